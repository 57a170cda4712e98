//! Coding of where a split opens the fan of `s`.
//!
//! On a closed fan of ordinary valence all pairs of spokes are ranked by a linear score of what the ring looks like: the
//! two that the split opens are short and the ones that go to the new vertex are long, since the collapse stretched them.
//! The cut is then coded as "is it this one?" from the likeliest pair on, each flag under a context that says how likely
//! the score finds it among those left. Elsewhere arc length and start are coded by themselves.

use super::fixed::{lg, power};
use super::local::Ring;
use super::range_coder::{BitCoder, Prob, TreeModel, contexts, uniform};
use super::trained::CutWeights;
use crate::mesh::{Cut, Fan};

/// Valences whose cuts are ranked; there are at most 132 pairs.
pub(crate) const RANKED_VALENCES: std::ops::RangeInclusive<u32> = 3..=MAX_RANKED_VALENCE;
pub(crate) const MAX_RANKED_VALENCE: u32 = 12;
/// The same as a length, and the pairs of that many spokes.
const MAX_SPOKES: usize = MAX_RANKED_VALENCE as usize;
const MAX_PAIRS: usize = MAX_SPOKES * (MAX_SPOKES - 1);
/// Classes of the odds of a candidate, in half octaves about even.
const ODDS: usize = 32;

/// Adaptive contexts of cuts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct CutModels {
    open_case: [Prob; 2],
    /// Whether a candidate is it, by its rank (first, second, later) and its odds among those left.
    is_it: [[Prob; ODDS]; 3],
    /// Arc length less one (capped, 15 escapes) by valence (capped), where cuts are not ranked.
    arc: [TreeModel<16>; 8],
}

contexts!(CutModels: open_case, is_it, arc);

/// Work space for ranking.
#[derive(Clone, Debug)]
pub(crate) struct Ranking {
    /// Of each pair, right spoke major: its weight (how likely it is, relative to the others) above [`PLACE_BITS`] bits that are
    /// the larger the earlier the pair; 0 once it has been ruled out. The largest key is the first of the largest weights.
    keys: [i32; MAX_PAIRS],
    /// How many there are.
    count: usize,
}

/// Bits of a key below the weight, and the place that they count down from.
const PLACE_BITS: u32 = 8;
const LAST_PLACE: i32 = (1 << PLACE_BITS) - 1;

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

impl Default for Ranking {
    fn default() -> Self {
        Self { keys: [0; MAX_PAIRS], count: 0 }
    }
}

/// What the score of a pair of spokes is made of.
#[derive(Clone, Copy, Debug)]
pub struct CutFeatures {
    /// Lengths of the two spokes against the mean, in 1/32 octave, added.
    pub cut_length: i32,
    /// Those of the spokes between them.
    pub inner_length: i32,
    /// Lengths of the ring's edges between them against the mean spoke, in 1/32 octave, added.
    pub edge_length: i32,
    /// Share of the ring's area between them, less a half, in 1/256.
    pub area: i32,
}

impl CutModels {
    pub(crate) const NEW: Self =
        Self { open_case: [Prob::HALF; 2], is_it: [[Prob::HALF; ODDS]; 3], arc: [TreeModel::NEW; 8] };

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
            return self.ranked(coder, weights, ranking, ring, cut);
        }
        if fan.is_closed() {
            let right = match cut {
                Cut::Both { right, .. } => right,
                _ => 0,
            };
            let arc = self.arc_len(coder, fan.arc_len(cut).max(1), spokes);
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

    fn arc_len(&mut self, coder: &mut impl BitCoder, arc: u32, valence: u32) -> u32 {
        let model = &mut self.arc[(valence.saturating_sub(MAX_RANKED_VALENCE)).min(7) as usize];
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
        cut: Cut,
    ) -> Cut {
        let spokes = ring.spokes.len() as u32;
        let wanted = match cut {
            Cut::Both { right, left } => right * (spokes - 1) + (left + spokes - right - 1) % spokes,
            _ => u32::MAX,
        };
        let mut rest = ranking.rank(weights, ring);
        let count = ranking.count;
        let mut chosen = 0;
        for rank in 0..count {
            let (at, weight) = ranking.likeliest();
            chosen = at;
            rest -= u64::from(weight);
            if rank + 1 == count {
                break;
            }
            let odds = (lg(u64::from(weight)) - lg(rest.max(1))) / 8 + ODDS as i32 / 2;
            let context = &mut self.is_it[rank.min(2)][odds.clamp(0, ODDS as i32 - 1) as usize];
            if coder.bit(context, at as u32 == wanted) {
                break;
            }
            ranking.keys[at] = 0;
        }
        let (right, arc) = (chosen as u32 / (spokes - 1), chosen as u32 % (spokes - 1) + 1);
        Cut::Both { right, left: (right + arc) % spokes }
    }
}

/// Share of the ring's area in each face, in 1/256. They add up over any arc: each is a difference of cumulative shares.
fn area_shares(ring: &Ring) -> [i32; MAX_SPOKES] {
    let total = ring.areas.iter().sum::<i64>().max(1);
    let mut shares = [0; MAX_SPOKES];
    let (mut sum, mut share_before) = (0, 0);
    for (share, area) in shares.iter_mut().zip(&ring.areas) {
        sum += area;
        let share_after = (sum << 8) / total;
        *share = (share_after - share_before) as i32;
        share_before = share_after;
    }
    shares
}

/// Calls `visit` with right spoke, arc length and features of each pair of spokes of a closed ring, in the order of coding.
#[cfg(any(test, feature = "testing"))]
pub(crate) fn for_each_pair(ring: &Ring, mut visit: impl FnMut(u32, u32, CutFeatures)) {
    let spokes = ring.spokes.len();
    let shares = area_shares(ring);
    for right in 0..spokes {
        let mut features = CutFeatures { cut_length: 0, inner_length: 0, edge_length: 0, area: -128 };
        let mut at = right;
        for arc in 1..spokes {
            features.edge_length += ring.edges[at] - ring.spoke;
            features.area += shares[at];
            if arc > 1 {
                features.inner_length += ring.lengths[at] - ring.spoke;
            }
            at = if at + 1 == spokes { 0 } else { at + 1 };
            features.cut_length = ring.lengths[right] + ring.lengths[at] - 2 * ring.spoke;
            visit(right as u32, arc as u32, features);
        }
    }
}

impl Ranking {
    /// Weighs all pairs and returns the sum of the weights. The score of a pair is linear in what lies on its arc, so it is made
    /// of sums up to each spoke, twice around, instead of visiting the arc.
    fn rank(&mut self, weights: &CutWeights, ring: &Ring) -> u64 {
        // With the number of spokes known to the compiler, loops over a handful of elements unroll and check no bounds.
        match ring.spokes.len() {
            3 => self.rank_of::<3>(weights, ring),
            4 => self.rank_of::<4>(weights, ring),
            5 => self.rank_of::<5>(weights, ring),
            6 => self.rank_of::<6>(weights, ring),
            7 => self.rank_of::<7>(weights, ring),
            8 => self.rank_of::<8>(weights, ring),
            9 => self.rank_of::<9>(weights, ring),
            10 => self.rank_of::<10>(weights, ring),
            11 => self.rank_of::<11>(weights, ring),
            _ => self.rank_of::<MAX_SPOKES>(weights, ring),
        }
    }

    fn rank_of<const SPOKES: usize>(&mut self, weights: &CutWeights, ring: &Ring) -> u64 {
        let spokes = SPOKES;
        let by_arc = &weights.arcs[spokes];
        let lengths: &[i32; SPOKES] = ring.lengths[..].try_into().expect("a length for each spoke");
        let edges: &[i32; SPOKES] = ring.edges[..].try_into().expect("an edge for each spoke of a closed ring");
        let shares = area_shares(ring);
        let (mut inner, mut cut) = ([0; MAX_SPOKES], [0; 2 * MAX_SPOKES]);
        // Of the edges before each spoke and the spokes before it, and of the areas.
        let (mut sums, mut areas) = ([0; 2 * MAX_SPOKES], [0; 2 * MAX_SPOKES]);
        let (mut sum, mut area) = (0, 0);
        for i in 0..spokes {
            let length = lengths[i] - ring.spoke;
            cut[i] = weights.cut_length * length;
            sums[i] = sum;
            areas[i] = area;
            inner[i] = weights.inner_length * length;
            sum += weights.edge_length * (edges[i] - ring.spoke) + inner[i];
            area += shares[i];
        }
        for i in 0..spokes {
            (cut[spokes + i], sums[spokes + i], areas[spokes + i]) = (cut[i], sums[i] + sum, areas[i] + area);
        }
        self.count = spokes * (spokes - 1);
        let keys = &mut self.keys[..spokes * (spokes - 1)];
        let mut best = i32::MIN;
        for right in 0..spokes {
            let start = cut[right] - sums[right] - inner[right];
            let start_area = -128 - areas[right];
            for arc in 1..spokes {
                let end = right + arc;
                let area = start_area + areas[end];
                let of_area = weights.area * area + weights.area_squared * ((area * area) >> 8);
                let score = (start + sums[end] + cut[end] + of_area + (by_arc[arc] << 8)) >> 8;
                keys[right * (spokes - 1) + arc - 1] = score;
                best = best.max(score);
            }
        }
        let mut total = 0;
        for (at, key) in keys.iter_mut().enumerate() {
            let weight = WEIGHTS[((best - *key) as usize).min(WEIGHTS.len() - 1)];
            total += weight;
            *key = (weight << PLACE_BITS) as i32 | (LAST_PLACE - at as i32);
        }
        total.into()
    }

    /// The first of the largest weights, and its place.
    fn likeliest(&self) -> (usize, u32) {
        let key = self.keys[..self.count].iter().fold(0, |largest: i32, &key| largest.max(key));
        ((LAST_PLACE - (key & LAST_PLACE)) as usize, key as u32 >> PLACE_BITS)
    }
}

const _: () = assert!(MAX_PAIRS <= LAST_PLACE as usize);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::op::trained::TRAINED;

    /// A ring whose numbers are those of no surface, which ranking must not care about.
    fn ring(rng: &mut fastrand::Rng, spokes: usize) -> Ring {
        let mut ring = Ring::default();
        ring.spoke = rng.i32(0..=700);
        let mut numbers = |most: i32| (0..spokes).map(|_| rng.i32(0..=most)).collect::<Vec<_>>();
        (ring.lengths, ring.edges) = (numbers(700), numbers(700));
        ring.areas = numbers(i32::MAX).into_iter().map(|area| i64::from(area) << 12).collect();
        ring.spokes = vec![[0; 3]; spokes];
        ring
    }

    #[test]
    fn ranking_agrees_with_a_visit_of_each_pair_and_a_sort() {
        let mut rng = fastrand::Rng::with_seed(3);
        let mut ranking = Ranking::default();
        let w = &TRAINED.cut;
        for spokes in RANKED_VALENCES.cycle().take(600) {
            let mut ring = ring(&mut rng, spokes as usize);
            if rng.bool() {
                // Ties.
                ring.lengths.fill(ring.spoke);
                ring.edges.fill(ring.spoke);
            }
            let mut scores = Vec::new();
            for_each_pair(&ring, |_, arc, f| {
                let sum = w.cut_length * f.cut_length + w.inner_length * f.inner_length + w.edge_length * f.edge_length;
                let area = w.area * f.area + w.area_squared * ((f.area * f.area) >> 8);
                scores.push((sum + area + (w.arcs[spokes as usize][arc as usize] << 8)) >> 8);
            });
            let best = scores.iter().copied().max().unwrap();
            let mut expected: Vec<(usize, u32)> =
                scores.iter().map(|score| power((score - best).max(-320))).enumerate().collect();
            expected.sort_by_key(|&(_, weight)| std::cmp::Reverse(weight));
            let total = ranking.rank(w, &ring);
            assert_eq!(total, expected.iter().map(|&(_, weight)| u64::from(weight)).sum());
            assert_eq!(ranking.count, expected.len());
            for expected in expected {
                assert_eq!(ranking.likeliest(), expected);
                ranking.keys[expected.0] = 0;
            }
        }
    }
}
