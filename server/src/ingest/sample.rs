//! The generated scan: a block of limestone with a large ammonite worked out of it, in any number of triangles.
//!
//! It stands in for a real scan wherever none may be shipped: the first model of a newcomer, benchmarks, load tests.
//! The shape is a signed field (`sculpture`, `fossil`), its surface is meshed on a sparse lattice whose step is found
//! from the wanted count (`contour`), evened out, and then each vertex gets fine relief and a colour (`paint`).
//! Only `+ - * /`, `sqrt` and integers are used (`math`), so the bytes are the same on every machine.

mod contour;
mod fossil;
mod math;
mod paint;
mod sculpture;

#[cfg(test)]
mod tests;

use std::num::NonZero;
use std::thread;

use glam::{DVec3, Vec3};

use self::contour::{Contour, Lattice, QuadMesh};
use self::paint::Painter;
use self::sculpture::{HALF_EXTENT, Sculpture};
use crate::mesh::TriMesh;

/// Fewest triangles that [`generate`] makes.
pub const MIN_TRIANGLES: usize = 1_000;
/// Most triangles that [`generate`] makes; also keeps its indices well inside 32 bits.
pub const MAX_TRIANGLES: usize = 200_000_000;

/// What to generate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SampleOptions {
    /// Wanted triangles, met within 1 %; clamped to [`MIN_TRIANGLES`]`..=`[`MAX_TRIANGLES`].
    pub triangles: usize,
    /// Which block: breaks, small fossils, relief and colour differ from seed to seed, the large fossils keep their
    /// places.
    pub seed: u64,
    /// Scanner noise along the normal: standard deviation in units of the mean edge. 0 is clean; real scans have 0.05
    /// to 0.3.
    pub noise: f64,
}

impl Default for SampleOptions {
    fn default() -> Self {
        Self { triangles: 1_000_000, seed: 0, noise: 0.0 }
    }
}

/// The sample without scanner noise; see [`generate_with`].
pub fn generate(triangles: usize, seed: u64) -> TriMesh {
    generate_with(&SampleOptions { triangles, seed, noise: 0.0 })
}

/// Generates the scan: closed, every directed edge once, each vertex a single fan, a colour per vertex, faces
/// counter-clockwise from outside.
///
/// About 2.4 x 2.1 x 1.0 model units around the origin, y up, with the large ammonite facing +z. The surface is
/// one piece except for rare crumbs of stone. Nine in ten triangles are within a
/// factor of five of each other in area, and under 2 % are slivers.
///
/// Time and memory go with the number of triangles: two to three microseconds of one core each, spread over all cores,
/// and a peak of about twice the mesh returned (60 bytes a triangle). The result depends on `options` alone, not on the
/// machine or its cores.
pub fn generate_with(options: &SampleOptions) -> TriMesh {
    let wanted = options.triangles.clamp(MIN_TRIANGLES, MAX_TRIANGLES);
    let threads = thread::available_parallelism().map_or(1, NonZero::get);
    let sculpture = Sculpture::new(options.seed);
    let field = |p: DVec3| sculpture.distance(p);
    let (contour, step) = fit(wanted, &field, threads);
    let mut mesh = contour.build(&field);
    for _ in 0..RELAXATIONS {
        relax(&mut mesh);
    }
    let normals = vertex_normals(&mesh);
    let colors = finish(&mut mesh.positions, &normals, &sculpture, step, options, threads);
    TriMesh { faces: triangulate(&mesh), positions: mesh.positions, colors: Some(colors) }
}

/// Rounds of evening out; more only costs time.
const RELAXATIONS: usize = 3;
/// Share by which the count may miss.
const TOLERANCE: f64 = 0.008;

/// Finds the lattice step that gives `wanted` triangles, and scans with it.
///
/// Triangles times step^2 is the area times a constant and falls a little with the step, nearly in a line: two coarse
/// scans tell the fine step. At small counts the number jumps from step to step, and more are tried.
fn fit<F: Fn(DVec3) -> f64 + Sync>(wanted: usize, field: &F, threads: usize) -> (Contour, f64) {
    // (step, triangles * step^2) of the last two scans; a surface of area A gives about 4 A, here about 42.
    let mut seen = [(0.0, 43.0); 2];
    let mut best: Option<(f64, Contour, f64)> = None;
    for attempt in 0..40 {
        let goal = match attempt {
            0 => wanted.min(COARSE / 4),
            1 => wanted.min(COARSE),
            _ => wanted,
        };
        let [(s0, k0), (s1, k1)] = seen;
        let slope = if attempt >= 2 && wanted > 2 * COARSE && s0 != s1 { (k1 - k0) / (s1 - s0) } else { 0.0 };
        let mut step = (k1 / goal as f64).sqrt();
        for _ in 0..3 {
            step = ((k1 + slope * (step - s1)) / goal as f64).sqrt();
        }
        if attempt > 4 {
            // A change too small to move the count would repeat itself for ever: nudge it.
            step *= 1.0 + 0.003 * (f64::from(attempt % 7) - 3.0);
        }
        let contour = Contour::scan(lattice(step), field, threads);
        let count = contour.triangle_count();
        seen = [seen[1], (step, count as f64 * step * step)];
        let miss = (count as f64 / wanted as f64 - 1.0).abs();
        if best.as_ref().is_none_or(|(least, ..)| miss < *least) {
            best = Some((miss, contour, step));
        }
        if miss <= TOLERANCE {
            break;
        }
    }
    let (_, contour, step) = best.expect("the first attempt is kept");
    (contour, step)
}

/// Triangles of the coarse scan that finds the step of a finer one.
const COARSE: usize = 120_000;

fn lattice(step: f64) -> Lattice {
    let half = DVec3::splat(HALF_EXTENT);
    Lattice::covering(-half, half, step)
}

/// Moves each vertex half-way to the middle of its neighbours, within the surface.
fn relax(mesh: &mut QuadMesh) {
    #[derive(Clone, Copy, Default)]
    struct Sum {
        toward: Vec3,
        normal: Vec3,
        neighbours: f32,
    }
    let mut sums = vec![Sum::default(); mesh.positions.len()];
    for quad in &mesh.quads {
        let p = quad.map(|v| DVec3::from_array(mesh.positions[v as usize]));
        let edges: [Vec3; 4] = std::array::from_fn(|i| (p[(i + 1) % 4] - p[i]).as_vec3());
        let normal = (edges[0] + edges[1]).cross(edges[1] + edges[2]);
        for i in 0..4 {
            let sum = &mut sums[quad[i] as usize];
            sum.toward += edges[i] - edges[(i + 3) % 4];
            sum.normal += normal;
            sum.neighbours += 2.0;
        }
    }
    for (position, sum) in mesh.positions.iter_mut().zip(&sums) {
        let shift = sum.toward / sum.neighbours.max(1.0);
        let normal = sum.normal.normalize_or_zero();
        let along = (shift - normal * normal.dot(shift)) * 0.5;
        *position = (DVec3::from_array(*position) + along.as_dvec3()).to_array();
    }
}

fn vertex_normals(mesh: &QuadMesh) -> Vec<Vec3> {
    let mut normals = vec![Vec3::ZERO; mesh.positions.len()];
    for quad in &mesh.quads {
        let p = quad.map(|v| DVec3::from_array(mesh.positions[v as usize]));
        let normal = (p[2] - p[0]).as_vec3().cross((p[3] - p[1]).as_vec3());
        for v in quad {
            normals[*v as usize] += normal;
        }
    }
    normals.iter_mut().for_each(|n| *n = n.normalize_or_zero());
    normals
}

/// Puts each vertex back on the surface, adds relief and noise, and returns the colours.
fn finish(
    positions: &mut [[f64; 3]],
    normals: &[Vec3],
    sculpture: &Sculpture,
    step: f64,
    options: &SampleOptions,
    threads: usize,
) -> Vec<[u8; 3]> {
    let painter = Painter::new(sculpture, step);
    let mut colors = vec![[0; 3]; positions.len()];
    let chunk = positions.len().div_ceil(threads).max(1);
    let seed = sculpture.seed() ^ 0x5ca4;
    let noise_height = options.noise * step;
    thread::scope(|scope| {
        let parts = positions.chunks_mut(chunk).zip(normals.chunks(chunk)).zip(colors.chunks_mut(chunk));
        for (part, ((positions, normals), colors)) in parts.enumerate() {
            let painter = &painter;
            scope.spawn(move || {
                for (i, ((position, normal), color)) in positions.iter_mut().zip(normals).zip(colors).enumerate() {
                    let n = normal.as_dvec3();
                    let mut p = DVec3::from_array(*position);
                    let probe = sculpture.probe(p);
                    p -= n * probe.distance.clamp(-step * 0.5, step * 0.5);
                    let touch = painter.touch(p, n, &probe);
                    let noise = noise_height * math::gaussian((part * chunk + i) as i64, seed);
                    *position = (p + n * (touch.height + noise)).to_array();
                    *color = touch.color;
                }
            });
        }
    });
    colors
}

/// Cuts each quad along its shorter diagonal.
fn triangulate(mesh: &QuadMesh) -> Vec<[u32; 3]> {
    let length = |a: u32, b: u32| {
        (DVec3::from_array(mesh.positions[a as usize]) - DVec3::from_array(mesh.positions[b as usize])).length_squared()
    };
    let mut faces = Vec::with_capacity(2 * mesh.quads.len());
    for &[a, b, c, d] in &mesh.quads {
        if length(a, c) <= length(b, d) {
            faces.extend([[a, b, c], [a, c, d]]);
        } else {
            faces.extend([[a, b, d], [b, c, d]]);
        }
    }
    faces
}
