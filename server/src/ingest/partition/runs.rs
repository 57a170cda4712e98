//! Items sorted into buckets outside memory, in one pass: the input is cut into runs, each is sorted by bucket in memory and
//! appended to one spill, and a bucket is read back from its slice of every run. What is kept in memory is where the slices
//! start: 8 bytes for each run and bucket.

use std::ops::Range;

use bytemuck::{AnyBitPattern, NoUninit};
use rayon::prelude::*;

use crate::ingest::spill::{Spill, SpillError, Workspace};

/// Input items of one run: a few megabytes.
const RUN: u64 = 1 << 17;

/// Most pieces of work that are in memory at once, whatever the number of threads.
const MOST_AT_ONCE: usize = 16;

/// Items by bucket, in each bucket in the order in which they were made.
#[derive(Debug)]
pub(super) struct Runs<T> {
    items: Spill<T>,
    bucket_count: usize,
    /// Run after run, the start of each bucket, and the number of items at the end.
    starts: Vec<u64>,
}

impl<T: NoUninit + AnyBitPattern + Send> Runs<T> {
    /// Calls `make` with one range of `0..input_len` after another, on all threads of the pool, and sorts what it pushes,
    /// pairs of bucket and item, into buckets.
    pub(super) fn build(
        workspace: &Workspace,
        input_len: u64,
        bucket_count: usize,
        make: impl Fn(Range<u64>, &mut Vec<(u32, T)>) -> Result<(), SpillError> + Sync,
    ) -> Result<Self, SpillError> {
        let mut items = workspace.spill();
        let mut starts = Vec::new();
        in_order(
            input_len.div_ceil(RUN) as usize,
            |run| {
                let first = run as u64 * RUN;
                let mut pairs = Vec::with_capacity(RUN as usize);
                make(first..input_len.min(first + RUN), &mut pairs)?;
                Ok(sort_by_bucket(&pairs, bucket_count))
            },
            |_, (sorted, ends)| {
                let before = items.len();
                starts.push(before);
                starts.extend(ends[..bucket_count - 1].iter().map(|&end| before + u64::from(end)));
                items.push(&sorted)
            },
        )?;
        starts.push(items.len());
        Ok(Self { items: items.finish()?, bucket_count, starts })
    }

    pub(super) fn bucket_count(&self) -> usize {
        self.bucket_count
    }

    fn slices(&self, bucket: usize) -> impl Iterator<Item = Range<u64>> + '_ {
        // In the order of the file, a bucket ends where the next one of the run, or the next run, starts.
        (bucket..self.starts.len() - 1)
            .step_by(self.bucket_count)
            .map(|at| self.starts[at]..self.starts[at + 1])
            .filter(|slice| !slice.is_empty())
    }

    /// Number of items in a bucket.
    pub(super) fn len(&self, bucket: usize) -> u64 {
        self.slices(bucket).map(|slice| slice.end - slice.start).sum()
    }

    /// A bucket.
    pub(super) fn read(&self, bucket: usize) -> Result<Vec<T>, SpillError> {
        let mut out = Vec::with_capacity(self.len(bucket) as usize);
        for slice in self.slices(bucket) {
            self.items.append_to(slice, &mut out)?;
        }
        Ok(out)
    }

    /// Calls `visit` with one part of a bucket after another, none of which is large.
    pub(super) fn for_each_part(
        &self,
        bucket: usize,
        mut visit: impl FnMut(&[T]) -> Result<(), SpillError>,
    ) -> Result<(), SpillError> {
        let mut part = Vec::new();
        for slice in self.slices(bucket) {
            for start in slice.clone().step_by(RUN as usize) {
                self.items.read_into(start..slice.end.min(start + RUN), &mut part)?;
                visit(&part)?;
            }
        }
        Ok(())
    }

    /// The items number `range` of a bucket.
    pub(super) fn read_range(&self, bucket: usize, range: Range<u64>) -> Result<Vec<T>, SpillError> {
        let mut out = Vec::with_capacity((range.end - range.start) as usize);
        let mut before = 0;
        for slice in self.slices(bucket) {
            let len = slice.end - slice.start;
            let (low, high) = (range.start.max(before), range.end.min(before + len));
            if low < high {
                self.items.append_to(slice.start + low - before..slice.start + high - before, &mut out)?;
            }
            before += len;
        }
        Ok(out)
    }
}

/// A stable counting sort; also returns where each bucket ends.
fn sort_by_bucket<T: Copy + AnyBitPattern>(pairs: &[(u32, T)], bucket_count: usize) -> (Vec<T>, Vec<u32>) {
    let mut at = vec![0u32; bucket_count];
    pairs.iter().for_each(|&(bucket, _)| at[bucket as usize] += 1);
    let mut total = 0;
    for slot in &mut at {
        total += std::mem::replace(slot, total);
    }
    let mut sorted = vec![T::zeroed(); pairs.len()];
    for &(bucket, item) in pairs {
        let slot = &mut at[bucket as usize];
        sorted[*slot as usize] = item;
        *slot += 1;
    }
    (sorted, at)
}

/// Calls `work` with `0..count` on all threads of the pool and `take` with the results in order, on this one. Only a few are
/// in memory at once.
pub(super) fn in_order<R: Send>(
    count: usize,
    work: impl Fn(usize) -> Result<R, SpillError> + Sync,
    mut take: impl FnMut(usize, R) -> Result<(), SpillError>,
) -> Result<(), SpillError> {
    let step = (2 * rayon::current_num_threads()).clamp(1, MOST_AT_ONCE);
    for first in (0..count).step_by(step) {
        let results: Vec<_> = (first..count.min(first + step)).into_par_iter().map(&work).collect();
        for (k, result) in (first..).zip(results) {
            take(k, result?)?;
        }
    }
    Ok(())
}

/// [`in_order`] over the blocks of a spill, given as ranges.
pub(super) fn blocks_in_order<R: Send>(
    len: u64,
    work: impl Fn(Range<u64>) -> Result<R, SpillError> + Sync,
    mut take: impl FnMut(R) -> Result<(), SpillError>,
) -> Result<(), SpillError> {
    let range = |k: usize| k as u64 * RUN..len.min((k as u64 + 1) * RUN);
    in_order(len.div_ceil(RUN) as usize, |k| work(range(k)), |_, result| take(result))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buckets_come_back_in_the_order_of_the_input() {
        let count = 3 * RUN + 77;
        let bucket = |k: u64| (k * k % 5) as u32 * 2;
        for memory in [0, u64::MAX] {
            let workspace = Workspace::new(&std::env::temp_dir(), memory);
            let runs = Runs::build(&workspace, count, 10, |range, out| {
                out.extend(range.filter(|k| k % 3 > 0).map(|k| (bucket(k), k)));
                Ok(())
            })
            .unwrap();
            for b in 0..10 {
                let expected: Vec<u64> = (0..count).filter(|k| k % 3 > 0 && bucket(*k) == b).collect();
                assert_eq!(runs.read(b as usize).unwrap(), expected);
                let mut parts = Vec::new();
                runs.for_each_part(b as usize, |part| {
                    parts.extend_from_slice(part);
                    Ok(())
                })
                .unwrap();
                assert_eq!(parts, expected);
                let middle = expected.len() as u64 / 3..expected.len() as u64 / 2;
                let [low, high] = [middle.start as usize, middle.end as usize];
                assert_eq!(runs.read_range(b as usize, middle).unwrap(), expected[low..high]);
            }
        }
    }

    #[test]
    fn nothing_in_gives_empty_buckets() {
        let runs = Runs::<u64>::build(&Workspace::in_memory(), 0, 3, |_, _| unreachable!()).unwrap();
        assert_eq!((runs.len(0), runs.len(2)), (0, 0));
    }
}
