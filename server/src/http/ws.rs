//! Streams: upgrade to a WebSocket, then frames between the socket and the session's channels, nothing else.

use std::sync::Arc;
use std::time::Duration;

use axum::Extension;
use axum::body::Bytes;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::ws::{CloseFrame, Message, Utf8Bytes, WebSocket, WebSocketUpgrade};
use axum::extract::{Path, State};
use axum::http::{HeaderMap, HeaderValue, Uri, header};
use axum::response::Response;
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use lodestream_protocol::limits::MAX_CLIENT_FRAME_BYTES;
use lodestream_protocol::message::CloseCode;
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval, sleep, timeout};
use tokio_tungstenite::tungstenite;
use tracing::Instrument;

use super::error::HttpError;
use super::serve::Peer;
use super::{App, ModelStatus, OpenError, Settings};
use crate::runtime::{Admitted, Core, SessionEnd, SessionReport, drive};
use crate::session::SessionError;

/// A close frame has room for 125 bytes, two of which are the code.
const MAX_REASON_BYTES: usize = 123;

/// Room for what a client sends in one go: some views and acks, each far below the longest frame.
const READ_BUFFER_BYTES: usize = 8 << 10;

/// `GET /models/<id>/stream`
pub(super) async fn stream(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    Extension(Peer(peer)): Extension<Peer>,
    headers: HeaderMap,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Response {
    let (upgrade, core, admitted) = match admit(&app, &id, &headers, upgrade).await {
        Ok(admission) => admission,
        Err(error) => {
            app.workers.metrics.note_refused(error.refusal());
            return error.respond(&headers);
        }
    };
    let span = tracing::info_span!("session", number = admitted.number, model = id, %peer);
    upgrade
        .max_frame_size(MAX_CLIENT_FRAME_BYTES)
        .max_message_size(MAX_CLIENT_FRAME_BYTES)
        .read_buffer_size(READ_BUFFER_BYTES)
        .on_upgrade(move |socket| run(socket, app, core, id, admitted).instrument(span))
}

/// All that must hold before a connection becomes a stream.
async fn admit(
    app: &Arc<App>,
    id: &str,
    headers: &HeaderMap,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<(WebSocketUpgrade, Box<dyn Core>, Admitted), HttpError> {
    check_origin(headers, &app.settings.allowed_origins)?;
    if app.shutdown.is_triggered() {
        return Err(HttpError::ShuttingDown);
    }
    // Those whose clients may or may not come back give way to one that is here.
    while app.workers.memory.is_exhausted(app.workers.metrics.session_bytes()) && app.workers.parking.displace() {}
    if app.workers.memory.is_exhausted(app.workers.metrics.session_bytes()) {
        tracing::warn!(model = id, "sessions hold all the memory they may");
        return Err(HttpError::NoMemory);
    }
    let admitted = app.admission.admit().inspect_err(|full| tracing::warn!(model = id, "{full}"))?;
    // Pages are not told why their socket was refused, so they ask again without one: what is to be said about the server
    // and the model comes first.
    let upgrade = upgrade.map_err(|rejection| {
        match app.models.list().iter().find(|entry| entry.id == id).map(|entry| entry.status) {
            Some(ModelStatus::Ready) => HttpError::NoWebSocket(rejection.body_text()),
            Some(ModelStatus::Quarantined) => HttpError::ModelUnusable(id.into()),
            None => HttpError::NoSuchModel(id.into()),
        }
    })?;
    let opened = tokio::task::spawn_blocking({
        let (app, id) = (Arc::clone(app), id.to_owned());
        move || app.models.open(&id)
    });
    let core = opened.await.map_err(|_| HttpError::Internal)?.inspect_err(|error| {
        if let OpenError::Unusable { .. } = error {
            tracing::error!("{error}");
        }
    })?;
    Ok((upgrade, core, admitted))
}

/// A browser says which site's page asks; other programs say nothing. A page of the same host is welcome, and so are those
/// in the list.
fn check_origin(headers: &HeaderMap, allowed: &[String]) -> Result<(), HttpError> {
    let Some(origin) = headers.get(header::ORIGIN) else {
        return Ok(());
    };
    let is_own = || {
        let origin = origin.to_str().ok()?.parse::<Uri>().ok()?;
        let host = headers.get(header::HOST)?.to_str().ok()?.parse::<Uri>().ok()?;
        let default_port = if origin.scheme_str() == Some("https") { 443 } else { 80 };
        let address = |uri: &Uri| Some((uri.host()?.to_ascii_lowercase(), uri.port_u16().unwrap_or(default_port)));
        Some(address(&origin)? == address(&host)?)
    };
    let is_listed =
        |origin: &HeaderValue| allowed.iter().any(|listed| listed == "*" || listed.as_bytes() == origin.as_bytes());
    if is_listed(origin) || is_own() == Some(true) {
        return Ok(());
    }
    Err(HttpError::ForeignOrigin(String::from_utf8_lossy(origin.as_bytes()).into_owned()))
}

/// One session from the upgrade to the end of its socket.
async fn run(socket: WebSocket, app: Arc<App>, core: Box<dyn Core>, model: String, admitted: Admitted) {
    let settings = &app.settings;
    let (inbound, frames) = mpsc::channel(settings.driver.inbound_frames);
    let (answers, outbound) = mpsc::channel(settings.driver.outbound_frames);
    let (mut sink, mut stream) = socket.split();
    app.workers.metrics.note_admitted();
    tracing::info!("session starts");
    let interrupted = async {
        tokio::select! {
            biased;
            () = app.shutdown.triggered() => SessionEnd::ShuttingDown,
            end = read(&mut stream, inbound, settings.idle_timeout) => end,
            end = write(&mut sink, outbound, settings) => end,
        }
    };
    let report = drive(core, &model, &app.workers, settings.driver.hello_timeout, frames, answers, interrupted).await;
    app.workers.metrics.note_closed(report.end.code());
    log_end(&report);
    close(sink, stream, &report.end, settings.close_timeout).await;
    drop(admitted);
}

/// Moves frames from the socket to the session until something is wrong.
async fn read(
    stream: &mut SplitStream<WebSocket>,
    inbound: mpsc::Sender<Vec<u8>>,
    idle_timeout: Duration,
) -> SessionEnd {
    loop {
        let message = match timeout(idle_timeout, stream.next()).await {
            Err(_) => return SessionEnd::Timeout { what: "nothing received", limit: idle_timeout },
            Ok(Some(Ok(Message::Close(_)))) => return SessionEnd::PeerDone,
            Ok(None) => return SessionEnd::PeerGone,
            Ok(Some(Err(error))) => return broken(error),
            Ok(Some(Ok(message))) => message,
        };
        match message {
            Message::Binary(frame) => {
                if inbound.send(frame.into()).await.is_err() {
                    // The driver is about to say why.
                    return std::future::pending().await;
                }
            }
            Message::Text(_) => return SessionEnd::Malformed("text frames are no part of the protocol".into()),
            Message::Ping(_) | Message::Pong(_) | Message::Close(_) => {}
        }
    }
}

/// What an error of the WebSocket layer says about the peer.
fn broken(error: axum::Error) -> SessionEnd {
    use tungstenite::error::{Error, ProtocolError};
    let error = error.into_inner();
    match error.downcast_ref() {
        Some(
            Error::Io(_)
            | Error::ConnectionClosed
            | Error::AlreadyClosed
            | Error::Protocol(ProtocolError::ResetWithoutClosingHandshake),
        ) => SessionEnd::PeerGone,
        _ => SessionEnd::Malformed(error.to_string()),
    }
}

/// Moves frames from the session to the socket and pings, until the socket takes no more.
async fn write(
    sink: &mut SplitSink<WebSocket, Message>,
    mut outbound: mpsc::Receiver<Vec<u8>>,
    settings: &Settings,
) -> SessionEnd {
    let mut pings = interval(settings.ping_interval);
    pings.set_missed_tick_behavior(MissedTickBehavior::Delay);
    pings.reset();
    loop {
        let message = tokio::select! {
            frame = outbound.recv() => match frame {
                Some(frame) => Message::Binary(frame.into()),
                // The driver is about to say why.
                None => return std::future::pending().await,
            },
            _ = pings.tick() => Message::Ping(Bytes::new()),
        };
        match timeout(settings.write_timeout, sink.send(message)).await {
            Ok(Ok(())) => {}
            Ok(Err(_)) => return SessionEnd::PeerGone,
            Err(_) => return SessionEnd::Timeout { what: "a frame was not taken", limit: settings.write_timeout },
        }
    }
}

/// Says why and waits for the peer's goodbye, both within `limit`.
async fn close(
    mut sink: SplitSink<WebSocket, Message>,
    mut stream: SplitStream<WebSocket>,
    end: &SessionEnd,
    limit: Duration,
) {
    let frame = CloseFrame { code: end.code() as u16, reason: reason(end) };
    let goodbye = async {
        if sink.send(Message::Close(Some(frame))).await.is_err() {
            return;
        }
        match end {
            SessionEnd::PeerDone | SessionEnd::PeerGone => {}
            // What follows in the socket is no frame, so nothing more is read. Closing a socket with unread bytes resets
            // it, and the peer might never see why: leave it time to.
            SessionEnd::Malformed(_) => sleep(limit).await,
            _ => while let Some(Ok(_)) = stream.next().await {},
        }
    };
    let _ = timeout(limit, goodbye).await;
}

/// The text of a close frame.
fn reason(end: &SessionEnd) -> Utf8Bytes {
    let mut text = end.to_string();
    text.truncate(text.floor_char_boundary(MAX_REASON_BYTES));
    text.into()
}

/// One line for each session: a peer's fault is a warning, bad data and our bugs are errors. Totals are left out where a
/// session was interrupted within a slice, which still has them.
fn log_end(SessionReport { end, stats, is_kept }: &SessionReport) {
    let code = end.code() as u16;
    macro_rules! log {
        ($level:ident) => {
            tracing::$level!(
                code,
                is_kept,
                bytes_sent = stats.map(|stats| stats.bytes_sent),
                batches = stats.map(|stats| stats.batches),
                splits = stats.map(|stats| stats.splits),
                collapses = stats.map(|stats| stats.collapses),
                views = stats.map(|stats| stats.views),
                "session ends: {end}"
            )
        };
    }
    match end {
        SessionEnd::PeerDone | SessionEnd::PeerGone | SessionEnd::TakenOver | SessionEnd::ShuttingDown => log!(info),
        SessionEnd::Timeout { .. } | SessionEnd::Malformed(_) => log!(warn),
        SessionEnd::Failed(error) => match error {
            SessionError::Peer(_, CloseCode::Normal) => log!(info),
            SessionError::Peer(..) => log!(warn),
            _ => log!(error),
        },
        SessionEnd::Lost(_) => log!(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn origins_are_compared_by_host_and_port() {
        let check = |origin: Option<&'static str>, host: &'static str, allowed: &[&str]| {
            let mut headers = HeaderMap::new();
            headers.insert(header::HOST, HeaderValue::from_static(host));
            if let Some(origin) = origin {
                headers.insert(header::ORIGIN, HeaderValue::from_static(origin));
            }
            let allowed: Vec<String> = allowed.iter().map(|&origin| origin.into()).collect();
            check_origin(&headers, &allowed).is_ok()
        };
        assert!(check(None, "a.org", &[]));
        assert!(check(Some("http://A.org"), "a.org", &[]));
        assert!(check(Some("https://a.org"), "a.org:443", &[]));
        assert!(check(Some("http://127.0.0.1:8080"), "127.0.0.1:8080", &[]));
        assert!(check(Some("http://[::1]:8080"), "[::1]:8080", &[]));
        assert!(check(Some("https://b.org"), "a.org", &["https://b.org"]));
        assert!(check(Some("https://b.org"), "a.org", &["*"]));
        assert!(!check(Some("https://b.org"), "a.org", &["https://c.org"]));
        assert!(!check(Some("http://a.org:81"), "a.org", &[]));
        assert!(!check(Some("null"), "a.org", &[]));
        assert!(!check(Some("http://a.org.evil.example"), "a.org", &[]));
    }

    #[test]
    fn reasons_fit_a_close_frame() {
        let end = SessionEnd::Malformed("ä".repeat(100));
        assert_eq!(reason(&end).as_str().len(), 122);
    }
}
