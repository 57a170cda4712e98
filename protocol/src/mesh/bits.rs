//! Sets of slots as bitmaps: membership in O(1), iteration and counting 64 slots at a time.

/// A growing set of small integers.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SlotSet {
    words: Vec<u64>,
    len: u32,
    /// No word before this one has a free bit.
    first_free_word: usize,
}

impl SlotSet {
    /// Number of members.
    #[inline]
    pub fn len(&self) -> u32 {
        self.len
    }

    /// Whether the set has no members.
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Whether `slot` is a member.
    #[inline]
    pub fn contains(&self, slot: u32) -> bool {
        self.words.get(slot as usize / 64).is_some_and(|w| w >> (slot % 64) & 1 == 1)
    }

    /// Adds `slot`; false if it was a member before.
    #[inline]
    pub fn insert(&mut self, slot: u32) -> bool {
        let word = slot as usize / 64;
        if word >= self.words.len() {
            self.words.resize(word + 1, 0);
        }
        let bit = 1u64 << (slot % 64);
        let added = self.words[word] & bit == 0;
        self.words[word] |= bit;
        self.len += u32::from(added);
        added
    }

    /// Removes `slot`; false if it was no member.
    #[inline]
    pub fn remove(&mut self, slot: u32) -> bool {
        let word = slot as usize / 64;
        let Some(w) = self.words.get_mut(word) else { return false };
        let bit = 1u64 << (slot % 64);
        let removed = *w & bit != 0;
        *w &= !bit;
        self.len -= u32::from(removed);
        if removed {
            self.first_free_word = self.first_free_word.min(word);
        }
        removed
    }

    /// The smallest integer that is no member. Amortised O(1) while removals precede insertions, as in a batch.
    pub fn smallest_free(&mut self) -> u32 {
        while self.words.get(self.first_free_word) == Some(&u64::MAX) {
            self.first_free_word += 1;
        }
        let word = self.first_free_word;
        let free = self.words.get(word).map_or(0, |w| (!w).trailing_zeros());
        word as u32 * 64 + free
    }

    /// Members in ascending order.
    pub fn iter(&self) -> impl Iterator<Item = u32> + '_ {
        self.words.iter().enumerate().flat_map(|(i, &word)| {
            std::iter::successors((word != 0).then_some(word), |w| {
                let rest = w & (w - 1);
                (rest != 0).then_some(rest)
            })
            .map(move |w| i as u32 * 64 + w.trailing_zeros())
        })
    }

    /// Number of members in `from .. to`.
    pub fn count_between(&self, from: u32, to: u32) -> u32 {
        if from >= to {
            return 0;
        }
        let (first, last) = (from as usize / 64, (to - 1) as usize / 64);
        let mut count = 0;
        for word in first..=last.min(self.words.len().saturating_sub(1)) {
            let mut w = self.words.get(word).copied().unwrap_or(0);
            if word == first {
                w &= u64::MAX << (from % 64);
            }
            if word == last {
                w &= u64::MAX >> (63 - (to - 1) % 64);
            }
            count += w.count_ones();
        }
        count
    }

    /// The member that has exactly `rank` members of the set at or after `from` before it, or `None`.
    pub fn select_from(&self, from: u32, rank: u32) -> Option<u32> {
        let mut left = rank;
        let mut word = from as usize / 64;
        let mut mask = u64::MAX << (from % 64);
        while word < self.words.len() {
            let mut w = self.words[word] & mask;
            let ones = w.count_ones();
            if left < ones {
                for _ in 0..left {
                    w &= w - 1;
                }
                return Some(word as u32 * 64 + w.trailing_zeros());
            }
            left -= ones;
            mask = u64::MAX;
            word += 1;
        }
        None
    }

    /// Bytes of memory held.
    pub fn heap_bytes(&self) -> usize {
        self.words.capacity() * 8
    }
}

#[cfg(test)]
mod tests {
    use super::SlotSet;
    use std::collections::BTreeSet;

    #[test]
    fn agrees_with_an_ordered_set() {
        let mut rng = fastrand::Rng::with_seed(7);
        let (mut set, mut twin) = (SlotSet::default(), BTreeSet::new());
        for step in 0..20_000 {
            let slot = rng.u32(0..500);
            if rng.bool() {
                assert_eq!(set.insert(slot), twin.insert(slot));
            } else {
                assert_eq!(set.remove(slot), twin.remove(&slot));
            }
            assert_eq!(set.len() as usize, twin.len());
            assert_eq!(set.smallest_free(), (0..).find(|s| !twin.contains(s)).unwrap());
            if step % 50 == 0 {
                assert!(set.iter().eq(twin.iter().copied()));
                let (a, b) = (rng.u32(0..600), rng.u32(0..600));
                assert_eq!(set.count_between(a, b) as usize, if a < b { twin.range(a..b).count() } else { 0 });
                let rank = rng.u32(0..300);
                assert_eq!(set.select_from(a, rank), twin.range(a..).nth(rank as usize).copied());
            }
        }
    }
}
