//! When a client's next view is due.

use std::str::FromStr;
use std::time::Duration;

use super::path::Path;

/// From the last view of a recording to its first, when it is played again: a round is never empty.
const REST: Duration = Duration::from_millis(33);

/// What decides when a client's next view is due.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pace {
    /// So many a second, above 0.
    PerSecond(f64),
    /// When the view before it has settled.
    Settled,
    /// The recording's times.
    Recorded,
}

/// Why a flag's value makes no sense.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{0}' is no rate of views: write a number from 0.001 to 1000 (per second) or 'settled'")]
pub struct PaceError(String);

impl FromStr for Pace {
    type Err = PaceError;

    /// `settled`, or views per second.
    fn from_str(text: &str) -> Result<Self, PaceError> {
        if text == "settled" {
            return Ok(Self::Settled);
        }
        let rate = text.parse().ok().filter(|rate| (0.001..=1000.0).contains(rate));
        rate.map(Self::PerSecond).ok_or_else(|| PaceError(text.into()))
    }
}

impl Pace {
    /// The step that time has reached, counted on over repetitions of the path; `None` if time does not decide.
    pub(super) fn step_at(self, path: &Path, elapsed: Duration) -> Option<u64> {
        match (self, path) {
            (Self::PerSecond(rate), _) => Some((elapsed.as_secs_f64() * rate) as u64),
            (Self::Recorded, Path::Recorded(recording)) => {
                let views = recording.views();
                let round = recording.duration() + REST;
                let rounds = (elapsed.as_nanos() / round.as_nanos()) as u64;
                let within = Duration::from_nanos((elapsed.as_nanos() % round.as_nanos()) as u64);
                let passed = views.partition_point(|view| view.time() <= within) as u64;
                Some((rounds * views.len() as u64 + passed).saturating_sub(1))
            }
            _ => None,
        }
    }

    /// When a step is due: [`step_at`](Self::step_at) has reached it then, and not much before.
    pub(super) fn time_of(self, path: &Path, step: u64) -> Option<Duration> {
        let time = match (self, path) {
            (Self::PerSecond(rate), _) => Duration::from_secs_f64(step as f64 / rate),
            (Self::Recorded, Path::Recorded(recording)) => {
                let views = recording.views();
                let count = views.len() as u64;
                let rounds = u32::try_from(step / count).unwrap_or(u32::MAX);
                let start = (recording.duration() + REST).saturating_mul(rounds);
                start.saturating_add(views[(step % count) as usize].time())
            }
            _ => return None,
        };
        // Rounding must not make it a little too early: a client would wake again and again.
        Some(time + Duration::from_micros(1))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::camera::recording::Recording;

    #[test]
    fn paces_parse() {
        assert_eq!("settled".parse(), Ok(Pace::Settled));
        assert_eq!("0.5".parse(), Ok(Pace::PerSecond(0.5)));
        for text in ["", "0", "-1", "nan", "inf", "2000", "recorded", "10/s"] {
            assert_eq!(text.parse::<Pace>(), Err(PaceError(text.into())), "{text}");
        }
    }

    fn recorded(times: &[f64]) -> Path {
        let view = |time: &f64| format!("{{\"time\":{time},\"eye\":[1,2,3],\"target\":[0,0,0],\"fov\":45}}\n");
        let text: String = times.iter().map(view).collect();
        Path::Recorded(Arc::new(Recording::read(format!("{{\"lodestream_path\":1}}\n{text}").as_bytes()).unwrap()))
    }

    #[test]
    fn a_step_is_reached_when_it_is_due_and_not_before() {
        let short = Duration::from_micros(3);
        let check = |pace: Pace, path: &Path| {
            for step in 1..2000 {
                let time = pace.time_of(path, step).unwrap();
                assert_eq!(pace.step_at(path, time), Some(step), "{pace:?}");
                assert_eq!(pace.step_at(path, time - short), Some(step - 1), "{pace:?}");
            }
        };
        for rate in [0.5, 7.0, 10.0, 333.3] {
            check(Pace::PerSecond(rate), &Path::Orbit);
        }
        check(Pace::Recorded, &recorded(&[0.0, 0.1, 0.3, 0.35, 1.0 / 3.0 + 1.0]));
        check(Pace::Recorded, &recorded(&[0.0]));
        assert_eq!(Pace::Settled.step_at(&Path::Orbit, short), None);
        assert_eq!(Pace::Settled.time_of(&Path::Orbit, 1), None);
    }

    #[test]
    fn views_at_one_time_are_skipped_but_for_the_last() {
        let path = recorded(&[0.0, 0.5, 0.5, 0.5, 0.7]);
        let at = |ms: u64| Pace::Recorded.step_at(&path, Duration::from_millis(ms)).unwrap();
        assert_eq!([at(0), at(499), at(500), at(699), at(700), at(732), at(733)], [0, 0, 3, 3, 4, 4, 5]);
    }
}
