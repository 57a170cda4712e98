//! From pixels to space and back.

use glam::DVec3;
use lodestream_protocol::view::Projection;

use super::{Camera, Viewport};

/// A half-line in model units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Where it begins: the eye, or (orthographic) the point of the eye's plane behind the pixel.
    pub origin: DVec3,
    /// Unit vector into the picture.
    pub direction: DVec3,
}

impl Ray {
    /// The point at a distance from the origin.
    pub fn at(&self, distance: f64) -> DVec3 {
        self.origin + self.direction * distance
    }
}

impl Camera {
    /// What lies behind a point of the image, in pixels from its upper left corner.
    pub fn ray(&self, viewport: Viewport, [x_px, y_px]: [f64; 2]) -> Ray {
        let height = f64::from(viewport.height_px.max(1));
        // From the middle, in halves of the image's height, y up.
        let x = (2.0 * x_px - f64::from(viewport.width_px)) / height;
        let y = 1.0 - 2.0 * y_px / height;
        match self.projection {
            Projection::Perspective { fov_y_rad } => {
                let reach = (f64::from(fov_y_rad) / 2.0).tan();
                let direction = (self.orientation * DVec3::new(x * reach, y * reach, -1.0)).normalize();
                Ray { origin: self.eye, direction }
            }
            Projection::Orthographic { height: units } => {
                let across = self.orientation * DVec3::new(x * units / 2.0, y * units / 2.0, 0.0);
                Ray { origin: self.eye + across, direction: self.forward() }
            }
        }
    }

    /// Where a point of the model is in the image, in pixels from its upper left corner (possibly outside), or `None` if
    /// it is not in front of the camera.
    pub fn pixel(&self, viewport: Viewport, point: DVec3) -> Option<[f64; 2]> {
        let p = self.orientation.conjugate() * (point - self.eye);
        if p.z >= 0.0 {
            return None;
        }
        let half = match self.projection {
            Projection::Perspective { fov_y_rad } => (f64::from(fov_y_rad) / 2.0).tan() * -p.z,
            Projection::Orthographic { height } => height / 2.0,
        };
        let height = f64::from(viewport.height_px.max(1));
        Some([(f64::from(viewport.width_px) + p.x / half * height) / 2.0, (1.0 - p.y / half) * height / 2.0])
    }

    /// Model units that a pixel spans across at a point: 0 behind the eye.
    pub fn units_per_pixel(&self, viewport: Viewport, point: DVec3) -> f64 {
        let height = f64::from(viewport.height_px.max(1));
        match self.projection {
            Projection::Perspective { fov_y_rad } => {
                let depth = (point - self.eye).dot(self.forward()).max(0.0);
                2.0 * (f64::from(fov_y_rad) / 2.0).tan() * depth / height
            }
            Projection::Orthographic { height: units } => units / height,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_and_rays_are_each_others_inverse() {
        let viewport = Viewport { width_px: 800, height_px: 500 };
        for projection in [Projection::Perspective { fov_y_rad: 0.9 }, Projection::Orthographic { height: 3.0 }] {
            let mut camera = Camera { projection, ..Camera::perspective(0.9) };
            camera.look_at(DVec3::new(3.0, 2.0, 5.0), DVec3::new(0.2, 0.1, 0.0));
            for pixel in [[400.0, 250.0], [0.0, 0.0], [799.0, 12.5]] {
                let point = camera.ray(viewport, pixel).at(4.0);
                let back = camera.pixel(viewport, point).unwrap();
                assert!((0..2).all(|k| (back[k] - pixel[k]).abs() < 1e-9), "{back:?} {pixel:?}");
                let beside = camera.orientation * DVec3::X * camera.units_per_pixel(viewport, point);
                let back = camera.pixel(viewport, point + beside).unwrap();
                assert!((back[0] - pixel[0] - 1.0).abs() < 1e-9, "a pixel to the right: {back:?}");
            }
            let middle = camera.ray(viewport, [400.0, 250.0]);
            assert!(middle.direction.distance(camera.forward()) < 1e-12);
            assert_eq!(camera.pixel(viewport, middle.at(-1.0)), None);
        }
    }

    #[test]
    fn the_matrix_agrees() {
        let viewport = Viewport { width_px: 640, height_px: 480 };
        let bounds = super::super::Bounds { center: DVec3::ZERO, radius: 1.0 };
        let mut camera = Camera::perspective(0.7);
        camera.frame(&bounds, DVec3::new(1.0, 0.4, 0.3), viewport.aspect());
        let point = DVec3::new(0.3, -0.2, 0.5);
        let clip = camera.view_projection(viewport.aspect(), &bounds).project_point3(point);
        let pixel = camera.pixel(viewport, point).unwrap();
        assert!((pixel[0] - (clip.x + 1.0) * 320.0).abs() < 1e-9 && (pixel[1] - (1.0 - clip.y) * 240.0).abs() < 1e-9);
    }
}
