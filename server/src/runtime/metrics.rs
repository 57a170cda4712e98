//! What the server counts, as Prometheus reads it (text format 0.0.4). Names are documented in `docs/metrics.md`, and a test
//! compares the two.
//!
//! Counters are atomics that are added to once for each slice of a session, never for an op, and no label holds what comes from
//! outside: the number of time series is fixed when the server starts.

use std::sync::Arc;
use std::time::Duration;

use lodestream_protocol::message::CloseCode;
use prometheus::core::Collector;
use prometheus::{
    Histogram, HistogramOpts, IntCounter, IntCounterVec, IntGauge, IntGaugeVec, Opts, Registry, TextEncoder,
};

use crate::session::{Activity, SessionStats};

/// What [`Metrics::render`] gives, as a media type.
pub const CONTENT_TYPE: &str = "text/plain; version=0.0.4; charset=utf-8";

/// Upper bounds of times in seconds, from 20 µs to 2.6 s by factors of 2.
const BUCKETS: usize = 18;
const SHORTEST_S: f64 = 20e-6;

/// Why a stream was not opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// All places are taken.
    Full,
    /// Sessions hold as much memory as they may.
    Memory,
    /// A page of another site asked.
    Origin,
    /// No such model, or a damaged one.
    Model,
    /// The request is no WebSocket upgrade.
    NoWebSocket,
    /// The server stops.
    ShuttingDown,
    /// The server failed.
    Internal,
}

impl Refusal {
    const ALL: [Self; 7] =
        [Self::Full, Self::Memory, Self::Origin, Self::Model, Self::NoWebSocket, Self::ShuttingDown, Self::Internal];

    fn label(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::Memory => "memory",
            Self::Origin => "origin",
            Self::Model => "model",
            Self::NoWebSocket => "no_websocket",
            Self::ShuttingDown => "shutting_down",
            Self::Internal => "internal",
        }
    }
}

fn close_label(code: CloseCode) -> &'static str {
    match code {
        CloseCode::Normal => "normal",
        CloseCode::GoingAway => "going_away",
        CloseCode::Malformed => "malformed",
        CloseCode::Version => "version",
        CloseCode::LimitTooSmall => "limit_too_small",
        CloseCode::Full => "full",
        CloseCode::ModelDamaged => "model_damaged",
        CloseCode::Internal => "internal",
        CloseCode::Timeout => "timeout",
        CloseCode::TakenOver => "taken_over",
    }
}

/// What became of a session whose connection broke, or of the wish to go on with one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Resumption {
    /// The session is kept for its client.
    Parked,
    /// The client came back to it.
    Resumed,
    /// The client did not come in time.
    Expired,
    /// It gave way to others, or to the end of the server.
    Displaced,
    /// A client asked for a session that it cannot have, and began anew.
    Refused,
}

impl Resumption {
    const ALL: [Self; 5] = [Self::Parked, Self::Resumed, Self::Expired, Self::Displaced, Self::Refused];

    fn label(self) -> &'static str {
        match self {
            Self::Parked => "parked",
            Self::Resumed => "resumed",
            Self::Expired => "expired",
            Self::Displaced => "displaced",
            Self::Refused => "refused",
        }
    }
}

/// The state of a session without a connection.
const PARKED: &str = "parked";

fn activity_label(activity: Activity) -> &'static str {
    match activity {
        Activity::Moving => "moving",
        Activity::Settled => "settled",
        Activity::Resting => "resting",
    }
}

/// Gauges that are read when somebody asks, from whoever owns the numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Readings {
    /// Models whose packs are open.
    pub open_models: u64,
    /// Pages read and checked so far.
    pub pages_read: u64,
    /// Slices that panicked so far.
    pub panics: u64,
}

/// See the module.
#[derive(Debug)]
pub struct Metrics {
    registry: Registry,
    sessions: IntGaugeVec,
    session_bytes: IntGauge,
    admitted: IntCounter,
    refused: IntCounterVec,
    closed: IntCounterVec,
    resumptions: IntCounterVec,
    bytes_sent: IntCounter,
    bytes_sent_again: IntCounter,
    bytes_received: IntCounter,
    batches: IntCounter,
    views: IntCounter,
    resets: IntCounter,
    rests: IntCounter,
    wakes: IntCounter,
    splits: IntCounter,
    cached_splits: IntCounter,
    collapses: IntCounter,
    spawns: IntCounter,
    despawns: IntCounter,
    view_seconds: Histogram,
    batch_seconds: Histogram,
    queue_seconds: Histogram,
    open_models: IntGauge,
    pages_read: IntCounter,
    panics: IntCounter,
    cpu_seconds: prometheus::Counter,
    resident_bytes: IntGauge,
}

impl Default for Metrics {
    fn default() -> Self {
        Self::new()
    }
}

impl Metrics {
    /// Everything at zero.
    pub fn new() -> Self {
        let registry = Registry::new();
        let sessions =
            keep(&registry, IntGaugeVec::new(Opts::new("lodestream_sessions", "Sessions by state."), &["state"]));
        for activity in [Activity::Moving, Activity::Settled, Activity::Resting] {
            sessions.with_label_values(&[activity_label(activity)]);
        }
        sessions.with_label_values(&[PARKED]);
        let refused = counters(&registry, "lodestream_refused_total", "Streams refused, by reason.", "reason");
        Refusal::ALL.iter().for_each(|reason| drop(refused.with_label_values(&[reason.label()])));
        let closed = counters(&registry, "lodestream_closed_total", "Streams closed, by close code.", "code");
        CloseCode::ALL.iter().for_each(|&code| drop(closed.with_label_values(&[close_label(code)])));
        let resumptions = counters(
            &registry,
            "lodestream_resumptions_total",
            "Sessions whose connection broke, by outcome.",
            "outcome",
        );
        Resumption::ALL.iter().for_each(|outcome| drop(resumptions.with_label_values(&[outcome.label()])));
        let ops = counters(&registry, "lodestream_ops_total", "Ops sent, by kind.", "kind");
        let kind = |kind| ops.with_label_values(&[kind]);
        let counter = |name, help| keep(&registry, IntCounter::new(name, help));
        let gauge = |name, help| keep(&registry, IntGauge::new(name, help));
        let times = |name: &str, help: &str| {
            let buckets = prometheus::exponential_buckets(SHORTEST_S, 2.0, BUCKETS).expect("constants that fit");
            keep(&registry, Histogram::with_opts(HistogramOpts::new(name, help).buckets(buckets)))
        };
        Self {
            sessions,
            refused,
            closed,
            resumptions,
            session_bytes: gauge("lodestream_session_memory_bytes", "Memory that sessions hold."),
            admitted: counter("lodestream_admitted_total", "Streams opened."),
            bytes_sent: counter("lodestream_sent_bytes_total", "Bytes of frames sent."),
            bytes_sent_again: counter(
                "lodestream_sent_again_bytes_total",
                "Bytes of batches sent a second time, over connections that took the place of broken ones.",
            ),
            bytes_received: counter("lodestream_received_bytes_total", "Bytes of frames received."),
            batches: counter("lodestream_batches_total", "Batches sent."),
            views: counter("lodestream_views_total", "Views received."),
            resets: counter("lodestream_resets_total", "Resets that clients asked for."),
            rests: counter("lodestream_rests_total", "Mirrors dropped by sessions at rest."),
            wakes: counter("lodestream_wakes_total", "Mirrors rebuilt."),
            splits: kind("split"),
            cached_splits: kind("cached_split"),
            collapses: kind("collapse"),
            spawns: kind("spawn"),
            despawns: kind("despawn"),
            view_seconds: times("lodestream_view_seconds", "Compute time from a view to the first frame for it."),
            batch_seconds: times("lodestream_batch_seconds", "Compute time of a slice that gives a batch."),
            queue_seconds: times("lodestream_queue_wait_seconds", "Time that a slice waits for a compute thread."),
            open_models: gauge("lodestream_open_models", "Models whose packs are open."),
            pages_read: counter("lodestream_pages_read_total", "Pages read and checked for sessions."),
            panics: counter("lodestream_panics_total", "Slices that panicked."),
            cpu_seconds: keep(
                &registry,
                prometheus::Counter::new("process_cpu_seconds_total", "Processor time used, user and system."),
            ),
            resident_bytes: gauge("process_resident_memory_bytes", "Resident memory, 0 where the system does not say."),
            registry,
        }
    }

    /// A stream was opened.
    pub fn note_admitted(&self) {
        self.admitted.inc();
    }

    /// A stream was refused.
    pub fn note_refused(&self, why: Refusal) {
        self.refused.with_label_values(&[why.label()]).inc();
    }

    /// A stream was closed.
    pub fn note_closed(&self, code: CloseCode) {
        self.closed.with_label_values(&[close_label(code)]).inc();
    }

    /// See [`Resumption`].
    pub fn note_resumption(&self, outcome: Resumption) {
        self.resumptions.with_label_values(&[outcome.label()]).inc();
    }

    /// A frame came in.
    pub fn note_received(&self, bytes: usize) {
        self.bytes_received.inc_by(bytes as u64);
    }

    /// A slice waited so long.
    pub fn note_queue_wait(&self, time: Duration) {
        self.queue_seconds.observe(time.as_secs_f64());
    }

    /// A slice gave a batch.
    pub fn note_batch_time(&self, time: Duration) {
        self.batch_seconds.observe(time.as_secs_f64());
    }

    /// The first frame for a view took so long to compute.
    pub fn note_view_time(&self, time: Duration) {
        self.view_seconds.observe(time.as_secs_f64());
    }

    /// Bytes that sessions hold by their own account.
    pub fn session_bytes(&self) -> u64 {
        u64::try_from(self.session_bytes.get()).unwrap_or(0)
    }

    /// Everything as text.
    pub fn render(&self, readings: Readings) -> String {
        self.open_models.set(to_gauge(readings.open_models));
        raise(&self.pages_read, readings.pages_read);
        raise(&self.panics, readings.panics);
        let cpu = processor_time().as_secs_f64();
        self.cpu_seconds.inc_by((cpu - self.cpu_seconds.get()).max(0.0));
        self.resident_bytes.set(to_gauge(resident_bytes()));
        let mut text = String::new();
        TextEncoder::new()
            .encode_utf8(&self.registry.gather(), &mut text)
            .expect("writing into memory does not fail, and no family is empty");
        text
    }
}

/// A session's share of the sums, taken out of the gauges when it is dropped.
#[derive(Debug)]
pub struct Account {
    metrics: Arc<Metrics>,
    counted: SessionStats,
    is_parked: bool,
}

impl Account {
    /// A new session.
    pub fn new(metrics: Arc<Metrics>) -> Self {
        let counted = SessionStats::default();
        metrics.sessions.with_label_values(&[activity_label(counted.activity)]).inc();
        Self { metrics, counted, is_parked: false }
    }

    /// The metrics that this is a share of.
    pub fn metrics(&self) -> &Metrics {
        &self.metrics
    }

    /// What the session last said of itself.
    pub fn stats(&self) -> &SessionStats {
        &self.counted
    }

    /// Adds what has changed since the last call.
    pub fn update(&mut self, stats: SessionStats) {
        let (sums, old) = (&self.metrics, std::mem::replace(&mut self.counted, stats));
        for (counter, new, old) in [
            (&sums.bytes_sent, stats.bytes_sent, old.bytes_sent),
            (&sums.bytes_sent_again, stats.bytes_sent_again, old.bytes_sent_again),
            (&sums.batches, stats.batches, old.batches),
            (&sums.views, stats.views, old.views),
            (&sums.resets, stats.resets, old.resets),
            (&sums.rests, stats.rests, old.rests),
            (&sums.wakes, stats.wakes, old.wakes),
            // Cached splits are a kind of their own: kinds add up to all ops.
            (&sums.splits, stats.splits - stats.cached_splits, old.splits - old.cached_splits),
            (&sums.cached_splits, stats.cached_splits, old.cached_splits),
            (&sums.collapses, stats.collapses, old.collapses),
            (&sums.spawns, stats.spawns, old.spawns),
            (&sums.despawns, stats.despawns, old.despawns),
        ] {
            if new > old {
                counter.inc_by(new - old);
            }
        }
        if stats.heap_bytes != old.heap_bytes {
            sums.session_bytes.add(to_gauge(stats.heap_bytes) - to_gauge(old.heap_bytes));
        }
        if stats.activity != old.activity && !self.is_parked {
            self.state(old.activity).dec();
            self.state(stats.activity).inc();
        }
    }

    /// Whether the session has no connection.
    pub fn set_parked(&mut self, is_parked: bool) {
        self.current_state().dec();
        self.is_parked = is_parked;
        self.current_state().inc();
    }

    fn current_state(&self) -> IntGauge {
        match self.is_parked {
            true => self.metrics.sessions.with_label_values(&[PARKED]),
            false => self.state(self.counted.activity),
        }
    }

    fn state(&self, activity: Activity) -> IntGauge {
        self.metrics.sessions.with_label_values(&[activity_label(activity)])
    }
}

impl Drop for Account {
    fn drop(&mut self) {
        self.current_state().dec();
        self.metrics.session_bytes.sub(to_gauge(self.counted.heap_bytes));
    }
}

fn keep<C: Collector + Clone + 'static>(registry: &Registry, metric: prometheus::Result<C>) -> C {
    let metric = metric.expect("names and buckets are constants that fit");
    registry.register(Box::new(metric.clone())).expect("each name is used once");
    metric
}

fn counters(registry: &Registry, name: &str, help: &str, label: &str) -> IntCounterVec {
    keep(registry, IntCounterVec::new(Opts::new(name, help), &[label]))
}

/// Sets a counter to what its owner has counted. Two readers at once may overtake each other, so it never falls.
fn raise(counter: &IntCounter, to: u64) {
    counter.inc_by(to.saturating_sub(counter.get()));
}

fn to_gauge(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

/// Processor time that this process has used, user and system; zero where the system does not say.
fn processor_time() -> Duration {
    #[cfg(unix)]
    {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
        Duration::new(u64::try_from(time.tv_sec).unwrap_or(0), u32::try_from(time.tv_nsec).unwrap_or(0))
    }
    #[cfg(not(unix))]
    Duration::ZERO
}

/// Resident memory; zero where there is no `/proc`.
fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kibibytes = line.and_then(|line| line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok());
    kibibytes.unwrap_or(0) * 1024
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(text: &str, series: &str) -> f64 {
        let line = text.lines().find_map(|line| line.strip_prefix(series)?.strip_prefix(' '));
        line.unwrap_or_else(|| panic!("no {series} in\n{text}")).parse().unwrap()
    }

    #[test]
    fn the_table_in_the_docs_lists_what_is_printed() {
        let text = Metrics::new().render(Readings::default());
        let mut printed: Vec<(&str, &str)> =
            text.lines().filter_map(|line| line.strip_prefix("# TYPE ")?.split_once(' ')).collect();
        printed.sort_unstable();
        let docs = include_str!("../../../docs/metrics.md");
        let mut documented: Vec<(&str, &str)> = docs
            .lines()
            .filter_map(|line| {
                let (name, rest) = line.strip_prefix("| `")?.split_once("` | ")?;
                Some((name, rest.split_once(" |")?.0))
            })
            .collect();
        documented.sort_unstable();
        assert_eq!(printed, documented);
        // Label values too: each stands in the docs in quotes.
        for line in text.lines().filter(|line| !line.starts_with('#') && !line.contains("le=\"")) {
            if let Some((_, label)) = line.split_once('{') {
                let (_, value) = label.split_once("=\"").unwrap();
                let value = value.split_once('"').unwrap().0;
                assert!(docs.contains(&format!("`{value}`")), "{value} is not in the docs");
            }
        }
    }

    #[test]
    fn sessions_add_up_and_leave_nothing_behind_in_gauges() {
        let metrics = Arc::new(Metrics::new());
        let mut account = Account::new(metrics.clone());
        let mut other = Account::new(metrics.clone());
        let stats = SessionStats {
            bytes_sent: 1000,
            bytes_sent_again: 100,
            splits: 30,
            cached_splits: 10,
            heap_bytes: 500,
            activity: Activity::Settled,
            ..SessionStats::default()
        };
        account.update(stats);
        account.update(SessionStats { bytes_sent: 1500, heap_bytes: 200, activity: Activity::Resting, ..stats });
        other.update(SessionStats { heap_bytes: 7, ..SessionStats::default() });
        let text = metrics.render(Readings { open_models: 3, pages_read: 9, panics: 1 });
        for (series, expected) in [
            ("lodestream_sent_bytes_total", 1500.0),
            ("lodestream_sent_again_bytes_total", 100.0),
            ("lodestream_ops_total{kind=\"split\"}", 20.0),
            ("lodestream_ops_total{kind=\"cached_split\"}", 10.0),
            ("lodestream_session_memory_bytes", 207.0),
            ("lodestream_sessions{state=\"resting\"}", 1.0),
            ("lodestream_sessions{state=\"moving\"}", 1.0),
            ("lodestream_open_models", 3.0),
            ("lodestream_pages_read_total", 9.0),
            ("lodestream_panics_total", 1.0),
        ] {
            assert_eq!(value(&text, series), expected, "{series}");
        }
        #[cfg(target_os = "linux")]
        assert!(value(&text, "process_cpu_seconds_total") > 0.0 && value(&text, "process_resident_memory_bytes") > 1e6);
        drop((account, other));
        let text = metrics.render(Readings::default());
        assert_eq!(value(&text, "lodestream_session_memory_bytes"), 0.0);
        assert_eq!(value(&text, "lodestream_sessions{state=\"resting\"}"), 0.0);
        assert_eq!(value(&text, "lodestream_sessions{state=\"moving\"}"), 0.0);
        assert_eq!(value(&text, "lodestream_sent_bytes_total"), 1500.0, "counters stay");
        assert_eq!(value(&text, "lodestream_pages_read_total"), 9.0);
    }
}
