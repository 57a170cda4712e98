//! Writing a pack: sections one after the other, then the header.

use std::io::{self, Cursor, Seek, SeekFrom, Write};

use lodestream_protocol::limits::MAX_PATCH_ELEMENTS;
use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use super::hash::CompleteMesh;
use super::layout::{
    FLAG_COLORS, FLAG_MOVES, FLAG_OPEN, FileHeader, MAGIC, MAX_METADATA_BYTES, ModelFields, PAGE_OPS, SECTION_REQUIRED,
    SPAWN_PAGE_HEADER, Section, SectionEntry, SpawnEntry, VERSION, tag,
};
use super::metadata::Metadata;
use super::page::{PageBuilder, PageContext, PageView, seal};
use super::record::{Bounds, CutRef, Dag, NO_OP, Patch, SplitRecord};
use super::spawns::{PatchArrays, put_patches, spawns_of_page};

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
}

fn invalid(reason: impl Into<String>) -> WriteError {
    WriteError::Invalid(reason.into())
}

/// Writes `dag` and returns the length of the pack. The same arguments give the same bytes.
///
/// `complete` describes the cleaned input on its lattice, before simplification. Holds one page in memory besides the
/// directory (8 bytes per 256 ops); `out` is left at the end of the pack and should be buffered.
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
    let context = check(dag, complete)?;
    metadata.check().map_err(invalid)?;
    let mut sections = Sections::begin(out)?;

    sections.put(Section::Model, bytemuck::bytes_of(&model_fields(dag, complete, &context)))?;
    let json = serde_json::to_vec(metadata).map_err(|e| invalid(e.to_string()))?;
    if json.len() as u64 > MAX_METADATA_BYTES {
        return Err(invalid("the metadata are too long"));
    }
    sections.put(Section::Metadata, &json)?;
    sections.put(Section::Base, &patch_section(&[&dag.base], &context, 0)?)?;
    sections.put(Section::SpawnTable, bytemuck::cast_slice(&spawn_table(dag)))?;

    let spawn_page = |page: u32| {
        let range = spawns_of_page(page, context.spawns);
        let patches: Vec<&Patch> = range.map(|i| &dag.spawns[i as usize].patch).collect();
        let mut bytes = patch_section(&patches, &context, SPAWN_PAGE_HEADER)?;
        seal(&mut bytes, page);
        Ok(bytes)
    };
    sections.put_pages(Section::SpawnPages, Section::SpawnDirectory, context.spawns, spawn_page)?;
    sections.put_pages(Section::OpPages, Section::OpDirectory, context.ops, |page| op_page(dag, &context, page))?;
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

/// Checks what the encoded form cannot express.
fn check(dag: &Dag, complete: &CompleteMesh) -> Result<PageContext, WriteError> {
    let spawns = u32::try_from(dag.spawns.len()).map_err(|_| invalid("too many spawns"))?;
    let ops = u32::try_from(dag.spawns.len() + dag.splits.len()).ok().filter(|&n| n != NO_OP);
    let ops = ops.ok_or_else(|| invalid("too many ops"))?;
    if !dag.lattice.is_valid() {
        return Err(invalid("no lattice"));
    }
    let (mut root_vertices, mut root_faces) = (0u64, 0u64);
    for (i, patch) in std::iter::once(&dag.base).chain(dag.spawns.iter().map(|s| &s.patch)).enumerate() {
        let vertices = patch.positions.len();
        if patch.colors.len() != vertices || patch.first_splits.len() != vertices {
            return Err(invalid(format!("patch {i} has arrays of different lengths")));
        }
        if vertices.max(patch.faces.len()) > MAX_PATCH_ELEMENTS as usize || i > 0 && patch.faces.is_empty() {
            return Err(invalid(format!("patch {i} is empty or too large")));
        }
        if patch.faces.iter().flatten().any(|&v| v as usize >= vertices) {
            return Err(invalid(format!("a corner of patch {i} is out of range")));
        }
        if !dag.has_colors && patch.colors.iter().any(|&c| c != [0; 3]) {
            return Err(invalid(format!("patch {i} has colours, the model has none")));
        }
        root_vertices += vertices as u64;
        root_faces += patch.faces.len() as u64;
    }
    if let Some(i) = dag.spawns.windows(2).position(|w| w[0].bounds.error < w[1].bounds.error) {
        return Err(invalid(format!("spawn {} has a larger error than the one before it", i + 1)));
    }
    let starts = spawn_table(dag);
    for (i, split) in dag.splits.iter().enumerate() {
        check_tree(split, spawns, dag.base.positions.len(), &starts).map_err(|e| invalid(format!("split {i}: {e}")))?;
        if !dag.has_colors && (split.color != [0; 3] || split.s_color_move != [0; 3]) {
            return Err(invalid(format!("split {i} has a colour, the model has none")));
        }
    }
    let max = dag.lattice.max_coordinate();
    if complete.box_min.iter().chain(&complete.box_max).any(|c| !(0..=max).contains(c)) {
        return Err(invalid("the box is off the lattice"));
    }
    let narrow = |n: u64| u32::try_from(n).map_err(|_| invalid("too many root elements"));
    Ok(PageContext {
        ops,
        spawns,
        root_vertices: narrow(root_vertices)?,
        root_faces: narrow(root_faces)?,
        max_coordinate: max,
        has_colors: dag.has_colors,
        has_moves: dag.splits.iter().any(|s| s.s_move != [0; 3] || s.s_color_move != [0; 3]),
    })
}

/// A tree parent that is no split is stored as the root vertex alone: the two must agree.
fn check_tree(split: &SplitRecord, spawns: u32, base: usize, starts: &[SpawnEntry]) -> Result<(), &'static str> {
    let parent = split.tree_parent;
    let fits = if parent == NO_OP {
        (split.s as usize) < base
    } else if parent < spawns {
        (starts[parent as usize].vertex..starts[parent as usize + 1].vertex).contains(&split.s)
    } else {
        split.s < 2
    };
    if fits { Ok(()) } else { Err("`s` does not fit the tree parent") }
}

fn spawn_table(dag: &Dag) -> Vec<SpawnEntry> {
    let mut at = SpawnEntry { vertex: dag.base.positions.len() as u32, face: dag.base.faces.len() as u32 };
    let mut table = vec![at];
    for spawn in &dag.spawns {
        // Overflow is refused by `check`, which counts in 64 bits.
        at.vertex = at.vertex.wrapping_add(spawn.patch.positions.len() as u32);
        at.face = at.face.wrapping_add(spawn.patch.faces.len() as u32);
        table.push(at);
    }
    table
}

fn model_fields(dag: &Dag, complete: &CompleteMesh, context: &PageContext) -> ModelFields {
    let flag = |on: bool, flag: u32| if on { flag } else { 0 };
    ModelFields {
        origin: dag.lattice.origin,
        step: dag.lattice.step,
        bits: dag.lattice.bits.into(),
        flags: flag(context.has_colors, FLAG_COLORS)
            | flag(context.has_moves, FLAG_MOVES)
            | flag(dag.is_open, FLAG_OPEN),
        box_min: complete.box_min,
        box_max: complete.box_max,
        hash: complete.hash.0,
        vertices: complete.vertices,
        triangles: complete.triangles,
        spawns: context.spawns,
        ops: context.ops,
        base_vertices: dag.base.positions.len() as u32,
        base_faces: dag.base.faces.len() as u32,
    }
}

/// Arrays of patches after so many bytes of header, checked as a reader does.
fn patch_section(patches: &[&Patch], context: &PageContext, header: usize) -> Result<Vec<u8>, WriteError> {
    let mut bytes = vec![0; header];
    put_patches(patches, context.has_colors, &mut bytes);
    let vertices = patches.iter().map(|p| p.positions.len() as u32).sum();
    let faces = patches.iter().map(|p| p.faces.len() as u32).sum();
    let arrays = PatchArrays::new(&bytes[header..], vertices, faces, context.has_colors);
    let arrays = arrays.expect("the arrays were written with these numbers");
    arrays.check(context.max_coordinate, &(context.spawns..context.ops)).map_err(invalid)?;
    Ok(bytes)
}

/// One page of ops, checked as a reader does.
fn op_page(dag: &Dag, context: &PageContext, page: u32) -> Result<Vec<u8>, WriteError> {
    let (first, ops, spawns) = context.rows(page);
    let mut builder = PageBuilder::new(ops, context.columns());
    let bounds = |op: u32| -> &Bounds {
        match op.checked_sub(context.spawns) {
            Some(split) => &dag.splits[split as usize].bounds,
            None => &dag.spawns[op as usize].bounds,
        }
    };
    let tests = (first..first + ops as u32).map(bounds);
    for k in 0..3 {
        builder.push(tests.clone().map(|b| b.center[k].into()));
    }
    builder.push(tests.clone().map(|b| b.radius.0.into()));
    builder.push(tests.clone().map(|b| b.error.0.into()));
    for k in 0..2 {
        builder.push(tests.clone().map(|b| (b.cone.axis[k] as u8).into()));
    }
    builder.push(tests.map(|b| b.cone.half_angle.into()));

    let begin = (first + spawns as u32 - context.spawns.min(first + spawns as u32)) as usize;
    let splits = &dag.splits[begin..begin + ops - spawns];
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
    fn begin(out: &'a mut W) -> Result<Self, WriteError> {
        let begin = out.stream_position()?;
        let at = size_of::<FileHeader>() + Section::ALL.len() * size_of::<SectionEntry>();
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
            flags: SECTION_REQUIRED,
            offset: self.at,
            bytes,
            checksum,
        });
        let padding = bytes.next_multiple_of(8) - bytes;
        self.out.write_all(&[0; 8][..padding as usize])?;
        self.at += bytes + padding;
        Ok(())
    }

    fn put_pages(
        &mut self,
        section: Section,
        directory: Section,
        items: u32,
        mut page: impl FnMut(u32) -> Result<Vec<u8>, WriteError>,
    ) -> Result<(), WriteError> {
        let mut offsets = vec![0u64];
        let mut bytes = 0;
        let mut hasher = Xxh3::new();
        for number in 0..items.div_ceil(PAGE_OPS) {
            let page = page(number)?;
            self.out.write_all(&page)?;
            hasher.update(&page);
            bytes += page.len() as u64;
            offsets.push(bytes);
        }
        self.close(section, bytes, hasher.digest())?;
        self.put(directory, bytemuck::cast_slice(&offsets))
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
