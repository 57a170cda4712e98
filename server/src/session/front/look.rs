//! Looks at rows that are due: which of the ops that hang on them become wanted, whether they still are themselves, and how long these
//! answers hold. What coming and going means for the closure is told to [`Front`].

use glam::DVec3;

use super::super::score::{Probe, Scorer};
use super::super::select::PageAccess;
use super::motion::{Motion, SumAt, bin_of};
use super::rows::{CHILD_IS_WANTED, Due, Half, QUEUED, Threshold, TurnsAt, WANTED};
use super::{Children, Context, Front, OVERSHOOT, SpawnRow, down, up};
use crate::pack::record::{Bounds, NO_OP};
use crate::pack::{PackError, PackedModel};

/// Rows whose bounds are read before the first of them is looked at, so that the waits for memory overlap.
const READ_AT_ONCE: usize = 16;

/// What a look at a row needs, as far as it was read before.
#[derive(Clone, Copy)]
struct Glance {
    /// Of the next split of `s` and the first of `t`.
    children: [Option<Bounds>; 2],
    own: Option<Bounds>,
}

impl Glance {
    const NOTHING: Self = Self { children: [None; 2], own: None };
}

/// What several tests wait for, together.
struct Together {
    /// A box around the centres of what was tested.
    low: DVec3,
    high: DVec3,
    /// See [`Due`].
    least_depth: f64,
    small: f64,
    most_depth: f64,
    large: f64,
    /// The least slack of what is out of sight, and by what it waits.
    appears: Option<(f64, SumAt)>,
    leaves: f64,
    leaves_else: f64,
    plane: u8,
    turns: f64,
    bin: u8,
}

impl Together {
    const NOTHING: Self = Self {
        low: DVec3::INFINITY,
        high: DVec3::NEG_INFINITY,
        least_depth: f64::INFINITY,
        small: 0.0,
        most_depth: 0.0,
        large: f64::INFINITY,
        appears: None,
        leaves: f64::INFINITY,
        leaves_else: f64::INFINITY,
        plane: 0,
        turns: f64::INFINITY,
        bin: 0,
    };

    /// The op stays out.
    #[inline]
    fn stays_out(&mut self, probe: &Probe, threshold: f32, scorer: &Scorer) {
        (self.low, self.high) = (self.low.min(probe.center), self.high.max(probe.center));
        let size = probe.size();
        let pixels = size.pixels * scorer.silhouette_factor();
        // Of the reasons to stay out that which will hold for longer.
        let small = size.least_depth - pixels / f64::from(threshold);
        if probe.is_out() {
            let away = probe.away().map_or(f64::NEG_INFINITY, |(away, _)| away);
            let hidden = away.max(-probe.inside) - probe.rounding();
            if hidden > 0.0 && (small.is_nan() || hidden >= small) {
                let at = match &probe.cone {
                    Some(cone) if away >= -probe.inside => SumAt::along(cone),
                    _ => SumAt::inward(probe.plane),
                };
                self.appears = Some(match self.appears {
                    None => (hidden, at),
                    Some((slack, before)) => (slack.min(hidden), before.or(at)),
                });
                return;
            }
        }
        (self.small, self.least_depth) = (self.small.max(pixels), self.least_depth.min(size.least_depth));
    }

    /// The op stays wanted.
    #[inline]
    fn stays_in(&mut self, probe: &Probe) {
        (self.low, self.high) = (self.low.min(probe.center), self.high.max(probe.center));
        let size = probe.size();
        (self.large, self.most_depth) = (size.pixels, size.most_depth);
        let rounding = probe.rounding();
        (self.plane, self.leaves, self.leaves_else) =
            (probe.plane, probe.inside - rounding, probe.next_inside - rounding);
        if let Some((away, normal)) = probe.away() {
            (self.turns, self.bin) = (-away - rounding, bin_of(normal));
        }
    }

    /// When the row is due, and its cell.
    #[inline]
    fn due(&self, motion: &Motion) -> (Due, u8) {
        if self.low.x > self.high.x {
            return (Due::NEVER, 0);
        }
        // What lies outside may move farther than the box: it is tested each time.
        let found = motion.cell(self.low, self.high);
        let cell = found.unwrap_or(0);
        let sums = motion.sums();
        let (appears, appears_at) = self.appears.unwrap_or((f64::INFINITY, SumAt::ANY_INWARD));
        let due = Due {
            least_depth: if self.small > 0.0 { motion.least(cell, self.least_depth) } else { 1.0 },
            most_depth: motion.most(cell, self.most_depth),
            small: if self.small > 0.0 { Half::above(up(self.small)) } else { Half::ZERO },
            large: Half::below(down(self.large)),
            appears: if found.is_some() { after(sums.at(cell, appears_at), appears) } else { Half::NEGATIVE },
            appears_at,
            leaves: after(sums.outward(cell, self.plane), self.leaves),
            leaves_else: after(sums.any_outward(cell), self.leaves_else),
            turns: after(sums.against(self.bin), self.turns),
            turns_at: TurnsAt { plane: self.plane, bin: self.bin },
        };
        (due, cell)
    }
}

/// The value of a sum at which an answer is due that holds for a change of `slack`.
#[inline]
fn after(sum: f32, slack: f64) -> Half {
    if slack > 0.0 { Half::below(down(f64::from(sum) + slack)) } else { Half::NEGATIVE }
}

impl Front {
    /// Looks at all that is due and follows what that leads to.
    pub(super) fn refresh(&mut self, context: &mut Context<'_>) -> Result<(), PackError> {
        let (threshold, near) = (self.threshold, down(context.scorer.near()));
        let lenient = Threshold { low: threshold / context.leniency, high: threshold * context.leniency };
        self.work.clear();
        let sums = self.motion.sums();
        for (row, (due, state)) in self.rows.dues.iter().zip(&mut self.rows.states).enumerate() {
            if due.is_now(sums, state.cell, &lenient, near) {
                state.flags |= QUEUED;
                self.work.push(u64::from(self.rows.ops[row]) << 32 | row as u64);
            }
        }
        for &op in context.model.base_first_splits() {
            if op == NO_OP || self.rows.state(op).flags & WANTED != 0 {
                continue;
            }
            if context.pages.has(PackedModel::page_of(op), f32::MAX) {
                let priority = context.scorer.priority(&context.model.bounds(op)?);
                if priority > threshold {
                    self.want(context, op, priority)?;
                }
            }
        }
        self.see_spawns(context, threshold)?;
        for op in 0..self.spawns.len() as u32 {
            let SpawnRow { due, cell } = self.spawns[op as usize];
            let is_due = due.is_now(self.motion.sums(), cell, &lenient, near);
            if is_due {
                self.look_at_spawn(context, op)?;
            }
        }
        // It may have been over the limit before: then it shrinks.
        let ceiling = context.limit.saturating_add(context.limit / OVERSHOOT).max(self.triangles);
        let mut pass = std::mem::take(&mut self.pass);
        while !self.work.is_empty() {
            pass.clear();
            std::mem::swap(&mut pass, &mut self.work);
            // Ops of a page together, and what goes before that which it hangs on.
            pass.sort_unstable_by_key(|&entry| std::cmp::Reverse(entry));
            let mut left = pass.as_slice();
            while !left.is_empty() {
                let (these, others) = left.split_at(left.len().min(READ_AT_ONCE));
                left = others;
                let mut glances = [Glance::NOTHING; READ_AT_ONCE];
                for (glance, &entry) in glances.iter_mut().zip(these) {
                    *glance = self.glance_at(context, (entry >> 32) as u32, entry as u32 as usize)?;
                }
                for (glance, &entry) in glances.iter().zip(these) {
                    let row = entry as u32 as usize;
                    self.rows.states[row].flags &= !QUEUED;
                    self.look_at(context, (entry >> 32) as u32, row, glance)?;
                }
                if self.triangles > ceiling {
                    // The threshold is going to be raised: what is left is looked at then.
                    for entry in left.iter().copied().chain(self.work.drain(..)) {
                        let row = entry as u32 as usize;
                        self.rows.states[row].flags &= !QUEUED;
                        self.rows.dues[row] = Due::NOW;
                    }
                    break;
                }
            }
        }
        self.pass = pass;
        Ok(())
    }

    /// Has a row looked at, unless it will be anyway.
    #[inline]
    pub(super) fn queue(&mut self, op: u32, row: usize) {
        let flags = &mut self.rows.states[row].flags;
        if *flags & QUEUED == 0 {
            *flags |= QUEUED;
            self.work.push(u64::from(op) << 32 | row as u64);
        }
    }

    /// Reads what a look at a wanted split will probably need.
    #[inline]
    fn glance_at(&self, context: &Context<'_>, op: u32, row: usize) -> Result<Glance, PackError> {
        let mut glance = Glance::NOTHING;
        let flags = self.rows.states[row].flags;
        if flags & WANTED == 0 || op < context.model.spawn_count() {
            return Ok(glance);
        }
        let children = context.model.children(op)?;
        for ((child, bounds), is_wanted) in children.into_iter().zip(&mut glance.children).zip(CHILD_IS_WANTED) {
            let is_read = context.pages.access == PageAccess::Blocking
                || child != NO_OP && context.model.is_ready(PackedModel::page_of(child));
            if child != NO_OP && flags & is_wanted == 0 && is_read {
                *bounds = Some(context.model.bounds(child)?);
            }
        }
        if flags & (CHILD_IS_WANTED[0] | CHILD_IS_WANTED[1]) == 0 {
            glance.own = Some(context.model.bounds(op)?);
        }
        Ok(glance)
    }

    /// Looks whether a spawn becomes wanted.
    pub(super) fn look_at_spawn(&mut self, context: &mut Context<'_>, op: u32) -> Result<(), PackError> {
        context.tested += 1;
        if self.rows.state(op).flags & WANTED != 0 {
            self.spawns[op as usize].due = Due::NEVER;
            return Ok(());
        }
        let probe = context.scorer.probe(&context.model.bounds(op)?);
        let priority = probe.priority();
        if priority > self.threshold {
            let is_wanted = self.want(context, op, priority)?;
            self.spawns[op as usize].due = if is_wanted { Due::NEVER } else { Due::NOW };
            return Ok(());
        }
        let mut waits = Together::NOTHING;
        waits.stays_out(&probe, self.threshold * context.leniency, context.scorer);
        let (due, cell) = waits.due(&self.motion);
        self.spawns[op as usize] = SpawnRow { due, cell };
        Ok(())
    }

    /// Looks at a wanted op: which of its children are wanted, and if none is, whether it still is itself.
    fn look_at(&mut self, context: &mut Context<'_>, op: u32, row: usize, glance: &Glance) -> Result<(), PackError> {
        if self.rows.states[row].flags & WANTED == 0 {
            self.rows.dues[row] = Due::NEVER;
            return Ok(());
        }
        context.tested += 1;
        let mut waits = Together::NOTHING;
        let (mut has_wanted_child, mut is_incomplete) = (false, false);
        // What a child on a missing page matters is at most what this op does.
        let mut own = None;
        let is_spawn = op < context.model.spawn_count();
        for (number, child) in Children::of(context.model, op)?.enumerate() {
            if child == NO_OP {
                continue;
            }
            let is_wanted = match is_spawn {
                true => self.rows.state(child).flags & WANTED != 0,
                false => self.rows.states[row].flags & CHILD_IS_WANTED[number] != 0,
            };
            if is_wanted {
                has_wanted_child = true;
                continue;
            }
            if !context.model.is_ready(PackedModel::page_of(child)) && context.pages.access == PageAccess::ReadAhead {
                let probe = context.scorer.probe(&context.model.bounds(op)?);
                own = Some(probe);
                context.pages.has(PackedModel::page_of(child), probe.priority());
                is_incomplete = true;
                continue;
            }
            let bounds = match glance.children.get(number).copied().flatten() {
                Some(bounds) if !is_spawn => bounds,
                _ => context.model.bounds(child)?,
            };
            let probe = context.scorer.probe(&bounds);
            let priority = probe.priority();
            if priority <= self.threshold {
                waits.stays_out(&probe, self.threshold * context.leniency, context.scorer);
            } else if self.want(context, child, priority)? {
                has_wanted_child = true;
                if !is_spawn {
                    self.rows.states[row].flags |= CHILD_IS_WANTED[number];
                }
            } else {
                is_incomplete = true;
            }
        }
        if !has_wanted_child {
            let probe = match own {
                Some(probe) => probe,
                None => context.scorer.probe(&glance.own.map_or_else(|| context.model.bounds(op), Ok)?),
            };
            let priority = probe.priority();
            if priority <= self.threshold {
                return self.leave(context, op, row);
            }
            waits.stays_in(&probe);
        }
        let (due, cell) = waits.due(&self.motion);
        self.rows.dues[row] = if is_incomplete { Due::NOW } else { due };
        self.rows.states[row].cell = cell;
        Ok(())
    }
}
