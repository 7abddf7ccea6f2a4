//! The driver `openimu`: Aceinna OpenIMU and MTLT. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/openimu.md")]

mod board;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::OpenImuBoard;
pub use frames::{Axes, Quantity, Upright};
pub use options::OpenImuOptions;

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Sensor;
use frames::{ADDRESSES, DELIVERED};
use proprio_topics::Kind;

impl Driver for OpenImuOptions {
    const NAME: &'static str = "openimu";
    const ADDRESS: Option<u32> = Some(DELIVERED);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Imu)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Sensor::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(OpenImuBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        ADDRESSES
            .filter_map(|address| recognise::sensor(seen, address))
            .collect()
    }
}
