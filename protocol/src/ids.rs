//! Newtypes for the numbers that both ends exchange, so that two kinds cannot be swapped.

use serde::{Deserialize, Serialize};

/// A vertex slot of the [`Replica`](crate::mesh::Replica): an index that outlives edits. Slots are taken smallest free
/// first on both ends, so the free set follows from the occupied one and no slot has to be named when it is taken.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
#[repr(transparent)]
pub struct VertexSlot(pub u32);

impl VertexSlot {
    /// Marks "no vertex" in packed arrays.
    pub const NONE: Self = Self(u32::MAX);

    /// Index into slot arrays.
    #[inline]
    pub fn index(self) -> usize {
        self.0 as usize
    }

    /// The two face slots that the op which made this slot owns: `f_l`, then `f_r`.
    #[inline]
    pub fn faces(self) -> [FaceSlot; 2] {
        [FaceSlot(2 * self.0), FaceSlot(2 * self.0 + 1)]
    }
}

/// A face slot. Slot `v` owns face slots `2v` and `2v + 1`.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
#[repr(transparent)]
pub struct FaceSlot(pub u32);

impl FaceSlot {
    /// Index into slot arrays.
    #[inline]
    pub fn index(self) -> usize {
        self.0 as usize
    }

    /// The vertex slot that owns this face slot.
    #[inline]
    pub fn owner(self) -> VertexSlot {
        VertexSlot(self.0 / 2)
    }
}

/// Number of a batch of ops within a session, counted from 1 after each base mesh.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default, Serialize, Deserialize)]
pub struct BatchSeq(pub u32);

impl BatchSeq {
    /// What a batch carries of its number.
    pub fn low(self) -> u8 {
        self.0 as u8
    }
}

/// Number of a view within a session, given by the client, increasing.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default, Serialize, Deserialize)]
pub struct ViewSeq(pub u32);

impl ViewSeq {
    /// What a batch carries of the number of its view.
    pub fn low(self) -> u16 {
        self.0 as u16
    }

    /// The newest number up to this one whose low 16 bits are `low`.
    pub fn newest(self, low: u16) -> Self {
        Self(self.0.wrapping_sub(u32::from(self.low().wrapping_sub(low))))
    }
}

/// Identity of a model: the order-independent hash of the oriented triangles of its complete, lattice-rounded mesh.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default, Serialize, Deserialize)]
pub struct ModelHash(pub u64);

/// What a client shows to go on with a session whose connection broke: 128 random bits that the server gave it. Whoever has
/// it may take the session over, so it is a secret: it is not shown in logs.
#[derive(Clone, Copy, Serialize, Deserialize)]
pub struct Token(pub [u8; 16]);

impl PartialEq for Token {
    /// Takes the same time wherever the two differ.
    fn eq(&self, other: &Self) -> bool {
        self.0.iter().zip(&other.0).fold(0, |differences, (a, b)| differences | (a ^ b)) == 0
    }
}

impl Eq for Token {}

impl std::fmt::Debug for Token {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Token(..)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_equal_in_all_bytes_and_not_shown() {
        let token = Token(std::array::from_fn(|i| i as u8));
        for i in 0..16 {
            for bit in 0..8 {
                let mut other = token;
                other.0[i] ^= 1 << bit;
                assert_ne!(token, other);
            }
        }
        assert_eq!(token, Token(token.0));
        assert_eq!(format!("{token:?}"), "Token(..)");
    }
}
