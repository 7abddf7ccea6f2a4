//! The unit's own side. It takes configurations and sends packets.

use super::options::OptoforceDaqOptions;
use super::protocol::{
    ANSWER, CONFIGURATION, DEFAULT_RATE, OVERLOAD_FX, OptoIds, PACKET, SENSOR_FAILURE, ZERO_HERE,
    period, sum,
};
use crate::{
    Board, EncodeError, Format, Frame, Frames, Mode, Simulate, Spec, SpecError, board, bytes,
};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading, Saturation};

/// The unit's own side.
#[derive(Debug)]
struct OptoBoard {
    ids: OptoIds,
    /// Steps per N.
    scale: [f64; 3],
    /// `None` while it is stopped.
    period: Option<Nanos>,
    counter: u16,
    /// The first frame of a configuration.
    first: Option<[u8; 8]>,
    /// What is subtracted, in steps, and whether the next load becomes it.
    zero: [i16; 3],
    zeroing: bool,
}

impl Simulate for OptoforceDaqOptions {
    /// A unit after power-on, which sends at once; in [`Mode::Listen`] another program has already
    /// configured it.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        let ids = self.ids(spec)?;
        let settings = self.settings()?.filter(|_| spec.mode == Mode::Listen);
        Ok(Box::new(OptoBoard {
            ids,
            scale: self.scale()?,
            period: Some(period(settings.map_or(DEFAULT_RATE, |s| s.speed))),
            counter: 0,
            first: None,
            zero: [0; 3],
            zeroing: false,
        }))
    }
}

impl Board for OptoBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        if frame.id != self.ids.config || frame.format != Format::Classic {
            return;
        }
        let Some(first) = self.first.take() else {
            let begins = |data: &[u8; 8]| data.starts_with(&CONFIGURATION);
            self.first = <[u8; 8]>::try_from(frame.data()).ok().filter(begins);
            return;
        };
        let ([a, b, c, d, speed, filter, zero, high], Some(low)) = (first, frame.data().first())
        else {
            return;
        };
        if sum(&[a, b, c, d, speed, filter, zero]) != u16::from_be_bytes([high, *low]) {
            return;
        }
        self.period = (speed > 0).then(|| period(speed));
        self.zeroing = zero == ZERO_HERE;
        self.zero = [0; 3];
        let [a, b, c, d] = ANSWER;
        let [high, low] = sum(&ANSWER).to_be_bytes();
        board::send(self.ids.data, &[a, b, c, d, 0, high, low], out);
    }

    fn period(&self) -> Option<Nanos> {
        self.period
    }

    /// The packet has no field for a torque.
    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let wrench = board::only_wrench(output, reading)?;
        board::finite(&wrench.force)?;
        let mut counts = [0; 3];
        for (count, (value, scale)) in counts.iter_mut().zip(wrench.force.iter().zip(self.scale)) {
            *count = bytes::quantise_i16(*value, 1.0 / scale);
        }
        if core::mem::take(&mut self.zeroing) {
            self.zero = counts;
        }
        for (count, zero) in counts.iter_mut().zip(self.zero) {
            *count = count.saturating_sub(zero);
        }
        let mut status = 0;
        for axis in 0..6 {
            let saturated = quality.saturation(axis) != Saturation::None;
            status |= u16::from(saturated) << (OVERLOAD_FX - axis);
        }
        if quality.contains(Quality::DEVICE_FAULT) {
            status |= SENSOR_FAILURE;
        }
        // A packet that repeats the last one is not counted.
        if !quality.contains(Quality::FROZEN) {
            self.counter = self.counter.wrapping_add(1);
        }
        let [a, b, c, d] = PACKET;
        let ([c0, c1], [s0, s1]) = (self.counter.to_be_bytes(), status.to_be_bytes());
        let first = [a, b, c, d, c0, c1, s0, s1];
        let [[a, b], [c, d], [e, f]] = counts.map(i16::to_be_bytes);
        let [high, low] = sum(&first)
            .wrapping_add(sum(&[a, b, c, d, e, f]))
            .to_be_bytes();
        for data in [first, [a, b, c, d, e, f, high, low]] {
            board::send(self.ids.data, &data, out);
        }
        Ok(())
    }
}
