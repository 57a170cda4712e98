//! Percentiles of any number of samples in bounded memory.

use serde::Serialize;

/// Buckets per power of two: what is reported lies at most 1/128 above the sample.
const STEPS: u64 = 128;

/// Counts of samples in buckets whose width grows with the value, as HdrHistogram does: exact below 256, then 128 buckets
/// for every power of two, so 60 KB at most. The largest sample is kept exactly.
#[derive(Clone, Debug, Default)]
pub(super) struct Histogram {
    buckets: Vec<u64>,
    count: u64,
    sum: f64,
    max: u64,
}

/// What a [`Histogram`] says, in the unit of the report.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Percentiles {
    /// Samples.
    pub count: u64,
    /// Mean.
    pub mean: f64,
    /// Half of the samples are at most this; it lies at most 1 % above the sample of that rank.
    pub p50: f64,
    /// Likewise for 90 %.
    pub p90: f64,
    /// Likewise for 99 %.
    pub p99: f64,
    /// The largest sample.
    pub max: f64,
}

impl Histogram {
    pub(super) fn add(&mut self, value: u64) {
        let bucket = bucket(value);
        if self.buckets.len() <= bucket {
            self.buckets.resize(bucket + 1, 0);
        }
        self.buckets[bucket] += 1;
        self.count += 1;
        self.sum += value as f64;
        self.max = self.max.max(value);
    }

    /// The largest value of the bucket with the sample of rank `ceil(share * count)`; `share` is above 0 and at most 1.
    fn percentile(&self, share: f64) -> u64 {
        let rank = ((share * self.count as f64).ceil() as u64).max(1);
        let mut below = 0;
        for (bucket, &count) in self.buckets.iter().enumerate() {
            below += count;
            if below >= rank {
                return last_of(bucket).min(self.max);
            }
        }
        self.max
    }

    /// Value at every percent from 1 to 100, divided by `unit`; empty without samples.
    pub(super) fn curve(&self, unit: f64) -> Vec<(f64, f64)> {
        let most = if self.count > 0 { 100u32 } else { 0 };
        let share = |percent: u32| f64::from(percent) / 100.0;
        (1..=most).map(|percent| (share(percent), self.percentile(share(percent)) as f64 / unit)).collect()
    }

    /// Percentiles, values divided by `unit`; `None` without samples.
    pub(super) fn summary(&self, unit: f64) -> Option<Percentiles> {
        let percentile = |share| self.percentile(share) as f64 / unit;
        (self.count > 0).then(|| Percentiles {
            count: self.count,
            mean: self.sum / self.count as f64 / unit,
            p50: percentile(0.5),
            p90: percentile(0.9),
            p99: percentile(0.99),
            max: self.max as f64 / unit,
        })
    }
}

/// Bucket of a value: values below 256 have one each, then the seven bits after the leading one count.
fn bucket(value: u64) -> usize {
    let shift = shift(value);
    (u64::from(shift) * STEPS + (value >> shift)) as usize
}

/// How many low bits do not count.
fn shift(value: u64) -> u32 {
    (u64::BITS - value.leading_zeros()).saturating_sub(STEPS.trailing_zeros() + 1)
}

/// The largest value of a bucket.
fn last_of(bucket: usize) -> u64 {
    let bucket = bucket as u64;
    let shift = (bucket / STEPS).saturating_sub(1);
    let first = (bucket - shift * STEPS) << shift;
    first + ((1 << shift) - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sorts and counts.
    fn dull(samples: &[u64], share: f64) -> u64 {
        let mut sorted = samples.to_vec();
        sorted.sort_unstable();
        let below = |value: u64| sorted.iter().filter(|&&other| other <= value).count() as f64;
        sorted.iter().copied().find(|&value| below(value) >= share * sorted.len() as f64).unwrap()
    }

    #[test]
    fn percentiles_are_those_of_the_sorted_samples_within_a_bucket() {
        let mut rng = fastrand::Rng::with_seed(11);
        for round in 0..200 {
            let bits = rng.u32(1..=64);
            let samples: Vec<u64> = (0..rng.usize(1..300)).map(|_| rng.u64(..) >> (64 - bits)).collect();
            let mut histogram = Histogram::default();
            samples.iter().for_each(|&sample| histogram.add(sample));
            for share in [0.001, 0.5, 0.9, 0.99, 1.0] {
                let (exact, found) = (dull(&samples, share), histogram.percentile(share));
                assert!(found >= exact && found - exact <= exact / STEPS, "{round}: {found} for {exact} at {share}");
            }
            let summary = histogram.summary(1000.0).unwrap();
            let curve = histogram.curve(1000.0);
            assert_eq!(
                [curve[49], curve[89], curve[98], curve[99]],
                [(0.5, summary.p50), (0.9, summary.p90), (0.99, summary.p99), (1.0, summary.max)]
            );
            assert!(curve.is_sorted_by(|a, b| a.1 <= b.1));
            assert_eq!(summary.max, *samples.iter().max().unwrap() as f64 / 1000.0);
            let mean = samples.iter().map(|&sample| sample as f64).sum::<f64>() / samples.len() as f64;
            assert!((summary.mean * 1000.0 / mean.max(1e-9) - 1.0).abs() < 1e-9 || mean == 0.0);
        }
        assert_eq!((Histogram::default().summary(1.0), Histogram::default().curve(1.0)), (None, Vec::new()));
    }

    #[test]
    fn buckets_tile_the_numbers() {
        let mut first = 0u64;
        for bucket_number in 0.. {
            let last = last_of(bucket_number);
            assert_eq!((bucket(first), bucket(last)), (bucket_number, bucket_number), "{first} to {last}");
            if last == u64::MAX {
                break;
            }
            first = last + 1;
        }
    }
}
