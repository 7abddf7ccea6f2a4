//! Scheduling of real-time threads in gateway, estimator and control loops: processor affinity,
//! SCHED_FIFO, locked memory.

use nix::sched::{CpuSet, sched_setaffinity};
use nix::sys::mman::{MlockAllFlags, mlockall};
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

/// Binds the calling thread to `cpu`; gives it SCHED_FIFO `priority` (1 to 99) and locks the
/// process's memory. `None` leaves a setting as it is. A setting that is not granted is not fatal.
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
        if let Err(error) = mlockall(MlockAllFlags::MCL_CURRENT | MlockAllFlags::MCL_FUTURE) {
            refused.push(format!(
                "locked memory: {error}; set LimitMEMLOCK=infinity in the systemd unit"
            ));
        }
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        let set = u8::try_from(priority)
            .map_err(|e| e.to_string())
            .and_then(|p| ThreadPriorityValue::try_from(p).map_err(|e| e.to_string()))
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
