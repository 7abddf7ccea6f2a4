//! The driver `cubemars`: CubeMars actuators. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/cubemars.md")]

mod board;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::CubemarsBoard;
pub use options::{Angle, CubemarsOptions, Effort, Mode, Model};

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Motor;
use frames::{DRIVE, JOINT};
use proprio_topics::Kind;

impl Driver for CubemarsOptions {
    const NAME: &'static str = "cubemars";

    fn outputs(&self) -> Vec<OutputInfo> {
        let drive = OutputInfo::temperature(DRIVE, "drive");
        [OutputInfo::new(JOINT, Kind::Joint), drive].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Motor::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(CubemarsBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        recognise::motors(seen)
    }
}
