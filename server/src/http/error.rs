//! Requests that are refused: a status and one clear sentence, as JSON for those who ask for it. Causes are logged where
//! they are found, not sent.

use axum::Json;
use axum::http::{HeaderMap, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use serde_json::json;

use super::models::OpenError;
use crate::runtime::Full;
use crate::runtime::metrics::Refusal;

/// How long a client should wait before it asks a full or stopping server again, in seconds.
const RETRY_AFTER_S: &str = "5";

/// Why a request is refused.
#[derive(Debug, thiserror::Error)]
pub(super) enum HttpError {
    /// No page at this address.
    #[error("there is nothing at {0}")]
    NoSuchPage(String),
    /// No such model.
    #[error("there is no model `{0}`")]
    NoSuchModel(String),
    /// The model has no picture.
    #[error("the model `{0}` has no thumbnail")]
    NoThumbnail(String),
    /// The model's file is damaged.
    #[error("the model `{0}` cannot be used")]
    ModelUnusable(String),
    /// A page of another site wants to open a stream.
    #[error("pages of {0} may not open streams on this server")]
    ForeignOrigin(String),
    /// Not a WebSocket request.
    #[error("this address is a WebSocket: {0}")]
    NoWebSocket(String),
    /// All sessions are in use.
    #[error(transparent)]
    Full(#[from] Full),
    /// Sessions hold as much memory as they may.
    #[error("the server is full: its sessions hold all the memory they may, try again later")]
    NoMemory,
    /// The server stops.
    #[error("the server is shutting down")]
    ShuttingDown,
    /// A bug of ours.
    #[error("internal error")]
    Internal,
}

impl HttpError {
    /// Under which reason a refused stream is counted.
    pub(super) fn refusal(&self) -> Refusal {
        match self {
            Self::NoSuchPage(_) | Self::NoSuchModel(_) | Self::NoThumbnail(_) | Self::ModelUnusable(_) => {
                Refusal::Model
            }
            Self::ForeignOrigin(_) => Refusal::Origin,
            Self::NoWebSocket(_) => Refusal::NoWebSocket,
            Self::Full(_) => Refusal::Full,
            Self::NoMemory => Refusal::Memory,
            Self::ShuttingDown => Refusal::ShuttingDown,
            Self::Internal => Refusal::Internal,
        }
    }

    fn status(&self) -> StatusCode {
        match self {
            Self::NoSuchPage(_) | Self::NoSuchModel(_) | Self::NoThumbnail(_) => StatusCode::NOT_FOUND,
            Self::ForeignOrigin(_) => StatusCode::FORBIDDEN,
            Self::NoWebSocket(_) => StatusCode::UPGRADE_REQUIRED,
            Self::Full(_) | Self::NoMemory | Self::ShuttingDown => StatusCode::SERVICE_UNAVAILABLE,
            Self::ModelUnusable(_) | Self::Internal => StatusCode::INTERNAL_SERVER_ERROR,
        }
    }

    /// The answer to a request with these headers.
    pub(super) fn respond(&self, headers: &HeaderMap) -> Response {
        let status = self.status();
        let mut response = if wants_json(headers) {
            (status, Json(json!({ "error": self.to_string() }))).into_response()
        } else {
            (status, format!("{self}\n")).into_response()
        };
        match status {
            StatusCode::SERVICE_UNAVAILABLE => {
                response.headers_mut().insert(header::RETRY_AFTER, header::HeaderValue::from_static(RETRY_AFTER_S));
            }
            StatusCode::UPGRADE_REQUIRED => {
                response.headers_mut().insert(header::UPGRADE, header::HeaderValue::from_static("websocket"));
            }
            _ => {}
        }
        response
    }
}

impl From<OpenError> for HttpError {
    fn from(error: OpenError) -> Self {
        match error {
            OpenError::Unknown(id) => Self::NoSuchModel(id),
            OpenError::Unusable { id, .. } => Self::ModelUnusable(id),
        }
    }
}

/// Whether the client asks for JSON rather than a page.
pub(super) fn wants_json(headers: &HeaderMap) -> bool {
    headers
        .get_all(header::ACCEPT)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(','))
        .any(|range| range.split(';').next().is_some_and(|kind| kind.trim().eq_ignore_ascii_case("application/json")))
}

/// Answers every address that nothing else answers.
pub(super) async fn no_such_page(uri: Uri, headers: HeaderMap) -> Response {
    HttpError::NoSuchPage(uri.path().into()).respond(&headers)
}
