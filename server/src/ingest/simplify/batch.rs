//! Order `batched`: passes over the cheapest share of the edges, collapsing an independent set in each.
//!
//! As good as a priority queue within a percent at equal tolerance, several times faster, and of the same DAG depth
//! (ALGORITHMS section 4.1). Costs are kept per edge from pass to pass: a collapse changes only those at the vertex it keeps,
//! and renews them at once. An edge that was found illegal is left alone until something in its neighbourhood changes.

use glam::DVec3;

use super::{
    Method,
    constraint::{Examined, STAGES, Stage},
    measure::{Behind, Chosen, Done, Measurer},
    placement::{self, Edge, Place, Placement, Volume},
    quadric::{self, Planes, Quadric},
    surface::{NONE, Site, Surface},
};
use crate::ingest::hierarchy::{Point, bounds::Carried, deviation::Samples};

/// Share of the edges that a pass considers, cheapest first.
const SHARE: f64 = 0.2;
/// The same once there are at most [`FEW_EDGES`] of components that are simplified to the end. What is left then is what coarse
/// meshes are made of, and passes over it cost next to nothing: the closer they come to the exact order of costs, the less a
/// mesh of 1 % of the triangles strays.
const SHARE_OF_FEW: f64 = 0.05;
const FEW_EDGES: u32 = 1 << 16;
/// Fewest edges that a pass considers.
const MIN_CANDIDATES: u32 = 16;

/// Keys order edges by cost: the bits of a non-negative `f32`, the lowest two of them put to other use.
const KEEPS_TARGET: u32 = 1;
const IS_BLOCKED: u32 = 2;
/// Key of a half-edge that does not stand for its edge (the smaller of two twins does) or is gone.
const NO_KEY: u32 = u32::MAX;
/// Keys per histogram bin, as a shift: three bits of mantissa remain.
const BIN_SHIFT: u32 = 20;
/// Faces whose edges are sorted together: few enough for what they touch to stay in the cache.
const BLOCK: usize = 1024;
/// Most passes over a block in a row, while it is in the cache.
const PASSES_PER_SWEEP: u32 = 4;

/// A mesh under simplification and what is carried with it.
pub(crate) struct Simplifier {
    pub(crate) surface: Surface,
    /// By vertex; where it is now, or was when it went.
    pub(crate) points: Vec<Point>,
    /// Per vertex, whether it takes part in no collapse: some of its faces are elsewhere.
    is_locked: Vec<bool>,
    /// Number of the first collapse.
    first_op: u32,
    /// `None`: half-edge collapses.
    mover: Option<Mover>,
    /// Collapses so far.
    count: u32,
    /// What is recorded of them; up to date but within [`Simplifier::run_ahead`].
    pub(crate) measurer: Measurer,
    /// Who measures instead, meanwhile.
    behind: Option<Behind>,
    /// Per face, the collapse that removed it, or [`NONE`].
    pub(crate) removed_by: Vec<u32>,
    /// Sweeps over the mesh done.
    pub(crate) sweeps: u32,
    /// Number of the current pass over a block.
    passes: u32,
    /// From how few edges on a pass takes [`SHARE_OF_FEW`] of them.
    few_edges: u32,
    /// Per vertex that is left.
    planes: Vec<Planes>,
    /// Key per half-edge.
    keys: Vec<u32>,
    /// Pass in which a half-edge was last found illegal.
    blocked_in: Vec<u32>,
    /// Per vertex, the last pass in which its star changed. In that pass it takes no further part.
    changed_in: Vec<u32>,
    live_faces: Vec<u32>,
    bins: Vec<u32>,
    /// Keys and half-edges of a block's candidates, before and after sorting.
    unsorted: Vec<(u32, u32)>,
    candidates: Vec<(u32, u32)>,
    examined: Examined,
    /// Edges at the vertex just kept, as half-edges, and their other ends.
    around: Vec<(u32, u32)>,
}

/// How vertices that stay move.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Mover {
    pub(super) rule: &'static dyn Placement,
    /// Largest coordinate of the lattice.
    pub(super) max_coordinate: i32,
}

/// What came of an attempt.
enum Outcome {
    Collapsed,
    Illegal,
    /// Legal, but at a cost over the pass's limit.
    Postponed(u32),
}

/// What the vertices of a surface bring along, an entry for each.
pub(crate) struct State {
    pub(crate) points: Vec<Point>,
    /// Whether the vertex takes part in no collapse: some of its faces are elsewhere.
    pub(crate) is_locked: Vec<bool>,
    pub(crate) quadrics: Vec<Quadric>,
    pub(crate) carried: Vec<Carried>,
    pub(crate) samples: Samples,
}

#[cfg(test)]
impl State {
    /// Of a complete mesh.
    pub(crate) fn of_originals(surface: &Surface, points: Vec<Point>, has_colors: bool) -> Self {
        let mut quadrics = quadric::of_faces(surface, &points);
        quadric::add_borders(&mut quadrics, surface, &points, |_, _| true);
        Self {
            is_locked: vec![false; points.len()],
            quadrics,
            carried: originals(surface, &points),
            samples: Samples::new(points.len(), has_colors),
            points,
        }
    }
}

impl Simplifier {
    /// Collapses are numbered from `first_op` on. O(vertices + faces).
    pub(crate) fn new(surface: Surface, state: State, method: Method, first_op: u32) -> Self {
        let vertices = surface.vertex_count();
        let State { points, is_locked, quadrics, carried, samples } = state;
        let planes = (0..vertices as u32).map(|v| Planes::around(&surface, &points, v)).collect();
        let mut simplifier = Self {
            points,
            is_locked,
            first_op,
            mover: method.mover,
            count: 0,
            measurer: Measurer::new(carried, quadrics, samples, method, first_op),
            behind: None,
            removed_by: vec![NONE; surface.face_count()],
            sweeps: 0,
            passes: 0,
            few_edges: 0,
            planes,
            keys: vec![NO_KEY; 3 * surface.face_count()],
            blocked_in: vec![0; 3 * surface.face_count()],
            changed_in: vec![0; vertices],
            live_faces: (0..surface.face_count() as u32).collect(),
            unsorted: Vec::new(),
            bins: vec![0; (NO_KEY >> BIN_SHIFT) as usize + 1],
            candidates: Vec::new(),
            examined: Examined::new(vertices),
            around: Vec::new(),
            surface,
        };
        simplifier.renew_all_keys();
        simplifier
    }

    /// Works on these faces from now on, ascending. No edge has one of them on one side and another face on the other.
    pub(crate) fn turn_to(&mut self, faces: Vec<u32>) {
        self.live_faces = faces;
    }

    /// Collapses until no collapse is legal in any stage. `progress` hears the share of the faces that are gone.
    pub(crate) fn run(&mut self, progress: &mut dyn FnMut(f32)) {
        let faces = self.live_faces.len().max(1) as f32;
        self.few_edges = FEW_EDGES;
        for stage in &STAGES {
            while self.sweep(stage) {
                progress(1.0 - self.live_faces.len() as f32 / faces);
            }
            self.renew_all_keys();
        }
        self.live_faces.retain(|&f| self.removed_by[f as usize] == NONE);
    }

    /// Collapses in the first stage until at most `target` faces are left or nothing is legal in it. `progress` hears how many
    /// are left.
    pub(crate) fn run_down_to(&mut self, target: usize, progress: &mut dyn FnMut(usize)) {
        self.few_edges = 0;
        while self.live_faces.len() > target && self.sweep(&STAGES[0]) {
            self.live_faces.retain(|&f| self.removed_by[f as usize] == NONE);
            progress(self.live_faces.len());
        }
    }

    /// Does `work` while another thread measures what it collapses, on a copy of the mesh; both are done when this returns.
    pub(crate) fn run_ahead(&mut self, work: impl FnOnce(&mut Self)) {
        std::thread::scope(|scope| {
            let measurer = std::mem::take(&mut self.measurer);
            let (behind, thread) = Behind::start(scope, self.surface.clone(), self.points.clone(), measurer);
            self.behind = Some(behind);
            work(self);
            self.behind = None;
            match thread.join() {
                Ok(measurer) => self.measurer = measurer,
                Err(panic) => std::panic::resume_unwind(panic),
            }
        });
    }

    /// Whether a face is still there.
    pub(crate) fn is_live(&self, face: u32) -> bool {
        self.removed_by[face as usize] == NONE
    }

    /// Faces that are left, ascending.
    #[cfg(test)]
    pub(crate) fn root_faces(&self) -> Vec<(u32, [u32; 3])> {
        self.live_faces.iter().map(|&f| (f, self.surface.corners(f))).collect()
    }

    fn renew_all_keys(&mut self) {
        let Self { live_faces, removed_by, .. } = self;
        live_faces.retain(|&f| removed_by[f as usize] == NONE);
        for i in 0..self.live_faces.len() {
            let f = self.live_faces[i];
            for h in 3 * f..3 * f + 3 {
                if self.surface.twin(h).is_none_or(|twin| h < twin) {
                    self.keys[h as usize] = self.edge_key(h);
                }
            }
        }
    }

    /// One sweep over the mesh. False if there was no edge left to consider.
    fn sweep(&mut self, stage: &Stage) -> bool {
        let Some(limit) = self.limit() else { return false };
        let live_faces = std::mem::take(&mut self.live_faces);
        for block in live_faces.chunks(BLOCK) {
            for _ in 0..PASSES_PER_SWEEP {
                self.passes += 1;
                let before = self.count;
                self.sort_candidates(block, limit);
                let candidates = std::mem::take(&mut self.candidates);
                for &(key, h) in &candidates {
                    self.consider(key, h, limit, stage);
                }
                self.candidates = candidates;
                if self.count == before {
                    break;
                }
            }
        }
        self.live_faces = live_faces;
        self.sweeps += 1;
        true
    }

    /// Tries to collapse the edge at `h` to the place that the placement says, then in either direction, the one in its key
    /// first; notes what came of it in the key.
    fn consider(&mut self, key: u32, h: u32, limit: u32, stage: &Stage) {
        let (a, b) = (self.surface.origin(h), self.surface.target(h));
        if self.changed_in[a as usize] == self.passes || self.changed_in[b as usize] == self.passes {
            return;
        }
        let keep_origin = key & KEEPS_TARGET == 0;
        let mut outcome = self.attempt_moving(h, limit, stage);
        for keep_origin in [keep_origin, !keep_origin] {
            if matches!(outcome, Outcome::Illegal) {
                outcome = self.attempt(h, keep_origin, None, limit, stage);
            }
        }
        self.keys[h as usize] = match outcome {
            Outcome::Collapsed => return,
            Outcome::Postponed(key) => key,
            Outcome::Illegal => {
                self.blocked_in[h as usize] = self.passes;
                key | IS_BLOCKED
            }
        };
    }

    /// Largest key among the cheapest share of the edges that are not blocked, rounded up to a bin; `None` if all are blocked.
    /// Drops removed faces from the list, and renews the keys of blocked edges around which something has changed.
    fn limit(&mut self) -> Option<u32> {
        self.bins.fill(0);
        let mut live_faces = std::mem::take(&mut self.live_faces);
        live_faces.retain(|&f| self.removed_by[f as usize] == NONE);
        let mut open = 0;
        for &f in &live_faces {
            for (h, mut key) in (3 * f..).zip(three(&self.keys, f)) {
                if key == NO_KEY {
                    continue;
                }
                if key & IS_BLOCKED != 0 {
                    let ends = [self.surface.origin(h), self.surface.target(h)];
                    let blocked_in = self.blocked_in[h as usize];
                    if ends.iter().all(|&v| self.changed_in[v as usize] < blocked_in) {
                        continue;
                    }
                    key = self.edge_key(h);
                    self.keys[h as usize] = key;
                    if key & IS_BLOCKED != 0 {
                        self.blocked_in[h as usize] = self.passes;
                        continue;
                    }
                }
                self.bins[(key >> BIN_SHIFT) as usize] += 1;
                open += 1;
            }
        }
        self.live_faces = live_faces;
        let share = if open <= self.few_edges { SHARE_OF_FEW } else { SHARE };
        let wanted = ((f64::from(open) * share) as u32).max(MIN_CANDIDATES).min(open);
        let mut total = 0;
        let last = self.bins.iter().position(|&count| {
            total += count;
            total >= wanted
        })?;
        (open > 0).then_some((last as u32) << BIN_SHIFT | ((1 << BIN_SHIFT) - 1))
    }

    /// Fills `candidates` with the edges of some faces within the limit, cheaper bins first, by half-edge within a bin.
    ///
    /// Which of two far edges comes first makes no difference, so each block is sorted by itself: its part of the mesh stays
    /// in the cache while it is worked on.
    fn sort_candidates(&mut self, faces: &[u32], limit: u32) {
        let last = (limit >> BIN_SHIFT) as usize;
        let bins = &mut self.bins[..=last];
        bins.fill(0);
        self.unsorted.clear();
        for &f in faces {
            for (h, key) in (3 * f..).zip(three(&self.keys, f)) {
                if key <= limit && key & IS_BLOCKED == 0 {
                    bins[(key >> BIN_SHIFT) as usize] += 1;
                    self.unsorted.push((key, h));
                }
            }
        }
        let mut start = 0;
        for count in bins.iter_mut() {
            start += std::mem::replace(count, start);
        }
        self.candidates.clear();
        self.candidates.resize(self.unsorted.len(), (NO_KEY, NONE));
        for &candidate in &self.unsorted {
            let place = &mut bins[(candidate.0 >> BIN_SHIFT) as usize];
            self.candidates[*place as usize] = candidate;
            *place += 1;
        }
    }

    /// The edge at `h` and its rule, if the vertex that joins its ends may move. An edge with one end on the boundary may not: that
    /// end stays put.
    #[inline]
    fn movable(&self, h: u32) -> Option<(&'static dyn Placement, Edge<'_>)> {
        let Mover { rule, max_coordinate: max } = self.mover?;
        let ends = [self.surface.origin(h), self.surface.target(h)];
        if self.surface.twin(h).is_some() && ends.iter().any(|&v| self.points[v as usize].is_boundary) {
            return None;
        }
        let planes = ends.map(|v| &self.planes[v as usize]);
        Some((rule, Edge { ends: ends.map(|v| &self.points[v as usize]), planes, max }))
    }

    /// Tries to place the vertex that joins the ends of `h` where its rule says; as good as illegal if it may not move.
    fn attempt_moving(&mut self, h: u32, limit: u32, stage: &Stage) -> Outcome {
        let Some((rule, edge)) = self.movable(h) else { return Outcome::Illegal };
        let place = rule.settle(&edge, rule.place(&edge), &|| self.volume(h));
        self.attempt(h, place.keeps_first, Some(place), limit, stage)
    }

    /// The volume around the edge at `h` as a function of the place that replaces it: relative to the place of its origin, which
    /// the sums would cancel against if they were not.
    fn volume(&self, h: u32) -> Volume {
        let ends = [self.surface.origin(h), self.surface.target(h)];
        let at = |v: u32| self.points[v as usize].at();
        let origin = at(ends[0]);
        let mut normal = DVec3::ZERO;
        let mut height = 0.0;
        for end in ends {
            for spoke in self.surface.spokes(end) {
                let (x, y) = quadric::others(&self.surface, spoke);
                // The faces at the edge are met from both its ends.
                if end == ends[1] && (x == ends[0] || y == ends[0]) {
                    continue;
                }
                let corner = at(end);
                let face = (at(x) - corner).cross(at(y) - corner);
                normal += face;
                height += face.dot(corner - origin);
            }
        }
        Volume { normal, height: height + normal.dot(origin) }
    }

    /// Tries one direction of the edge at `h`, with the vertex that stays where it is or at a place of its own.
    fn attempt(&mut self, h: u32, keep_origin: bool, place: Option<Place>, limit: u32, stage: &Stage) -> Outcome {
        let site = Site::new(&self.surface, h, keep_origin);
        let Site { s, t, .. } = site;
        let place = place.filter(|place| place.at != self.points[s as usize].position);
        let key_of = |cost: f64| key_of(cost) | if keep_origin { 0 } else { KEEPS_TARGET };
        let cost = place.map_or_else(|| self.costs(s, t)[0], |place| place.cost);
        // What is kept may be out of date, since the planes at an edge also change when an edge nearby is collapsed.
        if key_of(cost) > limit {
            return Outcome::Postponed(key_of(cost));
        }
        let weights = [s, t].map(|v| self.planes[v as usize].weight);
        let at = place.map(|place| placement::vector(place.at));
        if !self.examined.is_legal(&self.surface, &self.points, site, at, weights, stage) {
            return Outcome::Illegal;
        }
        let key = key_of(cost + self.examined.sliver);
        if key > limit {
            return Outcome::Postponed(key);
        }
        self.collapse(site, place);
        Outcome::Collapsed
    }

    /// Costs of the edge between `a` and `b`: keeping the former, and keeping the latter.
    #[inline]
    fn costs(&self, a: u32, b: u32) -> [f64; 2] {
        let [(pa, qa), (pb, qb)] = [a, b].map(|v| (&self.points[v as usize], &self.planes[v as usize]));
        quadric::costs(pa, qa, pb, qb)
    }

    /// Key of the cheaper direction of an edge, or of its place. A direction that takes a boundary vertex inside is no choice.
    fn edge_key(&self, h: u32) -> u32 {
        let (a, b) = (self.surface.origin(h), self.surface.target(h));
        if self.is_locked[a as usize] || self.is_locked[b as usize] {
            return NO_KEY;
        }
        if let Some((rule, edge)) = self.movable(h) {
            let place = rule.place(&edge);
            return key_of(place.cost) | if place.keeps_first { 0 } else { KEEPS_TARGET };
        }
        let is_inner = self.surface.twin(h).is_some();
        let may_go = |v: u32| !(is_inner && self.points[v as usize].is_boundary);
        let [keep_a, keep_b] = self.costs(a, b);
        let keep_origin = if may_go(b) { key_of(keep_a) } else { NO_KEY };
        let keep_target = if may_go(a) { key_of(keep_b) | KEEPS_TARGET } else { NO_KEY };
        match keep_origin.min(keep_target) {
            // Neither will do as long as the edge has two faces; it is looked at again when something changes.
            NO_KEY => key_of(0.0) | IS_BLOCKED,
            key => key,
        }
    }

    /// Collapses a legal site, which `examined` describes. O(valence), allocates only to grow.
    fn collapse(&mut self, site: Site, place: Option<Place>) {
        let Site { s, t, left, right } = site;
        let op = self.first_op + self.count;
        self.count += 1;
        let before = [s, t].map(|v| self.points[v as usize]);
        let moved = place.map(|place| moved(before, place));
        match &mut self.behind {
            Some(behind) => behind.push(Chosen::new(site, moved)),
            None => self.measurer.begin(&self.surface, &self.points, site, moved, &self.examined),
        }
        let Self { surface, points, examined, .. } = self;
        let removed = [(left, site.left_apex(surface)), (right, site.right_apex(surface))]
            .map(|(h, apex)| h.zip(apex).map(|(h, apex)| (apex, surface.face_normal(points, h / 3))));
        let outer = surface.collapse(site, &examined.arc);
        for h in [left, right].into_iter().flatten() {
            let face = h / 3;
            self.removed_by[face as usize] = op;
            self.keys[3 * face as usize..3 * face as usize + 3].fill(NO_KEY);
        }
        if let Some(moved) = moved {
            self.points[s as usize] = moved;
        }
        self.renew_planes(s, moved.is_some(), removed);
        self.changed_in[s as usize] = self.passes;
        self.changed_in[t as usize] = self.passes;
        let Self { surface, around, .. } = self;
        around.clear();
        surface.for_each_edge(s, |h, v| around.push((h, v)));
        for i in 0..self.around.len() {
            let (h, v) = self.around[i];
            self.changed_in[v as usize] = self.passes;
            self.renew_key(h);
        }
        if self.behind.is_none() {
            let Self { surface, points, examined, around, .. } = self;
            let has_moved = moved.is_some();
            self.measurer.finish(Done { surface, points, site, outer, before, has_moved, around }, examined);
        }
    }

    /// Renews the planes of `s` and of its neighbours after a collapse that `examined` describes. `removed` are the third corners
    /// of the removed faces and their normals.
    fn renew_planes(&mut self, s: u32, has_moved: bool, removed: [Option<(u32, DVec3)>; 2]) {
        let Self { surface, points, planes, examined, .. } = self;
        let mut own = planes[s as usize];
        for (apex, normal) in removed.into_iter().flatten() {
            let face = Planes::of_face(normal);
            planes[apex as usize].remove(&face);
            own.remove(&face);
        }
        for (&h, &(before, after)) in examined.arc.iter().chain(&examined.kept).zip(&examined.normals) {
            let (x, y) = quadric::others(surface, h);
            let (before, after) = (Planes::of_face(before), Planes::of_face(after));
            own.add(&after);
            for v in [x, y] {
                planes[v as usize].remove(&before);
                planes[v as usize].add(&after);
            }
        }
        // All faces of a vertex that moved are others, and planes of border edges change too.
        let is_anew = has_moved || points[s as usize].is_boundary;
        planes[s as usize] = if is_anew { Planes::around(surface, points, s) } else { own };
        surface.for_each_neighbor(s, |v| {
            if points[v as usize].is_boundary {
                planes[v as usize] = Planes::around(surface, points, v);
            }
        });
    }

    fn renew_key(&mut self, h: u32) {
        let twin = self.surface.twin(h).unwrap_or(NONE);
        let own = h.min(twin);
        self.keys[own as usize] = self.edge_key(own);
        if twin != NONE {
            self.keys[h.max(twin) as usize] = NO_KEY;
        }
    }
}

/// The entries of a face's half-edges.
#[inline]
fn three(keys: &[u32], face: u32) -> [u32; 3] {
    let h = 3 * face as usize;
    let keys = &keys[h..h + 3];
    [keys[0], keys[1], keys[2]]
}

fn key_of(cost: f64) -> u32 {
    (cost as f32).to_bits() & !(KEEPS_TARGET | IS_BLOCKED)
}

/// The first of two ends after it has gone to a place.
fn moved([from, other]: [Point; 2], place: Place) -> Point {
    let share = placement::share([&from, &other], place.at);
    let color = placement::color(from.color, other.color, share);
    Point { position: place.at, color, is_boundary: from.is_boundary }
}

/// What the vertices of the complete mesh carry: their one-rings, as far as they are here.
pub(crate) fn originals(surface: &Surface, points: &[Point]) -> Vec<Carried> {
    let units: Vec<DVec3> = (0..surface.face_count() as u32)
        .map(|face| {
            let normal = surface.face_normal(points, face);
            let length = normal.length();
            if length > 0.0 { normal / length } else { DVec3::ZERO }
        })
        .collect();
    let mut ring = Vec::new();
    let mut normals = Vec::new();
    // Where some faces of a vertex are elsewhere, those that are here may be several fans.
    let mut scattered = Vec::new();
    let mut carried: Vec<Carried> = (0..surface.vertex_count() as u32)
        .map(|v| {
            ring.clear();
            normals.clear();
            ring.push(points[v as usize].at());
            let mut faces = 0;
            for h in surface.spokes(v) {
                normals.extend(Some(units[h as usize / 3]).filter(|&unit| unit != DVec3::ZERO));
                faces += 1;
            }
            if faces < surface.valence(v) {
                scattered.push(v);
            }
            surface.for_each_neighbor(v, |n| ring.push(points[n as usize].at()));
            Carried::new(&ring, &normals)
        })
        .collect();
    if scattered.is_empty() {
        return carried;
    }
    let mut corners: Vec<(u32, u32)> = (0..surface.face_count() as u32)
        .flat_map(|face| surface.corners(face).map(|v| (v, face)))
        .filter(|(v, _)| scattered.binary_search(v).is_ok())
        .collect();
    corners.sort_unstable();
    for star in corners.chunk_by(|a, b| a.0 == b.0) {
        ring.clear();
        normals.clear();
        for &(_, face) in star {
            ring.extend(surface.corners(face).map(|v| points[v as usize].at()));
            normals.extend(Some(units[face as usize]).filter(|&unit| unit != DVec3::ZERO));
        }
        carried[star[0].0 as usize] = Carried::new(&ring, &normals);
    }
    carried
}
