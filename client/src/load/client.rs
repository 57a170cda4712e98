//! One client: a real session over a real socket, a camera that moves, and what it measures on the way.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use fastrand::Rng;
use glam::DVec3;
use lodestream_protocol::ids::ViewSeq;
use lodestream_protocol::message::CloseCode;
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::ViewError;

use super::LoadOptions;
use super::drops::Schedule;
use super::duty::Duty;
use super::pace::Pace;
use super::path::{Path, Pose, poses};
use super::totals::{Counters, FIRST_INTERVAL, Interval, Phase, SingleKind, SingleKindBatches, Totals};
use super::trace::{Point, Trace};
use crate::camera::{Bounds, Camera};
use crate::core::{ClientConfig, ClientError, ClientSession, Connectivity, Stats};
use crate::net::native::{Connection, Delivery, Event, NetError};

/// How long a server may say nothing at all while something is due from it.
const SILENCE: Duration = Duration::from_secs(30);
/// How long to wait before frames are offered again to a connection that takes no more.
const RETRY: Duration = Duration::from_millis(10);

/// Why a client ended early.
#[derive(Debug, thiserror::Error)]
pub(super) enum Failure {
    #[error(transparent)]
    Net(#[from] NetError),
    #[error(transparent)]
    Session(#[from] ClientError),
    #[error("the view makes no sense")]
    View(#[from] ViewError),
    #[error("the server has sent nothing for {} s", SILENCE.as_secs())]
    Silent,
}

/// Sums of all clients. A lock is held for a few additions only.
#[derive(Clone, Debug, Default)]
pub(super) struct Shared(Arc<Mutex<Totals>>);

impl Shared {
    pub(super) fn lock(&self) -> MutexGuard<'_, Totals> {
        // Sums of a client that panicked are as good as those of one that failed.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Connects, moves and measures until the path or the time ends. Failures are counted, not returned.
pub(super) async fn play(options: Arc<LoadOptions>, index: u64, shared: Shared) {
    shared.lock().started += 1;
    let result = run(&options, index, &shared).await;
    let mut totals = shared.lock();
    match result {
        Ok(()) => totals.completed += 1,
        Err(failure) => totals.fail(chain(&failure)),
    }
}

/// The error and what it comes from, in one line.
pub(super) fn chain(error: &dyn std::error::Error) -> String {
    std::iter::successors(error.source(), |source| source.source())
        .fold(error.to_string(), |text, source| format!("{text}: {source}"))
}

async fn run(options: &LoadOptions, index: u64, shared: &Shared) -> Result<(), Failure> {
    let mut rng = Rng::with_seed(seed_of(options.seed, index));
    let mut shape = options.shape;
    shape.seed = rng.u64(..);
    let mut connection = Connection::open(&options.target, shape).await?;
    {
        let mut totals = shared.lock();
        totals.connected += 1;
        totals.connect.add(micros(connection.now().0));
    }
    let mut client = Client::new(options, rng, shape.seed, shared);
    client.trace = (options.has_error_curves && Trace::includes(index, options.clients)).then(Trace::default);
    let result = client.drive(&mut connection).await;
    client.finish(&connection);
    {
        let mut totals = shared.lock();
        totals.connected_time += connection.now().0;
        totals.traces.extend(client.trace.take().map(|trace| (index, trace)));
    }
    match &result {
        Ok(()) => connection.close(CloseCode::Normal).await,
        Err(Failure::Session(ClientError::InboxFull)) => connection.close(CloseCode::Internal).await,
        Err(Failure::Session(_)) => connection.close(CloseCode::Malformed).await,
        Err(_) => {}
    }
    result
}

/// Seeds of neighbours that have nothing in common (the finaliser of splitmix64).
fn seed_of(seed: u64, index: u64) -> u64 {
    let mut x = seed.wrapping_add((index + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

fn micros(time: Duration) -> u64 {
    u64::try_from(time.as_micros()).unwrap_or(u64::MAX)
}

/// What is known about the newest view.
#[derive(Clone, Copy, Debug)]
struct Watched {
    seq: ViewSeq,
    set_at: Timestamp,
    is_settled: bool,
    stale_bytes: u64,
}

/// A session as all clients have it.
pub(super) fn session_config(options: &LoadOptions) -> ClientConfig {
    ClientConfig {
        triangle_limit: options.detail.triangle_limit,
        // The path says when a view is due.
        view_interval: Duration::ZERO,
        ..ClientConfig::default()
    }
}

struct Client<'a> {
    options: &'a LoadOptions,
    rng: Rng,
    shared: &'a Shared,
    session: ClientSession,
    bounds: Option<Bounds>,
    poses: Vec<Pose>,
    /// When the first view was set.
    began: Timestamp,
    /// Place in a period of motion and rest at which the client began, from 0 to 1.
    phase_of_motion: f64,
    /// Number of the newest view of the path, counted on over its repetitions.
    step: u64,
    watched: Option<Watched>,
    /// Views that no batch was applied for, nor for a later one, and when they were set. A server that is silent for
    /// [`SILENCE`] ends the client, which bounds them.
    unserved: VecDeque<(ViewSeq, Timestamp)>,
    phase: Phase,
    has_first_image: bool,
    has_settled: bool,
    drops: Schedule,
    /// When the connection broke, until the server has answered over the next one.
    broke_at: Option<Timestamp>,
    /// What was not yet added to the shared sums.
    counters: Counters,
    single_kind: SingleKindBatches,
    /// What of the connection's counts is in the counters.
    counted_in: u64,
    counted_out: u64,
    next_flush: Timestamp,
    /// What the report's curves of error are made of.
    trace: Option<Trace>,
}

impl<'a> Client<'a> {
    /// `seed` is that of the link.
    fn new(options: &'a LoadOptions, mut rng: Rng, seed: u64, shared: &'a Shared) -> Self {
        let phase_of_motion = if options.duty == Duty::ALWAYS { 0.0 } else { rng.f64() };
        Self {
            phase_of_motion,
            options,
            rng,
            shared,
            session: ClientSession::new(ClientConfig { reconnect_seed: seed, ..session_config(options) }),
            bounds: None,
            poses: Vec::new(),
            began: Timestamp::default(),
            step: 0,
            watched: None,
            unserved: VecDeque::new(),
            phase: Phase::FirstView,
            has_first_image: false,
            has_settled: false,
            drops: Schedule::new(options.drops, seed),
            broke_at: None,
            counters: Counters::default(),
            single_kind: SingleKindBatches::default(),
            counted_in: 0,
            counted_out: 0,
            next_flush: Timestamp(FIRST_INTERVAL),
            trace: None,
        }
    }

    async fn drive(&mut self, connection: &mut Connection) -> Result<(), Failure> {
        let mut heard = connection.bytes_received();
        let mut heard_at = connection.now();
        self.drops.connected(heard_at);
        loop {
            let now = connection.now();
            self.move_on(now)?;
            if self.broke_at.is_none() && self.drops.take_due(now, self.part_over(now)) {
                self.lose(connection).await?;
                (heard, heard_at) = (connection.bytes_received(), connection.now());
                continue;
            }
            while connection.may_send()
                && let Some(frame) = self.session.poll_transmit(now)
            {
                connection.send(frame);
            }
            if self.next_flush <= now {
                self.count_traffic(connection.bytes_delivered(), connection.bytes_sent());
                self.flush(now);
                self.next_flush = now + FIRST_INTERVAL;
            }
            if self.is_over(now) {
                return Ok(());
            }

            if heard != connection.bytes_received() || self.session.settled().is_some() {
                heard = connection.bytes_received();
                heard_at = now;
            } else if now.since(heard_at) >= SILENCE {
                return Err(Failure::Silent);
            }
            let retry = (!connection.may_send()).then_some(now + RETRY);
            // Who comes back is waited for, past the end.
            let end = self.options.duration.map(Timestamp).filter(|_| self.broke_at.is_none());
            let drop_at = self.drops.due_at(self.options.duration).filter(|_| self.broke_at.is_none());
            let wakes = [self.next_view_at(), end, retry, Some(self.next_flush), Some(heard_at + SILENCE), drop_at];
            match connection.next(wakes.into_iter().flatten().min()).await? {
                Event::Wake => {}
                Event::Frame(delivery) => self.take_frame(connection.now(), connection.bytes_sent(), &delivery)?,
            }
        }
    }

    /// Breaks the connection and makes another, try after try.
    async fn lose(&mut self, connection: &mut Connection) -> Result<(), Failure> {
        let lost_at = connection.now();
        let received = connection.bytes_received();
        let cut_off = received - connection.bytes_delivered().min(received);
        self.count_traffic(received.max(self.counted_in), connection.bytes_sent());
        connection.cut();
        {
            let mut totals = self.shared.lock();
            totals.dropped.connections += 1;
            totals.dropped.cut_off_bytes += cut_off;
        }
        self.broke_at = Some(lost_at);
        loop {
            self.session.handle_loss(connection.now());
            if let Connectivity::Reconnecting { next_try, .. } = self.session.connectivity() {
                connection.sleep_until(next_try).await;
            }
            match connection.reopen(&self.options.target).await {
                Ok(()) => return Ok(()),
                Err(error) if error.is_passing() && connection.now().since(lost_at) < SILENCE => {}
                Err(error) => return Err(error.into()),
            }
        }
    }

    /// Notes that the server has answered after a break.
    fn come_back(&mut self, now: Timestamp) {
        let connectivity = self.session.connectivity();
        if matches!(connectivity, Connectivity::Reconnecting { .. }) {
            return;
        }
        let Some(broke_at) = self.broke_at.take() else { return };
        self.drops.connected(now);
        let mut totals = self.shared.lock();
        totals.dropped.back.add(micros(now.since(broke_at)));
        match connectivity {
            Connectivity::Resumed => totals.dropped.resumed += 1,
            _ => totals.dropped.begun_anew += 1,
        }
    }

    /// Share of the run that is over: of its time, or of the views of the path.
    fn part_over(&self, now: Timestamp) -> f64 {
        match self.options.duration {
            Some(duration) => now.0.as_secs_f64() / duration.as_secs_f64(),
            None if self.watched.is_none() => 0.0,
            None => (self.step + 1) as f64 / self.length() as f64,
        }
    }

    fn take_frame(&mut self, now: Timestamp, bytes_sent: u64, delivery: &Delivery) -> Result<(), Failure> {
        let bytes = delivery.bytes_received - self.counted_in;
        self.count_traffic(delivery.bytes_received, bytes_sent);
        self.counters.payload_in += delivery.frame.len() as u64;
        self.session.note_traffic(delivery.bytes_received, bytes_sent);
        let before = self.session.stats().clone();
        let began = processor_time();
        let result = self.session.handle_frame(now, &delivery.frame);
        self.counters.core_cpu += processor_time().saturating_sub(began);
        self.come_back(now);
        let after = self.session.stats().clone();
        self.count_ops(&before, &after, bytes);
        self.watch(now, &before, &after, bytes);
        self.trace(now);
        Ok(result?)
    }

    fn count_traffic(&mut self, bytes_in: u64, bytes_out: u64) {
        self.counters.bytes_in += bytes_in - self.counted_in;
        self.counters.bytes_out += bytes_out - self.counted_out;
        (self.counted_in, self.counted_out) = (bytes_in, bytes_out);
    }

    fn count_ops(&mut self, before: &Stats, after: &Stats, bytes: u64) {
        let batches = after.batches - before.batches;
        let op_bytes = after.op_bytes - before.op_bytes;
        let splits = after.splits - before.splits;
        let cached = after.cached_splits - before.cached_splits;
        let collapses = after.collapses - before.collapses;
        let spawns = after.spawns - before.spawns;
        let despawns = after.despawns - before.despawns;
        self.counters.frames += after.frames - before.frames;
        self.counters.batches += batches;
        self.counters.op_bytes += op_bytes;
        self.counters.splits += splits;
        self.counters.cached_splits += cached;
        self.counters.collapses += collapses;
        self.counters.spawns += spawns;
        self.counters.despawns += despawns;
        let batch = |ops| SingleKind::new(batches, ops, op_bytes, bytes);
        match (splits - cached, cached, collapses, spawns + despawns) {
            (ops @ 1.., 0, 0, 0) => self.single_kind.fresh_splits.add(&batch(ops)),
            (0, ops @ 1.., 0, 0) => self.single_kind.cached_splits.add(&batch(ops)),
            (0, 0, ops @ 1.., 0) => self.single_kind.collapses.add(&batch(ops)),
            _ => {}
        }
    }

    /// Notes what a frame means for the newest view.
    fn watch(&mut self, now: Timestamp, before: &Stats, after: &Stats, bytes: u64) {
        if let Some((ms, bytes)) = after.first_image_ms.zip(after.first_image_bytes).filter(|_| !self.has_first_image) {
            self.has_first_image = true;
            let mut totals = self.shared.lock();
            totals.first_image.add((ms * 1e3) as u64);
            totals.first_image_bytes.add(bytes);
        }
        let Some(watched) = &mut self.watched else { return };
        if let Some(applied) = self.session.applied_view().filter(|_| after.batches > before.batches) {
            if applied != watched.seq {
                watched.stale_bytes += bytes;
            }
            while let Some((_, set_at)) = self.unserved.pop_front_if(|(seq, _)| *seq <= applied) {
                self.counters.views_served += 1;
                self.shared.lock().view_to_first_op.add(micros(now.since(set_at)));
            }
        }
        if let Some(settled) = self.session.settled().filter(|_| !watched.is_settled) {
            watched.is_settled = true;
            // Views that needed nothing.
            self.unserved.clear();
            self.counters.views_settled += 1;
            let mut totals = self.shared.lock();
            totals.view_to_settled.add(micros(now.since(watched.set_at)));
            totals.settled_error.add((f64::from(settled.outcome.error_px) * 1e6) as u64);
            totals.limited += u64::from(settled.outcome.limited);
            if !self.has_settled {
                self.has_settled = true;
                totals.first_settled.add(micros(now.0));
                totals.first_settled_bytes.add(after.bytes_received);
            }
        }
    }

    /// Notes how far the newest view has come.
    fn trace(&mut self, now: Timestamp) {
        let point = self.point(now);
        let Some(trace) = self.trace.as_mut().filter(|_| self.session.model().is_some()) else { return };
        trace.note(point, self.session.settled().is_some());
    }

    fn point(&self, now: Timestamp) -> Point {
        let stats = self.session.stats();
        Point { after: now.0, bytes: self.counted_in, ops: stats.splits + stats.spawns }
    }

    /// Sets the next view if it is due.
    fn move_on(&mut self, now: Timestamp) -> Result<(), ViewError> {
        if self.bounds.is_none() {
            self.meet_model();
        }
        if self.watched.is_none() {
            if self.bounds.is_some() || matches!(self.options.path, Path::Recorded(_)) {
                self.began = now;
                self.set_view(now)?;
            }
            return Ok(());
        }
        // A recording may repeat a view, which is no new one and stays settled. All may be the same: once round is enough.
        for _ in 0..self.length() {
            let Some(step) = self.next_step(now) else { break };
            self.step = step;
            if self.set_view(now)? {
                break;
            }
        }
        Ok(())
    }

    /// Learns from the welcome where the model is, and with it a built-in path.
    fn meet_model(&mut self) {
        let Some(model) = self.session.model() else { return };
        let bounds = Bounds::of(model);
        let aspect = self.options.viewport.aspect();
        self.poses = poses(&self.options.path, &bounds, self.options.fov_y_rad, aspect, &mut self.rng);
        self.shared.lock().model.get_or_insert_with(|| model.title.clone());
        self.bounds = Some(bounds);
    }

    /// The step that is due now, if it is another one.
    fn next_step(&self, now: Timestamp) -> Option<u64> {
        let pace = self.options.pace;
        let next = match pace {
            Pace::Settled => self.step + u64::from(self.session.settled().is_some()),
            // A client that comes late goes to where the camera is by now.
            _ => {
                let moved = self.options.duty.moved(self.phase_of_motion, now.since(self.began));
                pace.step_at(&self.options.path, moved).unwrap_or(self.step)
            }
        };
        let last = if self.options.duration.is_some() { u64::MAX } else { self.length() - 1 };
        Some(next.min(last)).filter(|&next| next > self.step)
    }

    /// Asks for the view of this step, and says whether it is another one than before.
    fn set_view(&mut self, now: Timestamp) -> Result<bool, ViewError> {
        let mut detail = self.options.detail;
        let at = (self.step % self.length()) as usize;
        let (pose, fov_y_rad) = match &self.options.path {
            Path::Recorded(recording) => {
                let view = &recording.views()[at];
                detail.tolerance_px = view.tolerance_px.unwrap_or(detail.tolerance_px);
                let pose = Pose { eye: DVec3::from_array(view.eye), target: DVec3::from_array(view.target) };
                (pose, view.fov_deg.to_radians())
            }
            _ => (self.poses[at], self.options.fov_y_rad),
        };
        let mut camera = Camera::perspective(fov_y_rad);
        camera.look_at(pose.eye, pose.target);
        // A recorded view goes out as it is, before and after the model is known.
        if let Some(bounds) = self.bounds.as_ref().filter(|_| !self.poses.is_empty()) {
            camera.fit_near(bounds);
        }
        let view = camera.view(self.options.viewport, &detail);
        let traced = self.trace.is_some().then(|| view.clone());
        let seq = self.session.set_view(now, view)?;
        if self.watched.is_some_and(|watched| watched.seq == seq) {
            return Ok(false);
        }
        if let Some(before) = self.watched.take() {
            self.end_view(&before);
            if self.phase == Phase::FirstView {
                self.flush(now);
                self.phase = Phase::Moving;
            }
        }
        let point = self.point(now);
        if let Some((trace, view)) = self.trace.as_mut().zip(traced) {
            trace.begin(&view, point);
        }
        self.trace(now);
        self.counters.views += 1;
        self.unserved.push_back((seq, now));
        self.watched = Some(Watched { seq, set_at: now, is_settled: false, stale_bytes: 0 });
        Ok(true)
    }

    /// A view is over. The first cannot have stale bytes, so it is no sample of them.
    fn end_view(&mut self, view: &Watched) {
        if self.phase == Phase::Moving {
            self.shared.lock().stale_bytes.add(view.stale_bytes);
        }
    }

    /// Views of the path.
    fn length(&self) -> u64 {
        match &self.options.path {
            Path::Recorded(recording) => recording.views().len() as u64,
            _ => self.poses.len() as u64,
        }
    }

    /// When the next view is due, if time decides that.
    fn next_view_at(&self) -> Option<Timestamp> {
        let next = self.step + 1;
        let is_last = self.options.duration.is_none() && next >= self.length();
        self.watched.filter(|_| !is_last)?;
        let moved = self.options.pace.time_of(&self.options.path, next)?;
        Some(self.began + self.options.duty.time_of(self.phase_of_motion, moved))
    }

    fn is_over(&self, now: Timestamp) -> bool {
        // Who comes back is waited for: every break has its outcome.
        if self.broke_at.is_some() {
            return false;
        }
        match self.options.duration {
            Some(duration) => now.0 >= duration,
            None => self.watched.is_some() && self.step + 1 >= self.length() && self.session.settled().is_some(),
        }
    }

    /// Adds what came since the last time to the sums.
    fn flush(&mut self, now: Timestamp) {
        let counters = std::mem::take(&mut self.counters);
        let stats = self.session.stats();
        let interval = Interval {
            bytes_in: counters.bytes_in,
            splits: counters.splits,
            collapses: counters.collapses,
            samples: 1,
            settled: u64::from(stats.settled),
            triangles: u64::from(stats.triangles),
        };
        let mut totals = self.shared.lock();
        totals.phase(self.phase).add(&counters);
        totals.single_kind.merge(&std::mem::take(&mut self.single_kind));
        totals.timeline.add(now.0, &interval);
    }

    /// The end, whether good or bad.
    fn finish(&mut self, connection: &Connection) {
        // What came of a frame that was not complete counts too.
        self.count_traffic(connection.bytes_received().max(self.counted_in), connection.bytes_sent());
        if let Some(view) = self.watched.take() {
            self.end_view(&view);
        }
        self.flush(connection.now());
        let stats = self.session.stats();
        let mut totals = self.shared.lock();
        totals.max_triangles_seen = totals.max_triangles_seen.max(stats.max_triangles_seen);
        totals.limits_exceeded += u64::from(stats.max_triangles_seen > self.options.detail.triangle_limit);
        totals.resets += u64::from(stats.resets);
        totals.dropped_batches += stats.dropped_batches;
    }
}

/// Processor time that this thread has used; where the system does not say, time.
fn processor_time() -> Duration {
    #[cfg(unix)]
    {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
        Duration::new(u64::try_from(time.tv_sec).unwrap_or(0), u32::try_from(time.tv_nsec).unwrap_or(0))
    }
    #[cfg(not(unix))]
    {
        use std::sync::OnceLock;
        use std::time::Instant;
        static START: OnceLock<Instant> = OnceLock::new();
        START.get_or_init(Instant::now).elapsed()
    }
}
