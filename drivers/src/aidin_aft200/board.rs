//! The device's own side: a sensor that streams once it is told to.

use super::{AidinAft200Options, COMMAND, CONTINUOUSLY, NEWTON, NEWTON_METRE, command, number};
use crate::{
    Board, EncodeError, Format, Frame, Frames, Id, Mode, Simulate, Spec, SpecError, board, bytes,
};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading, Saturation};

/// The sensor's own side.
#[derive(Debug)]
struct AftBoard {
    number: u8,
    ids: [Id; 2],
    period: Nanos,
    streaming: bool,
}

impl Simulate for AidinAft200Options {
    /// A sensor after power-on; in [`Mode::Listen`] another program has already started it.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(AftBoard {
            number: number(spec)?,
            ids: self.ids()?,
            period: self.period()?,
            streaming: spec.mode == Mode::Listen,
        }))
    }
}

impl Board for AftBoard {
    fn on_frame(&mut self, frame: &Frame, _out: &mut Frames) {
        if frame.id != COMMAND || frame.format != Format::Classic {
            return;
        }
        match *frame.data() {
            [number, ..] if number != self.number => {}
            [_, command::PERIOD, high, low, ..] if (high, low) != (0, 0) => {
                self.period = Nanos::from_micros(i64::from(u16::from_be_bytes([high, low])));
            }
            [_, command::TRANSMIT, CONTINUOUSLY, ..] => self.streaming = true,
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
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let wrench = board::only_wrench(output, reading)?;
        let [force, torque] = self.ids;
        let halves = [
            (force, wrench.force, NEWTON, 0),
            (torque, wrench.torque, NEWTON_METRE, 3),
        ];
        board::axes(wrench)?;
        for (id, values, (step, least), first) in halves {
            let mut data = [0; 6];
            for (axis, (to, value)) in (first..).zip(data.chunks_exact_mut(2).zip(values)) {
                let count = match quality.saturation(axis) {
                    Saturation::None => {
                        let count = bytes::quantise(value - least, step, 0, u16::MAX.into());
                        u16::try_from(count).unwrap_or(u16::MAX)
                    }
                    Saturation::Low => 0,
                    Saturation::High => u16::MAX,
                };
                to.copy_from_slice(&count.to_be_bytes());
            }
            board::send(id, &data, out);
        }
        Ok(())
    }
}
