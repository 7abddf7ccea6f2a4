//! Recognising motors: by their uploads in servo mode, or by their replies in MIT mode.

use super::frames::SERVO_STATUS;
use super::options::Options;
use crate::recognise::{Evidence, Finding, Key, Part, Stream, Traffic};
use crate::{Driver, Frame, Id};
use alloc::vec::Vec;

/// Errors, and that there is none.
const ERRORS: usize = 8;

/// The largest current of an upload \[0.01 A\].
const CURRENT: u16 = 6000;

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
    let stream = evidence.sends(id, |frame| match *frame.data() {
        [_, _, _, _, a, b, _, error] => {
            let current = i16::from_be_bytes([a, b]);
            current.unsigned_abs() <= CURRENT && has_error(Some(&error))
        }
        _ => false,
    })?;
    evidence.moves(stream, |frame| match *frame.data() {
        [a, b, c, d, ..] => {
            let [position, velocity] = [[a, b], [c, d]].map(i16::from_be_bytes);
            Some((position.into(), velocity.into()))
        }
        _ => None,
    });
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
        let addresses = match (host, number) {
            (0, _) => 1,
            // Like other devices, half of the motors have such a number.
            (_, ..0x20) => 0x40,
            _ => 0xFF,
        };
        let mut evidence = Evidence::new(seen, addresses);
        // Numbers are those that were heard: few of them tell something, and less than a rule.
        let few = stream.frames >= 8 * numbers.len() as u64;
        if few && numbers.len() > 1 {
            evidence.add(-3.0);
        }
        let part = Part::Sends((host == 0).then_some(*number));
        evidence.sends_as(part, stream.id, |frame| {
            let is_own = frame.data().first().is_some_and(|first| match host {
                0 => !few || numbers.contains(first),
                _ => u16::from(*first) == host,
            });
            is_own && is_reply(frame)
        })?;
        let command = Id::standard((*number).into());
        let is_its = |frame: &Frame| frame.data().first() == Some(number);
        if host == 0 {
            evidence.is_commanded(command, stream, is_its);
        }
        evidence.moves(stream, |frame| match *frame.data() {
            [first, a, b, c, d, ..] if first == *number => {
                let velocity = u16::from_be_bytes([c, d]) >> 4;
                let position = u16::from_be_bytes([a, b]);
                Some((position.into(), f64::from(velocity) - 2047.5))
            }
            _ => None,
        });
        let what = "CubeMars motor in MIT mode";
        let finding = finding(evidence, *number, what, "\"mit\"")?;
        let host = (host != 0).then(|| Key::new("host_id", host));
        let period = Key::period_ms(stream.period_of(is_its), 1, 60_000);
        let finding = finding.with_keys(host).with_keys(period);
        Some(finding.with_commands([command..=command]))
    };
    // A bus has not many motors: more numbers are no numbers.
    let few = numbers.len() <= 16;
    numbers.iter().filter(|_| few).filter_map(find).collect()
}
