//! Threads that read pages for the sessions, so that compute threads never wait for the disk.
//!
//! Each session has a [`Reading`]: the list of pages that it wants, at most 1,024 (see [`WantedPages`]), the newest list in
//! place of the one before. That bounds the queue: so many pages for each session that may be open. Sessions take turns, a few
//! pages each, and are told after each turn. A page that several want is read once: it is ready when the others' turn comes.

use std::collections::{HashMap, VecDeque};
use std::num::NonZeroUsize;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;

use super::pool::PoolError;
use crate::pack::{PackedModel, PageId};
use crate::session::WantedPages;

/// Pages that one session is read before the next one's turn: a fraction of a millisecond from memory, tens of milliseconds
/// from a slow disk.
const PAGES_PER_TURN: usize = 16;

/// Reader threads and what they have to read.
#[derive(Debug)]
pub struct PageReader {
    shared: Arc<Shared>,
}

/// One session's place at the reader; what it wants is forgotten when this is dropped.
#[derive(Debug)]
pub struct Reading {
    shared: Arc<Shared>,
    number: u64,
    news: Arc<News>,
}

#[derive(Debug, Default)]
struct News {
    arrived: Notify,
    is_lost: AtomicBool,
}

#[derive(Debug)]
struct Shared {
    queue: Mutex<Queue>,
    has_work: Condvar,
    next_number: AtomicU64,
    pages_read: AtomicU64,
}

#[derive(Debug, Default)]
struct Queue {
    /// By number of the session; none is empty, and those that have one stand in `turns`, once each.
    lists: HashMap<u64, List>,
    turns: VecDeque<u64>,
    is_stopped: bool,
}

#[derive(Debug)]
struct List {
    model: Arc<PackedModel>,
    pages: VecDeque<PageId>,
    news: Arc<News>,
}

impl Queue {
    fn forget(&mut self, number: u64) {
        if self.lists.remove(&number).is_some() {
            self.turns.retain(|&turn| turn != number);
        }
    }
}

impl PageReader {
    /// Starts `threads` threads: more than one keep several requests at the disk.
    ///
    /// # Errors
    /// The operating system's, when it gives no thread.
    pub fn new(threads: NonZeroUsize) -> std::io::Result<Self> {
        let shared = Arc::new(Shared {
            queue: Mutex::default(),
            has_work: Condvar::new(),
            next_number: AtomicU64::new(0),
            pages_read: AtomicU64::new(0),
        });
        let reader = Self { shared };
        for number in 0..threads.get() {
            let shared = Arc::clone(&reader.shared);
            std::thread::Builder::new().name(format!("lodestream-reader-{number}")).spawn(move || shared.work())?;
        }
        Ok(reader)
    }

    /// A place for a session.
    pub fn reading(&self) -> Reading {
        let number = self.shared.next_number.fetch_add(1, Ordering::Relaxed);
        Reading { shared: Arc::clone(&self.shared), number, news: Arc::default() }
    }

    /// Pages read since the threads started.
    pub fn pages_read(&self) -> u64 {
        self.shared.pages_read.load(Ordering::Relaxed)
    }
}

impl Drop for PageReader {
    fn drop(&mut self) {
        let mut queue = self.shared.lock();
        *queue = Queue { is_stopped: true, ..Queue::default() };
        drop(queue);
        self.shared.has_work.notify_all();
    }
}

impl Reading {
    /// Reads these pages, in this order, instead of those wanted before.
    pub fn want(&self, wanted: WantedPages) {
        let mut queue = self.shared.lock();
        if wanted.pages.is_empty() || queue.is_stopped {
            queue.forget(self.number);
            return;
        }
        let (pages, news) = (wanted.pages.into(), Arc::clone(&self.news));
        if queue.lists.insert(self.number, List { model: wanted.model, pages, news }).is_none() {
            queue.turns.push_back(self.number);
        }
        drop(queue);
        self.shared.has_work.notify_one();
    }

    /// Waits until some of the pages wanted were read, or could not be, since this was last called.
    ///
    /// # Errors
    /// [`PoolError::Panicked`] if reading panicked: the pages will not come.
    pub async fn arrived(&self) -> Result<(), PoolError> {
        self.news.arrived.notified().await;
        if self.news.is_lost.load(Ordering::Relaxed) { Err(PoolError::Panicked) } else { Ok(()) }
    }
}

impl Drop for Reading {
    fn drop(&mut self) {
        self.shared.lock().forget(self.number);
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        // Pages are read outside the lock, so a poisoned one holds no half-made state.
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn work(&self) {
        while let Some((model, pages, news)) = self.next_turn() {
            let read = || {
                for &page in &pages {
                    if model.is_ready(page) {
                        continue;
                    }
                    self.pages_read.fetch_add(1, Ordering::Relaxed);
                    if let Err(error) = model.read_page(page) {
                        // The model remembers the damage and the session asks it; the log is the session's too.
                        tracing::debug!(%error, "a page cannot be read");
                        return;
                    }
                }
            };
            if catch_unwind(AssertUnwindSafe(read)).is_err() {
                news.is_lost.store(true, Ordering::Relaxed);
            }
            news.arrived.notify_one();
        }
    }

    /// Waits for work. `None` when there will be no more.
    fn next_turn(&self) -> Option<(Arc<PackedModel>, Vec<PageId>, Arc<News>)> {
        let mut guard = self.lock();
        loop {
            let queue = &mut *guard;
            if queue.is_stopped {
                return None;
            }
            let Some(number) = queue.turns.pop_front() else {
                guard = self.has_work.wait(guard).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            let Some(list) = queue.lists.get_mut(&number) else { continue };
            let pages = list.pages.drain(..list.pages.len().min(PAGES_PER_TURN)).collect();
            let turn = (Arc::clone(&list.model), pages, Arc::clone(&list.news));
            if list.pages.is_empty() {
                queue.lists.remove(&number);
            } else {
                // Another thread may go on with it at once if nobody else waits.
                queue.turns.push_back(number);
                self.has_work.notify_one();
            }
            return Some(turn);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pack::testing::{DagOptions, random_dag};
    use crate::pack::{Metadata, write_to_vec};
    use std::time::Duration;

    fn pack() -> Vec<u8> {
        let (dag, complete) = random_dag(&DagOptions { splits: 8000, spawns: 600, ..DagOptions::default() });
        write_to_vec(&dag, &complete, &Metadata::default()).unwrap()
    }

    fn all_pages(model: &PackedModel) -> Vec<PageId> {
        let patches = (0..model.spawn_count().div_ceil(crate::pack::PAGE_OPS)).map(PageId::Patches);
        (0..model.page_count()).map(PageId::Ops).chain(patches).collect()
    }

    async fn arrived(reading: &Reading) {
        tokio::time::timeout(Duration::from_secs(20), reading.arrived()).await.expect("pages arrive").unwrap();
    }

    #[tokio::test]
    async fn all_that_sessions_want_arrives_and_is_read_once() {
        let bytes = pack();
        let models = [0; 2].map(|_| Arc::new(PackedModel::from_vec(bytes.clone()).unwrap()));
        let reader = PageReader::new(NonZeroUsize::MIN).unwrap();
        let readings = [0; 6].map(|_| reader.reading());
        let pages = all_pages(&models[0]);
        assert!(pages.len() > 2 * PAGES_PER_TURN);
        for (i, reading) in readings.iter().enumerate() {
            let mut pages = pages.clone();
            if i % 3 == 1 {
                pages.reverse();
            }
            reading.want(WantedPages { model: models[i % 2].clone(), pages });
        }
        for (i, reading) in readings.iter().enumerate() {
            while !pages.iter().all(|&page| models[i % 2].is_ready(page)) {
                arrived(reading).await;
            }
        }
        assert_eq!(reader.pages_read(), 2 * pages.len() as u64);
    }

    #[tokio::test]
    async fn a_new_list_takes_the_place_of_the_old_one_and_a_dropped_one_is_forgotten() {
        let model = Arc::new(PackedModel::from_vec(pack()).unwrap());
        // No thread reads before both lists are in.
        let shared = Arc::new(Shared {
            queue: Mutex::default(),
            has_work: Condvar::new(),
            next_number: AtomicU64::new(0),
            pages_read: AtomicU64::new(0),
        });
        let reader = PageReader { shared };
        let (reading, dropped) = (reader.reading(), reader.reading());
        let want = |reading: &Reading, pages: &[u32]| {
            let pages = pages.iter().map(|&page| PageId::Ops(page)).collect();
            reading.want(WantedPages { model: model.clone(), pages });
        };
        want(&reading, &[0, 1]);
        want(&dropped, &[2]);
        want(&reading, &[5, 3]);
        drop(dropped);
        let shared = Arc::clone(&reader.shared);
        let thread = std::thread::spawn(move || shared.work());
        arrived(&reading).await;
        let ready: Vec<u32> = (0..model.page_count()).filter(|&page| model.is_ready(PageId::Ops(page))).collect();
        assert_eq!(ready, [3, 5]);
        drop(reader);
        thread.join().unwrap();
    }

    #[tokio::test]
    async fn damage_is_told_and_other_models_go_on() {
        let good = Arc::new(PackedModel::from_vec(pack()).unwrap());
        let mut bytes = pack();
        let at = bytes.len() * 2 / 3;
        bytes[at] ^= 1;
        let bad = Arc::new(PackedModel::from_vec(bytes).unwrap());
        let reader = PageReader::new(NonZeroUsize::MIN).unwrap();
        let (first, second) = (reader.reading(), reader.reading());
        first.want(WantedPages { model: bad.clone(), pages: all_pages(&bad) });
        second.want(WantedPages { model: good.clone(), pages: all_pages(&good) });
        while bad.damage().is_none() {
            arrived(&first).await;
        }
        while !all_pages(&good).iter().all(|&page| good.is_ready(page)) {
            arrived(&second).await;
        }
        assert_eq!(good.damage(), None);
    }
}
