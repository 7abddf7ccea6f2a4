//! Robotous RFT and AIDIN AFT200 sensors: two frames without a sequence number for each reading.

use crate::rig::{
    Rig, board, count, decode, encode, frame, listener, options, reading, refused_at, shown_keys,
    spec, supervisor, texts, wrench,
};
use proprio_drivers::{
    Device, Format, Frame, Frames, Id, Mode, NotSent, SpecError, StampedReading, State,
};
use proprio_topics::{Counter, Nanos, Quality, Reading, Saturation, StampKind, Wrench};
use proptest::array::{uniform3, uniform6};
use proptest::prelude::*;

fn near(a: f64, b: f64, step: f64) -> bool {
    (a - b).abs() <= step * 0.5 + 1e-9
}

/// Halves of several readings: `F3` is the first half of reading 3, `S3` the second, at times in
/// ms. Returns the numbers of the readings and whether each follows a gap, and the number of halves
/// that were counted as unpaired.
fn paired(driver: &str, keys: &str, halves: &[(&str, f64)]) -> (Vec<(u16, bool)>, u32) {
    let frames: Vec<Frame> = halves
        .iter()
        .map(|(name, ms)| {
            let n: f64 = name[1..].parse().unwrap();
            let both = reading([n; 3], [n / 100.0; 3]);
            let both = encode(&mut *board(driver, keys, &[]), 0, &both, Quality::GOOD);
            let half = both[usize::from(name.starts_with('S'))];
            half.at(Nanos::from_seconds(ms * 1e-3), StampKind::Software)
        })
        .collect();
    let (readings, faults) = decode(&mut *listener(driver, keys, &[]), &frames);
    let counted = |stamped: &StampedReading| {
        let Wrench { force, torque } = wrench(&stamped.reading);
        let number = (torque[2] * 100.0).round();
        for k in 0..3 {
            assert!(near(force[k], number, 0.1), "halves of two: {stamped:?}");
            assert!(near(torque[k] * 100.0, number, 0.3), "{stamped:?}");
        }
        let gap = stamped.quality.contains(Quality::GAP_BEFORE);
        (number as u16, gap)
    };
    let numbers = readings.iter().map(counted).collect();
    (numbers, count(&faults, Counter::Unpaired))
}

/// What every family with two frames and no counter must do with them.
fn halves_of_two_readings_stay_apart(driver: &str, keys: &str) {
    let all = [("F1", 0.0), ("S1", 0.2), ("F2", 5.0), ("S2", 5.2)];
    let next = [("F7", 30.0), ("S7", 30.2), ("F8", 35.0), ("S8", 35.2)];
    let check = |middle: &[(&str, f64)], read: &[(u16, bool)], unpaired| {
        let halves = [&all[..], middle, &next[..]].concat();
        let expected = [&[(1, false), (2, false)], read].concat();
        let found = paired(driver, keys, &halves);
        assert_eq!(found, (expected, unpaired), "{driver}: {middle:?}");
    };
    check(&[], &[(7, false), (8, false)], 0);
    // The second half is lost: the next pair cannot be trusted either.
    check(&[("F3", 10.0)], &[(8, true)], 3);
    // The first half is lost.
    check(&[("S3", 10.2)], &[(7, true), (8, false)], 1);
    // Doubled halves.
    let doubled = [("F3", 10.0), ("S3", 10.2), ("S3", 10.3)];
    check(&doubled, &[(3, false), (7, true), (8, false)], 1);
    // The second half of 3 comes after the first of 4.
    let late = [("F3", 10.0), ("F4", 15.0), ("S3", 15.1), ("S4", 15.2)];
    check(&late, &[(7, true), (8, false)], 4);
    // The second half of 3 and the first of 4 are lost.
    check(&[("F3", 10.0), ("S4", 15.2)], &[(7, true), (8, false)], 2);
    // Nothing tells what belongs together before the first half that is heard.
    assert_eq!(
        paired(driver, keys, &[("S1", 0.2), ("F2", 5.0), ("S2", 5.2)]),
        (vec![(2, false)], 0)
    );
}

/// What waits for its second half when the board is started again does not wait any longer.
fn a_half_does_not_outlive_a_restart(driver: &str) {
    let whole = reading([1.0; 3], [0.1; 3]);
    let halves = encode(&mut *board(driver, "", &[]), 0, &whole, Quality::GOOD);
    let mut device = listener(driver, "", &[]);
    decode(&mut *device, &halves[..1]);
    device.restart(Nanos::ZERO);
    let (readings, faults) = decode(&mut *device, &halves[1..]);
    assert!(readings.is_empty() && faults.is_empty(), "{driver}");
}

/// Frames of every wrong form, on both identifiers of a listener, are counted and yield nothing.
fn wrong_frames_are_counted(driver: &str, ids: [u16; 2], short: usize) {
    let mut device = listener(driver, "", &[]);
    for id in ids.map(Id::standard) {
        let fd = Format::Fd {
            bit_rate_switch: false,
            error_state: false,
        };
        let frames = [
            Frame::new(id, &[0; 8][..short]),
            Frame::new(id, &[]),
            Frame::remote(id, 8),
            Frame::with_format(id, fd, &[0; 8]).unwrap(),
            Frame::with_format(id, Format::Error, &[0; 8]).unwrap(),
        ];
        let (readings, faults) = decode(&mut *device, &frames);
        assert!(readings.is_empty());
        let counts = [Counter::Length, Counter::Value].map(|c| count(&faults, c));
        assert_eq!((counts, faults.len()), ([3, 1], 4), "{driver}");
    }
}

/// The bytes are made up; the values are those of the formulas in `RobotousRFT.cpp` of
/// UniMelbHumanRoboticsLab/CANOpenRobotController, which joins bytes 7 and 8 of both frames to tx
/// and divides by 50 and 2000.
const RFT: [&str; 2] = ["001#0B0064FF9C03E8FF", "002#3807D0F830000000"];

#[test]
fn an_rft_splits_tx_over_its_frames() {
    let frames = [frame(RFT[0], 10.0), frame(RFT[1], 10.2)];
    for (model, force, torque) in [
        ("RFT40-SA01", 1.0, 1.0),
        ("RFT44-SB01", 1.0, 1.0),
        ("RFT60-HA01", 1.0, 1.0),
        ("RFT64-SB01", 1.0, 1.0),
        ("RFT76-HA01", 1.0, 1.0),
        ("RFT64-6A01", 1.0, 2.0),
        ("RFT80-6A01", 1.0, 2.0),
        ("RFT80-6A02", 1.0, 2.0),
        ("RFT80-6A03", 2.0, 4.0),
    ] {
        let keys = format!("model = \"{model}\"");
        let (readings, faults) = decode(&mut *listener("robotous_rft", &keys, &[]), &frames);
        assert!(faults.is_empty(), "{faults:?}");
        assert_eq!(readings.len(), 1);
        assert_eq!(readings[0].acquired, frames[0].t);
        assert_eq!(readings[0].stamp, StampKind::Software);
        assert_eq!(readings[0].quality, Quality::GOOD);
        let read = wrench(&readings[0].reading);
        assert_eq!(read.force, [2.0, -2.0, 20.0].map(|f| f * force), "{model}");
        assert_eq!(read.torque, [-0.1, 1.0, -1.0].map(|t| t * torque));
        let back = encode(
            &mut *board("robotous_rft", &keys, &[]),
            0,
            &readings[0].reading,
            Quality::GOOD,
        );
        assert_eq!(texts(&back), RFT);
    }
}

/// Bit by bit as in `RFT_IF_PACKET_Rev1.2.h`: 20 is fx, 01 is tz.
#[test]
fn an_overloaded_axis_of_an_rft_is_saturated_at_the_side_of_its_value() {
    let ends = [
        Saturation::High,
        Saturation::Low,
        Saturation::High,
        Saturation::Low,
        Saturation::High,
        Saturation::Low,
    ];
    for (axis, bit) in (0..).zip([0x20, 0x10, 0x08, 0x04, 0x02, 0x01]) {
        let second = format!("002#3807D0F830{bit:02X}0000");
        let frames = [frame(RFT[0], 0.0), frame(&second, 0.2)];
        let (readings, faults) = decode(&mut *listener("robotous_rft", "", &[]), &frames);
        let expected = Quality::GOOD.with_saturation(axis, ends[axis as usize]);
        assert_eq!(readings[0].quality, expected, "{bit:02X}");
        assert_eq!(count(&faults, Counter::Saturated), 1);
        let mut board = board("robotous_rft", "", &[]);
        let back = encode(&mut *board, 0, &readings[0].reading, expected);
        assert_eq!(texts(&back), [RFT[0], second.as_str()]);
    }
    // Bits without a meaning.
    let frames = [frame(RFT[0], 0.0), frame("002#3807D0F830C0FFFF", 0.2)];
    let (readings, faults) = decode(&mut *listener("robotous_rft", "", &[]), &frames);
    assert_eq!(readings[0].quality, Quality::GOOD);
    assert!(faults.is_empty());
}

#[test]
fn halves_of_two_rft_readings_stay_apart() {
    halves_of_two_readings_stay_apart("robotous_rft", "");
    a_half_does_not_outlive_a_restart("robotous_rft");
    // Half a period after its first half, a second half belongs to the next one.
    for (keys, limit) in [("", 2.8), ("rate_hz = 50", 10.3), ("rate_hz = 1000", 1.3)] {
        for (late, read) in [(limit - 0.1, vec![(1, false)]), (limit + 0.1, vec![])] {
            let (numbers, _) = paired("robotous_rft", keys, &[("F1", 0.0), ("S1", late)]);
            assert_eq!(numbers, read, "{keys} {late}");
        }
    }
}

#[test]
fn wrong_frames_of_an_rft_are_counted() {
    wrong_frames_are_counted("robotous_rft", [1, 2], 7);
    // Responses to other programs' commands are no readings.
    let other = [
        frame("001#0100000000000000", 0.0),
        frame("002#0000000000000000", 0.2),
        frame("001#1003000000000000", 1.0),
        frame("002#0000000000000000", 1.2),
    ];
    let (readings, faults) = decode(&mut *listener("robotous_rft", "", &[]), &other);
    assert!(readings.is_empty() && faults.is_empty());
}

#[test]
fn an_rft_whose_rate_fits_is_started_and_stopped() {
    let sent = reading([1.0, -2.5, 80.0], [0.3, -1.2, 0.004]);
    let mut rig = Rig::new("robotous_rft", "", &[], (0, sent));
    rig.run(100);
    // As a user of the sensor starts it: 8 bytes, the first is the command.
    let commands = [
        "064#0C00000000000000",
        "064#1000000000000000",
        "064#0B00000000000000",
    ];
    assert_eq!(rig.sent, commands);
    assert_eq!(
        (rig.device.state(), rig.readings.len(), rig.faults.len()),
        (State::Streaming, 20, 1)
    );
    assert_eq!(rig.readings[0].reading, sent);
    assert_eq!(rig.readings[0].quality, Quality::GOOD);
    rig.board_loses = Box::new(|_, _| true);
    rig.run(200);
    assert!(rig.states.contains(&State::Silent));
    assert_eq!(rig.count(Counter::Silences), 1);
    assert_eq!(rig.sent[3..5], commands[..2]);
    rig.board_loses = Box::new(|_, _| false);
    rig.run(1200);
    assert_eq!(rig.device.state(), State::Streaming);
    assert!(rig.readings[20].quality.contains(Quality::GAP_BEFORE));
    assert_eq!(rig.readings[21].quality, Quality::GOOD);
    assert!(!rig.sent.iter().any(|text| text.starts_with("064#0F")));
    rig.device.restart(rig.now);
    rig.run(50);
    let start = rig.sent.len() - 3;
    assert_eq!(rig.sent[start..], commands);
    rig.device.stop(rig.now);
    rig.run(30);
    assert_eq!(rig.sent.last().unwrap(), commands[0]);
    assert_eq!(
        (rig.device.state(), rig.board.period()),
        (State::Stopped, None)
    );
}

#[test]
fn an_rft_gets_its_rate_once() {
    let period_of = |keys: &str| {
        let mut rig = Rig::new("robotous_rft", keys, &[], (0, reading([0.0; 3], [0.0; 3])));
        rig.run(20);
        assert_eq!(rig.device.state(), State::Streaming);
        let sent = (rig.sent.iter()).map(|text| text[4..8].to_owned());
        (sent.collect::<Vec<_>>(), rig.board.period().unwrap())
    };
    for (hz, code, period_us) in [
        (10, 1, 100_000),
        (20, 2, 50_000),
        (50, 3, 20_000),
        (100, 4, 10_000),
        (300, 6, 3003),
        (333, 6, 3003),
        (500, 7, 2000),
        (1000, 8, 1000),
    ] {
        let (sent, period) = period_of(&format!("rate_hz = {hz}"));
        let set = format!("0F0{code}");
        assert_eq!(sent, ["0C00", "1000", set.as_str(), "1000", "0B00"], "{hz}");
        assert!((period.seconds() * 1e6 - f64::from(period_us)).abs() < 1.0);
    }
    // A sensor that streams since an earlier start of the host answers nothing but the stop.
    let sent = (0, reading([0.0; 3], [0.0; 3]));
    let mut rig = Rig::started("robotous_rft", "rate_hz = 500", Mode::Supervise, sent);
    rig.run(30);
    let commands = ["064#0C00000000000000", "064#1000000000000000"];
    assert_eq!(rig.sent[..2], commands);
    assert_eq!((rig.sent.len(), rig.device.state()), (3, State::Streaming));
    // Code 0 is 200 Hz too, and no other rate.
    for (keys, command) in [
        ("", "064#0B00000000000000"),
        ("rate_hz = 1000", "064#0F08000000000000"),
    ] {
        let mut device = supervisor("robotous_rft", keys, &[]);
        let mut out = proprio_drivers::Decoded::new();
        let now = Nanos::from_millis(1000);
        for command in commands {
            let next = device.poll_transmit(now, &mut out).unwrap().frame;
            assert_eq!(next.to_string(), command);
            device.on_sent(&next, Ok(now));
        }
        let answer = ["001#1000000000000000", "002#0000000000000000"];
        decode(&mut *device, &answer.map(|text| frame(text, 1000.2)));
        let next = device.poll_transmit(now, &mut out).unwrap().frame;
        assert_eq!(next.to_string(), command);
    }
}

/// 20 ms after it was sent, which is later than it was given to the bus.
#[test]
fn an_rft_that_does_not_answer_is_asked_again() {
    let mut device = supervisor("robotous_rft", "", &[]);
    let poll = |device: &mut dyn Device, t: Nanos, sent: Nanos| {
        let mut out = proprio_drivers::Decoded::new();
        let next = device.poll_transmit(t, &mut out)?.frame;
        device.on_sent(&next, Ok(sent));
        Some(next.to_string())
    };
    let [begin, sent, again] = [1000, 1010, 1030].map(Nanos::from_millis);
    let question = Some("064#1000000000000000".to_owned());
    poll(&mut *device, begin, begin);
    assert_eq!(poll(&mut *device, begin, sent), question);
    assert_eq!(device.next_wake(), Some(again));
    assert_eq!(poll(&mut *device, again - Nanos(1), again), None);
    assert_eq!(poll(&mut *device, again, again), question);
}

/// With argument 1 the present load becomes the zero, with 0 the sensor's own is back.
#[test]
fn the_bias_of_an_rft_is_set_and_reset() {
    let mut board = board("robotous_rft", "", &[]);
    let (readings, _) = decode(
        &mut *listener("robotous_rft", "", &[]),
        &[frame(RFT[0], 0.0), frame(RFT[1], 0.2)],
    );
    let load = readings[0].reading;
    let none = ["001#0B00000000000000", "002#0000000000000000"];
    for (command, sent) in [("064#1101", none), ("064#1100", RFT)] {
        let mut answers = Frames::new();
        board.on_frame(&frame(&format!("{command}000000000000"), 0.0), &mut answers);
        assert!(answers.is_empty(), "not answered");
        for _ in 0..2 {
            let frames = encode(&mut *board, 0, &load, Quality::GOOD);
            assert_eq!(texts(&frames), sent, "{command}");
        }
    }
}

/// Lost, refused and useless answers do not keep an RFT from streaming, and each set of its memory
/// follows an answer that shows that it is needed.
#[test]
fn an_rft_streams_even_if_its_rate_is_not_known() {
    let sent = (0, reading([0.0; 3], [0.0; 3]));
    let mut rig = Rig::new("robotous_rft", "rate_hz = 1000", &[], sent);
    rig.board_loses = Box::new(|_, frame| frame.data().first() == Some(&0x10));
    rig.run(290);
    assert_eq!(rig.device.state(), State::Asking);
    rig.run(710);
    assert_eq!(rig.device.state(), State::Streaming);
    let sets = |rig: &Rig| {
        let set = |text: &&String| text.starts_with("064#0F");
        rig.sent.iter().filter(set).count()
    };
    assert_eq!((sets(&rig), rig.sent.len()), (0, 17));
    assert_eq!(rig.count(Counter::Changed), 0);
    // Every set is lost: asked fifteen times, and counted once.
    let mut rig = Rig::new("robotous_rft", "rate_hz = 1000", &[], sent);
    rig.host_loses = Box::new(|_, frame| frame.data().first() == Some(&0x0F));
    rig.run(1000);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!((sets(&rig), rig.count(Counter::Changed)), (14, 1));
    // A set that the host's own bus did not take is tried again.
    let mut rig = Rig::new("robotous_rft", "rate_hz = 1000", &[], sent);
    let mut turns = 0;
    rig.interface = Box::new(move |frame| {
        turns += 1;
        (frame.data().first() == Some(&0x0F) && turns < 6).then_some(NotSent::Refused)
    });
    rig.run(200);
    assert_eq!((sets(&rig), rig.count(Counter::Changed)), (1, 0));
    assert_eq!((rig.sent.len(), rig.unsent.len()), (5, 3));
    // An answer without a question.
    let mut device = supervisor("robotous_rft", "", &[]);
    let answer = ["001#1000000000000000", "002#0000000000000000"].map(|text| frame(text, 1000.2));
    let (_, faults) = decode(&mut *device, &answer);
    assert_eq!(count(&faults, Counter::Unexpected), 1);
}

#[test]
fn an_rft_that_streams_takes_no_other_command() {
    let mut board = board("robotous_rft", "", &[]);
    let mut answer = |text: &str| {
        let mut out = Frames::new();
        board.on_frame(&frame(text, 0.0), &mut out);
        (texts(&out), board.period())
    };
    let zeros = "002#0000000000000000".to_owned();
    let done = |first: &str| vec![first.to_owned(), zeros.clone()];
    let set = answer("064#0F08000000000000");
    assert_eq!(set, (done("001#0F01000000000000"), None));
    let answered = answer("064#0F09000000000000");
    assert_eq!(answered, (done("001#0F00020000000000"), None));
    let get = answer("064#1000000000000000");
    assert_eq!(get, (done("001#1008000000000000"), None));
    let ms = Some(Nanos::from_millis(1));
    assert_eq!(answer("064#0B00000000000000"), (vec![], ms));
    assert_eq!(answer("064#0F01000000000000"), (vec![], ms));
    assert_eq!(answer("065#0C00000000000000"), (vec![], ms));
    assert_eq!(answer("064#0C00000000000000"), (vec![], None));
}

#[test]
fn wrong_keys_of_an_rft_are_refused() {
    let expected = "10, 20, 50, 100, 200, 300, 333, 500 or 1000";
    let (key, value) = ("rate_hz", 250.0);
    let rate = SpecError::Key {
        key,
        value,
        expected,
    };
    assert_eq!(refused_at("robotous_rft", "rate_hz = 250", 0x64), rate);
    for (keys, key, value) in [
        ("id_first = 0", "id_first", 0.0),
        ("id_first = 256", "id_first", 256.0),
        ("id_second = 0", "id_second", 0.0),
    ] {
        let expected = "from 1 to 255";
        let id = SpecError::Key {
            key,
            value,
            expected,
        };
        assert_eq!(refused_at("robotous_rft", keys, 0x64), id);
    }
    for keys in ["id_second = 1", "id_first = 100", "id_second = 100"] {
        let same = refused_at("robotous_rft", keys, 0x64);
        assert!(matches!(same, SpecError::Keys { .. }), "{same:?}");
    }
    for address in [0, 256] {
        let (least, most) = (1, 255);
        let refused = SpecError::Address {
            address,
            least,
            most,
        };
        assert_eq!(refused_at("robotous_rft", "", address), refused);
    }
    assert_eq!(options("robotous_rft", "").default_address(), Some(0x64));
}

/// Two sensors on a bus have three identifiers each.
#[test]
fn two_rfts_do_not_disturb_each_other() {
    let other = "id_first = 0xF1\nid_second = 0xF2";
    let mut one = options("robotous_rft", other)
        .device(&spec(0xF0, Mode::Listen, &[]))
        .unwrap();
    let (readings, faults) = decode(&mut *one, &RFT.map(|text| frame(text, 0.0)));
    assert!(readings.is_empty() && faults.is_empty());
    let frames = RFT.map(|text| frame(&text.replacen("00", "0F", 1), 0.0));
    assert_eq!(decode(&mut *one, &frames).0.len(), 1);
    let claims = |device: &dyn Device| {
        let key = |claim: &proprio_drivers::Claim| (claim.id, claim.exclusive);
        device.claims().iter().map(key).collect::<Vec<_>>()
    };
    let ids = [0xF1, 0xF2].map(|id| (Id::standard(id), true));
    assert_eq!(claims(&*one), ids);
    let ids = [1, 2].map(|id| (Id::standard(id), true));
    assert_eq!(claims(&*listener("robotous_rft", "", &[])), ids);
}

/// What `reading` becomes on its way through a board and a device.
fn through(driver: &str, keys: &str, sent: Reading) -> (Wrench, Quality) {
    let frames = encode(&mut *board(driver, keys, &[]), 0, &sent, Quality::GOOD);
    let (readings, _) = decode(&mut *listener(driver, keys, &[]), &frames);
    (wrench(&readings[0].reading), readings[0].quality)
}

#[test]
fn an_rft_limits_what_it_cannot_send() {
    let far = reading([1e6, -1e6, 655.341], [1e6, -1e6, 16.3837]);
    let (read, _) = through("robotous_rft", "", far);
    assert_eq!(read.force, [655.34, -655.36, 655.34]);
    assert_eq!(read.torque, [16.3835, -16.384, 16.3835]);
}

proptest! {
    #[test]
    fn an_rft_is_read_back(
        force in uniform3(-655.0_f64..655.0), torque in uniform3(-16.0_f64..16.0),
        coarse: bool, marks in uniform6(any::<bool>()),
    ) {
        let keys = if coarse { "model = \"RFT80-6A03\"" } else { "" };
        let (df, dt) = if coarse { (0.04, 0.002) } else { (0.02, 0.0005) };
        let sent = reading(force, torque);
        let mut quality = Quality::GOOD;
        for (axis, (value, mark)) in force.iter().chain(&torque).zip(marks).enumerate() {
            let step = if axis < 3 { df } else { dt };
            if mark && value.abs() > step {
                let end = if *value < 0.0 { Saturation::Low } else { Saturation::High };
                quality = quality.with_saturation(axis as u32, end);
            }
        }
        let frames = encode(&mut *board("robotous_rft", keys, &[]), 0, &sent, quality);
        let (readings, _) = decode(&mut *listener("robotous_rft", keys, &[]), &frames);
        let back = wrench(&readings[0].reading);
        prop_assert_eq!(readings[0].quality, quality);
        for k in 0..3 {
            prop_assert!(near(back.force[k], force[k], df));
            prop_assert!(near(back.torque[k], torque[k], dt));
        }
    }
}

#[test]
fn the_keys_on_the_page_of_an_rft_are_its_defaults() {
    let shown = shown_keys(include_str!(
        "../../../docs/book/src/devices/robotous_rft.md"
    ));
    assert_eq!(options("robotous_rft", shown), options("robotous_rft", ""));
}

/// The values are those that the README of rise-lab-skku/rise-aft-can shows of its sensor; the
/// bytes follow from them by the formulas there, by hand.
const AFT: [&str; 2] = ["001#701D76966EEC", "002#618462966053"];

#[test]
fn force_and_torque_of_an_aft_are_one_reading() {
    let longer = [format!("{}FFFF", AFT[0]), format!("{}00", AFT[1])];
    for texts_in in [AFT, [&longer[0], &longer[1]]] {
        let frames = [frame(texts_in[0], 10.0), frame(texts_in[1], 10.2)];
        let (readings, faults) = decode(&mut *listener("aidin_aft200", "", &[]), &frames);
        assert!(faults.is_empty(), "{faults:?}");
        assert_eq!(readings.len(), 1);
        assert_eq!(
            (readings[0].acquired, readings[0].quality),
            (frames[0].t, Quality::GOOD)
        );
        let read = wrench(&readings[0].reading);
        for (value, expected) in read.force.iter().zip([-12.99, 3.58, -16.04]) {
            assert!((value - expected).abs() < 1e-9, "{read:?}");
        }
        for (value, expected) in read.torque.iter().zip([-0.072, 0.476, -0.682]) {
            assert!((value - expected).abs() < 1e-9, "{read:?}");
        }
        let mut board = board("aidin_aft200", "", &[]);
        let back = encode(&mut *board, 0, &readings[0].reading, Quality::GOOD);
        assert_eq!(texts(&back), AFT);
    }
}

#[test]
fn halves_of_two_aft_readings_stay_apart() {
    halves_of_two_readings_stay_apart("aidin_aft200", "period_ms = 5");
    a_half_does_not_outlive_a_restart("aidin_aft200");
    for (ms, limit) in [(1, 1.3), (10, 5.3), (65, 32.8)] {
        for (late, read) in [(limit - 0.1, vec![(1, false)]), (limit + 0.1, vec![])] {
            let keys = format!("period_ms = {ms}");
            let halves = [("F1", 0.0), ("S1", late)];
            assert_eq!(paired("aidin_aft200", &keys, &halves).0, read, "{late}");
        }
    }
}

#[test]
fn wrong_frames_of_an_aft_are_counted() {
    wrong_frames_are_counted("aidin_aft200", [1, 2], 5);
}

#[test]
fn an_aft_is_started_and_started_again() {
    let sent = reading([1.0, -2.5, 80.0], [0.3, -1.2, 0.004]);
    let mut rig = Rig::new("aidin_aft200", "period_ms = 4", &[], (0, sent));
    rig.run(100);
    // As `sensors.py` sends 250 Hz, and the start.
    let commands = ["102#01050FA000000000", "102#0103010000000000"];
    assert_eq!(rig.sent, commands);
    assert_eq!(
        (rig.device.state(), rig.readings.len(), rig.faults.len()),
        (State::Streaming, 25, 1)
    );
    assert_eq!(rig.readings[0].quality, Quality::GOOD);
    rig.board_loses = Box::new(|_, _| true);
    rig.run(200);
    assert!(rig.states.contains(&State::Silent));
    rig.board_loses = Box::new(|_, _| false);
    rig.run(700);
    assert_eq!(rig.sent[2..4], commands);
    assert!(rig.readings[25].quality.contains(Quality::GAP_BEFORE));
    assert_eq!(rig.count(Counter::Silences), 1);
    // Nothing is known that would stop it.
    let before = rig.sent.len();
    rig.device.stop(rig.now);
    rig.run(30);
    assert_eq!(
        (rig.device.state(), rig.sent.len()),
        (State::Stopped, before)
    );
    let longest = Rig::new("aidin_aft200", "period_ms = 65", &[], (0, sent))
        .run(5)
        .sent[0]
        .clone();
    assert_eq!(longest, "102#0105FDE800000000");
}

#[test]
fn an_aft_takes_its_own_commands_only() {
    let mut board = board("aidin_aft200", "", &[]);
    let mut after = |text: &str| {
        let mut out = Frames::new();
        board.on_frame(&frame(text, 0.0), &mut out);
        assert!(out.is_empty());
        board.period()
    };
    assert_eq!(after("102#0203010000000000"), None);
    assert_eq!(after("103#0103010000000000"), None);
    assert_eq!(after("102#0103020000000000"), None);
    assert_eq!(after("102#0103010000000000"), Some(Nanos::from_millis(10)));
    assert_eq!(after("102#0105000000000000"), Some(Nanos::from_millis(10)));
    assert_eq!(after("102#010501F400000000"), Some(Nanos::from_micros(500)));
}

#[test]
fn an_aft_at_an_end_of_its_range_is_saturated() {
    let far = reading([1e6, -1e6, 0.0], [0.0, 1e6, -1e6]);
    let (read, quality) = through("aidin_aft200", "", far);
    let ends = [(0, Saturation::High), (1, Saturation::Low)];
    let ends = ends
        .into_iter()
        .chain([(4, Saturation::High), (5, Saturation::Low)]);
    let expected = ends.fold(Quality::GOOD, |quality, (axis, end)| {
        quality.with_saturation(axis, end)
    });
    assert_eq!(quality, expected);
    for (value, expected) in read.force.iter().zip([355.35, -300.0, 0.0]) {
        assert!((value - expected).abs() < 1e-9);
    }
    for (value, expected) in read.torque.iter().zip([0.0, 81.07, -50.0]) {
        assert!((value - expected).abs() < 1e-9);
    }
    // The flags alone do it, too.
    let within = reading([1.0; 3], [1.0; 3]);
    let mut board = board("aidin_aft200", "", &[]);
    let frames = encode(&mut *board, 0, &within, expected);
    let (readings, faults) = decode(&mut *listener("aidin_aft200", "", &[]), &frames);
    assert_eq!(readings[0].quality, expected);
    assert_eq!(count(&faults, Counter::Saturated), 1);
}

#[test]
fn wrong_keys_of_an_aft_are_refused() {
    for (keys, key, value, expected) in [
        ("period_ms = 0", "period_ms", 0.0, "an integer from 1 to 65"),
        (
            "period_ms = 66",
            "period_ms",
            66.0,
            "an integer from 1 to 65",
        ),
        ("id_force = 0x800", "id_force", 2048.0, "from 0 to 0x7FF"),
        ("id_torque = 0x800", "id_torque", 2048.0, "from 0 to 0x7FF"),
    ] {
        let refused = SpecError::Key {
            key,
            value,
            expected,
        };
        assert_eq!(refused_at("aidin_aft200", keys, 1), refused);
    }
    let same = refused_at("aidin_aft200", "id_force = 2", 1);
    assert!(matches!(same, SpecError::Keys { .. }), "{same:?}");
    for address in [0, 255] {
        let (least, most) = (1, 254);
        let refused = SpecError::Address {
            address,
            least,
            most,
        };
        assert_eq!(refused_at("aidin_aft200", "", address), refused);
    }
    let shown = shown_keys(include_str!(
        "../../../docs/book/src/devices/aidin_aft200.md"
    ));
    assert_eq!(options("aidin_aft200", shown), options("aidin_aft200", ""));
    assert_eq!(options("aidin_aft200", "").default_address(), Some(1));
}

#[test]
fn two_afts_do_not_disturb_each_other() {
    let other = options("aidin_aft200", "id_force = 0x21\nid_torque = 0x22");
    let mut other = other.device(&spec(2, Mode::Supervise, &[])).unwrap();
    let (readings, faults) = decode(&mut *other, &AFT.map(|text| frame(text, 0.0)));
    assert!(readings.is_empty() && faults.is_empty());
    let frames = AFT.map(|text| frame(&text.replacen("00", "02", 1), 0.0));
    assert_eq!(decode(&mut *other, &frames).0.len(), 1);
    let ids: Vec<(Id, bool)> = (other.claims().iter())
        .map(|c| (c.id, c.exclusive))
        .collect();
    assert_eq!(ids, [0x21, 0x22].map(|id| (Id::standard(id), true)));
    let mut out = proprio_drivers::Decoded::new();
    let first = other.poll_transmit(Nanos::ZERO, &mut out).unwrap().frame;
    assert_eq!(first.to_string(), "102#0205271000000000");
}

proptest! {
    #[test]
    fn an_aft_is_read_back(
        force in uniform3(-299.9_f64..355.3), torque in uniform3(-49.9_f64..81.0),
    ) {
        let (back, quality) = through("aidin_aft200", "", reading(force, torque));
        prop_assert_eq!(quality, Quality::GOOD);
        for k in 0..3 {
            prop_assert!(near(back.force[k], force[k], 0.01));
            prop_assert!(near(back.torque[k], torque[k], 0.002));
        }
    }
}
