//! One flag for each vertex or face, which threads may set together.

use std::sync::atomic::{AtomicU64, Ordering};

/// `len` flags, at first all false. One bit each.
#[derive(Debug)]
pub(super) struct Bits {
    words: Vec<AtomicU64>,
}

impl Bits {
    pub(super) fn new(len: u64) -> Self {
        let words = (0..len.div_ceil(64)).map(|_| AtomicU64::new(0)).collect();
        Self { words }
    }

    #[inline]
    pub(super) fn get(&self, at: u32) -> bool {
        self.words[at as usize / 64].load(Ordering::Relaxed) >> (at % 64) & 1 == 1
    }

    #[inline]
    pub(super) fn set(&self, at: u32) {
        let (word, bit) = (&self.words[at as usize / 64], 1 << (at % 64));
        // Most flags are asked for several times: a load does not take the line away from the other threads.
        if word.load(Ordering::Relaxed) & bit == 0 {
            word.fetch_or(bit, Ordering::Relaxed);
        }
    }

    /// Clears a flag and returns what it was.
    pub(super) fn take(&mut self, at: u32) -> bool {
        let (word, bit) = (self.words[at as usize / 64].get_mut(), 1 << (at % 64));
        let was = *word & bit != 0;
        *word &= !bit;
        was
    }

    /// Number of flags that are true.
    pub(super) fn count(&self) -> u64 {
        self.words.iter().map(|word| u64::from(word.load(Ordering::Relaxed).count_ones())).sum()
    }

    /// For each block of 512 flags, how many before it are true: with them, [`Bits::rank`] costs a few instructions.
    pub(super) fn ranks(&self) -> Vec<u32> {
        let mut before = 0;
        self.words
            .chunks(8)
            .map(|block| {
                let here = before;
                before += block.iter().map(|word| word.load(Ordering::Relaxed).count_ones()).sum::<u32>();
                here
            })
            .collect()
    }

    /// How many flags before `at` are true, by the [`Bits::ranks`].
    pub(super) fn rank(&self, ranks: &[u32], at: u32) -> u32 {
        let word = at as usize / 64;
        let whole: u32 = self.words[word & !7..word].iter().map(|w| w.load(Ordering::Relaxed).count_ones()).sum();
        let part = self.words[word].load(Ordering::Relaxed) & ((1 << (at % 64)) - 1);
        ranks[word / 8] + whole + part.count_ones()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranks_count_what_is_set_before() {
        let mut bits = Bits::new(3000);
        let expected: Vec<bool> = (0..3000u32).map(|k| k * k % 7 < 3).collect();
        (0..3000).filter(|&k| expected[k as usize]).for_each(|k| bits.set(k));
        let ranks = bits.ranks();
        let mut count = 0;
        for k in 0..3000 {
            assert_eq!((bits.get(k), bits.rank(&ranks, k)), (expected[k as usize], count), "{k}");
            count += u32::from(expected[k as usize]);
        }
        assert_eq!(bits.count(), u64::from(count));
        assert!(bits.take(0) && !bits.take(0));
    }
}
