//! What stands before and above the sections: header, section table, the model's fixed fields.

use lodestream_protocol::limits::MAX_PATCH_ELEMENTS;
use lodestream_protocol::quant::Lattice;
use xxhash_rust::xxh3::xxh3_64;

use super::layout::{
    FLAG_COLORS, FLAG_MOVES, FLAG_OPEN, FLAG_VERTICES, FileHeader, HEADER_NAME, MAGIC, MAX_SECTIONS, ModelFields,
    SECTION_REQUIRED, STEP_SHIFT, Section, SectionEntry, UNKNOWN_NAME, VERSION,
};
use super::record::NO_OP;
use super::{PackError, damaged};

fn header_damage(reason: impl Into<String>) -> PackError {
    PackError::Damaged { section: HEADER_NAME, reason: reason.into() }
}

/// Reads header and section table and checks that the sections tile the file, padding zero.
pub(super) fn read_table(file: &[u8]) -> Result<Vec<(Option<Section>, SectionEntry)>, PackError> {
    const HEADER: usize = size_of::<FileHeader>();
    const ENTRY: usize = size_of::<SectionEntry>();
    if !file.starts_with(&MAGIC) {
        return Err(PackError::NotAPack);
    }
    let header = file.get(..HEADER).ok_or_else(|| header_damage("the file ends within it"))?;
    let mut header: FileHeader = bytemuck::pod_read_unaligned(header);
    if header.version != VERSION {
        return Err(PackError::Version { found: header.version });
    }
    if header.file_bytes != file.len() as u64 {
        return Err(header_damage(format!("the file has {} of {} bytes", file.len(), header.file_bytes)));
    }
    if header.sections > MAX_SECTIONS {
        return Err(header_damage(format!("{} sections", header.sections)));
    }
    let table_end = HEADER + header.sections as usize * ENTRY;
    let table = file.get(HEADER..table_end).ok_or_else(|| header_damage("the file ends within the section table"))?;
    let stored = std::mem::take(&mut header.checksum);
    if xxh3_64(&[bytemuck::bytes_of(&header), table].concat()) != stored {
        return Err(header_damage("the checksum does not fit"));
    }
    let mut sections: Vec<(Option<Section>, SectionEntry)> = Vec::new();
    let (mut end, mut name) = (table_end as u64, HEADER_NAME);
    for bytes in table.chunks_exact(ENTRY) {
        let entry: SectionEntry = bytemuck::pod_read_unaligned(bytes);
        let section = Section::from_kind(entry.kind);
        if section.is_none() && entry.flags & SECTION_REQUIRED != 0 {
            return Err(PackError::UnknownSection { kind: entry.kind });
        }
        if sections.iter().any(|(_, other)| other.kind == entry.kind) {
            return Err(header_damage(format!("two sections of kind {}", entry.kind)));
        }
        check_padding(file, end, entry.offset, name)?;
        let section_end = entry.offset.checked_add(entry.bytes).filter(|&end| end <= header.file_bytes);
        end = section_end.ok_or_else(|| header_damage("a section ends after the file"))?;
        name = section.map_or(UNKNOWN_NAME, Section::name);
        sections.push((section, entry));
    }
    check_padding(file, end, header.file_bytes, name)?;
    Ok(sections)
}

/// The bytes from `end` to the next section fill up the grid and are zero.
fn check_padding(file: &[u8], end: u64, next: u64, name: &'static str) -> Result<(), PackError> {
    if next != end.next_multiple_of(8) || next > file.len() as u64 {
        return Err(header_damage("the sections do not follow one another"));
    }
    if file[end as usize..next as usize].iter().any(|&b| b != 0) {
        return Err(PackError::Damaged { section: name, reason: "the padding after it is not zero".into() });
    }
    Ok(())
}

/// Compares a section's checksum.
pub(super) fn check_section(file: &[u8], section: Section, entry: &SectionEntry) -> Result<(), PackError> {
    if xxh3_64(&file[entry.offset as usize..(entry.offset + entry.bytes) as usize]) != entry.checksum {
        return Err(damaged(section, "the checksum does not fit"));
    }
    Ok(())
}

/// Reads the model section and checks each field.
pub(super) fn read_model(bytes: &[u8]) -> Result<(ModelFields, Lattice), PackError> {
    let refuse = |reason: &str| Err(damaged(Section::Model, reason));
    let Ok(fields) = bytemuck::try_pod_read_unaligned::<ModelFields>(bytes) else { return refuse("wrong length") };
    let bits = u8::try_from(fields.bits).unwrap_or(u8::MAX);
    let lattice = Lattice { origin: fields.origin, step: fields.step, bits };
    if !lattice.is_valid() {
        return refuse("no lattice");
    }
    if fields.flags & ((1 << STEP_SHIFT) - 1) & !(FLAG_COLORS | FLAG_MOVES | FLAG_OPEN | FLAG_VERTICES) != 0 {
        return refuse("unknown flags");
    }
    let on_lattice = |p: &[i32; 3]| p.iter().all(|c| (0..=lattice.max_coordinate()).contains(c));
    if !on_lattice(&fields.box_min) || !on_lattice(&fields.box_max) {
        return refuse("the box is off the lattice");
    }
    if fields.spawns > fields.ops || fields.ops == NO_OP {
        return refuse("the numbers of ops make no sense");
    }
    if fields.base_vertices.max(fields.base_faces) > MAX_PATCH_ELEMENTS {
        return refuse("the base is too large");
    }
    Ok((fields, lattice))
}
