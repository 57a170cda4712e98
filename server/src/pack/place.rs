//! Where a split of the pack takes place in a mesh: from the ids of its record to slots, faces and spokes.

use lodestream_protocol::ids::{FaceSlot, VertexSlot};
use lodestream_protocol::mesh::{Cut, Fan, Replica};

use super::cut::{CutError, resolve_cut};
use super::record::{CutRef, NO_OP};
use super::{PackError, PackedModel, SplitFields};

/// A split's vertex and cut edges as they lie in a mesh now.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Place {
    /// The vertex to split.
    pub s: VertexSlot,
    /// Face slot and edge that `f_l` opens, if it is inserted.
    pub left: Option<(FaceSlot, u8)>,
    /// Face slot and edge that `f_r` opens, if it is inserted.
    pub right: Option<(FaceSlot, u8)>,
}

impl Place {
    /// Finds a split in a mesh where all its parents are applied; `slot_of` gives the address of an applied op. `Ok(None)` if a
    /// parent is missing.
    ///
    /// # Errors
    /// [`PackError`] if the record names what does not exist.
    pub fn find(
        model: &PackedModel,
        replica: &Replica,
        slot_of: impl Fn(u32) -> Option<u32>,
        split: &SplitFields,
    ) -> Result<Option<Self>, PackError> {
        let Some(s) = Self::vertex(model, replica, &slot_of, split)? else { return Ok(None) };
        let mut edges = [None; 2];
        for (edge, cut) in edges.iter_mut().zip([split.left, split.right]) {
            if cut != CutRef::None {
                *edge = face_edge(model, replica, &slot_of, cut)?;
                if edge.is_none() {
                    return Ok(None);
                }
            }
        }
        Ok(Some(Self { s: VertexSlot(s), left: edges[0], right: edges[1] }))
    }

    /// Slot of the vertex that is split, under the same conditions.
    ///
    /// # Errors
    /// As [`find`](Self::find).
    pub fn vertex(
        model: &PackedModel,
        replica: &Replica,
        slot_of: impl Fn(u32) -> Option<u32>,
        split: &SplitFields,
    ) -> Result<Option<u32>, PackError> {
        if split.tree_parent == NO_OP || split.tree_parent < model.spawn_count() {
            return Ok(match model.root_vertex(split.s)? {
                (None, vertex) => Some(vertex),
                (Some(spawn), vertex) => slot_of(spawn)
                    .and_then(|address| replica.spawn_slots(VertexSlot(address)))
                    .and_then(|slots| slots.get(vertex as usize).copied()),
            });
        }
        let Some(t) = slot_of(split.tree_parent) else { return Ok(None) };
        Ok(if split.s == 1 { Some(t) } else { replica.split_from(VertexSlot(t)).map(|s| s.0) })
    }

    /// The cut of `s`'s fan that opens the edges. O(valence).
    ///
    /// # Errors
    /// [`CutError`] if they are not edges of the fan.
    pub fn cut(&self, replica: &Replica, fan: &Fan) -> Result<Cut, CutError> {
        resolve_cut(replica, fan, self.s, self.left, self.right)
    }
}

/// Where a cut edge is now.
fn face_edge(
    model: &PackedModel,
    replica: &Replica,
    slot_of: &impl Fn(u32) -> Option<u32>,
    cut: CutRef,
) -> Result<Option<(FaceSlot, u8)>, PackError> {
    Ok(match cut {
        CutRef::None => None,
        CutRef::Split { op, side, edge } => slot_of(op).map(|slot| (FaceSlot(2 * slot + u32::from(side)), edge)),
        CutRef::Root { face, edge } => match model.root_face(face)? {
            (None, face) => Some((FaceSlot(face), edge)),
            (Some(spawn), face) => slot_of(spawn)
                .and_then(|address| replica.spawn_slots(VertexSlot(address)))
                .and_then(|slots| slots.get((face / 2) as usize).copied())
                .map(|slot| (FaceSlot(2 * slot + face % 2), edge)),
        },
    })
}
