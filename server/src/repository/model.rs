//! Names of models, and models that are open.

use std::fmt;
use std::fs::File;
use std::io;
use std::str::FromStr;
use std::sync::Arc;

use super::store::Stamp;
use super::{RepositoryError, mmap};
use crate::pack::{PackError, PackedModel};

/// Name of a model: 1 to 64 characters of `a-z 0-9 . _ -`, the first a letter or digit. Safe as a file name and in an address.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct ModelId(String);

/// A text is no [`ModelId`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no model id: 1 to 64 of a-z, 0-9, '.', '_' and '-', beginning with a letter or digit")]
pub struct ModelIdError(pub String);

impl FromStr for ModelId {
    type Err = ModelIdError;

    fn from_str(text: &str) -> Result<Self, ModelIdError> {
        let plain = |c: u8| c.is_ascii_lowercase() || c.is_ascii_digit();
        let begins_well = text.bytes().next().is_some_and(plain);
        if begins_well && text.len() <= 64 && text.bytes().all(|c| plain(c) || b"._-".contains(&c)) {
            return Ok(Self(text.to_owned()));
        }
        // The text may be long and is only shown.
        Err(ModelIdError(text.chars().take(80).collect()))
    }
}

impl ModelId {
    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for ModelId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A model that was opened, or the reason why it could not be: kept until its file is replaced, so that damage is looked into
/// once.
#[derive(Debug)]
pub(super) struct OpenModel {
    stamp: Stamp,
    result: Result<Arc<PackedModel>, PackError>,
}

impl OpenModel {
    pub(super) fn open(file: &File, stamp: Stamp) -> io::Result<Self> {
        if stamp.bytes == 0 {
            // Not every system maps an empty file.
            return Ok(Self { stamp, result: Err(PackError::NotAPack) });
        }
        let mapped = mmap::map(file)?;
        Ok(Self { stamp, result: PackedModel::open(Arc::new(mapped)).map(Arc::new) })
    }

    pub(super) fn stamp(&self) -> Stamp {
        self.stamp
    }

    /// The model, unless it was or has become known to be damaged.
    pub(super) fn get(&self, id: &ModelId) -> Result<Arc<PackedModel>, RepositoryError> {
        let damaged = |reason: &PackError| RepositoryError::Damaged { id: id.to_string(), reason: reason.clone() };
        let model = self.result.as_ref().map_err(damaged)?;
        match model.damage() {
            Some(reason) => Err(damaged(reason)),
            None => Ok(model.clone()),
        }
    }
}
