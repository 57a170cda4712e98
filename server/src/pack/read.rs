//! Reading a pack in place.

use std::fmt;
use std::num::NonZeroU16;
use std::ops::Range;
use std::sync::{Arc, OnceLock};

use lodestream_protocol::ids::ModelHash;
use lodestream_protocol::mesh::Patch;
use lodestream_protocol::message::ModelInfo;
use lodestream_protocol::op::encode_base;

use super::header::{check_section, read_model, read_table};
use super::layout::{
    FLAG_COLORS, FLAG_MOVES, FLAG_OPEN, FLAG_VERTICES, MAX_METADATA_BYTES, PAGE_SHIFT, SPAWN_PAGE_HEADER, STEP_SHIFT,
    Section, SectionEntry, SpawnEntry, align8, column, tag,
};
use super::page::{PageContext, PageView, TestPage};
use super::pages::{PageId, Pages};
use super::record::{Bounds, CutRef, NO_OP, VERTEX_OPS};
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

impl SplitFields {
    /// The parents that it names as ops, in no order, some perhaps twice: all of them but the spawns that root faces belong to.
    #[inline]
    pub fn named_parents(&self) -> impl Iterator<Item = u32> + use<> {
        let owner = |cut| if let CutRef::Split { op, .. } = cut { op } else { NO_OP };
        [self.tree_parent, owner(self.left), owner(self.right)].into_iter().filter(|&op| op != NO_OP)
    }
}

/// What a view takes in with an op, see [`PackedModel::prerequisites`].
#[derive(Clone, Copy, Debug)]
pub struct Prerequisites {
    ops: [u32; 3 + VERTEX_OPS],
    count: usize,
}

impl Prerequisites {
    /// Nothing: what a spawn waits for.
    pub const NONE: Self = Self { ops: [NO_OP; 3 + VERTEX_OPS], count: 0 };

    /// The ops, parents first.
    #[inline]
    pub fn as_slice(&self) -> &[u32] {
        &self.ops[..self.count]
    }
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
    coded_base: OnceLock<Vec<u8>>,
    base_first_splits: Vec<u32>,
    context: PageContext,
    sections: Vec<(Option<Section>, SectionEntry)>,
    spawn_table: Range<usize>,
    smallest_spawn: u32,
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
        let smallest_spawn =
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
            by_vertices: fields.flags & FLAG_VERTICES != 0,
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
            visual_step: NonZeroU16::new((fields.flags >> STEP_SHIFT) as u16),
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
            coded_base: OnceLock::new(),
            base_first_splits,
            context,
            spawn_table,
            smallest_spawn,
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

    /// The same as a welcome carries it. Coded when it is first asked for, once for all clients.
    pub fn coded_base(&self) -> &[u8] {
        let ModelInfo { lattice, has_colors, .. } = &self.info;
        self.coded_base.get_or_init(|| encode_base(&self.base, lattice.bits, *has_colors))
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

    /// Triangles of the smallest spawn; the largest number there is if none spawns.
    #[inline]
    pub fn smallest_spawn(&self) -> u32 {
        self.smallest_spawn
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

    /// The page with the fields of an op.
    #[inline]
    pub fn page_of(op: u32) -> PageId {
        PageId::Ops(op >> PAGE_SHIFT)
    }

    /// The page with the patch of a spawn.
    #[inline]
    pub fn patch_page_of(spawn: u32) -> PageId {
        PageId::Patches(spawn >> PAGE_SHIFT)
    }

    /// Whether a page was read and checked before. What it holds is then read without a check and, unless the system took the
    /// memory for something else meanwhile, without the disk.
    #[inline]
    pub fn is_ready(&self, page: PageId) -> bool {
        match page {
            PageId::Ops(page) => self.op_pages.is_checked(page),
            PageId::Patches(page) => self.spawn_pages.is_checked(page),
        }
    }

    /// Reads all of a page and checks it, so that it [is ready](Self::is_ready). Waits for the disk, then takes some
    /// microseconds; costs nothing if the page is ready.
    ///
    /// # Errors
    /// [`PackError`] if the page is damaged (which [`damage`](Self::damage) remembers) or there is none of this number.
    pub fn read_page(&self, page: PageId) -> Result<(), PackError> {
        match page {
            PageId::Ops(page) if page < self.op_pages.count() => self.op_page(page).map(|_| ()),
            PageId::Patches(page) if page < self.spawn_pages.count() => {
                self.spawn_arrays(page << PAGE_SHIFT).map(|_| ())
            }
            PageId::Ops(number) => Err(PackError::OutOfRange { what: "op page", number }),
            PageId::Patches(number) => Err(PackError::OutOfRange { what: "spawn page", number }),
        }
    }

    /// The pages that views of the model begin with: the coarsest `each` of op pages of spawns, of op pages of splits, and of
    /// spawn pages.
    pub fn first_pages(&self, each: u32) -> impl Iterator<Item = PageId> + use<> {
        let (ops, splits) = (self.op_pages.count(), self.context.spawns >> PAGE_SHIFT);
        let of_spawns = 0..each.min(splits);
        let of_splits = splits..splits.saturating_add(each).min(ops);
        let patches = 0..each.min(self.spawn_pages.count());
        of_spawns.chain(of_splits).map(PageId::Ops).chain(patches.map(PageId::Patches))
    }

    /// Whether all pages [are ready](Self::is_ready).
    pub(crate) fn is_all_ready(&self) -> bool {
        self.ready_pages() == self.op_pages.count() + self.spawn_pages.count()
    }

    /// Pages that [are ready](Self::is_ready).
    pub fn ready_pages(&self) -> u32 {
        self.op_pages.checked_count() + self.spawn_pages.checked_count()
    }

    /// The page of an op and its row there.
    #[inline(always)]
    fn op_row(&self, op: u32) -> Result<(PageView<'_>, usize), PackError> {
        if op >= self.context.ops {
            return Err(PackError::OutOfRange { what: "op", number: op });
        }
        let page = op >> PAGE_SHIFT;
        Ok((self.op_page(page)?, (op - (page << PAGE_SHIFT)) as usize))
    }

    #[inline(always)]
    fn op_page(&self, page: u32) -> Result<PageView<'_>, PackError> {
        match self.op_pages.warm(self.file(), page) {
            Some(bytes) => {
                let (_, ops, spawns) = self.context.rows(page);
                Ok(PageView { bytes, ops, spawns })
            }
            None => self.cold_page(page),
        }
    }

    #[cold]
    fn cold_page(&self, page: u32) -> Result<PageView<'_>, PackError> {
        let (first, ops, spawns) = self.context.rows(page);
        let bytes = self.op_pages.get(self.file(), page, &self.first_damage, |bytes| {
            let view = PageView { bytes, ops, spawns };
            view.check_structure(&self.context)?;
            view.check_fields(&self.context, first)
        })?;
        Ok(PageView { bytes, ops, spawns })
    }

    /// The page of a split and its row among the page's splits.
    #[inline(always)]
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

    /// Triangles that an op adds.
    ///
    /// # Errors
    /// See [`PackedModel::bounds`].
    pub fn triangles_of(&self, op: u32) -> Result<u32, PackError> {
        if op < self.spawn_count() {
            return self.spawn_triangles(op);
        }
        let (view, row) = self.split_row(op)?;
        let tags = view.tags(row).ok_or_else(changed)?;
        let sides = [tags, tags >> tag::RIGHT_SHIFT];
        Ok(sides.iter().map(|side| u32::from(side & 3 != tag::CUT_NONE)).sum())
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

    /// Forest parent of a split, or [`NO_OP`], and what `s` is to it: where that is a split, the vertex that it kept (0) or inserted (1), else the
    /// number of a root vertex.
    ///
    /// # Errors
    /// See [`PackedModel::bounds`].
    pub fn tree_parent_of(&self, split: u32) -> Result<(u32, u32), PackError> {
        let (view, row) = self.split_row(split)?;
        self.tree_parent(view, row)
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

    /// Whether views take in ops by the rule of vertices ([`Dag::by_vertices`](super::record::Dag::by_vertices)).
    pub fn is_by_vertices(&self) -> bool {
        self.context.by_vertices
    }

    /// What a view takes in with an op: its parents, and under the rule of vertices the last ops on the vertices around its
    /// cut. Without repeats; none for spawns.
    ///
    /// # Errors
    /// See [`PackedModel::bounds`].
    #[inline]
    pub fn prerequisites(&self, op: u32) -> Result<Prerequisites, PackError> {
        let mut all = Prerequisites::NONE;
        if op < self.spawn_count() {
            return Ok(all);
        }
        let (parents, count) = self.parents(op)?;
        all.ops[..3].copy_from_slice(&parents);
        all.count = count;
        if self.context.by_vertices {
            let (view, row) = self.split_row(op)?;
            let first = column::vertex_ops(self.context.has_colors, self.context.has_moves);
            for other in view.vertex_ops(row, first).ok_or_else(changed)? {
                if other != op && !all.as_slice().contains(&other) {
                    all.ops[all.count] = other;
                    all.count += 1;
                }
            }
        }
        Ok(all)
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
