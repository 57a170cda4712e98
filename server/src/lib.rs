//! Lodestream's server: ingests meshes into vertex-split DAGs and streams them.
//!
//! Layers, lowest first; a module uses only what stands above it in this list:
//! [`mesh`] (ingest-time geometry), [`pack`] (the file), then side by side [`ingest`], [`repository`] and [`session`], then
//! [`judge`] and [`picture`], [`runtime`], [`http`] and [`cli`]. [`config`] and [`telemetry`] serve the last three.

pub mod cli;
pub mod config;
pub mod http;
pub mod ingest;
pub mod judge;
pub mod mesh;
pub mod pack;
pub mod picture;
pub mod repository;
pub mod runtime;
pub mod session;
pub mod telemetry;
