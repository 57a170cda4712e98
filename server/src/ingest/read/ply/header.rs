//! The header of a PLY file: which elements follow, with which properties, in which encoding.

use super::super::number::parse_i64;
use super::super::{Format, ReadError, quoted};

/// Type of one number in a PLY file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn from_name(name: &[u8]) -> Option<Self> {
        Some(match name {
            b"char" | b"int8" => Self::I8,
            b"uchar" | b"uint8" => Self::U8,
            b"short" | b"int16" => Self::I16,
            b"ushort" | b"uint16" => Self::U16,
            b"int" | b"int32" => Self::I32,
            b"uint" | b"uint32" => Self::U32,
            b"float" | b"float32" => Self::F32,
            b"double" | b"float64" => Self::F64,
            _ => return None,
        })
    }

    /// Bytes that one value takes in a binary file.
    pub(super) fn byte_len(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    pub(super) fn is_float(self) -> bool {
        matches!(self, Self::F32 | Self::F64)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Scalar(Scalar),
    /// `count` is never a float.
    List {
        count: Scalar,
        item: Scalar,
    },
}

#[derive(Debug)]
pub(super) struct Property {
    pub(super) name: String,
    pub(super) kind: Kind,
}

#[derive(Debug)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) rows: u64,
    pub(super) properties: Vec<Property>,
    /// Line of the header that announces it.
    pub(super) line: u64,
}

impl Element {
    /// Least bytes that one row takes in a binary file: all its lists are empty.
    pub(super) fn min_row_bytes(&self) -> usize {
        let len = |property: &Property| match property.kind {
            Kind::Scalar(scalar) => scalar.byte_len(),
            Kind::List { count, .. } => count.byte_len(),
        };
        self.properties.iter().map(len).sum()
    }
}

#[derive(Debug)]
pub(super) struct Header {
    pub(super) format: Format,
    pub(super) elements: Vec<Element>,
    /// Where the rows start.
    pub(super) body: usize,
    /// Images named by `comment TextureFile`, the way MeshLab and others refer to them.
    pub(super) textures: Vec<String>,
}

impl Header {
    /// Reads the header from the first bytes of the file, all of them if `is_all`. Cost is linear in its length.
    pub(super) fn parse(bytes: &[u8], is_all: bool) -> Result<Self, ReadError> {
        // Lines end as the first one does: a lone carriage return would otherwise swallow a line feed that is the
        // first byte of a binary body.
        let first_end = bytes.iter().position(|&b| b == b'\n' || b == b'\r').unwrap_or(bytes.len());
        if bytes[..first_end].trim_ascii() != b"ply" {
            return Err(error(1, "a PLY file starts with the line `ply`"));
        }
        let terminator = match (bytes.get(first_end), bytes.get(first_end + 1)) {
            (Some(b'\r'), Some(b'\n')) | (Some(b'\n'), _) => b'\n',
            _ => b'\r',
        };
        let mut format = None;
        let mut elements: Vec<Element> = Vec::new();
        let mut textures = Vec::new();
        let mut rest = bytes;
        for line in 1.. {
            let Some(end) = rest.iter().position(|&b| b == terminator) else {
                let problem = if is_all { "the file ends before `end_header`" } else { "the header is too long" };
                return Err(error(line, problem));
            };
            let text = &rest[..end];
            rest = &rest[end + 1..];
            let mut words = text.split(|&b| b <= b' ').filter(|word| !word.is_empty());
            let Some(keyword) = words.next() else { continue };
            match keyword {
                b"ply" if line == 1 => {}
                b"comment" | b"obj_info" => textures.extend(texture_name(text)),
                b"format" => format = Some(parse_format(line, words.next(), words.next())?),
                b"element" => elements.push(parse_element(line, words.next(), words.next())?),
                b"property" => match elements.last_mut() {
                    Some(element) => element.properties.push(parse_property(line, words)?),
                    None => return Err(error(line, "a property before the first element")),
                },
                b"end_header" => {
                    let format = format.ok_or_else(|| error(line, "the header has no `format` line"))?;
                    return Ok(Self { format, elements, body: bytes.len() - rest.len(), textures });
                }
                _ => return Err(error(line, format!("unknown keyword {}", quoted(keyword)))),
            }
        }
        unreachable!("line numbers do not run out before lines")
    }
}

pub(super) fn error(line: u64, problem: impl Into<String>) -> ReadError {
    ReadError::Header { line, problem: problem.into() }
}

fn parse_format(line: u64, encoding: Option<&[u8]>, version: Option<&[u8]>) -> Result<Format, ReadError> {
    if version != Some(b"1.0") {
        return Err(error(line, format!("unknown version {} (1.0 is known)", quoted(version.unwrap_or_default()))));
    }
    match encoding {
        Some(b"ascii") => Ok(Format::PlyAscii),
        Some(b"binary_little_endian") => Ok(Format::PlyBinaryLittleEndian),
        Some(b"binary_big_endian") => Ok(Format::PlyBinaryBigEndian),
        other => Err(error(line, format!("unknown encoding {}", quoted(other.unwrap_or_default())))),
    }
}

fn parse_element(line: u64, name: Option<&[u8]>, rows: Option<&[u8]>) -> Result<Element, ReadError> {
    let (Some(name), Some(rows)) = (name, rows) else {
        return Err(error(line, "an element needs a name and a count"));
    };
    let count = parse_i64(rows).and_then(|rows| u64::try_from(rows).ok());
    let rows = count.ok_or_else(|| error(line, format!("{} is no count of rows", quoted(rows))))?;
    Ok(Element { name: lossy(name), rows, properties: Vec::new(), line })
}

fn parse_property<'a>(line: u64, mut words: impl Iterator<Item = &'a [u8]>) -> Result<Property, ReadError> {
    let scalar = |word: Option<&'a [u8]>| {
        let word = word.unwrap_or_default();
        Scalar::from_name(word).ok_or_else(|| error(line, format!("unknown type {}", quoted(word))))
    };
    let first = words.next();
    let kind = if first == Some(b"list") {
        let (count, item) = (scalar(words.next())?, scalar(words.next())?);
        if count.is_float() {
            return Err(error(line, "the count of a list cannot be a float"));
        }
        Kind::List { count, item }
    } else {
        Kind::Scalar(scalar(first)?)
    };
    let name = words.next().ok_or_else(|| error(line, "a property needs a name"))?;
    Ok(Property { name: lossy(name), kind })
}

fn texture_name(comment: &[u8]) -> Option<String> {
    let text = String::from_utf8_lossy(comment);
    let (_, name) = text.split_once("TextureFile ")?;
    Some(name.trim().chars().take(80).collect())
}

fn lossy(name: &[u8]) -> String {
    String::from_utf8_lossy(name).into_owned()
}
