//! What a server keeps of an [`OpState`] that rests, and how it comes back. The other end knows nothing of it.
//!
//! Mesh and cache follow from the ops applied and the ops cached, which the server knows by number; the coder's contexts
//! follow from nothing and are kept as far as they have left their priors.

use super::{Models, OpState};
use crate::cache::SplitCache;
use crate::op::range_coder::Prob;

/// The adaptive contexts of an [`OpState`]: a bit for each, and 4 bytes for each that differs from its prior.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SavedContexts {
    is_changed: Box<[u64]>,
    changed: Box<[u32]>,
}

impl SavedContexts {
    /// Bytes of memory held.
    pub fn heap_bytes(&self) -> usize {
        self.is_changed.len() * 8 + self.changed.len() * 4
    }
}

impl OpState {
    /// The contexts as they are now. O(contexts), some thousands.
    pub fn save_contexts(&self) -> SavedContexts {
        let mut priors = Vec::new();
        Models::new(self.trained).for_each_context(&mut |context| priors.push(context.to_bits()));
        let mut is_changed = vec![0u64; priors.len().div_ceil(64)];
        let mut changed = Vec::new();
        let mut i = 0;
        self.models.clone().for_each_context(&mut |context| {
            if context.to_bits() != priors[i] {
                is_changed[i / 64] |= 1 << (i % 64);
                changed.push(context.to_bits());
            }
            i += 1;
        });
        SavedContexts { is_changed: is_changed.into(), changed: changed.into() }
    }

    /// Takes up contexts and cache where another state of the same model has left them; the mesh is brought there by way of
    /// [`replica_mut`](Self::replica_mut).
    pub fn resume(&mut self, contexts: &SavedContexts, cache: SplitCache) {
        let mut models = Models::new(self.trained);
        let mut changed = contexts.changed.iter();
        let mut i = 0;
        models.for_each_context(&mut |context| {
            let is_changed = contexts.is_changed.get(i / 64).is_some_and(|bits| bits >> (i % 64) & 1 == 1);
            if let Some(&bits) = changed.as_slice().first().filter(|_| is_changed) {
                *context = Prob::from_bits(bits);
                changed.next();
            }
            i += 1;
        });
        *self.models = models;
        self.cache = cache;
    }
}
