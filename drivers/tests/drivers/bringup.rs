//! Bring-up of each family against its own board: frames sent, losses, silence, restart, refusal,
//! stop.

use crate::rig::{Rig, decode, frame, listener, options, spec, supervisor};
use proprio_drivers::{
    Command, CommandFailed, CommandOutcome, Decoded, Mode, NotSent, Options, SpecError, State,
};
use proprio_topics::{Counter, Imu, JointState, Nanos, Quality, Reading, Refusal, Wrench};

const SCALES: &str = "full_scale_n = [1804, 1804, 1804]\nfull_scale_nm = [31, 31, 31]\n";

fn wrench() -> (u8, Reading) {
    (
        0,
        Reading::Wrench(Wrench {
            force: [1.0, 2.0, 3.0],
            torque: [0.1, 0.2, 0.3],
        }),
    )
}

fn imu() -> (u8, Reading) {
    let imu = Imu {
        proper_acceleration: [0.0, 0.0, 9.81],
        angular_velocity: [0.0; 3],
        ..Imu::ABSENT
    };
    (0, Reading::Imu(imu))
}

fn strain() -> Rig {
    Rig::new("icub_strain", "", &[], wrench())
}

#[test]
fn a_strain_board_is_asked_started_and_stopped() {
    let mut rig = strain();
    rig.run(100);
    assert_eq!(
        rig.sent,
        [
            "201#1800", "201#1801", "201#1802", "201#1803", "201#1804", "201#1805", "201#080A",
            "201#0700"
        ]
    );
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(rig.readings.len(), 10);
    let Reading::Wrench(wrench) = rig.readings[0].reading else {
        panic!()
    };
    assert!((wrench.force[1] - 2.0).abs() < 0.03 && (wrench.torque[2] - 0.3).abs() < 5e-4);
    rig.device.stop(rig.now);
    rig.run(30);
    assert_eq!(rig.sent.last().unwrap(), "201#0701");
    assert_eq!(
        (rig.device.state(), rig.board.period(), rig.readings.len()),
        (State::Stopped, None, 10)
    );
    assert_eq!((rig.count(Counter::Starts), rig.faults.len()), (1, 1));
}

#[test]
fn temperature_and_both_streams_are_started_too() {
    let mut rig = Rig::new(
        "icub_strain",
        &format!("{SCALES}stream = \"both\"\ntemperature_period_s = 2"),
        &[],
        wrench(),
    );
    rig.run(40);
    assert_eq!(
        rig.sent,
        ["201#080A", "201#3901", "201#3A02", "201#0704"],
        "a configured scale is not requested"
    );
    let kinds: Vec<bool> = rig
        .readings
        .iter()
        .map(|r| matches!(r.reading, Reading::Gauges(_)))
        .collect();
    assert_eq!(kinds, [false, true, false, true, false, true, false, true]);
    rig.device.stop(rig.now);
    rig.run(2);
    assert_eq!(rig.sent[4..], ["201#3A00", "201#0701"]);
}

#[test]
fn lost_questions_and_answers_are_asked_again() {
    let mut rig = strain();
    // Every question needs three attempts: the first is lost, then its answer.
    let mut turn = 0;
    rig.host_loses = Box::new(move |_, frame| {
        turn += 1;
        frame.data().first() == Some(&0x18) && turn % 3 == 1
    });
    let mut answers = 0;
    rig.board_loses = Box::new(move |_, frame| {
        let answer = frame.data().first() == Some(&0x18) && frame.len() == 4;
        answers += u32::from(answer);
        answer && answers % 2 == 1
    });
    rig.run(300);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(
        rig.sent
            .iter()
            .filter(|text| text.starts_with("201#18"))
            .count(),
        18
    );
    assert_eq!(rig.count(Counter::Unexpected), 0);
}

#[test]
fn a_lost_start_is_repeated() {
    let mut rig = strain();
    let mut starts = 0;
    rig.host_loses = Box::new(move |_, frame| {
        let start = frame.data() == [0x07, 0x00];
        starts += u32::from(start);
        start && starts <= 2
    });
    rig.run(2000);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(rig.count(Counter::Starts), 3);
    assert_eq!(
        rig.count(Counter::Silences),
        0,
        "a board that never sent does not become silent"
    );
}

#[test]
fn a_board_that_is_off_is_refused_and_comes_up_when_it_gets_power() {
    let mut rig = strain();
    rig.host_loses = Box::new(|_, _| true);
    rig.run(5000);
    assert_eq!(rig.device.state(), State::Refused(Refusal::NoFullScale));
    assert_eq!(
        rig.states,
        [State::Asking, State::Refused(Refusal::NoFullScale)]
    );
    // 15 quick attempts, then two a second.
    assert!((20..=30).contains(&rig.sent.len()), "{}", rig.sent.len());
    rig.host_loses = Box::new(|_, _| false);
    rig.run(600);
    assert_eq!(rig.device.state(), State::Streaming);
}

/// The host's bus can not send for 2 s: 6 times as long as 15 attempts take.
#[test]
fn a_question_that_was_never_sent_is_no_attempt() {
    let mut rig = strain();
    rig.interface = Box::new(|_| Some(NotSent::Refused));
    rig.run(2000);
    assert_eq!(rig.states, [State::Asking]);
    // Tried again every 20 ms, not in an endless loop.
    let times: Vec<_> = rig.unsent.iter().map(|(t, _)| *t).collect();
    assert!(
        times
            .windows(2)
            .all(|pair| pair[1] - pair[0] == Nanos::from_millis(20))
    );
    rig.interface = Box::new(|_| None);
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(rig.sent.len(), 8, "{:?}", rig.sent);
    assert_eq!(rig.count(Counter::Unexpected), 0);
    // What was never asked has no answer.
    let mut rig = strain();
    rig.interface = Box::new(|_| Some(NotSent::Deadline));
    rig.run(100);
    let now = rig.now.seconds() * 1e3;
    let (_, faults) = decode(&mut *rig.device, &[frame("210#1800070C", now)]);
    assert_eq!(faults[0].counter, Counter::Unexpected);
}

#[test]
fn a_start_command_that_was_not_sent_is_repeated() {
    for (driver, keys, command, fails) in [
        ("icub_strain", SCALES, "201#080A", NotSent::Refused),
        ("icub_strain", SCALES, "201#0700", NotSent::Deadline),
        ("icub_imu", "", "201#350A", NotSent::LinkLost),
        ("icub_imu", "", "201#3405000100000000", NotSent::Refused),
        ("icub_imu", "", "201#33", NotSent::Refused),
    ] {
        let reading = if driver == "icub_imu" {
            imu()
        } else {
            wrench()
        };
        let mut rig = Rig::new(driver, keys, &[], reading);
        let mut count = 0;
        rig.interface = Box::new(move |frame| {
            count += u32::from(frame.to_string() == command);
            (frame.to_string() == command && count <= 3).then_some(fails)
        });
        rig.run(120);
        let unsent: Vec<&str> = rig.unsent.iter().map(|(_, text)| text.as_str()).collect();
        assert_eq!(unsent, [command; 3]);
        // As if it had been sent at once: every command once, in the same order.
        let sent = std::mem::take(&mut rig.sent);
        let mut usual = Rig::new(driver, keys, &[], reading);
        usual.run(50);
        assert_eq!(sent, usual.sent, "{command}");
        assert_eq!(
            (rig.device.state(), rig.count(Counter::Starts)),
            (State::Streaming, 1)
        );
    }
}

/// An interface that takes nothing for longer than the maximum silence, also where nothing is asked
/// before a start.
#[test]
fn a_board_is_asked_again_when_the_interface_takes_frames_again() {
    let joint = (
        0,
        Reading::Joint(JointState {
            position: 0.5,
            velocity: 0.0,
            torque: 0.0,
            current: 0.0,
            ..JointState::ABSENT
        }),
    );
    for (driver, keys, outputs, reading) in [
        ("moteus", "", &[0][..], joint),
        ("odrive", "request_period_ms = 5", &[0], joint),
        (
            "damiao",
            "model = \"DM4310\"\nrequest_period_ms = 5",
            &[0],
            joint,
        ),
        ("myactuator", "request_period_ms = 5", &[0], joint),
        (
            "robstride",
            "model = \"RS03\"\nrequest_period_ms = 5",
            &[0],
            joint,
        ),
        ("ati_netcanoem", "", &[], wrench()),
        ("icub_strain", "", &[], wrench()),
        ("icub_imu", "", &[], imu()),
    ] {
        let mut rig = Rig::new(driver, keys, outputs, reading);
        rig.run(1000);
        assert_eq!(rig.device.state(), State::Streaming, "{driver}");
        rig.interface = Box::new(|_| Some(NotSent::Deadline));
        rig.run(5000);
        rig.interface = Box::new(|_| None);
        rig.run(5000);
        assert_eq!(rig.device.state(), State::Streaming, "{driver}");
    }
}

/// The outcome is late: until it is known nothing else is sent. After a restart the device does not
/// wait for it.
#[test]
fn one_frame_is_under_way_at_a_time() {
    let device = || supervisor("icub_strain", SCALES, &[]);
    let mut out = Decoded::new();
    let (mut one, now) = (device(), Nanos::from_millis(1000));
    let first = one.poll_transmit(now, &mut out).unwrap();
    assert_eq!(first.frame.to_string(), "201#080A");
    let later = now + Nanos::from_millis(500);
    assert_eq!(one.poll_transmit(later, &mut out), None);
    assert_eq!(one.next_wake(), None);
    // Another frame's outcome is not this one's.
    one.on_sent(&frame("201#0700", 0.0), Ok(later));
    assert_eq!(one.poll_transmit(later, &mut out), None);
    one.on_sent(&first.frame, Ok(later));
    assert!(one.next_wake().unwrap() <= later);
    let second = one.poll_transmit(later, &mut out).unwrap();
    assert_eq!(second.frame.to_string(), "201#0700");
    one.restart(later);
    assert_eq!(
        one.poll_transmit(later, &mut out).unwrap().frame,
        first.frame
    );
    // A stop waits for the outcome, and is not repeated.
    one.stop(later);
    assert_eq!(one.poll_transmit(later, &mut out), None);
    one.on_sent(&first.frame, Err(NotSent::Deadline));
    let stop = one.poll_transmit(later, &mut out).unwrap().frame;
    assert_eq!(
        (stop.to_string().as_str(), one.state()),
        ("201#0701", State::Starting)
    );
    one.on_sent(&stop, Err(NotSent::LinkLost));
    assert_eq!(one.poll_transmit(later, &mut out), None);
    assert_eq!(one.state(), State::Stopped);
}

/// The time-out of an answer begins when the question is sent.
#[test]
fn a_question_that_waited_for_the_bus_is_not_repeated_early() {
    let mut device = supervisor("icub_strain", "", &[]);
    let (mut out, now) = (Decoded::new(), Nanos::from_millis(1000));
    let question = device.poll_transmit(now, &mut out).unwrap().frame;
    let sent = now + Nanos::from_millis(19);
    device.on_sent(&question, Ok(sent));
    let next = device.next_wake().unwrap();
    assert_eq!(next - sent, Nanos::from_millis(20));
    assert_eq!(device.poll_transmit(next - Nanos(1), &mut out), None);
    assert_eq!(
        device.poll_transmit(next, &mut out).unwrap().frame,
        question
    );
}

#[test]
fn silence_is_kept_after_power_on() {
    let mut rig = Rig::new("icub_strain", "power_on_silence_ms = 6000", &[], wrench());
    rig.run(5999);
    assert!(rig.sent.is_empty());
    assert_eq!(rig.device.state(), State::Waiting);
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
    // A board that streams already has left its bootloader, so the host need not wait.
    let keys = format!("{SCALES}power_on_silence_ms = 6000");
    let mut rig = Rig::started("icub_strain", &keys, Mode::Supervise, wrench());
    rig.run(30);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(rig.sent.len(), 2);
    // One that has fallen silent may be in it: nothing is sent, not even a stop.
    rig.board_loses = Box::new(|_, _| true);
    rig.run(100);
    assert_eq!(rig.device.state(), State::Silent);
    rig.device.stop(rig.now);
    rig.run(10);
    assert_eq!((rig.device.state(), rig.sent.len()), (State::Stopped, 2));
}

#[test]
fn a_silent_board_is_counted_once_and_started_again() {
    let mut rig = strain();
    rig.run(100);
    rig.board_loses = Box::new(|_, frame| frame.data().first() != Some(&0x18) || frame.len() != 4);
    rig.run(3000);
    assert_eq!(rig.device.state(), State::Silent);
    assert_eq!(rig.count(Counter::Silences), 1);
    let starts = rig.count(Counter::Starts);
    assert!((4..=8).contains(&starts), "{starts} attempts in 3 s");
    let before = rig.readings.len();
    rig.board_loses = Box::new(|_, _| false);
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
    assert!(rig.readings[before].quality.contains(Quality::GAP_BEFORE));
    assert!(
        !rig.readings[before + 1]
            .quality
            .contains(Quality::GAP_BEFORE)
    );
}

#[test]
fn a_board_that_was_reset_is_brought_up_again() {
    let mut rig = strain();
    rig.run(100);
    // Power cut: a new board that streams nothing.
    rig.board = options("icub_strain", "")
        .board(&spec(1, Mode::Supervise, &[]))
        .unwrap();
    rig.run(200);
    assert_eq!(
        (rig.device.state(), rig.count(Counter::Silences)),
        (State::Streaming, 1)
    );
    // The link was lost and is back.
    rig.board = options("icub_strain", "")
        .board(&spec(1, Mode::Supervise, &[]))
        .unwrap();
    let before = rig.readings.len();
    rig.device.restart(rig.now);
    rig.run(20);
    assert_eq!(
        (rig.device.state(), rig.count(Counter::Silences)),
        (State::Streaming, 1)
    );
    assert!(rig.readings[before].quality.contains(Quality::GAP_BEFORE));
}

#[test]
fn a_scale_of_zero_is_refused_until_it_is_repaired() {
    let zero = "full_scale_n = [1804, 1804, 0]\nfull_scale_nm = [31, 31, 31]";
    let mut rig = Rig::with_board("icub_strain", "", zero, &[], wrench());
    rig.run(3000);
    assert_eq!(
        rig.device.state(),
        State::Refused(Refusal::ZeroFullScale { channel: 2 })
    );
    assert!(rig.readings.is_empty() && rig.board.period().is_none());
    assert!(rig.sent.len() < 12, "{:?}", rig.sent);
    rig.board = options("icub_strain", "")
        .board(&spec(1, Mode::Supervise, &[]))
        .unwrap();
    rig.run(600);
    assert_eq!(rig.device.state(), State::Streaming);
    // The configuration overrides the board's value.
    let mut rig = Rig::with_board("icub_strain", SCALES, zero, &[], wrench());
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
}

#[test]
fn a_scale_that_changed_is_refused_for_good() {
    let mut rig = strain();
    rig.run(100);
    let other = "full_scale_n = [1804, 1804, 1805]\nfull_scale_nm = [31, 31, 31]";
    rig.board = options("icub_strain", other)
        .board(&spec(1, Mode::Supervise, &[]))
        .unwrap();
    let before = rig.readings.len();
    rig.run(1000);
    assert_eq!(rig.device.state(), State::Refused(Refusal::Changed));
    assert_eq!(
        (rig.count(Counter::Changed), rig.readings.len()),
        (1, before)
    );
    rig.device.restart(rig.now);
    rig.run(1000);
    assert_eq!(rig.device.state(), State::Refused(Refusal::Changed));
}

#[test]
fn an_answer_counts_only_while_it_is_asked_for() {
    let mut rig = strain();
    rig.run(3000);
    let state = rig.device.state();
    let now = rig.now.seconds() * 1e3;
    let at = |text| frame(text, now);
    let (_, faults) = decode(&mut *rig.device, &[at("210#1800070C")]);
    assert_eq!(
        faults.iter().map(|f| f.counter).collect::<Vec<_>>(),
        [Counter::Unexpected]
    );
    let (_, faults) = decode(&mut *rig.device, &[at("210#18000001")]);
    assert_eq!(
        faults.iter().map(|f| f.counter).collect::<Vec<_>>(),
        [Counter::Changed, Counter::Unexpected]
    );
    // Answers to other programs' questions are ignored.
    let (_, faults) = decode(
        &mut *rig.device,
        &[at("210#1C0C020008020001"), at("210#18100001")],
    );
    assert!(faults.is_empty(), "{faults:?}");
    assert_eq!(rig.device.state(), state);
}

#[test]
fn a_listener_learns_the_scale_from_the_log() {
    let mut device = listener("icub_strain", "", &[]);
    let pair = [
        frame("31A#E380B76A1887", 0.0),
        frame("31B#2184BE770881", 0.1),
    ];
    assert_eq!(device.state(), State::Starting);
    let (readings, _) = decode(&mut *device, &pair);
    assert!(readings.is_empty(), "no reading without a scale");
    assert_eq!(device.state(), State::Refused(Refusal::NoFullScale));
    let answers = [
        "1800070C", "1801070C", "1802070C", "1803001F", "1804001F", "1805001F",
    ];
    let answers: Vec<_> = answers
        .iter()
        .map(|data| frame(&format!("210#{data}"), 1.0))
        .collect();
    let (_, faults) = decode(&mut *device, &answers);
    assert!(faults.is_empty(), "{faults:?}");
    let (readings, _) = decode(&mut *device, &pair);
    assert_eq!((readings.len(), device.state()), (1, State::Streaming));
    // The same answer again changes nothing; a different value makes all readings doubtful.
    let (_, faults) = decode(&mut *device, &answers);
    assert!(faults.is_empty(), "{faults:?}");
    let (_, faults) = decode(&mut *device, &[frame("210#18000001", 2.0)]);
    assert_eq!(
        faults.iter().map(|f| f.counter).collect::<Vec<_>>(),
        [Counter::Changed]
    );
    let (readings, _) = decode(&mut *device, &pair);
    assert_eq!(
        (readings.len(), device.state()),
        (0, State::Refused(Refusal::Changed))
    );
}

#[test]
fn a_listener_watches_for_silence() {
    let mut rig = Rig::started("icub_strain", SCALES, Mode::Listen, wrench());
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
    let woken = rig.device.next_wake().unwrap();
    assert!(woken > rig.now && woken < rig.now + Nanos::from_millis(60));
    rig.board_loses = Box::new(|_, _| true);
    rig.run(500);
    assert_eq!(
        (rig.device.state(), rig.count(Counter::Silences)),
        (State::Silent, 1)
    );
    assert_eq!(rig.device.next_wake(), None);
    rig.board_loses = Box::new(|_, _| false);
    rig.run(20);
    assert_eq!((rig.device.state(), rig.sent.len()), (State::Streaming, 0));
}

#[test]
fn an_imu_is_told_asked_and_started_as_in_the_document() {
    let keys = r#"quantities = ["acceleration", "angular_velocity", "status"]"#;
    let mut rig = Rig::new("icub_imu", keys, &[], imu());
    rig.run(100);
    // The document's example: 201#3405800100000000, 201#350A.
    assert_eq!(rig.sent, ["201#3405800100000000", "201#33", "201#350A"]);
    assert_eq!(
        (rig.device.state(), rig.readings.len()),
        (State::Streaming, 10)
    );
    rig.device.stop(rig.now);
    rig.run(2);
    assert_eq!(
        (rig.sent.last().unwrap().as_str(), rig.board.period()),
        ("201#3500", None)
    );
}

#[test]
fn an_imu_that_lost_its_configuration_is_told_again() {
    let mut rig = Rig::new("icub_imu", "placement = 6\nmode = \"imu\"", &[], imu());
    rig.host_loses = Box::new(|number, _| number == 1);
    rig.run(100);
    assert_eq!(
        rig.sent,
        [
            "201#3405008886000000",
            "201#33",
            "201#3405008886000000",
            "201#33",
            "201#350A"
        ]
    );
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(rig.count(Counter::Changed), 0);
}

#[test]
fn an_imu_that_does_not_answer_is_started_all_the_same() {
    let mut rig = Rig::new("icub_imu", "", &[], imu());
    rig.board_loses = Box::new(|_, frame| frame.data().first() == Some(&0x33));
    rig.run(500);
    assert_eq!(rig.device.state(), State::Streaming);
}

#[test]
fn a_silent_imu_is_started_again_and_its_counter_begins_anew() {
    let mut rig = Rig::new("icub_imu", "", &[], imu());
    rig.run(500);
    rig.board = options("icub_imu", "")
        .board(&spec(1, Mode::Supervise, &[]))
        .unwrap();
    let before = rig.readings.len();
    rig.run(200);
    assert_eq!(
        (
            rig.device.state(),
            rig.count(Counter::Silences),
            rig.count(Counter::Lost)
        ),
        (State::Streaming, 1, 0)
    );
    assert!(rig.readings[before].quality.contains(Quality::GAP_BEFORE));
    assert_eq!(rig.readings[before].device_counter, 1);
}

/// A gateway that is started anew beside a board that streams: its first acquisition is heard from
/// the middle, and the start makes the counter begin anew. Neither is a loss; a gap later is.
#[test]
fn an_imu_that_streams_already_loses_nothing_at_the_start() {
    let keys = "quantities = [\"acceleration\", \"angular_velocity\", \"orientation\"]";
    let mut rig = Rig::new("icub_imu", keys, &[], imu());
    rig.reading.1 = Reading::Imu(Imu {
        orientation: [1.0, 0.0, 0.0, 0.0],
        ..match imu().1 {
            Reading::Imu(imu) => imu,
            other => panic!("{other:?}"),
        }
    });
    rig.run(1130);
    let fresh = options("icub_imu", keys).device(&spec(1, Mode::Supervise, &[]));
    rig.device = fresh.unwrap();
    // It begins to listen after the acceleration, and its first question is lost, so that the board
    // streams on for some time.
    let from = rig.received;
    let sent = rig.sent.len();
    rig.board_loses = Box::new(move |number, _| number == from + 1);
    rig.host_loses = Box::new(move |number, _| number <= sent + 2);
    rig.run(500);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(
        rig.faults
            .iter()
            .filter(|f| f.counter != Counter::Starts)
            .count(),
        0
    );
    let last = rig.readings.last().expect("readings").device_counter;
    assert!(last < 60, "the counter began anew: {last}");
    let from = rig.received;
    rig.board_loses = Box::new(move |number, _| number <= from + 9);
    rig.run(100);
    assert_eq!(rig.count(Counter::Lost), 3);
}

/// A command makes the counter begin anew once. What jumps after that is lost.
#[test]
fn a_command_excuses_one_jump_of_an_imus_counter() {
    let device = options("icub_imu", "").device(&spec(1, Mode::Supervise, &[]));
    let (mut device, now) = (device.unwrap(), Nanos::from_millis(1000));
    let command = device.poll_transmit(now, &mut Decoded::new()).unwrap();
    device.on_sent(&command.frame, Ok(now));
    let acquisitions = [(7, 1001.0), (100, 1010.0), (150, 1020.0)].map(|(sequence, ms)| {
        [0, 2].map(|sensor| {
            let text = format!("513#{sequence:02X}{sensor:02X}000000000000");
            frame(&text, ms)
        })
    });
    let (readings, faults) = decode(&mut *device, acquisitions.as_flattened());
    let gaps = readings
        .iter()
        .map(|reading| reading.quality.contains(Quality::GAP_BEFORE));
    assert_eq!(gaps.collect::<Vec<_>>(), [false, true, true]);
    let counted: Vec<_> = faults.iter().map(|f| (f.counter, f.count)).collect();
    assert_eq!(counted, [(Counter::Lost, 49)]);
}

/// As many starts as a question has attempts, then the board counts as silent. Over again until it
/// comes.
#[test]
fn a_board_that_never_sends_counts_as_silent() {
    let mut rig = Rig::new("icub_imu", "", &[], imu());
    rig.board_loses = Box::new(|_, _| true);
    rig.run(3000);
    assert!(!rig.states.contains(&State::Silent), "{:?}", rig.states);
    rig.run(20_000);
    let starts = rig.count(Counter::Starts);
    assert_eq!(rig.device.state(), State::Silent);
    assert!(starts > 15, "{starts}");
    rig.board_loses = Box::new(|_, _| false);
    rig.run(2000);
    assert_eq!(rig.device.state(), State::Streaming);
    assert!(!rig.readings[0].quality.contains(Quality::GAP_BEFORE));
}

#[test]
fn a_board_that_is_listened_to_and_never_sends_counts_as_silent() {
    let mut rig = Rig::started("icub_imu", "", Mode::Listen, imu());
    rig.board_loses = Box::new(|_, _| true);
    rig.run(8000);
    assert_eq!(rig.states, [State::Starting]);
    rig.run(1000);
    assert_eq!(rig.device.state(), State::Silent);
    assert!(rig.sent.is_empty(), "it only listens");
    rig.board_loses = Box::new(|_, _| false);
    rig.run(100);
    assert_eq!(rig.device.state(), State::Streaming);
}

#[test]
fn a_legacy_imu_is_started_with_its_own_command() {
    let mut rig = Rig::new("icub_imu", "legacy = \"mtb\"\nperiod_ms = 20", &[], imu());
    rig.run(100);
    assert_eq!(rig.sent, ["201#4F0614"]);
    assert_eq!(
        (rig.device.state(), rig.readings.len()),
        (State::Streaming, 5)
    );
    rig.device.stop(rig.now);
    rig.run(2);
    assert_eq!(
        (rig.sent.last().unwrap().as_str(), rig.board.period()),
        ("201#4F0000", None)
    );
}

#[test]
fn a_motor_board_is_only_listened_to() {
    let joint = JointState {
        position: 1.0,
        velocity: 0.0,
        current: 0.5,
        ..JointState::ABSENT
    };
    let mut rig = Rig::new(
        "icub_motor",
        "period_ms = 2",
        &[0],
        (0, Reading::Joint(joint)),
    );
    rig.run(100);
    assert_eq!(
        (rig.device.state(), rig.readings.len(), rig.sent.len()),
        (State::Streaming, 50, 0)
    );
    rig.board_loses = Box::new(|_, _| true);
    rig.run(200);
    assert_eq!(
        (rig.device.state(), rig.count(Counter::Silences)),
        (State::Silent, 1)
    );
    rig.device.stop(rig.now);
    rig.run(2);
    assert_eq!((rig.device.state(), rig.sent.len()), (State::Stopped, 0));
}

/// What a motor board has said before the link was lost does not hold after it is back.
#[test]
fn a_fault_of_a_motor_board_ends_with_a_restart() {
    let mut device = listener("icub_motor", "", &[0]);
    let (broken, motion) = ("113#0601000000000000", "110#0000000000000000");
    let (readings, _) = decode(&mut *device, &[broken, motion].map(|text| frame(text, 1.0)));
    assert_eq!(readings[1].quality, Quality::DEVICE_FAULT);
    device.restart(Nanos::from_millis(2));
    let (readings, _) = decode(&mut *device, &[frame(motion, 3.0)]);
    assert_eq!(readings[0].quality, Quality::GAP_BEFORE);
}

#[test]
fn a_pos_board_is_configured_and_started() {
    let joint = (
        2,
        Reading::Joint(JointState {
            position: 0.5,
            ..JointState::ABSENT
        }),
    );
    let keys = "sensors = [{ label = 2, inverted = true, rotation_deg = -90, zero_deg = 25.6 }, \
                { label = 3 }]\nperiod_ms = 5";
    let mut rig = Rig::new("icub_pos", keys, &[2], joint);
    rig.run(50);
    // F2: enabled, inverted, -90 deg, label 2; zero 0x0100. 83: enabled, label 3.
    assert_eq!(rig.sent, ["201#5200F20001830000", "201#5100", "201#5305"]);
    assert!(rig.readings.iter().all(|r| r.quality == Quality::GOOD));
    assert_eq!(
        (rig.device.state(), rig.readings.len()),
        (State::Streaming, 10)
    );
    rig.device.stop(rig.now);
    rig.run(2);
    assert_eq!(
        (rig.sent.last().unwrap().as_str(), rig.board.period()),
        ("201#5300", None)
    );
}

const POS: &str = "sensors = [{ label = 2, zero_deg = 25.6 }]";

fn pos() -> (u8, Reading) {
    let state = JointState {
        position: 0.5,
        ..JointState::ABSENT
    };
    (2, Reading::Joint(state))
}

/// The board misses the configuration several times; it streams meanwhile, with its old one.
#[test]
fn an_angle_is_good_only_when_the_board_has_confirmed_its_configuration() {
    let mut rig = Rig::new("icub_pos", POS, &[2], pos());
    rig.board = options("icub_pos", POS)
        .board(&spec(1, Mode::Listen, &[2]))
        .unwrap();
    let mut sets = 0;
    rig.host_loses = Box::new(move |_, frame| {
        sets += u32::from(frame.data().first() == Some(&0x52));
        // Neither the first configurations nor any question arrive: 3 x 20 ms without an answer.
        sets <= 3
    });
    rig.run(200);
    let good: Vec<bool> = rig
        .readings
        .iter()
        .map(|reading| reading.quality == Quality::GOOD)
        .collect();
    let first = good.iter().position(|good| *good).unwrap();
    assert!((5..8).contains(&first), "{good:?}");
    for reading in &rig.readings[..first] {
        assert_eq!(reading.quality, Quality::NOT_CALIBRATED);
    }
    assert!(good[first..].iter().all(|good| *good));
    assert_eq!(rig.count(Counter::Changed), 0);
    assert_eq!(rig.sent.last().unwrap(), "201#530A");
    // A board that was reset has lost its configuration: it counts again only when confirmed.
    rig.board = options("icub_pos", POS)
        .board(&spec(1, Mode::Listen, &[2]))
        .unwrap();
    rig.device.restart(rig.now);
    let before = rig.readings.len();
    rig.board_loses = Box::new(|_, frame| frame.data().first() == Some(&0x51));
    rig.run(600);
    let after = &rig.readings[before..];
    assert!(after.len() > 10 && rig.device.state() == State::Streaming);
    assert!(after[0].quality.contains(Quality::GAP_BEFORE));
    assert!(
        after
            .iter()
            .all(|reading| reading.quality.contains(Quality::NOT_CALIBRATED))
    );
    assert_eq!(rig.count(Counter::Changed), 0);
    // An answer that comes after the start confirms it, too.
    let set = rig.sent.iter().find(|sent| sent.starts_with("201#52"));
    let answer = set.expect("a command").replace("201#52", "210#51");
    let now = rig.now.seconds() * 1e3;
    let late = [&answer, "311#0021840300000000"].map(|text| frame(text, now));
    let (readings, faults) = decode(&mut *rig.device, &late);
    assert_eq!(readings[0].quality, Quality::GOOD);
    assert!(faults.is_empty(), "{faults:?}");
}

#[test]
fn a_pos_board_that_never_agrees_is_counted_and_its_angles_stay_doubtful() {
    let mut rig = Rig::new("icub_pos", POS, &[2], pos());
    rig.host_loses = Box::new(|_, frame| frame.data().first() == Some(&0x52));
    rig.run(500);
    assert_eq!(
        (rig.device.state(), rig.count(Counter::Changed)),
        (State::Streaming, 1)
    );
    assert!(rig.readings.len() > 10);
    assert!(
        rig.readings
            .iter()
            .all(|reading| reading.quality == Quality::NOT_CALIBRATED)
    );
    // Before anything was sent.
    let mut device = options("icub_pos", POS)
        .device(&spec(1, Mode::Supervise, &[2]))
        .unwrap();
    let (readings, _) = decode(&mut *device, &[frame("311#0021840300000000", 0.0)]);
    assert_eq!(readings[0].quality, Quality::NOT_CALIBRATED);
    // Without `sensors`, and where another program commands the board, there is nothing to confirm.
    let mut rig = Rig::new("icub_pos", "", &[2], pos());
    rig.run(100);
    assert_eq!(rig.sent, ["201#530A"]);
    assert_eq!(rig.readings[0].quality, Quality::GOOD);
    let mut device = listener("icub_pos", POS, &[2]);
    let (readings, _) = decode(&mut *device, &[frame("311#0021840300000000", 0.0)]);
    assert_eq!(readings[0].quality, Quality::GOOD);
}

#[test]
fn configurations_that_can_not_work_are_named() {
    let error = |driver: &str, keys: &str, address: u32, outputs: &[u8]| {
        let spec = spec(address, Mode::Supervise, outputs);
        match options(driver, keys).device(&spec) {
            Err(error) => error.to_string(),
            Ok(_) => panic!("{driver} accepts {keys:?}"),
        }
    };
    assert_eq!(
        error("icub_strain", "", 0, &[]),
        "address = 0 is outside 1 to 14"
    );
    assert_eq!(
        error("icub_imu", "", 15, &[]),
        "address = 15 is outside 1 to 14"
    );
    assert_eq!(
        error("icub_strain", "period_ms = 0", 1, &[]),
        "period_ms = 0 must be an integer from 1 to 255"
    );
    assert_eq!(
        error("icub_strain", "full_scale_n = [1, 2, 3]", 1, &[]),
        "full_scale_nm is missing: it is needed together with full_scale_n"
    );
    assert_eq!(
        error(
            "icub_strain",
            "full_scale_n = [1, 0, 3]\nfull_scale_nm = [1, 2, 3]",
            1,
            &[]
        ),
        "full_scale_n = 0 must be above 0 and at most 65535"
    );
    for keys in ["full_scale_n = [1, 2]", "full_scale_n = [1, 2, 3, 4]"] {
        let table: toml::Table = keys.parse().expect("test keys are TOML");
        let error = format!("{:?}", Options::deserialize("icub_strain", table));
        assert!(error.contains("expected 3 numbers"), "{keys}: {error}");
    }
    assert!(
        error("icub_imu", "quantities = [\"status\"]", 1, &[])
            .starts_with("quantities must be a list with at least one")
    );
    assert!(error("icub_imu", "placement = 8", 1, &[]).contains("placement = 8"));
    assert!(error("icub_motor", "", 1, &[]).contains("needs a joint"));
    assert_eq!(
        error("icub_motor", "", 1, &[3]),
        "joint channel 3 does not exist; this device has channels 0 to 0"
    );
    assert!(error("icub_pos", "sensors = []", 1, &[0]).starts_with("sensors must be"));
    for driver in ["icub_strain", "icub_imu", "icub_skin"] {
        for ms in [60_001, 70_000] {
            assert_eq!(
                error(driver, &format!("power_on_silence_ms = {ms}"), 1, &[]),
                format!("power_on_silence_ms = {ms} must be at most 60000")
            );
        }
        let most = options(driver, "power_on_silence_ms = 60000");
        assert!(most.device(&spec(1, Mode::Supervise, &[])).is_ok());
    }
    let missing = SpecError::Incomplete {
        given: "a",
        missing: "b",
    };
    assert_eq!(
        missing.to_string(),
        "b is missing: it is needed together with a"
    );
    // Unknown keys are errors.
    for &driver in proprio_drivers::DRIVERS {
        let table: toml::Table = "full_scale = 3".parse().unwrap();
        assert!(Options::deserialize(driver, table).is_err(), "{driver}");
    }
}

/// A board that must not hear anything while it starts is stopped as any other once it runs.
#[test]
fn a_board_with_a_silence_at_power_on_is_stopped() {
    let stopped = |keys: &str| {
        let mut rig = Rig::new("icub_strain", keys, &[], wrench());
        rig.run(300);
        assert_eq!(rig.device.state(), State::Streaming);
        let before = rig.sent.len();
        rig.device.stop(rig.now);
        rig.run(50);
        assert_eq!(rig.device.state(), State::Stopped);
        rig.sent.split_off(before)
    };
    let usual = stopped(SCALES);
    assert!(!usual.is_empty());
    assert_eq!(stopped(&format!("{SCALES}power_on_silence_ms = 20")), usual);
}

/// A sensor's first byte is 80 (enabled) and its label; its zero is in 0.1 deg.
#[test]
fn a_sensor_has_a_label_of_4_bits_and_a_zero_within_a_turn() {
    let first = |sensor: &str| {
        let options = options("icub_pos", &format!("sensors = [{sensor}]"));
        let mut device = options.device(&spec(1, Mode::Supervise, &[0]))?;
        let transmit = device.poll_transmit(Nanos::from_millis(1000), &mut Decoded::new());
        Ok(transmit.expect("a configuration").frame.to_string())
    };
    for (sensor, sent) in [
        ("{ label = 15 }", "201#52008F0000000000"),
        ("{ zero_deg = 360.0 }", "201#520080100E000000"),
        ("{ zero_deg = -360.0 }", "201#520080F0F1000000"),
    ] {
        assert_eq!(first(sensor), Ok(sent.to_owned()));
    }
    for (sensor, wrong) in [
        ("{ label = 16 }", "label"),
        ("{ label = 255 }", "label"),
        ("{ zero_deg = 360.1 }", "zero_deg"),
        ("{ zero_deg = -360.1 }", "zero_deg"),
        ("{ zero_deg = nan }", "zero_deg"),
        ("{ rotation_deg = 270 }", "rotation_deg"),
    ] {
        let refused = first(sensor);
        let names = matches!(refused, Err(SpecError::Key { key, .. }) if key == wrong);
        assert!(names, "{sensor}: {refused:?}");
    }
}

/// 0 is no period: these boards keep the one that they have.
#[test]
fn a_period_of_zero_is_ignored() {
    for (driver, outputs, zero, seven) in [
        ("icub_strain", &[][..], "201#0800", "201#0807"),
        ("icub_mais", &[0], "201#0800", "201#0807"),
        ("icub_skin", &[], "201#4D0000F5", "201#4D0007F5"),
    ] {
        let spec = spec(1, Mode::Listen, outputs);
        let mut board = options(driver, "period_ms = 20").board(&spec).unwrap();
        for (text, ms) in [(zero, 20), (seven, 7), (zero, 7)] {
            board.on_frame(&frame(text, 0.0), &mut proprio_drivers::Frames::new());
            assert_eq!(board.period(), Some(Nanos::from_millis(ms)), "{driver}");
        }
    }
}

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

/// It takes the command within the 20 ms of an answer and sends a period later: until then a jump
/// is excused.
#[test]
fn a_command_excuses_a_jump_of_an_imus_counter_for_a_while() {
    for (ms, lost) in [(1029.9, 0), (1030.1, 92)] {
        let device = options("icub_imu", "").device(&spec(1, Mode::Supervise, &[]));
        let (mut device, now) = (device.unwrap(), Nanos::from_millis(1000));
        let command = device.poll_transmit(now, &mut Decoded::new()).unwrap();
        device.on_sent(&command.frame, Ok(now));
        let texts = [7, 100].map(|sequence: u8| format!("513#{sequence:02X}00000000000000"));
        let frames = [frame(&texts[0], 1001.0), frame(&texts[1], ms)];
        let (_, faults) = decode(&mut *device, &frames);
        assert_eq!(crate::rig::count(&faults, Counter::Lost), lost, "{ms}");
    }
}
