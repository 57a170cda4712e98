//! The dull twin: replays a DAG from its records with hash maps and nothing of the builder's code.

use std::collections::HashMap;

use crate::pack::record::{CutRef, Dag, NO_OP, Patch, SplitRecord};

/// A face by who inserted it: a split and its side, or a root face's number.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug, PartialOrd, Ord)]
pub(super) enum Face {
    Of(u32, u8),
    Root(u32),
}

/// A vertex by who inserted it: a split, or a root vertex's number.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug, PartialOrd, Ord)]
pub(super) enum Vertex {
    Of(u32),
    Root(u32),
}

type Edge = (Face, u8);

/// The mesh after some ops.
#[derive(Default)]
pub(super) struct Replay {
    corners: HashMap<Face, [Vertex; 3]>,
    across: HashMap<Edge, Edge>,
    positions: HashMap<Vertex, [i32; 3]>,
    colors: HashMap<Vertex, [u8; 3]>,
}

/// Number of the first root vertex and root face of each spawn, after those of the base.
fn offsets(dag: &Dag) -> Vec<(u32, u32)> {
    let mut at = (dag.base.positions.len() as u32, dag.base.faces.len() as u32);
    dag.spawns
        .iter()
        .map(|spawn| {
            let here = at;
            at.0 += spawn.patch.positions.len() as u32;
            at.1 += spawn.patch.faces.len() as u32;
            here
        })
        .collect()
}

/// All parents of a split by final id, repeats removed. Root faces and vertices of the base have none.
pub(super) fn parents(dag: &Dag, split: &SplitRecord) -> Vec<u32> {
    let offsets = offsets(dag);
    let of_cut = |cut| match cut {
        CutRef::None => NO_OP,
        CutRef::Split { op, .. } => op,
        CutRef::Root { face, .. } => {
            offsets.iter().rposition(|&(_, first)| face >= first).map_or(NO_OP, |spawn| spawn as u32)
        }
    };
    let mut all = vec![split.tree_parent, of_cut(split.left), of_cut(split.right)];
    all.retain(|&op| op != NO_OP);
    all.sort_unstable();
    all.dedup();
    all
}

impl Replay {
    /// Base and all spawns.
    pub(super) fn roots(dag: &Dag) -> Self {
        let mut replay = Self::default();
        replay.insert_patch(&dag.base, 0, 0);
        for (spawn, (vertex, face)) in dag.spawns.iter().zip(offsets(dag)) {
            replay.insert_patch(&spawn.patch, vertex, face);
        }
        replay
    }

    fn insert_patch(&mut self, patch: &Patch, first_vertex: u32, first_face: u32) {
        for (i, (&position, &color)) in patch.positions.iter().zip(&patch.colors).enumerate() {
            self.positions.insert(Vertex::Root(first_vertex + i as u32), position);
            self.colors.insert(Vertex::Root(first_vertex + i as u32), color);
        }
        let mut edges: HashMap<[Vertex; 2], Edge> = HashMap::new();
        for (i, corners) in patch.faces.iter().enumerate() {
            let face = Face::Root(first_face + i as u32);
            let corners = corners.map(|v| Vertex::Root(first_vertex + v));
            self.corners.insert(face, corners);
            for k in 0..3 {
                let pair = [corners[k], corners[(k + 1) % 3]];
                assert!(edges.insert(pair, (face, k as u8)).is_none(), "a root patch repeats an edge");
            }
        }
        for (&[a, b], &edge) in &edges {
            if let Some(&other) = edges.get(&[b, a]) {
                self.across.insert(edge, other);
            }
        }
    }

    fn ends(&self, (face, k): Edge) -> [Vertex; 2] {
        let corners = self.corners[&face];
        [corners[usize::from(k)], corners[(usize::from(k) + 1) % 3]]
    }

    /// The two sides of a cut edge of `s`: the one that leaves `s` and the one that enters it.
    fn cut(&self, cut: CutRef, s: Vertex) -> Option<[Option<Edge>; 2]> {
        let edge = match cut {
            CutRef::None => return None,
            CutRef::Split { op, side, edge } => (Face::Of(op, side), edge),
            CutRef::Root { face, edge } => (Face::Root(face), edge),
        };
        let other = self.across.get(&edge).copied();
        let ends = self.ends(edge);
        if ends[0] == s {
            return Some([Some(edge), other]);
        }
        assert_eq!(ends[1], s, "a cut edge is not one of s");
        Some([other, Some(edge)])
    }

    fn join(&mut self, edge: Edge, other: Option<Edge>) {
        match other {
            Some(other) => {
                self.across.insert(edge, other);
                self.across.insert(other, edge);
            }
            None => {
                self.across.remove(&edge);
            }
        }
    }

    /// Applies split `op`, whose parents must all be applied.
    pub(super) fn split(&mut self, dag: &Dag, op: u32) {
        let spawns = dag.spawns.len() as u32;
        let record = &dag.splits[(op - spawns) as usize];
        let s = Self::vertex_s(dag, record);
        let t = Vertex::Of(op);
        let position = self.positions.get_mut(&s).expect("s exists");
        *position = std::array::from_fn(|k| position[k] + record.s_move[k]);
        let color = self.colors.get_mut(&s).expect("s exists");
        *color = std::array::from_fn(|k| color[k].wrapping_add(record.s_color_move[k]));
        self.positions.insert(t, record.position);
        self.colors.insert(t, record.color);
        let left = self.cut(record.left, s);
        let right = self.cut(record.right, s);
        assert!(left.is_some() || right.is_some(), "a split inserts no face");
        let apex = |cut: &[Option<Edge>; 2], replay: &Self| match *cut {
            [Some(leaving), _] => replay.ends(leaving)[1],
            [None, entering] => replay.ends(entering.expect("one side of a cut exists"))[0],
        };
        // The arc: from fn2, which the right cut edge leaves s in, counter-clockwise to fn1, which the left one enters s in.
        let last = left.and_then(|cut| cut[1]);
        let mut at = match (&right, &left) {
            (Some(cut), _) => cut[0],
            (None, Some([_, None])) => None,
            (None, _) => self.boundary_start(last.unwrap(), s),
        };
        let mut steps = 0;
        while let Some((face, k)) = at {
            steps += 1;
            assert!(steps < 100_000, "the arc does not end");
            let corner = &mut self.corners.get_mut(&face).unwrap()[usize::from(k)];
            assert_eq!(*corner, s);
            *corner = t;
            let incoming = (face, (k + 2) % 3);
            if last == Some(incoming) {
                break;
            }
            at = self.across.get(&incoming).copied();
            assert!(at.is_some() || last.is_none(), "the arc misses the left cut");
        }
        if let Some(cut) = left {
            let face = Face::Of(op, 0);
            let l = apex(&cut, self);
            assert!(self.corners.insert(face, [s, t, l]).is_none());
            self.join((face, 1), cut[1]);
            self.join((face, 2), cut[0]);
        }
        if let Some(cut) = right {
            let face = Face::Of(op, 1);
            let r = apex(&cut, self);
            assert!(self.corners.insert(face, [t, s, r]).is_none());
            self.join((face, 1), cut[1]);
            self.join((face, 2), cut[0]);
        }
        if left.is_some() && right.is_some() {
            self.join((Face::Of(op, 0), 0), Some((Face::Of(op, 1), 0)));
        }
    }

    /// Clockwise from the face that `entering` lies in to the boundary.
    fn boundary_start(&self, entering: Edge, s: Vertex) -> Option<Edge> {
        let mut leaving = (entering.0, (entering.1 + 1) % 3);
        while let Some(&(face, k)) = self.across.get(&leaving) {
            leaving = (face, (k + 1) % 3);
            assert_eq!(self.ends(leaving)[0], s);
        }
        Some(leaving)
    }

    /// The vertex that a split splits.
    pub(super) fn vertex_s(dag: &Dag, record: &SplitRecord) -> Vertex {
        let spawns = dag.spawns.len() as u32;
        let mut record = record;
        loop {
            if record.tree_parent == NO_OP || record.tree_parent < spawns {
                return Vertex::Root(record.s);
            }
            if record.s == 1 {
                return Vertex::Of(record.tree_parent);
            }
            assert_eq!(record.s, 0);
            record = &dag.splits[(record.tree_parent - spawns) as usize];
        }
    }

    /// Where `v` is now.
    pub(super) fn position(&self, v: Vertex) -> [i32; 3] {
        self.positions[&v]
    }

    /// The mesh as a sorted multiset of oriented triangles of (position, colour).
    pub(super) fn triangles(&self) -> Vec<[([i32; 3], [u8; 3]); 3]> {
        sorted(self.corners.values().map(|corners| corners.map(|v| (self.positions[&v], self.colors[&v]))))
    }

    /// The faces around each vertex, as positions.
    pub(super) fn stars(&self) -> HashMap<Vertex, Vec<[[i32; 3]; 3]>> {
        let mut stars: HashMap<Vertex, Vec<_>> = HashMap::new();
        for corners in self.corners.values() {
            for v in corners {
                stars.entry(*v).or_default().push(corners.map(|v| self.positions[&v]));
            }
        }
        stars
    }

    /// Panics unless twins agree about their ends, the other way round.
    pub(super) fn check_twins(&self) {
        for (&edge, &other) in &self.across {
            assert_eq!(self.across.get(&other), Some(&edge));
            let [a, b] = self.ends(edge);
            assert_eq!(self.ends(other), [b, a]);
        }
    }
}

/// Triangles in a form that compares as an oriented multiset: each starts at its smallest corner.
pub(super) fn sorted<T: Ord + Copy>(triangles: impl Iterator<Item = [T; 3]>) -> Vec<[T; 3]> {
    let mut all: Vec<[T; 3]> = triangles
        .map(|[a, b, c]| [[a, b, c], [b, c, a], [c, a, b]].into_iter().min().expect("three rotations"))
        .collect();
    all.sort_unstable();
    all
}
