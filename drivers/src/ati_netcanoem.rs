//! The driver `ati_netcanoem`: ATI F/T sensors. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/ati_netcanoem.md")]

mod board;
mod calibration;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::NetcanoemBoard;
pub use frames::{ForceUnit, TorqueUnit};
pub use options::AtiNetcanoemOptions;

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use frames::BASE_MOST;
use proprio_topics::Kind;

impl Driver for AtiNetcanoemOptions {
    const NAME: &'static str = "ati_netcanoem";
    const ADDRESS: Option<u32> = Some(0x20);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        device::Netcanoem::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(NetcanoemBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        (0..=BASE_MOST)
            .filter_map(|base| recognise::sensor(seen, Self::NAME, base))
            .collect()
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        recognise::questions(seen)
    }

    const ASKED_BY_NAME: bool = true;
}
