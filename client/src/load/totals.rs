//! What all clients of a run measured, together.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;

use super::histogram::Histogram;
use super::trace::Trace;

/// Intervals of a timeline at most; beyond that two become one.
const MAX_INTERVALS: usize = 240;
/// How long an interval is at first, and how often a client adds to it.
pub(super) const FIRST_INTERVAL: Duration = Duration::from_millis(250);
/// Causes of failure that are told apart.
const MAX_CAUSES: usize = 32;

/// Sums that grow as a client goes on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Counters {
    /// Bytes out of the link: upgrade, frame headers, control frames, everything.
    pub bytes_in: u64,
    /// Bytes into the link, counted likewise.
    pub bytes_out: u64,
    /// Bytes of the payloads of frames received: the part that the server's sessions count.
    pub payload_in: u64,
    /// Frames received.
    pub frames: u64,
    /// Batches applied.
    pub batches: u64,
    /// Bytes of their coded ops: what is left of `bytes_in` are the base mesh and headers.
    pub op_bytes: u64,
    /// Vertex splits, cached ones included.
    pub splits: u64,
    /// Splits that came from the mirrored cache.
    pub cached_splits: u64,
    /// Edge collapses.
    pub collapses: u64,
    /// Components inserted.
    pub spawns: u64,
    /// Components removed.
    pub despawns: u64,
    /// Views set.
    pub views: u64,
    /// Views after which a batch for them, or for a later one, was applied.
    pub views_served: u64,
    /// Views that settled while they were the newest.
    pub views_settled: u64,
    /// Processor time in the session core: decoding and applying frames.
    #[serde(rename = "core_cpu_s", serialize_with = "as_seconds")]
    pub core_cpu: Duration,
}

fn as_seconds<S: serde::Serializer>(time: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64(time.as_secs_f64())
}

impl Counters {
    pub(super) fn add(&mut self, other: &Self) {
        let Self {
            bytes_in,
            bytes_out,
            payload_in,
            frames,
            batches,
            op_bytes,
            splits,
            cached_splits,
            collapses,
            spawns,
            despawns,
            views,
            views_served,
            views_settled,
            core_cpu,
        } = other;
        self.bytes_in += bytes_in;
        self.bytes_out += bytes_out;
        self.payload_in += payload_in;
        self.frames += frames;
        self.batches += batches;
        self.op_bytes += op_bytes;
        self.splits += splits;
        self.cached_splits += cached_splits;
        self.collapses += collapses;
        self.spawns += spawns;
        self.despawns += despawns;
        self.views += views;
        self.views_served += views_served;
        self.views_settled += views_settled;
        self.core_cpu += *core_cpu;
    }

    /// All ops.
    pub fn ops(&self) -> u64 {
        self.splits + self.collapses + self.spawns + self.despawns
    }
}

/// A client's time is in one of these.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    /// From connecting until the second view is set.
    FirstView,
    /// From then on.
    Moving,
}

/// Ops of one kind, in batches that hold nothing else: their share of the bytes is known without asking the codec.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SingleKind {
    /// Such batches.
    pub batches: u64,
    /// Their ops.
    pub ops: u64,
    /// Bytes of their coded ops.
    pub op_bytes: u64,
    /// The same with the headers of batch and frame.
    pub bytes: u64,
    /// Coded bits for an op.
    pub bits_per_op: Option<f64>,
    /// Bits for an op with its share of the headers.
    pub bits_per_op_received: Option<f64>,
}

impl SingleKind {
    pub(super) fn new(batches: u64, ops: u64, op_bytes: u64, bytes: u64) -> Self {
        let bits = |bytes: u64| (ops > 0).then(|| bytes as f64 * 8.0 / ops as f64);
        Self { batches, ops, op_bytes, bytes, bits_per_op: bits(op_bytes), bits_per_op_received: bits(bytes) }
    }

    pub(super) fn add(&mut self, other: &Self) {
        let Self { batches, ops, op_bytes, bytes, .. } = *other;
        *self = Self::new(self.batches + batches, self.ops + ops, self.op_bytes + op_bytes, self.bytes + bytes);
    }
}

/// See [`SingleKind`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SingleKindBatches {
    /// Splits that came as records.
    pub fresh_splits: SingleKind,
    /// Splits from the cache.
    pub cached_splits: SingleKind,
    /// Collapses.
    pub collapses: SingleKind,
}

impl SingleKindBatches {
    pub(super) fn merge(&mut self, other: &Self) {
        self.fresh_splits.add(&other.fresh_splits);
        self.cached_splits.add(&other.cached_splits);
        self.collapses.add(&other.collapses);
    }
}

/// What went on at a time since clients began to connect.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Interval {
    pub(super) bytes_in: u64,
    pub(super) splits: u64,
    pub(super) collapses: u64,
    /// Looks at a client.
    pub(super) samples: u64,
    /// How many of them found it settled, and the sum of triangles that they found.
    pub(super) settled: u64,
    pub(super) triangles: u64,
}

impl Interval {
    fn add(&mut self, other: &Self) {
        let Self { bytes_in, splits, collapses, samples, settled, triangles } = other;
        self.bytes_in += bytes_in;
        self.splits += splits;
        self.collapses += collapses;
        self.samples += samples;
        self.settled += settled;
        self.triangles += triangles;
    }
}

/// Intervals of equal length from the moment when a client began to connect, its own for each.
#[derive(Clone, Debug)]
pub(super) struct Timeline {
    pub(super) length: Duration,
    pub(super) intervals: Vec<Interval>,
}

impl Default for Timeline {
    fn default() -> Self {
        Self { length: FIRST_INTERVAL, intervals: Vec::new() }
    }
}

impl Timeline {
    pub(super) fn add(&mut self, at: Duration, what: &Interval) {
        let index = loop {
            let index = (at.as_nanos() / self.length.as_nanos()) as usize;
            if index < MAX_INTERVALS {
                break index;
            }
            self.coarsen();
        };
        if self.intervals.len() <= index {
            self.intervals.resize(index + 1, Interval::default());
        }
        self.intervals[index].add(what);
    }

    fn coarsen(&mut self) {
        self.length *= 2;
        let halved = self.intervals.chunks(2).map(|pair| {
            let mut sum = pair[0];
            pair.iter().skip(1).for_each(|other| sum.add(other));
            sum
        });
        self.intervals = halved.collect();
    }
}

/// Connections that broke because that was asked for, and what became of them.
#[derive(Clone, Debug, Default)]
pub(super) struct Dropped {
    pub(super) connections: u64,
    /// Sessions that went on, and others that began anew.
    pub(super) resumed: u64,
    pub(super) begun_anew: u64,
    /// From the break to the server's answer over the next connection.
    pub(super) back: Histogram,
    /// Bytes that came of frames that were not complete.
    pub(super) cut_off_bytes: u64,
}

/// Everything. Times in histograms are microseconds, errors millionths of a pixel.
#[derive(Clone, Debug, Default)]
pub(super) struct Totals {
    /// Clients that began to connect, got their stream, ended well, failed.
    pub(super) started: u64,
    pub(super) connected: u64,
    pub(super) completed: u64,
    pub(super) failed: u64,
    pub(super) failures: BTreeMap<String, u64>,
    pub(super) model: Option<String>,

    pub(super) connect: Histogram,
    pub(super) first_image: Histogram,
    pub(super) first_image_bytes: Histogram,
    pub(super) first_settled: Histogram,
    pub(super) first_settled_bytes: Histogram,
    pub(super) view_to_first_op: Histogram,
    pub(super) view_to_settled: Histogram,
    pub(super) stale_bytes: Histogram,
    pub(super) settled_error: Histogram,
    /// Views that settled with the limit in the way.
    pub(super) limited: u64,

    pub(super) first_view: Counters,
    pub(super) moving: Counters,
    pub(super) single_kind: SingleKindBatches,
    pub(super) timeline: Timeline,

    /// Time that clients had a stream or were getting theirs, of all that got one.
    pub(super) connected_time: Duration,
    /// Of a few clients, with their numbers.
    pub(super) traces: Vec<(u64, Trace)>,

    pub(super) max_triangles_seen: u32,
    pub(super) limits_exceeded: u64,
    pub(super) resets: u64,
    pub(super) dropped_batches: u64,
    pub(super) dropped: Dropped,
}

impl Totals {
    pub(super) fn phase(&mut self, phase: Phase) -> &mut Counters {
        match phase {
            Phase::FirstView => &mut self.first_view,
            Phase::Moving => &mut self.moving,
        }
    }

    /// Both phases.
    pub(super) fn all(&self) -> Counters {
        let mut all = self.first_view;
        all.add(&self.moving);
        all
    }

    pub(super) fn fail(&mut self, cause: String) {
        self.failed += 1;
        let is_known = self.failures.contains_key(&cause);
        let cause = if is_known || self.failures.len() < MAX_CAUSES { cause } else { "other causes".into() };
        *self.failures.entry(cause).or_default() += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_timeline_coarsens_and_loses_nothing() {
        let mut timeline = Timeline::default();
        let mut rng = fastrand::Rng::with_seed(2);
        let mut added: Vec<(Duration, u64)> = Vec::new();
        for round in 0..3000u64 {
            let at = Duration::from_millis(rng.u64(0..1 + round * 100));
            timeline.add(at, &Interval { bytes_in: round, samples: 1, ..Interval::default() });
            added.push((at, round));
        }
        assert!(timeline.intervals.len() <= MAX_INTERVALS && timeline.length > FIRST_INTERVAL);
        for (i, interval) in (0u32..).zip(&timeline.intervals) {
            let inside = added.iter().filter(|(at, _)| (timeline.length * i..timeline.length * (i + 1)).contains(at));
            let (bytes, samples) = inside.fold((0, 0), |(bytes, samples), (_, round)| (bytes + round, samples + 1));
            assert_eq!((interval.bytes_in, interval.samples), (bytes, samples));
        }
    }

    #[test]
    fn causes_are_bounded() {
        let mut totals = Totals::default();
        for i in 0..100 {
            totals.fail(format!("cause {i}"));
            totals.fail("cause 0".into());
        }
        assert_eq!((totals.failed, totals.failures.len()), (200, MAX_CAUSES + 1));
        assert_eq!((totals.failures["cause 0"], totals.failures["other causes"]), (101, 68));
    }
}
