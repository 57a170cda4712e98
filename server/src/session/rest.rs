//! What a session keeps while its client looks at a settled view: which op is in which slot, the op cache as op ids, the
//! coder's contexts. The mirror is rebuilt from it when the client moves again, op by op into the same slots, in any order
//! in which parents come first, which gives the same mesh (invariant 1) and therefore the same bits after it.
//!
//! The cuts that the cache guesses by (left and right slots at the time of the collapse) follow from nothing that is kept:
//! the first batch after a rest makes both ends forget them.

use lodestream_protocol::cache::{CacheHolder, SplitCache};
use lodestream_protocol::ids::VertexSlot;
use lodestream_protocol::mesh::{Fan, NewVertex};
use lodestream_protocol::op::SavedContexts;

use super::mirror::{Mirror, MirrorError};
use super::op_index::OpSlots;
use super::select::OpMap;
use crate::pack::place::Place;
use crate::pack::record::NO_OP;
use crate::pack::{PackedModel, SplitFields};

/// A mirror that rests: 4 bytes and a bit for each slot, 4 bytes for each cached op, some kilobytes.
#[derive(Debug)]
pub(super) struct Resting {
    /// Which slots ops have made, a bit each.
    is_made: Box<[u64]>,
    /// The op of each of those, ascending by slot; a spawn is there once for each slot that it reserves.
    ops: Box<[u32]>,
    /// The oldest first.
    cached: Box<[u32]>,
    contexts: SavedContexts,
    digest: u64,
    cache_entries: u32,
}

impl Resting {
    /// What to keep of `mirror`.
    pub(super) fn new(mirror: &Mirror) -> Self {
        let replica = mirror.replica();
        let mut made: Vec<(u32, u32)> = Vec::new();
        for (op, address) in mirror.applied() {
            match replica.spawn_slots(VertexSlot(address)) {
                Some(slots) => made.extend(slots.iter().map(|&slot| (slot, op))),
                None => made.push((address, op)),
            }
        }
        made.sort_unstable();
        let words = made.last().map_or(0, |last| last.0 as usize / 64 + 1);
        let mut is_made = vec![0u64; words];
        made.iter().for_each(|&(slot, _)| is_made[slot as usize / 64] |= 1 << (slot % 64));
        let cache = mirror.state.cache();
        Self {
            is_made: is_made.into(),
            ops: made.iter().map(|&(_, op)| op).collect(),
            cached: cache.labels().collect(),
            contexts: mirror.state.save_contexts(),
            digest: replica.digest(),
            cache_entries: cache.capacity(),
        }
    }

    pub(super) fn heap_bytes(&self) -> usize {
        self.is_made.len() * 8 + (self.ops.len() + self.cached.len()) * 4 + self.contexts.heap_bytes()
    }

    /// Slots and their ops, ascending by slot.
    fn made(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        let slots = (0..).zip(&self.is_made).flat_map(|(word, &bits)| {
            let next = |bits: &u64| Some(bits & (bits - 1)).filter(|&rest| rest != 0);
            let of = move |bits: u64| word * 64 + bits.trailing_zeros();
            std::iter::successors(Some(bits).filter(|&bits| bits != 0), next).map(of)
        });
        slots.zip(self.ops.iter().copied())
    }

    /// Ops and the slots they are addressed by.
    pub(super) fn applied(&self) -> OpSlots {
        let mut slots = OpSlots::with_capacity(64 * self.is_made.len(), self.ops.len());
        for (slot, op) in self.made() {
            // A spawn is addressed by its first slot.
            if slots.slot(op).is_none() {
                slots.insert(op, slot);
            }
        }
        slots
    }

    /// The mirror as it was, but for cuts that its cache knew. O(ops x valence).
    pub(super) fn wake(&self, model: &PackedModel) -> Result<Mirror, MirrorError> {
        let mut mirror = Mirror::new(model, self.cache_entries)?;
        let slots = self.applied();
        let misfit = |op, reason: &str| MirrorError::Op { op, reason: reason.into() };
        self.insert_spawns(model, &mut mirror)?;
        let mut fan = Fan::default();
        let mut pending: Vec<(u32, VertexSlot)> = Vec::new();
        let find = |op| slots.slot(op);
        let first_split = model.spawn_count();
        for (slot, op) in self.made().filter(|&(_, op)| op >= first_split) {
            pending.push((op, VertexSlot(slot)));
            while let Some(&(op, slot)) = pending.last() {
                let replica = mirror.state.replica_mut();
                if replica.split_from(slot).is_some() {
                    pending.pop();
                    continue;
                }
                let fields = model.split(op)?;
                let is_there = |op, slot| op < first_split || replica.split_from(VertexSlot(slot)).is_some();
                let find_there = |op| find(op).filter(|&slot| is_there(op, slot));
                let Some(place) = Place::find(model, replica, find_there, &fields)? else {
                    let waiting = pending.len();
                    for parent in fields.named_parents() {
                        match find(parent) {
                            Some(slot) if is_there(parent, slot) => {}
                            Some(slot) => pending.push((parent, VertexSlot(slot))),
                            None => return Err(misfit(op, "a parent is not applied")),
                        }
                    }
                    if pending.len() == waiting {
                        return Err(misfit(op, "a parent is not applied"));
                    }
                    continue;
                };
                replica.fan(place.s, &mut fan).map_err(|error| misfit(op, &error.to_string()))?;
                let cut = place.cut(replica, &fan).map_err(|error| misfit(op, &error.to_string()))?;
                replica
                    .split_into(place.s, slot, &fan, cut, &inserted(&fields))
                    .map_err(|error| misfit(op, &error.to_string()))?;
                pending.pop();
            }
        }
        if mirror.replica().digest() != self.digest {
            return Err(misfit(NO_OP, "the mesh has changed while the session rested"));
        }
        let cache = self.cache(model, &mirror, &slots)?;
        mirror.state.resume(&self.contexts, cache);
        mirror.take_ops(slots);
        Ok(mirror)
    }

    fn insert_spawns(&self, model: &PackedModel, mirror: &mut Mirror) -> Result<(), MirrorError> {
        let mut slots: Vec<(u32, u32)> =
            self.made().filter(|&(_, op)| op < model.spawn_count()).map(|(slot, op)| (op, slot)).collect();
        slots.sort_unstable();
        for spawn in slots.chunk_by(|a, b| a.0 == b.0) {
            let (op, slots) = (spawn[0].0, spawn.iter().map(|&(_, slot)| slot).collect::<Vec<_>>());
            let patch = model.spawn_patch(op)?;
            let replica = mirror.state.replica_mut();
            replica
                .spawn_into(op, &patch, &slots)
                .map_err(|error| MirrorError::Op { op, reason: error.to_string() })?;
        }
        Ok(())
    }

    /// The cache: each split hangs from the vertex that it splits, or from the cached split that inserts that vertex.
    fn cache(&self, model: &PackedModel, mirror: &Mirror, slots: &OpSlots) -> Result<SplitCache, MirrorError> {
        let misfit = |op| MirrorError::Op { op, reason: "its vertex is neither there nor cached".into() };
        let places: OpMap<u32> = (0..).zip(&self.cached).map(|(place, &op)| (op, place)).collect();
        let mut splits = vec![(NO_OP, NewVertex::default(), CacheHolder::Entry(0)); self.cached.len()];
        let replica = mirror.replica();
        // What was there before an op on the same vertex collapsed after it: from the newest to the oldest.
        for (place, &op) in self.cached.iter().enumerate().rev() {
            let fields = model.split(op)?;
            let before = fields.tree_parent;
            let holder = match places.get(&before) {
                Some(&newer) if before != NO_OP && newer as usize > place => match fields.s {
                    1 => CacheHolder::Entry(newer),
                    _ => splits[newer as usize].2,
                },
                _ => {
                    let found = Place::vertex(model, replica, |op| slots.slot(op), &fields)?;
                    CacheHolder::Slot(VertexSlot(found.ok_or_else(|| misfit(op))?))
                }
            };
            splits[place] = (op, inserted(&fields), holder);
        }
        SplitCache::rebuilt(self.cache_entries, &splits).ok_or_else(|| misfit(NO_OP))
    }
}

fn inserted(fields: &SplitFields) -> NewVertex {
    NewVertex {
        position: fields.position,
        color: fields.color,
        s_move: fields.s_move,
        s_color_move: fields.s_color_move,
    }
}
