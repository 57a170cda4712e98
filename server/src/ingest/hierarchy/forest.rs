//! From collapses to the records of a [`Dag`]: final ids, tree parents, cut references, base and spawns.

use lodestream_protocol::op::canonical_order;
use lodestream_protocol::quant::Lattice;

use super::{
    Collapse, NONE, Point,
    assembly::Shape,
    bounds::{Carried, whole_component},
    components::Components,
    order::error_band,
};
use crate::mesh::morton::morton;
use crate::pack::record::{Bounds, CutRef, Dag, NO_OP, Patch, SpawnRecord, SplitRecord, VERTEX_OPS};

/// A finished simplification.
#[derive(Debug)]
pub(crate) struct InCore<'a> {
    pub(crate) lattice: Lattice,
    pub(crate) has_colors: bool,
    pub(crate) is_open: bool,
    /// Per vertex, where it was when it went or is now.
    pub(crate) points: &'a [Point],
    pub(crate) components: &'a Components,
    /// Faces that are left: number in the complete mesh, ascending, and corners in their own order.
    pub(crate) root_faces: &'a [(u32, [u32; 3])],
    /// In the order of simplification.
    pub(crate) collapses: &'a [Collapse],
    /// Per vertex, as left by its last collapse.
    pub(crate) carried: &'a [Carried],
    /// Per face, the number of the collapse that removed it, or [`NONE`].
    pub(crate) removed_by: &'a [u32],
}

/// Builds the records. O(n log n) in the collapses, for their final order.
pub(crate) fn assemble(simplified: &InCore) -> (Dag, Shape) {
    let roots = Roots::new(simplified);
    let tree = Tree::new(simplified);
    let order = tree.order(simplified);
    let spawn_count = roots.spawns.len() as u32;
    let mut ids = vec![0u32; order.len()];
    for (place, &op) in order.iter().enumerate() {
        ids[op as usize] = spawn_count + place as u32;
    }
    let converter = Converter { simplified, roots: &roots, tree: &tree, ids: &ids };
    let shape = converter.shape();
    let splits = order.iter().map(|&op| converter.split(op)).collect();
    let base = converter.patch(&roots.base);
    let spawns =
        roots.spawns.iter().map(|&(component, bounds)| SpawnRecord { bounds, patch: converter.patch(&[component]) });
    let spawns = spawns.collect();
    let InCore { lattice, has_colors, is_open, .. } = *simplified;
    (Dag { lattice, has_colors, is_open, by_vertices: false, base, spawns, splits }, shape)
}

/// Numbers of root vertices and faces, and who brings them.
struct Roots {
    base: Vec<u32>,
    /// Component and bounds, by error descending, then by diagonal.
    spawns: Vec<(u32, Bounds)>,
    /// Spawn id of each component, or [`NONE`] for those of the base.
    spawn_of: Vec<u32>,
    /// Per component, indices into the root faces.
    faces_of: Vec<Vec<u32>>,
    /// Per vertex of the complete mesh, its root number.
    vertex_numbers: Vec<u32>,
    /// Per component, its root vertices in order.
    vertices_of: Vec<Vec<u32>>,
    /// Per face of the complete mesh, its root number.
    face_numbers: Vec<u32>,
    /// Per face of the complete mesh, which corner is stored first.
    face_firsts: Vec<u8>,
}

impl Roots {
    fn new(simplified: &InCore) -> Self {
        let components = simplified.components;
        let mut faces_of = vec![Vec::new(); components.count()];
        let mut vertices_of = vec![Vec::new(); components.count()];
        let mut vertex_numbers = vec![NONE; simplified.points.len()];
        for (i, (_, corners)) in simplified.root_faces.iter().enumerate() {
            let component = components.of_vertex[corners[0] as usize] as usize;
            faces_of[component].push(i as u32);
            for &v in corners {
                if vertex_numbers[v as usize] == NONE {
                    vertex_numbers[v as usize] = 0;
                    vertices_of[component].push(v);
                }
            }
        }
        let triangles: Vec<usize> = faces_of.iter().map(Vec::len).collect();
        let (base, spawned) = components.base_and_spawns(&triangles);
        let mut spawns: Vec<(u32, Bounds)> = spawned
            .into_iter()
            .map(|component| {
                (
                    component,
                    spawn_bounds(
                        simplified,
                        component,
                        &faces_of[component as usize],
                        &vertices_of[component as usize],
                    ),
                )
            })
            .collect();
        spawns.sort_by_key(|&(_, bounds)| std::cmp::Reverse(bounds.error));
        let mut face_firsts = vec![0; simplified.removed_by.len()];
        for (vertices, faces) in vertices_of.iter_mut().zip(&mut faces_of) {
            let index_of = |v: u32| vertices.iter().position(|&w| w == v).expect("a vertex of the component") as u32;
            let points = vertices.iter().map(|&v| &simplified.points[v as usize]);
            let patch = lodestream_protocol::mesh::Patch {
                positions: points.clone().map(|point| point.position).collect(),
                colors: points.map(|point| point.color).collect(),
                faces: faces.iter().map(|&i| simplified.root_faces[i as usize].1.map(index_of)).collect(),
            };
            let Some(order) = canonical_order(&patch) else { continue };
            *vertices = order.vertices.iter().map(|&v| vertices[v as usize]).collect();
            *faces = order.faces.iter().map(|&(f, _)| faces[f as usize]).collect();
            for (&i, &(_, first)) in faces.iter().zip(&order.faces) {
                face_firsts[simplified.root_faces[i as usize].0 as usize] = first;
            }
        }
        let mut spawn_of = vec![NONE; components.count()];
        let mut face_numbers = vec![NONE; simplified.removed_by.len()];
        let (mut vertex, mut face) = (0, 0);
        for (spawn, component) in
            base.iter().map(|&c| (NONE, c)).chain(spawns.iter().enumerate().map(|(i, &(c, _))| (i as u32, c)))
        {
            spawn_of[component as usize] = spawn;
            for &v in &vertices_of[component as usize] {
                vertex_numbers[v as usize] = vertex;
                vertex += 1;
            }
            for &i in &faces_of[component as usize] {
                face_numbers[simplified.root_faces[i as usize].0 as usize] = face;
                face += 1;
            }
        }
        Self { base, spawns, spawn_of, faces_of, vertex_numbers, vertices_of, face_numbers, face_firsts }
    }
}

fn spawn_bounds(simplified: &InCore, component: u32, faces: &[u32], vertices: &[u32]) -> Bounds {
    let face_normals: Vec<_> = faces
        .iter()
        .map(|&i| {
            let [a, b, c] = simplified.root_faces[i as usize].1.map(|v| simplified.points[v as usize].at());
            (b - a).cross(c - a)
        })
        .collect();
    let vertices: Vec<_> = vertices
        .iter()
        .map(|&v| (&simplified.points[v as usize], &simplified.carried[v as usize]))
        .map(|(point, carried)| (point.at(), carried.normals, carried.child().copied()))
        .collect();
    whole_component(simplified.components.boxes[component as usize], &face_normals, &vertices)
}

/// The vertex forest over the collapses.
struct Tree {
    /// Tree parent of each collapse, and whether its `s` is the parent's `s` (0) or `t` (1).
    parents: Vec<(u32, u32)>,
}

impl Tree {
    fn new(simplified: &InCore) -> Self {
        let mut parents = vec![(NONE, 0); simplified.collapses.len()];
        for (op, collapse) in simplified.collapses.iter().enumerate() {
            for (child, role) in [(collapse.next_of_s, 0), (collapse.first_of_t, 1)] {
                if child != NONE {
                    parents[child as usize] = (op as u32, role);
                }
            }
        }
        Self { parents }
    }

    /// The collapses in the order of their final ids: by error band descending, then by where the band's topmost ancestor
    /// lies, then in the order of refinement. A parent precedes its children: it has no smaller error, and within a band both
    /// have the same topmost ancestor.
    fn order(&self, simplified: &InCore) -> Vec<u32> {
        let collapses = simplified.collapses;
        let mut codes = vec![0u64; collapses.len()];
        let mut keys = Vec::with_capacity(collapses.len());
        for op in (0..collapses.len()).rev() {
            let bounds = &collapses[op].bounds;
            let band = error_band(bounds.error);
            let parent = self.parents[op].0;
            codes[op] = if parent != NONE && error_band(collapses[parent as usize].bounds.error) == band {
                codes[parent as usize]
            } else {
                morton(bounds.center, simplified.lattice.max_coordinate())
            };
            keys.push((u8::MAX - band, codes[op], u32::MAX - op as u32));
        }
        keys.sort_unstable();
        keys.into_iter().map(|(.., op)| u32::MAX - op).collect()
    }
}

struct Converter<'a> {
    simplified: &'a InCore<'a>,
    roots: &'a Roots,
    tree: &'a Tree,
    /// Final id of each collapse.
    ids: &'a [u32],
}

impl Converter<'_> {
    fn split(&self, op: u32) -> SplitRecord {
        let collapse = &self.simplified.collapses[op as usize];
        let point = &self.simplified.points[collapse.t as usize];
        let id = |op: u32| if op == NONE { NO_OP } else { self.ids[op as usize] };
        let (parent, role) = self.tree.parents[op as usize];
        let (tree_parent, s) = if parent == NONE {
            let component = self.simplified.components.of_vertex[collapse.s as usize];
            (self.roots.spawn_of[component as usize], self.roots.vertex_numbers[collapse.s as usize])
        } else {
            (self.ids[parent as usize], role)
        };
        let [left, right] = cuts(collapse);
        SplitRecord {
            bounds: collapse.bounds,
            tree_parent,
            s,
            left: self.cut_ref(left),
            right: self.cut_ref(right),
            next_of_s: id(collapse.next_of_s),
            first_of_t: id(collapse.first_of_t),
            position: point.position,
            color: point.color,
            s_move: collapse.s_move,
            s_color_move: collapse.s_color_move,
            vertex_ops: [NO_OP; VERTEX_OPS],
        }
    }

    /// The younger of the two faces beside a cut: the one that was removed first. Those that were never removed are oldest.
    fn younger(&self, cut: Cut) -> Option<u32> {
        let age = |h: u32| self.simplified.removed_by[h as usize / 3];
        match cut {
            [NONE, NONE] => None,
            [h, NONE] | [NONE, h] => Some(h),
            [a, b] => Some(if age(b) < age(a) { b } else { a }),
        }
    }

    fn cut_ref(&self, cut: Cut) -> CutRef {
        let Some(h) = self.younger(cut) else { return CutRef::None };
        let (face, corner) = (h / 3, h % 3);
        let op = self.simplified.removed_by[face as usize];
        if op == NONE {
            let first = u32::from(self.roots.face_firsts[face as usize]);
            let edge = ((corner + 3 - first) % 3) as u8;
            return CutRef::Root { face: self.roots.face_numbers[face as usize], edge };
        }
        let owner = &self.simplified.collapses[op as usize];
        let (side, first) =
            if owner.left != NONE && owner.left / 3 == face { (0, owner.left) } else { (1, owner.right) };
        // Stored corners start at `s` of `f_l` and at `t` of `f_r`, where `left` and `right` start.
        CutRef::Split { op: self.ids[op as usize], side, edge: ((corner + 3 - first % 3) % 3) as u8 }
    }

    /// Depth and numbers of parents, in one walk from the coarse end.
    fn shape(&self) -> Shape {
        let mut shape = Shape { base_components: self.roots.base.len(), ..Shape::default() };
        let mut depths = vec![0u32; self.simplified.collapses.len()];
        for op in (0..depths.len()).rev() {
            let collapse = &self.simplified.collapses[op];
            let component = self.simplified.components.of_vertex[collapse.s as usize];
            // `NONE - 1` stands for the component's spawn, which is no collapse.
            let root = if self.roots.spawn_of[component as usize] == NONE { NONE } else { NONE - 1 };
            let owner = |cut| {
                self.younger(cut).map_or(NONE, |h| match self.simplified.removed_by[h as usize / 3] {
                    NONE => root,
                    op => op,
                })
            };
            let tree = match self.tree.parents[op].0 {
                NONE => root,
                parent => parent,
            };
            let [left, right] = cuts(collapse).map(owner);
            let parents = [tree, left, right];
            let mut distinct = 0;
            for (i, &parent) in parents.iter().enumerate() {
                if parent == NONE {
                    continue;
                }
                distinct += usize::from(!parents[..i].contains(&parent));
                let above = depths.get(parent as usize).copied().unwrap_or(1);
                depths[op] = depths[op].max(above);
            }
            depths[op] += 1;
            shape.parents[distinct] += 1;
            shape.depth = shape.depth.max(depths[op]);
        }
        shape
    }

    fn patch(&self, components: &[u32]) -> Patch {
        let mut patch = Patch::default();
        let first = components.iter().find_map(|&c| self.roots.vertices_of[c as usize].first());
        let offset = first.map_or(0, |&v| self.roots.vertex_numbers[v as usize]);
        for &component in components {
            for &v in &self.roots.vertices_of[component as usize] {
                let point = &self.simplified.points[v as usize];
                patch.positions.push(point.position);
                patch.colors.push(point.color);
                let last = self.simplified.carried[v as usize].last;
                patch.first_splits.push(if last == NONE { NO_OP } else { self.ids[last as usize] });
            }
            for &i in &self.roots.faces_of[component as usize] {
                let (face, mut corners) = self.simplified.root_faces[i as usize];
                corners.rotate_left(self.roots.face_firsts[face as usize].into());
                patch.faces.push(corners.map(|v| self.roots.vertex_numbers[v as usize] - offset));
            }
        }
        patch
    }
}

/// The two half-edges beside a cut, on the side of `s` first.
type Cut = [u32; 2];

fn cuts(collapse: &Collapse) -> [Cut; 2] {
    let [fn0, fn1, fn2, fn3] = collapse.outer;
    [[fn0, fn1], [fn3, fn2]]
}
