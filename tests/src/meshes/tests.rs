use glam::DVec3;
use lodestream_server::mesh::TriMesh;

use super::*;

/// Vertices, faces, boundary loops, components, genus.
fn check(name: &str, mesh: &TriMesh, expected: (usize, usize, usize, usize, i64)) {
    let t = topology(mesh).unwrap_or_else(|defect| panic!("{name}: {defect}"));
    assert_eq!((t.vertices, t.faces, t.boundary_loops, t.components, t.genus()), expected, "{name}");
    assert_eq!(mesh.positions.len(), t.vertices, "{name} has unused vertices");
    assert!(mesh.positions.iter().flatten().all(|c| c.is_finite()), "{name}");
}

/// Six times the enclosed volume; positive when closed faces turn outward.
fn volume(mesh: &TriMesh) -> f64 {
    let p = |v: u32| DVec3::from_array(mesh.positions[v as usize]);
    mesh.faces.iter().map(|&[a, b, c]| p(a).dot(p(b).cross(p(c)))).sum()
}

#[test]
fn shapes_have_the_documented_topology() {
    check("empty", &empty(), (0, 0, 0, 0, 0));
    check("single_triangle", &single_triangle(), (3, 1, 1, 1, 0));
    check("tetrahedron", &tetrahedron(), (4, 4, 0, 1, 0));
    check("cube", &cube(), (8, 12, 0, 1, 0));
    check("grid", &grid(7, 4), (40, 56, 1, 1, 0));
    check("grid_with_holes", &grid_with_holes(3, 2), (15 * 15 - 9, 2 * 4 * 40, 10, 1, 0));
    check("disk", &disk(9, 4), (37, 63, 1, 1, 0));
    check("smallest disk", &disk(3, 1), (4, 3, 1, 1, 0));
    check("annulus", &annulus(11, 3), (44, 66, 2, 1, 0));
    check("cylinder_open", &cylinder_open(8, 5), (48, 80, 2, 1, 0));
    check("torus", &torus(12, 7), (84, 168, 0, 1, 1));
    for level in 0..4 {
        let faces = 20 * 4usize.pow(level);
        check("icosphere", &icosphere(level), (faces / 2 + 2, faces, 0, 1, 0));
    }
    check("sphere", &sphere(7), (492, 980, 0, 1, 0));
    for (n, r) in [(0, 1), (1, 1), (2, 4), (5, 2)] {
        let faces = (4 * r * r * (9 * n + 7)) as usize;
        check("genus", &genus(n, r), (faces / 2 + 2 - 2 * n as usize, faces, 0, 1, i64::from(n)));
    }
    assert_eq!(double_torus(3), genus(2, 3));
}

#[test]
fn special_meshes_have_the_documented_topology() {
    let spheres = noisy_sphere(5_000, 3);
    check("noisy_sphere", &spheres, (2562, 5120, 0, 1, 0));
    check("colored_sphere", &colored_sphere(2), (162, 320, 0, 1, 0));
    check("painted_plane", &painted_plane(20), (441, 800, 1, 1, 0));
    check("sliver_strip", &sliver_strip(30), (62, 60, 1, 1, 0));
    check("with_zero_area_faces", &with_zero_area_faces(5), (642, 1280, 0, 1, 0));
    check("crack", &crack(), (50, 64, 2, 2, 0));
    let pieces = many_components(40, 9);
    let t = topology(&pieces).expect("clean");
    assert_eq!((t.components, t.genus()), (40, 0));
}

#[test]
fn faces_turn_outward_or_up() {
    for closed in [tetrahedron(), cube(), icosphere(2), torus(16, 8), genus(2, 2), noisy_sphere(2_000, 1)] {
        assert!(volume(&closed) > 0.0);
    }
    for flat in [grid(3, 3), grid_with_holes(1, 2), disk(8, 3), annulus(8, 2), painted_plane(4), sliver_strip(4)] {
        for &[a, b, c] in &flat.faces {
            let [a, b, c] = [a, b, c].map(|v| DVec3::from_array(flat.positions[v as usize]));
            assert!((b - a).cross(c - a).y > 0.0);
        }
    }
    let cylinder = cylinder_open(12, 3);
    for &[a, b, c] in &cylinder.faces {
        let [a, b, c] = [a, b, c].map(|v| DVec3::from_array(cylinder.positions[v as usize]));
        assert!((b - a).cross(c - a).dot((a + b + c) * DVec3::new(1.0, 0.0, 1.0)) > 0.0);
    }
}

#[test]
fn unclean_meshes_are_unclean_in_the_documented_way() {
    assert!(defect(&bow_tie()).is_some_and(|d| d.contains("vertex 0")));
    assert!(defect(&three_on_an_edge()).is_some_and(|d| d.contains("0 -> 1")));
    assert!(defect(&moebius()).is_some_and(|d| d.contains("twice")));
    assert_eq!((moebius().positions.len(), moebius().faces.len()), (48, 48));
}

#[test]
fn zero_area_and_slivers_are_there() {
    let mesh = with_zero_area_faces(1);
    let area = |mesh: &TriMesh, [a, b, c]: [u32; 3]| {
        let [a, b, c] = [a, b, c].map(|v| DVec3::from_array(mesh.positions[v as usize]));
        (b - a).cross(c - a).length() * 0.5
    };
    assert!(mesh.faces.iter().filter(|f| area(&mesh, **f) == 0.0).count() >= 20);
    let strip = sliver_strip(5);
    assert!(strip.faces.iter().all(|f| area(&strip, *f) < 1e-3));
}

#[test]
fn seeds_repeat_and_differ() {
    assert_eq!(many_components(10, 1), many_components(10, 1));
    assert_ne!(many_components(10, 1), many_components(10, 2));
    assert_eq!(noisy_sphere(500, 1), noisy_sphere(500, 1));
    assert_ne!(noisy_sphere(500, 1), noisy_sphere(500, 2));
    assert_ne!(with_zero_area_faces(1), with_zero_area_faces(2));
}
