//! What arrived and is not applied yet, in order.

use std::collections::VecDeque;

use lodestream_protocol::ids::BatchSeq;
use lodestream_protocol::message::{Batch, Settled};

/// Most messages that wait, whatever their size: a batch without ops still takes memory.
const MAX_ITEMS: usize = 4096;

/// One message that concerns the mesh.
#[derive(Debug)]
pub(super) enum Item {
    Batch(Batch),
    Settled(Settled),
    Restart,
}

/// A queue that is bounded by its reader: see [`Inbox::has_room`].
#[derive(Debug, Default)]
pub(super) struct Inbox {
    items: VecDeque<Item>,
    /// Bytes of ops in `items`.
    bytes: usize,
}

impl Inbox {
    pub(super) fn push(&mut self, item: Item) {
        self.bytes += op_bytes(&item);
        self.items.push_back(item);
    }

    pub(super) fn pop(&mut self) -> Option<Item> {
        let item = self.items.pop_front()?;
        self.bytes -= op_bytes(&item);
        Some(item)
    }

    /// The newest batch that has arrived, where `applied` are applied; `None` if nothing that is here or was applied is of use, because
    /// a restart is still to come.
    pub(super) fn received(&self, applied: BatchSeq, awaits_restart: bool) -> Option<BatchSeq> {
        let restart = self.items.iter().rposition(|item| matches!(item, Item::Restart));
        let (base, first) = match restart {
            Some(restart) => (0, restart + 1),
            None if awaits_restart => return None,
            None => (applied.0, 0),
        };
        let batches = self.items.range(first..).filter(|item| matches!(item, Item::Batch(_))).count();
        Some(BatchSeq(base.wrapping_add(u32::try_from(batches).unwrap_or(u32::MAX))))
    }

    /// Bytes of ops of the next item.
    pub(super) fn next_bytes(&self) -> Option<usize> {
        self.items.front().map(op_bytes)
    }

    pub(super) fn is_empty(&self) -> bool {
        self.items.is_empty()
    }

    /// Whether another item may be pushed, with `limit` in bytes of ops.
    pub(super) fn has_room(&self, limit: usize) -> bool {
        self.items.len() < MAX_ITEMS && self.bytes < limit.max(1)
    }
}

fn op_bytes(item: &Item) -> usize {
    match item {
        Item::Batch(batch) => batch.ops.len(),
        Item::Settled(_) | Item::Restart => 0,
    }
}
