//! PNG and JPEG to textures. Sizes are checked before anything is decoded, and large images are reduced as they come.

use std::io::Cursor;

use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use super::Texture;

/// Longest side of an image that is decoded.
const MAX_SIDE: u32 = 1 << 14;

/// Pixels of an image that can only be decoded whole.
const MAX_WHOLE: u64 = 1 << 26;

/// Longest side of a texture that is kept. Larger images are reduced by a power of two, which also keeps vertices that lie
/// many pixels apart from picking single ones.
const MAX_KEPT_SIDE: u32 = 1 << 12;

/// Pixels that a byte of JPEG can stand for: six blocks of 16 x 16 pixels take a bit each at least.
const MAX_JPEG_PIXELS_PER_BYTE: u64 = 512;

/// Decodes an image by what its first bytes say it is, and takes its pixels off `pixels_left`.
///
/// # Errors
/// A sentence fragment that says what is wrong with it.
pub(super) fn decode(bytes: &[u8], pixels_left: &mut u64) -> Result<Texture, String> {
    match bytes {
        [0x89, b'P', b'N', b'G', ..] => decode_png(bytes, pixels_left),
        [0xff, 0xd8, ..] => decode_jpeg(bytes, pixels_left),
        [] => Err("its file is empty".into()),
        _ => Err("it is neither PNG nor JPEG".into()),
    }
}

fn check_size(width: u32, height: u32, pixels_left: &mut u64) -> Result<(), String> {
    if width == 0 || height == 0 {
        return Err("it has no pixels".into());
    }
    if width > MAX_SIDE || height > MAX_SIDE {
        return Err(format!("{width} x {height} pixels are over the limit of {MAX_SIDE} x {MAX_SIDE}"));
    }
    let pixels = u64::from(width) * u64::from(height);
    *pixels_left = pixels_left.checked_sub(pixels).ok_or("the textures before it took all the pixels of one mesh")?;
    Ok(())
}

fn check_whole(width: u32, height: u32) -> Result<(), String> {
    if u64::from(width) * u64::from(height) > MAX_WHOLE {
        return Err(format!("{width} x {height} pixels are over the limit of {MAX_WHOLE} for this kind of image"));
    }
    Ok(())
}

fn decode_png(bytes: &[u8], pixels_left: &mut u64) -> Result<Texture, String> {
    let mut decoder = png::Decoder::new(Cursor::new(bytes));
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    let failed = |error: png::DecodingError| error.to_string();
    let header = decoder.read_header_info().map_err(failed)?;
    let (width, height) = (header.width, header.height);
    check_size(width, height, pixels_left)?;
    let mut reader = decoder.read_info().map_err(failed)?;
    let samples = reader.output_color_type().0.samples();
    let mut reduce = Reduce::new(width, height);
    if reader.info().interlaced {
        check_whole(width, height)?;
        let len = reader.output_buffer_size().ok_or("it is too large")?;
        let mut image = vec![0; len];
        reader.next_frame(&mut image).map_err(failed)?;
        image.chunks_exact(width as usize * samples).for_each(|row| reduce.push_row(row, samples));
    } else {
        while let Some(row) = reader.next_row().map_err(failed)? {
            reduce.push_row(row.data(), samples);
        }
    }
    reduce.finish()
}

fn decode_jpeg(bytes: &[u8], pixels_left: &mut u64) -> Result<Texture, String> {
    let options = DecoderOptions::new_safe()
        .set_max_width(MAX_SIDE as usize)
        .set_max_height(MAX_SIDE as usize)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = JpegDecoder::new_with_options(Cursor::new(bytes), options);
    decoder.decode_headers().map_err(|error| error.to_string())?;
    let info = decoder.info().ok_or("it has no header")?;
    let (width, height) = (u32::from(info.width), u32::from(info.height));
    check_size(width, height, pixels_left)?;
    check_whole(width, height)?;
    // The decoder takes the memory for all pixels at once, on the header's word.
    if u64::from(width) * u64::from(height) > bytes.len() as u64 * MAX_JPEG_PIXELS_PER_BYTE {
        return Err(format!("{} bytes cannot hold {width} x {height} pixels", bytes.len()));
    }
    let image = decoder.decode().map_err(|error| error.to_string())?;
    let mut reduce = Reduce::new(width, height);
    image.chunks_exact(width as usize * 3).for_each(|row| reduce.push_row(row, 3));
    reduce.finish()
}

/// Takes an image row by row and keeps means of squares of its pixels.
struct Reduce {
    /// Of the image.
    width: u32,
    height: u32,
    /// Pixels on a side of a square: a power of two.
    factor: u32,
    /// Sums over the rows of squares begun, and the rows in them.
    sums: Vec<[u32; 3]>,
    rows: u32,
    texels: Vec<[u8; 3]>,
}

impl Reduce {
    fn new(width: u32, height: u32) -> Self {
        let factor = width.max(height).div_ceil(MAX_KEPT_SIDE).next_power_of_two();
        let sums = vec![[0; 3]; width.div_ceil(factor) as usize];
        Self { width, height, factor, sums, rows: 0, texels: Vec::new() }
    }

    /// Adds a row of pixels with 1 (grey), 2 (grey, alpha), 3 (RGB) or 4 (RGB, alpha) bytes each. Alpha is left.
    fn push_row(&mut self, row: &[u8], samples: usize) {
        let pixel = |bytes: &[u8]| if samples < 3 { [bytes[0]; 3] } else { [bytes[0], bytes[1], bytes[2]] };
        if self.factor == 1 {
            self.texels.extend(row.chunks_exact(samples).map(pixel));
            return;
        }
        for (sums, square) in self.sums.iter_mut().zip(row.chunks(samples * self.factor as usize)) {
            for bytes in square.chunks_exact(samples) {
                let rgb = pixel(bytes);
                (0..3).for_each(|k| sums[k] += u32::from(rgb[k]));
            }
        }
        self.rows += 1;
        if self.rows == self.factor {
            self.end_squares();
        }
    }

    fn end_squares(&mut self) {
        for (column, sums) in self.sums.iter_mut().enumerate() {
            let across = (self.width - column as u32 * self.factor).min(self.factor);
            let pixels = across * self.rows;
            self.texels.push(sums.map(|sum| ((sum + pixels / 2) / pixels) as u8));
            *sums = [0; 3];
        }
        self.rows = 0;
    }

    fn finish(mut self) -> Result<Texture, String> {
        if self.rows > 0 {
            self.end_squares();
        }
        let size = [self.sums.len(), self.height.div_ceil(self.factor) as usize];
        if self.texels.len() != size[0] * size[1] {
            return Err("rows are missing".into());
        }
        let extent = [self.width, self.height].map(|side| f64::from(side) / f64::from(self.factor));
        Ok(Texture { size, extent, texels: self.texels })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn png(width: u32, height: u32, color: png::ColorType, data: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        let mut encoder = png::Encoder::new(&mut out, width, height);
        encoder.set_color(color);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.write_header().unwrap().write_image_data(data).unwrap();
        out
    }

    fn decoded(bytes: &[u8]) -> Result<Texture, String> {
        decode(bytes, &mut u64::MAX.clone())
    }

    #[test]
    fn every_colour_type_of_png_is_read() {
        for (color, data, expected) in [
            (png::ColorType::Grayscale, &[7, 9][..], [[7; 3], [9; 3]]),
            (png::ColorType::GrayscaleAlpha, &[7, 0, 9, 255], [[7; 3], [9; 3]]),
            (png::ColorType::Rgb, &[1, 2, 3, 4, 5, 6], [[1, 2, 3], [4, 5, 6]]),
            (png::ColorType::Rgba, &[1, 2, 3, 0, 4, 5, 6, 255], [[1, 2, 3], [4, 5, 6]]),
        ] {
            let texture = decoded(&png(2, 1, color, data)).unwrap();
            assert_eq!((texture.size, &texture.texels[..]), ([2, 1], &expected[..]));
        }
    }

    #[test]
    fn jpeg_is_read() {
        let mut bytes = super::super::super::testing::jpeg();
        let texture = decoded(&bytes).unwrap();
        assert_eq!(texture.size, [8, 8]);
        // Y 159, Cb 144, Cr 159: R = Y + 1.402 (Cr - 128), and so on.
        let expected = [159.0 + 1.402 * 31.0, 159.0 - 0.344 * 16.0 - 0.714 * 31.0, 159.0 + 1.772 * 16.0];
        for texel in &texture.texels {
            assert!((0..3).all(|k| (f64::from(texel[k]) - expected[k]).abs() < 2.5), "{texel:?} {expected:?}");
        }
        // The header promises more than the file can hold.
        let at = bytes.windows(2).position(|marker| marker == [0xff, 0xc0]).unwrap();
        bytes[at + 5..at + 9].copy_from_slice(&[0x1f, 0, 0x1f, 0]);
        assert_eq!(decoded(&bytes).unwrap_err(), format!("{} bytes cannot hold 7936 x 7936 pixels", bytes.len()));
        assert!(decoded(&[0xff, 0xd8, 0xff]).is_err());
    }

    #[test]
    fn large_images_are_reduced_to_means() {
        let (width, height) = (MAX_KEPT_SIDE + 3, 3);
        let pixel = |x: u32, y: u32| [(x % 251) as u8, (y * 50) as u8, ((x + y) % 7) as u8];
        let data: Vec<u8> = (0..height).flat_map(|y| (0..width).flat_map(move |x| pixel(x, y))).collect();
        let texture = decoded(&png(width, height, png::ColorType::Rgb, &data)).unwrap();
        assert_eq!(texture.size, [width.div_ceil(2) as usize, 2]);
        for (row, column) in [(0, 0), (0, 700), (1, 5), (1, texture.size[0] as u32 - 1)] {
            let inside = |x: u32, y: u32| (x < width && y < height).then(|| pixel(x, y));
            let square = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(x, y)| inside(2 * column + x, 2 * row + y));
            let pixels: Vec<_> = square.into_iter().flatten().collect();
            let mean: [u8; 3] = std::array::from_fn(|k| {
                let sum: f64 = pixels.iter().map(|pixel| f64::from(pixel[k])).sum();
                (sum / pixels.len() as f64 + 0.5) as u8
            });
            assert_eq!(texture.texels[row as usize * texture.size[0] + column as usize], mean);
        }
        // The middle of the image stays in the middle.
        let middle = texture.sample([0.5, 0.5], Default::default());
        assert!((middle[1] - 50.0).abs() < 20.0);
    }

    #[test]
    fn what_is_too_large_is_refused_before_it_is_decoded() {
        let mut header = png(2, 1, png::ColorType::Grayscale, &[0, 0]);
        header[16..20].copy_from_slice(&40_000_u32.to_be_bytes());
        // The checksum of the header no longer fits, which comes first.
        assert!(decoded(&header).is_err());
        let row = vec![0; MAX_SIDE as usize + 1];
        let error = decoded(&png(MAX_SIDE + 1, 1, png::ColorType::Grayscale, &row)).unwrap_err();
        assert_eq!(error, "16385 x 1 pixels are over the limit of 16384 x 16384");
        let small = png(2, 1, png::ColorType::Grayscale, &[0, 0]);
        let mut left = 3;
        decode(&small, &mut left).unwrap();
        assert_eq!(left, 1);
        assert!(decode(&small, &mut left).unwrap_err().contains("took all the pixels"));
        assert_eq!(decoded(b"BM").unwrap_err(), "it is neither PNG nor JPEG");
        assert!(decoded(&small[..small.len() - 20]).is_err());
    }
}
