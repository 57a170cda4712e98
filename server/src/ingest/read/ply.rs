//! PLY: text and both binary orders, any property order, any extra element.
//!
//! Knows the elements `vertex`, `face` and `tristrips`; passes over the rest.

use super::input::{BUFFER, Input};
use super::sink::{Fan, Sink, Strip};
use super::{Format, MAX_VERTICES, ReadError, ReadReport, channel_from_unit};
use crate::ingest::raw::RawMesh;

mod header;
mod source;
#[cfg(test)]
mod tests;

use header::{Element, Header, Kind, Scalar};
use source::{Binary, Fault, Source, Text};

/// Reads a PLY file.
///
/// Polygons become fans around their first corner, strips become triangles. Vertex colours come from `red`, `green`
/// and `blue` (or `diffuse_red` and so on, or `r`, `g`, `b`): bytes as they are, 16-bit ones by their upper half,
/// floats from 0..=1. Cost is linear in the length of the file.
///
/// # Errors
/// [`ReadError`] names the header line, or the element, its row and the line (text) or byte (binary).
pub(super) fn read(input: &mut Input<'_>, sink: Sink<'_>) -> Result<(RawMesh, ReadReport), ReadError> {
    let is_all = input.len() <= BUFFER as u64;
    let header = Header::parse(input.fill(BUFFER)?, is_all)?;
    input.consume(header.body);
    let layout = Layout::new(&header)?;
    match header.format {
        Format::PlyBinaryLittleEndian => read_body(&header, &layout, sink, Binary::<false>::new(input)),
        Format::PlyBinaryBigEndian => read_body(&header, &layout, sink, Binary::<true>::new(input)),
        _ => read_body(&header, &layout, sink, Text::new(input)),
    }
}

/// What a value of a vertex row is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Role {
    Position(usize),
    Color(usize),
    Other,
}

/// What the reader wants from the elements of one file.
#[derive(Debug, Default)]
struct Layout {
    vertex_rows: u64,
    /// One per property of `vertex`.
    vertex_roles: Vec<Role>,
    colored: bool,
    /// Property of `face` that holds its corners.
    face_corners: Option<usize>,
    /// Property of `tristrips` that holds its corners.
    strip_corners: Option<usize>,
}

impl Layout {
    fn new(header: &Header) -> Result<Self, ReadError> {
        let mut layout = Self::default();
        let mut has_vertices = false;
        for element in &header.elements {
            match element.name.as_str() {
                "vertex" if has_vertices => return Err(header::error(element.line, "a second element vertex")),
                "vertex" => {
                    has_vertices = true;
                    layout.set_vertex(element)?;
                }
                "face" => set_corners(&mut layout.face_corners, element)?,
                "tristrips" => set_corners(&mut layout.strip_corners, element)?,
                _ => {}
            }
        }
        let rows = |name| header.elements.iter().filter(move |e| e.name == name).map(|e| e.rows).sum::<u64>();
        if rows("face") == 0 && rows("tristrips") == 0 {
            return Err(ReadError::NoFaces { vertices: layout.vertex_rows });
        }
        Ok(layout)
    }

    fn set_vertex(&mut self, element: &Element) -> Result<(), ReadError> {
        if element.rows > MAX_VERTICES as u64 {
            return Err(ReadError::TooLarge { what: "vertices", limit: MAX_VERTICES as u64 });
        }
        self.vertex_rows = element.rows;
        self.vertex_roles = vec![Role::Other; element.properties.len()];
        let find =
            |name: &str| element.properties.iter().position(|p| p.name == name && matches!(p.kind, Kind::Scalar(_)));
        for (k, name) in ["x", "y", "z"].into_iter().enumerate() {
            match find(name) {
                Some(property) => self.vertex_roles[property] = Role::Position(k),
                None => return Err(header::error(element.line, format!("element vertex has no number {name}"))),
            }
        }
        const NAMES: [[&str; 3]; 3] =
            [["red", "green", "blue"], ["diffuse_red", "diffuse_green", "diffuse_blue"], ["r", "g", "b"]];
        for names in NAMES {
            if let [Some(red), Some(green), Some(blue)] = names.map(find) {
                for (k, property) in [red, green, blue].into_iter().enumerate() {
                    self.vertex_roles[property] = Role::Color(k);
                }
                self.colored = true;
                break;
            }
        }
        Ok(())
    }
}

fn set_corners(corners: &mut Option<usize>, element: &Element) -> Result<(), ReadError> {
    let name = &element.name;
    if corners.is_some() {
        return Err(header::error(element.line, format!("a second element {name}")));
    }
    let is_corners = |p: &header::Property| {
        matches!(p.name.as_str(), "vertex_indices" | "vertex_index") && matches!(p.kind, Kind::List { .. })
    };
    *corners = element.properties.iter().position(is_corners);
    if corners.is_none() {
        return Err(header::error(element.line, format!("element {name} has no list vertex_indices")));
    }
    Ok(())
}

/// What is read so far.
struct Build<'w> {
    sink: Sink<'w>,
    faces: u64,
    short_faces: u64,
    not_carried: Vec<String>,
}

fn read_body<S: Source>(
    header: &Header,
    layout: &Layout,
    sink: Sink<'_>,
    mut source: S,
) -> Result<(RawMesh, ReadReport), ReadError> {
    let mut build = Build { sink, faces: 0, short_faces: 0, not_carried: Vec::new() };
    for element in &header.elements {
        let needed = source.min_element_bytes(element);
        if needed > u128::from(source.left()) {
            let left = source.left();
            return Err(ReadError::Truncated { element: element.name.clone(), rows: element.rows, needed, left });
        }
        match element.name.as_str() {
            "vertex" => read_vertices(element, layout, &mut source, &mut build)?,
            "face" => {
                let corners = layout.face_corners.expect("the layout has the corners of every face element");
                read_faces(element, corners, layout.vertex_rows, &mut source, &mut build)?;
            }
            "tristrips" => {
                let corners = layout.strip_corners.expect("the layout has the corners of every strip element");
                read_strips(element, corners, layout.vertex_rows, &mut source, &mut build)?;
            }
            _ => skip_element(element, &mut source, &mut build)?,
        }
    }
    let Build { sink, faces, short_faces, mut not_carried } = build;
    if sink.triangles() == 0 {
        return Err(ReadError::NoFaces { vertices: layout.vertex_rows });
    }
    if short_faces > 0 {
        not_carried.push(format!("{short_faces} faces with fewer than three corners"));
    }
    let textures = header.textures.iter();
    not_carried.extend(textures.map(|name| format!("texture {name} (textures of PLY files are not baked)")));
    if source.has_more()? {
        not_carried.push(format!("{} bytes after the last element", source.left()));
    }
    let report = ReadReport { faces, colored: sink.is_colored(), not_carried, ..ReadReport::new(header.format, &sink) };
    Ok((sink.finish()?, report))
}

fn read_vertices<S: Source>(
    element: &Element,
    layout: &Layout,
    source: &mut S,
    build: &mut Build<'_>,
) -> Result<(), ReadError> {
    let mut row = 0;
    if let Some(columns) = Columns::new(element, layout).filter(|_| S::HAS_FIXED_ROWS) {
        while row < element.rows {
            let rows = source.fixed_rows(columns.row_bytes, element.rows - row)?;
            if rows.is_empty() {
                break;
            }
            for bytes in rows.chunks_exact(columns.row_bytes) {
                build.sink.push_vertex(columns.positions.map(|column| column.get(bytes)))?;
                if let Some(colors) = columns.colors {
                    build.sink.color_last(colors.map(|column| column.channel(bytes)))?;
                }
            }
            row += (rows.len() / columns.row_bytes) as u64;
        }
    }
    let columns: Vec<(Kind, Role)> =
        element.properties.iter().map(|p| p.kind).zip(layout.vertex_roles.iter().copied()).collect();
    for row in row..element.rows {
        let mut position = [0.0; 3];
        let mut color = [0; 3];
        for &(kind, role) in &columns {
            let result = match (kind, role) {
                (Kind::Scalar(scalar), Role::Position(k)) => source.scalar(scalar).map(|value| position[k] = value),
                (Kind::Scalar(scalar), Role::Color(k)) => {
                    source.scalar(scalar).map(|value| color[k] = channel(scalar, value))
                }
                _ => source.skip_property(kind),
            };
            result.map_err(|fault| row_error(element, row, source, fault))?;
        }
        build.sink.push_vertex(position)?;
        if layout.colored {
            build.sink.color_last(color)?;
        }
    }
    let others = layout.vertex_roles.iter().enumerate().filter(|(_, role)| **role == Role::Other);
    build.note_properties(element, others.map(|(k, _)| k));
    Ok(())
}

/// Where a value stands in rows of a fixed number of bytes, little-endian.
#[derive(Clone, Copy, Debug)]
struct Column {
    offset: usize,
    scalar: Scalar,
}

impl Column {
    #[inline]
    fn get(self, row: &[u8]) -> f64 {
        let bytes = &row[self.offset..];
        // The row is as long as the columns need.
        fn first<const N: usize>(bytes: &[u8]) -> [u8; N] {
            *bytes.first_chunk().expect("rows are as long as their columns")
        }
        match self.scalar {
            Scalar::I8 => f64::from(bytes[0] as i8),
            Scalar::U8 => f64::from(bytes[0]),
            Scalar::I16 => f64::from(i16::from_le_bytes(first(bytes))),
            Scalar::U16 => f64::from(u16::from_le_bytes(first(bytes))),
            Scalar::I32 => f64::from(i32::from_le_bytes(first(bytes))),
            Scalar::U32 => f64::from(u32::from_le_bytes(first(bytes))),
            Scalar::F32 => f64::from(f32::from_le_bytes(first(bytes))),
            Scalar::F64 => f64::from_le_bytes(first(bytes)),
        }
    }

    #[inline]
    fn channel(self, row: &[u8]) -> u8 {
        if self.scalar == Scalar::U8 { row[self.offset] } else { channel(self.scalar, self.get(row)) }
    }
}

/// The values wanted of vertices whose rows have a fixed length.
#[derive(Clone, Copy, Debug)]
struct Columns {
    row_bytes: usize,
    positions: [Column; 3],
    colors: Option<[Column; 3]>,
}

impl Columns {
    /// `None` if a property is a list.
    fn new(element: &Element, layout: &Layout) -> Option<Self> {
        let nowhere = [Column { offset: 0, scalar: Scalar::U8 }; 3];
        let (mut positions, mut colors, mut offset) = (nowhere, nowhere, 0);
        for (property, role) in element.properties.iter().zip(&layout.vertex_roles) {
            let Kind::Scalar(scalar) = property.kind else { return None };
            match *role {
                Role::Position(k) => positions[k] = Column { offset, scalar },
                Role::Color(k) => colors[k] = Column { offset, scalar },
                Role::Other => {}
            }
            offset += scalar.byte_len();
        }
        Some(Self { row_bytes: offset, positions, colors: layout.colored.then_some(colors) })
    }
}

fn read_faces<S: Source>(
    element: &Element,
    corners: usize,
    vertices: u64,
    source: &mut S,
    build: &mut Build<'_>,
) -> Result<(), ReadError> {
    let kinds: Vec<Kind> = element.properties.iter().map(|p| p.kind).collect();
    let is_plain = matches!(
        kinds[..],
        [Kind::List { count: Scalar::U8 | Scalar::I8, item: Scalar::U32 | Scalar::I32 }] if vertices <= 1 << 31
    );
    let mut row = 0;
    while row < element.rows {
        if is_plain {
            let sink = &mut build.sink;
            let rows = source.triangles(element.rows - row, vertices, |face| sink.push_face(face))?;
            row += rows;
            if rows > 0 {
                continue;
            }
        }
        read_face(element, row, corners, vertices, source, build)?;
        row += 1;
    }
    build.faces += element.rows;
    build.note_properties(element, (0..kinds.len()).filter(|&k| k != corners));
    Ok(())
}

fn read_face<S: Source>(
    element: &Element,
    row: u64,
    corners: usize,
    vertices: u64,
    source: &mut S,
    build: &mut Build<'_>,
) -> Result<(), ReadError> {
    for (k, property) in element.properties.iter().enumerate() {
        let Kind::List { count, item } = property.kind else {
            source.skip_property(property.kind).map_err(|fault| row_error(element, row, source, fault))?;
            continue;
        };
        if k != corners {
            source.skip_property(property.kind).map_err(|fault| row_error(element, row, source, fault))?;
            continue;
        }
        let len = source.list_len(count, item).map_err(|fault| row_error(element, row, source, fault))?;
        let mut fan = Fan::new();
        for _ in 0..len {
            let index = source.integer(item).map_err(|fault| row_error(element, row, source, fault))?;
            match u32::try_from(index) {
                Ok(corner) if u64::from(corner) < vertices => fan.push(corner, &mut build.sink)?,
                _ => return Err(out_of_range(row, index, vertices, source)),
            }
        }
        build.short_faces += u64::from(len < 3);
    }
    Ok(())
}

/// Reads triangle strips: -1 starts anew.
fn read_strips<S: Source>(
    element: &Element,
    corners: usize,
    vertices: u64,
    source: &mut S,
    build: &mut Build<'_>,
) -> Result<(), ReadError> {
    for row in 0..element.rows {
        for (k, property) in element.properties.iter().enumerate() {
            let Kind::List { count, item } = property.kind else {
                source.skip_property(property.kind).map_err(|fault| row_error(element, row, source, fault))?;
                continue;
            };
            if k != corners {
                source.skip_property(property.kind).map_err(|fault| row_error(element, row, source, fault))?;
                continue;
            }
            let len = source.list_len(count, item).map_err(|fault| row_error(element, row, source, fault))?;
            let mut strip = Strip::new();
            for _ in 0..len {
                let index = source.integer(item).map_err(|fault| row_error(element, row, source, fault))?;
                if index == -1 || index == i64::from(u32::MAX) {
                    strip = Strip::new();
                    continue;
                }
                match u32::try_from(index) {
                    Ok(corner) if u64::from(corner) < vertices => strip.push(corner, &mut build.sink)?,
                    _ => return Err(out_of_range(row, index, vertices, source)),
                }
            }
        }
    }
    build.faces += element.rows;
    build.note_properties(element, (0..element.properties.len()).filter(|&k| k != corners));
    Ok(())
}

fn skip_element<S: Source>(element: &Element, source: &mut S, build: &mut Build<'_>) -> Result<(), ReadError> {
    // Without properties the rows take no bytes, and their number is bounded by nothing: pass over them at once.
    if !element.properties.is_empty() && element.rows > 0 {
        build.not_carried.push(format!("element {} ({} rows)", shortened(&element.name), element.rows));
        for row in 0..element.rows {
            for property in &element.properties {
                source.skip_property(property.kind).map_err(|fault| row_error(element, row, source, fault))?;
            }
        }
    }
    Ok(())
}

impl Build<'_> {
    fn note_properties(&mut self, element: &Element, others: impl Iterator<Item = usize>) {
        const SHOWN: usize = 12;
        let names: Vec<String> = others.map(|k| shortened(&element.properties[k].name)).collect();
        if names.is_empty() {
            return;
        }
        let mut text = format!("{} properties {}", element.name, names[..names.len().min(SHOWN)].join(", "));
        if names.len() > SHOWN {
            text += &format!(" and {} more", names.len() - SHOWN);
        }
        self.not_carried.push(text);
    }
}

fn shortened(name: &str) -> String {
    name.chars().take(40).collect()
}

/// Colour channel of the type `scalar`, to 0..=255.
fn channel(scalar: Scalar, value: f64) -> u8 {
    // `as` saturates from floats and takes NaN to 0, both of which are wanted here.
    match scalar {
        // A signed byte in the header is a mistake of the writer: its bits are those of an unsigned one.
        Scalar::I8 if value < 0.0 => (value + 256.0) as u8,
        Scalar::I8 | Scalar::U8 => value as u8,
        Scalar::U16 => ((value as u16) >> 8) as u8,
        Scalar::I16 => ((value as u16) >> 7).min(255) as u8,
        // Wider integers are used by writers who do not care for size; their values are 0..=255 all the same.
        Scalar::I32 | Scalar::U32 => value as u8,
        Scalar::F32 | Scalar::F64 => channel_from_unit(value),
    }
}

#[cold]
fn row_error<S: Source>(element: &Element, index: u64, source: &S, fault: Fault) -> ReadError {
    if let Fault::Read(error) = fault {
        return *error;
    }
    let element = shortened(&element.name);
    ReadError::Row { element, index, place: source.place(), problem: fault.to_string() }
}

#[cold]
fn out_of_range<S: Source>(face: u64, index: i64, vertices: u64, source: &S) -> ReadError {
    ReadError::VertexOutOfRange { face, place: source.place(), index, vertices }
}
