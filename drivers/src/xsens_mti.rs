//! The driver `xsens_mti`: Xsens MTi. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/xsens_mti.md")]

mod board;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::MtiBoard;
pub use frames::{HighRate, Message};
pub use options::XsensMtiOptions;

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Mti;
use proprio_topics::Kind;

impl Driver for XsensMtiOptions {
    const NAME: &'static str = "xsens_mti";
    const ADDRESS: Option<u32> = Some(0);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Imu)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Mti::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(MtiBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let found = [false, true].map(|extended| recognise::sensor(seen, extended));
        found.into_iter().flatten().collect()
    }
}
