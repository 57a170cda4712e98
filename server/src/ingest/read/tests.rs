//! Files: what they are taken for, and what goes wrong with them.

use std::path::PathBuf;

use super::*;

/// Gives few bytes at a time.
pub(super) fn drip(bytes: &[u8]) -> impl Read {
    struct Drip<'a>(&'a [u8]);
    impl Read for Drip<'_> {
        fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
            let len = (self.0.len() % 5 + 1).min(out.len());
            self.0.read(&mut out[..len])
        }
    }
    Drip(bytes)
}

/// A directory that is removed with all that is in it.
pub(super) struct Folder(tempfile::TempDir);

impl Folder {
    pub(super) fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub(super) fn write(&self, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
        let path = self.0.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, bytes).unwrap();
        path
    }

    /// Writes an image of RGB pixels.
    pub(super) fn write_png(&self, name: &str, width: u32, height: u32, pixels: &[[u8; 3]]) {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, width, height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.write_header().unwrap().write_image_data(pixels.as_flattened()).unwrap();
        self.write(name, bytes);
    }
}

#[test]
fn unknown_and_broken_files_say_so() {
    let folder = Folder::new();
    let unknown = "unknown format (extension \"xyz\"); ply, obj, stl, off, gltf and glb are supported";
    for (name, content, expected) in [
        ("c.xyz", "1 2 3", unknown),
        ("d.ply", "plywood", "header line 1: a PLY file starts with the line `ply`"),
        ("e.ply", "", "the file is empty"),
        ("f.stl", "solid x", "the file holds no faces (it has 0 vertices; point clouds cannot be ingested)"),
        ("g.bin", "glTF", "byte 4: the file ends within a header"),
    ] {
        let path = folder.write(name, content);
        assert_eq!(read_mesh_in_memory(&path).unwrap_err().to_string(), expected);
    }
    assert!(matches!(read_mesh_in_memory(&folder.0.path().join("gone.ply")), Err(ReadError::Io(_))));
    let error = read_mesh_in_memory(folder.0.path()).unwrap_err();
    assert_eq!(error.to_string(), "it is a directory, not a file");
}

#[test]
fn formats_are_known_by_content_and_extension() {
    for (first, len, extension, expected) in [
        (&b"ply\nformat"[..], 10, "dat", Some(Kind::Ply)),
        (b"plywood", 7, "", None),
        (b"glTF", 4, "ply", Some(Kind::Gltf)),
        (b"OFF\n", 4, "txt", Some(Kind::Off)),
        (b"OFFICE", 6, "txt", None),
        (b"{}", 2, "gltf", Some(Kind::Gltf)),
        (b"solid x", 7, "", Some(Kind::Stl)),
        (&[0; 84], 84, "", Some(Kind::Stl)),
        (&[0; 84], 85, "", None),
        (b"v 1 2 3", 7, "obj", Some(Kind::Obj)),
    ] {
        assert_eq!(Kind::of(first, len, extension), expected, "{first:?}");
    }
}

#[test]
fn a_file_goes_to_spills_with_progress() {
    let vertices = 100_000;
    let positions: String = (0..vertices).map(|v| format!("v {v} 0.5 {}\n", v % 7)).collect();
    let faces: String = (3..=vertices).map(|v| format!("f {} {} {v}\n", v - 2, v - 1)).collect();
    let folder = Folder::new();
    let path = folder.write("big.obj", positions + &faces);
    let len = std::fs::metadata(&path).unwrap().len();
    assert!(len > 2 * input::BUFFER as u64);
    let (expected, _) = read_mesh_in_memory(&path).unwrap();
    let workspace = Workspace::new(folder.0.path(), 0);
    let mut steps = Vec::new();
    let (mesh, report) = read_mesh(&path, &workspace, &mut |done, all| steps.push((done, all))).unwrap();
    assert_eq!((report.vertices, report.triangles), (vertices as u64, vertices as u64 - 2));
    assert_eq!(mesh.load().unwrap(), expected);
    assert!(steps.len() > 2 && steps.is_sorted() && steps.iter().all(|step| step.1 == len), "{steps:?}");
    assert_eq!(steps.last().unwrap().0, len);
}

#[cfg(unix)]
#[test]
fn a_file_that_may_not_be_read_says_so() {
    use std::os::unix::fs::PermissionsExt;
    let folder = Folder::new();
    let path = folder.write("secret.ply", "ply\n");
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o0)).unwrap();
    if File::open(&path).is_ok() {
        eprintln!("skipped: this user may read everything");
        return;
    }
    let Err(ReadError::Io(error)) = read_mesh_in_memory(&path) else { panic!("it was read") };
    assert_eq!(error.kind(), std::io::ErrorKind::PermissionDenied);
}
