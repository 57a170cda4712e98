//! Work in parallel whose results are taken in order, with few of them waiting.

use std::collections::BTreeMap;
use std::sync::{Condvar, Mutex, PoisonError, mpsc};

/// Results that may wait for an earlier one, per thread.
const WAITING: u32 = 2;

/// Numbers handed out, and how far the results were taken.
#[derive(Default)]
struct Turns {
    next: u32,
    taken: u32,
    is_over: bool,
}

/// Calls `work` with `0 .. count` on `threads` threads, and `take` with each result on the caller's thread, in order. The first error
/// of `take` ends it. At most about three results per thread exist at any time.
pub(super) fn in_order<R: Send, E>(
    count: u32,
    threads: u32,
    work: impl Fn(u32) -> R + Sync,
    mut take: impl FnMut(u32, R) -> Result<(), E>,
) -> Result<(), E> {
    let threads = threads.clamp(1, count.max(1));
    if threads == 1 {
        return (0..count).try_for_each(|i| take(i, work(i)));
    }
    let turns = Mutex::new(Turns::default());
    let changed = Condvar::new();
    // Nothing between lock and unlock can panic, so the numbers are right even then.
    let lock = || turns.lock().unwrap_or_else(PoisonError::into_inner);
    std::thread::scope(|scope| {
        let (sender, results) = mpsc::channel();
        for _ in 0..threads {
            let sender = sender.clone();
            scope.spawn({
                let (lock, changed, work) = (&lock, &changed, &work);
                move || {
                    loop {
                        let mut turns = lock();
                        while !turns.is_over && turns.next < count && turns.next >= turns.taken + WAITING * threads {
                            turns = changed.wait(turns).unwrap_or_else(PoisonError::into_inner);
                        }
                        if turns.is_over || turns.next >= count {
                            return;
                        }
                        let i = turns.next;
                        turns.next += 1;
                        drop(turns);
                        // The receiver is gone when an error ended it.
                        if sender.send((i, work(i))).is_err() {
                            return;
                        }
                    }
                }
            });
        }
        drop(sender);
        let end = || {
            lock().is_over = true;
            changed.notify_all();
        };
        let mut waiting = BTreeMap::new();
        let mut next = 0;
        // Ends early when a worker panicked; the scope then passes the panic on.
        for (i, result) in results {
            waiting.insert(i, result);
            while let Some(result) = waiting.remove(&next) {
                if let Err(error) = take(next, result) {
                    end();
                    return Err(error);
                }
                next += 1;
                lock().taken = next;
                changed.notify_all();
            }
        }
        end();
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_come_in_order_on_any_number_of_threads() {
        for threads in [1, 2, 7] {
            let mut taken = Vec::new();
            let result: Result<(), ()> = in_order(
                100,
                threads,
                |i| {
                    // Earlier ones take longer, so that later ones have to wait.
                    (0..(100 - i) * 1000).fold(i, |sum, x| std::hint::black_box(sum ^ x));
                    i * i
                },
                |i, square| {
                    taken.push((i, square));
                    Ok(())
                },
            );
            assert_eq!(result, Ok(()));
            assert_eq!(taken, (0..100).map(|i| (i, i * i)).collect::<Vec<_>>());
        }
    }

    #[test]
    fn an_error_ends_it() {
        let mut taken = 0;
        let result = in_order(
            1000,
            4,
            |i| i,
            |i, _| {
                taken += 1;
                if i == 10 { Err("ten") } else { Ok(()) }
            },
        );
        assert_eq!((result, taken), (Err("ten"), 11));
    }
}
