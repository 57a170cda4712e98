//! What ingest says about itself.

use serde::Serialize;

use super::partition::Resampled;

/// Figures of one model. Lengths are in lattice steps.
#[derive(Clone, Debug, Default, Serialize)]
pub struct BuildReport {
    /// Bits of the lattice per axis.
    pub bits: u8,
    /// Model units per lattice step.
    pub step: f64,
    /// Vertices of the cleaned mesh.
    pub vertices: usize,
    /// Triangles of the cleaned mesh.
    pub triangles: usize,
    /// Connected components.
    pub components: usize,
    /// Vertices on the boundary.
    pub boundary_vertices: usize,
    /// Whether facing-away tests are off.
    pub is_open: bool,
    /// What `visual` precision did; `None` for `exact`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub resampled: Option<Resampled>,
    /// Chunks that the mesh was cut into.
    pub chunks: u32,
    /// Sweeps of the batched order, over all chunks.
    pub sweeps: u32,
    /// Splits recorded.
    pub splits: usize,
    /// Triangles of the base: the smallest legal triangle limit.
    pub base_triangles: usize,
    /// Vertices of the base.
    pub base_vertices: usize,
    /// Components in the base.
    pub base_components: usize,
    /// Components that are spawned.
    pub spawns: usize,
    /// Triangles that spawns insert.
    pub spawn_triangles: usize,
    /// Smallest error of a split that is not zero, and the largest; zeros without such splits.
    pub error_range: [f32; 2],
    /// Splits with an error of exactly zero.
    pub zero_error_splits: usize,
    /// Ops on the longest chain of parents.
    pub depth: u32,
    /// Splits by number of distinct parents, 0 to 3.
    pub parents: [u64; 4],
    /// Mean number of distinct parents.
    pub mean_parents: f64,
    /// Mean valence of the split vertex before the split.
    pub mean_valence: f64,
    /// Where the time went.
    pub timings: Timings,
}

/// Wall time by stage, in seconds.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Timings {
    /// Cleaning, lattice, chunks.
    pub partition: f64,
    /// Collapses.
    pub simplify: f64,
    /// Ids and records.
    pub assemble: f64,
}

/// What ingest is doing.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Stage {
    /// Cleaning, lattice, chunks.
    Partition,
    /// Collapsing.
    Simplify,
    /// Making records.
    Assemble,
    /// Writing the pack.
    Write,
}

/// How far ingest is.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Progress {
    /// What it is doing.
    pub stage: Stage,
    /// Share of that stage, 0 to 1.
    pub fraction: f32,
}
