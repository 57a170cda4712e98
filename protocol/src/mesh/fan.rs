//! The faces around a vertex and where a split opens them.

use super::patch::HalfEdge;
use crate::ids::FaceSlot;

/// Where a split opens the fan of `s`: indices of spokes in [`Fan`] order.
///
/// Going counter-clockwise, the faces from the right spoke to the left one move to the new vertex.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Cut {
    /// Both faces are inserted. On a closed fan `right != left`; on an open one `right < left`.
    Both {
        /// Spoke that `f_r` opens.
        right: u32,
        /// Spoke that `f_l` opens.
        left: u32,
    },
    /// Only `f_l` is inserted: the new vertex becomes the boundary start of an open fan.
    Left {
        /// Spoke that `f_l` opens; the faces before it move.
        left: u32,
    },
    /// Only `f_r` is inserted: the new vertex becomes the boundary end of an open fan.
    Right {
        /// Spoke that `f_r` opens; the faces after it move.
        right: u32,
    },
}

/// Spokes of a fan that is read without growing anything: nearly all have fewer.
pub(super) const COMMON_SPOKES: usize = 16;

/// Faces and spokes as a walk found them, and room to put those before some face behind the others.
pub(super) struct Walked {
    pub(super) out: [HalfEdge; 2 * COMMON_SPOKES],
    pub(super) ring: [u32; 2 * COMMON_SPOKES],
}

impl Walked {
    #[inline]
    pub(super) fn new() -> Self {
        Self { out: [0; 2 * COMMON_SPOKES], ring: [0; 2 * COMMON_SPOKES] }
    }
}

/// The faces around a vertex, counter-clockwise, in an order that depends on the mesh alone: from the boundary start of an
/// open fan, from the smallest face slot of a closed one.
#[derive(Clone, Debug)]
pub struct Fan {
    /// Outgoing half-edge in each face, then what other fans left there: at least [`COMMON_SPOKES`].
    out: Vec<HalfEdge>,
    /// Slot at the far end of each spoke, likewise; an open fan has one spoke more than faces.
    ring: Vec<u32>,
    faces: usize,
    spokes: usize,
}

impl Default for Fan {
    fn default() -> Self {
        Self { out: vec![0; COMMON_SPOKES], ring: vec![0; COMMON_SPOKES], faces: 0, spokes: 0 }
    }
}

impl Fan {
    /// Becomes the closed fan of these faces and spokes, beginning with that at `first`. `walked` is of the faces in order;
    /// what comes after the first `count` is of no meaning and overwritten.
    #[inline]
    pub(super) fn close(&mut self, walked: &mut Walked, count: usize, first: usize) {
        for i in 0..first {
            walked.out[(count + i) % (2 * COMMON_SPOKES)] = walked.out[i];
            walked.ring[(count + i) % (2 * COMMON_SPOKES)] = walked.ring[i];
        }
        // As many as there may be, since a fixed number of bytes is copied in an instruction or two.
        let first = first.min(COMMON_SPOKES);
        self.out[..COMMON_SPOKES].copy_from_slice(&walked.out[first..][..COMMON_SPOKES]);
        self.ring[..COMMON_SPOKES].copy_from_slice(&walked.ring[first..][..COMMON_SPOKES]);
        (self.faces, self.spokes) = (count, count);
    }

    /// Becomes the fan of these faces and spokes.
    pub(super) fn set(&mut self, out: &[HalfEdge], ring: &[u32]) {
        for (to, from) in [(&mut self.out, out), (&mut self.ring, ring)] {
            if to.len() < from.len() {
                to.resize(from.len(), 0);
            }
            to[..from.len()].copy_from_slice(from);
        }
        (self.faces, self.spokes) = (out.len(), ring.len());
    }

    /// Number of faces around the vertex.
    #[inline]
    pub fn faces(&self) -> u32 {
        self.faces as u32
    }

    /// Outgoing half-edge in each face.
    #[inline]
    pub(super) fn out(&self) -> &[HalfEdge] {
        &self.out[..self.faces]
    }

    /// Vertices at the far ends of the spokes, counter-clockwise.
    #[inline]
    pub fn ring(&self) -> &[u32] {
        &self.ring[..self.spokes]
    }

    /// Whether the faces close around the vertex.
    #[inline]
    pub fn is_closed(&self) -> bool {
        self.spokes == self.faces
    }

    /// The face between spokes `i` and `i + 1`.
    #[inline]
    pub fn face(&self, i: u32) -> FaceSlot {
        FaceSlot(self.out()[i as usize] / 4)
    }

    /// Whether `cut` opens this fan into two non-empty ones.
    pub fn admits(&self, cut: Cut) -> bool {
        let spokes = self.spokes as u32;
        match cut {
            Cut::Both { right, left } if self.is_closed() => right < spokes && left < spokes && right != left,
            Cut::Both { right, left } => right < left && left < spokes,
            Cut::Left { left } => !self.is_closed() && left < spokes,
            Cut::Right { right } => !self.is_closed() && right < spokes,
        }
    }

    /// Number of faces that `cut` moves to the new vertex.
    pub fn arc_len(&self, cut: Cut) -> u32 {
        match cut {
            Cut::Both { right, left } if left < right => left + self.faces() - right,
            Cut::Both { right, left } => left - right,
            Cut::Left { left } => left,
            Cut::Right { right } => self.faces() - right,
        }
    }
}
