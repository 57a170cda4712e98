//! From a mesh file to a vertex-split DAG: read, clean, simplify, hierarchy; beside them the generated [`sample`].

#[allow(dead_code)]
pub(crate) mod chunks;
pub mod clean;
pub mod hierarchy;
mod in_order;
#[allow(dead_code)]
pub mod raw;
pub mod read;
pub mod sample;
pub mod simplify;
#[allow(dead_code)]
pub mod spill;

use self::clean::CleanReport;
use self::simplify::{BuildError, BuildOptions, BuildReport, Progress, build};
use crate::mesh::TriMesh;
use crate::pack::CompleteMesh;
use crate::pack::record::Dag;

/// Edges whose faces meet at a larger angle than this are drawn sharp, in degrees, unless a model says otherwise: the
/// edges of machined parts stay crisp, the noise of scans is smoothed.
pub const DEFAULT_CREASE_ANGLE_DEG: f32 = 45.0;

/// What became of a mesh on its way to a pack.
#[derive(Debug)]
pub struct Ingested {
    /// The DAG.
    pub dag: Dag,
    /// The cleaned mesh on its lattice, in figures: what complete refinement must give back.
    pub complete: CompleteMesh,
    /// What cleaning did.
    pub cleaned: CleanReport,
    /// What building did.
    pub built: BuildReport,
}

/// Cleans and builds a mesh. `progress` is called between the passes of the simplification.
///
/// # Errors
/// [`BuildError`] for options out of range, or a mesh too large.
pub fn ingest(
    mesh: TriMesh,
    options: &BuildOptions,
    progress: &mut dyn FnMut(Progress),
) -> Result<Ingested, BuildError> {
    let (mesh, cleaned) = clean::clean(mesh);
    let (dag, built) = build(&mesh, options, progress)?;
    let positions: Vec<[i32; 3]> = mesh.positions.iter().map(|&p| dag.lattice.quantize(p)).collect();
    let complete = CompleteMesh::of(&positions, mesh.colors.as_deref(), &mesh.faces);
    Ok(Ingested { dag, complete, cleaned, built })
}
