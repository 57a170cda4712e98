//! Generated meshes on a lattice. Not every test uses all of them.
#![allow(dead_code)]

use std::collections::BTreeMap;

use glam::DVec3;
use lodestream_protocol::mesh::{Patch, Replica};
use lodestream_protocol::quant::Lattice;

/// 16 bits around the origin, so that a radius of 1 is well inside.
pub(crate) fn lattice() -> Lattice {
    Lattice::of_box([-2.0; 3], [2.0; 3], 16)
}

/// Points in model units with a colour each, and faces.
#[derive(Clone, Default)]
pub(crate) struct Soup {
    pub(crate) points: Vec<DVec3>,
    pub(crate) colors: Vec<[u8; 3]>,
    pub(crate) faces: Vec<[u32; 3]>,
}

impl Soup {
    pub(crate) fn new(points: Vec<DVec3>, faces: Vec<[u32; 3]>) -> Self {
        Self { colors: vec![[0; 3]; points.len()], points, faces }
    }

    pub(crate) fn colored(mut self, color: impl Fn(DVec3) -> [u8; 3]) -> Self {
        self.colors = self.points.iter().map(|&p| color(p)).collect();
        self
    }

    pub(crate) fn moved(mut self, f: impl Fn(DVec3) -> DVec3) -> Self {
        self.points.iter_mut().for_each(|p| *p = f(*p));
        self
    }

    pub(crate) fn replica(&self, lattice: &Lattice) -> Replica {
        let positions = self.points.iter().map(|p| lattice.quantize(p.to_array())).collect();
        let patch = Patch { positions, colors: self.colors.clone(), faces: self.faces.clone() };
        Replica::new(&patch).expect("a manifold")
    }
}

/// Unit icosphere, `20 * 4^level` faces.
pub(crate) fn icosphere(level: u32) -> Soup {
    let t = (1.0 + 5f64.sqrt()) / 2.0;
    let mut points: Vec<DVec3> = [
        [-1.0, t, 0.0],
        [1.0, t, 0.0],
        [-1.0, -t, 0.0],
        [1.0, -t, 0.0],
        [0.0, -1.0, t],
        [0.0, 1.0, t],
        [0.0, -1.0, -t],
        [0.0, 1.0, -t],
        [t, 0.0, -1.0],
        [t, 0.0, 1.0],
        [-t, 0.0, -1.0],
        [-t, 0.0, 1.0],
    ]
    .map(|p| DVec3::from_array(p).normalize())
    .to_vec();
    let ring = [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2]];
    let rest = [
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
    let mut faces: Vec<[u32; 3]> = ring.into_iter().chain(rest).collect();
    for _ in 0..level {
        let mut middle = BTreeMap::new();
        let mut finer = Vec::with_capacity(faces.len() * 4);
        for [a, b, c] in faces {
            let mut at = |a: u32, b: u32| {
                *middle.entry((a.min(b), a.max(b))).or_insert_with(|| {
                    points.push((points[a as usize] + points[b as usize]).normalize());
                    points.len() as u32 - 1
                })
            };
            let (ab, bc, ca) = (at(a, b), at(b, c), at(c, a));
            finer.extend([[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]);
        }
        faces = finer;
    }
    Soup::new(points, faces)
}

/// Closed cylinder around y with `segments` sides and caps without a middle vertex: radius 1, height 2.
pub(crate) fn cylinder(segments: u32) -> Soup {
    let angle = |i: u32| f64::from(i) / f64::from(segments) * std::f64::consts::TAU;
    let points = (0..2 * segments).map(|i| {
        let a = angle(i / 2);
        DVec3::new(a.cos(), if i % 2 == 0 { -1.0 } else { 1.0 }, -a.sin())
    });
    let mut faces = Vec::new();
    for i in 0..segments {
        let (low, high) = (2 * i, 2 * i + 1);
        let (next_low, next_high) = (2 * ((i + 1) % segments), 2 * ((i + 1) % segments) + 1);
        faces.extend([[low, next_low, next_high], [low, next_high, high]]);
    }
    for i in 1..segments - 1 {
        faces.extend([[1, 2 * i + 1, 2 * i + 3], [0, 2 * i + 2, 2 * i]]);
    }
    Soup::new(points.collect(), faces)
}

/// An axis-aligned cube from -1 to 1, twelve faces.
pub(crate) fn cube() -> Soup {
    let points = (0..8).map(|i| DVec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2)) * 2.0 - 1.0);
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let faces = quads.into_iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]);
    Soup::new(points.collect(), faces.collect())
}

/// An open grid of `n * n` quads in x and y from -1 to 1, lifted by `height`.
pub(crate) fn sheet(n: u32, height: impl Fn(f64, f64) -> f64) -> Soup {
    let at = |i: u32| f64::from(i) / f64::from(n) * 2.0 - 1.0;
    let points = (0..(n + 1) * (n + 1)).map(|i| {
        let (x, y) = (at(i % (n + 1)), at(i / (n + 1)));
        DVec3::new(x, y, height(x, y))
    });
    let faces = (0..n * n).flat_map(|i| {
        let a = i / n * (n + 1) + i % n;
        [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]
    });
    Soup::new(points.collect(), faces.collect())
}
