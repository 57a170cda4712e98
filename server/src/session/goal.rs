//! What the current view asks for against what the client holds: ops to apply, in the order in which they are sent, and ops
//! that the view left behind.
//!
//! Both follow from view to view by what changed in the [`Front`]. Where that cannot tell (complete views, pages that are missing
//! under a limit) the whole view is walked instead.

use lodestream_protocol::mesh::SlotSet;
use lodestream_protocol::view::View;

use super::HYSTERESIS_SHARE;
use super::front::{Effort, Front, give_back};
use super::mirror::Mirror;
use super::order::sending_order;
use super::score::Scorer;
use super::select::{PageAccess, asks_for_all, select};
use crate::pack::{PackError, PackedModel, PageId};

/// Views after which what a stale op matters has been judged again. It only decides what lingers until the view has rested, and a moving view
/// leaves thousands behind.
const TURNS: u32 = 8;

/// See the module. Kept as long as the session.
#[derive(Debug, Default)]
pub(super) struct Goal {
    front: Front,
    /// Members of the front that were not applied, and applied ops that are no members, as of the last view; less by now.
    waiting: Vec<u32>,
    stale: Stale,
    /// Which part of the stale ops the next view judges again.
    turn: u32,
    /// Whether waiting and stale ops are right.
    is_known: bool,
}

/// Slots of applied ops that the view does not ask for. Whoever takes an op away removes its slot.
#[derive(Debug, Default)]
pub(super) struct Stale {
    pub(super) slots: SlotSet,
    /// Those among them that may stay until the view has rested.
    pub(super) reluctant: SlotSet,
    /// Whether the second of these is right.
    is_judged: bool,
}

/// What one view asks for.
#[derive(Debug)]
pub(super) struct Aim {
    /// Ops to apply, parents first.
    pub(super) pending: Vec<u32>,
    /// Priority at which the selection ended: the tolerance, or more when the limit binds.
    pub(super) lambda: f32,
    /// Largest priority of an op that was left out. None where it takes a search, see [`Goal::error`]: a view that moves on is not asked for it.
    pub(super) error: Option<f32>,
    pub(super) is_limited: bool,
    /// Ops that were judged for it one by one; none are counted where the view was walked.
    pub(super) tested: u32,
    /// Pages that have to be read before this is all, see [`select`](super::select::Selection::missing).
    pub(super) missing: Vec<PageId>,
    /// Whether [`Effort::Exact`] may find more.
    pub(super) is_rough: bool,
}

impl Goal {
    pub(super) fn front_bytes(&self) -> usize {
        self.front.heap_bytes()
    }

    /// Memory of what waits and of what is stale.
    pub(super) fn list_bytes(&self) -> usize {
        let stale = self.stale.slots.heap_bytes() + self.stale.reluctant.heap_bytes();
        self.waiting.capacity() * 4 + stale
    }

    /// What is to go, as of the last view; less by now.
    pub(super) fn stale(&mut self) -> &mut Stale {
        &mut self.stale
    }

    pub(super) fn has_stale(&self) -> bool {
        !self.stale.slots.is_empty()
    }

    /// Whether some of that may stay until the view has rested.
    pub(super) fn has_reluctant(&self) -> bool {
        !self.stale.reluctant.is_empty()
    }

    /// Forgets what the client holds, not what it looks at.
    pub(super) fn restart(&mut self) {
        self.is_known = false;
    }

    /// Gives memory back until the next view.
    pub(super) fn rest(&mut self) {
        *self = Self { front: self.front.anew(), ..Self::default() };
    }

    /// Takes aim at a view.
    ///
    /// # Errors
    /// [`PackError`] if a page is damaged.
    pub(super) fn aim(
        &mut self,
        model: &PackedModel,
        access: PageAccess,
        view: &View,
        mirror: &Mirror,
        effort: Effort,
    ) -> Result<Aim, PackError> {
        let scorer = Scorer::new(view, model.info());
        if !Front::follows(view) {
            return self.walk(model, access, view, mirror, &scorer);
        }
        // Mostly as much is wanted as was: what comes back from a rest grows at once.
        self.front.reserve(mirror.applied_count());
        let update = self.front.update(model, &scorer, view, access, effort)?;
        if update.has_failed {
            self.front = Front::default();
            return self.walk(model, access, view, mirror, &scorer);
        }
        let may_bind = u64::from(view.triangle_limit) < model.info().triangles;
        if may_bind && !update.missing.is_empty() {
            return self.walk(model, access, view, mirror, &scorer);
        }
        let Self { front, waiting, stale, turn, is_known } = self;
        if *is_known {
            for &op in &update.joined {
                match mirror.slot(op) {
                    Some(slot) => stale.keep(slot),
                    None => waiting.push(op),
                }
            }
            for &op in &update.left {
                if let Some(slot) = mirror.slot(op) {
                    stale.slots.insert(slot);
                    stale.judge(model, &scorer, op, slot, update.lambda)?;
                }
            }
            // Most of them were applied since.
            tidy(waiting, |op| !mirror.is_applied(op) && front.has(op));
        } else {
            *waiting = front.members().filter(|&op| !mirror.is_applied(op)).collect();
            *stale = Stale::of(mirror, |op| front.has(op));
            *is_known = true;
        }
        debug_assert!(
            stale.slots.iter().eq(Stale::of(mirror, |op| front.has(op)).slots.iter()),
            "what is stale has been lost track of"
        );
        *turn = (*turn + 1) % TURNS;
        stale.judge_some(model, &scorer, mirror, update.lambda, *turn)?;
        if !update.missing.is_empty() {
            stale.keep_all_for_now();
        }
        Ok(Aim {
            pending: sending_order(model, &scorer, waiting)?,
            lambda: update.lambda,
            error: update.error,
            is_limited: update.is_limited,
            tested: update.tested,
            missing: update.missing,
            is_rough: update.is_rough,
        })
    }

    /// The error of the last view, which `view` is, where [`aim`](Self::aim) did not tell.
    ///
    /// # Errors
    /// [`PackError`] if a page is damaged.
    pub(super) fn error(&self, model: &PackedModel, access: PageAccess, view: &View) -> Result<f32, PackError> {
        self.front.error(model, &Scorer::new(view, model.info()), access)
    }

    fn walk(
        &mut self,
        model: &PackedModel,
        access: PageAccess,
        view: &View,
        mirror: &Mirror,
        scorer: &Scorer,
    ) -> Result<Aim, PackError> {
        self.is_known = false;
        if asks_for_all(model, access, view) {
            self.stale = Stale::default();
            let waiting: Vec<u32> = (0..model.op_count()).filter(|&op| !mirror.is_applied(op)).collect();
            return Ok(Aim {
                pending: sending_order(model, scorer, &waiting)?,
                lambda: scorer.threshold(),
                error: Some(0.0),
                is_limited: false,
                tested: 0,
                missing: Vec::new(),
                is_rough: false,
            });
        }
        let selection = select(model, scorer, view.triangle_limit, access)?;
        let waiting: Vec<u32> = selection.ops.iter().copied().filter(|&op| !mirror.is_applied(op)).collect();
        self.stale = Stale::of(mirror, |op| selection.set.contains(&op));
        self.stale.judge_some(model, scorer, mirror, selection.lambda, 0)?;
        if !selection.missing.is_empty() {
            self.stale.keep_all_for_now();
        }
        Ok(Aim {
            pending: sending_order(model, scorer, &waiting)?,
            lambda: selection.lambda,
            error: Some(selection.error),
            is_limited: selection.is_limited,
            tested: 0,
            missing: selection.missing,
            is_rough: false,
        })
    }
}

impl Stale {
    /// The slots of all applied ops but those that are wanted.
    fn of(mirror: &Mirror, is_wanted: impl Fn(u32) -> bool) -> Self {
        let mut slots = SlotSet::default();
        mirror.applied().filter(|&(op, _)| !is_wanted(op)).for_each(|(_, slot)| _ = slots.insert(slot));
        Self { slots, reluctant: SlotSet::default(), is_judged: false }
    }

    /// The op of a slot is asked for again.
    fn keep(&mut self, slot: u32) {
        self.slots.remove(slot);
        self.reluctant.remove(slot);
    }

    /// Judges the op of a stale slot.
    fn judge(
        &mut self,
        model: &PackedModel,
        scorer: &Scorer,
        op: u32,
        slot: u32,
        lambda: f32,
    ) -> Result<(), PackError> {
        match scorer.priority(&model.bounds(op)?) > HYSTERESIS_SHARE * lambda {
            true => self.reluctant.insert(slot),
            false => self.reluctant.remove(slot),
        };
        Ok(())
    }

    /// Judges those whose turn it is, or all of them if they were not.
    fn judge_some(
        &mut self,
        model: &PackedModel,
        scorer: &Scorer,
        mirror: &Mirror,
        lambda: f32,
        turn: u32,
    ) -> Result<(), PackError> {
        let is_first = !std::mem::replace(&mut self.is_judged, true);
        let due: Vec<u32> = self.slots.iter().filter(|slot| is_first || slot / 64 % TURNS == turn).collect();
        for slot in due {
            if let Some(op) = mirror.op_at(slot) {
                self.judge(model, scorer, op, slot, lambda)?;
            }
        }
        Ok(())
    }

    /// What a part of P* leaves out may belong to the whole.
    fn keep_all_for_now(&mut self) {
        self.reluctant = self.slots.clone();
        self.is_judged = false;
    }

    /// Nothing stays any longer.
    pub(super) fn let_go(&mut self) {
        self.reluctant = SlotSet::default();
    }
}

/// Each op once, and only those that still count.
fn tidy(list: &mut Vec<u32>, counts: impl Fn(u32) -> bool) {
    list.retain(|&op| counts(op));
    list.sort_unstable();
    list.dedup();
    let used = list.len();
    give_back(list, used);
}
