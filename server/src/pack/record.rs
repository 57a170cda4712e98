//! The records of a vertex-split DAG as ingest makes them and a pack stores them.
//!
//! Op ids: spawns first, `0 .. spawns.len()`, by error descending; then splits, `spawns.len() ..`, such that an op's
//! forest parent always has the smaller id. All geometry is in lattice steps.

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
}

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
    /// What a client holds before any op.
    pub base: Patch,
    /// Ops `0 .. spawns.len()`.
    pub spawns: Vec<SpawnRecord>,
    /// Ops `spawns.len() ..`.
    pub splits: Vec<SplitRecord>,
}
