//! The driver `myactuator`: MyActuator RMD actuators. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/myactuator.md")]

mod board;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::MyactuatorBoard;
pub use frames::Protocol;
pub use options::{MyactuatorOptions, Position};

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Motor;
use frames::{JOINT, MOTOR};
use proprio_topics::Kind;

impl Driver for MyactuatorOptions {
    const NAME: &'static str = "myactuator";
    const ASKED_BY_NAME: bool = true;

    fn outputs(&self) -> Vec<OutputInfo> {
        let motor = OutputInfo::temperature(MOTOR, "motor");
        [OutputInfo::new(JOINT, Kind::Joint), motor].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Motor::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(MyactuatorBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        recognise::motors(seen)
    }

    fn questions(_seen: &Traffic) -> Vec<Frame> {
        recognise::questions()
    }
}
