//! From the cut edges of a record to spokes of the current fan.

use lodestream_protocol::ids::{FaceSlot, VertexSlot};
use lodestream_protocol::mesh::{Cut, Fan, Replica};

/// An edge of a live face: from corner `edge` to corner `edge + 1`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct FaceEdge {
    /// The face.
    pub face: FaceSlot,
    /// 0, 1 or 2.
    pub edge: u8,
}

/// The cut of `s`'s fan that opens the given edges, or `None` if they are not edges of the fan. O(valence).
///
/// The face on either side of a cut edge names it: if its edge leaves `s`, the face follows the spoke counter-clockwise,
/// else it precedes it.
pub fn resolve_cut(
    replica: &Replica,
    fan: &Fan,
    s: VertexSlot,
    left: Option<FaceEdge>,
    right: Option<FaceEdge>,
) -> Option<Cut> {
    let spoke = |at: FaceEdge| -> Option<u32> {
        let i = (0..fan.faces()).find(|&i| fan.face(i) == at.face)?;
        let corners = replica.corners().get(at.face.index())?;
        let edge = usize::from(at.edge);
        if *corners.get(edge)? == s.0 {
            return Some(i);
        }
        (corners[(edge + 1) % 3] == s.0).then_some((i + 1) % fan.ring().len() as u32)
    };
    let cut = match (left, right) {
        (Some(left), Some(right)) => Cut::Both { right: spoke(right)?, left: spoke(left)? },
        (Some(left), None) => Cut::Left { left: spoke(left)? },
        (None, Some(right)) => Cut::Right { right: spoke(right)? },
        (None, None) => return None,
    };
    fan.admits(cut).then_some(cut)
}
