//! JR3 sensors: full scales that are asked for, and a counter in both halves.

use super::{FROZEN, Found, GAP, GOOD, faults_of, wrong_frames_are_counted};
use crate::rig::{
    Rig, board, decode, encode, frame, listener, options, reading, refused_at, shown_keys, spec,
    supervisor, texts, wrench,
};
use proprio_drivers::{
    Decoded, Device, Frame, Frames, Id, Mode, NotSent, SpecError, StampedReading, State,
};
use proprio_topics::{Counter, Nanos, Quality, Refusal, Saturation, StampKind};
use proptest::array::uniform6;
use proptest::prelude::*;

/// The full scales that `can-plotter.py` of roboticslab-uc3m/jr3-mbed-firmware-can has for one
/// sensor. As the board reports them: whole N, and tenths of Nm.
const JR3: &str = "full_scale_n = [115, 111, 185]\nfull_scale_nm = [5.6, 5.2, 6.1]\n";

/// The bytes are made up; the values are those of the formula in `can-plotter.py`, raw / 16384
/// times the full scale.
const JR3_FRAMES: [&str; 2] = ["601#004000C001003412", "681#FFFF002000E03412"];

#[test]
fn force_and_moment_of_a_jr3_are_one_reading() {
    let frames = [frame(JR3_FRAMES[0], 10.0), frame(JR3_FRAMES[1], 10.2)];
    let (readings, faults) = decode(&mut *listener("jr3_can", JR3, &[]), &frames);
    assert!(faults.is_empty(), "{faults:?}");
    assert_eq!(readings.len(), 1);
    assert_eq!(
        (readings[0].acquired, readings[0].stamp),
        (frames[0].t, StampKind::Software)
    );
    assert_eq!(readings[0].quality, Quality::DEVICE_COUNTER);
    assert_eq!(readings[0].device_counter, 0x1234);
    let read = wrench(&readings[0].reading);
    let expected = [115.0, -111.0, 185.0 / 16384.0, -5.6 / 16384.0, 2.6, -3.05];
    for (value, expected) in read.force.iter().chain(&read.torque).zip(expected) {
        assert!((value - expected).abs() < 1e-12, "{read:?}");
    }
    let mut board = board("jr3_can", JR3, &[]);
    let back = encode(&mut *board, 0, &readings[0].reading, Quality::GOOD);
    // The board's counter begins with its own time: 10 ms are 77 samples.
    assert_eq!(
        texts(&back),
        ["601#004000C001004D00", "681#FFFF002000E04D00"]
    );
}

/// The half of a reading with `counter`, which is also its fx and mx, at `ms`.
fn half(name: &str, ms: f64) -> Frame {
    let counter: u16 = name[1..].parse().unwrap();
    let [low, high] = counter.to_le_bytes();
    let id = if name.starts_with('F') { 0x601 } else { 0x681 };
    Frame::new(Id::standard(id), &[low, high, 0, 0, 0, 0, low, high])
        .at(Nanos::from_seconds(ms * 1e-3), StampKind::Software)
}

/// What is read of `halves`.
fn jr3(keys: &str, halves: &[(&str, f64)]) -> Found {
    let keys = format!("full_scale_n = [16384, 1, 1]\nfull_scale_nm = [16384, 1, 1]\n{keys}");
    let frames: Vec<Frame> = halves.iter().map(|(name, ms)| half(name, *ms)).collect();
    let (readings, faults) = decode(&mut *listener("jr3_can", &keys, &[]), &frames);
    let counter = |stamped: &StampedReading| {
        let read = wrench(&stamped.reading);
        let counter = f64::from((stamped.device_counter as u16).cast_signed());
        assert_eq!([read.force[0], read.torque[0]], [counter; 2], "{stamped:?}");
        (stamped.device_counter, stamped.quality)
    };
    (readings.iter().map(counter).collect(), faults_of(&faults))
}

#[test]
fn the_counter_tells_which_halves_of_a_jr3_belong_together() {
    // 10 ms are 78 samples.
    let before = [("F100", 0.0), ("M100", 0.2)];
    let after = [
        ("F412", 40.0),
        ("M412", 40.2),
        ("F490", 50.0),
        ("M490", 50.2),
    ];
    let check = |middle: &[(&str, f64)], read: &[(u32, Quality)], faults: &[(Counter, u32)]| {
        let halves = [&before[..], middle, &after[..]].concat();
        let expected = [&[(100, GOOD)], read, &[(490, GOOD)]].concat();
        assert_eq!(jr3("", &halves), (expected, faults.to_vec()), "{middle:?}");
    };
    use Counter::{Lost, Unpaired};
    check(&[], &[(412, GAP)], &[(Lost, 3)]);
    let (two, three) = (("F178", 10.0), [("F256", 20.0), ("M256", 20.2)]);
    let last = [("F334", 30.0), ("M334", 30.2)];
    let with = |middle: &[(&'static str, f64)]| [middle, &last[..]].concat();
    // A moment is lost: its force waits until the next one.
    check(
        &with(&[two, three[0], three[1]]),
        &[(256, GAP), (334, GOOD), (412, GOOD)],
        &[(Unpaired, 1), (Lost, 1)],
    );
    // A force is lost.
    check(
        &with(&[("M178", 10.2), three[0], three[1]]),
        &[(256, GAP), (334, GOOD), (412, GOOD)],
        &[(Unpaired, 1), (Lost, 1)],
    );
    // A moment and the next force are lost, which no time tells from a late moment.
    check(
        &with(&[two, ("M256", 10.3)]),
        &[(334, GAP), (412, GOOD)],
        &[(Unpaired, 1), (Unpaired, 1), (Lost, 2)],
    );
    // A moment comes after the next force.
    check(
        &with(&[two, three[0], ("M178", 20.1), three[1]]),
        &[(256, GAP), (334, GOOD), (412, GOOD)],
        &[(Unpaired, 1), (Unpaired, 1), (Lost, 1)],
    );
    // Doubled frames.
    check(
        &with(&[two, two, ("M178", 10.2), ("M178", 10.3), three[0], three[1]]),
        &[(178, GAP), (256, GAP), (334, GOOD), (412, GOOD)],
        &[(Unpaired, 1), (Unpaired, 1)],
    );
    // The stream is joined between two halves.
    let joined = [("M22", 0.2), ("F100", 1.0), ("M100", 1.2)];
    assert_eq!(jr3("", &joined), (vec![(100, GOOD)], vec![]));
}

#[test]
fn a_jr3_that_repeats_itself_is_frozen() {
    let halves = [
        ("F100", 0.0),
        ("M100", 0.2),
        ("F100", 10.0),
        ("M100", 10.2),
        ("F178", 20.0),
        ("M178", 20.2),
    ];
    let (readings, faults) = jr3("", &halves);
    assert_eq!(readings, [(100, GOOD), (100, FROZEN), (178, GOOD)]);
    assert!(faults.is_empty());
    let sent = reading([1.0; 3], [0.1; 3]);
    let mut board = board("jr3_can", JR3, &[]);
    let first = encode(&mut *board, 0, &sent, Quality::GOOD);
    assert_eq!(encode(&mut *board, 0, &sent, Quality::FROZEN), first);
    assert_ne!(encode(&mut *board, 0, &sent, Quality::GOOD), first);
}

/// At 1 kHz seven to nine samples lie between two readings; the counter wraps within 8.5 s.
#[test]
fn lost_readings_of_a_jr3_are_counted_by_their_time() {
    for (step, lost) in [(1, 0), (7, 0), (9, 0), (15, 1), (17, 1), (23, 2), (778, 99)] {
        for begin in [0_u16, 65_533] {
            let names =
                [begin, begin.wrapping_add(step)].map(|k| [format!("F{k}"), format!("M{k}")]);
            let halves: Vec<(&str, f64)> = (names.iter().flatten())
                .map(|name| (name.as_str(), 0.0))
                .collect();
            let (readings, faults) = jr3("period_ms = 1", &halves);
            let gap = if lost > 0 { GAP } else { GOOD };
            assert_eq!(readings[1].1, gap, "{step}");
            let expected = if lost > 0 {
                vec![(Counter::Lost, lost)]
            } else {
                vec![]
            };
            assert_eq!(faults, expected, "{step}");
        }
    }
}

#[test]
fn wrong_frames_of_a_jr3_are_counted() {
    let mut device = listener("jr3_can", JR3, &[]);
    for id in [0x601, 0x681] {
        wrong_frames_are_counted(&mut *device, id, 7);
        wrong_frames_are_counted(&mut *device, id, 0);
    }
    wrong_frames_are_counted(&mut *device, 0x101, 6);
    wrong_frames_are_counted(&mut *device, 0x101, 0);
    wrong_frames_are_counted(&mut *device, 0x701, 1);
    // Another board's frames, and operations that are of no interest.
    for text in ["602#0000", "781#00000000", "401#", "001#", "682#00"] {
        let (readings, faults) = decode(&mut *device, &[frame(text, 0.0)]);
        assert!(readings.is_empty() && faults.is_empty(), "{text}");
    }
}

#[test]
fn a_jr3_is_asked_started_and_stopped() {
    let load = |n: f64| {
        (
            0,
            reading([10.0 * n, 0.0, -20.0 * n], [0.5 * n, 0.0, 1.0 * n]),
        )
    };
    // As the firmware's README starts board 1: 2 Hz, 10 ms.
    let mut rig = Rig::new("jr3_can", "cutoff_hz = 2.0", &[], load(1.0));
    rig.run(50);
    let commands = ["481#", "501#", "201#C80010270000"];
    assert_eq!(rig.sent, commands);
    assert_eq!(
        (rig.device.state(), rig.readings.len(), rig.faults.len()),
        (State::Streaming, 5, 1)
    );
    // The start took the load as the zero.
    rig.reading = load(2.0);
    rig.run(20);
    let qualities: Vec<Quality> = rig.readings.iter().map(|r| r.quality).collect();
    let zeroed = GOOD | Quality::ZERO_CHANGED;
    assert_eq!(qualities, [zeroed, GOOD, GOOD, GOOD, GOOD, GOOD, GOOD]);
    assert_eq!(wrench(&rig.readings[4].reading).force, [0.0; 3]);
    let read = wrench(&rig.readings[5].reading);
    assert!((read.force[0] - 10.0).abs() < 0.01 && (read.force[2] + 20.0).abs() < 0.02);
    assert!((read.torque[0] - 0.5).abs() < 5e-4 && (read.torque[2] - 1.0).abs() < 5e-4);
    rig.board_loses = Box::new(|_, _| true);
    rig.run(200);
    assert!(rig.states.contains(&State::Silent));
    rig.board_loses = Box::new(|_, _| false);
    // Fifteen answers are waited for.
    rig.run(2500);
    assert_eq!(rig.sent[3], "481#");
    assert_eq!(rig.sent[rig.sent.len() - 3..], commands);
    // The board never stopped, and was started again with another zero.
    assert_eq!(rig.readings[7].quality, GAP);
    let changed = |r: &&StampedReading| r.quality.contains(Quality::ZERO_CHANGED);
    assert_eq!(rig.readings[8..].iter().filter(changed).count(), 1);
    rig.device.stop(rig.now);
    rig.run(30);
    assert_eq!(rig.sent.last().unwrap(), "281#");
    assert_eq!(
        (rig.device.state(), rig.board.period()),
        (State::Stopped, None)
    );
    let mut rig = Rig::new("jr3_can", &format!("{JR3}period_ms = 1000"), &[], load(1.0));
    rig.run(5);
    assert_eq!(
        rig.sent,
        ["201#000040420F00"],
        "configured scales are not asked"
    );
}

/// Until the start is acknowledged, a board that streams already may send the old zero or the new.
#[test]
fn all_readings_around_a_new_zero_of_a_jr3_are_marked() {
    let sent = (0, reading([1.0; 3], [0.1; 3]));
    let marked = |ack_lost: bool| {
        let mut rig = Rig::started("jr3_can", JR3, Mode::Supervise, sent);
        rig.board_loses = Box::new(move |_, frame| ack_lost && frame.len() == 1);
        rig.run(150);
        let changed = |r: &StampedReading| r.quality.contains(Quality::ZERO_CHANGED);
        let marks: Vec<bool> = rig.readings.iter().map(changed).collect();
        assert_eq!(marks.len(), 15);
        marks.iter().take_while(|mark| **mark).count()
    };
    assert_eq!(marked(false), 1);
    assert_eq!(marked(true), 11);
    // Another program's commands, and a boot-up.
    for command in ["181#0000", "201#000010270000", "301#", "701#"] {
        let mut device = listener("jr3_can", JR3, &[]);
        let pair = |ms: f64| JR3_FRAMES.map(|text| frame(text, ms));
        assert_eq!(decode(&mut *device, &pair(0.0)).0[0].quality, GOOD);
        let (readings, faults) = decode(&mut *device, &[frame(command, 5.0)]);
        assert!(readings.is_empty() && faults.is_empty());
        if command != "701#" {
            let old = decode(&mut *device, &pair(5.5)).0[0].quality;
            assert!(old.contains(Quality::ZERO_CHANGED), "{command}");
            decode(&mut *device, &[frame("101#00", 6.0)]);
        }
        let first = decode(&mut *device, &pair(10.0)).0[0].quality;
        assert!(first.contains(Quality::ZERO_CHANGED), "{command}");
        let next = decode(&mut *device, &pair(20.0)).0[0].quality;
        assert!(!next.contains(Quality::ZERO_CHANGED), "{command}");
    }
}

#[test]
fn a_jr3_that_boots_is_started_again() {
    let sent = (0, reading([1.0; 3], [0.1; 3]));
    let mut rig = Rig::new("jr3_can", "", &[], sent);
    rig.run(30);
    assert_eq!((rig.sent.len(), rig.readings.len()), (3, 3));
    // The board, and half a reading of before.
    rig.board = board("jr3_can", "", &[]);
    decode(
        &mut *rig.device,
        &[half("F7", 1029.0), frame("701#", 1029.5)],
    );
    let (readings, faults) = decode(&mut *rig.device, &[half("M7", 1029.8)]);
    assert!(readings.is_empty() && faults.is_empty());
    rig.run(30);
    assert_eq!(rig.sent[3..], rig.sent[..3]);
    assert_eq!(
        (rig.count(Counter::Starts), rig.count(Counter::Lost)),
        (2, 0)
    );
    let first = rig.readings[3].quality;
    assert_eq!(first, GAP | Quality::ZERO_CHANGED);
}

#[test]
fn lost_questions_and_answers_of_a_jr3_are_asked_again() {
    let mut rig = Rig::new("jr3_can", "", &[], (0, reading([1.0; 3], [0.1; 3])));
    let mut turn = 0;
    rig.host_loses = Box::new(move |_, frame| {
        turn += 1;
        frame.is_empty() && turn % 3 == 1
    });
    let mut answers = 0;
    rig.board_loses = Box::new(move |_, frame| {
        answers += u32::from(frame.len() == 7);
        frame.len() == 7 && answers % 2 == 1
    });
    rig.run(3000);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(
        rig.count(Counter::Unexpected) + rig.count(Counter::Changed),
        0
    );
    let asked = |text: &str| rig.sent.iter().filter(|sent| *sent == text).count();
    assert_eq!((asked("481#"), asked("501#")), (3, 3));
    // The host's own bus does not take them at first.
    let mut rig = Rig::new("jr3_can", "", &[], (0, reading([1.0; 3], [0.1; 3])));
    let mut left = 4;
    rig.interface = Box::new(move |_| {
        left -= i32::from(left > 0);
        (left > 0).then_some(NotSent::Deadline)
    });
    rig.run(200);
    assert_eq!((rig.sent.len(), rig.unsent.len()), (3, 3));
}

/// A device that has sent `question` at `ms`, and that of the next one.
fn ask(device: &mut dyn Device, question: &str, ms: i64) {
    let (mut out, now) = (Decoded::new(), Nanos::from_millis(ms));
    let next = device.poll_transmit(now, &mut out).map(|t| t.frame);
    assert_eq!(
        next.map(|f| f.to_string()).as_deref(),
        Some(question),
        "{ms}"
    );
    device.on_sent(&next.unwrap(), Ok(now));
}

fn quiet(device: &mut dyn Device, ms: i64) {
    let next = device.poll_transmit(Nanos::from_millis(ms), &mut Decoded::new());
    assert_eq!(next, None, "{ms}");
}

/// A slow board answers the first question after it was repeated. Its second answer must not be
/// taken for the full scales of moments.
#[test]
fn a_late_answer_of_a_jr3_is_not_taken_for_another_one() {
    let device = || supervisor("jr3_can", "", &[]);
    let forces = "101#0073006F00B900";
    let moments = "101#00380034003D00";
    let mut one = device();
    ask(&mut *one, "481#", 0);
    quiet(&mut *one, 19);
    assert_eq!(one.next_wake(), Some(Nanos::from_millis(20)));
    ask(&mut *one, "481#", 20);
    assert!(decode(&mut *one, &[frame(forces, 30.0)]).1.is_empty());
    // One answer is still to come.
    quiet(&mut *one, 31);
    assert_eq!(one.next_wake(), Some(Nanos::from_millis(1020) + Nanos(1)));
    assert!(decode(&mut *one, &[frame(forces, 50.0)]).1.is_empty());
    assert!(one.next_wake().unwrap() < Nanos::from_millis(50));
    ask(&mut *one, "501#", 51);
    assert!(decode(&mut *one, &[frame(moments, 52.0)]).1.is_empty());
    ask(&mut *one, "201#000010270000", 53);
    let pair = |ms: f64| JR3_FRAMES.map(|text| frame(text, ms));
    let read = wrench(&decode(&mut *one, &pair(60.0)).0[0].reading);
    assert!((read.force[0] - 115.0).abs() < 1e-9 && (read.torque[2] + 3.05).abs() < 1e-9);
    let (_, faults) = decode(&mut *one, &[frame(forces, 61.0)]);
    assert_eq!(faults_of(&faults), [(Counter::Unexpected, 1)]);
    // An answer that does not come any more is waited for no longer than it would count.
    let mut two = device();
    ask(&mut *two, "481#", 0);
    ask(&mut *two, "481#", 20);
    decode(&mut *two, &[frame(forces, 30.0)]);
    quiet(&mut *two, 1020);
    ask(&mut *two, "501#", 1021);
    decode(&mut *two, &[frame(moments, 1022.0)]);
    ask(&mut *two, "201#000010270000", 1023);
    let (_, faults) = decode(&mut *two, &[frame(moments, 1024.0)]);
    assert_eq!(faults_of(&faults), [(Counter::Unexpected, 1)]);
    // Answers that come too late do not count.
    let mut three = device();
    ask(&mut *three, "481#", 0);
    let (_, faults) = decode(&mut *three, &[frame(forces, 1001.0)]);
    assert_eq!(faults_of(&faults), [(Counter::Unexpected, 1)]);
    ask(&mut *three, "481#", 1002);
    // The time counts from when the question was sent.
    let (mut late, mut out) = (device(), Decoded::new());
    let question = late.poll_transmit(Nanos::ZERO, &mut out).unwrap().frame;
    late.on_sent(&question, Ok(Nanos::from_millis(500)));
    assert!(decode(&mut *late, &[frame(forces, 1400.0)]).1.is_empty());
    // Another program's question is not this host's.
    let mut other = device();
    ask(&mut *other, "481#", -2);
    decode(&mut *other, &[frame(forces, -1.0)]);
    let (_, faults) = decode(&mut *other, &[frame("501#", 0.0), frame(moments, 0.2)]);
    assert_eq!(faults_of(&faults), [(Counter::Unexpected, 1)]);
    let (_, faults) = decode(&mut *other, &[frame("481#", 1.0), frame(forces, 1.2)]);
    assert_eq!(faults_of(&faults), [(Counter::Unexpected, 1)]);
    // The board answers all that was asked while it booted, after it says so.
    let mut four = device();
    for k in 0..5 {
        ask(&mut *four, "481#", 20 * k);
    }
    decode(&mut *four, &[frame("701#", 90.0)]);
    ask(&mut *four, "481#", 91);
    for k in 0..6 {
        let ms = 92.0 + f64::from(k) * 0.2;
        quiet(&mut *four, 92);
        assert!(decode(&mut *four, &[frame(forces, ms)]).1.is_empty());
    }
    ask(&mut *four, "501#", 95);
    decode(&mut *four, &[frame(moments, 96.0)]);
    ask(&mut *four, "201#000010270000", 97);
}

/// From when it was asked, even if they come before the bus tells that it was. Each question has
/// one.
#[test]
fn answers_of_a_jr3_count_for_a_second() {
    let forces = "101#0073006F00B900";
    let device = || supervisor("jr3_can", "", &[]);
    let mut last = device();
    ask(&mut *last, "481#", 0);
    assert_eq!(last.state(), State::Asking);
    assert!(decode(&mut *last, &[frame(forces, 1000.0)]).1.is_empty());
    ask(&mut *last, "501#", 1001);
    let mut two = device();
    ask(&mut *two, "481#", 0);
    ask(&mut *two, "481#", 1000);
    for ms in [1000.0, 1000.5] {
        assert!(decode(&mut *two, &[frame(forces, ms)]).1.is_empty());
    }
    let (mut early, mut out) = (device(), Decoded::new());
    let now = Nanos::from_millis(1000);
    let question = early.poll_transmit(now, &mut out).unwrap().frame;
    assert!(decode(&mut *early, &[frame(forces, 1000.5)]).1.is_empty());
    early.on_sent(&question, Ok(now));
    ask(&mut *early, "501#", 1020);
}

#[test]
fn a_jr3_without_usable_full_scales_is_refused() {
    let sent = (0, reading([1.0; 3], [0.1; 3]));
    let mut rig = Rig::new("jr3_can", "", &[], sent);
    rig.board_loses = Box::new(|_, frame| frame.len() == 7);
    rig.run(400);
    assert_eq!(rig.device.state(), State::Refused(Refusal::NoFullScale));
    // Asked again, slowly, and used as soon as it answers.
    assert_eq!(rig.sent.len(), 16);
    rig.board_loses = Box::new(|_, _| false);
    rig.run(2500);
    assert_eq!(rig.device.state(), State::Streaming);
    let answers = |texts: &[&str]| {
        let mut device = supervisor("jr3_can", "", &[]);
        let mut faults = Vec::new();
        for (k, text) in (0..).zip(texts) {
            let question = if text.ends_with("3D00") {
                "501#"
            } else {
                "481#"
            };
            ask(&mut *device, question, 1000 * k);
            let ms = 1000.0 * k as f64 + 1.0;
            faults.extend(decode(&mut *device, &[frame(text, ms)]).1);
        }
        (device.state(), faults_of(&faults))
    };
    let zero = Refusal::ZeroFullScale { channel: 2 };
    assert_eq!(answers(&["101#0073006F000000"]).0, State::Refused(zero));
    let zero = Refusal::ZeroFullScale { channel: 3 };
    let good = "101#0073006F00B900";
    assert_eq!(
        answers(&[good, "101#00000034003D00"]).0,
        State::Refused(zero)
    );
    // Repaired meanwhile.
    let repaired = ["101#0073006F000000", good, "101#00380034003D00"];
    assert_eq!(answers(&repaired), (State::Asking, vec![]));
    // A board without a sensor answers with numbers that mean nothing.
    let (state, faults) = answers(&["101#0173006F00B900", good]);
    assert_eq!(state, State::Refused(Refusal::NoFullScale));
    assert_eq!(faults, [(Counter::DeviceFault, 1)]);
    let mut device = listener("jr3_can", JR3, &[]);
    let (_, faults) = decode(&mut *device, &[frame("101#01", 0.0), frame("101#00", 0.0)]);
    assert_eq!(faults_of(&faults), [(Counter::DeviceFault, 1)]);
}

/// Another sensor, without a word: the readings since then cannot be trusted.
#[test]
fn a_jr3_whose_full_scales_change_is_refused() {
    let mut rig = Rig::new("jr3_can", "", &[], (0, reading([1.0; 3], [0.1; 3])));
    rig.run(30);
    rig.board = board("jr3_can", &JR3.replace("185", "184"), &[]);
    rig.device.restart(rig.now);
    rig.run(100);
    assert_eq!(rig.device.state(), State::Refused(Refusal::Changed));
    assert_eq!((rig.count(Counter::Changed), rig.readings.len()), (1, 3));
    assert_eq!((rig.sent.len(), rig.device.next_wake()), (4, None));
    let pair = JR3_FRAMES.map(|text| frame(text, 2000.0));
    assert!(decode(&mut *rig.device, &pair).0.is_empty());
}

#[test]
fn a_listener_learns_full_scales_from_what_it_hears() {
    let pair = |ms: f64| JR3_FRAMES.map(|text| frame(text, ms));
    let mut device = listener("jr3_can", "", &[]);
    assert!(decode(&mut *device, &pair(0.0)).0.is_empty());
    assert_eq!(device.state(), State::Refused(Refusal::NoFullScale));
    // Without the questions, answers could be either.
    let (_, faults) = decode(&mut *device, &[frame("101#0073006F00B900", 1.0)]);
    assert_eq!(faults_of(&faults), [(Counter::Unexpected, 1)]);
    let heard = [
        frame("501#", 2.0),
        frame("101#00380034003D00", 2.3),
        frame("481#", 5000.0),
        frame("101#0073006F00B900", 5000.3),
    ];
    assert!(decode(&mut *device, &heard).1.is_empty());
    let (readings, _) = decode(&mut *device, &pair(5010.0));
    let read = wrench(&readings[0].reading);
    assert!((read.force[0] - 115.0).abs() < 1e-9 && (read.torque[2] + 3.05).abs() < 1e-9);
    assert_eq!(device.state(), State::Streaming);
    let mut device = listener("jr3_can", "", &[]);
    decode(
        &mut *device,
        &[frame("481#", 0.0), frame("101#0073000000B900", 0.3)],
    );
    decode(&mut *device, &pair(1.0));
    let channel = 1;
    assert_eq!(
        device.state(),
        State::Refused(Refusal::ZeroFullScale { channel })
    );
}

#[test]
fn the_keys_of_a_jr3_stand_before_its_own_full_scales() {
    let mut device = listener("jr3_can", JR3, &[]);
    let heard = [
        frame("481#", 0.0),
        frame("101#000A000A000A00", 0.3),
        frame("501#", 1.0),
        frame("101#000A000A000A00", 1.3),
    ];
    assert!(decode(&mut *device, &heard).1.is_empty());
    let pair = JR3_FRAMES.map(|text| frame(text, 10.0));
    let (readings, _) = decode(&mut *device, &pair);
    let read = wrench(&readings[0].reading);
    assert!((read.force[0] - 115.0).abs() < 1e-9 && (read.torque[2] + 3.05).abs() < 1e-9);
    assert_eq!(device.full_scale().map(|all| all[0]), Some(115.0));
}

/// Which of two full scales is right is not known, whatever is told after them.
#[test]
fn a_jr3_whose_full_scales_have_changed_stays_refused() {
    let mut device = listener("jr3_can", "", &[]);
    let mut hear = |question: &str, answer: &str| {
        let (_, faults) = decode(&mut *device, &[frame(question, 0.0), frame(answer, 0.3)]);
        (device.state(), faults_of(&faults))
    };
    let first = "101#0073006F00B900";
    hear("481#", first);
    hear("501#", "101#00380034003D00");
    let refused = State::Refused(Refusal::Changed);
    let (state, faults) = hear("481#", "101#0073006F00B800");
    assert_eq!((state, faults), (refused, vec![(Counter::Changed, 1)]));
    assert_eq!(hear("481#", first), (refused, vec![]));
    let pair = JR3_FRAMES.map(|text| frame(text, 10.0));
    assert!(decode(&mut *device, &pair).0.is_empty());
}

#[test]
fn wrong_keys_of_a_jr3_are_refused() {
    for (keys, key, value, expected) in [
        (
            "period_ms = 0",
            "period_ms",
            0.0,
            "an integer from 1 to 1000",
        ),
        (
            "period_ms = 1001",
            "period_ms",
            1001.0,
            "an integer from 1 to 1000",
        ),
        ("cutoff_hz = -0.1", "cutoff_hz", -0.1, "from 0 to 655.35"),
        (
            "cutoff_hz = 655.36",
            "cutoff_hz",
            655.36,
            "from 0 to 655.35",
        ),
        (
            "full_scale_n = [1, 0, 1]\nfull_scale_nm = [1, 1, 1]",
            "full_scale_n",
            0.0,
            "above 0 and at most 65535",
        ),
    ] {
        let refused = SpecError::Key {
            key,
            value,
            expected,
        };
        assert_eq!(refused_at("jr3_can", keys, 1), refused);
    }
    // The key that is named is the one of the wrong number, and 65535 is the most that fits.
    for (at, key) in (0..6).zip([["full_scale_n"; 3], ["full_scale_nm"; 3]].concat()) {
        for value in [0.0, -1.0, 65536.0, f64::INFINITY] {
            let mut all = [65535.0; 6];
            all[at] = value;
            let (force, torque) = all.split_at(3);
            let keys = format!("full_scale_n = {force:?}\nfull_scale_nm = {torque:?}");
            let refused = SpecError::Key {
                key,
                value,
                expected: "above 0 and at most 65535",
            };
            assert_eq!(refused_at("jr3_can", &keys, 1), refused);
        }
    }
    let most = "full_scale_n = [65535, 65535, 65535]\nfull_scale_nm = [65535, 65535, 65535]";
    let scale = listener("jr3_can", most, &[]).full_scale();
    assert_eq!(scale, Some([65535.0; 6]));
    let nan = options("jr3_can", "cutoff_hz = nan");
    assert!(nan.device(&spec(1, Mode::Supervise, &[])).is_err());
    let (given, missing) = ("full_scale_n", "full_scale_nm");
    let half = refused_at("jr3_can", "full_scale_n = [1, 1, 1]", 1);
    assert_eq!(half, SpecError::Incomplete { given, missing });
    for address in [0, 128] {
        let (least, most) = (1, 127);
        let refused = SpecError::Address {
            address,
            least,
            most,
        };
        assert_eq!(refused_at("jr3_can", "", address), refused);
    }
    let shown = shown_keys(include_str!("../../../../docs/book/src/devices/jr3_can.md"));
    assert_eq!(options("jr3_can", shown), options("jr3_can", JR3));
    assert_eq!(options("jr3_can", "").default_address(), Some(1));
}

#[test]
fn two_jr3s_do_not_disturb_each_other() {
    let claims = |address| {
        let device = options("jr3_can", "")
            .device(&spec(address, Mode::Supervise, &[]))
            .unwrap();
        device.claims().to_vec()
    };
    let (one, two) = (claims(1), claims(0x7F));
    let exclusive = |claims: &[proprio_drivers::Claim]| {
        let claims = claims.iter().filter(|claim| claim.exclusive);
        claims.map(|claim| claim.id.raw()).collect::<Vec<_>>()
    };
    assert_eq!(exclusive(&one), [0x601, 0x681, 0x101, 0x701]);
    assert_eq!(exclusive(&two), [0x67F, 0x6FF, 0x17F, 0x77F]);
    assert!(!one.iter().any(|a| two.iter().any(|b| a.overlaps(b))));
}

#[test]
fn a_jr3_at_an_end_of_its_range_is_saturated() {
    let far = reading([1e6, -1e6, 0.0], [0.0, 1e6, -1e6]);
    let ends = [
        (0, Saturation::High),
        (1, Saturation::Low),
        (4, Saturation::High),
        (5, Saturation::Low),
    ];
    let expected = ends.into_iter().fold(GOOD, |quality, (axis, end)| {
        quality.with_saturation(axis, end)
    });
    let within = reading([1.0; 3], [0.1; 3]);
    for (sent, quality) in [(far, Quality::GOOD), (within, expected)] {
        let frames = encode(&mut *board("jr3_can", JR3, &[]), 0, &sent, quality);
        let (readings, faults) = decode(&mut *listener("jr3_can", JR3, &[]), &frames);
        assert_eq!(readings[0].quality, expected);
        assert_eq!(faults_of(&faults), [(Counter::Saturated, 1)]);
        let read = wrench(&readings[0].reading);
        assert_eq!(read.force[1], -222.0);
        assert!((read.torque[1] - 32767.0 / 16384.0 * 5.2).abs() < 1e-9);
    }
}

#[test]
fn a_jr3_board_answers_its_own_commands_only() {
    let mut board = board("jr3_can", "", &[]);
    let mut answer = |text: &str| {
        let mut out = Frames::new();
        board.on_frame(&frame(text, 0.0), &mut out);
        (texts(&out).join(" "), board.period())
    };
    let at = |us| Some(Nanos::from_micros(us));
    let acknowledged = "101#00".to_owned();
    assert_eq!(answer("482#"), (String::new(), None));
    assert_eq!(answer("481#"), ("101#0073006F00B900".to_owned(), None));
    assert_eq!(answer("501#"), ("101#00380034003D00".to_owned(), None));
    assert_eq!(answer("401#"), (acknowledged.clone(), None));
    assert_eq!(answer("201#0000D2040000"), (acknowledged.clone(), at(1234)));
    assert_eq!(answer("201#000000000000"), (acknowledged.clone(), at(1234)));
    assert_eq!(answer("301#"), (acknowledged.clone(), at(1234)));
    assert_eq!(answer("281#"), (acknowledged, None));
}

proptest! {
    #[test]
    fn a_jr3_is_read_back(
        scales in uniform6(1.0_f64..60000.0), parts in uniform6(-1.99_f64..1.99),
    ) {
        let [a, b, c, d, e, f] = scales;
        let keys = format!(
            "full_scale_n = [{a:?}, {b:?}, {c:?}]\nfull_scale_nm = [{d:?}, {e:?}, {f:?}]"
        );
        let [u, v, w, x, y, z] = parts;
        let (force, torque) = ([u * a, v * b, w * c], [x * d, y * e, z * f]);
        let sent = reading(force, torque);
        let frames = encode(&mut *board("jr3_can", &keys, &[]), 0, &sent, Quality::GOOD);
        let (readings, _) = decode(&mut *listener("jr3_can", &keys, &[]), &frames);
        let back = wrench(&readings[0].reading);
        prop_assert_eq!(readings[0].quality, GOOD);
        for k in 0..3 {
            let near = |a: f64, b: f64, scale: f64| (a - b).abs() <= scale / 32768.0 * 1.000001;
            prop_assert!(near(back.force[k], force[k], scales[k]));
            prop_assert!(near(back.torque[k], torque[k], scales[k + 3]));
        }
    }

    /// Any frames lost, doubled or exchanged with the next one: no reading is of two, and each half
    /// is in a reading, counted, or still waiting.
    #[test]
    fn halves_of_two_jr3_readings_are_never_put_together(
        fates in proptest::collection::vec(0_u8..10, 2..120),
    ) {
        let mut names = Vec::new();
        for (k, fate) in fates.iter().enumerate() {
            let name = format!("{}{}", if k % 2 == 0 { 'F' } else { 'M' }, 100 + 78 * (k / 2));
            match fate {
                0 => {}
                1 => names.extend([name.clone(), name]),
                2 if !names.is_empty() => names.insert(names.len() - 1, name),
                _ => names.push(name),
            }
        }
        // Before the first force, moments are not counted.
        let first = names.iter().position(|name| name.starts_with('F')).unwrap_or(names.len());
        let halves: Vec<(&str, f64)> = names.iter().map(|name| (name.as_str(), 0.0)).collect();
        let (readings, faults) = jr3("", &halves);
        let unpaired: u32 = (faults.iter())
            .filter(|(counter, _)| *counter == Counter::Unpaired)
            .map(|(_, count)| *count)
            .sum();
        let seen = 2 * readings.len() + unpaired as usize;
        let heard = names.len() - first;
        prop_assert!((heard.saturating_sub(1)..=heard).contains(&seen), "{} {}", seen, heard);
    }
}
