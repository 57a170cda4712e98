//! What the training program (`tests/measure/src/bin/train.rs`) needs to see of the codec.

use super::cut::{CutFeatures, RANKED_VALENCES, features_of_starts};
use super::geometry::GeometryFeatures;
use super::local::Ring;
use super::observe::{Note, Observer};
use super::range_coder::Prob;
use crate::mesh::{Cut, Fan, Replica};

/// A choice among the starts of an arc in a closed fan.
#[derive(Clone, Debug)]
pub struct CutSample {
    /// Arc length.
    pub arc: u32,
    /// Features of each start.
    pub starts: Vec<CutFeatures>,
    /// Which of them it was.
    pub chosen: usize,
}

/// What the ring says about a split and, where cuts are ranked, about its cut.
#[derive(Clone, Debug)]
pub struct Sample {
    /// For position.
    pub geometry: GeometryFeatures,
    /// Normal of the fan and the axes across and along its dominant direction.
    pub normal: [i32; 3],
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
            Cut::Both { right, .. } if fan.is_closed() && RANKED_VALENCES.contains(&spokes) => {
                let arc = fan.arc_len(cut);
                let starts = features_of_starts(&ring, spokes as usize, arc as usize);
                Some(CutSample { arc, starts, chosen: right as usize })
            }
            _ => None,
        };
        Self { geometry: GeometryFeatures::new(fan, &ring, cut), normal: ring.normal, axes: ring.axes, cut: sample }
    }
}

/// How often each context saw a 0 and a 1.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    /// By context, in the order of [`Trained::priors`](super::Trained::priors), then of
    /// [`Trained::patch_priors`](super::Trained::patch_priors); of a base only the latter.
    pub counts: Vec<[f64; 2]>,
    by_address: std::collections::BTreeMap<usize, usize>,
}

impl Tally {
    /// Finds the contexts that `for_each` names; they must stay where they are until what they code is decoded.
    pub(super) fn attach(&mut self, for_each: impl FnOnce(&mut dyn FnMut(&mut Prob))) {
        self.by_address.clear();
        let mut next = 0;
        for_each(&mut |context| {
            self.by_address.insert(std::ptr::from_ref(context).addr(), next);
            next += 1;
        });
        self.counts.resize(next, [0.0; 2]);
    }
}

impl Observer for Tally {
    fn bit(&mut self, context: &Prob, _: Prob, bit: bool) {
        if let Some(&index) = self.by_address.get(&std::ptr::from_ref(context).addr()) {
            self.counts[index][usize::from(bit)] += 1.0;
        }
    }

    fn raw(&mut self, _: u32, _: u32) {}

    fn note(&mut self, _: Note<'_>) {}
}

/// Names of the contexts of a session's batches: by the order of [`Trained::priors`](super::Trained::priors), then by that of
/// [`Trained::patch_priors`](super::Trained::patch_priors).
pub fn context_names() -> [Vec<String>; 2] {
    super::batch::context_names()
}

/// One step of the coder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Decision {
    /// A bit under a context.
    Bit {
        /// Name of the context, see [`context_names`].
        context: String,
        /// Chance of a 0 before, in 1/2^16.
        zero: u32,
        /// The bit.
        bit: bool,
    },
    /// A number at even odds.
    Raw {
        /// The number.
        value: u32,
        /// Its bits.
        count: u32,
    },
}

/// Every step of the coder through a batch, in order.
#[derive(Debug, Default)]
pub struct Decisions {
    /// The steps.
    pub steps: Vec<Decision>,
    by_address: std::collections::BTreeMap<usize, String>,
}

impl Decisions {
    /// Finds the contexts that `for_each` names; they must stay where they are until what they code is decoded.
    pub(super) fn attach(&mut self, for_each: impl FnOnce(&mut dyn FnMut(&mut Prob))) {
        let [batch, patch] = context_names();
        let mut names = batch.into_iter().chain(patch.into_iter().map(|name| format!("patch.{name}")));
        self.by_address.clear();
        for_each(&mut |context| {
            let name = names.next().unwrap_or_default();
            self.by_address.insert(std::ptr::from_ref(context).addr(), name);
        });
    }
}

impl Observer for Decisions {
    fn bit(&mut self, context: &Prob, before: Prob, bit: bool) {
        let context = self.by_address.get(&std::ptr::from_ref(context).addr()).cloned().unwrap_or_default();
        self.steps.push(Decision::Bit { context, zero: before.zero(), bit });
    }

    fn raw(&mut self, value: u32, count: u32) {
        self.steps.push(Decision::Raw { value, count });
    }

    fn note(&mut self, _: Note<'_>) {}
}
