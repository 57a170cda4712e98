//! What a person may set, with names and values as text: the same words in the page, in links and in tests.

use std::fmt;
use std::str::FromStr;

use glam::{DVec3, Vec3};
use lodestream_protocol::view::Plane;

use crate::render::{RenderOptions, Shading};

/// Ranges of the numbers.
const TRIANGLES: (u32, u32) = (100, 100_000_000);
const TOLERANCE_PX: (f32, f32) = (0.0, 1000.0);
const BYTE_RATE: (u32, u32) = (1_000, 1_000_000_000);
const IMAGES_PER_S: (f32, f32) = (1.0, 240.0);
/// How dark crevices are.
const OCCLUSION: f32 = 0.8;
/// How far towards white the background goes.
const GRADIENT: f32 = 0.16;
const MEMORY_MIB: (u32, u32) = (16, 65_536);

/// A number that may be left to the program.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Auto<T> {
    /// The program chooses.
    #[default]
    Auto,
    /// It is this.
    Fixed(T),
}

impl<T: Copy> Auto<T> {
    /// The value, if it is fixed.
    pub fn fixed(self) -> Option<T> {
        match self {
            Self::Auto => None,
            Self::Fixed(value) => Some(value),
        }
    }
}

impl<T: fmt::Display> fmt::Display for Auto<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Fixed(value) => value.fmt(f),
        }
    }
}

/// An axis of the model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Axis {
    /// The first.
    X,
    /// The second.
    Y,
    /// The third.
    Z,
}

/// A plane across the model's box; what lies beyond it is cut away.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Section {
    /// Which way the plane cuts.
    pub axis: Axis,
    /// Where, from 0 at the low end of the box to 1 at the high end.
    pub share: f64,
    /// Whether the low side goes instead of the high one.
    pub flipped: bool,
}

impl Section {
    /// The plane `(a, b, c, d)` in model units for a box; `a x + b y + c z + d >= 0` stays.
    pub fn plane(&self, min: DVec3, max: DVec3) -> [f64; 4] {
        let index = self.axis as usize;
        let at = min[index] + (max[index] - min[index]) * self.share;
        let sign = if self.flipped { 1.0 } else { -1.0 };
        let mut plane = [0.0, 0.0, 0.0, -sign * at];
        plane[index] = sign;
        plane
    }
}

/// Everything that can be set. Whoever holds it may change it; [`Settings::set`] checks text.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Settings {
    /// Most triangles.
    pub triangles: Auto<u32>,
    /// Largest error that may stay, in pixels.
    pub tolerance_px: Auto<f32>,
    /// Most bytes per second from the server; auto sets no cap.
    pub byte_rate: Auto<u32>,
    /// Images per second: no more are drawn, and with automatic triangles their number falls until as many are reached.
    pub images_per_s: Auto<f32>,
    /// Memory for the mesh, in MiB: bounds the triangles, fixed or not.
    pub memory_mib: Auto<u32>,
    /// Smooth or flat.
    pub shading: Shading,
    /// Colours of the model; auto shows them if there are.
    pub colors: Auto<bool>,
    /// Edges of the faces on top.
    pub wireframe: bool,
    /// Faces coloured by how fine they are.
    pub levels: bool,
    /// Backs of faces in another colour.
    pub backs: bool,
    /// Darker crevices; auto for models without colours, where the program has no reason to spare the machine.
    pub occlusion: Auto<bool>,
    /// New detail moves to its place instead of jumping there; auto is on.
    pub morph: Auto<bool>,
    /// Direction to the light: x right, y up, z to the viewer; auto is the renderer's.
    pub light: Auto<Vec3>,
    /// Colour behind the model, in sRGB; auto is the renderer's.
    pub background: Auto<[u8; 3]>,
    /// The background grows lighter towards the upper edge; auto where its colour is.
    pub gradient: Auto<bool>,
    /// Where the model is cut.
    pub section: Option<Section>,
}

/// Why a setting was not made.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SettingError {
    /// No such setting.
    #[error("there is no setting '{0}'")]
    Unknown(String),
    /// A value that makes no sense.
    #[error("'{value}' is no {key}: {expected}")]
    Value {
        /// The setting.
        key: &'static str,
        /// What was given.
        value: String,
        /// What it can be.
        expected: &'static str,
    },
}

impl Settings {
    /// Sets one by name. Numbers beyond their range are moved into it.
    ///
    /// # Errors
    /// [`SettingError`]; nothing changes then.
    pub fn set(&mut self, key: &str, value: &str) -> Result<(), SettingError> {
        let number = "a number or auto";
        match key {
            "triangles" => self.triangles = auto("triangles", value, number, |text| ranged(text, TRIANGLES))?,
            "tolerance" => self.tolerance_px = auto("tolerance", value, number, |text| ranged(text, TOLERANCE_PX))?,
            "rate" => self.byte_rate = auto("rate", value, number, |text| ranged(text, BYTE_RATE))?,
            "fps" => self.images_per_s = auto("fps", value, number, |text| ranged(text, IMAGES_PER_S))?,
            "memory" => self.memory_mib = auto("memory", value, number, |text| ranged(text, MEMORY_MIB))?,
            "colors" => self.colors = auto("colors", value, "on, off or auto", switch)?,
            "wireframe" => self.wireframe = on("wireframe", value)?,
            "levels" => self.levels = on("levels", value)?,
            "backs" => self.backs = on("backs", value)?,
            "occlusion" => self.occlusion = auto("occlusion", value, "on, off or auto", switch)?,
            "morph" => self.morph = auto("morph", value, "on, off or auto", switch)?,
            "light" => self.light = auto("light", value, "x,y,z or auto", direction)?,
            "background" => self.background = auto("background", value, "rrggbb or auto", rgb)?,
            "gradient" => self.gradient = auto("gradient", value, "on, off or auto", switch)?,
            "shading" => {
                self.shading = match value {
                    "smooth" => Shading::Smooth,
                    "flat" => Shading::Flat,
                    _ => return Err(wrong("shading", value, "smooth or flat")),
                }
            }
            "section" => {
                self.section = match value {
                    "off" => None,
                    _ => Some(section(value).ok_or_else(|| {
                        wrong("section", value, "off, or an axis, a share and maybe flip, as in x,0.5,flip")
                    })?),
                }
            }
            _ => return Err(SettingError::Unknown(key.chars().take(40).collect())),
        }
        Ok(())
    }

    /// All settings by name, as [`set`](Self::set) takes them.
    pub fn pairs(&self) -> Vec<(&'static str, String)> {
        vec![
            ("triangles", self.triangles.to_string()),
            ("tolerance", self.tolerance_px.to_string()),
            ("rate", self.byte_rate.to_string()),
            ("fps", self.images_per_s.to_string()),
            ("memory", self.memory_mib.to_string()),
            ("shading", if self.shading == Shading::Flat { "flat" } else { "smooth" }.into()),
            ("colors", self.colors.fixed().map_or("auto".into(), on_off)),
            ("wireframe", on_off(self.wireframe)),
            ("levels", on_off(self.levels)),
            ("backs", on_off(self.backs)),
            ("occlusion", self.occlusion.fixed().map_or("auto".into(), on_off)),
            ("morph", self.morph.fixed().map_or("auto".into(), on_off)),
            ("light", self.light.fixed().map_or("auto".into(), |light| format!("{},{},{}", light.x, light.y, light.z))),
            ("background", self.background.fixed().map_or("auto".into(), |[r, g, b]| format!("{r:02x}{g:02x}{b:02x}"))),
            ("gradient", self.gradient.fixed().map_or("auto".into(), on_off)),
            ("section", self.section.map_or("off".into(), |section| section.to_string())),
        ]
    }

    /// Whether the background has a gradient: a colour that someone chose is that colour.
    pub fn is_gradient(&self) -> bool {
        self.gradient.fixed().unwrap_or(self.background == Auto::Auto)
    }

    /// What the renderer is told for a model, with the plane of the section in model units. Crevices are dark by themselves if
    /// `spend` says that the machine need not be spared.
    pub fn render_options(
        &self,
        has_colors: bool,
        crease_angle_deg: f32,
        section: Option<[f64; 4]>,
        spend: bool,
    ) -> RenderOptions {
        let defaults = RenderOptions::default();
        let vertex_colors = has_colors && self.colors.fixed().unwrap_or(true);
        let occlusion = self.occlusion.fixed().unwrap_or(spend && !vertex_colors);
        let background = self.background.fixed().unwrap_or(defaults.background);
        RenderOptions {
            shading: self.shading,
            vertex_colors,
            occlusion: if occlusion { OCCLUSION } else { 0.0 },
            crease_angle_deg,
            background,
            background_top: self.is_gradient().then(|| background.map(lighter)),
            wireframe: self.wireframe,
            refinement_colors: self.levels,
            tint_backs: self.backs,
            light: self.light.fixed().unwrap_or(defaults.light),
            section: section.map(|[a, b, c, d]| Plane { normal: DVec3::new(a, b, c), offset: d }),
            ..defaults
        }
    }
}

/// What a channel of the background is at the upper edge.
fn lighter(byte: u8) -> u8 {
    byte + ((255 - byte) as f32 * GRADIENT) as u8
}

impl fmt::Display for Section {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let axis = ["x", "y", "z"][self.axis as usize];
        // A ten-thousandth of the box is finer than a slider.
        let share = (self.share * 1e4).round() / 1e4;
        write!(f, "{axis},{share}{}", if self.flipped { ",flip" } else { "" })
    }
}

fn wrong(key: &'static str, value: &str, expected: &'static str) -> SettingError {
    SettingError::Value { key, value: value.chars().take(40).collect(), expected }
}

fn auto<T>(
    key: &'static str,
    value: &str,
    expected: &'static str,
    read: impl FnOnce(&str) -> Option<T>,
) -> Result<Auto<T>, SettingError> {
    match value {
        "auto" => Ok(Auto::Auto),
        _ => read(value).map(Auto::Fixed).ok_or_else(|| wrong(key, value, expected)),
    }
}

fn ranged<T: FromStr + PartialOrd + Copy>(text: &str, (least, most): (T, T)) -> Option<T> {
    let value: T = text.parse().ok()?;
    if value < least {
        return Some(least);
    }
    // A NaN compares with nothing.
    if value > most { Some(most) } else { (value >= least).then_some(value) }
}

fn on(key: &'static str, value: &str) -> Result<bool, SettingError> {
    switch(value).ok_or_else(|| wrong(key, value, "on or off"))
}

fn on_off(is_on: bool) -> String {
    if is_on { "on" } else { "off" }.into()
}

fn direction(text: &str) -> Option<Vec3> {
    let parts: Option<Vec<f32>> = text.split(',').take(4).map(|part| part.parse().ok()).collect();
    let light = Vec3::from_array(parts?.try_into().ok()?);
    (light.length_squared() > 1e-6 && light.abs().max_element() <= 1e3).then_some(light)
}

fn switch(text: &str) -> Option<bool> {
    match text {
        "on" => Some(true),
        "off" => Some(false),
        _ => None,
    }
}

fn rgb(text: &str) -> Option<[u8; 3]> {
    let is_hex = text.len() == 6 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    let code = is_hex.then(|| u32::from_str_radix(text, 16).ok())??;
    let [_, r, g, b] = code.to_be_bytes();
    Some([r, g, b])
}

fn section(text: &str) -> Option<Section> {
    let mut parts = text.split(',');
    let axis = match parts.next()? {
        "x" => Axis::X,
        "y" => Axis::Y,
        "z" => Axis::Z,
        _ => return None,
    };
    let share = ranged(parts.next()?, (0.0, 1.0))?;
    let flipped = match parts.next() {
        None => false,
        Some("flip") => true,
        Some(_) => return None,
    };
    parts.next().is_none().then_some(Section { axis, share, flipped })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_again() {
        let mut settings = Settings::default();
        for (key, value) in [
            ("triangles", "250000"),
            ("tolerance", "0.5"),
            ("rate", "125000"),
            ("fps", "30"),
            ("memory", "256"),
            ("shading", "flat"),
            ("colors", "off"),
            ("wireframe", "on"),
            ("levels", "on"),
            ("backs", "on"),
            ("occlusion", "on"),
            ("morph", "off"),
            ("light", "0.5,-0.25,1"),
            ("background", "0aff30"),
            ("gradient", "off"),
            ("section", "z,0.25,flip"),
        ] {
            settings.set(key, value).unwrap();
            let written = settings.pairs().into_iter().find(|(name, _)| *name == key).unwrap().1;
            assert_eq!(written, value);
        }
        let mut again = Settings::default();
        settings.pairs().iter().for_each(|(key, value)| again.set(key, value).unwrap());
        assert_eq!(again, settings);
        Settings::default().pairs().iter().for_each(|(key, value)| again.set(key, value).unwrap());
        assert_eq!(again, Settings::default());
    }

    #[test]
    fn numbers_are_moved_into_their_range_and_nonsense_is_named() {
        let mut settings = Settings::default();
        settings.set("triangles", "1").unwrap();
        assert_eq!(settings.triangles, Auto::Fixed(100));
        settings.set("fps", "1e30").unwrap();
        assert_eq!(settings.images_per_s, Auto::Fixed(240.0));
        let before = settings;
        for (key, value) in [
            ("triangles", "-1"),
            ("triangles", "many"),
            ("tolerance", "NaN"),
            ("background", "+12345"),
            ("section", "x"),
            ("section", "w,0.5"),
            ("section", "x,0.5,flip,flip"),
            ("shading", ""),
            ("colors", "1"),
            ("light", "0,0,0"),
            ("light", "1,NaN,1"),
            ("wireframe", "yes"),
        ] {
            let error = settings.set(key, value).unwrap_err();
            assert!(error.to_string().contains(key), "{error}");
        }
        assert_eq!(settings.set("nothing", "1"), Err(SettingError::Unknown("nothing".into())));
        assert_eq!(settings, before);
    }

    #[test]
    fn the_page_has_the_background_before_the_viewer_draws_it() {
        let options = Settings::default().render_options(false, 45.0, None, true);
        let hex = |[r, g, b]: [u8; 3]| format!("#{r:02x}{g:02x}{b:02x}");
        let gradient = format!("linear-gradient({},{})", hex(options.background_top.unwrap()), hex(options.background));
        let page = include_str!("../../../web/index.html");
        assert!(page.contains(&format!("#stage{{container-type:size;background:{gradient}}}")), "{gradient}");
    }

    #[test]
    fn sections_keep_the_side_that_they_say() {
        let (min, max) = (DVec3::new(-1.0, 0.0, 4.0), DVec3::new(1.0, 2.0, 8.0));
        let side = |section: Section, p: [f64; 3]| {
            let [a, b, c, d] = section.plane(min, max);
            a * p[0] + b * p[1] + c * p[2] + d
        };
        let section = Section { axis: Axis::Z, share: 0.25, flipped: false };
        assert!(side(section, [0.0, 0.0, 4.9]) > 0.0 && side(section, [0.0, 0.0, 5.1]) < 0.0);
        let flipped = Section { flipped: true, ..section };
        assert!(side(flipped, [0.0, 0.0, 4.9]) < 0.0 && side(flipped, [0.0, 0.0, 5.1]) > 0.0);
    }
}
