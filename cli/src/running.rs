//! When the verbs that read a running system end.

use anyhow::Context;
use signal_hook::consts::{SIGINT, SIGTERM};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Set by SIGINT and SIGTERM.
pub(crate) fn interrupted() -> anyhow::Result<Arc<AtomicBool>> {
    interrupted_by(&[SIGINT, SIGTERM])
}

/// Set by these signals.
pub(crate) fn interrupted_by(signals: &[i32]) -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in signals {
        signal_hook::flag::register(*signal, Arc::clone(&stop)).context("cannot catch signals")?;
    }
    Ok(stop)
}
