//! A recording becomes the table that would have been recorded in its place, to the last bit; also
//! what is left of one that was cut.
#![allow(missing_docs, clippy::unwrap_used)]

use proprio_drivers::{Format, Frame, Id};
use proprio_recording::{
    About, ReadError, Recorder, Ring, about, frames, is_mcap, to_estimates, to_table,
};
use proprio_topics::csv::{Columns, Series, SeriesKind, TableWriter, Value};
use proprio_topics::{
    ContactEstimate, ContactState, ContactWrench, Description, Entry, Header, JointTorque, Kind,
    MAX_CONTACTS, MAX_JOINTS, MAX_SUBTREES, Name, Nanos, Publisher, Quality, Reading, Reason,
    Residual, Role, StampKind, TorqueEstimate, VALUES,
};
use proptest::prelude::*;
use std::io::Cursor;

/// The first instant, and the wall clock minus it.
const BEGIN: Nanos = Nanos(1_000_000_000);
const OFFSET: Nanos = Nanos(1_780_000_000_000_000_000);

fn series() -> Vec<Series> {
    let channels = [
        (Kind::Joint, "elbow"),
        (Kind::Wrench, "ft"),
        (Kind::Imu, "chest"),
        (Kind::Skin, "palm"),
    ];
    let mut series: Vec<Series> = (channels.into_iter())
        .map(|(kind, name)| Series {
            kind: SeriesKind::Channel(kind),
            name: name.to_owned(),
        })
        .collect();
    series.push(Series {
        kind: SeriesKind::Contact,
        name: "hand".to_owned(),
    });
    series
}

/// Values of all series, also readings that are not the main one of their channel.
fn values(numbers: &[f64], count: usize) -> Vec<(Nanos, usize, Value)> {
    let mut at = (0..).map(|place: usize| numbers[place % numbers.len()]);
    let mut all = Vec::new();
    for step in 0..count {
        let t = BEGIN + Nanos(1_000_003 * step as i64);
        let mut reading = |kind: Kind| {
            let mut values = [0.0; VALUES];
            for value in values.iter_mut().take(kind.fields().len()) {
                *value = at.next().unwrap();
            }
            if kind == Kind::Skin {
                values[0] = (step % 5) as f64;
            }
            Reading::from_values(kind, &values).unwrap()
        };
        let quality = Quality(1 << (step % 9));
        let kinds = [Kind::Joint, Kind::Wrench, Kind::Imu, Kind::Skin];
        let number = step % 4;
        all.push((t, number, Value::Reading(reading(kinds[number]), quality)));
        if number == 1 {
            let temperature = reading(Kind::Temperature);
            all.push((t, number, Value::Reading(temperature, Quality::GOOD)));
        }
        if step % 7 == 3 {
            let state = ContactState {
                active: step % 2 == 0,
                position: [0.125, 0.25, f64::from(step as u32)],
                ..ContactState::configured(true)
            };
            all.push((t + Nanos(1), 4, Value::Contact(state)));
        }
    }
    all
}

fn table(values: &[(Nanos, usize, Value)]) -> Vec<u8> {
    let mut writer = TableWriter::new(Vec::new(), &series(), Columns::All).unwrap();
    for (t, series, value) in values {
        writer.push(Some(*t), *series, value).unwrap();
    }
    writer.finish().unwrap()
}

fn about_it() -> About {
    About {
        robot: "arm".into(),
        program: "test 1".into(),
        offset: OFFSET,
        files: vec![("estimator.toml".into(), b"[robot]".to_vec())],
    }
}

/// A recording of these values; each `flush` of them ends a chunk.
fn recording(values: &[(Nanos, usize, Value)], flush: usize) -> Vec<u8> {
    let output = Cursor::new(Vec::new());
    let mut recorder = Recorder::new(output, &about_it(), &series()).unwrap();
    for (number, (t, series, value)) in values.iter().enumerate() {
        recorder.value(*t, *series, value).unwrap();
        if number % flush == flush - 1 {
            recorder.flush().unwrap();
        }
    }
    recorder.torques(&names(), &torques()).unwrap();
    recorder.contacts(&names(), &contacts()).unwrap();
    recorder.finish().unwrap().into_inner()
}

fn names() -> Description {
    let entry = |name: &str, role: Role, index| Entry {
        name: Name::new(name).unwrap(),
        role: role.in_memory(),
        index,
        ..Entry::NONE
    };
    let entries = [
        entry("elbow", Role::Joint, 0),
        entry("wrist", Role::Joint, 1),
        entry("hand", Role::Contact, 0),
        entry("ft", Role::Channel, 3),
    ];
    Description::new(Publisher::Estimator, entries)
}

fn torques() -> TorqueEstimate {
    let mut joints = [JointTorque::ABSENT; MAX_JOINTS];
    joints[0] = JointTorque {
        torque: 1.5,
        standard_deviation: 0.25,
        valid: 1,
        reason: Reason::None.in_memory(),
        ..JointTorque::ABSENT
    };
    joints[1] = JointTorque {
        reason: Reason::Saturated.in_memory(),
        cause: 3,
        ..JointTorque::ABSENT
    };
    let header = Header {
        acquired: BEGIN,
        ..Header::default()
    };
    TorqueEstimate {
        header,
        count: 2,
        reserved: 0,
        joints,
    }
}

fn contacts() -> ContactEstimate {
    let mut contacts = [ContactWrench::ABSENT; MAX_CONTACTS];
    contacts[0] = ContactWrench {
        force: [1.0, 2.0, 3.0],
        torque: [4.0, 5.0, 6.0],
        valid: 1,
        ..ContactWrench::ABSENT
    };
    ContactEstimate {
        header: torques().header,
        count: 1,
        residual_count: 0,
        contacts,
        residuals: [Residual::ABSENT; MAX_SUBTREES],
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(30))]
    #[test]
    fn a_recording_is_its_table(
        numbers in prop::collection::vec(-1e12..1e12_f64, 1..50), flush in 1..40_usize,
    ) {
        let values = values(&numbers, 60);
        let recording = recording(&values, flush);
        prop_assert!(is_mcap(&recording));
        let mut found = Vec::new();
        let summary = to_table(recording.as_slice(), &mut found).unwrap();
        let expected = String::from_utf8(table(&values)).unwrap();
        prop_assert_eq!(String::from_utf8(found).unwrap(), expected);
        prop_assert_eq!((summary.values as usize, summary.damaged), (values.len(), 0));
        prop_assert!(!summary.is_cut);
    }
}

/// A recorder that is killed leaves the chunks that it had flushed.
#[test]
fn what_is_left_of_a_recording_is_the_beginning_of_its_table() {
    let values = values(&[0.5, -1.25, 3e-7], 400);
    let (whole, expected) = (recording(&values, 50), table(&values));
    let mut most = 0;
    for part in 1..20 {
        let cut = &whole[..whole.len() * part / 20];
        let mut found = Vec::new();
        match to_table(cut, &mut found) {
            Ok(summary) => assert!(summary.is_cut, "{part}"),
            // Not even the first chunk.
            Err(ReadError::Foreign) => continue,
            Err(error) => panic!("{part}: {error}"),
        }
        // The last row may lack values that came later.
        let rows = found.len()
            - found[..found.len() - 1]
                .iter()
                .rev()
                .take_while(|b| **b != b'\n')
                .count();
        assert!(expected.starts_with(&found[..rows - 1]), "{part}");
        assert!(found.len() >= most, "{part}");
        most = found.len();
    }
    assert!(most > expected.len() / 2, "{most} of {}", expected.len());
}

#[test]
fn other_files_are_refused_and_damage_is_counted() {
    assert!(matches!(
        to_table(&b"t,a\n1,2\n"[..], Vec::new()),
        Err(ReadError::Mcap(_))
    ));
    let empty = mcap::Writer::new(Cursor::new(Vec::new())).unwrap();
    let mut empty = empty;
    empty.finish().unwrap();
    let foreign = empty.into_inner().into_inner();
    let refused = to_table(foreign.as_slice(), Vec::new()).unwrap_err();
    assert!(
        refused.to_string().contains("without samples of Proprio"),
        "{refused}"
    );
}

proptest! {
    #[test]
    fn any_bytes_are_legal_input(bytes: Vec<u8>, place in 0..4000_usize, with: u8) {
        let _ = to_table(bytes.as_slice(), Vec::new());
        let mut damaged = recording(&values(&[0.5], 40), 10);
        let place = place % damaged.len();
        damaged[place] = with;
        let _ = to_table(damaged.as_slice(), Vec::new());
    }
}

/// Lengths above all: of records, names and attachments.
#[test]
fn each_byte_may_be_damaged() {
    let whole = recording(&values(&[0.5], 40), 10);
    for place in 0..whole.len() {
        for with in [0, 32, 255] {
            let mut damaged = whole.clone();
            damaged[place] = with;
            let _ = (
                to_table(damaged.as_slice(), Vec::new()),
                about(damaged.as_slice()),
            );
        }
    }
}

#[test]
fn a_recording_says_what_it_is_and_has_its_files() {
    let recording = recording(&values(&[1.0], 10), 4);
    let found = about(recording.as_slice()).unwrap();
    assert_eq!(
        (found.robot, found.program, found.offset, found.files),
        ("arm".into(), "test 1".into(), OFFSET, about_it().files)
    );
}

/// Frames of every form, with their bus and the wall clock's time to the nanosecond.
#[test]
fn frames_come_back() {
    let fd = Format::Fd {
        bit_rate_switch: false,
        error_state: false,
    };
    let at = |frame: Frame, n| frame.at(BEGIN + Nanos(n), StampKind::Software);
    let sent = [
        ("can0", at(Frame::new(Id::standard(0x123), &[1, 2, 3]), 0)),
        (
            "can1",
            at(Frame::new(Id::extended(0x1ABC_DEF0), &[9; 8]), 1),
        ),
        ("can0", at(Frame::remote(Id::standard(0x7FF), 5), 2)),
        (
            "can0",
            at(
                Frame::with_format(Id::standard(1), fd, &[7; 64]).unwrap(),
                3,
            ),
        ),
        (
            "can1",
            at(
                Frame::with_format(Id::extended(4), Format::Error, &[1; 8]).unwrap(),
                4,
            ),
        ),
        ("can0", at(Frame::new(Id::standard(0), &[]), 1_234_567_891)),
    ];
    let output = Cursor::new(Vec::new());
    let mut recorder = Recorder::new(output, &about_it(), &series()).unwrap();
    assert!(matches!(
        frames(recording(&[], 1).as_slice(), |_, _| Ok(())),
        Err(ReadError::NoFrames)
    ));
    for (bus, frame) in &sent {
        recorder.frame(bus, frame).unwrap();
    }
    let recorded = recorder.finish().unwrap().into_inner();
    let mut found = Vec::new();
    let summary = frames(recorded.as_slice(), |bus, frame| {
        found.push((bus.to_owned(), *frame));
        Ok(())
    })
    .unwrap();
    assert_eq!((summary.values, summary.damaged), (6, 0));
    for ((bus, frame), (sent_on, sent)) in found.iter().zip(&sent) {
        let expected = sent.at(sent.t + OFFSET, StampKind::Log);
        assert_eq!((bus.as_str(), frame), (*sent_on, &expected));
    }
    assert_eq!(found.len(), sent.len());
}

/// A ring has at least the time that is asked for, and not much more; it goes on after a snapshot.
#[test]
fn a_ring_has_the_last_seconds() {
    let values = values(&[0.5, -3.25, 1e-3], 4000);
    let newest = values.last().unwrap().0;
    let duration = Nanos::from_millis(400);
    let mut ring = Ring::new(about_it(), &series(), duration).unwrap();
    let mut snapshots = Vec::new();
    for (number, (t, series_number, value)) in values.iter().enumerate() {
        let recorder = ring.at(*t).unwrap();
        recorder.value(*t, *series_number, value).unwrap();
        if number == 20 || number == values.len() - 1 {
            recorder.torques(&names(), &torques()).unwrap();
            let output = Cursor::new(Vec::new());
            let snapshot = ring.snapshot(&series()).unwrap();
            snapshots.push(snapshot.write(output).unwrap().into_inner());
        }
    }
    let rows = |snapshot: &[u8]| {
        let mut found = Vec::new();
        let summary = to_table(snapshot, &mut found).unwrap();
        assert!(!summary.is_cut && summary.damaged == 0, "{summary:?}");
        String::from_utf8(found).unwrap()
    };
    let whole = String::from_utf8(table(&values)).unwrap();
    let [first, last] = [rows(&snapshots[0]), rows(&snapshots[1])];
    assert!(whole.starts_with(first.trim_end().rsplit_once('\n').unwrap().0));
    let (head, body) = last.split_once('\n').unwrap();
    assert!(whole.starts_with(head) && whole.ends_with(body));
    let t = |row: &str| row.split(',').next().unwrap().parse::<f64>().unwrap();
    let held = newest.seconds() - t(body.lines().next().unwrap());
    assert!(
        held >= duration.seconds() && held < duration.seconds() * 1.3,
        "{held}"
    );
    assert_eq!(
        about(snapshots[1].as_slice()).unwrap().files,
        about_it().files
    );
    assert!(ring.memory() > 0);
}

/// A channel that comes to be known late is in the recording, but has no column.
#[test]
fn late_channels_have_no_column() {
    let values = values(&[2.0], 40);
    let early = &series()[..2];
    let mut recorder = Recorder::new(Cursor::new(Vec::new()), &about_it(), early).unwrap();
    let (mut with, mut without) = (0, 0);
    for (number, (t, series_number, value)) in values.iter().enumerate() {
        if number == 5 {
            recorder.know(&series()).unwrap();
        }
        recorder.value(*t, *series_number, value).unwrap();
        let is_early = *series_number < 2;
        with += u64::from(is_early);
        without += u64::from(!is_early && number >= 5);
    }
    let recorded = recorder.finish().unwrap().into_inner();
    let summary = to_table(recorded.as_slice(), Vec::new()).unwrap();
    assert_eq!((summary.values, summary.without_column), (with, without));
    let topics: Vec<String> = mcap::MessageStream::new(&recorded)
        .unwrap()
        .map(|message| message.unwrap().channel.topic.clone())
        .collect();
    assert!(topics.iter().any(|topic| topic == "/samples/imu/chest"));
}

/// The table of estimates has the columns of torques and contacts, whichever comes first, and what
/// has no value is an empty cell.
#[test]
fn estimates_become_a_table() {
    let mut recorder = Recorder::new(Cursor::new(Vec::new()), &about_it(), &series()).unwrap();
    let later = |step: i64| {
        let (mut torques, mut contacts) = (torques(), contacts());
        torques.header.acquired += Nanos(step);
        contacts.header.acquired += Nanos(step);
        (torques, contacts)
    };
    recorder.contacts(&names(), &contacts()).unwrap();
    for step in [1, 2] {
        let (torques, contacts) = later(step);
        recorder.torques(&names(), &torques).unwrap();
        recorder.contacts(&names(), &contacts).unwrap();
    }
    let recorded = recorder.finish().unwrap().into_inner();
    let mut found = Vec::new();
    let summary = to_estimates(recorded.as_slice(), &mut found).unwrap();
    assert_eq!((summary.values, summary.without_column), (3, 0));
    let found = String::from_utf8(found).unwrap();
    let rows: Vec<Vec<&str>> = found.lines().map(|row| row.split(',').collect()).collect();
    let cell = |row: usize, column: &str| {
        let place = rows[0].iter().position(|name| *name == column);
        rows[row][place.unwrap_or_else(|| panic!("no {column}: {found}"))]
    };
    assert_eq!(cell(1, "torque/elbow"), "");
    assert_eq!(cell(1, "contact/hand/fx"), "1.0");
    assert_eq!(cell(2, "torque/elbow"), "1.5");
    assert_eq!(cell(3, "torque_std/elbow"), "0.25");
    assert_eq!(cell(3, "valid/elbow"), "1");
    assert_eq!(cell(3, "valid/wrist"), "0");
    assert_eq!(cell(3, "contact/hand/tz"), "6.0");
    let none = recording(&values(&[1.0], 3), 1);
    assert!(to_estimates(none.as_slice(), Vec::new()).is_ok());
    let empty = Recorder::new(Cursor::new(Vec::new()), &about_it(), &series()).unwrap();
    let empty = empty.finish().unwrap().into_inner();
    assert!(matches!(
        to_estimates(empty.as_slice(), Vec::new()),
        Err(ReadError::NoEstimates)
    ));
}

/// What is known of joints and daemons goes on in the next part of a ring.
#[test]
fn a_part_goes_on_with_what_is_known() {
    let mut recorder = Recorder::new(Cursor::new(Vec::new()), &about_it(), &series()).unwrap();
    let mut state = [0.0; VALUES];
    state[0] = 0.75;
    let reading = Reading::from_values(Kind::Joint, &state).unwrap();
    let t = torques().header.acquired;
    let value = Value::Reading(reading, Quality::GOOD);
    recorder.value(t - Nanos(1), 0, &value).unwrap();
    let first = recorder
        .turn_to(Cursor::new(Vec::new()), &about_it())
        .unwrap();
    recorder.torques(&names(), &torques()).unwrap();
    assert_eq!(recorder.state("elbow", t).position, 0.75);
    // Its board has fallen silent.
    assert!(
        recorder
            .state("elbow", t + Nanos::from_millis(1001))
            .position
            .is_nan()
    );
    let second = recorder.finish().unwrap().into_inner();
    for (part, values) in [(first.into_inner(), 1), (second, 0)] {
        let summary = to_table(part.as_slice(), Vec::new()).unwrap();
        assert_eq!((summary.values, summary.is_cut), (values, false));
    }
}
