//! Recognising boards: by what they answer, to this host or to another program.

use super::frames::{BASE_MOST, ForceUnit, TorqueUnit, id, opcode};
use crate::recognise::{Evidence, Finding, Key, LENGTH, Stream, Traffic, byte_of, length_of};
use crate::{Format, Frame};
use alloc::format;
use alloc::string::String;
use alloc::vec::Vec;

fn is_units(frame: &Frame) -> bool {
    match *frame.data() {
        [] => true,
        [force, torque] => {
            ForceUnit::from_code(force).is_some() && TorqueUnit::from_code(torque).is_some()
        }
        _ => false,
    }
}

/// The board at `base`, if `seen` shows it. A request and its answer have one identifier.
pub(super) fn sensor(seen: &Traffic, driver: &'static str, base: u8) -> Option<Finding> {
    let mut evidence = Evidence::new(seen, usize::from(BASE_MOST) + 1);
    let id = |opcode| id(base, opcode);
    let lengths = |lengths: [usize; 2]| {
        move |frame: &Frame| frame.format == Format::Classic && lengths.contains(&frame.len())
    };
    let answers = |stream: &Stream| stream.lengths.1 > 0;
    let first = evidence.sends(id(opcode::GAUGES), length_of(2), lengths([0, 8]));
    let second = evidence.sends_length(id(opcode::GAUGES_SECOND), 6);
    if let (Some(first), Some(second)) = (first, second) {
        evidence.together(first, second);
    }
    let units = LENGTH + 2.0 * byte_of(6);
    let units = evidence
        .sends(id(opcode::UNITS), units, is_units)
        .is_some_and(answers);
    let counts = evidence.sends(id(opcode::COUNTS), length_of(2), lengths([0, 8]));
    if second.is_none() && !units {
        return None;
    }
    for (opcode, most) in [
        (opcode::MATRIX, 8),
        (opcode::MATRIX + 1, 8),
        (opcode::MATRIX_LAST, 8),
    ] {
        evidence.sends(id(opcode), length_of(2), lengths([1, most]));
    }
    let mut what = String::from("ATI sensor at a NETCANOEM board");
    let text = |opcode| {
        let stream = seen.stream(id(opcode))?;
        let frame = stream.kept().find(|frame| !frame.is_empty())?;
        let letters = frame.data().iter().copied().map(char::from);
        let text: String = letters.filter(char::is_ascii_graphic).collect();
        (!text.is_empty()).then_some(text)
    };
    if counts.is_some_and(answers) {
        // Both counts are above 0.
        evidence.add(1.0);
    }
    if let Some(serial) = text(opcode::SERIAL) {
        // Letters and digits.
        evidence.explains(id(opcode::SERIAL), byte_of(2));
        what = format!("{what}, serial {serial}");
    }
    let finding = evidence.finding(driver, base.into(), what)?;
    let is_answer = |frame: &Frame| frame.len() == 8;
    let period = first.and_then(|stream| stream.period_of(is_answer));
    Some(finding.with_keys(Key::period_ms(period, 1, 1000)))
}

/// All bases are asked for their units; those that have answered for their serial number and counts.
pub(super) fn questions(seen: &Traffic) -> Vec<Frame> {
    let mut questions = Vec::new();
    for base in 0..=BASE_MOST {
        questions.push(Frame::new(id(base, opcode::UNITS), &[]));
        let heard = seen.stream(id(base, opcode::UNITS));
        if heard.is_some_and(|stream| stream.kept().any(|f| f.len() == 2 && is_units(f))) {
            questions.push(Frame::new(id(base, opcode::SERIAL), &[]));
            questions.push(Frame::new(id(base, opcode::COUNTS), &[]));
        }
    }
    questions
}
