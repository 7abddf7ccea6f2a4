//! Joints from coupled motors, from devices that wrap, and from several devices, through real
//! drivers: against the truth, with silences, faults, replacements, and back to a log.
#![allow(missing_docs, clippy::unwrap_used)]

mod offline;
mod plan;

use proprio_drivers::{Board, Frames, Mode, Spec};
use proprio_gateway::devices::{BusDevices, build};
use proprio_gateway::inbox::{Replacement, Reply, Request};
use proprio_gateway::offline::{decode, encode};
use proprio_gateway::plan::Plan;
use proprio_gateway::status::BusStatus;
use proprio_topics::csv::Columns;
use proprio_topics::{Counter, JointState, Nanos, Quality, Reading, Sample, StampKind};
use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};
use std::path::Path;
use std::sync::Arc;

const GAP: Quality = Quality::GAP_BEFORE;
const ZERO: Quality = Quality::ZERO_CHANGED;

/// Half a step of an icub_motor's shaft: position, velocity.
const HALF_POSITION: f64 = 0.5 * TAU / 65536.0;
const HALF_VELOCITY: f64 = HALF_POSITION * 1000.0;

/// The motors of iCub's shoulder.
const SHOULDER: &str = r#"
      [[bus.device]]
      driver = "icub_motor"
      name = "board_1"
      address = 1
      max_silence_ms = 30
        [[bus.device.joint]]
        name = "motor_1"
        ratio = 100.0
      [[bus.device]]
      driver = "icub_motor"
      name = "board_2"
      address = 2
      max_silence_ms = 50
        [[bus.device.joint]]
        name = "motor_2"
        ratio = 100.0
        sign = -1
        offset_rad = 0.5
      [[bus.device]]
      driver = "icub_motor"
      name = "board_3"
      address = 3
      max_silence_ms = 30
        [[bus.device.joint]]
        name = "motor_3"
        ratio = 100.0
      [[bus.coupling]]
      joints = ["pitch", "roll", "yaw"]
      motors = ["motor_1", "motor_2", "motor_3"]
      matrix = [[1.0, 0.0, 0.0], [1.0, 0.615, 0.0], [0.0, -0.615, 0.615]]
"#;

/// An encoder at the joint, which wraps, and a drive.
const ELBOW: &str = r#"
      [[bus.device]]
      driver = "canopen_encoder"
      name = "encoder"
      address = 20
      counts_per_turn = 65536.0
      max_silence_ms = 40
        [[bus.device.joint]]
        name = "elbow"
        sign = -1
        offset_rad = 0.2
        takes = ["position"]
        wraps_rad = [0.0, 6.283185307179586]
        centre_rad = 0.5
        max_speed_radps = 10.0
      [[bus.device]]
      driver = "canopen_drive"
      name = "drive"
      address = 21
      counts_per_turn = 4096.0
      rated_torque = 0.5
      rated_current = 3.0
      max_silence_ms = 20
      pdos = [
          { number = 1, objects = [0x606C, 0x6078], sync = 0 },
          { number = 2, objects = [0x6041, 0x6064, 0x6077], sync = 0 },
      ]
        [[bus.device.joint]]
        name = "elbow"
        ratio = 100.0
        takes = ["velocity", "torque", "current"]
"#;

fn plan(devices: &str) -> Result<Plan, String> {
    let text = format!(
        "schema = 1\nrobot = \"arm\"\n[[bus]]\nname = \"arm\"\n\
         source = {{ kind = \"virtual\", name = \"arm\" }}\n{devices}"
    );
    Plan::parse(&text, Path::new("."))
}

fn ms(ms: f64) -> Nanos {
    Nanos::from_seconds(ms * 1e-3)
}

/// A bus with its boards.
struct Rig {
    plan: Plan,
    devices: BusDevices,
    boards: Vec<Box<dyn Board>>,
    status: Arc<BusStatus>,
}

impl Rig {
    fn new(devices: &str) -> Self {
        let plan = plan(devices).unwrap();
        let bus = &plan.buses[0];
        let status = Arc::new(BusStatus::new(0, bus));
        let mode = Mode::Listen;
        let devices = BusDevices::new(0, bus, Some(mode), Arc::clone(&status)).unwrap();
        let boards = bus.devices.iter().map(|device| {
            let spec = Spec {
                mode,
                ..device.spec.clone()
            };
            device.options.board(&spec).unwrap()
        });
        Self {
            boards: boards.collect(),
            devices,
            status,
            plan,
        }
    }

    /// Device number `device` reports `state`, of its own shaft, at `t`: the joints' samples.
    fn send(
        &mut self,
        device: usize,
        t: Nanos,
        state: JointState,
        quality: Quality,
    ) -> Vec<Sample> {
        let mut samples = self.send_all(device, t, state, quality);
        samples.retain(|sample| matches!(sample.reading(), Some(Reading::Joint(_))));
        samples
    }

    /// The same with all samples.
    fn send_all(
        &mut self,
        device: usize,
        t: Nanos,
        state: JointState,
        quality: Quality,
    ) -> Vec<Sample> {
        let mut frames = Frames::new();
        let reading = Reading::Joint(state);
        let board = &mut self.boards[device];
        board.encode(0, &reading, quality, &mut frames).unwrap();
        let mut samples = Vec::new();
        self.devices.poll_transmit(t, |_, _| {});
        for frame in &frames {
            let frame = frame.at(t, StampKind::Software);
            self.devices
                .on_frame(&frame, |sample| samples.push(*sample));
        }
        samples
    }

    /// Device number `device` reports what it measures of joints in these states.
    fn measure(
        &mut self,
        device: usize,
        t: Nanos,
        joints: &BTreeMap<&str, JointState>,
    ) -> Vec<Sample> {
        let bus = &self.plan.buses[0];
        let output = bus.devices[device].outputs[0];
        let inverse = bus
            .joints
            .inverse(&output.input.unwrap(), output.map)
            .unwrap();
        let state = |channel: &u32| joints[self.plan.channels[*channel as usize].name.as_str()];
        let states: Vec<JointState> = inverse.channels.iter().map(state).collect();
        let state = inverse.device(inverse.shaft(&states));
        self.send(device, t, state, Quality::GOOD)
    }

    fn name(&self, sample: &Sample) -> &str {
        &self.plan.channels[sample.channel as usize].name
    }

    fn replace(&mut self, device: usize, text: &str, whole: bool) {
        let new = plan(text).unwrap().buses.remove(0).devices.remove(device);
        let request = Request::Replace(Replacement {
            device: whole.then(|| build(&new, Some(Mode::Listen)).unwrap()),
            max_silence: new.spec.max_silence,
            outputs: new.outputs,
        });
        let number = u16::try_from(device).unwrap();
        let reply = self.devices.request(number, request, Nanos::ZERO);
        assert!(matches!(reply, Some(Reply::Replaced(_))), "at once");
    }

    fn count(&self, device: usize, counter: Counter) -> u64 {
        self.status.devices().nth(device).unwrap().counters[counter as usize]
    }
}

fn joint(sample: &Sample) -> JointState {
    match sample.reading() {
        Some(Reading::Joint(state)) => state,
        other => panic!("{other:?}"),
    }
}

fn position(position: f64) -> JointState {
    JointState {
        position,
        ..JointState::ABSENT
    }
}

fn moving(position: f64, velocity: f64) -> JointState {
    JointState {
        position,
        velocity,
        ..JointState::ABSENT
    }
}

/// A smooth motion of joint number `k` at `t` seconds.
fn truth(k: usize, t: f64) -> JointState {
    let (amplitude, rate) = (0.4 + 0.1 * k as f64, 2.0 + 0.7 * k as f64);
    let (sin, cos) = (rate * t).sin_cos();
    JointState {
        position: amplitude * sin,
        velocity: amplitude * rate * cos,
        acceleration: -amplitude * rate * rate * sin,
        torque: 3.0 * cos + k as f64,
        current: 0.5 * sin,
    }
}

fn shoulder_at(t: f64) -> BTreeMap<&'static str, JointState> {
    let names = ["pitch", "roll", "yaw"];
    names
        .into_iter()
        .enumerate()
        .map(|(k, name)| (name, truth(k, t)))
        .collect()
}

/// Three motors that keep no step. Each sample is the truth at its stamp, to half a step of the
/// motors and what the carrying costs.
#[test]
fn coupled_joints_are_the_truth_at_their_stamp() {
    // With the reported velocity, and with the difference of two positions.
    for (velocity, carried) in [(true, 0.5), (false, 1.0)] {
        let keys = format!("address = {{}}\n velocity = {velocity}\n");
        let text = [1, 2, 3].iter().fold(SHOULDER.to_owned(), |text, n| {
            let address = format!("address = {n}\n");
            text.replace(&address, &keys.replace("{}", &n.to_string()))
        });
        let mut rig = Rig::new(&text);
        // Phases of a period of 4 ms.
        let phases = [0.0, 1.3, 2.9];
        let mut last = [Nanos::MIN; 3];
        let mut samples = 0;
        let mut worst = 0.0_f64;
        for k in 0..500 {
            for (device, phase) in phases.iter().enumerate() {
                let t = ms(4.0 * f64::from(k) + phase);
                for sample in rig.measure(device, t, &shoulder_at(t.seconds())) {
                    samples += 1;
                    assert_eq!(device, 2, "the last one completes it");
                    assert_eq!(sample.header.acquired, t);
                    let number = sample.channel as usize;
                    assert!(last[number] < t);
                    last[number] = t;
                    assert_eq!(rig.name(&sample), ["pitch", "roll", "yaw"][number]);
                    assert_eq!(sample.header.quality, Quality::GOOD);
                    if k == 0 {
                        continue;
                    }
                    let (found, truth) = (joint(&sample), truth(number, t.seconds()));
                    // The first motor is 2.9 ms old, the second one 1.6 ms; none of the motors
                    // accelerates by more than 24 rad/s^2 (behind its gear). A row's sum is 1.615.
                    let age: f64 = 2.9e-3;
                    let period = if velocity { 0.0 } else { 4e-3 };
                    let carry = carried * 24.0 * age * (age + period) / (2.0 * carried);
                    let noise = if velocity {
                        HALF_VELOCITY * age
                    } else {
                        2.5 * HALF_POSITION
                    };
                    let bound = 1.615 * (carry + (HALF_POSITION + noise) / 100.0);
                    let off = (found.position - truth.position).abs();
                    assert!(off < bound, "{number} {k}: {off} {bound}");
                    worst = worst.max(off);
                    assert_eq!(found.velocity.is_finite(), velocity);
                    let off = (found.velocity - truth.velocity).abs();
                    // Carried by the difference of two velocities, each off by half a step.
                    let bound = 1.615 * (4.0 * HALF_VELOCITY / 100.0 + 100.0 * age * age);
                    assert!(!velocity || off < bound, "{number} {k}: {off} {bound}");
                }
            }
        }
        assert_eq!(samples, 1500);
        // Without carrying, a joint at 1 rad/s would be off by 2.9 mrad.
        assert!(worst < 4e-4, "{worst}");
    }
}

/// A motor that reports twice as often as the others does not make more samples.
#[test]
fn coupled_joints_follow_the_slowest_motor() {
    let mut rig = Rig::new(SHOULDER);
    let mut stamps = Vec::new();
    for k in 0..40 {
        let t = ms(f64::from(k));
        for (device, every) in [1, 2, 5].into_iter().enumerate() {
            if k % every == 0 {
                let samples = rig.measure(device, t, &shoulder_at(t.seconds()));
                stamps.extend(
                    samples
                        .iter()
                        .filter(|s| s.channel == 0)
                        .map(|s| s.header.acquired),
                );
            }
        }
    }
    assert_eq!(
        stamps,
        (0..8).map(|k| ms(5.0 * f64::from(k))).collect::<Vec<_>>()
    );
    let silences = rig.plan.channels.iter().map(|c| c.max_silence);
    assert_eq!(
        silences.collect::<Vec<_>>(),
        [ms(50.0); 3],
        "that of the slowest"
    );
    let devices = rig.plan.channels.iter().map(|c| c.device);
    assert_eq!(
        devices.collect::<Vec<_>>(),
        [0, 1, 2],
        "the motor in the joint's place"
    );
}

/// While one motor is silent there are no samples; when it is back, none is made of what the others
/// sent before.
#[test]
fn a_silent_motor_silences_its_coupling() {
    let mut rig = Rig::new(SHOULDER);
    let mut all = Vec::new();
    let mut send = |rig: &mut Rig, devices: &[usize], at: f64| {
        for device in devices {
            let t = ms(at + 0.1 * *device as f64);
            all.extend(rig.measure(*device, t, &shoulder_at(t.seconds())));
        }
    };
    send(&mut rig, &[0, 1, 2], 0.0);
    send(&mut rig, &[0, 1, 2], 4.0);
    // The second one is silent for longer than its maximum.
    for k in 0..20 {
        send(&mut rig, &[0, 2], 8.0 + 4.0 * f64::from(k));
    }
    send(&mut rig, &[0, 1, 2], 100.0);
    send(&mut rig, &[0, 1, 2], 104.0);
    // All are silent, and come back one by one: the last two readings are old by then.
    send(&mut rig, &[0, 1], 108.0);
    send(&mut rig, &[0, 1], 112.0);
    send(&mut rig, &[2], 300.0);
    send(&mut rig, &[1], 301.0);
    send(&mut rig, &[0], 302.0);
    let yaw: Vec<(f64, Quality)> = (all.iter().filter(|s| s.channel == 2))
        .map(|s| {
            (
                (s.header.acquired.seconds() * 1e5).round() / 100.0,
                s.header.quality,
            )
        })
        .collect();
    let good = Quality::GOOD;
    // The stamp is that of the newest reading, whoever completes it: at 100.1 ms the second motor.
    assert_eq!(
        yaw,
        [
            (0.2, good),
            (4.2, good),
            (100.1, GAP),
            (104.1, good),
            (108.1, good),
            (302.0, GAP)
        ]
    );
    for sample in all.iter().filter(|s| s.header.quality == GAP) {
        let (found, truth) = (
            joint(sample),
            truth(sample.channel as usize, sample.header.acquired.seconds()),
        );
        let off = (found.position - truth.position).abs();
        assert!(off < 2e-3, "{off}");
    }
    // The first joint does not depend on the second motor.
    let pitch = all
        .iter()
        .filter(|s| s.channel == 0)
        .map(|s| s.header.quality);
    assert_eq!(
        pitch.collect::<Vec<_>>(),
        [good, good, good, good, good, GAP]
    );
}

/// A fault of a motor spoils the joints that it moves, and no other; what happened in a reading
/// that was overtaken is not lost.
#[test]
fn flags_of_a_motor_are_those_of_its_joints() {
    let text = SHOULDER.replace("joints = ", "takes = [\"position\"]\n joints = ");
    let encoders = "[[bus.device]]\n driver = \"icub_motor\"\n name = \"board_9\"\n period_ms = 4\n\
                    address = 9\n[[bus.device.joint]]\n name = \"yaw\"\n\
                    takes = [\"velocity\"]\n";
    let with_yaw = text.replace("[[bus.coupling]]", &format!("{encoders}[[bus.coupling]]"));
    for text in [SHOULDER, &with_yaw] {
        let mut rig = Rig::new(text);
        let mut send = |device: usize, quality: Quality, at: f64| -> Vec<Quality> {
            let samples = rig.send(device, ms(at), moving(0.0, 0.0), quality);
            samples.iter().map(|s| s.header.quality).collect()
        };
        let (good, fault) = (Quality::GOOD, Quality::DEVICE_FAULT);
        send(0, good, 0.0);
        send(1, fault, 1.0);
        assert_eq!(send(2, good, 2.0), [good, fault, fault]);
        // Replaced by a good one before it was used.
        send(0, fault, 4.0);
        send(0, good, 5.0);
        send(1, good, 6.0);
        // M^-T is an upper triangle: the third motor's torque is in that of each joint.
        assert_eq!(
            send(2, Quality::DRIVE_FAULT, 7.0),
            [Quality::DRIVE_FAULT; 3]
        );
        send(0, Quality::DRIVE_FAULT, 8.0);
        send(1, good, 9.0);
        let drive = Quality::DRIVE_FAULT;
        assert_eq!(send(2, good, 10.0), [drive, drive, good]);
        // A gap before a reading that was overtaken is still a gap before the sample.
        send(0, good, 40.0);
        send(0, good, 41.0);
        send(1, good, 42.0);
        assert_eq!(send(2, good, 43.0), [GAP, GAP, GAP]);
    }
}

/// What is drawn from the drive is carried along while it is fresh, and is absent after.
#[test]
fn a_joint_of_two_devices_is_one_sample() {
    let mut rig = Rig::new(ELBOW);
    assert_eq!(rig.plan.channels.len(), 1);
    assert_eq!(
        rig.plan.channels[0].max_silence,
        ms(40.0),
        "that of the encoder"
    );
    assert_eq!(rig.plan.channels[0].device, 0);
    let encoder = |angle: f64| position((0.2 - angle).rem_euclid(TAU));
    let drive = |velocity: f64, torque: f64| JointState {
        velocity: 100.0 * velocity,
        torque: torque / 100.0,
        current: 1.5,
        ..position(7.0)
    };
    let mut samples = rig.send(0, ms(0.0), encoder(0.5), Quality::GOOD);
    assert_eq!(
        rig.send(1, ms(1.0), drive(0.2, 4.0), Quality::GOOD),
        [],
        "it makes none"
    );
    samples.extend(rig.send(0, ms(2.0), encoder(0.4), Quality::GOOD));
    rig.send(1, ms(3.0), drive(0.3, 5.0), Quality::GOOD);
    samples.extend(rig.send(0, ms(4.0), encoder(0.3), Quality::GOOD));
    samples.extend(rig.send(0, ms(23.0), encoder(0.1), Quality::GOOD));
    samples.extend(rig.send(0, ms(23.1), encoder(-0.1), Quality::GOOD));
    let states: Vec<JointState> = samples.iter().map(joint).collect();
    let expected = [
        (0.5, f64::NAN, f64::NAN),
        (0.4, 0.2, 4.0),
        // The velocity goes on by 0.1 rad/s in 2 ms.
        (0.3, 0.35, 5.0),
        (0.1, 1.3, 5.0),
        (-0.1, f64::NAN, f64::NAN),
    ];
    for (state, (position, velocity, torque)) in states.iter().zip(expected) {
        assert!((state.position - position).abs() < 1e-4, "{state:?}");
        let near = |found: f64, wanted: f64, step: f64| {
            (found.is_nan() && wanted.is_nan()) || (found - wanted).abs() < step
        };
        assert!(near(state.velocity, velocity, 1e-3), "{state:?} {velocity}");
        assert!(near(state.torque, torque, 0.026), "{state:?} {torque}");
        assert_eq!(state.current.is_nan(), torque.is_nan());
    }
    // Stamps and readings are the encoder's.
    assert_eq!(samples[2].header.acquired, ms(4.0));
    assert!(samples.iter().all(|s| s.header.quality == Quality::GOOD));
    assert_eq!(
        (
            rig.count(0, Counter::Readings),
            rig.count(1, Counter::Readings)
        ),
        (5, 4)
    );
}

/// A fault belongs to what it spoils.
#[test]
fn a_drives_fault_does_not_condemn_the_encoder() {
    let mut rig = Rig::new(ELBOW);
    let drive = JointState {
        torque: 0.03,
        current: 1.5,
        ..moving(7.0, 10.0)
    };
    let encoder = position(1.0);
    let mut at = 0.0;
    let mut after = |drive_quality: Quality, encoder_quality: Quality| {
        at += 2.0;
        rig.send(1, ms(at), drive, drive_quality);
        let sample = rig.send(0, ms(at + 1.0), encoder, encoder_quality)[0];
        (sample.header.quality, joint(&sample))
    };
    let (good, fault) = (Quality::GOOD, Quality::DEVICE_FAULT);
    let (quality, state) = after(Quality::DRIVE_FAULT, good);
    assert_eq!(quality, Quality::DRIVE_FAULT);
    assert!(state.velocity.is_finite() && state.torque.is_finite());
    // The drive's own encoder: its velocity is lost, the torque is not.
    let (quality, state) = after(fault, good);
    assert!(!quality.intersects(Quality::UNTRUSTED_ENCODER), "{quality}");
    assert!(state.position.is_finite() && state.velocity.is_nan() && state.torque.is_finite());
    let (quality, state) = after(good, fault);
    assert_eq!(quality, fault);
    assert!(state.velocity.is_finite() && state.torque.is_finite());
    let (quality, _) = after(good, good);
    assert_eq!(quality, good);
    // The drive's own state is on the joint's channel: neither does that condemn the encoder, in a
    // table with one cell for the flags of both.
    let both = fault | Quality::DRIVE_FAULT;
    let samples = rig.send_all(1, ms(50.0), drive, both);
    assert_eq!(samples.len(), 1, "its status alone");
    assert_eq!(samples[0].header.quality, Quality::DRIVE_FAULT);
    let mut rig = Rig::new(
        &ELBOW[ELBOW
            .find("[[bus.device]]\n      driver = \"canopen_d")
            .unwrap()..]
            .replace("takes", "# takes"),
    );
    let samples = rig.send_all(0, ms(50.0), drive, fault);
    assert_eq!(samples.len(), 2, "the only source of its joint");
    assert!(samples.iter().all(|s| s.header.quality.contains(fault)));
}

/// Readings of one device whose stamps run backward are counted and not taken, however the joint
/// is made up.
#[test]
fn stamps_that_run_backward_are_not_taken() {
    let mut rig = Rig::new(ELBOW);
    rig.send(1, ms(10.0), moving(0.0, 1.0), Quality::GOOD);
    assert_eq!(rig.send(0, ms(10.0), position(1.0), Quality::GOOD).len(), 1);
    assert_eq!(rig.send(0, ms(9.0), position(1.0), Quality::GOOD).len(), 0);
    assert_eq!(rig.send(0, ms(10.0), position(1.0), Quality::GOOD).len(), 1);
    rig.send(1, ms(9.0), moving(0.0, 1.0), Quality::GOOD);
    assert_eq!(
        [0, 1].map(|device| rig.count(device, Counter::Backward)),
        [1, 1]
    );
    assert_eq!(
        // The drive's own state has no stamp to compare with.
        [0, 1].map(|device| rig.count(device, Counter::Readings)),
        [2, 3]
    );
    let mut rig = Rig::new(SHOULDER);
    let mut stamps = Vec::new();
    // Motors behind each other by more than a period.
    for (device, at) in [
        (0, 10.0),
        (1, 3.0),
        (2, 4.0),
        (2, 6.0),
        (1, 5.0),
        (0, 9.0),
        (0, 11.0),
    ] {
        let samples = rig.send(device, ms(at), moving(0.0, 0.0), Quality::GOOD);
        stamps.extend(
            samples
                .iter()
                .filter(|s| s.channel == 0)
                .map(|s| s.header.acquired),
        );
    }
    assert_eq!(stamps, [ms(10.0), ms(11.0)]);
    assert_eq!(rig.count(0, Counter::Backward), 1);
}

/// A wheel that turns without end, seen through gaps.
#[test]
fn turns_are_counted_as_long_as_they_are_certain() {
    let mut rig = Rig::new(ELBOW);
    // 10 rad/s: the turn is certain over less than pi / 10 s.
    let mut at = |t: f64, angle: f64, quality: Quality| {
        let sample = rig.send(0, ms(t), position((0.2 - angle).rem_euclid(TAU)), quality)[0];
        (joint(&sample).position, sample.header.quality)
    };
    let mut angle = 0.5;
    for k in 0..200 {
        let (found, quality) = at(f64::from(k) * 20.0, angle, Quality::GOOD);
        assert!(
            (found - angle).abs() < 1e-4 && quality == Quality::GOOD,
            "{found} {angle}"
        );
        angle += 0.15;
    }
    // A silence that is short enough for the turns is a gap alone.
    let (found, quality) = at(4200.0, angle, Quality::GOOD);
    assert!((found - angle).abs() < 1e-4, "{found} {angle}");
    assert_eq!(quality, GAP);
    // A longer one: nearest to 0.5 rad.
    let (found, quality) = at(4600.0, angle, Quality::GOOD);
    let turns = (angle - found) / TAU;
    assert!(
        (turns - turns.round()).abs() < 1e-4 && (found - 0.5).abs() < PI,
        "{found}"
    );
    assert_eq!(quality, GAP | ZERO);
    assert_eq!(at(4620.0, angle, Quality::GOOD).1, Quality::GOOD);
}

/// A changed configuration: the gear and its turns, or the whole device, of one of a joint's
/// sources.
#[test]
fn a_replaced_source_marks_what_it_changes() {
    let mut rig = Rig::new(ELBOW);
    let mut t = 0.0;
    let mut send = |rig: &mut Rig, quality: Quality| {
        t += 2.0;
        rig.send(1, ms(t), moving(0.0, 10.0), Quality::GOOD);
        let sample = rig.send(0, ms(t), position(6.2), quality)[0];
        (joint(&sample), sample.header.quality)
    };
    // 0.2 - 6.2 + 2 pi = 0.28.
    let (state, quality) = send(&mut rig, Quality::GOOD);
    assert!((state.position - 0.2832).abs() < 1e-3 && quality == Quality::GOOD);
    rig.replace(0, ELBOW, false);
    assert_eq!(
        send(&mut rig, Quality::GOOD).1,
        Quality::GOOD,
        "nothing has changed"
    );
    let changed = ELBOW.replace("centre_rad = 0.5", "centre_rad = -6.0");
    rig.replace(0, &changed, false);
    let (state, quality) = send(&mut rig, Quality::GOOD);
    assert!((state.position + 6.0).abs() < 1e-3, "{state:?}");
    assert_eq!(quality, GAP | ZERO);
    assert_eq!(send(&mut rig, Quality::GOOD).1, Quality::GOOD);
    // The drive's gear leaves the position as it is.
    rig.replace(1, &changed.replace("ratio = 100.0", "ratio = 50.0"), false);
    let (state, quality) = send(&mut rig, Quality::GOOD);
    assert!(
        (state.velocity - 0.2).abs() < 1e-3 && quality == Quality::GOOD,
        "{state:?}"
    );
    // A shorter time for which it is fresh.
    rig.replace(
        1,
        &changed.replace("max_silence_ms = 20", "max_silence_ms = 3"),
        false,
    );
    assert!(send(&mut rig, Quality::GOOD).0.torque.is_finite());
    let sample = rig.send(0, ms(17.0), position(6.2), Quality::GOOD)[0];
    assert!(joint(&sample).velocity.is_nan());
    // A motor of a coupling: its joints are marked, the others are not.
    let mut rig = Rig::new(SHOULDER);
    let round = |rig: &mut Rig, at: f64| -> Vec<Quality> {
        let send = |device: usize| rig.send(device, ms(at), moving(0.0, 0.0), Quality::GOOD);
        let samples: Vec<Sample> = [0, 1, 2].into_iter().flat_map(send).collect();
        samples.iter().map(|s| s.header.quality).collect()
    };
    let good = Quality::GOOD;
    assert_eq!(round(&mut rig, 1.0), [good; 3]);
    rig.replace(
        2,
        &SHOULDER.replace("offset_rad = 0.5", "offset_rad = 0.4"),
        false,
    );
    assert_eq!(round(&mut rig, 2.0), [good; 3]);
    rig.replace(
        1,
        &SHOULDER.replace("offset_rad = 0.5", "offset_rad = 0.4"),
        false,
    );
    assert_eq!(round(&mut rig, 3.0), [good, GAP | ZERO, GAP | ZERO]);
    assert_eq!(round(&mut rig, 4.0), [good; 3]);
}

/// Encoders at the joints of coupled motors: positions from the one, torques from the other.
#[test]
fn a_coupling_can_give_torques_alone() {
    let joints = ["pitch", "roll"];
    let mut text = String::new();
    for (node, name) in (30..).zip(joints) {
        text += &format!(
            "[[bus.device]]\ndriver = \"canopen_encoder\"\nname = \"encoder_{name}\"\n\
             address = {node}\ncounts_per_turn = 65536.0\n[[bus.device.joint]]\nname = \"{name}\"\n\
             takes = [\"position\"]\n"
        );
    }
    for node in [1, 2] {
        text += &format!(
            "[[bus.device]]\ndriver = \"canopen_drive\"\nname = \"drive_{node}\"\n\
             address = {node}\ncounts_per_turn = 4096.0\nrated_torque = 1.0\nrated_current = 1.0\n\
             pdos = [{{ number = 1, objects = [0x6064, 0x6077], sync = 0 }}]\n\
             [[bus.device.joint]]\nname = \"motor_{node}\"\n"
        );
    }
    text += "[[bus.coupling]]\njoints = [\"pitch\", \"roll\"]\n\
             motors = [\"motor_1\", \"motor_2\"]\nmatrix = [[0.5, 0.5], [0.5, -0.5]]\n\
             takes = [\"torque\"]\n";
    let mut rig = Rig::new(&text);
    assert_eq!(rig.plan.channels.len(), 2);
    let torque = |torque: f64| JointState {
        torque,
        ..position(50.0)
    };
    assert_eq!(rig.send(2, ms(1.0), torque(0.3), Quality::GOOD), []);
    assert_eq!(
        rig.send(3, ms(2.0), torque(0.1), Quality::GOOD),
        [],
        "they are held"
    );
    let mut state = |device: usize, at: f64| {
        let sample = rig.send(device, ms(at), position(1.0), Quality::GOOD)[0];
        (sample.channel, joint(&sample))
    };
    // M^-T = [[1, 1], [1, -1]].
    for (device, expected) in [(0, 0.4), (1, 0.2)] {
        let (channel, state) = state(device, 3.0);
        assert_eq!(channel as usize, device);
        assert!((state.position - 1.0).abs() < 1e-4, "{state:?}");
        assert!((state.torque - expected).abs() < 1e-9, "{state:?}");
        assert!(state.velocity.is_nan());
    }
    assert!(state(0, 103.0).1.torque.is_nan(), "no longer fresh");
    // In a log too the torques of a row are in its samples.
    let table = "t,joint/pitch/position,joint/pitch/torque,joint/roll/position,joint/roll/torque\n\
                 1.0,0.5,0.4,0.6,0.2\n";
    let (mut log, mut decoded) = (Vec::new(), Vec::new());
    encode(&rig.plan, table.as_bytes(), &mut log).unwrap();
    decode(&rig.plan, &log[..], &mut decoded, Columns::All).unwrap();
    let rows = cells(&String::from_utf8(decoded).unwrap());
    for (name, torque) in [("pitch", 0.4), ("roll", 0.2)] {
        let found = rows["1.000"][&format!("joint/{name}/torque")];
        assert!((found - torque).abs() < 1e-3, "{rows:?}");
    }
    let shown = plan(&text).unwrap().to_string();
    assert!(
        shown.contains("coupling, condition number 2.0 (torque alone)"),
        "{shown}"
    );
    assert!(
        shown.contains("    roll = 0.5 * motor_1 + -0.5 * motor_2\n"),
        "{shown}"
    );
}

/// A table's cells by stamp and column.
fn cells(table: &str) -> BTreeMap<String, BTreeMap<String, f64>> {
    let mut lines = table.lines();
    let columns: Vec<&str> = lines.next().unwrap().split(',').collect();
    let rows = lines.map(|line| {
        let cells: Vec<&str> = line.split(',').collect();
        let t: f64 = cells[0].parse().unwrap();
        let values = columns.iter().zip(&cells).skip(1);
        let row = values.filter_map(|(c, v)| Some(((*c).to_owned(), v.parse().ok()?)));
        // Within a millisecond: an emergency message comes a frame earlier than the reading.
        (format!("{t:.3}"), row.collect())
    });
    let mut all = BTreeMap::<String, BTreeMap<String, f64>>::new();
    for (t, row) in rows.collect::<Vec<(String, BTreeMap<String, f64>)>>() {
        all.entry(t).or_default().extend(row);
    }
    all
}
