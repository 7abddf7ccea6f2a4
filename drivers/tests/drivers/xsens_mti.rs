//! Xsens MTi: messages that cantools encodes from the maker's .dbc file, the order of a sample's
//! messages, and the sensor's opinion of itself.
//!
//! The bytes are the output of cantools 45.1 and `xsens.dbc`
//! (jiminghe/Xsens_MTi_CAN_ROS_Driver e305ce34), with the values that the tests expect:
//!
//! ```python
//! db = cantools.database.load_file("xsens.dbc", strict=False)
//! db.get_message_by_name("RateOfTurn").encode(dict(gyrX=1.5, gyrY=-2.25, gyrZ=34.5), strict=False)
//! ```
//! The file has no step 1/32767 of the quaternion and no sample time in units of 100 us: these
//! values are computed by hand.

use crate::rig::{Rig, board, count, decode, encode, frame, imu, listener, options, spec};
use proprio_drivers::{Claim, EncodeError, Frame, Frames, Id, Mode, SpecError, State};
use proprio_topics::{
    Counter, Gauges, Imu, Nanos, Quality, Reading, Saturation, StampKind, Temperature,
};
use proptest::array::uniform3;
use proptest::prelude::*;

const SAMPLE_TIME: &str = "005#075BCD15";
const GROUP_COUNTER: &str = "006#1234";
const STATUS_GOOD: &str = "011#00000003";
const QUATERNION: &str = "021#4000C0002000A000";
const RATE: &str = "032#0300FB804500";
const ACCELERATION: &str = "034#09D0FFC09D80";
const FIELD: &str = "041#0200FB000001";

const EVERYTHING: &str = r#"
quantities = ["magnetic_field", "orientation", "sample_time", "group_counter", "status",
              "acceleration", "angular_velocity"]
magnetic_unit = 50e-6
"#;

fn frames(texts: &[&str]) -> Vec<Frame> {
    (0..)
        .zip(texts)
        .map(|(k, text)| frame(text, f64::from(k) * 0.1))
        .collect()
}

#[test]
fn the_messages_of_a_sample_are_one_reading() {
    let sent = frames(&[
        SAMPLE_TIME,
        GROUP_COUNTER,
        STATUS_GOOD,
        QUATERNION,
        RATE,
        ACCELERATION,
        FIELD,
    ]);
    let (readings, faults) = decode(&mut *listener("xsens_mti", EVERYTHING, &[]), &sent);
    assert!(faults.is_empty(), "{faults:?}");
    assert_eq!(readings.len(), 1);
    let stamped = &readings[0];
    assert_eq!(
        (stamped.acquired, stamped.stamp),
        (sent[0].t, sent[0].stamp)
    );
    assert_eq!(stamped.quality, Quality::DEVICE_COUNTER);
    assert_eq!(stamped.device_counter, 0x1234);
    assert_eq!(stamped.device_time, Nanos::from_micros(123_456_789 * 100));
    let imu = imu(stamped);
    assert_eq!(imu.angular_velocity, [1.5, -2.25, 34.5]);
    assert_eq!(imu.proper_acceleration, [9.8125, -0.25, -98.5]);
    for (value, units) in imu
        .magnetic_field
        .into_iter()
        .zip([0.5, -1.25, 1.0 / 1024.0])
    {
        assert!((value - units * 50e-6).abs() < 1e-18);
    }
    for (value, part) in imu.orientation.into_iter().zip([0.5, -0.5, 0.25, -0.75]) {
        assert!((value - part * 32768.0 / 32767.0).abs() < 1e-12);
    }
    assert!(imu.angular_acceleration.iter().all(|value| value.is_nan()));
}

#[test]
fn where_the_sources_differ_a_key_decides() {
    let keys = r#"
        quantities = ["sample_time", "orientation"]
        sample_time_unit_us = 1
        quaternion_one = 32768
    "#;
    let sent = frames(&[SAMPLE_TIME, QUATERNION]);
    let (readings, _) = decode(&mut *listener("xsens_mti", keys, &[]), &sent);
    assert_eq!(imu(&readings[0]).orientation, [0.5, -0.5, 0.25, -0.75]);
    assert!(imu(&readings[0]).proper_acceleration[0].is_nan());
    assert_eq!(readings[0].device_time, Nanos::from_micros(123_456_789));

    // RateOfTurnHR and AccelerationHR of the .dbc file, then with their contents exchanged.
    let keys = r#"quantities = ["acceleration", "angular_velocity"]"#;
    for (high_rate, sent) in [
        ("rate_first", ["061#FF0000801800", "062#0100FE0009D0"]),
        (
            "acceleration_first",
            ["061#0100FE0009D0", "062#FF0000801800"],
        ),
    ] {
        let keys = format!("{keys}\nhigh_rate = \"{high_rate}\"");
        let (readings, faults) = decode(&mut *listener("xsens_mti", &keys, &[]), &frames(&sent));
        assert!(faults.is_empty(), "{faults:?}");
        assert_eq!(imu(&readings[0]).angular_velocity, [-0.5, 0.25, 12.0]);
        assert_eq!(imu(&readings[0]).proper_acceleration, [1.0, -2.0, 9.8125]);
        // Neither has the sensor a time or a counter here.
        assert_eq!(readings[0].device_time, Nanos::MIN);
        assert_eq!(readings[0].quality, Quality::GOOD);
    }
}

/// Identifiers of 29 bits, changed ones, and a number on top of all.
#[test]
fn identifiers_are_those_of_the_sensor() {
    let keys = r#"
        identifiers = { acceleration = 0x400, angular_velocity = 0x600, error = 0x7 }
        extended = true
    "#;
    let options = options("xsens_mti", keys);
    let mut device = options.device(&spec(0x10000, Mode::Listen, &[])).unwrap();
    let ids = [0x10005, 0x10400, 0x10600, 0x10007].map(Id::extended);
    assert_eq!(device.claims(), ids.map(Claim::exclusive));
    // The acceleration comes before the angular velocity now, whose identifier is higher.
    let sent = frames(&[
        "00010005#00000000",
        "00010400#09D0FFC09D80",
        "00010600#0300FB804500",
    ]);
    let (readings, faults) = decode(&mut *device, &sent);
    assert!(faults.is_empty(), "{faults:?}");
    assert_eq!(imu(&readings[0]).angular_velocity, [1.5, -2.25, 34.5]);
    let (_, faults) = decode(&mut *device, &[frame("00010007#01", 1.0)]);
    assert_eq!(count(&faults, Counter::DeviceFault), 1);
    // The identifiers of delivery, and those of 11 bits, are others' now.
    let (readings, faults) = decode(&mut *device, &frames(&[SAMPLE_TIME, RATE, ACCELERATION]));
    assert!(readings.is_empty() && faults.is_empty());

    // Two sensors share a bus, the second at the identifiers of the first plus 256.
    let mine = listener("xsens_mti", "", &[]).claims().to_vec();
    let other = crate::rig::options("xsens_mti", "").device(&spec(0x100, Mode::Listen, &[]));
    let other = other.unwrap().claims().to_vec();
    assert!(
        mine.iter()
            .all(|a| a.exclusive && other.iter().all(|b| !a.overlaps(b)))
    );
    assert_eq!(other[0].id, Id::standard(0x105));
}

/// A reading with this status word, of a sample with acceleration [9.8125, -0.25, -98.5], angular
/// velocity [1.5, -2.25, 34.5] and the other quantities of `keys`.
fn judged(keys: &str, word: u32) -> (Quality, [u32; 2]) {
    let mut sent = frames(&[STATUS_GOOD, QUATERNION, RATE, ACCELERATION, FIELD]);
    sent[0] = Frame::new(Id::standard(0x11), &word.to_be_bytes());
    let (readings, faults) = decode(&mut *listener("xsens_mti", keys, &[]), &sent);
    assert_eq!(readings.len(), 1, "{faults:?}");
    let counts = [Counter::DeviceFault, Counter::Saturated].map(|c| count(&faults, c));
    (readings[0].quality, counts)
}

/// The bits as cantools sets them, one signal at a time.
#[test]
fn the_status_word_decides_over_the_quality() {
    const ALL: &str = r#"
        quantities = ["status", "orientation", "angular_velocity", "acceleration",
                      "magnetic_field"]
        magnetic_unit = 1.0
    "#;
    const SOME: &str = r#"quantities = ["status", "acceleration"]"#;
    let fault = Quality::DEVICE_FAULT;
    let clipped = Quality::SATURATED;
    let at = |axis, end| Quality::GOOD.with_saturation(axis, end);
    let (high, low) = (Saturation::High, Saturation::Low);
    // The word, and the qualities with all quantities and with acceleration alone.
    let cases = [
        (0x0000_0003, Quality::GOOD, Quality::GOOD),
        (0x0000_0002, fault, fault),             // SelfTestOk is not set
        (0x0000_0001, fault, Quality::GOOD),     // OrientationValid is not set
        (0x0000_0103, at(0, high), at(0, high)), // ClipAccX
        (0x0000_0203, at(1, low), at(1, low)),   // ClipAccY
        (0x0000_0403, at(2, low), at(2, low)),   // ClipAccZ
        (0x0000_0803, at(3, high), Quality::GOOD), // ClipGyrX
        (0x0000_1003, at(4, low), Quality::GOOD), // ClipGyrY
        (0x0008_2003, at(5, high), Quality::GOOD), // ClipGyrZ, ClippingDetected
        (0x0000_4003, clipped, Quality::GOOD),   // ClipMagX
        (0x0008_8003, clipped, Quality::GOOD),   // ClipMagY, ClippingDetected
        (0x0001_0003, clipped, Quality::GOOD),   // ClipMagZ
        (0x0008_0003, clipped, clipped),         // ClippingDetected alone
        (0xFFF6_00FF, Quality::GOOD, Quality::GOOD), // everything else
        (0x0008_2203, at(1, low) | at(5, high), at(1, low)),
    ];
    for (word, all, some) in cases {
        for (keys, expected) in [(ALL, all), (SOME, some)] {
            let (quality, counts) = judged(keys, word);
            assert_eq!(quality.0, expected.0, "{word:08X}, {keys}: {quality}");
            let flags = [fault, clipped].map(|flag| u32::from(expected.contains(flag)));
            assert_eq!(counts, flags, "{word:08X}, {keys}");
        }
    }
    // Without the status word nothing is known.
    let sent = frames(&["011#00000000", RATE, ACCELERATION]);
    let keys = r#"quantities = ["angular_velocity", "acceleration"]"#;
    let (readings, faults) = decode(&mut *listener("xsens_mti", keys, &[]), &sent);
    assert!(faults.is_empty());
    assert_eq!(readings[0].quality, Quality::GOOD);
}

#[test]
fn a_full_output_buffer_is_a_gap() {
    let mut device = listener("xsens_mti", r#"quantities = ["acceleration"]"#, &[]);
    let sent = frames(&[
        ACCELERATION,
        "001#01",
        ACCELERATION,
        ACCELERATION,
        "001#02",
        "001#",
    ]);
    let (readings, faults) = decode(&mut *device, &sent);
    let gaps: Vec<bool> = (readings.iter())
        .map(|stamped| stamped.quality.contains(Quality::GAP_BEFORE))
        .collect();
    assert_eq!(gaps, [false, true, false]);
    assert_eq!(count(&faults, Counter::DeviceFault), 1);
    assert_eq!(count(&faults, Counter::Value), 1);
    assert_eq!(count(&faults, Counter::Length), 1);
}

#[test]
fn wrong_lengths_and_formats_are_counted() {
    use proprio_drivers::Format;
    let mut device = listener("xsens_mti", EVERYTHING, &[]);
    let right = [4, 2, 4, 8, 6, 6, 6];
    for (id, length) in [0x005, 0x006, 0x011, 0x021, 0x032, 0x034, 0x041]
        .into_iter()
        .zip(right)
    {
        for wrong in (0..=8).filter(|wrong| *wrong != length) {
            let sent = Frame::new(Id::standard(id), &[0; 8][..wrong]);
            let (readings, faults) = decode(&mut *device, &[sent]);
            assert!(readings.is_empty());
            assert_eq!(count(&faults, Counter::Length), 1, "{sent}");
        }
        let id = Id::standard(id);
        let fd = Format::Fd {
            bit_rate_switch: false,
            error_state: false,
        };
        let sent = [
            Frame::remote(id, 6),
            Frame::with_format(id, fd, &[0; 6]).unwrap(),
            Frame::with_format(id, Format::Error, &[0; 8]).unwrap(),
        ];
        let (readings, faults) = decode(&mut *device, &sent);
        assert!(readings.is_empty());
        assert_eq!(count(&faults, Counter::Length), 1);
        assert_eq!(count(&faults, Counter::Value), 1);
        assert_eq!(faults.len(), 2);
    }
}

/// The messages of samples with a counter, the letters of which name them: `C` counter, `G` angular
/// velocity, `A` acceleration, at times in periods of 10 ms. Both measure the number of the sample.
fn sequence(items: &[(&str, f64)]) -> Vec<Frame> {
    (items.iter())
        .map(|(name, periods)| {
            let number: u16 = name[1..].parse().unwrap();
            let [high, low] = number.to_be_bytes();
            let (id, data): (u16, &[u8]) = match &name[..1] {
                "C" => (0x006, &[high, low]),
                "G" => (0x032, &[high, low, high, low, high, low]),
                "A" => (0x034, &[high, low, high, low, high, low]),
                _ => unreachable!(),
            };
            let t = Nanos::from_seconds(periods * 0.01);
            Frame::new(Id::standard(id), data).at(t, StampKind::Software)
        })
        .collect()
}

/// The numbers of the readings, and whether each follows a gap; the readings that were dropped, and
/// those that the counter tells of. All parts of a reading must have its number.
fn numbers(keys: &str, frames: &[Frame]) -> (Vec<u32>, Vec<bool>, u32, u32) {
    let (readings, faults) = decode(&mut *listener("xsens_mti", keys, &[]), frames);
    let mut read = (Vec::new(), Vec::new());
    for stamped in &readings {
        let imu = imu(stamped);
        let [rate, ..] = imu.angular_velocity.map(|value| value * 512.0);
        let [acceleration, ..] = imu.proper_acceleration.map(|value| value * 256.0);
        assert_eq!(rate, acceleration, "a reading of two samples");
        if stamped.quality.contains(Quality::DEVICE_COUNTER) {
            assert_eq!(rate, f64::from(stamped.device_counter));
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        read.0.push(rate as u32);
        read.1.push(stamped.quality.contains(Quality::GAP_BEFORE));
    }
    let [dropped, lost] = [Counter::Unpaired, Counter::Lost].map(|c| count(&faults, c));
    (read.0, read.1, dropped, lost)
}

const COUNTED: &str = r#"quantities = ["group_counter", "angular_velocity", "acceleration"]"#;
const UNCOUNTED: &str = r#"quantities = ["angular_velocity", "acceleration"]"#;

/// Samples `from..to`, complete, at their times.
fn whole(from: u16, to: u16) -> Vec<(String, f64)> {
    (from..to)
        .flat_map(|number| {
            let t = f64::from(number);
            [
                (format!("C{number}"), t),
                (format!("G{number}"), t + 0.01),
                (format!("A{number}"), t + 0.02),
            ]
        })
        .collect()
}

/// Samples 1 to 9 without the messages `without`, and with `late` at another time.
fn disturbed(without: &[&str], late: Option<(&str, f64)>) -> Vec<Frame> {
    let mut items = whole(1, 10);
    items.retain(|(name, _)| !without.contains(&name.as_str()));
    if let Some((name, t)) = late {
        items.retain(|(other, _)| other != name);
        items.push((name.to_owned(), t));
    }
    items.sort_by(|(_, a), (_, b)| a.total_cmp(b));
    let items: Vec<(&str, f64)> = items.iter().map(|(name, t)| (name.as_str(), *t)).collect();
    sequence(&items)
}

#[test]
fn a_message_that_is_missing_costs_its_sample_and_the_next() {
    // The numbers that are read, the samples dropped for what was missing, those lost.
    let cases: [(&[&str], &[u32], u32, u32); 7] = [
        (&[], &[1, 2, 3, 4, 5, 6, 7, 8, 9], 0, 0),
        // The first: the others are alone, and nothing is in doubt.
        (&["C4"], &[1, 2, 3, 5, 6, 7, 8, 9], 1, 1),
        (&["G4"], &[1, 2, 3, 6, 7, 8, 9], 2, 2),
        (&["A4"], &[1, 2, 3, 6, 7, 8, 9], 2, 2),
        (&["C4", "G4", "A4"], &[1, 2, 3, 5, 6, 7, 8, 9], 0, 1),
        // The last of one and the first of the next: not their remains together.
        (&["A4", "C5"], &[1, 2, 3, 6, 7, 8, 9], 1, 2),
        (&["A4", "C5", "G5"], &[1, 2, 3, 6, 7, 8, 9], 1, 2),
    ];
    for (without, expected, dropped, lost) in cases {
        let (read, gaps, in_part, missed) = numbers(COUNTED, &disturbed(without, None));
        assert_eq!(read, expected, "without {without:?}");
        assert_eq!((in_part, missed), (dropped, lost), "without {without:?}");
        // What was read and what was lost is what was sent, and each gap is marked.
        assert_eq!(read.len() as u32 + missed, 9, "without {without:?}");
        let jumps: Vec<bool> = (read.iter().zip([0].iter().chain(&read)))
            .map(|(number, last)| *number != last + 1)
            .collect();
        assert_eq!(gaps, jumps, "without {without:?}");
    }
}

#[test]
fn a_pair_without_a_counter_is_never_of_two_samples() {
    let read_without = |without: &[&str], late| {
        let mut frames = disturbed(without, late);
        frames.retain(|frame| frame.id != Id::standard(6));
        numbers(UNCOUNTED, &frames)
    };
    let (read, _, dropped, lost) = read_without(&[], None);
    assert_eq!((read.len(), dropped, lost), (9, 0, 0));
    let (read, _, dropped, _) = read_without(&["G4"], None);
    assert_eq!(
        (read.as_slice(), dropped),
        (&[1, 2, 3, 5, 6, 7, 8, 9][..], 1)
    );
    let (read, gaps, dropped, _) = read_without(&["A4"], None);
    assert_eq!((read.as_slice(), dropped), (&[1, 2, 3, 6, 7, 8, 9][..], 2));
    assert_eq!(gaps, [false, false, false, true, false, false, false]);
    // Acceleration 4 after angular velocity 5, and after both of sample 5.
    let (read, _, dropped, _) = read_without(&[], Some(("A4", 5.015)));
    assert_eq!((read.as_slice(), dropped), (&[1, 2, 3, 6, 7, 8, 9][..], 2));
    let (read, _, _, _) = read_without(&["A5"], Some(("A4", 5.015)));
    assert_eq!(read, [1, 2, 3, 6, 7, 8, 9]);
}

#[test]
fn a_late_or_repeated_message_is_never_used_for_another_sample() {
    for late in ["C4", "G4", "A4"] {
        for t in [4.3, 4.6, 4.995, 5.005, 5.015, 5.03, 5.4, 5.995] {
            let (read, _, dropped, lost) = numbers(COUNTED, &disturbed(&[], Some((late, t))));
            assert!(read.len() >= 6, "{late} at {t}: {read:?}");
            assert_eq!(read.len() as u32 + lost, 9, "{late} at {t}");
            assert!(dropped >= lost, "{late} at {t}");
        }
    }
    // Two periods late, a message before the last shows itself by the one that it precedes.
    let (read, ..) = numbers(COUNTED, &disturbed(&[], Some(("G4", 6.005))));
    assert_eq!(read, [1, 2, 3, 7, 8, 9]);
    for again in ["C4", "G4", "A4"] {
        for t in [4.005, 4.015, 4.025, 4.9] {
            let mut frames = disturbed(&[], None);
            frames.extend(sequence(&[(again, t)]));
            frames.sort_by_key(|frame| frame.t);
            let (read, _, _, lost) = numbers(COUNTED, &frames);
            assert!(read.len() >= 7, "{again} at {t}: {read:?}");
            assert_eq!(read.len() as u32 + lost, 9, "{again} at {t}");
        }
    }
}

#[test]
fn a_stream_may_be_joined_anywhere() {
    for without in [&["C1"][..], &["C1", "G1"], &["C1", "G1", "A1"]] {
        let (read, gaps, dropped, lost) = numbers(COUNTED, &disturbed(without, None));
        assert_eq!(read, [2, 3, 4, 5, 6, 7, 8, 9]);
        assert_eq!(
            (gaps[0], dropped, lost),
            (false, 0, 0),
            "without {without:?}"
        );
    }
}

#[test]
fn the_counter_and_the_time_overflow() {
    let keys = r#"
        quantities = ["sample_time", "group_counter", "acceleration"]
        sample_time_unit_us = 1
    "#;
    let mut device = listener("xsens_mti", keys, &[]);
    let sent = frames(&[
        "005#FFFFD8F0",
        "006#FFFF",
        ACCELERATION, // 10 ms before the overflow
        "005#00000000",
        "006#0000",
        ACCELERATION,
        "005#00002710",
        "006#0003",
        ACCELERATION, // two samples are lost
        "005#00002710",
        "006#0003",
        ACCELERATION, // it comes twice
        "005#00000064",
        "006#0004",
        ACCELERATION, // the clock has started again
    ]);
    let (readings, faults) = decode(&mut *device, &sent);
    let times: Vec<Nanos> = readings.iter().map(|stamped| stamped.device_time).collect();
    let overflow = 1_i64 << 32;
    assert_eq!(
        times,
        [overflow - 10_000, overflow, overflow + 10_000, 100].map(Nanos::from_micros)
    );
    let counters: Vec<u32> = readings
        .iter()
        .map(|stamped| stamped.device_counter)
        .collect();
    assert_eq!(counters, [0xFFFF, 0, 3, 4]);
    assert_eq!(count(&faults, Counter::Lost), 2);
    assert_eq!(count(&faults, Counter::Unexpected), 1);
    assert_eq!(count(&faults, Counter::Unpaired), 0);
    let gaps: Vec<bool> = (readings.iter())
        .map(|stamped| stamped.quality.contains(Quality::GAP_BEFORE))
        .collect();
    assert_eq!(gaps, [false, false, true, false]);
}

/// After a restart of the link the sensor may have been reset: half a sample is forgotten, and so
/// are its clock and its counter.
#[test]
fn a_restart_begins_anew() {
    let keys = r#"
        quantities = ["sample_time", "group_counter", "acceleration"]
        sample_time_unit_us = 1
    "#;
    let mut device = listener("xsens_mti", keys, &[]);
    let sent = [
        ["005#60000000", "006#0005", ACCELERATION],
        // Five eighths of the range ahead, or three back.
        ["005#00000000", "006#0006", ACCELERATION],
        ["005#60000000", "006#0007", ACCELERATION],
        ["005#C0000000", "006#0008", ACCELERATION],
    ];
    let (readings, _) = decode(&mut *device, &frames(&sent.concat()));
    let times: Vec<i64> = (readings.iter())
        .map(|stamped| stamped.device_time.0 / 1000)
        .collect();
    assert_eq!(times, [0x6000_0000, 0, 0x6000_0000, 0xC000_0000]);
    decode(&mut *device, &frames(&["005#C0000001", "006#0009"]));
    device.restart(Nanos::from_millis(5));
    let sent = [
        frame(ACCELERATION, 0.15),
        frame("005#10000000", 10.0),
        frame("006#0002", 10.1),
        frame(ACCELERATION, 10.2),
    ];
    let (readings, faults) = decode(&mut *device, &sent);
    assert!(faults.is_empty(), "{faults:?}");
    assert_eq!(readings[0].device_time, Nanos::from_micros(0x1000_0000));
    assert_eq!(
        readings[0].quality,
        Quality::DEVICE_COUNTER | Quality::GAP_BEFORE
    );
}

#[test]
fn a_quantity_may_be_named_twice() {
    let keys = r#"quantities = ["acceleration", "acceleration"]"#;
    assert_eq!(listener("xsens_mti", keys, &[]).claims().len(), 2);
}

fn at_rest() -> (u8, Reading) {
    let imu = Imu {
        proper_acceleration: [0.0, 0.0, 9.8125],
        angular_velocity: [0.5, 0.0, -0.5],
        ..Imu::ABSENT
    };
    (0, Reading::Imu(imu))
}

#[test]
fn a_sensor_is_watched_and_never_commanded() {
    let keys = "period_ms = 5.0\nquantities = [\"sample_time\", \"group_counter\", \
                \"angular_velocity\", \"acceleration\"]";
    let mut rig = Rig::new("xsens_mti", keys, &[], at_rest());
    rig.run(100);
    assert_eq!(
        (rig.device.state(), rig.readings.len()),
        (State::Streaming, 20)
    );
    assert_eq!(
        imu(&rig.readings[0]).proper_acceleration,
        [0.0, 0.0, 9.8125]
    );
    // Its clock ticks as its samples do.
    let passed = rig.readings[19].device_time - rig.readings[0].device_time;
    assert_eq!(passed, Nanos::from_millis(95));
    rig.board_loses = Box::new(|_, _| true);
    rig.run(200);
    assert_eq!(
        rig.states,
        [State::Starting, State::Streaming, State::Silent]
    );
    assert_eq!(rig.count(Counter::Silences), 1);
    rig.board_loses = Box::new(|_, _| false);
    rig.run(50);
    assert!(rig.readings[20].quality.contains(Quality::GAP_BEFORE));
    assert!(!rig.readings[21].quality.contains(Quality::GAP_BEFORE));
    // After a silence the counter may have started again: it tells of no loss.
    assert_eq!(rig.count(Counter::Lost), 0);
    assert_eq!(rig.count(Counter::Unpaired), 0);
    let before = rig.readings.len();
    rig.device.restart(rig.now);
    rig.run(10);
    assert!(rig.readings[before].quality.contains(Quality::GAP_BEFORE));
    rig.device.stop(rig.now);
    rig.run(30);
    assert_eq!(rig.device.state(), State::Stopped);
    assert_eq!(rig.sent, [""; 0]);
}

#[test]
fn a_sensor_that_is_not_there_is_silent() {
    let mut rig = Rig::new("xsens_mti", "", &[], at_rest());
    rig.board_loses = Box::new(|_, _| true);
    rig.run(3000);
    assert_eq!(rig.states, [State::Starting, State::Silent]);
}

#[test]
fn wrong_keys_are_refused() {
    let refused = |keys: &str, address| {
        let spec = spec(address, Mode::Listen, &[]);
        let options = options("xsens_mti", keys);
        let of_device = options.device(&spec).map(|_| ()).unwrap_err().to_string();
        let of_board = options.board(&spec).map(|_| ()).unwrap_err().to_string();
        assert_eq!(of_device, of_board);
        of_device
    };
    for quantities in [
        "[]",
        "[\"sample_time\", \"status\"]",
        "[\"acceleration\", \"error\"]",
    ] {
        let error = refused(&format!("quantities = {quantities}"), 0);
        assert!(error.starts_with("quantities must be a list"), "{error}");
    }
    for (keys, expected) in [
        (
            "period_ms = 0.4",
            "period_ms = 0.4 must be from 0.5 to 1000",
        ),
        (
            "period_ms = 1001.0",
            "period_ms = 1001 must be from 0.5 to 1000",
        ),
        (
            "period_ms = nan",
            "period_ms = NaN must be from 0.5 to 1000",
        ),
        (
            "sample_time_unit_us = 10",
            "sample_time_unit_us = 10 must be 1 or 100",
        ),
        (
            "quaternion_one = 1",
            "quaternion_one = 1 must be 32767 or 32768",
        ),
        (
            "magnetic_unit = 0.0",
            "magnetic_unit = 0 must be above 0, at most 1",
        ),
        (
            "quantities = [\"magnetic_field\"]",
            "magnetic_unit is missing: it is needed together with magnetic_field",
        ),
        (
            "identifiers = { acceleration = 0x032 }",
            "identifiers must be different for each message",
        ),
        (
            "identifiers = { error = 0x034 }",
            "identifiers must be different for each message",
        ),
        (
            "identifiers = { acceleration = 0x800 }",
            "identifiers = 2048 must be an identifier",
        ),
    ] {
        assert_eq!(refused(keys, 0), expected);
    }
    let least = 0;
    let (address, most) = (0x7CC, 0x7FF - 0x034);
    let error = SpecError::Address {
        address,
        least,
        most,
    };
    assert_eq!(refused("", address), error.to_string());
    assert!(
        options("xsens_mti", "")
            .device(&spec(most, Mode::Listen, &[]))
            .is_ok()
    );
    assert!(
        options("xsens_mti", "extended = true")
            .device(&spec(0x800, Mode::Listen, &[]))
            .is_ok()
    );
}

#[test]
fn what_a_sensor_cannot_send_is_refused() {
    let mut out = Frames::new();
    let mut board = board("xsens_mti", EVERYTHING, &[]);
    let mut refused = |output, reading: &Reading| {
        let refused = board
            .encode(output, reading, Quality::GOOD, &mut out)
            .unwrap_err();
        assert!(out.is_empty());
        refused
    };
    let gauges = Reading::Gauges(Gauges { counts: [0; 6] });
    let temperature = Reading::Temperature(Temperature { celsius: 20.0 });
    assert_eq!(refused(0, &gauges), EncodeError::Kind);
    assert_eq!(refused(0, &temperature), EncodeError::Kind);
    assert_eq!(refused(1, &at_rest().1), EncodeError::Output(1));
    // The field and the orientation are absent.
    assert_eq!(refused(0, &at_rest().1), EncodeError::NotFinite);
}

#[test]
fn the_sensor_limits_what_it_sends() {
    let imu = Imu {
        proper_acceleration: [1e3, -1e3, 0.0],
        angular_velocity: [1e9, -64.1, 63.99],
        magnetic_field: [1.0, -1.0, 0.0],
        orientation: [1.0, -1.0, 0.5, 2.0],
        ..Imu::ABSENT
    };
    let mut board = board("xsens_mti", EVERYTHING, &[]);
    let sent = encode(&mut *board, 0, &Reading::Imu(imu), Quality::GOOD);
    let texts: Vec<String> = sent.iter().map(ToString::to_string).collect();
    assert_eq!(
        texts,
        [
            "005#00000000",
            "006#0000",
            "011#00000003",
            "021#7FFF800140007FFF",
            "032#7FFF80007FFB",
            "034#7FFF80000000",
            "041#7FFF80000000",
        ]
    );
    // Half a second later, at 100 Hz and 100 us.
    for _ in 0..49 {
        encode(&mut *board, 0, &Reading::Imu(imu), Quality::GOOD);
    }
    let sent = encode(&mut *board, 0, &Reading::Imu(imu), Quality::GOOD);
    assert_eq!(sent[0].to_string(), "005#00001388");
    assert_eq!(sent[1].to_string(), "006#0032");
}

/// Without an orientation, whose filter is a matter of its own.
#[test]
fn a_simulated_fault_is_one_of_the_self_test() {
    let keys = r#"quantities = ["status", "acceleration"]"#;
    let reading = at_rest().1;
    for (quality, status) in [
        (Quality::GOOD, STATUS_GOOD),
        (Quality::DEVICE_FAULT, "011#00000002"),
    ] {
        let sent = encode(&mut *board("xsens_mti", keys, &[]), 0, &reading, quality);
        assert_eq!(sent[0].to_string(), status);
        let (readings, _) = decode(&mut *listener("xsens_mti", keys, &[]), &sent);
        assert_eq!(readings[0].quality, quality);
    }
}

/// Half a step plus floating-point rounding.
fn near(a: f64, b: f64, step: f64) -> bool {
    (a - b).abs() <= step * 0.5 + 1e-12 * (a.abs() + b.abs())
}

proptest! {
    #[test]
    fn samples_are_read_back(
        acceleration in uniform3(-127.9_f64..127.9), rate in uniform3(-63.9_f64..63.9),
        field in uniform3(-1e-3_f64..1e-3),
        orientation in proptest::array::uniform4(-1.0_f64..1.0),
        marks in proptest::array::uniform6(any::<bool>()), fault: bool,
    ) {
        let imu_sent = Imu {
            proper_acceleration: acceleration, angular_velocity: rate, magnetic_field: field,
            orientation, ..Imu::ABSENT
        };
        let values = acceleration.into_iter().chain(rate);
        let mut quality = if fault { Quality::DEVICE_FAULT } else { Quality::GOOD };
        for (axis, (mark, value)) in (0..).zip(marks.into_iter().zip(values)) {
            let end = if value < 0.0 { Saturation::Low } else { Saturation::High };
            // A value that is sent as zero has no sign.
            if mark && value.abs() > 0.01 {
                quality = quality.with_saturation(axis, end);
            }
        }
        let sent = encode(
            &mut *board("xsens_mti", EVERYTHING, &[]), 0, &Reading::Imu(imu_sent), quality,
        );
        let (readings, _) = decode(&mut *listener("xsens_mti", EVERYTHING, &[]), &sent);
        prop_assert_eq!(readings.len(), 1);
        prop_assert_eq!(readings[0].quality, quality | Quality::DEVICE_COUNTER);
        let back = imu(&readings[0]);
        for axis in 0..3 {
            prop_assert!(near(back.proper_acceleration[axis], acceleration[axis], 1.0 / 256.0));
            prop_assert!(near(back.angular_velocity[axis], rate[axis], 1.0 / 512.0));
            prop_assert!(near(back.magnetic_field[axis], field[axis], 50e-6 / 1024.0));
        }
        for (a, b) in back.orientation.into_iter().zip(orientation) {
            prop_assert!(near(a, b, 1.0 / 32767.0));
        }
    }

    /// Whatever is lost, no reading is of two samples, and the counter tells of the rest.
    #[test]
    fn losses_never_mix_samples(lost in proptest::collection::vec(0..4_u8, 120)) {
        let names = whole(1, 41);
        let items: Vec<(&str, f64)> = (names.iter().zip(&lost))
            .filter(|(_, lost)| **lost != 0)
            .map(|((name, t), _)| (name.as_str(), *t))
            .collect();
        let frames = sequence(&items);
        let (read, _, _, missed) = numbers(COUNTED, &frames);
        if let (Some(first), Some(last)) = (read.first(), read.last()) {
            prop_assert_eq!(read.len() as u32 + missed, last - first + 1);
        }
        let pairs: Vec<Frame> =
            frames.into_iter().filter(|frame| frame.id != Id::standard(6)).collect();
        numbers(UNCOUNTED, &pairs);
    }
}
