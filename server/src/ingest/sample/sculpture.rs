//! The sculpture as one signed field: a broken block of bedded limestone with fossils worked out of it.

use glam::DVec3;

use super::fossil::{Fossil, Material, Shape};
use super::math::{cos, floor, fractal, hash, sin, smooth_max, smooth_min, smoothstep, unit};

/// Half the edge of the cube, centred on the origin, that holds the sculpture.
pub(super) const HALF_EXTENT: f64 = 1.7;
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
    /// Per table cell, the fossils whose reach touches it.
    nearby: Vec<Vec<u16>>,
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
            let angle = (f64::from(i) + 0.7 * random.f64()) * std::f64::consts::TAU / 11.0;
            let normal = DVec3::new(cos(angle), sin(angle), 0.7 * (random.f64() - 0.5)).normalize();
            sculpture.breaks.push((normal, 1.0 + 0.12 * random.f64() + 0.10 * normal.x.abs()));
        }
        for _ in 0..13 {
            let direction = sphere_direction(&mut random);
            let radius = 0.35 + 0.5 * random.f64();
            let at = sculpture.rock_surface(direction);
            if at.z < 0.15 || at.x.abs().max(at.y.abs()) > 0.95 {
                sculpture.chips.push((at + direction * (radius - 0.06 - 0.05 * random.f64()), radius));
            }
        }
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
        for &index in self.nearby_at(p) {
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
        let height = (p.dot(DVec3::new(0.16, 0.93, -0.25)) + 0.16 * bend) * 7.5;
        (height, unit(hash(floor(height) as i64, 0, 0, self.seed)))
    }

    /// Seed of the noises.
    pub(super) fn seed(&self) -> u32 {
        self.seed
    }

    fn rock(&self, p: DVec3) -> f64 {
        // An ellipsoid keeps the corners from being corners.
        let q = p / DVec3::new(1.28, 1.18, 0.72);
        let rho = q.length().max(1e-6);
        let mut d = (rho - 1.0) * rho / (p / DVec3::new(1.638, 1.392, 0.518)).length().max(1e-6);
        for (normal, offset) in &self.breaks {
            d = smooth_max(d, p.dot(*normal) - offset, 0.07);
        }
        for (centre, radius) in &self.chips {
            d = smooth_max(d, radius - (p - *centre).length(), 0.03);
        }
        if d > 0.4 {
            return d - 0.1;
        }
        let bend = fractal(p * 1.15, 2, self.seed);
        let (height, layer) = self.bedding(p, bend);
        let within = height - floor(height);
        // Hard and soft layers: each stands out by its own amount, with a rounded lower edge.
        let ledge = (layer - 0.5) * smoothstep(0.0, 0.16, within) * smoothstep(1.0, 0.86, within);
        d + 0.075 * bend - 0.075 * ledge
    }

    /// Where a ray from outside towards the centre meets the rock.
    fn rock_surface(&self, direction: DVec3) -> DVec3 {
        let mut at = direction * 2.4;
        for _ in 0..80 {
            at -= direction * (self.rock(at) * 0.6);
        }
        at
    }

    fn place_main_fossils(&mut self) {
        let facing = |normal: DVec3, turned: f64| {
            let w = normal.normalize();
            let u = DVec3::Y.cross(w).normalize();
            let v = w.cross(u);
            [u * cos(turned) + v * sin(turned), v * cos(turned) - u * sin(turned), w]
        };
        self.fossils.push(Fossil {
            shape: Shape::Ammonite { radius: 0.60, width: 0.86, ribs_per_turn: 31.0, mouth: -0.9 },
            centre: DVec3::new(-0.06, 0.08, 0.27),
            axes: facing(DVec3::new(0.10, 0.08, 1.0), 0.0),
        });
        self.fossils.push(Fossil {
            shape: Shape::Ammonite { radius: 0.17, width: 0.95, ribs_per_turn: 23.0, mouth: 0.6 },
            centre: DVec3::new(0.87, -0.52, 0.22),
            axes: facing(DVec3::new(0.45, -0.12, 1.0), 2.2),
        });
        self.fossils.push(Fossil {
            shape: Shape::Scallop { radius: 0.17 },
            centre: DVec3::new(-0.80, -0.66, 0.18),
            axes: facing(DVec3::new(-0.25, -0.1, 1.0), 0.5),
        });
        self.fossils.push(Fossil {
            shape: Shape::Crinoid { half_length: 0.22, radius: 0.045 },
            centre: DVec3::new(0.72, 0.66, 0.20),
            axes: facing(DVec3::new(0.2, 0.2, 1.0), 2.3),
        });
        self.fossils.push(Fossil {
            shape: Shape::Belemnite { half_length: 0.24, radius: 0.05 },
            centre: DVec3::new(0.30, -0.84, 0.17),
            axes: facing(DVec3::new(0.0, -0.3, 1.0), 0.25),
        });
    }

    /// Small fossils all around, wherever there is room.
    fn scatter(&mut self, random: &mut fastrand::Rng) {
        for _ in 0..90 {
            let direction = sphere_direction(random);
            let (kind, scale, turned) = (random.u32(0..4), 0.6 + 0.8 * random.f64(), random.f64() * 6.28);
            let tilt = sphere_direction(random) * 0.3;
            let at = self.rock_surface(direction);
            let e = 0.02;
            let slope = |axis: DVec3| self.rock(at + axis * e) - self.rock(at - axis * e);
            let normal = DVec3::new(slope(DVec3::X), slope(DVec3::Y), slope(DVec3::Z)).normalize_or(direction);
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
                    0.02,
                ),
                1 => (Shape::Scallop { radius: 0.10 * scale }, 0.01),
                2 => (Shape::Crinoid { half_length: 0.10 * scale, radius: 0.022 * scale }, 0.004),
                _ => (Shape::Belemnite { half_length: 0.13 * scale, radius: 0.026 * scale }, 0.006),
            };
            let fossil = Fossil { shape, centre: at - normal * sink, axes };
            let room = |other: &Fossil| (other.centre - fossil.centre).length() > other.reach() + fossil.reach() - 0.14;
            if self.fossils.iter().all(room) {
                self.fossils.push(fossil);
            }
        }
    }

    fn table(&self) -> Vec<Vec<u16>> {
        let cell = 2.0 * HALF_EXTENT / TABLE as f64;
        let mut lists = Vec::with_capacity(TABLE.pow(3));
        for index in 0..TABLE.pow(3) {
            let at = [index % TABLE, index / TABLE % TABLE, index / (TABLE * TABLE)];
            let lo = DVec3::from_array(at.map(|a| a as f64 * cell - HALF_EXTENT));
            let touches = |fossil: &Fossil| {
                let nearest = fossil.centre.clamp(lo, lo + DVec3::splat(cell));
                (fossil.centre - nearest).length() <= fossil.reach() + 1e-9
            };
            lists.push((0u16..).zip(&self.fossils).filter(|(_, f)| touches(f)).map(|(i, _)| i).collect());
        }
        lists
    }

    fn nearby_at(&self, p: DVec3) -> &[u16] {
        let cell = ((p + DVec3::splat(HALF_EXTENT)) * (TABLE as f64 / (2.0 * HALF_EXTENT))).to_array();
        let at = cell.map(|c| (c.max(0.0) as usize).min(TABLE - 1));
        self.nearby.get((at[2] * TABLE + at[1]) * TABLE + at[0]).map_or(&[], Vec::as_slice)
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
