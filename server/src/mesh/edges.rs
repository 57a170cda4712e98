//! Half-edges grouped by the edge that they run along, and disjoint sets: what connectivity questions are built on.
//!
//! Half-edge `3 * f + k` runs from corner `k` of face `f` to the next corner. Its number also names the corner it
//! starts at.

use std::ops::Range;

/// The half-edge after `half_edge` in its face.
#[inline]
pub(crate) fn next(half_edge: u32) -> u32 {
    if half_edge % 3 == 2 { half_edge - 2 } else { half_edge + 1 }
}

/// The half-edge before `half_edge` in its face.
#[inline]
pub(crate) fn previous(half_edge: u32) -> u32 {
    if half_edge.is_multiple_of(3) { half_edge + 2 } else { half_edge - 1 }
}

/// Vertex at which `half_edge` starts.
#[inline]
pub(crate) fn origin(faces: &[[u32; 3]], half_edge: u32) -> u32 {
    faces.as_flattened()[half_edge as usize]
}

/// Whether a face names one vertex twice.
#[inline]
pub(crate) fn is_degenerate(face: [u32; 3]) -> bool {
    face[0] == face[1] || face[1] == face[2] || face[2] == face[0]
}

/// The half-edges of a mesh, sorted by edge. Faces with a repeated vertex have none.
pub(crate) struct EdgeTable {
    /// Higher vertex and half-edge, grouped by lower vertex and sorted within the group.
    entries: Vec<(u32, u32)>,
    /// Where the group of each lower vertex starts; one more than there are vertices.
    starts: Vec<u32>,
}

/// All half-edges between two vertices.
#[derive(Clone, Debug)]
pub(crate) struct Edge<'a> {
    /// Its lower vertex.
    pub(crate) low: u32,
    /// Its higher vertex.
    pub(crate) high: u32,
    entries: &'a [(u32, u32)],
    range: Range<usize>,
}

impl Edge<'_> {
    /// How many faces have this edge.
    #[inline]
    pub(crate) fn len(&self) -> usize {
        self.entries.len()
    }

    /// Its half-edges, ascending.
    #[inline]
    pub(crate) fn half_edges(&self) -> impl Iterator<Item = u32> + '_ {
        self.entries.iter().map(|&(_, half_edge)| half_edge)
    }

    /// Its half-edge number `k`.
    #[inline]
    pub(crate) fn half_edge(&self, k: usize) -> u32 {
        self.entries[k].1
    }

    /// Names the edge within its table.
    pub(crate) fn range(&self) -> Range<usize> {
        self.range.clone()
    }
}

impl EdgeTable {
    /// Builds the table. Costs a counting sort over vertices, then sorts of some six entries each.
    ///
    /// # Panics
    /// If a corner is not below `vertex_count`, or if there are more than `u32::MAX / 3` faces.
    pub(crate) fn new(vertex_count: usize, faces: &[[u32; 3]]) -> Self {
        u32::try_from(faces.len() * 3).expect("readers refuse meshes with more half-edges than u32 counts");
        let mut starts = vec![0_u32; vertex_count + 1];
        let each = |visit: &mut dyn FnMut(u32, u32, u32)| {
            for (f, &face) in faces.iter().enumerate() {
                if is_degenerate(face) {
                    continue;
                }
                for k in 0..3 {
                    let (a, b) = (face[k], face[(k + 1) % 3]);
                    visit(a.min(b), a.max(b), (3 * f + k) as u32);
                }
            }
        };
        each(&mut |low, _, _| starts[low as usize] += 1);
        let mut total = 0;
        for start in &mut starts {
            total += *start;
            *start = total;
        }
        // Filling each group from its end leaves `starts` at the beginnings.
        let mut entries = vec![(0, 0); total as usize];
        each(&mut |low, high, half_edge| {
            let at = &mut starts[low as usize];
            *at -= 1;
            entries[*at as usize] = (high, half_edge);
        });
        for pair in starts.windows(2) {
            entries[pair[0] as usize..pair[1] as usize].sort_unstable();
        }
        Self { entries, starts }
    }

    /// All edges, ascending by lower, then by higher vertex.
    pub(crate) fn edges(&self) -> impl Iterator<Item = Edge<'_>> + '_ {
        self.starts.windows(2).enumerate().flat_map(move |(low, pair)| {
            let end = pair[1] as usize;
            let mut at = pair[0] as usize;
            std::iter::from_fn(move || {
                let high = self.entries[at..end].first()?.0;
                let start = at;
                while at < end && self.entries[at].0 == high {
                    at += 1;
                }
                Some(Edge { low: low as u32, high, entries: &self.entries[start..at], range: start..at })
            })
        })
    }

    /// The half-edges of the edge with this [`Edge::range`].
    pub(crate) fn half_edges(&self, range: Range<usize>) -> impl Iterator<Item = u32> + '_ {
        self.entries[range].iter().map(|&(_, half_edge)| half_edge)
    }
}

/// Disjoint sets over `0..len`. The lowest member stands for its set, so results do not depend on the order of joins.
pub(crate) struct DisjointSets {
    parents: Vec<u32>,
}

impl DisjointSets {
    pub(crate) fn new(len: usize) -> Self {
        Self { parents: (0..u32::try_from(len).expect("indices are u32")).collect() }
    }

    /// The lowest member of the set that holds `item`. Amortised O(log n).
    #[inline]
    pub(crate) fn find(&mut self, mut item: u32) -> u32 {
        loop {
            let parent = self.parents[item as usize];
            if parent == item {
                return item;
            }
            let grandparent = self.parents[parent as usize];
            self.parents[item as usize] = grandparent;
            item = grandparent;
        }
    }

    #[inline]
    pub(crate) fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.find(a), self.find(b));
        let (low, high) = (a.min(b), a.max(b));
        self.parents[high as usize] = low;
    }
}

/// Faces that repeat an earlier one: same corners in the same cyclic order. Ascending; O(n log n).
pub(crate) fn duplicate_faces(faces: &[[u32; 3]]) -> Vec<u32> {
    let mut keys: Vec<([u32; 3], u32)> = faces.iter().zip(0..).map(|(&face, f)| (lowest_first(face), f)).collect();
    keys.sort_unstable();
    let mut duplicates: Vec<u32> =
        keys.windows(2).filter(|pair| pair[0].0 == pair[1].0).map(|pair| pair[1].1).collect();
    duplicates.sort_unstable();
    duplicates
}

/// Turns a face until its lowest corner comes first.
fn lowest_first([a, b, c]: [u32; 3]) -> [u32; 3] {
    [a, b, c].min([b, c, a]).min([c, a, b])
}
