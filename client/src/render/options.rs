//! How a mesh is shaded, and the formulas in plain Rust for whoever wants to know what a pixel should be.

use std::time::Duration;

use glam::{DVec3, Vec3};
use lodestream_protocol::view::Plane;

/// Where normals come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Shading {
    /// Each face in one shade.
    Flat,
    /// Normals averaged over the faces around a vertex, apart across edges sharper than the crease angle. Falls back to
    /// [`Shading::Flat`] where the device has too few storage buffers or the mesh is too large for its bindings.
    #[default]
    Smooth,
}

/// Options of an image.
///
/// A pixel is `base * (0.25 * (0.75 + 0.25 * n.up) + 0.75 * max(n.key, 0))` in linear light, times what
/// [`occlusion`](Self::occlusion) leaves of it, then sRGB-encoded. `base` is the vertex colour (stored in sRGB, interpolated
/// in linear light) or [`CLAY_LINEAR`]. `n` is the normal turned towards the viewer, so both sides of the surface are lit
/// alike; `up` is the camera's, `key` the direction of [`light`](Self::light).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderOptions {
    /// Flat or smooth.
    pub shading: Shading,
    /// Vertex colours instead of clay grey.
    pub vertex_colors: bool,
    /// Edges whose faces meet at a larger angle are sharp in smooth shading, in degrees (of the model's information).
    pub crease_angle_deg: f32,
    /// Direction to the key light in camera coordinates: x right, y up, z towards the viewer. Of any length; without one
    /// (zero, not finite), that of [`DEFAULT_LIGHT`].
    pub light: Vec3,
    /// Colour of what the mesh leaves free, in sRGB.
    pub background: [u8; 3],
    /// Colour at the upper edge of the image, in sRGB: the background runs there from [`background`](Self::background) at
    /// the lower edge.
    pub background_top: Option<[u8; 3]>,
    /// Edges of the faces on top of the shading, one pixel wide. Falls away where [`DrawStats::has_details`] says so.
    ///
    /// [`DrawStats::has_details`]: super::DrawStats::has_details
    pub wireframe: bool,
    /// Faces coloured by their size in the model, from blue (coarse) to red (fine), instead of by `base`: see
    /// [`level_color`]. Falls away as wireframes do.
    pub refinement_colors: bool,
    /// Backs of faces in red. Falls away as wireframes do.
    pub tint_backs: bool,
    /// The part of the model on the far side of this plane (model units) is cut away, and the cut drawn in
    /// [`SECTION_LINEAR`]. A plane without a normal cuts nothing.
    pub section: Option<Plane>,
    /// How much darker crevices are, 0 (not at all) to 1. Falls away where [`DrawStats::has_occlusion`] says so.
    ///
    /// [`DrawStats::has_occlusion`]: super::DrawStats::has_occlusion
    pub occlusion: f32,
    /// Time of the image by any clock that never goes back: vertices that ops made or moved go to their places over a fraction
    /// of a second. `None`: they are there at once, as in every image that is to stay. Falls away where
    /// [`DrawStats::is_moving`] says so.
    ///
    /// [`DrawStats::is_moving`]: super::DrawStats::is_moving
    pub geomorph: Option<Duration>,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self {
            shading: Shading::Smooth,
            vertex_colors: false,
            crease_angle_deg: 45.0,
            light: DEFAULT_LIGHT,
            background: [0x1e, 0x21, 0x26],
            background_top: None,
            wireframe: false,
            refinement_colors: false,
            tint_backs: false,
            section: None,
            occlusion: 0.0,
            geomorph: None,
        }
    }
}

impl RenderOptions {
    /// Unit vector to the key light in camera coordinates.
    pub fn light_direction(&self) -> Vec3 {
        self.light.try_normalize().unwrap_or_else(|| DEFAULT_LIGHT.normalize())
    }

    /// Whether the shader's details are needed at all.
    pub(super) fn has_details(&self) -> bool {
        self.wireframe || self.refinement_colors || self.tint_backs
    }

    /// The section plane with a normal of unit length, if it cuts.
    pub(super) fn unit_section(&self) -> Option<Plane> {
        let Plane { normal, offset } = self.section?;
        let length = normal.length();
        let unit: DVec3 = normal / length;
        (unit.is_finite() && offset.is_finite()).then(|| Plane { normal: unit, offset: offset / length })
    }
}

/// From behind the viewer's right shoulder, whatever the view: a scan is never seen unlit.
pub const DEFAULT_LIGHT: Vec3 = Vec3::new(0.3, 0.4, 1.0);

/// Base colour of models without colours, in linear light.
pub const CLAY_LINEAR: [f32; 3] = [0.80, 0.78, 0.74];

/// Colour of a section plane's cut, in linear light. Unlit: a cut has no shape.
pub const SECTION_LINEAR: [f32; 3] = [0.86, 0.30, 0.10];

/// Light that reaches a surface of unit normal `n` (turned towards the viewer) in camera coordinates: x right, y up, z
/// towards the viewer, with the key light in direction `key` (unit length). The dull twin of `light` in `mesh.wgsl`.
pub fn light(n: Vec3, key: Vec3) -> f32 {
    0.25 * (0.75 + 0.25 * n.y) + 0.75 * n.dot(key).max(0.0)
}

/// Refinement of a face: how often the larger side of the lattice's box is halved until it is as long as the legs of a right
/// isosceles triangle of the face's area. `area` and `extent` in the same unit (squared and plain).
pub fn level(area: f64, extent: f64) -> f32 {
    (extent / (2.0 * area).sqrt()).log2() as f32
}

/// Linear colour of a face of this [`level`]: blue up to 2, red from 12 on, by way of green. The dull twin of `level_color`
/// in `mesh.wgsl`.
pub fn level_color(level: f32) -> [f32; 3] {
    const RAMP: [[f32; 3]; 6] = [
        [0.05, 0.08, 0.45],
        [0.04, 0.35, 0.80],
        [0.06, 0.60, 0.35],
        [0.75, 0.75, 0.08],
        [0.90, 0.35, 0.04],
        [0.60, 0.04, 0.05],
    ];
    let at = ((level - 2.0) / 2.0).clamp(0.0, 5.0);
    let below = (at as usize).min(4);
    std::array::from_fn(|k| RAMP[below][k] + (RAMP[below + 1][k] - RAMP[below][k]) * (at - below as f32))
}

/// Encodes linear light as an sRGB byte, `0 ..= 255` before rounding.
pub fn srgb_encode(linear: f32) -> f32 {
    let x = linear.clamp(0.0, 1.0);
    255.0 * if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 }
}

/// Linear light of an sRGB byte.
pub fn srgb_decode(byte: u8) -> f64 {
    let x = f64::from(byte) / 255.0;
    if x <= 0.040_45 { x / 12.92 } else { ((x + 0.055) / 1.055).powf(2.4) }
}
