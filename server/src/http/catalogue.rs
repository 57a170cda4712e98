//! The list of models and a page for each, for people and as JSON.

use std::fmt::Write as _;
use std::sync::Arc;

use axum::Json;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{Html, IntoResponse, Response};

use super::App;
use super::error::{HttpError, wants_json};
use super::models::{ModelEntry, ModelStatus, OpenError};

/// `GET /models`
pub(super) async fn list(State(app): State<Arc<App>>) -> Json<Vec<ModelEntry>> {
    Json(app.models.list())
}

/// `GET /models/<id>`: JSON for those who ask for it, else a page.
pub(super) async fn model(State(app): State<Arc<App>>, Path(id): Path<String>, headers: HeaderMap) -> Response {
    let Some(entry) = app.models.list().into_iter().find(|entry| entry.id == id) else {
        return HttpError::NoSuchModel(id).respond(&headers);
    };
    let mut response = if wants_json(&headers) {
        Json(entry).into_response()
    } else {
        html(name(&entry), &model_body(&entry, &headers))
    };
    response.headers_mut().insert(header::VARY, header::HeaderValue::from_static("accept"));
    response
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
    let known = headers.get(header::IF_NONE_MATCH).and_then(|tags| tags.to_str().ok()).unwrap_or_default();
    if known.split(',').any(|known| matches!(known.trim(), "*") || known.trim().trim_start_matches("W/") == tag) {
        return (StatusCode::NOT_MODIFIED, caching).into_response();
    }
    (caching, [(header::CONTENT_TYPE, "image/png")], png).into_response()
}

/// `GET /`
pub(super) async fn page(State(app): State<Arc<App>>) -> Response {
    let mut body = String::from("<h1>Models</h1>\n");
    let models = app.models.list();
    if models.is_empty() {
        body.push_str("<p>This repository is empty. <code>lodestream-server ingest</code> adds a model.</p>\n");
        return html("Models", &body);
    }
    body.push_str("<ul>\n");
    for entry in &models {
        let id = escape(&entry.id);
        let _ = writeln!(
            body,
            "<li>{}<a href=\"/models/{id}\">{}</a>: {} triangles{}</li>",
            picture(entry),
            escape(name(entry)),
            entry.triangles,
            match entry.status {
                ModelStatus::Ready => "",
                ModelStatus::Quarantined => ", not available: its file is damaged",
            }
        );
    }
    body.push_str("</ul>\n");
    html("Models", &body)
}

fn model_body(entry: &ModelEntry, headers: &HeaderMap) -> String {
    let host = headers.get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or("localhost:8080");
    let (id, host) = (escape(&entry.id), escape(host));
    let mut body = format!(
        "<h1>{}</h1>\n{}<p>{} triangles, {} vertices, {} bytes.</p>\n",
        escape(name(entry)),
        picture(entry),
        entry.triangles,
        entry.vertices,
        entry.bytes
    );
    match entry.status {
        ModelStatus::Ready => {
            let _ = write!(
                body,
                "<p>Take a picture of it:</p>\n\
                 <pre>lodestream snapshot http://{host}/models/{id} --output {id}.png</pre>\n"
            );
        }
        ModelStatus::Quarantined => body.push_str("<p>Its file is damaged, so it cannot be streamed.</p>\n"),
    }
    body.push_str("<p><a href=\"/\">All models</a></p>\n");
    body
}

/// The model's picture, if it has one.
fn picture(entry: &ModelEntry) -> String {
    let Some(address) = &entry.thumbnail else { return String::new() };
    format!("<p><img src=\"{}\" alt=\"\" loading=\"lazy\"></p>\n", escape(address))
}

fn name(entry: &ModelEntry) -> &str {
    if entry.title.is_empty() { &entry.id } else { &entry.title }
}

fn html(title: &str, body: &str) -> Response {
    let page = format!(
        "<!doctype html>\n<html lang=\"en\">\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width\">\n<title>{} - Lodestream</title>\n{body}</html>\n",
        escape(title)
    );
    ([(header::CONTENT_SECURITY_POLICY, "default-src 'none'; img-src 'self'")], Html(page)).into_response()
}

fn escape(text: &str) -> String {
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
