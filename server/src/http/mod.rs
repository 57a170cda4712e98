//! HTTP and WebSocket: the list of models, a page for each, its stream, and what a load balancer asks.
//!
//! This layer moves bytes. What a frame means is the session's business, and which models there are the [`Models`]'.

mod catalogue;
mod error;
mod health;
mod metrics;
pub mod models;
mod pages;
mod serve;
#[cfg(test)]
mod tests;
pub mod viewer;
mod ws;

use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::routing::get;

pub use models::{ModelEntry, ModelStatus, Models, OpenError};
pub use serve::{Drained, bind, serve};
pub use viewer::Viewer;

use crate::runtime::{Admission, DriverSettings, Memory, Metrics, PageReader, Parking, Pool, Shutdown, Workers};

/// What bounds the server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Origins other than the server's own whose pages may open streams, as in `https://example.org`; `*` allows all.
    pub allowed_origins: Vec<String>,
    /// Connections that have not become streams (yet); more wait to be accepted.
    pub max_connections: u32,
    /// Sessions open at once; more are refused.
    pub max_sessions: u32,
    /// Memory that all sessions may hold, in bytes; more sessions are refused then.
    pub max_session_bytes: u64,
    /// How long a session whose connection broke is kept for its client; zero keeps none. At most `max_sessions` are kept.
    pub resume_for: Duration,
    /// Threads that compute.
    pub compute_threads: NonZeroUsize,
    /// Threads that read pages.
    pub reader_threads: NonZeroUsize,
    /// A connection that takes longer to send a request's head is closed, and so is one that idles.
    pub header_timeout: Duration,
    /// A stream is pinged this often.
    pub ping_interval: Duration,
    /// A stream that sends nothing for so long, not even an answer to a ping, is closed.
    pub idle_timeout: Duration,
    /// A stream that takes longer to take one frame is closed.
    pub write_timeout: Duration,
    /// How long a closed stream may take to say goodbye.
    pub close_timeout: Duration,
    /// How long a shutdown waits for sessions and requests to end.
    pub shutdown_deadline: Duration,
    /// Bounds of each session's driver.
    pub driver: DriverSettings,
}

/// Everything that handlers share.
pub struct App {
    models: Box<dyn Models>,
    workers: Workers,
    admission: Admission,
    shutdown: Shutdown,
    settings: Settings,
    viewer: Viewer,
}

impl App {
    /// Starts the threads that compute and read. Browsers get `viewer`.
    ///
    /// # Errors
    /// The operating system's, when it gives no threads.
    pub fn new(
        models: Box<dyn Models>,
        viewer: Viewer,
        settings: Settings,
        shutdown: Shutdown,
    ) -> std::io::Result<Arc<Self>> {
        // A session hands in one slice at a time, and a closing one may overlap with its successor.
        let pool = Pool::new(settings.compute_threads, 2 * settings.max_sessions as usize)?;
        let reader = PageReader::new(settings.reader_threads)?;
        let memory = Memory::new(settings.max_session_bytes);
        let metrics = Arc::new(Metrics::new());
        let parking = Parking::new(settings.resume_for, settings.max_sessions, Arc::clone(&metrics));
        let workers = Workers { pool, reader, metrics, memory, parking };
        let admission = Admission::new(settings.max_sessions);
        Ok(Arc::new(Self { models, workers, admission, shutdown, settings, viewer }))
    }
}

fn router(app: Arc<App>) -> Router {
    Router::new()
        .route("/", get(catalogue::page))
        .route("/models", get(catalogue::list))
        .route("/models/{id}", get(catalogue::model))
        .route("/models/{id}/stream", get(ws::stream))
        .route("/models/{id}/thumbnail", get(catalogue::thumbnail))
        .route("/viewer/{hash}/{file}", get(viewer::file))
        .route("/metrics", get(metrics::page))
        .route("/healthz", get(health::alive))
        .route("/readyz", get(health::ready))
        .fallback(error::no_such_page)
        .with_state(app)
}
