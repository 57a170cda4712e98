//! What sessions sent, free of how it was coded: the material for breakdowns, for training priors and for benchmarks of the
//! codec.

use std::num::NonZeroU16;

use glam::DVec3;
use lodestream_client::core::ClientConfig;
use lodestream_protocol::mesh::Patch;
use lodestream_protocol::message::ServerMessage;
use lodestream_protocol::op::{
    BatchTrace, Breakdown, DecodeError, OpCounts, OpState, decode_base, decode_batch, decode_batch_measured,
    decode_batch_traced,
};
use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};
use lodestream_protocol::wire;

use crate::model::TestModel;
use crate::sim::{Pair, PairConfig};

/// What a client looks at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Path {
    /// Everything, from cold.
    Complete,
    /// The whole object from cold, then once around it, a degree a step.
    Orbit,
    /// A close view from cold, then a flight along the surface.
    Close,
    /// Random views far and near, each of the first again at the end.
    Jump,
}

impl Path {
    /// All of them.
    pub const ALL: [Path; 4] = [Path::Complete, Path::Orbit, Path::Close, Path::Jump];

    /// Lower-case name.
    pub fn name(self) -> &'static str {
        match self {
            Path::Complete => "complete",
            Path::Orbit => "orbit",
            Path::Close => "close",
            Path::Jump => "jump",
        }
    }

    /// The views, at one pixel of a 1080-line image.
    pub fn views(self, center: DVec3, radius: f64, triangle_limit: u32) -> Vec<View> {
        let look = |direction: DVec3, distance: f64| {
            let mut view = View::perspective(center + direction * distance, center, 45f32.to_radians());
            view.near = radius * 1e-3;
            view.triangle_limit = triangle_limit;
            view
        };
        let around = |degrees: f64| DVec3::new(degrees.to_radians().sin(), 0.0, degrees.to_radians().cos());
        let whole = radius / 22.5f64.to_radians().sin();
        match self {
            Path::Complete => {
                vec![View { complete: true, triangle_limit: UNLIMITED_TRIANGLES, ..look(DVec3::Z, whole) }]
            }
            Path::Orbit => (0..120).map(|i| look(around(f64::from(i)), whole)).collect(),
            Path::Close => (0..60).map(|i| look(around(f64::from(i)), radius * 0.95)).collect(),
            Path::Jump => {
                let mut rng = fastrand::Rng::with_seed(7);
                let mut views: Vec<View> = (0..12)
                    .map(|_| {
                        let direction = DVec3::new(rng.f64() - 0.5, rng.f64() - 0.5, rng.f64() - 0.5);
                        look(direction.normalize_or(DVec3::Z), radius * (0.95 + 2.0 * rng.f64()))
                    })
                    .collect();
                views.extend(views[..6].to_vec());
                views
            }
        }
    }
}

/// One batch as sent.
#[derive(Clone, Debug)]
pub struct SentBatch {
    /// Its ops.
    pub ops: Vec<u8>,
    /// Triangle limit in force.
    pub limit: u32,
    /// Low 16 bits of the digest after it.
    pub digest: u16,
}

/// One session, from the welcome on.
#[derive(Clone, Debug)]
pub struct SessionTrace {
    /// The base mesh.
    pub base: Patch,
    /// Bytes of the coded base mesh.
    pub base_bytes: u64,
    /// All that the client received.
    pub received: Received,
    /// What it received until its first view had settled.
    pub first_view: Received,
    /// Bits of a lattice coordinate.
    pub lattice_bits: u8,
    /// Whether vertices have colours.
    pub has_colors: bool,
    /// Whether splits move the vertex that they split.
    pub has_moves: bool,
    /// Step of `visual` precision.
    pub visual_step: Option<NonZeroU16>,
    /// Capacity of the op cache.
    pub cache_entries: u32,
    /// The batches as sent.
    pub batches: Vec<SentBatch>,
}

/// What a client received, as sums.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Received {
    /// Frames.
    pub frames: u64,
    /// Their bytes.
    pub frame_bytes: u64,
    /// Bytes of their WebSocket headers.
    pub websocket_bytes: u64,
    /// Batches among them.
    pub batches: usize,
    /// Bytes of the coded ops in these.
    pub op_bytes: u64,
}

/// What a part of a session held, and what its bytes were spent on.
#[derive(Clone, Debug, Default)]
pub struct Spent {
    /// Splits, those among them that came from the cache, collapses and spawns.
    pub ops: OpCounts,
    /// Bits of the coded ops.
    pub coded: Breakdown,
    /// Bits of frames that are neither ops nor the base mesh.
    pub framing_bits: f64,
    /// Bits of WebSocket headers.
    pub websocket_bits: f64,
    /// All of it and the base mesh.
    pub total_bits: f64,
    /// Frames.
    pub frames: u64,
}

impl SessionTrace {
    /// Runs a session over a link without delay, each view until it has settled, and keeps what was sent.
    ///
    /// # Panics
    /// If the two ends disagree.
    pub fn record(test: &TestModel, path: Path, triangle_limit: u32) -> Self {
        let (lo, hi) = test.clean.bounding_box().expect("the mesh has vertices");
        let (lo, hi) = (DVec3::from_array(lo), DVec3::from_array(hi));
        let client = ClientConfig { triangle_limit, ..PairConfig::default().client };
        let mut pair = Pair::new(test.model.clone(), PairConfig { client, ..PairConfig::default() });
        pair.keep_frames();
        for view in path.views((lo + hi) / 2.0, (hi - lo).length() / 2.0, triangle_limit) {
            pair.look(view);
            pair.settle();
        }
        let [frames, _] = pair.kept_frames();
        Self::of_frames(&frames)
    }

    /// What the frames to a client hold.
    ///
    /// # Panics
    /// If they are no session.
    pub fn of_frames(frames: &[Vec<u8>]) -> Self {
        let mut trace: Option<Self> = None;
        let (mut batches, mut limit) = (Vec::new(), 0);
        let mut received = Received::default();
        let mut first_view = None;
        for frame in frames {
            received.frames += 1;
            received.frame_bytes += frame.len() as u64;
            received.websocket_bytes += websocket_header(frame.len());
            match wire::decode_server(frame).expect("the server sends valid frames") {
                ServerMessage::Welcome { model, cache_entries, base, .. } => {
                    trace = Some(Self {
                        base: decode_base(&base, model.lattice.bits, model.has_colors).expect("the base decodes"),
                        base_bytes: base.len() as u64,
                        received: Received::default(),
                        first_view: Received::default(),
                        lattice_bits: model.lattice.bits,
                        has_colors: model.has_colors,
                        has_moves: model.has_moves,
                        visual_step: model.visual_step,
                        cache_entries,
                        batches: Vec::new(),
                    });
                }
                ServerMessage::Batch(batch) => {
                    received.batches += 1;
                    received.op_bytes += batch.ops.len() as u64;
                    limit = batch.limit.unwrap_or(limit);
                    if batch.outcome.is_some() {
                        first_view.get_or_insert(received);
                    }
                    batches.push(SentBatch { ops: batch.ops, limit, digest: batch.digest });
                }
                ServerMessage::Settled(_) => _ = first_view.get_or_insert(received),
                ServerMessage::Restart => panic!("the two ends disagreed"),
                ServerMessage::Resumed { .. } => panic!("a session that was not cut is none to resume"),
            }
        }
        let mut trace = trace.expect("a session begins with a welcome");
        trace.first_view = first_view.unwrap_or(received);
        trace.received = received;
        trace.batches = batches;
        trace
    }

    /// The state of both ends before the first batch.
    pub fn start(&self) -> OpState {
        let Self { base, lattice_bits, has_colors, has_moves, cache_entries, .. } = self;
        OpState::new(base, *lattice_bits, *has_colors, *has_moves, *cache_entries)
            .expect("the base is a manifold")
            .with_step(self.visual_step)
    }

    /// The ops, batch by batch.
    ///
    /// # Errors
    /// If a batch does not decode.
    pub fn ops(&self) -> Result<Vec<(BatchTrace, u32)>, DecodeError> {
        let mut state = self.start();
        let traced = |batch: &SentBatch| Ok((decode_batch_traced(&batch.ops, &mut state, batch.limit)?, batch.limit));
        self.batches.iter().map(traced).collect()
    }

    /// What everything was spent on.
    ///
    /// # Errors
    /// If a batch does not decode.
    pub fn spent(&self) -> Result<Spent, DecodeError> {
        self.spent_after(&Received::default())
    }

    /// What was spent on moving: all that came after the first view had settled.
    ///
    /// # Errors
    /// If a batch does not decode.
    pub fn spent_moving(&self) -> Result<Spent, DecodeError> {
        self.spent_after(&self.first_view)
    }

    fn spent_after(&self, start: &Received) -> Result<Spent, DecodeError> {
        let mut state = self.start();
        let mut before = Breakdown::default();
        let mut spent = Spent::default();
        for (number, batch) in self.batches.iter().enumerate() {
            let is_before = number < start.batches;
            let breakdown = if is_before { &mut before } else { &mut spent.coded };
            let counts = decode_batch_measured(&batch.ops, &mut state, batch.limit, breakdown)?;
            if !is_before {
                spent.ops.splits += counts.splits;
                spent.ops.cached_splits += counts.cached_splits;
                spent.ops.collapses += counts.collapses;
                spent.ops.spawns += counts.spawns;
                spent.ops.despawns += counts.despawns;
                spent.ops.max_triangles = spent.ops.max_triangles.max(counts.max_triangles);
            }
        }
        let base_bytes = if start.frames == 0 { self.base_bytes } else { 0 };
        let frame_bytes = self.received.frame_bytes - start.frame_bytes;
        let op_bytes = self.received.op_bytes - start.op_bytes;
        spent.framing_bits = 8.0 * (frame_bytes - op_bytes - base_bytes) as f64;
        spent.websocket_bits = 8.0 * (self.received.websocket_bytes - start.websocket_bytes) as f64;
        spent.total_bits = 8.0 * frame_bytes as f64 + spent.websocket_bits;
        spent.frames = self.received.frames - start.frames;
        Ok(spent)
    }

    /// Decodes and applies everything: the client's work, for benchmarks.
    ///
    /// # Errors
    /// If a batch does not decode.
    pub fn replay(&self) -> Result<OpState, DecodeError> {
        let mut state = self.start();
        for batch in &self.batches {
            decode_batch(&batch.ops, &mut state, batch.limit)?;
        }
        Ok(state)
    }
}

/// Bytes of the header of an unmasked WebSocket frame (RFC 6455, section 5.2).
fn websocket_header(payload: usize) -> u64 {
    match payload {
        0..=125 => 2,
        126..=65_535 => 4,
        _ => 10,
    }
}
