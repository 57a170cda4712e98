//! Connected components: which are the base and which are spawned (DESIGN section 2, "Components").

use glam::DVec3;

use super::{NONE, Point};

/// Most triangles of a base that consists of more than its largest component.
const MAX_BASE_TRIANGLES: usize = 1000;
/// Share of the largest component's diagonal that another one of the base has at least.
const MIN_BASE_DIAGONAL: f64 = 0.25;

/// The connected components of the complete mesh, numbered by their smallest vertex.
#[derive(Debug)]
pub(crate) struct Components {
    /// Component of each vertex; meaningless for a vertex without faces.
    pub(crate) of_vertex: Vec<u32>,
    /// Box of each component, in lattice steps.
    pub(crate) boxes: Vec<(DVec3, DVec3)>,
}

impl Components {
    /// Union-find over the faces' corners. O(vertices + faces), near enough.
    pub(crate) fn new(points: &[Point], faces: &[[u32; 3]]) -> Self {
        let mut up: Vec<u32> = vec![NONE; points.len()];
        for face in faces {
            for &v in face {
                if up[v as usize] == NONE {
                    up[v as usize] = v;
                }
            }
            let [a, b, c] = face.map(|v| root(&mut up, v));
            let low = a.min(b).min(c);
            for v in [a, b, c] {
                up[v as usize] = low;
            }
        }
        let mut of_vertex = vec![NONE; points.len()];
        let mut boxes = Vec::new();
        for v in 0..points.len() as u32 {
            if up[v as usize] == NONE {
                continue;
            }
            let top = root(&mut up, v);
            if top == v {
                of_vertex[v as usize] = boxes.len() as u32;
                boxes.push((DVec3::INFINITY, DVec3::NEG_INFINITY));
            }
            let component = of_vertex[top as usize];
            of_vertex[v as usize] = component;
            let (low, high) = &mut boxes[component as usize];
            let at = points[v as usize].at();
            *low = low.min(at);
            *high = high.max(at);
        }
        Self { of_vertex, boxes }
    }

    pub(crate) fn count(&self) -> usize {
        self.boxes.len()
    }

    /// Diagonal of a component's box: at least its diameter. Lattice steps.
    pub(crate) fn diagonal(&self, component: u32) -> f64 {
        let (low, high) = self.boxes[component as usize];
        low.distance(high)
    }

    /// See [`base_and_spawns`].
    pub(crate) fn base_and_spawns(&self, triangles: &[usize]) -> (Vec<u32>, Vec<u32>) {
        let diagonals: Vec<f64> = (0..self.count() as u32).map(|component| self.diagonal(component)).collect();
        base_and_spawns(&diagonals, triangles)
    }
}

/// Splits components into base and spawns, both by diagonal descending, then by number. `triangles` is what is left of each
/// after simplification.
pub(crate) fn base_and_spawns(diagonals: &[f64], triangles: &[usize]) -> (Vec<u32>, Vec<u32>) {
    let diagonal = |component: u32| diagonals[component as usize];
    let mut order: Vec<u32> = (0..diagonals.len() as u32).collect();
    order.sort_by(|&a, &b| diagonal(b).total_cmp(&diagonal(a)).then(a.cmp(&b)));
    let Some(&largest) = order.first() else { return (Vec::new(), Vec::new()) };
    let least = diagonal(largest) * MIN_BASE_DIAGONAL;
    let mut total = 0;
    order.into_iter().partition(|&component| {
        let grown = total + triangles[component as usize];
        let belongs = component == largest || (diagonal(component) >= least && grown <= MAX_BASE_TRIANGLES);
        if belongs {
            total = grown;
        }
        belongs
    })
}

fn root(up: &mut [u32], mut v: u32) -> u32 {
    while up[v as usize] != v {
        up[v as usize] = up[up[v as usize] as usize];
        v = up[v as usize];
    }
    v
}
