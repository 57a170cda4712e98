//! The sculpture as one signed field: a broken block of bedded limestone with fossils worked out of it.

use std::f64::consts::TAU;

use glam::DVec3;

use super::fossil::{Fossil, Material, Shape};
use super::math::{cos, floor, fractal, hash, noise, sin, smooth_max, smooth_min, smoothstep, unit};

/// Half the edge of the cube, centred on the origin, that holds the sculpture.
pub(super) const HALF_EXTENT: f64 = 1.7;
/// How far the edge between two breaks is rounded.
const BREAK_EDGE: f64 = 0.03;
/// How far the edge of a chip is rounded.
const CHIP_EDGE: f64 = 0.02;
/// Cells along that cube in the table of nearby fossils.
const TABLE: usize = 28;

/// The field and the things in it; negative inside.
pub(super) struct Sculpture {
    seed: u32,
    /// Planes that broke the block: outward normal and offset.
    breaks: Vec<(DVec3, f64)>,
    /// Shells broken off: centre and radius of the sphere that took them.
    chips: Vec<(DVec3, f64)>,
    fossils: Vec<Fossil>,
    /// Per table cell, the fossils and chips whose reach touches it.
    nearby: Vec<Nearby>,
}

/// Places in the lists of the sculpture.
struct Nearby {
    fossils: Vec<u16>,
    chips: Vec<u16>,
}

/// The field at a point, and what is there.
pub(super) struct Probe {
    pub(super) distance: f64,
    pub(super) material: Material,
    /// 1 where rock was cut away next to a fossil, 0 elsewhere.
    pub(super) worked: f64,
}

impl Sculpture {
    /// A sculpture for a seed: the large fossils keep their places, the rest is drawn.
    pub(super) fn new(seed: u64) -> Self {
        let mut random = fastrand::Rng::with_seed(seed ^ 0x5eed_f055_11ed);
        let mut sculpture = Self {
            seed: random.u32(..),
            breaks: vec![
                (DVec3::new(0.02, 0.10, 1.0).normalize(), 0.30),
                (DVec3::new(0.05, -0.05, -1.0).normalize(), 0.42),
                (DVec3::new(0.0, -1.0, 0.03).normalize(), 0.98),
            ],
            chips: Vec::new(),
            fossils: Vec::new(),
            nearby: Vec::new(),
        };
        for i in 0..11 {
            let angle = (f64::from(i) + 0.7 * random.f64()) * TAU / 11.0;
            let normal = DVec3::new(cos(angle), sin(angle), 0.7 * (random.f64() - 0.5)).normalize();
            sculpture.breaks.push((normal, 1.0 + 0.12 * random.f64() + 0.10 * normal.x.abs()));
        }
        for _ in 0..22 {
            let direction = sphere_direction(&mut random);
            let radius = 0.25 + 0.5 * random.f64();
            let at = sculpture.meet(direction * 2.4, -direction);
            if at.z < 0.15 || at.x.abs().max(at.y.abs()) > 0.85 {
                sculpture.chips.push((at + direction * (radius - 0.05 - 0.08 * random.f64()), radius));
            }
        }
        sculpture.nearby = sculpture.table();
        sculpture.place_main_fossils();
        sculpture.scatter(&mut random);
        sculpture.nearby = sculpture.table();
        sculpture
    }

    /// Signed field at `p`.
    pub(super) fn distance(&self, p: DVec3) -> f64 {
        self.probe(p).distance
    }

    /// Field and material at `p`.
    pub(super) fn probe(&self, p: DVec3) -> Probe {
        let mut nearest = f64::MAX;
        let mut found = Material::Rock;
        let mut worked: f64 = 0.0;
        for &index in self.nearby_at(p).map_or(&[][..], |n| &n.fossils) {
            let fossil = &self.fossils[usize::from(index)];
            let reach = fossil.reach();
            if (p - fossil.centre).length_squared() > reach * reach {
                continue;
            }
            let (d, material) = fossil.probe(p);
            if d < nearest {
                (nearest, found) = (d, material);
            }
            if fossil.freed() > 0.0 {
                worked = worked.max(smoothstep(fossil.freed(), 0.0, d) * fossil.freed() * 8.0);
            }
        }
        let worked = worked.min(1.0);
        let rock = self.rock(p) + 0.065 * worked;
        let distance = smooth_min(rock, nearest, 0.022);
        Probe { distance, material: if nearest < rock { found } else { Material::Rock }, worked }
    }

    /// Height in the bedding at `p`, in layers, and a number in [0, 1) for the layer.
    pub(super) fn bedding(&self, p: DVec3, bend: f64) -> (f64, f64) {
        let height = (p.dot(DVec3::new(-0.30, 0.24, 0.92)) + 0.10 * bend) * 8.5;
        (height, unit(hash(floor(height) as i64, 0, 0, self.seed)))
    }

    /// Seed of the noises.
    pub(super) fn seed(&self) -> u32 {
        self.seed
    }

    fn rock(&self, p: DVec3) -> f64 {
        // An ellipsoid keeps the corners from being corners.
        const INVERSE: DVec3 = DVec3::new(1.0 / 1.28, 1.0 / 1.18, 1.0 / 0.72);
        let q = p * INVERSE;
        let square = q.length_squared().max(1e-12);
        let mut d = (square - square.sqrt()) / (q * INVERSE).length().max(1e-6);
        for (normal, offset) in &self.breaks {
            let outside = p.dot(*normal) - offset;
            if outside > d - BREAK_EDGE {
                d = smooth_max(d, outside, BREAK_EDGE);
            }
        }
        // Far outside neither chips nor beds bring the surface here.
        if d > 0.3 {
            return d;
        }
        // Before the table exists the chips are still being struck, each into the unchipped block.
        for &index in self.nearby_at(p).map_or(&[][..], |n| &n.chips) {
            let (centre, radius) = self.chips[usize::from(index)];
            // Nothing to take here unless radius - length > d - CHIP_EDGE; most chips are settled without the root.
            let within = radius - d + CHIP_EDGE;
            let away = (p - centre).length_squared();
            if within > 0.0 && away < within * within {
                d = smooth_max(d, radius - away.sqrt(), CHIP_EDGE);
            }
        }
        // The rest moves the surface by less than 0.25.
        if d.abs() > 0.3 {
            return d;
        }
        let bend = self.bend(p);
        let (height, layer) = self.bedding(p, bend);
        let within = height - floor(height);
        // Hard and soft layers: each stands out by its own amount, with rounded edges.
        let ledge = (layer - 0.5) * smoothstep(0.0, 0.2, within) * smoothstep(1.0, 0.8, within);
        // Stone breaks in hollows with sharp ridges between them.
        let scar = noise(p * 2.3 + DVec3::splat(5.3), self.seed ^ 0x5c).abs();
        d + 0.07 * bend - 0.062 * ledge + 0.10 * (0.25 - scar)
    }

    /// How far the beds are bent at `p`, about -1..1.
    pub(super) fn bend(&self, p: DVec3) -> f64 {
        fractal(p * 1.25, 2, self.seed)
    }

    /// Where a ray from `from` meets the rock; `direction` has unit length.
    fn meet(&self, from: DVec3, direction: DVec3) -> DVec3 {
        let mut at = from;
        for _ in 0..80 {
            at += direction * (self.rock(at) * 0.6);
        }
        at
    }

    /// Outward normal of the rock at `at`, averaged over about `reach`.
    fn rock_normal(&self, at: DVec3, reach: f64) -> DVec3 {
        let slope = |axis: DVec3| self.rock(at + axis * reach) - self.rock(at - axis * reach);
        DVec3::new(slope(DVec3::X), slope(DVec3::Y), slope(DVec3::Z)).normalize_or(DVec3::Z)
    }

    fn place_main_fossils(&mut self) {
        let facing = |normal: DVec3, turned: f64| {
            let w = normal.normalize();
            let u = DVec3::Y.cross(w).normalize();
            let v = w.cross(u);
            [u * cos(turned) + v * sin(turned), v * cos(turned) - u * sin(turned), w]
        };
        self.fossils.push(Fossil {
            shape: Shape::Ammonite { radius: 0.70, width: 0.80, ribs_per_turn: 31.0, mouth: -0.9 },
            centre: DVec3::new(0.02, 0.04, 0.27),
            axes: facing(DVec3::new(0.10, 0.08, 1.0), 0.0),
        });
        let companions = [
            (0.90, -0.58, 0.9, 0.02, Shape::Ammonite { radius: 0.15, width: 0.95, ribs_per_turn: 23.0, mouth: 1.4 }),
            (-0.80, 0.62, 0.4, 0.03, Shape::Ammonite { radius: 0.11, width: 0.9, ribs_per_turn: 21.0, mouth: -2.0 }),
            (-0.82, -0.66, 0.5, 0.03, Shape::Scallop { radius: 0.16 }),
            (-0.58, -0.86, -0.9, 0.02, Shape::Scallop { radius: 0.09 }),
            (0.78, 0.66, 2.3, 0.01, Shape::Crinoid { half_length: 0.20, radius: 0.042 }),
            (0.97, 0.30, 1.2, 0.005, Shape::Crinoid { half_length: 0.07, radius: 0.03 }),
            (0.45, -0.93, 0.2, 0.015, Shape::Belemnite { half_length: 0.22, radius: 0.045 }),
        ];
        for (x, y, turned, sink, shape) in companions {
            let at = self.meet(DVec3::new(x, y, 1.5), DVec3::NEG_Z);
            let normal = self.rock_normal(at, 0.06).lerp(DVec3::Z, 0.3);
            let axes = facing(normal, turned);
            self.fossils.push(Fossil { shape, centre: at - axes[2] * sink, axes });
        }
    }

    /// Small fossils all around, wherever there is room.
    fn scatter(&mut self, random: &mut fastrand::Rng) {
        for _ in 0..90 {
            let direction = sphere_direction(random);
            let (kind, scale, turned) = (random.u32(0..4), 0.6 + 0.8 * random.f64(), random.f64() * TAU);
            let tilt = sphere_direction(random) * 0.22;
            let at = self.meet(direction * 2.4, -direction);
            let normal = self.rock_normal(at, 0.03);
            if normal.y < -0.8 {
                continue;
            }
            let w = (normal + tilt).normalize();
            let u = w.any_orthonormal_vector();
            let v = w.cross(u);
            let axes = [u * cos(turned) + v * sin(turned), v * cos(turned) - u * sin(turned), w];
            let (shape, sink) = match kind {
                0 => (
                    Shape::Ammonite {
                        radius: 0.10 * scale,
                        width: 0.9,
                        ribs_per_turn: 19.0 + floor(scale * 8.0),
                        mouth: turned,
                    },
                    0.03 * scale,
                ),
                1 => (Shape::Scallop { radius: 0.10 * scale }, 0.025 * scale),
                2 => (Shape::Crinoid { half_length: 0.10 * scale, radius: 0.022 * scale }, 0.008),
                _ => (Shape::Belemnite { half_length: 0.13 * scale, radius: 0.026 * scale }, 0.012),
            };
            let fossil = Fossil { shape, centre: at - normal * sink, axes };
            let room = |other: &Fossil| (other.centre - fossil.centre).length() > other.reach() + fossil.reach() - 0.14;
            if self.fossils.iter().all(room) {
                self.fossils.push(fossil);
            }
        }
    }

    fn table(&self) -> Vec<Nearby> {
        let cell = 2.0 * HALF_EXTENT / TABLE as f64;
        let mut table = Vec::with_capacity(TABLE.pow(3));
        for index in 0..TABLE.pow(3) {
            let at = [index % TABLE, index / TABLE % TABLE, index / (TABLE * TABLE)];
            let lo = DVec3::from_array(at.map(|a| a as f64 * cell - HALF_EXTENT));
            let touches = |centre: DVec3, reach: f64| {
                let nearest = centre.clamp(lo, lo + DVec3::splat(cell));
                (centre - nearest).length() <= reach + 1e-9
            };
            let places = |hits: &mut dyn Iterator<Item = bool>| {
                (0u16..).zip(hits).filter(|(_, hit)| *hit).map(|(i, _)| i).collect()
            };
            table.push(Nearby {
                fossils: places(&mut self.fossils.iter().map(|f| touches(f.centre, f.reach()))),
                // Deeper than this in the rock, where no surface can be, a chip need not be asked.
                chips: places(&mut self.chips.iter().map(|(centre, radius)| touches(*centre, radius + 0.3))),
            });
        }
        table
    }

    fn nearby_at(&self, p: DVec3) -> Option<&Nearby> {
        let cell = ((p + DVec3::splat(HALF_EXTENT)) * (TABLE as f64 / (2.0 * HALF_EXTENT))).to_array();
        let at = cell.map(|c| (c.max(0.0) as usize).min(TABLE - 1));
        self.nearby.get((at[2] * TABLE + at[1]) * TABLE + at[0])
    }
}

fn sphere_direction(random: &mut fastrand::Rng) -> DVec3 {
    loop {
        let p = DVec3::new(random.f64(), random.f64(), random.f64()) * 2.0 - DVec3::ONE;
        if (0.01..1.0).contains(&p.length_squared()) {
            return p.normalize();
        }
    }
}
