//! How the threshold goes along with the sizes where a triangle limit binds.

use super::THRESHOLD_POWER;

/// Where a threshold that goes along with the sizes leads, how fast it follows them, and how much of what is amiss it makes up for in a view.
const TREND_AIM: f64 = 0.98;
const TREND_SHARE: f64 = 0.6;
const TREND_PULL: f64 = 0.3;
/// Logarithm of the most that it moves by itself in a view.
const MOST_TREND: f64 = 0.05;

/// How a limit moves the threshold from view to view while the camera moves.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Trend {
    /// Logarithm of the threshold's growth in a view.
    rate: f64,
    /// Threshold and triangles after the last view, if that was one of a camera that moved and the limit did bind.
    last: Option<(f32, u32)>,
}

impl Trend {
    /// What a threshold is moved to before a view is looked at, so that it goes along with the sizes instead of behind them.
    pub(super) fn ahead(&self, threshold: f32) -> f32 {
        if self.last.is_some() { threshold * self.rate.exp() as f32 } else { threshold }
    }

    /// After a view: the limit did bind.
    pub(super) fn note(&mut self, threshold: f32, triangles: u32, limit: u32) {
        let share = f64::from(triangles) / f64::from(limit.max(1));
        if let Some((before, triangles_before)) = self.last {
            let moved = f64::from(threshold / before).ln();
            let grown = f64::from(triangles) / f64::from(triangles_before.max(1));
            // What would have kept the closure as large as it was.
            let needed = moved + THRESHOLD_POWER * grown.ln();
            let rate = (1.0 - TREND_SHARE) * self.rate + TREND_SHARE * needed;
            let rate = rate + TREND_PULL * THRESHOLD_POWER * (share / TREND_AIM).ln();
            // What a camera does that jumps says nothing about the next view.
            self.rate = if needed.abs() < 0.2 { rate.clamp(-MOST_TREND, MOST_TREND) } else { 0.0 };
        }
        self.last = Some((threshold, triangles));
    }

    pub(super) fn stop(&mut self) {
        *self = Self::default();
    }
}
