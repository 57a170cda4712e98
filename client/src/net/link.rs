//! A slower link than the real one, as arithmetic: what arrives when, given a rate and a latency.
//!
//! No I/O and no clock: `snapshot` and the load tester ask it when to hand on what the socket brought, and tests run it on
//! virtual time. A [`Lane`] is one direction.

use std::collections::VecDeque;
use std::str::FromStr;
use std::time::Duration;

use lodestream_protocol::time::Timestamp;

/// Bytes in a lane from which on it takes no more: about what the socket buffers along a real slow link hold.
const MAX_QUEUED_BYTES: usize = 1 << 20;

/// Rate of a link in bits per second, as `--rate` takes it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LinkRate {
    /// As fast as the socket.
    #[default]
    Unlimited,
    /// This many bits per second, at least 1.
    BitsPerSec(u64),
}

/// How a link is slower than the socket below it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkShape {
    /// Rate from the server to the client. What a client sends is too little to matter.
    pub rate: LinkRate,
    /// One-way latency, in both directions.
    pub latency: Duration,
}

/// Why a flag's value makes no sense.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ShapeError {
    /// No rate.
    #[error("'{0}' is no rate: write 'unlimited' or a number with bit, kbit, Mbit or Gbit, such as 1Mbit")]
    Rate(String),
    /// No duration.
    #[error("'{0}' is no duration: write a number with us, ms or s, such as 50ms")]
    Duration(String),
}

impl FromStr for LinkRate {
    type Err = ShapeError;

    /// `unlimited`, or a positive number of `bit`, `kbit`, `Mbit` or `Gbit` (powers of 1000, per second).
    fn from_str(text: &str) -> Result<Self, ShapeError> {
        if text == "unlimited" {
            return Ok(Self::Unlimited);
        }
        let units = [("Gbit", 1e9), ("Mbit", 1e6), ("kbit", 1e3), ("bit", 1.0)];
        number_with_unit(text, &units)
            .map(f64::round)
            .filter(|bits| (1.0..=1e15).contains(bits))
            .map(|bits| Self::BitsPerSec(bits as u64))
            .ok_or_else(|| ShapeError::Rate(text.into()))
    }
}

/// A duration as `--latency` takes it: a number with `us`, `ms` or `s`; a bare `0` will do.
///
/// # Errors
/// [`ShapeError::Duration`] if it is none, negative or over an hour.
pub fn parse_duration(text: &str) -> Result<Duration, ShapeError> {
    if text == "0" {
        return Ok(Duration::ZERO);
    }
    number_with_unit(text, &[("us", 1e-6), ("ms", 1e-3), ("s", 1.0)])
        .filter(|seconds| (0.0..=3600.0).contains(seconds))
        .map(Duration::from_secs_f64)
        .ok_or_else(|| ShapeError::Duration(text.into()))
}

/// The number before the first unit that `text` ends with, times that unit's factor.
fn number_with_unit(text: &str, units: &[(&str, f64)]) -> Option<f64> {
    let (number, factor) = units.iter().find_map(|&(unit, factor)| Some((text.strip_suffix(unit)?, factor)))?;
    let is_plain = number.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
    let number: f64 = number.parse().ok().filter(|_| is_plain)?;
    Some(number * factor)
}

/// One direction of a shaped link: items come out in order, each when its last byte would have arrived.
///
/// An item of `n` bytes leaves the bottleneck `n` bytes after the later of its own arrival there and the end of the item
/// before it, and comes out one latency after that.
#[derive(Debug)]
pub struct Lane<T> {
    rate: LinkRate,
    latency: Duration,
    /// When the bottleneck has sent all that it was given.
    busy_until: Timestamp,
    queue: VecDeque<Queued<T>>,
    queued_bytes: usize,
}

#[derive(Debug)]
struct Queued<T> {
    due: Timestamp,
    bytes: usize,
    item: T,
}

impl<T> Lane<T> {
    /// An empty lane.
    pub fn new(rate: LinkRate, latency: Duration) -> Self {
        Self { rate, latency, busy_until: Timestamp::default(), queue: VecDeque::new(), queued_bytes: 0 }
    }

    /// Puts in an item that takes `bytes` on the link.
    pub fn push(&mut self, now: Timestamp, bytes: usize, item: T) {
        self.busy_until = self.busy_until.max(now) + self.transfer(bytes);
        self.queued_bytes += bytes;
        self.queue.push_back(Queued { due: self.busy_until + self.latency, bytes, item });
    }

    /// Takes out the next item if it is due.
    pub fn pop(&mut self, now: Timestamp) -> Option<T> {
        let next = self.queue.pop_front_if(|next| next.due <= now)?;
        self.queued_bytes -= next.bytes;
        Some(next.item)
    }

    /// When the next item comes out.
    pub fn next_due(&self) -> Option<Timestamp> {
        self.queue.front().map(|next| next.due)
    }

    /// Whether the lane takes more. Whoever feeds it from a socket stops reading while it does not, as a full buffer
    /// along a real link would make the sender wait.
    pub fn has_room(&self) -> bool {
        self.queued_bytes < MAX_QUEUED_BYTES
    }

    /// Whether nothing is on the way.
    pub fn is_empty(&self) -> bool {
        self.queue.is_empty()
    }

    fn transfer(&self, bytes: usize) -> Duration {
        match self.rate {
            LinkRate::Unlimited => Duration::ZERO,
            LinkRate::BitsPerSec(rate) => {
                let nanos = bytes as u128 * 8 * 1_000_000_000 / u128::from(rate.max(1));
                Duration::from_nanos(u64::try_from(nanos).unwrap_or(u64::MAX))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Timestamp {
        Timestamp(Duration::from_millis(ms))
    }

    #[test]
    fn items_take_their_time_and_keep_their_order() {
        // 8 kbit/s is a byte per millisecond.
        let mut lane = Lane::new(LinkRate::BitsPerSec(8000), Duration::from_millis(50));
        lane.push(at(100), 30, 'a');
        lane.push(at(110), 20, 'b'); // waits for a: 130 + 20 + 50
        lane.push(at(300), 10, 'c'); // the link was idle: 300 + 10 + 50
        assert_eq!(lane.next_due(), Some(at(180)));
        assert_eq!(lane.pop(at(179)), None);
        assert_eq!(lane.pop(at(180)), Some('a'));
        assert_eq!(lane.next_due(), Some(at(200)));
        assert_eq!(lane.pop(at(500)), Some('b'));
        assert_eq!(lane.next_due(), Some(at(360)));
        assert_eq!(lane.pop(at(500)), Some('c'));
        assert!(lane.is_empty() && lane.pop(at(500)).is_none() && lane.next_due().is_none());
    }

    #[test]
    fn latency_does_not_lower_the_rate() {
        let mut lane = Lane::new(LinkRate::BitsPerSec(1_000_000), Duration::from_millis(200));
        for i in 0..100 {
            lane.push(at(0), 1250, i); // 10 ms each
        }
        let mut out = Vec::new();
        for ms in 0..=1200 {
            while lane.pop(at(ms)).is_some() {
                out.push(ms);
            }
        }
        assert_eq!(out, (1..=100).map(|i| 200 + 10 * i).collect::<Vec<_>>());
    }

    #[test]
    fn an_unlimited_lane_hands_on_at_once() {
        let mut lane = Lane::new(LinkRate::Unlimited, Duration::ZERO);
        lane.push(at(5), 1 << 30, ());
        assert!(!lane.has_room());
        assert_eq!(lane.pop(at(5)), Some(()));
        assert!(lane.has_room());
    }

    #[test]
    fn rates_parse() {
        let parse = |text: &str| text.parse::<LinkRate>();
        assert_eq!(parse("unlimited"), Ok(LinkRate::Unlimited));
        for (text, bits) in [("1Mbit", 1_000_000), ("256kbit", 256_000), ("1.5Mbit", 1_500_000), ("9bit", 9)] {
            assert_eq!(parse(text), Ok(LinkRate::BitsPerSec(bits)));
        }
        assert_eq!(parse("2Gbit"), Ok(LinkRate::BitsPerSec(2_000_000_000)));
        for text in ["", "1", "Mbit", "0Mbit", "-1Mbit", "1 Mbit", "1MB", "infbit", "nanMbit", "1e3bit", "99999999Gbit"]
        {
            assert_eq!(parse(text), Err(ShapeError::Rate(text.into())), "{text}");
        }
    }

    #[test]
    fn durations_parse() {
        for (text, micros) in [("0", 0), ("0ms", 0), ("50ms", 50_000), ("1.5s", 1_500_000), ("20us", 20)] {
            assert_eq!(parse_duration(text), Ok(Duration::from_micros(micros)));
        }
        for text in ["", "50", "ms", "-1ms", "infs", "2h", "4000s"] {
            assert_eq!(parse_duration(text), Err(ShapeError::Duration(text.into())), "{text}");
        }
    }
}
