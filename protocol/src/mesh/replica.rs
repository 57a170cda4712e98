//! The replica: the triangle mesh that the ops produce.
//!
//! Connectivity is kept as corners and twin half-edges per face, so an op finds everything it needs in the one-ring of one
//! vertex. What an op depends on is kept as reference counts that both ends infer from the mesh alone
//! (`PROTOCOL.md`, "The replica").

use std::collections::BTreeMap;

use super::bits::SlotSet;
use super::digest::{face_hash, vertex_hash};
use super::dirty::DirtySlots;
use super::fan::{Cut, Fan};
use super::growth::{and_a_sixteenth, reserve_a_sixteenth};
use super::patch::{HalfEdge, NO_HALF_EDGE, Patch, PatchError};
use super::references::References;
use crate::ids::{FaceSlot, VertexSlot};
use crate::limits::MAX_VERTEX_SLOTS;

const NONE: u32 = u32::MAX;
/// Tag of [`Replica::origin`] for a slot that a spawn took; the low bits are the spawn's address.
const SPAWNED: u32 = 1 << 31;
/// A face slot that holds no face. Degenerate, so it may be drawn as it is.
const NO_FACE: [u32; 3] = [0; 3];

/// Geometry of a split: the vertex it inserts and what it does to `s`.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct NewVertex {
    /// Lattice position of the new vertex.
    pub position: [i32; 3],
    /// Its colour; zero for models without colours.
    pub color: [u8; 3],
    /// Displacement of `s`; zero for placements that keep it.
    pub s_move: [i32; 3],
    /// Colour change of `s` per channel, modulo 256.
    pub s_color_move: [u8; 3],
}

/// What a collapse took away: enough to split again.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct SplitUndo {
    /// The vertex that stays.
    pub s: VertexSlot,
    /// The geometry that the split had inserted.
    pub vertex: NewVertex,
    /// Left vertex at the time of the collapse, or [`VertexSlot::NONE`] without `f_l`.
    pub left: VertexSlot,
    /// Right vertex at the time of the collapse, or [`VertexSlot::NONE`] without `f_r`.
    pub right: VertexSlot,
}

/// Why an op did not fit. The two ends disagree then; the replica is unchanged by the refused op.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ApplyError {
    /// The slot holds no vertex.
    #[error("slot {0} holds no vertex")]
    NoVertex(u32),
    /// The cut does not open the fan into two.
    #[error("cut {cut:?} does not fit {faces} faces around slot {slot}")]
    BadCut {
        /// Vertex to split.
        slot: u32,
        /// Faces around it.
        faces: u32,
        /// The cut asked for.
        cut: Cut,
    },
    /// The op in this slot is base, or another applied op depends on it.
    #[error("the op in slot {0} may not collapse")]
    NotCollapsible(u32),
    /// More slots than the protocol has.
    #[error("out of vertex slots")]
    OutOfSlots,
    /// A spawned patch is no manifold.
    #[error(transparent)]
    Patch(#[from] PatchError),
    /// This spawn is there already.
    #[error("spawn {0} is applied already")]
    SpawnedTwice(u32),
}

#[derive(Clone, Debug)]
struct Spawn {
    id: u32,
    slots: Box<[u32]>,
    faces: u32,
}

#[derive(Clone, Copy, Default, Debug, PartialEq, Eq)]
struct Move {
    position: [i32; 3],
    color: [u8; 3],
}

/// What an op looks at of a vertex slot, next to each other since memory comes in lines.
#[derive(Clone, Copy, Debug)]
struct Op {
    /// `s` of the split that made the slot, `SPAWNED | address`, or `NONE` for base slots and free ones.
    origin: u32,
    /// Address of the last op on the vertex (its creation or last split), `NONE` for an untouched base vertex.
    last_op: u32,
    /// Any face slot around the vertex. A hint without meaning for the other end.
    some_face: u32,
}

/// A face: a walk from face to face reads both of each.
#[derive(Clone, Copy, Debug)]
struct Face {
    corners: [u32; 3],
    twins: [HalfEdge; 3],
}

/// The current mesh. See the module.
///
/// Memory: 80 bytes per slot and a few bits, plus 16 for models whose placement moves vertices, and at most a sixteenth more.
#[derive(Clone, Debug)]
pub struct Replica {
    /// One past the largest vertex slot ever used.
    slot_end: u32,
    // Per vertex slot, and room for as many more as a sixteenth.
    position: Vec<[i32; 3]>,
    color: Vec<[u8; 3]>,
    ops: Vec<Op>,
    /// `last_op` of `s` before the split that made this slot.
    prev_op: Vec<u32>,
    /// At op addresses: how many references applied ops hold.
    references: References,
    /// Displacements of `s`; as long as needed, empty for placements that keep `s`.
    moves: Vec<Move>,
    // Per face slot.
    faces: Vec<Face>,

    occupied: SlotSet,
    vertices: SlotSet,
    /// Addresses of ops without references: what may collapse.
    collapsible: SlotSet,
    spawns: BTreeMap<u32, Spawn>,
    spawned_ids: std::collections::BTreeSet<u32>,
    /// Slots that the spawns have, for accounting.
    spawned_slots: usize,
    base_slots: u32,
    base_faces: u32,
    triangles: u32,
    digest: u64,
    dirty: Option<DirtySlots>,
}

impl Replica {
    /// The mesh before any op. The base keeps the first `max(V, ceil(F / 2))` slots for ever.
    ///
    /// # Errors
    /// [`PatchError`] if the base is no oriented manifold.
    pub fn new(base: &Patch) -> Result<Self, PatchError> {
        let twins = base.validate()?;
        let (vertices, faces) = (base.positions.len() as u32, base.faces.len() as u32);
        let base_slots = vertices.max(faces.div_ceil(2));
        let mut replica = Self {
            slot_end: 0,
            position: Vec::new(),
            color: Vec::new(),
            ops: Vec::new(),
            prev_op: Vec::new(),
            references: References::default(),
            moves: Vec::new(),
            faces: Vec::new(),
            occupied: SlotSet::default(),
            vertices: SlotSet::default(),
            collapsible: SlotSet::default(),
            spawns: BTreeMap::new(),
            spawned_ids: std::collections::BTreeSet::new(),
            spawned_slots: 0,
            base_slots,
            base_faces: faces,
            triangles: 0,
            digest: 0,
            dirty: None,
        };
        let slots: Vec<u32> = (0..base_slots).collect();
        for &slot in &slots {
            replica.occupy(slot);
        }
        replica.insert_patch(base, &twins, &slots, NONE);
        Ok(replica)
    }

    /// Starts to record touched slots. Everything that exists counts as touched.
    pub fn track_dirty(&mut self) {
        let mut dirty = DirtySlots::default();
        self.vertices.iter().for_each(|v| dirty.touch_vertex(v));
        (0..2 * self.slot_end).for_each(|f| dirty.touch_face(f));
        self.dirty = Some(dirty);
    }

    /// The touched slots since they were last cleared, if [tracked](Self::track_dirty).
    pub fn dirty_mut(&mut self) -> Option<&mut DirtySlots> {
        self.dirty.as_mut()
    }

    /// Triangles in the mesh.
    #[inline]
    pub fn triangle_count(&self) -> u32 {
        self.triangles
    }

    /// Vertices in the mesh.
    #[inline]
    pub fn vertex_count(&self) -> u32 {
        self.vertices.len()
    }

    /// One past the largest vertex slot ever used. Face slots end at twice that.
    #[inline]
    pub fn slot_end(&self) -> u32 {
        self.slot_end
    }

    /// Slots that the base keeps for ever.
    #[inline]
    pub fn base_slots(&self) -> u32 {
        self.base_slots
    }

    /// Face slots of the base that hold faces.
    #[inline]
    pub fn base_faces(&self) -> u32 {
        self.base_faces
    }

    /// Slots that hold a vertex.
    #[inline]
    pub fn vertices(&self) -> &SlotSet {
        &self.vertices
    }

    /// Addresses of the ops that may be undone now.
    #[inline]
    pub fn collapsible(&self) -> &SlotSet {
        &self.collapsible
    }

    /// Lattice positions by vertex slot, `len == slot_end()`. Free slots hold what was last there.
    #[inline]
    pub fn positions(&self) -> &[[i32; 3]] {
        &self.position[..self.slot_end as usize]
    }

    /// Colours by vertex slot, `len == slot_end()`.
    #[inline]
    pub fn colors(&self) -> &[[u8; 3]] {
        &self.color[..self.slot_end as usize]
    }

    /// Corners by face slot, `2 * slot_end()` in all. A slot without a face holds `[0, 0, 0]`.
    #[inline]
    pub fn corners(&self) -> impl ExactSizeIterator<Item = [u32; 3]> + Clone + '_ {
        self.faces[..2 * self.slot_end as usize].iter().map(|face| face.corners)
    }

    /// Corners of a face slot below `2 * slot_end()`.
    #[inline]
    pub fn corners_of(&self, face: FaceSlot) -> [u32; 3] {
        self.faces[face.index()].corners
    }

    /// Order-independent sum over vertices (slot, position, colour) and faces (slot, corners in stored rotation).
    #[inline]
    pub fn digest(&self) -> u64 {
        self.digest
    }

    /// Whether `slot` is the address of an applied spawn.
    pub fn is_spawn(&self, slot: VertexSlot) -> bool {
        self.spawns.contains_key(&slot.0)
    }

    /// Number of the spawn at this address.
    pub fn spawn_id(&self, slot: VertexSlot) -> Option<u32> {
        self.spawns.get(&slot.0).map(|s| s.id)
    }

    /// Slots that a spawn reserved, ascending; its vertices are in the first ones.
    pub fn spawn_slots(&self, slot: VertexSlot) -> Option<&[u32]> {
        self.spawns.get(&slot.0).map(|s| &*s.slots)
    }

    /// Numbers of the applied spawns, ascending.
    pub fn spawned_ids(&self) -> &std::collections::BTreeSet<u32> {
        &self.spawned_ids
    }

    /// The vertex that was split to make this slot, or `None` for base, spawned and free slots.
    #[inline]
    pub fn split_from(&self, slot: VertexSlot) -> Option<VertexSlot> {
        let origin = self.ops.get(slot.index())?.origin;
        (origin < SPAWNED).then_some(VertexSlot(origin))
    }

    /// Triangles that a collapse at this address removes.
    pub fn triangles_of(&self, slot: VertexSlot) -> u32 {
        match self.spawns.get(&slot.0) {
            Some(spawn) => spawn.faces,
            None => slot.faces().iter().filter(|f| self.faces[f.index()].corners != NO_FACE).count() as u32,
        }
    }

    /// Inserts a vertex by splitting `s`, whose fan the caller has just read, and returns its slot: the smallest free one.
    /// O(arc + log) without allocation except growth.
    ///
    /// # Errors
    /// [`ApplyError::BadCut`] or [`ApplyError::OutOfSlots`]; nothing has changed then.
    pub fn split(&mut self, s: VertexSlot, fan: &Fan, cut: Cut, vertex: &NewVertex) -> Result<VertexSlot, ApplyError> {
        let t = VertexSlot(self.occupied.smallest_free());
        self.split_into(s, t, fan, cut, vertex)
    }

    /// As [`split`](Self::split), into a slot that the caller names: for a server that builds a mesh anew whose slots it
    /// knows. Ops may come in any order in which parents precede their children.
    ///
    /// # Errors
    /// As [`split`](Self::split); [`ApplyError::OutOfSlots`] also where the slot is taken.
    pub fn split_into(
        &mut self,
        s: VertexSlot,
        t: VertexSlot,
        fan: &Fan,
        cut: Cut,
        vertex: &NewVertex,
    ) -> Result<VertexSlot, ApplyError> {
        if !fan.admits(cut) {
            return Err(ApplyError::BadCut { slot: s.0, faces: fan.faces(), cut });
        }
        let t = t.0;
        if t >= MAX_VERTEX_SLOTS || self.occupied.contains(t) {
            return Err(ApplyError::OutOfSlots);
        }
        self.occupy(t);
        let before = self.ops[s.index()].last_op;
        self.add_reference(before);
        self.prev_op[t as usize] = before;
        self.ops[s.index()].last_op = t;
        self.ops[t as usize].last_op = t;
        self.ops[t as usize].origin = s.0;
        self.references.clear(t);
        self.collapsible.insert(t);
        self.put_vertex(t, vertex.position, vertex.color);
        if let Some(dirty) = &mut self.dirty {
            dirty.note_birth(t, Some(s.0));
        }
        self.shift_vertex(s.0, vertex.s_move, vertex.s_color_move);
        if vertex.s_move != [0; 3] || vertex.s_color_move != [0; 3] || !self.moves.is_empty() {
            if self.moves.len() <= t as usize {
                reserve_a_sixteenth(&mut self.moves, t as usize + 1);
                self.moves.resize(t as usize + 1, Move::default());
            }
            self.moves[t as usize] = Move { position: vertex.s_move, color: vertex.s_color_move };
        }

        let (out, ring) = (fan.out(), fan.ring());
        let faces = out.len();
        let closed = fan.is_closed();
        // The faces before and after a spoke, going counter-clockwise; absent beyond the ends of an open fan.
        let after = |spoke: usize| (spoke < faces).then(|| out[spoke]);
        let before_spoke = |spoke: usize| match spoke {
            0 if closed => Some(out[faces - 1]),
            0 => None,
            _ => Some(out[spoke - 1]),
        };
        let (right, left) = match cut {
            Cut::Both { right, left } => (Some(right as usize), Some(left as usize)),
            Cut::Left { left } => (None, Some(left as usize)),
            Cut::Right { right } => (Some(right as usize), None),
        };
        // Relabel the arc.
        let arc = fan.arc_len(cut) as usize;
        let first = right.unwrap_or(0);
        for i in first..first + arc {
            self.set_corner(out[if i < faces { i } else { i - faces }], t);
        }
        let [f_l, f_r] = [2 * t, 2 * t + 1];
        if let Some(left) = left {
            let (s_side, t_side) = (after(left), before_spoke(left).map(previous));
            self.put_face(f_l, [s.0, t, ring[left]]);
            self.link(f_l * 4 + 1, t_side);
            self.link(f_l * 4 + 2, s_side);
            self.add_face_reference(t_side);
            self.add_face_reference(s_side);
        }
        if let Some(right) = right {
            let (s_side, t_side) = (before_spoke(right).map(previous), after(right));
            self.put_face(f_r, [t, s.0, ring[right]]);
            self.link(f_r * 4 + 1, s_side);
            self.link(f_r * 4 + 2, t_side);
            self.add_face_reference(t_side);
            self.add_face_reference(s_side);
        }
        if left.is_some() && right.is_some() {
            self.link(f_l * 4, Some(f_r * 4));
        }
        let face = if left.is_some() { f_l } else { f_r };
        self.ops[s.index()].some_face = face;
        self.ops[t as usize].some_face = face;
        Ok(VertexSlot(t))
    }

    /// Undoes the split that made `t` and returns what it had inserted. Addresses of ops that nothing depends on any more are
    /// appended to `released`. O(arc).
    ///
    /// # Errors
    /// [`ApplyError::NotCollapsible`]; nothing has changed then.
    pub fn collapse(&mut self, t: VertexSlot, released: &mut Vec<VertexSlot>) -> Result<SplitUndo, ApplyError> {
        let s = match self.split_from(t) {
            Some(s) if self.collapsible.contains(t.0) => s,
            _ => return Err(ApplyError::NotCollapsible(t.0)),
        };
        // Relabel the fan of t, walking both ways from f_l and f_r (they are neighbours across s-t).
        let [f_l, f_r] = [2 * t.0, 2 * t.0 + 1];
        let (has_left, has_right) =
            (self.faces[f_l as usize].corners != NO_FACE, self.faces[f_r as usize].corners != NO_FACE);
        let pair = |replica: &Self, face: u32| (replica.twin_of(face * 4 + 1), replica.twin_of(face * 4 + 2));
        // f_l = (s, t, l): edge 1 is t -> l with the t side behind it, edge 2 is l -> s with the s side.
        let (l_t, l_s) = if has_left { pair(self, f_l) } else { (NO_HALF_EDGE, NO_HALF_EDGE) };
        // f_r = (t, s, r): edge 1 is s -> r with the s side behind it, edge 2 is r -> t with the t side.
        let (r_s, r_t) = if has_right { pair(self, f_r) } else { (NO_HALF_EDGE, NO_HALF_EDGE) };
        if has_right {
            // Counter-clockwise from the face behind r -> t until f_l or the boundary.
            let mut h = r_t;
            while h != NO_HALF_EDGE && h / 4 != f_l {
                self.set_corner(h, s.0);
                h = self.twin_of(previous(h));
            }
        } else {
            // Clockwise from the face behind t -> l until the boundary.
            let mut incoming = l_t;
            while incoming != NO_HALF_EDGE {
                let h = next_in_face(incoming);
                self.set_corner(h, s.0);
                incoming = self.twin_of(h);
            }
        }
        let absent = VertexSlot::NONE;
        let left = if has_left { VertexSlot(self.faces[f_l as usize].corners[2]) } else { absent };
        let right = if has_right { VertexSlot(self.faces[f_r as usize].corners[2]) } else { absent };
        for (a, b, exists, face) in [(l_t, l_s, has_left, f_l), (r_t, r_s, has_right, f_r)] {
            if !exists {
                continue;
            }
            self.drop_face_reference(a, released);
            self.drop_face_reference(b, released);
            self.take_face(face);
            self.join(a, b);
        }
        let previous_op = self.prev_op[t.index()];
        self.ops[s.index()].last_op = previous_op;
        self.drop_reference(previous_op, released);
        // f_l and f_r may have been the hints of their corners: name a neighbour instead. One exists, since a split opens
        // next to a face.
        for (v, a, b) in [(left, l_t, l_s), (right, r_t, r_s)] {
            if v != absent {
                let near = if a != NO_HALF_EDGE { a } else { b };
                self.ops[v.index()].some_face = near / 4;
                self.ops[s.index()].some_face = near / 4;
            }
        }

        let moved = self.moves.get(t.index()).copied().unwrap_or_default();
        let vertex = NewVertex {
            position: self.position[t.index()],
            color: self.color[t.index()],
            s_move: moved.position,
            s_color_move: moved.color,
        };
        self.shift_vertex(s.0, moved.position.map(i32::wrapping_neg), moved.color.map(u8::wrapping_neg));
        self.take_vertex(t.0);
        self.collapsible.remove(t.0);
        self.occupied.remove(t.0);
        self.ops[t.index()].origin = NONE;
        Ok(SplitUndo { s, vertex, left, right })
    }

    /// Inserts a component as a whole into the `max(k, ceil(m / 2))` smallest free slots and returns its address, the
    /// first of them. O(m log m).
    ///
    /// # Errors
    /// [`ApplyError`]; nothing has changed then.
    pub fn spawn(&mut self, id: u32, patch: &Patch) -> Result<VertexSlot, ApplyError> {
        if self.spawned_ids.contains(&id) {
            return Err(ApplyError::SpawnedTwice(id));
        }
        let twins = patch.validate()?;
        let count = patch.positions.len().max(patch.faces.len().div_ceil(2));
        if count == 0 || self.occupied.len() as usize + count > MAX_VERTEX_SLOTS as usize {
            return Err(ApplyError::OutOfSlots);
        }
        let mut slots = Vec::with_capacity(count);
        for _ in 0..count {
            let slot = self.occupied.smallest_free();
            self.occupy(slot);
            slots.push(slot);
        }
        Ok(self.insert_spawn(id, patch, &twins, slots))
    }

    /// As [`spawn`](Self::spawn), into slots that the caller names, ascending and as many as the spawn reserves: see
    /// [`split_into`](Self::split_into).
    ///
    /// # Errors
    /// As [`spawn`](Self::spawn); [`ApplyError::OutOfSlots`] also where a slot is taken or their number is another.
    pub fn spawn_into(&mut self, id: u32, patch: &Patch, slots: &[u32]) -> Result<VertexSlot, ApplyError> {
        if self.spawned_ids.contains(&id) {
            return Err(ApplyError::SpawnedTwice(id));
        }
        let twins = patch.validate()?;
        let count = patch.positions.len().max(patch.faces.len().div_ceil(2));
        let is_free = |&slot: &u32| slot < MAX_VERTEX_SLOTS && !self.occupied.contains(slot);
        if count == 0 || slots.len() != count || !slots.is_sorted_by(|a, b| a < b) || !slots.iter().all(is_free) {
            return Err(ApplyError::OutOfSlots);
        }
        slots.iter().for_each(|&slot| self.occupy(slot));
        Ok(self.insert_spawn(id, patch, &twins, slots.to_vec()))
    }

    fn insert_spawn(&mut self, id: u32, patch: &Patch, twins: &[[u32; 3]], slots: Vec<u32>) -> VertexSlot {
        let address = slots[0];
        self.insert_patch(patch, twins, &slots, address);
        self.collapsible.insert(address);
        self.references.clear(address);
        self.spawned_ids.insert(id);
        self.spawned_slots += slots.len();
        let spawn = Spawn { id, slots: slots.into_boxed_slice(), faces: patch.faces.len() as u32 };
        self.spawns.insert(address, spawn);
        VertexSlot(address)
    }

    /// Removes a spawned component and returns its number and the slots it had.
    ///
    /// # Errors
    /// [`ApplyError::NotCollapsible`]; nothing has changed then.
    pub fn despawn(&mut self, address: VertexSlot) -> Result<(u32, Box<[u32]>), ApplyError> {
        if !self.collapsible.contains(address.0) {
            return Err(ApplyError::NotCollapsible(address.0));
        }
        let spawn = self.spawns.remove(&address.0).ok_or(ApplyError::NotCollapsible(address.0))?;
        for j in 0..spawn.faces {
            self.take_face(spawned_face(&spawn.slots, j));
        }
        for &slot in &spawn.slots {
            if self.vertices.contains(slot) {
                self.take_vertex(slot);
            }
            self.ops[slot as usize].origin = NONE;
            self.occupied.remove(slot);
        }
        self.collapsible.remove(address.0);
        self.spawned_ids.remove(&spawn.id);
        self.spawned_slots -= spawn.slots.len();
        Ok((spawn.id, spawn.slots))
    }

    /// Address of the op that made the vertex or the faces of `slot`; `None` for the base.
    #[inline]
    pub fn op_of(&self, slot: VertexSlot) -> Option<VertexSlot> {
        if slot.0 < self.base_slots {
            return None;
        }
        let origin = self.ops[slot.index()].origin;
        match origin {
            NONE => None,
            _ if origin & SPAWNED != 0 => Some(VertexSlot(origin & !SPAWNED)),
            _ => Some(slot),
        }
    }

    /// Bytes of memory held, for accounting. O(1).
    pub fn heap_bytes(&self) -> usize {
        self.position.capacity() * 12
            + self.color.capacity() * 3
            + self.ops.capacity() * size_of::<Op>()
            + self.prev_op.capacity() * 4
            + self.references.heap_bytes()
            + self.moves.capacity() * size_of::<Move>()
            + self.faces.capacity() * size_of::<Face>()
            + self.occupied.heap_bytes()
            + self.vertices.heap_bytes()
            + self.collapsible.heap_bytes()
            + self.spawns.len() * 64
            + self.spawned_slots * 4
    }

    /// The digest from scratch, for tests.
    #[cfg(any(test, feature = "testing"))]
    pub fn recompute_digest(&mut self) -> u64 {
        let vertices = self.vertices.iter().map(|v| vertex_hash(v, self.position[v as usize], self.color[v as usize]));
        let faces = (0..).zip(self.corners()).filter(|(_, c)| *c != NO_FACE).map(|(f, c)| face_hash(f, c));
        vertices.chain(faces).fold(0, u64::wrapping_add)
    }

    fn occupy(&mut self, slot: u32) {
        self.occupied.insert(slot);
        if slot >= self.slot_end {
            self.slot_end = slot + 1;
            if self.slot_end as usize > self.position.len() {
                self.grow();
            }
        }
    }

    /// Makes room for all slots up to the end and a sixteenth more: a server holds thousands of replicas, and what doubling leaves
    /// free would be a third of all.
    #[cold]
    #[inline(never)]
    fn grow(&mut self) {
        let slots = and_a_sixteenth(self.slot_end as usize);
        extend(&mut self.position, slots, [0; 3]);
        extend(&mut self.color, slots, [0; 3]);
        extend(&mut self.ops, slots, Op { origin: NONE, last_op: NONE, some_face: 0 });
        extend(&mut self.prev_op, slots, NONE);
        self.references.extend(slots);
        extend(&mut self.faces, 2 * slots, Face { corners: NO_FACE, twins: [NO_HALF_EDGE; 3] });
    }

    fn insert_patch(&mut self, patch: &Patch, twins: &[[u32; 3]], slots: &[u32], address: u32) {
        let origin = if address == NONE { NONE } else { SPAWNED | address };
        for &slot in slots {
            self.ops[slot as usize].origin = origin;
        }
        for (j, (&position, &color)) in patch.positions.iter().zip(&patch.colors).enumerate() {
            let slot = slots[j] as usize;
            self.ops[slot].last_op = address;
            self.prev_op[slot] = NONE;
            self.put_vertex(slots[j], position, color);
            if let Some(dirty) = &mut self.dirty {
                dirty.note_birth(slots[j], None);
            }
        }
        for (j, face) in patch.faces.iter().enumerate() {
            let f = spawned_face(slots, j as u32);
            self.put_face(f, face.map(|v| slots[v as usize]));
            for (k, &twin) in twins[j].iter().enumerate() {
                let to = match twin {
                    NO_HALF_EDGE => NO_HALF_EDGE,
                    _ => spawned_face(slots, twin / 4) * 4 + twin % 4,
                };
                self.faces[f as usize].twins[k] = to;
                self.ops[slots[face[k] as usize] as usize].some_face = f;
            }
        }
    }

    #[inline]
    fn twin_of(&self, h: HalfEdge) -> HalfEdge {
        self.faces[(h / 4) as usize].twins[(h % 4) as usize]
    }

    #[inline]
    fn corner_at(&self, h: HalfEdge) -> u32 {
        self.faces[(h / 4) as usize].corners[(h % 4) as usize]
    }

    /// The half-edge of `face` that starts at `vertex`.
    #[inline]
    fn outgoing(&self, face: u32, vertex: u32) -> HalfEdge {
        let c = self.faces[face as usize].corners;
        debug_assert!(c.contains(&vertex), "the hint of slot {vertex} is stale");
        face * 4
            + if c[0] == vertex {
                0
            } else if c[1] == vertex {
                1
            } else {
                2
            }
    }

    fn put_vertex(&mut self, slot: u32, position: [i32; 3], color: [u8; 3]) {
        self.position[slot as usize] = position;
        self.color[slot as usize] = color;
        self.vertices.insert(slot);
        self.digest = self.digest.wrapping_add(vertex_hash(slot, position, color));
        if let Some(dirty) = &mut self.dirty {
            dirty.touch_vertex(slot);
        }
    }

    fn take_vertex(&mut self, slot: u32) {
        self.vertices.remove(slot);
        let hash = vertex_hash(slot, self.position[slot as usize], self.color[slot as usize]);
        self.digest = self.digest.wrapping_sub(hash);
    }

    fn shift_vertex(&mut self, slot: u32, by: [i32; 3], color_by: [u8; 3]) {
        if by == [0; 3] && color_by == [0; 3] {
            return;
        }
        self.take_vertex(slot);
        let (p, c) = (self.position[slot as usize], self.color[slot as usize]);
        let position = std::array::from_fn(|k| p[k].wrapping_add(by[k]));
        let color = std::array::from_fn(|k| c[k].wrapping_add(color_by[k]));
        self.put_vertex(slot, position, color);
    }

    fn set_corner(&mut self, h: HalfEdge, to: u32) {
        let (face, k) = ((h / 4) as usize, (h % 4) as usize);
        let corners = &mut self.faces[face].corners;
        let before = *corners;
        corners[k] = to;
        let after = *corners;
        self.digest = self.digest.wrapping_sub(face_hash(h / 4, before)).wrapping_add(face_hash(h / 4, after));
        if let Some(dirty) = &mut self.dirty {
            dirty.touch_face(h / 4);
        }
    }

    fn put_face(&mut self, face: u32, corners: [u32; 3]) {
        self.faces[face as usize] = Face { corners, twins: [NO_HALF_EDGE; 3] };
        self.triangles += 1;
        self.digest = self.digest.wrapping_add(face_hash(face, corners));
        if let Some(dirty) = &mut self.dirty {
            dirty.touch_face(face);
        }
    }

    fn take_face(&mut self, face: u32) {
        let corners = std::mem::replace(&mut self.faces[face as usize].corners, NO_FACE);
        self.triangles -= 1;
        self.digest = self.digest.wrapping_sub(face_hash(face, corners));
        if let Some(dirty) = &mut self.dirty {
            dirty.touch_face(face);
        }
    }

    fn link(&mut self, a: HalfEdge, b: Option<HalfEdge>) {
        self.faces[(a / 4) as usize].twins[(a % 4) as usize] = b.unwrap_or(NO_HALF_EDGE);
        if let Some(b) = b {
            self.faces[(b / 4) as usize].twins[(b % 4) as usize] = a;
        }
    }

    fn join(&mut self, a: HalfEdge, b: HalfEdge) {
        for (from, to) in [(a, b), (b, a)] {
            if from != NO_HALF_EDGE {
                self.faces[(from / 4) as usize].twins[(from % 4) as usize] = to;
            }
        }
    }

    fn add_reference(&mut self, address: u32) {
        if address != NONE {
            self.references.add(address);
            self.collapsible.remove(address);
        }
    }

    fn drop_reference(&mut self, address: u32, released: &mut Vec<VertexSlot>) {
        if address != NONE && self.references.drop_one(address) == 0 {
            self.collapsible.insert(address);
            released.push(VertexSlot(address));
        }
    }

    fn add_face_reference(&mut self, h: Option<HalfEdge>) {
        if let Some(owner) = h.and_then(|h| self.op_of(VertexSlot(h / 8))) {
            self.add_reference(owner.0);
        }
    }

    fn drop_face_reference(&mut self, h: HalfEdge, released: &mut Vec<VertexSlot>) {
        if h != NO_HALF_EDGE
            && let Some(owner) = self.op_of(VertexSlot(h / 8))
        {
            self.drop_reference(owner.0, released);
        }
    }
}

/// So many elements and room for no more, the new ones all alike.
fn extend<T: Copy>(array: &mut Vec<T>, len: usize, value: T) {
    array.reserve_exact(len - array.len());
    array.resize(len, value);
}

/// Face slot of face `j` of a patch in these slots.
#[inline]
fn spawned_face(slots: &[u32], j: u32) -> u32 {
    2 * slots[(j / 2) as usize] + j % 2
}

#[inline]
fn next_in_face(h: HalfEdge) -> HalfEdge {
    if h % 4 == 2 { h - 2 } else { h + 1 }
}

#[inline]
fn previous(h: HalfEdge) -> HalfEdge {
    if h.is_multiple_of(4) { h + 2 } else { h - 1 }
}

mod walk;
pub use walk::TOUCHED_AT_ONCE;

#[cfg(test)]
mod tests;
