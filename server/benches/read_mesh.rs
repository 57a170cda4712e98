//! How fast mesh files are read into spills: `cargo bench -p lodestream-server --bench read_mesh [-- FILE...]`.
//!
//! Without files, a generated grid is written in each format and read back; its numbers are checked.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::time::Instant;

use lodestream_server::ingest::read::read_mesh;
use lodestream_server::ingest::spill::Workspace;
use lodestream_server::mesh::TriMesh;
use lodestream_server::mesh::export::{PlyCoordinates, PlyOptions, write_obj, write_ply, write_stl};

/// Vertices on a side of the grid.
const SIDE: u32 = 1000;

fn main() {
    let files: Vec<PathBuf> =
        std::env::args().skip(1).filter(|arg| !arg.starts_with("--")).map(PathBuf::from).collect();
    let directory = tempfile::tempdir().expect("a directory for temporary files");
    if !files.is_empty() {
        for file in &files {
            read(file, directory.path());
        }
        return;
    }
    let mesh = grid();
    for name in ["ply", "obj", "stl", "off"] {
        let path = directory.path().join(format!("grid.{name}"));
        write(&mesh, name, &path);
        assert_eq!(read(&path, directory.path()), mesh.faces.len() as u64);
    }
    let path = directory.path().join("ascii.ply");
    write(&mesh, "ascii", &path);
    assert_eq!(read(&path, directory.path()), mesh.faces.len() as u64);
}

/// Reads a file three times, prints the best, gives its triangles.
fn read(path: &Path, temporary: &Path) -> u64 {
    let mut best = f64::INFINITY;
    let mut triangles = 0;
    for _ in 0..3 {
        // What does not fit goes to files, as in an ingest of limited memory.
        let workspace = Workspace::new(temporary, 64 << 20);
        let start = Instant::now();
        let (_mesh, report) = read_mesh(path, &workspace, &mut |_, _| {}).expect("the file is good");
        best = best.min(start.elapsed().as_secs_f64());
        triangles = report.triangles;
    }
    let bytes = std::fs::metadata(path).map_or(0, |metadata| metadata.len());
    println!(
        "read/{}: {triangles} triangles in {best:.3} s, {:.1} M/s, {:.0} MB/s",
        path.file_name().unwrap_or_default().display(),
        triangles as f64 / best / 1e6,
        bytes as f64 / best / 1e6
    );
    triangles
}

/// A wavy grid with the digits of a scan.
fn grid() -> TriMesh {
    let height = |x: u32, y: u32| f64::from((x * x + 3 * y * y) % 997) * 1.234_56e-3;
    let vertices = (0..SIDE)
        .flat_map(|y| (0..SIDE).map(move |x| [f64::from(x) * 0.123_45, f64::from(y) * 0.543_21, height(x, y)]));
    let corner = |x: u32, y: u32| y * SIDE + x;
    let faces = (0..SIDE - 1).flat_map(|y| {
        (0..SIDE - 1).flat_map(move |x| {
            let [a, b, c, d] = [corner(x, y), corner(x + 1, y), corner(x, y + 1), corner(x + 1, y + 1)];
            [[a, b, c], [c, b, d]]
        })
    });
    TriMesh { positions: vertices.collect(), faces: faces.collect(), colors: None }
}

fn write(mesh: &TriMesh, format: &str, path: &Path) {
    use std::io::Write as _;
    let mut out = BufWriter::new(File::create(path).expect("a file can be made"));
    let options = PlyOptions { coordinates: PlyCoordinates::Float32, ..PlyOptions::default() };
    let written = match format {
        "ply" => write_ply(mesh, &options, &mut out),
        "obj" => write_obj(mesh, &mut out),
        "stl" => write_stl(mesh, &mut out),
        _ => {
            let [vertices, faces] = [mesh.positions.len(), mesh.faces.len()];
            let head = match format {
                "off" => format!("OFF\n{vertices} {faces} 0\n"),
                _ => format!(
                    "ply\nformat ascii 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n\
                     element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
                ),
            };
            let rows = mesh.positions.iter().map(|[x, y, z]| format!("{x:.6} {y:.6} {z:.6}\n"));
            let rows = rows.chain(mesh.faces.iter().map(|[a, b, c]| format!("3 {a} {b} {c}\n")));
            [head].into_iter().chain(rows).try_for_each(|row| out.write_all(row.as_bytes()))
        }
    };
    written.and_then(|()| out.flush()).expect("the disk has room");
}
