//! What the real binaries stream and export is the mesh that went in, and no more triangles than asked for.

use std::path::Path;

use lodestream_protocol::quant::Lattice;
use lodestream_server::ingest::clean::clean;
use lodestream_server::ingest::read::{read_mesh_in_memory, read_ply};
use lodestream_server::mesh::TriMesh;
use lodestream_server::pack::PackedModel;
use lodestream_tests::meshes;
use lodestream_tests::server_process::{ServerProcess, TempDir, described, ingest, server, snapshot};

/// Position on the lattice and colour.
type Corner = ([i32; 3], [u8; 3]);

/// The mesh as a sorted multiset of oriented triangles, each rotated to its smallest form.
fn triangles(mesh: &TriMesh, lattice: &Lattice) -> Vec<[Corner; 3]> {
    let corner = |v: u32| {
        let color = mesh.colors.as_ref().map_or([0; 3], |colors| colors[v as usize]);
        (lattice.quantize(mesh.positions[v as usize]), color)
    };
    let smallest = |face: &[u32; 3]| {
        let [a, b, c] = face.map(corner);
        [[a, b, c], [b, c, a], [c, a, b]].into_iter().min().expect("three rotations")
    };
    let mut triangles: Vec<_> = mesh.faces.iter().map(smallest).collect();
    triangles.sort_unstable();
    triangles
}

fn open(repository: &Path, name: &str) -> PackedModel {
    let bytes = std::fs::read(repository.join(format!("{name}.lodepack"))).expect("ingest published it");
    PackedModel::from_vec(bytes).expect("a published pack opens")
}

/// Streams and exports each model, and compares both with the cleaned input.
fn check_complete(models: &[(&str, TriMesh)], folder: &TempDir) {
    let repository = folder.join("repository");
    let server_process = ServerProcess::start(&repository);
    for (name, mesh) in models {
        let lattice = open(&repository, name).info().lattice;
        let (clean, _) = clean(mesh.clone());
        let expected = triangles(&clean, &lattice);

        let streamed = folder.join(&format!("{name}-streamed.ply"));
        let words = ["--complete", "--triangles", "unlimited", "--json", "--export"].map(Path::new);
        let output = snapshot(&server_process.url(name), words.into_iter().chain([&*streamed]));
        assert!(output.status.success(), "{name}: {}", described(&output));
        let stats: serde_json::Value = serde_json::from_slice(&output.stdout).expect("--json prints JSON");
        assert_eq!(stats["settled"], true, "{name}");
        assert_eq!(stats["triangles"], expected.len(), "{name}");
        assert_eq!(stats["resets"], 0, "{name}");

        let exported = folder.join(&format!("{name}-exported.ply"));
        let words = ["export", name, "--repository"].map(Path::new);
        let output = server(words.into_iter().chain([&*repository, Path::new("--output"), &*exported]));
        assert!(output.status.success(), "{name}: {}", described(&output));

        for path in [streamed, exported] {
            let (mesh, _) = read_ply(&std::fs::read(&path).expect("it was just written")).expect("our PLY");
            assert_eq!(mesh.colors.is_some(), clean.colors.is_some(), "{name}: {}", path.display());
            // A failed comparison of a hundred thousand triangles is not worth printing.
            let is_equal = triangles(&mesh, &lattice) == expected;
            assert!(is_equal, "{name}: {} is not the mesh that went in", path.display());
        }
    }
}

#[test]
fn complete_models_arrive_exactly() {
    let folder = TempDir::new();
    let models = [
        ("sphere", meshes::colored_sphere(5)),
        ("genus", meshes::genus(3, 6)),
        ("components", meshes::many_components(40, 1)),
        ("grid", meshes::grid(60, 40)),
    ];
    let files: Vec<_> = models.iter().map(|(name, mesh)| folder.write_mesh(name, mesh)).collect();
    ingest(&files.iter().map(|file| &**file).collect::<Vec<_>>(), &folder.join("repository"));
    check_complete(&models, &folder);
}

/// The folder of scanned and designed meshes is no part of the project; `LODESTREAM_MESHES` names it.
#[test]
fn real_meshes_arrive_exactly() {
    let Some(meshes) = std::env::var_os("LODESTREAM_MESHES") else {
        eprintln!("skipped: LODESTREAM_MESHES names no folder");
        return;
    };
    let folder = TempDir::new();
    let names = ["cow", "fandisk_cad", "jinx_dirty", "dragon_47k", "bunny", "gargo"];
    let files = names.map(|name| Path::new(&meshes).join(format!("{name}.ply")));
    let models: Vec<_> =
        names.iter().zip(&files).map(|(&name, file)| (name, read_mesh_in_memory(file).expect("a mesh").0)).collect();
    ingest(&files.each_ref().map(|file| &**file), &folder.join("repository"));
    check_complete(&models, &folder);
}

#[test]
fn triangle_limits_hold_and_are_used() {
    let folder = TempDir::new();
    let repository = folder.join("repository");
    let models = [("sphere", meshes::colored_sphere(5)), ("genus", meshes::genus(3, 10))];
    let files = models.each_ref().map(|(name, mesh)| folder.write_mesh(name, mesh));
    ingest(&files.each_ref().map(|file| &**file), &repository);
    let server_process = ServerProcess::start(&repository);
    for (name, _) in models {
        let figures = |args: &[&str]| {
            let output = snapshot(&server_process.url(name), args.iter().copied().chain(["--json"]));
            assert!(output.status.success(), "{name} {args:?}: {}", described(&output));
            serde_json::from_slice::<serde_json::Value>(&output.stdout).expect("--json prints JSON")
        };
        for view in [&["--complete"][..], &["--tolerance", "0.25", "--size", "640x480"]] {
            let wanted = figures(&[view, &["--triangles", "unlimited"]].concat())["triangles"].as_u64().unwrap();
            assert!(wanted > 1_000, "{name} {view:?}: {wanted} leave no limit to bind");
            let smallest = u64::from(open(&repository, name).info().smallest_limit);
            for limit in [smallest, 999, 2_000, 3_333, 50_000] {
                let stats = figures(&[view, &["--triangles", &limit.to_string()]].concat());
                let (most, held) =
                    (stats["max_triangles_seen"].as_u64().unwrap(), stats["triangles"].as_u64().unwrap());
                assert!(held <= most && most <= limit, "{name} {view:?}: {most} of {limit}");
                assert_eq!(stats["settled"], true, "{name} {view:?} {limit}");
                // The smallest limit is the base itself, with room for nothing.
                if wanted > limit && limit > smallest {
                    assert!(held * 100 >= limit * 97, "{name} {view:?}: only {held} of {limit}");
                    assert_eq!(stats["limited"], true, "{name} {view:?} {limit}");
                }
            }
        }
    }
}

#[test]
fn a_limit_below_the_smallest_is_refused() {
    let folder = TempDir::new();
    let repository = folder.join("repository");
    ingest(&[&folder.write_mesh("genus", &meshes::genus(3, 6))], &repository);
    let smallest = open(&repository, "genus").info().smallest_limit;
    assert!(smallest > 1);
    let mut server_process = ServerProcess::start(&repository);
    let limit = (smallest - 1).to_string();
    check_failure(&server_process, "genus", &["--triangles", &limit], &[&limit, &smallest.to_string(), "smallest"]);
    server_process.check_healthy();
}

#[test]
fn what_cannot_be_done_is_said() {
    let folder = TempDir::new();
    let repository = folder.join("repository");
    ingest(&[&folder.write_mesh("cube", &meshes::cube())], &repository);
    let mut server_process = ServerProcess::start(&repository);
    check_failure(&server_process, "nothing", &[], &["no model 'nothing'"]);
    let absent = folder.join("absent").join("x.ply");
    check_failure(&server_process, "cube", &["--export", absent.to_str().unwrap()], &["absent"]);
    for args in [&["--frobnicate"][..], &["--size", "0x5"], &["--triangles", "-5"], &["--eye", "1,2,3"]] {
        let output = snapshot(&server_process.url("cube"), args);
        assert_eq!(output.status.code(), Some(2), "{args:?}: {}", described(&output));
    }
    for args in [&["serve"][..], &["serve", "--repository", ".", "--listen", "nowhere"], &["ingest"], &["frobnicate"]] {
        let output = server(args);
        assert_eq!(output.status.code(), Some(2), "{args:?}: {}", described(&output));
    }
    server_process.check_healthy();
}

/// Exit code 1, one line on standard error with all the words, nothing on standard output.
fn check_failure(server_process: &ServerProcess, model: &str, args: &[&str], words: &[&str]) {
    let output = snapshot(&server_process.url(model), args);
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{}", described(&output));
    assert!(message.starts_with("error: ") && message.lines().count() == 1, "{message}");
    assert!(words.iter().all(|word| message.contains(word)), "{words:?} in {message}");
    assert!(output.stdout.is_empty(), "{}", described(&output));
}
