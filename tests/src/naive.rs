//! Dull twins of what needs both ends: the set that a view asks for by a full sort, and the mesh of a set of ops by its
//! definition instead of by applying ops.

use std::collections::{BTreeMap, BTreeSet};

use lodestream_protocol::ids::VertexSlot;
use lodestream_protocol::mesh::{Fan, NewVertex, Replica};
use lodestream_protocol::view::View;
use lodestream_server::pack::PackedModel;
use lodestream_server::pack::place::Place;
use lodestream_server::pack::record::CutRef;
use lodestream_server::session::score::Scorer;

use crate::model::{LatticeTriangle, canonical};

/// A vertex by what made it: the base, or a spawn or split.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum VertexKey {
    /// Vertex of the base.
    Base(u32),
    /// Vertex `.1` of spawn `.0`.
    Spawned(u32, u32),
    /// The vertex that a split inserted.
    Split(u32),
}

/// A face by what made it.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum FaceKey {
    /// Face of the base.
    Base(u32),
    /// Face `.1` of spawn `.0`.
    Spawned(u32, u32),
    /// `f_l` (0) or `f_r` (1) of a split.
    Split(u32, u32),
}

/// A mesh with every slot replaced by what made it.
pub type KeyedMesh = BTreeMap<FaceKey, [VertexKey; 3]>;

/// A replica and the ops applied to it, one at a time, by id.
#[derive(Debug)]
pub struct Walker<'a> {
    /// The model.
    pub model: &'a PackedModel,
    /// The mesh.
    pub replica: Replica,
    /// Address of each applied op.
    pub slots: BTreeMap<u32, u32>,
}

impl<'a> Walker<'a> {
    /// The base mesh.
    pub fn new(model: &'a PackedModel) -> Self {
        Self { model, replica: Replica::new(model.base()).expect("the base is a manifold"), slots: BTreeMap::new() }
    }

    /// Whether all parents of `op` are applied, and `op` is not.
    pub fn may_apply(&self, op: u32) -> bool {
        !self.slots.contains_key(&op) && parents(self.model, op).iter().all(|p| self.slots.contains_key(p))
    }

    /// Applies an op whose parents are applied.
    pub fn apply(&mut self, op: u32) {
        if op < self.model.spawn_count() {
            let patch = self.model.spawn_patch(op).unwrap();
            let slot = self.replica.spawn(op, &patch).expect("the patch is a manifold");
            self.slots.insert(op, slot.0);
            return;
        }
        let split = self.model.split(op).unwrap();
        let place = Place::find(self.model, &self.replica, |op| self.slots.get(&op).copied(), &split).unwrap();
        let place = place.expect("the parents are applied");
        let mut fan = Fan::default();
        self.replica.fan(place.s, &mut fan).unwrap();
        let cut = place.cut(&self.replica, &fan).expect("the cut edges are in the fan");
        let vertex = NewVertex {
            position: split.position,
            color: split.color,
            s_move: split.s_move,
            s_color_move: split.s_color_move,
        };
        let slot = self.replica.split(place.s, &fan, cut, &vertex).unwrap();
        self.slots.insert(op, slot.0);
    }

    /// Undoes an op, or says that it may not be undone.
    pub fn undo(&mut self, op: u32) -> bool {
        let slot = VertexSlot(self.slots[&op]);
        let done = if op < self.model.spawn_count() {
            self.replica.despawn(slot).is_ok()
        } else {
            self.replica.collapse(slot, &mut Vec::new()).is_ok()
        };
        if done {
            self.slots.remove(&op);
        }
        done
    }

    /// The mesh in terms of what made it.
    pub fn keyed(&self) -> KeyedMesh {
        let slots: Vec<(u32, u32)> = self.slots.iter().map(|(&op, &slot)| (op, slot)).collect();
        keyed(self.model, &self.replica, &slots)
    }
}

/// Parents of an op.
pub fn parents(model: &PackedModel, op: u32) -> Vec<u32> {
    if op < model.spawn_count() {
        return Vec::new();
    }
    let (parents, count) = model.parents(op).unwrap();
    parents[..count].to_vec()
}

/// Replaces the slots of a mesh by what made them, given the ops applied and their addresses.
pub fn keyed(model: &PackedModel, replica: &Replica, applied: &[(u32, u32)]) -> KeyedMesh {
    let mut vertices = BTreeMap::new();
    let mut faces = BTreeMap::new();
    for v in 0..model.base().positions.len() as u32 {
        vertices.insert(v, VertexKey::Base(v));
    }
    for f in 0..model.base().faces.len() as u32 {
        faces.insert(f, FaceKey::Base(f));
    }
    for &(op, slot) in applied {
        if op < model.spawn_count() {
            let patch = model.spawn_patch(op).unwrap();
            let slots = replica.spawn_slots(VertexSlot(slot)).expect("the spawn is applied");
            for j in 0..patch.positions.len() as u32 {
                vertices.insert(slots[j as usize], VertexKey::Spawned(op, j));
            }
            for j in 0..patch.faces.len() as u32 {
                faces.insert(2 * slots[(j / 2) as usize] + j % 2, FaceKey::Spawned(op, j));
            }
        } else {
            vertices.insert(slot, VertexKey::Split(op));
            faces.insert(2 * slot, FaceKey::Split(op, 0));
            faces.insert(2 * slot + 1, FaceKey::Split(op, 1));
        }
    }
    let live = (0..).zip(replica.corners()).filter(|(_, c)| *c != [0; 3]);
    live.map(|(f, corners): (u32, _)| (faces[&f], corners.map(|c| vertices[&c]))).collect()
}

/// The complete mesh, from which the mesh of any closed set follows by definition.
#[derive(Debug)]
pub struct CompleteMesh {
    faces: KeyedMesh,
    /// The vertex that each split splits.
    split_from: BTreeMap<u32, VertexKey>,
}

impl CompleteMesh {
    /// Applies every op once.
    pub fn new(model: &PackedModel) -> (Self, Vec<LatticeTriangle>) {
        let mut walker = Walker::new(model);
        let mut split_from = BTreeMap::new();
        for op in legal_order(model) {
            walker.apply(op);
            if op >= model.spawn_count() {
                let split = model.split(op).unwrap();
                let is_root = split.tree_parent == u32::MAX || split.tree_parent < model.spawn_count();
                let s = if is_root {
                    match model.root_vertex(split.s).unwrap() {
                        (None, v) => VertexKey::Base(v),
                        (Some(spawn), v) => VertexKey::Spawned(spawn, v),
                    }
                } else if split.s == 1 {
                    VertexKey::Split(split.tree_parent)
                } else {
                    split_from[&split.tree_parent]
                };
                split_from.insert(op, s);
            }
        }
        let triangles = triangles(&walker.replica);
        (Self { faces: walker.keyed(), split_from }, triangles)
    }

    /// The mesh of a set of ops closed under parents: the faces that its ops made, each corner being the nearest vertex that
    /// exists, going up the vertex forest from the corner of the complete mesh (ALGORITHMS, theorem T2).
    pub fn mesh_of(&self, ops: &BTreeSet<u32>) -> KeyedMesh {
        let exists = |key: VertexKey| match key {
            VertexKey::Base(_) => true,
            VertexKey::Spawned(op, _) | VertexKey::Split(op) => ops.contains(&op),
        };
        let ancestor = |mut key: VertexKey| {
            while !exists(key) {
                let VertexKey::Split(op) = key else { panic!("the set is not closed") };
                key = self.split_from[&op];
            }
            key
        };
        let present = |face: &FaceKey| match *face {
            FaceKey::Base(_) => true,
            FaceKey::Spawned(op, _) | FaceKey::Split(op, _) => ops.contains(&op),
        };
        let faces = self.faces.iter().filter(|(face, _)| present(face));
        faces.map(|(&face, corners)| (face, corners.map(ancestor))).collect()
    }
}

/// All ops, parents before children.
pub fn legal_order(model: &PackedModel) -> Vec<u32> {
    let mut order = Vec::new();
    let mut done = BTreeSet::new();
    for op in 0..model.op_count() {
        let mut stack = vec![op];
        while let Some(&op) = stack.last() {
            let missing: Vec<u32> = parents(model, op).into_iter().filter(|p| !done.contains(p)).collect();
            if missing.is_empty() {
                stack.pop();
                if done.insert(op) {
                    order.push(op);
                }
            } else {
                stack.extend(missing);
            }
        }
    }
    order
}

/// A mesh as a sorted multiset of lattice triangles.
pub fn triangles(replica: &Replica) -> Vec<LatticeTriangle> {
    let live = replica.corners().filter(|c| *c != [0; 3]);
    let mut triangles: Vec<LatticeTriangle> =
        live.map(|c| canonical(c.map(|v| replica.positions()[v as usize]))).collect();
    triangles.sort_unstable();
    triangles
}

/// Triangles that an op adds.
pub fn triangles_of(model: &PackedModel, op: u32) -> u32 {
    if op < model.spawn_count() {
        return model.spawn_patch(op).unwrap().faces.len() as u32;
    }
    let split = model.split(op).unwrap();
    [split.left, split.right].iter().map(|cut| u32::from(*cut != CutRef::None)).sum()
}

/// The ops that a view asks for, by judging and sorting all of them: priority descending, id ascending, each with its missing
/// parents; the first that does not fit goes in as far as it fits and ends it; one whose spawn does not fit is skipped.
pub fn ops_for_view(model: &PackedModel, view: &View) -> BTreeSet<u32> {
    let scorer = Scorer::new(view, model.info());
    let mut wanted: Vec<(f32, u32)> = (0..model.op_count())
        .map(|op| (scorer.priority(&model.bounds(op).unwrap()), op))
        .filter(|&(priority, _)| view.complete || priority > view.tolerance_px)
        .collect();
    wanted.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut set = BTreeSet::new();
    let mut triangles = model.base().faces.len() as u32;
    'ops: for (_, op) in wanted {
        let mut closure = Vec::new();
        parents_first(model, op, &set, &mut closure);
        for op in closure {
            let after = triangles.saturating_add(triangles_of(model, op));
            if after > view.triangle_limit {
                if op < model.spawn_count() {
                    continue 'ops;
                }
                break 'ops;
            }
            triangles = after;
            set.insert(op);
        }
    }
    set
}

fn parents_first(model: &PackedModel, op: u32, present: &BTreeSet<u32>, out: &mut Vec<u32>) {
    if present.contains(&op) || out.contains(&op) {
        return;
    }
    for &first in model.prerequisites(op).unwrap().as_slice() {
        parents_first(model, first, present, out);
    }
    out.push(op);
}
