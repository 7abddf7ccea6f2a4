//! iCub mc4 boards: frames computed by hand from the host's formulas, velocities that join the
//! positions, and faults of each joint.

use crate::rig::{
    FD, Rig, board, count, decode, encode, frame, listener, options, shown_keys, spec,
};
use proprio_drivers::{Claim, EncodeError, Frame, Frames, Id, Mode, SpecError, StampedReading};
use proprio_drivers::{State, icub_mc4::fault};
use proprio_topics::{Actuator, Counter, JointState, Quality, Reading};
use proptest::prelude::*;
use std::f64::consts::TAU;

/// One turn of joint 0, minus a quarter of a turn of joint 1 (4096 ticks per turn).
const POSITIONS: &str = "111#0000010000FCFFFF";
const KEYS: &str = "ticks_per_turn = [65536.0, 4096.0]\nvelocity_shift = [5, 3]";

fn joint(stamped: &StampedReading) -> JointState {
    match stamped.reading {
        Reading::Joint(joint) => joint,
        _ => panic!("{stamped:?}"),
    }
}

fn near(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-12 * b.abs().max(1.0)
}

/// icub-main: ticks/s = 1000 x steps / 2^shift. 64 steps of joint 0 are 2000 ticks/s, -16 of joint
/// 1 are -2000; the accelerations are not read.
#[test]
fn positions_and_velocities_are_those_of_the_host() {
    let mut device = listener("icub_mc4", KEYS, &[0, 1]);
    let frames = [frame("117#4000F0FF11112222", 0.0), frame(POSITIONS, 1.0)];
    let (readings, faults) = decode(&mut *device, &frames);
    assert!(faults.is_empty(), "{faults:?}");
    let expected = [
        (TAU, 2000.0 * TAU / 65536.0),
        (-TAU / 4.0, -2000.0 * TAU / 4096.0),
    ];
    assert_eq!(readings.len(), 2);
    for ((stamped, right), number) in readings.iter().zip(expected).zip(0..) {
        let joint = joint(stamped);
        assert_eq!(
            (stamped.output, stamped.quality, stamped.acquired),
            (number, Quality::GOOD, frames[1].t)
        );
        assert!(
            near(joint.position, right.0) && near(joint.velocity, right.1),
            "{joint:?}"
        );
        assert!(joint.acceleration.is_nan() && joint.torque.is_nan() && joint.current.is_nan());
    }
    let mut largest = listener("icub_mc4", "", &[0, 1]);
    let frames = [
        frame("117#FF7F008000000000", 0.0),
        frame("111#FFFFFF7F00000080", 0.0),
    ];
    let (readings, _) = decode(&mut *largest, &frames);
    let [a, b] = [0, 1].map(|n| joint(&readings[n]));
    assert!(near(a.position, 2_147_483_647.0 / 65536.0 * TAU));
    assert!(near(b.position, -32768.0 * TAU));
    assert!(near(a.velocity, 32767.0 * 1000.0 / 32.0 / 65536.0 * TAU));
    assert!(near(b.velocity, -32768.0 * 1000.0 / 32.0 / 65536.0 * TAU));
}

#[test]
fn a_velocity_is_held_and_then_absent() {
    let mut device = listener("icub_mc4", "hold_ms = 20", &[0, 1]);
    let frames = [
        frame(POSITIONS, 0.0),
        frame("117#0100010000000000", 1.0),
        frame(POSITIONS, 1.0),
        frame(POSITIONS, 21.0),
        frame(POSITIONS, 21.1),
        frame("117#0100010000000000", 30.0),
        frame(POSITIONS, 29.0),
    ];
    let (readings, _) = decode(&mut *device, &frames);
    let present: Vec<bool> = (readings.iter())
        .map(|r| !joint(r).velocity.is_nan())
        .collect();
    let each = [false, true, true, false, false];
    let expected: Vec<bool> = each.into_iter().flat_map(|known| [known; 2]).collect();
    assert_eq!(present, expected);
}

/// A joint that no configuration names is not read, nor is its state.
#[test]
fn only_joints_in_use_are_read() {
    for output in [0, 1] {
        let mut device = listener("icub_mc4", KEYS, &[output]);
        let frames = [frame(POSITIONS, 0.0), frame("113#1000100000000000", 1.0)];
        let (readings, _) = decode(&mut *device, &frames);
        let outputs: Vec<u8> = readings.iter().map(|r| r.output).collect();
        assert_eq!(outputs, [output; 2]);
    }
    let claims = |driver: &str, outputs: &[u8], address| {
        let device = options(driver, "")
            .device(&spec(address, Mode::Listen, outputs))
            .unwrap();
        device.claims().to_vec()
    };
    let ids = [0x1D1, 0x1D3, 0x1D7].map(|id| Claim::exclusive(Id::standard(id)));
    assert_eq!(claims("icub_mc4", &[0], 13), ids);
    // A 2FOC board has no such streams, but for the status.
    let other = claims("icub_motor", &[0], 13);
    let shared = other.iter().filter(|a| ids.iter().any(|b| a.overlaps(b)));
    assert_eq!(shared.count(), 1);
}

/// Faults of joint 0 in the first byte, of joint 1 in the third; of the board in the sixth.
#[test]
fn faults_belong_to_their_joint() {
    let (doubt, drive, zero) = (
        Quality::DEVICE_FAULT,
        Quality::DRIVE_FAULT,
        Quality::NOT_CALIBRATED,
    );
    let good = Quality::GOOD;
    for (status, qualities, faults) in [
        ("0001000100000000", [good, good], [0, 0]),
        ("0001000100000700", [good, good], [0, 0]),
        ("00010001FF000000", [good, good], [0, 0]),
        ("0101000100000000", [drive, good], [1, 0]),
        ("0201040100000000", [drive, drive], [2, 4]),
        ("0801800100000000", [drive, drive], [8, 128]),
        ("1001200100000000", [doubt, doubt], [16, 32]),
        ("4001480100000000", [doubt, doubt | drive], [64, 72]),
        ("0001000100010000", [good, good], [0, 0]),
        ("0001000100020000", [drive, good], [0x200, 0]),
        ("0001000100040000", [good, drive], [0, 0x400]),
        ("0001000100080000", [drive, good], [0x800, 0]),
        ("0001000100100000", [good, drive], [0, 0x1000]),
        ("0001000100E00000", [good, good], [0, 0]),
        ("00A0000100000000", [drive, good], [0, 0]),
        ("000100B000000000", [good, zero], [0, 0]),
        ("2060000100000000", [doubt | zero, good], [32, 0]),
    ] {
        let mut device = listener("icub_mc4", "", &[0, 1]);
        let frames = [frame(&format!("113#{status}"), 0.0), frame(POSITIONS, 1.0)];
        let (readings, counted) = decode(&mut *device, &frames);
        assert_eq!(readings.len(), 4);
        let read: Vec<Quality> = readings.iter().map(|r| r.quality).collect();
        assert_eq!(read, [qualities, qualities].concat(), "{status}");
        for (flag, counter) in [(doubt, Counter::DeviceFault), (drive, Counter::DriveFault)] {
            let faulty = qualities.iter().filter(|q| q.contains(flag)).count();
            assert_eq!(count(&counted, counter), faulty as u32, "{status}");
        }
        for (number, stamped) in readings[..2].iter().enumerate() {
            let Reading::Actuator(actuator) = stamped.reading else {
                panic!("{stamped:?}");
            };
            let mode = u32::from_str_radix(&status[4 * number + 2..4 * number + 4], 16);
            assert_eq!(
                (usize::from(stamped.output), Ok(actuator.mode)),
                (number, mode)
            );
            assert_eq!(actuator.faults, faults[number]);
            assert_eq!(actuator.encoder, faults[number] & fault::POSITION);
            assert!(actuator.duty.is_nan());
        }
    }
}

#[test]
fn frames_of_a_wrong_form_are_counted() {
    let mut device = listener("icub_mc4", "", &[0, 1]);
    for id in [0x111, 0x113, 0x117].map(Id::standard) {
        for length in 0..8 {
            let (readings, faults) = decode(&mut *device, &[Frame::new(id, &[0; 8][..length])]);
            assert!(readings.is_empty());
            assert_eq!(count(&faults, Counter::Length), 1);
        }
        let frames = [
            Frame::with_format(id, FD, &[0; 8]).unwrap(),
            Frame::remote(id, 8),
        ];
        let (readings, faults) = decode(&mut *device, &frames);
        assert!(readings.is_empty());
        assert_eq!(count(&faults, Counter::Value), 1);
        assert_eq!(count(&faults, Counter::Length), 1);
    }
    // Other streams, another board.
    for id in [0x110, 0x112, 0x114, 0x118, 0x11A, 0x121, 0x211] {
        let (readings, faults) = decode(&mut *device, &[Frame::new(Id::standard(id), &[0; 3])]);
        assert!(readings.is_empty() && faults.is_empty());
    }
}

#[test]
fn the_keys_of_the_page_are_legal_and_nothing_is_sent() {
    let keys = shown_keys(include_str!("../../../docs/book/src/devices/icub_mc4.md"));
    assert!(keys.contains("velocity_shift"));
    let still = JointState {
        position: 1.0,
        velocity: 0.5,
        ..JointState::ABSENT
    };
    let mut rig = Rig::new("icub_mc4", keys, &[1], (1, Reading::Joint(still)));
    rig.run(100);
    assert_eq!(
        (rig.device.state(), rig.readings.len()),
        (State::Streaming, 10)
    );
    assert!((joint(&rig.readings[9]).velocity - 0.5).abs() < 2e-3);
    // A silence ends what was told before it.
    let mut out = proprio_drivers::Decoded::new();
    let fault = frame("113#0001200100000000", 0.0).at(rig.now, proprio_topics::StampKind::Software);
    rig.device.on_frame(&fault, &mut out);
    assert_eq!(out.readings[0].quality, Quality::DEVICE_FAULT);
    rig.board_loses = Box::new(|_, _| true);
    rig.run(100);
    assert_eq!(rig.device.state(), State::Silent);
    assert_eq!(rig.count(Counter::Silences), 1);
    rig.board_loses = Box::new(|_, frame| frame.id == Id::standard(0x117));
    rig.run(20);
    assert_eq!(rig.readings[10].quality, Quality::GAP_BEFORE);
    assert!(joint(&rig.readings[10]).velocity.is_nan());
    assert_eq!(rig.readings[11].quality, Quality::GOOD);
    rig.device.stop(rig.now);
    rig.run(20);
    assert_eq!(rig.device.state(), State::Stopped);
    assert_eq!(rig.sent, [""; 0]);
    assert_eq!(rig.count(Counter::Starts), 0);
}

#[test]
fn a_silence_ends_the_velocity_too() {
    let mut device = listener("icub_mc4", "hold_ms = 1000", &[0, 1]);
    let velocity = frame("117#0100010000000000", 0.0);
    let (first, _) = decode(&mut *device, &[velocity, frame(POSITIONS, 0.0)]);
    assert!(first.iter().all(|r| !joint(r).velocity.is_nan()));
    device.restart(velocity.t);
    let (readings, _) = decode(
        &mut *device,
        &[frame(POSITIONS, 1.0), frame(POSITIONS, 2.0)],
    );
    assert!(readings.iter().all(|r| joint(r).velocity.is_nan()));
    let qualities: Vec<Quality> = readings.iter().map(|r| r.quality).collect();
    let (gap, good) = (Quality::GAP_BEFORE, Quality::GOOD);
    assert_eq!(qualities, [gap, gap, good, good]);
}

#[test]
fn wrong_keys_are_refused() {
    let refused = |keys: &str, address| {
        let options = options("icub_mc4", keys);
        let spec = spec(address, Mode::Listen, &[0]);
        let error = options.device(&spec).map(|_| ()).unwrap_err();
        let board = options.board(&spec).map(|_| ()).unwrap_err();
        assert_eq!(board.to_string(), error.to_string());
        match error {
            SpecError::Key { key, .. } => key,
            SpecError::Address { most: 14, .. } => "address",
            SpecError::Channel { most: 1, .. } => "channel",
            other => panic!("{other:?}"),
        }
    };
    for address in [0, 15] {
        assert_eq!(refused("", address), "address");
    }
    for (keys, key) in [
        ("ticks_per_turn = [65536.0, 0.0]", "ticks_per_turn"),
        ("ticks_per_turn = [-1.0, 65536.0]", "ticks_per_turn"),
        ("ticks_per_turn = [nan, 65536.0]", "ticks_per_turn"),
        ("ticks_per_turn = [65536.0, inf]", "ticks_per_turn"),
        ("velocity_shift = [16, 0]", "velocity_shift"),
        ("velocity_shift = [0, 16]", "velocity_shift"),
        ("hold_ms = 0", "hold_ms"),
        ("hold_ms = 1001", "hold_ms"),
        ("period_ms = 0", "period_ms"),
        ("period_ms = 256", "period_ms"),
    ] {
        assert_eq!(refused(keys, 1), key, "{keys}");
    }
    let third = options("icub_mc4", "").device(&spec(1, Mode::Listen, &[2]));
    assert!(matches!(
        third.map(|_| ()),
        Err(SpecError::Channel { most: 1, .. })
    ));
}

#[test]
fn a_simulated_board_sends_what_it_is_given() {
    let texts = |frames: Vec<Frame>| frames.iter().map(ToString::to_string).collect::<Vec<_>>();
    let mut mc4 = board("icub_mc4", KEYS, &[0, 1]);
    let state = |position, velocity| {
        Reading::Joint(JointState {
            position,
            velocity,
            ..JointState::ABSENT
        })
    };
    let (good, absent) = (Quality::GOOD, f64::NAN);
    let mut send =
        |output, reading: &Reading, quality| texts(encode(&mut *mc4, output, reading, quality));
    let (first, second) = (
        state(TAU, 2000.0 * TAU / 65536.0),
        state(-TAU / 4.0, -2000.0 * TAU / 4096.0),
    );
    assert_eq!(send(0, &first, good), [""; 0]);
    assert_eq!(send(0, &first, good), [""; 0]);
    let both = ["117#4000F0FF00000000", POSITIONS];
    assert_eq!(send(1, &second, good), both);
    assert_eq!(send(1, &second, good), [""; 0]);
    assert_eq!(send(0, &first, good), both);
    // Without one velocity there is no frame of them; ends of ranges.
    send(0, &state(-1e9, absent), good);
    assert_eq!(send(1, &state(1e9, 1e9), good), ["111#00000080FFFFFF7F"]);
    send(0, &state(0.0, -1e9), good);
    assert_eq!(
        send(1, &state(0.0, 1e9), good),
        ["117#0080FF7F00000000", "111#0000000000000000"]
    );
    // A status when the faults of a joint change.
    let (doubt, drive, zero) = (
        Quality::DEVICE_FAULT,
        Quality::DRIVE_FAULT,
        Quality::NOT_CALIBRATED,
    );
    assert_eq!(
        send(0, &first, doubt | Quality::SATURATED),
        ["113#2001000100000000"]
    );
    assert_eq!(send(0, &first, doubt | Quality::SATURATED), [""; 0]);
    assert_eq!(send(0, &first, drive | zero), ["113#0460000100000000"]);
    assert_eq!(send(0, &first, good), ["113#0001000100000000"]);
    let actuator = Reading::Actuator(Actuator {
        duty: 0.0,
        mode: 0x50,
        encoder: 0,
        faults: 0x48,
    });
    assert_eq!(send(1, &actuator, good), ["113#0001485000000000"]);
    let positions = send(1, &second, doubt | drive);
    assert_eq!(positions, both);
    // One joint in use does not wait for the other.
    let mut single = board("icub_mc4", KEYS, &[1]);
    assert_eq!(
        texts(encode(&mut *single, 1, &second, good)),
        ["117#0000F0FF00000000", "111#0000000000FCFFFF"]
    );
    let mut out = Frames::new();
    single.on_frame(&frame("001#5B0200", 0.0), &mut out);
    assert_eq!(texts(out.to_vec()), ["010#5B03020008020001"]);
    for (output, reading, error) in [
        (1, state(absent, 0.0), EncodeError::NotFinite),
        (
            1,
            Reading::Gauges(proprio_topics::Gauges { counts: [0; 6] }),
            EncodeError::Kind,
        ),
        (2, first, EncodeError::Output(2)),
    ] {
        assert_eq!(single.encode(output, &reading, good, &mut out), Err(error));
    }
}

proptest! {
    #[test]
    fn readings_come_back(
        positions in proptest::array::uniform2(-1e4_f64..1e4),
        velocities in proptest::array::uniform2(-15.0_f64..15.0),
        ticks in proptest::array::uniform2(360.0_f64..65536.0), shift in 0_u8..=5, bits in 0_u8..8,
    ) {
        let keys = format!("ticks_per_turn = {ticks:?}\nvelocity_shift = [{shift}, {shift}]");
        let mut quality = Quality::GOOD;
        if bits & 1 != 0 { quality |= Quality::DEVICE_FAULT; }
        if bits & 2 != 0 { quality |= Quality::NOT_CALIBRATED; }
        if bits & 4 != 0 { quality |= Quality::DRIVE_FAULT; }
        let mut board = board("icub_mc4", &keys, &[0, 1]);
        let mut frames = Vec::new();
        for joint in 0..2 {
            let sent = JointState {
                position: positions[joint], velocity: velocities[joint], ..JointState::ABSENT
            };
            frames.extend(encode(&mut *board, joint as u8, &Reading::Joint(sent), quality));
        }
        let (readings, _) = decode(&mut *listener("icub_mc4", &keys, &[0, 1]), &frames);
        let last = &readings[readings.len() - 2..];
        for (number, stamped) in last.iter().enumerate() {
            prop_assert_eq!(stamped.quality, quality);
            let (back, step) = (joint(stamped), TAU / ticks[number]);
            let step = [step, step * 1000.0 / f64::from(1 << shift)];
            let right = [positions[number], velocities[number]];
            for ((a, b), step) in [back.position, back.velocity].iter().zip(right).zip(step) {
                prop_assert!((a - b).abs() <= step * (0.5 + 1e-6), "{} {} {}", a, b, step);
            }
        }
    }
}
