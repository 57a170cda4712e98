//! Which collapses are legal: topology (link condition) and geometry (flip test), and the stages in which the geometric part
//! is relaxed once nothing else is left.

use glam::DVec3;

use super::{
    quadric::{others, shape, sliver},
    surface::{Site, Surface, next},
};
use crate::ingest::hierarchy::Point;

/// What a stage of simplification asks of a collapse besides topology.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Stage {
    /// Largest sum of the valences of `s` and `t`.
    pub(crate) max_valence_sum: u32,
    /// Smallest cosine between a face's normals before and after, or `None` for no flip test.
    pub(crate) min_cosine: Option<f64>,
}

/// The stages, in order; each runs until no collapse is left in it.
///
/// The first does the work. The others only make the base small: what they add has errors near the size of its component, so it
/// is never looked at closely. First fans may grow, then folds are let through. Topology holds in all of them, and no
/// face ever loses its area. The last cap keeps an op's cost bounded.
pub(crate) const STAGES: [Stage; 4] = [
    Stage { max_valence_sum: 22, min_cosine: Some(0.2) },
    Stage { max_valence_sum: 40, min_cosine: Some(0.2) },
    Stage { max_valence_sum: 40, min_cosine: None },
    Stage { max_valence_sum: 400, min_cosine: None },
];

/// What a legal collapse was found to do; the buffers are reused from one test to the next.
#[derive(Debug, Default)]
pub(crate) struct Examined {
    /// Spokes of `t` in the faces that go over to `s`.
    pub(crate) arc: Vec<u32>,
    /// Spokes of `s` in the faces that it keeps, if it moves.
    pub(crate) kept: Vec<u32>,
    /// Normals, before and after, of the faces that change shape, twice the area long: those of `arc`, then those of `kept`.
    pub(crate) normals: Vec<(DVec3, DVec3)>,
    /// Neighbours of `t`, and those of `s` if it moves.
    pub(crate) around: Vec<u32>,
    /// Cost of the slivers it makes.
    pub(crate) sliver: f64,
    /// Whether a face without area would get some.
    gains_area: bool,
    /// Per vertex, the number of the last test that met it among the neighbours of `s`.
    seen: Vec<u32>,
    tests: u32,
}

impl Examined {
    pub(crate) fn new(vertex_count: usize) -> Self {
        Self { seen: vec![0; vertex_count], ..Self::default() }
    }

    /// Whether `site` may collapse, with `s` where it is or at a place of its own. `weights` are those of the planes of `s` and `t`. Fills the fields if so. O(valence of s and t).
    ///
    /// Topology is the link condition (Dey, Edelsbrunner, Guha, Nekhayev 1999) with a virtual vertex joined to every boundary
    /// edge, which reduces to: a boundary vertex goes only along a boundary edge; the common neighbours of `s` and `t` are
    /// the third corners of the edge's faces; these keep at least 3 faces inside, 1 on the boundary, so that each removed
    /// face leaves at least one neighbour behind.
    pub(crate) fn is_legal(
        &mut self,
        surface: &Surface,
        points: &[Point],
        site: Site,
        place: Option<DVec3>,
        weights: [f64; 2],
        stage: &Stage,
    ) -> bool {
        let Site { s, t, left, right } = site;
        let sum = surface.valence(s) + surface.valence(t);
        if sum > stage.max_valence_sum || (points[t as usize].is_boundary && left.is_some() && right.is_some()) {
            return false;
        }
        let apexes = [site.left_apex(surface), site.right_apex(surface)];
        let keeps_enough = |v: u32| surface.valence(v) > if points[v as usize].is_boundary { 1 } else { 3 };
        if !apexes.iter().flatten().all(|&v| keeps_enough(v)) || apexes[0] == apexes[1] {
            return false;
        }
        self.has_only_expected_neighbors(surface, site)
            && match place {
                None => self.keeps_orientation(surface, points, site, weights[1], stage),
                Some(place) => self.keeps_both_orientations(surface, points, site, place, weights, stage),
            }
    }

    /// Fills the fields for a collapse that was found legal on another copy of the mesh.
    pub(crate) fn describe(&mut self, surface: &Surface, points: &[Point], site: Site, place: Option<DVec3>) {
        let stage = Stage { max_valence_sum: u32::MAX, min_cosine: None };
        let is_legal = self.is_legal(surface, points, site, place, [0.0; 2], &stage);
        debug_assert!(is_legal);
    }

    fn has_only_expected_neighbors(&mut self, surface: &Surface, site: Site) -> bool {
        self.tests = match self.tests.checked_add(1) {
            Some(tests) => tests,
            None => {
                self.seen.fill(0);
                1
            }
        };
        let Self { seen, tests, around, .. } = self;
        surface.for_each_neighbor(site.s, |v| seen[v as usize] = *tests);
        around.clear();
        let mut common = 0;
        surface.for_each_neighbor(site.t, |v| {
            common += usize::from(seen[v as usize] == *tests);
            around.push(v);
        });
        common == usize::from(site.left.is_some()) + usize::from(site.right.is_some())
    }

    /// The flip test. Cross products of lattice differences are exact, so "zero area" means just that. A face without area
    /// has no normal to keep: it is let through until it gains area, then compared with the mean normal around `t`.
    fn keeps_orientation(
        &mut self,
        surface: &Surface,
        points: &[Point],
        site: Site,
        weight: f64,
        stage: &Stage,
    ) -> bool {
        self.start();
        let Some(start) = surface.arc_start(site) else { return true };
        let stop = site.left.map(next);
        let [s, t] = [site.s, site.t].map(|v| points[v as usize].at());
        let turn = Turn { from: t, to: s, length_squared: s.distance_squared(t), weight };
        for h in surface.spokes_from(start) {
            if Some(h) == stop {
                break;
            }
            if !self.keeps_face(surface, points, h, &turn, stage) {
                return false;
            }
            self.arc.push(h);
        }
        self.gains_area_well(stage, || star_normal(surface, points, site.t))
    }

    /// The flip test where `s` moves to `place`: the faces that it keeps change as well as those of the arc.
    fn keeps_both_orientations(
        &mut self,
        surface: &Surface,
        points: &[Point],
        site: Site,
        place: DVec3,
        weights: [f64; 2],
        stage: &Stage,
    ) -> bool {
        self.start();
        let Self { around, .. } = self;
        surface.for_each_neighbor(site.s, |v| around.push(v));
        let [s, t] = [site.s, site.t].map(|v| points[v as usize].at());
        let length_squared = s.distance_squared(t);
        let stop = site.left.map(next);
        let turn = Turn { from: t, to: place, length_squared, weight: weights[1] };
        let arc = surface.arc_start(site).into_iter().flat_map(|start| surface.spokes_from(start));
        for h in arc.take_while(|&h| Some(h) != stop) {
            if !self.keeps_face(surface, points, h, &turn, stage) {
                return false;
            }
            self.arc.push(h);
        }
        let turn = Turn { from: s, to: place, length_squared, weight: weights[0] };
        let right = site.right.map(next);
        for h in surface.spokes(site.s).filter(|&h| Some(h) != site.left && Some(h) != right) {
            if !self.keeps_face(surface, points, h, &turn, stage) {
                return false;
            }
            self.kept.push(h);
        }
        self.gains_area_well(stage, || star_normal(surface, points, site.s) + star_normal(surface, points, site.t))
    }

    fn start(&mut self) {
        self.arc.clear();
        self.kept.clear();
        self.normals.clear();
        self.sliver = 0.0;
        self.gains_area = false;
    }

    /// Looks at the face of spoke `h`, whose origin moves.
    #[inline]
    fn keeps_face(&mut self, surface: &Surface, points: &[Point], h: u32, turn: &Turn, stage: &Stage) -> bool {
        let (x, y) = others(surface, h);
        let [x, y] = [x, y].map(|v| points[v as usize].at());
        let (before, after) = (shape(turn.from, x, y), shape(turn.to, x, y));
        let lost = after.0 == DVec3::ZERO;
        if before.0 == DVec3::ZERO {
            self.gains_area |= !lost;
        } else if lost || !turns_little(before.0, after.0, stage) {
            return false;
        }
        self.sliver += sliver(before, after, turn.length_squared, turn.weight);
        self.normals.push((before.0, after.0));
        true
    }

    /// Whether the faces that gain area agree with the mean normal around them, which is only asked for then.
    #[inline]
    fn gains_area_well(&self, stage: &Stage, around: impl FnOnce() -> DVec3) -> bool {
        if !self.gains_area || stage.min_cosine.is_none() {
            return true;
        }
        let around = around();
        around == DVec3::ZERO
            || self.normals.iter().all(|&(before, after)| {
                before != DVec3::ZERO || after == DVec3::ZERO || turns_little(around, after, stage)
            })
    }
}

/// How the faces at a vertex change: where it goes, and what a sliver costs there.
struct Turn {
    from: DVec3,
    to: DVec3,
    length_squared: f64,
    weight: f64,
}

/// Sum of the normals around `v`.
fn star_normal(surface: &Surface, points: &[Point], v: u32) -> DVec3 {
    let at = |v: u32| points[v as usize].at();
    surface
        .spokes(v)
        .map(|h| {
            let (x, y) = others(surface, h);
            shape(at(v), at(x), at(y)).0
        })
        .sum()
}

/// Whether the angle between two normals is within the stage's limit.
#[inline]
fn turns_little(before: DVec3, after: DVec3, stage: &Stage) -> bool {
    let Some(min) = stage.min_cosine else { return true };
    let dot = before.dot(after);
    dot > 0.0 && dot * dot > min * min * before.length_squared() * after.length_squared()
}
