//! A page of ops judged at once: not what each matters to a view, but the most and the least that it may matter, in single precision and without
//! branches, so that several lanes work side by side. Of nearly all of a page it is then known whether it is wanted, and only the rest is judged one by one.

use glam::DVec3;

use super::score::{Camera, Scorer};
use crate::pack::record::{Bounds, Cone, Magnitude};
use crate::pack::{PAGE_OPS, TestPage};

const ROWS: usize = PAGE_OPS as usize;
type Lanes = [f32; ROWS];

/// Share of a length that its rounding may come to in single precision, generously.
const ROUNDING: f32 = 1e-5;
/// The same for what is left across an axis of what lies nearly along it: the root of a difference.
const ROUNDING_ACROSS: f32 = 1e-3;

/// Work space of sweeps, and what the last one found.
#[derive(Clone, Debug)]
pub struct Sweep {
    centers: [Vec<i32>; 3],
    /// From the eye to the centres.
    ways: [Box<Lanes>; 3],
    distances: Box<Lanes>,
    radii: Box<Lanes>,
    /// How far inside the frustum.
    inside: Box<Lanes>,
    most: Box<Lanes>,
    least: Box<Lanes>,
    /// Axes of the cones, cosines and sines of their angles, and infinity where a cone holds all directions.
    axes: [Box<Lanes>; 3],
    cosines: Box<Lanes>,
    sines: Box<Lanes>,
    never: Box<Lanes>,
    rows: usize,
}

impl Default for Sweep {
    fn default() -> Self {
        let lanes = || Box::new([0.0; ROWS]);
        Self {
            centers: Default::default(),
            ways: [lanes(), lanes(), lanes()],
            distances: lanes(),
            radii: lanes(),
            inside: lanes(),
            most: lanes(),
            least: lanes(),
            axes: [lanes(), lanes(), lanes()],
            cosines: lanes(),
            sines: lanes(),
            never: lanes(),
            rows: 0,
        }
    }
}

impl Sweep {
    /// Judges the ops of a page for a view with a camera: none has a larger [priority](Scorer::priority) than what is returned for its row. Mostly
    /// that is less than a thousandth more. Some nanoseconds a row.
    pub fn judge(&mut self, scorer: &Scorer, page: &TestPage<'_>) -> &[f32] {
        let rows = page.error.len().min(ROWS);
        self.rows = rows;
        for (column, centers) in page.center.iter().zip(&mut self.centers) {
            centers.clear();
            column.decode_into(centers);
        }
        if scorer.camera().is_none() {
            // Priorities by error alone are hardly work.
            for row in 0..rows {
                self.most[row] = scorer.priority(&self.bounds(page, row));
                self.least[row] = self.most[row];
            }
            return self.most();
        }
        self.locate(scorer, page);
        self.look(scorer, page);
        self.most()
    }

    /// What [`judge`](Self::judge) returned last.
    #[inline]
    pub fn most(&self) -> &[f32] {
        &self.most[..self.rows]
    }

    /// What none of the ops that were judged last has a smaller priority than, row by row. Zero for what may be out of sight; mostly little less than
    /// the priority, except for a silhouette's factor.
    #[inline]
    pub fn least(&self) -> &[f32] {
        &self.least[..self.rows]
    }

    /// The bounds of a row of the page that was judged last.
    #[inline]
    pub fn bounds(&self, page: &TestPage<'_>, row: usize) -> Bounds {
        let [x, y, z] = &self.centers;
        Bounds {
            center: [x[row], y[row], z[row]],
            radius: Magnitude(page.radius[row]),
            error: Magnitude(page.error[row]),
            cone: Cone { axis: page.axis.map(|axis| axis[row]), half_angle: page.half_angle[row] },
        }
    }

    /// Distances, and how far inside all planes the spheres reach.
    fn locate(&mut self, scorer: &Scorer, page: &TestPage<'_>) {
        let rows = self.rows;
        let eye = scorer.eye();
        for ((centers, ways), eye) in self.centers.iter().zip(&mut self.ways).zip(eye.to_array()) {
            // The difference is taken before it is rounded: far eyes lose nothing.
            let lanes = ways[..rows].iter_mut().zip(&centers[..rows]);
            lanes.for_each(|(way, &center)| *way = (f64::from(center) - eye) as f32);
        }
        let [x, y, z] = self.ways.each_ref().map(|lanes| &lanes[..rows]);
        for (((distance, &x), &y), &z) in self.distances[..rows].iter_mut().zip(x).zip(y).zip(z) {
            *distance = (x * x + y * y + z * z).sqrt();
        }
        for (lane, &radius) in self.radii[..rows].iter_mut().zip(&page.radius[..rows]) {
            *lane = Magnitude(radius).decode();
        }
        self.inside[..rows].fill(f32::INFINITY);
        for plane in scorer.planes() {
            let normal = plane.normal.as_vec3();
            // As seen from the eye, which many of them go through.
            let offset = (plane.offset + plane.normal.dot(eye)) as f32;
            let lanes = self.inside[..rows].iter_mut().zip(x).zip(y).zip(z);
            for (((inside, &x), &y), &z) in lanes {
                let here = normal.x * x + normal.y * y + normal.z * z + offset;
                *inside = if here < *inside { here } else { *inside };
            }
        }
    }

    /// Axes of the cones, and cosines and sines of their angles.
    fn unpack_cones(&mut self, page: &TestPage<'_>) {
        let rows = self.rows;
        let [x, y, z] = self.axes.each_mut().map(|lanes| &mut lanes[..rows]);
        let codes = page.axis[0][..rows].iter().zip(&page.axis[1][..rows]);
        for (((x, y), z), (&u, &v)) in x.iter_mut().zip(y).zip(z).zip(codes) {
            let (u, v) = (f32::from(u) * (1.0 / 127.0), f32::from(v) * (1.0 / 127.0));
            let w = 1.0 - u.abs() - v.abs();
            let folded = at_least(-w, 0.0);
            let (u, v) = (u - folded.copysign(u), v - folded.copysign(v));
            let scale = 1.0 / (u * u + v * v + w * w).sqrt();
            (*x, *y, *z) = (u * scale, v * scale, w * scale);
        }
        let (cosines, sines, never) = (&mut self.cosines[..rows], &mut self.sines[..rows], &mut self.never[..rows]);
        let lanes = cosines.iter_mut().zip(sines).zip(never).zip(&page.half_angle[..rows]);
        for (((cos, sin), never), &code) in lanes {
            let q = f32::from(code) * (1.0 / 254.0);
            let norm = 1.0 / (1.0 + q * q);
            (*cos, *sin) = ((1.0 - q * q) * norm, 2.0 * q * norm);
            *never = if code == 255 { f32::INFINITY } else { 0.0 };
        }
    }

    /// The most and the least that each may matter.
    fn look(&mut self, scorer: &Scorer, page: &TestPage<'_>) {
        let Some(camera) = scorer.camera() else { return };
        self.weigh(scorer, &camera, page);
        if camera.culls_facing_away {
            self.unpack_cones(page);
            match camera.parallel {
                None => self.face_away::<false>(DVec3::ZERO),
                Some(direction) => self.face_away::<true>(direction),
            }
        }
    }

    /// Sizes of those that are not outside.
    fn weigh(&mut self, scorer: &Scorer, camera: &Camera, page: &TestPage<'_>) {
        let rows = self.rows;
        let forward = camera.forward.as_vec3();
        let corner_cosine = camera.corner_cosine as f32;
        let scale = (camera.pixel_scale * scorer.silhouette_factor()) as f32 * (1.0 + ROUNDING);
        let least_scale = (camera.pixel_scale * scorer.silhouette_factor().min(1.0)) as f32 * (1.0 - ROUNDING);
        // Planes may lie far from the eye.
        let reach = scorer.planes().iter().map(|plane| (plane.offset + plane.normal.dot(camera.eye)).abs());
        let slack = ROUNDING * reach.fold(0.0, f64::max) as f32;
        // The depth counts no less and no more than that.
        let (near, far) = if camera.parallel.is_some() { (1.0, 1.0) } else { (camera.near as f32, f32::INFINITY) };
        let [x, y, z] = self.ways.each_ref().map(|lanes| &lanes[..rows]);
        let ways = x.iter().zip(y).zip(z);
        let found = self.distances[..rows].iter().zip(&self.radii[..rows]).zip(&self.inside[..rows]);
        let bounds = self.most[..rows].iter_mut().zip(&mut self.least[..rows]);
        let lanes = bounds.zip(&page.error[..rows]).zip(ways).zip(found);
        for ((((most, least), &error), ((&x, &y), &z)), ((&distance, &radius), &inside)) in lanes {
            let rounding = ROUNDING * (distance + radius) + slack;
            let along_view = x * forward.x + y * forward.y + z * forward.z;
            let depth = at_least(along_view - radius, (distance - radius) * corner_cosine);
            let within = |depth: f32| {
                let depth = at_least(depth, near);
                if depth > far { far } else { depth }
            };
            let error = Magnitude(error).decode();
            let pixels = error * scale / within(depth - rounding);
            let fewest = error * least_scale / within(depth + rounding);
            // What is not a number may matter any amount, and what is too large for one is not known to.
            let pixels = if pixels.is_nan() { f32::INFINITY } else { pixels };
            let fewest = if fewest < f32::MAX { fewest } else { 0.0 };
            let reaches = inside + radius;
            *most = if reaches < -rounding { 0.0 } else { pixels };
            *least = if reaches > rounding { fewest } else { 0.0 };
        }
    }

    /// What surely faces away matters nothing, and what may face away perhaps: the least of `ray . n` over the cone says so, see `Probe::away`.
    fn face_away<const IS_PARALLEL: bool>(&mut self, direction: DVec3) {
        let rows = self.rows;
        let direction = direction.as_vec3();
        let [x, y, z] = self.ways.each_ref().map(|lanes| &lanes[..rows]);
        let [u, v, w] = self.axes.each_ref().map(|lanes| &lanes[..rows]);
        let ways = x.iter().zip(y).zip(z).zip(self.distances[..rows].iter().zip(&self.radii[..rows]));
        let axes = u.iter().zip(v).zip(w);
        let angles = self.cosines[..rows].iter().zip(&self.sines[..rows]).zip(&self.never[..rows]);
        let bounds = self.most[..rows].iter_mut().zip(&mut self.least[..rows]);
        let lanes = bounds.zip(ways).zip(axes).zip(angles);
        for ((((most, least), (((&x, &y), &z), (&distance, &radius))), ((&u, &v), &w)), ((&cos, &sin), &never)) in lanes
        {
            let (x, y, z, ray, reach) = match IS_PARALLEL {
                false => (x, y, z, distance, radius),
                true => (direction.x, direction.y, direction.z, 1.0, 0.0),
            };
            let along = x * u + y * v + z * w;
            let across = at_least(ray * ray - along * along, 0.0).sqrt();
            let away = along * cos - across * sin - reach - never;
            let rounding = ROUNDING_ACROSS * (ray + reach);
            *most = if away > rounding { 0.0 } else { *most };
            *least = if away < -rounding { *least } else { 0.0 };
        }
    }
}

/// The larger of two numbers; the second if the first is none.
#[inline(always)]
fn at_least(x: f32, least: f32) -> f32 {
    if x > least { x } else { least }
}

#[cfg(test)]
mod tests {
    use lodestream_protocol::view::{Projection, View};

    use super::*;
    use crate::pack::testing::{DagOptions, random_dag};
    use crate::pack::{Metadata, PackedModel, write_to_vec};

    #[test]
    fn nothing_matters_more_or_less_than_a_sweep_says() {
        let (mut rng, mut judged, mut in_sight, mut close, mut close_below) = (fastrand::Rng::with_seed(8), 0, 0, 0, 0);
        let mut sweep = Sweep::default();
        for seed in 0..4 {
            let (dag, complete) = random_dag(&DagOptions { splits: 1500, seed, ..DagOptions::default() });
            let model = PackedModel::from_vec(write_to_vec(&dag, &complete, &Metadata::default()).unwrap()).unwrap();
            let lattice = &model.info().lattice;
            for number in 0..200 {
                let mut random = |scale: f64| DVec3::from_array(std::array::from_fn(|_| (rng.f64() - 0.5) * scale));
                let place = |lattice_place: DVec3| DVec3::from_array(lattice.origin) + lattice_place * lattice.step;
                let away = [300.0, 3000.0, 1e5, 1e8][number % 4];
                let middle = DVec3::splat(500.0);
                let mut view = View::perspective(place(middle + random(away)), place(middle + random(800.0)), 0.7);
                view.near = 1e-3 * lattice.step;
                view.two_sided = number % 5 == 0;
                view.silhouette_factor = [1.0, 2.5][number % 2];
                if number % 3 == 0 {
                    view.projection = Projection::Orthographic { height: 700.0 * lattice.step };
                }
                if number % 7 == 0 {
                    let n = random(1.0).normalize();
                    view.clip_planes = vec![[n.x, n.y, n.z, -n.dot(place(middle))]];
                }
                view.complete = number % 20 == 19;
                let scorer = Scorer::new(&view, model.info());
                for page in 0..model.page_count() {
                    let tests = model.tests(page).unwrap();
                    let most = sweep.judge(&scorer, &tests).to_vec();
                    assert_eq!(most.len(), tests.error.len());
                    assert_eq!(sweep.least().len(), most.len());
                    for (row, (&most, &least)) in most.iter().zip(sweep.least()).enumerate() {
                        let bounds = model.bounds(tests.first_op + row as u32).unwrap();
                        assert_eq!(sweep.bounds(&tests, row), bounds);
                        let priority = scorer.priority(&bounds);
                        assert!(most >= priority, "seed {seed}, view {number}, {bounds:?}: {most} under {priority}");
                        assert!(least <= priority, "seed {seed}, view {number}, {bounds:?}: {least} over {priority}");
                        judged += 1;
                        close_below +=
                            u32::from(f64::from(least) * 1.001 * scorer.silhouette_factor() >= f64::from(priority));
                        in_sight += u32::from(priority > 0.0);
                        // Beside what a silhouette's factor may add.
                        close += u32::from(f64::from(most) <= f64::from(priority) * 1.001 * scorer.silhouette_factor());
                    }
                }
            }
        }
        assert!(in_sight > judged / 20, "{in_sight} of {judged}");
        assert!(close > judged / 100 * 97, "{close} of {judged} are near what they bound");
        assert!(close_below > judged / 100 * 95, "{close_below} of {judged} are near what they bound from below");
    }
}
