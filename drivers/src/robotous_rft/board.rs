//! The sensor's own side.

use super::options::{RftModel, RobotousRftOptions};
use super::protocol::{DEFAULT_RATE, OVERLOAD_FX, RATES, RftIds, SET, command, period};
use crate::{
    Board, EncodeError, Format, Frame, Frames, Mode, Simulate, Spec, SpecError, board, bytes,
};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading, Saturation};

/// In the answer to SET_RATE: done; and the error for a code out of range.
const DONE: u8 = 1;
const RANGE_ERROR: u8 = 2;

/// The sensor's own side.
#[derive(Debug)]
struct RftBoard {
    ids: RftIds,
    name: &'static str,
    divisors: [f64; 6],
    rate_code: u8,
    period: Nanos,
    streaming: bool,
    /// What is subtracted, in steps, and whether the next load becomes it; lost with the power.
    zero: [i16; 6],
    zeroing: bool,
}

impl RftBoard {
    /// Returns whether there is such a rate.
    fn set_rate(&mut self, code: u8) -> bool {
        let meant = if code == 0 { DEFAULT_RATE } else { code };
        let Some((hz, _)) = RATES.iter().find(|(_, code)| *code == meant) else {
            return false;
        };
        self.period = period(*hz);
        self.rate_code = code;
        true
    }

    /// Answers with a text, in both frames.
    fn tell(&self, command: u8, text: &str, out: &mut Frames) {
        let mut bytes = [0; 16];
        let text = core::iter::once(command).chain(text.bytes());
        for (to, from) in bytes.iter_mut().zip(text) {
            *to = from;
        }
        let (first, second) = bytes.split_at(8);
        board::send(self.ids.first, first, out);
        board::send(self.ids.second, second, out);
    }

    fn answer(&self, bytes: [u8; 3], out: &mut Frames) {
        let [a, b, c] = bytes;
        board::send(self.ids.first, &[a, b, c, 0, 0, 0, 0, 0], out);
        board::send(self.ids.second, &[0; 8], out);
    }
}

impl Simulate for RobotousRftOptions {
    /// A new sensor after power-on; in [`Mode::Listen`] another program has already set its rate
    /// and started it.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        let rate_code = self.rate_code()?;
        let mut this = RftBoard {
            ids: self.ids(spec)?,
            name: (RftModel::NAMES.get(self.model as usize).copied()).unwrap_or_default(),
            divisors: self.model.divisors(),
            rate_code,
            period: period(self.rate_hz),
            streaming: spec.mode == Mode::Listen,
            zero: [0; 6],
            zeroing: false,
        };
        if !this.streaming {
            this.set_rate(DEFAULT_RATE);
        }
        Ok(Box::new(this))
    }
}

impl Board for RftBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        if frame.id != self.ids.command || frame.format != Format::Classic {
            return;
        }
        match *frame.data() {
            [command::STOP, ..] => self.streaming = false,
            [command::BIAS, SET, ..] => self.zeroing = true,
            [command::BIAS, 0, ..] => self.zero = [0; 6],
            _ if self.streaming => {}
            [command::START, ..] => self.streaming = true,
            [command::NAME, ..] => self.tell(command::NAME, self.name, out),
            [command::SERIAL, ..] => self.tell(command::SERIAL, "RFT-SIMULATED", out),
            [command::GET_RATE, ..] => self.answer([command::GET_RATE, self.rate_code, 0], out),
            [command::SET_RATE, code, ..] => {
                let answer = match self.set_rate(code) {
                    true => [command::SET_RATE, DONE, 0],
                    false => [command::SET_RATE, 0, RANGE_ERROR],
                };
                self.answer(answer, out);
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
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let values = board::axes(board::only_wrench(output, reading)?)?;
        let mut counts = [0; 6];
        let mut overload = 0;
        let axes = values.into_iter().zip(self.divisors);
        for (axis, (count, (value, divisor))) in (0..).zip(counts.iter_mut().zip(axes)) {
            *count = bytes::quantise_i16(value, 1.0 / divisor);
            let is_at_end = [i16::MIN, i16::MAX].contains(count);
            if is_at_end || quality.saturation(axis) != Saturation::None {
                overload |= 1 << (OVERLOAD_FX - axis);
            }
        }
        if core::mem::take(&mut self.zeroing) {
            self.zero = counts;
        }
        for (count, zero) in counts.iter_mut().zip(self.zero) {
            *count = count.saturating_sub(zero);
        }
        let [[a, b], [c, d], [e, f], [g, h], [i, j], [k, l]] = counts.map(i16::to_be_bytes);
        for (id, data) in [
            (self.ids.first, [command::START, a, b, c, d, e, f, g]),
            (self.ids.second, [h, i, j, k, l, overload, 0, 0]),
        ] {
            board::send(id, &data, out);
        }
        Ok(())
    }
}
