//! A cleaned mesh on its lattice, cut into chunks of neighbouring faces: what simplification works through, chunk by chunk,
//! without ever holding the whole.
//!
//! Chunks follow the Morton curve, so a run of [`FAN_IN`] consecutive ones lies close together. They are the leaves of a tree:
//! the node at *height* `h` with number `i` holds the chunks `i * FAN_IN^h ..`. A vertex whose faces all lie in one node is
//! *inside* it, and so are its components; at the height of the root everything is.

use lodestream_protocol::quant::Lattice;

use super::hierarchy::Point;
use super::partition::Resampled;
use super::spill::{Spill, SpillError};
use crate::pack::CompleteMesh;

/// Children of a node, as a shift.
pub(crate) const FAN_IN_SHIFT: u32 = 3;
/// Children of a node.
pub(crate) const FAN_IN: u32 = 1 << FAN_IN_SHIFT;
/// Most faces of a chunk, but for a single vertex with more faces: few enough for a chunk to stay in the cache.
pub(crate) const MAX_CHUNK_FACES: usize = 1 << 18;

/// See the module.
#[derive(Debug)]
pub(crate) struct ChunkedMesh {
    pub(crate) lattice: Lattice,
    pub(crate) has_colors: bool,
    /// Whether so much boundary is there that the inside can be seen.
    pub(crate) is_open: bool,
    /// Numbered along the Morton curve, copies of a vertex after each other. Every vertex has a face.
    pub(crate) vertices: VertexTable,
    /// Corners by vertex number, chunk after chunk. Each face keeps the order of its corners. The number of a face is its place.
    pub(crate) faces: Spill<[u32; 3]>,
    /// First face of each chunk, and the number of faces at the end. No chunk is empty.
    pub(crate) chunk_starts: Vec<u32>,
    pub(crate) components: ComponentTable,
    /// What `visual` precision did to the vertices.
    pub(crate) resampled: Option<Resampled>,
    /// The mesh in figures: what complete refinement must give back.
    pub(crate) complete: CompleteMesh,
}

impl ChunkedMesh {
    pub(crate) fn chunk_count(&self) -> u32 {
        self.chunk_starts.len() as u32 - 1
    }

    /// Faces of a chunk.
    pub(crate) fn chunk(&self, chunk: u32) -> Result<Vec<[u32; 3]>, SpillError> {
        let [first, end] = [chunk, chunk + 1].map(|c| u64::from(self.chunk_starts[c as usize]));
        self.faces.read(first..end)
    }

    /// Height of the root.
    pub(crate) fn height(&self) -> u8 {
        height_of(0, self.chunk_count().saturating_sub(1))
    }
}

/// Height of the smallest node that holds both chunks.
pub(crate) fn height_of(first: u32, last: u32) -> u8 {
    (0..).find(|&h| first >> (FAN_IN_SHIFT * h) == last >> (FAN_IN_SHIFT * h)).expect("both become 0") as u8
}

/// The vertices of the cleaned mesh: 9 bytes each, 12 with colours.
#[derive(Debug, Default)]
pub(crate) struct VertexTable {
    /// 21 bits per axis, x lowest.
    packed: Vec<u64>,
    /// Empty for a model without colours.
    colors: Vec<[u8; 3]>,
    /// Height of the smallest node that the vertex is inside of; bit 7: on the boundary.
    places: Vec<u8>,
}

const BOUNDARY: u8 = 0x80;

impl VertexTable {
    /// `colors` is empty for a model without colours; else all three have the same length.
    pub(crate) fn new(packed: Vec<u64>, colors: Vec<[u8; 3]>, places: Vec<u8>) -> Self {
        assert!(packed.len() == places.len() && (colors.is_empty() || colors.len() == packed.len()));
        Self { packed, colors, places }
    }

    pub(crate) fn len(&self) -> usize {
        self.packed.len()
    }

    pub(crate) fn positions(&self) -> impl Iterator<Item = [i32; 3]> + '_ {
        self.packed.iter().copied().map(unpack)
    }

    pub(crate) fn position(&self, v: u32) -> [i32; 3] {
        unpack(self.packed[v as usize])
    }

    /// Moves a vertex.
    pub(crate) fn set_position(&mut self, v: u32, position: [i32; 3]) {
        self.packed[v as usize] = pack(position);
    }

    pub(crate) fn color(&self, v: u32) -> [u8; 3] {
        self.colors.get(v as usize).copied().unwrap_or_default()
    }

    /// Whether some face of the cleaned mesh ends at the vertex: it has an edge with a single face.
    pub(crate) fn is_boundary(&self, v: u32) -> bool {
        self.places[v as usize] & BOUNDARY != 0
    }

    /// Vertices on the boundary.
    pub(crate) fn boundary_count(&self) -> usize {
        self.places.iter().filter(|&&place| place & BOUNDARY != 0).count()
    }

    /// Height of the smallest node that holds all faces of the vertex.
    pub(crate) fn height(&self, v: u32) -> u8 {
        self.places[v as usize] & !BOUNDARY
    }

    pub(crate) fn point(&self, v: u32) -> Point {
        Point { position: self.position(v), color: self.color(v), is_boundary: self.is_boundary(v) }
    }
}

/// Entry of [`VertexTable`] for its height and whether it is on the boundary.
pub(crate) fn place(height: u8, is_boundary: bool) -> u8 {
    debug_assert!(height < BOUNDARY);
    height | if is_boundary { BOUNDARY } else { 0 }
}

/// A lattice position in 63 bits.
pub(crate) fn pack([x, y, z]: [i32; 3]) -> u64 {
    (x as u64) | (y as u64) << 21 | (z as u64) << 42
}

fn unpack(packed: u64) -> [i32; 3] {
    [packed, packed >> 21, packed >> 42].map(|x| (x & 0x1f_ffff) as i32)
}

/// The connected components of the cleaned mesh.
///
/// A *patch* is what hangs together by shared vertices within one chunk. [`patches`] numbers those of a chunk, so that the
/// component of each of its faces follows without a table of all faces.
#[derive(Debug, Default)]
pub(crate) struct ComponentTable {
    /// First patch of each chunk, and the number of patches at the end.
    pub(crate) patch_starts: Vec<u32>,
    /// Component of each patch; components are numbered by their first patch.
    pub(crate) of_patch: Vec<u32>,
    pub(crate) components: Vec<Component>,
}

/// What is known of a component before it is simplified.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Component {
    /// Smallest and largest coordinates.
    pub(crate) low: [i32; 3],
    pub(crate) high: [i32; 3],
    /// Height of the smallest node that the component is inside of.
    pub(crate) height: u8,
}

/// The vertices of some faces: their global numbers, ascending.
#[cfg(test)]
pub(crate) fn vertices_of(faces: &[[u32; 3]]) -> Vec<u32> {
    let mut vertices: Vec<u32> = faces.as_flattened().to_vec();
    vertices.sort_unstable();
    vertices.dedup();
    vertices
}

/// Patch of each face of a chunk, numbered by their first faces, and how many there are. Corners are places in a list of
/// `vertex_count` vertices. O(faces), near enough.
pub(crate) fn patches(vertex_count: usize, faces: &[[u32; 3]]) -> (Vec<u32>, u32) {
    let mut up: Vec<u32> = (0..vertex_count as u32).collect();
    fn root(up: &mut [u32], mut v: u32) -> u32 {
        while up[v as usize] != v {
            up[v as usize] = up[up[v as usize] as usize];
            v = up[v as usize];
        }
        v
    }
    for face in faces {
        let [a, b, c] = face.map(|v| root(&mut up, v));
        let low = a.min(b).min(c);
        for v in [a, b, c] {
            up[v as usize] = low;
        }
    }
    let mut labels = vec![u32::MAX; vertex_count];
    let mut count = 0;
    let of_faces = faces
        .iter()
        .map(|face| {
            let label = &mut labels[root(&mut up, face[0]) as usize];
            if *label == u32::MAX {
                *label = count;
                count += 1;
            }
            *label
        })
        .collect();
    (of_faces, count)
}
