//! Decides which faces to turn round, by the rule of [`clean::orient`](crate::ingest::clean): faces agree across every edge
//! that has exactly two, and within a patch the side with the larger area wins, or that of the first face.
//!
//! Only runs where the faces of some edge disagree. Patches are sets of faces with a parity, 4 bytes for each face of the input;
//! areas are whole numbers, so that their sums do not depend on the order.

use std::collections::{HashMap, HashSet};

use super::Stage;
use super::bits::Bits;
use super::runs::in_order;
use super::scan::Extent;
use super::stars::Stars;
use super::survey::at;
use crate::ingest::clean::orient::AreaUnits;
use crate::ingest::spill::{Spill, SpillError};

/// Faces, by their places in the input, to be turned round.
pub(super) struct Turned {
    pub(super) faces: Bits,
    pub(super) count: u64,
}

/// Reads all chunks twice.
pub(super) fn orient(stage: &Stage, positions: &Spill<[f64; 3]>, extent: Extent) -> Result<Turned, SpillError> {
    let mut patches = Parities::new(stage.face_count);
    let mut mixed: Vec<u32> = Vec::new();
    in_order(
        stage.ranges.count(),
        |chunk| Ok(joints(&stage.stars(chunk, None)?)),
        |_, joints| {
            for joint in joints {
                patches.join(joint.faces[0], joint.faces[1], joint.is_mixed);
                if joint.is_mixed {
                    mixed.push(joint.faces[0]);
                }
            }
            // Those of one patch stand for each other.
            mixed.iter_mut().for_each(|face| *face = patches.find(*face).0);
            mixed.sort_unstable();
            mixed.dedup();
            Ok(())
        },
    )?;
    let mixed: HashSet<u32> = mixed.into_iter().map(|face| patches.find(face).0).collect();

    let (low, high) = extent.corners();
    let units = AreaUnits::of_box(low, high);
    let mut areas: HashMap<u32, [u128; 2]> = HashMap::new();
    in_order(
        stage.ranges.count(),
        |chunk| {
            let stars = stage.stars(chunk, None)?;
            let positions = stars.local.read(positions)?;
            let area = |face: &[u32; 3]| units.double_area(face.map(|v| at(positions[v as usize])));
            let owned = stars.faces[..stars.owned].iter().map(area);
            Ok(stars.indices.iter().copied().zip(owned).collect::<Vec<_>>())
        },
        |_, faces| {
            for (face, area) in faces {
                let (patch, parity) = patches.find(face);
                if mixed.contains(&patch) {
                    areas.entry(patch).or_default()[usize::from(parity)] += u128::from(area);
                }
            }
            Ok(())
        },
    )?;

    let faces = Bits::new(u64::from(stage.face_count));
    let mut count = 0;
    for face in 0..stage.face_count {
        let (patch, parity) = patches.find(face);
        // Nothing that was dropped is in a patch with others.
        if let Some(areas) = areas.get(&patch)
            && parity ^ (areas[1] > areas[0])
        {
            faces.set(face);
            count += 1;
        }
    }
    Ok(Turned { faces, count })
}

/// Two faces at an edge that has no others.
struct Joint {
    faces: [u32; 2],
    /// Whether both run along it in the same direction.
    is_mixed: bool,
}

/// For the edges whose lower end is in the chunk.
fn joints(stars: &Stars) -> Vec<Joint> {
    let mut joints = Vec::new();
    let mut edges = Vec::new();
    for v in stars.own_vertices() {
        stars.edges_at(v, &mut edges);
        let here = stars.local.vertex(v);
        for edge in edges.chunk_by(|a, b| a.0 == b.0) {
            if let [a, b] = edge
                && here < stars.local.vertex(a.0)
            {
                let faces = [a, b].map(|side| stars.indices[side.2 as usize]);
                joints.push(Joint { faces, is_mixed: a.1 == b.1 });
            }
        }
    }
    joints
}

/// Disjoint sets whose members are on one of two sides; the lowest member stands for its set and is on the first.
struct Parities {
    /// Parent, and in the lowest bit whether it is on the other side.
    up: Vec<u32>,
}

impl Parities {
    fn new(len: u32) -> Self {
        assert!(len <= u32::MAX / 2, "readers count three half-edges a face in a u32");
        Self { up: (0..len).map(|k| k << 1).collect() }
    }

    fn find(&mut self, mut item: u32) -> (u32, bool) {
        let mut parity = 0;
        loop {
            let entry = self.up[item as usize];
            let parent = entry >> 1;
            if parent == item {
                return (item, parity & 1 == 1);
            }
            // Path halving: the grandparent, with both steps' parities.
            let above = self.up[parent as usize];
            let halved = above ^ (entry & 1);
            self.up[item as usize] = halved;
            parity ^= halved & 1;
            item = halved >> 1;
        }
    }

    /// Joins the sets of two items that are on different sides if `differ`. What contradicts earlier joins is ignored.
    fn join(&mut self, a: u32, b: u32, differ: bool) {
        let ((a, a_side), (b, b_side)) = (self.find(a), self.find(b));
        if a != b {
            let (low, high) = (a.min(b), a.max(b));
            self.up[high as usize] = low << 1 | u32::from(a_side ^ b_side ^ differ);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parities_follow_all_joins() {
        let mut random = fastrand::Rng::with_seed(5);
        let sides: Vec<bool> = (0..200).map(|_| random.bool()).collect();
        let mut parities = Parities::new(200);
        for _ in 0..400 {
            let (a, b) = (random.u32(..200), random.u32(..200));
            if a % 3 == b % 3 {
                parities.join(a, b, sides[a as usize] != sides[b as usize]);
            }
        }
        for k in 0..200 {
            let (root, parity) = parities.find(k);
            assert_eq!((root % 3, parity), (k % 3, sides[k as usize] != sides[root as usize]));
            assert!(root <= k);
        }
    }
}
