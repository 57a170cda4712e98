//! What options do to images, against what they should. Without a graphics adapter the tests report themselves skipped.

#![cfg(feature = "render")]

mod meshes;
mod studio;

use glam::{DVec3, Vec3};
use lodestream_client::render::lines::{Line, frustum};
use lodestream_client::render::options::{
    CLAY_LINEAR, SECTION_LINEAR, level, level_color, light, srgb_decode, srgb_encode,
};
use lodestream_client::render::{Image, RenderCamera, RenderOptions, Shading};
use lodestream_protocol::view::{Plane, Projection};
use meshes::{Soup, cube, icosphere, sheet};
use studio::{FOV_Y_RAD, Studio, assert_close, background, clay, covered, key_light, looking, shaded};

fn shades(color: [f32; 3], light: f32) -> [f32; 3] {
    color.map(|c| srgb_encode(c * light))
}

/// Where a point appears, in pixels.
fn pixel_of(camera: &RenderCamera, p: DVec3) -> [u32; 2] {
    let c = camera.rotation.inverse() * (p - camera.eye);
    let scale = match camera.projection {
        Projection::Perspective { .. } => 240.0 / (f64::from(FOV_Y_RAD) / 2.0).tan() / -c.z,
        Projection::Orthographic { height } => 480.0 / height,
    };
    [(320.0 + c.x * scale) as u32, (240.0 - c.y * scale) as u32]
}

fn at(image: &Image, [x, y]: [u32; 2]) -> [u8; 3] {
    image.pixel(x, y)
}

#[test]
fn the_key_light_comes_from_where_it_is_put() {
    let Some(mut studio) = Studio::open() else { return };
    let mut sphere = icosphere(5).replica(&studio.lattice);
    let camera = looking(DVec3::new(3.0, 1.0, 2.0), DVec3::ZERO);
    for direction in [Vec3::X, Vec3::new(-5.0, 1.0, 2.0), Vec3::new(0.0, -0.1, 0.3)] {
        let options = RenderOptions { light: direction, ..RenderOptions::default() };
        let image = studio.shoot("light", &mut sphere, &camera, &options);
        let key = direction.normalize();
        assert_close(image.pixel(320, 240), shades(CLAY_LINEAR, light(Vec3::Z, key)), 1.0);
    }
    // No direction is the default one.
    let images = [Vec3::ZERO, Vec3::NAN, RenderOptions::default().light]
        .map(|light| studio.shoot("light", &mut sphere, &camera, &RenderOptions { light, ..RenderOptions::default() }));
    assert!(images[0] == images[2] && images[1] == images[2]);
}

#[test]
fn the_background_runs_from_bottom_to_top() {
    let Some(mut studio) = Studio::open() else { return };
    let (low, high) = ([20, 30, 40], [120, 140, 160]);
    let options = RenderOptions { background: low, background_top: Some(high), ..RenderOptions::default() };
    let camera = looking(DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO);
    let image = studio.shoot_soup("gradient", &icosphere(4), &camera, &options);
    let close = |got: [u8; 3], want: [u8; 3], bound| assert_close(got, want.map(f32::from), bound);
    close(image.pixel(5, 479), low, 1.5);
    close(image.pixel(5, 0), high, 1.5);
    assert!((0..479).all(|y| image.pixel(3, y)[1] + 2 >= image.pixel(3, y + 1)[1]), "brighter upwards");
    assert_close(image.pixel(320, 240), clay(Vec3::Z), 1.0);
    // A plain background is exactly what was asked for.
    let plain = RenderOptions { background: low, ..RenderOptions::default() };
    let image = studio.shoot_soup("plain", &icosphere(4), &camera, &plain);
    assert!([(5, 479), (5, 0)].into_iter().all(|(x, y)| image.pixel(x, y) == low));
}

#[test]
fn wires_lie_on_edges_and_are_one_pixel_wide() {
    let Some(mut studio) = Studio::open() else { return };
    // A unit grid of 8 by 8 quads over 320 by 320 pixels: edges every 40 pixels and along the diagonals.
    let camera = RenderCamera {
        projection: Projection::Orthographic { height: 3.0 },
        ..looking(DVec3::new(0.0, 0.0, 3.0), DVec3::ZERO)
    };
    for shading in [Shading::Flat, Shading::Smooth] {
        let options = RenderOptions { wireframe: true, ..shaded(shading) };
        let image = studio.shoot_soup(&format!("wire-{shading:?}"), &sheet(8, |_, _| 0.0), &camera, &options);
        assert!(studio.offscreen.stats().has_details);
        let darkness = |x: u32, y: u32| f32::from(image.pixel(x, y)[1]) / clay(Vec3::Z)[1];
        // Across a vertical edge, in a row that no other edge crosses near it.
        for column in 1..8 {
            let edge = 160 + 40 * column;
            let row: Vec<f32> = (edge - 6..edge + 6).map(|x| darkness(x, 90)).collect();
            let dark = row.iter().filter(|&&d| d < 0.97).count();
            assert!((1..=2).contains(&dark), "{shading:?}: {row:?}");
        }
        // Inside of faces nothing changes.
        for (x, y) in [(170, 90), (190, 115), (330, 250)] {
            assert_close(image.pixel(x, y), clay(Vec3::Z), 1.0);
        }
    }
    // The same mesh without wires, whatever was drawn before.
    let plain = studio.shoot_soup("wire-off", &sheet(8, |_, _| 0.0), &camera, &shaded(Shading::Flat));
    assert!(!studio.offscreen.stats().has_details);
    assert_close(plain.pixel(200, 90), clay(Vec3::Z), 1.0);
    let sphere = looking(DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO);
    let options = RenderOptions { wireframe: true, ..RenderOptions::default() };
    studio.shoot_soup("wire-sphere", &icosphere(4), &sphere, &options);
}

#[test]
fn faces_are_coloured_by_their_size() {
    let Some(mut studio) = Studio::open() else { return };
    let camera = looking(DVec3::new(0.0, 0.0, 3.0), DVec3::ZERO);
    let options = RenderOptions { refinement_colors: true, ..shaded(Shading::Smooth) };
    for n in [1, 4, 30, 200] {
        let image = studio.shoot_soup(&format!("levels-{n}"), &sheet(n, |_, _| 0.0), &camera, &options);
        let extent = studio.lattice.step * f64::from(studio.lattice.max_coordinate());
        let side = 2.0 / f64::from(n);
        let expected = level_color(level(side * side / 2.0, extent));
        // Sides are a few lattice steps off where n is large.
        assert_close(image.pixel(325, 243), shades(expected, key_light(Vec3::Z)), 3.0);
    }
}

#[test]
fn backs_are_tinted_only_on_demand() {
    let Some(mut studio) = Studio::open() else { return };
    let options = RenderOptions { tint_backs: true, ..shaded(Shading::Smooth) };
    let shoot = |studio: &mut Studio, z: f64| {
        let camera = looking(DVec3::new(0.0, 0.0, z), DVec3::ZERO);
        studio.shoot_soup("backs", &sheet(4, |_, _| 0.0), &camera, &options).pixel(323, 241)
    };
    assert_close(shoot(&mut studio, 3.0), clay(Vec3::Z), 1.0);
    let [red, green, _] = shoot(&mut studio, -3.0);
    assert!(red > 2 * green, "backs are red: {red} {green}");
}

/// A sphere in a sphere, the inner one inside out: a shell.
fn shell() -> Soup {
    let mut shell = icosphere(5);
    let inner = icosphere(4).moved(|p| 0.6 * p);
    let first = shell.points.len() as u32;
    shell.points.extend(inner.points);
    shell.colors.extend(inner.colors);
    shell.faces.extend(inner.faces.iter().map(|&[a, b, c]| [first + a, first + c, first + b]));
    shell
}

#[test]
fn a_section_shows_the_cut_as_a_solid() {
    let Some(mut studio) = Studio::open() else { return };
    let perspective = looking(DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO);
    let parallel = RenderCamera { projection: Projection::Orthographic { height: 3.0 }, ..perspective };
    for camera in [perspective, parallel] {
        for shading in [Shading::Smooth, Shading::Flat] {
            // The front half of a shell is cut away: a ring of cut, and in it the inside of the cavity.
            let plane = Plane { normal: DVec3::new(0.0, 0.0, -2.0), offset: 0.4 };
            let options = RenderOptions { section: Some(plane), ..shaded(shading) };
            let image = studio.shoot_soup(&format!("section-{shading:?}"), &shell(), &camera, &options);
            let cut = SECTION_LINEAR.map(srgb_encode);
            let z = 0.2;
            for angle in [0.1, 1.3, 2.9, 4.0, 5.5f64] {
                let on = |r: f64| DVec3::new(r * angle.cos(), r * angle.sin(), z);
                assert_close(at(&image, pixel_of(&camera, on(0.7))), cut, 1.0);
                assert_close(at(&image, pixel_of(&camera, on(0.9))), cut, 1.0);
                let outer = (1.0f64 - z * z).sqrt();
                assert_close(at(&image, pixel_of(&camera, on(outer * 0.985))), cut, 1.0);
                let inner = (0.36f64 - z * z).sqrt();
                let cavity = at(&image, pixel_of(&camera, on(inner * 0.9)));
                assert!(cavity[0].abs_diff(cavity[1]) < 20, "the cavity is clay: {cavity:?}");
            }
            // In the middle one looks at the far wall of the cavity, whose faces turn their fronts to the viewer.
            assert_close(at(&image, pixel_of(&camera, DVec3::ZERO)), clay(Vec3::Z), 2.0);
            // From behind, what is left is an ordinary sphere, and nothing of the cut shows.
            let behind = RenderCamera { eye: -camera.eye, ..looking(-camera.eye, DVec3::ZERO) };
            let behind = RenderCamera { projection: camera.projection, ..behind };
            let whole = studio.shoot_soup("section-none", &shell(), &behind, &shaded(shading));
            let seen = studio.shoot_soup("section-behind", &shell(), &behind, &options);
            let off = whole.rgba.iter().zip(&seen.rgba).filter(|(a, b)| a.abs_diff(**b) > 2).count();
            assert!(off < 4 * 2000, "{off} of the rim's bytes may differ");
            // A plane without a normal cuts nothing.
            let none = Plane { normal: DVec3::ZERO, offset: -1.0 };
            let options = RenderOptions { section: Some(none), ..shaded(shading) };
            assert!(studio.shoot_soup("section-none", &shell(), &behind, &options) == whole);
        }
    }
}

#[test]
fn a_section_far_from_the_origin_is_where_it_should_be() {
    let Some(mut studio) = Studio::open() else { return };
    let origin = DVec3::new(5e6, 4e6, 300.0);
    studio.lattice =
        lodestream_protocol::quant::Lattice::of_box((origin - 5.0).to_array(), (origin + 5.0).to_array(), 21);
    let camera = looking(origin + DVec3::new(0.0, 0.0, 4.0), origin);
    // All right of the middle is gone.
    let plane = Plane { normal: DVec3::NEG_X, offset: origin.x };
    let options = RenderOptions { section: Some(plane), ..shaded(Shading::Smooth) };
    let image = studio.shoot_soup("section-survey", &cube().moved(|p| origin + p), &camera, &options);
    let row: Vec<bool> = (0..640).map(|x| image.pixel(x, 240) != background()).collect();
    assert!(row[200] && row[318] && !row[321] && !row[400]);
}

#[test]
fn lines_are_seen_through_the_mesh_but_faintly() {
    let Some(mut studio) = Studio::open() else { return };
    let camera = looking(DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO);
    let line = |z: f64, y: f64| Line { from: DVec3::new(-3.0, y, z), to: DVec3::new(3.0, y, z), color: [255, 40, 0] };
    let broken = Line { from: DVec3::splat(f64::NAN), ..line(0.0, 0.0) };
    // Half a pixel off, so that a line is in the middle of a row of pixels.
    let half = 0.5 * 4.0 * (f64::from(FOV_Y_RAD) / 2.0).tan() / 240.0;
    studio.offscreen.renderer_mut().set_lines(&[line(1.5, -half * 2.5 / 4.0), line(0.0, 0.5), broken]);
    let sphere = icosphere(5);
    let image = studio.shoot_soup("lines", &sphere, &camera, &shaded(Shading::Smooth));
    assert_close(image.pixel(320, 240), [255.0, 40.0, 0.0], 6.0);
    // Behind the sphere the line shines through, in front of the background it is itself.
    let y = pixel_of(&camera, DVec3::new(0.0, 0.5, 0.0))[1];
    let reddest = |x: u32| (y - 2..y + 3).map(|y| image.pixel(x, y)).max_by_key(|p| i32::from(p[0]) - i32::from(p[1]));
    let (hidden, seen) = (reddest(320).unwrap(), reddest(80).unwrap());
    assert!(hidden[0] > hidden[1] + 15 && hidden[1] > 120, "{hidden:?}");
    assert!(seen[0] > 200 && seen[1] < 110, "{seen:?}");
    // A line through the eye, one behind it and no line at all.
    let through = Line { from: DVec3::new(0.0, 0.0, 9.0), to: DVec3::new(0.3, 0.2, -9.0), color: [0, 255, 0] };
    let behind = Line { from: DVec3::new(-1.0, 0.0, 9.0), to: DVec3::new(1.0, 0.0, 9.0), color: [0, 255, 0] };
    studio.offscreen.renderer_mut().set_lines(&[behind]);
    let with = studio.shoot_soup("lines-behind", &sphere, &camera, &shaded(Shading::Smooth));
    studio.offscreen.renderer_mut().set_lines(&[]);
    let without = studio.shoot_soup("lines-none", &sphere, &camera, &shaded(Shading::Smooth));
    assert!(with == without, "nothing behind the eye is drawn");
    studio.offscreen.renderer_mut().set_lines(&[through]);
    studio.shoot_soup("lines-through", &sphere, &camera, &shaded(Shading::Smooth));
}

#[test]
fn a_frustum_covers_what_its_camera_sees() {
    let Some(mut studio) = Studio::open() else { return };
    let inner = looking(DVec3::new(1.5, 0.5, 2.0), DVec3::ZERO);
    for projection in [inner.projection, Projection::Orthographic { height: 1.5 }] {
        let inner = RenderCamera { projection, ..inner };
        let lines = frustum(&inner, 1.5, 4.0, [255, 160, 30]);
        assert!(lines.len() >= 12);
        // The far corners are the corners of the image.
        for line in &lines {
            let c = inner.rotation.inverse() * (line.to - inner.eye);
            assert!(c.z < 0.0 && c.z >= -4.0 - 1e-9);
        }
        studio.offscreen.renderer_mut().set_lines(&lines);
        let outside = looking(DVec3::new(6.0, 4.0, 5.0), DVec3::new(0.0, 0.0, 0.0));
        let image = studio.shoot_soup("frustum", &icosphere(4), &outside, &shaded(Shading::Smooth));
        assert!(covered(&image) > 2000.0);
    }
}

#[test]
fn without_storage_buffers_images_are_flat_and_say_so() {
    let (Some(mut studio), Some(mut webgl)) = (Studio::open(), Studio::as_webgl()) else { return };
    let camera = looking(DVec3::new(2.0, 1.0, 3.0), DVec3::ZERO);
    let plane = Plane { normal: DVec3::new(-1.0, 0.2, -0.5), offset: 0.1 };
    for section in [None, Some(plane)] {
        let flat = RenderOptions { section, ..shaded(Shading::Flat) };
        let expected = studio.shoot_soup("webgl-not", &shell(), &camera, &flat);
        let asked = RenderOptions { wireframe: true, refinement_colors: true, shading: Shading::Smooth, ..flat };
        let image = webgl.shoot_soup("webgl", &shell(), &camera, &asked);
        let stats = webgl.offscreen.stats();
        assert!(!stats.is_smooth && !stats.has_details && !stats.computed_normals, "{stats:?}");
        // Only the rims of the cut may differ: whole pixels are cut there.
        let off = expected.rgba.iter().zip(&image.rgba).filter(|(a, b)| a.abs_diff(**b) > 1).count();
        assert!(off <= if section.is_some() { 4 * 1500 } else { 0 }, "{off} bytes differ");
    }
}

/// Share of the light that occlusion leaves, by the green of a pixel.
fn left_of(with: [u8; 3], without: [u8; 3]) -> f64 {
    srgb_decode(with[1]) / srgb_decode(without[1])
}

#[test]
fn crevices_are_darker_and_nothing_else() {
    let Some(mut studio) = Studio::open() else { return };
    // A gutter with walls at right angles, between two floors.
    let gutter = sheet(64, |x, _| if x.abs() < 0.3 { x.abs() - 0.3 } else { 0.0 });
    let perspective = looking(DVec3::new(0.0, 0.0, 3.0), DVec3::ZERO);
    let parallel = RenderCamera { projection: Projection::Orthographic { height: 2.5 }, ..perspective };
    for camera in [perspective, parallel] {
        let occluded = RenderOptions { occlusion: 1.0, ..shaded(Shading::Flat) };
        let without = studio.shoot_soup("gutter-without", &gutter, &camera, &shaded(Shading::Flat));
        assert!(!studio.offscreen.stats().has_occlusion);
        let with = studio.shoot_soup("gutter", &gutter, &camera, &occluded);
        assert!(studio.offscreen.stats().has_occlusion);
        let left = |x: f64, y: f64| {
            let z = if x.abs() < 0.3 { x.abs() - 0.3 } else { 0.0 };
            let pixel = pixel_of(&camera, DVec3::new(x, y, z));
            left_of(at(&with, pixel), at(&without, pixel))
        };
        for y in [-0.4, 0.03, 0.5] {
            assert!(left(0.8, y) > 0.97 && left(-0.7, y) > 0.97, "floors are free: {} {}", left(0.8, y), left(-0.7, y));
            let walls = [0.02, 0.07, 0.12, 0.2].map(|x| (left(x, y) + left(-x, y)) / 2.0);
            assert!(walls.is_sorted() && walls[0] < 0.6, "darker and darker towards the bottom: {walls:?}");
            assert!((left(0.1, y) - left(-0.1, y)).abs() < 0.06, "both walls alike");
        }
        // What occludes weakly leaves more.
        let half = RenderOptions { occlusion: 0.5, ..occluded };
        let half = studio.shoot_soup("gutter-half", &gutter, &camera, &half);
        let bottom = pixel_of(&camera, DVec3::new(0.02, 0.03, -0.28));
        let expected = 0.5 + 0.5 * left_of(at(&with, bottom), at(&without, bottom));
        assert!((left_of(at(&half, bottom), at(&without, bottom)) - expected).abs() < 0.03);
    }
}

#[test]
fn occlusion_leaves_round_things_what_is_far_behind_and_cuts_alone() {
    let Some(mut studio) = Studio::open() else { return };
    let occluded = RenderOptions { occlusion: 1.0, ..RenderOptions::default() };
    let camera = looking(DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO);
    let mut sphere = icosphere(6).replica(&studio.lattice);
    let without = studio.shoot("round-without", &mut sphere, &camera, &RenderOptions::default());
    let with = studio.shoot("round", &mut sphere, &camera, &occluded);
    for (a, b) in without.rgba.chunks_exact(4).zip(with.rgba.chunks_exact(4)) {
        assert!(f64::from(b[1]) >= 0.93 * f64::from(a[1]) - 1.0 && b[1] <= a[1] + 1, "{a:?} became {b:?}");
        assert_eq!(b[3], 255);
    }
    // A small ball far in front of a wall: no halo around it.
    let mut scene = sheet(8, |_, _| -1.5);
    let ball = icosphere(4).moved(|p| p * 0.1 + DVec3::Z * 1.5);
    let first = scene.points.len() as u32;
    scene.points.extend(ball.points);
    scene.colors.extend(ball.colors);
    scene.faces.extend(ball.faces.iter().map(|face| face.map(|v| v + first)));
    let without = studio.shoot_soup("halo-without", &scene, &camera, &RenderOptions::default());
    let with = studio.shoot_soup("halo", &scene, &camera, &occluded);
    let darkest = (260..380).flat_map(|x| (180..300).map(move |y| (x, y)));
    let darkest = darkest.map(|(x, y)| left_of(with.pixel(x, y), without.pixel(x, y))).fold(1.0, f64::min);
    assert!(darkest > 0.9, "a halo leaves {darkest}");
    // The cut of a section has no shape, whatever lies behind it; the cavity has.
    let plane = Plane { normal: DVec3::NEG_Z, offset: 0.2 };
    let cut = RenderOptions { section: Some(plane), ..occluded };
    let image = studio.shoot_soup("section-occluded", &shell(), &camera, &cut);
    for x in [0.65, 0.75, 0.85, 0.95] {
        let pixel = at(&image, pixel_of(&camera, DVec3::new(x, 0.0, 0.2)));
        assert_close(pixel, SECTION_LINEAR.map(srgb_encode), 1.0);
    }
    assert!(image.rgba.chunks_exact(4).all(|p| p[3] == 255), "images are opaque");
    let Some(mut webgl) = Studio::as_webgl() else { return };
    webgl.shoot("webgl-occluded", &mut icosphere(3).replica(&studio.lattice), &camera, &occluded);
    assert!(!webgl.offscreen.stats().has_occlusion);
}
