//! What EDS and DCF files say of CANopen encoders and drives: scales, and where process data are.

use crate::rig::{decode, frame, options, spec};
use proprio_drivers::objects::{Entry, Objects};
use proprio_drivers::{Device, Mode, Options, Output, SpecError};
use proprio_topics::Reading;
use std::f64::consts::TAU;

/// A file that states these entries of this very device: index, sub-index, number.
fn file(entries: &[(u16, u8, u32)]) -> Objects {
    let entry = |&(index, sub, number): &(u16, u8, u32)| {
        let plus_node = matches!(index, 0x1800..=0x1803) && sub == 1;
        let entry = Entry {
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
fn turns(readings: &[Output]) -> Vec<(f64, f64)> {
    let joint = |output: &Output| match output.reading {
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
        let of = |node| {
            let file = Objects {
                node: Some(node),
                ..file(&[(0x6501, 0, 4096)])
            };
            let spec = spec(5, Mode::Listen, &[0]);
            described(driver, "", file).device(&spec).map(|_| ())
        };
        assert_eq!(of(5), Ok(()));
        assert!(matches!(of(6), Err(SpecError::Description(_))));
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
    let spec = spec(5, Mode::Listen, &[0]);
    for file in [
        with(0x700, 254),
        with(0x8000_0280, 254),
        file(&[(0x6501, 0, 100)]),
    ] {
        let refused = described("canopen_encoder", keys, file).device(&spec);
        assert!(matches!(
            refused.map(|_| ()),
            Err(SpecError::Keys { key: "eds", .. })
        ));
    }
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
