//! Coding of what a split inserts: position and colour of the new vertex, and what it does to `s`.
//!
//! Integers only. The position is coded as a residual against a prediction from the one-ring: first the two coordinates
//! across the fan's dominant normal axis, then the third against the plane that the fan's normal spans. How large the
//! residuals will be is predicted as well, since most of their cost is their size.

use super::color::{ColorModels, Share};
use super::fixed::{lg, reciprocal};
use super::local::Ring;
use super::observe::{Note, Part};
use super::range_coder::{BitCoder, NumberModel, Prob, ScaledSet, contexts};
use super::steps::{Grid, StepModels};
use super::trained::{CUT_SHAPES, SizeWeights, Trained};
use crate::mesh::{Cut, Fan, NewVertex};

/// Adaptive contexts for the payload of splits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct GeometryModels {
    across: ScaledSet,
    along: ScaledSet,
    height: ScaledSet,
    escape: NumberModel,
    color: ColorModels,
    moves: MoveModels,
}

contexts!(GeometryModels: across, along, height, escape, color, moves);

/// Adaptive contexts for how far a split moves `s`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct MoveModels {
    stays: Prob,
    /// Of those that move, whether `s` was in the middle.
    in_middle: Prob,
    parity: Prob,
    across: ScaledSet,
    along: ScaledSet,
    height: ScaledSet,
    escape: NumberModel,
}

contexts!(MoveModels: stays, in_middle, parity, across, along, height, escape);

impl GeometryModels {
    pub(crate) const NEW: Self = Self {
        across: ScaledSet::NEW,
        along: ScaledSet::NEW,
        height: ScaledSet::NEW,
        escape: NumberModel::NEW,
        color: ColorModels::NEW,
        moves: MoveModels {
            stays: Prob::HALF,
            in_middle: Prob::HALF,
            parity: Prob::HALF,
            across: ScaledSet::NEW,
            along: ScaledSet::NEW,
            height: ScaledSet::NEW,
            escape: NumberModel::NEW,
        },
    };

    /// Codes the vertex that `cut` inserts into `s`'s fan, whose ring is `ring`. `colors` are the replica's by slot.
    #[allow(clippy::too_many_arguments)]
    pub(crate) fn vertex(
        &mut self,
        coder: &mut impl BitCoder,
        trained: &Trained,
        s: u32,
        fan: &Fan,
        ring: &Ring,
        cut: Cut,
        colors: Option<&[[u8; 3]]>,
        moves: bool,
        coarse: Option<(&mut StepModels, i32)>,
        value: &NewVertex,
    ) -> NewVertex {
        let prediction = Prediction::new(trained, fan, ring, cut);
        let Self { across, along, height, escape, .. } = self;
        let mut out = NewVertex::default();
        let mut axes = ring.axes;
        let residual = |k: usize, predicted: i32| value.position[k].wrapping_sub(predicted);
        let mut grid = Grid { axes, unit: 1 };
        let mut sets = (across, along, &mut *escape);
        if let Some((models, step)) = coarse {
            grid = models.grid(coder, step, fan.is_closed(), ring, value.position);
            if grid.unit > 1 {
                sets = (&mut models.across, &mut models.along, &mut models.escape);
            }
        }
        let size = prediction.tangent_size - lg(grid.unit as u64);
        axes = grid.axes;
        let [u, v, h] = axes;
        let mut place = |set: &mut ScaledSet, k: usize| {
            let (mut near, mut wanted) = (prediction.point[k], value.position[k]);
            if grid.unit > 1 {
                (near, wanted) = (near.wrapping_add(grid.unit / 2).div_euclid(grid.unit), wanted / grid.unit);
            }
            let away = set.signed(coder, sets.2, size, wanted.wrapping_sub(near));
            out.position[k] = near.wrapping_add(away).wrapping_mul(grid.unit);
            out.position[k].wrapping_sub(prediction.point[k])
        };
        let du = place(sets.0, u);
        let dv = place(sets.1, v);
        let level = prediction.point[h].wrapping_sub(fall(ring, axes, du, dv));
        let dh = height.signed(coder, escape, prediction.height_size, residual(h, level));
        out.position[h] = level.wrapping_add(dh);
        coder.note(Note::Spent(Part::Position));
        if let Some(colors) = colors {
            out.color = self.color.vertex(coder, s, fan, cut, colors, value.color);
            coder.note(Note::Spent(Part::Color));
        }
        if moves {
            out.s_move = self.moves.code(coder, &prediction, ring, out.position, value.s_move);
            coder.note(Note::Spent(Part::Position));
            if let Some(colors) = colors {
                let share = Share::new(out.s_move, ring.origin, out.position);
                out.s_color_move = self.color.moved(coder, &share, colors[s as usize], out.color, value.s_color_move);
                coder.note(Note::Spent(Part::Color));
            }
        }
        out
    }
}

impl MoveModels {
    /// Codes what a split adds to the position of `s` when the new vertex is at `t`.
    fn code(
        &mut self,
        coder: &mut impl BitCoder,
        prediction: &Prediction,
        ring: &Ring,
        t: [i32; 3],
        value: [i32; 3],
    ) -> [i32; 3] {
        let before = ring.origin;
        if coder.bit(&mut self.stays, value == [0; 3]) {
            return [0; 3];
        }
        // On the other side of `before` from `t`.
        let mirrored: [i32; 3] = std::array::from_fn(|k| before[k].wrapping_sub(t[k]));
        // A middle between lattice points is rounded up where `t` is odd and down where it is even.
        let rounding = t.map(|c| if c & 1 == 1 { -1 } else { 1 });
        let residual: [i32; 3] = std::array::from_fn(|k| value[k].wrapping_sub(mirrored[k]));
        let in_middle = (0..3).all(|k| residual[k] == 0 || residual[k] == rounding[k]);
        if coder.bit(&mut self.in_middle, in_middle) {
            return std::array::from_fn(|k| {
                let is_rounded = coder.bit(&mut self.parity, residual[k] != 0);
                mirrored[k].wrapping_add(if is_rounded { rounding[k] } else { 0 })
            });
        }
        let [u, v, h] = ring.axes;
        let mut out = [0; 3];
        // It has moved less than `t` has: between not at all and as far.
        let halfway = mirrored.map(|d| d / 2);
        let residual = |k: usize| value[k].wrapping_sub(halfway[k]);
        let (escape, size) = (&mut self.escape, prediction.tangent_size);
        out[u] = halfway[u].wrapping_add(self.across.signed(coder, escape, size, residual(u)));
        out[v] = halfway[v].wrapping_add(self.along.signed(coder, escape, size, residual(v)));
        // As far from the fan's plane through `before` as `t` is, on the same side.
        let drop = t[h].wrapping_sub(before[h]).wrapping_add(fall(
            ring,
            ring.axes,
            t[u].wrapping_sub(before[u]),
            t[v].wrapping_sub(before[v]),
        ));
        let height = drop.wrapping_sub(fall(ring, ring.axes, out[u], out[v]));
        let coded = self.height.signed(coder, escape, prediction.height_size, value[h].wrapping_sub(height));
        out[h] = height.wrapping_add(coded);
        out
    }
}

/// What the expected size of a residual follows from, as logarithms in 1/32 octave.
pub type SizeFeatures = [i32; 6];

/// What the ring says about the new vertex.
#[derive(Clone, Debug)]
struct Prediction {
    point: [i32; 3],
    /// Expected size of residuals across the normal and along it, in 1/16 octave.
    tangent_size: i32,
    height_size: i32,
}

/// The ring in parts, as a cut divides it: what prediction is made of.
#[derive(Clone, Debug)]
pub struct GeometryFeatures {
    /// Shape of the cut.
    pub shape: usize,
    /// Sums of the spokes inside the arc (of left and right where there are none), of left and right, of the other spokes, and
    /// of all; relative to `s`.
    pub sums: [[i64; 3]; 4],
    /// Of how many spokes each is the sum.
    pub counts: [usize; 4],
    /// What the sizes of tangential residuals follow from.
    pub tangent: SizeFeatures,
    /// What the sizes of residuals along the normal follow from.
    pub height: SizeFeatures,
}

impl GeometryFeatures {
    #[inline]
    pub(crate) fn new(fan: &Fan, ring: &Ring, cut: Cut) -> Self {
        let spokes = ring.count();
        let arc = fan.arc_len(cut) as usize;
        // The spokes inside the arc, and those that the cut opens.
        let (first, inner, ends) = match cut {
            Cut::Both { right, left } => (right as usize + 1, arc.saturating_sub(1), [Some(right), Some(left)]),
            Cut::Left { left } => (0, arc, [None, Some(left)]),
            Cut::Right { right } => (right as usize + 1, arc, [Some(right), None]),
        };
        let mut inside = [0; 3];
        let mut at = if first >= spokes { 0 } else { first };
        for _ in 0..inner.min(spokes) {
            inside = add(inside, ring.spoke_at(at));
            at = if at + 1 == spokes { 0 } else { at + 1 };
        }
        let mut opened = [0; 3];
        let mut count = 0;
        for spoke in ends.into_iter().flatten() {
            opened = add(opened, ring.spoke_at(spoke as usize));
            count += 1;
        }
        let (arc_sum, arc_count) = if inner == 0 { (opened, count) } else { (inside, inner) };
        let rest: [i64; 3] = std::array::from_fn(|k| ring.sum[k] - inside[k] - opened[k]);
        let scaled = |spoke: Option<u32>| spoke.map_or([0; 3], |spoke| ring.scaled_spoke_at(spoke as usize));
        let (a, b) = (scaled(ends[0]), scaled(ends[1]));
        let span: [i64; 3] = std::array::from_fn(|k| i64::from(a[k] - b[k]));
        let span = lg_of_square(span) + ring.unscaled();
        let arc_length = lg_of_square(arc_sum) - 2 * lg(arc_count as u64);
        let normal = lg_of_square(ring.normal.map(i64::from));
        let roughness = 2 * (lg(ring.heights()) - lg(spokes as u64)) - normal + ring.unscaled();
        let area = lg(ring.area) + ring.unscaled();
        let shape = arc.clamp(1, 6) - 1 + if fan.is_closed() { 0 } else { 6 };
        Self {
            shape,
            sums: [arc_sum, opened, rest, ring.sum],
            counts: [arc_count, count, spokes.saturating_sub(inner + count), spokes],
            tangent: [ring.spoke, ring.shortest, span, arc_length, ring.edge, area],
            height: [ring.spoke, roughness, span, arc_length, ring.edge, area],
        }
    }
}

fn add(a: [i64; 3], b: [i32; 3]) -> [i64; 3] {
    std::array::from_fn(|k| a[k] + i64::from(b[k]))
}

/// `lg` of a vector's squared length, which does not overflow unless hundreds of the longest spokes are summed up.
fn lg_of_square(a: [i64; 3]) -> i32 {
    lg(a.iter().fold(0, |sum: i64, x| sum.wrapping_add(x.wrapping_mul(*x))) as u64)
}

impl SizeWeights {
    fn size(&self, shape: usize, features: &SizeFeatures) -> i32 {
        let sum: i32 = self.features.iter().zip(features).map(|(weight, feature)| weight * feature).sum();
        self.constant[shape] + (sum >> 9)
    }
}

impl Prediction {
    #[inline]
    fn new(trained: &Trained, fan: &Fan, ring: &Ring, cut: Cut) -> Self {
        let GeometryFeatures { shape, sums, counts, tangent, height } = GeometryFeatures::new(fan, ring, cut);
        // Weights in 1/256 by reciprocals in 1/65536.
        let weights: [i64; 4] =
            std::array::from_fn(|i| i64::from(trained.position[shape][i]) * i64::from(reciprocal(counts[i])));
        let point = std::array::from_fn(|k| {
            let sum = (0..4).fold(1 << 23, |sum: i64, i| sum.wrapping_add(weights[i].wrapping_mul(sums[i][k])));
            ring.origin[k].wrapping_add((sum >> 24) as i32)
        });
        Self {
            point,
            tangent_size: trained.tangent_size.size(shape, &tangent),
            height_size: trained.height_size.size(shape, &height),
        }
    }
}

/// How far the fan's plane falls along the third axis over a step along the first two, towards zero.
fn fall(ring: &Ring, [u, v, h]: [usize; 3], du: i32, dv: i32) -> i32 {
    let [along_u, along_v, down] = [u, v, h].map(|axis| i64::from(ring.normal[axis]));
    if down == 0 {
        return 0;
    }
    // The decoder may see residuals of any size; an honest encoder's fit 22 bits.
    let clamp = |d: i32| i64::from(d.clamp(-(1 << 22), 1 << 22));
    let slope = along_u * clamp(du) + along_v * clamp(dv);
    // A division of small numbers without signs is the fastest.
    let magnitude = (slope.unsigned_abs() / down.unsigned_abs()).min(1 << 23) as i32;
    if (slope < 0) == (down < 0) { magnitude } else { -magnitude }
}

const _: () = assert!(CUT_SHAPES == 12);
