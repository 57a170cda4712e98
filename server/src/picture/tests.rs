//! What thumbnails must hold; how they look was looked at.

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

fn decode(png: &[u8]) -> (u32, u32, Vec<u8>) {
    let mut reader = png::Decoder::new(std::io::Cursor::new(png)).read_info().unwrap();
    let mut rgba = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut rgba).unwrap();
    if info.color_type == png::ColorType::GrayscaleAlpha {
        rgba = rgba.chunks_exact(2).flat_map(|pixel| [pixel[0], pixel[0], pixel[0], pixel[1]]).collect();
    }
    (info.width, info.height, rgba)
}

#[test]
fn a_sphere_fills_the_height_and_is_brighter_above() {
    let (width, height, rgba) = decode(&draw(&sphere(60, None), false));
    assert_eq!([width, height], THUMBNAIL_SIZE);
    let pixel = |x: u32, y: u32| -> [u8; 4] { rgba[4 * (y * width + x) as usize..][..4].try_into().unwrap() };
    let covered: Vec<bool> = rgba.chunks_exact(4).map(|p| p[3] == 255).collect();
    let share = covered.iter().filter(|&&c| c).count() as f64 / covered.len() as f64;
    // A disk of 92 % of the height.
    let disk = std::f64::consts::PI * (0.46f64 * 240.0).powi(2) / (320.0 * 240.0);
    assert!((share - disk).abs() < 0.02, "{share} against {disk}");
    assert_eq!(pixel(0, 0)[3], 0);
    assert!(pixel(180, 80)[1] > pixel(150, 200)[1] + 20, "{:?} {:?}", pixel(180, 80), pixel(150, 200));
    assert_eq!(draw(&sphere(60, None), false), draw(&sphere(60, None), false));
}

#[test]
fn what_faces_away_is_drawn_for_open_surfaces_only() {
    let mut inside_out = sphere(20, None);
    inside_out.faces.iter_mut().for_each(|face| face.swap(1, 2));
    inside_out.faces.retain(|face| face.iter().all(|&v| inside_out.positions[v as usize][2] > 0.0));
    let covered = |is_open| decode(&draw(&inside_out, is_open)).2.chunks_exact(4).filter(|p| p[3] > 0).count();
    assert!(covered(true) > 3 * covered(false), "{} {}", covered(true), covered(false));
}

#[test]
fn noise_is_coarsened_until_it_fits() {
    let mut random = fastrand::Rng::with_seed(1);
    let colors: Vec<[u8; 3]> = (0..200_000).map(|_| [random.u8(..), random.u8(..), random.u8(..)]).collect();
    let png = draw(&sphere(200, Some(&|v| colors[v as usize])), false);
    assert!(png.len() <= MAX_THUMBNAIL_BYTES, "{}", png.len());
    let (width, height, rgba) = decode(&png);
    assert!(width >= 80 && width * 3 == height * 4, "{width} x {height}");
    assert!(rgba.chunks_exact(4).any(|p| p[0].abs_diff(p[1]) > 15), "colours are left");
}

#[test]
fn empty_flat_and_tiny_meshes_give_pictures() {
    let (_, _, rgba) = decode(&draw(&TriMesh::default(), false));
    assert!(rgba.iter().all(|&byte| byte == 0));
    let at = |positions: Vec<[f64; 3]>| TriMesh { positions, faces: vec![[0, 1, 2]], ..TriMesh::default() };
    decode(&draw(&at(vec![[3.0; 3]; 3]), true));
    let (_, _, rgba) = decode(&draw(&at(vec![[1e9, 0.0, 0.0], [1e9, 0.0, 1e-3], [1e9, 1e-3, 0.0]]), true));
    assert!(rgba.chunks_exact(4).any(|p| p[3] == 255));
}
