//! `verify`: every byte and record of a model, checked.

use std::path::PathBuf;

use super::model_id;
use crate::repository::Repository;

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

/// Checks every byte and replays every record.
///
/// # Errors
/// Names the damaged section.
pub fn run(args: VerifyArgs) -> anyhow::Result<()> {
    let id = model_id(&args.model)?;
    let report = Repository::open(&args.repository)?.verify(&id)?;
    if args.json {
        println!("{}", serde_json::to_string(&report)?)
    } else {
        {
            println!(
                "{id}: sound; {} bytes, {} pages, {} spawns, {} splits replayed to {} vertices and {} triangles, hash {:016x}",
                report.bytes,
                report.pages,
                report.spawns,
                report.splits,
                report.vertices,
                report.triangles,
                report.hash
            );
        }
    }
    Ok(())
}
