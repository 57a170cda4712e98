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

/// The vector with this many elements, for a loop to overwrite: pushing one by one checks the capacity each time.
fn sized<T: Copy + Default>(buffer: &mut Vec<T>, len: usize) -> &mut [T] {
    buffer.resize(len, T::default());
    buffer
}

fn square(a: [i64; 3]) -> u64 {
    dot(a, a) as u64
}

impl Ring {
    /// Reads the ring of the vertex at `origin`. Coordinates are at most 2^21 in magnitude.
    pub(crate) fn read(&mut self, s: u32, fan: &Fan, positions: &[[i32; 3]]) {
        let origin = positions[s as usize];
        self.origin = origin;
        let (spokes, faces) = (fan.ring().len(), fan.faces() as usize);
        let (mut sum, mut squares, mut shortest) = ([0; 3], 0u64, u64::MAX);
        let lengths = sized(&mut self.lengths, spokes);
        for ((&slot, spoke), lg_length) in fan.ring().iter().zip(sized(&mut self.spokes, spokes)).zip(lengths) {
            let p = positions[slot as usize];
            let d: [i64; 3] = std::array::from_fn(|k| i64::from(p[k]) - i64::from(origin[k]));
            let length = square(d);
            squares = squares.saturating_add(length);
            shortest = shortest.min(length);
            *lg_length = lg(length);
            sum = std::array::from_fn(|k| sum[k] + d[k]);
            *spoke = d;
        }
        self.sum = sum;
        let (mut normal, mut ring_squares) = ([0i64; 3], 0u64);
        let mut a = self.spokes[0];
        // One spoke more than faces, or the first one again.
        let ends = self.spokes[1..].iter().chain(&self.spokes[..1]);
        let (edges, crosses) = (sized(&mut self.edges, faces), sized(&mut self.crosses, faces));
        for ((&b, lg_edge), cross) in ends.zip(edges).zip(crosses) {
            *cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
            normal = std::array::from_fn(|k| normal[k] + (cross[k] >> 4));
            let edge = square(std::array::from_fn(|k| b[k] - a[k]));
            ring_squares = ring_squares.saturating_add(edge);
            *lg_edge = lg(edge);
            a = b;
        }
        let largest = normal.iter().map(|x| x.unsigned_abs()).max().unwrap_or(0);
        let shift = (64 - largest.leading_zeros()).saturating_sub(30);
        self.normal = normal.map(|x| x >> shift);
        let [x, y, z] = self.normal.map(i64::unsigned_abs);
        let h = if x >= y && x >= z {
            0
        } else if y >= z {
            1
        } else {
            2
        };
        self.axes = match h {
            0 => [1, 2, 0],
            1 => [0, 2, 1],
            _ => [0, 1, 2],
        };
        for (area, cross) in sized(&mut self.areas, faces).iter_mut().zip(&self.crosses) {
            *area = cross[h].abs();
        }
        let count = spokes;
        self.spoke = lg(squares / (count as u64).max(1));
        self.edge = lg(ring_squares / u64::from(fan.faces()).max(1));
        self.shortest = lg(shortest);
    }
}
