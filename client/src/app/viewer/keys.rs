//! What keys do, by the names that browsers and winit share (`KeyboardEvent.code`).

use glam::DVec3;

use super::command::{Command, Tool};
use crate::camera::navigate::StandardView;

/// What a key means.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum KeyAction {
    /// Moves while it is held: right, up, back.
    Thrust(DVec3),
    /// Turns by points (as a drag would) to the right and down.
    Turn([f64; 2]),
    /// Moves the picture likewise; with a shift key.
    Pan([f64; 2]),
    /// Zooms by a factor.
    Zoom(f64),
    /// Does what a button does.
    Do(Command),
    /// Switches between parallel rays and a pinhole.
    ToggleOrthographic,
    /// Freezes the view that is asked for, or lets it follow the camera again.
    ToggleFrozen,
    /// Switches a tool on, or off if it is on.
    Toggle(Tool),
}

/// Points that a press of an arrow key turns or moves.
const STEP: f64 = 40.0;
const ZOOM_STEP: f64 = 0.8;

pub(super) fn action(code: &str, shift: bool) -> Option<KeyAction> {
    use KeyAction::*;
    let arrow = |x: f64, y: f64| Some(if shift { Pan([STEP * x, STEP * y]) } else { Turn([STEP * x, STEP * y]) });
    let view = |view| Some(Do(Command::View(view)));
    match code {
        "KeyW" => Some(Thrust(DVec3::NEG_Z)),
        "KeyS" => Some(Thrust(DVec3::Z)),
        "KeyA" => Some(Thrust(DVec3::NEG_X)),
        "KeyD" => Some(Thrust(DVec3::X)),
        "KeyE" => Some(Thrust(DVec3::Y)),
        "KeyQ" => Some(Thrust(DVec3::NEG_Y)),
        "ArrowLeft" => arrow(-1.0, 0.0),
        "ArrowRight" => arrow(1.0, 0.0),
        "ArrowUp" => arrow(0.0, -1.0),
        "ArrowDown" => arrow(0.0, 1.0),
        "Equal" | "NumpadAdd" | "BracketRight" => Some(Zoom(ZOOM_STEP)),
        "Minus" | "NumpadSubtract" | "Slash" => Some(Zoom(1.0 / ZOOM_STEP)),
        "KeyF" => Some(Do(Command::Fit)),
        "KeyH" | "Digit0" => view(StandardView::Home),
        "Digit1" => view(StandardView::Front),
        "Digit2" => view(StandardView::Back),
        "Digit3" => view(StandardView::Left),
        "Digit4" => view(StandardView::Right),
        "Digit5" => view(StandardView::Top),
        "Digit6" => view(StandardView::Bottom),
        "Digit7" => view(StandardView::Iso),
        "KeyO" => Some(ToggleOrthographic),
        "KeyV" => Some(ToggleFrozen),
        "KeyM" => Some(Toggle(Tool::Measure)),
        "KeyG" => Some(Toggle(Tool::Fly)),
        "Escape" => Some(Do(Command::ClearMarks)),
        _ => None,
    }
}
