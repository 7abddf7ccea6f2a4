//! A recording becomes the table that would have been recorded in its place, to the last bit; also
//! what is left of one that was cut.
#![allow(missing_docs, clippy::unwrap_used)]

use proprio_recording::{ReadError, Recorder, is_mcap, to_table};
use proprio_topics::csv::{Columns, Series, Value, What, Writer};
use proprio_topics::{
    ContactEstimate, ContactState, ContactWrench, Description, Entry, Header, JointTorque, Kind,
    MAX_CONTACTS, MAX_JOINTS, MAX_SUBTREES, Name, Nanos, Publisher, Quality, Reading, Reason,
    Residual, Role, TorqueEstimate, VALUES,
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
            what: What::Channel(kind),
            name: name.to_owned(),
        })
        .collect();
    series.push(Series {
        what: What::Contact,
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
    let mut writer = Writer::new(Vec::new(), &series(), Columns::All).unwrap();
    for (t, series, value) in values {
        writer.push(Some(*t), *series, value).unwrap();
    }
    writer.finish().unwrap()
}

/// A recording of these values; each `flush` of them ends a chunk.
fn recording(values: &[(Nanos, usize, Value)], flush: usize) -> Vec<u8> {
    let output = Cursor::new(Vec::new());
    let mut recorder = Recorder::new(output, "arm", "test 1", &series(), OFFSET).unwrap();
    for (number, (t, series, value)) in values.iter().enumerate() {
        recorder.push(*t, *series, value).unwrap();
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
