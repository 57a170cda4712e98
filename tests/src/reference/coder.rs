//! The range coder with contexts by name, reading; what is read is written again by a plain encoder.

use std::collections::BTreeMap;

/// Two estimates that the next bit is 0, in 1/2^16, by the name of the context.
pub(super) type Contexts = BTreeMap<String, [u32; 2]>;

/// Contexts that start where they were trained to; beyond the end of `priors` at even odds.
pub(super) fn contexts(names: &[String], priors: &[u16]) -> Contexts {
    let trained = priors.iter().map(|&prior| u32::from(prior));
    let priors = trained.chain(std::iter::repeat(1 << 15));
    let contexts: Contexts = names.iter().cloned().zip(priors.map(|prior| [prior; 2])).collect();
    assert_eq!(contexts.len(), names.len(), "each context has a name of its own");
    contexts
}

/// Reads a stream.
pub(super) struct Tape<'a> {
    bytes: &'a [u8],
    at: usize,
    code: u32,
    range: u32,
    again: Encoder,
}

impl<'a> Tape<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        let mut tape = Self { bytes, at: 0, code: 0, range: u32::MAX, again: Encoder::default() };
        (0..4).for_each(|_| tape.next_byte());
        tape
    }

    fn next_byte(&mut self) {
        self.code = self.code << 8 | u32::from(self.bytes.get(self.at).copied().unwrap_or(0));
        self.at += 1;
    }

    /// What an encoder writes for all that was read.
    pub(super) fn encoded_again(self) -> Vec<u8> {
        self.again.finish(self.range)
    }

    /// Goes on with the part of the range that begins at `start`.
    fn narrow(&mut self, start: u32, range: u32) {
        self.code -= start;
        self.range = range;
        self.again.add(start);
        while self.range < 1 << 24 {
            self.range <<= 8;
            self.next_byte();
            self.again.shift();
        }
    }

    pub(super) fn bit(&mut self, contexts: &mut Contexts, name: &str) -> bool {
        let estimates = contexts.get_mut(name).unwrap_or_else(|| panic!("no context is called {name}"));
        let zero = ((estimates[0] + estimates[1]) / 2).clamp(32, 65504);
        let bound = (self.range >> 16) * zero;
        let bit = self.code >= bound;
        for (estimate, rate) in estimates.iter_mut().zip([5, 8]) {
            match bit {
                true => *estimate -= *estimate >> rate,
                false => *estimate += (65535 - *estimate) >> rate,
            }
        }
        match bit {
            true => self.narrow(bound, self.range - bound),
            false => self.narrow(0, bound),
        }
        bit
    }

    /// A number of so many bits at even odds, sixteen at a time from the highest.
    pub(super) fn raw(&mut self, mut bits: u32) -> u32 {
        let mut value = 0u64;
        while bits > 0 {
            let step = bits.min(16);
            bits -= step;
            let unit = self.range >> step;
            let chunk = (self.code / unit).min((1 << step) - 1);
            self.narrow(chunk * unit, unit);
            value = value << step | u64::from(chunk);
        }
        value as u32
    }

    pub(super) fn uniform(&mut self, count: u32) -> u32 {
        if count == 1 {
            return 0;
        }
        let bits = (count - 1).ilog2() + 1;
        let short = ((1u64 << bits) - u64::from(count)) as u32;
        let head = self.raw(bits - 1);
        if head < short { head } else { head * 2 + self.raw(1) - short }
    }

    /// Bits below a leading one, the first two with contexts.
    fn below_leading(&mut self, contexts: &mut Contexts, name: &str, bits: u32) -> (u32, u32) {
        let (mut value, mut left) = (1, bits);
        for _ in 0..bits.min(2) {
            value = value * 2 + u32::from(self.bit(contexts, &format!("{name}/{value}")));
            left -= 1;
        }
        (value, left)
    }

    pub(super) fn number(&mut self, contexts: &mut Contexts, name: &str) -> u32 {
        let mut length = 0;
        while length < 31 && self.bit(contexts, &format!("{name}/length/{length}")) {
            length += 1;
        }
        let (head, left) = self.below_leading(contexts, &format!("{name}/mantissa/{}", length.min(15)), length);
        // The longest has its raw bits from the highest, as all.
        let rest = self.raw(left);
        (head << left | rest) - 1
    }

    pub(super) fn zigzag(&mut self, contexts: &mut Contexts, name: &str) -> i32 {
        let number = self.number(contexts, name);
        if number.is_multiple_of(2) { (number / 2) as i32 } else { -((number / 2) as i32) - 1 }
    }

    pub(super) fn tree(&mut self, contexts: &mut Contexts, name: &str, leaves: u32) -> u32 {
        let mut node = 1;
        while node < leaves {
            node = node * 2 + u32::from(self.bit(contexts, &format!("{name}/{node}")));
        }
        node - leaves
    }

    /// What comes before the raw bits of a number of expected size `2^(size / 16)`: least value, raw bits.
    fn scaled_head(&mut self, contexts: &mut Contexts, name: &str, escape: &str, size: i32) -> (u32, u32) {
        let half_octaves = (size.clamp(-16, 384) + 16) as u32 / 8;
        let (class, shift) = match half_octaves {
            0..8 => (half_octaves, 0),
            _ => (8 + half_octaves % 2, half_octaves / 2 - 4),
        };
        let length = self.tree(contexts, &format!("{name}/{class}/length"), 8);
        if length == 7 {
            return ((127 + self.number(contexts, escape)) << shift, shift);
        }
        let (head, left) = self.below_leading(contexts, &format!("{name}/{class}/mantissa/{length}"), length);
        ((head << (left + shift)) - (1 << shift), left + shift)
    }

    pub(super) fn scaled(&mut self, contexts: &mut Contexts, name: &str, escape: &str, size: i32) -> u32 {
        let (least, bits) = self.scaled_head(contexts, name, escape, size);
        least + self.raw(bits)
    }

    pub(super) fn scaled_signed(&mut self, contexts: &mut Contexts, name: &str, escape: &str, size: i32) -> i32 {
        let (least, bits) = self.scaled_head(contexts, name, escape, size);
        // Where it cannot be zero, the sign is the last of the raw bits; else it has one of its own, unless it is.
        let (magnitude, is_negative) = match least {
            0 => {
                let magnitude = self.raw(bits);
                (magnitude, magnitude > 0 && self.raw(1) == 1)
            }
            _ => {
                let both = self.raw(bits + 1);
                (least + both / 2, both % 2 == 1)
            }
        };
        if is_negative { -(magnitude as i32) } else { magnitude as i32 }
    }
}

/// One long number, to which is added.
#[derive(Default)]
struct Encoder {
    digits: Vec<u8>,
    low: u64,
}

impl Encoder {
    fn add(&mut self, start: u32) {
        self.low += u64::from(start);
        self.carry();
    }

    fn carry(&mut self) {
        if self.low >> 32 == 0 {
            return;
        }
        self.low &= 0xffff_ffff;
        for digit in self.digits.iter_mut().rev() {
            *digit = digit.wrapping_add(1);
            if *digit != 0 {
                return;
            }
        }
        panic!("the number is below one");
    }

    fn shift(&mut self) {
        self.digits.push((self.low >> 24) as u8);
        self.low = self.low << 8 & 0xffff_ffff;
    }

    fn finish(mut self, range: u32) -> Vec<u8> {
        let coded = self.digits.len();
        let top = self.low + u64::from(range) - 1;
        // Of the numbers in range one with as many zero bytes at the end as can be.
        let candidates = [32, 24, 16, 8, 0].map(|bits| top >> bits << bits);
        self.low = candidates.into_iter().find(|&number| number >= self.low).expect("the last is the top");
        self.carry();
        (0..4).for_each(|_| self.shift());
        while self.digits.len() > coded && self.digits.last() == Some(&0) {
            self.digits.pop();
        }
        self.digits
    }
}

/// Names of the contexts of composite models, in the order of the trained priors.
pub(super) mod names {
    pub(in super::super) fn each(name: &str, ends: &[u32]) -> Vec<String> {
        let mut names = vec![name.to_owned()];
        for &end in ends {
            names = names.iter().flat_map(|name| (0..end).map(move |i| format!("{name}/{i}"))).collect();
        }
        names
    }

    pub(in super::super) fn number(name: &str) -> Vec<String> {
        let mantissa = each(&format!("{name}/mantissa"), &[16, 4]);
        each(&format!("{name}/length"), &[33]).into_iter().chain(mantissa).collect()
    }

    pub(in super::super) fn scaled_set(name: &str) -> Vec<String> {
        let one = |name: String| -> Vec<String> {
            let mantissa = (1..7).flat_map(|length| (1..4).map(move |head| (length, head)));
            let mantissa = mantissa.map(|(length, head)| format!("{name}/mantissa/{length}/{head}"));
            each(&format!("{name}/length"), &[8]).into_iter().chain(mantissa).collect()
        };
        each(name, &[10]).into_iter().flat_map(one).collect()
    }

    pub(in super::super) fn near(name: &str) -> Vec<String> {
        [each(&format!("{name}/length"), &[64]), each(&format!("{name}/mantissa"), &[4]), vec![format!("{name}/sign")]]
            .concat()
    }
}
