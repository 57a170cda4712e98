//! What a server holds: a directory of published packs.
//!
//! A model with id `bunny` is the file `bunny.lodepack`. A published file never changes; publishing an id again puts another
//! file in its place, and who has the old one open keeps it. Its input may lie beside it as `bunny.original-<hash>.ply`. One bad pack fails that model and nothing else. This module knows
//! files and packs, neither sessions nor HTTP.

mod catalogue;
mod mmap;
mod model;
mod store;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, BufWriter, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

pub use catalogue::{ModelEntry, ModelState};
pub use model::{ModelId, ModelIdError};

use crate::pack::{PackError, PackedModel, VerifyReport, WriteError, thumbnail_edits, verify};
use model::OpenModel;
pub use store::Original;
use store::Store;

/// Why the repository cannot do what it was asked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RepositoryError {
    /// There is no such model.
    #[error("no model {0:?} in the repository")]
    NotFound(String),
    /// The model's pack is damaged; it stays refused until another file is published in its place.
    #[error("model {id:?} cannot be used")]
    Damaged {
        /// The model.
        id: String,
        /// What is wrong.
        #[source]
        reason: PackError,
    },
    /// Files cannot be read or written.
    #[error("{what}")]
    Io {
        /// What was tried.
        what: String,
        /// Why it failed.
        #[source]
        source: io::Error,
    },
    /// The writer of a pack to publish gave up; nothing was published.
    #[error("the pack was not written")]
    Write(#[source] Box<dyn std::error::Error + Send + Sync>),
}

impl RepositoryError {
    fn io(what: impl Into<String>) -> impl FnOnce(io::Error) -> Self {
        let what = what.into();
        move |source| Self::Io { what, source }
    }
}

/// The models in one directory. Shared by all threads.
#[derive(Debug)]
pub struct Repository {
    store: Store,
    open: Mutex<HashMap<ModelId, OpenModel>>,
}

impl Repository {
    /// Opens the repository in `directory`, which must exist.
    ///
    /// # Errors
    /// [`RepositoryError::Io`] if it is not a directory that can be read.
    pub fn open(directory: &Path) -> Result<Self, RepositoryError> {
        let what = format!("cannot open the repository {}", directory.display());
        std::fs::read_dir(directory).map_err(RepositoryError::io(what))?;
        Ok(Self { store: Store::new(directory), open: Mutex::default() })
    }

    /// Opens the repository in `directory` and makes the directory if need be.
    ///
    /// # Errors
    /// [`RepositoryError::Io`].
    pub fn open_or_create(directory: &Path) -> Result<Self, RepositoryError> {
        let what = format!("cannot make the repository {}", directory.display());
        std::fs::create_dir_all(directory).map_err(RepositoryError::io(what))?;
        Self::open(directory)
    }

    /// All models, by id. Reads the directory and opens the packs that were not open yet; unreadable and damaged ones are
    /// listed with the reason.
    ///
    /// # Errors
    /// [`RepositoryError::Io`] if the directory cannot be read.
    pub fn list(&self) -> Result<Vec<ModelEntry>, RepositoryError> {
        let mut entries = Vec::new();
        for (id, path) in self.store.list()? {
            // A file that vanished since is no longer a model.
            if let Some(state) = ModelState::of(self.get(&id)) {
                entries.push(ModelEntry { id, path, state });
            }
        }
        self.lock().retain(|id, _| entries.iter().any(|entry| entry.id == *id));
        Ok(entries)
    }

    /// The model with this id, opened if it was not. Costs a look at the file's attributes if it was, so that models that were
    /// published by another process meanwhile are found.
    ///
    /// # Errors
    /// [`RepositoryError::NotFound`], [`RepositoryError::Damaged`] (also when a page turned out to be damaged since),
    /// [`RepositoryError::Io`].
    pub fn get(&self, id: &ModelId) -> Result<Arc<PackedModel>, RepositoryError> {
        let (file, stamp) = self.store.open(id)?;
        if let Some(model) = self.lock().get(id).filter(|model| model.stamp() == stamp) {
            return model.get(id);
        }
        // Outside the lock: two threads may open the same model at once, and one of them wins.
        let model = OpenModel::open(&file, stamp).map_err(RepositoryError::io(format!("cannot map model {id}")))?;
        let mut open = self.lock();
        if let Some(model) = open.get(id).filter(|model| model.stamp() == stamp) {
            return model.get(id);
        }
        let result = model.get(id);
        open.insert(id.clone(), model);
        result
    }

    /// Models whose packs are open now.
    pub fn open_count(&self) -> usize {
        self.lock().len()
    }

    /// The directory itself.
    pub fn directory(&self) -> &Path {
        self.store.directory()
    }

    /// The file of a model, whether it exists or not.
    pub fn path(&self, id: &ModelId) -> PathBuf {
        self.store.path(id)
    }

    /// Checks every byte and record of a model's pack as it is on disk now, see [`verify`](fn@verify).
    ///
    /// # Errors
    /// As [`Repository::get`].
    pub fn verify(&self, id: &ModelId) -> Result<VerifyReport, RepositoryError> {
        let (file, _) = self.store.open(id)?;
        let mapped = mmap::map(&file).map_err(RepositoryError::io(format!("cannot map model {id}")))?;
        verify(Arc::new(mapped)).map_err(|reason| RepositoryError::Damaged { id: id.to_string(), reason })
    }

    /// Publishes what `write` writes as the model `id`, in place of an earlier one. The bytes go to a file aside, which is opened
    /// as a pack, synced and renamed, so that no reader and no crash ever leaves a part of a pack under the name. Leftovers of
    /// processes that died are removed.
    ///
    /// # Errors
    /// [`RepositoryError::Write`] with the error of `write`, [`RepositoryError::Damaged`] if it wrote no pack,
    /// [`RepositoryError::Io`]. An earlier model of that id is then still there.
    pub fn publish<T, E>(
        &self,
        id: &ModelId,
        write: impl FnOnce(&mut BufWriter<File>) -> Result<T, E>,
    ) -> Result<T, RepositoryError>
    where
        E: Into<Box<dyn std::error::Error + Send + Sync>>,
    {
        self.publish_with(id, None, write)
    }

    /// Copies the input of a model into the repository, for [`Repository::publish_with`]. Costs a copy of the file.
    ///
    /// # Errors
    /// [`RepositoryError::Io`].
    pub fn keep_original(&self, id: &ModelId, source: &Path) -> Result<Original, RepositoryError> {
        self.store.keep_original(id, source)
    }

    /// As [`Repository::publish`]; the model's `original`, whose name its metadata should hold, is there when the pack appears
    /// and stays, and originals of earlier models of that id are removed.
    ///
    /// # Errors
    /// Those of [`Repository::publish`]. The original is then removed, unless an earlier model has the same.
    pub fn publish_with<T, E>(
        &self,
        id: &ModelId,
        original: Option<Original>,
        write: impl FnOnce(&mut BufWriter<File>) -> Result<T, E>,
    ) -> Result<T, RepositoryError>
    where
        E: Into<Box<dyn std::error::Error + Send + Sync>>,
    {
        let written = self.store.publish(
            id,
            |out| write(out).map_err(|e| RepositoryError::Write(e.into())),
            |file| {
                let mapped = mmap::map(file).map_err(RepositoryError::io(format!("cannot map the new model {id}")))?;
                PackedModel::open(Arc::new(mapped))
                    .map(|_| ())
                    .map_err(|reason| RepositoryError::Damaged { id: id.to_string(), reason })
            },
        )?;
        self.store.retain_original(id, original.as_ref().map(Original::name));
        original.into_iter().for_each(|mut original| original.is_used());
        Ok(written)
    }

    /// [`publish_with`](Self::publish_with) of a pack that was written [with room](crate::pack::Metadata::leaves_room_for_thumbnail), with
    /// the thumbnail that `draw` makes of it.
    ///
    /// # Errors
    /// As there; [`RepositoryError::Write`] with the error of `draw` too.
    pub fn publish_with_thumbnail<T, E>(
        &self,
        id: &ModelId,
        original: Option<Original>,
        write: impl FnOnce(&mut BufWriter<File>) -> Result<T, E>,
        draw: impl FnOnce(&PackedModel) -> Result<Vec<u8>, E>,
    ) -> Result<T, RepositoryError>
    where
        E: Into<Box<dyn std::error::Error + Send + Sync>> + From<WriteError> + From<PackError> + From<io::Error>,
    {
        self.publish_with(id, original, |out| {
            let written = write(out)?;
            out.flush()?;
            let edits = {
                let model = PackedModel::open(Arc::new(mmap::map(out.get_ref())?))?;
                thumbnail_edits(&model, &draw(&model)?)?
            };
            // Nothing maps the file any more.
            for (at, bytes) in edits {
                out.seek(SeekFrom::Start(at))?;
                out.write_all(&bytes)?;
            }
            Ok::<T, E>(written)
        })
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<ModelId, OpenModel>> {
        // The map is whole between any two statements, so a panic elsewhere does not spoil it.
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
