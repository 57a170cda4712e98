//! Random but valid DAGs (feature `testing`): what a builder makes, without a builder.

use glam::DVec3;
use lodestream_protocol::ids::VertexSlot;
use lodestream_protocol::mesh::{Cut, Fan, NewVertex, Patch, Replica};
use lodestream_protocol::quant::Lattice;
use lodestream_protocol::testing::{OperationRng, base_meshes};

use super::hash::CompleteMesh;
use super::record::{
    Bounds, Cone, CutRef, Dag, Magnitude, NO_OP, Patch as RootPatch, SpawnRecord, SplitRecord, VERTEX_OPS,
};
use super::replay::live_faces;

/// What to generate.
#[derive(Clone, Copy, Debug)]
pub struct DagOptions {
    /// Same seed, same DAG.
    pub seed: u64,
    /// Name of the base among [`base_meshes`].
    pub base: &'static str,
    /// Number of components that spawn.
    pub spawns: u32,
    /// Number of splits at most (fewer where nothing can be split).
    pub splits: u32,
    /// Bits of the lattice.
    pub bits: u8,
    /// Whether vertices have colours.
    pub has_colors: bool,
    /// Whether splits move the vertex that they split.
    pub has_moves: bool,
    /// Whether ops wait for vertices.
    pub by_vertices: bool,
}

impl Default for DagOptions {
    fn default() -> Self {
        Self {
            seed: 1,
            base: "grid",
            spawns: 3,
            splits: 100,
            bits: 12,
            has_colors: false,
            has_moves: false,
            by_vertices: false,
        }
    }
}

/// Splits random vertices of a small base at random cuts and records them. Ids go by depth in the vertex forest and then at
/// random, so that cut owners may have larger ids than the ops that depend on them; bounds are made up, but contain those of
/// the forest children.
pub fn random_dag(options: &DagOptions) -> (Dag, CompleteMesh) {
    Generator::new(options).finish()
}

struct Generator {
    rng: OperationRng,
    dag: Dag,
    replica: Replica,
    /// By face slot of the roots: number of the root face.
    root_face: Vec<u32>,
    /// By slot: last op on the vertex, as generated (splits count from `spawns`), and its `s`.
    last_op: Vec<(u32, u32)>,
    /// By slot: op that made it, and when.
    maker: Vec<u32>,
}

impl Generator {
    fn new(options: &DagOptions) -> Self {
        let mut rng = OperationRng::new(options.seed);
        let meshes = base_meshes();
        let root = |patch: &Patch| RootPatch {
            positions: patch.positions.clone(),
            colors: if options.has_colors { patch.colors.clone() } else { vec![[0; 3]; patch.colors.len()] },
            faces: patch.faces.clone(),
            first_splits: vec![NO_OP; patch.positions.len()],
        };
        let (_, base) = meshes.iter().find(|(name, _)| *name == options.base).expect("a name from `base_meshes`");
        let solid: Vec<&Patch> = meshes.iter().map(|(_, patch)| patch).filter(|p| !p.faces.is_empty()).collect();
        let spawns: Vec<SpawnRecord> = (0..options.spawns)
            .map(|_| SpawnRecord { bounds: NO_BOUNDS, patch: root(solid[rng.below(solid.len() as u32) as usize]) })
            .collect();
        let base = root(base);
        let mut replica = Replica::new(&as_patch(&base)).expect("a manifold");
        let mut generator = Self {
            root_face: Vec::new(),
            last_op: (0..base.positions.len() as u32).map(|v| (NO_OP, v)).collect(),
            maker: vec![NO_OP; replica.slot_end() as usize],
            dag: Dag {
                lattice: Lattice::of_box([-1.0; 3], [1.0; 3], options.bits),
                has_colors: options.has_colors,
                is_open: false,
                by_vertices: options.by_vertices,
                base,
                spawns: Vec::new(),
                splits: Vec::new(),
            },
            replica: replica.clone(),
            rng,
        };
        generator.root_face = (0..generator.dag.base.faces.len() as u32).collect();
        let (mut vertex, mut face) = (generator.dag.base.positions.len() as u32, generator.dag.base.faces.len() as u32);
        for (id, spawn) in (0..).zip(&spawns) {
            let address = replica.spawn(id, &as_patch(&spawn.patch)).expect("a manifold");
            let slots = replica.spawn_slots(address).expect("just spawned").to_vec();
            let end = replica.slot_end() as usize;
            generator.root_face.resize(2 * end, NO_OP);
            generator.last_op.resize(end, (NO_OP, NO_OP));
            generator.maker.resize(end, NO_OP);
            for j in 0..spawn.patch.faces.len() as u32 {
                generator.root_face[(2 * slots[(j / 2) as usize] + j % 2) as usize] = face + j;
            }
            for (j, slot) in slots.iter().enumerate() {
                generator.last_op[*slot as usize] = (id, vertex + j as u32);
                generator.maker[*slot as usize] = id;
            }
            vertex += spawn.patch.positions.len() as u32;
            face += spawn.patch.faces.len() as u32;
        }
        generator.replica = replica;
        generator.dag.spawns = spawns;
        for _ in 0..options.splits {
            generator.split(options.has_moves);
        }
        generator
    }

    fn split(&mut self, has_moves: bool) -> Option<()> {
        let vertices = self.replica.vertices();
        let rank = if vertices.is_empty() { return None } else { self.rng.below(vertices.len()) };
        let s = VertexSlot(vertices.select_from(0, rank)?);
        let mut fan = Fan::default();
        self.replica.fan(s, &mut fan).expect("the vertex exists");
        let cut = self.rng.random_cut(&fan)?;
        let vertex = self.new_vertex(s, has_moves);
        let (left, right) = match cut {
            Cut::Both { right, left } => (self.cut_ref(&fan, s, left), self.cut_ref(&fan, s, right)),
            Cut::Left { left } => (self.cut_ref(&fan, s, left), CutRef::None),
            Cut::Right { right } => (CutRef::None, self.cut_ref(&fan, s, right)),
        };
        let vertex_ops = self.ops_around(&fan);
        let t = self.replica.split(s, &fan, cut, &vertex).expect("the cut fits");
        let op = (self.dag.spawns.len() + self.dag.splits.len()) as u32;
        let (tree_parent, number) = self.last_op[s.index()];
        self.dag.splits.push(SplitRecord {
            bounds: NO_BOUNDS,
            tree_parent,
            s: number,
            left,
            right,
            next_of_s: NO_OP,
            first_of_t: NO_OP,
            position: vertex.position,
            color: vertex.color,
            s_move: vertex.s_move,
            s_color_move: vertex.s_color_move,
            vertex_ops,
        });
        let slots = self.replica.slot_end() as usize;
        self.last_op.resize(slots, (NO_OP, NO_OP));
        self.maker.resize(slots, NO_OP);
        self.last_op[s.index()] = (op, 0);
        self.last_op[t.index()] = (op, 1);
        self.maker[t.index()] = op;
        *self.child_of(tree_parent, number) = op;
        Some(())
    }

    /// The last ops on some vertices around a fan, if the model depends by vertices: of as many as a record holds.
    fn ops_around(&self, fan: &Fan) -> [u32; VERTEX_OPS] {
        let mut ops = [NO_OP; VERTEX_OPS];
        if self.dag.by_vertices {
            for (op, &vertex) in ops.iter_mut().zip(fan.ring()) {
                let (last, _) = self.last_op[vertex as usize];
                *op = if last != NO_OP && (last as usize) < self.dag.spawns.len() { NO_OP } else { last };
            }
        }
        ops
    }

    /// The place where the first op after `parent` on vertex `number` is noted.
    fn child_of(&mut self, parent: u32, number: u32) -> &mut u32 {
        let spawns = self.dag.spawns.len() as u32;
        if parent == NO_OP {
            return &mut self.dag.base.first_splits[number as usize];
        }
        if parent >= spawns {
            let split = &mut self.dag.splits[(parent - spawns) as usize];
            return if number == 0 { &mut split.next_of_s } else { &mut split.first_of_t };
        }
        let before: usize = self.dag.spawns[..parent as usize].iter().map(|s| s.patch.positions.len()).sum();
        let local = number as usize - self.dag.base.positions.len() - before;
        &mut self.dag.spawns[parent as usize].patch.first_splits[local]
    }

    fn new_vertex(&mut self, s: VertexSlot, has_moves: bool) -> NewVertex {
        let max = self.dag.lattice.max_coordinate();
        let near = self.replica.positions()[s.index()];
        let mut offset = |reach: u32| self.rng.below(2 * reach + 1) as i32 - reach as i32;
        let position = near.map(|c| (c + offset(40)).clamp(0, max));
        let s_move = near.map(|c| if has_moves { (c + offset(3)).clamp(0, max) - c } else { 0 });
        let mut byte = |on: bool| [0; 3].map(|_: u8| if on { self.rng.below(256) as u8 } else { 0 });
        let color = byte(self.dag.has_colors);
        NewVertex { position, color, s_move, s_color_move: byte(self.dag.has_colors && has_moves) }
    }

    /// The edge at a spoke, in the younger of the faces beside it.
    fn cut_ref(&self, fan: &Fan, s: VertexSlot, spoke: u32) -> CutRef {
        let after = (spoke < fan.faces()).then_some(spoke);
        let before = if spoke > 0 { Some(spoke - 1) } else { fan.is_closed().then(|| fan.faces() - 1) };
        let age = |face: u32| self.maker[(fan.face(face).0 / 2) as usize].wrapping_add(1);
        let younger = match (after, before) {
            (Some(a), Some(b)) if age(b) > age(a) => b,
            (Some(a), _) => a,
            (None, b) => b.expect("a spoke has a face beside it"),
        };
        let slot = fan.face(younger);
        let corners = self.replica.corners_of(slot);
        let at_s = corners.iter().position(|&c| c == s.0).expect("the face is around s");
        let edge = if Some(younger) == after { at_s } else { (at_s + 2) % 3 } as u8;
        match self.maker[slot.owner().index()] {
            NO_OP => CutRef::Root { face: self.root_face[slot.index()], edge },
            op if (op as usize) < self.dag.spawns.len() => CutRef::Root { face: self.root_face[slot.index()], edge },
            op => CutRef::Split { op, side: (slot.0 % 2) as u8, edge },
        }
    }

    fn finish(mut self) -> (Dag, CompleteMesh) {
        let number: Vec<u32> = {
            let mut next = 0..;
            let slots = 0..self.replica.slot_end();
            slots.map(|s| if self.replica.vertices().contains(s) { next.next().unwrap_or(0) } else { NO_OP }).collect()
        };
        let positions: Vec<_> = self.replica.vertices().iter().map(|s| self.replica.positions()[s as usize]).collect();
        let colors: Vec<_> = self.replica.vertices().iter().map(|s| self.replica.colors()[s as usize]).collect();
        let faces: Vec<_> = live_faces(&self.replica).map(|f| f.map(|s| number[s as usize])).collect();
        let complete = CompleteMesh::of(&positions, self.dag.has_colors.then_some(&colors[..]), &faces);
        self.make_bounds();
        self.renumber();
        (self.dag, complete)
    }

    /// Children come after their parents as generated, so one backward pass sees children first.
    fn make_bounds(&mut self) {
        let spawns = self.dag.spawns.len();
        for i in (0..self.dag.splits.len()).rev() {
            let split = &self.dag.splits[i];
            let children = [split.next_of_s, split.first_of_t];
            let children: Vec<Bounds> = children
                .into_iter()
                .filter(|&c| c != NO_OP)
                .map(|c| self.dag.splits[c as usize - spawns].bounds)
                .collect();
            self.dag.splits[i].bounds = self.cover(self.dag.splits[i].position, 20.0, &children);
        }
        for i in 0..spawns {
            let first = self.dag.spawns[i].patch.first_splits.iter().filter(|&&c| c != NO_OP);
            let children: Vec<Bounds> = first.map(|&c| self.dag.splits[c as usize - spawns].bounds).collect();
            self.dag.spawns[i].bounds = self.cover(self.dag.spawns[i].patch.positions[0], 2000.0, &children);
        }
        // Spawns come by error descending; making all alike spares us to renumber them.
        let largest = |bounds: Bounds| bounds.error.max(bounds.radius);
        let error = self.dag.spawns.iter().map(|s| largest(s.bounds)).max().unwrap_or_default();
        self.dag.spawns.iter_mut().for_each(|s| s.bounds.error = error);
    }

    fn cover(&mut self, center: [i32; 3], own_radius: f64, children: &[Bounds]) -> Bounds {
        let at = DVec3::from_array(center.map(f64::from));
        let radius = children.iter().map(|c| c.reach_from(at)).fold(own_radius, f64::max);
        let error = children.iter().map(|c| c.error).max().unwrap_or_default();
        let own_error = Magnitude::encode_up(f64::from(self.rng.below(1000)) / 50.0);
        let axis = [0; 2].map(|_: i8| (self.rng.below(255) as i32 - 127) as i8);
        let parts: Option<Vec<_>> = children.iter().map(|c| c.cone.wide()).collect();
        let own = Cone { axis, half_angle: 20 }.wide();
        let cone = match parts.zip(own) {
            Some((mut parts, own)) => {
                let axis = parts.first().map_or(own.axis, |first| first.axis);
                if parts.is_empty() {
                    parts.push(own);
                }
                Cone::cover(axis, &parts)
            }
            None => Cone::ANY,
        };
        Bounds { center, radius: Magnitude::encode_up(radius), error: error.max(own_error), cone }
    }

    fn renumber(&mut self) {
        let spawns = self.dag.spawns.len() as u32;
        let splits = std::mem::take(&mut self.dag.splits);
        let mut depth: Vec<u32> = Vec::with_capacity(splits.len());
        for split in &splits {
            let parent = split.tree_parent;
            let is_split = parent != NO_OP && parent >= spawns;
            depth.push(if is_split { 1 + depth[(parent - spawns) as usize] } else { 0 });
        }
        let mut order: Vec<u32> = (0..splits.len() as u32).collect();
        let salt = self.rng.next_u64();
        order.sort_by_key(|&i| (depth[i as usize], (u64::from(i) ^ salt).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 20));
        let mut new_id: Vec<u32> = (0..spawns + splits.len() as u32).collect();
        for (rank, &i) in (0..).zip(&order) {
            new_id[(spawns + i) as usize] = spawns + rank;
        }
        let map = |op: u32| if op == NO_OP { NO_OP } else { new_id[op as usize] };
        let map_cut = |cut: CutRef| match cut {
            CutRef::Split { op, side, edge } => CutRef::Split { op: map(op), side, edge },
            other => other,
        };
        self.dag.splits = order
            .iter()
            .map(|&i| {
                let split = splits[i as usize].clone();
                SplitRecord {
                    tree_parent: map(split.tree_parent),
                    left: map_cut(split.left),
                    right: map_cut(split.right),
                    next_of_s: map(split.next_of_s),
                    first_of_t: map(split.first_of_t),
                    vertex_ops: split.vertex_ops.map(map),
                    ..split
                }
            })
            .collect();
        let patches = self.dag.spawns.iter_mut().map(|s| &mut s.patch).chain([&mut self.dag.base]);
        patches.flat_map(|p| &mut p.first_splits).for_each(|first| *first = map(*first));
    }
}

const NO_BOUNDS: Bounds =
    Bounds { center: [0; 3], radius: Magnitude(0), error: Magnitude(0), cone: Cone { axis: [0; 2], half_angle: 0 } };

fn as_patch(patch: &RootPatch) -> Patch {
    Patch { positions: patch.positions.clone(), colors: patch.colors.clone(), faces: patch.faces.clone() }
}
