//! The data planes allocate nothing of their own once they run: a gateway's bus, from link to shared memory, bad frames
//! included, and an estimator's pipeline, from samples to torques.
//!
//! Counted is what the thread under test asks the allocator for. The only thing it may ask for is iceoryx2's: one loan of
//! 48 bytes per payload sent.

// A global allocator can only be made with unsafe code.
#![allow(unsafe_code)]

use proprio_drivers::{Claim, Frame, Id, Mode};
use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::setup::Setup;
use proprio_gateway::bus::{Bus, Turn};
use proprio_gateway::candump;
use proprio_gateway::clock::{Clock, Monotonic};
use proprio_gateway::decoder::Decoder;
use proprio_gateway::link::virtual_bus::VirtualBus;
use proprio_gateway::link::{Link, Received};
use proprio_gateway::publish::{Memory, Shared, Sink};
use proprio_gateway::status::BusStatus;
use proprio_simulator::record::record;
use proprio_simulator::{Robot, Settings, Simulator};
use proprio_topics::ipc::{Domain, DomainConfig, Reader, Writer};
use proprio_topics::{Counter, DeviceHealth, Nanos, Reading, Sample, Wrench};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;

thread_local! {
    /// Allocations of this thread, and their bytes.
    static COUNTED: Cell<(usize, usize)> = const { Cell::new((0, 0)) };
}

struct Counting;

fn count(bytes: usize) {
    let _ = COUNTED.try_with(|c| c.set((c.get().0 + 1, c.get().1 + bytes)));
}

// SAFETY: every call is passed on unchanged to the system's allocator, which upholds the contract; counting uses a
// thread-local that is initialised at compile time, has no destructor and does not allocate.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size());
        // SAFETY: the caller upholds `alloc`'s contract.
        unsafe { System.alloc(layout) }
    }
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count(layout.size());
        // SAFETY: the caller upholds `alloc_zeroed`'s contract.
        unsafe { System.alloc_zeroed(layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count(size);
        // SAFETY: the caller upholds `realloc`'s contract; the pointer came from `System`.
        unsafe { System.realloc(pointer, layout, size) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller upholds `dealloc`'s contract; the pointer came from `System`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Allocations and bytes of this thread during `run`.
fn counted(run: impl FnOnce()) -> (usize, usize) {
    let before = COUNTED.get();
    run();
    let after = COUNTED.get();
    (after.0 - before.0, after.1 - before.1)
}

#[test]
fn the_counter_counts() {
    assert_eq!(counted(|| drop(std::hint::black_box(vec![1_u8; 8]))), (1, 8));
    assert_eq!(
        counted(|| drop(std::hint::black_box(vec![0_u8; 8]))),
        (1, 8),
        "zeroed too"
    );
    let mut grows = Vec::<u8>::with_capacity(1);
    assert_eq!(counted(|| grows.reserve_exact(100)), (1, 100));
    assert_eq!(
        counted(|| drop(std::thread::spawn(|| drop(std::hint::black_box(vec![1_u8; 1 << 20]))).join())).1 >> 20,
        0
    );
}

fn robot() -> Robot {
    Robot::open("icub_left_arm").expect("the robot of the source tree")
}

/// Frames that no device should like: right identifiers with wrong lengths and contents, extended and remote ones, and
/// identifiers of nobody.
struct BadFrames {
    claims: Vec<Claim>,
    state: u64,
}

impl BadFrames {
    fn new(robot: &Robot, bus: usize) -> Self {
        let plan = &robot.plan.buses[bus];
        let decoder = Decoder::new(0, plan, Some(Mode::Listen), Arc::new(BusStatus::new(0, plan))).expect("devices");
        Self {
            claims: decoder.claims(),
            state: bus as u64,
        }
    }

    fn next(&mut self) -> Frame {
        // SplitMix64.
        let mut word = || {
            self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let z = (self.state ^ (self.state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            z ^ (z >> 31)
        };
        let bytes = word().to_le_bytes();
        let len = (word() % 9) as usize;
        match word() % 8 {
            0 => Frame::new(Id::extended((word() & 0x1FFF_FFFF) as u32), &bytes[..len]),
            1 => Frame::new(Id::standard((word() & 0x7FF) as u16), &bytes[..len]),
            2 => Frame::remote(Id::standard((word() & 0x7FF) as u16), len as u8),
            _ => {
                let claim = self.claims[(word() % self.claims.len() as u64) as usize];
                Frame::new(claim.id, &bytes[..len])
            }
        }
    }
}

/// One of the robot's buses, as the far end has it: its boards and, once `nonsense` is set, somebody who sends bad frames,
/// three a millisecond. Until `stop`.
fn far_end(robot: &Robot, number: usize, domain: &str, name: &str, nonsense: &AtomicBool, stop: &AtomicBool) {
    let clock = Monotonic;
    let mut link = VirtualBus::open(domain, name, &[]).expect("a virtual bus");
    let mut bad = BadFrames::new(robot, number);
    let mut simulator = Simulator::new(robot, &Settings::default(), clock.now()).expect("a simulator");
    let patience = Nanos::from_millis(10);
    while !stop.load(Relaxed) {
        let now = clock.now();
        while let Some((bus, frame)) = simulator.poll(now) {
            if bus == number {
                let _ = link.send(&frame, now + patience);
            }
        }
        for _ in 0..if nonsense.load(Relaxed) { 3 } else { 0 } {
            let _ = link.send(&bad.next(), now + patience);
        }
        if let Received::Frame(frame) = link.recv(now + Nanos::from_millis(1)) {
            simulator.on_frame(number, &frame, clock.now());
        }
    }
}

/// Runs the gateway's loop of bus `number` against its far end, with the sink that `sink` makes. Returns what the measured
/// stretch allocated, how many samples it published, and the bus's status.
fn run_bus<S: Sink>(number: usize, test: &str, sink: impl FnOnce() -> S) -> ((usize, usize), u64, Arc<BusStatus>) {
    const FRAMES: u64 = 8000;
    let robot = robot();
    let plan = &robot.plan.buses[number];
    let status = Arc::new(BusStatus::new(0, plan));
    let decoder = Decoder::new(0, plan, None, Arc::clone(&status)).expect("devices");
    // Tests run in parallel, in this process and others: a bus of this one's own.
    let (domain, name) = (format!("allocation-{}", std::process::id()), format!("{test}-{number}"));
    let link = VirtualBus::open(&domain, &name, &decoder.claims()).expect("a virtual bus");
    let mut bus = Bus::new(Box::new(link), decoder, sink(), Arc::clone(&status));
    let clock = Monotonic;
    let (nonsense, stop) = (AtomicBool::new(false), AtomicBool::new(false));
    let result = std::thread::scope(|scope| {
        scope.spawn(|| far_end(&robot, number, &domain, &name, &nonsense, &stop));
        let end = clock.now() + Nanos::from_millis(60_000);
        let mut turn_until = |done: &dyn Fn() -> bool| {
            while !done() && clock.now() < end {
                assert_eq!(bus.turn(&clock), Turn::Continue);
            }
        };
        // Warm: every device has told something.
        let readings = |d: &DeviceHealth| d.counters[Counter::Readings as usize];
        turn_until(&|| status.devices().all(|d| readings(&d) > 10));
        nonsense.store(true, Relaxed);
        let (frames, published) = (status.frames.load(Relaxed), status.published.load(Relaxed));
        let allocated = counted(|| turn_until(&|| status.frames.load(Relaxed) >= frames + FRAMES));
        let received = status.frames.load(Relaxed) - frames;
        let published_there = status.published.load(Relaxed) - published;
        let stopped = counted(|| bus.stop(&clock));
        let published_in_all = status.published.load(Relaxed) - published;
        stop.store(true, Relaxed);
        assert!(received >= FRAMES, "{received} frames came in a minute");
        (
            (allocated.0 + stopped.0, allocated.1 + stopped.1),
            published_there,
            published_in_all,
        )
    });
    let (allocated, published_there, published) = result;
    assert!(
        published_there > FRAMES / 10,
        "{published_there} samples of {FRAMES} frames"
    );
    (allocated, published, status)
}

/// Whether the bad frames were seen for what they are.
fn bad_frames(status: &BusStatus) -> u64 {
    let count = |d: &DeviceHealth, c: Counter| d.counters[c as usize];
    status
        .devices()
        .map(|d| count(&d, Counter::Length) + count(&d, Counter::Unexpected))
        .sum()
}

#[test]
fn a_bus_allocates_nothing_from_link_to_sink() {
    for number in 0..robot().plan.buses.len() {
        let (allocated, _, status) = run_bus(number, "memory", || Memory {
            samples: Vec::with_capacity(1 << 16),
        });
        assert_eq!(allocated, (0, 0), "bus {number}");
        assert!(
            bad_frames(&status) > 100,
            "bus {number}: {:?}",
            status.devices().collect::<Vec<_>>()
        );
    }
}

#[test]
fn a_bus_that_publishes_allocates_the_transports_loan_alone() {
    let base = tempfile::tempdir().unwrap();
    let domain = Domain::open(&DomainConfig::new(base.path(), "allocation")).unwrap();
    for number in 0..robot().plan.buses.len() {
        let mut reader = None;
        let (allocated, published, status) = run_bus(number, "shared", || {
            let writer = Writer::<Sample>::create(&domain, &format!("bus{number}"), domain.epoch()).unwrap();
            reader = Some(Reader::<Sample>::open(&domain, &format!("bus{number}")).unwrap());
            Shared(writer)
        });
        let sends = usize::try_from(published).unwrap();
        assert_eq!(
            allocated,
            (sends, 48 * sends),
            "bus {number}: one loan of 48 bytes per sample"
        );
        assert!(bad_frames(&status) > 100 && status.publish_failures.load(Relaxed) == 0);
        // They were really sent: the reader has the newest.
        let newest = reader.unwrap().latest().unwrap().expect("a sample");
        assert!(
            newest.header.sequence + 1 >= published,
            "{} {published}",
            newest.header.sequence
        );
    }
}

/// A recorded session: per frame the number of its bus, in order.
fn session(robot: &Robot, seconds: f64) -> Vec<(usize, Frame)> {
    let mut log = Vec::new();
    record(
        robot,
        &Settings::default(),
        seconds,
        Nanos::from_millis(50_000),
        &mut log,
    )
    .unwrap();
    let mut reader = candump::Reader::new(&log[..]);
    let mut frames = Vec::new();
    while let Some(record) = reader.next_record().unwrap() {
        let takes = |bus: &usize| robot.plan.matching(*bus).is_none_or(|m| m.takes(record.interface));
        let bus = (0..robot.plan.buses.len()).find(takes).expect("a bus of the robot");
        frames.push((bus, record.frame));
    }
    assert_eq!(reader.report().bad, 0);
    frames
}

fn decoders(robot: &Robot) -> Vec<Decoder> {
    let status = |(bus, number)| Arc::new(BusStatus::new(number, bus));
    let buses = robot.plan.buses.iter().zip(0..);
    buses
        .map(|(bus, number)| Decoder::new(number, bus, Some(Mode::Listen), status((bus, number))).unwrap())
        .collect()
}

#[test]
fn decoding_allocates_nothing() {
    let robot = robot();
    let frames = session(&robot, 3.0);
    let mut decoders = decoders(&robot);
    let mut bad: Vec<_> = (0..decoders.len()).map(|bus| BadFrames::new(&robot, bus)).collect();
    let (mut samples, mut at) = (0_u64, Nanos::ZERO);
    // From the very first frame on: nothing has to warm up.
    let allocated = counted(|| {
        for (bus, frame) in &frames {
            decoders[*bus].on_frame(frame, |_| samples += 1);
            at = frame.t;
            for bad in [bad[*bus].next(), bad[*bus].next()] {
                decoders[*bus].on_frame(&bad.at(at, frame.stamp), |_| {});
            }
            decoders[*bus].poll_transmit(at, |_| {});
            std::hint::black_box(decoders[*bus].next_wake());
        }
        decoders[0].restart(at);
        decoders[0].stop(at);
    });
    assert_eq!(allocated, (0, 0));
    assert!(
        frames.len() > 10_000 && samples > 5000,
        "{} frames, {samples} samples",
        frames.len()
    );
}

#[test]
fn the_pipeline_allocates_nothing_once_it_runs() {
    let robot = robot();
    let setup = Setup::new(&robot.config).unwrap();
    let channels: Vec<Option<usize>> = robot
        .plan
        .channels
        .iter()
        .map(|c| setup.channel(c.kind, &c.name))
        .collect();
    let hand = setup.contact("hand").expect("the hand is a contact");
    let mut decoders = decoders(&robot);
    let mut samples = Vec::new();
    for (bus, frame) in session(&robot, 6.0) {
        decoders[bus].on_frame(&frame, |sample| samples.push(*sample));
    }
    let mut pipeline = Pipeline::new(setup);
    let run = |pipeline: &mut Pipeline, samples: &[Sample], trouble: bool| {
        let (mut estimates, mut withheld, mut number) = (0_u64, 0_u64, 0_u64);
        for sample in samples {
            number += 1;
            let Some(channel) = channels[sample.channel as usize] else {
                continue;
            };
            let t = sample.header.acquired;
            if trouble {
                // Half a second without the first joint; contacts that come and go; samples twice, late and without sense.
                if number > 3000 && number < 5000 && sample.channel == 2 {
                    continue;
                }
                if number.is_multiple_of(500) {
                    pipeline.declare(hand, t, number.is_multiple_of(1000));
                }
                if number.is_multiple_of(7) {
                    pipeline.push(
                        channel,
                        t - Nanos::from_millis(20),
                        &sample.reading,
                        sample.header.quality,
                    );
                }
                if number.is_multiple_of(11) {
                    let nothing = Reading::Wrench(Wrench {
                        force: [f64::NAN; 3],
                        torque: [0.0; 3],
                    });
                    pipeline.push(channel, t, &nothing, sample.header.quality);
                }
            }
            pipeline.push(channel, t, &sample.reading, sample.header.quality);
            while let Some(estimate) = pipeline.poll() {
                estimates += 1;
                withheld += u64::from(estimate.torques.joints().iter().any(|j| j.valid != 1));
            }
        }
        (estimates, withheld)
    };
    let (warm, rest) = samples.split_at(samples.len() / 6);
    let (clean, rough) = rest.split_at(rest.len() / 2);
    run(&mut pipeline, warm, false);
    let (mut easy, mut hard) = ((0, 0), (0, 0));
    assert_eq!(counted(|| easy = run(&mut pipeline, clean, false)), (0, 0));
    assert_eq!(counted(|| hard = run(&mut pipeline, rough, true)), (0, 0));
    assert!(easy.0 > 2000 && easy.1 == 0, "{easy:?}");
    assert!(hard.0 > 2000 && hard.1 > 100, "{hard:?}");
    let counts = pipeline.counts();
    assert!(
        counts.late + counts.backward > 100 && counts.not_finite > 10,
        "{counts:?}"
    );
}
