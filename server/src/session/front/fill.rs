//! What a triangle limit leaves beside the wanted ops is filled in order of priority, as [`select`](super::super::select::select) does.

use std::collections::BinaryHeap;

use super::super::select::{OpSet, pack, unpack};
use super::rows::{FILLS, WANTED};
use super::{Children, Context, Front};
use crate::pack::record::NO_OP;
use crate::pack::{PackError, PackedModel, Prerequisites};

/// Ratio of the priorities between which candidates are taken up first; the square of the last one for each time after that.
const BAND: f32 = 0.99;
/// A ratio below which all that is left is taken up at once.
const LAST_BAND: f32 = 0.01;

/// How the filling ended.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Filled {
    /// Whether the limit kept something out; the rest is zero otherwise.
    pub(super) is_limited: bool,
    /// Priority of the first op that was left out.
    pub(super) lambda: f32,
    /// Largest priority of one.
    pub(super) error: f32,
    /// Nothing could be filled, see [`Update`](super::Update).
    pub(super) has_failed: bool,
    /// Nothing was filled, see [`Effort::Moving`](super::Effort::Moving).
    pub(super) is_rough: bool,
}

impl Filled {
    /// Nothing is filled: what a camera that moves is shown.
    pub(super) fn rough(threshold: f32) -> Self {
        Self { is_limited: true, is_rough: true, lambda: threshold, error: threshold, has_failed: false }
    }

    fn leave_out(&mut self, priority: f32) {
        if !self.is_limited {
            (self.is_limited, self.lambda) = (true, priority);
        }
        self.error = self.error.max(priority);
    }
}

enum Fit {
    All,
    Part,
    SkippedSpawn,
    NotYet,
}

impl Front {
    /// Takes ops in until the limit is reached or nothing of a priority over the tolerance is left.
    pub(super) fn fill(&mut self, context: &mut Context<'_>) -> Result<Filled, PackError> {
        let tolerance = context.scorer.threshold();
        let mut filled = Filled::default();
        let mut triangles = self.triangles;
        let mut heap = BinaryHeap::new();
        for &op in context.model.base_first_splits() {
            self.offer(context, &mut heap, op)?;
        }
        // Candidates of higher priority than this are in the heap, with all that they led to.
        let mut seeded = f32::INFINITY;
        let mut band = BAND;
        loop {
            while seeded > tolerance && heap.peek().is_none_or(|&key| unpack(key).0 <= seeded) {
                let high = seeded;
                seeded = if band < LAST_BAND { tolerance } else { (seeded.min(self.threshold) * band).max(tolerance) };
                band *= band;
                self.seed(context, &mut heap, seeded, high)?;
            }
            let Some(key) = heap.pop() else { break };
            let (priority, op) = unpack(key);
            if !self.rows.state(op).is_member() {
                match self.take(context, op, priority, &mut triangles)? {
                    Fit::All => {}
                    Fit::SkippedSpawn => {
                        filled.leave_out(priority);
                        continue;
                    }
                    Fit::Part => {
                        filled.leave_out(priority);
                        break;
                    }
                    Fit::NotYet => continue,
                }
            }
            for child in Children::of(context.model, op)? {
                self.offer(context, &mut heap, child)?;
            }
        }
        Ok(filled)
    }

    fn offer(&self, context: &mut Context<'_>, heap: &mut BinaryHeap<u64>, op: u32) -> Result<(), PackError> {
        if op == NO_OP || self.rows.state(op).flags & WANTED != 0 {
            return Ok(());
        }
        if context.pages.has(PackedModel::page_of(op), self.threshold) {
            context.tested += 1;
            let priority = context.scorer.priority(&context.model.bounds(op)?);
            if priority > context.scorer.threshold() {
                heap.push(pack(priority, op));
            }
        }
        Ok(())
    }

    /// Offers what hangs on rows whose bound lies in `low < bound <= high`: among them is all of a priority over `low` that does
    /// not lie over `high`.
    fn seed(
        &mut self,
        context: &mut Context<'_>,
        heap: &mut BinaryHeap<u64>,
        low: f32,
        high: f32,
    ) -> Result<(), PackError> {
        let near = super::down(context.scorer.near());
        let is_in = |bound: f32| bound > low && bound <= high;
        for row in 0..self.rows.ops.len() {
            if is_in(self.most_below(row, near)) && self.rows.states[row].flags & WANTED != 0 {
                for child in Children::of(context.model, self.rows.ops[row])? {
                    self.offer(context, heap, child)?;
                }
            }
        }
        let seen = self.spawns.len();
        self.see_spawns(context, low)?;
        for op in 0..self.spawns.len() {
            if op >= seen {
                self.look_at_spawn(context, op as u32)?;
                // It is no larger than what was not looked at, so it may lie anywhere below.
                if self.most_of_spawn_row(op as u32, near) > low {
                    self.offer(context, heap, op as u32)?;
                }
            } else if is_in(self.most_of_spawn_row(op as u32, near)) {
                self.offer(context, heap, op as u32)?;
            }
        }
        Ok(())
    }

    /// Takes an op with its closure, as far as it fits.
    fn take(
        &mut self,
        context: &mut Context<'_>,
        op: u32,
        priority: f32,
        triangles: &mut u32,
    ) -> Result<Fit, PackError> {
        let model = context.model;
        let room = context.limit.saturating_sub(*triangles);
        if room == 0 {
            // Every op adds a triangle, so nothing else will fit either.
            return Ok(Fit::Part);
        }
        if op < model.spawn_count() && model.spawn_triangles(op)? > room {
            return Ok(Fit::SkippedSpawn);
        }
        let Self { closure, rows, .. } = self;
        let is_whole =
            closure.gather(model, op, |op| rows.state(op).is_member(), |op| context.pages.has_op(op, priority))?;
        if !is_whole {
            return Ok(Fit::NotYet);
        }
        for i in 0..self.closure.ops.len() {
            let op = self.closure.ops[i];
            let after = triangles.saturating_add(model.triangles_of(op)?);
            if after > context.limit {
                // A component's spawn comes first in any closure that has one, so nothing was applied before it.
                return Ok(if op < model.spawn_count() { Fit::SkippedSpawn } else { Fit::Part });
            }
            *triangles = after;
            let row = self.touch(op);
            self.rows.states[row].flags |= FILLS;
            self.fills.push(op);
        }
        Ok(Fit::All)
    }
}

/// An op and those of its ancestors that are missing, parents first. Work space is kept between calls.
#[derive(Debug, Default)]
pub(crate) struct Closure {
    pub(crate) ops: Vec<u32>,
    stack: Vec<(u32, Prerequisites, usize)>,
    seen: OpSet,
}

impl Closure {
    /// Depth first over parents in stored order. Each op is entered once, so damaged parents cannot make it loop. False if a
    /// page is missing; those of other parents are then asked for too.
    pub(crate) fn gather(
        &mut self,
        model: &PackedModel,
        op: u32,
        is_present: impl Fn(u32) -> bool,
        mut has_pages: impl FnMut(u32) -> bool,
    ) -> Result<bool, PackError> {
        self.ops.clear();
        self.seen.clear();
        let mut enter = |seen: &mut OpSet, op: u32| -> Result<_, PackError> {
            seen.insert(op);
            let has = has_pages(op);
            let first = if has { model.prerequisites(op)? } else { Prerequisites::NONE };
            Ok(((op, first, 0), has))
        };
        let (first, mut is_whole) = enter(&mut self.seen, op)?;
        self.stack.push(first);
        while let Some((op, first, next)) = self.stack.last_mut() {
            let Some(&parent) = first.as_slice().get(*next) else {
                self.ops.push(*op);
                self.stack.pop();
                continue;
            };
            *next += 1;
            if !is_present(parent) && !self.seen.contains(&parent) {
                let (entry, has) = enter(&mut self.seen, parent)?;
                is_whole &= has;
                self.stack.push(entry);
            }
        }
        Ok(is_whole)
    }
}
