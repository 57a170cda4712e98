//! A server session and a client session joined by two links.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;
use std::time::Duration;

use lodestream_client::core::{ClientConfig, ClientSession, Connectivity};
use lodestream_protocol::ids::Token;
use lodestream_protocol::message::ServerMessage;
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::View;
use lodestream_protocol::wire::decode_server;
use lodestream_server::pack::{PackedModel, PageId};
use lodestream_server::session::{Session, SessionConfig};

use super::link::{Link, LinkShape};

/// How to set a pair up.
#[derive(Clone, Copy, Debug)]
pub struct PairConfig {
    /// Server to client.
    pub down: LinkShape,
    /// Client to server.
    pub up: LinkShape,
    /// The client's wishes.
    pub client: ClientConfig,
    /// How the server gets at pages.
    pub disk: Disk,
}

/// Where a server's pages come from.
#[derive(Clone, Copy, Debug)]
pub enum Disk {
    /// They are read where they are needed, at once.
    Instant,
    /// The server reads ahead: a disk with this seed reads any of the pages wanted, one after the other, each within so long.
    Slow {
        /// Same seed, same order.
        seed: u64,
        /// Longest time for a page.
        latency: Duration,
    },
}

impl Default for PairConfig {
    fn default() -> Self {
        let client = ClientConfig { view_interval: Duration::ZERO, ..ClientConfig::default() };
        Self { down: LinkShape::INSTANT, up: LinkShape::INSTANT, client, disk: Disk::Instant }
    }
}

/// Both ends and the clock.
#[derive(Debug)]
pub struct Pair {
    /// The server's end.
    pub server: Session,
    /// The client's end.
    pub client: ClientSession,
    /// Virtual time.
    pub now: Timestamp,
    model: Arc<PackedModel>,
    down: Link,
    up: Link,
    /// Whether there is a connection.
    is_open: bool,
    tokens: u64,
    batches: Batches,
    kept: Option<[Vec<Vec<u8>>; 2]>,
    damages: bool,
    damaged: u32,
    reader: Option<Reader>,
}

/// Checks what goes over the link: every batch arrives once, whatever is cut.
#[derive(Debug, Default)]
struct Batches {
    /// Hashes of the frames of all batches since the last base, in the order in which they were first sent: the frames of an hour
    /// would look like a leak.
    sent: Vec<u64>,
    /// How many batches arrived at the client since the last base that did.
    received: usize,
    /// Where those go on that the server sends now.
    next: usize,
    /// How many were sent more than once.
    again: u64,
}

impl Batches {
    fn send(&mut self, frame: &[u8]) {
        match decode_server(frame).expect("the server sends valid frames") {
            ServerMessage::Batch(_) => {}
            ServerMessage::Welcome { .. } | ServerMessage::Restart => {
                (self.sent, self.next) = (Vec::new(), 0);
                return;
            }
            ServerMessage::Resumed { .. } => {
                self.next = self.received;
                return;
            }
            ServerMessage::Settled(_) => return,
        }
        let mut hasher = DefaultHasher::new();
        frame.hash(&mut hasher);
        let hash = hasher.finish();
        match self.sent.get(self.next) {
            Some(&before) => {
                assert!(before == hash, "a batch that is sent again is as it was");
                self.again += 1;
            }
            None => self.sent.push(hash),
        }
        self.next += 1;
    }

    fn receive(&mut self, frame: &[u8]) {
        match decode_server(frame) {
            Ok(ServerMessage::Batch(_)) => self.received += 1,
            Ok(ServerMessage::Welcome { .. } | ServerMessage::Restart) => self.received = 0,
            _ => {}
        }
    }
}

/// Reads pages for the server, see [`Disk::Slow`].
#[derive(Debug)]
struct Reader {
    model: Arc<PackedModel>,
    rng: fastrand::Rng,
    latency: Duration,
    wanted: Vec<PageId>,
    next_at: Timestamp,
    pages_read: u32,
}

impl Reader {
    fn want(&mut self, now: Timestamp, pages: Vec<PageId>) {
        if self.wanted.is_empty() {
            self.next_at = self.next_page_at(now);
        }
        self.wanted = pages;
    }

    fn next_page_at(&mut self, now: Timestamp) -> Timestamp {
        now + self.latency.mul_f64(self.rng.f64())
    }

    fn next_arrival(&self) -> Option<Timestamp> {
        (!self.wanted.is_empty()).then_some(self.next_at)
    }

    /// Reads the page that is due by `now`, if one is.
    fn read(&mut self, now: Timestamp) -> bool {
        if self.next_arrival().is_none_or(|at| at > now) {
            return false;
        }
        let page = self.wanted.swap_remove(self.rng.usize(0..self.wanted.len()));
        self.pages_read += u32::from(!self.model.is_ready(page));
        // Damage is told by the model.
        let _ = self.model.read_page(page);
        self.next_at = self.next_page_at(now);
        true
    }
}

impl Pair {
    /// Two fresh ends.
    pub fn new(model: Arc<PackedModel>, config: PairConfig) -> Self {
        let reader = match config.disk {
            Disk::Instant => None,
            Disk::Slow { seed, latency } => Some(Reader {
                model: model.clone(),
                rng: fastrand::Rng::with_seed(seed),
                latency,
                wanted: Vec::new(),
                next_at: Timestamp::default(),
                pages_read: model.ready_pages(),
            }),
        };
        let mut server = fresh_session(&model, reader.is_some());
        server.offer(token(0));
        Self {
            model,
            server,
            client: ClientSession::new(config.client),
            now: Timestamp::default(),
            down: Link::new(config.down),
            up: Link::new(config.up),
            is_open: true,
            tokens: 0,
            batches: Batches::default(),
            kept: None,
            damages: false,
            damaged: 0,
            reader,
        }
    }

    /// Bytes of frames sent to the client so far.
    pub fn bytes_down(&self) -> u64 {
        self.down.bytes
    }

    /// Bytes of the largest frame sent to the client so far.
    pub fn largest_frame_down(&self) -> usize {
        self.down.largest
    }

    /// Pages that [`Disk::Slow`] has read.
    pub fn pages_read(&self) -> u32 {
        self.reader.as_ref().map_or(0, |reader| reader.pages_read)
    }

    /// Keeps a copy of every frame from now on.
    pub fn keep_frames(&mut self) {
        self.kept = Some([Vec::new(), Vec::new()]);
    }

    /// The frames kept: server to client, client to server.
    pub fn kept_frames(self) -> [Vec<Vec<u8>>; 2] {
        self.kept.unwrap_or_default()
    }

    /// The connection breaks: what is on its way is lost. The client comes back when its time to try again has come.
    pub fn cut(&mut self) {
        for link in [&mut self.down, &mut self.up] {
            link.cut();
        }
        self.is_open = false;
        self.client.handle_loss(self.now);
    }

    /// Likewise, and the server has forgotten the session when the client comes back.
    pub fn cut_and_forget(&mut self) {
        self.cut();
        self.server = fresh_session(&self.model, self.reader.is_some());
    }

    /// Batches that were sent more than once.
    pub fn sent_again(&self) -> u64 {
        self.batches.again
    }

    /// Makes the connection anew if it is time to.
    fn reconnect(&mut self) {
        let Connectivity::Reconnecting { next_try, .. } = self.client.connectivity() else { return };
        if !self.is_open && next_try <= self.now {
            self.server.park();
            if self.client.model().is_none() {
                // It has no token to come back with.
                self.server = fresh_session(&self.model, self.reader.is_some());
            }
            self.tokens += 1;
            self.server.offer(token(self.tokens));
            self.is_open = true;
        }
    }

    /// Damages the next large batch on its way to the client, which then asks to begin again.
    pub fn damage_a_batch(&mut self) {
        self.damages = true;
    }

    /// Flips a bit of the ops if this is a batch and its turn has come.
    fn damage(&mut self, frame: &mut [u8]) {
        // After the welcome only batches are so long, and three quarters of such a one are beyond its header.
        if self.damages && frame.len() > 200 && self.client.replica().is_some() {
            frame[frame.len() * 3 / 4] ^= 0x10;
            self.damages = false;
            self.damaged += 1;
        }
    }

    fn keep(&mut self, end: usize, frame: &[u8]) {
        if let Some(kept) = &mut self.kept {
            kept[end].push(frame.to_vec());
        }
    }

    /// Asks for a view.
    pub fn look(&mut self, view: View) {
        self.client.set_view(self.now, view).expect("the test's view is valid");
    }

    /// Moves everything that can move now, then advances the clock to the next event, at most by `at_most`. Returns false
    /// if nothing is left to wait for.
    pub fn step(&mut self, at_most: Duration) -> bool {
        self.exchange_all();
        let next = [
            self.down.next_arrival(),
            self.up.next_arrival(),
            self.client.poll_timeout().filter(|_| self.is_open),
            self.server.poll_timeout().filter(|_| self.is_open),
            match self.client.connectivity() {
                Connectivity::Reconnecting { next_try, .. } if !self.is_open => Some(next_try),
                _ => None,
            },
            self.reader.as_ref().filter(|_| self.is_open).and_then(Reader::next_arrival),
        ];
        let Some(next) = next.into_iter().flatten().min() else { return false };
        self.now = next.max(self.now + Duration::from_micros(1)).min(self.now + at_most);
        true
    }

    /// Runs until the newest view has settled at the client.
    pub fn settle(&mut self) {
        for _ in 0..10_000_000 {
            self.exchange_all();
            if self.client.settled().is_some() {
                return;
            }
            assert!(self.step(Duration::from_secs(10)), "nothing is left to happen, and the view has not settled");
        }
        panic!("the view did not settle");
    }

    /// Runs for a span of virtual time.
    pub fn run(&mut self, span: Duration) {
        let end = self.now + span;
        while self.now < end {
            if !self.step(end.since(self.now)) {
                self.now = end;
            }
        }
    }

    fn exchange_all(&mut self) {
        for _ in 0..1_000_000 {
            if !self.exchange() {
                return;
            }
        }
        panic!("the two ends talk without end at one moment");
    }

    /// One pass over both ends; whether anything happened.
    fn exchange(&mut self) -> bool {
        self.reconnect();
        if !self.is_open {
            return false;
        }
        let now = self.now;
        let mut moved = false;
        while let Some(frame) = self.client.poll_transmit(now) {
            self.keep(1, &frame);
            self.up.send(now, frame);
            moved = true;
        }
        while let Some(frame) = self.up.receive(now) {
            self.server.handle_frame(now, &frame).expect("the client sends what the server takes");
            moved = true;
        }
        if let Some(frame) = self.server.poll_transmit(now).expect("the session goes on") {
            self.keep(0, &frame);
            self.batches.send(&frame);
            self.down.send(now, frame);
            moved = true;
        }
        if let Some(reader) = &mut self.reader {
            assert_eq!(reader.model.ready_pages(), reader.pages_read, "the session read a page itself");
            if let Some(wanted) = self.server.poll_wanted() {
                reader.want(now, wanted.pages);
            }
            if reader.read(now) {
                self.server.handle_pages().expect("the model is sound");
                moved = true;
            }
        }
        while let Some(mut frame) = self.down.receive(now) {
            self.batches.receive(&frame);
            self.damage(&mut frame);
            self.client.handle_frame(now, &frame).expect("the server sends what the client takes");
            assert!(self.client.stats().resets <= self.damaged, "the two ends disagreed");
            moved = true;
        }
        moved
    }
}

fn fresh_session(model: &Arc<PackedModel>, reads_ahead: bool) -> Session {
    let session = if reads_ahead { Session::reading_ahead } else { Session::new };
    session(Arc::clone(model), SessionConfig::default())
}

/// Tokens need not be secret here, only different.
fn token(number: u64) -> Token {
    let mut bytes = [0; 16];
    bytes[..8].copy_from_slice(&number.to_le_bytes());
    Token(bytes)
}
