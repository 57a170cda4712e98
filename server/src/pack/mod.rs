//! The pack: one immutable file per model.

pub mod record;
