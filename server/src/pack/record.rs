//! The records of a vertex-split DAG as ingest makes them and a pack stores them.
//!
//! Op ids: spawns first, `0 .. spawns.len()`, by error descending; then splits, `spawns.len() ..`, such that an op's
//! forest parent always has the smaller id. All geometry is in lattice steps.

use glam::{DVec3, Vec3};
use lodestream_protocol::quant::Lattice;

/// Marks "no op" in id fields.
pub const NO_OP: u32 = u32::MAX;

/// Non-negative number in 16 bits: 5 bits of exponent, 11 of mantissa, ordered like the number itself. Zero is exact,
/// the smallest positive value is 2^-8, the largest just under 2^24; relative step 2^-11. Encoding rounds up, so bounds stay
/// bounds; `decode(encode_up(decode(q))) == decode(q)`, so carrying the maximum upwards adds nothing.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug, Default)]
#[repr(transparent)]
pub struct Magnitude(pub u16);

impl Magnitude {
    const BIAS: u32 = (127 - 8) << 11;

    /// Smallest representable value that is not below `x`. NaN and values over the range become the largest value.
    pub fn encode_up(x: f64) -> Self {
        if x <= 0.0 {
            return Self(0);
        }
        let f = x as f32;
        let f = if f64::from(f) < x { f32::from_bits(f.to_bits() + 1) } else { f };
        if f.is_nan() || f.is_infinite() {
            return Self(u16::MAX);
        }
        let top = f.to_bits().div_ceil(1 << 12);
        Self(top.saturating_sub(Self::BIAS).saturating_add(1).clamp(1, u32::from(u16::MAX)) as u16)
    }

    /// The number, in lattice steps.
    #[inline]
    pub fn decode(self) -> f32 {
        if self.0 == 0 { 0.0 } else { f32::from_bits((u32::from(self.0) - 1 + Self::BIAS) << 12) }
    }
}

/// Cone of normals: unit axis in octahedral mapping and half-angle.
///
/// `half_angle` codes `tan(angle / 2)` in steps of 1/254, rounded up, for angles up to 90 degrees; 255 means "any
/// direction", never culled.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Cone {
    /// Octahedral x and y, each mapped from -1..=1 to -127..=127.
    pub axis: [i8; 2],
    /// See the type.
    pub half_angle: u8,
}

impl Cone {
    /// The cone of all directions.
    pub const ANY: Self = Self { axis: [0, 0], half_angle: 255 };

    /// Largest stored half-angle that is not "any direction": 90 degrees.
    const MAX_CODE: u8 = 254;

    /// Unit axis, sine and cosine of the half-angle (0 to 90 degrees), or `None` for any direction. The stored angle already
    /// makes up for the rounding of the axis, so a test needs no slack beyond that of its own `f32` arithmetic.
    pub fn decode(self) -> Option<(Vec3, f32, f32)> {
        self.wide().map(|w| (w.axis.as_vec3(), w.sin as f32, w.cos as f32))
    }

    /// Like [`Cone::decode`] in `f64`: what covers and containment are computed with.
    pub fn wide(self) -> Option<WideCone> {
        if self.half_angle > Self::MAX_CODE {
            return None;
        }
        let q = f64::from(self.half_angle) / f64::from(Self::MAX_CODE);
        let axis = octahedral_axis(self.axis);
        Some(WideCone { axis, sin: 2.0 * q / (1.0 + q * q), cos: (1.0 - q * q) / (1.0 + q * q) })
    }

    /// Whether every direction of `other` is in this cone, as decoded.
    pub fn contains(self, other: Self) -> bool {
        let Some(outer) = self.wide() else { return true };
        other.wide().is_some_and(|inner| angle_code(outer.axis, &inner) <= f64::from(self.half_angle))
    }

    /// The cone about `axis` (unit length; rounded first) that contains all `parts`, as decoded. [`Cone::ANY`] when that takes
    /// more than 90 degrees.
    pub fn cover(axis: DVec3, parts: &[WideCone]) -> Self {
        Self::cover_about(octahedral_code(axis), parts)
    }

    /// [`Cone::cover`] about an axis that is rounded already.
    pub fn cover_about(axis: [i8; 2], parts: &[WideCone]) -> Self {
        let center = octahedral_axis(axis);
        let code = parts.iter().map(|part| angle_code(center, part)).fold(0.0, f64::max);
        if code > f64::from(Self::MAX_CODE) {
            return Self::ANY;
        }
        Self { axis, half_angle: code.ceil() as u8 }
    }
}

/// A cone of directions in `f64`: unit axis and half-angle of 0 to 90 degrees.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct WideCone {
    /// Unit axis.
    pub axis: DVec3,
    /// Sine of the half-angle.
    pub sin: f64,
    /// Cosine of the half-angle.
    pub cos: f64,
}

/// `254 tan(a / 2)` for the angle `a` between `axis` and the far side of `part`, lowered by 1e-9 so that a cone about an axis
/// that is already rounded gets back its own code; infinite over 90 degrees. Addition formulas and the half-angle formula
/// `tan(a / 2) = sin a / (1 + cos a)`: no trigonometric function, so the result is the same everywhere.
fn angle_code(axis: DVec3, part: &WideCone) -> f64 {
    let (sin_axes, cos_axes) = (axis.cross(part.axis).length(), axis.dot(part.axis));
    let sin = sin_axes * part.cos + cos_axes * part.sin;
    let cos = cos_axes * part.cos - sin_axes * part.sin;
    if cos < -1e-12 || sin < -1e-12 {
        return f64::INFINITY;
    }
    254.0 * (sin / (1.0 + cos)) - 1e-9
}

/// Unit vector of an octahedral code.
fn octahedral_axis(code: [i8; 2]) -> DVec3 {
    let (x, y) = (f64::from(code[0]) / 127.0, f64::from(code[1]) / 127.0);
    let z = 1.0 - x.abs() - y.abs();
    let v = if z >= 0.0 {
        DVec3::new(x, y, z)
    } else {
        DVec3::new((1.0 - y.abs()) * sign(x), (1.0 - x.abs()) * sign(y), z)
    };
    v / v.length()
}

/// Nearest octahedral code of a direction that is not zero.
fn octahedral_code(v: DVec3) -> [i8; 2] {
    let p = v / (v.x.abs() + v.y.abs() + v.z.abs());
    let (x, y) = if p.z >= 0.0 { (p.x, p.y) } else { ((1.0 - p.y.abs()) * sign(p.x), (1.0 - p.x.abs()) * sign(p.y)) };
    [(x * 127.0).round() as i8, (y * 127.0).round() as i8]
}

fn sign(x: f64) -> f64 {
    if x < 0.0 { -1.0 } else { 1.0 }
}

/// Visibility sphere of an op: everything that the op and its forest descendants touch (Southern 2001, section 5.1.1;
/// union over the vertex forest instead of the DAG).
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Bounds {
    /// Centre, in lattice steps.
    pub center: [i32; 3],
    /// Radius, in lattice steps.
    pub radius: Magnitude,
    /// Deviation from the complete surface while the op is not applied, in lattice steps.
    pub error: Magnitude,
    /// Normals involved.
    pub cone: Cone,
}

impl Bounds {
    /// The centre as a vector.
    pub fn center_f64(&self) -> DVec3 {
        DVec3::from_array(self.center.map(f64::from))
    }

    /// Radius that a sphere about `center` needs to contain the decoded sphere of `self`.
    pub fn reach_from(&self, center: DVec3) -> f64 {
        center.distance(self.center_f64()) + f64::from(self.radius.decode())
    }

    /// Whether sphere, error and cone of `child` are within this one's, all as decoded: what holds along every edge of the
    /// vertex forest.
    pub fn contains(&self, child: &Self) -> bool {
        child.reach_from(self.center_f64()) <= f64::from(self.radius.decode())
            && child.error <= self.error
            && self.cone.contains(child.cone)
    }
}

/// Where one side of a split's cut lies: an edge of `s` found through the younger of the two faces beside it.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum CutRef {
    /// The split inserts no face on this side (boundary).
    None,
    /// Edge `edge` (from corner `edge` to corner `edge + 1`) of the face that split `op` inserted: `f_l` for side 0, `f_r`
    /// for side 1. `f_l = (s, t, l)` and `f_r = (t, s, r)` in that corner order.
    Split {
        /// The split that owns the face.
        op: u32,
        /// 0 for `f_l`, 1 for `f_r`.
        side: u8,
        /// 0, 1 or 2.
        edge: u8,
    },
    /// Edge `edge` of a root face. Root faces are numbered through: the base's faces, then those of each spawn in order.
    Root {
        /// Number of the root face.
        face: u32,
        /// 0, 1 or 2.
        edge: u8,
    },
}

/// One vertex split.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct SplitRecord {
    /// Visibility sphere over the op's forest subtree.
    pub bounds: Bounds,
    /// The last op on `s` before this one (its creation or last earlier split), or [`NO_OP`] for a base vertex's first.
    pub tree_parent: u32,
    /// Root vertex number of `s` when the tree parent is not a split (base vertices, then those of each spawn in order);
    /// otherwise whether `s` is the kept (`0`) or the inserted (`1`) vertex of the tree parent.
    pub s: u32,
    /// Left cut edge. Together with `right` and `tree_parent` these name all parents of the op (at most three).
    pub left: CutRef,
    /// Right cut edge.
    pub right: CutRef,
    /// Next split of `s` after this one, or [`NO_OP`].
    pub next_of_s: u32,
    /// First split of `t`, or [`NO_OP`].
    pub first_of_t: u32,
    /// Position of the inserted vertex `t`.
    pub position: [i32; 3],
    /// Colour of `t` (zero for models without colours).
    pub color: [u8; 3],
    /// Displacement of `s` when the placement moves it, else zero.
    pub s_move: [i32; 3],
    /// Colour change of `s`, per channel, modulo 256, else zero.
    pub s_color_move: [u8; 3],
    /// Under the rule of vertices, the last ops before this one on `l`, `r` and the far corners of `fn0 .. fn3`, or [`NO_OP`]:
    /// what a view takes in with this op beside its parents. All [`NO_OP`] under the rule of faces.
    pub vertex_ops: [u32; VERTEX_OPS],
}

/// Vertices besides `s` in the faces around a split's cut edges: `l`, `r` and four far corners (Southern 2001, figure 5.3).
pub const VERTEX_OPS: usize = 6;

/// Vertices and faces that exist without any split: the base mesh, or what one spawn inserts.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Patch {
    /// Lattice positions.
    pub positions: Vec<[i32; 3]>,
    /// Colours, `len == positions.len()` (zeros for models without colours).
    pub colors: Vec<[u8; 3]>,
    /// Corner indices into `positions`. The patch is an oriented manifold, possibly with boundary.
    pub faces: Vec<[u32; 3]>,
    /// First split of each vertex, or [`NO_OP`].
    pub first_splits: Vec<u32>,
}

/// A component that appears and vanishes as a whole.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct SpawnRecord {
    /// Visibility sphere over the whole component; the error is at least the component's diameter.
    pub bounds: Bounds,
    /// What the spawn inserts.
    pub patch: Patch,
}

/// A whole vertex-split DAG in memory: what ingest builds and [`write`](super::write) stores.
#[derive(Clone, PartialEq, Debug)]
pub struct Dag {
    /// The lattice of all positions.
    pub lattice: Lattice,
    /// Whether colours mean anything.
    pub has_colors: bool,
    /// Whether facing-away tests would open holes: the surface has so much boundary that its inside can be seen.
    pub is_open: bool,
    /// Whether ops wait for all vertices of the faces around their cut instead of for those faces alone.
    pub by_vertices: bool,
    /// What a client holds before any op.
    pub base: Patch,
    /// Ops `0 .. spawns.len()`.
    pub spawns: Vec<SpawnRecord>,
    /// Ops `spawns.len() ..`.
    pub splits: Vec<SplitRecord>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn magnitude_rounds_up_and_is_idempotent() {
        for x in [1e-9, 0.003, 0.5, 1.0, 1.0001, 777.7, 1e6] {
            let m = Magnitude::encode_up(x);
            assert!(f64::from(m.decode()) >= x);
            assert!(f64::from(m.decode()) <= x * (1.0 + 1.0 / 2048.0) + 1.0 / 256.0);
            assert_eq!(Magnitude::encode_up(f64::from(m.decode())), m);
        }
        assert_eq!(Magnitude::encode_up(0.0).decode(), 0.0);
    }

    #[test]
    fn covering_cone_contains_its_parts_and_itself() {
        let mut rng = fastrand::Rng::with_seed(7);
        let mut unit = || loop {
            let v = DVec3::new(rng.f64() - 0.5, rng.f64() - 0.5, rng.f64() - 0.5);
            if v.length() > 0.05 {
                return v / v.length();
            }
        };
        for _ in 0..2000 {
            let parts: Vec<_> = (0..3).map(|_| Cone { axis: octahedral_code(unit()), half_angle: 40 }).collect();
            let wide: Vec<_> = parts.iter().map(|c| c.wide().unwrap()).collect();
            let sum: DVec3 = wide.iter().map(|w| w.axis).sum();
            let cover = Cone::cover(sum / sum.length(), &wide);
            assert!(parts.iter().all(|&p| cover.contains(p)));
            assert!(cover.contains(cover));
            if let Some(w) = cover.wide() {
                assert_eq!(Cone::cover_about(cover.axis, &[w]), cover, "covering twice adds nothing");
            }
        }
        assert!(Cone::ANY.contains(Cone { axis: [3, -127], half_angle: 254 }));
        assert!(!Cone { axis: [3, -127], half_angle: 254 }.contains(Cone::ANY));
    }
}
