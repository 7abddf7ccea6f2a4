//! The tools of can-utils and iproute2, as a person would use them.

use crate::{PATIENCE, Process, Rig, until};
use proprio_drivers::{Claim, Id};
use std::process::Command;

/// Whether vcan0 and vcan1 are there and ours, and up; says so if not.
#[must_use]
pub fn vcan() -> bool {
    let there = std::env::var("PROPRIO_VCAN").is_ok_and(|v| v == "1");
    if !there {
        println!("skipped: PROPRIO_VCAN=1 is not set (tests/run --only vcan provides vcan0 and vcan1)");
        return false;
    }
    // A test that failed may have left them otherwise.
    for name in ["vcan0", "vcan1"] {
        if !std::path::Path::new("/sys/class/net").join(name).exists() {
            add_interface(name);
        }
        run(&format!("ip link set up dev {name}"));
    }
    true
}

/// A tool with its arguments, separated by spaces; found where an ordinary user's PATH does not lead, too.
///
/// # Panics
/// On an empty line.
#[must_use]
pub fn tool(line: &str) -> Command {
    let mut words = line.split_whitespace();
    let mut command = Command::new(words.next().expect("a tool's name"));
    let path = std::env::var("PATH").unwrap_or_default();
    command.args(words).env("PATH", format!("{path}:/usr/sbin:/sbin"));
    command
}

/// Runs a tool to its end, which must be a success.
///
/// # Panics
/// If it fails.
pub fn run(line: &str) {
    let output = tool(line).output().unwrap_or_else(|error| panic!("{line}: {error}"));
    assert!(
        output.status.success(),
        "{line}: {}: {}",
        output.status,
        String::from_utf8_lossy(&output.stderr)
    );
}

/// Makes a virtual CAN interface with CAN FD, up.
pub fn add_interface(name: &str) {
    run(&format!("ip link add dev {name} type vcan"));
    run(&format!("ip link set dev {name} mtu 72 up"));
}

/// candump's filter for what `claims` let pass: data frames of these identifiers alone.
#[must_use]
pub fn filter(claims: &[Claim]) -> String {
    let one = |claim: &Claim| match claim.id {
        // The mask's upper bits: neither an extended identifier that ends alike, nor a remote request.
        Id::Standard(id) => format!(",{id:03X}:{:08X}", claim.mask & 0x7FF | 0xC000_0000),
        Id::Extended(id) => format!(",{id:08X}:{:08X}", claim.mask & 0x1FFF_FFFF | 0xC000_0000),
    };
    claims.iter().map(one).collect()
}

/// candump, writing what it receives in the log format to its output.
pub struct Candump {
    process: Process,
    probes: usize,
}

impl Candump {
    /// Listens on `interface` with `filter`; returns once it does. `probe` is a frame that passes the filter: it is sent until candump has
    /// it, and is not part of what [`Candump::log`] gives.
    ///
    /// # Panics
    /// If candump does not start to listen.
    #[must_use]
    pub fn start(rig: &Rig, interface: &str, filter: &str, probe: &str) -> Self {
        // A buffer for a flood.
        let process = rig.spawn(
            tool(&format!("candump -d -L -r 8388608 {interface}{filter}")),
            "candump",
        );
        let mut this = Self { process, probes: 0 };
        let heard = until(PATIENCE, || {
            run(&format!("cansend {interface} {probe}"));
            (!this.process.output().is_empty()).then_some(())
        });
        assert!(heard.is_some(), "candump does not listen: {}", this.process.log());
        // Those that were on their way.
        std::thread::sleep(std::time::Duration::from_millis(200));
        this.probes = this.process.output().lines().count();
        this
    }

    /// The frames since it was started, one a line.
    #[must_use]
    pub fn log(&self) -> String {
        self.process
            .output()
            .lines()
            .skip(self.probes)
            .map(|line| format!("{line}\n"))
            .collect()
    }

    /// How many these are.
    #[must_use]
    pub fn count(&self) -> usize {
        self.process.output().lines().count() - self.probes
    }
}
