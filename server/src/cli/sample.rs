//! `sample`: a generated scan of any size.

use std::path::PathBuf;

use super::export::ply_path;

/// Write a generated scan of any size.
#[derive(Clone, Debug, clap::Args)]
pub struct SampleArgs {
    /// Triangles of the scan, about.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub triangles: u64,
    /// Another seed gives another scan.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// The file to write, in the format PLY.
    #[arg(value_name = "FILE", value_parser = ply_path)]
    pub output: PathBuf,
}
