//! Meshes with something special: colours, many parts, slivers, and the ways of not being clean.

use std::f64::consts::TAU;

use glam::DVec3;
use lodestream_server::mesh::TriMesh;

use super::shapes::{grid, icosphere, mesh, single_triangle, sphere, tetrahedron};

/// `n` separate pieces of varied size and place: tetrahedra, spheres of 20 or 80 faces, single triangles and quads.
///
/// They may overlap in space and share no vertex.
pub fn many_components(n: usize, seed: u64) -> TriMesh {
    let mut random = fastrand::Rng::with_seed(seed);
    let mut out = TriMesh::default();
    for _ in 0..n {
        let piece = match random.u32(0..8) {
            0 | 1 => tetrahedron(),
            2 => icosphere(0),
            3 => icosphere(1),
            4 | 5 => single_triangle(),
            _ => grid(1, 1),
        };
        // Sizes over three decades, as loose crumbs in a scan have them.
        let size = 10f64.powf(-3.0 * random.f64());
        let at = DVec3::new(random.f64(), random.f64(), random.f64()) * 20.0;
        let base = out.positions.len() as u32;
        out.positions.extend(piece.positions.iter().map(|p| (at + DVec3::from_array(*p) * size).to_array()));
        out.faces.extend(piece.faces.iter().map(|f| f.map(|v| v + base)));
    }
    out
}

/// A body and `n` parts around it, as a scan of a site with debris has them: three quarters tetrahedra, the others spheres of 20
/// and 80 faces, of sizes over two decades, most of them small, thicker near the body. No two share a vertex.
pub fn debris(n: usize, seed: u64) -> TriMesh {
    let mut random = fastrand::Rng::with_seed(seed);
    let mut out = noisy_sphere(5000, seed);
    let parts = [tetrahedron(), icosphere(0), icosphere(1)];
    for _ in 0..n {
        let part = &parts[match random.u32(0..20) {
            0..15 => 0,
            15..19 => 1,
            _ => 2,
        }];
        let size = 0.12 * 10f64.powf(-2.0 * random.f64().sqrt());
        let direction = DVec3::new(random.f64() - 0.5, random.f64() - 0.5, random.f64() - 0.5).normalize_or(DVec3::Y);
        let at = direction * (1.4 + 4.0 * random.f64() * random.f64());
        let turn = glam::DQuat::from_axis_angle(direction, random.f64() * TAU);
        let base = out.positions.len() as u32;
        out.positions.extend(part.positions.iter().map(|p| (at + turn * DVec3::from_array(*p) * size).to_array()));
        out.faces.extend(part.faces.iter().map(|f| f.map(|v| v + base)));
    }
    out
}

/// A sphere of about `triangles` faces (20 f^2 for the nearest f) with bumps of all sizes and scanner noise.
pub fn noisy_sphere(triangles: usize, seed: u64) -> TriMesh {
    let f = ((triangles as f64 / 20.0).sqrt().round() as u32).max(1);
    let mut out = sphere(f);
    let mut random = fastrand::Rng::with_seed(seed);
    let waves: Vec<(DVec3, f64)> = (0..24)
        .map(|i| {
            let direction = DVec3::new(random.f64() - 0.5, random.f64() - 0.5, random.f64() - 0.5);
            (direction * (6.0 * 1.25f64.powi(i)), random.f64() * TAU)
        })
        .collect();
    let edge = 1.2 / f64::from(f);
    for position in &mut out.positions {
        let p = DVec3::from_array(*position);
        let bumps: f64 = waves.iter().map(|(k, phase)| (p.dot(*k) + phase).sin() * 0.12 / (1.0 + k.length())).sum();
        let noise = (random.f64() + random.f64() - 1.0) * 0.1 * edge;
        *position = (p * (1.0 + bumps + noise)).to_array();
    }
    out
}

/// [`icosphere`] with colours: a smooth gradient on the upper half, a checker with sharp edges on the lower one.
pub fn colored_sphere(level: u32) -> TriMesh {
    let mut out = icosphere(level);
    let color = |p: &[f64; 3]| {
        if p[1] > 0.0 {
            return p.map(|c| (127.5 + 127.5 * c).round() as u8);
        }
        let square = (p[0] * 6.0).floor() as i64 + (p[2] * 6.0).floor() as i64;
        if square.rem_euclid(2) == 0 { [250, 240, 20] } else { [20, 30, 120] }
    };
    out.colors = Some(out.positions.iter().map(color).collect());
    out
}

/// (n + 1)^2 vertices, 2 n^2 faces: perfectly flat, all its detail is colour (rings that grow finer, a checker, and a
/// straight edge between them).
pub fn painted_plane(n: u32) -> TriMesh {
    let mut out = grid(n, n);
    let mut colors = Vec::with_capacity(out.positions.len());
    for position in &mut out.positions {
        position[1] = 0.0;
        let (u, v) = (position[0] / f64::from(n.max(1)), position[2] / f64::from(n.max(1)));
        let ring = (0.5 + 0.5 * (90.0 * (u * u + v * v)).cos()) * 255.0;
        let checker = ((u * 16.0).floor() + (v * 16.0).floor()) as i64 % 2 == 0;
        colors.push(match (u + v > 1.0, checker) {
            (false, _) => [ring.round() as u8, 60, 255 - ring.round() as u8],
            (true, true) => [240, 240, 240],
            (true, false) => [200, 20, 20],
        });
    }
    out.colors = Some(colors);
    out
}

/// 2 (n + 1) vertices, 2 n faces: an open strip whose triangles are a thousand times longer than wide.
pub fn sliver_strip(n: u32) -> TriMesh {
    let mut out = grid(n, 1);
    for position in &mut out.positions {
        *position = [position[0] * 1e-3, 0.0, position[2]];
    }
    out
}

/// `icosphere(3)` (642 vertices, 1280 faces) in which some twenty edges have both ends at one position: clean, closed,
/// with faces of no area.
pub fn with_zero_area_faces(seed: u64) -> TriMesh {
    let mut out = icosphere(3);
    let mut random = fastrand::Rng::with_seed(seed);
    for _ in 0..20 {
        let [a, b, _] = out.faces[random.usize(..out.faces.len())];
        out.positions[a as usize] = out.positions[b as usize];
    }
    out
}

/// 5 vertices, 2 faces that share only vertex 0. Not clean: that vertex has two fans.
pub fn bow_tie() -> TriMesh {
    mesh(
        vec![[0.0, 0.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]],
        vec![[0, 1, 2], [0, 3, 4]],
    )
}

/// Two sheets of 4 x 4 cells side by side with a seam: the five positions at x = 4 occur twice.
///
/// 50 vertices, 64 faces. Clean as it stands (two components); welding equal positions gives one sheet of 8 x 4.
pub fn crack() -> TriMesh {
    let whole = grid(8, 4);
    let at = |x: u32, z: u32| z * 9 + x;
    let mut out = TriMesh::default();
    for first in [0, 4] {
        let base = out.positions.len() as u32;
        let half = grid(4, 4);
        for z in 0..=4 {
            out.positions.extend((first..=first + 4).map(|x| whole.positions[at(x, z) as usize]));
        }
        out.faces.extend(half.faces.iter().map(|f| f.map(|v| v + base)));
    }
    out
}

/// 5 vertices, 3 faces that share edge 0-1. Not clean: one direction of the edge occurs twice.
pub fn three_on_an_edge() -> TriMesh {
    mesh(
        vec![[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]],
        vec![[0, 1, 2], [1, 0, 3], [0, 1, 4]],
    )
}

/// 48 vertices, 48 faces: a band with one half turn. Not clean: no choice of orientation fits all faces, and as listed
/// the edge between the last two columns runs the same way twice.
pub fn moebius() -> TriMesh {
    const AROUND: u32 = 24;
    let point = |i: u32, side: f64| {
        let angle = f64::from(i) * TAU / f64::from(AROUND);
        let radius = 1.0 + 0.3 * side * (angle / 2.0).cos();
        [radius * angle.cos(), 0.3 * side * (angle / 2.0).sin(), radius * angle.sin()]
    };
    let positions = (0..AROUND).flat_map(|i| [point(i, -1.0), point(i, 1.0)]).collect();
    let faces = (0..AROUND).flat_map(|i| {
        let (a, b) = (2 * i, 2 * i + 1);
        // The half turn: the last column meets the first upside down.
        let (c, d) = if i + 1 < AROUND { (a + 2, b + 2) } else { (1, 0) };
        [[a, b, d], [a, d, c]]
    });
    mesh(positions, faces.collect())
}
