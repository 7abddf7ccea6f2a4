//! Independent runs on all processors, for the long sets.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// What `run` gives for each item, in the order of the items, without those for which it gives
/// nothing.
///
/// # Panics
/// If `run` panics.
pub fn on_all_processors<T: Sync, R: Send>(
    items: &[T],
    run: impl Fn(&T) -> Option<R> + Sync,
) -> Vec<(&T, R)> {
    let (next, done) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(|| {
                loop {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    let Some(item) = items.get(number) else {
                        return;
                    };
                    if let Some(one) = run(item) {
                        done.lock().expect("no panic").push((number, (item, one)));
                    }
                }
            });
        }
    });
    let mut done = done.into_inner().expect("no panic");
    done.sort_by_key(|(number, _)| *number);
    done.into_iter().map(|(_, one)| one).collect()
}
