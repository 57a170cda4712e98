//! Cuts what is not manifold. It is rare and local: the vertices where something is wrong are collected with all their faces,
//! and [`clean`](crate::ingest::clean) resolves this small mesh as it would resolve the whole.

use super::faces::Ranges;
use super::survey::Trouble;
use super::{bits::Bits, scan::plain};
use crate::ingest::chunks::{height_of, place};
use crate::ingest::clean::manifold::{Resolved, resolve_some};
use crate::ingest::hierarchy::NONE;
use crate::mesh::TriMesh;
use crate::mesh::edges::{EdgeTable, origin};

/// What became of the troubled vertices.
#[derive(Debug, Default)]
pub(super) struct Cuts {
    pub(super) counts: Resolved,
    /// Vertices with copies, ascending, and how many copies all up to and including this one have.
    copied: Vec<(u32, u32)>,
    /// Faces that have a copy as a corner: the corners before, and which copy each is now, 0 for the vertex itself; sorted.
    changed: Vec<([u32; 3], [u32; 3])>,
    /// Troubled vertices and their copies, as vertex and copy, with their places (see [`place`]); sorted.
    pub(super) places: Vec<(u32, u32, u8)>,
    /// Edges with a single face and a troubled end, in the new numbering.
    pub(super) boundary: Vec<[u32; 2]>,
}

impl Cuts {
    pub(super) fn is_troubled(&self, vertex: u32) -> bool {
        self.places.binary_search_by_key(&(vertex, 0), |&(v, copy, _)| (v, copy)).is_ok()
    }

    pub(super) fn has_copies(&self) -> bool {
        !self.copied.is_empty()
    }

    pub(super) fn copies(&self) -> u32 {
        self.copied.last().map_or(0, |last| last.1)
    }

    /// New number of a vertex: copies follow what they are copies of.
    pub(super) fn number(&self, vertex: u32) -> u32 {
        let before = self.copied.partition_point(|&(v, _)| v < vertex);
        vertex + before.checked_sub(1).map_or(0, |last| self.copied[last].1)
    }

    /// Number of copies of a vertex.
    pub(super) fn copies_of(&self, vertex: u32) -> u32 {
        match self.copied.binary_search_by_key(&vertex, |&(v, _)| v) {
            Ok(at) => self.copied[at].1 - at.checked_sub(1).map_or(0, |before| self.copied[before].1),
            Err(_) => 0,
        }
    }

    /// A face in the new numbering.
    pub(super) fn renumbered(&self, face: [u32; 3]) -> [u32; 3] {
        let copies = match self.changed.binary_search_by_key(&face, |&(face, _)| face) {
            Ok(at) => self.changed[at].1,
            Err(_) => [0; 3],
        };
        std::array::from_fn(|k| self.number(face[k]) + copies[k])
    }
}

/// Resolves what the chunks found. `numbers` gives the vertex of each vertex of the input. Memory in proportion to `trouble`.
pub(super) fn cut(mut trouble: Trouble, numbers: &[u32], ranges: &Ranges) -> Cuts {
    trouble.dedup();
    let Trouble { vertices: mut troubled, faces, positions } = trouble;
    if troubled.is_empty() {
        return Cuts::default();
    }
    troubled.sort_unstable();

    // Ties are broken by the order of the input, so the small mesh has to keep it.
    let place_of = |v: u32| positions.binary_search_by_key(&v, |&(v, _)| v).expect("a vertex of the faces");
    let order = in_input_order(&positions, numbers);
    let mut small_of = vec![0u32; positions.len()];
    (0..).zip(&order).for_each(|(k, &at)| small_of[at as usize] = k);
    let mut mesh = TriMesh {
        positions: order.iter().map(|&at| plain(positions[at as usize].1)).collect(),
        faces: faces.iter().map(|face| face.corners.map(|v| small_of[place_of(v)])).collect(),
        colors: None,
    };
    let number = |small: u32| positions[order[small as usize] as usize].0;
    let is_troubled: Vec<bool> = (0..order.len() as u32).map(|v| troubled.binary_search(&number(v)).is_ok()).collect();
    let before = mesh.faces.clone();
    let edges = EdgeTable::new(mesh.positions.len(), &mesh.faces);
    let counts = resolve_some(&mut mesh, &edges, Some(&is_troubled));
    drop(edges);

    // Vertex and copy of each vertex of the small mesh.
    let mut origins: Vec<(u32, u32)> = (0..order.len() as u32).map(|v| (number(v), 0)).collect();
    origins.resize(mesh.positions.len(), (NONE, 0));
    let corners = before.as_flattened().iter().zip(mesh.faces.as_flattened());
    corners.clone().for_each(|(&old, &new)| origins[new as usize].0 = number(old));
    let mut copies: Vec<u32> = (order.len() as u32..mesh.positions.len() as u32).collect();
    copies.sort_by_key(|&copy| origins[copy as usize].0);
    let mut copied: Vec<(u32, u32)> = Vec::new();
    for (so_far, &copy) in (1..).zip(&copies) {
        let vertex = origins[copy as usize].0;
        match copied.last_mut().filter(|last| last.0 == vertex) {
            Some(last) => last.1 = so_far,
            None => copied.push((vertex, so_far)),
        }
        let earlier = copied.len().checked_sub(2).map_or(0, |k| copied[k].1);
        origins[copy as usize].1 = so_far - earlier;
    }
    let mut changed: Vec<([u32; 3], [u32; 3])> = faces
        .iter()
        .zip(&mesh.faces)
        .map(|(face, new)| (face.corners, new.map(|v| origins[v as usize].1)))
        .filter(|(_, copies)| *copies != [0; 3])
        .collect();
    changed.sort_unstable();

    let mut cuts = Cuts { counts, copied, changed, ..Cuts::default() };
    let is_whole = |v: u32| is_troubled.get(v as usize).copied().unwrap_or(true);
    let mut is_boundary = vec![false; mesh.positions.len()];
    for edge in EdgeTable::new(mesh.positions.len(), &mesh.faces).edges() {
        debug_assert!(
            edge.len() < 2 || origin(&mesh.faces, edge.half_edge(0)) != origin(&mesh.faces, edge.half_edge(1))
        );
        if edge.len() == 1 && (is_whole(edge.low) || is_whole(edge.high)) {
            let ends = [edge.low, edge.high].map(|v| {
                is_boundary[v as usize] = true;
                let (vertex, copy) = origins[v as usize];
                cuts.number(vertex) + copy
            });
            cuts.boundary.push([ends[0].min(ends[1]), ends[0].max(ends[1])]);
        }
    }
    cuts.boundary.sort_unstable();
    let mut chunks: Vec<Option<(u32, u32)>> = vec![None; mesh.positions.len()];
    for (face, new) in faces.iter().zip(&mesh.faces) {
        let owner = ranges.chunk_of(*face.corners.iter().min().expect("three corners"));
        for &v in new {
            let seen = &mut chunks[v as usize];
            *seen = Some(seen.map_or((owner, owner), |(first, last)| (first.min(owner), last.max(owner))));
        }
    }
    for v in (0..mesh.positions.len() as u32).filter(|&v| is_whole(v)) {
        let (vertex, copy) = origins[v as usize];
        let (first, last) = chunks[v as usize].expect("every vertex has a face");
        cuts.places.push((vertex, copy, place(height_of(first, last), is_boundary[v as usize])));
    }
    cuts.places.sort_unstable();
    cuts
}

/// Places in `positions`, which are sorted by vertex, by the first vertex of the input that became each.
fn in_input_order(positions: &[(u32, [f64; 3])], numbers: &[u32]) -> Vec<u32> {
    let end = positions.last().map_or(0, |last| last.0 + 1);
    let [is_wanted, mut is_new] = [(); 2].map(|()| {
        let bits = Bits::new(u64::from(end));
        positions.iter().for_each(|&(v, _)| bits.set(v));
        bits
    });
    let ranks = is_wanted.ranks();
    let first = numbers.iter().filter(|&&number| number < end && is_new.take(number));
    first.map(|&number| is_wanted.rank(&ranks, number)).collect()
}
