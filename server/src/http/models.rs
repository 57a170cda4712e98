//! Which models there are and how a session on one is opened.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use serde::Serialize;

use crate::pack::{PackError, PackedModel};
use crate::runtime::Core;
use crate::session::{Session, SessionConfig};

/// One line of the list of models.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ModelEntry {
    /// Name in addresses.
    pub id: String,
    /// Name for people, may be empty.
    pub title: String,
    /// Triangles of the complete mesh.
    pub triangles: u64,
    /// Vertices of the complete mesh.
    pub vertices: u64,
    /// Bytes of the pack.
    pub bytes: u64,
    /// Whether it can be streamed.
    pub status: ModelStatus,
}

/// Whether a model can be streamed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ModelStatus {
    /// It can.
    Ready,
    /// Its file is damaged.
    Quarantined,
}

/// Why a model gives no session.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OpenError {
    /// There is no such model.
    #[error("there is no model `{0}`")]
    Unknown(String),
    /// It exists but cannot be used.
    #[error("the model `{id}` cannot be used: {reason}")]
    Unusable {
        /// The model.
        id: String,
        /// Why.
        reason: String,
    },
}

/// What the server serves: [`RepositoryModels`], or a stand-in that a test controls.
pub trait Models: Send + Sync + 'static {
    /// All models by id, ascending. Cheap: a snapshot held in memory.
    fn list(&self) -> Vec<ModelEntry>;

    /// Starts a session on a model. May read from disk, so it is called where blocking is allowed.
    ///
    /// # Errors
    /// [`OpenError`].
    fn open(&self, id: &str) -> Result<Box<dyn Core>, OpenError>;
}

/// The models of a repository.
#[derive(Debug)]
pub struct RepositoryModels {
    repository: Repository,
    session: SessionConfig,
}

impl RepositoryModels {
    /// Serves all of `repository` with sessions configured by `session`.
    pub fn new(repository: Repository, session: SessionConfig) -> Self {
        Self { repository, session }
    }
}

impl Models for RepositoryModels {
    fn list(&self) -> Vec<ModelEntry> {
        self.repository.list()
    }

    fn open(&self, id: &str) -> Result<Box<dyn Core>, OpenError> {
        let model = self.repository.get(id).map_err(|error| match error {
            RepositoryError::Unknown => OpenError::Unknown(id.into()),
            RepositoryError::Damaged(_) | RepositoryError::Io(_) => {
                OpenError::Unusable { id: id.into(), reason: error.to_string() }
            }
        })?;
        Ok(Box::new(Session::new(model, self.session)))
    }
}

/// Models held in memory by id.
#[derive(Debug, Default)]
pub struct Repository {
    models: BTreeMap<String, (ModelEntry, Arc<PackedModel>)>,
}

/// Why a repository or a model in it cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RepositoryError {
    /// There is no such model.
    #[error("no such model")]
    Unknown,
    /// Its pack is damaged.
    #[error(transparent)]
    Damaged(#[from] PackError),
    /// The operating system's.
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

impl Repository {
    /// The repository in `directory`.
    ///
    /// # Errors
    /// [`RepositoryError::Io`] when it cannot be read.
    pub fn open(directory: &Path) -> Result<Self, RepositoryError> {
        std::fs::read_dir(directory)?;
        Ok(Self::default())
    }

    /// All models by id, ascending.
    pub fn list(&self) -> Vec<ModelEntry> {
        self.models.values().map(|(entry, _)| entry.clone()).collect()
    }

    /// A model.
    ///
    /// # Errors
    /// [`RepositoryError`].
    pub fn get(&self, id: &str) -> Result<Arc<PackedModel>, RepositoryError> {
        self.models.get(id).map(|(_, model)| Arc::clone(model)).ok_or(RepositoryError::Unknown)
    }
}
