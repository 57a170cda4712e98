//! Small generated meshes.

use std::f64::consts::TAU;

use crate::mesh::TriMesh;

pub(super) fn triangle() -> TriMesh {
    TriMesh { positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], faces: vec![[0, 1, 2]], colors: None }
}

/// Two triangles for each cell; wrapped around in both directions if `wraps`.
fn cells(nu: u32, nv: u32, wraps: bool, at: impl Fn(f64, f64) -> [f64; 3]) -> TriMesh {
    let (pu, pv) = if wraps { (nu, nv) } else { (nu + 1, nv + 1) };
    let mut mesh = TriMesh::default();
    for v in 0..pv {
        mesh.positions.extend((0..pu).map(|u| at(f64::from(u), f64::from(v))));
    }
    let id = |u: u32, v: u32| v % pv * pu + u % pu;
    for v in 0..nv {
        for u in 0..nu {
            let [a, b, c, d] = [id(u, v), id(u + 1, v), id(u + 1, v + 1), id(u, v + 1)];
            mesh.faces.extend([[a, b, c], [c, d, a]]);
        }
    }
    mesh
}

pub(super) fn torus(nu: u32, nv: u32) -> TriMesh {
    cells(nu, nv, true, |u, v| {
        let (a, b) = (u / f64::from(nu) * TAU, v / f64::from(nv) * TAU);
        let r = 2.0 + 0.7 * b.cos() + 0.05 * (3.0 * a + 2.0 * b).sin();
        [r * a.cos(), r * a.sin(), 0.7 * b.sin()]
    })
}

pub(super) fn sheet(nu: u32, nv: u32) -> TriMesh {
    cells(nu, nv, false, |u, v| [u, v, (u * 0.7).sin() + (v * 0.9).cos()])
}

/// Triangles that touch nothing.
pub(super) fn separate(count: u32, seed: u64) -> TriMesh {
    let mut random = fastrand::Rng::with_seed(seed);
    let mut mesh = TriMesh::default();
    for k in 0..count {
        let at: [f64; 3] = std::array::from_fn(|_| random.f64() * 10.0);
        mesh.positions.extend([0.0, 0.1, 0.3].map(|x| [at[0] + x, at[1] + x * x, at[2] + random.f64()]));
        mesh.faces.push([3 * k, 3 * k + 1, 3 * k + 2]);
    }
    mesh
}

pub(super) fn colored(mut mesh: TriMesh) -> TriMesh {
    let color = |p: &[f64; 3]| p.map(|x| (x * 40.0) as i32 as u8);
    mesh.colors = Some(mesh.positions.iter().map(color).collect());
    mesh
}

/// Each face with vertices of its own, in another order; colours differ a little between those at one place.
pub(super) fn exploded(mesh: &TriMesh) -> TriMesh {
    let mut corners: Vec<u32> = mesh.faces.as_flattened().to_vec();
    let mut places: Vec<u32> = (0..corners.len() as u32).collect();
    fastrand::Rng::with_seed(8).shuffle(&mut places);
    let mut out = TriMesh { positions: vec![[0.0; 3]; corners.len()], ..TriMesh::default() };
    out.colors = mesh.colors.as_ref().map(|_| vec![[0; 3]; corners.len()]);
    for (corner, &place) in corners.iter_mut().zip(&places) {
        out.positions[place as usize] = mesh.positions[*corner as usize];
        if let (Some(colors), Some(from)) = (&mut out.colors, &mesh.colors) {
            colors[place as usize] = from[*corner as usize].map(|x| x ^ (place % 4) as u8);
        }
        *corner = place;
    }
    out.faces = corners.chunks(3).map(|face| [face[0], face[1], face[2]]).collect();
    out
}

/// A strip of `count` cells bent into a ring, its end joined upside down.
pub(super) fn moebius(count: u32) -> TriMesh {
    let mut mesh = TriMesh::default();
    for k in 0..count {
        let turn = f64::from(k) / f64::from(count) * TAU;
        for side in [-0.3, 0.3] {
            let (r, z) = (1.0 + side * (turn / 2.0).cos(), side * (turn / 2.0).sin());
            mesh.positions.push([r * turn.cos(), r * turn.sin(), z]);
        }
        let [a, b] = [2 * k, 2 * k + 1];
        let [c, d] = if k + 1 < count { [a + 2, b + 2] } else { [1, 0] };
        mesh.faces.extend([[a, c, b], [b, c, d]]);
    }
    mesh
}
