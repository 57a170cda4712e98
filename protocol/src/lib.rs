//! What both ends of a Lodestream session must agree on, and nothing else.
//!
//! No I/O, clock, thread or hash-map order lives here, and nothing that both ends must agree on depends on how a float rounds.
//!
//! - [`ids`], [`limits`]: newtypes and the limits on what crosses the wire.
//! - [`quant`]: the integer lattice of a model. [`view`]: what a client wants to see.
//! - [`mesh`]: the replica, the triangle mesh that the ops produce.
//! - [`op`]: the ops, coded against the state that both ends hold. [`cache`]: the mirrored op cache.
//! - [`message`], [`wire`]: control messages and their frames.

pub mod cache;
pub mod ids;
pub mod limits;
pub mod mesh;
pub mod message;
pub mod op;
pub mod quant;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
pub mod time;
pub mod view;
pub mod wire;
