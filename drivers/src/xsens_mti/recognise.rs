//! Recognising a sensor with the identifiers that it is delivered with.

use super::frames::{HighRate, MtiMessage};
use super::options::XsensMtiOptions;
use crate::recognise::{Evidence, Finding, Key, Traffic};
use crate::{Driver, Id, Recognise};
use alloc::format;
use alloc::string::String;
use alloc::vec::Vec;

/// The messages and their names in the key `quantities`.
const QUANTITIES: [(MtiMessage, &str); 7] = [
    (MtiMessage::SampleTime, "sample_time"),
    (MtiMessage::GroupCounter, "group_counter"),
    (MtiMessage::Status, "status"),
    (MtiMessage::Orientation, "orientation"),
    (MtiMessage::AngularVelocity, "angular_velocity"),
    (MtiMessage::Acceleration, "acceleration"),
    (MtiMessage::MagneticField, "magnetic_field"),
];

impl Recognise for XsensMtiOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let found = [false, true].map(|extended| sensor(seen, extended));
        found.into_iter().flatten().collect()
    }
}

/// The sensor, if `seen` shows it with identifiers of 29 bits (`extended`) or 11. Two quantities
/// that it measures must be there.
fn sensor(seen: &Traffic, extended: bool) -> Option<Finding> {
    let mut evidence = Evidence::new(seen, 1);
    let id = |message: MtiMessage, high_rate| match extended {
        true => Id::extended(message.identifier(high_rate)),
        #[allow(clippy::cast_possible_truncation)] // below 0x100
        false => Id::standard(message.identifier(high_rate) as u16),
    };
    evidence.sends_length(
        id(MtiMessage::Error, HighRate::None),
        MtiMessage::Error.length(),
    );
    let mut quantities: Vec<&str> = Vec::new();
    let mut measured = 0;
    let mut is_fast = false;
    let mut period = None;
    for (message, name) in QUANTITIES {
        let mut heard = evidence.sends_length(id(message, HighRate::None), message.length());
        if heard.is_none()
            && matches!(
                message,
                MtiMessage::AngularVelocity | MtiMessage::Acceleration
            )
        {
            heard = evidence.sends_length(id(message, HighRate::RateFirst), message.length());
            is_fast |= heard.is_some();
        }
        if let Some(stream) = heard {
            quantities.push(name);
            if MtiMessage::MEASURED.contains(&message) {
                measured += 1;
                period = period.or(stream.period());
            }
        }
    }
    if measured < 2 {
        return None;
    }
    let finding = evidence.finding(XsensMtiOptions::NAME, 0, "Xsens MTi")?;
    let words: String = format!("{quantities:?}");
    let mut keys = Vec::from([Key::new("quantities", words)]);
    keys.extend(Key::period_ms(period, 1, 1000));
    if extended {
        keys.push(Key::new("extended", true));
    }
    if is_fast {
        let note = "or \"acceleration_first\": compare one known motion";
        keys.push(Key::fill_in("high_rate", "\"rate_first\"", note));
    }
    if quantities.contains(&"magnetic_field") {
        let note = "the field at the calibration [T]";
        keys.push(Key::fill_in("magnetic_unit", "50e-6", note));
    }
    Some(finding.with_keys(keys))
}
