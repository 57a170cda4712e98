//! What thumbnails must hold; how they look was looked at.

use glam::dcamera::rh::{proj::directx, view};

use super::*;

/// A sphere with a given function for its colours, by latitude and longitude.
fn sphere(rings: u32, color: Option<&dyn Fn(u32) -> [u8; 3]>) -> TriMesh {
    let mut mesh = TriMesh::default();
    for ring in 0..=rings {
        for k in 0..2 * rings {
            let y = 2.0 * f64::from(ring) / f64::from(rings) - 1.0;
            let angle = std::f64::consts::PI * f64::from(k) / f64::from(rings);
            let r = (1.0 - y * y).sqrt();
            mesh.positions.push([r * angle.sin(), y, r * angle.cos()]);
        }
    }
    for ring in 0..rings {
        for k in 0..2 * rings {
            let at = |ring: u32, k: u32| ring * 2 * rings + k % (2 * rings);
            let [a, b, c, d] = [at(ring, k), at(ring, k + 1), at(ring + 1, k + 1), at(ring + 1, k)];
            mesh.faces.extend([[a, b, c], [a, c, d]]);
        }
    }
    mesh.colors = color.map(|color| (0..mesh.positions.len() as u32).map(color).collect());
    mesh
}

/// The ball around the box of the sphere.
const BALL: ([f64; 3], f64) = ([0.0; 3], 1.732_050_807_568_877_2);

fn decode(png: &[u8]) -> (u32, u32, Vec<u8>) {
    let mut decoder = png::Decoder::new(std::io::Cursor::new(png));
    decoder.set_transformations(png::Transformations::EXPAND);
    let mut reader = decoder.read_info().unwrap();
    let mut rgba = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut rgba).unwrap();
    if info.color_type == png::ColorType::GrayscaleAlpha {
        rgba = rgba.chunks_exact(2).flat_map(|pixel| [pixel[0], pixel[0], pixel[0], pixel[1]]).collect();
    }
    (info.width, info.height, rgba)
}

#[test]
fn a_sphere_fills_the_height_and_is_brighter_above() {
    let (width, height, rgba) = decode(&draw(&sphere(60, None), BALL, false));
    assert_eq!([width, height], THUMBNAIL_SIZE);
    let pixel = |x: u32, y: u32| -> [u8; 4] { rgba[4 * (y * width + x) as usize..][..4].try_into().unwrap() };
    let covered: Vec<bool> = rgba.chunks_exact(4).map(|p| p[3] == 255).collect();
    let share = covered.iter().filter(|&&c| c).count() as f64 / covered.len() as f64;
    // A disk of 92 % of the height.
    let disk = std::f64::consts::PI * (0.46f64 * 240.0).powi(2) / (320.0 * 240.0);
    assert!((share - disk).abs() < 0.02, "{share} against {disk}");
    assert_eq!(pixel(0, 0)[3], 0);
    assert!(pixel(180, 80)[1] > pixel(150, 200)[1] + 20, "{:?} {:?}", pixel(180, 80), pixel(150, 200));
    assert_eq!(draw(&sphere(60, None), BALL, false), draw(&sphere(60, None), BALL, false));
}

#[test]
fn what_faces_away_is_drawn_for_open_surfaces_only() {
    let mut inside_out = sphere(20, None);
    inside_out.faces.iter_mut().for_each(|face| face.swap(1, 2));
    inside_out.faces.retain(|face| face.iter().all(|&v| inside_out.positions[v as usize][2] > 0.0));
    let covered = |is_open| decode(&draw(&inside_out, BALL, is_open)).2.chunks_exact(4).filter(|p| p[3] > 0).count();
    assert!(covered(true) > 3 * covered(false), "{} {}", covered(true), covered(false));
}

#[test]
fn noise_is_coarsened_until_it_fits() {
    let mut random = fastrand::Rng::with_seed(1);
    let colors: Vec<[u8; 3]> = (0..200_000).map(|_| [random.u8(..), random.u8(..), random.u8(..)]).collect();
    let png = draw(&sphere(200, Some(&|v| colors[v as usize])), BALL, false);
    assert!(png.len() <= MAX_THUMBNAIL_BYTES, "{}", png.len());
    let (width, height, rgba) = decode(&png);
    assert!(width >= 80 && width * 3 == height * 4, "{width} x {height}");
    assert!(rgba.chunks_exact(4).any(|p| p[0].abs_diff(p[1]) > 15), "colours are left");
}

#[test]
fn empty_flat_and_tiny_meshes_give_pictures() {
    let (_, _, rgba) = decode(&draw(&TriMesh::default(), BALL, false));
    assert!(rgba.iter().all(|&byte| byte == 0));
    let at = |positions: Vec<[f64; 3]>| TriMesh { positions, faces: vec![[0, 1, 2]], ..TriMesh::default() };
    decode(&draw(&at(vec![[3.0; 3]; 3]), ([3.0; 3], 1.0), true));
    let sliver = at(vec![[1e9, 0.0, 0.0], [1e9, 0.0, 1e-3], [1e9, 1e-3, 0.0]]);
    let (_, _, rgba) = decode(&draw(&sliver, ([1e9, 5e-4, 5e-4], 7.1e-4), true));
    assert!(rgba.chunks_exact(4).any(|p| p[3] == 255));
}

#[test]
fn a_picture_says_where_it_lies_in_the_first_view() {
    // Small triangles here and there in a ball, and the matrices of a viewer: 45 degrees, the ball within them.
    let (center, radius) = (DVec3::new(10.0, -2.0, 5.0), 3.0);
    let direction = DVec3::new(0.35, 0.25, 1.0).normalize();
    let eye = center + direction * (radius / (std::f64::consts::FRAC_PI_8).sin());
    let to_clip =
        directx::perspective(std::f64::consts::FRAC_PI_4, 1.0, 1.0, 100.0) * view::look_at_mat4(eye, center, DVec3::Y);
    let right = DVec3::Y.cross(direction).normalize();
    let spots =
        [[1.5, 0.2, 0.4], [-1.2, 1.9, 0.3], [0.1, -1.7, 1.1], [0.4, 0.9, -1.4]].map(|p| center + DVec3::from_array(p));
    let mut mesh = TriMesh::default();
    for spot in spots {
        let first = mesh.positions.len() as u32;
        let up = direction.cross(right);
        mesh.positions.extend([-right - up, right - up, up].map(|p| (spot + p * 0.06).to_array()));
        mesh.faces.push([first, first + 1, first + 2]);
    }
    let png = draw(&mesh, (center.to_array(), radius), false);
    let Window { left, top, width, height } = window(&png).unwrap();
    assert!((width * 3.0 - height * 4.0).abs() < 1e-4);
    let (columns, rows, rgba) = decode(&png);
    for spot in spots {
        let clip = to_clip.project_point3(spot);
        let [x, y] = [(0.5 + 0.5 * clip.x - left) / width, (0.5 - 0.5 * clip.y - top) / height];
        let at = (y * f64::from(rows)) as u32 * columns + (x * f64::from(columns)) as u32;
        assert_eq!(rgba[4 * at as usize + 3], 255, "{x} {y}");
    }
    let covered = rgba.chunks_exact(4).filter(|pixel| pixel[3] > 0).count();
    assert!(covered < 1500, "{covered}: the spots are small");
}

#[test]
fn other_pictures_say_nothing() {
    let png = draw(&sphere(9, None), BALL, false);
    assert!(window(&png).is_some());
    for len in [0, 8, 20, 100] {
        assert_eq!(window(&png[..len]), None);
    }
    assert_eq!(window(&draw(&TriMesh::default(), BALL, false)), None, "nothing is shown");
    for text in ["", "0 0 1", "0 0 1 1 1", "0 0 0 1", "0 0 1 -1", "a b c d", "NaN 0 1 1", "0 0 1 inf", "11 0 1 1"] {
        assert_eq!(Window::from_text(text), None, "{text}");
    }
    let window = Window { left: -0.25, top: 0.125, width: 1.5, height: 1.125 };
    assert_eq!(Window::from_text(&window.to_text()), Some(window));
}

#[test]
fn clay_has_the_viewers_shades_and_takes_one_byte_a_pixel() {
    let png = draw(&sphere(60, None), BALL, false);
    let reader = png::Decoder::new(std::io::Cursor::new(&png)).read_info().unwrap();
    assert_eq!(reader.info().color_type, png::ColorType::Indexed);
    let (width, height, rgba) = decode(&png);
    // The middle of the sphere looks at the eye: light of (0.3, 0.4, 1), length 1.118, and a quarter of the up axis's share.
    let middle = &rgba[4 * (height / 2 * width + width / 2) as usize..][..4];
    let light = 0.25 * 0.75 + 0.75 / 1.118;
    for (channel, base) in middle.iter().zip([0.80, 0.78, 0.74]) {
        let linear: f64 = base * light;
        let expected = 255.0 * (1.055 * linear.powf(1.0 / 2.4) - 0.055);
        assert!((f64::from(*channel) - expected).abs() < 3.0, "{middle:?}: {expected}");
    }
}
