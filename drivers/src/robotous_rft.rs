//! The driver `robotous_rft`: Robotous RFT force/torque sensors.
//! What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/robotous_rft.md")]

mod board;
mod device;
mod options;
mod protocol;
mod recognise;

pub use board::RftBoard;
pub use options::{Model, RobotousRftOptions};

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Rft;
use proprio_topics::Kind;

impl Driver for RobotousRftOptions {
    const NAME: &'static str = "robotous_rft";
    const ADDRESS: Option<u32> = Some(0x64);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Rft::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(RftBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        recognise::sensor(seen).into_iter().collect()
    }

    fn questions(_seen: &Traffic) -> Vec<Frame> {
        recognise::questions()
    }

    const ASKED_BY_NAME: bool = true;
}
