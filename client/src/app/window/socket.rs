//! Connections beside the window's loop: a thread for each, two bounded channels, and a call that wakes the loop.

use std::io;
use std::thread;

use lodestream_protocol::message::CloseCode;
use tokio::sync::mpsc::{self, Receiver, Sender};

use super::super::viewer::Ending;
use crate::net::link::LinkShape;
use crate::net::native::{self, Connection, NetError};
use crate::net::target::Target;

/// Frames that wait on their way in. When the loop does not take them, the thread reads no more, and the server notices.
const INCOMING_FRAMES: usize = 64;
/// Frames that wait on their way out: views and acknowledgements, which the viewer says anew rather than to wait.
const OUTGOING_FRAMES: usize = 256;

/// What a connection brought.
#[derive(Debug)]
pub(super) enum Incoming {
    /// It is open.
    Open,
    /// A frame.
    Frame(Vec<u8>),
    /// It is over, or never was.
    Ended(Ending),
}

/// One connection, open or on the way there. Dropped, it says goodbye.
#[derive(Debug)]
pub(super) struct Socket {
    outgoing: Sender<Vec<u8>>,
    incoming: Receiver<Incoming>,
}

impl Socket {
    /// Begins to connect. `wake` is called on another thread after each [`Incoming`].
    ///
    /// # Errors
    /// The system grants no thread.
    pub(super) fn open(target: Target, wake: impl Fn() + Send + 'static) -> io::Result<Self> {
        let (outgoing, to_send) = mpsc::channel(OUTGOING_FRAMES);
        let (arrived, incoming) = mpsc::channel(INCOMING_FRAMES);
        let run = move || {
            let ended = match native::block_on(stream(&target, to_send, &arrived, &wake)) {
                Ok(None) => return,
                Ok(Some(ending)) => ending,
                Err(_) => Ending::Lost,
            };
            // Whoever dropped the socket does not want to hear of its end.
            let _ = arrived.blocking_send(Incoming::Ended(ended));
            wake();
        };
        thread::Builder::new().name("connection".into()).spawn(run)?;
        Ok(Self { outgoing, incoming })
    }

    /// What arrived next.
    pub(super) fn poll(&mut self) -> Option<Incoming> {
        self.incoming.try_recv().ok()
    }

    /// Whether [`send`](Self::send) takes a frame.
    pub(super) fn may_send(&self) -> bool {
        self.outgoing.capacity() > 0
    }

    /// Puts a frame on its way. What a connection that has ended does not take is lost with it.
    pub(super) fn send(&self, frame: Vec<u8>) {
        let _ = self.outgoing.try_send(frame);
    }
}

/// Carries frames in both directions until the socket is dropped (`None`) or the connection ends.
async fn stream(
    target: &Target,
    mut to_send: Receiver<Vec<u8>>,
    arrived: &Sender<Incoming>,
    wake: &impl Fn(),
) -> Option<Ending> {
    let mut connection = match Connection::open(target, LinkShape::default()).await {
        Ok(connection) => connection,
        Err(error) => return Some(ending(&error)),
    };
    if arrived.send(Incoming::Open).await.is_err() {
        connection.close(CloseCode::Normal).await;
        return None;
    }
    wake();
    loop {
        tokio::select! {
            frame = to_send.recv(), if connection.may_send() => match frame {
                Some(frame) => connection.send(frame),
                None => break,
            },
            event = connection.next(None) => match event {
                Ok(native::Event::Frame(delivery)) => {
                    if arrived.send(Incoming::Frame(delivery.frame)).await.is_err() {
                        break;
                    }
                    wake();
                }
                Ok(native::Event::Wake) => {}
                Err(error) => return Some(ending(&error)),
            },
        }
    }
    connection.close(CloseCode::Normal).await;
    None
}

fn ending(error: &NetError) -> Ending {
    match error {
        NetError::NoSuchModel(_) => Ending::NoSuchModel,
        NetError::Refused { status: 503, .. } => Ending::Full,
        NetError::Refused { .. } | NetError::Handshake(_) => Ending::Refused(error.to_string()),
        NetError::Closed { code, reason } => Ending::Closed { code: *code, reason: reason.clone() },
        _ => Ending::Lost,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_error_of_the_network_has_its_ending() {
        let refused = |status| NetError::Refused { status, reason: "no".into() };
        assert_eq!(ending(&NetError::NoSuchModel("x".into())), Ending::NoSuchModel);
        assert_eq!(ending(&refused(503)), Ending::Full);
        assert!(matches!(ending(&refused(403)), Ending::Refused(reason) if reason.contains("403")));
        assert_eq!(ending(&NetError::Lost("gone".into())), Ending::Lost);
        let closed = NetError::Closed { code: 4000, reason: "bad".into() };
        assert_eq!(ending(&closed), Ending::Closed { code: 4000, reason: "bad".into() });
    }

    #[test]
    fn a_connection_that_cannot_be_opened_says_so_and_wakes() {
        let (woken, wait) = std::sync::mpsc::channel();
        // A port that nobody listens on: it was free a moment ago.
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let target = format!("http://127.0.0.1:{port}/models/x").parse().unwrap();
        let wake = move || woken.send(()).unwrap_or_default();
        let mut socket = Socket::open(target, wake).unwrap();
        wait.recv_timeout(std::time::Duration::from_secs(20)).expect("the loop is woken");
        assert!(matches!(socket.poll(), Some(Incoming::Ended(Ending::Lost))));
        assert!(socket.poll().is_none());
    }
}
