//! The cost of an edge, by the planes of the faces at its ends, and error quadrics (Garland and Heckbert 1997), which remember
//! the complete mesh.

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use super::surface::{Surface, next, prev};
use crate::ingest::hierarchy::Point;

/// Weight of a boundary constraint plane, times the squared length of the boundary edge.
const BOUNDARY_WEIGHT: f64 = 3.0;
/// The same for the planes that collapses are chosen by, which do not add up.
const BORDER_WEIGHT: f64 = 1.0;
/// Deviation, as a share of the edge's length, that a full-scale colour difference across it counts for in the order.
const COLOR_WEIGHT: f64 = 0.25;
/// Tie-break per squared length, so that flat regions lose their short edges first.
const TIE_BREAK: f64 = 1e-12;

/// Weighted sum of squared distances to planes, as a function of the offset from the vertex that carries it.
///
/// Relative to the vertex, because the constant term of an absolute quadric on a 21-bit lattice cancels catastrophically. It
/// also makes evaluation at the vertex itself a single read, and half-edge collapses evaluate nowhere else.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct Quadric {
    /// Upper triangle of the matrix: xx, xy, xz, yy, yz, zz.
    a: [f64; 6],
    b: DVec3,
    /// Value at the vertex itself, in lattice steps to the fourth.
    pub(crate) c: f64,
    /// Sum of the weights, in squared lattice steps.
    pub(crate) weight: f64,
}

impl Quadric {
    /// Adds a plane through the vertex.
    fn add_plane(&mut self, unit: DVec3, weight: f64) {
        let n = unit * weight;
        let terms = [n.x * unit.x, n.x * unit.y, n.x * unit.z, n.y * unit.y, n.y * unit.z, n.z * unit.z];
        for (a, term) in self.a.iter_mut().zip(terms) {
            *a += term;
        }
        self.weight += weight;
    }

    /// Value at offset `d` from the vertex. Not negative: rounding may say so, but sums of squares are not.
    #[inline]
    pub(crate) fn at(&self, d: DVec3) -> f64 {
        ((apply(&self.a, d) + 2.0 * self.b).dot(d) + self.c).max(0.0)
    }

    /// Adds `other`, carried by the vertex at offset `-d` from this one's.
    #[inline]
    pub(crate) fn absorb(&mut self, other: &Self, d: DVec3) {
        self.c += other.at(d);
        self.b += other.b + apply(&other.a, d);
        for (a, term) in self.a.iter_mut().zip(other.a) {
            *a += term;
        }
        self.weight += other.weight;
    }

    /// Carries it by the vertex at offset `d` instead.
    pub(crate) fn carry(&mut self, d: DVec3) {
        self.c = self.at(d);
        self.b += apply(&self.a, d);
    }

    /// RMS distance of the vertex to the planes, in lattice steps.
    pub(crate) fn rms(&self) -> f64 {
        if self.weight > 0.0 { (self.c / self.weight).max(0.0).sqrt() } else { 0.0 }
    }
}

/// The quadrics of the faces of an original mesh: each gives a third of its area to each corner. O(faces).
pub(crate) fn of_faces(surface: &Surface, points: &[Point]) -> Vec<Quadric> {
    let mut quadrics = vec![Quadric::default(); surface.vertex_count()];
    for face in 0..surface.face_count() as u32 {
        let corners = surface.corners(face);
        let [a, b, c] = corners.map(|v| points[v as usize].at());
        let normal = (b - a).cross(c - a);
        let length = normal.length();
        if length > 0.0 {
            for v in corners {
                quadrics[v as usize].add_plane(normal / length, length / 6.0);
            }
        }
    }
    quadrics
}

/// Adds borders of the original mesh: each boundary edge gives a plane at right angles to its face to both ends, if `is_border`
/// says so of them. O(faces).
pub(crate) fn add_borders(
    quadrics: &mut [Quadric],
    surface: &Surface,
    points: &[Point],
    is_border: impl Fn(u32, u32) -> bool,
) {
    for h in 0..3 * surface.face_count() as u32 {
        if surface.twin(h).is_some() {
            continue;
        }
        let ends = [surface.origin(h), surface.target(h)];
        if !is_border(ends[0], ends[1]) {
            continue;
        }
        let [a, b, c] = surface.corners(h / 3).map(|v| points[v as usize].at());
        let normal = (b - a).cross(c - a);
        let along = points[ends[1] as usize].at() - points[ends[0] as usize].at();
        let side = along.cross(normal);
        let length = side.length();
        if length > 0.0 {
            for v in ends {
                quadrics[v as usize].add_plane(side / length, BOUNDARY_WEIGHT * along.length_squared());
            }
        }
    }
}

/// The planes of the faces around a vertex as the mesh now is, weighted: the squared distances to them that collapses are
/// chosen by. What was there before is forgotten (Lindstrom and Turk 1998: "memoryless"), which keeps the mean distance
/// lower than accumulated quadrics do, at the same number of triangles; [`Quadric`] remembers, for the error.
///
/// All the planes go through the vertex, so that a matrix is all there is. Their weights are areas to the power 3/2: halfway from
/// the squared distance over an area to the squared volume, which Lindstrom and Turk take and which lets thin parts go too soon.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Planes {
    /// Upper triangle of the matrix: xx, xy, xz, yy, yz, zz.
    a: [f64; 6],
    /// Sum of the weights, in lattice steps to the third.
    pub(crate) weight: f64,
}

impl Planes {
    /// Those around `v`. O(valence).
    pub(crate) fn around(surface: &Surface, points: &[Point], v: u32) -> Self {
        let mut planes = Self::default();
        let at = |v: u32| points[v as usize].at();
        for h in surface.spokes(v) {
            let (x, y) = others(surface, h);
            let normal = (at(x) - at(v)).cross(at(y) - at(v));
            planes.add(&Self::of_face(normal));
            for (h, from, to) in [(h, v, x), (prev(h), y, v)] {
                if surface.twin(h).is_none() {
                    planes.add_border(normal, at(to) - at(from));
                }
            }
        }
        planes
    }

    /// A face with this normal, twice its area long: a third of the area.
    #[inline]
    pub(crate) fn of_face(normal: DVec3) -> Self {
        let length_squared = normal.length_squared();
        if length_squared > 0.0 {
            let area = length_squared.sqrt() / 6.0;
            Self::of_plane(normal, weight_of(area), length_squared)
        } else {
            Self::default()
        }
    }

    fn of_plane(n: DVec3, weight: f64, length_squared: f64) -> Self {
        let m = n * (weight / length_squared);
        Self { a: [m.x * n.x, m.x * n.y, m.x * n.z, m.y * n.y, m.y * n.z, m.z * n.z], weight }
    }

    /// Adds others at the same vertex.
    #[inline]
    pub(crate) fn add(&mut self, other: &Self) {
        for (a, term) in self.a.iter_mut().zip(other.a) {
            *a += term;
        }
        self.weight += other.weight;
    }

    /// Takes out what was added. Rounding leaves next to nothing, and what is left may be negative.
    #[inline]
    pub(crate) fn remove(&mut self, other: &Self) {
        for (a, term) in self.a.iter_mut().zip(other.a) {
            *a -= term;
        }
        self.weight = (self.weight - other.weight).max(0.0);
    }

    /// Adds the plane at right angles to a face through its border edge.
    fn add_border(&mut self, normal: DVec3, along: DVec3) {
        let side = along.cross(normal);
        let length_squared = side.length_squared();
        if length_squared > 0.0 {
            let weight = weight_of(BORDER_WEIGHT * along.length_squared());
            self.add(&Self::of_plane(side, weight, length_squared));
        }
    }

    /// Value at offset `d` from the vertex, in lattice steps to the fifth.
    #[inline]
    pub(crate) fn at(&self, d: DVec3) -> f64 {
        apply(&self.a, d).dot(d).max(0.0)
    }
}

#[inline]
fn weight_of(area: f64) -> f64 {
    area * area.sqrt()
}

#[inline]
fn apply([xx, xy, xz, yy, yz, zz]: &[f64; 6], d: DVec3) -> DVec3 {
    DVec3::new(xx * d.x + xy * d.y + xz * d.z, xy * d.x + yy * d.y + yz * d.z, xz * d.x + yz * d.y + zz * d.z)
}

/// The sum of the planes around both ends of an edge, and of a pull towards a place that keeps its minimum well conditioned.
pub(crate) struct Minimum {
    columns: [DVec3; 3],
    determinant: f64,
    /// Gradient, halved, at the place.
    gradient: DVec3,
}

impl Minimum {
    /// `pull` is a share of the planes' weight. `None` if there is next to no weight.
    pub(crate) fn new(planes: [&Planes; 2], ends: [DVec3; 2], place: DVec3, pull: f64) -> Option<Self> {
        let [a, b] = planes;
        let weight = (a.weight + b.weight) * pull;
        let [xx, xy, xz, yy, yz, zz]: [f64; 6] = std::array::from_fn(|k| a.a[k] + b.a[k]);
        let (xx, yy, zz) = (xx + weight, yy + weight, zz + weight);
        let columns = [DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz)];
        let determinant = columns[0].dot(columns[1].cross(columns[2]));
        // At least (pull x weight)^3 but for rounding.
        let gradient = apply(&a.a, place - ends[0]) + apply(&b.a, place - ends[1]);
        (determinant > 0.5 * weight * weight * weight).then_some(Self { columns, determinant, gradient })
    }

    /// Solution of `M x = g`, by Cramer's rule.
    fn solve(&self, g: DVec3) -> DVec3 {
        let [x, y, z] = self.columns;
        DVec3::new(g.dot(y.cross(z)), x.dot(g.cross(z)), x.dot(y.cross(g))) / self.determinant
    }

    /// Offset of the minimum from the place.
    pub(crate) fn offset(&self) -> DVec3 {
        self.solve(-self.gradient)
    }

    /// Offset to the cheapest point of the plane `normal . x = height`, from a minimum at offset 0.
    pub(crate) fn offset_onto(&self, normal: DVec3, height: f64) -> Option<DVec3> {
        let x = self.solve(normal);
        let scale = normal.dot(x);
        (scale > 0.0).then(|| x * (height / scale))
    }
}

/// Costs of an edge in both directions: keeping `a`, and keeping `b`; in lattice steps to the fifth (squared distance times
/// weight). Each is the value at the kept vertex of the planes around the other, and what [`along`] adds for its weight.
#[inline]
pub(crate) fn costs(a: &Point, planes_a: &Planes, b: &Point, planes_b: &Planes) -> [f64; 2] {
    let d = b.at() - a.at();
    let length_squared = d.length_squared();
    let color = color_weight(a.color, b.color);
    [(planes_b, -d), (planes_a, d)].map(|(gone, d)| gone.at(d) + along(length_squared, color, gone.weight))
}

/// Squared deviation, as a share of the edge's squared length, that a change from one colour to the other counts for.
#[inline]
pub(crate) fn color_weight(a: [u8; 3], b: [u8; 3]) -> f64 {
    color_distance_squared(a, b) * (COLOR_WEIGHT * COLOR_WEIGHT)
}

/// What an edge adds to the planes' value: colour that changes over an area of this weight, and the tie-break.
#[inline]
pub(crate) fn along(length_squared: f64, color: f64, weight: f64) -> f64 {
    length_squared * (color * weight + TIE_BREAK)
}

/// Squared Euclidean distance of two colours, as a share of full scale (black to white is 1).
#[inline]
pub(crate) fn color_distance_squared(a: [u8; 3], b: [u8; 3]) -> f64 {
    let d = |k: usize| {
        let d = i32::from(a[k]) - i32::from(b[k]);
        d * d
    };
    f64::from(d(0) + d(1) + d(2)) / (3.0 * 255.0 * 255.0)
}

/// Share of an edge's length that the worst sliver counts for as a deviation.
const SLIVER_WEIGHT: f64 = 0.1;
/// Height over longest edge below which a triangle counts as a sliver.
const SLIVER_HEIGHT: f64 = 0.05;

/// What to add to the cost when collapsing `t` onto `s` makes a face thinner that is thin then: the deviation that would make
/// as much harm, squared, times the weight at the vertex that moves. `before` and `after` are (normal, squared longest edge) of an arc face.
#[inline]
pub(crate) fn sliver(before: (DVec3, f64), after: (DVec3, f64), length_squared: f64, weight: f64) -> f64 {
    // Height over longest edge is |n| / edge^2; compared squared, so that the common case takes no root.
    let limit = SLIVER_HEIGHT * SLIVER_HEIGHT * after.1 * after.1;
    let area_squared = after.0.length_squared();
    if area_squared >= limit || area_squared * before.1 * before.1 >= before.0.length_squared() * after.1 * after.1 {
        return 0.0;
    }
    let thinness = 1.0 - (area_squared / limit).sqrt();
    SLIVER_WEIGHT * SLIVER_WEIGHT * thinness * thinness * length_squared * weight
}

/// Normal (twice the area long) and squared longest edge of a triangle.
#[inline]
pub(crate) fn shape(a: DVec3, b: DVec3, c: DVec3) -> (DVec3, f64) {
    let (ab, ac) = (b - a, c - a);
    (ab.cross(ac), ab.length_squared().max(ac.length_squared()).max(b.distance_squared(c)))
}

/// The two other corners of the face of a spoke.
#[inline]
pub(crate) fn others(surface: &Surface, spoke: u32) -> (u32, u32) {
    (surface.origin(next(spoke)), surface.origin(prev(spoke)))
}
