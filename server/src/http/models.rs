//! Which models there are and how a session on one is opened.

use std::sync::Arc;

use glam::DVec3;
use lodestream_protocol::message::ModelInfo;
use serde::Serialize;

use crate::pack::{PackError, PackedModel};
use crate::repository::{ModelState, Repository, RepositoryError};
use crate::runtime::Core;
use crate::session::{Session, SessionConfig};

/// Pages of each kind that are read as a session opens: the first 2,048 spawns and splits, more than a first image has.
const FIRST_PAGES: u32 = 8;

/// One line of the list of models.
#[derive(Clone, Debug, PartialEq, Serialize)]
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
    /// Where its picture is, if it has one.
    pub thumbnail: Option<String>,
    /// Where it lies, unless its file is damaged.
    pub shape: Option<ModelShape>,
}

/// What a client may know of a model before it streams it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ModelShape {
    /// Least corner of its box, in model units.
    pub min: [f64; 3],
    /// The corner across.
    pub max: [f64; 3],
    /// Least triangle limit that a view may ask for.
    pub smallest_limit: u32,
}

impl ModelShape {
    fn of(info: &ModelInfo) -> Self {
        let corner = |point| info.lattice.position(point);
        Self { min: corner(info.box_min), max: corner(info.box_max), smallest_limit: info.smallest_limit }
    }

    /// Centre and radius of the ball around the box.
    pub fn ball(&self) -> ([f64; 3], f64) {
        let (min, max) = (DVec3::from_array(self.min), DVec3::from_array(self.max));
        (((min + max) / 2.0).to_array(), (max - min).length() / 2.0)
    }
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

    /// Models whose packs are open.
    fn open_count(&self) -> usize;

    /// Starts a session on a model. May read from disk, so it is called where blocking is allowed.
    ///
    /// # Errors
    /// [`OpenError`].
    fn open(&self, id: &str) -> Result<Box<dyn Core>, OpenError>;

    /// A model's picture as PNG, if it has one. May read from disk likewise.
    ///
    /// # Errors
    /// [`OpenError`].
    fn thumbnail(&self, id: &str) -> Result<Option<Vec<u8>>, OpenError>;
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

    fn get(&self, id: &str) -> Result<Arc<PackedModel>, OpenError> {
        let unknown = || OpenError::Unknown(id.into());
        self.repository.get(&id.parse().map_err(|_| unknown())?).map_err(|error| match error {
            RepositoryError::NotFound(_) => unknown(),
            other => OpenError::Unusable { id: id.into(), reason: with_causes(&other) },
        })
    }
}

impl Models for RepositoryModels {
    fn list(&self) -> Vec<ModelEntry> {
        let entries = match self.repository.list() {
            Ok(entries) => entries,
            Err(error) => {
                tracing::error!(%error, "the repository cannot be read");
                return Vec::new();
            }
        };
        let entry = |entry: crate::repository::ModelEntry| {
            let id = entry.id.to_string();
            match &entry.state {
                ModelState::Ready(model) => ModelEntry {
                    id,
                    title: model.info().title.clone(),
                    triangles: model.info().triangles,
                    vertices: model.info().vertices,
                    bytes: model.file_bytes(),
                    status: ModelStatus::Ready,
                    thumbnail: model.has_thumbnail().then(|| format!("/models/{}/thumbnail", entry.id)),
                    shape: Some(ModelShape::of(model.info())),
                },
                ModelState::Damaged(_) => ModelEntry {
                    id,
                    title: String::new(),
                    triangles: 0,
                    vertices: 0,
                    bytes: std::fs::metadata(&entry.path).map_or(0, |file| file.len()),
                    status: ModelStatus::Quarantined,
                    thumbnail: None,
                    shape: None,
                },
            }
        };
        entries.into_iter().map(entry).collect()
    }

    fn open_count(&self) -> usize {
        self.repository.open_count()
    }

    fn open(&self, id: &str) -> Result<Box<dyn Core>, OpenError> {
        let model = self.get(id)?;
        // We may wait for the disk here, and the first picture then need not.
        for page in model.first_pages(FIRST_PAGES) {
            let unusable = |reason: PackError| OpenError::Unusable { id: id.into(), reason: reason.to_string() };
            model.read_page(page).map_err(unusable)?;
        }
        Ok(Box::new(Session::reading_ahead(model, self.session)))
    }

    fn thumbnail(&self, id: &str) -> Result<Option<Vec<u8>>, OpenError> {
        let unusable = |reason: PackError| OpenError::Unusable { id: id.into(), reason: reason.to_string() };
        Ok(self.get(id)?.thumbnail().map_err(unusable)?.map(<[u8]>::to_vec))
    }
}

/// An error and what caused it: the section that is damaged stands at the end of the chain.
fn with_causes(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    causes.map(ToString::to_string).collect::<Vec<_>>().join(": ")
}
