//! Dirty slots of a replica to an upload plan, as plain data: what grows, then which slots are written.
//!
//! Slot number = element number in the buffers, so there is no remap table and a plan is three lists of intervals. Nothing
//! here knows the GPU; [`super::buffers`] executes plans.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use lodestream_protocol::ids::FaceSlot;
use lodestream_protocol::mesh::{DirtySlots, Replica};

use super::morph::GpuMorph;

/// Intervals with fewer untouched slots than this between them are written as one: a copy of 64 vertices costs less than
/// another copy command.
pub const MERGED_GAP_SLOTS: u32 = 64;
/// From so many bytes on, fewer gaps are closed: what an image uploads is bounded, commands only take time. Ops all over a large mesh would
/// otherwise write several times what they touch. Together with [as many of states](WIDE_STATE_BYTES) and [of
/// ghosts](super::ghosts::MOST_GHOST_BYTES) it is less than what viewers allow for an image.
pub const WIDE_BYTES: u64 = 1 << 20;
/// The same for states of transitions.
pub const WIDE_STATE_BYTES: u64 = 1 << 17;
/// Widths of gaps that are closed, tried in this order.
const GAPS: [u32; 3] = [MERGED_GAP_SLOTS, 8, 1];

/// Smallest capacity, so that the first few ops do not grow the buffers one after the other.
const SMALLEST_CAPACITY_SLOTS: u32 = 1024;

/// One element of the vertex buffer.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct GpuVertex {
    /// Lattice coordinates. They have at most 21 bits, so `f32` holds them exactly.
    pub position: [f32; 3],
    /// Red in the lowest byte, then green, blue and 255.
    pub color: u32,
}

/// Bytes of a vertex slot in the vertex buffer.
pub const VERTEX_BYTES: u64 = size_of::<GpuVertex>() as u64;
/// Bytes of a vertex slot in the index buffer: the corners of face slots `2v` and `2v + 1`.
pub const FACE_PAIR_BYTES: u64 = 24;

/// What to do before the buffers equal the replica again, in this order: grow, write.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct UploadPlan {
    /// New capacity in slots; what the buffers hold is kept.
    pub grow_to: Option<u32>,
    /// One past the last slot to draw.
    pub slot_end: u32,
    /// Vertex slots to write, ascending and disjoint.
    pub vertices: Vec<Range<u32>>,
    /// Vertex slots whose two face slots to write, ascending and disjoint.
    pub face_pairs: Vec<Range<u32>>,
}

impl UploadPlan {
    /// Whether nothing is written.
    pub fn is_empty(&self) -> bool {
        self.vertices.is_empty() && self.face_pairs.is_empty()
    }

    /// Bytes that the plan writes.
    pub fn bytes(&self) -> u64 {
        bytes(&self.vertices, &self.face_pairs)
    }
}

/// Plans the upload of everything that `replica` recorded as touched, and clears the record. A replica that does not
/// [track](Replica::track_dirty) starts to, and is uploaded whole.
///
/// `capacity_slots` is what the buffers hold now. Costs O(d log d) in the touched slots.
pub fn plan(replica: &mut Replica, capacity_slots: u32) -> UploadPlan {
    if replica.dirty_mut().is_none() {
        replica.track_dirty();
    }
    let slot_end = replica.slot_end();
    let dirty = replica.dirty_mut().expect("tracking is on");
    let (vertices, face_pairs) = narrowed(WIDE_BYTES, |gap| {
        let (vertices, face_pairs) = intervals(dirty, gap);
        let bytes = bytes(&vertices, &face_pairs);
        ((vertices, face_pairs), bytes)
    });
    dirty.clear();
    UploadPlan {
        grow_to: (slot_end > capacity_slots).then(|| grown(capacity_slots, slot_end)),
        slot_end,
        face_pairs,
        vertices,
    }
}

/// Most bytes that an image of the replica as it is now would upload, without [ghosts](super::ghosts::MOST_GHOST_BYTES): what [`plan`] would
/// write, and the state of a transition for each vertex. `None` for a replica that does not track yet, which is uploaded whole.
/// Costs as much as planning. Where it is more than [`WIDE_BYTES`], less may be written.
pub fn planned_bytes(replica: &mut Replica) -> Option<u64> {
    let (vertices, face_pairs) = intervals(replica.dirty_mut()?, MERGED_GAP_SLOTS);
    let touched: u64 = vertices.iter().map(|r| u64::from(r.end - r.start)).sum();
    Some(bytes(&vertices, &face_pairs) + touched * size_of::<GpuMorph>() as u64)
}

/// What `plan` gives for the widest gap that keeps it within so many bytes, else for the narrowest. `plan` is told a gap and says what it comes to.
pub(super) fn narrowed<Plan>(most_bytes: u64, mut plan: impl FnMut(u32) -> (Plan, u64)) -> Plan {
    let [widest, narrower @ ..] = GAPS;
    let (mut chosen, mut bytes) = plan(widest);
    for gap in narrower {
        if bytes <= most_bytes {
            break;
        }
        (chosen, bytes) = plan(gap);
    }
    chosen
}

/// Vertex slots and pairs of face slots to write, in intervals that are at least `gap` slots apart.
fn intervals(dirty: &mut DirtySlots, gap: u32) -> (Vec<Range<u32>>, Vec<Range<u32>>) {
    let gap = gap - 1;
    let vertices = dirty.vertex_ranges(gap);
    let faces = dirty.face_ranges(2 * gap);
    // A slot that is taken anew may have only one face. The other face slot has not changed for the replica, but buffers
    // that held another replica before do not know that, so faces go in pairs and along with their vertex.
    let pairs = faces.into_iter().map(|r| r.start / 2..r.end.div_ceil(2)).chain(vertices.iter().cloned());
    let face_pairs = merge(pairs.collect(), gap);
    (vertices, face_pairs)
}

fn bytes(vertices: &[Range<u32>], face_pairs: &[Range<u32>]) -> u64 {
    let slots = |ranges: &[Range<u32>]| ranges.iter().map(|r| u64::from(r.end - r.start)).sum::<u64>();
    slots(vertices) * VERTEX_BYTES + slots(face_pairs) * FACE_PAIR_BYTES
}

/// How much may be uploaded for one image, held to batch by batch: an op's upload is known once it is applied, so the next
/// batch is judged by what its like cost.
#[derive(Clone, Copy, Debug)]
pub struct Allowance {
    /// Most bytes per image.
    pub bytes: u64,
    /// Most bytes of uploads that a byte of ops came to lately.
    bytes_per_op_byte: f64,
    /// Most bytes of uploads that a batch came to lately: collapses touch as much as splits and take a tenth of the bytes, so a batch's
    /// length alone says little where a limit binds.
    bytes_per_batch: f64,
}

/// What an op byte comes to before anything is known: a split takes some 3 bytes and touches a dozen places of 24 bytes.
const FIRST_BYTES_PER_OP_BYTE: f64 = 100.0;
/// How much more than the costliest batch lately the next one is taken to cost: changes that lie farther apart cost more.
const MARGIN: f64 = 1.5;
/// How fast a costly batch is forgotten, per batch.
const FORGETTING: f64 = 0.98;

impl Allowance {
    /// An allowance of so many bytes per image.
    pub fn new(bytes: u64) -> Self {
        Self { bytes, bytes_per_op_byte: FIRST_BYTES_PER_OP_BYTE, bytes_per_batch: 0.0 }
    }

    /// Whether a batch of so many bytes of ops may be applied for this image when `planned` bytes are to be uploaded already.
    /// The first one may always: otherwise nothing would ever be.
    pub fn admits(&self, planned: u64, op_bytes: usize) -> bool {
        let may_take = self.estimate(op_bytes).max(self.bytes_per_batch as u64);
        planned == 0 || planned.saturating_add(may_take) <= self.bytes
    }

    /// What a batch of so many bytes of ops may come to.
    pub fn estimate(&self, op_bytes: usize) -> u64 {
        (MARGIN * self.bytes_per_op_byte * op_bytes as f64) as u64
    }

    /// A batch of so many bytes of ops raised what is planned from `before` to `after`.
    pub fn learn(&mut self, before: u64, after: u64, op_bytes: usize) {
        // Small batches cost more per byte than large ones, and are no danger.
        let measured = after.saturating_sub(before) as f64 / op_bytes.max(64) as f64;
        self.bytes_per_op_byte = measured.max(self.bytes_per_op_byte * FORGETTING);
        self.bytes_per_batch = (after.saturating_sub(before) as f64).max(self.bytes_per_batch * FORGETTING);
    }
}

/// `capacity` doubled until it holds `slots`.
fn grown(capacity: u32, slots: u32) -> u32 {
    let mut grown = capacity.max(SMALLEST_CAPACITY_SLOTS);
    while grown < slots {
        grown = grown.saturating_mul(2);
    }
    grown
}

fn merge(mut ranges: Vec<Range<u32>>, gap: u32) -> Vec<Range<u32>> {
    ranges.sort_unstable_by_key(|r| r.start);
    let mut merged: Vec<Range<u32>> = Vec::with_capacity(ranges.len());
    for range in ranges {
        match merged.last_mut() {
            Some(last) if range.start <= last.end.saturating_add(gap) => last.end = last.end.max(range.end),
            _ => merged.push(range),
        }
    }
    merged
}

/// The elements of the vertex buffer for these slots.
pub fn gpu_vertices(replica: &Replica, slots: Range<u32>) -> impl Iterator<Item = GpuVertex> + '_ {
    let slots = slots.start as usize..slots.end as usize;
    replica.positions()[slots.clone()].iter().zip(&replica.colors()[slots]).map(|(position, &[r, g, b])| GpuVertex {
        position: position.map(|x| x as f32),
        color: u32::from_le_bytes([r, g, b, 255]),
    })
}

/// The elements of the index buffer for these slots, `2 * slots.len()` times three. A face slot without a face holds
/// `[0, 0, 0]`, which draws nothing.
pub fn gpu_faces(replica: &Replica, slots: Range<u32>) -> impl Iterator<Item = [u32; 3]> + '_ {
    (2 * slots.start..2 * slots.end).map(|face| replica.corners_of(FaceSlot(face)))
}
