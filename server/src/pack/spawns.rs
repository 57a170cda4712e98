//! Root vertices and faces: the base and the patches of spawns, in place.

use std::ops::Range;

use lodestream_protocol::limits::MAX_PATCH_ELEMENTS;
use lodestream_protocol::mesh::Patch;

use super::layout::{PAGE_OPS, SPAWN_PAGE_HEADER, SpawnEntry, align8, patch_bytes};
use super::outline::Outline;
use super::page::u32_at;
use super::record::NO_OP;

/// Arrays of the patches of one page of spawns, or of the base: positions, faces, first splits, colours.
#[derive(Clone, Copy, Debug)]
pub(super) struct PatchArrays<'a> {
    bytes: &'a [u8],
    vertices: usize,
    faces: usize,
    has_colors: bool,
}

impl<'a> PatchArrays<'a> {
    /// `None` if the bytes are not as long as the numbers say.
    pub(super) fn new(bytes: &'a [u8], vertices: u32, faces: u32, has_colors: bool) -> Option<Self> {
        let expected = patch_bytes(vertices.into(), faces.into(), has_colors);
        let array = Self { bytes, vertices: vertices as usize, faces: faces as usize, has_colors };
        (bytes.len() as u64 == expected).then_some(array)
    }

    fn triple(&self, at: usize) -> Option<[u32; 3]> {
        Some([u32_at(self.bytes, at)?, u32_at(self.bytes, at + 4)?, u32_at(self.bytes, at + 8)?])
    }

    pub(super) fn position(&self, v: usize) -> Option<[i32; 3]> {
        Some(self.triple(12 * v)?.map(|c| c as i32))
    }

    pub(super) fn face(&self, f: usize) -> Option<[u32; 3]> {
        self.triple(12 * (self.vertices + f))
    }

    pub(super) fn first_split(&self, v: usize) -> Option<u32> {
        u32_at(self.bytes, 12 * (self.vertices + self.faces) + 4 * v)
    }

    fn color(&self, v: usize) -> Option<[u8; 3]> {
        let at = 16 * self.vertices + 12 * self.faces + 3 * v;
        if self.has_colors { self.bytes.get(at..at + 3)?.try_into().ok() } else { Some([0; 3]) }
    }

    /// The patch of so many vertices and faces that begins at these indices.
    pub(super) fn patch(&self, vertex: usize, vertices: usize, face: usize, faces: usize) -> Option<Patch> {
        Some(Patch {
            positions: (vertex..vertex + vertices).map(|v| self.position(v)).collect::<Option<_>>()?,
            colors: (vertex..vertex + vertices).map(|v| self.color(v)).collect::<Option<_>>()?,
            faces: (face..face + faces).map(|f| self.face(f)).collect::<Option<_>>()?,
        })
    }

    /// Checks positions and first splits of all vertices; corners are checked with the manifold when a patch is used.
    pub(super) fn check(&self, max_coordinate: i32, splits: &Range<u32>) -> Result<(), String> {
        for v in 0..self.vertices {
            let position = self.position(v).ok_or("the bytes changed")?;
            if position.iter().any(|c| !(0..=max_coordinate).contains(c)) {
                return Err(format!("root vertex {v} is off the lattice"));
            }
            let first = self.first_split(v).ok_or("the bytes changed")?;
            if first != NO_OP && !splits.contains(&first) {
                return Err(format!("the first split of root vertex {v} is out of range"));
            }
        }
        let used = self.vertices * if self.has_colors { 19 } else { 16 } + self.faces * 12;
        if self.bytes[used..].iter().any(|&b| b != 0) {
            return Err("the padding is not zero".into());
        }
        Ok(())
    }
}

/// The spawn table, in place.
#[derive(Clone, Copy, Debug)]
pub(super) struct SpawnTable<'a> {
    bytes: &'a [u8],
}

impl<'a> SpawnTable<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes }
    }

    pub(super) fn entry(&self, spawn: u32) -> Option<SpawnEntry> {
        let at = 8 * spawn as usize;
        Some(SpawnEntry { vertex: u32_at(self.bytes, at)?, face: u32_at(self.bytes, at + 4)? })
    }

    /// Checks that entries begin after the base and that each spawn has vertices and faces in reasonable numbers.
    /// Returns the faces of the smallest. O(spawns).
    pub(super) fn check(&self, spawns: u32, base: SpawnEntry) -> Result<u32, String> {
        if self.bytes.len() as u64 != 8 * (u64::from(spawns) + 1) {
            return Err(format!("{} bytes for {spawns} spawns", self.bytes.len()));
        }
        let missing = "the bytes changed";
        let mut before = self.entry(0).ok_or(missing)?;
        if before != base {
            return Err("the first spawn does not follow the base".into());
        }
        let mut smallest = u32::MAX;
        for spawn in 0..spawns {
            let next = self.entry(spawn + 1).ok_or(missing)?;
            let size = |from: u32, to: u32| to.checked_sub(from).filter(|n| (1..=MAX_PATCH_ELEMENTS).contains(n));
            let faces = size(before.face, next.face).filter(|_| size(before.vertex, next.vertex).is_some());
            let faces = faces.ok_or_else(|| format!("spawn {spawn} has no size or is too large"))?;
            smallest = smallest.min(faces);
            before = next;
        }
        Ok(smallest)
    }

    /// The spawn whose range holds a number that is known to be past the base and before the end. O(log spawns).
    pub(super) fn find(&self, spawns: u32, number: u32, of: impl Fn(SpawnEntry) -> u32) -> Option<(u32, u32)> {
        let (mut low, mut high) = (0, spawns);
        while low + 1 < high {
            let middle = low + (high - low) / 2;
            if of(self.entry(middle)?) <= number {
                low = middle;
            } else {
                high = middle;
            }
        }
        Some((low, number.checked_sub(of(self.entry(low)?))?))
    }
}

/// Bytes of a page of spawns with so many vertices and faces.
pub(super) fn spawn_page_bytes(vertices: u64, faces: u64, has_colors: bool) -> u64 {
    SPAWN_PAGE_HEADER as u64 + patch_bytes(vertices, faces, has_colors)
}

/// First spawn and one past the last of a page.
pub(super) fn spawns_of_page(page: u32, spawns: u32) -> Range<u32> {
    let first = page * PAGE_OPS;
    first..spawns.min(first.saturating_add(PAGE_OPS))
}

/// Appends the arrays of some root vertices and faces, padded to the grid.
pub(super) fn put_patches(outline: &Outline, vertices: Range<usize>, faces: Range<usize>, out: &mut Vec<u8>) {
    let begin = out.len();
    out.extend_from_slice(bytemuck::cast_slice(&outline.positions[vertices.clone()]));
    out.extend_from_slice(bytemuck::cast_slice(&outline.faces[faces]));
    out.extend_from_slice(bytemuck::cast_slice(&outline.first_splits[vertices.clone()]));
    if outline.has_colors {
        out.extend_from_slice(bytemuck::cast_slice(&outline.colors[vertices]));
    }
    out.resize(begin + align8(out.len() - begin), 0);
}
