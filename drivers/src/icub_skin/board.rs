//! The device's own side: a board that streams once it is told to.

use super::{FIRST, IcubSkinOptions, SECOND, THERMAL};
use crate::icub::{self, class, command};
use crate::{Board, EncodeError, Frame, Frames, Id, Mode, Simulate, Spec, SpecError, board, bytes};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading};

/// The board's own side. It sends the triangles that it is asked to encode.
#[derive(Debug)]
struct SkinBoard {
    address: u8,
    period: Nanos,
    no_load: u8,
    triangles: [u8; 2],
    streaming: bool,
}

impl SkinBoard {
    fn byte(&self, taxel: f64) -> u8 {
        let raw = bytes::quantise(f64::from(self.no_load) - taxel, 1.0, 0, 255);
        u8::try_from(raw).unwrap_or(u8::MAX)
    }
}

impl Simulate for IcubSkinOptions {
    /// A board after power-on; in [`Mode::Listen`] another program has already started it.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        self.check()?;
        let period = icub::period(self.period_ms)?;
        Ok(Box::new(SkinBoard {
            address: icub::address(spec)?,
            period,
            no_load: self.no_load,
            triangles: self.triangles,
            streaming: spec.mode == Mode::Listen,
        }))
    }
}

impl Board for SkinBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let (class, board) = (class::POLLING_ANALOG, icub::board::MTB);
        match icub::answer_management(frame, class, self.address, board, out) {
            Some(&[command::SKIN_CONFIG, _, ms, no_load]) if ms > 0 => {
                self.period = Nanos::from_millis(i64::from(ms));
                self.no_load = no_load;
            }
            Some(&[command::SKIN_TRIANGLES, first, last, ..]) => self.triangles = [first, last],
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
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let Reading::Skin(skin) = reading else {
            return Err(EncodeError::Kind);
        };
        let [first, last] = self.triangles;
        let triangle = u8::try_from(skin.triangle).unwrap_or(u8::MAX);
        if output != 0 || !(first..=last).contains(&triangle) {
            return Err(EncodeError::Output(output));
        }
        let mut out_of_range = 0_u16;
        let mut bytes = [self.no_load; 12];
        for (number, (byte, taxel)) in bytes.iter_mut().zip(skin.taxels).enumerate() {
            if taxel.is_finite() {
                *byte = self.byte(taxel);
            } else if !THERMAL.contains(&number) {
                out_of_range |= 1 << number;
            }
        }
        let [p0, p1, p2, p3, p4, p5, p6, p7, p8, p9, p10, p11] = bytes;
        let [high, low] = (out_of_range << 4).to_be_bytes();
        let low = low | u8::from(quality.contains(Quality::DEVICE_FAULT));
        let id: Id = icub::stream(class::PERIODIC_SKIN, self.address, triangle);
        for data in [
            [FIRST, p0, p1, p2, p3, p4, p5, p6],
            [SECOND, p7, p8, p9, p10, p11, high, low],
        ] {
            board::send(id, &data, out);
        }
        Ok(())
    }
}
