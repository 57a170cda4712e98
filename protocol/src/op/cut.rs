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
#[derive(Clone, Debug, Default)]
pub(crate) struct Ranking {
    /// Weight of each pair, right spoke major: how likely it is, relative to the others.
    weights: Vec<u32>,
    scores: Vec<i32>,
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
        let count = ranking.weights.len();
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
            ranking.weights[at] = 0;
        }
        let (right, arc) = (chosen as u32 / (spokes - 1), chosen as u32 % (spokes - 1) + 1);
        Cut::Both { right, left: (right + arc) % spokes }
    }
}

/// Calls `visit` with right spoke, arc length and features of each pair of spokes of a closed ring, in the order of coding.
pub(crate) fn for_each_pair(ring: &Ring, mut visit: impl FnMut(u32, u32, CutFeatures)) {
    let spokes = ring.spokes.len();
    let total = ring.areas.iter().sum::<i64>().max(1);
    let shares: [i32; MAX_RANKED_VALENCE as usize] = {
        let mut before = 0;
        std::array::from_fn(|i| {
            let start = before;
            before += ring.areas.get(i).copied().unwrap_or(0);
            // Cumulative shares, so that those of all arcs add up.
            ((before << 8) / total - (start << 8) / total) as i32
        })
    };
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
    /// Weighs all pairs and returns the sum of the weights.
    fn rank(&mut self, weights: &CutWeights, ring: &Ring) -> u64 {
        let by_arc = &weights.arcs[ring.spokes.len()];
        let Self { scores, weights: out } = self;
        scores.clear();
        let mut best = i32::MIN;
        for_each_pair(ring, |_, arc, f| {
            let area = f.area;
            let sum = weights.cut_length * f.cut_length
                + weights.inner_length * f.inner_length
                + weights.edge_length * f.edge_length
                + weights.area * area
                + weights.area_squared * ((area * area) >> 8)
                + (by_arc[arc as usize] << 8);
            let score = sum >> 8;
            best = best.max(score);
            scores.push(score);
        });
        out.clear();
        out.extend(scores.iter().map(|&score| power((score - best).max(-16 * 20))));
        out.iter().map(|&weight| u64::from(weight)).sum()
    }

    /// The first of the largest weights, and its place.
    fn likeliest(&self) -> (usize, u32) {
        let mut best = (0, 0);
        for (at, &weight) in self.weights.iter().enumerate() {
            if weight > best.1 {
                best = (at, weight);
            }
        }
        best
    }
}
