use super::super::testing::{glb, gltf, scene};
use super::super::tests::Folder;
use super::super::{read_gltf, read_mesh_in_memory};
use super::*;

fn check_error(bytes: &[u8], expected: &str) {
    assert_eq!(read_gltf(bytes).unwrap_err().to_string(), expected);
}

#[test]
fn a_scene_is_read_in_place_with_its_colours() {
    let (mesh, report) = read_gltf(&scene()).unwrap();
    assert_eq!((report.format, report.vertices, report.triangles), (Format::Glb, 12, 2 + 2 + 1));
    // A strip, scaled by two.
    assert_eq!(mesh.positions[..4], [[0.0; 3], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [2.0, 2.0, 0.0]]);
    assert_eq!(mesh.faces[..2], [[0, 1, 2], [2, 1, 3]]);
    // A fan with a vertex replaced, mirrored, moved, scaled, so that its faces are turned round.
    assert_eq!(mesh.positions[4..8], [[10.0, 12.0, 14.0], [8.0, 12.0, 14.0], [10.0, 16.0, 14.0], [8.0, 14.0, 14.0]]);
    assert_eq!(mesh.faces[2..4], [[4, 6, 5], [4, 7, 6]]);
    assert_eq!(mesh.faces[4], [8, 10, 9]);
    let colors = mesh.colors.unwrap();
    // Texel centres, as they are.
    assert_eq!(colors[..4], [[255, 0, 0], [0, 255, 0], [0, 0, 255], [200, 100, 50]]);
    // Linear light of COLOR_0 times that of the factor: sRGB of 0.25 is 137, of 0.5 is 188.
    assert_eq!(colors[4..8], [[137, 0, 0], [0, 188, 0], [0, 0, 255], [137, 188, 255]]);
    // The JPEG is of one colour, and the factor takes half of the red light.
    assert!(colors[8..].iter().all(|color| color == &colors[8] && color[0] < color[1] + 30), "{:?}", colors[8]);
    assert!(report.colored);
    assert_eq!(report.not_carried, ["8 texture coordinates", "1 corners that complete no triangle"]);
    assert_eq!(
        report.notes,
        [
            "vertex colours baked from images[0], images[1]",
            "vertex colours multiplied by the base colours of materials"
        ]
    );
}

#[test]
fn documents_with_buffers_inside_and_beside_are_read() {
    let folder = Folder::new();
    let (mesh, report) = read_mesh_in_memory(&folder.write("a.gltf", gltf())).unwrap();
    assert_eq!(mesh.positions, [[1.0, 2.0, 3.0], [2.0, 2.0, 3.0], [1.0, 3.0, 3.0]]);
    assert_eq!((report.format, &mesh.colors), (Format::Gltf, &None));

    let data = gltf().split_once("base64,").unwrap().1.split_once('"').unwrap().0.to_owned();
    let uri = format!("data:application/octet-stream;base64,{data}");
    folder.write("parts/a b.bin", buffers::decode_data_uri(&uri).unwrap());
    let beside = folder.write("b.gltf", gltf().replace(&uri, "parts/a%20b.bin"));
    assert_eq!(read_mesh_in_memory(&beside).unwrap().0, mesh);
    let outside = folder.write("parts/c.gltf", gltf().replace(&uri, "../b.gltf"));
    let error = read_mesh_in_memory(&outside).unwrap_err();
    assert_eq!(error.to_string(), "buffers[0]: ../b.gltf: it is not in the directory of the mesh");
}

#[test]
fn files_give_what_slices_give() {
    let folder = Folder::new();
    let path = folder.write("scene.glb", scene());
    assert_eq!(read_mesh_in_memory(&path).unwrap(), read_gltf(&scene()).unwrap());
}

#[test]
fn errors_name_the_part() {
    let changed = |from: &str, to: &str| {
        let text = gltf();
        assert!(text.contains(from), "{from}");
        text.replacen(from, to, 1).into_bytes()
    };
    let check = |from: &str, to: &str, expected: &str| check_error(&changed(from, to), expected);
    check(r#""count":3"#, r#""count":4"#, "accessors[0]: 4 entries do not lie in a view of 36 bytes");
    check(
        r#""count":3"#,
        r#""count":18446744073709551615"#,
        "accessors[0]: 18446744073709551615 entries do not lie in a view of 36 bytes",
    );
    check(r#""bufferView":0,"#, "", "accessors[0]: 3 entries without a view");
    check(r#""bufferView":0"#, r#""bufferView":7"#, "bufferViews[7]: there is no such view");
    check(
        r#""byteLength":36,"uri""#,
        r#""byteLength":37,"uri""#,
        "buffers[0]: 37 bytes are announced, but there are 36",
    );
    check(r#""byteLength":36}"#, r#""byteLength":40}"#, "bufferViews[0]: 40 bytes at 0 do not lie in a buffer of 36");
    check(r#""mesh":0"#, r#""mesh":3"#, "meshes[3]: there is no such mesh");
    check(
        r#""mesh":0"#,
        r#""children":[0]"#,
        "the file holds no faces (it has 0 vertices; point clouds cannot be ingested)",
    );
    check(
        r#""version":"2.0"}"#,
        r#""version":"2.0"},"scenes":[{"nodes":[0,0]}]"#,
        "nodes[0]: it is reached twice, but nodes form trees",
    );
    check(r#""version":"2.0"}"#, r#""version":"2.0"},"scene":1"#, "scenes[1]: there is no such scene");
    check(r#""version":"2.0""#, r#""version":"1.0""#, "asset: version 1.0 is not 2");
    check(
        r#""version":"2.0"}"#,
        r#""version":"2.0"},"extensionsRequired":["KHR_draco_mesh_compression"]"#,
        "extensionsRequired: KHR_draco_mesh_compression is not supported",
    );
    check(
        r#"{"POSITION":0}"#,
        r#"{"POSITION":0},"indices":0"#,
        "accessors[0]: Vec3 of component type 5126 cannot be Indices",
    );
    check(
        r#"{"POSITION":0}"#,
        r#"{"POSITION":0},"mode":0"#,
        "the file holds no faces (it has 0 vertices; point clouds cannot be ingested)",
    );
    assert!(read_gltf(b"{").unwrap_err().to_string().starts_with("document: EOF while parsing"));
    let whole = scene();
    for len in 0..whole.len() {
        read_gltf(&whole[..len]).unwrap_err();
    }
    let indices = glb(
        r#"{"asset":{"version":"2.0"},"meshes":[{"primitives":[{"attributes":{"POSITION":0},"indices":1}]}],
"accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"},{"bufferView":1,"componentType":5125,"count":3,"type":"SCALAR"}],
"bufferViews":[{"buffer":0,"byteLength":36},{"buffer":0,"byteOffset":36,"byteLength":12}],"buffers":[{"byteLength":48}]}"#,
        &[&[0; 44][..], &[3, 0, 0, 0]].concat(),
    );
    check_error(&indices, "meshes[0].primitives[0]: corner 2 names vertex 3 of 3");
}

/// A mesh in many places may make more than its file holds, within limits.
#[test]
fn instances_are_limited() {
    let places = |count: usize| {
        let nodes = vec![r#"{"mesh":0}"#; count].join(",");
        let vertices = 30_000;
        let json = format!(
            r#"{{"asset":{{"version":"2.0"}},"nodes":[{nodes}],"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}}}}]}}],
"accessors":[{{"bufferView":0,"componentType":5120,"count":{vertices},"type":"VEC3"}}],"bufferViews":[{{"buffer":0,"byteLength":{}}}],
"buffers":[{{"byteLength":{}}}]}}"#,
            vertices * 3,
            vertices * 3
        );
        read_gltf(&glb(&json, &vec![0; vertices * 3]))
    };
    assert_eq!(places(20).unwrap().1.triangles, 20 * 10_000);
    let error = places(320).unwrap_err().to_string();
    assert!(
        error.starts_with("meshes[0].primitives[0]: up to here, meshes in all their places have more than"),
        "{error}"
    );
}

/// The folder of scanned and designed meshes is no part of the project; `LODESTREAM_MESHES` names it.
#[test]
fn a_real_textured_scene_is_read() {
    let Some(meshes) = std::env::var_os("LODESTREAM_MESHES") else {
        eprintln!("skipped: LODESTREAM_MESHES names no folder");
        return;
    };
    let (mesh, report) = read_mesh_in_memory(&Path::new(&meshes).join("duck.glb")).unwrap();
    assert_eq!((report.triangles, report.colored), (4212, true), "{report:?}");
    // A yellow duck with an orange beak and black eyes.
    let colors = mesh.colors.unwrap();
    let yellow = colors.iter().filter(|[r, g, b]| *r > 150 && *g > 100 && *b < 120).count();
    assert!(yellow > colors.len() / 2, "{yellow} of {}", colors.len());
}
