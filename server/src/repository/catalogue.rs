//! What a listing says about each model.

use std::path::PathBuf;
use std::sync::Arc;

use super::{ModelId, RepositoryError};
use crate::pack::PackedModel;

/// One model of a listing.
#[derive(Clone, Debug)]
pub struct ModelEntry {
    /// Name of the model.
    pub id: ModelId,
    /// Its file.
    pub path: PathBuf,
    /// Whether it can be used.
    pub state: ModelState,
}

/// Whether a model can be used.
#[derive(Clone, Debug)]
pub enum ModelState {
    /// Open, with all that its header says at hand.
    Ready(Arc<PackedModel>),
    /// Not to be used, for this reason.
    Damaged(String),
}

impl ModelState {
    /// `None` for a model that does not exist.
    pub(super) fn of(result: Result<Arc<PackedModel>, RepositoryError>) -> Option<Self> {
        match result {
            Ok(model) => Some(Self::Ready(model)),
            Err(RepositoryError::NotFound(_)) => None,
            Err(RepositoryError::Damaged { reason, .. }) => Some(Self::Damaged(reason.to_string())),
            Err(RepositoryError::Io { what, source }) => Some(Self::Damaged(format!("{what}: {source}"))),
            Err(error) => Some(Self::Damaged(error.to_string())),
        }
    }
}
