use glam::DVec3;
use glam::dcamera::rh::proj::directx;

use super::*;

/// A picture whose pixels are units of x and y, y up, seen from +z.
fn flat_view(width: u32, height: u32) -> RasterOptions {
    let view_projection = directx::orthographic(0.0, f64::from(width), 0.0, f64::from(height), -10.0, 10.0);
    RasterOptions { width, height, view_projection, smooth: false, two_sided: false }
}

fn subject<'a>(positions: &'a [[f64; 3]], faces: &'a [[u32; 3]]) -> Subject<'a> {
    Subject { positions, faces, colors: None }
}

#[test]
fn shared_edges_are_filled_once() {
    // A fan around a point on a pixel centre: each pixel belongs to one face, whatever the order.
    let mut positions = vec![[10.5, 10.5, 0.0]];
    positions.extend([[20.0, 1.0, 0.0], [20.0, 20.0, 0.0], [10.5, 20.0, 0.0], [1.0, 20.0, 0.0], [1.0, 1.0, 0.0]]);
    let faces = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5], [0, 5, 1]];
    let each: usize =
        faces.iter().map(|f| render(&subject(&positions, &[*f]), &flat_view(21, 21)).covered_pixels()).sum();
    let image = render(&subject(&positions, &faces), &flat_view(21, 21));
    assert_eq!(image.covered_pixels(), 19 * 19);
    assert_eq!(each, 19 * 19);
}

#[test]
fn top_left_edges_own_their_pixel_centres() {
    // The square from pixel centre to pixel centre: left column and top row are in, right and bottom are out.
    let positions = [[1.5, 1.5, 0.0], [3.5, 1.5, 0.0], [3.5, 3.5, 0.0], [1.5, 3.5, 0.0]];
    let image = render(&subject(&positions, &[[0, 1, 2], [0, 2, 3]]), &flat_view(5, 5));
    // Row 0 is the top: y = 3.5 is row 1.
    for (x, y, covered) in [(1, 1, true), (2, 2, true), (3, 1, false), (1, 3, false), (0, 1, false)] {
        assert_eq!(image.hit(x, y).is_some(), covered, "({x}, {y})");
    }
    assert_eq!(image.covered_pixels(), 4);
}

#[test]
fn nearest_face_wins_and_back_faces_are_culled() {
    let positions =
        [[0.0, 0.0, 0.0], [8.0, 0.0, 0.0], [0.0, 8.0, 0.0], [0.0, 0.0, 5.0], [8.0, 0.0, 5.0], [0.0, 8.0, 5.0]];
    let image = render(&subject(&positions, &[[0, 1, 2], [3, 4, 5]]), &flat_view(8, 8));
    assert_eq!(image.hit(1, 6).map(|h| h.face), Some(1));
    let away = render(&subject(&positions, &[[0, 2, 1]]), &flat_view(8, 8));
    assert_eq!(away.covered_pixels(), 0);
    let both = render(&subject(&positions, &[[0, 2, 1]]), &RasterOptions { two_sided: true, ..flat_view(8, 8) });
    let front = render(&subject(&positions, &[[0, 1, 2]]), &flat_view(8, 8));
    assert_eq!(compare(&both, &front).max, 0);
    assert_eq!(compare(&both, &front).silhouette_pixels, 0);
}

#[test]
fn near_plane_cuts_and_depth_is_that_of_the_plane() {
    // A floor one unit below the eye that runs from behind it to the horizon.
    let positions = [[-50.0, -1.0, 50.0], [50.0, -1.0, 50.0], [50.0, -1.0, -50.0], [-50.0, -1.0, -50.0]];
    let view_projection = directx::perspective(1.2, 1.0, 0.1, 100.0);
    let options = RasterOptions { width: 64, height: 64, view_projection, smooth: false, two_sided: false };
    let image = render(&subject(&positions, &[[0, 1, 2], [0, 2, 3]]), &options);
    for y in 36..64 {
        let hit = image.hit(32, y).unwrap_or_else(|| panic!("row {y} is empty"));
        // Ray through the pixel centre meets y = -1 at this distance in front.
        let slope = (f64::from(y) + 0.5 - 32.0) / 32.0 * 0.6f64.tan();
        let at = view_projection * DVec3::new(0.0, -1.0, -1.0 / slope).extend(1.0);
        assert!((hit.depth - at.z / at.w).abs() < 1e-3, "row {y}: {} {}", hit.depth, at.z / at.w);
    }
    assert_eq!(image.hit(32, 30), None);
}

#[test]
fn colours_are_interpolated_in_linear_light_and_lit() {
    let positions = [[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 9.0, 0.0]];
    let colors = [[255, 0, 0], [255, 0, 0], [255, 0, 0]];
    let subject = Subject { positions: &positions, faces: &[[0, 1, 2]], colors: Some(&colors) };
    let options = flat_view(9, 9);
    let image = render(&subject, &options);
    let light = Light::of_camera(options.view_projection);
    assert!((light.key - DVec3::new(0.3, 0.4, 1.0).normalize()).length() < 1e-12);
    let lit = 0.25 * 0.5 + 0.75 * light.key.z;
    assert_eq!(image.rgb(2, 6), [encode_srgb(lit), 0, 0]);
    assert_eq!(image.rgb(8, 0), BACKGROUND);
    assert!((0..=255).all(|c| encode_srgb(decode_srgb(c)) == c));
}

#[test]
fn broken_faces_draw_nothing() {
    let positions = [[0.0, 0.0, 0.0], [9.0, f64::NAN, 0.0], [0.0, 9.0, 0.0], [9.0, 9.0, 0.0]];
    let image = render(&subject(&positions, &[[0, 1, 2], [0, 0, 2], [0, 7, 2]]), &flat_view(9, 9));
    assert_eq!(image.covered_pixels(), 0);
}

#[test]
fn difference_counts_pixels_and_silhouette() {
    let positions = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [4.0, 4.0, 0.0], [0.0, 4.0, 0.0]];
    let image = render(&subject(&positions, &[[0, 1, 2], [0, 2, 3]]), &flat_view(8, 4));
    let difference = compare(&image, &Image::blank(8, 4));
    assert_eq!(difference.silhouette_pixels, 16);
    assert_eq!(difference.share_over(0), 0.5);
    assert_eq!(difference.share_over(255), 0.0);
    assert!(difference.mean > 0.0 && difference.mean <= f64::from(difference.max));
}

#[test]
fn png_keeps_the_picture() {
    let positions = [[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 9.0, 0.0]];
    let image = render(&subject(&positions, &[[0, 1, 2]]), &flat_view(9, 9));
    let path = std::env::temp_dir().join(format!("lodestream-raster-{}.png", std::process::id()));
    image.write_png(&path).unwrap();
    let read = Image::read_png(&path).unwrap();
    std::fs::remove_file(&path).unwrap();
    let difference = compare(&image, &read);
    assert_eq!((difference.max, difference.silhouette_pixels), (0, 0));
}
