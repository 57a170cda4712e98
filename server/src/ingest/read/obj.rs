//! Wavefront OBJ: vertices, vertex colours and faces; everything else is counted and left.

use super::number::{parse_f64, parse_i64};
use super::{Fan, Format, MAX_VERTICES, Place, ReadError, ReadReport, channel_from_unit, quoted};
use crate::mesh::TriMesh;

#[cfg(test)]
mod tests;

/// Reads an OBJ file.
///
/// Polygons become fans around their first corner. Vertex colours are three numbers in 0..=1 after the position;
/// vertices without one are white if others have one. Faces may name vertices that follow them. Cost is linear in
/// the length of the file; memory is at most some ten times that.
///
/// # Errors
/// [`ReadError`] names the line.
pub fn read_obj(bytes: &[u8]) -> Result<(TriMesh, ReadReport), ReadError> {
    let reader = Reader::run(bytes, None)?;
    let vertices = reader.mesh.positions.len() as u64;
    if reader.highest_index > vertices {
        // A face names a vertex that never came. Which one only shows when the number of vertices is known.
        Reader::run(bytes, Some(vertices))?;
    }
    reader.finish()
}

#[derive(Default)]
struct Reader {
    mesh: TriMesh,
    /// Vertices of the whole file, once known.
    vertices: Option<u64>,
    /// Highest vertex index of any face, from 1.
    highest_index: u64,
    faces: u64,
    colored_vertices: u64,
    clamped_colors: u64,
    skipped: Skipped,
}

/// How many statements of each kind were left.
#[derive(Default)]
struct Skipped {
    weights: u64,
    short_faces: u64,
    texture_coordinates: u64,
    normals: u64,
    groups: u64,
    materials: u64,
    libraries: Vec<String>,
    points_and_lines: u64,
    curves_and_surfaces: u64,
    unknown: u64,
    first_unknown: Option<String>,
}

impl Reader {
    fn run(bytes: &[u8], vertices: Option<u64>) -> Result<Self, ReadError> {
        let mut reader = Self { vertices, ..Self::default() };
        let mut lines = Lines::new(bytes);
        let mut joined = Vec::new();
        while let Some((number, line)) = lines.next() {
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
            while let Some((_, next)) = lines.next() {
                joined.push(b' ');
                match continued(next) {
                    Some(head) => joined.extend_from_slice(head),
                    None => {
                        joined.extend_from_slice(next);
                        break;
                    }
                }
            }
            reader.statement(number, &joined)?;
        }
        Ok(reader)
    }

    #[inline]
    fn statement(&mut self, number: u64, line: &[u8]) -> Result<(), ReadError> {
        let mut words = Words(line);
        let skipped = &mut self.skipped;
        match words.next().unwrap_or_default() {
            b"v" => self.vertex(number, words)?,
            b"f" | b"fo" => self.face(number, words)?,
            b"vt" => skipped.texture_coordinates += 1,
            b"vn" => skipped.normals += 1,
            b"o" | b"g" | b"s" | b"mg" => skipped.groups += 1,
            b"usemtl" | b"usemap" => skipped.materials += 1,
            b"mtllib" | b"maplib" => {
                // A few names are worth a line in the report; the rest is noise.
                if skipped.libraries.len() < 4 {
                    let name = String::from_utf8_lossy(words.0.trim_ascii());
                    skipped.libraries.push(name.chars().take(80).collect());
                }
            }
            b"p" | b"l" => skipped.points_and_lines += 1,
            b"vp" | b"cstype" | b"deg" | b"bmat" | b"step" | b"curv" | b"curv2" | b"surf" | b"parm" | b"trim"
            | b"hole" | b"scrv" | b"sp" | b"end" | b"con" | b"ctech" | b"stech" | b"bzp" | b"bsp" | b"cdc" | b"cdp"
            | b"res" => {
                skipped.curves_and_surfaces += 1;
            }
            b"bevel" | b"c_interp" | b"d_interp" | b"lod" | b"shadow_obj" | b"trace_obj" | b"call" | b"csh" => {}
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
        if self.mesh.positions.len() == MAX_VERTICES {
            return Err(ReadError::TooLarge { what: "vertices", limit: MAX_VERTICES as u64 });
        }
        let before = self.mesh.positions.len();
        self.mesh.positions.push([values[0], values[1], values[2]]);
        self.skipped.weights += u64::from(count == 4 && values[3] != 1.0);
        if count >= 6 {
            let rgb = [values[3], values[4], values[5]];
            self.colored_vertices += 1;
            self.clamped_colors += u64::from(!rgb.iter().all(|c| (0.0..=1.0).contains(c)));
            let colors = self.mesh.colors.get_or_insert_default();
            colors.resize(before, WHITE);
            colors.push(rgb.map(channel_from_unit));
        }
        Ok(())
    }

    fn face(&mut self, line: u64, words: Words<'_>) -> Result<(), ReadError> {
        let known = self.mesh.positions.len() as i64;
        let mut fan = Fan::new(&mut self.mesh.faces);
        for word in words {
            let index = parse_corner(word).ok_or_else(|| {
                statement_error(line, format!("{} is not a corner of a face (v, v/vt, v//vn or v/vt/vn)", quoted(word)))
            })?;
            // From 1, or from -1 backwards: -1 is the vertex read last.
            let absolute = if index < 0 { known + index + 1 } else { index };
            let limit = self.vertices.unwrap_or(MAX_VERTICES as u64);
            match u32::try_from(absolute) {
                Ok(one_based) if one_based > 0 && u64::from(one_based) <= limit => {
                    self.highest_index = self.highest_index.max(u64::from(one_based));
                    fan.push(one_based - 1)?;
                }
                _ if index == 0 => return Err(statement_error(line, "vertex index 0 (OBJ counts from 1)")),
                _ => {
                    let vertices = self.vertices.unwrap_or(known as u64);
                    return Err(ReadError::VertexOutOfRange {
                        face: self.faces,
                        place: Place::Line(line),
                        index,
                        vertices,
                    });
                }
            }
        }
        self.skipped.short_faces += u64::from(fan.corners < 3);
        self.faces += 1;
        Ok(())
    }

    fn finish(mut self) -> Result<(TriMesh, ReadReport), ReadError> {
        let vertices = self.mesh.positions.len() as u64;
        if self.mesh.faces.is_empty() {
            return Err(ReadError::NoFaces { vertices });
        }
        if let Some(colors) = &mut self.mesh.colors {
            colors.resize(self.mesh.positions.len(), WHITE);
        }
        let report = ReadReport {
            format: Format::Obj,
            vertices,
            faces: self.faces,
            triangles: self.mesh.faces.len() as u64,
            colored: self.colored_vertices == vertices,
            not_carried: self.not_carried(vertices),
        };
        Ok((self.mesh, report))
    }

    fn not_carried(&mut self, vertices: u64) -> Vec<String> {
        let skipped = &mut self.skipped;
        let mut notes = Vec::new();
        let mut note = |count: u64, what: &str| {
            if count > 0 {
                notes.push(format!("{count} {what}"));
            }
        };
        note(skipped.texture_coordinates, "texture coordinates");
        note(skipped.normals, "normals");
        note(skipped.groups, "object, group and smoothing statements");
        note(skipped.materials, "uses of a material (textures are not baked yet)");
        note(skipped.short_faces, "faces with fewer than three corners");
        note(skipped.points_and_lines, "points and lines");
        note(skipped.curves_and_surfaces, "statements of free-form curves and surfaces");
        note(skipped.weights, "vertex weights other than 1");
        note(self.clamped_colors, "colours outside 0..=1 (clamped)");
        if self.colored_vertices > 0 {
            note(vertices - self.colored_vertices, "vertices without a colour (white)");
        }
        let libraries = skipped.libraries.drain(..);
        notes.extend(libraries.map(|name| format!("materials from {name} (textures are not baked yet)")));
        if let Some(first) = &skipped.first_unknown {
            notes.push(format!("{} unknown statements, the first is {first}", skipped.unknown));
        }
        notes
    }
}

const WHITE: [u8; 3] = [255; 3];

/// Vertex index of a corner `v`, `v/vt`, `v//vn` or `v/vt/vn`.
#[inline]
fn parse_corner(word: &[u8]) -> Option<i64> {
    let end = word.iter().position(|&b| b == b'/').unwrap_or(word.len());
    let (index, rest) = word.split_at(end);
    // The other indices are not carried, but they tell a corner from other text.
    let is_corner = rest.iter().all(|b| b.is_ascii_digit() || matches!(b, b'/' | b'-'));
    if is_corner { parse_i64(index) } else { None }
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

/// Lines of a file, numbered from 1. They end with a line feed, or with a carriage return if there is none in the file.
struct Lines<'a> {
    rest: &'a [u8],
    terminator: u8,
    number: u64,
}

impl<'a> Lines<'a> {
    fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes, terminator: if bytes.contains(&b'\n') { b'\n' } else { b'\r' }, number: 0 }
    }

    #[inline]
    fn next(&mut self) -> Option<(u64, &'a [u8])> {
        if self.rest.is_empty() {
            return None;
        }
        let end = self.rest.iter().position(|&b| b == self.terminator).unwrap_or(self.rest.len());
        let line = &self.rest[..end];
        self.rest = self.rest.get(end + 1..).unwrap_or_default();
        self.number += 1;
        Some((self.number, line))
    }
}

/// Words between white space.
struct Words<'a>(&'a [u8]);

impl<'a> Iterator for Words<'a> {
    type Item = &'a [u8];

    #[inline]
    fn next(&mut self) -> Option<&'a [u8]> {
        let start = self.0.iter().position(|&b| b > b' ')?;
        let rest = &self.0[start..];
        let end = rest.iter().position(|&b| b <= b' ').unwrap_or(rest.len());
        self.0 = &rest[end..];
        Some(&rest[..end])
    }
}
