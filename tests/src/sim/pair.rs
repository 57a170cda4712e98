//! A server session and a client session joined by two links.

use std::sync::Arc;
use std::time::Duration;

use lodestream_client::core::{ClientConfig, ClientSession};
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::View;
use lodestream_server::pack::PackedModel;
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
}

impl Default for PairConfig {
    fn default() -> Self {
        let client = ClientConfig { view_interval: Duration::ZERO, ..ClientConfig::default() };
        Self { down: LinkShape::INSTANT, up: LinkShape::INSTANT, client }
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
    down: Link,
    up: Link,
    kept: Option<[Vec<Vec<u8>>; 2]>,
}

impl Pair {
    /// Two fresh ends.
    pub fn new(model: Arc<PackedModel>, config: PairConfig) -> Self {
        Self {
            server: Session::new(model, SessionConfig::default()),
            client: ClientSession::new(config.client),
            now: Timestamp::default(),
            down: Link::new(config.down),
            up: Link::new(config.up),
            kept: None,
        }
    }

    /// Bytes of frames sent to the client so far.
    pub fn bytes_down(&self) -> u64 {
        self.down.bytes
    }

    /// Keeps a copy of every frame from now on.
    pub fn keep_frames(&mut self) {
        self.kept = Some([Vec::new(), Vec::new()]);
    }

    /// The frames kept: server to client, client to server.
    pub fn kept_frames(self) -> [Vec<Vec<u8>>; 2] {
        self.kept.unwrap_or_default()
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
        let next =
            [self.down.next_arrival(), self.up.next_arrival(), self.client.poll_timeout(), self.server.poll_timeout()];
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
            self.down.send(now, frame);
            moved = true;
        }
        while let Some(frame) = self.down.receive(now) {
            self.client.handle_frame(now, &frame).expect("the server sends what the client takes");
            assert_eq!(self.client.stats().resets, 0, "the two ends disagreed");
            moved = true;
        }
        moved
    }
}
