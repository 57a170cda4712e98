//! How much an op matters to a view: pure functions of its visibility sphere.

use glam::DVec3;
use lodestream_protocol::quant::Lattice;
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
    /// Viewing direction of parallel rays.
    parallel: Option<DVec3>,
    culls_facing_away: bool,
    silhouette_factor: f64,
    complete: bool,
    threshold: f32,
}

/// Which way a cone of normals faces.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Facing {
    Toward,
    Away,
    Both,
}

impl Scorer {
    /// Prepares a view of a model on `lattice`; `is_open` keeps what faces away.
    pub fn new(view: &View, lattice: &Lattice, is_open: bool) -> Self {
        let origin = DVec3::from_array(lattice.origin);
        let planes = view
            .planes()
            .into_iter()
            .map(|plane| Plane {
                normal: plane.normal,
                offset: (plane.normal.dot(origin) + plane.offset) / lattice.step,
            })
            .collect();
        let parallel = match view.projection {
            Projection::Perspective { .. } => None,
            Projection::Orthographic { .. } => Some(view.rotation() * DVec3::NEG_Z),
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
            parallel,
            culls_facing_away: !(view.two_sided || is_open),
            silhouette_factor: f64::from(view.silhouette_factor),
            complete: view.complete,
            threshold: if view.complete { 0.0 } else { view.tolerance_px },
        }
    }

    /// Whether an op of this priority is wanted, limits aside.
    #[inline]
    pub fn wants(&self, priority: f32) -> bool {
        self.complete || priority > self.threshold
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
        if self.complete {
            return error * bounds.radius.decode();
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
            pixels /= (distance - radius).max(self.near);
        }
        if facing == Facing::Both {
            pixels *= self.silhouette_factor;
        }
        pixels as f32
    }

    /// What is missing without an op of this priority: pixels, or lattice steps for complete views.
    pub fn missing(&self, priority: f32, bounds: &Bounds) -> f32 {
        if self.complete { bounds.error.decode() } else { priority }
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
