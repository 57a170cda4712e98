//! How a person moves: orbit with inertia, pan, zoom to a point, fly, smooth ways to named views.
//!
//! A [`Navigator`] turns commands and the time into a [`Camera`]. It has no clock: [`Navigator::advance`] is told the time
//! and says whether the camera moved. It knows the model's ball and the image, not the mesh: whoever has the mesh says
//! which point lies under the cursor.

use std::time::Duration;

use glam::DVec3;
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::Projection;

use super::{Bounds, Camera, DEFAULT_DIRECTION, Orbit, UpAxis, Viewport, fov_y_of};

/// Turn for a drag over the height of the image.
const DRAG_RAD: f64 = std::f64::consts::PI;
/// Time in which a turn that was let go slows down by a factor e.
const GLIDE_S: f64 = 0.18;
/// Slower turns stand still, in radians per second.
const STILL_RAD_PER_S: f64 = 0.02;
/// Drags within this time before letting go make the speed.
const FLING: Duration = Duration::from_millis(80);
/// Time in which a zoom that was asked for does all but 1/e of what is left.
const ZOOM_S: f64 = 0.05;
/// Less is done at once, as a logarithm.
const ZOOM_DONE: f64 = 1e-3;
/// How long the way to a named view takes.
const FLIGHT: Duration = Duration::from_millis(450);
/// Speed of flying, in distances to the target per second.
const FLY_PER_S: f64 = 0.8;
/// Time in which flying gets to all but 1/e of its speed.
const THRUST_S: f64 = 0.08;
/// Longest step that is computed at once: after a pause the camera does not leap.
const LONGEST_STEP_S: f64 = 0.1;
/// Nearest and farthest distance to the target, in radii of the model.
const NEAREST_RADII: f64 = 1e-5;
const FARTHEST_RADII: f64 = 100.0;
/// Share of the distance that is left after focusing on a point.
const FOCUS_ZOOM: f64 = 0.5;

/// Views by name, relative to the up axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StandardView {
    /// Along the axis towards the viewer (+z with y up).
    Front,
    /// From the other side.
    Back,
    /// From the left.
    Left,
    /// From the right.
    Right,
    /// From above.
    Top,
    /// From below.
    Bottom,
    /// From the corner between front, right and top.
    Iso,
    /// The first view: [`DEFAULT_DIRECTION`].
    Home,
}

impl StandardView {
    /// All of them.
    pub const ALL: [Self; 8] = {
        use StandardView::*;
        [Front, Back, Left, Right, Top, Bottom, Iso, Home]
    };

    /// Name in commands.
    pub fn name(self) -> &'static str {
        match self {
            Self::Front => "front",
            Self::Back => "back",
            Self::Left => "left",
            Self::Right => "right",
            Self::Top => "top",
            Self::Bottom => "bottom",
            Self::Iso => "iso",
            Self::Home => "home",
        }
    }

    /// From the model to the camera, as if y were up.
    fn direction(self) -> DVec3 {
        match self {
            Self::Front => DVec3::Z,
            Self::Back => DVec3::NEG_Z,
            Self::Left => DVec3::NEG_X,
            Self::Right => DVec3::X,
            Self::Top => DVec3::Y,
            Self::Bottom => DVec3::NEG_Y,
            Self::Iso => DVec3::ONE,
            Self::Home => DEFAULT_DIRECTION,
        }
    }
}

/// A drag that may go on by itself.
#[derive(Clone, Copy, Debug)]
struct Drag {
    at: Timestamp,
    yaw_rad: f64,
    pitch_rad: f64,
}

/// What moves the camera when nobody touches it.
#[derive(Clone, Copy, Debug)]
enum Motion {
    Still,
    /// Turning on, in radians per second.
    Glide {
        yaw: f64,
        pitch: f64,
    },
    /// On the way to a pose.
    Flight {
        from: Orbit,
        to: Orbit,
        began: Timestamp,
    },
}

/// Camera control. See the module.
#[derive(Clone, Debug)]
pub struct Navigator {
    bounds: Bounds,
    viewport: Viewport,
    orbit: Orbit,
    /// Opening angle of the image's narrower side.
    fov_rad: f32,
    is_orthographic: bool,
    motion: Motion,
    /// Drags of the last [`FLING`].
    drags: Vec<Drag>,
    /// Anchor and logarithm of the factor that is still to come.
    zoom: Option<(DVec3, f64)>,
    /// Wanted and present velocity in the camera's axes, in distances per second.
    thrust: DVec3,
    velocity: DVec3,
    last: Timestamp,
    /// Whether something moved since [`advance`](Self::advance) last said so.
    moved: bool,
}

impl Navigator {
    /// Sees the whole model from [`DEFAULT_DIRECTION`], through a lens that opens the narrower side of the image by `fov_rad`.
    pub fn new(bounds: Bounds, viewport: Viewport, fov_rad: f32) -> Self {
        let mut navigator = Self {
            bounds,
            viewport,
            orbit: Orbit::around(&bounds, bounds.radius),
            fov_rad,
            is_orthographic: false,
            motion: Motion::Still,
            drags: Vec::new(),
            zoom: None,
            thrust: DVec3::ZERO,
            velocity: DVec3::ZERO,
            last: Timestamp::default(),
            moved: true,
        };
        navigator.orbit = navigator.framing(DEFAULT_DIRECTION);
        navigator
    }

    /// The camera as it is now.
    pub fn camera(&self) -> Camera {
        let mut camera = Camera::perspective(self.fov_y_rad());
        self.orbit.pose(&mut camera);
        if self.is_orthographic {
            camera.projection = Projection::Orthographic { height: self.orthographic_height() };
            // Parallel rays have no eye: it goes back until nothing of the model is behind it.
            let back = camera.orientation * DVec3::Z;
            let behind = (self.bounds.center - camera.eye).dot(back) + 1.5 * self.bounds.radius;
            camera.eye += back * behind.max(0.0);
        }
        camera.fit_near(&self.bounds);
        camera
    }

    /// The pose behind the camera.
    pub fn orbit(&self) -> &Orbit {
        &self.orbit
    }

    /// Opening angle of the image's narrower side in radians.
    pub fn fov_rad(&self) -> f32 {
        self.fov_rad
    }

    /// Vertical opening angle in radians: wider than [`fov_rad`](Self::fov_rad) in an image that is higher than wide.
    pub fn fov_y_rad(&self) -> f32 {
        fov_y_of(self.fov_rad, self.viewport.aspect())
    }

    /// Whether rays are parallel.
    pub fn is_orthographic(&self) -> bool {
        self.is_orthographic
    }

    /// Pixels of the image.
    pub fn viewport(&self) -> Viewport {
        self.viewport
    }

    /// Whether the camera moves by itself or is being dragged, so that [`advance`](Self::advance) should be called again soon.
    pub fn is_moving(&self) -> bool {
        !matches!(self.motion, Motion::Still)
            || self.zoom.is_some()
            || self.thrust != DVec3::ZERO
            || self.velocity != DVec3::ZERO
    }

    /// The image has another size.
    pub fn set_viewport(&mut self, viewport: Viewport) {
        self.moved |= self.viewport != viewport;
        self.viewport = viewport;
    }

    /// Sets a pose at once, as from a link; `fov_rad` is of the image's narrower side.
    pub fn set_pose(&mut self, orbit: Orbit, fov_rad: f32, is_orthographic: bool) {
        self.stop();
        self.orbit = orbit;
        self.fov_rad = fov_rad;
        self.is_orthographic = is_orthographic;
        self.moved = true;
    }

    /// Parallel rays or a pinhole; what is at the target's distance keeps its size.
    pub fn set_orthographic(&mut self, is_orthographic: bool) {
        self.moved |= self.is_orthographic != is_orthographic;
        self.is_orthographic = is_orthographic;
    }

    /// Another axis is up.
    pub fn set_up(&mut self, now: Timestamp, up: UpAxis) {
        if self.orbit.up() != up {
            let mut to = self.orbit;
            to.set_up(up);
            self.fly_to(now, to);
        }
    }

    /// Turns around the target by a drag in pixels, to the right and down.
    pub fn drag(&mut self, now: Timestamp, right_px: f64, down_px: f64) {
        self.stop_motion();
        let scale = DRAG_RAD / f64::from(self.viewport.height_px.max(1));
        let (yaw_rad, pitch_rad) = (-right_px * scale, down_px * scale);
        self.orbit.rotate(yaw_rad, pitch_rad);
        self.drags.retain(|drag| now.since(drag.at) <= FLING);
        self.drags.push(Drag { at: now, yaw_rad, pitch_rad });
        self.moved = true;
    }

    /// The drag ends: the turn goes on if it was under way.
    pub fn release(&mut self, now: Timestamp) {
        self.drags.retain(|drag| now.since(drag.at) <= FLING);
        if self.drags.len() >= 2 {
            let sum = |angle: fn(&Drag) -> f64| self.drags.iter().map(angle).sum::<f64>() / FLING.as_secs_f64();
            self.motion = Motion::Glide { yaw: sum(|drag| drag.yaw_rad), pitch: sum(|drag| drag.pitch_rad) };
            self.last = now;
        }
        self.drags.clear();
    }

    /// Looks around by a drag in pixels, the eye staying where it is.
    pub fn look(&mut self, right_px: f64, down_px: f64) {
        self.stop_motion();
        let scale = f64::from(self.fov_y_rad()) / f64::from(self.viewport.height_px.max(1));
        self.orbit.look(right_px * scale, -down_px * scale);
        self.moved = true;
    }

    /// Moves the model with the pointer: what is at the target's depth stays under it.
    pub fn pan(&mut self, right_px: f64, down_px: f64) {
        self.stop_motion();
        let units = self.orthographic_height() / f64::from(self.viewport.height_px.max(1));
        self.orbit.pan(-right_px * units, down_px * units);
        self.moved = true;
    }

    /// Turns the picture by an angle, clockwise.
    pub fn twist(&mut self, clockwise_rad: f64) {
        self.stop_motion();
        self.orbit.roll(clockwise_rad);
        self.moved = true;
    }

    /// Zooms at once (a pinch): distances shrink by `factor`, `anchor` stays where it is in the picture.
    pub fn pinch(&mut self, anchor: DVec3, factor: f64) {
        self.stop_motion();
        self.zoom = None;
        self.zoom_by(anchor, factor);
    }

    /// Zooms smoothly (a wheel), on top of what is still to come.
    pub fn zoom(&mut self, now: Timestamp, anchor: DVec3, factor: f64) {
        if !(factor.is_finite() && factor > 0.0) {
            return;
        }
        self.stop_motion();
        let before = self.zoom.map_or_else(
            || {
                self.last = now;
                0.0
            },
            |(_, left)| left,
        );
        self.zoom = Some((anchor, (before + factor.ln()).clamp(-5.0, 5.0)));
    }

    /// Keys or sticks: right, up, back in the camera's axes, each from -1 to 1. Zero stops.
    pub fn set_thrust(&mut self, now: Timestamp, thrust: DVec3) {
        if thrust != DVec3::ZERO {
            self.stop_motion();
        }
        if !self.is_moving() {
            self.last = now;
        }
        self.thrust = thrust.clamp(DVec3::NEG_ONE, DVec3::ONE);
    }

    /// Goes to where the whole model is seen, from the side it is seen from now.
    pub fn fit(&mut self, now: Timestamp) {
        let back = self.orbit.rotation() * DVec3::Z;
        let mut to = Orbit::of_rotation(self.orbit.rotation(), self.bounds.center, 1.0, self.orbit.up());
        to.zoom(self.framing_distance(back), 0.0);
        self.fly_to(now, to);
    }

    /// Goes to a named view of the whole model.
    pub fn standard(&mut self, now: Timestamp, view: StandardView) {
        self.fly_to(now, self.framing(view.direction()));
    }

    /// Goes to where a point is in the middle, nearer than now.
    pub fn focus(&mut self, now: Timestamp, point: DVec3) {
        let mut to = self.orbit;
        let depth = (point - to.eye()).length();
        to.target = point;
        to.zoom(FOCUS_ZOOM * depth.min(to.distance()) / to.distance(), NEAREST_RADII * self.bounds.radius);
        self.fly_to(now, to);
    }

    /// Whatever moves by itself stops here.
    pub fn stop(&mut self) {
        self.stop_motion();
        self.zoom = None;
        (self.thrust, self.velocity) = (DVec3::ZERO, DVec3::ZERO);
    }

    /// Goes on to `now` and says whether the camera moved since the last call.
    pub fn advance(&mut self, now: Timestamp) -> bool {
        let step = now.since(self.last).as_secs_f64().min(LONGEST_STEP_S);
        self.last = now;
        match self.motion {
            Motion::Still => {}
            Motion::Glide { yaw, pitch } => {
                // The exact way of an exponential, so that the rate of images makes no difference.
                let left = (-step / GLIDE_S).exp();
                let way = GLIDE_S * (1.0 - left);
                self.orbit.rotate(yaw * way, pitch * way);
                let (yaw, pitch) = (yaw * left, pitch * left);
                let is_still = yaw.hypot(pitch) < STILL_RAD_PER_S;
                self.motion = if is_still { Motion::Still } else { Motion::Glide { yaw, pitch } };
                self.moved = true;
            }
            Motion::Flight { from, to, began } => {
                let share = (now.since(began).as_secs_f64() / FLIGHT.as_secs_f64()).min(1.0);
                self.orbit = if share < 1.0 { from.towards(&to, share * share * (3.0 - 2.0 * share)) } else { to };
                self.motion = if share < 1.0 { self.motion } else { Motion::Still };
                self.moved = true;
            }
        }
        if let Some((anchor, left)) = self.zoom {
            let done = if left.abs() < ZOOM_DONE { left } else { left * (1.0 - (-step / ZOOM_S).exp()) };
            self.zoom = (done != left).then_some((anchor, left - done));
            self.zoom_by(anchor, done.exp());
        }
        if self.thrust != DVec3::ZERO || self.velocity != DVec3::ZERO {
            self.velocity += (self.thrust - self.velocity) * (1.0 - (-step / THRUST_S).exp());
            if self.thrust == DVec3::ZERO && self.velocity.length() < 0.01 {
                self.velocity = DVec3::ZERO;
            }
            self.orbit.shift(self.velocity * (FLY_PER_S * step * self.orbit.distance()));
            self.moved = true;
        }
        std::mem::take(&mut self.moved)
    }

    fn zoom_by(&mut self, anchor: DVec3, factor: f64) {
        let radius = self.bounds.radius;
        self.orbit.zoom_about(anchor, factor, NEAREST_RADII * radius, FARTHEST_RADII * radius);
        self.moved = true;
    }

    fn fly_to(&mut self, now: Timestamp, to: Orbit) {
        self.stop();
        self.motion = Motion::Flight { from: self.orbit, to, began: now };
        self.last = now;
        self.moved = true;
    }

    fn stop_motion(&mut self) {
        self.motion = Motion::Still;
    }

    /// Height of the image at the target, in model units.
    fn orthographic_height(&self) -> f64 {
        2.0 * self.orbit.distance() * (f64::from(self.fov_y_rad()) / 2.0).tan()
    }

    fn framing(&self, direction: DVec3) -> Orbit {
        let distance = self.framing_distance(direction);
        Orbit::from_direction(self.bounds.center, direction, distance, self.orbit.up())
    }

    fn framing_distance(&self, direction: DVec3) -> f64 {
        let mut camera = Camera::perspective(self.fov_y_rad());
        camera.frame(&self.bounds, direction, self.viewport.aspect());
        camera.eye.distance(self.bounds.center)
    }
}

#[cfg(test)]
mod tests;
