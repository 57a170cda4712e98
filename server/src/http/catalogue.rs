//! The list of models and a page for each, for people and as JSON.

use std::fmt::Write as _;
use std::sync::Arc;

use axum::Json;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};

use super::error::{HttpError, wants_json};
use super::models::{ModelEntry, ModelStatus, OpenError};
use super::{App, pages, viewer};

/// Looks of the plain pages.
const STYLE: &str = "body{font:16px/1.5 system-ui,sans-serif;max-width:1100px;margin:2rem auto;padding:0 1rem}\
    :root{color-scheme:light dark}h1{font-size:1.4rem}a{color:inherit}small{opacity:.7}pre{overflow-x:auto}\
    ul{list-style:none;padding:0;display:grid;gap:1.2rem;grid-template-columns:repeat(auto-fill,minmax(220px,1fr))}\
    li a{text-decoration:none}li a:hover b{text-decoration:underline}\
    img,.none{display:block;width:100%;height:auto;aspect-ratio:4/3;object-fit:contain;background:linear-gradient(#424448,#1e2126);border-radius:10px;margin-bottom:.4rem}";

/// `GET /models`
pub(super) async fn list(State(app): State<Arc<App>>) -> Json<Vec<ModelEntry>> {
    Json(app.models.list())
}

/// `GET /models/<id>`: JSON for those who ask for it, else the viewer, or a page that says that there is none.
pub(super) async fn model(State(app): State<Arc<App>>, Path(id): Path<String>, headers: HeaderMap) -> Response {
    let Some(entry) = app.models.list().into_iter().find(|entry| entry.id == id) else {
        return HttpError::NoSuchModel(id).respond(&headers);
    };
    if wants_json(&headers) {
        let mut response = Json(entry).into_response();
        response.headers_mut().insert(header::VARY, header::HeaderValue::from_static("accept"));
        return response;
    }
    apart(&headers, move |headers| viewer(&app, &entry, headers).unwrap_or_else(|| lonely(&entry, headers))).await
}

/// Makes a page where reading and compressing hold nobody up.
async fn apart(headers: &HeaderMap, make: impl FnOnce(&HeaderMap) -> Response + Send + 'static) -> Response {
    let made = tokio::task::spawn_blocking({
        let headers = headers.clone();
        move || make(&headers)
    });
    made.await.unwrap_or_else(|_| HttpError::Internal.respond(headers))
}

/// The viewer's page for a model that can be streamed, if there is a viewer.
fn viewer(app: &App, entry: &ModelEntry, headers: &HeaderMap) -> Option<Response> {
    if entry.status != ModelStatus::Ready {
        return None;
    }
    // Without a picture the page is as good, only later.
    let picture = || app.models.thumbnail(&entry.id).ok().flatten();
    let html = app.viewer.page(entry, picture)?;
    Some(pages::page(headers, viewer::POLICY, html))
}

/// `GET /models/<id>/thumbnail`: the picture as PNG. A model published anew under its id has another tag, so whoever has a copy
/// asks whether it still holds.
pub(super) async fn thumbnail(State(app): State<Arc<App>>, Path(id): Path<String>, headers: HeaderMap) -> Response {
    let found = tokio::task::spawn_blocking({
        let (app, id) = (Arc::clone(&app), id.clone());
        move || app.models.thumbnail(&id)
    });
    let png = match found.await {
        Ok(Ok(Some(png))) => png,
        Ok(Ok(None)) => return HttpError::NoThumbnail(id).respond(&headers),
        Ok(Err(error)) => {
            if let OpenError::Unusable { .. } = error {
                tracing::error!("{error}");
            }
            return HttpError::from(error).respond(&headers);
        }
        Err(_) => return HttpError::Internal.respond(&headers),
    };
    let tag = format!("\"{:016x}\"", xxhash_rust::xxh3::xxh3_64(&png));
    let caching = [(header::ETAG, tag.clone()), (header::CACHE_CONTROL, "no-cache".into())];
    if pages::holds(&headers, &tag) {
        return (StatusCode::NOT_MODIFIED, caching).into_response();
    }
    (caching, [(header::CONTENT_TYPE, "image/png")], png).into_response()
}

/// `GET /`
pub(super) async fn page(State(app): State<Arc<App>>, headers: HeaderMap) -> Response {
    apart(&headers, move |headers| index(&app, headers)).await
}

fn index(app: &App, headers: &HeaderMap) -> Response {
    let mut body = String::from("<h1>Models</h1>\n");
    let models = app.models.list();
    if models.is_empty() {
        body.push_str("<p>This repository is empty. <code>lodestream-server ingest</code> adds a model.</p>\n");
        return html(headers, "Models", &body);
    }
    body.push_str("<ul>\n");
    for entry in &models {
        let id = escape(&entry.id);
        let _ = writeln!(
            body,
            "<li><a href=\"models/{id}\">{}<b>{}</b></a><br><small>{} triangles, {}{}</small></li>",
            picture(entry, "models/"),
            escape(name(entry)),
            grouped(entry.triangles),
            size(entry.bytes),
            match entry.status {
                ModelStatus::Ready => "",
                ModelStatus::Quarantined => "; not available: its file is damaged",
            }
        );
    }
    body.push_str("</ul>\n");
    html(headers, "Models", &body)
}

/// `1234567` as `1,234,567`.
fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (k, digit) in digits.chars().enumerate() {
        if k > 0 && (digits.len() - k).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// Bytes as people read them.
fn size(bytes: u64) -> String {
    match bytes {
        0..1_000 => format!("{bytes} bytes"),
        1_000..1_000_000 => format!("{:.0} kB", bytes as f64 / 1e3),
        1_000_000..1_000_000_000 => format!("{:.1} MB", bytes as f64 / 1e6),
        _ => format!("{:.2} GB", bytes as f64 / 1e9),
    }
}

/// The page of a model without a viewer.
fn lonely(entry: &ModelEntry, headers: &HeaderMap) -> Response {
    let host = headers.get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or("localhost:8080");
    let (id, host) = (escape(&entry.id), escape(host));
    let mut body = format!(
        "<h1>{}</h1>\n{}<p>{} triangles, {} vertices, {}.</p>\n",
        escape(name(entry)),
        picture(entry, ""),
        grouped(entry.triangles),
        grouped(entry.vertices),
        size(entry.bytes)
    );
    match entry.status {
        ModelStatus::Ready => {
            let _ = write!(
                body,
                "<p>This server was built without the viewer for browsers. <code>cargo xtask browser</code> builds it; a server \
                 built afterwards has it, and <code>serve --viewer target/browser/bundle</code> takes it as it is.</p>\n\
                 <p>Take a picture of the model:</p>\n\
                 <pre>lodestream snapshot http://{host}/models/{id} --output {id}.png</pre>\n"
            );
        }
        ModelStatus::Quarantined => body.push_str("<p>Its file is damaged, so it cannot be streamed.</p>\n"),
    }
    body.push_str("<p><a href=\"../\">All models</a></p>\n");
    html(headers, name(entry), &body)
}

/// The model's picture, if it has one, seen from a page below whose address `models` leads to those of models.
fn picture(entry: &ModelEntry, models: &str) -> String {
    if entry.thumbnail.is_none() {
        return "<span class=\"none\"></span>".into();
    }
    format!(
        "<img src=\"{models}{}/thumbnail\" alt=\"\" width=\"320\" height=\"240\" loading=\"lazy\">",
        escape(&entry.id)
    )
}

pub(super) fn name(entry: &ModelEntry) -> &str {
    if entry.title.is_empty() { &entry.id } else { &entry.title }
}

fn html(headers: &HeaderMap, title: &str, body: &str) -> Response {
    let page = format!(
        "<!doctype html>\n<html lang=\"en\">\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<link rel=\"icon\" href=\"data:,\">\n\
         <title>{} - Lodestream</title>\n<style>{STYLE}</style>\n{body}</html>\n",
        escape(title)
    );
    let policy = "default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'";
    pages::page(headers, policy, page)
}

pub(super) fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            c => escaped.push(c),
        }
    }
    escaped
}
