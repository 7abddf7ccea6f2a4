//! The data planes do not allocate after start: a gateway's bus, from link to shared memory,
//! including bad frames, and an estimator's pipeline, from samples to torques. Nor does any part of
//! the dynamics after construction.
//!
//! The tests count the allocations of the thread under test. The only permitted one is iceoryx2's
//! loan: 48 bytes per payload sent.

// A global allocator needs unsafe code.
#![allow(unsafe_code)]

use proprio_drivers::{Claim, Command, Frame, Id, Mode, NotSent};
use proprio_dynamics::model::{self, Model};
use proprio_dynamics::regressor::{EstimateRows, Regressor, StackedRegressor};
use proprio_dynamics::spatial::{self, Pose, Vec3};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, DynamicsError, ExternalWrench, FrameMotion,
    InverseDynamics, JointState, Kinematics, Noise, SensorCut, Solver, Structure,
};
use proprio_estimator::config::{Occurrence, TactileSkin};
use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::propagation::{Covariance, Propagation};
use proprio_estimator::setup::Setup;
use proprio_gateway::bus::{Bus, Turn};
use proprio_gateway::clock::{Clock, Monotonic};
use proprio_gateway::devices::{BusDevices, build};
use proprio_gateway::inbox::{Replacement, Reply, Request, inbox};
use proprio_gateway::link::virtual_bus::VirtualBus;
use proprio_gateway::link::{Link, Received, send_by};
use proprio_gateway::log;
use proprio_gateway::plan::Plan;
use proprio_gateway::publish::{Memory, SharedMemory, Sink};
use proprio_gateway::status::BusStatus;
use proprio_simulator::record::record;
use proprio_simulator::{SimulatedRobot, SimulationSettings, Simulator};
use proprio_topics::ipc::{Domain, DomainConfig, Reader, Writer};
use proprio_topics::{
    ContactState, Counter, DeviceHealth, Kind, Nanos, Reading, Sample, Skin, StampKind, Wrench,
};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::path::Path;
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

// SAFETY: every call is passed on unchanged to the system's allocator, which upholds the contract;
// counting uses a thread-local that is initialised at compile time, has no destructor and does not
// allocate.
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
    assert_eq!(
        counted(|| drop(std::hint::black_box(vec![1_u8; 8]))),
        (1, 8)
    );
    assert_eq!(
        counted(|| drop(std::hint::black_box(vec![0_u8; 8]))),
        (1, 8),
        "zeroed too"
    );
    let mut grows = Vec::<u8>::with_capacity(1);
    assert_eq!(counted(|| grows.reserve_exact(100)), (1, 100));
    assert_eq!(
        counted(|| drop(
            std::thread::spawn(|| drop(std::hint::black_box(vec![1_u8; 1 << 20]))).join()
        ))
        .1 >> 20,
        0
    );
}

fn robot() -> SimulatedRobot {
    SimulatedRobot::open("icub_left_arm").expect("the robot of the source tree")
}

/// Bad frames: right identifiers with wrong lengths and contents, extended and remote frames, and
/// unknown identifiers.
struct BadFrames {
    claims: Vec<Claim>,
    state: u64,
}

impl BadFrames {
    fn new(robot: &SimulatedRobot, bus: usize) -> Self {
        let plan = &robot.plan.buses[bus];
        let devices = BusDevices::new(
            0,
            plan,
            Some(Mode::Listen),
            Arc::new(BusStatus::new(0, plan)),
        )
        .expect("devices");
        Self {
            claims: devices.claims(),
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

/// The far end of one of the robot's buses, until `stop`: its boards and, once `nonsense` is set,
/// three bad frames per millisecond.
fn far_end(
    robot: &SimulatedRobot,
    number: usize,
    domain: &str,
    name: &str,
    nonsense: &AtomicBool,
    stop: &AtomicBool,
) {
    let clock = Monotonic;
    let mut link = VirtualBus::open(domain, name, &[]).expect("a virtual bus");
    let mut bad = BadFrames::new(robot, number);
    let mut simulator =
        Simulator::new(robot, &SimulationSettings::default(), clock.now()).expect("a simulator");
    let patience = Nanos::from_millis(10);
    while !stop.load(Relaxed) {
        let now = clock.now();
        while let Some((bus, frame)) = simulator.poll(now) {
            if bus == number {
                let _ = send_by(&mut link, &frame, now + patience);
            }
        }
        for _ in 0..if nonsense.load(Relaxed) { 3 } else { 0 } {
            let _ = send_by(&mut link, &bad.next(), now + patience);
        }
        if let Received::Frame(frame) = link.recv(now + Nanos::from_millis(1)) {
            simulator.on_frame(number, &frame, clock.now());
        }
    }
}

/// Runs the gateway's loop of bus `number` against its far end, with the sink from `sink`, while
/// every device is replaced and commanded. Returns the allocations of the measured part, the number
/// of samples published, and the bus's status.
fn run_bus<S: Sink>(
    number: usize,
    test: &str,
    sink: impl FnOnce() -> S,
) -> ((usize, usize), u64, Arc<BusStatus>) {
    const FRAMES: u64 = 8000;
    let robot = robot();
    let plan = &robot.plan.buses[number];
    let status = Arc::new(BusStatus::new(0, plan));
    let devices = BusDevices::new(0, plan, None, Arc::clone(&status)).expect("devices");
    // A separate bus, because tests run in parallel in this process and others.
    let (domain, name) = (
        format!("allocation-{}", std::process::id()),
        format!("{test}-{number}"),
    );
    let link = VirtualBus::open(&domain, &name, &devices.claims()).expect("a virtual bus");
    let device_count = plan.devices.len();
    let (mut requests, inbox) = inbox(device_count);
    let mut replacements: Vec<_> = (plan.devices.iter().zip(0_u16..))
        .map(|(device, number)| {
            let replacement = Replacement {
                device: Some(build(device, None).expect("a device")),
                max_silence: device.spec.max_silence,
                outputs: device.outputs.clone(),
            };
            (number, Request::Replace(replacement))
        })
        .collect();
    let mut bus = Bus::new(Box::new(link), devices, sink(), Arc::clone(&status)).with_inbox(inbox);
    let clock = Monotonic;
    let (nonsense, stop) = (AtomicBool::new(false), AtomicBool::new(false));
    let result = std::thread::scope(|scope| {
        scope.spawn(|| far_end(&robot, number, &domain, &name, &nonsense, &stop));
        let end = clock.now() + Nanos::from_millis(60_000);
        let mut turn_until = |done: &mut dyn FnMut() -> bool| {
            while !done() && clock.now() < end {
                assert_eq!(bus.turn(&clock), Turn::Continue);
            }
        };
        // Warm-up: every device has sent something.
        let readings = |d: &DeviceHealth| d.counters[Counter::Readings as usize];
        turn_until(&mut || status.devices().all(|d| readings(&d) > 10));
        nonsense.store(true, Relaxed);
        let (frames, published) = (status.frames.load(Relaxed), status.published.load(Relaxed));
        let mut replies = Vec::with_capacity(2 * device_count);
        let allocated = counted(|| {
            for (device, request) in replacements.drain(..) {
                assert_eq!(requests.send(device, request), Ok(()));
            }
            turn_until(&mut || {
                replies.extend(requests.take());
                replies.len() == device_count
            });
            turn_until(&mut || status.frames.load(Relaxed) >= frames + FRAMES / 2);
            for device in 0..device_count {
                let command = Request::Command {
                    command: Command::Tare,
                    until: Nanos::MAX,
                };
                assert_eq!(requests.send(device as u16, command), Ok(()));
            }
            turn_until(&mut || {
                replies.extend(requests.take());
                replies.len() == 2 * device_count
            });
            turn_until(&mut || status.frames.load(Relaxed) >= frames + FRAMES);
        });
        let replaced = |(_, reply): &&(u16, Reply)| matches!(reply, Reply::Replaced(_));
        assert_eq!(replies.len(), 2 * device_count);
        assert_eq!(replies.iter().filter(replaced).count(), device_count);
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

/// Asserts that the bad frames were counted as bad.
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

/// Two coupled motors, of which one wraps, and the velocity of a third board at one of the joints.
#[test]
fn joints_of_several_devices_allocate_nothing() {
    let mut text = "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n\
                    source = { kind = \"virtual\", name = \"b\" }\n"
        .to_owned();
    for (address, joint) in [
        (1, "name = \"m\""),
        (
            2,
            "name = \"n\"\nwraps_rad = [0.0, 3.0]\ncentre_rad = 0.0\nmax_speed_radps = 9.0",
        ),
        (3, "name = \"q\"\ntakes = [\"velocity\"]"),
    ] {
        text += &format!(
            "[[bus.device]]\ndriver = \"icub_motor\"\nname = \"{address}\"\n\
             address = {address}\n[[bus.device.joint]]\n{joint}\n"
        );
    }
    text += "[[bus.coupling]]\njoints = [\"q\", \"r\"]\nmotors = [\"m\", \"n\"]\n\
             matrix = [[1.0, 2.0], [1.0, -1.0]]\ntakes = [\"position\", \"current\"]\n";
    let plan = Plan::parse(&text, Path::new(".")).expect("a plan");
    let bus = &plan.buses[0];
    let status = Arc::new(BusStatus::new(0, bus));
    let mut devices = BusDevices::new(0, bus, None, status).expect("devices");
    let mut samples = 0;
    let allocated = counted(|| {
        for k in 0..1000_u16 {
            for address in 1..4 {
                let [low, high] = k.to_le_bytes();
                let id = Id::standard(0x100 | address << 4);
                let frame = Frame::new(id, &[0, 0, low, 0, 0, low, high, 0]);
                let t = Nanos::from_millis(i64::from(k));
                devices.on_frame(&frame.at(t, StampKind::Software), |_| samples += 1);
            }
        }
    });
    assert_eq!((allocated, samples), ((0, 0), 2000));
}

#[test]
fn a_bus_that_publishes_allocates_the_transports_loan_alone() {
    let base = tempfile::tempdir().unwrap();
    let domain = Domain::open(&DomainConfig::new(base.path(), "allocation")).unwrap();
    for number in 0..robot().plan.buses.len() {
        let mut reader = None;
        let (allocated, published, status) = run_bus(number, "shared", || {
            let writer =
                Writer::<Sample>::create(&domain, &format!("bus{number}"), domain.epoch()).unwrap();
            reader = Some(Reader::<Sample>::open(&domain, &format!("bus{number}")).unwrap());
            SharedMemory::new(writer, "robot", Arc::default())
        });
        let sends = usize::try_from(published).unwrap();
        assert_eq!(
            allocated,
            (sends, 48 * sends),
            "bus {number}: one loan of 48 bytes per sample"
        );
        assert!(bad_frames(&status) > 100 && status.publish_failures.load(Relaxed) == 0);
        // The samples were really sent: the reader has the newest.
        let newest = reader.unwrap().latest().unwrap().expect("a sample");
        assert!(
            newest.header.sequence + 1 >= published,
            "{} {published}",
            newest.header.sequence
        );
    }
}

/// A recorded session: the frames in order, with their bus numbers.
fn session(robot: &SimulatedRobot, seconds: f64) -> Vec<(usize, Frame)> {
    let mut log = Vec::new();
    record(
        robot,
        &SimulationSettings::default(),
        seconds,
        Nanos::from_millis(50_000),
        &mut log,
    )
    .unwrap();
    let mut reader = log::LogReader::new(&log[..]);
    let mut frames = Vec::new();
    while let Some(record) = reader.next_record().unwrap() {
        let takes = |bus: &usize| {
            robot
                .plan
                .matching(*bus)
                .is_none_or(|m| m.takes(record.interface))
        };
        let bus = (0..robot.plan.buses.len())
            .find(takes)
            .expect("a bus of the robot");
        frames.push((bus, record.frame));
    }
    assert_eq!(reader.report().bad, 0);
    frames
}

fn devices_of_buses(robot: &SimulatedRobot) -> Vec<BusDevices> {
    let status = |(bus, number)| Arc::new(BusStatus::new(number, bus));
    let buses = robot.plan.buses.iter().zip(0..);
    buses
        .map(|(bus, number)| {
            BusDevices::new(number, bus, Some(Mode::Listen), status((bus, number))).unwrap()
        })
        .collect()
}

#[test]
fn decoding_allocates_nothing() {
    let robot = robot();
    let frames = session(&robot, 3.0);
    let mut buses = devices_of_buses(&robot);
    let mut bad: Vec<_> = (0..buses.len())
        .map(|bus| BadFrames::new(&robot, bus))
        .collect();
    let (mut samples, mut at) = (0_u64, Nanos::ZERO);
    let mut commands = Vec::with_capacity(64);
    // Measured from the first frame on: no warm-up is needed.
    let allocated = counted(|| {
        for (bus, frame) in &frames {
            buses[*bus].on_frame(frame, |_| samples += 1);
            at = frame.t;
            for bad in [bad[*bus].next(), bad[*bus].next()] {
                buses[*bus].on_frame(&bad.at(at, frame.stamp), |_| {});
            }
            buses[*bus].poll_transmit(at, |device, t| commands.push((device, t.frame)));
            for (device, command) in commands.drain(..) {
                let refused = samples % 2 == 0;
                let outcome = if refused {
                    Err(NotSent::Refused)
                } else {
                    Ok(at)
                };
                buses[*bus].on_sent(device, &command, outcome);
            }
            std::hint::black_box(buses[*bus].next_wake());
        }
        buses[0].restart(at);
        buses[0].stop(at);
    });
    assert_eq!(allocated, (0, 0));
    assert!(
        frames.len() > 10_000 && samples > 5000,
        "{} frames, {samples} samples",
        frames.len()
    );
}

#[test]
fn identification_in_the_pipeline_allocates_nothing_but_in_its_jobs() {
    let robot = robot();
    let mut config = robot.config.clone();
    config.identification.enabled = true;
    // Otherwise the hand counts as always touched and nothing can be identified.
    config.contact.iter_mut().for_each(|contact| {
        if contact.name() == "hand" {
            contact.presence = Occurrence::Possible;
        }
    });
    let setup = Setup::new(&config).unwrap();
    let channels = robot.plan.channels.iter();
    let channels: Vec<Option<usize>> = channels
        .map(|c| setup.robot.channel(c.kind, &c.name))
        .collect();
    let hand = setup.robot.contact("hand").expect("the hand is a contact");
    let mut buses = devices_of_buses(&robot);
    let mut samples = Vec::new();
    for (bus, frame) in session(&robot, 8.0) {
        buses[bus].on_frame(&frame, |sample| samples.push(*sample));
    }
    let mut pipeline = Pipeline::new(setup);
    assert!(pipeline.identification_refused().is_none());
    let (mut allocated, mut jobs, mut told, mut job) = ((0, 0), 0, 0, None);
    for (number, sample) in samples.iter().enumerate() {
        let Some(channel) = channels[sample.channel as usize] else {
            continue;
        };
        let t = sample.header.acquired;
        let one = counted(|| {
            if number % 5000 == 0 {
                pipeline.declare(hand, t, &ContactState::configured(number % 10_000 == 0));
            }
            pipeline.push(
                channel,
                t,
                &sample.reading().unwrap(),
                sample.header.quality,
            );
            while pipeline.poll().is_some() {
                told += u32::from(pipeline.inertia().is_some());
                job = pipeline.take_job().or(job.take());
                assert!(pipeline.budget(number % 7).is_some());
            }
        });
        allocated = (allocated.0 + one.0, allocated.1 + one.1);
        if let Some(mut done) = job.take() {
            done.run();
            let one = counted(|| pipeline.give_back(done));
            allocated = (allocated.0 + one.0, allocated.1 + one.1);
            jobs += 1;
        }
    }
    assert_eq!(allocated, (0, 0));
    let counts = pipeline.identification().unwrap().state(0).unwrap().1;
    assert!(
        jobs >= 6 && told + 2 >= jobs && counts.learnt > 100 && counts.contact > 100,
        "{jobs} {told} {counts:?}"
    );
}

#[test]
fn the_pipeline_allocates_nothing_once_it_runs() {
    let robot = robot();
    let folder = tempfile::tempdir().unwrap();
    let taxels = folder.path().join("taxels.csv");
    std::fs::write(&taxels, "0.01 0.02 0.03 0 0 1\n".repeat(24)).unwrap();
    let mut config = robot.config.clone();
    config.skin.push(TactileSkin {
        channel: "skin".into(),
        link: "l_hand".into(),
        contact: "hand".into(),
        taxels,
        first_taxel: 0,
        noise: 1.0,
        false_alarms_per_hour: 1.0,
        position_std_m: None,
        max_silence_ms: 250.0,
    });
    let setup = Setup::new(&config).unwrap();
    let skin = setup.channel(Kind::Skin, "skin").expect("a skin");
    let channels: Vec<Option<usize>> = robot
        .plan
        .channels
        .iter()
        .map(|c| setup.robot.channel(c.kind, &c.name))
        .collect();
    let hand = setup.robot.contact("hand").expect("the hand is a contact");
    let mut buses = devices_of_buses(&robot);
    let mut samples = Vec::new();
    for (bus, frame) in session(&robot, 6.0) {
        buses[bus].on_frame(&frame, |sample| samples.push(*sample));
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
                // A touch that comes and goes, sometimes of no number.
                let pressure = if number % 2000 < 1000 { 50.0 } else { f64::NAN };
                let touch = Skin {
                    triangle: (number % 3) as u32,
                    taxels: [pressure; 12],
                };
                pipeline.push(skin, t, &Reading::Skin(touch), sample.header.quality);
                // Half a second without the first joint; contacts that begin and end; samples that
                // are repeated, late or invalid.
                if number > 3000 && number < 5000 && sample.channel == 2 {
                    continue;
                }
                if number.is_multiple_of(500) {
                    let state = ContactState {
                        position: [1e-6 * number as f64, 0.0, 0.01],
                        position_std: 0.002,
                        ..ContactState::configured(number.is_multiple_of(1000))
                    };
                    pipeline.declare(hand, t, &state);
                }
                if number.is_multiple_of(7) {
                    pipeline.push(
                        channel,
                        t - Nanos::from_millis(20),
                        &sample.reading().unwrap(),
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
            pipeline.push(
                channel,
                t,
                &sample.reading().unwrap(),
                sample.header.quality,
            );
            while let Some(estimate) = pipeline.poll() {
                estimates += 1;
                withheld += u64::from(estimate.torques.joints().iter().any(|j| j.valid != 1));
                assert!(pipeline.budget(0).is_some());
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

/// Runs one call of a part of the dynamics, which must succeed, and asserts that it does not
/// allocate.
fn allocates_nothing<E: std::fmt::Debug>(what: &str, call: impl FnOnce() -> Result<(), E>) {
    let mut outcome = Ok(());
    assert_eq!(counted(|| outcome = call()), (0, 0), "{what}");
    outcome.expect(what);
}

/// From the first call on, for every base and any set of contacts. Errors do not allocate either.
#[test]
fn the_dynamics_allocate_nothing_after_construction() {
    let text = std::fs::read_to_string(&robot().config.model).unwrap();
    let elements = Model::from_urdf(&text, &[]).unwrap().sensors().to_vec();
    let keep: Vec<&str> = elements
        .iter()
        .map(|sensor| sensor.joint.as_str())
        .collect();
    let model = &Model::from_urdf(&text, &keep).unwrap();
    let noise = Noise {
        force: [0.1; 3],
        torque: [0.003; 3],
    };
    let sensors: Vec<_> = elements
        .iter()
        .map(|s| SensorCut::new(model, &s.joint, s.frame, s.direction, &s.pose, &noise).unwrap())
        .collect();
    // One contact of each kind on every link, so that no contact, one full wrench, and too few or
    // too many unknowns can be selected.
    let frame = |link| model::Frame {
        link,
        pose: Pose::from_xyz_rpy([0.02, -0.01, 0.05], [0.1, -0.2, 0.3]),
    };
    let kinds = [
        ContactKind::Wrench,
        ContactKind::Force,
        ContactKind::ForceAlong(Vec3::new(0.0, 0.6, 0.8)),
    ];
    let contacts: Vec<_> = (0..model.link_count())
        .flat_map(|link| {
            kinds.map(|kind| ContactSpec {
                frame: frame(link),
                kind,
                position: Vec3::new(0.0, 0.0, 0.1),
            })
        })
        .take(ContactSet::CAPACITY)
        .collect();
    let structure = &Structure::new(model, &sensors, &contacts, Structure::LENGTH_SCALE).unwrap();
    let readings =
        vec![spatial::Wrench::from_parts([10.0, -5.0, 40.0], [1.0, 0.5, -0.3]); sensors.len()];
    let push = spatial::Wrench::from_parts([1.0, 2.0, 3.0], [0.1, 0.2, 0.3]);
    let external = [ExternalWrench {
        frame: frame(model.link_count() - 1),
        wrench: push,
    }];
    assert!(sensors.len() == 1 && model.dof_count() > 5 && contacts.len() > 20);

    let values = |scale: f64| {
        (0..model.dof_count())
            .map(|dof| scale * (dof as f64).sin())
            .collect()
    };
    let (position, velocity, acceleration): (Vec<f64>, Vec<f64>, Vec<f64>) =
        (values(0.5), values(1.0), values(3.0));
    let state = JointState {
        position: &position,
        velocity: &velocity,
        acceleration: &acceleration,
    };
    let motion = &FrameMotion {
        angular_velocity: Vec3::new(0.3, -0.2, 0.1),
        angular_acceleration: Vec3::new(1.0, 2.0, -1.0),
        proper_acceleration: Vec3::new(0.5, -0.3, 9.81),
    };
    let none = ContactSet::EMPTY;
    let all = ContactSet::first(contacts.len());
    let one_each = (0..contacts.len()).map(|contact| [contact].into_iter().collect());
    let sets: Vec<ContactSet> = [none, all].into_iter().chain(one_each).collect();
    let mut kinematics = Kinematics::new(model, 0).unwrap();
    let mut inverse = InverseDynamics::new(model);
    let mut solver = Solver::new(structure);
    let mut regressor = Regressor::new(model);
    let mut stacked = StackedRegressor::new(structure);
    let dofs = model.dof_count();
    let mut covariance = Covariance::exact(model.link_count(), sensors.len());
    // A matrix of any size, derived from an existing one, because this crate does not depend on the
    // matrix library.
    let empty = covariance.dense().resize(0, 0, 0.0);
    let matrix = |rows, columns, value| empty.clone().resize(rows, columns, value);
    let sensor_numbers: Vec<usize> = (0..sensors.len()).collect();
    let columns = 20 + 6 * sensors.len();
    covariance
        .add(&[0, 5], &sensor_numbers, matrix(columns, columns, 0.01))
        .unwrap();
    covariance.add(&[7], &[], matrix(10, 10, 0.01)).unwrap();
    covariance.set_drift(0, [0.01; 6], Nanos::ZERO).unwrap();
    let mut propagation = Propagation::new(structure, &covariance).unwrap();
    let mut row = vec![0.0; 10 * model.link_count() + 6 * sensors.len()];
    for base in 0..model.link_count() {
        allocates_nothing("set_base", || kinematics.set_base(model, base));
        allocates_nothing("kinematics", || kinematics.update(model, state, motion));
        allocates_nothing("inverse dynamics", || {
            inverse.update(model, &kinematics, &external)
        });
        allocates_nothing("regressor", || regressor.update(model, &kinematics));
        for active in &sets {
            allocates_nothing("solver", || {
                solver.solve(model, structure, &kinematics, &readings, active, &external)
            });
            allocates_nothing("deviations", || {
                solver.update_deviations(structure)?;
                propagation.update(structure, &solver, &kinematics, Nanos::from_millis(100))
            });
            allocates_nothing("stacked regressor", || {
                stacked.update(&kinematics, &readings, active, &external)
            });
            allocates_nothing("estimate rows", || {
                let rows = EstimateRows::new(structure, &solver, &kinematics)?;
                for dof in 0..dofs {
                    rows.torque_row(dof, &mut row)?;
                    rows.torque_measured(dof, &readings, &external)?;
                }
                Ok::<_, DynamicsError>(())
            });
        }
    }
    let results = [
        inverse.torque(),
        solver.torque(),
        propagation.torque_std(),
        &row,
    ];
    assert!(results.into_iter().flatten().all(|x| x.is_finite()));
    assert!(regressor.row(6).iter().all(|x| x.is_finite()));
    assert!(
        stacked
            .subtrees()
            .iter()
            .any(|subtree| subtree.remaining() > 0)
    );

    let unknown = [f64::NAN; 64];
    let too_short = JointState {
        velocity: &unknown[..velocity.len()],
        ..state
    };
    let refused = counted(|| {
        assert!(stacked.update(&kinematics, &[], &all, &[]).is_err());
        assert!(kinematics.update(model, too_short, motion).is_err());
        assert!(kinematics.set_base(model, model.link_count()).is_err());
        assert!(
            solver
                .solve(model, structure, &kinematics, &[], &all, &[])
                .is_err()
        );
    });
    assert_eq!(refused, (0, 0));
}
