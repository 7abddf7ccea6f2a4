//! Recognising encoders by their profile, or by the only number that they send.

use super::CanopenEncoderOptions;
use crate::canopen::{self, Recognised};
use crate::recognise::{Finding, Key, Stream, Traffic};
use crate::{Driver, Frame, Recognise};
use alloc::format;
use alloc::vec::Vec;

impl Recognise for CanopenEncoderOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let find = |node: Recognised<'_>| {
            let [first, others @ ..] = node.tpdos;
            let mut evidence = node.evidence;
            let what = match node.profile {
                Some(406) => format!("CANopen encoder (CiA 406){}", node.identity),
                Some(_) => return None,
                None => {
                    // Four bytes in one TPDO are rather a position than a drive's status.
                    let is_position = first.is_some_and(|stream| stream.lengths == (4, 4));
                    let alone = others.iter().all(Option::is_none);
                    evidence.add(if is_position && alone { 2.0 } else { -2.0 });
                    canopen::NO_PROFILE.into()
                }
            };
            let finding = Finding {
                guess: node.profile.is_none(),
                ..evidence.finding(Self::NAME, node.node.into(), what)?
            };
            let period = Key::period_ms(first.and_then(Stream::period), 1, 65_535);
            let commands = canopen::commands(node.node);
            let finding = finding.with_keys(period).with_joints([0]);
            Some(finding.with_commands(commands))
        };
        canopen::recognise(seen).filter_map(find).collect()
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        canopen::questions(seen)
    }
}
