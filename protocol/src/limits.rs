//! Every limit on what crosses the wire, each with its reason. These are part of the protocol, not configuration.

/// Longest frame in either direction. A base of 1,000 triangles takes a few kilobytes and batches are kept to a fraction
/// of a round trip; the bases of models that cannot be simplified further may reach some megabytes.
pub const MAX_FRAME_BYTES: usize = 64 << 20;

/// Longest frame that a client may send: views with clip planes stay far below.
pub const MAX_CLIENT_FRAME_BYTES: usize = 4096;

/// Most ops in one batch: keeps batches interruptible and bounds the work per frame at both ends.
pub const MAX_OPS_PER_BATCH: u32 = 16_384;

/// Most vertex slots of a replica. Face slots are twice as many and half-edges eight times, which must fit `u32`.
pub const MAX_VERTEX_SLOTS: u32 = 1 << 28;

/// Most vertices, and most faces, of a base mesh or a spawned patch. Above this the component should have been
/// simplified, and a decoder should not be made to allocate more for one frame.
pub const MAX_PATCH_ELEMENTS: u32 = 1 << 22;

/// Most entries of the mirrored op cache that a client may ask for: about 100 MB at either end.
pub const MAX_CACHE_ENTRIES: u32 = 1 << 21;

/// Clip planes in a view: a section box.
pub const MAX_CLIP_PLANES: usize = 6;

/// Longest text in a message (titles, reasons), in bytes.
pub const MAX_TEXT_BYTES: usize = 1024;
