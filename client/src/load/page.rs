//! The report of a run as one HTML page that stands for itself: no scripts, nothing loaded from elsewhere. It is well-formed XML
//! too, so that programs can read it.

use std::fmt::{self, Display, Write as _};

use plotters::prelude::SeriesLabelPosition::{LowerRight, UpperLeft, UpperRight};

pub use super::plot::PlotError;
use super::plot::{Axis, Line, bars, lines, short};
use super::report::{Percentiles, Report};
use super::trace::{ErrorCurve, ErrorPoint};

const STYLE: &str = "body{font:15px/1.5 sans-serif;max-width:1240px;margin:2em auto;padding:0 1em;color:#222}\
h1{font-size:1.5em}h2{font-size:1.15em;margin:2em 0 .5em}table{border-collapse:collapse}\
td,th{padding:.15em .9em .15em 0;text-align:left;border-bottom:1px solid #ddd;font-variant-numeric:tabular-nums}\
.figures td+td,.figures th+th{text-align:right;padding:.15em 0 .15em 1.4em}\
svg{max-width:100%;height:auto}p{max-width:60em}.bad{color:#b02010}";

/// Errors below this are drawn there, in pixels.
const LEAST_ERROR_PX: f64 = 0.01;

/// The page.
///
/// # Errors
/// [`PlotError`] if a plot cannot be drawn.
pub fn html(report: &Report) -> Result<String, PlotError> {
    let mut page = Page::default();
    let model = report.model.as_deref().filter(|title| !title.is_empty()).unwrap_or(&report.options.url);
    page.raw("<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"/><title>lodestream load: ");
    page.text(model);
    page.raw(&format!("</title><style>{STYLE}</style></head>\n<body><h1>Load on "));
    page.text(model);
    page.raw("</h1>\n");
    for fault in report.faults() {
        page.element("p class=\"bad\"", &fault);
    }
    settings(&mut page, report);
    percentiles(&mut page, report)?;
    errors(&mut page, report)?;
    kinds(&mut page, report)?;
    timeline(&mut page, report)?;
    dropped(&mut page, report);
    server(&mut page, report)?;
    page.raw("</body></html>\n");
    Ok(page.0)
}

/// Text that is escaped unless it is ours.
#[derive(Default)]
struct Page(String);

impl Page {
    fn raw(&mut self, markup: &str) {
        self.0.push_str(markup);
    }

    fn text(&mut self, text: impl Display) {
        write!(Escaped(&mut self.0), "{text}").expect("a string takes all");
    }

    /// `tag` may have attributes.
    fn element(&mut self, tag: &str, text: impl Display) {
        self.raw(&format!("<{tag}>"));
        self.text(text);
        self.raw(&format!("</{}>\n", tag.split(' ').next().unwrap_or_default()));
    }

    fn row(&mut self, cell: &str, cells: impl IntoIterator<Item = String>) {
        self.raw("<tr>");
        for text in cells {
            self.element(cell, text);
        }
        self.raw("</tr>\n");
    }
}

/// Escapes what HTML and XML give a meaning; control characters, which XML forbids, become spaces.
struct Escaped<'a>(&'a mut String);

impl fmt::Write for Escaped<'_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for c in text.chars() {
            match c {
                '&' => self.0.push_str("&amp;"),
                '<' => self.0.push_str("&lt;"),
                '>' => self.0.push_str("&gt;"),
                '"' => self.0.push_str("&quot;"),
                '\'' => self.0.push_str("&#39;"),
                c if c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}') => self.0.push(' '),
                c => self.0.push(c),
            }
        }
        Ok(())
    }
}

fn settings(page: &mut Page, report: &Report) {
    let options = &report.options;
    let or = |value: Option<String>, other: &str| value.unwrap_or_else(|| other.into());
    let path = match &options.path_file {
        Some(file) => format!("{} views of {} (XXH3 {})", file.views, file.name, file.xxh3),
        None => options.path.into(),
    };
    let views = match options.view_rate {
        Some(rate) => format!("{rate} a second"),
        None if options.waits_until_settled => "the next when the one before has settled".into(),
        None => "at the times of the recording".into(),
    };
    let views = match options.duty {
        share if share < 1.0 => format!("{views}, {:.0} % of the time", 100.0 * share),
        _ => views,
    };
    let limit = options.triangle_limit;
    let limit = if limit == u32::MAX { "unlimited".into() } else { limit.to_string() };
    let rows = [
        ("server and model", options.url.clone()),
        (
            "clients",
            format!(
                "{} over {} s; {} got a stream, {} completed, {} failed",
                options.clients,
                options.ramp_s,
                report.clients.connected,
                report.clients.completed,
                report.clients.failed
            ),
        ),
        ("duration", or(options.duration_s.map(|s| format!("{s} s each")), "once along the path")),
        ("took", format!("{:.1} s", report.elapsed_s)),
        ("path", path),
        ("views", views),
        ("seed", options.seed.to_string()),
        ("image", format!("{} x {} px, {:.1} degrees", options.size_px[0], options.size_px[1], options.fov_deg)),
        ("tolerance", format!("{} px", options.tolerance_px)),
        ("triangles", limit),
        ("link rate", or(options.rate_bits_per_s.map(|rate| format!("{}bit/s", short(rate as f64))), "unlimited")),
        ("latency", format!("{} ms one way", options.latency_ms)),
        ("loss", format!("{} % of packets", options.loss * 100.0)),
        (
            "broken connections",
            match (options.drop_share, options.drop_every_s) {
                (Some(share), _) => format!("one of {} % of the clients", share * 100.0),
                (None, Some(mean)) => format!("each after {mean} s on average"),
                (None, None) => "none".into(),
            },
        ),
        ("stalls", or(options.stalls_ms.map(|[length, gap]| format!("{length} ms, {gap} ms apart")), "none")),
    ];
    page.raw("<h2>Settings</h2>\n<table>\n");
    for (name, value) in rows {
        page.row("td", [name.into(), value]);
    }
    page.raw("</table>\n");
    page.element(
        "p",
        "The same seed gives each client the same path, and its link the same losses and stalls. Times, and what follows from them, may \
         differ from run to run.",
    );
    for (cause, count) in &report.clients.failures {
        page.element("p class=\"bad\"", format_args!("{count} x {cause}"));
    }
}

fn percentiles(page: &mut Page, report: &Report) -> Result<(), PlotError> {
    page.raw("<h2>Percentiles</h2>\n<table class=\"figures\">\n");
    page.row("th", ["", "samples", "mean", "p50", "p90", "p99", "max"].map(String::from));
    for (name, digits, percentiles) in report.percentiles() {
        let Some(Percentiles { count, mean, p50, p90, p99, max }) = percentiles else {
            page.row("td", [name, "none", "", "", "", "", ""].map(String::from));
            continue;
        };
        let values = [mean, p50, p90, p99, max].map(|value| format!("{value:.digits$}"));
        page.row("td", [name.into(), count.to_string()].into_iter().chain(values));
    }
    page.raw("</table>\n");
    let curves = &report.curves;
    let line =
        |name: &str, points: &[(f64, f64)]| Line::new(name, points.iter().map(|&(s, x)| (x, s * 100.0)).collect());
    let times = [
        line("connected", &curves.connect_ms),
        line("first image", &curves.first_image_ms),
        line("first settled", &curves.first_settled_ms),
        line("view to first op", &curves.view_to_first_op_ms),
        line("view to settled", &curves.view_to_settled_ms),
    ];
    let percent = Axis::linear("at most, % of samples");
    page.raw(&lines("Times", [Axis::log("ms", 0.1), percent], &times, UpperLeft)?);
    let bytes = [
        line("until the first image", &curves.first_image_bytes),
        line("until first settled", &curves.first_settled_bytes),
        line("stale after a view", &curves.stale_bytes),
    ];
    page.raw(&lines("Bytes", [Axis::log("bytes", 1.0), percent], &bytes, UpperLeft)?);
    Ok(())
}

fn errors(page: &mut Page, report: &Report) -> Result<(), PlotError> {
    page.raw("<h2>How the error falls</h2>\n");
    page.element(
        "p",
        "Largest error that a view leaves at most, over the clients that were traced and whose view settled. The first view counts from \
         connecting, the second from being set, with the first settled. The server was asked after the run how many ops leave which \
         error, so a line has a step for every factor of two.",
    );
    if let Some(missing) = &report.error_curves_missing {
        page.element("p", format_args!("Something is missing here: {missing}."));
    }
    for (name, curve) in [("first view", &report.first_view_error), ("second view", &report.second_view_error)] {
        let Some(ErrorCurve { clients, by_bytes, by_time_ms }) = curve else { continue };
        let error = Axis::log("error, px", LEAST_ERROR_PX);
        for (what, axis, points) in
            [("bytes", Axis::log("bytes", 1.0), by_bytes), ("time", Axis::log("ms", 0.1), by_time_ms)]
        {
            let line = Line {
                name: format!("median, p10 to p90 of {clients}"),
                points: points.iter().map(|point| (point.at, point.p50)).collect(),
                band: points.iter().map(|&ErrorPoint { at, p10, p90, .. }| (at, p10, p90)).collect(),
            };
            page.raw(&lines(&format!("Error against {what}, {name}"), [axis, error], &[line], UpperRight)?);
        }
    }
    Ok(())
}

fn kinds(page: &mut Page, report: &Report) -> Result<(), PlotError> {
    let all = &report.all.counters;
    page.raw("<h2>What came</h2>\n");
    page.raw(&bars(
        "Bytes by kind",
        &[
            ("coded ops", all.op_bytes as f64),
            ("base, heads of batches", all.payload_in.saturating_sub(all.op_bytes) as f64),
            ("upgrade, frame headers", all.bytes_in.saturating_sub(all.payload_in) as f64),
            ("sent by clients", all.bytes_out as f64),
        ],
    )?);
    page.raw(&bars(
        "Ops by kind",
        &[
            ("fresh splits", all.splits.saturating_sub(all.cached_splits) as f64),
            ("cached splits", all.cached_splits as f64),
            ("collapses", all.collapses as f64),
            ("spawns", all.spawns as f64),
            ("despawns", all.despawns as f64),
        ],
    )?);
    Ok(())
}

fn timeline(page: &mut Page, report: &Report) -> Result<(), PlotError> {
    let mut from = 0.0;
    let mut rates = [Vec::new(), Vec::new()];
    for moment in &report.timeline {
        let seconds = moment.to_s - from;
        from = moment.to_s;
        rates[0].push((moment.to_s, moment.bytes_in as f64 / seconds));
        rates[1].push((moment.to_s, (moment.splits + moment.collapses) as f64 / seconds));
    }
    let time = Axis::linear("s since a client began to connect");
    let [bytes, ops] = rates;
    let rates = [Line::new("bytes", bytes), Line::new("splits and collapses", ops)];
    page.raw(&lines("Received by all clients", [time, Axis::log("a second", 1.0)], &rates, LowerRight)?);
    let triangles = report.timeline.iter().filter_map(|moment| Some((moment.to_s, moment.triangles?))).collect();
    let triangles = [Line::new("mean of a client", triangles)];
    page.raw(&lines("Triangles", [time, Axis::linear("triangles")], &triangles, LowerRight)?);
    Ok(())
}

fn dropped(page: &mut Page, report: &Report) {
    let rows = report.dropped_rows();
    if rows.is_empty() {
        return;
    }
    page.raw("<h2>Broken connections</h2>\n<table class=\"figures\">\n");
    for (name, value) in rows {
        page.row("td", [name.into(), value]);
    }
    page.raw("</table>\n");
}

fn server(page: &mut Page, report: &Report) -> Result<(), PlotError> {
    page.raw("<h2>Server</h2>\n");
    let Some(server) = &report.server else {
        let reason = report.server_missing.as_deref().unwrap_or("nobody asked");
        page.element("p", format_args!("No figures: {reason}."));
        return Ok(());
    };
    page.raw("<table class=\"figures\">\n");
    for (name, value) in report.server_rows() {
        page.row("td", [name.into(), value]);
    }
    page.raw("</table>\n");
    let cores = server.readings.windows(2).filter_map(|pair| {
        let seconds = pair[1].at_s - pair[0].at_s;
        (seconds > 0.0).then(|| (pair[1].at_s, (pair[1].cpu_s - pair[0].cpu_s) / seconds))
    });
    let time = Axis::linear("s since the run began");
    let cores = [Line::new("cores used", cores.collect())];
    page.raw(&lines("Processor time of the server", [time, Axis::linear("cores")], &cores, LowerRight)?);
    let memory = |of: fn(&super::metrics::Reading) -> f64| -> Vec<(f64, f64)> {
        server.readings.iter().map(|reading| (reading.at_s, of(reading) / 1e6)).collect()
    };
    let memory = [
        Line::new("resident", memory(|reading| reading.resident_bytes)),
        Line::new("sessions, by their account", memory(|reading| reading.session_bytes)),
    ];
    page.raw(&lines("Memory of the server", [time, Axis::linear("MB")], &memory, LowerRight)?);
    Ok(())
}

#[cfg(test)]
mod tests;
