//! The final ids of the splits: by error band descending, then by where the band's topmost ancestor lies, then in the order of
//! refinement. A parent precedes its children: it has no smaller error, and within a band both have the same topmost ancestor.

use rayon::prelude::*;

use super::{Grain, blocks_from_the_end, invalid};
use crate::ingest::hierarchy::order::error_band;
use crate::ingest::hierarchy::{CollapseRecord, NONE};
use crate::ingest::spill::{Spill, SpillError, SpillWriter, Workspace};
use crate::mesh::morton::morton;
use crate::pack::WriteError;

/// Band, code and collapse, such that keys sort as the splits do. One number, since numbers compare without a branch.
type Key = u128;

fn key(band: u8, code: u64, op: u32) -> Key {
    Key::from(u8::MAX - band) << 95 | Key::from(code) << 32 | Key::from(!op)
}

fn op_of(key: Key) -> u32 {
    !(key as u32)
}

/// Final id of each collapse, counted from `first_id`. `max` is the largest coordinate of the lattice. Holds 9 bytes per
/// collapse for a while, then 4.
pub(super) fn final_ids(
    collapses: &Spill<CollapseRecord>,
    max: i32,
    first_id: u32,
    workspace: &Workspace,
    grain: &Grain,
    progress: &mut dyn FnMut(f32),
) -> Result<Vec<u32>, WriteError> {
    let mut sorter = Sorter::new(workspace, grain);
    let count = collapses.len() as usize;
    let mut heirs = Heirs { bands: vec![NO_BAND; count], codes: vec![0; count] };
    let mut block = Vec::new();
    let mut keys = Vec::with_capacity(grain.keys.min(count));
    for range in blocks_from_the_end(collapses.len(), grain.collapses) {
        collapses.read_into(range.clone(), &mut block)?;
        for (op, collapse) in (0..range.end as u32).rev().zip(block.iter().rev()) {
            keys.push(heirs.key(op, collapse, max)?);
            if keys.len() == grain.keys {
                sorter.push(&mut keys)?;
            }
        }
        progress(1.0 - range.start as f32 / count as f32);
    }
    drop((heirs, block));
    let mut ids = vec![0u32; count];
    let mut next = first_id;
    sorter.finish(keys, |sorted| {
        for &key in sorted {
            ids[op_of(key) as usize] = next;
            next += 1;
        }
    })?;
    Ok(ids)
}

const NO_BAND: u8 = u8::MAX;

/// What parents leave to their children: their band, and the code of the topmost ancestor in it.
struct Heirs {
    bands: Vec<u8>,
    codes: Vec<u64>,
}

impl Heirs {
    fn key(&mut self, op: u32, collapse: &CollapseRecord, max: i32) -> Result<Key, WriteError> {
        let bounds = collapse.bounds();
        let band = error_band(bounds.error);
        let inherits = self.bands[op as usize] == band;
        let code = if inherits { self.codes[op as usize] } else { morton(bounds.center, max) };
        for child in [collapse.next_of_s, collapse.first_of_t] {
            if child == NONE {
                continue;
            }
            if child >= op {
                return Err(invalid(format!("collapse {op} names collapse {child} as its child")));
            }
            self.bands[child as usize] = band;
            self.codes[child as usize] = code;
        }
        Ok(key(band, code, op))
    }
}

/// Sorts keys that do not all fit: in runs, which are then merged a range of keys at a time.
struct Sorter<'w> {
    sorted: SpillWriter<'w, Key>,
    /// Where each run ends.
    ends: Vec<u64>,
    /// Every so manieth key of each run.
    noted: Vec<Key>,
    /// Most keys of a run.
    run: usize,
    /// Keys of a run from one noted to the next.
    stride: usize,
}

impl<'w> Sorter<'w> {
    fn new(workspace: &'w Workspace, grain: &Grain) -> Self {
        let (run, stride) = (grain.keys, grain.keys.div_ceil(4096));
        Self { sorted: workspace.spill(), ends: Vec::new(), noted: Vec::new(), run, stride }
    }

    /// Takes a run out of `keys`.
    fn push(&mut self, keys: &mut Vec<Key>) -> Result<(), SpillError> {
        keys.par_sort_unstable();
        self.noted.extend(keys.iter().step_by(self.stride));
        self.sorted.push(keys)?;
        self.ends.push(self.sorted.len());
        keys.clear();
        Ok(())
    }

    /// Calls `visit` with all keys in order, those of `rest` included, a stretch at a time.
    fn finish(mut self, mut rest: Vec<Key>, mut visit: impl FnMut(&[Key])) -> Result<(), SpillError> {
        if self.ends.is_empty() {
            rest.par_sort_unstable();
            visit(&rest);
            return Ok(());
        }
        self.push(&mut rest)?;
        self.noted.par_sort_unstable();
        let borders: Vec<Key> = self.noted.iter().copied().step_by(self.run / self.stride).skip(1).collect();
        let runs = Runs { keys: self.sorted.finish()?, ends: self.ends };
        let mut from = runs.starts();
        for border in borders.into_iter().map(Some).chain([None]) {
            let to = runs.lower_bounds(&from, border)?;
            rest.clear();
            for (&begin, &end) in from.iter().zip(&to) {
                runs.keys.append_to(begin..end, &mut rest)?;
            }
            rest.par_sort_unstable();
            visit(&rest);
            from = to;
        }
        Ok(())
    }
}

/// Sorted runs one after the other.
struct Runs {
    keys: Spill<Key>,
    ends: Vec<u64>,
}

impl Runs {
    fn starts(&self) -> Vec<u64> {
        [0].into_iter().chain(self.ends[..self.ends.len() - 1].iter().copied()).collect()
    }

    /// Of each run, from these places on, the first place whose key is not below `border`; the end without a border.
    fn lower_bounds(&self, from: &[u64], border: Option<Key>) -> Result<Vec<u64>, SpillError> {
        let Some(border) = border else { return Ok(self.ends.clone()) };
        let mut one = Vec::new();
        let mut places = Vec::with_capacity(from.len());
        for (&begin, &end) in from.iter().zip(&self.ends) {
            let (mut low, mut high) = (begin, end);
            while low < high {
                let middle = low + (high - low) / 2;
                self.keys.read_into(middle..middle + 1, &mut one)?;
                if one[0] < border {
                    low = middle + 1;
                } else {
                    high = middle;
                }
            }
            places.push(low);
        }
        Ok(places)
    }
}
