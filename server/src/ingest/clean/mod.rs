//! From any triangles to an oriented 2-manifold, perhaps with a boundary, that looks the same.
//!
//! One pass per file, in the order of [`clean`]. Nothing is moved and nothing is filled: faces that are no surface are
//! dropped, vertices are joined where they coincide exactly and copied where sheets have to come apart. The result
//! depends on the input alone, not on a hash map or a thread.
//!
//! Read next: [`crate::mesh::audit`], which checks the result.

use std::fmt;

use serde::Serialize;

use crate::mesh::TriMesh;
use crate::mesh::edges::EdgeTable;

mod components;
mod degenerate;
pub(crate) mod manifold;
pub(crate) mod orient;
mod weld;

pub use components::components;

#[cfg(test)]
mod tests;

/// What [`clean`] did, in the order in which it did it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct CleanReport {
    /// Vertices of the input.
    pub vertices_before: u64,
    /// Triangles of the input.
    pub triangles_before: u64,
    /// Faces dropped because a vertex is not finite or does not exist.
    pub unusable_faces: u64,
    /// Vertices joined to an earlier one at exactly the same position.
    pub welded_vertices: u64,
    /// Vertices joined to one within the welding tolerance, if one was given.
    pub near_vertices: u64,
    /// Faces dropped because they name a vertex twice.
    pub degenerate_faces: u64,
    /// Faces dropped because they repeat an earlier one.
    pub duplicate_faces: u64,
    /// Vertices dropped because no face uses them, welded ones not counted.
    pub unreferenced_vertices: u64,
    /// Faces turned round to agree with their neighbours.
    pub turned_faces: u64,
    /// Edges cut because their patch has only one side.
    pub one_sided_edges: u64,
    /// Edges that had more than two faces.
    pub non_manifold_edges: u64,
    /// Faces that lost their neighbours at such an edge; all others there kept one.
    pub cut_sides: u64,
    /// Edges where the vertices could not tell two sheets apart, which were joined differently or cut.
    pub double_edges: u64,
    /// Vertices that had several fans.
    pub split_vertices: u64,
    /// Copies that they got.
    pub vertex_copies: u64,
    /// Components of the result.
    pub components: u64,
    /// Vertices of the result.
    pub vertices_after: u64,
    /// Triangles of the result.
    pub triangles_after: u64,
}

/// Cleans a mesh.
///
/// In the result each directed edge occurs at most once, the faces of every vertex form a single fan, closed or open,
/// and every vertex has a face: [`Audit::is_clean`](crate::mesh::audit::Audit::is_clean). Faces and vertices keep
/// their order; copies of vertices follow at the end. Faces of zero area stay, and so do vertices that are near each
/// other. The result may be empty. O(n log n), some 150 bytes a face.
///
/// # Panics
/// If there are more than [`MAX_TRIANGLES`](super::read::MAX_TRIANGLES) faces, or colours of another number than
/// vertices.
pub fn clean(mut mesh: TriMesh) -> (TriMesh, CleanReport) {
    let (vertices_before, triangles_before) = (mesh.positions.len() as u64, mesh.faces.len() as u64);
    let unusable_faces = degenerate::drop_unusable_faces(&mut mesh);
    let welded_vertices = weld::weld(&mut mesh);
    let degenerate_faces = degenerate::drop_degenerate_faces(&mut mesh);
    let duplicate_faces = degenerate::drop_duplicate_faces(&mut mesh);
    let unreferenced_vertices = degenerate::drop_unreferenced_vertices(&mut mesh) - welded_vertices;
    let mut edges = EdgeTable::new(mesh.positions.len(), &mesh.faces);
    let turned_faces = orient::orient(&mut mesh, &edges);
    if turned_faces > 0 {
        edges = EdgeTable::new(mesh.positions.len(), &mesh.faces);
    }
    let resolved = manifold::resolve(&mut mesh, &edges);
    let report = CleanReport {
        vertices_before,
        triangles_before,
        unusable_faces,
        welded_vertices,
        near_vertices: 0,
        degenerate_faces,
        duplicate_faces,
        unreferenced_vertices,
        turned_faces,
        one_sided_edges: resolved.one_sided_edges,
        non_manifold_edges: resolved.non_manifold_edges,
        cut_sides: resolved.cut_sides,
        double_edges: resolved.double_edges,
        split_vertices: resolved.split_vertices,
        vertex_copies: resolved.copies,
        components: components(&mesh).into_iter().max().map_or(0, |highest| u64::from(highest) + 1),
        vertices_after: mesh.positions.len() as u64,
        triangles_after: mesh.faces.len() as u64,
    };
    (mesh, report)
}

impl fmt::Display for CleanReport {
    /// One line for what came and went, then one for each thing that was done.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} vertices and {} triangles became {} and {} in {} components",
            self.vertices_before, self.triangles_before, self.vertices_after, self.triangles_after, self.components
        )?;
        let lines = [
            (self.unusable_faces, "faces without finite positions dropped"),
            (self.welded_vertices, "vertices welded to another at the same position"),
            (self.near_vertices, "vertices joined within the tolerance"),
            (self.degenerate_faces, "faces with a repeated vertex dropped"),
            (self.duplicate_faces, "duplicate faces dropped"),
            (self.unreferenced_vertices, "vertices without a face dropped"),
            (self.turned_faces, "faces turned round"),
            (self.one_sided_edges, "edges of one-sided surfaces cut"),
            (self.non_manifold_edges, "edges with more than two faces resolved"),
            (self.cut_sides, "faces cut loose at such edges"),
            (self.double_edges, "double edges separated"),
            (self.split_vertices, "vertices with several fans split"),
            (self.vertex_copies, "copies of vertices made"),
        ];
        for (count, what) in lines.into_iter().filter(|(count, _)| *count > 0) {
            write!(f, "\n  {count} {what}")?;
        }
        Ok(())
    }
}
