//! VESC motor controllers: frames of their own firmware, speed and current that join the positions,
//! the direction of a current, and thermometers that are not there.

use crate::rig::{
    Rig, board, decode, encode, frame, joints, listener, options, refused, shown_keys, spec,
    takes_eight_bytes, temperatures, texts,
};
use proprio_drivers::State;
use proprio_drivers::{Claim, Device, EncodeError, Frame, Frames, Id, Mode, StampedReading};
use proprio_topics::{Actuator, Counter, JointState, Nanos, Quality, Reading, Temperature};
use proptest::prelude::*;
use std::f64::consts::TAU;

/// Values, and the frames that the firmware makes of them: address, speed \[erpm\], current \[A\]
/// along the shaft's axis, duty, temperatures of FET and motor, position \[deg\], tachometer;
/// status 1, 4, 5, 2, 3, 6. Made with the firmware's own functions `comm_can_send_status1` to `6`,
/// `utils_norm_angle` and `util/buffer.c` (vedderb/bldc b9d287b3) for arbitrary values; the sign of
/// the current is that of `mcpwm_foc_get_tot_current_filtered`.
const FRAMES: &str = include_str!("vesc.txt");

const PID: &str = "pole_pairs = 7";
const TACHOMETER: &str = "pole_pairs = 7\nposition = \"tachometer\"";

fn controller(keys: &str, address: u32) -> Box<dyn Device> {
    options("vesc", keys)
        .device(&spec(address, Mode::Supervise, &[0]))
        .expect("a legal configuration")
}

fn near(a: f64, b: f64, within: f64) -> bool {
    (a - b).abs() <= within
}

/// The firmware cuts what is below a step.
#[test]
fn frames_of_the_firmware_are_read() {
    let mut seen = 0;
    for line in FRAMES.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        let numbers: Vec<f64> = words[..8].iter().map(|w| w.parse().unwrap()).collect();
        let [address, erpm, current, duty, fet, motor, degrees, count] = numbers[..] else {
            panic!("{line}");
        };
        let frames: Vec<Frame> = words[8..].iter().map(|text| frame(text, 0.0)).collect();
        for tachometer in [false, true] {
            let keys = if tachometer { TACHOMETER } else { PID };
            let keys = format!("{keys}\ngear_ratio = 2.0\ntorque_constant = 0.5");
            let (readings, faults) = decode(&mut *controller(&keys, address as u32), &frames);
            assert!(faults.is_empty(), "{line}: {faults:?}");
            let [(joint, _)] = joints(&readings)[..] else {
                panic!("{line}: {readings:?}");
            };
            let (position, step) = if tachometer {
                (count / 6.0 * TAU / 14.0, 0.0)
            } else {
                (degrees.to_radians(), TAU / 18_000.0)
            };
            assert!(near(joint.position, position, step + 1e-6), "{line}");
            let rad_per_s = TAU / 60.0 / 14.0;
            assert!(
                near(joint.velocity, erpm * rad_per_s, rad_per_s * 1.001),
                "{line}"
            );
            assert!(near(joint.current, current, 0.1), "{line}: {joint:?}");
            assert_eq!(joint.torque, 0.5 * joint.current);
            assert!(joint.acceleration.is_nan());
            let Reading::Actuator(told) = readings[0].reading else {
                panic!("{line}: {readings:?}");
            };
            assert!(near(told.duty, duty, 1e-3) && told.faults == 0, "{line}");
            let warmth = temperatures(&readings);
            assert!(warmth[0].0 == 2 && near(warmth[0].1, fet, 0.1), "{line}");
            // Motor -87.1: a thermometer that is not there.
            assert_eq!(warmth.len(), if motor < -40.0 { 1 } else { 2 }, "{line}");
            if let Some(&(output, celsius)) = warmth.get(1) {
                assert!(output == 1 && near(celsius, motor, 0.1), "{line}");
            }
        }
        seen += 1;
    }
    assert_eq!(seen, 24);
}

/// A controller's frames that rkyrlach/python-try shows (`can-test1.py`): 28.2 deg at the FETs, no
/// thermometer, 127.78 deg; 150 steps of the tachometer, 23.9 V.
#[test]
fn frames_that_somebody_recorded_are_read() {
    let frames = [
        frame("00001001#011AFC99000018F5", 0.0),
        frame("00001B01#0000009600EF0000", 0.1),
    ];
    let (readings, _) = decode(&mut *controller(PID, 1), &frames);
    let [(2, fet)] = temperatures(&readings)[..] else {
        panic!("{readings:?}");
    };
    assert!(near(fet, 28.2, 1e-9));
    assert!(near(
        joints(&readings)[0].0.position,
        127.78_f64.to_radians(),
        1e-12
    ));
    let (readings, _) = decode(&mut *controller(TACHOMETER, 1), &frames);
    assert!(near(
        joints(&readings)[0].0.position,
        25.0 * TAU / 7.0,
        1e-12
    ));
}

/// Positive drives the motor, whichever way it turns.
#[test]
fn a_current_has_the_direction_of_the_duty_cycle() {
    let position = frame("00001001#00FA00FA00000000", 0.1);
    for (status, current) in [
        ("00000901#00000064000A0064", 1.0),
        ("00000901#00000064FFF60064", -1.0),
        ("00000901#FFFFFF9C000AFF9C", -1.0),
        ("00000901#FFFFFF9CFFF6FF9C", 1.0),
        // Which way a motor holds that needs less than a thousandth of the voltage is not told.
        ("00000901#00000000000A0000", f64::NAN),
        ("00000901#0000000000000000", 0.0),
        ("00000901#000000000000FF9C", 0.0),
    ] {
        let keys = format!("{PID}\ntorque_constant = 0.25");
        let frames = [frame(status, 0.0), position];
        let (readings, _) = decode(&mut *controller(&keys, 1), &frames);
        let joint = joints(&readings)[0].0;
        assert_eq!(
            joint.current.total_cmp(&current),
            std::cmp::Ordering::Equal,
            "{status}"
        );
        assert_eq!(joint.torque.is_nan(), current.is_nan());
        assert!(current.is_nan() || joint.torque == 0.25 * current);
        assert!(!joint.velocity.is_nan());
        let (readings, _) = decode(&mut *controller(PID, 1), &frames);
        assert!(joints(&readings)[0].0.torque.is_nan());
    }
}

#[test]
fn speed_and_current_join_the_positions_for_a_while() {
    let status = frame("00000901#00000064000A0064", 10.0);
    let position = |ms| frame("00001001#00FA00FA00000000", ms);
    let mut device = controller("pole_pairs = 7\nhold_ms = 30", 1);
    let mut joined = |frame: Frame| joints(&decode(&mut *device, &[frame]).0)[0].0;
    let absent = |joint: JointState| joint.velocity.is_nan() && joint.current.is_nan();
    assert!(absent(joined(position(5.0))));
    let mut device = controller("pole_pairs = 7\nhold_ms = 30", 1);
    let mut joined = |frame: Frame| joints(&decode(&mut *device, &[status, frame]).0)[0].0;
    assert_eq!(joined(position(40.0)).current, 1.0);
    assert!(absent(joined(position(40.5))));
    // After a start, nothing of before is used.
    let mut device = controller(PID, 1);
    decode(&mut *device, &[status]);
    device.restart(Nanos::from_millis(20));
    let (readings, _) = decode(&mut *device, &[position(21.0)]);
    assert!(absent(joints(&readings)[0].0));
}

#[test]
fn frames_that_are_none_of_the_protocol_are_counted() {
    for command in [0x0901, 0x1001, 0x1B01] {
        let id = Id::extended(command);
        for keys in [PID, TACHOMETER] {
            let mut device = controller(keys, 1);
            takes_eight_bytes(&mut *device, id, 0);
        }
    }
    // Commands, other messages, other controllers, the same number as a standard identifier.
    let mut device = controller(PID, 1);
    for other in [0x0001, 0x0301, 0x0E01, 0x3A01, 0x0902, 0x1000].map(Id::extended) {
        let (readings, faults) = decode(&mut *device, &[Frame::new(other, &[0; 8])]);
        assert!(readings.is_empty() && faults.is_empty(), "{other}");
    }
    let claims = [0x0901, 0x1001, 0x1B01].map(|id| Claim::exclusive(Id::extended(id)));
    assert_eq!(device.claims(), claims);
}

#[test]
fn nothing_is_sent() {
    let keys = shown_keys(include_str!("../../../docs/book/src/devices/vesc.md"));
    assert!(keys.contains("gear_ratio"));
    let still = Reading::Joint(JointState {
        position: 1.0,
        velocity: 0.0,
        ..JointState::ABSENT
    });
    let mut rig = Rig::new("vesc", &format!("{keys}\n"), &[0], (0, still));
    rig.run(1000);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(joints(&rig.readings).len(), 50);
    rig.board_loses = Box::new(|_, _| true);
    rig.run(100);
    assert_eq!(rig.device.state(), State::Silent);
    assert_eq!(rig.count(Counter::Silences), 1);
    rig.board_loses = Box::new(|_, _| false);
    let before = rig.readings.len();
    rig.run(100);
    let is_gap = |stamped: &&StampedReading| stamped.quality.contains(Quality::GAP_BEFORE);
    assert_eq!(rig.readings[before..].iter().filter(is_gap).count(), 1);
    rig.device.stop(rig.now);
    rig.run(10);
    assert_eq!(rig.device.state(), State::Stopped);
    assert_eq!(rig.sent, [""; 0]);
}

#[test]
fn wrong_keys_are_refused() {
    let refused = |keys: &str, address| refused("vesc", keys, address);
    assert_eq!(refused("", 1), "pole_pairs");
    assert_eq!(refused(PID, 255), "0 to 254");
    for (keys, key) in [
        ("gear_ratio = 0.0", "gear_ratio"),
        ("gear_ratio = nan", "gear_ratio"),
        ("torque_constant = -1.0", "torque_constant"),
        ("hold_ms = 0", "hold_ms"),
        ("hold_ms = 60001", "hold_ms"),
        ("period_ms = 0", "period_ms"),
    ] {
        assert_eq!(refused(&format!("{PID}\n{keys}"), 1), key);
    }
    assert_eq!(refused("pole_pairs = 0", 1), "pole_pairs");
    for address in [0, 254] {
        controller(PID, address);
    }
}

#[test]
fn a_simulated_controller_sends_what_it_is_given() {
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
    let keys = "pole_pairs = 10\ntorque_constant = 2.0";
    let mut pid = board("vesc", keys, &[0]);
    let mut send = |output, reading: &Reading| texts(&encode(&mut *pid, output, reading, good));
    // A quarter back from 0; one turn per second is 600 electrical turns per minute.
    let back = reading(-TAU / 4.0, -TAU, 8.0, 1.5);
    let sent = ["00000901#FFFFFDA8000F0001", "00001001#00FA00FA000034BC"];
    assert_eq!(send(0, &back), sent);
    let derived = reading(3.0 * TAU, 0.0, -4.0, absent);
    let sent = ["00000901#000000000014FFFF", "00001001#00FA00FA00000000"];
    assert_eq!(send(0, &derived), sent);
    let duty = Reading::Actuator(Actuator {
        duty: -0.25,
        mode: 0,
        encoder: 0,
        faults: 0,
    });
    assert_eq!(send(0, &duty), [""; 0]);
    assert_eq!(send(0, &derived)[0], "00000901#000000000014FF06");
    let none = reading(0.0, 0.0, absent, absent);
    assert_eq!(send(0, &none)[0], "00000901#000000000000FF06");
    let temperature = |celsius| Reading::Temperature(Temperature { celsius });
    assert_eq!(send(1, &temperature(80.5)), [""; 0]);
    assert_eq!(send(2, &temperature(-20.0)), [""; 0]);
    assert_eq!(send(0, &none)[1], "00001001#FF38032500000000");

    let mut counter = board("vesc", TACHOMETER, &[0]);
    let mut send = |output, reading: &Reading| texts(&encode(&mut *counter, output, reading, good));
    let far = reading(-100.0 * TAU, 0.0, absent, absent);
    let sent = ["00000901#0000000000000000", "00001B01#FFFFEF9800000000"];
    assert_eq!(send(0, &far), sent);
    assert_eq!(send(1, &temperature(80.5)), ["00001001#00FA032500000000"]);
    let mut out = Frames::new();
    for (output, reading, error) in [
        (0, reading(absent, 0.0, 0.0, 0.0), EncodeError::NotFinite),
        (0, reading(0.0, absent, 0.0, 0.0), EncodeError::NotFinite),
        (1, temperature(absent), EncodeError::NotFinite),
        (2, none, EncodeError::Kind),
        (0, temperature(1.0), EncodeError::Kind),
        (3, none, EncodeError::Output(3)),
    ] {
        assert_eq!(counter.encode(output, &reading, good, &mut out), Err(error));
    }
}

proptest! {
    #[test]
    fn readings_come_back(
        p in -50.0_f64..50.0, v in -900.0_f64..900.0, i in -300.0_f64..300.0,
        duty in -1.0_f64..1.0,
    ) {
        for keys in [PID, TACHOMETER] {
            let state = JointState {
                position: p, velocity: v, current: i, ..JointState::ABSENT
            };
            let mut board = board("vesc", keys, &[0]);
            let actuator = Actuator { duty, mode: 0, encoder: 0, faults: 0 };
            encode(&mut *board, 0, &Reading::Actuator(actuator), Quality::GOOD);
            let frames = encode(&mut *board, 0, &Reading::Joint(state), Quality::GOOD);
            let (readings, faults) = decode(&mut *listener("vesc", keys, &[0]), &frames);
            prop_assert!(faults.is_empty());
            let back = joints(&readings)[0].0;
            let (expected, step) = match keys {
                PID => (p.rem_euclid(TAU), TAU / 18_000.0),
                _ => (p, TAU / 42.0),
            };
            let off = (back.position - expected).abs();
            prop_assert!(off.min(TAU - off) <= step * 0.5 + 1e-9);
            prop_assert!((0.0..TAU).contains(&back.position) || keys == TACHOMETER);
            prop_assert!((back.velocity - v).abs() <= TAU / 840.0 + 1e-9);
            prop_assert!((back.current - i).abs() <= 0.05 + 1e-9);
        }
    }
}
