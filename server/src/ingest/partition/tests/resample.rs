//! `visual` precision against `exact`: the same mesh, its vertices elsewhere on the same surface.

use super::*;
use crate::ingest::partition::Precision;

fn with(mesh: &TriMesh, precision: Precision, limits: Limits, memory: u64) -> (ChunkedMesh, CleanReport) {
    let options = PartitionOptions { bits: Some(12), precision, limits, ..PartitionOptions::default() };
    run_with(mesh, &options, memory)
}

/// A wavy sheet with its border beside a ring.
fn wavy() -> TriMesh {
    let mut mesh = sheet(40, 30);
    for p in &mut mesh.positions {
        let [x, y, _] = *p;
        p[2] += (x * 0.4).sin() * 0.8 + (y * 0.5).cos() * 0.9;
    }
    let first = mesh.positions.len() as u32;
    let ring = torus(60, 25);
    mesh.positions.extend(ring.positions.iter().map(|p| [10.0 * p[0] + 80.0, 10.0 * p[1], 10.0 * p[2]]));
    mesh.faces.extend(ring.faces.iter().map(|face| face.map(|v| v + first)));
    mesh
}

type Vec3 = [i64; 3];

fn normal(corners: [Vec3; 3]) -> [f64; 3] {
    let [a, b, c] = corners.map(|p| glam::DVec3::from_array(p.map(|x| x as f64)));
    (b - a).cross(c - a).to_array()
}

#[test]
fn vertices_slide_within_their_faces() {
    let mesh = wavy();
    for limits in [Limits::default(), Limits { faces: 300, ..SMALL }] {
        let (before, _) = with(&mesh, Precision::Exact, limits, u64::MAX);
        let (after, _) = with(&mesh, Precision::Visual, limits, u64::MAX);
        let faces = before.faces.read(0..before.faces.len()).unwrap();
        assert_eq!(faces, after.faces.read(0..after.faces.len()).unwrap());
        let resampled = after.resampled.unwrap();
        let step = i32::from(resampled.step.unwrap().get());
        assert_eq!(after.complete.visual_step, resampled.step);
        assert!(before.resampled.is_none() && before.complete.visual_step.is_none());

        let mut stars = vec![Vec::new(); before.vertices.len()];
        faces.iter().for_each(|face| face.iter().for_each(|&v| stars[v as usize].push(*face)));
        let at = |mesh: &ChunkedMesh, v: u32| mesh.vertices.position(v).map(i64::from);
        let mut moved = 0;
        for (v, star) in (0..).zip(&stars) {
            let (was, is) = (at(&before, v), at(&after, v));
            if was == is {
                continue;
            }
            moved += 1;
            assert!(!before.vertices.is_boundary(v) && before.vertices.height(v) == 0, "vertex {v}");
            let multiples = is.iter().filter(|&&x| x % i64::from(step) == 0).count();
            assert!(multiples >= 2, "vertex {v} at {is:?}, step {step}");
            // In the plane of a face, but for rounding along one axis.
            let is_on = |face: &[u32; 3]| {
                let n = normal(face.map(|w| at(&before, w)));
                let off: f64 = (0..3).map(|k| n[k] * (is[k] - was[k]) as f64).sum();
                let steepest = n.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
                off.abs() <= 0.5 * steepest * (1.0 + 1e-9)
            };
            assert!(star.iter().any(is_on), "vertex {v} left the surface");
        }
        let share = if limits.faces > 1000 { 0.8 } else { 0.4 };
        assert!(f64::from(moved) > share * stars.len() as f64, "{moved} of {} moved", stars.len());
        assert!(u64::from(moved as u32) <= resampled.moved && resampled.largest > 0.0);
        for face in &faces {
            let [was, is] = [&before, &after].map(|mesh| normal(face.map(|v| at(mesh, v))));
            assert!((0..3).map(|k| was[k] * is[k]).sum::<f64>() > 0.0, "{face:?} has turned");
        }
        let points: Vec<[i32; 3]> = after.vertices.positions().collect();
        let corner =
            |pick: fn(i32, i32) -> i32| points.iter().fold(points[0], |a, b| [0, 1, 2].map(|k| pick(a[k], b[k])));
        assert_eq!((after.complete.box_min, after.complete.box_max), (corner(i32::min), corner(i32::max)));
    }
}

#[test]
fn neither_memory_nor_threads_show() {
    let mesh = wavy();
    let limits = Limits { faces: 100, ..SMALL };
    let run = |threads: usize, memory: u64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| with(&mesh, Precision::Visual, limits, memory))
    };
    let expected = run(1, u64::MAX);
    assert!(expected.0.chunk_count() > 20);
    for (threads, memory) in [(1, 0), (2, u64::MAX), (5, 1000)] {
        let other = run(threads, memory);
        assert_eq!(contents(&other), contents(&expected), "{threads} threads, {memory} bytes");
        assert_eq!(other.0.resampled, expected.0.resampled);
    }
}

#[test]
fn a_lattice_as_coarse_as_the_edges_leaves_all_where_it_is() {
    let mesh = wavy();
    let options = |precision| PartitionOptions { bits: Some(8), precision, ..PartitionOptions::default() };
    let [exact, visual] = [Precision::Exact, Precision::Visual].map(|p| run_with(&mesh, &options(p), u64::MAX));
    assert_eq!(visual.0.complete, exact.0.complete);
    assert_eq!(contents(&visual), contents(&exact));
}
