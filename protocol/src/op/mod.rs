//! Ops and their coding.
//!
//! An op is one change to the replica: a vertex split, an edge collapse, a spawn of a component or its reverse. Ops are
//! coded against the state that both ends hold alike ([`OpState`]) and applied as they are coded, so no id crosses the wire.
//! `PROTOCOL.md` describes the layout.

mod batch;
mod color;
mod cut;
mod fixed;
mod geometry;
mod local;
mod observe;
mod patch;
mod range_coder;
mod steps;
mod trained;
#[cfg(any(test, feature = "testing"))]
pub mod training;

#[cfg(any(test, feature = "testing"))]
pub use batch::{decode_batch_stepwise, decode_batch_tallied, random_batch};
#[cfg(any(test, feature = "testing"))]
pub use patch::decode_base_tallied;

pub use batch::{
    BatchEncoder, DecodeError, OpCounts, OpState, SavedContexts, decode_batch, decode_batch_measured,
    decode_batch_traced, encode_trace,
};
pub use cut::{CutFeatures, MAX_RANKED_VALENCE};
pub use geometry::{GeometryFeatures, SizeFeatures};
pub use observe::{BatchTrace, Breakdown, Part};
pub use patch::{CanonicalOrder, PatchDecodeError, canonical_order, decode_base, encode_base};
pub use trained::{ArcWeights, CUT_SHAPES, CutWeights, SizeWeights, TRAINED, Trained};
