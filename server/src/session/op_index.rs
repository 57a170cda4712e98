//! Finds where something is kept by the op that it belongs to. What is kept names its op itself, so the table holds places alone.

use lodestream_protocol::mesh::reserve_a_sixteenth;

use crate::pack::record::NO_OP;

const EMPTY: u32 = u32::MAX;

/// Open addressing, between two thirds and three quarters full: 5.3 to 6 bytes for each op. Whoever calls says which op a place belongs to.
///
/// An entry is a place below the low bits of its home, where it would lie in an empty table. So what belongs elsewhere is told apart without a
/// look at its op, and what is removed leaves no hole without one. The length of the table is a multiple of what the bits count to.
#[derive(Debug, Default)]
pub(super) struct OpIndex {
    entries: Vec<u32>,
    len: usize,
    /// Bits of an entry that are the place.
    bits: u32,
}

impl OpIndex {
    pub(super) fn heap_bytes(&self) -> usize {
        self.entries.capacity() * 4
    }

    /// Makes room for so many in all, as much as they would take one by one.
    pub(super) fn reserve(&mut self, len: usize, op_of: impl Fn(u32) -> u32) {
        let entries = 17 * len / 12;
        if entries > self.entries.len() {
            self.resize(entries, len as u32, &op_of);
        }
    }

    /// Keeps no more room than for so many, or for what it holds.
    pub(super) fn shrink(&mut self, len: usize, op_of: impl Fn(u32) -> u32) {
        let entries = 17 * len.max(self.len) / 12;
        if entries < self.entries.len() {
            self.resize(entries, 0, &op_of);
        }
    }

    #[inline]
    fn home(&self, op: u32) -> usize {
        // Ids come from the pack, so nobody outside chooses them.
        let hash = u64::from(op).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
        ((hash * self.entries.len() as u64) >> 32) as usize
    }

    #[inline]
    fn after(&self, at: usize) -> usize {
        if at + 1 == self.entries.len() { 0 } else { at + 1 }
    }

    /// How far it is from one entry to another, around the table.
    #[inline]
    fn way(&self, from: usize, to: usize) -> usize {
        if to >= from { to - from } else { to + self.entries.len() - from }
    }

    /// The part of an entry that says where its home is.
    #[inline]
    fn tag(&self, home: usize) -> u32 {
        (home as u32) << self.bits
    }

    #[inline]
    fn place(&self, entry: u32) -> u32 {
        entry & self.largest_place()
    }

    #[inline]
    fn largest_place(&self) -> u32 {
        (1 << self.bits) - 1
    }

    /// How far an entry may lie from its home, and one more.
    #[inline]
    fn reach(&self) -> usize {
        1 << (u32::BITS - self.bits)
    }

    /// Where the entry of an op is, or would be.
    #[inline]
    fn probe(&self, op: u32, op_of: &impl Fn(u32) -> u32) -> usize {
        let mut at = self.home(op);
        let tag = self.tag(at);
        loop {
            let entry = self.entries[at];
            let is_at_home = (entry ^ tag) >> self.bits == 0;
            if entry == EMPTY || is_at_home && op_of(self.place(entry)) == op {
                return at;
            }
            at = self.after(at);
        }
    }

    #[inline]
    pub(super) fn find(&self, op: u32, op_of: impl Fn(u32) -> u32) -> Option<u32> {
        if self.entries.is_empty() {
            return None;
        }
        Some(self.entries[self.probe(op, &op_of)]).filter(|&entry| entry != EMPTY).map(|entry| self.place(entry))
    }

    /// The place of an op, which is `new` if it has none.
    #[inline]
    pub(super) fn find_or_insert(&mut self, op: u32, new: u32, op_of: impl Fn(u32) -> u32) -> u32 {
        debug_assert_ne!(op, NO_OP);
        if 4 * (self.len + 1) > 3 * self.entries.len() || new >= self.largest_place() {
            self.grow(new, &op_of);
        }
        loop {
            let at = self.probe(op, &op_of);
            if self.entries[at] != EMPTY {
                return self.place(self.entries[at]);
            }
            let home = self.home(op);
            if self.way(home, at) < self.reach() {
                self.entries[at] = self.tag(home) | new;
                self.len += 1;
                return new;
            }
            self.grow(new, &op_of);
        }
    }

    /// What belongs to an op is at another place now, before those of others; `op_of` still knows the place before.
    pub(super) fn moved(&mut self, op: u32, to: u32, op_of: impl Fn(u32) -> u32) {
        let at = self.probe(op, &op_of);
        debug_assert!(to < self.place(self.entries[at]));
        self.entries[at] = self.entries[at] & !self.largest_place() | to;
    }

    /// Forgets an op and returns its place.
    pub(super) fn remove(&mut self, op: u32, op_of: impl Fn(u32) -> u32) -> Option<u32> {
        if self.entries.is_empty() {
            return None;
        }
        let mut hole = self.probe(op, &op_of);
        let removed = std::mem::replace(&mut self.entries[hole], EMPTY);
        if removed == EMPTY {
            return None;
        }
        self.len -= 1;
        // Entries that the hole would hide move back.
        let mut at = hole;
        loop {
            at = self.after(at);
            let entry = self.entries[at];
            if entry == EMPTY {
                return Some(self.place(removed));
            }
            // Whether its home lies, around the table, outside of what follows the hole.
            let from_home = at.wrapping_sub((entry >> self.bits) as usize) & (self.reach() - 1);
            if from_home >= self.way(hole, at) {
                self.entries[hole] = entry;
                self.entries[at] = EMPTY;
                hole = at;
            }
        }
    }

    #[cold]
    fn grow(&mut self, largest: u32, op_of: &impl Fn(u32) -> u32) {
        // It is full, entries are too far from home, or their places have too few bits.
        let len = if largest < self.largest_place() {
            self.entries.len() + self.entries.len() / 8
        } else {
            self.entries.len()
        };
        self.resize(len, largest, op_of);
    }

    /// Makes a table of so many entries or some more, for places up to `largest`.
    fn resize(&mut self, len: usize, largest: u32, op_of: &impl Fn(u32) -> u32) {
        let before = std::mem::take(self);
        let places = || before.entries.iter().filter(|&&entry| entry != EMPTY).map(|&entry| before.place(entry));
        let largest = places().fold(largest, u32::max);
        let mut len = len.max(FEWEST);
        loop {
            // Tables with room for it let entries lie far from home.
            let reach_bits = if len < 1 << 10 {
                6
            } else if len < 1 << 14 {
                8
            } else {
                10
            };
            let place_bits = u32::BITS - (largest + 1).leading_zeros();
            self.bits = (u32::BITS - reach_bits).max(place_bits);
            let len_now = len.next_multiple_of(self.reach());
            self.entries = vec![EMPTY; len_now];
            let fits = places().all(|place| {
                let home = self.home(op_of(place));
                let mut at = home;
                while self.entries[at] != EMPTY {
                    at = self.after(at);
                }
                self.entries[at] = self.tag(home) | place;
                self.way(home, at) < self.reach()
            });
            if fits {
                break;
            }
            len = len_now + len_now / 8;
        }
        self.len = before.len;
    }
}

/// Entries of the smallest table.
const FEWEST: usize = 64;

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
            reserve_a_sixteenth(&mut self.op_at, at + 1);
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
        assert!(slots.index.heap_bytes() < 3000 * 7 + 400, "{}", slots.index.heap_bytes());
    }
}
