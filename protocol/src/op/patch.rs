//! Coding of the base mesh and of spawned patches: complete small meshes.

use super::range_coder::{BitCoder, Decoder, Encoder, NumberModel, Source, raw_bits};
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

/// Adaptive contexts for patches.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct PatchModels {
    count: NumberModel,
    corner: [NumberModel; 3],
    color: [NumberModel; 3],
}

impl PatchModels {
    pub(crate) fn new() -> Self {
        let n = || NumberModel::NEW;
        Self { count: n(), corner: [n(), n(), n()], color: [n(), n(), n()] }
    }

    /// Codes a patch; `may_hold` says whether so many vertices and faces can be meant.
    pub(crate) fn code<C: BitCoder>(
        &mut self,
        coder: &mut C,
        lattice_bits: u8,
        has_colors: bool,
        patch: &Patch,
        may_hold: impl Fn(&C, u32, u32) -> bool,
    ) -> Result<Patch, (u32, u32)> {
        let vertices = self.count.code(coder, patch.positions.len() as u32);
        let faces = self.count.code(coder, patch.faces.len() as u32);
        if vertices > MAX_PATCH_ELEMENTS || faces > MAX_PATCH_ELEMENTS || !may_hold(coder, vertices, faces) {
            return Err((vertices, faces));
        }
        let mut out = Patch::default();
        for v in 0..vertices as usize {
            let p = patch.positions.get(v).copied().unwrap_or_default();
            out.positions.push(p.map(|x| raw_bits(coder, x as u32, u32::from(lattice_bits)) as i32));
            let c = patch.colors.get(v).copied().unwrap_or_default();
            let before = if v == 0 { [0; 3] } else { out.colors[v - 1] };
            out.colors.push(match has_colors {
                true => std::array::from_fn(|k| {
                    let difference = i32::from(c[k]) - i32::from(before[k]);
                    let coded = unzigzag(self.color[k].code(coder, zigzag(difference)));
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
                let v = (next as i32).wrapping_sub(unzigzag(self.corner[k].code(coder, back))) as u32;
                next = next.max(v.saturating_add(1).min(vertices));
                v
            }));
        }
        Ok(out)
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
    PatchModels::new()
        .code(&mut coder, lattice_bits, has_colors, patch, |_, _, _| true)
        .expect("ingest keeps patches under the limit");
    coder.finish()
}

/// Reads a base mesh. Total on any bytes; the result may still be no manifold (`Patch::validate`).
///
/// # Errors
/// [`PatchDecodeError`].
pub fn decode_base(bytes: &[u8], lattice_bits: u8, has_colors: bool) -> Result<Patch, PatchDecodeError> {
    if lattice_bits > MAX_LATTICE_BITS {
        return Err(PatchDecodeError::Malformed);
    }
    let mut coder = Decoder::new(bytes);
    let patch = PatchModels::new()
        .code(&mut coder, lattice_bits, has_colors, &Patch::default(), |_, vertices, faces| {
            fits(bytes.len(), lattice_bits, vertices, faces)
        })
        .map_err(|(vertices, faces)| PatchDecodeError::TooLarge { vertices, faces, bytes: bytes.len() })?;
    if coder.is_overrun() || coder.has_trailing() {
        return Err(PatchDecodeError::Malformed);
    }
    Ok(patch)
}

/// Whether a patch can be coded in so many bytes: positions are raw, and a corner costs at least 1/1000 bit three times.
pub(crate) fn fits(bytes: usize, lattice_bits: u8, vertices: u32, faces: u32) -> bool {
    let bits = (bytes as u64 + 8) * 8;
    u64::from(vertices) * 3 * u64::from(lattice_bits) <= bits && u64::from(faces) <= bits * 300
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base_meshes_round_trip() {
        let tetrahedron = Patch {
            positions: vec![[0, 0, 0], [4095, 0, 7], [0, 4095, 9], [1, 2, 4095]],
            colors: vec![[0, 255, 3], [9, 9, 9], [255, 0, 0], [1, 2, 3]],
            faces: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
        };
        let bytes = encode_base(&tetrahedron, 12, true);
        assert_eq!(decode_base(&bytes, 12, true), Ok(tetrahedron.clone()));
        assert_eq!(decode_base(&encode_base(&Patch::default(), 12, true), 12, true), Ok(Patch::default()));
        let mut longer = bytes.clone();
        longer.extend([1, 2, 3, 4, 5]);
        assert_eq!(decode_base(&longer, 12, true), Err(PatchDecodeError::Malformed));
    }

    #[test]
    fn any_bytes_are_safe() {
        let mut rng = fastrand::Rng::with_seed(11);
        for _ in 0..20_000 {
            let bytes: Vec<u8> = (0..rng.usize(0..60)).map(|_| rng.u8(..)).collect();
            let _ = decode_base(&bytes, 14, rng.bool());
        }
    }
}
