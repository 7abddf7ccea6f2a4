//! iCub skin and MAIS boards: frames computed by hand from the document's tables, and start-up
//! against the boards.

use crate::rig::{Rig, board, count, decode, encode, frame, listener, options, spec};
use proprio_drivers::{EncodeError, Frame, Frames, Mode, SpecError, State};
use proprio_topics::{Counter, JointState, Nanos, Quality, Reading, Skin};
use proptest::prelude::*;

fn skin(reading: &Reading) -> Skin {
    match reading {
        Reading::Skin(skin) => *skin,
        other => panic!("{other:?}"),
    }
}

/// Triangle 5 of board 1: taxels 245, 244, ... down to 234, without a fault.
const FIRST: &str = "415#40F5F4F3F2F1F0EF";
const SECOND: &str = "415#C0EEEDECEBEA0000";

#[test]
fn both_frames_of_a_triangle_are_one_reading() {
    let mut device = listener("icub_skin", "", &[]);
    let frames = [frame(FIRST, 10.0), frame(SECOND, 10.2)];
    let (readings, faults) = decode(&mut *device, &frames);
    assert!(faults.is_empty(), "{faults:?}");
    assert_eq!(readings.len(), 1);
    assert_eq!(readings[0].acquired, frames[0].t);
    assert_eq!(readings[0].quality, Quality::GOOD);
    let Skin { triangle, taxels } = skin(&readings[0].reading);
    assert_eq!(triangle, 5);
    for (number, taxel) in taxels.iter().enumerate() {
        // 6 and 10 are thermometers.
        match number {
            6 | 10 => assert!(taxel.is_nan()),
            _ => assert_eq!(*taxel, number as f64),
        }
    }
}

/// Out of range are taxels 11, 4 and 0: bits 11:4 in the seventh byte, 3:0 above the flags.
#[test]
fn what_the_board_doubts_is_marked() {
    let mut device = listener("icub_skin", "no_load = 250", &[]);
    let doubt = "415#C0EEEDECEBEA8110";
    for (flags, faulty) in [(0, false), (1, true), (2, true), (4, false)] {
        let second = format!("{}{flags:X}", &doubt[..doubt.len() - 1]);
        let (readings, faults) = decode(&mut *device, &[frame(FIRST, 0.0), frame(&second, 0.2)]);
        let taxels = skin(&readings[0].reading).taxels;
        let absent: Vec<usize> = (0..12).filter(|k| taxels[*k].is_nan()).collect();
        assert_eq!(absent, [0, 4, 6, 10, 11]);
        assert_eq!(taxels[1], 250.0 - 244.0);
        assert_eq!(
            readings[0].quality.contains(Quality::DEVICE_FAULT),
            faulty,
            "{flags}"
        );
        assert_eq!(count(&faults, Counter::DeviceFault), u32::from(faulty));
    }
}

/// Triangles are paired apart from each other, and never a frame with one of another time.
#[test]
fn triangles_are_paired_apart() {
    let mut device = listener("icub_skin", "", &[]);
    let other = |text: &str| text.replace("415", "41F");
    let (readings, faults) = decode(
        &mut *device,
        &[
            frame(FIRST, 0.0),
            frame(&other(FIRST), 0.1),
            frame(SECOND, 0.2),
            frame(&other(SECOND), 0.3),
            // Lost: the second frame of triangle 5, and the first of triangle 15.
            frame(FIRST, 50.0),
            frame(&other(SECOND), 50.3),
            frame(FIRST, 100.0),
            frame(SECOND, 100.2),
            frame(FIRST, 150.0),
            frame(SECOND, 150.2),
            // Too late.
            frame(&other(FIRST), 150.3),
            frame(&other(SECOND), 190.0),
        ],
    );
    let read: Vec<(u32, bool)> = (readings.iter())
        .map(|r| {
            let gap = r.quality.contains(Quality::GAP_BEFORE);
            (skin(&r.reading).triangle, gap)
        })
        .collect();
    assert_eq!(read, [(5, false), (15, false), (5, true)]);
    assert_eq!(count(&faults, Counter::Unpaired), 6, "{faults:?}");
}

/// Of each triangle but 5, the second frame at 50 ms is lost; 7 has not been read before.
#[test]
fn a_gap_is_that_of_its_triangle() {
    let mut device = listener("icub_skin", "", &[]);
    let both = |triangle: u8, ms: f64| {
        let part = |text: &str, ms| frame(&text.replace("415", &format!("41{triangle:X}")), ms);
        [part(FIRST, ms), part(SECOND, ms + 0.2)]
    };
    let mut frames: Vec<Frame> = Vec::new();
    for (ms, used) in [
        (0.0, [2, 0, 2]),
        (50.0, [1, 1, 2]),
        (100.0, [2, 2, 2]),
        (150.0, [2, 2, 2]),
        (200.0, [2, 2, 2]),
    ] {
        for (triangle, used) in [15, 7, 5].into_iter().zip(used) {
            frames.extend(&both(triangle, ms)[..used]);
        }
    }
    let (readings, _) = decode(&mut *device, &frames);
    let gaps = |wanted: u32| -> Vec<bool> {
        let wanted_readings = readings
            .iter()
            .filter(|r| skin(&r.reading).triangle == wanted);
        wanted_readings
            .map(|r| r.quality.contains(Quality::GAP_BEFORE))
            .collect()
    };
    assert_eq!(gaps(5), [false; 5]);
    assert_eq!(gaps(15), [false, true, false]);
    assert_eq!(gaps(7), [false, false]);
}

#[test]
fn the_halves_of_a_triangle_before_and_after_a_restart_are_not_one() {
    let mut device = listener("icub_skin", "", &[]);
    assert!(decode(&mut *device, &[frame(FIRST, 0.0)]).0.is_empty());
    device.restart(Nanos::ZERO);
    assert!(decode(&mut *device, &[frame(SECOND, 0.2)]).0.is_empty());
    let frames = [frame(FIRST, 50.0), frame(SECOND, 50.2)];
    assert_eq!(decode(&mut *device, &frames).0.len(), 1);
}

#[test]
fn a_skin_board_sends_the_triangles_that_it_is_told() {
    let mut board = board("icub_skin", "triangles = [0, 15]", &[]);
    let mut out = Frames::new();
    board.on_frame(&frame("201#50020502010022", 0.0), &mut out);
    assert!(out.is_empty(), "not acknowledged");
    for (output, triangle, sends) in [
        (0, 1, false),
        (0, 2, true),
        (0, 5, true),
        (0, 6, false),
        (0, 300, false),
        (1, 3, false),
    ] {
        let reading = Reading::Skin(Skin {
            triangle,
            taxels: [0.0; 12],
        });
        let mut out = Frames::new();
        let encoded = board.encode(output, &reading, Quality::GOOD, &mut out);
        let expected = match sends {
            true => (Ok(()), 2),
            false => (Err(EncodeError::Output(output)), 0),
        };
        assert_eq!((encoded, out.len()), expected, "{output} {triangle}");
    }
}

#[test]
fn frames_that_are_none_of_a_triangle_are_counted() {
    let mut device = listener("icub_skin", "triangles = [0, 4]", &[]);
    let frames = [
        frame("411#40000102030405", 0.0),
        frame("411#4100010203040506", 1.0),
        frame(FIRST, 2.0),
        frame("411#", 3.0),
    ];
    let (readings, faults) = decode(&mut *device, &frames);
    assert!(readings.is_empty());
    assert_eq!(count(&faults, Counter::Length), 2);
    assert_eq!(count(&faults, Counter::Value), 2);
}

#[test]
fn a_skin_board_is_started_watched_and_stopped() {
    let taxels = [
        10.0,
        0.0,
        3.0,
        0.0,
        0.0,
        0.0,
        f64::NAN,
        1.0,
        2.0,
        3.0,
        f64::NAN,
        5.0,
    ];
    let reading = (
        0,
        Reading::Skin(Skin {
            triangle: 3,
            taxels,
        }),
    );
    let keys = "period_ms = 20\ntriangles = [2, 9]\ncompensation = \"palm\"\nno_load = 240";
    let mut rig = Rig::new("icub_skin", keys, &[], reading);
    rig.run(100);
    assert_eq!(rig.sent, ["201#4D0114F0", "201#50020902010022", "201#0700"]);
    assert_eq!(
        (rig.device.state(), rig.readings.len()),
        (State::Streaming, 5)
    );
    let read = skin(&rig.readings[0].reading);
    assert_eq!(read.taxels.map(f64::to_bits), taxels.map(f64::to_bits));
    rig.board_loses = Box::new(|_, _| true);
    rig.run(200);
    assert!(rig.states.contains(&State::Silent) && rig.sent.len() >= 6);
    rig.board_loses = Box::new(|_, _| false);
    rig.run(800);
    assert!(rig.readings[5].quality.contains(Quality::GAP_BEFORE));
    rig.device.stop(rig.now);
    rig.run(30);
    assert_eq!(rig.sent.last().unwrap(), "201#0701");
    assert_eq!(
        (rig.device.state(), rig.board.period()),
        (State::Stopped, None)
    );
}

#[test]
fn wrong_triangles_are_refused() {
    for triangles in ["[3, 2]", "[0, 16]"] {
        let keys = format!("triangles = {triangles}");
        let refused = options("icub_skin", &keys).device(&spec(1, Mode::Listen, &[]));
        let expected = "the first and the last of 0 to 15";
        let key = "triangles";
        assert_eq!(
            refused.map(|_| ()).unwrap_err(),
            SpecError::Keys { key, expected }
        );
    }
}

fn position(reading: &Reading) -> f64 {
    match reading {
        Reading::Joint(state) => state.position,
        other => panic!("{other:?}"),
    }
}

#[test]
fn each_frame_of_a_mais_gives_its_own_sensors() {
    let mut device = listener("icub_mais", "", &[0, 6, 7, 14]);
    let frames = [
        frame("31C#000102030405FE", 0.0),
        frame("31D#0708090A0B0C0D0E", 0.1),
        frame("31D#0708090A0B0C0D", 0.2),
    ];
    let (readings, faults) = decode(&mut *device, &frames);
    let read: Vec<(u8, f64)> = readings
        .iter()
        .map(|r| (r.output, position(&r.reading)))
        .collect();
    assert_eq!(read, [(0, 0.0), (6, 254.0), (7, 7.0), (14, 14.0)]);
    assert_eq!(readings[2].acquired, frames[1].t);
    assert_eq!(count(&faults, Counter::Length), 1);
}

#[test]
fn a_mais_is_started_and_stopped() {
    let joint = |position| {
        Reading::Joint(JointState {
            position,
            ..JointState::ABSENT
        })
    };
    let mut rig = Rig::new("icub_mais", "period_ms = 5", &[2], (2, joint(77.4)));
    rig.run(50);
    assert_eq!(rig.sent, ["201#1002", "201#0805", "201#0700"]);
    assert_eq!(
        (rig.device.state(), rig.readings.len()),
        (State::Streaming, 10)
    );
    assert_eq!(position(&rig.readings[0].reading), 77.0);
    rig.device.stop(rig.now);
    rig.run(30);
    assert_eq!(rig.sent.last().unwrap(), "201#0701");
    assert_eq!(
        (rig.device.state(), rig.board.period()),
        (State::Stopped, None)
    );
}

/// The board sends a frame once all its joints are new.
#[test]
fn a_mais_sends_all_sensors_of_a_frame_at_once() {
    let joint = |position| {
        Reading::Joint(JointState {
            position,
            ..JointState::ABSENT
        })
    };
    let mut board = board("icub_mais", "", &[1, 5, 9]);
    let mut sent = |sensor, value| {
        let frames = encode(&mut *board, sensor, &joint(value), Quality::GOOD);
        frames.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    assert_eq!(sent(1, 1.0), [""; 0]);
    assert_eq!(sent(9, 300.0), ["31D#0000FF0000000000"]);
    assert_eq!(sent(5, 5.0), ["31C#00010000000500"]);
    assert_eq!(sent(5, 6.0), [""; 0]);
    // A frame without joints is never sent.
    for (sensor, frame) in [(2, "31C#00000700000000"), (9, "31D#0000070000000000")] {
        let mut board = crate::rig::board("icub_mais", "", &[sensor]);
        let frames = encode(&mut *board, sensor, &joint(7.0), Quality::GOOD);
        let texts: Vec<String> = frames.iter().map(ToString::to_string).collect();
        assert_eq!(texts, [frame]);
    }
}

proptest! {
    #[test]
    fn skin_is_read_back(
        triangle in 0_u32..16, taxels in proptest::array::uniform12(-10.0_f64..245.0),
        absent in proptest::array::uniform12(proptest::bool::weighted(0.2)),
    ) {
        let mut right = taxels;
        for (number, taxel) in right.iter_mut().enumerate() {
            if absent[number] || number == 6 || number == 10 {
                *taxel = f64::NAN;
            }
        }
        let sent = Reading::Skin(Skin { triangle, taxels: right });
        let frames = encode(&mut *board("icub_skin", "", &[]), 0, &sent, Quality::GOOD);
        let (readings, faults) = decode(&mut *listener("icub_skin", "", &[]), &frames);
        prop_assert!(faults.is_empty());
        let back = skin(&readings[0].reading);
        prop_assert_eq!(back.triangle, triangle);
        for (a, b) in back.taxels.iter().zip(right) {
            prop_assert_eq!(a.is_nan(), b.is_nan());
            prop_assert!(a.is_nan() || (a - b).abs() <= 0.5 + 1e-9);
        }
    }
}
