//! `sample`: a generated scan of any size.

use std::path::PathBuf;

use super::UsageError;
use super::export::{mesh_path, write_mesh};
use crate::ingest::sample::{MAX_TRIANGLES, MIN_TRIANGLES, SampleOptions, generate_with};

/// Write a generated scan of any size.
#[derive(Clone, Debug, clap::Args)]
pub struct SampleArgs {
    /// Triangles of the scan, about.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub triangles: u64,
    /// Another seed gives another scan.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Scanner noise along the normal: its standard deviation in mean edge lengths; real scans have 0.05 to 0.3.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = noise)]
    pub noise: f64,
    /// The file to write, in the format PLY.
    #[arg(value_name = "FILE", value_parser = mesh_path)]
    pub output: PathBuf,
}

/// Generates and writes the scan.
///
/// # Errors
/// A number of triangles out of range, or a file that cannot be written.
pub fn run(args: SampleArgs) -> anyhow::Result<()> {
    let triangles = sample_size(args.triangles)?;
    let mesh = generate_with(&SampleOptions { triangles, seed: args.seed, noise: args.noise });
    write_mesh(&mesh, &args.output)?;
    say!("{}: {} vertices, {} triangles", args.output.display(), mesh.positions.len(), mesh.faces.len());
    Ok(())
}

fn noise(text: &str) -> Result<f64, String> {
    let share: f64 = text.parse().map_err(|_| format!("`{text}` is no number"))?;
    if (0.0..=1.0).contains(&share) { Ok(share) } else { Err("noise is 0 to 1 mean edge lengths".into()) }
}

/// A number of triangles that the generator can make.
///
/// # Errors
/// States the range.
pub(super) fn sample_size(triangles: u64) -> Result<usize, UsageError> {
    let range = MIN_TRIANGLES..=MAX_TRIANGLES;
    usize::try_from(triangles).ok().filter(|n| range.contains(n)).ok_or_else(|| {
        UsageError(format!("a sample has {MIN_TRIANGLES} to {MAX_TRIANGLES} triangles, not {triangles}"))
    })
}
