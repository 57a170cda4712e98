//! What a client wants to see: camera, limits, tolerance.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::limits::MAX_CLIP_PLANES;

/// Means "no triangle limit".
pub const UNLIMITED_TRIANGLES: u32 = u32::MAX;

/// How the camera maps space to the image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Projection {
    /// A pinhole.
    Perspective {
        /// Vertical opening angle in radians, above 0 and below pi.
        fov_y_rad: f32,
    },
    /// Parallel rays.
    Orthographic {
        /// Height of the visible box in model units, positive.
        height: f64,
    },
}

/// One request of a client. Lengths and positions are in model units, right-handed with y up; the camera looks along its
/// own -z.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct View {
    /// Camera position.
    pub eye: [f64; 3],
    /// Camera to model rotation as a unit quaternion (x, y, z, w).
    pub orientation: [f32; 4],
    /// Perspective or orthographic.
    pub projection: Projection,
    /// Width of the image over its height.
    pub aspect: f32,
    /// Height of the image in pixels, at least 1.
    pub viewport_height_px: u32,
    /// Distance of the near plane, positive. Errors are projected as if nothing were nearer.
    pub near: f64,
    /// Planes `(a, b, c, d)`; what lies where `a x + b y + c z + d < 0` need not be refined. At most
    /// [`MAX_CLIP_PLANES`].
    pub clip_planes: Vec<[f64; 4]>,
    /// Whether back faces are drawn, so that nothing may be left coarse because it faces away.
    pub two_sided: bool,
    /// Refine everything, whatever the camera: the priority of an op is then its error.
    pub complete: bool,
    /// Most triangles that the client will hold, after every single op.
    pub triangle_limit: u32,
    /// Largest error that may stay, in pixels; 0 wants every op that may be seen and changes the surface.
    pub tolerance_px: f32,
    /// Factor on the priority of what may be silhouette, at least 1 (Azuma 2000, section 3.3.3).
    pub silhouette_factor: f32,
}

/// Why a view makes no sense.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ViewError {
    /// A number is infinite, NaN or out of the range that its field states.
    #[error("{0} is out of range")]
    OutOfRange(&'static str),
}

impl View {
    /// A perspective view of a 1080-line 16:9 image with the defaults of the command line.
    pub fn perspective(eye: DVec3, target: DVec3, fov_y_rad: f32) -> Self {
        let forward = (target - eye).try_normalize().unwrap_or(DVec3::NEG_Z);
        Self {
            eye: eye.to_array(),
            orientation: look_along(forward, DVec3::Y).as_quat().to_array(),
            projection: Projection::Perspective { fov_y_rad },
            aspect: 16.0 / 9.0,
            viewport_height_px: 1080,
            near: 1e-3,
            clip_planes: Vec::new(),
            two_sided: false,
            complete: false,
            triangle_limit: 1_000_000,
            tolerance_px: 1.0,
            silhouette_factor: 1.0,
        }
    }

    /// Checks every field's range, as the server does before it uses a view.
    ///
    /// # Errors
    /// Names the field.
    pub fn validate(&self) -> Result<(), ViewError> {
        let check = |ok: bool, field| if ok { Ok(()) } else { Err(ViewError::OutOfRange(field)) };
        let positive = |x: f64| x.is_finite() && x > 0.0;
        let rotation = DQuat::from_array(self.orientation.map(f64::from)).length_squared();
        check(self.eye.iter().all(|x| x.is_finite()), "eye")?;
        check((0.98..1.02).contains(&rotation), "orientation")?;
        check(positive(f64::from(self.aspect)) && self.aspect < 1e4, "aspect")?;
        check((1..=1 << 20).contains(&self.viewport_height_px), "viewport height")?;
        check(positive(self.near), "near")?;
        match self.projection {
            Projection::Perspective { fov_y_rad: fov } => {
                check(fov > 1e-6 && fov < std::f32::consts::PI, "field of view")?
            }
            Projection::Orthographic { height } => check(positive(height), "height of the orthographic view")?,
        }
        let planes_fit = self.clip_planes.len() <= MAX_CLIP_PLANES;
        check(planes_fit && self.clip_planes.iter().flatten().all(|x| x.is_finite()), "clip planes")?;
        check(self.tolerance_px >= 0.0 && self.tolerance_px.is_finite(), "tolerance")?;
        check(self.silhouette_factor >= 1.0 && self.silhouette_factor <= 1e6, "silhouette factor")
    }

    /// Camera to model rotation.
    pub fn rotation(&self) -> DQuat {
        DQuat::from_array(self.orientation.map(f64::from)).normalize()
    }

    /// The planes that bound what may be seen, normals inward: left, right, bottom, top, then the clip planes. The near
    /// plane is left out: what is nearer is about to be seen.
    pub fn planes(&self) -> Vec<Plane> {
        let rotation = self.rotation();
        let eye = DVec3::from_array(self.eye);
        let mut planes = Vec::with_capacity(4 + self.clip_planes.len());
        let mut push = |normal: DVec3, through: DVec3| {
            let normal = (rotation * normal).normalize();
            planes.push(Plane { normal, offset: -normal.dot(through) });
        };
        match self.projection {
            Projection::Perspective { fov_y_rad } => {
                let y = f64::from(fov_y_rad / 2.0).tan();
                let x = y * f64::from(self.aspect);
                push(DVec3::new(1.0, 0.0, -x), eye);
                push(DVec3::new(-1.0, 0.0, -x), eye);
                push(DVec3::new(0.0, 1.0, -y), eye);
                push(DVec3::new(0.0, -1.0, -y), eye);
            }
            Projection::Orthographic { height } => {
                let y = height / 2.0;
                let x = y * f64::from(self.aspect);
                for (axis, reach) in [(DVec3::X, x), (DVec3::Y, y)] {
                    push(axis, eye - rotation * axis * reach);
                    push(-axis, eye + rotation * axis * reach);
                }
            }
        }
        for &[a, b, c, d] in &self.clip_planes {
            let length = DVec3::new(a, b, c).length();
            if length > 0.0 {
                planes.push(Plane { normal: DVec3::new(a, b, c) / length, offset: d / length });
            }
        }
        planes
    }

    /// Pixels per model unit at distance 1 (perspective) or anywhere (orthographic).
    pub fn pixel_scale(&self) -> f64 {
        let height = f64::from(self.viewport_height_px);
        match self.projection {
            Projection::Perspective { fov_y_rad } => height / (2.0 * f64::from(fov_y_rad / 2.0).tan()),
            Projection::Orthographic { height: units } => height / units,
        }
    }
}

/// `normal . p + offset >= 0` inside; the normal has length 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Unit normal, pointing inside.
    pub normal: DVec3,
    /// Signed distance of the origin.
    pub offset: f64,
}

/// Rotation that turns -z to `forward` (unit length) with `up` as upright as possible.
pub fn look_along(forward: DVec3, up: DVec3) -> DQuat {
    let back = -forward;
    let right = up.cross(back).try_normalize().unwrap_or_else(|| back.any_orthonormal_vector());
    DQuat::from_mat3(&glam::DMat3::from_cols(right, back.cross(right), back)).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn inside(view: &View, p: DVec3) -> bool {
        view.planes().iter().all(|plane| plane.normal.dot(p) + plane.offset >= 0.0)
    }

    #[test]
    fn planes_bound_what_the_camera_sees() {
        let mut view = View::perspective(DVec3::new(0.0, 0.0, 10.0), DVec3::ZERO, 1.0);
        let (y, x) = (0.5f64.tan() * 10.0, 0.5f64.tan() * 10.0 * 16.0 / 9.0);
        assert!(inside(&view, DVec3::ZERO));
        assert!(inside(&view, DVec3::new(0.99 * x, 0.99 * y, 0.0)));
        assert!(!inside(&view, DVec3::new(1.01 * x, 0.0, 0.0)));
        assert!(!inside(&view, DVec3::new(0.0, -1.01 * y, 0.0)));
        assert!(!inside(&view, DVec3::new(0.0, 0.0, 11.0)), "behind the camera");
        view.clip_planes.push([2.0, 0.0, 0.0, -2.0]);
        assert!(inside(&view, DVec3::new(1.1, 0.0, 0.0)) && !inside(&view, DVec3::new(0.9, 0.0, 0.0)));
        view.clip_planes.clear();
        view.projection = Projection::Orthographic { height: 4.0 };
        assert!(inside(&view, DVec3::new(3.5, 1.9, -100.0)) && !inside(&view, DVec3::new(0.0, 2.1, 0.0)));
        assert_eq!(view.pixel_scale(), 270.0);
    }

    #[test]
    fn looking_straight_down_is_no_special_case() {
        for forward in [DVec3::NEG_Y, DVec3::Y, DVec3::NEG_Z, DVec3::new(0.6, 0.8, 0.0)] {
            assert!((look_along(forward, DVec3::Y) * DVec3::NEG_Z).distance(forward) < 1e-12);
        }
    }

    #[test]
    fn nonsense_is_named() {
        let view = View::perspective(DVec3::Z, DVec3::ZERO, 0.8);
        assert_eq!(view.validate(), Ok(()));
        let check = |change: fn(&mut View), field| {
            let mut bad = view.clone();
            change(&mut bad);
            assert_eq!(bad.validate(), Err(ViewError::OutOfRange(field)));
        };
        check(|v| v.eye[1] = f64::NAN, "eye");
        check(|v| v.orientation = [0.0; 4], "orientation");
        check(|v| v.aspect = 0.0, "aspect");
        check(|v| v.near = -1.0, "near");
        check(|v| v.tolerance_px = f32::INFINITY, "tolerance");
        check(|v| v.clip_planes = vec![[0.0; 4]; 7], "clip planes");
        check(|v| v.projection = Projection::Perspective { fov_y_rad: 4.0 }, "field of view");
    }
}
