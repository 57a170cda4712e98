//! Pointers, wheel and keys, and what they do to the camera.

use std::time::Duration;

use glam::DVec3;
use lodestream_protocol::time::Timestamp;

use super::Viewer;
use super::command::{Command, Tool};
use super::keys::{self, KeyAction};
use crate::camera::gesture::{Gesture, Press};
use crate::camera::navigate::Navigator;

/// Pixels of a wheel for a factor e.
const WHEEL_PX: f64 = 500.0;
/// How long a point under a resting cursor is good for.
const ANCHOR_KEPT: Duration = Duration::from_millis(400);

impl Viewer {
    /// A pointer goes down, at pixels of the image.
    pub fn press(&mut self, now: Timestamp, id: i32, press: Press, at_px: [f64; 2]) {
        self.stop_player();
        if let Some(navigator) = &mut self.navigator {
            navigator.stop();
        }
        self.pointers.press(now, id, press, at_px);
    }

    /// A pointer moves.
    pub fn motion(&mut self, now: Timestamp, id: i32, at_px: [f64; 2]) {
        for gesture in self.pointers.motion(id, at_px) {
            self.handle_gesture(now, gesture);
        }
    }

    /// A pointer goes up.
    pub fn release(&mut self, now: Timestamp, id: i32) {
        if let Some(gesture) = self.pointers.release(now, id) {
            self.handle_gesture(now, gesture);
        }
    }

    /// Pointers and keys are lost: another window has them.
    pub fn cancel(&mut self, now: Timestamp) {
        self.pointers.cancel();
        self.held.clear();
        self.apply_thrust(now);
    }

    /// A wheel turned by so many pixels, positive towards the person, who moves away then.
    pub fn wheel(&mut self, now: Timestamp, at_px: [f64; 2], down_px: f64) {
        self.stop_player();
        let anchor = self.anchor(now, at_px);
        if let Some((navigator, anchor)) = self.navigator.as_mut().zip(anchor) {
            navigator.zoom(now, anchor, (down_px.clamp(-1000.0, 1000.0) / WHEEL_PX).exp());
        }
    }

    /// A key goes down or up, by its name in browsers (`KeyboardEvent.code`). Says whether it means something here.
    pub fn key(&mut self, now: Timestamp, code: &str, is_down: bool, shift: bool) -> bool {
        let Some(action) = keys::action(code, shift) else { return false };
        if let KeyAction::Thrust(direction) = action {
            self.held.retain(|(held, _)| held != code);
            if is_down {
                self.stop_player();
                self.held.push((code.to_owned(), direction));
            }
            self.apply_thrust(now);
            return true;
        }
        if !is_down {
            return true;
        }
        let step = self.options.pixels_per_point;
        match action {
            KeyAction::Do(command) => self.command(now, command),
            KeyAction::ToggleOrthographic => {
                let is_on = self.navigator.as_ref().is_some_and(Navigator::is_orthographic);
                self.command(now, Command::Orthographic(!is_on));
            }
            KeyAction::ToggleFrozen => self.command(now, Command::Freeze(self.frozen.is_none())),
            KeyAction::Toggle(tool) => {
                self.command(now, Command::Tool(if self.tool == tool { Tool::Look } else { tool }));
            }
            KeyAction::Turn([x, y]) => self.handle_gesture(now, Gesture::Turn { by_px: [x * step, y * step] }),
            KeyAction::Pan([x, y]) => self.handle_gesture(now, Gesture::Pan { by_px: [x * step, y * step] }),
            KeyAction::Zoom(factor) => {
                if let Some(navigator) = &mut self.navigator {
                    let target = navigator.orbit().target;
                    navigator.zoom(now, target, factor);
                }
            }
            KeyAction::Thrust(_) => unreachable!("handled above"),
        }
        true
    }

    fn handle_gesture(&mut self, now: Timestamp, gesture: Gesture) {
        let is_flying = self.tool == Tool::Fly;
        let Some(navigator) = &mut self.navigator else { return };
        match gesture {
            Gesture::Turn { by_px: [x, y] } if is_flying => navigator.look(x, y),
            Gesture::Turn { by_px: [x, y] } => navigator.drag(now, x, y),
            Gesture::Release if is_flying => {}
            Gesture::Release => navigator.release(now),
            Gesture::Pan { by_px: [x, y] } => navigator.pan(x, y),
            Gesture::Pinch { center_px, factor, clockwise_rad } => {
                navigator.twist(clockwise_rad);
                if let Some(anchor) = self.anchor(now, center_px)
                    && let Some(navigator) = &mut self.navigator
                {
                    navigator.pinch(anchor, 1.0 / factor);
                }
            }
            Gesture::Tap { at_px } if self.tool == Tool::Measure => self.pick(now, at_px),
            Gesture::Tap { .. } => {}
            Gesture::DoubleTap { at_px } if self.tool == Tool::Measure => self.pick(now, at_px),
            Gesture::DoubleTap { at_px } => self.command(now, Command::Focus(at_px)),
        }
    }

    fn apply_thrust(&mut self, now: Timestamp) {
        let thrust = self.held.iter().map(|(_, direction)| *direction).sum();
        if let Some(navigator) = &mut self.navigator {
            navigator.set_thrust(now, thrust);
        }
    }

    /// The point of the surface under a pixel, or of the plane through the target where there is none.
    fn anchor(&mut self, now: Timestamp, at_px: [f64; 2]) -> Option<DVec3> {
        let reach = 8.0 * self.options.pixels_per_point;
        if let Some((where_px, when, point)) = self.anchor
            && now.since(when) < ANCHOR_KEPT
            && (0..2).all(|k| (where_px[k] - at_px[k]).abs() < reach)
        {
            self.anchor = Some((at_px, now, point));
            return Some(point);
        }
        let navigator = self.navigator.as_ref()?;
        let camera = navigator.camera();
        let point = self.surface_at(at_px).or_else(|| {
            let ray = camera.ray(self.options.viewport, at_px);
            let ahead = ray.direction.dot(camera.forward());
            let depth = (navigator.orbit().target - ray.origin).dot(camera.forward());
            (ahead > 0.0 && depth > 0.0).then(|| ray.at(depth / ahead))
        })?;
        self.anchor = Some((at_px, now, point));
        Some(point)
    }
}
