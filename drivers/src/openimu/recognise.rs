//! Recognising sensors: by the groups that they send.

use super::frames::{ADDRESSES, DIVIDERS, OpenImuQuantity, identifier, period};
use super::options::OpenImuOptions;
use crate::recognise::{Evidence, Finding, Key, Traffic};
use crate::{Driver, Recognise};
use alloc::format;
use alloc::string::String;
use alloc::vec::Vec;

impl Recognise for OpenImuOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        ADDRESSES
            .filter_map(|address| sensor(seen, address))
            .collect()
    }
}

/// The sensor at `source`, if `seen` shows it. One group alone may be that of a tilt sensor of
/// another maker.
fn sensor(seen: &Traffic, source: u8) -> Option<Finding> {
    let mut evidence = Evidence::new(seen, ADDRESSES.count());
    let mut quantities: Vec<&str> = Vec::new();
    let mut measured = None;
    for (quantity, name) in [
        (OpenImuQuantity::Orientation, "orientation"),
        (OpenImuQuantity::Acceleration, "acceleration"),
        (OpenImuQuantity::AngularVelocity, "angular_velocity"),
    ] {
        let (pgn, priority, _) = quantity.pgn_priority_bit();
        if let Some(stream) = evidence.sends_length(identifier(priority, pgn, source), 8) {
            quantities.push(name);
            measured = measured.or(stream.period());
        }
    }
    if quantities.len() < 2 {
        return None;
    }
    let what = "Aceinna OpenIMU or MTLT (J1939)";
    let finding = evidence.finding(OpenImuOptions::NAME, source.into(), what)?;
    let words: String = format!("{quantities:?}");
    let mut keys = Vec::from([Key::new("quantities", words)]);
    let is_near = |divider: &&u8| {
        let ratio = measured.map(|measured| measured.seconds() / period(**divider).seconds());
        ratio.is_some_and(|ratio| (ratio - 1.0).abs() < 0.1)
    };
    let divider = DIVIDERS.iter().find(is_near);
    keys.extend(divider.map(|divider| Key::new("period_ms", period(*divider).0 / 1_000_000)));
    Some(finding.with_keys(keys))
}
