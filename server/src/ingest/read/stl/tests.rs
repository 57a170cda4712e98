use super::super::read_stl;
use super::*;
use crate::mesh::TriMesh;
use crate::mesh::export::write_stl;

fn tetrahedron() -> TriMesh {
    TriMesh {
        positions: vec![[0.0; 3], [2.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, -1.5]],
        faces: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]],
        colors: None,
    }
}

fn binary() -> Vec<u8> {
    let mut bytes = Vec::new();
    write_stl(&tetrahedron(), &mut bytes).unwrap();
    bytes
}

fn text() -> String {
    let mut text = String::from("solid made by hand\n");
    let mesh = tetrahedron();
    for face in &mesh.faces {
        text += " facet normal 0 0 0\n  outer loop\n";
        for &corner in face {
            let [x, y, z] = mesh.positions[corner as usize];
            text += &format!("   vertex {x} {y:e} {z}\r\n");
        }
        text += "  endloop\n endfacet\n";
    }
    text + "endsolid made by hand\n"
}

/// Corners of all triangles.
fn soup(mesh: &TriMesh) -> Vec<[[f64; 3]; 3]> {
    mesh.faces.iter().map(|face| face.map(|corner| mesh.positions[corner as usize])).collect()
}

#[test]
fn both_encodings_give_the_same_triangles() {
    for (bytes, format) in [(binary(), Format::StlBinary), (text().into_bytes(), Format::StlAscii)] {
        let (mesh, report) = read_stl(&bytes).unwrap();
        assert_eq!(soup(&mesh), soup(&tetrahedron()));
        assert_eq!((report.format, report.vertices, report.faces, report.triangles), (format, 12, 4, 4));
        assert!(report.not_carried.is_empty() && !report.colored);
    }
}

#[test]
fn solid_at_the_start_does_not_make_a_text() {
    let mut bytes = binary();
    bytes[..12].copy_from_slice(b"solid binary");
    let (mesh, report) = read_stl(&bytes).unwrap();
    assert_eq!((soup(&mesh), report.format), (soup(&tetrahedron()), Format::StlBinary));
}

#[test]
fn what_is_left_is_reported() {
    let mut bytes = binary();
    bytes[84 + 48] = 1;
    bytes.push(0);
    assert_eq!(
        read_stl(&bytes).unwrap().1.not_carried,
        ["1 triangles with an attribute", "1 bytes after the last triangle"]
    );
    bytes[..6].copy_from_slice(b"COLOR=");
    assert_eq!(read_stl(&bytes).unwrap().1.not_carried[0], "1 colours of triangles");
}

#[test]
fn errors_name_the_place() {
    let check = |bytes: &[u8], expected: &str| assert_eq!(read_stl(bytes).unwrap_err().to_string(), expected);
    let whole = binary();
    check(&whole[..200], "4 rows of element triangle need at least 200 bytes, but only 116 follow");
    check(&whole[..50], "byte 50: the header of a binary STL takes 84 bytes, and a text starts with `solid`");
    check(b"solid", "the file holds no faces (it has 0 vertices; point clouds cannot be ingested)");
    check(text().replace("-1.5", "x").as_bytes(), "line 13: vertex coordinate `x` is not a number");
    check(b"solid a\nvertex 1 2 3", "line 2: a vertex outside of a loop");
    check(b"solid a\nouter loop\nouter loop", "line 3: a loop within a loop");
    check(b"solid a\nouter loop\nvertex 0 0 0\nfacet", "line 4: the file ends within a loop");
    check(b"solid a\nouter loop\nfrob", "line 3: `frob` is not a vertex of the loop");
    check(b"solid a\nendloop", "line 2: the end of a loop that did not begin");
}
