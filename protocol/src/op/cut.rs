//! Coding of where a split opens the fan of `s`.
//!
//! On a closed fan of ordinary valence the arc length comes first, by valence and by how long the ring's edges are. All starts of
//! such an arc are then ranked by a linear score of what the ring looks like: the two spokes that the split opens are short and the
//! ones that go to the new vertex are long, since the collapse stretched them. The start is coded as "is it this one?" from the
//! likeliest on, each flag under a context that says how likely the score finds it among those left. Elsewhere the start is coded
//! at even odds.

use super::fixed::{lg, power};
use super::local::Ring;
use super::range_coder::{BitCoder, Prob, TreeModel, contexts, uniform};
use super::trained::{ArcWeights, CutWeights};
use crate::mesh::{Cut, Fan};

/// Valences whose cuts are ranked.
pub(crate) const RANKED_VALENCES: std::ops::RangeInclusive<u32> = MIN_RANKED_VALENCE..=MAX_RANKED_VALENCE;
const MIN_RANKED_VALENCE: u32 = 3;
/// The largest valence whose cuts are ranked.
pub const MAX_RANKED_VALENCE: u32 = 12;
/// The same as a length.
const MAX_SPOKES: usize = MAX_RANKED_VALENCE as usize;
const VALENCES: usize = (MAX_RANKED_VALENCE - MIN_RANKED_VALENCE + 1) as usize;
/// Classes of the mean edge of the ring against the mean spoke, in eighths of an octave.
const EDGE_CLASSES: usize = 8;
/// Classes of the odds of a candidate, in half octaves about even.
const ODDS: usize = 32;

/// Adaptive contexts of cuts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct CutModels {
    open_case: [Prob; 2],
    /// Whether a candidate is it, by its rank (first, second, later) and its odds among those left.
    is_it: [[Prob; ODDS]; 3],
    /// Where cuts are ranked, by valence and by how long the ring's edges are against the spokes: whether the arc is longer than 2,
    /// then than 1, then than 3 and so on.
    arc: [[[Prob; MAX_SPOKES]; EDGE_CLASSES]; VALENCES],
    /// Arc length less one (capped, 15 escapes) by valence (capped), where they are not.
    long_arc: [TreeModel<16>; 8],
}

contexts!(CutModels: open_case, is_it, arc, long_arc);

/// Work space for ranking.
#[derive(Clone, Debug, Default)]
pub(crate) struct Ranking {
    /// Of each start its weight (how likely it is, relative to the others) above [`PLACE_BITS`] bits that are the larger the
    /// earlier the start; 0 once it has been ruled out, and beyond the spokes. The largest key is the first of the largest weights.
    keys: [u32; KEYS],
}

/// Room for all starts, as many as vectors hold.
const KEYS: usize = 16;

/// Bits of a key below the weight, and the place that they count down from.
const PLACE_BITS: u32 = 8;
const LAST_PLACE: u32 = (1 << PLACE_BITS) - 1;

/// Scores that far below the best one all weigh the same.
const LEAST_SCORE: usize = 16 * 20;

/// Weights by how far a score is below the best one.
static WEIGHTS: [u32; LEAST_SCORE + 1] = {
    let mut weights = [0; LEAST_SCORE + 1];
    let mut below = 0;
    while below <= LEAST_SCORE {
        weights[below] = power(-(below as i32));
        below += 1;
    }
    weights
};

/// What the score of a start is made of, for an arc of a given length.
#[derive(Clone, Copy, Debug)]
pub struct CutFeatures {
    /// Lengths of the two spokes that the split opens, in 1/32 octave, added.
    pub cut_length: i32,
    /// Those of the spokes between them.
    pub inner_length: i32,
    /// Lengths of the ring's edges between them, in 1/32 octave, added.
    pub edge_length: i32,
    /// Share of the ring's area between them, less a half, in 1/256.
    pub area: i32,
}

impl CutModels {
    pub(crate) const NEW: Self = Self {
        open_case: [Prob::HALF; 2],
        is_it: [[Prob::HALF; ODDS]; 3],
        arc: [[[Prob::HALF; MAX_SPOKES]; EDGE_CLASSES]; VALENCES],
        long_arc: [TreeModel::NEW; 8],
    };

    /// Codes where the fan opens. A decoded cut may not fit the fan: `Fan::admits` tells.
    pub(crate) fn code(
        &mut self,
        coder: &mut impl BitCoder,
        weights: &CutWeights,
        ranking: &mut Ranking,
        ring: &Ring,
        fan: &Fan,
        cut: Cut,
    ) -> Cut {
        let spokes = fan.ring().len() as u32;
        if fan.is_closed() && RANKED_VALENCES.contains(&spokes) {
            return self.ranked(coder, weights, ranking, ring, fan, cut);
        }
        if fan.is_closed() {
            let right = match cut {
                Cut::Both { right, .. } => right,
                _ => 0,
            };
            let arc = self.long_arc_len(coder, fan.arc_len(cut).max(1), spokes);
            let right = uniform(coder, right, spokes);
            return Cut::Both { right, left: (right + arc) % spokes };
        }
        let (both, is_left) = (matches!(cut, Cut::Both { .. }), matches!(cut, Cut::Left { .. }));
        if coder.bit(&mut self.open_case[0], both) {
            let right = match cut {
                Cut::Both { right, .. } => right,
                _ => 0,
            };
            let arc = fan.arc_len(cut).max(1);
            let right = uniform(coder, right, spokes - 1);
            let arc = uniform(coder, arc.wrapping_sub(1), (spokes - 1).saturating_sub(right).max(1)) + 1;
            return Cut::Both { right, left: right + arc };
        }
        let is_left = coder.bit(&mut self.open_case[1], is_left);
        let spoke = match cut {
            Cut::Left { left } => left,
            Cut::Right { right } => right,
            Cut::Both { .. } => 0,
        };
        let spoke = uniform(coder, spoke, spokes);
        if is_left { Cut::Left { left: spoke } } else { Cut::Right { right: spoke } }
    }

    fn long_arc_len(&mut self, coder: &mut impl BitCoder, arc: u32, valence: u32) -> u32 {
        let model = &mut self.long_arc[(valence.saturating_sub(MAX_RANKED_VALENCE)).min(7) as usize];
        let low = model.code(coder, (arc - 1).min(15));
        if low < 15 {
            return low + 1;
        }
        16 + uniform(coder, arc.wrapping_sub(16), valence.saturating_sub(16).max(1))
    }

    fn ranked(
        &mut self,
        coder: &mut impl BitCoder,
        weights: &CutWeights,
        ranking: &mut Ranking,
        ring: &Ring,
        fan: &Fan,
        cut: Cut,
    ) -> Cut {
        let spokes = fan.ring().len() as u32;
        let wanted = match cut {
            Cut::Both { right, .. } => right,
            _ => u32::MAX,
        };
        let arc = self.arc_len(coder, ring, fan.arc_len(cut), spokes);
        let mut rest = ranking.rank(weights, ring, spokes, arc);
        let mut right = 0;
        for rank in 0..spokes as usize {
            let (at, weight) = ranking.likeliest();
            right = at;
            rest -= weight;
            if rank + 1 == spokes as usize {
                break;
            }
            let odds = (lg(weight.into()) - lg(rest.max(1).into())) / 8 + ODDS as i32 / 2;
            let context = &mut self.is_it[rank.min(2)][odds.clamp(0, ODDS as i32 - 1) as usize];
            if coder.bit(context, at == wanted) {
                break;
            }
            ranking.keys[at as usize] = 0;
        }
        let left = right + arc;
        Cut::Both { right, left: if left < spokes { left } else { left - spokes } }
    }

    /// Codes the length of an arc of a closed fan whose cuts are ranked.
    fn arc_len(&mut self, coder: &mut impl BitCoder, ring: &Ring, arc: u32, spokes: u32) -> u32 {
        let class = (((ring.edge - ring.spoke) >> 2) + EDGE_CLASSES as i32 / 2).clamp(0, EDGE_CLASSES as i32 - 1);
        let contexts = &mut self.arc[(spokes - MIN_RANKED_VALENCE) as usize][class as usize];
        if spokes <= 3 || !coder.bit(&mut contexts[0], arc > 2) {
            return 1 + u32::from(coder.bit(&mut contexts[1], arc > 1));
        }
        let mut coded = 3;
        while coded + 1 < spokes && coder.bit(&mut contexts[coded as usize - 1], arc > coded) {
            coded += 1;
        }
        coded
    }
}

/// Reciprocal of an area for [`share`], and by how much it is to be shifted: it keeps 16 bits.
fn reciprocal(total: u32) -> (u32, u32) {
    let shift = 16u32.saturating_sub(total.leading_zeros());
    ((1 << 31) / (total >> shift).max(1), shift)
}

/// What share an area is of the total, in 1/256: at most 256 where it is not larger.
fn share(area: u32, (reciprocal, shift): (u32, u32)) -> i32 {
    ((area >> shift).wrapping_mul(reciprocal) >> 23) as i32
}

/// The features of each start of an arc of this length in a closed ring.
#[cfg(any(test, feature = "testing"))]
pub(crate) fn features_of_starts(ring: &Ring, spokes: usize, arc: usize) -> Vec<CutFeatures> {
    let at: Vec<[i32; 3]> = (0..spokes).map(|i| ring.numbers_at(i)).collect();
    let total = reciprocal(at.iter().map(|numbers| numbers[2] as u32).sum());
    let of = |right: usize| {
        let sum = |number: usize, from: usize, to: usize| (from..to).map(|i| at[i % spokes][number]).sum::<i32>();
        CutFeatures {
            cut_length: at[right][0] + at[(right + arc) % spokes][0],
            inner_length: sum(0, right + 1, right + arc),
            edge_length: sum(1, right, right + arc),
            area: share(sum(2, right, right + arc) as u32, total) - 128,
        }
    };
    (0..spokes).map(of).collect()
}

impl Ranking {
    /// Weighs all starts of arcs of this length and returns the sum of the weights. What lies on an arc is the difference of
    /// sums up to its ends, which are kept twice around.
    fn rank(&mut self, weights: &CutWeights, ring: &Ring, spokes: u32, arc: u32) -> u32 {
        let weights = &weights.arcs[arc as usize];
        // With the number of spokes known to the compiler, loops over a handful of elements unroll and check no bounds.
        match spokes {
            3 => self.rank_of::<3>(weights, ring, arc),
            4 => self.rank_of::<4>(weights, ring, arc),
            5 => self.rank_of::<5>(weights, ring, arc),
            6 => self.rank_of::<6>(weights, ring, arc),
            7 => self.rank_of::<7>(weights, ring, arc),
            8 => self.rank_of::<8>(weights, ring, arc),
            9 => self.rank_of::<9>(weights, ring, arc),
            10 => self.rank_of::<10>(weights, ring, arc),
            11 => self.rank_of::<11>(weights, ring, arc),
            _ => self.rank_of::<MAX_SPOKES>(weights, ring, arc),
        }
    }

    fn rank_of<const SPOKES: usize>(&mut self, weights: &ArcWeights, ring: &Ring, arc: u32) -> u32 {
        let arc = (arc as usize).min(SPOKES - 1);
        let [lengths, edges, ring_areas] = ring.numbers::<SPOKES>();
        // Of the edges before each spoke and the spokes before it, and of the areas.
        let (mut sums, mut areas) = ([0; 2 * MAX_SPOKES], [0; 2 * MAX_SPOKES]);
        let (mut sum, mut area) = (0i32, 0u32);
        for i in 0..SPOKES {
            (sums[i], areas[i]) = (sum, area);
            sum += weights.edge_length * edges[i] + weights.inner_length * lengths[i];
            area += ring_areas[i] as u32;
        }
        let total = reciprocal(area);
        for i in 0..SPOKES {
            (sums[SPOKES + i], areas[SPOKES + i]) = (sums[i] + sum, areas[i] + area);
        }
        // Spokes that open count for themselves, and the right one not as one of those inside.
        let mut left = [0; 2 * MAX_SPOKES];
        for i in 0..SPOKES {
            left[i] = weights.cut_length * lengths[i];
            left[SPOKES + i] = left[i];
        }
        let mut scores = [0; SPOKES];
        for right in 0..SPOKES {
            let end = right + arc;
            let area = share(areas[end] - areas[right], total) - 128;
            let of_area = weights.area * area + weights.area_squared * ((area * area) >> 8);
            let inside = sums[end] - sums[right] - weights.inner_length * lengths[right];
            scores[right] = (left[right] + left[end] + inside + of_area) >> 8;
        }
        let best = scores.iter().fold(i32::MIN, |best, &score| best.max(score));
        let mut total = 0;
        for (at, (key, score)) in self.keys.iter_mut().zip(scores).enumerate() {
            let weight = WEIGHTS[((best - score) as usize).min(LEAST_SCORE)];
            total += weight;
            *key = weight << PLACE_BITS | (LAST_PLACE - at as u32);
        }
        self.keys[SPOKES..].fill(0);
        total
    }

    /// The first of the largest weights, and its place.
    #[inline]
    fn likeliest(&self) -> (u32, u32) {
        let key = self.keys.iter().fold(0, |largest, &key| largest.max(key));
        (LAST_PLACE - (key & LAST_PLACE), key >> PLACE_BITS)
    }
}

const _: () = assert!(MAX_SPOKES <= KEYS && KEYS <= LAST_PLACE as usize);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::op::trained::TRAINED;

    /// A ring whose numbers are those of no surface, which ranking must not care about.
    fn ring(rng: &mut fastrand::Rng, spokes: usize) -> Ring {
        let mut numbers = |most: i32| (0..spokes).map(|_| rng.i32(0..=most)).collect::<Vec<_>>();
        let (mut lengths, mut edges, areas) = (numbers(900), numbers(900), numbers(1 << 25));
        if lengths[0] % 4 == 0 {
            // Ties.
            lengths.fill(500);
            edges.fill(500);
        }
        Ring::of_numbers(&lengths, &edges, &areas)
    }

    fn score(weights: &ArcWeights, features: &CutFeatures) -> i32 {
        let of_lengths = weights.cut_length * features.cut_length
            + weights.inner_length * features.inner_length
            + weights.edge_length * features.edge_length;
        let area = features.area;
        (of_lengths + weights.area * area + weights.area_squared * ((area * area) >> 8)) >> 8
    }

    #[test]
    fn ranking_agrees_with_a_look_at_each_arc_and_a_sort() {
        let mut rng = fastrand::Rng::with_seed(3);
        let mut ranking = Ranking::default();
        for spokes in RANKED_VALENCES.cycle().take(1000) {
            let ring = ring(&mut rng, spokes as usize);
            let arc = rng.u32(1..spokes);
            let weights = &TRAINED.cut.arcs[arc as usize];
            let scores: Vec<i32> = features_of_starts(&ring, spokes as usize, arc as usize)
                .iter()
                .map(|features| score(weights, features))
                .collect();
            let best = scores.iter().copied().max().unwrap();
            let mut expected: Vec<(u32, u32)> =
                (0..).zip(scores.iter().map(|score| power((score - best).max(-320)))).collect();
            expected.sort_by_key(|&(_, weight)| std::cmp::Reverse(weight));
            let total = ranking.rank(&TRAINED.cut, &ring, spokes, arc);
            assert_eq!(total, expected.iter().map(|&(_, weight)| weight).sum::<u32>());
            for expected in expected {
                assert_eq!(ranking.likeliest(), expected);
                ranking.keys[expected.0 as usize] = 0;
            }
            assert_eq!(ranking.likeliest().1, 0);
        }
    }

    #[test]
    fn shares_follow_the_quotients() {
        let mut rng = fastrand::Rng::with_seed(9);
        for _ in 0..20_000 {
            let total = rng.u32(1..) >> rng.u32(0..32);
            let area = rng.u32(0..=total);
            let exact = f64::from(area) * 256.0 / f64::from(total.max(1));
            let got = f64::from(share(area, reciprocal(total)));
            assert!(got <= exact + 0.01 && got > exact - 1.02, "{area} of {total}: {got} for {exact}");
        }
        assert_eq!(share(0, reciprocal(0)), 0);
    }
}
