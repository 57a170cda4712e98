//! Fingers and buttons to gestures: what a press, some moves and a release mean.
//!
//! One finger or the left button turns, two fingers or another button move, pinch and twist, a short touch is a tap. It
//! knows pixels and times, no camera.

use std::time::Duration;

use lodestream_protocol::time::Timestamp;

/// A pointer that stays within so many points (pixels at a pixel ratio of 1) taps; one that goes farther drags.
const TAP_POINTS: f64 = 5.0;
/// A longer press is no tap.
const TAP: Duration = Duration::from_millis(400);
/// A second tap within this time and distance makes two.
const DOUBLE_TAP: Duration = Duration::from_millis(350);
const DOUBLE_TAP_POINTS: f64 = 24.0;
/// Fingers that count.
const MAX_FINGERS: usize = 2;

/// What pressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Press {
    /// A finger, or the left button.
    Primary,
    /// The middle or right button, or the left one with a key held.
    Secondary,
}

/// What a pointer's event means. Lengths in pixels to the right and down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Gesture {
    /// Turn.
    Turn {
        /// To the right and down.
        by_px: [f64; 2],
    },
    /// The turn ended.
    Release,
    /// Move along.
    Pan {
        /// To the right and down.
        by_px: [f64; 2],
    },
    /// Two fingers: things get larger by `factor` around `center_px` and turn clockwise.
    Pinch {
        /// Between the fingers.
        center_px: [f64; 2],
        /// Of the distance of the fingers.
        factor: f64,
        /// Angle of the line between the fingers.
        clockwise_rad: f64,
    },
    /// A short touch.
    Tap {
        /// Where.
        at_px: [f64; 2],
    },
    /// The second of two short touches.
    DoubleTap {
        /// Where.
        at_px: [f64; 2],
    },
}

#[derive(Clone, Copy, Debug)]
struct Pointer {
    id: i32,
    press: Press,
    at: [f64; 2],
    began: Timestamp,
    began_at: [f64; 2],
    is_tap: bool,
}

/// The pointers that are down.
#[derive(Clone, Debug)]
pub struct Pointers {
    pixels_per_point: f64,
    down: Vec<Pointer>,
    last_tap: Option<(Timestamp, [f64; 2])>,
    is_turning: bool,
}

impl Pointers {
    /// Nothing is pressed.
    pub fn new(pixels_per_point: f64) -> Self {
        Self { pixels_per_point, down: Vec::new(), last_tap: None, is_turning: false }
    }

    /// The screen's pixel ratio changed.
    pub fn set_pixels_per_point(&mut self, pixels_per_point: f64) {
        self.pixels_per_point = pixels_per_point;
    }

    /// A pointer goes down.
    pub fn press(&mut self, now: Timestamp, id: i32, press: Press, at: [f64; 2]) {
        self.down.retain(|pointer| pointer.id != id);
        if self.down.len() < MAX_FINGERS {
            self.down.push(Pointer { id, press, at, began: now, began_at: at, is_tap: self.down.is_empty() });
        }
        if self.down.len() > 1 {
            self.down.iter_mut().for_each(|pointer| pointer.is_tap = false);
        }
    }

    /// A pointer moves. Returns what follows: at most two gestures.
    pub fn motion(&mut self, id: i32, at: [f64; 2]) -> Vec<Gesture> {
        let reach = TAP_POINTS * self.pixels_per_point;
        let Some(index) = self.down.iter().position(|pointer| pointer.id == id) else { return Vec::new() };
        let pointer = self.down[index];
        if pointer.is_tap && distance(at, pointer.began_at) < reach {
            return Vec::new();
        }
        let by_px = minus(at, pointer.at);
        self.down[index].at = at;
        self.down[index].is_tap = false;
        if let [one, other] = self.down[..] {
            let (moved, fixed) = if index == 0 { (one, other) } else { (other, one) };
            let (before, after) = (minus(pointer.at, fixed.at), minus(moved.at, fixed.at));
            let half = [by_px[0] / 2.0, by_px[1] / 2.0];
            let center_px = [(moved.at[0] + fixed.at[0]) / 2.0, (moved.at[1] + fixed.at[1]) / 2.0];
            let (long, short) = (distance(after, [0.0; 2]), distance(before, [0.0; 2]));
            let mut gestures = vec![Gesture::Pan { by_px: half }];
            if long > reach && short > reach {
                let angle = after[1].atan2(after[0]) - before[1].atan2(before[0]);
                let clockwise_rad =
                    (angle + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU) - std::f64::consts::PI;
                gestures.push(Gesture::Pinch { center_px, factor: long / short, clockwise_rad });
            }
            return gestures;
        }
        match pointer.press {
            Press::Primary => {
                self.is_turning = true;
                vec![Gesture::Turn { by_px }]
            }
            Press::Secondary => vec![Gesture::Pan { by_px }],
        }
    }

    /// A pointer goes up.
    pub fn release(&mut self, now: Timestamp, id: i32) -> Option<Gesture> {
        let index = self.down.iter().position(|pointer| pointer.id == id)?;
        let pointer = self.down.remove(index);
        if pointer.is_tap && pointer.press == Press::Primary && now.since(pointer.began) <= TAP {
            let reach = DOUBLE_TAP_POINTS * self.pixels_per_point;
            let is_second = self
                .last_tap
                .take()
                .is_some_and(|(when, at)| now.since(when) <= DOUBLE_TAP && distance(at, pointer.at) < reach);
            if is_second {
                return Some(Gesture::DoubleTap { at_px: pointer.at });
            }
            self.last_tap = Some((now, pointer.at));
            return Some(Gesture::Tap { at_px: pointer.at });
        }
        // After two fingers the one that stays does not fling.
        let was_turning = std::mem::take(&mut self.is_turning);
        (was_turning && self.down.is_empty()).then_some(Gesture::Release)
    }

    /// Everything is up: the window lost the pointers.
    pub fn cancel(&mut self) {
        self.down.clear();
        self.is_turning = false;
    }
}

fn minus(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [a[0] - b[0], a[1] - b[1]]
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    let [x, y] = minus(a, b);
    x.hypot(y)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Timestamp {
        Timestamp(Duration::from_millis(ms))
    }

    #[test]
    fn short_touches_tap_and_long_ones_drag() {
        let mut pointers = Pointers::new(2.0);
        pointers.press(at(0), 1, Press::Primary, [10.0, 10.0]);
        assert_eq!(pointers.motion(1, [15.0, 12.0]), [], "a trembling hand");
        assert_eq!(pointers.release(at(100), 1), Some(Gesture::Tap { at_px: [10.0, 10.0] }));
        pointers.press(at(200), 1, Press::Primary, [20.0, 10.0]);
        assert_eq!(pointers.release(at(300), 1), Some(Gesture::DoubleTap { at_px: [20.0, 10.0] }));
        pointers.press(at(310), 1, Press::Primary, [20.0, 10.0]);
        assert_eq!(pointers.release(at(330), 1), Some(Gesture::Tap { at_px: [20.0, 10.0] }), "a third is a first");
        pointers.press(at(5000), 1, Press::Primary, [20.0, 10.0]);
        assert_eq!(pointers.release(at(6000), 1), None, "too long");
        pointers.press(at(7000), 1, Press::Primary, [0.0, 0.0]);
        assert_eq!(pointers.motion(1, [30.0, 0.0]), [Gesture::Turn { by_px: [30.0, 0.0] }]);
        assert_eq!(pointers.motion(1, [30.0, 5.0]), [Gesture::Turn { by_px: [0.0, 5.0] }]);
        assert_eq!(pointers.release(at(7100), 1), Some(Gesture::Release));
        pointers.press(at(8000), 1, Press::Secondary, [0.0, 0.0]);
        assert_eq!(pointers.motion(1, [30.0, 1.0]), [Gesture::Pan { by_px: [30.0, 1.0] }]);
        assert_eq!(pointers.release(at(8100), 1), None);
        assert_eq!(pointers.motion(1, [90.0, 1.0]), [], "nothing is down");
    }

    #[test]
    fn two_fingers_move_pinch_and_twist() {
        let mut pointers = Pointers::new(1.0);
        pointers.press(at(0), 1, Press::Primary, [100.0, 100.0]);
        pointers.press(at(10), 2, Press::Primary, [200.0, 100.0]);
        pointers.press(at(20), 3, Press::Primary, [0.0, 0.0]);
        assert_eq!(pointers.motion(3, [50.0, 0.0]), [], "two are enough");
        let gestures = pointers.motion(2, [300.0, 100.0]);
        assert_eq!(gestures[0], Gesture::Pan { by_px: [50.0, 0.0] });
        assert_eq!(gestures[1], Gesture::Pinch { center_px: [200.0, 100.0], factor: 2.0, clockwise_rad: 0.0 });
        let Gesture::Pinch { factor, clockwise_rad, .. } = pointers.motion(2, [100.0, 300.0])[1] else { panic!() };
        assert!((factor - 1.0).abs() < 1e-12 && (clockwise_rad - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
        assert_eq!(pointers.release(at(50), 1), None);
        assert_eq!(pointers.motion(2, [110.0, 300.0]), [Gesture::Turn { by_px: [10.0, 0.0] }]);
        assert_eq!(pointers.release(at(60), 2), Some(Gesture::Release));
    }
}
