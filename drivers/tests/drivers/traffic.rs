//! What is heard on a bus, identifier by identifier, and what a file says of a device: both are
//! read by other parts of Proprio, too.

use crate::rig::{FD, frame};
use proprio_drivers::objects::{ObjectEntry, Objects};
use proprio_drivers::recognise::Stream;
use proprio_drivers::{Format, Frame, Id, Traffic};
use proprio_topics::{Nanos, StampKind};

const ID: Id = Id::standard(0x123);

/// What is heard on [`ID`].
fn heard(frames: impl IntoIterator<Item = Frame>) -> Stream {
    let mut traffic = Traffic::new();
    frames
        .into_iter()
        .for_each(|frame| traffic.on_frame(&frame));
    traffic.stream(ID).expect("frames with this ID").clone()
}

#[test]
fn a_stream_has_the_numbers_of_its_frames() {
    let fd = |data: &[u8], ms| {
        let frame = Frame::with_format(ID, FD, data).unwrap();
        frame.at(Nanos::from_millis(ms), StampKind::Software)
    };
    let error = Frame::with_format(ID, Format::Error, &[0xFF; 8]).unwrap();
    let stream = heard([
        Frame::remote(ID, 8),
        frame("123#010203", 5000.0),
        frame("123#010207", 5010.0),
        Frame::remote(ID, 8),
        fd(&[0x01, 0x82, 0x03, 0xFF, 0xFF], 5020),
        error,
        fd(&[0x01, 0x02], 5040),
        Frame::remote(ID, 1),
        frame("123#010203", 5050.0),
    ]);
    assert_eq!((stream.frames, stream.fd, stream.remote), (5, 2, 3));
    assert_eq!(stream.lengths, (2, 5));
    let stamps = [5000, 5050].map(Nanos::from_millis);
    assert_eq!(stream.stamps, (stamps[0], stamps[1]));
    // Bit 7 of the second byte, bit 2 of the third; the fourth and the fifth came once.
    assert_eq!(stream.changing(), [0, 0x80, 0x04, 0, 0]);
    assert_eq!(stream.period(), Some(Nanos::from_millis(10)));
    // Four gaps in 50 ms.
    assert!((stream.rate() - 80.0).abs() < 1e-9, "{}", stream.rate());
}

/// A byte is compared with the first that came in its place, also if the first frame was shorter.
#[test]
fn bytes_beyond_a_short_first_frame_change_too() {
    let texts = ["123#01", "123#0102", "123#010A03", "123#01"];
    let stream = heard(texts.map(|text| frame(text, 0.0)));
    assert_eq!(stream.changing(), [0, 0x08, 0]);
}

#[test]
fn a_rate_needs_two_instants() {
    for (stamps, hz) in [
        (&[][..], 0.0),
        (&[7.0], 0.0),
        (&[7.0, 7.0], 0.0),
        (&[7.0, 9.0], 500.0),
        (&[7.0, 8.0, 9.0], 1000.0),
        (&[9.0, 7.0], 0.0),
    ] {
        let frames = stamps.iter().map(|ms| frame("123#00", *ms));
        let rate = heard(frames.chain([Frame::remote(ID, 1)])).rate();
        assert!((rate - hz).abs() < 1e-6, "{stamps:?}: {rate}");
    }
}

/// Frames that begin alike, in four bytes and in length, are kept once and among the newest.
#[test]
fn one_frame_of_each_beginning_is_kept() {
    let begun = [
        "123#",
        "123#01",
        "123#0100",
        "123#01020304",
        "123#01020305",
        "123#0102030400",
    ];
    let again = ["123#", "123#01", "123#0102030401", "123#0102030402"];
    let names = |frames: &[&str]| -> Vec<String> {
        frames
            .iter()
            .map(|text| frame(text, 0.0).to_string())
            .collect()
    };
    let all = [&begun[..], &again[..]].concat();
    let kept = |stream: &Stream| stream.kept().map(Frame::to_string).collect::<Vec<_>>();
    let stream = heard(all.iter().map(|text| frame(text, 0.0)));
    assert_eq!(kept(&stream), [names(&begun), names(&all)].concat());
    // However many there are, 128 beginnings and the 48 newest frames are kept.
    let many = |count: u16| heard((0..count).map(|n| Frame::new(ID, &n.to_be_bytes())));
    for (count, kept) in [(40, 80), (127, 127 + 48), (128, 128 + 48), (300, 128 + 48)] {
        assert_eq!(many(count).kept().count(), kept, "{count}");
    }
    let newest = many(300).recent().map(|f| f.data()[1]).collect::<Vec<_>>();
    assert_eq!(
        newest,
        (252..300_u16)
            .map(|n| n.to_be_bytes()[1])
            .collect::<Vec<_>>()
    );
}

/// An object may be stated for each node, or relative to the node's number.
#[test]
fn an_object_has_the_value_that_its_file_states() {
    let entry = |number, plus_node, own| ObjectEntry {
        number,
        plus_node,
        own,
    };
    let mut objects = Objects::default();
    objects.entries.extend([
        ((0x1000, 0), entry(0x0002_0192, false, true)),
        ((0x1200, 1), entry(0x600, true, false)),
        ((0x1018, 4), entry(0, false, true)),
    ]);
    for (index, sub, node, value, own) in [
        (0x1000, 0, 5, Some(0x0002_0192), Some(0x0002_0192)),
        (0x1200, 1, 5, Some(0x605), None),
        (0x1200, 1, 127, Some(0x67F), None),
        (0x1018, 4, 5, Some(0), None),
        (0x1200, 2, 5, None, None),
        (0x1201, 1, 5, None, None),
    ] {
        assert_eq!(objects.value(index, sub, node), value, "{index:X} {sub}");
        assert_eq!(objects.own(index, sub), own, "{index:X} {sub}");
    }
}
