//! The faces of one chunk in memory, grouped by vertex: its own and those of other chunks that have one of its vertices.

use std::ops::Range;

use super::bits::Bits;
use super::faces::{Face, Ranges};
use super::local::Local;
use super::runs::Runs;
use crate::ingest::spill::SpillError;

/// Groups of faces with the same smallest corner that are searched for duplicates pair by pair.
const SMALL_GROUP: usize = 12;

/// All faces of the vertices of one chunk, without duplicates.
pub(super) struct Stars {
    pub(super) local: Local,
    /// Corners by place. Those that the chunk owns come first; by smallest corner, then in the order of the input.
    pub(super) faces: Vec<[u32; 3]>,
    /// Place of each face in the input.
    pub(super) indices: Vec<u32>,
    /// How many of the faces the chunk owns.
    pub(super) owned: usize,
    /// Duplicates dropped among those that the chunk owns.
    pub(super) duplicates: u64,
    /// Chunk that owns each face that this one does not own.
    owners: Vec<u32>,
    /// Corners, `3 * face + corner`, of each of the chunk's own vertices.
    corners: Vec<u32>,
    /// Where they start.
    starts: Vec<u32>,
}

impl Stars {
    /// Reads a chunk. Faces in `turned`, given by their places in the input, are turned round. O(faces); some 60 bytes each.
    pub(super) fn read(
        dealt: &Runs<Face>,
        ranges: &Ranges,
        chunk: usize,
        turned: Option<&Bits>,
    ) -> Result<Self, SpillError> {
        let records = dealt.read(chunk)?;
        let own = ranges.range(chunk);
        let local = Local::new(own.clone(), records.iter().flat_map(|face| face.corners));
        let own_count = local.own_count();

        // By smallest corner. Its place is not the smallest place: vertices of earlier chunks come after the chunk's own.
        let mut keyed: Vec<(u32, [u32; 3], u32)> = Vec::with_capacity(records.len());
        let mut ends = vec![0u32; local.count() + 1];
        for face in &records {
            let low = face.corners.iter().min().expect("three corners");
            let key = local.place(*low);
            ends[key as usize + 1] += 1;
            keyed.push((key, face.corners.map(|v| local.place(v)), face.index));
        }
        drop(records);
        for k in 1..ends.len() {
            ends[k] += ends[k - 1];
        }
        let mut order = vec![0u32; keyed.len()];
        for (k, face) in (0..).zip(&keyed) {
            let at = &mut ends[face.0 as usize];
            order[*at as usize] = k;
            *at += 1;
        }

        let mut faces = Vec::with_capacity(keyed.len());
        let mut indices = Vec::with_capacity(keyed.len());
        let mut owners = Vec::new();
        let (mut owned, mut duplicates) = (0, 0);
        let mut is_duplicate = Vec::new();
        let mut start = 0;
        for key in 0..local.count() as u32 {
            let end = ends[key as usize] as usize;
            let group = &order[start..end];
            start = end;
            find_duplicates(group.iter().map(|&k| (key, keyed[k as usize].1)), &mut is_duplicate);
            for (&k, _) in group.iter().zip(&is_duplicate).filter(|(_, is_duplicate)| !**is_duplicate) {
                let (_, mut corners, index) = keyed[k as usize];
                if turned.is_some_and(|turned| turned.get(index)) {
                    corners.swap(1, 2);
                }
                faces.push(corners);
                indices.push(index);
            }
            if key < own_count {
                owned = faces.len();
                duplicates += is_duplicate.iter().filter(|is_duplicate| **is_duplicate).count() as u64;
            } else if !group.is_empty() {
                owners.resize(faces.len() - owned, ranges.chunk_of(local.vertex(key)));
            }
        }
        drop((keyed, order));

        let mut starts = vec![0u32; own_count as usize + 1];
        for &place in faces.as_flattened().iter().filter(|place| **place < own_count) {
            starts[place as usize] += 1;
        }
        let mut total = 0;
        for start in &mut starts {
            total += *start;
            *start = total;
        }
        let mut corners = vec![0; total as usize];
        // From the last face on, filling from the end leaves `starts` at the beginnings and the corners in order.
        for corner in (0..3 * faces.len() as u32).rev() {
            let place = faces.as_flattened()[corner as usize];
            if place < own_count {
                let at = &mut starts[place as usize];
                *at -= 1;
                corners[*at as usize] = corner;
            }
        }
        Ok(Self { local, faces, indices, owned, duplicates, owners, corners, starts })
    }

    /// Corners of one of the chunk's own vertices, by face.
    #[inline]
    pub(super) fn corners_at(&self, place: u32) -> &[u32] {
        &self.corners[self.starts[place as usize] as usize..self.starts[place as usize + 1] as usize]
    }

    /// Places of the next and the previous corner in the face.
    #[inline]
    pub(super) fn around(&self, corner: u32) -> (u32, u32) {
        let face = self.faces[corner as usize / 3];
        match corner % 3 {
            0 => (face[1], face[2]),
            1 => (face[2], face[0]),
            _ => (face[0], face[1]),
        }
    }

    /// Chunk that owns a face; `own` is this one.
    #[inline]
    pub(super) fn owner(&self, face: u32, own: u32) -> u32 {
        if (face as usize) < self.owned { own } else { self.owners[face as usize - self.owned] }
    }

    /// Vertex numbers of a face.
    pub(super) fn global(&self, face: u32) -> [u32; 3] {
        self.faces[face as usize].map(|place| self.local.vertex(place))
    }

    /// The vertices of the chunk, by place and number.
    pub(super) fn own_vertices(&self) -> Range<u32> {
        0..self.local.own_count()
    }

    /// The edges of one of the chunk's own vertices: the other end, whether the face runs away from the vertex, and the face;
    /// sorted.
    pub(super) fn edges_at(&self, place: u32, out: &mut Vec<(u32, bool, u32)>) {
        out.clear();
        for &corner in self.corners_at(place) {
            let (next, previous) = self.around(corner);
            out.push((next, true, corner / 3));
            out.push((previous, false, corner / 3));
        }
        out.sort_unstable();
    }
}

/// Flags the faces, given with the corner that comes first in the cycle, that repeat an earlier one of the group.
fn find_duplicates(group: impl ExactSizeIterator<Item = (u32, [u32; 3])> + Clone, is_duplicate: &mut Vec<bool>) {
    let rest = |(first, [a, b, c]): (u32, [u32; 3])| match first {
        _ if first == a => (b, c),
        _ if first == b => (c, a),
        _ => (a, b),
    };
    is_duplicate.clear();
    if group.len() <= SMALL_GROUP {
        let mut seen = [(0, 0); SMALL_GROUP];
        for (k, face) in group.enumerate() {
            let rest = rest(face);
            is_duplicate.push(seen[..k].contains(&rest));
            seen[k] = rest;
        }
        return;
    }
    let mut sorted: Vec<((u32, u32), usize)> = group.map(rest).zip(0..).collect();
    is_duplicate.resize(sorted.len(), false);
    sorted.sort_unstable();
    for pair in sorted.windows(2).filter(|pair| pair[0].0 == pair[1].0) {
        is_duplicate[pair[1].1] = true;
    }
}
