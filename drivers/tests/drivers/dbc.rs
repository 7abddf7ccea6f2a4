//! Readings that a .dbc file describes: of several frames, with held values, counters, faults and
//! pages. The file's own numbers are tested with the gateway, which reads it.

mod messages;

use crate::rig::{board, count, decode, encode, listener, options, spec};
use proprio_drivers::signal::{Bits, Message, Raw, Signal, Switch};
use proprio_drivers::{
    Decoded, EncodeError, Format, Frame, Frames, Id, Mode, StampedReading, State,
};
use proprio_topics::{
    Counter, JointState, Nanos, Quality, Reading, StampKind, Temperature, Wrench,
};
use proptest::prelude::*;
use std::f64::consts::TAU;

/// A sensor's force and torque in two messages, with a count and a fault.
pub(crate) const WRENCH: &str = r#"
file = "device.dbc"
[[reading]]
kind = "wrench"
fields = { fx = "F.X", fy = "F.Y", fz = "F.Z", tx = "T.X", ty = "T.Y", tz = "T.Z" }
counter = "F.Count"
fault = "State.Error"
pair_timeout_ms = 2.0
"#;

/// A drive: position and velocity together, its torque now and then.
pub(crate) const DRIVE: &str = r#"
file = "device.dbc"
[[reading]]
kind = "joint"
fields = { position = "Motion.Position", velocity = "Motion.Velocity", torque = "State.Torque" }
hold_ms = { torque = 100.0 }
[[reading]]
kind = "temperature"
name = "motor"
fields = { temperature = "State.Temperature" }
"#;

/// Three values on two pages of a message.
pub(crate) const PAGES: &str = r#"
file = "device.dbc"
[[reading]]
kind = "imu"
fields = { ax = "Page.X", ay = "Page.Y", az = "Page.Common" }
pair_timeout_ms = 2.0
"#;

fn signal(name: &str, start: u64, length: u64, raw: Raw, factor: f64, unit: &str) -> Signal {
    Signal {
        name: name.to_owned(),
        long_name: None,
        bits: Bits::new(start, length, false).ok_or_else(String::new),
        raw,
        factor,
        offset: 0.0,
        unit: unit.to_owned(),
        switch: None,
    }
}

/// What the device's file describes.
pub(crate) fn messages() -> Vec<Message> {
    let message = |name: &str, id, signals: &[Signal]| Message {
        name: name.to_owned(),
        long_name: None,
        id: Ok(Id::standard(id)),
        j1939: false,
        size: 8,
        signals: signals.to_vec(),
    };
    let axes = |unit| {
        let axis = |(name, start)| signal(name, start, 16, Raw::Signed, 0.01, unit);
        [("X", 0), ("Y", 16), ("Z", 32)].map(axis)
    };
    let page = |mut signal: Signal, number: u64| {
        signal.switch = Some(Switch {
            signal: "Number".to_owned(),
            ranges: vec![(number, number)],
        });
        signal
    };
    let counter = signal("Count", 48, 4, Raw::Unsigned, 1.0, "");
    vec![
        message("F", 0x10, &[&axes("N")[..], &[counter]].concat()),
        message("T", 0x11, &axes("Nm")),
        message(
            "Motion",
            0x12,
            &[
                signal("Position", 0, 32, Raw::Float32, 1.0, "rev"),
                signal("Velocity", 32, 32, Raw::Float32, 1.0, "rpm"),
            ],
        ),
        message(
            "State",
            0x13,
            &[
                signal("Error", 0, 8, Raw::Unsigned, 1.0, ""),
                signal("Temperature", 8, 8, Raw::Signed, 1.0, "degC"),
                signal("Torque", 16, 16, Raw::Signed, 1.0, "mNm"),
            ],
        ),
        message(
            "Page",
            0x14,
            &[
                signal("Number", 0, 2, Raw::Unsigned, 1.0, ""),
                page(signal("X", 8, 16, Raw::Signed, 1.0, "m/s^2"), 0),
                page(signal("Y", 8, 16, Raw::Signed, 1.0, "m/s^2"), 1),
                page(signal("Z", 8, 16, Raw::Signed, 1.0, "m/s^2"), 2),
                signal("Common", 32, 16, Raw::Signed, 1.0, "m/s^2"),
            ],
        ),
    ]
}

fn at(id: u16, data: &[u8], ms: f64) -> Frame {
    Frame::new(Id::standard(id), data).at(Nanos::from_seconds(ms * 1e-3), StampKind::Software)
}

/// Force or torque number `n`: all three axes are n hundredths.
fn half(second: bool, n: u8, ms: f64) -> Frame {
    at(0x10 + u16::from(second), &[n, 0, n, 0, n, 0, n % 16, 0], ms)
}

/// The numbers of force and torque in each reading.
fn numbers(readings: &[StampedReading]) -> Vec<(u32, u32)> {
    let number = |value: f64| (value * 100.0).round() as u32;
    let counts = |stamped: &StampedReading| match stamped.reading {
        Reading::Wrench(w) => (number(w.force[0]), number(w.torque[2])),
        _ => panic!("{stamped:?}"),
    };
    readings.iter().map(counts).collect()
}

#[test]
fn two_frames_are_one_reading_with_the_time_of_the_first() {
    let mut device = listener("dbc", WRENCH, &[]);
    let (readings, faults) = decode(&mut *device, &[half(false, 7, 1.0), half(true, 7, 1.5)]);
    assert!(faults.is_empty(), "{faults:?}");
    assert_eq!(numbers(&readings), [(7, 7)]);
    assert_eq!(readings[0].acquired, Nanos::from_millis(1));
    assert_eq!(readings[0].quality, Quality::DEVICE_COUNTER);
    assert_eq!(readings[0].device_counter, 7);
}

#[test]
fn a_simulated_device_sends_at_the_stated_period() {
    for ms in [7, 20] {
        let board = board("dbc", &format!("period_ms = {ms}\n{WRENCH}"), &[]);
        assert_eq!(board.period(), Some(Nanos::from_millis(ms)));
    }
}

/// A signal's factor and offset come first, then its unit's.
#[test]
fn offsets_of_signals_and_units_add_up() {
    for (unit, celsius) in [
        ("degC", 60.0),
        ("K", 60.0 - 273.15),
        ("degF", (60.0 - 32.0) / 1.8),
    ] {
        let keys = format!("{DRIVE}units = {{ temperature = \"{unit}\" }}\n");
        let mut messages = messages();
        messages[3].signals[1].offset = -40.0;
        let mut options = options("dbc", &keys);
        options.describe(messages);
        let spec = spec(options.default_address().unwrap_or(1), Mode::Listen, &[0]);
        let mut device = options.device(&spec).unwrap();
        let (readings, _) = decode(&mut *device, &[at(0x13, &[0, 100, 0, 0, 0, 0, 0, 0], 1.0)]);
        let Reading::Temperature(told) = readings[0].reading else {
            panic!("{readings:?}")
        };
        assert!((told.celsius - celsius).abs() < 1e-9, "{unit}: {told:?}");
    }
}

/// Lost, late, doubled and swapped halves: no reading of two different halves, and each reading
/// that does not come is counted.
#[test]
fn halves_of_two_readings_are_never_combined() {
    let late = |n: u8, ms| half(true, n, ms);
    for (what, frames, expected, unpaired) in [
        (
            "a second half is lost",
            vec![half(false, 2, 10.0)],
            vec![(4, 4)],
            2,
        ),
        (
            "a first half is lost",
            vec![late(2, 10.5)],
            vec![(3, 3), (4, 4)],
            1,
        ),
        (
            "a second half is late",
            vec![
                half(false, 2, 10.0),
                half(false, 3, 20.0),
                late(2, 20.1),
                late(3, 20.5),
            ],
            vec![(4, 4)],
            3,
        ),
        (
            "a second half comes twice",
            vec![half(false, 2, 10.0), late(2, 10.5), late(2, 10.6)],
            vec![(2, 2), (3, 3), (4, 4)],
            1,
        ),
        (
            "a second half and the next first half are lost",
            vec![half(false, 1, 10.0), late(2, 20.5)],
            vec![(3, 3), (4, 4)],
            2,
        ),
    ] {
        let mut all = vec![half(false, 0, 0.0), late(0, 0.5)];
        let has_three = frames.iter().any(|frame| frame.data()[0] == 3);
        all.extend(frames);
        if !has_three {
            all.extend([half(false, 3, 30.0), late(3, 30.5)]);
        }
        all.extend([half(false, 4, 40.0), late(4, 40.5)]);
        let (readings, faults) = decode(&mut *listener("dbc", WRENCH, &[]), &all);
        let mut right = vec![(0, 0)];
        right.extend(expected);
        assert_eq!(numbers(&readings), right, "{what}");
        assert_eq!(count(&faults, Counter::Unpaired), unpaired, "{what}");
        assert!(
            readings
                .iter()
                .any(|r| r.quality.contains(Quality::GAP_BEFORE))
                || unpaired == 1
        );
    }
    // What was sent before the log began is no loss.
    let joined = [late(1, 0.5), half(false, 2, 10.0), late(2, 10.5)];
    let (readings, faults) = decode(&mut *listener("dbc", WRENCH, &[]), &joined);
    assert_eq!((numbers(&readings), faults.len()), (vec![(2, 2)], 0));
}

/// The message that `first` names opens a reading.
#[test]
fn the_first_message_is_named() {
    let keys = WRENCH.replace("counter = \"F.Count\"", "first = \"T\"");
    let frames = [half(true, 1, 0.0), half(false, 1, 0.5), half(true, 2, 10.0)];
    let (readings, faults) = decode(&mut *listener("dbc", &keys, &[]), &frames);
    assert_eq!((numbers(&readings), faults.len()), (vec![(1, 1)], 0));
    assert_eq!(readings[0].quality, Quality::GOOD);
}

#[test]
fn a_counter_tells_what_was_lost() {
    let mut device = listener("dbc", WRENCH, &[]);
    let frames = [14_u8, 15, 18, 18, 19].map(|n| {
        [
            half(false, n, f64::from(n)),
            half(true, n, f64::from(n) + 0.1),
        ]
    });
    let (readings, faults) = decode(&mut *device, frames.as_flattened());
    assert_eq!(numbers(&readings), [(14, 14), (15, 15), (18, 18), (19, 19)]);
    let gaps: Vec<bool> = readings
        .iter()
        .map(|r| r.quality.contains(Quality::GAP_BEFORE))
        .collect();
    assert_eq!(gaps, [false, false, true, false]);
    assert_eq!(
        count(&faults, Counter::Lost),
        2,
        "16 and 17, beyond the wrap"
    );
    assert_eq!(count(&faults, Counter::Unexpected), 1, "18 came twice");
}

#[test]
fn a_fault_lasts_until_it_is_taken_back() {
    let mut device = listener("dbc", WRENCH, &[]);
    let pair = |n: u8| {
        [
            half(false, n, f64::from(n)),
            half(true, n, f64::from(n) + 0.1),
        ]
    };
    let frames = [
        &pair(1)[..],
        &[at(0x13, &[4, 0, 0, 0], 1.5)],
        &pair(2),
        &[at(0x13, &[0, 0, 0, 0], 2.5)],
        &pair(3),
    ]
    .concat();
    let (readings, faults) = decode(&mut *device, &frames);
    let faulty: Vec<bool> = readings
        .iter()
        .map(|r| r.quality.contains(Quality::DEVICE_FAULT))
        .collect();
    assert_eq!(faulty, [false, true, false]);
    assert_eq!(count(&faults, Counter::DeviceFault), 1);
}

/// Position and velocity in every frame; the torque joins them while it is not too old.
#[test]
fn a_held_value_joins_the_others_until_it_is_too_old() {
    let mut device = listener("dbc", DRIVE, &[0]);
    let motion = |ms| {
        let data = [0.25_f32.to_le_bytes(), (-30.0_f32).to_le_bytes()].concat();
        at(0x12, &data, ms)
    };
    let state = at(0x13, &[0, 0xD8, 0x2C, 0x01], 5.0);
    let frames = [
        motion(0.0),
        state,
        motion(10.0),
        motion(105.0),
        motion(105.1),
    ];
    let (readings, faults) = decode(&mut *device, &frames);
    assert!(faults.is_empty(), "{faults:?}");
    let joints: Vec<JointState> = (readings.iter())
        .filter_map(|stamped| match stamped.reading {
            Reading::Joint(state) => Some(state),
            _ => None,
        })
        .collect();
    let torques: Vec<f64> = joints.iter().map(|state| state.torque).collect();
    assert!(torques[0].is_nan() && torques[3].is_nan(), "{torques:?}");
    assert_eq!(torques[1..3], [0.3, 0.3]);
    assert_eq!(joints[0].position, TAU / 4.0);
    assert!((joints[0].velocity + TAU / 2.0).abs() < 1e-15);
    assert!(joints[0].acceleration.is_nan());
    let Reading::Temperature(temperature) = readings[1].reading else {
        panic!("{readings:?}")
    };
    assert_eq!((readings[1].output, temperature.celsius), (1, -40.0));
}

/// The common value is taken from the pages that are read, and no other page disturbs them.
#[test]
fn pages_of_one_message_are_one_reading() {
    let mut device = listener("dbc", PAGES, &[]);
    let page = |number: u8, value: u8, ms| at(0x14, &[number, value, 0, 0, value, 0, 0, 0], ms);
    let frames = [
        page(2, 9, 0.0),
        page(0, 1, 0.1),
        page(1, 2, 0.2),
        page(2, 9, 0.3),
        page(0, 3, 10.0),
        page(1, 4, 10.1),
    ];
    let (readings, faults) = decode(&mut *device, &frames);
    assert!(faults.is_empty(), "{faults:?}");
    let values: Vec<[f64; 3]> = (readings.iter())
        .map(|stamped| match stamped.reading {
            Reading::Imu(imu) => imu.proper_acceleration,
            _ => panic!("{stamped:?}"),
        })
        .collect();
    assert_eq!(values, [[1.0, 2.0, 2.0], [3.0, 4.0, 4.0]]);
}

/// Signals that a frame has together are taken from that frame, however their pages overlap; and a
/// simulated device sends them so.
#[test]
fn signals_of_one_frame_are_one_reading() {
    let device = |keys: &str, x: &[(u64, u64)], y: &[(u64, u64)], mode| {
        let mut messages = messages();
        for (at, start, ranges) in [(1, 8, x), (2, 24, y)] {
            let signal = &mut messages[4].signals[at];
            signal.bits = Bits::new(start, 16, false).ok_or_else(String::new);
            signal.switch.as_mut().unwrap().ranges = ranges.to_vec();
        }
        let mut options = options("dbc", keys);
        options.describe(messages);
        let spec = spec(0, mode, &[]);
        let board = options.board(&spec).unwrap();
        (options.device(&spec).unwrap(), board)
    };
    let page = |number: u8, value: u8, ms| at(0x14, &[number, value, 0, value, 0, 0, 0, 0], ms);
    let frames = [
        page(0, 1, 0.0),
        page(1, 2, 5.0),
        page(2, 3, 7.0),
        page(0, 4, 10.0),
        page(1, 5, 15.0),
    ];
    let both = "file = \"device.dbc\"\n[[reading]]\nkind = \"imu\"\n\
                fields = { ax = \"Page.X\", ay = \"Page.Y\" }\n";
    let held = format!("{both}hold_ms = {{ ay = 100.0 }}\n");
    let of_zero = [[1.0; 2], [4.0; 2]];
    for (keys, x, y, expected) in [
        // A range that covers the other signal's page, in one piece or in two.
        (both, &[(0, 0)][..], &[(0, 1)][..], of_zero),
        (both, &[(0, 1)], &[(0, 0)], of_zero),
        (both, &[(1, 1), (0, 0)], &[(0, 1)], [[1.0; 2], [2.0; 2]]),
        // Ranges of which neither covers the other.
        (both, &[(0, 1)], &[(1, 2)], [[2.0; 2], [5.0; 2]]),
        (&held, &[(0, 0)], &[(0, 1)], of_zero),
    ] {
        let (mut device, mut board) = device(keys, x, y, Mode::Listen);
        let (readings, faults) = decode(&mut *device, &frames);
        assert!(faults.is_empty(), "{faults:?}");
        let values = readings.iter().map(|stamped| stamped.reading.values());
        let values: Vec<[f64; 2]> = values.map(|values| [values[0], values[1]]).collect();
        assert_eq!(values[..2], expected, "{x:?} {y:?}");
        device.restart(Nanos::ZERO);
        let sent = encode(&mut *board, 0, &readings[0].reading, Quality::GOOD);
        let (back, _) = decode(&mut *device, &sent);
        assert_eq!((sent.len(), back.len()), (1, 1), "{x:?} {y:?}");
        assert_eq!(back[0].reading.values()[..2], expected[0]);
    }
}

/// In messages of J1939 the highest values stand for none; a request for a message is no message.
#[test]
fn values_that_are_not_available_are_none() {
    let keys = "file = \"device.dbc\"\n[[reading]]\nkind = \"joint\"\n\
                fields = { position = \"G.Byte\", velocity = \"G.Word\", current = \"G.Bits\", \
                torque = \"G.Two\" }\n\
                hold_ms = { current = 1000.0, torque = 1000.0 }\nfault = \"G.Flag\"\n";
    let decoded = |j1939: bool, raw: Raw, flag: u64, data: [u8; 6]| {
        let message = Message {
            name: "G".to_owned(),
            id: Ok(Id::extended(0x18FF_1023)),
            j1939,
            signals: vec![
                signal("Byte", 0, 8, raw, 1.0, "rad"),
                signal("Word", 8, 16, raw, 1.0, "rad/s"),
                signal("Bits", 24, 4, raw, 1.0, "A"),
                signal("Flag", 32, flag, raw, 1.0, ""),
                signal("Two", 40, 2, raw, 1.0, "Nm"),
            ],
            ..messages()[0].clone()
        };
        let mut options = options("dbc", keys);
        options.describe(vec![message]);
        let mut device = options.device(&spec(0, Mode::Listen, &[0])).unwrap();
        let id = Id::extended(0x18FF_1023);
        let (readings, faults) = decode(&mut *device, &[Frame::remote(id, 6)]);
        assert!(readings.is_empty() && faults.is_empty(), "{faults:?}");
        let (readings, faults) = decode(&mut *device, &[Frame::new(id, &data)]);
        let is_faulty = count(&faults, Counter::DeviceFault) != 0;
        let values = |stamped: &StampedReading| match stamped.reading {
            Reading::Joint(joint) => [joint.position, joint.velocity, joint.current, joint.torque],
            _ => panic!("{stamped:?}"),
        };
        (readings.first().map(values), is_faulty)
    };
    let same = |found: Option<[f64; 4]>, right: [f64; 4]| {
        let equal = |(a, b): (f64, f64)| a == b || a.is_nan() && b.is_nan();
        found.is_some_and(|found| found.into_iter().zip(right).all(equal))
    };
    const NONE: f64 = f64::NAN;
    for (data, right, fault) in [
        (
            [0xFD, 0xFF, 0xFD, 0x0E, 1, 1],
            [253.0, 65023.0, 14.0, 1.0],
            true,
        ),
        (
            [0xFE, 0x00, 0x01, 0x0F, 3, 3],
            [NONE, 256.0, NONE, NONE],
            false,
        ),
        ([0x01, 0x00, 0xFE, 0x01, 0, 0], [1.0, NONE, 1.0, 0.0], false),
        ([0x01, 0x34, 0xFF, 0x01, 2, 2], [1.0, NONE, 1.0, NONE], true),
    ] {
        let (found, is_faulty) = decoded(true, Raw::Unsigned, 2, data);
        assert!(same(found, right), "{data:?} {found:?}");
        assert_eq!(is_faulty, fault, "{data:?}");
    }
    // A flag that tells an error of itself tells a fault.
    for (flag, raw, fault) in [
        (2, 2, true),
        (8, 0xFE, true),
        (8, 0xFF, false),
        (1, 1, true),
    ] {
        let (_, is_faulty) = decoded(true, Raw::Unsigned, flag, [1, 1, 1, 1, raw, 1]);
        assert_eq!(is_faulty, fault, "{flag} {raw:x}");
    }
    let all = [0xFF; 6];
    assert_eq!(decoded(true, Raw::Unsigned, 2, all), (None, false));
    let found = decoded(false, Raw::Unsigned, 2, all);
    assert_eq!(found, (Some([255.0, 65535.0, 15.0, 3.0]), true));
    assert_eq!(decoded(true, Raw::Signed, 2, all), (Some([-1.0; 4]), true));
}

#[test]
fn numbers_that_are_none_and_short_frames_are_counted() {
    let mut device = listener("dbc", DRIVE, &[0]);
    let nan = [f32::NAN.to_le_bytes(), 0.0_f32.to_le_bytes()].concat();
    let frames = [at(0x12, &nan, 0.0), at(0x12, &nan[..7], 1.0)];
    let (readings, faults) = decode(&mut *device, &frames);
    assert!(readings.is_empty());
    assert_eq!(count(&faults, Counter::Value), 1);
    assert_eq!(count(&faults, Counter::Length), 1);
}

/// It sends nothing, tells a silence, and goes on after it.
#[test]
fn silence_is_told_and_nothing_is_sent() {
    for mode in [Mode::Supervise, Mode::Listen] {
        let options = options("dbc", WRENCH);
        let mut device = options.device(&spec(0, mode, &[])).unwrap();
        assert_eq!(device.state(), State::Starting);
        let mut out = Decoded::new();
        let mut poll = |device: &mut dyn proprio_drivers::Device, ms: i64| {
            out.clear();
            assert_eq!(device.poll_transmit(Nanos::from_millis(ms), &mut out), None);
            count(&out.faults, Counter::Silences)
        };
        assert_eq!(poll(&mut *device, 0), 0);
        let (readings, _) = decode(&mut *device, &[half(false, 1, 0.0), half(true, 1, 0.1)]);
        assert_eq!((readings.len(), device.state()), (1, State::Streaming));
        assert_eq!(poll(&mut *device, 50), 0);
        assert_eq!(poll(&mut *device, 51), 1);
        assert_eq!(device.state(), State::Silent);
        // The count went on meanwhile: that is the silence, no loss to be counted again.
        let frames = [half(false, 9, 90.0), half(true, 9, 90.1)];
        let (readings, faults) = decode(&mut *device, &frames);
        assert_eq!((readings.len(), count(&faults, Counter::Lost)), (1, 0));
        assert!(readings[0].quality.contains(Quality::GAP_BEFORE));
        device.stop(Nanos::from_millis(100));
        poll(&mut *device, 101);
        assert_eq!(device.state(), State::Stopped);
        assert!(decode(&mut *device, &frames).0.is_empty());
    }
}

#[test]
fn a_message_of_two_readings_is_sent_once() {
    let mut board = board(
        "dbc",
        &DRIVE.replace("hold_ms = { torque = 100.0 }\n", "pair_timeout_ms = 3.0\n"),
        &[0],
    );
    let joint = Reading::Joint(JointState {
        position: 1.0,
        velocity: 2.0,
        torque: 0.5,
        ..JointState::ABSENT
    });
    let temperature = Reading::Temperature(Temperature { celsius: 20.0 });
    let first = encode(&mut *board, 0, &joint, Quality::GOOD);
    let second = encode(&mut *board, 1, &temperature, Quality::GOOD);
    let ids = |frames: &[Frame]| frames.iter().map(|frame| frame.id).collect::<Vec<_>>();
    assert_eq!(ids(&first), [Id::standard(0x12)]);
    assert_eq!(ids(&second), [Id::standard(0x13)]);
    assert_eq!(second[0].data(), [0, 20, 0xF4, 0x01, 0, 0, 0, 0]);
}

/// What is wrong with these keys, for a device at `address` that a file with `messages` describes.
fn problem(keys: &str, messages: Vec<Message>, address: u32) -> Option<String> {
    let mut options = options("dbc", keys);
    options.describe(messages);
    let joints: &[u8] = if keys.contains("joint") { &[0] } else { &[] };
    let made = options.device(&spec(address, Mode::Listen, joints));
    made.err().map(|problem| problem.to_string())
}

/// A reading has the stamp of the frame that opens it.
#[test]
fn the_stamp_is_that_of_the_first_frame() {
    let first = half(false, 7, 1.0).at(Nanos::from_millis(1), StampKind::Hardware);
    let (readings, _) = decode(
        &mut *listener("dbc", WRENCH, &[]),
        &[first, half(true, 7, 1.5)],
    );
    assert_eq!(readings[0].stamp, StampKind::Hardware);
    assert_eq!(readings[0].acquired, Nanos::from_millis(1));
}

/// Halves from before and after a restart are no reading, and the gap is told once something had
/// been read.
#[test]
fn a_restart_begins_anew() {
    for has_read in [false, true] {
        let mut device = listener("dbc", WRENCH, &[]);
        if has_read {
            let frames = [half(false, 1, 1.0), half(true, 1, 1.5), half(false, 2, 9.0)];
            assert_eq!(decode(&mut *device, &frames).0.len(), 1);
        }
        device.restart(Nanos::from_millis(9));
        let frames = [
            half(true, 2, 9.5),
            half(false, 3, 19.0),
            half(true, 3, 19.5),
        ];
        let (readings, faults) = decode(&mut *device, &frames);
        assert_eq!((numbers(&readings), faults.len()), (vec![(3, 3)], 0));
        let gap = readings[0].quality.contains(Quality::GAP_BEFORE);
        assert_eq!(gap, has_read);
    }
}

/// A simulated device sends the message that opens a reading first, whatever its identifier.
#[test]
fn a_simulated_device_sends_the_first_message_first() {
    let reading = Reading::Wrench(Wrench {
        force: [1.0; 3],
        torque: [2.0; 3],
    });
    let named = WRENCH.replace("counter = \"F.Count\"", "first = \"T\"");
    for (keys, ids) in [(WRENCH, [0x10, 0x11]), (named.as_str(), [0x11, 0x10])] {
        let keys = keys.replace("fault = \"State.Error\"\n", "");
        let mut board = board("dbc", &keys, &[]);
        let sent = encode(&mut *board, 0, &reading, Quality::GOOD);
        let sent: Vec<Id> = sent.iter().map(|frame| frame.id).collect();
        assert_eq!(sent, ids.map(Id::standard), "{keys}");
    }
}

/// Each value that a reading needs must be a number; a held one need not.
#[test]
fn what_is_no_number_is_not_sent() {
    let state = JointState {
        position: 1.0,
        velocity: 2.0,
        torque: f64::NAN,
        ..JointState::ABSENT
    };
    let encode = |state| {
        let mut out = Frames::new();
        let reading = Reading::Joint(state);
        board("dbc", DRIVE, &[0]).encode(0, &reading, Quality::GOOD, &mut out)
    };
    assert_eq!(encode(state), Ok(()));
    for (position, velocity) in [(f64::NAN, 2.0), (1.0, f64::NAN), (1.0, f64::INFINITY)] {
        let state = JointState {
            position,
            velocity,
            ..state
        };
        assert_eq!(encode(state), Err(EncodeError::NotFinite));
    }
}

/// As many readings as a frame has bytes, one joint in each; one more is refused.
#[test]
fn a_frame_has_as_many_readings_as_bytes() {
    let keys = |readings: usize| {
        let reading = |n: usize| {
            format!(
                "[[reading]]\nkind = \"skin\"\nname = \"f{n}\"\nfields = {{ p0 = \"Hand.S{}\" }}\n",
                n % 64
            )
        };
        let readings: String = (0..readings).map(reading).collect();
        format!("file = \"device.dbc\"\n{readings}")
    };
    let hand = Message {
        size: 64,
        signals: (0..64)
            .map(|n| signal(&format!("S{n}"), 8 * n, 8, Raw::Unsigned, 1.0, ""))
            .collect(),
        ..messages()[0].clone()
    };
    let device = |readings| {
        let mut options = options("dbc", &keys(readings));
        let name = "Hand".to_owned();
        options.describe(vec![Message {
            name,
            ..hand.clone()
        }]);
        options.device(&spec(0, Mode::Listen, &[]))
    };
    let bytes: Vec<u8> = (100..164).collect();
    let format = Format::Fd {
        bit_rate_switch: true,
        error_state: false,
    };
    let frame = |bytes| Frame::with_format(Id::standard(0x10), format, bytes).unwrap();
    let mut hand = device(64).unwrap();
    let (readings, faults) = decode(&mut *hand, &[frame(&bytes)]);
    assert!(faults.is_empty(), "{faults:?}");
    let values: Vec<(u8, u8)> = (readings.iter())
        .map(|stamped| (stamped.output, stamped.reading.values()[1] as u8))
        .collect();
    assert_eq!(values, (0..).zip(bytes.clone()).collect::<Vec<_>>());
    // All that are too far back in a short frame are one fault.
    let (readings, faults) = decode(&mut *hand, &[frame(&bytes[..48])]);
    assert_eq!((readings.len(), count(&faults, Counter::Length)), (48, 1));
    let problem = device(65).map(|_| ()).unwrap_err().to_string();
    assert!(
        problem.contains("65 readings have signals of frame 0x010, and a frame has at most 64")
    );
}

/// Without the key it is not known.
#[test]
fn the_period_is_that_of_the_keys_or_unknown() {
    assert!(!options("dbc", WRENCH).states_period());
    assert!(options("dbc", &format!("period_ms = 20\n{WRENCH}")).states_period());
    assert!(options("odrive", "").states_period());
}

proptest! {
    #[test]
    fn a_simulated_device_is_read_back(
        force in proptest::array::uniform3(-327.0_f64..327.0),
        torque in proptest::array::uniform3(-327.0_f64..327.0),
        faulty: bool,
    ) {
        let quality = if faulty { Quality::DEVICE_FAULT } else { Quality::GOOD };
        let mut board = board("dbc", WRENCH, &[]);
        let mut device = listener("dbc", WRENCH, &[]);
        let wrench = Reading::Wrench(Wrench { force, torque });
        // The fault is in a frame of its own, after those of the reading.
        let frames = [
            encode(&mut *board, 0, &wrench, quality),
            encode(&mut *board, 0, &wrench, quality),
        ]
        .concat();
        let (readings, faults) = decode(&mut *device, &frames);
        prop_assert_eq!(readings.len(), 2);
        prop_assert_eq!(readings[1].quality, quality | Quality::DEVICE_COUNTER);
        prop_assert_eq!(faults.len(), usize::from(faulty));
        let Reading::Wrench(back) = readings[0].reading else { panic!("{readings:?}") };
        for axis in 0..3 {
            prop_assert!((back.force[axis] - force[axis]).abs() <= 0.005 + 1e-9);
            prop_assert!((back.torque[axis] - torque[axis]).abs() <= 0.005 + 1e-9);
        }
    }
}
