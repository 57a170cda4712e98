//! What is exported reads back as it was.

use super::*;
use crate::mesh::export::{PlyCoordinates, PlyOptions, write_obj, write_ply};

/// Enough vertices for several pieces of output.
fn sample() -> TriMesh {
    let mut random = fastrand::Rng::with_seed(1);
    let vertices = 5000_u32;
    TriMesh {
        positions: (0..vertices).map(|_| std::array::from_fn(|_| (random.f64() - 0.5) * 1e7)).collect(),
        faces: (2..vertices).map(|v| [v - 2, v - 1, v]).collect(),
        colors: Some((0..vertices).map(|v| [v as u8, (v / 3) as u8, 255 - v as u8]).collect()),
    }
}

#[test]
fn ply_and_obj_keep_every_bit() {
    for mesh in [sample(), TriMesh { colors: None, ..sample() }] {
        let mut ply = Vec::new();
        let options = PlyOptions { comments: vec!["two\nlines".into()], ..PlyOptions::default() };
        write_ply(&mesh, &options, &mut ply).unwrap();
        assert_eq!(read_ply(&ply).unwrap().0, mesh);
        let mut obj = Vec::new();
        write_obj(&mesh, &mut obj).unwrap();
        assert_eq!(read_obj(&obj).unwrap().0, mesh);
    }
}

#[test]
fn ply_of_floats_rounds() {
    let mesh = sample();
    let mut ply = Vec::new();
    let options = PlyOptions { coordinates: PlyCoordinates::Float32, ..PlyOptions::default() };
    write_ply(&mesh, &options, &mut ply).unwrap();
    let (back, _) = read_ply(&ply).unwrap();
    let rounded: Vec<_> = mesh.positions.iter().map(|p| p.map(|c| f64::from(c as f32))).collect();
    assert_eq!(back.positions, rounded);
    assert_eq!((back.faces, back.colors), (mesh.faces, mesh.colors));
}
