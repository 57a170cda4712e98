//! Accessors: sequences of numbers in a buffer, read in order and without being held.

use super::super::ReadError;
use super::super::input::Input;
use super::buffers::{Buffers, View};
use super::document::{Accessor, Document, Shape};
use super::fault;

/// Most entries of the sparse part of an accessor, which are held in memory.
const MAX_SPARSE: u64 = 1 << 22;

/// Type of a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Component {
    I8,
    U8,
    I16,
    U16,
    U32,
    F32,
}

impl Component {
    fn of(code: u32) -> Option<Self> {
        Some(match code {
            5120 => Self::I8,
            5121 => Self::U8,
            5122 => Self::I16,
            5123 => Self::U16,
            5125 => Self::U32,
            5126 => Self::F32,
            _ => return None,
        })
    }

    fn byte_len(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::U32 | Self::F32 => 4,
        }
    }

    /// The number, and what stands for one if it is normalized.
    #[inline]
    fn get(self, bytes: &[u8]) -> (f64, f64) {
        let two = || [bytes[0], bytes[1]];
        let four = || [bytes[0], bytes[1], bytes[2], bytes[3]];
        match self {
            Self::I8 => (f64::from(bytes[0] as i8), 127.0),
            Self::U8 => (f64::from(bytes[0]), 255.0),
            Self::I16 => (f64::from(i16::from_le_bytes(two())), 32767.0),
            Self::U16 => (f64::from(u16::from_le_bytes(two())), 65535.0),
            Self::U32 => (f64::from(u32::from_le_bytes(four())), 4_294_967_295.0),
            Self::F32 => (f64::from(f32::from_le_bytes(four())), 1.0),
        }
    }
}

/// What an accessor is used for, which says what it may look like.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Use {
    Indices,
    Positions,
    Colors,
    TextureCoordinates,
}

/// An accessor that was checked against its buffer.
#[derive(Debug)]
pub(super) struct Numbers {
    index: u32,
    view: Option<View>,
    /// Of the first entry in the view.
    offset: u64,
    stride: usize,
    component: Component,
    components: usize,
    normalized: bool,
    count: u64,
    /// Entries that are replaced, last one first.
    sparse: Vec<(u64, [f64; 4])>,
}

impl Numbers {
    /// Checks accessor `index`, opening its buffer.
    ///
    /// # Errors
    /// [`ReadError::Document`] names the accessor, the view or the buffer.
    pub(super) fn new(
        index: u32,
        wanted: Use,
        document: &Document<'_>,
        buffers: &mut Buffers<'_>,
    ) -> Result<Self, ReadError> {
        let fault = |problem: String| fault(format!("accessors[{index}]"), problem);
        let Some(accessor) = document.accessors.0.get(index as usize) else {
            return Err(fault("there is no such accessor".into()));
        };
        let component = Component::of(accessor.component_type)
            .ok_or_else(|| fault(format!("component type {} is unknown", accessor.component_type)))?;
        let components = match accessor.shape {
            Shape::Scalar => 1,
            Shape::Vec2 => 2,
            Shape::Vec3 => 3,
            Shape::Vec4 => 4,
            Shape::Mat2 | Shape::Mat3 | Shape::Mat4 => 0,
        };
        let fits = match wanted {
            Use::Indices => components == 1 && matches!(component, Component::U8 | Component::U16 | Component::U32),
            Use::Positions => components == 3,
            Use::Colors => components == 3 || components == 4,
            Use::TextureCoordinates => components == 2,
        };
        if !fits {
            let type_code = accessor.component_type;
            return Err(fault(format!("{:?} of component type {type_code} cannot be {wanted:?}", accessor.shape)));
        }
        let size = component.byte_len() * components;
        let mut numbers = Self {
            index,
            view: None,
            offset: accessor.byte_offset,
            stride: size,
            component,
            components,
            normalized: accessor.normalized,
            count: accessor.count,
            sparse: Vec::new(),
        };
        match accessor.buffer_view {
            Some(view) => {
                let view = buffers.open(view, document)?;
                let stride = view.stride.unwrap_or(size as u64);
                // The format allows 4 to 252.
                numbers.stride = usize::try_from(stride).unwrap_or(0);
                if numbers.stride < size || numbers.stride > 252.max(size) {
                    return Err(fault(format!("a stride of {stride} bytes for entries of {size}")));
                }
                numbers.view = Some(view);
                let last = accessor.count.checked_sub(1).and_then(|last| last.checked_mul(stride));
                let end = last.and_then(|last| last.checked_add(size as u64)?.checked_add(accessor.byte_offset));
                if accessor.count > 0 && end.is_none_or(|end| end > view.len) {
                    let count = accessor.count;
                    return Err(fault(format!("{count} entries do not lie in a view of {} bytes", view.len)));
                }
            }
            // Zeros, of which a sparse part replaces some; their number is bounded by no buffer.
            None => {
                let sparse = accessor.sparse.as_ref().map_or(0, |sparse| sparse.count.min(MAX_SPARSE));
                if accessor.count > sparse.saturating_mul(1024) {
                    return Err(fault(format!("{} entries without a view", accessor.count)));
                }
            }
        }
        numbers.sparse = numbers.read_sparse(accessor, document, buffers)?;
        // The next one is at the end, where it can be popped.
        numbers.sparse.reverse();
        Ok(numbers)
    }

    pub(super) fn count(&self) -> u64 {
        self.count
    }

    /// Begins to read.
    pub(super) fn read<'b>(self, buffers: &'b Buffers<'_>) -> NumbersReader<'b> {
        let input = self.view.filter(|_| self.count > 0).map(|view| {
            let used = (self.count - 1) * self.stride as u64 + (self.component.byte_len() * self.components) as u64;
            buffers.of(view).input(view.start + self.offset, used)
        });
        NumbersReader { numbers: self, input, at: 0 }
    }

    fn read_sparse(
        &self,
        accessor: &Accessor,
        document: &Document<'_>,
        buffers: &mut Buffers<'_>,
    ) -> Result<Vec<(u64, [f64; 4])>, ReadError> {
        let Some(sparse) = &accessor.sparse else { return Ok(Vec::new()) };
        let fault = |problem: String| fault(format!("accessors[{}].sparse", self.index), problem);
        if sparse.count > MAX_SPARSE || sparse.count > self.count {
            return Err(fault(format!("{} replaced entries are too many", sparse.count)));
        }
        let kind = Component::of(sparse.indices.component_type)
            .filter(|kind| matches!(kind, Component::U8 | Component::U16 | Component::U32))
            .ok_or_else(|| fault("the indices are no unsigned integers".into()))?;
        let mut input = |view: u32, offset: u64, size: usize| {
            let view = buffers.open(view, document)?;
            let bytes = sparse.count * size as u64;
            if offset.checked_add(bytes).is_none_or(|end| end > view.len) {
                return Err(fault(format!("{} entries do not lie in a view of {} bytes", sparse.count, view.len)));
            }
            buffers.of(view).read(view.start + offset, bytes)
        };
        let index_bytes = input(sparse.indices.buffer_view, sparse.indices.byte_offset, kind.byte_len())?;
        let size = self.component.byte_len() * self.components;
        let value_bytes = input(sparse.values.buffer_view, sparse.values.byte_offset, size)?;
        let mut out: Vec<(u64, [f64; 4])> = Vec::with_capacity(sparse.count as usize);
        for (index, value) in index_bytes.chunks_exact(kind.byte_len()).zip(value_bytes.chunks_exact(size)) {
            let index = kind.get(index).0 as u64;
            if index >= self.count || out.last().is_some_and(|&(last, _)| last >= index) {
                return Err(fault(format!("index {index} is out of range or out of order")));
            }
            out.push((index, self.decode(value)));
        }
        Ok(out)
    }

    #[inline]
    fn decode(&self, bytes: &[u8]) -> [f64; 4] {
        let mut out = [0.0; 4];
        let size = self.component.byte_len();
        for (k, value) in out.iter_mut().enumerate().take(self.components) {
            let (number, one) = self.component.get(&bytes[k * size..]);
            *value = if self.normalized { (number / one).max(-1.0) } else { number };
        }
        out
    }
}

/// Entries of an accessor, in order; what it has no numbers for is 0.
pub(super) struct NumbersReader<'b> {
    numbers: Numbers,
    /// `None` where all entries are zero.
    input: Option<Input<'b>>,
    at: u64,
}

impl NumbersReader<'_> {
    /// The next entry.
    ///
    /// # Panics
    /// If all were read.
    #[inline]
    pub(super) fn next(&mut self) -> Result<[f64; 4], ReadError> {
        assert!(self.at < self.numbers.count);
        let mut value = [0.0; 4];
        if let Some(input) = &mut self.input {
            let size = self.numbers.component.byte_len() * self.numbers.components;
            value = self.numbers.decode(&input.fill(size)?[..size]);
            let stride = self.numbers.stride;
            if self.at + 1 < self.numbers.count {
                input.fill(stride)?;
                input.consume(stride);
            }
        }
        if let Some((_, replaced)) = self.numbers.sparse.pop_if(|(index, _)| *index == self.at) {
            value = replaced;
        }
        self.at += 1;
        Ok(value)
    }
}
