//! The clock that all stamps are of, for the outermost loop of a consumer; nothing else in this crate reads a clock.

use crate::Nanos;
use nix::time::{ClockId, clock_gettime};

/// CLOCK_MONOTONIC now \[ns\]: what `Header::acquired` and `Header::published` are of.
#[must_use]
pub fn monotonic() -> Nanos {
    // The clock cannot be missing on Linux; the only error left by the manual page is a bad address.
    clock_gettime(ClockId::CLOCK_MONOTONIC).map_or(Nanos::MIN, |t| {
        Nanos(t.tv_sec().saturating_mul(1_000_000_000).saturating_add(t.tv_nsec()))
    })
}
