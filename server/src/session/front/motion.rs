//! How far the camera has moved, as what lies in each part of the model sees it.
//!
//! What a test finds holds until something that it rests on has changed by its slack: the depth of the sphere has fallen (a small op
//! may become large) or grown, a plane of the frustum has passed the sphere, the eye has gone so far that the cone may face another way
//! (ALGORITHMS 3.2, which takes the way of the eye plus the angle times the distance for all of these). Each of these is bounded by itself:
//! - Depths and distances to planes are linear in the place, so over a box their change from one view to the next has exact bounds. The
//!   model's box is divided into cells, for each of which these bounds are summed up, plane by plane.
//! - All that a sphere of radius r at c shows faces away from the eye e as long as (c - e) . n > r for each normal n of its cone. That is linear
//!   in the eye, so when the eye moves by d, it changes by no more than the largest d . n over the cone. Directions are divided into
//!   bins, each at the middle of caps of several widths, for each of which these bounds are summed up.
//!
//! A test is due when its sum has grown by its slack. An orbit then tests what comes nearer or turns, rather than all that the eye goes by, and a
//! camera that looks around what a border of the picture passes.
//!
//! A step costs some ten dot products a cell and one a bin, about 10 us; the sums take some 18 KB.

use std::sync::LazyLock;

use glam::DVec3;
use lodestream_protocol::view::Plane;

use super::super::score::Scorer;
use super::{down, up};
use crate::pack::record::WideCone;

/// Cells at most: their numbers are bytes. The first is the whole box.
const CELLS: usize = 256;
/// Half a cell as it counts, over half a cell of the grid: an op's children lie beside it.
const OVERLAP: f64 = 1.5;
/// Updates after which sums begin at zero again, so that what is compared with them, in two bytes, stays sharp.
const UPDATES_PER_EPOCH: u32 = 64;

/// Bins along an edge of the cube on which directions are divided.
const BIN_EDGE: usize = 6;
const BINS: usize = 6 * BIN_EDGE * BIN_EDGE;
/// Cosines and sines of the caps around the middle of each bin. The first holds the bin.
const CAPS: [(f64, f64); 4] = [(0.970, 0.243_105), (0.92, 0.391_919), (0.8, 0.6), (0.5, 0.866_026)];

/// Sums in what is the same for all cells: of ways along the directions of caps, and of all directions...
const ALONG_ANY: u16 = (BINS * CAPS.len()) as u16;
/// ... then of ways against those of bins.
const AGAINST: u16 = ALONG_ANY + 1;
const SHARED: usize = AGAINST as usize + BINS;

/// Sums of a cell: how much a depth may have fallen,
const NEARER: usize = 0;
/// and grown;
const FARTHER: usize = 1;
/// how far a plane, whichever, may have come,
const INWARD: usize = 2;
/// and gone;
const OUTWARD: usize = 3;
/// and the larger of the first of these and of the eye's way.
const EITHER: usize = 4;
/// The same for each plane: how far it may have come, then how far it may have gone.
const BY_PLANE: usize = 5;

/// What the change from a view depends on.
#[derive(Clone, Debug)]
struct Camera {
    eye: DVec3,
    forward: DVec3,
    planes: Vec<Plane>,
}

/// The model's box in equal parts.
#[derive(Debug)]
struct Grid {
    low: DVec3,
    high: DVec3,
    /// Edges of a part, and how many there are along each axis.
    edges: DVec3,
    counts: [usize; 3],
}

/// See the module.
#[derive(Debug, Default)]
pub(super) struct Motion {
    last: Option<Camera>,
    grid: Option<Grid>,
    sums: Sums,
    updates: u32,
}

/// What has been summed up, each addition rounded up: what all cells share, then cell by cell.
#[derive(Clone, Debug, Default)]
pub(super) struct Sums {
    all: Vec<f32>,
    planes: usize,
}

/// Where a sum is: among the [`SHARED`] ones, or so far from the first of a cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct SumAt(u16);

impl Sums {
    #[inline]
    fn stride(&self) -> usize {
        BY_PLANE + 2 * self.planes
    }

    #[inline]
    fn of(&self, cell: u8, which: usize) -> f32 {
        self.all[SHARED + usize::from(cell) * self.stride() + which]
    }

    #[inline]
    pub(super) fn nearer(&self, cell: u8) -> f32 {
        self.of(cell, NEARER)
    }

    #[inline]
    pub(super) fn farther(&self, cell: u8) -> f32 {
        self.of(cell, FARTHER)
    }

    /// How far out a plane may have moved.
    #[inline]
    pub(super) fn outward(&self, cell: u8, plane: u8) -> f32 {
        self.of(cell, BY_PLANE + self.planes + usize::from(plane))
    }

    /// The same of any plane.
    #[inline]
    pub(super) fn any_outward(&self, cell: u8) -> f32 {
        self.of(cell, OUTWARD)
    }

    /// How far the eye may have gone against a direction of a bin.
    #[inline]
    pub(super) fn against(&self, bin: u8) -> f32 {
        self.all[usize::from(AGAINST) + usize::from(bin)]
    }

    #[inline]
    pub(super) fn at(&self, cell: u8, at: SumAt) -> f32 {
        let at = usize::from(at.0);
        let of_cell = usize::from(cell) * self.stride();
        self.all[if at < SHARED { at } else { of_cell + at }]
    }
}

impl Grid {
    fn new([low, high]: [DVec3; 2]) -> Self {
        let extent = (high - low).max(DVec3::splat(f64::MIN_POSITIVE));
        // The finest that fits, by steps of a tenth.
        let mut edge = extent.max_element();
        let counts = |edge: f64| extent.to_array().map(|e| (e / edge).ceil().max(1.0) as usize);
        while counts(edge / 1.1).iter().product::<usize>() < CELLS {
            edge /= 1.1;
        }
        let counts = counts(edge);
        Self { low, high, edges: extent / DVec3::from_array(counts.map(|n| n as f64)), counts }
    }

    /// Centre and half the edges of a cell.
    fn cell(&self, cell: usize) -> (DVec3, DVec3) {
        let Some(part) = cell.checked_sub(1) else {
            return ((self.low + self.high) / 2.0, (self.high - self.low) / 2.0);
        };
        let [x, y, _] = self.counts;
        let corner = [part % x, part / x % y, part / (x * y)].map(|i| i as f64 + 0.5);
        (self.low + DVec3::from_array(corner) * self.edges, self.edges * (OVERLAP / 2.0))
    }

    fn len(&self) -> usize {
        1 + self.counts.iter().product::<usize>()
    }

    /// The smallest cell that holds this box, if any does.
    #[inline]
    fn find(&self, low: DVec3, high: DVec3) -> Option<u8> {
        if !(low.cmpge(self.low).all() && high.cmple(self.high).all()) {
            return None;
        }
        let at = ((low + high) / 2.0 - self.low) / self.edges;
        let [x, y, z] = self.counts;
        let (i, j, k) = ((at.x as usize).min(x - 1), (at.y as usize).min(y - 1), (at.z as usize).min(z - 1));
        let cell = 1 + i + x * (j + y * k);
        let (center, half) = self.cell(cell);
        let is_in = low.cmpge(center - half).all() && high.cmple(center + half).all();
        Some(if is_in { cell as u8 } else { 0 })
    }
}

impl Motion {
    /// The camera is now there. Returns the sums from which all that is due has to be reduced, when an epoch ends.
    pub(super) fn go_on(&mut self, scorer: &Scorer) -> Option<Sums> {
        let grid = self.grid.get_or_insert_with(|| Grid::new(scorer.tested_box()));
        let planes = scorer.planes().len();
        if self.sums.planes != planes || self.sums.all.is_empty() {
            // A view of another kind: all that was tested is due anyway.
            self.sums.planes = planes;
            self.sums.all = vec![0.0; SHARED + grid.len() * self.sums.stride()];
            (self.last, self.updates) = (None, 0);
        }
        let ended = (self.updates >= UPDATES_PER_EPOCH).then(|| self.sums.clone());
        if ended.is_some() {
            self.sums.all.fill(0.0);
            self.updates = 0;
        }
        self.updates += 1;
        let now = Camera { eye: scorer.eye(), forward: scorer.forward(), planes: scorer.planes().to_vec() };
        if let Some(before) = &self.last {
            let step = Step::new(before, &now, scorer);
            let stride = self.sums.stride();
            let (shared, cells) = self.sums.all.split_at_mut(SHARED);
            step.turn(shared);
            for (cell, sums) in cells.chunks_exact_mut(stride).enumerate() {
                let (center, half) = grid.cell(cell);
                step.over(center, half, sums);
            }
        }
        self.last = Some(now);
        ended
    }

    /// The cell for tests of spheres whose centres lie in this box.
    #[inline]
    pub(super) fn cell(&self, low: DVec3, high: DVec3) -> Option<u8> {
        self.grid.as_ref()?.find(low, high)
    }

    /// A number less the sum [`nearer`](Sums::nearer) of a cell, now and whenever that has grown, is not more than `depth` is then.
    #[inline]
    pub(super) fn least(&self, cell: u8, depth: f64) -> f32 {
        down(f64::from(self.sums.nearer(cell)) + depth)
    }

    /// A number that, with the sum [`farther`](Sums::farther) of a cell, is never less than `depth`.
    #[inline]
    pub(super) fn most(&self, cell: u8, depth: f64) -> f32 {
        up(depth - f64::from(self.sums.farther(cell)))
    }

    pub(super) fn heap_bytes(&self) -> usize {
        self.sums.all.capacity() * size_of::<f32>()
    }

    #[inline]
    pub(super) fn sums(&self) -> &Sums {
        &self.sums
    }
}

impl SumAt {
    /// That of the eye's way and of all planes.
    pub(super) const EITHER: Self = Self((SHARED + EITHER) as u16);
    /// How far in any plane may have come.
    pub(super) const ANY_INWARD: Self = Self((SHARED + INWARD) as u16);

    /// A sum that is not less than either.
    #[inline]
    pub(super) fn or(self, other: Self) -> Self {
        let is_turn = |at: Self| usize::from(at.0) < SHARED;
        match (is_turn(self), is_turn(other)) {
            _ if self == other => self,
            (true, true) => Self(ALONG_ANY),
            (false, false) if self != Self::EITHER && other != Self::EITHER => Self::ANY_INWARD,
            _ => Self::EITHER,
        }
    }

    /// How far in a plane may have come.
    #[inline]
    pub(super) fn inward(plane: u8) -> Self {
        Self((SHARED + BY_PLANE) as u16 + u16::from(plane))
    }

    /// How far the eye may have gone along a direction of a cone, by the narrowest cap that holds it.
    #[inline]
    pub(super) fn along(cone: &WideCone) -> Self {
        let bin = bin_of(cone.axis);
        // From the middle of the bin to the far side of the cone.
        let middle = MIDDLES[usize::from(bin)];
        let (cos, sin) = (middle.dot(cone.axis), middle.cross(cone.axis).length());
        let (far_cos, far_sin) = (cos * cone.cos - sin * cone.sin, sin * cone.cos + cos * cone.sin);
        let holds = |&(cap, _): &(f64, f64)| far_sin >= 0.0 && far_cos >= cap + 1e-9;
        match CAPS.iter().position(holds) {
            Some(cap) => Self(u16::from(bin) * CAPS.len() as u16 + cap as u16),
            None => Self(ALONG_ANY),
        }
    }
}

/// The bin of a direction of any length.
#[inline]
pub(super) fn bin_of(direction: DVec3) -> u8 {
    let size = direction.abs();
    let (axis, [x, y]) = if size.x >= size.y && size.x >= size.z {
        (0, [direction.y, direction.z])
    } else if size.y >= size.z {
        (1, [direction.z, direction.x])
    } else {
        (2, [direction.x, direction.y])
    };
    let most = size[axis].max(f64::MIN_POSITIVE);
    let along = |x: f64| (((x / most + 1.0) * (BIN_EDGE as f64 / 2.0)) as usize).min(BIN_EDGE - 1);
    let side = 2 * axis + usize::from(direction[axis] < 0.0);
    (side * BIN_EDGE * BIN_EDGE + along(x) * BIN_EDGE + along(y)) as u8
}

/// The middles of all bins, the same for all sessions.
static MIDDLES: LazyLock<[DVec3; BINS]> = LazyLock::new(|| std::array::from_fn(middle_of_bin));

fn middle_of_bin(bin: usize) -> DVec3 {
    let (side, part) = (bin / (BIN_EDGE * BIN_EDGE), bin % (BIN_EDGE * BIN_EDGE));
    let along = |i: usize| (2.0 * i as f64 + 1.0) / BIN_EDGE as f64 - 1.0;
    let (x, y) = (along(part / BIN_EDGE), along(part % BIN_EDGE));
    let out = if side.is_multiple_of(2) { 1.0 } else { -1.0 };
    match side / 2 {
        0 => DVec3::new(out, x, y),
        1 => DVec3::new(y, out, x),
        _ => DVec3::new(x, y, out),
    }
    .normalize()
}

/// Adds a change that is not negative, rounded up.
#[inline]
fn add(sum: &mut f32, change: f64) {
    let total = f64::from(*sum) + change * (1.0 + 1e-9);
    // Eyes may be anywhere a number can be.
    *sum = if total.is_nan() { f32::INFINITY } else { up(total) };
}

/// From one view to the next.
struct Step {
    /// How much the depth of a place grows: linear in the place.
    depth: (DVec3, f64),
    /// How much farther inside each plane it is then.
    planes: Vec<(DVec3, f64)>,
    eye: DVec3,
    way: DVec3,
    /// What turns cones: the eye's way, or of parallel rays how far their direction goes, times the length of the model.
    turn: DVec3,
    is_parallel: bool,
    corner_cosine: f64,
}

impl Step {
    fn new(before: &Camera, now: &Camera, scorer: &Scorer) -> Self {
        let depth_at = |camera: &Camera| camera.forward.dot(camera.eye);
        let way = now.eye - before.eye;
        let turn = match scorer.is_parallel() {
            true => (before.forward - now.forward) * scorer.parallel_length(),
            false => way,
        };
        Self {
            depth: (now.forward - before.forward, depth_at(before) - depth_at(now)),
            // Views of other kinds have other planes; nothing that was tested for one is kept for the other.
            planes: before
                .planes
                .iter()
                .zip(&now.planes)
                .map(|(a, b)| (b.normal - a.normal, b.offset - a.offset))
                .collect(),
            eye: before.eye,
            way,
            turn,
            is_parallel: scorer.is_parallel(),
            corner_cosine: scorer.corner_cosine(),
        }
    }

    /// Adds how far the eye goes along and against the directions of the bins.
    fn turn(&self, sums: &mut [f32]) {
        let length = self.turn.length();
        if length == 0.0 {
            return;
        }
        // The most that a way of this length goes along a direction of the cap, from its cosine and sine with the middle.
        let most = |cos: f64, sin: f64, (cap_cos, cap_sin): (f64, f64)| {
            length * if cos >= cap_cos { 1.0 } else { (cos * cap_cos + sin * cap_sin).max(0.0) }
        };
        let (along, against) = sums.split_at_mut(usize::from(AGAINST));
        for ((middle, along), against) in MIDDLES.iter().zip(along.chunks_exact_mut(CAPS.len())).zip(against) {
            let cos = larger(-1.0, middle.dot(self.turn) / length).min(1.0);
            let sin = (1.0 - cos * cos).sqrt() + 1e-9;
            along.iter_mut().zip(CAPS).for_each(|(sum, cap)| add(sum, most(cos, sin, cap)));
            add(against, most(-cos, sin, CAPS[0]));
        }
        add(&mut along[usize::from(ALONG_ANY)], length);
    }

    /// Adds bounds of the change anywhere in a box.
    fn over(&self, center: DVec3, half: DVec3, sums: &mut [f32]) {
        let range = |&(gradient, offset): &(DVec3, f64)| {
            let (middle, reach) = (gradient.dot(center) + offset, gradient.abs().dot(half));
            [middle - reach, middle + reach]
        };
        let (mut inward, mut outward) = (0f64, 0f64);
        let (shared, by_plane) = sums.split_at_mut(BY_PLANE);
        let (inwards, outwards) = by_plane.split_at_mut(self.planes.len());
        for ((plane, sum_in), sum_out) in self.planes.iter().zip(inwards).zip(outwards) {
            let [least, most] = range(plane);
            let (plane_in, plane_out) = (larger(0.0, most), larger(0.0, -least));
            add(sum_in, plane_in);
            add(sum_out, plane_out);
            (inward, outward) = (larger(inward, plane_in), larger(outward, plane_out));
        }
        if !self.is_parallel {
            // Sizes go by depth.
            let [least, most] = range(&self.depth);
            let [low, high] = self.distances(center, half.length(), self.way.length());
            add(&mut shared[NEARER], larger(larger(0.0, -least), -low * self.corner_cosine));
            add(&mut shared[FARTHER], larger(larger(0.0, most), high * self.corner_cosine));
        }
        add(&mut shared[INWARD], inward);
        add(&mut shared[OUTWARD], outward);
        add(&mut shared[EITHER], larger(inward, self.turn.length()));
    }

    /// By how much distances from the eye grow, at least and at most, anywhere in a ball.
    fn distances(&self, center: DVec3, radius: f64, way: f64) -> [f64; 2] {
        if way == 0.0 {
            return [0.0, 0.0];
        }
        let to_center = center - self.eye;
        let distance = to_center.length();
        // Directions from the eye, wherever on its way, to the ball are within this angle of that to its centre.
        let sine = (radius + way) / distance;
        if sine.is_nan() || sine >= 1.0 {
            return [-way, way];
        }
        let cosine = (1.0 - sine * sine).sqrt();
        let along = (self.way.dot(to_center) / (way * distance)).clamp(-1.0, 1.0);
        let across = (1.0 - along * along).sqrt();
        let toward = if along >= cosine { 1.0 } else { along * cosine + across * sine };
        let away = if -along >= cosine { 1.0 } else { -along * cosine + across * sine };
        [-way * toward, way * away]
    }
}

/// The larger of two numbers, and not a number if either is not.
fn larger(a: f64, b: f64) -> f64 {
    if a >= b || a.is_nan() { a } else { b }
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use lodestream_protocol::view::{Projection, View};

    use super::*;
    use crate::pack::testing::{DagOptions, random_dag};
    use crate::pack::{Metadata, PackedModel, write_to_vec};

    fn model() -> PackedModel {
        let (dag, complete) = random_dag(&DagOptions { splits: 300, ..DagOptions::default() });
        PackedModel::from_vec(write_to_vec(&dag, &complete, &Metadata::default()).unwrap()).unwrap()
    }

    #[test]
    fn cells_hold_what_they_are_found_for() {
        let mut rng = fastrand::Rng::with_seed(2);
        let mut random = |scale: DVec3| DVec3::from_array(std::array::from_fn(|_| rng.f64() - 0.5)) * scale;
        for sides in [DVec3::splat(100.0), DVec3::new(1000.0, 4.0, 5.0), DVec3::new(1.0, 7e5, 2e6)] {
            let grid = Grid::new([-sides, sides]);
            assert!((128..=CELLS).contains(&grid.len()), "{} cells", grid.len());
            let mut wide = 0;
            for _ in 0..2000 {
                let (a, b) = (random(2.0 * sides), random(0.6 * sides));
                let (low, high) = (a.min(a + b), a.max(a + b));
                let Some(cell) = grid.find(low, high) else {
                    assert!(low.cmplt(-sides).any() || high.cmpgt(sides).any());
                    continue;
                };
                let (center, half) = grid.cell(usize::from(cell));
                assert!(low.cmpge(center - half).all() && high.cmple(center + half).all());
                wide += u32::from(cell == 0);
            }
            assert!((1..1950).contains(&wide), "{wide} of 2000 boxes are in no cell but the first");
        }
    }

    #[test]
    fn caps_hold_what_they_are_found_for() {
        let mut rng = fastrand::Rng::with_seed(6);
        let mut found = [0; CAPS.len() + 1];
        for _ in 0..20_000 {
            let mut random = || DVec3::from_array(std::array::from_fn(|_| rng.f64() - 0.5)).normalize();
            let (axis, side) = (random(), random());
            let bin = bin_of(axis * 17.0);
            assert!(usize::from(bin) < BINS);
            let middle = middle_of_bin(bin.into());
            assert!(middle.dot(axis) >= CAPS[0].0, "a bin is wider than its cap");
            let angle = 1.2 * rng.f64() * rng.f64();
            let at = usize::from(SumAt::along(&WideCone { axis, sin: angle.sin(), cos: angle.cos() }).0);
            let cap = if at == usize::from(ALONG_ANY) { CAPS.len() } else { at % CAPS.len() };
            found[cap] += 1;
            if cap < CAPS.len() {
                assert_eq!(at / CAPS.len(), usize::from(bin));
                // A normal on the cone's rim.
                let across = (side - side.dot(axis) * axis).normalize();
                let normal = axis * angle.cos() + across * angle.sin();
                assert!(middle.dot(normal) >= CAPS[cap].0, "{cap} {angle}");
            }
        }
        assert!(found.iter().all(|&n| n > 200), "{found:?}");
        for (cos, sin) in CAPS {
            assert!((1.0..1.0 + 1e-5).contains(&(cos * cos + sin * sin).sqrt()), "{cos} {sin}");
        }
    }

    #[test]
    fn nothing_changes_more_than_the_sums_say() {
        let model = model();
        let (mut rng, mut tight) = (fastrand::Rng::with_seed(1), [0; 8]);
        for run in 0..300 {
            let mut random = |scale: f64| DVec3::from_array(std::array::from_fn(|_| (rng.f64() - 0.5) * scale));
            let lattice = &model.info().lattice;
            let mut view = View::perspective(DVec3::ZERO, DVec3::X, 0.8);
            if run % 4 == 0 {
                view.projection = Projection::Orthographic { height: 300.0 * lattice.step };
            }
            let mut motion = Motion::default();
            let (mut place, mut rotation) = (random(8e3), DQuat::from_scaled_axis(random(3.0)));
            let [low, high] = Scorer::new(&view, model.info()).tested_box();
            let point = (low + high) / 2.0 + random(0.99) * (high - low);
            let normal = random(1.0).normalize();
            // A narrow cone around the normal.
            let cone = WideCone { axis: (normal + random(0.05)).normalize(), sin: 0.1, cos: 0.99f64.sqrt() };
            let (way, turn) = ([1.0, 30.0, 900.0][run % 3], [0.0, 0.01, 0.2][run / 3 % 3]);
            let plane = run % 4;
            let mut first = None;
            for _ in 0..20 {
                place += random(way);
                rotation = DQuat::from_scaled_axis(random(turn)) * rotation;
                view.eye = (DVec3::from_array(lattice.origin) + place * lattice.step).to_array();
                view.orientation = rotation.as_quat().to_array();
                let scorer = Scorer::new(&view, model.info());
                motion.go_on(&scorer);
                let border = scorer.planes()[plane];
                let inside = border.normal.dot(point) + border.offset;
                let to_point = point - scorer.eye();
                let depth = match scorer.is_parallel() {
                    true => 1.0,
                    false => to_point.dot(scorer.forward()).max(to_point.length() * scorer.corner_cosine()),
                };
                let along = match scorer.is_parallel() {
                    true => scorer.forward().dot(normal) * scorer.parallel_length(),
                    false => to_point.dot(normal),
                };
                let (inside_then, depth_then, along_then) = *first.get_or_insert((inside, depth, along));
                let cell = motion.cell(point, point).expect("the point is in the box");
                let (sums, number) = (motion.sums(), plane as u8);
                let at = |at: SumAt| sums.at(cell, at);
                let (inward, along_cone) = (SumAt::inward(number), SumAt::along(&cone));
                let rounding = 1e-6 * (to_point.length() + place.length());
                let bounds = [
                    (depth_then - depth, sums.nearer(cell)),
                    (depth - depth_then, sums.farther(cell)),
                    (inside - inside_then, at(inward).min(at(SumAt::ANY_INWARD)).min(at(inward.or(along_cone)))),
                    (inside_then - inside, sums.outward(cell, number).min(sums.any_outward(cell))),
                    (along_then - along, at(along_cone).min(at(SumAt(ALONG_ANY)))),
                    (along_then - along, at(inward.or(along_cone)).min(at(along_cone.or(SumAt(0))))),
                    (along - along_then, sums.against(bin_of(normal))),
                ];
                for (which, (change, bound)) in bounds.into_iter().enumerate() {
                    let bound = f64::from(bound);
                    assert!(change <= bound + rounding, "run {run}, bound {which}: {change} over {bound}");
                    tight[which] += u32::from(change > 0.5 * bound && change > 0.1);
                }
            }
        }
        assert!(tight[..7].iter().all(|&n| n > 100), "the bounds are far from what they bound: {tight:?}");
    }
}
