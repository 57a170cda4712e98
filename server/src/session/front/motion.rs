//! How far the camera has moved, as what it sees from various distances.
//!
//! A sphere at distance `d` sees the eye move by the way it went plus `d` times the angle it turned by (ALGORITHMS 3.2). For
//! each octave of distances the sum of both, for the far end of the next octave, is kept; a test whose answer holds for some motion is due
//! when its octave's sum has grown by that much.

use glam::{DQuat, DVec3};

/// Octaves of distances, in lattice steps: coordinates have up to 21 bits, and eyes stand off.
const OCTAVES: usize = 48;
/// Updates after which sums begin at zero again, so that their rounding stays small.
const UPDATES_PER_EPOCH: u32 = 256;

#[derive(Debug)]
pub(super) struct Motion {
    last: Option<(DVec3, DQuat)>,
    way: f64,
    angle: f64,
    sums: [f32; OCTAVES],
    updates: u32,
}

impl Default for Motion {
    fn default() -> Self {
        Self { last: None, way: 0.0, angle: 0.0, sums: [0.0; OCTAVES], updates: 0 }
    }
}

impl Motion {
    /// The camera is now there. Returns the sums from which all that is due has to be reduced, when an epoch ends.
    pub(super) fn go_on(&mut self, eye: DVec3, rotation: DQuat) -> Option<[f32; OCTAVES]> {
        let ended = (self.updates >= UPDATES_PER_EPOCH).then_some(self.sums);
        if ended.is_some() {
            (self.way, self.angle, self.updates) = (0.0, 0.0, 0);
        }
        self.updates += 1;
        if let Some((before, rotated)) = self.last {
            self.way += eye.distance(before);
            let turn = rotated.inverse() * rotation;
            self.angle += 2.0 * DVec3::new(turn.x, turn.y, turn.z).length().atan2(turn.w.abs()) * (1.0 + 1e-9);
        }
        self.last = Some((eye, rotation));
        for (octave, sum) in self.sums.iter_mut().enumerate() {
            *sum = up(self.way + 2.0 * (octave as f64).exp2() * self.angle);
        }
        ended
    }

    /// Octave of a distance.
    #[inline]
    pub(super) fn octave(distance: f64) -> u8 {
        // The exponent of a power of two that is not less.
        let exponent = (distance.to_bits() >> 52) as i64 - 1023 + 1;
        exponent.clamp(0, OCTAVES as i64 - 1) as u8
    }

    /// When an answer is due that holds for a motion of `slack` lattice steps as seen from within an octave.
    #[inline]
    pub(super) fn due(&self, octave: u8, slack: f64) -> f32 {
        // Beyond that, the distance may have doubled.
        let slack = slack.min((f64::from(octave)).exp2());
        if slack <= 0.0 {
            return f32::NEG_INFINITY;
        }
        // Sums are rounded up.
        down(f64::from(self.sums[usize::from(octave)].next_down()) + slack)
    }

    #[inline]
    pub(super) fn sums(&self) -> &[f32; OCTAVES] {
        &self.sums
    }
}

fn up(x: f64) -> f32 {
    let rounded = x as f32;
    if f64::from(rounded) < x { rounded.next_up() } else { rounded }
}

fn down(x: f64) -> f32 {
    let rounded = x as f32;
    if f64::from(rounded) > x { rounded.next_down() } else { rounded }
}
