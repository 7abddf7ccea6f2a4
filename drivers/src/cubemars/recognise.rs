//! Recognising motors: by their uploads in servo mode, or by their replies in MIT mode.

use super::frames::SERVO_STATUS;
use super::options::Options;
use crate::recognise::{BYTE, Evidence, Finding, Key, LENGTH, Stream, Traffic, byte_of, length_of};
use crate::{Driver, Frame, Id};
use alloc::vec::Vec;

/// Errors, and that there is none.
const ERRORS: usize = 8;

fn has_error(byte: Option<&u8>) -> bool {
    byte.is_some_and(|error| usize::from(*error) < ERRORS)
}

/// The motors that `seen` shows.
pub(super) fn motors(seen: &Traffic) -> Vec<Finding> {
    let servo = (0..=0xFE_u8).filter_map(|number| servo(seen, number));
    let mit = seen.streams().flat_map(|stream| mit(seen, stream));
    servo.chain(mit).collect()
}

fn finding(evidence: Evidence<'_>, number: u8, what: &str, mode: &str) -> Option<Finding> {
    let finding = evidence.finding(Options::NAME, number.into(), what)?;
    let mode = Key::new("mode", mode);
    let model = Key::fill_in("model", "\"AK80-9\"", "its ranges depend on it");
    Some(finding.with_keys([mode, model]).with_joints([0]))
}

fn servo(seen: &Traffic, number: u8) -> Option<Finding> {
    let mut evidence = Evidence::new(seen, 0xFF);
    let id = Id::extended(SERVO_STATUS | u32::from(number));
    let stream = evidence.sends(id, LENGTH + byte_of(ERRORS), |frame| {
        frame.len() == 8 && has_error(frame.data().get(7))
    })?;
    let finding = finding(
        evidence,
        number,
        "CubeMars motor in servo mode",
        "\"servo\"",
    )?;
    Some(finding.with_keys(Key::period_ms(stream.period(), 1, 60_000)))
}

/// The motors that reply on the identifier of `stream`: 0, or their own number.
fn mit(seen: &Traffic, stream: &Stream) -> Vec<Finding> {
    let Id::Standard(host) = stream.id else {
        return Vec::new();
    };
    let mut numbers: Vec<u8> = Vec::new();
    for frame in stream.kept() {
        if let Some(&number) = frame.data().first()
            && !numbers.contains(&number)
        {
            numbers.push(number);
        }
    }
    let own = numbers
        .first()
        .is_some_and(|number| u16::from(*number) == host);
    if host != 0 && !(own && numbers.len() == 1) {
        return Vec::new();
    }
    let is_reply = |frame: &Frame| {
        let data = frame.data();
        data.len() == 6 || data.len() == 8 && has_error(data.get(7))
    };
    let find = |number: &u8| {
        let mut evidence = Evidence::new(seen, if host == 0 { 1 } else { 0xFF });
        let stage = if stream.lengths.1 == 8 {
            byte_of(ERRORS)
        } else {
            0.0
        };
        // The first byte is the identifier, or keeps to few numbers.
        let few = stream.frames >= 8 * numbers.len() as u64;
        let number_bits = match (host, few) {
            (1.., _) => BYTE,
            (0, true) => byte_of(numbers.len()),
            (0, false) => 0.0,
        };
        evidence.sends(stream.id, length_of(2) + stage + number_bits, is_reply)?;
        evidence.belongs(Id::standard((*number).into()));
        let what = "CubeMars motor in MIT mode";
        let finding = finding(evidence, *number, what, "\"mit\"")?;
        let host = (host != 0).then(|| Key::new("host_id", host));
        let is_its = |frame: &Frame| frame.data().first() == Some(number);
        let period = Key::period_ms(stream.period_of(is_its), 1, 60_000);
        let command = Id::standard((*number).into());
        let finding = finding.with_keys(host).with_keys(period);
        Some(finding.with_commands([command..=command]))
    };
    // A bus has not many motors: more numbers are no numbers.
    let few = numbers.len() <= 16;
    numbers.iter().filter(|_| few).filter_map(find).collect()
}
