//! From the collapses of a model of any size to its pack: final ids, tree parents, cut references, base and spawns.
//!
//! Two passes over the collapses, both from the last one back, which is the order of refinement: [`ids`] finds the final
//! order, [`records`] turns each collapse into a split and leaves it where [`splits`] finds it when the pack's writer asks for
//! that stretch of the model. [`roots`] is about what no collapse removed. What stays in memory is 4 bytes per face and 8 to 9
//! per collapse.
//!
//! A collapse is known by its place in the sequence. All that is assumed about the sequence: what a collapse names as its
//! children came before it, and a face is removed once. This module knows nothing of how collapses were found.

mod ids;
mod records;
mod roots;
mod splits;
#[cfg(test)]
pub(crate) mod tests;

use std::io::{Seek, Write};

use lodestream_protocol::quant::Lattice;

use self::records::Recorder;
use self::roots::Roots;
use self::splits::{Runs, Splits};
use super::{NONE, Simplified};
use crate::ingest::chunks::Component;
use crate::ingest::spill::{SpillError, Workspace};
use crate::pack::record::{Magnitude, NO_OP, VERTEX_OPS};
use crate::pack::{CompleteMesh, Metadata, Outline, PAGE_OPS, WriteError, write_splits};

/// What assembly needs to know of a model besides its simplification.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Model<'a> {
    pub(crate) lattice: Lattice,
    pub(crate) has_colors: bool,
    pub(crate) is_open: bool,
    /// Faces of the complete mesh.
    pub(crate) faces: u32,
    pub(crate) components: &'a [Component],
}

/// How much is worked on at once.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Grain {
    /// Keys that are sorted together.
    pub(crate) keys: usize,
    /// Collapses that are looked at together.
    pub(crate) collapses: u64,
    /// Splits that are put in order together; ids of whole pages.
    pub(crate) bucket: u32,
}

impl Default for Grain {
    /// 16 MB of keys, 12 MB of collapses, 21 MB of splits.
    fn default() -> Self {
        Self { keys: 1 << 20, collapses: 1 << 17, bucket: 1024 * PAGE_OPS }
    }
}

/// Figures about a finished DAG.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Shape {
    /// Ops on the longest chain of parents.
    pub(crate) depth: u32,
    /// Splits by number of distinct parents, 0 to 3.
    pub(crate) parents: [u64; 4],
    /// Components in the base.
    pub(crate) base_components: usize,
}

/// Errors of a model's splits.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct ErrorRange {
    /// Smallest that is not zero; zero if there is none.
    pub(crate) smallest: Magnitude,
    pub(crate) largest: Magnitude,
    /// Splits with an error of exactly zero.
    pub(crate) zeros: u64,
}

impl ErrorRange {
    fn add(&mut self, error: Magnitude) {
        self.largest = self.largest.max(error);
        if error.0 == 0 {
            self.zeros += 1;
        } else if self.smallest.0 == 0 || error < self.smallest {
            self.smallest = error;
        }
    }
}

/// A model ready to be written.
#[derive(Debug)]
pub(crate) struct Assembled {
    pub(crate) outline: Outline,
    pub(crate) shape: Shape,
    pub(crate) errors: ErrorRange,
    runs: Runs,
    /// Under the rule of vertices, by split.
    vertex_ops: Option<Vec<[u32; VERTEX_OPS]>>,
}

impl Assembled {
    /// Writes the pack; see [`pack::write`](fn@crate::pack::write). `progress` hears the share that is done.
    ///
    /// # Errors
    /// As there, and [`SpillError`] in [`WriteError::Source`].
    pub(crate) fn write(
        &self,
        complete: &CompleteMesh,
        metadata: &Metadata,
        out: &mut (impl Write + Seek),
        progress: &mut dyn FnMut(f32),
    ) -> Result<u64, WriteError> {
        write_splits(
            &self.outline,
            &mut Splits::new(&self.runs, self.vertex_ops.as_deref()),
            complete,
            metadata,
            out,
            progress,
        )
    }
}

/// Assembles a simplified model. `progress` hears the share that is done.
///
/// Temporary data of 16 and then 80 bytes per collapse go to `workspace`, the collapses are given up at the end.
///
/// # Errors
/// [`WriteError::Source`] with a [`SpillError`], and [`WriteError::Invalid`] if collapses contradict each other or are more
/// than 32-bit numbers can tell apart.
pub(crate) fn assemble(
    model: &Model,
    simplified: Simplified,
    workspace: &Workspace,
    progress: &mut dyn FnMut(f32),
) -> Result<Assembled, WriteError> {
    assemble_by(&Grain::default(), model, simplified, workspace, progress)
}

/// [`assemble`] with other grains, which make no difference to the pack.
pub(crate) fn assemble_by(
    grain: &Grain,
    model: &Model,
    simplified: Simplified,
    workspace: &Workspace,
    progress: &mut dyn FnMut(f32),
) -> Result<Assembled, WriteError> {
    let Simplified { collapses, vertex_ops, root_vertices, root_faces } = simplified;
    let roots = Roots::new(model, &root_vertices, &root_faces)?;
    let splits = u32::try_from(collapses.len()).map_err(|_| invalid("too many collapses"))?;
    let spawns = roots.spawns.len() as u32;
    spawns.checked_add(splits).ok_or_else(|| invalid("too many ops"))?;
    let max = model.lattice.max_coordinate();
    let ids = ids::final_ids(&collapses, max, spawns, workspace, grain, &mut |share| progress(0.4 * share))?;
    let mut outline = roots.outline(model, splits, &root_vertices, &root_faces, &ids)?;
    let mut recorder = Recorder::new(model, &outline, &roots, &root_vertices, &root_faces, splits)?;
    let base_components = roots.base.len();
    drop((root_vertices, root_faces));
    let runs = recorder.run(&collapses, &ids, spawns, workspace, grain, &mut |share| progress(0.4 + 0.6 * share))?;
    outline.has_moves = recorder.has_moves;
    outline.by_vertices = vertex_ops.is_some();
    let vertex_ops = vertex_ops.map(|ops| by_id(&ops, &ids, spawns));
    let shape = Shape { depth: recorder.depth, parents: recorder.parents, base_components };
    Ok(Assembled { outline, shape, errors: recorder.errors, runs, vertex_ops })
}

/// From the numbers of collapses to final ids, which count from `spawns`.
fn by_id(vertex_ops: &[[u32; VERTEX_OPS]], ids: &[u32], spawns: u32) -> Vec<[u32; VERTEX_OPS]> {
    let mut by_id = vec![[NO_OP; VERTEX_OPS]; ids.len()];
    for (ops, &id) in vertex_ops.iter().zip(ids) {
        by_id[(id - spawns) as usize] = ops.map(|op| if op == NONE { NO_OP } else { ids[op as usize] });
    }
    by_id
}

fn invalid(reason: impl Into<String>) -> WriteError {
    WriteError::Invalid(reason.into())
}

impl From<SpillError> for WriteError {
    fn from(error: SpillError) -> Self {
        Self::Source(Box::new(error))
    }
}

/// Blocks of at most `step` items, from the last back to the first.
pub(super) fn blocks_from_the_end(len: u64, step: u64) -> impl Iterator<Item = std::ops::Range<u64>> {
    (0..len.div_ceil(step)).rev().map(move |block| block * step..len.min((block + 1) * step))
}
