//! One direction of a virtual link: bytes arrive in order, after serialisation at a rate and a latency.

use std::collections::VecDeque;
use std::time::Duration;

use lodestream_protocol::time::Timestamp;

/// How a link behaves.
#[derive(Clone, Copy, Debug)]
pub struct LinkShape {
    /// Bytes per second.
    pub bytes_per_sec: f64,
    /// One way.
    pub latency: Duration,
}

impl LinkShape {
    /// Everything arrives at once.
    pub const INSTANT: Self = Self { bytes_per_sec: f64::INFINITY, latency: Duration::ZERO };
}

/// Frames on their way.
#[derive(Clone, Debug)]
pub struct Link {
    shape: LinkShape,
    busy_until: Timestamp,
    frames: VecDeque<(Timestamp, Vec<u8>)>,
    /// Bytes accepted so far.
    pub bytes: u64,
    /// Bytes of the largest frame among them.
    pub largest: usize,
}

impl Link {
    /// An idle link.
    pub fn new(shape: LinkShape) -> Self {
        Self { shape, busy_until: Timestamp::default(), frames: VecDeque::new(), bytes: 0, largest: 0 }
    }

    /// Sends a frame at `now`.
    pub fn send(&mut self, now: Timestamp, frame: Vec<u8>) {
        self.bytes += frame.len() as u64;
        self.largest = self.largest.max(frame.len());
        let seconds = frame.len() as f64 / self.shape.bytes_per_sec;
        self.busy_until = self.busy_until.max(now) + Duration::from_secs_f64(seconds);
        self.frames.push_back((self.busy_until + self.shape.latency, frame));
    }

    /// The next frame that has arrived by `now`.
    pub fn receive(&mut self, now: Timestamp) -> Option<Vec<u8>> {
        if self.frames.front()?.0 > now {
            return None;
        }
        self.frames.pop_front().map(|(_, frame)| frame)
    }

    /// Loses what is on its way.
    pub fn cut(&mut self) {
        self.frames.clear();
        self.busy_until = Timestamp::default();
    }

    /// When the next frame arrives.
    pub fn next_arrival(&self) -> Option<Timestamp> {
        self.frames.front().map(|frame| frame.0)
    }
}
