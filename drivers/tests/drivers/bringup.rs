//! Bring-up of each family against its own board: frames sent, losses, silence, restart, refusal,
//! stop.

mod imu;
mod pos;
mod scales;

use crate::rig::{Rig, decode, frame, listener, options, spec, supervisor};
use proprio_drivers::{Decoded, Mode, NotSent, Options, SpecError, State};
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
