//! Constants and field offsets of the file; the prose is in `FORMAT.md`, golden bytes hold the two together.

use bytemuck::{Pod, Zeroable};

#[cfg(target_endian = "big")]
compile_error!("packs are read in place and are little-endian");

pub(super) const MAGIC: [u8; 8] = *b"LODEPACK";
/// Version of the layout that this code writes, and the only one that it reads so far.
pub const VERSION: u32 = 1;

/// Ops per op page and spawns per spawn page.
pub const PAGE_OPS: u32 = 256;
pub(super) const PAGE_SHIFT: u32 = PAGE_OPS.trailing_zeros();

/// More sections than any version will have: bounds what a hostile header makes us read.
pub(super) const MAX_SECTIONS: u32 = 64;
/// Bounds what the JSON parser is given at open.
pub(super) const MAX_METADATA_BYTES: u64 = 4 << 20;
/// Sphere centres stay within this many lattice steps of the origin, so that `f32` holds them exactly.
pub(super) const MAX_CENTER: i32 = 1 << 23;

/// First bytes of the file, followed by the section table.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub(super) struct FileHeader {
    pub(super) magic: [u8; 8],
    pub(super) version: u32,
    pub(super) sections: u32,
    pub(super) file_bytes: u64,
    /// XXH3-64 of this header, with this field zero, and the section table.
    pub(super) checksum: u64,
}

/// One entry of the section table. Entries are in file order.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub(super) struct SectionEntry {
    pub(super) kind: u32,
    /// [`SECTION_REQUIRED`] or zero.
    pub(super) flags: u32,
    /// From the start of the file, a multiple of 8.
    pub(super) offset: u64,
    /// Without the padding that follows.
    pub(super) bytes: u64,
    /// XXH3-64 of the section's bytes.
    pub(super) checksum: u64,
}

/// A reader that does not know the section's kind must refuse the file.
pub(super) const SECTION_REQUIRED: u32 = 1;

/// Most bytes of a thumbnail: bounds what a server hands out for a hostile pack.
pub(super) const MAX_THUMBNAIL_BYTES: u64 = 1 << 16;

/// Sections of version 1, in file order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub(super) enum Section {
    Model = 1,
    Metadata = 2,
    Base = 3,
    SpawnTable = 4,
    SpawnPages = 5,
    SpawnDirectory = 6,
    OpPages = 7,
    OpDirectory = 8,
    Thumbnail = 9,
}

impl Section {
    /// Those that every pack has, and that a reader must know.
    pub(super) const REQUIRED: [Self; 8] = [
        Self::Model,
        Self::Metadata,
        Self::Base,
        Self::SpawnTable,
        Self::SpawnPages,
        Self::SpawnDirectory,
        Self::OpPages,
        Self::OpDirectory,
    ];

    pub(super) fn from_kind(kind: u32) -> Option<Self> {
        Self::REQUIRED.into_iter().chain([Self::Thumbnail]).find(|s| *s as u32 == kind)
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Model => "model",
            Self::Metadata => "metadata",
            Self::Base => "base",
            Self::SpawnTable => "spawn table",
            Self::SpawnPages => "spawn pages",
            Self::SpawnDirectory => "spawn directory",
            Self::OpPages => "op pages",
            Self::OpDirectory => "op directory",
            Self::Thumbnail => "thumbnail",
        }
    }
}

/// Name of what comes before the sections, in errors.
pub(super) const HEADER_NAME: &str = "header";
/// Name of a section of a kind that this version does not know.
pub(super) const UNKNOWN_NAME: &str = "unknown";

/// The model section.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub(super) struct ModelFields {
    pub(super) origin: [f64; 3],
    pub(super) step: f64,
    pub(super) bits: u32,
    pub(super) flags: u32,
    pub(super) box_min: [i32; 3],
    pub(super) box_max: [i32; 3],
    pub(super) hash: u64,
    pub(super) vertices: u64,
    pub(super) triangles: u64,
    pub(super) spawns: u32,
    pub(super) ops: u32,
    pub(super) base_vertices: u32,
    pub(super) base_faces: u32,
}

pub(super) const FLAG_COLORS: u32 = 1;
pub(super) const FLAG_MOVES: u32 = 2;
pub(super) const FLAG_OPEN: u32 = 4;
pub(super) const FLAG_VERTICES: u32 = 8;
/// The upper half of the flags is the step of a model of `visual` precision, 0 for others.
pub(super) const STEP_SHIFT: u32 = 16;

/// One entry of the spawn table: numbers of the first root vertex and root face of a spawn. A last entry holds the totals.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
pub(crate) struct SpawnEntry {
    pub(crate) vertex: u32,
    pub(crate) face: u32,
}

/// Bytes before the column table of an op page: checksum (8), ops (2), columns (2), zero (4).
pub(super) const PAGE_HEADER: usize = 16;
/// Bytes before the arrays of a spawn page: its checksum.
pub(super) const SPAWN_PAGE_HEADER: usize = 8;

/// Columns of an op page. The first [`TESTS`](column::TESTS) have a row per op, the others a row per split.
pub(super) mod column {
    pub(crate) const CENTER: usize = 0;
    pub(crate) const RADIUS: usize = 3;
    pub(crate) const ERROR: usize = 4;
    pub(crate) const AXIS: usize = 5;
    pub(crate) const HALF_ANGLE: usize = 7;
    pub(crate) const TESTS: usize = 8;
    pub(crate) const TAGS: usize = 8;
    pub(crate) const NEXT_OF_S: usize = 9;
    pub(crate) const FIRST_OF_T: usize = 10;
    pub(crate) const TREE: usize = 11;
    pub(crate) const LEFT: usize = 12;
    pub(crate) const RIGHT: usize = 13;
    pub(crate) const POSITION: usize = 14;
    /// Columns without colours and moves. Colours (3) follow if the model has any, then moves (3) if placements move `s`,
    /// then colour moves (3) if both, then the ops on neighbouring vertices (6) if the model depends by vertices.
    pub(crate) const PLAIN: usize = 17;

    /// Columns of a model's pages, without the ops on neighbouring vertices.
    pub(crate) fn count(has_colors: bool, has_moves: bool) -> usize {
        PLAIN + 3 * (usize::from(has_colors) + usize::from(has_moves) + usize::from(has_colors && has_moves))
    }

    pub(crate) fn colors() -> usize {
        PLAIN
    }

    pub(crate) fn moves(has_colors: bool) -> usize {
        PLAIN + if has_colors { 3 } else { 0 }
    }

    pub(crate) fn color_moves() -> usize {
        PLAIN + 6
    }

    pub(crate) fn vertex_ops(has_colors: bool, has_moves: bool) -> usize {
        count(has_colors, has_moves)
    }

    /// Width in bytes of columns that are always stored as they are, with base 0.
    pub(crate) fn fixed_width(column: usize) -> Option<u8> {
        match column {
            RADIUS | ERROR | TAGS => Some(2),
            AXIS..=HALF_ANGLE => Some(1),
            _ => None,
        }
    }
}

/// The tags of a split: what its reference columns mean.
pub(super) mod tag {
    /// Of a cut reference (2 bits): nothing, `f_l` or `f_r` of a split, a root face. Two bits of edge follow.
    pub(crate) const CUT_NONE: u32 = 0;
    pub(crate) const CUT_SPLIT_LEFT: u32 = 1;
    pub(crate) const CUT_SPLIT_RIGHT: u32 = 2;
    pub(crate) const CUT_ROOT: u32 = 3;
    pub(crate) const RIGHT_SHIFT: u32 = 4;
    /// Of the tree parent (2 bits): `s` is a root vertex, the vertex that the tree parent kept, the one that it inserted.
    pub(crate) const TREE_SHIFT: u32 = 8;
    pub(crate) const TREE_ROOT: u32 = 0;
    pub(crate) const TREE_KEPT: u32 = 1;
    pub(crate) const TREE_INSERTED: u32 = 2;
    /// Whether the child columns mean anything.
    pub(crate) const HAS_NEXT_OF_S: u32 = 1 << 10;
    pub(crate) const HAS_FIRST_OF_T: u32 = 1 << 11;
    pub(crate) const ALL: u32 = (1 << 12) - 1;
}

/// Rounds up to the 8-byte grid.
pub(super) const fn align8(bytes: usize) -> usize {
    (bytes + 7) & !7
}

/// Bytes of the arrays of patches with so many vertices and faces, padded: positions, faces, first splits, colours.
pub(super) fn patch_bytes(vertices: u64, faces: u64, has_colors: bool) -> u64 {
    (vertices * if has_colors { 19 } else { 16 } + faces * 12).next_multiple_of(8)
}
