//! Joins vertices that are within a tolerance of each other, one after the other: for scans whose parts almost meet.
//!
//! Pairs are found in buckets of grid cells, each with what lies within the tolerance of the cell, so that a bucket fits in
//! memory as long as cells do: a tolerance far above the distance of vertices costs memory, and time.

use bytemuck::{Pod, Zeroable};

use super::bits::Bits;
use super::faces::keep;
use super::runs::{Runs, in_order};
use super::scan::Extent;
use super::sort::Sorted;
use crate::ingest::hierarchy::NONE;
use crate::ingest::spill::{SpillError, Workspace};
use crate::mesh::edges::DisjointSets;

/// Side of a cell, in tolerances: at least 2, so that a vertex is near one neighbour at most along each axis, and large enough for
/// few vertices to be near one at all.
const CELL: f64 = 32.0;

#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
struct Point {
    position: [f64; 3],
    vertex: u32,
    padding: u32,
}

/// Joins vertices of `sorted` over distances of at most `tolerance`, transitively; of each set, the vertex that comes first
/// in the input keeps its position and colour. Returns how many vertices went. 12 bytes for each vertex while it runs.
pub(super) fn join_near(
    sorted: Sorted,
    tolerance: f64,
    extent: Extent,
    bucket_vertices: u64,
    workspace: &Workspace,
) -> Result<(Sorted, u64), SpillError> {
    let count = sorted.positions.len();
    let bucket_count = count.div_ceil(bucket_vertices).max(1);
    let (low, _) = extent.corners();
    let dealt = Runs::build(workspace, count, bucket_count as usize, |range, out| {
        for (vertex, position) in (range.start as u32..).zip(sorted.positions.read(range)?) {
            let point = Point { position, vertex, padding: 0 };
            let mut buckets = [NONE; 8];
            for (k, cell) in cells(position, low, tolerance).enumerate() {
                buckets[k] = bucket_of(cell, bucket_count);
                if !buckets[..k].contains(&buckets[k]) {
                    out.push((buckets[k], point));
                }
            }
        }
        Ok(())
    })?;
    let mut sets = DisjointSets::new(count as usize);
    in_order(
        bucket_count as usize,
        |bucket| Ok(pairs(&dealt.read(bucket)?, low, tolerance)),
        |_, pairs| {
            pairs.iter().for_each(|&[a, b]| sets.join(a, b));
            Ok(())
        },
    )?;
    drop(dealt);

    // By the lowest number of each set, the vertex that comes first in the input.
    let mut stands_for = vec![NONE; count as usize];
    for &number in sorted.numbers.iter().filter(|number| **number != NONE) {
        let first = &mut stands_for[sets.find(number) as usize];
        if *first == NONE {
            *first = number;
        }
    }
    let kept = Bits::new(count);
    stands_for.iter().filter(|first| **first != NONE).for_each(|&first| kept.set(first));
    let kept_count = kept.count();
    if kept_count == count {
        return Ok((sorted, 0));
    }
    let ranks = kept.ranks();
    let Sorted { positions, colors, mut numbers } = sorted;
    for number in numbers.iter_mut().filter(|number| **number != NONE) {
        *number = kept.rank(&ranks, stands_for[sets.find(*number) as usize]);
    }
    let positions = keep(&positions, &kept, workspace)?;
    let colors = colors.map(|colors| keep(&colors, &kept, workspace)).transpose()?;
    Ok((Sorted { positions, colors, numbers }, count - kept_count))
}

/// The cells that have the position in them or within the tolerance of them.
fn cells(position: [f64; 3], low: [f64; 3], tolerance: f64) -> impl Iterator<Item = [i64; 3]> {
    let side = CELL * tolerance;
    let axes: [(i64, i64); 3] = std::array::from_fn(|k| {
        let at = (position[k] - low[k]) / side;
        // A little more than the tolerance: rounding must not keep a pair apart.
        let margin = 1.01 / CELL;
        ((at - margin).floor() as i64, (at + margin).floor() as i64)
    });
    (0..8).filter_map(move |corner| {
        let is_high = [0, 1, 2].map(|k| corner >> k & 1 == 1);
        let is_new = (0..3).all(|k| !is_high[k] || axes[k].0 != axes[k].1);
        is_new.then(|| std::array::from_fn(|k| if is_high[k] { axes[k].1 } else { axes[k].0 }))
    })
}

fn bucket_of(cell: [i64; 3], bucket_count: u64) -> u32 {
    let mix = |hash: u64, x: i64| (hash ^ x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29);
    (cell.into_iter().fold(0, mix) % bucket_count) as u32
}

/// Vertices that are near each other: pairs enough to join all that hangs together.
fn pairs(points: &[Point], low: [f64; 3], tolerance: f64) -> Vec<[u32; 2]> {
    // Any two points of one cube are near: its diagonal is 0.87 tolerances. Those of cubes three apart are not.
    let side = tolerance / 2.0;
    let cube = |p: &Point| -> [i64; 3] { std::array::from_fn(|k| ((p.position[k] - low[k]) / side).floor() as i64) };
    let mut order: Vec<([i64; 3], u32)> = (0..).zip(points).map(|(k, p)| (cube(p), k)).collect();
    order.sort_unstable();
    let cubes: Vec<&[([i64; 3], u32)]> = order.chunk_by(|a, b| a.0 == b.0).collect();
    let is_near = |a: u32, b: u32| {
        let [p, q] = [a, b].map(|k| points[k as usize].position);
        (0..3).map(|k| (p[k] - q[k]) * (p[k] - q[k])).sum::<f64>() <= tolerance * tolerance
    };

    let mut sets = DisjointSets::new(points.len());
    let mut pairs = Vec::new();
    let mut join = |sets: &mut DisjointSets, a: u32, b: u32| {
        if sets.find(a) != sets.find(b) {
            sets.join(a, b);
            pairs.push([a, b].map(|k| points[k as usize].vertex));
        }
    };
    // Cubes with the same x and y follow each other by z, so a column of five is found by one search; and since searches go
    // up with the cubes, each is a step from the last.
    let columns = (0..=2_i64).flat_map(|x| (-2..=2_i64).map(move |y| [x, y])).filter(|&[x, y]| x > 0 || y >= 0);
    let mut starts: Vec<([i64; 2], usize)> = columns.map(|column| (column, 0)).collect();
    for (here, group) in cubes.iter().enumerate() {
        let [x, y, z] = group[0].0;
        for pair in group.windows(2).filter(|pair| is_near(pair[0].1, pair[1].1)) {
            join(&mut sets, pair[0].1, pair[1].1);
        }
        for ([dx, dy], start) in &mut starts {
            let (cx, cy) = (x.saturating_add(*dx), y.saturating_add(*dy));
            let first = [cx, cy, z.saturating_sub(2)];
            while cubes.get(*start).is_some_and(|cube| cube[0].0 < first) {
                *start += 1;
            }
            let end = [cx, cy, z.saturating_add(2)];
            for other in cubes[*start..].iter().take_while(|cube| cube[0].0 <= end) {
                // The other way round it comes up at the other cube.
                if other[0].0 <= cubes[here][0].0 || sets.find(group[0].1) == sets.find(other[0].1) {
                    continue;
                }
                let found = group.iter().find_map(|a| other.iter().find(|b| is_near(a.1, b.1)).map(|b| (a.1, b.1)));
                if let Some((a, b)) = found {
                    join(&mut sets, a, b);
                }
            }
        }
    }
    pairs
}
