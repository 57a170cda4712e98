//! The integer lattice on which every position of a model lies.

use serde::{Deserialize, Serialize};

/// Fewest bits per axis that a model may use.
pub const MIN_LATTICE_BITS: u8 = 8;
/// Most bits per axis: products of three coordinate differences then stay exact in `f64`.
pub const MAX_LATTICE_BITS: u8 = 21;

/// Maps model coordinates to integers in `0 ..= 2^bits - 1` on each axis and back.
///
/// The step is the same on all axes: `extent / (2^bits - 1)` with `extent` the longest side of the model's box. Rounding
/// moves a position by at most half a step along each axis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lattice {
    /// Model coordinates of lattice point (0, 0, 0). In `f64`, so that survey coordinates in the millions keep their
    /// millimetres.
    pub origin: [f64; 3],
    /// Model units per lattice step, positive and finite.
    pub step: f64,
    /// Bits per axis, [`MIN_LATTICE_BITS`] to [`MAX_LATTICE_BITS`].
    pub bits: u8,
}

impl Lattice {
    /// The lattice of the box `min ..= max` in model units. A box without extent gets a step of 1.
    pub fn of_box(min: [f64; 3], max: [f64; 3], bits: u8) -> Self {
        assert!((MIN_LATTICE_BITS..=MAX_LATTICE_BITS).contains(&bits), "callers check the bits");
        let extent = (0..3).map(|k| max[k] - min[k]).fold(0.0, f64::max);
        let steps = f64::from((1u32 << bits) - 1);
        let step = if extent > 0.0 && (extent / steps).is_normal() { extent / steps } else { 1.0 };
        Self { origin: min, step, bits }
    }

    /// Whether the numbers could have come from [`Lattice::of_box`].
    pub fn is_valid(&self) -> bool {
        (MIN_LATTICE_BITS..=MAX_LATTICE_BITS).contains(&self.bits)
            && self.step.is_finite()
            && self.step > 0.0
            && self.origin.iter().all(|x| x.is_finite())
    }

    /// Largest coordinate of a lattice point.
    pub fn max_coordinate(&self) -> i32 {
        (1i32 << self.bits) - 1
    }

    /// Nearest lattice point, clamped to the lattice.
    pub fn quantize(&self, p: [f64; 3]) -> [i32; 3] {
        let max = f64::from(self.max_coordinate());
        std::array::from_fn(|k| ((p[k] - self.origin[k]) / self.step).round().clamp(0.0, max) as i32)
    }

    /// Model coordinates of a lattice point.
    pub fn position(&self, q: [i32; 3]) -> [f64; 3] {
        std::array::from_fn(|k| self.origin[k] + f64::from(q[k]) * self.step)
    }

    /// Lattice coordinates, not rounded, of a point in model units.
    pub fn to_lattice(&self, p: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|k| (p[k] - self.origin[k]) / self.step)
    }
}
