//! The main connection as the driver sees it, and what its ends mean. When to try again, what is kept meanwhile and how the
//! session goes on is the session's to say ([`ClientSession::handle_loss`]); here is what it cannot know.

use std::time::Duration;

use lodestream_protocol::message::CloseCode;
use lodestream_protocol::time::Timestamp;

use crate::core::{ClientConfig, ClientSession, Connectivity};

/// How long an attempt may take.
const OPEN_TIMEOUT: Duration = Duration::from_secs(15);
/// Faults with no good connection in between after which there is no point in trying again.
const MAX_FAULTS: u32 = 4;
/// Letters of a fault that people are shown.
const MAX_REASON: usize = 200;

/// Why a connection ended, or there was none.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Ending {
    /// No server answers, or the connection broke.
    Lost,
    /// The server does not have the model.
    NoSuchModel,
    /// All places are taken.
    Full,
    /// The server will not stream this model, and says why.
    Refused(String),
    /// The server ended the stream with a code, see [`CloseCode`].
    Closed {
        /// The number of the close frame.
        code: u16,
        /// What the server says about it.
        reason: String,
    },
}

/// What a person is told besides that there is no connection.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Trouble {
    /// The model is not there; it is asked for from time to time.
    Gone,
    /// The server is full, likewise.
    Full,
    /// No use to try again.
    Failed { reason: String },
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Phase {
    Closed,
    Opening { since: Timestamp },
    Open,
}

/// The connection, without the connection.
#[derive(Clone, Debug)]
pub(super) struct Line {
    phase: Phase,
    trouble: Option<Trouble>,
    faults: u32,
    /// A setting wants another connection: no reason to wait.
    is_urgent: bool,
}

impl Line {
    /// Closed, and to be opened at once.
    pub(super) fn new() -> Self {
        Self { phase: Phase::Closed, trouble: None, faults: 0, is_urgent: false }
    }

    pub(super) fn is_open(&self) -> bool {
        matches!(self.phase, Phase::Open)
    }

    pub(super) fn trouble(&self) -> Option<&Trouble> {
        self.trouble.as_ref()
    }

    /// When it is to be opened, unless it is already or never again.
    fn due(&self, session: &ClientSession) -> Option<Timestamp> {
        let is_idle = self.phase == Phase::Closed && !matches!(self.trouble, Some(Trouble::Failed { .. }));
        is_idle.then(|| match session.connectivity() {
            Connectivity::Reconnecting { next_try, .. } if !self.is_urgent => next_try,
            _ => Timestamp::default(),
        })
    }

    /// Whether it should be opened now; it counts as being opened then.
    pub(super) fn poll_open(&mut self, now: Timestamp, session: &mut ClientSession) -> bool {
        if let Phase::Opening { since } = self.phase
            && now.since(since) > OPEN_TIMEOUT
        {
            self.phase = Phase::Closed;
            session.handle_loss(now);
        }
        let is_due = self.due(session).is_some_and(|due| due <= now);
        if is_due {
            self.phase = Phase::Opening { since: now };
            self.is_urgent = false;
        }
        is_due
    }

    /// When [`poll_open`](Self::poll_open) has something to say.
    pub(super) fn poll_timeout(&self, session: &ClientSession) -> Option<Timestamp> {
        match self.phase {
            Phase::Opening { since } => Some(since + OPEN_TIMEOUT + Duration::from_millis(1)),
            Phase::Closed | Phase::Open => self.due(session),
        }
    }

    /// It is open.
    pub(super) fn handle_open(&mut self) {
        self.phase = Phase::Open;
    }

    /// It brought something that made sense.
    pub(super) fn note_frame(&mut self) {
        self.trouble = None;
    }

    /// It is over, or never was.
    pub(super) fn handle_end(&mut self, now: Timestamp, ending: &Ending, session: &mut ClientSession) {
        if self.phase == Phase::Closed {
            return;
        }
        let code = match ending {
            Ending::Closed { code, .. } => CloseCode::from_number(*code),
            Ending::Lost | Ending::NoSuchModel | Ending::Full | Ending::Refused(_) => None,
        };
        let failed = |reason: &str| Some(Trouble::Failed { reason: reason.into() });
        self.trouble = match (ending, code) {
            (Ending::NoSuchModel, _) => Some(Trouble::Gone),
            (Ending::Full, _) | (_, Some(CloseCode::Full)) => Some(Trouble::Full),
            (Ending::Refused(reason), _) => failed(reason),
            (_, Some(CloseCode::Version)) => {
                failed("the server has another version: reload the page or update the program")
            }
            (_, Some(CloseCode::ModelDamaged)) => failed("the model's file is damaged"),
            (
                Ending::Closed { reason, .. },
                Some(CloseCode::Malformed | CloseCode::LimitTooSmall | CloseCode::Internal),
            ) => return self.note_fault(now, reason, session),
            _ => None,
        };
        self.close(now, session);
        session.handle_loss(now);
    }

    /// One end made no sense to the other. A few times this may be a server being replaced. The session begins anew.
    pub(super) fn note_fault(&mut self, now: Timestamp, reason: &str, session: &mut ClientSession) {
        self.close(now, session);
        session.begin_anew(now);
        self.faults += 1;
        let is_last = self.faults >= MAX_FAULTS;
        self.trouble = is_last.then(|| Trouble::Failed { reason: reason.chars().take(MAX_REASON).collect() });
    }

    /// Opens anew without waiting: the first message is to say something else.
    pub(super) fn restart(&mut self, now: Timestamp, config: ClientConfig, session: &mut ClientSession) {
        session.reconfigure(config);
        // A session that has said nothing loses nothing.
        if self.phase != Phase::Closed || session.model().is_some() {
            session.handle_loss(now);
        }
        (self.phase, self.trouble, self.is_urgent) = (Phase::Closed, None, true);
    }

    fn close(&mut self, now: Timestamp, session: &ClientSession) {
        if session.has_lasted(now) {
            self.faults = 0;
        }
        self.phase = Phase::Closed;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Timestamp {
        Timestamp(Duration::from_millis(ms))
    }

    fn opening() -> (Line, ClientSession) {
        let (mut line, mut session) = (Line::new(), ClientSession::new(ClientConfig::default()));
        assert!(line.poll_open(at(0), &mut session) && !line.poll_open(at(1), &mut session));
        (line, session)
    }

    #[test]
    fn the_session_says_when_to_try_again() {
        let (mut line, mut session) = opening();
        line.handle_end(at(10), &Ending::Lost, &mut session);
        let Connectivity::Reconnecting { attempt: 1, next_try } = session.connectivity() else { panic!("it is lost") };
        assert_eq!(line.poll_timeout(&session), Some(next_try));
        assert!(!line.poll_open(at(11), &mut session) && line.poll_open(next_try, &mut session));
        // An end that is told twice is one.
        line.handle_end(at(2000), &Ending::Lost, &mut session);
        line.handle_end(at(2000), &Ending::Lost, &mut session);
        assert!(matches!(session.connectivity(), Connectivity::Reconnecting { attempt: 2, .. }));
        // A setting does not wait.
        line.restart(at(2001), ClientConfig::default(), &mut session);
        assert!(line.poll_open(at(2001), &mut session));
    }

    #[test]
    fn an_attempt_that_never_ends_is_given_up() {
        let (mut line, mut session) = opening();
        assert!(!line.poll_open(at(15_001), &mut session));
        let until = line.poll_timeout(&session).unwrap();
        assert!(until > at(15_001) && line.poll_open(until, &mut session));
    }

    #[test]
    fn each_ending_has_its_answer() {
        let end = |ending: Ending| {
            let (mut line, mut session) = opening();
            line.handle_open();
            line.handle_end(at(2), &ending, &mut session);
            let tries_again = line.poll_timeout(&session).is_some();
            (line.trouble, tries_again)
        };
        let closed = |code: CloseCode| Ending::Closed { code: code as u16, reason: "because".into() };
        assert_eq!(end(Ending::NoSuchModel), (Some(Trouble::Gone), true));
        assert_eq!(end(Ending::Full), (Some(Trouble::Full), true));
        assert_eq!(end(closed(CloseCode::Full)), (Some(Trouble::Full), true));
        assert_eq!(end(closed(CloseCode::GoingAway)), (None, true));
        assert_eq!(end(closed(CloseCode::Timeout)), (None, true));
        assert_eq!(end(closed(CloseCode::Malformed)), (None, true));
        assert!(matches!(end(closed(CloseCode::Version)), (Some(Trouble::Failed { .. }), false)));
        assert!(matches!(end(Ending::Refused("no".into())), (Some(Trouble::Failed { .. }), false)));
        let (mut line, mut session) = opening();
        (0..MAX_FAULTS).for_each(|_| line.note_fault(at(5), "nonsense", &mut session));
        assert_eq!(line.trouble, Some(Trouble::Failed { reason: "nonsense".into() }));
    }
}
