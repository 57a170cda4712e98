//! What the current view asks for against what the client holds: ops to apply, in the order in which they are sent, and ops
//! that the view left behind.
//!
//! Both follow from view to view by what changed in the [`Front`]. Where that cannot tell (complete views, pages that are missing
//! under a limit) the whole view is walked instead.

use lodestream_protocol::view::View;

use super::front::{Effort, Front, give_back};
use super::mirror::Mirror;
use super::order::sending_order;
use super::score::Scorer;
use super::select::{PageAccess, select};
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
    /// With what each mattered when it was judged last.
    stale: Vec<(u32, Option<f32>)>,
    /// Which part of the stale ops the next view judges again.
    turn: u32,
    /// Whether these two are right.
    is_known: bool,
}

/// What one view asks for.
#[derive(Debug)]
pub(super) struct Aim {
    /// Ops to apply, parents first.
    pub(super) pending: Vec<u32>,
    /// Applied ops that the view does not ask for, with what they matter to it.
    pub(super) stale: Vec<(u32, f32)>,
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
    pub(super) fn heap_bytes(&self) -> usize {
        self.front.heap_bytes() + self.waiting.capacity() * 4 + self.stale.capacity() * size_of::<(u32, Option<f32>)>()
    }

    /// Forgets what the client holds, not what it looks at.
    pub(super) fn restart(&mut self) {
        self.is_known = false;
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
            waiting.extend_from_slice(&update.joined);
            stale.extend(update.left.iter().map(|&op| (op, None)));
        } else {
            *waiting = front.members().collect();
            *stale = mirror.applied().map(|(op, _)| (op, None)).collect();
            *is_known = true;
        }
        tidy(waiting, |&op| op, |op| front.has(op) && !mirror.is_applied(op));
        tidy(stale, |&(op, _)| op, |op| mirror.is_applied(op) && !front.has(op));
        *turn = (*turn + 1) % TURNS;
        Ok(Aim {
            pending: sending_order(model, &scorer, waiting)?,
            stale: judged(model, &scorer, stale, *turn)?,
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
        let selection = select(model, scorer, view.triangle_limit, access)?;
        let waiting: Vec<u32> = selection.ops.iter().copied().filter(|&op| !mirror.is_applied(op)).collect();
        let stale = mirror.applied().map(|(op, _)| op).filter(|op| !selection.set.contains(op));
        let mut stale: Vec<_> = stale.map(|op| (op, None)).collect();
        Ok(Aim {
            pending: sending_order(model, scorer, &waiting)?,
            stale: judged(model, scorer, &mut stale, 0)?,
            lambda: selection.lambda,
            error: Some(selection.error),
            is_limited: selection.is_limited,
            tested: 0,
            missing: selection.missing,
            is_rough: false,
        })
    }
}

/// Each op once, and only those that still count.
fn tidy<T>(list: &mut Vec<T>, op_of: impl Fn(&T) -> u32, mut counts: impl FnMut(u32) -> bool) {
    list.retain(|item| counts(op_of(item)));
    list.sort_unstable_by_key(&op_of);
    list.dedup_by_key(|item| op_of(item));
    let used = list.len();
    give_back(list, used);
}

/// Judges those that are new and those whose turn it is.
fn judged(
    model: &PackedModel,
    scorer: &Scorer,
    stale: &mut [(u32, Option<f32>)],
    turn: u32,
) -> Result<Vec<(u32, f32)>, PackError> {
    let judge = |(op, before): &mut (u32, Option<f32>)| {
        let priority = match *before {
            Some(priority) if *op % TURNS != turn => priority,
            _ => *before.insert(scorer.priority(&model.bounds(*op)?)),
        };
        Ok((*op, priority))
    };
    stale.iter_mut().map(judge).collect()
}
