//! Live figures: what a panel shows.

use std::collections::VecDeque;
use std::time::Duration;

use lodestream_protocol::time::Timestamp;

/// Rates are of the last so long.
const WINDOW: Duration = Duration::from_secs(1);
/// Most entries of a meter: more are merged into the last.
const MAX_ENTRIES: usize = 512;

/// What the viewer measures. Nothing here changes what it does.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Figures {
    /// Triangles on screen.
    pub triangles: u32,
    /// Triangles that there may be at present.
    pub limit: u32,
    /// Triangles of the complete model.
    pub model_triangles: u64,
    /// Largest error that the mesh leaves, in pixels, once it is settled.
    pub error_px: Option<f32>,
    /// Bytes per second received.
    pub bytes_per_s: f64,
    /// Bytes received since the viewer began, all connections.
    pub bytes_received: u64,
    /// Milliseconds from a new view to the first ops chosen for it.
    pub round_trip_ms: Option<f64>,
    /// Images drawn in the last second.
    pub images_per_s: f64,
    /// Share of the splits of this connection that came from the mirrored cache.
    pub cache_hits: Option<f64>,
    /// Bytes of the mesh in memory, the GPU's share included.
    pub memory_bytes: u64,
    /// Bytes uploaded for the last image.
    pub uploaded_bytes: u64,
    /// Most bytes uploaded for one image so far, whole meshes aside.
    pub most_uploaded_bytes: u64,
    /// Images for which more was uploaded than the allowance, whole meshes aside.
    pub images_over_allowance: u32,
    /// Ops applied for the last image.
    pub applied_ops: u32,
    /// Most of them for one image so far.
    pub most_applied_ops: u32,
    /// Views sent on this connection.
    pub views: u64,
}

/// Amounts over a sliding second.
#[derive(Clone, Debug, Default)]
pub struct Meter {
    entries: VecDeque<(Timestamp, f64)>,
}

impl Meter {
    /// So much happened.
    pub fn add(&mut self, now: Timestamp, amount: f64) {
        let is_full = self.entries.len() >= MAX_ENTRIES;
        match self.entries.back_mut().filter(|_| is_full) {
            Some((_, last)) => *last += amount,
            None => self.entries.push_back((now, amount)),
        }
    }

    /// How much happened in the last second.
    pub fn per_second(&mut self, now: Timestamp) -> f64 {
        while self.entries.front().is_some_and(|(at, _)| now.since(*at) > WINDOW) {
            self.entries.pop_front();
        }
        self.entries.iter().map(|(_, amount)| amount).sum::<f64>() / WINDOW.as_secs_f64()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_meter_forgets_what_is_over_a_second_old() {
        let at = |ms| Timestamp(Duration::from_millis(ms));
        let mut meter = Meter::default();
        for ms in (0..3000).step_by(10) {
            meter.add(at(ms), 5.0);
        }
        assert_eq!(meter.per_second(at(2990)), 505.0);
        assert_eq!(meter.per_second(at(3490)), 255.0);
        assert_eq!(meter.per_second(at(9000)), 0.0);
        (0..10_000).for_each(|_| meter.add(at(9000), 1.0));
        assert_eq!((meter.entries.len(), meter.per_second(at(9000))), (MAX_ENTRIES, 10_000.0));
    }
}
