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

/// How far a refinement is, as far as a client can tell: the server does not say how much is to come, so it goes by the
/// triangles that the last settled view had, or by a guess for the first. It never goes back while the view stays the same.
#[derive(Clone, Copy, Debug, Default)]
pub struct Progress {
    /// Triangles at the beginning.
    begin: Option<u32>,
    percent: u8,
    /// Triangles of the last view that settled.
    settled: Option<u32>,
}

/// Pixels of an image for each triangle that a view of a whole scan ends up with at a tolerance of a pixel, about.
const PIXELS_PER_TRIANGLE: f32 = 60.0;

/// What a view of so many pixels will need, if nothing is known yet.
pub fn guess(pixels: u64, tolerance_px: f32) -> u32 {
    (pixels as f32 / PIXELS_PER_TRIANGLE / tolerance_px.max(0.1)) as u32
}

impl Progress {
    /// Another view is asked for.
    pub fn begin(&mut self) {
        *self = Self { settled: self.settled, ..Self::default() };
    }

    /// The view is settled with so many triangles.
    pub fn settle(&mut self, triangles: u32) {
        self.settled = Some(triangles);
    }

    /// Notes the triangles held; `guess` are expected if no view has settled yet, and no more than `most`. Returns the per
    /// cent, from 0 to 99.
    pub fn note(&mut self, triangles: u32, guess: u32, most: u32) -> u8 {
        let first = *self.begin.get_or_insert(triangles);
        let wanted = self.settled.unwrap_or(guess).min(most).saturating_sub(first);
        if wanted > 0 {
            let share = triangles.saturating_sub(first) as f32 / wanted as f32;
            self.percent = self.percent.max((share.min(0.99) * 100.0) as u8);
        }
        self.percent
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn per_cents_rise_and_stop_short_of_the_end() {
        let mut progress = Progress::default();
        assert_eq!(progress.note(20, 10_020, 1_000_000), 0);
        assert_eq!(progress.note(5_020, 10_020, 1_000_000), 50);
        assert_eq!(progress.note(4_000, 10_020, 1_000_000), 50, "it never goes back");
        assert_eq!(progress.note(90_000, 10_020, 1_000_000), 99);
        progress.settle(90_000);
        progress.begin();
        assert_eq!(progress.note(10_000, 1, 1_000_000), 0);
        assert_eq!(progress.note(30_000, 1, 1_000_000), 25, "the last view knows better than the guess");
        progress.begin();
        assert_eq!(progress.note(10_000, 1, 30_000), 0);
        assert_eq!(progress.note(20_000, 1, 30_000), 50, "there will not be more than the limit");
        progress.begin();
        assert_eq!(progress.note(95_000, 1, 1_000_000), 0, "nothing is expected to come");
        assert_eq!(guess(1280 * 800, 1.0), 17_066);
    }
}
