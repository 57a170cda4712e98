//! Coding of a patch's vertices: positions as residuals against what the faces so far suggest, colours against neighbours.
//!
//! Integers only. All answers are total: whatever bits come, a decoder gets numbers, and [`Malformed`] where a position is off
//! the lattice.

use super::Malformed;
use crate::op::color::{from_ycocg, to_ycocg};
use crate::op::range_coder::{BitCoder, NumberModel, Prob, TreeModel, contexts, raw_bits};

/// Added to the difference of two bit lengths, so that it is never negative.
const LENGTH_BIAS: u32 = 32;

/// A signed number whose magnitude is near a known scale: by how many bits it is longer or shorter, the two bits after the
/// leading one, the rest raw, then the sign.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct NearModel {
    length: TreeModel<64>,
    /// By the bits below the leading one that were coded so far.
    mantissa: [Prob; 4],
    sign: Prob,
}

contexts!(NearModel: length, mantissa, sign);

impl NearModel {
    const NEW: Self = Self { length: TreeModel::NEW, mantissa: [Prob::HALF; 4], sign: Prob::HALF };

    /// `scale` is a bit length, at most 31. A value has at most 31 bits.
    fn code(&mut self, coder: &mut impl BitCoder, scale: u32, value: i32) -> i32 {
        let magnitude = value.unsigned_abs();
        let length = bit_length(u64::from(magnitude));
        let coded = self.length.code(coder, (LENGTH_BIAS + length).saturating_sub(scale).min(63));
        // Only a forged stream goes beyond either end.
        let length = (coded + scale).saturating_sub(LENGTH_BIAS).min(31);
        if length == 0 {
            return 0;
        }
        let mut left = length - 1;
        let mut number = 1u32;
        while left > 0 && number < 4 {
            left -= 1;
            let bit = coder.bit(&mut self.mantissa[number as usize], magnitude >> left & 1 == 1);
            number = number << 1 | u32::from(bit);
        }
        let number = number << left | raw_bits(coder, magnitude & ((1 << left) - 1), left);
        if coder.bit(&mut self.sign, value < 0) { -(number as i32) } else { number as i32 }
    }
}

/// Adaptive contexts for positions and colours of the vertices of patches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct VertexModels {
    /// From the first to the second vertex of a component, by axis.
    second: [NearModel; 3],
    /// From the middle of both to the third, by axis.
    third: [NearModel; 3],
    /// Against the parallelogram: the two axes across the normal's dominant one, then that.
    next: [NearModel; 3],
    color: [NumberModel; 3],
}

contexts!(VertexModels: second, third, next, color);

impl VertexModels {
    pub(super) fn new() -> Self {
        Self {
            second: [NearModel::NEW; 3],
            third: [NearModel::NEW; 3],
            next: [NearModel::NEW; 3],
            color: [NumberModel::NEW; 3],
        }
    }

    /// Codes vertex `k < 3` of the first face of a component, after those `before` it.
    pub(super) fn of_first_face(
        &mut self,
        coder: &mut impl BitCoder,
        lattice_bits: u8,
        before: &[[i32; 3]],
        value: [i32; 3],
    ) -> Result<[i32; 3], Malformed> {
        let mut out = [0; 3];
        for k in 0..3 {
            out[k] = match *before {
                [] => raw_bits(coder, value[k] as u32, lattice_bits.into()) as i32,
                [first] => {
                    let scale = u32::from(lattice_bits);
                    first[k].wrapping_add(self.second[k].code(coder, scale, value[k].wrapping_sub(first[k])))
                }
                [first, second, ..] => {
                    let middle = (first[k] + second[k]) >> 1;
                    let scale = bit_length(distance(first, second));
                    middle.wrapping_add(self.third[k].code(coder, scale, value[k].wrapping_sub(middle)))
                }
            };
        }
        on_lattice(out, lattice_bits)
    }

    /// Codes the vertex across the edge from `a` to `b` of a face whose third vertex is `d`.
    pub(super) fn across(
        &mut self,
        coder: &mut impl BitCoder,
        lattice_bits: u8,
        [a, b, d]: [[i32; 3]; 3],
        value: [i32; 3],
    ) -> Result<[i32; 3], Malformed> {
        let normal = normal(a, b, d);
        let h = (0..3).max_by_key(|&k| (normal[k].unsigned_abs(), 2 - k)).unwrap_or(2);
        let [u, v] = [[1, 2], [0, 2], [0, 1]][h];
        let scale = bit_length((distance(a, b) + distance(b, d) + distance(d, a)) / 3);
        let predicted: [i32; 3] = std::array::from_fn(|k| (a[k] + b[k]) >> 1);
        let mut out = [0; 3];
        let mut fall = 0;
        for (i, k) in [u, v].into_iter().enumerate() {
            let turn = |x: i32| if predicted[k] < d[k] { x.wrapping_neg() } else { x };
            let residual = turn(self.next[i].code(coder, scale, turn(value[k].wrapping_sub(predicted[k]))));
            fall += normal[k] * i64::from(residual);
            out[k] = predicted[k].wrapping_add(residual);
        }
        // On the plane of the face; what the normal points away from has a positive residual.
        let plane = predicted[h].wrapping_sub(fall.checked_div(normal[h]).unwrap_or(0) as i32);
        let turn = |x: i32| if normal[h] > 0 { x.wrapping_neg() } else { x };
        let residual = turn(self.next[2].code(coder, scale, turn(value[h].wrapping_sub(plane))));
        out[h] = plane.wrapping_add(residual);
        on_lattice(out, lattice_bits)
    }

    /// Codes a colour against the mean of two, or for the first vertex raw.
    pub(super) fn color(&mut self, coder: &mut impl BitCoder, near: Option<[[u8; 3]; 2]>, value: [u8; 3]) -> [u8; 3] {
        let Some([a, b]) = near else { return value.map(|c| raw_bits(coder, c.into(), 8) as u8) };
        let predicted = to_ycocg(std::array::from_fn(|k| (i32::from(a[k]) + i32::from(b[k])) >> 1));
        let actual = to_ycocg(value.map(i32::from));
        let coded = std::array::from_fn(|k| {
            let residual = super::unzigzag(self.color[k].code(coder, super::zigzag(actual[k] - predicted[k])));
            predicted[k].wrapping_add(residual)
        });
        from_ycocg(coded).map(|c| c.clamp(0, 255) as u8)
    }
}

fn on_lattice(position: [i32; 3], lattice_bits: u8) -> Result<[i32; 3], Malformed> {
    let max = (1 << lattice_bits) - 1;
    if position.iter().all(|x| (0..=max).contains(x)) { Ok(position) } else { Err(Malformed) }
}

fn bit_length(x: u64) -> u32 {
    64 - x.leading_zeros()
}

/// Sum of the absolute differences of the coordinates.
fn distance(a: [i32; 3], b: [i32; 3]) -> u64 {
    (0..3).map(|k| u64::from(a[k].abs_diff(b[k]))).sum()
}

fn difference(a: [i32; 3], b: [i32; 3]) -> [i64; 3] {
    std::array::from_fn(|k| i64::from(b[k]) - i64::from(a[k]))
}

fn cross(u: [i64; 3], w: [i64; 3]) -> [i64; 3] {
    [u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]]
}

/// Normal of a face, shifted to at most 30 bits and a sign: a product with a residual, and the sum of two, then fit.
fn normal(a: [i32; 3], b: [i32; 3], c: [i32; 3]) -> [i64; 3] {
    let normal = cross(difference(a, b), difference(a, c));
    let largest = normal.iter().map(|x| x.unsigned_abs()).max().unwrap_or(0);
    let shift = bit_length(largest).saturating_sub(30);
    normal.map(|x| x >> shift)
}

/// Ways in which the border may go on at an end of an edge.
pub(super) const BENDS: usize = 5;

/// How the border bends at `a` between the edge to `b`, which belongs to the face with the third vertex `d`, and the border's
/// other edge there, to `x`: 0 if there is none, 1 if it turns away, 2 to 4 the more it turns in: over, up to a right angle, to
/// 60 degrees, sharper.
pub(super) fn bend(a: [i32; 3], b: [i32; 3], d: [i32; 3], x: Option<[i32; 3]>) -> usize {
    let Some(x) = x else { return 0 };
    let (u, w, inside) = (difference(a, b), difference(a, x), difference(a, d));
    // Coordinates have at most 21 bits, so products of two fit, and those of four fit twice as many.
    let dot = |p: [i64; 3], q: [i64; 3]| -> i64 { (0..3).map(|k| p[k] * q[k]).sum() };
    let wide = |p: [i64; 3], q: [i64; 3]| -> i128 { (0..3).map(|k| i128::from(p[k]) * i128::from(q[k])).sum() };
    if wide(cross(u, w), cross(u, inside)) > 0 {
        return 1;
    }
    let along = dot(u, w);
    let square = 4 * i128::from(along) * i128::from(along);
    match (along > 0, square > i128::from(dot(u, u)) * i128::from(dot(w, w))) {
        (false, _) => 2,
        (true, false) => 3,
        (true, true) => 4,
    }
}

/// Square of the distance of `v` to the middle of `a` and `b`, times 4.
pub(super) fn to_middle(a: [i32; 3], b: [i32; 3], v: [i32; 3]) -> u64 {
    // At most 23 bits each.
    (0..3).map(|k| i64::from(a[k] + b[k] - 2 * v[k])).map(|d| (d * d) as u64).sum()
}
