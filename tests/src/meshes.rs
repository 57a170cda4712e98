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

use lodestream_server::mesh::TriMesh;

/// One mesh of every kind that matters to a session, by name.
pub fn every_topology() -> Vec<(&'static str, TriMesh)> {
    vec![
        ("empty", empty()),
        ("single triangle", single_triangle()),
        ("tetrahedron", tetrahedron()),
        ("cube", cube()),
        ("sphere", icosphere(4)),
        ("torus", torus(40, 20)),
        ("genus 4", genus(4, 4)),
        ("grid", grid(30, 20)),
        ("grid with holes", grid_with_holes(2, 6)),
        ("open cylinder", cylinder_open(24, 12)),
        ("disk", disk(24, 6)),
        ("components", many_components(60, 1)),
        ("noise", noisy_sphere(3000, 2)),
        ("colours", colored_sphere(4)),
        ("painted plane", painted_plane(24)),
        ("slivers", sliver_strip(60)),
        ("zero-area faces", with_zero_area_faces(3)),
        ("bow-tie", bow_tie()),
        ("moebius", moebius()),
        ("three on an edge", three_on_an_edge()),
    ]
}

#[cfg(test)]
mod tests;
