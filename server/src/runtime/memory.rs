//! How much memory sessions may hold together, and what happens when it runs short: sessions with nothing to do rest, and no new
//! ones are let in. What a session holds is its own account, see [`SessionStats`](crate::session::SessionStats).

use tokio::sync::Notify;

/// See the module.
#[derive(Debug)]
pub struct Memory {
    limit: u64,
    shortage: Notify,
}

impl Memory {
    /// All sessions may hold `limit` bytes.
    pub fn new(limit: u64) -> Self {
        Self { limit, shortage: Notify::new() }
    }

    /// Whether no new session may begin while so many bytes are held. Asks the others to rest.
    pub fn is_exhausted(&self, held: u64) -> bool {
        self.is_short(held) && held >= self.limit
    }

    /// Whether sessions should rest while so many bytes are held: from three quarters of the limit on. Wakes those that
    /// [wait](Self::shortage).
    pub(super) fn is_short(&self, held: u64) -> bool {
        let is_short = held >= self.limit / 4 * 3;
        if is_short {
            self.shortage.notify_waiters();
        }
        is_short
    }

    /// Waits until memory is found to be short.
    pub(super) async fn shortage(&self) {
        self.shortage.notified().await;
    }
}
