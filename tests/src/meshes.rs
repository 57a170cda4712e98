//! Generated meshes for property tests, each with known counts and topology.
//!
//! *Clean* means: every directed edge occurs at most once and the faces around each vertex form a single fan, closed or
//! open; [`defect`] checks it. Unless it says otherwise a mesh here is clean, has no colours, uses every vertex, and its
//! faces are counter-clockwise from outside (from +y for flat ones). Everything is deterministic.

mod shapes;
mod topology;
mod troubled;

pub use shapes::{
    annulus, cube, cylinder_open, disk, double_torus, empty, genus, grid, grid_with_holes, icosphere, single_triangle,
    sphere, tetrahedron, torus,
};
pub use topology::{Topology, defect, topology};
pub use troubled::{
    bow_tie, colored_sphere, crack, debris, many_components, moebius, noisy_sphere, painted_plane, sliver_strip,
    three_on_an_edge, with_zero_area_faces,
};

#[cfg(test)]
mod tests;
