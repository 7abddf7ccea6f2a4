//! Recognising boards: by what they answer, to this host or to another program.

use super::AtiNetcanoemOptions;
use super::frames::{BASE_MOST, ForceUnit, TorqueUnit, id, opcode};
use crate::recognise::{Evidence, Finding, Key, Traffic};
use crate::{Driver, Frame, Recognise};
use alloc::format;
use alloc::string::String;
use alloc::vec::Vec;

fn is_units(frame: &Frame) -> bool {
    match *frame.data() {
        [force, torque] => {
            ForceUnit::from_code(force).is_some() && TorqueUnit::from_code(torque).is_some()
        }
        _ => false,
    }
}

/// Whether it is a text: letters and digits, which zeros or spaces fill up.
fn is_text(frame: &Frame) -> bool {
    let is_filler = |byte: &u8| matches!(byte, 0 | b' ');
    let mut bytes = frame
        .data()
        .iter()
        .skip_while(|b| b.is_ascii_alphanumeric() || **b == b'-');
    let starts = frame.data().first().is_some_and(u8::is_ascii_alphanumeric);
    frame.len() >= 4 && starts && bytes.all(is_filler)
}

/// The board at `base`, if `seen` shows it. A request and its answer have one identifier.
fn sensor(seen: &Traffic, driver: &'static str, base: u8) -> Option<Finding> {
    let mut evidence = Evidence::new(seen, usize::from(BASE_MOST) + 1);
    let id = |opcode| id(base, opcode);
    let has_length = |lengths: [usize; 2]| move |frame: &Frame| lengths.contains(&frame.len());
    let first = evidence.answers(id(opcode::GAUGES), has_length([8, 8]));
    let second = evidence.sends_length(id(opcode::GAUGES_SECOND), 6);
    if let (Some(first), Some(second)) = (first, second) {
        evidence.together(first, second);
        evidence.measures(first);
    } else if second.is_some() {
        evidence.lacks();
    }
    let units = evidence.answers(id(opcode::UNITS), is_units);
    evidence.answers(id(opcode::COUNTS), has_length([8, 8]));
    if second.is_none() && units.is_none() {
        return None;
    }
    // A row's question, and its three answers.
    evidence.sends(id(opcode::MATRIX), has_length([1, 8]));
    for opcode in [opcode::MATRIX + 1, opcode::MATRIX_LAST] {
        evidence.sends_length(id(opcode), 8);
    }
    let mut what = String::from("ATI sensor at a NETCANOEM board");
    if let Some(serial) = evidence.answers(id(opcode::SERIAL), is_text) {
        let bytes = serial.kept().find(|frame| !frame.is_empty());
        let letters = bytes.into_iter().flat_map(Frame::data).copied();
        let letters: String = (letters.map(char::from).filter(char::is_ascii_graphic)).collect();
        what = format!("{what}, serial {letters}");
    }
    let finding = evidence.finding(driver, base.into(), what)?;
    let is_answer = |frame: &Frame| frame.len() == 8;
    let period = first.and_then(|stream| stream.period_of(is_answer));
    let finding = finding.with_keys(Key::period_ms(period, 1, 1000));
    // A frame without data may be a command, too: it selects, resets, or sets the bit rate.
    Some(finding.with_commands([id(0)..=id(0xF)]))
}

impl Recognise for AtiNetcanoemOptions {
    const ASKED_BY_NAME: bool = true;

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        (0..=BASE_MOST)
            .filter_map(|base| sensor(seen, Self::NAME, base))
            .collect()
    }

    /// All bases are asked for their units; those that have answered for their serial number and
    /// counts.
    fn questions(seen: &Traffic) -> Vec<Frame> {
        let mut questions = Vec::new();
        for base in 0..=BASE_MOST {
            questions.push(Frame::new(id(base, opcode::UNITS), &[]));
            let heard = seen.stream(id(base, opcode::UNITS));
            if heard.is_some_and(|stream| stream.kept().any(is_units)) {
                questions.push(Frame::new(id(base, opcode::SERIAL), &[]));
                questions.push(Frame::new(id(base, opcode::COUNTS), &[]));
            }
        }
        questions
    }
}
