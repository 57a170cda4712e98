use super::*;
use crate::mesh::audit::{Audit, audit};

fn mesh(positions: &[[f64; 3]], faces: &[[u32; 3]]) -> TriMesh {
    TriMesh { positions: positions.to_vec(), faces: faces.to_vec(), colors: None }
}

/// Cleans and checks what is promised of any input; returns what the report and the audit say.
fn check(input: &TriMesh) -> (TriMesh, CleanReport, Audit) {
    let (output, report) = clean(input.clone());
    let audit = audit(&output);
    assert!(audit.is_clean(), "{input:?}\n{output:?}\n{audit:?}");
    assert_eq!((report.vertices_after, report.triangles_after), (audit.vertices, audit.triangles));
    assert_eq!(report.components, audit.components);
    let dropped = report.unusable_faces + report.degenerate_faces + report.duplicate_faces;
    assert_eq!(report.triangles_before - dropped, report.triangles_after);
    let gone = report.welded_vertices + report.unreferenced_vertices;
    assert_eq!(report.vertices_before - gone + report.vertex_copies, report.vertices_after);
    (output, report, audit)
}

/// Corners of all faces with finite positions, sorted, as if faces had no orientation.
fn shapes(mesh: &TriMesh) -> Vec<Vec<[u64; 3]>> {
    let is_finite = |&v: &u32| mesh.positions[v as usize].iter().all(|c| c.is_finite());
    let corner = |v: u32| mesh.positions[v as usize].map(|c| (c + 0.0).to_bits());
    let mut shapes: Vec<Vec<_>> = mesh
        .faces
        .iter()
        .filter(|face| face.iter().all(is_finite))
        .map(|face| {
            let mut corners: Vec<_> = face.iter().map(|&v| corner(v)).collect();
            corners.sort_unstable();
            corners
        })
        .collect();
    shapes.sort_unstable();
    shapes
}

/// A strip of `count` quads bent into a ring, its end joined upside down.
fn moebius(count: u32) -> TriMesh {
    let mut positions = Vec::new();
    for k in 0..count {
        let turn = f64::from(k) / f64::from(count) * std::f64::consts::TAU;
        for side in [-0.3, 0.3] {
            let (r, z) = (1.0 + side * (turn / 2.0).cos(), side * (turn / 2.0).sin());
            positions.push([r * turn.cos(), r * turn.sin(), z]);
        }
    }
    let mut faces = Vec::new();
    for k in 0..count {
        let [a, b] = [2 * k, 2 * k + 1];
        let [c, d] = if k + 1 < count { [a + 2, b + 2] } else { [1, 0] };
        faces.extend([[a, c, b], [b, c, d]]);
    }
    mesh(&positions, &faces)
}

#[test]
fn a_moebius_strip_is_cut_open_once() {
    let (output, report, audit) = check(&moebius(9));
    assert_eq!(output.faces.len(), 18);
    assert_eq!((audit.components, audit.boundary_loops, audit.genus), (1, 1, Some(0)));
    assert_eq!((report.one_sided_edges, report.vertex_copies), (1, 2));
}

/// A closed surface with one side: the Moebius strip with a disk along its single boundary.
#[test]
fn a_projective_plane_becomes_a_disk() {
    // The six vertices of the icosahedron with opposite points taken as one.
    let faces = [
        [0, 1, 2],
        [0, 2, 3],
        [0, 3, 4],
        [0, 4, 5],
        [0, 5, 1], //
        [1, 2, 4],
        [2, 3, 5],
        [3, 4, 1],
        [4, 5, 2],
        [5, 1, 3],
    ];
    let positions: Vec<[f64; 3]> = (0..6).map(|k| [f64::from(k * k % 5), f64::from(k), f64::from(k % 2)]).collect();
    let input = mesh(&positions, &faces);
    assert_eq!((audit(&input).boundary_edges, audit(&input).euler_characteristic), (0, 1));
    let (_, report, audit) = check(&input);
    assert!(report.one_sided_edges > 0);
    assert_eq!((audit.components, audit.boundary_loops, audit.genus), (1, 1, Some(0)));
}

/// A flap (a face and its back) stands on the edge of two faces. Joined as a fold of one sheet it would pass the edge
/// twice between the same two vertices, so it comes off as a closed piece of its own.
#[test]
fn a_flap_comes_off_its_sheet() {
    let positions = [[0.0; 3], [0.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, -1.0, 0.0], [-1.0, 0.0, -1.0]];
    let (output, report, _) = check(&mesh(&positions, &[[0, 4, 1], [4, 0, 1], [0, 4, 2], [4, 0, 3]]));
    assert_eq!(output.faces, [[0, 4, 1], [4, 0, 1], [5, 6, 2], [6, 5, 3]]);
    assert_eq!((report.non_manifold_edges, report.cut_sides, report.double_edges), (1, 0, 1));
}

#[test]
fn a_clean_mesh_stays_as_it_is() {
    let tetrahedron = mesh(
        &[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        &[[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
    );
    let (output, report, audit) = check(&tetrahedron);
    assert_eq!(output, tetrahedron);
    assert_eq!(report.to_string(), "4 vertices and 4 triangles became 4 and 4 in 1 components");
    assert_eq!(audit.genus, Some(0));
}

#[test]
fn every_step_shows_in_the_report() {
    let positions = [
        [0.0; 3],
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0],
        [1.0, 1.0, 0.0],
        [0.0; 3],
        [f64::NAN; 3],
        [9.0; 3],
        [0.0, 1.0, 0.0],
    ];
    let faces = [[0, 1, 2], [1, 2, 3], [0, 1, 5], [0, 4, 1], [1, 7, 4], [0, 2, 2]];
    let (_, report, _) = check(&mesh(&positions, &faces));
    assert_eq!(
        report.to_string(),
        "8 vertices and 6 triangles became 4 and 2 in 1 components\n  1 faces without finite positions dropped\n  \
         2 vertices welded to another at the same position\n  2 faces with a repeated vertex dropped\n  \
         1 duplicate faces dropped\n  2 vertices without a face dropped\n  1 faces turned round"
    );
    assert!(serde_json::to_string(&report).unwrap().contains("\"welded_vertices\":2"));
}

#[test]
fn an_empty_mesh_and_a_mesh_without_a_good_face_are_fine() {
    check(&TriMesh::default());
    let (output, ..) = check(&mesh(&[[0.0; 3], [1.0; 3]], &[[0, 1, 1], [0, 1, 7]]));
    assert_eq!(output, TriMesh::default());
}

/// Random faces over few vertices are as tangled as meshes get: edges of many faces, one-sided patches, double edges.
#[test]
fn any_soup_becomes_a_manifold_of_the_same_triangles() {
    let mut random = fastrand::Rng::with_seed(11);
    let (mut double_edges, mut one_sided, mut copies) = (0, 0, 0);
    for round in 0..30_000 {
        let vertices = random.u32(4..16);
        let extent = random.u32(1..6);
        let count = random.usize(1..40);
        let position = |random: &mut fastrand::Rng| {
            std::array::from_fn(|_| match random.u32(..40) {
                // Squares of these overflow, vanish or are no numbers; nothing may depend on them.
                k @ 0..6 if round % 3 == 0 => [f64::MAX, -1e300, 1e-300, -0.0, f64::NAN, f64::INFINITY][k as usize],
                _ => f64::from(random.u32(..=extent)),
            })
        };
        let input = TriMesh {
            positions: (0..vertices).map(|_| position(&mut random)).collect(),
            faces: (0..count).map(|_| std::array::from_fn(|_| random.u32(..vertices))).collect(),
            colors: (round % 2 == 0).then(|| (0..vertices).map(|v| [v as u8; 3]).collect()),
        };
        let (output, report, _) = check(&input);
        double_edges += report.double_edges;
        one_sided += report.one_sided_edges;
        copies += report.vertex_copies;
        // Whatever was dropped was degenerate or a duplicate: as sets of corners, the rest is all there.
        let mut expected = shapes(&input);
        expected.retain(|corners| corners[0] != corners[1] && corners[1] != corners[2]);
        let mut actual = shapes(&output);
        expected.dedup();
        actual.dedup();
        assert_eq!(actual, expected, "round {round}");
        assert_eq!(clean(input).0, output, "round {round} is not repeatable");
    }
    assert!(double_edges > 1000 && one_sided > 50 && copies > 10_000, "{double_edges} {one_sided} {copies}");
}

/// However many faces meet, sorting them and taking pairs out of the circle stays near linear.
#[test]
fn a_fan_of_many_faces_around_one_edge_takes_near_linear_time() {
    let count = 100_000_u32;
    let mut positions = vec![[0.0; 3], [0.0, 0.0, 1.0]];
    let mut random = fastrand::Rng::with_seed(3);
    positions.extend((0..count).map(|_| [random.f64() - 0.5, random.f64() - 0.5, 0.5]));
    let faces: Vec<[u32; 3]> = (2..count + 2).map(|v| if random.bool() { [0, 1, v] } else { [1, 0, v] }).collect();
    let start = std::time::Instant::now();
    let (_, report, _) = check(&mesh(&positions, &faces));
    assert!(start.elapsed().as_secs() < 5, "{:?}", start.elapsed());
    assert!(report.cut_sides < u64::from(count) / 20, "{report}");
}

/// Reads and cleans every real mesh in the folder that `LODESTREAM_MESHES` names, and prints what came of it.
#[test]
fn real_meshes_become_clean() {
    let Some(folder) = std::env::var_os("LODESTREAM_MESHES").map(std::path::PathBuf::from) else {
        eprintln!("skipped: LODESTREAM_MESHES is not set");
        return;
    };
    let mut paths: Vec<_> = [folder.clone(), folder.join("odd")]
        .iter()
        .filter_map(|folder| std::fs::read_dir(folder).ok())
        .flatten()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.is_file() && !path.extension().is_some_and(|e| e == "md" || e == "mtl" || e == "png"))
        .collect();
    paths.sort();
    assert!(!paths.is_empty());
    for path in paths {
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let start = std::time::Instant::now();
        let (input, read_report) = match crate::ingest::read::read_mesh_in_memory(&path) {
            Ok(read) => read,
            Err(error) => {
                println!("{name}: {error}");
                continue;
            }
        };
        let read_time = start.elapsed();
        let copy = input.clone();
        let start = std::time::Instant::now();
        std::hint::black_box(clean(copy));
        let clean_time = start.elapsed();
        let before = audit(&input);
        let (output, report, after) = check(&input);
        println!("{name}: {read_report:?}");
        println!(
            "  read in {read_time:?}, cleaned in {clean_time:?}\n  before {before:?}\n  {report}\n  after {after:?}"
        );
        let largest = largest_component(&output);
        if largest.faces.len() < output.faces.len() {
            println!("  largest component {:?}", audit(&largest));
        }
    }
}

fn largest_component(mesh: &TriMesh) -> TriMesh {
    let labels = components(mesh);
    let mut sizes = vec![0; labels.iter().max().map_or(0, |label| *label as usize + 1)];
    labels.iter().for_each(|label| sizes[*label as usize] += 1);
    let largest = (0..sizes.len()).max_by_key(|&label| sizes[label]).map(|label| label as u32);
    let faces = mesh.faces.iter().zip(&labels).filter(|(_, label)| Some(**label) == largest).map(|(face, _)| *face);
    TriMesh { faces: faces.collect(), ..mesh.clone() }
}
