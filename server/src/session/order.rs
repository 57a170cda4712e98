//! The order in which the ops of a selection are sent.
//!
//! What matters more comes first, but only by bands of importance: within a band ops go by id, and ids of one size of error
//! run along the Morton curve. Ops of a batch then lie close together, so their slots do too, and naming them costs fewer bits
//! the less of the mesh the batch is. A mesh never waits for more than one band to have all of what is twice as important.

use super::select::{OpSet, Selection};
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
    let mut stack: Vec<u32> = Vec::new();
    let ends = selection.band_ends.iter().copied().filter(|&end| end < selection.ops.len());
    let mut start = 0;
    for end in ends.chain([selection.ops.len()]) {
        band.clear();
        for &op in selection.ops[start..end].iter().filter(|&&op| !is_applied(op)) {
            band.push((morton(model.bounds(op)?.center), op));
        }
        start = end;
        band.sort_unstable();
        waiting.clear();
        waiting.extend(band.iter().map(|&(_, op)| op));
        for &(_, op) in &band {
            // An op goes out once none of its parents waits. A damaged pack may have a cycle: entering an op takes it off
            // the list, so each is entered once.
            stack.push(op);
            while let Some(&op) = stack.last() {
                if !waiting.contains(&op) {
                    stack.pop();
                    continue;
                }
                let (parents, count) = if op < model.spawn_count() { ([0; 3], 0) } else { model.parents(op)? };
                let before = stack.len();
                // On the way down each op of the band is entered at most once and puts at most three on the stack: more than
                // that is a cycle.
                if stack.len() <= 3 * band.len() {
                    stack.extend(parents[..count].iter().copied().filter(|parent| waiting.contains(parent)));
                }
                if stack.len() == before {
                    stack.pop();
                    waiting.remove(&op);
                    out.push(op);
                }
            }
        }
    }
    Ok(out)
}

/// Place of a point of the lattice along the Morton curve.
fn morton(point: [i32; 3]) -> u64 {
    let spread = |x: i32| {
        let mut x = u64::from(x.clamp(0, (1 << 21) - 1) as u32);
        x = (x | x << 32) & 0x001f_0000_0000_ffff;
        x = (x | x << 16) & 0x001f_0000_ff00_00ff;
        x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
        x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
        (x | x << 2) & 0x1249_2492_4924_9249
    };
    spread(point[0]) | spread(point[1]) << 1 | spread(point[2]) << 2
}
