//! `export`: a model's complete mesh as a file.

use std::path::{Path, PathBuf};

/// Write a model's complete mesh to a file.
#[derive(Clone, Debug, clap::Args)]
pub struct ExportArgs {
    /// The model's id.
    pub model: String,
    /// Directory that holds the models.
    #[arg(long, value_name = "DIR")]
    pub repository: PathBuf,
    /// The file to write; the format follows from its extension: `.ply`.
    #[arg(long, value_name = "FILE", value_parser = ply_path)]
    pub output: PathBuf,
}

/// A path that ends in `.ply`, for clap.
///
/// # Errors
/// One line that says so.
pub(super) fn ply_path(text: &str) -> Result<PathBuf, String> {
    let path = Path::new(text);
    match path.extension() {
        Some(extension) if extension.eq_ignore_ascii_case("ply") => Ok(path.into()),
        _ => Err("the name must end in `.ply`, the only format available yet".into()),
    }
}
