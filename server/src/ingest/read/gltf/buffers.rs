//! The bytes that a glTF document refers to: in its own file, in data URIs, in files beside it.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use super::super::ReadError;
use super::super::input::Input;
use super::super::texture::{open_beside, shown};
use super::document::{Buffer, Document};
use super::fault;

/// Bytes that are held of each sequence being read; there are some four at once.
const BUFFER: usize = 1 << 16;

/// Bytes that can be read at any place.
#[derive(Debug)]
pub(in super::super) enum Bytes<'a> {
    /// In memory.
    Slice(&'a [u8]),
    /// Decoded into memory.
    Owned(Vec<u8>),
    /// A file, with its length when it was opened.
    File {
        /// The file.
        file: &'a File,
        /// Its length.
        len: u64,
    },
    /// A file beside the document.
    Beside {
        /// The file.
        file: File,
        /// Its length.
        len: u64,
    },
}

impl Bytes<'_> {
    pub(super) fn len(&self) -> u64 {
        match self {
            Self::Slice(bytes) => bytes.len() as u64,
            Self::Owned(bytes) => bytes.len() as u64,
            Self::File { len, .. } | Self::Beside { len, .. } => *len,
        }
    }

    /// Reads `len` bytes from `start` on, in order.
    ///
    /// # Panics
    /// If they do not lie within the bytes.
    pub(super) fn input(&self, start: u64, len: u64) -> Input<'_> {
        assert!(start <= self.len() && len <= self.len() - start, "{len} bytes at {start} of {}", self.len());
        let slice = |bytes| {
            let bytes: &[u8] = bytes;
            Input::with_buffer(&bytes[start as usize..(start + len) as usize], len, BUFFER)
        };
        match self {
            Self::Slice(bytes) => slice(bytes),
            Self::Owned(bytes) => slice(bytes),
            Self::File { file, .. } => Input::with_buffer(FileRange { file, at: start }, len, BUFFER),
            Self::Beside { file, .. } => Input::with_buffer(FileRange { file, at: start }, len, BUFFER),
        }
    }

    /// The bytes of a range, in memory.
    pub(super) fn read(&self, start: u64, len: u64) -> Result<Vec<u8>, ReadError> {
        let mut input = self.input(start, len);
        let mut out = Vec::new();
        while input.left() > 0 {
            let window = input.fill(1)?;
            out.extend_from_slice(window);
            let step = window.len();
            input.consume(step);
        }
        Ok(out)
    }
}

/// A file from some place on, whatever its cursor.
struct FileRange<'a> {
    file: &'a File,
    at: u64,
}

impl Read for FileRange<'_> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        #[cfg(unix)]
        let read = std::os::unix::fs::FileExt::read_at(self.file, out, self.at)?;
        #[cfg(windows)]
        let read = std::os::windows::fs::FileExt::seek_read(self.file, out, self.at)?;
        self.at += read as u64;
        Ok(read)
    }
}

/// The buffers of a document. Those that nothing uses are not opened.
pub(super) struct Buffers<'a> {
    directory: Option<&'a Path>,
    /// The file of the document.
    own: &'a Bytes<'a>,
    /// Start and length of its binary chunk, if it has one.
    chunk: Option<(u64, u64)>,
    opened: Vec<Option<Bytes<'a>>>,
}

impl<'a> Buffers<'a> {
    pub(super) fn new(
        own: &'a Bytes<'a>,
        chunk: Option<(u64, u64)>,
        directory: Option<&'a Path>,
        document: &Document<'_>,
    ) -> Self {
        let opened = document.buffers.0.iter().map(|_| None).collect();
        Self { directory, own, chunk, opened }
    }

    /// Opens the buffer of a view and gives the range of the view in it.
    ///
    /// # Errors
    /// [`ReadError::Document`] for what cannot be opened and what does not fit.
    pub(super) fn open(&mut self, view: u32, document: &Document<'_>) -> Result<View, ReadError> {
        let part = || format!("bufferViews[{view}]");
        let Some(description) = document.buffer_views.0.get(view as usize) else {
            return Err(fault(part(), "there is no such view"));
        };
        let index = description.buffer as usize;
        let (Some(buffer), Some(opened)) = (document.buffers.0.get(index), self.opened.get_mut(index)) else {
            return Err(fault(part(), format!("there is no buffer {index}")));
        };
        let (base, len) = match (&buffer.uri, self.chunk) {
            (None, Some((start, len))) if index == 0 => (start, len),
            (None, _) => {
                return Err(fault(format!("buffers[{index}]"), "it has no address, and the file no such chunk"));
            }
            (Some(uri), _) => {
                if opened.is_none() {
                    let problem = |problem: String| fault(format!("buffers[{index}]"), problem);
                    *opened = Some(open_uri(&uri.0, self.directory).map_err(problem)?);
                }
                (0, opened.as_ref().map_or(0, Bytes::len))
            }
        };
        check_length(index, buffer, len)?;
        let end = description.byte_offset.checked_add(description.byte_length);
        if end.is_none_or(|end| end > buffer.byte_length) {
            let (at, bytes) = (description.byte_offset, description.byte_length);
            let problem = format!("{bytes} bytes at {at} do not lie in a buffer of {}", buffer.byte_length);
            return Err(fault(part(), problem));
        }
        let is_own = buffer.uri.is_none();
        Ok(View {
            buffer: (!is_own).then_some(index),
            start: base + description.byte_offset,
            len: description.byte_length,
            stride: description.byte_stride,
        })
    }

    /// Bytes of the buffers that were opened and are not part of the document's file.
    pub(super) fn bytes_beside(&self) -> u64 {
        self.opened.iter().flatten().map(Bytes::len).sum()
    }

    /// The bytes in which the range of a view counts.
    pub(super) fn of(&self, view: View) -> &Bytes<'a> {
        match view.buffer {
            Some(index) => self.opened[index].as_ref().expect("a view is of a buffer that was opened"),
            None => self.own,
        }
    }
}

fn check_length(index: usize, buffer: &Buffer<'_>, len: u64) -> Result<(), ReadError> {
    if buffer.byte_length > len {
        let problem = format!("{} bytes are announced, but there are {len}", buffer.byte_length);
        return Err(fault(format!("buffers[{index}]"), problem));
    }
    Ok(())
}

/// A range of a buffer.
#[derive(Clone, Copy, Debug)]
pub(super) struct View {
    /// The buffer, `None` for the file of the document.
    buffer: Option<usize>,
    pub(super) start: u64,
    pub(super) len: u64,
    pub(super) stride: Option<u64>,
}

fn open_uri(uri: &str, directory: Option<&Path>) -> Result<Bytes<'static>, String> {
    if uri.starts_with("data:") {
        return Ok(Bytes::Owned(decode_data_uri(uri)?));
    }
    let name = decode_percent(uri);
    let (file, len) = open_beside(directory, &name).map_err(|problem| format!("{}: {problem}", shown(&name)))?;
    Ok(Bytes::Beside { file, len })
}

/// The bytes of `data:<type>;base64,<text>`.
pub(super) fn decode_data_uri(uri: &str) -> Result<Vec<u8>, String> {
    let text = uri.split_once(";base64,").ok_or("a data URI without base64")?.1.trim_end_matches('=');
    let mut out = Vec::with_capacity(text.len() / 4 * 3 + 2);
    let (mut bits, mut held) = (0_u32, 0);
    for byte in text.bytes() {
        let digit = match byte {
            b'A'..=b'Z' => byte - b'A',
            b'a'..=b'z' => byte - b'a' + 26,
            b'0'..=b'9' => byte - b'0' + 52,
            b'+' | b'-' => 62,
            b'/' | b'_' => 63,
            _ => return Err("a data URI with characters that are not base64".into()),
        };
        bits = bits << 6 | u32::from(digit);
        held += 6;
        if held >= 8 {
            held -= 8;
            out.push((bits >> held) as u8);
            bits &= (1 << held) - 1;
        }
    }
    Ok(out)
}

/// A name of a file from a URI, in which `%20` stands for a space.
pub(super) fn decode_percent(uri: &str) -> String {
    let bytes = uri.as_bytes();
    let hex = |at: usize| (*bytes.get(at)? as char).to_digit(16).map(|digit| digit as u8);
    let mut out = Vec::with_capacity(bytes.len());
    let mut at = 0;
    while at < bytes.len() {
        match (bytes[at], hex(at + 1), hex(at + 2)) {
            (b'%', Some(high), Some(low)) => {
                out.push(high << 4 | low);
                at += 3;
            }
            (byte, ..) => {
                out.push(byte);
                at += 1;
            }
        }
    }
    String::from_utf8_lossy(&out).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_uris_and_percent_signs_are_decoded() {
        for (text, bytes) in [("", &b""[..]), ("TQ==", b"M"), ("TWE", b"Ma"), ("TWFu", b"Man"), ("/+8=", b"\xff\xef")] {
            assert_eq!(decode_data_uri(&format!("data:a/b;base64,{text}")).unwrap(), bytes);
        }
        assert!(decode_data_uri("data:a/b;base64,T Q").is_err() && decode_data_uri("data:,x").is_err());
        assert_eq!(decode_percent("a%20b%2"), "a b%2");
    }
}
