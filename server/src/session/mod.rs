//! The streaming brain of one client, without I/O: frames in, frames out, time as an argument.

use std::sync::Arc;

use lodestream_protocol::message::CloseCode;
use lodestream_protocol::time::Timestamp;

use crate::pack::{PackError, PackedModel};

/// What a server decides for all its sessions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SessionConfig {
    /// Most entries of the mirrored op cache per session.
    pub max_cache_entries: u32,
    /// Most bytes that may be unacknowledged, whatever the link.
    pub max_window_bytes: u32,
}

impl Default for SessionConfig {
    fn default() -> Self {
        Self { max_cache_entries: 1 << 17, max_window_bytes: 1 << 20 }
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
    /// Components inserted and removed.
    pub spawns: u64,
    /// Resets that the client asked for.
    pub resets: u64,
    /// Views received.
    pub views: u64,
    /// Memory held now.
    pub heap_bytes: u64,
}

/// One client's session.
#[derive(Debug)]
pub struct Session {
    _model: Arc<PackedModel>,
}

#[allow(unused_variables, missing_docs)]
impl Session {
    pub fn new(model: Arc<PackedModel>, config: SessionConfig) -> Self {
        Self { _model: model }
    }

    /// Takes one frame from the client.
    pub fn handle_frame(&mut self, now: Timestamp, frame: &[u8]) -> Result<(), SessionError> {
        unimplemented!()
    }

    /// Next frame to send, or `None` while the window is full or there is nothing to do. Work per call is bounded.
    pub fn poll_transmit(&mut self, now: Timestamp) -> Result<Option<Vec<u8>>, SessionError> {
        unimplemented!()
    }

    /// When to call `poll_transmit` again although no frame came in.
    pub fn poll_timeout(&self) -> Option<Timestamp> {
        unimplemented!()
    }

    pub fn stats(&self) -> SessionStats {
        unimplemented!()
    }
}
