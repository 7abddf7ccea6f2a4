//! The driver `jr3_can`: JR3 force/torque sensors. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/jr3_can.md")]

mod board;
mod device;
mod options;
mod protocol;
mod recognise;
mod scales;

pub use board::Jr3Board;
pub use options::Jr3CanOptions;

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Jr3;
use proprio_topics::Kind;

impl Driver for Jr3CanOptions {
    const NAME: &'static str = "jr3_can";
    const ADDRESS: Option<u32> = Some(1);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Jr3::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(Jr3Board::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        (1..=0x7F)
            .filter_map(|node| recognise::board(seen, Self::NAME, node))
            .collect()
    }

    fn questions(_seen: &Traffic) -> Vec<Frame> {
        recognise::questions()
    }

    const ASKED_BY_NAME: bool = true;
}
