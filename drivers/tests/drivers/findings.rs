//! What speaks for a device and what against it, family by family, in frames that are written by
//! hand.

use crate::rig::{FD, frame};
use proprio_drivers::{Certainty, Finding, Frame, Id, Traffic, questions, recognise};
use proprio_topics::{Nanos, StampKind};

/// What was heard, if these frames were.
pub(crate) fn traffic(frames: &[Frame]) -> Traffic {
    let mut traffic = Traffic::new();
    frames.iter().for_each(|frame| traffic.on_frame(frame));
    traffic
}

/// The surest finding of `driver`.
fn found(driver: &str, frames: &[Frame]) -> Option<Finding> {
    let mut findings = recognise(&traffic(frames)).into_iter();
    findings.find(|found| found.driver == driver)
}

fn bits(driver: &str, frames: &[Frame]) -> f64 {
    found(driver, frames).map_or(0.0, |found| found.bits)
}

/// The value of key `name`.
fn key<'f>(found: &'f Finding, name: &str) -> Option<&'f str> {
    let key = found.keys.iter().find(|key| key.name == name)?;
    Some(&key.value)
}

/// Frames without stamps.
fn unstamped(frames: &[&str]) -> Vec<Frame> {
    let frame = |text: &&str| frame(text, 0.0).at(Nanos::ZERO, StampKind::None);
    frames.iter().map(frame).collect()
}

/// `count` frames each of these texts, with this period \[ms\].
fn periodic(texts: &[&str], period: f64, count: u16) -> Vec<Frame> {
    let turns = (0..count).map(|turn| 1000.0 + f64::from(turn) * period);
    turns
        .flat_map(|ms| texts.iter().map(move |text| frame(text, ms)))
        .collect()
}

const SLOPE: &str = "0CF02980#0000000000000000";
const ACCELERATION: &str = "08F02D80#0000000000000000";
const RATE: &str = "0CF02A80#0000000000000000";

/// The thresholds that the top of `recognise.rs` states.
#[test]
fn certainty_follows_from_the_bits() {
    let openimu = found("openimu", &unstamped(&[SLOPE, RATE])).unwrap();
    for (bits, certainty) in [
        (-500.0, None),
        (-3.2, None),
        (-3.1, Some(Certainty::Possible)),
        (6.6, Some(Certainty::Possible)),
        (6.7, Some(Certainty::Likely)),
        (19.9, Some(Certainty::Likely)),
        (20.0, Some(Certainty::Certain)),
        (500.0, Some(Certainty::Certain)),
    ] {
        let certainty_if = |guess| {
            Finding {
                bits,
                guess,
                ..openimu.clone()
            }
            .certainty()
        };
        assert_eq!(certainty_if(false), certainty, "{bits}");
        assert_eq!(
            certainty_if(true),
            certainty.map(|_| Certainty::Possible),
            "{bits}"
        );
    }
    // The words are probabilities, and are printed as such.
    for (bits, percent) in [
        (-3.17, "10 %"),
        (0.0, "50 %"),
        (6.7, "99.05 %"),
        (13.3, "99.9901 %"),
        (30.0, ">99.9999 %"),
    ] {
        let finding = Finding {
            bits,
            ..openimu.clone()
        };
        let odds = bits.exp2();
        assert!((finding.probability() - odds / (1.0 + odds)).abs() < 1e-12);
        assert_eq!(finding.percent(), percent);
    }
}

/// Of the frames that are kept, one in twenty may be another.
#[test]
fn a_few_odd_frames_do_not_refute_a_device() {
    for count in 4..60 {
        let mut frames = periodic(&[SLOPE, RATE], 10.0, count);
        frames[1] = frame("0CF02A80#00", 1000.0);
        // The odd one, and the first of the others, are kept as beginnings too: 2 of 40 are odd.
        let is_few = count >= 38;
        assert_eq!(found("openimu", &frames).is_some(), is_few, "{count}");
    }
}

/// The second half follows the first within an eighth of the period, nine times of ten.
#[test]
fn halves_that_come_together_count() {
    // 21 readings of a JR3 board, one each 80 ms, of which the first does not count: it may have
    // begun before anybody listened. `late` moments come after 40 ms, the others after `gap`.
    let jr3 = |gap: f64, late: u16| {
        let reading = |n: u16| {
            let t = 1000.0 + 80.0 * f64::from(n);
            let gap = if (1..=late).contains(&n) { 40.0 } else { gap };
            let [a, b] = n.to_le_bytes();
            let texts = ["601", "681"].map(|id| format!("{id}#000000000000{a:02X}{b:02X}"));
            [frame(&texts[0], t), frame(&texts[1], t + gap)]
        };
        (0..=20).flat_map(reading).collect::<Vec<Frame>>()
    };
    let without = |frame: &Frame| frame.at(Nanos::ZERO, StampKind::None);
    let unstamped: Vec<Frame> = jr3(1.0, 0).iter().map(without).collect();
    let least = bits("jr3_can", &unstamped);
    for (gap, late, more) in [
        (1.0, 0, 2.0),
        (10.0, 0, 2.0),
        (10.1, 0, 0.0),
        (40.0, 0, 0.0),
        (1.0, 2, 2.0),
        (1.0, 3, 0.0),
        (1.0, 10, 0.0),
    ] {
        let is = bits("jr3_can", &jr3(gap, late)) - least;
        assert!((is - more).abs() < 1e-9, "{gap} {late}: {is}");
    }
}

/// A byte that counts up by one, nine times of ten, speaks for an IMU.
#[test]
fn a_counter_is_evidence() {
    let imu = |counts: &[u8]| {
        let texts = counts
            .iter()
            .map(|count| format!("533#{count:02X}00000000000000"));
        let frames = texts.map(|text| frame(&text, 0.0)).collect::<Vec<_>>();
        bits("icub_imu", &frames)
    };
    // 21 counts from 250 on, of which the first `jumps` go on by 20.
    let jumping = |jumps: u8| {
        let count = |n: u8| 250_u8.wrapping_add(n).wrapping_add(19 * n.min(jumps));
        (0..=20).map(count).collect::<Vec<u8>>()
    };
    let twice: Vec<u8> = (0..=20).map(|n| n / 2).collect();
    let in_twos: Vec<u8> = (0..=20).map(|n| 2 * n).collect();
    for (counts, more) in [
        (&jumping(0)[..], 5.0),
        (&jumping(2), 5.0),
        (&jumping(3), 0.0),
        (&jumping(10), 0.0),
        (&jumping(0)[..4], 5.0),
        (&jumping(0)[..3], 0.0),
        (&twice, 5.0),
    ] {
        let is = imu(counts) - imu(&in_twos[..counts.len()]);
        assert!((is - more).abs() < 1e-9, "{counts:?}: {is}");
    }
}

/// A board that may have a skin, or encoders, or not, is found as such only if it sends them.
#[test]
fn an_mtb4_is_what_it_sends() {
    let answer = "730#FF0B010203";
    let drivers = |frames: &[&str]| {
        let findings = recognise(&traffic(&unstamped(frames)));
        let mut drivers: Vec<&str> = findings.iter().map(|found| found.driver).collect();
        drivers.sort_unstable();
        drivers
    };
    assert_eq!(drivers(&[answer]), ["icub_imu"]);
    assert_eq!(
        drivers(&[answer, "432#4000000000000000"]),
        ["icub_imu", "icub_skin"]
    );
}

/// What a person has to fill in is said; what is as found has no note.
#[test]
fn placeholders_are_explained() {
    for (driver, texts, name, is_placeholder) in [
        (
            "cubemars",
            &["00002968#0000000000000000"][..],
            "model",
            true,
        ),
        ("cubemars", &["00002968#0000000000000000"], "mode", false),
        ("odrive", &["021#0000000001000000"], "firmware", true),
        ("openimu", &[SLOPE, RATE], "quantities", false),
    ] {
        let found = found(driver, &unstamped(texts)).unwrap();
        let key = found.keys.iter().find(|key| key.name == name).unwrap();
        assert_eq!(!key.note.is_empty(), is_placeholder, "{found:?}");
    }
}

/// A reply is from one of 127 controllers to one of 128 hosts, in the shortest identifier.
#[test]
fn a_moteus_is_a_controller_that_replies_to_a_host() {
    let with = |id, data: &[u8]| Frame::with_format(id, FD, data).unwrap();
    let reply = |id| with(id, &[0x23, 0x00, 0x0A, 0x00, 0x00, 0x50, 0x50, 0x50]);
    for (id, controller) in [
        (Id::standard(0x100), Some((1, None))),
        (Id::standard(0x107), Some((1, Some("7")))),
        (Id::standard(0x17F), Some((1, Some("127")))),
        (Id::standard(0x180), None),
        (Id::standard(0x007), None),
        (Id::extended(0x107), None),
        (Id::extended(0x7F00), Some((127, None))),
        (Id::extended(0x7F7F), Some((127, Some("127")))),
        (Id::extended(0x8000), None),
        (Id::extended(0x1_0100), None),
    ] {
        let found = found("moteus", &[reply(id)]);
        let named = found
            .as_ref()
            .map(|found| (found.address, key(found, "host")));
        assert_eq!(named, controller, "{id}");
    }
    // Its host asks, and tells no errors.
    let seen = |query: &[u8]| {
        let query = with(Id::extended(0x8001), query);
        found("moteus", &[query, reply(Id::standard(0x100))]).is_some()
    };
    assert!(seen(&[0x11, 0x00, 0x1F, 0x01, 0x13, 0x0D]));
    for reply in [0x21, 0x30, 0x31] {
        assert!(!seen(&[reply, 0x00, 0x01]), "{reply:x}");
    }
}

const GAUGES: [&str; 2] = ["200#0000000100020003", "201#000400050006"];

/// Requests alone say nothing; units, serial numbers and gauges do.
#[test]
fn an_ati_board_is_known_by_its_answers() {
    let found = |texts: &[&str]| found("ati_netcanoem", &unstamped(texts));
    assert_eq!(found(&["200#", "205#", "207#", "208#"]), None);
    assert!(found(&GAUGES).is_some());
    for (units, is_one) in [
        ("208#0203", true),
        ("208#0606", true),
        ("208#0207", false),
        ("208#0703", false),
        ("208#0000", false),
        ("208#020300", false),
    ] {
        assert_eq!(found(&["208#", units]).is_some(), is_one, "{units}");
        // Only a board that has told its units is asked further.
        let asks = questions(&traffic(&unstamped(&[units])), &["ati_netcanoem"]);
        let further = [0x205, 0x207].map(|id| asks.contains(&Frame::new(Id::standard(id), &[])));
        assert_eq!(further, [is_one; 2], "{units}");
    }
    for (serial, letters) in [
        // FT12345, FT-12 and zeros, FT12 and spaces.
        ("205#46543132333435", Some("FT12345")),
        ("205#46542D3132000000", Some("FT-12")),
        ("205#4654313220202020", Some("FT12")),
        // Too short, a sign first, letters after a zero, signs, and none at all.
        ("205#465431", None),
        ("205#2D465431", None),
        ("205#46540031", None),
        ("205#465431322B", None),
        ("205#00000000", None),
    ] {
        let found = found(&["208#0203", "205#", serial]);
        let what = found.map(|found| found.what);
        let expected = letters.map(|l| format!("ATI sensor at a NETCANOEM board, serial {l}"));
        assert_eq!(what, expected, "{serial}");
    }
}

/// The readings' period is that of the answers, however often they are asked for.
#[test]
fn the_period_of_an_ati_board_is_that_of_its_answers() {
    let mut frames = Vec::new();
    for turn in 0..20 {
        let t = 1000.0 + 9.0 * f64::from(turn);
        let asked = [0.0, 3.0, 6.0].map(|ms| frame("200#", t + ms));
        frames.extend(asked);
        frames.extend(GAUGES.map(|text| frame(text, t + 6.5)));
    }
    let found = found("ati_netcanoem", &frames).unwrap();
    assert_eq!(key(&found, "period_ms"), Some("9"));
}

/// Replies of motors to their common host or to their own number; the last byte is an error.
#[test]
fn a_cubemars_motor_is_known_by_its_replies() {
    for (text, mode) in [
        ("000#010203040506", Some("\"mit\"")),
        ("000#0102030405060707", Some("\"mit\"")),
        ("000#0102030405060708", None),
        ("000#01020304050607", None),
        ("000#0102030405", None),
        ("005#050203040506", Some("\"mit\"")),
        ("005#060203040506", None),
        ("00002968#0001020304050607", Some("\"servo\"")),
        ("00002968#0001020304050608", None),
        ("00002968#00010203040506", None),
    ] {
        let found = found("cubemars", &periodic(&[text], 10.0, 8));
        let found_mode = found.as_ref().map(|found| key(found, "mode").unwrap());
        assert_eq!(found_mode, mode, "{text}");
        let host = found.as_ref().and_then(|found| key(found, "host_id"));
        assert_eq!(
            host,
            (text.starts_with("005") && mode.is_some()).then_some("5")
        );
    }
}

/// The first byte is a number of few motors, if there are eight times as many frames.
#[test]
fn motors_of_one_host_are_told_apart() {
    let mut frames = periodic(&["000#010000000000"], 5.0, 30);
    frames.extend(periodic(&["000#020000000000"], 20.0, 8));
    frames.sort_by_key(|frame| frame.t);
    let findings = recognise(&traffic(&frames));
    let mut motors: Vec<(u32, Option<&str>)> = findings
        .iter()
        .map(|found| (found.address, key(found, "period_ms")))
        .collect();
    motors.sort_unstable();
    assert_eq!(motors, [(1, Some("5")), (2, Some("20"))]);
    // Few numbers speak for motors, from eight times as many frames on.
    let one = |count| bits("cubemars", &periodic(&["000#010000000000"], 5.0, count));
    assert!(one(8) > one(7) + 4.0);
    let two = |count: u16| {
        let number = |n: u16| format!("000#{:02X}0000000000", n % 2 + 1);
        let frames = (0..count).map(|n| frame(&number(n), f64::from(n)));
        bits("cubemars", &frames.collect::<Vec<_>>())
    };
    assert!(two(16) > two(15) + 4.0, "{} {}", two(16), two(15));
    assert!((two(40) - two(16)).abs() < 1e-9);
}

/// Both halves of a reading with one counter, or full scales.
#[test]
fn a_jr3_board_is_known_by_its_counter_or_its_scales() {
    let force = "605#0000000000000100";
    let moment = "685#0000000000000100";
    for (texts, is_one) in [
        (&[force][..], false),
        (&[moment], false),
        (&[force, moment], true),
        (&["105#00"], false),
        (&["105#00640064006400"], true),
        (&["105#01010001000100"], true),
        (&["105#000F270F270F27"], true),
        (&["105#00102764006400"], false),
        (&["105#00640010276400"], false),
        (&["105#00640064000000"], false),
        (&["105#03640064006400"], false),
        (&[force, "105#00"], false),
        (&[force, "105#00640064006400"], true),
    ] {
        let found = found("jr3_can", &unstamped(texts));
        assert_eq!(
            found.map(|found| found.address),
            is_one.then_some(5),
            "{texts:?}"
        );
    }
    // 20 readings: the moments of `others` have a counter that no forces have.
    let bits = |others: u16| {
        let reading = |n: u16| {
            let other = n + if n < others { 100 } else { 0 };
            let text = |id, counter: u16| format!("{id}#000000000000{counter:02X}00");
            [frame(&text("605", n), 0.0), frame(&text("685", other), 0.0)]
        };
        bits("jr3_can", &(0..20).flat_map(reading).collect::<Vec<_>>())
    };
    for (others, more) in [(0, 10.0), (2, 10.0), (3, 0.0), (15, 0.0)] {
        assert!((bits(others) - bits(20) - more).abs() < 1e-9, "{others}");
    }
}

/// An axis is known by its heartbeat or by its estimates, and tells its firmware.
#[test]
fn an_odrive_is_known_by_its_heartbeat_or_its_estimates() {
    const BEAT: &str = "0A1#0000000001000000";
    const ESTIMATES: &str = "0A9#0000803F00000000";
    for (texts, what, firmware) in [
        (&[BEAT][..], "ODrive", "\"0.6\""),
        (&[ESTIMATES], "ODrive", "\"0.6\""),
        (
            &[BEAT, "0A0#0204043A00060800"],
            "ODrive 4.4, firmware 0.6.8",
            "\"0.6\"",
        ),
        (
            &[BEAT, "0A0#0203060000050600"],
            "ODrive 3.6, firmware 0.5.6",
            "\"0.5\"",
        ),
        (
            &[BEAT, ESTIMATES, "0A0#0203060000070600"],
            "ODrive",
            "\"0.6\"",
        ),
    ] {
        let found = found("odrive", &unstamped(texts)).unwrap();
        assert_eq!((found.address, found.what.as_str()), (5, what));
        assert_eq!(key(&found, "firmware"), Some(firmware), "{what}");
    }
    // A byte that is 0, one of two others, and an identifier next to one that it has.
    let least = bits("odrive", &unstamped(&[BEAT]));
    let with_beat = bits("odrive", &unstamped(&[BEAT, "0A0#0204043A00060800"]));
    assert!(
        (with_beat - least - 8.0 - 7.0 - 1.0).abs() < 1e-9,
        "{with_beat} {least}"
    );
    assert_eq!(found("odrive", &unstamped(&["0B4#0000803F00000000"])), None);
    // Who has a heartbeat is asked for its version: not who is asked for one, or sends another.
    let asks = |frames: &[Frame]| {
        let all = questions(&traffic(frames), &[]);
        all.contains(&Frame::remote(Id::standard(0x0A0), 8))
    };
    assert!(asks(&unstamped(&[BEAT])));
    assert!(!asks(&[Frame::remote(Id::standard(0x0A1), 8)]));
    assert!(!asks(&unstamped(&["0A1#00000000"])));
    assert!(!asks(&unstamped(&[ESTIMATES])));
}

/// Two groups or three, at a rate that the manual lists, within a tenth.
#[test]
fn an_openimu_is_known_by_two_groups() {
    for (texts, is_one) in [
        (&[SLOPE][..], false),
        (&[RATE], false),
        (&[SLOPE, ACCELERATION], true),
        (&[ACCELERATION, RATE], true),
        (&[SLOPE, ACCELERATION, RATE], true),
    ] {
        let found = found("openimu", &unstamped(texts));
        assert_eq!(found.is_some(), is_one, "{texts:?}");
    }
    for (ms, key_ms) in [
        (10.0, Some("10")),
        (10.8, Some("10")),
        (9.2, Some("10")),
        (11.5, None),
        (5.0, None),
        (20.0, Some("20")),
        (30.0, None),
        (52.0, Some("50")),
        (500.0, Some("500")),
        (1000.0, None),
    ] {
        let found = found("openimu", &periodic(&[SLOPE, RATE], ms, 10)).unwrap();
        assert_eq!(key(&found, "period_ms"), key_ms, "{ms}");
    }
}

/// Of the packets that begin, nine of ten are whole: their sum is right, and none is cut off.
#[test]
fn an_optoforce_unit_is_known_by_whole_packets() {
    // Force 1, 2, 3, counter 5: AA + 07 + 08 + 0A + 05 + 01 + 02 + 03 = CE.
    let first = "100#AA07080A00050000";
    let pairs = |whole: usize, second: &str| {
        let second = |n| {
            if n < whole {
                "100#00010002000300CE"
            } else {
                second
            }
        };
        let texts = (0..20).flat_map(|n| [first, second(n)]).collect::<Vec<_>>();
        found("optoforce_daq", &unstamped(&texts)).is_some()
    };
    for (whole, is_one) in [(20, true), (18, true), (17, false), (3, false), (0, false)] {
        assert_eq!(pairs(whole, "100#00010002000300CF"), is_one, "{whole}");
    }
    // The sum of a short second frame.
    let short = ["100#AA07080A00050000", "100#000100020003"];
    assert_eq!(found("optoforce_daq", &unstamped(&short)), None);
}

/// A rate that the manual lists, within a tenth.
#[test]
fn the_rate_of_a_robotous_sensor_is_measured() {
    for (ms, hz) in [
        (100.0, Some("10")),
        (50.0, Some("20")),
        (10.0, Some("100")),
        (10.5, Some("100")),
        (9.5, Some("100")),
        (7.0, None),
        (13.0, None),
        (5.0, Some("200")),
        (3.0, Some("333")),
        (2.0, Some("500")),
        (1.0, Some("1000")),
    ] {
        let data = ["001#0B00000000000000", "002#0000000000000000"];
        let found = found("robotous_rft", &periodic(&data, ms, 10)).unwrap();
        assert_eq!(key(&found, "rate_hz"), hz, "{ms}");
    }
}

/// Two quantities that it measures, or more.
#[test]
fn an_xsens_sensor_is_known_by_two_quantities() {
    let turn = "032#000000000000";
    let acceleration = "034#000000000000";
    let field = "041#000000000000";
    let count = "006#0000";
    for (texts, quantities) in [
        (&[turn][..], None),
        (&[turn, count], None),
        (
            &[turn, acceleration],
            Some("[\"angular_velocity\", \"acceleration\"]"),
        ),
        (
            &[turn, acceleration, field],
            Some("[\"angular_velocity\", \"acceleration\", \"magnetic_field\"]"),
        ),
        (
            &[count, "021#0000000000000000", field],
            Some("[\"group_counter\", \"orientation\", \"magnetic_field\"]"),
        ),
    ] {
        let found = found("xsens_mti", &unstamped(texts));
        let named = found.as_ref().and_then(|found| key(found, "quantities"));
        assert_eq!(named, quantities, "{texts:?}");
    }
}

/// Frames `id`#`first`, then a position that sweeps, its velocity, no torque, and 30 degrees twice;
/// each `period` ms.
fn mit(id: &str, first: &str, period: u16, phase: f64) -> Vec<Frame> {
    let turn = |turn: u16| {
        let ms = f64::from(turn * period);
        let angle = 0.005 * ms + phase;
        let position = (32768.0 + 9000.0 * angle.sin()) as u16;
        // 5 rad/s of 12.5 rad on 16 and of 30 rad/s on 12 bits.
        let velocity = (2047.5 + 1170.0 * angle.cos()) as u16;
        let text = format!("{id}#{first}{position:04X}{velocity:03X}8001E1E");
        frame(&text, 1000.0 + ms)
    };
    (0..2000 / period).map(turn).collect()
}

/// Each has its own period, and is told from the other by the low half of its number.
#[test]
fn damiao_motors_share_an_identifier() {
    let mut frames = [mit("000", "11", 5, 0.0), mit("000", "12", 20, 1.0)].concat();
    frames.sort_by_key(|frame| frame.t);
    let all = recognise(&traffic(&frames));
    for (address, period) in [(1, "5"), (2, "20")] {
        let one = all
            .iter()
            .find(|found| (found.driver, found.address) == ("damiao", address));
        let one = one.unwrap_or_else(|| panic!("{address}: {all:?}"));
        assert_eq!(key(one, "period_ms"), Some(period));
    }
}

#[test]
fn a_motor_in_motion_mode_sends_its_own_number() {
    let motor = found("myactuator", &mit("501", "01", 10, 0.0));
    assert_eq!(motor.map(|found| found.address), Some(1));
    assert!(found("myactuator", &mit("501", "02", 10, 0.0)).is_none());
}

/// Two bits of the identifier are the mode, of which there are three.
#[test]
fn robstride_motors_have_three_modes() {
    let motor = |id: &str| {
        found(
            "robstride",
            &periodic(&[&format!("{id}#8000800080000104")], 10.0, 50),
        )
    };
    assert!(motor("028001FD").is_some());
    assert!(motor("02C001FD").is_none());
}
