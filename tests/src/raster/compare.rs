//! How far two pictures differ.

use super::Image;

/// Differences between two pictures of one size, in units of 8-bit channels.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageDifference {
    /// Mean over pixels and channels of the absolute difference, 0..=255.
    pub mean: f64,
    /// Largest absolute difference of any channel.
    pub max: u8,
    /// Pixels that one picture covers and the other does not.
    pub silhouette_pixels: usize,
    /// Per value, the pixels whose worst channel differs by it.
    histogram: Box<[usize; 256]>,
}

impl ImageDifference {
    /// Share of pixels, 0..=1, whose worst channel differs by more than `threshold`.
    pub fn share_over(&self, threshold: u8) -> f64 {
        let over: usize = self.histogram[usize::from(threshold) + 1..].iter().sum();
        over as f64 / self.histogram.iter().sum::<usize>().max(1) as f64
    }
}

/// Compares two pictures pixel by pixel.
///
/// # Panics
/// When their sizes differ.
pub fn compare(a: &Image, b: &Image) -> ImageDifference {
    assert_eq!((a.width, a.height), (b.width, b.height), "pictures of different sizes");
    let mut histogram = Box::new([0; 256]);
    let mut sum = 0u64;
    for (p, q) in a.rgba.chunks_exact(4).zip(b.rgba.chunks_exact(4)) {
        let differences: [u8; 3] = std::array::from_fn(|k| p[k].abs_diff(q[k]));
        sum += differences.iter().map(|&d| u64::from(d)).sum::<u64>();
        let [r, g, b] = differences;
        histogram[usize::from(r.max(g).max(b))] += 1;
    }
    let pixels = a.hits.len();
    let max = histogram.iter().rposition(|&count| count > 0).unwrap_or(0);
    ImageDifference {
        mean: sum as f64 / (3 * pixels).max(1) as f64,
        max: u8::try_from(max).expect("256 entries"),
        silhouette_pixels: a.hits.iter().zip(&b.hits).filter(|(p, q)| p.is_some() != q.is_some()).count(),
        histogram,
    }
}
