//! HTML for browsers: short for those who take it compressed, and with a tag by which nobody loads twice what has not changed.

use std::io::Write as _;

use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use flate2::Compression;
use flate2::write::GzEncoder;

/// A page under a content security policy, for a request of these headers. It depends on what the request accepts, of kinds and
/// of codings. Compresses, some 20 ms for a megabyte: not for threads that serve sockets, if pages can be long.
///
/// The coding is gzip: most of a long page is a picture in base64, of which brotli spares no more.
pub(super) fn page(request: &HeaderMap, policy: &'static str, html: String) -> Response {
    let packs = accepts(request, "gzip");
    let coding = if packs { "gzip" } else { "identity" };
    let tag = format!("\"{:016x}-{coding}\"", xxhash_rust::xxh3::xxh3_64(html.as_bytes()));
    let headers = [
        (header::ETAG, tag.clone()),
        (header::CACHE_CONTROL, "no-cache".into()),
        (header::VARY, "accept, accept-encoding".into()),
        (header::CONTENT_SECURITY_POLICY, policy.into()),
    ];
    if holds(request, &tag) {
        return (StatusCode::NOT_MODIFIED, headers).into_response();
    }
    let body = if packs { gzip(html.as_bytes()) } else { html.into_bytes() };
    let mut response = (headers, [(header::CONTENT_TYPE, "text/html; charset=utf-8")], body).into_response();
    if packs {
        response.headers_mut().insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
    }
    response
}

/// Whether the client has what this tag names (weak comparison, RFC 9110, 13.1.2).
pub(super) fn holds(request: &HeaderMap, tag: &str) -> bool {
    listed(request, header::IF_NONE_MATCH).any(|known| known == "*" || known.trim_start_matches("W/") == tag)
}

/// Whether the client takes this coding: named, and not with a quality of zero.
pub(super) fn accepts(request: &HeaderMap, coding: &str) -> bool {
    listed(request, header::ACCEPT_ENCODING).any(|range| {
        let mut parts = range.split(';').map(str::trim);
        parts.next().is_some_and(|name| name.eq_ignore_ascii_case(coding))
            && !parts.any(|part| part.strip_prefix("q=").is_some_and(|q| q.parse() == Ok(0.0)))
    })
}

/// The members of a header that is a list.
fn listed(request: &HeaderMap, name: HeaderName) -> impl Iterator<Item = &str> {
    let values = request.get_all(name).into_iter().collect::<Vec<_>>();
    values.into_iter().filter_map(|value| value.to_str().ok()).flat_map(|value| value.split(',')).map(str::trim)
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
    encoder.write_all(bytes).expect("memory takes all");
    encoder.finish().expect("memory takes the end")
}
