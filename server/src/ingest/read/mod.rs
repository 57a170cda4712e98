//! Mesh files in, [`RawMesh`] out.
//!
//! Readers stream: no file is held in memory whole, except for a glTF document, whose length is limited. They trust no byte:
//! counts are checked against the bytes that are left before anything is allocated, nothing recurses, and the work is linear
//! in the length of the file. A reader reports what the file holds; mending it is the job of [`crate::ingest::clean`].
//!
//! Vertex colours are carried. Textures and material colours are baked into them; normals and texture coordinates are not
//! carried. All that is left is named in [`ReadReport::not_carried`].
//!
//! Read next: `input` (the bytes), `sink` (the mesh), then one file for each format.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use serde::Serialize;

use super::raw::RawMesh;
use super::spill::Workspace;
use crate::mesh::TriMesh;

mod error;
mod gltf;
mod input;
mod number;
mod obj;
mod off;
mod ply;
mod sink;
mod stl;
mod texture;

pub use error::{Place, ReadError};

use input::Input;
use sink::Sink;
use texture::color::channel_from_unit;

#[cfg(test)]
mod mutation_tests;
#[cfg(test)]
mod round_trip_tests;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
#[cfg(test)]
mod tests;

/// Most triangles one mesh may have: half-edges are numbered by `u32`, three to a triangle.
pub const MAX_TRIANGLES: usize = (u32::MAX / 3) as usize;

/// Most vertices one mesh may have.
pub const MAX_VERTICES: usize = u32::MAX as usize;

/// What a reader found, for people and for the model's metadata.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ReadReport {
    /// Format of the file.
    pub format: Format,
    /// Vertices in the file. Those of STL are three for each triangle, those of glTF count once for each instance of a mesh.
    pub vertices: u64,
    /// Faces in the file, polygons counted once (triangle strips count as one face each).
    pub faces: u64,
    /// Triangles after polygons became fans.
    pub triangles: u64,
    /// Whether every vertex got a colour from the file, its materials or its textures.
    pub colored: bool,
    /// What was changed on the way in, one sentence fragment each: what was baked into vertex colours, and how.
    pub notes: Vec<String>,
    /// What the file holds and the mesh does not, one sentence fragment each, in the order of the file.
    pub not_carried: Vec<String>,
}

impl ReadReport {
    /// Of what is in `sink`, with a face for each triangle.
    fn new(format: Format, sink: &Sink<'_>) -> Self {
        Self {
            format,
            vertices: sink.vertices(),
            faces: sink.triangles(),
            triangles: sink.triangles(),
            colored: sink.is_colored(),
            notes: Vec::new(),
            not_carried: Vec::new(),
        }
    }
}

/// A mesh file format that can be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Format {
    /// PLY, text.
    PlyAscii,
    /// PLY, binary, little-endian.
    PlyBinaryLittleEndian,
    /// PLY, binary, big-endian.
    PlyBinaryBigEndian,
    /// Wavefront OBJ.
    Obj,
    /// STL, text.
    StlAscii,
    /// STL, binary.
    StlBinary,
    /// OFF, text.
    OffAscii,
    /// OFF, binary.
    OffBinary,
    /// glTF 2.0, a JSON document.
    Gltf,
    /// glTF 2.0 with its data in one file.
    Glb,
}

/// Reads the mesh in the file at `path` into spills of `workspace`; what is in the workspace's memory is all that is held of
/// it, but for buffers of some megabytes. Textures take up to 200 MB while they are baked, and an OBJ that has some takes
/// 8 bytes for each texture coordinate and 4 for each vertex until it is read. `progress` is called each megabyte or so with
/// the bytes read so far and in all.
///
/// PLY, GLB and OFF are known by their first bytes, binary STL by its length, the others by their extension. Materials,
/// textures and buffers are only looked for in the directory of the file and below it.
///
/// # Errors
/// [`ReadError`] says what stands where. Nothing is guessed: a file with one bad index gives no mesh.
pub fn read_mesh(
    path: &Path,
    workspace: &Workspace,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<(RawMesh, ReadReport), ReadError> {
    // Before it is opened: opening a pipe waits for somebody to write.
    let metadata = std::fs::metadata(path)?;
    if !metadata.is_file() {
        return Err(ReadError::NotAFile { what: if metadata.is_dir() { "a directory" } else { "a pipe or a device" } });
    }
    let mut file = File::open(path)?;
    let len = file.metadata()?.len();
    if len == 0 {
        return Err(ReadError::Empty);
    }
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    let mut first = [0; FIRST_BYTES];
    let first_len = usize::try_from(len).unwrap_or(usize::MAX).min(FIRST_BYTES);
    read_first(&mut file, &mut first[..first_len], len)?;
    let first = &first[..first_len];
    let kind = Kind::of(first, len, &extension).ok_or(ReadError::UnknownFormat { extension })?;
    let sink = Sink::new(workspace);
    if let Kind::Gltf = kind {
        return gltf::read(&gltf::Bytes::File { file: &file, len }, path.parent(), sink, progress);
    }
    let mut input = Input::new(first.chain(&file), len).with_progress(progress);
    read_input(kind, &mut input, path.parent(), sink)
}

/// Bytes that tell most formats.
const FIRST_BYTES: usize = 84;

fn read_first(file: &mut File, first: &mut [u8], len: u64) -> Result<(), ReadError> {
    let mut done = 0;
    while done < first.len() {
        match file.read(&mut first[done..]) {
            Ok(0) => return Err(ReadError::Shrunk { at: done as u64, len }),
            Ok(read) => done += read,
            Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
            Err(error) => return Err(ReadError::Io(error)),
        }
    }
    Ok(())
}

/// Which reader a file is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Ply,
    Obj,
    Stl,
    Off,
    Gltf,
}

impl Kind {
    /// By the first bytes of the file, its length and its extension in lower case.
    fn of(first: &[u8], len: u64, extension: &str) -> Option<Self> {
        let is_keyword =
            |keyword: &[u8]| first.strip_prefix(keyword).is_some_and(|rest| rest.first().is_none_or(|&b| b <= b' '));
        if is_keyword(b"ply") {
            return Some(Self::Ply);
        }
        if first.starts_with(b"glTF") {
            return Some(Self::Gltf);
        }
        match extension {
            "ply" => return Some(Self::Ply),
            "obj" => return Some(Self::Obj),
            "stl" => return Some(Self::Stl),
            "off" | "coff" | "noff" | "stoff" | "cnoff" => return Some(Self::Off),
            "gltf" | "glb" => return Some(Self::Gltf),
            _ => {}
        }
        if [&b"OFF"[..], b"COFF", b"NOFF", b"STOFF", b"CNOFF"].into_iter().any(is_keyword) {
            return Some(Self::Off);
        }
        (stl::is_binary(first, len) || is_keyword(b"solid")).then_some(Self::Stl)
    }
}

fn read_input(
    kind: Kind,
    input: &mut Input<'_>,
    directory: Option<&Path>,
    sink: Sink<'_>,
) -> Result<(RawMesh, ReadReport), ReadError> {
    match kind {
        Kind::Ply => ply::read(input, sink),
        Kind::Obj => obj::read(input, directory, sink),
        Kind::Stl => stl::read(input, sink),
        Kind::Off => off::read(input, sink),
        Kind::Gltf => unreachable!("glTF is not read front to back"),
    }
}

/// As [`read_mesh`], into memory.
///
/// # Errors
/// Those of [`read_mesh`].
pub fn read_mesh_in_memory(path: &Path) -> Result<(TriMesh, ReadReport), ReadError> {
    load(read_mesh(path, &Workspace::in_memory(), &mut |_, _| {})?)
}

fn load((mesh, report): (RawMesh, ReadReport)) -> Result<(TriMesh, ReadReport), ReadError> {
    Ok((mesh.load()?, report))
}

fn read_slice(kind: Kind, bytes: &[u8]) -> Result<(TriMesh, ReadReport), ReadError> {
    let workspace = Workspace::in_memory();
    load(read_input(kind, &mut Input::of_slice(bytes), None, Sink::new(&workspace))?)
}

/// Reads a PLY file that is in memory.
///
/// # Errors
/// [`ReadError`].
pub fn read_ply(bytes: &[u8]) -> Result<(TriMesh, ReadReport), ReadError> {
    read_slice(Kind::Ply, bytes)
}

/// Reads an OBJ file that is in memory. Its materials are not looked for.
///
/// # Errors
/// [`ReadError`].
pub fn read_obj(bytes: &[u8]) -> Result<(TriMesh, ReadReport), ReadError> {
    read_slice(Kind::Obj, bytes)
}

/// Reads an STL file that is in memory.
///
/// # Errors
/// [`ReadError`].
pub fn read_stl(bytes: &[u8]) -> Result<(TriMesh, ReadReport), ReadError> {
    read_slice(Kind::Stl, bytes)
}

/// Reads an OFF file that is in memory.
///
/// # Errors
/// [`ReadError`].
pub fn read_off(bytes: &[u8]) -> Result<(TriMesh, ReadReport), ReadError> {
    read_slice(Kind::Off, bytes)
}

/// Reads a glTF or GLB file that is in memory. Buffers and textures in other files are not looked for.
///
/// # Errors
/// [`ReadError`].
pub fn read_gltf(bytes: &[u8]) -> Result<(TriMesh, ReadReport), ReadError> {
    let workspace = Workspace::in_memory();
    load(gltf::read(&gltf::Bytes::Slice(bytes), None, Sink::new(&workspace), &mut |_, _| {})?)
}

/// Text of the file for an error message: short, printable, in quotes.
fn quoted(text: &[u8]) -> String {
    const SHOWN: usize = 32;
    let shown: String = text.iter().take(SHOWN).flat_map(|&b| std::ascii::escape_default(b)).map(char::from).collect();
    format!("`{shown}{}`", if text.len() > SHOWN { "..." } else { "" })
}

/// Notes how many there are of something, if there are any.
fn note(notes: &mut Vec<String>, count: u64, what: &str) {
    if count > 0 {
        notes.push(format!("{count} {what}"));
    }
}
