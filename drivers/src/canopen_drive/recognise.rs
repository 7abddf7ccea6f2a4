//! Recognising drives by their profile, and nodes of other profiles, which no driver reads.

use super::CanopenDriveOptions;
use crate::canopen::{self, Recognised};
use crate::recognise::{Finding, Key, Stream, Traffic};
use crate::{Driver, Frame, Recognise};
use alloc::format;
use alloc::vec::Vec;

impl Recognise for CanopenDriveOptions {
    /// Nodes of other profiles too, which no driver reads.
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let find = |node: Recognised<'_>| {
            let (what, unusable) = match node.profile {
                Some(406) => return None,
                Some(402) => (format!("CANopen drive (CiA 402){}", node.identity), ""),
                None => (canopen::NO_PROFILE.into(), ""),
                Some(other) => {
                    let what = format!("CANopen node of profile {other}{}", node.identity);
                    (
                        what,
                        "no driver reads this profile; a .dbc file can describe it",
                    )
                }
            };
            let finding = (node.evidence).finding(Self::NAME, node.node.into(), what)?;
            // Its position is rather in the most frequent of them.
            let periods = node.tpdos.into_iter().flatten().filter_map(Stream::period);
            let finding = finding
                .with_keys(Key::period_ms(periods.min(), 1, 60_000))
                .with_joints([0])
                .with_commands(canopen::commands(node.node));
            Some(Finding {
                unusable,
                guess: node.profile.is_none(),
                needs_sync: node.needs_sync,
                ..finding
            })
        };
        canopen::recognise(seen).filter_map(find).collect()
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        canopen::questions(seen)
    }
}
