//! The pack: one immutable file per model.
//!
//! [`write()`] makes it from a [`Dag`](record::Dag), [`PackedModel`] reads it in place, [`verify`](fn@verify) replays
//! every record. The layout is in `FORMAT.md`. This module knows nothing of files, sessions or how a DAG is built.

mod cut;
mod hash;
mod header;
mod inspect;
mod layout;
mod metadata;
mod outline;
mod page;
mod pages;
pub mod place;
mod read;
pub mod record;
mod replay;
mod spawns;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
mod thumbnail;
mod verify;
mod write;

use std::sync::Arc;

pub use cut::{CutError, resolve_cut};
pub use hash::{CompleteMesh, complete_mesh_hash};
pub use inspect::{Inspection, SectionSize, inspect};
pub(crate) use layout::SpawnEntry;
pub use layout::{PAGE_OPS, VERSION};
pub use metadata::Metadata;
pub(crate) use outline::{Outline, SplitSource};
pub use page::{Column, TestPage};
pub use pages::PageId;
pub use read::{PackedModel, Prerequisites, SplitFields};
pub use replay::{extract, extract_complete, parents_first, replay, replay_ops};
pub use thumbnail::thumbnail_edits;
pub use verify::{VerifyReport, verify};
pub(crate) use write::write_splits;
pub use write::{WriteError, write, write_to_vec};

/// The bytes of a pack, in memory or mapped.
pub type PackBytes = Arc<dyn AsRef<[u8]> + Send + Sync>;

/// Why a pack was refused or a part of it cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PackError {
    /// The file does not begin like a pack.
    #[error("not a pack")]
    NotAPack,
    /// Written by another version of this software, most likely a newer one.
    #[error("pack version {found} is not supported, only {VERSION} is")]
    Version {
        /// The file's version.
        found: u32,
    },
    /// The file needs a reader that knows this kind of section.
    #[error("the pack needs a newer version of this software: required section of unknown kind {kind}")]
    UnknownSection {
        /// The section's kind.
        kind: u32,
    },
    /// A checksum or a field does not fit.
    #[error("section {section} is damaged: {reason}")]
    Damaged {
        /// Name of the section.
        section: &'static str,
        /// What is wrong.
        reason: String,
    },
    /// The caller asked for an op, vertex or face that the model does not have.
    #[error("the model has no {what} {number}")]
    OutOfRange {
        /// Kind of thing.
        what: &'static str,
        /// Its number.
        number: u32,
    },
}

impl PackError {
    /// Name of the section at fault; `None` if the request was.
    pub fn section(&self) -> Option<&'static str> {
        match self {
            Self::NotAPack | Self::Version { .. } => Some(layout::HEADER_NAME),
            Self::UnknownSection { .. } => Some(layout::UNKNOWN_NAME),
            Self::Damaged { section, .. } => Some(section),
            Self::OutOfRange { .. } => None,
        }
    }
}

fn damaged(section: layout::Section, reason: impl Into<String>) -> PackError {
    PackError::Damaged { section: section.name(), reason: reason.into() }
}

#[cfg(test)]
mod tests;
