//! How the arrays of a replica grow.

/// Makes room for `len` elements in all, and for a sixteenth more when that takes memory: a server holds thousands of arrays, so what doubling
/// leaves free would be a third of all. Long arrays are moved by the system, page by page, so the more frequent growth costs little.
#[inline]
pub fn reserve_a_sixteenth<T>(array: &mut Vec<T>, len: usize) {
    if len > array.capacity() {
        array.reserve_exact(and_a_sixteenth(len) - array.len());
    }
}

/// Elements to make room for where so many are needed.
#[inline]
pub(super) fn and_a_sixteenth(len: usize) -> usize {
    len + len / 16 + 16
}
