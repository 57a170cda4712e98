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

/// The faces around a vertex, counter-clockwise, in an order that depends on the mesh alone: from the boundary start of an
/// open fan, from the smallest face slot of a closed one.
#[derive(Clone, Debug, Default)]
pub struct Fan {
    /// Outgoing half-edge in each face.
    pub(super) out: Vec<HalfEdge>,
    /// Slot at the far end of each spoke; an open fan has one spoke more than faces.
    pub(super) ring: Vec<u32>,
}

impl Fan {
    /// Number of faces around the vertex.
    #[inline]
    pub fn faces(&self) -> u32 {
        self.out.len() as u32
    }

    /// Vertices at the far ends of the spokes, counter-clockwise.
    #[inline]
    pub fn ring(&self) -> &[u32] {
        &self.ring
    }

    /// Whether the faces close around the vertex.
    #[inline]
    pub fn is_closed(&self) -> bool {
        self.ring.len() == self.out.len()
    }

    /// The face between spokes `i` and `i + 1`.
    #[inline]
    pub fn face(&self, i: u32) -> FaceSlot {
        FaceSlot(self.out[i as usize] / 4)
    }

    /// Whether `cut` opens this fan into two non-empty ones.
    pub fn admits(&self, cut: Cut) -> bool {
        let spokes = self.ring.len() as u32;
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
