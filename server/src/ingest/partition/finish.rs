//! The last pass: positions on the lattice, final numbers, components, and the mesh in figures.

use std::collections::HashMap;
use std::ops::Range;

use glam::DVec3;
use lodestream_protocol::ids::ModelHash;
use lodestream_protocol::quant::Lattice;

use super::Surveyed;
use super::faces::Ranges;
use super::local::Local;
use super::resample::{self, Precision};
use super::runs::{blocks_in_order, in_order};
use super::trouble::Cuts;
use crate::ingest::chunks::{ChunkedMesh, Component, ComponentTable, VertexTable, height_of, pack, patches};
use crate::ingest::spill::{Spill, SpillError, Workspace};
use crate::mesh::edges::DisjointSets;
use crate::pack::{CompleteMesh, complete_mesh_hash};

pub(super) struct Input {
    pub(super) lattice: Lattice,
    pub(super) precision: Precision,
    pub(super) positions: Spill<[f64; 3]>,
    pub(super) colors: Option<Spill<[u8; 3]>>,
    pub(super) surveyed: Surveyed,
    pub(super) cuts: Cuts,
    pub(super) ranges: Ranges,
}

/// Box of lattice points.
#[derive(Clone, Copy)]
struct Bounds {
    low: [i32; 3],
    high: [i32; 3],
}

impl Bounds {
    const NOTHING: Self = Self { low: [i32::MAX; 3], high: [i32::MIN; 3] };

    fn join(&mut self, other: Self) {
        for k in 0..3 {
            self.low[k] = self.low[k].min(other.low[k]);
            self.high[k] = self.high[k].max(other.high[k]);
        }
    }

    fn add(&mut self, p: [i32; 3]) {
        self.join(Self { low: p, high: p });
    }
}

/// What hangs together within a chunk.
struct Patch {
    bounds: Bounds,
}

/// What the last look at a chunk gives.
struct Finished {
    /// In the final numbering; empty if nothing was renumbered.
    faces: Vec<[u32; 3]>,
    hash: u64,
    area: f64,
    patches: Vec<Patch>,
    /// Vertices with faces in other chunks, and the patch that they are in.
    joints: Vec<(u32, u32)>,
}

pub(super) fn finish(
    input: Input,
    workspace: &Workspace,
    progress: &mut dyn FnMut(f32),
) -> Result<ChunkedMesh, SpillError> {
    let Input { lattice, precision, positions, colors, mut surveyed, cuts, ranges } = input;
    let has_colors = colors.is_some();
    let places = final_places(std::mem::take(&mut surveyed.places), &cuts);
    let (packed, mut bounds) = round(&positions, &lattice, &cuts, places.len())?;
    drop(positions);
    let colors = match colors {
        Some(colors) => copied(&colors, &cuts, places.len())?,
        None => Vec::new(),
    };
    let mut vertices = VertexTable::new(packed, colors, places);

    let chunk_count = surveyed.chunk_starts.len() - 1;
    let ranges = ranges.renumbered(|v| cuts.number(v));
    let mut resampled = None;
    if precision == Precision::Visual {
        let max = lattice.max_coordinate();
        let done = resample::resample(&mut vertices, chunk_count, max, |chunk| {
            let mut faces = surveyed.chunk(chunk)?;
            if cuts.has_copies() {
                faces.iter_mut().for_each(|face| *face = cuts.renumbered(*face));
            }
            let local = Local::new(ranges.range(chunk), faces.iter().flatten().copied());
            faces.iter_mut().for_each(|face| *face = face.map(|v| local.place(v)));
            Ok((local, faces))
        })?;
        bounds = Bounds::NOTHING;
        vertices.positions().for_each(|p| bounds.add(p));
        resampled = Some(done);
    }
    let mut faces = cuts.has_copies().then(|| workspace.spill());
    let (mut hash, mut area) = (0_u64, 0.0);
    let mut joiner = Joiner::default();
    in_order(
        chunk_count,
        |chunk| {
            let mut faces = surveyed.chunk(chunk)?;
            if cuts.has_copies() {
                faces.iter_mut().for_each(|face| *face = cuts.renumbered(*face));
            }
            Ok(look(faces, ranges.range(chunk), &vertices, has_colors, cuts.has_copies()))
        },
        |chunk, finished: Finished| {
            hash = hash.wrapping_add(finished.hash);
            area += finished.area;
            joiner.add(&finished);
            progress((chunk + 1) as f32 / chunk_count as f32);
            faces.as_mut().map_or(Ok(()), |faces| faces.push(&finished.faces))
        },
    )?;
    let boundary = boundary_length(&surveyed.boundary, &cuts, &vertices)?;
    let faces = match faces {
        Some(faces) => faces.finish()?,
        None => surveyed.faces,
    };
    let bounds = if faces.len() == 0 { Bounds { low: [0; 3], high: [0; 3] } } else { bounds };
    Ok(ChunkedMesh {
        lattice,
        has_colors,
        is_open: boundary * boundary > 4.0 * area,
        complete: CompleteMesh {
            hash: ModelHash(hash),
            vertices: vertices.len() as u64,
            triangles: faces.len(),
            box_min: bounds.low,
            box_max: bounds.high,
            visual_step: resampled.and_then(|resampled| resampled.step),
        },
        resampled,
        vertices,
        faces,
        chunk_starts: surveyed.chunk_starts,
        components: joiner.table(),
    })
}

/// Places by final number.
fn final_places(mut places: Vec<u8>, cuts: &Cuts) -> Vec<u8> {
    for &(vertex, _, place) in cuts.places.iter().filter(|(_, copy, _)| *copy == 0) {
        places[vertex as usize] = place;
    }
    if !cuts.has_copies() {
        return places;
    }
    let mut out = Vec::with_capacity(places.len() + cuts.copies() as usize);
    let mut next = 0;
    for &(vertex, _, place) in cuts.places.iter().filter(|(_, copy, _)| *copy > 0) {
        let end = vertex as usize + 1;
        if next < end {
            out.extend_from_slice(&places[next..end]);
            next = end;
        }
        out.push(place);
    }
    out.extend_from_slice(&places[next..]);
    out
}

/// Appends the items of vertices `first ..`, each as often as the vertex and its copies need it.
fn push_copied<T: Copy>(first: u32, items: impl Iterator<Item = T>, cuts: &Cuts, out: &mut Vec<T>) {
    if !cuts.has_copies() {
        out.extend(items);
        return;
    }
    for (v, item) in (first..).zip(items) {
        out.extend(std::iter::repeat_n(item, 1 + cuts.copies_of(v) as usize));
    }
}

/// Lattice positions by final number, and their box.
fn round(
    positions: &Spill<[f64; 3]>,
    lattice: &Lattice,
    cuts: &Cuts,
    count: usize,
) -> Result<(Vec<u64>, Bounds), SpillError> {
    let mut packed = Vec::with_capacity(count);
    let mut bounds = Bounds::NOTHING;
    blocks_in_order(
        positions.len(),
        |range| {
            let mut bounds = Bounds::NOTHING;
            let mut part = Vec::new();
            let rounded = positions.read(range.clone())?.into_iter().map(|p| {
                let p = lattice.quantize(p);
                bounds.add(p);
                pack(p)
            });
            push_copied(range.start as u32, rounded, cuts, &mut part);
            Ok((part, bounds))
        },
        |(part, part_bounds)| {
            packed.extend_from_slice(&part);
            bounds.join(part_bounds);
            Ok(())
        },
    )?;
    Ok((packed, bounds))
}

fn copied(colors: &Spill<[u8; 3]>, cuts: &Cuts, count: usize) -> Result<Vec<[u8; 3]>, SpillError> {
    let mut out = Vec::with_capacity(count);
    colors.for_each_block(|first, block| push_copied(first as u32, block.iter().copied(), cuts, &mut out))?;
    Ok(out)
}

fn look(faces: Vec<[u32; 3]>, own: Range<u32>, vertices: &VertexTable, has_colors: bool, keep_faces: bool) -> Finished {
    let local = Local::new(own, faces.iter().flatten().copied());
    let corners: Vec<[u32; 3]> = faces.iter().map(|face| face.map(|v| local.place(v))).collect();
    let positions: Vec<[i32; 3]> = local.vertices().map(|v| vertices.position(v)).collect();
    let colors: Option<Vec<[u8; 3]>> = has_colors.then(|| local.vertices().map(|v| vertices.color(v)).collect());
    let hash = complete_mesh_hash(&positions, colors.as_deref(), &corners).0;
    drop(colors);

    let (patch_of_face, patch_count) = patches(local.count(), &corners);
    let mut patches: Vec<Patch> = (0..patch_count).map(|_| Patch { bounds: Bounds::NOTHING }).collect();
    let mut joints = Vec::new();
    let mut area = 0.0;
    let reaches_out: Vec<bool> = local.vertices().map(|v| vertices.height(v) > 0).collect();
    for (face, &patch) in corners.iter().zip(&patch_of_face) {
        let bounds = &mut patches[patch as usize].bounds;
        let [a, b, c] = face.map(|v| {
            let p = positions[v as usize];
            bounds.add(p);
            if reaches_out[v as usize] {
                joints.push((local.vertex(v), patch));
            }
            at(p)
        });
        area += (b - a).cross(c - a).length() * 0.5;
    }
    joints.sort_unstable();
    joints.dedup();
    Finished { faces: if keep_faces { faces } else { Vec::new() }, hash, area, patches, joints }
}

fn at(p: [i32; 3]) -> DVec3 {
    DVec3::from_array(p.map(f64::from))
}

/// Length of all edges with a single face, in lattice steps.
fn boundary_length(edges: &Spill<[u32; 2]>, cuts: &Cuts, vertices: &VertexTable) -> Result<f64, SpillError> {
    let length = |[v, w]: [u32; 2]| at(vertices.position(v)).distance(at(vertices.position(w)));
    let mut sum: f64 = 0.0;
    edges.for_each_block(|_, block| {
        for edge in block.iter().filter(|edge| !edge.iter().any(|&v| cuts.is_troubled(v))) {
            sum += length(edge.map(|v| cuts.number(v)));
        }
    })?;
    Ok(cuts.boundary.iter().fold(sum, |sum, &edge| sum + length(edge)))
}

/// Joins patches across chunks.
#[derive(Default)]
struct Joiner {
    patch_starts: Vec<u32>,
    patches: Vec<Patch>,
    /// A patch of each vertex that several chunks share. Looked up only, never walked through.
    patch_at: HashMap<u32, u32>,
    joints: Vec<[u32; 2]>,
}

impl Joiner {
    fn add(&mut self, finished: &Finished) {
        let first = self.patches.len() as u32;
        self.patch_starts.push(first);
        self.patches.extend(finished.patches.iter().map(|patch| Patch { bounds: patch.bounds }));
        let before = self.joints.len();
        for &(vertex, patch) in &finished.joints {
            let other = *self.patch_at.entry(vertex).or_insert(first + patch);
            if other != first + patch {
                self.joints.push([other, first + patch]);
            }
        }
        // One patch shares many vertices with another.
        let mut new = self.joints.split_off(before);
        new.sort_unstable();
        new.dedup();
        self.joints.extend(new);
    }

    fn table(mut self) -> ComponentTable {
        let mut sets = DisjointSets::new(self.patches.len());
        self.joints.iter().for_each(|&[a, b]| sets.join(a, b));
        self.patch_starts.push(self.patches.len() as u32);
        let mut of_patch = vec![0; self.patches.len()];
        let mut components: Vec<(Bounds, u32, u32)> = Vec::new();
        for chunk in 0..self.patch_starts.len() - 1 {
            for patch in self.patch_starts[chunk]..self.patch_starts[chunk + 1] {
                let root = sets.find(patch);
                let bounds = self.patches[patch as usize].bounds;
                if root == patch {
                    of_patch[patch as usize] = components.len() as u32;
                    components.push((bounds, chunk as u32, chunk as u32));
                } else {
                    let component = of_patch[root as usize];
                    of_patch[patch as usize] = component;
                    let (whole, _, last) = &mut components[component as usize];
                    whole.join(bounds);
                    *last = chunk as u32;
                }
            }
        }
        let components = components
            .into_iter()
            .map(|(bounds, first, last)| Component {
                low: bounds.low,
                high: bounds.high,
                height: height_of(first, last),
            })
            .collect();
        ComponentTable { patch_starts: self.patch_starts, of_patch, components }
    }
}
