//! Drives of CiA 402: their mapping, scales, and the process data of one SYNC.

use super::{STATE, Synced, actuator, at, claimed, joints, near, pair, session};
use crate::rig::{Rig, board, count, decode, encode, frame, joint, listener, options, spec};
use proprio_drivers::objects::{ObjectEntry, Objects};
use proprio_drivers::{Decoded, Frame, Mode, StampedReading, State};
use proprio_topics::{Counter, Nanos, Quality, Reading, Refusal, StampKind};
use std::f64::consts::TAU;

/// A drive that sends all that it knows, by a timer or at each SYNC.
const FULL: &str = "pdos = [{ number = 1, objects = [0x6041, 0x6064, 0x6077] }, \
                    { number = 2, objects = [0x606C, 0x6078, 0x6061] }]";
const FULL_BY_SYNC: &str = "pdos = [{ number = 1, objects = [0x6041, 0x6064, 0x6077], sync = 1 }, \
                            { number = 2, objects = [0x606C, 0x6078, 0x6061], sync = 1 }]";

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
    for stamped in &read[1..] {
        let state = joint(&stamped.reading);
        assert!((state.position - 1.5).abs() < TAU / 8192.0);
        assert!((state.velocity + 2.0).abs() < TAU / 8192.0);
        assert!((state.torque - 0.25).abs() < 0.5e-3 && (state.current - 1.1).abs() < 2.6e-3);
        assert_eq!(stamped.quality, Quality::GOOD);
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

fn both(n: u8, ms: f64) -> [Frame; 3] {
    [
        frame("080#", ms),
        frame(&format!("181#{n:02X}000000"), ms + 0.3),
        frame(&format!("381#{n:02X}000000"), ms + 0.6),
    ]
}

/// Number, time and gap of each reading; its two values must be of the same cycle.
fn cycles(readings: &[StampedReading]) -> Vec<(i32, f64, bool)> {
    let one = |stamped: &StampedReading| {
        let state = joint(&stamped.reading);
        let number = state.position * 4.0 / TAU;
        assert!(
            near(state.velocity * 60.0 / TAU, number),
            "two cycles: {state:?}"
        );
        let gap = stamped.quality.contains(Quality::GAP_BEFORE);
        (number.round() as i32, stamped.acquired.0 as f64 / 1e6, gap)
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
    for stamped in &read {
        assert_eq!(stamped.acquired.0 % 5_000_000, 0);
        let state = joint(&stamped.reading);
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
        let state = joint(&readings[0].reading);
        assert!(
            near(state.position, TAU / 4.0) && near(state.torque, 0.25),
            "{state:?}"
        );
        assert!(near(state.current, 4.0), "{state:?}");
        let right = [
            "001000", "A86000", "8F6001", "8F6002", "181001", "766000", "756000", "806000",
        ];
        assert_eq!(asked, right);
    }
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
