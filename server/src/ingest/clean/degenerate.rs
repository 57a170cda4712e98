//! Drops what no surface is made of: faces without finite positions, without three corners, or twice the same, and
//! vertices that no face uses. Faces of zero area between three vertices stay: they are the input.

use crate::mesh::TriMesh;
use crate::mesh::edges::{duplicate_faces, is_degenerate};

/// Drops faces that use a vertex that is not finite or does not exist. Returns how many.
pub(super) fn drop_unusable_faces(mesh: &mut TriMesh) -> u64 {
    let before = mesh.faces.len();
    let is_usable: Vec<bool> = mesh.positions.iter().map(|p| p.iter().all(|c| c.is_finite())).collect();
    mesh.faces.retain(|face| face.iter().all(|&v| is_usable.get(v as usize).copied().unwrap_or(false)));
    (before - mesh.faces.len()) as u64
}

/// Drops faces that name a vertex twice. Returns how many.
pub(super) fn drop_degenerate_faces(mesh: &mut TriMesh) -> u64 {
    let before = mesh.faces.len();
    mesh.faces.retain(|face| !is_degenerate(*face));
    (before - mesh.faces.len()) as u64
}

/// Drops faces with the corners of an earlier face in the same cyclic order. Returns how many.
///
/// The same corners in the other order are the back of a face and stay.
pub(super) fn drop_duplicate_faces(mesh: &mut TriMesh) -> u64 {
    let duplicates = duplicate_faces(&mesh.faces);
    let mut rest = duplicates.as_slice();
    let mut f = 0;
    mesh.faces.retain(|_| {
        let is_duplicate = rest.first() == Some(&f);
        rest = &rest[usize::from(is_duplicate)..];
        f += 1;
        !is_duplicate
    });
    duplicates.len() as u64
}

/// Drops vertices that no face uses; the others keep their order. Returns how many.
pub(super) fn drop_unreferenced_vertices(mesh: &mut TriMesh) -> u64 {
    let mut is_used = vec![false; mesh.positions.len()];
    mesh.faces.as_flattened().iter().for_each(|&v| is_used[v as usize] = true);
    let dropped = is_used.iter().filter(|used| !**used).count() as u64;
    if dropped == 0 {
        return 0;
    }
    let mut used = 0;
    let new_index: Vec<u32> = is_used
        .iter()
        .map(|&is_used| {
            used += u32::from(is_used);
            // Never read for an unused vertex.
            used.wrapping_sub(1)
        })
        .collect();
    mesh.faces.as_flattened_mut().iter_mut().for_each(|v| *v = new_index[*v as usize]);
    retain_by(&mut mesh.positions, &is_used);
    if let Some(colors) = &mut mesh.colors {
        retain_by(colors, &is_used);
    }
    dropped
}

fn retain_by<T>(items: &mut Vec<T>, keep: &[bool]) {
    let mut keep = keep.iter();
    items.retain(|_| *keep.next().expect("one flag for each item"));
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mesh(faces: &[[u32; 3]]) -> TriMesh {
        let positions = (0..6).map(|k| [f64::from(k), 0.0, 0.0]).collect();
        TriMesh { positions, faces: faces.to_vec(), colors: Some((0..6).map(|k| [k; 3]).collect()) }
    }

    #[test]
    fn faces_without_finite_positions_go() {
        let mut mesh = mesh(&[[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 1, 6], [0, 2, 5]]);
        mesh.positions[3][1] = f64::NAN;
        mesh.positions[4][2] = f64::NEG_INFINITY;
        assert_eq!(drop_unusable_faces(&mut mesh), 3);
        assert_eq!(mesh.faces, [[0, 1, 2], [0, 2, 5]]);
    }

    #[test]
    fn faces_with_a_repeated_vertex_go_and_those_of_zero_area_stay() {
        let mut mesh = mesh(&[[0, 0, 1], [0, 1, 0], [1, 0, 0], [2, 2, 2], [0, 1, 2]]);
        assert_eq!(drop_degenerate_faces(&mut mesh), 4);
        assert_eq!(mesh.faces, [[0, 1, 2]]);
    }

    #[test]
    fn the_first_of_two_equal_faces_stays_and_so_does_its_back() {
        let mut mesh = mesh(&[[1, 2, 0], [3, 4, 5], [0, 1, 2], [0, 2, 1], [2, 0, 1], [5, 4, 3]]);
        assert_eq!(drop_duplicate_faces(&mut mesh), 2);
        assert_eq!(mesh.faces, [[1, 2, 0], [3, 4, 5], [0, 2, 1], [5, 4, 3]]);
    }

    #[test]
    fn vertices_without_faces_go_with_their_colors() {
        let mut mesh = mesh(&[[1, 3, 5], [5, 3, 4]]);
        assert_eq!(drop_unreferenced_vertices(&mut mesh), 2);
        assert_eq!(mesh.faces, [[0, 1, 3], [3, 1, 2]]);
        assert_eq!(mesh.positions.iter().map(|p| p[0]).collect::<Vec<_>>(), [1.0, 3.0, 4.0, 5.0]);
        assert_eq!(mesh.colors.unwrap(), [[1; 3], [3; 3], [4; 3], [5; 3]]);
    }
}
