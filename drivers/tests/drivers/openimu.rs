//! OpenIMU and MTLT: messages as the sensor's firmware makes them, the commands of its host, and
//! the limits and faults of J1939.
//!
//! The bytes of [`SLOPE`], [`ACCELERATION`] and [`RATE`] are the output of the structures and
//! expressions of the firmware (`sae_j1939.h` of Aceinna/openIMU300-lib 1182d149,
//! `UserMessagingCAN.c` of Aceinna/platform-aceinna_imu 03639473, compiled with gcc) for pitch 5.25
//! deg and roll -30.5 deg, acceleration (1.5, -2.25, -9.75) m/s^2 and angular velocity (10.5,
//! -20.25, 100.125) deg/s forward, right and down, with the user behaviour of delivery. The
//! formulas of `CAN_MTLT.py` (Aceinna/python-mtlt 1b99f92e) read them as roll -30.50, pitch 5.25;
//! 2.25, 1.50, 9.75; -20.25, 10.50, 100.125. All others are computed by hand.

use crate::rig::{FD, Rig, board, count, decode, encode, frame, imu, listener, options, spec};
use proprio_drivers::{EncodeError, Format, Frame, Frames, Id, Mode, SpecError, State};
use proprio_topics::{Counter, Imu, Nanos, Quality, Reading, Saturation, StampKind, Temperature};
use proptest::array::uniform3;
use proptest::prelude::*;
use std::f64::consts::PI;

const SLOPE: &str = "0CF02980#00A07F00C06DCC02";
const ACCELERATION: &str = "08F02D80#E17D967DCF80BF00";
const RATE: &str = "0CF02A80#E072408210AF3F02";

const ALL: &str = r#"quantities = ["angular_velocity", "orientation", "acceleration"]"#;
const DEGREE: f64 = PI / 180.0;

fn frames(texts: &[&str]) -> Vec<Frame> {
    (0..)
        .zip(texts)
        .map(|(k, text)| frame(text, f64::from(k) * 0.6))
        .collect()
}

fn assert_near(values: &[f64], expected: &[f64]) {
    assert_eq!(values.len(), expected.len());
    for (value, right) in values.iter().zip(expected) {
        assert!(
            (value - right).abs() < 1e-12,
            "{values:?} is not {expected:?}"
        );
    }
}

/// `v` turned by the unit quaternion `q`.
fn turned([w, x, y, z]: [f64; 4], v: [f64; 3]) -> [f64; 3] {
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        ]
    };
    let axis = [x, y, z];
    let once = cross(axis, v);
    let twice = cross(axis, once);
    [0, 1, 2].map(|k| v[k] + 2.0 * (w * once[k] + twice[k]))
}

#[test]
fn the_messages_of_a_period_are_one_reading() {
    let sent = frames(&[SLOPE, ACCELERATION, RATE]);
    let (readings, faults) = decode(&mut *listener("openimu", ALL, &[]), &sent);
    assert!(faults.is_empty(), "{faults:?}");
    assert_eq!(readings.len(), 1);
    assert_eq!(
        (readings[0].acquired, readings[0].stamp),
        (sent[0].t, sent[0].stamp)
    );
    assert_eq!(readings[0].quality, Quality::GOOD);
    assert_eq!(readings[0].device_time, Nanos::MIN);
    let imu = imu(&readings[0]);
    assert_near(&imu.proper_acceleration, &[1.5, -2.25, -9.75]);
    let rates = [10.5, -20.25, 100.125].map(|rate| rate * DEGREE);
    assert_near(&imu.angular_velocity, &rates);
    assert!(imu.magnetic_field.iter().all(|value| value.is_nan()));

    // Without a slope message; those that come do not matter.
    let (readings, faults) = decode(&mut *listener("openimu", "", &[]), &sent);
    assert!(faults.is_empty(), "{faults:?}");
    assert_eq!(readings[0].acquired, sent[1].t);
    assert!(crate::openimu::imu(&readings[0]).orientation[0].is_nan());
}

/// The world has z up: gravity's opposite, in the sensor's axes, follows from pitch and roll, and
/// the nose lies in the plane of x and z, up with a positive pitch.
#[test]
fn the_orientation_is_that_of_pitch_and_roll() {
    let keys = r#"quantities = ["orientation"]"#;
    let (readings, faults) = decode(&mut *listener("openimu", keys, &[]), &frames(&[SLOPE]));
    assert!(faults.is_empty(), "{faults:?}");
    let orientation = imu(&readings[0]).orientation;
    let (pitch, roll) = (5.25 * DEGREE, -30.5 * DEGREE);
    let nose = turned(orientation, [1.0, 0.0, 0.0]);
    assert_near(&nose, &[pitch.cos(), 0.0, pitch.sin()]);
    let up = [
        pitch.sin(),
        -roll.sin() * pitch.cos(),
        -roll.cos() * pitch.cos(),
    ];
    assert_near(&turned(orientation, up), &[0.0, 0.0, 1.0]);
    // Level: 250 deg / 2^-15 deg = 8192000.
    let level = "0CF02980#00007D00007DCC00";
    let (readings, _) = decode(&mut *listener("openimu", keys, &[]), &frames(&[level]));
    assert_near(&imu(&readings[0]).orientation, &[0.0, 1.0, 0.0, 0.0]);
}

#[test]
fn the_order_and_the_direction_of_the_axes_are_keys() {
    for (keys, acceleration, rate) in [
        (
            "axes = \"xyz\"",
            [2.25, -1.5, -9.75],
            [-20.25, 10.5, 100.125],
        ),
        (
            "acceleration_z = \"down\"",
            [1.5, 2.25, 9.75],
            [10.5, -20.25, 100.125],
        ),
        (
            "axes = \"xyz\"\nacceleration_z = \"down\"",
            [2.25, 1.5, 9.75],
            [-20.25, 10.5, 100.125],
        ),
    ] {
        let sent = frames(&[ACCELERATION, RATE]);
        let (readings, _) = decode(&mut *listener("openimu", keys, &[]), &sent);
        let read = imu(&readings[0]);
        assert_near(&read.proper_acceleration, &acceleration);
        assert_near(&read.angular_velocity, &rate.map(|rate| rate * DEGREE));
        let reading = Reading::Imu(read);
        let mut board = board("openimu", keys, &[]);
        let back = encode(&mut *board, 0, &reading, Quality::GOOD);
        assert_eq!(back[0].data(), sent[0].data(), "{keys}");
        assert_eq!(back[1].data()[..7], sent[1].data()[..7], "{keys}");
    }
}

/// The quality of a reading with these bytes in the messages.
fn quality(slope: &str, acceleration: &str, rate: &str) -> (Quality, [u32; 2]) {
    let sent = [
        format!("0CF02980#{slope}"),
        format!("08F02D80#{acceleration}"),
        format!("0CF02A80#{rate}"),
    ];
    let sent: Vec<&str> = sent.iter().map(String::as_str).collect();
    let (readings, faults) = decode(&mut *listener("openimu", ALL, &[]), &frames(&sent));
    assert_eq!(readings.len(), 1, "{faults:?}");
    let counts = [Counter::DeviceFault, Counter::Saturated].map(|c| count(&faults, c));
    (readings[0].quality, counts)
}

#[test]
fn a_merit_of_two_is_a_fault() {
    let flags = |slope: u8, acceleration: u8, rate: u8| {
        quality(
            &format!("00007D00007D{slope:02X}00"),
            &format!("007D007D007D{acceleration:02X}00"),
            &format!("007D007D007D{rate:02X}00"),
        )
    };
    let good = (Quality::GOOD, [0, 0]);
    let fault = (Quality::DEVICE_FAULT, [1, 0]);
    assert_eq!(flags(0, 0, 0), good);
    // Less accuracy, and not known.
    assert_eq!(flags(0x55, 0x55, 0x55), good);
    assert_eq!(flags(0xFF, 0xFF, 0xFF), good);
    for bit in [0, 2, 4, 6] {
        let error = 2 << bit;
        assert_eq!(
            flags(0, error, 0),
            if bit < 6 { fault } else { good },
            "{bit}"
        );
        assert_eq!(
            flags(0, 0, error),
            if bit < 6 { fault } else { good },
            "{bit}"
        );
        // Pitch and roll; the others say how they are compensated.
        let of_angle = matches!(bit, 2 | 6);
        assert_eq!(
            flags(error, 0, 0),
            if of_angle { fault } else { good },
            "{bit}"
        );
    }
}

#[test]
fn a_rate_at_its_limit_is_saturated() {
    let flags = |[a, b, c]: [&str; 3], merits: u8| {
        quality(
            "00007D00007DCC00",
            "007D007D007DBF00",
            &format!("{a}{b}{c}{merits:02X}00"),
        )
    };
    let at = |axis, end| Quality::GOOD.with_saturation(axis, end);
    let (high, low) = (Saturation::High, Saturation::Low);
    // 64000 is 250 deg/s; the order is y, x, z.
    assert_eq!(flags(["0000", "007D", "007D"], 0x3F), (at(4, low), [0, 1]));
    assert_eq!(flags(["007D", "00FA", "007D"], 0x3F), (at(3, high), [0, 1]));
    assert_eq!(flags(["007D", "007D", "FFFA"], 0x3F), (at(5, high), [0, 1]));
    assert_eq!(
        flags(["FFF9", "0100", "FFF9"], 0x3F),
        (Quality::GOOD, [0, 0])
    );
    // OpenIMU335RI calls a limited axis an error: it is saturated. Another is a fault.
    assert_eq!(flags(["0000", "007D", "007D"], 0x02), (at(4, low), [0, 1]));
    assert_eq!(flags(["007D", "00FA", "007D"], 0x08), (at(3, high), [0, 1]));
    let both = at(3, high) | Quality::DEVICE_FAULT;
    assert_eq!(flags(["007D", "00FA", "007D"], 0x02), (both, [1, 1]));
}

#[test]
fn a_value_that_is_none_is_no_reading() {
    let mut device = listener("openimu", ALL, &[]);
    for (message, at, length, most) in [
        ("0CF02980#00007D00007DCC00", 0, 3, 0xFA_FFFF_u32),
        ("0CF02980#00007D00007DCC00", 3, 3, 0xFA_FFFF),
        ("08F02D80#007D007D007DBF00", 0, 2, 0xFAFF),
        ("08F02D80#007D007D007DBF00", 2, 2, 0xFAFF),
        ("08F02D80#007D007D007DBF00", 4, 2, 0xFAFF),
        ("0CF02A80#007D007D007D3F00", 0, 2, 0xFAFF),
        ("0CF02A80#007D007D007D3F00", 2, 2, 0xFAFF),
        ("0CF02A80#007D007D007D3F00", 4, 2, 0xFAFF),
    ] {
        for (value, wrong) in [(most, 0), (most + 1, 1), ((1 << (8 * length)) - 1, 1)] {
            let good = frame(message, 0.0);
            let mut data = good.data().to_vec();
            data[at..at + length].copy_from_slice(&value.to_le_bytes()[..length]);
            let (_, faults) = decode(&mut *device, &[Frame::new(good.id, &data)]);
            assert_eq!(count(&faults, Counter::Value), wrong, "{message} {value:X}");
        }
    }
}

#[test]
fn only_the_messages_of_its_address_are_its_own() {
    let options = options("openimu", "");
    let mut device = options.device(&spec(0x91, Mode::Listen, &[])).unwrap();
    // Any priority, but no other page, source, group or kind of identifier.
    let sent = frames(&["18F02D91#007D007D007DBF00", "00F02A91#007D007D007D3F00"]);
    let (readings, _) = decode(&mut *device, &sent);
    assert_eq!(readings.len(), 1);
    let other = frames(&[
        "09F02D91#007D007D007DBF00",
        "0AF02A91#007D007D007D3F00",
        "08F02D80#007D007D007DBF00",
        "0CF02A80#007D007D007D3F00",
        "08F02E91#007D007D007DBF00",
        "0CF02991#00007D00007DCC00",
        "591#00",
    ]);
    let (readings, faults) = decode(&mut *device, &other);
    assert!(readings.is_empty() && faults.is_empty(), "{faults:?}");

    let claims = |address| {
        let device = options
            .device(&spec(address, Mode::Supervise, &[]))
            .unwrap();
        device.claims().to_vec()
    };
    let (mine, others) = (claims(0x91), claims(0x80));
    assert!(
        mine.iter()
            .all(|a| a.exclusive && others.iter().all(|b| !a.overlaps(b)))
    );
    for id in [0x0CF0_2991, 0x18F0_2D91, 0x00F0_2A91] {
        assert!(
            mine.iter().any(|claim| claim.matches(Id::extended(id))),
            "{id:08X}"
        );
    }
    for id in [0x0DF0_2991, 0x0CF0_2990, 0x0CF0_2B91] {
        assert!(
            !mine.iter().any(|claim| claim.matches(Id::extended(id))),
            "{id:08X}"
        );
    }
}

#[test]
fn wrong_lengths_and_formats_are_counted() {
    let mut device = listener("openimu", ALL, &[]);
    for id in [0x0CF0_2980, 0x08F0_2D80, 0x0CF0_2A80].map(Id::extended) {
        for length in 0..8 {
            let sent = Frame::new(id, &[0x7D; 8][..length]);
            let (readings, faults) = decode(&mut *device, &[sent]);
            assert!(readings.is_empty());
            assert_eq!(count(&faults, Counter::Length), 1);
        }
        let sent = [
            Frame::remote(id, 8),
            Frame::with_format(id, FD, &[0x7D; 8]).unwrap(),
            Frame::with_format(id, Format::Error, &[0x7D; 8]).unwrap(),
        ];
        let (readings, faults) = decode(&mut *device, &sent);
        assert!(readings.is_empty());
        assert_eq!(count(&faults, Counter::Length), 1);
        assert_eq!(count(&faults, Counter::Value), 1);
        assert_eq!(faults.len(), 2);
    }
}

/// The messages of periods 1 to 9, 10 ms each: `S` slope, `A` acceleration, `R` rate, without
/// `without` and with `late` at another time. All hold the number of the period: the pitch in
/// 2^-7 deg, the acceleration in 0.01 m/s^2, the rate in 2^-7 deg/s.
fn disturbed(without: &[&str], late: Option<(&str, f64)>) -> Vec<Frame> {
    let mut frames = Vec::new();
    for number in 1..10_u16 {
        for (k, letter) in [(0, 'S'), (1, 'A'), (2, 'R')] {
            let name = format!("{letter}{number}");
            if without.contains(&name.as_str()) {
                continue;
            }
            let usual = f64::from(number) + 0.06 * f64::from(k);
            let t = late
                .filter(|(other, _)| *other == name)
                .map_or(usual, |(_, t)| t);
            let [low, high] = (32000 + number).to_le_bytes();
            let (id, data) = match letter {
                'S' => (0x0CF0_2980, [0, low, high, 0, 0, 0x7D, 0xCC, 0]),
                'A' => (0x08F0_2D80, [low, high, low, high, low, high, 0xBF, 0]),
                _ => (0x0CF0_2A80, [low, high, low, high, low, high, 0x3F, 0]),
            };
            let t = Nanos::from_seconds(t * 0.01);
            frames.push(Frame::new(Id::extended(id), &data).at(t, StampKind::Software));
        }
    }
    frames.sort_by_key(|frame| frame.t);
    frames
}

/// The numbers of the readings, whether each follows a gap, and the readings that were dropped. All
/// messages of a reading must have its number.
fn numbers(frames: &[Frame]) -> (Vec<i64>, Vec<bool>, u32) {
    let (readings, faults) = decode(&mut *listener("openimu", ALL, &[]), frames);
    let (mut read, mut gaps) = (Vec::new(), Vec::new());
    for stamped in &readings {
        let Imu {
            proper_acceleration,
            angular_velocity,
            orientation,
            ..
        } = imu(stamped);
        // The nose's height is the sine of the pitch.
        let pitch = turned(orientation, [1.0, 0.0, 0.0])[2].asin() / DEGREE;
        let all = [
            pitch * 128.0,
            proper_acceleration[0] * 100.0,
            angular_velocity[2] / DEGREE * 128.0,
        ];
        #[allow(clippy::cast_possible_truncation)]
        let all = all.map(|number| number.round() as i64);
        assert!(
            all.iter().all(|number| *number == all[0]),
            "a reading of two periods: {all:?}"
        );
        read.push(all[0]);
        gaps.push(stamped.quality.contains(Quality::GAP_BEFORE));
    }
    (read, gaps, count(&faults, Counter::Unpaired))
}

#[test]
fn a_reading_is_never_of_two_periods() {
    let cases: [(&[&str], &[i64], u32); 6] = [
        (&[], &[1, 2, 3, 4, 5, 6, 7, 8, 9], 0),
        (&["S4"], &[1, 2, 3, 5, 6, 7, 8, 9], 1),
        (&["A4"], &[1, 2, 3, 6, 7, 8, 9], 2),
        (&["R4"], &[1, 2, 3, 6, 7, 8, 9], 2),
        (&["A4", "R4", "S5"], &[1, 2, 3, 6, 7, 8, 9], 1),
        (&["R4", "S5", "A5"], &[1, 2, 3, 6, 7, 8, 9], 1),
    ];
    for (without, expected, dropped) in cases {
        let (read, gaps, in_part) = numbers(&disturbed(without, None));
        assert_eq!(
            (read.as_slice(), in_part),
            (expected, dropped),
            "without {without:?}"
        );
        let jumps: Vec<bool> = (read.iter().zip([0].iter().chain(&read)))
            .map(|(number, last)| *number != last + 1)
            .collect();
        assert_eq!(gaps, jumps, "without {without:?}");
    }
    for late in ["S4", "A4", "R4"] {
        for t in [4.3, 4.6, 4.99, 5.03, 5.09, 5.2, 5.6] {
            let (read, ..) = numbers(&disturbed(&[], Some((late, t))));
            assert!(read.len() >= 6, "{late} at {t}: {read:?}");
        }
    }
    // Again, at once and in the next period.
    for (again, t) in [
        (9, 4.02),
        (10, 4.08),
        (11, 4.14),
        (9, 5.02),
        (10, 5.08),
        (11, 5.14),
    ] {
        let mut frames = disturbed(&[], None);
        let t = Nanos::from_seconds(t * 0.01);
        frames.push(frames[again].at(t, StampKind::Software));
        frames.sort_by_key(|frame| frame.t);
        let (read, ..) = numbers(&frames);
        assert!(read.len() >= 7, "{again}: {read:?}");
    }
}

/// After a restart of the link a half reading is forgotten, and not counted.
#[test]
fn a_restart_begins_anew() {
    let mut device = listener("openimu", "", &[]);
    decode(&mut *device, &frames(&[ACCELERATION]));
    device.restart(Nanos::from_millis(5));
    let sent = [
        frame(RATE, 0.2),
        frame(ACCELERATION, 10.0),
        frame(RATE, 10.6),
    ];
    let (readings, faults) = decode(&mut *device, &sent);
    assert!(faults.is_empty(), "{faults:?}");
    assert_eq!((readings.len(), readings[0].acquired), (1, sent[1].t));
}

fn at_rest() -> (u8, Reading) {
    let imu = Imu {
        proper_acceleration: [0.0, 0.0, -9.81],
        angular_velocity: [0.5, 0.0, -0.25],
        orientation: [0.0, 1.0, 0.0, 0.0],
        ..Imu::ABSENT
    };
    (0, Reading::Imu(imu))
}

#[test]
fn a_sensor_is_told_what_to_send_watched_and_stopped() {
    let mut rig = Rig::new("openimu", "period_ms = 20", &[], at_rest());
    rig.run(100);
    let start = ["18FF56F9#8006000000", "18FF55F9#8002"];
    assert_eq!(rig.sent, start);
    assert_eq!(
        (rig.device.state(), rig.readings.len()),
        (State::Streaming, 5)
    );
    let read = imu(&rig.readings[0]);
    assert!((read.proper_acceleration[2] + 9.81).abs() < 0.005);
    assert!(read.orientation[0].is_nan());
    rig.board_loses = Box::new(|_, _| true);
    rig.run(100);
    assert_eq!(rig.count(Counter::Silences), 1);
    assert!(rig.states.contains(&State::Silent));
    assert_eq!(rig.sent[2..4], start);
    rig.board_loses = Box::new(|_, _| false);
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
    assert!(rig.readings[5].quality.contains(Quality::GAP_BEFORE));
    assert!(!rig.readings[6].quality.contains(Quality::GAP_BEFORE));
    assert_eq!(rig.count(Counter::Unpaired), 0);
    let before = rig.readings.len();
    rig.device.restart(rig.now);
    rig.run(100);
    assert_eq!(rig.sent[4..], start);
    assert!(rig.readings[before].quality.contains(Quality::GAP_BEFORE));
    rig.device.stop(rig.now);
    rig.run(30);
    assert_eq!(rig.sent.last().unwrap(), "18FF55F9#8000");
    assert_eq!(
        (rig.device.state(), rig.board.period()),
        (State::Stopped, None)
    );
}

/// It sends what it was configured for until it is told.
#[test]
fn a_command_that_is_lost_leaves_the_rate_of_delivery() {
    let keys = "quantities = [\"acceleration\"]\nperiod_ms = 50";
    let mut rig = Rig::with_board("openimu", keys, ALL, &[], at_rest());
    rig.host_loses = Box::new(|_, _| true);
    rig.run(100);
    assert_eq!(rig.board.period(), Some(Nanos::from_millis(10)));
    assert_eq!((rig.readings.len(), rig.received), (10, 30));
    rig.host_loses = Box::new(|_, _| false);
    rig.device.restart(rig.now);
    rig.run(100);
    assert_eq!(rig.sent[2..], ["18FF56F9#8004000000", "18FF55F9#8005"]);
    assert_eq!(rig.board.period(), Some(Nanos::from_millis(50)));
    assert_eq!(rig.received, 32);
    assert!(
        rig.faults
            .iter()
            .all(|fault| fault.counter == Counter::Starts)
    );

    // One that listens says nothing; another program has set the rate.
    let mut rig = Rig::started("openimu", keys, Mode::Listen, at_rest());
    rig.run(200);
    assert_eq!((rig.readings.len(), rig.sent.len()), (4, 0));
}

#[test]
fn a_sensor_that_is_not_there_is_silent_and_told_again() {
    let mut rig = Rig::new("openimu", "", &[], at_rest());
    rig.board_loses = Box::new(|_, _| true);
    rig.run(15_000);
    assert_eq!(rig.device.state(), State::Silent);
    assert!((10..=20).contains(&rig.sent.len()), "{}", rig.sent.len());
}

/// A sensor obeys no command for another, and none in another form.
#[test]
fn commands_name_their_sensor() {
    let mut board = board("openimu", ALL, &[]);
    let mut tell = |text: &str| {
        let mut answers = Frames::new();
        board.on_frame(&frame(text, 0.0), &mut answers);
        assert!(answers.is_empty());
        let mut sent = Frames::new();
        board
            .encode(0, &at_rest().1, Quality::GOOD, &mut sent)
            .unwrap();
        let periods = board.period().map(|period| period.0 / 10_000_000);
        (sent.len(), periods)
    };
    assert_eq!(tell("18FF56F9#8106"), (3, Some(1)));
    assert_eq!(tell("18FF55F9#8105"), (3, Some(1)));
    assert_eq!(tell("18FF55F9#80"), (3, Some(1)));
    assert_eq!(tell("19FF55F9#8005"), (3, Some(1)));
    assert_eq!(tell("18FF5500#80050000"), (3, Some(5)));
    assert_eq!(tell("18FF5600#800100"), (1, Some(5)));
    assert_eq!(tell("18FF5601#8000"), (0, Some(5)));
    assert_eq!(tell("18FF5501#8000"), (0, None));
    let id = Id::extended(0x18FF_5500);
    for other in [
        Frame::remote(id, 2),
        Frame::with_format(id, FD, &[0x80, 5]).unwrap(),
    ] {
        board.on_frame(&other, &mut Frames::new());
        assert_eq!(board.period(), None);
    }
}

#[test]
fn the_sensor_limits_what_it_sends() {
    let imu = Imu {
        proper_acceleration: [1e9, 1e9, 1e9],
        angular_velocity: [1e3, -1e3, 5.0],
        orientation: [0.0, 1.0, 0.0, 0.0],
        ..Imu::ABSENT
    };
    let texts = |quality| {
        let sent = encode(
            &mut *board("openimu", ALL, &[]),
            0,
            &Reading::Imu(imu),
            quality,
        );
        sent.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    // 5 rad/s is 286 deg/s.
    assert_eq!(
        texts(Quality::GOOD),
        [
            "0CF02980#00007D00007DCC00",
            "08F02D80#0000FFFA0000BF00",
            "0CF02A80#000000FA00FA3F00",
        ]
    );
    // Marks and faults, in the order y, x, z.
    let at = |axis, end| Quality::GOOD.with_saturation(axis, end);
    let quality = at(5, Saturation::Low) | at(4, Saturation::High) | Quality::DEVICE_FAULT;
    assert_eq!(
        texts(quality),
        [
            "0CF02980#00007D00007D8800",
            "08F02D80#0000FFFA0000AA00",
            "0CF02A80#00FA00FA00002A00",
        ]
    );
}

#[test]
fn what_a_sensor_cannot_send_is_refused() {
    let mut out = Frames::new();
    let mut board = board("openimu", ALL, &[]);
    let mut refused = |output, reading: &Reading| {
        let refused = board
            .encode(output, reading, Quality::GOOD, &mut out)
            .unwrap_err();
        assert!(out.is_empty());
        refused
    };
    let temperature = Reading::Temperature(Temperature { celsius: 20.0 });
    assert_eq!(refused(0, &temperature), EncodeError::Kind);
    assert_eq!(refused(1, &at_rest().1), EncodeError::Output(1));
    let Reading::Imu(good) = at_rest().1 else {
        unreachable!()
    };
    for bad in [
        Imu {
            proper_acceleration: [f64::NAN; 3],
            ..good
        },
        Imu {
            angular_velocity: [0.0, f64::INFINITY, 0.0],
            ..good
        },
        Imu {
            orientation: [f64::NAN; 4],
            ..good
        },
    ] {
        assert_eq!(refused(0, &Reading::Imu(bad)), EncodeError::NotFinite);
    }
}

#[test]
fn wrong_keys_are_refused() {
    let refused = |keys: &str, address| {
        let spec = spec(address, Mode::Listen, &[]);
        let options = options("openimu", keys);
        let of_device = options.device(&spec).map(|_| ()).unwrap_err();
        let of_board = options.board(&spec).map(|_| ()).unwrap_err();
        assert_eq!(of_device, of_board);
        of_device
    };
    let (least, most) = (0x80, 0xF7);
    for address in [0, 0x7F, 0xF8, 0x180] {
        assert_eq!(
            refused("", address),
            SpecError::Address {
                address,
                least,
                most
            }
        );
    }
    for address in [least, most] {
        assert!(
            options("openimu", "")
                .device(&spec(address, Mode::Listen, &[]))
                .is_ok()
        );
    }
    assert_eq!(
        refused("quantities = []", 0x80).to_string(),
        "quantities must be a list with at least one quantity"
    );
    for period in [0, 5, 15, 30, 1000] {
        let error = refused(&format!("period_ms = {period}"), 0x80).to_string();
        assert!(
            error.starts_with(&format!("period_ms = {period} must be 10, 20, 40")),
            "{error}"
        );
    }
    for period in [10, 20, 40, 50, 100, 200, 250, 500] {
        let keys = format!("period_ms = {period}");
        let board = options("openimu", &keys)
            .board(&spec(0x80, Mode::Listen, &[]))
            .unwrap();
        assert_eq!(board.period(), Some(Nanos::from_millis(period)));
    }
}

/// Half a step plus floating-point rounding.
fn near(a: f64, b: f64, step: f64) -> bool {
    (a - b).abs() <= step * 0.5 + 1e-12 * (a.abs() + b.abs())
}

proptest! {
    #[test]
    fn readings_are_read_back(
        acceleration in uniform3(-319.9_f64..319.9), rate in uniform3(-4.36_f64..4.36),
        pitch in -85.0_f64..85.0, roll in -179.9_f64..179.9, heading in -PI..PI,
        fault: bool, swapped: bool, down: bool,
    ) {
        let keys = format!(
            "{ALL}\naxes = \"{}\"\nacceleration_z = \"{}\"",
            if swapped { "yxz" } else { "xyz" }, if down { "down" } else { "up" },
        );
        // Heading about z up, then pitch and roll, then half a turn about x, as a product.
        let product = |[a, b, c, d]: [f64; 4], [e, f, g, h]: [f64; 4]| [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ];
        let half = |angle: f64| (angle / 2.0).sin_cos();
        let (sin, cos) = half(heading);
        let about_z = [cos, 0.0, 0.0, sin];
        let (sin, cos) = half(pitch * DEGREE);
        let about_y = [cos, 0.0, sin, 0.0];
        let (sin, cos) = half(roll * DEGREE);
        let about_x = [cos, sin, 0.0, 0.0];
        let level = product([0.0, 1.0, 0.0, 0.0], product(about_y, about_x));
        let imu_sent = Imu {
            proper_acceleration: acceleration, angular_velocity: rate,
            orientation: product(about_z, level), ..Imu::ABSENT
        };
        let quality = if fault { Quality::DEVICE_FAULT } else { Quality::GOOD };
        let sent = encode(&mut *board("openimu", &keys, &[]), 0, &Reading::Imu(imu_sent), quality);
        let (readings, _) = decode(&mut *listener("openimu", &keys, &[]), &sent);
        prop_assert_eq!(readings.len(), 1);
        prop_assert_eq!(readings[0].quality, quality);
        let back = imu(&readings[0]);
        for axis in 0..3 {
            prop_assert!(near(back.proper_acceleration[axis], acceleration[axis], 0.01));
            prop_assert!(near(back.angular_velocity[axis], rate[axis], DEGREE / 128.0));
        }
        // The heading is lost; half a step of both angles is 5e-7 rad.
        for (a, b) in back.orientation.into_iter().zip(level) {
            prop_assert!((a - b).abs() < 6e-7, "{:?} {:?}", back.orientation, level);
        }
    }

    /// What is encoded from a decoded reading is the message that it came from.
    #[test]
    fn messages_are_encoded_back(counts in proptest::array::uniform6(1_u16..64000)) {
        let [a, b, c, d, e, f] = counts.map(u16::to_le_bytes);
        let sent = [
            (0x08F0_2D80, [a, b, c, [0xBF, 0]]),
            (0x0CF0_2A80, [d, e, f, [0x3F, 0]]),
        ]
        .map(|(id, data)| Frame::new(Id::extended(id), data.as_flattened()));
        let (readings, _) = decode(&mut *listener("openimu", "", &[]), &sent);
        let mut board = board("openimu", "", &[]);
        let back = encode(&mut *board, 0, &readings[0].reading, Quality::GOOD);
        prop_assert_eq!(back, sent);
    }
}
