//! From a mesh file to a vertex-split DAG: read, clean, simplify, hierarchy; beside them the generated [`sample`].

pub mod clean;
pub mod hierarchy;
pub mod read;
pub mod sample;
pub mod simplify;
