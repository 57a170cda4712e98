//! Ops and their coding.
//!
//! An op is one change to the replica: a vertex split, an edge collapse, a spawn of a component or its reverse. Ops are
//! coded against the state that both ends hold alike ([`OpState`]) and applied as they are coded, so no id crosses the wire.
//! `PROTOCOL.md` describes the layout.

mod batch;
mod geometry;
mod patch;
mod range_coder;

pub use batch::{BatchEncoder, DecodeError, OpCounts, OpState, decode_batch};
pub use patch::{CanonicalOrder, PatchDecodeError, canonical_order, decode_base, encode_base};
