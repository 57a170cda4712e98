//! The real screen error of a mesh: how far the original's vertices lie from it, in pixels of a view.

use glam::DVec3;
use lodestream_protocol::view::View;

/// Triangles in a tree of boxes, for nearest-point queries.
pub struct TriangleTree {
    triangles: Vec<[DVec3; 3]>,
    nodes: Vec<Node>,
}

struct Node {
    min: DVec3,
    max: DVec3,
    /// First triangle and count of a leaf; index of the right child and 0 of an inner node, whose left child follows it.
    start: u32,
    count: u32,
}

impl TriangleTree {
    /// Builds the tree; O(n log n).
    pub fn new(mut triangles: Vec<[DVec3; 3]>) -> Self {
        let mut nodes = Vec::new();
        let count = triangles.len();
        if count > 0 {
            build(&mut triangles, 0, count, &mut nodes);
        }
        Self { triangles, nodes }
    }

    /// Distance from `p` to the nearest triangle, infinite without triangles.
    pub fn distance(&self, p: DVec3) -> f64 {
        let mut best = f64::INFINITY;
        let mut stack = Vec::with_capacity(64);
        if !self.nodes.is_empty() {
            stack.push((0usize, 0.0));
        }
        while let Some((index, at_least)) = stack.pop() {
            if at_least >= best {
                continue;
            }
            let node = &self.nodes[index];
            if node.count > 0 {
                for t in &self.triangles[node.start as usize..(node.start + node.count) as usize] {
                    best = best.min(distance_squared(p, t));
                }
                continue;
            }
            let (left, right) = (index + 1, node.start as usize);
            let (to_left, to_right) = (self.box_distance(left, p), self.box_distance(right, p));
            if to_left < to_right {
                stack.extend([(right, to_right), (left, to_left)]);
            } else {
                stack.extend([(left, to_left), (right, to_right)]);
            }
        }
        best.sqrt()
    }

    fn box_distance(&self, node: usize, p: DVec3) -> f64 {
        let Node { min, max, .. } = self.nodes[node];
        (min - p).max(p - max).max(DVec3::ZERO).length_squared()
    }
}

fn build(triangles: &mut [[DVec3; 3]], start: usize, count: usize, nodes: &mut Vec<Node>) {
    let slice = &mut triangles[start..start + count];
    let (min, max) = slice.iter().flatten().fold((slice[0][0], slice[0][0]), |(lo, hi), p| (lo.min(*p), hi.max(*p)));
    let index = nodes.len();
    nodes.push(Node { min, max, start: start as u32, count: count as u32 });
    if count <= 4 {
        return;
    }
    let size = max - min;
    let axis = if size.x >= size.y && size.x >= size.z {
        0
    } else if size.y >= size.z {
        1
    } else {
        2
    };
    let key = |t: &[DVec3; 3]| t[0][axis] + t[1][axis] + t[2][axis];
    slice.select_nth_unstable_by(count / 2, |a, b| key(a).total_cmp(&key(b)));
    build(triangles, start, count / 2, nodes);
    nodes[index].start = nodes.len() as u32;
    nodes[index].count = 0;
    build(triangles, start + count / 2, count - count / 2, nodes);
}

/// Squared distance from a point to a triangle (Ericson 2005, section 5.1.5, by Voronoi regions).
fn distance_squared(p: DVec3, [a, b, c]: &[DVec3; 3]) -> f64 {
    let segment = |a: DVec3, b: DVec3| {
        let d = b - a;
        let t = if d.length_squared() > 0.0 { ((p - a).dot(d) / d.length_squared()).clamp(0.0, 1.0) } else { 0.0 };
        p.distance_squared(a + d * t)
    };
    let normal = (*b - *a).cross(*c - *a);
    let inside = |a: DVec3, b: DVec3| (b - a).cross(p - a).dot(normal) >= 0.0;
    if normal.length_squared() > 0.0 && inside(*a, *b) && inside(*b, *c) && inside(*c, *a) {
        return (p - *a).dot(normal).powi(2) / normal.length_squared();
    }
    segment(*a, *b).min(segment(*b, *c)).min(segment(*c, *a))
}

/// Percentiles in pixels.
#[derive(Clone, Copy, Debug, Default)]
pub struct ScreenError {
    /// Vertices judged.
    pub vertices: usize,
    /// Half of the vertices are nearer than this.
    pub p50: f64,
    /// 99 % are.
    pub p99: f64,
    /// 99.9 % are.
    pub p999: f64,
    /// All are.
    pub max: f64,
}

/// Distance of the original's front-facing vertices inside the view to `mesh`, as pixels: distance x k / depth along the
/// view (TARGETS, rows 5 and 22). Occluded vertices count too, so the figures are upper bounds for what is unoccluded.
pub fn screen_error(positions: &[DVec3], normals: &[DVec3], mesh: &TriangleTree, view: &View) -> ScreenError {
    let eye = DVec3::from_array(view.eye);
    let forward = view.rotation() * DVec3::NEG_Z;
    let planes = view.planes();
    let scale = view.pixel_scale();
    let mut pixels: Vec<f64> = positions
        .iter()
        .zip(normals)
        .filter(|(p, n)| n.dot(**p - eye) < 0.0 && planes.iter().all(|s| s.normal.dot(**p) + s.offset >= 0.0))
        .map(|(p, _)| mesh.distance(*p) * scale / (*p - eye).dot(forward).max(view.near))
        .collect();
    pixels.sort_by(f64::total_cmp);
    let at = |share: f64| pixels.get(((pixels.len() as f64 * share) as usize).min(pixels.len().max(1) - 1)).copied();
    ScreenError {
        vertices: pixels.len(),
        p50: at(0.5).unwrap_or(0.0),
        p99: at(0.99).unwrap_or(0.0),
        p999: at(0.999).unwrap_or(0.0),
        max: pixels.last().copied().unwrap_or(0.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tree_agrees_with_trying_every_triangle() {
        let mut rng = fastrand::Rng::with_seed(4);
        let mut point = || DVec3::new(rng.f64(), rng.f64(), rng.f64());
        let triangles: Vec<[DVec3; 3]> = (0..300)
            .map(|_| {
                let a = point();
                [a, a + 0.2 * point(), a + 0.2 * point()]
            })
            .collect();
        let tree = TriangleTree::new(triangles.clone());
        for _ in 0..500 {
            let p = 2.0 * point() - DVec3::splat(0.5);
            let naive = triangles.iter().map(|t| distance_squared(p, t)).fold(f64::INFINITY, f64::min).sqrt();
            assert_eq!(tree.distance(p), naive);
        }
    }

    #[test]
    fn distances_of_known_points() {
        let t = [DVec3::ZERO, DVec3::X, DVec3::Y];
        assert_eq!(distance_squared(DVec3::new(0.2, 0.2, 3.0), &t), 9.0);
        assert_eq!(distance_squared(DVec3::new(-2.0, 0.0, 0.0), &t), 4.0);
        assert!((distance_squared(DVec3::new(1.0, 1.0, 0.0), &t) - 0.5).abs() < 1e-12);
    }
}
