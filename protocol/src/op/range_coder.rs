//! Adaptive binary range coder: 32-bit range, carry propagation, two-rate 16-bit probabilities.
//!
//! Both directions implement [`BitCoder`], so that a model is written once and cannot differ between the two ends: the
//! encoder codes the bit it is given and returns it, the decoder ignores it and returns the one it finds.

use std::hint::select_unpredictable;

use super::observe::Note;

/// Probability that the next bit is 0, as the mean of a fast and a slow estimate of 16 bits each: the upper and the lower half.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Prob(u32);

const FAST_SHIFT: u32 = 5;
const SLOW_SHIFT: u32 = 8;
/// The lowest and the highest estimate to start from. Adapting leaves neither half outside `31 ..= 65504`, so that the mean stays
/// in `32 ..= 65504` and both bits can be coded.
const PRIORS: std::ops::RangeInclusive<u16> = 33..=65_502;

impl Prob {
    /// Even odds.
    pub(crate) const HALF: Self = Self::at(1 << 15);

    /// Where both estimates are `zero / 2^16`, or as near to it as an estimate may begin.
    pub(crate) const fn at(zero: u16) -> Self {
        let zero = match zero {
            zero if zero < *PRIORS.start() => *PRIORS.start(),
            zero if zero > *PRIORS.end() => *PRIORS.end(),
            zero => zero,
        };
        Self((zero as u32) << 16 | zero as u32)
    }

    /// Both estimates as one number.
    pub(crate) const fn to_bits(self) -> u32 {
        self.0
    }

    /// The inverse of [`to_bits`](Self::to_bits).
    pub(crate) const fn from_bits(bits: u32) -> Self {
        Self(bits)
    }

    /// In `32 ..= 65504`.
    #[inline]
    pub(crate) fn zero(self) -> u32 {
        ((self.0 >> 16) + (self.0 & 0xffff)) >> 1
    }

    /// Code length of `bit`, in bits.
    pub(crate) fn cost(self, bit: bool) -> f64 {
        let zero = f64::from(self.zero()) / 65_536.0;
        -(if bit { 1.0 - zero } else { zero }).log2()
    }

    /// Without a branch: about half the bits are a surprise.
    #[inline]
    fn adapt(&mut self, bit: bool) {
        // The chance of what was not coded shrinks: that of a 0 as it is, that of a 1 as the complement.
        let flip = u32::from(bit).wrapping_sub(1);
        let chances = self.0 ^ flip;
        let fast = chances >> FAST_SHIFT & (0xffff_0000 >> FAST_SHIFT & 0xffff_0000);
        let slow = chances >> SLOW_SHIFT & (0xffff >> SLOW_SHIFT);
        self.0 = (chances - fast - slow) ^ flip;
    }
}

/// One direction of the coder. See the module.
pub(crate) trait BitCoder {
    /// Codes `bit` under `p` and adapts `p`.
    fn bit(&mut self, p: &mut Prob, bit: bool) -> bool;

    /// Codes the low `count` (at most 16) bits of `value` at even odds, highest first.
    fn raw(&mut self, value: u32, count: u32) -> u32;

    /// Tells what the models do; for observers.
    #[inline]
    fn note(&mut self, _: Note<'_>) {}
}

/// A coder that reads.
pub(crate) trait Source: BitCoder {
    /// Whether more was read than an encoder can have written.
    fn is_overrun(&self) -> bool;

    /// Whether bytes are left that an encoder would not have written.
    fn has_trailing(&self) -> bool;
}

/// Collects bytes.
#[derive(Debug)]
pub(crate) struct Encoder {
    low: u64,
    range: u32,
    /// Last byte not yet written, since a carry may still reach it; `None` before the first.
    pending: Option<u8>,
    /// 0xff bytes after `pending`.
    pending_ff: u32,
    bytes: Vec<u8>,
}

impl Encoder {
    pub(crate) fn new() -> Self {
        Self { low: 0, range: u32::MAX, pending: None, pending_ff: 0, bytes: Vec::new() }
    }

    /// Bytes written so far, give or take what is pending.
    pub(crate) fn len(&self) -> usize {
        self.bytes.len() + self.pending_ff as usize + 1
    }

    fn shift_low(&mut self) {
        let carry = (self.low >> 32) as u8;
        let byte = (self.low >> 24) as u8;
        if carry == 1 || byte != 0xff {
            if let Some(pending) = self.pending {
                self.bytes.push(pending.wrapping_add(carry));
            }
            for _ in 0..self.pending_ff {
                self.bytes.push(0xffu8.wrapping_add(carry));
            }
            self.pending_ff = 0;
            self.pending = Some(byte);
        } else {
            self.pending_ff += 1;
        }
        self.low = (self.low & 0x00ff_ffff) << 8;
    }

    #[inline]
    fn normalize(&mut self) {
        while self.range < 1 << 24 {
            self.range <<= 8;
            self.shift_low();
        }
    }

    /// Ends the stream: the shortest byte string that decodes alike when followed by zeros.
    pub(crate) fn finish(mut self) -> Vec<u8> {
        // Any value in low .. low + range will do: take one whose low bits are zero.
        let top = self.low + u64::from(self.range) - 1;
        let mut mask = 0xffff_ffffu64;
        while mask != 0 && (top & !mask) < self.low {
            mask >>= 8;
        }
        self.low = top & !mask;
        // Only zeros of the flush are cut, so that a decoder can tell a truncated stream by how far it reads past the end.
        let coded = self.bytes.len() + usize::from(self.pending.is_some()) + self.pending_ff as usize;
        for _ in 0..5 {
            self.shift_low();
        }
        while self.bytes.len() > coded && self.bytes.last() == Some(&0) {
            self.bytes.pop();
        }
        self.bytes
    }
}

impl BitCoder for Encoder {
    #[inline]
    fn bit(&mut self, p: &mut Prob, bit: bool) -> bool {
        let bound = (self.range >> 16) * p.zero();
        self.low += select_unpredictable(bit, u64::from(bound), 0);
        self.range = select_unpredictable(bit, self.range - bound, bound);
        p.adapt(bit);
        self.normalize();
        bit
    }

    #[inline]
    fn raw(&mut self, value: u32, count: u32) -> u32 {
        debug_assert!(count <= 16 && value >> count == 0);
        self.range >>= count;
        self.low += u64::from(value) * u64::from(self.range);
        self.normalize();
        value
    }
}

/// Reads bytes; past their end it reads zeros and counts them.
#[derive(Debug)]
pub(crate) struct Decoder<'a> {
    bytes: &'a [u8],
    at: usize,
    code: u32,
    range: u32,
}

/// Zeros a decoder may read past the end of an honest stream.
const MAX_OVERRUN: usize = 8;

impl<'a> Decoder<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        let mut decoder = Self { bytes, at: 0, code: 0, range: u32::MAX };
        for _ in 0..4 {
            decoder.code = decoder.code << 8 | u32::from(decoder.next());
        }
        decoder
    }

    #[inline]
    fn next(&mut self) -> u8 {
        let byte = self.bytes.get(self.at).copied().unwrap_or(0);
        self.at += 1;
        byte
    }

    #[inline]
    fn normalize(&mut self) {
        while self.range < 1 << 24 {
            self.range <<= 8;
            self.code = self.code << 8 | u32::from(self.next());
        }
    }
}

impl Source for Decoder<'_> {
    #[inline]
    fn is_overrun(&self) -> bool {
        self.at > self.bytes.len() + MAX_OVERRUN
    }

    fn has_trailing(&self) -> bool {
        self.at < self.bytes.len()
    }
}

impl BitCoder for Decoder<'_> {
    #[inline]
    fn bit(&mut self, p: &mut Prob, _: bool) -> bool {
        let bound = (self.range >> 16) * p.zero();
        // Selected, not jumped to: which it is can often not be foreseen.
        let bit = self.code >= bound;
        self.code = select_unpredictable(bit, self.code.wrapping_sub(bound), self.code);
        self.range = select_unpredictable(bit, self.range - bound, bound);
        p.adapt(bit);
        self.normalize();
        bit
    }

    #[inline]
    fn raw(&mut self, _: u32, count: u32) -> u32 {
        self.range >>= count;
        let value = (self.code / self.range).min((1 << count) - 1);
        self.code = self.code.wrapping_sub(value * self.range);
        self.normalize();
        value
    }
}

/// A number as its bit length (unary, adaptive), its next bits (adaptive) and the rest (raw): adaptive Exp-Golomb.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct NumberModel {
    length: [Prob; 33],
    /// By length (capped) and the bits below the leading one that were coded so far.
    mantissa: [[Prob; 4]; 16],
}

impl NumberModel {
    pub(crate) const NEW: Self = Self { length: [Prob::HALF; 33], mantissa: [[Prob::HALF; 4]; 16] };

    /// Codes `value`, at most `2^32 - 2`.
    pub(crate) fn code(&mut self, coder: &mut impl BitCoder, value: u32) -> u32 {
        let plus_one = value.wrapping_add(1);
        let wanted = 31 - (plus_one | 1).leading_zeros();
        let mut length = 0;
        while length < 31 && coder.bit(&mut self.length[length as usize], length < wanted) {
            length += 1;
        }
        let mut left = length;
        let mut coded = 1u32;
        let contexts = &mut self.mantissa[length.min(15) as usize];
        while left > 0 && coded < 4 {
            left -= 1;
            let bit = coder.bit(&mut contexts[coded as usize], plus_one >> left & 1 == 1);
            coded = coded << 1 | u32::from(bit);
        }
        while left > 0 {
            let step = left.min(16);
            left -= step;
            let chunk = coder.raw(plus_one >> left & ((1 << step) - 1), step);
            coded = coded << step | chunk;
        }
        coded.wrapping_sub(1)
    }
}

/// A number below `NODES` as a binary tree of adaptive bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct TreeModel<const NODES: usize> {
    nodes: [Prob; NODES],
}

impl<const NODES: usize> TreeModel<NODES> {
    pub(crate) const NEW: Self = Self { nodes: [Prob::HALF; NODES] };

    /// Codes `value < NODES`, which must be a power of two.
    pub(crate) fn code(&mut self, coder: &mut impl BitCoder, value: u32) -> u32 {
        let mut node = 1usize;
        for shift in (0..NODES.ilog2()).rev() {
            let bit = coder.bit(&mut self.nodes[node], value >> shift & 1 == 1);
            node = node << 1 | usize::from(bit);
        }
        (node - NODES) as u32
    }
}

/// A number whose size is known beforehand: divided by a power of two that the caller takes from what it expects, the
/// quotient by its bit length (a tree) and its next bits (adaptive), then the rest raw.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ScaledModel {
    length: TreeModel<8>,
    /// By bit length and the bits below the leading one that were coded so far.
    mantissa: [[Prob; 3]; 6],
}

/// Least quotient that a [`ScaledModel`] escapes with.
const ESCAPE: u32 = 127;

impl ScaledModel {
    pub(crate) const NEW: Self = Self { length: TreeModel::NEW, mantissa: [[Prob::HALF; 3]; 6] };

    /// Codes what is adaptive of `value`; returns the least value that goes on like this and how many raw bits are to be
    /// added.
    #[inline]
    fn head(&mut self, coder: &mut impl BitCoder, escape: &mut NumberModel, shift: u32, value: u32) -> (u32, u32) {
        let quotient = value >> shift;
        let plus_one = quotient.wrapping_add(1);
        let length = self.length.code(coder, (31 - (plus_one | 1).leading_zeros()).min(7));
        if length == 7 {
            let quotient = escape.code(coder, quotient.wrapping_sub(ESCAPE)).wrapping_add(ESCAPE);
            return (quotient << shift, shift);
        }
        let mut coded = 1;
        let mut left = length;
        while left > 0 && coded < 4 {
            left -= 1;
            let context = &mut self.mantissa[length as usize - 1][coded as usize - 1];
            coded = coded << 1 | u32::from(coder.bit(context, plus_one >> left & 1 == 1));
        }
        ((coded << (left + shift)) - (1 << shift), left + shift)
    }

    /// Codes `value`, at most `2^31`, in units of `2^shift`, at most `2^20`; `escape` serves what is far larger than expected.
    pub(crate) fn code(&mut self, coder: &mut impl BitCoder, escape: &mut NumberModel, shift: u32, value: u32) -> u32 {
        let (base, rest) = self.head(coder, escape, shift, value);
        base.wrapping_add(raw_bits(coder, value.wrapping_sub(base) & ((1 << rest) - 1), rest))
    }

    /// Codes a signed number likewise.
    pub(crate) fn signed(
        &mut self,
        coder: &mut impl BitCoder,
        escape: &mut NumberModel,
        shift: u32,
        value: i32,
    ) -> i32 {
        let magnitude = value.unsigned_abs();
        let (base, rest) = self.head(coder, escape, shift, magnitude);
        let low = magnitude.wrapping_sub(base) & ((1 << rest) - 1);
        let negative = u32::from(value < 0);
        let (magnitude, negative) = if base > 0 {
            let both = raw_bits(coder, low << 1 | negative, rest + 1);
            (base.wrapping_add(both >> 1), both & 1)
        } else {
            let magnitude = raw_bits(coder, low, rest);
            (magnitude, if magnitude > 0 { coder.raw(negative, 1) } else { 0 })
        };
        if negative == 1 { (magnitude as i32).wrapping_neg() } else { magnitude as i32 }
    }
}

/// Classes of expected size that a [`ScaledSet`] tells apart: half octaves up to 8, then two by where it lies in its octave.
pub(crate) const SIZES: usize = 10;

/// One [`ScaledModel`] for each class of expected size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ScaledSet {
    by_size: [ScaledModel; SIZES],
}

impl ScaledSet {
    pub(crate) const NEW: Self = Self { by_size: [ScaledModel::NEW; SIZES] };

    /// The model and its unit for numbers of an expected size of `2^(size / 16)`.
    fn pick(&mut self, size: i32) -> (&mut ScaledModel, u32) {
        let half_octaves = (size.clamp(-16, 24 * 16) + 16) / 8;
        if half_octaves < 8 {
            return (&mut self.by_size[half_octaves as usize], 0);
        }
        (&mut self.by_size[8 + (half_octaves & 1) as usize], half_octaves as u32 / 2 - 4)
    }

    /// Codes a number.
    pub(crate) fn code(&mut self, coder: &mut impl BitCoder, escape: &mut NumberModel, size: i32, value: u32) -> u32 {
        let (model, shift) = self.pick(size);
        model.code(coder, escape, shift, value)
    }

    /// Codes a signed number.
    pub(crate) fn signed(&mut self, coder: &mut impl BitCoder, escape: &mut NumberModel, size: i32, value: i32) -> i32 {
        let (model, shift) = self.pick(size);
        model.signed(coder, escape, shift, value)
    }
}

/// Everything that holds contexts can name them, always in the same order.
pub(crate) trait Contexts {
    /// Calls `visit` with each context.
    fn for_each(&mut self, visit: &mut dyn FnMut(&mut Prob));

    /// Adds the names of the contexts in the same order; `name` is that of the whole.
    #[cfg(any(test, feature = "testing"))]
    fn names(&self, name: &str, out: &mut Vec<String>);

    /// Sets the chance of a 0 in each context, in 1/2^16; those beyond the end of `priors` stay as they are.
    fn start_from(&mut self, priors: &[u16]) {
        let mut priors = priors.iter();
        self.for_each(&mut |context| {
            if let Some(&prior) = priors.next() {
                *context = Prob::at(prior);
            }
        });
    }
}

impl Contexts for Prob {
    fn for_each(&mut self, visit: &mut dyn FnMut(&mut Prob)) {
        visit(self);
    }

    #[cfg(any(test, feature = "testing"))]
    fn names(&self, name: &str, out: &mut Vec<String>) {
        out.push(name.into());
    }
}

impl<T: Contexts, const N: usize> Contexts for [T; N] {
    fn for_each(&mut self, visit: &mut dyn FnMut(&mut Prob)) {
        self.iter_mut().for_each(|each| each.for_each(visit));
    }

    #[cfg(any(test, feature = "testing"))]
    fn names(&self, name: &str, out: &mut Vec<String>) {
        for (i, each) in self.iter().enumerate() {
            each.names(&format!("{name}[{i}]"), out);
        }
    }
}

impl<const NODES: usize> Contexts for TreeModel<NODES> {
    fn for_each(&mut self, visit: &mut dyn FnMut(&mut Prob)) {
        self.nodes.for_each(visit);
    }

    #[cfg(any(test, feature = "testing"))]
    fn names(&self, name: &str, out: &mut Vec<String>) {
        self.nodes.names(name, out);
    }
}

/// Names the contexts of a struct field by field.
macro_rules! contexts {
    ($name:ident: $($field:ident),+) => {
        impl $crate::op::range_coder::Contexts for $name {
            fn for_each(&mut self, visit: &mut dyn FnMut(&mut $crate::op::range_coder::Prob)) {
                $($crate::op::range_coder::Contexts::for_each(&mut self.$field, visit);)+
            }

            #[cfg(any(test, feature = "testing"))]
            fn names(&self, name: &str, out: &mut Vec<String>) {
                let dot = if name.is_empty() { "" } else { "." };
                $($crate::op::range_coder::Contexts::names(
                    &self.$field,
                    &format!("{name}{dot}{}", stringify!($field)),
                    out,
                );)+
            }
        }
    };
}
pub(crate) use contexts;

contexts!(NumberModel: length, mantissa);
contexts!(ScaledModel: length, mantissa);
contexts!(ScaledSet: by_size);

/// Codes `value < count` with nearly equal odds; `count` is at least 1. A decoder may return a value up to the next power
/// of two: callers check.
pub(crate) fn uniform(coder: &mut impl BitCoder, value: u32, count: u32) -> u32 {
    // Truncated binary: the first `short` values take one bit less.
    let bits = 32 - (count - 1).leading_zeros();
    if bits == 0 {
        return 0;
    }
    let short = (1u64 << bits) - u64::from(count);
    let raw = |coder: &mut _, value: u32, bits: u32| raw_bits(coder, value, bits);
    let head = if u64::from(value) < short { value } else { ((u64::from(value) + short) >> 1) as u32 };
    let head = raw(coder, head, bits - 1);
    if u64::from(head) < short {
        return head;
    }
    let last = coder.raw(((u64::from(value) + short) & 1) as u32, 1);
    ((u64::from(head) << 1 | u64::from(last)) - short) as u32
}

/// Codes the low `count` (at most 32) bits of `value` at even odds.
pub(crate) fn raw_bits(coder: &mut impl BitCoder, value: u32, count: u32) -> u32 {
    let mut left = count;
    let mut coded = 0u32;
    while left > 0 {
        let step = left.min(16);
        left -= step;
        let chunk = coder.raw(value >> left & ((1u32 << step) - 1), step);
        coded = if step == 32 { chunk } else { coded << step | chunk };
    }
    coded
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn random_mixtures_decode_to_what_was_encoded() {
        for seed in 0..300 {
            let mut rng = fastrand::Rng::with_seed(seed);
            let n = rng.usize(0..400);
            let skew = rng.u32(1..40);
            let items: Vec<(u32, u32, u32)> =
                (0..n).map(|_| (rng.u32(0..4), rng.u32(..) >> rng.u32(0..32), rng.u32(1..2000))).collect();
            let run = |coder: &mut dyn FnMut(u32, u32, u32) -> u32| -> Vec<u32> {
                items.iter().map(|&(kind, value, count)| coder(kind, value, count)).collect()
            };
            let mut encoder = Encoder::new();
            let (mut bits, mut number, mut tree) = ([Prob::HALF; 2], NumberModel::NEW, TreeModel::<16>::NEW);
            let encoded = run(&mut |kind, value, count| match kind {
                0 => u32::from(encoder.bit(&mut bits[0], value % skew == 0)),
                1 => number.code(&mut encoder, value.min(u32::MAX - 1)),
                2 => tree.code(&mut encoder, value % 16),
                _ => uniform(&mut encoder, value % count, count),
            });
            let bytes = encoder.finish();
            let mut decoder = Decoder::new(&bytes);
            let (mut bits, mut number, mut tree) = ([Prob::HALF; 2], NumberModel::NEW, TreeModel::<16>::NEW);
            let decoded = run(&mut |kind, _, count| match kind {
                0 => u32::from(decoder.bit(&mut bits[0], false)),
                1 => number.code(&mut decoder, 0),
                2 => tree.code(&mut decoder, 0),
                _ => uniform(&mut decoder, 0, count),
            });
            assert_eq!(encoded, decoded, "seed {seed}");
            assert!(!decoder.is_overrun() && !decoder.has_trailing(), "seed {seed}");
            for (&(kind, value, count), got) in items.iter().zip(&encoded) {
                match kind {
                    1 => assert_eq!(*got, value.min(u32::MAX - 1)),
                    2 => assert_eq!(*got, value % 16),
                    3 => assert_eq!(*got, value % count),
                    _ => {}
                }
            }
        }
    }

    #[test]
    fn a_skewed_bit_costs_little() {
        let mut encoder = Encoder::new();
        let mut p = Prob::HALF;
        for i in 0..8000 {
            encoder.bit(&mut p, i % 100 == 0);
        }
        // The entropy is 0.081 bits each, 81 bytes; adaptation costs something.
        assert!(encoder.finish().len() < 110);
    }
}
