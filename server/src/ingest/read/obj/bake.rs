//! Colours of materials and textures, baked into the vertices of an OBJ while its faces pass by.
//!
//! OBJ numbers positions and texture coordinates apart, so both are looked up at random: 8 bytes for each texture coordinate
//! and 4 for each vertex are held, from the first material library on and only if there is one to be had.

use std::collections::BTreeMap;
use std::path::Path;
use std::rc::Rc;

use super::super::input::{Input, Words};
use super::super::number::parse_f64;
use super::super::sink::WHITE;
use super::super::texture::color::byte;
use super::super::texture::{Gallery, Texture, open_beside, shown};
use super::super::{ReadError, ReadReport, note};
use super::material::{MAX_MATERIALS, MAX_NAME, Material, read_library};
use crate::ingest::raw::RawMesh;
use crate::ingest::spill::{Spill, SpillError, Workspace};

/// Most material libraries of one mesh.
const MAX_LIBRARIES: usize = 64;

/// Where the colour of a vertex comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Origin {
    /// White, unless others follow.
    #[default]
    Nothing,
    /// Its `v` statement.
    Own,
    Material,
    Texture,
}

#[derive(Clone, Copy, Debug, Default)]
struct Paint {
    /// Of a material or a texture.
    color: [u8; 3],
    origin: Origin,
}

pub(super) struct Bake<'d> {
    directory: Option<&'d Path>,
    libraries: Vec<Vec<u8>>,
    materials: Vec<Material>,
    /// The first material of each name.
    by_name: BTreeMap<Vec<u8>, usize>,
    /// Material of the faces that follow.
    current: Option<usize>,
    /// Its texture, once a face asked for it.
    texture: Option<Option<Rc<Texture>>>,
    gallery: Gallery,
    /// Texture coordinates, the first of which has the index `uvs_before`.
    uvs: Vec<[f32; 2]>,
    uvs_before: u64,
    /// Of the vertices that a face named so far, or that have a colour of their own.
    paints: Vec<Paint>,
    uses: u64,
    unknown_materials: u64,
    corners_before_their_vertex: u64,
    corners_without_coordinates: u64,
}

impl<'d> Bake<'d> {
    pub(super) fn new(directory: Option<&'d Path>) -> Self {
        Self {
            directory,
            libraries: Vec::new(),
            materials: Vec::new(),
            by_name: BTreeMap::new(),
            current: None,
            texture: None,
            gallery: Gallery::new(),
            uvs: Vec::new(),
            uvs_before: 0,
            paints: Vec::new(),
            uses: 0,
            unknown_materials: 0,
            corners_before_their_vertex: 0,
            corners_without_coordinates: 0,
        }
    }

    /// Whether there are materials to bake.
    #[inline]
    pub(super) fn is_on(&self) -> bool {
        !self.materials.is_empty()
    }

    /// A material library, after `vertices`, of which `colored` have a colour of their own. The name may have spaces in it; if there is no such file, the words are names of their own.
    pub(super) fn library(&mut self, names: &[u8], vertices: u64, colored: u64) {
        let whole = [names];
        let exists = open_beside(self.directory, &String::from_utf8_lossy(names)).is_ok();
        let words: Vec<&[u8]> = if exists { whole.to_vec() } else { Words(names).take(MAX_LIBRARIES).collect() };
        for name in words {
            let name = &name[..name.len().min(MAX_NAME)];
            if self.libraries.iter().any(|library| library == name) {
                continue;
            }
            if self.libraries.len() == MAX_LIBRARIES {
                self.gallery.note(format!("material libraries beyond the first {MAX_LIBRARIES}"));
                return;
            }
            self.libraries.push(name.to_vec());
            let name = String::from_utf8_lossy(name);
            if let Err(problem) = self.read_library(&name) {
                self.gallery.note(format!("materials from {}: {problem}", shown(&name)));
            }
        }
        if self.is_on() && self.paints.is_empty() && colored > 0 {
            // Vertices without a colour among coloured ones were made white, which is a colour.
            self.paints.resize(vertices as usize, Paint { origin: Origin::Own, ..Paint::default() });
        }
    }

    fn read_library(&mut self, name: &str) -> Result<(), String> {
        let (file, len) = open_beside(self.directory, name)?;
        let from = self.materials.len();
        let fit = read_library(&mut Input::new(file, len), &mut self.materials).map_err(|error| error.to_string())?;
        for (index, material) in self.materials.iter().enumerate().skip(from) {
            self.by_name.entry(material.name.clone()).or_insert(index);
        }
        if fit { Ok(()) } else { Err(format!("more than {MAX_MATERIALS} materials")) }
    }

    pub(super) fn use_material(&mut self, name: &[u8]) {
        self.uses += 1;
        let material = self.by_name.get(&name[..name.len().min(MAX_NAME)]).copied();
        if self.is_on() && material.is_none() {
            self.unknown_materials += 1;
        }
        if material != self.current {
            (self.current, self.texture) = (material, None);
        }
    }

    /// A `vt` statement.
    #[inline]
    pub(super) fn texture_coordinate(&mut self, mut words: Words<'_>) {
        if !self.is_on() {
            self.uvs_before += 1;
            return;
        }
        let mut coordinate = || words.next().and_then(parse_f64).unwrap_or(0.0);
        // Texels are far coarser than f32.
        self.uvs.push([coordinate() as f32, coordinate() as f32]);
    }

    /// Vertex `index` came with a colour.
    #[inline]
    pub(super) fn has_color(&mut self, index: u64) {
        if self.is_on() {
            self.paint(index as usize).origin = Origin::Own;
        }
    }

    /// The paint of a vertex that exists.
    fn paint(&mut self, vertex: usize) -> &mut Paint {
        if self.paints.len() <= vertex {
            self.paints.resize(vertex + 1, Paint::default());
        }
        &mut self.paints[vertex]
    }

    /// A corner of a face: a vertex, of `vertices` that are known, and the index of a texture coordinate as it is written,
    /// of `coordinates` that came before.
    pub(super) fn corner(&mut self, vertex: u32, vertices: u64, coordinate: Option<i64>, coordinates: u64) {
        let Some(material) = self.current else { return };
        if u64::from(vertex) >= vertices {
            // Room for it cannot be taken on the word of an index.
            self.corners_before_their_vertex += 1;
            return;
        }
        let vertex = vertex as usize;
        let painted = self.paint(vertex).origin;
        if painted == Origin::Texture {
            return;
        }
        let material = &self.materials[material];
        if let Some(map) = &material.map {
            let gallery = &mut self.gallery;
            let texture = self.texture.get_or_insert_with(|| gallery.beside(self.directory, &map.file));
            if let Some(texture) = texture {
                let index = match coordinate {
                    Some(index) if index < 0 => coordinates.checked_add_signed(index),
                    Some(index) => u64::try_from(index - 1).ok(),
                    None => None,
                };
                let index = index.and_then(|index| index.checked_sub(self.uvs_before));
                let uv = index.and_then(|index| self.uvs.get(usize::try_from(index).ok()?));
                let Some(&[u, v]) = uv else {
                    self.corners_without_coordinates += 1;
                    return;
                };
                let uv = [f64::from(u) * map.scale[0] + map.offset[0], f64::from(v) * map.scale[1] + map.offset[1]];
                // Texture coordinates grow upwards.
                let color = texture.sample([uv[0], 1.0 - uv[1]], [map.wrap; 2]).map(byte);
                self.paints[vertex] = Paint { color, origin: Origin::Texture };
                return;
            }
        }
        if let (Some(color), Origin::Nothing) = (material.color, painted) {
            self.paints[vertex] = Paint { color, origin: Origin::Material };
        }
    }

    /// Puts the colours into the mesh, of whose vertices `own_colors` have one of their own, and into the report.
    pub(super) fn finish(
        self,
        mut mesh: RawMesh,
        own_colors: u64,
        workspace: &Workspace,
        report: &mut ReadReport,
    ) -> Result<RawMesh, ReadError> {
        let vertices = mesh.positions.len();
        let is_on = self.is_on();
        let count = |origin| self.paints.iter().filter(|paint| paint.origin == origin).count() as u64;
        let (textured, plain) = (count(Origin::Texture), count(Origin::Material));
        let colored = if is_on { count(Origin::Own) + textured + plain } else { own_colors };
        if textured + plain > 0 {
            mesh.colors = Some(painted(&mesh, &self.paints, workspace)?);
        }
        report.colored = colored == vertices;
        let (missing, baked) = self.gallery.into_report();
        if textured > 0 {
            const SHOWN: usize = 4;
            let names: Vec<String> = baked.iter().take(SHOWN).map(|name| shown(name)).collect();
            let more = baked.len().saturating_sub(SHOWN);
            report.notes.push(format!(
                "{textured} vertex colours baked from {}{}; where a vertex has several texture coordinates, the first counts",
                names.join(", "),
                if more > 0 { format!(" and {more} more textures") } else { String::new() }
            ));
        }
        note(&mut report.notes, plain, "vertex colours taken from materials");
        let left = &mut report.not_carried;
        if is_on {
            note(left, self.unknown_materials, "uses of a material that no library has");
        } else {
            note(left, self.uses, "uses of a material");
        }
        note(left, self.corners_without_coordinates, "corners with a texture and without texture coordinates");
        note(left, self.corners_before_their_vertex, "materials of corners before their vertex");
        if colored > 0 {
            note(left, vertices - colored, "vertices without a colour (white)");
        }
        left.extend(missing);
        Ok(mesh)
    }
}

/// The colours of the mesh with those of `paints` over them.
fn painted(mesh: &RawMesh, paints: &[Paint], workspace: &Workspace) -> Result<Spill<[u8; 3]>, SpillError> {
    const BLOCK: u64 = 1 << 16;
    let vertices = mesh.positions.len();
    let mut out = workspace.spill();
    let mut block = Vec::new();
    let mut at = 0;
    while at < vertices {
        let end = vertices.min(at + BLOCK);
        match &mesh.colors {
            Some(colors) => colors.read_into(at..end, &mut block)?,
            None => {
                block.clear();
                block.resize((end - at) as usize, WHITE);
            }
        }
        let here = paints.get(at as usize..).unwrap_or_default();
        for (color, paint) in block.iter_mut().zip(here) {
            if matches!(paint.origin, Origin::Material | Origin::Texture) {
                *color = paint.color;
            }
        }
        out.push(&block)?;
        at = end;
    }
    out.finish()
}
