//! The vertices of a chunk's faces, numbered from 0: the chunk's own first, then those of other chunks.

use std::ops::Range;

use crate::ingest::spill::{Spill, SpillError};

/// Vertices of other chunks that are this close together are read at once.
const READ_GAP: u32 = 64;

#[derive(Debug)]
pub(super) struct Local {
    own: Range<u32>,
    /// Numbers of the others, ascending.
    others: Vec<u32>,
}

impl Local {
    /// For faces with these corners and a chunk with these vertices. O(n log n) in the corners outside the range.
    pub(super) fn new(own: Range<u32>, corners: impl Iterator<Item = u32>) -> Self {
        let mut others: Vec<u32> = corners.filter(|v| !own.contains(v)).collect();
        others.sort_unstable();
        others.dedup();
        Self { own, others }
    }

    pub(super) fn own_count(&self) -> u32 {
        self.own.end - self.own.start
    }

    pub(super) fn count(&self) -> usize {
        self.own.len() + self.others.len()
    }

    /// Place of a vertex.
    #[inline]
    pub(super) fn place(&self, vertex: u32) -> u32 {
        if self.own.contains(&vertex) {
            return vertex - self.own.start;
        }
        self.own_count() + self.others.binary_search(&vertex).expect("a corner of the faces") as u32
    }

    /// Vertex at a place.
    #[inline]
    pub(super) fn vertex(&self, place: u32) -> u32 {
        if place < self.own_count() { self.own.start + place } else { self.others[(place - self.own_count()) as usize] }
    }

    /// All vertices, by place.
    pub(super) fn vertices(&self) -> impl Iterator<Item = u32> + '_ {
        self.own.clone().chain(self.others.iter().copied())
    }

    /// Positions, by place.
    pub(super) fn read(&self, positions: &Spill<[f64; 3]>) -> Result<Vec<[f64; 3]>, SpillError> {
        let mut out = Vec::with_capacity(self.count());
        positions.append_to(u64::from(self.own.start)..u64::from(self.own.end), &mut out)?;
        let mut part = Vec::new();
        for group in self.others.chunk_by(|a, b| b - a <= READ_GAP) {
            let first = group[0];
            let end = group[group.len() - 1] + 1;
            positions.read_into(u64::from(first)..u64::from(end), &mut part)?;
            out.extend(group.iter().map(|v| part[(v - first) as usize]));
        }
        Ok(out)
    }
}
