//! `GET` of a small page of the server that streams: for figures beside the stream, not for bulk.

use std::io;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::time::timeout;

use super::{LinkShape, Target, connect};

/// Longest head of an answer in bytes.
const MAX_HEAD_BYTES: usize = 16 << 10;

/// Why there is no page.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GetError {
    /// No connection, or it broke.
    #[error("the server cannot be asked")]
    Io(#[from] io::Error),
    /// It took too long.
    #[error("the server did not answer within {} ms", .0.as_millis())]
    Timeout(Duration),
    /// The answer is longer than is read.
    #[error("the answer is longer than {0} bytes")]
    TooLong(usize),
    /// Not found, not allowed and the like.
    #[error("the server answers with status {0}")]
    Status(u16),
    /// What comes is no HTTP.
    #[error("the answer is no HTTP: {0}")]
    Malformed(&'static str),
}

/// The body of what the host of `target` answers to `GET path` over a connection of its own, which no link shapes.
///
/// # Errors
/// [`GetError`]; a body is at most `max_bytes` long, and all of it is there within `limit`.
pub async fn get(target: &Target, path: &str, max_bytes: usize, limit: Duration) -> Result<Vec<u8>, GetError> {
    let answer = timeout(limit, exchange(target, path, max_bytes)).await.map_err(|_| GetError::Timeout(limit))??;
    read_answer(&answer, max_bytes)
}

/// Everything that comes until the server closes, which it is asked to do after one answer.
async fn exchange(target: &Target, path: &str, max_bytes: usize) -> Result<Vec<u8>, GetError> {
    let mut stream = connect(target, &LinkShape::default()).await?;
    let host = target.authority();
    let request = format!("GET {path} HTTP/1.1\r\nHost: {host}\r\nAccept: text/plain\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await?;
    // Chunks may be a byte each, with five bytes around it at least.
    let most = MAX_HEAD_BYTES + max_bytes.saturating_mul(2);
    let mut answer = Vec::new();
    stream.take(most as u64 + 1).read_to_end(&mut answer).await?;
    if answer.len() > most { Err(GetError::TooLong(max_bytes)) } else { Ok(answer) }
}

/// The body of a complete answer (RFC 9112, sections 4 to 7).
fn read_answer(answer: &[u8], max_bytes: usize) -> Result<Vec<u8>, GetError> {
    let head_len = answer.windows(4).take(MAX_HEAD_BYTES).position(|four| four == b"\r\n\r\n");
    let head_len = head_len.ok_or(GetError::Malformed("its head does not end"))?;
    let head = std::str::from_utf8(&answer[..head_len]).map_err(|_| GetError::Malformed("its head is no text"))?;
    let rest = &answer[head_len + 4..];
    let mut lines = head.split("\r\n");
    let mut words = lines.next().unwrap_or_default().split(' ');
    let version = words.next().unwrap_or_default();
    let status: Option<u16> = words.next().and_then(|word| word.parse().ok());
    let status = status.filter(|_| version.starts_with("HTTP/1.")).ok_or(GetError::Malformed("a bad first line"))?;
    if status != 200 {
        return Err(GetError::Status(status));
    }
    let (mut is_chunked, mut length) = (false, None);
    for line in lines {
        let (name, value) = line.split_once(':').ok_or(GetError::Malformed("a header without a colon"))?;
        let value = value.trim();
        if name.eq_ignore_ascii_case("transfer-encoding") {
            is_chunked = value.eq_ignore_ascii_case("chunked");
        } else if name.eq_ignore_ascii_case("content-length") {
            length = Some(value.parse::<usize>().map_err(|_| GetError::Malformed("a bad length"))?);
        }
    }
    let body = match (is_chunked, length) {
        (true, _) => join_chunks(rest)?,
        (false, Some(length)) => rest.get(..length).ok_or(GetError::Malformed("its body is cut off"))?.to_vec(),
        (false, None) => rest.to_vec(),
    };
    if body.len() > max_bytes { Err(GetError::TooLong(max_bytes)) } else { Ok(body) }
}

fn join_chunks(mut rest: &[u8]) -> Result<Vec<u8>, GetError> {
    const CUT: GetError = GetError::Malformed("a chunk is cut off");
    let mut body = Vec::new();
    loop {
        let end = rest.windows(2).take(64).position(|two| two == b"\r\n").ok_or(CUT)?;
        let digits = rest[..end].split(|&byte| byte == b';').next().unwrap_or_default();
        let digits = std::str::from_utf8(digits).ok().map(str::trim).filter(|digits| !digits.starts_with('+'));
        let length = digits.and_then(|digits| usize::from_str_radix(digits, 16).ok());
        let length = length.ok_or(GetError::Malformed("a chunk without a length"))?;
        rest = &rest[end + 2..];
        if length == 0 {
            return Ok(body);
        }
        body.extend_from_slice(rest.get(..length).ok_or(CUT)?);
        rest = rest[length..].strip_prefix(b"\r\n").ok_or(CUT)?;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(answer: &str) -> Result<String, String> {
        let body = read_answer(answer.as_bytes(), 20).map_err(|error| error.to_string())?;
        Ok(String::from_utf8(body).unwrap())
    }

    #[test]
    fn bodies_are_read_whichever_way_they_are_framed() {
        let check = |answer: &str, body: &str| assert_eq!(read(answer), Ok(body.into()), "{answer:?}");
        check("HTTP/1.1 200 OK\r\nContent-Length: 5\r\n\r\nhello", "hello");
        check("HTTP/1.0 200\r\nserver: x\r\n\r\nhello", "hello");
        check("HTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\nhello", "he");
        check("HTTP/1.1 200 OK\r\nTransfer-Encoding: Chunked\r\n\r\n3\r\nhel\r\n2;x=y\r\nlo\r\n0\r\n\r\n", "hello");
    }

    #[test]
    fn other_answers_are_refused_with_the_reason() {
        let check = |answer: &str, reason: &str| {
            let error = read(answer).unwrap_err();
            assert!(error.contains(reason), "{answer:?}: {error}");
        };
        check("", "does not end");
        check("HTTP/1.1 200 OK\r\n", "does not end");
        check("SSH-2.0-x\r\n\r\n", "first line");
        check("HTTP/1.1 two hundred\r\n\r\n", "first line");
        check("HTTP/1.1 404 Not Found\r\n\r\n", "status 404");
        check("HTTP/1.1 200 OK\r\nnonsense\r\n\r\n", "colon");
        check("HTTP/1.1 200 OK\r\nContent-Length: -1\r\n\r\n", "bad length");
        check("HTTP/1.1 200 OK\r\nContent-Length: 9\r\n\r\nhello", "cut off");
        check("HTTP/1.1 200 OK\r\n\r\nhello, hello and hello again", "longer than 20");
        let chunked = "HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n";
        for (chunks, reason) in [
            ("", "cut off"),
            ("ffffffffffffffff\r\nx", "cut off"),
            ("fffffffffffffffff\r\nx", "without a length"),
            ("+3\r\nhel\r\n0\r\n\r\n", "without a length"),
            ("3\r\nhello\r\n", "cut off"),
        ] {
            check(&format!("{chunked}{chunks}"), reason);
        }
    }

    #[test]
    fn no_byte_string_is_too_much() {
        let good = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n3\r\nhel\r\n0\r\n\r\n";
        let mut rng = fastrand::Rng::with_seed(3);
        for _ in 0..20_000 {
            let mut bytes = good.to_vec();
            for _ in 0..rng.usize(0..4) {
                let at = rng.usize(..bytes.len());
                bytes[at] = rng.u8(..);
            }
            bytes.truncate(rng.usize(..=bytes.len()));
            if let Ok(body) = read_answer(&bytes, 20) {
                assert!(body.len() <= 20);
            }
        }
    }
}
