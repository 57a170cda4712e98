//! The Lodestream client: it holds the current mesh of one model and applies what the server sends.
//!
//! - [`core`]: the session as a plain state machine, without I/O or a clock.

pub mod core;
