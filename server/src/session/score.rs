//! How much an op matters to a view: pure functions of its visibility sphere.

use glam::DVec3;
use lodestream_protocol::message::ModelInfo;
use lodestream_protocol::view::{Plane, Projection, View};

use crate::pack::record::{Bounds, WideCone};

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
    /// The model's extent.
    parallel_length: f64,
    culls_facing_away: bool,
    silhouette_factor: f64,
    measure: Measure,
    /// Whether even errors of zero are wanted.
    wants_all: bool,
    threshold: f32,
    /// Box of the complete mesh, in lattice steps.
    model_box: [DVec3; 2],
    /// That with a margin: centres of spheres may lie a little outside.
    tested_box: [DVec3; 2],
}

/// What a view with a camera judges by.
#[derive(Clone, Copy, Debug)]
pub(super) struct Camera {
    pub(super) eye: DVec3,
    pub(super) forward: DVec3,
    pub(super) pixel_scale: f64,
    pub(super) near: f64,
    pub(super) corner_cosine: f64,
    pub(super) parallel: Option<DVec3>,
    pub(super) culls_facing_away: bool,
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
    /// Factor of priorities at silhouettes.
    pub(super) fn silhouette_factor(&self) -> f64 {
        self.silhouette_factor
    }

    /// Depths below which sizes grow no more, in lattice steps; 0 for parallel rays.
    pub(super) fn near(&self) -> f64 {
        if self.parallel.is_some() { 0.0 } else { self.near }
    }

    /// A box that holds the centres of nearly all spheres of the model. It is the same for all views.
    pub(super) fn tested_box(&self) -> [DVec3; 2] {
        self.tested_box
    }

    /// Planes of the frustum and others that cut the view, normals inward.
    pub(super) fn planes(&self) -> &[Plane] {
        &self.planes
    }

    /// Viewing direction.
    pub(super) fn forward(&self) -> DVec3 {
        self.forward
    }

    /// Smallest depth over distance inside the frustum.
    pub(super) fn corner_cosine(&self) -> f64 {
        self.corner_cosine
    }

    /// Whether rays are parallel: sizes do not go by depth.
    pub(super) fn is_parallel(&self) -> bool {
        self.parallel.is_some()
    }

    /// By how much directions of parallel rays count beside lengths.
    pub(super) fn parallel_length(&self) -> f64 {
        self.parallel_length
    }

    /// The eye, in lattice steps.
    pub(super) fn eye(&self) -> DVec3 {
        self.eye
    }

    /// The camera, unless priorities go by errors alone.
    #[inline]
    pub(super) fn camera(&self) -> Option<Camera> {
        let camera = Camera {
            eye: self.eye,
            forward: self.forward,
            pixel_scale: self.pixel_scale,
            near: self.near,
            corner_cosine: self.corner_cosine,
            parallel: self.parallel,
            culls_facing_away: self.culls_facing_away,
        };
        (self.measure == Measure::Pixels).then_some(camera)
    }

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
        let model_box = [model.box_min, model.box_max].map(|q| DVec3::from_array(q.map(f64::from)));
        let margin = DVec3::splat(model_box[0].distance(model_box[1]) / 16.0 + 2.0);
        Self {
            eye: DVec3::from_array(lattice.to_lattice(view.eye)),
            planes,
            pixel_scale,
            near: (view.near / lattice.step).max(1e-6),
            forward,
            corner_cosine,
            parallel,
            parallel_length: model_box[0].distance(model_box[1]),
            culls_facing_away: !(view.two_sided || model.is_open),
            silhouette_factor: f64::from(view.silhouette_factor),
            measure: if view.complete { Measure::Volume } else { Measure::Pixels },
            wants_all: view.complete,
            threshold: if view.complete { 0.0 } else { view.tolerance_px },
            model_box,
            tested_box: [model_box[0] - margin, model_box[1] + margin],
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
            parallel_length: 0.0,
            culls_facing_away: false,
            silhouette_factor: 1.0,
            measure: Measure::Error,
            wants_all: false,
            threshold: steps,
            // Never looked at: complete views judge by error alone.
            model_box: [DVec3::ZERO; 2],
            tested_box: [DVec3::ZERO; 2],
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
        let probe = self.probe(bounds);
        if probe.is_out() { 0.0 } else { probe.pixels as f32 }
    }

    /// What decides about an op in a view with a camera, see [`Probe`]. With the reading of its bounds some 75 ns.
    #[inline]
    pub(super) fn probe(&self, bounds: &Bounds) -> Probe {
        let center = DVec3::new(f64::from(bounds.center[0]), f64::from(bounds.center[1]), f64::from(bounds.center[2]));
        let radius = f64::from(bounds.radius.decode());
        let (mut inside, mut next_inside, mut plane) = (f64::INFINITY, f64::INFINITY, 0);
        for (number, border) in self.planes.iter().enumerate() {
            let distance = border.normal.dot(center) + border.offset + radius;
            (plane, next_inside) =
                if distance < inside { (number, inside) } else { (plane, next_inside.min(distance)) };
            inside = inside.min(distance);
        }
        let to_center = center - self.eye;
        let distance = to_center.length();
        let cone = bounds.cone.wide();
        let facing = self.facing(cone.as_ref(), to_center, distance, radius);
        let error = f64::from(bounds.error.decode()) * self.pixel_scale;
        // Size on screen goes by depth, not distance: of two lower bounds on the depth of what is in the frustum and in
        // the sphere, the first serves near the axis, the other for large spheres beside it. Both grow as spheres shrink.
        let depth = match self.parallel {
            None => (to_center.dot(self.forward) - radius).max((distance - radius) * self.corner_cosine),
            Some(_) => 1.0,
        };
        let mut pixels = error;
        if self.parallel.is_none() {
            pixels /= depth.max(self.near);
        }
        if facing == Facing::Both {
            pixels *= self.silhouette_factor;
        }
        let depth_moves = self.parallel.is_none();
        let (ray, reach) = match self.parallel {
            None => (to_center, radius),
            Some(direction) => (direction * self.parallel_length, 0.0),
        };
        Probe {
            inside,
            plane: plane as u8,
            next_inside,
            is_away: facing == Facing::Away && self.culls_facing_away,
            cone: cone.filter(|_| self.culls_facing_away),
            ray,
            reach,
            error,
            depth,
            depth_moves,
            pixels,
            center,
            distance,
        }
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

    /// Which way the cone's directions face from everywhere in the sphere.
    #[inline]
    fn facing(&self, cone: Option<&WideCone>, to_center: DVec3, distance: f64, radius: f64) -> Facing {
        let Some(&WideCone { axis, sin, cos }) = cone else { return Facing::Both };
        // Angle by which the direction to a point of the sphere may differ from the direction to its centre.
        let (direction, sin_extent) = match self.parallel {
            Some(direction) => (direction, 0.0),
            None if distance <= radius => return Facing::Both,
            None => (to_center / distance, radius / distance),
        };
        let cos_extent = (1.0 - sin_extent * sin_extent).max(0.0).sqrt();
        // All normals and directions differ from the two axes by at most the sum of both angles.
        let cos_sum = cos * cos_extent - sin * sin_extent;
        let sin_sum = sin * cos_extent + cos * sin_extent;
        let along = direction.dot(axis);
        match along {
            _ if cos_sum <= 0.0 => Facing::Both,
            _ if along > sin_sum => Facing::Away,
            _ if along < -sin_sum => Facing::Toward,
            _ => Facing::Both,
        }
    }
}

/// What decides about an op, and how far what decides may change before the decision may: in lattice steps, by what each kind counts,
/// see [`front`](super::front).
#[derive(Clone, Copy, Debug)]
pub(super) struct Probe {
    /// How far inside the frustum the sphere reaches, negative outside.
    pub(super) inside: f64,
    /// The plane that says so, and the same by the next of the others.
    pub(super) plane: u8,
    pub(super) next_inside: f64,
    is_away: bool,
    /// Its normals, if it may face away.
    pub(super) cone: Option<WideCone>,
    /// From the eye to its centre; of parallel rays their direction, as long as the model.
    ray: DVec3,
    /// Its radius; none for parallel rays.
    reach: f64,
    /// Pixels at depth 1, without the silhouette factor.
    error: f64,
    depth: f64,
    /// Whether pixels go by depth at all.
    depth_moves: bool,
    pixels: f64,
    /// Of the sphere.
    pub(super) center: DVec3,
    /// From the eye to that.
    distance: f64,
}

/// Share of a depth that its rounding may come to, generously.
const ROUNDING: f64 = 1e-6;

impl Probe {
    /// Whether the op cannot be seen.
    #[inline]
    pub(super) fn is_out(&self) -> bool {
        self.inside < 0.0 || self.is_away
    }

    /// Its priority, see [`Scorer::priority`].
    #[inline]
    pub(super) fn priority(&self) -> f32 {
        if self.is_out() { 0.0 } else { self.pixels as f32 }
    }

    /// Its size by itself.
    #[inline]
    pub(super) fn size(&self) -> Size {
        let rounding = ROUNDING * self.distance;
        let depth = if self.depth_moves { self.depth } else { 1.0 };
        Size { pixels: self.error, least_depth: depth - rounding, most_depth: depth + rounding }
    }

    /// Share of what is compared that may be rounding.
    #[inline]
    pub(super) fn rounding(&self) -> f64 {
        ROUNDING * (self.distance + self.ray.length())
    }

    /// How far it is to or (positive) from facing away: the least of `ray . n - reach` over the normals n of its cone (Southern 2001, section
    /// 5.1.1, as a condition on the eye that is linear for each normal), and the normal for which it is least. None if it never faces away.
    #[inline]
    pub(super) fn away(&self) -> Option<(f64, DVec3)> {
        let WideCone { axis, sin, cos } = self.cone?;
        let along = self.ray.dot(axis);
        let across = self.ray - along * axis;
        let far = across.length();
        if far * cos + along * sin < 0.0 {
            // The cone holds the direction to the eye.
            return Some((-self.ray.length() - self.reach, -self.ray));
        }
        let sideways = if far > 0.0 { across / far } else { axis.any_orthonormal_vector() };
        Some((along * cos - far * sin - self.reach, axis * cos - sideways * sin))
    }
}

/// The size of what a sphere stands for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Size {
    /// Pixels at depth 1, without the factor of silhouettes.
    pub(super) pixels: f64,
    /// The depth that counts, rounding included; 1 for parallel rays.
    pub(super) least_depth: f64,
    pub(super) most_depth: f64,
}
