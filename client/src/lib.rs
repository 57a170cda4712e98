//! The Lodestream client: it holds the current mesh of one model and applies what the server sends.
//!
//! - [`core`]: the session as a plain state machine, without I/O or a clock.
//! - [`camera`]: pose and lens, the view that the server gets, the matrix that the renderer draws with.
//! - [`net`]: addresses, the WebSocket, simulated slow links.
//! - `render`: the wgpu renderer (feature `render`).
//! - `app`: what joins them: the offscreen client of `lodestream snapshot` (feature `net-native`), the viewer (`viewer`, `web`).
//! - `load`: many clients without a picture, and what they measured: `lodestream load` (feature `net-native`).

#[cfg(any(feature = "net-native", feature = "viewer"))]
pub mod app;
pub mod camera;
pub mod core;
#[cfg(test)]
mod fake_server;
#[cfg(feature = "net-native")]
pub mod load;
pub mod net;
#[cfg(feature = "render")]
pub mod render;
