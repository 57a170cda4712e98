//! `export`: a model's complete mesh as a file.

use std::io::BufWriter;
use std::path::{Path, PathBuf};

use anyhow::Context as _;

use super::model_id;
use crate::mesh::TriMesh;
use crate::mesh::export::{PlyOptions, write_ply};
use crate::pack::extract_complete;
use crate::repository::Repository;

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

/// Writes the complete mesh: exactly the cleaned input on its lattice.
///
/// # Errors
/// A model or a file that cannot be used.
pub fn run(args: ExportArgs) -> anyhow::Result<()> {
    let id = model_id(&args.model)?;
    let model = Repository::open(&args.repository)?.get(&id)?;
    let mesh = extract_complete(&model).with_context(|| format!("model {id}"))?;
    write_mesh(&mesh, &args.output)?;
    println!("{}: {} vertices, {} triangles", args.output.display(), mesh.positions.len(), mesh.faces.len());
    Ok(())
}

/// Writes a PLY file aside and renames it, so that no part of a file is ever left under the name.
pub(super) fn write_mesh(mesh: &TriMesh, path: &Path) -> anyhow::Result<()> {
    let aside = path.with_extension(format!("ply.{}.part", std::process::id()));
    let write = || -> std::io::Result<()> {
        let mut out = BufWriter::new(std::fs::File::create(&aside)?);
        write_ply(mesh, &PlyOptions::default(), &mut out)?;
        out.into_inner().map_err(std::io::IntoInnerError::into_error)?.sync_all()?;
        std::fs::rename(&aside, path)
    };
    write().map_err(|error| {
        let _ = std::fs::remove_file(&aside);
        anyhow::Error::new(error).context(format!("cannot write {}", path.display()))
    })
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
