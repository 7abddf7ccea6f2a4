//! OptoForce sensors: packets that lie over two frames, and their configuration.

use super::{FROZEN, Found, GAP, GOOD, faults_of, wrong_frames_are_counted};
use crate::rig::{
    Rig, board, decode, encode, frame, listener, options, reading, refused_at, shown_keys, spec,
    texts, wrench,
};
use proprio_drivers::{Frame, Frames, Id, Mode, SpecError, StampedReading, State};
use proprio_topics::{Counter, Nanos, Quality, Saturation, StampKind};
use proptest::array::uniform3;
use proptest::prelude::*;

/// The sensitivities of a sensor OMD-45-FH-2000N, as `optoforce` 0.3.0 on PyPI has them: 300 N are
/// 7925 and 8641 steps, 2000 N are 6049.
const OPTO: &str = "counts_per_newton = [26.416666666666668, 28.803333333333335, 3.0245]\n";

/// The first packets that the tests of that package hold, recorded from a unit, in two frames each,
/// and the forces that it reads in them.
const RECORDED: [(&str, &str, [f64; 3]); 3] = [
    (
        "AA07080A2D6A0000",
        "FFF7FFFB00070551",
        [-0.340_694_006_309, -0.173_591_019_558, 2.314_432_137_543],
    ),
    (
        "AA07080A2D6B0000",
        "FFF9FFFE000C055C",
        [-0.264_984_227_129, -0.069_436_407_823, 3.967_597_950_074],
    ),
    (
        "AA07080A2D6C0000",
        "FFF30001000A0359",
        [-0.492_113_564_669, 0.034_718_203_912, 3.306_331_625_062],
    ),
];

fn opto_frame(data: &str, ms: f64) -> Frame {
    frame(&format!("100#{data}"), ms)
}

#[test]
fn recorded_packets_of_an_optoforce_are_read() {
    let mut device = listener("optoforce_daq", OPTO, &[]);
    let mut board = board("optoforce_daq", OPTO, &[]);
    for (k, (first, second, force)) in RECORDED.into_iter().enumerate() {
        let ms = 10.0 * k as f64;
        let frames = [opto_frame(first, ms), opto_frame(second, ms + 0.2)];
        let (readings, faults) = decode(&mut *device, &frames);
        assert!(faults.is_empty(), "{faults:?}");
        assert_eq!(readings.len(), 1);
        assert_eq!(
            (readings[0].acquired, readings[0].stamp, readings[0].quality),
            (frames[0].t, StampKind::Software, GOOD)
        );
        assert_eq!(readings[0].device_counter, 11626 + k as u32);
        let read = wrench(&readings[0].reading);
        for (value, expected) in read.force.iter().zip(force) {
            assert!((value - expected).abs() < 1e-9, "{read:?}");
        }
        assert!(read.torque.iter().all(|value| value.is_nan()));
        // The board counts from 1.
        let back = encode(&mut *board, 0, &readings[0].reading, Quality::GOOD);
        let number = 1 + k as u16;
        assert_eq!(back[0].data()[..4], frames[0].data()[..4]);
        assert_eq!(back[0].data()[4..], [0, number as u8, 0, 0]);
        assert_eq!(back[1].data()[..6], frames[1].data()[..6]);
    }
    // The answer to its configuration stands before them.
    let (readings, faults) = decode(&mut *device, &[opto_frame("AA0050010000FB", 40.0)]);
    assert!(readings.is_empty() && faults.is_empty());
}

/// Half a packet: number `counter`, whose fx is the counter too.
fn opto_half(name: &str, ms: f64) -> Frame {
    let counter: u16 = name[1..].parse().unwrap();
    let [high, low] = counter.to_be_bytes();
    let first = [0xAA, 0x07, 0x08, 0x0A, high, low, 0, 0];
    let sum = 0xC3 + 2 * (u16::from(high) + u16::from(low));
    let [s0, s1] = sum.to_be_bytes();
    let data = match &name[..1] {
        "F" => first,
        // A wrong checksum.
        "X" => [high, low, 0, 0, 0, 1, s0, s1],
        _ => [high, low, 0, 0, 0, 0, s0, s1],
    };
    Frame::new(Id::standard(0x100), &data).at(Nanos::from_seconds(ms * 1e-3), StampKind::Software)
}

fn opto(halves: &[&str]) -> Found {
    let frames: Vec<Frame> = halves.iter().map(|name| opto_half(name, 0.0)).collect();
    let mut device = listener("optoforce_daq", "counts_per_newton = [1, 1, 1]", &[]);
    let (readings, faults) = decode(&mut *device, &frames);
    let counted = |stamped: &StampedReading| {
        let force = wrench(&stamped.reading).force[0];
        let counter = f64::from((stamped.device_counter as u16).cast_signed());
        assert_eq!(force, counter, "halves of two: {stamped:?}");
        (stamped.device_counter, stamped.quality)
    };
    (readings.iter().map(counted).collect(), faults_of(&faults))
}

#[test]
fn frames_of_two_optoforce_packets_stay_apart() {
    use Counter::{Lost, Unpaired, Value};
    let check = |middle: &[&str], read: &[(u32, Quality)], faults: &[(Counter, u32)]| {
        let halves = [&["F1", "S1"], middle, &["F4", "S4", "F5", "S5"]].concat();
        let expected = [&[(1, GOOD)], read, &[(5, GOOD)]].concat();
        assert_eq!(opto(&halves), (expected, faults.to_vec()), "{middle:?}");
    };
    let all = ["F2", "S2", "F3", "S3"];
    check(&all, &[(2, GOOD), (3, GOOD), (4, GOOD)], &[]);
    check(&[], &[(4, GAP)], &[(Lost, 2)]);
    // A second frame is lost, then a first one.
    let second = [(Unpaired, 1), (Lost, 1)];
    check(&["F2", "F3", "S3"], &[(3, GAP), (4, GOOD)], &second);
    check(&["S2", "F3", "S3"], &[(3, GAP), (4, GOOD)], &second);
    // A second frame and the next first one are lost: the checksum shows it.
    check(&["F2", "S3"], &[(4, GAP)], &[(Value, 1), (Lost, 2)]);
    // A second frame comes after the next first one.
    let late = [(Unpaired, 1), (Value, 1), (Unpaired, 1), (Lost, 2)];
    check(&["F2", "F3", "S2", "S3"], &[(4, GAP)], &late);
    // Doubled frames.
    let doubled = [(2, GOOD), (3, GAP), (4, GOOD)];
    check(&["F2", "S2", "S2", "F3", "S3"], &doubled, &[(Unpaired, 1)]);
    let doubled = [(2, GAP), (3, GOOD), (4, GOOD)];
    check(&["F2", "F2", "S2", "F3", "S3"], &doubled, &[(Unpaired, 1)]);
    let doubled = [(2, GOOD), (2, FROZEN), (3, GOOD), (4, GOOD)];
    check(&["F2", "S2", "F2", "S2", "F3", "S3"], &doubled, &[]);
    // A wrong checksum.
    let wrong = [(Value, 1), (Lost, 1)];
    check(&["F2", "X2", "F3", "S3"], &[(3, GAP), (4, GOOD)], &wrong);
    // The stream is joined between two frames.
    assert_eq!(opto(&["S1", "F2", "S2"]), (vec![(2, GOOD)], vec![]));
    // The counter wraps.
    let wrapped = opto(&["F65535", "S65535", "F1", "S1"]);
    assert_eq!(wrapped, (vec![(65535, GOOD), (1, GAP)], vec![(Lost, 1)]));
    // A unit that was started again.
    let again = opto(&["F20000", "S20000", "F0", "S0", "F1", "S1"]);
    let expected = vec![(20000, GOOD), (0, GAP), (1, GOOD)];
    assert_eq!(again, (expected, vec![]));
}

/// A second frame whose forces look like the beginning of a packet.
#[test]
fn an_optoforce_force_may_look_like_a_header() {
    let mut device = listener("optoforce_daq", "counts_per_newton = [1, 1, 1]", &[]);
    let frames = [
        opto_frame("AA07080A00010000", 0.0),
        opto_frame("AA07080A00000187", 0.2),
        opto_half("F2", 10.0),
        opto_half("S2", 10.2),
    ];
    let (readings, faults) = decode(&mut *device, &frames);
    assert!(faults.is_empty(), "{faults:?}");
    assert_eq!(wrench(&readings[0].reading).force, [-22009.0, 2058.0, 0.0]);
    assert_eq!(readings.len(), 2);
    // What waits when the unit is started again does not wait any longer.
    decode(&mut *device, &frames[2..3]);
    device.restart(Nanos::ZERO);
    let (readings, faults) = decode(&mut *device, &frames[3..]);
    assert!(readings.is_empty() && faults.is_empty());
    let (readings, faults) = decode(
        &mut *device,
        &[opto_half("F9", 20.0), opto_half("S9", 20.1)],
    );
    assert_eq!(
        (readings.len(), faults.len()),
        (1, 0),
        "what was before is no loss"
    );
}

/// Status bits as `optoforce_can.c` and the package on PyPI name them.
#[test]
fn the_status_of_an_optoforce_marks_its_readings() {
    let low = Saturation::Low;
    let high = Saturation::High;
    let at = |axis, end| GOOD.with_saturation(axis, end);
    let fault = GOOD | Quality::DEVICE_FAULT;
    for (status, expected) in [
        (1 << 9, at(0, low)),
        (1 << 8, at(1, low)),
        (1 << 7, at(2, high)),
        (1 << 6, at(3, high)),
        (1 << 5, at(4, high)),
        (1 << 4, at(5, high)),
        (0b1111, GOOD),
        (1 << 10, fault),
        (2 << 10, fault),
        (4 << 10, fault),
        (1 << 13, fault),
        (2 << 13, fault),
        (4 << 13, fault),
    ] {
        let [a, b] = u16::to_be_bytes(status);
        let sum = 0x0551 + u16::from(a) + u16::from(b);
        let frames = [
            opto_frame(&format!("AA07080A2D6A{status:04X}"), 0.0),
            opto_frame(&format!("FFF7FFFB0007{sum:04X}"), 0.2),
        ];
        let (readings, faults) = decode(&mut *listener("optoforce_daq", OPTO, &[]), &frames);
        assert_eq!(readings[0].quality, expected, "{status:04X}");
        let counts = match expected {
            GOOD => vec![],
            _ if expected == fault => vec![(Counter::DeviceFault, 1)],
            _ => vec![(Counter::Saturated, 1)],
        };
        assert_eq!(faults_of(&faults), counts);
        let mut board = board("optoforce_daq", OPTO, &[]);
        let back = encode(&mut *board, 0, &readings[0].reading, expected);
        let sent = u16::from_be_bytes([back[0].data()[6], back[0].data()[7]]);
        let shown = match expected {
            _ if expected == fault => 2 << 10,
            GOOD => 0,
            _ => status,
        };
        assert_eq!(sent, shown);
    }
}

#[test]
fn wrong_frames_of_an_optoforce_are_counted() {
    let mut device = listener("optoforce_daq", OPTO, &[]);
    for short in [0, 4, 6] {
        wrong_frames_are_counted(&mut *device, 0x100, short);
    }
    // Answers with an error, a wrong checksum, another header.
    for text in ["AA0050010100FC", "AA0050010000FC", "AA0051010000FC"] {
        let (readings, faults) = decode(&mut *device, &[opto_frame(text, 0.0)]);
        assert!(readings.is_empty());
        assert_eq!(faults_of(&faults), [(Counter::Value, 1)], "{text}");
    }
    // An answer between the frames of a packet.
    let frames = [
        opto_half("F2", 0.0),
        opto_frame("AA0050010000FB", 0.1),
        opto_half("S2", 0.2),
    ];
    let (readings, faults) = decode(&mut *device, &frames);
    assert_eq!((readings.len(), faults.len()), (1, 0));
    let (readings, faults) = decode(&mut *device, &[frame("101#AA00", 0.0)]);
    assert!(readings.is_empty() && faults.is_empty());
}

#[test]
fn an_optoforce_that_is_not_configured_gets_no_frame() {
    let sent = reading([10.0, 0.0, -20.0], [f64::NAN; 3]);
    let mut rig = Rig::new("optoforce_daq", OPTO, &[], (0, sent));
    rig.run(50);
    assert!(rig.sent.is_empty());
    assert_eq!(
        (rig.device.state(), rig.readings.len(), rig.faults.len()),
        (State::Streaming, 5, 0)
    );
    assert_eq!(rig.readings[0].quality, GOOD);
    rig.board_loses = Box::new(|_, _| true);
    rig.run(200);
    assert_eq!(rig.device.state(), State::Silent);
    rig.board_loses = Box::new(|_, _| false);
    rig.run(20);
    assert_eq!(rig.readings[5].quality, GAP);
    rig.device.stop(rig.now);
    rig.run(10);
    assert_eq!((rig.device.state(), rig.sent.len()), (State::Stopped, 0));
}

#[test]
fn an_optoforce_is_configured_and_stopped() {
    let load = |n: f64| (0, reading([10.0 * n, 5.0, -20.0 * n], [f64::NAN; 3]));
    // The bytes that the tests of the package on PyPI expect for 100 Hz, 15 Hz and no zero, in the
    // frames of `OptoforceSensor.cpp`.
    let keys = format!("{OPTO}rate_hz = 100");
    let mut rig = Rig::new("optoforce_daq", &keys, &[], load(1.0));
    rig.run(100);
    let commands = ["101#AA0032030A040000", "101#ED00000000000000"];
    assert_eq!(rig.sent, commands);
    assert_eq!(
        (rig.device.state(), rig.readings.len(), rig.faults.len()),
        (State::Streaming, 10, 1)
    );
    let zeroed = GOOD | Quality::ZERO_CHANGED;
    assert_eq!(rig.readings[0].quality, zeroed);
    assert!(rig.readings[1..].iter().all(|r| r.quality == GOOD));
    assert!((wrench(&rig.readings[9].reading).force[2] + 20.0).abs() < 0.2);
    rig.board_loses = Box::new(|_, _| true);
    rig.run(200);
    rig.board_loses = Box::new(|_, _| false);
    rig.run(700);
    assert_eq!(rig.sent[2..4], commands);
    assert!(rig.readings[10].quality.contains(Quality::GAP_BEFORE));
    rig.device.stop(rig.now);
    rig.run(30);
    let stopped = ["101#AA00320300040000", "101#E300000000000000"];
    assert_eq!(rig.sent[rig.sent.len() - 2..], stopped);
    assert_eq!(
        (rig.device.state(), rig.board.period()),
        (State::Stopped, None)
    );
    // The present load as the zero, in frames that are not filled.
    let keys = format!("{OPTO}rate_hz = 1000\nfilter_hz = 1.5\nzero = true\nfill = false");
    let mut rig = Rig::new("optoforce_daq", &keys, &[], load(1.0));
    rig.run(10);
    rig.reading = load(2.0);
    rig.run(10);
    assert_eq!(rig.sent, ["101#AA0032030106FF01", "101#E5"]);
    assert_eq!(wrench(&rig.readings[5].reading).force, [0.0; 3]);
    let force = wrench(&rig.readings[19].reading).force;
    assert!((force[0] - 10.0).abs() < 0.02 && force[1] == 0.0);
    rig.device.stop(rig.now);
    rig.run(3);
    assert_eq!(rig.sent[2..], ["101#AA00320300060000", "101#E5"]);
    // That has its own zero again.
    let (output, sent) = rig.reading;
    let frames = encode(&mut *rig.board, output, &sent, Quality::GOOD);
    let (readings, _) = decode(&mut *listener("optoforce_daq", OPTO, &[]), &frames);
    assert!((wrench(&readings[0].reading).force[0] - 20.0).abs() < 0.02);
}

#[test]
fn all_readings_around_a_new_zero_of_an_optoforce_are_marked() {
    let keys = format!("{OPTO}rate_hz = 100");
    let marked = |answer_lost: bool| {
        let sent = (0, reading([1.0; 3], [f64::NAN; 3]));
        let mut rig = Rig::new("optoforce_daq", &keys, &[], sent);
        rig.board_loses = Box::new(move |_, frame| answer_lost && frame.len() == 7);
        rig.run(150);
        let changed = |r: &StampedReading| r.quality.contains(Quality::ZERO_CHANGED);
        let marks: Vec<bool> = rig.readings.iter().map(changed).collect();
        assert_eq!(marks.len(), 15);
        marks.iter().take_while(|mark| **mark).count()
    };
    assert_eq!((marked(false), marked(true)), (1, 11));
}

#[test]
fn each_rate_and_filter_of_an_optoforce_has_its_code() {
    let first = |keys: &str| {
        let keys = format!("{OPTO}{keys}");
        let sent = (0, reading([1.0; 3], [f64::NAN; 3]));
        let mut rig = Rig::new("optoforce_daq", &keys, &[], sent);
        rig.run(2);
        (rig.sent[0][12..16].to_owned(), rig.board.period().unwrap())
    };
    for (hz, code, ms) in [
        (1000, "01", 1),
        (333, "03", 3),
        (100, "0A", 10),
        (30, "21", 33),
        (10, "64", 100),
    ] {
        let (sent, period) = first(&format!("rate_hz = {hz}"));
        assert_eq!(
            (sent, period),
            (format!("{code}04"), Nanos::from_millis(ms))
        );
    }
    for (code, hz) in ["0", "500", "150", "50", "15", "5", "1.5"]
        .iter()
        .enumerate()
    {
        let (sent, _) = first(&format!("rate_hz = 100\nfilter_hz = {hz}"));
        assert_eq!(sent, format!("0A0{code}"));
    }
}

#[test]
fn an_optoforce_takes_whole_configurations_only() {
    let mut board = board("optoforce_daq", OPTO, &[]);
    let mut after = |texts_in: &[&str]| {
        let mut out = Frames::new();
        for text in texts_in {
            board.on_frame(&frame(text, 0.0), &mut out);
        }
        (texts(&out).join(" "), board.period())
    };
    let ms = |ms| Some(Nanos::from_millis(ms));
    let nothing = String::new();
    assert_eq!(after(&[]), (nothing.clone(), ms(10)));
    let (right, wrong) = ("101#AA00320301040000", "101#E5");
    assert_eq!(after(&[right, wrong]), (nothing.clone(), ms(10)));
    assert_eq!(after(&["101#E4"]), (nothing.clone(), ms(10)));
    assert_eq!(after(&["102#AA00320301040000", "101#E4"]).1, ms(10));
    let answer = "100#AA0050010000FB".to_owned();
    assert_eq!(after(&[right, "101#E4"]), (answer.clone(), ms(1)));
    assert_eq!(after(&["101#AA00320300040000", "101#E3"]), (answer, None));
}

#[test]
fn wrong_keys_of_an_optoforce_are_refused() {
    let (key, expected) = (
        "counts_per_newton",
        "three numbers above 0, from the sensor's sensitivity report",
    );
    let missing = SpecError::Keys { key, expected };
    assert_eq!(refused_at("optoforce_daq", "", 0x100), missing);
    for (keys, key, value, expected) in [
        ("counts_per_newton = [1, 0, 1]", key, 0.0, expected),
        ("counts_per_newton = [1, 1, -2]", key, -2.0, expected),
        (
            "rate_hz = 200",
            "rate_hz",
            200.0,
            "10, 30, 100, 333 or 1000",
        ),
        (
            "rate_hz = 100\nfilter_hz = 10",
            "filter_hz",
            10.0,
            "0, 1.5, 5, 15, 50, 150 or 500",
        ),
        ("id_config = 0x800", "id_config", 2048.0, "from 0 to 0x7FF"),
    ] {
        let refused = SpecError::Key {
            key,
            value,
            expected,
        };
        let keys = match key {
            "counts_per_newton" => keys.to_owned(),
            _ => format!("{OPTO}{keys}"),
        };
        assert_eq!(refused_at("optoforce_daq", &keys, 0x100), refused);
    }
    for (keys, given) in [("filter_hz = 15", "filter_hz"), ("zero = true", "zero")] {
        let missing = "rate_hz";
        let alone = refused_at("optoforce_daq", &format!("{OPTO}{keys}"), 0x100);
        assert_eq!(alone, SpecError::Incomplete { given, missing });
    }
    let same = refused_at("optoforce_daq", &format!("{OPTO}id_config = 0x100"), 0x100);
    assert!(matches!(same, SpecError::Keys { .. }), "{same:?}");
    let (address, least, most) = (0x800, 0, 0x7FF);
    let refused = SpecError::Address {
        address,
        least,
        most,
    };
    assert_eq!(refused_at("optoforce_daq", OPTO, address), refused);
    let shown = shown_keys(include_str!(
        "../../../../docs/book/src/devices/optoforce_daq.md"
    ));
    let shown = options("optoforce_daq", shown);
    let same =
        "counts_per_newton = [26.42, 28.80, 3.02]\nrate_hz = 100\nfilter_hz = 15\nzero = false";
    assert_eq!(shown, options("optoforce_daq", same));
    assert_eq!(shown.default_address(), Some(0x100));
    assert!(shown.device(&spec(0x100, Mode::Supervise, &[])).is_ok());
}

#[test]
fn two_optoforces_do_not_disturb_each_other() {
    let keys = format!("{OPTO}id_config = 0x112");
    let mut other = options("optoforce_daq", &keys)
        .device(&spec(0x111, Mode::Listen, &[]))
        .unwrap();
    let claims: Vec<(Id, bool)> = (other.claims().iter())
        .map(|claim| (claim.id, claim.exclusive))
        .collect();
    assert_eq!(claims, [(Id::standard(0x111), true)]);
    let frames = [opto_half("F1", 0.0), opto_half("S1", 0.2)];
    let (readings, faults) = decode(&mut *other, &frames);
    assert!(readings.is_empty() && faults.is_empty());
    let moved = frames.map(|f| Frame::new(Id::standard(0x111), f.data()));
    assert_eq!(decode(&mut *other, &moved).0.len(), 1);
}

#[test]
fn an_optoforce_limits_what_it_cannot_send() {
    let keys = "counts_per_newton = [10, 10, 10]";
    let mut board = board("optoforce_daq", keys, &[]);
    let far = reading([1e6, -1e6, 3.04], [0.0; 3]);
    let frames = encode(&mut *board, 0, &far, Quality::GOOD);
    let (readings, _) = decode(&mut *listener("optoforce_daq", keys, &[]), &frames);
    assert_eq!(wrench(&readings[0].reading).force, [3276.7, -3276.8, 3.0]);
    let none = reading([f64::NAN, 0.0, 0.0], [0.0; 3]);
    let mut out = Frames::new();
    assert!(board.encode(0, &none, Quality::GOOD, &mut out).is_err());
}

proptest! {
    #[test]
    fn an_optoforce_is_read_back(
        scales in uniform3(0.5_f64..100.0), parts in uniform3(-32000.0_f64..32000.0),
    ) {
        let ([a, b, c], [x, y, z]) = (scales, parts);
        let keys = format!("counts_per_newton = [{a:?}, {b:?}, {c:?}]");
        let force = [x / a, y / b, z / c];
        let mut board = board("optoforce_daq", &keys, &[]);
        let frames = encode(&mut *board, 0, &reading(force, [0.0; 3]), Quality::GOOD);
        let (readings, _) = decode(&mut *listener("optoforce_daq", &keys, &[]), &frames);
        prop_assert_eq!(readings[0].quality, GOOD);
        let back = wrench(&readings[0].reading).force;
        for k in 0..3 {
            prop_assert!((back[k] - force[k]).abs() <= 0.5 / scales[k] * 1.000001);
        }
    }

    /// Any frames lost, doubled or exchanged with the next one: no reading is of two packets.
    #[test]
    fn frames_of_two_optoforce_packets_are_never_put_together(
        begin in 0_u16..1000, fates in proptest::collection::vec(0_u8..10, 2..120),
    ) {
        let mut names = Vec::new();
        for (k, fate) in (0_u16..).zip(&fates) {
            let name = format!("{}{}", if k % 2 == 0 { 'F' } else { 'S' }, begin + k / 2);
            match fate {
                0 | 3 => {}
                1 => names.extend([name.clone(), name]),
                2 if !names.is_empty() => names.insert(names.len() - 1, name),
                _ => names.push(name),
            }
        }
        let halves: Vec<&str> = names.iter().map(String::as_str).collect();
        let (readings, _) = opto(&halves);
        prop_assert!(readings.windows(2).all(|pair| pair[0].0 <= pair[1].0));
    }
}
