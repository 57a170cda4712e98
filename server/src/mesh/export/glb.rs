//! Binary glTF 2.0 out: one mesh of one primitive, positions and vertex colours.

use std::io::{self, Write};

use serde_json::json;

use super::{PIECE, hand_over};
use crate::mesh::TriMesh;

/// Bytes of the file's header and of each of its two chunks' headers.
const HEADER: usize = 12;
const CHUNK_HEADER: usize = 8;

/// glTF numbers for what is stored: `UNSIGNED_INT`, `FLOAT`, `UNSIGNED_BYTE`, `ARRAY_BUFFER`, `ELEMENT_ARRAY_BUFFER`.
const UNSIGNED_INT: u32 = 5125;
const FLOAT: u32 = 5126;
const UNSIGNED_BYTE: u32 = 5121;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;

/// Writes binary glTF (Khronos, glTF 2.0, section 4.4): `POSITION` as `f32` about the middle of the mesh's box, which the node's
/// translation gives back, indices as `u32`, and `COLOR_0` as normalised bytes, made linear as the format asks, if there are
/// colours. No normals: viewers shade flat without.
///
/// # Errors
/// [`io::ErrorKind::InvalidInput`] for a mesh without triangles, which the format cannot hold, or of more than 4 GiB; else
/// those of `out`, and part of the file is then written.
pub fn write_glb(mesh: &TriMesh, out: &mut impl Write) -> io::Result<()> {
    let refuse = |reason| io::Error::new(io::ErrorKind::InvalidInput, reason);
    let Some((low, high)) = mesh.bounding_box().filter(|_| !mesh.faces.is_empty()) else {
        return Err(refuse("glb holds no empty mesh"));
    };
    let middle: [f64; 3] = std::array::from_fn(|k| (low[k] + high[k]) / 2.0);
    // Rounding is what the format asks for.
    let local = |p: [f64; 3]| -> [f32; 3] { std::array::from_fn(|k| (p[k] - middle[k]) as f32) };
    let (vertices, corners) = (mesh.positions.len(), 3 * mesh.faces.len());
    let index_bytes = 4 * corners;
    let position_bytes = 12 * vertices;
    let color_bytes = if mesh.colors.is_some() { 4 * vertices } else { 0 };
    let mut views = vec![
        json!({"buffer": 0, "byteOffset": 0, "byteLength": index_bytes, "target": ELEMENT_ARRAY_BUFFER}),
        json!({"buffer": 0, "byteOffset": index_bytes, "byteLength": position_bytes, "target": ARRAY_BUFFER}),
    ];
    let mut accessors = vec![
        json!({"bufferView": 0, "componentType": UNSIGNED_INT, "count": corners, "type": "SCALAR"}),
        json!({"bufferView": 1, "componentType": FLOAT, "count": vertices, "type": "VEC3",
               "min": local(low), "max": local(high)}),
    ];
    let mut attributes = json!({"POSITION": 1});
    if mesh.colors.is_some() {
        let offset = index_bytes + position_bytes;
        views.push(json!({"buffer": 0, "byteOffset": offset, "byteLength": color_bytes, "target": ARRAY_BUFFER}));
        accessors.push(json!({"bufferView": 2, "componentType": UNSIGNED_BYTE, "normalized": true, "count": vertices,
                              "type": "VEC4"}));
        attributes["COLOR_0"] = 2.into();
    }
    let body = index_bytes + position_bytes + color_bytes;
    let document = json!({
        "asset": {"version": "2.0", "generator": "lodestream-server"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": middle}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 0}]}],
        "buffers": [{"byteLength": body}],
        "bufferViews": views,
        "accessors": accessors,
    });
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let total = HEADER + 2 * CHUNK_HEADER + text.len() + body;
    let too_large = |_| refuse("glb holds at most 4 GiB");
    let length = |bytes: usize| u32::try_from(bytes).map(u32::to_le_bytes).map_err(too_large);

    let mut piece = Vec::with_capacity(PIECE + 64);
    piece.extend_from_slice(b"glTF");
    piece.extend_from_slice(&2u32.to_le_bytes());
    piece.extend_from_slice(&length(total)?);
    piece.extend_from_slice(&length(text.len())?);
    piece.extend_from_slice(b"JSON");
    piece.extend_from_slice(&text);
    piece.extend_from_slice(&length(body)?);
    piece.extend_from_slice(b"BIN\0");
    for face in &mesh.faces {
        face.iter().for_each(|corner| piece.extend_from_slice(&corner.to_le_bytes()));
        hand_over(&mut piece, out)?;
    }
    for &position in &mesh.positions {
        local(position).iter().for_each(|x| piece.extend_from_slice(&x.to_le_bytes()));
        hand_over(&mut piece, out)?;
    }
    for color in mesh.colors.iter().flatten() {
        let [r, g, b] = color.map(linear);
        piece.extend_from_slice(&[r, g, b, u8::MAX]);
        hand_over(&mut piece, out)?;
    }
    out.write_all(&piece)
}

/// An sRGB channel made linear (IEC 61966-2-1).
fn linear(channel: u8) -> u8 {
    let x = f64::from(channel) / 255.0;
    let x = if x <= 0.04045 { x / 12.92 } else { ((x + 0.055) / 1.055).powf(2.4) };
    (x * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_file_has_the_parts_it_announces() {
        let mesh = TriMesh {
            positions: vec![[1e6, 0.0, 0.0], [1e6 + 2.0, 0.0, 0.0], [1e6, 3.0, 0.0]],
            faces: vec![[0, 1, 2]],
            colors: Some(vec![[0, 128, 255]; 3]),
        };
        let mut glb = Vec::new();
        write_glb(&mesh, &mut glb).unwrap();
        let word = |at: usize| u32::from_le_bytes(glb[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&glb[..4], word(4), word(8)), (&b"glTF"[..], 2, glb.len()));
        let text = word(12);
        assert_eq!((&glb[16..20], text % 4), (&b"JSON"[..], 0));
        let document: serde_json::Value = serde_json::from_slice(&glb[20..20 + text]).unwrap();
        let body = 20 + text + 8;
        assert_eq!((&glb[body - 4..body], word(body - 8)), (&b"BIN\0"[..], glb.len() - body));
        let part = |view: usize| {
            let view = &document["bufferViews"][view];
            let at = body + view["byteOffset"].as_u64().unwrap() as usize;
            &glb[at..at + view["byteLength"].as_u64().unwrap() as usize]
        };
        let indices: Vec<u32> = part(0).chunks(4).map(|c| u32::from_le_bytes(c.try_into().unwrap())).collect();
        assert_eq!(indices, [0, 1, 2]);
        let floats: Vec<f32> = part(1).chunks(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect();
        assert_eq!(floats, [-1.0, -1.5, 0.0, 1.0, -1.5, 0.0, -1.0, 1.5, 0.0]);
        assert_eq!(document["nodes"][0]["translation"], json!([1e6 + 1.0, 1.5, 0.0]));
        assert_eq!(part(2)[..4], [0, 55, 255, 255]);
    }

    #[test]
    fn an_empty_mesh_is_refused() {
        let error = write_glb(&TriMesh::default(), &mut Vec::new()).unwrap_err();
        assert_eq!(error.to_string(), "glb holds no empty mesh");
    }
}
