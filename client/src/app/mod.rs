//! Where camera, core, net and render meet: whole clients.
//!
//! - [`viewer`]: what a person sees and does, without a window (feature `viewer`). `web`: it in a browser (feature `web`).
//! - `window`: it in a native window (feature `window`): `lodestream view`.
//! - `drive`: the loop that joins a session and a connection (feature `net-native`, as all below).
//! - `snapshot`: connects, streams, writes files and ends: `lodestream snapshot`.
//! - `ply`, `file`: the received mesh as a PLY file; files that are complete or absent.

#[cfg(feature = "net-native")]
pub mod drive;
#[cfg(feature = "net-native")]
pub mod file;
#[cfg(feature = "net-native")]
pub mod ply;
#[cfg(feature = "net-native")]
pub mod snapshot;
#[cfg(feature = "viewer")]
pub mod viewer;
#[cfg(all(feature = "web", target_arch = "wasm32"))]
pub mod web;
#[cfg(feature = "window")]
pub mod window;
