//! Moving frames between client and server. Nothing here looks into a frame.
//!
//! - [`target`]: addresses of models. [`link`]: a slower link, as arithmetic.
//! - `native`: the WebSocket over tokio (feature `net-native`).

pub mod link;
#[cfg(feature = "net-native")]
pub mod native;
pub mod target;
