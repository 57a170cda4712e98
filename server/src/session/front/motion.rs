//! How far the camera has moved, as what lies in each part of the model sees it.
//!
//! What a test finds holds until something that it rests on has changed by its slack: the depth of the sphere has fallen (a small op
//! may become large) or grown, the sphere has come towards the frustum or towards its border, the eye has gone so far that a cone
//! may face another way (ALGORITHMS 3.2, which takes the way of the eye plus the angle times the distance for all of these). Depths and
//! distances to planes are linear in the place, so over a box their change from one view to the next has exact bounds. The model's box
//! is divided into cells, for each of which these bounds are summed up; a test is due when its cell's sum has grown by its slack. An orbit then
//! tests what comes nearer rather than all that the eye goes by, and a camera that looks around only what enters and leaves.
//!
//! A step costs some ten dot products a cell, about 10 us.

use glam::{DQuat, DVec3};
use lodestream_protocol::view::Plane;

use super::super::score::Scorer;
use super::{down, up};

/// Cells at most: their numbers are bytes. The first is the whole box.
const CELLS: usize = 256;
/// Half a cell as it counts, over half a cell of the grid: an op's children lie beside it.
const OVERLAP: f64 = 1.5;
/// Updates after which sums begin at zero again, so that their rounding, and that of what is compared with them, stays small.
const UPDATES_PER_EPOCH: u32 = 64;
/// What changes at unlike rates is summed up as the largest: a distance to the frustum counts so much,
pub(in super::super) const FRUSTUM_SHARE: f64 = 0.5;
/// and the eye's way so much, which turns cones. Slacks are scaled likewise, so these say only what is tested early.
pub(in super::super) const FACING_SHARE: f64 = 0.25;

/// What a test waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Wait {
    /// For a depth to fall.
    Nearer,
    /// For a depth to grow.
    Farther,
    /// For coming into sight.
    Appearing,
    /// For going out of sight.
    Vanishing,
}

const WAITS: usize = 4;
/// Sums of a cell, by [`Wait`].
pub(super) type Sums = [f32; WAITS];

/// What the change from a view depends on.
#[derive(Clone, Debug)]
struct Camera {
    eye: DVec3,
    rotation: DQuat,
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

#[derive(Debug, Default)]
pub(super) struct Motion {
    last: Option<Camera>,
    grid: Option<Grid>,
    exact: Vec<[f64; WAITS]>,
    sums: Vec<Sums>,
    updates: u32,
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
    pub(super) fn go_on(&mut self, scorer: &Scorer, rotation: DQuat) -> Option<Vec<Sums>> {
        let grid = self.grid.get_or_insert_with(|| Grid::new(scorer.tested_box()));
        if self.exact.is_empty() {
            (self.exact, self.sums) = (vec![[0.0; WAITS]; grid.len()], vec![[0.0; WAITS]; grid.len()]);
        }
        let ended = (self.updates >= UPDATES_PER_EPOCH).then(|| self.sums.clone());
        if ended.is_some() {
            self.exact.fill([0.0; WAITS]);
            self.updates = 0;
        }
        self.updates += 1;
        let now = Camera { eye: scorer.eye(), rotation, forward: scorer.forward(), planes: scorer.planes().to_vec() };
        if let Some(before) = &self.last {
            let step = Step::new(before, &now, scorer);
            for (cell, sums) in self.exact.iter_mut().enumerate() {
                let (center, half) = grid.cell(cell);
                for (sum, change) in sums.iter_mut().zip(step.over(center, half)) {
                    *sum += change * (1.0 + 1e-9);
                }
            }
        }
        self.last = Some(now);
        for (sums, exact) in self.sums.iter_mut().zip(&self.exact) {
            // Eyes may be anywhere a number can be.
            *sums = exact.map(|sum| if sum.is_nan() { f32::INFINITY } else { up(sum) });
        }
        ended
    }

    /// The cell for tests of spheres whose centres lie in this box.
    #[inline]
    pub(super) fn cell(&self, low: DVec3, high: DVec3) -> Option<u8> {
        self.grid.as_ref()?.find(low, high)
    }

    /// A number less `sum` of a cell, now and whenever the sum has grown, is not more than `depth` is then.
    #[inline]
    pub(super) fn least(&self, cell: u8, depth: f64) -> f32 {
        down(f64::from(self.sum(cell, Wait::Nearer)) + depth)
    }

    /// A number that, with the sum of a cell, is never less than `depth`.
    #[inline]
    pub(super) fn most(&self, cell: u8, depth: f64) -> f32 {
        up(depth - f64::from(self.sum(cell, Wait::Farther)))
    }

    /// When an answer is due that holds for a change of `slack`.
    #[inline]
    pub(super) fn due(&self, cell: u8, wait: Wait, slack: f64) -> f32 {
        match slack {
            f64::INFINITY => f32::INFINITY,
            _ if slack > 0.0 => down(f64::from(self.sum(cell, wait)) + slack),
            _ => f32::NEG_INFINITY,
        }
    }

    /// Sums are rounded up, so this may be what it is now.
    #[inline]
    fn sum(&self, cell: u8, wait: Wait) -> f32 {
        self.sums[usize::from(cell)][wait as usize].next_down().max(0.0)
    }

    #[inline]
    pub(super) fn sums(&self) -> &[Sums] {
        &self.sums
    }
}

/// From one view to the next.
struct Step {
    /// How much the depth of a place grows: linear in the place.
    depth: (DVec3, f64),
    /// How much farther inside each plane it is then.
    planes: Vec<(DVec3, f64)>,
    eye: DVec3,
    way: DVec3,
    angle: f64,
    is_parallel: bool,
    corner_cosine: f64,
}

impl Step {
    fn new(before: &Camera, now: &Camera, scorer: &Scorer) -> Self {
        let turn = before.rotation.inverse() * now.rotation;
        let depth_at = |camera: &Camera| camera.forward.dot(camera.eye);
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
            way: now.eye - before.eye,
            angle: 2.0 * DVec3::new(turn.x, turn.y, turn.z).length().atan2(turn.w.abs()),
            is_parallel: scorer.is_parallel(),
            corner_cosine: scorer.corner_cosine(),
        }
    }

    /// Bounds of the change anywhere in a box, by [`Wait`].
    fn over(&self, center: DVec3, half: DVec3) -> [f64; WAITS] {
        let range = |&(gradient, offset): &(DVec3, f64)| {
            let (middle, reach) = (gradient.dot(center) + offset, gradient.abs().dot(half));
            [middle - reach, middle + reach]
        };
        let (mut inward, mut outward) = (0f64, 0f64);
        for plane in &self.planes {
            let [least, most] = range(plane);
            (inward, outward) = (larger(inward, most), larger(outward, -least));
        }
        let (mut nearer, mut farther) = (0f64, 0f64);
        let mut way = self.way.length();
        if self.is_parallel {
            // Sizes are the same everywhere; all cones turn by the same angle, which counts by the distance.
            let distance = (center - self.eye).length() + half.length() + way;
            way += self.angle * distance;
        } else {
            let [least, most] = range(&self.depth);
            let [low, high] = self.distances(center, half.length(), way);
            nearer = larger(larger(nearer, -least), -low * self.corner_cosine);
            farther = larger(larger(farther, most), high * self.corner_cosine);
        }
        let turned = way * FACING_SHARE;
        [nearer, farther, larger(inward * FRUSTUM_SHARE, turned), larger(outward * FRUSTUM_SHARE, turned)]
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
    fn nothing_changes_more_than_the_sums_of_its_cell_say() {
        let model = model();
        let (mut rng, mut tight) = (fastrand::Rng::with_seed(1), 0);
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
            let (way, turn) = ([1.0, 30.0, 900.0][run % 3], [0.0, 0.01, 0.2][run / 3 % 3]);
            let mut first = None;
            let mut cell = None;
            for _ in 0..20 {
                place += random(way);
                rotation = DQuat::from_scaled_axis(random(turn)) * rotation;
                view.eye = (DVec3::from_array(lattice.origin) + place * lattice.step).to_array();
                view.orientation = rotation.as_quat().to_array();
                let scorer = Scorer::new(&view, model.info());
                motion.go_on(&scorer, view.rotation());
                let inside = scorer.planes().iter().map(|p| p.normal.dot(point) + p.offset).fold(f64::MAX, f64::min);
                let to_point = point - scorer.eye();
                let depth = match scorer.is_parallel() {
                    true => 1.0,
                    false => to_point.dot(scorer.forward()).max(to_point.length() * scorer.corner_cosine()),
                };
                let (eye, looks) = (scorer.eye(), scorer.forward());
                let (inside_then, depth_then, eye_then, looked) = *first.get_or_insert((inside, depth, eye, looks));
                let cell = *cell.get_or_insert_with(|| motion.cell(point, point).expect("the point is in the box"));
                let [nearer, farther, appearing, vanishing] = motion.sums()[usize::from(cell)].map(f64::from);
                let turned = match scorer.is_parallel() {
                    true => looked.angle_between(looks) * to_point.length(),
                    false => eye.distance(eye_then),
                } * FACING_SHARE;
                let rounding = 1e-6 * (to_point.length() + place.length());
                let bounds = [
                    (depth_then - depth, nearer),
                    ((inside - inside_then) * FRUSTUM_SHARE, appearing),
                    (turned, appearing),
                    (depth - depth_then, farther),
                    ((inside_then - inside) * FRUSTUM_SHARE, vanishing),
                    (turned, vanishing),
                ];
                for (which, (change, bound)) in bounds.into_iter().enumerate() {
                    assert!(change <= bound + rounding, "run {run}, bound {which}: {change} over {bound}");
                    tight += u32::from(change > 0.5 * bound && change > 0.1);
                }
            }
        }
        assert!(tight > 1000, "the bounds are far from what they bound: {tight}");
    }
}
