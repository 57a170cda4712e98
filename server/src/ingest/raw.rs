//! A mesh as a file holds it, before anything is mended: what readers write and cleaning reads.

use super::spill::{Spill, SpillError, Workspace};
use crate::mesh::TriMesh;

/// Positions may be infinite or not a number, corners may be repeated and name vertices that do not exist.
#[derive(Debug)]
pub struct RawMesh {
    /// In model units.
    pub(crate) positions: Spill<[f64; 3]>,
    /// One for each position, or `None` for a model without colours.
    pub(crate) colors: Option<Spill<[u8; 3]>>,
    /// Triangles, counter-clockwise seen from outside.
    pub(crate) faces: Spill<[u32; 3]>,
}

impl RawMesh {
    /// Copies a mesh that is in memory.
    ///
    /// # Errors
    /// [`SpillError`].
    pub fn of(mesh: &TriMesh, workspace: &Workspace) -> Result<Self, SpillError> {
        Ok(Self {
            positions: workspace.spill_of(&mesh.positions)?,
            colors: mesh.colors.as_ref().map(|colors| workspace.spill_of(colors)).transpose()?,
            faces: workspace.spill_of(&mesh.faces)?,
        })
    }

    /// Vertices.
    pub fn vertices(&self) -> u64 {
        self.positions.len()
    }

    /// Triangles.
    pub fn triangles(&self) -> u64 {
        self.faces.len()
    }

    /// The mesh in memory.
    ///
    /// # Errors
    /// [`SpillError`].
    pub fn load(&self) -> Result<TriMesh, SpillError> {
        Ok(TriMesh {
            positions: self.positions.read(0..self.positions.len())?,
            faces: self.faces.read(0..self.faces.len())?,
            colors: self.colors.as_ref().map(|colors| colors.read(0..colors.len())).transpose()?,
        })
    }
}
