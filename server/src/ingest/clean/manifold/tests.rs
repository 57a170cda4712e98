use super::*;

fn check(positions: &[[f64; 3]], faces: &[[u32; 3]], expected: &[[u32; 3]]) -> Resolved {
    let mut mesh = TriMesh { positions: positions.to_vec(), faces: faces.to_vec(), colors: None };
    let table = EdgeTable::new(mesh.positions.len(), &mesh.faces);
    let resolved = resolve(&mut mesh, &table);
    assert_eq!(mesh.faces, expected);
    assert_eq!(mesh.positions.len(), positions.len() + resolved.copies as usize);
    resolved
}

/// The edge 0-1 along y and four wings around it; counter-clockwise they are 2, 4, 3, 5.
const CROSS: [[f64; 3]; 6] =
    [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.5, 0.0], [-1.0, 0.5, 0.0], [0.0, 0.5, -1.0], [0.0, 0.5, 1.0]];

/// ```text
///   2     4
///   | \ / |
///   |  0  |
///   | / \ |
///   1     3
/// ```
#[test]
fn a_bow_tie_gets_two_vertices() {
    let resolved = check(&CROSS, &[[0, 2, 1], [0, 3, 4]], &[[0, 2, 1], [6, 3, 4]]);
    assert_eq!(resolved, Resolved { split_vertices: 1, copies: 1, ..Resolved::default() });
}

#[test]
fn a_fin_on_a_flat_sheet_is_cut_off() {
    for [a, b] in [[0, 1], [1, 0]] {
        let resolved = check(&CROSS, &[[0, 1, 3], [1, 0, 2], [a, b, 4]], &[[0, 1, 3], [1, 0, 2], [6, 7, 4]]);
        assert_eq!((resolved.non_manifold_edges, resolved.cut_sides, resolved.copies), (1, 1, 2));
    }
}

/// Sheets 2-0-1-3 and 4-0-1-5 cross; what is left touches but no longer crosses.
#[test]
fn crossing_sheets_come_apart_without_a_cut() {
    let faces = [[0, 1, 2], [1, 0, 3], [0, 1, 4], [1, 0, 5]];
    let resolved = check(&CROSS, &faces, &[[0, 1, 2], [6, 7, 3], [7, 6, 4], [1, 0, 5]]);
    assert_eq!((resolved.non_manifold_edges, resolved.cut_sides, resolved.copies), (1, 0, 2));
}

/// Two wedges of a solid that touch along an edge stay two wedges.
#[test]
fn solids_that_touch_along_an_edge_come_apart() {
    // Inside lies from backward to forward, counter-clockwise: 2 to 4 and 3 to 5.
    let resolved =
        check(&CROSS, &[[1, 0, 2], [0, 1, 4], [1, 0, 3], [0, 1, 5]], &[[1, 0, 2], [0, 1, 4], [6, 7, 3], [7, 6, 5]]);
    assert_eq!((resolved.non_manifold_edges, resolved.cut_sides, resolved.copies), (1, 0, 2));
}
