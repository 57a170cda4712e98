//! How much may be on its way: a window over unacknowledged bytes from the measured delivery rate and the shortest round
//! trip, and the client's own cap on the byte rate.

use std::collections::VecDeque;
use std::time::Duration;

use lodestream_protocol::ids::BatchSeq;
use lodestream_protocol::time::Timestamp;

/// Bytes that may be unacknowledged before anything was measured: about a TCP initial window.
const INITIAL_WINDOW: f64 = 16_384.0;
const MIN_WINDOW: f64 = 4096.0;
/// Slack on top of the round trip, so that a late acknowledgement does not idle the link.
const EXTRA: Duration = Duration::from_millis(50);
/// How long a rate or round-trip sample counts.
const MEMORY: Duration = Duration::from_secs(10);

#[derive(Clone, Copy, Debug)]
struct Sent {
    seq: BatchSeq,
    bytes: u64,
    at: Timestamp,
    /// Bytes delivered, and when, as this left.
    delivered: u64,
    delivered_at: Timestamp,
}

/// See the module.
#[derive(Clone, Debug)]
pub(crate) struct Pacer {
    max_window: f64,
    byte_rate: Option<f64>,
    tokens: f64,
    refilled_at: Timestamp,
    in_flight: VecDeque<Sent>,
    in_flight_bytes: u64,
    delivered: u64,
    delivered_at: Timestamp,
    /// Rates (bytes per second) of late, falling, and round trips (seconds), rising: the best first, each with those that
    /// outlive it.
    rates: VecDeque<(Timestamp, f64)>,
    round_trips: VecDeque<(Timestamp, f64)>,
    /// The shortest round trip is too old to trust: the window stays small until the link's queue is empty and a new
    /// one can be measured (as BBR's PROBE_RTT does).
    is_draining: bool,
    window: f64,
    /// Whether the window still doubles; ends when the rate stops growing with it.
    is_starting: bool,
    best_rate_at_last_growth: f64,
    rounds_without_growth: u32,
    round_ends_at: u64,
}

impl Pacer {
    pub(crate) fn new(max_window_bytes: u32, byte_rate: Option<u32>, now: Timestamp) -> Self {
        Self {
            max_window: f64::from(max_window_bytes).max(MIN_WINDOW),
            byte_rate: byte_rate.map(|rate| f64::from(rate.max(256))),
            tokens: 0.0,
            refilled_at: now,
            in_flight: VecDeque::new(),
            in_flight_bytes: 0,
            delivered: 0,
            delivered_at: now,
            rates: VecDeque::new(),
            round_trips: VecDeque::new(),
            is_draining: false,
            window: INITIAL_WINDOW,
            is_starting: true,
            best_rate_at_last_growth: 0.0,
            rounds_without_growth: 0,
            round_ends_at: 0,
        }
    }

    /// Bytes that the next batch may have: 0 when it has to wait.
    pub(crate) fn allowance(&mut self, now: Timestamp) -> usize {
        let room = self.window.min(self.max_window) - self.in_flight_bytes as f64;
        let mut allowed = if self.in_flight.is_empty() { room.max(MIN_WINDOW) } else { room };
        if let Some(rate) = self.byte_rate {
            self.refill(now, rate);
            allowed = allowed.min(self.tokens);
        }
        // A batch is a fraction of the window, so that a new view finds most of the link free.
        let share = (self.window / 4.0).clamp(1200.0, 16_384.0);
        if allowed < share.min(MIN_WINDOW / 4.0) { 0 } else { allowed.min(share) as usize }
    }

    /// Forgets what is on its way: the client will not acknowledge it any more. What was measured stays.
    pub(crate) fn restart(&mut self, now: Timestamp) {
        self.in_flight.clear();
        self.in_flight_bytes = 0;
        self.delivered_at = now;
        self.round_ends_at = self.delivered;
    }

    /// When [`allowance`](Self::allowance) may grow without an acknowledgement.
    pub(crate) fn next_refill(&self) -> Option<Timestamp> {
        let rate = self.byte_rate?;
        Some(self.refilled_at + Duration::from_secs_f64(((MIN_WINDOW / 4.0 - self.tokens) / rate).max(0.001)))
    }

    pub(crate) fn on_send(&mut self, now: Timestamp, seq: BatchSeq, bytes: usize) {
        if self.in_flight.is_empty() {
            // The link was idle: time without anything to deliver says nothing about its rate.
            self.delivered_at = now;
        }
        self.tokens -= bytes as f64;
        self.in_flight_bytes += bytes as u64;
        self.in_flight.push_back(Sent {
            seq,
            bytes: bytes as u64,
            at: now,
            delivered: self.delivered,
            delivered_at: self.delivered_at,
        });
    }

    pub(crate) fn on_ack(&mut self, now: Timestamp, seq: BatchSeq) {
        while let Some(&sent) = self.in_flight.front() {
            if sent.seq > seq {
                break;
            }
            self.in_flight.pop_front();
            self.in_flight_bytes -= sent.bytes;
            self.delivered += sent.bytes;
            self.delivered_at = now;
            let round_trip = now.since(sent.at).max(Duration::from_micros(100));
            let elapsed = now.since(sent.delivered_at).max(Duration::from_micros(100));
            let rate = (self.delivered - sent.delivered) as f64 / elapsed.as_secs_f64();
            remember(&mut self.rates, now, rate, |old, new| old <= new);
            forget(&mut self.rates, now);
            remember(&mut self.round_trips, now, round_trip.as_secs_f64(), |old, new| old >= new);
            self.refresh_round_trip(now);
            self.adapt(sent, round_trip);
        }
    }

    /// Shortest round trip of late, if one was measured.
    pub(crate) fn round_trip(&self) -> Option<Duration> {
        self.round_trips.front().map(|s| Duration::from_secs_f64(s.1))
    }

    fn refresh_round_trip(&mut self, now: Timestamp) {
        if self.is_draining {
            if self.in_flight_bytes as f64 <= MIN_WINDOW {
                self.is_draining = false;
                forget(&mut self.round_trips, now);
            }
        } else if self.round_trips.front().is_some_and(|s| now.since(s.0) > MEMORY) {
            self.is_draining = true;
        }
    }

    fn adapt(&mut self, acked: Sent, taken: Duration) {
        let rate = self.rates.front().map_or(0.0, |s| s.1);
        let round_trip = self.round_trip().unwrap_or_default();
        if taken > round_trip + 2 * EXTRA {
            // A queue has built up: the window is larger than the link needs.
            self.is_starting = false;
        }
        if self.is_starting && acked.delivered >= self.round_ends_at {
            // Once a round trip: has the larger window brought a higher rate?
            self.round_ends_at = self.delivered + self.in_flight_bytes;
            if rate > 1.25 * self.best_rate_at_last_growth {
                self.best_rate_at_last_growth = rate;
                self.rounds_without_growth = 0;
            } else {
                self.rounds_without_growth += 1;
                self.is_starting = self.rounds_without_growth < 3;
            }
        }
        let target = rate * (round_trip + EXTRA).as_secs_f64();
        self.window = if self.is_starting { self.window.max(2.0 * target) } else { target };
        if self.is_draining {
            self.window = MIN_WINDOW;
        }
        self.window = self.window.clamp(MIN_WINDOW, self.max_window);
    }

    fn refill(&mut self, now: Timestamp, rate: f64) {
        self.tokens += now.since(self.refilled_at).as_secs_f64() * rate;
        // A quarter of a second of saved-up tokens at most.
        self.tokens = self.tokens.min((rate / 4.0).max(MIN_WINDOW / 2.0));
        self.refilled_at = now;
    }
}

/// Appends a sample and drops those before it that it beats: they can never be the best again.
fn remember(samples: &mut VecDeque<(Timestamp, f64)>, now: Timestamp, sample: f64, loses: impl Fn(f64, f64) -> bool) {
    while samples.back().is_some_and(|s| loses(s.1, sample)) {
        samples.pop_back();
    }
    samples.push_back((now, sample));
}

/// Drops samples that are too old, all but the last.
fn forget(samples: &mut VecDeque<(Timestamp, f64)>, now: Timestamp) {
    while samples.len() > 1 && samples.front().is_some_and(|s| now.since(s.0) > MEMORY) {
        samples.pop_front();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A link of `rate` bytes per second and `latency` each way, always with something to send.
    fn steady_window(rate: f64, latency: f64, seconds: f64) -> (f64, f64) {
        let at = |s: f64| Timestamp(Duration::from_secs_f64(s));
        let mut pacer = Pacer::new(1 << 20, None, at(0.0));
        let (mut now, mut link_free, mut seq, mut delivered) = (0.0, 0.0f64, 0, 0.0);
        let mut acks: VecDeque<(f64, u32)> = VecDeque::new();
        while now < seconds {
            while acks.front().is_some_and(|a| a.0 <= now) {
                pacer.on_ack(at(now), BatchSeq(acks.pop_front().unwrap().1));
            }
            loop {
                let bytes = pacer.allowance(at(now));
                if bytes == 0 {
                    break;
                }
                seq += 1;
                pacer.on_send(at(now), BatchSeq(seq), bytes);
                link_free = link_free.max(now) + bytes as f64 / rate;
                delivered += bytes as f64;
                acks.push_back((link_free + 2.0 * latency, seq));
            }
            now += 0.001;
        }
        (pacer.window, delivered / seconds)
    }

    #[test]
    fn the_window_settles_near_the_bandwidth_delay_product_and_fills_the_link() {
        for (rate, latency) in [(125_000.0, 0.05), (32_000.0, 0.05), (625_000.0, 0.1), (125_000.0, 0.005)] {
            let (window, used) = steady_window(rate, latency, 28.0);
            let product = rate * (2.0 * latency + 0.05);
            assert!(window < 1.6 * product + 4096.0, "{rate} {latency}: {window} against {product}");
            assert!(used > 0.85 * rate, "{rate} {latency}: only {used} bytes per second");
        }
    }

    #[test]
    fn the_byte_rate_is_kept() {
        let at = |ms: u64| Timestamp(Duration::from_millis(ms));
        let mut pacer = Pacer::new(1 << 20, Some(20_000), at(0));
        let mut sent = 0;
        for (seq, ms) in (0..10_000).enumerate() {
            let bytes = pacer.allowance(at(ms));
            if bytes > 0 {
                pacer.on_send(at(ms), BatchSeq(seq as u32 + 1), bytes);
                pacer.on_ack(at(ms), BatchSeq(seq as u32 + 1));
                sent += bytes;
            }
        }
        assert!((180_000..=206_000).contains(&sent), "{sent}");
    }
}
