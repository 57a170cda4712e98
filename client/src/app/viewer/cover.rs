//! What lies over the image at first: the picture of a page, which has no dark crevices. They come once it goes, little by little, so
//! that the model does not turn darker from one moment to the next.

use std::time::Duration;

use lodestream_protocol::time::Timestamp;

/// How long crevices take to be as dark as they get: the picture takes half of it to go.
const DARKENING: Duration = Duration::from_millis(600);
/// Share of their depth before: not to be seen, and what draws them is made before it is needed.
const TRACE: f32 = 0.004;

/// See the module.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Cover {
    /// Something lies over the image.
    On,
    /// It goes since then.
    Going(Timestamp),
    /// There is nothing, or there was nothing.
    Off,
}

impl Cover {
    /// Share of their depth that crevices have at `now`.
    pub(super) fn crevices(self, now: Timestamp) -> f32 {
        match self {
            Self::On => TRACE,
            Self::Going(since) => {
                let share = (now.since(since).as_secs_f32() / DARKENING.as_secs_f32()).min(1.0);
                (share * share * (3.0 - 2.0 * share)).max(TRACE)
            }
            Self::Off => 1.0,
        }
    }

    /// Whether the next image will differ for it. Forgets what is over.
    pub(super) fn is_going(&mut self, now: Timestamp) -> bool {
        if let Self::Going(since) = *self
            && now.since(since) >= DARKENING
        {
            *self = Self::Off;
        }
        matches!(self, Self::Going(_))
    }
}
