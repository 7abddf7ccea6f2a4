//! Logs of Vector as text (.asc).

use super::{
    ASC, BLF_START, blf, bus_error, classic, container, fd, frames, numbered, object, padded, read,
    stamps,
};
use proprio_drivers::{Frame, Id};
use proprio_gateway::log::{FrameDirection, LineError, LogFormat};

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
