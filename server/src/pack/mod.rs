//! The pack: one immutable file per model.

pub mod cut;
pub mod record;

use lodestream_protocol::mesh::Patch;
use lodestream_protocol::message::ModelInfo;

use record::{Bounds, CutRef};

/// Why a pack was refused or a part of it cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PackError {
    /// A checksum or a field does not fit.
    #[error("section {section} is damaged: {reason}")]
    Damaged {
        /// Name of the section.
        section: &'static str,
        /// What is wrong.
        reason: String,
    },
}

/// The fixed fields of a split that the session needs to apply it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SplitFields {
    /// See [`record::SplitRecord::tree_parent`].
    pub tree_parent: u32,
    /// See [`record::SplitRecord::s`].
    pub s: u32,
    /// Left cut edge.
    pub left: CutRef,
    /// Right cut edge.
    pub right: CutRef,
    /// Position of the inserted vertex.
    pub position: [i32; 3],
    /// Its colour.
    pub color: [u8; 3],
    /// Displacement of `s`.
    pub s_move: [i32; 3],
    /// Colour change of `s`.
    pub s_color_move: [u8; 3],
}

/// A pack whose header, tables and base were checked; pages are checked at first use.
#[derive(Debug)]
pub struct PackedModel {
    info: ModelInfo,
    base: Patch,
}

#[allow(clippy::unused_self, unused_variables, missing_docs)]
impl PackedModel {
    pub fn info(&self) -> &ModelInfo {
        &self.info
    }

    /// The mesh before any op.
    pub fn base(&self) -> &Patch {
        &self.base
    }

    /// First split of each base vertex, or `NO_OP`.
    pub fn base_first_splits(&self) -> &[u32] {
        unimplemented!()
    }

    /// Spawns are ops `0 .. spawn_count()`.
    pub fn spawn_count(&self) -> u32 {
        unimplemented!()
    }

    /// Splits are ops `spawn_count() .. op_count()`.
    pub fn op_count(&self) -> u32 {
        unimplemented!()
    }

    /// Visibility sphere of an op of either kind.
    pub fn bounds(&self, op: u32) -> Result<Bounds, PackError> {
        unimplemented!()
    }

    /// The forest children of a split: next split of `s`, first split of `t`; `NO_OP` where there is none.
    pub fn children(&self, split: u32) -> Result<[u32; 2], PackError> {
        unimplemented!()
    }

    pub fn split(&self, split: u32) -> Result<SplitFields, PackError> {
        unimplemented!()
    }

    /// Owners of the three references of a split without repeats: tree parent, left, right. Spawns count as ops.
    pub fn parents(&self, split: u32) -> Result<([u32; 3], usize), PackError> {
        unimplemented!()
    }

    /// What a spawn inserts.
    pub fn spawn_patch(&self, spawn: u32) -> Result<Patch, PackError> {
        unimplemented!()
    }

    /// First split of each vertex of a spawn, or `NO_OP`.
    pub fn spawn_first_splits(&self, spawn: u32) -> Result<Vec<u32>, PackError> {
        unimplemented!()
    }

    /// Number of triangles of a spawn.
    pub fn spawn_triangles(&self, spawn: u32) -> Result<u32, PackError> {
        unimplemented!()
    }

    /// The spawn (or `None` for the base) that root face `face` belongs to, and its number within that patch.
    pub fn root_face(&self, face: u32) -> Result<(Option<u32>, u32), PackError> {
        unimplemented!()
    }

    /// Likewise for root vertices.
    pub fn root_vertex(&self, vertex: u32) -> Result<(Option<u32>, u32), PackError> {
        unimplemented!()
    }
}
