//! A camera that turns around a point.

use glam::{DQuat, DVec3};

use super::{Bounds, Camera, DEFAULT_DIRECTION, NEAREST};

/// Steepest pitch: straight up or down would leave the heading undefined.
const MAX_PITCH_RAD: f64 = 89.0 * std::f64::consts::PI / 180.0;

/// Pose as a target, a distance and two angles. Everything is in model units and radians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Orbit {
    /// The point that stays in the middle.
    pub target: DVec3,
    /// Distance of the eye, positive.
    distance: f64,
    /// Angle around the y axis; at 0 the eye is on the +z side of the target.
    yaw_rad: f64,
    /// Angle above the horizon, within plus or minus 89 degrees.
    pitch_rad: f64,
}

impl Orbit {
    /// Looks at the middle of the model from [`DEFAULT_DIRECTION`], at `distance`.
    pub fn around(bounds: &Bounds, distance: f64) -> Self {
        let mut orbit = Self { target: bounds.center, distance: 1.0, yaw_rad: 0.0, pitch_rad: 0.0 };
        orbit.set_offset(DEFAULT_DIRECTION.normalize() * distance);
        orbit
    }

    /// The orbit of a camera around the point at `distance` in front of it.
    pub fn of(camera: &Camera, distance: f64) -> Self {
        let target = camera.eye + camera.forward() * distance;
        let mut orbit = Self { target, distance: 1.0, yaw_rad: 0.0, pitch_rad: 0.0 };
        orbit.set_offset(camera.eye - target);
        orbit
    }

    /// Distance of the eye from the target.
    pub fn distance(&self) -> f64 {
        self.distance
    }

    /// Turns by these angles; positive yaw moves the eye to the right, positive pitch up. Pitch stops at 89 degrees.
    pub fn rotate(&mut self, yaw_rad: f64, pitch_rad: f64) {
        self.yaw_rad = (self.yaw_rad + yaw_rad) % std::f64::consts::TAU;
        self.pitch_rad = (self.pitch_rad + pitch_rad).clamp(-MAX_PITCH_RAD, MAX_PITCH_RAD);
    }

    /// Multiplies the distance by `factor`, which is ignored unless it is positive and finite. The distance stays above
    /// `least`.
    pub fn zoom(&mut self, factor: f64, least: f64) {
        if factor.is_finite() && factor > 0.0 {
            self.distance = (self.distance * factor).max(least);
        }
    }

    /// Moves the target in the image plane, in model units to the right and up.
    pub fn pan(&mut self, right: f64, up: f64) {
        self.target += self.rotation() * DVec3::new(right, up, 0.0);
    }

    /// Puts the camera where the orbit says; its lens stays, its near plane follows the distance.
    pub fn pose(&self, camera: &mut Camera) {
        camera.orientation = self.rotation();
        camera.eye = self.target + camera.orientation * DVec3::Z * self.distance;
        camera.near = self.distance * NEAREST;
    }

    fn rotation(&self) -> DQuat {
        DQuat::from_rotation_y(self.yaw_rad) * DQuat::from_rotation_x(-self.pitch_rad)
    }

    fn set_offset(&mut self, offset: DVec3) {
        let distance = offset.length();
        if distance > 0.0 && distance.is_finite() {
            self.distance = distance;
            self.yaw_rad = offset.x.atan2(offset.z);
            self.pitch_rad = (offset.y / distance).clamp(-1.0, 1.0).asin().clamp(-MAX_PITCH_RAD, MAX_PITCH_RAD);
        }
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
        assert!(camera.forward().y < -0.999, "looks down, but not quite straight");
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
}
