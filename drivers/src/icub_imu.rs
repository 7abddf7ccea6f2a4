//! The driver `icub_imu`: iCub IMUs. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/icub_imu.md")]

mod board;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::ImuBoard;
pub use frames::{Fusion, Legacy, Quantity};
pub use options::IcubImuOptions;

use crate::icub;
use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::ImuDevice;
use proprio_topics::Kind;

impl Driver for IcubImuOptions {
    const NAME: &'static str = "icub_imu";

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Imu)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        ImuDevice::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(ImuBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        recognise::boards(seen, Self::NAME)
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}
