//! Numbers in text files: exact, and several times faster than `str::parse` on what scanners write.

/// Powers of ten that `f64` holds exactly.
const POWERS: [f64; 23] = [
    1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20,
    1e21, 1e22,
];

/// Reads a decimal number, correctly rounded, or `None` if `token` is none.
///
/// `nan` and `inf` in any case, and the spellings of old C libraries (`1.#QNAN`, `-1.#INF`), are numbers that are
/// not finite: cleaning drops the faces that use them. Cost is linear in the length of the token.
#[inline]
pub(super) fn parse_f64(token: &[u8]) -> Option<f64> {
    match parse_short(token) {
        Some(value) => Some(value),
        None => parse_long(token),
    }
}

/// Clinger's fast path: a mantissa below 2^53 times or over a power of ten up to 10^22 is one exact operand each, so
/// the one rounding of the product or quotient is the correct one.
#[inline]
fn parse_short(token: &[u8]) -> Option<f64> {
    let (negative, digits) = match token {
        [b'-', rest @ ..] => (true, rest),
        [b'+', rest @ ..] => (false, rest),
        _ => (false, token),
    };
    // 18 digits and a point stay below 2^63; longer ones take the other path.
    if digits.len() > 24 {
        return None;
    }
    let mut mantissa = 0_u64;
    let mut digit_count = 0;
    let mut fraction = 0;
    let mut seen_point = false;
    let mut at = 0;
    while let Some(&byte) = digits.get(at) {
        if byte.is_ascii_digit() {
            if digit_count == 18 {
                return None;
            }
            mantissa = mantissa * 10 + u64::from(byte - b'0');
            digit_count += 1;
            fraction += i32::from(seen_point);
        } else if byte == b'.' && !seen_point {
            seen_point = true;
        } else {
            break;
        }
        at += 1;
    }
    if digit_count == 0 || mantissa > 1 << 53 {
        return None;
    }
    let mut exponent = -fraction;
    if at < digits.len() {
        if !matches!(digits[at], b'e' | b'E') {
            return None;
        }
        let written = i32::try_from(parse_i64(&digits[at + 1..])?).ok()?;
        exponent = exponent.checked_add(written)?;
    }
    let power = *POWERS.get(exponent.unsigned_abs() as usize)?;
    let value = if exponent < 0 { mantissa as f64 / power } else { mantissa as f64 * power };
    Some(if negative { -value } else { value })
}

#[cold]
fn parse_long(token: &[u8]) -> Option<f64> {
    let text = std::str::from_utf8(token).ok()?;
    if let Ok(value) = text.parse() {
        return Some(value);
    }
    let (_, tail) = text.split_once(".#")?;
    if tail.starts_with("INF") { Some(f64::INFINITY) } else { Some(f64::NAN) }
}

/// Reads an integer with an optional sign, or `None` if `token` is none or does not fit.
#[inline]
pub(super) fn parse_i64(token: &[u8]) -> Option<i64> {
    let (negative, digits) = match token {
        [b'-', rest @ ..] => (true, rest),
        [b'+', rest @ ..] => (false, rest),
        _ => (false, token),
    };
    // 18 digits cannot overflow, and nothing that is counted needs more.
    if digits.is_empty() || digits.len() > 18 {
        return None;
    }
    let mut value = 0_i64;
    for &byte in digits {
        if !byte.is_ascii_digit() {
            return None;
        }
        value = value * 10 + i64::from(byte - b'0');
    }
    Some(if negative { -value } else { value })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_equal_those_of_the_standard_library() {
        let mut random = fastrand::Rng::with_seed(1);
        let mut short = 0;
        for round in 0..200_000 {
            let value = match round % 4 {
                0 => f64::from_bits(random.u64(..)),
                1 => f64::from(random.f32() * 200.0 - 100.0),
                2 => (random.f64() * 2e6).floor() / 1e3,
                _ => random.f64(),
            };
            let text = match round % 3 {
                0 => format!("{value}"),
                1 => format!("{value:e}"),
                _ => format!("{value:.6}"),
            };
            let expected: f64 = text.parse().unwrap();
            let actual = parse_f64(text.as_bytes()).unwrap();
            assert!(actual == expected || (actual.is_nan() && expected.is_nan()), "{text}: {actual} {expected}");
            short += usize::from(parse_short(text.as_bytes()).is_some());
        }
        assert!(short > 50_000, "{short} took the fast path");
    }

    #[test]
    fn odd_spellings_are_read_and_nonsense_is_not() {
        for (text, expected) in [
            ("1.", 1.0),
            (".5", 0.5),
            ("+2", 2.0),
            ("1e+3", 1000.0),
            ("-0", -0.0),
            ("0.1e-5", 0.1e-5),
            ("inf", f64::INFINITY),
            ("1.#INF", f64::INFINITY),
            ("123456789012345678901234567890", 123456789012345678901234567890.0),
        ] {
            assert_eq!(parse_f64(text.as_bytes()).map(f64::to_bits), Some(f64::to_bits(expected)), "{text}");
        }
        assert!(parse_f64(b"-1.#IND").is_some_and(f64::is_nan));
        for text in ["", ".", "-", "1e", "1e+", "1,5", "0x10", "1.2.3", "--1", "1 ", "e5", "\u{663}"] {
            assert_eq!(parse_f64(text.as_bytes()), None, "{text}");
        }
        assert_eq!(parse_i64(b"-12"), Some(-12));
        for text in ["", "-", "1.0", "1234567890123456789"] {
            assert_eq!(parse_i64(text.as_bytes()), None, "{text}");
        }
    }
}
