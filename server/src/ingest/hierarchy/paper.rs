//! The rules of Southern, Blake and Marais (2001), chapter 5, where the default differs: what an op waits for, what its
//! visibility sphere bounds and what its error is. They are kept for comparison (`docs/paper.md`).
//!
//! Works on a finished simplification and is told nothing of how it came about. Unlike the rest of ingest it holds tables of
//! the whole model: [`Rules::bytes_per_vertex`].

use glam::DVec3;

use super::assembly::blocks_from_the_end;
use super::bounds::{Normals, Sphere};
use super::{CollapseRecord, NONE, Simplified};
use crate::ingest::spill::{Spill, SpillError, Workspace};
use crate::pack::record::{Bounds, Cone, Magnitude, VERTEX_OPS};

/// What an op waits for in a view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Dependencies {
    /// The ops that made the faces on either side of its cut (Hoppe 1997), at most three.
    #[default]
    Faces,
    /// The last ops on all vertices of those faces (Southern 2001, figure 5.3), at most seven.
    Vertices,
}

/// What a visibility sphere bounds besides the op's own region.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Spheres {
    /// The ops that descend from it in the vertex forest.
    #[default]
    Forest,
    /// All ops that wait for it, directly or not (Southern 2001, section 5.1.2).
    Dag,
}

/// How the error of an op is measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ErrorRule {
    /// How far the original surface lies from the collapsed one.
    #[default]
    Deviation,
    /// The distance between the vertex that goes and the one that stays (Southern 2001, section 5.1.1).
    Edge,
}

/// The rules of a model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Rules {
    /// What an op waits for.
    pub dependencies: Dependencies,
    /// What spheres bound.
    pub spheres: Spheres,
    /// What errors are.
    pub error: ErrorRule,
}

impl Rules {
    /// All rules of the paper.
    pub const PAPER: Self =
        Self { dependencies: Dependencies::Vertices, spheres: Spheres::Dag, error: ErrorRule::Edge };

    /// Memory that these rules take during ingest, beside what the default takes.
    pub fn bytes_per_vertex(&self) -> u64 {
        let vertices = if self.dependencies == Dependencies::Vertices { 24 + 24 + 8 } else { 0 };
        let spheres = if self.spheres == Spheres::Dag { 8 + 12 + 160 } else { 0 };
        vertices + spheres
    }
}

/// Makes a simplification follow `rules`; what they say of errors was seen to while it was made. `faces` are those of the
/// complete mesh, by vertices below `vertices`.
pub(crate) fn follow(
    rules: &Rules,
    simplified: Simplified,
    faces: &Spill<[u32; 3]>,
    vertices: usize,
    workspace: &Workspace,
) -> Result<Simplified, SpillError> {
    let Simplified { mut collapses, mut root_vertices, root_faces, .. } = simplified;
    let vertex_ops = match rules.dependencies {
        Dependencies::Faces => None,
        Dependencies::Vertices => Some(last_ops(&collapses, neighbours(&collapses, faces, vertices)?, vertices)?),
    };
    if rules.spheres == Spheres::Dag {
        let parents = parents(&collapses, faces.len() as usize)?;
        let nested = Nested::new(&collapses, &parents, vertex_ops.as_deref())?;
        let mut moved = workspace.spill();
        let mut block = Vec::new();
        for first in (0..collapses.len()).step_by(BLOCK as usize) {
            collapses.read_into(first..collapses.len().min(first + BLOCK), &mut block)?;
            for (collapse, &bounds) in block.iter_mut().zip(&nested.bounds[first as usize..]) {
                *collapse = collapse.with_bounds(bounds);
            }
            moved.push(&block)?;
        }
        collapses = moved.finish()?;
        for root in root_vertices.iter_mut().filter(|root| root.last != NONE) {
            root.stored = nested.bounds[root.last as usize];
            root.normals = root.normals.union(nested.regions[root.last as usize].1);
        }
    }
    Ok(Simplified { collapses, vertex_ops, root_vertices, root_faces })
}

/// Per collapse, the vertices besides `s` and `t` of its faces and of those beside them, or [`NONE`]: `l`, `r` and the far
/// corners of `fn0 .. fn3`, by the numbers that they have then. A corner of the complete mesh has become the vertex that the
/// collapses so far lead to from it.
fn neighbours(
    collapses: &Spill<CollapseRecord>,
    faces: &Spill<[u32; 3]>,
    vertices: usize,
) -> Result<Vec<[u32; VERTEX_OPS]>, SpillError> {
    let corners = faces.read(0..faces.len())?;
    let mut kept: Vec<u32> = (0..vertices as u32).collect();
    let mut of_ops = Vec::with_capacity(collapses.len() as usize);
    collapses.for_each_block(|_, block| {
        for collapse in block {
            let mut far = |h: u32| match h {
                NONE => NONE,
                _ => vertex_now(&mut kept, corners[h as usize / 3][(h as usize + 2) % 3]),
            };
            let [fn0, fn1, fn2, fn3] = collapse.outer;
            of_ops.push([collapse.left, collapse.right, fn0, fn1, fn2, fn3].map(&mut far));
            kept[collapse.t as usize] = collapse.s;
        }
    })?;
    Ok(of_ops)
}

/// The vertex that `v` has become, halving the way there.
fn vertex_now(kept: &mut [u32], mut v: u32) -> u32 {
    while kept[v as usize] != v {
        kept[v as usize] = kept[kept[v as usize] as usize];
        v = kept[v as usize];
    }
    v
}

/// Replaces vertices by the op on them that comes last before an op in the order of refinement, which is the next one in that of
/// simplification; [`NONE`] for vertices that are there from the start.
fn last_ops(
    collapses: &Spill<CollapseRecord>,
    mut neighbours: Vec<[u32; VERTEX_OPS]>,
    vertices: usize,
) -> Result<Vec<[u32; VERTEX_OPS]>, SpillError> {
    let mut last = vec![NONE; vertices];
    let mut block = Vec::new();
    for range in blocks_from_the_end(collapses.len(), BLOCK) {
        collapses.read_into(range.clone(), &mut block)?;
        for (op, collapse) in (0..range.end as u32).rev().zip(block.iter().rev()) {
            for vertex in neighbours[op as usize].iter_mut().filter(|vertex| **vertex != NONE) {
                *vertex = last[*vertex as usize];
            }
            last[collapse.s as usize] = op;
            last[collapse.t as usize] = op;
        }
    }
    Ok(neighbours)
}

/// Collapses that are looked at together.
const BLOCK: u64 = 1 << 16;

/// Per collapse, its parents under the rule of faces: tree parent, owners of the younger faces beside both cuts.
fn parents(collapses: &Spill<CollapseRecord>, faces: usize) -> Result<Vec<[u32; 3]>, SpillError> {
    let mut removed_by = vec![NONE; faces];
    let mut parents = vec![[NONE; 3]; collapses.len() as usize];
    collapses.for_each_block(|first, block| {
        for (op, collapse) in (first as u32..).zip(block) {
            for child in [collapse.next_of_s, collapse.first_of_t] {
                if let Some(parents) = parents.get_mut(child as usize) {
                    parents[0] = op;
                }
            }
            for h in [collapse.left, collapse.right] {
                if let Some(remover) = removed_by.get_mut(h as usize / 3) {
                    *remover = op;
                }
            }
        }
    })?;
    collapses.for_each_block(|first, block| {
        for (op, collapse) in (first as usize..).zip(block) {
            // `NONE` is the largest number: faces that are never removed are oldest, those that are not there do not count.
            let owner = |h: u32| removed_by.get(h as usize / 3).copied().unwrap_or(NONE);
            let [fn0, fn1, fn2, fn3] = collapse.outer.map(owner);
            parents[op][1] = fn0.min(fn1);
            parents[op][2] = fn2.min(fn3);
        }
    })?;
    Ok(parents)
}

/// Bounds over all ops that wait for an op. An op waits only for later collapses, so a walk in the order of simplification comes
/// to an op when all that wait for it are done.
struct Nested {
    /// Exact unions: sphere and normals.
    regions: Vec<(Sphere, Normals)>,
    bounds: Vec<Bounds>,
}

impl Nested {
    fn new(
        collapses: &Spill<CollapseRecord>,
        parents: &[[u32; 3]],
        vertex_ops: Option<&[[u32; VERTEX_OPS]]>,
    ) -> Result<Self, SpillError> {
        let mut bounds = Vec::with_capacity(parents.len());
        collapses.for_each_block(|_, block| {
            bounds.extend(block.iter().map(CollapseRecord::bounds));
        })?;
        let waits_for = |op: usize| {
            let others = vertex_ops.map(|ops| ops[op]).into_iter().flatten();
            parents[op].into_iter().chain(others).filter(|&parent| parent != NONE)
        };
        let mut regions: Vec<(Sphere, Normals)> = bounds.iter().map(region_of).collect();
        for op in 0..regions.len() {
            let (sphere, normals) = regions[op];
            for parent in waits_for(op) {
                let region = &mut regions[parent as usize];
                *region = (region.0.union(sphere), region.1.union(normals));
            }
        }
        // As stored: about the rounded centre and axis of the exact union, wide enough for what the children store.
        let mut reaches: Vec<f64> = Vec::with_capacity(bounds.len());
        for (bounds, (sphere, normals)) in bounds.iter_mut().zip(&regions) {
            let own = *bounds;
            let center = sphere.center.round();
            bounds.center = center.to_array().map(|x| x as i32);
            reaches.push(own.reach_from(center).max(center.distance(sphere.center) + sphere.radius));
            bounds.cone = match (normals, own.cone.wide()) {
                (Normals::Within(exact), Some(wide)) => Cone::cover(exact.axis, &[*exact, wide]),
                _ => Cone::ANY,
            };
        }
        for op in 0..bounds.len() {
            bounds[op].radius = Magnitude::encode_up(reaches[op]);
            let child = bounds[op];
            for parent in waits_for(op) {
                let (parent, reach) = (&mut bounds[parent as usize], &mut reaches[parent as usize]);
                *reach = reach.max(child.reach_from(DVec3::from_array(parent.center.map(f64::from))));
                parent.error = parent.error.max(child.error);
                parent.cone = match (parent.cone.wide(), child.cone.wide()) {
                    (Some(own), Some(part)) => Cone::cover_about(parent.cone.axis, &[own, part]),
                    _ => Cone::ANY,
                };
            }
        }
        Ok(Self { regions, bounds })
    }
}

fn region_of(bounds: &Bounds) -> (Sphere, Normals) {
    let sphere = Sphere { center: bounds.center_f64(), radius: bounds.radius.decode().into() };
    (sphere, bounds.cone.wide().map_or(Normals::Any, Normals::Within))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::ingest::partition::{PartitionOptions, partition};
    use crate::ingest::raw::RawMesh;
    use crate::ingest::simplify::{BuildOptions, simplify};
    use crate::ingest::{Precision, ingest_to_vec};
    use crate::mesh::TriMesh;
    use crate::pack::{Metadata, PackedModel, verify};

    /// A bumpy sheet with a border, not so regular that all choices are ties.
    fn sheet(side: u32) -> TriMesh {
        let mut rng = fastrand::Rng::with_seed(5);
        let mut mesh = TriMesh::default();
        for y in 0..side {
            for x in 0..side {
                mesh.positions.push([f64::from(x) + 0.3 * rng.f64(), f64::from(y), 2.0 * rng.f64()]);
            }
        }
        for y in 1..side {
            for x in 1..side {
                let d = y * side + x;
                let (a, b, c) = (d - side - 1, d - side, d - 1);
                mesh.faces.extend([[a, b, d], [a, d, c]]);
            }
        }
        mesh
    }

    /// The dull twin: replaces corners one collapse after the other and searches for the next op on each vertex.
    fn last_ops_by_search(collapses: &[CollapseRecord], mut corners: Vec<[u32; 3]>) -> Vec<[u32; VERTEX_OPS]> {
        let mut of_ops = Vec::new();
        for (op, collapse) in collapses.iter().enumerate() {
            let next_on = |v: u32| {
                let later = collapses.iter().enumerate().skip(op + 1);
                later.into_iter().find(|(_, c)| c.s == v || c.t == v).map_or(NONE, |(op, _)| op as u32)
            };
            let [fn0, fn1, fn2, fn3] = collapse.outer;
            of_ops.push([collapse.left, collapse.right, fn0, fn1, fn2, fn3].map(|h| match h {
                NONE => NONE,
                _ => next_on(corners[h as usize / 3][(h as usize + 2) % 3]),
            }));
            for corner in corners.as_flattened_mut() {
                if *corner == collapse.t {
                    *corner = collapse.s;
                }
            }
        }
        of_ops
    }

    #[test]
    fn ops_on_vertices_are_those_that_a_search_finds() {
        let workspace = Workspace::in_memory();
        let raw = RawMesh::of(&sheet(16), &workspace).unwrap();
        let options = PartitionOptions::new(Some(12), 0.0, Precision::Exact);
        let (mesh, _) = partition(raw, &options, &workspace, &mut |_| {}).unwrap();
        let (simplified, _) = simplify(&mesh, BuildOptions::default().method(4095), &workspace, 1, &|_| {}).unwrap();
        let collapses = simplified.collapses.read(0..simplified.collapses.len()).unwrap();
        let corners = mesh.faces.read(0..mesh.faces.len()).unwrap();
        assert!(collapses.len() > 150);
        let rules = Rules { dependencies: Dependencies::Vertices, ..Rules::default() };
        let followed = follow(&rules, simplified, &mesh.faces, mesh.vertices.len(), &workspace).unwrap();
        let vertex_ops = followed.vertex_ops.unwrap();
        assert_eq!(vertex_ops, last_ops_by_search(&collapses, corners));
        let most = vertex_ops.iter().map(|ops| ops.iter().filter(|&&op| op != NONE).count()).max();
        assert!(most >= Some(5), "{most:?}");
    }

    fn model(rules: Rules) -> (PackedModel, Vec<u8>) {
        let options = BuildOptions { bits: Some(12), rules, ..BuildOptions::default() };
        let (bytes, ..) = ingest_to_vec(&sheet(24), &options, &Metadata::default()).unwrap();
        (PackedModel::open(Arc::new(bytes.clone())).unwrap(), bytes)
    }

    #[test]
    fn nested_bounds_contain_those_of_all_that_wait() {
        for dependencies in [Dependencies::Faces, Dependencies::Vertices] {
            let rules = Rules { dependencies, spheres: Spheres::Dag, ..Rules::default() };
            let (nested, bytes) = model(rules);
            verify(Arc::new(bytes)).unwrap();
            let (forest, _) = model(Rules { spheres: Spheres::Forest, ..rules });
            let escapes = |model: &PackedModel| {
                let ops = model.spawn_count()..model.op_count();
                let escapes = ops.flat_map(|op| {
                    let child = model.bounds(op).unwrap();
                    let first = model.prerequisites(op).unwrap();
                    let escapes = |&&parent: &&u32| !model.bounds(parent).unwrap().contains(&child);
                    vec![op; first.as_slice().iter().filter(escapes).count()]
                });
                escapes.count()
            };
            assert_eq!(escapes(&nested), 0);
            assert!(escapes(&forest) > 100, "the forest's bounds should not do");
        }
    }

    #[test]
    fn an_edge_rule_stores_at_least_the_length_of_the_edge() {
        let (edge, _) = model(Rules { error: ErrorRule::Edge, ..Rules::default() });
        let (deviation, _) = model(Rules::default());
        let sum = |model: &PackedModel| -> f64 {
            (0..model.op_count()).map(|op| f64::from(model.bounds(op).unwrap().error.decode())).sum()
        };
        assert!(sum(&edge) > 1.5 * sum(&deviation), "{} {}", sum(&edge), sum(&deviation));
        // The last ops touch nothing that was refined: their error is their edge, between lattice points.
        let leaves = (edge.spawn_count()..edge.op_count()).filter(|&op| {
            let children = edge.children(op).unwrap();
            children.iter().all(|&child| child == crate::pack::record::NO_OP)
        });
        assert!(leaves.into_iter().all(|op| edge.bounds(op).unwrap().error.decode() >= 1.0));
    }
}
