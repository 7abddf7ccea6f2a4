//! Frames that cantools has encoded, decoded by the table of the same .dbc file. `everything.txt`
//! is made by `tests/oracle/frames/dbc.py`.
#![allow(missing_docs, clippy::unwrap_used, clippy::panic)]

use proprio_drivers::{Decoded, Device, Format, Frame, Frames, Id};
use proprio_gateway::devices::build;
use proprio_gateway::plan::Plan;
use proprio_topics::{Nanos, Quality, Reading, StampKind};
use std::collections::BTreeMap;
use std::path::Path;

const FRAMES: &str = include_str!("dbc/everything.txt");
const FILE: &str = include_str!("dbc/everything.dbc");

/// A line of `everything.txt`.
struct Golden {
    frame: Frame,
    message: String,
    values: BTreeMap<String, f64>,
}

fn golden(text: &str) -> impl Iterator<Item = Golden> {
    text.lines().map(|line| {
        let mut words = line.split(' ');
        let (id, data) = words.next().unwrap().split_once('#').unwrap();
        let number = u32::from_str_radix(id, 16).unwrap();
        let id = match id.len() {
            3 => Id::standard(u16::try_from(number).unwrap()),
            _ => Id::extended(number),
        };
        let (format, data) = match data.strip_prefix("#1") {
            None => (Format::Classic, data),
            Some(data) => {
                let (bit_rate_switch, error_state) = (true, false);
                let format = Format::Fd {
                    bit_rate_switch,
                    error_state,
                };
                (format, data)
            }
        };
        let byte = |at| u8::from_str_radix(&data[at..at + 2], 16).unwrap();
        let bytes: Vec<u8> = (0..data.len()).step_by(2).map(byte).collect();
        let frame = Frame::with_format(id, format, &bytes).unwrap();
        let message = words.next().unwrap().to_owned();
        let values = words.map(|word| {
            let (name, value) = word.split_once('=').unwrap();
            (name.to_owned(), value.parse().unwrap())
        });
        Golden {
            frame: frame.at(Nanos::from_millis(1), StampKind::Software),
            message,
            values: values.collect(),
        }
    })
}

/// The signals of each message of the file, by its lines.
fn signals() -> BTreeMap<String, Vec<String>> {
    let mut signals: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let mut message = String::new();
    for line in FILE.lines() {
        let word = |at: usize| line.split_whitespace().nth(at).unwrap().to_owned();
        if line.starts_with("BO_ ") {
            message = word(2).trim_end_matches(':').to_owned();
        } else if line.starts_with(" SG_ ") {
            signals.entry(message.clone()).or_default().push(word(1));
        }
    }
    signals
}

fn plan(reading: &str) -> Result<Plan, String> {
    let text = format!(
        "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n\
         source = {{ kind = \"virtual\", name = \"b\" }}\n[[bus.device]]\nname = \"any\"\n\
         driver = \"dbc\"\nfile = \"everything.dbc\"\n[[bus.device.reading]]\n{reading}"
    );
    Plan::parse(
        &text,
        Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/dbc")),
    )
}

/// Keys of a reading whose first values are these signals, as they are in the file.
fn keys<'s>(message: &str, names: impl Iterator<Item = &'s String>) -> String {
    let (mut fields, mut units) = (Vec::new(), Vec::new());
    for (number, name) in names.enumerate() {
        fields.push(format!("p{number} = \"{message}.{name}\""));
        units.push(format!("p{number} = \"raw\""));
    }
    format!(
        "kind = \"skin\"\nfields = {{ {} }}\nunits = {{ {} }}\n",
        fields.join(", "),
        units.join(", ")
    )
}

fn device(reading: &str) -> Box<dyn Device> {
    build(&plan(reading).unwrap().buses[0].devices[0], None).unwrap()
}

fn decode(device: &mut dyn Device, frame: &Frame) -> Decoded {
    let mut out = Decoded::new();
    device.on_frame(frame, &mut out);
    out
}

#[test]
fn every_signal_is_what_cantools_reads() {
    let signals = signals();
    let mut frames = 0;
    for golden in golden(FRAMES) {
        let names = golden.values.keys();
        let mut device = device(&keys(&golden.message, names.clone()));
        let out = decode(&mut *device, &golden.frame);
        assert!(out.faults.is_empty(), "{} {:?}", golden.frame, out.faults);
        assert_eq!(out.readings.len(), 1, "{}", golden.frame);
        let Reading::Skin(skin) = out.readings[0].reading else {
            panic!("{out:?}")
        };
        for ((name, expected), value) in golden.values.iter().zip(skin.taxels) {
            assert!(
                (value - expected).abs() <= 1e-12 * expected.abs().max(1.0),
                "{} {name}: {value}, {expected}",
                golden.frame
            );
        }
        // What is on another page is not read.
        for other in &signals[&golden.message] {
            if !golden.values.contains_key(other) {
                let mut device = self::device(&keys(&golden.message, [other].into_iter()));
                let out = decode(&mut *device, &golden.frame);
                assert!(out.readings.is_empty(), "{} {other}", golden.frame);
                assert!(out.faults.is_empty(), "{} {other}", golden.frame);
            }
        }
        frames += 1;
    }
    assert_eq!(frames, 180);
}

/// The frames of a simulated device are cantools' own, as far as their signals reach.
#[test]
fn every_signal_is_written_where_cantools_writes_it() {
    for golden in golden(FRAMES) {
        let keys = keys(&golden.message, golden.values.keys());
        let plan = plan(&keys).unwrap();
        let device = &plan.buses[0].devices[0];
        let read = decode(&mut *build(device, None).unwrap(), &golden.frame).readings[0];
        let mut board = device.options.board(&device.spec).unwrap();
        let mut frames = Frames::new();
        board
            .encode(0, &read.reading, Quality::GOOD, &mut frames)
            .unwrap();
        assert_eq!(frames.len(), 1);
        if golden.message == "Floats" {
            // A double with a factor and an offset is rounded.
            let again = decode(&mut *build(device, None).unwrap(), &frames[0]).readings[0];
            for (a, b) in again.reading.values().iter().zip(read.reading.values()) {
                assert!(a.to_bits() == b.to_bits() || (a - b).abs() <= 1e-12 * b.abs());
            }
        } else {
            assert_eq!(frames[0].to_string(), golden.frame.to_string());
        }
    }
}

#[test]
fn a_frame_that_is_too_short_is_counted() {
    let golden = golden(FRAMES).next().unwrap();
    let mut device = device(&keys(&golden.message, golden.values.keys()));
    let short = Frame::new(golden.frame.id, &golden.frame.data()[..7]);
    let out = decode(&mut *device, &short);
    assert!(out.readings.is_empty());
    assert_eq!(out.faults.len(), 1);
}

/// A mistake in the keys has a message that says what would be right.
#[test]
fn mistakes_in_the_keys_are_explained() {
    let joint =
        |fields: &str, rest: &str| format!("kind = \"joint\"\nfields = {{ {fields} }}\n{rest}\n");
    for (keys, expected) in [
        (
            joint("position = \"Floats.Singel\"", ""),
            "fields.position = \"Floats.Singel\": the message has no signal \"Singel\"; it has \
             Single, Double",
        ),
        (
            joint("position = \"Flots.Single\"", ""),
            "\"everything.dbc\" has no message \"Flots\"; it has Intel, Motorola, Floats",
        ),
        (
            joint("position = \"Single\"", ""),
            "it must be written Message.Signal",
        ),
        (
            joint("position = \"Floats.Double\"", ""),
            "its unit \"rpm\" does not fit: it must be one of rad, mrad, deg, mdeg, rev, m, cm, ",
        ),
        (
            joint("position = \"Wide.Start\"", ""),
            "the file gives no unit: add units = { position = \"...\" }, one of rad",
        ),
        (
            joint(
                "position = \"Wide.Start\"",
                "units = { position = \"furlong\" }",
            ),
            "its unit \"furlong\" is not known",
        ),
        (
            joint("postion = \"Floats.Single\"", ""),
            "fields.postion: there is no such value; there is position, velocity",
        ),
        (
            joint(
                "position = \"Floats.Single\"",
                "hold_ms = { velocity = 3.0 }",
            ),
            "hold_ms.velocity: fields.velocity is missing",
        ),
        (
            joint(
                "position = \"Floats.Single\", velocity = \"Motorola.Middle\"",
                "",
            ),
            "pair_timeout_ms is missing: its values come in several frames (Floats, Motorola)",
        ),
        (
            joint("position = \"Floats.Single\"", "first = \"Intel\""),
            "first = \"Intel\" must be a message of its fields: Floats",
        ),
        (
            joint("position = \"Floats.Single\"", "counter = \"Wide.Start\""),
            "counter = \"Wide.Start\": it must be a signal of Floats",
        ),
        (
            joint(
                "position = \"Floats.Single\"",
                "hold_ms = { position = 3.0 }",
            ),
            "it needs a value without hold_ms",
        ),
        (
            "kind = \"wrench\"\nfields = { fx = \"Intel.Low\" }\n".to_owned(),
            "fields.fy is missing: a wrench needs it",
        ),
        (
            "kind = \"wrist\"\nfields = { fx = \"Intel.Low\" }\n".to_owned(),
            "unknown variant `wrist`, expected one of `joint`, `wrench`",
        ),
    ] {
        let joint = match keys.contains("joint") {
            true => "[[bus.device.joint]]\nname = \"j\"\n",
            false => "",
        };
        let problem = plan(&format!("{keys}{joint}")).map(|p| p.to_string());
        let problem = problem.unwrap_err();
        assert!(problem.contains(expected), "{keys}: {problem}");
    }
}
