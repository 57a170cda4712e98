//! Makes every edge have at most two faces, in opposite directions, and every vertex a single fan.
//!
//! Faces never change their place: only vertices are copied. Which faces stay joined is decided half-edge by
//! half-edge, in a [`Pairing`]; the copies follow from it.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::ops::Range;

use glam::DVec3;

use crate::mesh::TriMesh;
use crate::mesh::edges::{DisjointSets, Edge, EdgeTable, next, origin, previous};

#[cfg(test)]
mod tests;

/// What [`resolve`] did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Resolved {
    /// Edges that had more than two faces.
    pub(crate) non_manifold_edges: u64,
    /// Faces that lost their neighbours at such an edge.
    pub(crate) cut_sides: u64,
    /// Edges of two faces that cannot agree on a side, cut.
    pub(crate) one_sided_edges: u64,
    /// Edges whose ends could not tell two sheets apart, joined differently or cut.
    pub(crate) double_edges: u64,
    /// Vertices that had several fans.
    pub(crate) split_vertices: u64,
    /// Copies that they got.
    pub(crate) copies: u64,
}

/// Copies vertices until each directed edge occurs at most once and each vertex has a single fan.
///
/// Around an edge with more than two faces, neighbours in angular order whose directions are opposite stay joined,
/// the flattest first; what is left over is cut. `edges` is the table of `mesh`, whose faces have three different
/// corners each, none the same as another. Copies follow the old vertices in the order of their faces. O(n log n).
pub(super) fn resolve(mesh: &mut TriMesh, edges: &EdgeTable) -> Resolved {
    resolve_some(mesh, edges, None)
}

/// [`resolve`] for a part of a mesh: only vertices for which `is_whole` holds, which must have all their faces here, are
/// copied. If they are all that the whole mesh would have copied, and vertices and faces are in the same order, the result is
/// that of the whole mesh.
pub(crate) fn resolve_some(mesh: &mut TriMesh, edges: &EdgeTable, is_whole: Option<&[bool]>) -> Resolved {
    let mut resolved = Resolved::default();
    let mut pairing = Pairing::new(mesh.faces.len());
    // Edges with two half-edges in one direction: only they can come out of this with a directed edge twice.
    let mut crowded: Vec<Range<usize>> = Vec::new();
    for edge in edges.edges() {
        match edge.len() {
            1 => {}
            2 => {
                let (a, b) = (edge.half_edge(0), edge.half_edge(1));
                if origin(&mesh.faces, a) == origin(&mesh.faces, b) {
                    resolved.one_sided_edges += 1;
                    crowded.push(edge.range());
                } else {
                    pairing.join(a, b);
                }
            }
            count => {
                resolved.non_manifold_edges += 1;
                resolved.cut_sides += count as u64 - 2 * join_sheets(mesh, &edge, &mut pairing);
                crowded.push(edge.range());
            }
        }
    }
    let mut fans = Fans::new(mesh, &pairing, is_whole);
    let separated = separate_double_edges(edges, &crowded, &fans, &mut pairing);
    resolved.double_edges = separated.len() as u64;
    if resolved.double_edges > 0 {
        fans = Fans::new(mesh, &pairing, is_whole);
        if rejoin(mesh, &separated, &fans, &mut pairing) > 0 {
            fans = Fans::new(mesh, &pairing, is_whole);
        }
    }
    resolved.copies = fans.copied.len() as u64;
    resolved.split_vertices = {
        let mut copied = fans.copied.clone();
        copied.sort_unstable();
        copied.dedup();
        copied.len() as u64
    };
    if resolved.copies > 0 {
        fans.apply(mesh);
    }
    resolved
}

/// Which half-edges stay joined. An involution: a half-edge at a boundary or a cut is its own partner.
struct Pairing(Vec<u32>);

impl Pairing {
    fn new(face_count: usize) -> Self {
        Self((0..face_count as u32 * 3).collect())
    }

    #[inline]
    fn partner(&self, half_edge: u32) -> Option<u32> {
        let partner = self.0[half_edge as usize];
        (partner != half_edge).then_some(partner)
    }

    fn join(&mut self, a: u32, b: u32) {
        self.0[a as usize] = b;
        self.0[b as usize] = a;
    }

    /// The corner clockwise of `corner` at its vertex: the one after its half-edge's partner.
    #[inline]
    fn clockwise(&self, corner: u32) -> Option<u32> {
        self.partner(corner).map(next)
    }

    /// The corner counter-clockwise of `corner` at its vertex: the partner of the half-edge that runs into it.
    #[inline]
    fn counter_clockwise(&self, corner: u32) -> Option<u32> {
        self.partner(previous(corner))
    }

    fn cut(&mut self, half_edge: u32) {
        let partner = self.0[half_edge as usize];
        self.0[partner as usize] = partner;
        self.0[half_edge as usize] = half_edge;
    }
}

/// One face at an edge, seen along it.
struct Wing {
    half_edge: u32,
    /// Runs from the lower to the higher vertex.
    is_forward: bool,
    /// Direction of its third corner, perpendicular to the edge, in the plane's two axes; of length 1, or 0.
    direction: [f64; 2],
}

/// Joins the half-edges of one edge in pairs and returns how many pairs there are.
///
/// Taking neighbours of opposite direction out of the circle until none are left always leaves half-edges of one
/// direction only, and no two sheets cross. O(n log n) in the faces of the edge.
fn join_sheets(mesh: &TriMesh, edge: &Edge<'_>, pairing: &mut Pairing) -> u64 {
    let wings = sorted_wings(mesh, edge);
    let count = wings.len();
    let mut after: Vec<usize> = (0..count).map(|k| (k + 1) % count).collect();
    let mut before: Vec<usize> = (0..count).map(|k| (k + count - 1) % count).collect();
    let mut is_joined = vec![false; count];
    let mut candidates = BinaryHeap::new();
    let offer = |candidates: &mut BinaryHeap<_>, a: usize, b: usize| {
        let (wing, other) = (&wings[a], &wings[b]);
        if wing.is_forward != other.is_forward {
            let [x, y] = wing.direction;
            // -1 is flat, 1 is folded. Coarse, so that rounding does not decide between equal angles.
            let fold = ((x * other.direction[0] + y * other.direction[1]) * 4096.0).round() as i32;
            // A forward face looks towards growing angles: from backward to forward lies the inside of a solid.
            let is_outside = wing.is_forward;
            candidates.push(Reverse((fold, is_outside, wing.half_edge, other.half_edge, a, b)));
        }
    };
    for (k, &other) in after.iter().enumerate() {
        offer(&mut candidates, k, other);
    }
    let mut pairs = 0;
    while let Some(Reverse((.., a, b))) = candidates.pop() {
        if is_joined[a] || is_joined[b] || after[a] != b {
            continue;
        }
        pairing.join(wings[a].half_edge, wings[b].half_edge);
        pairs += 1;
        (is_joined[a], is_joined[b]) = (true, true);
        let (left, right) = (before[a], after[b]);
        if left == b {
            break;
        }
        (after[left], before[right]) = (right, left);
        if left != right {
            offer(&mut candidates, left, right);
        }
    }
    pairs
}

/// The faces of an edge in angular order, counter-clockwise around the direction from its lower to its higher vertex.
fn sorted_wings(mesh: &TriMesh, edge: &Edge<'_>) -> Vec<Wing> {
    let at = |v: u32| DVec3::from(mesh.positions[v as usize]);
    let start = at(edge.low);
    let axis = (at(edge.high) - start).normalize_or_zero();
    let outward = |half_edge: u32| {
        let apex = at(origin(&mesh.faces, previous(half_edge))) - start;
        (apex - axis * axis.dot(apex)).normalize_or_zero()
    };
    let x_axis = edge.half_edges().map(outward).find(|d| *d != DVec3::ZERO).unwrap_or(DVec3::ZERO);
    let y_axis = axis.cross(x_axis);
    let mut wings: Vec<(f64, Wing)> = edge
        .half_edges()
        .map(|half_edge| {
            let direction = outward(half_edge);
            let direction = [direction.dot(x_axis), direction.dot(y_axis)];
            let is_forward = origin(&mesh.faces, half_edge) == edge.low;
            (pseudo_angle(direction), Wing { half_edge, is_forward, direction })
        })
        .collect();
    wings.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.half_edge.cmp(&b.1.half_edge)));
    wings.into_iter().map(|(_, wing)| wing).collect()
}

/// Grows with the angle of `[x, y]`, from 0 to 4 for a full turn; 0 for the zero vector.
fn pseudo_angle([x, y]: [f64; 2]) -> f64 {
    let sum = x.abs() + y.abs();
    if sum == 0.0 {
        return 0.0;
    }
    if y >= 0.0 { 1.0 - x / sum } else { 3.0 + x / sum }
}

/// The vertex of every corner, one for each fan.
struct Fans {
    /// `len == 3 * faces.len()`.
    corners: Vec<u32>,
    /// Old vertex of each new one. The lowest corner's fan keeps the old vertex.
    copied: Vec<u32>,
}

impl Fans {
    /// Walks around every vertex, from corner to corner across paired half-edges. Linear. A vertex that is not whole keeps all
    /// its corners.
    fn new(mesh: &TriMesh, pairing: &Pairing, is_whole: Option<&[bool]>) -> Self {
        let corner_count = mesh.faces.len() as u32 * 3;
        let mut is_visited = vec![false; corner_count as usize];
        let mut has_fan = vec![false; mesh.positions.len()];
        let mut fans = Self { corners: vec![0; corner_count as usize], copied: Vec::new() };
        for corner in 0..corner_count {
            if is_visited[corner as usize] {
                continue;
            }
            let mut first = corner;
            while let Some(other) = pairing.clockwise(first).filter(|&other| other != corner) {
                first = other;
            }
            let old = origin(&mesh.faces, corner);
            let may_copy = is_whole.is_none_or(|is_whole| is_whole[old as usize]);
            let vertex = if has_fan[old as usize] && may_copy {
                fans.copied.push(old);
                let copy = mesh.positions.len() + fans.copied.len() - 1;
                u32::try_from(copy).expect("no more vertices than corners, which u32 counts")
            } else {
                has_fan[old as usize] = true;
                old
            };
            let mut at = Some(first);
            while let Some(corner) = at.filter(|&corner| !is_visited[corner as usize]) {
                is_visited[corner as usize] = true;
                fans.corners[corner as usize] = vertex;
                at = pairing.counter_clockwise(corner);
            }
        }
        fans
    }

    fn ends(&self, half_edge: u32) -> (u32, u32) {
        (self.corners[half_edge as usize], self.corners[next(half_edge) as usize])
    }

    fn apply(self, mesh: &mut TriMesh) {
        for (corner, vertex) in mesh.faces.as_flattened_mut().iter_mut().zip(&self.corners) {
            *corner = *vertex;
        }
        mesh.positions.extend(self.copied.iter().map(|&v| mesh.positions[v as usize]).collect::<Vec<_>>());
        if let Some(colors) = &mut mesh.colors {
            colors.extend(self.copied.iter().map(|&v| colors[v as usize]).collect::<Vec<_>>());
        }
    }
}

/// Cuts all pairs between two copies that some directed edge joins twice. Returns their half-edges, edge by edge.
///
/// One round is enough. Walk around copy `a`: all pairs across the edge to `b` are passed in one direction, so once
/// they are cut, a fan meets at most one half-edge `a -> b`, at its first face, and at most one `b -> a`, at its last.
/// A half-edge that was never paired stood at such an end already. So each fan of `a` has each direction at most once,
/// and fans that become smaller cannot break other edges. What then is left at one edge in both directions is joined
/// by its index: that swaps the sheets instead of cutting them.
fn separate_double_edges(
    edges: &EdgeTable,
    crowded: &[Range<usize>],
    fans: &Fans,
    pairing: &mut Pairing,
) -> Vec<Vec<u32>> {
    let mut separated = Vec::new();
    let mut half_edges: Vec<((u32, u32), bool, u32)> = Vec::new();
    for range in crowded {
        half_edges.clear();
        half_edges.extend(edges.half_edges(range.clone()).map(|half_edge| {
            let (a, b) = fans.ends(half_edge);
            ((a.min(b), a.max(b)), a < b, half_edge)
        }));
        half_edges.sort_unstable();
        for group in half_edges.chunk_by(|a, b| a.0 == b.0) {
            if group.windows(2).any(|pair| pair[0].1 == pair[1].1) {
                group.iter().for_each(|&(.., half_edge)| pairing.cut(half_edge));
                separated.push(group.iter().map(|&(.., half_edge)| half_edge).collect());
            }
        }
    }
    separated
}

/// Joins half-edges that separation left without a partner, where their fans have room for each other. Returns how
/// many pairs there are.
///
/// It is what becomes of the two faces of a sheet from whose edge a flap came off.
fn rejoin(mesh: &TriMesh, separated: &[Vec<u32>], fans: &Fans, pairing: &mut Pairing) -> u64 {
    /// More half-edges at one edge than scans ever have: trying all pairs would be quadratic.
    const MOST_AT_EDGE: usize = 16;
    let mut vertices = DisjointSets::new(mesh.positions.len() + fans.copied.len());
    let mut pairs = 0;
    for group in separated.iter().filter(|group| group.len() <= MOST_AT_EDGE) {
        let low = origin(&mesh.faces, group[0]);
        let (forward, backward): (Vec<u32>, Vec<u32>) =
            group.iter().partition(|&&half_edge| origin(&mesh.faces, half_edge) == low);
        for &a in &forward {
            for &b in &backward {
                if pairing.partner(a).is_none()
                    && pairing.partner(b).is_none()
                    && have_room(a, b, fans, pairing, &mut vertices)
                {
                    pairing.join(a, b);
                    pairs += 1;
                    let ((start, end), (other_end, other_start)) = (fans.ends(a), fans.ends(b));
                    vertices.join(start, other_start);
                    vertices.join(end, other_end);
                }
            }
        }
    }
    pairs
}

/// Whether each directed edge still occurs at most once when `a` and `b`, of opposite directions, are joined and the
/// copies at their ends become one.
fn have_room(a: u32, b: u32, fans: &Fans, pairing: &Pairing, vertices: &mut DisjointSets) -> bool {
    /// Fans that are larger stay apart, or joining them one by one would be quadratic.
    const MOST_CORNERS: usize = 64;
    let ((start, end), (other_end, other_start)) = (fans.ends(a), fans.ends(b));
    let joined = [(start, other_start), (end, other_end)].map(|(v, w)| (vertices.find(v), vertices.find(w)));
    let mut name = |v: u32| {
        let v = vertices.find(v);
        joined.iter().find(|pair| pair.1 == v).map_or(v, |pair| pair.0)
    };
    let mut directed: Vec<((u32, u32), u32)> = Vec::new();
    for corner in [a, next(b), next(a), b] {
        let mut count = 0;
        let mut add = |corner: u32| {
            for half_edge in [corner, previous(corner)] {
                let (v, w) = fans.ends(half_edge);
                directed.push(((name(v), name(w)), half_edge));
            }
            count += 1;
            count <= MOST_CORNERS
        };
        let mut at = Some(corner);
        while let Some(here) = at {
            if !add(here) {
                return false;
            }
            at = pairing.counter_clockwise(here).filter(|&other| other != corner);
        }
        let mut at = pairing.clockwise(corner);
        while let Some(here) = at.filter(|&other| other != corner) {
            if !add(here) {
                return false;
            }
            at = pairing.clockwise(here);
        }
    }
    directed.sort_unstable();
    directed.dedup();
    directed.windows(2).all(|pair| pair[0].0 != pair[1].0)
}
