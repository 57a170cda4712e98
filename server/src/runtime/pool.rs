//! Compute threads shared by all sessions.
//!
//! A session hands in one slice of work at a time and waits for it, and slices run in the order in which they were handed
//! in: between two slices of one session, every other session that has work gets one.

use std::collections::VecDeque;
use std::num::NonZeroUsize;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use tokio::sync::oneshot;
use tracing::Span;

type Slice = Box<dyn FnOnce() + Send>;

/// Why a slice gave no result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PoolError {
    /// The slice panicked; what it owned is gone.
    #[error("a compute slice panicked")]
    Panicked,
    /// More slices wait than sessions may exist.
    #[error("the compute queue is full: {limit} slices wait")]
    Full {
        /// Slices that may wait.
        limit: usize,
    },
    /// The pool was dropped before the slice ran.
    #[error("the compute pool has stopped")]
    Stopped,
}

/// A fixed number of threads and one bounded queue of slices, first in, first out.
#[derive(Debug)]
pub struct Pool {
    shared: Arc<Shared>,
}

struct Shared {
    queue: Mutex<Queue>,
    has_work: Condvar,
    limit: usize,
    panics: AtomicU64,
}

struct Queue {
    slices: VecDeque<Slice>,
    is_stopped: bool,
}

impl Pool {
    /// Starts `threads` threads. At most `max_waiting` slices wait: one for each session is enough.
    ///
    /// # Errors
    /// The operating system's, when it gives no thread.
    pub fn new(threads: NonZeroUsize, max_waiting: usize) -> std::io::Result<Self> {
        let shared = Arc::new(Shared {
            queue: Mutex::new(Queue { slices: VecDeque::new(), is_stopped: false }),
            has_work: Condvar::new(),
            limit: max_waiting,
            panics: AtomicU64::new(0),
        });
        let pool = Self { shared };
        for number in 0..threads.get() {
            let shared = Arc::clone(&pool.shared);
            std::thread::Builder::new().name(format!("lodestream-compute-{number}")).spawn(move || shared.work())?;
        }
        Ok(pool)
    }

    /// Runs `slice` on a compute thread, inside the caller's tracing span, and waits for its result.
    ///
    /// Dropping the future does not stop a slice; its result is then dropped where it ran.
    ///
    /// # Errors
    /// [`PoolError`]; `slice` and what it owned are then gone.
    pub async fn run<T: Send + 'static>(&self, slice: impl FnOnce() -> T + Send + 'static) -> Result<T, PoolError> {
        let (sender, receiver) = oneshot::channel();
        let shared = Arc::clone(&self.shared);
        let span = Span::current();
        self.shared.push(Box::new(move || {
            let _entered = span.enter();
            let result = catch_unwind(AssertUnwindSafe(slice)).map_err(|_| {
                shared.panics.fetch_add(1, Ordering::Relaxed);
                PoolError::Panicked
            });
            let _ = sender.send(result);
        }))?;
        receiver.await.unwrap_or(Err(PoolError::Stopped))
    }

    /// Slices that panicked since the pool started.
    pub fn panics(&self) -> u64 {
        self.shared.panics.load(Ordering::Relaxed)
    }
}

impl Drop for Pool {
    fn drop(&mut self) {
        let mut queue = self.shared.lock();
        queue.is_stopped = true;
        let slices = std::mem::take(&mut queue.slices);
        drop(queue);
        self.shared.has_work.notify_all();
        drop(slices);
    }
}

impl Shared {
    /// Slices run outside the lock, so a poisoned one holds no half-made state.
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn push(&self, slice: Slice) -> Result<(), PoolError> {
        let mut queue = self.lock();
        if queue.is_stopped {
            return Err(PoolError::Stopped);
        }
        if queue.slices.len() >= self.limit {
            return Err(PoolError::Full { limit: self.limit });
        }
        queue.slices.push_back(slice);
        drop(queue);
        self.has_work.notify_one();
        Ok(())
    }

    fn work(&self) {
        loop {
            let mut queue = self.lock();
            let slice = loop {
                if queue.is_stopped {
                    return;
                }
                match queue.slices.pop_front() {
                    Some(slice) => break slice,
                    None => queue = self.has_work.wait(queue).unwrap_or_else(PoisonError::into_inner),
                }
            };
            drop(queue);
            // A result that nobody waits for is dropped in here, and dropping may panic too.
            if catch_unwind(AssertUnwindSafe(slice)).is_err() {
                self.panics.fetch_add(1, Ordering::Relaxed);
            }
        }
    }
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared").field("limit", &self.limit).field("panics", &self.panics).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc;

    fn pool(threads: usize, max_waiting: usize) -> Pool {
        Pool::new(NonZeroUsize::new(threads).unwrap(), max_waiting).unwrap()
    }

    #[tokio::test]
    async fn a_panic_is_counted_and_the_thread_goes_on() {
        let pool = pool(1, 4);
        assert_eq!(pool.run(|| panic!("expected in this test")).await.map(|(): ()| ()), Err(PoolError::Panicked));
        assert_eq!(pool.run(|| 7).await, Ok(7));
        assert_eq!(pool.panics(), 1);
    }

    #[tokio::test]
    async fn a_panic_while_an_unwanted_result_is_dropped_is_counted_too() {
        struct Bomb;
        impl Drop for Bomb {
            fn drop(&mut self) {
                panic!("expected in this test");
            }
        }
        let pool = pool(1, 4);
        let (release, wait) = mpsc::channel::<()>();
        {
            let abandoned = pool.run(move || {
                let _ = wait.recv();
                Bomb
            });
            let mut abandoned = std::pin::pin!(abandoned);
            tokio::select! {
                biased;
                _ = &mut abandoned => unreachable!("the slice waits"),
                () = std::future::ready(()) => {}
            }
        }
        release.send(()).unwrap();
        assert_eq!(pool.run(|| 7).await, Ok(7));
        assert_eq!(pool.panics(), 1);
    }

    #[tokio::test]
    async fn slices_run_in_order_and_too_many_are_refused() {
        let pool = pool(1, 2);
        let (started, has_started) = oneshot::channel();
        let (release, wait) = mpsc::channel::<()>();
        let order = Arc::new(Mutex::new(Vec::new()));
        let note = |n: u32| {
            let order = Arc::clone(&order);
            move || order.lock().unwrap().push(n)
        };
        let blocker = pool.run(move || {
            started.send(()).unwrap();
            let _ = wait.recv();
        });
        let rest = async {
            has_started.await.unwrap();
            let (first, second) = (pool.run(note(1)), pool.run(note(2)));
            let third = async {
                assert_eq!(pool.run(note(3)).await, Err(PoolError::Full { limit: 2 }));
                release.send(()).unwrap();
            };
            let (first, second, ()) = tokio::join!(biased; first, second, third);
            (first, second)
        };
        let (blocked, results) = tokio::join!(blocker, rest);
        assert_eq!((blocked, results), (Ok(()), (Ok(()), Ok(()))));
        assert_eq!(*order.lock().unwrap(), [1, 2]);
    }
}
