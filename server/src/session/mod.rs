//! The streaming brain of one client, without I/O: frames in, frames out, time as an argument.
//!
//! - [`Session::handle_frame`] takes what the client sent;
//! - [`Session::poll_transmit`] gives the next frame to send, chosen now: nothing is queued, so the newest view wins;
//! - [`Session::poll_timeout`] says when to poll again although nothing came in.
//!
//! A session that [reads ahead](Session::reading_ahead) never touches a page that has not been read: [`Session::poll_wanted`]
//! names those it needs, whoever may wait for the disk reads them, and [`Session::handle_pages`] is told. Until then the ops of
//! such pages are as if they did not exist yet, and the view does not settle.
//!
//! A session whose view has settled rests after a while: the mirror goes, and comes back with the next view (`rest`).
//!
//! A session whose connection broke can go on over another: it keeps what the client has not acknowledged ([`Session::park`],
//! `resume`).
//!
//! `score` judges one op for a view, `front` keeps the set of ops that a view asks for from view to view, `select` finds it anew,
//! `goal` compares it with what the client holds, `order` says what goes first, `mirror` keeps the client's state and encodes,
//! `pacer` says how much may be on its way.

mod front;
mod goal;
mod mirror;
mod op_index;
mod order;
mod pacer;
mod rest;
mod resume;
pub mod score;
mod select;
pub mod sweep;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use lodestream_protocol::ids::{BatchSeq, Token, ViewSeq};
use lodestream_protocol::limits::MAX_OPS_PER_BATCH;
use lodestream_protocol::mesh::Replica;
use lodestream_protocol::message::{
    Batch, ClientMessage, CloseCode, Hello, Outcome, PROTOCOL_VERSION, ServerMessage, Settled,
};
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::View;
use lodestream_protocol::wire;

use self::front::Effort;
use self::goal::{Aim, Goal, Stale};
use self::mirror::{BatchPlan, Mirror, MirrorError};
use self::pacer::Pacer;
use self::rest::Resting;
use self::resume::Unacknowledged;
use self::select::PageAccess;
pub use self::select::{ops_by_error, ops_for_view};
use crate::pack::{PackError, PackedModel, PageId};

/// How long after the last view an op stays although its priority fell a little below the threshold, and what a triangle limit leaves may
/// be missing.
const HYSTERESIS: Duration = Duration::from_millis(250);
/// Share of the threshold above which an op stays for that long.
const HYSTERESIS_SHARE: f32 = 0.7;
/// Bytes that a split is taken to cost when a batch is sized.
const BYTES_PER_SPLIT: usize = 3;
/// Splits that every batch may have, however small the allowance: fewer would be all header.
const MIN_OPS: usize = 64;
/// Most splits of a batch. A client applies batches whole and uploads what they touch for one image: some 550 bytes an op where they lie far
/// apart, and an image has two megabytes for that and for what fades.
const MOST_SPLITS: usize = 2048;
/// The same where the triangle limit binds: collapses make room for them, and what goes takes memory too while it fades.
const MOST_SPLITS_AT_LIMIT: usize = 768;
const _: () = assert!(2 * MOST_SPLITS < MAX_OPS_PER_BATCH as usize);
/// Bytes that a face of a spawn is taken to cost, and a colour of a vertex.
const BYTES_PER_SPAWNED_FACE: usize = 1;
const BYTES_PER_SPAWNED_COLOR: usize = 3;

/// Memory that a triangle is taken to cost a session: half a vertex, 85 bytes in the replica and 50 in the mirror and the front,
/// up to twice that while arrays grow, and a quarter of an entry of the cache.
const BYTES_PER_TRIANGLE: u64 = 160;

/// What a server decides for all its sessions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SessionConfig {
    /// Most entries of the mirrored op cache per session.
    pub max_cache_entries: u32,
    /// Most bytes that may be unacknowledged, whatever the link.
    pub max_window_bytes: u32,
    /// Most memory that a session may hold by its own account. Views are served under a triangle limit that keeps an ordinary
    /// mesh below it, see [`triangles`](Self::triangles); a session that passes it all the same ends.
    pub max_bytes: u64,
    /// A session whose view has settled drops its mirror after so long without another one.
    pub rest_after: Duration,
}

impl Default for SessionConfig {
    fn default() -> Self {
        Self {
            max_cache_entries: 1 << 17,
            max_window_bytes: 1 << 20,
            max_bytes: 2 << 30,
            rest_after: Duration::from_secs(30),
        }
    }
}

impl SessionConfig {
    /// Largest triangle limit that a session works under, whatever its client asks for.
    pub fn triangles(&self) -> u32 {
        u32::try_from(self.max_bytes / BYTES_PER_TRIANGLE).unwrap_or(u32::MAX)
    }
}

/// Why a session ended. [`code`](Self::code) goes into the close frame, the text beside it.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SessionError {
    /// The client sent something that is no message or makes no sense.
    #[error("{0}")]
    Peer(String, CloseCode),
    /// The model cannot be used.
    #[error(transparent)]
    Model(#[from] PackError),
    /// A bug of ours.
    #[error("internal error: {0}")]
    Internal(String),
}

impl SessionError {
    /// What to close the connection with.
    pub fn code(&self) -> CloseCode {
        match self {
            Self::Peer(_, code) => *code,
            Self::Model(_) => CloseCode::ModelDamaged,
            Self::Internal(_) => CloseCode::Internal,
        }
    }

    fn malformed(text: impl Into<String>) -> Self {
        Self::Peer(text.into(), CloseCode::Malformed)
    }
}

impl From<MirrorError> for SessionError {
    fn from(error: MirrorError) -> Self {
        match error {
            MirrorError::Model(error) => Self::Model(error),
            other => Self::Internal(other.to_string()),
        }
    }
}

/// What a session does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Activity {
    /// Something is still to be sent for the newest view, or there is none yet.
    #[default]
    Moving,
    /// Nothing is to be sent until the view changes.
    Settled,
    /// Likewise for a while: the mirror was dropped and comes back with the next view.
    Resting,
}

/// Totals of a session, for metrics and logs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SessionStats {
    /// Bytes of frames given out.
    pub bytes_sent: u64,
    /// Batches given out.
    pub batches: u64,
    /// Vertex splits, cached ones included.
    pub splits: u64,
    /// Splits that came from the mirrored cache.
    pub cached_splits: u64,
    /// Edge collapses.
    pub collapses: u64,
    /// Components inserted.
    pub spawns: u64,
    /// Components removed.
    pub despawns: u64,
    /// Resets that the client asked for.
    pub resets: u64,
    /// Views received.
    pub views: u64,
    /// Ops judged because their answer might have changed with a view.
    pub tested: u64,
    /// Mirrors dropped because the session was at rest, and mirrors rebuilt.
    pub rests: u64,
    /// See `rests`.
    pub wakes: u64,
    /// How often the session went on over another connection.
    pub resumes: u64,
    /// Bytes of batches that were given out once more then; they count in `bytes_sent`, too.
    pub bytes_sent_again: u64,
    /// Whether the client has acknowledged a batch on this connection: it knows the newest token then.
    pub is_confirmed: bool,
    /// Memory held now.
    pub heap_bytes: u64,
    /// What it does now.
    pub activity: Activity,
}

/// Bytes that the parts of a session hold.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SessionMemory {
    /// The mirror of the client's mesh.
    pub mesh: usize,
    /// The mirrored op cache.
    pub cache: usize,
    /// Contexts of the coder, the same for any mesh.
    pub coder: usize,
    /// Which op is in which slot.
    pub slots: usize,
    /// What selection keeps from view to view.
    pub front: usize,
    /// Ops that wait to be sent and slots that are to go.
    pub lists: usize,
    /// What is kept of a mirror at rest.
    pub resting: usize,
    /// Batches that may have to be sent again.
    pub unacknowledged: usize,
}

impl SessionMemory {
    /// The parts by name.
    pub fn parts(&self) -> [(&'static str, usize); 8] {
        [
            ("mesh", self.mesh),
            ("cache", self.cache),
            ("coder", self.coder),
            ("slots", self.slots),
            ("front", self.front),
            ("lists", self.lists),
            ("resting", self.resting),
            ("unacknowledged", self.unacknowledged),
        ]
    }

    /// All of them.
    pub fn total(&self) -> usize {
        self.parts().iter().map(|part| part.1).sum()
    }
}

/// Pages that a session needs.
#[derive(Clone, Debug)]
pub struct WantedPages {
    /// Of this model.
    pub model: Arc<PackedModel>,
    /// The most important first, at most 1,024. Replaces what was wanted before; empty if nothing is.
    pub pages: Vec<PageId>,
}

/// One client's session.
#[derive(Debug)]
pub struct Session {
    model: Arc<PackedModel>,
    access: PageAccess,
    config: SessionConfig,
    stats: SessionStats,
    /// Replies to control messages. Bounded: a hello is answered once, a reset only after all batches before it.
    control: VecDeque<ServerMessage>,
    /// What the next welcome brings.
    token: Option<Token>,
    /// `None` until the client has said hello.
    running: Option<Running>,
}

#[derive(Debug)]
struct Running {
    cache_entries: u32,
    /// `None` while the session rests.
    mirror: Option<Mirror>,
    /// What comes back as the mirror.
    resting: Option<Box<Resting>>,
    /// Since when nothing is left to do for the view, if so.
    settled_at: Option<Timestamp>,
    goal: Goal,
    pacer: Pacer,
    last_seq: BatchSeq,
    /// Limit and threshold as the last batch left them, which the next one need not repeat.
    told: Option<(u32, f32)>,
    view: Option<CurrentView>,
    work: Option<Work>,
    /// What the newest view settled with, if it did.
    settled: Option<Settled>,
    /// Whether the client was given a token, so that its batches are kept until they are acknowledged.
    is_resumable: bool,
    unacknowledged: Unacknowledged,
    /// Whether there is no connection.
    is_parked: bool,
    /// Whether the first view on this connection may be the one in force.
    may_repeat_view: bool,
    /// Whether the client may not know that the view has settled.
    repeats_settled: bool,
    /// See [`SessionStats::is_confirmed`].
    is_confirmed: bool,
}

#[derive(Debug)]
struct CurrentView {
    seq: ViewSeq,
    view: View,
    received_at: Timestamp,
}

/// What is left to do for the current view.
#[derive(Debug)]
struct Work {
    /// Ops to apply, parents first, in order of priority; done up to `next`.
    pending: Vec<u32>,
    next: usize,
    lambda: f32,
    /// See [`Aim`].
    error: Option<f32>,
    is_limited: bool,
    /// Pages without which there may be more to do, see [`select`](select::Selection::missing).
    missing: Vec<PageId>,
    /// Whether [`Session::poll_wanted`] has named them.
    is_announced: bool,
    /// Whether this is not yet all of P*: the view has not rested.
    is_rough: bool,
}

impl Session {
    /// A session on `model`, waiting for the client's hello. Reads pages where it needs them and waits for the disk.
    pub fn new(model: Arc<PackedModel>, config: SessionConfig) -> Self {
        Self::with_access(model, config, PageAccess::Blocking)
    }

    /// A session that never waits for the disk (as long as the system keeps the pages that were read): see the module.
    pub fn reading_ahead(model: Arc<PackedModel>, config: SessionConfig) -> Self {
        Self::with_access(model, config, PageAccess::ReadAhead)
    }

    fn with_access(model: Arc<PackedModel>, config: SessionConfig, access: PageAccess) -> Self {
        Self {
            model,
            access,
            config,
            stats: SessionStats::default(),
            control: VecDeque::new(),
            token: None,
            running: None,
        }
    }

    /// Pages that the current view needs, if that has changed since the last call. To be called after
    /// [`poll_transmit`](Self::poll_transmit).
    pub fn poll_wanted(&mut self) -> Option<WantedPages> {
        let work = self.running.as_mut()?.work.as_mut().filter(|work| !work.is_announced)?;
        work.is_announced = true;
        Some(WantedPages { model: Arc::clone(&self.model), pages: work.missing.clone() })
    }

    /// Some of the pages wanted were read, or could not be. [`poll_transmit`](Self::poll_transmit) should be called next.
    ///
    /// # Errors
    /// [`SessionError::Model`] if the model was found damaged.
    pub fn handle_pages(&mut self) -> Result<(), SessionError> {
        if let Some(damage) = self.model.damage() {
            return Err(damage.clone().into());
        }
        let Some(running) = &mut self.running else { return Ok(()) };
        let Some(work) = running.work.as_ref().filter(|work| !work.missing.is_empty()) else { return Ok(()) };
        // Selecting anew costs as much as for a new view: once for all that was wanted, or when the link would idle.
        let is_ready = |&page: &PageId| self.model.is_ready(page);
        let idles = work.next == work.pending.len();
        if work.missing.iter().all(is_ready) || idles && work.missing.iter().any(is_ready) {
            running.work = None;
        }
        Ok(())
    }

    /// Takes one frame from the client.
    ///
    /// # Errors
    /// [`SessionError`] ends the session: close the connection with its code and text.
    pub fn handle_frame(&mut self, now: Timestamp, frame: &[u8]) -> Result<(), SessionError> {
        let message = wire::decode_client(frame).map_err(|error| SessionError::malformed(error.to_string()))?;
        match (message, &mut self.running) {
            (ClientMessage::Hello(hello), None) => self.greet(now, hello),
            (ClientMessage::Resume(claim), _) => self.resume(now, &claim),
            (ClientMessage::Hello(_), Some(_)) => Err(SessionError::malformed("a second hello")),
            (_, None) => Err(SessionError::malformed("the first message is not a hello")),
            (ClientMessage::View { seq, mut view }, Some(running)) => {
                view.validate().map_err(|error| SessionError::malformed(error.to_string()))?;
                let smallest = self.model.info().smallest_limit;
                if view.triangle_limit < smallest {
                    let text = format!("limit {} is below this model's smallest, {smallest}", view.triangle_limit);
                    return Err(SessionError::Peer(text, CloseCode::LimitTooSmall));
                }
                let may_repeat = std::mem::take(&mut running.may_repeat_view);
                if may_repeat && running.view.as_ref().is_some_and(|current| current.seq == seq) {
                    return Ok(());
                }
                if running.view.as_ref().is_some_and(|current| current.seq >= seq) {
                    return Err(SessionError::malformed("view numbers must increase"));
                }
                // Batches name the limit in force, and a view that settles under it says so.
                view.triangle_limit = view.triangle_limit.min(self.config.triangles());
                self.stats.views += 1;
                running.view = Some(CurrentView { seq, view, received_at: now });
                running.work = None;
                (running.settled_at, running.settled, running.repeats_settled) = (None, None, false);
                Ok(())
            }
            (ClientMessage::Ack { seq }, Some(running)) => {
                if seq > running.last_seq {
                    return Err(SessionError::malformed("acknowledged a batch that was not sent"));
                }
                running.pacer.on_ack(now, seq);
                running.unacknowledged.acknowledge(seq);
                running.is_confirmed = true;
                Ok(())
            }
            (ClientMessage::Reset { .. }, Some(_)) => self.begin_again(now),
        }
    }

    /// Goes back to the base, at the client's wish.
    fn begin_again(&mut self, now: Timestamp) -> Result<(), SessionError> {
        let Some(running) = &mut self.running else { return Ok(()) };
        self.stats.resets += 1;
        running.mirror = Some(Mirror::new(&self.model, running.cache_entries)?);
        running.resting = None;
        (running.settled_at, running.settled, running.repeats_settled) = (None, None, false);
        running.unacknowledged = Unacknowledged::default();
        running.goal.restart();
        running.pacer.restart(now);
        running.last_seq = BatchSeq(0);
        running.told = None;
        running.work = None;
        self.control.push_back(ServerMessage::Restart);
        Ok(())
    }

    /// Next frame to send, or `None` while the window is full or there is nothing to do. Work per call is bounded by
    /// [`MAX_OPS_PER_BATCH`], except that the first call after a view selects the ops it asks for.
    ///
    /// # Errors
    /// [`SessionError`] ends the session.
    pub fn poll_transmit(&mut self, now: Timestamp) -> Result<Option<Vec<u8>>, SessionError> {
        if let Some(message) = self.control.pop_front() {
            return Ok(Some(self.frame(&message)));
        }
        let Some(running) = self.running.as_mut().filter(|running| !running.is_parked) else { return Ok(None) };
        if let Some((seq, frame)) = running.unacknowledged.next_again() {
            running.pacer.on_send(now, seq, frame.len());
            self.stats.bytes_sent += frame.len() as u64;
            self.stats.bytes_sent_again += frame.len() as u64;
            return Ok(Some(frame));
        }
        if running.view.is_none() {
            return Ok(None);
        }
        if let Some(settled) = running.settled.filter(|_| std::mem::take(&mut running.repeats_settled)) {
            return Ok(Some(self.frame(&ServerMessage::Settled(settled))));
        }
        if let Some(settled_at) = running.settled_at {
            if running.mirror.is_some() && now >= settled_at + self.config.rest_after {
                running.rest();
                self.stats.rests += 1;
            }
            return Ok(None);
        }
        let allowance = running.pacer.allowance(now);
        if allowance == 0 {
            return Ok(None);
        }
        if running.wake(&self.model)? {
            self.stats.wakes += 1;
        }
        let held = running.heap_bytes() as u64;
        if held > self.config.max_bytes {
            let text = format!("the session takes {held} bytes, over this server's limit of {}", self.config.max_bytes);
            return Err(SessionError::Peer(text, CloseCode::Full));
        }
        let (Some(mirror), Some(current)) = (&mut running.mirror, &running.view) else {
            return Err(SessionError::Internal("a session has lost its mirror".into()));
        };
        let has_rested = now.since(current.received_at) >= HYSTERESIS;
        if has_rested && running.work.as_ref().is_some_and(|work| work.is_rough) {
            running.work = None;
        }
        if running.work.is_none() {
            let effort = if has_rested { Effort::Exact } else { Effort::Moving };
            let aim = running.goal.aim(&self.model, self.access, &current.view, mirror, effort)?;
            self.stats.tested += u64::from(aim.tested);
            running.work = Some(Work::new(self.access, aim));
        }
        let work = running.work.as_mut().expect("made above");
        if has_rested && work.missing.is_empty() {
            running.goal.stale().let_go();
        }
        let limit = current.view.triangle_limit;
        if let Some(mut plan) = work.next_batch(&self.model, mirror, running.goal.stale(), limit, allowance)? {
            let (ops, counts, applied) = mirror.batch(&self.model, &mut plan)?;
            work.next += applied;
            if work.next == work.pending.len() {
                (work.pending, work.next) = (Vec::new(), 0);
            }
            running.last_seq.0 += 1;
            self.stats.batches += 1;
            self.stats.splits += u64::from(counts.splits);
            self.stats.cached_splits += u64::from(counts.cached_splits);
            self.stats.collapses += u64::from(counts.collapses);
            self.stats.spawns += u64::from(counts.spawns);
            self.stats.despawns += u64::from(counts.despawns);
            let seq = running.last_seq;
            let has_settled = work.is_done() && !running.goal.has_stale();
            running.settled_at = has_settled.then_some(now);
            let outcome = match has_settled {
                true => {
                    Some(work.outcome(|| running.goal.error(&self.model, self.access, &current.view))?.rounded_up())
                }
                false => None,
            };
            running.settled = outcome.map(|outcome| Settled { view: current.seq, seq, outcome });
            let in_force = (current.view.triangle_limit, work.lambda);
            let before = running.told.replace(in_force);
            let message = ServerMessage::Batch(Batch {
                seq: seq.low(),
                view: current.seq.low(),
                limit: before.is_none_or(|told| told.0 != in_force.0).then_some(in_force.0),
                lambda_px: before.is_none_or(|told| told.1 != in_force.1).then_some(in_force.1),
                digest: mirror.replica().digest() as u16,
                outcome,
                ops,
            });
            let frame = wire::encode_server(&message);
            running.pacer.on_send(now, seq, frame.len());
            if running.is_resumable {
                running.unacknowledged.push(seq, frame.clone());
            }
            self.stats.bytes_sent += frame.len() as u64;
            return Ok(Some(frame));
        }
        if !work.is_done() || running.goal.has_stale() {
            return Ok(None);
        }
        running.settled_at = Some(now);
        let outcome = work.outcome(|| running.goal.error(&self.model, self.access, &current.view))?;
        let settled = Settled { view: current.seq, seq: running.last_seq, outcome };
        running.settled = Some(settled);
        Ok(Some(self.frame(&ServerMessage::Settled(settled))))
    }

    /// Drops the mirror now, whatever is left to do: it is rebuilt when the next frame is to be made. For a client that has gone
    /// away, and where memory runs short. O(ops).
    pub fn rest(&mut self) {
        if let Some(running) = self.running.as_mut().filter(|running| running.mirror.is_some()) {
            running.rest();
            self.stats.rests += 1;
        }
    }

    /// Rebuilds the mirror now, if the session rests. The next frame would do so itself; this is for measuring. O(ops x valence).
    ///
    /// # Errors
    /// [`SessionError`] ends the session.
    pub fn wake(&mut self) -> Result<(), SessionError> {
        if let Some(running) = &mut self.running
            && running.wake(&self.model)?
        {
            self.stats.wakes += 1;
        }
        Ok(())
    }

    /// When to call [`poll_transmit`](Self::poll_transmit) again although no frame came in.
    pub fn poll_timeout(&self) -> Option<Timestamp> {
        let running = self.running.as_ref().filter(|running| !running.is_parked)?;
        let current = running.view.as_ref()?;
        if let Some(settled_at) = running.settled_at {
            return running.mirror.as_ref().map(|_| settled_at + self.config.rest_after);
        }
        let work = running.work.as_ref();
        if work.is_some_and(Work::waits_for_pages) {
            return None;
        }
        // Once the view has rested, or where pages are missing, nothing but a frame from the client changes what can be sent.
        let has_more = |work: &Work| work.is_rough || work.missing.is_empty() && running.goal.has_reluctant();
        let rested = work.is_some_and(has_more).then_some(current.received_at + HYSTERESIS);
        [running.pacer.next_refill(), rested].into_iter().flatten().min()
    }

    /// Totals so far.
    pub fn stats(&self) -> SessionStats {
        let held = self.running.as_ref().map_or(0, Running::heap_bytes);
        let activity = self.running.as_ref().map_or(Activity::Moving, Running::activity);
        let is_confirmed = self.running.as_ref().is_some_and(|running| running.is_confirmed);
        SessionStats { heap_bytes: held as u64, activity, is_confirmed, ..self.stats }
    }

    /// What holds the memory of [`SessionStats::heap_bytes`].
    pub fn memory(&self) -> SessionMemory {
        self.running.as_ref().map(Running::memory).unwrap_or_default()
    }

    /// The mirror of the client's mesh, once the client has said hello and while the session does not rest.
    pub fn mirror(&self) -> Option<&Replica> {
        self.running.as_ref()?.mirror.as_ref().map(Mirror::replica)
    }

    /// Applied ops and the slots they are addressed by, ids ascending, for tests and diagnostics.
    pub fn applied_ops(&self) -> Vec<(u32, u32)> {
        let mut ops: Vec<(u32, u32)> = match &self.running {
            Some(Running { mirror: Some(mirror), .. }) => mirror.applied().collect(),
            Some(Running { resting: Some(resting), .. }) => resting.applied().iter().collect(),
            _ => Vec::new(),
        };
        ops.sort_unstable();
        ops
    }

    fn greet(&mut self, now: Timestamp, hello: Hello) -> Result<(), SessionError> {
        if hello.version != PROTOCOL_VERSION {
            let text = format!("this server speaks version {PROTOCOL_VERSION}, the client {}", hello.version);
            return Err(SessionError::Peer(text, CloseCode::Version));
        }
        let info = self.model.info();
        if self.config.triangles() < info.smallest_limit {
            let text = format!(
                "this model's base of {} triangles takes more memory than a session may hold on this server",
                info.smallest_limit
            );
            return Err(SessionError::Peer(text, CloseCode::Full));
        }
        // The paper's 5 % of the ops, a quarter of what the client will hold, whichever is smaller.
        let default = (self.model.op_count() / 20).min(hello.triangle_limit / 4);
        let cache_entries = hello.cache_entries.unwrap_or(default).min(self.config.max_cache_entries);
        self.control.push_back(ServerMessage::Welcome {
            model: info.clone(),
            cache_entries,
            token: self.token,
            base: self.model.coded_base().to_vec(),
        });
        self.running = Some(Running {
            cache_entries,
            mirror: Some(Mirror::new(&self.model, cache_entries)?),
            resting: None,
            settled_at: None,
            goal: Goal::default(),
            pacer: Pacer::new(self.config.max_window_bytes, hello.byte_rate, now),
            last_seq: BatchSeq(0),
            told: None,
            view: None,
            work: None,
            settled: None,
            is_resumable: self.token.is_some(),
            unacknowledged: Unacknowledged::default(),
            is_parked: false,
            may_repeat_view: false,
            repeats_settled: false,
            is_confirmed: false,
        });
        Ok(())
    }

    fn frame(&mut self, message: &ServerMessage) -> Vec<u8> {
        let frame = wire::encode_server(message);
        self.stats.bytes_sent += frame.len() as u64;
        frame
    }
}

impl Running {
    fn memory(&self) -> SessionMemory {
        let mirror = self.mirror.as_ref();
        let of_mirror = |bytes: fn(&Mirror) -> usize| mirror.map_or(0, bytes);
        SessionMemory {
            mesh: of_mirror(|mirror| mirror.replica().heap_bytes()),
            cache: of_mirror(|mirror| mirror.state.cache().heap_bytes()),
            coder: of_mirror(Mirror::coder_bytes),
            slots: of_mirror(Mirror::slot_bytes),
            front: self.goal.front_bytes(),
            lists: self.goal.list_bytes() + self.work.as_ref().map_or(0, |work| work.pending.capacity() * 4),
            resting: self.resting.as_ref().map_or(0, |resting| resting.heap_bytes()),
            unacknowledged: self.unacknowledged.heap_bytes(),
        }
    }

    fn heap_bytes(&self) -> usize {
        self.memory().total()
    }

    fn activity(&self) -> Activity {
        match (&self.mirror, self.settled_at) {
            (None, _) => Activity::Resting,
            (_, Some(_)) => Activity::Settled,
            (_, None) => Activity::Moving,
        }
    }

    /// Rebuilds the mirror if it was dropped; whether it was.
    fn wake(&mut self, model: &PackedModel) -> Result<bool, MirrorError> {
        let Some(resting) = &self.resting else { return Ok(false) };
        self.mirror = Some(resting.wake(model)?);
        self.resting = None;
        Ok(true)
    }

    /// Drops the mirror, and with it the plan: a new view makes both anew.
    fn rest(&mut self) {
        if let Some(mirror) = self.mirror.take() {
            self.resting = Some(Box::new(Resting::new(&mirror)));
            self.work = None;
            self.goal.rest();
        }
    }
}

impl Work {
    fn new(access: PageAccess, aim: Aim) -> Self {
        Self {
            pending: aim.pending,
            next: 0,
            lambda: aim.lambda,
            error: aim.error,
            is_limited: aim.is_limited,
            is_announced: access == PageAccess::Blocking,
            missing: aim.missing,
            is_rough: aim.is_rough,
        }
    }

    /// What a settled view is told; `error` finds what is left out, if that is not known.
    fn outcome(&mut self, error: impl FnOnce() -> Result<f32, PackError>) -> Result<Outcome, PackError> {
        let error_px = match self.error {
            Some(error) => error,
            None => *self.error.insert(error()?),
        };
        Ok(Outcome { error_px, limited: self.is_limited })
    }

    /// Whether nothing is left to apply.
    fn is_done(&self) -> bool {
        self.next == self.pending.len() && self.missing.is_empty() && !self.is_rough
    }

    /// Whether nothing is left to do before a page was read.
    fn waits_for_pages(&self) -> bool {
        self.next == self.pending.len() && !self.missing.is_empty()
    }

    /// What to do with an allowance of so many bytes, or `None` when there is nothing to do now.
    fn next_batch<'a>(
        &'a self,
        model: &PackedModel,
        mirror: &Mirror,
        stale: &'a mut Stale,
        limit: u32,
        allowance: usize,
    ) -> Result<Option<BatchPlan<'a>>, PackError> {
        let is_over = mirror.replica().triangle_count() > limit;
        let room = limit.saturating_sub(mirror.replica().triangle_count()) as usize;
        let most = if room < 2 * MOST_SPLITS { MOST_SPLITS_AT_LIMIT } else { MOST_SPLITS };
        let budget = (allowance / BYTES_PER_SPLIT).clamp(MIN_OPS, most);
        let left = &self.pending[self.next..];
        let ops = if is_over { &[] } else { &left[..fitting(model, left, budget)?] };
        let Stale { slots: stale, reluctant, .. } = stale;
        let may_go = |slot| mirror.replica().collapsible().contains(slot) && !reluctant.contains(slot);
        if ops.is_empty() && !is_over && (stale.len() == reluctant.len() || !stale.iter().any(may_go)) {
            return Ok(None);
        }
        // What a view left behind goes in small shares while there are splits to send, then as fast as the link allows.
        let spare = if left.is_empty() { budget } else { budget / 4 };
        let spare_collapses = spare.min(2 * MOST_SPLITS_AT_LIMIT) as u32;
        Ok(Some(BatchPlan { ops, stale, reluctant, spare_collapses, limit }))
    }
}

/// How many of `ops` cost as much as `budget` splits, at least one if there are any. A spawn's positions are sent as they are.
fn fitting(model: &PackedModel, ops: &[u32], budget: usize) -> Result<usize, PackError> {
    let info = model.info();
    let color = if info.has_colors { BYTES_PER_SPAWNED_COLOR } else { 0 };
    let per_vertex = (3 * usize::from(info.lattice.bits)).div_ceil(8) + color;
    let mut bytes = budget * BYTES_PER_SPLIT;
    for (i, &op) in ops.iter().enumerate().take(budget) {
        let cost = if op < model.spawn_count() {
            model.spawn_vertices(op)? as usize * per_vertex
                + model.spawn_triangles(op)? as usize * BYTES_PER_SPAWNED_FACE
        } else {
            BYTES_PER_SPLIT
        };
        if cost > bytes && i > 0 {
            return Ok(i);
        }
        bytes = bytes.saturating_sub(cost);
    }
    Ok(ops.len().min(budget))
}
