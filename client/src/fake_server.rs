//! A server small enough to drive by hand: it splits and collapses at random and tells the truth unless asked to lie.

use lodestream_protocol::ids::{BatchSeq, ModelHash, Token, ViewSeq};
use lodestream_protocol::mesh::{Cut, Fan, Patch, Replica};
use lodestream_protocol::message::{Batch, ModelInfo, Outcome, ServerMessage, Settled};
use lodestream_protocol::op::{BatchEncoder, OpState, encode_base};
use lodestream_protocol::quant::Lattice;
use lodestream_protocol::testing::{OperationRng, base_meshes};
use lodestream_protocol::wire::encode_server;

const BITS: u8 = 12;
const CACHE_ENTRIES: u32 = 64;
pub(crate) const TOKEN: Token = Token([7; 16]);

pub(crate) struct FakeServer {
    base: Patch,
    state: OpState,
    seq: BatchSeq,
    rng: OperationRng,
}

impl FakeServer {
    /// Serves a coloured tetrahedron on a 12-bit lattice of step 0.5.
    pub(crate) fn new() -> Self {
        let (_, base) = base_meshes().swap_remove(0);
        let state = OpState::new(&base, BITS, true, false, CACHE_ENTRIES).unwrap();
        Self { base, state, seq: BatchSeq(0), rng: OperationRng::new(7) }
    }

    pub(crate) fn model(&self) -> ModelInfo {
        ModelInfo {
            hash: ModelHash(1),
            title: "tetrahedron".into(),
            lattice: Lattice { origin: [-10.0, 0.0, 5.0], step: 0.5, bits: BITS },
            box_min: [0; 3],
            box_max: [4095; 3],
            has_colors: true,
            has_moves: false,
            visual_step: None,
            is_open: false,
            triangles: 10_000,
            vertices: 5_000,
            smallest_limit: 4,
            crease_angle_deg: 40.0,
        }
    }

    pub(crate) fn replica(&self) -> &Replica {
        self.state.replica()
    }

    /// The newest batch sent.
    pub(crate) fn seq(&self) -> BatchSeq {
        self.seq
    }

    pub(crate) fn welcome(&self) -> Vec<u8> {
        let base = encode_base(&self.base, BITS, true);
        encode_server(&ServerMessage::Welcome {
            model: self.model(),
            cache_entries: CACHE_ENTRIES,
            token: Some(TOKEN),
            base,
        })
    }

    /// A batch that collapses what it may, if asked to, and splits about `splits` vertices in one round.
    pub(crate) fn batch_message(&mut self, view: ViewSeq, collapse: bool, splits: usize) -> Batch {
        let limit = 1_000_000;
        let mut encoder = BatchEncoder::new(&mut self.state, false);
        let members: Vec<u32> = match collapse {
            true => encoder.replica().collapsible().iter().collect(),
            false => Vec::new(),
        };
        if encoder.collapse_round(&members).unwrap() {
            encoder.collapse_round(&[]).unwrap();
        }
        encoder.spawns(&[], limit).unwrap();
        let members: Vec<u32> = encoder.replica().vertices().iter().take(splits).collect();
        encoder.split_round(&members).unwrap();
        for &s in &members {
            // Where the cache holds the split, the encoder takes the geometry from there.
            let resolve = |_: &Replica, fan: &Fan| {
                let cut = self.rng.random_cut(fan).unwrap_or(Cut::Both { right: 0, left: 1 });
                Some((cut, self.rng.random_vertex()))
            };
            encoder.split(s, limit, resolve).unwrap();
        }
        if !members.is_empty() && encoder.end_split_round() {
            encoder.split_round(&[]).unwrap();
        }
        let (ops, _) = encoder.finish();
        self.seq.0 += 1;
        let digest = self.state.replica().digest() as u16;
        let (limit, lambda_px) = (Some(limit), Some(2.5));
        Batch { seq: self.seq.low(), view: view.low(), limit, lambda_px, digest, outcome: None, ops }
    }

    pub(crate) fn batch(&mut self, view: ViewSeq, splits: usize) -> Vec<u8> {
        encode_server(&ServerMessage::Batch(self.batch_message(view, false, splits)))
    }

    pub(crate) fn settled(&self, view: ViewSeq) -> Vec<u8> {
        encode_server(&ServerMessage::Settled(Settled {
            view,
            seq: self.seq,
            outcome: Outcome { error_px: 0.5, limited: true },
        }))
    }

    /// Goes back to the base, as the real one does after a reset.
    pub(crate) fn restart(&mut self) -> Vec<u8> {
        self.state = OpState::new(&self.base, BITS, true, false, CACHE_ENTRIES).unwrap();
        self.seq = BatchSeq(0);
        encode_server(&ServerMessage::Restart)
    }
}
