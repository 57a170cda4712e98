//! Visibility spheres: what each op and its forest descendants touch, carried up with the surviving vertices.
//!
//! Two versions travel together: the union in `f64`, and the bounds as stored. A stored sphere covers the exact union and the
//! stored spheres of its children, so it contains them as decoded; since it is not made from the children's rounded
//! spheres alone, rounding does not pile up along the forest (Southern 2001, section 5.1.1).

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use super::NONE;
use crate::pack::record::{Bounds, Cone, Magnitude, WideCone};

/// A sphere in lattice steps.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct Sphere {
    pub(crate) center: DVec3,
    pub(crate) radius: f64,
}

/// Slack for the rounding of a few additions and roots.
const ROUNDING: f64 = 1.0 + 1e-12;

impl Sphere {
    /// The sphere about the middle of the points' box.
    fn around(points: &[DVec3]) -> Self {
        let mut low = DVec3::INFINITY;
        let mut high = DVec3::NEG_INFINITY;
        for &p in points {
            low = low.min(p);
            high = high.max(p);
        }
        let center = (low + high) * 0.5;
        let radius = points.iter().map(|p| p.distance_squared(center)).fold(0.0, f64::max).sqrt() * ROUNDING;
        Self { center, radius }
    }

    /// Smallest sphere around two.
    pub(crate) fn union(self, other: Self) -> Self {
        let between = other.center - self.center;
        let distance = between.length();
        if distance + other.radius <= self.radius {
            return self;
        }
        if distance + self.radius <= other.radius {
            return other;
        }
        let radius = (distance + self.radius + other.radius) * 0.5;
        Self { center: self.center + between * ((radius - self.radius) / distance), radius }
    }

    /// A small sphere around two spheres and some points: grown point by point (Ritter 1990), then cut back to what the
    /// centre found that way needs.
    fn around_spheres(a: Self, b: Self, points: &[DVec3]) -> Self {
        let Self { mut center, mut radius } = a.union(b);
        for &p in points {
            let distance_squared = p.distance_squared(center);
            if distance_squared > radius * radius {
                let distance = distance_squared.sqrt();
                let growth = (distance - radius) * 0.5;
                center += (p - center) * (growth / distance);
                radius += growth;
            }
        }
        let far = points.iter().map(|p| p.distance_squared(center)).fold(0.0, f64::max).sqrt();
        let radius = far.max(center.distance(a.center) + a.radius).max(center.distance(b.center) + b.radius);
        Self { center, radius: radius * ROUNDING }
    }
}

/// The directions of some normals.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Normals {
    /// No face with area yet.
    Nothing,
    Within(WideCone),
    /// More than a half-space.
    Any,
}

impl Normals {
    /// Smallest cone around two, found with addition formulas and roots alone.
    pub(crate) fn union(self, other: Self) -> Self {
        match (self, other) {
            (Self::Nothing, x) | (x, Self::Nothing) => x,
            (Self::Any, _) | (_, Self::Any) => Self::Any,
            (Self::Within(a), Self::Within(b)) => union(&a, &b),
        }
    }

    /// The cone of some unit normals about their mean.
    fn of_units(units: &[DVec3]) -> Self {
        if units.is_empty() {
            return Self::Nothing;
        }
        let sum: DVec3 = units.iter().sum();
        let length = sum.length();
        if length < 1e-6 {
            return Self::Any;
        }
        let axis = sum / length;
        let cos = units.iter().map(|n| axis.dot(*n)).fold(1.0, f64::min);
        if cos > 0.0 { Self::Within(WideCone { axis, sin: (1.0 - cos * cos).sqrt(), cos }) } else { Self::Any }
    }

    /// Adds normals of any length; zero is ignored. Takes in the one that sticks out most, then looks again: one or two
    /// rounds bring in nearly all of them.
    pub(crate) fn add(&mut self, normals: &[DVec3]) {
        loop {
            let mut farthest = (1.0, DVec3::ZERO);
            let (axis, least) = match self {
                Self::Any => return,
                // The first normal there is.
                Self::Nothing => (DVec3::ZERO, 1.0),
                Self::Within(cone) => (cone.axis, cone.cos - 1e-12),
            };
            for &normal in normals {
                let length_squared = normal.length_squared();
                if length_squared == 0.0 {
                    continue;
                }
                let along = axis.dot(normal);
                if along > 0.0 && along * along >= least * least * length_squared {
                    continue;
                }
                let length = length_squared.sqrt();
                let cos = along / length;
                if cos < least && cos < farthest.0 {
                    farthest = (cos, normal / length);
                }
            }
            if farthest.1 == DVec3::ZERO {
                return;
            }
            *self = self.union(Self::Within(WideCone { axis: farthest.1, sin: 0.0, cos: 1.0 }));
        }
    }
}

fn union(a: &WideCone, b: &WideCone) -> Normals {
    let cos_axes = a.axis.dot(b.axis);
    let sin_axes = a.axis.cross(b.axis).length();
    // Cosine and sine of the angle from the axis of `x` to the far side of `y`.
    let far = |y: &WideCone| (cos_axes * y.cos - sin_axes * y.sin, sin_axes * y.cos + cos_axes * y.sin);
    let is_inside = |x: &WideCone, (cos, sin): (f64, f64)| sin >= 0.0 && cos >= x.cos;
    if is_inside(a, far(b)) {
        return Normals::Within(*a);
    }
    if is_inside(b, far(a)) {
        return Normals::Within(*b);
    }
    if sin_axes < 1e-9 {
        // Almost one axis: the wider cone, unless they are opposite.
        return if cos_axes > 0.0 { Normals::Within(if a.cos < b.cos { *a } else { *b }) } else { Normals::Any };
    }
    // The whole spans (angle of a) + (angle between the axes) + (angle of b).
    let (cos, sin) = far(b);
    if cos * a.sin + sin * a.cos <= 0.0 || sin < 0.0 {
        return Normals::Any;
    }
    let edge_a = a.axis * a.cos - (b.axis - a.axis * cos_axes) * (a.sin / sin_axes);
    let edge_b = b.axis * b.cos - (a.axis - b.axis * cos_axes) * (b.sin / sin_axes);
    let sum = edge_a + edge_b;
    let length = sum.length();
    if length < 1e-9 {
        return Normals::Any;
    }
    let axis = sum / length;
    let cos = axis.dot(edge_a).min(axis.dot(edge_b)).clamp(0.0, 1.0);
    Normals::Within(WideCone { axis, sin: (1.0 - cos * cos).sqrt(), cos })
}

/// What one surviving vertex carries for its forest subtree and the original faces around it.
#[derive(Clone, Debug)]
pub(crate) struct Carried {
    pub(crate) sphere: Sphere,
    pub(crate) normals: Normals,
    /// Last collapse that kept this vertex and its bounds as stored; [`NONE`] before the first.
    pub(crate) last: u32,
    pub(crate) stored: Bounds,
}

impl Carried {
    /// An original vertex, from itself and its neighbours and the unit normals of its faces.
    pub(crate) fn new(ring: &[DVec3], units: &[DVec3]) -> Self {
        let stored = Bounds { center: [0; 3], radius: Magnitude(0), error: Magnitude(0), cone: Cone::ANY };
        Self { sphere: Sphere::around(ring), normals: Normals::of_units(units), last: NONE, stored }
    }

    /// An original vertex, from two parts of its surroundings.
    pub(crate) fn joined(&self, other: &Self) -> Self {
        debug_assert!(self.last == NONE && other.last == NONE);
        let Sphere { center, radius } = self.sphere.union(other.sphere);
        let sphere = Sphere { center, radius: radius * ROUNDING };
        Self { sphere, normals: self.normals.union(other.normals), ..self.clone() }
    }

    /// Bounds of the last collapse, as stored.
    pub(crate) fn child(&self) -> Option<&Bounds> {
        (self.last != NONE).then_some(&self.stored)
    }

    /// Error of the last collapse, in lattice steps; 0 without one.
    pub(crate) fn error(&self) -> f64 {
        f64::from(self.stored.error.decode())
    }
}

/// Bounds of a collapse as stored: cover of the exact union and of the children's stored bounds.
///
/// `own` is its error in lattice steps before the maximum with the children's.
pub(crate) fn store(sphere: Sphere, normals: Normals, own: f64, children: &[Option<&Bounds>]) -> Bounds {
    let children = || children.iter().copied().flatten();
    let center = sphere.center.round();
    let reach =
        children().map(|child| child.reach_from(center)).fold(center.distance(sphere.center) + sphere.radius, f64::max);
    let error = children().map(|child| child.error).fold(Magnitude::encode_up(own), Magnitude::max);
    Bounds {
        center: center.to_array().map(|x| x as i32),
        radius: Magnitude::encode_up(reach),
        error,
        cone: store_cone(normals, children().map(|child| child.cone)),
    }
}

fn store_cone(normals: Normals, children: impl Iterator<Item = Cone>) -> Cone {
    let Normals::Within(exact) = normals else { return Cone::ANY };
    let mut parts = [exact; 3];
    let mut axes = [None; 2];
    let mut count = 1;
    for child in children.take(2) {
        let Some(wide) = child.wide() else { return Cone::ANY };
        parts[count] = wide;
        axes[count - 1] = Some(child.axis);
        count += 1;
    }
    let alone = Cone::cover(exact.axis, &parts[..1]);
    if count == 1 {
        return alone;
    }
    let mut best = Cone::cover_about(alone.axis, &parts[1..count]);
    if best.half_angle <= alone.half_angle {
        return alone;
    }
    // A child's rounding sticks out. About the child's own axis it may not, which is what keeps it from adding up.
    for axis in axes.into_iter().flatten() {
        let other = Cone::cover_about(axis, &parts[..count]);
        if other.half_angle < best.half_angle {
            best = other;
        }
    }
    best
}

/// Bounds of a whole component whose complete mesh lies in this box, as stored: they contain its root vertices, which may have
/// moved out of the box, and the bounds of their last collapses. They come with all normals of what became part of them. Its error is the diagonal of its box: without it, that much is missing.
pub(crate) fn whole_component(
    (low, high): (DVec3, DVec3),
    face_normals: &[DVec3],
    vertices: &[(DVec3, Normals, Option<Bounds>)],
) -> Bounds {
    let center = (low + high) * 0.5;
    let mut normals = Normals::Nothing;
    normals.add(face_normals);
    let mut radius = center.distance(high);
    for &(at, carried, _) in vertices {
        normals = normals.union(carried);
        radius = radius.max(center.distance(at));
    }
    let sphere = Sphere { center, radius };
    let mut bounds = store(sphere, normals, low.distance(high), &[]);
    for child in vertices.iter().filter_map(|(.., child)| child.as_ref()) {
        bounds.radius = bounds.radius.max(Magnitude::encode_up(child.reach_from(bounds.center_f64())));
        bounds.error = bounds.error.max(child.error);
        bounds.cone = match (bounds.cone.wide(), child.cone.wide()) {
            (Some(own), Some(part)) => Cone::cover_about(bounds.cone.axis, &[own, part]),
            _ => Cone::ANY,
        };
    }
    // Views stop judging spawns by their error alone, see `FORMAT.md`: large for its error, one would come too late.
    bounds.error = bounds.error.max(bounds.radius);
    bounds
}

/// Merges what `t` carries into what `s` carries. `ring` is the one-ring of `t` before the collapse, `normals` those of the
/// faces that change, before and after. Returns the exact union; the caller stores it with an error.
pub(crate) fn merge(s: &Carried, t: &Carried, ring: &[DVec3], normals: &[DVec3]) -> (Sphere, Normals) {
    let sphere = Sphere::around_spheres(s.sphere, t.sphere, ring);
    let mut cone = s.normals.union(t.normals);
    cone.add(normals);
    (sphere, cone)
}
