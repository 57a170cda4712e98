//! Where the rows of a PLY file come from: tokens of text or bytes of either order, behind one interface.

use super::super::input::Input;
use super::super::number::{parse_f64, parse_i64};
use super::super::{Place, ReadError, quoted};
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
    /// The file cannot be read, whatever it holds.
    Read(Box<ReadError>),
}

impl From<ReadError> for Fault {
    #[cold]
    fn from(error: ReadError) -> Self {
        Self::Read(Box::new(error))
    }
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::End => write!(f, "the file ends here"),
            Self::NotANumber(token) => write!(f, "{token} is not a number of the property's type"),
            Self::NegativeCount(count) => write!(f, "a list of {count} items"),
            Self::ListTooLong(count) => write!(f, "a list of {count} items is longer than the rest of the file"),
            Self::Read(error) => write!(f, "{error}"),
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
    fn left(&self) -> u64;
    /// Where the value asked for last starts: for errors only.
    fn place(&self) -> Place;
    /// Whether values follow the last row.
    fn has_more(&mut self) -> Result<bool, ReadError>;

    /// Passes over the rows of `row_bytes` each that are at hand, up to `most` of them, and gives their bytes: none where
    /// [`Source::HAS_FIXED_ROWS`] does not hold or the file ends before the next row does.
    fn fixed_rows(&mut self, _row_bytes: usize, _most: u64) -> Result<&[u8], ReadError> {
        Ok(&[])
    }

    /// Whether rows of a fixed number of little-endian bytes can be had at once.
    const HAS_FIXED_ROWS: bool = false;

    /// Passes over the rows at hand that are a byte of 3 and three indices below `vertices` of four bytes, calls `take` with
    /// each and says how many they were: none where [`Source::HAS_FIXED_ROWS`] does not hold.
    fn triangles(
        &mut self,
        _most: u64,
        _vertices: u64,
        _take: impl FnMut([u32; 3]) -> Result<(), ReadError>,
    ) -> Result<u64, ReadError> {
        Ok(0)
    }

    /// Reads the count of a list and checks it against the bytes that are left.
    #[inline]
    fn list_len(&mut self, count: Scalar, item: Scalar) -> Result<u64, Fault> {
        let written = self.integer(count)?;
        let len = u64::try_from(written).map_err(|_| Fault::NegativeCount(written))?;
        if self.min_bytes(item, len) > u128::from(self.left()) {
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
pub(super) struct Text<'i, 'a> {
    input: &'i mut Input<'a>,
    /// Offset in the file of the token read last.
    last: u64,
}

impl<'i, 'a> Text<'i, 'a> {
    pub(super) fn new(input: &'i mut Input<'a>) -> Self {
        let last = input.position();
        Self { input, last }
    }

    fn skip_space(&mut self) -> Result<(), ReadError> {
        loop {
            let window = self.input.fill(1)?;
            let space = window.iter().position(|&b| b > b' ');
            let (step, done) = (space.unwrap_or(window.len()), space.is_some() || window.is_empty());
            self.input.consume(step);
            if done {
                return Ok(());
            }
        }
    }

    #[inline]
    fn token(&mut self) -> Result<&[u8], Fault> {
        let window = self.input.window();
        let start = window.iter().position(|&b| b > b' ').unwrap_or(window.len());
        let len = window[start..].iter().position(|&b| b <= b' ');
        let (start, len) = match len {
            Some(len) => (start, len),
            None => self.far_token()?,
        };
        self.last = self.input.position() + start as u64;
        let token = start..start + len;
        // The window of before, whose bytes stay where they are when they are consumed.
        self.input.consume(token.end);
        Ok(self.input.consumed(len))
    }

    /// A token that does not end in the window: where it starts in the window, and its length.
    #[cold]
    fn far_token(&mut self) -> Result<(usize, usize), Fault> {
        self.skip_space()?;
        self.last = self.input.position();
        let mut known = 0;
        loop {
            let window = self.input.fill(known + 1)?;
            if let Some(end) = window[known..].iter().position(|&b| b <= b' ') {
                return Ok((0, known + end));
            }
            if window.len() == known {
                // The file ends, or nothing more fits the buffer.
                return match (known, self.input.left() == known as u64) {
                    (0, _) => Err(Fault::End),
                    (_, true) => Ok((0, known)),
                    (_, false) => Err(Fault::NotANumber(quoted(self.input.window()))),
                };
            }
            known = window.len();
        }
    }
}

impl Source for Text<'_, '_> {
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

    fn left(&self) -> u64 {
        self.input.left()
    }

    fn place(&self) -> Place {
        Place::Line(self.input.line_at(self.last))
    }

    fn has_more(&mut self) -> Result<bool, ReadError> {
        self.skip_space()?;
        Ok(self.left() > 0)
    }
}

/// Bytes, most significant first if `BIG`.
pub(super) struct Binary<'i, 'a, const BIG: bool> {
    input: &'i mut Input<'a>,
    /// Offset in the file of the value read last.
    last: u64,
}

impl<'i, 'a, const BIG: bool> Binary<'i, 'a, BIG> {
    pub(super) fn new(input: &'i mut Input<'a>) -> Self {
        let last = input.position();
        Self { input, last }
    }

    #[inline]
    fn take<const N: usize>(&mut self) -> Result<[u8; N], Fault> {
        self.last = self.input.position();
        let taken = self.input.fill(N)?.first_chunk::<N>().ok_or(Fault::End)?;
        let mut value = *taken;
        self.input.consume(N);
        if BIG {
            value.reverse();
        }
        Ok(value)
    }
}

impl<const BIG: bool> Source for Binary<'_, '_, BIG> {
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
        self.last = self.input.position();
        let bytes = u64::try_from(self.min_bytes(kind, count)).map_err(|_| Fault::End)?;
        if bytes > self.input.left() {
            return Err(Fault::End);
        }
        Ok(self.input.skip(bytes)?)
    }

    #[inline]
    fn min_bytes(&self, kind: Scalar, count: u64) -> u128 {
        u128::from(count) * kind.byte_len() as u128
    }

    fn min_element_bytes(&self, element: &Element) -> u128 {
        u128::from(element.rows) * element.min_row_bytes() as u128
    }

    #[inline]
    fn left(&self) -> u64 {
        self.input.left()
    }

    fn place(&self) -> Place {
        Place::Byte(self.last)
    }

    fn has_more(&mut self) -> Result<bool, ReadError> {
        Ok(self.left() > 0)
    }

    const HAS_FIXED_ROWS: bool = !BIG;

    fn fixed_rows(&mut self, row_bytes: usize, most: u64) -> Result<&[u8], ReadError> {
        let rows = self.input.fill(row_bytes)?.len() / row_bytes.max(1);
        let bytes = rows.min(usize::try_from(most).unwrap_or(usize::MAX)) * row_bytes;
        self.input.consume(bytes);
        Ok(self.input.consumed(bytes))
    }

    fn triangles(
        &mut self,
        most: u64,
        vertices: u64,
        mut take: impl FnMut([u32; 3]) -> Result<(), ReadError>,
    ) -> Result<u64, ReadError> {
        const ROW: usize = 1 + 3 * 4;
        if BIG {
            return Ok(0);
        }
        let window = self.input.fill(ROW)?;
        let most = usize::try_from(most).unwrap_or(usize::MAX);
        let mut rows = 0;
        for row in window.as_chunks::<ROW>().0.iter().take(most) {
            let [count, corners @ ..] = row;
            let corners = corners.as_chunks::<4>().0;
            let face: [u32; 3] = std::array::from_fn(|k| u32::from_le_bytes(corners[k]));
            let is_plain = *count == 3 && face.iter().all(|&corner| u64::from(corner) < vertices);
            if !is_plain {
                break;
            }
            take(face)?;
            rows += 1;
        }
        self.input.consume(rows * ROW);
        Ok(rows as u64)
    }
}
