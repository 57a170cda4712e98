//! What a session counts, for people, for `--stats` and for the load tester.

use serde::Serialize;

use lodestream_protocol::op::OpCounts;
use lodestream_protocol::time::Timestamp;

/// Triangles from which on a replica makes a first image; less is one only if the view wants no more.
pub const FIRST_IMAGE_TRIANGLES: u32 = 2_000;

/// Counters of one session. Times are milliseconds since [`Timestamp`] zero, when the driver began to connect.
///
/// The names of the fields are those of `--stats`.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Stats {
    /// Bytes that came through the socket, upgrade and frame headers included. The driver counts them.
    pub bytes_received: u64,
    /// Bytes that went out through the socket, counted likewise.
    pub bytes_sent: u64,
    /// Frames received.
    pub frames: u64,
    /// Batches applied.
    pub batches: u64,
    /// Bytes of their coded ops, without the headers of batch and frame.
    pub op_bytes: u64,
    /// Vertex splits applied, cached ones included.
    pub splits: u64,
    /// Splits that came from the mirrored cache.
    pub cached_splits: u64,
    /// Edge collapses applied.
    pub collapses: u64,
    /// Components inserted.
    pub spawns: u64,
    /// Components removed.
    pub despawns: u64,
    /// Vertices in the replica now.
    pub vertices: u32,
    /// Triangles in the replica now.
    pub triangles: u32,
    /// Most triangles after any single op.
    pub max_triangles_seen: u32,
    /// Largest error that the mesh leaves in the view, in pixels (lattice steps for complete views): the server's figure
    /// once settled, before that the threshold of the newest batch.
    pub error_px: Option<f32>,
    /// Whether the mesh is exactly what the newest view asks for.
    pub settled: bool,
    /// Whether, settled, the triangle limit kept wanted ops out.
    pub limited: bool,
    /// When the replica first had [`FIRST_IMAGE_TRIANGLES`] triangles, or all that were wanted.
    pub first_image_ms: Option<f64>,
    /// `bytes_received` at that moment.
    pub first_image_bytes: Option<u64>,
    /// When the newest view settled.
    pub settled_ms: Option<f64>,
    /// Milliseconds from setting the newest view to applying the first batch that was chosen for it.
    pub view_latency_ms: Option<f64>,
    /// Views sent.
    pub views: u64,
    /// How often the server was asked to begin again because the two ends disagreed.
    pub resets: u32,
    /// How often the connection broke, how often the session went on after that, and how often it had to begin anew.
    pub connections_lost: u32,
    /// See `connections_lost`.
    pub resumed: u32,
    /// See `connections_lost`.
    pub restarted: u32,
    /// Batches that arrived between such a request and its answer.
    pub dropped_batches: u64,
}

impl Stats {
    /// Adds what a batch did.
    pub(super) fn count(&mut self, op_bytes: usize, counts: &OpCounts) {
        self.batches += 1;
        self.op_bytes += op_bytes as u64;
        self.splits += u64::from(counts.splits);
        self.cached_splits += u64::from(counts.cached_splits);
        self.collapses += u64::from(counts.collapses);
        self.spawns += u64::from(counts.spawns);
        self.despawns += u64::from(counts.despawns);
        self.max_triangles_seen = self.max_triangles_seen.max(counts.max_triangles);
    }

    /// Notes the size of the replica, and with it the first image.
    pub(super) fn note_mesh(&mut self, now: Timestamp, vertices: u32, triangles: u32) {
        self.vertices = vertices;
        self.triangles = triangles;
        self.max_triangles_seen = self.max_triangles_seen.max(triangles);
        if self.first_image_ms.is_none() && (triangles >= FIRST_IMAGE_TRIANGLES || self.settled) {
            self.first_image_ms = Some(millis(now));
            self.first_image_bytes = Some(self.bytes_received);
        }
    }
}

/// Milliseconds since [`Timestamp`] zero.
pub(super) fn millis(at: Timestamp) -> f64 {
    at.0.as_secs_f64() * 1e3
}
