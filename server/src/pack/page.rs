//! Op pages: columns of integers, each stored as offsets from its smallest value in as few bytes as the page needs.

use super::layout::{
    MAX_CENTER, PAGE_HEADER, PAGE_OPS, align8,
    column::{self, TESTS},
    tag,
};
use super::record::{Bounds, Cone, CutRef, Magnitude, VERTEX_OPS};

/// What the columns of a model's pages may refer to.
#[derive(Clone, Copy, Debug)]
pub(super) struct PageContext {
    pub(super) ops: u32,
    pub(super) spawns: u32,
    pub(super) root_vertices: u32,
    pub(super) root_faces: u32,
    pub(super) max_coordinate: i32,
    pub(super) has_colors: bool,
    pub(super) has_moves: bool,
    pub(super) by_vertices: bool,
}

impl PageContext {
    /// First op, number of ops and number of spawns among them (which come first) of a page.
    #[inline]
    pub(super) fn rows(&self, page: u32) -> (u32, usize, usize) {
        let first = page * PAGE_OPS;
        let ops = (self.ops - first).min(PAGE_OPS);
        (first, ops as usize, self.spawns.saturating_sub(first).min(ops) as usize)
    }

    pub(super) fn columns(&self) -> usize {
        column::count(self.has_colors, self.has_moves) + if self.by_vertices { VERTEX_OPS } else { 0 }
    }
}

/// Bytes of a column's values, padded to the grid.
fn column_bytes(width: u8, rows: usize) -> usize {
    match width {
        3 => align8(2 * rows) + align8(rows),
        width => align8(usize::from(width) * rows),
    }
}

/// Builds a page column by column.
pub(super) struct PageBuilder {
    ops: u16,
    entries: Vec<u8>,
    data: Vec<u8>,
    header: usize,
}

impl PageBuilder {
    pub(super) fn new(ops: usize, columns: usize) -> Self {
        let ops = u16::try_from(ops).expect("a page has at most 256 ops");
        Self { ops, entries: Vec::new(), data: Vec::new(), header: PAGE_HEADER + 8 * columns }
    }

    /// Appends the next column; values are `u32` or `i32`.
    pub(super) fn push(&mut self, values: impl Iterator<Item = i64> + Clone) {
        let fixed = column::fixed_width(self.entries.len() / 8);
        let base = if fixed.is_some() { 0 } else { values.clone().min().unwrap_or(0) };
        let range = values.clone().max().map_or(0, |max| max - base);
        let width = fixed.unwrap_or(match range {
            0 => 0,
            1..=0xff => 1,
            0x100..=0xffff => 2,
            0x1_0000..=0xff_ffff => 3,
            _ => 4,
        });
        let offset = u16::try_from((self.header + self.data.len()) / 8).expect("a page is below 512 KB");
        self.entries.extend((base as u32).to_le_bytes());
        self.entries.extend(offset.to_le_bytes());
        self.entries.extend([width, 0]);
        let pad = |data: &mut Vec<u8>| data.resize(align8(data.len()), 0);
        let offsets = values.map(|value| (value - base) as u32);
        match width {
            0 => {}
            1 => self.data.extend(offsets.map(|v| v as u8)),
            2 => self.data.extend(offsets.flat_map(|v| (v as u16).to_le_bytes())),
            3 => {
                self.data.extend(offsets.clone().flat_map(|v| (v as u16).to_le_bytes()));
                pad(&mut self.data);
                self.data.extend(offsets.map(|v| (v >> 16) as u8));
            }
            _ => self.data.extend(offsets.flat_map(u32::to_le_bytes)),
        }
        pad(&mut self.data);
    }

    /// The page, its checksum seeded with its number.
    pub(super) fn finish(self, page: u32) -> Vec<u8> {
        let columns = (self.entries.len() / 8) as u16;
        let mut bytes = vec![0; 8];
        bytes.extend(self.ops.to_le_bytes());
        bytes.extend(columns.to_le_bytes());
        bytes.extend([0; 4]);
        bytes.extend(self.entries);
        debug_assert_eq!(bytes.len(), self.header);
        bytes.extend(self.data);
        seal(&mut bytes, page);
        bytes
    }
}

/// Puts the checksum of a page of either kind into its first 8 bytes.
pub(super) fn seal(page: &mut [u8], number: u32) {
    let checksum = checksum(page, number);
    page[..8].copy_from_slice(&checksum.to_le_bytes());
}

/// Checksum of a page of either kind: seeded with its number, so that swapped pages are noticed.
pub(super) fn checksum(page: &[u8], number: u32) -> u64 {
    xxhash_rust::xxh3::xxh3_64_with_seed(&page[8..], u64::from(number))
}

/// Offset of a column's values from its smallest, as stored.
#[derive(Clone, Copy, Debug)]
pub(super) enum Offsets<'a> {
    Zero,
    U8(&'a [u8]),
    U16(&'a [u16]),
    U24(&'a [u16], &'a [u8]),
    U32(&'a [u32]),
}

/// One column of a page, in place.
#[derive(Clone, Copy, Debug)]
pub struct Column<'a> {
    base: u32,
    rows: usize,
    offsets: Offsets<'a>,
}

impl Column<'_> {
    /// Appends all values to `out`. Costs well under a nanosecond a value.
    pub fn decode_into(&self, out: &mut Vec<i32>) {
        let base = self.base;
        match self.offsets {
            Offsets::Zero => out.extend(std::iter::repeat_n(base as i32, self.rows)),
            Offsets::U8(v) => out.extend(v.iter().map(|&x| base.wrapping_add(u32::from(x)) as i32)),
            Offsets::U16(v) => out.extend(v.iter().map(|&x| base.wrapping_add(u32::from(x)) as i32)),
            Offsets::U24(low, high) => out.extend(
                low.iter().zip(high).map(|(&l, &h)| base.wrapping_add(u32::from(l) | u32::from(h) << 16) as i32),
            ),
            Offsets::U32(v) => out.extend(v.iter().map(|&x| base.wrapping_add(x) as i32)),
        }
    }
}

/// The test arrays of consecutive ops, in place: what a scan over many ops reads.
#[derive(Clone, Copy, Debug)]
pub struct TestPage<'a> {
    /// Op of the first row.
    pub first_op: u32,
    /// Coordinates of the centres, in lattice steps.
    pub center: [Column<'a>; 3],
    /// [`Magnitude`] of each radius. The length is the number of ops.
    pub radius: &'a [u16],
    /// [`Magnitude`] of each error.
    pub error: &'a [u16],
    /// Octahedral axes of the cones.
    pub axis: [&'a [i8]; 2],
    /// Half-angles of the cones, see [`Cone`].
    pub half_angle: &'a [u8],
}

/// A page whose checksum, structure and fields were checked. Reads give `None` only if the bytes changed since.
#[derive(Clone, Copy, Debug)]
pub(super) struct PageView<'a> {
    pub(super) bytes: &'a [u8],
    pub(super) ops: usize,
    pub(super) spawns: usize,
}

#[inline]
pub(super) fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes(bytes.get(at..at + 2)?.try_into().ok()?))
}

#[inline]
pub(super) fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
}

#[inline]
pub(super) fn u64_at(bytes: &[u8], at: usize) -> Option<u64> {
    Some(u64::from_le_bytes(bytes.get(at..at + 8)?.try_into().ok()?))
}

// Inlining is forced where a triple returned through memory would be stored in parts and loaded as a whole, which stalls:
// measured, that doubles the cost of `PackedModel::bounds`.
impl<'a> PageView<'a> {
    #[inline]
    fn rows_of(&self, column: usize) -> usize {
        if column < TESTS { self.ops } else { self.ops - self.spawns }
    }

    #[inline(always)]
    fn value(&self, column: usize, row: usize) -> Option<u32> {
        let entry = u64_at(self.bytes, PAGE_HEADER + 8 * column)?;
        self.value_of(entry, self.rows_of(column), row)
    }

    /// A value of the column with this entry in the table.
    #[inline(always)]
    fn value_of(&self, entry: u64, rows: usize, row: usize) -> Option<u32> {
        let at = ((entry >> 32) as usize & 0xffff) * 8;
        let offset = match entry >> 48 {
            2 => u32::from(u16_at(self.bytes, at + 2 * row)?),
            3 => {
                let high = *self.bytes.get(at + align8(2 * rows) + row)?;
                u32::from(u16_at(self.bytes, at + 2 * row)?) | u32::from(high) << 16
            }
            0 => 0,
            1 => u32::from(*self.bytes.get(at + row)?),
            _ => u32_at(self.bytes, at + 4 * row)?,
        };
        Some((entry as u32).wrapping_add(offset))
    }

    /// Values of three columns, with one look at the table.
    #[inline(always)]
    fn triple(&self, column: usize, row: usize) -> Option<[i32; 3]> {
        let entries: &[u8; 24] = self.bytes.get(PAGE_HEADER + 8 * column..)?.first_chunk()?;
        let entries = [u64_at(entries, 0)?, u64_at(entries, 8)?, u64_at(entries, 16)?];
        let rows = self.rows_of(column);
        if entries.iter().all(|entry| entry >> 48 == 2) {
            // Nearly all pages of lattices up to 16 bits.
            let at = |k: usize| {
                let at = ((entries[k] >> 32) as usize & 0xffff) * 8;
                Some((entries[k] as u32).wrapping_add(u16_at(self.bytes, at + 2 * row)?.into()) as i32)
            };
            return Some([at(0)?, at(1)?, at(2)?]);
        }
        let at = |k: usize| self.value_of(entries[k], rows, row).map(|v| v as i32);
        Some([at(0)?, at(1)?, at(2)?])
    }

    #[inline(always)]
    pub(super) fn bounds(&self, row: usize) -> Option<Bounds> {
        // The columns after the centre have fixed widths, so their places follow from that of the first of them.
        let radius = usize::from(u16_at(self.bytes, PAGE_HEADER + 8 * column::RADIUS + 4)?) * 8;
        let (wide, narrow) = (align8(2 * self.ops), align8(self.ops));
        let fixed = self.bytes.get(radius..radius + 2 * wide + 3 * narrow)?;
        Some(Bounds {
            center: self.triple(column::CENTER, row)?,
            radius: Magnitude(u16_at(fixed, 2 * row)?),
            error: Magnitude(u16_at(fixed, wide + 2 * row)?),
            cone: Cone {
                axis: [*fixed.get(2 * wide + row)? as i8, *fixed.get(2 * wide + narrow + row)? as i8],
                half_angle: *fixed.get(2 * wide + 2 * narrow + row)?,
            },
        })
    }

    /// Tags; their width and base are fixed. Rows of splits count from the page's first split.
    #[inline]
    pub(super) fn tags(&self, row: usize) -> Option<u32> {
        let offset = u16_at(self.bytes, PAGE_HEADER + 8 * column::TAGS + 4)?;
        u16_at(self.bytes, usize::from(offset) * 8 + 2 * row).map(u32::from)
    }

    /// Next split of `s` and first split of `t`.
    #[inline(always)]
    pub(super) fn children(&self, row: usize) -> Option<[Option<u32>; 2]> {
        let tags = self.tags(row)?;
        let next = if tags & tag::HAS_NEXT_OF_S != 0 { Some(self.value(column::NEXT_OF_S, row)?) } else { None };
        let first = if tags & tag::HAS_FIRST_OF_T != 0 { Some(self.value(column::FIRST_OF_T, row)?) } else { None };
        Some([next, first])
    }

    /// Tree parent's kind (see [`tag`]) and number.
    #[inline(always)]
    pub(super) fn tree(&self, row: usize, tags: u32) -> Option<(u32, u32)> {
        Some((tags >> tag::TREE_SHIFT & 3, self.value(column::TREE, row)?))
    }

    #[inline(always)]
    pub(super) fn cut(&self, row: usize, tags: u32, column: usize) -> Option<CutRef> {
        let tags = if column == column::RIGHT { tags >> tag::RIGHT_SHIFT } else { tags };
        let edge = (tags >> 2 & 3) as u8;
        Some(match tags & 3 {
            tag::CUT_NONE => CutRef::None,
            tag::CUT_ROOT => CutRef::Root { face: self.value(column, row)?, edge },
            side => CutRef::Split { op: self.value(column, row)?, side: (side - tag::CUT_SPLIT_LEFT) as u8, edge },
        })
    }

    #[inline(always)]
    pub(super) fn position(&self, row: usize) -> Option<[i32; 3]> {
        self.triple(column::POSITION, row)
    }

    #[inline]
    pub(super) fn color(&self, row: usize, first_column: usize) -> Option<[u8; 3]> {
        Some(self.triple(first_column, row)?.map(|c| c as u8))
    }

    #[inline]
    pub(super) fn s_move(&self, row: usize, first_column: usize) -> Option<[i32; 3]> {
        self.triple(first_column, row)
    }

    /// The ops on neighbouring vertices, the op itself where there is none.
    #[inline]
    pub(super) fn vertex_ops(&self, row: usize, first_column: usize) -> Option<[u32; VERTEX_OPS]> {
        let mut ops = [0; VERTEX_OPS];
        for (column, op) in (first_column..).zip(&mut ops) {
            *op = self.value(column, row)?;
        }
        Some(ops)
    }

    fn column(&self, column: usize) -> Option<Column<'a>> {
        let rows = self.rows_of(column);
        let entry = u64_at(self.bytes, PAGE_HEADER + 8 * column)?;
        let at = ((entry >> 32) as usize & 0xffff) * 8;
        let slice = |at: usize, len: usize| self.bytes.get(at..at + len);
        let offsets = match entry >> 48 {
            0 => Offsets::Zero,
            1 => Offsets::U8(slice(at, rows)?),
            2 => Offsets::U16(bytemuck::try_cast_slice(slice(at, 2 * rows)?).ok()?),
            3 => {
                Offsets::U24(bytemuck::try_cast_slice(slice(at, 2 * rows)?).ok()?, slice(at + align8(2 * rows), rows)?)
            }
            _ => Offsets::U32(bytemuck::try_cast_slice(slice(at, 4 * rows)?).ok()?),
        };
        Some(Column { base: entry as u32, rows, offsets })
    }

    pub(super) fn tests(&self, first_op: u32) -> Option<TestPage<'a>> {
        let wide = |column| match self.column(column)?.offsets {
            Offsets::U16(v) => Some(v),
            _ => None,
        };
        let narrow = |column| match self.column(column)?.offsets {
            Offsets::U8(v) => Some(v),
            _ => None,
        };
        Some(TestPage {
            first_op,
            center: [self.column(column::CENTER)?, self.column(column::CENTER + 1)?, self.column(column::CENTER + 2)?],
            radius: wide(column::RADIUS)?,
            error: wide(column::ERROR)?,
            axis: [bytemuck::cast_slice(narrow(column::AXIS)?), bytemuck::cast_slice(narrow(column::AXIS + 1)?)],
            half_angle: narrow(column::HALF_ANGLE)?,
        })
    }

    /// Checks that the columns tile the page. O(columns).
    pub(super) fn check_structure(&self, context: &PageContext) -> Result<(), String> {
        let columns = context.columns();
        let header = PAGE_HEADER + 8 * columns;
        if self.bytes.len() < header {
            return Err(format!("{} bytes do not hold {columns} columns", self.bytes.len()));
        }
        let expected = self.ops as u64 | (columns as u64) << 16;
        if u64_at(self.bytes, 8) != Some(expected) {
            return Err(format!("not a page of {} ops and {columns} columns", self.ops));
        }
        let mut at = header;
        for column in 0..columns {
            let entry = u64_at(self.bytes, PAGE_HEADER + 8 * column).expect("the header is within the page");
            let (offset, width) = ((entry >> 32) as usize & 0xffff, entry >> 48);
            let width = u8::try_from(width).ok().filter(|&w| w <= 4);
            let Some(width) = width else { return Err(format!("column {column} has no width")) };
            if column::fixed_width(column).is_some_and(|fixed| fixed != width || entry as u32 != 0) {
                return Err(format!("column {column} has width {width} and base {}", entry as u32));
            }
            if offset * 8 != at {
                return Err(format!("column {column} is not where the one before it ends"));
            }
            at += column_bytes(width, self.rows_of(column));
        }
        if at != self.bytes.len() {
            return Err(format!("{} bytes, but the columns end at {at}", self.bytes.len()));
        }
        Ok(())
    }

    /// Checks every field against what it may refer to. O(ops).
    pub(super) fn check_fields(&self, context: &PageContext, first_op: u32) -> Result<(), String> {
        let changed = || "the bytes changed".to_string();
        for row in 0..self.ops {
            let bounds = self.bounds(row).ok_or_else(changed)?;
            if bounds.center.iter().any(|c| !(-MAX_CENTER..=MAX_CENTER).contains(c))
                || bounds.cone.axis.contains(&i8::MIN)
            {
                return Err(format!("the bounds of op {} are out of range", first_op + row as u32));
            }
        }
        for row in 0..self.ops - self.spawns {
            let op = first_op + (self.spawns + row) as u32;
            self.check_split(context, row, op).ok_or_else(changed)?.map_err(|what| format!("split {op}: {what}"))?;
        }
        Ok(())
    }

    fn check_split(&self, context: &PageContext, row: usize, op: u32) -> Option<Result<(), &'static str>> {
        let is_split = |id: u32| (context.spawns..context.ops).contains(&id);
        let tags = self.tags(row)?;
        if tags & !tag::ALL != 0 {
            return Some(Err("unknown tags"));
        }
        if self.children(row)?.into_iter().flatten().any(|child| child <= op || child >= context.ops) {
            return Some(Err("a child is out of range"));
        }
        let tree_fits = match self.tree(row, tags)? {
            (tag::TREE_ROOT, vertex) => vertex < context.root_vertices,
            (tag::TREE_KEPT | tag::TREE_INSERTED, parent) => is_split(parent) && parent < op,
            _ => false,
        };
        if !tree_fits {
            return Some(Err("the tree parent is out of range"));
        }
        let cuts = [self.cut(row, tags, column::LEFT)?, self.cut(row, tags, column::RIGHT)?];
        if cuts == [CutRef::None; 2] {
            return Some(Err("no cut"));
        }
        let empty_edges =
            [0, tag::RIGHT_SHIFT].map(|shift| tags >> shift & 3 == tag::CUT_NONE && tags >> shift & 12 != 0);
        let cut_fits = |cut: &CutRef| match *cut {
            CutRef::None => true,
            CutRef::Split { op: owner, edge, .. } => is_split(owner) && owner != op && edge < 3,
            CutRef::Root { face, edge } => face < context.root_faces && edge < 3,
        };
        if empty_edges.contains(&true) || !cuts.iter().all(cut_fits) {
            return Some(Err("a cut is out of range"));
        }
        let max = context.max_coordinate;
        if self.position(row)?.iter().any(|c| !(0..=max).contains(c)) {
            return Some(Err("the position is off the lattice"));
        }
        let byte = |c: &i32| (0..256).contains(c);
        if context.has_colors && !self.triple(column::colors(), row)?.iter().all(byte) {
            return Some(Err("the colour is out of range"));
        }
        if context.has_moves {
            let s_move = self.s_move(row, column::moves(context.has_colors))?;
            if s_move.iter().any(|d| !(-max..=max).contains(d)) {
                return Some(Err("the move is out of range"));
            }
            if context.has_colors && !self.triple(column::color_moves(), row)?.iter().all(byte) {
                return Some(Err("the colour move is out of range"));
            }
        }
        if context.by_vertices {
            let first = column::vertex_ops(context.has_colors, context.has_moves);
            if !self.vertex_ops(row, first)?.into_iter().all(is_split) {
                return Some(Err("an op on a neighbouring vertex is out of range"));
            }
        }
        Some(Ok(()))
    }
}
