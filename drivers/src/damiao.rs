//! The driver `damiao`: Damiao actuators. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/damiao.md")]

mod board;
mod device;
mod frames;
mod options;
mod ranges;
mod recognise;

pub use board::DamiaoBoard;
pub use options::{DamiaoOptions, Model};

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Motor;
use frames::{FET, JOINT, MOTOR};
use proprio_topics::Kind;

impl Driver for DamiaoOptions {
    const NAME: &'static str = "damiao";

    fn needs_fd(&self) -> bool {
        self.fd
    }

    fn outputs(&self) -> Vec<OutputInfo> {
        let temperature = OutputInfo::temperature;
        let joint = OutputInfo::new(JOINT, Kind::Joint);
        [joint, temperature(MOTOR, "motor"), temperature(FET, "fet")].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Motor::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(DamiaoBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        recognise::motors(seen)
    }

    fn questions(_seen: &Traffic) -> Vec<Frame> {
        recognise::questions()
    }
}
