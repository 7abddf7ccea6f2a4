//! `proprio decode` and a replaying gateway give the same samples whatever program recorded the
//! bus, and one clear message about a file that is no log.
#![allow(missing_docs)]

use proprio_drivers::{Format, Frame, Id};
use proprio_gateway::log::LogReader;
use proprio_simulator::record::record;
use proprio_simulator::{SimulatedRobot, SimulationSettings};
use proprio_tests::watch::Recorder;
use proprio_tests::{Arm, PATIENCE, Rig, until};
use proprio_topics::Nanos;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::process::Output;

/// The session begins so long after 1970-01-01.
const T0: Nanos = Nanos::from_millis(100_000);
/// The robot's buses under the names of channels 1 and 2.
const BUSES: [&str; 2] = ["can0", "can1"];

/// A session of the simulated robot: its frames with their times and channels, from 0 on.
fn session(robot: &SimulatedRobot, seconds: f64) -> (Vec<(Nanos, usize, Frame)>, Vec<u8>) {
    let mut log = Vec::new();
    record(robot, &SimulationSettings::default(), seconds, T0, &mut log)
        .expect("memory can be written");
    let mut reader = LogReader::new(&log[..]);
    let mut frames = Vec::new();
    while let Some(record) = reader.next_record().expect("memory can be read") {
        let channel = BUSES.iter().position(|bus| *bus == record.interface);
        let t = record.stamp.expect("a stamp");
        frames.push((t, channel.expect("one of the buses"), record.frame));
    }
    (frames, log)
}

fn hex(data: &[u8]) -> String {
    data.iter().fold(String::new(), |mut text, byte| {
        write!(text, " {byte:02X}").expect("memory can be written");
        text
    })
}

fn asc(frames: &[(Nanos, usize, Frame)]) -> Vec<u8> {
    let mut text = "date Thu Jan 1 00:01:00.000 1970\nbase hex  timestamps absolute\n\
                    internal events logged\n// version 9.0.0\n"
        .to_owned();
    for (t, channel, frame) in frames {
        let t = t.0 - 60_000_000_000;
        let (seconds, micros) = (t / 1_000_000_000, t / 1_000 % 1_000_000);
        let id = match frame.id {
            Id::Standard(id) => format!("{id:X}"),
            Id::Extended(id) => format!("{id:X}x"),
        };
        let (channel, data) = (channel + 1, hex(frame.data()));
        let length = frame.len();
        writeln!(
            text,
            "{seconds:4}.{micros:06} {channel}  {id:<15} Rx   d {length:X}{data}  Length = 0"
        )
        .expect("memory can be written");
    }
    text += "End TriggerBlock\n";
    text.into()
}

fn trc(frames: &[(Nanos, usize, Frame)]) -> Vec<u8> {
    let mut text = ";$FILEVERSION=2.1\r\n;$STARTTIME=25569\r\n;$COLUMNS=N,O,T,B,I,d,R,L,D\r\n\
                    ;---+-- ------+------ +- +- --+----- +- +- +--- +- -- -- --\r\n"
        .to_owned();
    for (number, (t, channel, frame)) in frames.iter().enumerate() {
        let id = match frame.id {
            Id::Standard(id) => format!("{id:04X}"),
            Id::Extended(id) => format!("{id:08X}"),
        };
        let (ms, micros) = (t.0 / 1_000_000, t.0 / 1_000 % 1_000);
        let (number, channel, data) = (number + 1, channel + 1, hex(frame.data()));
        let length = frame.len();
        write!(
            text,
            "{number:7} {ms:9}.{micros:03} DT {channel}  {id:>8} Rx -  {length}   {data}\r\n"
        )
        .expect("memory can be written");
    }
    text.into()
}

/// A container with all objects that is not packed.
fn blf(frames: &[(Nanos, usize, Frame)]) -> Vec<u8> {
    let mut objects = Vec::new();
    for (t, channel, frame) in frames {
        let id = match frame.id {
            Id::Standard(id) => u32::from(id),
            Id::Extended(id) => id | 0x8000_0000,
        };
        let mut data = [0; 8];
        data[..frame.len()].copy_from_slice(frame.data());
        objects.extend(b"LOBJ\x20\0\x01\0\x30\0\0\0\x01\0\0\0\x02\0\0\0\0\0\0\0");
        objects.extend(t.0.to_le_bytes());
        objects.extend([*channel as u8 + 1, 0, 0, frame.len() as u8]);
        objects.extend(id.to_le_bytes());
        objects.extend(data);
    }
    let mut file = vec![0; 144];
    file[..8].copy_from_slice(b"LOGG\x90\0\0\0");
    let start = [1970_u16, 1, 4, 1].map(u16::to_le_bytes).concat();
    file[40..48].copy_from_slice(&start);
    file.extend(b"LOBJ\x10\0\x01\0");
    file.extend((32 + objects.len() as u32).to_le_bytes());
    file.extend(b"\x0A\0\0\0\0\0\0\0\0\0\0\0");
    file.extend((objects.len() as u32).to_le_bytes());
    file.extend([0; 4]);
    file.extend(objects);
    file
}

/// python-can's table, which has no channels.
fn csv(frames: &[(Nanos, usize, Frame)]) -> Vec<u8> {
    let mut text = "timestamp,arbitration_id,extended,remote,error,dlc,data\n".to_owned();
    for (t, _, frame) in frames {
        let (id, extended) = match frame.id {
            Id::Standard(id) => (u32::from(id), 0),
            Id::Extended(id) => (id, 1),
        };
        let (data, length) = (base64(frame.data()), frame.len());
        writeln!(text, "{t},0x{id:x},{extended},0,0,{length},{data}")
            .expect("memory can be written");
    }
    text.into()
}

fn base64(data: &[u8]) -> String {
    let digits = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::new();
    for three in data.chunks(3) {
        let mut bytes = [0; 4];
        bytes[1..=three.len()].copy_from_slice(three);
        let bits = u32::from_be_bytes(bytes);
        for place in 0..4 {
            let digit = digits[(bits >> (18 - 6 * place) & 63) as usize] as char;
            text.push(if place > three.len() { '=' } else { digit });
        }
    }
    text
}

fn decode(rig: &Rig, config: &str, log: &str) -> Output {
    rig.command(&["decode", "--config", config, "--log", log, "--out", "-"])
        .output()
        .expect("proprio can be started")
}

#[test]
fn every_format_gives_the_same_table() {
    let rig = Rig::new();
    let arm = Arm::new().on_interfaces(BUSES).write(&rig.path("arm"));
    let (frames, log) = session(&arm.robot, 2.0);
    assert!(frames.iter().all(|(_, _, f)| f.format == Format::Classic));
    let write = |name: &str, log: &[u8]| {
        // A name tells nothing.
        let path = rig.path(name);
        std::fs::write(&path, log).expect("a file in a temporary folder");
        path.to_str().expect("a path in UTF-8").to_owned()
    };
    let table = |config: &str, log: &str| {
        let ran = decode(&rig, config, log);
        let text = String::from_utf8_lossy(&ran.stderr).into_owned();
        assert!(ran.status.success(), "{text}");
        assert!(text.contains("0 of other interfaces, 0 "), "{text}");
        String::from_utf8(ran.stdout).expect("text")
    };
    let truth = table(&arm.gateway, &write("a", &log));
    assert!(truth.lines().count() > 1_000);
    for (name, log) in [
        ("b", asc(&frames)),
        ("c", blf(&frames)),
        ("d", trc(&frames)),
    ] {
        let log = write(name, &log);
        assert!(
            table(&arm.gateway, &log) == truth,
            "{name}: not the same table"
        );
    }
    // One bus takes a channel of any name; the table without channels is that of one bus, too.
    let gateway = std::fs::read_to_string(&arm.gateway).expect("a file");
    let mut gateway: toml::Table = gateway.parse().expect("a configuration");
    let buses = gateway["bus"].as_array_mut().expect("the buses");
    buses.truncate(1);
    let one = write("one.toml", gateway.to_string().as_bytes());
    let first: Vec<_> = frames
        .iter()
        .filter(|(_, bus, _)| *bus == 0)
        .copied()
        .collect();
    let truth = table(&one, &write("e", &asc(&first)));
    assert!(truth.lines().count() > 500);
    let renamed: Vec<_> = first.iter().map(|(t, _, frame)| (*t, 6, *frame)).collect();
    for (name, log) in [
        ("f", csv(&first)),
        ("g", blf(&renamed)),
        ("h", trc(&renamed)),
    ] {
        assert!(
            table(&one, &write(name, &log)) == truth,
            "{name}: not the same table"
        );
    }
}

#[test]
fn a_misleading_file_gives_one_message() {
    let rig = Rig::new();
    let arm = Arm::new().on_interfaces(BUSES).write(&rig.path("arm"));
    let utf_16 = "date Thu Jan 1 00:01:00.000 1970\n".encode_utf16();
    let utf_16: Vec<u8> = utf_16.flat_map(u16::to_le_bytes).collect();
    for (log, what) in [
        (
            &b"%PDF-1.7\n%\xE2\xE3\xCF\xD3\n1 0 obj\n"[..],
            "it is a PDF document",
        ),
        (b"", "it is empty"),
        (
            &[b"\xFF\xFE", &utf_16[..]].concat(),
            "text in UTF-16: save it as UTF-8",
        ),
        (
            b"\x1F\x8B\x08\0\0\0\0\0\0\x03",
            "compressed with gzip: unpack it first",
        ),
        (
            b"\0\x01\x02\x03\x04\x05\x06\x07\n",
            "none of the formats that can be read",
        ),
        (
            b"Time;Channel;ID\n1;2;3\n",
            "a table with columns other than python-can's",
        ),
        (b"LOGG\x90\0\0\0", "the file was cut off"),
    ] {
        let path = rig.path("log");
        std::fs::write(&path, log).expect("a file in a temporary folder");
        let path = path.to_str().expect("a path in UTF-8");
        let ran = decode(&rig, &arm.gateway, path);
        let text = String::from_utf8_lossy(&ran.stderr).into_owned();
        assert_eq!(ran.status.code(), Some(1), "{text}");
        assert_eq!(text.lines().count(), 1, "{text}");
        assert!(
            text.contains("the log holds no frame") && text.contains(what),
            "{text}"
        );
    }
}

#[test]
fn a_gateway_replays_every_format() {
    let rig = Rig::new();
    let arm = Arm::new().on_interfaces(BUSES).write(&rig.path("arm"));
    let (mut frames, mut log) = session(&arm.robot, 1.0);
    // A frame of nobody and a silence, so that the reader of the samples comes in time.
    let early = (
        T0 - Nanos::from_millis(2_000),
        0,
        Frame::new(Id::standard(0x7FF), &[0]),
    );
    frames.insert(0, early);
    let mut all_of_it = b"(0000000098.000000) can0 7FF#00\n".to_vec();
    all_of_it.append(&mut log);
    let log = all_of_it;
    let mut all = Vec::new();
    for (name, log) in [
        ("candump", log),
        ("asc", asc(&frames)),
        ("blf", blf(&frames)),
    ] {
        let rig = Rig::new();
        std::fs::write(rig.path("log"), log).expect("a file in a temporary folder");
        let gateway = std::fs::read_to_string(&arm.gateway).expect("a file");
        let mut gateway: toml::Table = gateway.parse().expect("a configuration");
        for (bus, name) in gateway["bus"]
            .as_array_mut()
            .expect("buses")
            .iter_mut()
            .zip(BUSES)
        {
            bus["name"] = name.into();
            let source = [("kind", "replay"), ("log", "log")];
            let source = source.map(|(key, value)| (key.to_owned(), value.into()));
            bus["source"] = toml::Table::from_iter(source).into();
        }
        let config = rig.path("gateway.toml");
        std::fs::write(&config, gateway.to_string()).expect("a file in a temporary folder");
        let domain = rig.open();
        let mut process = rig.start(&["gateway", "--config", config.to_str().expect("a path")]);
        let mut samples = Recorder::of_samples(&domain, "icub_left_arm");
        // It ends when its logs have ended.
        let ended = until(PATIENCE, || {
            samples.take();
            process.ended()
        });
        assert!(
            ended.is_some_and(|status| status.success()),
            "{}",
            process.log()
        );
        samples.take();
        let log = process.log();
        assert!(!log.contains("skipped"), "{log}");
        let ends = log
            .lines()
            .filter_map(|line| line.split_once("the log has ended "));
        let ends: BTreeSet<String> = ends.map(|(_, end)| end.to_owned()).collect();
        all.push((name, ends, samples.by_channel()));
    }
    // A reader that comes late misses the first samples.
    let (_, ends, truth) = &all[0];
    assert!(
        ends.len() == 2 && truth.len() > 8,
        "{ends:?}, {} channels",
        truth.len()
    );
    for (name, found_ends, found) in &all[1..] {
        assert_eq!(found_ends, ends, "{name}");
        let mut compared = 0;
        for (channel, found) in found {
            let truth = &truth[channel];
            let common = truth.len().min(found.len());
            let last = |samples: &[String]| samples[samples.len() - common..].to_vec();
            assert_eq!(last(found), last(truth), "{name}: {channel}");
            compared += common;
        }
        assert!(compared > 200, "{name}: {compared} samples");
    }
}
