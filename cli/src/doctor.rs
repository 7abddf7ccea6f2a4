//! `proprio doctor`: checks this machine and names a remedy for every problem.

use anyhow::bail;
use nix::sys::resource::{Resource, getrlimit};
use nix::sys::socket::{AddressFamily, SockFlag, SockType};
use nix::sys::statfs::{FsType, TMPFS_MAGIC, statfs};
use proprio_drivers::{Frame, Id};
use proprio_gateway::clock::{Clock, Monotonic};
use proprio_gateway::link::adapter;
use proprio_gateway::link::interface::{Interfaces as _, Netlink};
use proprio_gateway::link::virtual_bus::VirtualBus;
use proprio_gateway::link::{Link, Received, send_by};
use proprio_topics::ipc::{Domain, DomainConfig, memory_needed};
use proprio_topics::{Controller, InterfaceHealth, Nanos};
use serde_json::json;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

/// Of a file system in memory that cannot be swapped (linux/magic.h).
const RAMFS_MAGIC: FsType = FsType(0x8584_58f6);

/// `proprio doctor`.
#[derive(clap::Args)]
pub(crate) struct DoctorArgs {
    /// Print the findings as JSON
    #[arg(long)]
    json: bool,
}

/// The result of a check.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Readiness {
    /// No problem.
    Ok,
    /// It works with limitations.
    Lacking,
    /// Proprio cannot run.
    Failed,
}

struct CheckResult {
    what: &'static str,
    verdict: Readiness,
    says: String,
    hint: String,
}

/// Runs all checks; fails if one finds that Proprio cannot run.
pub(crate) fn run(args: &DoctorArgs, domain: &DomainConfig) -> anyhow::Result<()> {
    let mut findings = vec![can()];
    findings.extend(interfaces());
    findings.extend([
        virtual_bus(domain),
        shared_memory(domain),
        buffers(),
        open_files(),
        realtime(),
        locked_memory(),
    ]);
    if args.json {
        let rows: Vec<_> = findings
            .iter()
            .map(|f| {
                json!({
                    "check": f.what, "verdict": word(f.verdict), "says": f.says, "hint": f.hint,
                })
            })
            .collect();
        print_line!("{}", serde_json::Value::from(rows));
    } else {
        for f in &findings {
            print_line!("{:<8} {:<16} {}", word(f.verdict), f.what, f.says);
            if !f.hint.is_empty() {
                print_line!("{:<26}-> {}", "", f.hint);
            }
        }
    }
    let failed: Vec<_> = findings
        .iter()
        .filter(|f| f.verdict == Readiness::Failed)
        .map(|f| f.what)
        .collect();
    if failed.is_empty() {
        Ok(())
    } else {
        bail!("this machine cannot run proprio: {}", failed.join(", "))
    }
}

const fn word(verdict: Readiness) -> &'static str {
    match verdict {
        Readiness::Ok => "ok",
        Readiness::Lacking => "lacking",
        Readiness::Failed => "FAILED",
    }
}

fn ok(what: &'static str, says: impl Into<String>) -> CheckResult {
    CheckResult {
        what,
        verdict: Readiness::Ok,
        says: says.into(),
        hint: String::new(),
    }
}

fn lacking(what: &'static str, says: impl Into<String>, hint: impl Into<String>) -> CheckResult {
    CheckResult {
        what,
        verdict: Readiness::Lacking,
        says: says.into(),
        hint: hint.into(),
    }
}

fn can() -> CheckResult {
    // SockProtocol has no CAN_RAW; family and type suffice to test whether the kernel has CAN.
    match nix::sys::socket::socket(
        AddressFamily::Can,
        SockType::Raw,
        SockFlag::SOCK_CLOEXEC,
        None,
    ) {
        Ok(_) => ok("kernel CAN", "the kernel has raw CAN sockets"),
        // An existing family refuses protocol 0; a missing family returns a different error.
        Err(nix::Error::EPROTONOSUPPORT | nix::Error::EPROTOTYPE) => {
            ok("kernel CAN", "the kernel has CAN")
        }
        Err(nix::Error::EPERM | nix::Error::EACCES) => lacking(
            "kernel CAN",
            "the kernel has CAN, but this user has no permission to open it",
            "give the process CAP_NET_RAW, or run it as another user",
        ),
        Err(error) => lacking(
            "kernel CAN",
            format!("the kernel has no CAN ({error})"),
            "`modprobe can-raw` if the kernel has it as a module; otherwise use the virtual bus: \
             source = { kind = \"virtual\", name = \"...\" }",
        ),
    }
}

fn interfaces() -> Vec<CheckResult> {
    let mut netlink = Netlink::default();
    let mut findings = Vec::new();
    let sys = Path::new(adapter::SYS);
    for present in adapter::present(sys) {
        let name = &present.interface;
        let folder = sys.join("class/net").join(name);
        let read = |file: &str| {
            fs::read_to_string(folder.join(file))
                .unwrap_or_default()
                .trim()
                .to_owned()
        };
        // With what a configuration may call its adapter.
        let system = format!(
            "{present}: {}, queue {}",
            read("operstate"),
            read("tx_queue_len")
        );
        findings.push(match netlink.ask(name) {
            Ok(health) => interface(name, &system, &health),
            Err(error) => lacking(
                INTERFACE,
                format!("{system}; its controller is not known ({error})"),
                "allow AF_NETLINK sockets",
            ),
        });
    }
    if findings.is_empty() {
        findings.push(lacking(
            INTERFACE,
            "no CAN interface",
            "`ip link add dev vcan0 type vcan && ip link set vcan0 up` creates a virtual one; `ip \
             link set can0 up type can bitrate 1000000 restart-ms 100` brings a real one up",
        ));
    }
    findings
}

const INTERFACE: &str = "CAN interfaces";

/// The finding about interface `name`, of which the system says `system`.
fn interface(name: &str, system: &str, health: &InterfaceHealth) -> CheckResult {
    let mut says = system.to_owned();
    let _ = write!(
        says,
        ", {}",
        if health.fd == 1 {
            "CAN FD"
        } else {
            "classic CAN"
        }
    );
    let controller = health.controller.get().unwrap_or_default();
    if controller != Controller::Unknown {
        let _ = write!(says, ", {} bit/s", health.bit_rate);
        if health.data_bit_rate != 0 {
            let _ = write!(says, " ({} bit/s in the data phase)", health.data_bit_rate);
        }
        let _ = write!(
            says,
            ", controller {}, error counters tx={} rx={}, restart-ms {}{}",
            controller.word(),
            health.tx_error_counter,
            health.rx_error_counter,
            health.restart_ms,
            if health.listen_only == 1 {
                ", listen-only"
            } else {
                ""
            }
        );
    }
    let _ = write!(
        says,
        "; received {} ({} errors, {} dropped), sent {} ({} errors, {} dropped)",
        health.rx_frames,
        health.rx_errors,
        health.rx_dropped,
        health.tx_frames,
        health.tx_errors,
        health.tx_dropped
    );
    let hint = match controller {
        Controller::BusOff => format!(
            "bus-off: check the cable, the termination and the bit-rate, then `ip link set {name} \
             type can restart`"
        ),
        Controller::Warning | Controller::Passive => {
            "many errors: check the cable, the termination and the bit-rate".to_owned()
        }
        // A stopped one is that of an interface that is down.
        Controller::Active | Controller::Stopped | Controller::Sleeping
            if health.restart_ms == 0 =>
        {
            format!(
                "restart-ms 0: after too many errors (bus-off) it stays off until a person \
                 restarts it; `ip link set {name} down && ip link set {name} up type can \
                 restart-ms 100`"
            )
        }
        Controller::Active | Controller::Stopped | Controller::Sleeping | Controller::Unknown => {
            return ok(INTERFACE, says);
        }
    };
    lacking(INTERFACE, says, hint)
}

fn virtual_bus(domain: &DomainConfig) -> CheckResult {
    let clock = Monotonic;
    let name = format!("doctor-{}", std::process::id());
    let test = || -> Result<Nanos, String> {
        let open = || VirtualBus::open(&domain.name, &name, &[]).map_err(|e| e.to_string());
        let (mut one, mut other) = (open()?, open()?);
        let sent = clock.now();
        send_by(
            &mut one,
            &Frame::new(Id::standard(0x123), &[1, 2, 3]),
            sent + Nanos::from_millis(100),
        )
        .map_err(|e| e.to_string())?;
        match other.recv(sent + Nanos::from_millis(500)) {
            Received::Frame(_) => Ok(clock.now() - sent),
            _ => Err("a frame sent on it does not arrive; is the loopback interface up?".into()),
        }
    };
    match test() {
        Ok(took) => ok(
            "virtual bus",
            format!("a frame arrives after {} us", took.0 / 1000),
        ),
        Err(problem) => lacking(
            "virtual bus",
            problem,
            "`ip link set lo up`; IPv4 multicast on it must not be filtered",
        ),
    }
}

fn shared_memory(domain: &DomainConfig) -> CheckResult {
    let probe = DomainConfig {
        name: format!("doctor-{}", std::process::id()),
        ..domain.clone()
    };
    let opened = Domain::open(&probe).map(drop);
    let _ = Domain::remove_if_unused(&probe);
    let in_memory = statfs(&probe.base)
        .is_ok_and(|system| [TMPFS_MAGIC, RAMFS_MAGIC].contains(&system.filesystem_type()));
    match opened {
        Ok(()) if !in_memory => lacking(
            "shared memory",
            format!(
                "a domain opens, but its folder {} is on a disk: starts and restarts wait for the \
                 disk, for seconds if others write to it",
                probe.base.display()
            ),
            "set PROPRIO_RUNTIME_DIR to a folder in memory, the same for all programs: \
             /dev/shm/proprio",
        ),
        Ok(()) => {
            let ([one, more], free) = memory_needed();
            let (one, more) = (one.div_ceil(1 << 20), more.div_ceil(1 << 20));
            let free = free >> 20;
            let what = format!(
                "a domain opens in {}; /dev/shm has {free} MB free, a robot needs {one} MB and \
                 {more} MB for each bus",
                probe.base.display()
            );
            if free >= one + more {
                return ok("shared memory", what);
            }
            lacking(
                "shared memory",
                what,
                "remove files in /dev/shm, or `mount -o remount,size=256M /dev/shm`; in a \
                 container --shm-size",
            )
        }
        Err(error) => CheckResult {
            verdict: Readiness::Failed,
            ..lacking(
                "shared memory",
                error.to_string(),
                "gateway, estimator and consumers need it",
            )
        },
    }
}

fn buffers() -> CheckResult {
    const WANTED: u64 = 4 << 20;
    let number = |path: &str| {
        fs::read_to_string(path)
            .ok()
            .and_then(|t| t.trim().parse::<u64>().ok())
    };
    let most = number("/proc/sys/net/core/rmem_max").unwrap_or(0);
    if most >= WANTED || has_capability(CAP_NET_ADMIN) {
        return ok("receive buffers", "a burst of thousands of frames fits");
    }
    lacking(
        "receive buffers",
        format!(
            "at most {most} bytes: room for about {} frames while the gateway is not scheduled",
            most / 768
        ),
        "`sysctl -w net.core.rmem_max=4194304`, or grant the gateway CAP_NET_ADMIN",
    )
}

fn open_files() -> CheckResult {
    // With two buses and three readers, a gateway holds 41 and an estimator 58; a bus or a reader
    // more adds two or three to each. The most buses and a dozen readers stay below this.
    const WANTED: u64 = 256;
    let limit = getrlimit(Resource::RLIMIT_NOFILE).map_or(0, |(soft, _)| soft);
    let says = format!("a process may open {limit}; a run needs {WANTED} at most");
    if limit >= WANTED {
        return ok("open files", says);
    }
    lacking(
        "open files",
        says,
        "`ulimit -n 1024` in the shell, or LimitNOFILE=1024 in the systemd unit",
    )
}

/// May exceed net.core.rmem_max (linux/capability.h).
const CAP_NET_ADMIN: u32 = 12;
/// May lock any amount of memory.
const CAP_IPC_LOCK: u32 = 14;
/// May schedule in real time.
const CAP_SYS_NICE: u32 = 23;

/// Whether this process has a capability.
fn has_capability(number: u32) -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status
        .lines()
        .find_map(|l| l.strip_prefix("CapEff:"))
        .and_then(|m| u64::from_str_radix(m.trim(), 16).ok());
    mask.is_some_and(|m| m >> number & 1 == 1)
}

fn realtime() -> CheckResult {
    let limit = getrlimit(Resource::RLIMIT_RTPRIO).map_or(0, |(soft, _)| soft);
    let rt_kernel = fs::read_to_string("/sys/kernel/realtime").is_ok_and(|t| t.trim() == "1");
    let kernel = if rt_kernel {
        "PREEMPT_RT kernel"
    } else {
        "not a PREEMPT_RT kernel"
    };
    if limit > 0 || has_capability(CAP_SYS_NICE) {
        return ok("real-time", format!("SCHED_FIFO is allowed; {kernel}"));
    }
    lacking(
        "real-time",
        format!("SCHED_FIFO is not allowed; {kernel}"),
        "LimitRTPRIO=80 in the systemd unit, or `ulimit -r 80`; needed only for realtime = \
         { priority = ... }",
    )
}

fn locked_memory() -> CheckResult {
    const WANTED: u64 = 256 << 20;
    let limit = getrlimit(Resource::RLIMIT_MEMLOCK).map_or(0, |(soft, _)| soft);
    if limit >= WANTED || has_capability(CAP_IPC_LOCK) {
        return ok("locked memory", "memory can be locked");
    }
    lacking(
        "locked memory",
        format!("at most {limit} bytes can be locked"),
        "LimitMEMLOCK=infinity in the systemd unit, or `ulimit -l unlimited`; needed only for \
         realtime = { priority = ... }",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_controller_is_described_and_its_problem_named() {
        let health = |controller: Controller, restart_ms| InterfaceHealth {
            controller: controller.in_memory(),
            bit_rate: 500_000,
            tx_error_counter: 136,
            rx_frames: 77,
            restart_ms,
            ..InterfaceHealth::default()
        };
        for (controller, restart_ms, verdict, hint) in [
            (Controller::Active, 100, Readiness::Ok, ""),
            (Controller::Active, 0, Readiness::Lacking, "restart-ms 100"),
            (Controller::Stopped, 0, Readiness::Lacking, "restart-ms 100"),
            (Controller::Passive, 100, Readiness::Lacking, "many errors"),
            (
                Controller::BusOff,
                100,
                Readiness::Lacking,
                "can5 type can restart",
            ),
            // A virtual interface has no controller.
            (Controller::Unknown, 0, Readiness::Ok, ""),
        ] {
            let finding = interface(
                "can5",
                "can5: up, queue 10",
                &health(controller, restart_ms),
            );
            assert!(finding.verdict == verdict, "{controller:?}");
            assert!(finding.hint.contains(hint), "{}", finding.hint);
            assert_eq!(finding.hint.is_empty(), verdict == Readiness::Ok);
            for fact in ["can5: up", "classic CAN", "received 77"] {
                assert!(finding.says.contains(fact), "{}", finding.says);
            }
            for fact in ["500000 bit/s", controller.word(), "tx=136"] {
                assert_eq!(
                    finding.says.contains(fact),
                    controller != Controller::Unknown,
                    "{}",
                    finding.says
                );
            }
        }
    }
}
