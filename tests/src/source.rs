//! Where the meshes of a measurement come from: files that were named, those of [`MESHES_VAR`], or generated ones.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};
use lodestream_server::ingest::read::read_mesh_in_memory;
use lodestream_server::mesh::TriMesh;

/// Name of the variable with a folder of meshes to measure.
pub const MESHES_VAR: &str = "LODESTREAM_MESHES";

/// Where a mesh comes from.
#[derive(Clone, Debug)]
pub enum Source {
    /// A mesh file.
    File(PathBuf),
    /// Generated, with a name.
    Made(&'static str, fn() -> TriMesh),
}

impl Source {
    /// The files named.
    pub fn of_files(files: Vec<PathBuf>) -> Vec<Self> {
        files.into_iter().map(Self::File).collect()
    }

    /// Those of `names` in the folder [`MESHES_VAR`], or `made` if the variable is not set. Says on standard error what is not
    /// as the targets have it.
    ///
    /// # Errors
    /// If the folder has none of them.
    pub fn of_targets(names: &[&str], made: &[Self]) -> anyhow::Result<Vec<Self>> {
        let Some(folder) = std::env::var_os(MESHES_VAR) else {
            let names = names.join(", ");
            eprintln!(
                "{MESHES_VAR} is not set: the figures are those of generated meshes. For those of the targets set it to a folder \
                 with {names}, or name mesh files."
            );
            return Ok(made.to_vec());
        };
        let folder = Path::new(&folder);
        let (there, missing): (Vec<_>, Vec<_>) =
            names.iter().map(|name| folder.join(name)).partition(|file| file.is_file());
        ensure!(!there.is_empty(), "{MESHES_VAR}: {} has none of {}", folder.display(), names.join(", "));
        missing.iter().for_each(|file| eprintln!("left out, as it is not there: {}", file.display()));
        Ok(Self::of_files(there))
    }

    /// Stem of the file, or the name.
    pub fn name(&self) -> String {
        match self {
            Self::File(file) => file.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default(),
            Self::Made(name, _) => (*name).to_owned(),
        }
    }

    /// The mesh.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn mesh(&self) -> anyhow::Result<TriMesh> {
        match self {
            Self::File(file) => Ok(read_mesh_in_memory(file).with_context(|| file.display().to_string())?.0),
            Self::Made(_, make) => Ok(make()),
        }
    }
}
