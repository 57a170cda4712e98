//! The order in which the ops of a selection are sent.
//!
//! What matters more comes first, but only by bands of importance, a factor of two wide: within a band first the components by
//! priority, then the splits along the Morton curve. Splits of a batch then lie close together, so their slots do too, and
//! naming them costs fewer bits the less of the mesh the batch is. A mesh never waits for more than one band to have all of
//! what is twice as important.

use super::select::{OpSet, Selection};
use crate::mesh::morton::morton;
use crate::pack::{PackError, PackedModel};

/// Ops of a selection that are not applied yet, parents before children. O(n log n) for n ops.
///
/// # Errors
/// [`PackError`] if a page is damaged.
pub(super) fn sending_order(
    model: &PackedModel,
    selection: &Selection,
    is_applied: impl Fn(u32) -> bool,
) -> Result<Vec<u32>, PackError> {
    let mut out = Vec::new();
    let mut band: Vec<(u64, u32)> = Vec::new();
    let mut waiting = OpSet::default();
    let mut stack = Vec::new();
    let ends = selection.band_ends.iter().copied().filter(|&end| end < selection.ops.len());
    let mut start = 0;
    for end in ends.chain([selection.ops.len()]) {
        band.clear();
        for &op in selection.ops[start..end].iter().filter(|&&op| !is_applied(op)) {
            // Components arrive by their size: they are named by number in any case.
            if op < model.spawn_count() {
                out.push(op);
            } else {
                band.push((morton(model.bounds(op)?.center, model.info().lattice.max_coordinate()), op));
            }
        }
        start = end;
        band.sort_unstable();
        waiting.clear();
        waiting.extend(band.iter().map(|&(_, op)| op));
        for &(_, op) in &band {
            // Depth first over parents. Each op is entered once, so damaged parents cannot make it loop.
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
    }
    Ok(out)
}

/// Takes `op` up if it waits.
fn enter(
    model: &PackedModel,
    waiting: &mut OpSet,
    stack: &mut Vec<(u32, [u32; 3], usize)>,
    op: u32,
) -> Result<(), PackError> {
    if waiting.remove(&op) {
        stack.push((op, model.parents(op)?.0, 0));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};

    use super::*;
    use crate::pack::testing::{DagOptions, random_dag};
    use crate::pack::{Metadata, write_to_vec};
    use crate::session::score::Scorer;
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
            let is_applied = |op: u32| op % 7 == seed as u32 && op.is_multiple_of(3);
            let order = sending_order(&model, &selection, is_applied).unwrap();
            let pending: BTreeSet<u32> = selection.ops.iter().copied().filter(|&op| !is_applied(op)).collect();
            assert_eq!(order.iter().copied().collect::<BTreeSet<u32>>(), pending);
            assert_eq!(order.len(), pending.len(), "none comes twice");
            let rank = |op: u32| order.iter().position(|&other| other == op);
            let mut ends = selection.band_ends.clone();
            ends.push(selection.ops.len());
            let band_of = |op: u32| {
                let at = selection.ops.iter().position(|&other| other == op).unwrap();
                ends.iter().position(|&end| at < end).unwrap()
            };
            assert!(order.windows(2).all(|pair| band_of(pair[0]) <= band_of(pair[1])));
            for &op in order.iter().filter(|&&op| op >= model.spawn_count()) {
                let (parents, count) = model.parents(op).unwrap();
                for &parent in &parents[..count] {
                    assert!(is_applied(parent) || rank(parent) < rank(op), "seed {seed}: {parent} after {op}");
                }
            }
            assert!(ends.len() > 3, "one band tells nothing: {ends:?}");
        }
    }
}
