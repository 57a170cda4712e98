//! `export`: a model's mesh as a file, complete or as coarse as asked for.

use std::io::BufWriter;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use lodestream_protocol::view::UNLIMITED_TRIANGLES;

use super::{UsageError, model_id};
use crate::mesh::TriMesh;
use crate::mesh::export::{ExportFormat, write_as};
use crate::pack::{PackError, PackedModel, extract, extract_complete, replay_ops};
use crate::repository::Repository;
use crate::session::ops_by_error;

/// Write a model's mesh to a file: the complete one, or the best that a limit or an error allows.
#[derive(Clone, Debug, clap::Args)]
pub struct ExportArgs {
    /// The model's id.
    pub model: String,
    /// Directory that holds the models.
    #[arg(long, value_name = "DIR")]
    pub repository: PathBuf,
    /// The file to write; the format follows from its extension: `.ply`, `.obj`, `.stl` or `.glb`.
    #[arg(long, value_name = "FILE", value_parser = mesh_path)]
    pub output: PathBuf,
    /// Most triangles of the mesh.
    #[arg(long, value_name = "N")]
    pub triangles: Option<u32>,
    /// Largest error that may stay, in model units.
    #[arg(long, value_name = "E", value_parser = error_model)]
    pub error: Option<f64>,
}

/// Writes the mesh. Without limit or error it is exactly the cleaned input on its lattice.
///
/// # Errors
/// A model or a file that cannot be used, a limit below the smallest possible.
pub fn run(args: ExportArgs) -> anyhow::Result<()> {
    let id = model_id(&args.model)?;
    let model = Repository::open(&args.repository)?.get(&id)?;
    let smallest = model.info().smallest_limit;
    if let Some(limit) = args.triangles.filter(|&limit| limit < smallest) {
        return Err(UsageError(format!("{id} has no mesh of {limit} triangles; the smallest has {smallest}")).into());
    }
    let mesh = match (args.triangles, args.error) {
        (None, None) => extract_complete(&model),
        (limit, error) => coarse(&model, limit.unwrap_or(UNLIMITED_TRIANGLES), error),
    };
    let mesh = mesh.with_context(|| format!("model {id}"))?;
    write_mesh(&mesh, &args.output)?;
    say!("{}: {} vertices, {} triangles", args.output.display(), mesh.positions.len(), mesh.faces.len());
    Ok(())
}

fn coarse(model: &PackedModel, limit: u32, error: Option<f64>) -> Result<TriMesh, PackError> {
    let ops = ops_by_error(model, error, limit)?;
    Ok(extract(model, &replay_ops(model, ops.into_iter())?))
}

fn error_model(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|x: &f64| *x >= 0.0 && x.is_finite()).ok_or_else(|| "not a number from 0 on".into())
}

/// Writes a mesh file aside and renames it, so that no part of a file is ever left under the name.
pub(super) fn write_mesh(mesh: &TriMesh, path: &Path) -> anyhow::Result<()> {
    let format = ExportFormat::of(path).ok_or_else(|| UsageError(no_format()))?;
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}.part", std::process::id()));
    let aside = path.with_file_name(name);
    let write = || -> std::io::Result<()> {
        let mut out = BufWriter::new(std::fs::File::create(&aside)?);
        write_as(format, mesh, &mut out)?;
        out.into_inner().map_err(std::io::IntoInnerError::into_error)?.sync_all()?;
        std::fs::rename(&aside, path)
    };
    write().map_err(|error| {
        let _ = std::fs::remove_file(&aside);
        anyhow::Error::new(error).context(format!("cannot write {}", path.display()))
    })
}

fn no_format() -> String {
    "the name must end in `.ply`, `.obj`, `.stl` or `.glb`".into()
}

/// A path whose extension names a format, for clap.
///
/// # Errors
/// One line that says so.
pub(super) fn mesh_path(text: &str) -> Result<PathBuf, String> {
    let path = Path::new(text);
    if ExportFormat::of(path).is_some() { Ok(path.into()) } else { Err(no_format()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extensions_name_formats() {
        assert!(mesh_path("a.PLY").is_ok() && mesh_path("b/c.obj").is_ok() && mesh_path("d.glb").is_ok());
        assert!(mesh_path("ply").is_err() && mesh_path("a.xyz").is_err());
        assert_eq!(error_model("0.5"), Ok(0.5));
        assert!(error_model("-1").is_err() && error_model("NaN").is_err());
    }
}
