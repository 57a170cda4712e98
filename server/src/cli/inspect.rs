//! `inspect`: what a model is made of.

use std::path::PathBuf;

use anyhow::Context as _;

use super::model_id;
use crate::repository::Repository;

/// Say what a model is made of.
#[derive(Clone, Debug, clap::Args)]
pub struct InspectArgs {
    /// The model's id.
    pub model: String,
    /// Directory that holds the models.
    #[arg(long, value_name = "DIR")]
    pub repository: PathBuf,
    /// Write the model's thumbnail to this file, as PNG.
    #[arg(long, value_name = "FILE")]
    pub thumbnail: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}

/// Prints what the model is made of.
///
/// # Errors
/// A model that cannot be used, or has no thumbnail to write.
pub fn run(args: InspectArgs) -> anyhow::Result<()> {
    let id = model_id(&args.model)?;
    let model = Repository::open(&args.repository)?.get(&id)?;
    if let Some(path) = &args.thumbnail {
        let png = model.thumbnail().with_context(|| format!("model {id}"))?;
        let png = png.with_context(|| format!("model {id} has no thumbnail"))?;
        std::fs::write(path, png).with_context(|| format!("cannot write {}", path.display()))?;
    }
    let found = crate::pack::inspect(&model).with_context(|| format!("model {id}"))?;
    if args.json {
        say!("{}", serde_json::to_string(&found)?);
    } else {
        say!("{}", found.to_string().trim_end());
    }
    Ok(())
}
