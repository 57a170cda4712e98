//! `inspect`: what a model is made of.

use std::path::PathBuf;

/// Say what a model is made of.
#[derive(Clone, Debug, clap::Args)]
pub struct InspectArgs {
    /// The model's id.
    pub model: String,
    /// Directory that holds the models.
    #[arg(long, value_name = "DIR")]
    pub repository: PathBuf,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}
