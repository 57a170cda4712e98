//! The one token that every loop waits on beside its work.

use std::sync::Arc;

use tokio::sync::watch;

/// Says "stop" once, to everyone who holds a clone.
#[derive(Clone, Debug)]
pub struct Shutdown {
    is_triggered: Arc<watch::Sender<bool>>,
}

impl Default for Shutdown {
    fn default() -> Self {
        Self { is_triggered: Arc::new(watch::Sender::new(false)) }
    }
}

impl Shutdown {
    /// Stops everything that waits on this token. Calling it again changes nothing.
    pub fn trigger(&self) {
        self.is_triggered.send_replace(true);
    }

    /// Whether it is time to stop.
    pub fn is_triggered(&self) -> bool {
        *self.is_triggered.borrow()
    }

    /// Waits until it is time to stop.
    pub async fn triggered(&self) {
        // The sender lives as long as `self`, so waiting cannot fail.
        let _ = self.is_triggered.subscribe().wait_for(|is_triggered| *is_triggered).await;
    }

    /// Waits for the signals that ask a process to stop: SIGINT and SIGTERM, or Ctrl-C elsewhere.
    ///
    /// # Errors
    /// The operating system's, when it takes no handler.
    pub async fn signal() -> std::io::Result<&'static str> {
        #[cfg(unix)]
        {
            use tokio::signal::unix::{SignalKind, signal};
            let mut terminate = signal(SignalKind::terminate())?;
            let mut interrupt = signal(SignalKind::interrupt())?;
            Ok(tokio::select! {
                _ = terminate.recv() => "SIGTERM",
                _ = interrupt.recv() => "SIGINT",
            })
        }
        #[cfg(not(unix))]
        {
            tokio::signal::ctrl_c().await?;
            Ok("Ctrl-C")
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
    }
}
