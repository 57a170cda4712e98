//! Logarithms and powers of two on integers, alike on every machine.

/// Units of [`lg`] per doubling.
pub(crate) const LG_ONE: i32 = 16;

/// `16 log2(x)`, linear between powers of two, which is at most 1.4 too low; 0 for `x == 0`.
#[inline]
pub(crate) fn lg(x: u64) -> i32 {
    let x = x.max(1);
    let exponent = 63 - x.leading_zeros();
    let mantissa = (x << (63 - exponent)) >> 59 & 15;
    exponent as i32 * LG_ONE + mantissa as i32
}

/// `2^16 * 2^(i / 16)`, rounded.
const POWERS: [u32; 16] = [
    65_536, 68_438, 71_468, 74_632, 77_936, 81_386, 84_990, 88_752, 92_682, 96_785, 101_070, 105_545, 110_218, 115_098,
    120_194, 125_515,
];

/// `2^16 * 2^(x / 16)` for `x` at most 0, and at least 1.
#[inline]
pub(crate) const fn power(x: i32) -> u32 {
    let down = (-x) as u32;
    let (whole, part) = (down.div_ceil(16), (16 - down % 16) % 16);
    match POWERS[part as usize].checked_shr(whole) {
        None | Some(0) => 1,
        Some(power) => power,
    }
}

/// Counts with a reciprocal in the table.
const RECIPROCALS: usize = 64;

static TABLE: [u32; RECIPROCALS] = {
    let mut table = [0; RECIPROCALS];
    let mut count = 1;
    while count < RECIPROCALS {
        table[count] = divided(count);
        count += 1;
    }
    table
};

const fn divided(count: usize) -> u32 {
    (((1 << 16) + count / 2) / count) as u32
}

/// `2^16 / count`, rounded; 0 for no count.
#[inline]
pub(crate) fn reciprocal(count: usize) -> u32 {
    TABLE.get(count).copied().unwrap_or_else(|| divided(count))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reciprocals_are_rounded_quotients() {
        assert_eq!(reciprocal(0), 0);
        for count in 1..300 {
            assert_eq!(reciprocal(count), (65_536.0 / count as f64).round() as u32, "{count}");
        }
    }

    #[test]
    fn they_follow_the_floats() {
        for x in (1..5000u64).chain((0..60).map(|k| (1 << k) + 77)) {
            let exact = 16.0 * (x as f64).log2();
            let got = f64::from(lg(x));
            assert!(got <= exact && got > exact - 2.4, "{x}: {got} for {exact}");
        }
        assert_eq!(lg(0), 0);
        for x in -300..=0 {
            let exact = 65_536.0 * (f64::from(x) / 16.0).exp2();
            assert!((f64::from(power(x)) - exact).abs() <= 1.0, "{x}: {} for {exact}", power(x));
        }
    }
}
