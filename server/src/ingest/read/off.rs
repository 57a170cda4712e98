//! OFF (Geomview), text and binary, with its prefixes for normals, colours and texture coordinates.

use super::input::{Input, Lines, Words};
use super::number::{parse_f64, parse_i64};
use super::sink::{Fan, Sink};
use super::{Format, MAX_VERTICES, Place, ReadError, ReadReport, channel_from_unit, note, quoted};
use crate::ingest::raw::RawMesh;

#[cfg(test)]
mod tests;

/// Reads an OFF file: `[ST][C][N]OFF`, then ` BINARY` or not. Without the keyword it is a plain text.
///
/// Polygons become fans around their first corner. Vertex colours are carried, those of faces are not. A colour is three or
/// four numbers: integers are bytes, others are from 0..=1. Cost is linear in the length of the file.
///
/// # Errors
/// [`ReadError`] names the line, or the byte.
pub(super) fn read(input: &mut Input<'_>, sink: Sink<'_>) -> Result<(RawMesh, ReadReport), ReadError> {
    let first = input.fill(80)?;
    let line_end = first.iter().position(|&b| matches!(b, b'\n' | b'\r')).unwrap_or(first.len());
    let mut words = Words(&first[..line_end]);
    let keyword = words.next().unwrap_or_default();
    let is_binary = keyword.ends_with(b"OFF") && words.next() == Some(b"BINARY");
    if is_binary {
        let layout = Layout::of(keyword)?;
        // A line feed ends the line, with a carriage return before it or not; a lone carriage return does, too.
        let ends = if first[line_end..].starts_with(b"\r\n") { 2 } else { 1 };
        let header = (line_end + ends).min(first.len());
        input.consume(header);
        return read_binary(input, layout, sink);
    }
    read_text(input, sink)
}

/// What follows the position of each vertex, in this order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Layout {
    normal: bool,
    color: bool,
    texture: bool,
}

impl Layout {
    fn of(keyword: &[u8]) -> Result<Self, ReadError> {
        let unknown = || ReadError::Header { line: 1, problem: format!("{} is no kind of OFF", quoted(keyword)) };
        let mut rest = keyword.strip_suffix(b"OFF").ok_or_else(unknown)?;
        let mut take = |prefix: &[u8]| match rest.strip_prefix(prefix) {
            Some(after) => {
                rest = after;
                true
            }
            None => false,
        };
        let layout = Self { texture: take(b"ST"), color: take(b"C"), normal: take(b"N") };
        match rest {
            b"" => Ok(layout),
            b"4" | b"n" | b"4n" => {
                let problem = "meshes in four or more dimensions are not read".into();
                Err(ReadError::Header { line: 1, problem })
            }
            _ => Err(unknown()),
        }
    }

    fn note(self, notes: &mut Vec<String>, vertices: u64) {
        note(notes, if self.normal { vertices } else { 0 }, "normals");
        note(notes, if self.texture { vertices } else { 0 }, "texture coordinates");
    }
}

/// Counts in the header, checked: a vertex takes `vertex_bytes` at least and a face `face_bytes`.
fn check_counts([vertices, faces]: [u64; 2], [vertex_bytes, face_bytes]: [u64; 2], left: u64) -> Result<(), ReadError> {
    if vertices > MAX_VERTICES as u64 {
        return Err(ReadError::TooLarge { what: "vertices", limit: MAX_VERTICES as u64 });
    }
    let truncated = |element: &str, rows: u64, needed: u128| {
        Err(ReadError::Truncated { element: element.into(), rows, needed, left })
    };
    // The last line needs no end.
    let needed = (u128::from(vertices) * u128::from(vertex_bytes)).saturating_sub(1);
    if needed > u128::from(left) {
        return truncated("vertex", vertices, needed);
    }
    let needed = (u128::from(faces) * u128::from(face_bytes)).saturating_sub(1);
    if needed > u128::from(left) {
        return truncated("face", faces, needed);
    }
    if faces == 0 {
        return Err(ReadError::NoFaces { vertices });
    }
    Ok(())
}

/// The lines of a text that say something, without comments.
struct Statements<'i, 'a> {
    lines: Lines<'i, 'a>,
    /// Number of the line given last.
    line: u64,
}

impl Statements<'_, '_> {
    /// The next one.
    ///
    /// # Errors
    /// Those of the file, and its end.
    fn next(&mut self) -> Result<Words<'_>, ReadError> {
        loop {
            let Some((number, line)) = self.lines.next(b'#')? else {
                return Err(self.error("the file ends here"));
            };
            let says_something = without_comment(line).iter().any(|&b| b > b' ');
            self.line = number;
            if says_something {
                return Ok(Words(without_comment(self.lines.last())));
            }
        }
    }

    #[cold]
    fn error(&self, problem: impl Into<String>) -> ReadError {
        ReadError::Statement { line: self.line, problem: problem.into() }
    }
}

fn without_comment(line: &[u8]) -> &[u8] {
    &line[..memchr::memchr(b'#', line).unwrap_or(line.len())]
}

fn read_text(input: &mut Input<'_>, mut sink: Sink<'_>) -> Result<(RawMesh, ReadReport), ReadError> {
    let mut statements = Statements { lines: Lines::new(input)?, line: 1 };
    let mut layout = Layout::default();
    let mut counts = [0; 3];
    {
        let mut words = statements.next()?;
        let mut first = words.clone();
        let keyword = first.next().unwrap_or_default().to_vec();
        if keyword.ends_with(b"OFF") {
            layout = Layout::of(&keyword)?;
            words = first;
        }
        // The counts may stand in the line of the keyword.
        let mut numbers: Vec<Vec<u8>> = words.take(3).map(<[u8]>::to_vec).collect();
        if numbers.is_empty() {
            numbers = statements.next()?.take(3).map(<[u8]>::to_vec).collect();
        }
        for (k, count) in counts.iter_mut().enumerate() {
            // The number of edges is often left out and always wrong.
            let word = match numbers.get(k) {
                Some(word) => word,
                None if k == 2 => break,
                None => return Err(statements.error("the numbers of vertices and faces are missing")),
            };
            *count = parse_i64(word)
                .and_then(|count| u64::try_from(count).ok())
                .ok_or_else(|| statements.error(format!("{} is no count", quoted(word))))?;
        }
    }
    let [vertices, faces, _] = counts;
    // Three digits and white space after each; a face of no corners is a digit.
    check_counts([vertices, faces], [6, 2], statements.lines.input.left())?;
    let mut colored = 0_u64;
    for vertex in 0..vertices {
        let words = statements.next()?;
        let row = parse_vertex(words, layout);
        let line = statements.line;
        let (position, color) = row.map_err(|problem| ReadError::Row {
            element: "vertex".into(),
            index: vertex,
            place: Place::Line(line),
            problem,
        })?;
        sink.push_vertex(position)?;
        if let Some(color) = color {
            colored += 1;
            sink.color_last(color)?;
        }
    }
    let (mut short_faces, mut colored_faces) = (0_u64, 0_u64);
    for face in 0..faces {
        let mut words = statements.next()?;
        let fan = parse_face(&mut words, vertices, &mut sink);
        let has_color = words.next().is_some();
        let place = Place::Line(statements.line);
        match fan {
            Ok(corners) => short_faces += u64::from(corners < 3),
            Err(FaceFault::Problem(problem)) => {
                return Err(ReadError::Row { element: "face".into(), index: face, place, problem });
            }
            Err(FaceFault::OutOfRange(index)) => {
                return Err(ReadError::VertexOutOfRange { face, place, index, vertices });
            }
            Err(FaceFault::Read(error)) => return Err(error),
        }
        colored_faces += u64::from(has_color);
    }
    let mut not_carried = Vec::new();
    layout.note(&mut not_carried, vertices);
    note(&mut not_carried, colored_faces, "colours of faces");
    note(&mut not_carried, short_faces, "faces with fewer than three corners");
    if colored > 0 {
        note(&mut not_carried, vertices - colored, "vertices without a colour (white)");
    }
    finish(Format::OffAscii, sink, faces, colored == vertices, not_carried)
}

/// Position and colour of a line, or what is wrong with it.
fn parse_vertex(mut words: Words<'_>, layout: Layout) -> Result<([f64; 3], Option<[u8; 3]>), String> {
    let mut position = [0.0; 3];
    for coordinate in &mut position {
        let word = words.next().unwrap_or_default();
        *coordinate = parse_f64(word).ok_or_else(|| format!("{} is not a number", quoted(word)))?;
    }
    if layout.normal {
        words.by_ref().take(3).for_each(drop);
    }
    if !layout.color {
        return Ok((position, None));
    }
    let mut channels = [&b""[..]; 4];
    let mut count = 0;
    for word in words {
        if count == 4 {
            break;
        }
        channels[count] = word;
        count += 1;
    }
    if count < 3 {
        return Ok((position, None));
    }
    // One number with a point makes all of them shares of one.
    let is_bytes = channels[..3].iter().all(|word| parse_i64(word).is_some());
    let mut color = [0; 3];
    for (channel, word) in color.iter_mut().zip(channels) {
        let value = parse_f64(word).ok_or_else(|| format!("colour {} is not a number", quoted(word)))?;
        // `as` saturates, which is wanted here.
        *channel = if is_bytes { value as u8 } else { channel_from_unit(value) };
    }
    Ok((position, Some(color)))
}

enum FaceFault {
    Problem(String),
    OutOfRange(i64),
    Read(ReadError),
}

/// Reads the corners of a face and says how many they were.
fn parse_face(words: &mut Words<'_>, vertices: u64, sink: &mut Sink<'_>) -> Result<u64, FaceFault> {
    let word = words.next().unwrap_or_default();
    let count = parse_i64(word).and_then(|count| u64::try_from(count).ok());
    let count = count.ok_or_else(|| FaceFault::Problem(format!("{} is no number of corners", quoted(word))))?;
    let mut fan = Fan::new();
    for _ in 0..count {
        let Some(word) = words.next() else {
            return Err(FaceFault::Problem(format!("{} of {count} corners are missing", count - fan.corners)));
        };
        let index =
            parse_i64(word).ok_or_else(|| FaceFault::Problem(format!("{} is no index of a vertex", quoted(word))))?;
        match u32::try_from(index) {
            Ok(corner) if u64::from(corner) < vertices => fan.push(corner, sink).map_err(FaceFault::Read)?,
            _ => return Err(FaceFault::OutOfRange(index)),
        }
    }
    Ok(fan.corners)
}

/// A big-endian number of four bytes.
fn take(input: &mut Input<'_>) -> Result<[u8; 4], ReadError> {
    let byte = input.position();
    let Some(&taken) = input.fill(4)?.first_chunk() else {
        return Err(ReadError::Bytes { byte, problem: "the file ends here".into() });
    };
    input.consume(4);
    Ok(taken)
}

fn read_binary(input: &mut Input<'_>, layout: Layout, mut sink: Sink<'_>) -> Result<(RawMesh, ReadReport), ReadError> {
    let mut count = || {
        let byte = input.position();
        let count = i32::from_be_bytes(take(input)?);
        u64::try_from(count).map_err(|_| ReadError::Bytes { byte, problem: format!("{count} is no count") })
    };
    let (vertices, faces, _edges) = (count()?, count()?, count()?);
    let columns =
        3 + if layout.normal { 3 } else { 0 } + if layout.color { 4 } else { 0 } + if layout.texture { 2 } else { 0 };
    check_counts([vertices, faces], [columns * 4, 8], input.left())?;
    for _ in 0..vertices {
        let mut position = [0.0; 3];
        for coordinate in &mut position {
            *coordinate = f64::from(f32::from_be_bytes(take(input)?));
        }
        sink.push_vertex(position)?;
        if layout.normal {
            input.skip(12)?;
        }
        if layout.color {
            let mut color = [0; 3];
            for channel in &mut color {
                *channel = channel_from_unit(f64::from(f32::from_be_bytes(take(input)?)));
            }
            sink.color_last(color)?;
            input.skip(4)?;
        }
        if layout.texture {
            input.skip(8)?;
        }
    }
    let (mut short_faces, mut colored_faces) = (0_u64, 0_u64);
    for face in 0..faces {
        let place = Place::Byte(input.position());
        let row_error = |problem: String| ReadError::Row { element: "face".into(), index: face, place, problem };
        let corners = i32::from_be_bytes(take(input)?);
        let corners = u32::try_from(corners).map_err(|_| row_error(format!("a face of {corners} corners")))?;
        if u64::from(corners) * 4 > input.left() {
            return Err(row_error(format!("a face of {corners} corners is longer than the rest of the file")));
        }
        let mut fan = Fan::new();
        for _ in 0..corners {
            let place = Place::Byte(input.position());
            let index = i64::from(i32::from_be_bytes(take(input)?));
            match u32::try_from(index) {
                Ok(corner) if u64::from(corner) < vertices => fan.push(corner, &mut sink)?,
                _ => return Err(ReadError::VertexOutOfRange { face, place, index, vertices }),
            }
        }
        short_faces += u64::from(corners < 3);
        let channels = i32::from_be_bytes(take(input)?);
        let bytes = u64::try_from(channels).map_err(|_| row_error(format!("a colour of {channels} numbers")))? * 4;
        if bytes > input.left() {
            return Err(row_error(format!("a colour of {channels} numbers is longer than the rest of the file")));
        }
        input.skip(bytes)?;
        colored_faces += u64::from(channels > 0);
    }
    let mut not_carried = Vec::new();
    layout.note(&mut not_carried, vertices);
    note(&mut not_carried, colored_faces, "colours of faces");
    note(&mut not_carried, short_faces, "faces with fewer than three corners");
    note(&mut not_carried, input.left(), "bytes after the last face");
    finish(Format::OffBinary, sink, faces, layout.color, not_carried)
}

fn finish(
    format: Format,
    sink: Sink<'_>,
    faces: u64,
    colored: bool,
    not_carried: Vec<String>,
) -> Result<(RawMesh, ReadReport), ReadError> {
    if sink.triangles() == 0 {
        return Err(ReadError::NoFaces { vertices: sink.vertices() });
    }
    let report = ReadReport { faces, colored, not_carried, ..ReadReport::new(format, &sink) };
    Ok((sink.finish()?, report))
}
