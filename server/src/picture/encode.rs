//! Samples into a PNG that keeps a length.

use glam::DVec3;

use super::camera::Window;
use super::raster::{Canvas, linear};

/// Most and fewest bits per channel.
const BITS: [u32; 2] = [8, 4];
/// Keyword of the text in the PNG that says which part of the viewer's first view it is, see [`Window`].
const WINDOW: &str = "Lodestream window";
/// Linear colour of surfaces without colours of their own: the viewer's clay.
const CLAY: DVec3 = DVec3::new(0.80, 0.78, 0.74);
/// Shades of clay in a palette, apart from those at edges, which have a third of them for each share of coverage.
const SHADES: usize = 190;
const EDGE_SHADES: usize = 16;
/// Coverage at edges, in steps: none and all are no edges.
const COVERAGE_STEPS: usize = 5;

/// How a picture is encoded.
#[derive(Clone, Copy, Debug)]
pub(super) struct Encoding {
    /// Samples per pixel and direction.
    pub(super) oversampling: u32,
    /// Whether surfaces are white and to be shown as clay.
    pub(super) is_clay: bool,
    /// What the picture shows, if it shows something.
    pub(super) window: Option<Window>,
}

/// Encodes as PNG with the best of these that stays within `max_bytes`: all the pixels with 8 bits per channel down to 4, then
/// likewise half of them across and down, and so on. The alpha channel is the share of a pixel that is covered. Clay has a
/// palette; where else all is grey, one channel stands for three.
pub(super) fn within(canvas: &Canvas, encoding: Encoding, max_bytes: usize) -> Vec<u8> {
    let mut samples = encoding.oversampling;
    loop {
        let (width, height, pixels) = resolve(canvas, samples);
        // Each bit more takes more bytes, so the interval is halved, once it is known that the most are too many.
        let [mut bits, few] = BITS;
        let (mut enough, mut too_many) = (few - 1, bits + 1);
        let mut best = None;
        while enough + 1 < too_many {
            let image = if encoding.is_clay { clay(&pixels, bits) } else { colors(&rounded(&pixels, bits)) };
            let png = encode(width, height, image, encoding.window);
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

/// The part of the viewer's first view that a picture says it is; `None` if it does not say.
pub fn window(png: &[u8]) -> Option<Window> {
    let limits = png::Limits { bytes: 1 << 16 };
    let reader = png::Decoder::new_with_limits(std::io::Cursor::new(png), limits).read_info().ok()?;
    let text = reader.info().uncompressed_latin1_text.iter().find(|text| text.keyword == WINDOW)?;
    Window::from_text(&text.text)
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

/// Bytes of a picture and what they mean.
struct Image {
    kind: png::ColorType,
    bytes: Vec<u8>,
    /// Red, green and blue of each index, and its opacity.
    palette: Option<(Vec<u8>, Vec<u8>)>,
}

fn colors(rgba: &[u8]) -> Image {
    let is_grey = rgba.chunks_exact(4).all(|pixel| pixel[0] == pixel[1] && pixel[1] == pixel[2]);
    if is_grey {
        let bytes = rgba.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[3]]).collect();
        return Image { kind: png::ColorType::GrayscaleAlpha, bytes, palette: None };
    }
    Image { kind: png::ColorType::Rgba, bytes: rgba.to_vec(), palette: None }
}

/// White surfaces in shades of clay, as many as so many bits can tell apart. A byte per pixel, of which most are shades in
/// their order, which predict each other well.
fn clay(pixels: &[[u8; 4]], bits: u32) -> Image {
    let shades = SHADES.min(1 << bits);
    let mut table = vec![[0; 4]];
    for (shades, coverage) in
        std::iter::once((shades, COVERAGE_STEPS)).chain((1..COVERAGE_STEPS).map(|step| (EDGE_SHADES, step)))
    {
        for shade in 0..shades {
            let white = (shade * 255 / (shades - 1)) as u8;
            let [r, g, b] = (linear([white; 3]) * CLAY).to_array().map(encode_srgb);
            table.push([r, g, b, (coverage * 255 / COVERAGE_STEPS) as u8]);
        }
    }
    let nearest = |value: u8, steps: usize| (usize::from(value) * steps + 127) / 255;
    let bytes = pixels.iter().map(|&[white, _, _, alpha]| {
        let index = match nearest(alpha, COVERAGE_STEPS) {
            0 => 0,
            COVERAGE_STEPS => 1 + nearest(white, shades - 1),
            step => 1 + shades + (step - 1) * EDGE_SHADES + nearest(white, EDGE_SHADES - 1),
        };
        u8::try_from(index).expect("the palette has at most 256 entries")
    });
    let bytes = bytes.collect();
    let palette = (
        table.iter().flat_map(|color| [color[0], color[1], color[2]]).collect(),
        table.iter().map(|color| color[3]).collect(),
    );
    Image { kind: png::ColorType::Indexed, bytes, palette: Some(palette) }
}

fn encode(width: u32, height: u32, image: Image, window: Option<Window>) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, width, height);
    encoder.set_color(image.kind);
    encoder.set_depth(png::BitDepth::Eight);
    if let Some((colors, opacity)) = image.palette {
        encoder.set_palette(colors);
        encoder.set_trns(opacity);
    }
    // Several tries may be needed, so each must be quick.
    encoder.set_compression(png::Compression::Balanced);
    encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    if let Some(window) = window {
        encoder.add_text_chunk(WINDOW.into(), window.to_text()).expect("a few digits are a text");
    }
    let mut writer = encoder.write_header().expect("a picture has pixels, and memory takes them");
    writer.write_image_data(&image.bytes).expect("each pixel has its bytes");
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
