//! ATI NETCANOEM: a session that Python wrote from the manual's tables, halves out of step, and the
//! questions for the calibration.

use crate::rig::{
    Rig, board, count, decode, encode, frame, listener, options, poll, spec, supervisor,
};
use proprio_drivers::{
    Decoded, Device, Fault, Frame, Mode, NotSent, Options, SpecError, StampedReading, State,
};
use proprio_topics::{Counter, Nanos, Quality, Reading, Refusal, Wrench};
use proptest::prelude::*;

/// A calibration in the keys: 0.01 N and 0.001 Nm per count.
pub(crate) const KEYS: &str = r#"
counts_per_force = 100
counts_per_torque = 1000
force_unit = "N"
torque_unit = "Nm"
matrix = [
    [1, 0, 0, 0, 0, 0],
    [0, 1, 0, 0, 0, 0],
    [0, 0, 1, 0, 0, 0],
    [0, 0, 0, 1, 0, 0],
    [0, 0, 0, 0, 1, 0],
    [0, 0, 0, 0, 0, 1],
]
"#;

fn values(reading: &Reading) -> [f64; 6] {
    match reading {
        Reading::Wrench(Wrench { force, torque }) => {
            let ([fx, fy, fz], [tx, ty, tz]) = (*force, *torque);
            [fx, fy, fz, tx, ty, tz]
        }
        other => panic!("{other:?}"),
    }
}

fn wrench(values: [f64; 6]) -> Reading {
    let [fx, fy, fz, tx, ty, tz] = values;
    Reading::Wrench(Wrench {
        force: [fx, fy, fz],
        torque: [tx, ty, tz],
    })
}

const LOAD: [f64; 6] = [10.0, -20.0, 30.0, 1.0, -0.5, 0.25];

/// A session, `tests/oracle/frames/ati.py`.
const SESSION: &str = include_str!("ati.txt");

/// Its frames in the order of the file, 0.2 ms apart or without stamps, and its wrenches.
fn session(stamped: bool) -> (Vec<Frame>, Vec<[f64; 6]>) {
    let (mut frames, mut wrenches) = (Vec::new(), Vec::new());
    for line in SESSION.lines() {
        if let Some(numbers) = line.strip_prefix("wrench ") {
            let numbers: Vec<f64> = numbers.split(' ').map(|n| n.parse().unwrap()).collect();
            wrenches.push(numbers.try_into().unwrap());
        } else {
            let mut frame = frame(line, frames.len() as f64 * 0.2);
            if !stamped {
                frame.stamp = proprio_topics::StampKind::None;
            }
            frames.push(frame);
        }
    }
    (frames, wrenches)
}

fn session_listener(keys: &str) -> Box<dyn Device> {
    let listen = spec(0x3F, Mode::Listen, &[]);
    options("ati_netcanoem", keys).device(&listen).unwrap()
}

fn assert_read(readings: &[StampedReading], wrenches: &[[f64; 6]]) {
    assert_eq!(readings.len(), wrenches.len());
    for (reading, right) in readings.iter().zip(wrenches) {
        for (a, b) in values(&reading.reading).iter().zip(right) {
            assert!(
                (a - b).abs() <= 1e-9 * b.abs().max(1.0),
                "{reading:?} {right:?}"
            );
        }
    }
}

#[test]
fn a_log_of_another_programs_session_decodes_without_keys() {
    for stamped in [true, false] {
        let (frames, wrenches) = session(stamped);
        let mut device = session_listener("");
        let (readings, faults) = decode(&mut *device, &frames);
        assert!(faults.is_empty(), "{faults:?}");
        assert_read(&readings, &wrenches);
        assert_eq!(readings[0].quality, Quality::GOOD);
        // The stamp is that of the first half.
        assert!(
            frames
                .iter()
                .any(|f| f.t == readings[4].acquired && f.data().len() == 8)
        );
        assert_eq!(device.state(), State::Streaming);
    }
}

#[test]
fn the_keys_stand_before_the_sensors_own() {
    let (frames, wrenches) = session(true);
    let (mut readings, _) = decode(
        &mut *session_listener("counts_per_force = 8896\ncounts_per_torque = 2000"),
        &frames,
    );
    let halved: Vec<_> = wrenches
        .iter()
        .map(|[a, b, c, d, e, f]| [a / 2.0, b / 2.0, c / 2.0, *d, *e, *f])
        .collect();
    assert_read(&readings, &halved);
    let units = "force_unit = \"N\"\ntorque_unit = \"Nmm\"";
    (readings, _) = decode(&mut *session_listener(units), &frames);
    let in_si: Vec<_> = wrenches
        .iter()
        .map(|[a, b, c, d, e, f]| {
            let (n, nm) = (4.448_221_615_260_5, 112.984_829_027_616_7);
            [a / n, b / n, c / n, d / nm, e / nm, f / nm]
        })
        .collect();
    assert_read(&readings, &in_si);
    let (readings, _) = decode(&mut *session_listener(KEYS), &frames[frames.len() - 3..]);
    let gauge = |at| {
        i16::from_be_bytes(
            frames[frames.len() - 2].data()[at..at + 2]
                .try_into()
                .unwrap(),
        )
    };
    assert_eq!(values(&readings[0].reading)[0], f64::from(gauge(2)) / 100.0);
}

/// A reading whose six gauges are all `n`.
fn halves(n: i16, status: u16, ms: f64) -> [Frame; 2] {
    let gauge = format!("{n:04X}").repeat(3);
    [
        frame(&format!("200#{status:04X}{gauge}"), ms),
        frame(&format!("201#{gauge}"), ms + 0.2),
    ]
}

fn decode_keys(frames: &[Frame]) -> (Vec<StampedReading>, Vec<Fault>) {
    decode(&mut *listener("ati_netcanoem", KEYS, &[]), frames)
}

/// The number of each reading, if its halves belong together, and whether it follows a gap.
fn numbers(readings: &[StampedReading]) -> Vec<(i32, bool)> {
    let number = |reading: &StampedReading| {
        let [a, b, ..] = values(&reading.reading);
        assert_eq!(a, b, "halves of different readings");
        let gap = reading.quality.contains(Quality::GAP_BEFORE);
        ((a * 100.0).round() as i32, gap)
    };
    readings.iter().map(number).collect()
}

#[test]
fn halves_out_of_step_are_paired_in_their_order() {
    let [a, a2] = halves(1, 0, 0.0);
    let [b, b2] = halves(2, 0, 2.0);
    let [c, c2] = halves(3, 0, 4.0);
    let (readings, faults) = decode_keys(&[a, b, c, a2, b2, c2]);
    assert_eq!(numbers(&readings), [(1, false), (2, false), (3, false)]);
    assert!(faults.is_empty());
}

#[test]
fn a_lost_half_costs_few_readings_and_none_is_wrong() {
    let all: Vec<Frame> = (1..=12)
        .flat_map(|n| halves(n, 0, f64::from(n) * 2.0))
        .collect();
    for lost in 0..24 {
        let mut frames = all.clone();
        frames.remove(lost);
        let (readings, faults) = decode_keys(&frames);
        let read = numbers(&readings);
        // The stream may begin with the second half of a request before it.
        let expected: &[i32] = match lost {
            0 => &[],
            _ if lost % 2 == 0 => &[1],
            _ => &[4, 1],
        };
        let gone = 12 - read.len() as i32;
        let tail = lost >= 17 && lost % 2 == 1;
        assert!(
            tail || lost == 0 || expected.contains(&gone),
            "{lost}: {gone} are gone"
        );
        if lost == 0 {
            assert!(faults.is_empty(), "{faults:?}");
            assert!(!read[0].1);
        } else if !tail {
            let total = count(&faults, Counter::Unpaired);
            assert_eq!(total, if lost % 2 == 0 { 1 } else { 7 }, "{lost}");
        }
        if let Some((_, gap)) = read.get(lost / 2).filter(|_| lost > 0 && !tail) {
            assert!(gap, "{lost}");
        }
    }
}

/// A first half is not kept for ever: 30 ms.
#[test]
fn halves_that_are_far_apart_are_not_paired() {
    let [a, _] = halves(1, 0, 0.0);
    let [_, b2] = halves(1, 0, 29.8);
    assert_eq!(decode_keys(&[a, b2]).0.len(), 1);
    let [_, b2] = halves(1, 0, 30.0);
    let (readings, faults) = decode_keys(&[a, b2]);
    assert!(readings.is_empty());
    assert_eq!(count(&faults, Counter::Unpaired), 2);
    let [c, c2] = halves(3, 0, 40.0);
    let (readings, faults) = decode_keys(&[a, c, c2]);
    assert_eq!(numbers(&readings), [(3, true)]);
    assert_eq!(count(&faults, Counter::Unpaired), 1);
}

#[test]
fn faults_and_saturation_are_told() {
    let fault = |status| {
        let (readings, faults) = decode_keys(&halves(7, status, 0.0));
        let is_faulty = readings[0].quality.contains(Quality::DEVICE_FAULT);
        assert_eq!(count(&faults, Counter::DeviceFault), u32::from(is_faulty));
        is_faulty
    };
    for bit in 0..16 {
        let concerns = matches!(bit, 0..=8 | 11 | 12 | 15);
        assert_eq!(fault(1 << bit), concerns, "bit {bit}");
    }
    assert!(!fault(1 << 14 | 1 << 15), "the bus alone");
    assert!(fault(1 << 14 | 1 << 15 | 1 << 6));
    for (gauge, saturated) in [
        (32767, true),
        (-32767, true),
        (-32768, true),
        (32766, false),
        (-32766, false),
    ] {
        let (readings, faults) = decode_keys(&halves(gauge, 0, 0.0));
        assert_eq!(readings[0].quality.contains(Quality::SATURATED), saturated);
        assert_eq!(count(&faults, Counter::Saturated), u32::from(saturated));
    }
}

#[test]
fn frames_that_are_none_of_the_sensor_are_counted() {
    let (readings, faults) = decode_keys(&[
        frame("200#", 0.0),
        frame("200#0000", 1.0),
        frame("201#00000000000000", 2.0),
        frame("205#4654313233", 3.0),
        frame("209#0A", 4.0),
    ]);
    assert!(readings.is_empty());
    assert_eq!(count(&faults, Counter::Length), 2);
    assert_eq!(faults.len(), 2, "{faults:?}");
}

fn rig(keys: &str) -> Rig {
    Rig::new("ati_netcanoem", keys, &[], (0, wrench(LOAD)))
}

#[test]
fn the_sensor_is_asked_for_its_calibration_and_then_for_readings() {
    let mut rig = rig("calibration = 3\nperiod_ms = 4");
    rig.run(50);
    let asked = [
        "206#03", "207#", "208#", "202#00", "202#01", "202#02", "202#03", "202#04", "202#05",
    ];
    assert_eq!(rig.sent[..9], asked);
    assert!(rig.sent[9..].iter().all(|frame| frame == "200#"));
    assert_eq!(rig.device.state(), State::Streaming);
    assert!(
        (12..=13).contains(&rig.readings.len()),
        "{}",
        rig.readings.len()
    );
    for (read, right) in values(&rig.readings[3].reading).iter().zip(LOAD) {
        assert!((read - right).abs() < 0.02, "{read} {right}");
    }
    assert_eq!((rig.faults.len(), rig.count(Counter::Starts)), (1, 1));
    let sent = rig.sent.len();
    rig.device.stop(rig.now);
    rig.run(30);
    assert_eq!((rig.device.state(), rig.sent.len()), (State::Stopped, sent));
}

#[test]
fn what_the_keys_tell_is_not_asked() {
    let mut rig = rig(KEYS);
    rig.run(20);
    assert!(rig.sent.iter().all(|frame| frame == "200#"));
    assert_eq!(rig.readings.len(), 10);
    for (read, right) in values(&rig.readings[3].reading).iter().zip(LOAD) {
        assert!((read - right).abs() < 0.0051);
    }
}

#[test]
fn what_the_keys_do_not_tell_is_asked() {
    let matrix: Vec<String> = (0..6).map(|row| format!("202#{row:02}")).collect();
    let asked: [Vec<String>; 3] = [vec!["207#".into()], vec!["208#".into()], matrix];
    for (part, asked) in asked.iter().enumerate() {
        let keys: String = (0..3).filter(|n| *n != part).map(|n| parts()[n]).collect();
        let mut rig = rig(&keys);
        rig.run(50);
        let questions = rig.sent.iter().filter(|frame| *frame != "200#");
        assert_eq!(questions.cloned().collect::<Vec<_>>(), *asked);
        assert!(rig.readings.len() > 10);
    }
}

/// The parts of [`KEYS`]: counts, units, matrix.
fn parts() -> [&'static str; 3] {
    let (units, matrix) = (
        KEYS.find("force_unit").unwrap(),
        KEYS.find("matrix").unwrap(),
    );
    [&KEYS[..units], &KEYS[units..matrix], &KEYS[matrix..]]
}

/// A request is sent when the last one is answered, or 30 ms after it.
#[test]
fn a_request_without_an_answer_costs_one_reading() {
    let mut rig = rig(KEYS);
    let second = |frame: &Frame| frame.to_string().starts_with("201#");
    rig.board_loses = Box::new(move |n, frame| n == 20 && second(frame));
    rig.run(100);
    assert_eq!(rig.count(Counter::Lost), 1);
    assert_eq!(rig.readings.len(), 9 + (100 - 18 - 30) / 2);
    assert!(rig.readings[9].quality.contains(Quality::GAP_BEFORE));
    let gaps = rig.readings.iter().filter(|r| r.quality != Quality::GOOD);
    assert_eq!(gaps.count(), 1);
    // A request that could not be sent is no lost reading.
    rig.interface = Box::new(|_| Some(NotSent::Refused));
    rig.run(10);
    rig.interface = Box::new(|_| None);
    rig.run(50);
    assert_eq!(rig.count(Counter::Lost), 1);
    assert_eq!(rig.device.state(), State::Streaming);
}

#[test]
fn each_lost_request_and_answer_at_the_start_is_made_up_for() {
    for lost in 1..=26 {
        for host in [true, false] {
            let mut rig = rig("");
            let lose = move |n: usize, _: &Frame| n == lost;
            if host {
                rig.host_loses = Box::new(lose);
            } else {
                rig.board_loses = Box::new(lose);
            }
            rig.run(600);
            assert_eq!(rig.device.state(), State::Streaming, "{lost} {host}");
            for (read, right) in values(&rig.readings[0].reading).iter().zip(LOAD) {
                assert!(
                    (read - right).abs() < 0.02,
                    "{lost} {host}: {:?}",
                    rig.readings[0]
                );
            }
        }
    }
}

/// The first of two answers is late: the second must not be taken for that of the next row.
#[test]
fn an_answer_that_comes_twice_is_not_taken_for_another_row() {
    let options = options("ati_netcanoem", "");
    let spec = spec(0x20, Mode::Supervise, &[]);
    let (mut device, mut board) = (
        options.device(&spec).unwrap(),
        options.board(&spec).unwrap(),
    );
    board.present(0, &wrench(LOAD), Quality::GOOD);
    let mut late: Vec<(i64, Frame)> = Vec::new();
    let mut readings = Vec::new();
    for ms in 1000..2500 {
        let now = Nanos::from_millis(ms);
        let mut out = Decoded::new();
        while let Some(sent) = device.poll_transmit(now, &mut out) {
            device.on_sent(&sent.frame, Ok(now));
            let mut answers = proprio_drivers::Frames::new();
            board.on_frame(&sent.frame, &mut answers);
            // Matrix rows take 25 ms, longer than the host waits before it asks again.
            let delay = if sent.frame.to_string().starts_with("202") {
                25
            } else {
                0
            };
            late.extend(answers.into_iter().map(|frame| (ms + delay, frame)));
        }
        let due = late
            .iter()
            .filter(|(t, _)| *t <= ms)
            .map(|(_, frame)| *frame);
        let due: Vec<Frame> = due.collect();
        late.retain(|(t, _)| *t > ms);
        for frame in due {
            let frame = frame.at(now, proprio_topics::StampKind::Software);
            device.on_frame(&frame, &mut out);
        }
        readings.extend(out.readings);
    }
    assert!(readings.len() > 100);
    for (read, right) in values(&readings[0].reading).iter().zip(LOAD) {
        assert!((read - right).abs() < 0.02, "{:?}", readings[0]);
    }
}

#[test]
fn a_sensor_that_does_not_tell_its_calibration_is_refused_by_name() {
    let mut silent = rig("");
    silent.board_loses = Box::new(|_, frame| frame.to_string().starts_with("204"));
    silent.run(400);
    let refused = State::Refused(Refusal::NoCalibration);
    assert_eq!(silent.device.state(), refused);
    silent.board_loses = Box::new(|_, _| false);
    silent.run(1500);
    assert_eq!(silent.device.state(), State::Streaming);

    // Zero counts, a row of zeros, a row that is not a number; the state names the channel.
    let state = |frames: &[&str]| {
        let mut device = session_listener("");
        let frames: Vec<Frame> = frames.iter().map(|text| frame(text, 0.0)).collect();
        let (_, faults) = decode(&mut *device, &frames);
        assert_eq!(count(&faults, Counter::Value), 1, "{faults:?}");
        device.state()
    };
    let bad = |channel| State::Refused(Refusal::BadCalibration { channel });
    assert_eq!(state(&["3F7#00000000000007D0"]), bad(0));
    assert_eq!(state(&["3F7#000007D000000000"]), bad(3));
    assert_eq!(state(&["3F8#0007"]), bad(0));
    assert_eq!(state(&["3F8#0200"]), bad(3));
    let zeros = [
        "3F2#04",
        "3F2#0000000000000000",
        "3F3#0000000000000000",
        "3F4#0000000000000000",
    ];
    assert_eq!(state(&zeros), bad(4));
    let nan = [
        "3F2#05",
        "3F2#FFFFFFFFFFFFFFFF",
        "3F3#3F80000000000000",
        "3F4#0000000000000000",
    ];
    assert_eq!(state(&nan), bad(5));
}

#[test]
fn a_sensor_that_was_off_for_long_streams_again() {
    let mut rig = rig("");
    rig.run(400);
    assert_eq!(rig.device.state(), State::Streaming);
    rig.board_loses = Box::new(|_, _| true);
    rig.run(3000);
    let refused = State::Refused(Refusal::NoCalibration);
    assert_eq!(rig.device.state(), refused);
    rig.board_loses = Box::new(|_, _| false);
    rig.run(1500);
    assert_eq!(rig.device.state(), State::Streaming);
}

/// While the link is down, answers wait at the board; they come when the matrix is read anew.
/// A matrix that really is another one is refused.
#[test]
fn old_answers_are_not_taken_for_another_matrix() {
    for is_other in [false, true] {
        let mut rig = rig("");
        rig.run(400);
        rig.device.restart(rig.now);
        let mut answers = proprio_drivers::Frames::new();
        for row in 3..5 {
            let request = frame(&format!("202#0{row}"), 0.0);
            rig.board.on_frame(&request, &mut answers);
        }
        if is_other {
            let other = options("ati_netcanoem", parts()[2]);
            rig.board = other.board(&spec(0x20, Mode::Supervise, &[])).unwrap();
        }
        // They come right after the first request for a row.
        let is_row = |sent: &String| sent.starts_with("202#");
        let before = rig.sent.iter().filter(|sent| is_row(sent)).count();
        rig.board_loses = Box::new(|_, frame| frame.to_string().starts_with("202"));
        while rig.sent.iter().filter(|sent| is_row(sent)).count() == before {
            rig.run(1);
        }
        let mut out = Decoded::new();
        for answer in answers {
            let answer = answer.at(rig.now, proprio_topics::StampKind::Software);
            rig.device.on_frame(&answer, &mut out);
        }
        assert!(is_other || !out.faults.is_empty());
        rig.board_loses = Box::new(|_, _| false);
        rig.run(3000);
        let state = match is_other {
            true => State::Refused(Refusal::Changed),
            false => State::Streaming,
        };
        assert_eq!(rig.device.state(), state);
    }
}

/// What was known before does not end the refusal.
#[test]
fn numbers_that_become_bad_are_refused() {
    let (mut frames, _) = session(true);
    frames.push(frame("3F7#", 900.0));
    frames.push(frame("3F7#00000000000007D0", 900.1));
    frames.push(frame("3F8#", 901.0));
    frames.push(frame("3F8#0101", 901.1));
    let mut device = session_listener("");
    decode(&mut *device, &frames);
    let refused = State::Refused(Refusal::BadCalibration { channel: 0 });
    assert_eq!(device.state(), refused);
}

#[test]
fn a_calibration_that_changes_is_refused() {
    let (mut frames, _) = session(true);
    // Counts, then units, then a row, told again with another value.
    for (request, reply) in [
        ("3F7#", "3F7#00001161000007D0"),
        ("3F8#", "3F8#0203"),
        ("3F2#02", "3F3#C117F112C06119F4"),
    ] {
        let mut device = session_listener("");
        frames.push(frame(request, 900.0));
        frames.push(frame(reply, 900.1));
        let (_, faults) = decode(&mut *device, &frames);
        frames.truncate(frames.len() - 2);
        assert_eq!(device.state(), State::Refused(Refusal::Changed), "{reply}");
        assert_eq!(count(&faults, Counter::Changed), 1);
        let (readings, _) = decode(&mut *device, &halves_at_3f(950.0));
        assert!(readings.is_empty());
    }
    // Another calibration is selected: all is read anew.
    let mut device = session_listener("");
    decode(&mut *device, &frames);
    let (readings, _) = decode(
        &mut *device,
        &[frame("3F6#05", 990.0), frame("3F6#05", 990.1)],
    );
    assert!(readings.is_empty());
    let (readings, _) = decode(&mut *device, &halves_at_3f(991.0));
    assert!(readings.is_empty());
    assert_eq!(device.state(), State::Refused(Refusal::NoCalibration));
    let (again, wrenches) = session(true);
    let (readings, _) = decode(&mut *device, &again);
    assert_eq!(readings.len(), wrenches.len());
}

/// What the keys state does not depend on which calibration is selected; the rest does.
#[test]
fn another_calibration_voids_what_is_not_configured() {
    let select = [frame("3F6#05", 990.0), frame("3F6#05", 990.1)];
    let (frames, _) = session(true);
    for without in 0..4 {
        let keys: String = (0..3)
            .filter(|part| *part != without)
            .map(|part| parts()[part])
            .collect();
        let mut device = session_listener(&keys);
        decode(&mut *device, &frames);
        decode(&mut *device, &select);
        let (readings, _) = decode(&mut *device, &halves_at_3f(991.0));
        assert_eq!(
            readings.len(),
            usize::from(without == 3),
            "without {without}"
        );
    }
}

/// A device that selects a calibration counts an answer with another number, and asks again.
#[test]
fn an_answer_with_another_number_is_counted() {
    let mut device = supervisor("ati_netcanoem", "calibration = 3", &[]);
    let mut out = Decoded::new();
    let now = Nanos::from_millis(1000);
    let asked = device.poll_transmit(now, &mut out).unwrap().frame;
    assert_eq!(asked.to_string(), "206#03");
    device.on_sent(&asked, Ok(now));
    let (_, faults) = decode(&mut *device, &[frame("206#05", 1000.1)]);
    assert_eq!(count(&faults, Counter::Value), 1);
    let (_, faults) = decode(&mut *device, &[frame("206#03", 1000.2)]);
    assert!(faults.is_empty(), "{faults:?}");
    let next = device.poll_transmit(now + Nanos::from_millis(1), &mut out);
    assert_eq!(next.unwrap().frame.to_string(), "207#");
}

/// A device that asks, without a sensor: every answer is given by hand.
fn asking(keys: &str) -> Box<dyn Device> {
    supervisor("ati_netcanoem", keys, &[])
}

fn at(ms: i64) -> Nanos {
    Nanos::from_millis(ms)
}

/// The device sends `question` at `t`, and is told that it left then, or that it did not.
fn ask(device: &mut dyn Device, question: &str, t: Nanos, outcome: Result<Nanos, NotSent>) {
    let next = poll(device, t).expect("a question");
    assert_eq!(next.to_string(), question);
    device.on_sent(&next, outcome);
}

fn faults_of(device: &mut dyn Device, text: &str, ms: f64) -> Vec<Counter> {
    let (_, faults) = decode(device, &[frame(text, ms)]);
    faults.iter().map(|fault| fault.counter).collect()
}

const COUNTS: &str = "207#0000006400000064";
const UNITS: &str = "208#0203";

/// A question is repeated 20 ms after it was sent. Then two answers may come: nothing else is asked
/// before both are there or can not come any more.
#[test]
fn a_question_is_repeated_and_its_answers_are_waited_for() {
    let mut device = asking("");
    ask(&mut *device, "207#", at(1000), Ok(at(1005)));
    assert_eq!(device.next_wake(), Some(at(1025)));
    assert_eq!(poll(&mut *device, at(1025) - Nanos(1)), None);
    ask(&mut *device, "207#", at(1025), Ok(at(1025)));
    assert_eq!(faults_of(&mut *device, COUNTS, 1030.0), []);
    assert_eq!(device.next_wake(), Some(at(1125) + Nanos(1)));
    assert_eq!(poll(&mut *device, at(1125)), None);
    assert_eq!(faults_of(&mut *device, COUNTS, 1125.0), []);
    let next = at(1125) + Nanos(1);
    ask(&mut *device, "208#", next, Ok(next));
}

/// An answer counts if this host has asked, for 100 ms.
#[test]
fn a_question_that_did_not_leave_has_no_answer() {
    let unexpected = [Counter::Unexpected];
    let mut device = asking("");
    ask(&mut *device, "207#", at(1000), Err(NotSent::Refused));
    assert_eq!(faults_of(&mut *device, COUNTS, 1001.0), unexpected);
    ask(&mut *device, "207#", at(1020), Ok(at(1020)));
    assert_eq!(faults_of(&mut *device, COUNTS, 1021.0), []);
    // One question, one answer: the next is asked at once.
    ask(&mut *device, "208#", at(1022), Err(NotSent::Refused));
    assert_eq!(faults_of(&mut *device, UNITS, 1023.0), unexpected);
    ask(&mut *device, "208#", at(1042), Ok(at(1042)));
    assert_eq!(faults_of(&mut *device, UNITS, 1142.1), unexpected);
    assert_eq!(faults_of(&mut *device, UNITS, 1142.0), []);
}

/// The sensor may be another one.
#[test]
fn a_restart_asks_for_the_calibration_anew() {
    let mut rig = rig("");
    rig.run(50);
    let asked = rig.sent[..8].to_vec();
    let sent = rig.sent.len();
    rig.device.restart(rig.now);
    rig.run(50);
    assert_eq!(rig.sent[sent..sent + 8], asked);
    assert_eq!(rig.device.state(), State::Streaming);
    let before = rig.readings.len();
    rig.board = board("ati_netcanoem", KEYS, &[]);
    rig.device.restart(rig.now);
    rig.run(50);
    assert_eq!(rig.device.state(), State::Refused(Refusal::Changed));
    assert_eq!(
        (rig.count(Counter::Changed), rig.readings.len()),
        (1, before)
    );
    assert_eq!(rig.device.next_wake(), None, "nothing is asked any more");
}

/// Another program asks for row 4 and gets no answer; the host's own question for row 0 gets two.
#[test]
fn the_rows_of_another_programs_questions_are_not_this_hosts() {
    let mut device = asking(&parts()[..2].concat());
    let mut sensor = board("ati_netcanoem", KEYS, &[]);
    let mut answer = |device: &mut dyn Device, row: u8, ms: f64| {
        let mut answers = proprio_drivers::Frames::new();
        sensor.on_frame(&frame(&format!("202#0{row}"), ms), &mut answers);
        for answer in answers {
            assert_eq!(faults_of(device, &answer.to_string(), ms), []);
        }
    };
    ask(&mut *device, "202#00", at(1000), Ok(at(1000)));
    assert_eq!(faults_of(&mut *device, "202#04", 1010.0), []);
    ask(&mut *device, "202#00", at(1020), Ok(at(1020)));
    answer(&mut *device, 0, 1021.0);
    answer(&mut *device, 0, 1022.0);
    for row in 1..6 {
        let ms = 1200 + i64::from(row);
        ask(&mut *device, &format!("202#0{row}"), at(ms), Ok(at(ms)));
        answer(&mut *device, row, ms as f64);
    }
    ask(&mut *device, "200#", at(1210), Ok(at(1210)));
    let (readings, faults) = decode(&mut *device, &halves(5, 0, 1211.0));
    assert!(faults.is_empty(), "{faults:?}");
    let [force, torque] = [0.05, 0.005].map(|value| [value; 3]);
    let read = values(&readings[0].reading);
    for (value, right) in read.iter().zip([force, torque].concat()) {
        assert!((value - right).abs() < 1e-12, "{read:?}");
    }
}

/// A request has 10 ms from when it was sent. Its answer may come before the bus tells that.
#[test]
fn a_request_is_open_until_it_is_answered() {
    let mut device = asking(KEYS);
    ask(&mut *device, "200#", at(1000), Ok(at(1004)));
    assert_eq!(device.next_wake(), Some(at(1014)));
    let (readings, _) = decode(&mut *device, &halves(1, 0, 1005.0));
    assert_eq!(numbers(&readings), [(1, false)]);
    let request = poll(&mut *device, at(1006)).expect("a request");
    let (readings, _) = decode(&mut *device, &halves(2, 0, 1007.0));
    assert_eq!(numbers(&readings), [(2, false)]);
    device.on_sent(&request, Ok(at(1006)));
    assert_eq!(device.next_wake(), Some(at(1008)));
    ask(&mut *device, "200#", at(1008), Ok(at(1008)));
    // A restart does not wait for the answer, and does not count it as lost.
    device.restart(at(1009));
    let mut out = Decoded::new();
    let request = device.poll_transmit(at(1009), &mut out);
    assert_eq!(
        request.map(|sent| sent.frame.to_string()).as_deref(),
        Some("200#")
    );
    assert_eq!(count(&out.faults, Counter::Lost), 0);
}

/// Each reply comes again 50 ms later, and would be taken for the answer to a request of then.
#[test]
fn replies_that_come_again_are_not_trusted() {
    let mut device = asking(KEYS);
    let (mut good, mut faulty, mut unexpected, mut n) = (0, 0, 0, 0_i16);
    for ms in (1000..3000).step_by(2) {
        let t = f64::from(ms);
        ask(
            &mut *device,
            "200#",
            at(i64::from(ms)),
            Ok(at(i64::from(ms))),
        );
        n += 1;
        let repeats = (1050..1500).contains(&ms);
        let old = halves(n - 25, 0, t + 0.2).into_iter().filter(|_| repeats);
        let frames: Vec<Frame> = old.chain(halves(n, 0, t + 0.6)).collect();
        let (readings, faults) = decode(&mut *device, &frames);
        unexpected += count(&faults, Counter::Unexpected);
        for reading in &readings {
            let is_faulty = reading.quality.contains(Quality::DEVICE_FAULT);
            faulty += u32::from(is_faulty);
            good += u32::from(!is_faulty);
            // The first that comes again can not be told.
            let is_old = values(&reading.reading)[0] < f64::from(n) * 0.01 - 1e-9;
            assert!(is_faulty || !is_old || ms == 1050, "{ms}: {reading:?}");
        }
    }
    assert_eq!(unexpected, 225);
    // The second after the last one too many is not trusted either.
    assert!(
        (25 + 240..=25 + 255).contains(&good),
        "{good} good, {faulty} faulty"
    );
}

/// Another program repeats its questions, before and after they are answered, and asks for a row
/// that there is none of.
#[test]
fn questions_of_another_program_may_be_repeated() {
    let (frames, wrenches) = session(true);
    let mut repeated = vec![frame("3F2#06", 0.0)];
    for frame in &frames {
        repeated.push(*frame);
        if frame.data().len() == 1 {
            repeated.push(*frame);
        }
    }
    let mut device = session_listener("");
    for frames in [repeated, frames] {
        let (readings, faults) = decode(&mut *device, &frames);
        assert!(faults.is_empty(), "{faults:?}");
        assert_read(&readings, &wrenches);
    }
}

/// The matrix is configured: what is told of it does not matter.
#[test]
fn a_stray_row_does_not_void_a_configured_matrix() {
    let mut device = session_listener(parts()[2]);
    let stray = faults_of(&mut *device, "3F2#3F8000003F800000", 0.0);
    assert_eq!(stray, [Counter::Unexpected]);
    let answers = ["3F7#", "3F7#00000064000003E8", "3F8#", "3F8#0203"];
    let (_, faults) = decode(&mut *device, &answers.map(|text| frame(text, 1.0)));
    assert!(faults.is_empty(), "{faults:?}");
    let (readings, _) = decode(&mut *device, &halves_at_3f(2.0));
    assert_eq!(numbers(&readings), [(5, false)]);
}

fn halves_at_3f(ms: f64) -> [Frame; 2] {
    halves(5, 0, ms).map(|f| frame(&f.to_string().replacen("20", "3F", 1), ms))
}

/// Replies without a request do not say which row they are; the host's own are not awaited.
#[test]
fn replies_that_nobody_asked_for_are_counted() {
    let (frames, _) = session(true);
    let replies: Vec<Frame> = frames
        .iter()
        .filter(|f| f.data().len() > 1)
        .copied()
        .collect();
    let mut device = session_listener("");
    let (readings, faults) = decode(&mut *device, &replies);
    assert!(readings.is_empty());
    assert_eq!(count(&faults, Counter::Unexpected), 18);
    assert_eq!(device.state(), State::Refused(Refusal::NoCalibration));

    let mut rig = rig("");
    rig.run(100);
    let before = rig.readings.len();
    let stray = ["207#0000000100000001", "208#0101", "203#3F8000003F800000"];
    let (_, faults) = decode(&mut *rig.device, &stray.map(|text| frame(text, 1100.0)));
    assert_eq!(count(&faults, Counter::Unexpected), 3);
    rig.run(20);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(
        rig.readings[before].reading,
        rig.readings[before - 1].reading
    );
}

#[test]
fn wrong_keys_are_refused() {
    let refused = |keys: &str| {
        let device = options("ati_netcanoem", keys).device(&spec(1, Mode::Listen, &[]));
        device.map(|_| ()).unwrap_err().to_string()
    };
    assert_eq!(refused("period_ms = 0"), "period_ms = 0 must be 1 to 1000");
    assert_eq!(
        refused("calibration = 16"),
        "calibration = 16 must be 0 to 15"
    );
    for number in [0, 15] {
        let options = options("ati_netcanoem", &format!("calibration = {number}"));
        assert!(options.device(&spec(1, Mode::Listen, &[])).is_ok());
    }
    assert!(refused("counts_per_force = 1").contains("counts_per_torque is missing"));
    assert!(refused("torque_unit = \"Nm\"").contains("force_unit is missing"));
    let zero = "counts_per_force = 0\ncounts_per_torque = 1";
    assert!(refused(zero).contains("counts_per_force = 0 must be above 0"));
    assert!(refused(&KEYS.replace("[1, 0", "[0, 0")).contains("matrix must be six rows"));
    let options: Options = options("ati_netcanoem", &KEYS.replace("[1, 0,", "[0, 1,"));
    assert!(matches!(
        options.board(&spec(1, Mode::Listen, &[])).map(|_| ()),
        Err(SpecError::Keys { key: "matrix", .. })
    ));
    let address = options.device(&spec(0x80, Mode::Listen, &[]));
    assert!(matches!(
        address.map(|_| ()),
        Err(SpecError::Address { most: 127, .. })
    ));
}

proptest! {
    #[test]
    fn wrenches_are_read_back(load in proptest::array::uniform6(-300.0_f64..300.0)) {
        let [fx, fy, fz, tx, ty, tz] = load;
        let load = [fx, fy, fz, tx / 10.0, ty / 10.0, tz / 10.0];
        let mut sensor = board("ati_netcanoem", KEYS, &[]);
        let frames = encode(&mut *sensor, 0, &wrench(load), Quality::GOOD);
        let (readings, faults) = decode_keys(&frames);
        let steps = [0.01, 0.01, 0.01, 0.001, 0.001, 0.001];
        let clamped = load.iter().zip(steps).any(|(x, lsb)| (x / lsb).abs() >= 32766.5);
        prop_assert_eq!(count(&faults, Counter::Saturated), u32::from(clamped));
        for ((a, b), lsb) in values(&readings[0].reading).iter().zip(load).zip(steps) {
            let right = b.clamp(-32768.0 * lsb, 32767.0 * lsb);
            prop_assert!((a - right).abs() <= 0.5001 * lsb, "{} {}", a, b);
        }
        let faulty = encode(
            &mut *board("ati_netcanoem", KEYS, &[]), 0, &wrench(load), Quality::DEVICE_FAULT,
        );
        prop_assert!(decode_keys(&faulty).0[0].quality.contains(Quality::DEVICE_FAULT));
    }
}
