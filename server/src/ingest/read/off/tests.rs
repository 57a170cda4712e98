use super::super::read_off;
use super::*;
use crate::mesh::TriMesh;

fn check(text: &str, faces: &[[u32; 3]]) -> (TriMesh, ReadReport) {
    let (mesh, report) = read_off(text.as_bytes()).unwrap();
    assert_eq!(mesh.faces, faces, "{text}");
    assert_eq!((report.format, report.triangles), (Format::OffAscii, faces.len() as u64));
    (mesh, report)
}

const SQUARE: &str = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n";

#[test]
fn headers_of_every_kind_are_read() {
    for head in ["OFF\n4 1 0\n", "OFF 4 1 4\n", "# x\nOFF # y\n\n4 1\n", "4 1 0\n", "OFF\r\n4 1 0\r\n"] {
        let (mesh, report) = check(&format!("{head}{SQUARE}4 0 1 2 3\n"), &[[0, 1, 2], [0, 2, 3]]);
        assert_eq!((mesh.positions[2], report.faces), ([1.0, 1.0, 0.0], 1));
    }
}

#[test]
fn colours_of_vertices_are_carried() {
    let (mesh, report) =
        check("COFF\n3 1 0\n0 0 0 1 2 3 255\n1 0 0 255 300 -1\n0 1 0 0.5 1 0.0 1\n3 0 1 2\n", &[[0, 1, 2]]);
    assert_eq!(mesh.colors.unwrap(), [[1, 2, 3], [255, 255, 0], [128, 255, 0]]);
    assert!(report.colored && report.not_carried.is_empty());
    let (mesh, report) =
        check("STCNOFF\n3 1 0\n0 0 0 9 9 9 1 2 3 4 7 7\n1 0 0 9 9 9 5\n0 1 0\n3 0 1 2 1 0 0\n", &[[0, 1, 2]]);
    assert_eq!(mesh.colors.unwrap(), [[1, 2, 3], [255; 3], [255; 3]]);
    assert_eq!(
        report.not_carried,
        ["3 normals", "3 texture coordinates", "1 colours of faces", "2 vertices without a colour (white)"]
    );
}

fn binary() -> Vec<u8> {
    let mut bytes = b"CNOFF BINARY\n".to_vec();
    [3, 2, 0].iter().for_each(|count: &i32| bytes.extend(count.to_be_bytes()));
    for vertex in 0..3 {
        let row = [vertex as f32, 0.5, -1.0, 0.0, 0.0, 1.0, 1.0, 0.5, 0.0, 1.0];
        row.iter().for_each(|number| bytes.extend(number.to_be_bytes()));
    }
    [3, 0, 1, 2, 0, 3, 2, 1, 0, 1].iter().for_each(|number: &i32| bytes.extend(number.to_be_bytes()));
    bytes.extend(0.5_f32.to_be_bytes());
    bytes
}

#[test]
fn binary_files_are_read() {
    let (mesh, report) = read_off(&binary()).unwrap();
    assert_eq!(mesh.positions, [[0.0, 0.5, -1.0], [1.0, 0.5, -1.0], [2.0, 0.5, -1.0]]);
    assert_eq!(mesh.faces, [[0, 1, 2], [2, 1, 0]]);
    assert_eq!(mesh.colors.unwrap(), [[255, 128, 0]; 3]);
    assert_eq!(
        (report.format, report.not_carried),
        (Format::OffBinary, vec!["3 normals".into(), "1 colours of faces".into()])
    );
    let whole = binary();
    for len in 0..whole.len() {
        read_off(&whole[..len]).unwrap_err();
    }
}

#[test]
fn errors_name_the_place() {
    let check = |text: &str, expected: &str| assert_eq!(read_off(text.as_bytes()).unwrap_err().to_string(), expected);
    check("OFF", "line 1: the file ends here");
    check("XOFF\n", "header line 1: `XOFF` is no kind of OFF");
    check("4OFF\n", "header line 1: meshes in four or more dimensions are not read");
    check("OFF\n3 x 0", "line 2: `x` is no count");
    check("OFF\n3\n", "line 2: the numbers of vertices and faces are missing");
    check("OFF\n5000 1 0\n0 0 0", "5000 rows of element vertex need at least 29999 bytes, but only 5 follow");
    check("OFF\n1 5000 0\n0 0 0", "5000 rows of element face need at least 9999 bytes, but only 5 follow");
    check("OFF\n3 1 0\n0 0 0\n0 y 0\n0 0 0\n3 0 1 2", "vertex 1 at line 4: `y` is not a number");
    let square = format!("OFF\n4 1 0\n{SQUARE}");
    check(&square, "line 6: the file ends here");
    check(&format!("{square}3 0 1 4"), "face 0 at line 7 names vertex 4, but the file has 4 vertices");
    check(&format!("{square}3 0 1 "), "face 0 at line 7: 1 of 3 corners are missing");
    check(&format!("{square}2 0 1"), "the file holds no faces (it has 4 vertices; point clouds cannot be ingested)");
}
