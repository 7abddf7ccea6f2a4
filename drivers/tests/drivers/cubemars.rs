//! CubeMars motors: frames that other people's programs read, motors that share an identifier, ends
//! of ranges, and errors.

use crate::rig::{
    FD, Rig, actuator, board, count, decode, encode, frame, is_saturated, joints, listener, near,
    options, refused, shown_keys, spec, texts,
};
use proprio_drivers::{Claim, Device, EncodeError, Frame, Frames, Id, Mode};
use proprio_drivers::{StampedReading, State};
use proprio_topics::{Counter, JointState, Kind, Nanos, Quality, Reading, StampKind, Temperature};
use proptest::prelude::*;
use std::f64::consts::TAU;

/// Frames of motor 3 with their values, `tests/oracle/frames/ak.py`.
const FRAMES: &str = include_str!("cubemars.txt");

const MIT: &str = "model = \"AK80-9\"";
const SERVO: &str = "mode = \"servo\"\nmodel = \"AK80-9\"";

fn motor(keys: &str, number: u32) -> Box<dyn Device> {
    options("cubemars", keys)
        .device(&spec(number, Mode::Listen, &[0]))
        .expect("a legal configuration")
}

/// Errors and temperatures told.
fn actuators(readings: &[StampedReading]) -> Vec<(u32, f64)> {
    let mut all = Vec::new();
    for pair in readings.windows(2) {
        if let (Reading::Actuator(actuator), Reading::Temperature(temperature)) =
            (pair[0].reading, pair[1].reading)
        {
            assert_eq!((pair[0].output, pair[1].output), (0, 1));
            assert!(actuator.duty.is_nan() && actuator.mode == 0);
            assert_eq!(actuator.encoder, u32::from(actuator.faults == 5));
            all.push((actuator.faults, temperature.celsius));
        }
    }
    all
}

#[test]
fn frames_are_read_as_other_programs_read_them() {
    let mut seen = 0;
    for line in FRAMES.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        let [
            mode,
            model,
            text,
            position,
            velocity,
            effort,
            celsius,
            error,
        ] = words[..]
        else {
            panic!("{line}");
        };
        let number = |word: &str| word.parse::<f64>().unwrap();
        let keys = format!("mode = {mode:?}\nmodel = {model:?}");
        let mut device = motor(&keys, 3);
        let (readings, faults) = decode(&mut *device, &[frame(text, 0.0)]);
        let (joint, read) = joints(&readings)[0];
        assert!(near(joint.position, number(position)), "{line}");
        assert!(near(joint.velocity, number(velocity)), "{line}");
        let (given, absent) = match mode {
            "mit" => (joint.torque, joint.current),
            _ => (joint.current, joint.torque),
        };
        assert!(near(given, number(effort)), "{line}");
        assert!(absent.is_nan() && joint.acceleration.is_nan());
        if error == "-" {
            assert_eq!(readings.len(), 1);
        } else {
            let (celsius, error) = (number(celsius), error.parse().unwrap());
            assert_eq!(actuators(&readings), [(error, celsius)], "{line}");
            let quality = match error {
                0 => Quality::GOOD,
                5 => Quality::DEVICE_FAULT,
                _ => Quality::DRIVE_FAULT,
            };
            assert!(read.contains(quality));
            let faulty = [Counter::DeviceFault, Counter::DriveFault].map(|c| count(&faults, c));
            let expected = [error == 5, error != 5 && error != 0].map(u32::from);
            assert_eq!(faulty, expected);
        }
        seen += 1;
    }
    assert_eq!(seen, 40);
}

/// By hand: ends and middles of all fields, AK80-9. Servo mode: 90 deg, one turn of the output per
/// second (21 pole pairs, gear 9: 11340 electrical revolutions per minute), 1 A.
#[test]
fn fields_are_where_the_manual_has_them() {
    let mut mit = motor(MIT, 1);
    let read = |device: &mut dyn Device, text: &str| {
        let (readings, _) = decode(device, &[frame(text, 0.0)]);
        let joint = joints(&readings)[0].0;
        [joint.position, joint.velocity, joint.torque, joint.current]
    };
    assert_eq!(
        read(&mut *mit, "000#010000000000")[..3],
        [-12.5, -50.0, -18.0]
    );
    assert_eq!(
        read(&mut *mit, "000#01FFFF000000")[..3],
        [12.5, -50.0, -18.0]
    );
    let [_, velocity, torque, _] = read(&mut *mit, "000#010000FFF000");
    assert!(near(velocity, 50.0) && near(torque, -18.0));
    let [_, velocity, torque, _] = read(&mut *mit, "000#010000000FFF");
    assert!(near(velocity, -50.0) && near(torque, 18.0));
    let mut servo = motor(&format!("{SERVO}\ntorque_constant = 1.5"), 104);
    let [position, velocity, torque, current] = read(&mut *servo, "00002968#0384046E00641900");
    assert!(near(position, TAU / 4.0) && near(velocity, TAU));
    assert!(near(current, 1.0) && near(torque, 1.5));
    let mut electrical = motor(&format!("{SERVO}\nangle = \"electrical\""), 104);
    let electrical = read(&mut *electrical, "00002968#0384046E00641900");
    assert!(near(electrical[0] * 189.0, position) && near(electrical[1], velocity));
}

#[test]
fn keys_replace_the_models_ranges() {
    let keys = "position_max = 95.5\nvelocity_max = 45.0\neffort_max = 40.0\neffort = \"current\"\n\
                torque_constant = 0.5\nhost_id = 0x7FF\ncelsius_at_zero = 0.0";
    for model in ["", "model = \"AK80-6\"\n"] {
        let mut device = motor(&format!("{model}{keys}"), 2);
        let text = "7FF#02FFFFFFFFFF2A00";
        let (readings, _) = decode(&mut *device, &[frame(text, 0.0)]);
        let read = joints(&readings)[0].0;
        assert!(near(read.position, 95.5) && near(read.velocity, 45.0));
        assert!(near(read.current, 40.0) && near(read.torque, 20.0));
        assert_eq!(actuators(&readings), [(0, 42.0)]);
    }
    let keys = "mode = \"servo\"\nmodel = \"AK10-9\"\npole_pairs = 14\ngear_ratio = 6.0";
    let mut device = motor(keys, 2);
    let (readings, _) = decode(&mut *device, &[frame("00002902#0000000100000000", 0.0)]);
    let read = joints(&readings)[0].0;
    assert!(near(read.velocity, TAU / 6.0 / 84.0));
}

/// The table of the page: upper ends of the ranges, and a speed of 10 electrical turns per minute.
#[test]
fn models_have_the_numbers_of_the_page() {
    let page = include_str!("../../../docs/book/src/devices/cubemars.md");
    let mut models = 0;
    for row in page.lines().filter(|line| line.starts_with("| AK")) {
        let row = row.trim_start_matches("| ").trim_end_matches(" |");
        let cells: Vec<&str> = row.split(" | ").collect();
        let number = |cell: usize| cells[cell].parse::<f64>().unwrap();
        let keys = format!("model = {:?}\n", cells[0]);
        let (readings, _) = decode(&mut *motor(&keys, 1), &[frame("000#01FFFFFFFFFF", 0.0)]);
        let read = joints(&readings)[0].0;
        assert!(near(read.position, 12.5));
        assert!(
            near(read.velocity, number(1)) && near(read.torque, number(2)),
            "{row}"
        );
        let mut servo = motor(&format!("{keys}mode = \"servo\""), 1);
        let (readings, _) = decode(&mut *servo, &[frame("00002901#0000000100000000", 0.0)]);
        let read = joints(&readings)[0].0;
        assert!(
            near(read.velocity, TAU / 6.0 / number(3) / number(4)),
            "{row}"
        );
        models += 1;
    }
    assert_eq!(models, 7);
}

/// Each device takes the replies with its number; what is on the identifier besides is nobody's.
#[test]
fn motors_share_an_identifier() {
    let frames = [
        frame("000#017FFF7FF7FF", 0.0),
        frame("000#02FFFF7FF7FF", 0.2),
        frame("000#09FFFF7FF7FF", 0.4),
        // A command to all in MIT mode, an empty frame, a request.
        frame("000#FFFFFFFFFFFFFFFC", 0.6),
        frame("000#", 0.8),
        Frame::remote(Id::standard(0), 8),
    ];
    let mut first = motor(MIT, 1);
    let mut second = motor("model = \"AK80-64\"", 2);
    for (device, position) in [(&mut first, 0.0), (&mut second, 12.5)] {
        let (readings, faults) = decode(&mut **device, &frames);
        assert_eq!(readings.len(), 1);
        assert!((joints(&readings)[0].0.position - position).abs() < 4e-4);
        assert_eq!(faults.len(), usize::from(position > 0.0), "{faults:?}");
    }
    assert_eq!(first.claims(), [Claim::shared(Id::standard(0))]);
    assert_eq!(first.claims(), second.claims());
    // A motor whose replies have its own number as identifier: commands have it too.
    let mut named = motor(&format!("{MIT}\nhost_id = 7"), 7);
    assert_eq!(named.claims(), [Claim::shared(Id::standard(7))]);
    let frames = [
        frame("007#80007FF000000800", 0.0),
        frame("007#FFFFFFFFFFFFFFFC", 0.5),
        frame("007#0780007FF8004100", 1.0),
    ];
    let (readings, faults) = decode(&mut *named, &frames);
    assert!(faults.is_empty());
    assert_eq!(joints(&readings).len(), 1);
    assert_eq!(actuators(&readings), [(0, 25.0)]);
    // Servo mode: each motor has its own.
    let servo = motor(SERVO, 254);
    assert_eq!(servo.claims(), [Claim::exclusive(Id::extended(0x29FE))]);
}

#[test]
fn a_value_at_an_end_of_its_range_is_saturated() {
    for (keys, text, saturated) in [
        (MIT, "000#018000800800", false),
        (MIT, "000#010001800800", false),
        (MIT, "000#010000800800", true),
        (MIT, "000#01FFFE800800", false),
        (MIT, "000#01FFFF800800", true),
        (MIT, "000#018000001800", false),
        (MIT, "000#018000000800", true),
        (MIT, "000#018000FFE800", false),
        (MIT, "000#018000FFF800", true),
        (MIT, "000#018000800001", false),
        (MIT, "000#018000800000", true),
        (MIT, "000#018000800FFE", false),
        (MIT, "000#018000800FFF", true),
        (SERVO, "00002901#7CFF7CFF176F1900", false),
        (SERVO, "00002901#83018301E8911900", false),
        (SERVO, "00002901#7D00000000001900", true),
        (SERVO, "00002901#8300000000001900", true),
        (SERVO, "00002901#7FFF000000001900", true),
        (SERVO, "00002901#00007D0000001900", true),
        (SERVO, "00002901#0000830000001900", true),
        (SERVO, "00002901#0000000017701900", true),
        (SERVO, "00002901#00000000E8901900", true),
    ] {
        assert_eq!(
            is_saturated(&mut *motor(keys, 1), text),
            saturated,
            "{text}"
        );
    }
}

/// Once a second, when the error changes, and after a silence.
#[test]
fn temperature_and_error_are_told_now_and_then() {
    let mut device = motor(SERVO, 1);
    let at = |celsius: u8, error: u8, ms| {
        let data = [0, 0, 0, 0, 0, 0, celsius, error];
        Frame::new(Id::extended(0x2901), &data)
            .at(Nanos::from_seconds(ms * 1e-3), StampKind::Software)
    };
    let frames = [
        at(20, 0, 0.0),
        at(21, 0, 2.0),
        at(22, 0, 1000.0),
        at(23, 0, 1001.0),
        at(24, 0, 1003.0),
        at(25, 1, 1005.0),
        at(26, 1, 1007.0),
        at(27, 5, 1009.0),
        at(0xF6, 0, 1011.0),
    ];
    let (readings, _) = decode(&mut *device, &frames);
    let expected = [(0, 20.0), (0, 23.0), (1, 25.0), (5, 27.0), (0, -10.0)];
    assert_eq!(actuators(&readings), expected);
    assert_eq!(joints(&readings).len(), frames.len());
    device.restart(Nanos::from_millis(1100));
    let (readings, _) = decode(&mut *device, &[at(30, 0, 1100.0)]);
    assert_eq!(actuators(&readings), [(0, 30.0)]);
    let qualities: Vec<Quality> = readings.iter().map(|r| r.quality).collect();
    assert_eq!(
        qualities,
        [Quality::GOOD, Quality::GOOD, Quality::GAP_BEFORE]
    );
}

#[test]
fn frames_that_are_none_of_the_protocol_are_counted() {
    for (keys, id, data) in [
        (MIT, Id::standard(0), &[1_u8, 0, 0, 0, 0, 0, 0, 0][..]),
        (SERVO, Id::extended(0x2901), &[0; 8]),
    ] {
        let mut device = motor(keys, 1);
        let is_mit = keys == MIT;
        for length in 1..8 {
            let (readings, faults) = decode(&mut *device, &[Frame::new(id, &data[..length])]);
            let legal = is_mit && length == 6;
            assert_eq!(
                (readings.len(), !faults.is_empty()),
                (usize::from(legal), true)
            );
            assert_eq!(count(&faults, Counter::Length), u32::from(!legal));
        }
        let fd = Frame::with_format(id, FD, data).unwrap();
        let (_, faults) = decode(&mut *device, &[fd]);
        assert_eq!(count(&faults, Counter::Value), 1);
        let (_, faults) = decode(&mut *device, &[Frame::remote(id, 8)]);
        assert_eq!(count(&faults, Counter::Length), u32::from(!is_mit));
        // The identifiers of commands and of other motors.
        for other in [
            Id::standard(1),
            Id::extended(0),
            Id::extended(0x2902),
            Id::extended(0x301),
        ] {
            let (readings, faults) = decode(&mut *device, &[Frame::new(other, data)]);
            assert!(readings.is_empty() && faults.is_empty());
        }
    }
}

#[test]
fn the_keys_of_the_page_are_legal_and_nothing_is_sent() {
    let keys = shown_keys(include_str!("../../../docs/book/src/devices/cubemars.md"));
    assert!(keys.contains("celsius_at_zero"));
    let still = Reading::Joint(JointState {
        position: 1.0,
        velocity: 0.0,
        ..JointState::ABSENT
    });
    let mut rig = Rig::new("cubemars", keys, &[0], (0, still));
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(joints(&rig.readings).len(), 50);
    rig.board_loses = Box::new(|_, _| true);
    rig.run(100);
    assert_eq!(rig.device.state(), State::Silent);
    assert_eq!(rig.count(Counter::Silences), 1);
    rig.board_loses = Box::new(|_, _| false);
    rig.run(20);
    assert_eq!(joints(&rig.readings)[50].1, Quality::GAP_BEFORE);
    assert_eq!(actuators(&rig.readings).len(), 2);
    rig.device.stop(rig.now);
    rig.run(20);
    assert_eq!(rig.device.state(), State::Stopped);
    assert_eq!(rig.sent, [""; 0]);
    assert_eq!(rig.count(Counter::Starts), 0);
}

#[test]
fn the_temperature_has_a_channel_of_its_own() {
    for keys in [MIT, SERVO] {
        let outputs = options("cubemars", keys).outputs().into_iter();
        let outputs: Vec<_> = outputs
            .map(|o| (o.number, o.kind, o.suffix.into_owned()))
            .collect();
        let joint = (0, Kind::Joint, String::new());
        let drive = (1, Kind::Temperature, "drive".to_owned());
        assert_eq!(outputs, [joint, drive]);
    }
}

#[test]
fn wrong_keys_are_refused() {
    let refused = |keys: &str, address| refused("cubemars", keys, address);
    for address in [255, 256, 257] {
        assert_eq!(refused(MIT, address), "0 to 254");
    }
    for (keys, key) in [
        ("", "velocity_max"),
        ("velocity_max = 50.0", "effort_max"),
        ("mode = \"servo\"", "pole_pairs"),
        ("mode = \"servo\"\npole_pairs = 21", "gear_ratio"),
        // A model has no range of currents.
        ("model = \"AK80-9\"\neffort = \"current\"", "effort_max"),
    ] {
        assert_eq!(refused(keys, 1), key, "{keys}");
    }
    for (keys, key) in [
        ("host_id = 2048", "host_id"),
        ("position_max = 0.0", "position_max"),
        ("position_max = -12.5", "position_max"),
        ("velocity_max = inf", "velocity_max"),
        ("effort_max = nan", "effort_max"),
        ("celsius_at_zero = -101.0", "celsius_at_zero"),
        ("celsius_at_zero = 101.0", "celsius_at_zero"),
        ("celsius_at_zero = nan", "celsius_at_zero"),
        ("torque_constant = 0.0", "torque_constant"),
        ("period_ms = 0", "period_ms"),
        ("period_ms = 60001", "period_ms"),
    ] {
        assert_eq!(refused(&format!("{MIT}\n{keys}"), 1), key);
    }
    for (keys, key) in [
        ("pole_pairs = 0", "pole_pairs"),
        ("gear_ratio = -9.0", "gear_ratio"),
    ] {
        assert_eq!(refused(&format!("{SERVO}\n{keys}"), 1), key);
    }
    for keys in [MIT, SERVO] {
        for address in [0, 254] {
            motor(keys, address);
        }
    }
}

#[test]
fn a_simulated_motor_sends_what_it_is_given() {
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
    let mut mit = board("cubemars", MIT, &[0]);
    let mut send =
        |output, reading: &Reading, quality| texts(&encode(&mut *mit, output, reading, quality));
    let high = reading(99.0, 99.0, 99.0, absent);
    assert_eq!(send(0, &high, good), ["000#01FFFFFFFFFF4100"]);
    let low = reading(-99.0, -99.0, -99.0, absent);
    assert_eq!(
        send(0, &low, Quality::DRIVE_FAULT),
        ["000#0100000000004102"]
    );
    let both = Quality::DRIVE_FAULT | Quality::DEVICE_FAULT;
    assert_eq!(send(0, &low, both), ["000#0100000000004105"]);
    assert_eq!(send(0, &actuator(0, 7), good), [""; 0]);
    let temperature = |celsius| Reading::Temperature(Temperature { celsius });
    assert_eq!(send(1, &temperature(300.0), good), [""; 0]);
    // An error of that kind stays as it was told.
    let quality = Quality::DRIVE_FAULT | Quality::SATURATED;
    assert_eq!(send(0, &low, quality), ["000#010000000000FF07"]);
    send(1, &temperature(-60.0), good);
    assert_eq!(send(0, &low, good), ["000#0100000000000000"]);

    let keys = format!("{SERVO}\ntorque_constant = 2.0");
    let mut servo = board("cubemars", &keys, &[0]);
    let mut send =
        |output, reading: &Reading, quality| texts(&encode(&mut *servo, output, reading, quality));
    send(1, &temperature(-300.0), good);
    let given = reading(TAU / 4.0, -TAU, 8.0, 1.0);
    assert_eq!(send(0, &given, good), ["00002901#0384FB9200648000"]);
    let derived = reading(0.0, 0.0, 4.0, absent);
    assert_eq!(send(0, &derived, good), ["00002901#0000000000C88000"]);
    let none = reading(0.0, 0.0, absent, absent);
    assert_eq!(send(0, &none, good), ["00002901#0000000000008000"]);
    send(1, &temperature(300.0), good);
    let far = reading(999.0, 9999.0, absent, -99.0);
    assert_eq!(send(0, &far, good), ["00002901#7D007D00E8907F00"]);
    let mut out = Frames::new();
    for (output, reading, error) in [
        (0, reading(absent, 0.0, 0.0, 0.0), EncodeError::NotFinite),
        (0, reading(0.0, absent, 0.0, 0.0), EncodeError::NotFinite),
        (
            0,
            reading(0.0, 0.0, 0.0, f64::INFINITY),
            EncodeError::NotFinite,
        ),
        (1, temperature(absent), EncodeError::NotFinite),
        (1, none, EncodeError::Kind),
        (0, temperature(1.0), EncodeError::Kind),
        (2, none, EncodeError::Output(2)),
    ] {
        assert_eq!(servo.encode(output, &reading, good, &mut out), Err(error));
    }
}

proptest! {
    #[test]
    fn readings_come_back(
        p in -1.0_f64..1.0, v in -1.0_f64..1.0, e in -1.0_f64..1.0, celsius in -20.0_f64..127.0,
        fault in 0_u8..3,
    ) {
        let ends = [
            (MIT, [12.5, 50.0, 18.0], [25.0 / 65535.0, 100.0 / 4095.0, 36.0 / 4095.0]),
            (
                SERVO,
                [55.8, 1770.0, 59.9],
                [TAU / 3600.0, TAU / 6.0 / 189.0, 0.01],
            ),
        ];
        for (keys, ends, steps) in ends {
            let quality = match fault {
                0 => Quality::GOOD,
                1 => Quality::DEVICE_FAULT,
                _ => Quality::DRIVE_FAULT,
            };
            let sent = [p * ends[0], v * ends[1].min(170.0), e * ends[2]];
            let mut state = JointState {
                position: sent[0], velocity: sent[1], ..JointState::ABSENT
            };
            *(if keys == MIT { &mut state.torque } else { &mut state.current }) = sent[2];
            let mut board = board("cubemars", keys, &[0]);
            let warm = Reading::Temperature(Temperature { celsius });
            encode(&mut *board, 1, &warm, Quality::GOOD);
            let frames = encode(&mut *board, 0, &Reading::Joint(state), quality);
            let (readings, _) = decode(&mut *listener("cubemars", keys, &[0]), &frames);
            let (back, found) = joints(&readings)[0];
            let effort = if keys == MIT { back.torque } else { back.current };
            let read = [back.position, back.velocity, effort];
            for ((a, b), step) in read.iter().zip(sent).zip(steps) {
                prop_assert!((a - b).abs() <= step * (0.5 + 1e-9), "{} {} {}", a, b, step);
            }
            prop_assert_eq!(found.0 & !Quality::SATURATED.0, quality.0);
            let (_, read) = told_once(&readings);
            prop_assert!((read - celsius).abs() <= 0.5 + 1e-9);
        }
    }
}

fn told_once(readings: &[StampedReading]) -> (u32, f64) {
    let actuators = actuators(readings);
    assert_eq!(actuators.len(), 1);
    actuators[0]
}
