//! What is recorded of each collapse: its error, its sphere and cone, and what the vertex that stays carries on.
//!
//! None of it has a say in what is collapsed next. So a second thread may do it [`Behind`] the one that chooses, on a copy of
//! the mesh that goes through the same collapses, with the same result.

use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::{Scope, ScopedJoinHandle};

use glam::DVec3;

use super::{
    Method,
    constraint::Examined,
    quadric::Quadric,
    surface::{NONE, Site, Surface},
};
use crate::ingest::hierarchy::paper::ErrorRule;
use crate::ingest::hierarchy::{
    Collapse, Point,
    bounds::{self, Carried, Normals, Sphere},
    deviation::{Samples, Star, Surroundings},
};

/// Factor on the sampled deviation and on the RMS quadric distance (ALGORITHMS section 5).
const SAMPLED_FACTOR: f64 = 1.5;
const RMS_FACTOR: f64 = 2.0;
/// Factor on colour difference times diameter.
const COLOR_FACTOR: f64 = 0.25;
/// Errors below this many lattice steps are rounding, not shape: coplanar faces in a tilted plane.
const SMALLEST_ERROR: f64 = 1.0 / 4096.0;

/// Collapses that a thread hands over at once.
const BATCH: usize = 512;
/// Such batches that may wait.
const WAITING: usize = 64;

/// What vertices carry, and the collapses so far.
#[derive(Debug, Default)]
pub(crate) struct Measurer {
    /// Number of the first collapse.
    first_op: u32,
    /// Whether vertices that stay may move.
    moves: bool,
    error: ErrorRule,
    pub(crate) collapses: Vec<Collapse>,
    pub(crate) carried: Vec<Carried>,
    pub(crate) quadrics: Vec<Quadric>,
    pub(crate) samples: Samples,
    /// Sum over all collapses of the valence of `s` afterwards.
    pub(crate) valence_sum: u64,
    /// Exact bounds of the collapse that was begun.
    region: Option<(Sphere, Normals)>,
    star: Star,
    ring: Vec<DVec3>,
    normals: Vec<DVec3>,
    /// Edges at a vertex beside the one just kept, as half-edges, and their other ends.
    edges: Vec<(u32, u32)>,
    /// Faces that the collapse changed.
    changed: Vec<u32>,
}

/// A collapse and the mesh after it.
pub(super) struct Done<'a> {
    pub(super) surface: &'a Surface,
    pub(super) points: &'a [Point],
    pub(super) site: Site,
    /// What [`Surface::collapse`] returned.
    pub(super) outer: [u32; 4],
    /// The vertices `[s, t]` before.
    pub(super) before: [Point; 2],
    pub(super) has_moved: bool,
    /// Edges at `s`, as half-edges, and their other ends.
    pub(super) around: &'a [(u32, u32)],
}

impl Measurer {
    /// `carried` and `quadrics` have an entry for each vertex.
    pub(super) fn new(
        carried: Vec<Carried>,
        quadrics: Vec<Quadric>,
        samples: Samples,
        method: Method,
        first_op: u32,
    ) -> Self {
        let collapses = Vec::with_capacity(carried.len());
        let (moves, error) = (method.mover.is_some(), method.error);
        Self { first_op, moves, error, collapses, carried, quadrics, samples, ..Self::default() }
    }

    /// Looks at a legal site, which `examined` describes, before it is collapsed. `moved` is `s` afterwards, if it moves.
    pub(super) fn begin(
        &mut self,
        surface: &Surface,
        points: &[Point],
        site: Site,
        moved: Option<Point>,
        examined: &Examined,
    ) {
        let Site { s, t, left, right } = site;
        let Self { ring, normals, carried, .. } = self;
        ring.clear();
        ring.extend(examined.around.iter().map(|&v| points[v as usize].at()));
        ring.extend(moved.map(|point| point.at()));
        normals.clear();
        for &(before, after) in &examined.normals {
            normals.push(before);
            normals.push(after);
        }
        for h in [left, right].into_iter().flatten() {
            normals.push(surface.face_normal(points, h / 3));
        }
        self.region = Some(bounds::merge(&carried[s as usize], &carried[t as usize], ring, normals));
    }

    /// Records the collapse that was begun, now that it is done. `examined` is used up.
    pub(super) fn finish(&mut self, done: Done<'_>, examined: &mut Examined) {
        let Done { surface, points, site, outer, before, has_moved, around } = done;
        let Site { s, t, left, right } = site;
        let op = self.first_op + self.collapses.len() as u32;
        let ps = points[s as usize];
        let gone = self.quadrics[t as usize];
        let quadric = &mut self.quadrics[s as usize];
        quadric.absorb(&gone, before[0].at() - before[1].at());
        if has_moved {
            quadric.carry(ps.at() - before[0].at());
        }
        let rms = RMS_FACTOR * quadric.rms();
        self.star.reset(points, s, around.iter().copied());
        let inherited = self.carried[s as usize].error().max(self.carried[t as usize].error());
        let enough = inherited.max(rms) / SAMPLED_FACTOR;
        let deviation = self.samples.merge([s, t], before, self.moves, &self.star, enough);
        let beside = self.measure_around(&done, examined, enough.max(deviation.distance));
        let own = match self.error {
            ErrorRule::Deviation => {
                rms.max(SAMPLED_FACTOR * deviation.distance.max(beside)).max(COLOR_FACTOR * deviation.color)
            }
            ErrorRule::Edge => before[1].at().distance(ps.at()),
        };
        let own = if own < SMALLEST_ERROR { 0.0 } else { own };
        let (sphere, normals) = self.region.take().expect("a collapse is begun before it is done");
        let children = [s, t].map(|v| self.carried[v as usize].child());
        let stored = bounds::store(sphere, normals, own, &children);
        let [next_of_s, first_of_t] = [s, t].map(|v| self.carried[v as usize].last);
        self.carried[s as usize] = Carried { sphere, normals, last: op, stored };
        self.valence_sum += u64::from(surface.valence(s));
        let id = |h: Option<u32>| h.unwrap_or(NONE);
        self.collapses.push(Collapse {
            s,
            t,
            left: id(left),
            right: id(right),
            outer,
            next_of_s,
            first_of_t,
            s_move: std::array::from_fn(|k| before[0].position[k] - ps.position[k]),
            s_color_move: std::array::from_fn(|k| before[0].color[k].wrapping_sub(ps.color[k])),
            bounds: stored,
        });
    }

    /// Largest distance over `enough` of the samples beside a collapse that has just been done, or 0.
    fn measure_around(&mut self, done: &Done<'_>, examined: &mut Examined, enough: f64) -> f64 {
        let &Done { surface, points, site, has_moved, around, .. } = done;
        let Self { samples, changed, edges, star, .. } = self;
        let vertices = &mut examined.around;
        changed.clear();
        changed.extend(site.left.into_iter().chain(site.right).map(|h| h / 3));
        if has_moved {
            // All faces of `s` did, old and new.
            changed.extend(surface.spokes(site.s).map(|h| h / 3));
            vertices.clear();
            vertices.extend(around.iter().map(|&(_, v)| v));
        } else {
            changed.extend(examined.arc.iter().map(|h| h / 3));
            vertices.retain(|&v| v != site.s);
        }
        let surroundings = Surroundings { around: vertices, changed };
        samples.measure_around(points, surroundings, star, enough, |star, v| {
            edges.clear();
            surface.for_each_edge(v, |h, w| edges.push((h, w)));
            star.reset(points, v, edges.iter().copied());
        })
    }
}

/// A collapse that was chosen, to be done again on a copy of the mesh.
#[derive(Clone, Copy, Debug)]
pub(super) struct Chosen {
    site: Site,
    /// `s` afterwards, if it moves.
    moved: Option<Point>,
}

impl Chosen {
    pub(super) fn new(site: Site, moved: Option<Point>) -> Self {
        Self { site, moved }
    }
}

/// Hands collapses to a thread that measures them.
pub(super) struct Behind {
    chosen: Vec<Chosen>,
    sender: SyncSender<Vec<Chosen>>,
}

impl Behind {
    /// Starts the thread on a copy of the mesh as it is. It ends with what it has measured when this is dropped.
    pub(super) fn start<'scope>(
        scope: &'scope Scope<'scope, '_>,
        surface: Surface,
        points: Vec<Point>,
        measurer: Measurer,
    ) -> (Self, ScopedJoinHandle<'scope, Measurer>) {
        let (sender, receiver) = sync_channel::<Vec<Chosen>>(WAITING);
        let examined = Examined::new(points.len());
        let mut twin = Twin { surface, points, measurer, examined, around: Vec::new() };
        let thread = scope.spawn(move || {
            receiver.iter().flatten().for_each(|chosen| twin.collapse(chosen));
            twin.measurer
        });
        (Self { chosen: Vec::with_capacity(BATCH), sender }, thread)
    }

    pub(super) fn push(&mut self, chosen: Chosen) {
        self.chosen.push(chosen);
        if self.chosen.len() == BATCH {
            self.flush();
        }
    }

    fn flush(&mut self) {
        let chosen = std::mem::replace(&mut self.chosen, Vec::with_capacity(BATCH));
        // Without a receiver the thread has panicked, which whoever joins it hears.
        let _ = self.sender.send(chosen);
    }
}

impl Drop for Behind {
    fn drop(&mut self) {
        self.flush();
    }
}

/// The mesh of the thread that measures.
struct Twin {
    surface: Surface,
    points: Vec<Point>,
    measurer: Measurer,
    examined: Examined,
    around: Vec<(u32, u32)>,
}

impl Twin {
    fn collapse(&mut self, Chosen { site, moved }: Chosen) {
        let Self { surface, points, measurer, examined, around } = self;
        let Site { s, t, .. } = site;
        let before = [s, t].map(|v| points[v as usize]);
        examined.describe(surface, points, site, moved.map(|point| point.at()));
        measurer.begin(surface, points, site, moved, examined);
        let outer = surface.collapse(site, &examined.arc);
        if let Some(moved) = moved {
            points[s as usize] = moved;
        }
        around.clear();
        surface.for_each_edge(s, |h, v| around.push((h, v)));
        let has_moved = moved.is_some();
        measurer.finish(Done { surface, points, site, outer, before, has_moved, around }, examined);
    }
}
