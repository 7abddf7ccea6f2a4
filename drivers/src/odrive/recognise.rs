//! Recognising axes: by heartbeat and estimates, and by the version that they tell.

use super::OdriveOptions;
use super::frames::{NODE_MOST, command};
use crate::recognise::{Evidence, Finding, Key, Stream, Traffic};
use crate::{Driver, Format, Frame, Id, Recognise, bytes};
use alloc::format;
use alloc::vec::Vec;

const fn id(node: u16, command: u8) -> Id {
    Id::standard(node << 5 | command as u16)
}

/// States of an axis, from undefined to the last calibration.
const STATES: usize = 15;

fn is_answer(frame: &Frame) -> bool {
    frame.format == Format::Classic && frame.len() == 8
}

/// Whether a frame has two floats of an ordinary size, or none.
fn is_measured(frame: &Frame) -> bool {
    let is_usual = |at| {
        let value = f32::from_bits(bytes::u32_le(frame.data(), at)).abs();
        value == 0.0 || value.is_nan() || (1e-7..1e8).contains(&value)
    };
    is_answer(frame) && is_usual(0) && is_usual(4)
}

fn is_heartbeat(frame: &Frame) -> bool {
    let state = frame.data().get(4).copied();
    is_answer(frame) && state.is_some_and(|state| usize::from(state) < STATES)
}

/// Axis `node`, if `seen` shows it.
fn axis(seen: &Traffic, driver: &'static str, node: u16) -> Option<Finding> {
    let mut evidence = Evidence::new(seen, usize::from(NODE_MOST) + 1);
    let heartbeat = id(node, command::HEARTBEAT);
    let beats = evidence.sends(heartbeat, is_heartbeat);
    let estimates = evidence.answers(id(node, command::ESTIMATES), is_measured);
    if beats.is_none() && estimates.is_none() {
        return None;
    }
    if beats.is_none() || estimates.is_none() {
        evidence.lacks();
    }
    if let Some(estimates) = estimates {
        evidence.moves(estimates, |frame| {
            let number = |at| f64::from(f32::from_bits(bytes::u32_le(frame.data(), at)));
            is_answer(frame).then(|| (number(0), number(4)))
        });
    }
    for command in [command::IQ, command::TEMPERATURE, command::TORQUES] {
        evidence.answers(id(node, command), is_measured);
    }
    let mut what = "ODrive".into();
    let mut firmware = "";
    let version = seen.stream(id(node, command::VERSION)).into_iter();
    let answer = version
        .flat_map(Stream::kept)
        .find(|frame| is_answer(frame));
    if let Some(&[_, hardware, revision, _, 0, minor @ (5 | 6), patch, _]) = answer.map(Frame::data)
    {
        // A byte that is 0, and one that is 5 or 6.
        evidence.explains(id(node, command::VERSION), 8.0 + 7.0);
        what = format!("ODrive {hardware}.{revision}, firmware 0.{minor}.{patch}");
        firmware = if minor == 5 { "0.5" } else { "0.6" };
    }
    let period = estimates.and_then(|stream| stream.period_of(is_answer));
    let finding = evidence.finding(driver, node.into(), what)?;
    let firmware = match firmware {
        "" => Key::fill_in("firmware", "\"0.6\"", "or \"0.5\", for an ODrive v3"),
        known => Key::new("firmware", format!("{known:?}")),
    };
    let period = Key::period_ms(period, 1, 60_000);
    let commands = id(node, 0)..=id(node, 0x1F);
    let finding = finding.with_keys([firmware]).with_keys(period);
    Some(finding.with_joints([0]).with_commands([commands]))
}

impl Recognise for OdriveOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        (0..=NODE_MOST)
            .filter_map(|node| axis(seen, Self::NAME, node))
            .collect()
    }

    /// Axes that are heard are asked for their version, by a remote frame.
    fn questions(seen: &Traffic) -> Vec<Frame> {
        let is_axis = |node: &u16| {
            let heard = seen.stream(id(*node, command::HEARTBEAT));
            heard.is_some_and(|stream| stream.frames > 0 && stream.kept().all(is_heartbeat))
        };
        // The identifier of axis 0 is that of CANopen's network management.
        let nodes = (1..=NODE_MOST).filter(is_axis);
        nodes
            .map(|node| Frame::remote(id(node, command::VERSION), 8))
            .collect()
    }
}
