//! The mesh that others are judged against, and what of it a view shows.

use glam::DVec3;
use lodestream_protocol::view::{Projection, View};
use rayon::prelude::*;

use super::tree::TriangleTree;
use crate::mesh::TriMesh;
use crate::mesh::edges::DisjointSets;

/// Vertices that one task works through in a row.
pub(super) const BLOCK: usize = 2048;

/// A mesh ready to be looked at from anywhere.
#[derive(Debug)]
pub struct Original {
    positions: Vec<DVec3>,
    /// Sums of the normals of the faces around each vertex, weighted by area; not of unit length.
    normals: Vec<DVec3>,
    colors: Option<Vec<[u8; 3]>>,
    /// Diagonal of the box of each vertex's component.
    component_sizes: Vec<f64>,
    tree: TriangleTree,
    center: DVec3,
    radius: f64,
}

/// A vertex of the original that a view shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shown {
    /// Its number, see [`Original::position`].
    pub vertex: u32,
    /// Its depth along the viewing direction; for parallel rays 1, since size does not depend on it.
    pub depth: f64,
    /// Whether no face stands between it and the eye.
    pub is_unoccluded: bool,
}

impl Original {
    /// Takes a mesh over. Vertices without faces are left out. O(n log n), about 1 us a triangle.
    pub fn new(mesh: &TriMesh) -> Self {
        let at = |v: u32| DVec3::from_array(mesh.positions[v as usize]);
        let mut normals = vec![DVec3::ZERO; mesh.positions.len()];
        let mut is_used = vec![false; mesh.positions.len()];
        let triangles: Vec<[DVec3; 3]> = mesh.faces.iter().map(|face| face.map(at)).collect();
        for (face, [a, b, c]) in mesh.faces.iter().zip(&triangles) {
            let normal = (*b - *a).cross(*c - *a);
            for &v in face {
                normals[v as usize] += normal;
                is_used[v as usize] = true;
            }
        }
        let mut order: Vec<u32> = (0..mesh.positions.len() as u32).filter(|&v| is_used[v as usize]).collect();
        let used = || order.iter().map(|&v| at(v));
        let (low, high) = used().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), p| (lo.min(p), hi.max(p)));
        let size = (high - low).max_element();
        // Neighbours in this order are neighbours in space, so that one query's answer is a good hint for the next.
        order.par_sort_by_cached_key(|&v| morton((at(v) - low) / size));
        let pick = |v: &u32| *v as usize;
        let sizes = component_sizes(mesh);
        let (center, radius) =
            if order.is_empty() { (DVec3::ZERO, 0.0) } else { ((low + high) * 0.5, low.distance(high) * 0.5) };
        Self {
            positions: order.iter().map(|&v| at(v)).collect(),
            normals: order.iter().map(|v| normals[pick(v)]).collect(),
            colors: mesh.colors.as_ref().map(|colors| order.iter().map(|v| colors[pick(v)]).collect()),
            component_sizes: order.iter().map(|v| sizes[pick(v)]).collect(),
            tree: TriangleTree::new(&triangles),
            center,
            radius,
        }
    }

    /// Vertices with faces.
    pub fn vertex_count(&self) -> usize {
        self.positions.len()
    }

    /// Where a vertex lies. Vertices are numbered along a curve through space, not as in the mesh.
    pub fn position(&self, vertex: u32) -> DVec3 {
        self.positions[vertex as usize]
    }

    /// Diagonal of the box of a vertex's component.
    pub fn component_size(&self, vertex: u32) -> f64 {
        self.component_sizes[vertex as usize]
    }

    /// Normal of a vertex, of any length.
    pub fn normal(&self, vertex: u32) -> DVec3 {
        self.normals[vertex as usize]
    }

    /// Colour of a vertex.
    pub fn color(&self, vertex: u32) -> Option<[u8; 3]> {
        self.colors.as_ref().map(|colors| colors[vertex as usize])
    }

    /// Middle of the box.
    pub fn center(&self) -> DVec3 {
        self.center
    }

    /// Half the diagonal of the box: the radius of the bounding sphere about [`center`](Self::center).
    pub fn radius(&self) -> f64 {
        self.radius
    }

    /// The vertices that a view shows, by number: inside its planes, not nearer than its near plane, and facing the eye unless
    /// the view is two-sided.
    ///
    /// A vertex is occluded if a face of this mesh that does not have it as a corner crosses the line from the eye to it, from
    /// whichever side. Exact but for rounding: no depth buffer, whose pixels hide what lies beside a silhouette. About 1 us
    /// a vertex on one core; runs in the caller's thread pool.
    pub fn shown(&self, view: &View) -> Vec<Shown> {
        let eye = DVec3::from_array(view.eye);
        let forward = view.rotation() * DVec3::NEG_Z;
        let planes = view.planes();
        let is_parallel = matches!(view.projection, Projection::Orthographic { .. });
        // Parallel rays start outside of the mesh.
        let reach = eye.distance(self.center) + 2.0 * self.radius;
        let blocks = self.positions.par_chunks(BLOCK).zip(self.normals.par_chunks(BLOCK)).enumerate();
        let shown: Vec<Vec<Shown>> = blocks
            .map(|(block, (positions, normals))| {
                let mut shown = Vec::new();
                let mut hint = u32::MAX;
                for (i, (&p, &normal)) in positions.iter().zip(normals).enumerate() {
                    let depth = (p - eye).dot(forward);
                    let ray = if is_parallel { forward } else { p - eye };
                    let faces_eye = view.two_sided || normal.dot(ray) < 0.0;
                    let is_inside = || planes.iter().all(|plane| plane.normal.dot(p) + plane.offset >= 0.0);
                    if !faces_eye || !is_parallel && depth < view.near || !is_inside() {
                        continue;
                    }
                    let from = if is_parallel { p - forward * (depth.abs() + reach) } else { eye };
                    let blocker = self.tree.blocker(from, p, hint);
                    hint = blocker.unwrap_or(hint);
                    shown.push(Shown {
                        vertex: (block * BLOCK + i) as u32,
                        depth: if is_parallel { 1.0 } else { depth },
                        is_unoccluded: blocker.is_none(),
                    });
                }
                shown
            })
            .collect();
        shown.concat()
    }
}

/// Interleaved bits of a point in the unit cube, 10 a coordinate; NaN counts as 0.
fn morton(p: DVec3) -> u32 {
    let spread = |x: f64| {
        // `as` saturates and takes NaN to 0.
        let mut x = (x * 1024.0) as u32 & 0x3ff;
        x = (x | x << 16) & 0x0300_00ff;
        x = (x | x << 8) & 0x0300_f00f;
        x = (x | x << 4) & 0x030c_30c3;
        (x | x << 2) & 0x0924_9249
    };
    spread(p.x.min(0.9999)) | spread(p.y.min(0.9999)) << 1 | spread(p.z.min(0.9999)) << 2
}

/// Diagonal of the box of each vertex's component. O(n log n) at worst, about linear.
fn component_sizes(mesh: &TriMesh) -> Vec<f64> {
    let mut sets = DisjointSets::new(mesh.positions.len());
    for &[a, b, c] in &mesh.faces {
        sets.join(a, b);
        sets.join(b, c);
    }
    let mut boxes = vec![(DVec3::INFINITY, DVec3::NEG_INFINITY); mesh.positions.len()];
    for (v, &at) in (0..).zip(&mesh.positions) {
        let (low, high) = &mut boxes[sets.find(v) as usize];
        *low = low.min(DVec3::from_array(at));
        *high = high.max(DVec3::from_array(at));
    }
    (0..mesh.positions.len() as u32)
        .map(|v| {
            let (low, high) = boxes[sets.find(v) as usize];
            low.distance(high)
        })
        .collect()
}
