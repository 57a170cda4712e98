//! The parts of a glTF 2.0 document that a mesh needs, as they are written; nothing is checked but types and counts.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;
use std::marker::PhantomData;

use serde::de::{Deserialize, Deserializer, SeqAccess, Visitor};

/// Most entries of any array of the document, so that a short text cannot ask for much memory.
pub(super) const MAX_ENTRIES: usize = 1 << 18;

/// A text that is borrowed from the document where it has no escapes: addresses may hold whole files.
#[derive(Debug, serde::Deserialize)]
pub(super) struct Text<'a>(#[serde(borrow)] pub(super) Cow<'a, str>);

/// An array of at most [`MAX_ENTRIES`].
#[derive(Debug)]
pub(super) struct Entries<T>(pub(super) Vec<T>);

impl<T> Default for Entries<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<'de, T: Deserialize<'de>> Deserialize<'de> for Entries<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Visit<T>(PhantomData<T>);
        impl<'de, T: Deserialize<'de>> Visitor<'de> for Visit<T> {
            type Value = Entries<T>;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "an array of at most {MAX_ENTRIES} entries")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut entries: A) -> Result<Self::Value, A::Error> {
                let mut out = Vec::new();
                while let Some(entry) = entries.next_element()? {
                    if out.len() == MAX_ENTRIES {
                        return Err(serde::de::Error::invalid_length(out.len() + 1, &self));
                    }
                    out.push(entry);
                }
                Ok(Entries(out))
            }
        }
        deserializer.deserialize_seq(Visit(PhantomData))
    }
}

#[derive(Debug, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Document<'a> {
    #[serde(borrow)]
    pub(super) asset: Asset<'a>,
    #[serde(borrow, default)]
    pub(super) extensions_required: Entries<Text<'a>>,
    pub(super) scene: Option<u32>,
    #[serde(default)]
    pub(super) scenes: Entries<Scene>,
    #[serde(default)]
    pub(super) nodes: Entries<Node>,
    #[serde(default)]
    pub(super) meshes: Entries<Mesh>,
    #[serde(default)]
    pub(super) accessors: Entries<Accessor>,
    #[serde(default)]
    pub(super) buffer_views: Entries<BufferView>,
    #[serde(borrow, default)]
    pub(super) buffers: Entries<Buffer<'a>>,
    #[serde(default)]
    pub(super) materials: Entries<Material>,
    #[serde(default)]
    pub(super) textures: Entries<Texture>,
    #[serde(borrow, default)]
    pub(super) images: Entries<Image<'a>>,
    #[serde(default)]
    pub(super) samplers: Entries<Sampler>,
    #[serde(default)]
    pub(super) animations: Entries<serde::de::IgnoredAny>,
    #[serde(default)]
    pub(super) skins: Entries<serde::de::IgnoredAny>,
    #[serde(default)]
    pub(super) cameras: Entries<serde::de::IgnoredAny>,
}

#[derive(Debug, serde::Deserialize)]
pub(super) struct Asset<'a> {
    #[serde(borrow)]
    pub(super) version: Text<'a>,
}

#[derive(Debug, serde::Deserialize)]
pub(super) struct Scene {
    #[serde(default)]
    pub(super) nodes: Entries<u32>,
}

#[derive(Debug, serde::Deserialize)]
pub(super) struct Node {
    pub(super) mesh: Option<u32>,
    #[serde(default)]
    pub(super) children: Entries<u32>,
    pub(super) matrix: Option<Box<[f64; 16]>>,
    pub(super) translation: Option<[f64; 3]>,
    pub(super) rotation: Option<[f64; 4]>,
    pub(super) scale: Option<[f64; 3]>,
}

#[derive(Debug, serde::Deserialize)]
pub(super) struct Mesh {
    pub(super) primitives: Entries<Primitive>,
}

#[derive(Debug, serde::Deserialize)]
pub(super) struct Primitive {
    pub(super) attributes: Attributes,
    pub(super) indices: Option<u32>,
    pub(super) material: Option<u32>,
    #[serde(default = "triangles")]
    pub(super) mode: u32,
    #[serde(default)]
    pub(super) targets: Entries<serde::de::IgnoredAny>,
}

/// The mode of a primitive of single triangles.
pub(super) const TRIANGLES: u32 = 4;

fn triangles() -> u32 {
    TRIANGLES
}

/// Accessors by the names of what they hold.
#[derive(Debug, Default, serde::Deserialize)]
#[serde(transparent)]
pub(super) struct Attributes(BTreeMap<String, u32>);

impl Attributes {
    pub(super) fn get(&self, name: &str) -> Option<u32> {
        self.0.get(name).copied()
    }

    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(String::as_str)
    }
}

#[derive(Debug, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Accessor {
    pub(super) buffer_view: Option<u32>,
    #[serde(default)]
    pub(super) byte_offset: u64,
    pub(super) component_type: u32,
    #[serde(default)]
    pub(super) normalized: bool,
    pub(super) count: u64,
    #[serde(rename = "type")]
    pub(super) shape: Shape,
    pub(super) sparse: Option<Box<Sparse>>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub(super) enum Shape {
    Scalar,
    Vec2,
    Vec3,
    Vec4,
    Mat2,
    Mat3,
    Mat4,
}

#[derive(Debug, serde::Deserialize)]
pub(super) struct Sparse {
    pub(super) count: u64,
    pub(super) indices: SparseIndices,
    pub(super) values: SparseValues,
}

#[derive(Debug, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct SparseIndices {
    pub(super) buffer_view: u32,
    #[serde(default)]
    pub(super) byte_offset: u64,
    pub(super) component_type: u32,
}

#[derive(Debug, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct SparseValues {
    pub(super) buffer_view: u32,
    #[serde(default)]
    pub(super) byte_offset: u64,
}

#[derive(Debug, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct BufferView {
    pub(super) buffer: u32,
    #[serde(default)]
    pub(super) byte_offset: u64,
    pub(super) byte_length: u64,
    pub(super) byte_stride: Option<u64>,
}

#[derive(Debug, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Buffer<'a> {
    #[serde(borrow)]
    pub(super) uri: Option<Text<'a>>,
    pub(super) byte_length: u64,
}

#[derive(Debug, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Material {
    pub(super) pbr_metallic_roughness: Option<Box<Pbr>>,
}

#[derive(Debug, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Pbr {
    pub(super) base_color_factor: Option<[f64; 4]>,
    pub(super) base_color_texture: Option<TextureRef>,
}

#[derive(Debug, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct TextureRef {
    pub(super) index: u32,
    #[serde(default)]
    pub(super) tex_coord: u32,
    #[serde(default)]
    pub(super) extensions: TextureExtensions,
}

#[derive(Debug, Default, serde::Deserialize)]
pub(super) struct TextureExtensions {
    #[serde(rename = "KHR_texture_transform")]
    pub(super) transform: Option<TextureTransform>,
}

#[derive(Clone, Copy, Debug, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct TextureTransform {
    #[serde(default)]
    pub(super) offset: [f64; 2],
    #[serde(default)]
    pub(super) rotation: f64,
    pub(super) scale: Option<[f64; 2]>,
    pub(super) tex_coord: Option<u32>,
}

#[derive(Debug, serde::Deserialize)]
pub(super) struct Texture {
    pub(super) sampler: Option<u32>,
    pub(super) source: Option<u32>,
}

#[derive(Debug, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Image<'a> {
    #[serde(borrow)]
    pub(super) uri: Option<Text<'a>>,
    pub(super) buffer_view: Option<u32>,
}

#[derive(Debug, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Sampler {
    pub(super) wrap_s: Option<u32>,
    pub(super) wrap_t: Option<u32>,
}
