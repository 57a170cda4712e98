//! Counts of references, nearly all of them small: a byte each, and a map for those that do not fit.

use std::collections::BTreeMap;

/// Counts from here on are in the map.
const LARGE: u8 = u8::MAX;

/// How many references there are to each op, by address.
#[derive(Clone, Debug, Default)]
pub(super) struct References {
    counts: Vec<u8>,
    large: BTreeMap<u32, u32>,
}

impl References {
    /// Makes it count for so many addresses; further ones start at none.
    pub(super) fn extend(&mut self, addresses: usize) {
        self.counts.reserve_exact(addresses - self.counts.len());
        self.counts.resize(addresses, 0);
    }

    pub(super) fn heap_bytes(&self) -> usize {
        self.counts.capacity() + 16 * self.large.len()
    }

    pub(super) fn clear(&mut self, address: u32) {
        if std::mem::take(&mut self.counts[address as usize]) == LARGE {
            self.large.remove(&address);
        }
    }

    #[inline]
    pub(super) fn add(&mut self, address: u32) {
        let count = &mut self.counts[address as usize];
        if *count < LARGE - 1 {
            *count += 1;
        } else {
            *count = LARGE;
            *self.large.entry(address).or_insert(u32::from(LARGE) - 1) += 1;
        }
    }

    /// Takes one away and returns how many are left. There is one.
    #[inline]
    pub(super) fn drop_one(&mut self, address: u32) -> u32 {
        let count = &mut self.counts[address as usize];
        if *count < LARGE {
            *count -= 1;
            return u32::from(*count);
        }
        self.drop_large(address)
    }

    #[cold]
    fn drop_large(&mut self, address: u32) -> u32 {
        let Some(left) = self.large.get_mut(&address) else { return 0 };
        *left -= 1;
        let left = *left;
        if left < u32::from(LARGE) {
            self.large.remove(&address);
            self.counts[address as usize] = left as u8;
        }
        left
    }
}

#[cfg(test)]
mod tests {
    use super::References;

    #[test]
    fn counts_are_those_of_plain_numbers() {
        let mut rng = fastrand::Rng::with_seed(5);
        let (mut references, mut twin) = (References::default(), [0u32; 3]);
        references.extend(3);
        let mut most = 0;
        for step in 0..200_000 {
            let address = rng.usize(..3);
            // Up for a long time, then down, so that they pass what a byte holds both ways.
            let grows = rng.u8(..) < if step / 2000 % 2 == 0 { 150 } else { 106 };
            if rng.u16(..) == 0 {
                references.clear(address as u32);
                twin[address] = 0;
            } else if grows {
                references.add(address as u32);
                twin[address] += 1;
            } else if twin[address] > 0 {
                twin[address] -= 1;
                assert_eq!(references.drop_one(address as u32), twin[address]);
            }
            most = most.max(twin[address]);
            assert_eq!(references.large.len(), twin.iter().filter(|&&count| count > 254).count());
        }
        assert!(most > 400, "{most}");
    }
}
