//! Hashes of single vertices and faces. Their wrapping sum is the digest of a mesh: it does not depend on order, so it
//! follows every op in O(1) per element touched.

/// Folds a 128-bit product: a cheap mixer (PROTOCOL.md, "Digest").
#[inline]
fn fold(a: u64, b: u64) -> u64 {
    let product = u128::from(a ^ 0x9e37_79b9_7f4a_7c15) * u128::from(b ^ 0xd1b5_4a32_d192_ed03);
    product as u64 ^ (product >> 64) as u64
}

#[inline]
pub(super) fn vertex_hash(slot: u32, p: [i32; 3], c: [u8; 3]) -> u64 {
    let [x, y, z] = p.map(|x| u64::from(x as u32));
    let color = u64::from(c[0]) | u64::from(c[1]) << 8 | u64::from(c[2]) << 16;
    fold(fold(u64::from(slot) | x << 32, y | z << 32), color)
}

#[inline]
pub(super) fn face_hash(face: u32, c: [u32; 3]) -> u64 {
    let [a, b, c] = c.map(u64::from);
    fold(fold(u64::from(face) | a << 32, b | c << 32), 1 << 32)
}
