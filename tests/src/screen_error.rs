//! The dull twin of the server's judge: every vertex against every triangle.

use glam::DVec3;
use lodestream_protocol::view::View;
use lodestream_server::judge::tree::distance_squared;
use lodestream_server::mesh::TriMesh;

/// What there is to say about one vertex that a view shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judged {
    /// Where it lies.
    pub position: [f64; 3],
    /// Distance to the mesh in pixels.
    pub pixels: f64,
    /// Whether nothing hides it.
    pub is_unoccluded: bool,
}

/// Judges `mesh` in a perspective view. O(vertices x triangles). In the order of the original's vertices, which all must have
/// faces.
pub fn judge(original: &TriMesh, mesh: &TriMesh, view: &View) -> Vec<Judged> {
    let eye = DVec3::from_array(view.eye);
    let forward = view.rotation() * DVec3::NEG_Z;
    let corners = |mesh: &TriMesh, face: [u32; 3]| face.map(|v| DVec3::from_array(mesh.positions[v as usize]));
    let mut judged = Vec::new();
    for (v, &position) in (0..).zip(&original.positions) {
        let p = DVec3::from_array(position);
        let around = original.faces.iter().filter(|face| face.contains(&v));
        let normal: DVec3 = around.map(|&face| corners(original, face)).map(|[a, b, c]| (b - a).cross(c - a)).sum();
        let depth = (p - eye).dot(forward);
        let is_inside = view.planes().iter().all(|plane| plane.normal.dot(p) + plane.offset >= 0.0);
        if normal.dot(p - eye) >= 0.0 || depth < view.near || !is_inside {
            continue;
        }
        let distance =
            mesh.faces.iter().map(|&face| distance_squared(p, &corners(mesh, face))).fold(f64::INFINITY, f64::min);
        let hides = |&&face: &&[u32; 3]| !face.contains(&v) && is_crossed(eye, p, corners(original, face));
        judged.push(Judged {
            position,
            pixels: distance.sqrt() * view.pixel_scale() / depth,
            is_unoccluded: original.faces.iter().find(hides).is_none(),
        });
    }
    judged
}

/// Whether the line from `eye` to `p` crosses a triangle on its way, by signed volumes.
fn is_crossed(eye: DVec3, p: DVec3, [a, b, c]: [DVec3; 3]) -> bool {
    let volume = |a: DVec3, b: DVec3, c: DVec3, d: DVec3| (b - a).cross(c - a).dot(d - a);
    let sides = [volume(a, b, c, eye), volume(a, b, c, p)];
    let turns = [volume(eye, p, a, b), volume(eye, p, b, c), volume(eye, p, c, a)];
    sides[0] * sides[1] < 0.0 && (turns.iter().all(|&x| x >= 0.0) || turns.iter().all(|&x| x <= 0.0))
}
