//! One session between two bounded channels: frames in, frames out, and the only clock that its core sees.
//!
//! The core itself lives on the compute threads: each call to it is one slice of the [`Pool`](super::pool::Pool). Nothing is asked of a core
//! before there is room for its answer, so a slow link costs no work and the newest view wins. Pages that a core wants go to the
//! [`PageReader`](super::PageReader), and the core is told when some were read.
//!
//! When the connection breaks, the core is handed to [`Parking`](super::Parking), and the driver of the connection that resumes it takes it
//! from there.

use std::sync::Arc;
use std::time::Duration;

use lodestream_protocol::ids::Token;
use lodestream_protocol::message::{ClientMessage, CloseCode};
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::wire;
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep_until};

use super::metrics::{Account, Resumption};
use super::parking::{Claim, Kept, Ticket};
use super::pool::PoolError;
use super::{Reading, Workers};
use crate::session::{Activity, Session, SessionError, SessionStats, WantedPages};

/// A core that says "call me again" for a time gone by is called after this long, or it would keep a thread busy.
const SHORTEST_WAIT: Duration = Duration::from_millis(1);

/// How long a connection waits for another one to give up the session: for the end of a slice.
const TAKEOVER_LIMIT: Duration = Duration::from_secs(10);

/// What the driver needs of a session: [`Session`], or a stand-in that a test controls, which says what it does not do by leaving it out.
pub trait Core: Send + 'static {
    /// See [`Session::handle_frame`].
    ///
    /// # Errors
    /// [`SessionError`] ends the session.
    fn handle_frame(&mut self, now: Timestamp, frame: &[u8]) -> Result<(), SessionError>;
    /// See [`Session::poll_transmit`].
    ///
    /// # Errors
    /// [`SessionError`] ends the session.
    fn poll_transmit(&mut self, now: Timestamp) -> Result<Option<Vec<u8>>, SessionError>;
    /// See [`Session::poll_timeout`].
    fn poll_timeout(&self) -> Option<Timestamp> {
        None
    }
    /// See [`Session::poll_wanted`].
    fn poll_wanted(&mut self) -> Option<WantedPages> {
        None
    }
    /// See [`Session::handle_pages`].
    ///
    /// # Errors
    /// [`SessionError`] ends the session.
    fn handle_pages(&mut self) -> Result<(), SessionError> {
        Ok(())
    }
    /// See [`Session::rest`].
    fn rest(&mut self) {}
    /// See [`Session::offer`].
    fn offer(&mut self, _token: Token) {}
    /// See [`Session::park`].
    fn park(&mut self) -> bool {
        false
    }
    /// See [`Session::stats`].
    fn stats(&self) -> SessionStats {
        SessionStats::default()
    }
}

impl Core for Session {
    fn handle_frame(&mut self, now: Timestamp, frame: &[u8]) -> Result<(), SessionError> {
        self.handle_frame(now, frame)
    }

    fn poll_transmit(&mut self, now: Timestamp) -> Result<Option<Vec<u8>>, SessionError> {
        self.poll_transmit(now)
    }

    fn poll_timeout(&self) -> Option<Timestamp> {
        self.poll_timeout()
    }

    fn poll_wanted(&mut self) -> Option<WantedPages> {
        self.poll_wanted()
    }

    fn handle_pages(&mut self) -> Result<(), SessionError> {
        self.handle_pages()
    }

    fn rest(&mut self) {
        self.rest();
    }

    fn offer(&mut self, token: Token) {
        self.offer(token);
    }

    fn park(&mut self) -> bool {
        self.park()
    }

    fn stats(&self) -> SessionStats {
        self.stats()
    }
}

/// What bounds every driver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DriverSettings {
    /// A client that has not sent its first frame by then is closed.
    pub hello_timeout: Duration,
    /// Frames from the client that may wait for the session.
    pub inbound_frames: usize,
    /// Frames for the client that may wait for the socket.
    pub outbound_frames: usize,
}

/// Why a session is over.
#[derive(Debug, thiserror::Error)]
pub enum SessionEnd {
    /// The client closed the connection.
    #[error("the client is done")]
    PeerDone,
    /// The connection broke.
    #[error("the client is gone")]
    PeerGone,
    /// Another connection goes on with the session.
    #[error("the session goes on over another connection")]
    TakenOver,
    /// The server stops.
    #[error("the server is shutting down")]
    ShuttingDown,
    /// The client was silent, or did not read, for too long.
    #[error("{what} within {limit:?}")]
    Timeout {
        /// What did not happen.
        what: &'static str,
        /// How long the server waited.
        limit: Duration,
    },
    /// What came through the socket is no frame of the protocol.
    #[error("{0}")]
    Malformed(String),
    /// The session gave up.
    #[error(transparent)]
    Failed(#[from] SessionError),
    /// A slice of the session gave no result.
    #[error("internal error")]
    Lost(#[source] PoolError),
}

impl SessionEnd {
    /// What to close the connection with.
    pub fn code(&self) -> CloseCode {
        match self {
            Self::PeerDone | Self::PeerGone => CloseCode::Normal,
            Self::TakenOver => CloseCode::TakenOver,
            Self::ShuttingDown => CloseCode::GoingAway,
            Self::Timeout { .. } => CloseCode::Timeout,
            Self::Malformed(_) => CloseCode::Malformed,
            Self::Failed(error) => error.code(),
            Self::Lost(_) => CloseCode::Internal,
        }
    }

    /// Whether neither side decided to end the session: the client may come back.
    fn is_broken_connection(&self) -> bool {
        matches!(self, Self::PeerGone | Self::TakenOver | Self::Timeout { .. })
    }
}

/// How a session went.
#[derive(Debug)]
pub struct SessionReport {
    /// Why it is over.
    pub end: SessionEnd,
    /// Its totals, or `None` when it was lost or interrupted within a slice.
    pub stats: Option<SessionStats>,
    /// Whether the session is kept for the client, or goes on over another connection already.
    pub is_kept: bool,
}

/// Runs `core`, or the session on `model` that the client's first frame resumes, until the client leaves, the core fails, or
/// `interrupted` gives another reason to stop.
///
/// `inbound` and `outbound` are the bounded channels of [`DriverSettings`]. `interrupted` is polled together with the
/// session, so whoever moves frames between socket and channels can live in it.
pub async fn drive(
    core: Box<dyn Core>,
    model: &str,
    workers: &Workers,
    hello_timeout: Duration,
    inbound: mpsc::Receiver<Vec<u8>>,
    outbound: mpsc::Sender<Vec<u8>>,
    interrupted: impl Future<Output = SessionEnd>,
) -> SessionReport {
    let mut driver = Driver {
        core: Some(core),
        model: model.into(),
        ticket: None,
        workers,
        reading: workers.reader.reading(),
        started: Instant::now(),
        wake: None,
        wants_transmit: false,
        account: Account::new(Arc::clone(&workers.metrics)),
        view_time: None,
    };
    let mut run = Box::pin(driver.run(hello_timeout, inbound, outbound));
    let (mut end, is_interrupted) = tokio::select! {
        biased;
        end = interrupted => (end, true),
        end = &mut run => (end, false),
    };
    if is_interrupted && end.is_broken_connection() {
        // A slice that runs now has the core, which is wanted. The driver ends after it: with `interrupted`, the other ends of its channels
        // are gone.
        match run.await {
            SessionEnd::PeerGone => {}
            other => end = other,
        }
    } else {
        drop(run);
    }
    driver.finish(end).await
}

struct Driver<'a> {
    /// `None` while a slice has it.
    core: Option<Box<dyn Core>>,
    model: Arc<str>,
    /// `None` before the first frame, and where sessions are not kept.
    ticket: Option<Ticket>,
    workers: &'a Workers,
    reading: Reading,
    started: Instant,
    /// When to ask for a frame again although none came in.
    wake: Option<Instant>,
    wants_transmit: bool,
    account: Account,
    /// Compute time since the newest view came, until there is a frame for it.
    view_time: Option<Duration>,
}

/// What a slice gives back.
struct Done<T> {
    core: Box<dyn Core>,
    result: Result<T, SessionError>,
    timeout: Option<Timestamp>,
    wanted: Option<WantedPages>,
    stats: SessionStats,
    waited: Duration,
    took: Duration,
}

impl Driver<'_> {
    async fn run(
        &mut self,
        hello_timeout: Duration,
        mut inbound: mpsc::Receiver<Vec<u8>>,
        outbound: mpsc::Sender<Vec<u8>>,
    ) -> SessionEnd {
        let first = match tokio::time::timeout(hello_timeout, inbound.recv()).await {
            Ok(Some(frame)) => frame,
            Ok(None) => return SessionEnd::PeerGone,
            Err(_) => return SessionEnd::Timeout { what: "no hello", limit: hello_timeout },
        };
        if let Err(end) = self.begin(first).await {
            return end;
        }
        loop {
            let wake = self.wake;
            // Frames first: the next batch should answer the newest of them.
            let step = tokio::select! {
                biased;
                () = taken_over(self.ticket.as_ref()) => Err(SessionEnd::TakenOver),
                frame = inbound.recv() => match frame {
                    Some(frame) => self.handle(frame).await,
                    None => return SessionEnd::PeerGone,
                },
                room = outbound.reserve(), if self.wants_transmit => match room {
                    Ok(room) => self.transmit(room).await,
                    Err(_) => return SessionEnd::PeerGone,
                },
                arrived = self.reading.arrived() => match arrived {
                    Ok(()) => self.handle_pages().await,
                    Err(lost) => Err(SessionEnd::Lost(lost)),
                },
                () = self.workers.memory.shortage(), if self.account.stats().activity == Activity::Settled => {
                    self.slice(|core, _| {
                        core.rest();
                        Ok(())
                    })
                    .await
                }
                () = sleep_until(wake.unwrap_or(self.started)), if !self.wants_transmit && wake.is_some() => {
                    self.wants_transmit = true;
                    Ok(())
                }
            };
            if let Err(end) = step {
                return end;
            }
        }
    }

    /// Handles the first frame: with the core that it resumes, if there is one.
    async fn begin(&mut self, frame: Vec<u8>) -> Result<(), SessionEnd> {
        let wanted = match wire::decode_client(&frame) {
            Ok(ClientMessage::Resume(resume)) => Some(resume.token),
            // Whatever else it is, the core says what is wrong with it.
            _ => None,
        };
        let known = match wanted {
            Some(token) => self.claim(token).await.then_some(token),
            None => None,
        };
        self.ticket = self.workers.parking.open(&self.model, known);
        if let Some(token) = self.ticket.as_ref().map(|ticket| ticket.token) {
            self.slice(move |core, _| {
                core.offer(token);
                Ok(())
            })
            .await?;
        }
        let resumes = self.account.stats().resumes;
        let result = self.handle(frame).await;
        if wanted.is_some() {
            let is_resumed = self.account.stats().resumes > resumes;
            let outcome = if is_resumed { Resumption::Resumed } else { Resumption::Refused };
            self.account.metrics().note_resumption(outcome);
            if let Some(ticket) = self.ticket.as_ref().filter(|_| !is_resumed) {
                // That token was for a session that is no more.
                ticket.confirm();
            }
        }
        result
    }

    /// Takes up the session of `token`; whether there is one.
    async fn claim(&mut self, token: Token) -> bool {
        let kept = match self.workers.parking.claim(token, &self.model, Instant::now()) {
            Claim::Unknown => None,
            Claim::Parked(kept) => Some(kept),
            Claim::Open(session) => tokio::time::timeout(TAKEOVER_LIMIT, session).await.ok().and_then(Result::ok),
        };
        let Some(Kept { core, started, account }) = kept else { return false };
        (self.core, self.started, self.account) = (Some(core), started, account);
        true
    }

    async fn handle(&mut self, frame: Vec<u8>) -> Result<(), SessionEnd> {
        self.account.metrics().note_received(frame.len());
        self.slice(move |core, now| core.handle_frame(now, &frame)).await?;
        self.wants_transmit = true;
        Ok(())
    }

    async fn handle_pages(&mut self) -> Result<(), SessionEnd> {
        self.slice(|core, _| core.handle_pages()).await?;
        self.wants_transmit = true;
        Ok(())
    }

    async fn transmit(&mut self, room: mpsc::Permit<'_, Vec<u8>>) -> Result<(), SessionEnd> {
        match self.slice(|core, now| core.poll_transmit(now)).await? {
            Some(frame) => {
                if let Some(time) = self.view_time.take() {
                    self.account.metrics().note_view_time(time);
                }
                room.send(frame);
            }
            None => self.wants_transmit = false,
        }
        Ok(())
    }

    /// One call to the core on a compute thread.
    async fn slice<T: Send + 'static>(
        &mut self,
        call: impl FnOnce(&mut dyn Core, Timestamp) -> Result<T, SessionError> + Send + 'static,
    ) -> Result<T, SessionEnd> {
        let mut core = self.core.take().expect("a session runs one slice at a time");
        let (started, handed_in) = (self.started, std::time::Instant::now());
        let done = self
            .workers
            .pool
            .run(move || {
                let began = std::time::Instant::now();
                let result = call(core.as_mut(), Timestamp(started.elapsed()));
                let (timeout, wanted, stats) = (core.poll_timeout(), core.poll_wanted(), core.stats());
                let waited = began.duration_since(handed_in);
                Done { core, result, timeout, wanted, stats, waited, took: began.elapsed() }
            })
            .await
            .map_err(SessionEnd::Lost)?;
        self.core = Some(done.core);
        if let Some(wanted) = done.wanted {
            self.reading.want(wanted);
        }
        self.wake = done.timeout.map(|at| (self.started + at.0).max(Instant::now() + SHORTEST_WAIT));
        self.count(&done.stats, done.waited, done.took);
        Ok(done.result?)
    }

    /// Adds a slice to the metrics.
    fn count(&mut self, stats: &SessionStats, waited: Duration, took: Duration) {
        let metrics = self.account.metrics();
        metrics.note_queue_wait(waited);
        let before = self.account.stats();
        if stats.batches > before.batches {
            metrics.note_batch_time(took);
        }
        if stats.views > before.views {
            self.view_time = Some(Duration::ZERO);
        }
        if let Some(time) = &mut self.view_time {
            *time += took;
        }
        let is_news = stats.is_confirmed && !before.is_confirmed;
        self.account.update(*stats);
        if let Some(ticket) = self.ticket.as_ref().filter(|_| is_news) {
            ticket.confirm();
        }
        // Those with nothing to do wait for this and rest.
        let _ = self.workers.memory.is_short(self.account.metrics().session_bytes());
    }

    /// Keeps the core for the connection after this one, if the client may come back.
    async fn finish(self, end: SessionEnd) -> SessionReport {
        let Self { core, ticket, started, mut account, workers, .. } = self;
        let Some(mut core) = core else { return SessionReport { end, stats: None, is_kept: false } };
        let may_return = ticket.is_some() && end.is_broken_connection();
        let done = workers.pool.run(move || {
            let is_worth_keeping = may_return && core.park();
            let stats = core.stats();
            (core, is_worth_keeping, stats)
        });
        let Ok((core, is_worth_keeping, stats)) = done.await else {
            return SessionReport { end, stats: None, is_kept: false };
        };
        let is_kept = match ticket.filter(|_| is_worth_keeping) {
            Some(ticket) => {
                account.update(stats);
                ticket.park(Kept { core, started, account }, Instant::now())
            }
            None => false,
        };
        SessionReport { end, stats: Some(stats), is_kept }
    }
}

/// Never, without a ticket.
async fn taken_over(ticket: Option<&Ticket>) {
    match ticket {
        Some(ticket) => ticket.taken_over().await,
        None => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runtime::{PageReader, Pool};
    use std::num::NonZeroUsize;

    /// A view that takes long slices without end, and counts them.
    #[derive(Default)]
    struct Huge(std::sync::Arc<std::sync::atomic::AtomicU64>);

    impl Core for Huge {
        fn handle_frame(&mut self, _: Timestamp, _: &[u8]) -> Result<(), SessionError> {
            Ok(())
        }

        fn poll_transmit(&mut self, _: Timestamp) -> Result<Option<Vec<u8>>, SessionError> {
            let end = std::time::Instant::now() + Duration::from_millis(2);
            while std::time::Instant::now() < end {}
            self.0.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
            Ok(Some(vec![0]))
        }
    }

    #[tokio::test]
    async fn many_small_sessions_are_served_between_the_slices_of_a_huge_one() {
        let workers =
            std::sync::Arc::new(Workers { pool: Pool::new(NonZeroUsize::MIN, 64).unwrap(), ..some_workers() });
        let begin = |core: Box<dyn Core>| {
            let workers = std::sync::Arc::clone(&workers);
            let (frames, inbound) = mpsc::channel(4);
            let (outbound, answers) = mpsc::channel(2);
            tokio::spawn(async move {
                drive(core, "echo", &workers, Duration::from_secs(20), inbound, outbound, std::future::pending()).await
            });
            (frames, answers)
        };
        let slices = std::sync::Arc::new(std::sync::atomic::AtomicU64::new(0));
        let (huge, mut huge_answers) = begin(Box::new(Huge(slices.clone())));
        huge.send(vec![0]).await.unwrap();
        tokio::spawn(async move { while huge_answers.recv().await.is_some() {} });
        let mut small: Vec<_> = (0..20).map(|_| begin(Box::<Echo>::default())).collect();
        for round in 0..5 {
            let before = slices.load(std::sync::atomic::Ordering::Relaxed);
            for (frames, _) in &small {
                frames.send(vec![1]).await.unwrap();
            }
            for (_, answers) in &mut small {
                assert_eq!(answers.recv().await.unwrap(), [0], "round {round}");
            }
            // A frame takes two slices, before each of which the huge one has a turn; and one may have begun before.
            let turns = slices.load(std::sync::atomic::Ordering::Relaxed) - before;
            assert!(turns <= 2 * 20 + 8, "{turns} slices of the huge session before all others had their answer");
            for (_, answers) in &mut small {
                assert_eq!(answers.recv().await.unwrap(), [99], "round {round}");
            }
        }
        assert!(slices.load(std::sync::atomic::Ordering::Relaxed) > 5, "the huge session goes on too");
        let waits = workers.metrics.render(Default::default());
        assert!(
            waits.lines().any(|line| line.starts_with("lodestream_queue_wait_seconds_count ") && !line.ends_with(" 0"))
        );
        drop(huge);
    }

    /// Answers each frame with as many frames as its first byte says, and wakes itself once 50 ms after a frame.
    #[derive(Default)]
    struct Echo {
        due: u8,
        wake: Option<Timestamp>,
        sent: u64,
    }

    impl Core for Echo {
        fn handle_frame(&mut self, now: Timestamp, frame: &[u8]) -> Result<(), SessionError> {
            match frame.first() {
                Some(255) => panic!("expected in this test"),
                Some(254) => Err(SessionError::Peer("no such message".into(), CloseCode::Malformed)),
                first => {
                    self.due += first.copied().unwrap_or(0);
                    self.wake = Some(now + Duration::from_millis(50));
                    Ok(())
                }
            }
        }

        fn poll_transmit(&mut self, now: Timestamp) -> Result<Option<Vec<u8>>, SessionError> {
            if self.due == 0 {
                return Ok(self.wake.take_if(|wake| *wake <= now).map(|_| vec![99]));
            }
            self.due -= 1;
            self.sent += 1;
            Ok(Some(vec![self.due]))
        }

        fn poll_timeout(&self) -> Option<Timestamp> {
            self.wake
        }

        fn stats(&self) -> SessionStats {
            SessionStats { batches: self.sent, ..SessionStats::default() }
        }
    }

    struct Session {
        frames: mpsc::Sender<Vec<u8>>,
        answers: mpsc::Receiver<Vec<u8>>,
        report: tokio::task::JoinHandle<SessionReport>,
        workers: std::sync::Arc<Workers>,
    }

    fn workers() -> std::sync::Arc<Workers> {
        std::sync::Arc::new(some_workers())
    }

    fn some_workers() -> Workers {
        let threads = NonZeroUsize::MIN;
        let (pool, reader) = (Pool::new(threads, 4).unwrap(), PageReader::new(threads).unwrap());
        let metrics: Arc<crate::runtime::Metrics> = Default::default();
        let parking = crate::runtime::Parking::new(Duration::ZERO, 0, Arc::clone(&metrics));
        Workers { pool, reader, metrics, memory: crate::runtime::Memory::new(1000), parking }
    }

    fn start(hello_timeout: Duration, interrupted: impl Future<Output = SessionEnd> + Send + 'static) -> Session {
        let workers = workers();
        let (frames, inbound) = mpsc::channel(4);
        let (outbound, answers) = mpsc::channel(1);
        let report = tokio::spawn({
            let workers = std::sync::Arc::clone(&workers);
            async move {
                drive(Box::new(Echo::default()), "echo", &workers, hello_timeout, inbound, outbound, interrupted).await
            }
        });
        Session { frames, answers, report, workers }
    }

    #[tokio::test]
    async fn frames_are_answered_and_timers_kept() {
        let mut session = start(Duration::from_secs(10), std::future::pending());
        session.frames.send(vec![2]).await.unwrap();
        for expected in [1, 0, 99] {
            assert_eq!(session.answers.recv().await.unwrap(), [expected]);
        }
        drop(session.frames);
        let report = session.report.await.unwrap();
        assert!(matches!(report.end, SessionEnd::PeerGone));
        assert_eq!(report.stats.unwrap().batches, 2);
    }

    #[tokio::test]
    async fn a_client_that_does_not_read_stops_the_work() {
        let mut session = start(Duration::from_secs(10), std::future::pending());
        session.frames.send(vec![200]).await.unwrap();
        assert!(session.answers.recv().await.is_some());
        for _ in 0..50 {
            session.workers.pool.run(tokio::task::yield_now).await.unwrap().await;
        }
        drop(session.frames);
        let report = session.report.await.unwrap();
        assert_eq!(report.stats.unwrap().batches, 2, "one read, one in the channel, none beyond");
    }

    #[tokio::test]
    async fn silence_errors_and_panics_end_the_session_with_their_codes() {
        let code = async |frame: Option<u8>| {
            let session = start(Duration::from_millis(20), std::future::pending());
            if let Some(byte) = frame {
                session.frames.send(vec![byte]).await.unwrap();
            }
            let report = session.report.await.unwrap();
            (report.end.code(), report.end.to_string(), session.workers.pool.panics())
        };
        assert_eq!(code(None).await, (CloseCode::Timeout, "no hello within 20ms".into(), 0));
        assert_eq!(code(Some(254)).await, (CloseCode::Malformed, "no such message".into(), 0));
        assert_eq!(code(Some(255)).await, (CloseCode::Internal, "internal error".into(), 1));
    }

    #[tokio::test]
    async fn an_interruption_ends_the_session() {
        let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
        let mut session = start(Duration::from_secs(10), async {
            let _ = stopped.await;
            SessionEnd::ShuttingDown
        });
        session.frames.send(vec![1]).await.unwrap();
        assert!(session.answers.recv().await.is_some());
        stop.send(()).unwrap();
        assert_eq!(session.report.await.unwrap().end.code(), CloseCode::GoingAway);
    }
}
