//! Numbers that were learnt from sessions over scans and generated meshes.

use super::cut::MAX_RANKED_VALENCE;

/// Weights of the scores that rank the starts of arcs, by arc length.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CutWeights {
    /// By arc length; the first is of no use.
    pub arcs: [ArcWeights; MAX_RANKED_VALENCE as usize],
}

/// Weights of a score, in 1/256 of what [`CutFeatures`](super::cut::CutFeatures) count; the score is in 1/16 bit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ArcWeights {
    /// On `cut_length`.
    pub cut_length: i32,
    /// On `inner_length`.
    pub inner_length: i32,
    /// On `edge_length`.
    pub edge_length: i32,
    /// On `area`.
    pub area: i32,
    /// On the square of `area` in 1/256.
    pub area_squared: i32,
}

/// Shapes of cuts that the geometry's weights tell apart: closed and open fans by arc length 1 to 6 and more.
pub const CUT_SHAPES: usize = 12;

/// Everything learnt.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Trained {
    /// Weights of cuts.
    pub cut: CutWeights,
    /// By shape of the cut, in 1/256: weights of the arc's centre, the middle of left and right, the centre of the other ring
    /// vertices and the ring's centre, all relative to `s`, in the predicted position.
    pub position: [[i32; 4]; CUT_SHAPES],
    /// By shape: constant in 1/16 octave; then, for all, weights in 1/256 of [`SizeFeatures`](super::geometry::SizeFeatures).
    pub tangent_size: SizeWeights,
    /// Likewise for the residual along the normal.
    pub height_size: SizeWeights,
    /// Where each context starts, as the chance of a 0 in 1/2^16; even odds beyond the end.
    pub priors: &'static [u16],
    /// Likewise for the contexts of the base mesh and of spawned patches.
    pub patch_priors: &'static [u16],
}

/// Weights of the expected logarithm of a residual.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SizeWeights {
    /// Constants by shape of the cut, in 1/16 octave.
    pub constant: [i32; CUT_SHAPES],
    /// Weights of the features, in 1/256.
    pub features: [i32; 6],
}

mod table;

pub use table::TRAINED;
