//! CANopen encoders, drives and SYNC: a session of nodes and a master of another implementation,
//! start-up against the boards, cycles of SYNC, and what nodes say of themselves.

mod drive;

use crate::rig::{Rig, board, count, decode, encode, frame, joint, listener, options, spec};
use proprio_drivers::{
    Board, Decoded, Device, Frame, Frames, Mode, SpecError, StampedReading, State,
};
use proprio_topics::{Actuator, Counter, JointState, Nanos, Quality, Reading, Refusal, StampKind};
use proptest::prelude::*;
use std::f64::consts::TAU;

/// A session, `tests/oracle/frames/canopen_session.py`: a frame a millisecond.
const SESSION: &str = include_str!("canopen.txt");

fn actuator(reading: &Reading) -> Actuator {
    match reading {
        Reading::Actuator(actuator) => *actuator,
        other => panic!("{other:?}"),
    }
}

fn joints(readings: &[StampedReading]) -> Vec<StampedReading> {
    let is_joint = |stamped: &&StampedReading| matches!(stamped.reading, Reading::Joint(_));
    readings.iter().filter(is_joint).copied().collect()
}

/// Its frames, and the raw values of each reading of `who`.
fn session(who: &str) -> (Vec<Frame>, Vec<Vec<f64>>) {
    let (mut frames, mut truth) = (Vec::new(), Vec::new());
    for (ms, line) in SESSION.lines().enumerate() {
        match line.split_once(' ') {
            None => frames.push(frame(line, ms as f64)),
            Some((name, numbers)) if name == who => {
                truth.push(numbers.split(' ').map(|n| n.parse().unwrap()).collect());
            }
            Some(_) => {}
        }
    }
    (frames, truth)
}

fn at(driver: &str, keys: &str, node: u32, mode: Mode) -> Box<dyn Device> {
    options(driver, keys)
        .device(&spec(node, mode, &[0]))
        .unwrap()
}

/// The frames that a device would get.
fn claimed(device: &dyn Device, frames: &[Frame]) -> Vec<Frame> {
    let mine = |frame: &&Frame| device.claims().iter().any(|claim| claim.matches(frame.id));
    frames.iter().filter(mine).copied().collect()
}

fn near(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-9 * b.abs().max(1.0)
}

#[test]
fn a_session_of_another_master_tells_mapping_and_scales() {
    let (frames, truth) = session("drive");
    let mut device = at(
        "canopen_drive",
        "velocity_unit = \"0.1 rpm\"",
        5,
        Mode::Listen,
    );
    let mine = claimed(&*device, &frames);
    let (readings, faults) = decode(&mut *device, &mine);
    let joints = joints(&readings);
    // The status is sent after the joint's values: one fault is told by the emergency message.
    assert_eq!(count(&faults, Counter::DriveFault), 2, "{faults:?}");
    assert_eq!((joints.len(), faults.len()), (truth.len(), 2));
    for (stamped, raw) in joints.iter().zip(&truth) {
        let read = joint(&stamped.reading);
        assert!(near(read.position, raw[0] * TAU / 10_000.0), "{read:?}");
        assert!(near(read.velocity, raw[1] * 0.1 * TAU / 60.0), "{read:?}");
        assert!(near(read.torque, raw[2] * 0.88e-3), "{read:?}");
        assert!(near(read.current, raw[3] * 4.3e-3), "{read:?}");
        let sync = frames
            .iter()
            .rfind(|f| f.id.raw() == 0x80 && f.t <= stamped.acquired);
        assert_eq!(stamped.acquired, sync.unwrap().t, "measured at its SYNC");
    }
    let fault = |stamped: &StampedReading| stamped.quality.contains(Quality::DRIVE_FAULT);
    assert_eq!(
        joints.iter().map(fault).collect::<Vec<_>>(),
        [false, false, false, true, true, false]
    );
    let states: Vec<Actuator> = (readings.iter())
        .filter(|stamped| matches!(stamped.reading, Reading::Actuator(_)))
        .map(|stamped| actuator(&stamped.reading))
        .collect();
    assert_eq!(states.len(), 12, "the mode's and the status' process data");
    assert_eq!(
        (states[1].mode, states[1].encoder, states[1].faults),
        (10, 0x637, 0)
    );
    assert_eq!(states[7].faults, 0x2310);
    assert_eq!(device.state(), State::Streaming);
}

#[test]
fn an_encoder_that_another_master_has_configured_is_read() {
    let (frames, truth) = session("encoder");
    let mut device = at("canopen_encoder", "sync = 1", 9, Mode::Listen);
    let mine = claimed(&*device, &frames);
    let (readings, faults) = decode(&mut *device, &mine);
    assert_eq!(readings.len(), truth.len());
    for (stamped, raw) in readings.iter().zip(&truth) {
        // It is scaled: object 6001, not 6501.
        let position = joint(&stamped.reading).position;
        assert!(near(position, raw[0] * TAU / 3600.0), "{position}");
        assert!(
            frames
                .iter()
                .any(|f| f.id.raw() == 0x80 && f.t == stamped.acquired)
        );
    }
    let fault = |stamped: &StampedReading| stamped.quality.contains(Quality::DEVICE_FAULT);
    assert_eq!(readings.iter().filter(|r| fault(r)).count(), 1);
    assert!(fault(&readings[4]) && count(&faults, Counter::DeviceFault) == 1);
    let mut by_key = at("canopen_encoder", "counts_per_turn = 100", 9, Mode::Listen);
    let (readings, _) = decode(&mut *by_key, &mine);
    assert!(near(
        joint(&readings[0].reading).position,
        truth[0][0] * TAU / 100.0
    ));
    assert_eq!(
        readings[0].acquired,
        mine.iter().find(|f| f.id.raw() == 0x189).unwrap().t
    );
}

/// A device and a board with a SYNC from the host each `period` milliseconds.
struct Synced {
    device: Box<dyn Device>,
    board: Box<dyn Board>,
    reading: Reading,
    period: i64,
    now: i64,
    readings: Vec<StampedReading>,
    sent: Vec<String>,
    /// Whether the n-th process data frame is lost.
    loses: fn(usize) -> bool,
    received: usize,
}

impl Synced {
    fn new(driver: &str, keys: &str, board_keys: &str, reading: Reading) -> Self {
        let spec = spec(1, Mode::Supervise, &[0]);
        Self {
            device: options(driver, keys).device(&spec).unwrap(),
            board: options(driver, board_keys).board(&spec).unwrap(),
            reading,
            period: 5,
            now: 1000,
            readings: Vec::new(),
            sent: Vec::new(),
            loses: |_| false,
            received: 0,
        }
    }

    fn run(&mut self, ms: i64) -> &mut Self {
        for _ in 0..ms {
            let now = Nanos::from_millis(self.now);
            let mut out = Decoded::new();
            let mut answers = Frames::new();
            self.board.present(0, &self.reading, Quality::GOOD);
            if self.now % self.period == 0 {
                let sync = frame("080#", self.now as f64);
                self.device.overhear(&sync, &mut out);
                self.board.on_frame(&sync, &mut answers);
            }
            while let Some(transmit) = self.device.poll_transmit(now, &mut out) {
                self.device.on_sent(&transmit.frame, Ok(now));
                self.sent.push(transmit.frame.to_string());
                self.board.on_frame(&transmit.frame, &mut answers);
                for answer in answers.take() {
                    // A little later, as on a bus.
                    let t = now + Nanos::from_micros(200);
                    let is_process_data = (0x180..0x580).contains(&answer.id.raw());
                    self.received += usize::from(is_process_data);
                    if !(is_process_data && (self.loses)(self.received)) {
                        self.device
                            .on_frame(&answer.at(t, StampKind::Software), &mut out);
                    }
                }
            }
            for answer in answers {
                let is_process_data = (0x180..0x580).contains(&answer.id.raw());
                self.received += usize::from(is_process_data);
                if !(is_process_data && (self.loses)(self.received)) {
                    let t = now + Nanos::from_micros(200);
                    self.device
                        .on_frame(&answer.at(t, StampKind::Software), &mut out);
                }
            }
            self.readings.extend(out.readings);
            self.now += 1;
        }
        self
    }
}

const STATE: JointState = JointState {
    position: 1.5,
    velocity: -2.0,
    acceleration: f64::NAN,
    torque: 0.25,
    current: 1.1,
};

#[test]
fn an_encoder_is_configured_and_started() {
    let mut rig = Rig::new("canopen_encoder", "", &[0], (0, Reading::Joint(STATE)));
    rig.run(60);
    assert_eq!(
        rig.sent,
        [
            "000#8001",
            "601#4000100000000000",
            "601#4000600000000000",
            "601#4001650000000000",
            "601#23001801810100C0",
            "601#2F001A0000000000",
            "601#23001A0120000460",
            "601#2F001A0001000000",
            "601#2F001802FE000000",
            "601#2B0018050A000000",
            "601#2300180181010040",
            "601#2B171000F4010000",
            "000#0101"
        ]
    );
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(rig.readings.len(), 6);
    for stamped in &rig.readings {
        assert!((joint(&stamped.reading).position - 1.5).abs() < TAU / 16384.0);
        assert_eq!(stamped.quality, Quality::GOOD);
    }
    rig.device.stop(rig.now);
    rig.run(30);
    assert_eq!(rig.sent.last().unwrap(), "000#8001");
    assert_eq!(
        (rig.device.state(), rig.board.period()),
        (State::Stopped, None)
    );
}

#[test]
fn each_lost_frame_of_the_start_is_made_up_for() {
    for lost in 1..=13 {
        for host in [true, false] {
            let mut rig = Rig::new("canopen_encoder", "", &[0], (0, Reading::Joint(STATE)));
            let lose = move |n: usize, _: &Frame| n == lost;
            if host {
                rig.host_loses = Box::new(lose);
            } else {
                rig.board_loses = Box::new(lose);
            }
            rig.run(500);
            assert_eq!(rig.device.state(), State::Streaming, "{lost} {host}");
            assert!((joint(&rig.readings[0].reading).position - 1.5).abs() < 1e-3);
        }
    }
}

#[test]
fn an_encoder_can_measure_by_sync() {
    let mut synced = Synced::new(
        "canopen_encoder",
        "sync = 2",
        "sync = 2",
        Reading::Joint(STATE),
    );
    synced.run(200);
    assert!(synced.sent.contains(&"601#2F00180202000000".to_owned()));
    assert!(
        !synced.sent.iter().any(|f| f.starts_with("601#2B001805")),
        "no timer"
    );
    assert!(
        (18..=20).contains(&synced.readings.len()),
        "{}",
        synced.readings.len()
    );
    for stamped in &synced.readings {
        assert_eq!(stamped.acquired.0 % 5_000_000, 0, "the time of a SYNC");
    }
}

/// Which SYNC is whose: frames by their stamps \[ms\], an answer by its number, a SYNC by 0; and
/// the stamps of the readings.
#[test]
fn a_late_answer_does_not_get_the_stamp_of_a_later_sync() {
    type Case = (&'static [(f64, u8)], &'static [(u32, f64)], u32);
    let cases: &[Case] = &[
        // One answer is lost: the next could be it.
        (
            &[
                (10.0, 0),
                (10.5, 1),
                (20.0, 0),
                (30.0, 0),
                (30.5, 3),
                (40.0, 0),
                (40.5, 4),
            ],
            &[(1, 10.0), (4, 40.0)],
            1,
        ),
        // One comes after the next SYNC; then both SYNC are answered.
        (
            &[
                (10.0, 0),
                (20.0, 0),
                (20.1, 1),
                (20.5, 2),
                (30.0, 0),
                (30.5, 3),
            ],
            &[(2, 20.0), (3, 30.0)],
            1,
        ),
        // So does one with the stamp of the next.
        (
            &[
                (10.0, 0),
                (20.0, 0),
                (20.0, 1),
                (20.5, 2),
                (30.0, 0),
                (30.5, 3),
            ],
            &[(2, 20.0), (3, 30.0)],
            1,
        ),
        // It was taken after it, but its stamp is before.
        (
            &[
                (10.0, 0),
                (20.0, 0),
                (10.4, 1),
                (20.5, 2),
                (30.0, 0),
                (30.5, 3),
            ],
            &[(1, 10.0), (2, 20.0), (3, 30.0)],
            0,
        ),
        // Two late ones.
        (
            &[
                (10.0, 0),
                (20.0, 0),
                (30.0, 0),
                (30.1, 1),
                (30.2, 2),
                (30.3, 3),
            ],
            &[(3, 30.0)],
            2,
        ),
        // The host has noted its SYNC after the answer's stamp.
        (
            &[(10.0, 0), (9.9, 1), (20.0, 0), (20.5, 2)],
            &[(1, 9.9), (2, 20.0)],
            0,
        ),
        // A SYNC that was not heard: its own stamp.
        (
            &[(10.0, 0), (10.5, 1), (20.5, 2)],
            &[(1, 10.0), (2, 20.5)],
            0,
        ),
    ];
    for (frames, right, unpaired) in cases {
        let mut device = at(
            "canopen_encoder",
            "counts_per_turn = 4\nsync = 1",
            1,
            Mode::Listen,
        );
        let to_frame = |(ms, number): &(f64, u8)| match number {
            0 => frame("080#", *ms),
            number => frame(&format!("181#{number:02X}000000"), *ms),
        };
        let frames: Vec<Frame> = frames.iter().map(to_frame).collect();
        let (readings, faults) = decode(&mut *device, &frames);
        let read = |stamped: &StampedReading| {
            let number = joint(&stamped.reading).position * 4.0 / TAU;
            (number.round() as u32, stamped.acquired.0 as f64 / 1e6)
        };
        let read: Vec<(u32, f64)> = readings.iter().map(read).collect();
        assert_eq!(read, *right);
        assert_eq!(count(&faults, Counter::Unpaired), *unpaired);
        let gaps = readings
            .iter()
            .filter(|r| r.quality.contains(Quality::GAP_BEFORE));
        assert_eq!(gaps.count(), usize::from(*unpaired > 0));
    }
}

/// A node without the optional objects: 6000 and 1017 refused, 6200 instead of the timer.
#[test]
fn what_an_encoder_lacks_is_left_out_or_replaced() {
    let mut device = at("canopen_encoder", "", 1, Mode::Supervise);
    let mut sent = Vec::new();
    let mut out = Decoded::new();
    for ms in 0..50 {
        let now = Nanos::from_millis(ms);
        while let Some(transmit) = device.poll_transmit(now, &mut out) {
            let text = transmit.frame.to_string();
            device.on_sent(&transmit.frame, Ok(now));
            let object = text.get(6..12).unwrap_or("").to_owned();
            let answer = match object.as_str() {
                "" => None,
                "001000" => Some("4300100096010100".to_owned()),
                "016500" => Some("4301650000200000".to_owned()),
                "006000" | "171000" | "001805" => Some(format!("80{object}00000206")),
                _ => Some(format!("60{object}00000000")),
            };
            sent.push(text);
            if let Some(answer) = answer {
                device.on_frame(&frame(&format!("581#{answer}"), ms as f64), &mut out);
            }
        }
    }
    assert!(
        sent.contains(&"601#2B0062000A000000".to_owned()),
        "{sent:?}"
    );
    assert_eq!(sent.last().unwrap(), "000#0101");
    device.on_frame(&frame("181#00100000", 60.0), &mut out);
    let reading = out.readings.last().unwrap();
    assert!(near(
        joint(&reading.reading).position,
        4096.0 * TAU / 8192.0
    ));
}

/// The state after each of `answers` in turn to the questions of the start.
fn refused(driver: &str, answers: impl Fn(&str) -> String) -> State {
    let mut device = at(driver, "", 1, Mode::Supervise);
    let mut out = Decoded::new();
    for ms in 0..400 {
        let now = Nanos::from_millis(ms);
        while let Some(transmit) = device.poll_transmit(now, &mut out) {
            let text = transmit.frame.to_string();
            device.on_sent(&transmit.frame, Ok(now));
            let answer = answers(text.get(6..12).unwrap_or(""));
            if !answer.is_empty() {
                device.on_frame(&frame(&format!("581#{answer}"), ms as f64), &mut out);
            }
        }
        out.clear();
    }
    device.state()
}

#[test]
fn nodes_that_cannot_be_used_are_refused_by_name() {
    let state = |refusal| State::Refused(refusal);
    for driver in ["canopen_encoder", "canopen_drive"] {
        let silent = refused(driver, |_| String::new());
        assert_eq!(silent, state(Refusal::NoAnswer));
        let other = refused(driver, |_| "4300100091010000".to_owned());
        assert_eq!(other, state(Refusal::OtherDevice { profile: 401 }));
        let rejected = refused(driver, |_| "8000100000000206".to_owned());
        assert_eq!(rejected, state(Refusal::Rejected { object: 0x1000 }));
    }
    let nothing = refused("canopen_encoder", |object| match object {
        "001000" => "4300100096010100".to_owned(),
        "016500" => "4301650000000000".to_owned(),
        object => format!("80{object}00000206"),
    });
    assert_eq!(nothing, state(Refusal::BadCalibration { channel: 0 }));
    let unmapped = refused("canopen_drive", |object| match object {
        "001000" => "4300100092010200".to_owned(),
        "8F6001" | "8F6002" => format!("43{object}01000000"),
        object => format!("80{object}00000206"),
    });
    assert_eq!(unmapped, state(Refusal::NotMapped));
    let unscaled = refused("canopen_drive", |object| match object {
        "001000" => "4300100092010200".to_owned(),
        object => format!("80{object}00000206"),
    });
    assert_eq!(unscaled, state(Refusal::Rejected { object: 0x608F }));
}

const PAIR: &str = "counts_per_turn = 4\nvelocity_unit = \"rpm\"\nhold_ms = 50.0\n";

fn pair(sync: u8) -> Box<dyn Device> {
    let keys = format!(
        "{PAIR}pdos = [{{ number = 1, objects = [0x6064], sync = {sync} }}, \
         {{ number = 3, objects = [0x606C], sync = {sync} }}]"
    );
    listener("canopen_drive", &keys, &[0])
}

/// Boot-up, a state that is not operational, and silence each start a node again.
#[test]
fn a_node_that_boots_or_stops_is_started_again() {
    for heartbeat in ["701#00", "701#7F", "701#04", "701#FF"] {
        let mut rig = Rig::new("canopen_encoder", "", &[0], (0, Reading::Joint(STATE)));
        rig.run(100);
        let (sent, read) = (rig.sent.len(), rig.readings.len());
        let mut out = Decoded::new();
        rig.device.on_frame(&frame("701#05", 1100.0), &mut out);
        rig.device.on_frame(&frame("701#85", 1100.0), &mut out);
        rig.run(20);
        assert_eq!(rig.sent.len(), sent, "operational");
        rig.device.on_frame(&frame(heartbeat, 1120.0), &mut out);
        rig.run(50);
        assert_eq!(rig.sent.len(), 2 * sent, "{heartbeat}");
        let gaps = rig.readings[read..].iter();
        let gaps = gaps.filter(|r| r.quality.contains(Quality::GAP_BEFORE));
        assert_eq!(gaps.count(), 1);
        assert_eq!(rig.count(Counter::Starts), 2);
        rig.device.on_frame(&frame("701#0500", 1120.0), &mut out);
        assert_eq!(count(&out.faults, Counter::Length), 1);
    }
}

#[test]
fn emergencies_are_faults_until_they_are_over() {
    let keys = "counts_per_turn = 4";
    let mut encoder = listener("canopen_encoder", keys, &[0]);
    let mut drive = pair(0);
    let position = |ms| frame("181#01000000", ms);
    for (code, encoder_fault, sensor, any) in [
        ("0000", false, false, false),
        ("1023", true, false, true),
        ("0573", true, true, true),
        ("0073", true, true, true),
        ("0074", true, false, true),
        ("0000", false, false, false),
    ] {
        let frames = [
            frame(&format!("081#{code}000000000000"), 1.0),
            position(2.0),
        ];
        let (readings, faults) = decode(&mut *encoder, &frames);
        let quality = readings[0].quality;
        assert_eq!(
            quality.contains(Quality::DEVICE_FAULT),
            encoder_fault,
            "{code}"
        );
        assert_eq!(
            count(&faults, Counter::DeviceFault),
            u32::from(encoder_fault)
        );
        let (readings, faults) = decode(&mut *drive, &frames);
        let quality = readings[0].quality;
        assert_eq!(quality.contains(Quality::DEVICE_FAULT), sensor, "{code}");
        assert_eq!(quality.contains(Quality::DRIVE_FAULT), any, "{code}");
        assert_eq!(count(&faults, Counter::DeviceFault), u32::from(sensor));
        assert_eq!(count(&faults, Counter::DriveFault), u32::from(any));
    }
    let boots = [
        frame("081#1023000000000000", 1.0),
        frame("701#00", 2.0),
        position(3.0),
    ];
    let (readings, _) = decode(&mut *encoder, &boots);
    assert!(
        !readings[0].quality.contains(Quality::DEVICE_FAULT),
        "booted"
    );
    let (_, faults) = decode(
        &mut *encoder,
        &[frame("081#1023", 1.0), frame("581#80", 2.0)],
    );
    assert_eq!(count(&faults, Counter::Length), 2);
}

/// The stamp and its kind are those of the SYNC.
#[test]
fn a_reading_has_the_stamp_of_its_sync() {
    let mut device = at(
        "canopen_encoder",
        "sync = 1\ncounts_per_turn = 100",
        9,
        Mode::Listen,
    );
    let sync = frame("080#", 7.0);
    let sync = sync.at(sync.t, StampKind::Hardware);
    let (readings, _) = decode(&mut *device, &[sync, frame("189#19000000", 7.3)]);
    assert_eq!(
        (readings[0].acquired, readings[0].stamp),
        (sync.t, StampKind::Hardware)
    );
    assert!(near(joint(&readings[0].reading).position, TAU / 4.0));
}

/// What another program writes, and the drive refuses, changes nothing; nor does an answer to
/// another question.
#[test]
fn a_write_that_is_refused_changes_nothing() {
    let (frames, _) = session("drive");
    let reads = |more: &[&str]| {
        let mut device = at("canopen_drive", "", 5, Mode::Listen);
        let mut mine = claimed(&*device, &frames);
        let answers = mine.iter().rposition(|f| f.id.raw() == 0x585).unwrap() + 1;
        let after: Vec<Frame> = mine.split_off(answers);
        decode(&mut *device, &mine);
        let more: Vec<Frame> = more.iter().map(|text| frame(text, 90.0)).collect();
        decode(&mut *device, &more);
        decode(&mut *device, &after).0.len()
    };
    let all = reads(&[]);
    assert!(all > 0);
    // The mapping of TPDO 1, emptied: refused, confirmed, and refused to another question.
    let write = "605#2F001A0000000000";
    assert_eq!(reads(&[write, "585#80001A0021000108"]), all);
    assert_eq!(reads(&[write, "585#60001A0000000000"]), 0);
    assert_eq!(reads(&[write, "585#80FFFF0021000108"]), all);
    // The number that it is, in one byte of four.
    assert_eq!(
        reads(&["605#2F001A0003FFFFFF", "585#60001A0000000000"]),
        all
    );
}

#[test]
fn the_sync_is_sent_in_step() {
    let mut device = at_zero("period_ms = 2.5", Mode::Supervise);
    let mut times = Vec::new();
    let mut out = Decoded::new();
    let mut now = Nanos::ZERO;
    while now < Nanos::from_millis(100) {
        while let Some(transmit) = device.poll_transmit(now, &mut out) {
            assert_eq!(transmit.frame.to_string(), "080#");
            device.on_sent(&transmit.frame, Ok(now));
            times.push(now.0);
        }
        now += Nanos::from_micros(500);
        if now == Nanos::from_millis(50) {
            // The host sleeps for 21 ms: what was missed is not made up for.
            now = Nanos::from_millis(71);
        }
    }
    let steps: Vec<i64> = times.windows(2).map(|w| w[1] - w[0]).collect();
    // The late one, and the next.
    let late: Vec<i64> = steps.into_iter().filter(|s| *s != 2_500_000).collect();
    assert_eq!(late, [23_500_000, 1_500_000]);
    // Before and after, in step with the first.
    let phases = times.iter().map(|t| t % 2_500_000);
    assert_eq!(phases.filter(|phase| *phase != 0).count(), 1, "{times:?}");
    assert_eq!(device.state(), State::Streaming);
    device.stop(now);
    assert!(device.poll_transmit(now, &mut out).is_none());
    let mut quiet = at_zero("", Mode::Listen);
    assert!(quiet.poll_transmit(now, &mut out).is_none());
    assert!(
        quiet
            .poll_transmit(now + Nanos::from_millis(50), &mut out)
            .is_none()
    );
    assert!(
        out.faults
            .iter()
            .all(|fault| fault.counter == Counter::Starts)
    );
    for wrong in ["period_ms = 0.4", "period_ms = 1001.0", "period_ms = 50.0"] {
        let refused = options("canopen_sync", wrong).device(&spec(0, Mode::Listen, &[]));
        assert!(refused.is_err());
    }
}

fn at_zero(keys: &str, mode: Mode) -> Box<dyn Device> {
    options("canopen_sync", keys)
        .device(&spec(0, mode, &[]))
        .unwrap()
}

#[test]
fn wrong_keys_are_refused() {
    let refused = |driver: &str, node, keys: &str| {
        let device = options(driver, keys).device(&spec(node, Mode::Listen, &[0]));
        device.map(|_| ()).unwrap_err()
    };
    for driver in ["canopen_encoder", "canopen_drive"] {
        for node in [0, 128] {
            let (least, most, address) = (1, 127, node);
            let range = SpecError::Address {
                address,
                least,
                most,
            };
            assert_eq!(refused(driver, node, ""), range);
        }
        for keys in [
            "counts_per_turn = 0",
            "counts_per_turn = inf",
            "period_ms = 0",
            "sync = 241",
        ] {
            assert!(
                matches!(refused(driver, 1, keys), SpecError::Key { .. }),
                "{keys}"
            );
        }
    }
    for keys in ["rated_torque = -1", "rated_current = 0", "hold_ms = -1.0"] {
        assert!(
            matches!(refused("canopen_drive", 1, keys), SpecError::Key { .. }),
            "{keys}"
        );
    }
    for pdos in [
        "{ number = 5, objects = [0x6064] }",
        "{ number = 0, objects = [0x6064] }",
        "{ number = 1, objects = [0x606C] }",
        "{ number = 1, objects = [] }",
        "{ number = 1, objects = [0x1234, 0x6064] }",
        "{ number = 1, objects = [0x6064, 0x606C, 0x6061] }",
        "{ number = 1, objects = [0x6064], sync = 241 }",
        "{ number = 1, objects = [0x6064] }, { number = 1, objects = [0x606C] }",
        // Another device's, or the node's own answers and its commands, or twice the same.
        "{ number = 1, objects = [0x6064], id = 0x180 }",
        "{ number = 1, objects = [0x6064], id = 0x581 }",
        "{ number = 1, objects = [0x6064], id = 0x601 }",
        "{ number = 1, objects = [0x6064], id = 0x6E0 }",
        "{ number = 1, objects = [0x6064] }, { number = 2, objects = [0x606C], id = 0x181 }",
    ] {
        let keys = format!("pdos = [{pdos}]");
        assert!(
            matches!(
                refused("canopen_drive", 1, &keys),
                SpecError::Keys { key: "pdos", .. }
            ),
            "{pdos}"
        );
    }
}

/// What the node's server does with wrong requests.
#[test]
fn a_simulated_node_refuses_as_the_standard_says() {
    let mut node = board("canopen_encoder", "", &[0]);
    let mut ask = |text: &str| {
        let mut out = Frames::new();
        node.on_frame(&frame(text, 0.0), &mut out);
        out.first().map(ToString::to_string)
    };
    let some = |text: &str| Some(text.to_owned());
    assert_eq!(ask("601#4000100000000000"), some("581#4300100096010200"));
    assert_eq!(ask("601#4019100000000000"), some("581#8019100000000206"));
    assert_eq!(ask("601#2319100000000000"), some("581#8019100000000206"));
    // Its identity: how many entries, and the serial number.
    assert_eq!(ask("601#4018100000000000"), some("581#4F18100004000000"));
    assert_eq!(ask("601#4018100400000000"), some("581#4318100401000000"));
    assert_eq!(ask("601#2F00180500000000"), some("581#8000180510000706"));
    assert_eq!(ask("601#E000100000000000"), some("581#8000100001000405"));
    assert_eq!(ask("601#2B001805E8030000"), some("581#6000180500000000"));
    assert_eq!(ask("601#4000180500000000"), some("581#4B001805E8030000"));
    assert_eq!(ask("000#8101"), some("701#00"));
    assert_eq!(ask("601#4000180500000000"), some("581#4B0018050A000000"));
    assert_eq!((ask("602#4000100000000000"), ask("000#8102")), (None, None));
}

proptest! {
    #[test]
    fn joints_are_read_back(
        position in -1e5_f64..1e5, velocity in -1e4_f64..1e4, torque in -1.9_f64..1.9,
        current in -9.0_f64..9.0, faulty: bool,
    ) {
        let state = JointState { position, velocity, torque, current, ..JointState::ABSENT };
        let keys = "counts_per_turn = 4096\nrated_torque = 1.0\nrated_current = 5.0\n\
                    pdos = [{ number = 1, objects = [0x6041, 0x6064, 0x6077], sync = 1 }, \
                    { number = 2, objects = [0x606C, 0x6078], sync = 1 }]";
        let quality = if faulty { Quality::DRIVE_FAULT } else { Quality::GOOD };
        let mut drive = board("canopen_drive", keys, &[0]);
        let frames = encode(&mut *drive, 0, &Reading::Joint(state), quality);
        let (readings, _) = decode(&mut *listener("canopen_drive", keys, &[0]), &frames);
        let read = joints(&readings);
        let back = joint(&read[0].reading);
        let half = TAU / 8192.0 * 1.0001;
        prop_assert!((back.position - position).abs() <= half);
        prop_assert!((back.velocity - velocity).abs() <= half);
        prop_assert!((back.torque - torque).abs() <= 0.5001e-3);
        prop_assert!((back.current - current).abs() <= 2.501e-3);
        prop_assert_eq!(read[0].quality.contains(Quality::DRIVE_FAULT), faulty);
    }

    #[test]
    fn angles_are_read_back(turns in 0.0_f64..500_000.0, faulty: bool) {
        let sent = Reading::Joint(JointState { position: turns * TAU, ..JointState::ABSENT });
        let keys = "counts_per_turn = 8192";
        let quality = if faulty { Quality::DEVICE_FAULT } else { Quality::GOOD };
        let started = spec(1, Mode::Listen, &[0]);
        let mut node = options("canopen_encoder", keys).board(&started).unwrap();
        let frames = encode(&mut *node, 0, &sent, quality);
        let (readings, _) = decode(&mut *listener("canopen_encoder", keys, &[0]), &frames);
        let back = joint(&readings[0].reading).position;
        prop_assert!((back - turns * TAU).abs() <= TAU / 8192.0 * 0.5001);
        prop_assert_eq!(readings[0].quality.contains(Quality::DEVICE_FAULT), faulty);
    }
}
