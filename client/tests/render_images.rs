//! Images of generated meshes against what they should be. Without a graphics adapter the tests report themselves skipped.
//! `LODESTREAM_TEST_IMAGES=DIR` keeps the images.

#![cfg(feature = "render")]

mod meshes;
mod studio;

use std::f64::consts::PI;

use glam::{DQuat, DVec3, Vec3};
use lodestream_client::render::options::{srgb_decode, srgb_encode};
use lodestream_client::render::{Image, RenderCamera, RenderError, RenderOptions, Shading};
use lodestream_protocol::mesh::Replica;
use lodestream_protocol::quant::Lattice;
use lodestream_protocol::testing::OperationRng;
use lodestream_protocol::view::Projection;
use meshes::{cube, cylinder, icosphere, sheet};
use studio::{FOV_Y_RAD, SIZE, Studio, assert_close, background, clay, covered, key_light, looking, shaded};

/// Darkest green of what is not background or its blend: pixels whose four neighbours are all covered.
fn darkest_inside(image: &Image) -> u8 {
    let mut darkest = 255;
    for y in 2..image.height - 2 {
        for x in 2..image.width - 2 {
            let near = [(0, 0), (2, 0), (0, 2), (4, 2), (2, 4), (2, 2), (4, 4), (0, 4), (4, 0)];
            if near.iter().all(|(i, j)| image.pixel(x + i - 2, y + j - 2) != background()) {
                darkest = darkest.min(image.pixel(x, y)[1]);
            }
        }
    }
    darkest
}

#[test]
fn sphere_has_its_silhouette_shade_and_background() {
    let Some(mut studio) = Studio::open() else { return };
    let mut sphere = icosphere(5).replica(&studio.lattice);
    let camera = looking(DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO);
    for shading in [Shading::Smooth, Shading::Flat] {
        let image = studio.shoot(&format!("sphere-{shading:?}"), &mut sphere, &camera, &shaded(shading));
        assert_eq!(studio.offscreen.stats().is_smooth, shading == Shading::Smooth);
        // A sphere of radius 1 at distance 4 appears as a cone of half-angle asin(1/4).
        let scale = f64::from(SIZE[1]) / 2.0 / (f64::from(FOV_Y_RAD) / 2.0).tan();
        let radius = scale * (0.25f64).asin().tan();
        // Any touched pixel counts, which adds half a pixel all around; the faceted outline is 0.1 % smaller.
        let area = covered(&image) / (PI * (radius + 0.5) * (radius + 0.5));
        assert!((area - 1.0).abs() < 0.005, "{shading:?}: silhouette is {area} of the circle");
        // Faces are 2 degrees wide: flat shades are off by up to a degree, which is 1 of 255 here.
        let bound = if shading == Shading::Smooth { 1.0 } else { 2.0 };
        assert_close(image.pixel(320, 240), clay(Vec3::Z), bound);
        // Half-way up the sphere's image and to the side, where the ray meets the sphere.
        for (dx, dy) in [(0.0, 90.0), (-70.0, -40.0), (100.0, 10.0)] {
            let ray = Vec3::new(dx, dy, -scale as f32).normalize();
            let (eye, b) = (Vec3::new(0.0, 0.0, 4.0), 4.0 * ray.z);
            let n = eye + ray * (-b - (b * b - 15.0).sqrt());
            let at = [(320.0 + dx) as u32, (240.0 - dy) as u32];
            assert_close(image.pixel(at[0], at[1]), clay(n.normalize()), 1.5 * bound);
        }
        for corner in [(0, 0), (639, 0), (0, 479), (639, 479), (320, 20)] {
            assert_eq!(image.pixel(corner.0, corner.1), background());
        }
    }
}

#[test]
fn orthographic_silhouette_is_exact_however_far_the_eye_is() {
    let Some(mut studio) = Studio::open() else { return };
    let mut sphere = icosphere(5).replica(&studio.lattice);
    for distance in [3.0, 1e7] {
        let camera = RenderCamera {
            projection: Projection::Orthographic { height: 3.0 },
            ..looking(DVec3::new(0.6, 0.48, 0.64) * distance, DVec3::ZERO)
        };
        let image = studio.shoot("orthographic", &mut sphere, &camera, &shaded(Shading::Smooth));
        let radius = f64::from(SIZE[1]) / 3.0 + 0.5;
        let area = covered(&image) / (PI * radius * radius);
        assert!((area - 1.0).abs() < 0.005, "silhouette is {area} of the circle");
        assert_close(image.pixel(320, 240), clay(Vec3::Z), 1.0);
    }
}

#[test]
fn creases_are_sharp_and_curves_smooth() {
    let Some(mut studio) = Studio::open() else { return };
    let camera = looking(DVec3::new(2.2, 2.0, 3.0), DVec3::ZERO);
    let flat = studio.shoot_soup("cube-flat", &cube(), &camera, &shaded(Shading::Flat));
    let smooth = studio.shoot_soup("cube-smooth", &cube(), &camera, &shaded(Shading::Smooth));
    // All edges of a cube are creases: both ways of shading agree up to rounding.
    let off = flat.rgba.iter().zip(&smooth.rgba).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(off <= Some(1), "flat and smooth cubes differ by {off:?}");

    // 24 sides meet at 15 degrees: with a crease angle of 45 the side is smooth, the caps flat, the rims sharp.
    let tube = cylinder(24);
    let image = studio.shoot_soup("cylinder-smooth", &tube, &camera, &shaded(Shading::Smooth));
    studio.shoot_soup("cylinder-flat", &tube, &camera, &shaded(Shading::Flat));
    let cap_normal = camera.rotation.inverse() * DVec3::Y;
    let pixel_of = |p: DVec3| {
        let c = camera.rotation.inverse() * (p - camera.eye);
        let scale = 240.0 / (f64::from(FOV_Y_RAD) / 2.0).tan();
        [(320.0 - c.x / c.z * scale) as u32, (240.0 + c.y / c.z * scale) as u32]
    };
    for (x, z) in [(0.0, 0.0), (0.9, 0.0), (0.0, 0.9), (-0.6, -0.6)] {
        let [px, py] = pixel_of(DVec3::new(x, 1.0, z));
        assert_close(image.pixel(px, py), clay(cap_normal.as_vec3()), 1.0);
    }
    for i in 0..12 {
        // Anywhere on the visible side. A chord's points are 1 % inside of the circle, its interpolated normals exact to a
        // fraction of a degree.
        let a = f64::from(i) * 0.11 + 0.1;
        let n = DVec3::new(a.cos(), 0.0, a.sin());
        let [px, py] = pixel_of(n * 0.996 + DVec3::Y * (0.1 * f64::from(i) - 0.7));
        assert_close(image.pixel(px, py), clay((camera.rotation.inverse() * n).as_vec3()), 2.5);
    }
}

#[test]
fn walls_do_not_tilt_floors_where_many_faces_meet() {
    let Some(mut studio) = Studio::open() else { return };
    // The caps are fans of 94 faces around one vertex of the rim, too many to be ordered.
    let camera = RenderCamera {
        projection: Projection::Orthographic { height: 3.0 },
        ..looking(DVec3::new(1.5, 3.0, 2.0), DVec3::ZERO)
    };
    let image = studio.shoot_soup("large-fan", &cylinder(96), &camera, &shaded(Shading::Smooth));
    let cap_normal = (camera.rotation.inverse() * DVec3::Y).as_vec3();
    for i in 0..100 {
        // Spiralling to just inside of the rim, which is 2 % wider.
        let (r, a) = (f64::from(i) / 100.0 * 0.97, f64::from(i) * 2.4);
        let p = DVec3::new(r * a.cos(), 1.0, r * a.sin());
        let c = camera.rotation.inverse() * (p - camera.eye);
        let pixel = image.pixel((320.0 + c.x * 160.0) as u32, (240.0 - c.y * 160.0) as u32);
        assert_close(pixel, clay(cap_normal), 1.0);
    }
}

#[test]
fn vertex_colors_are_srgb() {
    let Some(mut studio) = Studio::open() else { return };
    let color = [200, 90, 30];
    let options = RenderOptions { vertex_colors: true, ..RenderOptions::default() };
    let camera = looking(DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO);
    let image = studio.shoot_soup("color-uniform", &icosphere(4).colored(|_| color), &camera, &options);
    let expected = color.map(|c| srgb_encode(srgb_decode(c) as f32 * key_light(Vec3::Z)));
    assert_close(image.pixel(320, 240), expected, 1.0);
    let rainbow = icosphere(4).colored(|p| (p * 127.0 + 128.0).to_array().map(|x| x as u8));
    studio.shoot_soup("color-rainbow", &rainbow, &looking(DVec3::new(2.0, 1.5, 2.5), DVec3::ZERO), &options);
}

#[test]
fn both_sides_of_an_open_sheet_are_lit() {
    let Some(mut studio) = Studio::open() else { return };
    let flat_sheet = sheet(8, |_, _| 0.0);
    for (name, z) in [("sheet-front", 3.0), ("sheet-back", -3.0)] {
        for shading in [Shading::Flat, Shading::Smooth] {
            let camera = looking(DVec3::new(0.0, 0.0, z), DVec3::ZERO);
            let image = studio.shoot_soup(name, &flat_sheet, &camera, &shaded(shading));
            assert_close(image.pixel(320, 240), clay(Vec3::Z), 1.0);
        }
    }
    // A bowl seen from inside and outside at a slant: no normal may be lit as if it faced away.
    let bowl = sheet(40, |x, y| 0.6 * (x * x + y * y));
    for (name, eye) in [("bowl-inside", DVec3::new(0.5, -1.5, 3.0)), ("bowl-outside", DVec3::new(1.0, -2.5, -2.0))] {
        for shading in [Shading::Flat, Shading::Smooth] {
            let image =
                studio.shoot_soup(&format!("{name}-{shading:?}"), &bowl, &looking(eye, DVec3::ZERO), &shaded(shading));
            assert!(darkest_inside(&image) >= clay(Vec3::NEG_Y)[1] as u8, "{}", darkest_inside(&image));
        }
    }
}

#[test]
fn slivers_and_zero_area_faces_leave_no_marks() {
    let Some(mut studio) = Studio::open() else { return };
    // A plane whose rows of quads alternate between wide and one lattice step or nothing: the thin faces' normals are
    // rounding, pointing anywhere, also backwards.
    let step = studio.lattice.step;
    let mut rng = OperationRng::new(3);
    let n = 41;
    let mut soup = sheet(n, |_, _| 0.0);
    let row = |i: usize| i / (n as usize + 1);
    let origin = DVec3::splat(-2.0);
    let on_lattice = |p: DVec3| ((p - origin) / step).round() * step + origin;
    for i in 0..soup.points.len() {
        if row(i) % 2 == 1 {
            let below = on_lattice(soup.points[i - n as usize - 1]);
            let thickness = f64::from(rng.below(3)) - 1.0;
            let depth = f64::from(rng.below(3)) - 1.0;
            soup.points[i] = below + DVec3::new(0.0, thickness, depth) * step;
        }
    }
    let expected = studio.shoot_soup(
        "slivers-without",
        &sheet(1, |_, _| 0.0),
        &looking(DVec3::new(0.0, 0.0, 2.0), DVec3::ZERO),
        &shaded(Shading::Smooth),
    );
    let image =
        studio.shoot_soup("slivers", &soup, &looking(DVec3::new(0.0, 0.0, 2.0), DVec3::ZERO), &shaded(Shading::Smooth));
    let worst = (100..380)
        .flat_map(|y| (200..440).map(move |x| (x, y)))
        .map(|(x, y)| image.pixel(x, y)[1].abs_diff(expected.pixel(x, y)[1]))
        .max();
    assert!(worst <= Some(3), "slivers show: {worst:?}");
    for (name, eye) in [("slivers-slanted", DVec3::new(1.0, -1.0, 1.0)), ("slivers-close", DVec3::new(0.02, 0.0, 0.05))]
    {
        for shading in [Shading::Flat, Shading::Smooth] {
            let camera = RenderCamera { near: 1e-4, ..looking(eye, DVec3::ZERO) };
            let image = studio.shoot_soup(&format!("{name}-{shading:?}"), &soup, &camera, &shaded(shading));
            assert!(darkest_inside(&image) >= clay(Vec3::NEG_Y)[1] as u8, "{}", darkest_inside(&image));
        }
    }
}

#[test]
fn close_ups_stay_where_they_are() {
    let Some(mut studio) = Studio::open() else { return };
    // A model with survey coordinates: 10 m wide, 5,000 km from its origin, seen from 2 mm away, 21 bits.
    let origin = DVec3::new(5e6, 4e6, 300.0);
    studio.lattice = Lattice::of_box((origin - 5.0).to_array(), (origin + 5.0).to_array(), 21);
    let soup = cube().moved(|p| origin + p);
    let corner = DVec3::from_array(studio.lattice.position(studio.lattice.quantize((origin + 1.0).to_array())));
    let direction = DVec3::new(0.5, 0.6, 0.9).normalize();
    for distance in [8.0, 0.2, 0.002] {
        let camera = RenderCamera { near: distance / 10.0, ..looking(corner + direction * distance, corner) };
        let image = studio.shoot_soup(&format!("survey-{distance}"), &soup, &camera, &shaded(Shading::Smooth));
        // The corner is in the middle; the three faces around it are where they must be.
        for (axis, down) in [(DVec3::X, -1.0), (DVec3::Y, -1.0), (DVec3::Z, -1.0)] {
            let inward = (DVec3::ONE - axis) * down;
            let c = camera.rotation.inverse() * inward;
            let (dx, dy) = (c.x / c.length() * 30.0, -c.y / c.length() * 30.0);
            let pixel = image.pixel((320.0 + dx) as u32, (240.0 + dy) as u32);
            assert_close(pixel, clay((camera.rotation.inverse() * axis).as_vec3()), 1.0);
        }
    }
}

#[test]
fn images_follow_the_replica() {
    let Some(mut studio) = Studio::open() else { return };
    let camera = looking(DVec3::new(1.0, 2.0, 6.0), DVec3::ZERO);
    let options = shaded(Shading::Smooth);
    let mut replica = icosphere(2).replica(&studio.lattice);
    let mut rng = OperationRng::new(5);
    for _ in 0..3 {
        // Random vertices lie in a corner of this lattice; what they look like does not matter here.
        for _ in 0..700 {
            rng.random_split(&mut replica);
        }
        for _ in 0..200 {
            rng.random_collapse(&mut replica);
        }
        let followed = studio.shoot("followed", &mut replica, &camera, &options);
        assert!(studio.offscreen.stats().computed_normals);
        let again = studio.shoot("followed", &mut replica, &camera, &options);
        assert_eq!((studio.offscreen.stats().uploaded_bytes, studio.offscreen.stats().computed_normals), (0, false));
        assert!(followed == again, "the same mesh drawn twice");
        let mut fresh = Studio::open().expect("there was one");
        let mut copy = replica.clone();
        copy.track_dirty();
        let expected = fresh.shoot("fresh", &mut copy, &camera, &options);
        // Sums of floats in another order may round otherwise.
        let off = followed.rgba.iter().zip(&expected.rgba).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(off <= Some(2), "incremental and whole upload differ by {off:?}");
    }
    let mut nothing = Replica::new(&Default::default()).unwrap();
    let empty = studio.shoot("empty", &mut nothing, &camera, &options);
    assert_eq!(covered(&empty), 0.0);
}

#[test]
fn sizes_out_of_range_are_refused_and_odd_ones_drawn() {
    let Some(mut studio) = Studio::open() else { return };
    let mut sphere = icosphere(1).replica(&studio.lattice);
    let camera = RenderCamera { rotation: DQuat::IDENTITY, ..looking(DVec3::Z * 3.0, DVec3::ZERO) };
    for size in [[1, 1], [3, 5], [257, 31], [64, 64]] {
        let options = RenderOptions::default();
        let image = studio.offscreen.render(&mut sphere, &studio.lattice, &camera, size, &options).unwrap();
        assert_eq!(image.rgba.len(), 4 * (size[0] * size[1]) as usize);
        let mut png = Vec::new();
        image.encode_png(&mut png).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(png)).read_info().unwrap();
        let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut rgb).unwrap();
        assert_eq!([info.width, info.height], size);
        assert_eq!(rgb[..3], image.pixel(0, 0));
    }
    for size in [[0, 10], [10, 0], [1 << 20, 10]] {
        let refused = studio.offscreen.render(&mut sphere, &studio.lattice, &camera, size, &RenderOptions::default());
        assert!(matches!(refused, Err(RenderError::ImageSize { .. })), "{size:?}");
    }
}

#[test]
fn a_device_that_is_gone_says_so_and_another_draws_the_same() {
    let (Some(mut first), Some(mut second)) = (Studio::open(), Studio::open()) else { return };
    let mut sphere = icosphere(4).replica(&first.lattice);
    let camera = looking(DVec3::new(3.0, 1.0, 2.0), DVec3::ZERO);
    let before = first.shoot("device", &mut sphere, &camera, &RenderOptions::default());
    assert!(!first.offscreen.gpu().is_lost());
    first.offscreen.gpu().device.destroy();
    // The word of it comes with the next look at the device.
    let _ = first.offscreen.gpu().device.poll(wgpu::PollType::wait_indefinitely());
    assert!(first.offscreen.gpu().is_lost() && !second.offscreen.gpu().is_lost());
    sphere.track_dirty();
    assert!(second.shoot("device", &mut sphere, &camera, &RenderOptions::default()) == before);
}
