//! Reads of what will be asked for next, for no other end than to have it near the processor: reading one record after another means to wait
//! for each, and the reads of several overlap.

use super::layout::{PAGE_HEADER, column};
use super::page::{PageView, u64_at};
use super::{PackedModel, record::NO_OP};

/// How many ops are touched at once.
const TOUCHED_AT_ONCE: usize = 16;

impl PackedModel {
    /// Touches the bounds of ops, as far as their pages are ready. Like all of these it passes over [`NO_OP`].
    pub(crate) fn touch_bounds(&self, ops: &[u32]) {
        self.touch(ops, |view, row| {
            let mut seen = 0;
            for column in column::CENTER..column::TESTS {
                seen ^= view.touch(column, row);
            }
            seen
        });
    }

    /// Touches what says which ops hang on splits.
    pub(crate) fn touch_children(&self, splits: &[u32]) {
        self.touch(splits, |view, row| {
            let row = row - view.spawns.min(row);
            view.touch(column::TAGS, row) ^ view.touch(column::NEXT_OF_S, row) ^ view.touch(column::FIRST_OF_T, row)
        });
    }

    /// Touches what it takes to apply splits.
    pub(crate) fn touch_fields(&self, splits: &[u32]) {
        self.touch(splits, |view, row| {
            let row = row - view.spawns.min(row);
            let mut seen = view.touch(column::TAGS, row);
            for column in column::TREE..column::PLAIN {
                seen ^= view.touch(column, row);
            }
            seen
        });
    }

    #[inline(always)]
    fn touch(&self, ops: &[u32], touch: impl Fn(PageView<'_>, usize) -> u8) {
        let mut seen = 0;
        for ops in ops.chunks(TOUCHED_AT_ONCE) {
            // The heads of all pages first: they say where the columns are.
            let mut rows = [None; TOUCHED_AT_ONCE];
            for (row, &op) in rows.iter_mut().zip(ops) {
                *row = if op == NO_OP { None } else { self.ready_row(op) };
                if let Some((view, _)) = row {
                    seen ^= view.bytes.get(PAGE_HEADER + 8 * column::TAGS).copied().unwrap_or_default();
                }
            }
            for &(view, row) in rows.iter().flatten() {
                seen ^= touch(view, row);
            }
        }
        std::hint::black_box(seen);
    }
}

impl PageView<'_> {
    /// A byte of where a value of a column lies.
    #[inline(always)]
    fn touch(&self, column: usize, row: usize) -> u8 {
        let Some(entry) = u64_at(self.bytes, PAGE_HEADER + 8 * column) else { return 0 };
        let (at, width) = ((entry >> 32) as usize & 0xffff, (entry >> 48) as usize & 7);
        // Of values in three bytes, the first two.
        let width = if width == 3 { 2 } else { width };
        self.bytes.get(at * 8 + width * row).copied().unwrap_or_default()
    }
}
