//! Where the rows of a PLY file come from: tokens of text or bytes of either order, behind one interface.

use super::super::number::{line_at, parse_f64, parse_i64};
use super::super::{Place, quoted};
use super::header::{Element, Kind, Scalar};

/// Why a value could not be read. Turned into an error with its row and place by the caller.
#[derive(Debug)]
pub(super) enum Fault {
    /// The file ends.
    End,
    /// A token that is no number, or no integer where one is needed.
    NotANumber(String),
    /// A list with a negative count.
    NegativeCount(i64),
    /// A list that is longer than the rest of the file.
    ListTooLong(u64),
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::End => write!(f, "the file ends here"),
            Self::NotANumber(token) => write!(f, "{token} is not a number of the property's type"),
            Self::NegativeCount(count) => write!(f, "a list of {count} items"),
            Self::ListTooLong(count) => write!(f, "a list of {count} items is longer than the rest of the file"),
        }
    }
}

/// A cursor over the rows.
pub(super) trait Source {
    /// Reads a number as `f64`, which holds every type exactly.
    fn scalar(&mut self, kind: Scalar) -> Result<f64, Fault>;
    /// Reads a number that has to be an integer.
    fn integer(&mut self, kind: Scalar) -> Result<i64, Fault>;
    /// Passes over `count` numbers.
    fn skip(&mut self, kind: Scalar, count: u64) -> Result<(), Fault>;
    /// Least bytes that `count` numbers take from here on.
    fn min_bytes(&self, kind: Scalar, count: u64) -> u128;
    /// Least bytes that all rows of `element` take from here on.
    fn min_element_bytes(&self, element: &Element) -> u128;
    /// Bytes that are left.
    fn left(&self) -> usize;
    /// Where the value asked for last starts. Linear in the length of a text file: for errors only.
    fn place(&self) -> Place;
    /// Whether values follow the last row.
    fn has_more(&mut self) -> bool;

    /// Reads the count of a list and checks it against the bytes that are left.
    #[inline]
    fn list_len(&mut self, count: Scalar, item: Scalar) -> Result<u64, Fault> {
        let written = self.integer(count)?;
        let len = u64::try_from(written).map_err(|_| Fault::NegativeCount(written))?;
        if self.min_bytes(item, len) > self.left() as u128 {
            return Err(Fault::ListTooLong(len));
        }
        Ok(len)
    }

    /// Passes over one property of a row.
    #[inline]
    fn skip_property(&mut self, kind: Kind) -> Result<(), Fault> {
        match kind {
            Kind::Scalar(scalar) => self.skip(scalar, 1),
            Kind::List { count, item } => {
                let len = self.list_len(count, item)?;
                self.skip(item, len)
            }
        }
    }
}

/// Text: numbers between white space. Line breaks carry no meaning, as in most readers.
pub(super) struct Text<'a> {
    bytes: &'a [u8],
    at: usize,
    /// Start of the token read last.
    last: usize,
}

impl<'a> Text<'a> {
    pub(super) fn new(bytes: &'a [u8], at: usize) -> Self {
        Self { bytes, at, last: at }
    }

    #[inline]
    fn skip_space(&mut self) {
        while self.bytes.get(self.at).is_some_and(|&b| b <= b' ') {
            self.at += 1;
        }
    }

    #[inline]
    fn token(&mut self) -> Result<&'a [u8], Fault> {
        self.skip_space();
        self.last = self.at;
        while self.bytes.get(self.at).is_some_and(|&b| b > b' ') {
            self.at += 1;
        }
        if self.last == self.at { Err(Fault::End) } else { Ok(&self.bytes[self.last..self.at]) }
    }
}

impl Source for Text<'_> {
    #[inline]
    fn scalar(&mut self, _: Scalar) -> Result<f64, Fault> {
        let token = self.token()?;
        parse_f64(token).ok_or_else(|| Fault::NotANumber(quoted(token)))
    }

    #[inline]
    fn integer(&mut self, _: Scalar) -> Result<i64, Fault> {
        let token = self.token()?;
        if let Some(value) = parse_i64(token) {
            return Ok(value);
        }
        // Some writers print every number as a float.
        match parse_f64(token) {
            Some(value) if value == value.trunc() && value.abs() < 1e15 => Ok(value as i64),
            _ => Err(Fault::NotANumber(quoted(token))),
        }
    }

    fn skip(&mut self, _: Scalar, count: u64) -> Result<(), Fault> {
        for _ in 0..count {
            self.token()?;
        }
        Ok(())
    }

    fn min_bytes(&self, _: Scalar, count: u64) -> u128 {
        // A digit and a space each; the last number of the file needs no space.
        (u128::from(count) * 2).saturating_sub(1)
    }

    fn min_element_bytes(&self, element: &Element) -> u128 {
        (u128::from(element.rows) * element.properties.len() as u128 * 2).saturating_sub(1)
    }

    fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    fn place(&self) -> Place {
        Place::Line(line_at(self.bytes, self.last))
    }

    fn has_more(&mut self) -> bool {
        self.skip_space();
        self.left() > 0
    }
}

/// Bytes, most significant first if `BIG`.
pub(super) struct Binary<'a, const BIG: bool> {
    bytes: &'a [u8],
    at: usize,
    /// Start of the value read last.
    last: usize,
}

impl<'a, const BIG: bool> Binary<'a, BIG> {
    pub(super) fn new(bytes: &'a [u8], at: usize) -> Self {
        Self { bytes, at, last: at }
    }

    #[inline]
    fn take<const N: usize>(&mut self) -> Result<[u8; N], Fault> {
        self.last = self.at;
        let taken = self.bytes[self.at..].first_chunk::<N>().ok_or(Fault::End)?;
        self.at += N;
        let mut value = *taken;
        if BIG {
            value.reverse();
        }
        Ok(value)
    }
}

impl<const BIG: bool> Source for Binary<'_, BIG> {
    #[inline]
    fn scalar(&mut self, kind: Scalar) -> Result<f64, Fault> {
        Ok(match kind {
            Scalar::F32 => f64::from(f32::from_le_bytes(self.take()?)),
            Scalar::F64 => f64::from_le_bytes(self.take()?),
            // At most 32 bits, so the conversion is exact.
            integer => self.integer(integer)? as f64,
        })
    }

    #[inline]
    fn integer(&mut self, kind: Scalar) -> Result<i64, Fault> {
        Ok(match kind {
            Scalar::I8 => i64::from(i8::from_le_bytes(self.take()?)),
            Scalar::U8 => i64::from(u8::from_le_bytes(self.take()?)),
            Scalar::I16 => i64::from(i16::from_le_bytes(self.take()?)),
            Scalar::U16 => i64::from(u16::from_le_bytes(self.take()?)),
            Scalar::I32 => i64::from(i32::from_le_bytes(self.take()?)),
            Scalar::U32 => i64::from(u32::from_le_bytes(self.take()?)),
            Scalar::F32 | Scalar::F64 => {
                let value = self.scalar(kind)?;
                if value != value.trunc() || value.abs() >= 1e15 {
                    return Err(Fault::NotANumber(format!("{value}")));
                }
                value as i64
            }
        })
    }

    #[inline]
    fn skip(&mut self, kind: Scalar, count: u64) -> Result<(), Fault> {
        self.last = self.at;
        let bytes = usize::try_from(self.min_bytes(kind, count)).map_err(|_| Fault::End)?;
        if bytes > self.left() {
            return Err(Fault::End);
        }
        self.at += bytes;
        Ok(())
    }

    #[inline]
    fn min_bytes(&self, kind: Scalar, count: u64) -> u128 {
        u128::from(count) * kind.byte_len() as u128
    }

    fn min_element_bytes(&self, element: &Element) -> u128 {
        u128::from(element.rows) * element.min_row_bytes() as u128
    }

    #[inline]
    fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    fn place(&self) -> Place {
        Place::Byte(self.last as u64)
    }

    fn has_more(&mut self) -> bool {
        self.left() > 0
    }
}
