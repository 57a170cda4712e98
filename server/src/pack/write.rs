//! Writing a pack: sections one after the other, then the header.

use std::error::Error;
use std::io::{self, Cursor, Seek, SeekFrom, Write};
use std::ops::Range;

use lodestream_protocol::limits::MAX_PATCH_ELEMENTS;
use rayon::prelude::*;
use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use super::hash::CompleteMesh;
use super::layout::{
    FLAG_COLORS, FLAG_MOVES, FLAG_OPEN, FLAG_VERTICES, FileHeader, MAGIC, MAX_METADATA_BYTES, ModelFields, PAGE_OPS,
    SECTION_REQUIRED, SPAWN_PAGE_HEADER, STEP_SHIFT, Section, SectionEntry, VERSION, tag,
};
use super::metadata::Metadata;
use super::outline::{Outline, SplitSource, WholeDag};
use super::page::{PageBuilder, PageContext, PageView, seal};
use super::record::{Bounds, CutRef, Dag, NO_OP, SplitRecord, VERTEX_OPS};
use super::spawns::{PatchArrays, put_patches, spawns_of_page};

/// Pages that are encoded before they are written: some megabytes.
const PAGES_AT_ONCE: u32 = 512;

/// Why no pack was written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WriteError {
    /// The records contradict each other or do not fit the format: a bug of the builder.
    #[error("the model cannot be packed: {0}")]
    Invalid(String),
    /// The bytes could not be written.
    #[error("cannot write the pack")]
    Io(#[from] io::Error),
    /// The splits could not be had, for example from temporary data.
    #[error(transparent)]
    Source(Box<dyn Error + Send + Sync>),
}

pub(super) fn invalid(reason: impl Into<String>) -> WriteError {
    WriteError::Invalid(reason.into())
}

/// Writes `dag` and returns the length of the pack. The same arguments give the same bytes, on any number of threads.
///
/// `complete` describes the cleaned input on its lattice, before simplification. `out` is left at the end of the pack and
/// should be buffered. Pages are encoded in the caller's pool of threads.
///
/// # Errors
/// [`WriteError::Invalid`] for everything that a reader would refuse at a page's first use; what only a replay can tell is
/// left to [`verify`](fn@super::verify).
pub fn write(
    dag: &Dag,
    complete: &CompleteMesh,
    metadata: &Metadata,
    out: &mut (impl Write + Seek),
) -> Result<u64, WriteError> {
    write_splits(&Outline::of(dag)?, &mut WholeDag::new(dag), complete, metadata, out, &mut |_| {})
}

/// [`write`](fn@write) for a model whose splits are nowhere together. Holds some pages besides the outline, a stretch of
/// splits and the directory (8 bytes per 256 ops). `progress` hears the share of the ops that is written.
///
/// # Errors
/// As there, and what the source says.
pub(crate) fn write_splits(
    outline: &Outline,
    splits: &mut impl SplitSource,
    complete: &CompleteMesh,
    metadata: &Metadata,
    out: &mut (impl Write + Seek),
    progress: &mut dyn FnMut(f32),
) -> Result<u64, WriteError> {
    let context = check(outline, complete)?;
    metadata.check().map_err(invalid)?;
    let optional = usize::from(metadata.leaves_room_for_thumbnail);
    let mut sections = Sections::begin(out, Section::REQUIRED.len() + optional)?;

    sections.put(Section::Model, bytemuck::bytes_of(&model_fields(outline, complete, &context)))?;
    let json = serde_json::to_vec(metadata).map_err(|e| invalid(e.to_string()))?;
    if json.len() as u64 > MAX_METADATA_BYTES {
        return Err(invalid("the metadata are too long"));
    }
    sections.put(Section::Metadata, &json)?;
    sections.put(Section::Base, &patch_section(outline, None, &context)?)?;
    sections.put(Section::SpawnTable, bytemuck::cast_slice(&outline.starts))?;

    let mut pages = PageStream::default();
    for page in 0..context.spawns.div_ceil(PAGE_OPS) {
        let mut bytes = patch_section(outline, Some(spawns_of_page(page, context.spawns)), &context)?;
        seal(&mut bytes, page);
        pages.put(sections.out, &bytes)?;
    }
    sections.end_pages(pages, Section::SpawnPages, Section::SpawnDirectory)?;

    let mut pages = PageStream::default();
    let count = context.ops.div_ceil(PAGE_OPS);
    put_op_pages(outline, &context, splits, &mut |page, bytes| {
        if page % PAGES_AT_ONCE == 0 {
            progress(page as f32 / count as f32);
        }
        pages.put(sections.out, bytes)
    })?;
    sections.end_pages(pages, Section::OpPages, Section::OpDirectory)?;
    if metadata.leaves_room_for_thumbnail {
        sections.put(Section::Thumbnail, &[])?;
    }
    sections.finish()
}

/// [`write`](fn@write) into memory.
///
/// # Errors
/// As there.
pub fn write_to_vec(dag: &Dag, complete: &CompleteMesh, metadata: &Metadata) -> Result<Vec<u8>, WriteError> {
    let mut out = Cursor::new(Vec::new());
    write(dag, complete, metadata, &mut out)?;
    Ok(out.into_inner())
}

/// Checks what the encoded form cannot express, all but the splits.
fn check(outline: &Outline, complete: &CompleteMesh) -> Result<PageContext, WriteError> {
    let spawns = u32::try_from(outline.spawns.len()).map_err(|_| invalid("too many spawns"))?;
    let ops = spawns.checked_add(outline.splits).filter(|&n| n != NO_OP);
    let ops = ops.ok_or_else(|| invalid("too many ops"))?;
    if !outline.lattice.is_valid() {
        return Err(invalid("no lattice"));
    }
    for i in 0..=outline.spawns.len() {
        let (vertices, faces) = outline.patch(i.checked_sub(1).map(|spawn| spawn as u32));
        if vertices.len().max(faces.len()) > MAX_PATCH_ELEMENTS as usize || i > 0 && faces.is_empty() {
            return Err(invalid(format!("patch {i} is empty or too large")));
        }
        if outline.faces[faces].iter().flatten().any(|&v| v as usize >= vertices.len()) {
            return Err(invalid(format!("a corner of patch {i} is out of range")));
        }
        if !outline.has_colors && outline.colors[vertices].iter().any(|&c| c != [0; 3]) {
            return Err(invalid(format!("patch {i} has colours, the model has none")));
        }
    }
    if let Some(i) = outline.spawns.windows(2).position(|w| w[0].error < w[1].error) {
        return Err(invalid(format!("spawn {} has a larger error than the one before it", i + 1)));
    }
    let max = outline.lattice.max_coordinate();
    if complete.box_min.iter().chain(&complete.box_max).any(|c| !(0..=max).contains(c)) {
        return Err(invalid("the box is off the lattice"));
    }
    let narrow = |n: usize| u32::try_from(n).map_err(|_| invalid("too many root elements"));
    Ok(PageContext {
        ops,
        spawns,
        root_vertices: narrow(outline.positions.len())?,
        root_faces: narrow(outline.faces.len())?,
        max_coordinate: max,
        has_colors: outline.has_colors,
        has_moves: outline.has_moves,
        by_vertices: outline.by_vertices,
    })
}

/// What of a split the encoded form cannot express. A tree parent that is no split is stored as the root vertex alone: the
/// two must agree.
fn check_split(split: &SplitRecord, outline: &Outline) -> Result<(), &'static str> {
    let (parent, starts) = (split.tree_parent, &outline.starts);
    let fits = if parent == NO_OP {
        split.s < starts[0].vertex
    } else if (parent as usize) < outline.spawns.len() {
        (starts[parent as usize].vertex..starts[parent as usize + 1].vertex).contains(&split.s)
    } else {
        split.s < 2
    };
    if !fits {
        return Err("`s` does not fit the tree parent");
    }
    if !outline.has_colors && (split.color != [0; 3] || split.s_color_move != [0; 3]) {
        return Err("it has a colour, the model has none");
    }
    if !outline.has_moves && (split.s_move != [0; 3] || split.s_color_move != [0; 3]) {
        return Err("it moves `s`, the model has no moves");
    }
    if !outline.by_vertices && split.vertex_ops != [NO_OP; VERTEX_OPS] {
        return Err("it waits for vertices, the model depends by faces");
    }
    Ok(())
}

fn model_fields(outline: &Outline, complete: &CompleteMesh, context: &PageContext) -> ModelFields {
    let flag = |on: bool, flag: u32| if on { flag } else { 0 };
    ModelFields {
        origin: outline.lattice.origin,
        step: outline.lattice.step,
        bits: outline.lattice.bits.into(),
        flags: flag(context.has_colors, FLAG_COLORS)
            | flag(context.has_moves, FLAG_MOVES)
            | flag(outline.is_open, FLAG_OPEN)
            | flag(outline.by_vertices, FLAG_VERTICES)
            | complete.visual_step.map_or(0, |step| u32::from(step.get()) << STEP_SHIFT),
        box_min: complete.box_min,
        box_max: complete.box_max,
        hash: complete.hash.0,
        vertices: complete.vertices,
        triangles: complete.triangles,
        spawns: context.spawns,
        ops: context.ops,
        base_vertices: outline.starts[0].vertex,
        base_faces: outline.starts[0].face,
    }
}

/// Arrays of the patches of some spawns after a page's header, or of the base without one; checked as a reader does.
fn patch_section(outline: &Outline, spawns: Option<Range<u32>>, context: &PageContext) -> Result<Vec<u8>, WriteError> {
    let header = if spawns.is_some() { SPAWN_PAGE_HEADER } else { 0 };
    let (vertices, faces) = match spawns {
        Some(spawns) => outline.patches(spawns),
        None => outline.patch(None),
    };
    let mut bytes = vec![0; header];
    let numbers = (vertices.len() as u32, faces.len() as u32);
    put_patches(outline, vertices, faces, &mut bytes);
    let arrays = PatchArrays::new(&bytes[header..], numbers.0, numbers.1, context.has_colors);
    let arrays = arrays.expect("the arrays were written with these numbers");
    arrays.check(context.max_coordinate, &(context.spawns..context.ops)).map_err(invalid)?;
    Ok(bytes)
}

/// Encodes all op pages, some at once, and hands them on in order.
fn put_op_pages(
    outline: &Outline,
    context: &PageContext,
    source: &mut impl SplitSource,
    put: &mut impl FnMut(u32, &[u8]) -> Result<(), WriteError>,
) -> Result<(), WriteError> {
    let splits_of = |page: u32| {
        let (first, ops, _) = context.rows(page);
        first.saturating_sub(context.spawns)..(first + ops as u32).saturating_sub(context.spawns)
    };
    let pages = context.ops.div_ceil(PAGE_OPS);
    let mut page = 0;
    let mut stretch = 0..0;
    while page < pages {
        let mut end = page;
        while end < pages && end - page < PAGES_AT_ONCE && splits_of(end).end <= stretch.end {
            end += 1;
        }
        if end == page {
            if splits_of(page).start != stretch.end {
                return Err(invalid(format!("a stretch of splits ends within page {page}")));
            }
            let more = source.advance()?;
            if more == 0 {
                return Err(invalid(format!("there are {} of {} splits", stretch.end, outline.splits)));
            }
            stretch = stretch.end..stretch.end.checked_add(more).ok_or_else(|| invalid("too many splits"))?;
            continue;
        }
        let ready = &*source;
        let encoded: Vec<Result<Vec<u8>, WriteError>> = (page..end)
            .into_par_iter()
            .map_init(Vec::new, |splits, page| {
                let range = splits_of(page);
                splits.clear();
                ready.read(range.start - stretch.start..range.end - stretch.start, splits);
                op_page(outline, context, page, splits)
            })
            .collect();
        for (page, bytes) in (page..end).zip(encoded) {
            put(page, &bytes?)?;
        }
        page = end;
    }
    Ok(())
}

/// One page of ops, checked as a reader does.
fn op_page(outline: &Outline, context: &PageContext, page: u32, splits: &[SplitRecord]) -> Result<Vec<u8>, WriteError> {
    let (first, ops, spawns) = context.rows(page);
    let begin = first.saturating_sub(context.spawns);
    for (i, split) in (begin..).zip(splits) {
        check_split(split, outline).map_err(|e| invalid(format!("split {i}: {e}")))?;
    }
    let mut builder = PageBuilder::new(ops, context.columns());
    let own_spawns: &[Bounds] = if spawns > 0 { &outline.spawns[first as usize..][..spawns] } else { &[] };
    let tests = own_spawns.iter().chain(splits.iter().map(|split| &split.bounds));
    for k in 0..3 {
        builder.push(tests.clone().map(|b| b.center[k].into()));
    }
    builder.push(tests.clone().map(|b| b.radius.0.into()));
    builder.push(tests.clone().map(|b| b.error.0.into()));
    for k in 0..2 {
        builder.push(tests.clone().map(|b| (b.cone.axis[k] as u8).into()));
    }
    builder.push(tests.map(|b| b.cone.half_angle.into()));

    builder.push(splits.iter().map(|s| tags(s, context.spawns).into()));
    builder.push(or_smallest(splits.iter().map(|s| Some(s.next_of_s).filter(|&c| c != NO_OP)).collect()));
    builder.push(or_smallest(splits.iter().map(|s| Some(s.first_of_t).filter(|&c| c != NO_OP)).collect()));
    let is_root = |s: &SplitRecord| s.tree_parent == NO_OP || s.tree_parent < context.spawns;
    builder.push(splits.iter().map(|s| if is_root(s) { s.s } else { s.tree_parent }.into()));
    builder.push(or_smallest(splits.iter().map(|s| cut_target(s.left)).collect()));
    builder.push(or_smallest(splits.iter().map(|s| cut_target(s.right)).collect()));
    for k in 0..3 {
        builder.push(splits.iter().map(|s| s.position[k].into()));
    }
    if context.has_colors {
        (0..3).for_each(|k| builder.push(splits.iter().map(|s| s.color[k].into())));
    }
    if context.has_moves {
        (0..3).for_each(|k| builder.push(splits.iter().map(|s| s.s_move[k].into())));
        if context.has_colors {
            (0..3).for_each(|k| builder.push(splits.iter().map(|s| s.s_color_move[k].into())));
        }
    }
    if context.by_vertices {
        let first_id = context.spawns + begin;
        for k in 0..VERTEX_OPS {
            let ops =
                (first_id..).zip(splits).map(|(id, s)| if s.vertex_ops[k] == NO_OP { id } else { s.vertex_ops[k] });
            builder.push(ops.map(i64::from));
        }
    }
    let bytes = builder.finish(page);
    let view = PageView { bytes: &bytes, ops, spawns };
    view.check_structure(context).map_err(invalid)?;
    view.check_fields(context, first).map_err(invalid)?;
    Ok(bytes)
}

/// Values where there are any; elsewhere the smallest, so that gaps widen no column.
fn or_smallest(values: Vec<Option<u32>>) -> impl Iterator<Item = i64> + Clone {
    let smallest = values.iter().flatten().min().copied().unwrap_or(0);
    values.into_iter().map(move |v| v.unwrap_or(smallest).into())
}

fn cut_target(cut: CutRef) -> Option<u32> {
    match cut {
        CutRef::None => None,
        CutRef::Split { op, .. } => Some(op),
        CutRef::Root { face, .. } => Some(face),
    }
}

fn tags(split: &SplitRecord, spawns: u32) -> u16 {
    // An edge or side that does not fit its bits gives tags that the check of the page refuses.
    let cut = |cut: CutRef| match cut {
        CutRef::None => tag::CUT_NONE,
        CutRef::Split { side: 0, edge, .. } => tag::CUT_SPLIT_LEFT | u32::from(edge.min(3)) << 2,
        CutRef::Split { side: 1, edge, .. } => tag::CUT_SPLIT_RIGHT | u32::from(edge.min(3)) << 2,
        CutRef::Split { .. } => u32::MAX,
        CutRef::Root { edge, .. } => tag::CUT_ROOT | u32::from(edge.min(3)) << 2,
    };
    let tree = match split.tree_parent {
        NO_OP => tag::TREE_ROOT,
        parent if parent < spawns => tag::TREE_ROOT,
        _ if split.s == 0 => tag::TREE_KEPT,
        _ => tag::TREE_INSERTED,
    };
    let child = |child: u32, flag: u32| if child == NO_OP { 0 } else { flag };
    let tags = cut(split.left)
        | cut(split.right) << tag::RIGHT_SHIFT
        | tree << tag::TREE_SHIFT
        | child(split.next_of_s, tag::HAS_NEXT_OF_S)
        | child(split.first_of_t, tag::HAS_FIRST_OF_T);
    tags as u16
}

/// Writes sections and keeps the table of them.
struct Sections<'a, W> {
    out: &'a mut W,
    /// Where the pack begins in `out`.
    begin: u64,
    at: u64,
    entries: Vec<SectionEntry>,
}

impl<'a, W: Write + Seek> Sections<'a, W> {
    fn begin(out: &'a mut W, count: usize) -> Result<Self, WriteError> {
        let begin = out.stream_position()?;
        let at = size_of::<FileHeader>() + count * size_of::<SectionEntry>();
        out.write_all(&vec![0; at])?;
        Ok(Self { out, begin, at: at as u64, entries: Vec::new() })
    }

    fn put(&mut self, section: Section, bytes: &[u8]) -> Result<(), WriteError> {
        self.out.write_all(bytes)?;
        self.close(section, bytes.len() as u64, xxh3_64(bytes))
    }

    /// Enters a section whose bytes were just written, and fills up the grid.
    fn close(&mut self, section: Section, bytes: u64, checksum: u64) -> Result<(), WriteError> {
        self.entries.push(SectionEntry {
            kind: section as u32,
            flags: if Section::REQUIRED.contains(&section) { SECTION_REQUIRED } else { 0 },
            offset: self.at,
            bytes,
            checksum,
        });
        let padding = bytes.next_multiple_of(8) - bytes;
        self.out.write_all(&[0; 8][..padding as usize])?;
        self.at += bytes + padding;
        Ok(())
    }

    /// Enters the pages that were written into `out` since the last section, and their directory.
    fn end_pages(&mut self, pages: PageStream, section: Section, directory: Section) -> Result<(), WriteError> {
        let bytes = pages.offsets.last().copied().unwrap_or_default();
        self.close(section, bytes, pages.hasher.digest())?;
        self.put(directory, bytemuck::cast_slice(&pages.offsets))
    }

    fn finish(self) -> Result<u64, WriteError> {
        let sections = self.entries.len() as u32;
        let mut header = FileHeader { magic: MAGIC, version: VERSION, sections, file_bytes: self.at, checksum: 0 };
        let table: &[u8] = bytemuck::cast_slice(&self.entries);
        header.checksum = xxh3_64(&[bytemuck::bytes_of(&header), table].concat());
        self.out.seek(SeekFrom::Start(self.begin))?;
        self.out.write_all(bytemuck::bytes_of(&header))?;
        self.out.write_all(table)?;
        self.out.seek(SeekFrom::Start(self.begin + self.at))?;
        Ok(self.at)
    }
}

/// Pages on their way into a section.
struct PageStream {
    /// Where each page begins, and where the next one will.
    offsets: Vec<u64>,
    hasher: Xxh3,
}

impl Default for PageStream {
    fn default() -> Self {
        Self { offsets: vec![0], hasher: Xxh3::new() }
    }
}

impl PageStream {
    fn put(&mut self, out: &mut impl Write, page: &[u8]) -> Result<(), WriteError> {
        out.write_all(page)?;
        self.hasher.update(page);
        self.offsets.push(self.offsets[self.offsets.len() - 1] + page.len() as u64);
        Ok(())
    }
}
