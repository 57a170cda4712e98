//! From a clean mesh to a vertex-split DAG: rounds it to a lattice, collapses edge after edge, and has
//! [`hierarchy`](super::hierarchy) turn the collapses into records.
//!
//! `t` goes, `s` stays: where it is with the colour it has (half-edge collapses, the default), or at a place between or near
//! the two that a [`placement`] chooses. The order is `batched` by the planes that are left;
//! what is stored with each op is a measured deviation. All geometry is integer and all floating-point work is `+ - * /` and
//! square roots in a fixed order, so the same input gives the same DAG everywhere.
//!
//! [`surface`] is the connectivity, [`constraint`] says what is legal, [`quadric`] what it costs, [`placement`] where it leads,
//! [`batch`] runs the passes.

mod batch;
mod constraint;
mod lattice;
mod order;
mod placement;
mod quadric;
mod report;
mod surface;
#[cfg(test)]
mod tests;

use std::time::Instant;

use lodestream_protocol::quant::{MAX_LATTICE_BITS, MIN_LATTICE_BITS};

pub use self::placement::PlacementChoice;
pub use self::report::{BuildReport, BuildStage, Progress, Timings};
use self::{
    batch::{Mover, Simplifier},
    surface::Surface,
};
use super::hierarchy::{
    Point,
    components::Components,
    forest::{InCore, assemble},
};
use crate::{mesh::TriMesh, pack::record::Dag};

/// Choices of a build.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BuildOptions {
    /// Bits of the lattice per axis, 8 to 21. `None`: the fewest from 12 on for which a step is at most 1/16 of the mean edge
    /// and half the 1st-percentile edge.
    pub bits: Option<u8>,
    /// Where the vertex that a collapse leaves lies.
    pub placement: PlacementChoice,
}

/// Why a mesh was refused. All but the first two mean that it was not cleaned.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BuildError {
    /// Lattice bits out of range.
    #[error("{0} bits per axis is outside 8 to 21")]
    Bits(u8),
    /// More than 32-bit half-edge ids can number.
    #[error("{vertices} vertices and {faces} faces are too many for one build")]
    TooLarge {
        /// Vertices of the mesh.
        vertices: usize,
        /// Faces of the mesh.
        faces: usize,
    },
    /// A coordinate is infinite or not a number.
    #[error("vertex {vertex} has a coordinate that is not finite")]
    NotFinite {
        /// Index of the vertex.
        vertex: usize,
    },
    /// There is not one colour per vertex.
    #[error("{colors} colours for {vertices} vertices")]
    ColorCount {
        /// Colours given.
        colors: usize,
        /// Vertices of the mesh.
        vertices: usize,
    },
    /// A corner is no vertex.
    #[error("face {face} refers to vertex {vertex}, which does not exist")]
    NoSuchVertex {
        /// Index of the face.
        face: usize,
        /// The corner.
        vertex: u32,
    },
    /// A face has the same vertex twice.
    #[error("face {face} has a repeated corner")]
    RepeatedCorner {
        /// Index of the face.
        face: usize,
    },
    /// A directed edge belongs to two faces.
    #[error("two faces have an edge from vertex {from} to vertex {to}")]
    RepeatedEdge {
        /// Start of the edge.
        from: u32,
        /// End of the edge.
        to: u32,
    },
    /// The faces at a vertex are not one fan.
    #[error("the faces at vertex {vertex} form several fans")]
    SeveralFans {
        /// Index of the vertex.
        vertex: u32,
    },
}

/// Builds the vertex-split DAG of a clean mesh: each directed edge in at most one face, one fan at each vertex, no repeated
/// corner. Boundaries, any number of components, faces without area, coincident vertices and the empty mesh are all fine;
/// vertices without faces are left out.
///
/// Complete refinement of the result gives exactly the faces of `mesh` with positions rounded to `Dag::lattice`. Costs
/// about 2 microseconds and 320 bytes per triangle. `progress` is called between passes.
///
/// # Errors
/// [`BuildError`] names the first thing about the mesh or the options that will not do.
pub fn build(
    mesh: &TriMesh,
    options: &BuildOptions,
    progress: &mut dyn FnMut(Progress),
) -> Result<(Dag, BuildReport), BuildError> {
    let started = Instant::now();
    let mut timings = Timings::default();
    let mut tell = |stage, fraction| progress(Progress { stage, fraction });
    tell(BuildStage::Prepare, 0.0);
    check(mesh, options)?;
    let lattice = lattice::choose(mesh, options.bits)?;
    let (mut points, faces) = order::by_place(&lattice::round(mesh, &lattice), &mesh.faces, lattice.bits);
    let surface = match Surface::new(points.len(), &faces) {
        Ok(surface) => surface,
        // Said again in the caller's numbering.
        Err(error) => return Err(Surface::new(mesh.positions.len(), &mesh.faces).err().unwrap_or(error)),
    };
    for (v, point) in (0..).zip(&mut points) {
        point.is_boundary = surface.is_boundary(v);
    }
    let components = Components::new(&points, &faces);
    drop(faces);
    let is_open = is_open(&surface, &points);
    timings.prepare = started.elapsed().as_secs_f64();

    tell(BuildStage::Simplify, 0.0);
    let has_colors = mesh.colors.is_some();
    let boundary_vertices = points.iter().filter(|p| p.is_boundary).count();
    let max_coordinate = lattice.max_coordinate();
    let mover = options.placement.rule().map(|rule| Mover { rule, max_coordinate });
    let mut simplifier = Simplifier::new(surface, points, has_colors, mover);
    timings.initialize = started.elapsed().as_secs_f64() - timings.prepare;
    simplifier.run(&mut |fraction| tell(BuildStage::Simplify, fraction));
    let simplified_at = started.elapsed().as_secs_f64();
    timings.simplify = simplified_at - timings.prepare - timings.initialize;

    tell(BuildStage::Assemble, 0.0);
    let (dag, shape) = assemble(&InCore {
        lattice,
        has_colors,
        is_open,
        points: &simplifier.points,
        components: &components,
        root_faces: &simplifier.root_faces(),
        collapses: &simplifier.collapses,
        carried: &simplifier.carried,
        removed_by: &simplifier.removed_by,
    });
    timings.total = started.elapsed().as_secs_f64();
    timings.assemble = timings.total - simplified_at;
    tell(BuildStage::Assemble, 1.0);

    let splits = dag.splits.len();
    let mean = |sum: u64| if splits == 0 { 0.0 } else { sum as f64 / splits as f64 };
    let errors = || dag.splits.iter().map(|split| split.bounds.error);
    let smallest = errors().filter(|error| error.0 > 0).min().unwrap_or_default();
    let report = BuildReport {
        bits: lattice.bits,
        step: lattice.step,
        vertices: mesh.positions.len(),
        triangles: mesh.faces.len(),
        components: components.count(),
        boundary_vertices,
        is_open,
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
        mean_valence: mean(simplifier.valence_sum),
        timings,
    };
    Ok((dag, report))
}

fn check(mesh: &TriMesh, options: &BuildOptions) -> Result<(), BuildError> {
    if let Some(bits) = options.bits.filter(|bits| !(MIN_LATTICE_BITS..=MAX_LATTICE_BITS).contains(bits)) {
        return Err(BuildError::Bits(bits));
    }
    match &mesh.colors {
        Some(colors) if colors.len() != mesh.positions.len() => {
            return Err(BuildError::ColorCount { colors: colors.len(), vertices: mesh.positions.len() });
        }
        _ => {}
    }
    surface::check_indices(mesh.positions.len(), &mesh.faces)
}

/// Whether so much boundary is there that the inside can be seen: more than twice the side of a square of the surface's area.
/// A sheet has at least 3.5 times that; the bunny with its holes at the bottom stays below.
fn is_open(surface: &Surface, points: &[Point]) -> bool {
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
