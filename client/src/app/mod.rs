//! Where camera, core and net meet: whole clients.
//!
//! - [`drive`]: the loop that joins a session and a connection.
//! - [`snapshot`]: connects, streams, writes files and ends: `lodestream snapshot`.
//! - [`ply`], [`file`](mod@file): the received mesh as a PLY file; files that are complete or absent.

pub mod drive;
pub mod file;
pub mod ply;
pub mod snapshot;
