//! Devices made of other people's software on a kernel CAN bus: CANopen nodes of the package
//! `canopen` (a drive that is set up as its DCF says, and an encoder), and a moteus controller that
//! speaks through the package `moteus`. They share no code with this project.
//!
//! Runs as `vcan.rs` does, if python3 is there and PROPRIO_PEERS names a folder with the packages
//! of `tests/peers-on-bus/requirements.txt` (`tests/run --only vcan` makes it).
#![allow(missing_docs)]

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use proprio_tests::can::vcan;
use proprio_tests::watch::{Newest, Recorder, count};
use proprio_tests::{PATIENCE, Process, Rig, uml, until};
use proprio_topics::{
    Counter, DeviceHealth, DeviceState, GatewayHealth, JointState, Nanos, Quality, Reading, Sample,
};
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

const ROBOT: &str = "peers";

/// The folder with the packages, if these tests can run; else says why not.
fn packages() -> Option<PathBuf> {
    if !vcan() {
        return None;
    }
    let Some(folder) = std::env::var_os("PROPRIO_PEERS").map(PathBuf::from) else {
        println!("skipped: PROPRIO_PEERS is not set (tests/run --only vcan makes that folder)");
        return None;
    };
    if !folder.join("canopen").is_dir() || python().arg("-V").output().is_err() {
        println!("skipped: python3 or the packages of tests/peers-on-bus are not installed");
        return None;
    }
    Some(folder)
}

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The interpreter: a `python3` in PATH may be a slow script that looks for one.
fn python() -> Command {
    Command::new(std::env::var_os("PROPRIO_PYTHON").unwrap_or_else(|| "python3".into()))
}

/// A script of `tests/peers-on-bus` that has said that it is ready.
fn peer(rig: &Rig, packages: &Path, script: &str, arguments: &[&str]) -> Process {
    let mut command = python();
    command
        .arg(repository().join("tests/peers-on-bus").join(script))
        .args(arguments)
        .env("PYTHONPATH", packages);
    let mut process = rig.spawn(command, script);
    let ready = until(PATIENCE, || {
        process.assert_runs();
        process.output().contains("ready").then_some(())
    });
    assert!(ready.is_some(), "{script} is not ready: {}", process.log());
    process
}

fn signal(process: &Process, signal: Signal) {
    let id = Pid::from_raw(i32::try_from(process.id()).expect("a process number"));
    kill(id, signal).expect("the peer runs");
}

/// A gateway on vcan0 with these devices, and what it publishes.
struct Host {
    gateway: Process,
    recorder: Recorder,
    health: Newest<GatewayHealth>,
}

impl Host {
    fn start(rig: &Rig, devices: &str) -> Self {
        let config = rig.path("gateway.toml");
        let text = format!(
            "schema = 1\nrobot = \"{ROBOT}\"\n[[bus]]\nname = \"bus\"\nbit_rate = 1_000_000\n\
             source = {{ kind = \"socketcan\", interface = \"vcan0\" }}\n{devices}"
        );
        fs::write(&config, text).expect("a configuration");
        let gateway = rig.start(&["gateway", "--config", config.to_str().expect("UTF-8")]);
        let domain = rig.open();
        Self {
            gateway,
            recorder: Recorder::of_samples(&domain, ROBOT),
            health: Newest::open(&domain, ROBOT),
        }
    }

    /// Waits until the samples from now on fulfil `enough`, and returns them.
    fn samples(&mut self, what: &str, enough: impl Fn(&[Sample]) -> bool) -> Vec<Sample> {
        self.recorder.take();
        self.recorder.taken.clear();
        let found = until(PATIENCE, || {
            self.gateway.assert_runs();
            self.recorder.take();
            enough(&self.recorder.taken).then_some(())
        });
        assert!(
            found.is_some(),
            "never: {what}; {:?}",
            self.health.fresh().devices()
        );
        std::mem::take(&mut self.recorder.taken)
    }

    /// Waits until device `name` fulfils `condition`.
    fn wait(&mut self, name: &str, what: &str, condition: impl Fn(&DeviceHealth) -> bool) {
        self.health.wait(&format!("{name} {what}"), |health| {
            health
                .devices()
                .iter()
                .any(|d| d.name.as_str() == name && condition(d))
        });
    }

    fn counter(&mut self, name: &str, counter: Counter) -> u64 {
        let health = self.health.fresh();
        let device = health.devices().iter().find(|d| d.name.as_str() == name);
        count(device.expect("the device"), counter)
    }

    /// A peer is killed: the device is silent, within the configured time and what the machine
    /// needs to say so. Ends with the newest stamp of channel 0.
    fn kill(&mut self, peer: &mut Process, names: &[&str]) -> Nanos {
        let last = self.samples("a sample", |taken| !taken.is_empty());
        let last = last
            .last()
            .map_or(Nanos::MIN, |sample| sample.header.acquired);
        peer.kill();
        for name in names {
            self.wait(name, "is silent", |device| {
                device.state == DeviceState::Silent
            });
        }
        let late = proprio_tests::now() - last;
        let limit = Nanos::from_millis(if uml() { 15_000 } else { 3_000 });
        assert!(late < SILENCE + limit, "silent after {} s", late.seconds());
        self.recorder.take();
        let newest = self
            .recorder
            .taken
            .last()
            .map(|sample| sample.header.acquired);
        newest.unwrap_or(last)
    }

    fn end(mut self, rig: &Rig) {
        self.gateway.end();
        assert!(!self.gateway.log().contains("panicked"));
        drop((self.recorder, self.health));
        rig.assert_nothing_left();
    }
}

/// `max_silence_ms` of all devices here.
const SILENCE: Nanos = Nanos(1_000_000_000);

fn joint(sample: &Sample) -> Option<JointState> {
    match sample.reading() {
        Some(Reading::Joint(joint)) => Some(joint),
        _ => None,
    }
}

/// The joint samples of channel `channel`.
fn joints(taken: &[Sample], channel: u32) -> impl Iterator<Item = (&Sample, JointState)> {
    let of_channel = taken.iter().filter(move |sample| sample.channel == channel);
    of_channel.filter_map(|sample| Some((sample, joint(sample)?)))
}

fn near(value: f64, expected: f64) -> bool {
    (value - expected).abs() <= 1e-6 * (1.0 + expected.abs())
}

/// The number k of the SYNC to which the drive's sample belongs; its values must belong to it too.
fn of_drive(joint: &JointState) -> i64 {
    // The motor's angle by `sign`, `ratio` and `offset_rad`, with the 20000 counts of two turns of
    // the DCF.
    let motor = (joint.position - 0.5) * -2.0;
    let counts = motor / TAU * 10_000.0;
    let steps = counts.round();
    assert!(
        (counts - steps).abs() < 1e-3 && steps % 7.0 == 0.0,
        "{joint:?}"
    );
    assert!(
        near(joint.velocity, 0.5 * steps / 10_000.0 * TAU),
        "{joint:?}"
    );
    // Thousandths of 0.88 Nm and 4.3 A, which the DCF states.
    assert!(
        near(joint.torque, -2.0 * (steps % 1000.0) * 0.88e-3),
        "{joint:?}"
    );
    assert!(near(joint.current, (steps % 500.0) * 4.3e-3), "{joint:?}");
    (steps / 7.0) as i64
}

/// As [`of_drive`], for the encoder.
fn of_encoder(joint: &JointState) -> i64 {
    let counts = joint.position / TAU * 3600.0;
    let number = (counts / 9.0).round();
    assert!((counts - 9.0 * number).abs() < 1e-3, "{joint:?}");
    number as i64
}

#[test]
fn canopen_nodes_of_another_library_are_read() {
    let Some(packages) = packages() else { return };
    let rig = Rig::new();
    let files = repository()
        .join("gateway/tests/eds")
        .canonicalize()
        .expect("a folder");
    let file = |name: &str| files.join(name).to_str().expect("UTF-8").to_owned();
    let (dcf, eds) = (file("drive.dcf"), file("encoder.eds"));
    let nodes = || peer(&rig, &packages, "canopen_nodes.py", &["vcan0", &dcf, &eds]);
    // The gateway is there first: it waits for the nodes.
    let devices = format!(
        "[[bus.device]]\ndriver = \"canopen_sync\"\nname = \"sync\"\nperiod_ms = 50.0\n\
         [[bus.device]]\ndriver = \"canopen_drive\"\nname = \"drive\"\nmax_silence_ms = 1000\n\
         eds = {dcf:?}\n[[bus.device.joint]]\nname = \"elbow\"\nratio = 2.0\nsign = -1\n\
         offset_rad = 0.5\n\
         [[bus.device]]\ndriver = \"canopen_encoder\"\nname = \"encoder\"\naddress = 9\nsync = 1\n\
         max_silence_ms = 1000\n[[bus.device.joint]]\nname = \"wrist\"\n"
    );
    let mut host = Host::start(&rig, &devices);
    let mut peer = nodes();
    let taken = host.samples("20 samples of each", |taken| {
        joints(taken, 0).count() >= 20 && joints(taken, 1).count() >= 20
    });
    // Which SYNC measured what: both nodes answer the same ones.
    let mut instants: BTreeMap<i64, Vec<Nanos>> = BTreeMap::new();
    let (mut drive, mut encoder) = (0, 0);
    for (sample, joint) in joints(&taken, 0) {
        let number = of_drive(&joint);
        assert!(number > drive, "{number} after {drive}");
        assert_eq!(sample.header.quality.0 & Quality::DRIVE_FAULT.0, 0);
        drive = number;
        instants
            .entry(number)
            .or_default()
            .push(sample.header.acquired);
    }
    for (sample, joint) in joints(&taken, 1) {
        let number = of_encoder(&joint);
        assert!(number > encoder, "{number} after {encoder}");
        encoder = number;
        instants
            .entry(number)
            .or_default()
            .push(sample.header.acquired);
    }
    let pairs: Vec<_> = instants.values().filter(|both| both.len() == 2).collect();
    assert!(pairs.len() >= 10, "{instants:?}");
    assert!(
        pairs.iter().all(|both| both[0] == both[1]),
        "one SYNC, one instant: {instants:?}"
    );
    // One SYNC after the other, one instant after the other.
    let order: Vec<Nanos> = instants.values().map(|of| of[0]).collect();
    assert!(order.windows(2).all(|two| two[0] < two[1]), "{instants:?}");

    // An emergency message, and its end.
    let faulty = |sample: &Sample| sample.header.quality.contains(Quality::DRIVE_FAULT);
    signal(&peer, Signal::SIGUSR1);
    let taken = host.samples("a fault of the drive", |taken| {
        joints(taken, 0).any(|(sample, _)| faulty(sample))
            && taken.iter().any(|sample| {
                matches!(sample.reading(), Some(Reading::Actuator(a)) if a.faults == 0x2310)
            })
    });
    assert!(
        joints(&taken, 1).all(|(sample, _)| !faulty(sample)),
        "the encoder has none"
    );
    assert!(host.counter("drive", Counter::DriveFault) > 0);
    signal(&peer, Signal::SIGUSR2);
    host.samples("the end of the fault", |taken| {
        joints(taken, 0)
            .last()
            .is_some_and(|(sample, _)| !faulty(sample))
    });

    // The nodes boot by themselves: they are set up and started again.
    let before = ["drive", "encoder"].map(|name| host.counter(name, Counter::Starts));
    signal(&peer, Signal::SIGHUP);
    for (name, before) in ["drive", "encoder"].into_iter().zip(before) {
        host.wait(name, "is started again", |device| {
            count(device, Counter::Starts) > before && device.state == DeviceState::Streaming
        });
    }
    let taken = host.samples("samples after the boot", |taken| {
        joints(taken, 0).count() > 3 && joints(taken, 1).count() > 3
    });
    assert!(joints(&taken, 0).all(|(_, joint)| of_drive(&joint) > drive));
    assert!(joints(&taken, 1).all(|(_, joint)| of_encoder(&joint) > encoder));

    // They lose their power, and have it again.
    let last = host.kill(&mut peer, &["drive", "encoder"]);
    let mut peer = nodes();
    let taken = host.samples("samples of the new nodes", |taken| {
        joints(taken, 0).count() > 3 && joints(taken, 1).count() > 3
    });
    assert!(joints(&taken, 0).all(|(sample, _)| sample.header.acquired > last));
    for (_, joint) in joints(&taken, 0) {
        of_drive(&joint);
    }
    for (_, joint) in joints(&taken, 1) {
        of_encoder(&joint);
    }
    peer.kill();
    host.end(&rig);
}

#[test]
fn a_moteus_controller_of_its_makers_library_is_read() {
    let Some(packages) = packages() else { return };
    let rig = Rig::new();
    let controller = || peer(&rig, &packages, "moteus_controller.py", &["vcan0", "7"]);
    let mut peer = controller();
    let mut host = Host::start(
        &rig,
        "data_bit_rate = 5_000_000\n[[bus.device]]\ndriver = \"moteus\"\nname = \"controller\"\n\
         address = 7\nperiod_ms = 50\nmax_silence_ms = 1000\n\
         [[bus.device.joint]]\nname = \"knee\"\n",
    );
    let check = |taken: &[Sample]| {
        let mut last = 0.0;
        for (_, joint) in joints(taken, 0) {
            let number = (joint.position / TAU * 100.0).round();
            assert!(number > last, "{number} after {last}");
            last = number;
            assert!(near(joint.position, number / 100.0 * TAU), "{joint:?}");
            assert!(near(joint.velocity, -number / 50.0 * TAU), "{joint:?}");
            assert!(near(joint.torque, number / 20.0), "{joint:?}");
        }
    };
    let taken = host.samples("20 samples", |taken| joints(taken, 0).count() >= 20);
    check(&taken);
    let faulty = |sample: &Sample| sample.header.quality.contains(Quality::DRIVE_FAULT);
    assert!(!joints(&taken, 0).any(|(sample, _)| faulty(sample)));
    signal(&peer, Signal::SIGUSR1);
    host.samples("a fault", |taken| {
        joints(taken, 0).any(|(sample, _)| faulty(sample))
    });
    signal(&peer, Signal::SIGUSR2);
    host.samples("its end", |taken| {
        joints(taken, 0)
            .last()
            .is_some_and(|(sample, _)| !faulty(sample))
    });
    let last = host.kill(&mut peer, &["controller"]);
    let mut peer = controller();
    let taken = host.samples("samples again", |taken| joints(taken, 0).count() >= 5);
    check(&taken);
    assert!(joints(&taken, 0).all(|(sample, _)| sample.header.acquired > last));
    peer.kill();
    host.end(&rig);
}
