//! The figures of a run: JSON for machines, a table for people.

use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use serde::Serialize;

use super::LoadOptions;
use super::drops::Drops;
pub use super::histogram::Percentiles;
use super::ladder::ErrorCurves;
pub use super::metrics::ServerFigures;
use super::pace::Pace;
use super::path::{Path, PathFile};
use super::totals::{Counters, Interval, Totals};
pub use super::totals::{SingleKind, SingleKindBatches};
use super::trace::ErrorCurve;
use crate::net::link::LinkRate;

/// What was asked for.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Asked {
    /// Address of the stream.
    pub url: String,
    /// Clients.
    pub clients: u32,
    /// Time over which they begin, in seconds.
    pub ramp_s: f64,
    /// How long each moves, `None` for once along the path.
    pub duration_s: Option<f64>,
    /// Name of the path.
    pub path: &'static str,
    /// Where a recorded one comes from.
    pub path_file: Option<PathFile>,
    /// Views per second, `None` if views follow the recording or wait until the one before has settled.
    pub view_rate: Option<f64>,
    /// Whether they wait.
    pub waits_until_settled: bool,
    /// Share of the time in which a client moves.
    pub duty: f64,
    /// Size of the images in pixels.
    pub size_px: [u32; 2],
    /// Vertical opening angle in degrees.
    pub fov_deg: f32,
    /// Tolerance in pixels.
    pub tolerance_px: f32,
    /// Triangle limit.
    pub triangle_limit: u32,
    /// Rate of each link in bits per second and direction, `None` for unlimited.
    pub rate_bits_per_s: Option<u64>,
    /// One-way latency in milliseconds.
    pub latency_ms: f64,
    /// Share of packets lost.
    pub loss: f64,
    /// Length of a stall, and mean time from one to the next, in milliseconds.
    pub stalls_ms: Option<[f64; 2]>,
    /// Share of clients that lose their connection once.
    pub drop_share: Option<f64>,
    /// Mean time that a client's connection lasts, in seconds.
    pub drop_every_s: Option<f64>,
    /// Seed of paths and links.
    pub seed: u64,
}

/// How many clients came how far.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Clients {
    /// Began to connect.
    pub started: u64,
    /// Got a stream.
    pub connected: u64,
    /// Came to their end.
    pub completed: u64,
    /// Did not.
    pub failed: u64,
    /// How many failed for which reason.
    pub failures: BTreeMap<String, u64>,
}

/// Connections that broke because that was asked for.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Dropped {
    /// How many.
    pub connections: u64,
    /// After how many the session went on.
    pub resumed: u64,
    /// After how many it began anew.
    pub begun_anew: u64,
    /// From the break to the server's answer over the next connection, waits included.
    pub time_to_answer_ms: Option<Percentiles>,
    /// Bytes that had come of frames when these broke off.
    pub cut_off_bytes: u64,
    /// Bytes of batches that the server sent a second time, by its own account.
    pub sent_again_bytes: Option<f64>,
}

/// Sums over a part of the run, and what follows from them.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Part {
    /// The sums.
    #[serde(flatten)]
    pub counters: Counters,
    /// Everything received, in bits, for each split, cached ones included.
    pub bits_per_split: Option<f64>,
    /// Everything received, in bits, for each op of any kind.
    pub bits_per_op: Option<f64>,
    /// Coded ops alone, in bits, for each op of any kind.
    pub coded_bits_per_op: Option<f64>,
    /// Splits for each second of processor time in the core. The collapses among them cost time too.
    pub splits_per_core_cpu_s: Option<f64>,
    /// Ops for each such second.
    pub ops_per_core_cpu_s: Option<f64>,
}

impl Part {
    fn new(counters: Counters) -> Self {
        let ratio = |a: f64, b: f64| (b > 0.0).then(|| a / b);
        let (bits, cpu) = (counters.bytes_in as f64 * 8.0, counters.core_cpu.as_secs_f64());
        Self {
            bits_per_split: ratio(bits, counters.splits as f64),
            bits_per_op: ratio(bits, counters.ops() as f64),
            coded_bits_per_op: ratio(counters.op_bytes as f64 * 8.0, counters.ops() as f64),
            splits_per_core_cpu_s: ratio(counters.splits as f64, cpu),
            ops_per_core_cpu_s: ratio(counters.ops() as f64, cpu),
            counters,
        }
    }
}

/// A piece of the time since clients began to connect, each on its own clock.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Moment {
    /// Where it ends, in seconds.
    pub to_s: f64,
    /// Bytes received by all clients.
    pub bytes_in: u64,
    /// Splits applied by all.
    pub splits: u64,
    /// Collapses applied by all.
    pub collapses: u64,
    /// Mean number of triangles of a client, `None` if nobody looked.
    pub triangles: Option<f64>,
    /// Share of looks that found the newest view settled.
    pub settled: Option<f64>,
}

/// Percentile curves: share of samples, from 0.01 to 1, and the least value that so many do not exceed.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Curves {
    pub(super) connect_ms: Vec<(f64, f64)>,
    pub(super) first_image_ms: Vec<(f64, f64)>,
    pub(super) first_image_bytes: Vec<(f64, f64)>,
    pub(super) first_settled_ms: Vec<(f64, f64)>,
    pub(super) first_settled_bytes: Vec<(f64, f64)>,
    pub(super) view_to_first_op_ms: Vec<(f64, f64)>,
    pub(super) view_to_settled_ms: Vec<(f64, f64)>,
    pub(super) stale_bytes: Vec<(f64, f64)>,
}

/// All figures. Times are in milliseconds. A percentile that has no samples is absent.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// What was asked for.
    pub options: Asked,
    /// The model's title.
    pub model: Option<String>,
    /// Seconds from beginning to end.
    pub elapsed_s: f64,
    /// Who came how far.
    pub clients: Clients,
    /// Connection and upgrade, over clients.
    pub connect_ms: Option<Percentiles>,
    /// First image, from beginning to connect, over clients.
    pub first_image_ms: Option<Percentiles>,
    /// Bytes received until then.
    pub first_image_bytes: Option<Percentiles>,
    /// The first view that settles, from beginning to connect, over clients.
    pub first_settled_ms: Option<Percentiles>,
    /// Bytes received until then.
    pub first_settled_bytes: Option<Percentiles>,
    /// From setting a view to applying the first batch for it or for a later one, over views.
    pub view_to_first_op_ms: Option<Percentiles>,
    /// From setting a view to its being settled, over the views that lived to see it.
    pub view_to_settled_ms: Option<Percentiles>,
    /// Bytes received while a view was the newest in batches for an earlier one, over all views but the clients' first.
    pub stale_bytes: Option<Percentiles>,
    /// Error left in a settled view, in pixels, as the server states it.
    pub settled_error_px: Option<Percentiles>,
    /// Settled views for which the triangle limit kept wanted ops out.
    pub limited_views: u64,
    /// From connecting to the second view.
    pub first_view: Part,
    /// From the second view on.
    pub moving: Part,
    /// Both.
    pub all: Part,
    /// Batches with ops of one kind.
    pub single_kind_batches: SingleKindBatches,
    /// Most triangles that a client held after any op.
    pub max_triangles_seen: u32,
    /// Clients that held more than they allowed.
    pub limits_exceeded: u64,
    /// Times that the two ends disagreed about a mesh.
    pub resets: u64,
    /// Batches dropped until the server began again.
    pub dropped_batches: u64,
    /// Connections that broke, if that was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dropped: Option<Dropped>,
    /// What the server says about itself, if it does.
    pub server: Option<ServerFigures>,
    /// Why not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub server_missing: Option<String>,
    /// How the error of clients' first views fell, if that was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub first_view_error: Option<ErrorCurve>,
    /// Likewise for second views that were set when the first had settled.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub second_view_error: Option<ErrorCurve>,
    /// Why one of them is not there, or not over all clients.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error_curves_missing: Option<String>,
    /// What happened when.
    pub timeline: Vec<Moment>,
    #[serde(skip)]
    pub(super) curves: Curves,
}

impl Report {
    pub(super) fn new(
        options: &LoadOptions,
        totals: &Totals,
        elapsed: Duration,
        server: Result<ServerFigures, String>,
    ) -> Self {
        const MILLI: f64 = 1e3;
        let (server, server_missing) = match server {
            Ok(figures) => (Some(figures), None),
            Err(reason) => (None, Some(reason)),
        };
        Self {
            options: Asked::new(options),
            model: totals.model.clone(),
            elapsed_s: elapsed.as_secs_f64(),
            clients: Clients {
                started: totals.started,
                connected: totals.connected,
                completed: totals.completed,
                failed: totals.failed,
                failures: totals.failures.clone(),
            },
            connect_ms: totals.connect.summary(MILLI),
            first_image_ms: totals.first_image.summary(MILLI),
            first_image_bytes: totals.first_image_bytes.summary(1.0),
            first_settled_ms: totals.first_settled.summary(MILLI),
            first_settled_bytes: totals.first_settled_bytes.summary(1.0),
            view_to_first_op_ms: totals.view_to_first_op.summary(MILLI),
            view_to_settled_ms: totals.view_to_settled.summary(MILLI),
            stale_bytes: totals.stale_bytes.summary(1.0),
            settled_error_px: totals.settled_error.summary(1e6),
            limited_views: totals.limited,
            first_view: Part::new(totals.first_view),
            moving: Part::new(totals.moving),
            all: Part::new(totals.all()),
            single_kind_batches: totals.single_kind,
            max_triangles_seen: totals.max_triangles_seen,
            limits_exceeded: totals.limits_exceeded,
            resets: totals.resets,
            dropped_batches: totals.dropped_batches,
            dropped: options.drops.map(|_| Dropped {
                connections: totals.dropped.connections,
                resumed: totals.dropped.resumed,
                begun_anew: totals.dropped.begun_anew,
                time_to_answer_ms: totals.dropped.back.summary(MILLI),
                cut_off_bytes: totals.dropped.cut_off_bytes,
                sent_again_bytes: server.as_ref().map(|server| server.sent_again_bytes),
            }),
            server,
            server_missing,
            first_view_error: None,
            second_view_error: None,
            error_curves_missing: None,
            curves: Curves {
                connect_ms: totals.connect.curve(MILLI),
                first_image_ms: totals.first_image.curve(MILLI),
                first_image_bytes: totals.first_image_bytes.curve(1.0),
                first_settled_ms: totals.first_settled.curve(MILLI),
                first_settled_bytes: totals.first_settled_bytes.curve(1.0),
                view_to_first_op_ms: totals.view_to_first_op.curve(MILLI),
                view_to_settled_ms: totals.view_to_settled.curve(MILLI),
                stale_bytes: totals.stale_bytes.curve(1.0),
            },
            timeline: (1..)
                .zip(&totals.timeline.intervals)
                .map(|(number, interval)| Moment::new(totals.timeline.length * number, interval))
                .collect(),
        }
    }

    pub(super) fn set_errors(&mut self, errors: ErrorCurves) {
        let ErrorCurves { first, second, missing } = errors;
        (self.first_view_error, self.second_view_error, self.error_curves_missing) = (first, second, missing);
    }

    /// Names, digits behind the point and figures, as they stand in tables.
    pub(super) fn percentiles(&self) -> [(&'static str, usize, &Option<Percentiles>); 9] {
        [
            ("connected, ms", 1, &self.connect_ms),
            ("first image, ms", 1, &self.first_image_ms),
            ("first image, bytes", 0, &self.first_image_bytes),
            ("first settled, ms", 1, &self.first_settled_ms),
            ("first settled, bytes", 0, &self.first_settled_bytes),
            ("view to first op, ms", 1, &self.view_to_first_op_ms),
            ("view to settled, ms", 1, &self.view_to_settled_ms),
            ("stale bytes after a view", 0, &self.stale_bytes),
            ("error when settled, px", 3, &self.settled_error_px),
        ]
    }

    /// What became of connections that broke, as it stands in tables; none if none were to.
    pub(super) fn dropped_rows(&self) -> Vec<(&'static str, String)> {
        let Some(dropped) = &self.dropped else { return Vec::new() };
        let Dropped { connections, resumed, begun_anew, time_to_answer_ms, cut_off_bytes, sent_again_bytes } = dropped;
        let time =
            |of: fn(&Percentiles) -> f64| time_to_answer_ms.as_ref().map_or("-".into(), |t| format!("{:.1}", of(t)));
        vec![
            ("connections broken", connections.to_string()),
            ("  resumed", resumed.to_string()),
            ("  begun anew", begun_anew.to_string()),
            ("  until answered, ms, p50", time(|t| t.p50)),
            ("  p99", time(|t| t.p99)),
            ("  max", time(|t| t.max)),
            ("  bytes cut off", cut_off_bytes.to_string()),
            ("  bytes sent again", sent_again_bytes.map_or("-".into(), |bytes| format!("{bytes:.0}"))),
        ]
    }

    /// The server's figures as they stand in tables; none if there are none.
    pub(super) fn server_rows(&self) -> Vec<(&'static str, String)> {
        let Some(server) = &self.server else { return Vec::new() };
        let number = |value: Option<f64>, digits: usize| value.map_or("-".into(), |value| format!("{value:.digits$}"));
        let mega = |bytes: f64| format!("{:.1}", bytes / 1e6);
        vec![
            ("server cpu, s", number(Some(server.cpu_s), 2)),
            ("  per client, s", number(server.cpu_s_per_client, 4)),
            ("  per client and s, ms", number(server.cpu_s_per_client_s.map(|cpu| cpu * 1e3), 3)),
            ("clients per core", number(server.clients_per_core, 0)),
            ("resident before, MB", mega(server.resident_bytes_before)),
            ("  at most, MB", mega(server.resident_bytes_peak)),
            ("  after, MB", mega(server.resident_bytes_after)),
            ("sessions at most", number(Some(server.sessions_peak), 0)),
            ("  kB for each", number(server.session_bytes_per_session.map(|bytes| bytes / 1e3), 1)),
            ("refused", number(Some(server.refused), 0)),
            ("resets", number(Some(server.resets), 0)),
        ]
    }

    /// What went wrong, in words; empty if nothing did.
    pub fn faults(&self) -> Vec<String> {
        let of = |count: u64, text: &str| (count > 0).then(|| format!("{count} {text}"));
        [
            of(self.clients.failed, "clients failed"),
            of(self.resets, "times client and server disagreed about a mesh"),
            of(self.limits_exceeded, "clients held more triangles than their limit"),
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}

impl Asked {
    fn new(options: &LoadOptions) -> Self {
        Self {
            url: options.target.to_string(),
            clients: options.clients,
            ramp_s: options.ramp.as_secs_f64(),
            duration_s: options.duration.map(|duration| duration.as_secs_f64()),
            path: match options.path {
                Path::Orbit => "orbit",
                Path::Zoom => "zoom",
                Path::Fly => "fly",
                Path::Jump => "jump",
                Path::Recorded(_) => "recorded",
            },
            path_file: options.path_file.clone(),
            view_rate: match options.pace {
                Pace::PerSecond(rate) => Some(rate),
                Pace::Settled | Pace::Recorded => None,
            },
            waits_until_settled: options.pace == Pace::Settled,
            duty: options.duty.share(),
            size_px: [options.viewport.width_px, options.viewport.height_px],
            fov_deg: options.fov_y_rad.to_degrees(),
            tolerance_px: options.detail.tolerance_px,
            triangle_limit: options.detail.triangle_limit,
            rate_bits_per_s: match options.shape.rate {
                LinkRate::Unlimited => None,
                LinkRate::BitsPerSec(rate) => Some(rate),
            },
            latency_ms: options.shape.latency.as_secs_f64() * 1e3,
            loss: options.shape.loss,
            stalls_ms: options
                .shape
                .stalls
                .map(|stalls| [stalls.length, stalls.interval].map(|t| t.as_secs_f64() * 1e3)),
            drop_share: match options.drops {
                Some(Drops::Share(share)) => Some(share),
                Some(Drops::Every(_)) | None => None,
            },
            drop_every_s: match options.drops {
                Some(Drops::Every(mean)) => Some(mean.as_secs_f64()),
                Some(Drops::Share(_)) | None => None,
            },
            seed: options.seed,
        }
    }
}

impl Moment {
    fn new(to: Duration, interval: &Interval) -> Self {
        let mean = |sum: u64| (interval.samples > 0).then(|| sum as f64 / interval.samples as f64);
        Self {
            to_s: to.as_secs_f64(),
            bytes_in: interval.bytes_in,
            splits: interval.splits,
            collapses: interval.collapses,
            triangles: mean(interval.triangles),
            settled: mean(interval.settled),
        }
    }
}

impl fmt::Display for Report {
    /// A summary for people.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Clients { started, connected, completed, failed, failures } = &self.clients;
        let title: String = self.model.iter().flat_map(|title| title.chars()).filter(|c| !c.is_control()).collect();
        writeln!(f, "model    {} {title}", self.options.url)?;
        writeln!(
            f,
            "clients  {started} started, {connected} connected, {completed} completed, {failed} failed, {:.1} s",
            self.elapsed_s
        )?;
        for (cause, count) in failures {
            writeln!(f, "         {count} x {cause}")?;
        }
        writeln!(f)?;
        let head = ["samples", "mean", "p50", "p90", "p99", "max"];
        writeln!(f, "{:<28}{}", "", head.map(|word| format!("{word:>12}")).concat())?;
        for (name, digits, percentiles) in self.percentiles() {
            let Some(Percentiles { count, mean, p50, p90, p99, max }) = percentiles else {
                writeln!(f, "{name:<28}{:>12}", "none")?;
                continue;
            };
            let values = [mean, p50, p90, p99, max].map(|value| format!("{value:>12.digits$}")).concat();
            writeln!(f, "{name:<28}{count:>12}{values}")?;
        }
        writeln!(f)?;
        let parts = [&self.first_view, &self.moving, &self.all];
        writeln!(f, "{:<28}{:>16}{:>16}{:>16}", "", "first view", "moving", "all")?;
        let mut row = |name: &str, value: &dyn Fn(&Part) -> String| {
            writeln!(f, "{name:<28}{}", parts.map(|part| format!("{:>16}", value(part))).concat())
        };
        row("bytes in", &|part| part.counters.bytes_in.to_string())?;
        row("bytes out", &|part| part.counters.bytes_out.to_string())?;
        row("views", &|part| part.counters.views.to_string())?;
        row("  served", &|part| part.counters.views_served.to_string())?;
        row("  settled", &|part| part.counters.views_settled.to_string())?;
        row("batches", &|part| part.counters.batches.to_string())?;
        row("  bytes of coded ops", &|part| part.counters.op_bytes.to_string())?;
        row("splits", &|part| part.counters.splits.to_string())?;
        row("  cached", &|part| part.counters.cached_splits.to_string())?;
        row("collapses", &|part| part.counters.collapses.to_string())?;
        row("spawns", &|part| part.counters.spawns.to_string())?;
        row("despawns", &|part| part.counters.despawns.to_string())?;
        let number = |value: Option<f64>, digits: usize| value.map_or("-".into(), |value| format!("{value:.digits$}"));
        row("bits per split, all in", &|part| number(part.bits_per_split, 2))?;
        row("bits per op, all in", &|part| number(part.bits_per_op, 2))?;
        row("bits per op, coded", &|part| number(part.coded_bits_per_op, 2))?;
        row("core, k splits per cpu s", &|part| number(part.splits_per_core_cpu_s.map(|rate| rate / 1e3), 0))?;
        row("core, k ops per cpu s", &|part| number(part.ops_per_core_cpu_s.map(|rate| rate / 1e3), 0))?;
        writeln!(f)?;
        let dropped = self.dropped_rows();
        for (name, value) in &dropped {
            writeln!(f, "{name:<28}{value:>12}")?;
        }
        if !dropped.is_empty() {
            writeln!(f)?;
        }
        for (name, value) in self.server_rows() {
            writeln!(f, "{name:<28}{value:>12}")?;
        }
        if let Some(reason) = &self.server_missing {
            writeln!(f, "no figures of the server: {reason}")?;
        }
        writeln!(f)?;
        let SingleKindBatches { fresh_splits, cached_splits, collapses } = &self.single_kind_batches;
        for (name, kind) in [("fresh splits", fresh_splits), ("cached splits", cached_splits), ("collapses", collapses)]
        {
            if let Some((coded, received)) = kind.bits_per_op.zip(kind.bits_per_op_received) {
                let SingleKind { batches, ops, .. } = kind;
                writeln!(
                    f,
                    "{coded:.2} bits per op, {received:.2} with headers, in {batches} batches of {ops} {name} and nothing else"
                )?;
            }
        }
        let limit = self.options.triangle_limit;
        let allowed = if limit == u32::MAX { "unlimited".into() } else { format!("{limit} allowed") };
        write!(f, "{} triangles at most, {allowed}; ", self.max_triangles_seen)?;
        write!(f, "{} settled views were limited; {} resets", self.limited_views, self.resets)
    }
}
