//! The device's own side: a board that streams once it is told to.

use super::{HES0TO6, HES7TO14, IcubMaisOptions, SECOND, SENSORS};
use crate::icub::{self, class, command};
use crate::{Board, EncodeError, Frame, Frames, Mode, Simulate, Spec, SpecError, board, bytes};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading};

/// The board's own side. It sends a frame when all sensors of it that are joints are new.
#[derive(Debug)]
struct MaisBoard {
    address: u8,
    period: Nanos,
    streaming: bool,
    counts: [u8; SENSORS as usize],
    /// The joints, and those of them that are new, one bit each.
    joints: u16,
    fresh: u16,
}

impl Simulate for IcubMaisOptions {
    /// A board after power-on; in [`Mode::Listen`] another program has already started it.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        let period = icub::period(self.period_ms)?;
        Ok(Box::new(MaisBoard {
            address: icub::address(spec)?,
            period,
            streaming: spec.mode == Mode::Listen,
            counts: [0; SENSORS as usize],
            joints: spec
                .outputs
                .0
                .iter()
                .fold(0, |all, sensor| all | 1 << sensor),
            fresh: 0,
        }))
    }
}

impl Board for MaisBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let (class, board) = (class::POLLING_ANALOG, icub::board::MAIS);
        match icub::answer_management(frame, class, self.address, board, out) {
            Some(&[command::SET_CANDATARATE, ms]) if ms > 0 => {
                self.period = Nanos::from_millis(i64::from(ms));
            }
            Some(&[command::SET_TXMODE, mode]) => self.streaming = mode == 0,
            _ => {}
        }
    }

    fn period(&self) -> Option<Nanos> {
        self.streaming.then_some(self.period)
    }

    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        _quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let Reading::Joint(joint) = reading else {
            return Err(EncodeError::Kind);
        };
        board::finite(&[joint.position])?;
        let Some(count) = self.counts.get_mut(usize::from(output)) else {
            return Err(EncodeError::Output(output));
        };
        let quantised = bytes::quantise(joint.position, 1.0, 0, 255);
        *count = u8::try_from(quantised).unwrap_or(u8::MAX);
        self.fresh |= 1 << output;
        let (first, second) = self.counts.split_at(usize::from(SECOND));
        let lower: u16 = (1 << SECOND) - 1;
        for (kind, counts, mask) in [(HES0TO6, first, lower), (HES7TO14, second, !lower)] {
            let joints = self.joints & mask;
            let has_this = 1 << output & mask != 0;
            if has_this && self.fresh & joints == joints {
                self.fresh &= !mask;
                let id = icub::stream(class::PERIODIC_ANALOG, self.address, kind);
                board::send(id, counts, out);
            }
        }
        Ok(())
    }
}
