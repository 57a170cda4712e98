//! What tests of both ends share: generated [`meshes`] and a CPU rasteriser ([`raster`]) as the oracle for pictures.

pub mod meshes;
pub mod raster;
