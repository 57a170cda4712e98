//! A camera that turns around a point.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use glam::{DQuat, DVec3};

use super::{Bounds, Camera, DEFAULT_DIRECTION, NEAREST};

/// From here on a direction is as good as straight up or down: the heading then follows from the image's right.
const POLE_SIN: f64 = 1.0 - 1e-9;

/// Which way is up in the model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum UpAxis {
    /// +y, as in most meshes for graphics.
    #[default]
    Y,
    /// +z, as in surveys and many scanners.
    Z,
}

impl UpAxis {
    /// Turns +y to the axis.
    fn frame(self) -> DQuat {
        match self {
            Self::Y => DQuat::IDENTITY,
            Self::Z => DQuat::from_rotation_x(FRAC_PI_2),
        }
    }
}

/// Pose as a target, a distance and three angles. Everything is in model units and radians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Orbit {
    /// The point that stays in the middle.
    pub target: DVec3,
    /// Distance of the eye, positive.
    distance: f64,
    /// Angle around the up axis; at 0 the eye is on the +z side of the target (y up).
    yaw_rad: f64,
    /// Angle above the horizon, within plus or minus a right angle.
    pitch_rad: f64,
    /// Angle of the camera around its own axis.
    roll_rad: f64,
    up: UpAxis,
}

impl Orbit {
    /// Looks at the middle of the model from [`DEFAULT_DIRECTION`], at `distance`, with y up.
    pub fn around(bounds: &Bounds, distance: f64) -> Self {
        Self::from_direction(bounds.center, DEFAULT_DIRECTION, distance, UpAxis::Y)
    }

    /// Looks at `target` from `direction` (any length but zero, as if y were up: turned with the axis), upright.
    pub fn from_direction(target: DVec3, direction: DVec3, distance: f64, up: UpAxis) -> Self {
        let direction = direction.try_normalize().unwrap_or(DVec3::Z);
        let pitch_rad = direction.y.clamp(-1.0, 1.0).asin();
        let yaw_rad = if direction.y.abs() < POLE_SIN { direction.x.atan2(direction.z) } else { 0.0 };
        let distance = if distance.is_finite() && distance > 0.0 { distance } else { 1.0 };
        Self { target, distance, yaw_rad, pitch_rad, roll_rad: 0.0, up }
    }

    /// The orbit of a camera around the point at `distance` in front of it.
    pub fn of(camera: &Camera, distance: f64) -> Self {
        Self::of_rotation(camera.orientation, camera.eye + camera.forward() * distance, distance, UpAxis::Y)
    }

    /// The orbit whose camera has this orientation and sees `target` at `distance`.
    pub fn of_rotation(orientation: DQuat, target: DVec3, distance: f64, up: UpAxis) -> Self {
        let local = up.frame().conjugate() * orientation;
        let (back, right) = (local * DVec3::Z, local * DVec3::X);
        let mut orbit = Self::from_direction(target, back, distance, up);
        if back.y.abs() >= POLE_SIN {
            orbit.yaw_rad = (-right.z).atan2(right.x);
            return orbit;
        }
        let level = orbit.level().conjugate() * right;
        orbit.roll_rad = level.y.atan2(level.x);
        orbit
    }

    /// The orbit with these angles: yaw, pitch (clamped), roll in radians; the distance must be positive.
    pub fn from_angles(target: DVec3, distance: f64, [yaw, pitch, roll]: [f64; 3], up: UpAxis) -> Self {
        let mut orbit = Self::from_direction(target, DVec3::Z, distance, up);
        orbit.rotate(yaw, pitch);
        orbit.roll(roll);
        orbit
    }

    /// Yaw around the up axis (0 looks from +z, y up), pitch above the horizon and roll, in radians.
    pub fn angles(&self) -> [f64; 3] {
        [self.yaw_rad, self.pitch_rad, self.roll_rad]
    }

    /// Distance of the eye from the target.
    pub fn distance(&self) -> f64 {
        self.distance
    }

    /// Which way is up.
    pub fn up(&self) -> UpAxis {
        self.up
    }

    /// Looks from the same side at a model with another axis up.
    pub fn set_up(&mut self, up: UpAxis) {
        self.up = up;
    }

    /// Turns by these angles; positive yaw moves the eye to the right, positive pitch up. Pitch stops at the poles.
    pub fn rotate(&mut self, yaw_rad: f64, pitch_rad: f64) {
        self.yaw_rad = (self.yaw_rad + yaw_rad) % TAU;
        self.pitch_rad = (self.pitch_rad + pitch_rad).clamp(-FRAC_PI_2, FRAC_PI_2);
    }

    /// Turns the camera around its own axis; positive turns the picture clockwise.
    pub fn roll(&mut self, roll_rad: f64) {
        self.roll_rad = (self.roll_rad + roll_rad) % TAU;
    }

    /// Turns like [`rotate`](Self::rotate), but around the eye: the target moves.
    pub fn look(&mut self, yaw_rad: f64, pitch_rad: f64) {
        let eye = self.eye();
        self.rotate(yaw_rad, pitch_rad);
        self.target = eye - self.rotation() * DVec3::Z * self.distance;
    }

    /// Multiplies the distance by `factor`, which is ignored unless it is positive and finite. The distance stays above
    /// `least`.
    pub fn zoom(&mut self, factor: f64, least: f64) {
        self.zoom_about(self.target, factor, least, f64::INFINITY);
    }

    /// Like [`zoom`](Self::zoom), so that `anchor` stays where it is in the picture. The distance stays within `least`
    /// and `most`.
    pub fn zoom_about(&mut self, anchor: DVec3, factor: f64, least: f64, most: f64) {
        if factor.is_finite() && factor > 0.0 {
            let distance = (self.distance * factor).min(most.max(self.distance)).max(least);
            let factor = distance / self.distance;
            self.distance = distance;
            self.target = anchor + (self.target - anchor) * factor;
        }
    }

    /// Moves the target in the image plane, in model units to the right and up.
    pub fn pan(&mut self, right: f64, up: f64) {
        self.shift(DVec3::new(right, up, 0.0));
    }

    /// Moves eye and target by a vector of the camera: right, up, back.
    pub fn shift(&mut self, by: DVec3) {
        self.target += self.rotation() * by;
    }

    /// Puts the camera where the orbit says; its lens stays, its near plane follows the distance.
    pub fn pose(&self, camera: &mut Camera) {
        camera.orientation = self.rotation();
        camera.eye = self.eye();
        camera.near = self.distance * NEAREST;
    }

    /// Position of the camera.
    pub fn eye(&self) -> DVec3 {
        self.target + self.rotation() * DVec3::Z * self.distance
    }

    /// Camera to model rotation.
    pub fn rotation(&self) -> DQuat {
        self.up.frame() * self.level() * DQuat::from_rotation_z(self.roll_rad)
    }

    /// Between this pose (0) and another (1): the shorter way around, distances geometrically. The axis is the other's.
    pub fn towards(&self, other: &Self, share: f64) -> Self {
        let from = Self::of_rotation(self.rotation(), self.target, self.distance, other.up);
        let mix = |a: f64, b: f64| a + (b - a) * share;
        let turn = |a: f64, b: f64| a + ((b - a + PI).rem_euclid(TAU) - PI) * share;
        Self {
            target: from.target.lerp(other.target, share),
            distance: from.distance * (other.distance / from.distance).powf(share),
            yaw_rad: turn(from.yaw_rad, other.yaw_rad),
            pitch_rad: mix(from.pitch_rad, other.pitch_rad),
            roll_rad: turn(from.roll_rad, other.roll_rad),
            up: other.up,
        }
    }

    fn level(&self) -> DQuat {
        DQuat::from_rotation_y(self.yaw_rad) * DQuat::from_rotation_x(-self.pitch_rad)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn orbit_and_camera_describe_the_same_pose() {
        let mut camera = Camera::perspective(0.8);
        camera.look_at(DVec3::new(3.0, 2.0, -4.0), DVec3::new(1.0, 1.0, 1.0));
        let distance = DVec3::new(2.0, 1.0, -5.0).length();
        let orbit = Orbit::of(&camera, distance);
        assert!(orbit.target.distance(DVec3::ONE) < 1e-12);
        let mut again = Camera::perspective(0.8);
        orbit.pose(&mut again);
        assert!(again.eye.distance(camera.eye) < 1e-9);
        assert!(again.orientation.angle_between(camera.orientation) < 1e-6);
    }

    #[test]
    fn any_rotation_has_its_angles() {
        let mut rng = fastrand::Rng::with_seed(3);
        for up in [UpAxis::Y, UpAxis::Z] {
            for i in 0..300 {
                let pitch = match i % 3 {
                    0 => FRAC_PI_2,
                    1 => -FRAC_PI_2,
                    _ => (rng.f64() - 0.5) * PI,
                };
                let mut orbit = Orbit::from_direction(DVec3::ONE, DVec3::Z, 2.0, up);
                orbit.rotate(rng.f64() * TAU, pitch);
                orbit.roll(rng.f64() * TAU);
                let again = Orbit::of_rotation(orbit.rotation(), orbit.target, 2.0, up);
                assert!(again.rotation().angle_between(orbit.rotation()) < 1e-6, "{orbit:?}");
            }
        }
    }

    #[test]
    fn turning_keeps_the_target_in_the_middle() {
        let bounds = Bounds { center: DVec3::new(5.0, 6.0, 7.0), radius: 2.0 };
        let mut orbit = Orbit::around(&bounds, 8.0);
        let mut camera = Camera::perspective(0.8);
        for _ in 0..50 {
            orbit.rotate(0.3, 0.11);
            orbit.zoom(0.95, 1.0);
            orbit.pose(&mut camera);
            let to_target = bounds.center - camera.eye;
            assert!((to_target.length() - orbit.distance()).abs() < 1e-9);
            assert!(to_target.normalize().distance(camera.forward()) < 1e-9);
        }
        assert_eq!(orbit.distance(), 1.0);
        assert!(camera.forward().distance(DVec3::NEG_Y) < 1e-9, "looks straight down");
        orbit.set_up(UpAxis::Z);
        orbit.pose(&mut camera);
        assert!(camera.forward().distance(DVec3::NEG_Z) < 1e-9, "down is where the axis says");
    }

    #[test]
    fn panning_moves_the_picture() {
        let mut orbit = Orbit::around(&Bounds { center: DVec3::ZERO, radius: 1.0 }, 4.0);
        let mut camera = Camera::perspective(0.8);
        orbit.pose(&mut camera);
        let before = camera;
        orbit.pan(0.5, 0.25);
        orbit.pose(&mut camera);
        let moved = before.orientation.conjugate() * (camera.eye - before.eye);
        assert!(moved.distance(DVec3::new(0.5, 0.25, 0.0)) < 1e-12);
        orbit.zoom(f64::NAN, 0.1);
        assert_eq!(orbit.distance(), 4.0);
    }

    #[test]
    fn looking_around_keeps_the_eye_and_the_way_between_poses_ends_at_both() {
        let mut orbit = Orbit::around(&Bounds { center: DVec3::X, radius: 1.0 }, 4.0);
        let eye = orbit.eye();
        orbit.look(0.4, -0.2);
        assert!(orbit.eye().distance(eye) < 1e-12 && orbit.target.distance(DVec3::X) > 0.5);
        let mut other = Orbit::from_direction(DVec3::Y, DVec3::NEG_Y, 1.0, UpAxis::Z);
        other.roll(1.0);
        assert!(orbit.towards(&other, 1.0).eye().distance(other.eye()) < 1e-9);
        assert!(orbit.towards(&other, 0.0).eye().distance(eye) < 1e-9);
        assert!((orbit.towards(&other, 0.5).distance() - 2.0).abs() < 1e-9);
    }
}
