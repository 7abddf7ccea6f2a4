//! Recognising motors by the frames with which they answer commands and questions.

use super::frames::{DamiaoMessage, DamiaoState, QUESTIONS, RANGES, READ, STATE, question};
use super::options::DamiaoOptions;
use crate::recognise::{Evidence, Finding, IdUse, Key, Stream, Traffic};
use crate::{Driver, Frame, Id, Recognise};
use alloc::vec::Vec;

/// How many motors a scan asks: people number them from 1 on.
const ASKED: u8 = 0x20;
/// The temperatures of a motor that works \[degrees Celsius\], and how far those of power stage and
/// rotor are from each other.
const CELSIUS: core::ops::RangeInclusive<u8> = 5..=120;
const APART: u8 = 50;
/// The ends that a range has.
const ENDS: core::ops::Range<f32> = 0.5..1000.0;
/// What an answer with a range counts \[bits\]: four bytes that others send once in 2^32 times, but
/// small numbers.
const TELLS: f64 = 16.0;

/// What a question to the motor counts that is heard \[bits\]: others have its bytes less often,
/// but a question for one motor may be on a bus without it.
const ASKS: f64 = 6.0;

/// What `frame` tells of the motor at `address`, if it may be its frame.
fn message(frame: &Frame, address: u8) -> Option<DamiaoMessage> {
    let data = (frame.len() == 8).then(|| frame.data())?;
    DamiaoMessage::parse(address, data).filter(|message| match message {
        DamiaoMessage::State(DamiaoState { state, celsius, .. }) => {
            let is_known = matches!(state, 0 | 1 | 5 | 6 | 8..=0xE);
            let [fet, rotor] = celsius;
            let are_usual = CELSIUS.contains(fet) && CELSIUS.contains(rotor);
            is_known && are_usual && fet.abs_diff(*rotor) <= APART
        }
        DamiaoMessage::Register(..) | DamiaoMessage::Other => true,
    })
}

/// A bus has not more motors than this: more streams of their form are of other devices, but for
/// those with the identifiers that most motors have.
const MOTORS: usize = 32;

impl Recognise for DamiaoOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let form = |frame: &Frame| {
            let half = frame.data().first().map(|first| first & 0xF);
            half.is_some_and(|half| message(frame, half).is_some())
        };
        let has_form =
            |stream: &&Stream| stream.frames > 0 && stream.recent().rev().take(4).all(form);
        let mut streams: Vec<&Stream> = seen.streams().filter(has_form).collect();
        if streams.len() > MOTORS {
            streams.retain(|stream| stream.id.raw() < 0x20);
        }
        let on = |stream: &Stream| on(seen, stream);
        streams.into_iter().flat_map(on).collect()
    }

    /// The state and a range of the first motors.
    fn questions(_seen: &Traffic) -> Vec<Frame> {
        let [range, ..] = RANGES;
        let asked = |address| {
            [
                question(address, false, STATE, 0),
                question(address, false, READ, range),
            ]
        };
        (1..=ASKED).flat_map(asked).collect()
    }
}

/// The motors that answer on the identifier of `stream`.
fn on(seen: &Traffic, stream: &Stream) -> Vec<Finding> {
    let Id::Standard(host @ 0..0x7FF) = stream.id else {
        return Vec::new();
    };
    // The low halves of their numbers.
    let mut halves: Vec<u8> = Vec::new();
    for half in stream.first_bytes().iter().map(|first| first & 0xF) {
        if !halves.contains(&half) {
            halves.push(half);
        }
    }
    if halves.len() > 8 {
        return Vec::new();
    }
    let find = |half: &u8| {
        // Commands tell the number; without any it is a small one.
        let numbers = (0..=0xF_u8).map(|high| high << 4 | half);
        let is_commanded = |number: &u8| {
            let id = Id::standard((*number).into());
            *number > 0 && id != stream.id && seen.stream(id).is_some_and(|s| s.frames > 0)
        };
        let address = numbers.clone().find(is_commanded).unwrap_or(*half);
        motor(seen, stream, host, &halves, address)
    };
    halves.iter().filter_map(find).collect()
}

fn motor(
    seen: &Traffic,
    stream: &Stream,
    host: u16,
    halves: &[u8],
    address: u8,
) -> Option<Finding> {
    if address == 0 {
        return None;
    }
    // Usual are 0 as it is delivered, and the number plus 10 (hexadecimal); and numbers up to 8.
    let is_usual = host == 0 || host == u16::from(address) + 0x10;
    let addresses = match (is_usual, address) {
        (true, 1..=8) => 16,
        (true, _) => 64,
        (false, _) => 0x7FF * 15,
    };
    let mut evidence = Evidence::with_fd(seen, addresses);
    let shared = (halves.len() > 1 || host == 0).then_some(address & 0xF);
    if halves.len() > 1 {
        evidence.add(-3.0);
    }
    evidence.sends_as(IdUse::Sends(shared), stream.id, |frame| {
        let number = frame.data().first().map(|first| first & 0xF);
        number.is_some_and(|number| halves.contains(&number) && message(frame, number).is_some())
    })?;
    let is_its =
        |frame: &Frame| frame.data().first().map(|first| first & 0xF) == Some(address & 0xF);
    let has_told = |frame: &Frame| match message(frame, address) {
        Some(DamiaoMessage::Register(register, value)) => {
            RANGES.contains(&register) && ENDS.contains(&value)
        }
        _ => false,
    };
    if stream.kept().any(has_told) {
        evidence.add(TELLS);
    }
    evidence.measures(stream);
    evidence.moves(stream, |frame| match message(frame, address) {
        Some(DamiaoMessage::State(DamiaoState {
            raw: [position, velocity, _],
            ..
        })) if is_its(frame) => Some((position as f64, velocity as f64 - 2047.5)),
        _ => None,
    });
    let command = Id::standard(address.into());
    let asks = |frame: &Frame| matches!(frame.data(), [low, 0, ..] if *low == address);
    let asked = seen.stream(QUESTIONS);
    if asked.is_some_and(|asked| asked.kept().any(asks)) {
        evidence.belongs(QUESTIONS);
        evidence.add(ASKS);
    } else {
        evidence.is_commanded(command, stream, is_its);
    }
    // Modes that are not MIT's.
    for base in [0x100, 0x200, 0x300] {
        evidence.belongs(Id::standard(base + u16::from(address)));
    }
    let finding = evidence.finding(DamiaoOptions::NAME, address.into(), "Damiao motor")?;
    let model = Key::fill_in("model", "\"DM4310\"", "its ranges depend on it");
    let host = (host != 0).then(|| Key::new("host_id", host));
    let period = Key::period_ms(stream.period_of(is_its), 1, 60_000);
    Some(
        finding
            .with_keys([model])
            .with_keys(host)
            .with_keys(period)
            .with_joints([0])
            .with_commands([command..=command]),
    )
}
