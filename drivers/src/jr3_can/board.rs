//! The board's own side. It reports its full scales, executes the host's commands, and sends
//! readings as frames.

use super::options::Jr3CanOptions;
use super::protocol::{NEWTON_METRE_PER_LSB, READY, SAMPLE, STEPS, id, node, op, op_of};
use crate::{
    Board, EncodeError, Format, Frame, Frames, Mode, Simulate, Spec, SpecError, board, bytes,
};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading, Saturation};

/// The full scales of a sensor of the firmware's authors \[N, Nm\]: those of a simulated one.
const USUAL_FULL_SCALE: [f64; 6] = [115.0, 111.0, 185.0, 5.6, 5.2, 6.1];

/// The board's own side.
#[derive(Debug)]
struct Jr3Board {
    node: u16,
    full_scale: [f64; 6],
    period: Nanos,
    streaming: bool,
    /// The time that its sensor has run.
    elapsed: Nanos,
    /// What is subtracted, in steps, and whether the next load becomes it.
    zero: [i16; 6],
    zeroing: bool,
}

impl Jr3Board {
    fn acknowledge(&self, scales: &[(f64, f64)], out: &mut Frames) {
        let mut data = [READY; 7];
        let (_, to) = data.split_at_mut(1);
        for (to, (scale, lsb)) in to.chunks_exact_mut(2).zip(scales) {
            let count = bytes::quantise(*scale, *lsb, 0, u16::MAX.into());
            to.copy_from_slice(&u16::try_from(count).unwrap_or(u16::MAX).to_le_bytes());
        }
        let length = 1 + 2 * scales.len();
        let id = id(op::ACKNOWLEDGE, self.node);
        board::send(id, data.get(..length).unwrap_or(&data), out);
    }
}

impl Simulate for Jr3CanOptions {
    /// A board after power-on; in [`Mode::Listen`] another program has already started it.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        self.cutoff()?;
        Ok(Box::new(Jr3Board {
            node: node(spec)?,
            full_scale: self.full_scale()?.unwrap_or(USUAL_FULL_SCALE),
            period: self.period()?,
            streaming: spec.mode == Mode::Listen,
            elapsed: Nanos::ZERO,
            zero: [0; 6],
            zeroing: false,
        }))
    }
}

impl Board for Jr3Board {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let Some(op) = op_of(frame.id, self.node).filter(|_| frame.format == Format::Classic)
        else {
            return;
        };
        let [fx, fy, fz, mx, my, mz] = self.full_scale;
        match (op, frame.data()) {
            (op::GET_FORCE_SCALES, _) => {
                self.acknowledge(&[fx, fy, fz].map(|scale| (scale, 1.0)), out);
            }
            (op::GET_MOMENT_SCALES, _) => {
                let scales = [mx, my, mz].map(|scale| (scale, NEWTON_METRE_PER_LSB));
                self.acknowledge(&scales, out);
            }
            (op::START, &[_, _, ref period @ ..]) => {
                let us = bytes::u32_le(period, 0);
                if us > 0 {
                    self.period = Nanos::from_micros(i64::from(us));
                }
                self.streaming = true;
                self.zeroing = true;
                self.acknowledge(&[], out);
            }
            (op::STOP, _) => {
                self.streaming = false;
                self.acknowledge(&[], out);
            }
            (op::ZERO, _) => {
                self.zeroing = true;
                self.acknowledge(&[], out);
            }
            (op::GET_STATE, _) => self.acknowledge(&[], out),
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
        for (count, (value, full_scale)) in counts
            .iter_mut()
            .zip(values.into_iter().zip(self.full_scale))
        {
            *count = bytes::quantise_i16(value, full_scale / STEPS);
        }
        if core::mem::take(&mut self.zeroing) {
            self.zero = counts;
        }
        for (axis, (count, zero)) in (0..).zip(counts.iter_mut().zip(self.zero)) {
            *count = match quality.saturation(axis) {
                Saturation::None => count.saturating_sub(zero),
                Saturation::Low => i16::MIN,
                Saturation::High => i16::MAX,
            };
        }
        // A reading that repeats the last one is none of a new sample.
        if !quality.contains(Quality::FROZEN) {
            self.elapsed += self.period;
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // it wraps
        let [low, high] = ((self.elapsed.0 / SAMPLE.0) as u16).to_le_bytes();
        let [[a, b], [c, d], [e, f], [g, h], [i, j], [k, l]] = counts.map(i16::to_le_bytes);
        for (op, [a, b, c, d, e, f]) in [
            (op::FORCE, [a, b, c, d, e, f]),
            (op::MOMENT, [g, h, i, j, k, l]),
        ] {
            let data = [a, b, c, d, e, f, low, high];
            board::send(id(op, self.node), &data, out);
        }
        Ok(())
    }
}
