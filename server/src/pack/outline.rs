//! What the writer takes in: a model but for its splits, and where those come from.

use std::ops::Range;

use lodestream_protocol::quant::Lattice;

use super::layout::SpawnEntry;
use super::record::{Bounds, Dag, SplitRecord};
use super::write::{WriteError, invalid};

/// A model but for its splits. Root vertices and faces are those of the base, then those of each spawn, numbered through.
#[derive(Clone, PartialEq, Debug)]
pub(crate) struct Outline {
    /// The lattice of all positions.
    pub(crate) lattice: Lattice,
    /// Whether colours mean anything.
    pub(crate) has_colors: bool,
    /// Whether some split moves `s` or changes its colour.
    pub(crate) has_moves: bool,
    /// See [`Dag::is_open`].
    pub(crate) is_open: bool,
    /// See [`Dag::by_vertices`].
    pub(crate) by_vertices: bool,
    /// Number of splits.
    pub(crate) splits: u32,
    /// Of the root vertices.
    pub(crate) positions: Vec<[i32; 3]>,
    /// Of the root vertices; zeros for models without colours.
    pub(crate) colors: Vec<[u8; 3]>,
    /// First split of each root vertex, or [`NO_OP`](super::record::NO_OP).
    pub(crate) first_splits: Vec<u32>,
    /// Corners of the root faces; they count from the first vertex of their base or spawn.
    pub(crate) faces: Vec<[u32; 3]>,
    /// Visibility spheres of the spawns, by error descending.
    pub(crate) spawns: Vec<Bounds>,
    /// First root vertex and face of each spawn, and one past the last at the end.
    pub(crate) starts: Vec<SpawnEntry>,
}

impl Outline {
    /// That of a whole DAG.
    ///
    /// # Errors
    /// [`WriteError::Invalid`] if arrays of a patch differ in length or there are too many elements.
    pub(super) fn of(dag: &Dag) -> Result<Self, WriteError> {
        let mut outline = Self {
            lattice: dag.lattice,
            has_colors: dag.has_colors,
            has_moves: dag.splits.iter().any(|s| s.s_move != [0; 3] || s.s_color_move != [0; 3]),
            is_open: dag.is_open,
            by_vertices: dag.by_vertices,
            splits: u32::try_from(dag.splits.len()).map_err(|_| invalid("too many ops"))?,
            positions: Vec::new(),
            colors: Vec::new(),
            first_splits: Vec::new(),
            faces: Vec::new(),
            spawns: dag.spawns.iter().map(|spawn| spawn.bounds).collect(),
            starts: Vec::new(),
        };
        let narrow = |n: usize| u32::try_from(n).map_err(|_| invalid("too many root elements"));
        for (i, patch) in std::iter::once(&dag.base).chain(dag.spawns.iter().map(|s| &s.patch)).enumerate() {
            let vertices = patch.positions.len();
            if patch.colors.len() != vertices || patch.first_splits.len() != vertices {
                return Err(invalid(format!("patch {i} has arrays of different lengths")));
            }
            outline.positions.extend_from_slice(&patch.positions);
            outline.colors.extend_from_slice(&patch.colors);
            outline.first_splits.extend_from_slice(&patch.first_splits);
            outline.faces.extend_from_slice(&patch.faces);
            let end = SpawnEntry { vertex: narrow(outline.positions.len())?, face: narrow(outline.faces.len())? };
            outline.starts.push(end);
        }
        Ok(outline)
    }

    /// Root vertices and faces of a spawn, or of the base.
    pub(super) fn patch(&self, spawn: Option<u32>) -> (Range<usize>, Range<usize>) {
        match spawn {
            Some(spawn) => self.patches(spawn..spawn + 1),
            None => (0..self.starts[0].vertex as usize, 0..self.starts[0].face as usize),
        }
    }

    /// Root vertices and faces of some spawns.
    pub(super) fn patches(&self, spawns: Range<u32>) -> (Range<usize>, Range<usize>) {
        let (first, end) = (self.starts[spawns.start as usize], self.starts[spawns.end as usize]);
        (first.vertex as usize..end.vertex as usize, first.face as usize..end.face as usize)
    }
}

/// Splits in the order of their ids, a stretch at a time.
pub(crate) trait SplitSource: Sync {
    /// Goes on to the next stretch, at first to the first one, and returns its length; 0 after the last. A stretch ends where
    /// a page of ops does, spawns counted, but for the last.
    fn advance(&mut self) -> Result<u32, WriteError>;

    /// Appends some splits of the stretch, counted from its first.
    fn read(&self, splits: Range<u32>, out: &mut Vec<SplitRecord>);
}

/// All splits of a DAG in one stretch.
pub(super) struct WholeDag<'a> {
    splits: &'a [SplitRecord],
    has_begun: bool,
}

impl<'a> WholeDag<'a> {
    pub(super) fn new(dag: &'a Dag) -> Self {
        Self { splits: &dag.splits, has_begun: false }
    }
}

impl SplitSource for WholeDag<'_> {
    fn advance(&mut self) -> Result<u32, WriteError> {
        let is_first = !std::mem::replace(&mut self.has_begun, true);
        Ok(if is_first { self.splits.len() as u32 } else { 0 })
    }

    fn read(&self, splits: Range<u32>, out: &mut Vec<SplitRecord>) {
        out.extend_from_slice(&self.splits[splits.start as usize..splits.end as usize]);
    }
}
