//! The driver `dbc`: Devices that a .dbc file describes. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/dbc.md")]

mod board;
mod device;
mod layout;
mod options;

pub use board::DbcBoard;
pub use options::{DbcOptions, ReadingKeys};

use crate::signal::Message;
use crate::{Board, Device, Driver, OutputInfo, Spec, SpecError};
use alloc::borrow::Cow;
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::DbcDevice;

impl Driver for DbcOptions {
    const NAME: &'static str = "dbc";
    const ADDRESS: Option<u32> = Some(0);

    fn outputs(&self) -> Vec<OutputInfo> {
        let info = |(number, reading): (u8, &ReadingKeys)| OutputInfo {
            number,
            kind: reading.kind,
            suffix: Cow::Owned(reading.name.clone()),
        };
        (0..).zip(&self.reading).map(info).collect()
    }

    fn states_period(&self) -> bool {
        self.period_ms.is_some()
    }

    fn description(&self) -> Option<&str> {
        Some(&self.file)
    }

    fn describe(&mut self, messages: Vec<Message>) {
        self.messages = messages;
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        DbcDevice::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(DbcBoard::new(spec, self)?))
    }
}
