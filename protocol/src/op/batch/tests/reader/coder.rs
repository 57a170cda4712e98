//! The coder and its numbers for the dull reader.

use super::Fault;

/// The numbers behind `key`, after `section`, of the file, flattened.
pub(super) fn numbers(section: &str, key: &str) -> Vec<i64> {
    let text = include_str!("../../../../../../docs/protocol-v6-numbers.json");
    let behind = |text: &'static str, key: &str| text.split_once(&format!("\"{key}\":")).expect("a key").1;
    let mut text = behind(text, section);
    if !key.is_empty() {
        text = behind(text, key);
    }
    let mut depth = 0;
    let end = text.find(|c| {
        depth += i32::from(c == '[') - i32::from(c == ']');
        depth == 0 && (c == ']' || c == ',' || c == '}')
    });
    let is_separator = |c: char| c != '-' && !c.is_ascii_digit();
    text[..end.unwrap()].split(is_separator).filter(|part| !part.is_empty()).map(|part| part.parse().unwrap()).collect()
}

pub(super) const PATCH: usize = 7447;

/// The coder with all contexts, those of patches behind those of batches.
#[derive(Clone)]
pub(super) struct Coder {
    pub(super) contexts: Vec<[i64; 2]>,
    pub(super) bytes: Vec<u8>,
    pub(super) at: usize,
    pub(super) range: u64,
    pub(super) code: u64,
}

pub(super) fn bit_length(x: i128) -> i64 {
    128 - i64::from(x.leading_zeros())
}

pub(super) fn lg(x: i128) -> i64 {
    let x = x.max(1);
    let e = bit_length(x) - 1;
    16 * e + ((x << 4 >> e) & 15) as i64
}

pub(super) fn power(x: i64) -> i64 {
    const P: [i64; 16] = [
        65_536, 68_438, 71_468, 74_632, 77_936, 81_386, 84_990, 88_752, 92_682, 96_785, 101_070, 105_545, 110_218,
        115_098, 120_194, 125_515,
    ];
    (P[x.rem_euclid(16) as usize] >> ((15 - x) / 16)).max(1)
}

pub(super) fn unzigzag(x: i64) -> i64 {
    if x % 2 == 0 { x / 2 } else { -(x + 1) / 2 }
}

impl Coder {
    pub(super) fn start(&mut self, bytes: &[u8]) {
        (self.bytes, self.at, self.range, self.code) = (bytes.to_vec(), 0, 0xffff_ffff, 0);
        (0..4).for_each(|_| self.shift());
    }

    pub(super) fn end(&self) -> Result<(), Fault> {
        if (self.bytes.len()..=self.bytes.len() + 8).contains(&self.at) { Ok(()) } else { Err(Fault) }
    }

    fn shift(&mut self) {
        self.code = self.code << 8 | u64::from(self.bytes.get(self.at).copied().unwrap_or(0));
        self.at += 1;
    }

    fn normalize(&mut self) {
        while self.range < 1 << 24 {
            self.range <<= 8;
            self.shift();
        }
    }

    pub(super) fn bit(&mut self, context: usize) -> bool {
        let [fast, slow] = &mut self.contexts[context];
        let p = ((*fast + *slow) >> 1).clamp(32, 65_504);
        let bound = (self.range >> 16) * p as u64;
        let bit = self.code >= bound;
        if bit {
            *fast -= *fast >> 5;
            *slow -= *slow >> 8;
            (self.code, self.range) = (self.code - bound, self.range - bound);
        } else {
            *fast += (65_535 - *fast) >> 5;
            *slow += (65_535 - *slow) >> 8;
            self.range = bound;
        }
        self.normalize();
        bit
    }

    pub(super) fn raw(&mut self, count: i64) -> i64 {
        let (mut left, mut out) = (count, 0);
        while left > 0 {
            let step = left.min(16);
            left -= step;
            self.range >>= step;
            let value = (self.code / self.range).min((1 << step) - 1);
            self.code -= value * self.range;
            self.normalize();
            out = out << step | value as i64;
        }
        out
    }

    pub(super) fn number(&mut self, at: usize) -> i64 {
        let mut n = 0;
        while n < 31 && self.bit(at + n) {
            n += 1;
        }
        let (mut c, mut left) = (1, n as i64);
        while left > 0 && c < 4 {
            left -= 1;
            c = 2 * c + i64::from(self.bit(at + 33 + n.min(15) * 4 + c as usize));
        }
        (c << left | self.raw(left)) - 1
    }

    pub(super) fn tree(&mut self, at: usize, nodes: usize) -> i64 {
        let mut c = 1;
        while c < nodes {
            c = 2 * c + usize::from(self.bit(at + c));
        }
        (c - nodes) as i64
    }

    pub(super) fn uniform(&mut self, n: i64) -> i64 {
        let b = bit_length(i128::from(n - 1));
        if b == 0 {
            return 0;
        }
        let short = (1 << b) - n;
        let y = self.raw(b - 1);
        if y < short { y } else { 2 * y + self.raw(1) - short }
    }

    /// What the raw bits of a scaled number are added to, and how many they are.
    fn scaled_head(&mut self, at: usize, escape: usize, size: i64) -> (i64, i64) {
        let c = (size.clamp(-16, 384) + 16) >> 3;
        let (model, shift) = if c < 8 { (c, 0) } else { (8 + (c & 1), (c >> 1) - 4) };
        let at = at + 26 * model as usize;
        let n = self.tree(at, 8);
        if n == 7 {
            return ((self.number(escape) + 127) << shift, shift);
        }
        let (mut c, mut left) = (1, n);
        while left > 0 && c < 4 {
            left -= 1;
            c = 2 * c + i64::from(self.bit(at + 8 + (n as usize - 1) * 3 + c as usize - 1));
        }
        ((c << (left + shift)) - (1 << shift), left + shift)
    }

    pub(super) fn scaled(&mut self, at: usize, escape: usize, size: i64) -> i64 {
        let (base, rest) = self.scaled_head(at, escape, size);
        base + self.raw(rest)
    }

    pub(super) fn signed(&mut self, at: usize, escape: usize, size: i64) -> i64 {
        let (base, rest) = self.scaled_head(at, escape, size);
        let (magnitude, is_negative) = if base != 0 {
            let raw = self.raw(rest + 1);
            (base + (raw >> 1), raw & 1 == 1)
        } else {
            let magnitude = self.raw(rest);
            (magnitude, magnitude != 0 && self.raw(1) == 1)
        };
        if is_negative { -magnitude } else { magnitude }
    }

    pub(super) fn near(&mut self, at: usize, s: i64) -> i64 {
        let n = self.tree(at, 64) + s - 32;
        if n <= 0 {
            return 0;
        }
        let (mut c, mut left) = (1, n - 1);
        while left > 0 && c < 4 {
            left -= 1;
            c = 2 * c + i64::from(self.bit(at + 64 + c as usize));
        }
        c = c << left | self.raw(left);
        if self.bit(at + 68) { -c } else { c }
    }
}
