//! EDS and DCF files: their objects are those that the package `canopen` reads, and drives and
//! encoders are decoded as they say. `eds/objects.txt` is made by `tests/oracle/frames/eds.py`.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing
)]

use proprio_drivers::objects::Objects;
use proprio_drivers::{Board, Decoded, Device, Frame, Frames, Id, Options, StampedReading, State};
use proprio_gateway::devices::build;
use proprio_gateway::plan::{DevicePlan, Plan};
use proprio_topics::{JointState, Nanos, Quality, Reading, Refusal, StampKind};
use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

/// As `canopen` reads the files in `eds/`, of node 5.
const GOLDEN: &str = include_str!("eds/objects.txt");
const FILES: [&str; 3] = ["drive.eds", "drive.dcf", "encoder.eds"];
const NODE: u8 = 5;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/eds")
}

/// The plan of one device with these keys, on a bus with these.
fn plan(bus: &str, keys: &str) -> Result<DevicePlan, String> {
    let text = format!(
        "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n{bus}\n\
         source = {{ kind = \"virtual\", name = \"b\" }}\n[[bus.device]]\nname = \"d\"\n{keys}\n\
         [[bus.device.joint]]\nname = \"j\"\n"
    );
    Ok(Plan::parse(&text, &folder())?.buses[0].devices[0].clone())
}

fn drive(keys: &str) -> DevicePlan {
    plan("", &format!("driver = \"canopen_drive\"\n{keys}")).unwrap()
}

/// The objects of a file.
fn objects(file: &Path) -> Objects {
    let keys = format!("driver = \"canopen_drive\"\nlisten_only = true\neds = {file:?}");
    // A DCF has an address of its own.
    let planned = plan("", &keys).or_else(|_| plan("", &format!("address = 5\n{keys}")));
    match planned.unwrap_or_else(|e| panic!("{e}")).options {
        Options::CanopenDrive(options) => options.objects.unwrap(),
        other => panic!("{other:?}"),
    }
}

/// Asserts that each line of `golden` is what is read, and returns how many there are.
fn compare(golden: &str, folder: &Path, files: &[&str]) -> usize {
    for name in files {
        let objects = objects(&folder.join(name));
        let mut read = String::new();
        for ((index, sub), entry) in &objects.entries {
            let value = objects.value(*index, *sub, NODE).unwrap();
            // A line tells signed numbers with their sign.
            let place = format!("{name} {index:04X} {sub} ");
            let expected = golden
                .lines()
                .find_map(|line| line.strip_prefix(place.as_str()));
            let Some(expected) = expected else {
                // canopen does not count the entries of a short form.
                assert_eq!(*sub, 0, "{place}is {value}");
                continue;
            };
            let (number, own) = expected.split_once(' ').unwrap();
            let number: i64 = number.parse().unwrap();
            assert_eq!(number as u32, value, "{place}");
            // Constants count as values.
            assert!(entry.own || own != "own", "{place}");
            writeln!(read, "{place}").unwrap();
        }
        for line in golden
            .lines()
            .filter(|line| line.starts_with(&format!("{name} ")))
        {
            let place = line.splitn(4, ' ').take(3).collect::<Vec<_>>().join(" ");
            assert!(read.contains(&format!("{place} \n")), "{line} is not read");
        }
    }
    golden.lines().count()
}

#[test]
fn objects_are_those_that_canopen_reads() {
    assert_eq!(compare(GOLDEN, &folder(), &FILES), 95);
}

/// The same with the package itself, where it is installed; with more files in PROPRIO_DATA/eds.
#[test]
fn canopen_reads_the_same_today() {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/oracle/frames/eds.py");
    let run = |folder: &Path, files: &[&str]| {
        let mut command = Command::new("python3");
        command
            .arg(&script)
            .arg(NODE.to_string())
            .args(files)
            .current_dir(folder);
        if let Ok(peers) = std::env::var("PROPRIO_PEERS") {
            command.env("PYTHONPATH", peers);
        }
        command.output()
    };
    match run(&folder(), &FILES) {
        Ok(output) if output.status.success() => {
            assert_eq!(String::from_utf8_lossy(&output.stdout), GOLDEN);
        }
        Ok(output) if output.status.code() != Some(3) => panic!("{output:?}"),
        _ => return println!("skipped: python3 with the package canopen is not installed"),
    }
    let Some(more) = std::env::var_os("PROPRIO_DATA").map(|data| Path::new(&data).join("eds"))
    else {
        return;
    };
    for file in std::fs::read_dir(&more).into_iter().flatten().flatten() {
        let name = file.file_name().into_string().unwrap();
        let output = run(&more, &[&name]).unwrap();
        assert!(output.status.success(), "{name}: {output:?}");
        let count = compare(&String::from_utf8_lossy(&output.stdout), &more, &[&name]);
        println!("{name}: {count} objects");
    }
}

fn frame(text: &str, ms: f64) -> Frame {
    let (id, data) = text.split_once('#').unwrap();
    let bytes: Vec<u8> = (0..data.len())
        .step_by(2)
        .map(|at| u8::from_str_radix(&data[at..at + 2], 16).unwrap())
        .collect();
    let id = Id::standard(u16::from_str_radix(id, 16).unwrap());
    Frame::new(id, &bytes).at(Nanos::from_seconds(ms * 1e-3), StampKind::Software)
}

/// The joints' states in these frames, each 0.1 ms after the one before, of those that the device
/// receives.
fn joints(device: &mut dyn Device, frames: &[&str]) -> Vec<JointState> {
    let mut joints = Vec::new();
    for (number, text) in frames.iter().enumerate() {
        let frame = frame(text, number as f64 * 0.1);
        let mut out = Decoded::new();
        if device.claims().iter().any(|claim| claim.matches(frame.id)) {
            device.on_frame(&frame, &mut out);
        }
        joints.extend(out.readings.iter().filter_map(
            |StampedReading { reading, .. }| match reading {
                Reading::Joint(joint) => Some(*joint),
                _ => None,
            },
        ));
    }
    joints
}

fn near(a: f64, b: f64) -> bool {
    (a - b).abs() < 1e-9
}

#[test]
fn a_drive_is_read_as_its_file_says() {
    let keys = "address = 5\nlisten_only = true\nrated_torque = 2.0\nrated_current = 5.0\n\
                counts_per_turn = 1000\neds = \"drive.eds\"";
    let mut device = build(&drive(keys), None).unwrap();
    let frames = [
        "485#640001",           // 6078, 6061
        "080#",                 // SYNC
        "185#2706E8030000",     // 6041, 6064
        "315#D00700007FF401",   // 606C, a maker's object, 6077; at an identifier of its own
        "285#0000000000000000", // what the drive does not send
    ];
    let read = joints(&mut *device, &frames);
    assert_eq!(read.len(), 1, "{:?}", device.state());
    assert!(
        near(read[0].position, TAU) && near(read[0].velocity, 2.0 * TAU),
        "{read:?}"
    );
    assert!(
        near(read[0].torque, 1.0) && near(read[0].current, 0.5),
        "{read:?}"
    );
    // An EDS is of a kind of drive: its scales are those of no motor.
    let keys = "address = 5\nlisten_only = true\neds = \"drive.eds\"";
    let mut device = build(&drive(keys), None).unwrap();
    assert!(joints(&mut *device, &frames).is_empty());
    let object = 0x608F;
    assert_eq!(device.state(), State::Refused(Refusal::Untold { object }));
}

#[test]
fn a_configured_drive_has_its_own_scales() {
    // Its address, and its mapping: the torque at 2A5, and the current at each SYNC.
    let device = drive("listen_only = true\neds = \"drive.dcf\"");
    assert_eq!(device.spec.address, 5);
    let mut device = build(&device, None).unwrap();
    let frames = ["080#", "185#2706E8030000", "2A5#D00700007FF401", "485#6400"];
    let read = joints(&mut *device, &frames);
    assert_eq!(read.len(), 1, "{:?}", device.state());
    assert!(
        near(read[0].position, 0.1 * TAU) && near(read[0].velocity, 0.2 * TAU),
        "{read:?}"
    );
    assert!(
        near(read[0].torque, 0.44) && near(read[0].current, 0.43),
        "{read:?}"
    );
    // Keys count before it.
    let keys = "listen_only = true\neds = \"drive.dcf\"\nrated_torque = 2.0\n\
                pdos = [{ number = 2, id = 0x2A5, objects = [0x6064, 0x6077] }]";
    let mut device = build(&drive(keys), None).unwrap();
    let read = joints(&mut *device, &["2A5#10270000F401"]);
    assert!(
        near(read[0].position, TAU) && near(read[0].torque, 1.0),
        "{read:?}"
    );
}

#[test]
fn what_a_node_says_counts_before_its_file() {
    let keys = "listen_only = true\neds = \"drive.dcf\"";
    // Another master has read or written: no torque, and the counts of a turn.
    let written = [
        "605#23001802A0000000",
        "605#2F001A0000000000",
        "585#60001A0000000000",
        "605#23001A0120006460",
        "585#60001A0100000000",
        "605#23001A0210004160",
        "585#80001A0230000906", // refused: it changes nothing
        "605#2F001A0001000000",
        "585#60001A0000000000",
        "605#23011801A5020080",
        "585#6001180100000000",
        "605#23001801B2010000",
        "585#8000180130000906", // refused, too
        "605#23031801850400C0",
        "585#6003180100000000",
        "585#438F600164000000",
        "585#438F600201000000",
        "080#",
        "185#C8000000",
    ];
    let mut device = build(&drive(keys), None).unwrap();
    let read = joints(&mut *device, &written);
    assert_eq!(read.len(), 1, "{:?}", device.state());
    assert!(
        near(read[0].position, 2.0 * TAU) && read[0].torque.is_nan(),
        "{read:?}"
    );
    // Where it sends is not received.
    let mut device = build(&drive(keys), None).unwrap();
    joints(
        &mut *device,
        &["585#43001801B2010000", "185#000000000000", "080#", "185#00"],
    );
    assert_eq!(
        device.state(),
        State::Refused(Refusal::OtherIdentifier { id: 0x1B2 })
    );
}

/// Runs the start of a device with a board of other keys; returns its joints and its state.
fn start(keys: &str, board: &str) -> (Vec<JointState>, State) {
    let mut device = build(&drive(keys), None).unwrap();
    let board = drive(board);
    let mut board: Box<dyn Board> = board.options.board(&board.spec).unwrap();
    let state = JointState {
        position: 1.0,
        velocity: 0.5,
        torque: 0.4,
        current: 2.0,
        ..JointState::ABSENT
    };
    board.present(0, &Reading::Joint(state), Quality::GOOD);
    let (mut joints, mut out) = (Vec::new(), Decoded::new());
    for ms in 0..300 {
        let now = Nanos::from_millis(ms);
        let mut answers = Frames::new();
        while let Some(transmit) = device.poll_transmit(now, &mut out) {
            device.on_sent(&transmit.frame, Ok(now));
            board.on_frame(&transmit.frame, &mut answers);
            for answer in answers.take() {
                device.on_frame(&answer.at(now, StampKind::Software), &mut out);
            }
        }
        if ms % 10 == 0 {
            let sync = frame("080#", ms as f64);
            device.overhear(&sync, &mut out);
            board.on_frame(&sync, &mut answers);
            let mine = |id| device.claims().iter().any(|claim| claim.matches(id));
            let answers: Vec<_> = answers.into_iter().filter(|frame| mine(frame.id)).collect();
            for answer in answers {
                let t = now + Nanos::from_micros(300);
                device.on_frame(&answer.at(t, StampKind::Software), &mut out);
            }
        }
        let found = out
            .readings
            .iter()
            .filter_map(|stamped| match stamped.reading {
                Reading::Joint(joint) => Some(joint),
                _ => None,
            });
        joints.extend(found);
        out.clear();
    }
    (joints, device.state())
}

#[test]
fn a_drive_is_asked_what_it_sends_wherever_it_sends_it() {
    let dcf = "eds = \"drive.dcf\"";
    for keys in [dcf, "address = 5\neds = \"drive.dcf\"\nrated_torque = 0.88"] {
        let (read, state) = start(keys, dcf);
        assert_eq!(state, State::Streaming, "{keys}");
        let last = read.last().unwrap();
        assert!((last.position - 1.0).abs() < 1e-3 && (last.velocity - 0.5).abs() < 1e-3);
        assert!((last.torque - 0.4).abs() < 1e-3 && (last.current - 2.0).abs() < 5e-3);
    }
    // Without the file it is not known where to listen.
    let (read, state) = start("address = 5", dcf);
    assert_eq!(
        state,
        State::Refused(Refusal::OtherIdentifier { id: 0x2A5 })
    );
    assert!(read.is_empty());
    // The drive is set up otherwise than its file says: it is asked.
    let other = "address = 5\npdos = [{ number = 1, objects = [0x6064], sync = 1 }]";
    let (read, state) = start(dcf, other);
    assert_eq!(state, State::Streaming);
    assert!(
        read.iter().all(|joint| (joint.position - 1.0).abs() < 2e-3),
        "{read:?}"
    );
    assert!(read.len() > 10 && read[0].torque.is_nan());
}

#[test]
fn an_encoder_is_read_as_its_file_says() {
    let keys = "driver = \"canopen_encoder\"\naddress = 5\nlisten_only = true\n\
                configure = false\neds = \"encoder.eds\"";
    let device = plan("", keys).unwrap();
    let mut host = build(&device, None).unwrap();
    // 6030 sub 1, then 6004; its constants say that it is scaled.
    let read = joints(&mut *host, &["185#FFFF", "080#", "285#FFFF84030000"]);
    assert_eq!(read.len(), 1, "{:?}", host.state());
    assert!(near(read[0].position, 0.25 * TAU), "{read:?}");
    // Its file says that it measures at a SYNC.
    let mut out = Decoded::new();
    for (text, ms) in [("080#", 50.0), ("285#FFFF84030000", 51.0)] {
        host.on_frame(&frame(text, ms), &mut out);
    }
    assert_eq!(out.readings[0].acquired, Nanos::from_millis(50));
    let mut board = device.options.board(&device.spec).unwrap();
    let (mut frames, quarter) = (Frames::new(), 0.25 * TAU);
    let state = JointState {
        position: quarter,
        ..JointState::ABSENT
    };
    board
        .encode(0, &Reading::Joint(state), Quality::GOOD, &mut frames)
        .unwrap();
    assert_eq!(frames[0].to_string(), "285#000084030000");
    // The driver maps the position itself.
    let mut host = build(&plan("", &keys.replace("false", "true")).unwrap(), None).unwrap();
    let read = joints(&mut *host, &["185#84030000"]);
    assert!(near(read[0].position, quarter), "{read:?}");
}

#[test]
fn files_that_do_not_fit_are_refused() {
    let drive = "driver = \"canopen_drive\"\neds = ";
    for (bus, keys, expected) in [
        (
            "",
            format!("address = 6\n{drive}\"drive.dcf\""),
            "node 5 (NodeID), and address = 6",
        ),
        (
            "bit_rate = 500000",
            format!("{drive}\"drive.dcf\""),
            "a bus of 1 Mbit/s (Baudrate), and bit_rate = 500000",
        ),
        ("", format!("{drive}\"drive.eds\""), "address is missing"),
        (
            "",
            format!("address = 5\n{drive}\"drive.edf\""),
            "drive.edf: cannot be read",
        ),
        (
            "",
            format!("address = 5\n{drive}\"objects.txt\""),
            "is no EDS or DCF file",
        ),
        (
            "",
            "address = 5\ndriver = \"canopen_encoder\"\nconfigure = false\neds = \"drive.eds\""
                .into(),
            "eds = \"drive.eds\": no TPDO has the position (6004)",
        ),
    ] {
        let problem = plan(bus, &keys).unwrap_err();
        assert!(problem.contains(expected), "{keys}: {problem}");
    }
    let fits = plan("bit_rate = 1000000", &format!("{drive}\"drive.dcf\""));
    assert!(fits.is_ok(), "{fits:?}");
}
