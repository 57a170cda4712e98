//! The viewer for browsers: a page for each model and the files that it loads.
//!
//! Both come from one folder (`cargo xtask browser`), embedded in the program or read from disk at the start. The files lie
//! under the hash of their contents, so browsers keep them for ever; the page carries the model's picture, so there is
//! something to see before anything else has arrived.

use std::borrow::Cow;
use std::collections::HashMap;
use std::fmt::Write as _;
use std::io;
use std::path::Path;
use std::sync::Arc;

use axum::extract::{Path as UrlPath, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use lodestream_protocol::message::{ClientMessage, Hello, PROTOCOL_VERSION};
use lodestream_protocol::wire::encode_client;

use super::App;
use super::catalogue::{escape, name};
use super::error::HttpError;
use super::models::ModelEntry;
use super::pages::{accepts, holds};
use crate::picture::{self, Window};

mod embedded {
    include!(concat!(env!("OUT_DIR"), "/viewer_files.rs"));
}

/// Triangle limits that the viewer begins with if nobody sets one: for large screens and for small ones. The page says hello
/// with them before the viewer is loaded.
const AUTO_TRIANGLES: [u32; 2] = [1_000_000, 200_000];

/// What the pages may do: run the module, draw, speak to this server, nothing else.
pub(super) const POLICY: &str = "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; \
    img-src 'self' data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'";

/// Name of the page in the folder.
const PAGE: &str = "index.html";

type Bytes = Cow<'static, [u8]>;

/// The page and its files; empty in a server that was built without them.
#[derive(Debug, Default)]
pub struct Viewer {
    page: Option<String>,
    /// By `hash/name`, compressed forms with their `.br` and `.gz`.
    files: HashMap<String, Bytes>,
}

impl Viewer {
    /// The one that this program was built with.
    pub fn embedded() -> Self {
        Self::of(embedded::FILES.iter().map(|&(name, bytes)| (name.to_owned(), Cow::Borrowed(bytes))))
    }

    /// The one in a folder.
    ///
    /// # Errors
    /// The folder cannot be read, or is none of `cargo xtask browser`.
    pub fn from_folder(folder: &Path) -> io::Result<Self> {
        let mut files = Vec::new();
        for entry in std::fs::read_dir(folder)? {
            let entry = entry?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if !entry.file_type()?.is_dir() {
                files.push((name, Cow::Owned(std::fs::read(entry.path())?)));
                continue;
            }
            for file in std::fs::read_dir(entry.path())? {
                let file = file?;
                let name = format!("{name}/{}", file.file_name().to_string_lossy());
                files.push((name, Cow::Owned(std::fs::read(file.path())?)));
            }
        }
        let viewer = Self::of(files.into_iter());
        match viewer.page {
            Some(_) => Ok(viewer),
            None => Err(io::Error::new(io::ErrorKind::NotFound, format!("there is no {PAGE}"))),
        }
    }

    fn of(files: impl Iterator<Item = (String, Bytes)>) -> Self {
        let mut files: HashMap<String, Bytes> = files.collect();
        let page = files.remove(PAGE).and_then(|page| String::from_utf8(page.into_owned()).ok());
        Self { page, files }
    }

    /// Whether there is one.
    pub fn is_there(&self) -> bool {
        self.page.is_some()
    }

    /// The page of a model, with the `picture` if there is one. `None` if there is no viewer.
    pub(super) fn page(&self, entry: &ModelEntry, picture: impl FnOnce() -> Option<Vec<u8>>) -> Option<String> {
        let mut page = self.page.clone()?;
        let poster = picture().map_or(String::new(), |png| poster(&png));
        let counts = format!("{} triangles, {} vertices.", entry.triangles, entry.vertices);
        let hint = entry.shape.as_ref().map_or(String::new(), |shape| {
            let ([x, y, z], radius) = shape.ball();
            format!("{x},{y},{z},{radius},{}", shape.smallest_limit)
        });
        for (key, value) in [
            ("{{name}}", escape(name(entry)).as_str()),
            ("{{id}}", &escape(&entry.id)),
            ("{{hello}}", &hellos()),
            ("{{hint}}", &hint),
            ("{{counts}}", &counts),
            // Last: it holds no keys, and is long.
            ("{{poster}}", &poster),
        ] {
            page = page.replace(key, value);
        }
        Some(page)
    }

    fn file(&self, name: &str, headers: &HeaderMap) -> Option<Response> {
        // The compressed forms have no addresses of their own.
        let kind = content_type(name)?;
        let plain = self.files.get(name)?;
        let packed = [("br", "br"), ("gzip", "gz")].into_iter().find_map(|(coding, extension)| {
            let file = self.files.get(&format!("{name}.{extension}"))?;
            accepts(headers, coding).then_some((coding, file))
        });
        let (coding, bytes) = packed.unwrap_or(("identity", plain));
        let tag = format!("\"{name}-{coding}\"");
        let caching = [
            (header::ETAG, tag.clone()),
            (header::CACHE_CONTROL, "public, max-age=31536000, immutable".into()),
            (header::VARY, "accept-encoding".into()),
        ];
        if holds(headers, &tag) {
            return Some((StatusCode::NOT_MODIFIED, caching).into_response());
        }
        let body = match bytes {
            Cow::Borrowed(bytes) => axum::body::Bytes::from_static(bytes),
            Cow::Owned(bytes) => axum::body::Bytes::copy_from_slice(bytes),
        };
        let mut response = (caching, [(header::CONTENT_TYPE, kind)], body).into_response();
        if packed.is_some() {
            response.headers_mut().insert(header::CONTENT_ENCODING, HeaderValue::from_static(coding));
        }
        Some(response)
    }
}

/// `GET /viewer/<hash>/<file>`
pub(super) async fn file(
    State(app): State<Arc<App>>,
    UrlPath((hash, file)): UrlPath<(String, String)>,
    headers: HeaderMap,
) -> Response {
    let name = format!("{hash}/{file}");
    let found = app.viewer.file(&name, &headers);
    found.unwrap_or_else(|| HttpError::NoSuchPage(format!("/viewer/{name}")).respond(&headers))
}

fn content_type(name: &str) -> Option<&'static str> {
    match name.rsplit_once('.')?.1 {
        "js" => Some("text/javascript"),
        "css" => Some("text/css"),
        "wasm" => Some("application/wasm"),
        _ => None,
    }
}

/// A model's picture as an element of the page: exactly where the viewer will draw the same, if the picture says what it shows.
fn poster(png: &[u8]) -> String {
    let place = picture::window(png).map_or(String::new(), |Window { left, top, width, height }| {
        // In hundredths of the square in the middle of the page, from its centre.
        let [left, top] = [left, top].map(|edge| 100.0 * (edge - 0.5));
        let [width, height] = [width, height].map(|side| 100.0 * side);
        format!(" style=\"--left:{left:.3};--top:{top:.3};--width:{width:.3};--height:{height:.3}\"")
    });
    format!("<img id=\"poster\" alt=\"\"{place} src=\"data:image/png;base64,{}\">", base64(png))
}

/// First messages for the automatic limits, as `limit:hex,limit:hex`.
fn hellos() -> String {
    let hello = |triangle_limit: u32| {
        let hello = Hello { version: PROTOCOL_VERSION, triangle_limit, cache_entries: None, byte_rate: None };
        let mut text = format!("{triangle_limit}:");
        for byte in encode_client(&ClientMessage::Hello(hello)) {
            let _ = write!(text, "{byte:02x}");
        }
        text
    };
    AUTO_TRIANGLES.map(hello).join(",")
}

/// RFC 4648, section 4.
fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let byte = |k: usize| chunk.get(k).copied().map_or(0, u32::from);
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for k in 0..4 {
            let digit = DIGITS[(bits >> (18 - 6 * k) & 63) as usize];
            text.push(if k <= chunk.len() { char::from(digit) } else { '=' });
        }
    }
    text
}

#[cfg(test)]
impl Viewer {
    /// A page and a few files.
    pub(super) fn for_tests() -> Self {
        let file = |name: &str, text: &'static str| (name.to_owned(), Cow::Borrowed(text.as_bytes()));
        let page = "<title>{{name}}</title>{{poster}}<p data-hello=\"{{hello}}\" data-hint=\"{{hint}}\">";
        Self::of(
            [
                file("index.html", page),
                file("abc/main.js", "plain"),
                file("abc/main.js.br", "brotli"),
                file("abc/main.js.gz", "gzip"),
                file("abc/style.css", "p{}"),
            ]
            .into_iter(),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn viewer() -> Viewer {
        Viewer::for_tests()
    }

    fn headers(name: header::HeaderName, value: &str) -> HeaderMap {
        HeaderMap::from_iter([(name, value.parse().unwrap())])
    }

    fn coding(viewer: &Viewer, accept: &str) -> Option<String> {
        let response = viewer.file("abc/main.js", &headers(header::ACCEPT_ENCODING, accept)).unwrap();
        response.headers().get(header::CONTENT_ENCODING).map(|value| value.to_str().unwrap().to_owned())
    }

    #[test]
    fn files_go_out_in_the_best_coding_that_the_client_takes() {
        let viewer = viewer();
        assert_eq!(coding(&viewer, "gzip, deflate, br").as_deref(), Some("br"));
        assert_eq!(coding(&viewer, "GZIP;q=0.5, br;q=0").as_deref(), Some("gzip"));
        assert_eq!(coding(&viewer, "identity"), None);
        assert_eq!(coding(&viewer, "brx"), None);
        let response = viewer.file("abc/style.css", &headers(header::ACCEPT_ENCODING, "br")).unwrap();
        assert_eq!(response.headers()[header::CONTENT_TYPE], "text/css");
        assert!(response.headers()[header::CACHE_CONTROL].to_str().unwrap().contains("immutable"));
        let tag = response.headers()[header::ETAG].to_str().unwrap().to_owned();
        let again = viewer.file("abc/style.css", &headers(header::IF_NONE_MATCH, &tag)).unwrap();
        assert_eq!(again.status(), StatusCode::NOT_MODIFIED);
        for absent in ["abc/main.js.br", "abd/main.js", "index.html", "abc/../index.html"] {
            assert!(viewer.file(absent, &HeaderMap::new()).is_none(), "{absent}");
        }
    }

    #[test]
    fn base64_is_that_of_the_rfc() {
        for (bytes, text) in
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foob", "Zm9vYg=="), ("foobar", "Zm9vYmFy")]
        {
            assert_eq!(base64(bytes.as_bytes()), text);
        }
    }

    #[test]
    fn the_page_says_hello_for_large_and_small_screens() {
        let text = hellos();
        let parts: Vec<_> = text.split(',').collect();
        assert_eq!(parts.len(), 2);
        for (part, limit) in parts.iter().zip(AUTO_TRIANGLES) {
            let hex = part.strip_prefix(&format!("{limit}:")).unwrap();
            let bytes: Vec<u8> =
                (0..hex.len() / 2).map(|k| u8::from_str_radix(&hex[2 * k..2 * k + 2], 16).unwrap()).collect();
            let Ok(ClientMessage::Hello(hello)) = lodestream_protocol::wire::decode_client(&bytes) else { panic!() };
            assert_eq!((hello.triangle_limit, hello.version), (limit, PROTOCOL_VERSION));
        }
    }
}
