//! What becomes of a session whose connection breaks: how it stands, and when to try again.

use std::time::Duration;

use lodestream_protocol::time::Timestamp;

/// Longest wait before the first try; each later one may be twice as long.
const FIRST_WAIT: Duration = Duration::from_millis(250);
/// Longest wait of all.
const LONGEST_WAIT: Duration = Duration::from_secs(15);
/// A connection on which the server answered and that lasted so long was a good one: the waits begin anew after it. A server that
/// greets and fails at once would otherwise be asked again without end, and by all of its clients.
pub const GOOD_CONNECTION: Duration = Duration::from_secs(5);

/// How a session stands with its server.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Connectivity {
    /// The first connection is being made, or has brought nothing yet.
    #[default]
    Connecting,
    /// The server answers; the session is as it began.
    Connected,
    /// The connection broke.
    Reconnecting {
        /// Tries since a good connection broke, from 1.
        attempt: u32,
        /// When this one is due.
        next_try: Timestamp,
    },
    /// The server answers again, and the session goes on where it was.
    Resumed,
    /// The server answers again but has nothing left of the session: it comes anew, and until it is as good the mesh from before is
    /// shown.
    Restarting,
}

/// When to try again: waits that double, each between half of its length and all of it, so that the clients of a server that was
/// away do not come back at once.
#[derive(Clone, Debug)]
pub(super) struct Backoff {
    rng: fastrand::Rng,
    attempts: u32,
}

impl Backoff {
    pub(super) fn new(seed: u64) -> Self {
        Self { rng: fastrand::Rng::with_seed(seed), attempts: 0 }
    }

    /// A try has failed, or the connection broke.
    pub(super) fn next(&mut self, now: Timestamp) -> Connectivity {
        let longest = FIRST_WAIT.saturating_mul(1 << self.attempts.min(16)).min(LONGEST_WAIT);
        self.attempts = self.attempts.saturating_add(1);
        let wait = longest.mul_f64(0.5 + 0.5 * self.rng.f64());
        Connectivity::Reconnecting { attempt: self.attempts, next_try: now + wait }
    }

    /// What broke was a good connection.
    pub(super) fn restart(&mut self) {
        self.attempts = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_double_with_jitter_up_to_the_longest() {
        let waits = |seed: u64, count: usize| {
            let mut backoff = Backoff::new(seed);
            let wait = |attempt: usize| match backoff.next(Timestamp::default()) {
                Connectivity::Reconnecting { attempt: number, next_try } => {
                    assert_eq!(number as usize, attempt + 1);
                    next_try.0
                }
                other => panic!("{other:?}"),
            };
            (0..count).map(wait).collect::<Vec<_>>()
        };
        let first = waits(1, 100);
        for (attempt, wait) in first.iter().enumerate() {
            let longest = (FIRST_WAIT * 2u32.pow(attempt.min(10) as u32)).min(LONGEST_WAIT);
            assert!((longest / 2..=longest).contains(wait), "{attempt}: {wait:?}");
        }
        assert_eq!(first, waits(1, 100), "a seed stands for its waits");
        assert_ne!(first, waits(2, 100), "clients do not move in step");
        let mut backoff = Backoff::new(1);
        (0..5).for_each(|_| _ = backoff.next(Timestamp::default()));
        backoff.restart();
        assert!(matches!(backoff.next(Timestamp::default()), Connectivity::Reconnecting { attempt: 1, .. }));
    }
}
