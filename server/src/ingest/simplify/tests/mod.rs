//! Properties of whole builds. [`oracle`] replays the records independently, [`meshes`] makes the inputs.

mod assembly;
mod chunked;
mod in_core;
mod meshes;
mod oracle;

use std::path::Path;

use self::in_core::build;
use self::{
    meshes::*,
    oracle::{Replay, Vertex, parents, sorted},
};
use super::{BuildOptions, PlacementChoice, surface::SurfaceError};
use crate::ingest::report::BuildReport;
use crate::mesh::TriMesh;
use crate::pack::record::{Bounds, CutRef, Dag, NO_OP};

fn run(mesh: &TriMesh) -> (Dag, BuildReport) {
    run_with(mesh, PlacementChoice::default())
}

fn run_with(mesh: &TriMesh, placement: PlacementChoice) -> (Dag, BuildReport) {
    build(mesh, &BuildOptions { placement, ..BuildOptions::default() }).unwrap()
}

/// Everything that must hold for any clean mesh, in all placements; returns what the default one made. `orders`: how many random
/// legal orders to replay.
fn check(name: &str, mesh: &TriMesh, orders: u64) -> (Dag, BuildReport) {
    for placement in PlacementChoice::ALL {
        // Large meshes take long and show nothing new.
        if placement != PlacementChoice::default() && mesh.faces.len() < 100_000 {
            check_with(&format!("{name}, {placement:?}"), mesh, orders, placement);
        }
    }
    check_with(name, mesh, orders, PlacementChoice::default())
}

fn check_with(name: &str, mesh: &TriMesh, orders: u64, placement: PlacementChoice) -> (Dag, BuildReport) {
    let (dag, report) = run_with(mesh, placement);
    assert_eq!(report.splits, dag.splits.len(), "{name}");
    check_dag(name, mesh, &dag, orders);
    for max_faces in [mesh.faces.len() / 3 + 1, 40] {
        // Small chunks make sense of small meshes only.
        if max_faces > 1000 || mesh.faces.len() < 10_000 {
            let chunked = chunked::build(mesh, max_faces, 1, placement);
            check_dag(&format!("{name} in chunks of {max_faces}"), mesh, &chunked, orders.min(2));
            assert!(chunked == chunked::build(mesh, max_faces, 3, placement), "{name}: threads make a difference");
        }
    }
    (dag, report)
}

fn check_dag(name: &str, mesh: &TriMesh, dag: &Dag, orders: u64) {
    let spawns = dag.spawns.len();
    let splits = || (spawns as u32..).zip(&dag.splits);

    // Ids, parents and stored monotonicity.
    let bounds = |op: u32| -> &Bounds {
        match dag.spawns.get(op as usize) {
            Some(spawn) => &spawn.bounds,
            None => &dag.splits[op as usize - spawns].bounds,
        }
    };
    assert!(dag.spawns.windows(2).all(|w| w[0].bounds.error >= w[1].bounds.error), "{name}");
    let all_parents: Vec<Vec<u32>> = dag.splits.iter().map(|split| parents(dag, split)).collect();
    let mut with_tree_parent = 0;
    for ((op, split), parents) in splits().zip(&all_parents) {
        assert!(parents.len() <= 3, "{name}: op {op}");
        if split.tree_parent != NO_OP {
            with_tree_parent += 1;
            assert!(split.tree_parent < op, "{name}: op {op}");
            assert!(bounds(split.tree_parent).contains(&split.bounds), "{name}: bounds of op {op}");
        }
        for (child, role) in [(split.next_of_s, 0), (split.first_of_t, 1)] {
            if child != NO_OP {
                let child = &dag.splits[child as usize - spawns];
                assert_eq!((child.tree_parent, child.s), (op, role), "{name}: child of op {op}");
            }
        }
        contains_points(name, &split.bounds, &[split.position]);
    }
    for spawn in &dag.spawns {
        contains_points(name, &spawn.bounds, &spawn.patch.positions);
    }
    let patches = std::iter::once(&dag.base).chain(dag.spawns.iter().map(|s| &s.patch));
    let firsts = patches.flat_map(|p| &p.first_splits).filter(|&&op| op != NO_OP);
    let from_spawns: usize =
        splits().filter(|(_, s)| s.tree_parent != NO_OP && (s.tree_parent as usize) < spawns).count();
    assert_eq!(firsts.count() + with_tree_parent - from_spawns, dag.splits.len(), "{name}: the forest misses ops");

    // Replay: in the order of ids as far as legal, then at random.
    let expected = sorted(mesh.faces.iter().map(|f| {
        f.map(|v| {
            let color = mesh.colors.as_ref().map_or([0; 3], |c| c[v as usize]);
            (dag.lattice.quantize(mesh.positions[v as usize]), color)
        })
    }));
    for seed in 0..orders {
        let order = legal_order(spawns as u32, &all_parents, seed);
        let mut replay = Replay::roots(dag);
        let half = order.len() / 2;
        for (i, &op) in order.iter().enumerate() {
            let split = &dag.splits[op as usize - spawns];
            contains_points(name, &split.bounds, &[replay.position(Replay::vertex_s(dag, split))]);
            replay.split(dag, op);
            if i == half {
                replay.check_twins();
            }
        }
        replay.check_twins();
        assert!(replay.triangles() == expected, "{name}: order {seed} does not give the input back");
        if seed == 0 {
            contains_regions(name, dag, &replay);
        }
    }
}

/// The complete mesh around both ends of a split lies in its sphere, and the normals there in its cone.
fn contains_regions(name: &str, dag: &Dag, complete: &Replay) {
    let stars = complete.stars();
    for (op, split) in (dag.spawns.len() as u32..).zip(&dag.splits) {
        for end in [Vertex::Of(op), Replay::vertex_s(dag, split)] {
            for face in &stars[&end] {
                contains_points(name, &split.bounds, face);
                let [a, b, c] = face.map(|p| glam::DVec3::from_array(p.map(f64::from)));
                let normal = (b - a).cross(c - a);
                if let Some(cone) = split.bounds.cone.wide().filter(|_| normal.length() > 0.0) {
                    assert!(
                        cone.axis.dot(normal / normal.length()) >= cone.cos - 1e-9,
                        "{name}: a normal outside its cone"
                    );
                }
            }
        }
    }
}

fn contains_points(name: &str, bounds: &Bounds, points: &[[i32; 3]]) {
    for p in points {
        let p = glam::DVec3::from_array(p.map(f64::from));
        assert!(
            p.distance(bounds.center_f64()) <= f64::from(bounds.radius.decode()),
            "{name}: a point outside its sphere"
        );
    }
}

/// All splits, each after its parents; among those that are legal, order 0 takes the smallest id, others one at random.
fn legal_order(spawns: u32, all_parents: &[Vec<u32>], seed: u64) -> Vec<u32> {
    let mut rng = fastrand::Rng::with_seed(seed);
    let mut missing: Vec<usize> = Vec::new();
    let mut children: Vec<Vec<u32>> = vec![Vec::new(); all_parents.len()];
    let mut ready = std::collections::BTreeSet::new();
    let mut pool = Vec::new();
    for (i, parents) in all_parents.iter().enumerate() {
        let waits_for: Vec<u32> = parents.iter().copied().filter(|&p| p >= spawns).collect();
        missing.push(waits_for.len());
        for &parent in &waits_for {
            children[(parent - spawns) as usize].push(i as u32);
        }
        if waits_for.is_empty() {
            ready.insert(i as u32);
            pool.push(i as u32);
        }
    }
    let mut order = Vec::new();
    loop {
        let next = if seed == 0 {
            ready.pop_first()
        } else {
            (!pool.is_empty()).then(|| pool.swap_remove(rng.usize(..pool.len())))
        };
        let Some(i) = next else { break };
        order.push(i + spawns);
        for &child in &children[i as usize] {
            missing[child as usize] -= 1;
            if missing[child as usize] == 0 {
                ready.insert(child);
                pool.push(child);
            }
        }
    }
    assert_eq!(order.len(), all_parents.len(), "the parents have a cycle");
    order
}

#[test]
fn closed_surfaces_refine_to_the_input() {
    let (dag, _) = check("icosphere", &icosphere(3), 4);
    assert!(dag.base.faces.len() <= 8, "{}", dag.base.faces.len());
    let (dag, _) = check("torus", &torus(24, 12), 4);
    assert!(dag.base.faces.len() <= 60, "{}", dag.base.faces.len());
    check("noisy icosphere", &noisy(icosphere(3), 0.02, 1), 3);
    check("very noisy torus", &noisy(torus(20, 11), 0.3, 2), 3);
}

#[test]
fn surfaces_with_boundary_refine_to_the_input() {
    let (dag, report) = check("flat grid", &grid(12, 0.0), 4);
    assert_eq!(dag.base.faces.len(), 1);
    assert!(report.is_open);
    check("hills", &grid(15, 0.8), 4);
    check("noisy hills", &noisy(grid(15, 0.8), 0.3, 3), 4);
    check("sieve", &sieve(18), 4);
    check("noisy sieve", &noisy(sieve(17), 0.3, 4), 3);
}

#[test]
fn a_flat_interior_costs_no_error() {
    let (_, report) = run(&grid(16, 0.0));
    assert!(report.zero_error_splits >= 15 * 15, "{}", report.zero_error_splits);
}

#[test]
fn faces_without_area_refine_to_the_input() {
    check("pinched sphere", &pinched(icosphere(3), 7), 4);
    check("pinched noisy grid", &pinched(noisy(grid(14, 0.5), 0.2, 5), 3), 4);
    let mut point = icosphere(2);
    point.positions.fill([3.0, 4.0, 5.0]);
    let (dag, _) = check("all on one point", &point, 2);
    assert!(dag.splits.iter().all(|s| s.bounds.error.0 == 0));
    let mut line = grid(6, 0.0);
    line.positions.iter_mut().for_each(|p| p[1] = 0.0);
    check("all on one line", &line, 2);
}

#[test]
fn tiny_meshes_are_their_own_base() {
    let (dag, report) = check("empty", &TriMesh::default(), 1);
    assert_eq!((dag.base.faces.len(), report.components), (0, 0));
    let (dag, _) = check("triangle", &triangle(), 1);
    assert_eq!((dag.base.faces.len(), dag.splits.len()), (1, 0));
    let stray = TriMesh { positions: vec![[1.0; 3]; 4], ..TriMesh::default() };
    assert!(check("no faces", &stray, 1).0.base.positions.is_empty());
    let mut pillow = triangle();
    pillow.faces.push([0, 2, 1]);
    assert_eq!(check("pillow", &pillow, 1).0.base.faces.len(), 2);
}

#[test]
fn small_components_are_spawned() {
    let mut parts = vec![(icosphere(3), 1.0, [0.0; 3]), (torus(16, 9), 0.2, [3.0, 0.0, 0.0])];
    for i in 0..40 {
        parts.push((icosphere(1), 0.01 + 0.001 * f64::from(i % 7), [f64::from(i) * 0.1, 2.0, 0.0]));
    }
    parts.push((triangle(), 0.05, [0.0, 3.0, 0.0]));
    parts.push((grid(5, 0.3), 0.01, [0.0, -3.0, 0.0]));
    let (dag, report) = check("scattered", &scattered(&parts), 3);
    assert_eq!((report.components, report.base_components, dag.spawns.len()), (44, 2, 42));
    for spawn in &dag.spawns {
        let p = &spawn.patch.positions;
        let far = p.iter().flat_map(|a| {
            p.iter().map(move |b| {
                glam::DVec3::from_array(a.map(f64::from)).distance(glam::DVec3::from_array(b.map(f64::from)))
            })
        });
        assert!(f64::from(spawn.bounds.error.decode()) >= far.fold(0.0, f64::max));
    }
}

#[test]
fn a_base_of_many_large_components_stays_small() {
    let parts: Vec<_> = (0..300).map(|i| (icosphere(0), 1.0, [f64::from(i) * 3.0, 0.0, 0.0])).collect();
    let (dag, report) = check("beads", &scattered(&parts), 1);
    assert!(dag.base.faces.len() <= 1000);
    assert_eq!(report.base_components + dag.spawns.len(), 300);
}

#[test]
fn colour_edges_count_as_errors() {
    let plain = grid(24, 0.0);
    let painted = striped(grid(24, 0.0), 6.0);
    let (plain, _) = check("plain", &plain, 1);
    let (painted, _) = check("painted", &painted, 2);
    let over = |dag: &Dag, error: f32| dag.splits.iter().filter(|s| s.bounds.error.decode() > error).count();
    let one_cell = (1.0 / plain.lattice.step) as f32;
    assert_eq!(over(&plain, one_cell), over(&plain, 2.0 * one_cell).max(over(&plain, one_cell)));
    assert!(over(&painted, 0.5 * one_cell) > over(&plain, 0.5 * one_cell) + 8);
}

#[test]
fn builds_repeat() {
    let mesh = striped(noisy(sieve(20), 0.3, 6), 3.0);
    for placement in PlacementChoice::ALL {
        assert!(run_with(&mesh, placement).0 == run_with(&mesh, placement).0);
    }
}

#[test]
fn unclean_meshes_are_refused() {
    let refuse = |faces: &[[u32; 3]]| {
        let positions = (0..8).map(|i| [f64::from(i), f64::from(i * i), 0.0]).collect();
        let mesh = TriMesh { positions, faces: faces.to_vec(), colors: None };
        build(&mesh, &BuildOptions::default()).map(|_| ()).unwrap_err()
    };
    assert_eq!(refuse(&[[0, 1, 1]]), SurfaceError::RepeatedCorner { face: 0 });
    assert_eq!(refuse(&[[0, 1, 8]]), SurfaceError::NoSuchVertex { face: 0, vertex: 8 });
    assert_eq!(refuse(&[[0, 1, 2], [0, 1, 3]]), SurfaceError::RepeatedEdge { from: 0, to: 1 });
    assert_eq!(refuse(&[[0, 1, 2], [0, 3, 4]]), SurfaceError::SeveralFans { vertex: 0 });
}

#[test]
fn root_references_name_existing_faces() {
    let (dag, _) = run(&scattered(&[(torus(12, 8), 1.0, [0.0; 3]), (icosphere(1), 0.05, [4.0, 0.0, 0.0])]));
    let faces = dag.base.faces.len() + dag.spawns.iter().map(|s| s.patch.faces.len()).sum::<usize>();
    for split in &dag.splits {
        for cut in [split.left, split.right] {
            if let CutRef::Root { face, edge } = cut {
                assert!((face as usize) < faces && edge < 3);
            }
        }
    }
}

/// The real scans there are; a file that is not clean as it stands is passed over.
fn real_meshes() -> impl Iterator<Item = (&'static str, TriMesh)> {
    let folder = std::env::var_os("LODESTREAM_MESHES");
    let names = ["bunny", "armadillo", "rocker-arm", "screwdriver", "fandisk_cad", "gears_cad", "gargo", "dragon_871k"];
    names.into_iter().filter_map(move |name| {
        let path = Path::new(folder.as_ref()?).join(name).with_extension("ply");
        let mesh = path.exists().then(|| read_ply(&path))?;
        match super::surface::Surface::new(mesh.positions.len(), &mesh.faces) {
            Ok(_) => Some((name, mesh)),
            Err(error) => {
                println!("{name}: passed over, {error}");
                None
            }
        }
    })
}

#[test]
fn real_meshes_refine_to_the_input() {
    for (name, mesh) in real_meshes() {
        check(name, &mesh, if mesh.faces.len() > 200_000 { 1 } else { 2 });
    }
}

/// Prints a report per real scan, with the processor time that the build took (wall time says little on a busy machine).
#[test]
#[ignore = "prints figures, proves nothing"]
fn figures_of_real_meshes() {
    let cpu = || -> f64 {
        let stat = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
        stat.split(' ').next().and_then(|ns| ns.parse::<f64>().ok()).unwrap_or(f64::NAN) * 1e-9
    };
    for (name, mesh) in real_meshes() {
        let before = cpu();
        let (dag, report) = run(&mesh);
        let seconds = cpu() - before;
        let extent = f64::from(dag.lattice.max_coordinate());
        let over = [1e-2, 1e-3, 3e-4, 1e-4]
            .map(|share| dag.splits.iter().filter(|s| f64::from(s.bounds.error.decode()) > share * extent).count());
        let mean_radius = dag.splits.iter().map(|s| f64::from(s.bounds.radius.decode())).sum::<f64>()
            / dag.splits.len().max(1) as f64
            / extent;
        let wide = dag.splits.iter().filter(|s| s.bounds.cone.wide().is_none()).count();
        println!(
            "{name}: splits over 1e-2, 1e-3, 3e-4, 1e-4 of the extent {over:?}, radius {mean_radius:.2e}, any {wide}"
        );
        let rate = mesh.faces.len() as f64 / seconds * 1e-6;
        println!("{name}: {seconds:.3} s, {rate:.3} M tri/s; {}", serde_json::to_string(&report).unwrap());
        for max_faces in [mesh.faces.len() / 4 + 1, mesh.faces.len() / 32 + 1] {
            let before = cpu();
            let chunked = chunked::build(&mesh, max_faces, 1, PlacementChoice::default());
            let seconds = cpu() - before;
            let over = [1e-2, 1e-3, 3e-4, 1e-4].map(|share| {
                chunked.splits.iter().filter(|s| f64::from(s.bounds.error.decode()) > share * extent).count()
            });
            let base = chunked.base.faces.len();
            println!("{name} in chunks of {max_faces}: {seconds:.3} s, over {over:?}, base {base}");
        }
    }
}
