//! The loop that joins a [`ClientSession`] and a [`Connection`].

use std::str::FromStr;
use std::time::Duration;

use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::ViewError;

use crate::core::{ClientError, ClientSession, Connectivity};
use crate::net::native::{Connection, Event, NetError};
use crate::net::target::Target;

/// How long a server may say nothing at all while something is due from it.
const SILENCE: Duration = Duration::from_secs(30);
/// How long to wait before frames are offered again to a connection that takes no more.
const RETRY: Duration = Duration::from_millis(10);

/// When to stop.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Until {
    /// When the mesh is exactly what the view asks for.
    #[default]
    Settled,
    /// After the frames that lie wholly within this many bytes, upgrade and frame headers included, or when settled.
    Bytes(u64),
    /// This long after the connection was begun.
    Elapsed(Duration),
}

/// Why a flag's value makes no sense.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{0}' is no end: write settled, bytes:N or seconds:S")]
pub struct UntilError(String);

impl FromStr for Until {
    type Err = UntilError;

    /// `settled`, `bytes:N` or `seconds:S`, where S may have a fraction.
    fn from_str(text: &str) -> Result<Self, UntilError> {
        let error = || UntilError(text.into());
        if text == "settled" {
            return Ok(Self::Settled);
        }
        match text.split_once(':').ok_or_else(error)? {
            ("bytes", count) => count.parse().map(Self::Bytes).map_err(|_| error()),
            ("seconds", seconds) => {
                let seconds = seconds.parse().ok().filter(|seconds| (0.0..=1e9).contains(seconds)).ok_or_else(error)?;
                Ok(Self::Elapsed(Duration::from_secs_f64(seconds)))
            }
            _ => Err(error()),
        }
    }
}

/// Why streaming ended early.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DriveError {
    /// The connection failed.
    #[error(transparent)]
    Net(#[from] NetError),
    /// The connection broke, and no other could be made in time.
    #[error("{cause}; no way back within {} s: {last}", patience.as_secs())]
    NoWayBack {
        /// How it broke.
        cause: NetError,
        /// Why the last try failed.
        last: NetError,
        /// How long it was tried.
        patience: Duration,
    },
    /// The server's frames make no sense.
    #[error(transparent)]
    Session(#[from] ClientError),
    /// The caller asked for a view that makes no sense.
    #[error("the view makes no sense")]
    View(#[from] ViewError),
    /// The server is there but sends nothing.
    #[error("the server has sent nothing for {} s", SILENCE.as_secs())]
    Silent,
}

/// Where to connect again when the connection breaks, and for how long to try.
#[derive(Clone, Copy, Debug)]
pub struct WayBack<'a> {
    /// The stream.
    pub target: &'a Target,
    /// Time after which a broken connection is an error. Zero makes it one at once.
    pub patience: Duration,
}

/// Streams until `until`. When the connection breaks it is made anew along `way_back`. `tick` is called before the first wait and after every event; it may set views and look at the
/// session. The session must apply batches on arrival.
///
/// # Errors
/// [`DriveError`]; what the session holds stays valid and can still be used.
pub async fn drive(
    connection: &mut Connection,
    session: &mut ClientSession,
    until: Until,
    way_back: WayBack<'_>,
    mut tick: impl FnMut(&mut ClientSession, Timestamp) -> Result<(), ViewError>,
) -> Result<(), DriveError> {
    let mut heard = connection.bytes_received();
    let mut heard_at = connection.now();
    loop {
        let now = connection.now();
        session.note_traffic(connection.bytes_delivered(), connection.bytes_sent());
        tick(session, now)?;
        while connection.may_send()
            && let Some(frame) = session.poll_transmit(now)
        {
            connection.send(frame);
        }
        if is_reached(until, connection, session) {
            return Ok(());
        }

        if heard != connection.bytes_received() || session.settled().is_some() {
            heard = connection.bytes_received();
            heard_at = now;
        } else if now.since(heard_at) >= SILENCE {
            return Err(DriveError::Silent);
        }
        let end = match until {
            Until::Elapsed(length) => Some(Timestamp(length)),
            Until::Settled | Until::Bytes(_) => None,
        };
        let retry = (!connection.may_send()).then_some(now + RETRY);
        let wakes = [end, retry.or(session.poll_timeout()), Some(heard_at + SILENCE)];
        match connection.next(wakes.into_iter().flatten().min()).await {
            Ok(Event::Wake) => {}
            Err(error) if error.is_passing() && !way_back.patience.is_zero() => {
                come_back(connection, session, way_back, error, &mut tick).await?;
                (heard, heard_at) = (connection.bytes_received(), connection.now());
            }
            Err(error) => return Err(error.into()),
            Ok(Event::Frame(delivery)) => {
                if matches!(until, Until::Bytes(limit) if delivery.bytes_received > limit) {
                    return Ok(());
                }
                session.note_traffic(delivery.bytes_received, connection.bytes_sent());
                session.handle_frame(connection.now(), &delivery.frame)?;
            }
        }
    }
}

/// Makes the connection anew, try after try.
async fn come_back(
    connection: &mut Connection,
    session: &mut ClientSession,
    way_back: WayBack<'_>,
    cause: NetError,
    tick: &mut impl FnMut(&mut ClientSession, Timestamp) -> Result<(), ViewError>,
) -> Result<(), DriveError> {
    connection.cut();
    let end = connection.now() + way_back.patience;
    loop {
        session.handle_loss(connection.now());
        tick(session, connection.now())?;
        if let Connectivity::Reconnecting { next_try, .. } = session.connectivity() {
            connection.sleep_until(next_try.min(end)).await;
        }
        match connection.reopen(way_back.target).await {
            Ok(()) => return Ok(()),
            Err(error) if !error.is_passing() => return Err(error.into()),
            Err(last) if connection.now() >= end => {
                return Err(DriveError::NoWayBack { cause, last, patience: way_back.patience });
            }
            Err(_) => {}
        }
    }
}

fn is_reached(until: Until, connection: &Connection, session: &ClientSession) -> bool {
    match until {
        Until::Settled => session.settled().is_some(),
        Until::Bytes(limit) => session.settled().is_some() || connection.bytes_delivered() > limit,
        Until::Elapsed(length) => connection.now().0 >= length,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_parse() {
        assert_eq!("settled".parse(), Ok(Until::Settled));
        assert_eq!("bytes:30000".parse(), Ok(Until::Bytes(30_000)));
        assert_eq!("seconds:1.5".parse(), Ok(Until::Elapsed(Duration::from_millis(1500))));
        for text in ["", "bytes", "bytes:", "bytes:-1", "bytes:1k", "seconds:nan", "seconds:-1", "frames:3", "Settled"]
        {
            assert_eq!(text.parse::<Until>(), Err(UntilError(text.into())));
        }
    }
}
