//! The set of ops that a view asks for: P*, the closure of the wanted ops, as far as the triangle limit allows.
//!
//! The rule (DESIGN: "Session"): ops in order of priority descending, id ascending; each brings its missing parents. The
//! first closure that does not fit is applied parents first as far as it fits and ends the selection; one whose spawn does
//! not fit is skipped. The result depends on the view and the model alone.
//!
//! Priorities fall along the vertex forest and forest parents have smaller ids, so a best-first walk from the roots meets the
//! ops in exactly that order. Cost: O(k log k) for k ops selected, whatever the size of the model.

use std::collections::BinaryHeap;
use std::hash::BuildHasherDefault;

use super::score::Scorer;
use crate::pack::record::{CutRef, NO_OP};
use crate::pack::{PackError, PackedModel};

/// Hash map keyed by op id.
pub(crate) type OpMap<V> = std::collections::HashMap<u32, V, BuildHasherDefault<OpHasher>>;
/// Hash set of op ids.
pub(crate) type OpSet = std::collections::HashSet<u32, BuildHasherDefault<OpHasher>>;

/// Multiplicative hash of one op id. Ids come from the pack, so nobody outside chooses them; nothing depends on the order.
#[derive(Default, Clone, Copy, Debug)]
pub(crate) struct OpHasher(u64);

impl std::hash::Hasher for OpHasher {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|&b| self.write_u32(u32::from(b)));
    }

    fn write_u32(&mut self, x: u32) {
        let h = (self.0 ^ u64::from(x)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        self.0 = h ^ h >> 32;
    }
}

/// The result for one view.
#[derive(Clone, Debug, Default)]
pub(crate) struct Selection {
    /// P*, parents before children, in order of priority.
    pub(crate) ops: Vec<u32>,
    /// The same as a set.
    pub(crate) set: OpSet,
    /// Triangles of the mesh built from it.
    pub(crate) triangles: u32,
    /// Priority at which the selection ended: the tolerance, or more when the limit binds.
    pub(crate) lambda: f32,
    /// Largest priority of an op that was left out.
    pub(crate) error: f32,
    /// Whether the limit kept wanted ops out.
    pub(crate) is_limited: bool,
}

/// Triangles that an op adds.
pub(crate) fn triangles_of(model: &PackedModel, op: u32) -> Result<u32, PackError> {
    if op < model.spawn_count() {
        return model.spawn_triangles(op);
    }
    let fields = model.split(op)?;
    Ok(u32::from(fields.left != CutRef::None) + u32::from(fields.right != CutRef::None))
}

/// Computes P* for a view under a triangle limit.
pub(crate) fn select(model: &PackedModel, scorer: &Scorer, limit: u32) -> Result<Selection, PackError> {
    let mut walk = Walk {
        model,
        scorer,
        heap: BinaryHeap::new(),
        out: Selection { triangles: model.base().faces.len() as u32, lambda: scorer.threshold(), ..Default::default() },
    };
    for &op in model.base_first_splits() {
        walk.offer(op)?;
    }
    for spawn in 0..model.spawn_count() {
        walk.offer(spawn)?;
    }
    let mut closure = Closure::default();
    while let Some(key) = walk.heap.pop() {
        let (priority, op) = unpack(key);
        if !walk.out.set.contains(&op) {
            closure.gather(model, &walk.out.set, op)?;
            match walk.apply(&closure, limit)? {
                Fit::All => {}
                Fit::SkippedSpawn => {
                    walk.leave_out(priority, op)?;
                    continue;
                }
                Fit::Part => {
                    walk.leave_out(priority, op)?;
                    break;
                }
            }
        }
        if op < model.spawn_count() {
            for first in model.spawn_first_splits(op)? {
                walk.offer(first)?;
            }
        } else {
            for child in model.children(op)? {
                walk.offer(child)?;
            }
        }
    }
    if walk.out.is_limited {
        // What comes later has no larger priority, but in a complete view it may have a larger error.
        for key in std::mem::take(&mut walk.heap) {
            let (priority, op) = unpack(key);
            if !walk.out.set.contains(&op) {
                walk.leave_out(priority, op)?;
            }
        }
    }
    Ok(walk.out)
}

struct Walk<'a> {
    model: &'a PackedModel,
    scorer: &'a Scorer,
    heap: BinaryHeap<u64>,
    out: Selection,
}

enum Fit {
    All,
    Part,
    SkippedSpawn,
}

/// Orders by priority descending, then id ascending, as a max-heap key. Priorities are not negative, so their bits order
/// like the numbers.
fn pack(priority: f32, op: u32) -> u64 {
    u64::from(priority.to_bits()) << 32 | u64::from(!op)
}

fn unpack(key: u64) -> (f32, u32) {
    (f32::from_bits((key >> 32) as u32), !(key as u32))
}

impl Walk<'_> {
    fn offer(&mut self, op: u32) -> Result<(), PackError> {
        if op == NO_OP {
            return Ok(());
        }
        let priority = self.scorer.priority(&self.model.bounds(op)?);
        if self.scorer.wants(priority) {
            self.heap.push(pack(priority, op));
        } else {
            self.out.error = self.out.error.max(priority);
        }
        Ok(())
    }

    fn leave_out(&mut self, priority: f32, op: u32) -> Result<(), PackError> {
        if !self.out.is_limited {
            self.out.is_limited = true;
            self.out.lambda = self.out.lambda.max(priority);
        }
        self.out.error = self.out.error.max(self.scorer.missing(priority, &self.model.bounds(op)?));
        Ok(())
    }

    fn apply(&mut self, closure: &Closure, limit: u32) -> Result<Fit, PackError> {
        for &op in &closure.ops {
            let triangles = triangles_of(self.model, op)?;
            let after = self.out.triangles.saturating_add(triangles);
            if after > limit {
                // A component's spawn comes first in any closure that has one, so nothing was applied before it.
                return Ok(if op < self.model.spawn_count() { Fit::SkippedSpawn } else { Fit::Part });
            }
            self.out.triangles = after;
            self.out.set.insert(op);
            self.out.ops.push(op);
        }
        Ok(Fit::All)
    }
}

/// An op and those of its ancestors that are missing, parents first. Work space is kept between calls.
#[derive(Default)]
struct Closure {
    ops: Vec<u32>,
    stack: Vec<(u32, [u32; 3], usize, usize)>,
    seen: OpSet,
}

impl Closure {
    /// Depth first over parents in stored order. Each op is entered once, so damaged parents cannot make it loop.
    fn gather(&mut self, model: &PackedModel, present: &OpSet, op: u32) -> Result<(), PackError> {
        self.ops.clear();
        self.seen.clear();
        self.enter(model, op)?;
        while let Some((op, parents, count, next)) = self.stack.last_mut() {
            if *next == *count {
                self.ops.push(*op);
                self.stack.pop();
                continue;
            }
            let parent = parents[*next];
            *next += 1;
            if !present.contains(&parent) && !self.seen.contains(&parent) {
                self.enter(model, parent)?;
            }
        }
        Ok(())
    }

    fn enter(&mut self, model: &PackedModel, op: u32) -> Result<(), PackError> {
        self.seen.insert(op);
        let (parents, count) = if op < model.spawn_count() { ([NO_OP; 3], 0) } else { model.parents(op)? };
        self.stack.push((op, parents, count, 0));
        Ok(())
    }
}
