//! Logs in formats other than candump's: files that python-can wrote, lines and objects as the
//! formats' own programs write them, damage, and what is no log at all.
#![allow(missing_docs, clippy::unwrap_used)]

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
    let of = |name: &str| read(&std::fs::read(folder.join(name)).unwrap());
    let truth = of("bus.log");
    assert_eq!(truth.report.bad, 0);
    for (name, format) in FILES {
        let found = of(name);
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

fn asc_frames() -> Vec<Frame> {
    vec![
        Frame::new(
            Id::extended(0x18EB_FF00),
            &[0x01, 0xA0, 0x0F, 0xA6, 0x60, 0x3B, 0xD1, 0x40],
        ),
        classic(0x3FF, &[0x55, 0xAA, 1, 2, 3, 4, 5, 6]),
        Frame::remote(Id::standard(0x100), 0),
        Frame::remote(Id::standard(0x200), 0),
        Frame::remote(Id::extended(0x300), 8),
        bus_error(),
        fd(
            Id::standard(0x7D),
            true,
            false,
            &[0x01, 0x1B, 0xD6, 0xD0, 0x8A, 0x1F, 0xD7, 0xF6],
        ),
        fd(
            Id::extended(0x716),
            false,
            true,
            &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 255],
        ),
        Frame::remote(Id::extended(0x50005), 5),
        classic(0x117, &[0xAB, 0xCD]),
        // Whatever its flags say: no classic frame is so long.
        fd(
            Id::standard(0x117),
            false,
            false,
            &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12],
        ),
        bus_error(),
    ]
}

#[test]
fn what_vector_writes_as_text_is_read() {
    for text in [
        ASC.to_owned(),
        ASC.replace('\n', "\r\n"),
        format!("\u{feff}{ASC}"),
    ] {
        let found = read(text.as_bytes());
        assert_eq!(found.report.bad, 0, "{:?}", found.report);
        assert_eq!(frames(&found), asc_frames());
        let ms = [
            1100, 1300, 1400, 1500, 1600, 1700, 1800, 1900, 2000, 2100, 2150, 2200,
        ];
        // 2017-09-30 15:06:13.191.
        assert_eq!(
            stamps(&found),
            ms.map(|ms| (1_506_783_973_191 + ms) * 1_000_000)
        );
        let interfaces: Vec<&str> = found.entries.iter().map(|e| e.interface.as_str()).collect();
        let numbers = [0, 1, 1, 2, 3, 0, 5, 6, 2, 2, 2, 4];
        assert_eq!(interfaces, numbers.map(|n| format!("can{n}")));
        let (r, t) = (Some(FrameDirection::Received), Some(FrameDirection::Sent));
        let directions: Vec<_> = found.entries.iter().map(|e| e.direction).collect();
        assert_eq!(directions, [r, t, r, t, r, None, r, t, t, r, r, None]);
    }
    // A part without the header: hexadecimal, and from an unknown start.
    let part = ASC.split_once("0.00%\n").unwrap().1;
    let found = read(part.as_bytes());
    assert_eq!((frames(&found), found.report.bad), (asc_frames(), 0));
    assert_eq!(stamps(&found)[0], 1_100_000_000);
    for first in [
        "  1.7 1 ErrorFrame\n",
        " 1.8 CANFD 1 Rx 7d 1 0 0 0 0 0 1000 0\n",
    ] {
        assert_eq!(read(first.as_bytes()).entries.len(), 1, "{first}");
    }
}

#[test]
fn decimal_and_relative_text_of_vector_is_read() {
    // Lines with CANFD stay hexadecimal.
    let log = "date Mon Jun 4 12:04:42.117 pm 2018\n\
               base dec  timestamps relative\n\
               no internal events logged\n\
               100.5 5  469744131x      Rx   d 8 135 129  24  62 177   0 240   1  Length = 2\n\
               0.25 1 Statistic: D 2\n\
               0.125 CANFD 2 Rx fc ESC_51 1 0 9 12 67 ce ff 00 7e 0 40 6 0 0 0 10 0 0 1000 0\n\
               0.5 3  1003            Rx   d 2 9 10\n";
    let found = read(log.as_bytes());
    assert_eq!(found.report.bad, 0, "{:?}", found.report);
    let data = [0x67, 0xCE, 0xFF, 0, 0x7E, 0, 0x40, 6, 0, 0, 0, 0x10];
    let expected = [
        Frame::new(
            Id::extended(469_744_131),
            &[135, 129, 24, 62, 177, 0, 240, 1],
        ),
        fd(Id::standard(0xFC), true, false, &data),
        classic(1003, &[9, 10]),
    ];
    assert_eq!(frames(&found), expected);
    // 2018-06-04 12:04:42.117.
    let ms = [100_500, 100_875, 101_375].map(|ms| (1_528_113_882_117_i64 + ms) * 1_000_000);
    assert_eq!(stamps(&found), ms);
}

#[test]
fn the_start_of_a_text_of_vector_is_that_of_its_measurement() {
    let first = |header: &str| {
        let log = format!("{header}\n   0.5 1 100 Rx d 0\n");
        let found = read(log.as_bytes());
        (found.entries[0].t.unwrap().0, found.report.bad)
    };
    for (date, seconds) in [
        ("Sat Sep 30 03:06:13 pm 2017", 1_506_783_973),
        ("Sat Sep 30 03:06:13.000 PM 2017", 1_506_783_973),
        ("Sam Mai 27 04:09:35 2017", 1_495_858_175),
        ("Don M\u{e4}r 2 00:00:00 2017", 1_488_412_800),
        ("Mit Okt 4 12:00:00.000 am 2017", 1_507_075_200),
        ("Son Dez 31 12:59:59.000 am 2017", 1_514_681_999),
    ] {
        let start = seconds * 1_000_000_000 + 500_000_000;
        assert_eq!(
            first(&format!("date {date}\nbase hex")),
            (start, 0),
            "{date}"
        );
        let block = format!("base hex\nBegin Triggerblock {date}");
        assert_eq!(first(&block), (start, 0), "{date}");
    }
    // The same in Latin-1.
    let latin = b"date Don M\xe4r 2 00:00:00 2017\n 0.5 1 100 Rx d 0\n";
    assert_eq!(stamps(&read(latin)), [1_488_412_800_500_000_000]);
    // Milliseconds are a number.
    assert_eq!(
        first("date Sat Sep 30 15:06:13.5 2017").0,
        1_506_783_973_505_000_000
    );
    // The measurement starts in a block; a later block is of the same measurement.
    let header = "date Sat Sep 30 15:06:13 2017\nBegin Triggerblock Sat Sep 30 15:06:20 2017";
    assert_eq!(first(header).0, 1_506_783_973_500_000_000);
    let header = format!("{header}\n 0.0 Start of measurement");
    assert_eq!(first(&header).0, 1_506_783_980_500_000_000);
    // asammdf writes microseconds, and no trigger block.
    for (fraction, ns) in [
        (".123456", 123_456_000),
        (".1234", 123_400_000),
        (".123456789", 123_456_789),
        (",123456", 123_456_000),
        (".12", 12_000_000),
    ] {
        let date = format!("date Mon May 06 07:08:09{fraction} AM 2024\nbase hex");
        assert_eq!(first(&date).0, 1_714_979_289_500_000_000 + ns, "{fraction}");
    }
    // Other languages, in UTF-8 and Latin-1, and other orders.
    for date in [
        "lun. juil. 30 15:06:13 2018",
        "lun lug 30 15:06:13 2018",
        "seg jul 30 15:06:13 2018",
        "Mo 30. Juli 2018 15:06:13",
        "30 Jul 2018, 03:06:13 p.m.",
        "Mon 2018-07-30 15:06:13.000000",
        "Mo 30.07.2018 15:06:13 h",
        "Mon Jul 30 15:06:13 pm 2018",
    ] {
        let start = 1_532_963_173_500_000_000;
        assert_eq!(
            first(&format!("date {date}\nbase hex")),
            (start, 0),
            "{date}"
        );
    }
    for (month, seconds) in [
        ("f\u{e9}vr.", 1_517_443_200),
        ("ao\u{fb}t", 1_533_081_600),
        ("d\u{e9}c.", 1_543_622_400),
        ("J\u{e4}n", 1_514_764_800),
        ("avr.", 1_522_540_800),
        ("juin", 1_527_811_200),
        ("ott", 1_538_352_000),
        ("ene", 1_514_764_800),
    ] {
        let text = format!("date mar. {month} 1 00:00:00 2018\n 0.5 1 100 Rx d 0\n");
        let latin: Vec<u8> = text.chars().map(|c| u8::try_from(c).unwrap()).collect();
        for bytes in [text.as_bytes(), &latin] {
            assert_eq!(
                stamps(&read(bytes)),
                [seconds * 1_000_000_000 + 500_000_000],
                "{month}"
            );
        }
    }
    // A date that cannot be read is told, and the times count from the start.
    let found = read("date Mon 7/8 15:06:13 2017\n 0.5 1 100 Rx d 0\n".as_bytes());
    assert_eq!(found.report.first_bad.as_slice(), [(1, LineError::Date)]);
    assert_eq!(stamps(&found), [500_000_000]);
}

/// CANoe with symbolic names: the identifier is at the end of the line, in decimal.
#[test]
fn messages_of_vector_may_have_names() {
    let log = "date Sat Sep 30 03:06:13.191 pm 2017\n\
               base hex  timestamps absolute\n\
               0.037 1  BRAKE_01   Rx   d 4 34 00 00 08  Length = 160000 BitCount = 84 ID = 1638\n\
               0.038 1  EF         Rx   d 2 C0 C0  Length = 124000 BitCount = 66 ID = 1623\n\
               0.039 1  EEC1       Rx   d 1 11  Length = 124000 BitCount = 66 ID = 217056256x\n\
               0.040 1  ADD        Tx   r 8 Length = 124000 BitCount = 66 ID = 291\n\
               0.041 1  18EBFF00x  Rx   d 1 22  Length = 124000 BitCount = 66 ID = 418119424x\n\
               0.042 1  Unknown    Rx   d 1 33\n\
               0.043 1  ADD        Rx   d 1 44\n\
               0.044 1  Large      Rx   d 1 44 ID = 2048\n";
    let found = read(log.as_bytes());
    let expected = [
        classic(1638, &[0x34, 0, 0, 8]),
        classic(1623, &[0xC0, 0xC0]),
        Frame::new(Id::extended(0x0CF0_0400), &[0x11]),
        Frame::remote(Id::standard(291), 8),
        Frame::new(Id::extended(0x18EB_FF00), &[0x22]),
    ];
    assert_eq!(frames(&found), expected);
    // Without an identifier at the end of the line, what can be a number is one.
    let bad: Vec<_> = found
        .report
        .first_bad
        .iter()
        .map(|(line, _)| *line)
        .collect();
    assert_eq!(bad, [8, 9, 10]);
    assert_eq!(found.report.first_bad[0].1, LineError::Symbolic);
    // Cut off, it is none of these lines: an identifier may be half, or not there yet.
    let line = log.lines().nth(3).unwrap();
    for end in 0..line.len() {
        let cut = format!("base hex\n{}", &line[..end]);
        assert_eq!(read(cut.as_bytes()).entries.len(), 0, "{cut}");
    }
}

/// A stamp at an end of the range costs its own record, in every format.
#[test]
fn a_time_out_of_range_costs_one_record() {
    let message = |t: i64, flags: u32| {
        let mut body = vec![1, 0, 0, 1, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0];
        body.extend([0; 8]);
        padded(object(86, 1, flags, t, &body))
    };
    for (t, flags) in [
        (i64::MAX, 2),
        (i64::MIN, 2),
        (i64::MAX / 2 + 1, 2),
        (i64::MAX, 1),
        (i64::MAX / 10_000, 1),
        (i64::MIN, 1),
    ] {
        let objects = [numbered(1), message(t, flags), numbered(2)].concat();
        for container in [container(0, &objects), container(2, &objects)] {
            let found = read(&blf(&[&container]));
            assert_eq!(stamps(&found), [BLF_START + 1, BLF_START + 2], "{t}");
            assert_eq!(
                found.report.first_bad.as_slice(),
                [(2, LineError::Range)],
                "{t}"
            );
        }
    }
    let far = "9223372036.8";
    let asc = |base: &str| {
        let log = format!(
            "date Sat Sep 30 15:06:13 2017\nbase hex timestamps {base}\n\
             0.5 1 100 Rx d 0\n{far} 1 100 Rx d 0\n-{far} 1 100 Rx d 0\n0.6 1 100 Rx d 0\n"
        );
        read(log.as_bytes())
    };
    let start = 1_506_783_973_000_000_000;
    for (base, last) in [("absolute", 600_000_000), ("relative", 1_100_000_000)] {
        let found = asc(base);
        assert_eq!(
            stamps(&found),
            [start + 500_000_000, start + last],
            "{base}"
        );
        assert_eq!(found.report.bad, 2, "{base}");
    }
    let trc = "1) 1.0 Rx 0100 0\n2) 9223372036800 Rx 0100 0\n3) 2.0 Rx 0100 0\n";
    let found = read(format!(";$FILEVERSION=1.1\n{trc}").as_bytes());
    assert_eq!(stamps(&found), [1_000_000, 2_000_000]);
    let csv = "timestamp,arbitration_id,extended,remote,error,dlc,data\n\
               1.0,0x1,0,0,0,0,\n9.2e+09,0x1,0,0,0,0,\n-9223372036,0x1,0,0,0,0,\n\
               1.1,0x1,0,0,0,0,\n";
    let found = read(csv.as_bytes());
    assert_eq!((stamps(&found).len(), found.report.bad), (2, 2));
}

#[test]
fn faults_in_a_text_of_vector_are_named() {
    let missing = |declared, found| LineError::Missing { declared, found };
    let kind = LineError::Kind {
        format: LogFormat::Asc,
    };
    for (line, error) in [
        ("1.x 1 100 Rx d 0", LineError::Time),
        ("1.0", LineError::NoFrame),
        ("1.0 1", LineError::NoFrame),
        ("1.0 1 10G Rx d 0", LineError::Number),
        ("1.0 1 G10 Rx d 0", LineError::Symbolic),
        (
            "1.0 1 800 Rx d 0",
            LineError::IdentifierRange {
                id: 0x800,
                bits: 11,
            },
        ),
        (
            "1.0 1 20000000x Rx d 0",
            LineError::IdentifierRange {
                id: 0x2000_0000,
                bits: 29,
            },
        ),
        ("1.0 1 100 Ry d 0", LineError::Direction),
        ("1.0 1 100 Rx q 0", kind),
        ("1.0 1 100 Rx", kind),
        ("1.0 1 100 Rx d", LineError::Length),
        ("1.0 1 100 Rx d 10 00", LineError::Length),
        ("1.0 1 100 Rx d 3 00 11", missing(3, 2)),
        ("1.0 1 100 Rx d 1 100", LineError::Data),
        ("1.0 1 100 Rx d 1 GG", LineError::Data),
        ("1.0 CANXL 1 Rx XLFF 984438 4656 432", LineError::Xl),
        ("1.0 CANFD", LineError::Interface),
        ("1.0 CANFD 1 R 100 0 0 0 0", LineError::Direction),
        ("1.0 CANFD 1 Rx 100 0 2 0 0", kind),
        ("1.0 CANFD 1 Rx 100 0 0 10 0", LineError::Length),
        ("1.0 CANFD 1 Rx 100 0 0 f 65", LineError::Length),
        ("1.0 CANFD 1 Rx 100 0 0 2 2 00", missing(2, 1)),
        (
            "what",
            LineError::Foreign {
                format: LogFormat::Asc,
            },
        ),
    ] {
        let log = format!("base hex\n{line}\n1.1 1 100 Rx d 0\n");
        let found = read(log.as_bytes());
        assert_eq!(found.report.first_bad.as_slice(), [(2, error)], "{line}");
        assert_eq!(found.entries.len(), 1, "{line}");
        assert!(!error.to_string().is_empty());
    }
}

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
fn every_version_of_peak_is_read() {
    let twelve = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12];
    let all = [
        classic(0x300, &[0, 0, 0, 0, 4, 0, 10]),
        Frame::new(Id::extended(0x18EF_C034), &[1, 2]),
        Frame::remote(Id::standard(0x100), 3),
        bus_error(),
        fd(Id::standard(0x500), false, false, &twelve),
        fd(Id::standard(0x500), true, false, &[1]),
        fd(Id::standard(0x500), false, true, &[]),
        fd(Id::extended(0x500), true, true, &[1]),
    ];
    let us = [
        1_841_000, 1_850_000, 1_860_000, 1_870_000, 1_880_000, 1_880_250, 1_880_500, 1_880_750,
    ];
    for (version, text, count) in trcs() {
        for text in [text.clone(), text.replace('\n', "\r\n")] {
            let found = read(text.as_bytes());
            assert_eq!(found.report.bad, 0, "{version}: {:?}", found.report);
            assert_eq!(found.format, Some(LogFormat::Trc));
            assert_eq!(frames(&found), all[..count], "{version}");
            // 2021-12-18 14:28:07.062001, as its ten decimals of a day tell.
            let start = if version == "1.0" {
                0
            } else {
                1_639_837_687_062_001
            };
            let expected: Vec<i64> = us[..count].iter().map(|us| (start + us) * 1_000).collect();
            assert_eq!(stamps(&found), expected, "{version}");
            let many = matches!(version, "1.2" | "1.3" | "2.1");
            let second = if many { "can1" } else { "can0" };
            assert_eq!(found.entries[1].interface, second, "{version}");
            assert_eq!(found.entries[0].interface, "can0");
            let directions = [found.entries[0].direction, found.entries[1].direction];
            let expected = [Some(FrameDirection::Received), Some(FrameDirection::Sent)];
            let expected = if version == "1.0" {
                [None; 2]
            } else {
                expected
            };
            assert_eq!(directions, expected, "{version}");
        }
    }
    let comma = trcs()[1].1.replace("44548.6028595139", "44548,6028595139");
    assert_eq!(
        stamps(&read(comma.as_bytes()))[0],
        1_639_837_688_903_001_000
    );
}

#[test]
fn faults_in_a_log_of_peak_are_named() {
    let kind = LineError::Kind {
        format: LogFormat::Trc,
    };
    for (line, error) in [
        ("1", LineError::NoFrame),
        ("1 x DT 1 0300 Rx - 0", LineError::Time),
        ("1 1.0 XX 1 0300 Rx - 0", kind),
        ("1 1.0 DT x 0300 Rx - 0", LineError::Interface),
        ("1 1.0 DT 1 03G0 Rx - 0", LineError::Number),
        (
            "1 1.0 DT 1 0800 Rx - 0",
            LineError::IdentifierRange {
                id: 0x800,
                bits: 11,
            },
        ),
        ("1 1.0 DT 1 0300 RT - 0", LineError::Direction),
        ("1 1.0 DT 1 0300 Rx - x", LineError::Length),
        ("1 1.0 FD 1 0300 Rx - 16", LineError::Length),
        (
            "1 1.0 DT 1 0300 Rx - 2 00",
            LineError::Missing {
                declared: 2,
                found: 1,
            },
        ),
        ("1 1.0 DT 1 0300 Rx - 1 0", LineError::Data),
        ("1 1.0 DT 1 0300 Rx - 1 0G", LineError::Data),
    ] {
        let header = ";$FILEVERSION=2.1\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n";
        let log = format!("{header}{line}\n2 1.1 DT 1 0300 Rx - 0\n");
        let found = read(log.as_bytes());
        assert_eq!(found.report.first_bad.as_slice(), [(3, error)], "{line}");
        assert_eq!(found.entries.len(), 1, "{line}");
        assert!(!error.to_string().is_empty());
    }
    // Without knowing the columns nothing more is read.
    for header in [
        ";$FILEVERSION=3.0\n",
        ";$FILEVERSION=2.1\n",
        ";$FILEVERSION=2.0\n;$COLUMNS=N,O,,I\n",
        ";$FILEVERSION=2.0\n;$COLUMNS=N,T,I,d,l,D\n",
        ";$FILEVERSION=2.0\n;$COLUMNS=N,O,T,d,l,D\n",
    ] {
        let line = "1 1.0 DT 1 0300 Rx - 0\n";
        let found = read(format!("{header}{line}{line}").as_bytes());
        assert_eq!((found.entries.len(), found.report.bad), (0, 1), "{header}");
        assert_eq!(found.report.first_bad[0].1, LineError::Columns, "{header}");
    }
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

// ------------------------------------------------------------------------------------------ BLF

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

/// CAN_FD_MESSAGE_64 with `length` bytes stated and `data` present.
fn fd_64(flags: u32, code: u8, length: u8, more: u8, data: &[u8]) -> Vec<u8> {
    let mut body = vec![3, code, length, 0];
    body.extend((0x1234_5678_u32 | 0x8000_0000).to_le_bytes());
    body.extend([0; 4]);
    body.extend(flags.to_le_bytes());
    body.extend([0; 18]);
    body.extend([1, more, 0, 0, 0, 0]);
    assert_eq!(body.len(), 40);
    body.extend(data);
    padded(object(101, 1, 2, 7, &body))
}

#[test]
fn every_object_of_vector_with_a_frame_is_read() {
    let eight = [1, 2, 3, 4, 5, 6, 7, 8];
    let short = |id: u32, flags: u8, length: u8| {
        let mut body = vec![2, 0, flags, length];
        body.extend(id.to_le_bytes());
        body.extend(eight);
        body
    };
    let fd_100 = |flags: u8, code: u8, fd: u8, data: &[u8]| {
        let mut body = vec![2, 0, flags, code, 0x23, 1, 0, 0];
        body.extend([0, 0, 0, 0, 0, fd, data.len() as u8, 0, 0, 0, 0, 0]);
        body.extend(data);
        padded(object(100, 1, 2, 5, &body))
    };
    let id = Id::extended(0x1234_5678);
    let standard = Id::standard(0x123);
    let mut zeros = [0; 12];
    zeros[..8].copy_from_slice(&eight);
    let error = |kind: u32, channel: &[u8]| {
        let mut body = channel.to_vec();
        body.resize(60, 0xAA);
        padded(object(kind, 1, 2, 9, &body))
    };
    let cases = [
        // Time in units of 10 us; both versions of the header; a code above 8.
        (
            object(1, 1, 1, 150, &short(0x123, 1, 8)),
            classic(0x123, &eight),
            1_500_000,
        ),
        (
            object(86, 2, 2, 150, &short(0x123, 0, 15)),
            classic(0x123, &eight),
            150,
        ),
        (
            object(1, 2, 1, -3, &short(0x123, 0, 3)),
            classic(0x123, &eight[..3]),
            -30_000,
        ),
        (
            object(1, 1, 2, 1, &short(0x9234_5678, 0, 0)),
            Frame::new(id, &[]),
            1,
        ),
        (
            object(1, 1, 2, 1, &short(0x123, 0x80, 5)),
            Frame::remote(standard, 5),
            1,
        ),
        (
            fd_100(0, 9, 7, &[9; 12]),
            fd(standard, true, true, &[9; 12]),
            5,
        ),
        (fd_100(0, 1, 1, &[9]), fd(standard, false, false, &[9]), 5),
        (fd_100(0, 8, 0, &[9; 8]), classic(0x123, &[9; 8]), 5),
        (fd_100(0x80, 3, 0, &[]), Frame::remote(standard, 3), 5),
        (
            fd_64(0x3000, 9, 12, 0, &[9; 12]),
            fd(id, true, false, &[9; 12]),
            7,
        ),
        (fd_64(0x5000, 1, 1, 0, &[9]), fd(id, false, true, &[9]), 7),
        (fd_64(0, 2, 2, 0, &[9, 8]), Frame::new(id, &[9, 8]), 7),
        (fd_64(0x10, 2, 0, 0, &[]), Frame::remote(id, 2), 7),
        // Fewer bytes than stated, at the end of the object and before what follows the data.
        (
            fd_64(0x1000, 9, 12, 0, &eight),
            fd(id, false, false, &zeros),
            7,
        ),
        (
            fd_64(0x1000, 9, 12, 80, &[&eight[..], &[0xEE; 20]].concat()),
            fd(id, false, false, &zeros),
            7,
        ),
        (error(2, &[1, 0]), bus_error(), 9),
        (error(73, &[1, 0]), bus_error(), 9),
        (error(104, &[1]), bus_error(), 9),
    ];
    for (object, frame, t) in &cases {
        for file in [
            blf(&[&container(2, &padded(object.clone()))]),
            blf(&[&container(0, object)]),
            // Outside any container.
            blf(&[&padded(object.clone())]),
        ] {
            let found = read(&file);
            assert_eq!(found.report.bad, 0, "{frame:?}: {:?}", found.report);
            assert_eq!(frames(&found), [*frame]);
            assert_eq!(stamps(&found), [BLF_START + t], "{frame:?}");
        }
    }
    let objects: Vec<Vec<u8>> = cases
        .iter()
        .map(|(object, ..)| padded(object.clone()))
        .collect();
    let found = read(&blf(&[&container(2, &objects.concat())]));
    let expected: Vec<Frame> = cases.iter().map(|(_, frame, _)| *frame).collect();
    assert_eq!((frames(&found), found.report.bad), (expected, 0));
    let interfaces: Vec<&str> = found.entries.iter().map(|e| e.interface.as_str()).collect();
    assert_eq!(
        (interfaces[0], interfaces[10], interfaces[17]),
        ("can1", "can2", "can0")
    );
    let (r, t) = (Some(FrameDirection::Received), Some(FrameDirection::Sent));
    let directions: Vec<_> = found.entries.iter().map(|e| e.direction).collect();
    assert_eq!((directions[0], directions[1], directions[9]), (t, r, t));
    // Without a start.
    let mut file = blf(&[&container(2, &numbered(3))]);
    file[40..56].fill(0);
    assert_eq!(stamps(&read(&file)), [3]);
}

#[test]
fn objects_lie_over_containers_as_they_like() {
    // Frames between objects of other types, one of which is long; whatever the sizes of the
    // containers, down to one byte.
    let other = |size: usize| padded(object(65, 1, 2, 0, &vec![b'L'; size]));
    for (size, count) in [
        (1, 4),
        (7, 15),
        (100, 60),
        (4_096, 60),
        (65_536, 60),
        (1 << 20, 60),
    ] {
        let mut contents = Vec::new();
        for number in 0..count {
            contents.extend(numbered(number));
            contents.extend(other(usize::from(number) * 11));
        }
        contents.extend(other(usize::from(count) * 1_500));
        contents.extend(numbered(count));
        let pieces = contents.chunks(size).zip([0, 2].into_iter().cycle());
        let pieces: Vec<Vec<u8>> = pieces
            .map(|(piece, packing)| container(packing, piece))
            .collect();
        let found = read(&blf(&[&pieces.concat()]));
        assert_eq!(found.report.bad, 0, "{size}: {:?}", found.report);
        let numbers: Vec<u8> = found.entries.iter().map(|e| e.frame.data()[0]).collect();
        assert_eq!(numbers, (0..=count).collect::<Vec<u8>>(), "{size}");
    }
}

#[test]
fn damage_to_a_binary_log_costs_what_it_hits() {
    let many = |numbers: std::ops::Range<u8>| numbers.flat_map(numbered).collect::<Vec<u8>>();
    let [first, second, third] = [many(0..40), many(40..80), many(80..120)];
    let numbers = |found: &Read| {
        found
            .entries
            .iter()
            .map(|e| e.frame.data()[0])
            .collect::<Vec<u8>>()
    };
    let [before, after] = [(0..40).collect::<Vec<u8>>(), (80..120).collect()];
    let packed = [&first, &second, &third].map(|part| container(2, part));
    let error = |found: &Read| {
        found
            .report
            .first_bad
            .iter()
            .map(|b| b.1)
            .collect::<Vec<_>>()
    };

    // The packed bytes, of which the beginning may still be good.
    let mut damaged = packed[1].clone();
    let middle = damaged.len() / 2;
    damaged[middle..middle + 8].fill(0xFF);
    let found = read(&blf(&[&packed[0], &damaged, &packed[2]]));
    assert_eq!(error(&found), [LineError::Container]);
    assert!(numbers(&found).starts_with(&before) && numbers(&found).ends_with(&after));
    assert!(found.entries.len() < 120);

    // A container that is not what it says.
    let mut unknown = packed[1].clone();
    unknown[16] = 7;
    let found = read(&blf(&[&packed[0], &unknown, &packed[2]]));
    assert_eq!(error(&found), [LineError::Packing(7)]);
    assert_eq!(numbers(&found), [before.clone(), after.clone()].concat());
    let mut tiny = packed[1].clone();
    tiny[8..12].copy_from_slice(&5_u32.to_le_bytes());
    let found = read(&blf(&[&packed[0], &tiny, &packed[2]]));
    assert_eq!(error(&found), [LineError::Object]);
    assert_eq!(numbers(&found), [before.clone(), after.clone()].concat());

    // Noise between containers and between objects.
    let noise = [0xAA; 100];
    let found = read(&blf(&[&packed[0], &noise, &packed[1], &packed[2]]));
    // Padding may count.
    assert!(
        matches!(error(&found)[..], [LineError::Gap(100..=103)]),
        "{:?}",
        error(&found)
    );
    assert_eq!(numbers(&found), (0..120).collect::<Vec<u8>>());
    let found = read(&blf(&[&container(
        2,
        &[&first[..], &noise, &third].concat(),
    )]));
    // Padding may count.
    assert!(
        matches!(error(&found)[..], [LineError::Gap(100..=103)]),
        "{:?}",
        error(&found)
    );
    assert_eq!(numbers(&found), [before.clone(), after.clone()].concat());

    // An object whose size is wrong, or which is too short for a frame.
    let mut wrong = second.clone();
    wrong[8..12].copy_from_slice(&5_u32.to_le_bytes());
    let found = read(&blf(&[&container(
        0,
        &[&first[..], &wrong, &third].concat(),
    )]));
    assert_eq!(error(&found), [LineError::Object]);
    assert_eq!(found.entries.len(), 119);
    let short = object(86, 1, 2, 0, &[1, 0, 0, 8, 1, 0, 0, 0, 1, 2, 3, 4]);
    let found = read(&blf(&[&container(
        0,
        &[&first[..], &short, &third].concat(),
    )]));
    assert_eq!(error(&found), [LineError::Object]);
    assert_eq!(numbers(&found), [before.clone(), after.clone()].concat());
    let mut range = numbered(1);
    range[32 + 6] = 1;
    let found = read(&blf(&[&container(0, &range)]));
    let out = LineError::IdentifierRange {
        id: 0x1_0001,
        bits: 11,
    };
    assert_eq!(error(&found), [out]);
    assert!(
        found.why_empty.contains("object 1: the identifier"),
        "{}",
        found.why_empty
    );

    // A container that ends in the middle of its last object, at the end of the file.
    let begun = &first[..first.len() - 20];
    let found = read(&blf(&[&container(2, begun)]));
    let expected = (vec![LineError::CutOff], 39);
    assert_eq!((error(&found), found.entries.len()), expected);

    // A container that cannot be unpacked at all: a block of a kind that zlib does not have.
    let mut broken = packed[1].clone();
    broken[34] = 0xFF;
    let found = read(&blf(&[&packed[0], &broken, &packed[2]]));
    assert_eq!(error(&found), [LineError::Container]);
    assert_eq!(numbers(&found), [before, after].concat());

    // The file's header states more than there is.
    let mut file = blf(&[&packed[0]]);
    file[16] += 1;
    let found = read(&file);
    assert_eq!(
        (error(&found), found.entries.len()),
        (vec![LineError::CutOff], 40)
    );
}

// --------------------------------------------------------------------------------------- damage

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
            let told = found.report.bad > 0;
            if binary {
                assert!(told || end == 0 || count == whole.len(), "{name}: {end}");
            } else if !told {
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

// --------------------------------------------------------------------------------------- replay

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
    let told = error.to_string();
    assert!(
        told.contains("it holds no frame: it is a PDF document"),
        "{told}"
    );
}
