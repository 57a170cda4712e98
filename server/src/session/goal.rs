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

/// See the module. Kept as long as the session.
#[derive(Debug, Default)]
pub(super) struct Goal {
    front: Front,
    /// Members of the front that were not applied, and applied ops that are no members, as of the last view; less by now.
    waiting: Vec<u32>,
    stale: Vec<u32>,
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
        self.front.heap_bytes() + (self.waiting.capacity() + self.stale.capacity()) * 4
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
        let Self { front, waiting, stale, is_known } = self;
        if *is_known {
            waiting.extend_from_slice(&update.joined);
            stale.extend_from_slice(&update.left);
        } else {
            (*waiting, *stale) = (front.members().collect(), mirror.applied().map(|(op, _)| op).collect());
            *is_known = true;
        }
        tidy(waiting, |op| front.has(op) && !mirror.is_applied(op));
        tidy(stale, |op| mirror.is_applied(op) && !front.has(op));
        Ok(Aim {
            pending: sending_order(model, &scorer, waiting)?,
            stale: judged(model, &scorer, stale)?,
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
        let stale: Vec<u32> = mirror.applied().map(|(op, _)| op).filter(|op| !selection.set.contains(op)).collect();
        Ok(Aim {
            pending: sending_order(model, scorer, &waiting)?,
            stale: judged(model, scorer, &stale)?,
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
fn tidy(ops: &mut Vec<u32>, mut counts: impl FnMut(u32) -> bool) {
    ops.retain(|&op| counts(op));
    ops.sort_unstable();
    ops.dedup();
    let used = ops.len();
    give_back(ops, used);
}

fn judged(model: &PackedModel, scorer: &Scorer, ops: &[u32]) -> Result<Vec<(u32, f32)>, PackError> {
    ops.iter().map(|&op| Ok((op, scorer.priority(&model.bounds(op)?)))).collect()
}
