//! `GET /metrics`: what the server counts.

use std::sync::Arc;

use axum::extract::State;
use axum::http::header;
use axum::response::{IntoResponse, Response};

use super::App;
use crate::runtime::metrics::{CONTENT_TYPE, Readings};

/// `GET /metrics`
pub(super) async fn page(State(app): State<Arc<App>>) -> Response {
    let readings = Readings {
        open_models: app.models.open_count() as u64,
        pages_read: app.workers.reader.pages_read(),
        panics: app.workers.pool.panics(),
    };
    ([(header::CONTENT_TYPE, CONTENT_TYPE)], app.workers.metrics.render(readings)).into_response()
}
