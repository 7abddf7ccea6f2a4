//! Recognising motors by their answers to commands and questions.

use super::frames::{ANSWERS, COMMANDS, LENGTH, MOTION, command};
use super::options::MyactuatorOptions;
use crate::bytes::{i16_le, u32_le};
use crate::recognise::{Evidence, Finding, Key, Stream, Traffic};
use crate::{Driver, Frame, Id, Recognise, mit};
use alloc::vec::Vec;

/// The highest number.
const NUMBERS: u16 = 32;
/// Commands that are answered, beside those that the driver reads.
const OTHERS: [u8; 20] = [
    0x30, 0x31, 0x32, 0x42, 0x43, 0x60, 0x61, 0x62, 0x64, 0x70, 0x71, 0x80, 0x81, 0x88, 0x90, 0x94,
    0x9B, 0x9D, 0xB1, 0xB2,
];

fn is_command(byte: u8) -> bool {
    let known = [command::ANGLE, command::ERRORS, command::STATE];
    known.contains(&byte) || command::MOVES.contains(&byte) || OTHERS.contains(&byte)
}

fn has_command(frame: &Frame) -> bool {
    frame.len() == LENGTH && frame.data().first().is_some_and(|byte| is_command(*byte))
}

/// An answer of V3.
fn is_answer(frame: &Frame) -> bool {
    has_command(frame)
        && match *frame.data() {
            [command::ANGLE, a, b, c, ..] => [a, b, c] == [0; 3],
            _ => true,
        }
}

impl Recognise for MyactuatorOptions {
    const ASKED_BY_NAME: bool = true;

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let v3 = (1..=NUMBERS).filter_map(|address| v3(seen, address));
        let v2 = (1..=NUMBERS).filter_map(|address| v2(seen, address));
        v3.chain(v2).collect()
    }

    /// The errors and the state of all motors.
    fn questions(_seen: &Traffic) -> Vec<Frame> {
        let asked = |address: u16| {
            [command::ERRORS, command::STATE].map(|command| {
                let data = [command, 0, 0, 0, 0, 0, 0, 0];
                Frame::new(Id::standard(COMMANDS + address), &data)
            })
        };
        (1..=NUMBERS).flat_map(asked).collect()
    }
}

/// Whether answers to `command` are in `stream`.
fn has(stream: &Stream, command: u8) -> bool {
    let is_one = |frame: &Frame| {
        let rest = frame.data().split_first();
        rest.is_some_and(|(first, rest)| *first == command && rest.iter().any(|byte| *byte != 0))
    };
    stream.kept().any(is_one)
}

/// Whether the newest answers about errors and state tell one temperature.
fn agrees(stream: &Stream) -> bool {
    let temperature = |command: u8| {
        let is_one = |frame: &&Frame| {
            let rest = frame.data().split_first();
            rest.is_some_and(|(first, rest)| *first == command && rest.iter().any(|b| *b != 0))
        };
        let newest = stream.recent().rev().find(is_one)?;
        newest.data().get(1).map(|byte| byte.cast_signed())
    };
    let temperatures = (temperature(command::ERRORS), temperature(command::STATE));
    matches!(temperatures, (Some(a), Some(b)) if a.abs_diff(b) <= 1)
}

/// What that counts \[bits\]: a byte of two frames is the same, within 1, once in 85 times; but
/// more often if it is a small number.
const AGREE: f64 = 5.0;

fn finding(evidence: Evidence<'_>, address: u16, stream: &Stream) -> Option<Finding> {
    let what = "MyActuator RMD or LKMTech motor";
    let finding = evidence.finding(MyactuatorOptions::NAME, address.into(), what)?;
    let position = (!has(stream, command::ANGLE)).then(|| Key::new("position", "\"status\""));
    let commands = Id::standard(COMMANDS + address);
    Some(
        finding
            .with_keys(position)
            .with_joints([0])
            .with_commands([commands..=commands]),
    )
}

fn v3(seen: &Traffic, address: u16) -> Option<Finding> {
    let mut evidence = Evidence::new(seen, usize::from(NUMBERS));
    let motion = Id::standard(MOTION + address);
    let answers = evidence.sends(Id::standard(ANSWERS + address), is_answer);
    let moves = evidence.sends(motion, |frame| {
        let first = frame.data().first().copied();
        frame.len() == LENGTH && first.map(u16::from) == Some(address)
    });
    let stream = answers.or(moves)?;
    if let Some(answers) = answers {
        evidence.measures(answers);
        evidence.moves(answers, |frame| match *frame.data() {
            [command::STATE | 0xA1..=0xA9, _, _, _, _, _, _, _] => {
                let [speed, place] = [4, 6].map(|at| f64::from(i16_le(frame.data(), at)));
                Some((place, speed))
            }
            _ => None,
        });
        evidence.moves(answers, with_angle(answers));
        evidence.is_commanded(Id::standard(COMMANDS + address), answers, |_| true);
        if agrees(answers) {
            evidence.add(AGREE);
        }
    }
    if let Some(moves) = moves {
        evidence.moves(moves, |frame| {
            let ([position, velocity, _], _) = mit::unpack(frame.data().get(1..)?)?;
            Some((position as f64, velocity as f64 - 2047.5))
        });
    }
    let by_motion = answers.is_none();
    let finding = finding(evidence, address, stream)?;
    if by_motion {
        let mut finding = finding;
        finding.keys.clear();
        return Some(finding.with_keys([Key::new("position", "\"motion\"")]));
    }
    Some(finding)
}

/// Reads the angles in answers, each with the speed in the answer before it.
fn with_angle(stream: &Stream) -> impl Fn(&Frame) -> Option<(f64, f64)> {
    move |frame| {
        let angle = match frame.data() {
            [command::ANGLE, 0, 0, 0, ..] => f64::from(u32_le(frame.data(), 4).cast_signed()),
            _ => return None,
        };
        let is_state =
            |other: &&Frame| other.t <= frame.t && other.data().first() == Some(&command::STATE);
        let state = stream.recent().rev().find(is_state)?;
        Some((angle, f64::from(i16_le(state.data(), 4))))
    }
}

/// In V2 answers have the identifier of commands: both are heard on it.
fn v2(seen: &Traffic, address: u16) -> Option<Finding> {
    let mut evidence = Evidence::new(seen, usize::from(NUMBERS));
    let stream = evidence.sends(Id::standard(COMMANDS + address), has_command)?;
    let is_question = |frame: &Frame| frame.data().iter().skip(1).all(|byte| *byte == 0);
    let asked = |command: u8| {
        let is_one = |frame: &&Frame| frame.data().first() == Some(&command);
        stream.kept().filter(is_one).any(is_question)
    };
    let is_answered = |command: &u8| asked(*command) && has(stream, *command);
    let asking = [command::STATE, command::ANGLE, command::ERRORS];
    let (answered, agrees) = (asking.iter().any(is_answered), agrees(stream));
    if !answered && (!agrees || asking.into_iter().any(asked)) {
        return None;
    }
    if answered {
        // A question and its answer, of one command, which others have once in 16 times.
        evidence.add(4.0);
    }
    if agrees {
        evidence.add(AGREE);
    }
    let finding = finding(evidence, address, stream)?;
    Some(finding.with_keys([Key::new("protocol", "\"v2\"")]))
}
