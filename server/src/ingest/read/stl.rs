//! STL, text and binary: triangles without shared vertices. Cleaning welds them.

use super::input::{Input, Lines, Words};
use super::number::parse_f64;
use super::sink::{Fan, Sink};
use super::{Format, ReadError, ReadReport, note, quoted};
use crate::ingest::raw::RawMesh;

#[cfg(test)]
mod tests;

/// Bytes before the first triangle of a binary file: a text and the number of triangles.
const HEADER: usize = 84;

/// Bytes of a triangle: a normal, three corners, two bytes that each program uses in its own way.
const TRIANGLE: usize = 50;

/// Triangles that the header of a binary file announces.
fn announced(first: &[u8]) -> Option<u32> {
    Some(u32::from_le_bytes(*first.get(HEADER - 4..)?.first_chunk()?))
}

/// Whether a file with these first bytes and this length is binary: `solid` at the start says little, the length is right in
/// no text by chance.
pub(super) fn is_binary(first: &[u8], len: u64) -> bool {
    announced(first).is_some_and(|count| HEADER as u64 + u64::from(count) * TRIANGLE as u64 == len)
}

/// Reads an STL file.
///
/// It is binary if its length is that of its triangles, text if it starts with `solid`, binary otherwise. Cost is linear in
/// the length of the file.
///
/// # Errors
/// [`ReadError`] names the line, or the byte.
pub(super) fn read(input: &mut Input<'_>, sink: Sink<'_>) -> Result<(RawMesh, ReadReport), ReadError> {
    let len = input.len();
    let first = input.fill(HEADER)?;
    if !is_binary(first, len)
        && first.trim_ascii_start().get(..5).is_some_and(|word| word.eq_ignore_ascii_case(b"solid"))
    {
        return read_text(input, sink);
    }
    read_binary(input, sink)
}

fn read_binary(input: &mut Input<'_>, mut sink: Sink<'_>) -> Result<(RawMesh, ReadReport), ReadError> {
    let Some(count) = announced(input.window()) else {
        let problem = format!("the header of a binary STL takes {HEADER} bytes, and a text starts with `solid`");
        return Err(ReadError::Bytes { byte: input.len(), problem });
    };
    // As Materialise Magics writes it: then the two bytes of a triangle are its colour, too.
    let has_colors = memchr::memmem::find(&input.window()[..HEADER], b"COLOR=").is_some();
    input.consume(HEADER);
    let needed = u128::from(count) * TRIANGLE as u128;
    if needed > u128::from(input.left()) {
        let left = input.left();
        return Err(ReadError::Truncated { element: "triangle".into(), rows: u64::from(count), needed, left });
    }
    let mut attributes = 0_u64;
    let mut left = count as usize;
    while left > 0 {
        let rows = (input.fill(TRIANGLE)?.len() / TRIANGLE).min(left);
        for row in input.window()[..rows * TRIANGLE].chunks_exact(TRIANGLE) {
            let numbers = row[12..48].as_chunks::<4>().0;
            let mut corners =
                numbers.as_chunks::<3>().0.iter().map(|corner| corner.map(|c| f64::from(f32::from_le_bytes(c))));
            let positions: [[f64; 3]; 3] = std::array::from_fn(|_| corners.next().unwrap_or_default());
            push_triangle(&mut sink, positions)?;
            attributes += u64::from(row[48..50] != [0, 0]);
        }
        input.consume(rows * TRIANGLE);
        left -= rows;
    }
    let mut not_carried = Vec::new();
    note(&mut not_carried, attributes, if has_colors { "colours of triangles" } else { "triangles with an attribute" });
    note(&mut not_carried, input.left(), "bytes after the last triangle");
    finish(Format::StlBinary, sink, None, not_carried)
}

fn push_triangle(sink: &mut Sink<'_>, positions: [[f64; 3]; 3]) -> Result<(), ReadError> {
    let first = vertices_u32(sink)?;
    for position in positions {
        sink.push_vertex(position)?;
    }
    sink.push_face([first, first + 1, first + 2])
}

/// The number of vertices, three more than which can be numbered.
fn vertices_u32(sink: &Sink<'_>) -> Result<u32, ReadError> {
    let too_large = ReadError::TooLarge { what: "vertices", limit: super::MAX_VERTICES as u64 };
    u32::try_from(sink.vertices()).ok().filter(|&count| count <= u32::MAX - 3).ok_or(too_large)
}

fn read_text(input: &mut Input<'_>, mut sink: Sink<'_>) -> Result<(RawMesh, ReadReport), ReadError> {
    let mut lines = Lines::new(input)?;
    let mut fan: Option<Fan> = None;
    let (mut faces, mut short_faces, mut solids) = (0_u64, 0_u64, 0_u64);
    let mut last_line = 1;
    while let Some((line, text)) = lines.next(b'#')? {
        last_line = line;
        let mut words = Words(text);
        let Some(keyword) = words.next() else { continue };
        let error = |problem: String| ReadError::Statement { line, problem };
        match keyword.to_ascii_lowercase().as_slice() {
            b"vertex" => {
                let Some(fan) = &mut fan else { return Err(error("a vertex outside of a loop".into())) };
                let mut position = [0.0; 3];
                for coordinate in &mut position {
                    let word = words.next().unwrap_or_default();
                    *coordinate = parse_f64(word)
                        .ok_or_else(|| error(format!("vertex coordinate {} is not a number", quoted(word))))?;
                }
                let index = vertices_u32(&sink)?;
                sink.push_vertex(position)?;
                fan.push(index, &mut sink)?;
            }
            b"outer" => {
                if fan.replace(Fan::new()).is_some() {
                    return Err(error("a loop within a loop".into()));
                }
            }
            b"endloop" => {
                let Some(ended) = fan.take() else { return Err(error("the end of a loop that did not begin".into())) };
                faces += 1;
                short_faces += u64::from(ended.corners < 3);
            }
            b"solid" => solids += 1,
            b"facet" | b"endfacet" | b"endsolid" => {}
            // What follows a solid's name may be any text.
            _ if fan.is_none() => {}
            _ => return Err(error(format!("{} is not a vertex of the loop", quoted(keyword)))),
        }
    }
    if fan.is_some() {
        let problem = "the file ends within a loop".into();
        return Err(ReadError::Statement { line: last_line, problem });
    }
    let mut not_carried = Vec::new();
    note(&mut not_carried, short_faces, "faces with fewer than three corners");
    if solids > 1 {
        note(&mut not_carried, solids, "names of solids");
    }
    finish(Format::StlAscii, sink, Some(faces), not_carried)
}

fn finish(
    format: Format,
    sink: Sink<'_>,
    faces: Option<u64>,
    not_carried: Vec<String>,
) -> Result<(RawMesh, ReadReport), ReadError> {
    if sink.triangles() == 0 {
        return Err(ReadError::NoFaces { vertices: sink.vertices() });
    }
    let report = ReadReport::new(format, &sink);
    let report = ReadReport { faces: faces.unwrap_or(report.faces), not_carried, ..report };
    Ok((sink.finish()?, report))
}
