//! The sensor's own side.

use super::frames::{ACCELERATION_LSB, MtiMessage, RATE_LSB, status};
use super::options::{MtiKeys, XsensMtiOptions};
use crate::{Board, EncodeError, Frame, Frames, Simulate, Spec, SpecError, board, bytes};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading, Saturation};

/// The sensor's own side. It streams from power-on, as it was configured over its serial port.
#[derive(Debug)]
struct MtiBoard {
    plan: MtiKeys,
    /// The sensor's clock at the next sample.
    clock: Nanos,
    counter: u16,
}

impl MtiBoard {
    /// The status word of a sample with `quality`.
    fn status(quality: Quality) -> u32 {
        let mut word = status::SELF_TEST | status::FILTER_VALID;
        if quality.contains(Quality::DEVICE_FAULT) {
            word &= !status::SELF_TEST;
        }
        if quality.contains(Quality::SATURATED) {
            word |= status::CLIPPED;
        }
        for axis in 0..6 {
            if quality.saturation(axis) != Saturation::None {
                word |= 1 << (status::FIRST_AXIS + axis);
            }
        }
        word
    }
}

impl Simulate for XsensMtiOptions {
    /// A sensor that streams at once.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(MtiBoard {
            plan: MtiKeys::new(spec, self)?,
            clock: Nanos::ZERO,
            counter: 0,
        }))
    }
}

impl Board for MtiBoard {
    fn period(&self) -> Option<Nanos> {
        Some(self.plan.period)
    }

    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let imu = board::only_imu(output, reading)?;
        let mut sent = Frames::new();
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // it overflows
        let ticks = (self.clock.0 / self.plan.tick.0) as u32;
        for &(id, message) in &self.plan.messages {
            let (values, lsb): (&[f64], f64) = match message {
                MtiMessage::Orientation => (&imu.orientation, self.plan.quaternion_lsb),
                MtiMessage::AngularVelocity => (&imu.angular_velocity, RATE_LSB),
                MtiMessage::Acceleration => (&imu.proper_acceleration, ACCELERATION_LSB),
                MtiMessage::MagneticField => (&imu.magnetic_field, self.plan.field_lsb),
                _ => (&[], 1.0),
            };
            board::finite(values)?;
            let mut counts = [[0; 2]; 4];
            for (count, value) in counts.iter_mut().zip(values) {
                *count = bytes::quantise_i16(*value, lsb).to_be_bytes();
            }
            let frame = match message {
                MtiMessage::SampleTime => Frame::new(id, &ticks.to_be_bytes()),
                MtiMessage::GroupCounter => Frame::new(id, &self.counter.to_be_bytes()),
                MtiMessage::Status => Frame::new(id, &Self::status(quality).to_be_bytes()),
                _ => Frame::new(
                    id,
                    counts.as_flattened().get(..message.length()).unwrap_or(&[]),
                ),
            };
            let _ = sent.try_push(frame);
        }
        self.clock += self.plan.period;
        self.counter = self.counter.wrapping_add(1);
        for frame in sent {
            let _ = out.try_push(frame);
        }
        Ok(())
    }
}
