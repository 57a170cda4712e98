//! Counts what is wrong, or merely remarkable, about the connectivity of a mesh.

use serde::Serialize;

use super::TriMesh;
use super::edges::{DisjointSets, EdgeTable, duplicate_faces, is_degenerate, next, origin};

/// What [`audit`] counted. Faces with a repeated vertex have no edges here.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Audit {
    /// Vertices of the mesh, used or not.
    pub vertices: u64,
    /// Faces of the mesh.
    pub triangles: u64,
    /// Pairs of vertices that at least one face joins.
    pub edges: u64,
    /// Edges with more than two faces.
    pub non_manifold_edges: u64,
    /// Edges with exactly two faces, both running along it in the same direction.
    pub inconsistent_edges: u64,
    /// Vertices whose faces do not hang together edge by edge.
    pub multi_fan_vertices: u64,
    /// Edges with exactly one face.
    pub boundary_edges: u64,
    /// Connected sets of boundary edges; closed loops in a manifold mesh.
    pub boundary_loops: u64,
    /// Sets of faces that share no vertex with the others.
    pub components: u64,
    /// Used vertices minus edges plus faces.
    pub euler_characteristic: i64,
    /// Handles of all components together, if the mesh [is a manifold](Audit::is_manifold).
    pub genus: Option<i64>,
    /// Faces that name a vertex twice.
    pub degenerate_faces: u64,
    /// Faces with the corners of an earlier face in the same cyclic order.
    pub duplicate_faces: u64,
    /// Vertices that no face uses.
    pub unreferenced_vertices: u64,
}

impl Audit {
    /// Whether every directed edge occurs at most once and the faces of every vertex form a single fan: an oriented
    /// 2-manifold, perhaps with a boundary.
    pub fn is_manifold(&self) -> bool {
        self.non_manifold_edges == 0
            && self.inconsistent_edges == 0
            && self.multi_fan_vertices == 0
            && self.degenerate_faces == 0
            && self.duplicate_faces == 0
    }

    /// [`Audit::is_manifold`] and no vertex without a face: what cleaning promises.
    pub fn is_clean(&self) -> bool {
        self.is_manifold() && self.unreferenced_vertices == 0
    }
}

/// Counts everything in [`Audit`]. O(n log n) in time, some 100 bytes a face.
///
/// # Panics
/// If a face names a vertex that does not exist.
pub fn audit(mesh: &TriMesh) -> Audit {
    let faces = mesh.faces.as_slice();
    let vertex_count = mesh.positions.len();
    let mut is_used = vec![false; vertex_count];
    let mut components = DisjointSets::new(vertex_count);
    for face in faces {
        face.iter().for_each(|&v| is_used[v as usize] = true);
        components.join(face[0], face[1]);
        components.join(face[1], face[2]);
    }

    let (mut edges, mut non_manifold, mut inconsistent, mut boundary) = (0_u64, 0, 0, 0);
    let mut fans = DisjointSets::new(faces.len() * 3);
    let mut loops = DisjointSets::new(vertex_count);
    let mut on_boundary = vec![false; vertex_count];
    for edge in EdgeTable::new(vertex_count, faces).edges() {
        edges += 1;
        match edge.len() {
            1 => {
                boundary += 1;
                loops.join(edge.low, edge.high);
                on_boundary[edge.low as usize] = true;
                on_boundary[edge.high as usize] = true;
            }
            2 => {
                let same = origin(faces, edge.half_edge(0)) == origin(faces, edge.half_edge(1));
                inconsistent += u64::from(same);
            }
            _ => non_manifold += 1,
        }
        // The corners at either end hang together across the edge.
        let ends = |half_edge: u32| {
            let (here, there) = (half_edge, next(half_edge));
            if origin(faces, here) == edge.low { (here, there) } else { (there, here) }
        };
        let first = ends(edge.half_edge(0));
        for half_edge in edge.half_edges().skip(1) {
            let other = ends(half_edge);
            fans.join(first.0, other.0);
            fans.join(first.1, other.1);
        }
    }

    let mut fan_counts = vec![0_u32; vertex_count];
    for (f, &face) in faces.iter().enumerate().filter(|(_, face)| !is_degenerate(**face)) {
        for k in 0..3 {
            let corner = (3 * f + k) as u32;
            fan_counts[face[k] as usize] += u32::from(fans.find(corner) == corner);
        }
    }
    let degenerate = faces.iter().filter(|face| is_degenerate(**face)).count() as u64;
    let sets = |sets: &mut DisjointSets, holds: &[bool]| {
        (0..vertex_count as u32).filter(|&v| holds[v as usize] && sets.find(v) == v).count() as u64
    };
    let used = is_used.iter().filter(|used| **used).count() as u64;
    let mut audit = Audit {
        vertices: vertex_count as u64,
        triangles: faces.len() as u64,
        edges,
        non_manifold_edges: non_manifold,
        inconsistent_edges: inconsistent,
        multi_fan_vertices: fan_counts.iter().filter(|count| **count > 1).count() as u64,
        boundary_edges: boundary,
        boundary_loops: sets(&mut loops, &on_boundary),
        components: sets(&mut components, &is_used),
        euler_characteristic: used as i64 - edges as i64 + faces.len() as i64,
        genus: None,
        degenerate_faces: degenerate,
        duplicate_faces: duplicate_faces(faces).len() as u64,
        unreferenced_vertices: vertex_count as u64 - used,
    };
    if audit.is_manifold() {
        // Euler and Poincaré: for each component, V - E + F = 2 - 2 * genus - loops.
        let (components, loops) = (audit.components as i64, audit.boundary_loops as i64);
        audit.genus = Some((2 * components - audit.euler_characteristic - loops) / 2);
    }
    audit
}

#[cfg(test)]
mod tests;
