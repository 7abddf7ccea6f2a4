//! The driver `optoforce_daq`: OptoForce force sensors. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/optoforce_daq.md")]

mod board;
mod device;
mod options;
mod protocol;
mod recognise;

pub use board::OptoBoard;
pub use options::OptoforceDaqOptions;

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Opto;
use proprio_topics::Kind;

impl Driver for OptoforceDaqOptions {
    const NAME: &'static str = "optoforce_daq";
    const ADDRESS: Option<u32> = Some(0x100);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Opto::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(OptoBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        seen.streams()
            .filter_map(|stream| recognise::unit(seen, stream))
            .collect()
    }
}
