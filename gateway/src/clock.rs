//! The only place that reads a clock. It also converts kernel and adapter stamps to
//! CLOCK_MONOTONIC.

use nix::errno::Errno;
use nix::sys::time::TimeSpec;
use nix::time::{ClockId, ClockNanosleepFlags, clock_gettime, clock_nanosleep};
use proprio_topics::Nanos;
use proprio_topics::ipc::monotonic;

/// A source of time.
pub trait Clock {
    /// The instant now \[ns\].
    fn now(&self) -> Nanos;
}

/// CLOCK_MONOTONIC, which never steps.
#[derive(Debug, Clone, Copy, Default)]
pub struct Monotonic;

impl Clock for Monotonic {
    fn now(&self) -> Nanos {
        monotonic()
    }
}

/// A clock that is set by hand, for tests and logs.
#[derive(Debug, Default)]
pub struct Manual(std::cell::Cell<i64>);

impl Manual {
    /// A clock that shows `now`.
    #[must_use]
    pub fn new(now: Nanos) -> Self {
        Self(std::cell::Cell::new(now.0))
    }

    /// Sets it to `now`.
    pub fn set(&self, now: Nanos) {
        self.0.set(now.0);
    }
}

impl Clock for Manual {
    fn now(&self) -> Nanos {
        Nanos(self.0.get())
    }
}

fn read(id: ClockId) -> Nanos {
    // Linux has both clocks; the call fails only for an unknown clock id.
    clock_gettime(id).map_or(Nanos::ZERO, |t| {
        Nanos(t.tv_sec() * 1_000_000_000 + t.tv_nsec())
    })
}

/// Sleeps until CLOCK_MONOTONIC shows `instant`; returns at once if it has passed.
pub fn sleep_until(instant: Nanos) {
    if instant.0 <= 0 {
        return;
    }
    let until = TimeSpec::new(instant.0 / 1_000_000_000, instant.0 % 1_000_000_000);
    // A signal wakes early; any other failure needs an unknown clock id.
    while clock_nanosleep(
        ClockId::CLOCK_MONOTONIC,
        ClockNanosleepFlags::TIMER_ABSTIME,
        &until,
    ) == Err(Errno::EINTR)
    {}
}

/// Converts the kernel's receive stamps, which are in CLOCK_REALTIME and step with it, to
/// CLOCK_MONOTONIC.
///
/// The offset is read once per batch of frames: `monotonic = realtime - offset`. A stamp cannot be
/// later than the moment it was read. A step of the wall clock between reception and reading could
/// make it earlier than the previous stamp. Therefore it is limited to that interval: the stamps of
/// one link never run backwards.
#[derive(Debug, Default)]
pub struct RealtimeToMonotonic {
    offset: i64,
    now: Nanos,
    last: Nanos,
}

impl RealtimeToMonotonic {
    /// Reads both clocks. The realtime clock is read between two readings of the monotonic one, so
    /// that a preemption in between shifts the offset by at most half of its duration. Of three
    /// tries the quickest counts.
    pub fn refresh(&mut self) {
        let mut best = i64::MAX;
        for _ in 0..3 {
            let before = read(ClockId::CLOCK_MONOTONIC);
            let wall = read(ClockId::CLOCK_REALTIME);
            let after = read(ClockId::CLOCK_MONOTONIC);
            let took = after.0 - before.0;
            self.now = after;
            if took < best {
                best = took;
                self.offset = wall.0 - (before.0 + took / 2);
            }
            if took < 1_000 {
                break;
            }
        }
    }

    /// The instant of CLOCK_MONOTONIC at which CLOCK_REALTIME showed `realtime` \[ns\], not later
    /// than the last refresh.
    #[must_use]
    pub fn convert(&self, realtime: Nanos) -> Nanos {
        Nanos((realtime.0.saturating_sub(self.offset)).min(self.now.0))
    }

    /// `stamp` (CLOCK_MONOTONIC \[ns\]), limited to the interval from the previous stamp to the
    /// last refresh.
    pub fn limit(&mut self, stamp: Nanos) -> Nanos {
        self.last = self.last.max(stamp.min(self.now));
        self.last
    }

    /// Time of the last refresh.
    #[must_use]
    pub const fn now(&self) -> Nanos {
        self.now
    }
}

/// CLOCK_REALTIME minus CLOCK_MONOTONIC now \[ns\].
#[must_use]
pub fn realtime_offset() -> Nanos {
    let mut times = RealtimeToMonotonic::default();
    times.refresh();
    Nanos(times.offset)
}

/// Converts an adapter's receive stamps, in the adapter's own clock, to CLOCK_MONOTONIC.
///
/// Each frame has two stamps, the adapter's `h` and the kernel's `s`, with `s = h + offset + d`,
/// where `d >= 0` is the frame's delay from adapter to kernel. The smallest `s - h` of the last
/// second estimates the offset plus the shortest delay. The estimate follows the drift of the
/// adapter's clock; with a drift of 50 ppm its error is at most 50 us.
///
/// A frame whose stamps disagree by more than `HardwareToMonotonic::LONGEST_WAY` is not
/// converted: the adapter's clock has been set. If it was set forward (the difference falls), the
/// estimate starts again; if back, the old offset expires after a second.
#[derive(Debug, Clone)]
pub struct HardwareToMonotonic {
    /// The smallest difference of each eighth of the last second, `i64::MAX` for none.
    smallest: [i64; Self::PARTS],
    /// Number of the newest eighth, counted from the origin of CLOCK_MONOTONIC.
    newest: i64,
}

impl Default for HardwareToMonotonic {
    fn default() -> Self {
        Self {
            smallest: [i64::MAX; Self::PARTS],
            newest: i64::MIN,
        }
    }
}

impl HardwareToMonotonic {
    const PARTS: usize = 8;
    const PART: i64 = 125_000_000;
    /// The longest plausible delay from adapter to kernel \[ns\].
    pub(crate) const LONGEST_WAY: Nanos = Nanos(100_000_000);

    /// The instant at which the adapter's clock showed `hardware`, given the kernel's stamp of the
    /// same frame (both \[ns\], the latter CLOCK_MONOTONIC); never later than that. `None` if the
    /// two stamps are inconsistent.
    pub fn convert(&mut self, hardware: Nanos, software: Nanos) -> Option<Nanos> {
        let difference = software.0.checked_sub(hardware.0)?;
        let part = software.0.div_euclid(Self::PART);
        let parts = Self::PARTS as i64;
        let known = self.smallest.iter().copied().min().unwrap_or(i64::MAX);
        let set_forward =
            known != i64::MAX && difference < known.saturating_sub(Self::LONGEST_WAY.0);
        if set_forward || part < self.newest.saturating_sub(parts) {
            self.smallest = [i64::MAX; Self::PARTS];
            self.newest = part;
        } else if part > self.newest {
            // Drop the parts older than one second.
            let passed = part.saturating_sub(self.newest).min(parts);
            for gone in 0..passed {
                self.place((part - gone).rem_euclid(parts), |smallest| {
                    *smallest = i64::MAX;
                });
            }
            self.newest = part;
        }
        self.place(part.rem_euclid(parts), |smallest| {
            *smallest = difference.min(*smallest);
        });
        let offset = self.smallest.iter().copied().min()?;
        let way = difference.checked_sub(offset)?;
        (way <= Self::LONGEST_WAY.0 && !set_forward).then(|| Nanos(software.0 - way))
    }

    fn place(&mut self, part: i64, change: impl FnOnce(&mut i64)) {
        if let Some(smallest) = usize::try_from(part)
            .ok()
            .and_then(|at| self.smallest.get_mut(at))
        {
            change(smallest);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_never_run_backwards_nor_into_the_future() {
        let mut times = RealtimeToMonotonic::default();
        times.refresh();
        let before = times.now();
        // A minute on either side, because the two clocks cannot be read at the same instant.
        let (wall, minute) = (read(ClockId::CLOCK_REALTIME), 60_000_000_000);
        let second = minute / 60;
        assert_eq!(
            times.convert(Nanos(wall.0 + minute)),
            before,
            "not later than the refresh"
        );
        let converted = times.convert(Nanos(wall.0 - minute));
        assert!(
            (converted.0 + minute - before.0).abs() < second,
            "{converted:?} {before:?}"
        );
        assert_eq!(times.limit(Nanos(before.0 - 5)), Nanos(before.0 - 5));
        assert_eq!(times.limit(Nanos(before.0 - 9)), Nanos(before.0 - 5));
        assert_eq!(times.limit(Nanos::MAX), before);
    }

    /// The largest error for frames with a delay of 20 us plus up to 980 us of jitter, from an
    /// adapter whose clock drifts by `ppm`.
    fn worst(ppm: i64) -> i64 {
        let mut estimate = HardwareToMonotonic::default();
        let mut worst = 0;
        for i in 0..5_000_i64 {
            let sent = 1_000_000_000 + i * 1_000_000;
            let hardware = 77 + (i * 1_000_000) + i * ppm;
            let software = sent + 20_000 + (i * 7_919) % 98 * 10_000;
            let Some(t) = estimate.convert(Nanos(hardware), Nanos(software)) else {
                return i64::MAX;
            };
            assert!(t.0 <= software);
            // The first frames are too few for an estimate.
            if i > 200 {
                worst = worst.max((t.0 - sent - 20_000).abs());
            }
        }
        worst
    }

    #[test]
    fn the_adapters_stamps_lose_the_jitter_of_the_kernels() {
        assert_eq!(worst(0), 0);
        for ppm in [-50, 50] {
            assert!(worst(ppm) <= 60_000, "{} ns with {ppm} ppm", worst(ppm));
        }
    }

    #[test]
    fn an_adapter_whose_clock_is_set_is_believed_again_after_a_while() {
        for jump in [-3_600_000_000_000_i64, 3_600_000_000_000] {
            let mut estimate = HardwareToMonotonic::default();
            let (mut refused, mut recovered) = (0, None);
            for i in 0..3_000_i64 {
                let software = 5_000_000_000 + i * 1_000_000;
                let hardware =
                    4_000_000_000_000 + i * 1_000_000 - 30_000 + if i < 1_500 { 0 } else { jump };
                match estimate.convert(Nanos(hardware), Nanos(software)) {
                    Some(t) => {
                        assert_eq!(t.0, software);
                        if i >= 1_500 {
                            recovered.get_or_insert(i);
                        }
                    }
                    None => refused += 1,
                }
            }
            assert!(
                refused >= 1 && recovered.is_some_and(|i| i <= 2_510),
                "{refused} {recovered:?}"
            );
        }
    }
}
