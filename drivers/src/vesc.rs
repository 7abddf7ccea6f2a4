//! The driver `vesc`: VESC motor controllers. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/vesc.md")]

mod board;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::VescBoard;
pub use options::{Position, VescOptions};

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Controller;
use frames::{FET, JOINT, MOTOR};
use proprio_topics::Kind;

impl Driver for VescOptions {
    const NAME: &'static str = "vesc";

    fn outputs(&self) -> Vec<OutputInfo> {
        let temperature = OutputInfo::temperature;
        let joint = OutputInfo::new(JOINT, Kind::Joint);
        [joint, temperature(MOTOR, "motor"), temperature(FET, "fet")].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Controller::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(VescBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        recognise::controllers(seen)
    }
}
