//! The one token that every loop waits on beside its work.

use std::sync::Arc;

use tokio::sync::watch;

/// Says "stop", and later perhaps "now", to everyone who holds a clone.
#[derive(Clone, Debug)]
pub struct Shutdown {
    phase: Arc<watch::Sender<Phase>>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Phase {
    Running,
    Stopping,
    Hurrying,
}

impl Default for Shutdown {
    fn default() -> Self {
        Self { phase: Arc::new(watch::Sender::new(Phase::Running)) }
    }
}

impl Shutdown {
    /// Stops everything that waits on this token. Calling it again changes nothing.
    pub fn trigger(&self) {
        self.raise(Phase::Stopping);
    }

    /// Stops, and waits for nobody any more.
    pub fn hurry(&self) {
        self.raise(Phase::Hurrying);
    }

    /// Whether it is time to stop.
    pub fn is_triggered(&self) -> bool {
        *self.phase.borrow() >= Phase::Stopping
    }

    /// Waits until it is time to stop.
    pub async fn triggered(&self) {
        self.reached(Phase::Stopping).await;
    }

    /// Waits until it is time to cut off what still runs.
    pub async fn hurried(&self) {
        self.reached(Phase::Hurrying).await;
    }

    /// Triggers at the first signal that asks the process to stop (SIGINT or SIGTERM, Ctrl-C elsewhere) and hurries at the
    /// second. To be called where [`block_on`](super::block_on) runs.
    ///
    /// # Errors
    /// The operating system's, when it takes no handler.
    pub fn follow_signals(&self) -> std::io::Result<()> {
        let mut signals = Signals::new()?;
        let shutdown = self.clone();
        tokio::spawn(async move {
            let signal = signals.next().await;
            tracing::info!(signal, "shutting down");
            shutdown.trigger();
            let signal = signals.next().await;
            tracing::warn!(signal, "shutting down at once");
            shutdown.hurry();
        });
        Ok(())
    }

    fn raise(&self, phase: Phase) {
        self.phase.send_modify(|current| *current = phase.max(*current));
    }

    async fn reached(&self, phase: Phase) {
        // The sender lives as long as `self`, so waiting cannot fail.
        let _ = self.phase.subscribe().wait_for(|current| *current >= phase).await;
    }
}

#[cfg(unix)]
struct Signals {
    terminate: tokio::signal::unix::Signal,
    interrupt: tokio::signal::unix::Signal,
}

#[cfg(unix)]
impl Signals {
    fn new() -> std::io::Result<Self> {
        use tokio::signal::unix::{SignalKind, signal};
        Ok(Self { terminate: signal(SignalKind::terminate())?, interrupt: signal(SignalKind::interrupt())? })
    }

    async fn next(&mut self) -> &'static str {
        tokio::select! {
            _ = self.terminate.recv() => "SIGTERM",
            _ = self.interrupt.recv() => "SIGINT",
        }
    }
}

#[cfg(not(unix))]
struct Signals;

#[cfg(not(unix))]
impl Signals {
    fn new() -> std::io::Result<Self> {
        Ok(Self)
    }

    async fn next(&mut self) -> &'static str {
        match tokio::signal::ctrl_c().await {
            Ok(()) => "Ctrl-C",
            // Without a handler the system ends the process at Ctrl-C.
            Err(_) => std::future::pending().await,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn waiting_ends_for_those_before_and_after() {
        let shutdown = Shutdown::default();
        let waiting = tokio::spawn({
            let shutdown = shutdown.clone();
            async move { shutdown.triggered().await }
        });
        assert!(!shutdown.is_triggered());
        shutdown.trigger();
        waiting.await.unwrap();
        shutdown.triggered().await;
        assert!(shutdown.is_triggered());
        shutdown.hurry();
        shutdown.trigger();
        shutdown.hurried().await;
    }
}
