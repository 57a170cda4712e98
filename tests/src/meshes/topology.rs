//! Counts that do not depend on where the vertices lie.

use std::collections::HashMap;

use lodestream_server::mesh::TriMesh;

/// Numbers of a clean mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Topology {
    /// Vertices that a face uses.
    pub vertices: usize,
    /// Undirected edges.
    pub edges: usize,
    /// Triangles.
    pub faces: usize,
    /// Edges with one face.
    pub boundary_edges: usize,
    /// Closed walks along the boundary.
    pub boundary_loops: usize,
    /// Pieces connected through edges.
    pub components: usize,
}

impl Topology {
    /// V - E + F.
    pub fn euler(&self) -> i64 {
        self.vertices as i64 - self.edges as i64 + self.faces as i64
    }

    /// Handles of all components together: each adds 2 - 2 handles - loops to the Euler number.
    pub fn genus(&self) -> i64 {
        (2 * self.components as i64 - self.boundary_loops as i64 - self.euler()) / 2
    }
}

/// What keeps a mesh from being clean, in words, or `None`. Costs O(faces).
pub fn defect(mesh: &TriMesh) -> Option<String> {
    topology(mesh).err()
}

/// Counts of a clean mesh. Costs O(faces).
///
/// # Errors
/// The first defect found, in words.
pub fn topology(mesh: &TriMesh) -> Result<Topology, String> {
    let count = mesh.positions.len();
    if mesh.colors.as_ref().is_some_and(|colors| colors.len() != count) {
        return Err("colours and positions differ in number".into());
    }
    // Around each vertex, face by face: from the edge to `v` to the edge to `w`.
    let mut next: HashMap<(u32, u32), u32> = HashMap::new();
    let mut faces_around = vec![0usize; count];
    for (i, &[a, b, c]) in mesh.faces.iter().enumerate() {
        if [a, b, c].iter().any(|&v| v as usize >= count) || a == b || b == c || c == a {
            return Err(format!("face {i} has corners {a} {b} {c}"));
        }
        for (u, v, w) in [(a, b, c), (b, c, a), (c, a, b)] {
            if next.insert((u, v), w).is_some() {
                return Err(format!("directed edge {u} -> {v} occurs twice"));
            }
            faces_around[u as usize] += 1;
        }
    }
    // A fan starts at an outgoing edge that no face before it ends at, or anywhere in a closed fan.
    let mut start: Vec<Option<u32>> = vec![None; count];
    let mut boundary = HashMap::new();
    for &(u, v) in next.keys() {
        if !next.contains_key(&(v, u)) {
            if boundary.insert(u, v).is_some() {
                return Err(format!("vertex {u} has two open fans"));
            }
            start[u as usize] = Some(v);
        }
        start[u as usize].get_or_insert(v);
    }
    for (u, around) in faces_around.iter().enumerate() {
        let Some(first) = start[u] else { continue };
        let (mut at, mut steps) = (first, 0);
        while let Some(&w) = next.get(&(u as u32, at)) {
            steps += 1;
            at = w;
            if at == first {
                break;
            }
        }
        if steps != *around {
            return Err(format!("vertex {u} has {around} faces, {steps} of them in one fan"));
        }
    }
    let boundary_edges = boundary.len();
    Ok(Topology {
        vertices: start.iter().flatten().count(),
        edges: (next.len() + boundary_edges) / 2,
        faces: mesh.faces.len(),
        boundary_edges,
        boundary_loops: count_loops(boundary),
        components: count_components(mesh),
    })
}

fn count_loops(mut boundary: HashMap<u32, u32>) -> usize {
    let mut loops = 0;
    while let Some(&start) = boundary.keys().next() {
        let mut at = start;
        while let Some(to) = boundary.remove(&at) {
            at = to;
        }
        loops += 1;
    }
    loops
}

fn count_components(mesh: &TriMesh) -> usize {
    let mut parent: Vec<u32> = (0..).take(mesh.positions.len()).collect();
    fn root(parent: &mut [u32], mut v: u32) -> u32 {
        while parent[v as usize] != v {
            parent[v as usize] = parent[parent[v as usize] as usize];
            v = parent[v as usize];
        }
        v
    }
    for &[a, b, c] in &mesh.faces {
        for (u, v) in [(a, b), (b, c)] {
            let (u, v) = (root(&mut parent, u), root(&mut parent, v));
            parent[u as usize] = v;
        }
    }
    let mut used = vec![false; parent.len()];
    for v in mesh.faces.iter().flatten() {
        let top = root(&mut parent, *v);
        used[top as usize] = true;
    }
    used.iter().filter(|u| **u).count()
}
