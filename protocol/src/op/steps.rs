//! Coarse coordinates of models with `visual` precision: most of their vertices have two coordinates that are multiples of
//! the model's step, and the third, along the axis that the surface there faces most, is exact.
//!
//! Nothing marks such a vertex but its coordinates: the encoder looks for two that are multiples, and says which axis is
//! left over.

use super::fixed::lg;
use super::local::Ring;
use super::range_coder::{BitCoder, NumberModel, Prob, ScaledSet, contexts};

/// Adaptive contexts of coarse coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct StepModels {
    /// By whether `s` is coarse, and whether its fan is closed.
    is_coarse: [[Prob; 2]; 2],
    /// Whether the exact axis is the fan's, by how much more the fan faces it than the next one.
    is_fans_axis: [Prob; AXIS_CLASSES],
    /// Whether it is the next one, by how much more the fan faces that than the last one.
    is_next_axis: [Prob; AXIS_CLASSES],
    pub(super) across: ScaledSet,
    pub(super) along: ScaledSet,
    pub(super) escape: NumberModel,
}

contexts!(StepModels: is_coarse, is_fans_axis, is_next_axis, across, along, escape);

/// Quarter octaves that are told apart.
const AXIS_CLASSES: usize = 8;

/// In what the coordinates of a vertex are coded.
#[derive(Clone, Copy, Debug)]
pub(super) struct Grid {
    /// The two axes across, then the one along which heights are exact.
    pub(super) axes: [usize; 3],
    /// Lattice steps of a unit across; 1 for a vertex that is exact.
    pub(super) unit: i32,
}

impl StepModels {
    pub(crate) const NEW: Self = Self {
        is_coarse: [[Prob::HALF; 2]; 2],
        is_fans_axis: [Prob::HALF; AXIS_CLASSES],
        is_next_axis: [Prob::HALF; AXIS_CLASSES],
        across: ScaledSet::NEW,
        along: ScaledSet::NEW,
        escape: NumberModel::NEW,
    };

    /// Codes the grid of a vertex at `position` that is split off where the ring is.
    pub(super) fn grid(
        &mut self,
        coder: &mut impl BitCoder,
        step: i32,
        is_closed: bool,
        ring: &Ring,
        position: [i32; 3],
    ) -> Grid {
        let [_, _, h] = ring.axes;
        let facing = |k: usize| u64::from(ring.normal[k].unsigned_abs());
        let (next, last) = match h {
            0 => (1, 2),
            1 => (0, 2),
            _ => (0, 1),
        };
        let (next, last) = if facing(last) > facing(next) { (last, next) } else { (next, last) };
        let is_coarse = |p: [i32; 3]| [h, next, last].into_iter().find(|&axis| is_coarse(p, axis, step));
        let found = is_coarse(position);
        let context = [usize::from(is_coarse(ring.origin).is_some()), usize::from(is_closed)];
        if !coder.bit(&mut self.is_coarse[context[0]][context[1]], found.is_some()) {
            return Grid { axes: ring.axes, unit: 1 };
        }
        let class = |more: usize, less: usize| {
            ((lg(facing(more)) - lg(facing(less))) / 4).clamp(0, AXIS_CLASSES as i32 - 1) as usize
        };
        let axis = if coder.bit(&mut self.is_fans_axis[class(h, next)], found == Some(h)) {
            h
        } else if coder.bit(&mut self.is_next_axis[class(next, last)], found == Some(next)) {
            next
        } else {
            last
        };
        let axes = match axis {
            0 => [1, 2, 0],
            1 => [0, 2, 1],
            _ => [0, 1, 2],
        };
        Grid { axes, unit: step }
    }
}

/// Whether the coordinates but that of `axis` are multiples of the step.
fn is_coarse(position: [i32; 3], axis: usize, step: i32) -> bool {
    (0..3).all(|k| k == axis || position[k] % step == 0)
}
