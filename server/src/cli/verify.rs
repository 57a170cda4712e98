//! `verify`: every byte and record of a model, checked.

use std::path::PathBuf;

/// Check every byte and record of a model.
#[derive(Clone, Debug, clap::Args)]
pub struct VerifyArgs {
    /// The model's id.
    pub model: String,
    /// Directory that holds the models.
    #[arg(long, value_name = "DIR")]
    pub repository: PathBuf,
    /// Print one JSON object and no progress.
    #[arg(long)]
    pub json: bool,
}
