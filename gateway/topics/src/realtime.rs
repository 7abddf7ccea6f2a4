//! Scheduling of real-time threads in gateway, estimator and control loops: processor affinity,
//! SCHED_FIFO, locked memory.

use crate::maps::{self, Mapping};
use nix::libc;
use nix::sched::{CpuSet, sched_setaffinity};
use nix::unistd::Pid;
use std::format;
use std::io;
use std::string::{String, ToString};
use std::vec::Vec;
use thread_priority::unix::{
    RealtimeThreadSchedulePolicy, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};
use thread_priority::{Error, ThreadPriority, ThreadPriorityValue};

/// Stack of a thread that needs little \[bytes\]: all of it counts as locked memory. The usual two
/// megabytes for each of sixteen buses would be most of what the gateway locks.
pub const SMALL_STACK: usize = 512 << 10;

/// Locks the memory that this process has now: code, data, heap, stacks, mapped shared memory. What
/// has been touched stays in memory, and what is touched later stays from then on. (Pages of shared
/// memory are allocated when its file is made.)
///
/// `mlockall` also counts address space that is only reserved, as by the C library for the heap of
/// each thread: hundreds of megabytes, of which a few are used.
#[allow(unsafe_code)]
fn lock_memory() -> io::Result<()> {
    for line in maps::own()?.lines() {
        let Some(mapping) = Mapping::parse(line).filter(Mapping::is_readable) else {
            continue;
        };
        let (start, length) = (mapping.start as *const _, mapping.length());
        // SAFETY: a locked page differs from another in nothing that a program can see; a range
        // that was unmapped meanwhile is an error.
        if unsafe { libc::mlock2(start, length, libc::MLOCK_ONFAULT) } != 0 {
            let error = io::Error::last_os_error();
            let is_there = maps::own()?.lines().any(|other| other == line);
            if is_there {
                return Err(error);
            }
        }
    }
    Ok(())
}

/// Binds the calling thread to `cpu`; gives it SCHED_FIFO `priority` (1 to 99) and locks the
/// memory that the process has. `None` leaves a setting as it is. A setting that is not granted is
/// not fatal.
///
/// Returns one message per setting that was not granted, with the way to grant it.
#[must_use]
pub fn apply(cpu: Option<usize>, priority: Option<i32>) -> Vec<String> {
    let mut refused = Vec::new();
    if let Some(cpu) = cpu {
        let mut set = CpuSet::new();
        if let Err(error) = set
            .set(cpu)
            .and_then(|()| sched_setaffinity(Pid::from_raw(0), &set))
        {
            refused.push(format!(
                "processor {cpu}: {error}; `nproc` prints the number of processors"
            ));
        }
    }
    if let Some(priority) = priority {
        if let Err(error) = lock_memory() {
            refused.push(format!(
                "locked memory: {error}; set LimitMEMLOCK=infinity in the systemd unit"
            ));
        }
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        let set = u8::try_from(priority)
            .map_err(|e| e.to_string())
            .and_then(ThreadPriorityValue::try_from)
            .and_then(|p| {
                set_thread_priority_and_policy(
                    thread_native_id(),
                    ThreadPriority::Crossplatform(p),
                    policy,
                )
                .map_err(|e| match e {
                    Error::OS(code) => io::Error::from_raw_os_error(code).to_string(),
                    e => e.to_string(),
                })
            });
        if let Err(error) = set {
            refused.push(format!(
                "SCHED_FIFO {priority}: {error}; set LimitRTPRIO={priority} in the systemd unit"
            ));
        }
    }
    refused
}
