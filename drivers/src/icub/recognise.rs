//! Recognising boards of the protocol: by what they tell of themselves, and by their streams.

use super::{ADDRESSES, BROADCAST, board, class, command, to_board, to_host};
use crate::recognise::{Evidence, Finding, IdUse, Key, Stream, Traffic, log2};
use crate::{Format, Frame, Id};
use alloc::format;
use alloc::string::String;
use alloc::vec::Vec;

/// What a board has told of itself.
#[derive(Debug, Clone)]
struct BoardIdentity {
    board: u8,
    /// Major, minor; build in the application alone.
    version: [u8; 2],
    build: Option<u8>,
    /// The text in it.
    info: String,
}

/// Takes the answers of board `address`, if it is of one of `types`; `Err` if it is of another one.
fn identity(
    evidence: &mut Evidence<'_>,
    address: u8,
    types: &[u8],
) -> Result<Option<BoardIdentity>, ()> {
    let mut identity = discovered(evidence, address, types);
    for (class, command) in [
        (class::POLLING_ANALOG, command::GET_FIRMWARE_VERSION),
        (class::POLLING_MOTOR, command::MOTOR_GET_FIRMWARE_VERSION),
    ] {
        evidence.belongs(to_board(class, address));
        let version = version(evidence, to_host(class, address), command, types);
        identity = identity.or(version);
    }
    match identity {
        Some(identity) if !types.contains(&identity.board) => Err(()),
        identity => Ok(identity),
    }
}

/// What board `address` has answered to who asked all boards who they are, and for its text.
fn discovered(evidence: &mut Evidence<'_>, address: u8, types: &[u8]) -> Option<BoardIdentity> {
    let id = to_host(class::MANAGEMENT, address);
    // Commands of the bootloader are below 10.
    let rule = |frame: &Frame| {
        let first = frame.data().first().copied();
        first.is_some_and(|c| c == command::DISCOVER || c < 0x10)
    };
    let stream = evidence.sends_as(IdUse::Tells, id, rule)?;
    let mut identity = None;
    let mut texts: [Option<[u8; 4]>; 8] = [None; 8];
    let (mut frames, mut answers) = (0, 0_usize);
    for frame in stream.kept() {
        frames += 1;
        match *frame.data() {
            [command::DISCOVER, board, major, minor, ref build @ ..] if build.len() < 2 => {
                answers += 1;
                identity = Some(BoardIdentity {
                    board,
                    version: [major, minor],
                    build: build.first().copied(),
                    info: String::new(),
                });
            }
            [command::GET_ADDITIONAL_INFO, number, a, b, c, d] => {
                if let Some(text) = texts.get_mut(usize::from(number)) {
                    *text = Some([a, b, c, d]);
                }
            }
            _ => {}
        }
    }
    let mut identity = identity?;
    // A type of 256; among many frames one is like it by chance.
    evidence.add(8.0 - log2(types.len()) - log2(frames / answers.max(1)));
    if texts.iter().all(Option::is_some) {
        // A command, and eight numbers in their order.
        evidence.add(16.0);
        let bytes = texts.iter().flatten().flatten();
        let text = bytes
            .take_while(|byte| **byte != 0)
            .map(|byte| char::from(*byte));
        identity.info = text.filter(|letter| !letter.is_control()).collect();
    }
    Some(identity)
}

/// What a board has answered with identifier `id` to who asked for its version with `command`.
fn version(
    evidence: &mut Evidence<'_>,
    id: Id,
    command: u8,
    types: &[u8],
) -> Option<BoardIdentity> {
    let stream = evidence.traffic.stream(id)?;
    let is_classic = |frame: &&Frame| frame.format == Format::Classic;
    let frames = stream.kept().filter(is_classic).count();
    let mut versions = (stream.kept().filter(is_classic)).filter_map(|frame| match *frame.data() {
        [c, board, major, minor, build, _, _, fits @ (0 | 1)]
            if c == command && board::NAMES.iter().any(|(known, _)| *known == board) =>
        {
            Some((board, [major, minor, build], fits))
        }
        _ => None,
    });
    let (board, [major, minor, build], fits) = versions.next()?;
    let count = 1 + versions.count();
    // Among many frames one is like it by chance.
    if count * 32 < frames {
        return None;
    }
    // A command and a type of 256 each, and a byte that is 1; 0 is in many frames.
    let fits = if fits == 1 { 7.0 } else { 1.0 };
    let bits = 8.0 + (8.0 - log2(types.len())) + fits;
    evidence.tells(id, bits - log2(frames / count));
    Some(BoardIdentity {
        board,
        version: [major, minor],
        build: Some(build),
        info: String::new(),
    })
}

/// The boards of driver `driver`. `types` are those that it reads, of which some (`maybe`) may lack
/// the part that it reads: they are found only if they send. `streams` adds what speaks for board
/// `address`, and returns keys and joints.
pub(crate) fn recognise(
    seen: &Traffic,
    driver: &'static str,
    types: &[u8],
    maybe: &[u8],
    streams: impl Fn(&mut Evidence<'_>, u8, Option<u8>) -> (Vec<Key>, Vec<u8>),
) -> Vec<Finding> {
    let find = |address: u8| {
        let mut evidence = Evidence::new(seen, ADDRESSES.count());
        let identity = identity(&mut evidence, address, types).ok()?;
        let board = identity.as_ref().map(|identity| identity.board);
        let (keys, joints) = streams(&mut evidence, address, board);
        if board.is_none_or(|board| maybe.contains(&board)) && !evidence.is_sending() {
            return None;
        }
        let what = match &identity {
            None => "iCub board".into(),
            Some(identity) => {
                let known = board::NAMES
                    .iter()
                    .find(|(code, _)| *code == identity.board);
                let name = known.map_or("board", |(_, name)| name);
                let [major, minor] = identity.version;
                let text = match identity.info.as_str() {
                    "" => String::new(),
                    text => format!(", {text:?}"),
                };
                match identity.build {
                    Some(build) => format!("{name}, firmware {major}.{minor}.{build}{text}"),
                    None => format!("{name}, in its bootloader {major}.{minor}: restart it{text}"),
                }
            }
        };
        let finding = evidence.finding(driver, address.into(), what)?;
        Some(finding.with_keys(keys).with_joints(joints))
    };
    ADDRESSES.filter_map(find).collect()
}

/// All boards are asked who they are, and those that answer for the text in them.
pub(crate) fn questions(seen: &Traffic) -> Vec<Frame> {
    let everyone = to_board(class::MANAGEMENT, BROADCAST);
    let mut questions = Vec::from([Frame::new(everyone, &[command::DISCOVER])]);
    for address in ADDRESSES {
        let heard = seen.stream(to_host(class::MANAGEMENT, address));
        let mut frames = heard.into_iter().flat_map(Stream::kept);
        // A bootloader is left alone.
        if frames.any(|f| f.data().first() == Some(&command::DISCOVER) && f.len() == 5) {
            let id = to_board(class::MANAGEMENT, address);
            questions.push(Frame::new(id, &[command::GET_ADDITIONAL_INFO]));
        }
    }
    questions
}
