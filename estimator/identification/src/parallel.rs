//! Applies a function to many items on all cores. Results are in the order of the items, and equal
//! to the bit for any number of cores.
//!
//! Nested calls run on one thread, since all cores are busy already.

use std::cell::Cell;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

thread_local! {
    /// Whether this thread is a worker.
    static AT_WORK: Cell<bool> = const { Cell::new(false) };
}

/// Applies `work` to each number below `count`.
pub fn map<T: Send>(count: usize, work: impl Fn(usize) -> T + Sync) -> Vec<T> {
    map_with(count, || (), |(), number| work(number))
}

/// Applies `work` to each number below `count`, with state that every thread makes for itself:
/// buffers whose earlier contents must not affect any result.
pub(crate) fn map_with<S, T: Send>(
    count: usize,
    make: impl Fn() -> S + Sync,
    work: impl Fn(&mut S, usize) -> T + Sync,
) -> Vec<T> {
    let threads = std::thread::available_parallelism()
        .map_or(1, usize::from)
        .min(count);
    if threads < 2 || AT_WORK.get() {
        let mut state = make();
        return (0..count).map(|number| work(&mut state, number)).collect();
    }
    let results: Vec<Mutex<Option<T>>> = (0..count).map(|_| Mutex::new(None)).collect();
    let next = AtomicUsize::new(0);
    let run = || {
        AT_WORK.set(true);
        let mut state = make();
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            let Some(result) = results.get(number) else {
                break;
            };
            let done = work(&mut state, number);
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
    let taken = results
        .into_iter()
        .filter_map(|result| result.into_inner().ok());
    taken.flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_are_in_the_order_of_the_items() {
        for count in [0, 1, 2, 1000] {
            let squares = map(count, |number| number * number);
            assert_eq!(squares, (0..count).map(|n| n * n).collect::<Vec<_>>());
        }
    }

    #[test]
    fn nested_calls_run_on_the_same_thread() {
        let threads = map(8, |_| {
            let caller = std::thread::current().id();
            map(8, |_| std::thread::current().id())
                .iter()
                .all(|id| *id == caller)
        });
        assert_eq!(threads, [true; 8]);
        // Afterwards all cores are free again.
        assert!(!AT_WORK.get());
    }

    #[test]
    fn every_thread_makes_its_own_state() {
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
