//! Arithmetic and noise of the generated sample: only `+ - * /`, `sqrt` and integer operations.
//!
//! The platform's `sin`, `exp` and `atan2` differ in the last bit from one C library to the next; these polynomials do
//! not, so a sample has the same bytes everywhere. They are accurate to about 1e-7, which is plenty for a sculpture.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, LN_2, PI};

use glam::DVec3;

/// 1.5 * 2^52: adding it leaves the nearest integer in the low bits of the sum.
const TO_INTEGER: f64 = 6_755_399_441_055_744.0;

/// Largest integer not above `x`, for |x| < 2^31, as float and as integer.
fn split(x: f64) -> (f64, i32) {
    let shifted = x + TO_INTEGER;
    let nearest = shifted - TO_INTEGER;
    let above = nearest > x;
    (nearest - f64::from(u8::from(above)), (shifted.to_bits() as i32).wrapping_sub(i32::from(above)))
}

/// Largest integer not above `x`, for |x| < 2^31.
pub(super) fn floor(x: f64) -> f64 {
    split(x).0
}

fn round(x: f64) -> f64 {
    floor(x + 0.5)
}

/// Sine of an angle in radians.
pub(super) fn sin(x: f64) -> f64 {
    // Reduced to [-pi/2, pi/2], where the Taylor series to x^11 is within 6e-8.
    let turns = round(x / PI);
    let r = x - turns * PI;
    let r2 = r * r;
    let odd = (turns as i64) & 1 == 1;
    let s = r
        * (1.0
            + r2 * (-1.0 / 6.0
                + r2 * (1.0 / 120.0 + r2 * (-1.0 / 5040.0 + r2 * (1.0 / 362_880.0 - r2 / 39_916_800.0)))));
    if odd { -s } else { s }
}

/// Cosine of an angle in radians.
pub(super) fn cos(x: f64) -> f64 {
    sin(x + FRAC_PI_2)
}

/// Angle of the point (x, y) in (-pi, pi]; 0 at the origin.
pub(super) fn atan2(y: f64, x: f64) -> f64 {
    let (ax, ay) = (x.abs(), y.abs());
    let (small, large) = if ax < ay { (ax, ay) } else { (ay, ax) };
    if large == 0.0 {
        return 0.0;
    }
    let ratio = small / large;
    // atan(q) = pi/4 + atan((q - 1) / (q + 1)) keeps the series argument below tan(pi/8).
    let (t, base) = if ratio > 0.414_213_562 { ((ratio - 1.0) / (ratio + 1.0), FRAC_PI_4) } else { (ratio, 0.0) };
    let t2 = t * t;
    let series = 1.0
        + t2 * (-1.0 / 3.0 + t2 * (1.0 / 5.0 + t2 * (-1.0 / 7.0 + t2 * (1.0 / 9.0 + t2 * (-1.0 / 11.0 + t2 / 13.0)))));
    let mut angle = base + t * series;
    if ax < ay {
        angle = FRAC_PI_2 - angle;
    }
    if x < 0.0 {
        angle = PI - angle;
    }
    if y < 0.0 { -angle } else { angle }
}

/// Natural logarithm of a normal positive number.
pub(super) fn ln(x: f64) -> f64 {
    let bits = x.to_bits();
    let mut exponent = ((bits >> 52) & 0x7ff) as i64 - 1023;
    let mut m = f64::from_bits((bits & 0x000f_ffff_ffff_ffff) | (1023 << 52));
    if m > std::f64::consts::SQRT_2 {
        m *= 0.5;
        exponent += 1;
    }
    let s = (m - 1.0) / (m + 1.0);
    let s2 = s * s;
    2.0 * s * (1.0 + s2 * (1.0 / 3.0 + s2 * (1.0 / 5.0 + s2 * (1.0 / 7.0 + s2 / 9.0)))) + exponent as f64 * LN_2
}

/// e to the power `x`, for |x| < 700.
pub(super) fn exp(x: f64) -> f64 {
    let n = round(x / LN_2);
    let r = x - n * LN_2;
    let series = 1.0
        + r * (1.0
            + r * (0.5 + r * (1.0 / 6.0 + r * (1.0 / 24.0 + r * (1.0 / 120.0 + r * (1.0 / 720.0 + r / 5040.0))))));
    series * f64::from_bits(((n as i64 + 1023) as u64) << 52)
}

/// `a` at 0, `b` at 1.
pub(super) fn mix(a: f64, b: f64, t: f64) -> f64 {
    a + (b - a) * t
}

/// 0 below `lo`, 1 above `hi`, a cubic between; `lo > hi` falls instead of rising.
pub(super) fn smoothstep(lo: f64, hi: f64, x: f64) -> f64 {
    let t = ((x - lo) / (hi - lo)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Smaller of two distances, rounded within `k` of a tie; exactly the smaller one further away.
pub(super) fn smooth_min(a: f64, b: f64, k: f64) -> f64 {
    let h = k - (a - b).abs();
    if h <= 0.0 { a.min(b) } else { a.min(b) - h * h / (4.0 * k) }
}

/// Larger of two distances, rounded within `k` of a tie.
pub(super) fn smooth_max(a: f64, b: f64, k: f64) -> f64 {
    -smooth_min(-a, -b, k)
}

/// 32 well-mixed bits for a lattice point.
pub(super) fn hash(x: i64, y: i64, z: i64, seed: u32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x9e37_79b1)
        ^ (y as u32).wrapping_mul(0x85eb_ca77).rotate_left(11)
        ^ (z as u32).wrapping_mul(0xc2b2_ae3d).rotate_left(22)
        ^ seed.wrapping_mul(0x27d4_eb2f);
    h ^= h >> 15;
    h = h.wrapping_mul(0x2c1b_3c6d);
    h ^= h >> 12;
    h = h.wrapping_mul(0x297a_2d39);
    h ^ (h >> 15)
}

/// A number in [0, 1) from ten bits of a hash.
pub(super) fn unit(bits: u32) -> f64 {
    f64::from(bits & 0x3ff) / 1024.0
}

/// About normal with mean 0 and deviation 1, within 3.5: the sum of four uniform numbers.
pub(super) fn gaussian(index: i64, seed: u32) -> f64 {
    let (a, b) = (hash(index, 0, 1, seed), hash(index, 0, 2, seed));
    (unit(a) + unit(a >> 16) + unit(b) + unit(b >> 16) - 2.0) * 1.732_050_807_568_877
}

/// Directions from the middle of a cube to its edges, four of them twice, scaled so that noise is about -1..1.
const GRADIENTS: [[f64; 3]; 16] = {
    const G: f64 = 0.87;
    [
        [G, G, 0.0],
        [-G, G, 0.0],
        [G, -G, 0.0],
        [-G, -G, 0.0],
        [G, 0.0, G],
        [-G, 0.0, G],
        [G, 0.0, -G],
        [-G, 0.0, -G],
        [0.0, G, G],
        [0.0, -G, G],
        [0.0, G, -G],
        [0.0, -G, -G],
        [G, G, 0.0],
        [-G, G, 0.0],
        [0.0, -G, G],
        [0.0, -G, -G],
    ]
};

/// Gradient noise (Perlin 2002): continuous, about -1..1, mean 0, features one unit across.
pub(super) fn noise(p: DVec3, seed: u32) -> f64 {
    let [(cx, ix), (cy, iy), (cz, iz)] = [split(p.x), split(p.y), split(p.z)];
    let (x, y, z) = (p.x - cx, p.y - cy, p.z - cz);
    let spread = |i: i32, factor: u32| [i, i.wrapping_add(1)].map(|i| (i as u32).wrapping_mul(factor));
    let hx = spread(ix, 0x9e37_79b1);
    let hy = spread(iy, 0x85eb_ca77).map(|h| h.rotate_left(11));
    let hz = spread(iz, 0xc2b2_ae3d).map(|h| h.rotate_left(22) ^ seed.wrapping_mul(0x27d4_eb2f));
    let corner = |dx: usize, dy: usize, dz: usize| {
        let mut h = hx[dx] ^ hy[dy] ^ hz[dz];
        h = (h ^ h >> 15).wrapping_mul(0x2c1b_3c6d);
        let g = GRADIENTS[(h >> 28) as usize];
        g[0] * (x - dx as f64) + g[1] * (y - dy as f64) + g[2] * (z - dz as f64)
    };
    let fade = |t: f64| t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
    let (u, v, w) = (fade(x), fade(y), fade(z));
    let plane = |dz: usize| {
        let front = mix(corner(0, 0, dz), corner(1, 0, dz), u);
        let back = mix(corner(0, 1, dz), corner(1, 1, dz), u);
        mix(front, back, v)
    };
    mix(plane(0), plane(1), w)
}

/// Sum of noise octaves, each of 0.56 times the amplitude and about half the wavelength of the one before; about -1..1.
pub(super) fn fractal(p: DVec3, octaves: u32, seed: u32) -> f64 {
    let mut sum = 0.0;
    let mut amplitude = 0.5;
    let mut q = p;
    for octave in 0..octaves {
        sum += amplitude * noise(q, seed.wrapping_add(octave * 131));
        // A swap of axes hides that the lattices are aligned.
        q = DVec3::new(q.y * 2.03 + 7.1, q.z * 2.03 - 3.7, q.x * 2.03 + 1.9);
        amplitude *= 0.56;
    }
    sum
}

/// Distances to the nearest and second-nearest of one random point per unit cell, and the hash of the nearest.
pub(super) struct Cells {
    pub(super) nearest: f64,
    pub(super) second: f64,
    pub(super) id: u32,
}

/// Cellular noise at `p`.
pub(super) fn cells(p: DVec3, seed: u32) -> Cells {
    let [(cx, ix), (cy, iy), (cz, iz)] = [split(p.x), split(p.y), split(p.z)].map(|(c, i)| (c, i64::from(i)));
    let f = p - DVec3::new(cx, cy, cz);
    let mut best = Cells { nearest: 9.0, second: 9.0, id: 0 };
    for dz in -1..=1 {
        for dy in -1..=1 {
            for dx in -1..=1 {
                let h = hash(ix + dx, iy + dy, iz + dz, seed);
                let to = DVec3::new(dx as f64 + unit(h), dy as f64 + unit(h >> 10), dz as f64 + unit(h >> 20)) - f;
                let d2 = to.dot(to);
                if d2 < best.nearest {
                    best = Cells { nearest: d2, second: best.nearest, id: h };
                } else if d2 < best.second {
                    best.second = d2;
                }
            }
        }
    }
    Cells { nearest: best.nearest.sqrt(), second: best.second.sqrt(), id: best.id }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polynomials_follow_the_library() {
        for i in -4000..4000 {
            let x = f64::from(i) * 0.0037;
            assert!((sin(x) - x.sin()).abs() < 2e-7, "sin {x}");
            assert!((cos(x) - x.cos()).abs() < 2e-7, "cos {x}");
            assert!((exp(x) / x.exp() - 1.0).abs() < 2e-7, "exp {x}");
            assert!((ln(x.abs() + 1e-3) - (x.abs() + 1e-3).ln()).abs() < 1e-8, "ln {x}");
            let (y, z) = (x.sin(), (1.7 * x).cos());
            assert!((atan2(y, z) - y.atan2(z)).abs() < 2e-7, "atan2 {y} {z}");
            assert_eq!(floor(x), x.floor());
        }
    }

    #[test]
    fn noise_is_continuous_and_bounded() {
        let mut previous = noise(DVec3::ZERO, 1);
        for i in 0..20_000 {
            let p = DVec3::new(0.731, 0.53, -0.211) * (f64::from(i) * 0.002);
            let value = noise(p, 1);
            assert!(value.abs() < 1.6);
            assert!((value - previous).abs() < 0.02, "jump at {i}");
            previous = value;
        }
    }
}
