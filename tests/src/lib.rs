//! What tests of both ends share: generated [`meshes`], models built from them ([`model`]), dull twins ([`naive`]), virtual
//! links ([`sim`]), real binaries ([`server_process`]), a
//! [`proxy`] that loses connections, a plain [`mod@reference`] of the codec, fuzz targets ([`fuzz`]), random sessions ([`soak`]) and a CPU rasteriser ([`raster`]) as the oracle for pictures.

pub mod fuzz;
pub mod meshes;
pub mod model;
pub mod naive;
pub mod proxy;
pub mod raster;
pub mod reference;
pub mod screen_error;
pub mod server_process;
pub mod sim;
pub mod soak;
pub mod source;
pub mod traces;
