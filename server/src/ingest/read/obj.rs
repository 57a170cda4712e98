//! Wavefront OBJ: vertices, vertex colours, faces, and the colours of their materials; everything else is counted and left.

use std::path::Path;

use super::input::{BUFFER, Input, Lines, Words};
use super::number::{parse_f64, parse_i64};
use super::sink::{Fan, Sink};
use super::{Format, MAX_VERTICES, Place, ReadError, ReadReport, channel_from_unit, note, quoted};
use crate::ingest::raw::RawMesh;

mod bake;
mod material;
#[cfg(test)]
mod tests;

use bake::Bake;

/// Reads an OBJ file, with its materials and textures in `directory`.
///
/// Polygons become fans around their first corner. Vertex colours are three numbers in 0..=1 after the position;
/// vertices without one are white if others have one. Where a face's material has a texture, its vertices take their
/// colours from there, where it only has a colour, those without a colour of their own take that; the first face of a
/// vertex decides. Positions are not split at seams of the texture. Faces may name vertices that follow them. Cost is linear
/// in the length of the file.
///
/// # Errors
/// [`ReadError`] names the line.
pub(super) fn read(
    input: &mut Input<'_>,
    directory: Option<&Path>,
    sink: Sink<'_>,
) -> Result<(RawMesh, ReadReport), ReadError> {
    let mut reader = Reader {
        sink,
        bake: Bake::new(directory),
        highest: None,
        faces: 0,
        colored_vertices: 0,
        clamped_colors: 0,
        skipped: Skipped::default(),
    };
    let mut lines = Lines::new(input)?;
    let mut joined = Vec::new();
    while let Some((number, line)) = lines.next(b'#')? {
        let Some(first) = line.iter().position(|&b| b > b' ') else { continue };
        let line = &line[first..];
        if line[0] == b'#' {
            continue;
        }
        let Some(head) = continued(line) else {
            reader.statement(number, line)?;
            continue;
        };
        joined.clear();
        joined.extend_from_slice(head);
        while let Some((_, next)) = lines.next(b'#')? {
            joined.push(b' ');
            let head = continued(next);
            joined.extend_from_slice(head.unwrap_or(next));
            if joined.len() > BUFFER {
                return Err(statement_error(number, format!("the statement is longer than {BUFFER} bytes")));
            }
            if head.is_none() {
                break;
            }
        }
        reader.statement(number, &joined)?;
    }
    reader.finish()
}

struct Reader<'d, 'w> {
    sink: Sink<'w>,
    bake: Bake<'d>,
    /// The highest vertex index of any face, and the first face that has it.
    highest: Option<Highest>,
    faces: u64,
    colored_vertices: u64,
    clamped_colors: u64,
    skipped: Skipped,
}

#[derive(Clone, Copy)]
struct Highest {
    vertex: u32,
    face: u64,
    line: u64,
}

/// How many statements of each kind were left.
#[derive(Default)]
struct Skipped {
    weights: u64,
    short_faces: u64,
    texture_coordinates: u64,
    normals: u64,
    groups: u64,
    points_and_lines: u64,
    curves_and_surfaces: u64,
    unknown: u64,
    first_unknown: Option<String>,
}

impl Reader<'_, '_> {
    #[inline]
    fn statement(&mut self, number: u64, line: &[u8]) -> Result<(), ReadError> {
        let mut words = Words(line);
        let skipped = &mut self.skipped;
        match words.next().unwrap_or_default() {
            b"v" => self.vertex(number, words)?,
            b"f" | b"fo" => self.face(number, words)?,
            b"vt" => {
                skipped.texture_coordinates += 1;
                self.bake.texture_coordinate(words);
            }
            b"vn" => skipped.normals += 1,
            b"o" | b"g" | b"s" | b"mg" => skipped.groups += 1,
            b"usemtl" => self.bake.use_material(words.0.trim_ascii()),
            b"mtllib" => self.bake.library(words.0.trim_ascii(), self.sink.vertices(), self.colored_vertices),
            b"p" | b"l" => skipped.points_and_lines += 1,
            b"vp" | b"cstype" | b"deg" | b"bmat" | b"step" | b"curv" | b"curv2" | b"surf" | b"parm" | b"trim"
            | b"hole" | b"scrv" | b"sp" | b"end" | b"con" | b"ctech" | b"stech" | b"bzp" | b"bsp" | b"cdc" | b"cdp"
            | b"res" => {
                skipped.curves_and_surfaces += 1;
            }
            b"bevel" | b"c_interp" | b"d_interp" | b"lod" | b"shadow_obj" | b"trace_obj" | b"call" | b"csh"
            | b"maplib" | b"usemap" => {}
            keyword => {
                skipped.unknown += 1;
                if skipped.first_unknown.is_none() {
                    skipped.first_unknown = Some(format!("{} in line {number}", quoted(keyword)));
                }
            }
        }
        Ok(())
    }

    fn vertex(&mut self, line: u64, words: Words<'_>) -> Result<(), ReadError> {
        // x y z, then nothing, or w, or r g b, or r g b a.
        let mut values = [0.0; 7];
        let mut count = 0;
        for word in words {
            if count == values.len() {
                break;
            }
            values[count] = parse_f64(word)
                .ok_or_else(|| statement_error(line, format!("vertex coordinate {} is not a number", quoted(word))))?;
            count += 1;
        }
        if count < 3 {
            return Err(statement_error(line, format!("a vertex needs three coordinates, this one has {count}")));
        }
        self.sink.push_vertex([values[0], values[1], values[2]])?;
        self.skipped.weights += u64::from(count == 4 && values[3] != 1.0);
        if count >= 6 {
            let rgb = [values[3], values[4], values[5]];
            self.colored_vertices += 1;
            self.clamped_colors += u64::from(!rgb.iter().all(|c| (0.0..=1.0).contains(c)));
            self.sink.color_last(rgb.map(channel_from_unit))?;
            self.bake.has_color(self.sink.vertices() - 1);
        }
        Ok(())
    }

    fn face(&mut self, line: u64, words: Words<'_>) -> Result<(), ReadError> {
        let known = self.sink.vertices();
        let mut fan = Fan::new();
        for word in words {
            let (index, texture) = parse_corner(word).ok_or_else(|| {
                statement_error(line, format!("{} is not a corner of a face (v, v/vt, v//vn or v/vt/vn)", quoted(word)))
            })?;
            // From 1, or from -1 backwards: -1 is the vertex read last.
            let absolute = if index < 0 { known as i64 + index } else { index - 1 };
            match u32::try_from(absolute) {
                Ok(vertex) if (vertex as usize) < MAX_VERTICES => {
                    if self.highest.is_none_or(|highest| vertex > highest.vertex) {
                        self.highest = Some(Highest { vertex, face: self.faces, line });
                    }
                    fan.push(vertex, &mut self.sink)?;
                    if self.bake.is_on() {
                        self.bake.corner(vertex, known, texture, self.skipped.texture_coordinates);
                    }
                }
                _ if index == 0 => return Err(statement_error(line, "vertex index 0 (OBJ counts from 1)")),
                _ => {
                    return Err(ReadError::VertexOutOfRange {
                        face: self.faces,
                        place: Place::Line(line),
                        index,
                        vertices: known,
                    });
                }
            }
        }
        self.skipped.short_faces += u64::from(fan.corners < 3);
        self.faces += 1;
        Ok(())
    }

    fn finish(self) -> Result<(RawMesh, ReadReport), ReadError> {
        let vertices = self.sink.vertices();
        if let Some(Highest { vertex, face, line }) = self.highest {
            // A face may name a vertex that follows, so that only shows now.
            if u64::from(vertex) >= vertices {
                let index = i64::from(vertex) + 1;
                return Err(ReadError::VertexOutOfRange { face, place: Place::Line(line), index, vertices });
            }
        }
        if self.sink.triangles() == 0 {
            return Err(ReadError::NoFaces { vertices });
        }
        let mut report = ReadReport { faces: self.faces, ..ReadReport::new(Format::Obj, &self.sink) };
        self.note_skipped(&mut report.not_carried);
        let workspace = self.sink.workspace();
        let mesh = self.bake.finish(self.sink.finish()?, self.colored_vertices, workspace, &mut report)?;
        if let Some(first) = &self.skipped.first_unknown {
            report.not_carried.push(format!("{} unknown statements, the first is {first}", self.skipped.unknown));
        }
        Ok((mesh, report))
    }

    fn note_skipped(&self, notes: &mut Vec<String>) {
        let skipped = &self.skipped;
        note(notes, skipped.texture_coordinates, "texture coordinates");
        note(notes, skipped.normals, "normals");
        note(notes, skipped.groups, "object, group and smoothing statements");
        note(notes, skipped.short_faces, "faces with fewer than three corners");
        note(notes, skipped.points_and_lines, "points and lines");
        note(notes, skipped.curves_and_surfaces, "statements of free-form curves and surfaces");
        note(notes, skipped.weights, "vertex weights other than 1");
        note(notes, self.clamped_colors, "colours outside 0..=1 (clamped)");
    }
}

/// Vertex and texture index of a corner `v`, `v/vt`, `v//vn` or `v/vt/vn`, as they are written.
#[inline]
fn parse_corner(word: &[u8]) -> Option<(i64, Option<i64>)> {
    let Some(end) = word.iter().position(|&b| b == b'/') else { return Some((parse_i64(word)?, None)) };
    let rest = &word[end + 1..];
    // The index of the normal is not carried, but it tells a corner from other text.
    if !rest.iter().all(|b| b.is_ascii_digit() || matches!(b, b'/' | b'-')) {
        return None;
    }
    let texture = rest.split(|&b| b == b'/').next().unwrap_or_default();
    Some((parse_i64(&word[..end])?, parse_i64(texture)))
}

#[cold]
fn statement_error(line: u64, problem: impl Into<String>) -> ReadError {
    ReadError::Statement { line, problem: problem.into() }
}

/// The line without its `\` if it goes on in the next one.
#[inline]
fn continued(line: &[u8]) -> Option<&[u8]> {
    match line.trim_ascii_end() {
        [head @ .., b'\\'] => Some(head),
        _ => None,
    }
}
