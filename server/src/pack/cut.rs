//! From stored cut references to spokes of the mesh as it is now.

use lodestream_protocol::ids::{FaceSlot, VertexSlot};
use lodestream_protocol::mesh::{Cut, Fan, Replica};

/// Why a stored cut does not fit the mesh: the pack is damaged, or a parent is not applied.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CutError {
    /// The split inserts no face.
    #[error("the cut has no side")]
    NoSide,
    /// The face is not around the vertex.
    #[error("face slot {0} is not around the vertex to split")]
    NotAround(u32),
    /// The edge does not end at the vertex.
    #[error("edge {edge} of face slot {face} does not end at the vertex to split")]
    NotAtVertex {
        /// The face slot.
        face: u32,
        /// The edge.
        edge: u8,
    },
}

/// The cut of vertex `s`, whose `fan` the caller has just read, through an edge (face slot and edge number `k`, from its
/// corner `k` to corner `k + 1`) on either side. Whether the cut opens the fan is up to [`Replica::split`]. O(valence).
///
/// # Errors
/// [`CutError`] if an edge is not one of the fan's spokes.
pub fn resolve_cut(
    replica: &Replica,
    fan: &Fan,
    s: VertexSlot,
    left: Option<(FaceSlot, u8)>,
    right: Option<(FaceSlot, u8)>,
) -> Result<Cut, CutError> {
    let spoke = |edge: (FaceSlot, u8)| spoke_of(replica, fan, s, edge);
    match (left, right) {
        (Some(left), Some(right)) => Ok(Cut::Both { right: spoke(right)?, left: spoke(left)? }),
        (Some(left), None) => Ok(Cut::Left { left: spoke(left)? }),
        (None, Some(right)) => Ok(Cut::Right { right: spoke(right)? }),
        (None, None) => Err(CutError::NoSide),
    }
}

/// The spoke that an edge of a face around `s` lies on.
fn spoke_of(replica: &Replica, fan: &Fan, s: VertexSlot, (face, edge): (FaceSlot, u8)) -> Result<u32, CutError> {
    let index = (0..fan.faces()).find(|&i| fan.face(i) == face).ok_or(CutError::NotAround(face.0))?;
    let corners = replica.corners_of(face);
    let k = usize::from(edge);
    if corners.get(k) == Some(&s.0) {
        return Ok(index);
    }
    if k < 3 && corners[(k + 1) % 3] == s.0 {
        let next = index + 1;
        return Ok(if next as usize == fan.ring().len() { 0 } else { next });
    }
    Err(CutError::NotAtVertex { face: face.0, edge })
}
