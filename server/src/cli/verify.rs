//! `verify`: every byte and record of a model, checked, and on request whether its errors keep their word.

use std::path::PathBuf;

use anyhow::Context as _;

use super::model_id;
use super::progress::ProgressLine;
use crate::judge::calibration::{Calibration, CalibrationOptions, calibrate};
use crate::repository::Repository;

/// Check every byte and record of a model.
#[derive(Clone, Debug, clap::Args)]
pub struct VerifyArgs {
    /// The model's id.
    pub model: String,
    /// Directory that holds the models.
    #[arg(long, value_name = "DIR")]
    pub repository: PathBuf,
    /// Measure the real screen error over so many random views.
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    pub views: u64,
    /// Which random views.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Tolerance of all random views, in pixels [default: 0.5 to 4, another for each view].
    #[arg(long, value_name = "PX", value_parser = positive)]
    pub tolerance: Option<f32>,
    /// Print one JSON object and no progress.
    #[arg(long)]
    pub json: bool,
}

fn positive(text: &str) -> Result<f32, String> {
    let value: f32 = text.parse().map_err(|_| "not a number".to_owned())?;
    if value > 0.0 && value.is_finite() { Ok(value) } else { Err("not a positive number".into()) }
}

/// Checks every byte, replays every record, and measures the real screen error if there are views to try.
///
/// # Errors
/// Names the damaged section.
pub fn run(args: VerifyArgs) -> anyhow::Result<()> {
    let id = model_id(&args.model)?;
    let repository = Repository::open(&args.repository)?;
    let progress = ProgressLine::new(!args.json);
    progress.show("replay", 0, None);
    let report = repository.verify(&id)?;
    let mut calibration = None;
    if args.views > 0 {
        let model = repository.get(&id)?;
        let options = CalibrationOptions { views: args.views, seed: args.seed, tolerance_px: args.tolerance };
        let measured = calibrate(&model, &options, &mut |done| progress.show("views", done, Some(args.views)));
        calibration = Some(measured.with_context(|| format!("model {id}"))?);
    }
    drop(progress);
    if args.json {
        let mut line = serde_json::to_value(report)?;
        line["calibration"] = serde_json::to_value(&calibration)?;
        say!("{line}");
        return Ok(());
    }
    say!(
        "{id}: sound; {} bytes, {} pages, {} spawns, {} splits replayed to {} vertices and {} triangles, hash {:016x}",
        report.bytes,
        report.pages,
        report.spawns,
        report.splits,
        report.vertices,
        report.triangles,
        report.hash
    );
    if let Some(calibration) = &calibration {
        print(calibration)?;
    }
    Ok(())
}

fn print(calibration: &Calibration) -> std::io::Result<()> {
    let Calibration { views, seed, error, front_facing, .. } = calibration;
    say!(
        "screen error over {views} random views (seed {seed}), {} vertices, in units of the tolerance:",
        error.vertices
    );
    for (name, p) in [("unoccluded", error), ("front-facing", front_facing)] {
        say!("  {name:<13} p50 {:.3}  p99 {:.3}  p99.9 {:.3}  maximum {:.3}", p.p50, p.p99, p.p999, p.max);
    }
    say!(
        "  worst single view: p99.9 {:.3}, maximum in view {}; {} views with a vertex over the tolerance",
        calibration.worst_view_p999,
        calibration.worst_view,
        calibration.views_over_tolerance
    );
    if let Some(color) = &calibration.color {
        say!("  colour difference: mean {:.2} %, maximum {:.1} % of full scale", 100.0 * color.mean, 100.0 * color.max);
    }
    Ok(())
}
