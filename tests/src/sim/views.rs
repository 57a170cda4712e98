//! Random views.

use fastrand::Rng;
use glam::DVec3;
use lodestream_protocol::message::ModelInfo;
use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};

/// A view of the model from a random place, near or far, with a random tolerance.
pub fn random_view(rng: &mut Rng, info: &ModelInfo) -> View {
    let corner = |q| DVec3::from_array(info.lattice.position(q));
    let (min, max) = (corner(info.box_min), corner(info.box_max));
    let radius = ((max - min).length() / 2.0).max(1e-3);
    let direction = DVec3::new(rng.f64() - 0.5, rng.f64() - 0.5, rng.f64() - 0.5).normalize_or(DVec3::Z);
    let center = (min + max) / 2.0;
    let target = center + DVec3::new(rng.f64() - 0.5, rng.f64() - 0.5, rng.f64() - 0.5) * radius;
    let eye = center + direction * radius * (0.7 + 3.0 * rng.f64() * rng.f64());
    let mut view = View::perspective(eye, target, 0.3 + rng.f32());
    view.near = radius * 1e-3;
    view.tolerance_px = [0.0, 0.5, 1.0, 4.0, 20.0][rng.usize(0..5)];
    view.two_sided = rng.u8(0..4) == 0;
    view.silhouette_factor = if rng.bool() { 1.0 } else { 3.0 };
    view.complete = rng.u8(0..8) == 0;
    let most = (info.triangles as u32).max(info.smallest_limit + 1);
    view.triangle_limit = if rng.bool() { UNLIMITED_TRIANGLES } else { rng.u32(info.smallest_limit..most + 1) };
    view
}
