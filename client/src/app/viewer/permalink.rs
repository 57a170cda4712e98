//! A link to a view: the camera and the settings as the fragment of an address.
//!
//! `at=0,1.5,0&from=20,15,4.2&shading=flat`: the point looked at, then yaw and pitch in degrees, distance and (if the camera is
//! rolled) roll. What is at its default is left out. Reading is forgiving, since links outlive versions: what is not
//! understood is skipped, and numbers that make no camera leave the camera alone.

use glam::DVec3;

use super::settings::Settings;
use crate::camera::navigate::Navigator;
use crate::camera::{Orbit, UpAxis};

/// Longest fragment that is looked at.
const MAX_BYTES: usize = 4096;
/// Farthest coordinate and largest distance.
const FARTHEST: f64 = 1e15;

/// A camera as a link names it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkedPose {
    /// Where it is.
    pub orbit: Orbit,
    /// Opening angle of the image's narrower side in radians.
    pub fov_rad: f32,
    /// Whether rays are parallel.
    pub is_orthographic: bool,
}

/// The fragment, without `#`.
pub fn write(navigator: &Navigator, settings: &Settings, default_fov_rad: f32) -> String {
    let orbit = navigator.orbit();
    let distance = orbit.distance();
    let point = |p: DVec3| format!("{},{},{}", short(p.x, distance), short(p.y, distance), short(p.z, distance));
    let [yaw, pitch, roll] = orbit.angles().map(|angle| (angle.to_degrees() * 100.0).round() / 100.0);
    let mut text = format!("at={}&from={yaw},{pitch},{}", point(orbit.target), short(distance, distance));
    if roll != 0.0 {
        text.push_str(&format!(",{roll}"));
    }
    if orbit.up() == UpAxis::Z {
        text.push_str("&up=z");
    }
    if navigator.is_orthographic() {
        text.push_str("&ortho=on");
    }
    if navigator.fov_rad() != default_fov_rad {
        text.push_str(&format!("&fov={}", (f64::from(navigator.fov_rad()).to_degrees() * 100.0).round() / 100.0));
    }
    let defaults = Settings::default().pairs();
    for ((key, value), (_, default)) in settings.pairs().into_iter().zip(defaults) {
        if value != default {
            text.push_str(&format!("&{key}={value}"));
        }
    }
    text
}

/// What a fragment says: the camera, if there is one, and settings on top of the defaults.
pub fn read(text: &str, default_fov_rad: f32) -> (Option<LinkedPose>, Settings) {
    let mut settings = Settings::default();
    let (mut at, mut from, mut up) = (None, None, UpAxis::Y);
    let (mut fov_rad, mut is_orthographic) = (default_fov_rad, false);
    let text = if text.len() <= MAX_BYTES { text.trim_start_matches('#') } else { "" };
    for (key, value) in text.split('&').filter_map(|pair| pair.split_once('=')) {
        match key {
            "at" => at = numbers(value).filter(|numbers| numbers.len() == 3),
            "from" => from = numbers(value).filter(|numbers| (3..=4).contains(&numbers.len())),
            "up" if value == "z" => up = UpAxis::Z,
            "ortho" => is_orthographic = value == "on",
            "fov" => {
                let degrees = value.parse().ok().filter(|degrees| (0.1..=170.0).contains(degrees));
                fov_rad = degrees.map_or(fov_rad, f32::to_radians);
            }
            // A link from a newer version may know more.
            _ => drop(settings.set(key, value)),
        }
    }
    let pose = at.zip(from).filter(|(_, from)| from[2] > 0.0).map(|(at, from)| {
        let angles = [from[0], from[1], from.get(3).copied().unwrap_or(0.0)].map(f64::to_radians);
        let orbit = Orbit::from_angles(DVec3::new(at[0], at[1], at[2]), from[2], angles, up);
        LinkedPose { orbit, fov_rad, is_orthographic }
    });
    (pose, settings)
}

fn numbers(text: &str) -> Option<Vec<f64>> {
    let all: Option<Vec<f64>> = text.split(',').take(5).map(|part| part.parse().ok()).collect();
    all.filter(|numbers| numbers.iter().all(|x| x.abs() <= FARTHEST))
}

/// As many digits as can be seen from `distance`: a hundred-thousandth of it.
fn short(x: f64, distance: f64) -> f64 {
    let digits = 5 - distance.log10().floor() as i32;
    if !(-12..=12).contains(&digits) {
        return x;
    }
    let scale = 10f64.powi(digits.abs());
    // Division by a whole power of ten gives the shortest text; multiplication by a tenth does not.
    if digits >= 0 { (x * scale).round() / scale } else { (x / scale).round() * scale }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Bounds, Viewport};
    use lodestream_protocol::time::Timestamp;

    const FOV: f32 = 0.8;

    fn navigator() -> Navigator {
        let bounds = Bounds { center: DVec3::new(100.0, 2.0, -3.0), radius: 2.0 };
        Navigator::new(bounds, Viewport { width_px: 800, height_px: 600 }, FOV)
    }

    #[test]
    fn a_link_leads_back_to_the_view() {
        let mut navigator = navigator();
        navigator.drag(Timestamp::default(), 123.0, -45.0);
        navigator.twist(0.3);
        navigator.pinch(DVec3::new(101.0, 2.0, -3.0), 0.037);
        navigator.set_orthographic(true);
        let mut settings = Settings::default();
        settings.set("triangles", "5000").unwrap();
        settings.set("section", "y,0.5").unwrap();
        let text = write(&navigator, &settings, FOV);
        let (pose, read_settings) = read(&format!("#{text}"), FOV);
        let pose = pose.unwrap();
        assert_eq!(read_settings, settings);
        assert!(pose.is_orthographic && pose.fov_rad == FOV);
        let (a, b) = (navigator.orbit(), pose.orbit);
        assert!(a.eye().distance(b.eye()) < 1e-3 * a.distance(), "{text}");
        assert!(a.rotation().angle_between(b.rotation()) < 3e-4, "{text}");
        assert!(text.len() < 120 && text.ends_with("&ortho=on&triangles=5000&section=y,0.5"), "{text}");
    }

    #[test]
    fn nonsense_leaves_the_camera_alone() {
        for text in [
            "",
            "#",
            "at=1,2,3",
            "at=1,2&from=1,2,3",
            "at=1,2,nan&from=0,0,1",
            "at=0,0,0&from=0,0,-1",
            "from=0,0,0&at=0,0,0",
        ] {
            assert_eq!(read(text, FOV).0, None, "{text}");
        }
        assert!(read(&format!("at=0,0,0&from=0,0,1&x={}", "1".repeat(5000)), FOV).0.is_none());
        let (pose, settings) = read("from=0,0,1&at=1e3,0,0&later=1&triangles=x&fov=900&shading=flat", FOV);
        assert_eq!((pose.unwrap().fov_rad, settings.pairs()[5].1.as_str()), (FOV, "flat"));
        let mut rng = fastrand::Rng::with_seed(4);
        for _ in 0..20_000 {
            let mut bytes = b"at=1,2,3&from=4,5,6,7&up=z&fov=40&triangles=700&section=x,0.5,flip".to_vec();
            for _ in 0..rng.usize(1..5) {
                let at = rng.usize(..bytes.len());
                bytes[at] = rng.u8(32..127);
            }
            let (pose, _) = read(std::str::from_utf8(&bytes).unwrap(), FOV);
            assert!(pose.is_none_or(|pose| pose.orbit.eye().is_finite() && pose.orbit.distance() > 0.0));
        }
    }
}
