//! How much an op matters to a view: pure functions of its visibility sphere.

use glam::DVec3;
use lodestream_protocol::message::ModelInfo;
use lodestream_protocol::view::{Plane, Projection, View};

use crate::pack::record::{Bounds, Cone};

/// A view in lattice coordinates, ready to judge visibility spheres.
///
/// The priority of an op is its projected error in pixels if it may be seen, else 0 (Southern 2001, section 5.1.1, with the
/// facing test made conservative for the sphere's extent and the projection for its nearest point). It never exceeds the
/// priority of the op's forest parent, because spheres, cones and errors are nested.
#[derive(Clone, Debug)]
pub struct Scorer {
    eye: DVec3,
    planes: Vec<Plane>,
    /// Pixels per lattice step at distance of one step, or anywhere for parallel rays.
    pixel_scale: f64,
    near: f64,
    /// Viewing direction.
    forward: DVec3,
    /// Smallest depth over distance of a point inside the frustum: that of its corners.
    corner_cosine: f64,
    /// Viewing direction of parallel rays.
    parallel: Option<DVec3>,
    culls_facing_away: bool,
    silhouette_factor: f64,
    measure: Measure,
    /// Whether even errors of zero are wanted.
    wants_all: bool,
    threshold: f32,
    /// Box of the complete mesh, in lattice steps.
    model_box: [DVec3; 2],
}

/// What priorities are.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Measure {
    /// Projected errors.
    Pixels,
    /// Errors in lattice steps, whatever the camera.
    Error,
    /// Errors times radii.
    Volume,
}

/// Which way a cone of normals faces.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Facing {
    Toward,
    Away,
    Both,
}

impl Scorer {
    /// Prepares a view of a model.
    pub fn new(view: &View, model: &ModelInfo) -> Self {
        let lattice = &model.lattice;
        let origin = DVec3::from_array(lattice.origin);
        let planes = view
            .planes()
            .into_iter()
            .map(|plane| Plane {
                normal: plane.normal,
                offset: (plane.normal.dot(origin) + plane.offset) / lattice.step,
            })
            .collect();
        let forward = view.rotation() * DVec3::NEG_Z;
        let (parallel, corner_cosine) = match view.projection {
            Projection::Perspective { fov_y_rad } => {
                let y = f64::from(fov_y_rad / 2.0).tan();
                let x = y * f64::from(view.aspect);
                (None, 1.0 / (1.0 + x * x + y * y).sqrt())
            }
            Projection::Orthographic { .. } => (Some(forward), 1.0),
        };
        let pixel_scale = match parallel {
            None => view.pixel_scale(),
            Some(_) => view.pixel_scale() * lattice.step,
        };
        Self {
            eye: DVec3::from_array(lattice.to_lattice(view.eye)),
            planes,
            pixel_scale,
            near: (view.near / lattice.step).max(1e-6),
            forward,
            corner_cosine,
            parallel,
            culls_facing_away: !(view.two_sided || model.is_open),
            silhouette_factor: f64::from(view.silhouette_factor),
            measure: if view.complete { Measure::Volume } else { Measure::Pixels },
            wants_all: view.complete,
            threshold: if view.complete { 0.0 } else { view.tolerance_px },
            model_box: [model.box_min, model.box_max].map(|q| DVec3::from_array(q.map(f64::from))),
        }
    }

    /// Wants every op with an error over so many lattice steps, whatever the camera.
    pub fn by_error(steps: f32) -> Self {
        Self {
            eye: DVec3::ZERO,
            planes: Vec::new(),
            pixel_scale: 1.0,
            near: 1.0,
            forward: DVec3::NEG_Z,
            corner_cosine: 1.0,
            parallel: None,
            culls_facing_away: false,
            silhouette_factor: 1.0,
            measure: Measure::Error,
            wants_all: false,
            threshold: steps,
            // Never looked at: complete views judge by error alone.
            model_box: [DVec3::ZERO; 2],
        }
    }

    /// Wants every op, as a complete view does.
    pub fn complete() -> Self {
        Self { measure: Measure::Volume, wants_all: true, ..Self::by_error(0.0) }
    }

    /// Whether an op of this priority is wanted, limits aside.
    #[inline]
    pub fn wants(&self, priority: f32) -> bool {
        self.wants_all || priority > self.threshold
    }

    /// Largest priority that is not wanted.
    pub fn threshold(&self) -> f32 {
        self.threshold
    }

    /// Projected error in pixels, or 0 for what cannot be seen. For complete views, error times radius in squared lattice steps:
    /// halfway from the largest distance anywhere, which the error alone would keep low, to the volume between the surfaces. Under a
    /// triangle limit that gives the least mean distance, and like the error it falls along the forest.
    pub fn priority(&self, bounds: &Bounds) -> f32 {
        let error = bounds.error.decode();
        match self.measure {
            Measure::Error => return error,
            Measure::Volume => return error * bounds.radius.decode(),
            Measure::Pixels => {}
        }
        let center = DVec3::new(f64::from(bounds.center[0]), f64::from(bounds.center[1]), f64::from(bounds.center[2]));
        let radius = f64::from(bounds.radius.decode());
        if self.planes.iter().any(|plane| plane.normal.dot(center) + plane.offset < -radius) {
            return 0.0;
        }
        let to_center = center - self.eye;
        let distance = to_center.length();
        let facing = self.facing(&bounds.cone, to_center, distance, radius);
        if facing == Facing::Away && self.culls_facing_away {
            return 0.0;
        }
        let mut pixels = f64::from(error) * self.pixel_scale;
        if self.parallel.is_none() {
            // Size on screen goes by depth, not distance: of two lower bounds on the depth of what is in the frustum and in
            // the sphere, the first serves near the axis, the other for large spheres beside it. Both grow as spheres shrink.
            let depth = (to_center.dot(self.forward) - radius).max((distance - radius) * self.corner_cosine);
            pixels /= depth.max(self.near);
        }
        if facing == Facing::Both {
            pixels *= self.silhouette_factor;
        }
        pixels as f32
    }

    /// Not less than the priority of any spawn whose error is at most so many lattice steps: its centre lies in the model's box
    /// and its radius is at most twice its error, which [`verify`](fn@crate::pack::verify) checks.
    pub(crate) fn most_of_spawn(&self, error: f32) -> f32 {
        match self.measure {
            Measure::Error => return error,
            Measure::Volume => return 2.0 * error * error * (1.0 + 1e-6),
            Measure::Pixels => {}
        }
        let mut pixels = f64::from(error) * self.pixel_scale * self.silhouette_factor.max(1.0);
        if self.parallel.is_none() {
            let [low, high] = self.model_box;
            let distance = self.eye.distance(self.eye.clamp(low, high));
            pixels /= ((distance - 2.0 * f64::from(error)) * self.corner_cosine).max(self.near);
        }
        // The sums of `priority` are rounded in another order.
        (pixels * (1.0 + 1e-6)) as f32
    }

    /// Whether an op of smaller priority may have a larger error.
    pub(crate) fn weighs_errors(&self) -> bool {
        self.measure == Measure::Volume
    }

    /// What is missing without an op of this priority: pixels, or lattice steps for complete views.
    pub fn missing(&self, priority: f32, bounds: &Bounds) -> f32 {
        if self.measure == Measure::Pixels { priority } else { bounds.error.decode() }
    }

    fn facing(&self, cone: &Cone, to_center: DVec3, distance: f64, radius: f64) -> Facing {
        let Some((axis, sin, cos)) = cone.decode() else { return Facing::Both };
        // Angle by which the direction to a point of the sphere may differ from the direction to its centre.
        let (direction, sin_extent) = match self.parallel {
            Some(direction) => (direction, 0.0),
            None if distance <= radius => return Facing::Both,
            None => (to_center / distance, radius / distance),
        };
        let cos_extent = (1.0 - sin_extent * sin_extent).max(0.0).sqrt();
        let (sin, cos) = (f64::from(sin), f64::from(cos));
        // All normals and directions differ from the two axes by at most the sum of both angles.
        if cos * cos_extent - sin * sin_extent <= 0.0 {
            return Facing::Both;
        }
        let sin_sum = sin * cos_extent + cos * sin_extent;
        let along = direction.dot(axis.as_dvec3());
        if along > sin_sum {
            Facing::Away
        } else if along < -sin_sum {
            Facing::Toward
        } else {
            Facing::Both
        }
    }
}
