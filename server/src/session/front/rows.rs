//! One row for each op that a front holds, found by a hash of its id and scanned as plain arrays.

use crate::pack::record::NO_OP;

/// The op is wanted for its own sake.
pub(super) const WANTED: u8 = 1;
/// The op fills what the triangle limit leaves.
pub(super) const FILLS: u8 = 2;
/// The row is in the list of those that this update has touched.
pub(super) const TOUCHED: u8 = 4;
/// The op was a member before this update.
pub(super) const WAS_MEMBER: u8 = 8;

/// What keeps an op in the set.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct State {
    /// Members in the closure of the wanted ops that have it as a parent.
    pub(super) references: u16,
    pub(super) flags: u8,
    /// Band of the distances of what the row was tested with, see [`Motion`](super::motion::Motion).
    pub(super) band: u8,
}

impl State {
    /// Whether it belongs to the closure of the wanted ops.
    #[inline]
    pub(super) fn is_closed_in(self) -> bool {
        self.references > 0 || self.flags & WANTED != 0
    }

    #[inline]
    pub(super) fn is_member(self) -> bool {
        self.references > 0 || self.flags & (WANTED | FILLS) != 0
    }
}

/// When a row has to be looked at again.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Due {
    /// Motion, see [`Motion`](super::motion::Motion).
    pub(super) motion: f32,
    /// When the threshold falls below this.
    pub(super) under: f32,
    /// When it rises above this.
    pub(super) over: f32,
}

impl Due {
    /// Never.
    pub(super) const NEVER: Self = Self { motion: f32::INFINITY, under: f32::NEG_INFINITY, over: f32::INFINITY };
    /// At the next update.
    pub(super) const NOW: Self = Self { motion: f32::NEG_INFINITY, under: f32::INFINITY, over: f32::NEG_INFINITY };
}

const EMPTY: u32 = u32::MAX;

/// The rows, in no order: 20 bytes each, and 4 to 12 of the index (open addressing, at most two thirds full).
#[derive(Debug, Default)]
pub(super) struct Rows {
    pub(super) ops: Vec<u32>,
    pub(super) dues: Vec<Due>,
    pub(super) states: Vec<State>,
    index: Vec<u32>,
}

impl Rows {
    pub(super) fn heap_bytes(&self) -> usize {
        (self.ops.capacity() + self.states.capacity() + self.index.capacity()) * 4 + self.dues.capacity() * 12
    }

    #[inline]
    fn home(&self, op: u32) -> usize {
        // Ids come from the pack, so nobody outside chooses them.
        let hash = u64::from(op).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        (hash >> (64 - self.index.len().trailing_zeros())) as usize
    }

    #[inline]
    fn probe(&self, op: u32) -> usize {
        let mask = self.index.len() - 1;
        let mut at = self.home(op);
        while self.index[at] != EMPTY && self.ops[self.index[at] as usize] != op {
            at = (at + 1) & mask;
        }
        at
    }

    #[inline]
    pub(super) fn find(&self, op: u32) -> Option<usize> {
        if self.index.is_empty() {
            return None;
        }
        let row = self.index[self.probe(op)];
        (row != EMPTY).then_some(row as usize)
    }

    #[inline]
    pub(super) fn state(&self, op: u32) -> State {
        self.find(op).map_or(State::default(), |row| self.states[row])
    }

    /// The row of an op, a new one if it has none.
    pub(super) fn ensure(&mut self, op: u32) -> usize {
        debug_assert_ne!(op, NO_OP);
        if 3 * (self.ops.len() + 1) > 2 * self.index.len() {
            self.grow();
        }
        let at = self.probe(op);
        if self.index[at] != EMPTY {
            return self.index[at] as usize;
        }
        let row = self.ops.len();
        self.index[at] = row as u32;
        self.ops.push(op);
        self.dues.push(Due::NEVER);
        self.states.push(State::default());
        row
    }

    fn grow(&mut self) {
        let capacity = (2 * self.index.len()).max(64);
        self.index = vec![EMPTY; capacity];
        for row in 0..self.ops.len() {
            let at = self.probe(self.ops[row]);
            self.index[at] = row as u32;
        }
    }

    /// Removes the row of an op; the last row takes its place.
    pub(super) fn remove(&mut self, op: u32) {
        let hole = self.probe(op);
        let row = self.index[hole];
        if row == EMPTY {
            return;
        }
        let last = self.ops.len() - 1;
        let at_last = self.probe(self.ops[last]);
        self.index[at_last] = row;
        self.index[hole] = EMPTY;
        self.ops.swap_remove(row as usize);
        self.dues.swap_remove(row as usize);
        self.states.swap_remove(row as usize);
        self.close(hole);
    }

    /// Moves entries back that a hole would hide.
    fn close(&mut self, mut hole: usize) {
        let mask = self.index.len() - 1;
        let mut at = hole;
        loop {
            at = (at + 1) & mask;
            let row = self.index[at];
            if row == EMPTY {
                return;
            }
            let home = self.home(self.ops[row as usize]);
            // Whether `home` lies cyclically outside (hole, at].
            if (at.wrapping_sub(home) & mask) >= (at.wrapping_sub(hole) & mask) {
                self.index[hole] = row;
                self.index[at] = EMPTY;
                hole = at;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    #[test]
    fn rows_come_and_go_like_those_of_a_map() {
        let mut rng = fastrand::Rng::with_seed(3);
        let (mut rows, mut twin) = (Rows::default(), BTreeMap::new());
        for step in 0..60_000u32 {
            // Few ids, so that they collide and come again.
            let op = rng.u32(..3000) * 256;
            if rng.u8(..) < if step < 30_000 { 160 } else { 96 } {
                let row = rows.ensure(op);
                rows.states[row].references = step as u16;
                twin.insert(op, step as u16);
            } else {
                rows.remove(op);
                twin.remove(&op);
            }
            let other = rng.u32(..3000) * 256;
            assert_eq!(rows.find(other).map(|row| rows.states[row].references), twin.get(&other).copied());
        }
        let found: BTreeMap<u32, u16> =
            rows.ops.iter().zip(&rows.states).map(|(&op, state)| (op, state.references)).collect();
        assert_eq!(found, twin);
        assert_eq!((rows.ops.len(), rows.dues.len(), rows.states.len()), (twin.len(), twin.len(), twin.len()));
    }
}
