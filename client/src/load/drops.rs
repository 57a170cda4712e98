//! When connections break: at random moments that a seed gives, without a goodbye, as in a tunnel.

use std::str::FromStr;
use std::time::Duration;

use fastrand::Rng;
use lodestream_protocol::time::Timestamp;

use crate::net::link::parse_duration;

/// Whose connections break, and how often.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Drops {
    /// This share of the clients, above 0 to 1, each once, anywhere in its run.
    Share(f64),
    /// All, again and again, this long after a connection was made on average (exponentially distributed).
    Every(Duration),
}

/// Why a flag's value makes no sense.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "'{0}' names no broken connections: write the share of clients that lose theirs once, such as 0.2, or how often each does, such as 1/10s"
)]
pub struct DropsError(String);

impl FromStr for Drops {
    type Err = DropsError;

    /// A share above 0, up to 1, or a number of times in a time, such as `1/10s` or `2.5/60s`.
    fn from_str(text: &str) -> Result<Self, DropsError> {
        let number = |text: &str| text.parse().ok().filter(|&number: &f64| number > 0.0 && number <= 1e6);
        let parsed = match text.split_once('/') {
            None => number(text).filter(|&share| share <= 1.0).map(Self::Share),
            Some((times, time)) => number(times)
                .zip(parse_duration(time).ok())
                .map(|(times, time)| time.div_f64(times))
                .filter(|mean| !mean.is_zero())
                .map(Self::Every),
        };
        parsed.ok_or_else(|| DropsError(text.into()))
    }
}

/// When one client's next connection breaks.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Next {
    At(Timestamp),
    /// When this share of the run is over.
    Part(f64),
}

/// When the connections of one client break: a function of its seed and of when they were made.
#[derive(Debug)]
pub(super) struct Schedule {
    rng: Rng,
    /// `None` for one that loses at most one.
    mean: Option<Duration>,
    next: Option<Next>,
}

impl Schedule {
    pub(super) fn new(drops: Option<Drops>, seed: u64) -> Self {
        let mut rng = Rng::with_seed(seed ^ 0xd20b_ed11);
        let (mean, next) = match drops {
            None => (None, None),
            Some(Drops::Share(share)) => {
                // Both are drawn in any case: who is hit with a small share is hit with a larger one at the same moment.
                let (is_hit, part) = (rng.f64() < share, rng.f64());
                (None, is_hit.then_some(Next::Part(part)))
            }
            Some(Drops::Every(mean)) => (Some(mean), None),
        };
        Self { rng, mean, next }
    }

    /// A connection was made.
    pub(super) fn connected(&mut self, now: Timestamp) {
        if let Some(mean) = self.mean {
            self.next = Some(Next::At(now + mean.mul_f64(-(1.0 - self.rng.f64()).ln())));
        }
    }

    /// When the connection breaks, in a run of this length. `None` if it does not, or if time does not decide that.
    pub(super) fn due_at(&self, duration: Option<Duration>) -> Option<Timestamp> {
        match self.next? {
            Next::At(at) => Some(at),
            Next::Part(part) => duration.map(|duration| Timestamp(duration.mul_f64(part))),
        }
    }

    /// Whether the connection breaks now, this part of the run being over; it does once.
    pub(super) fn take_due(&mut self, now: Timestamp, part_over: f64) -> bool {
        let is_due = |next: &mut Next| match *next {
            Next::At(at) => now >= at,
            Next::Part(part) => part_over >= part,
        };
        self.next.take_if(is_due).is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drops_parse() {
        assert_eq!("0.2".parse(), Ok(Drops::Share(0.2)));
        assert_eq!("1".parse(), Ok(Drops::Share(1.0)));
        assert_eq!("1/10s".parse(), Ok(Drops::Every(Duration::from_secs(10))));
        assert_eq!("2.5/500ms".parse(), Ok(Drops::Every(Duration::from_millis(200))));
        for text in
            ["", "0", "1.5", "-0.1", "nan", "20%", "1/", "/1s", "0/1s", "1/0", "1/s", "1/10", "inf/1s", "1/1s/1s"]
        {
            assert_eq!(text.parse::<Drops>(), Err(DropsError(text.into())), "{text}");
        }
    }

    #[test]
    fn a_share_of_the_clients_is_hit_once_each() {
        let parts = |share: f64| {
            let next = |seed| Schedule::new(Some(Drops::Share(share)), seed).next;
            (0..2000).map(next).collect::<Vec<_>>()
        };
        let (some, more) = (parts(0.2), parts(0.6));
        let hit = some.iter().flatten().count();
        // Binomial: five standard deviations.
        assert!((400 - 90..400 + 90).contains(&hit), "{hit}");
        assert!(some.iter().zip(&more).all(|(some, more)| some.is_none() || some == more));
        assert_eq!(parts(1.0).iter().flatten().count(), 2000);

        let mut schedule = Schedule::new(Some(Drops::Share(1.0)), 3);
        let Some(Next::Part(part)) = schedule.next else { panic!("it is hit") };
        schedule.connected(Timestamp::default());
        let at = schedule.due_at(Some(Duration::from_secs(10))).unwrap();
        assert!((at.0.as_secs_f64() - 10.0 * part).abs() < 1e-6 && schedule.due_at(None).is_none());
        assert!(!schedule.take_due(at, part * 0.99));
        assert!(schedule.take_due(at, part) && !schedule.take_due(at, 1.0), "once");
        schedule.connected(at);
        assert!(schedule.due_at(Some(Duration::from_secs(10))).is_none(), "and not over the next connection");
    }

    #[test]
    fn gaps_have_their_mean_and_are_the_same_for_the_same_seed() {
        let gaps = |seed: u64| {
            let mut schedule = Schedule::new(Some(Drops::Every(Duration::from_secs(2))), seed);
            let mut now = Timestamp::default();
            let mut gap = || {
                schedule.connected(now);
                let at = schedule.due_at(None).unwrap();
                assert!(!schedule.take_due(now, 1.0) || at == now);
                assert!(schedule.take_due(at, 0.0) && schedule.due_at(None).is_none());
                let gap = at.since(now);
                now = at + Duration::from_millis(200);
                gap.as_secs_f64()
            };
            (0..2000).map(|_| gap()).collect::<Vec<_>>()
        };
        let one = gaps(1);
        let mean = one.iter().sum::<f64>() / one.len() as f64;
        // Five standard errors of an exponential mean.
        assert!((mean - 2.0).abs() < 5.0 * 2.0 / 2000f64.sqrt(), "{mean}");
        assert_eq!(one, gaps(1));
        assert_ne!(one, gaps(2));
        assert_eq!(Schedule::new(None, 1).next, None);
    }
}
