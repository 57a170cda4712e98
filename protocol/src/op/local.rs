//! What the one-ring of a vertex looks like: the integers that prediction and contexts are made of.

use super::fixed::{LG_ONE, lg};
use crate::mesh::Fan;

/// Elements that loops over a ring go through at once: what vectors of a processor hold, twice. As many spokes as few
/// vertices exceed.
const LANES: usize = 8;
/// Bits of the scaled spokes, so that products of two and sums of three such products fit 32 bits.
const SCALED_BITS: u32 = 12;
/// Bits of the scaled normal.
const NORMAL_BITS: u32 = 14;

type Lanes = [i32; LANES];

/// The one-ring of `s`, relative to `s`. Logarithms are in 1/32 octave (`lg` of squares). O(valence); kept from split to split
/// for its buffers.
///
/// All but the spokes themselves is made of scaled spokes: shifted to the right until no coordinate of any has more than
/// [`SCALED_BITS`] bits, which only rings that are large in their lattice need.
#[derive(Clone, Debug, Default)]
pub(crate) struct Ring {
    /// Position of `s`.
    pub(crate) origin: [i32; 3],
    /// Spokes and the faces behind them, in the fan's order. Behind the last spoke the first one stands in, so that faces from
    /// there on have no area.
    blocks: Vec<Block>,
    /// How many spokes there are.
    count: usize,
    /// By how much spokes are shifted.
    shift: u32,
    /// The fan's normal, at most 2^14 in each component.
    pub(crate) normal: [i32; 3],
    /// The two axes across the dominant axis of the normal, then that axis.
    pub(crate) axes: [usize; 3],
    /// `lg` of the mean squared spoke, unscaled.
    pub(crate) spoke: i32,
    /// `lg` of the mean squared edge of the ring, unscaled.
    pub(crate) edge: i32,
    /// `lg` of the shortest squared spoke, unscaled.
    pub(crate) shortest: i32,
    /// Sum of the spokes.
    pub(crate) sum: [i64; 3],
    /// Sum of the areas of the faces as the normal sees them, in units of scaled spokes.
    pub(crate) area: u64,
}

/// Some spokes and faces of a ring.
#[derive(Clone, Copy, Debug, Default)]
struct Block {
    /// Spokes by axis.
    spokes: [Lanes; 3],
    /// `lg` of each scaled spoke's squared length.
    lengths: Lanes,
    /// `lg` of the squared length of the ring's scaled edge of each face.
    edges: Lanes,
    /// Twice the area of each face as the axes see it, with the sign of its orientation; at most 2^25 in magnitude.
    crosses: [Lanes; 3],
}

/// What adds up over the blocks of a ring.
#[derive(Default)]
struct Sums {
    squares: i64,
    ring_squares: i64,
    shortest: i32,
    normal: [i64; 3],
}

impl Ring {
    /// Reads the ring of the vertex at `s`. Coordinates are at most 2^21 in magnitude.
    pub(crate) fn read(&mut self, s: u32, fan: &Fan, positions: &[[i32; 3]]) {
        let origin = positions[s as usize];
        let spoke = |slot: u32| -> [i32; 3] {
            let [x, y, z] = positions[slot as usize];
            [x - origin[0], y - origin[1], z - origin[2]]
        };
        let (spokes, faces) = (fan.ring().len(), fan.faces() as usize);
        let blocks = spokes.div_ceil(LANES);
        if self.blocks.len() < blocks {
            self.blocks.resize(blocks, Block::default());
        }
        (self.origin, self.count) = (origin, spokes);
        let first = spoke(fan.ring()[0]);
        let mut sum = [0i64; 3];
        let mut used = 0;
        for (block, slots) in self.blocks.iter_mut().zip(fan.ring().chunks(LANES)) {
            let [xs, ys, zs] = &mut block.spokes;
            (*xs, *ys, *zs) = ([first[0]; LANES], [first[1]; LANES], [first[2]; LANES]);
            for (((&slot, x), y), z) in slots.iter().zip(&mut *xs).zip(&mut *ys).zip(&mut *zs) {
                [*x, *y, *z] = spoke(slot);
            }
            let again = (LANES - slots.len()) as i32;
            for k in 0..3 {
                let (total, bits) = sum_and_bits(&block.spokes[k]);
                sum[k] += i64::from(total - again * first[k]);
                used |= bits;
            }
        }
        self.sum = sum;
        self.shift = (32 - used.leading_zeros()).saturating_sub(SCALED_BITS);

        let mut sums = Sums { shortest: i32::MAX, ..Sums::default() };
        let used_blocks = &mut self.blocks[..blocks];
        for i in 0..blocks {
            let next = used_blocks.get(i + 1).map_or(first, |next| next.spokes.map(|axis| axis[0]));
            let in_ring = spokes.saturating_sub(i * LANES).min(LANES);
            // From the last spoke of an open fan to the first there is no face.
            let gap = if faces < spokes && faces / LANES == i { Some(faces % LANES) } else { None };
            used_blocks[i].measure(self.shift, next, in_ring, gap, &mut sums);
        }
        let unscaled = self.unscaled();
        self.spoke = lg(sums.squares as u64) - lg(spokes as u64) + unscaled;
        self.edge = lg(sums.ring_squares as u64) - lg(faces as u64) + unscaled;
        self.shortest = lg(sums.shortest as u64) + unscaled;
        let largest = sums.normal.iter().fold(0, |largest, x| largest | x.unsigned_abs());
        let shift = (64 - largest.leading_zeros()).saturating_sub(NORMAL_BITS);
        self.normal = sums.normal.map(|x| (x >> shift) as i32);
        let [x, y, z] = self.normal.map(i32::unsigned_abs);
        self.axes = if x >= y && x >= z {
            [1, 2, 0]
        } else if y >= z {
            [0, 2, 1]
        } else {
            [0, 1, 2]
        };
        self.area = 0;
        for block in &self.blocks[..blocks] {
            let areas = &block.crosses[self.axes[2]];
            self.area += u64::from(areas.iter().fold(0, |sum, area| sum + area.unsigned_abs()));
        }
    }

    /// What to add to the `lg` of a scaled square.
    pub(crate) fn unscaled(&self) -> i32 {
        32 * self.shift as i32
    }

    /// Number of spokes.
    pub(crate) fn count(&self) -> usize {
        self.count
    }

    /// A spoke as a vector.
    #[inline]
    pub(crate) fn spoke_at(&self, i: usize) -> [i32; 3] {
        let spokes = &self.blocks[i / LANES].spokes;
        [spokes[0][i % LANES], spokes[1][i % LANES], spokes[2][i % LANES]]
    }

    /// The same scaled.
    #[inline]
    pub(crate) fn scaled_spoke_at(&self, i: usize) -> [i32; 3] {
        self.spoke_at(i).map(|x| x >> self.shift)
    }

    /// Lengths, edges and areas (as the fan's normal sees them, by their magnitude) of the first spokes.
    #[inline]
    pub(crate) fn numbers<const SPOKES: usize>(&self) -> [[i32; SPOKES]; 3] {
        let mut out = [[0; SPOKES]; 3];
        let h = self.axes[2];
        for (i, block) in self.blocks[..SPOKES.div_ceil(LANES)].iter().enumerate() {
            for j in 0..LANES.min(SPOKES - i * LANES) {
                out[0][i * LANES + j] = block.lengths[j];
                out[1][i * LANES + j] = block.edges[j];
                out[2][i * LANES + j] = block.crosses[h][j].abs();
            }
        }
        out
    }

    /// The same of one spoke.
    #[cfg(any(test, feature = "testing"))]
    pub(crate) fn numbers_at(&self, i: usize) -> [i32; 3] {
        let (block, lane) = (&self.blocks[i / LANES], i % LANES);
        [block.lengths[lane], block.edges[lane], block.crosses[self.axes[2]][lane].abs()]
    }

    /// Sum over the scaled spokes of how far they go along the normal, up or down.
    pub(crate) fn heights(&self) -> u64 {
        let mut sum = 0;
        let [nx, ny, nz] = self.normal;
        for (block, from) in self.blocks.iter().zip((0..self.count).step_by(LANES)) {
            let [xs, ys, zs] = &block.spokes;
            let mut heights = [0; LANES];
            for i in 0..LANES {
                let at = |axis: &Lanes| axis[i] >> self.shift;
                heights[i] = (at(xs) * nx + at(ys) * ny + at(zs) * nz).abs();
            }
            // At most 3 2^26 each.
            let in_ring = &heights[..LANES.min(self.count - from)];
            sum += u64::from(in_ring.iter().fold(0, |sum, &height| sum + height as u32));
        }
        sum
    }

    /// A ring of these lengths, edges and areas, whatever surface that would be.
    #[cfg(test)]
    pub(crate) fn of_numbers(lengths: &[i32], edges: &[i32], areas: &[i32]) -> Self {
        let mut ring = Self { count: lengths.len(), ..Self::default() };
        ring.blocks.resize(ring.count.div_ceil(LANES), Block::default());
        for (i, ((&length, &edge), &area)) in lengths.iter().zip(edges).zip(areas).enumerate() {
            let block = &mut ring.blocks[i / LANES];
            block.lengths[i % LANES] = length;
            block.edges[i % LANES] = edge;
            block.crosses[0][i % LANES] = area;
        }
        ring
    }
}

/// The sum of the lanes, and the bits of their magnitudes (or, of negative ones, of the magnitude less one) together.
#[inline(always)]
fn sum_and_bits(lanes: &Lanes) -> (i32, u32) {
    let (mut sum, mut bits) = (0, 0);
    for lane in lanes {
        sum += lane;
        bits |= lane ^ (lane >> 31);
    }
    (sum, bits as u32)
}

impl Block {
    /// Measures spokes and faces. `next` is the spoke behind the block, `in_ring` says how many of the spokes are no stand-ins, `gap`
    /// which face is none.
    #[inline(always)]
    fn measure(&mut self, shift: u32, next: [i32; 3], in_ring: usize, gap: Option<usize>, sums: &mut Sums) {
        let (mut a, mut b) = ([[0; LANES]; 3], [[0; LANES]; 3]);
        for k in 0..3 {
            for (scaled, spoke) in a[k].iter_mut().zip(&self.spokes[k]) {
                *scaled = spoke >> shift;
            }
            b[k][..LANES - 1].copy_from_slice(&a[k][1..]);
            b[k][LANES - 1] = next[k] >> shift;
        }
        let ([ax, ay, az], [bx, by, bz]) = (&a, &b);
        let (mut squares, mut edges) = ([0; LANES], [0; LANES]);
        for i in 0..LANES {
            squares[i] = ax[i] * ax[i] + ay[i] * ay[i] + az[i] * az[i];
            let (x, y, z) = (bx[i] - ax[i], by[i] - ay[i], bz[i] - az[i]);
            edges[i] = x * x + y * y + z * z;
        }
        let [cx, cy, cz] = &mut self.crosses;
        for i in 0..LANES {
            cx[i] = ay[i] * bz[i] - az[i] * by[i];
            cy[i] = az[i] * bx[i] - ax[i] * bz[i];
            cz[i] = ax[i] * by[i] - ay[i] * bx[i];
        }
        if let Some(gap) = gap {
            edges[gap] = 0;
            (cx[gap], cy[gap], cz[gap]) = (0, 0, 0);
        }
        for i in 0..LANES {
            self.lengths[i] = lg_of_lane(squares[i]);
            self.edges[i] = lg_of_lane(edges[i]);
        }
        let [mut nx, mut ny, mut nz] = [0; 3];
        let (mut square_sum, mut edge_sum) = (0, 0);
        for i in 0..LANES {
            nx += cx[i];
            ny += cy[i];
            nz += cz[i];
            edge_sum += edges[i];
            square_sum += squares[i];
        }
        for (sum, lanes) in sums.normal.iter_mut().zip([nx, ny, nz]) {
            *sum += i64::from(lanes);
        }
        let shortest = squares.iter().fold(i32::MAX, |shortest, &square| shortest.min(square));
        let stand_ins = (LANES - in_ring) as i32;
        // The first spoke stands in, and it is behind the last face that is one.
        sums.shortest = sums.shortest.min(shortest);
        sums.squares += i64::from(square_sum) - i64::from(stand_ins * squares[LANES - 1]);
        sums.ring_squares += i64::from(edge_sum);
    }
}

/// `lg` of a number below 2^28.
///
/// The exponent of a float and the first four bits behind its leading one, which is what `lg` is, come without a count of zeros,
/// which vectors lack. Numbers of 24 bits are floats exactly, and those below 2^28 are once the last four bits are gone, so
/// that no rounding can carry.
#[inline(always)]
fn lg_of_lane(x: i32) -> i32 {
    let exact = if x < 1 << 24 { x } else { x & !15 };
    ((exact.max(1) as f32).to_bits() >> 19) as i32 - 127 * LG_ONE
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithms_of_lanes_are_those_of_numbers() {
        let near_powers = (0..28).flat_map(|k| (-3..=3).map(move |d| ((1 << k) + d).clamp(0, (1 << 28) - 1)));
        let mut rng = fastrand::Rng::with_seed(4);
        // All ones carry if anything rounds.
        let all_ones = (1..=28).flat_map(|k| (0..k).map(move |low| ((1 << k) - 1) & !((1 << low) - 1)));
        let at_random = (0..200_000).map(|_| rng.i32(0..1 << 28) >> rng.u32(0..28));
        for x in near_powers.chain(all_ones).chain(at_random) {
            assert_eq!(lg_of_lane(x), lg(x as u64), "{x}");
        }
    }
}
