//! Logs of PEAK (.trc), in each of their versions.

use super::{bus_error, classic, fd, frames, read, stamps, trcs};
use proprio_drivers::{Frame, Id};
use proprio_gateway::log::{FrameDirection, LineError, LogFormat};

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
