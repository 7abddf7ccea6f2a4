//! What EDS and DCF files say of CANopen encoders and drives: scales, and where process data are.

use crate::rig::{decode, frame, options, spec};
use proprio_drivers::objects::{ObjectEntry, Objects};
use proprio_drivers::{Device, Mode, Options, SpecError, StampedReading, State};
use proprio_topics::{Reading, Refusal};
use std::f64::consts::TAU;

/// A file that states these entries of this very device: index, sub-index, number.
fn file(entries: &[(u16, u8, u32)]) -> Objects {
    let entry = |&(index, sub, number): &(u16, u8, u32)| {
        let plus_node = matches!(index, 0x1800..=0x1803) && sub == 1;
        let entry = ObjectEntry {
            number,
            plus_node,
            own: true,
        };
        ((index, sub), entry)
    };
    Objects {
        entries: entries.iter().map(entry).collect(),
        ..Objects::default()
    }
}

fn described(driver: &str, keys: &str, file: Objects) -> Options {
    let mut options = options(driver, keys);
    options.describe_objects(file);
    options
}

/// Node 5 with `file`, which another program commands.
fn listener(driver: &str, keys: &str, file: Objects) -> Box<dyn Device> {
    described(driver, keys, file)
        .device(&spec(5, Mode::Listen, &[0]))
        .expect("a legal file")
}

/// Position \[turns\] and velocity \[turns/s\] of each joint's reading.
fn turns(readings: &[StampedReading]) -> Vec<(f64, f64)> {
    let joint = |stamped: &StampedReading| match stamped.reading {
        Reading::Joint(joint) => Some((joint.position / TAU, joint.velocity / TAU)),
        _ => None,
    };
    readings.iter().filter_map(joint).collect()
}

#[test]
fn the_key_names_the_file() {
    for driver in ["canopen_encoder", "canopen_drive"] {
        let named = options(driver, "eds = \"left.dcf\"");
        assert_eq!(named.eds(), Some("left.dcf"));
    }
}

#[test]
fn the_file_of_another_node_is_refused() {
    for driver in ["canopen_encoder", "canopen_drive"] {
        let build = |node| {
            let file = Objects {
                node: Some(node),
                ..file(&[(0x6501, 0, 4096)])
            };
            let spec = spec(5, Mode::Listen, &[0]);
            described(driver, "", file).device(&spec).map(|_| ())
        };
        assert_eq!(build(5), Ok(()));
        assert!(matches!(build(6), Err(SpecError::Description(_))));
    }
}

/// Bit 2 of object 6000 decides between 6001 and 6501.
#[test]
fn an_encoder_has_the_counts_per_turn_of_its_file() {
    for (parameters, counts) in [(0b011, 4096), (0b100, 1000), (0b111, 1000)] {
        let entries = [
            (0x6000, 0, parameters),
            (0x6001, 0, 1000),
            (0x6501, 0, 4096),
        ];
        let mut device = listener("canopen_encoder", "", file(&entries));
        let (readings, _) = decode(&mut *device, &[frame("185#64000000", 1.0)]);
        let position = turns(&readings)[0].0;
        assert!((position - 100.0 / f64::from(counts)).abs() < 1e-12);
    }
}

/// With `configure = false`: TPDO 2 has 16 bits of something else, then the position.
#[test]
fn a_file_tells_where_the_position_of_an_encoder_is() {
    let with = |id: u32, transmission: u32| {
        file(&[
            (0x6501, 0, 100),
            (0x1800, 1, 0x8000_0180),
            (0x1801, 1, id),
            (0x1801, 2, transmission),
            (0x1A01, 0, 2),
            (0x1A01, 1, 0x6030_0110),
            (0x1A01, 2, 0x6004_0020),
        ])
    };
    let keys = "configure = false";
    let sync = frame("080#", 10.0);
    let answer = "285#FFFF19000000";
    for (transmission, acquired) in [(1, 10.0), (240, 10.0), (254, 10.4)] {
        let mut device = listener("canopen_encoder", keys, with(0x280, transmission));
        let (readings, _) = decode(&mut *device, &[sync, frame(answer, 10.4)]);
        assert_eq!(turns(&readings)[0].0, 0.25);
        assert_eq!(readings[0].acquired, frame("0#", acquired).t);
    }
    // An extended identifier: bit 29 of object 1801 sub 1.
    let mut device = listener("canopen_encoder", keys, with(0x2001_0280, 254));
    let (readings, _) = decode(&mut *device, &[frame("00010285#FFFF19000000", 1.0)]);
    assert_eq!(turns(&readings)[0].0, 0.25);
    // The identifier of something else, one that is off, and a file without the position.
    let keys = "configure = false\neds = \"left.dcf\"";
    let spec = spec(5, Mode::Listen, &[0]);
    for (file, told) in [
        (
            with(0x700, 254),
            "eds = \"left.dcf\", [1801sub1]: TPDO 2 has the position (6004), but has an identifier",
        ),
        (
            with(0x8000_0280, 254),
            "but is switched off (bit 31 of its COB-ID)",
        ),
        (
            file(&[(0x6501, 0, 100)]),
            "no TPDO has the position (6004): correct it there, or set",
        ),
    ] {
        let refused = described("canopen_encoder", keys, file).device(&spec);
        let problem = refused.map(|_| ()).unwrap_err().to_string();
        assert!(problem.contains(told), "{problem}");
    }
}

/// As CiA 406 maps it: in TPDO 1 by events, and in TPDO 2 by SYNC. What comes is read, once.
#[test]
fn an_encoder_may_have_its_position_in_two_tpdos() {
    let entries = [
        (0x6501, 0, 4),
        (0x1800, 1, 0x180),
        (0x1800, 2, 254),
        (0x1A00, 1, 0x6004_0020),
        (0x1801, 1, 0x280),
        (0x1801, 2, 1),
        (0x1A01, 1, 0x6004_0020),
    ];
    let read = |frames: &[(&str, f64)]| {
        let mut device = listener("canopen_encoder", "configure = false", file(&entries));
        let frames: Vec<_> = frames.iter().map(|(text, ms)| frame(text, *ms)).collect();
        let (readings, faults) = decode(&mut *device, &frames);
        assert!(faults.is_empty(), "{faults:?}");
        let at = |stamped: &StampedReading| stamped.acquired.0 / 100_000;
        readings.iter().map(at).collect::<Vec<_>>()
    };
    let (sync, first, second) = ("080#", "185#01000000", "285#01000000");
    assert_eq!(read(&[(first, 1.0), (first, 11.0)]), [10, 110]);
    assert_eq!(
        read(&[(sync, 1.0), (second, 1.5), (sync, 11.0), (second, 11.5)]),
        [10, 110]
    );
    let both = [
        (sync, 1.0),
        (second, 1.2),
        (first, 5.0),
        (sync, 11.0),
        (second, 11.2),
        (first, 15.0),
    ];
    assert_eq!(read(&both), [10, 110]);
}

/// Of those by SYNC, the one that follows each makes the readings: its time is that of the SYNC.
#[test]
fn an_encoder_has_its_position_at_each_sync() {
    let entries = [
        (0x6501, 0, 4),
        (0x1800, 1, 0x180),
        (0x1800, 2, 10),
        (0x1A00, 1, 0x6004_0020),
        (0x1801, 1, 0x280),
        (0x1801, 2, 1),
        (0x1A01, 1, 0x6004_0020),
    ];
    let mut device = listener("canopen_encoder", "configure = false", file(&entries));
    let mut frames = Vec::new();
    for cycle in 0..40 {
        let ms = 10.0 * f64::from(cycle);
        frames.push(frame("080#", ms));
        if cycle % 10 == 5 {
            frames.push(frame("185#01000000", ms + 0.2));
        }
        frames.push(frame("285#01000000", ms + 0.4));
    }
    let (readings, faults) = decode(&mut *device, &frames);
    assert!(faults.is_empty(), "{faults:?}");
    let found: Vec<i64> = readings.iter().map(|stamped| stamped.acquired.0).collect();
    let syncs: Vec<i64> = (0..40).map(|cycle| 10_000_000 * cycle).collect();
    assert_eq!(found, syncs);
}

/// The same position by two timers: which one makes the readings does not change by their jitter.
#[test]
fn two_tpdos_with_the_position_do_not_take_turns() {
    let entries = [
        (0x6501, 0, 100),
        (0x1800, 1, 0x180),
        (0x1800, 2, 254),
        (0x1A00, 1, 0x6004_0020),
        (0x1801, 1, 0x280),
        (0x1801, 2, 254),
        (0x1A01, 1, 0x6004_0020),
    ];
    // The TPDO of each reading, which is its position; the second comes each 10 ms.
    let read = |period: i32, silent: std::ops::Range<i32>| {
        let mut frames = Vec::new();
        for k in (0..1000).filter(|k| !silent.contains(&(k * period))) {
            let late = 0.1 * f64::from(k * 7919 % 11);
            frames.push(frame("185#01000000", f64::from(k * period) + late));
        }
        for k in 0..1000 {
            let late = 0.1 * f64::from(k * 6151 % 13) + 0.05;
            frames.push(frame("285#02000000", f64::from(k * 10) + late));
        }
        frames.retain(|frame| frame.t.0 < 10_000_000_000);
        frames.sort_by_key(|frame| frame.t);
        let mut device = listener("canopen_encoder", "configure = false", file(&entries));
        let (readings, faults) = decode(&mut *device, &frames);
        assert!(faults.is_empty(), "{faults:?}");
        let tpdo = |(position, _): (f64, f64)| (100.0 * position).round() as i32;
        let found: Vec<i32> = turns(&readings).into_iter().map(tpdo).collect();
        let mut runs: Vec<(i32, usize)> = Vec::new();
        for tpdo in found {
            match runs.last_mut() {
                Some((last, count)) if *last == tpdo => *count += 1,
                _ => runs.push((tpdo, 1)),
            }
        }
        runs
    };
    // The first is better, and stays at half the rate; not at a quarter.
    assert_eq!(read(10, 0..0), [(1, 1000)]);
    assert_eq!(read(20, 0..0), [(1, 500)]);
    assert_eq!(read(40, 0..0), [(1, 1), (2, 997)]);
    let runs = read(30, 0..0);
    assert!(runs.len() <= 2, "{runs:?}");
    // Silent, it is replaced at the fourth reading, until it comes as often again.
    assert_eq!(read(10, 2000..5000), [(1, 200), (2, 300), (1, 498)]);
}

/// What nobody needs of a file of a drive refuses nothing; what is needed is told with its place.
#[test]
fn a_tpdo_that_is_not_needed_refuses_nothing() {
    let made = |keys: &str, more: &[(u16, u8, u32)], wrong: &[(u16, u8)], mode| {
        let right = [
            (0x608F, 1, 4),
            (0x1800, 1, 0x180),
            (0x1800, 2, 255),
            (0x1A00, 1, 0x6064_0020),
        ];
        let mut objects = file(&[&right[..], more].concat());
        for at in wrong {
            objects.entries.remove(at);
            let problem = format!(
                "[{:04x}sub{}]: defaultvalue = \"x\" is no number",
                at.0, at.1
            );
            objects.unreadable.insert(*at, problem);
        }
        let keys = format!("eds = \"left.dcf\"\n{keys}");
        let mut device = described("canopen_drive", &keys, objects)
            .device(&spec(5, mode, &[0]))
            .map_err(|e| e.to_string())?;
        let (readings, _) = decode(&mut *device, &[frame("185#01000000", 1.0)]);
        assert_eq!(
            readings.len(),
            usize::from(mode == Mode::Listen),
            "{more:x?}"
        );
        Ok::<(), String>(())
    };
    // TPDO 4, which has an object of a maker, or the velocity. The node is added to identifiers.
    let fourth = |id: u32, object: u32| {
        let id = if id == 0 { 0_u32.wrapping_sub(5) } else { id };
        [(0x1803, 1, id), (0x1A03, 1, object)]
    };
    let (maker, velocity) = (0x2000_0020, 0x606C_0020);
    for (more, wrong) in [
        (&fourth(0x480, maker)[..], &[(0x1803, 1)][..]),
        (&fourth(0x480, maker), &[(0x1A03, 1)]),
        (&fourth(0x480, maker), &[(0x1803, 2), (0x1A03, 0)]),
        // Twice one identifier, one that is another's, and none.
        (
            &[&fourth(0x380, maker)[..], &[(0x1802, 1, 0x380)]].concat(),
            &[],
        ),
        (&fourth(0x700, maker), &[]),
        (&fourth(0, velocity), &[]),
        // It is off.
        (&fourth(0x8000_0480, velocity), &[(0x1A03, 2)]),
    ] {
        for mode in [Mode::Listen, Mode::Supervise] {
            assert_eq!(made("", more, wrong, mode), Ok(()), "{more:x?} {wrong:x?}");
        }
    }
    for (more, wrong, told) in [
        (
            &fourth(0x480, velocity),
            &[(0x1803, 1)][..],
            "eds = \"left.dcf\", [1803sub1]: defaultv",
        ),
        (
            &fourth(0x480, velocity),
            &[(0x1A03, 2)],
            "[1a03sub2]: defaultvalue",
        ),
        (
            &fourth(0x480, maker),
            &[(0x1A00, 1)],
            "[1a00sub1]: defaultvalue",
        ),
        (
            &fourth(0x180, velocity),
            &[],
            "left.dcf\", [1800sub1]: TPDO 1 has the identifier 0x185",
        ),
        (
            &fourth(0x700, velocity),
            &[],
            "[1803sub1]: TPDO 4 has the identifier 0x705",
        ),
    ] {
        let problem = made("", more, wrong, Mode::Listen).unwrap_err();
        assert!(problem.contains(told), "{problem}");
        assert!(
            problem.contains("correct it there, or state pdos"),
            "{problem}"
        );
        // The drive is asked; and keys count before a file.
        assert_eq!(made("", more, wrong, Mode::Supervise), Ok(()));
        let pdos = "pdos = [{ number = 1, objects = [0x6064] }]";
        assert_eq!(made(pdos, more, wrong, Mode::Listen), Ok(()));
    }
}

/// Torque and current whose rated values nobody tells are absent, and that is told.
#[test]
fn a_rated_value_that_is_not_known_takes_only_its_own() {
    let entries = [
        (0x608F, 1, 4),
        (0x1800, 1, 0x180),
        (0x1A00, 1, 0x6064_0020),
        (0x1A00, 2, 0x6077_0010),
        (0x1A00, 3, 0x6078_0010),
    ];
    let frames = [frame("185#01000000E803E803", 1.0)];
    for (keys, object) in [
        ("", Some(0x6076)),
        ("rated_torque = 2.0", Some(0x6075)),
        ("rated_torque = 2.0\ncurrent_unit = \"mA\"", None),
    ] {
        let mut device = listener("canopen_drive", keys, file(&entries));
        let (readings, faults) = decode(&mut *device, &frames);
        let Reading::Joint(joint) = readings[0].reading else {
            panic!("{readings:?}")
        };
        assert!(faults.is_empty() && (joint.position - TAU / 4.0).abs() < 1e-12);
        assert_eq!(joint.torque.is_nan(), keys.is_empty());
        assert_eq!(joint.current.is_nan(), object.is_some());
        assert_eq!(
            device.lacks(),
            object.map(|object| Refusal::Untold { object })
        );
    }
}

#[test]
fn a_position_that_is_switched_off_is_named() {
    let entries = [
        (0x608F, 1, 4),
        (0x1802, 1, 0x8000_0380),
        (0x1A02, 1, 0x6064_0020),
    ];
    let mut device = listener("canopen_drive", "", file(&entries));
    decode(&mut *device, &[frame("385#01000000", 1.0)]);
    let refusal = Refusal::SwitchedOff { object: 0x1802 };
    assert_eq!(device.state(), State::Refused(refusal));
    assert!(refusal.to_string().contains("object 1802 sub 1, bit 31"));
}

/// The TPDO that comes more often makes the readings, with the last values of the other.
#[test]
fn a_slow_tpdo_does_not_hold_a_fast_one_up() {
    let entries = [
        (0x608F, 1, 4),
        (0x1800, 1, 0x180),
        (0x1A00, 1, 0x6064_0020),
        (0x1801, 1, 0x280),
        (0x1A01, 1, 0x6064_0020),
        (0x1A01, 2, 0x606C_0020),
    ];
    let mut frames = Vec::new();
    for ms in 0..200 {
        if ms % 50 == 5 {
            frames.push(frame("285#0100000001000000", f64::from(ms) - 0.4));
        }
        frames.push(frame("185#01000000", f64::from(ms)));
    }
    let mut device = listener("canopen_drive", "", file(&entries));
    let (readings, faults) = decode(&mut *device, &frames);
    assert!(faults.is_empty(), "{faults:?}");
    assert!((195..=202).contains(&readings.len()), "{}", readings.len());
    assert!(
        turns(&readings)
            .iter()
            .skip(6)
            .all(|(_, velocity)| *velocity == 0.25)
    );
}

/// TPDO 3 of a drive that sends position and velocity after each SYNC. Files leave out the number
/// of objects, or entries that are not used.
#[test]
fn a_drive_has_the_mapping_of_its_file() {
    let entries = [
        (0x608F, 1, 400),
        (0x608F, 2, 1),
        (0x1802, 1, 0x380),
        (0x1802, 2, 1),
        (0x1A02, 0, 2),
        (0x1A02, 1, 0x6064_0020),
        (0x1A02, 2, 0x606C_0020),
        (0x1A02, 4, 0x6041_0010),
        // Nothing is in it, so that it may have any identifier.
        (0x1803, 1, 0x380),
        (0x1A03, 0, 0),
    ];
    let without_count = entries.map(|(index, sub, number)| match (index, sub) {
        (0x1A02, 0) => (0x2000, 0, number),
        _ => (index, sub, number),
    });
    for entries in [entries, without_count] {
        let mut device = listener("canopen_drive", "", file(&entries));
        let frames = [
            frame("080#", 10.0),
            frame("385#64000000C8000000", 10.4),
            frame("385#640000", 10.6),
        ];
        let (readings, _) = decode(&mut *device, &frames);
        let [(position, velocity)] = turns(&readings)[..] else {
            panic!("{readings:?}")
        };
        assert!((position - 0.25).abs() < 1e-12 && (velocity - 0.5).abs() < 1e-12);
        assert_eq!(readings[0].acquired, frames[0].t);
    }
}

/// Two TPDOs of which each has the position, by events: the one with most values that comes makes
/// the readings.
#[test]
fn two_tpdos_with_the_position_are_one_series_of_readings() {
    let entries = [
        (0x608F, 1, 4096),
        (0x1801, 1, 0x280),
        (0x1801, 2, 255),
        (0x1A01, 1, 0x6041_0010),
        (0x1A01, 2, 0x6064_0020),
        (0x1803, 1, 0x480),
        (0x1803, 2, 255),
        (0x1A03, 1, 0x6064_0020),
        (0x1A03, 2, 0x606C_0020),
    ];
    let heard = |frames: &[(&str, f64)]| {
        let mut device = listener("canopen_drive", "", file(&entries));
        let frames: Vec<_> = frames.iter().map(|(text, ms)| frame(text, *ms)).collect();
        let (readings, faults) = decode(&mut *device, &frames);
        assert!(faults.is_empty(), "{faults:?}");
        let at = |stamped: &StampedReading| {
            (stamped.acquired.0 / 1_000_000, stamped.reading.values()[0])
        };
        let joints = readings
            .iter()
            .filter(|stamped| matches!(stamped.reading, Reading::Joint(_)));
        joints.map(at).collect::<Vec<_>>()
    };
    let quarter = |n: i64| (10 * n, n as f64 * TAU / 4.0);
    // Only one of them comes.
    let (two, four) = (
        [("285#270400040000", 10.0), ("285#270400080000", 20.0)],
        [
            ("485#0004000064000000", 10.0),
            ("485#0008000064000000", 20.0),
        ],
    );
    assert_eq!(heard(&two), [quarter(1), quarter(2)]);
    assert_eq!(heard(&four), [quarter(1), quarter(2)]);
    // Both, then the better one falls silent for longer than hold_ms.
    let both = [
        ("485#0004000064000000", 10.0),
        ("285#270400040000", 10.5),
        ("285#270400080000", 20.0),
        ("485#0008000064000000", 20.5),
        ("285#2704000C0000", 120.0),
        ("285#2704000C0000", 130.0),
        ("285#2704000C0000", 140.0),
        ("285#270400100000", 150.0),
        ("285#270400140000", 160.0),
    ];
    assert_eq!(
        heard(&both),
        [quarter(1), quarter(2), (150, TAU), (160, 1.25 * TAU)]
    );
    // One by SYNC is better than any.
    let mut mixed = entries;
    mixed[2].2 = 1;
    let mut device = listener("canopen_drive", "", file(&mixed));
    let frames = [
        frame("080#", 10.0),
        frame("485#0004000064000000", 10.1),
        frame("285#270400040000", 10.2),
        frame("485#0004000064000000", 10.3),
        frame("080#", 20.0),
        frame("285#270400080000", 20.2),
    ];
    let (readings, _) = decode(&mut *device, &frames);
    let joints = readings
        .iter()
        .filter(|stamped| matches!(stamped.reading, Reading::Joint(_)));
    let times: Vec<i64> = joints.map(|stamped| stamped.acquired.0 / 100_000).collect();
    assert_eq!(times, [101, 100, 200]);
}

/// The torque \[Nm\] of 1000 per mille, or why there is none.
fn rated(keys: &str, vendor: Option<u32>, entries: &[(u16, u8, u32)]) -> Result<f64, State> {
    let objects = Objects {
        vendor,
        ..file(entries)
    };
    let keys = format!(
        "counts_per_turn = 3200\npdos = [{{ number = 1, objects = [0x6064, 0x6077] }}]\n{keys}"
    );
    let mut device = listener("canopen_drive", &keys, objects);
    let (readings, _) = decode(&mut *device, &[frame("185#00000000E803", 1.0)]);
    match readings.first().map(|stamped| stamped.reading) {
        Some(Reading::Joint(joint)) => Ok(joint.torque),
        _ => Err(device.state()),
    }
}

/// maxon's EPOS4 tells millionths: 4760 mA x 107746 uNm/A = 512871 uNm, in EPOS Studio's file.
#[test]
fn the_unit_of_the_rated_torque_is_its_makers() {
    let near = |found: Result<f64, State>, right: f64| {
        let found = found.unwrap();
        assert!((found / right - 1.0).abs() < 1e-12, "{found}");
    };
    let epos = [(0x6076, 0, 512_871)];
    near(rated("", Some(0xFB), &epos), 0.512_871);
    near(rated("", None, &[(0x1018, 1, 0xFB), epos[0]]), 0.512_871);
    near(rated("rated_torque_unit = \"uNm\"", None, &epos), 0.512_871);
    near(
        rated("rated_torque_unit = \"mNm\"", Some(0xFB), &epos),
        512.871,
    );
    near(rated("rated_torque = 0.5", Some(0xFB), &epos), 0.5);
    near(rated("", Some(0x9A), &[(0x6076, 0, 512)]), 0.512);
}

/// No motor has the torque with its current, or with its speed.
#[test]
fn a_rated_torque_that_can_not_be_is_refused() {
    let refused = Err(State::Refused(Refusal::Implausible { object: 0x6076 }));
    let torque = |number| (0x6076, 0, number);
    let (current, speed) = (|ma| (0x6075, 0, ma), |rpm| (0x6080, 0, rpm));
    for (entries, is_plausible) in [
        (vec![torque(512_871), current(4760)], false),
        (vec![torque(512), current(4760)], true),
        // 50 Nm/A, and a little more; half a thousandth, and a little less.
        (vec![torque(50_000), current(1000)], true),
        (vec![torque(50_001), current(1000)], false),
        (vec![torque(50), current(100_000)], true),
        (vec![torque(49), current(100_000)], false),
        // 50 kW: 1300 rpm and 367 Nm.
        (vec![torque(512_871), speed(1300)], false),
        (vec![torque(367_000), speed(1300)], true),
        (vec![torque(368_000), speed(1300)], false),
        // A speed that is rather a default.
        (vec![torque(40_000), speed(200_000)], true),
        (vec![torque(48_000), speed(200_000)], false),
    ] {
        let found = rated("", None, &entries);
        match is_plausible {
            true => assert!(found.is_ok(), "{entries:?} {found:?}"),
            false => assert_eq!(found, refused, "{entries:?}"),
        }
        assert!(rated("rated_torque = 1.0", None, &entries).is_ok());
        assert!(rated("rated_torque_unit = \"mNm\"", None, &entries).is_ok());
    }
    let text = Refusal::Implausible { object: 0x6076 }.to_string();
    assert!(
        text.contains("object 6076") && text.contains("rated_torque_unit"),
        "{text}"
    );
}

/// Codes of CiA 303-2, as drives of several makers have them: power of ten, unit, time.
#[test]
fn positions_and_velocities_are_in_the_units_that_the_drive_states() {
    const KEYS: &str = "pdos = [{ number = 1, objects = [0x6064, 0x606C] }]";
    let read = |keys: &str, units: &[(u16, u8, u32)]| {
        let mut objects = file(&[(0x608F, 1, 1000)]);
        let more = file(units).entries.into_iter();
        // Defaults of a kind of drive.
        objects.entries.extend(more.map(|(at, entry)| {
            (
                at,
                ObjectEntry {
                    own: false,
                    ..entry
                },
            )
        }));
        let mut device = listener("canopen_drive", &format!("{keys}\n{KEYS}"), objects);
        let (readings, _) = decode(&mut *device, &[frame("185#6400000064000000", 1.0)]);
        let found = turns(&readings);
        found.first().copied().ok_or(device.state())
    };
    let (position, velocity) = (|code| (0x60A8, 0, code), |code| (0x60A9, 0, code));
    for (units, right) in [
        (vec![], (0.1, 0.1)),
        (
            vec![position(0x00B5_0000), velocity(0x00B5_0300)],
            (0.1, 0.1),
        ),
        // rpm, and thousandths of it.
        (vec![velocity(0x00B4_4700)], (0.1, 100.0 / 60.0)),
        (vec![velocity(0xFDB4_4700)], (0.1, 0.1 / 60.0)),
        // Revolutions, degrees, and milliradians per second.
        (vec![velocity(0x00B4_0300)], (0.1, 100.0)),
        (vec![velocity(0x0041_0300)], (0.1, 100.0 / 360.0)),
        (vec![velocity(0xFD10_0300)], (0.1, 0.1 / TAU)),
        // Thousandths of a degree; velocities are in the same over seconds.
        (vec![position(0xFD41_0000)], (0.1 / 360.0, 0.1 / 360.0)),
        // 0: not stated.
        (vec![position(0), velocity(0)], (0.1, 0.1)),
    ] {
        let found = read("", &units).unwrap();
        assert!((found.0 - right.0).abs() < 1e-12, "{units:?} {found:?}");
        assert!((found.1 - right.1).abs() < 1e-12, "{units:?} {found:?}");
    }
    // Keys count before what is told.
    let rpm = [velocity(0x00B4_4700)];
    let found = read("velocity_unit = \"0.1 counts/s\"", &rpm).unwrap();
    assert!((found.1 - 0.01).abs() < 1e-12);
    let degrees = [position(0x0041_0000)];
    let found = read("counts_per_turn = 200", &degrees).unwrap();
    assert!((found.0 - 0.5).abs() < 1e-12);
    // Metres are no angle.
    let metres = [velocity(0x0001_0300)];
    let refusal = Refusal::Implausible { object: 0x60A9 };
    assert_eq!(read("", &metres), Err(State::Refused(refusal)));
    assert!(read("velocity_unit = \"rpm\"", &metres).is_ok());
    let metres = [position(0x0001_0000)];
    let refusal = Refusal::Implausible { object: 0x60A8 };
    assert_eq!(read("", &metres), Err(State::Refused(refusal)));
    assert!(read("counts_per_turn = 200", &metres).is_ok());
}

/// A value that is no number is told to a driver that needs it.
#[test]
fn what_is_wrong_in_a_file_harms_only_where_it_is_needed() {
    let build = |driver: &str, keys: &str, at: (u16, u8), mode| {
        let mut objects = file(&[
            (0x608F, 1, 1000),
            (0x6501, 0, 1000),
            (0x1800, 1, 0x180),
            (0x1A00, 1, 0x6064_0020),
        ]);
        objects
            .unreadable
            .insert(at, "[6076]: defaultvalue = \"x\" is no number".to_owned());
        let made = described(driver, keys, objects).device(&spec(5, mode, &[0]));
        made.map(|_| ()).map_err(|e| e.to_string())
    };
    let (drive, encoder) = ("canopen_drive", "canopen_encoder");
    let pdos = "pdos = [{ number = 1, objects = [0x6064, 0x6077] }]";
    for (driver, keys, at, mode, is_needed) in [
        (drive, "", (0x2000, 1), Mode::Listen, false),
        (drive, "", (0x1A02, 3), Mode::Listen, false),
        (drive, "", (0x1A00, 2), Mode::Listen, true),
        (drive, "", (0x1A00, 2), Mode::Supervise, false),
        (drive, pdos, (0x1A02, 3), Mode::Listen, false),
        (drive, "", (0x6076, 0), Mode::Listen, false),
        (drive, pdos, (0x6076, 0), Mode::Listen, true),
        (drive, pdos, (0x6076, 0), Mode::Supervise, false),
        (drive, "", (0x608F, 2), Mode::Listen, true),
        (
            drive,
            "counts_per_turn = 10",
            (0x608F, 2),
            Mode::Listen,
            false,
        ),
        (encoder, "", (0x1A00, 1), Mode::Listen, false),
        (
            encoder,
            "configure = false",
            (0x1A00, 1),
            Mode::Listen,
            true,
        ),
        (encoder, "", (0x6001, 0), Mode::Listen, true),
        (encoder, "", (0x6001, 0), Mode::Supervise, false),
        (
            encoder,
            "counts_per_turn = 10",
            (0x6001, 0),
            Mode::Listen,
            false,
        ),
    ] {
        let problem = build(driver, keys, at, mode);
        assert_eq!(
            problem.is_err(),
            is_needed,
            "{driver} {keys} {at:x?} {problem:?}"
        );
        if let Err(problem) = problem {
            assert!(problem.contains("[6076]: defaultvalue"), "{problem}");
        }
    }
}
