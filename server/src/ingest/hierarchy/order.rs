//! Where the final ids of splits come from: bands of errors, then places along a [Morton curve](crate::mesh::morton).

use crate::pack::record::Magnitude;

/// Errors within a factor of 4 of each other, by two steps of the exponent; 0 holds the errors of zero.
pub(crate) fn error_band(error: Magnitude) -> u8 {
    if error.0 == 0 { 0 } else { 1 + ((error.0 - 1) >> 12) as u8 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_hold_a_factor_of_four() {
        let band = |x: f64| error_band(Magnitude::encode_up(x));
        assert_eq!(band(0.0), 0);
        assert!(band(1.0) > 0);
        assert_eq!(band(4.1) + 1, band(16.5));
    }
}
