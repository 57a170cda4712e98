//! The walk over a patch, face by face across the edges of what was already walked, that numbers its vertices and faces.
//!
//! Encoder, decoder and [`canonical_order`] take the same steps, so that no order is ever sent: a patch that is coded this way
//! has the order of its walk.

use std::collections::{BTreeMap, BTreeSet};

use super::vertex::{BENDS, VertexModels, bend, to_middle};
use super::{Malformed, PatchModels};
use crate::mesh::Patch;
use crate::op::range_coder::{BitCoder, NumberModel, Prob, contexts, uniform};
use crate::op::trained::TRAINED;

const NONE: u32 = u32::MAX;

/// Longest border whose vertices are ranked by distance, so that a patch takes time in proportion to its faces.
pub(super) const MAX_RANKED: usize = 256;

/// Adaptive contexts for what lies across an edge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct AcrossModels {
    /// By how the border bends at both ends.
    pub(super) by_bend: [[Steps; BENDS]; BENDS],
    /// Whether a hole of three edges is filled.
    pub(super) fills: Prob,
    /// Whether there is nothing, by how many ends are known to lie on the boundary.
    pub(super) is_boundary: [Prob; 3],
    pub(super) rank: NumberModel,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Steps {
    pub(super) is_new: Prob,
    pub(super) is_before: Prob,
    pub(super) is_after: Prob,
}

contexts!(Steps: is_new, is_before, is_after);
contexts!(AcrossModels: by_bend, fills, is_boundary, rank);

impl AcrossModels {
    pub(super) fn new() -> Self {
        const NEW: Steps = Steps { is_new: Prob::HALF, is_before: Prob::HALF, is_after: Prob::HALF };
        Self {
            by_bend: [const { [NEW; BENDS] }; BENDS],
            fills: Prob::HALF,
            is_boundary: [Prob::HALF; 3],
            rank: NumberModel::NEW,
        }
    }
}

/// Where the encoding end finds what to code, as far as it was walked. That of the
/// empty patch, which a decoder uses, knows nothing.
pub(super) struct Given<'a> {
    patch: &'a Patch,
    twins: Vec<[u32; 3]>,
    /// Faces in the order of the walk: number in the patch and which corner comes first.
    faces: Vec<(u32, u8)>,
    /// Vertices in the order of the walk.
    vertices: Vec<u32>,
    /// By vertex of the patch, its number in the walk or [`NONE`].
    numbers: Vec<u32>,
    /// By face: whether a component that was begun has it.
    is_begun: Vec<bool>,
    next_face: usize,
}

impl<'a> Given<'a> {
    /// `None` for a patch that is no oriented manifold. O(F log F).
    pub(super) fn new(patch: &'a Patch) -> Option<Self> {
        Some(Self {
            twins: patch.validate().ok()?,
            faces: Vec::with_capacity(patch.faces.len()),
            vertices: Vec::with_capacity(patch.positions.len()),
            numbers: vec![NONE; patch.positions.len()],
            is_begun: vec![false; patch.faces.len()],
            next_face: 0,
            patch,
        })
    }

    fn enter(&mut self, face: u32, corner: u8) {
        self.faces.push((face, corner));
        // Of the first face of a component all vertices are new, and of any other at most one.
        for k in 0..3 {
            let v = self.corner(face, corner, k);
            if self.numbers[v as usize] == NONE {
                self.numbers[v as usize] = self.vertices.len() as u32;
                self.vertices.push(v);
            }
        }
    }

    fn corner(&self, face: u32, first: u8, k: u8) -> u32 {
        self.patch.faces[face as usize][usize::from((first + k) % 3)]
    }

    /// Enters the next component: the one of the first face that no component so far has, at its vertex of the smallest
    /// position (x, then y, then z, then the number), in the first face there.
    fn begin(&mut self) {
        while self.is_begun.get(self.next_face) == Some(&true) {
            self.next_face += 1;
        }
        if self.next_face >= self.is_begun.len() {
            return;
        }
        let mut stack = vec![self.next_face as u32];
        self.is_begun[self.next_face] = true;
        let mut first = None;
        while let Some(face) = stack.pop() {
            let corners = self.patch.faces[face as usize];
            for (k, v) in (0..).zip(corners) {
                let key = (self.patch.positions[v as usize], v, face, k);
                first = Some(first.map_or(key, |first: ([i32; 3], u32, u32, u8)| first.min(key)));
            }
            for &twin in self.twins[face as usize].iter().filter(|&&twin| twin != NONE) {
                if !std::mem::replace(&mut self.is_begun[(twin / 4) as usize], true) {
                    stack.push(twin / 4);
                }
            }
        }
        if let Some((_, _, face, corner)) = first {
            self.enter(face, corner);
        }
    }

    /// Face and corner at the far side of edge `edge` of face `face` of the walk.
    fn twin(&self, face: u32, edge: u8) -> Option<(u32, u8)> {
        let &(face, first) = self.faces.get(face as usize)?;
        let twin = self.twins[face as usize][usize::from((first + edge) % 3)];
        (twin != NONE).then_some((twin / 4, (twin % 4) as u8))
    }

    /// Number of the vertex across an edge; if it is a new one, that of the next.
    fn across(&self, face: u32, edge: u8) -> Option<u32> {
        let (face, first) = self.twin(face, edge)?;
        let number = self.numbers[self.corner(face, first, 2) as usize];
        Some(number.min(self.vertices.len() as u32))
    }

    fn vertex(&self, number: usize) -> ([i32; 3], [u8; 3]) {
        let Some(&v) = self.vertices.get(number) else { return Default::default() };
        (self.patch.positions[v as usize], self.patch.colors[v as usize])
    }

    /// Whether the walk has met vertices and faces as they are numbered.
    fn is_in_order(&self) -> bool {
        self.vertices.iter().copied().eq(0..self.patch.positions.len() as u32)
            && self.faces.iter().copied().eq((0..self.patch.faces.len() as u32).map(|face| (face, 0)))
    }
}

/// What is beside an edge of the border of what was walked.
#[derive(Clone, Copy)]
struct Beside {
    opposite: u32,
    face: u32,
    edge: u8,
}

/// A walk as far as it has come.
pub(super) struct Walk<'s, 'p> {
    source: &'s mut Given<'p>,
    lattice_bits: u8,
    has_colors: bool,
    /// Whether the patch has no boundary.
    is_closed: bool,
    /// What it has in all.
    vertices: usize,
    faces: usize,
    out: Patch,
    /// Edges of the border, as (from, to) in the direction of the face beside them.
    border: BTreeMap<(u32, u32), Beside>,
    /// The same as (to, from).
    reverse: BTreeSet<(u32, u32)>,
    /// Border edges whose turn will come, the next one last, and some that are inside by now.
    gates: Vec<(u32, u32)>,
    /// By vertex.
    is_on_boundary: Vec<bool>,
}

impl<'s, 'p> Walk<'s, 'p> {
    pub(super) fn new(source: &'s mut Given<'p>, lattice_bits: u8, has_colors: bool, size: [u32; 2]) -> Self {
        Self {
            source,
            lattice_bits,
            has_colors,
            is_closed: true,
            vertices: size[0] as usize,
            faces: size[1] as usize,
            out: Patch::default(),
            border: BTreeMap::new(),
            reverse: BTreeSet::new(),
            gates: Vec::new(),
            is_on_boundary: Vec::new(),
        }
    }

    /// Codes the patch. O(F log F), no allocation beyond what was coded.
    pub(super) fn code(mut self, coder: &mut impl BitCoder, models: &mut PatchModels) -> Result<Patch, Malformed> {
        let is_closed = self.source.twins.iter().flatten().all(|&twin| twin != NONE);
        self.is_closed = coder.bit(&mut models.is_closed, is_closed);
        while self.out.faces.len() < self.faces {
            match self.gates.pop() {
                Some((a, b)) => {
                    if let Some(&beside) = self.border.get(&(a, b)) {
                        self.cross(coder, models, a, b, beside)?;
                    }
                }
                None => self.begin(coder, &mut models.vertex)?,
            }
        }
        if self.out.positions.len() == self.vertices { Ok(self.out) } else { Err(Malformed) }
    }

    /// Codes the first face of a component.
    fn begin(&mut self, coder: &mut impl BitCoder, models: &mut VertexModels) -> Result<(), Malformed> {
        self.source.begin();
        let first = self.out.positions.len();
        if first + 3 > self.vertices {
            return Err(Malformed);
        }
        for v in first..first + 3 {
            let (position, color) = self.source.vertex(v);
            let before = &self.out.positions[first..];
            let position = models.of_first_face(coder, self.lattice_bits, before, position)?;
            self.out.positions.push(position);
            let near = match v - first {
                0 => None,
                k => Some([self.out.colors[first], self.out.colors[first + k - 1]]),
            };
            self.color(coder, models, near, color);
        }
        let first = first as u32;
        self.add_face([first, first + 1, first + 2], 0);
        Ok(())
    }

    fn color(
        &mut self,
        coder: &mut impl BitCoder,
        models: &mut VertexModels,
        near: Option<[[u8; 3]; 2]>,
        value: [u8; 3],
    ) {
        let color = if self.has_colors { models.color(coder, near, value) } else { [0; 3] };
        self.out.colors.push(color);
        self.is_on_boundary.push(false);
    }

    /// Codes what lies across an edge of the border.
    fn cross(
        &mut self,
        coder: &mut impl BitCoder,
        models: &mut PatchModels,
        a: u32,
        b: u32,
        beside: Beside,
    ) -> Result<(), Malformed> {
        // The border before `a` and after `b`, where the newest edge counts if it passes more than once.
        let before = self.reverse.range((a, 0)..=(a, u32::MAX)).next_back().map(|edge| edge.1);
        let after = self.border.range((b, 0)..=(b, u32::MAX)).next_back().map(|(edge, _)| edge.1);
        let at = |v: u32| self.out.positions[v as usize];
        let [pa, pb, pd] = [at(a), at(b), at(beside.opposite)];
        let bends = [bend(pa, pb, pd, before.map(at)), bend(pb, pa, pd, after.map(at))];
        let PatchModels { across, vertex: vertex_models, .. } = models;
        let steps = &mut across.by_bend[bends[0]][bends[1]];

        let wanted = self.source.across(beside.face, beside.edge);
        let next = self.out.positions.len() as u32;
        let may_be_new = self.out.positions.len() < self.vertices;
        let third = if may_be_new && coder.bit(&mut steps.is_new, wanted == Some(next)) {
            next
        } else {
            let fills = before.is_some() && before == after;
            let is_before = if fills { &mut across.fills } else { &mut steps.is_before };
            match (before, after) {
                (Some(before), _) if coder.bit(is_before, wanted == Some(before)) => before,
                (_, Some(after)) if !fills && coder.bit(&mut steps.is_after, wanted == Some(after)) => after,
                _ => {
                    let ends = [a, b].iter().filter(|&&v| self.is_on_boundary[v as usize]).count();
                    if !self.is_closed && coder.bit(&mut across.is_boundary[ends], wanted.is_none()) {
                        self.border.remove(&(a, b));
                        self.reverse.remove(&(b, a));
                        self.is_on_boundary[a as usize] = true;
                        self.is_on_boundary[b as usize] = true;
                        return Ok(());
                    }
                    self.elsewhere(coder, across, [a, b], [before, after], wanted)?
                }
            }
        };
        if third > next || third == a || third == b || (third == next && !may_be_new) {
            return Err(Malformed);
        }
        if let Some((face, corner)) = self.source.twin(beside.face, beside.edge) {
            self.source.enter(face, corner);
        }
        if third == next {
            let (position, color) = self.source.vertex(next as usize);
            let position = vertex_models.across(coder, self.lattice_bits, [pa, pb, pd], position)?;
            self.out.positions.push(position);
            let near = [self.out.colors[a as usize], self.out.colors[b as usize]];
            self.color(coder, vertex_models, Some(near), color);
        }
        self.add_face([b, a, third], 1);
        Ok(())
    }

    /// Codes a vertex that is none of `known` and not beside the edge from `a` to `b`: by how many vertices of the border are nearer to the
    /// edge's middle, or by its number when the border is long.
    fn elsewhere(
        &self,
        coder: &mut impl BitCoder,
        models: &mut AcrossModels,
        [a, b]: [u32; 2],
        known: [Option<u32>; 2],
        wanted: Option<u32>,
    ) -> Result<u32, Malformed> {
        let count = self.out.positions.len() as u32;
        if self.border.len() > MAX_RANKED {
            return Ok(uniform(coder, wanted.unwrap_or(0), count));
        }
        let at = |v: u32| self.out.positions[v as usize];
        let mut ranked: Vec<(u64, u32)> = Vec::with_capacity(self.border.len());
        for &(v, _) in self.border.keys() {
            let is_new = ranked.last().is_none_or(|&(_, last)| last != v);
            if is_new && v != a && v != b && !known.contains(&Some(v)) {
                ranked.push((to_middle(at(a), at(b), at(v)), v));
            }
        }
        ranked.sort_unstable();
        let rank = ranked.iter().position(|&(_, v)| Some(v) == wanted).unwrap_or(0) as u32;
        let rank = models.rank.code(coder, rank);
        ranked.get(rank as usize).map(|&(_, v)| v).ok_or(Malformed)
    }

    /// Adds a face and its edges but for the first `known` ones, which are known to be inside.
    fn add_face(&mut self, corners: [u32; 3], known: usize) {
        let face = self.out.faces.len() as u32;
        self.out.faces.push(corners);
        for k in 0..3 {
            let (from, to) = (corners[k], corners[(k + 1) % 3]);
            if self.border.remove(&(to, from)).is_some() {
                self.reverse.remove(&(from, to));
            } else if k >= known {
                self.border.insert((from, to), Beside { opposite: corners[(k + 2) % 3], face, edge: k as u8 });
                self.reverse.insert((to, from));
                self.gates.push((from, to));
            }
        }
    }
}

/// Codes nothing: each bit is what the encoding end says.
struct Silent;

impl BitCoder for Silent {
    fn bit(&mut self, _: &mut Prob, bit: bool) -> bool {
        bit
    }

    fn raw(&mut self, value: u32, _: u32) -> u32 {
        value
    }
}

/// The order in which a patch is coded best.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CanonicalOrder {
    /// Vertices of the patch in this order.
    pub vertices: Vec<u32>,
    /// Faces of the patch in this order, and which of their corners comes first.
    pub faces: Vec<(u32, u8)>,
}

impl CanonicalOrder {
    /// The patch in this order.
    pub fn apply(&self, patch: &Patch) -> Patch {
        let mut numbers = vec![0; self.vertices.len()];
        for (number, &v) in (0..).zip(&self.vertices) {
            numbers[v as usize] = number;
        }
        let corner = |face: u32, k: usize| numbers[patch.faces[face as usize][k % 3] as usize];
        Patch {
            positions: self.vertices.iter().map(|&v| patch.positions[v as usize]).collect(),
            colors: self.vertices.iter().map(|&v| patch.colors[v as usize]).collect(),
            faces: self.faces.iter().map(|&(f, first)| [0, 1, 2].map(|k| corner(f, usize::from(first) + k))).collect(),
        }
    }
}

/// The order in which the coder of patches walks over `patch`; components keep theirs, which is that of their first faces.
/// That of a patch in canonical order changes nothing. `None` if the patch is no oriented manifold with one fan per vertex, or
/// a position is off every lattice. O(F log F).
pub fn canonical_order(patch: &Patch) -> Option<CanonicalOrder> {
    let source = walked(patch)?;
    Some(CanonicalOrder { vertices: source.vertices, faces: source.faces })
}

/// Whether the patch is in canonical order.
pub(super) fn is_canonical(patch: &Patch) -> bool {
    walked(patch).is_some_and(|source| source.is_in_order())
}

fn walked(patch: &Patch) -> Option<Given<'_>> {
    let mut source = Given::new(patch)?;
    let size = [patch.positions.len() as u32, patch.faces.len() as u32];
    let walk = Walk::new(&mut source, crate::quant::MAX_LATTICE_BITS, false, size);
    walk.code(&mut Silent, &mut PatchModels::new(&TRAINED)).ok()?;
    Some(source)
}
