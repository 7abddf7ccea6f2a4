//! Recognising a unit: by the beginning and the checksum of its packets, on any identifier.

use super::options::OptoforceDaqOptions;
use super::protocol::PACKET;
use crate::recognise::{Evidence, Finding, Key, Stream, Traffic};
use crate::{Driver, Format, Frame, Id, Recognise, bytes};
use alloc::vec::Vec;

impl Recognise for OptoforceDaqOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        seen.streams()
            .filter_map(|stream| unit(seen, stream))
            .collect()
    }
}

/// The unit that sends on `stream`, if it is one.
fn unit(seen: &Traffic, stream: &Stream) -> Option<Finding> {
    let Id::Standard(address) = stream.id else {
        return None;
    };
    let is_first =
        |frame: &Frame| frame.format == Format::Classic && frame.data().starts_with(&PACKET);
    let is_packet = |(first, second): (&Frame, &Frame)| {
        let all = first
            .data()
            .iter()
            .chain(second.data().get(..6).unwrap_or_default());
        let all = all.fold(0_u16, |sum, byte| sum.wrapping_add(u16::from(*byte)));
        let lengths = (first.len(), second.len()) == (8, 8);
        lengths && all == bytes::u16_be(second.data(), 6)
    };
    let pairs = || stream.recent().zip(stream.recent().skip(1));
    let begun = pairs().filter(|(first, _)| is_first(first)).count();
    let whole = pairs()
        .filter(|pair| is_first(pair.0) && is_packet(*pair))
        .count();
    // A lost frame breaks a packet.
    if whole == 0 || whole * 10 < begun * 9 {
        return None;
    }
    let mut evidence = Evidence::new(seen, 1 << 11);
    // Four bytes and a checksum.
    evidence.explains(stream.id, 48.0);
    let finding = evidence.finding(
        OptoforceDaqOptions::NAME,
        address.into(),
        "OptoForce sensor at a DAQ",
    )?;
    let scale = "[1.0, 1.0, 1.0]";
    let note = "from the sensor's sensitivity report";
    // Not its rate: with that key each start would change the zero.
    Some(finding.with_keys([Key::fill_in("counts_per_newton", scale, note)]))
}
