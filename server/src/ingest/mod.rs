//! From a mesh file to a vertex-split DAG: read, clean, simplify, hierarchy.

pub mod clean;
pub mod hierarchy;
pub mod read;
pub mod simplify;
