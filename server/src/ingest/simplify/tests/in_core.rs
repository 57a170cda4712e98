//! The whole way in one piece and in memory: the dull twin of partition, chunks and assembly.

use super::super::{
    BuildOptions,
    batch::{Simplifier, State},
    lattice, order,
    surface::{Surface, SurfaceError},
};
use crate::ingest::hierarchy::{
    Point,
    components::Components,
    forest::{InCore, assemble},
};
use crate::ingest::report::{BuildReport, Timings};
use crate::mesh::TriMesh;
use crate::pack::record::Dag;

/// Builds the vertex-split DAG of a clean mesh: each directed edge in at most one face, one fan at each vertex, no repeated
/// corner. Boundaries, any number of components, faces without area, coincident vertices and the empty mesh are all fine;
/// vertices without faces are left out.
///
/// # Errors
/// [`SurfaceError`] names the first thing about the mesh or the options that will not do.
pub(super) fn build(mesh: &TriMesh, options: &BuildOptions) -> Result<(Dag, BuildReport), SurfaceError> {
    Surface::new(mesh.positions.len(), &mesh.faces)?;
    let lattice = lattice::choose(mesh, options.bits);
    let (mut points, faces) = order::by_place(&lattice::round(mesh, &lattice), &mesh.faces, lattice.bits);
    let surface = Surface::new(points.len(), &faces)?;
    for (v, point) in (0..).zip(&mut points) {
        point.is_boundary = surface.is_boundary(v);
    }
    let components = Components::new(&points, &faces);
    drop(faces);
    let is_open = is_open(&surface, &points);
    let has_colors = mesh.colors.is_some();
    let boundary_vertices = points.iter().filter(|p| p.is_boundary).count();
    let method = options.method(lattice.max_coordinate());
    let state = State::of_originals(&surface, points, has_colors);
    let mut simplifier = Simplifier::new(surface, state, method, 0);
    simplifier.run(&mut |_| {});
    let (dag, shape) = assemble(&InCore {
        lattice,
        has_colors,
        is_open,
        points: &simplifier.points,
        components: &components,
        root_faces: &simplifier.root_faces(),
        collapses: &simplifier.measurer.collapses,
        carried: &simplifier.measurer.carried,
        removed_by: &simplifier.removed_by,
    });
    let splits = dag.splits.len();
    let mean = |sum: u64| if splits == 0 { 0.0 } else { sum as f64 / splits as f64 };
    let errors = || dag.splits.iter().map(|split| split.bounds.error);
    let smallest = errors().filter(|error| error.0 > 0).min().unwrap_or_default();
    let report = BuildReport {
        resampled: None,
        bits: lattice.bits,
        step: lattice.step,
        vertices: mesh.positions.len(),
        triangles: mesh.faces.len(),
        components: components.count(),
        boundary_vertices,
        is_open,
        chunks: 1,
        sweeps: simplifier.sweeps,
        splits,
        base_triangles: dag.base.faces.len(),
        base_vertices: dag.base.positions.len(),
        base_components: shape.base_components,
        spawns: dag.spawns.len(),
        spawn_triangles: dag.spawns.iter().map(|spawn| spawn.patch.faces.len()).sum(),
        error_range: [smallest.decode(), errors().max().unwrap_or_default().decode()],
        zero_error_splits: errors().filter(|error| error.0 == 0).count(),
        depth: shape.depth,
        parents: shape.parents,
        mean_parents: mean((0..4u64).zip(shape.parents).map(|(count, splits)| count * splits).sum()),
        mean_valence: mean(simplifier.measurer.valence_sum),
        timings: Timings::default(),
    };
    Ok((dag, report))
}

/// Whether so much boundary is there that the inside can be seen: more than twice the side of a square of the surface's area.
/// A sheet has at least 3.5 times that; the bunny with its holes at the bottom stays below.
pub(super) fn is_open(surface: &Surface, points: &[Point]) -> bool {
    let at = |v: u32| points[v as usize].at();
    let (mut boundary, mut area) = (0.0, 0.0);
    for face in 0..surface.face_count() as u32 {
        let [a, b, c] = surface.corners(face).map(at);
        area += (b - a).cross(c - a).length() * 0.5;
        for h in 3 * face..3 * face + 3 {
            if surface.twin(h).is_none() {
                boundary += at(surface.origin(h)).distance(at(surface.target(h)));
            }
        }
    }
    boundary * boundary > 4.0 * area
}
