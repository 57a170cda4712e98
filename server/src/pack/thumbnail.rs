//! The picture in a pack: read on demand, and put there after the pack was written.

use xxhash_rust::xxh3::xxh3_64;

use super::header::check_section;
use super::layout::{FileHeader, MAGIC, MAX_THUMBNAIL_BYTES, Section, SectionEntry, VERSION};
use super::write::{WriteError, invalid};
use super::{PackError, PackedModel, damaged};

impl PackedModel {
    fn thumbnail_entry(&self) -> Option<&SectionEntry> {
        let found = self.sections().iter().find(|(section, _)| *section == Some(Section::Thumbnail));
        found.map(|(_, entry)| entry).filter(|entry| entry.bytes > 0)
    }

    /// Whether the pack has a picture. Reads nothing.
    pub fn has_thumbnail(&self) -> bool {
        self.thumbnail_entry().is_some()
    }

    /// The model's picture as PNG, or `None` if the pack has none. Checks it each time, some microseconds. A damaged one does
    /// not quarantine the model.
    ///
    /// # Errors
    /// [`PackError::Damaged`].
    pub fn thumbnail(&self) -> Result<Option<&[u8]>, PackError> {
        let Some(entry) = self.thumbnail_entry() else { return Ok(None) };
        if entry.bytes > MAX_THUMBNAIL_BYTES {
            return Err(damaged(Section::Thumbnail, "it is too long"));
        }
        check_section(self.file(), Section::Thumbnail, entry)?;
        Ok(self.file().get(entry.offset as usize..(entry.offset + entry.bytes) as usize))
    }
}

/// What to write where so that a pack that was [written with room](super::Metadata::leaves_room_for_thumbnail) has this
/// thumbnail: offsets from its start, and bytes. The file must not be used in between.
///
/// # Errors
/// [`WriteError::Invalid`] if there is no room, or the picture is too long.
pub fn thumbnail_edits(model: &PackedModel, png: &[u8]) -> Result<[(u64, Vec<u8>); 2], WriteError> {
    if png.is_empty() || png.len() as u64 > MAX_THUMBNAIL_BYTES {
        return Err(invalid(format!("a thumbnail of {} bytes", png.len())));
    }
    let mut entries: Vec<SectionEntry> = model.sections().iter().map(|&(_, entry)| entry).collect();
    let room = entries.last_mut().filter(|entry| entry.kind == Section::Thumbnail as u32 && entry.bytes == 0);
    let entry = room.ok_or_else(|| invalid("there is no room for a thumbnail"))?;
    entry.bytes = png.len() as u64;
    entry.checksum = xxh3_64(png);
    let at = entry.offset;
    let mut tail = png.to_vec();
    tail.resize(png.len().next_multiple_of(8), 0);
    let mut header = FileHeader {
        magic: MAGIC,
        version: VERSION,
        sections: entries.len() as u32,
        file_bytes: at + tail.len() as u64,
        checksum: 0,
    };
    let table: &[u8] = bytemuck::cast_slice(&entries);
    header.checksum = xxh3_64(&[bytemuck::bytes_of(&header), table].concat());
    Ok([(0, [bytemuck::bytes_of(&header), table].concat()), (at, tail)])
}
