//! Deals the faces out to chunks: ranges of vertex numbers, each with the faces whose smallest corner lies in it.
//!
//! A chunk is given all faces of its vertices, also those that another chunk owns, because what is wrong with a vertex or an
//! edge only shows in all faces there.

use std::sync::atomic::{AtomicU32, Ordering};

use bytemuck::{AnyBitPattern, NoUninit, Pod, Zeroable};

use super::bits::Bits;
use super::runs::{Runs, blocks_in_order};
use super::sort::Sorted;
use crate::ingest::hierarchy::NONE;
use crate::ingest::spill::{Spill, SpillError, Workspace};

/// Share of the most faces of a chunk that is aimed at: room for the last vertex to overshoot.
const FILL: f64 = 15.0 / 16.0;

/// A face on its way into a chunk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Face {
    /// Vertex numbers, in the order of the input.
    pub(super) corners: [u32; 3],
    /// Place in the input.
    pub(super) index: u32,
}

/// The vertices of each chunk.
#[derive(Debug)]
pub(super) struct Ranges {
    /// First vertex of each chunk, and the number of vertices at the end.
    starts: Vec<u32>,
}

impl Ranges {
    pub(super) fn count(&self) -> usize {
        self.starts.len() - 1
    }

    pub(super) fn range(&self, chunk: usize) -> std::ops::Range<u32> {
        self.starts[chunk]..self.starts[chunk + 1]
    }

    /// Chunk of a vertex.
    pub(super) fn chunk_of(&self, vertex: u32) -> u32 {
        self.starts.partition_point(|&start| start <= vertex) as u32 - 1
    }

    /// The same with vertices numbered anew, in the same order.
    pub(super) fn renumbered(&self, number: impl Fn(u32) -> u32) -> Self {
        Self { starts: self.starts.iter().map(|&v| number(v)).collect() }
    }
}

/// How many faces each vertex is the smallest corner of, and what was dropped.
#[derive(Debug)]
pub(super) struct Census {
    owned: Vec<AtomicU32>,
    pub(super) faces: u64,
    pub(super) degenerate_faces: u64,
    /// Vertices of faces with three different corners.
    referenced: Bits,
    pub(super) vertices: u64,
}

enum Kind {
    Unusable,
    Degenerate,
    Proper([u32; 3]),
}

#[inline]
fn kind(face: [u32; 3], numbers: &[u32]) -> Kind {
    let [a, b, c] = face.map(|v| numbers.get(v as usize).copied().unwrap_or(NONE));
    if a == NONE || b == NONE || c == NONE {
        Kind::Unusable
    } else if a == b || b == c || c == a {
        Kind::Degenerate
    } else {
        Kind::Proper([a, b, c])
    }
}

/// Counts faces by vertex. 4 bytes for each vertex.
pub(super) fn census(faces: &Spill<[u32; 3]>, sorted: &Sorted) -> Result<Census, SpillError> {
    let vertex_count = sorted.positions.len();
    let owned: Vec<AtomicU32> = (0..vertex_count).map(|_| AtomicU32::new(0)).collect();
    let referenced = Bits::new(vertex_count);
    let (mut proper, mut degenerate) = (0, 0);
    blocks_in_order(
        faces.len(),
        |range| {
            let (mut proper, mut degenerate) = (0u64, 0u64);
            for face in faces.read(range)? {
                match kind(face, &sorted.numbers) {
                    Kind::Unusable => {}
                    Kind::Degenerate => degenerate += 1,
                    Kind::Proper(corners) => {
                        proper += 1;
                        corners.iter().for_each(|&v| referenced.set(v));
                        let low = corners[0].min(corners[1]).min(corners[2]);
                        owned[low as usize].fetch_add(1, Ordering::Relaxed);
                    }
                }
            }
            Ok((proper, degenerate))
        },
        |counts| {
            proper += counts.0;
            degenerate += counts.1;
            Ok(())
        },
    )?;
    let vertices = referenced.count();
    Ok(Census { owned, faces: proper, degenerate_faces: degenerate, referenced, vertices })
}

/// Leaves out the vertices that only degenerate faces use.
pub(super) fn compact(sorted: Sorted, census: &mut Census, workspace: &Workspace) -> Result<Sorted, SpillError> {
    if census.vertices == sorted.positions.len() {
        return Ok(sorted);
    }
    let kept = &census.referenced;
    let positions = keep(&sorted.positions, kept, workspace)?;
    let colors = sorted.colors.map(|colors| keep(&colors, kept, workspace)).transpose()?;
    let ranks = kept.ranks();
    let mut numbers = sorted.numbers;
    for number in numbers.iter_mut().filter(|number| **number != NONE) {
        // Only degenerate faces name what is not kept, and they have been counted.
        *number = if kept.get(*number) { kept.rank(&ranks, *number) } else { NONE };
    }
    let mut v = 0;
    census.owned.retain(|_| {
        v += 1;
        kept.get(v - 1)
    });
    Ok(Sorted { positions, colors, numbers })
}

/// The items of the vertices that are kept.
pub(super) fn keep<T: NoUninit + AnyBitPattern>(
    items: &Spill<T>,
    kept: &Bits,
    workspace: &Workspace,
) -> Result<Spill<T>, SpillError> {
    let mut out = workspace.spill();
    let mut result = Ok(());
    let mut part = Vec::new();
    items.for_each_block(|first, block| {
        part.clear();
        part.extend((first as u32..).zip(block).filter(|(v, _)| kept.get(*v)).map(|(_, item)| *item));
        if result.is_ok() {
            result = out.push(&part);
        }
    })?;
    result?;
    out.finish()
}

impl Census {
    /// Cuts the vertices into ranges with about the same number of faces each, at most `most` unless a single vertex has more.
    /// No range is without a face.
    pub(super) fn ranges(&self, most: usize) -> Ranges {
        let goal = ((most as f64 * FILL) as u64).max(1);
        let count = self.faces.div_ceil(goal).max(1);
        let mut starts = vec![0];
        let (mut before, mut here) = (0, 0);
        for (v, owned) in (0..).zip(&self.owned) {
            let owned = u64::from(owned.load(Ordering::Relaxed));
            if owned == 0 {
                continue;
            }
            let target = self.faces * (starts.len() as u64) / count;
            if here > 0 && (before + here >= target || here + owned > most as u64) {
                starts.push(v);
                before += here;
                here = 0;
            }
            here += owned;
        }
        starts.push(self.owned.len() as u32);
        Ranges { starts }
    }
}

/// The faces by chunk, each in all chunks that have one of its corners. 16 bytes of temporary data each.
pub(super) fn deal(
    faces: &Spill<[u32; 3]>,
    numbers: &[u32],
    ranges: &Ranges,
    workspace: &Workspace,
) -> Result<Runs<Face>, SpillError> {
    Runs::build(workspace, faces.len(), ranges.count(), |block, out| {
        let mut chunk = 0;
        let mut range = ranges.range(0);
        for (index, face) in (block.start as u32..).zip(faces.read(block)?) {
            let Kind::Proper(corners) = kind(face, numbers) else { continue };
            let face = Face { corners, index };
            if corners.iter().all(|v| range.contains(v)) {
                out.push((chunk, face));
                continue;
            }
            let [a, b, c] = corners.map(|v| ranges.chunk_of(v));
            out.push((a, face));
            if b != a {
                out.push((b, face));
            }
            if c != a && c != b {
                out.push((c, face));
            }
            chunk = a;
            range = ranges.range(a as usize);
        }
        Ok(())
    })
}
