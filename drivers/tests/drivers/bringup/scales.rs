//! Full scales and tares of F/T boards: asked for, configured, changed, and calibrated.

use super::{SCALES, strain, wrench};
use crate::rig::{Rig, decode, frame, listener, supervisor};
use proprio_drivers::{Command, CommandFailed, CommandOutcome, Decoded, NotSent, State};
use proprio_topics::{Counter, Nanos, Refusal};

/// The answers of a board with the usual scales.
const USUAL: [&str; 6] = [
    "210#1800070C",
    "210#1801070C",
    "210#1802070C",
    "210#1803001F",
    "210#1804001F",
    "210#1805001F",
];
/// The worked example of a strain board.
const PAIR: [&str; 2] = ["31A#E380B76A1887", "31B#2184BE770881"];

/// The upper half of the byte is the regulation set: 0 the one in use, 1 to 3 those stored.
#[test]
fn scales_of_stored_sets_are_for_other_programs() {
    for (channel, is_wrong) in [
        (0x10, false),
        (0x11, false),
        (0x15, false),
        (0x35, false),
        (0x06, true),
        (0x16, true),
        (0x17, true),
        (0x36, true),
        (0x40, true),
        (0x45, true),
        (0x51, true),
    ] {
        let mut device = listener("icub_strain", "", &[]);
        let answer = frame(&format!("210#18{channel:02X}0000"), 0.0);
        let (_, faults) = decode(&mut *device, &[answer]);
        let counted: Vec<Counter> = faults.iter().map(|fault| fault.counter).collect();
        let expected = if is_wrong { &[Counter::Value][..] } else { &[] };
        assert_eq!(counted, expected, "{channel:x}");
        assert_eq!(device.state(), State::Starting, "{channel:x}");
    }
}

#[test]
fn a_configured_scale_holds_whatever_the_board_answers() {
    let mut device = listener("icub_strain", SCALES, &[]);
    let mut read = |answers: &[&str]| {
        let frames: Vec<_> = answers.iter().map(|text| frame(text, 0.0)).collect();
        decode(&mut *device, &frames);
        let (readings, _) = decode(&mut *device, &PAIR.map(|text| frame(text, 1.0)));
        assert_eq!(device.state(), State::Streaming);
        readings[0].reading
    };
    let first = read(&[]);
    assert_eq!(read(&["210#18020000"]), first);
    let others = [0, 1, 2, 3, 4, 5].map(|axis| format!("210#180{axis}0064"));
    assert_eq!(read(&others.each_ref().map(String::as_str)), first);
}

/// A scale of zero is that axis's: an answer about another axis does not repair it.
#[test]
fn a_scale_of_zero_is_repaired_by_its_own_axis() {
    let mut device = listener("icub_strain", "", &[]);
    let mut state_after = |texts: &[&str]| {
        let frames: Vec<_> = texts.iter().map(|text| frame(text, 0.0)).collect();
        decode(&mut *device, &frames);
        device.state()
    };
    let zero = State::Refused(Refusal::ZeroFullScale { channel: 2 });
    assert_eq!(state_after(&["210#18020000"]), zero);
    assert_eq!(state_after(&USUAL[..2]), zero);
    assert_eq!(
        state_after(&PAIR),
        zero,
        "this says more than that none is known"
    );
    assert_eq!(state_after(&USUAL[2..3]), State::Starting);
    assert_eq!(state_after(&USUAL[3..]), State::Starting);
    assert_eq!(state_after(&PAIR), State::Streaming);
    // One that has changed is refused for good.
    let changed = State::Refused(Refusal::Changed);
    assert_eq!(state_after(&["210#18010001"]), changed);
    assert_eq!(state_after(&USUAL), changed);
    assert_eq!(state_after(&PAIR), changed);
}

/// Frames without a known scale are no reason to refuse a device that still asks for it, nor one
/// that reads raw gauges alone.
#[test]
fn a_wrench_without_a_scale_refuses_only_who_needs_it() {
    let pair = PAIR.map(|text| frame(text, 1000.0));
    let mut asks = supervisor("icub_strain", "", &[]);
    let question = asks.poll_transmit(Nanos::from_millis(1000), &mut Decoded::new());
    assert_eq!(question.unwrap().frame.to_string(), "201#1800");
    let (readings, faults) = decode(&mut *asks, &pair);
    assert!(readings.is_empty() && faults.is_empty());
    assert_eq!(asks.state(), State::Asking);
    let mut raw = listener("icub_strain", "stream = \"uncalibrated\"", &[]);
    assert!(decode(&mut *raw, &pair).0.is_empty());
    assert_eq!(raw.state(), State::Starting);
}

/// As many answers count as there were questions whose answers may still arrive, for a second.
#[test]
fn each_question_for_a_scale_has_one_answer() {
    let mut rig = strain();
    rig.run(100);
    let now = rig.now.seconds() * 1e3;
    let (_, faults) = decode(&mut *rig.device, &[frame(USUAL[0], now)]);
    assert_eq!(faults.len(), 1);
    assert_eq!(faults[0].counter, Counter::Unexpected);
    // The second question is asked before the answer to the first, or when that is too late.
    for (second, unexpected) in [(1020, 0), (2100, 1)] {
        let mut device = supervisor("icub_strain", "", &[]);
        for ms in [1000, second] {
            let now = Nanos::from_millis(ms);
            let question = device.poll_transmit(now, &mut Decoded::new()).unwrap();
            assert_eq!(question.frame.to_string(), "201#1800");
            device.on_sent(&question.frame, Ok(now));
        }
        let answer = frame(USUAL[0], second as f64 + 1.0);
        let (_, faults) = decode(&mut *device, &[answer, answer]);
        let counted = faults.iter().filter(|f| f.counter == Counter::Unexpected);
        assert_eq!((counted.count(), faults.len()), (unexpected, unexpected));
    }
}

/// What a tare asks is asked as what a bring-up asks: a question that was not sent is no attempt,
/// and each has one answer.
#[test]
fn a_question_of_a_tare_that_was_never_sent_is_no_attempt() {
    let mut rig = Rig::new("icub_strain", SCALES, &[], wrench());
    rig.run(50);
    rig.interface =
        Box::new(|frame| (frame.data().first() == Some(&0x16)).then_some(NotSent::Refused));
    assert_eq!(rig.device.command(Command::Tare, rig.now), Ok(()));
    // Longer than 15 attempts take.
    rig.run(500);
    assert_eq!(rig.device.outcome(), None);
    rig.interface = Box::new(|_| None);
    rig.run(30);
    let outcome = rig.device.outcome();
    assert!(
        matches!(outcome, Some(Ok(CommandOutcome::Tared(Some(_))))),
        "{outcome:?}"
    );
    assert_eq!(rig.count(Counter::Unexpected), 0);
    let now = rig.now.seconds() * 1e3;
    for axis in 0..6 {
        let answer = frame(&format!("210#160{axis}0000"), now);
        let (_, faults) = decode(&mut *rig.device, &[answer]);
        assert_eq!(faults.len(), 1);
        assert_eq!(faults[0].counter, Counter::Unexpected, "axis {axis}");
    }
}

/// It is given up after a second, and the device asks to be woken for it.
#[test]
fn a_tare_without_an_answer_ends_on_time() {
    let mut rig = Rig::new("icub_strain", SCALES, &[], wrench());
    rig.run(50);
    rig.board_loses = Box::new(|_, frame| frame.data().first() == Some(&0x16));
    let limit = rig.now + Nanos::from_millis(1000);
    assert_eq!(rig.device.command(Command::Tare, rig.now), Ok(()));
    rig.run(1000);
    assert_eq!(rig.now, limit);
    let mut out = Decoded::new();
    assert_eq!(rig.device.poll_transmit(limit, &mut out), None);
    assert_eq!(rig.device.outcome(), None);
    let wake = rig.device.next_wake().unwrap();
    assert!(wake > limit && wake <= limit + Nanos::from_micros(1));
    assert_eq!(rig.device.poll_transmit(wake, &mut out), None);
    assert_eq!(rig.device.outcome(), Some(Err(CommandFailed::NoAnswer)));
    assert_eq!(rig.device.state(), State::Streaming);
}

/// A question is on its way when the link is lost; what became of it is told after the restart, and
/// says nothing of the tare that has been commanded since.
#[test]
fn a_late_outcome_is_that_of_the_tare_before_the_restart() {
    for late in [Ok(Nanos::from_millis(1060)), Err(NotSent::LinkLost)] {
        let mut rig = Rig::new("icub_strain", SCALES, &[], wrench());
        rig.run(50);
        let mut out = Decoded::new();
        assert_eq!(rig.device.command(Command::Tare, rig.now), Ok(()));
        let command = rig.device.poll_transmit(rig.now, &mut out).unwrap().frame;
        rig.device.on_sent(&command, Ok(rig.now));
        let question = rig.device.poll_transmit(rig.now, &mut out).unwrap().frame;
        assert_eq!(question.to_string(), "201#1600");
        rig.device.restart(rig.now);
        let outcome = rig.device.outcome();
        assert_eq!(outcome, Some(Err(CommandFailed::Interrupted)));
        rig.run(50);
        assert_eq!(rig.device.state(), State::Streaming);
        assert_eq!(rig.device.command(Command::Tare, rig.now), Ok(()));
        assert_eq!(rig.device.poll_transmit(rig.now, &mut out), None);
        rig.device.on_sent(&question, late);
        assert_eq!(rig.device.outcome(), None);
        rig.run(10);
        let outcome = rig.device.outcome();
        assert!(
            matches!(outcome, Some(Ok(CommandOutcome::Tared(Some(_))))),
            "{outcome:?}"
        );
    }
}

/// Both a calibration and the bring-up ask for the full scales: each takes the answers to its own
/// questions.
#[test]
fn a_calibration_does_not_take_the_answers_of_a_bringup() {
    let mut rig = strain();
    rig.run(50);
    let usual = std::mem::take(&mut rig.sent);
    assert_eq!(usual.len(), 8);
    for is_interrupted in [false, true] {
        assert_eq!(rig.device.command(Command::Calibration, rig.now), Ok(()));
        if is_interrupted {
            rig.board_loses = Box::new(|_, frame| frame.data().first() == Some(&0x18));
        }
        rig.run(3);
        rig.board_loses = Box::new(|_, _| false);
        rig.device.restart(rig.now);
        let outcome = rig.device.outcome();
        match is_interrupted {
            true => assert_eq!(outcome, Some(Err(CommandFailed::Interrupted))),
            false => assert!(matches!(outcome, Some(Ok(CommandOutcome::Calibration(_))))),
        }
        rig.sent.clear();
        rig.run(50);
        assert_eq!(rig.sent, usual);
        assert_eq!(rig.count(Counter::Unexpected), 0);
    }
    // The late answer to a tare that was interrupted is nobody else's.
    rig.board_loses = Box::new(|_, frame| frame.data().first() == Some(&0x16));
    assert_eq!(rig.device.command(Command::Tare, rig.now), Ok(()));
    rig.run(3);
    rig.device.restart(rig.now);
    let now = rig.now.seconds() * 1e3;
    let (_, faults) = decode(&mut *rig.device, &[frame("210#16000000", now)]);
    assert!(faults.is_empty(), "{faults:?}");
}
