//! What some other device would send: how often it would happen to send what a driver looks for.
//!
//! All values are in bits, -log2 of a probability. They are measured on the frames that were heard
//! and on the driver's own rule, so that no driver states them:
//!
//! - **Length**: six of ten devices send 8 bytes, each other length has one of twenty; nine of ten
//!   send frames of one length.
//! - **Bytes**: each byte of a frame is replaced by others, to see of how many values the rule
//!   takes. A byte that is always 00 or FF counts one bit at most: that is what unused bytes are.
//!   If the rule takes 00 or FF, another value counts two bits at most: other devices, too, have
//!   states and small numbers. One that changes, and that the rule still fits, counts one bit more.
//! - **Identifier**: half of the devices have a number below 20 (hexadecimal) as their identifier,
//!   the others any of 11 bits, or of about 20 bits that are in use of 29. Any of the identifiers
//!   that are heard might have been this one. An identifier that follows one that is already
//!   explained counts one bit, and so does one of the same row of identifiers, all of which are
//!   heard: most devices number their frames.
//! - **This bus**: the streams of it that no device of the family explains tell, too, how often
//!   other devices fulfil the rule. Where the rule fits other streams too, which are none
//!   of this family, the identifier is one of theirs: it counts no more than the density with which
//!   they fill the range from the first to the last of them. So it is where other streams are
//!   within 32 identifiers of it, whatever their form: devices have blocks of identifiers. Four
//!   are a block; with each that is missing it is one half as often.

use super::traffic::{Stream, Traffic};
use crate::{Format, Frame, Id};
use alloc::vec::Vec;

/// Values that take the place of a byte: each bit alone and others, of which a rule takes its part.
const PROBES: [u8; 32] = [
    0x00, 0x01, 0x02, 0x04, 0x08, 0x10, 0x20, 0x40, 0x80, 0x55, 0xAA, 0xFF, 0x07, 0x13, 0x1C, 0x29,
    0x33, 0x3E, 0x47, 0x4E, 0x5F, 0x66, 0x6B, 0x79, 0x87, 0x92, 0x9D, 0xB4, 0xC3, 0xD8, 0xE1, 0xF2,
];
/// The most that a length counts.
const LENGTH_MOST: f64 = 6.0;
/// What a byte counts that is always 00 or FF, at most.
const IDLE: f64 = 1.0;
/// What a byte counts that might be so, at most.
const SMALL: f64 = 2.0;
/// How much more a byte counts that changes.
const CHANGING: f64 = 1.0;
/// How far the identifiers of a block are from each other.
pub(super) const NEAR: u32 = 32;
/// How many streams near each other are a block of identifiers.
const BLOCK: usize = 4;
/// The bits of an identifier next to one that is explained.
const NEXT: f64 = 1.0;

#[allow(clippy::cast_precision_loss)] // counts
pub(crate) fn log2(count: usize) -> f64 {
    libm::log2(count.max(1) as f64)
}

/// The probability of a length of 0 to 8 bytes.
fn has_length(length: usize) -> f64 {
    if length == 8 { 0.6 } else { 0.05 }
}

/// `frame` with the first bytes of `data` in its place.
fn with(frame: &Frame, data: &[u8]) -> Frame {
    let changed = Frame::with_format(frame.id, frame.format, data);
    changed.unwrap_or(*frame).at(frame.t, frame.stamp)
}

/// What the lengths and the bytes of `stream` count, all of whose frames fulfil `rule`.
pub(super) fn form(stream: &Stream, rule: &dyn Fn(&Frame) -> bool) -> f64 {
    let fits = || stream.kept().filter(|frame| rule(frame));
    // The longest, of those the newest.
    let Some(longest) = fits().max_by_key(|frame| frame.len()) else {
        return 0.0;
    };
    lengths(stream, longest, rule) + bytes(stream, longest, rule)
}

fn lengths(stream: &Stream, longest: &Frame, rule: &dyn Fn(&Frame) -> bool) -> f64 {
    if longest.format != Format::Classic {
        return 0.0;
    }
    let mut data = [0; 8];
    for (to, byte) in data.iter_mut().zip(longest.data()) {
        *to = *byte;
    }
    let resized = (0..=8).filter_map(|length| Some(with(longest, data.get(..length)?)));
    let taken = resized.filter(|frame| rule(frame)).count();
    let (mut heard, mut other) = (0, 1.0);
    for length in stream.usual_lengths() {
        heard += 1;
        other *= has_length(length);
    }
    other *= if heard == 1 { 0.9 } else { 0.1 };
    (-libm::log2(other) - log2(taken)).clamp(-1.0, LENGTH_MOST)
}

fn bytes(stream: &Stream, longest: &Frame, rule: &dyn Fn(&Frame) -> bool) -> f64 {
    let mut all = 0.0;
    let mut data = [0; 8];
    let length = longest.len().min(data.len());
    for (to, byte) in data.iter_mut().zip(longest.data()) {
        *to = *byte;
    }
    for place in 0..length {
        let passes = |value: u8| {
            let mut probe = data;
            if let Some(byte) = probe.get_mut(place) {
                *byte = value;
            }
            rule(&with(longest, probe.get(..length).unwrap_or_default()))
        };
        if PROBES.iter().all(|value| passes(*value)) {
            continue;
        }
        let bits = 8.0 - log2((0..=u8::MAX).filter(|value| passes(*value)).count());
        let mut values: Vec<u8> = Vec::new();
        for value in stream.kept().filter_map(|frame| frame.data().get(place)) {
            if !values.contains(value) {
                values.push(*value);
            }
        }
        let most = if passes(0x00) || passes(0xFF) {
            SMALL
        } else {
            f64::INFINITY
        };
        all += match values[..] {
            [0x00 | 0xFF] => bits.min(IDLE),
            [_] => bits.min(most),
            _ => (2.0 * bits).min(bits + CHANGING).min(most),
        };
    }
    all
}

/// What a form counts that the model says to count `bits`, where `alike` of `others` have it: this
/// bus is better known than others, of which the model counts as eight streams.
pub(super) fn common(bits: f64, others: usize, alike: usize) -> f64 {
    const MODEL: f64 = 8.0;
    #[allow(clippy::cast_precision_loss)] // counts
    let chance = (alike as f64 + MODEL * libm::exp2(-bits)) / (others as f64 + MODEL);
    bits.min(-libm::log2(chance))
}

/// The other streams that `rule` fits too.
pub(super) fn alike(traffic: &Traffic, own: Id, rule: &dyn Fn(&Frame) -> bool) -> Vec<Id> {
    let is_alike = |stream: &&Stream| {
        let mut newest = stream.recent().rev().take(4);
        stream.id != own && stream.frames > 0 && newest.all(rule)
    };
    let alike = traffic.streams().filter(is_alike);
    alike.map(|stream| stream.id).collect()
}

/// What the identifier `id` counts among `others` that nobody explains, of which those in `alike`
/// fit the same rule, and `near` are within [`NEAR`]; `is_next`: one next to it is explained by the
/// same device.
pub(super) fn identifier(id: Id, others: usize, alike: &[u32], near: usize, is_next: bool) -> f64 {
    if is_next {
        return NEXT;
    }
    let one: f64 = match id {
        Id::Standard(0..0x20) => 6.0,
        Id::Standard(_) => 12.0,
        Id::Extended(_) => 20.0,
    };
    let chance = one - log2(others);
    let density = match alike {
        [first, .., last] if (*first..=*last).contains(&id.raw()) => {
            // In steps of what divides all distances.
            let gcd = |mut a: u32, mut b: u32| {
                while b != 0 {
                    (a, b) = (b, a % b);
                }
                a
            };
            let steps = alike.iter().copied().chain([id.raw()]);
            let step = steps.fold(0, |step, raw| gcd(step, raw.abs_diff(*first)));
            let places = (last - first).checked_div(step).unwrap_or(0) as usize + 1;
            log2(places) - log2(alike.len())
        }
        _ => f64::INFINITY,
    };
    let block = match near {
        0 => f64::INFINITY,
        _ => log2(2 * NEAR as usize) - log2(near) + log2(1 << BLOCK.saturating_sub(near)),
    };
    chance.min(density).min(block).max(0.0)
}
