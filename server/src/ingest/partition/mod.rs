//! From a raw mesh to a [`ChunkedMesh`]: welded, oriented, cut where it is not manifold, rounded to its lattice, numbered along
//! the Morton curve and dealt out to chunks, without ever holding the whole.
//!
//! Means what [`clean`](super::clean::clean) followed by rounding means, and reports the same counts; only how one-sided patches
//! are laid out may differ. Works in passes, each from temporary data to temporary data:
//!
//! 1. [`scan`]: which vertices count.
//! 2. [`sort`]: vertices along the curve, equal ones joined. From here on a vertex is a number.
//!    [`near`] joins those that are almost equal, on request.
//! 3. [`faces`]: ranges of numbers become chunks, and each face goes to the chunks of its corners.
//! 4. [`survey`]: each chunk, in memory, drops duplicates and looks around each of its vertices.
//! 5. [`orient`] if faces disagree, [`trouble`] if something is not manifold: both see only what the survey found.
//! 6. [`lattice`], [`finish`]: rounding, components, figures.
//!
//! In memory are 4 to 8 bytes for each vertex of the input until the survey is done (16 while near vertices are joined), then those
//! of [`VertexTable`](super::chunks::VertexTable). The result does not depend on threads or on the memory that spills may use.

mod bits;
mod faces;
mod finish;
mod lattice;
mod local;
mod near;
mod orient;
mod resample;
mod runs;
mod scan;
mod sort;
mod stars;
mod survey;
#[cfg(test)]
mod tests;
mod trouble;

use lodestream_protocol::quant::{Lattice, MAX_LATTICE_BITS, MIN_LATTICE_BITS};

use self::bits::Bits;
use self::faces::{Face, Ranges};
use self::lattice::EdgeLengths;
#[cfg(test)]
pub(crate) use self::lattice::MIN_DEFAULT_BITS;
pub use self::resample::{Precision, Resampled};
use self::runs::{Runs, in_order};
use self::scan::Extent;
use self::stars::Stars;
use self::survey::{Trouble, survey};
use super::chunks::{ChunkedMesh, MAX_CHUNK_FACES};
use super::clean::CleanReport;
use super::raw::RawMesh;
use super::spill::{Spill, SpillError, SpillWriter, Workspace};
use crate::ingest::read::MAX_TRIANGLES;

/// Choices of a partition.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PartitionOptions {
    /// Bits of the lattice per axis, 8 to 21. `None`: the fewest from 12 on for which a step is at most 1/16 of the mean edge
    /// and half the 1st-percentile edge.
    pub(crate) bits: Option<u8>,
    /// Vertices that are this close together, in model units, are joined, one after the other; 0 for none.
    pub(crate) weld_tolerance: f64,
    pub(crate) precision: Precision,
    /// Anything but the default is for tests.
    pub(crate) limits: Limits,
}

impl PartitionOptions {
    pub(crate) fn new(bits: Option<u8>, weld_tolerance: f64, precision: Precision) -> Self {
        Self { bits, weld_tolerance, precision, ..Self::default() }
    }
}

/// How much is in memory at once.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limits {
    /// Vertices that are sorted in memory.
    pub(crate) vertices: u64,
    /// Faces of a chunk.
    pub(crate) faces: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self { vertices: 1 << 18, faces: MAX_CHUNK_FACES }
    }
}

/// Why a mesh was not partitioned.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PartitionError {
    /// Temporary data could not be kept.
    #[error(transparent)]
    Spill(#[from] SpillError),
    /// Lattice bits out of range.
    #[error("{0} bits per axis is outside 8 to 21")]
    Bits(u8),
    /// The welding tolerance is negative, infinite or not a number.
    #[error("a welding tolerance of {0} is no distance")]
    Tolerance(f64),
    /// More than 32-bit half-edge ids can number.
    #[error("{vertices} vertices and {faces} faces are too many for one model")]
    TooLarge {
        /// Vertices of the mesh.
        vertices: u64,
        /// Faces of the mesh.
        faces: u64,
    },
    /// There is not one colour per vertex.
    #[error("{colors} colours for {vertices} vertices")]
    ColorCount {
        /// Colours given.
        colors: u64,
        /// Vertices of the mesh.
        vertices: u64,
    },
}

/// Partitions a mesh. `progress` gets the share of the work that is done, 0 to 1.
///
/// Costs some 0.3 microseconds for each triangle, 9 to 13 bytes of memory for each vertex and at most some 200 MB beside them, and
/// 60 bytes of temporary data for each triangle. A mesh that is nowhere manifold costs memory in proportion to what is wrong
/// with it, one with inconsistent orientation 4 bytes for each face.
///
/// # Errors
/// [`PartitionError`]; nothing that a mesh holds is refused but for its size.
pub(crate) fn partition(
    raw: RawMesh,
    options: &PartitionOptions,
    workspace: &Workspace,
    progress: &mut dyn FnMut(f32),
) -> Result<(ChunkedMesh, CleanReport), PartitionError> {
    check(&raw, options)?;
    let (vertices_before, triangles_before) = (raw.positions.len(), raw.faces.len());
    let usage = scan::usage(&raw)?;
    progress(0.1);
    let sorted = sort::sort(&raw, &usage, options.limits, workspace)?;
    let RawMesh { faces, .. } = raw;
    let welded_vertices = usage.used_count - sorted.positions.len();
    progress(0.3);
    let (sorted, near_vertices) = match options.weld_tolerance {
        0.0 => (sorted, 0),
        tolerance => near::join_near(sorted, tolerance, usage.extent, options.limits.vertices, workspace)?,
    };
    progress(0.4);
    let mut census = faces::census(&faces, &sorted)?;
    let sorted = faces::compact(sorted, &mut census, workspace)?;
    let ranges = census.ranges(options.limits.faces);
    let (degenerate_faces, vertex_count) = (census.degenerate_faces, census.vertices);
    drop(census);
    let dealt = faces::deal(&faces, &sorted.numbers, &ranges, workspace)?;
    drop(faces);
    progress(0.5);

    let stage = Stage { dealt, ranges, face_count: triangles_before as u32 };
    let with_lengths = options.bits.is_none();
    let look = |turned: Option<&Bits>, progress: &mut dyn FnMut(f32)| {
        Surveyed::of(&stage, &sorted.positions, turned, with_lengths, workspace, progress)
    };
    let mut surveyed = look(None, &mut |done| progress(0.5 + 0.2 * done))?;
    let mut turned_faces = 0;
    if surveyed.is_mixed {
        let turned = orient::orient(&stage, &sorted.positions, surveyed.extent)?;
        turned_faces = turned.count;
        surveyed = look(Some(&turned.faces), &mut |done| progress(0.7 + 0.1 * done))?;
    }
    let Stage { dealt, ranges, .. } = stage;
    drop(dealt);
    let cuts = trouble::cut(std::mem::take(&mut surveyed.trouble), &sorted.numbers, &ranges);
    let sort::Sorted { positions, colors, numbers } = sorted;
    drop(numbers);

    let (low, high) = surveyed.extent.corners();
    let bits = match options.bits {
        Some(bits) => bits,
        None => surveyed.bits(&positions, &ranges)?,
    };
    let lattice = Lattice::of_box(low, high, bits);
    let duplicate_faces = surveyed.duplicates;
    let counts = cuts.counts;
    let input = finish::Input { lattice, precision: options.precision, positions, colors, surveyed, cuts, ranges };
    let mesh = finish::finish(input, workspace, &mut |done| progress(0.8 + 0.2 * done))?;
    let report = CleanReport {
        vertices_before,
        triangles_before,
        unusable_faces: usage.unusable_faces,
        welded_vertices,
        near_vertices,
        degenerate_faces,
        duplicate_faces,
        unreferenced_vertices: vertices_before - vertex_count - welded_vertices - near_vertices,
        turned_faces,
        one_sided_edges: counts.one_sided_edges,
        non_manifold_edges: counts.non_manifold_edges,
        cut_sides: counts.cut_sides,
        double_edges: counts.double_edges,
        split_vertices: counts.split_vertices,
        vertex_copies: counts.copies,
        components: mesh.components.components.len() as u64,
        vertices_after: mesh.vertices.len() as u64,
        triangles_after: mesh.faces.len(),
    };
    Ok((mesh, report))
}

fn check(raw: &RawMesh, options: &PartitionOptions) -> Result<(), PartitionError> {
    if let Some(bits) = options.bits.filter(|bits| !(MIN_LATTICE_BITS..=MAX_LATTICE_BITS).contains(bits)) {
        return Err(PartitionError::Bits(bits));
    }
    if !(0.0..f64::INFINITY).contains(&options.weld_tolerance) {
        return Err(PartitionError::Tolerance(options.weld_tolerance));
    }
    let (vertices, faces) = (raw.positions.len(), raw.faces.len());
    if vertices > u64::from(u32::MAX) || faces > MAX_TRIANGLES as u64 {
        return Err(PartitionError::TooLarge { vertices, faces });
    }
    match &raw.colors {
        Some(colors) if colors.len() != vertices => Err(PartitionError::ColorCount { colors: colors.len(), vertices }),
        _ => Ok(()),
    }
}

/// Faces by chunk.
struct Stage {
    dealt: Runs<Face>,
    ranges: Ranges,
    /// Of the input.
    face_count: u32,
}

impl Stage {
    fn stars(&self, chunk: usize, turned: Option<&Bits>) -> Result<Stars, SpillError> {
        Stars::read(&self.dealt, &self.ranges, chunk, turned)
    }
}

/// What all chunks know together.
struct Surveyed {
    /// Chunk after chunk.
    faces: Spill<[u32; 3]>,
    /// Where the faces of each chunk start, and how many there are.
    chunk_starts: Vec<u32>,
    /// By vertex.
    places: Vec<u8>,
    /// Edges with a single face.
    boundary: Spill<[u32; 2]>,
    duplicates: u64,
    is_mixed: bool,
    /// Empty if `is_mixed`: turning faces may change it.
    trouble: Trouble,
    lengths: EdgeLengths,
    extent: Extent,
}

impl Surveyed {
    fn of(
        stage: &Stage,
        positions: &Spill<[f64; 3]>,
        turned: Option<&Bits>,
        with_lengths: bool,
        workspace: &Workspace,
        progress: &mut dyn FnMut(f32),
    ) -> Result<Self, SpillError> {
        let mut faces: SpillWriter<'_, [u32; 3]> = workspace.spill();
        let mut boundary = workspace.spill();
        let mut chunk_starts = vec![0];
        let mut places = Vec::with_capacity(positions.len() as usize);
        let (mut duplicates, mut is_mixed) = (0, false);
        let mut trouble = Trouble::default();
        let mut lengths = EdgeLengths::default();
        let mut extent = Extent::NOTHING;
        // Without faces there is one range, without vertices.
        let count = if positions.len() == 0 { 0 } else { stage.ranges.count() };
        in_order(
            count,
            |chunk| survey(&stage.stars(chunk, turned)?, chunk as u32, positions, with_lengths),
            |chunk, survey| {
                faces.push(&survey.faces)?;
                chunk_starts.push(faces.len() as u32);
                places.extend(survey.places);
                boundary.push(&survey.boundary)?;
                duplicates += survey.duplicates;
                is_mixed |= survey.is_mixed;
                trouble.extend(survey.trouble);
                if is_mixed && turned.is_none() {
                    trouble = Trouble::default();
                }
                lengths.join(&survey.lengths);
                extent.join(survey.extent);
                progress((chunk + 1) as f32 / count as f32);
                Ok(())
            },
        )?;
        let (faces, boundary) = (faces.finish()?, boundary.finish()?);
        Ok(Self { faces, chunk_starts, places, boundary, duplicates, is_mixed, trouble, lengths, extent })
    }

    fn chunk(&self, chunk: usize) -> Result<Vec<[u32; 3]>, SpillError> {
        let [start, end] = [chunk, chunk + 1].map(|c| u64::from(self.chunk_starts[c]));
        self.faces.read(start..end)
    }

    /// Bits of the lattice.
    fn bits(&self, positions: &Spill<[f64; 3]>, ranges: &Ranges) -> Result<u8, SpillError> {
        let (low, high) = self.extent.corners();
        let bin = match self.lengths.bits(low, high) {
            Ok(bits) => return Ok(bits),
            Err(bin) => bin,
        };
        let mut counts: Vec<u32> = Vec::new();
        in_order(
            ranges.count(),
            |chunk| {
                let mut faces = self.chunk(chunk)?;
                let local = local::Local::new(ranges.range(chunk), faces.iter().flatten().copied());
                faces.as_flattened_mut().iter_mut().for_each(|v| *v = local.place(*v));
                Ok(bin.count(&faces, &local.read(positions)?))
            },
            |_, part| {
                counts.resize(part.len(), 0);
                counts.iter_mut().zip(part).for_each(|(sum, part)| *sum += part);
                Ok(())
            },
        )?;
        Ok(bin.bits(&counts, low, high))
    }
}
