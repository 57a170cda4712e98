//! Lines on top of a mesh: frustums seen from outside, distances, markers.
//!
//! Lines have a constant width in pixels. Where the mesh hides them they are drawn faintly.

use std::array;

use bytemuck::{Pod, Zeroable};
use glam::DVec3;
use lodestream_protocol::quant::Lattice;
use lodestream_protocol::view::Projection;

use super::camera::{CameraUniform, RenderCamera};

/// Most lines that are drawn; what comes after them is left out.
pub const MAX_LINES: usize = 4096;
/// Opacity of what the mesh hides.
const HIDDEN_ALPHA: u8 = 60;

/// A straight line between two points in model units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// One end.
    pub from: DVec3,
    /// The other end.
    pub to: DVec3,
    /// Colour in sRGB.
    pub color: [u8; 3],
}

/// The edges of what a camera sees in an image `aspect` times as wide as high, up to `depth` model units ahead, with a mark
/// that says where up is.
pub fn frustum(camera: &RenderCamera, aspect: f64, depth: f64, color: [u8; 3]) -> Vec<Line> {
    let corners = |ahead: f64| -> [DVec3; 4] {
        let half_y = match camera.projection {
            Projection::Perspective { fov_y_rad } => ahead * (f64::from(fov_y_rad) / 2.0).tan(),
            Projection::Orthographic { height } => height / 2.0,
        };
        let (x, y) = (half_y * aspect, half_y);
        [(-x, -y), (x, -y), (x, y), (-x, y)].map(|(x, y)| camera.eye + camera.rotation * DVec3::new(x, y, -ahead))
    };
    let (near, far) = (corners(camera.near.min(depth)), corners(depth));
    let line = |from, to| Line { from, to, color };
    let mut lines = Vec::with_capacity(14);
    for k in 0..4 {
        lines.push(line(near[k], far[k]));
        lines.push(line(far[k], far[(k + 1) % 4]));
        lines.push(line(near[k], near[(k + 1) % 4]));
    }
    let height = far[3] - far[0];
    let middle = (far[2] + far[3]) / 2.0 + height * 0.15;
    lines.push(line(far[3].lerp(far[2], 0.35), middle));
    lines.push(line(middle, far[3].lerp(far[2], 0.65)));
    lines
}

/// One instance of the line pipelines.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub(super) struct GpuLine {
    from: [f32; 3],
    to: [f32; 3],
    color: [u8; 4],
}

/// Bytes of an instance.
pub(super) const LINE_BYTES: u64 = size_of::<GpuLine>() as u64;

/// The lines relative to the camera's anchor, first faint for what is hidden, then once more for what is seen. Ends that
/// are no numbers take their line away.
pub(super) fn gpu_lines(lines: &[Line], camera: &CameraUniform, lattice: &Lattice) -> Vec<GpuLine> {
    let anchor = camera.anchor();
    let relative = |p: DVec3| -> [f32; 3] {
        let p = DVec3::from_array(lattice.to_lattice(p.to_array())) - anchor;
        array::from_fn(|k| p[k] as f32)
    };
    let gpu = |line: &Line, alpha| {
        let [r, g, b] = line.color;
        GpuLine { from: relative(line.from), to: relative(line.to), color: [r, g, b, alpha] }
    };
    let is_sound = |line: &GpuLine| line.from.iter().chain(&line.to).all(|x| x.is_finite());
    let lines = &lines[..lines.len().min(MAX_LINES)];
    let of = |alpha| lines.iter().map(move |line| gpu(line, alpha)).filter(is_sound);
    of(HIDDEN_ALPHA).chain(of(255)).collect()
}
