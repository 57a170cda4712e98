//! What a load balancer asks: is the process alive, and should it get new work.

use std::sync::Arc;

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};

use super::App;
use super::error::HttpError;

/// `GET /healthz`: the process answers.
pub(super) async fn alive() -> &'static str {
    "alive\n"
}

/// `GET /readyz`: new clients are welcome. A full server stays ready: a place may come free at any time, and taking it out
/// of service would not help those who are in.
pub(super) async fn ready(State(app): State<Arc<App>>, headers: HeaderMap) -> Response {
    if app.shutdown.is_triggered() {
        return HttpError::ShuttingDown.respond(&headers);
    }
    (StatusCode::OK, "ready\n").into_response()
}
