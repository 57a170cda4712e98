//! Views to try a model from: what people do, and what is hard.

use fastrand::Rng;
use glam::DVec3;
use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};

use super::original::Original;

/// View number `index` of the sequence that `seed` names; each can be made without those before it. With R the radius of the
/// bounding sphere, in turn:
///
/// 0. the whole object: from any direction, 2.2 to 4 R away, looking at a point within 0.2 R of the centre;
/// 1. close up: 0.9 to 2 R away, looking at a point within 0.4 R of the centre;
/// 2. near the surface: 0.01 to 0.3 R (log-uniform) from a random vertex, within 60 degrees of its normal, looking at it;
/// 3. along the surface: from such a place, at another random vertex.
///
/// Each has an opening angle of 45 degrees (every second one 20 to 90), a width of 1 to 2.4 heights, 360, 720, 1080 or 2160
/// lines, a tolerance of 0.5 to 4 pixels (log-uniform), no triangle limit, and a near plane of a thousandth of R or of the
/// distance to the vertex if that is less.
pub fn random_view(original: &Original, seed: u64, index: u64) -> View {
    let mut rng = Rng::with_seed(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ index);
    let (center, radius) = (original.center(), original.radius());
    let (eye, target, distance) = match index % 4 {
        0 => {
            let eye = center + direction(&mut rng) * between(&mut rng, 2.2, 4.0) * radius;
            (eye, center + direction(&mut rng) * 0.2 * rng.f64() * radius, radius)
        }
        1 => {
            let eye = center + direction(&mut rng) * between(&mut rng, 0.9, 2.0) * radius;
            (eye, center + direction(&mut rng) * 0.4 * rng.f64() * radius, radius)
        }
        near => {
            let vertex = vertex(original, &mut rng);
            let distance = log_uniform(&mut rng, 0.01, 0.3) * radius;
            let at = original.position(vertex);
            let eye = at + about(original.normal(vertex), &mut rng) * distance;
            let target = if near == 2 { at } else { original.position(self::vertex(original, &mut rng)) };
            (eye, target, distance)
        }
    };
    let fov_deg = if rng.bool() { 45.0 } else { between(&mut rng, 20.0, 90.0) };
    let mut view = View::perspective(eye, target, (fov_deg as f32).to_radians());
    view.aspect = between(&mut rng, 1.0, 2.4) as f32;
    view.viewport_height_px = [360, 720, 1080, 2160][rng.usize(..4)];
    view.tolerance_px = log_uniform(&mut rng, 0.5, 4.0) as f32;
    view.triangle_limit = UNLIMITED_TRIANGLES;
    view.near = radius.min(distance) * 1e-3;
    view
}

fn between(rng: &mut Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * rng.f64()
}

fn log_uniform(rng: &mut Rng, low: f64, high: f64) -> f64 {
    low * (high / low).powf(rng.f64())
}

fn vertex(original: &Original, rng: &mut Rng) -> u32 {
    rng.u32(..original.vertex_count().max(1) as u32)
}

/// A unit vector, all directions alike: a point of the ball, found by trying.
fn direction(rng: &mut Rng) -> DVec3 {
    loop {
        let p = DVec3::new(rng.f64(), rng.f64(), rng.f64()) * 2.0 - DVec3::ONE;
        if (1e-3..=1.0).contains(&p.length()) {
            return p.normalize();
        }
    }
}

/// A unit vector within 60 degrees of `normal`, or any if that has no length.
fn about(normal: DVec3, rng: &mut Rng) -> DVec3 {
    let Some(normal) = normal.try_normalize() else { return direction(rng) };
    loop {
        let candidate = direction(rng);
        if candidate.dot(normal) >= 0.5 {
            return candidate;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::TriMesh;

    #[test]
    fn every_view_is_valid_and_its_own() {
        let square = TriMesh {
            positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]],
            faces: vec![[0, 1, 2], [0, 2, 3]],
            colors: None,
        };
        let original = Original::new(&square);
        let views: Vec<View> = (0..40).map(|index| random_view(&original, 7, index)).collect();
        for (index, view) in (0..).zip(&views) {
            assert_eq!(view.validate(), Ok(()), "view {index}");
            assert_eq!(*view, random_view(&original, 7, index), "view {index} is the same again");
            assert!((0.5..=4.0).contains(&view.tolerance_px));
        }
        assert_ne!(views[0].eye, views[4].eye);
        assert_ne!(random_view(&original, 8, 0).eye, views[0].eye);
    }
}
