//! Where readers put what they read: the spills of a [`RawMesh`], a batch at a time.

use super::{MAX_TRIANGLES, MAX_VERTICES, ReadError};
use crate::ingest::raw::RawMesh;
use crate::ingest::spill::{SpillError, SpillWriter, Workspace};

use bytemuck::{AnyBitPattern, NoUninit};

/// Items handed to a spill at once.
const BATCH: usize = 4096;

/// A spill that is written item by item.
#[derive(Debug)]
pub(super) struct Batched<'w, T> {
    pending: Vec<T>,
    out: SpillWriter<'w, T>,
}

impl<'w, T: NoUninit + AnyBitPattern> Batched<'w, T> {
    pub(super) fn new(workspace: &'w Workspace) -> Self {
        Self { pending: Vec::new(), out: workspace.spill() }
    }

    pub(super) fn len(&self) -> u64 {
        self.out.len() + self.pending.len() as u64
    }

    #[inline]
    pub(super) fn push(&mut self, item: T) -> Result<(), SpillError> {
        if self.pending.len() == BATCH {
            self.flush()?;
        }
        self.pending.push(item);
        Ok(())
    }

    #[inline(never)]
    fn flush(&mut self) -> Result<(), SpillError> {
        self.out.push(&self.pending)?;
        self.pending.clear();
        Ok(())
    }

    fn finish(mut self) -> Result<crate::ingest::spill::Spill<T>, SpillError> {
        self.flush()?;
        self.out.finish()
    }
}

/// A mesh being written.
#[derive(Debug)]
pub(super) struct Sink<'w> {
    workspace: &'w Workspace,
    positions: Batched<'w, [f64; 3]>,
    colors: Option<Batched<'w, [u8; 3]>>,
    faces: Batched<'w, [u32; 3]>,
}

pub(super) const WHITE: [u8; 3] = [255; 3];

impl<'w> Sink<'w> {
    pub(super) fn new(workspace: &'w Workspace) -> Self {
        let (positions, faces) = (Batched::new(workspace), Batched::new(workspace));
        Self { workspace, positions, colors: None, faces }
    }

    pub(super) fn workspace(&self) -> &'w Workspace {
        self.workspace
    }

    pub(super) fn vertices(&self) -> u64 {
        self.positions.len()
    }

    pub(super) fn triangles(&self) -> u64 {
        self.faces.len()
    }

    pub(super) fn is_colored(&self) -> bool {
        self.colors.is_some()
    }

    /// Appends a vertex, within [`MAX_VERTICES`]. It is white if others have colours and it gets none.
    #[inline]
    pub(super) fn push_vertex(&mut self, position: [f64; 3]) -> Result<(), ReadError> {
        if self.positions.len() == MAX_VERTICES as u64 {
            return Err(ReadError::TooLarge { what: "vertices", limit: MAX_VERTICES as u64 });
        }
        self.positions.push(position)?;
        Ok(())
    }

    /// Colours the vertex appended last; vertices before it without a colour become white.
    #[inline]
    pub(super) fn color_last(&mut self, color: [u8; 3]) -> Result<(), ReadError> {
        let before = self.positions.len() - 1;
        let colors = self.colors.get_or_insert_with(|| Batched::new(self.workspace));
        while colors.len() < before {
            colors.push(WHITE)?;
        }
        colors.push(color)?;
        Ok(())
    }

    /// Appends a triangle, within [`MAX_TRIANGLES`].
    #[inline]
    pub(super) fn push_face(&mut self, face: [u32; 3]) -> Result<(), ReadError> {
        if self.faces.len() == MAX_TRIANGLES as u64 {
            return Err(ReadError::TooLarge { what: "triangles", limit: MAX_TRIANGLES as u64 });
        }
        self.faces.push(face)?;
        Ok(())
    }

    /// Ends the mesh. Cost is at most one write of each vertex's colour.
    pub(super) fn finish(self) -> Result<RawMesh, SpillError> {
        let vertices = self.positions.len();
        let colors = self.colors.map(|mut colors| {
            while colors.len() < vertices {
                colors.push(WHITE)?;
            }
            colors.finish()
        });
        Ok(RawMesh { positions: self.positions.finish()?, colors: colors.transpose()?, faces: self.faces.finish()? })
    }
}

/// Appends the fan of one polygon, corner by corner, without a buffer.
pub(super) struct Fan {
    first: u32,
    previous: u32,
    pub(super) corners: u64,
}

impl Fan {
    pub(super) fn new() -> Self {
        Self { first: 0, previous: 0, corners: 0 }
    }

    #[inline]
    pub(super) fn push(&mut self, corner: u32, sink: &mut Sink<'_>) -> Result<(), ReadError> {
        self.turn(corner).map_or(Ok(()), |face| sink.push_face(face))
    }

    /// The triangle that a corner completes.
    #[inline]
    pub(super) fn turn(&mut self, corner: u32) -> Option<[u32; 3]> {
        if self.corners == 0 {
            self.first = corner;
        }
        let face = (self.corners >= 2).then_some([self.first, self.previous, corner]);
        self.previous = corner;
        self.corners += 1;
        face
    }
}

/// Appends the triangles of one strip, corner by corner: every two neighbours make a triangle with the next corner, every
/// second one is turned round. Triangles with a repeated corner only steer the strip and are left out.
pub(super) struct Strip {
    before: u32,
    last: u32,
    corners: u64,
}

impl Strip {
    pub(super) fn new() -> Self {
        Self { before: 0, last: 0, corners: 0 }
    }

    #[inline]
    pub(super) fn push(&mut self, corner: u32, sink: &mut Sink<'_>) -> Result<(), ReadError> {
        self.turn(corner).map_or(Ok(()), |face| sink.push_face(face))
    }

    /// The triangle that a corner completes.
    #[inline]
    pub(super) fn turn(&mut self, corner: u32) -> Option<[u32; 3]> {
        let (before, last) = (self.before, self.last);
        let is_triangle = self.corners >= 2 && before != last && last != corner && corner != before;
        let face = if self.corners.is_multiple_of(2) { [before, last, corner] } else { [last, before, corner] };
        (self.before, self.last) = (last, corner);
        self.corners += 1;
        is_triangle.then_some(face)
    }
}
