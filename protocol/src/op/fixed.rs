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

/// Most that [`mean`] divides by without a division.
const MAX_RECIPROCAL: usize = 16;

/// `2^35 / count`, rounded up.
static RECIPROCALS: [u64; MAX_RECIPROCAL + 1] = {
    let mut reciprocals = [0; MAX_RECIPROCAL + 1];
    let mut count = 1;
    while count <= MAX_RECIPROCAL {
        reciprocals[count] = (1u64 << 35).div_ceil(count as u64);
        count += 1;
    }
    reciprocals
};

/// `64 sum / count`, towards zero, of a sum of `count` numbers of at most 2^21 in magnitude; 0 without any.
#[inline]
pub(crate) fn mean(sum: i64, count: usize) -> i64 {
    if count > MAX_RECIPROCAL {
        return sum * 64 / count as i64;
    }
    // A rounded reciprocal is too large by less than `count / 2^35`, and `64 sum` is at most `count 2^27`: the product is too
    // large by less than `count^2 / 2^8 <= 1` in units of the last quotient's `1 / count`, so its floor is the quotient.
    let magnitude = (sum.unsigned_abs() * 64 * RECIPROCALS[count]) >> 35;
    if sum < 0 { -(magnitude as i64) } else { magnitude as i64 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_quotients() {
        let mut rng = fastrand::Rng::with_seed(5);
        assert_eq!(mean(0, 0), 0);
        for count in 1..40 {
            let most = (count as i64) << 21;
            let at_random = (0..5000).map(|_| rng.i64(-most..=most) >> rng.u32(0..30));
            let near_multiples = (0..4000).map(|i| most - i);
            for sum in at_random.chain(near_multiples).flat_map(|sum| [sum, -sum]) {
                assert_eq!(mean(sum, count), sum * 64 / count as i64, "{sum} / {count}");
            }
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
