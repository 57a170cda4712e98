//! The share of its time in which a client moves: people look for a while at what they have turned to.

use std::str::FromStr;
use std::time::Duration;

/// A client moves at the beginning of each of these and then keeps still.
const PERIOD: Duration = Duration::from_secs(10);

/// Share of the time in motion, above 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Duty(f64);

/// Why a flag's value makes no sense.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{0}' is no share of time: write a number above 0, up to 1")]
pub struct DutyError(String);

impl FromStr for Duty {
    type Err = DutyError;

    fn from_str(text: &str) -> Result<Self, DutyError> {
        let share = text.parse().ok().filter(|&share: &f64| share > 0.0 && share <= 1.0);
        share.map(Self).ok_or_else(|| DutyError(text.into()))
    }
}

impl Duty {
    /// Always in motion.
    pub const ALWAYS: Self = Self(1.0);

    /// The share.
    pub fn share(self) -> f64 {
        self.0
    }

    /// How long a client has moved after `elapsed`, if it began at the place `phase`, from 0 to 1, of a period.
    pub(super) fn moved(self, phase: f64, elapsed: Duration) -> Duration {
        if self == Self::ALWAYS {
            return elapsed;
        }
        let begin = phase * PERIOD.as_secs_f64();
        Duration::from_secs_f64((self.since_start(begin + elapsed.as_secs_f64()) - self.since_start(begin)).max(0.0))
    }

    /// When it has moved so long, or soon after.
    pub(super) fn time_of(self, phase: f64, moved: Duration) -> Duration {
        if self == Self::ALWAYS {
            return moved;
        }
        let period = PERIOD.as_secs_f64();
        let begin = phase * period;
        // What it has moved at the end of a period is reached earlier, but asked for just there rounding could come out below.
        let total = self.since_start(begin) + moved.as_secs_f64();
        let periods = (total / (self.0 * period)).floor();
        let time = periods * period + (total - periods * self.0 * period).max(0.0) - begin;
        Duration::from_secs_f64(time.max(0.0)) + Duration::from_micros(1)
    }

    /// Seconds in motion from the start of a period on.
    fn since_start(self, seconds: f64) -> f64 {
        let period = PERIOD.as_secs_f64();
        let (periods, rest) = ((seconds / period).floor(), seconds % period);
        periods * self.0 * period + rest.min(self.0 * period)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_parse() {
        assert_eq!("0.2".parse(), Ok(Duty(0.2)));
        assert_eq!("1".parse(), Ok(Duty::ALWAYS));
        for text in ["", "0", "-0.1", "1.01", "nan", "20%"] {
            assert_eq!(text.parse::<Duty>(), Err(DutyError(text.into())), "{text}");
        }
    }

    /// Against a walk in steps of a millisecond.
    #[test]
    fn time_in_motion_is_what_a_clock_adds_up() {
        for (duty, phase) in [(0.2, 0.0), (0.2, 0.1), (0.05, 0.7), (0.9, 0.95), (1.0, 0.5)] {
            let share = Duty(duty);
            let mut sum = 0.0;
            for ms in 0..60_000u32 {
                let place = (phase * 10_000.0 + f64::from(ms)) % 10_000.0;
                let moved = share.moved(phase, Duration::from_millis(ms.into())).as_secs_f64();
                assert!((moved - sum).abs() < 2.5e-3, "{duty} {phase} {ms}: {moved}, not {sum}");
                if place < duty * 10_000.0 {
                    sum += 1e-3;
                }
            }
            assert!((sum - 60.0 * duty).abs() < 2.1, "{sum}");
        }
    }

    #[test]
    fn a_time_is_reached_when_it_is_due() {
        for (duty, phase) in [(0.2, 0.0), (0.2, 0.15), (0.05, 0.7), (1.0, 0.3)] {
            let share = Duty(duty);
            let mut last = Duration::ZERO;
            for step in 1..500u32 {
                let moved = Duration::from_millis(100) * step;
                let time = share.time_of(phase, moved);
                assert!(share.moved(phase, time) + Duration::from_nanos(2) >= moved, "{duty} {phase} {step}");
                assert!(time > last && share.moved(phase, time) < moved + Duration::from_millis(1));
                last = time;
            }
        }
    }
}
