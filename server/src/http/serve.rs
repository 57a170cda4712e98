//! Accepts connections until the shutdown token says stop, then sees the open ones off.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, interval, sleep};

use super::{App, router};
use crate::runtime::Shutdown;

/// Longest head of a request, in bytes; the smallest that hyper takes is 8 KiB.
const MAX_REQUEST_HEAD_BYTES: usize = 16 << 10;

/// Pause after the operating system refused a connection, for want of file descriptors in most cases.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Between two looks for parked sessions whose time is over.
const EXPIRY_INTERVAL: Duration = Duration::from_secs(1);

/// Whether everything ended by the deadline of a shutdown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Drained {
    /// All sessions and requests ended.
    Completely,
    /// Some are cut off.
    Partly {
        /// Sessions cut off.
        sessions: u32,
    },
}

/// The address of a connection's other end: a client, or the proxy in front of it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Peer(pub(super) SocketAddr);

/// A socket that listens on `address`.
///
/// # Errors
/// The operating system's.
pub async fn bind(address: SocketAddr) -> std::io::Result<TcpListener> {
    TcpListener::bind(address).await
}

/// Serves `app` on `listener` until its shutdown token is triggered, then closes all streams and returns when they are
/// closed, at the latest after the shutdown deadline or
/// when the token says hurry.
pub async fn serve(listener: TcpListener, app: Arc<App>) -> Drained {
    let max_connections = app.settings.max_connections;
    let places = Arc::new(Semaphore::new(max_connections as usize));
    let router = router(Arc::clone(&app));
    let mut expiring = std::pin::pin!(expire(&app));
    loop {
        let (stream, peer, place) = tokio::select! {
            biased;
            () = app.shutdown.triggered() => break,
            () = &mut expiring => break,
            accepted = accept(&listener, &places) => accepted,
        };
        // Batches are small and the client waits for each: none may wait for the next to fill a segment.
        if let Err(error) = stream.set_nodelay(true) {
            tracing::debug!(%peer, %error, "connection lost before it was accepted");
            continue;
        }
        let router = router.clone().layer(Extension(Peer(peer)));
        tokio::spawn(connection(stream, router, app.settings.header_timeout, app.shutdown.clone(), place));
    }
    drop(listener);
    app.workers.parking.close();
    let all_closed = async {
        let _ = places.acquire_many(max_connections).await;
        app.admission.wait_empty().await;
    };
    tokio::select! {
        () = all_closed => Drained::Completely,
        () = sleep(app.settings.shutdown_deadline) => Drained::Partly { sessions: app.admission.active() },
        () = app.shutdown.hurried() => Drained::Partly { sessions: app.admission.active() },
    }
}

/// Drops parked sessions when their time is over, for ever.
async fn expire(app: &App) {
    let mut ticks = interval(EXPIRY_INTERVAL);
    loop {
        ticks.tick().await;
        app.workers.parking.expire(Instant::now());
    }
}

async fn accept(listener: &TcpListener, places: &Arc<Semaphore>) -> (TcpStream, SocketAddr, OwnedSemaphorePermit) {
    let place = Arc::clone(places).acquire_owned().await.expect("nothing closes the semaphore");
    loop {
        match listener.accept().await {
            Ok((stream, peer)) => return (stream, peer, place),
            Err(error) => {
                tracing::warn!(%error, "cannot accept a connection");
                sleep(ACCEPT_PAUSE).await;
            }
        }
    }
}

/// Serves one connection until it closes or becomes a stream.
async fn connection(
    stream: TcpStream,
    router: Router,
    header_timeout: Duration,
    shutdown: Shutdown,
    _place: OwnedSemaphorePermit,
) {
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(header_timeout)
        .max_buf_size(MAX_REQUEST_HEAD_BYTES)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(router))
        .with_upgrades();
    let mut connection = std::pin::pin!(connection);
    let result = tokio::select! {
        result = connection.as_mut() => result,
        () = shutdown.triggered() => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = result {
        tracing::debug!(%error, "connection ended");
    }
}
