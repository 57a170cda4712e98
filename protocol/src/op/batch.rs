//! Batches: many ops coded in rounds against the state of both ends.
//!
//! Order: collapses and despawns, then spawns, then splits. Within each kind the first round names its members as gaps in
//! an ordered candidate set; a later round flags only those candidates that the round before it can have made legal.

use std::collections::BTreeSet;
use std::num::NonZeroU16;

use super::cut::{CutModels, Ranking};
use super::fixed::lg;
use super::geometry::GeometryModels;
use super::local::Ring;
use super::observe::{BatchTrace, Breakdown, Note, Observed, Part};
use super::patch::{PatchModels, fits};
use super::range_coder::{BitCoder, Contexts, Decoder, Encoder, NumberModel, Prob, ScaledSet, Source, contexts};
use super::steps::StepModels;
use super::trained::{TRAINED, Trained};
use crate::cache::SplitCache;
use crate::ids::VertexSlot;
use crate::limits::MAX_OPS_PER_BATCH;
use crate::mesh::{ApplyError, Cut, Fan, NewVertex, Patch, PatchError, Replica, SlotSet, TOUCHED_AT_ONCE};

/// Contexts of gaps by how the gaps before were against what is expected.
const GAP_CLASSES: usize = 4;

/// Everything that an op changes and that both ends hold alike: mesh, op cache, coder contexts.
#[derive(Clone, Debug)]
pub struct OpState {
    replica: Replica,
    cache: SplitCache,
    models: Box<Models>,
    trained: &'static Trained,
    lattice_bits: u8,
    has_colors: bool,
    has_moves: bool,
    visual_step: Option<NonZeroU16>,
    fan: Fan,
    ring: Ring,
    ranking: Ranking,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Models {
    forget: Prob,
    count: [NumberModel; 3],
    collapse_gap: Gaps,
    split_gap: Gaps,
    spawn_gap: NumberModel,
    /// By whether this is round 2 or later.
    collapse_flag: [Prob; 2],
    /// By the roles that the candidate had, whether its next split is cached, whether this is round 2 or later.
    split_flag: [[[Prob; 2]; 2]; 16],
    same_cut: Prob,
    cut: CutModels,
    geometry: GeometryModels,
    steps: StepModels,
    patch: PatchModels,
}

contexts!(Models: forget, count, collapse_gap, split_gap, spawn_gap, collapse_flag, split_flag, same_cut, cut, geometry, steps);

impl Models {
    fn new(trained: &Trained) -> Self {
        let mut models = Self {
            forget: Prob::HALF,
            count: [NumberModel::NEW; 3],
            collapse_gap: Gaps::NEW,
            split_gap: Gaps::NEW,
            spawn_gap: NumberModel::NEW,
            collapse_flag: [Prob::HALF; 2],
            split_flag: [[[Prob::HALF; 2]; 2]; 16],
            same_cut: Prob::HALF,
            cut: CutModels::NEW,
            geometry: GeometryModels::NEW,
            steps: StepModels::NEW,
            patch: PatchModels::new(trained),
        };
        models.start_from(trained.priors);
        models
    }

    /// All contexts, in the order of [`Trained::priors`].
    fn for_each_context(&mut self, visit: &mut dyn FnMut(&mut Prob)) {
        self.for_each(visit);
        self.patch.for_each(visit);
    }
}

/// Adaptive contexts of the gaps between members of a set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Gaps {
    by_last: [ScaledSet; GAP_CLASSES],
    escape: NumberModel,
}

contexts!(Gaps: by_last, escape);

impl Gaps {
    const NEW: Self = Self { by_last: [ScaledSet::NEW; GAP_CLASSES], escape: NumberModel::NEW };
}

/// What a batch did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OpCounts {
    /// Vertex splits, cached ones included.
    pub splits: u32,
    /// Splits that came from the cache.
    pub cached_splits: u32,
    /// Edge collapses.
    pub collapses: u32,
    /// Components inserted.
    pub spawns: u32,
    /// Components removed.
    pub despawns: u32,
    /// Most triangles after any op of the batch.
    pub max_triangles: u32,
}

impl OpCounts {
    /// Ops of all kinds.
    pub fn total(&self) -> u32 {
        self.splits + self.collapses + self.spawns + self.despawns
    }
}

/// Why a batch was refused. The state is of no use then: ask for a reset.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// The bytes end too early or go on after the end, or a number is out of range.
    #[error("malformed batch")]
    Malformed,
    /// More ops than a batch may hold.
    #[error("a batch of more than {MAX_OPS_PER_BATCH} ops")]
    TooManyOps,
    /// An op breaks the triangle limit.
    #[error("{triangles} triangles are over the limit of {limit}")]
    OverLimit {
        /// Triangles after the op.
        triangles: u32,
        /// Limit in force.
        limit: u32,
    },
    /// An op does not fit the mesh.
    #[error(transparent)]
    Apply(#[from] ApplyError),
}

impl OpState {
    /// The state before any op.
    ///
    /// # Errors
    /// [`PatchError`] if the base is no manifold.
    pub fn new(
        base: &Patch,
        lattice_bits: u8,
        has_colors: bool,
        has_moves: bool,
        cache_capacity: u32,
    ) -> Result<Self, PatchError> {
        Self::with_trained(&TRAINED, base, lattice_bits, has_colors, has_moves, cache_capacity)
    }

    /// As [`new`](Self::new) with other numbers than those that both ends are built with: for training.
    ///
    /// # Errors
    /// [`PatchError`] if the base is no manifold.
    pub fn with_trained(
        trained: &'static Trained,
        base: &Patch,
        lattice_bits: u8,
        has_colors: bool,
        has_moves: bool,
        cache_capacity: u32,
    ) -> Result<Self, PatchError> {
        Ok(Self {
            replica: Replica::new(base)?,
            cache: SplitCache::new(cache_capacity),
            models: Box::new(Models::new(trained)),
            trained,
            lattice_bits,
            has_colors,
            has_moves,
            visual_step: None,
            fan: Fan::default(),
            ring: Ring::default(),
            ranking: Ranking::default(),
        })
    }

    /// The same for a model of this step, see [`ModelInfo::visual_step`](crate::message::ModelInfo::visual_step).
    pub fn with_step(self, visual_step: Option<NonZeroU16>) -> Self {
        Self { visual_step, ..self }
    }

    /// The mesh.
    pub fn replica(&self) -> &Replica {
        &self.replica
    }

    /// The mesh, for dirty tracking.
    pub fn replica_mut(&mut self) -> &mut Replica {
        &mut self.replica
    }

    /// The op cache.
    pub fn cache(&self) -> &SplitCache {
        &self.cache
    }

    /// Calls `visit` with each context of the coder, in the order of [`Trained::priors`].
    #[cfg(any(test, feature = "testing"))]
    pub(super) fn for_each_context(&mut self, visit: &mut dyn FnMut(&mut Prob)) {
        self.models.for_each_context(visit);
    }

    /// Bytes of memory held, for accounting.
    pub fn heap_bytes(&self) -> usize {
        self.replica.heap_bytes() + self.cache.heap_bytes() + size_of::<Models>()
    }
}

/// The rounds of one batch, in either direction.
struct Rounds<'a, C> {
    state: &'a mut OpState,
    coder: C,
    counts: OpCounts,
    round: usize,
    /// Candidates of the next round, ascending, with the roles they had.
    candidates: Vec<(u32, u8)>,
    /// Work space for the ops whose last reference went.
    released: Vec<VertexSlot>,
}

const ROLE_S: u8 = 1;
const ROLE_T: u8 = 2;
const ROLE_LEFT: u8 = 4;
const ROLE_RIGHT: u8 = 8;

impl<'a, C: BitCoder> Rounds<'a, C> {
    fn new(state: &'a mut OpState, mut coder: C, forget_cuts: bool) -> Self {
        let forgets_cuts = coder.bit(&mut state.models.forget, forget_cuts);
        if forgets_cuts {
            state.cache.forget_cuts();
        }
        coder.note(Note::Batch { forgets_cuts });
        let counts = OpCounts { max_triangles: state.replica.triangle_count(), ..OpCounts::default() };
        Self { state, coder, counts, round: 0, candidates: Vec::new(), released: Vec::new() }
    }

    fn begin_kind(&mut self) {
        self.round = 0;
        self.candidates.clear();
    }

    /// Names the members of a round of collapses and returns them. `chosen` is ascending and a subset of the candidates.
    fn collapse_round(&mut self, chosen: &[u32]) -> Result<Vec<u32>, DecodeError> {
        self.round += 1;
        let models = &mut self.state.models;
        if self.round == 1 {
            let set = self.state.replica.collapsible();
            let (count, gaps) = (&mut models.count[0], &mut models.collapse_gap);
            let chosen = code_gaps(&mut self.coder, count, gaps, set, chosen, |_| Part::Collapse)?;
            self.coder.note(Note::Collapses(&chosen));
            return Ok(chosen);
        }
        let flag = &mut models.collapse_flag[usize::from(self.round > 2)];
        let coder = &mut self.coder;
        let mut chosen = chosen.iter().copied().peekable();
        let is_chosen = |&(slot, _): &(u32, u8)| coder.bit(flag, chosen.next_if_eq(&slot).is_some());
        let chosen: Vec<u32> = self.candidates.iter().copied().filter(is_chosen).map(|(slot, _)| slot).collect();
        self.coder.note(Note::Spent(Part::Collapse));
        self.coder.note(Note::Collapses(&chosen));
        Ok(chosen)
    }

    /// Applies a round of collapses and lists the candidates of the next.
    fn apply_collapses(&mut self, chosen: &[u32]) -> Result<(), DecodeError> {
        self.released.clear();
        for &slot in chosen {
            let slot = VertexSlot(slot);
            if self.state.replica.is_spawn(slot) {
                let (_, slots) = self.state.replica.despawn(slot)?;
                self.state.cache.drop_slots(&slots);
                self.counts.despawns += 1;
            } else {
                let undo = self.state.replica.collapse(slot, &mut self.released)?;
                self.state.cache.push(slot, &undo);
                self.counts.collapses += 1;
            }
            self.check_ops()?;
        }
        self.candidates.clear();
        self.candidates.extend(self.released.iter().map(|slot| (slot.0, 0)));
        self.candidates.sort_unstable();
        Ok(())
    }

    /// Codes how many spawns follow.
    fn spawn_count(&mut self, count: u32) -> u32 {
        let count = self.state.models.count[1].code(&mut self.coder, count);
        self.coder.note(Note::Spent(Part::Control));
        count
    }

    /// Codes and applies a spawn; ids ascend within a batch, `after` is the one before.
    fn spawn(
        &mut self,
        after: Option<u32>,
        id: u32,
        patch: &Patch,
        limit: u32,
        may_hold: impl Fn(&C, u32, u32) -> bool,
    ) -> Result<(u32, VertexSlot), DecodeError> {
        let state = &mut *self.state;
        let first = after.map_or(0, |id| id.saturating_add(1));
        let gap = gap_before(state.replica.spawned_ids(), first, id);
        let gap = state.models.spawn_gap.code(&mut self.coder, gap);
        let id = skip_gap(state.replica.spawned_ids(), first, gap).ok_or(DecodeError::Malformed)?;
        let patch = state
            .models
            .patch
            .code(&mut self.coder, state.lattice_bits, state.has_colors, patch, may_hold)
            .map_err(|_| DecodeError::Malformed)?;
        self.coder.note(Note::Spent(Part::Spawn));
        self.coder.note(Note::Spawn(id, &patch));
        self.check_limit(patch.faces.len() as u32, limit)?;
        let slot = self.state.replica.spawn(id, &patch)?;
        self.counts.spawns += 1;
        self.note_triangles();
        self.check_ops()?;
        Ok((id, slot))
    }

    /// Names the members of a round of splits and returns them. `chosen` is ascending and a subset of the candidates.
    fn split_round(&mut self, chosen: &[u32]) -> Result<Vec<u32>, DecodeError> {
        self.round += 1;
        let models = &mut self.state.models;
        if self.round == 1 {
            let set = self.state.replica.vertices();
            let cache = &self.state.cache;
            let part = |slot| if cache.top(VertexSlot(slot)).is_some() { Part::Cached } else { Part::Address };
            let (count, gaps) = (&mut models.count[2], &mut models.split_gap);
            let chosen = code_gaps(&mut self.coder, count, gaps, set, chosen, part)?;
            self.coder.note(Note::SplitRound);
            return Ok(chosen);
        }
        let (coder, cache, late) = (&mut self.coder, &self.state.cache, usize::from(self.round > 2));
        let mut chosen = chosen.iter().copied().peekable();
        let is_chosen = |&(slot, roles): &(u32, u8)| {
            let cached = usize::from(cache.top(VertexSlot(slot)).is_some());
            let flag = &mut models.split_flag[usize::from(roles)][cached][late];
            let is_chosen = coder.bit(flag, chosen.next_if_eq(&slot).is_some());
            coder.note(Note::Spent(if cached == 1 { Part::Cached } else { Part::Address }));
            is_chosen
        };
        let members = self.candidates.iter().copied().filter(is_chosen).map(|(slot, _)| slot).collect();
        self.coder.note(Note::SplitRound);
        self.candidates.clear();
        Ok(members)
    }

    /// Codes and applies the split of `s`, a member of the round. `resolve` says what the encoding end wants, given the fan.
    fn split(
        &mut self,
        s: u32,
        limit: u32,
        resolve: impl FnOnce(&Replica, &Fan) -> Option<(Cut, NewVertex)>,
    ) -> Result<VertexSlot, DecodeError> {
        let OpState { replica, cache, models, trained, has_colors, has_moves, visual_step, fan, ring, ranking, .. } =
            &mut *self.state;
        let models = &mut **models;
        replica.fan(VertexSlot(s), fan)?;
        let (cut, vertex) = resolve(replica, fan).ok_or(DecodeError::Malformed)?;
        let (cut, vertex, is_cached) = match cache.top(VertexSlot(s)) {
            Some(cached) => {
                let guess = if cached.cut_known { guess_cut(fan, cached.left, cached.right) } else { None };
                let cut = match guess {
                    Some(guess) if self.coder.bit(&mut models.same_cut, cut == guess) => guess,
                    _ => {
                        ring.read(s, fan, replica.positions());
                        models.cut.code(&mut self.coder, &trained.cut, ranking, ring, fan, cut)
                    }
                };
                self.coder.note(Note::Spent(Part::Cached));
                (cut, cached.vertex, true)
            }
            None => {
                ring.read(s, fan, replica.positions());
                let cut = models.cut.code(&mut self.coder, &trained.cut, ranking, ring, fan, cut);
                self.coder.note(Note::Spent(Part::Cut));
                if !fan.admits(cut) {
                    return Err(ApplyError::BadCut { slot: s, faces: fan.faces(), cut }.into());
                }
                let colors = has_colors.then(|| replica.colors());
                let Models { geometry, steps, .. } = models;
                let coarse = visual_step.map(|step| (steps, i32::from(step.get())));
                let coder = &mut self.coder;
                let vertex = geometry.vertex(coder, trained, s, fan, ring, cut, colors, *has_moves, coarse, &vertex);
                (cut, vertex, false)
            }
        };
        let added = match cut {
            Cut::Both { .. } => 2,
            _ => 1,
        };
        let max = (1 << self.state.lattice_bits) - 1;
        let at_s = self.state.replica.positions()[s as usize];
        let moved = (0..3).map(|k| at_s[k].wrapping_add(vertex.s_move[k]));
        if vertex.position.into_iter().chain(moved).any(|x| x < 0 || x > max) {
            return Err(DecodeError::Malformed);
        }
        self.coder.note(Note::Split(s, cut, &vertex));
        self.check_limit(added, limit)?;
        let OpState { replica, cache, fan, .. } = &mut *self.state;
        let t = replica.split(VertexSlot(s), fan, cut, &vertex)?;
        if is_cached {
            cache.pop(VertexSlot(s), t);
            self.counts.cached_splits += 1;
        }
        let ring = fan.ring();
        self.candidates.extend([(s, ROLE_S), (t.0, ROLE_T)]);
        let (left, right) = match cut {
            Cut::Both { right, left } => (Some(left), Some(right)),
            Cut::Left { left } => (Some(left), None),
            Cut::Right { right } => (None, Some(right)),
        };
        self.candidates.extend(left.map(|spoke| (ring[spoke as usize], ROLE_LEFT)));
        self.candidates.extend(right.map(|spoke| (ring[spoke as usize], ROLE_RIGHT)));
        self.counts.splits += 1;
        self.note_triangles();
        self.check_ops()?;
        Ok(t)
    }

    /// Sorts the candidates that a round of splits left behind.
    fn end_split_round(&mut self) {
        sort_by_slot(&mut self.candidates);
        self.candidates.dedup_by(|next, kept| {
            let same = next.0 == kept.0;
            if same {
                kept.1 |= next.1;
            }
            same
        });
    }

    fn note_triangles(&mut self) {
        self.counts.max_triangles = self.counts.max_triangles.max(self.state.replica.triangle_count());
    }

    fn check_ops(&self) -> Result<(), DecodeError> {
        if self.counts.total() > MAX_OPS_PER_BATCH { Err(DecodeError::TooManyOps) } else { Ok(()) }
    }

    fn check_limit(&self, added: u32, limit: u32) -> Result<(), DecodeError> {
        let triangles = self.state.replica.triangle_count().saturating_add(added);
        if triangles > limit { Err(DecodeError::OverLimit { triangles, limit }) } else { Ok(()) }
    }
}

/// Codes a subset of `set`: its size, then for each member how many candidates it skips.
fn code_gaps(
    coder: &mut impl BitCoder,
    count: &mut NumberModel,
    gaps: &mut Gaps,
    set: &SlotSet,
    chosen: &[u32],
    part: impl Fn(u32) -> Part,
) -> Result<Vec<u32>, DecodeError> {
    let count = count.code(coder, chosen.len() as u32);
    coder.note(Note::Spent(Part::Control));
    if count > MAX_OPS_PER_BATCH {
        return Err(DecodeError::TooManyOps);
    }
    if count > set.len() {
        return Err(DecodeError::Malformed);
    }
    let mut members = Vec::with_capacity(count as usize);
    let mut from = 0;
    let mut candidates = set.len();
    // Members lie in clusters: the gaps before tell about the next one more than the mean does. In 1/16, decaying by 1/4.
    let mut recent = u64::from(candidates) * 16 / u64::from(count).max(1);
    for i in 0..count {
        let expected = u64::from(candidates) * 16 / u64::from(count - i);
        let class = match recent {
            recent if recent * 8 < expected => 0,
            recent if recent * 2 < expected => 1,
            recent if recent < expected * 2 => 2,
            _ => 3,
        };
        let gap = chosen.get(i as usize).map_or(0, |&slot| set.count_between(from, slot));
        let gap = gaps.by_last[class].code(coder, &mut gaps.escape, lg(recent.max(1)) - 4 * 16, gap);
        recent = (recent * 3 + u64::from(gap) * 16) / 4;
        if gap >= candidates {
            return Err(DecodeError::Malformed);
        }
        let slot = set.select_from(from, gap).ok_or(DecodeError::Malformed)?;
        coder.note(Note::Spent(part(slot)));
        members.push(slot);
        from = slot + 1;
        candidates -= gap + 1;
    }
    Ok(members)
}

/// Sorts candidates by slot. O(k) for many, as four buckets of bytes, of which only those are visited in which slots differ.
fn sort_by_slot(candidates: &mut Vec<(u32, u8)>) {
    const FEW: usize = 256;
    if candidates.len() < FEW {
        candidates.sort_unstable_by_key(|candidate| candidate.0);
        return;
    }
    let mut other = vec![(0, 0); candidates.len()];
    let used = candidates.iter().fold(0, |used, candidate| used | candidate.0);
    let mut shift = 0;
    while shift < 32 && used >> shift != 0 {
        let digit = |slot: u32| (slot >> shift & 0xff) as usize;
        let mut starts = [0usize; 256];
        for candidate in candidates.iter() {
            starts[digit(candidate.0)] += 1;
        }
        let mut sum = 0;
        for start in &mut starts {
            sum += std::mem::replace(start, sum);
        }
        for &candidate in candidates.iter() {
            let at = &mut starts[digit(candidate.0)];
            other[*at] = candidate;
            *at += 1;
        }
        std::mem::swap(candidates, &mut other);
        shift += 8;
    }
}

/// Ids from `first` on, below `id`, that are not in `taken`.
fn gap_before(taken: &BTreeSet<u32>, first: u32, id: u32) -> u32 {
    id.saturating_sub(first) - taken.range(first..id.max(first)).count() as u32
}

/// The id with exactly `gap` ids that are not in `taken` between `first` and it.
fn skip_gap(taken: &BTreeSet<u32>, first: u32, gap: u32) -> Option<u32> {
    let mut id = first.checked_add(gap)?;
    for &other in taken.range(first..) {
        if other > id {
            break;
        }
        id = id.checked_add(1)?;
    }
    Some(id)
}

/// The cut between the spokes that lead to `left` and `right`, if there is exactly one of each.
fn guess_cut(fan: &Fan, left: VertexSlot, right: VertexSlot) -> Option<Cut> {
    let spoke = |slot: VertexSlot| fan.ring().iter().position(|&r| r == slot.0).map(|i| i as u32);
    let cut = match (right, left) {
        (VertexSlot::NONE, left) => Cut::Left { left: spoke(left)? },
        (right, VertexSlot::NONE) => Cut::Right { right: spoke(right)? },
        (right, left) => Cut::Both { right: spoke(right)?, left: spoke(left)? },
    };
    fan.admits(cut).then_some(cut)
}

/// Encodes one batch while applying it to this end's state.
///
/// Call order: [`collapse_round`](Self::collapse_round) until the round is empty or no candidates are left, then
/// [`spawns`](Self::spawns) in ascending id order, then [`split_round`](Self::split_round) and one [`split`](Self::split) per
/// member, likewise until empty, then [`finish`](Self::finish).
pub struct BatchEncoder<'a> {
    rounds: Rounds<'a, Encoder>,
    stage: Stage,
}

#[derive(PartialEq, Eq, PartialOrd, Ord, Clone, Copy)]
enum Stage {
    Collapses,
    Spawns,
    Splits,
    Done,
}

impl<'a> BatchEncoder<'a> {
    /// Begins a batch. `forget_cuts` makes both ends forget the cuts that their caches hold.
    pub fn new(state: &'a mut OpState, forget_cuts: bool) -> Self {
        Self { rounds: Rounds::new(state, Encoder::new(), forget_cuts), stage: Stage::Collapses }
    }

    /// The mesh as it is now.
    pub fn replica(&self) -> &Replica {
        &self.rounds.state.replica
    }

    /// Ops so far.
    pub fn counts(&self) -> &OpCounts {
        &self.rounds.counts
    }

    /// Bytes so far, give or take a few.
    pub fn len(&self) -> usize {
        self.rounds.coder.len()
    }

    /// Whether no byte has been written.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Collapses the ops at these addresses: ascending; in the first round any of `replica().collapsible()`, later any that
    /// [`candidates`](Self::candidates) lists. Returns whether another round may follow.
    ///
    /// # Errors
    /// [`DecodeError::Apply`] if an op may not collapse: a bug of the caller, the state is lost.
    pub fn collapse_round(&mut self, addresses: &[u32]) -> Result<bool, DecodeError> {
        debug_assert!(self.stage == Stage::Collapses);
        let chosen = self.rounds.collapse_round(addresses)?;
        debug_assert_eq!(chosen, addresses);
        self.rounds.apply_collapses(&chosen)?;
        let more = !chosen.is_empty() && !self.rounds.candidates.is_empty();
        if !more {
            self.stage = Stage::Spawns;
        }
        Ok(more)
    }

    /// Labels the splits that the round before has put into the cache, in order, without the despawns among them: see
    /// [`SplitCache::label_newest`].
    pub fn label_cached(&mut self, labels: &[u32]) {
        self.rounds.state.cache.label_newest(labels);
    }

    /// Slots that the next round may name, ascending.
    pub fn candidates(&self) -> impl Iterator<Item = u32> + '_ {
        self.rounds.candidates.iter().map(|&(slot, _)| slot)
    }

    /// Inserts components, ids ascending, and returns their addresses.
    ///
    /// # Errors
    /// As the decoder would: a bug of the caller, the state is lost.
    pub fn spawns(&mut self, spawns: &[(u32, &Patch)], limit: u32) -> Result<Vec<VertexSlot>, DecodeError> {
        debug_assert!(self.stage == Stage::Spawns);
        self.stage = Stage::Splits;
        self.rounds.begin_kind();
        self.rounds.spawn_count(spawns.len() as u32);
        let mut after = None;
        let mut slots = Vec::with_capacity(spawns.len());
        for &(id, patch) in spawns {
            let (coded, slot) = self.rounds.spawn(after, id, patch, limit, |_, _, _| true)?;
            debug_assert_eq!(coded, id);
            after = Some(id);
            slots.push(slot);
        }
        Ok(slots)
    }

    /// Names the vertices that this round splits: ascending; in the first round any vertices, later any that
    /// [`candidates`](Self::candidates) lists. An empty round ends the splits.
    ///
    /// # Errors
    /// As the decoder would: a bug of the caller, the state is lost.
    pub fn split_round(&mut self, vertices: &[u32]) -> Result<(), DecodeError> {
        debug_assert!(self.stage == Stage::Splits);
        let chosen = self.rounds.split_round(vertices)?;
        debug_assert_eq!(chosen, vertices);
        if chosen.is_empty() {
            self.stage = Stage::Done;
        }
        Ok(())
    }

    /// Splits `s`, the next member of the round, and returns the new slot. `resolve` is given the mesh and `s`'s fan and
    /// says where to cut and what to insert; it must return what the cache holds where the cache holds this split, and
    /// `None` only to give up.
    ///
    /// # Errors
    /// As the decoder would: a bug of the caller, the state is lost.
    pub fn split(
        &mut self,
        s: u32,
        limit: u32,
        resolve: impl FnOnce(&Replica, &Fan) -> Option<(Cut, NewVertex)>,
    ) -> Result<VertexSlot, DecodeError> {
        self.rounds.split(s, limit, resolve)
    }

    /// Ends the round; returns whether another may follow.
    pub fn end_split_round(&mut self) -> bool {
        self.rounds.end_split_round();
        let more = !self.rounds.candidates.is_empty();
        if !more {
            self.stage = Stage::Done;
        }
        more
    }

    /// The batch as bytes and what it did.
    pub fn finish(self) -> (Vec<u8>, OpCounts) {
        debug_assert!(self.stage == Stage::Done);
        (self.rounds.coder.finish(), self.rounds.counts)
    }
}

/// Decodes a batch and applies it op by op. Total on any bytes: work is bounded by [`MAX_OPS_PER_BATCH`] and the mesh.
///
/// # Errors
/// [`DecodeError`]; the state is then of no use.
pub fn decode_batch(bytes: &[u8], state: &mut OpState, limit: u32) -> Result<OpCounts, DecodeError> {
    decode(Decoder::new(bytes), bytes.len(), state, limit)
}

/// As [`decode_batch`], and adds to `breakdown` what the bits were spent on. Some 3 times slower.
///
/// # Errors
/// [`DecodeError`]; the state is then of no use.
pub fn decode_batch_measured(
    bytes: &[u8],
    state: &mut OpState,
    limit: u32,
    breakdown: &mut Breakdown,
) -> Result<OpCounts, DecodeError> {
    decode(Observed::new(Decoder::new(bytes), breakdown), bytes.len(), state, limit)
}

/// As [`decode_batch`], and says what the batch held.
///
/// # Errors
/// [`DecodeError`]; the state is then of no use.
pub fn decode_batch_traced(bytes: &[u8], state: &mut OpState, limit: u32) -> Result<BatchTrace, DecodeError> {
    let mut trace = BatchTrace::default();
    decode(Observed::new(Decoder::new(bytes), &mut trace), bytes.len(), state, limit)?;
    Ok(trace)
}

/// As [`decode_batch`], and counts what the contexts saw.
///
/// # Errors
/// [`DecodeError`]; the state is then of no use.
#[cfg(any(test, feature = "testing"))]
pub fn decode_batch_tallied(
    bytes: &[u8],
    state: &mut OpState,
    limit: u32,
    tally: &mut super::training::Tally,
) -> Result<OpCounts, DecodeError> {
    tally.attach(|visit| state.for_each_context(visit));
    decode(Observed::new(Decoder::new(bytes), tally), bytes.len(), state, limit)
}

/// As [`decode_batch`], and says what the coder did step by step. `decisions` is empty before.
///
/// # Errors
/// [`DecodeError`]; the state is then of no use.
#[cfg(any(test, feature = "testing"))]
pub fn decode_batch_stepwise(
    bytes: &[u8],
    state: &mut OpState,
    limit: u32,
    decisions: &mut super::training::Decisions,
) -> Result<OpCounts, DecodeError> {
    decisions.attach(|visit| state.for_each_context(visit));
    decode(Observed::new(Decoder::new(bytes), decisions), bytes.len(), state, limit)
}

/// See [`training::context_names`](super::training::context_names).
#[cfg(any(test, feature = "testing"))]
pub(super) fn context_names() -> [Vec<String>; 2] {
    let models = Models::new(&TRAINED);
    let mut names = [Vec::new(), Vec::new()];
    Contexts::names(&models, "", &mut names[0]);
    Contexts::names(&models.patch, "", &mut names[1]);
    names
}

fn decode<S: Source>(source: S, byte_count: usize, state: &mut OpState, limit: u32) -> Result<OpCounts, DecodeError> {
    let mut rounds = Rounds::new(state, source, false);
    let check = |rounds: &Rounds<'_, S>| match rounds.coder.is_overrun() {
        true => Err(DecodeError::Malformed),
        false => Ok(()),
    };
    loop {
        let chosen = rounds.collapse_round(&[])?;
        check(&rounds)?;
        rounds.apply_collapses(&chosen)?;
        if chosen.is_empty() || rounds.candidates.is_empty() {
            break;
        }
    }
    rounds.begin_kind();
    let spawns = rounds.spawn_count(0);
    if spawns > MAX_OPS_PER_BATCH {
        return Err(DecodeError::TooManyOps);
    }
    let mut after = None;
    for _ in 0..spawns {
        check(&rounds)?;
        let may_hold = |_: &S, v, f| fits(byte_count, v, f);
        after = Some(rounds.spawn(after, 0, &Patch::default(), limit, may_hold)?.0);
    }
    loop {
        let chosen = rounds.split_round(&[])?;
        check(&rounds)?;
        if chosen.is_empty() {
            break;
        }
        for some in chosen.chunks(TOUCHED_AT_ONCE) {
            rounds.state.replica.touch_fans(some);
            for &s in some {
                rounds.split(s, limit, |_, _| Some((Cut::Left { left: 0 }, NewVertex::default())))?;
                check(&rounds)?;
            }
        }
        rounds.end_split_round();
        if rounds.candidates.is_empty() {
            break;
        }
    }
    if rounds.coder.is_overrun() || rounds.coder.has_trailing() {
        return Err(DecodeError::Malformed);
    }
    Ok(rounds.counts)
}

/// Encodes the ops of `trace` while applying them.
///
/// # Errors
/// As [`decode_batch`] would, if the trace does not fit the state.
pub fn encode_trace(trace: &BatchTrace, state: &mut OpState, limit: u32) -> Result<(Vec<u8>, OpCounts), DecodeError> {
    let mut encoder = BatchEncoder::new(state, trace.forgets_cuts);
    for round in &trace.collapses {
        encoder.collapse_round(round)?;
    }
    let spawns: Vec<(u32, &Patch)> = trace.spawns.iter().map(|(id, patch)| (*id, patch)).collect();
    encoder.spawns(&spawns, limit)?;
    for round in &trace.splits {
        encoder.split_round(&round.iter().map(|split| split.0).collect::<Vec<_>>())?;
        for &(s, cut, vertex) in round {
            encoder.split(s, limit, |_, _| Some((cut, vertex)))?;
        }
        encoder.end_split_round();
    }
    Ok(encoder.finish())
}

mod rest;
pub use rest::SavedContexts;

#[cfg(any(test, feature = "testing"))]
mod random;
#[cfg(any(test, feature = "testing"))]
pub use random::random_batch;

#[cfg(test)]
mod tests;
