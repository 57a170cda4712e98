//! The server's copy of what a client holds, and which op made which slot.

use lodestream_protocol::ids::VertexSlot;
use lodestream_protocol::mesh::{Fan, NewVertex, Patch, Replica, SlotSet, TOUCHED_AT_ONCE};
use lodestream_protocol::op::{BatchEncoder, DecodeError, OpCounts, OpState};

use super::op_index::OpSlots;
use super::select::OpMap;
use crate::pack::place::Place;
use crate::pack::{PackError, PackedModel, SplitFields};

/// Why a batch could not be made.
#[derive(Debug, thiserror::Error)]
pub(crate) enum MirrorError {
    /// The pack is at fault.
    #[error(transparent)]
    Model(#[from] PackError),
    /// The mirror is: a bug.
    #[error("op {op} does not fit the mirror: {reason}")]
    Op { op: u32, reason: String },
    /// Likewise.
    #[error("batch does not fit the mirror: {0}")]
    Batch(#[from] DecodeError),
}

/// What one batch shall do.
#[derive(Debug)]
pub(crate) struct BatchPlan<'a> {
    /// Apply these ops, parents before children, after making room for them.
    pub(crate) ops: &'a [u32],
    /// Ops in these slots may be collapsed to make room; those that are get removed.
    pub(crate) stale: &'a mut SlotSet,
    /// Those of them that stay unless room is needed.
    pub(crate) reluctant: &'a mut SlotSet,
    /// Collapse so many even where no room is needed.
    pub(crate) spare_collapses: u32,
    /// Limit in force.
    pub(crate) limit: u32,
}

/// Most triangles that one batch frees, by half as many collapses, see [`MOST_SPLITS_AT_LIMIT`](super::MOST_SPLITS_AT_LIMIT).
const MAX_FREED: u32 = 2048;

/// Replica, cache and contexts as the client has them, and the ops behind the slots.
#[derive(Debug)]
pub(crate) struct Mirror {
    pub(super) state: OpState,
    slots: OpSlots,
    /// Whether the next batch makes both ends forget the cuts in their caches.
    forgets_cuts: bool,
}

impl Mirror {
    pub(crate) fn new(model: &PackedModel, cache_entries: u32) -> Result<Self, PackError> {
        let info = model.info();
        let state = OpState::new(model.base(), info.lattice.bits, info.has_colors, info.has_moves, cache_entries)
            .map_err(|error| PackError::Damaged { section: "base", reason: error.to_string() })?
            .with_step(info.visual_step);
        Ok(Self { state, slots: OpSlots::default(), forgets_cuts: false })
    }

    /// Takes up the ops of a mesh that was built anew, without what its cache knew about cuts.
    pub(super) fn take_ops(&mut self, slots: OpSlots) {
        self.slots = slots;
        self.forgets_cuts = true;
    }

    pub(crate) fn replica(&self) -> &Replica {
        self.state.replica()
    }

    /// Applied ops and the slots they are addressed by, ascending by slot.
    pub(crate) fn applied(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        self.slots.iter()
    }

    /// How many ops are applied.
    pub(crate) fn applied_count(&self) -> usize {
        self.slots.len()
    }

    /// Slot that an applied op is addressed by.
    pub(crate) fn slot(&self, op: u32) -> Option<u32> {
        self.slots.slot(op)
    }

    /// Op that is addressed by a slot.
    pub(crate) fn op_at(&self, slot: u32) -> Option<u32> {
        self.slots.op_at(slot)
    }

    pub(crate) fn is_applied(&self, op: u32) -> bool {
        self.slots.slot(op).is_some()
    }

    /// Memory of the coder's contexts.
    pub(crate) fn coder_bytes(&self) -> usize {
        self.state.heap_bytes() - self.replica().heap_bytes() - self.state.cache().heap_bytes()
    }

    /// Memory that knows the ops behind the slots.
    pub(crate) fn slot_bytes(&self) -> usize {
        self.slots.heap_bytes()
    }

    /// Encodes a batch and applies it. Returns the bytes, what they do, and how many of the plan's ops, counted from the
    /// front, found room.
    pub(crate) fn batch(
        &mut self,
        model: &PackedModel,
        plan: &mut BatchPlan<'_>,
    ) -> Result<(Vec<u8>, OpCounts, usize), MirrorError> {
        let Self { state, slots, forgets_cuts } = self;
        let triangles = |&op: &u32| model.triangles_of(op);
        let added: Vec<u32> = plan.ops.iter().map(triangles).collect::<Result<_, _>>()?;
        let needed = added.iter().fold(state.replica().triangle_count(), |sum, &n| sum.saturating_add(n));
        let to_free = needed.saturating_sub(plan.limit).min(MAX_FREED);
        let mut encoder = BatchEncoder::new(state, std::mem::take(forgets_cuts));
        collapse(&mut encoder, plan, to_free, slots)?;
        let mut room = plan.limit.saturating_sub(encoder.replica().triangle_count());
        let fitting = added
            .iter()
            .take_while(|&&n| {
                let fits = n <= room;
                room = room.saturating_sub(n);
                fits
            })
            .count();
        let ops = &plan.ops[..fitting];
        spawn(&mut encoder, model, ops, plan.limit, slots)?;
        split(&mut encoder, model, ops, plan.limit, slots)?;
        let (bytes, counts) = encoder.finish();
        Ok((bytes, counts, fitting))
    }
}

fn collapse(
    encoder: &mut BatchEncoder<'_>,
    plan: &mut BatchPlan<'_>,
    to_free: u32,
    slots: &mut OpSlots,
) -> Result<(), MirrorError> {
    let target = encoder.replica().triangle_count().saturating_sub(to_free);
    let mut spare = plan.spare_collapses;
    let mut members: Vec<u32> = Vec::new();
    // The cache is kept as op ids while the session rests.
    let mut labels: Vec<u32> = Vec::new();
    let mut is_first = true;
    loop {
        members.clear();
        let replica = encoder.replica();
        let mut triangles = replica.triangle_count();
        let mut consider = |slot: u32| {
            let needs_room = triangles > target;
            if !replica.collapsible().contains(slot) || (!needs_room && plan.reluctant.contains(slot)) {
                return true;
            }
            if needs_room {
                triangles = triangles.saturating_sub(replica.triangles_of(VertexSlot(slot)));
            } else if spare > 0 {
                spare -= 1;
            } else {
                return false;
            }
            members.push(slot);
            true
        };
        if is_first {
            plan.stale.iter().all(&mut consider);
        } else {
            encoder.candidates().filter(|&slot| plan.stale.contains(slot)).all(&mut consider);
        }
        is_first = false;
        labels.clear();
        for &slot in &members {
            let is_spawn = encoder.replica().is_spawn(VertexSlot(slot));
            let op = slots.take(slot);
            if !is_spawn {
                labels.push(op);
            }
            plan.stale.remove(slot);
            plan.reluctant.remove(slot);
        }
        let goes_on = encoder.collapse_round(&members)?;
        encoder.label_cached(&labels);
        if !goes_on {
            return Ok(());
        }
    }
}

fn spawn(
    encoder: &mut BatchEncoder<'_>,
    model: &PackedModel,
    ops: &[u32],
    limit: u32,
    slots: &mut OpSlots,
) -> Result<(), MirrorError> {
    let mut ids: Vec<u32> = ops.iter().copied().filter(|&op| op < model.spawn_count()).collect();
    ids.sort_unstable();
    let patches: Vec<Patch> = ids.iter().map(|&id| model.spawn_patch(id)).collect::<Result<_, _>>()?;
    let spawns: Vec<(u32, &Patch)> = ids.iter().copied().zip(&patches).collect();
    for (slot, &id) in encoder.spawns(&spawns, limit)?.into_iter().zip(&ids) {
        slots.insert(id, slot.0);
    }
    Ok(())
}

fn split(
    encoder: &mut BatchEncoder<'_>,
    model: &PackedModel,
    ops: &[u32],
    limit: u32,
    slots: &mut OpSlots,
) -> Result<(), MirrorError> {
    // The round of an op is one more than that of its latest parent in this batch: then it is legal, and by the rule of
    // neighbouring faces its vertex is among those that the round before touched.
    let mut by_round: Vec<Vec<(u32, SplitFields)>> = Vec::new();
    let mut round_of: OpMap<u32> = OpMap::default();
    for &op in ops.iter().filter(|&&op| op >= model.spawn_count()) {
        let fields = model.split(op)?;
        let round = fields.named_parents().filter_map(|parent| round_of.get(&parent)).map(|round| round + 1).max();
        let round = round.unwrap_or(0);
        round_of.insert(op, round);
        if by_round.len() <= round as usize {
            by_round.resize(round as usize + 1, Vec::new());
        }
        by_round[round as usize].push((op, fields));
    }
    let (mut members, mut order, mut vertices) = (Vec::new(), Vec::new(), Vec::new());
    for (round, ops) in by_round.iter().enumerate() {
        members.clear();
        order.clear();
        for (op, fields) in ops {
            let op = *op;
            let place = Place::find(model, encoder.replica(), |op| slots.slot(op), fields)?
                .ok_or_else(|| missing(op, "a parent is not applied"))?;
            let vertex = NewVertex {
                position: fields.position,
                color: fields.color,
                s_move: fields.s_move,
                s_color_move: fields.s_color_move,
            };
            // What is sorted stays small: the vertex to split, then where the rest is.
            order.push(u64::from(place.s.0) << 32 | members.len() as u64);
            members.push((place, op, vertex));
        }
        order.sort_unstable();
        vertices.clear();
        vertices.extend(order.iter().map(|key| (key >> 32) as u32));
        encoder.split_round(&vertices)?;
        for (order, vertices) in order.chunks(TOUCHED_AT_ONCE).zip(vertices.chunks(TOUCHED_AT_ONCE)) {
            encoder.replica().touch_fans(vertices);
            for key in order {
                let (place, op, vertex) = &members[*key as u32 as usize];
                let resolve = |replica: &Replica, fan: &Fan| Some((place.cut(replica, fan).ok()?, *vertex));
                let t = encoder.split(place.s.0, limit, resolve).map_err(|error| missing(*op, &error.to_string()))?;
                slots.insert(*op, t.0);
            }
        }
        let more = encoder.end_split_round();
        if round + 1 == by_round.len() && more {
            encoder.split_round(&[])?;
        }
    }
    if by_round.is_empty() {
        encoder.split_round(&[])?;
    }
    Ok(())
}

fn missing(op: u32, reason: &str) -> MirrorError {
    MirrorError::Op { op, reason: reason.into() }
}
