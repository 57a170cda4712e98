//! From a chunked mesh to a sequence of collapses, which [`hierarchy`](super::hierarchy) turns into a vertex-split DAG.
//!
//! `t` goes, `s` stays: where it is with the colour it has (half-edge collapses, the default), or at a place between or near
//! the two that a [`placement`] chooses. The order is `batched` by the planes that are left;
//! what is stored with each op is a measured deviation. All geometry is integer and all floating-point work is `+ - * /` and
//! square roots in a fixed order, so the same input gives the same DAG everywhere.
//!
//! [`surface`] is the connectivity, [`constraint`] says what is legal, [`quadric`] what it costs, [`placement`] where it leads,
//! [`batch`] runs the passes over one [`part`], [`measure`] records what they did, [`tree`] leads from chunk to chunk.

mod batch;
mod constraint;
#[cfg(test)]
pub(super) mod lattice;
mod measure;
#[cfg(test)]
mod order;
mod part;
mod placement;
mod quadric;
mod surface;
#[cfg(test)]
mod tests;
mod tree;

use self::batch::Mover;
pub use self::placement::PlacementChoice;
pub(crate) use self::tree::simplify;
use super::hierarchy::paper::{ErrorRule, Rules};
pub use super::partition::Precision;

/// Choices of a build.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BuildOptions {
    /// Bits of the lattice per axis, 8 to 21. `None`: the fewest from 12 on for which a step is at most 1/16 of the mean edge
    /// and half the 1st-percentile edge.
    pub bits: Option<u8>,
    /// Where the vertex that a collapse leaves lies.
    pub placement: PlacementChoice,
    /// Vertices that are this close together, in model units, are joined, one after the other; 0 for none but those at one place.
    pub weld_tolerance: f64,
    /// Whether vertices may slide along the surface.
    pub precision: Precision,
    /// What ops wait for, what their spheres bound, what their errors are.
    pub rules: Rules,
}

impl BuildOptions {
    /// How collapses are chosen and measured on a lattice with this largest coordinate.
    pub(crate) fn method(&self, max_coordinate: i32) -> Method {
        Method { mover: self.placement.mover(max_coordinate), error: self.rules.error }
    }
}

/// How collapses are chosen and measured.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Method {
    /// `None`: vertices that stay do not move.
    mover: Option<Mover>,
    error: ErrorRule,
}
