use super::super::read_ply;
use super::*;
use crate::ingest::read::Place;

fn text(header: &str, body: &str) -> Vec<u8> {
    format!("ply\nformat ascii 1.0\n{header}end_header\n{body}").into_bytes()
}

const XYZ: &str = "property float x\nproperty float y\nproperty float z\n";

fn check_error(bytes: &[u8], expected: &str) {
    assert_eq!(read_ply(bytes).unwrap_err().to_string(), expected);
}

/// A file with every type, extra elements and lists, properties out of order, polygons and an unusual count type.
fn exotic(format: &str) -> Vec<u8> {
    let mut out = format!(
        "ply\nformat {format} 1.0\ncomment TextureFile skin.png\nobj_info made by hand\nelement camera 2\n\
         property list short double matrix\nproperty int8 id\nelement vertex 5\nproperty uint16 red\n\
         property double z\nproperty list uchar float weights\nproperty short x\nproperty ushort blue\n\
         property ushort green\nproperty float32 y\nelement nothing 9000000000000000\nelement face 2\n\
         property uint8 flags\nproperty list uint int vertex_index\nproperty list uint8 float texcoord\nend_header\n"
    )
    .into_bytes();
    let mut put = |numbers: &[(&str, f64)]| {
        for &(kind, value) in numbers {
            let mut bytes = match kind {
                "i8" => vec![value as i8 as u8],
                "u8" => vec![value as u8],
                "i16" => (value as i16).to_le_bytes().to_vec(),
                "u16" => (value as u16).to_le_bytes().to_vec(),
                "i32" => (value as i32).to_le_bytes().to_vec(),
                "u32" => (value as u32).to_le_bytes().to_vec(),
                "f32" => (value as f32).to_le_bytes().to_vec(),
                _ => value.to_le_bytes().to_vec(),
            };
            match format {
                "ascii" => bytes = format!("{value}\r\n\t").into_bytes(),
                "binary_big_endian" => bytes.reverse(),
                _ => {}
            }
            out.extend(bytes);
        }
    };
    put(&[("i16", 2.0), ("f64", 1.5), ("f64", 2.5), ("i8", -3.0), ("i16", 0.0), ("i8", 4.0)]);
    for k in 0..5 {
        let k = f64::from(k);
        put(&[("u16", 256.0 * k), ("f64", 0.125 + k), ("u8", 1.0), ("f32", 0.5), ("i16", -k)]);
        put(&[("u16", 65535.0), ("u16", 255.0), ("f32", 10.0 * k)]);
    }
    put(&[("u8", 7.0), ("u32", 3.0), ("i32", 0.0), ("i32", 1.0), ("i32", 2.0), ("u8", 0.0)]);
    put(&[("u8", 7.0), ("u32", 5.0), ("i32", 4.0), ("i32", 3.0), ("i32", 2.0), ("i32", 1.0), ("i32", 0.0)]);
    put(&[("u8", 1.0), ("f32", 0.25)]);
    out
}

#[test]
fn all_encodings_types_and_orders_give_the_same_mesh() {
    for (name, format) in [
        ("ascii", Format::PlyAscii),
        ("binary_little_endian", Format::PlyBinaryLittleEndian),
        ("binary_big_endian", Format::PlyBinaryBigEndian),
    ] {
        let (mesh, report) = read_ply(&exotic(name)).unwrap();
        assert_eq!(mesh.positions[3], [-3.0, 30.0, 3.125], "{name}");
        assert_eq!(mesh.faces, [[0, 1, 2], [4, 3, 2], [4, 2, 1], [4, 1, 0]], "{name}");
        assert_eq!(mesh.colors.unwrap()[2], [2, 0, 255], "{name}");
        assert_eq!((report.format, report.vertices, report.faces, report.triangles), (format, 5, 2, 4));
        assert_eq!(
            report.not_carried,
            [
                "element camera (2 rows)",
                "vertex properties weights",
                "face properties flags, texcoord",
                "texture skin.png (textures of PLY files are not baked)"
            ]
        );
    }
}

#[test]
fn every_truncation_is_an_error() {
    for format in ["ascii", "binary_little_endian", "binary_big_endian"] {
        let whole = exotic(format);
        // The last white space, and in text the digits of the last number, are not missed.
        let needed = whole.trim_ascii_end().len() - if format == "ascii" { 3 } else { 0 };
        for len in 0..needed {
            read_ply(&whole[..len]).unwrap_err();
        }
        read_ply(&whole[..needed]).unwrap();
    }
}

#[test]
fn carriage_returns_end_the_header_without_swallowing_the_body() {
    for (newline, first) in [("\n", b'\n'), ("\r\n", b'\n'), ("\r", b'\n'), ("\r", b'\r')] {
        let header = "ply\nformat binary_little_endian 1.0\nelement face 1\nproperty list uchar uchar vertex_indices\n\
             element vertex 11\nproperty uchar x\nproperty uchar y\nproperty uchar z\nend_header\n";
        let mut bytes = header.replace('\n', newline).into_bytes();
        bytes.push(3);
        bytes.extend([0, 1, first.min(10)]);
        bytes.extend([10; 33]);
        let (mesh, _) = read_ply(&bytes).unwrap();
        assert_eq!(mesh.faces, [[0, 1, 10]]);
        assert_eq!(mesh.positions[0], [10.0; 3]);
    }
}

#[test]
fn colors_of_every_type_become_bytes() {
    for (kind, names, values, expected) in [
        ("uchar", "red green blue", "1 2 255", [1, 2, 255]),
        ("char", "red green blue", "1 -2 -1", [1, 254, 255]),
        ("ushort", "red green blue", "255 256 65535", [0, 1, 255]),
        ("int", "diffuse_red diffuse_green diffuse_blue", "1 -2 300", [1, 0, 255]),
        ("float", "r g b", "0.5 -1 nan", [128, 0, 0]),
        ("double", "red green blue", "0.1 0.9 7", [26, 230, 255]),
    ] {
        let properties: String = names.split(' ').map(|name| format!("property {kind} {name}\n")).collect();
        let header =
            format!("element vertex 3\n{XYZ}{properties}element face 1\nproperty list int int vertex_indices\n");
        let row = format!("0 0 0 {values}\n");
        let (mesh, report) = read_ply(&text(&header, &format!("{}3 0 1 2", row.repeat(3)))).unwrap();
        assert_eq!(mesh.colors.unwrap(), [expected; 3], "{kind}");
        assert!(report.colored && report.not_carried.is_empty(), "{report:?}");
    }
}

#[test]
fn strips_become_triangles() {
    let header = format!("element vertex 6\n{XYZ}element tristrips 1\nproperty list int int vertex_indices\n");
    let (mesh, report) =
        read_ply(&text(&header, &format!("{}11 0 1 2 3 -1 3 4 4 5 -1 0", "0 0 0\n".repeat(6)))).unwrap();
    assert_eq!(mesh.faces, [[0, 1, 2], [2, 1, 3]]);
    assert_eq!((report.faces, report.triangles), (1, 2));
    let (mesh, _) = read_ply(&text(&header, &format!("{}6 0 1 2 2 3 4", "0 0 0\n".repeat(6)))).unwrap();
    // The repeated corner turns the strip: the last triangle is the fourth one.
    assert_eq!(mesh.faces, [[0, 1, 2], [3, 2, 4]]);
}

#[test]
fn errors_name_the_row_and_its_place() {
    let header = format!("element vertex 3\n{XYZ}element face 1\nproperty list uchar int vertex_indices\n");
    let good = "0 0 0\n1 0 0\n0 1 0\n";
    check_error(
        &text(&header, &format!("{good}3 0 1 3\n")),
        "face 0 at line 13 names vertex 3, but the file has 3 vertices",
    );
    check_error(
        &text(&header, &format!("{good}3 0 1 -1\n")),
        "face 0 at line 13 names vertex -1, but the file has 3 vertices",
    );
    check_error(
        &text(&header, "0 0 0\n1 zero 0\n0 1 0\n3 0 1 2"),
        "vertex 1 at line 11: `zero` is not a number of the property's type",
    );
    check_error(
        &text(&header, &format!("{good}3 0 1 1.5\n")),
        "face 0 at line 13: `1.5` is not a number of the property's type",
    );
    check_error(&text(&header, &format!("{good}3 0 1\n")), "face 0 at line 14: the file ends here");
    check_error(
        &text(&header, &format!("{good}99 0 1 2\n")),
        "face 0 at line 13: a list of 99 items is longer than the rest of the file",
    );
    check_error(&text(&header, &format!("{good}-3 0 1 2\n")), "face 0 at line 13: a list of -3 items");
    check_error(&text(&header, "0 0 0\n"), "3 rows of element vertex need at least 17 bytes, but only 6 follow");
    check_error(
        &text(&header, &format!("{good}2 0 1\n")),
        "the file holds no faces (it has 3 vertices; point clouds cannot be ingested)",
    );

    let mut binary =
        String::from_utf8(text(&header, "")).unwrap().replace("ascii", "binary_little_endian").into_bytes();
    let body = binary.len();
    binary.extend([0; 36]);
    binary.push(3);
    binary.extend([0; 8]);
    binary.extend(7_u32.to_le_bytes());
    let place = Place::Byte(body as u64 + 36 + 1 + 8);
    let error = read_ply(&binary).unwrap_err();
    assert!(matches!(error, ReadError::VertexOutOfRange { place: p, index: 7, .. } if p == place), "{error}");
}

#[test]
fn headers_that_promise_too_much_are_refused_before_anything_is_allocated() {
    let huge = "element vertex 4000000000\nproperty float x\nproperty float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\n";
    check_error(
        &text(huge, "0 0 0"),
        "4000000000 rows of element vertex need at least 23999999999 bytes, but only 5 follow",
    );
    check_error(&text(&huge.replace("4000000000", "5000000000"), ""), "the mesh has more than 4294967295 vertices");
    check_error(&text(&huge.replace("4000000000", "-1"), ""), "header line 3: `-1` is no count of rows");
}

#[test]
fn headers_that_make_no_sense_are_refused() {
    check_error(b"", "header line 1: a PLY file starts with the line `ply`");
    check_error(b"ply\n", "header line 2: the file ends before `end_header`");
    check_error(b"ply\nend_header\n", "header line 2: the header has no `format` line");
    check_error(b"ply\nformat ascii 2.0\n", "header line 2: unknown version `2.0` (1.0 is known)");
    check_error(b"ply\nformat utf8 1.0\n", "header line 2: unknown encoding `utf8`");
    check_error(b"ply\nproperty int x\n", "header line 2: a property before the first element");
    check_error(b"ply\nelement a 1\nproperty quad x\n", "header line 3: unknown type `quad`");
    check_error(
        b"ply\nelement a 1\nproperty list float int x\n",
        "header line 3: the count of a list cannot be a float",
    );
    check_error(b"ply\nfrob\n", "header line 2: unknown keyword `frob`");
    check_error(&text("element vertex 1\nproperty float x\n", "0"), "header line 3: element vertex has no number y");
    check_error(
        &text("element face 1\nproperty int a\n", "0"),
        "header line 3: element face has no list vertex_indices",
    );
    check_error(
        &text(&format!("element vertex 1\n{XYZ}element face 0\nproperty list uchar int vertex_indices\n"), "0 0 0"),
        "the file holds no faces (it has 1 vertices; point clouds cannot be ingested)",
    );
    check_error(
        &text(&format!("element vertex 1\n{XYZ}"), "0 0 0"),
        "the file holds no faces (it has 1 vertices; point clouds cannot be ingested)",
    );
}

#[test]
fn buffers_of_any_size_give_the_same_mesh_and_the_same_errors() {
    use super::super::tests::drip;
    let read = |bytes: &[u8], buffer: usize| {
        let workspace = crate::ingest::spill::Workspace::in_memory();
        let mut input = Input::with_buffer(drip(bytes), bytes.len() as u64, buffer);
        let (mesh, report) = read(&mut input, Sink::new(&workspace))?;
        Ok::<_, ReadError>((mesh.load()?, report))
    };
    for format in ["ascii", "binary_little_endian", "binary_big_endian"] {
        let whole = exotic(format);
        let expected = read_ply(&whole).unwrap();
        // The header has to fit, and nothing else.
        let header = Header::parse(&whole, true).unwrap().body;
        for buffer in header..header + 40 {
            assert_eq!(read(&whole, buffer).unwrap(), expected);
            for cut in [header + 10, header + 57, whole.len() - 9] {
                let expected = read_ply(&whole[..cut]).unwrap_err().to_string();
                assert_eq!(read(&whole[..cut], buffer).unwrap_err().to_string(), expected);
            }
        }
    }
}

/// Faces that are read at once, and those around them that are not.
#[test]
fn plain_faces_and_others_may_be_mixed() {
    let header = format!("element vertex 9\n{XYZ}element face 6\nproperty list uchar int vertex_indices\n");
    let faces: [&[i32]; 6] = [&[0, 1, 2], &[3, 4, 5, 6], &[6, 7, 8], &[8], &[2, 1, 0], &[5, 4, 3]];
    let mut bytes = text(&header, "");
    let at = bytes.windows(5).position(|word| word == b"ascii").unwrap();
    bytes.splice(at..at + 5, *b"binary_little_endian");
    (0..27).for_each(|k| bytes.extend((k as f32 + 0.5).to_le_bytes()));
    for face in faces {
        bytes.push(face.len() as u8);
        face.iter().for_each(|corner| bytes.extend(corner.to_le_bytes()));
    }
    let (mesh, report) = read_ply(&bytes).unwrap();
    assert_eq!(mesh.positions[8], [24.5, 25.5, 26.5]);
    assert_eq!(mesh.faces, [[0, 1, 2], [3, 4, 5], [3, 5, 6], [6, 7, 8], [2, 1, 0], [5, 4, 3]]);
    assert_eq!((report.faces, report.not_carried), (6, vec!["1 faces with fewer than three corners".to_owned()]));
    let at = bytes.len() - 4;
    bytes[at..].copy_from_slice(&9_i32.to_le_bytes());
    check_error(&bytes, &format!("face 5 at byte {at} names vertex 9, but the file has 9 vertices"));
}
