//! Maps a published pack into memory: the workspace's only `unsafe`.

use std::fs::File;
use std::io;

use memmap2::Mmap;

/// A file in memory, read-only, on a page boundary.
#[derive(Debug)]
pub(super) struct MappedFile(Mmap);

impl AsRef<[u8]> for MappedFile {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}

/// Maps the whole of `file`.
///
/// # Errors
/// What the operating system says.
#[allow(unsafe_code)]
pub(super) fn map(file: &File) -> io::Result<MappedFile> {
    // SAFETY: a mapping must not change while it is borrowed. Published packs never change: `Store::publish` writes aside,
    // finishes (only then is the file mapped, to draw its thumbnail, which is added when the mapping is gone, and to be checked)
    // and renames, so a file under its published name is complete and
    // is only ever replaced or unlinked as a whole, which leaves mappings of it intact. Whoever writes into the files by other
    // means breaks that contract; reads are bounds-checked all the same, so the worst is a wrong answer or a bus error.
    unsafe { Mmap::map(file) }.map(MappedFile)
}
