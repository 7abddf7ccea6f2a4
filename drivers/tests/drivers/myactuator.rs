//! MyActuator and LKMTech motors: frames that other people's programs read, in both protocols, what
//! may be sent, commands that are no answers, ends of ranges, and errors.

use crate::rig::{
    Rig, actuator, asked, board, count, decode, encode, frame, is_saturated, joints, listener,
    options, refused, sends_nothing, shown_keys, spec, takes_eight_bytes, temperatures, texts,
};
use proprio_drivers::State;
use proprio_drivers::{Claim, Device, EncodeError, Frames, Id, Mode, StampedReading};
use proprio_topics::{Counter, JointState, Nanos, Quality, Reading, Temperature};
use proptest::prelude::*;
use std::f64::consts::TAU;

/// Answers of motor 1 in V3, arbitrary ones, and what `responses.hpp` and `responses.cpp` of
/// 2b-t/myactuator_rmd c43980ca and `motion_control_response.hpp` of
/// yukunlin1124/myactuator_rmd_v4.3 564d3cda read from them when they are run: `state` temperature,
/// current \[A\], speed \[deg/s\], angle \[deg\]; `angle` \[deg\]; `errors`; `motion` position,
/// velocity, torque.
const V3: &str = include_str!("myactuator.txt");
/// Questions and answers in V2, `tests/oracle/frames/lk.py`.
const V2: &str = include_str!("myactuator_v2.txt");

const STATUS: &str = "position = \"status\"\ntorque_constant = 2.0";
const MOTION: &str = "position = \"motion\"";
const OLD: &str = "protocol = \"v2\"";
const OLD_STATUS: &str = "protocol = \"v2\"\nposition = \"status\"\nampere_per_step = 0.5";

fn motor(keys: &str, address: u32, mode: Mode) -> Box<dyn Device> {
    options("myactuator", keys)
        .device(&spec(address, mode, &[0]))
        .expect("a legal configuration")
}

fn faults(readings: &[StampedReading]) -> Vec<u32> {
    (readings.iter())
        .filter_map(|stamped| match stamped.reading {
            Reading::Actuator(actuator) => Some(actuator.faults),
            _ => None,
        })
        .collect()
}

/// The other programs compute in single precision.
fn near(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-6 * b.abs().max(1.0)
}

fn still() -> (u8, Reading) {
    let state = JointState {
        position: 20.0,
        velocity: -1.5,
        current: 0.5,
        ..JointState::ABSENT
    };
    (0, Reading::Joint(state))
}

#[test]
fn answers_are_read_as_other_programs_read_them() {
    let mut seen = 0;
    for line in V3.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        let numbers: Vec<f64> = words[2..]
            .iter()
            .map(|word| word.parse().unwrap())
            .collect();
        let keys = match words[0] {
            "motion" => MOTION,
            "angle" => "",
            _ => STATUS,
        };
        let mut device = motor(keys, 1, Mode::Listen);
        let (readings, counted) = decode(&mut *device, &[frame(words[1], 0.0)]);
        match (words[0], &numbers[..]) {
            ("state", &[celsius, current, speed, angle]) => {
                let (joint, _) = joints(&readings)[0];
                assert!(near(joint.position, angle.to_radians()), "{line}");
                assert!(near(joint.velocity, speed.to_radians()), "{line}");
                assert!(near(joint.current, current), "{line}");
                assert_eq!(joint.torque, 2.0 * joint.current);
                assert_eq!(temperatures(&readings), [(1, celsius)], "{line}");
            }
            ("angle", &[angle]) => {
                let (joint, _) = joints(&readings)[0];
                assert!(near(joint.position, angle.to_radians()), "{line}");
                assert!(joint.velocity.is_nan() && joint.current.is_nan());
            }
            ("errors", &[error]) => {
                assert_eq!(faults(&readings), [error as u32], "{line}");
                let expected = match error as u32 {
                    0 => Quality::GOOD,
                    0x2000 => Quality::DEVICE_FAULT,
                    _ => Quality::DRIVE_FAULT,
                };
                let state = frame("241#9C20000000000000", 1.0);
                let (readings, _) = decode(&mut *device, &[state]);
                assert_eq!(joints(&readings)[0].1, expected, "{line}");
            }
            ("motion", &[position, velocity, torque]) => {
                let (joint, _) = joints(&readings)[0];
                assert!(near(joint.position, position), "{line}");
                assert!(
                    near(joint.velocity, velocity) && near(joint.torque, torque),
                    "{line}"
                );
            }
            _ => panic!("{line}"),
        }
        assert!(counted.is_empty(), "{line}: {counted:?}");
        seen += 1;
    }
    assert_eq!(seen, 23);
}

#[test]
fn answers_of_the_older_protocol_are_read_as_other_programs_read_them() {
    let mut seen = 0;
    for line in V2.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        let numbers: Vec<f64> = words[2..]
            .iter()
            .map(|word| word.parse().unwrap())
            .collect();
        let keys = match numbers.len() {
            4 => format!("{OLD_STATUS}\ngear_ratio = 6.0\nencoder_bits = 15"),
            _ => format!("{OLD}\ngear_ratio = 6.0"),
        };
        // A question is no answer.
        let mut device = motor(&keys, 3, Mode::Listen);
        let (readings, counted) = decode(&mut *device, &[frame(words[0], 0.0)]);
        assert!(readings.is_empty() && counted.is_empty(), "{line}");
        let (readings, counted) = decode(&mut *device, &[frame(words[1], 1.0)]);
        match numbers[..] {
            [celsius, current, speed, encoder] => {
                let (joint, _) = joints(&readings)[0];
                let position = encoder / 32768.0 * TAU / 6.0;
                assert!(near(joint.position, position), "{line}");
                assert!(near(joint.velocity, speed.to_radians() / 6.0), "{line}");
                assert_eq!(joint.current, current * 0.5, "{line}");
                assert_eq!(temperatures(&readings), [(1, celsius)]);
            }
            [error] if words[1].starts_with("143#9A") => {
                assert_eq!(faults(&readings), [error as u32], "{line}");
            }
            [angle] => {
                let (joint, _) = joints(&readings)[0];
                let position = (angle * 0.01).to_radians() / 6.0;
                assert!(
                    (joint.position - position).abs() <= 1e-9 * position.abs(),
                    "{line}"
                );
            }
            _ => panic!("{line}"),
        }
        assert!(counted.is_empty(), "{line}");
        seen += 1;
    }
    assert_eq!(seen, 17);
}

/// The vectors of 2b-t's `responses_test.cpp`.
#[test]
fn test_vectors_of_another_program_are_read() {
    let read = |keys: &str, text: &str| {
        let (readings, _) = decode(&mut *motor(keys, 1, Mode::Listen), &[frame(text, 0.0)]);
        joints(&readings)[0].0
    };
    let forward = read(STATUS, "241#9C326400F4012D00");
    let values = [forward.current, forward.velocity, forward.position];
    let expected = [1.0, 500_f64.to_radians(), 45_f64.to_radians()];
    assert!(
        values.iter().zip(expected).all(|(a, b)| near(*a, b)),
        "{values:?}"
    );
    let back = read(STATUS, "241#A2329CFF0CFED3FF");
    let values = [back.current, back.velocity, back.position];
    assert!(
        values.iter().zip(expected).all(|(a, b)| near(*a, -b)),
        "{values:?}"
    );
    assert!(near(read("", "241#92000000A08C0000").position, TAU));
}

#[test]
fn speed_and_current_join_the_angles_for_a_while() {
    let state = frame("241#9C20640064000000", 10.0);
    let angle = |ms| frame("241#92000000A08C0000", ms);
    for (ms, joined) in [(40.0, true), (40.5, false)] {
        let mut device = motor("hold_ms = 30\ntorque_constant = 3.0", 1, Mode::Listen);
        let (readings, _) = decode(&mut *device, &[state, angle(ms)]);
        let read = joints(&readings);
        assert_eq!(read.len(), 1);
        let (joint, _) = read[0];
        assert_eq!(joint.current == 1.0 && joint.torque == 3.0, joined);
        assert_eq!(joint.velocity.is_nan(), !joined);
    }
    let mut device = motor("", 1, Mode::Listen);
    decode(&mut *device, &[state, frame("241#9A20000000000200", 11.0)]);
    device.restart(Nanos::from_millis(20));
    let (readings, _) = decode(&mut *device, &[angle(21.0)]);
    let (joint, quality) = joints(&readings)[0];
    assert!(joint.velocity.is_nan() && quality == Quality::GOOD);
    // The temperature once a second, errors when they change.
    let at = |ms| frame("241#9C20640064000000", ms);
    let error = |ms| frame("241#9A20000000000200", ms);
    let frames = [
        at(0.0),
        at(1.0),
        at(1000.0),
        at(1001.0),
        error(1002.0),
        error(1003.0),
    ];
    let (readings, _) = decode(&mut *motor("", 1, Mode::Listen), &frames);
    assert_eq!(temperatures(&readings), [(1, 32.0); 2]);
    assert_eq!(faults(&readings), [2]);
}

/// Every frame that the driver can send: three questions.
#[test]
fn no_command_is_ever_sent() {
    let questions = |round: &[&str]| -> Vec<String> {
        round
            .iter()
            .map(|command| format!("141#{command}00000000000000"))
            .collect()
    };
    for (keys, round) in [
        ("", &["9A", "9C", "92"][..]),
        (STATUS, &["9A", "9C"]),
        (OLD, &["9A", "9C", "92"]),
    ] {
        let legal = questions(round);
        let keys = format!("{keys}\nrequest_period_ms = 5");
        let mut rig = Rig::new("myactuator", &keys, &[0], still());
        rig.run(1000);
        assert_eq!(rig.device.state(), State::Streaming, "{keys}");
        assert_eq!(rig.sent[..round.len()], legal);
        let errors = rig.sent.iter().filter(|text| text.contains("#9A")).count();
        assert_eq!((joints(&rig.readings).len(), errors), (200, 1), "{keys}");
        let (joint, _) = joints(&rig.readings)[1];
        let coarse = if round.len() == 2 { 0.01 } else { 1e-4 };
        assert!((joint.position - 20.0).abs() < coarse, "{joint:?}");
        assert!((joint.velocity + 1.5).abs() < 0.02, "{joint:?}");
        rig.disturb();
        for text in &rig.sent {
            assert!(legal.contains(text), "{text}");
        }
        let mut device = motor(&keys, 1, Mode::Listen);
        sends_nothing(&mut *device);
    }
    for keys in ["", MOTION, OLD_STATUS] {
        let mut device = motor(keys, 1, Mode::Supervise);
        sends_nothing(&mut *device);
    }
}

/// Errors are asked for once a second, however rare the other questions are.
#[test]
fn errors_are_asked_for_by_themselves() {
    let mut rig = Rig::new("myactuator", "request_period_ms = 5000", &[0], still());
    rig.run(2500);
    let commands: Vec<&str> = rig.sent.iter().map(|text| &text[4..6]).collect();
    assert_eq!(commands, ["9A", "9C", "92", "9A", "9A"]);
}

/// In V2 commands have the identifier of the answers.
#[test]
fn commands_are_no_answers() {
    let commands = [
        "141#A100000064000000",
        "141#A200000028230000",
        "141#A4002C01A08C0000",
        "141#A6010000A08C0000",
        "141#8800000000000000",
        "141#9C00000000000000",
        "141#9A00000000000000",
    ];
    for keys in [OLD, OLD_STATUS] {
        for text in commands {
            let (readings, counted) =
                decode(&mut *motor(keys, 1, Mode::Listen), &[frame(text, 0.0)]);
            assert!(readings.is_empty() && counted.is_empty(), "{text}");
        }
    }
    let answer = frame("141#A102000064000000", 0.0);
    let (readings, _) = decode(&mut *motor(OLD_STATUS, 1, Mode::Listen), &[answer]);
    assert_eq!(joints(&readings).len(), 1);
    // An angle of 0 is an answer to a device that asks itself.
    let zero = frame("141#9200000000000000", 0.0);
    let keys = format!("{OLD}\nrequest_period_ms = 5");
    for (mode, number) in [(Mode::Supervise, 1), (Mode::Listen, 0)] {
        let (readings, _) = decode(&mut *motor(&keys, 1, mode), &[zero]);
        assert_eq!(joints(&readings).len(), number);
    }
    let (readings, _) = decode(
        &mut *motor("", 1, Mode::Listen),
        &[frame("241#9200000000000000", 0.0)],
    );
    assert_eq!(joints(&readings)[0].0.position, 0.0);
}

#[test]
fn a_value_at_an_end_of_its_range_is_saturated() {
    for (keys, text, saturated) in [
        (STATUS, "241#9C20FF7EFF7EFF7E", false),
        (STATUS, "241#9C20FF7F00000000", true),
        (STATUS, "241#9C20008000000000", true),
        (STATUS, "241#9C200000FF7F0000", true),
        (STATUS, "241#9C2000000000FF7F", true),
        (STATUS, "241#9C20000000000080", true),
        (OLD_STATUS, "141#9C2000000000FFFF", false),
        (OLD_STATUS, "141#9C2000000000FF7F", false),
        (OLD_STATUS, "141#9C20FF7F00000000", true),
        (MOTION, "501#0180008008000000", false),
        (MOTION, "501#0100008008000000", true),
        (MOTION, "501#01FFFF8008000000", true),
        (MOTION, "501#0180000008000000", true),
        (MOTION, "501#018000800FFF0000", true),
    ] {
        let mut device = motor(keys, 1, Mode::Listen);
        assert_eq!(is_saturated(&mut *device, text), saturated, "{text}");
    }
}

#[test]
fn frames_that_are_none_of_the_protocol_are_counted() {
    for (keys, id) in [("", 0x241), (OLD, 0x141), (MOTION, 0x501), (MOTION, 0x241)] {
        let mut device = motor(keys, 1, Mode::Listen);
        let id = Id::standard(id);
        takes_eight_bytes(&mut *device, id, 0x92);
    }
    // Other answers, commands, other motors; the motion mode of another ID.
    for text in [
        "241#B200000034890134",
        "241#3055195519551955",
        "141#A100000064000000",
        "242#92000000A08C0000",
        "501#0180008008000000",
        "00000241#92000000A08C0000",
    ] {
        let (readings, counted) = decode(&mut *motor("", 1, Mode::Listen), &[frame(text, 0.0)]);
        assert!(readings.is_empty() && counted.is_empty(), "{text}");
    }
    let (readings, counted) = decode(
        &mut *motor(MOTION, 1, Mode::Listen),
        &[frame("501#0280008008000000", 0.0)],
    );
    assert_eq!((readings.len(), count(&counted, Counter::Value)), (0, 1));
    let (readings, _) = decode(
        &mut *motor(MOTION, 1, Mode::Listen),
        &[frame("241#92000000A08C0000", 0.0)],
    );
    assert!(readings.is_empty());
    let claims = |keys: &str| motor(keys, 32, Mode::Listen).claims().to_vec();
    let exclusive = |id| Claim::exclusive(Id::standard(id));
    assert_eq!(claims(""), [exclusive(0x260)]);
    assert_eq!(claims(OLD), [exclusive(0x160)]);
    assert_eq!(claims(MOTION), [exclusive(0x520), exclusive(0x260)]);
}

#[test]
fn the_keys_of_the_page_are_legal() {
    let keys = shown_keys(include_str!("../../../docs/book/src/devices/myactuator.md"));
    assert!(keys.contains("encoder_bits"));
    let mut rig = Rig::new("myactuator", keys, &[0], still());
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
}

#[test]
fn wrong_keys_are_refused() {
    let refused = |keys: &str, address| refused("myactuator", keys, address);
    for address in [0, 33] {
        assert_eq!(refused("", address), "1 to 32");
    }
    for (keys, key) in [
        ("protocol = \"v2\"\nposition = \"motion\"", "position"),
        (
            "position = \"motion\"\nrequest_period_ms = 5",
            "request_period_ms",
        ),
        ("request_period_ms = 0", "request_period_ms"),
        ("gear_ratio = 0.0", "gear_ratio"),
        ("encoder_bits = 11", "encoder_bits"),
        ("encoder_bits = 17", "encoder_bits"),
        ("ampere_per_step = -1.0", "ampere_per_step"),
        ("torque_constant = nan", "torque_constant"),
        ("position_max = 0.0", "position_max"),
        ("velocity_max = inf", "velocity_max"),
        ("torque_max = 0.0", "torque_max"),
        ("hold_ms = 0", "hold_ms"),
        ("period_ms = 60001", "period_ms"),
    ] {
        assert_eq!(refused(keys, 1), key, "{keys}");
    }
    motor("encoder_bits = 12", 32, Mode::Listen);
}

#[test]
fn a_simulated_motor_answers_as_real_ones_do() {
    let reading = |position, velocity, torque, current| {
        Reading::Joint(JointState {
            position,
            velocity,
            torque,
            current,
            ..JointState::ABSENT
        })
    };
    let (good, absent) = (Quality::GOOD, f64::NAN);
    let both = Quality::DRIVE_FAULT | Quality::DEVICE_FAULT;
    let temperature = |celsius| Reading::Temperature(Temperature { celsius });
    let mut angle = board("myactuator", "torque_constant = 2.0", &[0]);
    let mut send =
        |output, reading: &Reading, quality| texts(&encode(&mut *angle, output, reading, quality));
    let turn = reading(-TAU, TAU, absent, 1.5);
    let sent = ["241#9C199600680198FE", "241#920000006073FFFF"];
    assert_eq!(send(0, &turn, good), sent);
    let derived = reading(-TAU, TAU, 3.0, absent);
    assert_eq!(send(0, &derived, good), sent);
    assert_eq!(send(0, &turn, both)[0], "241#9A19000100004020");
    assert_eq!(send(0, &turn, both), sent);
    assert_eq!(send(1, &temperature(200.0), good), [""; 0]);
    let over = ["241#9A7F000100000000", "241#9C7F9600680198FE", sent[1]];
    assert_eq!(send(0, &turn, good), over);
    assert_eq!(
        send(0, &actuator(0, 0x1002), good),
        ["241#9A7F000100000210"]
    );
    let far = reading(1e9, 1e9, absent, 1e9);
    let ends = ["241#9C7FFF7FFF7FFF7F", "241#92000000FFFFFF7F"];
    assert_eq!(send(0, &far, Quality::DRIVE_FAULT), ends);
    let mut out = Frames::new();
    for (output, reading, error) in [
        (0, reading(absent, 0.0, 0.0, 0.0), EncodeError::NotFinite),
        (0, reading(0.0, absent, 0.0, 0.0), EncodeError::NotFinite),
        (
            0,
            reading(0.0, 0.0, f64::INFINITY, 0.0),
            EncodeError::NotFinite,
        ),
        (
            0,
            reading(0.0, 0.0, 0.0, f64::INFINITY),
            EncodeError::NotFinite,
        ),
        (1, temperature(absent), EncodeError::NotFinite),
        (1, turn, EncodeError::Kind),
        (0, temperature(1.0), EncodeError::Kind),
        (2, turn, EncodeError::Output(2)),
    ] {
        assert_eq!(angle.encode(output, &reading, good, &mut out), Err(error));
    }
    let mut ask = |text: &str| asked(&mut *angle, text);
    assert_eq!(ask("141#9C00000000000000"), [ends[0]]);
    assert_eq!(ask("141#9200000000000000"), [ends[1]]);
    assert_eq!(ask("141#9A00000000000000"), ["241#9A7F000100000210"]);
    assert_eq!(ask("141#A200000028230000"), [ends[0]]);
    for none in [
        "141#9C",
        "142#9C00000000000000",
        "141#8000000000000000",
        "141#AA00000000000000",
    ] {
        assert_eq!(ask(none), [""; 0], "{none}");
    }
    let mut motion = board("myactuator", MOTION, &[0]);
    let frames = texts(&encode(
        &mut *motion,
        0,
        &reading(99.0, -99.0, absent, 1.0),
        good,
    ));
    assert_eq!(frames, ["501#01FFFF0008000000"]);
    let keys = format!("{OLD}\ngear_ratio = 2.0");
    let mut old = board("myactuator", &keys, &[0]);
    let frames = texts(&encode(
        &mut *old,
        0,
        &reading(-TAU, TAU / 4.0, 1.0, 1.0),
        Quality::DEVICE_FAULT,
    ));
    let sent = [
        "141#9A19000000000040",
        "141#9C190000B4000000",
        "141#92C0E6FEFFFFFFFF",
    ];
    assert_eq!(frames, sent);
    let mut old = board("myactuator", OLD_STATUS, &[0]);
    let frames = texts(&encode(
        &mut *old,
        0,
        &reading(-TAU / 4.0, 0.0, absent, 2.0),
        good,
    ));
    assert_eq!(frames, ["141#9C190400000000C0"]);
}

proptest! {
    #[test]
    fn readings_come_back(
        p in -12.4_f64..12.4, v in -44.0_f64..44.0, i in -300.0_f64..300.0,
        t in -23.9_f64..23.9, fault in 0_u8..3,
    ) {
        let quality = [Quality::GOOD, Quality::DEVICE_FAULT, Quality::DRIVE_FAULT]
            [usize::from(fault)];
        let state = JointState {
            position: p, velocity: v, current: i, torque: t, ..JointState::ABSENT
        };
        let degree = TAU / 360.0;
        for (keys, step, velocity) in [
            ("", 0.01 * degree, degree),
            (STATUS, degree, degree),
            (MOTION, 25.0 / 65535.0, 90.0 / 4095.0),
        ] {
            let mut board = board("myactuator", keys, &[0]);
            let frames = encode(&mut *board, 0, &Reading::Joint(state), quality);
            let (readings, _) = decode(&mut *listener("myactuator", keys, &[0]), &frames);
            let (back, read) = joints(&readings)[0];
            prop_assert_eq!(read, quality);
            prop_assert!((back.position - p).abs() <= step * 0.5 + 1e-9);
            prop_assert!((back.velocity - v).abs() <= velocity * 0.5 + 1e-9);
            if keys == MOTION {
                prop_assert!((back.torque - t).abs() <= 24.0 / 4095.0 + 1e-9);
            } else {
                prop_assert!((back.current - i).abs() <= 0.005 + 1e-9);
            }
        }
    }
}
