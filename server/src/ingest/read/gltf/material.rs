//! Base colours: what a material and its texture say about the colour of a vertex.

use std::path::Path;
use std::rc::Rc;

use super::super::texture::color::{byte, linear_from_srgb, srgb_from_linear};
use super::super::texture::{Gallery, Texture, Wrap, open_beside, read_encoded, shown};
use super::super::{ReadError, ReadReport};
use super::buffers::{Buffers, decode_data_uri, decode_percent};
use super::document::{Document, Image, TextureRef};
use super::fault;

/// The surface of a primitive.
#[derive(Debug, Default)]
pub(super) struct Surface {
    /// Linear light, `None` for white.
    factor: Option<[f64; 3]>,
    texture: Option<(Rc<Texture>, [Wrap; 2])>,
    /// Texture coordinates are multiplied by the first, then moved by the second.
    placement: Option<[[f64; 2]; 2]>,
    /// The set of texture coordinates that the texture wants.
    pub(super) texture_coordinates: Option<u32>,
}

impl Surface {
    /// Colour of a vertex with its own linear light and its texture coordinates, or `None` if nothing gives it any.
    #[inline]
    pub(super) fn color(&self, light: Option<[f64; 3]>, uv: Option<[f64; 2]>) -> Option<[u8; 3]> {
        let texel = match (&self.texture, uv) {
            (Some((texture, wrap)), Some(uv)) => {
                let [scale, offset] = self.placement.unwrap_or([[1.0; 2], [0.0; 2]]);
                Some(texture.sample([uv[0] * scale[0] + offset[0], uv[1] * scale[1] + offset[1]], *wrap))
            }
            _ => None,
        };
        match (texel, self.factor, light) {
            (None, None, None) => None,
            // Bytes as they are, without the way to light and back.
            (Some(texel), None, None) => Some(texel.map(byte)),
            (texel, factor, light) => {
                let texel = texel.map_or([1.0; 3], |texel| texel.map(linear_from_srgb));
                let (factor, light) = (factor.unwrap_or([1.0; 3]), light.unwrap_or([1.0; 3]));
                Some(std::array::from_fn(|k| srgb_from_linear(texel[k] * factor[k] * light[k])))
            }
        }
    }
}

/// The materials of a document, and the textures that they use.
pub(super) struct Materials<'a> {
    directory: Option<&'a Path>,
    gallery: Gallery,
    factors: bool,
}

impl<'a> Materials<'a> {
    pub(super) fn new(directory: Option<&'a Path>) -> Self {
        Self { directory, gallery: Gallery::new(), factors: false }
    }

    /// The surface of a primitive with this material. A texture that cannot be had becomes a note in the report.
    ///
    /// # Errors
    /// [`ReadError::Document`] for a material that does not exist.
    pub(super) fn surface(
        &mut self,
        material: Option<u32>,
        document: &Document<'_>,
        buffers: &mut Buffers<'_>,
    ) -> Result<Surface, ReadError> {
        let Some(index) = material else { return Ok(Surface::default()) };
        let material = document.materials.0.get(index as usize);
        let material = material.ok_or_else(|| fault(format!("materials[{index}]"), "there is no such material"))?;
        let Some(pbr) = &material.pbr_metallic_roughness else { return Ok(Surface::default()) };
        let factor = pbr.base_color_factor.map(|[r, g, b, _]| [r, g, b]).filter(|&rgb| rgb != [1.0; 3]);
        self.factors |= factor.is_some();
        let mut surface = Surface { factor, ..Surface::default() };
        if let Some(reference) = &pbr.base_color_texture {
            self.set_texture(&mut surface, reference, document, buffers);
        }
        Ok(surface)
    }

    fn set_texture(
        &mut self,
        surface: &mut Surface,
        reference: &TextureRef,
        document: &Document<'_>,
        buffers: &mut Buffers<'_>,
    ) {
        let mut set = reference.tex_coord;
        if let Some(transform) = reference.extensions.transform {
            if transform.rotation != 0.0 {
                self.gallery.note("rotations of texture coordinates".into());
            }
            surface.placement = Some([transform.scale.unwrap_or([1.0; 2]), transform.offset]);
            set = transform.tex_coord.unwrap_or(set);
        }
        let Some(texture) = document.textures.0.get(reference.index as usize) else {
            self.gallery.note(format!("texture {}, which does not exist", reference.index));
            return;
        };
        let image = texture.source.and_then(|source| Some((source, document.images.0.get(source as usize)?)));
        let Some((source, image)) = image else {
            self.gallery.note(format!("texture {} without an image that can be read", reference.index));
            return;
        };
        let name = match &image.uri {
            Some(uri) if !uri.0.starts_with("data:") => decode_percent(&uri.0),
            _ => format!("images[{source}]"),
        };
        let directory = self.directory;
        let loaded = self.gallery.get(&name, || encoded(image, directory, document, buffers));
        let sampler = texture.sampler.and_then(|sampler| document.samplers.0.get(sampler as usize));
        let wrap = |code: Option<u32>| match code {
            Some(33071) => Wrap::Clamp,
            Some(33648) => Wrap::Mirror,
            _ => Wrap::Repeat,
        };
        let wraps = sampler.map_or([Wrap::Repeat; 2], |sampler| [wrap(sampler.wrap_s), wrap(sampler.wrap_t)]);
        surface.texture = loaded.map(|texture| (texture, wraps));
        surface.texture_coordinates = surface.texture.is_some().then_some(set);
    }

    /// Adds what was baked and what could not be.
    pub(super) fn report(self, report: &mut ReadReport) {
        let (missing, baked) = self.gallery.into_report();
        if !baked.is_empty() {
            const SHOWN: usize = 4;
            let names: Vec<String> = baked.iter().take(SHOWN).map(|name| shown(name)).collect();
            let more = baked.len().saturating_sub(SHOWN);
            let more = if more > 0 { format!(" and {more} more textures") } else { String::new() };
            report.notes.push(format!("vertex colours baked from {}{more}", names.join(", ")));
        }
        if self.factors {
            report.notes.push("vertex colours multiplied by the base colours of materials".into());
        }
        report.not_carried.extend(missing);
    }
}

/// The bytes of an image file.
fn encoded(
    image: &Image<'_>,
    directory: Option<&Path>,
    document: &Document<'_>,
    buffers: &mut Buffers<'_>,
) -> Result<Vec<u8>, String> {
    if let Some(view) = image.buffer_view {
        let view = buffers.open(view, document).map_err(|error| error.to_string())?;
        let bytes = buffers.of(view).input(view.start, view.len);
        return read_encoded(bytes, view.len);
    }
    let uri = image.uri.as_ref().ok_or("it has neither an address nor a view")?;
    if uri.0.starts_with("data:") {
        return decode_data_uri(&uri.0);
    }
    let (file, len) = open_beside(directory, &decode_percent(&uri.0))?;
    read_encoded(file, len)
}
