//! What the camera and the light are to the shaders.
//!
//! The GPU works in lattice steps relative to the eye. The eye goes up in two `f32` parts, the first a whole number of
//! steps, so that `(position - high) - low` loses nothing near the eye; everything else is composed in `f64` here. Origins
//! in the millions and close-ups then cost no precision, and neither the origin nor the step reaches the GPU.

use bytemuck::{Pod, Zeroable};
use glam::{DMat4, DQuat, DVec3, DVec4, Mat4, Vec3, Vec4};
use lodestream_protocol::quant::Lattice;
use lodestream_protocol::view::{Projection, View};

/// Where an image is taken from. Lengths in model units; the camera looks along its own -z with +y up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderCamera {
    /// Position in the model.
    pub eye: DVec3,
    /// Camera to model rotation.
    pub rotation: DQuat,
    /// Perspective or orthographic.
    pub projection: Projection,
    /// Distance of the near plane, positive. There is no far plane.
    pub near: f64,
}

impl From<&View> for RenderCamera {
    /// The camera of a view. The aspect is left to the image's size.
    fn from(view: &View) -> Self {
        Self {
            eye: DVec3::from_array(view.eye),
            rotation: view.rotation(),
            projection: view.projection,
            near: view.near,
        }
    }
}

/// The camera's share of the shaders' globals.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct CameraUniform {
    /// Eye-relative lattice steps to clip space. Reverse-Z: 1 at the near plane, 0 at infinity.
    pub clip_from_relative: [[f32; 4]; 4],
    /// The eye in lattice steps, rounded to whole steps (as far as `f32` has them).
    pub eye_high: [f32; 4],
    /// The eye minus `eye_high`.
    pub eye_low: [f32; 4],
    /// The camera's backward axis; `w` is 1 for orthographic cameras, which all pixels see along it.
    pub back: [f32; 4],
    /// The camera's upward axis.
    pub up: [f32; 4],
    /// Unit vector to the key light.
    pub key: [f32; 4],
    /// From clip space back to camera coordinates: half the width and height of the image at distance 1 (perspective) or at
    /// any (orthographic). Perspective: `z` is the near distance, `w` 0. Orthographic: `z` the depth's span and `w` the far
    /// end's distance.
    pub unproject: [f32; 4],
}

impl CameraUniform {
    /// Composes what the shaders need for an image `aspect` times as wide as high, lit from the direction `key` (unit length,
    /// camera coordinates).
    pub fn new(camera: &RenderCamera, lattice: &Lattice, aspect: f64, key: Vec3) -> Self {
        let rotation = camera.rotation.normalize();
        let (up, back) = (rotation * DVec3::Y, rotation * DVec3::Z);
        let near = (camera.near / lattice.step).clamp(1e-20, 1e20);
        let eye = DVec3::from_array(lattice.to_lattice(camera.eye.to_array()));
        let camera_from_relative = DMat4::from_quat(rotation.inverse());
        let (anchor, clip_from_camera, unproject) = match camera.projection {
            Projection::Perspective { fov_y_rad } => {
                let focal = 1.0 / (f64::from(fov_y_rad) / 2.0).tan();
                let columns = [
                    DVec4::new(focal / aspect, 0.0, 0.0, 0.0),
                    DVec4::new(0.0, focal, 0.0, 0.0),
                    DVec4::new(0.0, 0.0, 0.0, -1.0),
                    DVec4::new(0.0, 0.0, near, 0.0),
                ];
                let unproject = [aspect / focal, 1.0 / focal, near, 0.0];
                (eye, DMat4::from_cols(columns[0], columns[1], columns[2], columns[3]), unproject)
            }
            Projection::Orthographic { height } => {
                // Parallel rays do not care how far back the eye is, but `f32` does: measure from where the eye's ray
                // passes the middle of the lattice. Depth spans from the near plane to the far side of the lattice's box.
                let half = f64::from(lattice.max_coordinate()) / 2.0;
                let ahead = (eye - DVec3::splat(half)).dot(back).max(0.0);
                let far = near.max(ahead + half * 3f64.sqrt()) + 1.0;
                let scale = 2.0 / (height / lattice.step);
                let depth = 1.0 / (far - near);
                let columns = [
                    DVec4::new(scale / aspect, 0.0, 0.0, 0.0),
                    DVec4::new(0.0, scale, 0.0, 0.0),
                    DVec4::new(0.0, 0.0, depth, 0.0),
                    DVec4::new(0.0, 0.0, (far - ahead) * depth, 1.0),
                ];
                let unproject = [aspect / scale, 1.0 / scale, far - near, far - ahead];
                (eye - back * ahead, DMat4::from_cols(columns[0], columns[1], columns[2], columns[3]), unproject)
            }
        };
        let clip_from_relative = (clip_from_camera * camera_from_relative).as_mat4();
        let high = anchor.round().as_vec3();
        let low = (anchor - high.as_dvec3()).as_vec3();
        let is_parallel = matches!(camera.projection, Projection::Orthographic { .. });
        Self {
            clip_from_relative: clip_from_relative.to_cols_array_2d(),
            eye_high: high.extend(0.0).to_array(),
            eye_low: low.extend(0.0).to_array(),
            back: back.as_vec3().extend(if is_parallel { 1.0 } else { 0.0 }).to_array(),
            up: up.as_vec3().extend(0.0).to_array(),
            key: (rotation * key.as_dvec3()).as_vec3().extend(0.0).to_array(),
            unproject: unproject.map(|x| x as f32),
        }
    }

    /// Where a point in lattice coordinates is in clip space, in `f32` as the shaders compute it.
    pub fn clip(&self, p: Vec3) -> Vec4 {
        let relative = (p - Vec4::from_array(self.eye_high).truncate()) - Vec4::from_array(self.eye_low).truncate();
        Mat4::from_cols_array_2d(&self.clip_from_relative) * relative.extend(1.0)
    }

    /// The point that the shaders' coordinates are relative to, in lattice steps: the eye, or for orthographic cameras a
    /// point on its axis.
    pub fn anchor(&self) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|k| f64::from(self.eye_high[k]) + f64::from(self.eye_low[k])))
    }
}

#[cfg(test)]
mod tests {
    use lodestream_protocol::view::look_along;

    use super::*;

    /// Where the shader puts lattice point `p`.
    fn clip(uniform: &CameraUniform, p: [i32; 3]) -> Vec4 {
        uniform.clip(Vec3::from_array(p.map(|x| x as f32)))
    }

    #[test]
    fn survey_coordinates_keep_their_pixels_in_a_close_up() {
        // A lattice of 0.1 mm steps in the millions of metres, looked at from 5 mm away.
        let lattice = Lattice { origin: [500_000.0, 4_600_000.0, 120.0], step: 1e-4, bits: 21 };
        let target = DVec3::from_array(lattice.position([1_500_000, 2_000_001, 1_999_999]));
        let forward = DVec3::new(0.3, -0.5, -0.8).normalize();
        let camera = RenderCamera {
            eye: target - forward * 5e-3,
            rotation: look_along(forward, DVec3::Y),
            projection: Projection::Perspective { fov_y_rad: 0.8 },
            near: 1e-4,
        };
        let uniform = CameraUniform::new(&camera, &lattice, 1.5, Vec3::Z);
        let at = clip(&uniform, [1_500_000, 2_000_001, 1_999_999]);
        // f64 model coordinates of this size resolve 1e-9 m: 1e-5 steps at a distance of 50 steps.
        assert!((at.x / at.w).abs() < 1e-5 && (at.y / at.w).abs() < 1e-5, "{at}");
        assert!((at.w - 50.0).abs() < 1e-3, "{at}");
        assert!((at.z / at.w - 0.02).abs() < 1e-5, "near over distance: {at}");
    }

    #[test]
    fn depth_is_reversed_and_orthographic_eyes_may_be_far() {
        let lattice = Lattice { origin: [-1.0; 3], step: 2.0 / 1023.0, bits: 10 };
        for distance in [3.0, 3e7] {
            let camera = RenderCamera {
                eye: DVec3::new(0.0, 0.0, distance),
                rotation: DQuat::IDENTITY,
                projection: Projection::Orthographic { height: 4.0 },
                near: 0.5,
            };
            let uniform = CameraUniform::new(&camera, &lattice, 1.0, Vec3::Z);
            let (front, rear) = (clip(&uniform, [1023, 0, 1023]), clip(&uniform, [1023, 0, 0]));
            assert!((front.x - 0.5).abs() < 1e-6 && (front.y + 0.5).abs() < 1e-6 && front.w == 1.0, "{front}");
            assert!(front.z > rear.z && rear.z > 0.0 && front.z < 1.0, "{front} {rear}");
        }
    }
}
