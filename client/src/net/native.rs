//! The WebSocket over tokio, behind a [shaped link](super::link), with every byte counted.
//!
//! A [`Connection`] owns the socket and the clock. It is driven by one task: [`send`](Connection::send) puts a frame on its
//! way, [`next`](Connection::next) does all the waiting. The link lies below the WebSocket, so that every byte takes its
//! time and a slow one makes the server wait. [`get`] asks for small pages beside it.

mod counted;
pub mod get;
mod shaped;

use std::collections::VecDeque;
use std::future::{Future, poll_fn};
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use futures_util::{Sink, Stream};
use lodestream_protocol::limits::MAX_FRAME_BYTES;
use lodestream_protocol::message::CloseCode;
use lodestream_protocol::time::Timestamp;
use tokio::io::AsyncWrite;
use tokio::net::{TcpSocket, TcpStream, lookup_host};
use tokio::time::{Instant, sleep, sleep_until, timeout};
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::error::ProtocolError;
use tokio_tungstenite::tungstenite::http::StatusCode;
use tokio_tungstenite::tungstenite::protocol::frame::CloseFrame;
use tokio_tungstenite::tungstenite::protocol::{Message, WebSocketConfig};
use tokio_tungstenite::{WebSocketStream, client_async_with_config, tungstenite};

use super::link::LinkShape;
use super::target::Target;
use counted::Counted;
use shaped::Shaped;

/// How long opening a connection may take, besides what the shaped link adds.
const OPEN_TIMEOUT: Duration = Duration::from_secs(10);
/// How long the socket may refuse a frame: clients send a few hundred bytes a second, so it is stuck then.
const SEND_TIMEOUT: Duration = Duration::from_secs(10);
/// How long to wait for the server to take our goodbye.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(500);
/// Bytes of frames that wait to be sent from which on no more are taken.
const MAX_QUEUED_BYTES: usize = 1 << 20;
/// Bytes that the system keeps for a socket behind a shaped link: the link has buffers of its own.
const SHAPED_RECEIVE_BYTES: u32 = 64 << 10;
/// Bytes that are read from the link at once. There may be thousands of connections.
const READ_BUFFER_BYTES: usize = 16 << 10;
/// Longest text of a server that is repeated to the user, in characters.
const MAX_REASON_CHARS: usize = 300;

/// Why there is no connection, or none any more.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum NetError {
    /// No TCP connection.
    #[error("no server answers at {authority}")]
    Unreachable {
        /// Host and port.
        authority: String,
        /// What the system says.
        #[source]
        source: io::Error,
    },
    /// The server took too long to answer.
    #[error("the server at {authority} did not answer within {seconds} s")]
    OpenTimeout {
        /// Host and port.
        authority: String,
        /// How long that was.
        seconds: u64,
    },
    /// The server does not have this model.
    #[error("no model '{0}' on this server")]
    NoSuchModel(String),
    /// The server will not stream.
    #[error("the server refused to stream: status {status}{}{reason}", if reason.is_empty() { "" } else { ", " })]
    Refused {
        /// HTTP status.
        status: u16,
        /// Beginning of what the server says about it, may be empty.
        reason: String,
    },
    /// What answers speaks something else.
    #[error("what answers there is no Lodestream server: {0}")]
    Handshake(String),
    /// The server ended the stream and said so.
    #[error("the server closed the connection: {}", closing_words(*code, reason))]
    Closed {
        /// Number of the close frame, see [`CloseCode`].
        code: u16,
        /// What the server says about it, may be empty.
        reason: String,
    },
    /// The connection broke.
    #[error("the connection to the server was lost: {0}")]
    Lost(String),
    /// A frame is longer than the protocol allows, or no frame at all.
    #[error("the server broke the rules of WebSocket: {0}")]
    BadFrame(String),
}

impl NetError {
    /// Whether another connection may do better: this one broke, or the server was away, busy, or about to end. Otherwise somebody
    /// decided that the session is over.
    pub fn is_passing(&self) -> bool {
        const PASSING: [CloseCode; 2] = [CloseCode::GoingAway, CloseCode::Timeout];
        match self {
            Self::Unreachable { .. } | Self::OpenTimeout { .. } | Self::Lost(_) => true,
            Self::Closed { code, .. } => CloseCode::from_number(*code).is_some_and(|code| PASSING.contains(&code)),
            // Unavailable, and what proxies say when the server behind them is away.
            Self::Refused { status, .. } => [502, 503, 504].contains(status),
            Self::NoSuchModel(_) | Self::Handshake(_) | Self::BadFrame(_) => false,
        }
    }
}

fn closing_words(code: u16, reason: &str) -> String {
    let name = CloseCode::from_number(code).map_or(String::new(), |code| format!("{code:?}, "));
    match reason {
        "" => format!("{name}code {code}"),
        _ => format!("{reason} ({name}code {code})"),
    }
}

/// A frame as it comes out of the link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Delivery {
    /// The frame's payload.
    pub frame: Vec<u8>,
    /// Bytes from the socket's first one to this frame's last one: upgrade, frame headers and all.
    pub bytes_received: u64,
}

/// What [`Connection::next`] waited for.
#[derive(Debug)]
pub enum Event {
    /// A frame arrived.
    Frame(Delivery),
    /// The time given is reached.
    Wake,
}

type Socket = WebSocketStream<Counted<Shaped<TcpStream>>>;

/// One WebSocket connection. See the module.
#[derive(Debug)]
pub struct Connection {
    /// `None` between [`cut`](Connection::cut) and the next one.
    socket: Option<Socket>,
    start: Instant,
    shape: LinkShape,
    /// Frames to send.
    queue: VecDeque<Vec<u8>>,
    queued_bytes: usize,
    /// Since when the socket refuses a frame.
    stuck_since: Option<Instant>,
    /// Where the last message ends in the stream of bytes.
    delivered_end: u64,
    /// Whether the server is known to be gone: what it said before is still to be read.
    is_over: bool,
    /// Bytes that came and went through the sockets before this one.
    earlier: [u64; 2],
}

impl Connection {
    /// Connects to the stream of a model. Timestamp zero is when this was called. Setting up TCP costs a round trip of the
    /// link, and the upgrade crosses it like all that follows.
    ///
    /// # Errors
    /// [`NetError`]; nothing is left open.
    pub async fn open(target: &Target, shape: LinkShape) -> Result<Self, NetError> {
        let start = Instant::now();
        let socket = open(target, &shape, start).await?;
        let delivered_end = socket.get_ref().head_received();
        Ok(Self {
            socket: Some(socket),
            start,
            shape,
            queue: VecDeque::new(),
            queued_bytes: 0,
            stuck_since: None,
            delivered_end,
            is_over: false,
            earlier: [0; 2],
        })
    }

    /// Lets go of the socket without a goodbye, as if the connection broke. What was to be sent is forgotten.
    pub fn cut(&mut self) {
        self.earlier = [self.bytes_received(), self.bytes_sent()];
        self.socket = None;
        self.queue.clear();
        self.queued_bytes = 0;
        self.stuck_since = None;
        self.is_over = false;
    }

    /// Connects again after the connection broke, or was [cut](Self::cut): the clock and the counts go on.
    ///
    /// # Errors
    /// [`NetError`]; there is no connection then, and another try may be made.
    pub async fn reopen(&mut self, target: &Target) -> Result<(), NetError> {
        self.cut();
        let socket = open(target, &self.shape, self.start).await?;
        // What came of a frame that broke off came all the same.
        self.delivered_end = self.earlier[0] + socket.get_ref().head_received();
        self.socket = Some(socket);
        Ok(())
    }

    /// Time since [`open`](Self::open) was called.
    pub fn now(&self) -> Timestamp {
        Timestamp(self.start.elapsed())
    }

    /// Waits until then.
    pub async fn sleep_until(&self, at: Timestamp) {
        sleep_until(self.start + at.0).await;
    }

    /// Whether [`send`](Self::send) may be called: its queue is bounded.
    pub fn may_send(&self) -> bool {
        self.queued_bytes < MAX_QUEUED_BYTES
    }

    /// Puts a frame on its way. It goes out during [`next`](Self::next).
    pub fn send(&mut self, frame: Vec<u8>) {
        self.queued_bytes += frame.len();
        self.queue.push_back(frame);
    }

    /// Waits for the next frame, at most until `until`. Frames that are there come before the time is looked at.
    ///
    /// # Errors
    /// [`NetError`], after everything that came before the end.
    pub async fn next(&mut self, until: Option<Timestamp>) -> Result<Event, NetError> {
        let wake = until.map(|until| self.start + until.0);
        let waiting = async {
            match wake {
                Some(wake) => sleep_until(wake).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            biased;
            delivery = poll_fn(|cx| self.poll_delivery(cx)) => delivery.map(Event::Frame),
            () = waiting => Ok(Event::Wake),
        }
    }

    /// Bytes that came out of the link up to the end of the last frame.
    pub fn bytes_delivered(&self) -> u64 {
        self.delivered_end
    }

    /// Bytes that came out of the link so far; the last of them may belong to a frame that is not complete.
    pub fn bytes_received(&self) -> u64 {
        self.earlier[0] + self.socket.as_ref().map_or(0, |socket| socket.get_ref().received())
    }

    /// Bytes that went into the link so far.
    pub fn bytes_sent(&self) -> u64 {
        self.earlier[1] + self.socket.as_ref().map_or(0, |socket| socket.get_ref().sent())
    }

    /// Says goodbye and waits until that has gone out. What is still on the way here is lost, which is no error.
    pub async fn close(self, code: CloseCode) {
        let Some(mut socket) = self.socket else { return };
        let frame = CloseFrame { code: (code as u16).into(), reason: "".into() };
        let goodbye = async {
            socket.close(Some(frame)).await?;
            poll_fn(|cx| Pin::new(socket.get_mut()).poll_shutdown(cx)).await?;
            Ok::<(), tungstenite::Error>(())
        };
        let _ = timeout(CLOSE_TIMEOUT + self.shape.latency, goodbye).await;
    }

    fn poll_delivery(&mut self, cx: &mut Context<'_>) -> Poll<Result<Delivery, NetError>> {
        loop {
            self.poll_send(cx)?;
            let next = self.socket.as_mut().map(|socket| Pin::new(socket).poll_next(cx));
            let Some(message) = ready!(next.unwrap_or(Poll::Ready(None))) else {
                return Poll::Ready(Err(NetError::Lost("it ended".into())));
            };
            let message = message.map_err(broken)?;
            self.delivered_end += frame_bytes(payload_bytes(&message));
            match message {
                Message::Binary(bytes) => {
                    let delivery = Delivery { frame: bytes.into(), bytes_received: self.delivered_end };
                    return Poll::Ready(Ok(delivery));
                }
                Message::Ping(_) | Message::Pong(_) => {}
                Message::Close(Some(frame)) => {
                    let (code, reason) = (frame.code.into(), printable(&frame.reason));
                    return Poll::Ready(Err(NetError::Closed { code, reason }));
                }
                Message::Close(None) => {
                    return Poll::Ready(Err(NetError::Closed { code: 1005, reason: "without a reason".into() }));
                }
                Message::Text(_) | Message::Frame(_) => {
                    return Poll::Ready(Err(NetError::BadFrame("a frame of text".into())));
                }
            }
        }
    }

    /// Sends what the socket takes.
    fn poll_send(&mut self, cx: &mut Context<'_>) -> Result<(), NetError> {
        while !self.is_over {
            match self.poll_send_one(cx) {
                Poll::Ready(Ok(true)) => self.stuck_since = None,
                Poll::Ready(Ok(false)) => {
                    self.stuck_since = None;
                    return Ok(());
                }
                // The server may have said why before it went: reading on brings that out.
                Poll::Ready(Err(error)) if is_gone(&error) => self.is_over = true,
                Poll::Ready(Err(error)) => return Err(broken(error)),
                Poll::Pending => {
                    let since = *self.stuck_since.get_or_insert_with(Instant::now);
                    let stalls = self.shape.stalls.map_or(Duration::ZERO, |stalls| stalls.length * 2);
                    return match since.elapsed() > SEND_TIMEOUT + stalls {
                        true => Err(NetError::Lost("the server takes no more".into())),
                        false => Ok(()),
                    };
                }
            }
        }
        Ok(())
    }

    /// Sends one frame, or what was not sent of those before. `false` if there is nothing more to send.
    fn poll_send_one(&mut self, cx: &mut Context<'_>) -> Poll<Result<bool, tungstenite::Error>> {
        let Some(socket) = self.socket.as_mut() else { return Poll::Ready(Ok(false)) };
        let mut socket = Pin::new(socket);
        ready!(socket.as_mut().poll_ready(cx))?;
        ready!(socket.as_mut().poll_flush(cx))?;
        let Some(frame) = self.queue.pop_front() else { return Poll::Ready(Ok(false)) };
        self.queued_bytes -= frame.len();
        socket.as_mut().start_send(Message::Binary(frame.into()))?;
        Poll::Ready(Ok(true))
    }
}

/// Bytes that a message has after the header of its frame.
fn payload_bytes(message: &Message) -> usize {
    match message {
        Message::Close(Some(frame)) => 2 + frame.reason.len(),
        Message::Close(None) => 0,
        other => other.len(),
    }
}

/// Runs a future to its end on this thread.
///
/// # Errors
/// The system grants no event queue.
pub fn block_on<F: Future>(future: F) -> io::Result<F::Output> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build()?;
    Ok(runtime.block_on(future))
}

async fn open(target: &Target, shape: &LinkShape, start: Instant) -> Result<Socket, NetError> {
    let limit = OPEN_TIMEOUT + shape.latency * 4 + shape.stalls.map_or(Duration::ZERO, |stalls| stalls.length * 2);
    timeout(limit, upgrade(target, shape, start))
        .await
        .map_err(|_| NetError::OpenTimeout { authority: target.authority(), seconds: limit.as_secs() })?
}

async fn connect(target: &Target, shape: &LinkShape) -> io::Result<TcpStream> {
    let mut failure = io::Error::new(io::ErrorKind::NotFound, "the name has no address");
    for address in lookup_host((target.host.as_str(), target.port)).await? {
        let socket = if address.is_ipv4() { TcpSocket::new_v4() } else { TcpSocket::new_v6() }?;
        if !shape.is_transparent() {
            // A system that refuses keeps more, no more than that.
            let _ = socket.set_recv_buffer_size(SHAPED_RECEIVE_BYTES);
        }
        match socket.connect(address).await {
            Ok(stream) => return Ok(stream),
            Err(error) => failure = error,
        }
    }
    Err(failure)
}

async fn upgrade(target: &Target, shape: &LinkShape, start: Instant) -> Result<Socket, NetError> {
    let stream = connect(target, shape)
        .await
        .map_err(|source| NetError::Unreachable { authority: target.authority(), source })?;
    // Frames are small and wait for nothing; without the option the socket works, only slower.
    let _ = stream.set_nodelay(true);
    // The handshake of TCP, there and back.
    sleep(shape.latency * 2).await;
    let request = target.to_string().into_client_request().map_err(|error| NetError::Handshake(error.to_string()))?;
    let config = WebSocketConfig::default()
        .max_message_size(Some(MAX_FRAME_BYTES))
        .max_frame_size(Some(MAX_FRAME_BYTES))
        .read_buffer_size(READ_BUFFER_BYTES)
        .write_buffer_size(0);
    let stream = Counted::new(Shaped::new(stream, shape, start));
    match client_async_with_config(request, stream, Some(config)).await {
        Ok((socket, _)) => Ok(socket),
        Err(tungstenite::Error::Http(response)) if response.status() == StatusCode::NOT_FOUND => {
            Err(NetError::NoSuchModel(target.model.clone()))
        }
        Err(tungstenite::Error::Http(response)) => {
            let body = response.body().as_deref().unwrap_or_default();
            let reason = printable(&String::from_utf8_lossy(body));
            Err(NetError::Refused { status: response.status().as_u16(), reason })
        }
        // The server, or something on the way, went before it had answered.
        Err(tungstenite::Error::Io(error)) => Err(NetError::Lost(error.to_string())),
        Err(tungstenite::Error::Protocol(ProtocolError::HandshakeIncomplete)) => {
            Err(NetError::Lost("it ended before the server answered".into()))
        }
        Err(error) => Err(NetError::Handshake(error.to_string())),
    }
}

/// Bytes of an unmasked, unfragmented frame on the wire (RFC 6455, section 5.2). Lodestream servers fragment nothing.
fn frame_bytes(payload: usize) -> u64 {
    let header = match payload {
        0..=125 => 2,
        126..=0xffff => 4,
        _ => 10,
    };
    payload as u64 + header
}

/// Whether the other end is known to be gone, so that only its last words are of interest.
fn is_gone(error: &tungstenite::Error) -> bool {
    matches!(
        error,
        tungstenite::Error::ConnectionClosed
            | tungstenite::Error::AlreadyClosed
            | tungstenite::Error::Io(_)
            | tungstenite::Error::Protocol(ProtocolError::SendAfterClosing)
    )
}

fn broken(error: tungstenite::Error) -> NetError {
    match error {
        tungstenite::Error::Io(error) => NetError::Lost(error.to_string()),
        tungstenite::Error::Protocol(ProtocolError::ResetWithoutClosingHandshake)
        | tungstenite::Error::ConnectionClosed
        | tungstenite::Error::AlreadyClosed => NetError::Lost("it ended without a goodbye".into()),
        error => NetError::BadFrame(error.to_string()),
    }
}

/// A server's text, short enough and without what could steer a terminal.
fn printable(text: &str) -> String {
    let words = text.trim().chars().take(MAX_REASON_CHARS);
    words.map(|c| if c.is_control() { ' ' } else { c }).collect()
}

#[cfg(test)]
mod tests;
