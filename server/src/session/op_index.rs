//! Finds where something is kept by the op that it belongs to. What is kept names its op itself, so the table holds places alone.

use lodestream_protocol::mesh::reserve_an_eighth;

use crate::pack::record::NO_OP;

const EMPTY: u32 = u32::MAX;

/// Open addressing, between half and two thirds full: 6 to 8 bytes for each op. Whoever calls says which op a place belongs to.
#[derive(Debug, Default)]
pub(super) struct OpIndex {
    places: Vec<u32>,
    len: usize,
}

impl OpIndex {
    pub(super) fn heap_bytes(&self) -> usize {
        self.places.capacity() * 4
    }

    /// Makes room for so many in all, as much as they would take one by one.
    pub(super) fn reserve(&mut self, len: usize, op_of: impl Fn(u32) -> u32) {
        let places = 7 * len / 4;
        if places > self.places.len() {
            self.resize(places, &op_of);
        }
    }

    #[inline]
    fn home(&self, op: u32) -> usize {
        // Ids come from the pack, so nobody outside chooses them.
        let hash = u64::from(op).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
        ((hash * self.places.len() as u64) >> 32) as usize
    }

    #[inline]
    fn after(&self, at: usize) -> usize {
        if at + 1 == self.places.len() { 0 } else { at + 1 }
    }

    /// Where the place of an op is, or would be.
    #[inline]
    fn probe(&self, op: u32, op_of: &impl Fn(u32) -> u32) -> usize {
        let mut at = self.home(op);
        while self.places[at] != EMPTY && op_of(self.places[at]) != op {
            at = self.after(at);
        }
        at
    }

    #[inline]
    pub(super) fn find(&self, op: u32, op_of: impl Fn(u32) -> u32) -> Option<u32> {
        if self.places.is_empty() {
            return None;
        }
        Some(self.places[self.probe(op, &op_of)]).filter(|&place| place != EMPTY)
    }

    /// The place of an op, which is `new` if it has none.
    #[inline]
    pub(super) fn find_or_insert(&mut self, op: u32, new: u32, op_of: impl Fn(u32) -> u32) -> u32 {
        debug_assert_ne!(op, NO_OP);
        if 3 * (self.len + 1) > 2 * self.places.len() {
            self.grow(&op_of);
        }
        let at = self.probe(op, &op_of);
        if self.places[at] == EMPTY {
            self.places[at] = new;
            self.len += 1;
        }
        self.places[at]
    }

    /// What belongs to an op is at another place now; `op_of` still knows the place before.
    pub(super) fn moved(&mut self, op: u32, to: u32, op_of: impl Fn(u32) -> u32) {
        let at = self.probe(op, &op_of);
        self.places[at] = to;
    }

    /// Forgets an op and returns its place.
    pub(super) fn remove(&mut self, op: u32, op_of: impl Fn(u32) -> u32) -> Option<u32> {
        if self.places.is_empty() {
            return None;
        }
        let mut hole = self.probe(op, &op_of);
        let removed = std::mem::replace(&mut self.places[hole], EMPTY);
        if removed == EMPTY {
            return None;
        }
        self.len -= 1;
        // Entries that the hole would hide move back.
        let len = self.places.len();
        let way = |from: usize, to: usize| if to >= from { to - from } else { to + len - from };
        let mut at = hole;
        loop {
            at = self.after(at);
            let place = self.places[at];
            if place == EMPTY {
                return Some(removed);
            }
            // Whether its home lies, around the table, outside of what follows the hole.
            if way(self.home(op_of(place)), at) >= way(hole, at) {
                self.places[hole] = place;
                self.places[at] = EMPTY;
                hole = at;
            }
        }
    }

    fn grow(&mut self, op_of: &impl Fn(u32) -> u32) {
        self.resize(self.places.len() + self.places.len() / 4, op_of);
    }

    fn resize(&mut self, len: usize, op_of: &impl Fn(u32) -> u32) {
        let before = std::mem::take(&mut self.places);
        self.places = vec![EMPTY; len.max(64)];
        for place in before.into_iter().filter(|&place| place != EMPTY) {
            let at = self.probe(op_of(place), op_of);
            self.places[at] = place;
        }
    }
}

/// The slots by which applied ops are addressed, both ways.
#[derive(Debug, Default)]
pub(super) struct OpSlots {
    /// Op whose address a slot is, or [`NO_OP`].
    op_at: Vec<u32>,
    index: OpIndex,
}

impl OpSlots {
    pub(super) fn heap_bytes(&self) -> usize {
        self.op_at.capacity() * 4 + self.index.heap_bytes()
    }

    /// For so many ops at slots below that.
    pub(super) fn with_capacity(slots: usize, ops: usize) -> Self {
        let mut index = OpIndex::default();
        index.reserve(ops, |_| NO_OP);
        Self { op_at: Vec::with_capacity(slots), index }
    }

    /// How many ops there are.
    pub(super) fn len(&self) -> usize {
        self.index.len
    }

    /// Slot that an applied op is addressed by.
    #[inline]
    pub(super) fn slot(&self, op: u32) -> Option<u32> {
        self.index.find(op, |slot| self.op_at[slot as usize])
    }

    /// Op that is addressed by a slot.
    #[inline]
    pub(super) fn op_at(&self, slot: u32) -> Option<u32> {
        self.op_at.get(slot as usize).copied().filter(|&op| op != NO_OP)
    }

    /// Ops and their slots, ascending by slot.
    pub(super) fn iter(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        self.op_at.iter().copied().zip(0..).filter(|&(op, _)| op != NO_OP)
    }

    /// An op, not applied before, is addressed by a slot.
    pub(super) fn insert(&mut self, op: u32, slot: u32) {
        let at = slot as usize;
        if self.op_at.len() <= at {
            reserve_an_eighth(&mut self.op_at, at + 1);
            self.op_at.resize(at + 1, NO_OP);
        }
        self.op_at[at] = op;
        let op_at = &self.op_at;
        let found = self.index.find_or_insert(op, slot, |slot| op_at[slot as usize]);
        debug_assert_eq!(found, slot, "op {op} is applied already");
    }

    /// The op that a slot addresses is not applied any more.
    pub(super) fn take(&mut self, slot: u32) -> u32 {
        let op = self.op_at[slot as usize];
        let op_at = &self.op_at;
        self.index.remove(op, |slot| op_at[slot as usize]);
        self.op_at[slot as usize] = NO_OP;
        op
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::collections::btree_map::Entry;

    use super::*;

    #[test]
    fn slots_are_found_like_those_of_a_map() {
        let mut rng = fastrand::Rng::with_seed(3);
        let (mut slots, mut twin) = (OpSlots::default(), BTreeMap::new());
        let mut free: Vec<u32> = (0..3000).collect();
        rng.shuffle(&mut free);
        for step in 0..60_000u32 {
            // Few ops, so that they collide and come again.
            let op = rng.u32(..3000) * 256;
            if rng.u8(..) < if step < 30_000 { 160 } else { 96 } {
                if let Entry::Vacant(vacant) = twin.entry(op) {
                    let slot = free.pop().unwrap();
                    slots.insert(op, slot);
                    vacant.insert(slot);
                }
            } else if let Some(slot) = twin.remove(&op) {
                assert_eq!(slots.take(slot), op);
                free.push(slot);
            }
            let other = rng.u32(..3000) * 256;
            assert_eq!(slots.slot(other), twin.get(&other).copied());
        }
        assert_eq!(slots.iter().collect::<BTreeMap<_, _>>(), twin);
        assert!(slots.index.heap_bytes() < 3000 * 8 + 400, "{}", slots.index.heap_bytes());
    }
}
