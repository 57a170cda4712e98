//! Reading a pack in place.

use std::fmt;
use std::ops::Range;
use std::sync::{Arc, OnceLock};

use lodestream_protocol::ids::ModelHash;
use lodestream_protocol::limits::MAX_PATCH_ELEMENTS;
use lodestream_protocol::mesh::Patch;
use lodestream_protocol::message::ModelInfo;
use lodestream_protocol::quant::Lattice;
use xxhash_rust::xxh3::xxh3_64;

use super::layout::{
    FLAG_COLORS, FLAG_MOVES, FLAG_OPEN, FileHeader, HEADER_NAME, MAGIC, MAX_METADATA_BYTES, MAX_SECTIONS, ModelFields,
    PAGE_SHIFT, SECTION_REQUIRED, SPAWN_PAGE_HEADER, Section, SectionEntry, SpawnEntry, UNKNOWN_NAME, VERSION, align8,
    column, tag,
};
use super::page::{PageContext, PageView, TestPage};
use super::pages::Pages;
use super::record::{Bounds, CutRef, NO_OP};
use super::spawns::{PatchArrays, SpawnTable, spawn_page_bytes, spawns_of_page};
use super::{Metadata, PackBytes, PackError, damaged};

/// The fixed fields of a split that the session needs to apply it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SplitFields {
    /// See [`record::SplitRecord::tree_parent`](super::record::SplitRecord::tree_parent).
    pub tree_parent: u32,
    /// See [`record::SplitRecord::s`](super::record::SplitRecord::s).
    pub s: u32,
    /// Left cut edge.
    pub left: CutRef,
    /// Right cut edge.
    pub right: CutRef,
    /// Position of the inserted vertex.
    pub position: [i32; 3],
    /// Its colour.
    pub color: [u8; 3],
    /// Displacement of `s`.
    pub s_move: [i32; 3],
    /// Colour change of `s`.
    pub s_color_move: [u8; 3],
}

/// A pack whose header, tables and base were checked; pages are checked at first use.
///
/// Shared by all sessions of a model: reads take no lock. After the first use of a page (some microseconds) an access costs
/// about ten nanoseconds. Ids in range, children larger than their op and tree parents smaller are guaranteed for every
/// answer. *Not* guaranteed for a hostile pack, because only a replay tells: that cut owners form no cycle, that children and
/// tree parents agree, and that cuts fit. Callers bound their walks and check what the replica answers.
pub struct PackedModel {
    bytes: PackBytes,
    info: ModelInfo,
    metadata: Metadata,
    base: Patch,
    base_first_splits: Vec<u32>,
    context: PageContext,
    sections: Vec<(Option<Section>, SectionEntry)>,
    spawn_table: Range<usize>,
    spawn_pages: Pages,
    op_pages: Pages,
    first_damage: OnceLock<PackError>,
}

impl fmt::Debug for PackedModel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PackedModel").field("info", &self.info).field("ops", &self.context.ops).finish_non_exhaustive()
    }
}

/// Bytes on an 8-byte boundary, for owners that cannot promise one.
struct Aligned {
    words: Vec<u64>,
    len: usize,
}

impl AsRef<[u8]> for Aligned {
    fn as_ref(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.words)[..self.len]
    }
}

impl Aligned {
    fn copy_of(bytes: &[u8]) -> Self {
        let mut words = vec![0u64; bytes.len().div_ceil(8)];
        bytemuck::cast_slice_mut(&mut words)[..bytes.len()].copy_from_slice(bytes);
        Self { words, len: bytes.len() }
    }
}

impl PackedModel {
    /// Checks header, tables, metadata and base. Costs the same for any number of splits (a bit of memory per page, a few
    /// nanoseconds per spawn). Bytes that do not begin on an 8-byte boundary are copied.
    ///
    /// # Errors
    /// [`PackError`] names the section at fault.
    pub fn open(bytes: PackBytes) -> Result<Self, PackError> {
        if (*bytes).as_ref().as_ptr().align_offset(8) != 0 {
            let copy = Aligned::copy_of((*bytes).as_ref());
            return Self::open_aligned(Arc::new(copy));
        }
        Self::open_aligned(bytes)
    }

    /// [`PackedModel::open`] on bytes in memory.
    ///
    /// # Errors
    /// As there.
    pub fn from_vec(bytes: Vec<u8>) -> Result<Self, PackError> {
        Self::open(Arc::new(bytes))
    }

    fn open_aligned(owner: PackBytes) -> Result<Self, PackError> {
        let file = (*owner).as_ref();
        let sections = read_table(file)?;
        let range = |section: Section| -> Result<Range<usize>, PackError> {
            let found = sections.iter().find(|(kind, _)| *kind == Some(section));
            let (_, entry) = found.ok_or_else(|| damaged(section, "it is missing"))?;
            Ok(entry.offset as usize..(entry.offset + entry.bytes) as usize)
        };
        for section in [Section::Model, Section::Metadata, Section::Base, Section::SpawnTable] {
            let range = range(section)?;
            let limit = if section == Section::Metadata { MAX_METADATA_BYTES } else { u64::MAX };
            if range.len() as u64 > limit {
                return Err(damaged(section, "it is too long"));
            }
        }
        for (kind, entry) in &sections {
            if let Some(section @ (Section::Model | Section::Metadata | Section::Base | Section::SpawnTable)) = kind {
                check_section(file, *section, entry)?;
            }
        }

        let (fields, lattice) = read_model(&file[range(Section::Model)?])?;
        let metadata = &file[range(Section::Metadata)?];
        let refuse = |reason: String| damaged(Section::Metadata, reason);
        let metadata: Metadata = serde_json::from_slice(metadata).map_err(|e| refuse(e.to_string()))?;
        metadata.check().map_err(|reason| refuse(reason.into()))?;

        let base_end = SpawnEntry { vertex: fields.base_vertices, face: fields.base_faces };
        let spawn_table = range(Section::SpawnTable)?;
        let table = SpawnTable::new(&file[spawn_table.clone()]);
        table.check(fields.spawns, base_end).map_err(|reason| damaged(Section::SpawnTable, reason))?;
        let roots = table.entry(fields.spawns).expect("the table has one entry more than spawns");
        let context = PageContext {
            ops: fields.ops,
            spawns: fields.spawns,
            root_vertices: roots.vertex,
            root_faces: roots.face,
            max_coordinate: lattice.max_coordinate(),
            has_colors: fields.flags & FLAG_COLORS != 0,
            has_moves: fields.flags & FLAG_MOVES != 0,
        };
        let (base, base_first_splits) = read_base(&file[range(Section::Base)?], base_end, &context)?;

        let pages =
            |section, directory, items| Pages::new(section, range(section)?, range(directory)?, directory, items);
        let spawn_pages = pages(Section::SpawnPages, Section::SpawnDirectory, fields.spawns)?;
        let op_pages = pages(Section::OpPages, Section::OpDirectory, fields.ops)?;
        let info = ModelInfo {
            hash: ModelHash(fields.hash),
            title: metadata.title.clone(),
            lattice,
            box_min: fields.box_min,
            box_max: fields.box_max,
            has_colors: context.has_colors,
            has_moves: context.has_moves,
            is_open: fields.flags & FLAG_OPEN != 0,
            triangles: fields.triangles,
            vertices: fields.vertices,
            smallest_limit: fields.base_faces,
            crease_angle_deg: metadata.crease_angle_deg,
        };
        Ok(Self {
            info,
            metadata,
            base,
            base_first_splits,
            context,
            spawn_table,
            spawn_pages,
            op_pages,
            first_damage: OnceLock::new(),
            sections,
            bytes: owner,
        })
    }

    #[inline]
    pub(super) fn file(&self) -> &[u8] {
        (*self.bytes).as_ref()
    }

    pub(super) fn sections(&self) -> &[(Option<Section>, SectionEntry)] {
        &self.sections
    }

    pub(super) fn pages(&self) -> [&Pages; 2] {
        [&self.spawn_pages, &self.op_pages]
    }

    /// Length of the pack.
    pub fn file_bytes(&self) -> u64 {
        self.file().len() as u64
    }

    /// What clients are told of the model.
    pub fn info(&self) -> &ModelInfo {
        &self.info
    }

    /// Title, origin, reports.
    pub fn metadata(&self) -> &Metadata {
        &self.metadata
    }

    /// The first damage found since the pack was opened: it should serve no new session then.
    pub fn damage(&self) -> Option<&PackError> {
        self.first_damage.get()
    }

    /// The mesh before any op, an oriented manifold.
    pub fn base(&self) -> &Patch {
        &self.base
    }

    /// First split of each base vertex, or `NO_OP`.
    pub fn base_first_splits(&self) -> &[u32] {
        &self.base_first_splits
    }

    /// Spawns are ops `0 .. spawn_count()`.
    #[inline]
    pub fn spawn_count(&self) -> u32 {
        self.context.spawns
    }

    /// Splits are ops `spawn_count() .. op_count()`.
    #[inline]
    pub fn op_count(&self) -> u32 {
        self.context.ops
    }

    /// Pages of [`PAGE_OPS`](super::PAGE_OPS) ops.
    pub fn page_count(&self) -> u32 {
        self.op_pages.count()
    }

    /// Whether the page of `op` was used before, so that reading it costs no check (and most likely no disk access).
    #[inline]
    pub fn is_warm(&self, op: u32) -> bool {
        self.op_pages.is_checked(op >> PAGE_SHIFT)
    }

    /// Reads and checks the page of `op`: what a thread that reads ahead does.
    ///
    /// # Errors
    /// [`PackError`] if the page is damaged or there is no such op.
    pub fn warm(&self, op: u32) -> Result<(), PackError> {
        self.op_row(op).map(|_| ())
    }

    /// The page of an op and its row there.
    #[inline]
    fn op_row(&self, op: u32) -> Result<(PageView<'_>, usize), PackError> {
        if op >= self.context.ops {
            return Err(PackError::OutOfRange { what: "op", number: op });
        }
        let page = op >> PAGE_SHIFT;
        Ok((self.op_page(page)?, (op - (page << PAGE_SHIFT)) as usize))
    }

    #[inline]
    fn op_page(&self, page: u32) -> Result<PageView<'_>, PackError> {
        let (first, ops, spawns) = self.context.rows(page);
        let bytes = self.op_pages.get(self.file(), page, &self.first_damage, |bytes| {
            let view = PageView { bytes, ops, spawns };
            view.check_structure(&self.context)?;
            view.check_fields(&self.context, first)
        })?;
        Ok(PageView { bytes, ops, spawns })
    }

    /// The page of a split and its row among the page's splits.
    #[inline]
    fn split_row(&self, split: u32) -> Result<(PageView<'_>, usize), PackError> {
        if split < self.context.spawns {
            return Err(PackError::OutOfRange { what: "split", number: split });
        }
        let (view, row) = self.op_row(split)?;
        Ok((view, row - view.spawns))
    }

    /// Visibility sphere of an op of either kind.
    ///
    /// # Errors
    /// [`PackError`] if the page is damaged or there is no such op; so for all accessors.
    #[inline]
    pub fn bounds(&self, op: u32) -> Result<Bounds, PackError> {
        let (view, row) = self.op_row(op)?;
        view.bounds(row).ok_or_else(changed)
    }

    /// The test arrays of ops `256 * page ..`, in place.
    ///
    /// # Errors
    /// See [`PackedModel::bounds`].
    pub fn tests(&self, page: u32) -> Result<TestPage<'_>, PackError> {
        if page >= self.page_count() {
            return Err(PackError::OutOfRange { what: "page", number: page });
        }
        self.op_page(page)?.tests(page << PAGE_SHIFT).ok_or_else(changed)
    }

    /// The forest children of a split: next split of `s`, first split of `t`; `NO_OP` where there is none.
    ///
    /// # Errors
    /// See [`PackedModel::bounds`].
    #[inline]
    pub fn children(&self, split: u32) -> Result<[u32; 2], PackError> {
        let (view, row) = self.split_row(split)?;
        Ok(view.children(row).ok_or_else(changed)?.map(|child| child.unwrap_or(NO_OP)))
    }

    /// The fields of a split.
    ///
    /// # Errors
    /// See [`PackedModel::bounds`].
    #[inline]
    pub fn split(&self, split: u32) -> Result<SplitFields, PackError> {
        let (view, row) = self.split_row(split)?;
        let (has_colors, has_moves) = (self.context.has_colors, self.context.has_moves);
        let read = || {
            let tags = view.tags(row)?;
            Some(SplitFields {
                tree_parent: 0,
                s: 0,
                left: view.cut(row, tags, column::LEFT)?,
                right: view.cut(row, tags, column::RIGHT)?,
                position: view.position(row)?,
                color: if has_colors { view.color(row, column::colors())? } else { [0; 3] },
                s_move: if has_moves { view.s_move(row, column::moves(has_colors))? } else { [0; 3] },
                s_color_move: if has_moves && has_colors { view.color(row, column::color_moves())? } else { [0; 3] },
            })
        };
        let mut fields = read().ok_or_else(changed)?;
        (fields.tree_parent, fields.s) = self.tree_parent(view, row)?;
        Ok(fields)
    }

    /// Tree parent and what `s` is to it.
    #[inline]
    fn tree_parent(&self, view: PageView<'_>, row: usize) -> Result<(u32, u32), PackError> {
        let tree = view.tags(row).and_then(|tags| view.tree(row, tags));
        Ok(match tree.ok_or_else(changed)? {
            (tag::TREE_ROOT, vertex) => (self.root_vertex(vertex)?.0.unwrap_or(NO_OP), vertex),
            (kind, parent) => (parent, kind - tag::TREE_KEPT),
        })
    }

    /// Owners of the three references of a split without repeats: tree parent, left, right. Spawns count as ops.
    ///
    /// # Errors
    /// See [`PackedModel::bounds`].
    #[inline]
    pub fn parents(&self, split: u32) -> Result<([u32; 3], usize), PackError> {
        let (view, row) = self.split_row(split)?;
        let mut parents = [NO_OP; 3];
        let mut count = 0;
        let mut add = |op: u32| {
            if op != NO_OP && !parents[..count].contains(&op) {
                parents[count] = op;
                count += 1;
            }
        };
        add(self.tree_parent(view, row)?.0);
        let tags = view.tags(row).ok_or_else(changed)?;
        for side in [column::LEFT, column::RIGHT] {
            match view.cut(row, tags, side).ok_or_else(changed)? {
                CutRef::None => {}
                CutRef::Split { op, .. } => add(op),
                CutRef::Root { face, .. } => add(self.root_face(face)?.0.unwrap_or(NO_OP)),
            }
        }
        Ok((parents, count))
    }

    /// Where a spawn's elements begin and end.
    fn spawn_range(&self, spawn: u32) -> Result<(SpawnEntry, SpawnEntry), PackError> {
        if spawn >= self.context.spawns {
            return Err(PackError::OutOfRange { what: "spawn", number: spawn });
        }
        let table = self.spawn_table();
        table.entry(spawn).zip(table.entry(spawn + 1)).ok_or_else(changed)
    }

    fn spawn_table(&self) -> SpawnTable<'_> {
        SpawnTable::new(self.file().get(self.spawn_table.clone()).unwrap_or_default())
    }

    /// Arrays of the page that holds a spawn and the page's first elements.
    fn spawn_arrays(&self, spawn: u32) -> Result<(PatchArrays<'_>, SpawnEntry), PackError> {
        let page = spawn >> PAGE_SHIFT;
        let spawns = spawns_of_page(page, self.context.spawns);
        let table = self.spawn_table();
        let (first, end) = table.entry(spawns.start).zip(table.entry(spawns.end)).ok_or_else(changed)?;
        let (vertices, faces) = (end.vertex - first.vertex, end.face - first.face);
        let arrays = |bytes| {
            let expected = spawn_page_bytes(vertices.into(), faces.into(), self.context.has_colors);
            let fits = |bytes: &&[u8]| bytes.len() as u64 == expected;
            let body = Some(bytes).filter(fits).map(|bytes: &[u8]| &bytes[SPAWN_PAGE_HEADER..]);
            body.and_then(|body| PatchArrays::new(body, vertices, faces, self.context.has_colors))
        };
        let bytes = self.spawn_pages.get(self.file(), page, &self.first_damage, |bytes| {
            let arrays = arrays(bytes).ok_or_else(|| format!("{} bytes do not fit the table", bytes.len()))?;
            arrays.check(self.context.max_coordinate, &(self.context.spawns..self.context.ops))
        })?;
        Ok((arrays(bytes).ok_or_else(changed)?, first))
    }

    /// What a spawn inserts. Corners are in range; that it is a manifold is checked when it is applied.
    ///
    /// # Errors
    /// See [`PackedModel::bounds`].
    pub fn spawn_patch(&self, spawn: u32) -> Result<Patch, PackError> {
        let (begin, end) = self.spawn_range(spawn)?;
        let (arrays, first) = self.spawn_arrays(spawn)?;
        let [vertex, vertices] = [begin.vertex - first.vertex, end.vertex - begin.vertex].map(|n| n as usize);
        let [face, faces] = [begin.face - first.face, end.face - begin.face].map(|n| n as usize);
        let patch = arrays.patch(vertex, vertices, face, faces).ok_or_else(changed)?;
        if patch.faces.iter().flatten().any(|&v| v as usize >= vertices) {
            let error = damaged(Section::SpawnPages, format!("spawn {spawn}: a corner is out of range"));
            let _ = self.first_damage.set(error.clone());
            return Err(error);
        }
        Ok(patch)
    }

    /// First split of each vertex of a spawn, or `NO_OP`.
    ///
    /// # Errors
    /// See [`PackedModel::bounds`].
    pub fn spawn_first_splits(&self, spawn: u32) -> Result<Vec<u32>, PackError> {
        let (begin, end) = self.spawn_range(spawn)?;
        let (arrays, first) = self.spawn_arrays(spawn)?;
        let range = begin.vertex - first.vertex..end.vertex - first.vertex;
        range.map(|v| arrays.first_split(v as usize)).collect::<Option<_>>().ok_or_else(changed)
    }

    /// Number of triangles of a spawn.
    ///
    /// # Errors
    /// [`PackError::OutOfRange`].
    pub fn spawn_triangles(&self, spawn: u32) -> Result<u32, PackError> {
        self.spawn_range(spawn).map(|(begin, end)| end.face - begin.face)
    }

    /// Number of vertices of a spawn.
    ///
    /// # Errors
    /// [`PackError::OutOfRange`].
    pub fn spawn_vertices(&self, spawn: u32) -> Result<u32, PackError> {
        self.spawn_range(spawn).map(|(begin, end)| end.vertex - begin.vertex)
    }

    /// The spawn (or `None` for the base) that root face `face` belongs to, and its number within that patch. O(log spawns).
    ///
    /// # Errors
    /// [`PackError::OutOfRange`].
    #[inline]
    pub fn root_face(&self, face: u32) -> Result<(Option<u32>, u32), PackError> {
        if face < self.info.smallest_limit {
            return Ok((None, face));
        }
        if face >= self.context.root_faces {
            return Err(PackError::OutOfRange { what: "root face", number: face });
        }
        let found = self.spawn_table().find(self.context.spawns, face, |entry| entry.face);
        found.map(|(spawn, local)| (Some(spawn), local)).ok_or_else(changed)
    }

    /// Likewise for root vertices.
    ///
    /// # Errors
    /// [`PackError::OutOfRange`].
    #[inline]
    pub fn root_vertex(&self, vertex: u32) -> Result<(Option<u32>, u32), PackError> {
        if (vertex as usize) < self.base_first_splits.len() {
            return Ok((None, vertex));
        }
        if vertex >= self.context.root_vertices {
            return Err(PackError::OutOfRange { what: "root vertex", number: vertex });
        }
        let found = self.spawn_table().find(self.context.spawns, vertex, |entry| entry.vertex);
        found.map(|(spawn, local)| (Some(spawn), local)).ok_or_else(changed)
    }
}

/// A published pack never changes; if somebody wrote into it all the same, this is what readers say.
#[cold]
fn changed() -> PackError {
    damaged(Section::OpPages, "the bytes changed since they were checked")
}

fn header_damage(reason: impl Into<String>) -> PackError {
    PackError::Damaged { section: HEADER_NAME, reason: reason.into() }
}

/// Reads header and section table and checks that the sections tile the file, padding zero.
fn read_table(file: &[u8]) -> Result<Vec<(Option<Section>, SectionEntry)>, PackError> {
    const HEADER: usize = size_of::<FileHeader>();
    const ENTRY: usize = size_of::<SectionEntry>();
    if !file.starts_with(&MAGIC) {
        return Err(PackError::NotAPack);
    }
    let header = file.get(..HEADER).ok_or_else(|| header_damage("the file ends within it"))?;
    let mut header: FileHeader = bytemuck::pod_read_unaligned(header);
    if header.version != VERSION {
        return Err(PackError::Version { found: header.version });
    }
    if header.file_bytes != file.len() as u64 {
        return Err(header_damage(format!("the file has {} of {} bytes", file.len(), header.file_bytes)));
    }
    if header.sections > MAX_SECTIONS {
        return Err(header_damage(format!("{} sections", header.sections)));
    }
    let table_end = HEADER + header.sections as usize * ENTRY;
    let table = file.get(HEADER..table_end).ok_or_else(|| header_damage("the file ends within the section table"))?;
    let stored = std::mem::take(&mut header.checksum);
    if xxh3_64(&[bytemuck::bytes_of(&header), table].concat()) != stored {
        return Err(header_damage("the checksum does not fit"));
    }
    let mut sections: Vec<(Option<Section>, SectionEntry)> = Vec::new();
    let (mut end, mut name) = (table_end as u64, HEADER_NAME);
    for bytes in table.chunks_exact(ENTRY) {
        let entry: SectionEntry = bytemuck::pod_read_unaligned(bytes);
        let section = Section::from_kind(entry.kind);
        if section.is_none() && entry.flags & SECTION_REQUIRED != 0 {
            return Err(PackError::UnknownSection { kind: entry.kind });
        }
        if sections.iter().any(|(_, other)| other.kind == entry.kind) {
            return Err(header_damage(format!("two sections of kind {}", entry.kind)));
        }
        check_padding(file, end, entry.offset, name)?;
        let section_end = entry.offset.checked_add(entry.bytes).filter(|&end| end <= header.file_bytes);
        end = section_end.ok_or_else(|| header_damage("a section ends after the file"))?;
        name = section.map_or(UNKNOWN_NAME, Section::name);
        sections.push((section, entry));
    }
    check_padding(file, end, header.file_bytes, name)?;
    Ok(sections)
}

/// The bytes from `end` to the next section fill up the grid and are zero.
fn check_padding(file: &[u8], end: u64, next: u64, name: &'static str) -> Result<(), PackError> {
    if next != end.next_multiple_of(8) || next > file.len() as u64 {
        return Err(header_damage("the sections do not follow one another"));
    }
    if file[end as usize..next as usize].iter().any(|&b| b != 0) {
        return Err(PackError::Damaged { section: name, reason: "the padding after it is not zero".into() });
    }
    Ok(())
}

/// Compares a section's checksum.
pub(super) fn check_section(file: &[u8], section: Section, entry: &SectionEntry) -> Result<(), PackError> {
    if xxh3_64(&file[entry.offset as usize..(entry.offset + entry.bytes) as usize]) != entry.checksum {
        return Err(damaged(section, "the checksum does not fit"));
    }
    Ok(())
}

fn read_model(bytes: &[u8]) -> Result<(ModelFields, Lattice), PackError> {
    let refuse = |reason: &str| Err(damaged(Section::Model, reason));
    let Ok(fields) = bytemuck::try_pod_read_unaligned::<ModelFields>(bytes) else { return refuse("wrong length") };
    let bits = u8::try_from(fields.bits).unwrap_or(u8::MAX);
    let lattice = Lattice { origin: fields.origin, step: fields.step, bits };
    if !lattice.is_valid() {
        return refuse("no lattice");
    }
    if fields.flags & !(FLAG_COLORS | FLAG_MOVES | FLAG_OPEN) != 0 {
        return refuse("unknown flags");
    }
    let on_lattice = |p: &[i32; 3]| p.iter().all(|c| (0..=lattice.max_coordinate()).contains(c));
    if !on_lattice(&fields.box_min) || !on_lattice(&fields.box_max) {
        return refuse("the box is off the lattice");
    }
    if fields.spawns > fields.ops || fields.ops == NO_OP {
        return refuse("the numbers of ops make no sense");
    }
    if fields.base_vertices.max(fields.base_faces) > MAX_PATCH_ELEMENTS {
        return refuse("the base is too large");
    }
    Ok((fields, lattice))
}

fn read_base(bytes: &[u8], size: SpawnEntry, context: &PageContext) -> Result<(Patch, Vec<u32>), PackError> {
    let refuse = |reason: String| damaged(Section::Base, reason);
    // The section ends on the grid, so its own padding is under its checksum.
    let arrays = PatchArrays::new(bytes, size.vertex, size.face, context.has_colors)
        .ok_or_else(|| refuse(format!("{} bytes for {} vertices and {} faces", bytes.len(), size.vertex, size.face)))?;
    debug_assert_eq!(align8(bytes.len()), bytes.len());
    arrays.check(context.max_coordinate, &(context.spawns..context.ops)).map_err(refuse)?;
    let [vertices, faces] = [size.vertex, size.face].map(|n| n as usize);
    let missing = || refuse("the bytes changed".into());
    let patch = arrays.patch(0, vertices, 0, faces).ok_or_else(missing)?;
    patch.validate().map_err(|e| refuse(e.to_string()))?;
    let first_splits = (0..vertices).map(|v| arrays.first_split(v)).collect::<Option<_>>().ok_or_else(missing)?;
    Ok((patch, first_splits))
}
