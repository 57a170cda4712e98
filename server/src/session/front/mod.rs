//! The set of ops that a view asks for, kept from view to view: P* by what changed instead of anew.
//!
//! The result is that of [`select`](super::select::select), which walks the whole view and is the twin in the tests. What is kept:
//! - the *wanted* ops, of priority over a threshold. Priorities fall along the vertex forest, so only wanted ops without wanted
//!   children may cease to be, and only their unwanted children may begin to;
//! - their closure under parents, by counting for each op the members that have it as a parent;
//! - for each wanted op a row: bounds of the sizes and depths that these answers rest on, which hold as the camera moves ([`motion`]). An
//!   update looks at the rows that are due (`look`), found by a scan of 28 bytes a row.
//!
//! The threshold is the tolerance as long as the closure fits the triangle limit. Where it does not, the threshold stays where the closure
//! takes 96 to 100 % of the limit while the camera moves ([`Effort::Moving`]), and goes along with the sizes from view to view; else 98.5 to 100 %, and
//! the rest is filled best-first, in the order that `select` has.
//!
//! Cost of an update: a few nanoseconds a row, and some 100 ns for each row that is due and each op that comes or goes.

mod fill;
mod look;
mod motion;
mod rows;
mod trend;

use std::collections::HashMap;

use glam::DQuat;
use lodestream_protocol::view::View;

pub(super) use self::fill::Closure;
use self::motion::Motion;
use self::rows::{CHILD_IS_WANTED, Due, FILLS, Rows, TOUCHED, WANTED, WAS_MEMBER};
use self::trend::Trend;
use super::score::Scorer;
use super::select::PageAccess;
use crate::pack::record::NO_OP;
use crate::pack::{PAGE_OPS, PackError, PackedModel, PageId};

/// Share of the limit that the wanted ops and their parents take at least, where the limit binds.
const LOW_WATER: f64 = 0.985;
/// Where an adjusted threshold aims.
const AIM: f64 = 0.994;
/// The same while the camera moves: a threshold that is moved seldom costs less, and few see a twenty-fifth of the triangles missing.
const MOVING_LOW_WATER: f64 = 0.96;
const MOVING_AIM: f64 = 0.993;
/// How the size of a closure falls with the threshold: by about the power -1.6.
const THRESHOLD_POWER: f64 = 0.6;
/// Where a threshold of zero is raised to.
const SMALLEST_THRESHOLD: f32 = 1.0 / 1024.0;
/// Steps after which nothing is wanted for its own sake, rather than to look for a threshold any longer.
const MOST_RAISES: u32 = 80;
/// A closure that outgrows the limit by this share is given up and the threshold raised.
const OVERSHOOT: u32 = 4;
/// While the camera moves, an op may be larger than the threshold by this factor before it is taken in, and smaller before it goes. What comes
/// near the threshold is otherwise looked at again and again before it has passed it.
const MOVING_FACTOR: f32 = 1.1;

/// How far an update goes where the triangle limit binds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Effort {
    /// To a set that is closed under parents: the next view will come at once. Where the limit binds it takes nearly all of that; elsewhere ops
    /// whose sizes are within [`MOVING_FACTOR`] of the tolerance may be in it or not.
    Moving,
    /// To P*.
    Exact,
}

/// What an update changed, and what the set is now.
#[derive(Debug, Default)]
pub(crate) struct Update {
    /// Ops that joined, in no order.
    pub(crate) joined: Vec<u32>,
    /// Ops that left, in no order.
    pub(crate) left: Vec<u32>,
    /// See [`Selection`](super::select::Selection).
    pub(crate) lambda: f32,
    /// Where the limit binds; elsewhere [`Front::error`] tells.
    pub(crate) error: Option<f32>,
    pub(crate) is_limited: bool,
    /// Pages without which the set is a part of P*, those of the most important ops first.
    pub(crate) missing: Vec<PageId>,
    /// No threshold was found: the front is to be dropped.
    pub(crate) has_failed: bool,
    /// Whether [`Effort::Exact`] may find more.
    pub(crate) is_rough: bool,
    /// Rows that were looked at, for measurements.
    pub(crate) tested: u32,
}

/// See the module.
#[derive(Debug, Default)]
pub(crate) struct Front {
    rows: Rows,
    /// Spawns that were looked at so far: those of the first pages.
    spawns: Vec<SpawnRow>,
    motion: Motion,
    /// What a view is but for its eye and orientation, and for what each test of a row is told: near plane, tolerance and limit.
    kind: Option<View>,
    tolerance: f32,
    /// Ops of higher priority are wanted.
    threshold: f32,
    /// Triangles of base and closure.
    triangles: u32,
    fills: Vec<u32>,
    /// Rows that may have changed, with their ops as in `work`.
    touched: Vec<u64>,
    trend: Trend,
    /// Threshold of the front that was there before, if any.
    before: Option<f32>,
    /// Eye and orientation of the last view.
    pose: Option<([f64; 3], [f32; 4])>,
    // Work space.
    /// Rows to look at, each once, with their ops above them: rows stay where they are during an update.
    work: Vec<u64>,
    /// Those of them that are looked at in this pass.
    pass: Vec<u64>,
    stack: Vec<u32>,
    /// Ops of a closure whose pages are missing.
    unread: Vec<u32>,
    closure: Closure,
}

#[derive(Clone, Copy, Debug)]
struct SpawnRow {
    due: Due,
    cell: u8,
}

/// What an update works with.
struct Context<'a> {
    model: &'a PackedModel,
    scorer: &'a Scorer,
    pages: Pages<'a>,
    limit: u32,
    /// Factor between the threshold and the sizes at which an answer counts as changed.
    leniency: f32,
    tested: u32,
}

/// The pages that may be looked into, and those that are missing with the priority of what they are needed for.
struct Pages<'a> {
    model: &'a PackedModel,
    access: PageAccess,
    missing: HashMap<PageId, u32>,
}

impl Pages<'_> {
    #[inline]
    fn has(&mut self, page: PageId, priority: f32) -> bool {
        if self.access == PageAccess::Blocking || self.model.is_ready(page) {
            return true;
        }
        let most = self.missing.entry(page).or_default();
        *most = (*most).max(priority.to_bits());
        false
    }

    /// Whether the page of an op can be used, and of a spawn that of its patch too.
    #[inline]
    fn has_op(&mut self, op: u32, priority: f32) -> bool {
        self.has(PackedModel::page_of(op), priority)
            && (op >= self.model.spawn_count() || self.has(PackedModel::patch_page_of(op), priority))
    }
}

impl Front {
    /// Whether [`update`](Self::update) can follow such a view: complete ones do not depend on the camera, and [`select`](super::select::select) does them.
    pub(crate) fn follows(view: &View) -> bool {
        !view.complete
    }

    /// Members, in no order.
    pub(crate) fn members(&self) -> impl Iterator<Item = u32> + '_ {
        self.rows.ops.iter().zip(&self.rows.states).filter(|(_, state)| state.is_member()).map(|(&op, _)| op)
    }

    pub(crate) fn has(&self, op: u32) -> bool {
        self.rows.state(op).is_member()
    }

    /// A front that begins anew where this one is: with its threshold, which probably fits what comes after a rest.
    pub(crate) fn anew(&self) -> Self {
        let before = if self.kind.is_some() { Some(self.threshold) } else { self.before };
        Self { before, ..Self::default() }
    }

    /// Makes room for so many members, if nothing was looked at yet.
    pub(crate) fn reserve(&mut self, members: usize) {
        if self.kind.is_none() {
            self.rows.reserve(members);
        }
    }

    pub(crate) fn heap_bytes(&self) -> usize {
        let work = 2 * (self.work.capacity() + self.pass.capacity() + self.touched.capacity());
        let lists = self.fills.capacity() + work + self.stack.capacity();
        self.rows.heap_bytes() + self.motion.heap_bytes() + self.spawns.capacity() * size_of::<SpawnRow>() + lists * 4
    }

    /// Makes the set that of `view`, for which `scorer` was made.
    ///
    /// # Errors
    /// [`PackError`] if a page is damaged; the front is to be dropped then.
    pub(crate) fn update(
        &mut self,
        model: &PackedModel,
        scorer: &Scorer,
        view: &View,
        access: PageAccess,
        effort: Effort,
    ) -> Result<Update, PackError> {
        let pages = Pages { model, access, missing: HashMap::new() };
        // Without a view before there is nothing that could stay as it is, a limit that binds moves the threshold for all ops, and a camera that
        // stands where it stood costs little anyway.
        let pose = (view.eye, view.orientation);
        let has_moved = self.pose.replace(pose).is_some_and(|before| before != pose);
        let is_lenient = effort == Effort::Moving && has_moved && self.threshold <= scorer.threshold();
        let leniency = if is_lenient { MOVING_FACTOR } else { 1.0 };
        let mut context = Context { model, scorer, pages, limit: view.triangle_limit, leniency, tested: 0 };
        self.begin(&mut context, view);
        let is_bound = self.threshold > self.tolerance;
        match effort {
            Effort::Moving if is_bound => self.threshold = self.trend.ahead(self.threshold).max(self.tolerance),
            _ => self.trend.stop(),
        }
        let filled = self.adjust(&mut context, effort)?;
        if effort == Effort::Moving && self.threshold > self.tolerance {
            self.trend.note(self.threshold, self.triangles, context.limit);
        }
        let mut out = Update {
            lambda: scorer.threshold(),
            missing: ordered(context.pages.missing),
            tested: context.tested,
            ..Update::default()
        };
        out.has_failed = filled.is_some_and(|filled| filled.has_failed);
        out.is_rough = is_lenient || filled.is_some_and(|filled| filled.is_rough);
        if let Some(filled) = filled.filter(|filled| filled.is_limited) {
            (out.lambda, out.error, out.is_limited) = (filled.lambda, Some(filled.error), true);
        }
        let touched = self.touched.len();
        // Rows stay where they are until all of these were looked at.
        self.stack.clear();
        for entry in self.touched.drain(..) {
            let (op, row) = ((entry >> 32) as u32, entry as u32 as usize);
            let state = &mut self.rows.states[row];
            let was_member = state.flags & WAS_MEMBER != 0;
            state.flags &= !(TOUCHED | WAS_MEMBER);
            let is_member = state.is_member();
            if is_member && !was_member {
                out.joined.push(op);
            }
            if !is_member {
                self.stack.push(op);
                if was_member {
                    out.left.push(op);
                }
            }
        }
        for op in self.stack.drain(..) {
            self.rows.remove(op);
        }
        self.rows.give_back();
        // A first view touches as much as a thousand others.
        give_back(&mut self.touched, touched);
        give_back(&mut self.work, touched);
        give_back(&mut self.pass, touched);
        give_back(&mut self.stack, touched);
        Ok(out)
    }

    /// Moves the camera, and marks what that does not cover as due.
    fn begin(&mut self, context: &mut Context<'_>, view: &View) {
        let kind = View {
            eye: [0.0; 3],
            orientation: DQuat::IDENTITY.as_quat().to_array(),
            near: 1.0,
            tolerance_px: 0.0,
            triangle_limit: 0,
            ..view.clone()
        };
        let tolerance = context.scorer.threshold();
        if self.kind.is_none() {
            self.triangles = context.model.base().faces.len() as u32;
            // From above, so that a first view under a limit is not overshot.
            let may_bind = u64::from(context.limit) < context.model.info().triangles;
            let high = self.before.map_or(f32::MAX, |before| before.max(tolerance));
            self.threshold = if may_bind { high } else { tolerance };
        } else if self.tolerance != tolerance {
            // Where the limit binds, the tolerance only matters once it is over the threshold.
            let is_limited = self.threshold > self.tolerance;
            self.threshold = if is_limited { self.threshold.max(tolerance) } else { tolerance };
        }
        self.tolerance = tolerance;
        if self.kind.as_ref() != Some(&kind) {
            self.kind = Some(kind);
            self.rows.dues.iter_mut().zip(&self.rows.states).for_each(|(due, state)| {
                if state.flags & WANTED != 0 {
                    *due = Due::NOW;
                }
            });
            self.spawns.iter_mut().for_each(|spawn| spawn.due = Due::NOW);
        }
        if let Some(sums) = self.motion.go_on(context.scorer) {
            let dues = self.rows.dues.iter_mut().zip(&self.rows.states).map(|(due, state)| (due, state.cell));
            let spawns = self.spawns.iter_mut().map(|spawn| (&mut spawn.due, spawn.cell));
            dues.chain(spawns).for_each(|(due, cell)| due.rebase(&sums, cell));
        }
        self.drop_fills();
    }

    /// Brings the wanted ops up to date, finds the threshold at which their closure fits, and fills the rest.
    fn adjust(&mut self, context: &mut Context<'_>, effort: Effort) -> Result<Option<fill::Filled>, PackError> {
        let tolerance = context.scorer.threshold();
        let limit = context.limit;
        let mut steps = 0;
        // The highest threshold that was too low, in this update.
        let mut too_low = None;
        let mut has_fitted = false;
        loop {
            steps += 1;
            self.refresh(context)?;
            // Only what was there at the tolerance may stay as it is: a threshold that the limit moves is moved for all ops.
            context.leniency = 1.0;
            if steps > 2 * MOST_RAISES {
                return Ok(Some(fill::Filled { has_failed: true, ..fill::Filled::default() }));
            }
            if !context.pages.missing.is_empty() && u64::from(limit) < context.model.info().triangles {
                // The set is of no use then, see `Goal::aim`, and no threshold would fit.
                return Ok(None);
            }
            let share = f64::from(self.triangles) / f64::from(limit.max(1));
            let (low_water, aim) = match effort {
                Effort::Moving => (MOVING_LOW_WATER, MOVING_AIM),
                Effort::Exact => (LOW_WATER, AIM),
            };
            let factor = (share / aim).powf(THRESHOLD_POWER) as f32;
            if self.triangles > limit {
                too_low = Some(self.threshold);
                let is_far = self.triangles > limit.saturating_add(limit / OVERSHOOT) || steps > 40;
                let factor = if is_far { 2.0 } else { factor.clamp(1.005, 2.0) };
                self.threshold = (self.threshold * factor).max(SMALLEST_THRESHOLD);
                if steps > MOST_RAISES {
                    // A view may make sizes of any magnitude, infinite ones too: nothing is wanted for its own sake then.
                    self.threshold = f32::INFINITY;
                    self.rows.dues.fill(Due::NOW);
                }
                continue;
            }
            if self.threshold <= tolerance {
                return Ok(None);
            }
            if share < low_water && steps < 64 && !has_fitted {
                let highest = if self.threshold >= f32::MAX { self.highest_root(context)? } else { f32::MAX };
                let next = (self.threshold * factor.max(0.5)).min(highest);
                let next = next.max(too_low.map_or(tolerance, |low| (low * self.threshold).sqrt()));
                if next < 0.998 * self.threshold {
                    self.threshold = next;
                    continue;
                }
            }
            if effort == Effort::Moving {
                return Ok(Some(fill::Filled::rough(self.threshold)));
            }
            let filled = self.fill(context)?;
            if filled.is_limited || has_fitted {
                return Ok(Some(filled));
            }
            // Everything fits after all.
            has_fitted = true;
            self.drop_fills();
            self.threshold = tolerance;
        }
    }

    fn drop_fills(&mut self) {
        for i in 0..self.fills.len() {
            let row = self.touch(self.fills[i]);
            self.rows.states[row].flags &= !FILLS;
        }
        self.fills.clear();
    }

    /// Largest priority of a root.
    fn highest_root(&mut self, context: &mut Context<'_>) -> Result<f32, PackError> {
        let mut highest = context.scorer.most_of_spawn(self.largest_unseen_spawn(context.model)?);
        for &op in context.model.base_first_splits() {
            if op != NO_OP && context.pages.has(PackedModel::page_of(op), f32::MAX) {
                highest = highest.max(context.scorer.priority(&context.model.bounds(op)?));
            }
        }
        Ok(highest)
    }

    /// Largest error of a spawn that was not looked at, in lattice steps.
    fn largest_unseen_spawn(&self, model: &PackedModel) -> Result<f32, PackError> {
        match (self.spawns.len() as u32).checked_sub(1) {
            _ if self.spawns.len() as u32 == model.spawn_count() => Ok(0.0),
            None => Ok(f32::INFINITY),
            Some(last) => Ok(model.bounds(last)?.error.decode()),
        }
    }

    /// Takes up the spawns, page by page, as long as the next may be of higher priority than `least`.
    fn see_spawns(&mut self, context: &mut Context<'_>, least: f32) -> Result<(), PackError> {
        let count = context.model.spawn_count();
        while (self.spawns.len() as u32) < count {
            let most = context.scorer.most_of_spawn(self.largest_unseen_spawn(context.model)?);
            if most <= least {
                break;
            }
            let page = self.spawns.len() as u32 / PAGE_OPS;
            if !context.pages.has(PageId::Ops(page), most) {
                let pages = count.div_ceil(PAGE_OPS);
                (page + 1..pages.min(page + super::select::SPAWN_PAGES_AHEAD))
                    .for_each(|page| _ = context.pages.has(PageId::Ops(page), most));
                break;
            }
            let end = count.min((page + 1) * PAGE_OPS) as usize;
            self.spawns.resize(end, SpawnRow { due: Due::NOW, cell: 0 });
        }
        Ok(())
    }

    /// Takes an op in with its closure, unless a page of that is missing, and will look at it.
    fn want(&mut self, context: &mut Context<'_>, op: u32, priority: f32) -> Result<bool, PackError> {
        let row = self.touch(op);
        let state = &mut self.rows.states[row];
        let was_in = state.is_closed_in();
        state.flags |= WANTED;
        self.rows.dues[row] = Due::NOW;
        if !was_in && !self.enter(context, op, priority)? {
            self.rows.states[row].flags &= !WANTED;
            self.rows.dues[row] = Due::NEVER;
            self.withdraw(context, op)?;
            return Ok(false);
        }
        self.queue(op, row);
        Ok(true)
    }

    /// Counts in the closure of an op that has come in. False if a page of it is missing: then as much of it as can be read was counted, and is to be
    /// [withdrawn](Self::withdraw); pages of all its branches are asked for.
    fn enter(&mut self, context: &mut Context<'_>, op: u32, priority: f32) -> Result<bool, PackError> {
        self.stack.push(op);
        while let Some(op) = self.stack.pop() {
            if !context.pages.has_op(op, priority) {
                self.unread.push(op);
                continue;
            }
            self.triangles += context.model.triangles_of(op)?;
            for &parent in context.model.prerequisites(op)?.as_slice() {
                let row = self.touch(parent);
                let state = &mut self.rows.states[row];
                let was_in = state.is_closed_in();
                state.references = state.references.checked_add(1).ok_or_else(too_many)?;
                if !was_in {
                    self.stack.push(parent);
                }
            }
        }
        Ok(self.unread.is_empty())
    }

    /// Takes the closure of an op out that does not belong to it any more, but for what others need.
    fn withdraw(&mut self, context: &Context<'_>, op: u32) -> Result<(), PackError> {
        self.stack.push(op);
        while let Some(op) = self.stack.pop() {
            // A page may have come since.
            if self.unread.contains(&op) {
                continue;
            }
            self.triangles -= context.model.triangles_of(op)?;
            for &parent in context.model.prerequisites(op)?.as_slice() {
                let row = self.touch(parent);
                let state = &mut self.rows.states[row];
                state.references -= 1;
                if !state.is_closed_in() {
                    self.stack.push(parent);
                }
            }
        }
        self.unread.clear();
        Ok(())
    }

    /// The op is not wanted any more, and its forest parent will be looked at.
    fn leave(&mut self, context: &mut Context<'_>, op: u32, row: usize) -> Result<(), PackError> {
        if op < context.model.spawn_count() {
            self.spawns[op as usize].due = Due::NOW;
        } else {
            let (parent, side) = context.model.tree_parent_of(op)?;
            // It has a row unless the pack contradicts itself.
            if parent != NO_OP
                && let Some(row) = self.rows.find(parent)
            {
                if parent >= context.model.spawn_count() {
                    self.rows.states[row].flags &= !CHILD_IS_WANTED[side as usize];
                }
                self.queue(parent, row);
            }
        }
        self.note(op, row);
        let state = &mut self.rows.states[row];
        state.flags &= !WANTED;
        let is_in = state.is_closed_in();
        self.rows.dues[row] = Due::NEVER;
        if is_in { Ok(()) } else { self.withdraw(context, op) }
    }

    /// The row of an op, noted as one that may change.
    #[inline]
    fn touch(&mut self, op: u32) -> usize {
        let row = self.rows.ensure(op);
        self.note(op, row);
        row
    }

    #[inline]
    fn note(&mut self, op: u32, row: usize) {
        let state = &mut self.rows.states[row];
        if state.flags & TOUCHED == 0 {
            state.flags |= if state.is_member() { TOUCHED | WAS_MEMBER } else { TOUCHED };
            self.touched.push(u64::from(op) << 32 | row as u64);
        }
    }

    /// Not less than the priority of any op that hangs on a row and is not wanted.
    #[inline]
    fn most_below(&self, row: usize, near: f32) -> f32 {
        self.rows.dues[row].most_priority(self.motion.sums(), self.rows.states[row].cell, near)
    }

    /// Likewise of a spawn that is not wanted.
    #[inline]
    fn most_of_spawn_row(&self, spawn: u32, near: f32) -> f32 {
        let SpawnRow { due, cell } = &self.spawns[spawn as usize];
        due.most_priority(self.motion.sums(), *cell, near)
    }

    /// Largest priority of an op that is not wanted in the view of the last update, where no limit binds. A few nanoseconds a row.
    ///
    /// # Errors
    /// [`PackError`] if a page is damaged.
    pub(crate) fn error(&self, model: &PackedModel, scorer: &Scorer, access: PageAccess) -> Result<f32, PackError> {
        let is_ready = |op: u32| access == PageAccess::Blocking || model.is_ready(PackedModel::page_of(op));
        let is_out = |op: u32| op != NO_OP && is_ready(op) && self.rows.state(op).flags & WANTED == 0;
        let near = down(scorer.near());
        let mut error = 0f32;
        for &op in model.base_first_splits().iter().filter(|&&op| is_out(op)) {
            error = error.max(scorer.priority(&model.bounds(op)?));
        }
        // Spawns are judged page by page as far as they may matter, and what comes then is bounded.
        let mut largest = f32::INFINITY;
        for page in 0..model.spawn_count().div_ceil(PAGE_OPS) {
            let most = scorer.most_of_spawn(largest);
            if !scorer.wants(most) {
                error = error.max(most);
                break;
            }
            let spawns = page * PAGE_OPS..model.spawn_count().min((page + 1) * PAGE_OPS);
            if spawns.end as usize > self.spawns.len() {
                break;
            }
            largest = model.bounds(spawns.end - 1)?.error.decode();
            for op in spawns {
                if self.most_of_spawn_row(op, near) > error && is_out(op) {
                    error = error.max(scorer.priority(&model.bounds(op)?));
                }
            }
        }
        // A row bounds what its children matter, so few have to be looked at once the largest is nearly known.
        for share in [0.9, 0.0] {
            let least = share * scorer.threshold();
            for row in 0..self.rows.ops.len() {
                if self.most_below(row, near) > error.max(least) && self.rows.states[row].flags & WANTED != 0 {
                    for child in Children::of(model, self.rows.ops[row])?.filter(|&op| is_out(op)) {
                        error = error.max(scorer.priority(&model.bounds(child)?));
                    }
                }
            }
            if error > least {
                break;
            }
        }
        Ok(error)
    }
}

/// Gives memory back that is far more than what was used.
pub(super) fn give_back<T>(list: &mut Vec<T>, used: usize) {
    if list.capacity() > (8 * used).max(1024) {
        list.shrink_to(2 * used);
    }
}

/// Rounded up and down.
#[inline]
fn up(x: f64) -> f32 {
    let rounded = x as f32;
    if f64::from(rounded) < x { rounded.next_up() } else { rounded }
}

#[inline]
fn down(x: f64) -> f32 {
    let rounded = x as f32;
    if f64::from(rounded) > x { rounded.next_down() } else { rounded }
}

fn too_many() -> PackError {
    PackError::Damaged { section: "ops", reason: "an op is a parent of more than 65,535 others".into() }
}

/// Children of an op in the vertex forest, [`NO_OP`] among them.
enum Children {
    Split(std::array::IntoIter<u32, 2>),
    Spawn(std::vec::IntoIter<u32>),
}

impl Children {
    #[inline]
    fn of(model: &PackedModel, op: u32) -> Result<Self, PackError> {
        Ok(if op < model.spawn_count() {
            Self::Spawn(model.spawn_first_splits(op)?.into_iter())
        } else {
            Self::Split(model.children(op)?.into_iter())
        })
    }
}

impl Iterator for Children {
    type Item = u32;

    #[inline]
    fn next(&mut self) -> Option<u32> {
        match self {
            Self::Split(ops) => ops.next(),
            Self::Spawn(ops) => ops.next(),
        }
    }
}

/// The most important first.
fn ordered(missing: HashMap<PageId, u32>) -> Vec<PageId> {
    let mut missing: Vec<(PageId, u32)> = missing.into_iter().collect();
    missing.sort_unstable_by(|a, b| b.1.cmp(&a.1).then(a.0.cmp(&b.0)));
    missing.truncate(super::select::MAX_MISSING);
    missing.into_iter().map(|(page, _)| page).collect()
}

#[cfg(test)]
mod tests;
