//! Sessions by the tokens that their clients hold: those with a connection, and those *parked*, whose connection broke and whose
//! client may come back.
//!
//! A parked session takes no place of [`Admission`](super::Admission). Its memory counts like any other's, and it gives way: the one
//! parked first goes where memory is wanted for a new session, and where more are parked than may be. What a client claims to
//! hold is the session's business, see [`Core`].
//!
//! Tokens are looked up by a hash that is keyed at random, and compared in constant time, so answers tell nothing about tokens
//! that are close.

use std::collections::{BTreeSet, HashMap};
use std::hash::{BuildHasher, RandomState};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use lodestream_protocol::ids::Token;
use tokio::sync::{Notify, oneshot};
use tokio::time::Instant;

use super::driver::Core;
use super::metrics::{Account, Metrics, Resumption};

/// A session without a connection.
pub(super) struct Kept {
    pub(super) core: Box<dyn Core>,
    /// Where its time begins.
    pub(super) started: Instant,
    pub(super) account: Account,
}

/// See the module.
#[derive(Debug)]
pub struct Parking {
    keep: Duration,
    limit: usize,
    hasher: RandomState,
    metrics: Arc<Metrics>,
    table: Mutex<Table>,
}

#[derive(Debug, Default)]
struct Table {
    /// By the hash of a token: whose it is.
    tokens: HashMap<u64, (Token, u64)>,
    sessions: HashMap<u64, Entry>,
    /// Those parked and when they go, the first to go first.
    parked: BTreeSet<(Instant, u64)>,
    last_number: u64,
    is_closed: bool,
}

#[derive(Debug)]
struct Entry {
    model: Arc<str>,
    /// The token of its newest welcome, and that of the one before if the client may not have got the newest.
    newest: Token,
    known: Option<Token>,
    place: Place,
}

enum Place {
    /// It has a connection, which is told when another one asks for the session, and whoever waits for it then.
    Open {
        takeover: Arc<Notify>,
        claimant: Option<oneshot::Sender<Kept>>,
    },
    Parked {
        kept: Kept,
        until: Instant,
    },
}

impl std::fmt::Debug for Place {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Open { claimant, .. } => write!(f, "Open {{ is_claimed: {} }}", claimant.is_some()),
            Self::Parked { until, .. } => write!(f, "Parked {{ until: {until:?} }}"),
        }
    }
}

/// What a token leads to.
pub(super) enum Claim {
    /// Nothing: the client begins anew.
    Unknown,
    Parked(Kept),
    /// The session has a connection, which is asked to give it up.
    Open(oneshot::Receiver<Kept>),
}

/// A session with a connection: gone from the table when dropped.
#[derive(Debug)]
pub(super) struct Ticket {
    parking: Arc<Parking>,
    number: u64,
    pub(super) token: Token,
    takeover: Arc<Notify>,
}

impl Parking {
    /// Keeps sessions for so long, at most `limit` of them at once. Zero of either keeps none.
    pub fn new(keep: Duration, limit: u32, metrics: Arc<Metrics>) -> Arc<Self> {
        let (hasher, table) = (RandomState::new(), Mutex::default());
        Arc::new(Self { keep, limit: limit as usize, hasher, metrics, table })
    }

    /// A token for a session on `model` that has a connection now. `known` is the one by which it was [claimed](Self::claim), which
    /// stays good until [`Ticket::confirm`]. `None` if no sessions are kept.
    pub(super) fn open(self: &Arc<Self>, model: &Arc<str>, known: Option<Token>) -> Option<Ticket> {
        if self.keep.is_zero() || self.limit == 0 {
            return None;
        }
        let mut table = self.lock();
        if table.is_closed {
            return None;
        }
        // Random bits are different, or the system's source of them is broken.
        let newest = random_token().filter(|token| !table.tokens.contains_key(&self.hash(*token)))?;
        table.last_number += 1;
        let number = table.last_number;
        for token in [Some(newest), known].into_iter().flatten() {
            table.tokens.insert(self.hash(token), (token, number));
        }
        let takeover = Arc::new(Notify::new());
        let place = Place::Open { takeover: Arc::clone(&takeover), claimant: None };
        table.sessions.insert(number, Entry { model: Arc::clone(model), newest, known, place });
        Some(Ticket { parking: Arc::clone(self), number, token: newest, takeover })
    }

    /// Takes the session of `token` out, if it is one on `model`. A token is good once; one whose session another connection is
    /// waiting for is good no more.
    pub(super) fn claim(&self, token: Token, model: &str, now: Instant) -> Claim {
        let mut table = self.lock();
        let known = table.tokens.get(&self.hash(token)).filter(|(known, _)| *known == token);
        let Some(number) = known.map(|&(_, number)| number) else { return Claim::Unknown };
        let Some(entry) = table.sessions.get_mut(&number).filter(|entry| *entry.model == *model) else {
            return Claim::Unknown;
        };
        if let Place::Open { takeover, claimant } = &mut entry.place {
            if claimant.is_some() {
                return Claim::Unknown;
            }
            let (sender, receiver) = oneshot::channel();
            *claimant = Some(sender);
            takeover.notify_one();
            return Claim::Open(receiver);
        }
        match self.remove(&mut table, number).map(|entry| entry.place) {
            Some(Place::Parked { mut kept, until }) if now < until => {
                drop(table);
                kept.account.set_parked(false);
                Claim::Parked(kept)
            }
            expired => {
                drop((table, expired));
                self.metrics.note_resumption(Resumption::Expired);
                Claim::Unknown
            }
        }
    }

    /// Drops those that were parked for too long.
    pub fn expire(&self, now: Instant) {
        let mut gone = Vec::new();
        let mut table = self.lock();
        while let Some(&(until, number)) = table.parked.first().filter(|first| first.0 <= now) {
            table.parked.remove(&(until, number));
            gone.extend(self.remove(&mut table, number));
        }
        drop(table);
        gone.iter().for_each(|_| self.metrics.note_resumption(Resumption::Expired));
    }

    /// Drops the one that was parked first; whether there was one.
    pub fn displace(&self) -> bool {
        let mut table = self.lock();
        let gone = table.parked.pop_first().and_then(|(_, number)| self.remove(&mut table, number));
        drop(table);
        if gone.is_some() {
            self.metrics.note_resumption(Resumption::Displaced);
        }
        gone.is_some()
    }

    /// Drops all that are parked, and keeps none from now on.
    pub fn close(&self) {
        self.lock().is_closed = true;
        while self.displace() {}
    }

    /// How many are parked.
    pub fn len(&self) -> usize {
        self.lock().parked.len()
    }

    /// Whether none is.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    fn park(&self, number: u64, mut kept: Kept, now: Instant) -> bool {
        let mut table = self.lock();
        let Some(entry) = table.sessions.get_mut(&number) else { return false };
        if let Place::Open { claimant, .. } = &mut entry.place
            && let Some(claimant) = claimant.take()
        {
            match claimant.send(kept) {
                Ok(()) => {
                    // Which tokens are good from here on, the claimant says when it opens the session.
                    let entry = self.remove(&mut table, number);
                    drop((table, entry));
                    return true;
                }
                // It waits no more.
                Err(unclaimed) => kept = unclaimed,
            }
        }
        let is_closed = table.is_closed;
        let Some(entry) = table.sessions.get_mut(&number).filter(|_| !is_closed) else {
            drop((table, kept));
            return false;
        };
        let until = now + self.keep;
        kept.account.set_parked(true);
        entry.place = Place::Parked { kept, until };
        table.parked.insert((until, number));
        let is_over = table.parked.len() > self.limit;
        drop(table);
        self.metrics.note_resumption(Resumption::Parked);
        if is_over {
            self.displace();
        }
        true
    }

    /// Takes a session and its tokens out of the table. What it holds is to be dropped after the lock.
    fn remove(&self, table: &mut Table, number: u64) -> Option<Entry> {
        let entry = table.sessions.remove(&number)?;
        for token in [Some(entry.newest), entry.known].into_iter().flatten() {
            table.tokens.remove(&self.hash(token));
        }
        if let Place::Parked { until, .. } = &entry.place {
            table.parked.remove(&(*until, number));
        }
        Some(entry)
    }

    fn hash(&self, token: Token) -> u64 {
        self.hasher.hash_one(token.0)
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        // Nothing that holds the lock leaves the table half changed.
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// `None` where the system has no random bits to give: sessions are not resumed then.
fn random_token() -> Option<Token> {
    let mut bits = [0; 16];
    match getrandom::fill(&mut bits) {
        Ok(()) => Some(Token(bits)),
        Err(error) => {
            tracing::error!(%error, "no random bits: this session cannot be resumed");
            None
        }
    }
}

impl Ticket {
    /// Waits until another connection asks for the session.
    pub(super) async fn taken_over(&self) {
        self.takeover.notified().await;
    }

    /// The client has the newest token: the one before is good no more.
    pub(super) fn confirm(&self) {
        let mut table = self.parking.lock();
        let Some(known) = table.sessions.get_mut(&self.number).and_then(|entry| entry.known.take()) else { return };
        table.tokens.remove(&self.parking.hash(known));
    }

    /// Hands the session to the connection that asks for it, or parks it. Whether either was done.
    pub(super) fn park(self, kept: Kept, now: Instant) -> bool {
        self.parking.park(self.number, kept, now)
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        let mut table = self.parking.lock();
        let is_open = |entry: &Entry| matches!(entry.place, Place::Open { .. });
        let entry = match table.sessions.get(&self.number).is_some_and(is_open) {
            true => self.parking.remove(&mut table, self.number),
            false => None,
        };
        drop((table, entry));
    }
}

#[cfg(test)]
mod tests;
