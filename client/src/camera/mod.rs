//! Pose and lens of the viewer, and what follows from them: the [`View`] that the server gets and the matrix that the
//! renderer draws with.
//!
//! Right-handed, y up, the camera looks along its own -z. All of it is in `f64` and in model units; only
//! [`Camera::lattice_to_clip`] rounds, at the very end, so that survey coordinates in the millions keep their millimetres.
//! [`Orbit`] is a pose around a point, [`navigate`] how a person moves it, [`gesture`] what pointers mean, [`ray`] how pixels
//! and points go together; `recording` is the file format of a session's views.

pub mod gesture;
pub mod navigate;
mod orbit;
pub mod ray;
#[cfg(any(feature = "net-native", feature = "viewer"))]
pub mod recording;

use glam::{DMat4, DQuat, DVec3, DVec4, Mat4};
use lodestream_protocol::message::ModelInfo;
use lodestream_protocol::quant::Lattice;
use lodestream_protocol::view::{Projection, View, look_along};

pub use orbit::{Orbit, UpAxis};

/// From where a model is looked at unless someone says otherwise: from the front, a little from the right and above.
pub const DEFAULT_DIRECTION: DVec3 = DVec3::new(0.35, 0.25, 1.0);

/// Distance of the near plane unless more is known, as a share of the distance to what is looked at.
const NEAREST: f64 = 1e-4;

/// Largest vertical opening angle of images that are higher than wide, in radians: beyond it little fits into much.
const WIDEST_FOV_Y_RAD: f64 = 2.1;

/// The vertical opening angle of an image whose narrower side opens by `fov_rad`, limited to 120 degrees unless `fov_rad` is more.
/// `aspect` is width over height.
///
/// A model that fits the narrower side then looks the same in an image of any shape: on a phone that is turned, in a window
/// that is drawn, and in the picture that a page shows before.
pub fn fov_y_of(fov_rad: f32, aspect: f64) -> f32 {
    if aspect >= 1.0 {
        return fov_rad;
    }
    let half = ((f64::from(fov_rad) / 2.0).tan() / aspect).atan();
    ((2.0 * half).min(WIDEST_FOV_Y_RAD) as f32).max(fov_rad)
}

/// The opening angle of the narrower side where the vertical one is `fov_y_rad`: [`fov_y_of`] backwards, as far as that is not
/// limited.
pub fn fov_of(fov_y_rad: f32, aspect: f64) -> f32 {
    if aspect >= 1.0 { fov_y_rad } else { (2.0 * ((f64::from(fov_y_rad) / 2.0).tan() * aspect).atan()) as f32 }
}

/// A ball around the model, in model units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Centre of the model's box.
    pub center: DVec3,
    /// Half the diagonal of the box, at least one lattice step.
    pub radius: f64,
}

impl Bounds {
    /// The ball around the complete model.
    pub fn of(model: &ModelInfo) -> Self {
        let min = DVec3::from_array(model.lattice.position(model.box_min));
        let max = DVec3::from_array(model.lattice.position(model.box_max));
        Self { center: (min + max) / 2.0, radius: ((max - min).length() / 2.0).max(model.lattice.step) }
    }
}

/// Pixels of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Viewport {
    /// Width in pixels, at least 1.
    pub width_px: u32,
    /// Height in pixels, at least 1.
    pub height_px: u32,
}

impl Viewport {
    /// Width over height.
    pub fn aspect(self) -> f64 {
        f64::from(self.width_px.max(1)) / f64::from(self.height_px.max(1))
    }
}

/// What a view asks for besides the picture's geometry.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Detail {
    /// Most triangles to hold, [`UNLIMITED_TRIANGLES`](lodestream_protocol::view::UNLIMITED_TRIANGLES) for no limit.
    pub triangle_limit: u32,
    /// Largest error that may stay, in pixels.
    pub tolerance_px: f32,
    /// Everything, whatever the camera sees.
    pub complete: bool,
    /// Back faces are drawn too.
    pub two_sided: bool,
}

impl Default for Detail {
    fn default() -> Self {
        Self { triangle_limit: 1_000_000, tolerance_px: 1.0, complete: false, two_sided: false }
    }
}

/// Where the viewer is, where it looks, through which lens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Position in model units.
    pub eye: DVec3,
    /// Camera to model rotation, of unit length.
    pub orientation: DQuat,
    /// Perspective or orthographic.
    pub projection: Projection,
    /// Distance of the near plane, positive: what is nearer is cut off, and the server refines nothing as if it were nearer.
    pub near: f64,
}

impl Camera {
    /// A camera in the origin that looks along -z, with a vertical opening angle in radians.
    pub fn perspective(fov_y_rad: f32) -> Self {
        let projection = Projection::Perspective { fov_y_rad };
        Self { eye: DVec3::ZERO, orientation: DQuat::IDENTITY, projection, near: NEAREST }
    }

    /// A camera that sees all of the model: the ball around its box touches the narrower side of the image, seen from
    /// [`DEFAULT_DIRECTION`]. `fov_y_rad` is the vertical opening angle, `aspect` width over height.
    pub fn frame_model(model: &ModelInfo, fov_y_rad: f32, aspect: f64) -> Self {
        let mut camera = Self::perspective(fov_y_rad);
        camera.frame(&Bounds::of(model), DEFAULT_DIRECTION, aspect);
        camera
    }

    /// Moves the camera so that the ball fits the image, seen from `direction` (from the ball to the camera, of any
    /// length but zero).
    pub fn frame(&mut self, bounds: &Bounds, direction: DVec3, aspect: f64) {
        let direction = direction.try_normalize().unwrap_or(DVec3::Z);
        let distance = match &mut self.projection {
            Projection::Perspective { fov_y_rad } => {
                let half_y = f64::from(*fov_y_rad) / 2.0;
                let half_x = (half_y.tan() * aspect).atan();
                bounds.radius / half_y.min(half_x).sin()
            }
            Projection::Orthographic { height } => {
                *height = 2.0 * bounds.radius / aspect.min(1.0);
                2.0 * bounds.radius
            }
        };
        self.look_at(bounds.center + direction * distance, bounds.center);
        self.fit_near(bounds);
    }

    /// Puts the camera at `eye`, looking at `target`, as upright as possible, with the near plane at a ten-thousandth of
    /// the way. If both are the same point, direction and near plane stay.
    pub fn look_at(&mut self, eye: DVec3, target: DVec3) {
        self.eye = eye;
        if let Some(forward) = (target - eye).try_normalize() {
            self.orientation = look_along(forward, DVec3::Y);
            self.near = eye.distance(target) * NEAREST;
        }
    }

    /// Unit vector into the picture.
    pub fn forward(&self) -> DVec3 {
        self.orientation * DVec3::NEG_Z
    }

    /// Moves the near plane out to just before the ball, if the camera is in front of it.
    pub fn fit_near(&mut self, bounds: &Bounds) {
        let depth = (bounds.center - self.eye).dot(self.forward()) - bounds.radius;
        self.near = self.near.max(0.99 * depth);
    }

    /// The request to the server.
    pub fn view(&self, viewport: Viewport, detail: &Detail) -> View {
        View {
            eye: self.eye.to_array(),
            orientation: self.orientation.as_quat().to_array(),
            projection: self.projection,
            aspect: viewport.aspect() as f32,
            viewport_height_px: viewport.height_px,
            near: self.near,
            clip_planes: Vec::new(),
            two_sided: detail.two_sided,
            complete: detail.complete,
            triangle_limit: detail.triangle_limit,
            tolerance_px: detail.tolerance_px,
            silhouette_factor: 1.0,
        }
    }

    /// Model units to clip space with **reversed** depth: 1 at the near plane, 0 at infinity (perspective) or behind the
    /// ball (orthographic). Clear depth to 0 and compare with `Greater`. Reversed, because floats are then dense
    /// where perspective needs them and no far plane has to be chosen.
    pub fn view_projection(&self, aspect: f64, bounds: &Bounds) -> DMat4 {
        let near = self.near;
        let projection = match self.projection {
            Projection::Perspective { fov_y_rad } => {
                let f = 1.0 / (f64::from(fov_y_rad) / 2.0).tan();
                DMat4::from_cols(
                    DVec4::new(f / aspect, 0.0, 0.0, 0.0),
                    DVec4::new(0.0, f, 0.0, 0.0),
                    DVec4::new(0.0, 0.0, 0.0, -1.0),
                    DVec4::new(0.0, 0.0, near, 0.0),
                )
            }
            Projection::Orthographic { height } => {
                let behind = (bounds.center - self.eye).dot(self.forward()) + 1.01 * bounds.radius;
                let far = behind.max(near + bounds.radius);
                let scale = 2.0 / height;
                DMat4::from_cols(
                    DVec4::new(scale / aspect, 0.0, 0.0, 0.0),
                    DVec4::new(0.0, scale, 0.0, 0.0),
                    DVec4::new(0.0, 0.0, 1.0 / (far - near), 0.0),
                    DVec4::new(0.0, 0.0, far / (far - near), 1.0),
                )
            }
        };
        projection * DMat4::from_quat(self.orientation.conjugate()) * DMat4::from_translation(-self.eye)
    }

    /// Lattice coordinates, as the replica holds them, to clip space: see [`view_projection`](Self::view_projection).
    /// Multiplied in `f64` and rounded once.
    pub fn lattice_to_clip(&self, lattice: &Lattice, aspect: f64, bounds: &Bounds) -> Mat4 {
        let to_model =
            DMat4::from_translation(DVec3::from_array(lattice.origin)) * DMat4::from_scale(DVec3::splat(lattice.step));
        (self.view_projection(aspect, bounds) * to_model).as_mat4()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fake_server::FakeServer;

    const FOV: f32 = std::f32::consts::FRAC_PI_4;

    fn model() -> ModelInfo {
        FakeServer::new().model()
    }

    /// Directions spread over the sphere.
    fn directions() -> impl Iterator<Item = DVec3> {
        (0..400).map(|i| {
            let y = 1.0 - (2.0 * f64::from(i) + 1.0) / 400.0;
            let (sin, cos) = (f64::from(i) * 2.399_963).sin_cos();
            let r = (1.0 - y * y).sqrt();
            DVec3::new(r * cos, y, r * sin)
        })
    }

    #[test]
    fn the_default_camera_frames_the_model() {
        let model = model();
        let bounds = Bounds::of(&model);
        for aspect in [0.4, 1.0, 16.0 / 9.0] {
            let camera = Camera::frame_model(&model, FOV, aspect);
            let matrix = camera.view_projection(aspect, &bounds);
            let (mut widest, mut highest) = (0.0f64, 0.0f64);
            for direction in directions() {
                let p = matrix.project_point3(bounds.center + direction * bounds.radius);
                widest = widest.max(p.x.abs());
                highest = highest.max(p.y.abs());
                assert!(p.z > 0.0 && p.z <= 1.0, "depth {}", p.z);
            }
            let fill = if aspect < 1.0 { widest } else { highest };
            assert!(widest <= 1.0 && highest <= 1.0 && fill > 0.97, "aspect {aspect}: {widest} x {highest}");
        }
    }

    #[test]
    fn the_narrower_side_opens_alike_in_images_of_any_shape() {
        for fov in [0.1, FOV, 1.5] {
            for aspect in [1.0, 1.4, 3.0] {
                assert_eq!(fov_y_of(fov, aspect), fov);
                assert_eq!(fov_of(fov, aspect), fov);
            }
            for aspect in [0.99, 0.75, 0.46] {
                let fov_y = fov_y_of(fov, aspect);
                assert!(fov_y > fov && fov_y <= WIDEST_FOV_Y_RAD as f32);
                if fov_y < WIDEST_FOV_Y_RAD as f32 {
                    assert!((fov_of(fov_y, aspect) - fov).abs() < 1e-6, "{fov} {aspect}");
                    let reach = |angle: f32| (f64::from(angle) / 2.0).tan();
                    assert!((reach(fov_y) * aspect - reach(fov)).abs() < 1e-6, "{fov} {aspect}");
                }
            }
            assert_eq!(fov_y_of(fov, 1e-9), WIDEST_FOV_Y_RAD as f32);
        }
        assert_eq!(fov_y_of(2.5, 0.3), 2.5);
    }

    #[test]
    fn view_and_matrix_agree_on_what_is_seen() {
        let model = model();
        let bounds = Bounds::of(&model);
        let viewport = Viewport { width_px: 1280, height_px: 720 };
        for projection in
            [Projection::Perspective { fov_y_rad: FOV }, Projection::Orthographic { height: bounds.radius }]
        {
            let mut camera = Camera { projection, ..Camera::perspective(FOV) };
            camera.look_at(bounds.center + DVec3::new(0.3, 1.2, 0.9) * bounds.radius, bounds.center);
            let view = camera.view(viewport, &Detail::default());
            assert_eq!(view.validate(), Ok(()));
            let planes = view.planes();
            let matrix = camera.view_projection(viewport.aspect(), &bounds);
            let mut seen = 0;
            for direction in directions() {
                let p = bounds.center + direction * bounds.radius;
                let clip = matrix * p.extend(1.0);
                let margin = (clip.w - clip.x.abs()).min(clip.w - clip.y.abs()) / clip.w;
                if margin.abs() < 1e-5 {
                    continue;
                }
                let inside = planes.iter().all(|plane| plane.normal.dot(p) + plane.offset >= 0.0);
                assert_eq!(inside, margin > 0.0 && clip.w > 0.0, "{p}");
                assert!((0.0..=1.0).contains(&(clip.z / clip.w)));
                seen += usize::from(inside);
            }
            assert!((50..350).contains(&seen), "{seen}");
        }
    }

    #[test]
    fn depth_is_one_at_the_near_plane_and_falls_off() {
        let bounds = Bounds { center: DVec3::ZERO, radius: 1.0 };
        let mut camera = Camera::perspective(FOV);
        camera.look_at(DVec3::new(0.0, 0.0, 11.0), DVec3::ZERO);
        assert!((camera.near - 11e-4).abs() < 1e-12);
        camera.fit_near(&bounds);
        assert!((camera.near - 9.9).abs() < 1e-12);
        let matrix = camera.view_projection(1.0, &bounds);
        let depth = |z: f64| matrix.project_point3(DVec3::new(0.0, 0.0, z)).z;
        assert!((depth(1.1) - 1.0).abs() < 1e-12);
        assert!(depth(0.0) < depth(1.0) && depth(-1e9) > 0.0);
        // Inside the ball the near plane stays positive.
        camera.look_at(DVec3::ZERO, DVec3::X);
        camera.fit_near(&bounds);
        assert_eq!(camera.near, 1e-4);
    }

    #[test]
    fn large_coordinates_keep_their_precision() {
        let lattice = Lattice { origin: [5.2e6, 120.0, -7.3e5], step: 1e-3, bits: 21 };
        let center = DVec3::from_array(lattice.position([1 << 20; 3]));
        let bounds = Bounds { center, radius: 900.0 };
        let mut camera = Camera::perspective(FOV);
        camera.look_at(center + DVec3::new(0.0, 0.0, 50.0), center);
        let matrix = camera.lattice_to_clip(&lattice, 1.0, &bounds);
        let project = |q: [i32; 3]| matrix.project_point3(glam::IVec3::from_array(q).as_vec3());
        // 1 m to the right, 50 m away.
        let p = project([(1 << 20) + 1000, 1 << 20, 1 << 20]);
        let expected = 1.0 / (50.0 * (f64::from(FOV) / 2.0).tan());
        assert!((f64::from(p.x) - expected).abs() < 1e-5, "{p}");
    }

    #[test]
    fn a_camera_on_its_target_keeps_its_direction() {
        let mut camera = Camera::perspective(FOV);
        camera.look_at(DVec3::X, DVec3::X);
        assert_eq!(camera.forward(), DVec3::NEG_Z);
        assert!(camera.near > 0.0);
    }
}
