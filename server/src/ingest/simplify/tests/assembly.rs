//! Assembly out of core against its dull twin, which holds everything in memory.

use std::io::Cursor;
use std::path::Path;

use super::super::batch::{Simplifier, State};
use super::super::{BuildOptions, lattice, order, surface::Surface};
use super::in_core::is_open;
use super::{meshes::*, real_meshes};
use crate::ingest::hierarchy::assembly::{Assembled, Grain, Model, assemble, assemble_by, tests::spilled};
use crate::ingest::hierarchy::components::Components;
use crate::ingest::hierarchy::forest::{self, InCore};
use crate::ingest::hierarchy::{CollapseRecord, NONE, Simplified};
use crate::ingest::spill::Workspace;
use crate::mesh::TriMesh;
use crate::pack::record::Dag;
use crate::pack::{CompleteMesh, Metadata, PackedModel, WriteError, verify, write_to_vec};

/// Grains so small that every mesh has several of each.
const SMALL: Grain = Grain { keys: 50, collapses: 37, bucket: 256 };

/// Simplifies in memory and hands over what there is then.
fn simplify<T>(mesh: &TriMesh, go_on: impl FnOnce(&InCore, CompleteMesh) -> T) -> T {
    let lattice = lattice::choose(mesh, None);
    let (mut points, faces) = order::by_place(&lattice::round(mesh, &lattice), &mesh.faces, lattice.bits);
    let surface = Surface::new(points.len(), &faces).unwrap();
    for (v, point) in (0..).zip(&mut points) {
        point.is_boundary = surface.is_boundary(v);
    }
    let components = Components::new(&points, &faces);
    let is_open = is_open(&surface, &points);
    let has_colors = mesh.colors.is_some();
    let positions: Vec<[i32; 3]> = points.iter().map(|p| p.position).collect();
    let colors: Vec<[u8; 3]> = points.iter().map(|p| p.color).collect();
    let complete = CompleteMesh::of(&positions, has_colors.then_some(&colors[..]), &faces);
    let state = State::of_originals(&surface, points, has_colors);
    let mut simplifier = Simplifier::new(surface, state, BuildOptions::default().method(lattice.max_coordinate()), 0);
    simplifier.run(&mut |_| {});
    let done = InCore {
        lattice,
        has_colors,
        is_open,
        points: &simplifier.points,
        components: &components,
        root_faces: &simplifier.root_faces(),
        collapses: &simplifier.measurer.collapses,
        carried: &simplifier.measurer.carried,
        removed_by: &simplifier.removed_by,
    };
    go_on(&done, complete)
}

/// Assembles out of core, after `change` has gone over the collapses.
fn assembled(
    done: &InCore,
    memory_bytes: u64,
    grain: Option<&Grain>,
    change: impl Fn(u32, &mut CollapseRecord),
) -> Result<Assembled, WriteError> {
    let workspace = Workspace::new(&std::env::temp_dir(), memory_bytes);
    let (simplified, components) = spilled(done, &workspace);
    let mut collapses = simplified.collapses.read(0..simplified.collapses.len()).unwrap();
    (0..).zip(&mut collapses).for_each(|(op, collapse)| change(op, collapse));
    let simplified = Simplified { collapses: workspace.spill_of(&collapses).unwrap(), ..simplified };
    let &InCore { lattice, has_colors, is_open, .. } = done;
    let faces = done.removed_by.len() as u32;
    let model = Model { lattice, has_colors, is_open, faces, components: &components };
    match grain {
        Some(grain) => assemble_by(grain, &model, simplified, &workspace, &mut |_| {}),
        None => assemble(&model, simplified, &workspace, &mut |_| {}),
    }
}

fn pack(assembled: &Assembled, complete: &CompleteMesh) -> Vec<u8> {
    let mut out = Cursor::new(Vec::new());
    let len = assembled.write(complete, &Metadata::default(), &mut out, &mut |_| {}).unwrap();
    assert_eq!(len, out.get_ref().len() as u64);
    out.into_inner()
}

/// The pack is that of the twin, whatever the budget, the threads and the grain.
fn check(name: &str, mesh: &TriMesh, grains: &[Option<&Grain>]) {
    simplify(mesh, |done, complete| {
        let (dag, shape) = forest::assemble(done);
        let expected = write_to_vec(&dag, &complete, &Metadata::default()).unwrap();
        for threads in [1, 4] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            for (memory_bytes, grain) in [0, u64::MAX].iter().flat_map(|&m| grains.iter().map(move |&g| (m, g))) {
                let bytes = pool.install(|| {
                    let assembled = assembled(done, memory_bytes, grain, |_, _| {}).unwrap();
                    assert_eq!(assembled.shape, shape, "{name}");
                    pack(&assembled, &complete)
                });
                assert!(bytes == expected, "{name}: {threads} threads, {memory_bytes} bytes, {grain:?}");
            }
        }
    });
}

#[test]
fn the_pack_is_that_of_the_twin() {
    let beads: Vec<_> = (0..300).map(|i| (icosphere(0), 1.0, [f64::from(i) * 3.0, 0.0, 0.0])).collect();
    let mut parts = vec![(icosphere(3), 1.0, [0.0; 3]), (torus(16, 9), 0.2, [3.0, 0.0, 0.0])];
    for i in 0..300 {
        parts.push((icosphere(1), 0.01 + 0.001 * f64::from(i % 7), [f64::from(i) * 0.1, 2.0, 0.0]));
    }
    parts.push((triangle(), 0.05, [0.0, 3.0, 0.0]));
    let mut point = icosphere(2);
    point.positions.fill([3.0, 4.0, 5.0]);
    for (name, mesh) in [
        ("empty", TriMesh::default()),
        ("triangle", triangle()),
        ("icosphere", icosphere(3)),
        ("very noisy torus", noisy(torus(40, 21), 0.3, 2)),
        ("noisy sieve", striped(noisy(sieve(20), 0.3, 6), 3.0)),
        ("pinched", pinched(noisy(grid(30, 0.5), 0.2, 5), 3)),
        ("all on one point", point),
        ("beads", scattered(&beads)),
        ("scattered", striped(scattered(&parts), 0.5)),
    ] {
        check(name, &mesh, &[None, Some(&SMALL)]);
    }
}

#[test]
fn packs_of_real_meshes_are_those_of_the_twin() {
    for (name, mesh) in real_meshes() {
        check(name, &mesh, &[None]);
    }
}

#[test]
fn moves_of_the_vertex_that_stays_are_stored() {
    let mesh = striped(noisy(torus(24, 12), 0.1, 1), 1.0);
    simplify(&mesh, |done, complete| {
        // Only few move, so that the flag cannot come from the first one.
        let s_move = |p: [i32; 3]| if p[0] % 16 == 0 { [p[1] % 5 - 2, p[2] % 7 - 3, 1] } else { [0; 3] };
        let s_color_move = |p: [i32; 3]| if p[1] % 16 == 0 { [(p[0] % 256) as u8, 0, 255] } else { [0; 3] };
        let (mut dag, _): (Dag, _) = forest::assemble(done);
        for split in &mut dag.splits {
            (split.s_move, split.s_color_move) = (s_move(split.position), s_color_move(split.position));
        }
        let expected = write_to_vec(&dag, &complete, &Metadata::default()).unwrap();
        let moved = assembled(done, 0, Some(&SMALL), |_, collapse| {
            (collapse.s_move, collapse.s_color_move) = (s_move(collapse.position), s_color_move(collapse.position));
        });
        let bytes = pack(&moved.unwrap(), &complete);
        assert!(bytes == expected);
        let model = PackedModel::from_vec(bytes).unwrap();
        assert!(model.info().has_moves);
        let read = (model.spawn_count()..model.op_count()).map(|op| model.split(op).unwrap());
        assert!(read.map(|split| split.s_move).eq(dag.splits.iter().map(|split| split.s_move)));
    });
}

#[test]
fn collapses_that_contradict_each_other_are_refused() {
    simplify(&torus(16, 9), |done, complete| {
        let last = done.collapses.len() as u32 - 1;
        let check = |what: &str, reason: &str, change: &dyn Fn(u32, &mut CollapseRecord)| {
            let error = assembled(done, u64::MAX, None, change).map(|_| ()).unwrap_err();
            assert!(matches!(&error, WriteError::Invalid(text) if text.contains(reason)), "{what}: {error}");
        };
        let at = |op: u32, go: fn(&mut CollapseRecord)| {
            move |i: u32, c: &mut CollapseRecord| {
                if i == op {
                    go(c)
                }
            }
        };
        check("later child", "as its child", &at(0, |c| c.next_of_s = 1));
        check("child out of range", "as its child", &at(last, |c| c.first_of_t = NONE - 1));
        check("lost child", "is no child", &|_, c| c.next_of_s = NONE);
        check("face out of range", "does not exist", &at(last, |c| c.left = NONE - 1));
        check("face removed twice", "removed later", &at(0, |c| c.left = 3 * 2));
        check("no such neighbour", "not there", &at(last, |c| c.outer[0] = NONE - 1));
        // Nothing of this was the mesh's fault.
        let bytes = pack(&assembled(done, u64::MAX, None, |_, _| {}).unwrap(), &complete);
        assert_eq!(verify(std::sync::Arc::new(bytes)).unwrap().hash, complete.hash.0);
    });
}

#[test]
fn a_directory_that_cannot_be_written_is_named() {
    simplify(&torus(16, 9), |done, _| {
        let (simplified, components) = spilled(done, &Workspace::in_memory());
        let &InCore { lattice, has_colors, is_open, .. } = done;
        let faces = done.removed_by.len() as u32;
        let model = Model { lattice, has_colors, is_open, faces, components: &components };
        let nowhere = Workspace::new(Path::new("no/such/directory"), 0);
        let error = assemble(&model, simplified, &nowhere, &mut |_| {}).unwrap_err();
        assert!(matches!(error, WriteError::Source(_)));
        assert_eq!(error.to_string(), "cannot make temporary data in no/such/directory");
    });
}

/// Assembles the mesh that `LODESTREAM_SCAN` names from files on disk and prints time and memory.
#[test]
#[ignore = "prints figures, proves nothing"]
fn figures_of_assembly() {
    let Some(path) = std::env::var_os("LODESTREAM_SCAN") else { return };
    let (mesh, _) = crate::ingest::read::read_mesh_in_memory(Path::new(&path)).unwrap();
    let (mesh, _) = crate::ingest::clean::clean(mesh);
    // Processor seconds of the process, resident and peak bytes.
    let usage = || -> [f64; 3] {
        let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
        let ticks = |field: usize| stat.rsplit(')').next().unwrap().split(' ').nth(field).unwrap().parse::<f64>();
        let status = std::fs::read_to_string("/proc/self/status").unwrap();
        let of = |name: &str| {
            let line = status.lines().find(|line| line.starts_with(name)).unwrap();
            line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() / 1024.0
        };
        [(ticks(12).unwrap() + ticks(13).unwrap()) / 100.0, of("VmRSS"), of("VmHWM")]
    };
    let directory = std::env::temp_dir();
    simplify(&mesh, |done, complete| {
        let workspace = Workspace::new(&directory, 0);
        let (simplified, components) = spilled(done, &workspace);
        let &InCore { lattice, has_colors, is_open, .. } = done;
        let faces = done.removed_by.len() as u32;
        let model = Model { lattice, has_colors, is_open, faces, components: &components };
        std::fs::write("/proc/self/clear_refs", "5").unwrap();
        let ([before, rss, _], start) = (usage(), std::time::Instant::now());
        let mut shares = Vec::new();
        let assembled = assemble(&model, simplified, &workspace, &mut |share| {
            shares.push((share, start.elapsed().as_secs_f64()));
        });
        let assembled = assembled.unwrap();
        let ids_done = shares.iter().rev().find(|(share, _)| *share <= 0.4).map_or(0.0, |x| x.1);
        let [middle, ..] = usage();
        let assemble_s = start.elapsed().as_secs_f64();
        let mut out = std::io::BufWriter::with_capacity(1 << 18, tempfile::tempfile_in(&directory).unwrap());
        let bytes = assembled.write(&complete, &Metadata::default(), &mut out, &mut |_| {}).unwrap();
        let ([after, _, peak], total_s) = (usage(), start.elapsed().as_secs_f64());
        println!(
            "{} splits, {} spawns, {bytes} bytes; ids {ids_done:.2} s, assemble {assemble_s:.2} s wall {:.2} s cpu, \
             write {:.2} s wall {:.2} s cpu, {:.0} MB over what was there",
            assembled.outline.splits,
            assembled.outline.spawns.len(),
            middle - before,
            total_s - assemble_s,
            after - middle,
            peak - rss,
        );
    });
}
