//! Where a client's camera goes: built-in paths around a model, or a recording.
//!
//! A built-in path is a closed list of poses, a function of the model's ball, the lens and the client's random numbers, so
//! that clients differ and runs repeat.

use std::f64::consts::TAU;
use std::sync::Arc;

use fastrand::Rng;
use glam::DVec3;
use serde::Serialize;

use crate::camera::recording::Recording;
use crate::camera::{Bounds, Camera};

/// Steps of an orbit: a degree each.
const ORBIT_STEPS: usize = 360;
/// What a step of a zoom multiplies the distance with.
const ZOOM_STEP: f64 = 0.96;
/// Where a zoom turns back, in radii from the centre: inside the ball, before most surfaces.
const ZOOM_NEAREST: f64 = 0.7;
/// Points that a flight passes, and steps between two of them.
const FLY_POINTS: usize = 8;
const FLY_STEPS: usize = 32;
/// Views of a path that jumps.
const JUMP_VIEWS: usize = 20;

/// A way to move.
#[derive(Clone, Debug, PartialEq)]
pub enum Path {
    /// Around the model at the distance where it fills the image, one degree a step.
    Orbit,
    /// From there straight in until 0.7 radii from the centre, 4 % a step, and back.
    Zoom,
    /// Along a closed curve through random points at 0.7 to 1.6 radii, looking ahead and at the model.
    Fly,
    /// From one random view to another, at 0.9 to 3 radii.
    Jump,
    /// As recorded.
    Recorded(Arc<Recording>),
}

/// Where a recorded path comes from, for the record.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct PathFile {
    /// Its name as it was given.
    pub name: String,
    /// XXH3 of its bytes, in hexadecimal digits.
    pub xxh3: String,
    /// Views.
    pub views: usize,
}

/// Eye and the point looked at, in model units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pose {
    pub(super) eye: DVec3,
    pub(super) target: DVec3,
}

/// The poses of a built-in path; none for a recording.
pub(super) fn poses(path: &Path, bounds: &Bounds, fov_y_rad: f32, aspect: f64, rng: &mut Rng) -> Vec<Pose> {
    let Bounds { center, radius } = *bounds;
    let toward = |direction: DVec3, distance: f64| Pose { eye: center + direction * distance, target: center };
    // From where the whole model fits the image, as `snapshot` frames it.
    let mut framing = Camera::perspective(fov_y_rad);
    framing.frame(bounds, DVec3::Z, aspect);
    let whole = framing.eye.distance(center);
    match path {
        Path::Orbit => {
            let (start, elevation) = (rng.f64() * TAU, random_elevation(rng));
            (0..ORBIT_STEPS)
                .map(|step| toward(direction(start + step as f64 / ORBIT_STEPS as f64 * TAU, elevation), whole))
                .collect()
        }
        Path::Zoom => {
            let direction = direction(rng.f64() * TAU, random_elevation(rng));
            let distances = std::iter::successors(Some(whole), |distance| Some(distance * ZOOM_STEP));
            let inward: Vec<f64> = distances.take_while(|&distance| distance > ZOOM_NEAREST * radius).collect();
            let outward = inward.iter().rev().skip(1).take(inward.len().saturating_sub(2));
            inward.iter().chain(outward).map(|&distance| toward(direction, distance)).collect()
        }
        Path::Fly => {
            let points: Vec<DVec3> = (0..FLY_POINTS)
                .map(|i| {
                    // One point in each eighth of the way round, so that the curve leads around the model.
                    let azimuth = (i as f64 + rng.f64()) / FLY_POINTS as f64 * TAU;
                    center + direction(azimuth, random_elevation(rng)) * radius * (0.7 + 0.9 * rng.f64())
                })
                .collect();
            let mut poses = Vec::with_capacity(FLY_POINTS * FLY_STEPS);
            for i in 0..FLY_POINTS {
                let around = [0, 1, 2, 3].map(|k| points[(i + k) % FLY_POINTS]);
                for step in 0..FLY_STEPS {
                    let (eye, velocity) = catmull_rom(around, step as f64 / FLY_STEPS as f64);
                    let ahead = velocity.normalize_or(DVec3::X) + (center - eye).normalize_or(DVec3::Z);
                    poses.push(Pose { eye, target: eye + ahead.normalize_or(DVec3::Z) * radius });
                }
            }
            poses
        }
        Path::Jump => (0..JUMP_VIEWS)
            .map(|_| {
                let eye = center + random_direction(rng) * radius * (0.9 + 2.1 * rng.f64());
                Pose { eye, target: center + random_direction(rng) * radius * 0.4 * rng.f64() }
            })
            .collect(),
        Path::Recorded(_) => Vec::new(),
    }
}

/// Unit vector at an azimuth (0 is +z) and an elevation.
fn direction(azimuth: f64, elevation: f64) -> DVec3 {
    let (sin, cos) = azimuth.sin_cos();
    let (up, flat) = elevation.sin_cos();
    DVec3::new(flat * sin, up, flat * cos)
}

/// As people look at things: from 20 degrees below to 40 above.
fn random_elevation(rng: &mut Rng) -> f64 {
    (-20.0 + 60.0 * rng.f64()).to_radians()
}

/// Evenly spread over the sphere (Archimedes: the height is uniform).
fn random_direction(rng: &mut Rng) -> DVec3 {
    let up = 2.0 * rng.f64() - 1.0;
    direction(rng.f64() * TAU, up.asin())
}

/// Position and velocity on the Catmull-Rom curve from the second to the third of four points.
fn catmull_rom([a, b, c, d]: [DVec3; 4], t: f64) -> (DVec3, DVec3) {
    let (linear, square, cube) = (c - a, 2.0 * a - 5.0 * b + 4.0 * c - d, 3.0 * (b - c) + d - a);
    let position = b + 0.5 * t * (linear + t * (square + t * cube));
    (position, 0.5 * (linear + t * (2.0 * square + 3.0 * t * cube)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const BUILT_IN: [Path; 4] = [Path::Orbit, Path::Zoom, Path::Fly, Path::Jump];
    const FOV: f32 = 0.8;

    fn bounds() -> Bounds {
        Bounds { center: DVec3::new(5.2e6, 120.0, -7.3e5), radius: 40.0 }
    }

    fn made(path: &Path, seed: u64) -> Vec<Pose> {
        poses(path, &bounds(), FOV, 16.0 / 9.0, &mut Rng::with_seed(seed))
    }

    #[test]
    fn the_same_seed_gives_the_same_path_and_another_another() {
        for path in BUILT_IN {
            assert_eq!(made(&path, 7), made(&path, 7));
            assert_ne!(made(&path, 7), made(&path, 8));
        }
    }

    #[test]
    fn poses_are_sound_and_near_the_model() {
        let Bounds { center, radius } = bounds();
        for path in BUILT_IN {
            for seed in 0..20 {
                let poses = made(&path, seed);
                assert!(poses.len() >= JUMP_VIEWS, "{path:?}");
                for pose in &poses {
                    let (distance, gaze) = (pose.eye.distance(center), pose.eye.distance(pose.target));
                    assert!(distance > 0.3 * radius && distance < 4.0 * radius, "{path:?}: {distance}");
                    assert!(gaze > 0.1 * radius, "{path:?}: {gaze}");
                }
            }
        }
    }

    #[test]
    fn an_orbit_turns_a_degree_a_step_at_the_distance_that_frames_the_model() {
        let Bounds { center, radius } = bounds();
        let poses = made(&Path::Orbit, 3);
        assert_eq!(poses.len(), 360);
        let flat = |pose: &Pose| ((pose.eye - center) * DVec3::new(1.0, 0.0, 1.0)).normalize();
        let whole = radius / (f64::from(FOV) / 2.0).sin();
        for (i, pose) in poses.iter().enumerate() {
            let turn = flat(pose).dot(flat(&poses[(i + 1) % 360])).acos().to_degrees();
            // Coordinates in the millions leave some 1e-9 of the radius.
            assert!((turn - 1.0).abs() < 1e-4, "{turn}");
            assert!((pose.eye.distance(center) / whole - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn paths_that_move_have_no_jumps_where_they_close() {
        for path in [Path::Orbit, Path::Zoom, Path::Fly] {
            for seed in 0..20 {
                let poses = made(&path, seed);
                let longest = (0..poses.len())
                    .map(|i| poses[i].eye.distance(poses[(i + 1) % poses.len()].eye) / bounds().radius)
                    .fold(0.0, f64::max);
                assert!(longest < 0.2, "{path:?} {seed}: {longest} radii");
            }
        }
    }
}
