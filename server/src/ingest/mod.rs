//! From a mesh file to a vertex-split DAG: [`read`], [`partition`](mod@partition), [`simplify`](mod@simplify), [`hierarchy`]; beside them the
//! generated [`sample`].
//!
//! No stage holds the whole model: what is too long waits in a [`spill`]. Every stage gives the same on any number of threads
//! and in any memory.

pub(crate) mod chunks;
pub mod clean;
pub mod hierarchy;
mod in_order;
pub(crate) mod partition;
pub mod raw;
pub mod read;
pub mod report;
pub mod sample;
pub mod simplify;
pub mod spill;

use std::io::{Cursor, Seek, Write};
use std::time::Instant;

use self::clean::CleanReport;
use self::hierarchy::assembly::{Assembled, Model, assemble};
use self::hierarchy::paper;
pub use self::hierarchy::paper::{Dependencies, ErrorRule, Rules, Spheres};
pub use self::partition::{PartitionError, Precision, Resampled};
use self::partition::{PartitionOptions, partition};
use self::raw::RawMesh;
use self::report::{BuildReport, Progress, Stage, Timings};
use self::simplify::{BuildOptions, simplify};
use self::spill::{SpillError, Workspace};
use crate::mesh::TriMesh;
use crate::pack::{CompleteMesh, Metadata, WriteError};

/// Edges whose faces meet at a larger angle than this are drawn sharp, in degrees, unless a model says otherwise: the
/// edges of machined parts stay crisp, the noise of scans is smoothed.
pub const DEFAULT_CREASE_ANGLE_DEG: f32 = 45.0;

/// Why a mesh did not become a model.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IngestError {
    /// The mesh or the options will not do.
    #[error(transparent)]
    Partition(#[from] PartitionError),
    /// Temporary data could not be kept.
    #[error(transparent)]
    Spill(#[from] SpillError),
    /// The records could not be made.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The system gives no threads.
    #[error("cannot start {threads} threads")]
    Threads {
        /// As many were wanted.
        threads: u32,
        /// What the system says.
        #[source]
        source: rayon::ThreadPoolBuildError,
    },
}

/// A model ready to be written, and what became of the mesh on its way.
#[derive(Debug)]
pub struct Ingested {
    assembled: Assembled,
    pool: rayon::ThreadPool,
    /// The cleaned mesh on its lattice, in figures: what complete refinement must give back.
    pub complete: CompleteMesh,
    /// What cleaning did.
    pub cleaned: CleanReport,
    /// What building did.
    pub built: BuildReport,
}

impl Ingested {
    /// Writes the pack, on the threads that were asked for; see [`pack::write`](fn@crate::pack::write).
    ///
    /// # Errors
    /// As there, and [`SpillError`] in [`WriteError::Source`].
    pub fn write(
        &self,
        metadata: &Metadata,
        out: &mut (impl Write + Seek + Send),
        progress: &(dyn Fn(Progress) + Sync),
    ) -> Result<u64, WriteError> {
        let mut tell = |fraction| progress(Progress { stage: Stage::Write, fraction });
        self.pool.install(|| self.assembled.write(&self.complete, metadata, out, &mut tell))
    }
}

/// Cleans and builds a mesh on `threads` threads, which take about 100 MB each. `progress` may be called from any of them.
///
/// Peak memory is about 9 bytes per vertex (12 with colours), what `workspace` may keep, and 200 MB. Takes about 3
/// microseconds of processor time per triangle.
///
/// # Errors
/// [`IngestError`]; nothing that a mesh holds is refused, but for its size.
pub fn ingest(
    raw: RawMesh,
    options: &BuildOptions,
    workspace: &Workspace,
    threads: u32,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<Ingested, IngestError> {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads.max(1) as usize)
        .build()
        .map_err(|source| IngestError::Threads { threads, source })?;
    let (assembled, complete, cleaned, built) =
        pool.install(|| ingest_in_pool(raw, options, workspace, threads, progress))?;
    Ok(Ingested { assembled, pool, complete, cleaned, built })
}

/// Cleans and builds a mesh that is in memory and writes its pack into memory, on one thread.
///
/// # Errors
/// As [`ingest`].
pub fn ingest_to_vec(
    mesh: &TriMesh,
    options: &BuildOptions,
    metadata: &Metadata,
) -> Result<(Vec<u8>, CleanReport, BuildReport), IngestError> {
    let workspace = Workspace::in_memory();
    let done = ingest(RawMesh::of(mesh, &workspace)?, options, &workspace, 1, &|_| {})?;
    let mut out = Cursor::new(Vec::new());
    done.write(metadata, &mut out, &|_| {})?;
    Ok((out.into_inner(), done.cleaned, done.built))
}

fn ingest_in_pool(
    raw: RawMesh,
    options: &BuildOptions,
    workspace: &Workspace,
    threads: u32,
    progress: &(dyn Fn(Progress) + Sync),
) -> Result<(Assembled, CompleteMesh, CleanReport, BuildReport), IngestError> {
    let tell = |stage, fraction| progress(Progress { stage, fraction });
    let started = Instant::now();
    tell(Stage::Partition, 0.0);
    let partition_options = PartitionOptions::new(options.bits, options.weld_tolerance, options.precision);
    let (mesh, cleaned) =
        partition(raw, &partition_options, workspace, &mut |fraction| tell(Stage::Partition, fraction))?;
    let partitioned_at = started.elapsed().as_secs_f64();

    tell(Stage::Simplify, 0.0);
    let method = options.method(mesh.lattice.max_coordinate());
    let (simplified, figures) =
        simplify(&mesh, method, workspace, threads, &|fraction| tell(Stage::Simplify, fraction))?;
    let simplified = paper::follow(&options.rules, simplified, &mesh.faces, mesh.vertices.len(), workspace)?;
    let simplified_at = started.elapsed().as_secs_f64();

    tell(Stage::Assemble, 0.0);
    let chunks = mesh.chunk_count();
    let boundary_vertices = mesh.vertices.boundary_count();
    let resampled = mesh.resampled;
    let chunks::ChunkedMesh { lattice, has_colors, is_open, vertices, faces, components, complete, .. } = mesh;
    let (vertices, faces) = {
        let counts = (vertices.len(), faces.len());
        // Assembly has tables of its own.
        drop((vertices, faces));
        counts
    };
    let model = Model { lattice, has_colors, is_open, faces: faces as u32, components: &components.components };
    let assembled = assemble(&model, simplified, workspace, &mut |fraction| tell(Stage::Assemble, fraction))?;

    let Assembled { outline, shape, errors, .. } = &assembled;
    let splits = outline.splits as usize;
    let mean = |sum: u64| if splits == 0 { 0.0 } else { sum as f64 / splits as f64 };
    let base = outline.starts[0];
    let built = BuildReport {
        bits: lattice.bits,
        step: lattice.step,
        vertices,
        triangles: faces as usize,
        components: components.components.len(),
        boundary_vertices,
        is_open,
        resampled,
        chunks,
        sweeps: figures.sweeps,
        splits,
        base_triangles: base.face as usize,
        base_vertices: base.vertex as usize,
        base_components: shape.base_components,
        spawns: outline.spawns.len(),
        spawn_triangles: outline.faces.len() - base.face as usize,
        error_range: [errors.smallest.decode(), errors.largest.decode()],
        zero_error_splits: errors.zeros as usize,
        depth: shape.depth,
        parents: shape.parents,
        mean_parents: mean((0..4u64).zip(shape.parents).map(|(count, splits)| count * splits).sum()),
        mean_valence: mean(figures.valence_sum),
        timings: Timings {
            partition: partitioned_at,
            simplify: simplified_at - partitioned_at,
            assemble: started.elapsed().as_secs_f64() - simplified_at,
        },
    };
    Ok((assembled, complete, cleaned, built))
}
