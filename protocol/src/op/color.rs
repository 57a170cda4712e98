//! Coding of colours: YCoCg-R residuals against a mean of neighbours.

use super::fixed::lg;
use super::range_coder::{BitCoder, NumberModel, ScaledSet, contexts};
use crate::mesh::{Cut, Fan};

/// Adaptive contexts of colours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ColorModels {
    /// By channel.
    residual: [ScaledSet; 3],
    /// What a moving `s` changes.
    moved: ScaledSet,
    escape: NumberModel,
}

contexts!(ColorModels: residual, moved, escape);

impl ColorModels {
    pub(crate) const NEW: Self =
        Self { residual: [ScaledSet::NEW; 3], moved: ScaledSet::NEW, escape: NumberModel::NEW };

    /// Codes the colour of the vertex that `cut` inserts into `s`'s fan.
    pub(crate) fn vertex(
        &mut self,
        coder: &mut impl BitCoder,
        s: u32,
        fan: &Fan,
        cut: Cut,
        colors: &[[u8; 3]],
        value: [u8; 3],
    ) -> [u8; 3] {
        let ring = fan.ring();
        let (a, b) = match cut {
            Cut::Both { right, left } => (ring[right as usize], ring[left as usize]),
            Cut::Left { left } => (ring[left as usize], s),
            Cut::Right { right } => (ring[right as usize], s),
        };
        let near = [s, a, b].map(|slot| to_ycocg(colors[slot as usize].map(i32::from)));
        let actual = to_ycocg(value.map(i32::from));
        // The better luma is known, the better chroma's size can be guessed.
        let mut surprise = 0;
        let coded: [i32; 3] = std::array::from_fn(|k| {
            let [s, a, b] = near.map(|c| c[k]);
            let predicted = (s + a + b + 1) / 3;
            let spread = (s - a).unsigned_abs() + (s - b).unsigned_abs() + (a - b).unsigned_abs();
            let size = lg(u64::from(spread + surprise + 1)) - 16;
            let residual = self.residual[k].signed(coder, &mut self.escape, size, actual[k].wrapping_sub(predicted));
            surprise = residual.unsigned_abs().min(255) >> 1;
            predicted.wrapping_add(residual)
        });
        from_ycocg(coded).map(|c| c.clamp(0, 255) as u8)
    }

    /// Codes what the colour of `s`, now `before`, changes when the new vertex has colour `t`; modulo 256.
    pub(crate) fn moved(
        &mut self,
        coder: &mut impl BitCoder,
        share: &Share,
        before: [u8; 3],
        t: [u8; 3],
        value: [u8; 3],
    ) -> [u8; 3] {
        std::array::from_fn(|k| {
            let predicted = share.color_move(before[k], t[k]);
            let size = lg(u64::from(before[k].abs_diff(t[k])) + 1) - 16;
            let residual = i32::from(value[k].wrapping_sub(predicted) as i8);
            predicted.wrapping_add(self.moved.signed(coder, &mut self.escape, size, residual) as u8)
        })
    }
}

/// Where the joined vertex was along the edge, as what the colour of `s` changes per difference between it and `t`.
pub(crate) struct Share {
    of: i64,
    rest: i64,
}

impl Share {
    pub(crate) fn new(s_move: [i32; 3], before: [i32; 3], t: [i32; 3]) -> Self {
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

/// The lossless YCoCg-R transform.
pub(super) fn to_ycocg([r, g, b]: [i32; 3]) -> [i32; 3] {
    let co = r - b;
    let t = b + (co >> 1);
    let cg = g - t;
    [t + (cg >> 1), co, cg]
}

/// Its reverse; total on any numbers.
pub(super) fn from_ycocg([y, co, cg]: [i32; 3]) -> [i32; 3] {
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
