//! What the one-ring of a vertex looks like: the integers that prediction and contexts are made of.

use super::fixed::lg;
use crate::mesh::Fan;

/// The one-ring of `s`, relative to `s`. Lengths are logarithms in 1/32 octave (`lg` of squares), areas are those of the
/// projection along the dominant axis of the fan's normal. O(valence); kept from split to split for its buffers.
#[derive(Clone, Debug, Default)]
pub(crate) struct Ring {
    /// Position of `s`.
    pub(crate) origin: [i32; 3],
    /// Spokes as vectors, in the fan's order.
    pub(crate) spokes: Vec<[i64; 3]>,
    /// `lg` of each spoke's squared length.
    pub(crate) lengths: Vec<i32>,
    /// `lg` of the squared length of the ring's edge of each face.
    pub(crate) edges: Vec<i32>,
    /// Twice the projected area of each face.
    pub(crate) areas: Vec<i64>,
    /// The fan's normal, at most 2^30 in each component.
    pub(crate) normal: [i64; 3],
    /// The two axes across the dominant axis of the normal, then that axis.
    pub(crate) axes: [usize; 3],
    /// `lg` of the mean squared spoke.
    pub(crate) spoke: i32,
    /// `lg` of the mean squared edge of the ring.
    pub(crate) edge: i32,
    /// `lg` of the shortest squared spoke.
    pub(crate) shortest: i32,
    /// Sum of the spokes.
    pub(crate) sum: [i64; 3],
    crosses: Vec<[i64; 3]>,
}

pub(crate) fn dot(a: [i64; 3], b: [i64; 3]) -> i64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn square(a: [i64; 3]) -> u64 {
    dot(a, a) as u64
}

impl Ring {
    /// Reads the ring of the vertex at `origin`. Coordinates are at most 2^21 in magnitude.
    pub(crate) fn read(&mut self, s: u32, fan: &Fan, positions: &[[i32; 3]]) {
        let origin = positions[s as usize];
        self.origin = origin;
        self.spokes.clear();
        self.lengths.clear();
        self.edges.clear();
        self.crosses.clear();
        self.areas.clear();
        self.sum = [0; 3];
        let (mut squares, mut shortest) = (0, u64::MAX);
        for &slot in fan.ring() {
            let p = positions[slot as usize];
            let d: [i64; 3] = std::array::from_fn(|k| i64::from(p[k]) - i64::from(origin[k]));
            let length = square(d);
            squares = u64::saturating_add(squares, length);
            shortest = shortest.min(length);
            self.lengths.push(lg(length));
            self.sum = std::array::from_fn(|k| self.sum[k] + d[k]);
            self.spokes.push(d);
        }
        let (mut normal, mut ring_squares) = ([0i64; 3], 0);
        let count = self.spokes.len();
        for i in 0..fan.faces() as usize {
            let (a, b) = (self.spokes[i], self.spokes[if i + 1 == count { 0 } else { i + 1 }]);
            let cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
            normal = std::array::from_fn(|k| normal[k] + (cross[k] >> 4));
            self.crosses.push(cross);
            let edge = square(std::array::from_fn(|k| b[k] - a[k]));
            ring_squares = u64::saturating_add(ring_squares, edge);
            self.edges.push(lg(edge));
        }
        let largest = normal.iter().map(|x| x.unsigned_abs()).max().unwrap_or(0);
        let shift = (64 - largest.leading_zeros()).saturating_sub(30);
        self.normal = normal.map(|x| x >> shift);
        let h = (0..3).max_by_key(|&k| (self.normal[k].unsigned_abs(), 2 - k)).unwrap_or(2);
        self.axes = match h {
            0 => [1, 2, 0],
            1 => [0, 2, 1],
            _ => [0, 1, 2],
        };
        self.areas.extend(self.crosses.iter().map(|cross| cross[h].abs()));
        self.spoke = lg(squares / (count as u64).max(1));
        self.edge = lg(ring_squares / u64::from(fan.faces()).max(1));
        self.shortest = lg(shortest);
    }
}
