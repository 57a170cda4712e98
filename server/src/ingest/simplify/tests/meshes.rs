//! Small generated meshes, and real ones from the folder that `LODESTREAM_MESHES` names.

use std::{collections::HashMap, path::Path};

use crate::mesh::TriMesh;

fn mesh(positions: Vec<[f64; 3]>, faces: Vec<[u32; 3]>) -> TriMesh {
    TriMesh { positions, faces, colors: None }
}

pub(super) fn triangle() -> TriMesh {
    mesh(vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], vec![[0, 1, 2]])
}

/// A sphere of 20 * 4^levels faces.
pub(super) fn icosphere(levels: u32) -> TriMesh {
    let g = (1.0 + 5f64.sqrt()) / 2.0;
    let mut positions: Vec<[f64; 3]> = vec![
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
    let mut faces: Vec<[u32; 3]> = vec![
        [0, 11, 5],
        [0, 5, 1],
        [0, 1, 7],
        [0, 7, 10],
        [0, 10, 11],
        [1, 5, 9],
        [5, 11, 4],
        [11, 10, 2],
        [10, 7, 6],
        [7, 1, 8],
        [3, 9, 4],
        [3, 4, 2],
        [3, 2, 6],
        [3, 6, 8],
        [3, 8, 9],
        [4, 9, 5],
        [2, 4, 11],
        [6, 2, 10],
        [8, 6, 7],
        [9, 8, 1],
    ];
    for _ in 0..levels {
        let mut middles = HashMap::new();
        let mut middle = |a: u32, b: u32, positions: &mut Vec<[f64; 3]>| {
            *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                let [p, q] = [positions[a as usize], positions[b as usize]];
                positions.push(std::array::from_fn(|k| (p[k] + q[k]) / 2.0));
                positions.len() as u32 - 1
            })
        };
        faces = faces
            .iter()
            .flat_map(|&[a, b, c]| {
                let (ab, bc, ca) =
                    (middle(a, b, &mut positions), middle(b, c, &mut positions), middle(c, a, &mut positions));
                [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
            })
            .collect();
    }
    for p in &mut positions {
        let length = p.iter().map(|x| x * x).sum::<f64>().sqrt();
        *p = p.map(|x| x / length);
    }
    mesh(positions, faces)
}

/// A grid of quads, wrapped around in both directions if `wrap`, placed by `at`.
fn quads(nu: u32, nv: u32, wrap: bool, at: impl Fn(f64, f64) -> [f64; 3]) -> TriMesh {
    let (pu, pv) = if wrap { (nu, nv) } else { (nu + 1, nv + 1) };
    let positions =
        (0..pv).flat_map(|v| (0..pu).map(move |u| (u, v))).map(|(u, v)| at(f64::from(u), f64::from(v))).collect();
    let id = |u: u32, v: u32| (v % pv) * pu + u % pu;
    let faces = (0..nv)
        .flat_map(|v| (0..nu).map(move |u| (u, v)))
        .flat_map(|(u, v)| {
            let [a, b, c, d] = [id(u, v), id(u + 1, v), id(u + 1, v + 1), id(u, v + 1)];
            [[a, b, c], [a, c, d]]
        })
        .collect();
    mesh(positions, faces)
}

pub(super) fn torus(nu: u32, nv: u32) -> TriMesh {
    let tau = std::f64::consts::TAU;
    quads(nu, nv, true, |u, v| {
        let (a, b) = (u / f64::from(nu) * tau, v / f64::from(nv) * tau);
        let r = 2.0 + 0.7 * b.cos();
        [r * a.cos(), r * a.sin(), 0.7 * b.sin()]
    })
}

/// An open sheet with hills of the given height.
pub(super) fn grid(n: u32, height: f64) -> TriMesh {
    quads(n, n, false, |u, v| [u, v, height * ((u * 0.7).sin() + (v * 0.9).cos())])
}

/// `grid` with some inner faces taken out, so that there are holes.
pub(super) fn sieve(n: u32) -> TriMesh {
    let mut mesh = grid(n, 0.5);
    let keep = |i: usize| {
        let (u, v) = ((i / 2) as u32 % n, (i / 2) as u32 / n);
        !(u % 4 == 2 && v % 4 == 2)
    };
    let mut i = 0;
    mesh.faces.retain(|_| {
        i += 1;
        keep(i - 1)
    });
    mesh
}

/// Moves every vertex at random by up to `amount` along each axis.
pub(super) fn noisy(mut mesh: TriMesh, amount: f64, seed: u64) -> TriMesh {
    let mut rng = fastrand::Rng::with_seed(seed);
    for x in mesh.positions.iter_mut().flatten() {
        *x += (rng.f64() - 0.5) * 2.0 * amount;
    }
    mesh
}

/// Puts every n-th vertex onto one of its neighbours: faces without area, coincident vertices.
pub(super) fn pinched(mut mesh: TriMesh, every: usize) -> TriMesh {
    for i in (0..mesh.faces.len()).step_by(every) {
        let [a, b, _] = mesh.faces[i];
        mesh.positions[a as usize] = mesh.positions[b as usize];
    }
    mesh
}

/// Several meshes in one, each scaled and moved.
pub(super) fn scattered(parts: &[(TriMesh, f64, [f64; 3])]) -> TriMesh {
    let mut all = TriMesh::default();
    for (part, scale, offset) in parts {
        let first = all.positions.len() as u32;
        all.positions.extend(part.positions.iter().map(|p| std::array::from_fn(|k| p[k] * scale + offset[k])));
        all.faces.extend(part.faces.iter().map(|f| f.map(|v| v + first)));
    }
    all
}

/// Paints a mesh by position: stripes along x.
pub(super) fn striped(mut mesh: TriMesh, width: f64) -> TriMesh {
    let paint = |p: &[f64; 3]| if (p[0] / width).floor() as i64 % 2 == 0 { [250, 240, 20] } else { [10, 20, 120] };
    mesh.colors = Some(mesh.positions.iter().map(paint).collect());
    mesh
}

/// A binary little-endian PLY of the plain kind in the mesh folder: float positions, optional uchar colours, triangles.
pub(super) fn read_ply(path: &Path) -> TriMesh {
    let bytes = std::fs::read(path).unwrap();
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    let count = |what: &str| -> usize {
        let line = header.lines().find(|l| l.starts_with(&format!("element {what} "))).unwrap();
        line.rsplit(' ').next().unwrap().parse().unwrap()
    };
    let has_colors = header.contains("property uchar red");
    let stride = if has_colors { 15 } else { 12 };
    let (vertices, faces) = bytes[end..].split_at(count("vertex") * stride);
    let float = |b: &[u8]| f64::from(f32::from_le_bytes(b.try_into().unwrap()));
    TriMesh {
        positions: vertices.chunks(stride).map(|v| [float(&v[..4]), float(&v[4..8]), float(&v[8..12])]).collect(),
        colors: has_colors.then(|| vertices.chunks(stride).map(|v| [v[12], v[13], v[14]]).collect()),
        faces: faces[..count("face") * 13]
            .chunks(13)
            .map(|f| std::array::from_fn(|k| u32::from_le_bytes(f[1 + 4 * k..5 + 4 * k].try_into().unwrap())))
            .collect(),
    }
}
