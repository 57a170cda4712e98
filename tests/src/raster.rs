//! A plain CPU rasteriser: the oracle that pictures from the GPU are compared with.
//!
//! It follows the rules that GPUs follow (pixel centres, top-left fill rule, eight bits below the pixel, clip depth
//! 0..=1, counter-clockwise front faces), so that coverage agrees to the pixel but for rounding of the transform. It
//! knows nothing of the client; [`shade`] and [`Light`] say all that a shader needs to give the same colours.

mod compare;
mod draw;

use std::fs::File;
use std::io::{BufReader, BufWriter};
use std::path::Path;

use anyhow::{Context, ensure};
use glam::dcamera::rh::{proj::directx, view};
use glam::{DMat4, DVec3, DVec4};

pub use compare::{ImageDifference, compare};
pub use draw::render;

/// sRGB colour of pixels without a face: `#1e2126`.
pub const BACKGROUND: [u8; 3] = [0x1e, 0x21, 0x26];
/// Linear base colour of a surface without vertex colours: light clay grey.
pub const CLAY: [f64; 3] = [0.80, 0.78, 0.74];

/// What to draw.
#[derive(Clone, Copy, Debug)]
pub struct Subject<'a> {
    /// World positions.
    pub positions: &'a [[f64; 3]],
    /// Corners, counter-clockwise seen from the front.
    pub faces: &'a [[u32; 3]],
    /// One sRGB colour per position, or [`CLAY`] for all.
    pub colors: Option<&'a [[u8; 3]]>,
}

impl<'a> From<&'a lodestream_server::mesh::TriMesh> for Subject<'a> {
    fn from(mesh: &'a lodestream_server::mesh::TriMesh) -> Self {
        Self { positions: &mesh.positions, faces: &mesh.faces, colors: mesh.colors.as_deref() }
    }
}

/// How to draw it.
#[derive(Clone, Copy, Debug)]
pub struct RasterOptions {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// World to clip space: right-handed, y up, depth 0..=1, symmetric frustum.
    pub view_projection: DMat4,
    /// Interpolated vertex normals (area-weighted mean of the faces around) instead of flat face normals.
    pub smooth: bool,
    /// Draw back faces too, lit as if they faced the viewer. Otherwise they are culled.
    pub two_sided: bool,
}

/// Directions of the light in world space, from the camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// Towards the key light, unit length: `normalize(back + 0.4 up + 0.3 right)` of the camera, where `back` points
    /// from the scene to the viewer.
    pub key: DVec3,
    /// Towards the sky, unit length: the camera's up direction.
    pub sky: DVec3,
}

impl Light {
    /// Reads the camera's axes off a view-projection: with a symmetric frustum and depth 0..=1, the first three
    /// numbers of rows 0, 1 and 2 point right, up and forward, for perspective and parallel projections alike.
    pub fn of_camera(view_projection: DMat4) -> Self {
        let axis = |row: usize| view_projection.row(row).truncate().normalize_or_zero();
        let (right, up, back) = (axis(0), axis(1), -axis(2));
        Self { key: (back + 0.4 * up + 0.3 * right).normalize_or_zero(), sky: up }
    }
}

/// Linear colour of a lit surface.
///
/// `base` is linear (vertex colours are decoded from sRGB at the vertex and interpolated linearly, perspective-correct),
/// `normal` has unit length and points to the viewer's side of the face. In WGSL:
///
/// ```wgsl
/// let ambient = 0.25 * (0.5 + 0.5 * dot(normal, sky));
/// let key_part = 0.75 * max(dot(normal, key), 0.0);
/// return base * (ambient + key_part);
/// ```
///
/// The result is then encoded by [`encode_srgb`] (an sRGB render target does the same) and rounded to 8 bits.
pub fn shade(base: DVec3, normal: DVec3, light: &Light) -> DVec3 {
    let ambient = 0.25 * (0.5 + 0.5 * normal.dot(light.sky));
    let key = 0.75 * normal.dot(light.key).max(0.0);
    base * (ambient + key)
}

/// Linear light in 0..=1 of an 8-bit sRGB channel.
pub fn decode_srgb(channel: u8) -> f64 {
    let c = f64::from(channel) / 255.0;
    if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
}

/// 8-bit sRGB channel of linear light, clamped to 0..=1 and rounded to nearest.
pub fn encode_srgb(linear: f64) -> u8 {
    let c = linear.clamp(0.0, 1.0);
    let encoded = if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
    (encoded * 255.0 + 0.5) as u8
}

/// A picture and what lies behind its pixels, row by row from the top left.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    width: u32,
    height: u32,
    /// `len == 4 * width * height`; alpha is 255 throughout.
    rgba: Vec<u8>,
    /// `len == width * height`.
    hits: Vec<Option<Hit>>,
}

/// The nearest face at a pixel's centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Index into the faces drawn; `u32::MAX` never occurs. 0 for a picture that was read from outside.
    pub face: u32,
    /// Clip depth, 0 at the near plane and 1 at the far plane. 0 for a picture that was read from outside.
    pub depth: f64,
}

impl Image {
    /// A picture of background.
    pub fn blank(width: u32, height: u32) -> Self {
        let pixels = width as usize * height as usize;
        let [r, g, b] = BACKGROUND;
        Self { width, height, rgba: [r, g, b, 255].repeat(pixels), hits: vec![None; pixels] }
    }

    /// A picture from elsewhere (`rgba.len() == 4 * width * height`); pixels of another colour than [`BACKGROUND`]
    /// count as covered.
    ///
    /// # Errors
    /// When the length does not fit the size.
    pub fn from_rgba(width: u32, height: u32, rgba: Vec<u8>) -> anyhow::Result<Self> {
        let pixels = width as usize * height as usize;
        ensure!(rgba.len() == 4 * pixels, "{} bytes for {width} x {height} pixels", rgba.len());
        let covered = |pixel: &[u8]| (pixel[..3] != BACKGROUND).then_some(Hit { face: 0, depth: 0.0 });
        let hits = rgba.chunks_exact(4).map(covered).collect();
        Ok(Self { width, height, rgba, hits })
    }

    /// Pixels across.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Pixels down.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// The colours, four bytes per pixel.
    pub fn rgba(&self) -> &[u8] {
        &self.rgba
    }

    /// Colour at a pixel inside the picture.
    pub fn rgb(&self, x: u32, y: u32) -> [u8; 3] {
        let at = 4 * self.index(x, y);
        [self.rgba[at], self.rgba[at + 1], self.rgba[at + 2]]
    }

    /// What is seen at a pixel inside the picture, or `None` for background.
    pub fn hit(&self, x: u32, y: u32) -> Option<Hit> {
        self.hits[self.index(x, y)]
    }

    /// All hits, row by row: face ids, depths and the coverage mask in one.
    pub fn hits(&self) -> &[Option<Hit>] {
        &self.hits
    }

    /// Pixels that show a face.
    pub fn covered_pixels(&self) -> usize {
        self.hits.iter().flatten().count()
    }

    /// Writes the colours as PNG.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_png(&self, path: &Path) -> anyhow::Result<()> {
        let file = File::create(path).with_context(|| format!("cannot create {}", path.display()))?;
        let mut encoder = png::Encoder::new(BufWriter::new(file), self.width, self.height);
        encoder.set_color(png::ColorType::Rgba);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&self.rgba)?;
        writer.finish()?;
        Ok(())
    }

    /// Reads an 8-bit RGB or RGBA PNG; see [`Image::from_rgba`].
    ///
    /// # Errors
    /// When the file cannot be read or has another pixel format.
    pub fn read_png(path: &Path) -> anyhow::Result<Self> {
        let file = File::open(path).with_context(|| format!("cannot open {}", path.display()))?;
        let mut reader = png::Decoder::new(BufReader::new(file)).read_info()?;
        let mut bytes = vec![0; reader.output_buffer_size().context("picture too large")?];
        let info = reader.next_frame(&mut bytes)?;
        ensure!(info.bit_depth == png::BitDepth::Eight, "not 8 bits per channel");
        bytes.truncate(info.buffer_size());
        let rgba = match info.color_type {
            png::ColorType::Rgba => bytes,
            png::ColorType::Rgb => bytes.chunks_exact(3).flat_map(|p| [p[0], p[1], p[2], 255]).collect(),
            other => anyhow::bail!("pixel format {other:?}"),
        };
        Self::from_rgba(info.width, info.height, rgba)
    }

    fn index(&self, x: u32, y: u32) -> usize {
        assert!(x < self.width && y < self.height, "pixel ({x}, {y}) outside {} x {}", self.width, self.height);
        y as usize * self.width as usize + x as usize
    }

    fn set(&mut self, index: usize, hit: Hit, linear: DVec3) {
        self.hits[index] = Some(hit);
        let rgb = linear.to_array().map(encode_srgb);
        self.rgba[4 * index..4 * index + 3].copy_from_slice(&rgb);
    }
}

/// View-projection of a perspective camera at `eye`.
///
/// `aspect` is width over height. Near and far plane enclose the sphere around the box's middle through its corners,
/// or start at a thousandth of its radius when the eye is inside.
pub fn perspective(eye: DVec3, target: DVec3, fov_y_rad: f64, aspect: f64, bounds: ([f64; 3], [f64; 3])) -> DMat4 {
    let (lo, hi) = (DVec3::from_array(bounds.0), DVec3::from_array(bounds.1));
    let radius = ((hi - lo).length() * 0.5).max(1e-9);
    let distance = (eye - (lo + hi) * 0.5).length();
    let near = (distance - radius * 1.01).max(radius * 1e-3);
    let projection = directx::perspective(fov_y_rad, aspect, near, distance + radius * 1.01);
    let up = if (target - eye).normalize_or(DVec3::NEG_Z).y.abs() > 0.999 { DVec3::Z } else { DVec3::Y };
    projection * view::look_at_mat4(eye, target, up)
}

/// View-projection that frames a box from `direction` (from its middle to the eye, any length), 45 degrees high.
pub fn framing(bounds: ([f64; 3], [f64; 3]), direction: DVec3, aspect: f64) -> DMat4 {
    let (lo, hi) = (DVec3::from_array(bounds.0), DVec3::from_array(bounds.1));
    let fov_y_rad = std::f64::consts::FRAC_PI_4;
    let narrow = (fov_y_rad * 0.5).tan() * aspect.min(1.0);
    let distance = (hi - lo).length() * 0.5 / narrow.atan().sin();
    let middle = (lo + hi) * 0.5;
    perspective(middle + direction.normalize_or(DVec3::Z) * distance, middle, fov_y_rad, aspect, bounds)
}

/// A corner on its way to the screen.
#[derive(Clone, Copy, Debug)]
struct Corner {
    clip: DVec4,
    /// Linear base colour.
    base: DVec3,
    normal: DVec3,
}

#[cfg(test)]
mod tests;
