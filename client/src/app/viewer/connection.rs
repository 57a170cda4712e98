//! When to connect: the life of one connection, without the connection.

use std::time::Duration;

use lodestream_protocol::message::CloseCode;
use lodestream_protocol::time::Timestamp;

/// Wait before the first, the second... attempt in a row.
const FIRST_WAIT: Duration = Duration::from_millis(300);
const LONGEST_WAIT: Duration = Duration::from_secs(8);
/// Wait while the server is full.
const FULL_WAIT: Duration = Duration::from_secs(5);
/// How long an attempt may take.
const OPEN_TIMEOUT: Duration = Duration::from_secs(15);
/// A connection that brought a mesh and lasted so long was a good one.
const GOOD: Duration = Duration::from_secs(5);
/// Ends of one kind in a row after which there is no point in trying again.
const MAX_FAULTS: u32 = 4;

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

/// What to do about a connection.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Phase {
    /// Wait, then try.
    Waiting { until: Timestamp },
    /// Being opened.
    Opening { since: Timestamp },
    /// Open.
    Open { since: Timestamp },
    /// The model is not there: ask again from time to time.
    Gone { until: Timestamp },
    /// The server is full, likewise.
    Full { until: Timestamp },
    /// No use.
    Failed { reason: String },
}

/// One connection's life.
#[derive(Clone, Debug)]
pub(super) struct Connection {
    pub(super) phase: Phase,
    attempts: u32,
    faults: u32,
    rng: fastrand::Rng,
}

impl Connection {
    /// Begins at once. The seed spreads the attempts of many clients after a restart.
    pub(super) fn new(now: Timestamp, seed: u64) -> Self {
        let rng = fastrand::Rng::with_seed(seed);
        Self { phase: Phase::Waiting { until: now }, attempts: 0, faults: 0, rng }
    }

    /// Whether it should be opened now; it counts as being opened then.
    pub(super) fn poll_open(&mut self, now: Timestamp) -> bool {
        if let Phase::Opening { since } = self.phase
            && now.since(since) > OPEN_TIMEOUT
        {
            self.wait(now);
        }
        let (Phase::Waiting { until } | Phase::Gone { until } | Phase::Full { until }) = self.phase else {
            return false;
        };
        if now < until {
            return false;
        }
        self.phase = Phase::Opening { since: now };
        true
    }

    /// When [`poll_open`](Self::poll_open) has something to say.
    pub(super) fn poll_timeout(&self) -> Option<Timestamp> {
        match self.phase {
            Phase::Waiting { until } | Phase::Gone { until } | Phase::Full { until } => Some(until),
            Phase::Opening { since } => Some(since + OPEN_TIMEOUT + Duration::from_millis(1)),
            Phase::Open { .. } | Phase::Failed { .. } => None,
        }
    }

    /// It is open.
    pub(super) fn handle_open(&mut self, now: Timestamp) {
        self.phase = Phase::Open { since: now };
    }

    /// It is over, or never was.
    pub(super) fn handle_end(&mut self, now: Timestamp, ending: &Ending, had_mesh: bool) {
        if let Phase::Open { since } = self.phase
            && had_mesh
            && now.since(since) > GOOD
        {
            (self.attempts, self.faults) = (0, 0);
        }
        let code = match ending {
            Ending::Closed { code, .. } => CloseCode::from_number(*code),
            Ending::Lost | Ending::NoSuchModel | Ending::Full | Ending::Refused(_) => None,
        };
        match (ending, code) {
            (Ending::NoSuchModel, _) => self.phase = Phase::Gone { until: now + FULL_WAIT },
            (Ending::Full, _) | (_, Some(CloseCode::Full)) => self.phase = Phase::Full { until: now + FULL_WAIT },
            (Ending::Refused(reason), _) => self.phase = Phase::Failed { reason: reason.clone() },
            (_, Some(CloseCode::Version)) => {
                let reason = "the server has another version: reload the page or update the program".into();
                self.phase = Phase::Failed { reason };
            }
            (_, Some(CloseCode::ModelDamaged)) => {
                self.phase = Phase::Failed { reason: "the model's file is damaged".into() };
            }
            (
                Ending::Closed { reason, .. },
                Some(CloseCode::Malformed | CloseCode::LimitTooSmall | CloseCode::Internal),
            ) => {
                self.note_fault(now, reason);
            }
            _ => self.wait(now),
        }
    }

    /// What came made no sense. A few times this may be a server being replaced.
    pub(super) fn note_fault(&mut self, now: Timestamp, reason: &str) {
        self.faults += 1;
        if self.faults < MAX_FAULTS {
            return self.wait(now);
        }
        self.phase = Phase::Failed { reason: reason.chars().take(200).collect() };
    }

    /// Opens anew without waiting: a setting wants another connection.
    pub(super) fn restart(&mut self, now: Timestamp) {
        self.phase = Phase::Waiting { until: now };
    }

    fn wait(&mut self, now: Timestamp) {
        let wait = FIRST_WAIT * 2u32.saturating_pow(self.attempts.min(10));
        self.attempts += 1;
        // Half to all of it, so that a thousand clients do not come back in one moment.
        let wait = wait.min(LONGEST_WAIT).mul_f64(0.5 + 0.5 * self.rng.f64());
        self.phase = Phase::Waiting { until: now + wait };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Timestamp {
        Timestamp(Duration::from_millis(ms))
    }

    #[test]
    fn attempts_become_rarer_until_one_goes_well() {
        let mut connection = Connection::new(at(0), 7);
        assert!(connection.poll_open(at(0)) && !connection.poll_open(at(1)));
        let mut now = 10;
        let mut waits = Vec::new();
        for _ in 0..8 {
            connection.handle_end(at(now), &Ending::Lost, false);
            let until = connection.poll_timeout().unwrap();
            waits.push(until.since(at(now)).as_millis());
            assert!(!connection.poll_open(at(now)));
            now = until.0.as_millis() as u64 + 1;
            assert!(connection.poll_open(at(now)));
        }
        assert!((150..=300).contains(&waits[0]) && waits[7] >= 4000 && waits[7] <= 8000, "{waits:?}");
        connection.handle_open(at(now));
        connection.handle_end(at(now + 60_000), &Ending::Lost, true);
        assert!(connection.poll_timeout().unwrap().since(at(now + 60_000)) <= FIRST_WAIT, "forgiven");
    }

    #[test]
    fn an_attempt_that_never_ends_is_given_up() {
        let mut connection = Connection::new(at(0), 7);
        assert!(connection.poll_open(at(0)));
        assert!(!connection.poll_open(at(15_001)));
        let until = connection.poll_timeout().unwrap();
        assert!(connection.poll_open(until));
    }

    #[test]
    fn each_ending_has_its_answer() {
        let end = |ending: Ending| {
            let mut connection = Connection::new(at(0), 1);
            connection.poll_open(at(0));
            connection.handle_open(at(1));
            connection.handle_end(at(2), &ending, false);
            connection.phase
        };
        let closed = |code: CloseCode| Ending::Closed { code: code as u16, reason: "because".into() };
        assert!(matches!(end(Ending::NoSuchModel), Phase::Gone { .. }));
        assert!(matches!(end(Ending::Full), Phase::Full { .. }));
        assert!(matches!(end(closed(CloseCode::Full)), Phase::Full { .. }));
        assert!(matches!(end(closed(CloseCode::GoingAway)), Phase::Waiting { .. }));
        assert!(matches!(end(closed(CloseCode::Timeout)), Phase::Waiting { .. }));
        assert!(matches!(end(closed(CloseCode::Malformed)), Phase::Waiting { .. }));
        assert!(matches!(end(closed(CloseCode::Version)), Phase::Failed { .. }));
        assert!(matches!(end(Ending::Refused("no".into())), Phase::Failed { .. }));
        let mut connection = Connection::new(at(0), 1);
        (0..MAX_FAULTS).for_each(|_| connection.note_fault(at(5), "nonsense"));
        assert_eq!(connection.phase, Phase::Failed { reason: "nonsense".into() });
    }
}
