//! Coding of the base mesh and of spawned patches: complete small meshes.
//!
//! A patch in canonical order ([`canonical_order`]) is coded by a [`walk`] over its faces; any other as lists of vertices and
//! corners, *plainly*, so that whatever a pack holds can be sent.

mod vertex;
mod walk;

use self::vertex::VertexModels;
use self::walk::{AcrossModels, Given, Walk, is_canonical};
pub use self::walk::{CanonicalOrder, canonical_order};
use super::range_coder::{BitCoder, Contexts, Decoder, Encoder, NumberModel, Prob, Source, contexts, raw_bits};
use super::trained::{TRAINED, Trained};
use crate::limits::MAX_PATCH_ELEMENTS;
use crate::mesh::Patch;
use crate::quant::MAX_LATTICE_BITS;

/// Why base bytes were refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PatchDecodeError {
    /// More vertices or faces than a patch may have, or than the bytes can hold.
    #[error("a patch of {vertices} vertices and {faces} faces does not fit {bytes} bytes")]
    TooLarge {
        /// Vertices announced.
        vertices: u32,
        /// Faces announced.
        faces: u32,
        /// Bytes there are.
        bytes: usize,
    },
    /// The bytes end too early, go on after the end, or hold a number out of range.
    #[error("malformed patch")]
    Malformed,
}

/// The bits mean nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Malformed;

/// Adaptive contexts for patches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct PatchModels {
    is_plain: Prob,
    vertices: NumberModel,
    /// By whether the patch is plain.
    faces: [NumberModel; 2],
    is_closed: Prob,
    across: AcrossModels,
    vertex: VertexModels,
    plain_corner: [NumberModel; 3],
    plain_color: [NumberModel; 3],
}

contexts!(PatchModels: is_plain, vertices, faces, is_closed, across, vertex, plain_corner, plain_color);

impl PatchModels {
    pub(crate) fn new(trained: &Trained) -> Self {
        const NUMBER: NumberModel = NumberModel::NEW;
        let mut models = Self {
            is_plain: Prob::HALF,
            vertices: NUMBER,
            faces: [NUMBER; 2],
            is_closed: Prob::HALF,
            across: AcrossModels::new(),
            vertex: VertexModels::new(),
            plain_corner: [NUMBER; 3],
            plain_color: [NUMBER; 3],
        };
        models.start_from(trained.patch_priors);
        models
    }

    /// Codes a patch; `may_hold` says whether so many vertices and faces can be meant. A decoder gives the empty patch and gets
    /// one of that size, which may still be no manifold.
    pub(crate) fn code<C: BitCoder>(
        &mut self,
        coder: &mut C,
        lattice_bits: u8,
        has_colors: bool,
        patch: &Patch,
        may_hold: impl Fn(&C, u32, u32) -> bool,
    ) -> Result<Patch, Refused> {
        let is_plain = !is_canonical(patch) || !self.is_long_enough(lattice_bits, has_colors, patch);
        let is_plain = coder.bit(&mut self.is_plain, is_plain);
        let vertices = self.vertices.code(coder, patch.positions.len() as u32);
        // As many as a closed surface without handles has.
        let expected = vertices.wrapping_mul(2).wrapping_sub(4);
        let more = zigzag((patch.faces.len() as u32).wrapping_sub(expected) as i32);
        let more = unzigzag(self.faces[usize::from(is_plain)].code(coder, more));
        let faces = expected.wrapping_add(more as u32);
        if vertices > MAX_PATCH_ELEMENTS || faces > MAX_PATCH_ELEMENTS || !may_hold(coder, vertices, faces) {
            return Err(Refused::TooLarge { vertices, faces });
        }
        if is_plain {
            return Ok(self.plain(coder, lattice_bits, has_colors, patch, [vertices, faces]));
        }
        let mut source = Given::new(patch).ok_or(Malformed)?;
        Ok(Walk::new(&mut source, lattice_bits, has_colors, [vertices, faces]).code(coder, self)?)
    }

    /// Whether [`fits`] admits the patch in the bytes that a walk takes. Only one of many flat, even faces takes fewer.
    fn is_long_enough(&self, lattice_bits: u8, has_colors: bool, patch: &Patch) -> bool {
        let size = [patch.positions.len() as u32, patch.faces.len() as u32];
        if fits(0, size[0], size[1]) {
            return true;
        }
        let mut coder = Encoder::new();
        let Some(mut source) = Given::new(patch) else { return false };
        let walk = Walk::new(&mut source, lattice_bits, has_colors, size);
        walk.code(&mut coder, &mut self.clone()).is_ok() && fits(coder.len(), size[0], size[1])
    }

    fn plain(
        &mut self,
        coder: &mut impl BitCoder,
        lattice_bits: u8,
        has_colors: bool,
        patch: &Patch,
        [vertices, faces]: [u32; 2],
    ) -> Patch {
        let mut out = Patch::default();
        for v in 0..vertices as usize {
            let p = patch.positions.get(v).copied().unwrap_or_default();
            out.positions.push(p.map(|x| raw_bits(coder, x as u32, u32::from(lattice_bits)) as i32));
            let c = patch.colors.get(v).copied().unwrap_or_default();
            let before = if v == 0 { [0; 3] } else { out.colors[v - 1] };
            out.colors.push(match has_colors {
                true => std::array::from_fn(|k| {
                    let difference = i32::from(c[k]) - i32::from(before[k]);
                    let coded = unzigzag(self.plain_color[k].code(coder, zigzag(difference)));
                    i32::from(before[k]).wrapping_add(coded).clamp(0, 255) as u8
                }),
                false => [0; 3],
            });
        }
        // Corners count back from the first vertex not yet named, which costs next to nothing for vertices in order of
        // first use.
        let mut next = 0u32;
        for f in 0..faces as usize {
            let face = patch.faces.get(f).copied().unwrap_or_default();
            out.faces.push(std::array::from_fn(|k| {
                let back = zigzag((next as i32).wrapping_sub(face[k] as i32));
                let v = (next as i32).wrapping_sub(unzigzag(self.plain_corner[k].code(coder, back))) as u32;
                next = next.max(v.saturating_add(1).min(vertices));
                v
            }));
        }
        out
    }
}

/// Why [`PatchModels::code`] gives no patch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Refused {
    TooLarge { vertices: u32, faces: u32 },
    Malformed,
}

impl From<Malformed> for Refused {
    fn from(Malformed: Malformed) -> Self {
        Self::Malformed
    }
}

fn zigzag(x: i32) -> u32 {
    ((x << 1) ^ (x >> 31)) as u32
}

fn unzigzag(x: u32) -> i32 {
    (x >> 1) as i32 ^ -((x & 1) as i32)
}

/// The base mesh as bytes for [`decode_base`].
pub fn encode_base(patch: &Patch, lattice_bits: u8, has_colors: bool) -> Vec<u8> {
    let mut coder = Encoder::new();
    PatchModels::new(&TRAINED)
        .code(&mut coder, lattice_bits, has_colors, patch, |_, _, _| true)
        .expect("ingest keeps patches under the limit");
    coder.finish()
}

/// Reads a base mesh. Total on any bytes; the result may still be no manifold (`Patch::validate`).
///
/// # Errors
/// [`PatchDecodeError`].
pub fn decode_base(bytes: &[u8], lattice_bits: u8, has_colors: bool) -> Result<Patch, PatchDecodeError> {
    decode(Decoder::new(bytes), &mut PatchModels::new(&TRAINED), bytes.len(), lattice_bits, has_colors)
}

/// As [`decode_base`], and counts what the contexts saw.
///
/// # Errors
/// [`PatchDecodeError`].
#[cfg(any(test, feature = "testing"))]
pub fn decode_base_tallied(
    bytes: &[u8],
    lattice_bits: u8,
    has_colors: bool,
    tally: &mut super::training::Tally,
) -> Result<Patch, PatchDecodeError> {
    let mut models = PatchModels::new(&TRAINED);
    tally.attach(|visit| models.for_each(visit));
    let source = super::observe::Observed::new(Decoder::new(bytes), tally);
    decode(source, &mut models, bytes.len(), lattice_bits, has_colors)
}

fn decode<S: Source>(
    mut coder: S,
    models: &mut PatchModels,
    byte_count: usize,
    lattice_bits: u8,
    has_colors: bool,
) -> Result<Patch, PatchDecodeError> {
    if lattice_bits > MAX_LATTICE_BITS {
        return Err(PatchDecodeError::Malformed);
    }
    let fits = |_: &S, vertices, faces| fits(byte_count, vertices, faces);
    let patch =
        models.code(&mut coder, lattice_bits, has_colors, &Patch::default(), fits).map_err(
            |refused| match refused {
                Refused::TooLarge { vertices, faces } => {
                    PatchDecodeError::TooLarge { vertices, faces, bytes: byte_count }
                }
                Refused::Malformed => PatchDecodeError::Malformed,
            },
        )?;
    if coder.is_overrun() || coder.has_trailing() {
        return Err(PatchDecodeError::Malformed);
    }
    Ok(patch)
}

/// Whether a patch may be coded in so many bytes: what a decoder holds for an announced patch stays in proportion to them.
///
/// A plain patch always may: its positions are raw, at least 24 bits for a vertex; a manifold has no more than V (V - 1) / 3 faces,
/// and with [`MAX_PATCH_ELEMENTS`] at most 1536 V.
pub(crate) fn fits(bytes: usize, vertices: u32, faces: u32) -> bool {
    let bytes = bytes as u64 + 8;
    u64::from(vertices) <= 128 * bytes && u64::from(faces) <= 512 * bytes
}

#[cfg(test)]
mod tests;
