//! Where a picture is taken from: the first view that the viewer shows, of which the picture is a part.

use glam::DVec3;

/// From the model towards the eye: the viewer's first direction. y is up.
const TOWARDS_EYE: DVec3 = DVec3::new(0.35, 0.25, 1.0);
/// Half of the viewer's opening angle, 22.5 degrees: its tangent and its sine.
const TANGENT: f64 = 0.414_213_562_373_095_1;
const SINE: f64 = 0.382_683_432_365_089_8;
/// Share of the picture that stays empty on each side.
const MARGIN: f64 = 0.04;
/// Least height of a picture in heights of the first view: a single point would be scaled without end.
const LEAST: f64 = 1e-3;

/// The part of the first view that a picture shows. The unit is the *square* of the view: the square in the middle of an
/// image that is as long as the narrower side, whose edges the ball around the model touches. What a picture shows is thus where
/// it is in every image, whatever its shape.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window {
    /// From the left edge of the square to that of the picture, to the right.
    pub left: f64,
    /// From the top edge of the square to that of the picture, down.
    pub top: f64,
    /// Width, positive.
    pub width: f64,
    /// Height, positive.
    pub height: f64,
}

/// Steps of the square's side that a window is told in: finer than pixels.
const STEPS: f64 = 1e5;

impl Window {
    /// The smallest one of `aspect` (width over height) with a margin around these points of the square.
    fn around(least: [f64; 2], most: [f64; 2], aspect: f64) -> Self {
        let extent = [0, 1].map(|k| (most[k] - least[k]) / (1.0 - 2.0 * MARGIN));
        let height = rounded(extent[1].max(extent[0] / aspect).max(LEAST));
        let width = rounded(height * aspect);
        let [left, top] = [(0, width), (1, height)].map(|(k, side)| rounded((least[k] + most[k] - side) / 2.0));
        Self { left, top, width, height }
    }

    /// Four numbers: left, top, width and height.
    pub(super) fn to_text(self) -> String {
        let Self { left, top, width, height } = self;
        format!("{left} {top} {width} {height}")
    }

    /// Reads them again; `None` if they are none, or of no picture.
    pub(super) fn from_text(text: &str) -> Option<Self> {
        let numbers: Option<Vec<f64>> = text.split(' ').take(5).map(|number| number.parse().ok()).collect();
        let [left, top, width, height] = numbers?.try_into().ok()?;
        let is_of_a_picture = [left, top, width, height].iter().all(|x| x.abs() <= 10.0) && width > 0.0 && height > 0.0;
        is_of_a_picture.then_some(Self { left, top, width, height })
    }
}

/// As the text says it, so that the picture is drawn for exactly the place that it is shown in.
fn rounded(x: f64) -> f64 {
    (x * STEPS).round() / STEPS
}

/// Maps points to samples.
#[derive(Clone, Debug)]
pub(super) struct Camera {
    eye: DVec3,
    /// Unit vectors to the right, up and back.
    pub(super) right: DVec3,
    pub(super) up: DVec3,
    pub(super) back: DVec3,
    /// What the picture shows of the first view.
    pub(super) window: Window,
    /// Samples per side of the square.
    scale: [f64; 2],
}

impl Camera {
    /// The viewer's first camera before a model of this ball (centre and radius in model units, the radius positive), and of
    /// what it sees as much as all the points need, in so many samples. `None` without points.
    pub(super) fn framing(
        (center, radius): ([f64; 3], f64),
        points: &[[f64; 3]],
        width: u32,
        height: u32,
    ) -> Option<Self> {
        let back = TOWARDS_EYE / TOWARDS_EYE.dot(TOWARDS_EYE).sqrt();
        let right = DVec3::Y.cross(back);
        let right = right / right.dot(right).sqrt();
        let up = back.cross(right);
        let square = Window { left: 0.0, top: 0.0, width: 1.0, height: 1.0 };
        let eye = DVec3::from_array(center) + back * (radius / SINE);
        let mut camera = Self { eye, right, up, back, window: square, scale: [1.0; 2] };

        let (mut least, mut most) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for &point in points {
            let [x, y, _] = camera.project(DVec3::from_array(point));
            for (k, at) in [x, y].into_iter().enumerate() {
                least[k] = least[k].min(at);
                most[k] = most[k].max(at);
            }
        }
        if points.is_empty() {
            return None;
        }
        camera.window = Window::around(least, most, f64::from(width) / f64::from(height));
        camera.scale = [f64::from(width) / camera.window.width, f64::from(height) / camera.window.height];
        Some(camera)
    }

    /// Samples from the left and from the top, and the depth along the view. Points of the ball are in front of the eye.
    pub(super) fn project(&self, point: DVec3) -> [f64; 3] {
        let from_eye = point - self.eye;
        let depth = -from_eye.dot(self.back);
        // Half the square's side, at this depth.
        let half = depth * TANGENT;
        let x = 0.5 + 0.5 * from_eye.dot(self.right) / half;
        let y = 0.5 - 0.5 * from_eye.dot(self.up) / half;
        [(x - self.window.left) * self.scale[0], (y - self.window.top) * self.scale[1], depth]
    }

    /// From a point towards the eye; any length.
    pub(super) fn towards_eye(&self, point: DVec3) -> DVec3 {
        self.eye - point
    }
}
