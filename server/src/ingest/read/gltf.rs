//! glTF 2.0 and GLB: the triangles of all nodes of a scene, in place, with the colours of their materials.
//!
//! The document is held in memory; the numbers of a mesh stream from their buffers. The crate `gltf` wants whole buffers, so
//! [`document`] has the few parts that count here.

use std::borrow::Cow;
use std::path::Path;

use glam::{DMat4, DQuat, DVec3};

use super::sink::{Fan, Sink, Strip};
use super::{Format, ReadError, ReadReport, note};
use crate::ingest::raw::RawMesh;

mod accessor;
mod buffers;
mod document;
mod material;
#[cfg(test)]
mod tests;

pub(super) use buffers::Bytes;

use accessor::{Numbers, NumbersReader, Use};
use buffers::Buffers;
use document::{Document, Primitive};
use material::{Materials, Surface};

/// Longest document, in bytes: it is held in memory, data URIs and all. The binary chunk of a GLB is not part of it.
const MAX_DOCUMENT: u64 = 256 << 20;

/// Vertices and corners of all instances for each byte that the file and its buffers have, above the constant: a mesh in a
/// thousand places is common, one that fills the disk from a small file is not.
const MAX_NUMBERS_PER_BYTE: u64 = 16;
const MIN_NUMBERS: u64 = 1 << 24;

/// Extensions without which a document can be read, or that are.
const KNOWN_EXTENSIONS: &[&str] = &["KHR_mesh_quantization", "KHR_texture_transform", "KHR_materials_unlit"];

fn fault(part: impl Into<String>, problem: impl Into<String>) -> ReadError {
    ReadError::Document { part: part.into(), problem: problem.into() }
}

/// Reads a glTF or GLB file.
///
/// Triangles, strips and fans of all nodes of the default scene are carried, with their transforms applied in `f64`; a
/// transform that mirrors turns the faces round. A vertex has the product of `COLOR_0`, the base colour and its texture, if
/// there is any. Buffers and images are in the file, in data URIs, or in files in `directory` and below. Cost is linear in
/// the length of the buffers times the places of a mesh.
///
/// # Errors
/// [`ReadError::Document`] names the part of the document.
pub(super) fn read(
    bytes: &Bytes<'_>,
    directory: Option<&Path>,
    sink: Sink<'_>,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<(RawMesh, ReadReport), ReadError> {
    let (format, json, chunk) = open(bytes)?;
    let document: Document<'_> = serde_json::from_slice(&json).map_err(|error| fault("document", error.to_string()))?;
    if !document.asset.version.0.starts_with("2.") {
        return Err(fault("asset", format!("version {:.8} is not 2", document.asset.version.0)));
    }
    for extension in &document.extensions_required.0 {
        let name = &*extension.0;
        if !KNOWN_EXTENSIONS.contains(&name) && !name.starts_with("KHR_materials_") {
            return Err(fault("extensionsRequired", format!("{name:.40} is not supported")));
        }
    }
    let mut reader = Reader {
        document: &document,
        buffers: Buffers::new(bytes, chunk, directory, &document),
        materials: Materials::new(directory),
        sink,
        file_bytes: bytes.len(),
        numbers: 0,
        uncolored: 0,
        lost: Lost::default(),
    };
    let instances = instances(&document)?;
    for (k, instance) in instances.iter().enumerate() {
        let done = bytes.len() as u128 * k as u128 / instances.len() as u128;
        progress(done as u64, bytes.len());
        reader.mesh(instance)?;
    }
    reader.finish(format)
}

/// The format, the document, and where the binary chunk lies.
type Opened<'a> = (Format, Cow<'a, [u8]>, Option<(u64, u64)>);

fn open<'a>(bytes: &'a Bytes<'_>) -> Result<Opened<'a>, ReadError> {
    const HEADER: u64 = 12;
    let word = |at: u64| -> Result<u32, ReadError> {
        let four = bytes.len().checked_sub(at).filter(|&left| left >= 4);
        let problem = || ReadError::Bytes { byte: bytes.len(), problem: "the file ends within a header".into() };
        let word = bytes.read(at, four.map(|_| 4).ok_or_else(problem)?)?;
        Ok(u32::from_le_bytes(*word.first_chunk().expect("four bytes were asked for")))
    };
    let document = |start: u64, len: u64| -> Result<Cow<'a, [u8]>, ReadError> {
        if len > MAX_DOCUMENT {
            let problem = format!("{len} bytes are over the limit of {MAX_DOCUMENT}; store it as GLB");
            return Err(fault("document", problem));
        }
        Ok(match bytes {
            Bytes::Slice(bytes) => Cow::Borrowed(&bytes[start as usize..(start + len) as usize]),
            _ => Cow::Owned(bytes.read(start, len)?),
        })
    };
    if bytes.len() < 4 || word(0)? != u32::from_le_bytes(*b"glTF") {
        return Ok((Format::Gltf, document(0, bytes.len())?, None));
    }
    let at = |byte: u64, problem: String| ReadError::Bytes { byte, problem };
    if word(4)? != 2 {
        return Err(at(4, format!("version {} of GLB is not 2", word(4)?)));
    }
    let len = u64::from(word(8)?);
    if len > bytes.len() {
        return Err(at(8, format!("the header announces {len} bytes, but the file has {}", bytes.len())));
    }
    // Each chunk has its length and its type before it.
    let chunk = |start: u64| -> Result<Option<(u32, u64, u64)>, ReadError> {
        if start + 8 > len {
            return Ok(None);
        }
        let (chunk_len, kind) = (u64::from(word(start)?), word(start + 4)?);
        if chunk_len > len - start - 8 {
            return Err(at(start, format!("a chunk of {chunk_len} bytes is longer than the rest of the file")));
        }
        Ok(Some((kind, start + 8, chunk_len)))
    };
    let json = match chunk(HEADER)? {
        Some((kind, start, len)) if kind == u32::from_le_bytes(*b"JSON") => (start, len),
        _ => return Err(at(HEADER, "the first chunk is not JSON".into())),
    };
    let binary = chunk(json.0 + json.1.next_multiple_of(4))?;
    let binary = binary.filter(|chunk| chunk.0 == u32::from_le_bytes(*b"BIN\0")).map(|(_, start, len)| (start, len));
    Ok((Format::Glb, document(json.0, json.1)?, binary))
}

/// A mesh in its place.
struct Instance {
    mesh: u32,
    transform: DMat4,
}

/// The meshes of the default scene, or of all trees of nodes if there are no scenes.
fn instances(document: &Document<'_>) -> Result<Vec<Instance>, ReadError> {
    let nodes = &document.nodes.0;
    if nodes.is_empty() {
        let meshes = 0..document.meshes.0.len() as u32;
        return Ok(meshes.map(|mesh| Instance { mesh, transform: DMat4::IDENTITY }).collect());
    }
    let roots: Vec<u32> = match (document.scene, &document.scenes.0[..]) {
        (None, []) => {
            let mut is_child = vec![false; nodes.len()];
            let children = nodes.iter().flat_map(|node| &node.children.0);
            children
                .for_each(|&child| is_child.get_mut(child as usize).into_iter().for_each(|is_child| *is_child = true));
            (0..nodes.len() as u32).filter(|&node| !is_child[node as usize]).collect()
        }
        (scene, scenes) => {
            let scene = scene.unwrap_or(0);
            let found = scenes.get(scene as usize);
            found.ok_or_else(|| fault(format!("scenes[{scene}]"), "there is no such scene"))?.nodes.0.clone()
        }
    };
    let mut instances = Vec::new();
    let mut is_reached = vec![false; nodes.len()];
    let mut open: Vec<(u32, DMat4)> = roots.into_iter().rev().map(|root| (root, DMat4::IDENTITY)).collect();
    while let Some((index, parent)) = open.pop() {
        let part = || format!("nodes[{index}]");
        let node = nodes.get(index as usize).ok_or_else(|| fault(part(), "there is no such node"))?;
        if std::mem::replace(&mut is_reached[index as usize], true) {
            return Err(fault(part(), "it is reached twice, but nodes form trees"));
        }
        let transform = parent * local_transform(node);
        instances.extend(node.mesh.map(|mesh| Instance { mesh, transform }));
        open.extend(node.children.0.iter().rev().map(|&child| (child, transform)));
    }
    Ok(instances)
}

fn local_transform(node: &document::Node) -> DMat4 {
    if let Some(matrix) = &node.matrix {
        return DMat4::from_cols_array(matrix);
    }
    let scale = node.scale.map_or(DVec3::ONE, DVec3::from);
    let rotation = node.rotation.map_or(DQuat::IDENTITY, DQuat::from_array);
    DMat4::from_scale_rotation_translation(scale, rotation, node.translation.map_or(DVec3::ZERO, DVec3::from))
}

/// How much of each kind was left.
#[derive(Default)]
struct Lost {
    points_and_lines: u64,
    normals: u64,
    texture_coordinates: u64,
    other_attributes: u64,
    corners: u64,
    morph_targets: u64,
}

struct Reader<'a, 'w> {
    document: &'a Document<'a>,
    buffers: Buffers<'a>,
    materials: Materials<'a>,
    sink: Sink<'w>,
    /// Of the document's file.
    file_bytes: u64,
    /// Vertices and corners so far.
    numbers: u64,
    /// Vertices without a colour.
    uncolored: u64,
    lost: Lost,
}

impl Reader<'_, '_> {
    fn mesh(&mut self, instance: &Instance) -> Result<(), ReadError> {
        let index = instance.mesh;
        let document = self.document;
        let mesh = document.meshes.0.get(index as usize);
        let mesh = mesh.ok_or_else(|| fault(format!("meshes[{index}]"), "there is no such mesh"))?;
        for (k, primitive) in mesh.primitives.0.iter().enumerate() {
            let part = format!("meshes[{index}].primitives[{k}]");
            self.primitive(primitive, &part, &instance.transform)?;
        }
        Ok(())
    }

    fn primitive(&mut self, primitive: &Primitive, part: &str, transform: &DMat4) -> Result<(), ReadError> {
        match primitive.mode {
            document::TRIANGLES..=6 => {}
            0..document::TRIANGLES => {
                self.lost.points_and_lines += 1;
                return Ok(());
            }
            mode => return Err(fault(part, format!("mode {mode} is unknown"))),
        }
        let Some(positions) = primitive.attributes.get("POSITION") else {
            // Allowed, for extensions that bring their own.
            return Err(fault(part, "it has no positions"));
        };
        let document = self.document;
        let mut numbers = |index, wanted| Numbers::new(index, wanted, document, &mut self.buffers);
        let positions = numbers(positions, Use::Positions)?;
        let indices = primitive.indices.map(|index| numbers(index, Use::Indices)).transpose()?;
        let colors = primitive.attributes.get("COLOR_0").map(|index| numbers(index, Use::Colors)).transpose()?;
        let vertices = positions.count();
        let corners = indices.as_ref().map_or(vertices, Numbers::count);
        self.check_size(part, vertices, corners)?;

        let surface = self.materials.surface(primitive.material, document, &mut self.buffers)?;
        let set = surface.texture_coordinates.and_then(|set| primitive.attributes.get(&format!("TEXCOORD_{set}")));
        let uvs =
            set.map(|index| Numbers::new(index, Use::TextureCoordinates, document, &mut self.buffers)).transpose()?;
        self.note_lost(primitive, vertices);

        let first = self.sink.vertices();
        let buffers = &self.buffers;
        for (what, numbers) in [("COLOR_0", &colors), ("texture coordinates", &uvs)] {
            if numbers.as_ref().is_some_and(|numbers| numbers.count() < vertices) {
                return Err(fault(part, format!("{what} of fewer vertices than there are positions")));
            }
        }
        let uncolored = push_vertices(
            &mut self.sink,
            transform,
            vertices,
            positions.read(buffers),
            colors.map(|colors| colors.read(buffers)),
            uvs.map(|uvs| uvs.read(buffers)),
            &surface,
        )?;
        self.uncolored += uncolored;
        let indices = indices.map(|indices| indices.read(buffers));
        let corners = Corners { part, mode: primitive.mode, first, vertices, corners };
        self.lost.corners += corners.push(indices, is_mirror(transform), &mut self.sink)?;
        Ok(())
    }

    /// Checks what a primitive adds against the length of the file and its buffers.
    fn check_size(&mut self, part: &str, vertices: u64, corners: u64) -> Result<(), ReadError> {
        let bytes = self.file_bytes.saturating_add(self.buffers.bytes_beside());
        let limit = MIN_NUMBERS.saturating_add(bytes.saturating_mul(MAX_NUMBERS_PER_BYTE));
        self.numbers = self.numbers.saturating_add(vertices).saturating_add(corners);
        if self.numbers > limit {
            let problem = format!("up to here, meshes in all their places have more than {limit} vertices and corners");
            return Err(fault(part, format!("{problem}, from {bytes} bytes")));
        }
        Ok(())
    }

    fn note_lost(&mut self, primitive: &Primitive, vertices: u64) {
        let lost = &mut self.lost;
        for name in primitive.attributes.names() {
            match name {
                "POSITION" | "COLOR_0" => {}
                "NORMAL" => lost.normals += vertices,
                _ if name.starts_with("TEXCOORD_") => lost.texture_coordinates += vertices,
                _ => lost.other_attributes += vertices,
            }
        }
        lost.morph_targets += primitive.targets.0.len() as u64;
    }

    fn finish(self, format: Format) -> Result<(RawMesh, ReadReport), ReadError> {
        let vertices = self.sink.vertices();
        if self.sink.triangles() == 0 {
            return Err(ReadError::NoFaces { vertices });
        }
        let mut report = ReadReport::new(format, &self.sink);
        let lost = &self.lost;
        let left = &mut report.not_carried;
        note(left, lost.normals, "normals");
        note(left, lost.texture_coordinates, "texture coordinates");
        note(left, lost.other_attributes, "tangents and other attributes of vertices");
        note(left, lost.points_and_lines, "primitives of points and lines");
        note(left, lost.corners, "corners that complete no triangle");
        note(left, lost.morph_targets, "morph targets");
        note(left, self.document.skins.0.len() as u64, "skins");
        note(left, self.document.animations.0.len() as u64, "animations");
        note(left, self.document.cameras.0.len() as u64, "cameras");
        if self.sink.is_colored() {
            note(left, self.uncolored, "vertices without a colour (white)");
            report.colored = self.uncolored == 0;
        }
        self.materials.report(&mut report);
        Ok((self.sink.finish()?, report))
    }
}

/// Whether the transform turns the faces of a mesh round.
fn is_mirror(transform: &DMat4) -> bool {
    let [x, y, z] = [transform.x_axis, transform.y_axis, transform.z_axis].map(|axis| axis.truncate());
    x.cross(y).dot(z) < 0.0
}

/// Appends the vertices of a primitive and says how many have no colour.
fn push_vertices(
    sink: &mut Sink<'_>,
    transform: &DMat4,
    vertices: u64,
    mut positions: NumbersReader<'_>,
    mut colors: Option<NumbersReader<'_>>,
    mut uvs: Option<NumbersReader<'_>>,
    surface: &Surface,
) -> Result<u64, ReadError> {
    let mut uncolored = 0;
    for _ in 0..vertices {
        let [x, y, z, _] = positions.next()?;
        // Term by term, in the order of the matrix: the last row of a transform is 0 0 0 1.
        let [a, b, c, d] = [transform.x_axis, transform.y_axis, transform.z_axis, transform.w_axis];
        let placed = a.truncate() * x + b.truncate() * y + c.truncate() * z + d.truncate();
        sink.push_vertex(placed.to_array())?;
        let light = colors.as_mut().map(NumbersReader::next).transpose()?.map(|[r, g, b, _]| [r, g, b]);
        let uv = uvs.as_mut().map(NumbersReader::next).transpose()?.map(|[u, v, ..]| [u, v]);
        match surface.color(light, uv) {
            Some(color) => sink.color_last(color)?,
            None => uncolored += 1,
        }
    }
    Ok(uncolored)
}

/// The corners of a primitive.
struct Corners<'p> {
    part: &'p str,
    mode: u32,
    /// Vertices before those of the primitive.
    first: u64,
    vertices: u64,
    corners: u64,
}

impl Corners<'_> {
    /// Appends the triangles, and says how many corners complete none.
    fn push(
        &self,
        mut indices: Option<NumbersReader<'_>>,
        is_mirrored: bool,
        sink: &mut Sink<'_>,
    ) -> Result<u64, ReadError> {
        let (mut fan, mut strip, mut single) = (Fan::new(), Strip::new(), Fan::new());
        for corner in 0..self.corners {
            let index = match &mut indices {
                // An unsigned integer of at most 32 bits, so the conversion is exact.
                Some(indices) => indices.next()?[0] as u64,
                None => corner,
            };
            if index >= self.vertices {
                let problem = format!("corner {corner} names vertex {index} of {}", self.vertices);
                return Err(fault(self.part, problem));
            }
            let vertex = u32::try_from(self.first + index).expect("vertices are at most MAX_VERTICES");
            let face = match self.mode {
                5 => strip.turn(vertex),
                6 => fan.turn(vertex),
                _ => {
                    let face = single.turn(vertex);
                    if face.is_some() {
                        single = Fan::new();
                    }
                    face
                }
            };
            if let Some([a, b, c]) = face {
                sink.push_face(if is_mirrored { [a, c, b] } else { [a, b, c] })?;
            }
        }
        Ok(match self.mode {
            document::TRIANGLES => single.corners,
            _ if self.corners < 3 => self.corners,
            _ => 0,
        })
    }
}
