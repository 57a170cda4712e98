//! How far the camera has moved, as what it sees from various distances.
//!
//! A sphere at distance `d` sees the eye move by the way it went plus `d` times the angle it turned by (ALGORITHMS 3.2). Seen from
//! the camera, nothing in the model's box moves farther than its corners do, which is less where the camera orbits what it looks at. What
//! faces where is a matter of the eye's way alone. For each band of distances the sum of these steps is kept; a test whose answer holds
//! for some motion is due when its band's sum has grown by that much.

use glam::{DQuat, DVec3};

/// Bands per octave of distance.
const BANDS_PER_OCTAVE: f64 = 4.0;
/// Distances, in lattice steps, go to 2^44: coordinates have up to 21 bits, and eyes stand off.
const BANDS: usize = 176;
/// Updates after which sums begin at zero again, so that their rounding stays small.
const UPDATES_PER_EPOCH: u32 = 256;

#[derive(Debug)]
pub(super) struct Motion {
    last: Option<(DVec3, DQuat)>,
    exact: [f64; BANDS],
    sums: [f32; BANDS],
    updates: u32,
}

impl Default for Motion {
    fn default() -> Self {
        Self { last: None, exact: [0.0; BANDS], sums: [0.0; BANDS], updates: 0 }
    }
}

impl Motion {
    /// The camera is now there. `model_box` holds all that is tested, unless what is seen does not go by the camera's place alone
    /// (parallel rays). Returns the sums from which all that is due has to be reduced, when an epoch ends.
    pub(super) fn go_on(&mut self, eye: DVec3, rotation: DQuat, model_box: Option<[DVec3; 2]>) -> Option<[f32; BANDS]> {
        let ended = (self.updates >= UPDATES_PER_EPOCH).then_some(self.sums);
        if ended.is_some() {
            (self.exact, self.updates) = ([0.0; BANDS], 0);
        }
        self.updates += 1;
        if let Some((before, rotated)) = self.last {
            let way = eye.distance(before);
            let turn = rotated.inverse() * rotation;
            let angle = 2.0 * DVec3::new(turn.x, turn.y, turn.z).length().atan2(turn.w.abs()) * (1.0 + 1e-9);
            let seen = |eye: DVec3, rotation: DQuat, point: DVec3| rotation.inverse() * (point - eye);
            let most = model_box.map_or(f64::INFINITY, |sides| {
                let corner = |i: usize| DVec3::new(sides[i & 1].x, sides[i >> 1 & 1].y, sides[i >> 2].z);
                let moved = |point| seen(eye, rotation, point).distance(seen(before, rotated, point));
                (0..8).map(|i| moved(corner(i))).fold(way, f64::max) * (1.0 + 1e-9)
            });
            for (band, sum) in self.exact.iter_mut().enumerate() {
                *sum += (way + far_end(band) * angle).min(most);
            }
        }
        self.last = Some((eye, rotation));
        for (sum, &exact) in self.sums.iter_mut().zip(&self.exact) {
            // Eyes may be anywhere a number can be.
            *sum = if exact.is_nan() { f32::INFINITY } else { up(exact) };
        }
        ended
    }

    /// Band of a test, and when its answer is due that holds for a motion of `slack` lattice steps at a distance that is now
    /// `distance`.
    #[inline]
    pub(super) fn due(&self, distance: f64, slack: f64) -> (u8, f32) {
        if slack <= 0.0 {
            return (0, f32::NEG_INFINITY);
        }
        let slack = slack.min(distance);
        let band = band_of(distance + slack);
        // Sums are rounded up.
        (band, down(f64::from(self.sums[usize::from(band)].next_down()) + slack))
    }

    #[inline]
    pub(super) fn sums(&self) -> &[f32; BANDS] {
        &self.sums
    }
}

/// First band all of whose distances may be as large as that.
#[inline]
fn band_of(distance: f64) -> u8 {
    // A logarithm by the bits: linear between powers of two, too low by at most 0.086.
    let bits = distance.to_bits();
    let log = (bits >> 32) as f64 / f64::from(1u32 << 20) - 1023.0 + 0.087;
    (log * BANDS_PER_OCTAVE).ceil().clamp(0.0, BANDS as f64 - 1.0) as u8
}

/// Largest distance of a band.
fn far_end(band: usize) -> f64 {
    (band as f64 / BANDS_PER_OCTAVE).exp2()
}

fn up(x: f64) -> f32 {
    let rounded = x as f32;
    if f64::from(rounded) < x { rounded.next_up() } else { rounded }
}

fn down(x: f64) -> f32 {
    let rounded = x as f32;
    if f64::from(rounded) > x { rounded.next_down() } else { rounded }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_reach_as_far_as_what_is_in_them() {
        let mut distance = 1e-3;
        while distance < 1e12 {
            let band = usize::from(band_of(distance));
            assert!(far_end(band) >= distance, "{distance} in band {band}");
            assert!(band == 0 || far_end(band) <= 1.3 * distance, "{distance} in band {band}");
            distance *= 1.01;
        }
    }

    #[test]
    fn no_point_moves_farther_than_the_sum_of_its_band() {
        let mut rng = fastrand::Rng::with_seed(1);
        let mut random = |scale: f64| DVec3::from_array(std::array::from_fn(|_| (rng.f64() - 0.5) * scale));
        let sides = [DVec3::splat(-100.0), DVec3::splat(100.0)];
        for _ in 0..200 {
            let mut motion = Motion::default();
            let (mut eye, mut rotation) = (random(800.0), DQuat::from_scaled_axis(random(3.0)));
            motion.go_on(eye, rotation, Some(sides));
            let point = random(200.0);
            let (first, distance, way_from) = (rotation.inverse() * (point - eye), point.distance(eye), eye);
            let mut farthest = 0f64;
            for _ in 0..20 {
                eye += random(10.0);
                rotation = DQuat::from_scaled_axis(random(0.02)) * rotation;
                motion.go_on(eye, rotation, Some(sides));
                let moved = (rotation.inverse() * (point - eye)).distance(first).max(eye.distance(way_from));
                farthest = farthest.max(moved);
                let slack = farthest * 0.999;
                if slack < distance {
                    let band = usize::from(band_of(distance + slack));
                    assert!(f64::from(motion.sums()[band]) >= slack, "{} after {farthest}", motion.sums()[band]);
                }
            }
        }
    }
}
