//! The device's own side: there is none.

use super::CanopenSyncOptions;
use crate::{Board, EncodeError, Frames, Simulate, Spec, SpecError};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading};

/// There is nothing at the other end.
#[derive(Debug)]
struct Nothing;

impl Simulate for CanopenSyncOptions {
    fn board(&self, _spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(Nothing))
    }
}

impl Board for Nothing {
    fn period(&self) -> Option<Nanos> {
        None
    }

    fn encode(
        &mut self,
        output: u8,
        _reading: &Reading,
        _quality: Quality,
        _out: &mut Frames,
    ) -> Result<(), EncodeError> {
        Err(EncodeError::Output(output))
    }
}
