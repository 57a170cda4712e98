//! sRGB bytes and linear light, with + - * / alone, so that every machine computes the same.

use std::sync::OnceLock;

/// Colour channel in 0..=1 to 0..=255; what lies outside is clamped and NaN is 0.
pub(in super::super) fn channel_from_unit(value: f64) -> u8 {
    // `as` saturates and takes NaN to 0, both of which are wanted here.
    (value * 255.0 + 0.5) as u8
}

/// sRGB in 0..=255 to the nearest byte.
pub(in super::super) fn byte(value: f64) -> u8 {
    (value + 0.5) as u8
}

/// Light of an sRGB channel in 0..=255 (IEC 61966-2-1).
fn light_of(srgb: f64) -> f64 {
    let unit = srgb / 255.0;
    if unit <= 0.04045 {
        return unit / 12.92;
    }
    let base = (unit + 0.055) / 1.055;
    // base^2.4 = base^2 * (base^2)^(1/5), the fifth root by Newton's method from above.
    let square = base * base;
    let mut root = 1.0;
    for _ in 0..60 {
        root = (4.0 * root + square / (root * root * root * root)) / 5.0;
    }
    square * root
}

struct Tables {
    /// Light of each sRGB byte.
    light: [f64; 256],
    /// `limits[b]` divides the light of byte `b` from that of `b + 1`: that of `b + 1/2`.
    limits: [f64; 255],
}

fn tables() -> &'static Tables {
    static TABLES: OnceLock<Tables> = OnceLock::new();
    TABLES.get_or_init(|| Tables {
        light: std::array::from_fn(|b| light_of(b as f64)),
        limits: std::array::from_fn(|b| light_of(b as f64 + 0.5)),
    })
}

/// Light of an sRGB channel in 0..=255, linear between bytes.
pub(in super::super) fn linear_from_srgb(srgb: f64) -> f64 {
    let light = &tables().light;
    let low = (srgb as usize).min(254);
    light[low] + (light[low + 1] - light[low]) * (srgb - low as f64)
}

/// The sRGB byte nearest to linear light; what lies outside 0..=1 is clamped and NaN is 0.
pub(in super::super) fn srgb_from_linear(light: f64) -> u8 {
    let limits = &tables().limits;
    limits.partition_point(|&limit| limit <= light) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn conversions_follow_the_formula() {
        for byte in 0..=255_u8 {
            let unit = f64::from(byte) / 255.0;
            let expected = if unit <= 0.04045 { unit / 12.92 } else { ((unit + 0.055) / 1.055_f64).powf(2.4) };
            let light = linear_from_srgb(f64::from(byte));
            assert!((light - expected).abs() < 1e-12, "{byte}");
            assert_eq!(srgb_from_linear(light), byte);
        }
        for (light, expected) in [(-1.0, 0), (f64::NAN, 0), (2.0, 255), (0.5, 188), (0.2140, 127)] {
            assert_eq!(srgb_from_linear(light), expected, "{light}");
        }
        assert_eq!([-0.1, 0.5, 1.1, f64::NAN].map(channel_from_unit), [0, 128, 255, 0]);
    }
}
