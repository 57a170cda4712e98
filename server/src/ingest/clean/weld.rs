//! Joins vertices at exactly the same position: scans and renderers' files come with their seams split.

use crate::mesh::TriMesh;

/// Lets faces use the first of all vertices at one position; the others stay, unused. -0.0 equals 0.0.
///
/// The colour of the first becomes the mean of all, channel by channel, rounded half up. Only vertices that a face
/// uses take part; their positions are finite. Returns how many vertices lost their faces. O(n log n).
pub(super) fn weld(mesh: &mut TriMesh) -> u64 {
    let mut is_used = vec![false; mesh.positions.len()];
    mesh.faces.as_flattened().iter().for_each(|&v| is_used[v as usize] = true);
    let mut keys: Vec<([u64; 3], u32)> = (0..)
        .zip(&mesh.positions)
        .filter(|&(v, _)| is_used[v as usize])
        .map(|(v, position): (u32, _)| (position.map(bits), v))
        .collect();
    keys.sort_unstable();
    let mut targets: Vec<u32> = Vec::new();
    let mut welded = 0;
    for group in keys.chunk_by(|a, b| a.0 == b.0).filter(|group| group.len() > 1) {
        if targets.is_empty() {
            targets = (0..mesh.positions.len() as u32).collect();
        }
        let first = group[0].1;
        group.iter().for_each(|&(_, v)| targets[v as usize] = first);
        welded += group.len() as u64 - 1;
        if let Some(colors) = &mut mesh.colors {
            let count = group.len() as u64;
            colors[first as usize] = std::array::from_fn(|k| {
                let sum: u64 = group.iter().map(|&(_, v)| u64::from(colors[v as usize][k])).sum();
                u8::try_from((sum + count / 2) / count).expect("a mean of bytes is a byte")
            });
        }
    }
    if welded > 0 {
        mesh.faces.as_flattened_mut().iter_mut().for_each(|v| *v = targets[*v as usize]);
    }
    welded
}

/// Equal for equal numbers, also for the two zeros.
fn bits(coordinate: f64) -> u64 {
    (coordinate + 0.0).to_bits()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two triangles with a split seam, and one vertex at the seam that no face uses.
    ///
    /// ```text
    ///   2 5---4
    ///   |\ \  |
    ///   | \ \ |
    ///   0--1 3     6 at 1
    /// ```
    #[test]
    fn a_seam_is_closed_and_its_colors_are_averaged() {
        let mut mesh = TriMesh {
            positions: vec![
                [0.0, 0.0, 0.0],
                [1.0, 0.0, 0.0],
                [0.0, 1.0, 0.0],
                [1.0, -0.0, 0.0],
                [1.0, 1.0, 0.0],
                [-0.0, 1.0, 0.0],
                [1.0, 0.0, 0.0],
            ],
            faces: vec![[0, 1, 2], [3, 4, 5]],
            colors: Some(vec![[0; 3], [10, 0, 255], [0; 3], [11, 1, 255], [9; 3], [2; 3], [200; 3]]),
        };
        assert_eq!(weld(&mut mesh), 2);
        assert_eq!(mesh.faces, [[0, 1, 2], [1, 4, 2]]);
        let colors = mesh.colors.unwrap();
        assert_eq!((colors[1], colors[2]), ([11, 1, 255], [1; 3]));
    }

    #[test]
    fn near_is_not_the_same() {
        let mut mesh = TriMesh {
            positions: vec![[0.0; 3], [f64::MIN_POSITIVE; 3], [1.0; 3], [1.0 + f64::EPSILON; 3]],
            faces: vec![[0, 1, 2], [1, 2, 3]],
            colors: None,
        };
        assert_eq!(weld(&mut mesh), 0);
        assert_eq!(mesh.faces, [[0, 1, 2], [1, 2, 3]]);
    }
}
