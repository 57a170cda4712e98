//! Fine relief and colour of the sculpture, from the material, the noises and the depth of the crevices.

use std::f64::consts::TAU;

use glam::DVec3;

use super::fossil::{Material, suture_distance};
use super::math::{cells, cos, floor, fractal, hash, mix, noise, sin, smoothstep, unit};
use super::sculpture::{Probe, Sculpture};

/// What is done to one vertex.
pub(super) struct Touch {
    /// Outward along the normal, in model units.
    pub(super) height: f64,
    pub(super) color: [u8; 3],
}

/// Paints the surface at the resolution of one lattice step.
pub(super) struct Painter<'a> {
    sculpture: &'a Sculpture,
    /// Octaves of relief before the wavelength falls under three steps.
    octaves: u32,
    /// Cycles per unit of length of the finest noise that the vertices can carry.
    finest: f64,
    step: f64,
}

impl<'a> Painter<'a> {
    pub(super) fn new(sculpture: &'a Sculpture, step: f64) -> Self {
        let mut octaves = 1;
        while octaves < 9 && 1.0 / (RELIEF * f64::from(1u32 << octaves)) > 3.0 * step {
            octaves += 1;
        }
        Self { sculpture, octaves, finest: 0.3 / step, step }
    }

    /// Relief and colour at `p`, a point of the surface with outward unit normal `n` and there or very near `probe`.
    pub(super) fn touch(&self, p: DVec3, n: DVec3, probe: &Probe) -> Touch {
        let seed = self.sculpture.seed();
        // Free space along the normal, near and far: 1 in the open, 0 at the bottom of a crevice.
        let space = |reach: f64| (self.sculpture.distance(p + n * reach) / reach).clamp(0.0, 1.0);
        let open = 0.45 * space(0.025) + 0.55 * space(0.11);
        let grain = fractal(p * RELIEF, self.octaves, seed);
        let broad = noise(p * 1.9, seed ^ 0x51);
        let speckle = 0.8 * noise(p * self.finest, seed ^ 0xf1) + 0.5 * noise(p * (self.finest * 3.1), seed ^ 0xf2);
        let spot = Spot { p, n, open, grain, broad, speckle, step: self.step, seed };
        let (height, base) = match probe.material {
            Material::Rock => self.rock(&spot, probe.worked),
            Material::Ammonite { turn, around, rib, tube } => ammonite(&spot, turn, around, rib, tube),
            Material::Scallop { growth, rib } => scallop(&spot, growth, rib),
            Material::Crinoid { joint, disc } => crinoid(&spot, joint, disc),
            Material::Belemnite { along } => belemnite(&spot, along),
        };
        // Dirt gathers in crevices, and little light comes there.
        let dirt = smoothstep(0.80, 0.25, open + 0.10 * grain);
        let dirty = base.lerp(DVec3::new(0.20, 0.145, 0.10), 0.62 * dirt);
        let lit = dirty * mix(0.52, 1.04, smoothstep(0.0, 0.95, open));
        Touch { height, color: lit.to_array().map(|c| (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8) }
    }

    fn rock(&self, spot: &Spot, worked: f64) -> (f64, DVec3) {
        let Spot { p, n, grain, broad, speckle, seed, .. } = *spot;
        let bend = self.sculpture.bend(p);
        let (layer_height, layer) = self.sculpture.bedding(p, bend);
        let flat = p * 0.8;

        // Pits, cracks and a calcite vein that stands out.
        let pit = cells(p * 19.0, seed ^ 0x91);
        let pitted = if pit.id & 0x3000_0000 == 0 { smoothstep(0.38, 0.08, pit.nearest) } else { 0.0 };
        let warp = DVec3::new(noise(p * 5.0, seed ^ 0x18), noise(p * 5.0, seed ^ 0x19), noise(p * 5.0, seed ^ 0x1a));
        let lump = cells(p * 2.2 + warp * 0.28, seed ^ 0x17);
        let crack = smoothstep(0.03, 0.0, lump.second - lump.nearest) * smoothstep(0.05, 0.45, broad + 0.5 * grain);
        let vein_at = noise(flat * 1.6 + warp * 0.08, seed ^ 0x77);
        let vein = smoothstep(0.016, 0.005, vein_at.abs()) * smoothstep(-0.15, 0.25, noise(flat * 2.2, seed ^ 0x78));
        // The chisel left short grooves where the stone was cut away.
        let groove = noise(DVec3::new(p.x * 34.0 + p.y * 20.0, p.y * 9.0 - p.x * 14.0, p.z * 12.0), seed ^ 0x33);
        let height = 0.034 * grain * (1.0 - 0.45 * worked) - 0.007 * pitted - 0.020 * crack
            + 0.006 * vein
            + 0.006 * worked * groove
            + 0.0012 * speckle;

        let warm = DVec3::new(0.70, 0.585, 0.43);
        let grey = DVec3::new(0.56, 0.545, 0.52);
        let mut color = warm.lerp(grey, smoothstep(-0.35, 0.45, broad + 0.35 * grain));
        // Beds differ in tint; thin laminae run inside each.
        color *= 0.88 + 0.22 * layer;
        let lamina = noise(DVec3::new(layer_height * 5.3, p.x * 0.7, p.z * 0.7), seed ^ 0x21);
        color *= 1.0 + 0.10 * lamina;
        let iron = smoothstep(0.18, 0.62, noise(p * 1.3 + DVec3::splat(0.2 * grain), seed ^ 0x41) + 0.3 * grain);
        color = color.lerp(DVec3::new(0.60, 0.34, 0.17), 0.75 * iron);
        color = color.lerp(DVec3::new(0.86, 0.81, 0.72), 0.55 * worked * smoothstep(-0.5, 0.6, groove + grain));
        color *= 1.0 + 0.30 * grain + 0.17 * speckle - 0.25 * pitted - 0.4 * crack;
        color = color.lerp(DVec3::new(0.93, 0.91, 0.86), 0.85 * vein);
        let (lichen_height, color) = lichen(spot, color, warp, n.y * 0.30 - 0.08 - worked);
        (height + lichen_height, color)
    }
}

/// Cycles per unit of length of the coarsest relief.
const RELIEF: f64 = 5.5;

/// What every material is painted from.
struct Spot {
    p: DVec3,
    n: DVec3,
    open: f64,
    grain: f64,
    broad: f64,
    /// Fine noise, about -1..1.
    speckle: f64,
    /// Step of the lattice, about the length of an edge.
    step: f64,
    seed: u32,
}

/// Round crusts in two colours, each with a pale rim; `favour` moves the share of stone they cover.
fn lichen(spot: &Spot, under: DVec3, warp: DVec3, favour: f64) -> (f64, DVec3) {
    let Spot { p, open, grain, speckle, seed, .. } = *spot;
    let mut height = 0.0;
    let mut color = under;
    let kinds = [
        (6.0, 0x61, DVec3::new(0.66, 0.70, 0.57), DVec3::new(0.80, 0.82, 0.72)),
        (9.5, 0x62, DVec3::new(0.80, 0.53, 0.13), DVec3::new(0.90, 0.68, 0.27)),
    ];
    for (scale, salt, inner, rim) in kinds {
        let region = noise(p * 1.1, seed ^ salt) + favour;
        if region < 0.05 {
            continue;
        }
        let crust = cells(p * scale + warp * 0.20 + DVec3::new(grain, speckle, -grain) * 0.09, seed ^ salt);
        let size = 0.20 + 0.30 * unit(crust.id >> 7) * smoothstep(0.05, 0.4, region);
        let cover = smoothstep(size, size - 0.05, crust.nearest) * smoothstep(0.25, 0.6, open);
        let at_rim = smoothstep(size - 0.14, size - 0.02, crust.nearest);
        let spotted = 0.86 + 0.22 * smoothstep(-0.1, 0.3, grain) + 0.2 * speckle;
        color = color.lerp(inner.lerp(rim, at_rim) * spotted, 0.85 * cover);
        height += 0.005 * cover * (0.4 + at_rim) + 0.004 * cover * grain;
    }
    (height, color)
}

fn ammonite(spot: &Spot, turn: f64, around: f64, rib: f64, tube: f64) -> (f64, DVec3) {
    let Spot { p, open, grain, broad, speckle, seed, .. } = *spot;
    let side = around.abs();
    // Growth lines follow the sweep of the ribs, denser than they.
    let swept = turn - 0.10 * cos(around) + 0.045 * cos(2.0 * around);
    let line = sin(swept * 190.0) * 0.6 + sin(swept * 71.0 + 1.0) * 0.4;
    // Where the outer shell has gone, mother-of-pearl shows with the suture lines of the chamber walls.
    let worn_noise = noise(p * 2.6, seed ^ 0x13) + 0.5 * noise(p * 6.3, seed ^ 0x14) + 0.30 * grain;
    let chambered = smoothstep(-4.2, -4.6, turn);
    let worn = smoothstep(0.10, 0.16, worn_noise + 0.30 * rib - 0.34 + 0.28 * chambered);
    let drawn = smoothstep(4.0, 9.0, tube / spot.step);
    let suture = smoothstep(0.075, 0.03, suture_distance(turn, around)) * chambered * worn * drawn;
    let height = tube * (0.006 * line * (1.0 - worn) - 0.022 * worn - 0.012 * suture) + 0.006 * grain;

    let umber = DVec3::new(0.36, 0.225, 0.135);
    let amber = DVec3::new(0.66, 0.43, 0.235);
    let cream = DVec3::new(0.88, 0.76, 0.58);
    let mut shell = umber.lerp(amber, smoothstep(-0.6, 0.5, broad + 0.6 * grain + 0.35 * line));
    // Colour bands along the whorl, as on living shells.
    let band = smoothstep(0.3, 0.8, 0.5 + 0.5 * cos(side * 5.0 + 0.8 * broad));
    shell = shell.lerp(DVec3::new(0.47, 0.20, 0.11), 0.5 * band * (1.0 - rib));
    shell = shell.lerp(cream, smoothstep(0.45, 1.0, rib + 0.25 * grain) * 0.75);

    // Thin-film colours: red and green first, blue rarely, moving with the thickness of the layer.
    let film = 0.55 * turn + 0.9 * broad + 0.5 * side + 0.7 * noise(p * 5.1, seed ^ 0x15) + 0.25 * rib;
    let tint = |shift: f64| 0.5 + 0.5 * cos(TAU * (0.30 * film + shift));
    let pearl = DVec3::new(0.40 + 0.50 * tint(0.0), 0.24 + 0.48 * tint(0.30), 0.14 + 0.24 * tint(0.66));
    let nacre = DVec3::new(0.78, 0.63, 0.44).lerp(pearl, 0.58) * (0.92 + 0.2 * grain + 0.10 * rib);
    let mut color = shell.lerp(nacre, worn);
    color = color.lerp(DVec3::new(0.17, 0.10, 0.07), 0.75 * suture);
    color *= 1.0 + 0.22 * grain + 0.07 * speckle;
    // Stone still clings to the furrows.
    let clinging =
        smoothstep(0.25, 0.6, noise(p * 4.2, seed ^ 0x16) + 0.6 * grain + 0.25 - 0.5 * rib - 0.4 * open + 0.1);
    color = color.lerp(DVec3::new(0.66, 0.57, 0.45), 0.7 * clinging);
    (height + 0.004 * clinging, color)
}

fn scallop(spot: &Spot, growth: f64, rib: f64) -> (f64, DVec3) {
    let grain = spot.grain;
    let ring = 0.5 + 0.5 * cos(growth * 57.0);
    let mut color = DVec3::new(0.80, 0.70, 0.58).lerp(DVec3::new(0.70, 0.42, 0.33), 0.7 * ring * ring);
    color = color.lerp(DVec3::new(0.92, 0.87, 0.79), 0.5 * rib);
    (0.005 * grain + 0.001 * ring, color * (1.0 + 0.35 * grain))
}

fn crinoid(spot: &Spot, joint: f64, disc: i64) -> (f64, DVec3) {
    let shade = 0.88 + 0.2 * unit(hash(disc, 3, 0, spot.seed));
    let color = DVec3::new(0.82, 0.79, 0.74).lerp(DVec3::new(0.46, 0.38, 0.31), 0.8 * joint) * shade;
    (0.003 * spot.grain, color * (1.0 + 0.3 * spot.grain))
}

fn belemnite(spot: &Spot, along: f64) -> (f64, DVec3) {
    let streak = noise(DVec3::new(along * 3.0, spot.p.y * 60.0, spot.p.z * 60.0), spot.seed ^ 0x55);
    let ring = along * 9.0 - floor(along * 9.0);
    let color = DVec3::new(0.42, 0.27, 0.16).lerp(DVec3::new(0.70, 0.50, 0.28), 0.5 + 0.5 * streak);
    (0.002 * spot.grain, color * (1.0 + 0.3 * spot.grain) * (0.94 + 0.06 * ring))
}
