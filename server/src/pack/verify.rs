//! The deep check: every byte, every field, every forest edge, and a replay that must give the complete mesh.

use serde::Serialize;
use xxhash_rust::xxh3::xxh3_64;

use super::hash::complete_mesh_hash;
use super::header::check_section;
use super::layout::{Section, UNKNOWN_NAME};
use super::record::{Bounds, NO_OP};
use super::replay::{live_faces, replay};
use super::{PackBytes, PackError, PackedModel, damaged};

/// What [`verify`] went through.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct VerifyReport {
    /// Length of the pack.
    pub bytes: u64,
    /// Pages of ops and of spawns.
    pub pages: u32,
    /// Components that spawn.
    pub spawns: u32,
    /// Vertex splits replayed.
    pub splits: u32,
    /// Vertices of the complete mesh.
    pub vertices: u64,
    /// Triangles of the complete mesh.
    pub triangles: u64,
    /// Hash of the complete mesh.
    pub hash: u64,
}

/// Checks everything about a pack: all checksums, every field, that bounds contain those of the forest children, that parents
/// and children agree, and that a replay gives the mesh that the header describes. About 1 us a split.
///
/// # Errors
/// [`PackError`] with the first thing found, in the order of this list; damaged pages are named by section and number.
pub fn verify(bytes: PackBytes) -> Result<VerifyReport, PackError> {
    let model = PackedModel::open(bytes)?;
    check_sections(&model)?;
    check_forest(&model)?;
    check_mesh(&model)?;
    let [spawn_pages, op_pages] = model.pages();
    Ok(VerifyReport {
        bytes: model.file_bytes(),
        pages: spawn_pages.count() + op_pages.count(),
        spawns: model.spawn_count(),
        splits: model.op_count() - model.spawn_count(),
        vertices: model.info().vertices,
        triangles: model.info().triangles,
        hash: model.info().hash.0,
    })
}

/// What open left out: directories, each page, and the sections as wholes.
fn check_sections(model: &PackedModel) -> Result<(), PackError> {
    let file = model.file();
    let entries = model.sections();
    for (section, entry) in entries {
        match section {
            Some(Section::SpawnPages | Section::OpPages) => {}
            Some(section) => check_section(file, *section, entry)?,
            None => {
                if xxh3_64(&file[entry.offset as usize..(entry.offset + entry.bytes) as usize]) != entry.checksum {
                    let reason = format!("the checksum of kind {} does not fit", entry.kind);
                    return Err(PackError::Damaged { section: UNKNOWN_NAME, reason });
                }
            }
        }
    }
    for spawn in 0..model.spawn_count() {
        model.spawn_patch(spawn)?;
    }
    for page in 0..model.page_count() {
        model.tests(page)?;
    }
    for pages in model.pages() {
        pages.check_extent(file)?;
    }
    for (section, entry) in entries {
        if let Some(section @ (Section::SpawnPages | Section::OpPages)) = section {
            check_section(file, *section, entry)?;
        }
    }
    Ok(())
}

/// Every split is the child of exactly the op (or base vertex) that it names, and within its bounds.
fn check_forest(model: &PackedModel) -> Result<(), PackError> {
    let mut children = 0u32;
    let mut edge = |parent: Option<(u32, &Bounds)>, s: u32, child: u32, section: Section| -> Result<(), PackError> {
        if child == NO_OP {
            return Ok(());
        }
        children += 1;
        let split = model.split(child)?;
        if (split.tree_parent, split.s) != (parent.map_or(NO_OP, |(op, _)| op), s) {
            return Err(damaged(section, format!("split {child} is not the child of op {}", split.tree_parent)));
        }
        match parent {
            Some((op, bounds)) if !bounds.contains(&model.bounds(child)?) => Err(damaged(
                Section::OpPages,
                format!("the bounds of op {op} do not contain those of its child {child}"),
            )),
            _ => Ok(()),
        }
    };
    let mut root_vertex = 0;
    for &first in model.base_first_splits() {
        edge(None, root_vertex, first, Section::Base)?;
        root_vertex += 1;
    }
    let mut last_error = None;
    for spawn in 0..model.spawn_count() {
        let bounds = model.bounds(spawn)?;
        if last_error.is_some_and(|last| last < bounds.error) {
            return Err(damaged(Section::OpPages, format!("spawn {spawn} has a larger error than the one before it")));
        }
        last_error = Some(bounds.error);
        let info = model.info();
        let is_inside = (0..3).all(|k| (info.box_min[k]..=info.box_max[k]).contains(&bounds.center[k]));
        if !is_inside || bounds.radius.decode() > 2.0 * bounds.error.decode() {
            let reason = format!("the sphere of spawn {spawn} is centred outside the model or has twice its error");
            return Err(damaged(Section::OpPages, reason));
        }
        for first in model.spawn_first_splits(spawn)? {
            edge(Some((spawn, &bounds)), root_vertex, first, Section::SpawnPages)?;
            root_vertex += 1;
        }
    }
    for op in model.spawn_count()..model.op_count() {
        let bounds = model.bounds(op)?;
        let [next_of_s, first_of_t] = model.children(op)?;
        edge(Some((op, &bounds)), 0, next_of_s, Section::OpPages)?;
        edge(Some((op, &bounds)), 1, first_of_t, Section::OpPages)?;
    }
    // Each of these edges leads to another split, since a split names one parent and one place there.
    let splits = model.op_count() - model.spawn_count();
    if children != splits {
        return Err(damaged(Section::OpPages, format!("{children} of {splits} splits are children of an op")));
    }
    Ok(())
}

/// Replays and compares with the header.
fn check_mesh(model: &PackedModel) -> Result<(), PackError> {
    let replica = replay(model)?;
    let info = model.info();
    let refuse = |reason: String| Err(damaged(Section::Model, reason));
    if u64::from(replica.vertex_count()) != info.vertices || u64::from(replica.triangle_count()) != info.triangles {
        let (vertices, triangles) = (replica.vertex_count(), replica.triangle_count());
        return refuse(format!("a replay gives {vertices} vertices and {triangles} triangles"));
    }
    let faces: Vec<[u32; 3]> = live_faces(&replica).collect();
    let colors = info.has_colors.then(|| replica.colors());
    let hash = complete_mesh_hash(replica.positions(), colors, &faces);
    if hash != info.hash {
        return refuse(format!("a replay gives a mesh of hash {:016x}", hash.0));
    }
    let positions = || replica.vertices().iter().map(|slot| replica.positions()[slot as usize]);
    let first = positions().next().unwrap_or_default();
    let (mut low, mut high) = (first, first);
    for p in positions() {
        low = std::array::from_fn(|k| low[k].min(p[k]));
        high = std::array::from_fn(|k| high[k].max(p[k]));
    }
    if (low, high) != (info.box_min, info.box_max) {
        return refuse("a replay gives another box".into());
    }
    Ok(())
}
