//! Where a picture is taken from: a perspective camera that frames what it sees.

use glam::DVec3;

/// From the model towards the eye: three quarters, a little above. y is up.
const TOWARDS_EYE: DVec3 = DVec3::new(0.52, 0.42, 0.80);
/// Distance of the eye in radii of the model: a long lens, which distorts little.
const DISTANCE: f64 = 4.0;
/// Share of the picture that stays empty on each side.
const MARGIN: f64 = 0.04;

/// Maps points to samples.
#[derive(Clone, Debug)]
pub(super) struct Camera {
    eye: DVec3,
    /// Unit vectors to the right, up and back.
    pub(super) right: DVec3,
    pub(super) up: DVec3,
    pub(super) back: DVec3,
    /// Samples per unit of the image plane, and where its origin lies.
    scale: f64,
    offset: [f64; 2],
}

impl Camera {
    /// A camera that sees all the points in the middle of so many samples, as large as they fit; `None` without points.
    pub(super) fn framing(points: &[[f64; 3]], width: u32, height: u32) -> Option<Self> {
        let mut low = DVec3::from_array(*points.first()?);
        let mut high = low;
        for &point in points {
            low = low.min(DVec3::from_array(point));
            high = high.max(DVec3::from_array(point));
        }
        let center = (low + high) * 0.5;
        let radius = (high - low).length() * 0.5;
        let radius = if radius > 0.0 { radius } else { 1.0 };
        let back = TOWARDS_EYE / TOWARDS_EYE.dot(TOWARDS_EYE).sqrt();
        let right = DVec3::Y.cross(back);
        let right = right / right.dot(right).sqrt();
        let up = back.cross(right);
        let mut camera =
            Self { eye: center + back * (radius * DISTANCE), right, up, back, scale: 1.0, offset: [0.0; 2] };

        let (mut least, mut most) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for &point in points {
            let [x, y, _] = camera.project(DVec3::from_array(point));
            for (k, at) in [x, y].into_iter().enumerate() {
                least[k] = least[k].min(at);
                most[k] = most[k].max(at);
            }
        }
        let room = [width, height].map(|samples| f64::from(samples) * (1.0 - 2.0 * MARGIN));
        // A tiny share of the image plane at least, or a single point would be scaled without end.
        let extent = |k: usize| (most[k] - least[k]).max(1e-6);
        camera.scale = (room[0] / extent(0)).min(room[1] / extent(1));
        camera.offset = [0, 1].map(|k| {
            let samples = f64::from([width, height][k]);
            samples * 0.5 - (least[k] + most[k]) * 0.5 * camera.scale
        });
        Some(camera)
    }

    /// Samples from the left and from the top, and the depth along the view. Every point is in front of the eye.
    pub(super) fn project(&self, point: DVec3) -> [f64; 3] {
        let from_eye = point - self.eye;
        let depth = -from_eye.dot(self.back);
        let x = from_eye.dot(self.right) / depth * self.scale + self.offset[0];
        let y = -from_eye.dot(self.up) / depth * self.scale + self.offset[1];
        [x, y, depth]
    }

    /// From a point towards the eye; any length.
    pub(super) fn towards_eye(&self, point: DVec3) -> DVec3 {
        self.eye - point
    }
}
