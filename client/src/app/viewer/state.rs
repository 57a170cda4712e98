//! What the viewer is doing, in one word that is always on screen.

use std::fmt;

/// The state of a viewer.
#[derive(Clone, Debug, PartialEq)]
pub enum State {
    /// No picture of the model yet.
    Connecting,
    /// Detail is coming.
    Refining {
        /// How far, from 0 to 99.
        percent: u8,
    },
    /// The mesh is exactly what the view asks for.
    Settled {
        /// Whether the triangle limit kept detail out.
        limited: bool,
    },
    /// The connection is lost and will be tried again; the picture stays.
    Reconnecting,
    /// The server takes no more sessions at present; it is asked again from time to time.
    Full,
    /// The server does not have the model (any more).
    Gone,
    /// It cannot go on.
    Failed {
        /// Why, for people.
        reason: String,
    },
}

impl State {
    /// The word that programs look for.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Connecting => "connecting",
            Self::Refining { .. } => "refining",
            Self::Settled { .. } => "settled",
            Self::Reconnecting => "reconnecting",
            Self::Full => "full",
            Self::Gone => "gone",
            Self::Failed { .. } => "failed",
        }
    }
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Connecting => f.write_str("Connecting"),
            Self::Refining { percent } => write!(f, "Refining {percent} %"),
            Self::Settled { limited: false } => f.write_str("All detail shown"),
            Self::Settled { limited: true } => f.write_str("Settled at the triangle limit"),
            Self::Reconnecting => f.write_str("Connection lost, reconnecting"),
            Self::Full => f.write_str("The server is full, trying again"),
            Self::Gone => f.write_str("This model is no longer on the server"),
            Self::Failed { reason } => write!(f, "Stopped: {reason}"),
        }
    }
}

/// How far a refinement is. Errors fall geometrically with the ops that come, so it goes by their logarithm, or by the
/// triangles where a limit ends it; it never goes back while the view stays the same.
#[derive(Clone, Copy, Debug, Default)]
pub struct Progress {
    /// Error in pixels and triangles at the beginning.
    begin: Option<(f32, u32)>,
    percent: u8,
}

impl Progress {
    /// Another view is asked for.
    pub fn begin(&mut self) {
        *self = Self::default();
    }

    /// Notes an error in pixels and the triangles held, of which there may be `limit`, and returns the per cent.
    pub fn note(&mut self, error_px: Option<f32>, tolerance_px: f32, triangles: u32, limit: u32) -> u8 {
        let Some(error) = error_px.filter(|error| error.is_finite() && *error > 0.0) else { return self.percent };
        let &mut (first, first_triangles) = self.begin.get_or_insert((error, triangles));
        let least = tolerance_px.max(1e-2);
        let by_error = if first > least { (first / error).ln() / (first / least).ln() } else { 0.0 };
        let wanted = limit.saturating_sub(first_triangles);
        let by_triangles =
            if wanted == 0 { 0.0 } else { triangles.saturating_sub(first_triangles) as f32 / wanted as f32 };
        let share = by_error.max(by_triangles).clamp(0.0, 0.99);
        self.percent = self.percent.max((share * 100.0) as u8);
        self.percent
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn per_cents_rise_and_stop_short_of_the_end() {
        let mut progress = Progress::default();
        assert_eq!(progress.note(None, 1.0, 10, 1000), 0);
        assert_eq!(progress.note(Some(64.0), 1.0, 10, 100_000), 0);
        assert_eq!(progress.note(Some(8.0), 1.0, 50, 100_000), 50);
        assert_eq!(progress.note(Some(16.0), 1.0, 40, 100_000), 50, "it never goes back");
        assert_eq!(progress.note(Some(0.5), 1.0, 90_000, 100_000), 99);
        progress.begin();
        assert_eq!(progress.note(Some(100.0), 0.0, 0, 200), 0);
        assert_eq!(progress.note(Some(90.0), 0.0, 150, 200), 75, "the limit comes first");
        assert_eq!(progress.note(Some(f32::NAN), 0.0, 0, 0), 75);
    }
}
