//! Frames as they come: two virtual buses with 2,000 frames/s each, and a reader that waits.
//!
//! `cargo bench -p proprio-gateway --bench arrival` prints the CPU time per frame of the bus
//! threads and the time from a frame's stamp to its sample in the hands of the reader. The bare
//! loop receives from the same kind of socket and publishes as many samples through the same kind
//! of port, and decodes nothing: the machine's own wake-up is in both. The two take turns, a second
//! each. Without `--bench`, which `cargo bench` passes, it is one short round, to see that it runs.

use proprio_drivers::Frame;
use proprio_gateway::bus::Bus;
use proprio_gateway::clock::Monotonic;
use proprio_gateway::devices::BusDevices;
use proprio_gateway::link::virtual_bus::VirtualBus;
use proprio_gateway::link::{Link, Received, send_by};
use proprio_gateway::log;
use proprio_gateway::offline;
use proprio_gateway::plan::Plan;
use proprio_gateway::publish::SharedMemory;
use proprio_gateway::status::BusStatus;
use proprio_topics::ipc::{Domain, DomainConfig, Reader, Writer, monotonic};
use proprio_topics::{Header, JointState, Nanos, Reading, Sample};
use std::fmt::Write as _;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::{Acquire, Release};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

/// Rounds of a second for each of the two.
const ROUNDS: usize = 10;
/// Bursts of a round; in each, every bus gets three frames: a position, and a wrench in two.
const BURSTS: usize = 667;
const BURST_PERIOD: Duration = Duration::from_micros(1500);
/// The place in a burst of the first half of the wrench, counted from one.
const WRENCH_BEGINS: u64 = 2;
const BUSES: [&str; 2] = ["a", "b"];

fn plan(bus: &str) -> Plan {
    let text = format!(
        r#"
        schema = 1
        robot = "bench"
        [[bus]]
        name = "{bus}"
        source = {{ kind = "virtual", name = "{bus}" }}
          [[bus.device]]
          driver = "icub_strain"
          name = "ft"
          address = 13
          full_scale_n = [1804.0, 1804.0, 1804.0]
          full_scale_nm = [31.0, 31.0, 31.0]
          listen_only = true
          [[bus.device]]
          driver = "icub_motor"
          name = "elbow_board"
          address = 4
            [[bus.device.joint]]
            name = "elbow"
            ratio = 100.0
        "#
    );
    Plan::parse(&text, Path::new(".")).expect("a plan")
}

/// Frames of one bus: of every three, two are the halves of a wrench, and one is a position.
fn frames() -> Vec<Frame> {
    let mut table = String::from("t,joint/elbow/position,joint/elbow/velocity");
    ["fx", "fy", "fz", "tx", "ty", "tz"]
        .iter()
        .for_each(|c| write!(table, ",wrench/ft/{c}").expect("text"));
    table.push('\n');
    for i in 0..BURSTS {
        let t = Nanos::from_millis(i as i64);
        writeln!(table, "{t},0.1,0,1,2,3,1,2,3").expect("text");
    }
    let mut log = Vec::new();
    offline::encode(&plan("a"), table.as_bytes(), &mut log).expect("frames");
    let mut reader = log::LogReader::new(log.as_slice());
    let mut frames = Vec::new();
    while let Some(record) = reader.next_record().expect("a log") {
        frames.push(record.frame);
    }
    // A burst is a position and then the halves of a wrench: 0x140, 0x3da, 0x3db.
    for burst in frames.chunks_mut(3) {
        burst.sort_by_key(|frame| frame.id.raw());
    }
    assert_eq!(frames[1].id.raw() + 1, frames[2].id.raw());
    frames
}

/// CPU time of the calling thread \[ns\].
fn cpu_time() -> u64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").expect("a Linux kernel");
    let first = text.split(' ').next().expect("a number");
    first.parse().expect("a number")
}

/// Runs one turn at a time while its turn lasts; sends the CPU time that it took in each.
fn worker(mut turn: impl FnMut(), go: &AtomicBool, done: &AtomicBool, used: &mpsc::Sender<u64>) {
    while !done.load(Acquire) {
        if !go.load(Acquire) {
            thread::sleep(Duration::from_millis(1));
            continue;
        }
        let begin = cpu_time();
        while go.load(Acquire) {
            turn();
        }
        used.send(cpu_time() - begin).expect("a listener");
    }
}

fn quantile(sorted: &[i64], q: f64) -> f64 {
    let at = (q * (sorted.len().max(1) - 1) as f64) as usize;
    sorted.get(at).map_or(f64::NAN, |ns| *ns as f64 * 1e-3)
}

fn main() {
    let is_measured = std::env::args().any(|argument| argument == "--bench");
    let (rounds, bursts) = if is_measured {
        (ROUNDS, BURSTS)
    } else {
        (1, BURSTS / 20)
    };
    let base = tempfile::tempdir().expect("a folder");
    let domain = Domain::open(&DomainConfig::new(base.path(), "bench")).expect("a domain");
    let done = Arc::new(AtomicBool::new(false));
    let name = |kind: &str| format!("{kind}{}", std::process::id());
    let mut sides = Vec::new();
    for kind in ["bare", "proprio"] {
        let go = Arc::new(AtomicBool::new(false));
        let (used, times) = mpsc::channel();
        let mut senders = Vec::new();
        let mut threads = Vec::new();
        for bus in BUSES {
            senders.push(VirtualBus::open(&name(kind), bus, &[]).expect("a bus"));
            let (link_domain, domain) = (name(kind), domain.clone());
            let (go, done, used) = (Arc::clone(&go), Arc::clone(&done), used.clone());
            threads.push(thread::spawn(move || {
                let plan = plan(bus);
                let status = Arc::new(BusStatus::new(0, &plan.buses[0]));
                let devices = BusDevices::new(0, &plan.buses[0], None, Arc::clone(&status));
                let devices = devices.expect("devices");
                let robot = if kind == "bare" { "bare" } else { "proprio" };
                let mut writer =
                    Writer::<Sample>::create(&domain, robot, domain.epoch()).expect("a port");
                let link = VirtualBus::open(&link_domain, bus, &devices.claims()).expect("a bus");
                if kind == "proprio" {
                    let mut bus = Bus::new(
                        Box::new(link),
                        devices,
                        SharedMemory::new(writer, "robot", Arc::default()),
                        status,
                    );
                    let turn = || {
                        bus.turn(&Monotonic);
                    };
                    worker(turn, &go, &done, &used);
                } else {
                    let (mut link, mut count, mut last) = (link, 0_u64, frames()[0]);
                    let reading = Reading::Joint(JointState::ABSENT);
                    let turn = || {
                        let deadline = monotonic() + Nanos::from_millis(50);
                        if let Received::Frame(frame) = link.recv(deadline) {
                            // A wrench is stamped with its first half.
                            let before = std::mem::replace(&mut last, frame);
                            count += 1;
                            if count % 3 != WRENCH_BEGINS {
                                let is_wrench = count % 3 == 0;
                                let stamped = if is_wrench { before } else { frame };
                                let header = Header {
                                    acquired: stamped.t,
                                    ..Header::default()
                                };
                                let _ = writer.send(&Sample::new(header, 0, &reading), monotonic());
                            }
                        }
                    };
                    worker(turn, &go, &done, &used);
                }
            }));
        }
        let (domain, done) = (domain.clone(), Arc::clone(&done));
        let reader = thread::spawn(move || {
            let mut reader = loop {
                match Reader::<Sample>::open(&domain, kind) {
                    Ok(reader) => break reader,
                    Err(_) => thread::sleep(Duration::from_millis(1)),
                }
            };
            let mut latency = Vec::with_capacity(4 * BURSTS * ROUNDS);
            while !done.load(Acquire) {
                reader.wait(monotonic() + Nanos::from_millis(50));
                while let Ok(Some(sample)) = reader.try_take() {
                    latency.push((monotonic() - sample.header.acquired).0);
                }
            }
            latency.sort_unstable();
            latency
        });
        sides.push((kind, go, times, senders, threads, reader, 0_u64, 0_u64));
    }
    let frames = frames();
    for _ in 0..rounds {
        for (_, go, times, senders, _, _, sent, used) in &mut sides {
            go.store(true, Release);
            thread::sleep(Duration::from_millis(100));
            let mut next = frames.iter().cycle();
            for _ in 0..bursts {
                let deadline = monotonic() + Nanos::from_millis(100);
                for frame in next.by_ref().take(3) {
                    for sender in senders.iter_mut() {
                        send_by(sender, frame, deadline).expect("room");
                        *sent += 1;
                    }
                }
                thread::sleep(BURST_PERIOD);
            }
            go.store(false, Release);
            for _ in BUSES {
                *used += times.recv().expect("a thread");
            }
        }
    }
    done.store(true, Release);
    println!(
        "{:10} {:>14} {:>12} {:>12} {:>12}",
        "", "CPU/frame [us]", "p50 [us]", "p99 [us]", "p99.9 [us]"
    );
    for (kind, _, _, senders, threads, reader, sent, used) in sides {
        drop(senders);
        threads.into_iter().for_each(|t| t.join().expect("it ends"));
        let latency = reader.join().expect("it ends");
        println!(
            "{kind:10} {:>14.2} {:>12.1} {:>12.1} {:>12.1}   {sent} frames, {} samples",
            used as f64 / sent as f64 * 1e-3,
            quantile(&latency, 0.5),
            quantile(&latency, 0.99),
            quantile(&latency, 0.999),
            latency.len(),
        );
    }
}
