//! The mirrored operation cache (Southern, Blake and Marais 2001, section 5.2, "Client Cache"): what collapsed recently,
//! kept alike at both ends, so that splitting again costs an address and a flag.
//!
//! Repeated splits of a vertex are totally ordered, so the only split of `s` that can follow a collapse onto `s` is the one
//! that was undone: each vertex has a stack of cached splits, and "split `s`" names its top. Splits cached on a vertex that
//! collapses itself are nested in that vertex's entry and come back with it.

use crate::ids::VertexSlot;
use crate::mesh::{NewVertex, SplitUndo, reserve_a_sixteenth};

const NONE: u32 = u32::MAX;
/// Tag of [`Entry::holder`]: the stack hangs from a slot instead of from another entry.
const AT_SLOT: u32 = 1 << 31;

/// A cached split.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct CachedSplit {
    /// What the split inserts.
    pub vertex: NewVertex,
    /// Left slot when it collapsed, [`VertexSlot::NONE`] without `f_l`.
    pub left: VertexSlot,
    /// Right slot when it collapsed, [`VertexSlot::NONE`] without `f_r`.
    pub right: VertexSlot,
    /// Whether `left` and `right` may be used to guess the cut.
    pub cut_known: bool,
}

/// What a cached split hangs from, for [`SplitCache::rebuilt`].
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum CacheHolder {
    /// The vertex in this slot.
    Slot(VertexSlot),
    /// The split with this place in the list, whose vertex it splits.
    Entry(u32),
}

/// 48 bytes: what splits displace is apart, see [`SplitCache::moves`].
#[derive(Clone, Debug, PartialEq, Eq)]
struct Entry {
    position: [i32; 3],
    color: [u8; 3],
    /// [`CUT_KNOWN`] and [`NESTED_TOP`].
    flags: u8,
    left: VertexSlot,
    right: VertexSlot,
    /// What the owner calls it, see [`SplitCache::label_newest`].
    label: u32,
    /// Next entry below in the same stack.
    below: u32,
    /// What points at this entry: the entry above, or (for a top) `AT_SLOT | slot` or the entry it is nested in.
    holder: u32,
    /// Top of the stack of the inserted vertex's own cached splits.
    nested: u32,
    /// Neighbours in order of pushing.
    older: u32,
    newer: u32,
}

/// Whether `left` and `right` may be used to guess the cut.
const CUT_KNOWN: u8 = 1;
/// Whether the entry is the top of a nested stack (then `holder` is the enclosing entry).
const NESTED_TOP: u8 = 2;

impl Entry {
    fn set(&mut self, flag: u8, is_set: bool) {
        self.flags = if is_set { self.flags | flag } else { self.flags & !flag };
    }
}

/// What a split does to the vertex that it splits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Move {
    s_move: [i32; 3],
    s_color_move: [u8; 3],
}

/// Bounded in entries; the oldest entry goes first. Both ends run this code on the same collapses and splits.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SplitCache {
    capacity: u32,
    len: u32,
    entries: Vec<Entry>,
    /// Of entries, as long as needed: empty for placements that keep `s`.
    moves: Vec<Move>,
    free: Vec<u32>,
    /// Top of each slot's stack.
    tops: Vec<u32>,
    oldest: u32,
    newest: u32,
}

impl SplitCache {
    /// A cache of at most `capacity` entries, nested ones counted.
    pub fn new(capacity: u32) -> Self {
        let (entries, moves) = (Vec::new(), Vec::new());
        Self { capacity, len: 0, entries, moves, free: Vec::new(), tops: Vec::new(), oldest: NONE, newest: NONE }
    }

    /// Entries held.
    pub fn len(&self) -> u32 {
        self.len
    }

    /// Whether nothing is cached.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Most entries held.
    pub fn capacity(&self) -> u32 {
        self.capacity
    }

    /// The split that `slot` would undo next, if it is cached.
    pub fn top(&self, slot: VertexSlot) -> Option<CachedSplit> {
        match self.tops.get(slot.index()) {
            None | Some(&NONE) => None,
            Some(&top) => Some(self.split_of(top)),
        }
    }

    fn split_of(&self, index: u32) -> CachedSplit {
        let Entry { position, color, flags, left, right, .. } = self.entries[index as usize];
        let Move { s_move, s_color_move } = self.moves.get(index as usize).copied().unwrap_or_default();
        let vertex = NewVertex { position, color, s_move, s_color_move };
        CachedSplit { vertex, left, right, cut_known: flags & CUT_KNOWN != 0 }
    }

    /// Keeps what the split of an entry displaces.
    fn put_move(&mut self, index: u32, vertex: &NewVertex) {
        let moved = Move { s_move: vertex.s_move, s_color_move: vertex.s_color_move };
        let index = index as usize;
        if moved != Move::default() && self.moves.len() <= index {
            reserve_a_sixteenth(&mut self.moves, index + 1);
            self.moves.resize(index + 1, Move::default());
        }
        if let Some(place) = self.moves.get_mut(index) {
            *place = moved;
        }
    }

    /// Makes room for the stack of this slot.
    fn extend_tops(&mut self, slot: VertexSlot) {
        if self.tops.len() <= slot.index() {
            reserve_a_sixteenth(&mut self.tops, slot.index() + 1);
            self.tops.resize(slot.index() + 1, NONE);
        }
    }

    /// Records that the split which made `t` was undone. `t`'s own stack is nested in the new entry. Evicts the oldest
    /// entry when full. O(1).
    pub fn push(&mut self, t: VertexSlot, undo: &SplitUndo) {
        let nested = self.take_top(t);
        if self.capacity == 0 {
            return;
        }
        if self.len == self.capacity {
            // Whatever is nested in an entry collapsed before it did, so the oldest entry has nothing nested in it and
            // nothing below it.
            self.evict_oldest();
        }
        // The eviction may have taken the bottom of `t`'s own stack, even all of it.
        let nested =
            if nested != NONE && self.entries[nested as usize].holder == AT_SLOT | t.0 { nested } else { NONE };
        self.extend_tops(undo.s);
        let below = self.tops[undo.s.index()];
        let entry = Entry {
            position: undo.vertex.position,
            color: undo.vertex.color,
            flags: CUT_KNOWN,
            left: undo.left,
            right: undo.right,
            label: NONE,
            below,
            holder: AT_SLOT | undo.s.0,
            nested,
            older: self.newest,
            newer: NONE,
        };
        let index = match self.free.pop() {
            Some(index) => {
                self.entries[index as usize] = entry;
                index
            }
            None => {
                let len = self.entries.len() + 1;
                reserve_a_sixteenth(&mut self.entries, len);
                self.entries.push(entry);
                self.entries.len() as u32 - 1
            }
        };
        self.put_move(index, &undo.vertex);
        if nested != NONE {
            self.entries[nested as usize].holder = index;
            self.entries[nested as usize].set(NESTED_TOP, true);
        }
        if below != NONE {
            self.entries[below as usize].holder = index;
        }
        match self.newest {
            NONE => self.oldest = index,
            newest => self.entries[newest as usize].newer = index,
        }
        self.newest = index;
        self.tops[undo.s.index()] = index;
        self.len += 1;
    }

    /// Takes the top of `s`'s stack, which is being split into the new slot `t`; `t` gets its own stack back. O(1).
    pub fn pop(&mut self, s: VertexSlot, t: VertexSlot) -> Option<CachedSplit> {
        let index = match self.tops.get(s.index()) {
            None | Some(&NONE) => return None,
            Some(&top) => top,
        };
        let split = self.split_of(index);
        let Entry { below, nested, .. } = self.entries[index as usize];
        self.tops[s.index()] = below;
        if below != NONE {
            self.entries[below as usize].holder = AT_SLOT | s.0;
        }
        if nested != NONE {
            self.extend_tops(t);
            self.tops[t.index()] = nested;
            self.entries[nested as usize].holder = AT_SLOT | t.0;
            self.entries[nested as usize].set(NESTED_TOP, false);
        }
        self.unlink(index);
        Some(split)
    }

    /// Gives the entries pushed last these labels, the newest the last of them; labels in front of entries that were evicted
    /// since mean nothing. A server calls entries by their op's number, so that it can [rebuild](Self::rebuilt) the cache.
    pub fn label_newest(&mut self, labels: &[u32]) {
        let mut index = self.newest;
        for &label in labels.iter().rev() {
            let Some(entry) = self.entries.get_mut(index as usize) else { return };
            entry.label = label;
            index = entry.older;
        }
    }

    /// Labels of all entries, the oldest first.
    pub fn labels(&self) -> impl Iterator<Item = u32> + '_ {
        let first = self.entries.get(self.oldest as usize);
        std::iter::successors(first, |entry| self.entries.get(entry.newer as usize)).map(|entry| entry.label)
    }

    /// The cache that holds these splits, the oldest first, without the cuts, as after [`forget_cuts`](Self::forget_cuts).
    /// Each comes with its label and with what it hangs from: what is cached on one vertex or in one entry is a stack, the
    /// newest on top. `None` if they are more than `capacity` or an entry is named that is not newer.
    pub fn rebuilt(capacity: u32, splits: &[(u32, NewVertex, CacheHolder)]) -> Option<Self> {
        let mut cache = Self::new(capacity);
        let len = u32::try_from(splits.len()).ok().filter(|&len| len <= capacity)?;
        cache.entries.reserve_exact(splits.len());
        // Tops of what is nested in entries that are not there yet.
        let mut nested = vec![NONE; splits.len()];
        for (index, &(label, vertex, holder)) in (0..).zip(splits) {
            let top = match holder {
                CacheHolder::Slot(slot) => {
                    cache.extend_tops(slot);
                    &mut cache.tops[slot.index()]
                }
                CacheHolder::Entry(newer) => nested.get_mut(newer as usize).filter(|_| newer > index)?,
            };
            let below = std::mem::replace(top, index);
            if below != NONE {
                cache.entries[below as usize].holder = index;
                cache.entries[below as usize].set(NESTED_TOP, false);
            }
            let inside = nested[index as usize];
            if inside != NONE {
                cache.entries[inside as usize].holder = index;
            }
            let none = VertexSlot::NONE;
            let (holder, is_nested_top) = match holder {
                CacheHolder::Slot(slot) => (AT_SLOT | slot.0, false),
                CacheHolder::Entry(newer) => (newer, true),
            };
            cache.entries.push(Entry {
                position: vertex.position,
                color: vertex.color,
                flags: if is_nested_top { NESTED_TOP } else { 0 },
                left: none,
                right: none,
                label,
                below,
                holder,
                nested: inside,
                older: index.wrapping_sub(1),
                newer: if index + 1 == len { NONE } else { index + 1 },
            });
            cache.put_move(index, &vertex);
        }
        if len > 0 {
            (cache.oldest, cache.newest, cache.len) = (0, len - 1, len);
        }
        Some(cache)
    }

    /// Drops what is cached on slots that a despawn frees.
    pub fn drop_slots(&mut self, slots: &[u32]) {
        let mut pending: Vec<u32> = slots.iter().map(|&slot| self.take_top(VertexSlot(slot))).collect();
        while let Some(index) = pending.pop() {
            if index != NONE {
                let Entry { below, nested, .. } = self.entries[index as usize];
                pending.extend([below, nested]);
                self.unlink(index);
            }
        }
    }

    /// Forgets every stored cut, as both ends do when a batch says so.
    pub fn forget_cuts(&mut self) {
        self.entries.iter_mut().for_each(|entry| entry.set(CUT_KNOWN, false));
    }

    /// Bytes of memory held.
    pub fn heap_bytes(&self) -> usize {
        self.entries.capacity() * size_of::<Entry>()
            + self.moves.capacity() * size_of::<Move>()
            + (self.free.capacity() + self.tops.capacity()) * 4
    }

    fn take_top(&mut self, slot: VertexSlot) -> u32 {
        match self.tops.get_mut(slot.index()) {
            Some(top) => std::mem::replace(top, NONE),
            None => NONE,
        }
    }

    fn evict_oldest(&mut self) {
        let index = self.oldest;
        let Entry { below, holder, flags, nested, .. } = self.entries[index as usize];
        debug_assert!(below == NONE && nested == NONE, "what is below or nested is older");
        if holder & AT_SLOT != 0 {
            // The slot's top, unless the caller has just taken it.
            let top = &mut self.tops[(holder & !AT_SLOT) as usize];
            if *top == index {
                *top = NONE;
            }
        } else if flags & NESTED_TOP != 0 {
            self.entries[holder as usize].nested = NONE;
        } else {
            self.entries[holder as usize].below = NONE;
        }
        self.unlink(index);
    }

    /// Takes an entry out of the order of pushing and frees it.
    fn unlink(&mut self, index: u32) {
        let Entry { older, newer, .. } = self.entries[index as usize];
        match older {
            NONE => self.oldest = newer,
            older => self.entries[older as usize].newer = newer,
        }
        match newer {
            NONE => self.newest = older,
            newer => self.entries[newer as usize].older = older,
        }
        self.entries[index as usize].holder = NONE;
        self.free.push(index);
        self.len -= 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    /// The dull twin: trees of entries with their time of pushing, searched in full.
    #[derive(Clone, Debug)]
    struct Node {
        x: i32,
        pushed: u64,
        nested: Vec<Node>,
    }

    #[derive(Default)]
    struct Naive {
        stacks: BTreeMap<u32, Vec<Node>>,
        clock: u64,
    }

    fn count(stack: &[Node]) -> u32 {
        stack.iter().map(|n| 1 + count(&n.nested)).sum()
    }

    fn oldest(stack: &[Node]) -> u64 {
        stack.iter().map(|n| n.pushed.min(oldest(&n.nested))).min().unwrap_or(u64::MAX)
    }

    fn remove(stack: &mut Vec<Node>, pushed: u64) {
        stack.retain(|n| n.pushed != pushed);
        stack.iter_mut().for_each(|n| remove(&mut n.nested, pushed));
    }

    #[test]
    fn agrees_with_nested_vectors() {
        for seed in 0..40 {
            let mut rng = fastrand::Rng::with_seed(seed);
            let capacity = rng.u32(0..20);
            let (mut cache, mut naive) = (SplitCache::new(capacity), Naive::default());
            // A forest of vertices: slot -> the slot it was split from. A vertex may collapse when nothing was split off it.
            let mut alive: BTreeMap<u32, Option<u32>> = (0..4).map(|s| (s, None)).collect();
            let mut last: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
            for step in 0..3000 {
                let slots: Vec<u32> = alive.keys().copied().collect();
                let v = slots[rng.usize(0..slots.len())];
                if rng.bool() && alive.len() < 40 {
                    let t = (0..).find(|t| !alive.contains_key(t)).unwrap();
                    let expected = naive.stacks.entry(v).or_default().pop();
                    let got = cache.pop(VertexSlot(v), VertexSlot(t));
                    assert_eq!(got.map(|c| c.vertex.position[0]), expected.as_ref().map(|n| n.x), "seed {seed} {step}");
                    naive.stacks.insert(t, expected.map(|n| n.nested).unwrap_or_default());
                    alive.insert(t, Some(v));
                    last.entry(v).or_default().push(t);
                } else if let Some(Some(s)) = alive.get(&v).copied() {
                    // Only the last vertex split from s, and only when it has no split vertices itself.
                    if last[&s].last() != Some(&v) || last.get(&v).is_some_and(|l| !l.is_empty()) {
                        continue;
                    }
                    last.get_mut(&s).unwrap().pop();
                    alive.remove(&v);
                    let x = rng.i32(..);
                    let vertex = NewVertex { position: [x, 0, 0], ..Default::default() };
                    let undo = SplitUndo { s: VertexSlot(s), vertex, left: VertexSlot(0), right: VertexSlot::NONE };
                    cache.push(VertexSlot(v), &undo);
                    let nested = naive.stacks.remove(&v).unwrap_or_default();
                    naive.clock += 1;
                    if capacity > 0 {
                        let pushed = naive.clock;
                        naive.stacks.entry(s).or_default().push(Node { x, pushed, nested });
                        while naive.stacks.values().map(|s| count(s)).sum::<u32>() > capacity {
                            let first = naive.stacks.values().map(|s| oldest(s)).min().unwrap();
                            naive.stacks.values_mut().for_each(|s| remove(s, first));
                        }
                    }
                } else if step % 97 == 0 {
                    cache.drop_slots(&[v]);
                    naive.stacks.remove(&v);
                }
                assert_eq!(cache.len(), naive.stacks.values().map(|s| count(s)).sum::<u32>());
                let top = |s| naive.stacks.get(&s).and_then(|s| s.last()).map(|n| n.x);
                for &slot in alive.keys() {
                    assert_eq!(cache.top(VertexSlot(slot)).map(|c| c.vertex.position[0]), top(slot));
                }
            }
        }
    }
}
