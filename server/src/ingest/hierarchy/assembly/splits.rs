//! Splits on their way from the order of simplification to that of their ids.
//!
//! They are written in *runs*, blocks in the order of simplification, each grouped by *bucket*, a range of ids that fits in
//! memory. A bucket is read by collecting its part of every run; there it only takes an index to put splits in order.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use crate::ingest::spill::Spill;
use crate::pack::record::{Bounds, Cone, CutRef, Magnitude, NO_OP, SplitRecord, VERTEX_OPS};
use crate::pack::{SplitSource, WriteError};

/// A [`SplitRecord`] with its id as it waits in a spill, without padding.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct StoredSplit {
    pub(super) id: u32,
    pub(super) tree_parent: u32,
    pub(super) s: u32,
    /// Owner or root face of each cut.
    pub(super) cuts: [u32; 2],
    pub(super) next_of_s: u32,
    pub(super) first_of_t: u32,
    pub(super) position: [i32; 3],
    pub(super) s_move: [i32; 3],
    pub(super) center: [i32; 3],
    pub(super) radius: u16,
    pub(super) error: u16,
    pub(super) axis: [i8; 2],
    pub(super) half_angle: u8,
    pub(super) color: [u8; 3],
    pub(super) s_color_move: [u8; 3],
    /// What each cut is, in four bits: [`NO_CUT`], [`ROOT_CUT`] or [`SPLIT_CUT`] plus the side, and the edge above.
    pub(super) kinds: [u8; 2],
    pub(super) padding: u8,
}

pub(super) const NO_CUT: u8 = 0;
pub(super) const ROOT_CUT: u8 = 1;
pub(super) const SPLIT_CUT: u8 = 2;

impl StoredSplit {
    fn record(&self) -> SplitRecord {
        let cut = |k: usize| {
            let (kind, edge) = (self.kinds[k] & 3, self.kinds[k] >> 2);
            match kind {
                NO_CUT => CutRef::None,
                ROOT_CUT => CutRef::Root { face: self.cuts[k], edge },
                _ => CutRef::Split { op: self.cuts[k], side: kind - SPLIT_CUT, edge },
            }
        };
        SplitRecord {
            bounds: Bounds {
                center: self.center,
                radius: Magnitude(self.radius),
                error: Magnitude(self.error),
                cone: Cone { axis: self.axis, half_angle: self.half_angle },
            },
            tree_parent: self.tree_parent,
            s: self.s,
            left: cut(0),
            right: cut(1),
            next_of_s: self.next_of_s,
            first_of_t: self.first_of_t,
            position: self.position,
            color: self.color,
            s_move: self.s_move,
            s_color_move: self.s_color_move,
            vertex_ops: [NO_OP; VERTEX_OPS],
        }
    }
}

/// All splits of a model, in runs.
#[derive(Debug)]
pub(super) struct Runs {
    pub(super) splits: Spill<StoredSplit>,
    /// Where each bucket of each run begins, run after run, and the end.
    pub(super) starts: Vec<u64>,
    /// Ids of a bucket, spawns counted.
    pub(super) bucket: u32,
    /// First id, which is the number of spawns, and one past the last.
    pub(super) ids: Range<u32>,
}

/// Reads the splits of a model bucket after bucket.
pub(super) struct Splits<'a> {
    runs: &'a Runs,
    /// By split, under the rule of vertices.
    vertex_ops: Option<&'a [[u32; VERTEX_OPS]]>,
    /// The bucket to read next.
    next: u32,
    /// Splits of the bucket at hand, run after run.
    splits: Vec<StoredSplit>,
    /// Where they are, by id.
    places: Vec<u32>,
}

impl<'a> Splits<'a> {
    pub(super) fn new(runs: &'a Runs, vertex_ops: Option<&'a [[u32; VERTEX_OPS]]>) -> Self {
        Self { runs, vertex_ops, next: runs.ids.start / runs.bucket, splits: Vec::new(), places: Vec::new() }
    }
}

impl SplitSource for Splits<'_> {
    fn advance(&mut self) -> Result<u32, WriteError> {
        let Runs { splits, starts, bucket, ids } = self.runs;
        let buckets = ids.end.div_ceil(*bucket);
        if self.next >= buckets {
            self.splits.clear();
            return Ok(0);
        }
        let parts =
            (self.next as usize..starts.len() - 1).step_by(buckets as usize).map(|at| starts[at]..starts[at + 1]);
        let count: u64 = parts.clone().map(|part| part.end - part.start).sum();
        // What is there is written over: filling a file's worth of memory with zeros first would cost as much as the reading.
        self.splits.resize(count as usize, Zeroable::zeroed());
        let mut rest = &mut self.splits[..];
        let mut reads = Vec::new();
        for part in parts {
            let (own, others) = rest.split_at_mut((part.end - part.start) as usize);
            reads.push((part.start, own));
            rest = others;
        }
        reads.into_par_iter().try_for_each(|(start, part)| splits.fill(start, part))?;
        let first = ids.start.max(self.next * bucket);
        self.places.clear();
        self.places.resize(self.splits.len(), 0);
        for (place, split) in (0..).zip(&self.splits) {
            self.places[(split.id - first) as usize] = place;
        }
        self.next += 1;
        Ok(self.splits.len() as u32)
    }

    fn read(&self, splits: Range<u32>, out: &mut Vec<SplitRecord>) {
        let places = &self.places[splits.start as usize..splits.end as usize];
        out.extend(places.iter().map(|&place| {
            let split = &self.splits[place as usize];
            let vertex_ops = self.vertex_ops.map(|ops| ops[(split.id - self.runs.ids.start) as usize]);
            SplitRecord { vertex_ops: vertex_ops.unwrap_or([NO_OP; VERTEX_OPS]), ..split.record() }
        }));
    }
}
