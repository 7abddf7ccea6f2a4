//! RobStride motors and CyberGears: frames that other people's programs read, faults, what may be
//! sent, ends of ranges, and the MIT protocol.

use crate::rig::{
    Rig, actuator, asked, board, count, decode, encode, frame, is_saturated, joints, listener,
    near, options, refused, sends_nothing, sent, shown_keys, spec, takes_eight_bytes, temperatures,
    texts,
};
use proprio_drivers::State;
use proprio_drivers::{Claim, Device, EncodeError, Frame, Frames, Id, Mode, StampedReading};
use proprio_topics::{Counter, JointState, Nanos, Quality, Reading, Temperature};
use proptest::prelude::*;
use std::f64::consts::{PI, TAU};

/// Frames with their values, questions and answers, `tests/oracle/frames/rs.py`.
const FRAMES: &str = include_str!("robstride.txt");

const MODEL: &str = "model = \"RS03\"";
const ASKED: &str = "model = \"RS03\"\nrequest_period_ms = 5\ntorque_constant = 2.0";
const MIT: &str = "model = \"RS03\"\nprotocol = \"mit\"";

fn motor(keys: &str, address: u32, mode: Mode) -> Box<dyn Device> {
    options("robstride", keys)
        .device(&spec(address, mode, &[0]))
        .expect("a legal configuration")
}

/// Modes and faults.
fn actuators(readings: &[StampedReading]) -> Vec<(u32, u32)> {
    (readings.iter())
        .filter_map(|stamped| match stamped.reading {
            Reading::Actuator(actuator) => Some((actuator.mode, actuator.faults)),
            _ => None,
        })
        .collect()
}

fn still() -> (u8, Reading) {
    let state = JointState {
        position: 20.0,
        velocity: -1.5,
        torque: 2.0,
        current: 0.5,
        ..JointState::ABSENT
    };
    (0, Reading::Joint(state))
}

#[test]
fn frames_are_read_as_other_programs_read_them() {
    let (mut states, mut questions) = (0, 0);
    for line in FRAMES.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        let number = |word: &str| word.parse::<f64>().unwrap();
        let address = |text: &str| u32::from_str_radix(&text[4..6], 16).unwrap();
        match words[..] {
            ["read", parameter, question, answer, value] => {
                let mut device = motor(ASKED, address(answer), Mode::Supervise);
                let sent = sent(&mut *device, 1000, 10);
                assert!(sent.iter().any(|sent| sent == question), "{line}: {sent:?}");
                let id = &answer[..8];
                let position = format!("{id}#1970000000000000");
                let frames = [frame(answer, 1010.0), frame(&position, 1011.0)];
                let (readings, faults) = decode(&mut *device, &frames);
                assert!(faults.is_empty());
                let read = joints(&readings);
                let (first, last) = (read[0].0, read[read.len() - 1].0);
                let value = number(value);
                match parameter {
                    "701B" => assert_eq!(last.velocity, value),
                    "701A" => assert_eq!((last.current, last.torque), (value, 2.0 * value)),
                    _ => assert_eq!(first.position, value),
                }
                questions += 1;
            }
            [
                model,
                text,
                position,
                velocity,
                torque,
                celsius,
                mode,
                faults,
            ] => {
                let mut keys = format!("model = {model:?}");
                if model == "CyberGear" {
                    keys += "\nposition_max = 12.5";
                }
                let mut device = motor(&keys, address(text), Mode::Listen);
                let (readings, counted) = decode(&mut *device, &[frame(text, 0.0)]);
                let (joint, quality) = joints(&readings)[0];
                assert!(near(joint.position, number(position)), "{line}");
                assert!(near(joint.velocity, number(velocity)), "{line}");
                assert!(near(joint.torque, number(torque)), "{line}");
                assert!(joint.current.is_nan() && joint.acceleration.is_nan());
                let faults: u32 = faults.parse().unwrap();
                assert_eq!(
                    actuators(&readings),
                    [(mode.parse().unwrap(), faults << 24)],
                    "{line}"
                );
                assert!(
                    near(temperatures(&readings)[0].1, number(celsius)),
                    "{line}"
                );
                // 8: magnetic encoder, 32: not calibrated; 16: Hall encoder of a CyberGear.
                let encoder = if model == "CyberGear" { 0x38 } else { 0x28 };
                let expected = [faults & encoder != 0, faults & !encoder != 0];
                let flags = [Quality::DEVICE_FAULT, Quality::DRIVE_FAULT];
                assert_eq!(flags.map(|flag| quality.contains(flag)), expected, "{line}");
                let counters = [Counter::DeviceFault, Counter::DriveFault];
                assert_eq!(counters.map(|c| count(&counted, c) == 1), expected);
                states += 1;
            }
            _ => panic!("{line}"),
        }
    }
    assert_eq!((states, questions), (12, 6));
}

/// The table of the page; upper ends of the ranges in both protocols.
#[test]
fn models_have_the_numbers_of_the_page() {
    let page = include_str!("../../../docs/book/src/devices/robstride.md");
    let is_row = |line: &&str| {
        ["| RS", "| EL", "| Cyb"]
            .iter()
            .any(|s| line.starts_with(s))
    };
    let mut models = 0;
    for row in page.lines().filter(is_row) {
        let row = row.trim_start_matches("| ").trim_end_matches(" |");
        let cells: Vec<&str> = row.split(" | ").collect();
        let numbers: Vec<f64> = (cells[1].split(", "))
            .chain([cells[2]])
            .map(|number| number.parse().unwrap())
            .collect();
        for (protocol, text, velocity) in [
            ("private", "028001FD#FFFFFFFFFFFF0000", numbers[0]),
            ("mit", "0FD#01FFFFFFFFFF0100", numbers[1]),
        ] {
            let keys = format!("model = {:?}\nprotocol = {protocol:?}", cells[0]);
            let (readings, _) = decode(&mut *motor(&keys, 1, Mode::Listen), &[frame(text, 0.0)]);
            let (joint, _) = joints(&readings)[0];
            assert!(near(joint.position, 4.0 * PI), "{row}");
            assert!(
                near(joint.velocity, velocity) && near(joint.torque, numbers[2]),
                "{row}"
            );
        }
        models += 1;
    }
    assert_eq!(models, 9);
}

/// As the manual has them in section 4.1: feedback, active report, and a frame about faults.
#[test]
fn faults_hold_until_they_are_over() {
    let mut device = motor(MODEL, 1, Mode::Listen);
    let state = |upper: u8, kind: u8, ms| {
        let text = format!("{kind:02X}{upper:02X}01FD#8000800080000140");
        frame(&text, ms)
    };
    let mut read = |frame: Frame| {
        let (readings, _) = decode(&mut *device, &[frame]);
        (
            actuators(&readings),
            joints(&readings).first().map(|(_, quality)| *quality),
        )
    };
    let (good, sensor, drive) = (Quality::GOOD, Quality::DEVICE_FAULT, Quality::DRIVE_FAULT);
    assert_eq!(read(state(0x80, 0x02, 0.0)), (vec![(2, 0)], Some(good)));
    assert_eq!(read(state(0x80, 0x18, 1.0)), (vec![], Some(good)));
    // Encoder not calibrated, driver chip; a warning alone is none.
    let fault = frame("150001FD#8200000000000000", 2.0);
    assert_eq!(read(fault), (vec![(2, 0x82)], None));
    assert_eq!(
        read(state(0x00, 0x02, 3.0)),
        (vec![(0, 0x82)], Some(sensor | drive))
    );
    assert_eq!(
        read(state(0x84, 0x02, 4.0)),
        (vec![(2, 0x0400_0082)], Some(sensor | drive))
    );
    assert_eq!(read(state(0x80, 0x02, 5.0)), (vec![(2, 0)], Some(good)));
    let position = frame("150001FD#0002000000000000", 6.0);
    assert_eq!(read(position), (vec![(2, 0x200)], None));
    assert_eq!(read(state(0x00, 0x02, 7.0)).1, Some(sensor));
    let over = frame("150001FD#0000000001000000", 8.0);
    assert_eq!(read(over), (vec![(0, 0)], None));
    assert_eq!(read(state(0x00, 0x02, 9.0)).1, Some(good));
    // Once a second.
    assert_eq!(read(state(0x00, 0x02, 1008.0)).0, []);
    assert_eq!(read(state(0x00, 0x02, 1009.0)).0, [(0, 0)]);
    // After a start nothing is known.
    read(frame("150001FD#8200000000000000", 1010.0));
    device.restart(Nanos::from_millis(1011));
    let (readings, _) = decode(&mut *device, &[state(0x00, 0x02, 1012.0)]);
    assert_eq!(joints(&readings)[0].1, Quality::GAP_BEFORE);
    // Bits 8 to 15 of a CyberGear are its overload.
    let mut gear = motor("model = \"CyberGear\"", 1, Mode::Listen);
    let frames = [
        frame("150001FD#0002000000000000", 0.0),
        state(0x00, 0x02, 1.0),
    ];
    assert_eq!(joints(&decode(&mut *gear, &frames).0)[0].1, drive);
}

#[test]
fn a_value_at_an_end_of_its_range_is_saturated() {
    for (text, saturated) in [
        ("028001FD#8000800080000140", false),
        ("028001FD#0001800080000140", false),
        ("028001FD#0000800080000140", true),
        ("028001FD#FFFE800080000140", false),
        ("028001FD#FFFF800080000140", true),
        ("028001FD#8000000080000140", true),
        ("028001FD#8000FFFF80000140", true),
        ("028001FD#8000800000000140", true),
        ("028001FD#80008000FFFF0140", true),
    ] {
        let mut device = motor(MODEL, 1, Mode::Listen);
        assert_eq!(is_saturated(&mut *device, text), saturated, "{text}");
    }
}

/// Every frame that the driver can send: it reads three parameters of its motor.
#[test]
fn no_command_is_ever_sent() {
    let legal = [
        "1100FD01#1B70000000000000",
        "1100FD01#1A70000000000000",
        "1100FD01#1970000000000000",
    ];
    let mut rig = Rig::new("robstride", ASKED, &[0], still());
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(rig.sent[..3], legal);
    let read = joints(&rig.readings);
    assert_eq!(read.len(), 20);
    // Beyond four turns, which an answer counts.
    assert_eq!(read[0].0.position, 20.0);
    assert_eq!((read[0].0.velocity, read[0].0.current), (-1.5, 0.5));
    assert_eq!(read[0].0.torque, 1.0);
    rig.disturb();
    for text in &rig.sent {
        assert!(legal.contains(&text.as_str()), "{text}");
    }
    for (keys, mode) in [
        (MODEL, Mode::Supervise),
        (MIT, Mode::Supervise),
        (ASKED, Mode::Listen),
    ] {
        let mut device = motor(keys, 1, mode);
        sends_nothing(&mut *device);
    }
}

/// Where parameters are asked for, positions are theirs alone.
#[test]
fn answers_and_states_are_not_mixed() {
    let state = frame("029001FD#8000800080000140", 0.0);
    let answer = |parameter: &str, value: f32, ms| {
        let value: String = value
            .to_le_bytes()
            .iter()
            .map(|b| format!("{b:02X}"))
            .collect();
        frame(&format!("110001FD#{parameter}0000{value}"), ms)
    };
    let mut device = motor(ASKED, 1, Mode::Listen);
    let (readings, _) = decode(&mut *device, &[state]);
    assert!(joints(&readings).is_empty());
    assert_eq!(actuators(&readings), [(2, 0x1000_0000)]);
    assert_eq!(temperatures(&readings), [(1, 32.0)]);
    let frames = [
        answer("1B70", 3.0, 1.0),
        answer("1A70", 4.0, 1.1),
        answer("1970", 5.0, 1.2),
        answer("1970", 6.0, 6.05),
        answer("1970", 7.0, 8.0),
    ];
    let (readings, _) = decode(&mut *device, &frames);
    let read = joints(&readings);
    assert_eq!(read[0].1, Quality::DRIVE_FAULT);
    let values = |at: usize| (read[at].0.position, read[at].0.velocity, read[at].0.current);
    assert_eq!(values(0), (5.0, 3.0, 4.0));
    // A velocity of the round before is none of this one: it is older than a period.
    let (position, velocity, current) = values(1);
    assert_eq!((position, current), (6.0, 4.0));
    assert!(velocity.is_nan());
    assert!(values(2).1.is_nan() && values(2).2.is_nan());
    // What is no number, cannot be read, or is another parameter.
    let (readings, faults) = decode(
        &mut *device,
        &[
            answer("1970", f32::NAN, 9.0),
            frame("110101FD#1970000000000000", 9.1),
            frame("110101FD#1C70000000000000", 9.2),
            answer("1C70", 24.0, 9.3),
        ],
    );
    assert!(joints(&readings).is_empty());
    assert_eq!(count(&faults, Counter::Value), 2);
    // Another program's questions are none of a device that asks nothing.
    let mut device = motor(MODEL, 1, Mode::Listen);
    let (readings, faults) = decode(&mut *device, &[answer("1970", 5.0, 0.0)]);
    assert!(readings.is_empty() && faults.is_empty());
}

#[test]
fn the_mit_protocol_has_its_own_frames() {
    let mut device = motor(MIT, 2, Mode::Listen);
    assert_eq!(device.claims(), [Claim::shared(Id::standard(0xFD))]);
    let frames = [
        frame("0FD#02FFFE7FF7FF0140", 0.0),
        frame("0FD#01FFFE7FF7FF0140", 0.1),
        frame("001#02FFFE7FF7FF0140", 0.2),
        frame("0FD#0280000000000000", 1.0),
        frame("0FD#02FFFE7FF7FF0140", 2.0),
        frame("0FD#0200000000000000", 3.0),
        frame("0FD#02FFFE7FF7FF0140", 4.0),
    ];
    let (readings, _) = decode(&mut *device, &frames);
    let read = joints(&readings);
    assert_eq!(read.len(), 3);
    let step = 8.0 * PI / 65535.0;
    assert!(near(read[0].0.position, 4.0 * PI - step));
    assert!(read[0].0.velocity.abs() < 0.01 && read[0].0.torque.abs() < 0.02);
    let qualities: Vec<Quality> = read.iter().map(|(_, quality)| *quality).collect();
    assert_eq!(
        qualities,
        [Quality::GOOD, Quality::DEVICE_FAULT, Quality::GOOD]
    );
    assert_eq!(actuators(&readings), [(0, 0), (0, 0x80), (0, 0)]);
    assert_eq!(temperatures(&readings), [(1, 32.0)]);
}

#[test]
fn frames_that_are_none_of_the_protocol_are_counted() {
    let private = [0x0280_01FD, 0x1100_01FD, 0x1500_01FD, 0x1800_01FD].map(Id::extended);
    let cases = private.map(|id| (MODEL, id)).into_iter();
    for (keys, id) in cases.chain([(MIT, Id::standard(0xFD))]) {
        let mut device = motor(keys, 1, Mode::Listen);
        takes_eight_bytes(&mut *device, id, 1);
    }
    // Commands, other motors, other hosts.
    let mut device = motor(MODEL, 1, Mode::Listen);
    let others = [
        Id::extended(0x0100_0001),
        Id::extended(0x0300_FD01),
        Id::extended(0x0280_02FD),
        Id::extended(0x0280_01FE),
        Id::extended(0x0000_01FE),
        Id::standard(0xFD),
    ];
    for other in others {
        let (readings, faults) = decode(&mut *device, &[Frame::new(other, &[1; 8])]);
        assert!(readings.is_empty() && faults.is_empty(), "{other}");
        assert!(!device.claims().iter().any(|claim| claim.matches(other)));
    }
    assert!(device.claims()[0].matches(Id::extended(0x02BF_01FD)));
}

#[test]
fn the_keys_of_the_page_are_legal() {
    let keys = shown_keys(include_str!("../../../docs/book/src/devices/robstride.md"));
    assert!(keys.contains("torque_constant"));
    let mut rig = Rig::new("robstride", keys, &[0], still());
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
}

#[test]
fn wrong_keys_are_refused() {
    let refused = |keys: &str, address| refused("robstride", keys, address);
    for address in [0, 254] {
        assert_eq!(refused(MODEL, address), "1 to 253");
    }
    for (keys, key) in [("", "velocity_max"), ("velocity_max = 20.0", "torque_max")] {
        assert_eq!(refused(keys, 1), key);
    }
    for (keys, key) in [
        ("host_id = 1", "host_id"),
        ("position_max = 0.0", "position_max"),
        ("velocity_max = nan", "velocity_max"),
        ("torque_max = -1.0", "torque_max"),
        ("torque_constant = 0.0", "torque_constant"),
        ("request_period_ms = 0", "request_period_ms"),
        (
            "request_period_ms = 10\nprotocol = \"mit\"",
            "request_period_ms",
        ),
        ("period_ms = 60001", "period_ms"),
    ] {
        assert_eq!(refused(&format!("{MODEL}\n{keys}"), 1), key);
    }
    motor("velocity_max = 20.0\ntorque_max = 1.0", 252, Mode::Listen);
}

#[test]
fn a_simulated_motor_sends_what_it_is_given() {
    let reading = |position, velocity, torque| {
        Reading::Joint(JointState {
            position,
            velocity,
            torque,
            ..JointState::ABSENT
        })
    };
    let (good, absent) = (Quality::GOOD, f64::NAN);
    let both = Quality::DRIVE_FAULT | Quality::DEVICE_FAULT;
    let temperature = |celsius| Reading::Temperature(Temperature { celsius });
    let mut motor = board("robstride", MODEL, &[0]);
    let mut send =
        |output, reading: &Reading, quality| texts(&encode(&mut *motor, output, reading, quality));
    let high = reading(99.0, 99.0, 99.0);
    assert_eq!(send(0, &high, good), ["028001FD#FFFFFFFFFFFF00FA"]);
    let low = reading(-99.0, -99.0, -99.0);
    assert_eq!(
        send(0, &low, Quality::DRIVE_FAULT),
        ["028401FD#00000000000000FA"]
    );
    assert_eq!(send(0, &low, both), ["028C01FD#00000000000000FA"]);
    // A fault of that kind stays as it was told.
    let report = ["150001FD#0001000000000000"];
    assert_eq!(send(0, &actuator(1, 0x0100_0100), good), report);
    assert_eq!(
        send(0, &low, Quality::DRIVE_FAULT),
        ["024101FD#00000000000000FA"]
    );
    let over = ["150001FD#0000000000000000", "024001FD#00000000000000FA"];
    assert_eq!(send(0, &low, good), over);
    assert_eq!(send(1, &temperature(-5.0), good), [""; 0]);
    assert_eq!(
        send(0, &reading(0.0, 0.0, absent), good),
        ["024001FD#8000800080000000"]
    );
    let mut out = Frames::new();
    for (output, reading, error) in [
        (0, reading(absent, 0.0, 0.0), EncodeError::NotFinite),
        (0, reading(0.0, absent, 0.0), EncodeError::NotFinite),
        (0, reading(0.0, 0.0, f64::INFINITY), EncodeError::NotFinite),
        (1, temperature(absent), EncodeError::NotFinite),
        (1, high, EncodeError::Kind),
        (0, temperature(1.0), EncodeError::Kind),
        (2, high, EncodeError::Output(2)),
    ] {
        assert_eq!(motor.encode(output, &reading, good, &mut out), Err(error));
    }
    assert_eq!(
        asked(&mut *motor, "0000FD01#0000000000000000"),
        ["000001FE#363130140B333331"]
    );
    assert_eq!(
        asked(&mut *motor, "1100AA01#1A70000000000000"),
        ["110001AA#1A70000000000000"]
    );
    assert_eq!(
        asked(&mut *motor, "1100AA01#0570000000000000"),
        ["110101AA#0570000000000000"]
    );
    for none in [
        "1100AA02#1A70000000000000",
        "1101AA01#1A70000000000000",
        "1100AA01#1A70",
        "0300FD01#0000000000000000",
        "001#1A70000000000000",
    ] {
        assert_eq!(asked(&mut *motor, none), [""; 0], "{none}");
    }
    let mut mit = board("robstride", MIT, &[0]);
    let mut send = |reading: &Reading, quality| texts(&encode(&mut *mit, 0, reading, quality));
    assert_eq!(send(&high, good), ["0FD#01FFFFFFFFFF00FA"]);
    assert_eq!(
        send(&high, both),
        ["0FD#0181000000000000", "0FD#01FFFFFFFFFF00FA"]
    );
    assert_eq!(
        send(&low, good),
        ["0FD#0100000000000000", "0FD#01000000000000FA"]
    );
    assert_eq!(asked(&mut *mit, "0000FD01#0000000000000000"), [""; 0]);
}

proptest! {
    #[test]
    fn readings_come_back(
        p in -12.5_f64..12.5, v in -19.9_f64..19.9, t in -59.9_f64..59.9, fault in 0_u8..3,
    ) {
        let quality = [Quality::GOOD, Quality::DEVICE_FAULT, Quality::DRIVE_FAULT]
            [usize::from(fault)];
        let state = JointState { position: p, velocity: v, torque: t, ..JointState::ABSENT };
        for (keys, most, velocity) in [(MODEL, 65535.0, 20.0), (MIT, 4095.0, 33.0)] {
            let mut board = board("robstride", keys, &[0]);
            let frames = encode(&mut *board, 0, &Reading::Joint(state), quality);
            let (readings, _) = decode(&mut *listener("robstride", keys, &[0]), &frames);
            let (back, read) = joints(&readings)[0];
            prop_assert_eq!(read, quality);
            for (a, b, step) in [
                (back.position, p, 4.0 * TAU / 65535.0),
                (back.velocity, v, 2.0 * velocity / most),
                (back.torque, t, 120.0 / most),
            ] {
                prop_assert!((a - b).abs() <= step * 0.5 + 1e-9);
            }
        }
    }
}
