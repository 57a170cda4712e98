//! The client's half of a session, without I/O: frames go in, frames come out, time is an argument.
//!
//! A [`ClientSession`] holds the replica of one model over one connection, or over several if connections break. It decides nothing about refinement: it says
//! what it looks at, applies what comes, and checks after every batch that both ends still hold the same mesh. It knows
//! nothing of sockets, clocks or the GPU, and runs in the browser as it is.
//!
//! A driver calls, in this order: [`handle_frame`](ClientSession::handle_frame) for what arrived (while
//! [`has_room`](ClientSession::has_room)), [`apply_ready`](ClientSession::apply_ready) if the session was told not to
//! apply on arrival, [`poll_transmit`](ClientSession::poll_transmit) until it returns `None`, then it sleeps until
//! something arrives or [`poll_timeout`](ClientSession::poll_timeout). Methods that change the session take the time;
//! accessors do not. When the connection breaks, it calls [`handle_loss`](ClientSession::handle_loss), waits until the
//! [time to try again](Connectivity::Reconnecting), and goes on with the new connection as with the old one; when that cannot be
//! made, it calls [`handle_loss`](ClientSession::handle_loss) again.

mod apply;
mod inbox;
mod reconnect;
mod stats;

use std::time::Duration;

use lodestream_protocol::ids::{BatchSeq, Token, ViewSeq};
use lodestream_protocol::limits::MAX_CACHE_ENTRIES;
use lodestream_protocol::mesh::{Patch, PatchError, Replica};
use lodestream_protocol::message::{ClientMessage, Hello, ModelInfo, PROTOCOL_VERSION, Resume, ServerMessage, Settled};
use lodestream_protocol::op::{OpState, PatchDecodeError};
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::{View, ViewError};
use lodestream_protocol::wire::{self, WireError};

use inbox::{Inbox, Item};
use reconnect::Backoff;
pub use reconnect::{Connectivity, GOOD_CONNECTION};
pub use stats::{FIRST_IMAGE_TRIANGLES, Stats};

/// How a session behaves. All queues are bounded by what stands here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClientConfig {
    /// Triangle limit that the views will have; the server sizes the default op cache by it.
    pub triangle_limit: u32,
    /// Entries of the mirrored op cache to ask for; `None` takes the server's default.
    pub cache_entries: Option<u32>,
    /// Most bytes per second that the server may send; `None` sets no cap.
    pub byte_rate: Option<u32>,
    /// Least time between two views sent.
    pub view_interval: Duration,
    /// Whether batches are applied inside [`ClientSession::handle_frame`]. If not, they wait in the inbox for
    /// [`ClientSession::apply_ready`].
    pub apply_on_arrival: bool,
    /// Bytes of ops in the inbox from which on [`ClientSession::has_room`] is false. A frame that arrives below the mark
    /// is taken whole.
    pub inbox_bytes: usize,
    /// What the waits before a broken connection is made anew are drawn from. Clients should have seeds of their own.
    pub reconnect_seed: u64,
}

impl Default for ClientConfig {
    fn default() -> Self {
        Self {
            triangle_limit: 1_000_000,
            cache_entries: None,
            byte_rate: None,
            view_interval: Duration::from_millis(33),
            apply_on_arrival: true,
            inbox_bytes: 4 << 20,
            reconnect_seed: 0,
        }
    }
}

/// Why a session cannot go on. Except for [`InboxFull`](Self::InboxFull) the server is at fault: close with
/// [`CloseCode::Malformed`](lodestream_protocol::message::CloseCode::Malformed).
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ClientError {
    /// A frame that is no message.
    #[error("the server sent a bad frame")]
    Wire(#[from] WireError),
    /// A message that may not come now.
    #[error("the server sent {0} out of turn")]
    OutOfTurn(&'static str),
    /// The welcome describes a model that cannot be.
    #[error("the server described the model with a bad {0}")]
    BadModel(&'static str),
    /// The base mesh does not decode.
    #[error("the server sent a bad base mesh")]
    BadBase(#[from] PatchDecodeError),
    /// The base mesh is no manifold.
    #[error("the server sent a broken base mesh")]
    BrokenBase(#[from] PatchError),
    /// Both ends disagreed again and again.
    #[error("client and server disagreed about the mesh {resets} times")]
    Disagreement {
        /// Resets so far.
        resets: u32,
    },
    /// The driver went on although [`ClientSession::has_room`] was false.
    #[error("the inbox is full")]
    InboxFull,
}

/// What the welcome brought.
#[derive(Debug)]
struct Model {
    info: ModelInfo,
    base: Patch,
    cache_entries: u32,
    state: OpState,
}

#[derive(Debug)]
struct CurrentView {
    seq: ViewSeq,
    view: View,
    set_at: Timestamp,
    is_sent: bool,
}

/// One session over one connection. See the module.
#[derive(Debug)]
pub struct ClientSession {
    config: ClientConfig,
    connectivity: Connectivity,
    backoff: Backoff,
    is_hello_sent: bool,
    /// When the server's first word on this connection came, and whether it may be that the session goes on.
    answered_at: Option<Timestamp>,
    may_resume: bool,
    /// The newest that the server gave.
    token: Option<Token>,
    /// The mesh from before a session that had to begin anew, until the new one is as good.
    kept: Option<Model>,
    current: Option<CurrentView>,
    view_sent_at: Option<Timestamp>,
    model: Option<Model>,
    inbox: Inbox,
    /// Newest batch applied since the base.
    applied: BatchSeq,
    applied_view: Option<ViewSeq>,
    /// Limit and threshold that batches are under until one says otherwise.
    limit: Option<u32>,
    lambda_px: Option<f32>,
    ack_due: Option<BatchSeq>,
    reset_due: Option<BatchSeq>,
    /// Set from a disagreement until the server's restart; ops mean nothing then.
    awaits_restart: bool,
    batches_since_reset: u32,
    resets_in_a_row: u32,
    generation: u32,
    settled: Option<Settled>,
    stats: Stats,
}

impl ClientSession {
    /// A session that has said nothing yet.
    pub fn new(config: ClientConfig) -> Self {
        Self {
            config,
            connectivity: Connectivity::default(),
            backoff: Backoff::new(config.reconnect_seed),
            is_hello_sent: false,
            answered_at: None,
            may_resume: false,
            token: None,
            kept: None,
            current: None,
            view_sent_at: None,
            model: None,
            inbox: Inbox::default(),
            applied: BatchSeq(0),
            applied_view: None,
            limit: None,
            lambda_px: None,
            ack_due: None,
            reset_due: None,
            awaits_restart: false,
            batches_since_reset: 0,
            resets_in_a_row: 0,
            generation: 0,
            settled: None,
            stats: Stats::default(),
        }
    }

    /// Asks for `view` from now on and returns its number. Only the newest view is kept; a view equal to it changes
    /// nothing. The first goes out right after the hello, later ones at most every [`ClientConfig::view_interval`].
    ///
    /// # Errors
    /// [`ViewError`] if the view makes no sense; the one before it stays.
    pub fn set_view(&mut self, now: Timestamp, view: View) -> Result<ViewSeq, ViewError> {
        view.validate()?;
        let seq = match &self.current {
            Some(current) if current.view == view => return Ok(current.seq),
            Some(current) => ViewSeq(current.seq.0.wrapping_add(1)),
            None => ViewSeq(1),
        };
        self.current = Some(CurrentView { seq, view, set_at: now, is_sent: false });
        self.unsettle();
        self.stats.view_latency_ms = None;
        Ok(seq)
    }

    /// Takes a frame from the server.
    ///
    /// # Errors
    /// [`ClientError`]; the session is over then. A batch that does not fit the mesh is no error: the session asks the
    /// server to begin again and counts it in [`Stats::resets`].
    pub fn handle_frame(&mut self, now: Timestamp, frame: &[u8]) -> Result<(), ClientError> {
        if !self.has_room() {
            return Err(ClientError::InboxFull);
        }
        let message = wire::decode_server(frame)?;
        self.stats.frames += 1;
        match message {
            ServerMessage::Welcome { .. } if !self.awaits_answer() => return Err(ClientError::OutOfTurn("a welcome")),
            ServerMessage::Welcome { model, cache_entries, token, base } => {
                self.begin(now, model, cache_entries, &base)?;
                self.token = token;
            }
            ServerMessage::Resumed { .. } if !(self.awaits_answer() && self.may_resume) => {
                return Err(ClientError::OutOfTurn("a resumption"));
            }
            ServerMessage::Resumed { token } => {
                self.token = Some(token);
                self.answered(now, Connectivity::Resumed);
                self.stats.resumed += 1;
            }
            _ if self.awaits_answer() => return Err(ClientError::OutOfTurn("something before its welcome")),
            ServerMessage::Batch(batch) => self.inbox.push(Item::Batch(batch)),
            ServerMessage::Settled(settled) => self.inbox.push(Item::Settled(settled)),
            ServerMessage::Restart => self.inbox.push(Item::Restart),
        }
        if self.config.apply_on_arrival {
            self.apply_ready(now, u32::MAX)?;
        }
        Ok(())
    }

    /// Applies what waits in the inbox, in order, until `max_ops` ops are done, and returns how many were. A batch is
    /// applied whole, so one call may overshoot by a batch; `max_ops` of at least 1 makes progress.
    ///
    /// # Errors
    /// [`ClientError`]; the session is over then.
    pub fn apply_ready(&mut self, now: Timestamp, max_ops: u32) -> Result<u32, ClientError> {
        let mut ops = 0u32;
        while ops < max_ops
            && let Some(item) = self.inbox.pop()
        {
            match item {
                Item::Restart => self.restart(now)?,
                Item::Batch(_) if self.awaits_restart => self.stats.dropped_batches += 1,
                Item::Settled(_) if self.awaits_restart => {}
                Item::Batch(batch) => ops = ops.saturating_add(self.apply(now, &batch)?),
                Item::Settled(settled) => self.settle(now, settled)?,
            }
        }
        Ok(ops)
    }

    /// The connection broke, or one could not be made. What has arrived stays, and so does the mesh; what was to be said is said
    /// anew over the next connection, which begins with [`poll_transmit`](Self::poll_transmit) once it is open. Waits grow until a
    /// connection [has lasted](Self::has_lasted).
    pub fn handle_loss(&mut self, now: Timestamp) {
        let is_first = !matches!(self.connectivity, Connectivity::Reconnecting { .. });
        if self.has_lasted(now) {
            self.backoff.restart();
        }
        self.stats.connections_lost += u32::from(is_first && self.model.is_some());
        self.connectivity = self.backoff.next(now);
        self.is_hello_sent = false;
        self.answered_at = None;
        self.may_resume = false;
        // What the claim names counts as acknowledged, and it says whether a restart is wanted.
        self.ack_due = None;
        self.reset_due = None;
        self.view_sent_at = None;
        if let Some(current) = &mut self.current {
            current.is_sent = false;
        }
    }

    /// Like [`handle_loss`](Self::handle_loss) where what both ends hold of the session is of no use any more, as after a
    /// [`ClientError`]: the next connection begins anew. The mesh is shown until the new one is as good.
    pub fn begin_anew(&mut self, now: Timestamp) {
        self.handle_loss(now);
        self.token = None;
        self.inbox = Inbox::default();
        self.resets_in_a_row = 0;
    }

    /// Other settings. What the server is to know of them it hears at the next connection, with the first message. To make that one at
    /// once is no fault of the server: it does not lengthen waits.
    pub fn reconfigure(&mut self, config: ClientConfig) {
        self.config = config;
        self.backoff.restart();
    }

    /// How the session stands with its server.
    pub fn connectivity(&self) -> Connectivity {
        self.connectivity
    }

    /// Whether the connection is a good one: the server answered on it, and it has lasted [`GOOD_CONNECTION`] since. One that greets and
    /// fails at once is not.
    pub fn has_lasted(&self, now: Timestamp) -> bool {
        self.answered_at.is_some_and(|at| now.since(at) >= GOOD_CONNECTION)
    }

    /// Whether the session went on after its connection broke the last time.
    pub fn is_resumed(&self) -> bool {
        self.connectivity == Connectivity::Resumed
    }

    /// Whether the session had to begin anew and the mesh from before is still shown, as it is better.
    pub fn is_restarting(&self) -> bool {
        self.kept.is_some()
    }

    /// Whether [`handle_frame`](Self::handle_frame) takes another frame. A driver stops reading while it does not.
    pub fn has_room(&self) -> bool {
        self.inbox.has_room(self.config.inbox_bytes)
    }

    /// Whether something waits for [`apply_ready`](Self::apply_ready).
    pub fn has_ready(&self) -> bool {
        !self.inbox.is_empty()
    }

    /// Bytes of ops that the next item waiting for [`apply_ready`](Self::apply_ready) holds, 0 for one without ops.
    pub fn next_op_bytes(&self) -> Option<usize> {
        self.inbox.next_bytes()
    }

    /// The next frame to send, or `None` if there is nothing to say yet.
    pub fn poll_transmit(&mut self, now: Timestamp) -> Option<Vec<u8>> {
        self.next_message(now).map(|message| wire::encode_client(&message))
    }

    fn next_message(&mut self, now: Timestamp) -> Option<ClientMessage> {
        if !self.is_hello_sent {
            self.is_hello_sent = true;
            let ClientConfig { triangle_limit, cache_entries, byte_rate, .. } = self.config;
            let cache_entries = cache_entries.map(|entries| entries.min(MAX_CACHE_ENTRIES));
            let hello = Hello { version: PROTOCOL_VERSION, triangle_limit, cache_entries, byte_rate };
            let Some(token) = self.token.filter(|_| self.model.is_some()) else {
                return Some(ClientMessage::Hello(hello));
            };
            self.may_resume = true;
            // The claim says both.
            (self.ack_due, self.reset_due) = (None, None);
            let received = self.inbox.received(self.applied, self.awaits_restart);
            return Some(ClientMessage::Resume(Resume { hello, token, received }));
        }
        // Before the server has said whether the session goes on, the numbers of batches may mean nothing to it.
        if let Some(seq) = self.ack_due.take_if(|_| self.answered_at.is_some()) {
            return Some(ClientMessage::Ack { seq });
        }
        if let Some(seq) = self.reset_due.take_if(|_| self.answered_at.is_some()) {
            return Some(ClientMessage::Reset { seq });
        }
        let is_due = self.poll_timeout().is_some_and(|at| at <= now);
        let current = self.current.as_mut().filter(|current| is_due && !current.is_sent)?;
        current.is_sent = true;
        self.view_sent_at = Some(now);
        self.stats.views += 1;
        Some(ClientMessage::View { seq: current.seq, view: current.view.clone() })
    }

    /// When [`poll_transmit`](Self::poll_transmit) should be asked again although nothing arrived: the moment at which a
    /// newer view may be sent.
    pub fn poll_timeout(&self) -> Option<Timestamp> {
        let current = self.current.as_ref().filter(|current| !current.is_sent)?;
        Some(self.view_sent_at.map_or(current.set_at, |at| at + self.config.view_interval))
    }

    /// Tells the session what went through the socket so far, in bytes. Call it before the frame that those bytes brought.
    pub fn note_traffic(&mut self, bytes_received: u64, bytes_sent: u64) {
        self.stats.bytes_received = bytes_received;
        self.stats.bytes_sent = bytes_sent;
    }

    /// The mesh to show, once the server has sent the base: while the session [restarts](Self::is_restarting), the one from before.
    pub fn replica(&self) -> Option<&Replica> {
        self.shown().map(|model| model.state.replica())
    }

    /// That mesh, for dirty tracking.
    pub fn replica_mut(&mut self) -> Option<&mut Replica> {
        self.kept.as_mut().or(self.model.as_mut()).map(|model| model.state.replica_mut())
    }

    fn shown(&self) -> Option<&Model> {
        self.kept.as_ref().or(self.model.as_ref())
    }

    /// Counts the meshes shown: 0 before the welcome, then one more with each restart, and where the mesh from before gives way to
    /// that of a session that began anew. When it changes, the replica is a new one
    /// and whoever holds a copy must begin again; dirty tracking goes on if it was on, with all of the base touched.
    pub fn generation(&self) -> u32 {
        self.generation
    }

    /// What the server says about the model.
    pub fn model(&self) -> Option<&ModelInfo> {
        self.shown().map(|model| &model.info)
    }

    /// Entries of the mirrored op cache that the server granted.
    pub fn cache_entries(&self) -> Option<u32> {
        self.model.as_ref().map(|model| model.cache_entries)
    }

    /// The newest view and its number.
    pub fn view(&self) -> Option<(ViewSeq, &View)> {
        self.current.as_ref().map(|current| (current.seq, &current.view))
    }

    /// The view that the newest batch applied was chosen for, `None` before the first.
    pub fn applied_view(&self) -> Option<ViewSeq> {
        self.applied_view
    }

    /// The server's word that the mesh is exactly what the newest view asks for; `None` until then.
    pub fn settled(&self) -> Option<Settled> {
        self.settled
    }

    /// What happened so far.
    pub fn stats(&self) -> &Stats {
        &self.stats
    }

    fn awaits_answer(&self) -> bool {
        self.answered_at.is_none()
    }
}

#[cfg(test)]
mod tests;
