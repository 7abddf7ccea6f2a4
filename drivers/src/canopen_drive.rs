//! The driver `canopen_drive`: CANopen drives. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/canopen_drive.md")]

mod board;
mod device;
mod layout;
mod options;
mod start;

pub use board::DriveBoard;
pub use options::{CanopenDriveOptions, CurrentUnit, PdoKeys, VelocityUnit};

use crate::canopen::{self, Recognised};
use crate::objects::Objects;
use crate::recognise::{Finding, Key, Stream, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::format;
use alloc::vec::Vec;
use proprio_topics::Kind;

impl Driver for CanopenDriveOptions {
    const NAME: &'static str = "canopen_drive";

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Joint)].to_vec()
    }

    fn eds(&self) -> Option<&str> {
        self.eds.as_deref()
    }

    fn describe_objects(&mut self, objects: Objects) {
        self.objects = Some(objects);
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        device::Drive::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(DriveBoard::new(spec, self)?))
    }

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
