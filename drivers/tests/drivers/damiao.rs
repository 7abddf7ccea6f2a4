//! Damiao motors: frames that other people's programs read, ranges that the motor tells, motors
//! that share an identifier, what may be sent, ends of ranges, and states.

use crate::rig::{
    FD, Rig, actuator, asked, board, count, decode, encode, frame, is_saturated, joints, listener,
    near, options, poll, refused, sends_nothing, shown_keys, spec, texts,
};
use proprio_drivers::State;
use proprio_drivers::{
    Claim, Decoded, Device, EncodeError, Frame, Frames, Id, Mode, StampedReading,
};
use proprio_topics::{
    Counter, JointState, Nanos, Quality, Reading, Refusal, StampKind, Temperature,
};
use proptest::prelude::*;

/// Frames with their values, questions and answers, `tests/oracle/frames/dm.py`.
const FRAMES: &str = include_str!("damiao.txt");

const MODEL: &str = "model = \"DM4310\"\nhost_id = 0x11";
const ASKED: &str = "host_id = 0x11\nrequest_period_ms = 5";

fn motor(keys: &str, address: u32, mode: Mode) -> Box<dyn Device> {
    options("damiao", keys)
        .device(&spec(address, mode, &[0]))
        .expect("a legal configuration")
}

/// Mode and faults, temperatures of FET and motor.
fn actuators(readings: &[StampedReading]) -> Vec<(u32, u32, f64, f64)> {
    let states = readings.windows(3).filter_map(|three| {
        let [a, b, c] = [0, 1, 2].map(|place| (three[place].output, three[place].reading));
        match (a, b, c) {
            (
                (0, Reading::Actuator(actuator)),
                (2, Reading::Temperature(fet)),
                (1, Reading::Temperature(motor)),
            ) => {
                assert!(actuator.duty.is_nan());
                assert_eq!(actuator.encoder, u32::from(actuator.faults == 5));
                Some((actuator.mode, actuator.faults, fet.celsius, motor.celsius))
            }
            _ => None,
        }
    });
    states.collect()
}

#[test]
fn frames_are_read_as_other_programs_read_them() {
    let (mut states, mut questions) = (0, 0);
    for line in FRAMES.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        let number = |word: &str| word.parse::<f64>().unwrap();
        match words[..] {
            [model, text, position, velocity, torque, fet, rotor, state] => {
                let id = &text[..3];
                let address = u32::from_str_radix(id, 16).unwrap() - 0x10;
                let keys = format!("model = {model:?}\nhost_id = 0x{id}");
                let mut device = motor(&keys, address, Mode::Listen);
                let (readings, faults) = decode(&mut *device, &[frame(text, 0.0)]);
                let (joint, quality) = joints(&readings)[0];
                assert!(near(joint.position, number(position)), "{line}");
                assert!(near(joint.velocity, number(velocity)), "{line}");
                assert!(near(joint.torque, number(torque)), "{line}");
                assert!(joint.current.is_nan() && joint.acceleration.is_nan());
                let state: u32 = state.parse().unwrap();
                let expected = (u32::from(state == 1), if state > 1 { state } else { 0 });
                let (mode, code, hot, hotter) = actuators(&readings)[0];
                assert_eq!((mode, code), expected, "{line}");
                assert_eq!((hot, hotter), (number(fet), number(rotor)), "{line}");
                assert_eq!(quality.contains(Quality::DRIVE_FAULT), state > 1, "{line}");
                assert_eq!(count(&faults, Counter::DriveFault), u32::from(state > 1));
                states += 1;
            }
            [kind @ ("ask" | "read"), address, register, text] => {
                // What the driver sends is what these programs send: to a motor that answers.
                let keys = "host_id = 0x7E0\nrequest_period_ms = 5";
                let mut rig = Rig::new("damiao", keys, &[0], still());
                let spec = spec(address.parse().unwrap(), Mode::Supervise, &[0]);
                let options = options("damiao", keys);
                rig.device = options.device(&spec).unwrap();
                rig.board = options.board(&spec).unwrap();
                rig.run(30);
                assert!(
                    rig.sent.iter().any(|sent| sent == text),
                    "{kind} {register}"
                );
                questions += 1;
            }
            ["answer", address, register, value, text] => {
                let host = &text[..3];
                let keys = format!("host_id = 0x{host}\nrequest_period_ms = 5");
                let keys = format!(
                    "{keys}\n{}",
                    match register {
                        "21" => "velocity_max = 1.0\ntorque_max = 1.0",
                        "22" => "position_max = 1.0\ntorque_max = 1.0",
                        _ => "position_max = 1.0\nvelocity_max = 1.0",
                    }
                );
                let address = address.parse().unwrap();
                let mut device = motor(&keys, address, Mode::Listen);
                let state = format!("{host}#1{:X}FFFFFFFFFF1919", address & 0xF);
                let (readings, faults) = decode(&mut *device, &[frame(&state, 0.0)]);
                assert_eq!(
                    (readings.len(), count(&faults, Counter::Unexpected)),
                    (0, 1)
                );
                let (readings, _) = decode(&mut *device, &[frame(text, 1.0), frame(&state, 2.0)]);
                let (joint, _) = joints(&readings)[0];
                let values = [joint.position, joint.velocity, joint.torque];
                let place = usize::from(register.parse::<u8>().unwrap() - 21);
                assert!(near(values[place], number(value)), "{line}: {values:?}");
                questions += 1;
            }
            _ => panic!("{line}"),
        }
    }
    assert_eq!((states, questions), (14, 14));
}

fn still() -> (u8, Reading) {
    let state = JointState {
        position: 1.0,
        velocity: 0.0,
        torque: 2.0,
        ..JointState::ABSENT
    };
    (0, Reading::Joint(state))
}

/// By hand: ends and middles of all fields.
#[test]
fn fields_are_where_other_programs_have_them() {
    let read = |text: &str| {
        let mut device = motor(MODEL, 1, Mode::Listen);
        joints(&decode(&mut *device, &[frame(text, 0.0)]).0)[0].0
    };
    let low = read("011#1100000000001919");
    let values = [low.position, low.velocity, low.torque];
    assert_eq!(values, [-12.5, -30.0, -10.0]);
    assert!(near(read("011#11FFFF0000001919").position, 12.5));
    let velocity = read("011#110000FFF0001919");
    assert!(near(velocity.velocity, 30.0) && near(velocity.torque, -10.0));
    let torque = read("011#110000000FFF1919");
    assert!(near(torque.velocity, -30.0) && near(torque.torque, 10.0));
}

/// The table of the page.
#[test]
fn models_have_the_numbers_of_the_page() {
    let page = include_str!("../../../docs/book/src/devices/damiao.md");
    let mut models = 0;
    for row in page.lines().filter(|line| line.starts_with("| DM")) {
        let row = row.trim_start_matches("| ").trim_end_matches(" |");
        let cells: Vec<&str> = row.split(" | ").collect();
        let number = |cell: usize| cells[cell].parse::<f64>().unwrap();
        let mut device = motor(&format!("model = {:?}", cells[0]), 1, Mode::Listen);
        let (readings, _) = decode(&mut *device, &[frame("000#11FFFFFFFFFF1919", 0.0)]);
        let (joint, _) = joints(&readings)[0];
        assert!(near(joint.position, 12.5), "{row}");
        assert!(
            near(joint.velocity, number(1)) && near(joint.torque, number(2)),
            "{row}"
        );
        models += 1;
    }
    assert_eq!(models, 12);
}

/// Each device takes the frames with its own low half; classic CAN and CAN FD.
#[test]
fn motors_share_an_identifier() {
    let state = frame("000#11FFFE7FF7FF1919", 0.0);
    let fd = Frame::with_format(state.id, FD, state.data()).unwrap();
    let frames = [
        frame("000#127FFF7FF7FF1919", 0.0),
        state,
        frame("000#137FFF7FF7FF1919", 0.2),
        fd,
        Frame::remote(Id::standard(0), 8),
    ];
    for (address, number) in [(1, 2), (2, 1), (0x11, 2), (0xF3, 1), (4, 0)] {
        let mut device = motor("model = \"DM8009\"", address, Mode::Listen);
        let (readings, faults) = decode(&mut *device, &frames);
        assert_eq!(joints(&readings).len(), number, "{address}");
        assert_eq!(count(&faults, Counter::Length), 1);
        assert_eq!(faults.len(), 1);
        assert_eq!(device.claims(), [Claim::shared(Id::standard(0))]);
    }
}

#[test]
fn a_value_at_an_end_of_its_range_is_saturated() {
    for (text, saturated) in [
        ("011#1180008008001919", false),
        ("011#1100018008001919", false),
        ("011#1100008008001919", true),
        ("011#11FFFE8008001919", false),
        ("011#11FFFF8008001919", true),
        ("011#1180000008001919", true),
        ("011#118000FFF8001919", true),
        ("011#1180008000001919", true),
        ("011#118000800FFF1919", true),
    ] {
        let mut device = motor(MODEL, 1, Mode::Listen);
        assert_eq!(is_saturated(&mut *device, text), saturated, "{text}");
    }
}

/// Once a second, when the state changes, and after a start.
#[test]
fn states_are_told_now_and_then() {
    let mut device = motor(MODEL, 1, Mode::Listen);
    let at = |state: u8, fet: u8, ms| {
        let data = [state << 4 | 1, 0x80, 0, 0x80, 8, 0, fet, 40];
        Frame::new(Id::standard(0x11), &data).at(Nanos::from_millis(ms), StampKind::Software)
    };
    let frames = [
        at(0, 20, 0),
        at(0, 21, 1000),
        at(0, 22, 1001),
        at(1, 23, 1005),
        at(5, 24, 1007),
        at(5, 25, 1008),
        at(6, 26, 1009),
        at(2, 27, 1010),
        at(1, 28, 1011),
    ];
    let (readings, faults) = decode(&mut *device, &frames);
    let expected = [
        (0, 0, 20.0, 40.0),
        (0, 0, 22.0, 40.0),
        (1, 0, 23.0, 40.0),
        (0, 5, 24.0, 40.0),
        (0, 6, 26.0, 40.0),
        (0, 2, 27.0, 40.0),
        (1, 0, 28.0, 40.0),
    ];
    assert_eq!(actuators(&readings), expected);
    let (good, sensor) = (Quality::GOOD, Quality::DEVICE_FAULT);
    let drive = Quality::DRIVE_FAULT;
    let qualities: Vec<Quality> = joints(&readings)
        .iter()
        .map(|(_, quality)| *quality)
        .collect();
    let expected = [good, good, good, good, sensor, sensor, drive, drive, good];
    assert_eq!(qualities, expected);
    let faulty = [Counter::DeviceFault, Counter::DriveFault].map(|c| count(&faults, c));
    assert_eq!(faulty, [2, 2]);
    device.restart(Nanos::from_millis(1012));
    let (readings, _) = decode(&mut *device, &[at(1, 30, 1012)]);
    assert_eq!(actuators(&readings), [(1, 0, 30.0, 40.0)]);
    assert_eq!(joints(&readings)[0].1, Quality::GAP_BEFORE);
}

/// Every frame that the driver can send: it reads three registers and the state, of its motor.
#[test]
fn no_command_is_ever_sent() {
    let legal = [
        "7FF#0100CC0000000000",
        "7FF#0100331500000000",
        "7FF#0100331600000000",
        "7FF#0100331700000000",
    ];
    let mut rig = Rig::new("damiao", ASKED, &[0], still());
    rig.run(300);
    rig.disturb();
    for text in &rig.sent {
        assert!(legal.contains(&text.as_str()), "{text}");
    }
    for text in legal {
        assert!(rig.sent.iter().any(|sent| sent == text), "{text}");
    }
    // Without the key, and where another program commands, nothing.
    for (keys, mode) in [(MODEL, Mode::Supervise), (ASKED, Mode::Listen)] {
        let mut device = motor(keys, 1, mode);
        sends_nothing(&mut *device);
    }
}

#[test]
fn a_motor_is_asked_for_its_ranges_and_then_for_its_state() {
    let board_keys = format!("{ASKED}\nposition_max = 20.0\nvelocity_max = 8.0\ntorque_max = 40.0");
    // The model's ranges are not those that this motor has.
    for keys in [ASKED.to_string(), format!("{ASKED}\nmodel = \"DM8009\"")] {
        let mut rig = Rig::with_board("damiao", &keys, &board_keys, &[0], still());
        rig.run(100);
        assert_eq!(rig.device.state(), State::Streaming);
        let asked = [
            "7FF#0100331500000000",
            "7FF#0100331600000000",
            "7FF#0100331700000000",
        ];
        assert_eq!(rig.sent[..3], asked);
        assert_eq!(rig.sent[3..].len(), 20);
        assert!(
            rig.sent[3..]
                .iter()
                .all(|sent| sent == "7FF#0100CC0000000000")
        );
        let read = joints(&rig.readings);
        assert_eq!(read.len(), 20);
        assert!((read[0].0.position - 1.0).abs() < 1e-3);
        assert!((read[0].0.torque - 2.0).abs() < 2e-2);
    }
    // A range that is stated is not asked for, and holds.
    let keys = format!("{ASKED}\nvelocity_max = 8.0");
    let mut rig = Rig::with_board("damiao", &keys, &board_keys, &[0], still());
    rig.run(50);
    assert_eq!(
        rig.sent[..2],
        ["7FF#0100331500000000", "7FF#0100331700000000"]
    );
    assert_eq!(rig.sent[2], "7FF#0100CC0000000000");
    // In CAN FD.
    let keys = format!("{ASKED}\nfd = true");
    assert!(options("damiao", &keys).needs_fd() && !options("damiao", ASKED).needs_fd());
    let mut rig = Rig::new("damiao", &keys, &[0], still());
    rig.run(50);
    assert_eq!(rig.sent[0], "7FF##10100331500000000");
    assert!(!joints(&rig.readings).is_empty());
}

/// Old firmware has no registers: the model's ranges, if the model is known. Else it is told.
#[test]
fn a_motor_that_does_not_tell_its_ranges() {
    let silent = |frame: &Frame| frame.data().get(2) == Some(&0x33);
    let keys = format!("{ASKED}\nmodel = \"DM4310\"");
    let mut rig = Rig::new("damiao", &keys, &[0], still());
    rig.board_loses = Box::new(move |_, frame| silent(frame));
    rig.run(400);
    assert_eq!(rig.device.state(), State::Streaming);
    let asked = rig
        .sent
        .iter()
        .filter(|text| text.contains("#010033"))
        .count();
    assert_eq!(asked, 5);

    let mut rig = Rig::new("damiao", ASKED, &[0], still());
    rig.board_loses = Box::new(move |_, frame| silent(frame));
    rig.run(1000);
    assert_eq!(rig.device.state(), State::Refused(Refusal::NoAnswer));
    assert!(rig.readings.is_empty());
    rig.board_loses = Box::new(|_, _| false);
    rig.run(1000);
    assert_eq!(rig.device.state(), State::Streaming);
    assert!(!rig.readings.is_empty());
}

/// Of another program, or late: the newest holds, for the motor uses it.
#[test]
fn ranges_that_change_are_counted() {
    let answer = |register: u8, value: f32, command: u8, ms| {
        let [a, b, c, d] = value.to_le_bytes();
        let data = [1, 0, command, register, a, b, c, d];
        Frame::new(Id::standard(0x11), &data).at(Nanos::from_millis(ms), StampKind::Software)
    };
    let state = |ms| frame("011#11FFFF8008001919", ms);
    let mut device = motor(MODEL, 1, Mode::Listen);
    let mut read = |frames: &[Frame]| {
        let (readings, faults) = decode(&mut *device, frames);
        let joint = joints(&readings)[0].0;
        (
            joint.position,
            count(&faults, Counter::Changed),
            count(&faults, Counter::Value),
        )
    };
    assert!(near(read(&[state(0.0)]).0, 12.5));
    assert_eq!(read(&[answer(21, 20.0, 0x33, 1), state(2.0)]), (20.0, 0, 0));
    assert_eq!(read(&[answer(21, 20.0, 0x33, 3), state(4.0)]), (20.0, 0, 0));
    // It was set.
    assert_eq!(read(&[answer(21, 25.0, 0x55, 5), state(6.0)]), (25.0, 1, 0));
    // Other registers, what is no range, and the answer to a request to save.
    for value in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        assert_eq!(
            read(&[answer(21, value, 0x33, 7), state(8.0)]),
            (25.0, 0, 1)
        );
    }
    for (register, command) in [(20, 0x33), (24, 0x33), (1, 0xAA), (21, 0xAA)] {
        let frames = [answer(register, 3.0, command, 9), state(10.0)];
        assert_eq!(read(&frames), (25.0, 0, 0));
    }
    // A key overrides what the motor tells.
    let keys = format!("{MODEL}\nposition_max = 3.0");
    let mut device = motor(&keys, 1, Mode::Listen);
    let (readings, _) = decode(&mut *device, &[answer(21, 20.0, 0x33, 1), state(2.0)]);
    assert!(near(joints(&readings)[0].0.position, 3.0));
    // An enabled motor, or a position elsewhere, is no answer.
    let mut device = motor(MODEL, 1, Mode::Listen);
    for text in [
        "011#1100331500000000",
        "011#0101331500000000",
        "011#0100345600000000",
    ] {
        let (readings, _) = decode(&mut *device, &[frame(text, 0.0)]);
        assert_eq!(joints(&readings).len(), 1, "{text}");
    }
}

#[test]
fn frames_that_are_none_of_the_protocol_are_counted() {
    let mut device = motor(MODEL, 1, Mode::Listen);
    let id = Id::standard(0x11);
    for length in 0..8 {
        let short = Frame::new(id, &[0x11; 8][..length]);
        let (readings, faults) = decode(&mut *device, &[short]);
        assert_eq!((readings.len(), count(&faults, Counter::Length)), (0, 1));
    }
    let long = Frame::with_format(id, FD, &[0x11; 12]).unwrap();
    let (readings, faults) = decode(&mut *device, &[long]);
    assert_eq!((readings.len(), count(&faults, Counter::Length)), (0, 1));
    for other in [
        Id::standard(1),
        Id::standard(0x101),
        Id::standard(0x7FF),
        Id::extended(0x11),
    ] {
        let (readings, faults) = decode(&mut *device, &[Frame::new(other, &[0x11; 8])]);
        assert!(readings.is_empty() && faults.is_empty(), "{other}");
    }
}

#[test]
fn the_keys_of_the_page_are_legal() {
    let keys = shown_keys(include_str!("../../../docs/book/src/devices/damiao.md"));
    assert!(keys.contains("request_period_ms"));
    let mut rig = Rig::new("damiao", keys, &[0], still());
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
}

#[test]
fn wrong_keys_are_refused() {
    let refused = |keys: &str, address| refused("damiao", keys, address);
    for address in [0, 256] {
        assert_eq!(refused(MODEL, address), "1 to 255");
    }
    for keys in ["", "position_max = 12.5\nvelocity_max = 30.0"] {
        assert_eq!(refused(keys, 1), "model");
    }
    for (keys, key) in [
        ("host_id = 0x7FF", "host_id"),
        ("host_id = 1", "host_id"),
        ("position_max = 0.0", "position_max"),
        ("velocity_max = nan", "velocity_max"),
        ("torque_max = -1.0", "torque_max"),
        ("request_period_ms = 0", "request_period_ms"),
        ("request_period_ms = 60001", "request_period_ms"),
        ("period_ms = 0", "period_ms"),
    ] {
        assert_eq!(refused(&format!("model = \"DM4310\"\n{keys}"), 1), key);
    }
    motor(
        "position_max = 12.5\nvelocity_max = 30.0\ntorque_max = 1.0",
        255,
        Mode::Listen,
    );
    motor("model = \"DM4310\"\nhost_id = 0x7FE", 1, Mode::Listen);
}

#[test]
fn a_simulated_motor_answers_as_real_ones_do() {
    let reading = |position, velocity, torque| {
        Reading::Joint(JointState {
            position,
            velocity,
            torque,
            ..JointState::ABSENT
        })
    };
    let (good, absent) = (Quality::GOOD, f64::NAN);
    let mut motor = board("damiao", MODEL, &[0]);
    let mut send =
        |output, reading: &Reading, quality| texts(&encode(&mut *motor, output, reading, quality));
    let high = reading(99.0, 99.0, 99.0);
    assert_eq!(send(0, &high, good), ["011#11FFFFFFFFFF1919"]);
    let low = reading(-99.0, -99.0, -99.0);
    assert_eq!(
        send(0, &low, Quality::DRIVE_FAULT),
        ["011#E100000000001919"]
    );
    let both = Quality::DRIVE_FAULT | Quality::DEVICE_FAULT;
    assert_eq!(send(0, &low, both), ["011#5100000000001919"]);
    assert_eq!(send(0, &actuator(0, 0xB), good), [""; 0]);
    // A fault of that kind stays as it was told.
    assert_eq!(
        send(0, &low, Quality::DRIVE_FAULT),
        ["011#B100000000001919"]
    );
    send(0, &actuator(0, 0), good);
    let temperature = |celsius| Reading::Temperature(Temperature { celsius });
    assert_eq!(send(1, &temperature(80.6), good), [""; 0]);
    send(2, &temperature(-5.0), good);
    assert_eq!(
        send(0, &reading(0.0, 0.0, absent), good),
        ["011#0180008008000051"]
    );
    let mut out = Frames::new();
    for (output, reading, error) in [
        (0, reading(absent, 0.0, 0.0), EncodeError::NotFinite),
        (0, reading(0.0, absent, 0.0), EncodeError::NotFinite),
        (1, temperature(absent), EncodeError::NotFinite),
        (2, high, EncodeError::Kind),
        (0, temperature(1.0), EncodeError::Kind),
        (3, high, EncodeError::Output(3)),
    ] {
        assert_eq!(motor.encode(output, &reading, good, &mut out), Err(error));
    }
    // Commands in each mode are answered; those to others are not.
    let mut ask = |text: &str| asked(&mut *motor, text);
    let state = ["011#0180008008000051"];
    for command in [
        "001#8000800000000800",
        "101#0000000000000000",
        "301#0000000000000000",
    ] {
        assert_eq!(ask(command), state);
    }
    assert_eq!(ask("7FF#0100CC0000000000"), state);
    assert_eq!(ask("7FF#0100331500000000"), ["011#0100331500004841"]);
    for none in [
        "001#80008000000008",
        "002#8000800000000800",
        "401#8000800000000800",
        "7FF#0200CC0000000000",
        "7FF#0101CC0000000000",
        "7FF#0100331400000000",
        "7FF#0100",
    ] {
        assert_eq!(ask(none), [""; 0], "{none}");
    }
}

proptest! {
    #[test]
    fn readings_come_back(
        p in -12.4_f64..12.4, v in -29.9_f64..29.9, t in -9.9_f64..9.9, fault in 0_u8..3,
    ) {
        let quality = [Quality::GOOD, Quality::DEVICE_FAULT, Quality::DRIVE_FAULT]
            [usize::from(fault)];
        let state = JointState { position: p, velocity: v, torque: t, ..JointState::ABSENT };
        let mut board = board("damiao", MODEL, &[0]);
        let frames = encode(&mut *board, 0, &Reading::Joint(state), quality);
        let (readings, _) = decode(&mut *listener("damiao", MODEL, &[0]), &frames);
        let (back, read) = joints(&readings)[0];
        prop_assert_eq!(read, quality);
        for (a, b, step) in [
            (back.position, p, 25.0 / 65535.0),
            (back.velocity, v, 60.0 / 4095.0),
            (back.torque, t, 20.0 / 4095.0),
        ] {
            prop_assert!((a - b).abs() <= step * 0.5 + 1e-9);
        }
    }
}

/// A reply that the host did not ask for: of another program, while the driver asks itself.
#[test]
fn questions_are_asked_in_their_order_whatever_comes() {
    let mut device = motor(ASKED, 1, Mode::Supervise);
    let mut out = Decoded::new();
    let now = Nanos::from_millis(1000);
    let first = device
        .poll_transmit(now, &mut out)
        .expect("a question")
        .frame;
    device.on_sent(&first, Ok(now));
    let mut answer = |register: u8| {
        let [a, b, c, d] = 20.0_f32.to_le_bytes();
        let data = [1, 0, 0x33, register, a, b, c, d];
        let frame = Frame::new(Id::standard(0x11), &data).at(now, StampKind::Software);
        device.on_frame(&frame, &mut Decoded::new());
        poll(&mut *device, now).map(|frame| frame.to_string())
    };
    assert_eq!(answer(23), None);
    assert_eq!(answer(21), Some("7FF#0100331600000000".into()));
}
