//! The order in which the ops of a selection are sent.
//!
//! What matters more comes first, but only by bands of importance, a factor of two wide: within a band first the components by
//! priority, then the splits along the Morton curve. Splits of a batch then lie close together, so their slots do too, and
//! naming them costs fewer bits the less of the mesh the batch is. A mesh never waits for more than one band to have all of
//! what is twice as important.

use super::score::Scorer;
use super::select::OpSet;
use crate::mesh::morton::morton;
use crate::pack::record::NO_OP;
use crate::pack::{PackError, PackedModel};

/// Share of a model's ops from which on a bit for each of them is less than a set of those that are meant.
const BITS_FROM: u32 = 64;

/// The ops in the order in which they are sent, parents before children. `ops` have no parents that are not applied but among
/// themselves. O(n log n) for n ops.
///
/// # Errors
/// [`PackError`] if a page is damaged.
pub(super) fn sending_order(model: &PackedModel, scorer: &Scorer, ops: &[u32]) -> Result<Vec<u32>, PackError> {
    let mut ranked: Vec<(u32, u64, u32)> = Vec::with_capacity(ops.len());
    for &op in ops {
        let bounds = model.bounds(op)?;
        let priority = scorer.priority(&bounds);
        // Components arrive by their size: they are named by number in any case.
        let place = match op < model.spawn_count() {
            true => u64::from(!priority.to_bits()),
            false => 1 << 63 | morton(bounds.center, model.info().lattice.max_coordinate()),
        };
        ranked.push((!band(priority), place, op));
    }
    ranked.sort_unstable();
    let mut waiting = Waiting::new(model, ops);
    let mut out = Vec::with_capacity(ops.len());
    let mut stack = Vec::new();
    for (_, _, op) in ranked {
        // Depth first over parents, some of which matter less by themselves. Each op is entered once, so damaged parents cannot
        // make it loop.
        enter(model, &mut waiting, &mut stack, op)?;
        while let Some((op, parents, next)) = stack.last_mut() {
            let Some(&parent) = parents.get(*next) else {
                out.push(*op);
                stack.pop();
                continue;
            };
            *next += 1;
            enter(model, &mut waiting, &mut stack, parent)?;
        }
    }
    Ok(out)
}

/// Ops that were not entered yet.
enum Waiting {
    /// A bit for each op of the model.
    Most(Vec<u64>),
    Few(OpSet),
}

impl Waiting {
    fn new(model: &PackedModel, ops: &[u32]) -> Self {
        if ops.len() < (model.op_count() / BITS_FROM) as usize {
            return Self::Few(ops.iter().copied().collect());
        }
        let mut bits = vec![0; model.op_count().div_ceil(64) as usize];
        ops.iter().for_each(|&op| bits[op as usize / 64] |= 1 << (op % 64));
        Self::Most(bits)
    }

    /// Takes an op out; whether it was there.
    #[inline]
    fn remove(&mut self, op: u32) -> bool {
        match self {
            Self::Few(ops) => ops.remove(&op),
            Self::Most(bits) => bits.get_mut(op as usize / 64).is_some_and(|bits| {
                let was_there = *bits >> (op % 64) & 1 != 0;
                *bits &= !(1 << (op % 64));
                was_there
            }),
        }
    }
}

/// Number of the band of a priority: its octave.
fn band(priority: f32) -> u32 {
    priority.to_bits() >> 23
}

/// Takes `op` up if it waits.
fn enter(
    model: &PackedModel,
    waiting: &mut Waiting,
    stack: &mut Vec<(u32, [u32; 3], usize)>,
    op: u32,
) -> Result<(), PackError> {
    if waiting.remove(op) {
        let parents = if op < model.spawn_count() { [NO_OP; 3] } else { model.parents(op)?.0 };
        stack.push((op, parents, 0));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, BTreeSet};

    use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};

    use super::*;
    use crate::pack::testing::{DagOptions, random_dag};
    use crate::pack::{Metadata, write_to_vec};
    use crate::session::select::{PageAccess, select};

    #[test]
    fn parents_come_first_and_bands_stay_apart() {
        for seed in 0..6 {
            let (dag, complete) = random_dag(&DagOptions { splits: 2000, seed, ..DagOptions::default() });
            let model = PackedModel::from_vec(write_to_vec(&dag, &complete, &Metadata::default()).unwrap()).unwrap();
            let info = model.info();
            let middle = glam::DVec3::from_array(info.lattice.origin) + glam::DVec3::splat(500.0 * info.lattice.step);
            let mut view = View::perspective(middle + glam::DVec3::splat(1000.0 * info.lattice.step), middle, 0.9);
            (view.tolerance_px, view.two_sided) = (0.0, true);
            let scorer = if seed % 2 == 0 { Scorer::complete() } else { Scorer::new(&view, model.info()) };
            let selection = select(&model, &scorer, UNLIMITED_TRIANGLES, PageAccess::Blocking).unwrap();
            // Any part that is closed under parents may be applied.
            let mut applied = OpSet::default();
            for (i, &op) in selection.ops.iter().enumerate() {
                let (parents, count) =
                    if op < model.spawn_count() { ([NO_OP; 3], 0) } else { model.parents(op).unwrap() };
                if i % 5 != seed as usize % 5 && parents[..count].iter().all(|parent| applied.contains(parent)) {
                    applied.insert(op);
                }
            }
            let pending: Vec<u32> = selection.ops.iter().copied().filter(|op| !applied.contains(op)).collect();
            let order = sending_order(&model, &scorer, &pending).unwrap();
            let set = |ops: &[u32]| ops.iter().copied().collect::<BTreeSet<u32>>();
            assert_eq!(set(&order), set(&pending));
            assert_eq!(order.len(), pending.len(), "none comes twice");
            assert!(!applied.is_empty() && order.len() > 100, "{} and {}", applied.len(), order.len());
            let rank: BTreeMap<u32, usize> = order.iter().enumerate().map(|(rank, &op)| (op, rank)).collect();
            // The band in which an op is sent is the highest of those of what needs it.
            let mut bands: BTreeMap<u32, u32> = BTreeMap::new();
            for &op in order.iter().rev() {
                let own = band(scorer.priority(&model.bounds(op).unwrap()));
                let at = *bands.entry(op).and_modify(|at| *at = own.max(*at)).or_insert(own);
                if op < model.spawn_count() {
                    continue;
                }
                let (parents, count) = model.parents(op).unwrap();
                for &parent in &parents[..count] {
                    if !applied.contains(&parent) {
                        assert!(rank[&parent] < rank[&op], "seed {seed}: {parent} after {op}");
                        bands.entry(parent).and_modify(|other| *other = at.max(*other)).or_insert(at);
                    }
                }
            }
            assert!(order.windows(2).all(|pair| bands[&pair[0]] >= bands[&pair[1]]), "seed {seed}");
            // What comes first is closed as well, and few enough to be kept as a set.
            let few = &order[..order.len().min((model.op_count() / BITS_FROM) as usize - 1)];
            let again = sending_order(&model, &scorer, few).unwrap();
            assert_eq!(set(&again), set(few));
            let rank: BTreeMap<u32, usize> = again.iter().enumerate().map(|(rank, &op)| (op, rank)).collect();
            for &op in few.iter().filter(|&&op| op >= model.spawn_count()) {
                let parents = model.prerequisites(op).unwrap();
                let after = parents.as_slice().iter().filter_map(|parent| rank.get(parent)).max();
                assert!(after.is_none_or(|&after| after < rank[&op]), "seed {seed}: {op}");
            }
            let different: BTreeSet<u32> = bands.values().copied().collect();
            assert!(different.len() > 3, "one band tells nothing: {different:?}");
        }
    }
}
