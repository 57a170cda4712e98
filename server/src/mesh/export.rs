//! Meshes out: PLY, OBJ, STL and GLB.
//!
//! Writers need no buffering of their own from the caller: they hand over large pieces.

use std::fmt::Write as _;
use std::io::{self, Write};

use super::TriMesh;

mod glb;

pub use glb::write_glb;

/// A file format to write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExportFormat {
    /// Binary PLY with `double` coordinates: nothing is lost.
    Ply,
    /// Wavefront OBJ: nothing is lost.
    Obj,
    /// Binary STL: no colours, no shared vertices, `f32`.
    Stl,
    /// Binary glTF: `f32` about the middle of the box.
    Glb,
}

impl ExportFormat {
    /// The format that a file's extension names.
    pub fn of(path: &std::path::Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        let formats = [("ply", Self::Ply), ("obj", Self::Obj), ("stl", Self::Stl), ("glb", Self::Glb)];
        formats.into_iter().find(|(name, _)| *name == extension).map(|(_, format)| format)
    }
}

/// Writes a mesh in a format.
///
/// # Errors
/// Those of the format's writer.
pub fn write_as(format: ExportFormat, mesh: &TriMesh, out: &mut impl Write) -> io::Result<()> {
    match format {
        ExportFormat::Ply => write_ply(mesh, &PlyOptions::default(), out),
        ExportFormat::Obj => write_obj(mesh, out),
        ExportFormat::Stl => write_stl(mesh, out),
        ExportFormat::Glb => write_glb(mesh, out),
    }
}

/// Type of the coordinates in a PLY file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PlyCoordinates {
    /// `double`: positions survive exactly.
    #[default]
    Float64,
    /// `float`: half the size, rounded to 24 bits. Enough for what came as `float` in the first place.
    Float32,
}

/// How [`write_ply`] writes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PlyOptions {
    /// Type of the coordinates.
    pub coordinates: PlyCoordinates,
    /// Comment lines of the header, such as the licence; line breaks in them become spaces.
    pub comments: Vec<String>,
}

/// Bytes that are collected before they are handed over.
const PIECE: usize = 1 << 16;

/// Writes binary little-endian PLY: `x`, `y`, `z`, then `red`, `green`, `blue` as `uchar` if there are colours, and
/// faces as `list uchar uint vertex_indices`.
///
/// # Errors
/// Those of `out`; part of the file is then written.
pub fn write_ply(mesh: &TriMesh, options: &PlyOptions, out: &mut impl Write) -> io::Result<()> {
    let scalar = match options.coordinates {
        PlyCoordinates::Float64 => "double",
        PlyCoordinates::Float32 => "float",
    };
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    for comment in &options.comments {
        header += &format!("comment {}\n", comment.replace(['\n', '\r'], " "));
    }
    header += &format!("element vertex {}\n", mesh.positions.len());
    for axis in ["x", "y", "z"] {
        header += &format!("property {scalar} {axis}\n");
    }
    if mesh.colors.is_some() {
        header += "property uchar red\nproperty uchar green\nproperty uchar blue\n";
    }
    header += &format!("element face {}\nproperty list uchar uint vertex_indices\nend_header\n", mesh.faces.len());
    let mut piece = header.into_bytes();
    for (v, position) in mesh.positions.iter().enumerate() {
        for &coordinate in position {
            match options.coordinates {
                PlyCoordinates::Float64 => piece.extend_from_slice(&coordinate.to_le_bytes()),
                // Rounding is what the option asks for.
                PlyCoordinates::Float32 => piece.extend_from_slice(&(coordinate as f32).to_le_bytes()),
            }
        }
        if let Some(colors) = &mesh.colors {
            piece.extend_from_slice(&colors[v]);
        }
        hand_over(&mut piece, out)?;
    }
    for face in &mesh.faces {
        piece.push(3);
        face.iter().for_each(|corner| piece.extend_from_slice(&corner.to_le_bytes()));
        hand_over(&mut piece, out)?;
    }
    out.write_all(&piece)
}

/// Writes OBJ: `v x y z`, with `r g b` in 0..=1 if there are colours, and `f a b c`.
///
/// Numbers are the shortest that read back as the same `f64`, and colours read back as the same byte.
///
/// # Errors
/// Those of `out`; part of the file is then written.
pub fn write_obj(mesh: &TriMesh, out: &mut impl Write) -> io::Result<()> {
    const CANNOT_FAIL: &str = "writing to a string cannot fail";
    let mut text = String::new();
    for (v, [x, y, z]) in mesh.positions.iter().enumerate() {
        write!(text, "v {x:?} {y:?} {z:?}").expect(CANNOT_FAIL);
        if let Some(colors) = &mesh.colors {
            let [r, g, b] = colors[v].map(|channel| f64::from(channel) / 255.0);
            write!(text, " {r:.4} {g:.4} {b:.4}").expect(CANNOT_FAIL);
        }
        text.push('\n');
        if text.len() >= PIECE {
            out.write_all(text.as_bytes())?;
            text.clear();
        }
    }
    for [a, b, c] in &mesh.faces {
        // From 1, which may be one more than u32 holds.
        let [a, b, c] = [a, b, c].map(|&corner| u64::from(corner) + 1);
        writeln!(text, "f {a} {b} {c}").expect(CANNOT_FAIL);
        if text.len() >= PIECE {
            out.write_all(text.as_bytes())?;
            text.clear();
        }
    }
    out.write_all(text.as_bytes())
}

/// Writes binary STL: for each triangle a unit normal (0 for one without area) and three corners, as `f32`.
///
/// STL has neither shared vertices nor colours: both are lost.
///
/// # Errors
/// [`io::ErrorKind::InvalidInput`] above `u32::MAX` triangles, else those of `out`; part of the file is then written.
pub fn write_stl(mesh: &TriMesh, out: &mut impl Write) -> io::Result<()> {
    let count = u32::try_from(mesh.faces.len())
        .map_err(|_| io::Error::new(io::ErrorKind::InvalidInput, "stl holds at most 4294967295 triangles"))?;
    // Must not start with `solid`, which would make it text.
    let mut piece = b"binary STL".to_vec();
    piece.resize(80, b' ');
    piece.extend_from_slice(&count.to_le_bytes());
    for face in &mesh.faces {
        let corners = face.map(|v| glam::DVec3::from(mesh.positions[v as usize]));
        let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize_or_zero();
        for vector in [normal, corners[0], corners[1], corners[2]] {
            vector.to_array().iter().for_each(|&c| piece.extend_from_slice(&(c as f32).to_le_bytes()));
        }
        piece.extend_from_slice(&[0, 0]);
        hand_over(&mut piece, out)?;
    }
    out.write_all(&piece)
}

#[inline]
fn hand_over(piece: &mut Vec<u8>, out: &mut impl Write) -> io::Result<()> {
    if piece.len() >= PIECE {
        out.write_all(piece)?;
        piece.clear();
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(vertices: u32) -> TriMesh {
        let mut random = fastrand::Rng::with_seed(1);
        TriMesh {
            positions: (0..vertices).map(|_| std::array::from_fn(|_| (random.f64() - 0.5) * 1e7)).collect(),
            faces: (2..vertices).map(|v| [v - 2, v - 1, v]).collect(),
            colors: Some((0..vertices).map(|v| [v as u8, (v / 3) as u8, 255 - v as u8]).collect()),
        }
    }

    /// Several pieces, so that handing over is tried too.
    const VERTICES: u32 = 5000;

    #[test]
    fn stl_has_fifty_bytes_a_triangle_and_normals_that_point_out() {
        let mesh = TriMesh {
            positions: vec![[0.0; 3], [2.0, 0.0, 0.0], [0.0, 3.0, 0.0]],
            faces: vec![[0, 1, 2], [0, 1, 1]],
            colors: None,
        };
        let mut stl = Vec::new();
        write_stl(&mesh, &mut stl).unwrap();
        assert_eq!(stl.len(), 84 + 2 * 50);
        assert_eq!(stl[80..84], 2_u32.to_le_bytes());
        let floats: Vec<f32> = stl[84..132].chunks(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect();
        assert_eq!(floats, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 3.0, 0.0]);
        assert_eq!(stl[134..146], [0; 12]);
    }

    #[test]
    fn a_full_disk_is_an_error() {
        let mesh = sample(VERTICES);
        let mut room = [0; 100_000];
        assert!(write_ply(&mesh, &PlyOptions::default(), &mut room.as_mut_slice()).is_err());
        assert!(write_obj(&mesh, &mut room.as_mut_slice()).is_err());
        assert!(write_stl(&mesh, &mut room.as_mut_slice()).is_err());
    }
}
