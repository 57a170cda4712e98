//! Textures, from which readers bake vertex colours: found beside the mesh, decoded within limits, sampled.
//!
//! Knows PNG and JPEG, see [`decode`]; how colours mix is in [`color`].

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Component, Path, PathBuf};
use std::rc::Rc;

pub(super) mod color;
pub(super) mod decode;

use decode::decode;

/// Longest encoded image that is read, in bytes.
const MAX_ENCODED: u64 = 128 << 20;

/// Texels that are kept in memory at once, three bytes each.
const MAX_TEXELS_KEPT: u64 = 64 << 20;

/// Pixels that are decoded for one mesh, or a small file could keep the reader busy for hours with large empty images.
const MAX_PIXELS_DECODED: u64 = 8 << 30;

/// Most notes on textures that a report holds.
const MAX_NOTES: usize = 16;

/// What a coordinate outside 0..=1 stands for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Wrap {
    #[default]
    Repeat,
    Clamp,
    Mirror,
}

impl Wrap {
    /// The texel that `index` stands for in a row of `len`.
    #[inline]
    fn texel(self, index: i64, len: i64) -> usize {
        let texel = match self {
            Self::Clamp => index.clamp(0, len - 1),
            Self::Repeat => index.rem_euclid(len),
            Self::Mirror => {
                let turn = index.rem_euclid(2 * len);
                if turn < len { turn } else { 2 * len - 1 - turn }
            }
        };
        usize::try_from(texel).expect("within the row")
    }
}

/// An image, top row first.
#[derive(Debug, PartialEq)]
pub(super) struct Texture {
    /// Texels across and down.
    size: [usize; 2],
    /// The same before it was reduced, in texels: the last one may stand for fewer pixels than the others.
    extent: [f64; 2],
    /// sRGB, `len == size[0] * size[1]`, at least one.
    texels: Vec<[u8; 3]>,
}

impl Texture {
    /// Color at `uv`, sRGB in 0.0..=255.0, bilinear between texel centres; `uv` is (0, 0) at the top left.
    pub(super) fn sample(&self, uv: [f64; 2], wrap: [Wrap; 2]) -> [f64; 3] {
        let axis = |k: usize| {
            let at = uv[k] * self.extent[k] - 0.5;
            // Beyond this, coordinates have no fraction left; `as` would saturate.
            let at = if at.abs() < 1e15 { at } else { 0.0 };
            let low = at.floor();
            let texel = |i| wrap[k].texel(i, self.size[k] as i64);
            (texel(low as i64), texel(low as i64 + 1), at - low)
        };
        let (left, right, x) = axis(0);
        let (top, bottom, y) = axis(1);
        let texel = |column: usize, row: usize| self.texels[row * self.size[0] + column];
        let corners = [texel(left, top), texel(right, top), texel(left, bottom), texel(right, bottom)];
        std::array::from_fn(|channel| {
            let [a, b, c, d] = corners.map(|corner| f64::from(corner[channel]));
            let (upper, lower) = (a + (b - a) * x, c + (d - c) * x);
            upper + (lower - upper) * y
        })
    }
}

/// The file `name` in `directory` or below it, opened, with its length.
///
/// # Errors
/// A sentence fragment that says why there is none: a name that leads out of the directory, no such file, no file.
pub(super) fn open_beside(directory: Option<&Path>, name: &str) -> Result<(File, u64), String> {
    let Some(directory) = directory else { return Err("there is no directory to look in".into()) };
    // Materials made on Windows write backslashes, wherever they are read.
    let relative = PathBuf::from(name.replace('\\', "/"));
    let is_inside = relative.components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
    if !is_inside || name.contains(':') {
        return Err("it is not in the directory of the mesh".into());
    }
    let real = |path: &Path| path.canonicalize().map_err(|error| error.to_string());
    // A link may lead out as well.
    let directory = if directory.as_os_str().is_empty() { Path::new(".") } else { directory };
    let path = real(&directory.join(relative))?;
    if !path.starts_with(real(directory)?) {
        return Err("it is not in the directory of the mesh".into());
    }
    // Before it is opened: opening a pipe waits for somebody to write.
    if !path.is_file() {
        return Err("it is not a file".into());
    }
    let file = File::open(&path).map_err(|error| error.to_string())?;
    let metadata = file.metadata().map_err(|error| error.to_string())?;
    Ok((file, metadata.len()))
}

/// The decoded textures of one mesh: as many as fit are kept, the others decoded again when they are needed again.
pub(super) struct Gallery {
    kept: BTreeMap<String, Kept>,
    /// Grows with each use.
    clock: u64,
    pixels_left: u64,
    /// Why textures are missing, one sentence fragment each.
    notes: Vec<String>,
    notes_left_out: u64,
    baked: Vec<String>,
}

struct Kept {
    /// `None` if it cannot be had.
    texture: Option<Rc<Texture>>,
    used: u64,
}

impl Gallery {
    pub(super) fn new() -> Self {
        Self {
            kept: BTreeMap::new(),
            clock: 0,
            pixels_left: MAX_PIXELS_DECODED,
            notes: Vec::new(),
            notes_left_out: 0,
            baked: Vec::new(),
        }
    }

    /// The texture of the file `name` beside the mesh, or `None` and a note.
    pub(super) fn beside(&mut self, directory: Option<&Path>, name: &str) -> Option<Rc<Texture>> {
        self.get(name, || {
            let (file, len) = open_beside(directory, name)?;
            read_encoded(file, len)
        })
    }

    /// The texture called `name` among those of the mesh, whose file `encoded` reads if it is not kept.
    pub(super) fn get(&mut self, name: &str, encoded: impl FnOnce() -> Result<Vec<u8>, String>) -> Option<Rc<Texture>> {
        self.clock += 1;
        if let Some(kept) = self.kept.get_mut(name) {
            kept.used = kept.used.max(self.clock);
            return kept.texture.clone();
        }
        let result = encoded().and_then(|bytes| decode(&bytes, &mut self.pixels_left));
        let texture = match result {
            Ok(texture) => {
                if !self.baked.iter().any(|baked| baked == name) {
                    self.baked.push(name.to_owned());
                }
                Some(Rc::new(texture))
            }
            Err(problem) => {
                self.note(format!("texture {}: {problem}", shown(name)));
                None
            }
        };
        // One that cannot be had now is not tried again.
        let used = if texture.is_some() { self.clock } else { u64::MAX };
        self.make_room(texture.as_ref().map_or(0, |t| t.texels.len() as u64));
        self.kept.insert(name.to_owned(), Kept { texture: texture.clone(), used });
        texture
    }

    fn make_room(&mut self, texels: u64) {
        let len = |kept: &Kept| kept.texture.as_ref().map_or(0, |texture| texture.texels.len() as u64);
        while texels + self.kept.values().map(len).sum::<u64>() > MAX_TEXELS_KEPT {
            let oldest = self.kept.iter().filter(|(_, kept)| kept.texture.is_some());
            let Some(oldest) = oldest.min_by_key(|(_, kept)| kept.used).map(|(name, _)| name.clone()) else { return };
            self.kept.remove(&oldest);
        }
    }

    /// Says in the report that something is missing.
    pub(super) fn note(&mut self, note: String) {
        if self.notes.contains(&note) {
            return;
        }
        if self.notes.len() < MAX_NOTES {
            self.notes.push(note);
        } else {
            self.notes_left_out += 1;
        }
    }

    /// What is missing, and the names of the textures that were used.
    pub(super) fn into_report(mut self) -> (Vec<String>, Vec<String>) {
        if self.notes_left_out > 0 {
            self.notes.push(format!("{} more textures or materials", self.notes_left_out));
        }
        (self.notes, self.baked)
    }
}

/// Reads an image file, no longer than [`MAX_ENCODED`].
pub(super) fn read_encoded(source: impl Read, len: u64) -> Result<Vec<u8>, String> {
    if len > MAX_ENCODED {
        return Err(format!("its file of {len} bytes is over the limit of {MAX_ENCODED}"));
    }
    let mut bytes = Vec::new();
    source.take(len).read_to_end(&mut bytes).map_err(|error| error.to_string())?;
    Ok(bytes)
}

/// A name for people: short and printable.
pub(super) fn shown(name: &str) -> String {
    name.chars().take(80).map(|c| if c.is_control() { '?' } else { c }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(texels: &[[u8; 3]]) -> Texture {
        Texture { size: [texels.len(), 1], extent: [texels.len() as f64, 1.0], texels: texels.to_vec() }
    }

    #[test]
    fn samples_lie_between_texel_centres() {
        let texture = row(&[[0, 100, 0], [100, 0, 0], [200, 0, 200]]);
        let at = |u, wrap| texture.sample([u, 0.5], [wrap; 2]);
        assert_eq!(at(0.5 / 3.0, Wrap::Repeat), [0.0, 100.0, 0.0]);
        let halfway = at(1.0 / 3.0, Wrap::Clamp);
        assert!((halfway[0] - 50.0).abs() < 1e-9 && (halfway[1] - 50.0).abs() < 1e-9 && halfway[2] == 0.0);
        // At the edge: the neighbour is the far texel, the texel itself, the texel itself.
        assert_eq!(at(0.0, Wrap::Repeat), [100.0, 50.0, 100.0]);
        assert_eq!(at(0.0, Wrap::Clamp), [0.0, 100.0, 0.0]);
        assert_eq!(at(0.0, Wrap::Mirror), [0.0, 100.0, 0.0]);
        let center = |k: f64| (k + 0.5) / 3.0;
        let close = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9);
        assert!(close(at(center(4.0), Wrap::Repeat), [100.0, 0.0, 0.0]));
        assert!(close(at(center(4.0), Wrap::Clamp), [200.0, 0.0, 200.0]));
        assert!(close(at(center(3.0), Wrap::Mirror), [200.0, 0.0, 200.0]));
        assert!(close(at(center(-1.0), Wrap::Mirror), [0.0, 100.0, 0.0]));
        assert!(close(at(center(5.0), Wrap::Mirror), [0.0, 100.0, 0.0]));
        for odd in [f64::NAN, f64::INFINITY, -1e300] {
            texture.sample([odd, odd], [Wrap::Repeat, Wrap::Mirror]);
        }
    }

    #[test]
    fn names_that_lead_out_of_the_directory_are_refused() {
        let directory = std::env::temp_dir();
        for name in ["../x.png", "/etc/hostname", "a/../../x.png", "..\\x.png", "C:\\x.png", "\\x.png"] {
            let error = open_beside(Some(&directory), name).unwrap_err();
            assert_eq!(error, "it is not in the directory of the mesh", "{name}");
        }
        assert!(open_beside(Some(&directory), "no-such-file.png").is_err());
        assert_eq!(open_beside(Some(&directory), "").unwrap_err(), "it is not a file");
        assert!(open_beside(None, "x.png").is_err());
    }
}
