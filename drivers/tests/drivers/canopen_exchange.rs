//! The exchange of a CANopen master with its nodes, answer by answer; nodes that are replaced; and
//! which process data make a reading.

use crate::rig::{Rig, board, count, decode, encode, frame, listener, options, spec, supervisor};
use proprio_drivers::{
    Decoded, Device, EncodeError, Frame, Frames, Mode, NotSent, StampedReading, State,
};
use proprio_topics::{
    Actuator, Counter, JointState, Nanos, Quality, Reading, Refusal, StampKind, Temperature,
};
use std::f64::consts::TAU;

fn turned(turns: f64) -> Reading {
    Reading::Joint(JointState {
        position: turns * TAU,
        velocity: 0.0,
        torque: 0.0,
        current: 0.0,
        ..JointState::ABSENT
    })
}

/// The positions \[turns\] of joints in `readings`.
fn positions(readings: &[StampedReading]) -> Vec<f64> {
    let joint = |stamped: &StampedReading| match stamped.reading {
        Reading::Joint(joint) => Some(joint.position / TAU),
        _ => None,
    };
    readings.iter().filter_map(joint).collect()
}

/// An encoder at node 1 that is started, while `answers` gives what the node sends after each of
/// the host's frames. What the host has sent, and the device.
fn start(answers: impl Fn(&str) -> Vec<String>) -> (Vec<String>, Box<dyn Device>, Decoded) {
    let mut device = supervisor("canopen_encoder", "", &[0]);
    let (mut sent, mut out) = (Vec::new(), Decoded::new());
    for ms in 0..30 {
        let now = Nanos::from_millis(ms);
        while let Some(transmit) = device.poll_transmit(now, &mut out) {
            let text = transmit.frame.to_string();
            device.on_sent(&transmit.frame, Ok(now));
            for answer in answers(&text) {
                device.on_frame(&frame(&answer, ms as f64), &mut out);
            }
            sent.push(text);
        }
    }
    (sent, device, out)
}

/// What a usual node answers to one of the host's frames.
fn usual(question: &str) -> Option<String> {
    let object = question.strip_prefix("601#")?.get(2..8)?;
    Some(match (&question[4..6], object) {
        ("40", "001000") => "581#4300100096010100".into(),
        ("40", "016500") => "581#4301650000100000".into(),
        ("40", _) => format!("581#80{object}00000206"),
        _ => format!("581#60{object}00000000"),
    })
}

/// The size of an answer may be stated (43 to 4F: 4 bytes to 1) or not (42). What is beyond it does
/// not count. 41 begins an answer in segments, which only another program asks for.
#[test]
fn answers_of_each_size_are_read() {
    for (profile, state) in [
        ("4300100096010100", State::Starting),
        ("47001000960101FF", State::Starting),
        ("4B0010009601FFFF", State::Starting),
        ("4200100096010100", State::Starting),
        ("4100100096010000", State::Asking),
        (
            "4F00100096FFFFFF",
            State::Refused(Refusal::OtherDevice { profile: 0x96 }),
        ),
    ] {
        let (_, device, _) = start(|question| {
            if question.starts_with("601#40001000") {
                return vec![format!("581#{profile}")];
            }
            usual(question).into_iter().collect()
        });
        assert_eq!(device.state(), state, "{profile}");
    }
}

/// Bit 2 of object 6000 says that the counts per turn are those of 6001.
#[test]
fn a_scaled_encoder_is_asked_for_its_scale() {
    let (sent, mut device, mut out) = start(|question| {
        let answer = match question.get(4..12) {
            Some("40006000") => "581#4B00600004000000".to_owned(),
            Some("40016000") => "581#4301600064000000".to_owned(),
            _ => return usual(question).into_iter().collect(),
        };
        vec![answer]
    });
    assert!(
        !sent.contains(&"601#4001650000000000".to_owned()),
        "{sent:?}"
    );
    device.on_frame(&frame("181#19000000", 60.0), &mut out);
    assert_eq!(positions(&out.readings), [0.25]);
}

/// Eight objects, the most that a TPDO of one byte each holds, are all asked for.
#[test]
fn each_mapped_object_of_a_drive_is_asked_for() {
    let mut device = supervisor("canopen_drive", "", &[0]);
    let (mut asked, mut out) = (Vec::new(), Decoded::new());
    for ms in 0..50 {
        let now = Nanos::from_millis(ms);
        while let Some(transmit) = device.poll_transmit(now, &mut out) {
            device.on_sent(&transmit.frame, Ok(now));
            let text = transmit.frame.to_string();
            let Some(object) = text.strip_prefix("601#40") else {
                continue;
            };
            let object = &object[..6];
            let answer = match object {
                "001000" => "4300100092010200".to_owned(),
                "001801" => "4300180181010040".to_owned(),
                "001802" => "4F001802FE000000".to_owned(),
                "001A00" => "4F001A0008000000".to_owned(),
                mapped if mapped.starts_with("001A") => format!("43{mapped}08006160"),
                object => format!("80{object}00000206"),
            };
            device.on_frame(&frame(&format!("581#{answer}"), ms as f64), &mut out);
            asked.push(object.to_owned());
        }
    }
    let mapping = asked.iter().filter(|object| object.starts_with("001A"));
    let expected: Vec<String> = (0..=8).map(|sub| format!("001A{sub:02}")).collect();
    assert_eq!(mapping.cloned().collect::<Vec<_>>(), expected);
    for number in 1..4 {
        let ids = asked
            .iter()
            .filter(|object| **object == format!("0{number}1801"));
        assert_eq!(ids.count(), 1, "{asked:?}");
    }
}

/// Another program may use the same channel: only the answer to the host's own question is taken.
/// A node that says that it is not operational is not started anew while it is being started.
#[test]
fn what_another_program_is_answered_is_not_taken() {
    let (usual_frames, ..) = start(|question| usual(question).into_iter().collect());
    assert_eq!(usual_frames.len(), 13);
    for foreign in [
        // The counts per turn, a write of them, that it is refused, and a state.
        "581#4301650007000000",
        "581#6001650000000000",
        "581#8001650000000206",
        "701#7F",
    ] {
        let (sent, mut device, mut out) = start(|question| {
            if question.starts_with("601#4001650") {
                // Also of the same object, as the other one writes it.
                return vec!["581#6001650000000000".into(), usual(question).unwrap()];
            }
            let answers = usual(question);
            [foreign.to_owned()].into_iter().chain(answers).collect()
        });
        assert_eq!(sent, usual_frames, "{foreign}");
        let faults = out.faults.iter();
        let counters: Vec<Counter> = faults.map(|fault| fault.counter).collect();
        assert_eq!(counters, [Counter::Starts], "{foreign}");
        device.on_frame(&frame("181#00040000", 60.0), &mut out);
        assert_eq!(positions(&out.readings), [0.25], "{foreign}");
    }
}

/// A node that is asked twice a second because it does not answer: what comes later than 200 ms
/// after a question is another program's.
#[test]
fn an_answer_that_comes_late_is_not_taken() {
    for (late, taken) in [(150, true), (300, false)] {
        let mut device = supervisor("canopen_encoder", "", &[0]);
        let (mut out, mut asked) = (Decoded::new(), Nanos::ZERO);
        for now in (0..3000).map(Nanos::from_millis) {
            if asked > Nanos::from_millis(2000) {
                break;
            }
            if let Some(transmit) = device.poll_transmit(now, &mut out) {
                device.on_sent(&transmit.frame, Ok(now));
                asked = now;
            }
        }
        let at = asked + Nanos::from_millis(late);
        let answer = frame("581#4300100096010100", 0.0).at(at, StampKind::Software);
        device.on_frame(&answer, &mut out);
        let next = device.poll_transmit(at, &mut out);
        assert_eq!(next.is_some(), taken, "{late} ms: {next:?}");
    }
}

/// Frames of the start that the interface refuses are sent again, none is left out.
#[test]
fn each_frame_that_is_not_sent_is_sent_later() {
    let reading = (0, turned(0.25));
    let mut whole = Rig::new("canopen_encoder", "", &[0], reading);
    whole.run(60);
    for refused in 1..=whole.sent.len() {
        let mut rig = Rig::new("canopen_encoder", "", &[0], reading);
        let mut count = 0;
        rig.interface = Box::new(move |_| {
            count += 1;
            (count == refused).then_some(NotSent::Refused)
        });
        rig.run(300);
        assert_eq!(rig.sent, whole.sent, "{refused}");
    }
}

/// A node that is to be stopped while it is started again was started once: it is stopped.
#[test]
fn a_node_is_stopped_in_the_midst_of_a_restart() {
    let mut rig = Rig::new("canopen_encoder", "", &[0], (0, turned(0.25)));
    rig.run(60);
    rig.device.restart(rig.now);
    rig.device.stop(rig.now);
    rig.run(10);
    assert_eq!(rig.sent.last().map(String::as_str), Some("000#8001"));
    let end = (rig.device.state(), rig.board.period());
    assert_eq!(end, (State::Stopped, None));
}

/// After a restart it may be another encoder, or another drive: its scales are asked anew.
#[test]
fn a_node_may_be_replaced() {
    let mapped = "pdos = [{ number = 1, objects = [0x6041, 0x6064] }]";
    for (driver, own, other) in [
        ("canopen_encoder", "", "counts_per_turn = 1000"),
        ("canopen_drive", mapped, "counts_per_turn = 1000"),
    ] {
        let mut rig = Rig::with_board(driver, "", own, &[0], (0, turned(0.25)));
        rig.run(300);
        assert_eq!(rig.device.state(), State::Streaming, "{driver}");
        rig.readings.clear();
        rig.board = board(driver, other, &[0]);
        rig.device.restart(rig.now);
        rig.run(300);
        assert_eq!(rig.device.state(), State::Streaming, "{driver}");
        let read = positions(&rig.readings);
        assert!(read.len() > 10);
        assert!(
            read.iter().all(|turns| (turns - 0.25).abs() < 1e-3),
            "{driver}: {read:?}"
        );
    }
}

/// The counts per turn that a node tells twice must be the same.
#[test]
fn counts_per_turn_may_not_change() {
    for (second, state) in [
        ("589#4301650000100000", State::Streaming),
        ("589#4301650000200000", State::Refused(Refusal::Changed)),
    ] {
        let encoder = options("canopen_encoder", "");
        let mut device = encoder
            .device(&spec(9, Mode::Listen, &[0]))
            .expect("legal keys");
        let answer = frame("589#4301650000100000", 1.0);
        let frames = [answer, frame("189#00040000", 2.0), frame(second, 3.0)];
        let (readings, _) = decode(&mut *device, &frames);
        assert_eq!(positions(&readings), [0.25]);
        assert_eq!(device.state(), state, "{second}");
    }
}

/// What the keys state is not compared with what the drive tells, and what it tells twice may be
/// the same.
#[test]
fn scales_of_keys_count_before_those_of_the_drive() {
    let keys = "counts_per_turn = 4\nrated_current = 2.0\nrated_torque = 3.0\n\
                pdos = [{ number = 1, objects = [0x6064, 0x6077, 0x6078] }]";
    let mut drive = listener("canopen_drive", keys, &[0]);
    let answers = [
        "581#438F600110000000",
        "581#438F600111000000",
        "581#438F600201000000",
        "581#438F600202000000",
        "581#4375600001000000",
        "581#4375600002000000",
        "581#4376600001000000",
        "581#4376600002000000",
        "181#01000000F4010A00",
    ];
    let (readings, faults) = decode(&mut *drive, &answers.map(|text| frame(text, 1.0)));
    assert_eq!(faults, []);
    let Reading::Joint(joint) = readings[0].reading else {
        panic!("{readings:?}")
    };
    assert!((joint.position - TAU / 4.0).abs() < 1e-12);
    assert!((joint.torque - 1.5).abs() < 1e-12 && (joint.current - 0.02).abs() < 1e-12);
    let mut drive = listener("canopen_drive", "", &[0]);
    let twice = ["581#438F600110000000"; 2].map(|text| frame(text, 1.0));
    assert_eq!(decode(&mut *drive, &twice).1, []);
}

/// A drive that sends torque or current in thousandths of a rated value that nobody has told.
#[test]
fn a_scale_that_is_not_known_is_missed() {
    for (object, keys, scale) in [
        (0x6077, "rated_torque", 0x6076),
        (0x6078, "rated_current", 0x6075),
    ] {
        let mapped =
            format!("counts_per_turn = 4\npdos = [{{ number = 1, objects = [0x6064, {object}] }}]");
        let position = [frame("181#010000000000", 1.0)];
        let mut unknown = listener("canopen_drive", &mapped, &[0]);
        assert!(decode(&mut *unknown, &position).0.is_empty());
        assert_eq!(
            unknown.state(),
            State::Refused(Refusal::Untold { object: scale }),
            "{keys}"
        );
        let text = Refusal::Untold { object: scale }.to_string();
        assert!(
            text.contains(&format!("{scale:04X}")) && text.contains(keys),
            "{text}"
        );
        let known = format!("{keys} = 1.0\n{mapped}");
        let mut known = listener("canopen_drive", &known, &[0]);
        assert_eq!(positions(&decode(&mut *known, &position).0), [0.25]);
    }
}

/// The units of object 606C: counts or tenths of them each second, turns or tenths each minute.
#[test]
fn velocities_are_in_the_unit_of_the_keys() {
    for (unit, turns_per_s) in [
        ("", 60.0 / 4.0),
        ("velocity_unit = \"counts/s\"", 60.0 / 4.0),
        ("velocity_unit = \"0.1 counts/s\"", 6.0 / 4.0),
        ("velocity_unit = \"rpm\"", 1.0),
        ("velocity_unit = \"0.1 rpm\"", 0.1),
    ] {
        let keys = format!(
            "counts_per_turn = 4\n{unit}\npdos = [{{ number = 1, objects = [0x6064, 0x606C] }}]"
        );
        let mut drive = listener("canopen_drive", &keys, &[0]);
        let (readings, _) = decode(&mut *drive, &[frame("181#000000003C000000", 1.0)]);
        let Reading::Joint(joint) = readings[0].reading else {
            panic!("{readings:?}")
        };
        assert!((joint.velocity / TAU - turns_per_s).abs() < 1e-12, "{unit}");
    }
}

/// Process data belong to the reading of the position if the same SYNC causes them and they hold a
/// value of the joint: others are not waited for.
#[test]
fn a_reading_waits_only_for_what_belongs_to_it() {
    for (second, waits) in [
        ("objects = [0x606C], sync = 1", true),
        ("objects = [0x606C], sync = 2", false),
        ("objects = [0x606C]", false),
        ("objects = [0x6041], sync = 1", false),
    ] {
        let keys = format!(
            "counts_per_turn = 4\npdos = [{{ number = 1, objects = [0x6064], sync = 1 }}, \
             {{ number = 2, {second} }}]"
        );
        let mut drive = listener("canopen_drive", &keys, &[0]);
        let frames: Vec<Frame> = (1..5)
            .map(|n| f64::from(n) * 10.0)
            .flat_map(|ms| [frame("080#", ms), frame("181#01000000", ms + 0.5)])
            .collect();
        let read = positions(&decode(&mut *drive, &frames).0).len();
        assert_eq!(read, if waits { 0 } else { 4 }, "{second}");
    }
}

/// Process data in which nothing is of use may have any identifier.
#[test]
fn an_identifier_matters_only_for_values_of_use() {
    for (mapped, state) in [
        ("2010", State::Streaming),
        (
            "606C",
            State::Refused(Refusal::OtherIdentifier { id: 0x3FF }),
        ),
    ] {
        let object = u16::from_str_radix(mapped, 16).expect("a number");
        let [low, high] = object.to_le_bytes();
        let mut drive = listener("canopen_drive", "counts_per_turn = 4", &[0]);
        let answers = [
            "581#4300180181010000".to_owned(),
            "581#4F001802FE000000".to_owned(),
            "581#4F001A0001000000".to_owned(),
            "581#43001A0120006460".to_owned(),
            "581#43011801FF030000".to_owned(),
            "581#4F011802FE000000".to_owned(),
            "581#4F011A0001000000".to_owned(),
            format!("581#43011A012000{low:02X}{high:02X}"),
            "181#01000000".to_owned(),
        ];
        let frames: Vec<Frame> = answers.iter().map(|text| frame(text, 1.0)).collect();
        decode(&mut *drive, &frames);
        assert_eq!(drive.state(), state, "{mapped}");
    }
}

/// It answers the last SYNC before its stamp, also if a later one was received first.
#[test]
fn a_node_of_each_second_sync_answers_the_last_before_its_stamp() {
    let keys = "sync = 2\ncounts_per_turn = 4";
    for (ms, acquired) in [(20.0, 20.0), (20.5, 20.0), (19.9, 10.0)] {
        let mut device = listener("canopen_encoder", keys, &[0]);
        let frames = [
            frame("080#", 10.0),
            frame("080#", 20.0),
            frame("181#01000000", ms),
        ];
        let (readings, _) = decode(&mut *device, &frames);
        assert_eq!(readings[0].acquired, frame("0#", acquired).t, "{ms}");
    }
}

/// A simulated drive sends after a SYNC what is due, and has no status of its own.
#[test]
fn simulated_nodes_measure_at_the_sync() {
    let keys = "counts_per_turn = 4\npdos = [{ number = 1, objects = [0x6064], sync = 1 }, \
                { number = 3, objects = [0x606C], sync = 2 }]";
    let started = spec(1, Mode::Listen, &[0]);
    let mut drive = options("canopen_drive", keys)
        .board(&started)
        .expect("legal keys");
    drive.present(0, &turned(0.25), Quality::GOOD);
    let ids = [1, 2, 3, 4].map(|_| {
        let mut out = Frames::new();
        drive.on_frame(&frame("080#", 1.0), &mut out);
        out.iter().map(|frame| frame.id.raw()).collect::<Vec<_>>()
    });
    assert_eq!(
        ids,
        [
            vec![0x181],
            vec![0x181, 0x381],
            vec![0x181],
            vec![0x181, 0x381]
        ]
    );
    let mut out = Frames::new();
    let actuator = Reading::Actuator(Actuator {
        duty: 0.0,
        mode: 0,
        encoder: 0,
        faults: 0,
    });
    assert_eq!(drive.encode(0, &actuator, Quality::GOOD, &mut out), Ok(()));
    let warm = Reading::Temperature(Temperature { celsius: 30.0 });
    let refused = drive.encode(0, &warm, Quality::GOOD, &mut out);
    assert_eq!((refused, out.len()), (Err(EncodeError::Kind), 0));

    let mut encoder = options("canopen_encoder", "counts_per_turn = 4\nsync = 1")
        .board(&started)
        .expect("legal keys");
    encoder.present(0, &turned(0.25), Quality::GOOD);
    encoder.on_frame(&frame("080#", 1.0), &mut out);
    assert_eq!(out[0].to_string(), "181#01000000");
    for board in [&drive, &encoder] {
        assert!(board.measures_at(&frame("080#", 1.0)));
        assert!(!board.measures_at(&frame("601#4000100000000000", 1.0)));
    }
    let strain = board("icub_strain", "", &[]);
    assert!(!strain.measures_at(&frame("080#", 1.0)));
}

/// A timer of 0 is none; all 32 bits of an entry are kept; an emergency ends with an empty one.
#[test]
fn a_simulated_node_keeps_what_is_written() {
    let mut node = options("canopen_encoder", "")
        .board(&spec(1, Mode::Listen, &[0]))
        .expect("legal keys");
    let mut ask = |text: &str| {
        let mut out = Frames::new();
        node.on_frame(&frame(text, 0.0), &mut out);
        let answer = out.first().map(ToString::to_string).unwrap_or_default();
        (answer, node.period())
    };
    let running = Some(Nanos::from_millis(10));
    assert_eq!(
        ask("601#4000180500000000"),
        ("581#4B0018050A000000".into(), running)
    );
    assert_eq!(
        ask("601#2B00180500000000"),
        ("581#6000180500000000".into(), None)
    );
    assert_eq!(
        ask("601#2B0018050A000000"),
        ("581#6000180500000000".into(), running)
    );
    assert_eq!(
        ask("601#23001801810100C0"),
        ("581#6000180100000000".into(), None)
    );
    assert_eq!(
        ask("601#4000180100000000"),
        ("581#43001801810100C0".into(), None)
    );
    let mut send = |quality| encode(&mut *node, 0, &turned(0.0), quality)[0].to_string();
    assert_eq!(send(Quality::DEVICE_FAULT), "081#0050010000000000");
    assert_eq!(send(Quality::GOOD), "081#0000000000000000");
}

/// Each key at the end of its range.
#[test]
fn the_ends_of_ranges_are_legal() {
    for (driver, keys) in [
        ("canopen_encoder", "sync = 240\nperiod_ms = 65535"),
        ("canopen_encoder", "period_ms = 1"),
        ("canopen_drive", "sync = 240\nperiod_ms = 65535"),
        ("canopen_drive", "period_ms = 1\nhold_ms = 0.0"),
        (
            "canopen_drive",
            "pdos = [{ number = 4, objects = [0x6064], sync = 240 }]",
        ),
    ] {
        let device = options(driver, keys).device(&spec(127, Mode::Listen, &[0]));
        assert!(device.is_ok(), "{driver} {keys}");
    }
    // The longest period is below the maximum silence, 50 ms here.
    for period in [0.5, 49.9] {
        let keys = format!("period_ms = {period:?}");
        let device = options("canopen_sync", &keys).device(&spec(0, Mode::Listen, &[]));
        assert!(device.is_ok(), "{keys}");
    }
}

#[test]
fn a_source_of_sync_is_due_when_it_says() {
    let mut device = supervisor("canopen_sync", "period_ms = 2.5", &[]);
    let (mut now, mut out) = (Nanos::from_millis(7), Decoded::new());
    // Its start.
    while device.next_wake().is_none_or(|wake| wake <= now) {
        if let Some(transmit) = device.poll_transmit(now, &mut out) {
            device.on_sent(&transmit.frame, Ok(now));
        }
    }
    for _ in 0..10 {
        assert_eq!(device.poll_transmit(now, &mut out), None);
        let wake = device.next_wake().expect("the next one");
        assert_eq!(wake, now + Nanos::from_micros(2500));
        now = wake;
        let transmit = device.poll_transmit(now, &mut out).expect("it is due");
        assert_eq!(transmit.frame.to_string(), "080#");
        device.on_sent(&transmit.frame, Ok(now));
    }
    assert_eq!(count(&out.faults, Counter::Silences), 0);
}

/// The host itself is the source.
#[test]
fn there_is_no_simulated_source_of_sync() {
    let mut nothing = board("canopen_sync", "", &[]);
    assert_eq!(nothing.period(), None);
    let refused = nothing.encode(3, &turned(0.0), Quality::GOOD, &mut Frames::new());
    assert_eq!(refused, Err(EncodeError::Output(3)));
}
