//! The clock of all stamps, for the outermost loop of a consumer. Nothing else in this crate reads
//! a clock.

use crate::Nanos;
use nix::time::{ClockId, clock_gettime};
use std::time::Duration;

/// CLOCK_MONOTONIC now \[ns\], the clock of `Header::acquired` and `Header::published`.
#[must_use]
pub fn monotonic() -> Nanos {
    // Linux always has this clock. The only other error in the manual page is a bad address.
    clock_gettime(ClockId::CLOCK_MONOTONIC).map_or(Nanos::MIN, |t| {
        Nanos(
            t.tv_sec()
                .saturating_mul(1_000_000_000)
                .saturating_add(t.tv_nsec()),
        )
    })
}

/// Sleeps until the clock shows `deadline` \[ns\].
pub(super) fn sleep_until(deadline: Nanos) {
    let left = deadline.saturating_sub(monotonic()).0;
    std::thread::sleep(Duration::from_nanos(u64::try_from(left).unwrap_or(0)));
}
