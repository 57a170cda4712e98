//! Recording the views of a person, and playing a recording: the file of [`recording`](crate::camera::recording).

use std::time::Duration;

use glam::DVec3;
use lodestream_protocol::time::Timestamp;

use crate::camera::navigate::Navigator;
use crate::camera::recording::{RecordedView, Recording, RecordingError, write_header, write_view};
use crate::camera::{Orbit, UpAxis};

/// Least time between two views of a recording.
const INTERVAL: Duration = Duration::from_millis(33);
/// Most views: an hour of motion.
const MAX_VIEWS: usize = 100_000;

/// Views as they go by.
#[derive(Debug)]
pub(super) struct Recorder {
    began: Timestamp,
    last: Option<Timestamp>,
    views: usize,
    text: Vec<u8>,
}

impl Recorder {
    pub(super) fn new(now: Timestamp) -> Self {
        let mut text = Vec::new();
        write_header(&mut text).expect("memory takes all");
        Self { began: now, last: None, views: 0, text }
    }

    /// Takes a view of a camera that moved, unless one was just taken.
    pub(super) fn note(&mut self, now: Timestamp, navigator: &Navigator, tolerance_px: f32) {
        if self.last.is_some_and(|last| now.since(last) < INTERVAL) || self.views >= MAX_VIEWS {
            return;
        }
        self.last = Some(now);
        self.views += 1;
        let orbit = navigator.orbit();
        let view = RecordedView {
            time_s: now.since(self.began).as_secs_f64(),
            eye: orbit.eye().to_array(),
            target: orbit.target.to_array(),
            fov_deg: navigator.fov_y_rad().to_degrees(),
            tolerance_px: Some(tolerance_px),
        };
        write_view(&mut self.text, &view).expect("memory takes all");
    }

    /// The file, which ends with the view at `now`.
    pub(super) fn finish(mut self, now: Timestamp, navigator: Option<&Navigator>, tolerance_px: f32) -> Vec<u8> {
        self.last = None;
        if let Some(navigator) = navigator {
            self.note(now, navigator, tolerance_px);
        }
        self.text
    }
}

/// A recording that is played.
#[derive(Debug)]
pub(super) struct Player {
    recording: Recording,
    began: Timestamp,
    /// View played last.
    index: usize,
}

impl Player {
    /// # Errors
    /// [`RecordingError`].
    pub(super) fn new(now: Timestamp, file: &[u8]) -> Result<Self, RecordingError> {
        Ok(Self { recording: Recording::read(file)?, began: now, index: 0 })
    }

    /// The pose at `now`, between the two views around it, and whether it is the last.
    pub(super) fn pose(&mut self, now: Timestamp) -> (Orbit, f32, bool) {
        let views = self.recording.views();
        let elapsed = now.since(self.began).as_secs_f64() + views[0].time_s;
        while self.index + 1 < views.len() && views[self.index + 1].time_s <= elapsed {
            self.index += 1;
        }
        let (view, next) = (&views[self.index], views.get(self.index + 1));
        let from = orbit_of(view);
        let Some(next) = next else { return (from, view.fov_deg.to_radians(), true) };
        let length = next.time_s - view.time_s;
        let share = if length > 0.0 { ((elapsed - view.time_s) / length).clamp(0.0, 1.0) } else { 0.0 };
        // Jumps stay jumps: what took long to come was not on the way.
        let share = if length > 1.0 { 0.0 } else { share };
        (from.towards(&orbit_of(next), share), view.fov_deg.to_radians(), false)
    }
}

fn orbit_of(view: &RecordedView) -> Orbit {
    let (eye, target) = (DVec3::from_array(view.eye), DVec3::from_array(view.target));
    Orbit::from_direction(target, eye - target, eye.distance(target), UpAxis::Y)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Bounds, Viewport};

    #[test]
    fn what_was_recorded_plays_the_same_way() {
        let at = |ms| Timestamp(Duration::from_millis(ms));
        let bounds = Bounds { center: DVec3::ZERO, radius: 2.0 };
        let mut navigator = Navigator::new(bounds, Viewport { width_px: 800, height_px: 600 }, 0.8);
        let mut recorder = Recorder::new(at(1000));
        let mut eyes = Vec::new();
        for ms in (1000..2000).step_by(10) {
            navigator.drag(at(ms), 3.0, 1.0);
            recorder.note(at(ms), &navigator, 1.0);
            eyes.push((ms, navigator.orbit().eye()));
        }
        let file = recorder.finish(at(1990), Some(&navigator), 1.0);
        let mut player = Player::new(at(50_000), &file).unwrap();
        let mut is_last = false;
        for (ms, eye) in eyes {
            let (orbit, fov, last) = player.pose(at(49_000 + ms));
            assert!(orbit.eye().distance(eye) < 0.12, "at {ms}: {} {eye}", orbit.eye());
            assert!((fov - 0.8).abs() < 1e-6);
            is_last = last;
        }
        assert!(is_last);
        assert!(Player::new(at(0), b"nothing").is_err());
    }
}
