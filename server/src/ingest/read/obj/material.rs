//! Material libraries (MTL): the colour and the texture of each material; the rest is for renderers.

use super::super::ReadError;
use super::super::input::{Input, Lines, Words};
use super::super::number::parse_f64;
use super::super::texture::Wrap;
use super::super::texture::color::channel_from_unit;

/// Most materials of one mesh.
pub(super) const MAX_MATERIALS: usize = 1 << 16;

/// Longest name of a material or a texture, in bytes.
pub(super) const MAX_NAME: usize = 1 << 10;

/// What a material says about colour.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Material {
    pub(super) name: Vec<u8>,
    /// `Kd`, which is sRGB by custom.
    pub(super) color: Option<[u8; 3]>,
    pub(super) map: Option<Map>,
}

/// A `map_Kd` statement.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Map {
    pub(super) file: String,
    pub(super) wrap: Wrap,
    /// Texture coordinates are multiplied by this, then moved.
    pub(super) scale: [f64; 2],
    pub(super) offset: [f64; 2],
}

/// Appends the materials of a library to `materials`, as long as there is room, and says whether there was.
///
/// # Errors
/// Those of the file, and lines of excessive length. Statements that make no sense are passed over: a picture without a
/// texture is better than none.
pub(super) fn read_library(input: &mut Input<'_>, materials: &mut Vec<Material>) -> Result<bool, ReadError> {
    let mut lines = Lines::new(input)?;
    let mut current: Option<Material> = None;
    while let Some((_, line)) = lines.next(b'#')? {
        let mut words = Words(line);
        match words.next().unwrap_or_default() {
            b"newmtl" => {
                materials.extend(current.take());
                if materials.len() >= MAX_MATERIALS {
                    return Ok(false);
                }
                let name = words.0.trim_ascii();
                current = Some(Material { name: name[..name.len().min(MAX_NAME)].to_vec(), ..Material::default() });
            }
            b"Kd" => {
                if let (Some(material), Some(color)) = (&mut current, parse_color(words)) {
                    material.color = Some(color);
                }
            }
            b"map_Kd" => {
                if let (Some(material), Some(map)) = (&mut current, parse_map(words.0)) {
                    material.map = Some(map);
                }
            }
            _ => {}
        }
    }
    materials.extend(current);
    Ok(true)
}

/// `r`, or `r g b`; spectral curves and CIE XYZ are passed over.
fn parse_color(mut words: Words<'_>) -> Option<[u8; 3]> {
    let red = parse_f64(words.next()?)?;
    let rest = [words.next(), words.next()].map(|word| word.and_then(parse_f64));
    Some([red, rest[0].unwrap_or(red), rest[1].unwrap_or(red)].map(channel_from_unit))
}

/// Options, then the name of a file, which may have spaces in it.
fn parse_map(text: &[u8]) -> Option<Map> {
    let mut map = Map { file: String::new(), wrap: Wrap::Repeat, scale: [1.0; 2], offset: [0.0; 2] };
    let mut words = Words(text);
    loop {
        let mut rest = words.clone();
        let option = rest.next()?;
        let arguments: usize = match option {
            b"-s" | b"-o" | b"-t" => {
                let mut numbers = [None; 3];
                for number in &mut numbers {
                    let mut ahead = rest.clone();
                    match ahead.next().and_then(parse_f64) {
                        Some(value) => (*number, rest) = (Some(value), ahead),
                        None => break,
                    }
                }
                let missing = if option == b"-s" { 1.0 } else { 0.0 };
                let pair = [numbers[0].unwrap_or(missing), numbers[1].unwrap_or(missing)];
                match option {
                    b"-s" => map.scale = pair,
                    b"-o" => map.offset = pair,
                    _ => {}
                }
                0
            }
            b"-clamp" => {
                map.wrap = if rest.next() == Some(b"on") { Wrap::Clamp } else { Wrap::Repeat };
                0
            }
            b"-blendu" | b"-blendv" | b"-cc" | b"-texres" | b"-bm" | b"-boost" | b"-imfchan" | b"-type"
            | b"-colorspace" => 1,
            b"-mm" => 2,
            _ => break,
        };
        rest.by_ref().take(arguments).for_each(drop);
        words = rest;
    }
    let file = words.0.trim_ascii();
    if file.is_empty() || file.len() > MAX_NAME {
        return None;
    }
    map.file = String::from_utf8_lossy(file).into_owned();
    Some(map)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Vec<Material> {
        let mut materials = Vec::new();
        assert!(read_library(&mut Input::of_slice(text.as_bytes()), &mut materials).unwrap());
        materials
    }

    #[test]
    fn colours_and_textures_are_read() {
        let materials = read(
            "Kd 1 1 1\nnewmtl a b\r\n\tKd 0.5\n\tmap_Kd my skin.png\nnewmtl c\nKd 1 0 2 # x\nNs 3\nmap_bump b.png\n\
             newmtl d\nKd spectral a.rfl\nmap_Kd -s 2 3 1 -clamp on -o 0.5 -bm 1 -mm 0 1 dir/t.jpg\nmap_Kd\n",
        );
        let map = |file: &str, wrap, scale, offset| Some(Map { file: file.into(), wrap, scale, offset });
        assert_eq!(
            materials,
            [
                Material {
                    name: b"a b".to_vec(),
                    color: Some([128; 3]),
                    map: map("my skin.png", Wrap::Repeat, [1.0; 2], [0.0; 2])
                },
                Material { name: b"c".to_vec(), color: Some([255, 0, 255]), map: None },
                Material {
                    name: b"d".to_vec(),
                    color: None,
                    map: map("dir/t.jpg", Wrap::Clamp, [2.0, 3.0], [0.5, 0.0])
                },
            ]
        );
    }

    #[test]
    fn the_number_of_materials_is_limited() {
        let text = "newmtl a\n".repeat(MAX_MATERIALS + 5);
        let mut materials = Vec::new();
        assert!(!read_library(&mut Input::of_slice(text.as_bytes()), &mut materials).unwrap());
        assert_eq!(materials.len(), MAX_MATERIALS);
    }
}
