//! Well-behaved shapes.

use std::collections::HashMap;
use std::f64::consts::TAU;

use glam::DVec3;
use lodestream_server::mesh::TriMesh;

pub(super) fn mesh(positions: Vec<[f64; 3]>, faces: Vec<[u32; 3]>) -> TriMesh {
    TriMesh { positions, faces, colors: None }
}

/// Splits quads, counter-clockwise, along the diagonal from their first corner.
fn halves(quads: impl IntoIterator<Item = [u32; 4]>) -> Vec<[u32; 3]> {
    quads.into_iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]).collect()
}

/// Renumbers so that every vertex is used, in order of first use.
fn compact(mesh: TriMesh) -> TriMesh {
    let mut places = HashMap::new();
    let mut out = TriMesh::default();
    for face in mesh.faces {
        out.faces.push(face.map(|v| {
            *places.entry(v).or_insert_with(|| {
                out.positions.push(mesh.positions[v as usize]);
                out.positions.len() as u32 - 1
            })
        }));
    }
    out
}

/// No vertices, no faces.
pub fn empty() -> TriMesh {
    TriMesh::default()
}

/// 3 vertices, 1 face: the smallest mesh with a boundary.
pub fn single_triangle() -> TriMesh {
    mesh(vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], vec![[0, 1, 2]])
}

/// 4 vertices, 4 faces: the smallest closed mesh.
pub fn tetrahedron() -> TriMesh {
    mesh(
        vec![[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]],
        vec![[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]],
    )
}

/// 8 vertices, 12 faces, closed: from -1 to 1.
pub fn cube() -> TriMesh {
    let corner = |i: usize| [0, 1, 2].map(|k| if i >> k & 1 == 1 { 1.0 } else { -1.0 });
    let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    mesh((0..8).map(corner).collect(), halves(quads))
}

/// (w + 1)(h + 1) vertices, 2 w h faces: an open sheet over w x h unit cells of the xz plane, with a bump in y.
///
/// One boundary of 2 (w + h) edges.
pub fn grid(w: u32, h: u32) -> TriMesh {
    let height = |x: f64, z: f64| {
        let (u, v) = (x / f64::from(w.max(1)) - 0.5, z / f64::from(h.max(1)) - 0.5);
        0.2 * f64::from(w.min(h)) * (-12.0 * (u * u + v * v)).exp()
    };
    let rows = (0..=h).flat_map(|z| (0..=w).map(move |x| (f64::from(x), f64::from(z))));
    let positions = rows.map(|(x, z)| [x, height(x, z), z]).collect();
    let at = |x: u32, z: u32| z * (w + 1) + x;
    let cells = (0..h).flat_map(|z| (0..w).map(move |x| (x, z)));
    mesh(positions, halves(cells.map(|(x, z)| [at(x, z), at(x, z + 1), at(x + 1, z + 1), at(x + 1, z)])))
}

/// A flat sheet with n x n square holes, cells of edge 1 / `resolution`.
///
/// The sheet has (2n + 1)^2 squares of `resolution`^2 cells each; those with both numbers odd are missing. One outer
/// boundary and n^2 inner ones; 2 r^2 ((2n + 1)^2 - n^2) faces; Euler number 1 - n^2.
pub fn grid_with_holes(n: u32, resolution: u32) -> TriMesh {
    let side = (2 * n + 1) * resolution;
    let mut sheet = grid(side, side);
    for position in &mut sheet.positions {
        *position = [position[0] / f64::from(resolution), 0.0, position[2] / f64::from(resolution)];
    }
    let hole = |cell: u32| (cell / resolution) % 2 == 1;
    let mut cell = 0;
    sheet.faces.retain(|_| {
        let (x, z) = ((cell / 2) % side, cell / 2 / side);
        cell += 1;
        !(hole(x) && hole(z))
    });
    compact(sheet)
}

/// 1 + rings * spokes vertices, spokes (2 rings - 1) faces: a flat disk of radius 1, one boundary of `spokes` edges.
///
/// `spokes` is at least 3, `rings` at least 1.
pub fn disk(spokes: u32, rings: u32) -> TriMesh {
    let mut disk = annulus(spokes, rings.max(1) - 1);
    let scale = f64::from(rings.max(1));
    let inner = disk.positions.len() as u32;
    for (i, position) in disk.positions.iter_mut().enumerate() {
        let ring = (i as u32 / spokes) as f64 + 1.0;
        let direction = DVec3::from_array(*position).normalize();
        *position = (direction * (ring / scale)).to_array();
    }
    disk.positions.push([0.0; 3]);
    disk.faces.extend((0..spokes).map(|s| [inner, (s + 1) % spokes, s]));
    disk
}

/// spokes (rings + 1) vertices, 2 spokes rings faces: flat, from radius 1 to 2, two boundaries of `spokes` edges.
pub fn annulus(spokes: u32, rings: u32) -> TriMesh {
    let point = |ring: u32, s: u32| {
        let (radius, angle) = (1.0 + f64::from(ring) / f64::from(rings.max(1)), f64::from(s) * TAU / f64::from(spokes));
        [radius * angle.cos(), 0.0, radius * angle.sin()]
    };
    let positions = (0..=rings).flat_map(|r| (0..spokes).map(move |s| point(r, s))).collect();
    mesh(positions, ring_faces(spokes, rings))
}

/// Quads between closed rings of `around` vertices, ring after ring.
fn ring_faces(around: u32, rings: u32) -> Vec<[u32; 3]> {
    let at = move |r: u32, s: u32| r * around + s % around;
    let cells = (0..rings).flat_map(|r| (0..around).map(move |s| (r, s)));
    halves(cells.map(|(r, s)| [at(r, s), at(r, s + 1), at(r + 1, s + 1), at(r + 1, s)]))
}

/// u (v + 1) vertices, 2 u v faces: radius 1, height 2 along y, two boundaries of `u` edges. `u` is at least 3.
pub fn cylinder_open(u: u32, v: u32) -> TriMesh {
    let point = |ring: u32, s: u32| {
        let angle = f64::from(s) * TAU / f64::from(u);
        // Downward, so that rings follow each other as the faces need.
        [angle.cos(), 1.0 - 2.0 * f64::from(ring) / f64::from(v.max(1)), angle.sin()]
    };
    mesh((0..=v).flat_map(|r| (0..u).map(move |s| point(r, s))).collect(), ring_faces(u, v))
}

/// u v vertices, 2 u v faces, closed, genus 1: radii 1 and 0.4, axis y. `u` and `v` are at least 3.
pub fn torus(u: u32, v: u32) -> TriMesh {
    let point = |i: u32, j: u32| {
        let (a, b) = (f64::from(i) * TAU / f64::from(u), f64::from(j) * TAU / f64::from(v));
        let radius = 1.0 + 0.4 * b.cos();
        [radius * a.cos(), 0.4 * b.sin(), radius * a.sin()]
    };
    let positions = (0..u).flat_map(|i| (0..v).map(move |j| point(i, j))).collect();
    let at = |i: u32, j: u32| (i % u) * v + j % v;
    let cells = (0..u).flat_map(|i| (0..v).map(move |j| (i, j)));
    mesh(positions, halves(cells.map(|(i, j)| [at(i, j), at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)])))
}

/// [`genus`] of 2.
pub fn double_torus(resolution: u32) -> TriMesh {
    genus(2, resolution)
}

/// Closed, genus n: a plate of 2n + 1 by 3 by 1 unit boxes with n square holes through it, cells of edge
/// 1 / `resolution`.
///
/// 4 r^2 (9 n + 7) faces (top and bottom 5n + 3 squares each, outside 4n + 8, holes 4n; two triangles a cell), and
/// V = F / 2 + 2 - 2n.
pub fn genus(n: u32, resolution: u32) -> TriMesh {
    let r = resolution as i32;
    let size = [(2 * n as i32 + 1) * r, 3 * r, r];
    let solid = |c: [i32; 3]| {
        let inside = (0..3).all(|k| (0..size[k]).contains(&c[k]));
        inside && !((c[0] / r) % 2 == 1 && c[1] / r == 1)
    };
    let mut places: HashMap<[i32; 3], u32> = HashMap::new();
    let mut positions = Vec::new();
    let mut quads = Vec::new();
    for (z, y, x) in (0..size[2]).flat_map(|z| (0..size[1]).flat_map(move |y| (0..size[0]).map(move |x| (z, y, x)))) {
        let cell = [x, y, z];
        if !solid(cell) {
            continue;
        }
        for (axis, high) in (0..3).flat_map(|axis| [(axis, 0), (axis, 1)]) {
            let mut beyond = cell;
            beyond[axis] += 2 * high - 1;
            if solid(beyond) {
                continue;
            }
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            let mut ring = [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(du, dv)| {
                let mut corner = cell;
                corner[axis] += high;
                corner[u] += du;
                corner[v] += dv;
                *places.entry(corner).or_insert_with(|| {
                    positions.push(corner.map(|c| f64::from(c) / f64::from(r)));
                    positions.len() as u32 - 1
                })
            });
            if high == 0 {
                ring.reverse();
            }
            quads.push(ring);
        }
    }
    mesh(positions, halves(quads))
}

/// 10 * 4^level + 2 vertices, 20 * 4^level faces, closed, genus 0, radius 1.
pub fn icosphere(level: u32) -> TriMesh {
    sphere(1 << level)
}

/// 10 f^2 + 2 vertices, 20 f^2 faces: an icosahedron with edges cut into f parts, pushed out to radius 1.
pub fn sphere(f: u32) -> TriMesh {
    let f = f.max(1);
    let (corners, triangles) = icosahedron();
    // A point is known by its weights on the corners, in f-ths.
    let mut places: HashMap<[(u32, u32); 3], u32> = HashMap::new();
    let mut out = TriMesh::default();
    for triangle in triangles {
        let mut at = |i: u32, j: u32| {
            let mut key = [(triangle[0], f - i - j), (triangle[1], i), (triangle[2], j)];
            for part in &mut key {
                if part.1 == 0 {
                    *part = (u32::MAX, 0);
                }
            }
            key.sort_unstable();
            *places.entry(key).or_insert_with(|| {
                let parts = key.iter().filter(|part| part.1 > 0);
                let sum: DVec3 = parts.map(|&(corner, weight)| corners[corner as usize] * f64::from(weight)).sum();
                out.positions.push(sum.normalize().to_array());
                out.positions.len() as u32 - 1
            })
        };
        for i in 0..f {
            for j in 0..f - i {
                out.faces.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
                if i + j + 1 < f {
                    out.faces.push([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
                }
            }
        }
    }
    out
}

fn icosahedron() -> ([DVec3; 12], [[u32; 3]; 20]) {
    let g = (1.0 + 5f64.sqrt()) / 2.0;
    let corners = [
        [-1.0, g, 0.0],
        [1.0, g, 0.0],
        [-1.0, -g, 0.0],
        [1.0, -g, 0.0],
        [0.0, -1.0, g],
        [0.0, 1.0, g],
        [0.0, -1.0, -g],
        [0.0, 1.0, -g],
        [g, 0.0, -1.0],
        [g, 0.0, 1.0],
        [-g, 0.0, -1.0],
        [-g, 0.0, 1.0],
    ];
    #[rustfmt::skip]
    let triangles = [
        [0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11],
        [1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6], [7, 1, 8],
        [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9],
        [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1],
    ];
    (corners.map(DVec3::from_array), triangles)
}
