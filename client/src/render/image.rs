//! Pixels and PNG files.

use std::io::{BufWriter, Write};
use std::path::Path;

use super::error::RenderError;

/// Rows from the top, sRGB, opaque.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `len == 4 * width * height`.
    pub rgba: Vec<u8>,
}

impl Image {
    /// Red, green and blue of a pixel, `(0, 0)` at the top left.
    ///
    /// # Panics
    /// If the pixel is outside.
    pub fn pixel(&self, x: u32, y: u32) -> [u8; 3] {
        assert!(x < self.width && y < self.height, "pixel ({x}, {y}) of {} x {}", self.width, self.height);
        let at = 4 * (y as usize * self.width as usize + x as usize);
        [self.rgba[at], self.rgba[at + 1], self.rgba[at + 2]]
    }

    /// Encodes as PNG. Alpha is left out, since nothing is transparent.
    ///
    /// # Errors
    /// [`RenderError::Png`] if `to` does not take the bytes.
    pub fn encode_png(&self, to: impl Write) -> Result<(), RenderError> {
        let mut encoder = png::Encoder::new(to, self.width, self.height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        let rgb: Vec<u8> = self.rgba.chunks_exact(4).flat_map(|pixel| &pixel[..3]).copied().collect();
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&rgb)?;
        Ok(writer.finish()?)
    }

    /// Writes a PNG file.
    ///
    /// # Errors
    /// [`RenderError::Io`], [`RenderError::Png`].
    pub fn write_png(&self, path: &Path) -> Result<(), RenderError> {
        let mut file = BufWriter::new(std::fs::File::create(path)?);
        self.encode_png(&mut file)?;
        Ok(file.flush()?)
    }
}
