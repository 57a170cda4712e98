//! Choice of the lattice from edge lengths that were counted chunk by chunk: the rule of
//! [`choose`](crate::ingest::simplify::lattice::choose), without a list of all edges.
//!
//! The mean is summed in another order, so it may differ in its last bits. The percentile is exact where it matters: a
//! histogram gives it within 1/256, and only if the number of bits could differ within that, the edges are counted again.

use lodestream_protocol::quant::{Lattice, MAX_LATTICE_BITS};

use super::survey::at;

/// Fewest bits that are chosen without being asked for.
pub(crate) const MIN_DEFAULT_BITS: u8 = 12;

/// Low bits of an `f32` that the histogram leaves out.
const FINE_BITS: u32 = 15;

/// Lengths of the edges of faces, each edge once for each face, those of zero length left out.
#[derive(Debug, Default)]
pub(super) struct EdgeLengths {
    count: u64,
    sum: f64,
    /// By the upper 16 bits of a positive `f32`; empty for no lengths.
    histogram: Vec<u32>,
}

impl EdgeLengths {
    pub(super) fn add_faces(&mut self, faces: &[[u32; 3]], positions: &[[f64; 3]]) {
        self.histogram.resize(1 << 16, 0);
        for_each_length(faces, positions, |length| {
            self.count += 1;
            self.sum += length;
            self.histogram[((length as f32).to_bits() >> FINE_BITS) as usize] += 1;
        });
    }

    pub(super) fn join(&mut self, other: &Self) {
        self.count += other.count;
        self.sum += other.sum;
        if !other.histogram.is_empty() {
            self.histogram.resize(1 << 16, 0);
            // A mesh has fewer half-edges than a `u32` counts.
            self.histogram.iter_mut().zip(&other.histogram).for_each(|(a, b)| *a += b);
        }
    }

    /// Number of bits for a mesh in this box, or the bin of the percentile that decides it.
    pub(super) fn bits(&self, low: [f64; 3], high: [f64; 3]) -> Result<u8, Bin> {
        if self.count == 0 {
            return Ok(MIN_DEFAULT_BITS);
        }
        let mut rank = self.count / 100;
        let mut bin = 0;
        while rank >= u64::from(self.histogram[bin]) {
            rank -= u64::from(self.histogram[bin]);
            bin += 1;
        }
        let least = (bin as u32) << FINE_BITS;
        let most = least | ((1 << FINE_BITS) - 1);
        let mean = self.sum / self.count as f64;
        let [fewest, enough] = [most, least].map(|bits| bits_for(mean, f32::from_bits(bits), low, high));
        // The bin after the last finite length holds infinity and what is no number.
        if fewest == enough || f32::from_bits(most).is_nan() {
            Ok(enough)
        } else {
            Err(Bin { bin: bin as u32, rank, mean })
        }
    }
}

/// Where the 1st percentile lies.
#[derive(Debug)]
pub(super) struct Bin {
    bin: u32,
    /// How many lengths of the bin come before it.
    rank: u64,
    mean: f64,
}

impl Bin {
    /// Counts the lengths of the bin by their remaining bits.
    pub(super) fn count(&self, faces: &[[u32; 3]], positions: &[[f64; 3]]) -> Vec<u32> {
        let mut counts = vec![0; 1 << FINE_BITS];
        for_each_length(faces, positions, |length| {
            let bits = (length as f32).to_bits();
            if bits >> FINE_BITS == self.bin {
                counts[bits as usize & ((1 << FINE_BITS) - 1)] += 1;
            }
        });
        counts
    }

    /// Number of bits, from the sum of all [`Bin::count`].
    pub(super) fn bits(&self, counts: &[u32], low: [f64; 3], high: [f64; 3]) -> u8 {
        let mut rank = self.rank;
        let mut fine = 0;
        while rank >= u64::from(counts[fine]) {
            rank -= u64::from(counts[fine]);
            fine += 1;
        }
        bits_for(self.mean, f32::from_bits(self.bin << FINE_BITS | fine as u32), low, high)
    }
}

fn bits_for(mean: f64, percentile: f32, low: [f64; 3], high: [f64; 3]) -> u8 {
    let step = (mean / 16.0).min(f64::from(percentile) / 2.0);
    (MIN_DEFAULT_BITS..MAX_LATTICE_BITS)
        .find(|&bits| Lattice::of_box(low, high, bits).step <= step)
        .unwrap_or(MAX_LATTICE_BITS)
}

#[inline]
fn for_each_length(faces: &[[u32; 3]], positions: &[[f64; 3]], mut visit: impl FnMut(f64)) {
    for face in faces {
        let corners = face.map(|v| at(positions[v as usize]));
        for k in 0..3 {
            let length = corners[k].distance(corners[(k + 1) % 3]);
            if length > 0.0 {
                visit(length);
            }
        }
    }
}
