//! Whether a model's errors keep their word: what is sent for random views, measured.

use lodestream_protocol::view::View;
use serde::Serialize;

use super::original::Original;
use super::random_views::random_view;
use super::screen_error::{Candidate, ColorDifference, Percentiles, findings};
use crate::mesh::TriMesh;
use crate::pack::{PackError, PackedModel, extract, extract_complete, replay_ops};
use crate::session::ops_for_view;

/// Bins per tolerance of the distribution over all views.
const BINS_PER_UNIT: usize = 1024;
/// Tolerances that the bins reach; the rest goes into the last.
const BIN_UNITS: usize = 16;
/// Fewest vertices that a view must show for its percentiles to be told: of fewer, one is more than 0.1 %.
const MIN_VERTICES: usize = 1000;

/// Which views [`calibrate`] tries.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CalibrationOptions {
    /// How many.
    pub views: u64,
    /// Names the sequence of views.
    pub seed: u64,
    /// Tolerance of all views in pixels, or `None` for that which comes with each random view.
    pub tolerance_px: Option<f32>,
}

/// What [`calibrate`] found: errors of unoccluded, front-facing vertices in units of the tolerance of their view.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Calibration {
    /// Views tried.
    pub views: u64,
    /// Names the sequence of views.
    pub seed: u64,
    /// Over the vertices of all views together; percentiles to a thousandth.
    pub error: Percentiles,
    /// The same over all front-facing vertices, whether something hides them or not.
    pub front_facing: Percentiles,
    /// Largest 99.9th percentile of a single view with at least 1,000 vertices to judge.
    pub worst_view_p999: f64,
    /// Number of the view with the largest error.
    pub worst_view: u64,
    /// Views in which some vertex was off by more than the tolerance.
    pub views_over_tolerance: u64,
    /// Ops of all views together.
    pub ops: u64,
    /// Colour difference at those vertices, for models with colours.
    pub color: Option<ColorDifference>,
}

/// Builds what a client would be sent for some random views ([`random_view`]) and measures how far the complete mesh
/// strays from it. `progress` hears how many views are done. About 2 us for each vertex that a view shows, on one core; runs
/// in the caller's thread pool.
///
/// A vertex whose whole component is missing counts as far off as its component is large, not as the next other component is
/// away: that much is not seen, and it is what the error of a spawn says.
///
/// # Errors
/// [`PackError`] if a record is damaged.
pub fn calibrate(
    model: &PackedModel,
    options: &CalibrationOptions,
    progress: &mut dyn FnMut(u64),
) -> Result<Calibration, PackError> {
    let CalibrationOptions { views, seed, tolerance_px } = *options;
    let original = Original::new(&extract_complete(model)?);
    let mut out = Calibration { views, seed, ..Calibration::default() };
    let (mut unoccluded, mut front_facing) = (Histogram::default(), Histogram::default());
    let (mut color_max, mut color_sum) = (0.0f64, 0.0);
    for index in 0..views {
        progress(index);
        let mut view = random_view(&original, seed, index);
        view.tolerance_px = tolerance_px.unwrap_or(view.tolerance_px);
        let (mesh, ops) = mesh_for_view(model, &view)?;
        out.ops += ops as u64;
        // Nothing of an open model is left coarse for facing away.
        let mut shown_view = view.clone();
        shown_view.two_sided |= model.info().is_open;
        let found = findings(&original, &original.shown(&shown_view), &Candidate::new(&mesh), &view);
        let tolerance = f64::from(view.tolerance_px);
        let mut errors = Vec::with_capacity(found.len());
        for finding in &found {
            let size = original.component_size(finding.shown.vertex) * view.pixel_scale() / finding.shown.depth;
            let error = finding.pixels.min(size) / tolerance;
            front_facing.add(error);
            if finding.shown.is_unoccluded {
                unoccluded.add(error);
                errors.push(error);
                let color = finding.color.unwrap_or(0.0);
                color_max = color_max.max(color);
                color_sum += color;
            }
        }
        let own = Percentiles::of(&mut errors);
        if own.max > out.error.max {
            out.error.max = own.max;
            out.worst_view = index;
        }
        if own.vertices >= MIN_VERTICES {
            out.worst_view_p999 = out.worst_view_p999.max(own.p999);
        }
        out.views_over_tolerance += u64::from(own.max > 1.0);
    }
    progress(views);
    out.error = unoccluded.percentiles();
    out.front_facing = front_facing.percentiles();
    out.color = model
        .info()
        .has_colors
        .then(|| ColorDifference { max: color_max, mean: color_sum / out.error.vertices.max(1) as f64 });
    Ok(out)
}

/// The mesh that a client holds once a view is settled, and the number of ops in it.
///
/// # Errors
/// [`PackError`] if a record is damaged.
pub fn mesh_for_view(model: &PackedModel, view: &View) -> Result<(TriMesh, usize), PackError> {
    let ops = ops_for_view(model, view)?;
    Ok((extract(model, &replay_ops(model, ops.iter().copied())?), ops.len()))
}

/// Distribution of errors in units of the tolerance.
#[derive(Default)]
struct Histogram {
    bins: Vec<u64>,
    count: u64,
    max: f64,
}

impl Histogram {
    fn add(&mut self, error: f64) {
        self.bins.resize(BINS_PER_UNIT * BIN_UNITS, 0);
        // `as` saturates.
        let bin = ((error * BINS_PER_UNIT as f64) as usize).min(self.bins.len() - 1);
        self.bins[bin] += 1;
        self.count += 1;
        self.max = self.max.max(error);
    }

    /// Percentiles rounded up to the end of their bin.
    fn percentiles(&self) -> Percentiles {
        let at = |share: f64| {
            let wanted = (self.count as f64 * share) as u64;
            let mut total = 0;
            let bin = self.bins.iter().position(|&count| {
                total += count;
                total > wanted
            });
            bin.map_or(0.0, |bin| ((bin + 1) as f64 / BINS_PER_UNIT as f64).min(self.max))
        };
        Percentiles { vertices: self.count as usize, p50: at(0.5), p99: at(0.99), p999: at(0.999), max: self.max }
    }
}
