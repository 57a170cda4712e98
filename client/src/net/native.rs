//! The WebSocket over tokio, behind a [shaped link](super::link), with every byte counted.
//!
//! A [`Connection`] owns the socket and the clock. It is driven by one task: [`send`](Connection::send) puts a frame on its
//! way, [`next`](Connection::next) does all the waiting. Nothing above this module names tokio.

mod counted;

use std::future::Future;
use std::io;
use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use lodestream_protocol::limits::MAX_FRAME_BYTES;
use lodestream_protocol::message::CloseCode;
use lodestream_protocol::time::Timestamp;
use tokio::net::TcpStream;
use tokio::time::{Instant, sleep, sleep_until, timeout};
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::error::ProtocolError;
use tokio_tungstenite::tungstenite::http::StatusCode;
use tokio_tungstenite::tungstenite::protocol::frame::CloseFrame;
use tokio_tungstenite::tungstenite::protocol::{Message, WebSocketConfig};
use tokio_tungstenite::{WebSocketStream, client_async_with_config, tungstenite};

use super::link::{Lane, LinkRate, LinkShape};
use super::target::Target;
use counted::Counted;

/// How long opening a connection may take, besides what the shaped link adds.
const OPEN_TIMEOUT: Duration = Duration::from_secs(10);
/// How long the socket may refuse a frame: clients send a few hundred bytes a second, so it is stuck then.
const SEND_TIMEOUT: Duration = Duration::from_secs(10);
/// How long to wait for the server to take our goodbye.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(500);
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

/// What is on the way to the client.
#[derive(Debug)]
enum Arrival {
    Frame(Vec<u8>),
    /// Pings and the like: bytes that mean nothing above.
    Control,
    End(NetError),
}

/// One WebSocket connection. See the module.
#[derive(Debug)]
pub struct Connection {
    socket: WebSocketStream<Counted<TcpStream>>,
    start: Instant,
    /// From the server, with where each arrival ends in the stream of bytes.
    down: Lane<(Arrival, u64)>,
    up: Lane<Vec<u8>>,
    /// Where the last message read from the socket ends.
    read_end: u64,
    /// Where the last arrival taken out of the link ends.
    delivered_end: u64,
    is_over: bool,
}

impl Connection {
    /// Connects to the stream of a model. Timestamp zero is when this was called. Setting up TCP costs a round trip of the
    /// link, and the upgrade crosses it like all that follows.
    ///
    /// # Errors
    /// [`NetError`]; nothing is left open.
    pub async fn open(target: &Target, shape: LinkShape) -> Result<Self, NetError> {
        let start = Instant::now();
        let limit = OPEN_TIMEOUT + shape.latency * 4;
        let socket = timeout(limit, upgrade(target, shape))
            .await
            .map_err(|_| NetError::OpenTimeout { authority: target.authority(), seconds: limit.as_secs() })??;
        let mut connection = Self {
            read_end: socket.get_ref().head_received(),
            socket,
            start,
            down: Lane::new(shape.rate, shape.latency),
            up: Lane::new(LinkRate::Unlimited, shape.latency),
            delivered_end: 0,
            is_over: false,
        };
        connection.arrive(connection.read_end, Arrival::Control);
        while let Some(due) = connection.down.next_due() {
            sleep_until(start + due.0).await;
            connection.take_due();
        }
        Ok(connection)
    }

    /// Time since [`open`](Self::open) was called.
    pub fn now(&self) -> Timestamp {
        Timestamp(self.start.elapsed())
    }

    /// Whether [`send`](Self::send) may be called: its queue is bounded.
    pub fn may_send(&self) -> bool {
        self.up.has_room()
    }

    /// Puts a frame on its way. It goes out during [`next`](Self::next).
    pub fn send(&mut self, frame: Vec<u8>) {
        self.up.push(self.now(), frame.len(), frame);
    }

    /// Waits for the next frame, at most until `until`. Frames that are due come before the time is looked at.
    ///
    /// # Errors
    /// [`NetError`], after everything that came before the end.
    pub async fn next(&mut self, until: Option<Timestamp>) -> Result<Event, NetError> {
        loop {
            self.send_due().await?;
            if let Some(arrival) = self.take_due() {
                match arrival {
                    Arrival::Frame(frame) => {
                        return Ok(Event::Frame(Delivery { frame, bytes_received: self.delivered_end }));
                    }
                    Arrival::Control => continue,
                    Arrival::End(error) => return Err(error),
                }
            }
            if until.is_some_and(|until| until <= self.now()) {
                return Ok(Event::Wake);
            }
            let wake = [until, self.down.next_due(), self.up.next_due()].into_iter().flatten().min();
            let start = self.start;
            let waiting = async {
                match wake {
                    Some(wake) => sleep_until(start + wake.0).await,
                    None => std::future::pending().await,
                }
            };
            let may_read = !self.is_over && self.down.has_room();
            tokio::select! {
                message = self.socket.next(), if may_read => self.read(message),
                () = waiting => {}
            }
        }
    }

    /// Bytes that came out of the link so far: where the last frame ended.
    pub fn bytes_delivered(&self) -> u64 {
        self.delivered_end
    }

    /// Bytes that came through the socket so far; some of them may still be in the link.
    pub fn bytes_received(&self) -> u64 {
        self.socket.get_ref().received()
    }

    /// Bytes that went out through the socket so far.
    pub fn bytes_sent(&self) -> u64 {
        self.socket.get_ref().sent()
    }

    /// Whether something from the server is still in the link.
    pub fn is_receiving(&self) -> bool {
        !self.down.is_empty()
    }

    /// Says goodbye. What is still on the way is lost, which is no error.
    pub async fn close(mut self, code: CloseCode) {
        let frame = CloseFrame { code: (code as u16).into(), reason: "".into() };
        let _ = timeout(CLOSE_TIMEOUT, self.socket.close(Some(frame))).await;
    }

    async fn send_due(&mut self) -> Result<(), NetError> {
        while let Some(frame) = self.up.pop(self.now()) {
            if self.is_over {
                continue;
            }
            match timeout(SEND_TIMEOUT, self.socket.send(Message::Binary(frame.into()))).await {
                Ok(Ok(())) => {}
                // The server may have said why before it went: reading on brings that out.
                Ok(Err(error)) if is_gone(&error) => {}
                Ok(Err(error)) => return Err(broken(error)),
                Err(_) => return Err(NetError::Lost("the server takes no more".into())),
            }
        }
        Ok(())
    }

    fn take_due(&mut self) -> Option<Arrival> {
        let (arrival, end) = self.down.pop(self.now())?;
        self.delivered_end = end;
        Some(arrival)
    }

    /// Puts what the socket brought into the link. `bytes` is what it took on the wire.
    fn arrive(&mut self, bytes: u64, arrival: Arrival) {
        self.down.push(self.now(), usize::try_from(bytes).unwrap_or(usize::MAX), (arrival, self.read_end));
    }

    fn read(&mut self, message: Option<Result<Message, tungstenite::Error>>) {
        let (payload, arrival) = match message {
            Some(Ok(Message::Binary(bytes))) => (bytes.len(), Arrival::Frame(bytes.into())),
            Some(Ok(Message::Ping(bytes) | Message::Pong(bytes))) => (bytes.len(), Arrival::Control),
            Some(Ok(Message::Close(Some(frame)))) => {
                let (code, reason) = (frame.code.into(), printable(&frame.reason));
                (2 + frame.reason.len(), Arrival::End(NetError::Closed { code, reason }))
            }
            Some(Ok(Message::Close(None))) => {
                (0, Arrival::End(NetError::Closed { code: 1005, reason: "without a reason".into() }))
            }
            Some(Ok(Message::Text(_) | Message::Frame(_))) => {
                self.is_over = true;
                return self.arrive(0, Arrival::End(NetError::BadFrame("a frame of text".into())));
            }
            Some(Err(error)) => {
                self.is_over = true;
                return self.arrive(0, Arrival::End(broken(error)));
            }
            None => {
                self.is_over = true;
                return self.arrive(0, Arrival::End(NetError::Lost("it ended".into())));
            }
        };
        self.is_over |= matches!(arrival, Arrival::End(_));
        let bytes = frame_bytes(payload);
        self.read_end += bytes;
        self.arrive(bytes, arrival);
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

async fn upgrade(target: &Target, shape: LinkShape) -> Result<WebSocketStream<Counted<TcpStream>>, NetError> {
    let stream = TcpStream::connect((target.host.as_str(), target.port))
        .await
        .map_err(|source| NetError::Unreachable { authority: target.authority(), source })?;
    // Frames are small and wait for nothing; without the option the socket works, only slower.
    let _ = stream.set_nodelay(true);
    // The handshake of TCP there and back, and the request on its way.
    sleep(shape.latency * 3).await;
    let request = target.to_string().into_client_request().map_err(|error| NetError::Handshake(error.to_string()))?;
    let config = WebSocketConfig::default()
        .max_message_size(Some(MAX_FRAME_BYTES))
        .max_frame_size(Some(MAX_FRAME_BYTES))
        .write_buffer_size(0);
    match client_async_with_config(request, Counted::new(stream), Some(config)).await {
        Ok((socket, _)) => Ok(socket),
        Err(tungstenite::Error::Http(response)) if response.status() == StatusCode::NOT_FOUND => {
            Err(NetError::NoSuchModel(target.model.clone()))
        }
        Err(tungstenite::Error::Http(response)) => {
            let body = response.body().as_deref().unwrap_or_default();
            let reason = printable(&String::from_utf8_lossy(body));
            Err(NetError::Refused { status: response.status().as_u16(), reason })
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
