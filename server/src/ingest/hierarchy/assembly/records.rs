//! From collapses to splits, in the order of refinement.

use rayon::prelude::*;

use super::roots::Roots;
use super::splits::{NO_CUT, ROOT_CUT, Runs, SPLIT_CUT, StoredSplit};
use super::{ErrorRange, Grain, Model, blocks_from_the_end, invalid};
use crate::ingest::hierarchy::{CollapseRecord, NONE, RootFace, RootVertex};
use crate::ingest::spill::{Spill, SpillError, SpillWriter, Workspace};
use crate::pack::record::NO_OP;
use crate::pack::{Outline, WriteError};

/// In a slot: the rest is a place among the root vertices.
const IS_ROOT: u32 = 1 << 31;
/// Codes of a split's faces per op: two faces, three corners to begin at.
const CODES: u32 = 6;

/// Finds out what each collapse refers to. Collapses come from the last one back; at each, the faces that later ones
/// removed are known, and these are all that it can refer to.
pub(super) struct Recorder {
    /// Per collapse: what it is the first op of, until its turn; then its depth. The former is a root vertex, or twice the tree
    /// parent plus one if `s` is that one's `t`.
    slots: Vec<u32>,
    /// Per face: who owns it and where its stored corners begin, see [`Owner`]; [`NONE`] until it is known.
    owners: Vec<u32>,
    /// Number of collapses.
    ops: u32,
    base_vertices: u32,
    base_faces: u32,
    /// By number of a root face, which of its corners is stored first.
    root_firsts: Vec<u8>,
    /// By place among the root vertices: number and spawn.
    roots: Vec<(u32, u32)>,
    /// See [`Shape`](super::Shape).
    pub(super) depth: u32,
    pub(super) parents: [u64; 4],
    pub(super) errors: ErrorRange,
    pub(super) has_moves: bool,
}

/// What a collapse refers to, as collapses and codes.
#[derive(Clone, Copy)]
struct Resolved {
    /// As in [`Recorder::slots`].
    tree: u32,
    /// Code of the owner on either side, or [`NONE`].
    cuts: [u32; 2],
    edges: [u8; 2],
}

impl Recorder {
    pub(super) fn new(
        model: &Model,
        outline: &Outline,
        roots: &Roots,
        vertices: &[RootVertex],
        faces: &[RootFace],
        ops: u32,
    ) -> Result<Self, WriteError> {
        let codes = u64::from(ops) * u64::from(CODES) + faces.len() as u64;
        if codes >= u64::from(NONE) || ops >= IS_ROOT / 2 {
            return Err(invalid(format!("{ops} collapses are too many")));
        }
        let mut slots = vec![NONE; ops as usize];
        for (place, vertex) in (0..).zip(vertices) {
            if vertex.last != NONE {
                // Roots have looked whether there is such a collapse, unless the vertex has no face.
                *slots.get_mut(vertex.last as usize).ok_or_else(|| invalid("a root vertex names no collapse"))? =
                    IS_ROOT | place;
            }
        }
        let mut owners = vec![NONE; model.faces as usize];
        for (face, &number) in faces.iter().zip(&roots.face_numbers) {
            owners[face.face as usize] = ops * CODES + number;
        }
        Ok(Self {
            slots,
            owners,
            ops,
            base_vertices: outline.starts[0].vertex,
            base_faces: outline.starts[0].face,
            root_firsts: roots.firsts_by_number(),
            roots: roots.vertex_numbers.iter().copied().zip(roots.vertex_owners.iter().copied()).collect(),
            depth: 0,
            parents: [0; 4],
            errors: ErrorRange::default(),
            has_moves: false,
        })
    }

    /// Goes through all collapses. While one run of them is turned into splits, the next is looked through.
    pub(super) fn run(
        &mut self,
        collapses: &Spill<CollapseRecord>,
        ids: &[u32],
        spawns: u32,
        workspace: &Workspace,
        grain: &Grain,
        progress: &mut dyn FnMut(f32),
    ) -> Result<Runs, WriteError> {
        let end = spawns + self.ops;
        let roots = std::mem::take(&mut self.roots);
        let mut filing = Filing {
            ids,
            codes_end: self.ops * CODES,
            roots: &roots,
            bucket: grain.bucket,
            buckets: end.div_ceil(grain.bucket),
            starts: vec![0],
            splits: workspace.spill(),
            places: Vec::new(),
            grouped: Vec::new(),
        };
        let (mut ready, mut next) = (Run::default(), Run::default());
        for range in blocks_from_the_end(collapses.len(), grain.collapses) {
            let (resolved, filed) = rayon::join(
                || {
                    next.first = range.start as u32;
                    collapses.read_into(range.clone(), &mut next.collapses)?;
                    self.resolve(&mut next, &roots)
                },
                || filing.file(&ready),
            );
            resolved?;
            filed?;
            std::mem::swap(&mut ready, &mut next);
            progress(1.0 - range.start as f32 / self.ops as f32);
        }
        filing.file(&ready)?;
        Ok(Runs { splits: filing.splits.finish()?, starts: filing.starts, bucket: grain.bucket, ids: spawns..end })
    }

    fn resolve(&mut self, run: &mut Run, roots: &[(u32, u32)]) -> Result<(), WriteError> {
        run.resolved.clear();
        run.resolved.resize(run.collapses.len(), Resolved { tree: NONE, cuts: [NONE; 2], edges: [0; 2] });
        for i in (0..run.collapses.len()).rev() {
            let op = run.first + i as u32;
            let resolved = self.resolve_one(op, &run.collapses[i], roots);
            run.resolved[i] = resolved.map_err(|reason| invalid(format!("collapse {op} {reason}")))?;
        }
        Ok(())
    }

    fn resolve_one(
        &mut self,
        op: u32,
        collapse: &CollapseRecord,
        roots: &[(u32, u32)],
    ) -> Result<Resolved, &'static str> {
        let tree = self.slots[op as usize];
        if tree == NONE {
            return Err("is no child of another and the last of no root vertex");
        }
        let [fn0, fn1, fn2, fn3] = collapse.outer;
        let [left, right] = [self.younger([fn0, fn1])?, self.younger([fn3, fn2])?];
        self.count_parents(op, tree, [left.0, right.0], roots)?;
        for (child, role) in [(collapse.next_of_s, 0), (collapse.first_of_t, 1)] {
            if child != NONE {
                let slot = self.slots.get_mut(child as usize).filter(|slot| child < op && **slot == NONE);
                *slot.ok_or("has a child that comes after it or has another parent")? = op << 1 | role;
            }
        }
        for (h, side) in [(collapse.left, 0), (collapse.right, 3)] {
            if h != NONE {
                let owner = self.owners.get_mut(h as usize / 3).filter(|owner| **owner == NONE);
                *owner.ok_or("removes a face that does not exist or is removed later")? = op * CODES + side + h % 3;
            }
        }
        self.errors.add(collapse.bounds().error);
        self.has_moves |= collapse.s_move != [0; 3] || collapse.s_color_move != [0; 3];
        Ok(Resolved { tree, cuts: [left.0, right.0], edges: [left.1, right.1] })
    }

    /// Code of the younger of the two faces beside a cut, and which edge of it the cut is. The younger is the one that was
    /// removed first, those that never were are oldest. `cut` has the half-edges in the faces, the one on the side of `s` first.
    fn younger(&self, cut: [u32; 2]) -> Result<(u32, u8), &'static str> {
        let code = |h: u32| match self.owners.get(h as usize / 3) {
            None | Some(&NONE) => Err("has a neighbour that is not there"),
            Some(&code) => Ok(code),
        };
        let (h, code) = match cut {
            [NONE, NONE] => return Ok((NONE, 0)),
            [h, NONE] | [NONE, h] => (h, code(h)?),
            [a, b] => {
                let (of_a, of_b) = (code(a)?, code(b)?);
                let is_split = |code: u32| code < self.ops * CODES;
                if is_split(of_b) && (!is_split(of_a) || of_b / CODES < of_a / CODES) { (b, of_b) } else { (a, of_a) }
            }
        };
        // Stored corners start at `s` of `f_l` and at `t` of `f_r`, where the halves of the collapsed edge start.
        let first = match code.checked_sub(self.ops * CODES) {
            None => code % 3,
            Some(number) => self.root_firsts[number as usize].into(),
        };
        Ok((code, ((h % 3 + 3 - first) % 3) as u8))
    }

    /// Takes note of the depth of an op.
    fn count_parents(&mut self, op: u32, tree: u32, cuts: [u32; 2], roots: &[(u32, u32)]) -> Result<(), &'static str> {
        const BASE: u32 = NONE;
        // Which spawn it is makes no difference: an op has parents in a single component.
        const SPAWN: u32 = NONE - 1;
        let root_or = |is_base: bool| if is_base { BASE } else { SPAWN };
        let tree = match tree & IS_ROOT {
            0 => tree >> 1,
            _ => {
                let (number, _) = roots[(tree & !IS_ROOT) as usize];
                if number == NONE {
                    return Err("leaves a vertex without a face");
                }
                root_or(number < self.base_vertices)
            }
        };
        let owner = |code: u32| match code {
            NONE => BASE,
            code if code < self.ops * CODES => code / CODES,
            code => root_or(code - self.ops * CODES < self.base_faces),
        };
        let parents = [tree, owner(cuts[0]), owner(cuts[1])];
        let (mut distinct, mut depth) = (0, 0);
        for (i, &parent) in parents.iter().enumerate() {
            if parent != BASE {
                distinct += usize::from(!parents[..i].contains(&parent));
                depth = depth.max(if parent == SPAWN { 1 } else { self.slots[parent as usize] });
            }
        }
        self.slots[op as usize] = depth + 1;
        self.parents[distinct] += 1;
        self.depth = self.depth.max(depth + 1);
        Ok(())
    }
}

/// Some collapses one after the other, and what they refer to.
#[derive(Default)]
struct Run {
    first: u32,
    collapses: Vec<CollapseRecord>,
    resolved: Vec<Resolved>,
}

/// Makes splits with their final ids and files them by bucket.
struct Filing<'a> {
    /// Final id of each collapse.
    ids: &'a [u32],
    /// One past the largest code of a split's face.
    codes_end: u32,
    roots: &'a [(u32, u32)],
    /// Ids of a bucket, and how many buckets there are.
    bucket: u32,
    buckets: u32,
    starts: Vec<u64>,
    splits: SpillWriter<'a, StoredSplit>,
    places: Vec<u32>,
    grouped: Vec<StoredSplit>,
}

impl Filing<'_> {
    fn file(&mut self, run: &Run) -> Result<(), SpillError> {
        if run.collapses.is_empty() {
            return Ok(());
        }
        let ids = &self.ids[run.first as usize..][..run.collapses.len()];
        let mut next = vec![0u32; self.buckets as usize];
        for id in ids {
            next[(id / self.bucket) as usize] += 1;
        }
        let (mut at, before) = (0, self.splits.len());
        for count in &mut next {
            at += std::mem::replace(count, at);
            self.starts.push(before + u64::from(at));
        }
        self.places.resize(ids.len(), 0);
        for (place, id) in (0..).zip(ids) {
            let bucket = &mut next[(id / self.bucket) as usize];
            self.places[*bucket as usize] = place;
            *bucket += 1;
        }
        let mut grouped = std::mem::take(&mut self.grouped);
        let split = |&place: &u32| self.split(run, place);
        self.places.par_iter().with_min_len(1 << 10).map(split).collect_into_vec(&mut grouped);
        self.splits.push(&grouped)?;
        self.grouped = grouped;
        Ok(())
    }

    fn split(&self, run: &Run, place: u32) -> StoredSplit {
        let (collapse, resolved) = (&run.collapses[place as usize], &run.resolved[place as usize]);
        let id = |op: u32| if op == NONE { NO_OP } else { self.ids[op as usize] };
        let (tree_parent, s) = match resolved.tree & IS_ROOT {
            0 => (self.ids[(resolved.tree >> 1) as usize], resolved.tree & 1),
            _ => {
                let (number, owner) = self.roots[(resolved.tree & !IS_ROOT) as usize];
                (owner, number)
            }
        };
        let cut = |k: usize| match resolved.cuts[k] {
            NONE => (0, NO_CUT),
            code if code < self.codes_end => {
                let side = (code / 3 % 2) as u8;
                (self.ids[(code / CODES) as usize], (SPLIT_CUT + side) | (resolved.edges[k] << 2))
            }
            code => (code - self.codes_end, ROOT_CUT | (resolved.edges[k] << 2)),
        };
        let (left, right) = (cut(0), cut(1));
        let bounds = collapse.bounds();
        StoredSplit {
            id: self.ids[(run.first + place) as usize],
            tree_parent,
            s,
            cuts: [left.0, right.0],
            next_of_s: id(collapse.next_of_s),
            first_of_t: id(collapse.first_of_t),
            position: collapse.position,
            s_move: collapse.s_move,
            center: bounds.center,
            radius: bounds.radius.0,
            error: bounds.error.0,
            axis: bounds.cone.axis,
            half_angle: bounds.cone.half_angle,
            color: collapse.color,
            s_color_move: collapse.s_color_move,
            kinds: [left.1, right.1],
            padding: 0,
        }
    }
}
