//! Which faces hang together.

use crate::mesh::TriMesh;
use crate::mesh::edges::DisjointSets;

/// Component of each face (`len == faces.len()`): 0, 1, 2, ... in the order of their first faces.
///
/// Faces that share a vertex are in one component. In a clean mesh that is the same as sharing an edge, one after
/// the other, because no vertex has two fans. O(n log n) at worst, about linear.
///
/// # Panics
/// If a face names a vertex that does not exist.
pub fn components(mesh: &TriMesh) -> Vec<u32> {
    let mut sets = DisjointSets::new(mesh.positions.len());
    for &[a, b, c] in &mesh.faces {
        sets.join(a, b);
        sets.join(b, c);
    }
    let mut labels: Vec<Option<u32>> = vec![None; mesh.positions.len()];
    let mut count = 0;
    let mut label_of = |root: u32| {
        *labels[root as usize].get_or_insert_with(|| {
            count += 1;
            count - 1
        })
    };
    mesh.faces.iter().map(|face| label_of(sets.find(face[0]))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_count_up_in_face_order() {
        let faces = vec![[7, 8, 9], [0, 1, 2], [3, 4, 5], [2, 6, 3], [9, 10, 7]];
        let mesh = TriMesh { positions: vec![[0.0; 3]; 11], faces, colors: None };
        assert_eq!(components(&mesh), [0, 1, 1, 1, 0]);
        assert!(components(&TriMesh::default()).is_empty());
    }
}
