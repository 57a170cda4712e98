//! The received mesh as a PLY file.

use std::io::{self, Write};

use lodestream_protocol::mesh::Replica;
use lodestream_protocol::message::ModelInfo;

/// Marks a slot without a vertex.
const NO_VERTEX: u32 = u32::MAX;

/// Writes the mesh as binary little-endian PLY: double positions in model units, byte colours if the model has them, one
/// vertex per vertex of the replica in order of slots, triangles in order of face slots.
///
/// Positions are computed from lattice points alone, so equal lattice points give equal doubles in every file of a model.
///
/// # Errors
/// Those of `out`.
pub fn write_ply(out: &mut impl Write, replica: &Replica, model: &ModelInfo) -> io::Result<()> {
    writeln!(out, "ply\nformat binary_little_endian 1.0")?;
    let [x, y, z] = model.lattice.origin;
    writeln!(
        out,
        "comment lattice origin {x:?} {y:?} {z:?} step {:?} bits {}",
        model.lattice.step, model.lattice.bits
    )?;
    writeln!(out, "element vertex {}", replica.vertex_count())?;
    writeln!(out, "property double x\nproperty double y\nproperty double z")?;
    if model.has_colors {
        writeln!(out, "property uchar red\nproperty uchar green\nproperty uchar blue")?;
    }
    writeln!(out, "element face {}", replica.triangle_count())?;
    writeln!(out, "property list uchar int vertex_indices\nend_header")?;

    let mut index_of = vec![NO_VERTEX; replica.slot_end() as usize];
    for (index, slot) in (0..).zip(replica.vertices().iter()) {
        index_of[slot as usize] = index;
        for coordinate in model.lattice.position(replica.positions()[slot as usize]) {
            out.write_all(&coordinate.to_le_bytes())?;
        }
        if model.has_colors {
            out.write_all(&replica.colors()[slot as usize])?;
        }
    }
    // A face slot without a face repeats a corner, which no face does.
    for corners in replica.corners().filter(|corners| corners[0] != corners[1]) {
        out.write_all(&[3])?;
        for corner in corners {
            out.write_all(&index_of[corner as usize].to_le_bytes())?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use lodestream_protocol::ids::ViewSeq;

    use super::*;
    use crate::fake_server::FakeServer;

    #[test]
    fn the_file_holds_exactly_the_replica() {
        let mut server = FakeServer::new();
        server.batch(ViewSeq(1), 4);
        server.batch_message(ViewSeq(1), true, 2); // leaves free slots
        for has_colors in [true, false] {
            let model = ModelInfo { has_colors, ..server.model() };
            let mut file = Vec::new();
            write_ply(&mut file, server.replica(), &model).unwrap();
            let end = file.windows(11).position(|bytes| bytes == b"end_header\n").unwrap() + 11;
            let header = String::from_utf8(file[..end].to_vec()).unwrap();
            let (vertices, faces) = (server.replica().vertex_count(), server.replica().triangle_count());
            assert!(header.starts_with("ply\nformat binary_little_endian 1.0\n"));
            assert!(header.contains("comment lattice origin -10.0 0.0 5.0 step 0.5 bits 12\n"));
            assert!(header.contains(&format!("element vertex {vertices}\nproperty double x\n")));
            assert!(header.contains(&format!("element face {faces}\n")));
            assert_eq!(header.contains("uchar red"), has_colors);

            let stride = if has_colors { 27 } else { 24 };
            let body = &file[end..];
            assert_eq!(body.len(), vertices as usize * stride + faces as usize * 13);
            // Vertex 1 is base slot 1, at lattice (900, 0, 0).
            let x = f64::from_le_bytes(body[stride..stride + 8].try_into().unwrap());
            assert_eq!(x, -10.0 + 900.0 * 0.5);
            for face in body[vertices as usize * stride..].chunks(13) {
                assert_eq!(face[0], 3);
                let corner = |k: usize| u32::from_le_bytes(face[1 + 4 * k..][..4].try_into().unwrap());
                assert!((0..3).all(|k| corner(k) < vertices && corner(k) != corner((k + 1) % 3)));
            }
        }
    }
}
