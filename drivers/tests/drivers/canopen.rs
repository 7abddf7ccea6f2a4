//! CANopen encoders, drives and SYNC: a session of nodes and a master of another implementation,
//! start-up against the boards, cycles of SYNC, and what nodes say of themselves.

use crate::rig::{Rig, board, count, decode, encode, frame, listener, options, spec};
use proprio_drivers::objects::{ObjectEntry, Objects};
use proprio_drivers::{Board, Decoded, Device, Frame, Frames, Mode, Output, SpecError, State};
use proprio_topics::{Actuator, Counter, JointState, Nanos, Quality, Reading, Refusal, StampKind};
use proptest::prelude::*;
use std::f64::consts::TAU;

/// A session, `tests/oracle/frames/canopen_session.py`: a frame a millisecond.
const SESSION: &str = include_str!("canopen.txt");

fn joint(reading: &Reading) -> JointState {
    match reading {
        Reading::Joint(joint) => *joint,
        other => panic!("{other:?}"),
    }
}

fn actuator(reading: &Reading) -> Actuator {
    match reading {
        Reading::Actuator(actuator) => *actuator,
        other => panic!("{other:?}"),
    }
}

fn joints(readings: &[Output]) -> Vec<Output> {
    let is_joint = |output: &&Output| matches!(output.reading, Reading::Joint(_));
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
    for (output, raw) in joints.iter().zip(&truth) {
        let read = joint(&output.reading);
        assert!(near(read.position, raw[0] * TAU / 10_000.0), "{read:?}");
        assert!(near(read.velocity, raw[1] * 0.1 * TAU / 60.0), "{read:?}");
        assert!(near(read.torque, raw[2] * 0.88e-3), "{read:?}");
        assert!(near(read.current, raw[3] * 4.3e-3), "{read:?}");
        let sync = frames
            .iter()
            .rfind(|f| f.id.raw() == 0x80 && f.t <= output.acquired);
        assert_eq!(output.acquired, sync.unwrap().t, "measured at its SYNC");
    }
    let fault = |output: &Output| output.quality.contains(Quality::DRIVE_FAULT);
    assert_eq!(
        joints.iter().map(fault).collect::<Vec<_>>(),
        [false, false, false, true, true, false]
    );
    let states: Vec<Actuator> = (readings.iter())
        .filter(|output| matches!(output.reading, Reading::Actuator(_)))
        .map(|output| actuator(&output.reading))
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
    for (output, raw) in readings.iter().zip(&truth) {
        // It is scaled: object 6001, not 6501.
        let position = joint(&output.reading).position;
        assert!(near(position, raw[0] * TAU / 3600.0), "{position}");
        assert!(
            frames
                .iter()
                .any(|f| f.id.raw() == 0x80 && f.t == output.acquired)
        );
    }
    let fault = |output: &Output| output.quality.contains(Quality::DEVICE_FAULT);
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
    readings: Vec<Output>,
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

/// A drive that sends all that it knows, by a timer or at each SYNC.
const FULL: &str = "pdos = [{ number = 1, objects = [0x6041, 0x6064, 0x6077] }, \
                    { number = 2, objects = [0x606C, 0x6078, 0x6061] }]";
const FULL_BY_SYNC: &str = "pdos = [{ number = 1, objects = [0x6041, 0x6064, 0x6077], sync = 1 }, \
                            { number = 2, objects = [0x606C, 0x6078, 0x6061], sync = 1 }]";

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
    for output in &rig.readings {
        assert!((joint(&output.reading).position - 1.5).abs() < TAU / 16384.0);
        assert_eq!(output.quality, Quality::GOOD);
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
    for output in &synced.readings {
        assert_eq!(output.acquired.0 % 5_000_000, 0, "the time of a SYNC");
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
        let read = |output: &Output| {
            let number = joint(&output.reading).position * 4.0 / TAU;
            (number.round() as u32, output.acquired.0 as f64 / 1e6)
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

/// While it is refused, a node is asked again; once somebody has set it up, it is used.
#[test]
fn a_drive_that_is_set_up_later_is_used() {
    let (unmapped, mapped) = (
        "pdos = [{ number = 1, objects = [0x6041, 0x6064] }]",
        "counts_per_turn = 4096",
    );
    let mut rig = Rig::with_board(
        "canopen_drive",
        mapped,
        FULL,
        &[0],
        (0, Reading::Joint(STATE)),
    );
    rig.board_loses = Box::new(|_, frame| frame.to_string().starts_with("581#43001A"));
    rig.run(400);
    assert_eq!(rig.device.state(), State::Refused(Refusal::NoAnswer));
    rig.board_loses = Box::new(|_, _| false);
    rig.run(1500);
    assert_eq!(rig.device.state(), State::Streaming);
    let state = joint(&joints(&rig.readings)[1].reading);
    assert!((state.torque - 0.25).abs() < 1e-3 && (state.velocity + 2.0).abs() < 2e-3);

    let mut rig = Rig::with_board(
        "canopen_drive",
        "",
        unmapped,
        &[0],
        (0, Reading::Joint(STATE)),
    );
    rig.run(300);
    assert_eq!(rig.device.state(), State::Streaming);
    let state = joint(&joints(&rig.readings)[0].reading);
    assert!(state.torque.is_nan() && state.velocity.is_nan() && state.current.is_nan());
    assert!((state.position - 1.5).abs() < 1e-3);
    assert!(!rig.sent.iter().any(|f| f.contains("6076")), "not needed");
}

/// With `configure` a drive that nobody has set up is set to the keys: by its timer, and by SYNC.
#[test]
fn a_drive_is_configured_as_the_keys_say() {
    let torque = "pdos = [{ number = 2, objects = [0x6064, 0x6077], sync = 1 }]";
    for (keys, mapping) in [
        (
            "",
            &[
                "601#2300180181010 0C0",
                "601#2F001A0000000000",
                "601#23001A0110004160",
                "601#23001A0220006460",
                "601#23001A0308006160",
                "601#2F001A0003000000",
                "601#2F001802FF000000",
                "601#2B00180505000000",
                "601#2300180181010040",
                "601#2301180181020 0C0",
                "601#2F011A0000000000",
                "601#23011A0120006C60",
                "601#2F011A0001000000",
                "601#2F011802FF000000",
                "601#2B01180505000000",
                "601#2301180181020040",
            ][..],
        ),
        (
            torque,
            &[
                "601#2301180181020 0C0",
                "601#2F011A0000000000",
                "601#23011A0120006460",
                "601#23011A0210007760",
                "601#2F011A0002000000",
                "601#2F01180201000000",
                "601#2301180181020040",
            ],
        ),
    ] {
        let keys = format!("period_ms = 5\nconfigure = true\n{keys}");
        let mut rig = Rig::with_board(
            "canopen_drive",
            &keys,
            &keys,
            &[0],
            (0, Reading::Joint(STATE)),
        );
        rig.run(100);
        assert_eq!(rig.sent[0], "000#8001");
        let written: Vec<&String> = rig.sent.iter().filter(|f| f.starts_with("601#2")).collect();
        let right: Vec<String> = mapping.iter().map(|text| text.replace(' ', "")).collect();
        assert_eq!(written, right.iter().collect::<Vec<_>>());
        assert!(
            !rig.sent.iter().any(|f| f.starts_with("601#40001A")),
            "its mapping is known"
        );
        assert_eq!(rig.sent.last().unwrap(), "000#0101");
        if keys.contains("sync") {
            continue;
        }
        assert_eq!(rig.device.state(), State::Streaming);
        let read = joints(&rig.readings);
        assert!((12..=20).contains(&read.len()), "{}", read.len());
        assert!((joint(&read[3].reading).position - 1.5).abs() < TAU / 4096.0);
        assert!((joint(&read[3].reading).velocity + 2.0).abs() < TAU / 4096.0);
    }
    // What a drive does not take is told.
    let mut device = at("canopen_drive", "configure = true", 1, Mode::Supervise);
    let mut out = Decoded::new();
    for ms in 0..100 {
        let now = Nanos::from_millis(ms);
        while let Some(transmit) = device.poll_transmit(now, &mut out) {
            let text = transmit.frame.to_string();
            device.on_sent(&transmit.frame, Ok(now));
            let object = text.get(6..12).unwrap_or("").to_owned();
            let answer = match object.as_str() {
                "" => continue,
                "001000" => "4300100092010200".to_owned(),
                "001805" => format!("80{object}00000206"),
                _ => format!("60{object}00000000"),
            };
            device.on_frame(&frame(&format!("581#{answer}"), ms as f64), &mut out);
        }
        out.clear();
    }
    let refusal = Refusal::Rejected { object: 0x1800 };
    assert_eq!(device.state(), State::Refused(refusal));
    // Nothing is written where another program commands the drive.
    let listener = at(
        "canopen_drive",
        "configure = true\ncounts_per_turn = 4",
        1,
        Mode::Listen,
    );
    let mut listener = listener;
    let (readings, _) = decode(&mut *listener, &[frame("181#27060100000000", 1.0)]);
    assert!(near(
        joint(&joints(&readings)[0].reading).position,
        TAU / 4.0
    ));
}

#[test]
fn a_drive_is_asked_for_its_mapping_and_started() {
    let mut rig = Rig::with_board("canopen_drive", "", FULL, &[0], (0, Reading::Joint(STATE)));
    rig.run(100);
    let sent = &rig.sent;
    assert_eq!(sent[0], "601#4000100000000000");
    assert_eq!(sent[1], "601#4000180100000000");
    assert_eq!(sent[2], "601#4000180200000000");
    assert_eq!(sent[3], "601#40001A0000000000");
    assert_eq!(sent[4], "601#40001A0100000000");
    assert!(sent.contains(&"601#40001A0300000000".to_owned()));
    assert!(
        !sent.contains(&"601#40001A0400000000".to_owned()),
        "three objects"
    );
    assert!(
        !sent.contains(&"601#40021A0000000000".to_owned()),
        "it is off"
    );
    let end = [
        "601#40A8600000000000",
        "601#408F600100000000",
        "601#408F600200000000",
        "601#40A9600000000000",
        "601#4018100100000000",
        "601#4076600000000000",
        "601#4075600000000000",
        "601#4080600000000000",
        "000#0101",
    ];
    assert_eq!(sent[sent.len() - end.len()..], end);
    assert!(
        !sent.iter().any(|f| f.starts_with("601#2")),
        "nothing is written"
    );
    let read = joints(&rig.readings);
    assert!((9..=10).contains(&read.len()));
    // By a timer: the first reading is made before the other process data have come.
    for output in &read[1..] {
        let state = joint(&output.reading);
        assert!((state.position - 1.5).abs() < TAU / 8192.0);
        assert!((state.velocity + 2.0).abs() < TAU / 8192.0);
        assert!((state.torque - 0.25).abs() < 0.5e-3 && (state.current - 1.1).abs() < 2.6e-3);
        assert_eq!(output.quality, Quality::GOOD);
    }
    assert!(joint(&read[0].reading).velocity.is_nan());
    let plain = encode(
        &mut *board("canopen_drive", "", &[0]),
        0,
        &Reading::Joint(STATE),
        Quality::GOOD,
    );
    let lengths: Vec<usize> = plain.iter().map(|frame| frame.data().len()).collect();
    assert_eq!(lengths, [7, 4], "without the keys: no torque");
    let count = sent.len();
    rig.device.stop(rig.now);
    rig.run(30);
    assert_eq!(
        (rig.device.state(), rig.sent.len()),
        (State::Stopped, count)
    );
}

#[test]
fn what_the_keys_tell_a_drive_is_not_asked() {
    let keys = "counts_per_turn = 100\nrated_torque = 2.0\ncurrent_unit = \"mA\"\n\
                pdos = [{ number = 1, objects = [0x6064, 0x6077, 0x6078] }]";
    let mut rig = Rig::new("canopen_drive", keys, &[0], (0, Reading::Joint(STATE)));
    rig.run(30);
    assert_eq!(rig.sent, ["601#4000100000000000", "000#0101"]);
    let state = joint(&rig.readings[0].reading);
    assert!((state.position - 1.5).abs() < TAU / 200.0);
    assert!((state.torque - 0.25).abs() < 1.1e-3 && (state.current - 1.1).abs() < 0.6e-3);
    let mut listens = listener("canopen_drive", keys, &[0]);
    let (readings, _) = decode(&mut *listens, &[frame("181#19000000F401FAFF", 1.0)]);
    let state = joint(&readings[0].reading);
    assert!(near(state.position, TAU / 4.0) && near(state.torque, 1.0));
    assert!(near(state.current, -6e-3));
    let (readings, faults) = decode(&mut *listens, &[frame("181#19000000F401FA", 2.0)]);
    assert!(readings.is_empty() && count(&faults, Counter::Length) == 1);
}

const PAIR: &str = "counts_per_turn = 4\nvelocity_unit = \"rpm\"\nhold_ms = 50.0\n";

fn pair(sync: u8) -> Box<dyn Device> {
    let keys = format!(
        "{PAIR}pdos = [{{ number = 1, objects = [0x6064], sync = {sync} }}, \
         {{ number = 3, objects = [0x606C], sync = {sync} }}]"
    );
    listener("canopen_drive", &keys, &[0])
}

fn both(n: u8, ms: f64) -> [Frame; 3] {
    [
        frame("080#", ms),
        frame(&format!("181#{n:02X}000000"), ms + 0.3),
        frame(&format!("381#{n:02X}000000"), ms + 0.6),
    ]
}

/// Number, time and gap of each reading; its two values must be of the same cycle.
fn cycles(readings: &[Output]) -> Vec<(i32, f64, bool)> {
    let one = |output: &Output| {
        let state = joint(&output.reading);
        let number = state.position * 4.0 / TAU;
        assert!(
            near(state.velocity * 60.0 / TAU, number),
            "two cycles: {state:?}"
        );
        let gap = output.quality.contains(Quality::GAP_BEFORE);
        (number.round() as i32, output.acquired.0 as f64 / 1e6, gap)
    };
    readings.iter().map(one).collect()
}

#[test]
fn the_process_data_of_one_sync_are_one_reading() {
    let frames: Vec<Frame> = (1..=4).flat_map(|n| both(n, f64::from(n) * 10.0)).collect();
    let (readings, faults) = decode(&mut *pair(1), &frames);
    assert!(faults.is_empty());
    let read = [
        (1, 10.0, false),
        (2, 20.0, false),
        (3, 30.0, false),
        (4, 40.0, false),
    ];
    assert_eq!(cycles(&readings), read);
    // In the other order, too.
    let swap = |c: &[Frame]| {
        [
            c[0],
            c[2].at(c[1].t, c[1].stamp),
            c[1].at(c[2].t, c[2].stamp),
        ]
    };
    let swapped: Vec<Frame> = frames.chunks(3).flat_map(swap).collect();
    assert_eq!(cycles(&decode(&mut *pair(1), &swapped).0), read);
    // Halves of two cycles between which two frames and a SYNC are lost: too long apart.
    let apart = [frames[0], frames[1], frame("381#01000000", 71.0)];
    let (readings, faults) = decode(&mut *pair(1), &apart);
    assert!(readings.is_empty() && count(&faults, Counter::Unpaired) == 1);
    // Without SYNC a repeated frame begins the next; the stamp is that of the first frame.
    let unsynced: Vec<Frame> = frames
        .iter()
        .filter(|f| f.id.raw() != 0x80)
        .copied()
        .collect();
    let (readings, _) = decode(&mut *pair(1), &unsynced);
    assert_eq!(cycles(&readings)[1], (2, 20.3, false));
}

#[test]
fn lost_and_late_process_data_never_mix_two_cycles() {
    let frames: Vec<Frame> = (1..=8).flat_map(|n| both(n, f64::from(n) * 10.0)).collect();
    for lost in 3..18 {
        let mut some = frames.clone();
        let gone = some.remove(lost);
        let (readings, faults) = decode(&mut *pair(1), &some);
        let read = cycles(&readings);
        if gone.id.raw() == 0x80 {
            assert_eq!(read.len(), 8, "{lost}");
        } else {
            assert_eq!(read.len(), 6, "{lost}: {read:?}");
            assert_eq!(count(&faults, Counter::Unpaired), 2);
            assert_eq!(read.iter().filter(|r| r.2).count(), 1);
        }
        // The same frame, after the next SYNC, and after the next of its own.
        for (place, least) in [(lost + 3 - lost % 3, 5), (lost + 3, 5)] {
            let mut late = some.clone();
            late.insert(place.min(late.len()), gone);
            if gone.id.raw() != 0x80 {
                let (readings, _) = decode(&mut *pair(1), &late);
                assert!(cycles(&readings).len() >= least, "{lost} {place}");
            }
        }
    }
}

/// An adapter gives each frame twice, also of a joint that stands still: nothing changes but the
/// count.
#[test]
fn process_data_that_come_twice_are_counted_once() {
    for moves in [1, 0] {
        let frames: Vec<Frame> = (1..=6)
            .flat_map(|n| both(5 + moves * n, f64::from(n) * 10.0))
            .collect();
        let twice = |f: &Frame| [*f, f.at(f.t + Nanos::from_micros(100), f.stamp)];
        let doubled: Vec<Frame> = (frames.iter().filter(|f| f.id.raw() != 0x80))
            .flat_map(twice)
            .chain(frames.iter().filter(|f| f.id.raw() == 0x80).copied())
            .collect();
        let mut doubled = doubled;
        doubled.sort_by_key(|f| f.t);
        let (once, _) = decode(&mut *pair(1), &frames);
        let (readings, faults) = decode(&mut *pair(1), &doubled);
        assert_eq!(cycles(&readings), cycles(&once));
        assert_eq!(readings.len(), 6);
        assert_eq!(count(&faults, Counter::Unexpected), 12);
        assert_eq!(count(&faults, Counter::Unpaired), 0);
    }
}

#[test]
fn values_of_other_events_are_held_for_a_time() {
    let mut device = pair(0);
    let frames = [
        frame("381#05000000", 0.0),
        frame("181#05000000", 50.0),
        frame("080#", 50.1),
        frame("181#05000000", 50.2),
        frame("381#06000000", 60.0),
        frame("181#06000000", 70.0),
    ];
    let (readings, faults) = decode(&mut *device, &frames);
    assert!(faults.is_empty());
    let velocity = |at: usize| joint(&readings[at].reading).velocity;
    assert!(near(velocity(0), 5.0 * TAU / 60.0) && near(velocity(2), 6.0 * TAU / 60.0));
    assert!(velocity(1).is_nan(), "50.2 ms old");
    assert_eq!(readings[2].acquired, frames[5].t);
}

#[test]
fn a_drive_measures_by_sync_of_the_host() {
    let mut synced = Synced::new("canopen_drive", "", FULL_BY_SYNC, Reading::Joint(STATE));
    synced.run(200);
    let read = joints(&synced.readings);
    assert!(read.len() >= 34, "{}", read.len());
    for output in &read {
        assert_eq!(output.acquired.0 % 5_000_000, 0);
        let state = joint(&output.reading);
        assert!((state.velocity + 2.0).abs() < 2e-3 && (state.torque - 0.25).abs() < 1e-3);
    }
    // A frame in twenty is lost: then two cycles.
    let before = read.len();
    synced.loses = |n| n % 20 == 0;
    synced.run(500);
    let more = joints(&synced.readings).len() - before;
    assert!((78..=82).contains(&more), "{more}");
    assert_eq!(synced.device.state(), State::Streaming);
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

#[test]
fn the_status_word_is_told_and_judged() {
    let keys = "counts_per_turn = 4\npdos = [{ number = 1, objects = [0x6041, 0x603F, 0x6064] }]";
    let mut drive = listener("canopen_drive", keys, &[0]);
    for (word, fault) in [("2706", false), ("0800", true), ("F7FF", false)] {
        let frames = [frame(&format!("181#{word}341201000000"), 1.0)];
        let (readings, faults) = decode(&mut *drive, &frames);
        let state = actuator(&readings[0].reading);
        assert_eq!(
            state.encoder,
            u32::from_str_radix(word, 16).unwrap().swap_bytes() >> 16
        );
        assert_eq!((state.faults, state.duty.is_nan()), (0x1234, true));
        assert_eq!(joint(&readings[1].reading).position, TAU / 4.0);
        assert_eq!(
            readings[1].quality.contains(Quality::DRIVE_FAULT),
            fault,
            "{word}"
        );
        assert_eq!(count(&faults, Counter::DriveFault), u32::from(fault));
    }
}

/// What a drive that is asked refuses to tell, its DCF file states; a default of an EDS file does
/// not count, as it is of some motor.
#[test]
fn scales_that_a_drive_does_not_tell_are_those_of_its_file() {
    let keys = "pdos = [{ number = 1, objects = [0x6064, 0x6077, 0x6078] }]";
    for own in [true, false] {
        let entry = |number| ObjectEntry {
            number,
            plus_node: false,
            own,
        };
        let stated = [
            ((0x608F, 1), entry(8192)),
            ((0x608F, 2), entry(2)),
            ((0x6076, 0), entry(500)),
            ((0x6075, 0), entry(4000)),
        ];
        let mut options = options("canopen_drive", keys);
        options.describe_objects(Objects {
            entries: stated.into_iter().collect(),
            ..Objects::default()
        });
        let spec = spec(5, Mode::Supervise, &[0]);
        let mut device = options.device(&spec).unwrap();
        let mut asked = Vec::new();
        for ms in 1000..1200 {
            let (now, mut out) = (Nanos::from_millis(ms), Decoded::new());
            while let Some(transmit) = device.poll_transmit(now, &mut out) {
                device.on_sent(&transmit.frame, Ok(now));
                let question = transmit.frame.to_string();
                let Some(object) = question.strip_prefix("605#40") else {
                    continue;
                };
                asked.push(object[..6].to_owned());
                let answer = match &object[..6] {
                    "001000" => "585#4300100092010200".to_owned(),
                    object => format!("585#80{object}00000206"),
                };
                let answer = frame(&answer, 0.0).at(now, StampKind::Software);
                device.on_frame(&answer, &mut out);
            }
        }
        let (readings, _) = decode(&mut *device, &[frame("185#00040000F401E803", 1200.0)]);
        if !own {
            let object = 0x608F;
            let refusal = Refusal::Rejected { object };
            assert_eq!(device.state(), State::Refused(refusal));
            assert!(readings.is_empty());
            continue;
        }
        // A quarter of the 4096 counts of a turn, half of 0.5 Nm, and all of 4 A.
        let told = joint(&readings[0].reading);
        assert!(
            near(told.position, TAU / 4.0) && near(told.torque, 0.25),
            "{told:?}"
        );
        assert!(near(told.current, 4.0), "{told:?}");
        let right = [
            "001000", "A86000", "8F6001", "8F6002", "181001", "766000", "756000", "806000",
        ];
        assert_eq!(asked, right);
    }
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

/// A drive that sends two TPDOs on one identifier is refused: no frame is read by the mapping of
/// another.
#[test]
fn identifiers_that_a_drive_tells_must_differ() {
    let (frames, _) = session("drive");
    let mut device = at("canopen_drive", "", 5, Mode::Listen);
    let mine = claimed(&*device, &frames);
    decode(&mut *device, &mine);
    assert_eq!(device.state(), State::Streaming);
    // Object 1801 sub 1: 0x40000185, which is TPDO 1.
    let then = [
        frame("585#4301180185010040", 200.0),
        frame("185#0ADE4291C54500", 201.0),
    ];
    let (readings, _) = decode(&mut *device, &then);
    assert_eq!(readings, []);
    let refusal = Refusal::OtherIdentifier { id: 0x185 };
    assert_eq!(device.state(), State::Refused(refusal));
}

#[test]
fn scales_that_change_are_refused() {
    let (frames, _) = session("drive");
    for answer in [
        "585#438F600121000000",
        "585#438F600203000000",
        "585#4376600001000000",
    ] {
        let mut device = at("canopen_drive", "", 5, Mode::Listen);
        let mine = claimed(&*device, &frames);
        decode(&mut *device, &mine);
        let (_, faults) = decode(&mut *device, &[frame(answer, 200.0)]);
        assert_eq!(count(&faults, Counter::Value), 1);
        assert_eq!(device.state(), State::Refused(Refusal::Changed), "{answer}");
    }
    // A key that states a scale counts before what is told.
    let answer = [frame("585#4376600001000000", 200.0)];
    let mut device = at("canopen_drive", "rated_torque = 0.25", 5, Mode::Listen);
    let mine = claimed(&*device, &frames);
    decode(&mut *device, &mine);
    let (_, faults) = decode(&mut *device, &answer);
    assert_eq!((faults.len(), device.state()), (0, State::Streaming));
    // Without the master's questions the mapping is not known.
    let mut device = at("canopen_drive", "", 5, Mode::Listen);
    let (readings, _) = decode(&mut *device, &[frame("185#0ADE4291C54500", 1.0)]);
    assert!(readings.is_empty());
    assert_eq!(device.state(), State::Refused(Refusal::NotMapped));
    let mut device = at("canopen_encoder", "", 5, Mode::Listen);
    decode(&mut *device, &[frame("185#0ADE4291", 1.0)]);
    assert_eq!(device.state(), State::Refused(Refusal::NoCalibration));
    let (readings, faults) = decode(&mut *device, &[frame("185#0ADE42", 1.0)]);
    assert!(readings.is_empty() && count(&faults, Counter::Length) == 1);
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
    let told = |text: &str| Some(text.to_owned());
    assert_eq!(ask("601#4000100000000000"), told("581#4300100096010200"));
    assert_eq!(ask("601#4019100000000000"), told("581#8019100000000206"));
    assert_eq!(ask("601#2319100000000000"), told("581#8019100000000206"));
    // Its identity: how many entries, and the serial number.
    assert_eq!(ask("601#4018100000000000"), told("581#4F18100004000000"));
    assert_eq!(ask("601#4018100400000000"), told("581#4318100401000000"));
    assert_eq!(ask("601#2F00180500000000"), told("581#8000180510000706"));
    assert_eq!(ask("601#E000100000000000"), told("581#8000100001000405"));
    assert_eq!(ask("601#2B001805E8030000"), told("581#6000180500000000"));
    assert_eq!(ask("601#4000180500000000"), told("581#4B001805E8030000"));
    assert_eq!(ask("000#8101"), told("701#00"));
    assert_eq!(ask("601#4000180500000000"), told("581#4B0018050A000000"));
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
