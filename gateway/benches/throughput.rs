//! Frames per second on one core: from a log to a table, and from a bus to shared memory.
//!
//! `cargo bench -p proprio-gateway` prints the time for one round of [`FRAMES`] frames and the
//! rate. The bare loops only read the same datagrams from the same kind of socket, one of them also
//! publishes as many samples: the ratio shows what decoding costs.

use divan::Bencher;
use divan::counter::ItemsCount;
use proprio_drivers::Frame;
use proprio_gateway::bus::{Bus, Turn};
use proprio_gateway::clock::{Clock, Monotonic};
use proprio_gateway::devices::BusDevices;
use proprio_gateway::link::virtual_bus::VirtualBus;
use proprio_gateway::link::{Link, LinkCounters, Received, TransmitError, send_by};
use proprio_gateway::log;
use proprio_gateway::offline;
use proprio_gateway::plan::Plan;
use proprio_gateway::publish::SharedMemory;
use proprio_gateway::status::BusStatus;
use proprio_topics::csv::Columns;
use proprio_topics::ipc::{Domain, DomainConfig, Writer};
use proprio_topics::{Header, JointState, LinkState, Nanos, Reading, Sample};
use std::fmt::Write as _;
use std::path::Path;
use std::sync::Arc;

/// Frames in one round, well below the capacity of a link's receive buffer.
const FRAMES: u64 = 2_000;

const PLAN: &str = r#"
    schema = 1
    robot = "bench"
    [[bus]]
    name = "arm"
    source = { kind = "virtual", name = "arm" }
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
"#;

fn plan() -> Plan {
    Plan::parse(PLAN, Path::new(".")).unwrap()
}

/// A log of `frames` frames, two thirds of them halves of wrenches, as on a robot's bus.
fn log(frames: u64) -> Vec<u8> {
    let mut table = String::from("t,joint/elbow/position,joint/elbow/velocity");
    ["fx", "fy", "fz", "tx", "ty", "tz"]
        .iter()
        .for_each(|c| write!(table, ",wrench/ft/{c}").unwrap());
    table.push('\n');
    for i in 0..frames / 3 {
        let (t, x) = (
            Nanos(i64::try_from(i).unwrap() * 1_000_000),
            (i as f64 * 0.01).sin(),
        );
        writeln!(
            table,
            "{t},{},{},{},{},{},{},{},{}",
            x,
            -x,
            10.0 * x,
            3.0 - x,
            100.0 * x,
            x,
            -x,
            0.3 * x
        )
        .unwrap();
    }
    let mut log = Vec::new();
    offline::encode(&plan(), table.as_bytes(), &mut log).unwrap();
    log
}

/// `proprio decode` without the disk: text in, text out.
#[divan::bench(sample_count = 20)]
fn decode_log_to_table(bencher: Bencher<'_, '_>) {
    let log = log(300_000);
    let frames = log.iter().filter(|b| **b == b'\n').count();
    bencher.counter(ItemsCount::new(frames)).bench(|| {
        let mut table = Vec::with_capacity(64 << 20);
        offline::decode(&plan(), log.as_slice(), &mut table, Columns::Main)
            .unwrap()
            .samples
    });
}

/// The text of a log to frames.
#[divan::bench(sample_count = 20)]
fn parse_log(bencher: Bencher<'_, '_>) {
    let log = log(300_000);
    let frames = log.iter().filter(|b| **b == b'\n').count();
    bencher.counter(ItemsCount::new(frames)).bench(|| {
        let mut reader = log::LogReader::new(log.as_slice());
        let mut count = 0;
        while reader.next_record().unwrap().is_some() {
            count += 1;
        }
        count
    });
}

fn frames() -> Vec<Frame> {
    let log = log(FRAMES + 3);
    let mut reader = log::LogReader::new(log.as_slice());
    let mut frames = Vec::new();
    while let (Ok(Some(record)), true) = (reader.next_record(), (frames.len() as u64) < FRAMES) {
        frames.push(record.frame);
    }
    frames
}

fn fill(bus: &mut VirtualBus, frames: &[Frame]) {
    let deadline = Monotonic.now() + Nanos::from_millis(1000);
    frames
        .iter()
        .for_each(|f| send_by(bus, f, deadline).unwrap());
}

/// Only reads the datagrams that have arrived.
#[divan::bench(sample_count = 50)]
fn bare_receive(bencher: Bencher<'_, '_>) {
    let domain = format!("bench{}", std::process::id());
    let mut sender = VirtualBus::open(&domain, "bare", &[]).unwrap();
    let receiver = std::cell::RefCell::new(VirtualBus::open(&domain, "bare", &[]).unwrap());
    let frames = frames();
    bencher
        .counter(ItemsCount::new(FRAMES))
        .with_inputs(|| fill(&mut sender, &frames))
        .bench_local_values(|()| {
            let mut count = 0;
            while let Received::Frame(_) = receiver.borrow_mut().recv(Nanos::ZERO) {
                count += 1;
            }
            assert_eq!(count, FRAMES);
        });
}

/// Reads the datagrams that have arrived, and publishes a sample for two of every three: as many as
/// the data plane publishes.
#[divan::bench(sample_count = 50)]
fn bare_receive_and_send(bencher: Bencher<'_, '_>) {
    let base = tempfile::tempdir().unwrap();
    let domain = Domain::open(&DomainConfig::new(base.path(), "bare")).unwrap();
    let mut writer = Writer::<Sample>::create(&domain, "bench", domain.epoch()).unwrap();
    let name = format!("bench{}", std::process::id());
    let mut sender = VirtualBus::open(&name, "both", &[]).unwrap();
    let mut receiver = VirtualBus::open(&name, "both", &[]).unwrap();
    let frames = frames();
    let sample = Sample::new(Header::default(), 0, &Reading::Joint(JointState::ABSENT));
    bencher
        .counter(ItemsCount::new(FRAMES))
        .with_inputs(|| fill(&mut sender, &frames))
        .bench_local_values(|()| {
            let mut count = 0;
            while let Received::Frame(frame) = receiver.recv(Nanos::ZERO) {
                count += 1;
                if count % 3 != 0 {
                    writer.send(&sample, frame.t).unwrap();
                }
            }
            assert_eq!(count, FRAMES);
        });
}

/// From frames waiting at the link to samples in shared memory: the whole data plane.
#[divan::bench(sample_count = 50)]
fn frames_to_shared_memory(bencher: Bencher<'_, '_>) {
    let base = tempfile::tempdir().unwrap();
    let domain = Domain::open(&DomainConfig::new(base.path(), "bench")).unwrap();
    let name = format!("bench{}", std::process::id());
    let plan = plan();
    let status = Arc::new(BusStatus::new(0, &plan.buses[0]));
    let devices = BusDevices::new(0, &plan.buses[0], None, Arc::clone(&status)).unwrap();
    let writer = Writer::<Sample>::create(&domain, "bench", domain.epoch()).unwrap();
    let mut sender = VirtualBus::open(&name, "arm", &[]).unwrap();
    let link = Waiting(VirtualBus::open(&name, "arm", &devices.claims()).unwrap());
    let bus = std::cell::RefCell::new(Bus::new(
        Box::new(link),
        devices,
        SharedMemory::new(writer, "robot", Arc::default()),
        status,
    ));
    let frames = frames();
    bencher
        .counter(ItemsCount::new(FRAMES))
        .with_inputs(|| fill(&mut sender, &frames))
        .bench_local_values(|()| {
            for _ in 0..FRAMES {
                assert_eq!(bus.borrow_mut().turn(&Monotonic), Turn::Continue);
            }
        });
}

/// A link that never waits, so that only work is measured.
struct Waiting(VirtualBus);

impl Link for Waiting {
    fn recv(&mut self, _: Nanos) -> Received {
        self.0.recv(Nanos::ZERO)
    }
    fn send(&mut self, frame: &Frame) -> Result<(), TransmitError> {
        self.0.send(frame)
    }
    fn state(&self) -> LinkState {
        self.0.state()
    }
    fn counters(&self) -> LinkCounters {
        self.0.counters()
    }
}

fn main() {
    divan::main();
}
