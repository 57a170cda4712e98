//! Looks at every vertex of a chunk and the faces around it: what is on the boundary, what reaches into other chunks, and what
//! is not a single fan of faces that agree on their side.

use glam::DVec3;

use super::faces::Face;
use super::lattice::EdgeLengths;
use super::scan::Extent;
use super::stars::Stars;
use crate::ingest::chunks::{height_of, place};
use crate::ingest::spill::{Spill, SpillError};

/// What one chunk knows.
#[derive(Debug)]
pub(super) struct Survey {
    /// The faces that the chunk owns, by vertex number.
    pub(super) faces: Vec<[u32; 3]>,
    pub(super) duplicates: u64,
    /// See [`place`]; for each vertex of the chunk. Not final at trouble vertices.
    pub(super) places: Vec<u8>,
    /// Edges with a single face whose lower end is in the chunk.
    pub(super) boundary: Vec<[u32; 2]>,
    /// Whether the two faces of some edge disagree.
    pub(super) is_mixed: bool,
    pub(super) trouble: Trouble,
    /// Of the edges of the faces that the chunk owns.
    pub(super) lengths: EdgeLengths,
    /// Of the vertices of the chunk.
    pub(super) extent: Extent,
}

/// Vertices that cannot stay as they are, with all their faces.
#[derive(Debug, Default)]
pub(super) struct Trouble {
    /// Ends of edges that two faces run along in one direction, and vertices with several fans.
    pub(super) vertices: Vec<u32>,
    /// All faces of these.
    pub(super) faces: Vec<Face>,
    /// Vertices of the faces and where they are, each at least once.
    pub(super) positions: Vec<(u32, [f64; 3])>,
}

impl Trouble {
    pub(super) fn extend(&mut self, other: Self) {
        self.vertices.extend(other.vertices);
        self.faces.extend(other.faces);
        self.positions.extend(other.positions);
    }

    /// Each face and position once.
    pub(super) fn dedup(&mut self) {
        self.faces.sort_unstable_by_key(|face| face.index);
        self.faces.dedup_by_key(|face| face.index);
        self.positions.sort_unstable_by_key(|&(v, _)| v);
        self.positions.dedup_by_key(|&mut (v, _)| v);
    }
}

/// What a vertex's walk around its faces found.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Fan {
    Closed,
    Open,
    Trouble,
}

/// For each place, the face around the current vertex that starts and that ends there: stamped by vertex, never cleared.
#[derive(Clone, Copy, Default)]
struct Spoke {
    out_stamp: u32,
    in_stamp: u32,
    next: u32,
}

/// Surveys a chunk. O(corners).
pub(super) fn survey(
    stars: &Stars,
    chunk: u32,
    positions: &Spill<[f64; 3]>,
    with_lengths: bool,
) -> Result<Survey, SpillError> {
    let positions = stars.local.read(positions)?;
    let mut extent = Extent::NOTHING;
    positions[..stars.own_vertices().len()].iter().for_each(|&p| extent.add(p));
    let mut lengths = EdgeLengths::default();
    if with_lengths {
        lengths.add_faces(&stars.faces[..stars.owned], &positions);
    }

    let mut places = Vec::with_capacity(stars.own_vertices().len());
    let mut boundary = Vec::new();
    let mut is_mixed = false;
    let mut trouble = Trouble::default();
    let mut spokes = vec![Spoke::default(); stars.local.count()];
    let mut edges = Vec::new();
    for v in stars.own_vertices() {
        let fan = fan(stars, v, &mut spokes);
        let corners = stars.corners_at(v);
        let (mut first, mut last) = (chunk, chunk);
        // Faces are in the order of their owners but for the chunk's own, which come first.
        if let Some(corner) = corners.last().filter(|corner| **corner as usize >= 3 * stars.owned) {
            let owner = |corner: u32| stars.owner(corner / 3, chunk);
            let foreign = corners.iter().map(|&c| owner(c));
            (first, last) = foreign.fold((owner(*corner), owner(*corner)), |(a, b), o| (a.min(o), b.max(o)));
        }
        places.push(place(height_of(first, last), fan != Fan::Closed));
        if fan == Fan::Closed {
            continue;
        }
        stars.edges_at(v, &mut edges);
        let here = stars.local.vertex(v);
        for edge in edges.chunk_by(|a, b| a.0 == b.0) {
            let there = stars.local.vertex(edge[0].0);
            if edge.len() == 1 && here < there {
                boundary.push([here, there]);
            }
            is_mixed |= edge.len() == 2 && edge[0].1 == edge[1].1;
        }
        if fan == Fan::Trouble {
            trouble.vertices.push(here);
            for &corner in corners {
                let face = corner / 3;
                trouble.faces.push(Face { corners: stars.global(face), index: stars.indices[face as usize] });
                let places = stars.faces[face as usize];
                trouble.positions.extend(places.map(|p| (stars.local.vertex(p), positions[p as usize])));
            }
        }
    }
    trouble.dedup();
    Ok(Survey {
        faces: (0..stars.owned as u32).map(|face| stars.global(face)).collect(),
        duplicates: stars.duplicates,
        places,
        boundary,
        is_mixed,
        trouble,
        lengths,
        extent,
    })
}

/// Whether the faces of a vertex are one fan.
fn fan(stars: &Stars, v: u32, spokes: &mut [Spoke]) -> Fan {
    let stamp = v + 1;
    let corners = stars.corners_at(v);
    for &corner in corners {
        let (next, previous) = stars.around(corner);
        let start = &mut spokes[next as usize];
        if start.out_stamp == stamp {
            return Fan::Trouble;
        }
        (start.out_stamp, start.next) = (stamp, previous);
        let end = &mut spokes[previous as usize];
        if end.in_stamp == stamp {
            return Fan::Trouble;
        }
        end.in_stamp = stamp;
    }
    // Every neighbour now starts at most one face and ends at most one: the faces are chains and rings.
    let mut begin = None;
    for &corner in corners {
        let (next, _) = stars.around(corner);
        if spokes[next as usize].in_stamp != stamp {
            if begin.is_some() {
                return Fan::Trouble;
            }
            begin = Some(next);
        }
    }
    let first = begin.unwrap_or(stars.around(corners[0]).0);
    let (mut at, mut count) = (first, 0);
    while spokes[at as usize].out_stamp == stamp {
        at = spokes[at as usize].next;
        count += 1;
        if at == first {
            break;
        }
    }
    match begin {
        _ if count < corners.len() => Fan::Trouble,
        Some(_) => Fan::Open,
        None => Fan::Closed,
    }
}

/// Positions as vectors.
pub(super) fn at(position: [f64; 3]) -> DVec3 {
    DVec3::from_array(position)
}
