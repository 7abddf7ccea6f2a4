//! The device's own side: a board that streams once it is told to.

use super::{IcubPosOptions, LABEL_MOST, POS, PosQuantity};
use crate::icub::{self, class, command};
use crate::{Board, EncodeError, Frame, Frames, Mode, Simulate, Spec, SpecError, board, bytes};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading};

/// The board's own side. It sends each value in a separate frame (n = 1), which the protocol
/// allows.
#[derive(Debug)]
struct PosBoard {
    address: u8,
    period: Nanos,
    streaming: bool,
    quantity: PosQuantity,
    /// The configuration received, in the form of POS_CONFIG_SET.
    configuration: [u8; 8],
}

impl Simulate for IcubPosOptions {
    /// A board after power-on; in [`Mode::Listen`] another program has already started it.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        self.configuration()?;
        let period = icub::period(self.period_ms)?;
        Ok(Box::new(PosBoard {
            address: icub::address(spec)?,
            period,
            streaming: spec.mode == Mode::Listen,
            quantity: self.quantity,
            configuration: [0; 8],
        }))
    }
}

impl Board for PosBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let (class, board) = (class::POLLING_ANALOG, icub::board::PSC);
        match icub::answer_management(frame, class, self.address, board, out) {
            Some(&[command::POS_CONFIG_SET, a, b, c, d, e, f, g]) => {
                // As in the firmware, a new configuration stops the stream.
                self.streaming = false;
                self.configuration = [command::POS_CONFIG_SET, a, b, c, d, e, f, g];
            }
            Some(&[command::POS_CONFIG_GET, kind]) => {
                let [_, _, sensors @ ..] = self.configuration;
                let [b, c, d, e, f, g] = sensors;
                let id = icub::to_host(class::POLLING_ANALOG, self.address);
                let answer = [command::POS_CONFIG_GET, kind, b, c, d, e, f, g];
                board::send(id, &answer, out);
            }
            Some(&[command::POS_TRANSMIT, ms]) => {
                self.streaming = ms > 0;
                self.period = Nanos::from_millis(i64::from(ms));
            }
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
        if output > LABEL_MOST {
            return Err(EncodeError::Output(output));
        }
        board::finite(&[joint.position])?;
        let (code, lsb) = self.quantity.code_and_lsb();
        let [low, high] = bytes::quantise_i16(joint.position, lsb).to_le_bytes();
        let id = icub::stream(class::PERIODIC_ANALOG, self.address, POS);
        board::send(id, &[code, output << 4 | 1, low, high, 0, 0, 0, 0], out);
        Ok(())
    }
}
