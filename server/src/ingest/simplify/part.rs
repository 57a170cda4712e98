//! A part of the mesh under simplification: the chunk of a leaf, or what is left of the children of an inner node.

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use super::{
    Method,
    batch::{Simplifier, State, originals},
    quadric::{self, Quadric},
    surface::Surface,
};
use crate::ingest::chunks::{ChunkedMesh, patches};
use crate::ingest::hierarchy::{
    Collapse, CollapseRecord, NONE, Point, RootFace, RootVertex,
    bounds::{Carried, Normals, Sphere},
    deviation::Samples,
};
use crate::ingest::spill::SpillError;
use crate::pack::record::{Bounds, Cone, Magnitude, WideCone};

/// Share of the faces that a node leaves for its parent to go on with: what eight children leave is one chunk again.
const SHARE_LEFT: usize = 8;

/// A vertex that is left when a node is done, as it waits in a spill for the node's parent.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Survivor {
    quadric: Quadric,
    sphere: Sphere,
    /// Axis, sine and cosine of the cone of normals, if `normals_kind` says that there is one.
    cone: [f64; 5],
    normals_kind: u32,
    pub(super) vertex: u32,
    component: u32,
    /// Last collapse that kept it, or [`NONE`].
    pub(super) last: u32,
    sample_count: u32,
    position: [i32; 3],
    center: [i32; 3],
    radius: u16,
    error: u16,
    axis: [i8; 2],
    half_angle: u8,
    color: [u8; 3],
    padding: [u8; 2],
}

/// A sample of a [`Survivor`].
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Sample {
    position: [i32; 3],
    color: [u8; 3],
    is_boundary: u8,
}

impl From<&Point> for Sample {
    fn from(point: &Point) -> Self {
        Self { position: point.position, color: point.color, is_boundary: point.is_boundary.into() }
    }
}

impl From<&Sample> for Point {
    fn from(sample: &Sample) -> Self {
        Self { position: sample.position, color: sample.color, is_boundary: sample.is_boundary != 0 }
    }
}

/// What nodes hand up: survivors by vertex, their samples one after the other, and faces by vertex numbers with their own
/// numbers, in order.
#[derive(Debug, Default)]
pub(super) struct Remainder {
    pub(super) survivors: Vec<Survivor>,
    pub(super) samples: Vec<Sample>,
    pub(super) faces: Vec<[u32; 3]>,
    pub(super) face_numbers: Vec<u32>,
}

/// What became of a part.
#[derive(Debug)]
pub(super) struct Simplified {
    /// In order. Ops of the part itself are numbered from the `first_op` that it was given.
    pub(super) collapses: Vec<CollapseRecord>,
    pub(super) remainder: Remainder,
    /// What is left of components that are finished.
    pub(super) root_vertices: Vec<RootVertex>,
    pub(super) root_faces: Vec<RootFace>,
    pub(super) sweeps: u32,
    pub(super) valence_sum: u64,
}

/// How a part is to be simplified.
#[derive(Clone, Copy, Debug)]
pub(super) struct Task {
    /// Of its node.
    pub(super) height: u8,
    pub(super) method: Method,
    /// Number of its first collapse.
    pub(super) first_op: u32,
    /// Whether a thread has nothing else to do than to help. The result is the same.
    pub(super) has_second_thread: bool,
}

/// See the module.
pub(super) struct Part {
    /// Numbers of the vertices, ascending.
    vertices: Vec<u32>,
    /// Component of each vertex.
    components: Vec<u32>,
    /// Numbers of the faces.
    face_numbers: Vec<u32>,
    surface: Surface,
    state: State,
}

impl Part {
    /// The part of a leaf.
    pub(super) fn leaf(mesh: &ChunkedMesh, chunk: u32) -> Result<Self, SpillError> {
        let mut faces = mesh.chunk(chunk)?;
        let vertices = localize(&mut faces);
        let first = mesh.chunk_starts[chunk as usize];
        let face_numbers = (first..).take(faces.len()).collect();
        let points: Vec<Point> = vertices.iter().map(|&v| mesh.vertices.point(v)).collect();
        let heights: Vec<u8> = vertices.iter().map(|&v| mesh.vertices.height(v)).collect();
        let mut components = vec![0; vertices.len()];
        let (labels, _) = patches(vertices.len(), &faces);
        let table = &mesh.components;
        for (face, label) in faces.iter().zip(labels) {
            let component = table.of_patch[(table.patch_starts[chunk as usize] + label) as usize];
            for &v in face {
                components[v as usize] = component;
            }
        }
        let surface = surface_of(vertices.len(), &faces);
        let mut quadrics = quadric::of_faces(&surface, &points);
        add_borders(&mut quadrics, &surface, &points, &heights, 0);
        let state = State {
            is_locked: heights.iter().map(|&h| h > 0).collect(),
            quadrics,
            carried: originals(&surface, &points),
            samples: Samples::new(points.len(), mesh.has_colors),
            points,
        };
        Ok(Self { vertices, components, face_numbers, surface, state })
    }

    /// The part of an inner node of this height, from what is left of its children, in their order.
    pub(super) fn join(mesh: &ChunkedMesh, height: u8, children: Remainder) -> Self {
        let Remainder { mut survivors, samples, mut faces, face_numbers } = children;
        // A vertex between several children comes once from each; a stable order keeps sums the same at any time.
        let mut first_sample = 0;
        let mut order: Vec<(u32, u32, u32)> = Vec::with_capacity(survivors.len());
        for (survivor, i) in survivors.iter().zip(0..) {
            order.push((survivor.vertex, i, first_sample));
            first_sample += survivor.sample_count;
        }
        order.sort_unstable();
        let vertices = localize(&mut faces);
        let count = vertices.len();
        let heights: Vec<u8> = vertices.iter().map(|&v| mesh.vertices.height(v)).collect();
        let mut components = Vec::with_capacity(count);
        let mut state = State {
            points: Vec::with_capacity(count),
            is_locked: heights.iter().map(|&h| h > height).collect(),
            quadrics: Vec::with_capacity(count),
            carried: Vec::with_capacity(count),
            samples: Samples::new(count, mesh.has_colors),
        };
        let mut own_samples = Vec::new();
        for copies in order.chunk_by(|a, b| a.0 == b.0) {
            let v = state.points.len() as u32;
            debug_assert_eq!(vertices[v as usize], copies[0].0);
            let (_, i, first_sample) = copies[0];
            let survivor = &mut survivors[i as usize];
            state.points.push(Point {
                position: survivor.position,
                color: survivor.color,
                is_boundary: mesh.vertices.is_boundary(copies[0].0),
            });
            components.push(survivor.component);
            let mut quadric = survivor.quadric;
            let mut carried = survivor.carried();
            own_samples.clear();
            let range = first_sample as usize..(first_sample + survivor.sample_count) as usize;
            own_samples.extend(samples[range].iter().map(Point::from));
            state.samples.give(v, &own_samples);
            for &(_, i, _) in &copies[1..] {
                let other = &survivors[i as usize];
                quadric.absorb(&other.quadric, DVec3::ZERO);
                carried = carried.joined(&other.carried());
            }
            state.quadrics.push(quadric);
            state.carried.push(carried);
        }
        assert_eq!(state.points.len(), count, "each survivor has a face");
        drop(survivors);
        let surface = surface_of(count, &faces);
        add_borders(&mut state.quadrics, &surface, &state.points, &heights, height);
        Self { vertices, components, face_numbers, surface, state }
    }

    /// Simplifies the part at this height: components that lie inside it to the end, the others to an eighth of their faces.
    /// `progress` hears how many faces are gone since it was last called.
    pub(super) fn simplify(self, mesh: &ChunkedMesh, task: Task, progress: &mut dyn FnMut(u64)) -> Simplified {
        let Task { height, method, first_op, has_second_thread } = task;
        let Self { vertices, components, face_numbers, surface, state } = self;
        let is_finished = |component: u32| mesh.components.components[component as usize].height <= height;
        let component_of = |surface: &Surface, face: u32| components[surface.corners(face)[0] as usize];
        let (inside, across): (Vec<u32>, Vec<u32>) =
            (0..face_numbers.len() as u32).partition(|&face| is_finished(component_of(&surface, face)));
        let mut simplifier = Simplifier::new(surface, state, method, first_op);
        let mut tell = Countdown { told: 0, progress };
        let work = |simplifier: &mut Simplifier| {
            if !across.is_empty() {
                let target = across.len() / SHARE_LEFT;
                tell.to(0);
                let total = across.len();
                simplifier.turn_to(across);
                simplifier.run_down_to(target, &mut |left| tell.to((total - left) as u64));
            }
            if !inside.is_empty() {
                let total = inside.len() as f32;
                tell.told = 0;
                simplifier.turn_to(inside);
                simplifier.run(&mut |share| tell.to((share * total) as u64));
            }
        };
        if has_second_thread {
            simplifier.run_ahead(work);
        } else {
            work(&mut simplifier);
        }
        let measured = &simplifier.measurer;

        let global = |h: u32| if h == NONE { NONE } else { 3 * face_numbers[h as usize / 3] + h % 3 };
        let collapses = measured
            .collapses
            .iter()
            .map(|collapse| {
                let Collapse { s, t, left, right, outer, next_of_s, first_of_t, s_move, s_color_move, bounds } =
                    *collapse;
                let gone = &simplifier.points[t as usize];
                let mut record = CollapseRecord::zeroed().with_bounds(bounds);
                (record.s, record.t) = (vertices[s as usize], vertices[t as usize]);
                (record.left, record.right, record.outer) = (global(left), global(right), outer.map(global));
                (record.next_of_s, record.first_of_t) = (next_of_s, first_of_t);
                (record.position, record.color) = (gone.position, gone.color);
                (record.s_move, record.s_color_move) = (s_move, s_color_move);
                record
            })
            .collect();
        let mut result = Simplified {
            collapses,
            remainder: Remainder::default(),
            root_vertices: Vec::new(),
            root_faces: Vec::new(),
            sweeps: simplifier.sweeps,
            valence_sum: measured.valence_sum,
        };
        for (face, &number) in (0..).zip(&face_numbers) {
            if !simplifier.is_live(face) {
                continue;
            }
            let corners = simplifier.surface.corners(face);
            let component = components[corners[0] as usize];
            let corners = corners.map(|v| vertices[v as usize]);
            if is_finished(component) {
                result.root_faces.push(RootFace { face: number, component, corners });
            } else {
                result.remainder.faces.push(corners);
                result.remainder.face_numbers.push(number);
            }
        }
        for (v, &vertex) in (0..).zip(&vertices) {
            if simplifier.surface.valence(v) == 0 {
                continue;
            }
            let (point, component) = (&simplifier.points[v as usize], components[v as usize]);
            let carried = &measured.carried[v as usize];
            if is_finished(component) {
                result.root_vertices.push(RootVertex {
                    vertex,
                    component,
                    position: point.position,
                    color: point.color,
                    last: carried.last,
                    normals: carried.normals,
                    stored: carried.stored,
                });
            } else {
                let samples = measured.samples.of(v);
                let quadric = measured.quadrics[v as usize];
                result.remainder.samples.extend(samples.iter().map(Sample::from));
                result.remainder.survivors.push(Survivor::new(
                    vertex,
                    component,
                    point,
                    quadric,
                    carried,
                    samples.len(),
                ));
            }
        }
        result
    }
}

/// Tells steps from totals.
struct Countdown<'a> {
    told: u64,
    progress: &'a mut dyn FnMut(u64),
}

impl Countdown<'_> {
    fn to(&mut self, total: u64) {
        (self.progress)(total.saturating_sub(self.told));
        self.told = self.told.max(total);
    }
}

impl Survivor {
    fn new(vertex: u32, component: u32, point: &Point, quadric: Quadric, carried: &Carried, samples: usize) -> Self {
        let Carried { sphere, normals, last, stored } = carried;
        let (normals_kind, cone) = match normals {
            Normals::Nothing => (0, [0.0; 5]),
            Normals::Within(WideCone { axis, sin, cos }) => (1, [axis.x, axis.y, axis.z, *sin, *cos]),
            Normals::Any => (2, [0.0; 5]),
        };
        Self {
            quadric,
            sphere: *sphere,
            cone,
            normals_kind,
            vertex,
            component,
            last: *last,
            sample_count: samples as u32,
            position: point.position,
            center: stored.center,
            radius: stored.radius.0,
            error: stored.error.0,
            axis: stored.cone.axis,
            half_angle: stored.cone.half_angle,
            color: point.color,
            padding: [0; 2],
        }
    }

    fn carried(&self) -> Carried {
        let [x, y, z, sin, cos] = self.cone;
        let normals = match self.normals_kind {
            0 => Normals::Nothing,
            1 => Normals::Within(WideCone { axis: DVec3::new(x, y, z), sin, cos }),
            _ => Normals::Any,
        };
        let stored = Bounds {
            center: self.center,
            radius: Magnitude(self.radius),
            error: Magnitude(self.error),
            cone: Cone { axis: self.axis, half_angle: self.half_angle },
        };
        Carried { sphere: self.sphere, normals, last: self.last, stored }
    }
}

/// Replaces vertex numbers by places in the list of all that occur, which it returns, ascending. O(faces + range of the
/// numbers / 64) where they are about as dense as in a chunk, else O(faces log faces).
fn localize(faces: &mut [[u32; 3]]) -> Vec<u32> {
    let corners = faces.as_flattened_mut();
    let (low, high) = corners.iter().fold((u32::MAX, 0), |(low, high), &v| (low.min(v), high.max(v)));
    if low > high {
        return Vec::new();
    }
    let words = (high - low) as usize / 64 + 1;
    if words > corners.len() {
        return localize_sparse(corners);
    }
    // A bit for each number that occurs, and how many occur before each word.
    let mut bits = vec![0u64; words];
    let place = |v: u32| ((v - low) as usize / 64, (v - low) % 64);
    for &v in corners.iter() {
        let (word, bit) = place(v);
        bits[word] |= 1 << bit;
    }
    let mut before = Vec::with_capacity(words);
    let mut vertices = Vec::with_capacity(corners.len() / 6 + 8);
    for (word, first) in bits.iter().zip((low..).step_by(64)) {
        before.push(vertices.len() as u32);
        let mut left = *word;
        while left != 0 {
            vertices.push(first + left.trailing_zeros());
            left &= left - 1;
        }
    }
    for v in corners {
        let (word, bit) = place(*v);
        *v = before[word] + (bits[word] & ((1 << bit) - 1)).count_ones();
    }
    vertices
}

/// The same for numbers that are far apart.
fn localize_sparse(corners: &mut [u32]) -> Vec<u32> {
    let mut vertices = corners.to_vec();
    vertices.sort_unstable();
    vertices.dedup();
    for v in corners {
        *v = vertices.binary_search(v).expect("it is one of them") as u32;
    }
    vertices
}

fn surface_of(vertex_count: usize, faces: &[[u32; 3]]) -> Surface {
    // No collapse undoes what a clean mesh promises.
    Surface::of_part(vertex_count, faces).expect("a part of a clean mesh is clean")
}

/// Adds the borders that show at this height: of an edge with a single face here and an end that is inside, there is no other
/// face elsewhere. Below, both ends were locked and the edge as it is now.
fn add_borders(quadrics: &mut [Quadric], surface: &Surface, points: &[Point], heights: &[u8], height: u8) {
    let shows_at = |a: u32, b: u32| heights[a as usize].min(heights[b as usize]);
    quadric::add_borders(quadrics, surface, points, |a, b| shows_at(a, b) == height);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_are_places_among_the_vertices() {
        let mut random = fastrand::Rng::with_seed(7);
        for (count, range) in [(0, 0..1), (1, 5..6), (3, 0..7), (500, 1000..1300), (500, 63..129), (200, 0..u32::MAX)] {
            let faces: Vec<[u32; 3]> = (0..count).map(|_| [(); 3].map(|()| random.u32(range.clone()))).collect();
            let mut expected = faces.as_flattened().to_vec();
            expected.sort_unstable();
            expected.dedup();
            let mut places = faces.clone();
            assert_eq!(localize(&mut places), expected, "{range:?}");
            let back: Vec<u32> = places.as_flattened().iter().map(|&place| expected[place as usize]).collect();
            assert_eq!(back, faces.as_flattened(), "{range:?}");
            let mut sparse = faces.clone();
            assert_eq!(localize_sparse(sparse.as_flattened_mut()), expected);
            assert_eq!(sparse, places);
        }
    }
}
