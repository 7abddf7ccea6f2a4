//! moteus: the query and replies of the package `moteus` in each resolution, and a controller that
//! is asked.

use crate::rig::{FD, Rig, board, count, decode, encode, listener, options, spec, supervisor};
use proprio_drivers::{
    Board, Decoded, Device, Frame, Frames, Id, Mode, NotSent, SpecError, StampedReading, State,
};
use proprio_topics::{
    Actuator, Counter, JointState, Nanos, Quality, Reading, StampKind, Temperature,
};
use proptest::prelude::*;
use std::f64::consts::TAU;

/// `tests/oracle/frames/moteus_replies.py`.
const GOLDEN: &str = include_str!("moteus.txt");

fn bytes(hex: &str) -> Vec<u8> {
    let byte = |at| u8::from_str_radix(&hex[at..at + 2], 16).unwrap();
    (0..hex.len()).step_by(2).map(byte).collect()
}

/// A reply of controller 1 to host 0.
fn reply(hex: &str) -> Frame {
    let frame = Frame::with_format(Id::standard(0x100), FD, &bytes(hex)).unwrap();
    frame.at(Nanos::from_millis(5), StampKind::Software)
}

fn read(hex: &str) -> (Vec<StampedReading>, Vec<proprio_drivers::Fault>) {
    decode(&mut *listener("moteus", "", &[0]), &[reply(hex)])
}

fn joint(stamped: &StampedReading) -> JointState {
    match stamped.reading {
        Reading::Joint(joint) => joint,
        other => panic!("{other:?}"),
    }
}

const STATE: JointState = JointState {
    position: 3.0,
    velocity: -7.0,
    acceleration: f64::NAN,
    torque: 1.5,
    current: f64::NAN,
};

#[test]
fn replies_are_read_as_by_the_makers_package() {
    let same = |a: f64, b: f64| (a.is_nan() && b.is_nan()) || (a - b).abs() < 1e-9;
    let mut absent = 0;
    for line in GOLDEN.lines().skip(1) {
        let mut words = line.split(' ');
        let (readings, faults) = read(words.next().unwrap());
        let right: Vec<f64> = words.map(|word| word.parse().unwrap()).collect();
        let [
            mode,
            position,
            velocity,
            torque,
            _voltage,
            temperature,
            fault,
        ] = right[..]
        else {
            panic!("{line}")
        };
        let [actuator, warmth, state] = &readings[..] else {
            panic!("{readings:?}")
        };
        let Reading::Actuator(Actuator {
            mode: read_mode,
            faults: read_fault,
            duty,
            encoder,
        }) = actuator.reading
        else {
            panic!()
        };
        assert_eq!((f64::from(read_mode), f64::from(read_fault)), (mode, fault));
        assert!(duty.is_nan() && encoder == 0);
        let Reading::Temperature(Temperature { celsius }) = warmth.reading else {
            panic!()
        };
        assert!(same(celsius, temperature));
        let joint = joint(state);
        assert!(same(joint.position, position * TAU), "{line}");
        assert!(same(joint.velocity, velocity * TAU), "{line}");
        assert!(
            same(joint.torque, torque) && joint.current.is_nan(),
            "{line}"
        );
        absent += usize::from(torque.is_nan());
        let (drive, sensor) = (mode == 1.0, mode == 1.0 && fault == 35.0);
        assert_eq!(
            state.quality.contains(Quality::DRIVE_FAULT),
            drive,
            "{line}"
        );
        assert_eq!(
            state.quality.contains(Quality::DEVICE_FAULT),
            sensor,
            "{line}"
        );
        assert_eq!(count(&faults, Counter::DriveFault), u32::from(drive));
        assert_eq!(count(&faults, Counter::DeviceFault), u32::from(sensor));
    }
    assert_eq!(absent, 4);
}

#[test]
fn a_controller_is_asked_as_by_the_makers_package() {
    let keys = "period_ms = 4";
    let mut rig = Rig::new("moteus", keys, &[0], (0, Reading::Joint(STATE)));
    rig.run(100);
    let query = GOLDEN
        .lines()
        .next()
        .unwrap()
        .strip_prefix("query ")
        .unwrap();
    assert_eq!(rig.sent.len(), 25);
    assert!(
        rig.sent
            .iter()
            .all(|frame| *frame == format!("00008001##1{query}"))
    );
    let joints = rig
        .readings
        .iter()
        .filter(|r| matches!(r.reading, Reading::Joint(_)));
    let joints: Vec<JointState> = joints.map(joint).collect();
    assert_eq!((joints.len(), rig.device.state()), (25, State::Streaming));
    assert!((joints[3].position - 3.0).abs() < 1e-6 && (joints[3].velocity + 7.0).abs() < 1e-6);
    assert_eq!(joints[3].torque, 1.5);
    // One reply is lost: that reading alone.
    rig.board_loses = Box::new(|n, _| n == 30);
    rig.run(100);
    // State and temperature are told once.
    assert_eq!(rig.readings.len(), 49 + 2);
    rig.board_loses = Box::new(|_, _| true);
    rig.run(300);
    assert_eq!(rig.device.state(), State::Silent);
    rig.board_loses = Box::new(|_, _| false);
    let before = rig.readings.len();
    rig.run(2500);
    assert_eq!(rig.device.state(), State::Streaming);
    let gaps = rig.readings[before..].iter();
    let gaps = gaps.filter(|r| r.quality.contains(Quality::GAP_BEFORE));
    assert_eq!(gaps.count(), 1);
    let sent = rig.sent.len();
    rig.device.stop(rig.now);
    rig.run(30);
    assert_eq!((rig.device.state(), rig.sent.len()), (State::Stopped, sent));
}

/// A state is told when it changes, and state and temperature once a second.
#[test]
fn states_are_told_on_change_and_once_a_second() {
    let mut device = listener("moteus", "", &[0]);
    // Mode 10 for 2.5 s; then mode 1 with fault 35, and again mode 10.
    let mut states = Vec::new();
    for ms in 0..2520 {
        let (mode, fault) = if (2510..2515).contains(&ms) {
            (1, 35)
        } else {
            (10, 0)
        };
        let reply = reply(&format!("2100{mode:02X}210E1F210F{fault:02X}505050"));
        let t = Nanos::from_millis(ms);
        let (readings, _) = decode(&mut *device, &[reply.at(t, StampKind::Software)]);
        for stamped in readings {
            match stamped.reading {
                Reading::Actuator(state) => states.push((ms, state.mode, state.faults)),
                Reading::Temperature(warmth) => states.push((ms, 0, warmth.celsius as u32)),
                _ => {}
            }
        }
    }
    let expected = [
        (0, 10, 0),
        (0, 0, 31),
        (1001, 10, 0),
        (1001, 0, 31),
        (2002, 10, 0),
        (2002, 0, 31),
        (2510, 1, 35),
        (2515, 10, 0),
    ];
    assert_eq!(states, expected);
    // A fault alone, in the answer to another program's question.
    let (readings, _) = decode(&mut *device, &[reply("210F2A50")]);
    let Reading::Actuator(state) = readings[0].reading else {
        panic!("{readings:?}")
    };
    assert_eq!((state.mode, state.faults), (10, 42));
}

#[test]
fn identifiers_hold_source_and_destination() {
    for (node, host, query, answer) in [
        (1, 0, Id::extended(0x8001), Id::standard(0x100)),
        (7, 3, Id::extended(0x8307), Id::standard(0x703)),
        (8, 0, Id::extended(0x8008), Id::extended(0x800)),
        (127, 126, Id::extended(0xFE7F), Id::extended(0x7F7E)),
    ] {
        let options = options("moteus", &format!("host = {host}"));
        let spec = spec(node, Mode::Supervise, &[0]);
        let mut device = options.device(&spec).unwrap();
        let mut board = options.board(&spec).unwrap();
        let mut out = Decoded::new();
        // Starting takes a poll.
        let sent = (0..3).find_map(|_| device.poll_transmit(Nanos::ZERO, &mut out));
        assert_eq!(device.claims()[0].id, answer);
        let frame = Frame::with_format(query, FD, &bytes("11001F01130D")).unwrap();
        assert_eq!(sent.map(|sent| sent.frame), Some(frame));
        board.present(0, &Reading::Joint(STATE), Quality::GOOD);
        let mut answers = Frames::new();
        board.on_frame(&frame, &mut answers);
        assert_eq!(answers[0].id, answer);
        let mut none = Frames::new();
        // Without the wish for a reply, to another controller, with other bits.
        for other in [query.raw() & 0x7FFF, query.raw() ^ 1, query.raw() | 0x10000] {
            let id = Id::extended(other);
            board.on_frame(
                &Frame::with_format(id, FD, frame.data()).unwrap(),
                &mut none,
            );
        }
        assert!(none.is_empty());
    }
}

fn one_reply(board: &mut dyn Board, query: &str) -> Option<String> {
    let query = Frame::with_format(Id::extended(0x8001), FD, &bytes(query)).unwrap();
    let mut answers = Frames::new();
    board.on_frame(&query, &mut answers);
    answers.first().map(ToString::to_string)
}

/// Types, counts and padding of any query; the numbers by hand: 0.25 turns, 2 turns/s, NaN.
#[test]
fn a_simulated_controller_answers_any_query() {
    let mut board = board("moteus", "", &[0]);
    let state = JointState {
        position: 0.25 * TAU,
        velocity: 2.0 * TAU,
        torque: f64::NAN,
        ..JointState::ABSENT
    };
    board.present(0, &Reading::Joint(state), Quality::GOOD);
    board.present(
        0,
        &Reading::Temperature(Temperature { celsius: 31.2 }),
        Quality::GOOD,
    );
    let mut ask = |query: &str| one_reply(&mut *board, query);
    let some = |text: &str| Some(format!("100##1{text}"));
    assert_eq!(ask("1301"), some("2301191480"));
    assert_eq!(ask("1701"), some("2701C409401F0080"));
    assert_eq!(ask("1B01"), some("2B01A8610000400D0300000000805050"));
    assert_eq!(ask("110E5050"), some("210E1F"));
    assert_eq!(ask("10040D"), some("20040D301F0000"));
    // A register that it does not have is 0; it answers nothing about those above 127.
    assert_eq!(ask("117F"), some("217F00"));
    // No query, cut off, too long, a write, register 128.
    for wrong in [
        "", "50", "11", "1F", "01000A", "14FF01", "2004000A", "118001",
    ] {
        assert_eq!(ask(wrong), None, "{wrong}");
    }
}

#[test]
fn replies_without_the_position_are_no_reading_of_the_joint() {
    // Mode alone; an error for a register; the position is not a number.
    let (readings, faults) = read("21000A50");
    assert!(matches!(
        readings[..],
        [StampedReading {
            reading: Reading::Actuator(_),
            ..
        }]
    ));
    assert!(faults.is_empty());
    let (readings, faults) = read("31810203");
    assert!(readings.is_empty() && faults.is_empty());
    let (readings, faults) = read("2D010000C07F");
    assert!(readings.is_empty() && count(&faults, Counter::Value) == 1);
    let (readings, _) = read("2E010000803F0000807F");
    assert_eq!(joint(&readings[0]).position, TAU);
    assert!(joint(&readings[0]).velocity.is_nan(), "infinite");
    // Unknown registers beside it, and a count of its own.
    let (readings, _) = read("20020402032902C800");
    assert!(readings.is_empty());
    let (readings, _) = read("20050001640A0201");
    assert_eq!(joint(&readings[1]).position, TAU);
    // Register 129: its lower seven bits are those of the position's number.
    let (readings, faults) = read("2181010A");
    assert!(readings.is_empty() && faults.is_empty(), "{readings:?}");
}

/// As i8, i16, i32 and f32.
#[test]
fn temperatures_are_read_in_each_type() {
    for (hex, right) in [
        ("210E1F", 31.0),
        ("250E3801", 31.2),
        ("290EE0790000", 31.2),
        ("2D0E0000FA41", 31.25),
    ] {
        let (readings, faults) = read(hex);
        assert!(faults.is_empty());
        let [
            StampedReading {
                reading: Reading::Temperature(Temperature { celsius }),
                ..
            },
        ] = readings[..]
        else {
            panic!("{readings:?}")
        };
        assert!((celsius - right).abs() < 1e-9, "{hex}: {celsius}");
    }
}

/// The device tells when the next query is due, and sends it then.
#[test]
fn queries_leave_in_step() {
    let mut device = supervisor("moteus", "period_ms = 4", &[0]);
    let mut out = Decoded::new();
    let mut poll = |device: &mut dyn Device, t: Nanos| {
        let sent = device.poll_transmit(t, &mut out)?;
        device.on_sent(&sent.frame, Ok(t));
        Some(sent.frame.id)
    };
    let query = Some(Id::extended(0x8001));
    assert_eq!(poll(&mut *device, Nanos::from_millis(1000)), query);
    for ms in [1004, 1008, 1012] {
        let due = Nanos::from_millis(ms);
        assert_eq!(device.next_wake(), Some(due));
        assert_eq!(poll(&mut *device, due - Nanos(1)), None);
        assert_eq!(poll(&mut *device, due), query);
    }
}

/// A reply that a queue has held back, or that comes twice, is none of what is asked now. A
/// listener does not know what was asked.
#[test]
fn a_reply_to_no_query_is_dropped() {
    let mut device = supervisor("moteus", "period_ms = 4", &[0]);
    let reply = reply("21010A");
    let count = |device: &mut dyn Device| {
        let (readings, faults) = decode(device, &[reply]);
        (readings.len(), faults)
    };
    let mut out = Decoded::new();
    let mut ask = |device: &mut dyn Device, ms: i64, outcome: Result<(), NotSent>| {
        let t = Nanos::from_millis(ms);
        let sent = device.poll_transmit(t, &mut out).expect("a query").frame;
        device.on_sent(&sent, outcome.map(|()| t));
    };
    ask(&mut *device, 1000, Ok(()));
    assert_eq!(count(&mut *device).0, 1);
    let (readings, faults) = count(&mut *device);
    assert_eq!((readings, faults[0].counter), (0, Counter::Unexpected));
    ask(&mut *device, 1004, Ok(()));
    assert_eq!(count(&mut *device).0, 1);
    ask(&mut *device, 1008, Err(NotSent::Deadline));
    assert_eq!(count(&mut *device).0, 0, "it was not asked");
    let mut other = listener("moteus", "", &[0]);
    assert_eq!([(); 2].map(|()| count(&mut *other).0), [1; 2]);
}

/// Another controller may be there: what the last one told is forgotten.
#[test]
fn a_restart_forgets_the_fault() {
    let mut device = listener("moteus", "", &[0]);
    let fault = reply("210001210F2321010A");
    let (readings, _) = decode(&mut *device, &[fault]);
    let faults = Quality::DRIVE_FAULT | Quality::DEVICE_FAULT;
    assert_eq!(readings[1].quality, faults);
    device.restart(Nanos::ZERO);
    let (readings, _) = decode(&mut *device, &[reply("21010A")]);
    assert_eq!(readings[0].quality, Quality::GAP_BEFORE);
    device.restart(Nanos::ZERO);
    let (readings, _) = decode(&mut *device, &[fault]);
    let first = readings[0].reading;
    assert!(
        matches!(first, Reading::Actuator(_)),
        "told anew: {first:?}"
    );
}

/// Fault 35 is one of the encoder, 38 is too hot.
#[test]
fn a_simulated_controller_tells_its_state_with_the_joints() {
    let (drive, sensor) = (Quality::DRIVE_FAULT, Quality::DEVICE_FAULT);
    for (quality, state) in [
        (Quality::GOOD, (0, 0)),
        (drive, (1, 38)),
        (sensor, (1, 35)),
        (drive | sensor, (1, 35)),
    ] {
        let mut node = board("moteus", "", &[0]);
        let warmth = Reading::Temperature(Temperature { celsius: 61.0 });
        assert!(encode(&mut *node, 0, &warmth, Quality::GOOD).is_empty());
        let frames = encode(&mut *node, 0, &Reading::Joint(STATE), quality);
        let (readings, _) = decode(&mut *listener("moteus", "", &[0]), &frames);
        let Reading::Actuator(told) = readings[0].reading else {
            panic!("{readings:?}")
        };
        assert_eq!((told.mode, told.faults), state, "{quality}");
        assert_eq!(readings[1].reading, warmth);
    }
}

#[test]
fn frames_that_are_no_reply_are_counted() {
    for wrong in [
        "",
        "50",
        "2004000A",
        "2F01",
        "20",
        "2080808080",
        "7F00",
        "11001F01130D",
        "30",
    ] {
        let (readings, faults) = read(wrong);
        assert!(readings.is_empty(), "{wrong}");
        assert_eq!(count(&faults, Counter::Value), 1, "{wrong}");
    }
    let remote = Frame::remote(Id::standard(0x100), 4);
    let (_, faults) = decode(&mut *listener("moteus", "", &[0]), &[remote]);
    assert_eq!(count(&faults, Counter::Length), 1);
    // Short replies may be classic frames.
    let classic = Frame::new(Id::standard(0x100), &bytes("2101010A"));
    let (readings, _) = decode(&mut *listener("moteus", "", &[0]), &[classic]);
    assert_eq!(readings.len(), 0);
    let classic = Frame::new(Id::standard(0x100), &bytes("21010A"));
    let (readings, _) = decode(&mut *listener("moteus", "", &[0]), &[classic]);
    assert!((joint(&readings[0]).position - 0.1 * TAU).abs() < 1e-12);
}

#[test]
fn which_faults_concern_the_position() {
    for fault in 32..=44_u8 {
        let mut device = listener("moteus", "", &[0]);
        let hex = format!("210001210F{fault:02X}21010A");
        let (readings, _) = decode(&mut *device, &[reply(&hex)]);
        let quality = readings.last().unwrap().quality;
        let concerns = matches!(fault, 35 | 36 | 42 | 43);
        assert_eq!(quality.contains(Quality::DEVICE_FAULT), concerns, "{fault}");
        assert!(quality.contains(Quality::DRIVE_FAULT));
        // A fault that is over.
        let (readings, _) = decode(&mut *device, &[reply("21000A21010A")]);
        assert_eq!(readings.last().unwrap().quality, Quality::GOOD);
    }
}

#[test]
fn wrong_keys_are_refused() {
    let refused = |address, keys: &str| {
        let device = options("moteus", keys).device(&spec(address, Mode::Listen, &[0]));
        device.map(|_| ()).unwrap_err()
    };
    for address in [0, 128] {
        assert!(matches!(
            refused(address, ""),
            SpecError::Address {
                least: 1,
                most: 127,
                ..
            }
        ));
    }
    for keys in [
        "period_ms = 0",
        "period_ms = 1001",
        "host = 128",
        "host = 5",
    ] {
        assert!(matches!(refused(5, keys), SpecError::Key { .. }), "{keys}");
    }
    for keys in ["period_ms = 1", "period_ms = 1000", "host = 127"] {
        let device = options("moteus", keys).device(&spec(5, Mode::Listen, &[0]));
        assert!(device.is_ok(), "{keys}");
    }
    assert!(options("moteus", "").needs_fd() && !options("icub_pos", "").needs_fd());
}

proptest! {
    #[test]
    fn states_are_read_back(
        position in -1e3_f64..1e3, velocity in -1e3_f64..1e3, torque in -50.0_f64..50.0,
        faulty: bool,
    ) {
        let state = JointState { position, velocity, torque, ..JointState::ABSENT };
        let quality = if faulty { Quality::DRIVE_FAULT } else { Quality::GOOD };
        let mut node = board("moteus", "host = 9", &[0]);
        let frames = encode(&mut *node, 0, &Reading::Joint(state), quality);
        let (readings, _) = decode(&mut *listener("moteus", "host = 9", &[0]), &frames);
        let back = readings.last().unwrap();
        prop_assert_eq!(back.quality.contains(Quality::DRIVE_FAULT), faulty);
        let back = joint(back);
        let near = |a: f64, b: f64| (a - b).abs() <= 1e-6 * b.abs().max(1.0);
        prop_assert!(near(back.position, position) && near(back.velocity, velocity));
        prop_assert!(near(back.torque, torque));
    }
}
