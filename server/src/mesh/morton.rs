//! The Morton curve, along which neighbours in space are neighbours in order.

/// Interleaved bits of a lattice point, 21 per axis; clamped to `0 ..= max`.
pub(crate) fn morton(at: [i32; 3], max: i32) -> u64 {
    let spread = |x: i32| {
        let mut x = u64::from(x.clamp(0, max) as u32);
        x = (x | x << 32) & 0x001f_0000_0000_ffff;
        x = (x | x << 16) & 0x001f_0000_ff00_00ff;
        x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
        x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
        (x | x << 2) & 0x1249_2492_4924_9249
    };
    spread(at[0]) | spread(at[1]) << 1 | spread(at[2]) << 2
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn morton_interleaves_and_clamps() {
        assert_eq!(morton([1, 0, 0], 7), 1);
        assert_eq!(morton([0, 1, 3], 7), 0b100_110);
        assert_eq!(morton([-5, 99, 0], 7), morton([0, 7, 0], 7));
        assert_eq!(morton([0x1f_ffff; 3], 0x1f_ffff), (1 << 63) - 1);
    }
}
