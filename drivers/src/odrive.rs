//! The driver `odrive`: ODrive motor controllers. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/odrive.md")]

mod board;
mod device;
mod firmware;
mod frames;
mod options;
mod recognise;

pub use board::OdriveBoard;
pub use firmware::{Firmware, error_words};
pub use options::OdriveOptions;

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Axis;
use frames::{FET, JOINT, MOTOR, NODE_MOST};
use proprio_topics::Kind;

impl Driver for OdriveOptions {
    const NAME: &'static str = "odrive";

    fn outputs(&self) -> Vec<OutputInfo> {
        let temperature = OutputInfo::temperature;
        let joint = OutputInfo::new(JOINT, Kind::Joint);
        match self.firmware {
            Firmware::V0_5 => [joint].to_vec(),
            Firmware::V0_6 => {
                [joint, temperature(MOTOR, "motor"), temperature(FET, "fet")].to_vec()
            }
        }
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Axis::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(OdriveBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        (0..=NODE_MOST)
            .filter_map(|node| recognise::axis(seen, Self::NAME, node))
            .collect()
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        recognise::questions(seen)
    }
}
