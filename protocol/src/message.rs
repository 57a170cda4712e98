//! Control messages: plain types made for the wire.

use std::num::NonZeroU16;

use serde::{Deserialize, Serialize};

use crate::ids::{BatchSeq, ModelHash, Token, ViewSeq};
use crate::quant::Lattice;
use crate::view::View;

/// Version of everything in `PROTOCOL.md`. Both ends must have the same.
pub const PROTOCOL_VERSION: u16 = 6;

/// What a client says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ClientMessage {
    /// First message of a connection, of a client that holds nothing.
    Hello(Hello),
    /// What to show from now on. Only the newest view counts.
    View {
        /// Increases with each view.
        seq: ViewSeq,
        /// The request.
        view: View,
    },
    /// The batch and all before it are applied.
    Ack {
        /// The newest batch applied.
        seq: BatchSeq,
    },
    /// The client's state is of no use (a digest differed, a batch did not decode): send the base again.
    Reset {
        /// The batch at fault.
        seq: BatchSeq,
    },
    /// First message of a connection, in place of the hello: of a client whose connection before this one broke.
    Resume(Resume),
}

/// Opens a session.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Hello {
    /// [`PROTOCOL_VERSION`] of the client.
    pub version: u16,
    /// Triangle limit that the views will have: the default size of the cache follows from it.
    pub triangle_limit: u32,
    /// Entries of the mirrored op cache that the client would like, or `None` for the server's default.
    pub cache_entries: Option<u32>,
    /// Most bytes per second that the server may send, or `None`.
    pub byte_rate: Option<u32>,
}

/// Opens a connection and asks to go on with a session. The server answers with [`ServerMessage::Resumed`], or with
/// [`ServerMessage::Welcome`] as if it were a [`Hello`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Resume {
    /// What a hello says. Of a session that goes on, the cache stays as it is.
    pub hello: Hello,
    /// The newest that the server gave.
    pub token: Token,
    /// The newest batch that has arrived whole, with all before it; 0 for none since the base. `None`: what the client holds is of
    /// no use (it waits for a restart), so the session is to begin again.
    pub received: Option<BatchSeq>,
}

/// What a server says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ServerMessage {
    /// Answers [`Hello`]; the base mesh follows in the same message.
    Welcome {
        /// The model.
        model: ModelInfo,
        /// Entries of the mirrored op cache, fixed for the session.
        cache_entries: u32,
        /// What to resume the session by, should the connection break. `None` if the server keeps no such sessions.
        token: Option<Token>,
        /// The base mesh, see [`decode_base`](crate::op::decode_base).
        base: Vec<u8>,
    },
    /// Ops, see [`decode_batch`](crate::op::decode_batch).
    Batch(Batch),
    /// The mesh is exactly what the view asks for; nothing more comes until the view changes. Sent where no batch can say so.
    Settled(Settled),
    /// Answers [`ClientMessage::Reset`]: go back to the base, an empty cache and fresh coder contexts. Batches count from 1
    /// again.
    Restart,
    /// Answers [`ClientMessage::Resume`]: the session goes on. The batches after the one that the client named follow, those that were
    /// sent before as they were; or a [`Restart`](Self::Restart), if it named none.
    Resumed {
        /// Takes the place of the one before.
        token: Token,
    },
}

/// The model as a client needs to know it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelInfo {
    /// Identity of the complete mesh.
    pub hash: ModelHash,
    /// Name for people, may be empty.
    pub title: String,
    /// Lattice of all positions.
    pub lattice: Lattice,
    /// Box of the complete mesh in lattice steps.
    pub box_min: [i32; 3],
    /// See `box_min`.
    pub box_max: [i32; 3],
    /// Whether vertices have colours.
    pub has_colors: bool,
    /// Whether splits may move the vertex that they split.
    pub has_moves: bool,
    /// Two coordinates of most vertices are multiples of this, in lattice steps: `visual` precision. `None`: `exact`.
    pub visual_step: Option<NonZeroU16>,
    /// Whether the inside of the surface can be seen, so that back faces should be drawn.
    pub is_open: bool,
    /// Triangles of the complete mesh.
    pub triangles: u64,
    /// Vertices of the complete mesh.
    pub vertices: u64,
    /// Smallest triangle limit that a view may ask for: the base's triangles.
    pub smallest_limit: u32,
    /// Edges whose faces meet at a larger angle than this are drawn sharp, in degrees.
    pub crease_angle_deg: f32,
}

/// Ops sent together.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Batch {
    /// Low byte of its number, which counts from 1 after each base.
    pub seq: u8,
    /// Low 16 bits of the number of the view that the ops were chosen for, see [`ViewSeq::newest`].
    pub view: u16,
    /// Triangle limit in force: the count after an op is at most this, or at most what it was before the op. `None`: as in
    /// the batch before; the first after a base has it.
    pub limit: Option<u32>,
    /// Error threshold in force, in pixels (of the complete mesh's error for complete views, in lattice steps). `None`
    /// likewise.
    pub lambda_px: Option<f32>,
    /// Low 16 bits of the replica's digest after the batch. A mesh that differs stays different, so what one batch does not tell the next
    /// one does.
    pub digest: u16,
    /// Whether the view is settled with this batch, and how.
    pub outcome: Option<Outcome>,
    /// The ops.
    pub ops: Vec<u8>,
}

/// How a view settled.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// Largest priority of an op that is not applied, in pixels (lattice steps for complete views); 0 if all are. Batches carry the upper
    /// 16 bits of it, see [`rounded_up`](Self::rounded_up).
    pub error_px: f32,
    /// Whether the triangle limit kept wanted ops out.
    pub limited: bool,
}

impl Outcome {
    /// With the error as a batch carries it: the least number of 16 bits that is not smaller, at most 1/128 more. A bound stays one.
    pub fn rounded_up(self) -> Self {
        let bits = self.error_px.to_bits();
        // Rounding away from zero what is not below zero; carries go into the exponent, at most to infinity.
        let up = if self.error_px > 0.0 && self.error_px.is_finite() { bits.saturating_add(0xffff) } else { bits };
        Self { error_px: f32::from_bits(up & 0xffff_0000), ..self }
    }
}

/// See [`ServerMessage::Settled`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settled {
    /// The view that is settled.
    pub view: ViewSeq,
    /// Last batch sent.
    pub seq: BatchSeq,
    /// How.
    pub outcome: Outcome,
}

/// Why a WebSocket was closed. The numbers are those of the close frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum CloseCode {
    /// The peer is done.
    Normal = 1000,
    /// The server is shutting down.
    GoingAway = 1001,
    /// A frame was malformed or made no sense.
    Malformed = 4000,
    /// The client speaks another version of the protocol.
    Version = 4001,
    /// The triangle limit is below the model's smallest.
    LimitTooSmall = 4002,
    /// The server is full.
    Full = 4003,
    /// The model's file is damaged.
    ModelDamaged = 4004,
    /// The server failed.
    Internal = 4005,
    /// The client did not say hello, or sent nothing for too long.
    Timeout = 4006,
    /// The session goes on over another connection.
    TakenOver = 4007,
}

impl CloseCode {
    /// All codes.
    pub const ALL: [Self; 10] = {
        use CloseCode::*;
        [Normal, GoingAway, Malformed, Version, LimitTooSmall, Full, ModelDamaged, Internal, Timeout, TakenOver]
    };

    /// The code with this number.
    pub fn from_number(number: u16) -> Option<Self> {
        Self::ALL.into_iter().find(|code| *code as u16 == number)
    }
}
