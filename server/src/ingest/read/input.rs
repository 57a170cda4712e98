//! The bytes of one file, front to back, through a buffer of bounded size.
//!
//! An [`Input`] knows how long the file is, so readers can check every count against the bytes that are left before they
//! believe it. It holds no more than [`BUFFER`] bytes, whatever the file.

use std::io::{self, Read};

use super::ReadError;

/// Most bytes that are held at once, and so the longest line, token or row that can be read.
pub(super) const BUFFER: usize = 1 << 20;

/// A reader of known length.
pub(super) struct Input<'a> {
    source: Box<dyn Read + 'a>,
    /// Called with the bytes taken from `source` so far and the length of the file.
    progress: Option<&'a mut dyn FnMut(u64, u64)>,
    /// Length of the file when it was opened; what is appended later is not read.
    len: u64,
    /// Offset in the file of `buffer[0]`.
    base: u64,
    /// `buffer[at..end]` is read and not consumed.
    buffer: Vec<u8>,
    at: usize,
    end: usize,
    /// Line feeds in the file before `buffer[0]`: counting them costs next to nothing.
    line_feeds: u64,
}

impl<'a> Input<'a> {
    /// Reads `len` bytes of `source`.
    pub(super) fn new(source: impl Read + 'a, len: u64) -> Self {
        Self::with_buffer(source, len, BUFFER)
    }

    /// As [`Input::new`], holding at most `most` bytes.
    pub(super) fn with_buffer(source: impl Read + 'a, len: u64, most: usize) -> Self {
        // A small file does not pay for a large buffer.
        let room = usize::try_from(len).unwrap_or(most).min(most);
        Self {
            source: Box::new(source),
            progress: None,
            len,
            base: 0,
            buffer: vec![0; room],
            at: 0,
            end: 0,
            line_feeds: 0,
        }
    }

    pub(super) fn of_slice(bytes: &'a [u8]) -> Self {
        Self::new(bytes, bytes.len() as u64)
    }

    pub(super) fn with_progress(self, progress: &'a mut dyn FnMut(u64, u64)) -> Self {
        Self { progress: Some(progress), ..self }
    }

    /// Bytes of the file.
    pub(super) fn len(&self) -> u64 {
        self.len
    }

    /// Bytes consumed so far.
    #[inline]
    pub(super) fn position(&self) -> u64 {
        self.base + self.at as u64
    }

    /// Bytes that are not consumed yet.
    #[inline]
    pub(super) fn left(&self) -> u64 {
        self.len - self.position()
    }

    /// Bytes that are at hand, none if none were asked for by [`Input::fill`].
    #[inline]
    pub(super) fn window(&self) -> &[u8] {
        &self.buffer[self.at..self.end]
    }

    /// Passes over bytes of the window.
    #[inline]
    pub(super) fn consume(&mut self, bytes: usize) {
        debug_assert!(bytes <= self.end - self.at);
        self.at += bytes;
    }

    /// The bytes consumed last, if [`Input::fill`] was not called since.
    #[inline]
    pub(super) fn consumed(&self, bytes: usize) -> &[u8] {
        &self.buffer[self.at - bytes..self.at]
    }

    /// The window, with `wanted` bytes or more (at most as many as fit the buffer), or fewer where the file ends.
    ///
    /// # Errors
    /// Those of the file, and [`ReadError::Shrunk`].
    #[inline]
    pub(super) fn fill(&mut self, wanted: usize) -> Result<&[u8], ReadError> {
        if self.end - self.at < wanted {
            self.refill(wanted)?;
        }
        Ok(self.window())
    }

    #[cold]
    fn refill(&mut self, wanted: usize) -> Result<(), ReadError> {
        let ahead = self.len - self.base - self.end as u64;
        if ahead == 0 {
            return Ok(());
        }
        self.line_feeds += memchr::memchr_iter(b'\n', &self.buffer[..self.at]).count() as u64;
        self.buffer.copy_within(self.at..self.end, 0);
        self.base += self.at as u64;
        (self.at, self.end) = (0, self.end - self.at);
        let room = (self.buffer.len() - self.end).min(usize::try_from(ahead).unwrap_or(usize::MAX));
        let goal = self.end + room;
        while self.end < wanted.min(goal) {
            match self.source.read(&mut self.buffer[self.end..goal]) {
                Ok(0) => return Err(ReadError::Shrunk { at: self.base + self.end as u64, len: self.len }),
                Ok(read) => self.end += read,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(ReadError::Io(error)),
            }
        }
        if let Some(progress) = &mut self.progress {
            progress(self.base + self.end as u64, self.len);
        }
        Ok(())
    }

    /// Passes over `bytes`.
    ///
    /// # Errors
    /// Those of the file, and its end.
    pub(super) fn skip(&mut self, mut bytes: u64) -> Result<(), ReadError> {
        while bytes > 0 {
            let step = self.fill(1)?.len().min(usize::try_from(bytes).unwrap_or(usize::MAX));
            if step == 0 {
                return Err(ReadError::Bytes { byte: self.position(), problem: "the file ends here".into() });
            }
            self.consume(step);
            bytes -= step as u64;
        }
        Ok(())
    }

    /// Line of the byte `offset`, from 1, which must not be before the start of the window of the last [`Input::fill`].
    pub(super) fn line_at(&self, offset: u64) -> u64 {
        let upto = usize::try_from(offset.saturating_sub(self.base)).unwrap_or(usize::MAX).min(self.end);
        let here = memchr::memchr_iter(b'\n', &self.buffer[..upto]).count() as u64;
        self.line_feeds + here + 1
    }
}

impl Read for Input<'_> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let window = self.fill(1).map_err(io::Error::other)?;
        let len = window.len().min(out.len());
        out[..len].copy_from_slice(&window[..len]);
        self.consume(len);
        Ok(len)
    }
}

/// Lines of a text, numbered from 1.
///
/// They end with a line feed, or with a carriage return if there is no line feed within the first [`BUFFER`] bytes.
pub(super) struct Lines<'i, 'a> {
    pub(super) input: &'i mut Input<'a>,
    terminator: u8,
    number: u64,
    /// Where the line given last stands in the buffer of the input.
    last: std::ops::Range<usize>,
}

impl<'i, 'a> Lines<'i, 'a> {
    pub(super) fn new(input: &'i mut Input<'a>) -> Result<Self, ReadError> {
        let terminator = if memchr::memchr(b'\n', input.fill(BUFFER)?).is_some() { b'\n' } else { b'\r' };
        Ok(Self { input, terminator, number: 0, last: 0..0 })
    }

    /// The next line and its number. A line that begins with `comment` and is too long for the buffer is cut.
    ///
    /// # Errors
    /// [`ReadError::Statement`] for a line of more than [`BUFFER`] bytes, and those of the file.
    #[inline]
    pub(super) fn next(&mut self, comment: u8) -> Result<Option<(u64, &[u8])>, ReadError> {
        self.number += 1;
        let window = self.input.window();
        let (line, ending) = match memchr::memchr(self.terminator, window) {
            Some(end) => (end, 1),
            None => match self.far_end(comment)? {
                Some(found) => found,
                None => return Ok(None),
            },
        };
        self.last = self.input.at..self.input.at + line;
        self.input.consume(line + ending);
        Ok(Some((self.number, self.last())))
    }

    /// The line given last.
    #[inline]
    pub(super) fn last(&self) -> &[u8] {
        &self.input.buffer[self.last.clone()]
    }

    /// Length of the line and of what ends it, for a line that does not end in the window.
    #[cold]
    fn far_end(&mut self, comment: u8) -> Result<Option<(usize, usize)>, ReadError> {
        let mut known = self.input.window().len();
        loop {
            let window = self.input.fill(known + 1)?;
            if let Some(end) = memchr::memchr(self.terminator, &window[known..]) {
                return Ok(Some((known + end, 1)));
            }
            known = window.len();
            if known as u64 == self.input.left() {
                return Ok((known > 0).then_some((known, 0)));
            }
            if known < self.input.buffer.len() {
                continue;
            }
            if self.input.window().trim_ascii_start().first() != Some(&comment) {
                let problem = format!("the line is longer than {BUFFER} bytes");
                return Err(ReadError::Statement { line: self.number, problem });
            }
            return self.cut_comment().map(Some);
        }
    }

    /// Passes over a comment that is longer than the buffer. What is left of it is an empty line.
    fn cut_comment(&mut self) -> Result<(usize, usize), ReadError> {
        loop {
            let window = self.input.fill(1)?;
            if window.is_empty() {
                return Ok((0, 0));
            }
            match memchr::memchr(self.terminator, window) {
                Some(end) => {
                    self.input.consume(end);
                    return Ok((0, 1));
                }
                None => {
                    let all = window.len();
                    self.input.consume(all);
                }
            }
        }
    }
}

/// Words between white space.
#[derive(Clone)]
pub(super) struct Words<'a>(pub(super) &'a [u8]);

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

#[cfg(test)]
mod tests {
    use super::*;

    /// Gives one to three bytes at a time.
    struct Drip<'a>(&'a [u8], usize);

    impl Read for Drip<'_> {
        fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
            self.1 += 1;
            if self.1.is_multiple_of(5) {
                return Err(io::ErrorKind::Interrupted.into());
            }
            let len = (1 + self.1 % 3).min(out.len()).min(self.0.len());
            out[..len].copy_from_slice(&self.0[..len]);
            self.0 = &self.0[len..];
            Ok(len)
        }
    }

    #[test]
    fn short_reads_and_small_buffers_change_nothing() {
        let bytes: Vec<u8> = (0..10_000_u32).map(|i| (i * 7 % 251) as u8).collect();
        let mut input = Input::with_buffer(Drip(&bytes, 0), bytes.len() as u64, 17);
        let mut seen = Vec::new();
        while input.left() > 0 {
            let wanted = 1 + seen.len() % 17;
            let position = input.position();
            let left = input.left();
            let window = input.fill(wanted).unwrap();
            assert!(window.len() as u64 >= left.min(wanted as u64));
            assert_eq!(position, seen.len() as u64);
            let taken = window.len().min(wanted);
            seen.extend_from_slice(&window[..taken]);
            input.consume(taken);
        }
        assert_eq!(seen, bytes);
        assert!(input.fill(1).unwrap().is_empty());
    }

    #[test]
    fn a_file_that_shrinks_is_an_error_with_its_place() {
        let mut input = Input::new(&[1_u8, 2, 3][..], 5);
        let error = input.fill(4).unwrap_err();
        assert_eq!(error.to_string(), "the file ends at byte 3, but it had 5 bytes when it was opened");
    }

    #[test]
    fn lines_are_counted_across_refills() {
        let text: String = (0..3000).map(|i| format!("{i}\n")).collect();
        let mut input = Input::with_buffer(text.as_bytes(), text.len() as u64, 64);
        while input.left() > 0 {
            let expected = 1 + text[..input.position() as usize].matches('\n').count() as u64;
            assert_eq!(input.line_at(input.position()), expected);
            let step = input.fill(7).unwrap().len().min(7);
            input.consume(step);
        }
    }

    #[test]
    fn long_comments_are_cut_and_long_lines_refused() {
        let long = "x".repeat(3 * BUFFER);
        let text = format!("a\n  #{long}\nb");
        let mut input = Input::of_slice(text.as_bytes());
        let mut lines = Lines::new(&mut input).unwrap();
        assert_eq!(lines.next(b'#').unwrap(), Some((1, &b"a"[..])));
        assert_eq!(lines.next(b'#').unwrap(), Some((2, &b""[..])));
        assert_eq!(lines.next(b'#').unwrap(), Some((3, &b"b"[..])));
        assert_eq!(lines.next(b'#').unwrap(), None);
        let text = format!("a\n{long}");
        let mut input = Input::of_slice(text.as_bytes());
        let mut lines = Lines::new(&mut input).unwrap();
        lines.next(b'#').unwrap();
        assert_eq!(lines.next(b'#').unwrap_err().to_string(), "line 2: the line is longer than 1048576 bytes");
    }
}
