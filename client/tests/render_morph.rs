//! Transitions: nothing jumps when they begin, and nothing is left of them when they end.

#![cfg(feature = "render")]

mod meshes;
mod studio;

use std::collections::HashMap;
use std::time::Duration;

use glam::{DVec3, Vec3};
use lodestream_client::render::camera::CameraUniform;
use lodestream_client::render::ghosts::MAX_GHOSTS;
use lodestream_client::render::morph::{LONGEST, MorphView, Morphs, Motion, SHORTEST};
use lodestream_client::render::{Image, RenderCamera, RenderOptions, Shading};
use lodestream_protocol::ids::VertexSlot;
use lodestream_protocol::mesh::{Cut, Fan, NewVertex, Replica};
use lodestream_protocol::testing::OperationRng;
use lodestream_protocol::view::Projection;
use meshes::{icosphere, lattice};
use studio::{SIZE, Studio, looking, shaded};

fn millis(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

/// Splits `s` half-way to a neighbour, at a little distance from the surface.
fn split(replica: &mut Replica, s: u32, lift: f64) -> Option<u32> {
    let mut fan = Fan::default();
    replica.fan(VertexSlot(s), &mut fan).ok()?;
    let faces = fan.faces();
    let cut = Cut::Both { right: 0, left: faces / 2 };
    let middle = |k: usize| {
        let at = |v: u32| f64::from(replica.positions()[v as usize][k]);
        let center = f64::from(1u32 << 15);
        let p = (at(s) + at(fan.ring()[faces as usize / 4])) / 2.0;
        (center + (p - center) * lift).round() as i32
    };
    let vertex = NewVertex { position: [middle(0), middle(1), middle(2)], ..NewVertex::default() };
    replica.split(VertexSlot(s), &fan, cut, &vertex).ok().map(|t| t.0)
}

fn uniform(camera: &RenderCamera) -> CameraUniform {
    CameraUniform::new(camera, &lattice(), 4.0 / 3.0, Vec3::Z)
}

fn advance(morphs: &mut Morphs, now: Duration, replica: &mut Replica, camera: &CameraUniform) {
    let dirty = replica.dirty_mut().expect("it tracks");
    let births = dirty.take_births();
    let touched = dirty.vertex_ranges(63);
    dirty.clear();
    let view = MorphView { camera, size: SIZE, extent: 65535.0, duration: millis(200) };
    morphs.advance(now, births.as_deref(), &touched, replica, &view);
}

/// The dull twin: where everything was shown, carried from op to op by a map.
#[test]
fn whatever_overlaps_nothing_jumps() {
    let camera = RenderCamera {
        projection: Projection::Orthographic { height: 4.5 },
        ..looking(DVec3::new(1.0, 2.0, 6.0), DVec3::ZERO)
    };
    let camera = uniform(&camera);
    // Lattice steps per pixel, times what is not worth moving.
    let least = 0.3 * 4.5 / 480.0 / lattice().step;
    for seed in 0..20 {
        let mut rng = OperationRng::new(seed);
        let mut replica = icosphere(2).replica(&lattice());
        replica.track_dirty();
        let mut morphs = Morphs::default();
        let mut now = Duration::ZERO;
        let mut seen_moving = 0;
        advance(&mut morphs, now, &mut replica, &camera);
        for _ in 0..30 {
            // Time goes on, and everything is somewhere on its way.
            now += millis(u64::from(rng.below(120)));
            advance(&mut morphs, now, &mut replica, &camera);
            let mut shown: HashMap<u32, [f32; 3]> =
                replica.vertices().iter().map(|slot| (slot, morphs.shown(slot))).collect();
            for _ in 0..rng.below(60) {
                if rng.one_in(3) {
                    // Slots are freed and taken again.
                    let free = replica.collapsible().iter().nth(rng.below(40) as usize);
                    if let Some(t) = free.filter(|&t| replica.split_from(VertexSlot(t)).is_some()) {
                        replica.collapse(VertexSlot(t), &mut Vec::new()).unwrap();
                        shown.remove(&t);
                    }
                } else {
                    let s = replica.vertices().select_from(0, rng.below(150)).expect("so many there are");
                    if let Some(t) = split(&mut replica, s, 1.1) {
                        shown.insert(t, shown[&s]);
                    }
                }
            }
            advance(&mut morphs, now, &mut replica, &camera);
            for slot in replica.vertices().iter() {
                let (got, expected) = (Vec3::from(morphs.shown(slot)), Vec3::from(shown[&slot]));
                let place = Vec3::from(replica.positions()[slot as usize].map(|x| x as f32));
                // What is not seen moving is in its place: too short a way in the image, most of it along the ray.
                let is_near = got == place && {
                    let (a, b) = (camera.clip(got), camera.clip(expected));
                    (a - b).truncate().truncate().length() * 240.0 < 1.4 * 0.3
                };
                assert!(got.distance(expected) < 0.02 || is_near, "seed {seed}: {slot} jumps from {expected} to {got}");
                seen_moving += usize::from(got.distance(place) > least as f32);
            }
        }
        assert!(seen_moving > 100, "{seen_moving}");
        now += millis(201);
        advance(&mut morphs, now, &mut replica, &camera);
        assert!(!morphs.is_running());
        for slot in replica.vertices().iter() {
            assert_eq!(morphs.shown(slot), replica.positions()[slot as usize].map(|x| x as f32));
        }
    }
}

#[test]
fn what_is_out_of_sight_and_what_is_new_altogether_does_not_move() {
    let away = uniform(&looking(DVec3::new(0.0, 0.0, 3.0), DVec3::new(0.0, 0.0, 9.0)));
    let mut replica = icosphere(2).replica(&lattice());
    replica.track_dirty();
    let mut morphs = Morphs::default();
    // Nobody had asked for births before: a whole mesh that appears does not move.
    advance(&mut morphs, Duration::ZERO, &mut replica, &away);
    assert!(!morphs.is_running());
    (0..50).for_each(|s| assert!(split(&mut replica, s, 1.1).is_some()));
    advance(&mut morphs, millis(5), &mut replica, &away);
    assert!(!morphs.is_running() && morphs.take_changed().is_empty());
    // A replica made anew, as after a restart.
    let toward = uniform(&looking(DVec3::new(0.0, 0.0, 3.0), DVec3::ZERO));
    (0..50).for_each(|s| assert!(split(&mut replica, s, 1.1).is_some()));
    advance(&mut morphs, millis(10), &mut replica, &toward);
    assert!(morphs.is_running());
    let mut anew = icosphere(1).moved(|p| p * 0.7).replica(&lattice());
    anew.track_dirty();
    advance(&mut morphs, millis(20), &mut anew, &toward);
    assert!(!morphs.is_running());
    for slot in anew.vertices().iter() {
        assert_eq!(morphs.shown(slot), anew.positions()[slot as usize].map(|x| x as f32));
    }
}

#[test]
fn transitions_are_shorter_while_the_camera_moves() {
    let mut motion = Motion::default();
    let camera = |angle: f64| uniform(&looking(DVec3::new(4.0 * angle.sin(), 0.0, 4.0 * angle.cos()), DVec3::ZERO));
    let mut durations = Vec::new();
    for speed in [0.0, 0.5, 3.0] {
        for i in 0..60 {
            let t = f64::from(i) / 60.0;
            let now = millis(1000 * durations.len() as u64) + Duration::from_secs_f64(t);
            let duration = motion.follow(now, &camera(speed * t), 65535.0);
            if i == 59 {
                durations.push(duration);
            }
        }
    }
    assert_eq!(durations[0], LONGEST);
    assert!(durations.is_sorted_by(|a, b| a > b) && durations[2] < 2 * SHORTEST, "{durations:?}");
    // An image drawn twice at one time, and a clock that stands, change nothing.
    let again = motion.follow(millis(2983), &camera(0.0), 65535.0);
    assert_eq!(again, motion.follow(millis(2983), &camera(1.0), 65535.0));
}

fn worst(a: &Image, b: &Image) -> u8 {
    a.rgba.iter().zip(&b.rgba).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0)
}

/// Mean difference over all bytes.
fn mean(a: &Image, b: &Image) -> f64 {
    a.rgba.iter().zip(&b.rgba).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / a.rgba.len() as f64
}

#[test]
fn images_begin_as_before_and_end_as_without() {
    let (Some(mut studio), Some(mut plain)) = (Studio::open(), Studio::open()) else { return };
    let camera = looking(DVec3::new(0.7, 0.5, 3.0), DVec3::ZERO);
    for shading in [Shading::Smooth, Shading::Flat] {
        let mut replica = icosphere(2).replica(&studio.lattice);
        let at = |ms: u64| RenderOptions { geomorph: Some(millis(ms)), ..shaded(shading) };
        let name = format!("morph-{shading:?}");
        let first = studio.shoot(&format!("{name}-first"), &mut replica, &camera, &at(0));
        let before = studio.shoot(&format!("{name}-before"), &mut replica, &camera, &at(10));
        assert!(!studio.offscreen.stats().is_moving && first == before);
        for s in 0..160 {
            split(&mut replica, s, 1.15);
        }
        let mut copy = replica.clone();
        copy.track_dirty();
        let expected = plain.shoot(&format!("{name}-without"), &mut copy, &camera, &shaded(shading));

        let begin = studio.shoot(&format!("{name}-begin"), &mut replica, &camera, &at(20));
        let stats = studio.offscreen.stats();
        assert!(stats.is_moving && stats.uploaded_bytes > 0);
        // The same surface, cut up otherwise: slivers round their normals.
        assert!(mean(&begin, &before) < 0.05 && mean(&expected, &before) > 1.0, "{}", mean(&begin, &before));
        let mut last = 0.0;
        for ms in [80, 160, 240, 320, 400] {
            let image = studio.shoot(&format!("{name}-{ms}"), &mut replica, &camera, &at(20 + ms - 1));
            let stats = studio.offscreen.stats();
            assert!(stats.is_moving && stats.uploaded_bytes == 0, "{stats:?}");
            let moved = mean(&image, &before);
            assert!(moved > last, "{ms}: further and further");
            last = moved;
        }
        let end = studio.shoot(&format!("{name}-end"), &mut replica, &camera, &at(421));
        assert!(!studio.offscreen.stats().is_moving);
        assert_eq!(worst(&end, &expected), 0, "{shading:?}");
        // Off in the middle of another transition, and on again: at once, and not from somewhere else.
        (0..100).for_each(|s| assert!(split(&mut replica, s, 1.1).is_some()));
        studio.shoot(&name, &mut replica, &camera, &at(450));
        assert!(studio.offscreen.stats().is_moving);
        let off = studio.shoot(&name, &mut replica, &camera, &shaded(shading));
        let on = studio.shoot(&name, &mut replica, &camera, &at(460));
        assert!(!studio.offscreen.stats().is_moving && off == on);
    }
}

/// Collapses all that may, once.
fn collapse_all(replica: &mut Replica) -> usize {
    let free: Vec<u32> =
        replica.collapsible().iter().filter(|&t| replica.split_from(VertexSlot(t)).is_some()).collect();
    free.iter().filter(|&&t| replica.collapse(VertexSlot(t), &mut Vec::new()).is_ok()).count()
}

#[test]
fn what_collapses_fades() {
    let (Some(mut studio), Some(mut plain)) = (Studio::open(), Studio::open()) else { return };
    let camera = looking(DVec3::new(0.7, 0.5, 3.0), DVec3::ZERO);
    for shading in [Shading::Smooth, Shading::Flat] {
        let mut replica = icosphere(2).replica(&studio.lattice);
        (0..160).for_each(|s| assert!(split(&mut replica, s, 1.0).is_some()));
        let made = (0..160).filter_map(|s| split(&mut replica, s, 1.05)).count();
        assert!(made > 100);
        let at = |ms: u64| RenderOptions { geomorph: Some(millis(ms)), ..shaded(shading) };
        let name = format!("ghosts-{shading:?}");
        studio.shoot(&name, &mut replica, &camera, &at(0));
        let before = studio.shoot(&format!("{name}-before"), &mut replica, &camera, &at(10));
        assert!(collapse_all(&mut replica) > 50);
        let mut copy = replica.clone();
        copy.track_dirty();
        let expected = plain.shoot(&format!("{name}-without"), &mut copy, &camera, &shaded(shading));
        let jump = mean(&expected, &before);

        let begin = studio.shoot(&format!("{name}-begin"), &mut replica, &camera, &at(20));
        let stats = studio.offscreen.stats();
        assert!(stats.is_moving && stats.ghosts > 50, "{stats:?}");
        // Ghosts that lie deeper than the mesh is now are hidden by it.
        assert!(mean(&begin, &before) < 0.5 * jump, "{} of {jump}", mean(&begin, &before));
        let mut last = f64::INFINITY;
        for ms in [100, 200, 300, 390] {
            let image = studio.shoot(&format!("{name}-{ms}"), &mut replica, &camera, &at(20 + ms));
            let left = mean(&image, &expected);
            assert!(left < last, "{ms}: fainter and fainter");
            last = left;
        }
        assert!(last < 0.1 * jump);
        let end = studio.shoot(&format!("{name}-end"), &mut replica, &camera, &at(421));
        let stats = studio.offscreen.stats();
        assert_eq!((stats.is_moving, stats.ghosts), (false, 0));
        assert_eq!(worst(&end, &expected), 0, "{shading:?}");
    }
}

#[test]
fn ghosts_are_bounded_and_never_of_another_mesh() {
    let Some(mut studio) = Studio::open() else { return };
    let camera = looking(DVec3::new(0.0, 0.0, 1.6), DVec3::ZERO);
    let at = |ms: u64| RenderOptions { geomorph: Some(millis(ms)), ..RenderOptions::default() };
    let mut replica = icosphere(5).replica(&studio.lattice);
    let made = (0..10_000).filter_map(|s| split(&mut replica, s, 1.0)).count();
    assert!(made > 9_000);
    studio.shoot("ghosts-many", &mut replica, &camera, &at(0));
    studio.shoot("ghosts-many", &mut replica, &camera, &at(1));
    assert!(collapse_all(&mut replica) > 3000);
    studio.shoot("ghosts-many", &mut replica, &camera, &at(10));
    assert_eq!(studio.offscreen.stats().ghosts as usize, MAX_GHOSTS);
    // After a restart nothing fades that was not there.
    let mut anew = icosphere(3).replica(&studio.lattice);
    anew.track_dirty();
    studio.shoot("ghosts-anew", &mut anew, &camera, &at(20));
    assert_eq!(studio.offscreen.stats().ghosts, 0);
}
