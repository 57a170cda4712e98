//! Triangles in a tree of boxes: nearest points and blocked lines of sight.

use glam::DVec3;
use rayon::prelude::*;

/// Most triangles of a leaf.
const LEAF: usize = 4;
/// Triangles below which a subtree is built on one thread.
const SERIAL: usize = 8192;
/// Most levels: more than any number of triangles needs.
const MAX_LEVELS: usize = 40;
/// Share of a line of sight by which a hit must lie before its end. Faces that meet the end in an edge or at a corner that is
/// not quite equal would block it otherwise.
const BEFORE_THE_END: f64 = 1.0 - 1e-9;

/// Triangles in a complete binary tree of boxes: node `i` has the children `2 i + 1` and `2 i + 2`, and the node `k` of level
/// `l` holds the triangles `n k / 2^l .. n (k + 1) / 2^l`. About 170 bytes a triangle.
#[derive(Debug)]
pub struct TriangleTree {
    triangles: Vec<[DVec3; 3]>,
    /// For each triangle, its place in the list that the tree was built from.
    numbers: Vec<u32>,
    boxes: Vec<Box3>,
    levels: u32,
}

#[derive(Clone, Copy, Debug)]
struct Box3 {
    min: DVec3,
    max: DVec3,
}

impl Box3 {
    const EMPTY: Self = Self { min: DVec3::INFINITY, max: DVec3::NEG_INFINITY };

    fn union(self, other: Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    #[inline]
    fn distance_squared(&self, p: DVec3) -> f64 {
        (self.min - p).max(p - self.max).max(DVec3::ZERO).length_squared()
    }

    /// Whether the line from `from` meets the box before its end; `inverse` is one over its direction, by component, with
    /// positive infinity for zero.
    #[inline]
    fn meets(&self, from: DVec3, inverse: DVec3) -> bool {
        let (a, b) = ((self.min - from) * inverse, (self.max - from) * inverse);
        // A line within a side of the box gives 0 x infinity, which must not keep it out: `max` and `min` drop NaN.
        let slab = |a: f64, b: f64| {
            let (a, b) = (a.max(f64::NEG_INFINITY), b.min(f64::INFINITY));
            (a.min(b), a.max(b))
        };
        let ((ax, bx), (ay, by), (az, bz)) = (slab(a.x, b.x), slab(a.y, b.y), slab(a.z, b.z));
        let enter = ax.max(ay).max(az).max(0.0);
        let leave = bx.min(by).min(bz).min(1.0);
        enter <= leave * (1.0 + 1e-12)
    }
}

/// The point of a tree's triangles nearest to another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Nearest {
    /// Squared distance to it.
    pub distance_squared: f64,
    /// The triangle's place in the list that the tree was built from.
    pub triangle: u32,
    /// Weights of the triangle's corners there; they sum to 1.
    pub weights: [f64; 3],
    /// The triangle's place in the tree: a good `hint` for the next query nearby.
    pub hint: u32,
}

impl TriangleTree {
    /// Builds the tree in the caller's thread pool. O(n log n), some 0.5 us a triangle on one core.
    ///
    /// # Panics
    /// With 2^32 triangles or more.
    pub fn new(triangles: &[[DVec3; 3]]) -> Self {
        let count = u32::try_from(triangles.len()).expect("meshes have fewer than 2^32 triangles");
        let mut items: Vec<(DVec3, u32)> =
            triangles.iter().zip(0..count).map(|(t, i)| (t[0] + t[1] + t[2], i)).collect();
        let levels = (triangles.len().div_ceil(LEAF)).next_power_of_two().trailing_zeros();
        sort(&mut items, 0, 0, triangles.len(), 0, levels);
        let numbers: Vec<u32> = items.iter().map(|&(_, i)| i).collect();
        let triangles: Vec<[DVec3; 3]> = numbers.iter().map(|&i| triangles[i as usize]).collect();
        let mut tree = Self { triangles, numbers, boxes: Vec::new(), levels };
        let leaves = 1usize << levels;
        tree.boxes.resize(2 * leaves - 1, Box3::EMPTY);
        let mut boxes = std::mem::take(&mut tree.boxes);
        boxes[leaves - 1..].par_iter_mut().enumerate().for_each(|(k, b)| {
            *b = tree.triangles[tree.range(k)]
                .iter()
                .flatten()
                .fold(Box3::EMPTY, |b, &p| b.union(Box3 { min: p, max: p }));
        });
        for node in (0..leaves - 1).rev() {
            boxes[node] = boxes[2 * node + 1].union(boxes[2 * node + 2]);
        }
        tree.boxes = boxes;
        tree
    }

    /// Triangles in it.
    pub fn len(&self) -> usize {
        self.triangles.len()
    }

    /// Whether there is no triangle.
    pub fn is_empty(&self) -> bool {
        self.triangles.is_empty()
    }

    /// Triangles of leaf `k`.
    #[inline]
    fn range(&self, k: usize) -> std::ops::Range<usize> {
        range(self.triangles.len(), k, self.levels)
    }

    /// The point nearest to `p`, or `None` without triangles. `hint` names a triangle that is likely near
    /// ([`Nearest::hint`] of a neighbour); any value will do and only the time depends on it, except that of equally near
    /// triangles another may be named.
    pub fn nearest(&self, p: DVec3, hint: u32) -> Option<Nearest> {
        let first = self.triangles.get(hint as usize).map_or(0, |_| hint as usize);
        let (mut best, mut place) = (distance_squared(p, self.triangles.get(first)?), first);
        let leaf = self.boxes.len() / 2;
        let mut stack = [(0usize, 0.0f64); MAX_LEVELS];
        stack[0] = (0, self.boxes[0].distance_squared(p));
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (node, at_least) = stack[depth];
            if at_least >= best {
                continue;
            }
            if node >= leaf {
                for i in self.range(node - leaf) {
                    let distance = distance_squared(p, &self.triangles[i]);
                    if distance < best {
                        (best, place) = (distance, i);
                    }
                }
                continue;
            }
            let children = [2 * node + 1, 2 * node + 2].map(|child| (child, self.boxes[child].distance_squared(p)));
            let [near, far] = if children[0].1 <= children[1].1 { children } else { [children[1], children[0]] };
            for child in [far, near] {
                if child.1 < best {
                    stack[depth] = child;
                    depth += 1;
                }
            }
        }
        Some(Nearest {
            distance_squared: best,
            triangle: self.numbers[place],
            weights: weights(p, &self.triangles[place]),
            hint: place as u32,
        })
    }

    /// Place in the tree of a triangle that the line from `from` to `to` crosses on its way, or `None` if there is none.
    /// Triangles with a corner exactly at `to` do not count. `hint` as for [`nearest`](Self::nearest).
    pub fn blocker(&self, from: DVec3, to: DVec3, hint: u32) -> Option<u32> {
        let direction = to - from;
        if self.triangles.get(hint as usize).is_some_and(|t| crosses(from, direction, to, t)) {
            return Some(hint);
        }
        if self.triangles.is_empty() {
            return None;
        }
        // Adding zero makes a negative zero positive.
        let inverse = (direction + DVec3::ZERO).recip();
        let leaf = self.boxes.len() / 2;
        let mut stack = [0usize; MAX_LEVELS];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let node = stack[depth];
            if !self.boxes[node].meets(from, inverse) {
                continue;
            }
            if node >= leaf {
                let mut range = self.range(node - leaf);
                if let Some(i) = range.find(|&i| crosses(from, direction, to, &self.triangles[i])) {
                    return Some(i as u32);
                }
                continue;
            }
            // What blocks is most often near the end.
            stack[depth] = 2 * node + 1;
            stack[depth + 1] = 2 * node + 2;
            depth += 2;
        }
        None
    }
}

#[inline]
fn range(count: usize, k: usize, level: u32) -> std::ops::Range<usize> {
    count * k >> level..count * (k + 1) >> level
}

/// Puts the items of node `k` of `level`, which begin at `offset`, in the tree's order. At most `levels` deep.
fn sort(items: &mut [(DVec3, u32)], offset: usize, k: usize, count: usize, level: u32, levels: u32) {
    if level == levels {
        return;
    }
    let (min, max) =
        items.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), (p, _)| (lo.min(*p), hi.max(*p)));
    let size = max - min;
    let axis = if size.x >= size.y && size.x >= size.z {
        0
    } else if size.y >= size.z {
        1
    } else {
        2
    };
    let middle = range(count, 2 * k + 1, level + 1).start - offset;
    if middle < items.len() {
        // The number breaks ties, so that the tree depends on the triangles alone.
        items.select_nth_unstable_by(middle, |a, b| a.0[axis].total_cmp(&b.0[axis]).then(a.1.cmp(&b.1)));
    }
    let is_large = items.len() > SERIAL;
    let (left, right) = items.split_at_mut(middle);
    let mut left = || sort(left, offset, 2 * k, count, level + 1, levels);
    let mut right = || sort(right, offset + middle, 2 * k + 1, count, level + 1, levels);
    if is_large {
        rayon::join(left, right);
    } else {
        left();
        right();
    }
}

/// Whether the line from `from` along `direction` to `to` crosses a triangle before it gets there (Möller and Trumbore 1997,
/// from both sides, edges included). Triangles at whose corner it ends are not crossed.
#[inline]
fn crosses(from: DVec3, direction: DVec3, to: DVec3, [a, b, c]: &[DVec3; 3]) -> bool {
    const SLACK: f64 = 1e-12;
    let (ab, ac) = (*b - *a, *c - *a);
    let p = direction.cross(ac);
    let determinant = ab.dot(p);
    if determinant == 0.0 {
        return false;
    }
    let inverse = 1.0 / determinant;
    let s = from - *a;
    let u = s.dot(p) * inverse;
    if !(-SLACK..=1.0 + SLACK).contains(&u) {
        return false;
    }
    let q = s.cross(ab);
    let v = direction.dot(q) * inverse;
    if v < -SLACK || u + v > 1.0 + SLACK {
        return false;
    }
    let along = ac.dot(q) * inverse;
    along > 0.0 && along < BEFORE_THE_END && ![a, b, c].contains(&&to)
}

/// Squared distance from a point to a triangle (Ericson 2005, section 5.1.5, by Voronoi regions).
pub fn distance_squared(p: DVec3, [a, b, c]: &[DVec3; 3]) -> f64 {
    let segment = |a: DVec3, b: DVec3| p.distance_squared(a + (b - a) * along(p, a, b));
    let normal = (*b - *a).cross(*c - *a);
    let inside = |a: DVec3, b: DVec3| (b - a).cross(p - a).dot(normal) >= 0.0;
    if normal.length_squared() > 0.0 && inside(*a, *b) && inside(*b, *c) && inside(*c, *a) {
        return (p - *a).dot(normal).powi(2) / normal.length_squared();
    }
    segment(*a, *b).min(segment(*b, *c)).min(segment(*c, *a))
}

/// Where on the way from `a` to `b` the point nearest to `p` lies, 0 to 1.
fn along(p: DVec3, a: DVec3, b: DVec3) -> f64 {
    let d = b - a;
    if d.length_squared() > 0.0 { ((p - a).dot(d) / d.length_squared()).clamp(0.0, 1.0) } else { 0.0 }
}

/// Weights of a triangle's corners at the point nearest to `p`.
fn weights(p: DVec3, [a, b, c]: &[DVec3; 3]) -> [f64; 3] {
    let normal = (*b - *a).cross(*c - *a);
    let area = normal.length_squared();
    if area > 0.0 {
        let part = |a: DVec3, b: DVec3| (b - a).cross(p - a).dot(normal) / area;
        let parts = [part(*b, *c), part(*c, *a), part(*a, *b)];
        if parts.iter().all(|&w| w >= 0.0) {
            return parts;
        }
    }
    let edges = [(0, 1, *a, *b), (1, 2, *b, *c), (2, 0, *c, *a)].map(|(i, j, a, b)| {
        let share = along(p, a, b);
        let mut weights = [0.0; 3];
        weights[i] = 1.0 - share;
        weights[j] = share;
        (p.distance_squared(a + (b - a) * share), weights)
    });
    let best = if edges[1].0 < edges[0].0 { edges[1] } else { edges[0] };
    if edges[2].0 < best.0 { edges[2].1 } else { best.1 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_of_known_points() {
        let t = [DVec3::ZERO, DVec3::X, DVec3::Y];
        assert_eq!(distance_squared(DVec3::new(0.2, 0.2, 3.0), &t), 9.0);
        assert_eq!(distance_squared(DVec3::new(-2.0, 0.0, 0.0), &t), 4.0);
        assert!((distance_squared(DVec3::new(1.0, 1.0, 0.0), &t) - 0.5).abs() < 1e-12);
    }

    #[test]
    fn weights_give_the_nearest_point() {
        let mut rng = fastrand::Rng::with_seed(5);
        let mut point = || DVec3::new(rng.f64(), rng.f64(), rng.f64());
        for _ in 0..300 {
            let t = [point(), point(), point()];
            let p = 2.0 * point() - DVec3::splat(0.5);
            let [u, v, w] = weights(p, &t);
            assert!((u + v + w - 1.0).abs() < 1e-12 && u.min(v).min(w) >= 0.0);
            let there = t[0] * u + t[1] * v + t[2] * w;
            assert!((there.distance_squared(p) - distance_squared(p, &t)).abs() < 1e-12);
        }
    }

    #[test]
    fn a_line_is_blocked_on_its_way_only() {
        let wall = [DVec3::new(-1.0, -1.0, 0.0), DVec3::new(1.0, -1.0, 0.0), DVec3::new(0.0, 1.0, 0.0)];
        let tree = TriangleTree::new(&[wall]);
        let blocked = |from: DVec3, to: DVec3| tree.blocker(from, to, u32::MAX).is_some();
        assert!(blocked(DVec3::Z, DVec3::NEG_Z) && blocked(DVec3::NEG_Z, DVec3::Z), "from both sides");
        assert!(!blocked(DVec3::Z, DVec3::Z * 0.5), "it ends before");
        assert!(!blocked(DVec3::Z, DVec3::ZERO), "it ends there");
        assert!(!blocked(DVec3::new(0.0, 2.0, 1.0), DVec3::new(0.0, 2.0, -1.0)), "it passes by");
        assert!(!blocked(DVec3::new(0.0, 1.0, 1.0), wall[2]), "it ends at a corner");
        assert!(blocked(DVec3::new(0.5, 0.0, 1.0), DVec3::new(0.5, 0.0, -1.0)), "along an axis through an edge");
    }

    #[test]
    fn the_empty_tree_has_nothing_near() {
        let tree = TriangleTree::new(&[]);
        assert!(tree.is_empty() && tree.nearest(DVec3::ZERO, 0).is_none());
        assert!(tree.blocker(DVec3::ZERO, DVec3::X, 0).is_none());
    }
}
