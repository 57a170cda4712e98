//! `lodestream load`: many clients in one process move through a model, and what they see of the server is measured.
//!
//! Each client is a task with the session core and the socket of the real client, behind a link of its own; nothing is drawn.
//!
//! - [`path`]: where cameras go. [`pace`], [`duty`]: when. [`drops`]: when connections break. `client`: one client. `totals`, `histogram`: what they measure, in bounded memory.
//! - [`metrics`]: what the server says about itself meanwhile. [`trace`], `ladder`: how the error of a view falls.
//! - [`report`]: the figures for people and machines. [`page`], `plot`: the same as a page with plots.
//!
//! Links are in [`net`](crate::net), below the WebSocket.

mod client;
pub mod drops;
pub mod duty;
mod histogram;
mod ladder;
pub mod metrics;
pub mod pace;
pub mod page;
pub mod path;
mod plot;
pub mod report;
mod totals;
pub mod trace;

use std::io::{self, IsTerminal, Write};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::Notify;
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until};

use crate::camera::{Detail, Viewport};
use crate::net::link::LinkShape;
use crate::net::target::Target;
use client::{Shared, chain, play};
use drops::Drops;
use duty::Duty;
use ladder::error_curves;
use metrics::Reader;
use pace::Pace;
use path::{Path, PathFile};
use report::Report;

/// Time between two progress lines.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(500);

/// What to run.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadOptions {
    /// The model.
    pub target: Target,
    /// How many clients.
    pub clients: u32,
    /// Over what time their beginnings are spread, evenly.
    pub ramp: Duration,
    /// How long each client moves, the path again and again; `None` ends it when the path has been walked once and its last
    /// view has settled.
    pub duration: Option<Duration>,
    /// Where cameras go.
    pub path: Path,
    /// The file that a recorded one comes from.
    pub path_file: Option<PathFile>,
    /// When.
    pub pace: Pace,
    /// How much of the time; of no account where views wait until the one before has settled.
    pub duty: Duty,
    /// Size of the images that nobody draws.
    pub viewport: Viewport,
    /// Vertical opening angle in radians.
    pub fov_y_rad: f32,
    /// How much to ask for.
    pub detail: Detail,
    /// Each client's link. The seed of the shape is not used: every client has its own.
    pub shape: LinkShape,
    /// Whose connections break, if any do. Clients whose do so come back and go on with their sessions.
    pub drops: Option<Drops>,
    /// What paths and links are drawn from.
    pub seed: u64,
    /// Threads that all clients share; 0 for one per core.
    pub threads: usize,
    /// Whether to find out how the error fell, which asks the server for some views again after the run.
    pub has_error_curves: bool,
}

/// Runs all clients to their end. Blocks this thread; progress goes to standard error if that is a terminal.
///
/// # Errors
/// The system grants no event queue or no threads. What goes wrong with clients is in the report.
pub fn run(options: LoadOptions) -> io::Result<Report> {
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    if options.threads > 0 {
        builder.worker_threads(options.threads);
    }
    let runtime = builder.enable_io().enable_time().build()?;
    Ok(runtime.block_on(run_clients(Arc::new(options))))
}

async fn run_clients(options: Arc<LoadOptions>) -> Report {
    let mut reader = Reader::new(&options.target, Instant::now());
    reader.begin().await;
    let stop = Arc::new(Notify::new());
    let reading = tokio::spawn(reader.go_on(Arc::clone(&stop)));
    let start = Instant::now();
    let shared = Shared::default();
    let mut clients = JoinSet::new();
    for index in 0..u64::from(options.clients) {
        let (options, shared) = (Arc::clone(&options), shared.clone());
        clients.spawn(async move {
            let share = index as f64 / f64::from(options.clients);
            sleep_until(start + options.ramp.mul_f64(share)).await;
            play(options, index, shared).await;
        });
    }
    let mut progress = Progress { is_terminal: io::stderr().is_terminal(), is_shown: false, before: (start, 0, 0) };
    let mut ticks = interval(PROGRESS_INTERVAL);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            ended = clients.join_next() => match ended {
                None => break,
                Some(Ok(())) => {}
                Some(Err(error)) => shared.lock().fail(format!("a bug of this program: {error}")),
            },
            _ = ticks.tick() => progress.show(&shared, options.clients, start),
        }
    }
    progress.clear();
    let elapsed = start.elapsed();
    let mut totals = std::mem::take(&mut *shared.lock());
    stop.notify_one();
    let server = match reading.await {
        Ok(reader) => reader.end(totals.connected, totals.connected_time).await.map_err(|error| chain(&error)),
        Err(error) => Err(format!("a bug of this program: {error}")),
    };
    let mut report = Report::new(&options, &totals, elapsed, server);
    if options.has_error_curves {
        // In the order of their numbers: the order in which clients end is no part of the result.
        totals.traces.sort_by_key(|(index, _)| *index);
        report.set_errors(error_curves(&options, totals.traces.into_iter().map(|(_, trace)| trace).collect()).await);
    }
    report
}

/// A line on the terminal that is written again and again.
struct Progress {
    is_terminal: bool,
    is_shown: bool,
    /// When it was shown last, and bytes and splits then.
    before: (Instant, u64, u64),
}

impl Progress {
    fn show(&mut self, shared: &Shared, planned: u32, start: Instant) {
        if !self.is_terminal {
            return;
        }
        let totals = shared.lock();
        let (all, now) = (totals.all(), Instant::now());
        let (running, ended, failed) =
            (totals.started - totals.completed - totals.failed, totals.completed, totals.failed);
        drop(totals);
        let (at, bytes, splits) = std::mem::replace(&mut self.before, (now, all.bytes_in, all.splits));
        let per_second = |count: u64| count as f64 / now.duration_since(at).as_secs_f64().max(1e-3);
        self.is_shown = true;
        // A terminal that went away is no reason to stop.
        let _ = write!(
            io::stderr(),
            "\r{:.0} s: {running} of {planned} clients running, {ended} done, {failed} failed, {} views, {:.2} MB/s, {:.0} k splits/s\x1b[K",
            now.duration_since(start).as_secs_f64(),
            all.views,
            per_second(all.bytes_in - bytes) / 1e6,
            per_second(all.splits - splits) / 1e3,
        );
    }

    fn clear(&mut self) {
        if std::mem::take(&mut self.is_shown) {
            let _ = write!(io::stderr(), "\r\x1b[K");
        }
    }
}
