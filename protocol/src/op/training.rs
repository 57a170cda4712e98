//! What the training program (`tests/src/bin/train.rs`) needs to see of the codec.

use super::batch::OpState;
use super::cut::{CutFeatures, RANKED_VALENCES, for_each_pair};
use super::geometry::GeometryFeatures;
use super::local::Ring;
use super::observe::{Note, Observer};
use super::range_coder::Prob;
use crate::mesh::{Cut, Fan, Replica};

/// A choice among the ways to cut a closed fan.
#[derive(Clone, Debug)]
pub struct CutSample {
    /// Valence.
    pub valence: u32,
    /// Arc length and features of each pair.
    pub pairs: Vec<(u32, CutFeatures)>,
    /// Which of the pairs it was.
    pub chosen: usize,
}

/// What the ring says about a split and, where cuts are ranked, about its cut.
#[derive(Clone, Debug)]
pub struct Sample {
    /// For position.
    pub geometry: GeometryFeatures,
    /// Normal of the fan and the axes across and along its dominant direction.
    pub normal: [i64; 3],
    /// See `normal`.
    pub axes: [usize; 3],
    /// For the cut.
    pub cut: Option<CutSample>,
}

impl Sample {
    /// Reads what the codec sees when it splits `s`.
    pub fn new(replica: &Replica, s: u32, fan: &Fan, cut: Cut) -> Self {
        let mut ring = Ring::default();
        ring.read(s, fan, replica.positions());
        let spokes = fan.ring().len() as u32;
        let sample = match cut {
            Cut::Both { right, left } if fan.is_closed() && RANKED_VALENCES.contains(&spokes) => {
                let mut pairs = Vec::new();
                let mut chosen = 0;
                for_each_pair(&ring, |r, arc, features| {
                    if r == right && (r + arc) % spokes == left {
                        chosen = pairs.len();
                    }
                    pairs.push((arc, features));
                });
                Some(CutSample { valence: spokes, pairs, chosen })
            }
            _ => None,
        };
        Self { geometry: GeometryFeatures::new(fan, &ring, cut), normal: ring.normal, axes: ring.axes, cut: sample }
    }
}

/// How often each context saw a 0 and a 1.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    /// By context, in the order of [`Trained::priors`](super::Trained::priors).
    pub counts: Vec<[f64; 2]>,
    by_address: std::collections::HashMap<usize, usize>,
}

impl Tally {
    /// Finds the contexts of `state`, which must stay where it is until its batches are decoded.
    pub(super) fn attach(&mut self, state: &mut OpState) {
        self.by_address.clear();
        let mut next = 0;
        state.for_each_context(&mut |context| {
            self.by_address.insert(std::ptr::from_ref(context).addr(), next);
            next += 1;
        });
        self.counts.resize(next, [0.0; 2]);
    }
}

impl Observer for Tally {
    fn bit(&mut self, context: &Prob, bit: bool, _: f64) {
        if let Some(&index) = self.by_address.get(&std::ptr::from_ref(context).addr()) {
            self.counts[index][usize::from(bit)] += 1.0;
        }
    }

    fn note(&mut self, _: Note<'_>) {}
}
