//! How a mesh is shaded, and the shading formula in plain Rust for whoever wants to know what a pixel should be.

use glam::Vec3;

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
/// A pixel is `base * (0.25 * (0.75 + 0.25 * n.up) + 0.75 * max(n.key, 0))` in linear light, then sRGB-encoded. `base` is
/// the vertex colour (stored in sRGB, interpolated in linear light) or [`CLAY_LINEAR`]. `n` is the normal turned towards the
/// viewer, so both sides of the surface are lit alike; `up` is the camera's, `key = normalize(back + 0.4 up + 0.3 right)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderOptions {
    /// Flat or smooth.
    pub shading: Shading,
    /// Vertex colours instead of clay grey.
    pub vertex_colors: bool,
    /// Edges whose faces meet at a larger angle are sharp in smooth shading, in degrees (of the model's information).
    pub crease_angle_deg: f32,
    /// Colour of what the mesh leaves free, in sRGB.
    pub background: [u8; 3],
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self { shading: Shading::Smooth, vertex_colors: false, crease_angle_deg: 45.0, background: [0x1e, 0x21, 0x26] }
    }
}

/// Base colour of models without colours, in linear light.
pub const CLAY_LINEAR: [f32; 3] = [0.80, 0.78, 0.74];

/// Light that reaches a surface of unit normal `n` (turned towards the viewer) in camera coordinates: x right, y up, z
/// towards the viewer. The dull twin of `light` in `mesh.wgsl`.
pub fn light(n: Vec3) -> f32 {
    let key = Vec3::new(0.3, 0.4, 1.0).normalize();
    0.25 * (0.75 + 0.25 * n.y) + 0.75 * n.dot(key).max(0.0)
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
