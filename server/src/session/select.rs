//! The set of ops that a view asks for: P*, the closure of the wanted ops, as far as the triangle limit allows.
//!
//! The rule (DESIGN: "Session"): ops in order of priority descending, id ascending; each brings its missing parents. The
//! first closure that does not fit is applied parents first as far as it fits and ends the selection; one whose spawn does
//! not fit is skipped. The result depends on the view and the model alone.
//!
//! Priorities fall along the vertex forest and forest parents have smaller ids, so a best-first walk from the roots meets the
//! ops in exactly that order. Spawns have no parents, but they are stored by error descending, so those of a page are judged
//! only once the walk has come down to what the largest of them may matter. Cost: O(k log k) for k ops selected, whatever the
//! size of the model, and about 20 ns for each spawn that is judged.
//!
//! Where pages are read ahead, an op whose page has not been read is passed over with all that depends on it, and the page is
//! named: the selection is then a part of P*. Where the limit may bind, it is the part that comes before whatever is missing.

use std::collections::BinaryHeap;
use std::hash::BuildHasherDefault;

use lodestream_protocol::view::View;

use super::front::Closure;
use super::score::Scorer;
use super::sweep::Sweep;
use crate::pack::record::{Bounds, Magnitude, NO_OP};
use crate::pack::{PAGE_OPS, PackError, PackedModel, PageId};

/// Most pages that one selection names: what a walk finds missing beyond them, the next one names. 16 MB of pages of the usual
/// size, and 8 KB of names.
pub(crate) const MAX_MISSING: usize = 1024;

/// Pages of spawns that are asked for at once when the next one is missing.
pub(super) const SPAWN_PAGES_AHEAD: u32 = 16;

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
    /// Pages that have to be read before this is P*, those of the most important ops first; at most [`MAX_MISSING`].
    pub(crate) missing: Vec<PageId>,
}

/// What happens where a page has not been read yet.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum PageAccess {
    /// It is read and checked, whoever asks.
    Blocking,
    /// It is named as missing.
    ReadAhead,
}

/// P* for a view and its triangle limit: parents before children, otherwise in order of priority. What a settled session holds.
///
/// # Errors
/// [`PackError`] if a page is damaged.
pub fn ops_for_view(model: &PackedModel, view: &View) -> Result<Vec<u32>, PackError> {
    let scorer = Scorer::new(view, model.info());
    Ok(select(model, &scorer, view.triangle_limit, PageAccess::Blocking)?.ops)
}

/// Every op with an error of more than `error` in model units, and what they need, within a triangle limit: parents before
/// children, otherwise by error. Without `error` every op, as in a complete view.
///
/// # Errors
/// [`PackError`] if a page is damaged.
pub fn ops_by_error(model: &PackedModel, error: Option<f64>, limit: u32) -> Result<Vec<u32>, PackError> {
    let scorer = match error {
        Some(error) => Scorer::by_error((error / model.info().lattice.step) as f32),
        None => Scorer::complete(),
    };
    Ok(select(model, &scorer, limit, PageAccess::Blocking)?.ops)
}

/// Whether P* is known without a look: all ops there are, which can be read, too.
pub(super) fn asks_for_all(model: &PackedModel, access: PageAccess, view: &View) -> bool {
    let can_read = access == PageAccess::Blocking || model.is_all_ready();
    view.complete && u64::from(view.triangle_limit) >= model.info().triangles && can_read
}

/// Computes P* for a view under a triangle limit, or as much of it as can be told from the pages that were read.
pub(crate) fn select(
    model: &PackedModel,
    scorer: &Scorer,
    limit: u32,
    access: PageAccess,
) -> Result<Selection, PackError> {
    let mut walk = Walk {
        model,
        scorer,
        pages: Pages { model, access, missing: Vec::new() },
        heap: BinaryHeap::new(),
        spawns: Spawns { next_page: 0, largest_error: f32::INFINITY },
        sweep: Sweep::default(),
        out: Selection { triangles: model.base().faces.len() as u32, lambda: scorer.threshold(), ..Default::default() },
    };
    for &op in model.base_first_splits() {
        walk.offer(op)?;
    }
    let mut closure = Closure::default();
    // How much was selected when the first page was missing, and its triangles: all that is certain to come first.
    let mut certain = None;
    loop {
        walk.offer_spawns(limit)?;
        if certain.is_none() && !walk.pages.missing.is_empty() {
            certain = Some((walk.out.ops.len(), walk.out.triangles));
        }
        let Some(key) = walk.heap.pop() else { break };
        let (priority, op) = unpack(key);
        if !walk.out.set.contains(&op) {
            match walk.take(op, limit, &mut closure)? {
                Fit::All => {}
                Fit::SkippedSpawn => {
                    walk.leave_out(priority, op)?;
                    continue;
                }
                Fit::Part => {
                    walk.leave_out(priority, op)?;
                    break;
                }
                Fit::NotYet => continue,
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
    if walk.out.is_limited && scorer.weighs_errors() {
        // What comes later has no larger priority, but it may have a larger error.
        for key in std::mem::take(&mut walk.heap) {
            let (priority, op) = unpack(key);
            if !walk.out.set.contains(&op) {
                walk.leave_out(priority, op)?;
            }
        }
    }
    let mut out = walk.out;
    if let Some((count, triangles)) = certain
        && u64::from(limit) < model.info().triangles
    {
        // What is missing may leave no room for the rest, and what is sent in vain is sent twice.
        out.ops.drain(count..).for_each(|op| _ = out.set.remove(&op));
        out.triangles = triangles;
    }
    out.missing = walk.pages.missing;
    Ok(out)
}

struct Walk<'a> {
    model: &'a PackedModel,
    scorer: &'a Scorer,
    pages: Pages<'a>,
    heap: BinaryHeap<u64>,
    spawns: Spawns,
    sweep: Sweep,
    out: Selection,
}

/// The pages of ops that a walk may look into.
struct Pages<'a> {
    model: &'a PackedModel,
    access: PageAccess,
    missing: Vec<PageId>,
}

impl Pages<'_> {
    /// Whether a page can be used now; else it is noted.
    #[inline]
    fn has(&mut self, page: PageId) -> bool {
        if self.access == PageAccess::Blocking || self.model.is_ready(page) {
            return true;
        }
        self.note(page);
        false
    }

    #[cold]
    fn note(&mut self, page: PageId) {
        // Ops of one page mostly come soon after one another; what slips through costs the reader a look.
        if self.missing.len() < MAX_MISSING && !self.missing.iter().rev().take(64).any(|&noted| noted == page) {
            self.missing.push(page);
        }
    }

    /// Whether the page of an op can be used, and of a spawn that of its patch too.
    #[inline]
    fn has_op(&mut self, op: u32) -> bool {
        self.has(PackedModel::page_of(op))
            && (op >= self.model.spawn_count() || self.has(PackedModel::patch_page_of(op)))
    }
}

/// Which spawns were judged: all those before a page.
struct Spawns {
    next_page: u32,
    /// No later spawn has a larger error, in lattice steps.
    largest_error: f32,
}

enum Fit {
    All,
    Part,
    SkippedSpawn,
    NotYet,
}

/// Orders by priority descending, then id ascending, as a max-heap key. Priorities are not negative, so their bits order
/// like the numbers.
pub(super) fn pack(priority: f32, op: u32) -> u64 {
    u64::from(priority.to_bits()) << 32 | u64::from(!op)
}

pub(super) fn unpack(key: u64) -> (f32, u32) {
    (f32::from_bits((key >> 32) as u32), !(key as u32))
}

impl Walk<'_> {
    fn offer(&mut self, op: u32) -> Result<(), PackError> {
        if op == NO_OP || !self.pages.has(PackedModel::page_of(op)) {
            return Ok(());
        }
        self.judge(op, &self.model.bounds(op)?);
        Ok(())
    }

    fn judge(&mut self, op: u32, bounds: &Bounds) {
        let priority = self.scorer.priority(bounds);
        if self.scorer.wants(priority) {
            self.heap.push(pack(priority, op));
        } else {
            self.out.error = self.out.error.max(priority);
        }
    }

    /// Judges the next spawns as long as one of them may come before what the walk would take next.
    fn offer_spawns(&mut self, limit: u32) -> Result<(), PackError> {
        let pages = self.model.spawn_count().div_ceil(PAGE_OPS);
        while self.spawns.next_page < pages {
            let most = self.scorer.most_of_spawn(self.spawns.largest_error);
            if !self.scorer.wants(most) {
                self.out.error = self.out.error.max(most);
                break;
            }
            if self.heap.peek().is_some_and(|&key| most < unpack(key).0) || self.is_full(limit) {
                break;
            }
            let page = self.spawns.next_page;
            if !self.pages.has(PageId::Ops(page)) {
                (page + 1..pages.min(page + SPAWN_PAGES_AHEAD)).for_each(|page| _ = self.pages.has(PageId::Ops(page)));
                // What these hold comes before what the others do, so there is nothing more to tell.
                self.spawns.next_page = pages;
                break;
            }
            self.judge_spawns(page)?;
            self.spawns.next_page += 1;
        }
        Ok(())
    }

    fn judge_spawns(&mut self, page: u32) -> Result<(), PackError> {
        let tests = self.model.tests(page)?;
        let rows = ((self.model.spawn_count() - tests.first_op) as usize).min(tests.error.len());
        let mut sweep = std::mem::take(&mut self.sweep);
        let most = sweep.judge(self.scorer, &tests);
        let wanted: Vec<usize> =
            (0..rows).filter(|&row| self.scorer.wants(most[row]) || most[row] > self.out.error).collect();
        for row in wanted {
            self.judge(tests.first_op + row as u32, &sweep.bounds(&tests, row));
        }
        self.sweep = sweep;
        if let Some(&last) = tests.error[..rows].last() {
            self.spawns.largest_error = Magnitude(last).decode();
        }
        Ok(())
    }

    /// Whether the limit has kept something out and no spawn fits any more.
    fn is_full(&self, limit: u32) -> bool {
        self.out.is_limited && limit.saturating_sub(self.out.triangles) < self.model.smallest_spawn()
    }

    fn leave_out(&mut self, priority: f32, op: u32) -> Result<(), PackError> {
        if !self.out.is_limited {
            self.out.is_limited = true;
            self.out.lambda = self.out.lambda.max(priority);
        }
        self.out.error = self.out.error.max(self.scorer.missing(priority, &self.model.bounds(op)?));
        Ok(())
    }

    /// Applies an op with its closure, as far as it fits.
    fn take(&mut self, op: u32, limit: u32, closure: &mut Closure) -> Result<Fit, PackError> {
        let room = limit.saturating_sub(self.out.triangles);
        if room == 0 {
            // Every op adds a triangle, so nothing else will fit either.
            return Ok(Fit::Part);
        }
        if op < self.model.spawn_count() && self.model.spawn_triangles(op)? > room {
            return Ok(Fit::SkippedSpawn);
        }
        let Self { pages, out, .. } = self;
        if !closure.gather(self.model, op, |op| out.set.contains(&op), |op| pages.has_op(op))? {
            return Ok(Fit::NotYet);
        }
        for &op in &closure.ops {
            let triangles = self.model.triangles_of(op)?;
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
