use super::*;

const VIEWPORT: Viewport = Viewport { width_px: 900, height_px: 600 };

fn at(ms: u64) -> Timestamp {
    Timestamp(Duration::from_millis(ms))
}

fn navigator() -> Navigator {
    let bounds = Bounds { center: DVec3::new(1.0, 2.0, 3.0), radius: 2.0 };
    let mut navigator = Navigator::new(bounds, VIEWPORT, 0.8);
    assert!(navigator.advance(at(0)), "the first pose is news");
    assert!(!navigator.advance(at(1)));
    navigator
}

/// Advances in steps until nothing moves.
fn settle(navigator: &mut Navigator, from_ms: u64, step_ms: u64) -> u64 {
    let mut now = from_ms;
    for _ in 0..10_000 {
        now += step_ms;
        navigator.advance(at(now));
        if !navigator.is_moving() {
            return now;
        }
    }
    panic!("it never stops");
}

#[test]
fn the_first_view_is_that_of_snapshots() {
    let navigator = navigator();
    let mut framed = Camera::perspective(0.8);
    framed.frame(&Bounds { center: DVec3::new(1.0, 2.0, 3.0), radius: 2.0 }, DEFAULT_DIRECTION, VIEWPORT.aspect());
    let camera = navigator.camera();
    assert!(camera.eye.distance(framed.eye) < 1e-9 && camera.orientation.angle_between(framed.orientation) < 1e-7);
    assert!((camera.near - framed.near).abs() < 1e-9);
}

#[test]
fn a_drag_turns_and_letting_go_glides_the_same_way_at_any_rate_of_images() {
    let turned = |step_ms: u64| {
        let mut navigator = navigator();
        for ms in (100..200).step_by(10) {
            navigator.drag(at(ms), 6.0, 0.0);
        }
        let held = navigator.camera();
        navigator.release(at(200));
        assert!(navigator.is_moving());
        settle(&mut navigator, 200, step_ms);
        assert!(navigator.camera().orientation.angle_between(held.orientation) > 0.1, "it goes on");
        navigator.camera().forward()
    };
    assert!(turned(1).distance(turned(16)) < 2e-3, "{} {}", turned(1), turned(16));
    // Held still before letting go: no inertia.
    let mut navigator = navigator();
    navigator.drag(at(100), 30.0, 5.0);
    navigator.drag(at(110), 30.0, 5.0);
    navigator.release(at(400));
    assert!(!navigator.is_moving());
}

#[test]
fn zooming_keeps_the_point_under_the_cursor() {
    for is_orthographic in [false, true] {
        let mut navigator = navigator();
        navigator.set_orthographic(is_orthographic);
        let anchor = DVec3::new(1.5, 2.5, 3.2);
        let before = navigator.camera().pixel(VIEWPORT, anchor).unwrap();
        let units = navigator.camera().units_per_pixel(VIEWPORT, navigator.orbit().target);
        navigator.zoom(at(10), anchor, 0.5);
        navigator.zoom(at(20), anchor, 0.5);
        settle(&mut navigator, 20, 16);
        let after = navigator.camera().pixel(VIEWPORT, anchor).unwrap();
        assert!((before[0] - after[0]).abs() < 1e-6 && (before[1] - after[1]).abs() < 1e-6, "{before:?} {after:?}");
        let now = navigator.camera().units_per_pixel(VIEWPORT, navigator.orbit().target);
        assert!((now * 4.0 / units - 1.0).abs() < 1e-9, "{now} {units}");
        // No end of the wheel leads through the point or out of sight.
        for ms in 0..4000 {
            navigator.zoom(at(1000 + ms), anchor, 0.1);
            navigator.advance(at(1000 + ms));
        }
        assert!(navigator.orbit().distance() >= NEAREST_RADII * 2.0 * 0.999);
        for ms in 0..4000 {
            navigator.zoom(at(9000 + ms), anchor, 10.0);
            navigator.advance(at(9000 + ms));
        }
        assert!(navigator.orbit().distance() <= FARTHEST_RADII * 2.0 * 1.001);
        assert!(navigator.camera().view(VIEWPORT, &Default::default()).validate().is_ok());
    }
}

#[test]
fn panning_keeps_the_target_plane_under_the_pointer() {
    for is_orthographic in [false, true] {
        let mut navigator = navigator();
        navigator.set_orthographic(is_orthographic);
        let point = navigator.orbit().target;
        let before = navigator.camera().pixel(VIEWPORT, point).unwrap();
        navigator.pan(40.0, -25.0);
        let after = navigator.camera().pixel(VIEWPORT, point).unwrap();
        assert!((after[0] - before[0] - 40.0).abs() < 1e-6 && (after[1] - before[1] + 25.0).abs() < 1e-6);
    }
}

#[test]
fn named_views_are_reached_exactly() {
    for up in [UpAxis::Y, UpAxis::Z] {
        let mut navigator = navigator();
        navigator.set_up(at(0), up);
        let mut now = settle(&mut navigator, 0, 16);
        let turned = |direction: DVec3| match up {
            UpAxis::Y => direction,
            UpAxis::Z => DVec3::new(direction.x, -direction.z, direction.y),
        };
        for view in StandardView::ALL {
            navigator.standard(at(now), view);
            now = settle(&mut navigator, now, 16);
            let forward = navigator.camera().forward();
            assert!(forward.distance(-turned(view.direction()).normalize()) < 1e-9, "{up:?} {view:?}: {forward}");
            assert!(navigator.orbit().target.distance(navigator.bounds.center) < 1e-9);
        }
        navigator.focus(at(now), DVec3::new(2.0, 2.0, 3.0));
        now = settle(&mut navigator, now, 16);
        let middle = navigator.camera().pixel(VIEWPORT, DVec3::new(2.0, 2.0, 3.0)).unwrap();
        assert!((middle[0] - 450.0).abs() < 1e-6 && (middle[1] - 300.0).abs() < 1e-6);
        navigator.fit(at(now));
        settle(&mut navigator, now, 16);
        assert!(navigator.orbit().target.distance(navigator.bounds.center) < 1e-9);
    }
}

#[test]
fn flying_goes_on_while_a_key_is_held() {
    let mut navigator = navigator();
    let eye = navigator.camera().eye;
    navigator.set_thrust(at(0), DVec3::NEG_Z);
    for ms in (0..500).step_by(16) {
        navigator.advance(at(ms));
    }
    let ahead = (navigator.camera().eye - eye).dot(navigator.camera().forward());
    assert!(ahead > 0.0 && (navigator.camera().eye - eye).length() < ahead * 1.001, "{ahead}");
    let rest = navigator.orbit().distance();
    navigator.set_thrust(at(500), DVec3::ZERO);
    settle(&mut navigator, 500, 16);
    assert!((navigator.orbit().distance() - rest).abs() < 1e-9);
    // After a pause, as of a page in the background, the camera does not leap.
    navigator.set_thrust(at(2_000), DVec3::X);
    navigator.advance(at(2_016));
    let eye = navigator.camera().eye;
    navigator.advance(at(100_000));
    assert!(navigator.camera().eye.distance(eye) < 0.15 * navigator.orbit().distance());
}

#[test]
fn orthographic_cameras_cut_nothing_off_however_near() {
    let mut navigator = navigator();
    navigator.set_orthographic(true);
    navigator.pinch(DVec3::new(1.0, 2.0, 3.0), 1e-3);
    let camera = navigator.camera();
    let depth = (navigator.bounds.center - camera.eye).dot(camera.forward()) - navigator.bounds.radius;
    assert!(depth > camera.near, "{depth} {}", camera.near);
}

#[test]
fn a_model_keeps_its_size_when_the_image_changes_its_shape() {
    let mut navigator = navigator();
    let bounds = Bounds { center: DVec3::new(1.0, 2.0, 3.0), radius: 2.0 };
    let edge = bounds.center + DVec3::new(0.0, 1.5, 0.7);
    // Pixels from the middle of the image, where the narrower side has as many.
    let mut seen = |width_px: u32, height_px: u32| {
        let viewport = Viewport { width_px, height_px };
        navigator.set_viewport(viewport);
        let matrix = navigator.camera().view_projection(viewport.aspect(), &bounds);
        let clip = matrix.project_point3(edge);
        [clip.x * f64::from(width_px) / 2.0, clip.y * f64::from(height_px) / 2.0]
    };
    let first = seen(900, 600);
    for (width_px, height_px) in [(600, 600), (600, 900), (600, 1290), (1290, 600)] {
        let other = seen(width_px, height_px);
        let far = (first[0] - other[0]).hypot(first[1] - other[1]);
        assert!(far < 0.01, "{width_px} x {height_px}: {far} px");
    }
}
