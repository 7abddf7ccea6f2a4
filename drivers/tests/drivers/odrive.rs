//! ODrive axes: frames that cantools encoded from the maker's .dbc files, values that join the
//! estimates for a while, faults, and requests.

use crate::rig::{
    FD, Rig, board, count, decode, encode, frame, joint, listener, options, shown_keys, spec,
    supervisor,
};
use proprio_drivers::{
    Decoded, Device, EncodeError, Frame, Frames, Id, Mode, NotSent, SpecError, State,
};
use proprio_topics::{
    Actuator, Counter, JointState, Kind, Nanos, Quality, Reading, StampKind, Temperature,
};
use proptest::prelude::*;
use std::f64::consts::TAU;

/// Frames with their values, `tests/oracle/frames/cansimple.py`.
const FRAMES: &str = include_str!("odrive.txt");

const OLD: &str = "firmware = \"0.5\"";

fn keys(firmware: &str) -> String {
    format!("firmware = {firmware:?}")
}

fn device(keys: &str) -> Box<dyn Device> {
    options("odrive", keys)
        .device(&spec(5, Mode::Listen, &[0]))
        .unwrap()
}

fn actuator(reading: &Reading) -> Actuator {
    match reading {
        Reading::Actuator(actuator) => *actuator,
        other => panic!("{other:?}"),
    }
}

/// Two floats of a message of axis 1.
fn floats(command: u16, values: [f32; 2], ms: f64) -> Frame {
    let data = values.map(f32::to_le_bytes).concat();
    Frame::new(Id::standard(1 << 5 | command), &data)
        .at(Nanos::from_seconds(ms * 1e-3), StampKind::Software)
}

fn estimates(position: f32, ms: f64) -> Frame {
    floats(0x09, [position, 0.5], ms)
}

#[test]
fn frames_of_the_makers_description_are_read() {
    let mut seen = [0; 5];
    for line in FRAMES.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        let [firmware, text, message, ref values @ ..] = words[..] else {
            panic!("{line}");
        };
        if text == "error" {
            continue;
        }
        let values: Vec<f64> = values.iter().map(|v| v.parse().unwrap()).collect();
        let mut device = device(&keys(firmware));
        let (readings, faults) = decode(&mut *device, &[frame(text, 0.0)]);
        assert!(faults.is_empty(), "{line}: {faults:?}");
        // What comes in a frame of its own is seen in the next estimates.
        let (next, _) = decode(&mut *device, &[frame("0A9#000000000000803F", 1.0)]);
        let joined = joint(&next[0].reading);
        match (message, &values[..]) {
            ("estimates", &[position, velocity]) => {
                let read = joint(&readings[0].reading);
                assert_eq!((read.position, read.velocity), (position, velocity));
                assert_eq!(readings[0].output, 0);
                assert!(read.torque.is_nan() && read.current.is_nan());
                assert!(read.acceleration.is_nan());
                seen[0] += 1;
            }
            ("current", &[current]) => {
                assert!(readings.is_empty());
                assert_eq!((joined.current, joined.velocity), (current, TAU));
                assert!(joined.torque.is_nan());
                seen[1] += 1;
            }
            ("torque", &[torque]) => {
                assert!(readings.is_empty());
                assert_eq!(joined.torque, torque);
                assert!(joined.current.is_nan());
                seen[2] += 1;
            }
            ("temperature", &[fet, motor]) => {
                let read: Vec<(u8, Reading)> =
                    readings.iter().map(|r| (r.output, r.reading)).collect();
                let temp = |celsius| Reading::Temperature(Temperature { celsius });
                assert_eq!(read, [(2, temp(fet)), (1, temp(motor))]);
                seen[3] += 1;
            }
            ("heartbeat", &[errors, state, motor, encoder, controller, doubtful, drive]) => {
                let read = actuator(&readings[0].reading);
                assert!(read.duty.is_nan() && readings[0].output == 0);
                let flags = 64.0 * motor + 256.0 * encoder + 512.0 * controller;
                let faults = errors as u32 | flags as u32;
                assert_eq!((f64::from(read.mode), read.faults), (state, faults));
                for quality in [readings[0].quality, next[0].quality] {
                    let read = [Quality::DEVICE_FAULT, Quality::DRIVE_FAULT];
                    let read = read.map(|flag| f64::from(u8::from(quality.contains(flag))));
                    assert_eq!(read, [doubtful, drive], "{line}");
                }
                assert_eq!(f64::from(u8::from(read.encoder != 0)), doubtful);
                assert_eq!(read.encoder & !faults, 0);
                seen[4] += 1;
            }
            _ => panic!("{line}"),
        }
    }
    assert_eq!(seen, [8, 6, 3, 3, 43]);
}

/// Current and torque are used as long as `hold_ms` says, and never for an earlier reading.
#[test]
fn what_comes_in_other_frames_is_held_and_then_absent() {
    let mut device = listener("odrive", "hold_ms = 20", &[0]);
    let (readings, faults) = decode(
        &mut *device,
        &[
            estimates(1.0, 0.0),
            floats(0x14, [9.0, 2.0], 5.0),
            floats(0x1C, [9.0, -3.0], 10.0),
            estimates(2.0, 10.0),
            estimates(3.0, 25.0),
            estimates(4.0, 25.1),
            estimates(5.0, 30.0),
            estimates(6.0, 30.1),
            floats(0x14, [9.0, 4.0], 40.0),
            estimates(7.0, 39.0),
            estimates(8.0, 40.0),
            // Not numbers: not reported.
            floats(0x14, [9.0, f32::NAN], 41.0),
            floats(0x1C, [9.0, f32::INFINITY], 41.0),
            estimates(9.0, 42.0),
        ],
    );
    assert!(faults.is_empty(), "{faults:?}");
    let (absent, mut read) = (f64::NAN, Vec::new());
    for stamped in &readings {
        let joint = joint(&stamped.reading);
        assert_eq!(joint.velocity, TAU * 0.5);
        read.push([joint.current, joint.torque]);
    }
    let expected = [
        [absent, absent],
        [2.0, -3.0],
        [2.0, -3.0],
        [absent, -3.0],
        [absent, -3.0],
        [absent, absent],
        [absent, absent],
        [4.0, absent],
        [absent, absent],
    ];
    assert_eq!(format!("{read:?}"), format!("{expected:?}"));
}

#[test]
fn torque_may_follow_from_the_current() {
    for firmware in ["0.5", "0.6"] {
        let keys = format!("torque_constant = 0.25\n{}", keys(firmware));
        let mut device = listener("odrive", &keys, &[0]);
        let frames = [
            floats(0x14, [9.0, 8.0], 1.0),
            floats(0x1C, [9.0, 5.0], 1.0),
            estimates(1.0, 2.0),
            estimates(1.0, 150.0),
        ];
        let (readings, _) = decode(&mut *device, &frames);
        let [first, last] = [0, 1].map(|n| joint(&readings[n].reading));
        assert_eq!((first.current, first.torque), (8.0, 2.0));
        assert!(last.current.is_nan() && last.torque.is_nan());
    }
}

/// In 0.5 command 15 is no temperature and 1C no torque.
#[test]
fn the_firmware_decides_what_is_read() {
    let claimed = |keys: &str| {
        let device = device(keys);
        let claims = device.claims().iter();
        let mut ids: Vec<u32> = claims
            .map(|claim| {
                assert!(claim.exclusive && claim.mask == u32::MAX);
                claim.id.raw() - (5 << 5)
            })
            .collect();
        ids.sort_unstable();
        ids
    };
    assert_eq!(claimed(""), [0x01, 0x09, 0x14, 0x15, 0x1C]);
    assert_eq!(claimed(OLD), [0x01, 0x09, 0x14]);
    let mut old = listener("odrive", OLD, &[0]);
    let frames = [
        floats(0x15, [30.0, 40.0], 0.0),
        floats(0x1C, [3.0, 4.0], 0.0),
        estimates(1.0, 1.0),
    ];
    let (readings, faults) = decode(&mut *old, &frames);
    assert!(faults.is_empty());
    assert_eq!(readings.len(), 1);
    assert!(joint(&readings[0].reading).torque.is_nan());
    let kinds = |keys: &str| {
        let outputs = options("odrive", keys).outputs().into_iter();
        outputs
            .map(|o| (o.number, o.kind, o.suffix.into_owned()))
            .collect::<Vec<_>>()
    };
    let joint = (0, Kind::Joint, String::new());
    assert_eq!(kinds(OLD), std::slice::from_ref(&joint));
    let [motor, fet] = [(1, "motor"), (2, "fet")]
        .map(|(number, suffix)| (number, Kind::Temperature, suffix.to_owned()));
    assert_eq!(kinds(""), [joint, motor, fet]);
}

#[test]
fn a_fault_lasts_until_the_next_heartbeat() {
    let mut device = listener("odrive", "", &[0]);
    let heartbeat = |errors: u32| {
        let [a, b, c, d] = errors.to_le_bytes();
        Frame::new(Id::standard(0x21), &[a, b, c, d, 8, 0, 0, 0])
    };
    let mut read = Vec::new();
    for errors in [0, 1 << 3, 1 << 13, 1 << 26 | 1, 0] {
        let frames = [heartbeat(errors), estimates(1.0, 0.0), estimates(1.0, 1.0)];
        let (readings, faults) = decode(&mut *device, &frames);
        let [device, drive] =
            [Counter::DeviceFault, Counter::DriveFault].map(|c| count(&faults, c));
        let qualities = [0, 1, 2].map(|n| readings[n].quality);
        assert!(qualities.iter().all(|q| *q == qualities[0]));
        read.push((qualities[0], device, drive));
    }
    let (device, drive) = (Quality::DEVICE_FAULT, Quality::DRIVE_FAULT);
    let expected = [
        (Quality::GOOD, 0, 0),
        (device, 2, 0),
        (drive, 0, 2),
        (device | drive, 2, 2),
        (Quality::GOOD, 0, 0),
    ];
    assert_eq!(read, expected);
}

/// An ODrive without a thermistor sends no number; neither does one without an estimate.
#[test]
fn what_is_no_number_is_no_reading() {
    let mut device = listener("odrive", "", &[0]);
    let (readings, faults) = decode(
        &mut *device,
        &[
            floats(0x15, [f32::NAN, 21.0], 0.0),
            floats(0x15, [22.0, f32::NAN], 0.0),
            floats(0x09, [1.0, f32::NAN], 1.0),
            floats(0x09, [f32::NAN, 1.0], 2.0),
            floats(0x09, [f32::INFINITY, 1.0], 3.0),
            floats(0x09, [2.0, f32::NEG_INFINITY], 4.0),
        ],
    );
    let outputs: Vec<u8> = readings.iter().map(|r| r.output).collect();
    assert_eq!(outputs, [1, 2, 0, 0]);
    assert_eq!(count(&faults, Counter::Value), 2);
    assert!(joint(&readings[2].reading).velocity.is_nan());
    assert!(joint(&readings[3].reading).velocity.is_nan());
    assert_eq!(readings[3].quality, Quality::GAP_BEFORE);
}

/// Another host's requests have the identifiers of the answers.
#[test]
fn requests_of_others_are_no_faults_and_wrong_lengths_are() {
    let mut device = listener("odrive", "", &[0]);
    for id in [0x21, 0x29, 0x34, 0x35, 0x3C].map(Id::standard) {
        let (readings, faults) = decode(
            &mut *device,
            &[
                Frame::remote(id, 8),
                Frame::remote(id, 0),
                Frame::new(id, &[]),
            ],
        );
        assert!(readings.is_empty() && faults.is_empty(), "{id} {faults:?}");
        for length in 1..8 {
            let (readings, faults) = decode(&mut *device, &[Frame::new(id, &[0; 8][..length])]);
            assert!(readings.is_empty());
            assert_eq!(count(&faults, Counter::Length), 1);
        }
        let fd = Frame::with_format(id, FD, &[0; 8]).unwrap();
        let (readings, faults) = decode(&mut *device, &[fd]);
        assert!(readings.is_empty());
        assert_eq!(count(&faults, Counter::Value), 1);
    }
    // Other messages, other axes, extended identifiers.
    for id in [
        Id::standard(0x2A),
        Id::standard(0x49),
        Id::standard(0x09),
        Id::extended(0x29),
    ] {
        let (readings, faults) = decode(&mut *device, &[Frame::new(id, &[0; 8])]);
        assert!(readings.is_empty() && faults.is_empty(), "{id}");
    }
}

fn still() -> (u8, Reading) {
    let joint = JointState {
        position: 1.0,
        velocity: 0.0,
        torque: 2.0,
        current: 4.0,
        ..JointState::ABSENT
    };
    (0, Reading::Joint(joint))
}

#[test]
fn nothing_is_sent_unless_the_keys_say_so() {
    let mut rig = Rig::new("odrive", "period_ms = 5", &[0], still());
    rig.run(100);
    assert_eq!(
        (rig.device.state(), rig.readings.len()),
        (State::Streaming, 20)
    );
    rig.board_loses = Box::new(|_, _| true);
    rig.run(100);
    assert_eq!(rig.device.state(), State::Silent);
    assert_eq!(rig.count(Counter::Silences), 1);
    rig.board_loses = Box::new(|_, _| false);
    rig.run(50);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(rig.readings[20].quality, Quality::GAP_BEFORE);
    rig.device.stop(rig.now);
    rig.run(20);
    assert_eq!(rig.device.state(), State::Stopped);
    assert_eq!(rig.sent, [""; 0]);
    assert_eq!(rig.count(Counter::Starts), 0);
}

/// The messages of one axis whose estimates come last, in rounds of 10 ms.
#[test]
fn an_old_firmware_is_asked() {
    for (firmware, round) in [
        ("0.5", &["034#R8", "029#R8"][..]),
        ("0.6", &["03C#R8", "034#R8", "029#R8"]),
    ] {
        let keys = format!("request_period_ms = 10\n{}", keys(firmware));
        let mut rig = Rig::new("odrive", &keys, &[0], still());
        assert_eq!(rig.board.period(), None);
        rig.run(200);
        assert_eq!(rig.sent, round.repeat(20));
        assert_eq!(rig.readings.len(), 20);
        let read = joint(&rig.readings[0].reading);
        let torque = if firmware == "0.5" { f64::NAN } else { 2.0 };
        assert!((read.position - 1.0).abs() < 1e-6 && read.current == 4.0);
        assert_eq!(read.torque.to_bits(), torque.to_bits());
        // Lost requests and refused ones are asked again in the next round.
        rig.host_loses = Box::new(|_, frame| frame.to_string() == "029#R8");
        rig.interface = Box::new(|frame| {
            let refused = frame.to_string() == "034#R8";
            refused.then_some(NotSent::Refused)
        });
        let sent = rig.sent.len();
        rig.run(20);
        assert_eq!(rig.sent.len() - sent, 2 * (round.len() - 1));
        assert_eq!(rig.unsent.len(), 2);
        // As long as none is answered they go on, and the silence is counted once.
        rig.run(3000);
        assert_eq!(rig.device.state(), State::Silent);
        assert_eq!(rig.count(Counter::Silences), 1);
        let sent = rig.sent.len();
        rig.run(1000);
        assert!(rig.sent.len() - sent >= 95 * (round.len() - 1));
        rig.host_loses = Box::new(|_, _| false);
        rig.interface = Box::new(|_| None);
        rig.run(200);
        assert_eq!(rig.device.state(), State::Streaming);
        assert_eq!(rig.readings[20].quality, Quality::GAP_BEFORE);
        rig.device.restart(rig.now);
        rig.run(20);
        assert_eq!(rig.device.state(), State::Streaming);
        rig.device.stop(rig.now);
        let sent = rig.sent.len();
        rig.run(50);
        assert_eq!((rig.device.state(), rig.sent.len()), (State::Stopped, sent));
    }
}

/// The device tells when the next round is due, and sends it then.
#[test]
fn requests_leave_in_step() {
    let keys = format!("request_period_ms = 10\n{OLD}");
    let mut device = supervisor("odrive", &keys, &[0]);
    let mut out = Decoded::new();
    let mut poll = |device: &mut dyn Device, t: Nanos| {
        let sent = device.poll_transmit(t, &mut out)?;
        device.on_sent(&sent.frame, Ok(t));
        Some(sent.frame.to_string())
    };
    let round = ["034#R8", "029#R8"].map(|request| Some(request.to_owned()));
    let begin = Nanos::from_millis(1000);
    let first = [(); 2].map(|()| poll(&mut *device, begin));
    assert_eq!(first, round);
    for ms in [1010, 1020, 1030] {
        let due = Nanos::from_millis(ms);
        assert_eq!(device.next_wake(), Some(due));
        assert_eq!(poll(&mut *device, due - Nanos(1)), None);
        let sent = [(); 2].map(|()| poll(&mut *device, due));
        assert_eq!(sent, round);
    }
}

/// After a silence the errors and the values of before are forgotten.
#[test]
fn a_silence_ends_what_was_held() {
    let keys = "hold_ms = 60000";
    let mut rig = Rig::new("odrive", keys, &[0], still());
    rig.run(20);
    let mut out = Decoded::new();
    let fault = Frame::new(Id::standard(0x21), &[8, 0, 0, 0, 8, 0, 0, 0]);
    rig.device
        .on_frame(&fault.at(rig.now, StampKind::Software), &mut out);
    rig.board_loses = Box::new(|_, _| true);
    rig.run(100);
    rig.board_loses = Box::new(|_, frame| frame.id != Id::standard(0x29));
    rig.run(20);
    let last = rig.readings.last().unwrap();
    assert!(!last.quality.contains(Quality::DEVICE_FAULT));
    assert!(joint(&last.reading).current.is_nan());
    assert!(joint(&last.reading).torque.is_nan());
}

#[test]
fn the_keys_of_the_page_are_legal() {
    let keys = shown_keys(include_str!("../../../docs/book/src/devices/odrive.md"));
    assert!(keys.contains("request_period_ms = 10"));
    let mut rig = Rig::new("odrive", keys, &[0], still());
    rig.run(50);
    assert_eq!(rig.device.state(), State::Streaming);
}

#[test]
fn wrong_keys_are_refused() {
    let refused = |keys: &str, address| {
        let options = options("odrive", keys);
        let spec = spec(address, Mode::Listen, &[0]);
        let error = options.device(&spec).map(|_| ()).unwrap_err();
        let board = options.board(&spec).map(|_| ()).unwrap_err();
        assert_eq!(board.to_string(), error.to_string());
        error
    };
    assert!(matches!(
        refused("", 64),
        SpecError::Address { most: 63, .. }
    ));
    for (keys, named) in [
        ("torque_constant = 0.0", "torque_constant"),
        ("torque_constant = -1.0", "torque_constant"),
        ("torque_constant = nan", "torque_constant"),
        ("torque_constant = inf", "torque_constant"),
        ("hold_ms = 0", "hold_ms"),
        ("hold_ms = 60001", "hold_ms"),
        ("request_period_ms = 0", "request_period_ms"),
        ("request_period_ms = 60001", "request_period_ms"),
        ("period_ms = 0", "period_ms"),
        ("period_ms = 60001", "period_ms"),
    ] {
        match refused(keys, 1) {
            SpecError::Key { key, .. } => assert_eq!(key, named),
            other => panic!("{other:?}"),
        }
    }
    let legal = "torque_constant = 0.05\nhold_ms = 60000\nrequest_period_ms = 1\nperiod_ms = 60000";
    for address in [0, 63] {
        let spec = spec(address, Mode::Supervise, &[0]);
        assert!(options("odrive", legal).device(&spec).is_ok());
    }
    let keys: toml::Table = "firmware = \"0.7\"".parse().unwrap();
    assert!(proprio_drivers::Options::deserialize("odrive", keys).is_err());
}

#[test]
fn a_simulated_axis_sends_what_it_is_given() {
    let texts = |frames: Vec<Frame>| frames.iter().map(ToString::to_string).collect::<Vec<_>>();
    let mut axis = board("odrive", "", &[0]);
    let position = JointState {
        position: TAU,
        velocity: -TAU,
        ..JointState::ABSENT
    };
    let joint = Reading::Joint(position);
    let alone = "029#0000803F000080BF";
    let mut send =
        |output, reading: &Reading, quality| texts(encode(&mut *axis, output, reading, quality));
    let good = Quality::GOOD;
    assert_eq!(send(0, &joint, good), [alone]);
    // Both temperatures once both are new, the inverter's first.
    let temp = |celsius| Reading::Temperature(Temperature { celsius });
    assert_eq!(send(1, &temp(1.0), good), [""; 0]);
    assert_eq!(send(1, &temp(2.0), good), [""; 0]);
    assert_eq!(send(2, &temp(1.0), good), ["035#0000803F00000040"]);
    assert_eq!(send(2, &temp(2.0), good), [""; 0]);
    // A heartbeat when the faults change.
    let fault = send(0, &joint, Quality::DEVICE_FAULT | Quality::SATURATED);
    assert_eq!(fault, ["021#0800000008000000", alone]);
    assert_eq!(send(0, &joint, Quality::DEVICE_FAULT), [alone]);
    let fault = send(0, &joint, Quality::DRIVE_FAULT);
    assert_eq!(fault, ["021#0000000208000000", alone]);
    let fault = send(0, &joint, good);
    assert_eq!(fault, ["021#0000000008000000", alone]);
    // It answers requests, in both forms, and nothing else.
    let mut answers = Frames::new();
    for id in [0x21, 0x29, 0x34, 0x35, 0x3C].map(Id::standard) {
        axis.on_frame(&Frame::remote(id, 8), &mut answers);
        axis.on_frame(&Frame::new(id, &[]), &mut answers);
        axis.on_frame(&Frame::new(id, &[0; 8]), &mut answers);
    }
    axis.on_frame(&Frame::remote(Id::standard(0x49), 8), &mut answers);
    assert_eq!(answers.len(), 10);
    let same = answers.chunks(2).all(|pair| pair[0] == pair[1]);
    assert!(same && answers[2].to_string() == alone);
    // The version in firmware 0.6: protocol 2, hardware 4.4.58, firmware 0.6.9, released.
    let version = Frame::remote(Id::standard(0x20), 8);
    answers.clear();
    axis.on_frame(&version, &mut answers);
    assert_eq!(texts(answers.to_vec()), ["020#0204043A00060900"]);

    let mut old = board("odrive", &format!("torque_constant = 0.5\n{OLD}"), &[0]);
    let torque = Reading::Joint(JointState {
        torque: 1.0,
        ..position
    });
    let quality = Quality::DEVICE_FAULT | Quality::DRIVE_FAULT;
    let sent = texts(encode(&mut *old, 0, &torque, quality));
    let expected = ["021#0041000008000100", "034#0000004000000040", alone];
    assert_eq!(sent, expected);
    // The torque tells the current only where that is absent: 4 A.
    let current = Reading::Joint(JointState {
        torque: 1.0,
        current: 4.0,
        ..position
    });
    let sent = texts(encode(&mut *old, 0, &current, quality));
    assert_eq!(sent, ["034#0000804000008040", alone]);
    answers.clear();
    old.on_frame(&version, &mut answers);
    assert!(answers.is_empty());
    // What an axis cannot send.
    let mut out = Frames::new();
    let absent = Reading::Joint(JointState::ABSENT);
    for (output, reading, error) in [
        (0, absent, EncodeError::NotFinite),
        (1, temp(1.0), EncodeError::Kind),
        (0, temp(1.0), EncodeError::Kind),
        (3, torque, EncodeError::Output(3)),
    ] {
        let refused = old.encode(output, &reading, quality, &mut out);
        assert_eq!(refused, Err(error));
    }
}

/// Half a step of single precision.
fn near(a: f64, b: f64) -> bool {
    (a - b).abs() <= b.abs() * f64::from(f32::EPSILON) / 2.0 * (1.0 + 1e-9)
}

proptest! {
    #[test]
    fn readings_come_back(
        position in -1e4_f64..1e4, velocity in -1e3_f64..1e3, torque in -50.0_f64..50.0,
        current in -99.0_f64..99.0, bits in 0_u8..4, celsius in -40.0_f64..150.0,
        errors in any::<u32>(), state in 0_u8..20, old: bool,
    ) {
        let keys = keys(if old { "0.5" } else { "0.6" });
        let mut axis = board("odrive", &keys, &[0]);
        let mut host = listener("odrive", &keys, &[0]);
        let mut quality = Quality::GOOD;
        if bits & 1 != 0 { quality |= Quality::DEVICE_FAULT; }
        if bits & 2 != 0 { quality |= Quality::DRIVE_FAULT; }
        let sent = JointState { position, velocity, torque, current, ..JointState::ABSENT };
        let frames = encode(&mut *axis, 0, &Reading::Joint(sent), quality);
        let (readings, _) = decode(&mut *host, &frames);
        let last = readings.last().unwrap();
        let back = joint(&last.reading);
        prop_assert_eq!(last.quality, quality);
        prop_assert!(near(back.position, position) && near(back.velocity, velocity));
        prop_assert!(near(back.current, current));
        prop_assert!(back.torque.is_nan() == old && (old || near(back.torque, torque)));
        let reading = Reading::Actuator(Actuator {
            duty: 0.0, mode: u32::from(state), encoder: 0, faults: errors,
        });
        let (readings, _) = decode(&mut *host, &encode(&mut *axis, 0, &reading, Quality::GOOD));
        let back = actuator(&readings[0].reading);
        prop_assert_eq!((back.mode, back.faults), (u32::from(state), errors));
        if !old {
            let reading = Reading::Temperature(Temperature { celsius });
            encode(&mut *axis, 1, &reading, Quality::GOOD);
            let frames = encode(&mut *axis, 2, &reading, Quality::GOOD);
            let (readings, _) = decode(&mut *host, &frames);
            for stamped in &readings {
                let Reading::Temperature(back) = stamped.reading else { panic!("{stamped:?}") };
                prop_assert!(near(back.celsius, celsius));
            }
            prop_assert_eq!(readings.len(), 2);
        }
    }
}
