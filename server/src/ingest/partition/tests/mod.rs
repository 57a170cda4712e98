//! The partition against its dull twin: cleaning and rounding in memory, by [`clean`], [`choose`] and [`round`].

mod meshes;

use std::path::Path;

use glam::DVec3;

use self::meshes::*;
use super::*;
use crate::ingest::chunks::{height_of, pack, patches};
use crate::ingest::clean::{clean, components};
use crate::ingest::simplify::lattice::{choose, round};
use crate::mesh::TriMesh;
use crate::mesh::audit::audit;
use crate::mesh::edges::{DisjointSets, EdgeTable};
use crate::mesh::morton::morton;
use crate::pack::CompleteMesh;

mod resample;

/// Few enough for a mesh of a few hundred faces to have chunks of chunks.
const SMALL: Limits = Limits { vertices: 20, faces: 12 };

fn run(mesh: &TriMesh, bits: Option<u8>, limits: Limits, memory: u64) -> (ChunkedMesh, CleanReport) {
    run_with(mesh, &PartitionOptions { bits, limits, ..PartitionOptions::default() }, memory)
}

fn run_with(mesh: &TriMesh, options: &PartitionOptions, memory: u64) -> (ChunkedMesh, CleanReport) {
    let workspace = Workspace::new(&std::env::temp_dir(), memory);
    let raw = RawMesh::of(mesh, &workspace).unwrap();
    let mut told = vec![0.0];
    let result = partition(raw, options, &workspace, &mut |done| told.push(done)).unwrap();
    assert!(told.is_sorted() && told.iter().all(|done| (0.0..=1.0).contains(done)), "{told:?}");
    result
}

/// All that a chunked mesh holds, and the report.
fn contents(result: &(ChunkedMesh, CleanReport)) -> impl PartialEq + std::fmt::Debug + use<> {
    let (mesh, report) = result;
    let vertices: Vec<_> = (0..mesh.vertices.len() as u32)
        .map(|v| {
            (mesh.vertices.position(v), mesh.vertices.color(v), mesh.vertices.is_boundary(v), mesh.vertices.height(v))
        })
        .collect();
    let components: Vec<_> = mesh.components.components.iter().map(|c| (c.low, c.high, c.height)).collect();
    (
        (mesh.lattice, mesh.has_colors, mesh.is_open, mesh.complete),
        vertices,
        mesh.faces.read(0..mesh.faces.len()).unwrap(),
        mesh.chunk_starts.clone(),
        (mesh.components.patch_starts.clone(), mesh.components.of_patch.clone(), components),
        report.clone(),
    )
}

/// Partitions in chunks of all sizes and holds the results against the twin.
fn check(input: &TriMesh, bits: Option<u8>) -> CleanReport {
    let whole = run(input, bits, Limits::default(), u64::MAX);
    let small = run(input, bits, SMALL, u64::MAX);
    for (result, limits) in [(&whole, Limits::default()), (&small, SMALL)] {
        check_chunks(&result.0, limits);
        check_twin(input, bits, result);
    }
    assert_eq!(contents(&small), contents(&run(input, bits, SMALL, 0)), "the memory budget shows");
    whole.1
}

/// What the module of chunks promises.
fn check_chunks(mesh: &ChunkedMesh, limits: Limits) {
    let faces = mesh.faces.read(0..mesh.faces.len()).unwrap();
    assert_eq!((mesh.chunk_starts[0], mesh.chunk_starts[mesh.chunk_count() as usize]), (0, faces.len() as u32));
    let mut chunks_of = vec![(u32::MAX, 0); mesh.vertices.len()];
    let mut of_face = Vec::new();
    assert_eq!(mesh.components.patch_starts.len(), mesh.chunk_starts.len());
    let mut patch_count = 0;
    for chunk in 0..mesh.chunk_count() {
        let faces = mesh.chunk(chunk).unwrap();
        assert!(!faces.is_empty());
        // Of a vertex with more faces, there may be copies.
        let mut lows = faces.iter().map(|face| mesh.vertices.position(*face.iter().min().unwrap()));
        let first = lows.next().unwrap();
        let one_vertex = lows.all(|p| p == first);
        assert!(faces.len() <= limits.faces || one_vertex, "{} faces", faces.len());
        for &v in faces.as_flattened() {
            let (first, last) = &mut chunks_of[v as usize];
            (*first, *last) = ((*first).min(chunk), chunk);
        }
        let (patches, count) = patches(mesh.vertices.len(), &faces);
        let first = mesh.components.patch_starts[chunk as usize];
        assert_eq!(first, patch_count);
        patch_count += count;
        of_face.extend(patches.iter().map(|patch| mesh.components.of_patch[(first + patch) as usize]));
    }
    assert_eq!(patch_count, *mesh.components.patch_starts.last().unwrap());
    assert_eq!(patch_count as usize, mesh.components.of_patch.len());

    let mut is_boundary = vec![false; mesh.vertices.len()];
    for edge in EdgeTable::new(mesh.vertices.len(), &faces).edges().filter(|edge| edge.len() == 1) {
        is_boundary[edge.low as usize] = true;
        is_boundary[edge.high as usize] = true;
    }
    for v in 0..mesh.vertices.len() as u32 {
        let (first, last) = chunks_of[v as usize];
        assert_eq!(mesh.vertices.height(v), height_of(first, last), "vertex {v}");
        assert_eq!(mesh.vertices.is_boundary(v), is_boundary[v as usize], "vertex {v}");
    }

    let labels = components(&unchunked(mesh));
    assert_eq!(of_face, labels, "components are numbered by their first face");
    for (label, component) in (0..).zip(&mesh.components.components) {
        let members = || (0..faces.len()).filter(|&f| labels[f] == label);
        let chunk_of = |face: usize| mesh.chunk_starts.partition_point(|&start| start as usize <= face) as u32 - 1;
        let height = height_of(chunk_of(members().next().unwrap()), chunk_of(members().next_back().unwrap()));
        let corners = members().flat_map(|f| faces[f]).map(|v| mesh.vertices.position(v));
        let low = corners.clone().reduce(|a, b| std::array::from_fn(|k| a[k].min(b[k]))).unwrap();
        let high = corners.reduce(|a, b| std::array::from_fn(|k| a[k].max(b[k]))).unwrap();
        assert_eq!((component.low, component.high, component.height), (low, high, height));
        if mesh.components.components.len() > 100 && label > 20 {
            break;
        }
    }
}

/// In lattice steps.
fn unchunked(mesh: &ChunkedMesh) -> TriMesh {
    let vertices = 0..mesh.vertices.len() as u32;
    TriMesh {
        positions: vertices.clone().map(|v| mesh.vertices.position(v).map(f64::from)).collect(),
        faces: mesh.faces.read(0..mesh.faces.len()).unwrap(),
        colors: mesh.has_colors.then(|| vertices.map(|v| mesh.vertices.color(v)).collect()),
    }
}

/// Position and colour.
type Corner = (u64, [u8; 3]);

/// By component, its oriented triangles, by the positions and colours of their corners: sorted.
fn shape(mesh: &TriMesh) -> Vec<Vec<[Corner; 3]>> {
    let corner = |v: u32| {
        let p = mesh.positions[v as usize].map(|x| x as i32);
        (pack(p), mesh.colors.as_ref().map_or([0; 3], |colors| colors[v as usize]))
    };
    let labels = components(mesh);
    let mut parts = vec![Vec::new(); labels.iter().max().map_or(0, |max| *max as usize + 1)];
    for (face, label) in mesh.faces.iter().zip(labels) {
        let [a, b, c] = face.map(corner);
        parts[label as usize].push([[a, b, c], [b, c, a], [c, a, b]].into_iter().min().unwrap());
    }
    parts.iter_mut().for_each(|part| part.sort_unstable());
    parts.sort_unstable();
    parts
}

/// Position, colour, number of faces, whether on the boundary: what can be said of a vertex without its number.
fn vertices(mesh: &TriMesh) -> Vec<(Corner, u32, bool)> {
    let mut faces = vec![0; mesh.positions.len()];
    mesh.faces.as_flattened().iter().for_each(|&v| faces[v as usize] += 1);
    let mut is_boundary = vec![false; mesh.positions.len()];
    for edge in EdgeTable::new(mesh.positions.len(), &mesh.faces).edges().filter(|edge| edge.len() == 1) {
        is_boundary[edge.low as usize] = true;
        is_boundary[edge.high as usize] = true;
    }
    let color = |v: usize| mesh.colors.as_ref().map_or([0; 3], |colors| colors[v]);
    let of = |v: usize| ((pack(mesh.positions[v].map(|x| x as i32)), color(v)), faces[v], is_boundary[v]);
    let mut vertices: Vec<_> = (0..mesh.positions.len()).map(of).collect();
    vertices.sort_unstable();
    vertices
}

/// The rule of [`super::super::simplify::build`].
fn is_open(mesh: &TriMesh) -> bool {
    let at = |v: u32| DVec3::from_array(mesh.positions[v as usize]);
    let area: f64 = mesh.faces.iter().map(|f| (at(f[1]) - at(f[0])).cross(at(f[2]) - at(f[0])).length() * 0.5).sum();
    let table = EdgeTable::new(mesh.positions.len(), &mesh.faces);
    let boundary = table.edges().filter(|edge| edge.len() == 1).map(|edge| at(edge.low).distance(at(edge.high)));
    boundary.sum::<f64>().powi(2) > 4.0 * area
}

fn check_twin(input: &TriMesh, bits: Option<u8>, (mesh, report): &(ChunkedMesh, CleanReport)) {
    let (cleaned, expected_report) = clean(input.clone());
    assert_eq!(*report, expected_report, "{report}\n{expected_report}");
    let lattice = choose(&cleaned, bits);
    assert_eq!(mesh.lattice, lattice);
    let rounded: Vec<[i32; 3]> = round(&cleaned, &lattice).iter().map(|point| point.position).collect();
    assert_eq!(mesh.complete, CompleteMesh::of(&rounded, cleaned.colors.as_deref(), &cleaned.faces));
    let twin = TriMesh { positions: rounded.iter().map(|p| p.map(f64::from)).collect(), ..cleaned };
    let actual = unchunked(mesh);
    assert_eq!(actual.colors.is_some(), twin.colors.is_some());
    let audit = [audit(&actual), audit(&twin)];
    assert!(audit[0].is_clean(), "{:?}", audit[0]);
    assert_eq!(audit[0], audit[1]);
    assert_eq!(shape(&actual), shape(&twin));
    assert_eq!(vertices(&actual), vertices(&twin));
    assert_eq!(mesh.is_open, is_open(&twin));
}

#[test]
fn clean_meshes_of_many_chunks() {
    for mesh in [TriMesh::default(), triangle(), sheet(20, 13), torus(30, 11), separate(200, 1), colored(torus(12, 20))]
    {
        let report = check(&mesh, None);
        assert_eq!(report.vertex_copies + report.turned_faces + report.welded_vertices, 0);
        check(&mesh, Some(8));
    }
    let (mesh, _) = run(&torus(60, 40), Some(10), SMALL, 0);
    assert!(mesh.height() >= 3 && mesh.vertices.height(0) < mesh.height());
}

#[test]
fn soups_without_shared_vertices_are_welded() {
    for mesh in [sheet(9, 9), torus(10, 12), colored(torus(20, 9))] {
        let soup = exploded(&mesh);
        let report = check(&soup, None);
        assert_eq!(report.welded_vertices, (soup.positions.len() - mesh.positions.len()) as u64);
    }
}

#[test]
fn turned_faces_are_turned_back() {
    let mut random = fastrand::Rng::with_seed(4);
    for share in [1, 3, 30, 100] {
        for mut mesh in [sheet(12, 9), torus(14, 12), separate(40, 2)] {
            let mut count = 0;
            for face in &mut mesh.faces {
                if random.usize(..100) < share {
                    face.swap(0, 2);
                    count += 1;
                }
            }
            let report = check(&mesh, None);
            assert_eq!(report.one_sided_edges, 0);
            assert!(report.turned_faces > 0 || count == 0 || share == 100 || mesh.positions.len() == 120);
        }
    }
}

/// Random faces over few vertices: edges of many faces, double edges, fans upon fans.
#[test]
fn any_soup_is_what_it_is_in_memory() {
    let mut random = fastrand::Rng::with_seed(11);
    let (mut double_edges, mut copies, mut turned, mut skipped) = (0, 0, 0, 0);
    for round in 0..4000 {
        let vertices = random.u32(4..24);
        let extent = random.u32(1..6);
        let count = random.usize(1..40);
        let position = |random: &mut fastrand::Rng| {
            std::array::from_fn(|_| match random.u32(..40) {
                k @ 0..6 if round % 3 == 0 => [f64::MAX, -1e300, 1e-300, -0.0, f64::NAN, f64::INFINITY][k as usize],
                _ => f64::from(random.u32(..=extent)),
            })
        };
        let input = TriMesh {
            positions: (0..vertices).map(|_| position(&mut random)).collect(),
            faces: (0..count)
                .map(|_| std::array::from_fn(|_| random.u32(..vertices + u32::from(round % 5 == 0))))
                .collect(),
            colors: (round % 2 == 0).then(|| (0..vertices).map(|v| [v as u8; 3]).collect()),
        };
        let report = clean(input.clone()).1;
        if report.one_sided_edges > 0 {
            // A one-sided patch is cut somewhere else.
            let result = run(&input, None, SMALL, 0);
            check_chunks(&result.0, SMALL);
            assert!(audit(&unchunked(&result.0)).is_clean());
            assert_eq!(result.1.triangles_after, report.triangles_after);
            skipped += 1;
            continue;
        }
        let report = check(&input, (round % 7 == 0).then_some(12));
        double_edges += report.double_edges;
        copies += report.vertex_copies;
        turned += report.turned_faces;
    }
    assert!(
        double_edges > 50 && copies > 2000 && turned > 1000 && skipped < 1000,
        "{double_edges} {copies} {turned} {skipped}"
    );
}

/// Trouble here and there in a mesh that is fine otherwise.
#[test]
fn local_trouble_is_cut_as_in_the_whole() {
    let mut random = fastrand::Rng::with_seed(7);
    for round in 0..60 {
        let mut mesh = if round % 2 == 0 { torus(16, 12) } else { colored(sheet(14, 14)) };
        let count = mesh.positions.len() as u32;
        for _ in 0..random.u32(1..8) {
            match random.u32(..5) {
                // A fin on an edge.
                0 => {
                    let [a, b, _] = mesh.faces[random.usize(..mesh.faces.len())];
                    mesh.faces.push([a, b, random.u32(..count)]);
                }
                // Its back.
                1 => {
                    let [a, b, c] = mesh.faces[random.usize(..mesh.faces.len())];
                    mesh.faces.push([c, b, a]);
                }
                // Two places become one.
                2 => {
                    let (a, b) = (random.u32(..count), random.u32(..count));
                    mesh.positions[a as usize] = mesh.positions[b as usize];
                }
                3 => {
                    let face = mesh.faces[random.usize(..mesh.faces.len())];
                    mesh.faces.push([face[1], face[2], face[0]]);
                }
                _ => {
                    mesh.faces.swap_remove(random.usize(..mesh.faces.len()));
                }
            }
        }
        if clean(mesh.clone()).1.one_sided_edges == 0 {
            check(&mesh, None);
        }
    }
}

#[test]
fn a_moebius_strip_is_cut_open() {
    for count in [9, 200] {
        let result = run(&moebius(count), None, SMALL, 0);
        check_chunks(&result.0, SMALL);
        let audit = audit(&unchunked(&result.0));
        assert!(audit.is_clean());
        assert_eq!((audit.components, audit.boundary_loops, audit.genus), (1, 1, Some(0)));
        assert_eq!(result.1.one_sided_edges, 1);
    }
}

#[test]
fn what_holds_no_face_gives_an_empty_mesh() {
    let point = |faces: &[[u32; 3]]| TriMesh {
        positions: vec![[1.0; 3], [1.0; 3], [2.0; 3], [f64::NAN; 3]],
        faces: faces.to_vec(),
        colors: None,
    };
    let nothing: [&[[u32; 3]]; 5] = [&[], &[[0, 1, 2]], &[[0, 2, 3]], &[[0, 2, 4], [7, 8, u32::MAX]], &[[0, 0, 0]]];
    for faces in nothing {
        let report = check(&point(faces), None);
        assert_eq!(report.triangles_after, 0);
    }
}

/// All vertices on one point of the lattice and of the curve, and some at one position.
#[test]
fn an_outlier_far_away_costs_passes_but_not_memory() {
    let mut mesh = sheet(15, 15);
    mesh.positions.iter_mut().flatten().for_each(|x| *x = 1.0 + *x * 1e-12);
    mesh.positions.push([1e9; 3]);
    mesh.faces.push([0, 1, mesh.positions.len() as u32 - 1]);
    check(&mesh, Some(10));
    let mut mesh = exploded(&sheet(8, 8));
    for k in 0..90 {
        mesh.positions.push([3.25; 3]);
        let end = mesh.positions.len() as u32;
        mesh.faces.push([end - 1, k, k + 1]);
    }
    check(&mesh, None);
}

#[test]
fn extremes_of_connectivity() {
    let (mesh, report) = run(&separate(1_000_000, 5), Some(16), Limits::default(), 0);
    assert_eq!((report.components, mesh.components.of_patch.len()), (1_000_000, 1_000_000));
    let point = TriMesh { positions: vec![[2.5; 3]; 300_000], ..separate(100_000, 5) };
    let report = run(&point, None, Limits { vertices: 1000, ..Limits::default() }, 0).1;
    assert_eq!((report.welded_vertices, report.degenerate_faces, report.triangles_after), (299_999, 100_000, 0));
    // Every vertex on one point of the lattice, but no two at one position.
    let mut crowd = sheet(60, 60);
    crowd.positions.iter_mut().flatten().for_each(|x| *x = *x * 1e-15 + 1.0);
    crowd.positions[0] = [1e12; 3];
    check(&crowd, Some(8));
}

#[test]
fn one_vertex_with_many_faces_may_have_a_large_chunk() {
    let count = 100_000;
    let mut mesh = TriMesh { positions: vec![[0.0; 3]], faces: Vec::new(), colors: None };
    for k in 0..count {
        let turn = f64::from(k) / f64::from(count) * std::f64::consts::TAU;
        mesh.positions.push([turn.cos(), turn.sin(), 1.0]);
        mesh.faces.push([0, 1 + k, 1 + (k + 1) % count]);
    }
    let limits = Limits { vertices: 5000, faces: 3000 };
    let result = run(&mesh, None, limits, 0);
    check_chunks(&result.0, limits);
    check_twin(&mesh, None, &result);
    let mesh = result.0;
    assert!((0..mesh.chunk_count()).any(|c| mesh.chunk(c).unwrap().len() > 3000) || mesh.chunk_count() > 30);
}

#[test]
fn coordinates_in_the_millions_keep_their_precision() {
    let mut near = torus(20, 16);
    // Multiples of 2^-20, which stay exact after the move.
    near.positions.iter_mut().flatten().for_each(|x| *x = (*x * f64::from(1 << 20)).round() / f64::from(1 << 20));
    let mut far = near.clone();
    let offset = [3_000_000.0, 5_500_000.0, 250.0];
    far.positions.iter_mut().for_each(|p| (0..3).for_each(|k| p[k] += offset[k]));
    check(&far, None);
    let [near, far] = [near, far].map(|mesh| run(&mesh, Some(20), Limits::default(), u64::MAX).0);
    assert_eq!(near.complete, far.complete);
    assert_eq!(near.lattice.step, far.lattice.step);
    assert_eq!(far.lattice.origin[1] - near.lattice.origin[1], offset[1]);
}

#[test]
fn vertices_follow_the_morton_curve() {
    for mesh in [torus(40, 30), exploded(&sheet(20, 20)), separate(300, 9)] {
        let (mesh, _) = run(&mesh, Some(21), SMALL, 0);
        let codes = (0..mesh.vertices.len() as u32).map(|v| morton(mesh.vertices.position(v), (1 << 21) - 1));
        assert!(codes.collect::<Vec<_>>().is_sorted());
    }
}

#[test]
fn chunks_are_balanced() {
    let (mesh, _) = run(&torus(100, 87), None, Limits { vertices: 1000, faces: 5000 }, u64::MAX);
    let sizes: Vec<usize> = (0..mesh.chunk_count()).map(|c| mesh.chunk(c).unwrap().len()).collect();
    assert_eq!(sizes.len(), 4);
    assert!(sizes.iter().all(|size| size.abs_diff(17_400 / 4) < 20), "{sizes:?}");
}

#[test]
fn the_number_of_threads_does_not_show() {
    let mut mesh = exploded(&colored(torus(120, 90)));
    mesh.faces.iter_mut().step_by(17).for_each(|face| face.swap(0, 1));
    mesh.faces.extend((0..50).map(|k| [k, 7 * k + 11, 3 * k + 500]));
    let limits = Limits { vertices: 500, faces: 300 };
    let results: Vec<_> = [1, 2, 5]
        .into_iter()
        .map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            contents(&pool.install(|| run(&mesh, None, limits, if threads == 2 { 0 } else { u64::MAX })))
        })
        .collect();
    assert!(results[0] == results[1] && results[1] == results[2]);
}

#[test]
fn the_percentile_is_counted_again_where_it_decides() {
    // Edges just below and just above the length from which on one bit less is enough.
    for (short, bits) in [(0.999, 13), (1.001, 12)] {
        let mut mesh = separate(100, 3);
        let step = 8190.0 / f64::from((1 << 12) - 1);
        mesh.positions = (0..300)
            .map(|k| {
                let at = f64::from(k / 3) * 81.9;
                let edge = if k < 3 { 2.0 * step * short } else { 60.0 };
                [[at, 0.0, 0.0], [at + edge, 0.0, 0.0], [at, edge * 1.7, 0.0]][k as usize % 3]
            })
            .collect();
        mesh.positions[299] = [8190.0, 0.0, 0.0];
        check(&mesh, None);
        let (mesh, _) = run(&mesh, None, SMALL, 0);
        assert!(mesh.lattice.bits.abs_diff(bits) <= 1);
    }
}

#[test]
fn bad_options_and_meshes_are_refused() {
    let workspace = Workspace::in_memory();
    let error = |mesh: &TriMesh, bits, weld_tolerance| {
        let raw = RawMesh::of(mesh, &workspace).unwrap();
        let options = PartitionOptions { bits, weld_tolerance, ..PartitionOptions::default() };
        partition(raw, &options, &workspace, &mut |_| {}).unwrap_err().to_string()
    };
    assert_eq!(error(&triangle(), Some(22), 0.0), "22 bits per axis is outside 8 to 21");
    assert_eq!(error(&triangle(), None, -0.5), "a welding tolerance of -0.5 is no distance");
    assert_eq!(error(&triangle(), None, f64::NAN), "a welding tolerance of NaN is no distance");
    let colors = Some(vec![[0; 3]; 2]);
    assert_eq!(error(&TriMesh { colors, ..triangle() }, None, 0.0), "2 colours for 3 vertices");
    let workspace = Workspace::new(Path::new("no/such/directory"), 3 << 20);
    let raw = RawMesh::of(&triangle(), &workspace).unwrap();
    let result = partition(raw, &PartitionOptions::default(), &workspace, &mut |_| {});
    assert_eq!(result.unwrap_err().to_string(), "cannot make temporary data in no/such/directory");
}

/// All pairs of used vertices compared; the first of each set keeps its position.
fn joined_near(mesh: &TriMesh, tolerance: f64) -> TriMesh {
    let is_usable = |face: &[u32; 3]| {
        face.iter().all(|&v| mesh.positions.get(v as usize).is_some_and(|p| p.iter().all(|x| x.is_finite())))
    };
    let mut used: Vec<u32> = mesh.faces.iter().filter(|face| is_usable(face)).flatten().copied().collect();
    used.sort_unstable();
    used.dedup();
    let mut sets = DisjointSets::new(mesh.positions.len());
    for (k, &a) in used.iter().enumerate() {
        for &b in &used[..k] {
            let [p, q] = [a, b].map(|v| mesh.positions[v as usize]);
            if (0..3).map(|k| (p[k] - q[k]) * (p[k] - q[k])).sum::<f64>() <= tolerance * tolerance {
                sets.join(a, b);
            }
        }
    }
    let mut mesh = mesh.clone();
    for face in mesh.faces.iter_mut().filter(|face| face.iter().all(|v| used.binary_search(v).is_ok())) {
        *face = face.map(|v| sets.find(v));
    }
    mesh
}

#[test]
fn near_vertices_are_joined_as_by_comparing_all() {
    let mut random = fastrand::Rng::with_seed(21);
    let mut joined = 0;
    for round in 0..60 {
        let mut mesh = [sheet(9, 8), exploded(&torus(10, 9)), separate(60, round)][round as usize % 3].clone();
        let amount = [0.0, 1e-6, 0.02, 0.1][random.usize(..4)];
        mesh.positions.iter_mut().flatten().for_each(|x| *x += (random.f64() - 0.5) * amount);
        if round % 7 == 0 {
            mesh.positions[5][1] = f64::NAN;
            mesh.positions[9][0] = 1e9;
        }
        for tolerance in [1e-9, 2.0 * amount.max(1e-7), 0.9, 50.0] {
            let options = PartitionOptions { weld_tolerance: tolerance, limits: SMALL, ..PartitionOptions::default() };
            let (chunked, report) = run_with(&mesh, &options, 0);
            check_chunks(&chunked, SMALL);
            let (cleaned, twin) = clean(joined_near(&mesh, tolerance));
            if twin.one_sided_edges > 0 {
                continue;
            }
            let lattice = choose(&cleaned, None);
            assert_eq!(chunked.lattice, lattice);
            let rounded: Vec<[i32; 3]> = cleaned.positions.iter().map(|&p| lattice.quantize(p)).collect();
            assert_eq!(chunked.complete, CompleteMesh::of(&rounded, None, &cleaned.faces));
            // Where exact copies are in a set, the twin has no use for them any more.
            let gone = report.welded_vertices + report.near_vertices + report.unreferenced_vertices;
            assert_eq!(gone, twin.welded_vertices + twin.unreferenced_vertices);
            assert_eq!(report.degenerate_faces, twin.degenerate_faces);
            joined += report.near_vertices;
        }
    }
    assert!(joined > 1000, "{joined}");
}

#[test]
fn a_crack_is_closed_within_the_tolerance_only() {
    let mut mesh = exploded(&sheet(12, 12));
    let mut random = fastrand::Rng::with_seed(2);
    mesh.positions.iter_mut().flatten().for_each(|x| *x += (random.f64() - 0.5) * 1e-3);
    let joined = |weld_tolerance| {
        let options = PartitionOptions { weld_tolerance, limits: SMALL, ..PartitionOptions::default() };
        run_with(&mesh, &options, u64::MAX).1
    };
    assert_eq!(joined(1e-9).components, 2 * 12 * 12);
    let report = joined(3e-3);
    assert_eq!((report.components, report.vertices_after, report.triangles_after), (1, 13 * 13, 2 * 12 * 12));
    assert!(report.to_string().contains(&format!("{} vertices joined within the tolerance", 3 * 288 - 169)));
}

/// Every real mesh in the folder that `LODESTREAM_MESHES` names.
#[test]
fn real_meshes_are_what_they_are_in_memory() {
    let Some(folder) = std::env::var_os("LODESTREAM_MESHES").map(std::path::PathBuf::from) else {
        eprintln!("skipped: LODESTREAM_MESHES is not set");
        return;
    };
    let mut paths: Vec<_> = [folder.clone(), folder.join("odd")]
        .iter()
        .filter_map(|folder| std::fs::read_dir(folder).ok())
        .flatten()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "ply" || e == "obj"))
        .collect();
    paths.sort();
    assert!(!paths.is_empty());
    for path in paths {
        let Ok((input, _)) = crate::ingest::read::read_mesh_in_memory(&path) else { continue };
        let expected = clean(input.clone()).1;
        println!("{}: {expected}", path.display());
        for limits in [Limits::default(), Limits { vertices: 5000, faces: 3000 }] {
            let result = run(&input, None, limits, 0);
            check_chunks(&result.0, limits);
            if expected.one_sided_edges == 0 {
                check_twin(&input, None, &result);
            } else {
                println!("  one-sided: {}", result.1);
                assert!(audit(&unchunked(&result.0)).is_clean());
            }
        }
    }
}

/// Partitions the file that `LODESTREAM_PLY` names with spills in files, and prints time and memory.
#[test]
#[ignore = "prints figures, proves nothing"]
fn figures() {
    let Some(path) = std::env::var_os("LODESTREAM_PLY") else { return };
    let workspace = Workspace::new(&std::env::temp_dir(), 0);
    let raw = {
        let (mesh, _) = crate::ingest::read::read_mesh_in_memory(Path::new(&path)).unwrap();
        RawMesh::of(&mesh, &workspace).unwrap()
    };
    // Linux starts the peak anew; elsewhere it is not known.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
    let status = |what: &str| {
        let text = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
        text.lines().find(|line| line.starts_with(what)).unwrap_or_default().to_owned()
    };
    // User and system time of all threads, in hundredths of a second.
    let cpu = || {
        let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
        let times = text.split(' ').skip(13).take(2).map(|ticks| ticks.parse::<u64>().unwrap_or(0));
        times.collect::<Vec<_>>()
    };
    println!("before: {} {:?}", status("VmRSS"), cpu());
    let (start, mut last) = (std::time::Instant::now(), 0.0);
    let (mesh, report) = partition(raw, &PartitionOptions::default(), &workspace, &mut |done| {
        if done - last >= 0.05 {
            last = done;
            println!("{:3.0} % {:?} {:?} {}", done * 100.0, start.elapsed(), cpu(), status("VmHWM"));
        }
    })
    .unwrap();
    println!("{:?} {:?} {} {}\n{report}", start.elapsed(), cpu(), status("VmHWM"), status("VmRSS"));
    println!("{} chunks, {} bits", mesh.chunk_count(), mesh.lattice.bits);
}
