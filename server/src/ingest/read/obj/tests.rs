use super::*;

fn check(text: &str, faces: &[[u32; 3]]) -> (TriMesh, ReadReport) {
    let (mesh, report) = read_obj(text.as_bytes()).unwrap();
    assert_eq!(mesh.faces, faces, "{text}");
    assert_eq!(report.triangles, faces.len() as u64);
    assert_eq!(report.vertices, mesh.positions.len() as u64);
    (mesh, report)
}

fn check_error(text: &str, expected: &str) {
    assert_eq!(read_obj(text.as_bytes()).unwrap_err().to_string(), expected, "{text}");
}

const SQUARE: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";

#[test]
fn every_form_of_a_corner_is_read() {
    for face in
        ["f 1 2 3", "f 1/1 2/2 3/3", "f 1//1 2//1 3//1", "f 1/1/1 2/2/1 3/3/1", "f -4 -3 -2", "f -4/-1/-1 2// 3"]
    {
        check(&format!("{SQUARE}{face}"), &[[0, 1, 2]]);
    }
}

#[test]
fn polygons_become_fans() {
    let (_, report) = check(&format!("{SQUARE}v 2 2 2\nf 1 2 3 4 5\n"), &[[0, 1, 2], [0, 2, 3], [0, 3, 4]]);
    assert_eq!(report.faces, 1);
}

#[test]
fn line_ends_and_continuations_of_every_kind_are_read() {
    check("# c \\\nv 0 0 0\r\nv 1 0 \\\r\n0\r\n  v\t1 1 0\r\nf 1 \\\n2\\\n 3", &[[0, 1, 2]]);
    check("v 0 0 0\rv 1 0 0\rv 0 1 0\rf 1 2 3\r", &[[0, 1, 2]]);
    check(&format!("{SQUARE}f 1 2 3 \\"), &[[0, 1, 2]]);
}

#[test]
fn faces_may_come_before_their_vertices() {
    check(&format!("f 1 2 3\n{SQUARE}"), &[[0, 1, 2]]);
}

#[test]
fn colors_are_scaled_and_missing_ones_are_white() {
    let (mesh, report) = check("v 0 0 0\nv 1 0 0 0 .5 1\nv 0 1 0 2 0 0 1\nv 3 3 3 1\nf 1 2 3", &[[0, 1, 2]]);
    assert_eq!(mesh.colors.unwrap(), [[255, 255, 255], [0, 128, 255], [255, 0, 0], [255, 255, 255]]);
    assert!(!report.colored);
    assert_eq!(report.not_carried, ["1 colours outside 0..=1 (clamped)", "2 vertices without a colour (white)"]);
}

#[test]
fn what_is_left_is_reported() {
    let text = "mtllib a.mtl\nusemtl b\no c\ng d\ns 1\nvt 0 0\nvn 0 0 1\nl 1 2\nfrob\nv 9 9 9 2\nf 1 2\n";
    let (_, report) = check(&format!("{text}{SQUARE}f 1 2 3"), &[[0, 1, 2]]);
    assert_eq!(
        report.not_carried,
        [
            "1 texture coordinates",
            "1 normals",
            "3 object, group and smoothing statements",
            "1 uses of a material (textures are not baked yet)",
            "1 faces with fewer than three corners",
            "1 points and lines",
            "1 vertex weights other than 1",
            "materials from a.mtl (textures are not baked yet)",
            "1 unknown statements, the first is `frob` in line 9",
        ]
    );
    assert_eq!(report.faces, 2);
}

#[test]
fn errors_name_the_line() {
    check_error("v 0 0 0\n\nv 1 x 0", "line 3: vertex coordinate `x` is not a number");
    check_error("v 0 0", "line 1: a vertex needs three coordinates, this one has 2");
    check_error(&format!("{SQUARE}f 1 2 0"), "line 5: vertex index 0 (OBJ counts from 1)");
    check_error(
        &format!("{SQUARE}f 1 2 3\nf 1 2 a"),
        "line 6: `a` is not a corner of a face (v, v/vt, v//vn or v/vt/vn)",
    );
    check_error(&format!("{SQUARE}f 1 2 3\nf 1 2 5"), "face 1 at line 6 names vertex 5, but the file has 4 vertices");
    check_error(&format!("{SQUARE}f 1 2 -5"), "face 0 at line 5 names vertex -5, but the file has 4 vertices");
    check_error(SQUARE, "the file holds no faces (it has 4 vertices; point clouds cannot be ingested)");
    check_error("", "the file holds no faces (it has 0 vertices; point clouds cannot be ingested)");
}
