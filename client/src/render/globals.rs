//! Bind group 0: what an image has in common for all shaders, composed from camera and options.

use bytemuck::{Pod, Zeroable};
use glam::DVec3;
use lodestream_protocol::quant::Lattice;
use wgpu::TextureFormat;

use super::camera::CameraUniform;
use super::options::{CLAY_LINEAR, RenderOptions, SECTION_LINEAR, Shading, srgb_decode};

const DETAIL_WIREFRAME: u32 = 1;
const DETAIL_LEVELS: u32 = 2;
const DETAIL_FACING: u32 = 4;
const DETAIL_FLAT: u32 = 8;

/// As in `globals.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct Globals {
    /// Camera and light.
    pub camera: CameraUniform,
    /// Linear base colour; `w` is 1 where vertex colours replace it.
    pub base_color: [f32; 4],
    /// Section plane relative to the eye, in lattice steps, normal towards what is kept; zero without one.
    pub section: [f32; 4],
    /// Linear colour of the cut; `w` is 1 where the eye is in what is cut away.
    pub section_color: [f32; 4],
    /// Background at the lower edge of the image, encoded as the target takes it.
    pub background_low: [f32; 4],
    /// The same at the upper edge; `w` is the amplitude of the noise that hides the gradient's steps.
    pub background_high: [f32; 4],
    /// Width and height of the image in pixels, and their inverses.
    pub viewport: [f32; 4],
    /// One past the last slot.
    pub slot_end: u32,
    /// Slots of the buffers.
    pub capacity_slots: u32,
    /// Cosine of the crease angle.
    pub crease_cosine: f32,
    /// Bits: wireframe, colours by refinement, tinted backs, flat.
    pub details: u32,
    /// Refinement of a face whose legs are one lattice step.
    pub level_zero: f32,
    /// How much darker crevices are.
    pub occlusion_strength: f32,
    /// Alpha of the cut: 0 where passes follow that have to tell it from surfaces.
    pub section_alpha: f32,
    /// Time of the transitions, see [`Morphs::now_s`](super::morph::Morphs::now_s).
    pub morph_now_s: f32,
    /// See [`Morphs::share`](super::morph::Morphs::share).
    pub morph_share: f32,
    /// Fills the last 16 bytes.
    pub unused: [f32; 3],
}

impl Globals {
    /// Composes everything but `slot_end`, `capacity_slots`, those of transitions (left at 0) and `section_alpha`
    /// (left at 1).
    pub fn new(
        camera: CameraUniform,
        lattice: &Lattice,
        options: &RenderOptions,
        size: [u32; 2],
        format: TextureFormat,
    ) -> Self {
        let [r, g, b] = CLAY_LINEAR;
        let [width, height] = size.map(|side| side as f32);
        let (section, looks_at_cut) = section(&camera, lattice, options);
        let [cut_r, cut_g, cut_b] = SECTION_LINEAR;
        let encoded = |color: [u8; 3], w| {
            let [r, g, b] = color.map(|byte| encode(format, byte) as f32);
            [r, g, b, w]
        };
        // Sixteen-bit floats and the like need no noise, and a plain background is to be exactly what was asked for.
        let noise = if options.background_top.is_some() { 1.0 / 255.0 } else { 0.0 };
        let details = [
            (options.wireframe, DETAIL_WIREFRAME),
            (options.refinement_colors, DETAIL_LEVELS),
            (options.tint_backs, DETAIL_FACING),
            (options.shading == Shading::Flat, DETAIL_FLAT),
        ];
        Self {
            camera,
            base_color: [r, g, b, if options.vertex_colors { 1.0 } else { 0.0 }],
            section,
            section_color: [cut_r, cut_g, cut_b, if looks_at_cut { 1.0 } else { 0.0 }],
            background_low: encoded(options.background, 1.0),
            background_high: encoded(
                options.background_top.unwrap_or(options.background),
                // Half a step of sRGB is less in linear light where the background is dark.
                if format.is_srgb() { noise * 0.25 } else { noise },
            ),
            viewport: [width, height, 1.0 / width, 1.0 / height],
            slot_end: 0,
            capacity_slots: 0,
            crease_cosine: options.crease_angle_deg.clamp(0.0, 180.0).to_radians().cos(),
            details: details.into_iter().map(|(is_on, bit)| if is_on { bit } else { 0 }).sum(),
            level_zero: f64::from(lattice.max_coordinate()).log2() as f32,
            occlusion_strength: options.occlusion.clamp(0.0, 1.0),
            section_alpha: 1.0,
            morph_now_s: 0.0,
            morph_share: 0.0,
            unused: [0.0; 3],
        }
    }
}

/// A colour component as a target of `format` takes it.
pub fn encode(format: TextureFormat, byte: u8) -> f64 {
    if format.is_srgb() { srgb_decode(byte) } else { f64::from(byte) / 255.0 }
}

/// The plane in the shader's terms, and whether the viewer is on the side that is cut away.
fn section(camera: &CameraUniform, lattice: &Lattice, options: &RenderOptions) -> ([f32; 4], bool) {
    let Some(plane) = options.unit_section() else { return ([0.0; 4], false) };
    // In lattice steps, where the normal is the same.
    let origin = plane.normal.dot(DVec3::from_array(lattice.origin)) + plane.offset;
    let inside = plane.normal.dot(camera.anchor()) + origin / lattice.step;
    let [x, y, z, is_parallel] = camera.back.map(f64::from);
    let looks_at_cut = if is_parallel > 0.0 { plane.normal.dot(DVec3::new(x, y, z)) < 0.0 } else { inside < 0.0 };
    (plane.normal.as_vec3().extend(inside as f32).to_array(), looks_at_cut)
}
