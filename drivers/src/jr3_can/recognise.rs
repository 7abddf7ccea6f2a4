//! Recognising boards: by the counter in both halves of a reading, and by their full scales.

use super::Jr3CanOptions;
use super::protocol::{READY, id, op};
use crate::recognise::{Evidence, Finding, Key, Stream, Traffic};
use crate::{Driver, Frame, Recognise, bytes};
use alloc::vec::Vec;

/// Board `node`, if `seen` shows it.
fn board(seen: &Traffic, driver: &'static str, node: u16) -> Option<Finding> {
    let mut evidence = Evidence::new(seen, 127);
    let force = evidence.sends_length(id(op::FORCE, node), 8);
    let moment = evidence.sends_length(id(op::MOMENT, node), 8);
    if let (Some(force), Some(moment)) = (force, moment) {
        let counter = |frame: &Frame| bytes::u16_le(frame.data(), 6);
        let shared = |frame: &&Frame| force.recent().any(|f| counter(f) == counter(frame));
        let (all, same) = (
            moment.recent().count(),
            moment.recent().filter(shared).count(),
        );
        let goes_on = moment.recent().zip(moment.recent().skip(1));
        let goes_on = goes_on.filter(|(a, b)| counter(a) != counter(b)).count();
        if same * 10 >= all * 9 && goes_on * 10 >= all.saturating_sub(1) * 9 {
            // One of 48 that are kept, of 65536.
            evidence.add(10.0);
        }
        evidence.together(force, moment);
        evidence.measures(force);
    }
    // A state, alone or before three full scales.
    let acknowledged = evidence.sends(id(op::ACKNOWLEDGE, node), |frame| {
        let state = frame.data().first();
        let is_state = state.is_some_and(|state| *state <= READY + 1);
        is_state && matches!(frame.len(), 1 | 7)
    });
    let scales = acknowledged.is_some_and(|stream| {
        let plausible = |frame: &Frame| {
            let scale = |at| bytes::u16_le(frame.data(), at);
            frame.len() == 7
                && [1, 3, 5]
                    .into_iter()
                    .all(|at| (1..10_000).contains(&scale(at)))
        };
        let mut frames = stream.kept().filter(|frame| frame.len() == 7).peekable();
        frames.peek().is_some() && frames.all(plausible)
    });
    if scales {
        // Each a number of 16 bits, one of seven.
        evidence.add(8.0);
    }
    if (force.is_none() || moment.is_none()) && !scales {
        return None;
    }
    let finding = evidence.finding(driver, node.into(), WHAT)?;
    let commands = [
        op::START_SYNC,
        op::START,
        op::STOP,
        op::ZERO,
        op::FILTER,
        op::RESET,
    ];
    let commands = commands.map(|op| id(op, node)..=id(op, node));
    let period = Key::period_ms(force.and_then(Stream::period), 1, 1000);
    Some(finding.with_keys(period).with_commands(commands))
}

const WHAT: &str = "JR3 sensor at a board of UC3M";

impl Recognise for Jr3CanOptions {
    const ASKED_BY_NAME: bool = true;

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        (1..=0x7F)
            .filter_map(|node| board(seen, Self::NAME, node))
            .collect()
    }

    /// All boards are asked for their full scales.
    fn questions(_seen: &Traffic) -> Vec<Frame> {
        let ops = [op::GET_FORCE_SCALES, op::GET_MOMENT_SCALES];
        let questions = (1..=0x7F).flat_map(|node| ops.map(|op| Frame::new(id(op, node), &[])));
        questions.collect()
    }
}
