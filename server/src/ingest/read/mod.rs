//! Mesh files in, [`TriMesh`] out.
//!
//! Every reader takes the whole file as bytes and trusts none of them: counts are checked against the bytes that are
//! left before anything is allocated, nothing recurses, and the work is linear in the length of the file. A reader
//! reports what the file holds; mending it is the job of [`crate::ingest::clean`].
//!
//! Read next: [`ply`](read_ply), [`obj`](read_obj).

use std::fmt;
use std::path::Path;

use serde::Serialize;

use crate::mesh::TriMesh;

mod number;
mod obj;
mod ply;

pub use obj::read_obj;
pub use ply::read_ply;

#[cfg(test)]
mod mutation_tests;
#[cfg(test)]
mod round_trip_tests;

/// Most triangles one mesh may have: half-edges are numbered by `u32`, three to a triangle.
pub const MAX_TRIANGLES: usize = (u32::MAX / 3) as usize;

/// Most vertices one mesh may have.
pub const MAX_VERTICES: usize = u32::MAX as usize;

/// What a reader found, for people and for the model's metadata.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ReadReport {
    /// Format of the file.
    pub format: Format,
    /// Vertices in the file.
    pub vertices: u64,
    /// Faces in the file, polygons counted once (triangle strips count as one face each).
    pub faces: u64,
    /// Triangles after polygons became fans.
    pub triangles: u64,
    /// Whether every vertex got a colour from the file.
    pub colored: bool,
    /// What the file holds and the mesh does not, one sentence fragment each, in the order of the file.
    pub not_carried: Vec<String>,
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
}

/// Where in a file something was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// Line of a text file, from 1.
    Line(u64),
    /// Byte offset in a binary file, from 0.
    Byte(u64),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line(line) => write!(f, "line {line}"),
            Self::Byte(byte) => write!(f, "byte {byte}"),
        }
    }
}

/// Why a file gave no mesh. The file is at fault, except for [`ReadError::Io`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReadError {
    /// The file could not be read from its disk.
    #[error("cannot read the file")]
    Io(#[from] std::io::Error),
    /// A format that is known, but that no reader exists for yet.
    #[error("{format} files are not supported yet; ply and obj are")]
    NotSupportedYet {
        /// Usual name of the format.
        format: &'static str,
    },
    /// Neither the content nor the extension tells a format.
    #[error("unknown format (extension {extension:?}); ply and obj are supported")]
    UnknownFormat {
        /// Extension of the file, without its dot, empty if there is none.
        extension: String,
    },
    /// A PLY header that cannot be understood.
    #[error("header line {line}: {problem}")]
    Header {
        /// Line, from 1.
        line: u64,
        /// What is wrong with it.
        problem: String,
    },
    /// A statement of a text file that cannot be understood.
    #[error("line {line}: {problem}")]
    Statement {
        /// Line, from 1.
        line: u64,
        /// What is wrong with it.
        problem: String,
    },
    /// A row of a PLY element that cannot be understood, or where the file ends.
    #[error("{element} {index} at {place}: {problem}")]
    Row {
        /// Name of the element, such as `vertex`.
        element: String,
        /// Row of the element, from 0.
        index: u64,
        /// Where the row's offending value starts.
        place: Place,
        /// What is wrong with it.
        problem: String,
    },
    /// More rows are announced than the rest of the file can hold.
    #[error("{rows} rows of element {element} need at least {needed} bytes, but only {left} follow")]
    Truncated {
        /// Name of the element.
        element: String,
        /// Rows that the header announces.
        rows: u64,
        /// Least bytes that they take.
        needed: u128,
        /// Bytes that are left.
        left: u64,
    },
    /// A face names a vertex that does not exist.
    #[error("face {face} at {place} names vertex {index}, but the file has {vertices} vertices")]
    VertexOutOfRange {
        /// The face, from 0.
        face: u64,
        /// Where the face or its index stands.
        place: Place,
        /// The index as the file writes it.
        index: i64,
        /// Vertices in the file.
        vertices: u64,
    },
    /// A point cloud, or an empty file.
    #[error("the file holds no faces (it has {vertices} vertices; point clouds cannot be ingested)")]
    NoFaces {
        /// Vertices in the file.
        vertices: u64,
    },
    /// More than [`MAX_VERTICES`] or [`MAX_TRIANGLES`].
    #[error("the mesh has more than {limit} {what}")]
    TooLarge {
        /// What there is too much of.
        what: &'static str,
        /// How many there may be.
        limit: u64,
    },
}

/// Reads the mesh in the file at `path`.
///
/// PLY is known by its first bytes, OBJ by its extension. The file is read into memory whole.
///
/// # Errors
/// [`ReadError`] says what stands where. Nothing is guessed: a file with one bad index gives no mesh.
pub fn read_mesh(path: &Path) -> Result<(TriMesh, ReadReport), ReadError> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    let bytes = std::fs::read(path)?;
    if bytes.starts_with(b"ply") && bytes.get(3).is_some_and(|&b| b <= b' ') {
        return read_ply(&bytes);
    }
    if bytes.starts_with(b"glTF") {
        return Err(ReadError::NotSupportedYet { format: "GLB" });
    }
    match extension.as_str() {
        "ply" => read_ply(&bytes),
        "obj" => read_obj(&bytes),
        "stl" => Err(ReadError::NotSupportedYet { format: "STL" }),
        "off" | "coff" | "noff" => Err(ReadError::NotSupportedYet { format: "OFF" }),
        "gltf" => Err(ReadError::NotSupportedYet { format: "glTF" }),
        "glb" => Err(ReadError::NotSupportedYet { format: "GLB" }),
        _ => Err(ReadError::UnknownFormat { extension }),
    }
}

/// Appends the fan of one polygon, corner by corner, without a buffer.
struct Fan<'a> {
    faces: &'a mut Vec<[u32; 3]>,
    first: u32,
    previous: u32,
    corners: usize,
}

impl<'a> Fan<'a> {
    fn new(faces: &'a mut Vec<[u32; 3]>) -> Self {
        Self { faces, first: 0, previous: 0, corners: 0 }
    }

    #[inline]
    fn push(&mut self, corner: u32) -> Result<(), ReadError> {
        match self.corners {
            0 => self.first = corner,
            1 => {}
            _ => push_face(self.faces, [self.first, self.previous, corner])?,
        }
        self.previous = corner;
        self.corners += 1;
        Ok(())
    }
}

/// Appends one triangle, within [`MAX_TRIANGLES`].
#[inline]
fn push_face(faces: &mut Vec<[u32; 3]>, face: [u32; 3]) -> Result<(), ReadError> {
    if faces.len() == MAX_TRIANGLES {
        return Err(ReadError::TooLarge { what: "triangles", limit: MAX_TRIANGLES as u64 });
    }
    faces.push(face);
    Ok(())
}

/// Text of the file for an error message: short, printable, in quotes.
fn quoted(text: &[u8]) -> String {
    const SHOWN: usize = 32;
    let shown: String = text.iter().take(SHOWN).flat_map(|&b| std::ascii::escape_default(b)).map(char::from).collect();
    format!("`{shown}{}`", if text.len() > SHOWN { "..." } else { "" })
}

/// Colour channel in 0..=1 to 0..=255; what lies outside is clamped and NaN is 0.
fn channel_from_unit(value: f64) -> u8 {
    // `as` saturates and takes NaN to 0, both of which are wanted here.
    (value * 255.0 + 0.5) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_formats_without_a_reader_say_so() {
        let dir = std::env::temp_dir().join(format!("lodestream-read-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        for (name, content, expected) in [
            ("a.stl", "solid x", "STL files are not supported yet; ply and obj are"),
            ("b.bin", "glTF", "GLB files are not supported yet; ply and obj are"),
            ("c.xyz", "1 2 3", "unknown format (extension \"xyz\"); ply and obj are supported"),
            ("d.ply", "plywood", "header line 1: a PLY file starts with the line `ply`"),
        ] {
            let path = dir.join(name);
            std::fs::write(&path, content).unwrap();
            assert_eq!(read_mesh(&path).unwrap_err().to_string(), expected);
        }
        std::fs::remove_dir_all(&dir).unwrap();
        assert!(matches!(read_mesh(&dir.join("gone.ply")), Err(ReadError::Io(_))));
    }

    #[test]
    fn ply_is_known_by_its_content() {
        let path = std::env::temp_dir().join(format!("lodestream-read-{}.dat", std::process::id()));
        std::fs::write(&path, "ply\nformat ascii 1.0\nend_header\n").unwrap();
        let result = read_mesh(&path);
        std::fs::remove_file(&path).unwrap();
        assert!(matches!(result, Err(ReadError::NoFaces { vertices: 0 })));
    }
}
