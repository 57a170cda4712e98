//! The `visual` precision: vertices slide along the surface to where their coordinates are cheap.
//!
//! A vertex is a sample of the surface, and which sample it is can be seen far less than that it lies on the surface. So each
//! vertex is moved within the faces around it: across the dominant axis of its normal to the nearest multiples of a step, and
//! along that axis to the height that the surface has there. Two coordinates in three then lose their low bits
//! (the codec sends them in steps), while the shape stays what it was. Faces keep their sides: a move that would turn a face
//! too far from where it faced is not made.
//!
//! Only vertices whose faces all belong to one chunk move. Chunks share no such vertex and read no such vertex of each other,
//! so each can be resampled by itself, and the result depends on the division into chunks alone.

use std::num::NonZeroU16;

use super::local::Local;
use super::runs::in_order;
use crate::ingest::chunks::VertexTable;
use crate::ingest::spill::SpillError;

/// Whether vertices may slide along the surface.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// Vertices stay where they are, rounded to the lattice.
    #[default]
    Exact,
    /// Most vertices are moved along the surface, by a sixteenth of a mean edge across each axis at most, to where they take
    /// fewer bits.
    Visual,
}

/// What resampling did.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Resampled {
    /// Step across the normal, in lattice steps; `None` if all vertices stayed for the edges being too short.
    pub step: Option<NonZeroU16>,
    /// Vertices on the coarse grid.
    pub moved: u64,
    /// Largest distance that a vertex moved, in lattice steps.
    pub largest: f64,
}

/// Most steps of the lattice to a step across: it has 16 bits.
const MAX_STEP: u64 = u16::MAX as u64;
/// Chunks whose moves are held back until no other chunk of them is looked at.
const CHUNKS_AT_ONCE: usize = 16;
/// Steps to a mean edge of the mesh.
const EDGE_STEPS: u64 = 8;
/// Steps to a mean edge around a vertex that moves, at least.
const LOCAL_EDGE_STEPS: f64 = 5.0;
/// Square of the least cosine between where a face faced and where it faces: 25 degrees.
const LEAST_COSINE_SQUARED: f64 = 0.81;

type Vec3 = [i64; 3];

fn sub(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn normal([a, b, c]: [Vec3; 3]) -> Vec3 {
    cross(sub(b, a), sub(c, a))
}

/// A chunk's vertices and faces as they are resampled.
struct Patch<'a> {
    faces: &'a [[u32; 3]],
    /// As they were.
    before: Vec<Vec3>,
    now: Vec<Vec3>,
    max: i64,
}

impl Patch<'_> {
    fn corners(&self, of: &[Vec3], face: u32) -> [Vec3; 3] {
        self.faces[face as usize].map(|v| of[v as usize])
    }

    /// Where the vertex goes on a grid of `step`: a point of the faces around it. `None` if they are no height field along
    /// the axis, or so steep there that the height would change by more than a step.
    fn place(&self, v: u32, around: &[u32], step: i64) -> Option<Vec3> {
        let at = self.before[v as usize];
        let sum = around.iter().fold([0; 3], |sum, &face| {
            let n = normal(self.corners(&self.before, face));
            [sum[0] + n[0], sum[1] + n[1], sum[2] + n[2]]
        });
        let h = (0..3).max_by_key(|&k| (sum[k].unsigned_abs(), 2 - k)).expect("three axes");
        let (u, w) = ((h + 1) % 3, (h + 2) % 3);
        let round = |x: i64| (x + step / 2).div_euclid(step) * step;
        let (x, y) = (round(at[u]), round(at[w]));
        if x > self.max || y > self.max {
            return None;
        }
        let side = sum[h].signum();
        let mut height = None;
        for &face in around {
            let corners = self.corners(&self.before, face);
            let n = normal(corners);
            if n[h] * side <= 0 {
                return None;
            }
            let is_inside = (0..3).all(|k| {
                let (a, b) = (corners[k], corners[(k + 1) % 3]);
                ((b[u] - a[u]) * (y - a[w]) - (b[w] - a[w]) * (x - a[u])) * side >= 0
            });
            if is_inside && height.is_none() {
                let fall = n[u] * (x - at[u]) + n[w] * (y - at[w]);
                // Rounded to nearest.
                let drop = (2 * fall + n[h].abs() * fall.signum()) / (2 * n[h]);
                height = Some(at[h] - drop);
            }
        }
        let height = height.filter(|z| (0..=self.max).contains(z) && (z - at[h]).abs() <= step)?;
        let mut to = [0; 3];
        (to[u], to[w], to[h]) = (x, y, height);
        Some(to)
    }

    /// Whether all faces around a vertex would still face where they faced.
    fn keeps_sides(&self, v: u32, to: Vec3, around: &[u32]) -> bool {
        around.iter().all(|&face| {
            let was = normal(self.corners(&self.before, face)).map(|x| x as f64);
            let is = normal(self.faces[face as usize].map(|w| if w == v { to } else { self.now[w as usize] }));
            let is = is.map(|x| x as f64);
            let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
            let along = dot(was, is);
            along > 0.0 && along * along >= LEAST_COSINE_SQUARED * dot(was, was) * dot(is, is)
        })
    }
}

fn squared(d: Vec3) -> i64 {
    d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
}

fn length(d: Vec3) -> f64 {
    (squared(d) as f64).sqrt()
}

/// What became of a chunk: the vertices that moved, where to, and the square of the longest way.
struct Moved {
    places: Vec<(u32, [i32; 3])>,
    largest_squared: i64,
}

/// Moves the vertices of a chunk, in the order of their numbers. O(corners).
fn resample_chunk(local: &Local, faces: &[[u32; 3]], vertices: &VertexTable, step: i64, max: i32) -> Moved {
    let before: Vec<Vec3> = local.vertices().map(|v| vertices.position(v).map(i64::from)).collect();
    let mut starts = vec![0u32; local.count() + 1];
    faces.as_flattened().iter().for_each(|&v| starts[v as usize + 1] += 1);
    (1..starts.len()).for_each(|v| starts[v] += starts[v - 1]);
    let mut next = starts.clone();
    let mut around = vec![0u32; faces.len() * 3];
    for (face, corners) in (0..).zip(faces) {
        for &v in corners {
            around[next[v as usize] as usize] = face;
            next[v as usize] += 1;
        }
    }
    let mut patch = Patch { faces, now: before.clone(), before, max: max.into() };
    let mut moved = Moved { places: Vec::new(), largest_squared: 0 };
    for v in 0..local.count() as u32 {
        let vertex = local.vertex(v);
        if vertices.height(vertex) > 0 || vertices.is_boundary(vertex) {
            continue;
        }
        let around = &around[starts[v as usize] as usize..starts[v as usize + 1] as usize];
        let at = patch.before[v as usize];
        let spokes = |&face: &u32| patch.corners(&patch.before, face).map(|w| length(sub(w, at))).iter().sum::<f64>();
        let mean_spoke = around.iter().map(spokes).sum::<f64>() / (2 * around.len()) as f64;
        if mean_spoke < LOCAL_EDGE_STEPS * step as f64 {
            continue;
        }
        let Some(to) = patch.place(v, around, step).filter(|&to| patch.keeps_sides(v, to, around)) else { continue };
        moved.largest_squared = moved.largest_squared.max(squared(sub(to, at)));
        moved.places.push((vertex, to.map(|x| x as i32)));
        patch.now[v as usize] = to;
    }
    moved
}

/// Resamples the vertices. `chunk_of` gives the faces of a chunk, their corners as places in its list of vertices.
///
/// Takes two passes over the faces, and beside the table 16 bytes for each vertex of a chunk, chunk after chunk.
pub(super) fn resample(
    vertices: &mut VertexTable,
    chunk_count: usize,
    max: i32,
    chunk_of: impl Fn(usize) -> Result<(Local, Vec<[u32; 3]>), SpillError> + Sync,
) -> Result<Resampled, SpillError> {
    let (mut sum, mut count) = (0.0, 0);
    in_order(
        chunk_count,
        |chunk| {
            let (local, faces) = chunk_of(chunk)?;
            let at = |v: u32| vertices.position(local.vertex(v)).map(i64::from);
            let edges = faces.iter().flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]);
            Ok((edges.map(|edge| length(sub(at(edge[0]), at(edge[1])))).sum::<f64>(), 3 * faces.len() as u64))
        },
        |_, (part, edges)| {
            sum += part;
            count += edges;
            Ok(())
        },
    )?;
    let step = if count == 0 { 0 } else { (sum / (count * EDGE_STEPS) as f64) as u64 };
    let Some(step) = NonZeroU16::new(step.min(MAX_STEP) as u16).filter(|step| step.get() > 1) else {
        return Ok(Resampled::default());
    };
    let mut done = Resampled { step: Some(step), ..Resampled::default() };
    for first in (0..chunk_count).step_by(CHUNKS_AT_ONCE) {
        let mut moved = Vec::new();
        in_order(
            CHUNKS_AT_ONCE.min(chunk_count - first),
            |chunk| {
                let (local, faces) = chunk_of(first + chunk)?;
                Ok(resample_chunk(&local, &faces, vertices, step.get().into(), max))
            },
            |_, part| {
                moved.push(part);
                Ok(())
            },
        )?;
        for Moved { places, largest_squared } in moved {
            done.moved += places.len() as u64;
            done.largest = done.largest.max((largest_squared as f64).sqrt());
            places.into_iter().for_each(|(v, position)| vertices.set_position(v, position));
        }
    }
    Ok(done)
}
