//! One row for each op that a front holds, found by a hash of its id and scanned as plain arrays.

use lodestream_protocol::mesh::reserve_a_sixteenth;

use super::super::op_index::OpIndex;
use super::motion::{SumAt, Sums};

/// The op is wanted for its own sake.
pub(super) const WANTED: u8 = 1;
/// The op fills what the triangle limit leaves.
pub(super) const FILLS: u8 = 2;
/// The row is in the list of those that this update has touched.
pub(super) const TOUCHED: u8 = 4;
/// The op was a member before this update.
pub(super) const WAS_MEMBER: u8 = 8;

/// The row is in the list of those that will be looked at.
pub(super) const QUEUED: u8 = 64;

/// The next split of `s` is wanted, and the first split of `t`. Kept for splits alone: a spawn may have any number of children.
pub(super) const CHILD_IS_WANTED: [u8; 2] = [16, 32];

/// What keeps an op in the set.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct State {
    /// Members in the closure of the wanted ops that have it as a parent.
    pub(super) references: u16,
    pub(super) flags: u8,
    /// Cell of what the row was tested with, see [`Motion`](super::motion::Motion).
    pub(super) cell: u8,
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

/// When a row has to be looked at again: bounds of what is seen now, by sums of [`Motion`](super::motion::Motion).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Due {
    /// Less the cell's sum, the ops that are in sight but stay out for being small are at least that deep.
    pub(super) least_depth: f32,
    /// With the cell's sum, the op itself is at most that deep.
    pub(super) most_depth: f32,
    /// Pixels at depth 1 of the largest of those that stay out, at most.
    pub(super) small: Half,
    /// Pixels at depth 1 of the op itself, at least.
    pub(super) large: Half,
    /// Value at which what stays out for being out of sight may appear, of the sum that `appears_at` names.
    pub(super) appears: Half,
    pub(super) appears_at: SumAt,
    /// Value at which the op itself may go out over the plane next to it, which `turns_at` names,
    pub(super) leaves: Half,
    /// over any other,
    pub(super) leaves_else: Half,
    /// and at which it may begin to face away, of the sum that `turns_at` names.
    pub(super) turns: Half,
    pub(super) turns_at: TurnsAt,
}

/// What sizes are compared with when it is asked whether an answer may have changed: ops that stay out are no larger than the higher number, ops that
/// stay wanted are over the lower one.
#[derive(Clone, Copy, Debug)]
pub(super) struct Threshold {
    pub(super) low: f32,
    pub(super) high: f32,
}

/// A plane of the view and a bin of directions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TurnsAt {
    pub(super) plane: u8,
    pub(super) bin: u8,
}

impl Due {
    /// Never.
    pub(super) const NEVER: Self = Self {
        least_depth: 1.0,
        most_depth: 1.0,
        small: Half::ZERO,
        large: Half::INFINITY,
        appears: Half::INFINITY,
        appears_at: SumAt::ANY_INWARD,
        leaves: Half::INFINITY,
        leaves_else: Half::INFINITY,
        turns: Half::INFINITY,
        turns_at: TurnsAt { plane: 0, bin: 0 },
    };
    /// At the next update; what stays out may be of any size.
    pub(super) const NOW: Self = Self { small: Half::INFINITY, ..Self::NEVER };

    /// Whether that is now, at a threshold and in a cell. Depths count as at least `near`, which is rounded down.
    #[inline(always)]
    pub(super) fn is_now(&self, sums: &Sums, cell: u8, threshold: &Threshold, near: f32) -> bool {
        let least = (self.least_depth - sums.nearer(cell)).max(near);
        let most = (self.most_depth + sums.farther(cell)).max(near.next_up());
        // Products that are not numbers, of zero and infinity, are due. Without branches: rows are scanned by the ten thousand.
        let stays_out = least * threshold.high >= self.small.get();
        let stays_in = most * threshold.low < self.large.get();
        let stays_hidden = self.appears.get() > sums.at(cell, self.appears_at);
        let TurnsAt { plane, bin } = self.turns_at;
        let stays_inside = self.leaves.get() > sums.outward(cell, plane);
        let stays_inside_else = self.leaves_else.get() > sums.any_outward(cell);
        let stays_turned = self.turns.get() > sums.against(bin);
        !(stays_out & stays_in & stays_hidden & stays_inside & stays_inside_else & stays_turned)
    }

    /// Not less than the priority of any op that hangs on the row and stays out.
    #[inline]
    pub(super) fn most_priority(&self, sums: &Sums, cell: u8, near: f32) -> f32 {
        let small = self.small.get();
        if small == 0.0 {
            return 0.0;
        }
        // Rounded, and by one more for that of the product that was compared.
        let most = small / (self.least_depth - sums.nearer(cell)).max(near) * (1.0 + 4.0 * f32::EPSILON);
        if most.is_nan() { f32::INFINITY } else { most }
    }

    /// The sums begin at zero again.
    pub(super) fn rebase(&mut self, sums: &Sums, cell: u8) {
        self.least_depth = (self.least_depth - sums.nearer(cell)).next_down();
        self.most_depth = (self.most_depth + sums.farther(cell)).next_up();
        let TurnsAt { plane, bin } = self.turns_at;
        for (due, sum) in [
            (&mut self.appears, sums.at(cell, self.appears_at)),
            (&mut self.leaves, sums.outward(cell, plane)),
            (&mut self.leaves_else, sums.any_outward(cell)),
            (&mut self.turns, sums.against(bin)),
        ] {
            *due = Half::below((due.get() - sum).next_down());
        }
    }
}

/// A number in two bytes: the upper half of its float. The infinities are exact.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Half(u16);

impl Half {
    pub(super) const ZERO: Self = Self(0);
    pub(super) const INFINITY: Self = Self(0x7f80);
    /// Below all others.
    pub(super) const NEGATIVE: Self = Self(0xff80);

    /// The largest one not above a number; one far below what is not positive.
    #[inline]
    pub(super) fn below(number: f32) -> Self {
        if number > 0.0 { Self((number.to_bits() >> 16) as u16) } else { Self::NEGATIVE }
    }

    /// The least one not below a number that is not negative.
    #[inline]
    pub(super) fn above(number: f32) -> Self {
        Self(((number.to_bits() + 0xffff) >> 16) as u16)
    }

    #[inline]
    pub(super) fn get(self) -> f32 {
        f32::from_bits(u32::from(self.0) << 16)
    }
}

/// The rows, in no order: 32 bytes each, and 6 to 8 of the index.
#[derive(Debug, Default)]
pub(super) struct Rows {
    pub(super) ops: Vec<u32>,
    pub(super) dues: Vec<Due>,
    pub(super) states: Vec<State>,
    index: OpIndex,
}

impl Rows {
    pub(super) fn heap_bytes(&self) -> usize {
        (self.ops.capacity() + self.states.capacity()) * 4
            + self.index.heap_bytes()
            + self.dues.capacity() * size_of::<Due>()
    }

    /// Makes room for so many in all.
    pub(super) fn reserve(&mut self, len: usize) {
        reserve_a_sixteenth(&mut self.ops, len);
        reserve_a_sixteenth(&mut self.dues, len);
        reserve_a_sixteenth(&mut self.states, len);
        let ops = &self.ops;
        self.index.reserve(len, |row| ops[row as usize]);
    }

    /// Gives memory back that is far more than what the rows take: what a camera leaves may be most of what it saw.
    pub(super) fn give_back(&mut self) {
        let used = self.ops.len();
        if self.ops.capacity() > (4 * used).max(1024) {
            let room = 2 * used;
            self.ops.shrink_to(room);
            self.dues.shrink_to(room);
            self.states.shrink_to(room);
            let ops = &self.ops;
            self.index.shrink(room, |row| ops[row as usize]);
        }
    }

    #[inline]
    pub(super) fn find(&self, op: u32) -> Option<usize> {
        self.index.find(op, |row| self.ops[row as usize]).map(|row| row as usize)
    }

    #[inline]
    pub(super) fn state(&self, op: u32) -> State {
        self.find(op).map_or(State::default(), |row| self.states[row])
    }

    /// The row of an op, a new one if it has none.
    pub(super) fn ensure(&mut self, op: u32) -> usize {
        let (ops, new) = (&self.ops, self.ops.len());
        let row = self.index.find_or_insert(op, new as u32, |row| ops[row as usize]) as usize;
        if row == new {
            reserve_a_sixteenth(&mut self.ops, new + 1);
            reserve_a_sixteenth(&mut self.dues, new + 1);
            reserve_a_sixteenth(&mut self.states, new + 1);
            self.ops.push(op);
            self.dues.push(Due::NEVER);
            self.states.push(State::default());
        }
        row
    }

    /// Removes the row of an op; the last row takes its place.
    pub(super) fn remove(&mut self, op: u32) {
        let ops = &self.ops;
        let op_of = |row: u32| ops[row as usize];
        let Some(row) = self.index.remove(op, op_of) else { return };
        if row as usize + 1 < ops.len() {
            self.index.moved(ops[ops.len() - 1], row, op_of);
        }
        self.ops.swap_remove(row as usize);
        self.dues.swap_remove(row as usize);
        self.states.swap_remove(row as usize);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    #[test]
    fn halves_lie_beside_what_they_stand_for() {
        let mut rng = fastrand::Rng::with_seed(4);
        for number in (0..1000).map(|_| f32::from_bits(rng.u32(..f32::INFINITY.to_bits()))).chain([0.0, f32::MAX]) {
            let (below, above) = (Half::below(number).get(), Half::above(number).get());
            assert!(below <= number && number <= above, "{below} {number} {above}");
            let is_near = number - below <= number / 100.0 && above - number <= number / 100.0;
            assert!(is_near || number < 1e-30 || above == f32::INFINITY, "{below} {number} {above}");
        }
        assert_eq!(Half::above(f32::INFINITY), Half::INFINITY);
        assert_eq!(Half::below(f32::INFINITY), Half::INFINITY);
    }

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
        let before = rows.heap_bytes();
        assert!(rows.ops.capacity() > 1024, "so few are not given back");
        for op in rows.ops.clone().into_iter().skip(10) {
            rows.remove(op);
            twin.remove(&op);
            rows.give_back();
            if op % 64 == 0 {
                assert!(
                    twin.iter()
                        .all(|(&op, &count)| rows.find(op).is_some_and(|row| rows.states[row].references == count))
                );
            }
        }
        assert!(rows.ops.capacity() <= 1024 && rows.heap_bytes() < before, "{} of {before}", rows.heap_bytes());
        let found: BTreeMap<u32, u16> =
            rows.ops.iter().zip(&rows.states).map(|(&op, state)| (op, state.references)).collect();
        assert_eq!(found, twin);
        assert_eq!((rows.ops.len(), rows.dues.len(), rows.states.len()), (twin.len(), twin.len(), twin.len()));
    }
}
