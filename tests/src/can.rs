//! The tools of can-utils and iproute2.

use crate::{PATIENCE, Process, Rig, until};
use proprio_drivers::{Claim, Id};
use std::process::Command;

/// Whether vcan0 and vcan1 exist, belong to this test and are up; prints a note if not.
#[must_use]
pub fn vcan() -> bool {
    let there = std::env::var("PROPRIO_VCAN").is_ok_and(|v| v == "1");
    if !there {
        println!(
            "skipped: PROPRIO_VCAN=1 is not set (tests/run --only vcan provides vcan0 and vcan1)"
        );
        return false;
    }
    // An earlier, failed test may have changed them.
    for name in ["vcan0", "vcan1"] {
        if !std::path::Path::new("/sys/class/net").join(name).exists() {
            add_interface(name);
        }
        run(&format!("ip link set up dev {name}"));
    }
    true
}

/// A tool with its arguments, separated by spaces; also searched in sbin folders, which may not be
/// in PATH.
///
/// # Panics
/// If the line is empty.
#[must_use]
pub fn tool(line: &str) -> Command {
    let mut words = line.split_whitespace();
    let mut command = Command::new(words.next().expect("a tool's name"));
    let path = std::env::var("PATH").unwrap_or_default();
    command
        .args(words)
        .env("PATH", format!("{path}:/usr/sbin:/sbin"));
    command
}

/// Runs a tool until it ends; it must succeed.
///
/// # Panics
/// If it fails.
pub fn run(line: &str) {
    let output = tool(line)
        .output()
        .unwrap_or_else(|error| panic!("{line}: {error}"));
    assert!(
        output.status.success(),
        "{line}: {}: {}",
        output.status,
        String::from_utf8_lossy(&output.stderr)
    );
}

/// Creates a virtual CAN interface with CAN FD and brings it up.
pub fn add_interface(name: &str) {
    run(&format!("ip link add dev {name} type vcan"));
    run(&format!("ip link set dev {name} mtu 72 up"));
}

/// candump's filter for `claims`: only data frames of these identifiers.
#[must_use]
pub fn filter(claims: &[Claim]) -> String {
    let one = |claim: &Claim| match claim.id {
        // The mask's upper bits exclude remote requests and extended identifiers with the same low
        // bits.
        Id::Standard(id) => format!(",{id:03X}:{:08X}", claim.mask & 0x7FF | 0xC000_0000),
        Id::Extended(id) => format!(",{id:08X}:{:08X}", claim.mask & 0x1FFF_FFFF | 0xC000_0000),
    };
    claims.iter().map(one).collect()
}

/// A candump process that writes received frames in the log format to its output.
pub struct Candump {
    process: Process,
    probes: usize,
}

impl Candump {
    /// Listens on `interface` with `filter`; returns when it listens. `probe` is a frame that
    /// passes the filter: it is sent until candump receives it, and is not part of
    /// [`Candump::log`].
    ///
    /// # Panics
    /// If candump does not start to listen.
    #[must_use]
    pub fn start(rig: &Rig, interface: &str, filter: &str, probe: &str) -> Self {
        // A large buffer for many frames.
        let process = rig.spawn(
            tool(&format!("candump -d -L -r 8388608 {interface}{filter}")),
            "candump",
        );
        let mut this = Self { process, probes: 0 };
        let heard = until(PATIENCE, || {
            run(&format!("cansend {interface} {probe}"));
            (!this.process.output().is_empty()).then_some(())
        });
        assert!(
            heard.is_some(),
            "candump does not listen: {}",
            this.process.log()
        );
        // Wait for probes still in transit.
        std::thread::sleep(std::time::Duration::from_millis(200));
        this.probes = this.process.output().lines().count();
        this
    }

    /// The frames since its start, one per line.
    #[must_use]
    pub fn log(&self) -> String {
        self.process
            .output()
            .lines()
            .skip(self.probes)
            .map(|line| format!("{line}\n"))
            .collect()
    }

    /// The number of these frames.
    #[must_use]
    pub fn count(&self) -> usize {
        self.process.output().lines().count() - self.probes
    }
}
