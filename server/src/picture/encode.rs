//! Samples into a PNG that keeps a length.

use super::raster::Canvas;

/// Most and fewest bits per channel.
const BITS: [u32; 2] = [8, 4];

/// Encodes as PNG with the best of these that stays within `max_bytes`: all the pixels with 8 bits per channel down to 4, then
/// likewise half of them across and down, and so on. The alpha channel is the share of a pixel that is covered. Where all is
/// grey, one channel stands for three.
pub(super) fn within(canvas: &Canvas, oversampling: u32, max_bytes: usize) -> Vec<u8> {
    let mut samples = oversampling;
    loop {
        let (width, height, pixels) = resolve(canvas, samples);
        // Each bit more takes more bytes, so the interval is halved, once it is known that the most are too many.
        let [mut bits, few] = BITS;
        let (mut enough, mut too_many) = (few - 1, bits + 1);
        let mut best = None;
        while enough + 1 < too_many {
            let png = encode(width, height, &rounded(&pixels, bits));
            if png.len() <= max_bytes || (width, height) == (1, 1) {
                (enough, best) = (bits, Some(png));
            } else {
                too_many = bits;
            }
            bits = (enough + too_many).div_ceil(2);
        }
        if let Some(png) = best {
            return png;
        }
        samples *= 2;
    }
}

/// Pixels of `samples` x `samples` each: mean light of what is covered, and the share that is.
fn resolve(canvas: &Canvas, samples: u32) -> (u32, u32, Vec<[u8; 4]>) {
    let (width, height) = ((canvas.width / samples).max(1), (canvas.height / samples).max(1));
    let mut pixels = Vec::with_capacity(width as usize * height as usize);
    for y in 0..height {
        for x in 0..width {
            let (mut sum, mut covered, mut count) = ([0f64; 3], 0u32, 0u32);
            for sample_y in y * samples..((y + 1) * samples).min(canvas.height) {
                for sample_x in x * samples..((x + 1) * samples).min(canvas.width) {
                    count += 1;
                    if let Some(color) = canvas.sample(sample_x, sample_y) {
                        covered += 1;
                        (0..3).for_each(|k| sum[k] += f64::from(color[k]));
                    }
                }
            }
            let [r, g, b] = sum.map(|sum| if covered > 0 { encode_srgb(sum / f64::from(covered)) } else { 0 });
            let alpha = f64::from(covered) / f64::from(count.max(1));
            pixels.push([r, g, b, (alpha * 255.0 + 0.5) as u8]);
        }
    }
    (width, height, pixels)
}

/// sRGB channel of linear light: square roots in place of the standard's power, within a thousandth of it.
fn encode_srgb(linear: f64) -> u8 {
    let c = linear.clamp(0.0, 1.0);
    let (second, fourth, eighth) = (c.sqrt(), c.sqrt().sqrt(), c.sqrt().sqrt().sqrt());
    let encoded = 0.662_002_687 * second + 0.684_122_060 * fourth - 0.323_583_601 * eighth - 0.022_541_147 * c;
    (encoded.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}

/// Colours in so many bits, spread over the whole range again. Full and no coverage stay what they are.
fn rounded(pixels: &[[u8; 4]], bits: u32) -> Vec<u8> {
    let steps = (1u32 << bits) - 1;
    let round = |channel: u8| ((u32::from(channel) * steps + 127) / 255 * 255 / steps) as u8;
    pixels.iter().flat_map(|pixel| pixel.map(round)).collect()
}

fn encode(width: u32, height: u32, rgba: &[u8]) -> Vec<u8> {
    let is_grey = rgba.chunks_exact(4).all(|pixel| pixel[0] == pixel[1] && pixel[1] == pixel[2]);
    let grey: Vec<u8>;
    let (kind, bytes) = if is_grey {
        grey = rgba.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[3]]).collect();
        (png::ColorType::GrayscaleAlpha, &grey[..])
    } else {
        (png::ColorType::Rgba, rgba)
    };
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, width, height);
    encoder.set_color(kind);
    encoder.set_depth(png::BitDepth::Eight);
    // Several tries may be needed, so each must be quick.
    encoder.set_compression(png::Compression::Balanced);
    encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    let mut writer = encoder.write_header().expect("a picture has pixels, and memory takes them");
    writer.write_image_data(bytes).expect("each pixel has its bytes");
    writer.finish().expect("memory takes the end");
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_is_encoded_as_the_standard_says() {
        for level in 0..=1000 {
            let c = f64::from(level) / 1000.0;
            let standard = if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
            let found = f64::from(encode_srgb(c)) / 255.0;
            assert!((found - standard).abs() < 0.004 || c < 0.002 && found < 0.02, "{c}: {found} against {standard}");
        }
    }

    #[test]
    fn rounding_keeps_the_ends() {
        for bits in 4..=8 {
            assert_eq!(rounded(&[[0, 255, 0, 255]], bits), [0, 255, 0, 255]);
        }
        assert_eq!(rounded(&[[1, 100, 200, 254]], 8), [1, 100, 200, 254]);
    }
}
