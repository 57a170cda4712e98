use std::fs::File;

use super::super::tests::Folder;
use super::super::{read_mesh_in_memory, read_obj};
use super::*;
use crate::mesh::TriMesh;

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
            "1 faces with fewer than three corners",
            "1 points and lines",
            "1 vertex weights other than 1",
            "1 uses of a material",
            "materials from a.mtl: there is no directory to look in",
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

/// A square with a texture of four texels, one for each corner, and a triangle without one.
fn textured(folder: &Folder) -> std::path::PathBuf {
    folder.write_png("maps/skin.png", 2, 2, &[[255, 0, 0], [0, 255, 0], [0, 0, 255], [200, 100, 50]]);
    folder.write(
        "a.mtl",
        "newmtl skin\nKd 0 0 0\nmap_Kd -clamp on maps\\skin.png\nnewmtl red\nKd 1 0.2 0\nnewmtl gone\nKd 0 1 0\n\
         map_Kd gone.png\nnewmtl bare\n",
    );
    folder.write(
        "a.obj",
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 2 0\nv 3 3 0\nv 4 4 0\nv 5 5 0\n\
         vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt 0.5 0.5\n\
         usemtl skin\nf 1/1 2/2 3/3 4/-2\nf 1/5 2/5 5/5\nf 1 2 6\nusemtl red\nf 1 5 6\nusemtl gone\nf 5/1 6/1 7/1\n\
         usemtl bare\nf 1 7 8\nusemtl never\nf 1 7 8\n",
    )
}

#[test]
fn textures_and_material_colours_are_baked() {
    let folder = Folder::new();
    let (mesh, report) = read_mesh_in_memory(&textured(&folder)).unwrap();
    let mean = [114, 89, 76];
    assert_eq!(
        mesh.colors.unwrap(),
        [[0, 0, 255], [200, 100, 50], [0, 255, 0], [255, 0, 0], mean, [255, 51, 0], [0, 255, 0], [255; 3]]
    );
    assert_eq!(mesh.positions.len(), 8);
    assert!(!report.colored);
    assert_eq!(
        report.notes,
        [
            "5 vertex colours baked from maps\\skin.png; where a vertex has several texture coordinates, the first counts",
            "2 vertex colours taken from materials"
        ]
    );
    let left = report.not_carried;
    assert_eq!(left[0], "5 texture coordinates");
    assert_eq!(left[1], "1 uses of a material that no library has");
    assert_eq!(left[2], "1 corners with a texture and without texture coordinates");
    assert_eq!(left[3], "1 vertices without a colour (white)");
    assert!(left[4].starts_with("texture gone.png: "), "{left:?}");
    assert_eq!(left.len(), 5);
}

#[test]
fn colours_of_vertices_give_way_to_textures_alone() {
    let folder = Folder::new();
    folder.write_png("t.png", 1, 1, &[[9, 8, 7]]);
    folder.write("m.mtl", "newmtl t\nmap_Kd t.png\nnewmtl k\nKd 1 0 0\n");
    let text = "v 0 0 0 1 1 0\nmtllib m.mtl\nv 1 0 0 0 1 1\nv 0 1 0\nv 1 1 1\nvt 0 0\nusemtl k\nf 1 2 3\nusemtl t\nf 2/1 3/1 4/1\n";
    let (mesh, report) = read_mesh_in_memory(&folder.write("m.obj", text)).unwrap();
    assert_eq!(mesh.colors.unwrap(), [[255, 255, 0], [9, 8, 7], [9, 8, 7], [9, 8, 7]]);
    assert!(report.colored);
}

#[test]
fn missing_libraries_and_textures_outside_are_notes() {
    let folder = Folder::new();
    folder.write("sub/m.mtl", "newmtl t\nmap_Kd ../t.png\n");
    folder.write_png("t.png", 1, 1, &[[9, 8, 7]]);
    let text = format!("mtllib m.mtl gone.mtl\nusemtl t\n{SQUARE}vt 0 0\nf 1/1 2/1 3/1\n");
    let (mesh, report) = read_mesh_in_memory(&folder.write("sub/m.obj", text)).unwrap();
    assert_eq!(mesh.colors, None);
    assert!(!report.colored && report.notes.is_empty());
    let left = report.not_carried;
    assert!(left[1].starts_with("materials from gone.mtl: "), "{left:?}");
    assert_eq!(left[2], "texture ../t.png: it is not in the directory of the mesh");
}

/// The folder of scanned and designed meshes is no part of the project; `LODESTREAM_MESHES` names it.
#[test]
fn a_real_textured_mesh_gets_the_colours_of_its_texels() {
    let Some(meshes) = std::env::var_os("LODESTREAM_MESHES") else {
        eprintln!("skipped: LODESTREAM_MESHES names no folder");
        return;
    };
    let path = std::path::Path::new(&meshes).join("spot.obj");
    let text = std::fs::read_to_string(&path).unwrap();
    let (mesh, report) = read_mesh_in_memory(&path).unwrap();
    assert!(report.colored, "{report:?}");
    let colors = mesh.colors.unwrap();
    let mut decoder = png::Decoder::new(std::io::BufReader::new(File::open(path.with_file_name("spot.png")).unwrap()));
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().unwrap();
    let mut image = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut image).unwrap();
    let samples = info.color_type.samples();
    let numbers = |line: &str| -> Vec<f64> { line.split(' ').skip(1).map(|word| word.parse().unwrap()).collect() };
    let uvs: Vec<Vec<f64>> = text.lines().filter(|line| line.starts_with("vt ")).map(numbers).collect();
    // The nearest texel, by the first face of each vertex: near enough where the texture is smooth.
    let mut is_seen = vec![false; colors.len()];
    let (mut near, mut seen) = (0, 0);
    for corner in text.lines().filter(|line| line.starts_with("f ")).flat_map(|line| line.split(' ').skip(1)) {
        let (v, vt) = corner.split_once('/').unwrap();
        let v = v.parse::<usize>().unwrap() - 1;
        let uv = &uvs[vt.split('/').next().unwrap().parse::<usize>().unwrap() - 1];
        if std::mem::replace(&mut is_seen[v], true) {
            continue;
        }
        let x = ((uv[0] * f64::from(info.width)) as usize).min(info.width as usize - 1);
        let y = (((1.0 - uv[1]) * f64::from(info.height)) as usize).min(info.height as usize - 1);
        let texel = &image[(y * info.width as usize + x) * samples..][..3];
        seen += 1;
        near += usize::from(colors[v].iter().zip(texel).all(|(a, b)| a.abs_diff(*b) <= 24));
    }
    assert_eq!(seen, colors.len());
    assert!(near as f64 > 0.95 * seen as f64, "{near} of {seen}");
}
