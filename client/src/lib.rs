//! x
#[cfg(feature = "render")]
pub mod render;
