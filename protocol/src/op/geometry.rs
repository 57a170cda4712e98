//! Coding of what a split inserts: where it cuts the fan of `s`, the position and the colour of the new vertex.
//!
//! Integers only. The position is coded as a residual against a prediction from the one-ring: first the two coordinates
//! across the fan's dominant normal axis, then the third against the plane that the fan's normal spans.

use super::range_coder::{BitCoder, NumberModel, Prob, TreeModel, uniform};
use crate::mesh::{Cut, Fan, NewVertex};

/// Classes of expected residual magnitude (bit length of the mean spoke).
const SCALES: usize = 16;

/// A signed number: magnitude by [`NumberModel`], then the sign.
#[derive(Clone, Debug, PartialEq, Eq)]
struct SignedModel {
    magnitude: NumberModel,
    sign: Prob,
}

impl SignedModel {
    const NEW: Self = Self { magnitude: NumberModel::NEW, sign: Prob::HALF };

    fn code(&mut self, coder: &mut impl BitCoder, value: i32) -> i32 {
        let magnitude = self.magnitude.code(coder, value.unsigned_abs());
        if magnitude == 0 {
            return 0;
        }
        match coder.bit(&mut self.sign, value < 0) {
            true => (magnitude as i32).wrapping_neg(),
            false => magnitude as i32,
        }
    }
}

/// Adaptive contexts for the payload of splits.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct GeometryModels {
    open_case: [Prob; 3],
    /// Arc length less one (capped, 15 escapes) by valence (capped).
    arc: Vec<TreeModel<16>>,
    across: Vec<SignedModel>,
    along: Vec<SignedModel>,
    height: Vec<SignedModel>,
    color: [SignedModel; 3],
    moves: MoveModels,
}

/// Adaptive contexts for how far a split moves `s`.
#[derive(Clone, Debug, PartialEq, Eq)]
struct MoveModels {
    stays: Prob,
    /// Of those that move, whether `s` was in the middle.
    in_middle: Prob,
    parity: Prob,
    across: Vec<SignedModel>,
    along: Vec<SignedModel>,
    height: Vec<SignedModel>,
    color: SignedModel,
}

impl GeometryModels {
    pub(crate) fn new() -> Self {
        Self {
            open_case: [Prob::HALF; 3],
            arc: vec![TreeModel::NEW; 21],
            across: vec![SignedModel::NEW; SCALES],
            along: vec![SignedModel::NEW; SCALES],
            height: vec![SignedModel::NEW; SCALES],
            color: [SignedModel::NEW; 3],
            moves: MoveModels {
                stays: Prob::HALF,
                in_middle: Prob::HALF,
                parity: Prob::HALF,
                across: vec![SignedModel::NEW; SCALES],
                along: vec![SignedModel::NEW; SCALES],
                height: vec![SignedModel::NEW; SCALES],
                color: SignedModel::NEW,
            },
        }
    }

    /// Codes where the fan opens. A decoded cut may not fit the fan: `Fan::admits` tells.
    pub(crate) fn cut(&mut self, coder: &mut impl BitCoder, fan: &Fan, cut: Cut) -> Cut {
        let spokes = fan.ring().len() as u32;
        if fan.is_closed() {
            let right = match cut {
                Cut::Both { right, .. } => right,
                _ => 0,
            };
            let arc = fan.arc_len(cut).max(1);
            let arc = self.arc_len(coder, arc, spokes);
            let right = uniform(coder, right, spokes);
            return Cut::Both { right, left: (right + arc) % spokes };
        }
        let (both, is_left) = (matches!(cut, Cut::Both { .. }), matches!(cut, Cut::Left { .. }));
        if coder.bit(&mut self.open_case[0], both) {
            let right = match cut {
                Cut::Both { right, .. } => right,
                _ => 0,
            };
            let arc = fan.arc_len(cut).max(1);
            let right = uniform(coder, right, spokes - 1);
            let arc = uniform(coder, arc.wrapping_sub(1), (spokes - 1).saturating_sub(right).max(1)) + 1;
            return Cut::Both { right, left: right + arc };
        }
        let is_left = coder.bit(&mut self.open_case[1], is_left);
        let spoke = match cut {
            Cut::Left { left } => left,
            Cut::Right { right } => right,
            Cut::Both { .. } => 0,
        };
        let spoke = uniform(coder, spoke, spokes);
        if is_left { Cut::Left { left: spoke } } else { Cut::Right { right: spoke } }
    }

    fn arc_len(&mut self, coder: &mut impl BitCoder, arc: u32, valence: u32) -> u32 {
        let model = &mut self.arc[valence.min(20) as usize];
        let low = model.code(coder, (arc - 1).min(15));
        if low < 15 {
            return low + 1;
        }
        16 + uniform(coder, arc.wrapping_sub(16), valence.saturating_sub(16).max(1))
    }

    /// Codes the vertex that `cut` inserts into `s`'s fan. `positions` and `colors` are the replica's slot arrays.
    #[allow(clippy::too_many_arguments)]
    pub(crate) fn vertex(
        &mut self,
        coder: &mut impl BitCoder,
        s: u32,
        fan: &Fan,
        cut: Cut,
        positions: &[[i32; 3]],
        colors: Option<&[[u8; 3]]>,
        moves: bool,
        value: &NewVertex,
    ) -> NewVertex {
        let context = Prediction::new(s, fan, cut, positions);
        let [u, v, h] = context.axes;
        let residual = |k: usize, predicted: i32| value.position[k].wrapping_sub(predicted);
        let du = self.across[context.scale].code(coder, residual(u, context.point[u]));
        let dv = self.along[context.scale].code(coder, residual(v, context.point[v]));
        let height = context.height(du, dv);
        let dh = self.height[context.scale].code(coder, residual(h, height));
        let mut out = NewVertex::default();
        out.position[u] = context.point[u].wrapping_add(du);
        out.position[v] = context.point[v].wrapping_add(dv);
        out.position[h] = height.wrapping_add(dh);
        if let Some(colors) = colors {
            let predicted = to_ycocg(predict_color(s, fan, cut, colors));
            let actual = to_ycocg(value.color.map(i32::from));
            let coded: [i32; 3] = std::array::from_fn(|k| {
                predicted[k].wrapping_add(self.color[k].code(coder, actual[k].wrapping_sub(predicted[k])))
            });
            out.color = from_ycocg(coded).map(|c| c.clamp(0, 255) as u8);
        }
        if moves {
            let before = positions[s as usize];
            out.s_move = self.moves.code(coder, &context, before, out.position, value.s_move);
            if let Some(colors) = colors {
                let share = Share::new(out.s_move, before, out.position);
                out.s_color_move = std::array::from_fn(|k| {
                    let predicted = share.color_move(colors[s as usize][k], out.color[k]);
                    let residual = value.s_color_move[k].wrapping_sub(predicted) as i8;
                    predicted.wrapping_add(self.moves.color.code(coder, i32::from(residual)) as u8)
                });
            }
        }
        out
    }
}

impl MoveModels {
    /// Codes what a split adds to the position of `s`, which is at `before`, when the new vertex is at `t`.
    fn code(
        &mut self,
        coder: &mut impl BitCoder,
        context: &Prediction,
        before: [i32; 3],
        t: [i32; 3],
        value: [i32; 3],
    ) -> [i32; 3] {
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
        let [u, v, h] = context.axes;
        let mut out = [0; 3];
        // It has moved less than `t` has: between not at all and as far.
        let halfway = mirrored.map(|d| d / 2);
        let residual = |k: usize| value[k].wrapping_sub(halfway[k]);
        out[u] = halfway[u].wrapping_add(self.across[context.scale].code(coder, residual(u)));
        out[v] = halfway[v].wrapping_add(self.along[context.scale].code(coder, residual(v)));
        // As far from the fan's plane through `before` as `t` is, on the same side.
        let drop = t[h]
            .wrapping_sub(before[h])
            .wrapping_add(context.fall(t[u].wrapping_sub(before[u]), t[v].wrapping_sub(before[v])));
        let height = drop.wrapping_sub(context.fall(out[u], out[v]));
        out[h] = height.wrapping_add(self.height[context.scale].code(coder, value[h].wrapping_sub(height)));
        out
    }
}

/// Where the joined vertex was along the edge, as what the colour of `s` changes per difference between it and `t`.
struct Share {
    of: i64,
    rest: i64,
}

impl Share {
    fn new(s_move: [i32; 3], before: [i32; 3], t: [i32; 3]) -> Self {
        // Honest differences fit 22 bits; clamped, products of any fit.
        let clamp = |d: i32| i64::from(d.clamp(-(1 << 22), 1 << 22));
        let (mut along, mut length_squared) = (0, 0);
        for k in 0..3 {
            // The edge runs from where `s` goes to `t`.
            let moved = clamp(s_move[k]);
            let edge = clamp(t[k].wrapping_sub(before[k])) - moved;
            along -= moved * edge;
            length_squared += edge * edge;
        }
        let of = along.clamp(0, length_squared);
        Self { of, rest: length_squared - of }
    }

    /// Predicted change of a channel of `s`, whose value is `before`, when that of `t` is `t`; modulo 256.
    fn color_move(&self, before: u8, t: u8) -> u8 {
        if self.rest == 0 {
            return 0;
        }
        let change = (i64::from(before) - i64::from(t)) * self.of / self.rest;
        ((i64::from(before) + change).clamp(0, 255) as u8).wrapping_sub(before)
    }
}

/// What the ring says about the new vertex.
struct Prediction {
    point: [i32; 3],
    /// The two axes across the dominant normal axis, then that axis.
    axes: [usize; 3],
    normal: [i64; 3],
    scale: usize,
}

/// Weights of the arc's centre, the middle of left and right, the centre of the other ring vertices and the ring's centre, in
/// 1/100, by arc length 1 to 5 and more: least squares over scans (ALGORITHMS: "Predictor").
const WEIGHTS: [[i64; 4]; 5] =
    [[26, 26, -8, 5], [18, 24, -19, 26], [30, 15, -13, 16], [38, 8, -10, 10], [40, 1, -11, 8]];

impl Prediction {
    fn new(s: u32, fan: &Fan, cut: Cut, positions: &[[i32; 3]]) -> Self {
        let at = |slot: u32| positions[slot as usize].map(i64::from);
        let origin = at(s);
        let offset = |slot: u32| -> [i64; 3] {
            let p = at(slot);
            std::array::from_fn(|k| p[k] - origin[k])
        };
        let ring = fan.ring();
        let spokes = ring.len() as u32;
        let arc = fan.arc_len(cut);
        let (first, ends): (u32, [Option<u32>; 2]) = match cut {
            Cut::Both { right, left } => (right + 1, [Some(right), Some(left)]),
            Cut::Left { left } => (0, [None, Some(left)]),
            Cut::Right { right } => (right + 1, [Some(right), None]),
        };
        let inner = if ends[0].is_some() && ends[1].is_some() { arc.saturating_sub(1) } else { arc };
        let mut sums = [[0i64; 3]; 3];
        let mut counts = [0i64; 3];
        let mut length = 0i64;
        for j in 0..spokes {
            let d = offset(ring[j as usize]);
            length += d.iter().map(|x| x.abs()).sum::<i64>();
            let group = if ends.contains(&Some(j)) {
                1
            } else if (j + spokes - first % spokes) % spokes < inner {
                0
            } else {
                2
            };
            (0..3).for_each(|k| sums[group][k] += d[k]);
            counts[group] += 1;
        }
        let total: [i64; 3] = std::array::from_fn(|k| sums.iter().map(|s| s[k]).sum());
        let mean = |sum: i64, count: i64| if count == 0 { 0 } else { sum * 64 / count };
        let ends_mean: [i64; 3] = std::array::from_fn(|k| mean(sums[1][k], counts[1]));
        let weights = WEIGHTS[(arc.clamp(1, 5) - 1) as usize];
        let point = std::array::from_fn(|k| {
            let arc_mean = if counts[0] == 0 { ends_mean[k] } else { mean(sums[0][k], counts[0]) };
            let sum = weights[0] * arc_mean
                + weights[1] * ends_mean[k]
                + weights[2] * mean(sums[2][k], counts[2])
                + weights[3] * mean(total[k], i64::from(spokes));
            (origin[k] + (sum + 3200).div_euclid(6400)) as i32
        });
        let mut normal = [0i64; 3];
        for j in 0..fan.faces() {
            let a = offset(ring[j as usize]);
            let b = offset(ring[((j + 1) % spokes) as usize]);
            let cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
            normal = std::array::from_fn(|k| normal[k] + (cross[k] >> 4));
        }
        let largest = normal.iter().map(|x| x.unsigned_abs()).max().unwrap_or(0);
        let shift = (64 - largest.leading_zeros()).saturating_sub(30);
        normal = normal.map(|x| x >> shift);
        let h = (0..3).max_by_key(|&k| (normal[k].unsigned_abs(), 2 - k)).unwrap_or(2);
        let axes = match h {
            0 => [1, 2, 0],
            1 => [0, 2, 1],
            _ => [0, 1, 2],
        };
        let spoke = (length / i64::from(spokes).max(1)) as u64;
        let scale = (64 - spoke.leading_zeros() as usize).min(SCALES - 1);
        Self { point, axes, normal, scale }
    }

    /// Third coordinate on the plane through the predicted point, at the coded first two.
    fn height(&self, du: i32, dv: i32) -> i32 {
        self.point[self.axes[2]].wrapping_sub(self.fall(du, dv))
    }

    /// How far the fan's plane falls along the third axis over a step along the first two.
    fn fall(&self, du: i32, dv: i32) -> i32 {
        let [u, v, h] = self.axes;
        if self.normal[h] == 0 {
            return 0;
        }
        // The decoder may see residuals of any size; an honest encoder's fit 22 bits.
        let clamp = |d: i32| i64::from(d.clamp(-(1 << 22), 1 << 22));
        let slope = self.normal[u] * clamp(du) + self.normal[v] * clamp(dv);
        (slope / self.normal[h]).clamp(-(1 << 23), 1 << 23) as i32
    }
}

fn predict_color(s: u32, fan: &Fan, cut: Cut, colors: &[[u8; 3]]) -> [i32; 3] {
    let ring = fan.ring();
    let (a, b) = match cut {
        Cut::Both { right, left } => (ring[right as usize], ring[left as usize]),
        Cut::Left { left } => (ring[left as usize], s),
        Cut::Right { right } => (ring[right as usize], s),
    };
    std::array::from_fn(|k| {
        let channel = |slot: u32| i32::from(colors[slot as usize][k]);
        (channel(s) + channel(a) + channel(b) + 1) / 3
    })
}

/// The lossless YCoCg-R transform.
fn to_ycocg([r, g, b]: [i32; 3]) -> [i32; 3] {
    let co = r - b;
    let t = b + (co >> 1);
    let cg = g - t;
    [t + (cg >> 1), co, cg]
}

fn from_ycocg([y, co, cg]: [i32; 3]) -> [i32; 3] {
    let t = y.wrapping_sub(cg >> 1);
    let g = cg.wrapping_add(t);
    let b = t.wrapping_sub(co >> 1);
    [b.wrapping_add(co), g, b]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ycocg_is_lossless() {
        let mut rng = fastrand::Rng::with_seed(3);
        for _ in 0..10_000 {
            let rgb = [0; 3].map(|_: i32| rng.i32(0..256));
            assert_eq!(from_ycocg(to_ycocg(rgb)), rgb);
        }
    }

    #[test]
    fn colour_moves_follow_the_share() {
        // The joined vertex lies a third of the way from `s` to `t`, which has 30 more: `s` had 15 less.
        let share = Share::new([-10, 0, 0], [10, 0, 0], [30, 0, 0]);
        assert_eq!(share.color_move(100, 130), 0u8.wrapping_sub(15));
        assert_eq!(Share::new([0; 3], [1; 3], [1; 3]).color_move(7, 9), 0);
        // Whatever is decoded, nothing overflows.
        let wild = Share::new([i32::MIN; 3], [i32::MAX; 3], [i32::MIN; 3]);
        wild.color_move(255, 0);
    }
}
