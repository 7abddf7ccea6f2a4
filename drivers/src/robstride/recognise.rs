//! Recognising motors by their states, by parameters that they tell, and by their number.

use super::frames::{LENGTH, RobstrideMessage, id, kind};
use super::options::RobstrideOptions;
use crate::bytes::{u16_be, u16_le};
use crate::recognise::{Evidence, Finding, IdUse, Key, Stream, Traffic};
use crate::{Driver, Frame, Id, Recognise};
use alloc::vec::Vec;

/// The highest number that people give, and the hosts that programs are.
const NUMBERS: u8 = 0x7F;
const HOSTS: [u8; 5] = [0xFD, 0x00, 0xFE, 0xFF, 0xAA];
/// The host of the MIT protocol, as it is delivered.
const MIT_HOST: u16 = 0xFD;
/// The highest temperature \[0.1 degrees Celsius\].
const TENTHS: u16 = 1600;
/// What a motor's answer about its number counts: 8 arbitrary bytes on an identifier of its own.
const TELLS: f64 = 4.0;

/// A motor is not at the lower ends of all three ranges.
fn is_state(frame: &Frame) -> bool {
    let data = frame.data();
    data.len() == LENGTH && u16_be(data, 6) <= TENTHS && !data.starts_with(&[0; 6])
}

fn is_parameter(frame: &Frame) -> bool {
    let data = frame.data();
    let is_known = matches!(u16_le(data, 0) >> 8, 0x20 | 0x30 | 0x70);
    data.len() == LENGTH && is_known && u16_le(data, 2) == 0
}

impl Recognise for RobstrideOptions {
    const ASKED_BY_NAME: bool = true;

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let mut found: Vec<(u8, u8)> = Vec::new();
        for stream in seen.streams().filter(|stream| stream.frames > 0) {
            let Id::Extended(raw) = stream.id else {
                continue;
            };
            let [host, address, upper, kind] = raw.to_le_bytes();
            let pair = match kind {
                kind::STATE | kind::REPORT if upper >> 6 < 3 => (address, host),
                kind::PARAMETER if upper < 2 && HOSTS.contains(&host) => (address, host),
                // Whoever asks, it tells its number to all.
                kind::DEVICE if (upper, host) == (0, 0xFE) => (address, 0xFD),
                _ => continue,
            };
            let is_new = found.iter().all(|known| known.0 != pair.0);
            if (1..=NUMBERS).contains(&address) && is_new {
                found.push(pair);
            }
        }
        let private = found
            .iter()
            .filter_map(|(address, host)| private(seen, *address, *host));
        let mit = seen.stream(Id::standard(MIT_HOST)).into_iter();
        private
            .chain(mit.flat_map(|stream| mit_motors(seen, stream)))
            .collect()
    }

    /// The numbers of all motors, of the host as it is delivered.
    fn questions(_seen: &Traffic) -> Vec<Frame> {
        let question = |address| Frame::new(id(kind::DEVICE, 0, 0xFD, address), &[0; LENGTH]);
        (1..=NUMBERS).map(question).collect()
    }
}

fn finding(evidence: Evidence<'_>, address: u8) -> Option<Finding> {
    let finding = evidence.finding(RobstrideOptions::NAME, address.into(), "RobStride motor")?;
    let model = Key::fill_in("model", "\"RS03\"", "its ranges depend on it");
    Some(finding.with_keys([model]).with_joints([0]))
}

fn private(seen: &Traffic, address: u8, host: u8) -> Option<Finding> {
    let hosts = if HOSTS.contains(&host) { 2 } else { 256 };
    let mut evidence = Evidence::new(seen, usize::from(NUMBERS) * hosts);
    let is_own = |stream: &&Stream, kinds: &[u8]| {
        let [to, from, upper, kind] = stream.id.raw().to_le_bytes();
        let is_extended = matches!(stream.id, Id::Extended(_));
        is_extended && (to, from) == (host, address) && upper >> 6 < 3 && kinds.contains(&kind)
    };
    let mut period = None;
    // The identifier tells the mode, and faults: what has many of these is another device with as
    // many messages of one form. So the stream with most frames speaks for the motor.
    let states = seen
        .streams()
        .filter(|stream| is_own(stream, &[kind::STATE, kind::REPORT]));
    let mut states: Vec<&Stream> = states.collect();
    states.sort_by_key(|stream| core::cmp::Reverse(stream.frames));
    if let Some((most, others)) = states.split_first() {
        if let Some(stream) = evidence.sends(most.id, is_state) {
            evidence.moves(stream, |frame| {
                let [position, velocity] = [0, 2].map(|at| f64::from(u16_be(frame.data(), at)));
                Some((position, velocity - 32767.5))
            });
            period = stream.period();
        }
        (others.iter()).for_each(|stream| evidence.belongs(stream.id));
    }
    for stream in seen
        .streams()
        .filter(|stream| is_own(stream, &[kind::PARAMETER]))
    {
        evidence.sends(stream.id, is_parameter);
    }
    for stream in seen
        .streams()
        .filter(|stream| is_own(stream, &[kind::FAULT]))
    {
        evidence.sends_length(stream.id, LENGTH);
    }
    let number = id(kind::DEVICE, 0, address, 0xFE);
    let tells = |stream: &Stream| stream.kept().all(|frame| frame.len() == LENGTH);
    if seen
        .stream(number)
        .is_some_and(|stream| stream.frames > 0 && tells(stream))
    {
        evidence.explains(number, TELLS);
    }
    // Commands and questions.
    for stream in seen.streams() {
        let [to, from, _, kind] = stream.id.raw().to_le_bytes();
        let is_asked = kind == kind::DEVICE || kind == kind::PARAMETER;
        let is_command = matches!(kind, 1 | 3 | 4 | 6 | 7 | 0x12 | 0x16..=0x19);
        let is_its = is_command || is_asked && HOSTS.contains(&from);
        if matches!(stream.id, Id::Extended(_)) && to == address && is_its {
            evidence.belongs(stream.id);
        }
    }
    let host = (host != 0xFD).then(|| Key::new("host_id", host));
    let period = Key::period_ms(period, 1, 60_000);
    Some(
        finding(evidence, address)?
            .with_keys(host)
            .with_keys(period),
    )
}

/// Motors with the MIT protocol that answer on the identifier of `stream`.
fn mit_motors(seen: &Traffic, stream: &Stream) -> Vec<Finding> {
    let numbers = stream.first_bytes();
    let are_few = (1..=16).contains(&numbers.len())
        && numbers.iter().all(|number| (1..=NUMBERS).contains(number));
    let find = |address: &u8| {
        let mut evidence = Evidence::new(seen, 16);
        if numbers.len() > 1 {
            evidence.add(-3.0);
        }
        evidence.sends_as(IdUse::Sends(Some(*address)), stream.id, |frame| {
            let first = frame.data().first();
            let is_own = first.is_some_and(|first| numbers.contains(first));
            is_own && is_state(frame)
        })?;
        let read = |frame: &Frame| match RobstrideMessage::of_mit(*address, frame.data()) {
            Some(RobstrideMessage::State(state)) => Some(state.raw),
            _ => None,
        };
        evidence.moves(stream, |frame| {
            let [position, velocity, _] = read(frame)?;
            Some((position as f64, velocity as f64 - 2047.5))
        });
        let command = Id::standard((*address).into());
        let is_its = |frame: &Frame| frame.data().first() == Some(address);
        evidence.is_commanded(command, stream, is_its);
        let finding = finding(evidence, *address)?;
        let period = Key::period_ms(stream.period_of(is_its), 1, 60_000);
        let finding = finding
            .with_keys([Key::new("protocol", "\"mit\"")])
            .with_keys(period);
        Some(finding.with_commands([command..=command]))
    };
    numbers
        .iter()
        .filter(|_| are_few)
        .filter_map(find)
        .collect()
}
