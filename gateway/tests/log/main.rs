//! Logs in formats other than candump's: files that python-can wrote, lines and objects as the
//! formats' own programs write them, damage, and what is no log at all.
#![allow(missing_docs, clippy::unwrap_used)]

mod peak;
mod vector_binary;
mod vector_text;

use flate2::Compression;
use flate2::write::ZlibEncoder;
use proprio_drivers::{Format, Frame, Id};
use proprio_gateway::link::replay::{Matching, Pace, Replay};
use proprio_gateway::link::{Link, Received};
use proprio_gateway::log::{FrameDirection, LineError, LogFormat, LogReader, LogReport};
use proprio_topics::{Nanos, StampKind};
use proptest::prelude::*;
use std::io::{BufReader, Cursor, Write as _};
use std::path::{Path, PathBuf};
use std::process::Command;

/// A record without its borrow; the frame without its stamp.
#[derive(Debug, Clone, PartialEq)]
struct Entry {
    t: Option<Nanos>,
    interface: String,
    direction: Option<FrameDirection>,
    frame: Frame,
}

/// What was read of a log.
struct Read {
    entries: Vec<Entry>,
    format: Option<LogFormat>,
    report: LogReport,
    why_empty: String,
}

fn read_with(log: &[u8], buffer: usize) -> Read {
    let mut reader = LogReader::new(BufReader::with_capacity(buffer, Cursor::new(log)));
    let mut entries = Vec::new();
    while let Some(record) = reader.next_record().unwrap() {
        let stamp = record.stamp.map_or(StampKind::None, |_| StampKind::Log);
        assert_eq!(record.frame.stamp, stamp);
        assert_eq!(record.frame.t, record.stamp.unwrap_or_default());
        entries.push(Entry {
            t: record.stamp,
            interface: record.interface.to_owned(),
            direction: record.direction,
            frame: record.frame.at(Nanos::ZERO, StampKind::None),
        });
    }
    // The end stays the end.
    assert!(reader.next_record().unwrap().is_none());
    Read {
        entries,
        format: reader.format(),
        report: reader.report().clone(),
        why_empty: reader.why_empty(),
    }
}

fn read(log: &[u8]) -> Read {
    read_with(log, 1 << 16)
}

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/log")
}

fn file(name: &str) -> Vec<u8> {
    std::fs::read(folder().join(name)).unwrap()
}

/// The files that python-can wrote.
const FILES: [(&str, LogFormat); 7] = [
    ("bus.log", LogFormat::Candump),
    ("bus.asc", LogFormat::Asc),
    ("bus.blf", LogFormat::Blf),
    ("stored.blf", LogFormat::Blf),
    ("straddling.blf", LogFormat::Blf),
    ("bus.trc", LogFormat::Trc),
    ("bus.csv", LogFormat::Csv),
];

/// What python-can keeps of a message in this format; `None` if it does not write it.
fn kept(format: LogFormat, mut entry: Entry) -> Option<Entry> {
    match format {
        LogFormat::Trc if entry.frame.format != Format::Classic => return None,
        LogFormat::Csv => {
            entry.interface = "can0".to_owned();
            entry.direction = None;
            if let Format::Fd { .. } = entry.frame.format {
                let data = entry.frame.data();
                let fd = Format::Fd {
                    bit_rate_switch: false,
                    error_state: false,
                };
                let format = if data.len() > 8 { fd } else { Format::Classic };
                entry.frame = Frame::with_format(entry.frame.id, format, data)?;
            }
        }
        _ => {}
    }
    Some(entry)
}

/// Asserts that the files in `folder` have the messages of its candump log.
fn assert_same_messages(folder: &Path) -> usize {
    let frames = |name: &str| read(&std::fs::read(folder.join(name)).unwrap());
    let truth = frames("bus.log");
    assert_eq!(truth.report.bad, 0);
    for (name, format) in FILES {
        let found = frames(name);
        assert_eq!(found.format, Some(format), "{name}");
        assert_eq!(found.report.bad, 0, "{name}: {:?}", found.report);
        let expected = truth.entries.iter().cloned();
        let expected: Vec<Entry> = expected.filter_map(|e| kept(format, e)).collect();
        assert_eq!(found.entries.len(), expected.len(), "{name}");
        for (mut found, expected) in found.entries.into_iter().zip(expected) {
            let error = (found.t.unwrap() - expected.t.unwrap()).0.abs();
            if format == LogFormat::Blf {
                // python-can subtracts doubles, which have steps of 0.24 us at this time.
                assert!(error < 1_000, "{name}: {error} ns");
                found.t = expected.t;
                // Its BLF has a direction for an error frame only by accident.
            }
            assert_eq!(found, expected, "{name}");
        }
    }
    truth.entries.len()
}

#[test]
fn every_format_of_one_bus_gives_the_same_frames() {
    assert_eq!(assert_same_messages(&folder()), 24);
    // The log has every kind of frame.
    let log = read(&file("bus.log"));
    let has = |what: &dyn Fn(&Frame) -> bool| log.entries.iter().any(|e| what(&e.frame));
    assert!(has(&|f| f.format == Format::Remote) && has(&|f| f.format == Format::Error));
    assert!(has(
        &|f| matches!(f.format, Format::Fd { .. }) && f.len() == 64
    ));
    assert!(has(&|f| matches!(f.id, Id::Extended(_))));
    assert_eq!(log.entries[0].t, Some(Nanos(1_700_000_000_125_000_000)));
}

#[test]
fn what_python_can_writes_from_random_messages_is_read() {
    let installed = Command::new("python3")
        .args(["-c", "import can; print(can.__version__)"])
        .output();
    if !installed.is_ok_and(|out| out.status.success()) {
        println!("skipped: python3 with python-can is not installed");
        return;
    }
    for seed in 1..=4 {
        let place = tempfile::tempdir().unwrap();
        let ran = Command::new("python3")
            .arg(folder().join("write.py"))
            .arg(place.path())
            .args([seed.to_string(), "3000".to_owned()])
            .output()
            .unwrap();
        assert!(ran.status.success(), "{ran:?}");
        assert_eq!(assert_same_messages(place.path()), 3000);
    }
}

fn classic(id: u16, data: &[u8]) -> Frame {
    Frame::new(Id::standard(id), data)
}

fn fd(id: Id, bit_rate_switch: bool, error_state: bool, data: &[u8]) -> Frame {
    let format = Format::Fd {
        bit_rate_switch,
        error_state,
    };
    Frame::with_format(id, format, data).unwrap()
}

fn bus_error() -> Frame {
    Frame::with_format(Id::extended(0x80), Format::Error, &[]).unwrap()
}

fn frames(read: &Read) -> Vec<Frame> {
    read.entries.iter().map(|e| e.frame).collect()
}

fn stamps(read: &Read) -> Vec<i64> {
    read.entries.iter().map(|e| e.t.unwrap().0).collect()
}

/// As CANoe and CANalyzer write it.
const ASC: &str = "\
date Sam Sep 30 15:06:13.191 2017
base hex  timestamps absolute
internal events logged
// version 9.0.0
//0.000000 previous log file: other.asc
Begin Triggerblock Sam Sep 30 15:06:13.191 2017
   0.000000 Start of measurement
   0.015991 CAN 1 Status:chip status error passive - TxErr: 132 RxErr: 0
   1.015991 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%
   1.1 1  18EBFF00x       Rx   d 8 01 A0 0F A6 60 3B D1 40  Length = 273910 BitCount = 141 ID = 4x
   1.2 1  J1939TP FEE3p        6    0  0   -   Rx   d 9 A0 0F A6 60 3B D1 40 1F DE
   1.3 2  3FF             Tx   d D 55 AA 01 02 03 04 05 06  Length = 232016
   1.35 2  3FF             TxRq d 1 55
   1.4 2 100 Rx r
   1.5 3 200 Tx r Length = 1704000 BitCount = 145 ID = 88888888x
   1.6 4 300x Rx r 8 Length = 1704000 BitCount = 145 ID = 88888888x
   1.7 1 ErrorFrame ECC: 10100010
   1.75 L1 3C              Rx 8 01 02 03 04 05 06 07 08 checksum = 21
   1.8 CANFD   6 Rx         7d  BrakeSnData_4   1 0 8  8 01 1b d6 d0 8a 1f d7 f6 10 13 323000 a8
   1.9 CANFD   7 Tx        716x                 0 1 9 12 1 2 3 4 5 6 7 8 9 a b ff 0 0 5000 0 0 0
   2.0 CANFD   3 Tx     50005x                  0 1 5 0 140000 73 200050 7a60 46500250 460a0250
   2.1 CANFD   3 Rx        117                  0 0 2  2 AB CD 130000 130 0 0 0 0 0 0
   2.15 CANFD  3 Rx        117                  0 0 9 12 1 2 3 4 5 6 7 8 9 a b c 0 0 0 0 0 0
   2.2 CANFD   5 Tx ErrorFrame Not Acknowledge error, dominant error flag fffe c7 31ca Arb. 556 44
   2.3 SV: 3 0 1 ::CANoe::UnknownSysVar = \"::CANoe::Simulation\"
   2.4 1  OverloadFrame
End TriggerBlock
";

/// A log of each version of PEAK's format: the same frames, as far as the version has them.
fn trcs() -> [(&'static str, String, usize); 6] {
    let start = ";$STARTTIME=44548.6028595139\n;\n;   Start time: 18.12.2021 14:28:07.062.0\n";
    [
        (
            "1.0",
            ";####################\n;   C:\\TraceFile.trc\n;\n;    PCAN-Net: PCI1\n\
             ;----+-   ---+---  ----+---  +  -+ -- -- ...\n\
             \x20    1)      1841      0300  7  00 00 00 00 04 00 0A\n\
             \x20    2)      1843  FFFFFFFF  4  00 00 00 04 -- -- -- --  BUSLIGHT\n\
             \x20    3)      1850  18EFC034  2  01 02\n\
             \x20    4)      1860      0100  3  RTR\n\
             \x20    5)      1870      0008  4  ERROR 00 19 08 08\n"
                .to_owned(),
            4,
        ),
        (
            "1.1",
            format!(
                ";$FILEVERSION=1.1\n{start}\
                 \x20    1)      1841.0  Rx         0300  7  00 00 00 00 04 00 0A\n\
                 \x20    2)      1843.0  Warng  FFFFFFFF  4  00 00 00 04  BUSLIGHT\n\
                 \x20    3)      1850.0  Tx     18EFC034  2  01 02\n\
                 \x20    4)      1860.0  Rx         0100  3  RTR\n\
                 \x20    5)      1870.0  Error      0008  4  00 19 08 08\n"
            ),
            4,
        ),
        (
            "1.2",
            format!(
                ";$FILEVERSION=1.2\n{start}\
                 \x20    1)      1841.000  1  Rx         0300  7  00 00 00 00 04 00 0A\n\
                 \x20    2)      1843.000  1  Warng  FFFFFFFF  4  00 00 00 04  BUSLIGHT\n\
                 \x20    3)      1850.000  2  Tx     18EFC034  2  01 02\n\
                 \x20    4)      1860.000  1  Rx         0100  3  RTR\n\
                 \x20    5)      1870.000  1  Error      0008  4  00 19 08 08\n"
            ),
            4,
        ),
        (
            "1.3",
            format!(
                ";$FILEVERSION=1.3\n{start}\
                 \x20    1)      1841.000 1  Rx        0300 -  7    00 00 00 00 04 00 0A\n\
                 \x20    2)      1843.000 1  Warng FFFFFFFF -  4    00 00 00 04  BUSLIGHT\n\
                 \x20    3)      1850.000 2  Tx    18EFC034 -  2    01 02\n\
                 \x20    4)      1860.000 1  Rx        0100 -  3    RTR\n\
                 \x20    5)      1870.000 1  Error     0008 -  4    00 19 08 08\n"
            ),
            4,
        ),
        (
            "2.0",
            format!(
                ";$FILEVERSION=2.0\n{start};$COLUMNS=N,O,T,I,d,l,D\n\
                 \x20     1      1841.000 DT     0300 Rx 7  00 00 00 00 04 00 0A\n\
                 \x20     2      1843.000 ST          Rx    00 00 00 08\n\
                 \x20     3      1850.000 DT 18EFC034 Tx 2  01 02\n\
                 \x20     4      1860.000 RR     0100 Rx 3\n\
                 \x20     5      1870.000 ER          Rx    04 00 02 00 00\n\
                 \x20     6      1875.000 EC          Rx    02 02\n\
                 \x20     7      1880.000 FD     0500 Tx 12 01 02 03 04 05 06 07 08 09 0A 0B 0C\n\
                 \x20     8      1880.250 FB     0500 Tx 1  01\n\
                 \x20     9      1880.500 FE     0500 Tx 0\n\
                 \x20    10      1880.750 BI 00000500 Tx 1  01\n"
            ),
            8,
        ),
        (
            "2.1",
            format!(
                ";$FILEVERSION=2.1\n{start};$COLUMNS=N,O,T,B,I,d,R,L,D\n\
                 \x20     1      1841.000 DT 1      0300 Rx -  7    00 00 00 00 04 00 0A\n\
                 \x20     2      1843.000 ST 1         - Rx -  4    00 00 00 08\n\
                 \x20     3      1850.000 DT 2  18EFC034 Tx -  2    01 02\n\
                 \x20     4      1860.000 RR 1      0100 Rx -  3\n\
                 \x20     5      1870.000 ER 1         - Rx -  5    04 00 02 00 00\n\
                 \x20     6      1872.000 EV 1  User-defined event for bus 1\n\
                 \x20     7      1873.000 EV -  User-defined event for all busses\n\
                 \x20     8      1875.000 EC 1         - Rx -  2    02 02\n\
                 \x20     9      1880.000 FD 1      0500 Tx -  9    01 02 03 04 05 06 07 08 09 0A \
                 0B 0C\n\
                 \x20    10      1880.250 FB 1      0500 Tx -  1    01\n\
                 \x20    11      1880.500 FE 1      0500 Tx -  0\n\
                 \x20    12      1880.750 BI 1  00000500 Tx -  1    01\n"
            ),
            8,
        ),
    ]
}

#[test]
fn tables_of_python_can_are_read_and_others_refused() {
    const HEADER: &str = "timestamp,arbitration_id,extended,remote,error,dlc,data\n";
    // Times as Python prints doubles.
    let rows = "1.9e-09,0x7,0,0,0,0,\n5e-05,0x123,0,0,0,1,AQ==\n0.1000001,0x123,1,0,0,0,\n\
                1e+02,0x0,1,0,1,0,\n\
                1483389946.1970001,0xdadada,1,1,0,6,\n";
    let expected = [
        (2, classic(7, &[])),
        (50_000, classic(0x123, &[1])),
        (100_000_100, Frame::new(Id::extended(0x123), &[])),
        (100_000_000_000, bus_error()),
        (
            1_483_389_946_197_000_100,
            Frame::remote(Id::extended(0xDA_DADA), 6),
        ),
    ];
    // python-can writes no header to a file that it appends to.
    for log in [
        format!("{HEADER}{rows}"),
        rows.to_owned(),
        format!("{HEADER}{rows}{HEADER}"),
    ] {
        let found = read(log.as_bytes());
        assert_eq!(
            (found.format, found.report.bad),
            (Some(LogFormat::Csv), 0),
            "{log}"
        );
        let found: Vec<_> = stamps(&found).into_iter().zip(frames(&found)).collect();
        assert_eq!(found, expected);
    }
    for (row, error) in [
        ("x,0x1,0,0,0,0,", LineError::Time),
        ("1.0,1,0,0,0,0,", LineError::Number),
        (
            "1.0,0x800,0,0,0,0,",
            LineError::IdentifierRange {
                id: 0x800,
                bits: 11,
            },
        ),
        ("1.0,0x1,2,0,0,0,", LineError::Row),
        ("1.0,0x1,0,0,0,x,", LineError::Row),
        ("1.0,0x1,0,0,0,0", LineError::Row),
        ("1.0,0x1,0,0,0,0,,", LineError::Row),
        ("1.0,0x1,0,0,0,1,A", LineError::Base64),
        (
            "1.0,0x1,0,0,0,2,AQ==",
            LineError::Missing {
                declared: 2,
                found: 1,
            },
        ),
        (
            "1.0,0x1,0,0,0,65,",
            LineError::Missing {
                declared: 65,
                found: 0,
            },
        ),
    ] {
        let found = read(format!("{HEADER}{row}\n1.0,0x1,0,0,0,0,\n").as_bytes());
        assert_eq!(found.report.first_bad.as_slice(), [(2, error)], "{row}");
        assert_eq!(found.entries.len(), 1);
    }
    for other in [
        "Time [s],ID,Length,Data\n0.1,291,1,01\n",
        "t,joint/elbow/position,joint/elbow/velocity\n0.1,1,2\n",
        "Time;Channel;ID\n1;2;3\n",
        "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2\n1,00000123,false,Rx,0,1,00,\n",
    ] {
        let found = read(other.as_bytes());
        assert_eq!(
            (found.entries.len(), found.report.lines, found.report.bad),
            (0, 1, 1)
        );
        assert!(
            found.why_empty.contains("columns other than python-can's"),
            "{other}"
        );
    }
}

/// The object of `kind` with `body`.
fn object(kind: u32, version: u16, flags: u32, t: i64, body: &[u8]) -> Vec<u8> {
    let mut header = [flags.to_le_bytes(), [0; 4]].concat();
    header.extend(t.to_le_bytes());
    if version == 2 {
        header.extend([0xEE; 8]);
    }
    let size = 16 + header.len();
    let mut object = b"LOBJ".to_vec();
    object.extend((size as u16).to_le_bytes());
    object.extend(version.to_le_bytes());
    object.extend(((size + body.len()) as u32).to_le_bytes());
    object.extend(kind.to_le_bytes());
    object.extend(header);
    object.extend(body);
    object
}

/// With the padding that follows it.
fn padded(mut object: Vec<u8>) -> Vec<u8> {
    let padding = object.len() % 4;
    object.extend(std::iter::repeat_n(0, padding));
    object
}

fn container(packing: u16, contents: &[u8]) -> Vec<u8> {
    let packed = if packing == 2 {
        let mut zlib = ZlibEncoder::new(Vec::new(), Compression::default());
        zlib.write_all(contents).unwrap();
        zlib.finish().unwrap()
    } else {
        contents.to_vec()
    };
    let mut container = b"LOBJ\x10\0\x01\0".to_vec();
    container.extend((32 + packed.len() as u32).to_le_bytes());
    container.extend(10_u32.to_le_bytes());
    container.extend(packing.to_le_bytes());
    container.extend([0; 6]);
    container.extend((contents.len() as u32).to_le_bytes());
    container.extend([0; 4]);
    container.extend(packed);
    padded(container)
}

/// A file that began at 2017-09-30 15:06:13.191.
fn blf(parts: &[&[u8]]) -> Vec<u8> {
    let mut file = vec![0; 144];
    file[..8].copy_from_slice(b"LOGG\x90\0\0\0");
    let date = [2017_u16, 9, 6, 30, 15, 6, 13, 191].map(u16::to_le_bytes);
    file[40..56].copy_from_slice(&date.concat());
    for part in parts {
        file.extend(*part);
    }
    let size = (file.len() as u64).to_le_bytes();
    file[16..24].copy_from_slice(&size);
    file
}

/// CAN_MESSAGE2 of channel 1 with one byte.
fn numbered(number: u8) -> Vec<u8> {
    let mut body = vec![1, 0, 0, 1, number, 0, 0, 0, number, 0, 0, 0, 0, 0, 0, 0];
    body.extend([0; 8]);
    padded(object(86, 1, 2, i64::from(number), &body))
}

const BLF_START: i64 = 1_506_783_973_191_000_000;

/// All logs above and of python-can.
fn logs() -> Vec<(String, Vec<u8>)> {
    let mut logs: Vec<(String, Vec<u8>)> = FILES
        .iter()
        .map(|(name, _)| ((*name).to_owned(), file(name)))
        .collect();
    logs.push(("asc".to_owned(), ASC.into()));
    // Lengths that are the beginning of others, and a word that may be missing.
    let rtr = ";$FILEVERSION=1.1\n 1) 1.0 Rx 0100 0 RTR\n";
    let long = ";$FILEVERSION=2.1\n;$COLUMNS=O,T,I,d,L,D\n1.0 RR 0100 Rx 12\n";
    logs.push(("rtr".to_owned(), rtr.into()));
    logs.push(("long".to_owned(), long.into()));
    logs.extend(trcs().map(|(version, text, _)| (version.to_owned(), text.into())));
    logs
}

#[test]
fn a_log_cut_anywhere_yields_a_beginning_of_its_frames() {
    for (name, log) in logs() {
        let whole = read(&log).entries;
        let what = |entries: &[Entry]| {
            // The direction may be cut off.
            entries
                .iter()
                .map(|e| (e.t, e.interface.clone(), e.frame))
                .collect::<Vec<_>>()
        };
        let mut most = 0;
        for end in 0..log.len() {
            let found = read(&log[..end]);
            let count = found.entries.len();
            assert!(
                what(&whole).starts_with(&what(&found.entries)),
                "{name}: {end}"
            );
            assert!(count >= most, "{name}: {end}");
            most = count;
            // Every line that ended is read, and a line or object that did not is told.
            let binary = log.starts_with(b"LOGG");
            let is_told = found.report.bad > 0;
            if binary {
                assert!(is_told || end == 0 || count == whole.len(), "{name}: {end}");
            } else if !is_told {
                assert_eq!(read(&[&log[..end], b"\n"].concat()).entries.len(), count);
            }
            assert!(found.report.bad <= 1, "{name}: {end}: {:?}", found.report);
        }
        assert!(most + 1 >= whole.len(), "{name}");
    }
}

#[test]
fn the_size_of_the_buffer_makes_no_difference() {
    for (name, log) in logs() {
        let whole = read(&log).entries;
        for buffer in [1, 2, 3, 5, 17, 64] {
            assert_eq!(read_with(&log, buffer).entries, whole, "{name}: {buffer}");
        }
    }
}

proptest! {
    #[test]
    fn any_bytes_are_legal_input(
        bytes in proptest::collection::vec(any::<u8>(), 0..300),
        start in 0..16_usize,
    ) {
        read(&bytes);
        // After the beginning of a log.
        let (_, log) = &logs()[start];
        let begun = log.len() * 3 / 4;
        read(&[&log[..begun], &bytes].concat());
        let mut packed = container(2, &bytes);
        read(&blf(&[&packed]));
        packed[16] = 0;
        read(&blf(&[&packed]));
    }

    #[test]
    fn damaged_logs_are_legal_input(
        at in any::<usize>(),
        byte in any::<u8>(),
        start in 0..16_usize,
    ) {
        let (_, mut log) = logs().swap_remove(start);
        let at = at % log.len();
        log[at] = byte;
        let found = read(&log);
        prop_assert_eq!(found.entries.len() as u64, found.report.records);
        let objects: Vec<u8> = (0..20).flat_map(numbered).collect();
        let mut objects = container(0, &objects);
        let at = at % objects.len();
        objects[at] = byte;
        let found = read(&blf(&[&objects]));
        // One byte hits the container's header, or an object: it, the one before, and others if it
        // looks longer, up to 512 bytes.
        let count = found.entries.len();
        prop_assert!(count >= 20 - 2 - 512 / 56 || at < 32, "{} of 20", count);
    }
}

#[test]
fn what_is_no_log_is_named() {
    let utf_16 = |text: &str| {
        text.encode_utf16()
            .flat_map(u16::to_le_bytes)
            .collect::<Vec<u8>>()
    };
    let asc = utf_16(ASC);
    for (log, what) in [
        (
            &b"%PDF-1.7\n%\xE2\xE3\xCF\xD3\n1 0 obj\n"[..],
            "it is a PDF document",
        ),
        (
            b"\x1F\x8B\x08\x00\x00\x00\x00\x00\x00\x03",
            "gzip: unpack it first",
        ),
        (b"BZh91AY&SY", "bzip2: unpack it first"),
        (b"\xFD7zXZ\x00\x00\x04", "xz: unpack it first"),
        (b"\x28\xB5\x2F\xFD\x04\x00", "zstd: unpack it first"),
        (
            b"PK\x03\x04\x14\x00\x06\x00",
            "a zip archive or an office document",
        ),
        (b"MDF     4.10    ", "an MDF file: convert it"),
        (b"SQLite format 3\0", "an SQLite database"),
        (b"\n\r\r\n\x1C\0\0\0\x4D\x3C\x2B\x1A", "a pcapng capture"),
        (b"\xD4\xC3\xB2\xA1\x02\0\x04\0", "a pcap capture"),
        (
            &[b"\xFF\xFE", &asc[..]].concat(),
            "text in UTF-16: save it as UTF-8",
        ),
        (&asc, "text in UTF-16: save it as UTF-8"),
        (b"", "it is empty"),
        (b"\n\n# nothing\n", "none of its 3 lines is one"),
        (
            b"Once upon a time\nthere was a robot.\n",
            "none of the formats that can be read (candump, Vector ASC",
        ),
        (
            ASC.split_once("   1.1 ").unwrap().0.as_bytes(),
            "none of its 9 lines is one",
        ),
        (
            b"base hex\n1.0 1 100 Rx d\n",
            "the first that cannot be read is line 2: the length",
        ),
        (b"LOGG", "object 1: the file was cut off"),
        (&blf(&[]), "it is empty"),
    ] {
        let found = read(log);
        assert_eq!(found.entries.len(), 0, "{what}");
        assert!(
            found.why_empty.contains(what),
            "{} instead of {what}",
            found.why_empty
        );
    }
    // A line of candump's first decides, as does a garbled line before the others' headers.
    let log = format!("garbage\nMon, Tue, Wed\n{ASC}");
    let found = read(log.as_bytes());
    assert_eq!((found.entries.len(), found.report.bad), (12, 2));
    let found = read(format!("(1.0) can0 123#\n{ASC}").as_bytes());
    assert_eq!(
        (found.entries.len(), found.format),
        (1, Some(LogFormat::Candump))
    );
}

#[test]
fn logs_are_replayed_at_their_pace() {
    for name in ["bus.asc", "bus.blf", "bus.trc", "bus.csv"] {
        let log = read(&file(name)).entries;
        let buses = [(Some("can0"), "left"), (None, "can1")];
        let mut links = [0, 1].map(|bus| {
            let matching = Matching::of(&buses, bus);
            Replay::open(&folder().join(name), Pace::Recorded, matching, &[]).unwrap()
        });
        let start = Nanos::from_millis(1);
        links.iter_mut().for_each(|link| link.start_at(start));
        for (link, interface) in links.iter_mut().zip(["can0", "can1"]) {
            let expected = log.iter().filter(|e| e.interface == interface);
            for entry in expected {
                // The clock is far beyond, so that every frame is due.
                let (Received::Frame(frame) | Received::Error(frame)) = link.recv(Nanos::ZERO)
                else {
                    panic!("{name}: no frame")
                };
                let t = start + (entry.t.unwrap() - log[0].t.unwrap());
                assert_eq!(frame, entry.frame.at(t, StampKind::Log), "{name}");
            }
            assert!(matches!(link.recv(Nanos::ZERO), Received::Ended), "{name}");
            let here = log.iter().filter(|e| e.interface == interface).count();
            assert_eq!(link.unmatched(), (log.len() - here) as u64, "{name}");
        }
    }
    let pdf = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(pdf.path(), "%PDF-1.7\n").unwrap();
    let error = Replay::open(pdf.path(), Pace::Recorded, None, &[]).unwrap_err();
    let text = error.to_string();
    assert!(
        text.contains("it holds no frame: it is a PDF document"),
        "{text}"
    );
}
