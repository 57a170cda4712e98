use std::collections::{BTreeMap, BTreeSet};

use super::*;

fn mesh(vertices: usize, faces: &[[u32; 3]]) -> TriMesh {
    TriMesh { positions: vec![[0.0; 3]; vertices], faces: faces.to_vec(), colors: None }
}

/// Repeats `merge` until no two sets touch, the dull way.
fn merged(mut sets: Vec<BTreeSet<u32>>) -> usize {
    'again: loop {
        for a in 0..sets.len() {
            for b in a + 1..sets.len() {
                if !sets[a].is_disjoint(&sets[b]) {
                    let other = sets.swap_remove(b);
                    sets[a].extend(other);
                    continue 'again;
                }
            }
        }
        return sets.len();
    }
}

/// The dull twin of [`audit`].
fn naive(mesh: &TriMesh) -> Audit {
    let faces: Vec<[u32; 3]> = mesh.faces.iter().copied().filter(|&[a, b, c]| a != b && b != c && c != a).collect();
    let mut edges: BTreeMap<(u32, u32), Vec<bool>> = BTreeMap::new();
    for face in &faces {
        for k in 0..3 {
            let (a, b) = (face[k], face[(k + 1) % 3]);
            edges.entry((a.min(b), a.max(b))).or_default().push(a < b);
        }
    }
    let pairs = |keep: &dyn Fn(&Vec<bool>) -> bool| edges.iter().filter(|(_, d)| keep(d)).count() as u64;
    let boundary: Vec<BTreeSet<u32>> =
        edges.iter().filter(|(_, d)| d.len() == 1).map(|(&(a, b), _)| BTreeSet::from([a, b])).collect();
    let used: BTreeSet<u32> = mesh.faces.as_flattened().iter().copied().collect();
    let multi_fan = used.iter().filter(|&&v| {
        // Opposite edges of the faces at `v`: connected if and only if the faces are a single fan.
        let link = faces.iter().filter(|f| f.contains(&v)).map(|f| f.iter().copied().filter(|&w| w != v).collect());
        merged(link.collect()) > 1
    });
    let mut seen = BTreeSet::new();
    let is_repeated = |&&[a, b, c]: &&[u32; 3]| !seen.insert([[a, b, c], [b, c, a], [c, a, b]].into_iter().min());
    let mut audit = Audit {
        vertices: mesh.positions.len() as u64,
        triangles: mesh.faces.len() as u64,
        edges: edges.len() as u64,
        non_manifold_edges: pairs(&|d| d.len() > 2),
        inconsistent_edges: pairs(&|d| d.len() == 2 && d[0] == d[1]),
        multi_fan_vertices: multi_fan.count() as u64,
        boundary_edges: boundary.len() as u64,
        boundary_loops: merged(boundary) as u64,
        components: merged(mesh.faces.iter().map(|&f| BTreeSet::from(f)).collect()) as u64,
        euler_characteristic: used.len() as i64 - edges.len() as i64 + mesh.faces.len() as i64,
        genus: None,
        degenerate_faces: (mesh.faces.len() - faces.len()) as u64,
        duplicate_faces: mesh.faces.iter().filter(is_repeated).count() as u64,
        unreferenced_vertices: (mesh.positions.len() - used.len()) as u64,
    };
    if audit.is_manifold() {
        let (components, loops) = (audit.components as i64, audit.boundary_loops as i64);
        audit.genus = Some((2 * components - audit.euler_characteristic - loops) / 2);
    }
    audit
}

#[test]
fn counts_equal_those_of_the_naive_audit() {
    let mut random = fastrand::Rng::with_seed(7);
    for round in 0..2000 {
        let vertices = random.u32(3..14);
        let faces: Vec<[u32; 3]> =
            (0..random.usize(..24)).map(|_| std::array::from_fn(|_| random.u32(..vertices))).collect();
        let mesh = mesh(vertices as usize, &faces);
        assert_eq!(audit(&mesh), naive(&mesh), "round {round}: {faces:?}");
    }
}

#[test]
fn a_tetrahedron_is_clean_and_has_no_handle() {
    let audit = audit(&mesh(4, &[[0, 1, 2], [0, 2, 3], [0, 3, 1], [3, 2, 1]]));
    assert!(audit.is_clean());
    assert_eq!((audit.edges, audit.boundary_edges, audit.euler_characteristic, audit.genus), (6, 0, 2, Some(0)));
}

/// A grid of 3 x 3 vertices whose opposite sides are the same.
#[test]
fn a_torus_has_one_handle() {
    let vertex = |x: u32, y: u32| x % 3 + 3 * (y % 3);
    let faces: Vec<[u32; 3]> = (0..9)
        .flat_map(|k| {
            let (x, y) = (k % 3, k / 3);
            let [a, b, c, d] = [vertex(x, y), vertex(x + 1, y), vertex(x + 1, y + 1), vertex(x, y + 1)];
            [[a, b, c], [a, c, d]]
        })
        .collect();
    assert_eq!(audit(&mesh(9, &faces)).genus, Some(1));
    // Without one face the handle is still there.
    let open = audit(&mesh(9, &faces[1..]));
    assert_eq!((open.boundary_edges, open.boundary_loops, open.genus), (3, 1, Some(1)));
}

#[test]
fn every_fault_is_counted() {
    let audit = audit(&mesh(
        12,
        &[[0, 1, 2], [1, 0, 3], [0, 1, 4], [4, 5, 6], [5, 4, 6], [6, 5, 4], [7, 7, 8], [2, 9, 10], [9, 2, 11]],
    ));
    assert_eq!(audit.non_manifold_edges, 1 + 3);
    assert!(audit.multi_fan_vertices > 0 && !audit.is_manifold());
    assert_eq!((audit.degenerate_faces, audit.duplicate_faces, audit.unreferenced_vertices), (1, 1, 0));
    assert_eq!(super::audit(&TriMesh::default()).components, 0);
}
