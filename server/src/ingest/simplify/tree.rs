//! Simplification chunk by chunk, up the tree of chunks (ALGORITHMS section 4.2).
//!
//! Nodes of one height touch disjoint parts of the mesh, since no collapse involves a vertex that is not inside its node. So
//! they run in parallel, and any order of them is a valid order of the whole; that of their numbers is taken, which makes the
//! result independent of the threads. Each face is worked on about 8/7 times. Where fewer nodes are left than threads, as at
//! the root, a second thread measures what the first collapses.

use std::sync::atomic::{AtomicU64, Ordering};

use super::Method;
use super::part::{Part, Remainder, Sample, Simplified as Done, Survivor, Task};
use crate::ingest::{
    chunks::{ChunkedMesh, FAN_IN},
    hierarchy::{CollapseRecord, NONE, RootFace, RootVertex, Simplified},
    in_order::in_order,
    spill::{Spill, SpillError, SpillWriter, Workspace},
};

/// Figures about a simplification.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Figures {
    /// Sweeps of the batched order, over all nodes.
    pub(crate) sweeps: u32,
    /// Sum over all collapses of the valence of `s` afterwards.
    pub(crate) valence_sum: u64,
}

/// Simplifies a mesh until no collapse is legal, on `threads` threads of about 100 MB each. `progress` hears the share of the
/// faces that are gone, from any thread.
pub(crate) fn simplify(
    mesh: &ChunkedMesh,
    method: Method,
    workspace: &Workspace,
    threads: u32,
    progress: &(dyn Fn(f32) + Sync),
) -> Result<(Simplified, Figures), SpillError> {
    let mut output = Output {
        collapses: workspace.spill(),
        root_vertices: Vec::new(),
        root_faces: Vec::new(),
        figures: Figures::default(),
    };
    let removed = AtomicU64::new(0);
    let total = mesh.faces.len().max(1) as f32;
    let tell = |gone: u64| {
        let removed = removed.fetch_add(gone, Ordering::Relaxed) + gone;
        progress(removed as f32 / total);
    };
    let mut below: Option<Level> = None;
    for height in 0..=mesh.height() {
        let nodes = mesh.chunk_count().div_ceil(FAN_IN.saturating_pow(height.into()));
        let first_op = output.collapses.len() as u32;
        let mut level = LevelWriter::new(workspace);
        // Nodes after the last full round of all threads, if each can have two.
        let rest = nodes % threads.max(1);
        let helped = if 2 * rest <= threads { rest } else { 0 };
        let work = |node: u32| -> Result<Done, SpillError> {
            let part = match &below {
                None => Part::leaf(mesh, node)?,
                Some(below) => Part::join(mesh, height, below.children_of(node)?),
            };
            let task = Task { height, method, first_op, has_second_thread: node >= nodes - helped };
            Ok(part.simplify(mesh, task, &mut |gone| tell(gone)))
        };
        in_order(nodes, threads, work, |_, done| {
            let remainder = output.take(done?, first_op)?;
            level.push(&remainder)
        })?;
        below = Some(level.finish()?);
    }
    let Output { collapses, mut root_vertices, mut root_faces, figures } = output;
    root_vertices.sort_unstable_by_key(|v| v.vertex);
    root_faces.sort_unstable_by_key(|f| f.face);
    Ok((Simplified { collapses: collapses.finish()?, vertex_ops: None, root_vertices, root_faces }, figures))
}

/// What all nodes have given so far.
struct Output<'w> {
    collapses: SpillWriter<'w, CollapseRecord>,
    root_vertices: Vec<RootVertex>,
    root_faces: Vec<RootFace>,
    figures: Figures,
}

impl Output<'_> {
    /// Takes over the ops and roots of a node. It numbered its own ops from `first_op`, where its level begins; they now get the
    /// numbers that follow those of the node before it.
    fn take(&mut self, done: Done, first_op: u32) -> Result<Remainder, SpillError> {
        let Done { mut collapses, mut remainder, mut root_vertices, root_faces, sweeps, valence_sum } = done;
        let shift = self.collapses.len() as u32 - first_op;
        let renumber = |op: &mut u32| {
            if *op != NONE && *op >= first_op {
                *op += shift;
            }
        };
        for collapse in &mut collapses {
            renumber(&mut collapse.next_of_s);
            renumber(&mut collapse.first_of_t);
        }
        remainder.survivors.iter_mut().for_each(|survivor| renumber(&mut survivor.last));
        root_vertices.iter_mut().for_each(|vertex| renumber(&mut vertex.last));
        self.collapses.push(&collapses)?;
        self.root_vertices.extend(root_vertices);
        self.root_faces.extend(root_faces);
        self.figures.sweeps += sweeps;
        self.figures.valence_sum += valence_sum;
        Ok(remainder)
    }
}

/// Ends of what a node has left in the spills of its level.
#[derive(Clone, Copy, Debug, Default)]
struct Ends {
    survivors: u64,
    samples: u64,
    faces: u64,
}

struct LevelWriter<'w> {
    survivors: SpillWriter<'w, Survivor>,
    samples: SpillWriter<'w, Sample>,
    faces: SpillWriter<'w, [u32; 3]>,
    face_numbers: SpillWriter<'w, u32>,
    ends: Vec<Ends>,
}

impl<'w> LevelWriter<'w> {
    fn new(workspace: &'w Workspace) -> Self {
        Self {
            survivors: workspace.spill(),
            samples: workspace.spill(),
            faces: workspace.spill(),
            face_numbers: workspace.spill(),
            ends: vec![Ends::default()],
        }
    }

    fn push(&mut self, node: &Remainder) -> Result<(), SpillError> {
        self.survivors.push(&node.survivors)?;
        self.samples.push(&node.samples)?;
        self.faces.push(&node.faces)?;
        self.face_numbers.push(&node.face_numbers)?;
        self.ends.push(Ends { survivors: self.survivors.len(), samples: self.samples.len(), faces: self.faces.len() });
        Ok(())
    }

    fn finish(self) -> Result<Level, SpillError> {
        Ok(Level {
            survivors: self.survivors.finish()?,
            samples: self.samples.finish()?,
            faces: self.faces.finish()?,
            face_numbers: self.face_numbers.finish()?,
            ends: self.ends,
        })
    }
}

/// What the nodes of one height have left.
struct Level {
    survivors: Spill<Survivor>,
    samples: Spill<Sample>,
    faces: Spill<[u32; 3]>,
    face_numbers: Spill<u32>,
    /// Ends of each node, after a first entry of zeros.
    ends: Vec<Ends>,
}

impl Level {
    fn children_of(&self, node: u32) -> Result<Remainder, SpillError> {
        let nodes = self.ends.len() as u32 - 1;
        let [from, to] = [node * FAN_IN, node * FAN_IN + FAN_IN].map(|n| self.ends[n.min(nodes) as usize]);
        Ok(Remainder {
            survivors: self.survivors.read(from.survivors..to.survivors)?,
            samples: self.samples.read(from.samples..to.samples)?,
            faces: self.faces.read(from.faces..to.faces)?,
            face_numbers: self.face_numbers.read(from.faces..to.faces)?,
        })
    }
}
