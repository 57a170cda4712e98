//! Walks around a vertex: its fan, and reads that bring fans near.

use super::{ApplyError, Face, Replica, next_in_face, previous};
use crate::ids::VertexSlot;
use crate::mesh::fan::{COMMON_SPOKES, Fan, Walked};
use crate::mesh::patch::{HalfEdge, NO_HALF_EDGE};

/// How many fans [`Replica::touch_fans`] walks around at once: what a processor looks ahead.
pub const TOUCHED_AT_ONCE: usize = 8;
/// How many faces of each.
const TOUCHED_FACES: usize = 6;
/// Slots from which on a replica is too large to be near anyway.
const TOUCHED_FROM: usize = 1 << 13;

/// The half-edge of a face after each, and the one before; those of a fourth are never looked up.
static AFTER: [usize; 4] = [1, 2, 0, 0];
static BEFORE: [usize; 4] = [2, 0, 1, 0];

impl Replica {
    /// The faces around `slot` in canonical order, written into `fan`. O(valence); allocates at boundaries and around
    /// vertices of more than 16 faces only.
    ///
    /// # Errors
    /// [`ApplyError::NoVertex`].
    pub fn fan(&self, slot: VertexSlot, fan: &mut Fan) -> Result<(), ApplyError> {
        if !self.vertices.contains(slot.0) {
            return Err(ApplyError::NoVertex(slot.0));
        }
        let start = self.outgoing(self.ops[slot.index()].some_face, slot.0);
        let mut walked = Walked::new();
        let (mut h, mut count) = (start, 0);
        let mut smallest = (u32::MAX, 0);
        while count < COMMON_SPOKES {
            let (face, k) = ((h / 4) as usize, (h % 4) as usize);
            if h < smallest.0 {
                smallest = (h, count);
            }
            let Face { corners, twins } = &self.faces[face];
            (walked.out[count], walked.ring[count]) = (h, corners[AFTER[k]]);
            count += 1;
            let next = twins[BEFORE[k]];
            if next == start {
                fan.close(&mut walked, count, smallest.1);
                return Ok(());
            }
            if next == NO_HALF_EDGE {
                break;
            }
            h = next;
        }
        self.rare_fan(start, fan);
        Ok(())
    }

    /// As [`fan`](Self::fan) does, at a boundary or of a vertex with many faces, from any outgoing half-edge on.
    #[cold]
    #[inline(never)]
    fn rare_fan(&self, start: HalfEdge, fan: &mut Fan) {
        let mut out = Vec::new();
        let mut h = start;
        let mut closed = false;
        loop {
            out.push(h);
            let next = self.twin_of(previous(h));
            if next == NO_HALF_EDGE {
                break;
            }
            if next == start {
                closed = true;
                break;
            }
            h = next;
        }
        if closed {
            let smallest = (0..out.len()).min_by_key(|&i| out[i] / 4).unwrap_or(0);
            out.rotate_left(smallest);
        } else {
            // The walk began somewhere in the middle: find the rest, clockwise from the start.
            let walked = out.len();
            let mut h = start;
            loop {
                let twin = self.twin_of(h);
                if twin == NO_HALF_EDGE {
                    break;
                }
                h = next_in_face(twin);
                out.push(h);
            }
            // ... s+1, s+2, [s-1, s-2, ...] -> ..., s-2, s-1, s, s+1, s+2
            out[walked..].reverse();
            out.rotate_left(walked);
        }
        let mut ring: Vec<u32> = out.iter().map(|&h| self.corner_at(next_in_face(h))).collect();
        if !closed {
            ring.extend(out.last().map(|&last| self.corner_at(previous(last))));
        }
        fan.set(&out, &ring);
    }

    /// Reads around a few vertices, [`TOUCHED_AT_ONCE`] of which are served best, for no other end than to have their fans near
    /// the processor: walking one fan means to wait for one read after the other, walking several at once the reads overlap.
    pub fn touch_fans(&self, slots: &[u32]) {
        if (self.slot_end as usize) < TOUCHED_FROM {
            return;
        }
        let mut seen = 0;
        for slots in slots.chunks_exact(TOUCHED_AT_ONCE) {
            // Of each walk, the face and the corner of it at which the vertex is.
            let mut walks: [(usize, usize); TOUCHED_AT_ONCE] = std::array::from_fn(|i| {
                let face = self.ops.get(slots[i] as usize).map_or(0, |op| op.some_face as usize);
                let [a, b, _] = self.faces[face].corners;
                (face, if a == slots[i] { 0 } else { 1 + usize::from(b != slots[i]) })
            });
            for _ in 0..TOUCHED_FACES {
                for (face, k) in &mut walks {
                    let Face { corners: [a, b, c], twins: [ab, bc, ca] } = self.faces[*face];
                    let (end, next) = [(b, ca), (c, ab), (a, bc)][*k];
                    seen ^= self.position[end as usize][0] ^ self.ops[*face / 2].origin as i32;
                    if next != NO_HALF_EDGE {
                        (*face, *k) = ((next / 4) as usize, (next % 4).min(2) as usize);
                    }
                }
            }
        }
        std::hint::black_box(seen);
    }
}
