//! The same work for each of many things, on all cores. What comes out is in the order of the things, and the same bits whatever number of cores there is.
//!
//! Work that itself is such work is done one after the other: all cores are taken already.

use std::cell::Cell;
use std::ops::Range;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

thread_local! {
    /// Whether this thread is one of those at work.
    static AT_WORK: Cell<bool> = const { Cell::new(false) };
}

/// `work` of each number below `count`.
pub(super) fn map<T: Send>(count: usize, work: impl Fn(usize) -> T + Sync) -> Vec<T> {
    map_with(count, || (), |(), number| work(number))
}

/// `work` of each number below `count`, with something that every thread makes for itself: room to work in, of which no result may depend on what an earlier one left there.
pub(super) fn map_with<S, T: Send>(
    count: usize,
    make: impl Fn() -> S + Sync,
    work: impl Fn(&mut S, usize) -> T + Sync,
) -> Vec<T> {
    let threads = std::thread::available_parallelism().map_or(1, usize::from).min(count);
    if threads < 2 || AT_WORK.get() {
        let mut own = make();
        return (0..count).map(|number| work(&mut own, number)).collect();
    }
    let results: Vec<Mutex<Option<T>>> = (0..count).map(|_| Mutex::new(None)).collect();
    let next = AtomicUsize::new(0);
    let run = || {
        AT_WORK.set(true);
        let mut own = make();
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            let Some(result) = results.get(number) else { break };
            let done = work(&mut own, number);
            if let Ok(mut result) = result.lock() {
                *result = Some(done);
            }
        }
    };
    std::thread::scope(|scope| {
        for _ in 1..threads {
            scope.spawn(run);
        }
        run();
        AT_WORK.set(false);
    });
    let taken = results.into_iter().filter_map(|result| result.into_inner().ok());
    taken.flatten().collect()
}

/// Numbers in a piece: many enough that a thread is not worth more than what it does.
const PIECE: usize = 2048;

/// `work` of consecutive numbers, of all below `count`: what it gives of each piece, one behind the other.
pub(super) fn in_pieces<T: Send>(count: usize, work: impl Fn(Range<usize>) -> Vec<T> + Sync) -> Vec<T> {
    let pieces = map(count.div_ceil(PIECE), |number| {
        work(number * PIECE..count.min((number + 1) * PIECE))
    });
    pieces.into_iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_are_put_together_again() {
        for count in [0, 1, PIECE, 3 * PIECE + 7] {
            let all = in_pieces(count, |range| range.map(|number| 3 * number).collect());
            assert_eq!(all, (0..count).map(|n| 3 * n).collect::<Vec<_>>());
        }
    }

    #[test]
    fn results_are_in_the_order_of_what_they_are_of() {
        for count in [0, 1, 2, 1000] {
            let squares = map(count, |number| number * number);
            assert_eq!(squares, (0..count).map(|n| n * n).collect::<Vec<_>>());
        }
    }

    #[test]
    fn work_within_work_is_done_by_the_same_thread() {
        let threads = map(8, |_| {
            let own = std::thread::current().id();
            map(8, |_| std::thread::current().id()).iter().all(|id| *id == own)
        });
        assert_eq!(threads, [true; 8]);
        // Afterwards all cores are free again.
        assert!(!AT_WORK.get());
    }

    #[test]
    fn every_thread_makes_its_own() {
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        let made = AtomicUsize::new(0);
        let numbers = map_with(
            100,
            || made.fetch_add(1, Ordering::Relaxed),
            |own, number| (*own < threads).then_some(number),
        );
        assert_eq!(numbers, (0..100).map(Some).collect::<Vec<_>>());
        assert!((1..=threads).contains(&made.into_inner()));
    }
}
