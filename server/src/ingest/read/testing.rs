//! Small files of every format, for tests and as seeds of fuzzers.

/// Files of one format that use most of what its reader knows.
#[derive(Clone, Debug)]
pub struct Seeds {
    /// Extension of the format.
    pub format: &'static str,
    /// The files.
    pub files: Vec<Vec<u8>>,
}

/// Seeds for all readers.
pub fn seeds() -> Vec<Seeds> {
    let ply = ["ascii", "binary_little_endian", "binary_big_endian"].map(ply);
    let obj = [
        "# square\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n",
        "mtllib a.mtl\no x\nv 0 0 0 1 0.5 0\nv 1 0 0 0 0 0\nv 1 1 0 \\\n1 1 1\nvt 0 0\nvn 0 0 1\nusemtl m\n\
         f -3/1/1 -2/1/1 -1/1/1\r\nl 1 2\n",
    ];
    let stl_text = "solid a\n facet normal 0 0 1\n  outer loop\n   vertex 0 0 0\n   vertex 1e0 0 0\n   vertex 0 -1.5 0\n\
                    endloop\n endfacet\nendsolid a\n";
    let mut stl = vec![b' '; 80];
    stl.extend(2_u32.to_le_bytes());
    (0..24).for_each(|k| {
        stl.extend((k as f32).to_le_bytes());
        stl.extend(&[0, 0][..if k % 12 == 11 { 2 } else { 0 }]);
    });
    let off = [
        "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n4 0 1 2 3 255 0 0\n",
        "CNOFF # x\n3 1 0\n0 0 0 0 0 1 1 2 3 4\n1 0 0 0 0 1 0.5 1 0 1\n1 1 0 0 0 1 9 9 9 9\n3 0 1 2\n",
    ];
    let mut off_binary = b"OFF BINARY\n".to_vec();
    [3, 1, 0].iter().for_each(|number: &i32| off_binary.extend(number.to_be_bytes()));
    (0..9).for_each(|k| off_binary.extend((k as f32).to_be_bytes()));
    [3, 0, 1, 2, 1, 0].iter().for_each(|number: &i32| off_binary.extend(number.to_be_bytes()));
    let texts = |texts: &[&str]| texts.iter().map(|text| text.as_bytes().to_vec()).collect::<Vec<_>>();
    vec![
        Seeds { format: "ply", files: ply.to_vec() },
        Seeds { format: "obj", files: texts(&obj) },
        Seeds { format: "stl", files: [texts(&[stl_text]), vec![stl]].concat() },
        Seeds { format: "off", files: [texts(&off), vec![off_binary]].concat() },
        Seeds { format: "gltf", files: vec![gltf().into_bytes()] },
        Seeds { format: "glb", files: vec![scene()] },
    ]
}

/// A PLY file with polygons, a strip and colours.
pub fn ply(format: &str) -> Vec<u8> {
    let header = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n\
                  property uchar green\nproperty uchar blue\nelement face 2\nproperty list uchar int vertex_indices\n\
                  element tristrips 1\nproperty list int int vertex_indices\nend_header\n";
    let mut bytes = format!("ply\nformat {format} 1.0\n{header}").into_bytes();
    let big = format == "binary_big_endian";
    let int = |value: i32| if big { value.to_be_bytes() } else { value.to_le_bytes() };
    if format == "ascii" {
        bytes.extend(b"0 0 0 1 2 3\n1.5 0 0 4 5 6\n0 1e0 0 7 8 9\n0 0 -1 0 0 0\n3 0 1 2\n4 0 1 2 3\n6 0 1 2 -1 0 3\n");
        return bytes;
    }
    for corner in 0..4_i32 {
        for axis in 0..3 {
            bytes.extend(int(if corner == axis { 0x3f80_0000 } else { 0 }));
        }
        bytes.extend([1, 2, 3]);
    }
    for face in [&[0, 1, 2][..], &[0, 1, 2, 3]] {
        bytes.push(face.len() as u8);
        face.iter().for_each(|&corner| bytes.extend(int(corner)));
    }
    [5, 0, 1, 2, -1, 3].iter().for_each(|&value| bytes.extend(int(value)));
    bytes
}

/// A glTF document with its buffer in a data URI: one triangle.
pub fn gltf() -> String {
    // Little-endian f32: (0, 0, 0), (1, 0, 0), (0, 1, 0).
    let buffer = "AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAA";
    format!(
        r#"{{"asset":{{"version":"2.0"}},"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}}}}]}}],"nodes":[{{"mesh":0,"translation":[1,2,3]}}],
"accessors":[{{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"}}],"bufferViews":[{{"buffer":0,"byteLength":36}}],
"buffers":[{{"byteLength":36,"uri":"data:application/octet-stream;base64,{buffer}"}}]}}"#
    )
}

/// A GLB file of a document and a binary chunk.
pub fn glb(json: &str, binary: &[u8]) -> Vec<u8> {
    let mut json = json.as_bytes().to_vec();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut binary = binary.to_vec();
    binary.resize(binary.len().next_multiple_of(4), 0);
    let len = |bytes: usize| u32::try_from(bytes).expect("test files are small").to_le_bytes();
    let mut out = b"glTF\x02\0\0\0".to_vec();
    out.extend(len(12 + 8 + json.len() + 8 + binary.len()));
    out.extend(len(json.len()));
    out.extend(b"JSON");
    out.extend(json);
    out.extend(len(binary.len()));
    out.extend(b"BIN\0");
    out.extend(binary);
    out
}

/// A GLB file with strips, fans, a sparse accessor, colours, two textures, and a mesh in two places, one of them mirrored.
pub fn scene() -> Vec<u8> {
    let mut binary = Vec::new();
    let mut views = Vec::new();
    let mut view = |bytes: &[u8]| {
        binary.resize(binary.len().next_multiple_of(4), 0);
        views.push(format!(r#"{{"buffer":0,"byteOffset":{},"byteLength":{}}}"#, binary.len(), bytes.len()));
        binary.extend(bytes);
    };
    let floats = |numbers: &[f32]| numbers.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>();
    view(&floats(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0]));
    view(&[0, 1, 2, 3]);
    view(&floats(&[0.25, 0.25, 0.75, 0.25, 0.25, 0.75, 0.75, 0.75]));
    view(&[255, 0, 0, 255, 0, 255, 0, 255, 0, 0, 255, 255, 255, 255, 255, 255]);
    view(&png(2, 2, &[[255, 0, 0], [0, 255, 0], [0, 0, 255], [200, 100, 50]]));
    view(&jpeg());
    view(&[2, 0]);
    view(&floats(&[0.0, 2.0, 0.0]));
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
"nodes":[{{"children":[1,2],"scale":[2,2,2]}},{{"mesh":0,"rotation":[0,0,0,1]}},{{"mesh":1,"matrix":[-1,0,0,0,0,1,0,0,0,0,1,0,5,6,7,1]}}],
"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"TEXCOORD_0":2}},"indices":1,"mode":5,"material":0}}]}},
{{"primitives":[{{"attributes":{{"POSITION":4,"COLOR_0":3}},"indices":1,"mode":6,"material":2}},
{{"attributes":{{"POSITION":0,"TEXCOORD_0":2}},"material":1}}]}}],
"materials":[{{"pbrMetallicRoughness":{{"baseColorTexture":{{"index":0}}}}}},
{{"pbrMetallicRoughness":{{"baseColorFactor":[0.5,1,1,1],"baseColorTexture":{{"index":1,"extensions":{{"KHR_texture_transform":{{"offset":[0.5,0],"scale":[2,2]}}}}}}}}}},
{{"pbrMetallicRoughness":{{"baseColorFactor":[0.25,0.5,1,1]}}}}],
"textures":[{{"source":0,"sampler":0}},{{"source":1}}],"images":[{{"bufferView":4}},{{"bufferView":5}}],
"samplers":[{{"wrapS":33071,"wrapT":33648}}],
"accessors":[{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3"}},{{"bufferView":1,"componentType":5121,"count":4,"type":"SCALAR"}},
{{"bufferView":2,"componentType":5126,"count":4,"type":"VEC2"}},{{"bufferView":3,"componentType":5121,"normalized":true,"count":4,"type":"VEC4"}},
{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","sparse":{{"count":1,"indices":{{"bufferView":6,"componentType":5121}},"values":{{"bufferView":7}}}}}}],
"bufferViews":[{}],"buffers":[{{"byteLength":{}}}]}}"#,
        views.join(","),
        binary.len()
    );
    glb(&json, &binary)
}

/// A PNG of RGB pixels, `pixels.len() == width * height`.
pub fn png(width: u32, height: u32, pixels: &[[u8; 3]]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = ::png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(::png::ColorType::Rgb);
    let mut writer = encoder.write_header().expect("writing to memory");
    writer.write_image_data(pixels.as_flattened()).expect("writing to memory");
    writer.finish().expect("writing to memory");
    bytes
}

/// A JPEG of 8 x 8 pixels of one colour, some (190, 143, 159): each component is a block with a mean and nothing else.
pub fn jpeg() -> Vec<u8> {
    let mut bytes = vec![0xff, 0xd8];
    let mut segment = |marker: u8, content: &[u8]| {
        bytes.extend([0xff, marker]);
        bytes.extend((content.len() as u16 + 2).to_be_bytes());
        bytes.extend(content);
    };
    // All steps of the quantisation are 8, so that a mean is what is coded.
    segment(0xdb, &[&[0][..], &[8; 64]].concat());
    segment(0xc0, &[8, 0, 8, 0, 8, 3, 1, 0x11, 0, 2, 0x11, 0, 3, 0x11, 0]);
    // One code of one bit each: a difference of five bits for means, the end of the block for the rest.
    let one_code = |class: u8, symbol: u8| [&[class, 1][..], &[0; 15], &[symbol]].concat();
    segment(0xc4, &one_code(0x00, 5));
    segment(0xc4, &one_code(0x10, 0));
    segment(0xda, &[3, 1, 0x00, 2, 0x00, 3, 0x00, 0, 63, 0]);
    // A difference of 31, of 16, of 31, each with its code before and the end of its block after; then ones.
    bytes.extend([0b0111_1100, 0b1000_0001, 0b1111_0111, 0xff, 0xd9]);
    bytes
}
