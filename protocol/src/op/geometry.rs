//! Coding of what a split inserts: position and colour of the new vertex, and what it does to `s`.
//!
//! Integers only. The position is coded as a residual against a prediction from the one-ring: first the two coordinates
//! across the fan's dominant normal axis, then the third against the plane that the fan's normal spans. How large the
//! residuals will be is predicted as well, since most of their cost is their size.

use super::color::{ColorModels, Share};
use super::fixed::{lg, mean};
use super::local::{Ring, dot};
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
            let near = prediction.point[k].wrapping_add(grid.unit / 2).div_euclid(grid.unit);
            let away = set.signed(coder, sets.2, size, (value.position[k] / grid.unit).wrapping_sub(near));
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
    /// Centres of the spokes inside the arc, of left and right, of the other spokes, and of all; relative to `s`, in 1/64.
    pub centers: [[i64; 3]; 4],
    /// What the sizes of tangential residuals follow from.
    pub tangent: SizeFeatures,
    /// What the sizes of residuals along the normal follow from.
    pub height: SizeFeatures,
}

impl GeometryFeatures {
    pub(crate) fn new(fan: &Fan, ring: &Ring, cut: Cut) -> Self {
        let spokes = ring.spokes.len();
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
            inside = add(inside, ring.spokes[at]);
            at = if at + 1 == spokes { 0 } else { at + 1 };
        }
        let mut opened = [0; 3];
        let mut count = 0;
        for spoke in ends.into_iter().flatten() {
            opened = add(opened, ring.spokes[spoke as usize]);
            count += 1;
        }
        let mean = |sum: [i64; 3], count: usize| sum.map(|x| mean(x, count));
        let ends_center = mean(opened, count);
        let arc_center = if inner == 0 { ends_center } else { mean(inside, inner) };
        let rest: [i64; 3] = std::array::from_fn(|k| ring.sum[k] - inside[k] - opened[k]);
        let rest_center = mean(rest, spokes.saturating_sub(inner + count));
        let span: [i64; 3] = match ends {
            [Some(a), Some(b)] => std::array::from_fn(|k| ring.spokes[a as usize][k] - ring.spokes[b as usize][k]),
            _ => opened,
        };
        let square = |a: [i64; 3]| lg(dot(a, a) as u64);
        // In 1/64, so six octaves more.
        let arc_length = square(arc_center) - 2 * 6 * 16;
        let heights = ring.spokes.iter().map(|&d| dot(d, ring.normal).unsigned_abs());
        let above = heights.fold(0, u64::saturating_add);
        let roughness = 2 * (lg(above / spokes as u64)) - square(ring.normal);
        let area = lg(ring.areas.iter().fold(0, |sum: i64, &x| sum.saturating_add(x)) as u64);
        let shape = arc.clamp(1, 6) - 1 + if fan.is_closed() { 0 } else { 6 };
        Self {
            shape,
            centers: [arc_center, ends_center, rest_center, mean(ring.sum, spokes)],
            tangent: [ring.spoke, ring.shortest, square(span), arc_length, ring.edge, area],
            height: [ring.spoke, roughness, square(span), arc_length, ring.edge, area],
        }
    }
}

fn add(a: [i64; 3], b: [i64; 3]) -> [i64; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

impl SizeWeights {
    fn size(&self, shape: usize, features: &SizeFeatures) -> i32 {
        let sum: i32 = self.features.iter().zip(features).map(|(weight, feature)| weight * feature).sum();
        self.constant[shape] + (sum >> 9)
    }
}

impl Prediction {
    fn new(trained: &Trained, fan: &Fan, ring: &Ring, cut: Cut) -> Self {
        let features = GeometryFeatures::new(fan, ring, cut);
        let weights = &trained.position[features.shape];
        let point = std::array::from_fn(|k| {
            let sum: i64 = (0..4).map(|i| i64::from(weights[i]) * features.centers[i][k]).sum();
            // Weights in 1/256 of centres in 1/64.
            ring.origin[k].wrapping_add(((sum + (1 << 13)) >> 14) as i32)
        });
        Self {
            point,
            tangent_size: trained.tangent_size.size(features.shape, &features.tangent),
            height_size: trained.height_size.size(features.shape, &features.height),
        }
    }
}

/// How far the fan's plane falls along the third axis over a step along the first two.
fn fall(ring: &Ring, [u, v, h]: [usize; 3], du: i32, dv: i32) -> i32 {
    if ring.normal[h] == 0 {
        return 0;
    }
    // The decoder may see residuals of any size; an honest encoder's fit 22 bits.
    let clamp = |d: i32| i64::from(d.clamp(-(1 << 22), 1 << 22));
    let slope = ring.normal[u] * clamp(du) + ring.normal[v] * clamp(dv);
    (slope / ring.normal[h]).clamp(-(1 << 23), 1 << 23) as i32
}

const _: () = assert!(CUT_SHAPES == 12);
