//! Recognising motors: by their uploads in servo mode, or by their replies in MIT mode.

use super::frames::SERVO_STATUS;
use super::options::CubemarsOptions;
use crate::recognise::{Evidence, Finding, IdUse, Key, Stream, Traffic};
use crate::{Driver, Frame, Id, Recognise};
use alloc::vec::Vec;

/// Errors, and that there is none.
const ERRORS: usize = 8;

/// The largest current of an upload \[0.01 A\].
const CURRENT: u16 = 6000;

fn has_error(byte: Option<&u8>) -> bool {
    byte.is_some_and(|error| usize::from(*error) < ERRORS)
}

impl Recognise for CubemarsOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let servo = (0..=0xFE_u8).filter_map(|number| servo(seen, number));
        let mit = seen.streams().flat_map(|stream| mit(seen, stream));
        servo.chain(mit).collect()
    }
}

fn finding(evidence: Evidence<'_>, number: u8, what: &str, mode: &str) -> Option<Finding> {
    let finding = evidence.finding(CubemarsOptions::NAME, number.into(), what)?;
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
    match u8::try_from(host) {
        Ok(0) => on_zero(seen, stream),
        Ok(number) => on_its_own(seen, stream, number).into_iter().collect(),
        Err(_) => Vec::new(),
    }
}

fn is_reply(frame: &Frame, number: u8) -> bool {
    let data = frame.data();
    let has_length = data.len() == 6 || data.len() == 8 && has_error(data.get(7));
    has_length && data.first() == Some(&number)
}

/// Motor `number`, if it replies on the identifier on which it is commanded.
fn on_its_own(seen: &Traffic, stream: &Stream, number: u8) -> Option<Finding> {
    let is_its = |frame: &Frame| is_reply(frame, number);
    let (all, replies) = (
        stream.recent().count(),
        stream.recent().filter(|frame| is_its(frame)).count(),
    );
    // Like other devices, half of the motors have such a number.
    let addresses = if number < 0x20 { 0x40 } else { 0xFF };
    let mut evidence = Evidence::new(seen, addresses);
    if replies == all {
        evidence.sends(stream.id, is_its)?;
    } else if replies * 3 >= all {
        // Commands and replies in turn, half of which begin with the identifier by chance once in
        // 256 times.
        evidence.sends(stream.id, |frame| is_its(frame) || frame.len() == 8)?;
        evidence.add(8.0);
    }
    with_motion(&mut evidence, stream, number);
    let what = "CubeMars motor in MIT mode";
    let finding = finding(evidence, number, what, "\"mit\"")?;
    let keys = Key::period_ms(stream.period_of(is_its), 1, 60_000);
    let host = Key::new("host_id", number);
    let finding = finding.with_keys([host]).with_keys(keys);
    Some(finding.with_commands([stream.id..=stream.id]))
}

/// Whether the positions of motor `number` go on as its velocities say.
fn with_motion(evidence: &mut Evidence<'_>, stream: &Stream, number: u8) {
    evidence.moves(stream, |frame| match *frame.data() {
        [first, a, b, c, d, ..] if first == number && is_reply(frame, number) => {
            let velocity = u16::from_be_bytes([c, d]) >> 4;
            let position = u16::from_be_bytes([a, b]);
            Some((position.into(), f64::from(velocity) - 2047.5))
        }
        _ => None,
    });
}

/// The motors that reply on identifier 0.
fn on_zero(seen: &Traffic, stream: &Stream) -> Vec<Finding> {
    let numbers = stream.first_bytes();
    // Numbers are those that were heard: few of them tell something, and less than a rule.
    let few = stream.frames >= 8 * numbers.len() as u64;
    let find = |number: &u8| {
        let mut evidence = Evidence::new(seen, 1);
        if few && numbers.len() > 1 {
            evidence.add(-3.0);
        }
        evidence.sends_as(IdUse::Sends(Some(*number)), stream.id, |frame| {
            let first = frame.data().first();
            first.is_some_and(|first| (!few || numbers.contains(first)) && is_reply(frame, *first))
        })?;
        let command = Id::standard((*number).into());
        let is_its = |frame: &Frame| frame.data().first() == Some(number);
        evidence.is_commanded(command, stream, is_its);
        with_motion(&mut evidence, stream, *number);
        let what = "CubeMars motor in MIT mode";
        let finding = finding(evidence, *number, what, "\"mit\"")?;
        let period = Key::period_ms(stream.period_of(is_its), 1, 60_000);
        Some(finding.with_keys(period).with_commands([command..=command]))
    };
    // A bus has not many motors: more numbers are no numbers.
    let are_few = numbers.len() <= 16;
    numbers
        .iter()
        .filter(|_| are_few)
        .filter_map(find)
        .collect()
}
