//! From a mesh file to a vertex-split DAG: read, clean, simplify, hierarchy; beside them the generated [`sample`].

pub mod sample;
