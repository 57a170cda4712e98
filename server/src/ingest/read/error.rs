//! Why a file gave no mesh, and where.

use std::fmt;

use crate::ingest::spill::SpillError;

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

/// Why a file gave no mesh. The file is at fault, except for [`ReadError::Io`] and [`ReadError::Spill`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReadError {
    /// The file could not be read from its disk.
    #[error("cannot read the file")]
    Io(#[from] std::io::Error),
    /// What was read could not be kept.
    #[error(transparent)]
    Spill(#[from] SpillError),
    /// A directory, a pipe or the like: its length is not known before it is read.
    #[error("it is {what}, not a file")]
    NotAFile {
        /// What it is.
        what: &'static str,
    },
    /// A file of no bytes.
    #[error("the file is empty")]
    Empty,
    /// The file ended before its length when it was opened.
    #[error("the file ends at byte {at}, but it had {len} bytes when it was opened")]
    Shrunk {
        /// Where it ends now.
        at: u64,
        /// Its length before.
        len: u64,
    },
    /// Neither the content nor the extension tells a format.
    #[error("unknown format (extension {extension:?}); ply, obj, stl, off, gltf and glb are supported")]
    UnknownFormat {
        /// Extension of the file, without its dot, empty if there is none.
        extension: String,
    },
    /// A header that cannot be understood.
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
    /// Bytes of a binary file that cannot be understood.
    #[error("byte {byte}: {problem}")]
    Bytes {
        /// Offset, from 0.
        byte: u64,
        /// What is wrong there.
        problem: String,
    },
    /// A part of a glTF document that cannot be used.
    #[error("{part}: {problem}")]
    Document {
        /// The part, such as `accessors[3]`.
        part: String,
        /// What is wrong with it.
        problem: String,
    },
    /// A row of an element that cannot be understood, or where the file ends.
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
    /// A point cloud, or a file without a mesh.
    #[error("the file holds no faces (it has {vertices} vertices; point clouds cannot be ingested)")]
    NoFaces {
        /// Vertices in the file.
        vertices: u64,
    },
    /// More than [`MAX_VERTICES`](super::MAX_VERTICES) or [`MAX_TRIANGLES`](super::MAX_TRIANGLES).
    #[error("the mesh has more than {limit} {what}")]
    TooLarge {
        /// What there is too much of.
        what: &'static str,
        /// How many there may be.
        limit: u64,
    },
}
