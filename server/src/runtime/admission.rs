//! Who may open a session: a place is taken before the connection is accepted and given back when it is closed.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// Every place is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the server is full: all {limit} sessions are in use, try again later")]
pub struct Full {
    /// Sessions that may be open at once.
    pub limit: u32,
}

/// A fixed number of places for sessions.
#[derive(Debug)]
pub struct Admission {
    places: Arc<Semaphore>,
    limit: u32,
    admitted: AtomicU64,
    refused: AtomicU64,
}

/// A place, given back when dropped.
#[derive(Debug)]
pub struct Admitted {
    _place: OwnedSemaphorePermit,
    /// Number of the session since the server started, from 1.
    pub number: u64,
}

impl Admission {
    /// Places for `limit` sessions.
    pub fn new(limit: u32) -> Self {
        Self {
            places: Arc::new(Semaphore::new(limit as usize)),
            limit,
            admitted: AtomicU64::new(0),
            refused: AtomicU64::new(0),
        }
    }

    /// Takes a place.
    ///
    /// # Errors
    /// [`Full`] at once when there is none: nobody waits in line.
    pub fn admit(&self) -> Result<Admitted, Full> {
        match Arc::clone(&self.places).try_acquire_owned() {
            Ok(place) => Ok(Admitted { _place: place, number: self.admitted.fetch_add(1, Ordering::Relaxed) + 1 }),
            Err(_) => {
                self.refused.fetch_add(1, Ordering::Relaxed);
                Err(Full { limit: self.limit })
            }
        }
    }

    /// Sessions open now.
    pub fn active(&self) -> u32 {
        self.limit - u32::try_from(self.places.available_permits()).unwrap_or(self.limit).min(self.limit)
    }

    /// Sessions refused since the server started.
    pub fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }

    /// Waits until no session is open. Places are taken while it waits for the last ones, so nobody else gets in.
    pub async fn wait_empty(&self) {
        // An error means that the semaphore was closed, which nothing does.
        let _ = self.places.acquire_many(self.limit).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_comes_back_when_it_is_dropped() {
        let admission = Admission::new(2);
        let first = admission.admit().unwrap();
        let second = admission.admit().unwrap();
        assert_eq!((first.number, second.number, admission.active()), (1, 2, 2));
        assert_eq!(admission.admit().unwrap_err(), Full { limit: 2 });
        drop(first);
        assert_eq!(admission.admit().unwrap().number, 3);
        assert_eq!((admission.active(), admission.refused()), (1, 1));
    }
}
