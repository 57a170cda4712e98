//! What both ends of a Lodestream session must agree on, and nothing else.
//!
//! No I/O, clock, thread or hash-map order lives here, and nothing that both ends must agree on depends on a float.

pub mod ids;
pub mod quant;
