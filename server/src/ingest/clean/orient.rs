//! Turns faces so that neighbours agree on which side is out.

use glam::DVec3;

use crate::mesh::TriMesh;
use crate::mesh::edges::{EdgeTable, origin};

/// Orients faces alike across every edge that has exactly two of them, patch by patch; within a patch the
/// orientation that covers more area wins, and the first face's on a tie. Returns how many faces were turned.
///
/// Afterwards an edge with two faces that still run the same way means that its patch has only one side.
/// `edges` is the table of `mesh`; it is stale when faces were turned. Linear.
pub(super) fn orient(mesh: &mut TriMesh, edges: &EdgeTable) -> u64 {
    // Most meshes agree with themselves, and then there is nothing to decide.
    let faces = mesh.faces.as_slice();
    let is_mixed = |a: u32, b: u32| origin(faces, a) == origin(faces, b);
    if !edges.edges().any(|edge| edge.len() == 2 && is_mixed(edge.half_edge(0), edge.half_edge(1))) {
        return 0;
    }
    // The half-edge on the other side; a half-edge without one is its own.
    let mut across: Vec<u32> = (0..faces.len() as u32 * 3).collect();
    for edge in edges.edges().filter(|edge| edge.len() == 2) {
        let (a, b) = (edge.half_edge(0), edge.half_edge(1));
        across[a as usize] = b;
        across[b as usize] = a;
    }

    let (low, high) = mesh.bounding_box().unwrap_or_default();
    let units = AreaUnits::of_box(low, high);
    // Whether each visited face is turned, relative to the first of its patch.
    let mut turned: Vec<Option<bool>> = vec![None; faces.len()];
    let mut queue: Vec<u32> = Vec::with_capacity(faces.len());
    for seed in 0..faces.len() as u32 {
        if turned[seed as usize].is_some() {
            continue;
        }
        let start = queue.len();
        let mut head = start;
        let mut areas = [0_u128; 2];
        turned[seed as usize] = Some(false);
        queue.push(seed);
        while let Some(&face) = queue.get(head) {
            head += 1;
            let is_turned = turned[face as usize] == Some(true);
            let corners = mesh.faces[face as usize].map(|v| DVec3::from(mesh.positions[v as usize]));
            areas[usize::from(is_turned)] += u128::from(units.double_area(corners));
            for half_edge in 3 * face..3 * face + 3 {
                let other = across[half_edge as usize];
                let neighbor = &mut turned[other as usize / 3];
                if neighbor.is_none() {
                    *neighbor = Some(is_turned ^ is_mixed(half_edge, other));
                    queue.push(other / 3);
                }
            }
        }
        if areas[1] > areas[0] {
            for &face in &queue[start..] {
                turned[face as usize] = turned[face as usize].map(|turned| !turned);
            }
        }
    }
    let mut count = 0;
    for (face, _) in mesh.faces.iter_mut().zip(&turned).filter(|(_, turned)| **turned == Some(true)) {
        face.swap(1, 2);
        count += 1;
    }
    count
}

/// Areas in whole numbers: their sum does not depend on the order of the faces, so neither do ties.
pub(crate) struct AreaUnits {
    /// Inverse of the longest side of the box; 0 for a box so large or small that it has none.
    scale: f64,
}

impl AreaUnits {
    /// 2^60 for the square of the longest side of the box. What is too small for that counts as nothing.
    pub(crate) fn of_box(low: [f64; 3], high: [f64; 3]) -> Self {
        let extent = (0..3).map(|k| high[k] - low[k]).fold(0.0, f64::max);
        let scale = 1.0 / extent;
        Self { scale: if scale.is_normal() { scale } else { 0.0 } }
    }

    /// Twice the area of a triangle in the box: at most 3 * 2^60.
    pub(crate) fn double_area(&self, [a, b, c]: [DVec3; 3]) -> u64 {
        let length = ((b - a) * self.scale).cross((c - a) * self.scale).length();
        // `as` takes what is no number, from differences without end, to 0.
        (length * (1_u64 << 60) as f64) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(positions: &[[f64; 3]], faces: &[[u32; 3]], expected: &[[u32; 3]]) {
        let mut mesh = TriMesh { positions: positions.to_vec(), faces: faces.to_vec(), colors: None };
        let table = EdgeTable::new(mesh.positions.len(), &mesh.faces);
        let turned = orient(&mut mesh, &table);
        assert_eq!(mesh.faces, expected);
        assert_eq!(turned as usize, faces.iter().zip(expected).filter(|(a, b)| a != b).count());
    }

    /// ```text
    ///   3---2----------5
    ///   | \ |       /
    ///   0---1---4
    /// ```
    const STRIP: [[f64; 3]; 6] =
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [2.0, 0.0, 0.0], [9.0, 1.0, 0.0]];

    #[test]
    fn an_inverted_face_is_turned() {
        check(&STRIP, &[[0, 1, 3], [1, 3, 2], [1, 4, 2]], &[[0, 1, 3], [1, 2, 3], [1, 4, 2]]);
    }

    #[test]
    fn the_larger_area_keeps_its_orientation() {
        check(&STRIP, &[[0, 1, 3], [1, 2, 3], [1, 2, 4], [4, 2, 5]], &[[0, 3, 1], [1, 3, 2], [1, 2, 4], [4, 2, 5]]);
    }

    #[test]
    fn patches_are_independent_and_no_patch_reaches_through_a_non_manifold_edge() {
        let faces = [[0, 1, 2], [0, 1, 3], [0, 1, 4]];
        check(&STRIP, &faces, &faces);
    }
}
