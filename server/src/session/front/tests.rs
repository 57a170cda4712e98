//! Fronts against the walk of the whole view, along random camera paths.

use std::collections::BTreeSet;

use glam::DVec3;
use lodestream_protocol::view::{Projection, UNLIMITED_TRIANGLES, View, look_along};

use super::super::select::select;
use super::*;
use crate::pack::testing::{DagOptions, random_dag};
use crate::pack::{Metadata, write_to_vec};

/// A camera that mostly goes on a little, sometimes jumps, and now and then changes what is asked for.
struct Camera {
    rng: fastrand::Rng,
    middle: DVec3,
    size: f64,
    triangles: u32,
    eye: DVec3,
    target: DVec3,
    view: View,
}

impl Camera {
    fn new(model: &PackedModel, seed: u64) -> Self {
        let info = model.info();
        let corner = |q: [i32; 3]| {
            DVec3::from_array(info.lattice.origin) + DVec3::from_array(q.map(f64::from)) * info.lattice.step
        };
        let (low, high) = (corner(info.box_min), corner(info.box_max));
        let (middle, size) = ((low + high) / 2.0, low.distance(high));
        let eye = middle + DVec3::new(0.1, 0.2, 1.3) * size;
        let mut view = View::perspective(eye, middle, 0.8);
        view.near = 1e-3 * size;
        view.tolerance_px = 1.0;
        Self {
            rng: fastrand::Rng::with_seed(seed),
            middle,
            size,
            triangles: info.triangles as u32,
            eye,
            target: middle,
            view,
        }
    }

    fn direction(&mut self) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|_| self.rng.f64() - 0.5)).normalize_or(DVec3::Z)
    }

    fn step(&mut self, smallest_limit: u32) -> View {
        let (size, step) = (self.size, 0.02 * self.rng.f64());
        let way = self.direction() * size * step;
        match self.rng.u8(..100) {
            0..3 => self.eye = self.middle + self.direction() * size * (0.1 + 2.0 * self.rng.f64()),
            3..6 => self.target = self.middle + self.direction() * size * 0.3,
            6..40 => self.eye += way,
            40..60 => self.eye += (self.target - self.eye) * 2.0 * step,
            60..80 => self.target += way,
            80..83 => self.view.tolerance_px = [0.0, 0.5, 1.0, 4.0, 30.0][self.rng.usize(..5)],
            83..86 => {
                self.view.triangle_limit = match self.rng.u8(..4) {
                    0 => UNLIMITED_TRIANGLES,
                    _ => smallest_limit + self.rng.u32(..self.triangles),
                }
            }
            86..88 => self.view.silhouette_factor = [1.0, 2.5][self.rng.usize(..2)],
            88..90 => self.view.two_sided = self.rng.bool(),
            90..92 => {
                self.view.projection = match self.rng.bool() {
                    true => Projection::Perspective { fov_y_rad: 0.8 },
                    false => Projection::Orthographic { height: size * (0.2 + self.rng.f64()) },
                }
            }
            92..94 => {
                let n = self.direction();
                self.view.clip_planes = vec![[n.x, n.y, n.z, -n.dot(self.middle)]];
            }
            94..96 => self.view.clip_planes.clear(),
            // Viewers fit it to each view.
            96..98 => self.view.near = size * self.rng.f64().powi(4).max(1e-9),
            _ => {}
        }
        let forward = (self.target - self.eye).normalize_or(DVec3::Z);
        let orientation = look_along(forward, DVec3::Y).as_quat().to_array();
        View { eye: self.eye.to_array(), orientation, ..self.view.clone() }
    }
}

/// Follows a camera and compares each view. Returns how many were limited, and rows tested against ops held.
fn follow(model: &PackedModel, seed: u64, views: u32) -> (u32, u64, u64) {
    let mut camera = Camera::new(model, seed);
    let (mut front, mut members) = (Front::default(), BTreeSet::new());
    let (mut limited, mut tested, mut held, mut roughs, mut late) = (0, 0, 0, 0, 0);
    for number in 0..views {
        let view = camera.step(model.info().smallest_limit);
        let scorer = Scorer::new(&view, model.info());
        if camera.rng.bool() {
            // On the way, any closed set that nearly fills the limit will do.
            let rough = front.update(model, &scorer, &view, PageAccess::Blocking, Effort::Moving).unwrap();
            rough.left.iter().for_each(|op| assert!(members.remove(op), "seed {seed}, view {number}: {op}"));
            rough.joined.iter().for_each(|op| assert!(members.insert(*op), "seed {seed}, view {number}: {op}"));
            let mut triangles = model.base().faces.len() as u32;
            for &op in &members {
                assert!(front.has(op));
                triangles += model.triangles_of(op).unwrap();
                let parents = model.prerequisites(op).unwrap();
                assert!(parents.as_slice().iter().all(|parent| members.contains(parent)), "seed {seed}: {op}");
            }
            assert!(triangles <= view.triangle_limit, "seed {seed}, view {number}: {triangles}");
            roughs += u32::from(rough.is_rough);
            if !rough.is_limited {
                // Sizes are right within a factor.
                let at = |share: f32| {
                    let (tolerance_px, triangle_limit) = (view.tolerance_px * share, UNLIMITED_TRIANGLES);
                    let view = View { tolerance_px, triangle_limit, ..view.clone() };
                    let scorer = Scorer::new(&view, model.info());
                    let all = select(model, &scorer, triangle_limit, PageAccess::Blocking).unwrap();
                    all.ops.into_iter().collect::<BTreeSet<u32>>()
                };
                let (least, most) = (at(MOVING_FACTOR * 1.00001), at(0.99999 / MOVING_FACTOR));
                let missing = least.difference(&members).count();
                let needless = members.difference(&most).count();
                assert_eq!((missing, needless), (0, 0), "seed {seed}, view {number}: of {}", members.len());
                late += u32::from(members != at(1.0));
            }
        }
        let update = front.update(model, &scorer, &view, PageAccess::Blocking, Effort::Exact).unwrap();
        assert!(!update.is_rough);
        let expected = select(model, &scorer, view.triangle_limit, PageAccess::Blocking).unwrap();
        for op in &update.left {
            assert!(members.remove(op), "seed {seed}, view {number}: {op} left, but was not there");
        }
        for op in &update.joined {
            assert!(members.insert(*op), "seed {seed}, view {number}: {op} joined twice");
        }
        let found: BTreeSet<u32> = front.members().collect();
        assert_eq!(found, members, "seed {seed}, view {number}: members are not those that joined");
        let wanted: BTreeSet<u32> = expected.ops.iter().copied().collect();
        assert!(
            found == wanted,
            "seed {seed}, view {number}: {} ops instead of {}, too many {:?}, too few {:?}; {:?}",
            found.len(),
            wanted.len(),
            found.difference(&wanted).take(3).collect::<Vec<_>>(),
            wanted.difference(&found).take(3).collect::<Vec<_>>(),
            view,
        );
        let error = update.error.unwrap_or_else(|| front.error(model, &scorer, PageAccess::Blocking).unwrap());
        assert_eq!(
            (update.lambda, error, update.is_limited),
            (expected.lambda, expected.error, expected.is_limited),
            "seed {seed}, view {number}"
        );
        limited += u32::from(expected.is_limited);
        tested += u64::from(update.tested);
        held += found.len() as u64;
    }
    assert!(roughs > 20, "seed {seed}: {roughs} views were found roughly");
    assert!(late > 0, "seed {seed}: a moving camera is never followed late");
    (limited, tested, held)
}

#[test]
fn fronts_hold_what_a_walk_of_the_whole_view_finds() {
    let (mut limited, mut free) = (0, 0);
    for seed in 0..6 {
        let options = DagOptions { splits: 3000, seed, ..DagOptions::default() };
        let (dag, complete) = random_dag(&options);
        let model = PackedModel::from_vec(write_to_vec(&dag, &complete, &Metadata::default()).unwrap()).unwrap();
        let (some, _, _) = follow(&model, seed, 700);
        limited += some;
        free += 700 - some;
    }
    assert!(limited > 300 && free > 300, "{limited} limited views and {free} others");
}

#[test]
fn views_in_which_sizes_are_infinite_come_to_an_end() {
    let (dag, complete) = random_dag(&DagOptions { splits: 3000, ..DagOptions::default() });
    let model = PackedModel::from_vec(write_to_vec(&dag, &complete, &Metadata::default()).unwrap()).unwrap();
    let mut front = Front::default();
    let mut camera = Camera::new(&model, 0);
    for (near, limit) in [(1e-300, 500), (1.0, 500), (1e-300, 200), (1e-300, UNLIMITED_TRIANGLES)] {
        camera.view.near = near;
        camera.view.projection = Projection::Perspective { fov_y_rad: 2e-6 };
        camera.view.viewport_height_px = 1 << 20;
        camera.view.silhouette_factor = 1e6;
        camera.view.triangle_limit = model.info().smallest_limit.saturating_add(limit);
        let view = View { eye: camera.middle.to_array(), ..camera.view.clone() };
        let scorer = Scorer::new(&view, model.info());
        let expected = select(&model, &scorer, view.triangle_limit, PageAccess::Blocking).unwrap();
        front.update(&model, &scorer, &view, PageAccess::Blocking, Effort::Exact).unwrap();
        let found: BTreeSet<u32> = front.members().collect();
        assert_eq!(found, expected.ops.into_iter().collect(), "near {near}, limit {limit}");
    }
}
