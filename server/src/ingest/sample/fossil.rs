//! The shapes in the stone: ammonites, scallops, crinoid stems and belemnites as signed fields.
//!
//! A field is negative inside and close to a distance near the surface. Beside it each shape gives coordinates on its
//! own surface, from which `paint` finds growth lines, sutures and wear.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use glam::DVec3;

use super::math::{atan2, cos, exp, floor, ln, sin, smooth_max, smooth_min, smoothstep};

/// What lies at a point of the surface, with coordinates along the thing itself.
#[derive(Clone, Copy, Debug)]
pub(super) enum Material {
    Rock,
    /// `turn`: angle along the spiral in radians, 0 at the mouth and falling inward; `around`: angle around the
    /// tube, 0 on the outer edge; `rib`: 0 in a furrow, 1 on a crest; `tube`: tube radius in model units.
    Ammonite {
        turn: f64,
        around: f64,
        rib: f64,
        tube: f64,
    },
    /// `growth`: 0 at the hinge, 1 at the rim; `rib` as above.
    Scallop {
        growth: f64,
        rib: f64,
    },
    /// `joint`: 1 in the groove between two discs; `disc`: number of the disc.
    Crinoid {
        joint: f64,
        disc: i64,
    },
    /// `along`: 0 at the blunt end, 1 at the tip.
    Belemnite {
        along: f64,
    },
}

/// A shape placed in space.
pub(super) struct Fossil {
    pub(super) shape: Shape,
    pub(super) centre: DVec3,
    /// Orthonormal axes of the shape's own coordinates.
    pub(super) axes: [DVec3; 3],
}

pub(super) enum Shape {
    Ammonite {
        /// Distance from the axis to the middle of the tube at the mouth.
        radius: f64,
        /// Width of a whorl over its height.
        width: f64,
        ribs_per_turn: f64,
        /// Angle of the mouth in the shape's plane.
        mouth: f64,
    },
    Scallop {
        radius: f64,
    },
    Crinoid {
        half_length: f64,
        radius: f64,
    },
    Belemnite {
        half_length: f64,
        radius: f64,
    },
}

/// A whorl is twice as large after one turn.
const GROWTH: f64 = std::f64::consts::LN_2 / TAU;
/// Tube radius over its distance from the axis: a little more than what makes the whorls touch.
const TUBE: f64 = 0.36;
/// The spiral starts this far before the mouth.
const INNERMOST: f64 = -4.6 * TAU;

impl Fossil {
    /// Radius of a sphere about `centre` outside which the shape need not be asked.
    pub(super) fn reach(&self) -> f64 {
        match self.shape {
            Shape::Ammonite { radius, .. } => radius * (1.15 + TUBE) + 0.1,
            Shape::Scallop { radius } => radius * 1.15 + 0.03,
            Shape::Crinoid { half_length, radius } | Shape::Belemnite { half_length, radius } => {
                half_length + radius + 0.04
            }
        }
    }

    /// How far around itself the stone was cut away to free it.
    pub(super) fn freed(&self) -> f64 {
        match self.shape {
            Shape::Ammonite { radius, .. } => radius * 0.17,
            Shape::Scallop { radius } => radius * 0.1,
            _ => 0.0,
        }
    }

    /// Signed field and surface coordinates at `p`.
    pub(super) fn probe(&self, p: DVec3) -> (f64, Material) {
        let q = p - self.centre;
        let local = DVec3::new(q.dot(self.axes[0]), q.dot(self.axes[1]), q.dot(self.axes[2]));
        match self.shape {
            Shape::Ammonite { radius, width, ribs_per_turn, mouth } => {
                ammonite(local, radius, width, ribs_per_turn, mouth)
            }
            Shape::Scallop { radius } => scallop(local, radius),
            Shape::Crinoid { half_length, radius } => crinoid(local, half_length, radius),
            Shape::Belemnite { half_length, radius } => belemnite(local, half_length, radius),
        }
    }
}

fn ammonite(q: DVec3, radius: f64, width: f64, ribs_per_turn: f64, mouth: f64) -> (f64, Material) {
    let r = (q.x * q.x + q.y * q.y).sqrt().max(radius * 1e-4);
    let mut turn = atan2(q.y, q.x) - mouth;
    turn -= floor(turn / TAU) * TAU;
    let behind_mouth = turn - TAU;
    // Whorl whose middle passes closest on this side of the axis, then its neighbour on the other side of `r`.
    let ideal = ln(r / radius) / GROWTH;
    let whorl = floor((ideal - behind_mouth) / TAU + 0.5);
    let near = behind_mouth + whorl * TAU;
    let far = if ideal > near { near + TAU } else { near - TAU };
    let (first, first_material) = whorl_field(q.z, r, near, radius, width, ribs_per_turn);
    let (second, second_material) = whorl_field(q.z, r, far, radius, width, ribs_per_turn);
    let seed = radius * exp(GROWTH * INNERMOST);
    let heart = q.length() - seed * 1.5;
    let shell = smooth_min(first, second, 0.05 * r);
    (shell.min(heart), if first < second { first_material } else { second_material })
}

/// One turn of the tube; `turn` is the unwound angle.
fn whorl_field(z: f64, r: f64, turn: f64, radius: f64, width: f64, ribs_per_turn: f64) -> (f64, Material) {
    if !(INNERMOST..1.2).contains(&turn) {
        return (9.0, Material::Rock);
    }
    let middle = radius * exp(GROWTH * turn);
    let lip = smoothstep(-0.16, -0.03, turn);
    let tube = middle * TUBE * (1.0 + 0.1 * lip);
    let (x, y) = ((r - middle) / tube, z / (tube * width));
    let rho = (x * x + y * y).sqrt().max(1e-6);
    let slope = ((x * x + y * y / (width * width)).sqrt() / (tube * rho)).max(1e-6);
    let around = atan2(y, x);
    let side = around.abs();
    let smooth = (rho - 1.0) / slope;
    // Far from the surface the relief fades, and where it is gone it need not be found.
    let nearby = smoothstep(0.7, 0.4, smooth.abs() / tube);
    if nearby == 0.0 && turn.abs() >= FRAC_PI_2 {
        return (if turn > 0.0 { smooth.max(r) } else { smooth }, Material::Ammonite { turn, around, rib: 0.0, tube });
    }

    // Ribs sweep forward over the outer edge and fork half-way up the flank, with a knob at the fork.
    let swept = turn - 0.10 * cos(around) + 0.045 * cos(2.0 * around);
    let phase = swept * ribs_per_turn;
    let single = 0.5 + 0.5 * cos(phase);
    let double = 0.5 + 0.5 * cos(2.0 * phase);
    let forked = smoothstep(1.35, 0.85, side);
    let crest = single + (double - single) * forked;
    let on_flank = smoothstep(2.75, 2.0, side) * smoothstep(0.1, 0.4, side);
    let knob = (1.0 - ((side - 1.42) / 0.28) * ((side - 1.42) / 0.28)).max(0.0);
    let keel = (1.0 - (side / 0.17) * (side / 0.17)).max(0.0);
    let strength = 0.8 + 0.2 * sin(turn * 1.7 + 0.6);
    let rib = crest * crest * (3.0 - 2.0 * crest) * on_flank * (1.0 - lip);
    let relief = nearby
        * tube
        * strength
        * (0.115 * rib + 0.10 * knob * knob * single * single * (1.0 - lip) + keel * keel * (0.10 + 0.03 * double));
    let mut d = smooth - relief;

    // The mouth: a flat end at turn 0, hollow behind it.
    if turn.abs() < FRAC_PI_2 {
        let past_end = r * sin(turn);
        let hollow = 0.86 * smoothstep(-0.55, -0.18, turn);
        d = smooth_max(d, past_end, 0.06 * tube);
        d = smooth_max(d, (hollow - rho) / slope, 0.06 * tube);
    } else if turn > 0.0 {
        d = d.max(r);
    }
    (d, Material::Ammonite { turn, around, rib, tube })
}

fn scallop(q: DVec3, radius: f64) -> (f64, Material) {
    const DOME: f64 = 0.42;
    let (x, y, z) = (q.x / radius, q.y / radius, q.z / radius);
    let fan = atan2(x, y + 1.02);
    let growth = (x * x + (y + 1.02) * (y + 1.02)).sqrt() / 2.02;
    let narrow = 1.0 - 0.45 * smoothstep(0.1, -1.0, y);
    let (ex, ez) = (x / narrow, z / (DOME * narrow));
    let rho = (ex * ex + y * y + ez * ez).sqrt().max(1e-6);
    let slope = ((ex * ex + y * y + ez * ez / (DOME * DOME)).sqrt() / (radius * rho)).max(1e-6);
    let crest = 0.5 + 0.5 * cos(fan * 19.0);
    let ring = growth * 9.0;
    let step = ring - floor(ring);
    let relief = radius * (0.06 * crest * smoothstep(0.1, 0.5, growth) + 0.018 * (smoothstep(0.0, 0.3, step) - step));
    ((rho - 1.0) / slope * 0.9 - relief, Material::Scallop { growth, rib: crest })
}

fn crinoid(q: DVec3, half_length: f64, radius: f64) -> (f64, Material) {
    let place = q.x / (radius * 0.55);
    let disc = floor(place);
    let edge = (place - disc - 0.5).abs() * 2.0;
    let joint = smoothstep(0.6, 1.0, edge);
    let wide = if (disc as i64).rem_euclid(3) == 0 { 1.1 } else { 1.0 };
    let bead = 1.0 + 0.03 * cos(atan2(q.z, q.y) * 10.0);
    let side = (q.y * q.y + q.z * q.z).sqrt() - radius * wide * bead * (1.0 - 0.16 * joint);
    let d = smooth_max(side, q.x.abs() - half_length, radius * 0.15);
    (d * 0.9, Material::Crinoid { joint, disc: disc as i64 })
}

fn belemnite(q: DVec3, half_length: f64, radius: f64) -> (f64, Material) {
    let along = ((q.x + half_length) / (2.0 * half_length)).clamp(0.0, 1.0);
    let taper = 1.0 - along * along * along;
    let d = smooth_max((q.y * q.y + q.z * q.z).sqrt() - radius * taper, q.x.abs() - half_length, radius * 0.3);
    (d * 0.9, Material::Belemnite { along })
}

/// Distance from the nearest suture line, in tube radii.
///
/// The lines are the edges of the chamber walls, folded into lobes on lobes.
pub(super) fn suture_distance(turn: f64, around: f64) -> f64 {
    const PER_RADIAN: f64 = 11.0 / PI;
    let place = |around: f64| {
        turn * PER_RADIAN
            + 0.50 * cos(4.0 * around)
            + 0.22 * sin(9.0 * around + 1.6 * sin(4.0 * around))
            + 0.10 * sin(23.0 * around + 1.3 * sin(9.0 * around))
    };
    let here = place(around);
    // Where the line runs along the tube, equal steps of `place` lie closer together.
    let across = (place(around + 0.01) - here) / 0.01;
    let along = PER_RADIAN * TUBE;
    (here - floor(here) - 0.5).abs() / (across * across + along * along).sqrt()
}
