use std::collections::HashMap;

use glam::DVec3;

use super::contour::{Contour, Lattice};
use super::{SampleOptions, generate, generate_with};
use crate::mesh::TriMesh;

/// Closed, each directed edge once, each vertex one fan.
fn assert_closed_manifold(faces: &[[u32; 3]], vertices: usize) {
    let mut next = HashMap::new();
    let mut degree = vec![0usize; vertices];
    for &[a, b, c] in faces {
        for (u, v, w) in [(a, b, c), (b, c, a), (c, a, b)] {
            assert!(next.insert((u, v), w).is_none(), "edge {u} -> {v} twice");
            degree[u as usize] += 1;
        }
    }
    let mut any = vec![None; vertices];
    for &(u, v) in next.keys() {
        assert!(next.contains_key(&(v, u)), "edge {u} -> {v} is open");
        any[u as usize] = Some(v);
    }
    for (v, &faces_around) in degree.iter().enumerate() {
        let first = any[v].expect("every vertex has a face");
        let (mut at, mut steps) = (first, 0);
        loop {
            at = next[&(v as u32, at)];
            steps += 1;
            if at == first {
                break;
            }
        }
        assert_eq!(steps, faces_around, "vertex {v} has two fans");
    }
}

fn assert_count(mesh: &TriMesh, wanted: usize) {
    let miss = mesh.faces.len() as f64 / wanted as f64 - 1.0;
    assert!(miss.abs() < 0.01, "{} triangles instead of {wanted}", mesh.faces.len());
}

#[test]
fn any_signs_give_a_manifold() {
    // White noise on the lattice meets every case beside every other; the border is outside.
    for seed in 0..6 {
        let lattice = Lattice::covering(DVec3::ZERO, DVec3::splat(40.0), 1.0);
        let field = |p: DVec3| {
            let inside = p.min_element() > 0.5 && p.max_element() < 12.5;
            let bits = super::math::hash(p.x as i64, p.y as i64, p.z as i64, seed);
            let density = 0.3 + 0.08 * f64::from(seed);
            if inside && super::math::unit(bits) < density { -0.3 - super::math::unit(bits >> 10) } else { 0.7 }
        };
        let mesh = Contour::scan(lattice, &field, 2).build(&field);
        assert!(mesh.quads.len() > 1_000);
        let faces: Vec<_> = mesh.quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        assert_closed_manifold(&faces, mesh.positions.len());
    }
}

#[test]
fn surface_is_followed_where_the_skip_test_fails() {
    // The field claims to be far from zero on one side, so that all of that side is skipped.
    let field = |p: DVec3| {
        let d = (p - DVec3::splat(32.0)).length() - 20.0;
        if p.x > 40.0 { d * 50.0 } else { d }
    };
    let mesh = Contour::scan(Lattice::covering(DVec3::ZERO, DVec3::splat(63.0), 1.0), &field, 1).build(&field);
    let faces: Vec<_> = mesh.quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
    assert_closed_manifold(&faces, mesh.positions.len());
    assert!(mesh.positions.iter().any(|p| p[0] > 51.0), "the far side is missing");
}

#[test]
fn sample_is_a_closed_manifold_of_the_wanted_size() {
    for (wanted, seed) in [(1_000, 0), (5_000, 1), (60_000, 2), (150_000, 0)] {
        let mesh = generate(wanted, seed);
        assert_count(&mesh, wanted);
        assert_closed_manifold(&mesh.faces, mesh.positions.len());
        assert_eq!(mesh.colors.as_ref().map(Vec::len), Some(mesh.positions.len()));
        let (lo, hi) = mesh.bounding_box().expect("not empty");
        assert!(lo.iter().chain(&hi).all(|c| c.abs() < 1.6), "{lo:?} {hi:?}");
    }
}

#[test]
fn same_options_give_the_same_mesh() {
    let options = SampleOptions { triangles: 20_000, seed: 7, noise: 0.2 };
    let mesh = generate_with(&options);
    assert_eq!(mesh, generate_with(&options));
    assert_ne!(mesh.positions, generate_with(&SampleOptions { seed: 8, ..options }).positions);
    let clean = generate_with(&SampleOptions { noise: 0.0, ..options });
    assert_eq!(mesh.faces.len(), clean.faces.len());
    let moved = |a: &[f64; 3], b: &[f64; 3]| (DVec3::from_array(*a) - DVec3::from_array(*b)).length_squared();
    let sum: f64 = mesh.positions.iter().zip(&clean.positions).map(|(a, b)| moved(a, b)).sum();
    let deviation = (sum / mesh.positions.len() as f64).sqrt();
    assert!((0.001..0.02).contains(&deviation), "{deviation}");
}

#[test]
fn triangles_are_even_in_shape_and_size() {
    let mesh = generate(100_000, 0);
    let mut areas = Vec::new();
    let mut slivers = 0;
    for face in &mesh.faces {
        let [a, b, c] = face.map(|v| DVec3::from_array(mesh.positions[v as usize]));
        let area = 0.5 * (b - a).cross(c - a).length();
        // 1 for an equilateral triangle, 0 for one of no area.
        let squares = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
        slivers += usize::from(4.0 * 3f64.sqrt() * area / squares < 0.3);
        areas.push(area);
    }
    areas.sort_unstable_by(f64::total_cmp);
    let at = |share: f64| areas[(share * areas.len() as f64) as usize];
    let spread = at(0.95) / at(0.05);
    assert!(spread < 5.0, "areas differ by a factor of {spread}");
    assert!(slivers * 50 < areas.len(), "{slivers} slivers of {}", areas.len());
}
