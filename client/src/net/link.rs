//! A slower link than the real one, as arithmetic: which byte arrives when, given rate, latency, losses and stalls.
//!
//! No I/O and no clock: the socket's wrapper asks it when to hand on what the socket brought, and tests run it on virtual
//! time. A [`Lane`] is one direction.

use std::collections::VecDeque;
use std::str::FromStr;
use std::time::Duration;

use fastrand::Rng;
use lodestream_protocol::time::Timestamp;

/// Payload of a full TCP segment: what a link carries in one piece.
const PACKET_BYTES: usize = 1448;
/// Bytes in front of the bottleneck from which on a lane takes no more: what the buffer of a home router holds.
const BUFFER_BYTES: usize = 256 << 10;
/// Bytes in a lane, wherever they are, from which on it takes no more: a large receive window.
const WINDOW_BYTES: usize = 4 << 20;
/// Least time in which a lost packet is sent again.
const LEAST_RETRANSMISSION: Duration = Duration::from_millis(1);

/// Rate of a link in bits per second, as `--rate` takes it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LinkRate {
    /// As fast as the socket.
    #[default]
    Unlimited,
    /// This many bits per second, at least 1.
    BitsPerSec(u64),
}

/// How a link is slower than the socket below it. The same in both directions.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LinkShape {
    /// Rate in each direction.
    pub rate: LinkRate,
    /// One-way latency.
    pub latency: Duration,
    /// Share of packets that are lost and sent again, which takes a round trip and holds up all behind them; from 0 to 1.
    pub loss: f64,
    /// Times in which nothing moves.
    pub stalls: Option<Stalls>,
    /// Seed of losses and stalls.
    pub seed: u64,
}

impl LinkShape {
    /// Whether bytes pass as if there were no link.
    pub fn is_transparent(&self) -> bool {
        self.rate == LinkRate::Unlimited && self.latency.is_zero() && self.loss <= 0.0 && self.stalls.is_none()
    }
}

/// A link that freezes now and then, both directions at once: lengths are fixed, the gaps between two stalls are random
/// (exponentially distributed).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stalls {
    /// How long a stall lasts.
    pub length: Duration,
    /// Mean time from the end of one to the beginning of the next.
    pub interval: Duration,
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
    /// No stalls.
    #[error("'{0}' names no stalls: write their length and the mean time between two, such as 300ms/10s")]
    Stalls(String),
}

impl FromStr for Stalls {
    type Err = ShapeError;

    /// Length and interval, both above zero, such as `300ms/10s`.
    fn from_str(text: &str) -> Result<Self, ShapeError> {
        let parse = |text: &str| parse_duration(text).ok().filter(|time| !time.is_zero());
        text.split_once('/')
            .and_then(|(length, interval)| Some(Self { length: parse(length)?, interval: parse(interval)? }))
            .ok_or_else(|| ShapeError::Stalls(text.into()))
    }
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

/// One direction of a shaped link: bytes come out in order, each packet of at most 1,448 bytes when its last byte would
/// have arrived.
///
/// A packet of `n` bytes leaves the bottleneck `n` bytes after the later of its own arrival there and the end of the
/// packet before it (a token bucket that holds one packet), and comes out one latency after that. A stall stops the
/// bottleneck. A lost packet passes the bottleneck twice and comes out a round trip later, with all that follows behind
/// it. Room is bounded, so whoever feeds a lane from a socket stops reading in time, and the sender finds the socket full.
#[derive(Debug)]
pub struct Lane {
    rate: LinkRate,
    latency: Duration,
    loss: f64,
    losses: Rng,
    stalls: Option<StallSchedule>,
    /// When the bottleneck has sent all that it was given.
    busy_until: Timestamp,
    /// When the newest packet comes out.
    last_due: Timestamp,
    bytes: VecDeque<u8>,
    packets: VecDeque<Packet>,
    /// Packets at the front that were found past the bottleneck.
    past: usize,
    /// Bytes of the others.
    waiting_bytes: usize,
}

#[derive(Clone, Copy, Debug)]
struct Packet {
    bytes: usize,
    /// When the bottleneck has sent it.
    left: Timestamp,
    due: Timestamp,
}

/// Which of the two lanes of a link: losses in one say nothing about the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// From the server.
    Down,
    /// To the server.
    Up,
}

impl Lane {
    /// An empty lane.
    pub fn new(shape: &LinkShape, direction: Direction) -> Self {
        let losses = Rng::with_seed(shape.seed.wrapping_mul(2).wrapping_add(u64::from(direction == Direction::Up)));
        Self {
            rate: shape.rate,
            latency: shape.latency,
            loss: shape.loss,
            losses,
            stalls: shape.stalls.map(|stalls| StallSchedule::new(stalls, shape.seed)),
            busy_until: Timestamp::default(),
            last_due: Timestamp::default(),
            bytes: VecDeque::new(),
            packets: VecDeque::new(),
            past: 0,
            waiting_bytes: 0,
        }
    }

    /// Bytes that [`push`](Self::push) may be given now.
    pub fn room(&mut self, now: Timestamp) -> usize {
        while let Some(packet) = self.packets.get(self.past).filter(|packet| packet.left <= now) {
            self.waiting_bytes -= packet.bytes;
            self.past += 1;
        }
        let buffer = BUFFER_BYTES.saturating_sub(self.waiting_bytes);
        buffer.min(WINDOW_BYTES.saturating_sub(self.bytes.len()))
    }

    /// Puts bytes in. Those that come at once make full packets and a rest.
    pub fn push(&mut self, now: Timestamp, bytes: &[u8]) {
        for piece in bytes.chunks(PACKET_BYTES) {
            let mut left = self.send(now, piece.len());
            let mut delay = self.latency;
            while self.loss > 0.0 && self.losses.f64() < self.loss {
                left = self.send(now, piece.len());
                delay += (self.latency * 2).max(LEAST_RETRANSMISSION);
            }
            self.last_due = self.last_due.max(left + delay);
            self.packets.push_back(Packet { bytes: piece.len(), left, due: self.last_due });
            self.waiting_bytes += piece.len();
        }
        self.bytes.extend(bytes);
    }

    /// The next bytes that are due: all of them or a part, empty if none are.
    pub fn ready(&self, now: Timestamp) -> &[u8] {
        let (first, _) = self.bytes.as_slices();
        let mut due = 0;
        for packet in self.packets.iter().take_while(|packet| packet.due <= now) {
            due += packet.bytes;
            if due >= first.len() {
                return first;
            }
        }
        &first[..due]
    }

    /// Takes out so many bytes of those that are [`ready`](Self::ready).
    pub fn consume(&mut self, mut count: usize) {
        self.bytes.drain(..count);
        while let Some(packet) = self.packets.front_mut().filter(|_| count > 0) {
            let taken = count.min(packet.bytes);
            count -= taken;
            if self.past == 0 {
                self.waiting_bytes -= taken;
            }
            packet.bytes -= taken;
            if packet.bytes == 0 {
                self.packets.pop_front();
                self.past = self.past.saturating_sub(1);
            }
        }
    }

    /// When the next byte comes out.
    pub fn next_due(&self) -> Option<Timestamp> {
        self.packets.front().map(|packet| packet.due)
    }

    /// When there will be more [`room`](Self::room), as far as the lane knows: the next packet leaves the bottleneck.
    pub fn next_room(&self) -> Option<Timestamp> {
        self.packets.get(self.past).map(|packet| packet.left)
    }

    /// Whether nothing is on the way.
    pub fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// Gives the bottleneck a packet and says when it has sent it.
    fn send(&mut self, now: Timestamp, bytes: usize) -> Timestamp {
        let start = self.busy_until.max(now);
        let work = match self.rate {
            LinkRate::Unlimited => Duration::ZERO,
            LinkRate::BitsPerSec(rate) => {
                let nanos = bytes as u128 * 8 * 1_000_000_000 / u128::from(rate.max(1));
                Duration::from_nanos(u64::try_from(nanos).unwrap_or(u64::MAX))
            }
        };
        self.busy_until = match &mut self.stalls {
            Some(stalls) => stalls.finish(start, work),
            None => start + work,
        };
        self.busy_until
    }
}

/// When the stalls of a link are: a function of its seed.
#[derive(Debug)]
struct StallSchedule {
    stalls: Stalls,
    rng: Rng,
    /// When the next stall begins, or that in which time stands.
    next: Timestamp,
}

impl StallSchedule {
    fn new(stalls: Stalls, seed: u64) -> Self {
        let mut schedule = Self { stalls, rng: Rng::with_seed(seed ^ 0x57a1_1ed5), next: Timestamp::default() };
        schedule.next = schedule.next + schedule.gap();
        schedule
    }

    fn gap(&mut self) -> Duration {
        // 1 - u lies above 0, so the logarithm is finite.
        self.stalls.interval.mul_f64(-(1.0 - self.rng.f64()).ln())
    }

    /// When work that begins at `start` is done. `start` must not fall from call to call.
    fn finish(&mut self, start: Timestamp, mut work: Duration) -> Timestamp {
        let mut at = start;
        while self.next <= at || self.next < at + work {
            // A stall that was over before changes nothing.
            work = work.saturating_sub(self.next.since(at));
            at = at.max(self.next + self.stalls.length);
            self.next = self.next + self.stalls.length + self.gap();
        }
        at + work
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Timestamp {
        Timestamp(Duration::from_millis(ms))
    }

    fn shape(bits_per_sec: u64, latency_ms: u64) -> LinkShape {
        let rate = LinkRate::BitsPerSec(bits_per_sec);
        LinkShape { rate, latency: Duration::from_millis(latency_ms), ..LinkShape::default() }
    }

    fn take(lane: &mut Lane, now: Timestamp) -> Vec<u8> {
        let mut out = Vec::new();
        while !lane.ready(now).is_empty() {
            let ready = lane.ready(now);
            out.extend(ready);
            let count = ready.len();
            lane.consume(count);
        }
        out
    }

    #[test]
    fn bytes_take_their_time_and_keep_their_order() {
        // 8 kbit/s is a byte per millisecond.
        let mut lane = Lane::new(&shape(8000, 50), Direction::Down);
        lane.push(at(100), &[1; 30]);
        lane.push(at(110), &[2; 20]); // waits for the first: 130 + 20 + 50
        lane.push(at(300), &[3; 10]); // the link was idle: 300 + 10 + 50
        assert_eq!(lane.next_due(), Some(at(180)));
        assert!(take(&mut lane, at(179)).is_empty());
        assert_eq!(take(&mut lane, at(180)), [1; 30]);
        assert_eq!(lane.next_due(), Some(at(200)));
        assert_eq!(take(&mut lane, at(359)), [2; 20]);
        assert_eq!(lane.next_due(), Some(at(360)));
        assert_eq!(take(&mut lane, at(500)), [3; 10]);
        assert!(lane.is_empty() && lane.next_due().is_none() && lane.next_room().is_none());
    }

    #[test]
    fn latency_does_not_lower_the_rate() {
        let mut lane = Lane::new(&shape(1_158_400, 200), Direction::Down);
        lane.push(at(0), &[0; 100 * PACKET_BYTES]); // 10 ms each
        for ms in 0..=1200 {
            let expected = if ms >= 210 && ms % 10 == 0 { PACKET_BYTES } else { 0 };
            assert_eq!(take(&mut lane, at(ms)).len(), expected, "{ms}");
        }
        assert!(lane.is_empty());
    }

    #[test]
    fn room_comes_back_as_packets_leave_the_bottleneck() {
        let mut lane = Lane::new(&shape(1_158_400, 1000), Direction::Down);
        assert_eq!(lane.room(at(0)), BUFFER_BYTES);
        lane.push(at(0), &[0; BUFFER_BYTES]);
        assert_eq!((lane.room(at(0)), lane.next_room()), (0, Some(at(10))));
        assert_eq!(lane.room(at(9)), 0);
        assert_eq!(lane.room(at(30)), 3 * PACKET_BYTES);
        assert_eq!(lane.next_room(), Some(at(40)));
        assert!(take(&mut lane, at(1009)).is_empty());
        assert_eq!(take(&mut lane, at(1010)).len(), PACKET_BYTES);
        assert_eq!(lane.room(at(1010)), 101 * PACKET_BYTES);
        // Taken in pieces it is the same.
        while lane.next_due().is_some_and(|due| due <= at(1100)) {
            lane.consume(1);
        }
        assert_eq!(lane.room(at(1100)), 110 * PACKET_BYTES);
        // An unlimited lane with latency is bounded too.
        let mut lane = Lane::new(&LinkShape { rate: LinkRate::Unlimited, ..shape(1, 50) }, Direction::Up);
        while lane.room(at(0)) > 0 {
            let room = lane.room(at(0));
            lane.push(at(0), &vec![0; room]);
        }
        assert_eq!(take(&mut lane, at(50)).len(), WINDOW_BYTES);
    }

    #[test]
    fn an_unlimited_lane_hands_on_at_once() {
        let mut lane = Lane::new(&LinkShape::default(), Direction::Down);
        lane.push(at(5), &[7; 10_000]);
        assert_eq!(take(&mut lane, at(5)), [7; 10_000]);
    }

    #[test]
    fn stalls_stop_the_bottleneck_and_are_the_same_for_the_same_seed() {
        let stalls = Stalls { length: Duration::from_millis(300), interval: Duration::from_secs(1) };
        // A hundred seconds of work done in one piece or packet by packet ends at the same time.
        let finish = |seed: u64, pieces: u32| {
            let mut schedule = StallSchedule::new(stalls, seed);
            let mut now = Timestamp::default();
            for _ in 0..pieces {
                now = schedule.finish(now, Duration::from_secs(100) / pieces);
            }
            now
        };
        let mut lengths = Vec::new();
        for seed in 0..50 {
            let end = finish(seed, 1);
            assert_eq!(end, finish(seed, 1000));
            let stalled = end.0 - Duration::from_secs(100);
            assert_eq!(stalled.as_nanos() % stalls.length.as_nanos(), 0, "whole stalls");
            lengths.push(stalled.as_secs_f64() / stalls.length.as_secs_f64());
        }
        // The number of stalls is a Poisson variable of mean 100: the mean of 50 of them lies within 5 standard errors.
        let mean = lengths.iter().sum::<f64>() / 50.0;
        assert!((mean - 100.0).abs() < 5.0 * (100.0f64 / 50.0).sqrt(), "{mean}");
        assert!(lengths.iter().any(|&other| other != lengths[0]), "seeds differ");
    }

    #[test]
    fn an_idle_link_sleeps_through_its_stalls() {
        let stalls = Stalls { length: Duration::from_millis(300), interval: Duration::from_secs(1) };
        let mut schedule = StallSchedule::new(stalls, 3);
        // What is asked at a millisecond's distance is either not delayed or to the end of one stall.
        let (mut delayed, mut end) = (0, Timestamp::default());
        for ms in 0..100_000 {
            let done = schedule.finish(end.max(at(ms)), Duration::ZERO);
            assert!(done.since(at(ms)) <= stalls.length && done >= end);
            delayed += u32::from(done > at(ms));
            end = done;
        }
        // 300 ms of every 1,300 on average, known to a few per cent.
        assert!((15_000..32_000).contains(&delayed), "{delayed}");
    }

    #[test]
    fn lost_packets_come_a_round_trip_later_and_hold_up_the_rest() {
        let lossy = LinkShape { loss: 0.1, seed: 4, ..shape(11_584_000, 50) };
        let mut lane = Lane::new(&lossy, Direction::Down);
        lane.push(at(0), &[0; 1000 * PACKET_BYTES]); // 1 ms each
        let (mut last, mut gaps) = (at(0), 0);
        while let Some(due) = lane.next_due() {
            assert!(due >= last);
            gaps += u32::from(due.since(last) > Duration::from_millis(2));
            last = due;
            let count = lane.ready(due).len();
            lane.consume(count);
        }
        // Every loss takes a packet's time again: 1000 / 0.9 packets on average, with a deviation of 11. The last packet may
        // be lost itself, three times in a row once in a thousand runs.
        let total = last.0.as_millis();
        assert!((1050 + 50..1170 + 50 + 300).contains(&total) && gaps >= 5, "{total} ms, {gaps} gaps");
    }

    #[test]
    fn stalls_parse() {
        let expected = Stalls { length: Duration::from_millis(300), interval: Duration::from_secs(10) };
        assert_eq!("300ms/10s".parse(), Ok(expected));
        for text in ["", "300ms", "300ms/", "0ms/1s", "1s/0s", "a/b"] {
            assert_eq!(text.parse::<Stalls>(), Err(ShapeError::Stalls(text.into())), "{text}");
        }
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
