//! The device's own side: a board that streams at once.

use super::{
    AMPERE_PER_LSB, DUTY_PER_LSB, IcubMotorOptions, RAD_PER_LSB, RAD_PER_S_PER_LSB, encoder, fault,
    kind, quality_of,
};
use crate::icub::{self, class};
use crate::{Board, EncodeError, Frame, Frames, Simulate, Spec, SpecError, board, bytes};
use alloc::boxed::Box;
use proprio_topics::{Actuator, Nanos, Quality, Reading};

/// The board's own side: it streams without commands, as if it were commanded once a period.
#[derive(Debug)]
struct MotorBoard {
    address: u8,
    period: Nanos,
    velocity: bool,
    /// The quality in its last status.
    status: Quality,
}

impl MotorBoard {
    fn send_status(&mut self, actuator: &Actuator, out: &mut Frames) -> Result<(), EncodeError> {
        board::finite(&[actuator.duty])?;
        #[allow(clippy::cast_possible_truncation)] // both are bytes on the wire
        let (mode, encoder) = (actuator.mode as u8, actuator.encoder as u8);
        #[allow(clippy::cast_possible_truncation)] // limited to 16 bits
        let [d0, d1] =
            (bytes::quantise(actuator.duty, DUTY_PER_LSB, -32000, 32000) as i16).to_le_bytes();
        let [f0, f1, f2, f3] = actuator.faults.to_le_bytes();
        let id = icub::stream(class::PERIODIC_MOTOR, self.address, kind::STATUS);
        board::send(id, &[mode, encoder, d0, d1, f0, f1, f2, f3], out);
        self.status = quality_of(actuator);
        Ok(())
    }
}

impl Simulate for IcubMotorOptions {
    /// A board that streams at once.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        let period = icub::period(self.period_ms)?;
        Ok(Box::new(MotorBoard {
            address: icub::address(spec)?,
            period,
            velocity: self.velocity,
            status: Quality::GOOD,
        }))
    }
}

impl Board for MotorBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        icub::answer_management(
            frame,
            class::POLLING_MOTOR,
            self.address,
            icub::board::TWO_FOC,
            out,
        );
    }

    fn period(&self) -> Option<Nanos> {
        Some(self.period)
    }

    /// If the faults differ from the last status, a status frame precedes the joint reading. The
    /// frame has no field for torque and acceleration; an absent current is sent as 0.
    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        board::only_output(output)?;
        match reading {
            Reading::Joint(joint) => {
                let velocity = if self.velocity { joint.velocity } else { 0.0 };
                board::finite(&[joint.position, velocity])?;
                let carried =
                    Quality::DEVICE_FAULT | Quality::DRIVE_FAULT | Quality::NOT_CALIBRATED;
                if self.status.0 & carried.0 != quality.0 & carried.0 {
                    let mut actuator = Actuator {
                        duty: 0.0,
                        mode: 6,
                        encoder: 0,
                        faults: 0,
                    };
                    if quality.contains(Quality::DEVICE_FAULT) {
                        actuator.faults |= fault::ENCODER;
                    }
                    if quality.contains(Quality::DRIVE_FAULT) {
                        actuator.faults |= fault::EXTERNAL;
                    }
                    if quality.contains(Quality::NOT_CALIBRATED) {
                        actuator.encoder = encoder::NOT_CALIBRATED;
                    }
                    self.send_status(&actuator, out)?;
                }
                let current = if joint.current.is_finite() {
                    joint.current
                } else {
                    0.0
                };
                let [c0, c1] = bytes::quantise_i16(current, AMPERE_PER_LSB).to_le_bytes();
                let [v0, v1] = bytes::quantise_i16(velocity, RAD_PER_S_PER_LSB).to_le_bytes();
                let position = bytes::quantise(
                    joint.position,
                    RAD_PER_LSB,
                    i64::from(i32::MIN),
                    i64::from(i32::MAX),
                );
                #[allow(clippy::cast_possible_truncation)] // limited to 32 bits
                let [p0, p1, p2, p3] = (position as i32).to_le_bytes();
                let id = icub::stream(class::PERIODIC_MOTOR, self.address, kind::TWO_FOC);
                board::send(id, &[c0, c1, v0, v1, p0, p1, p2, p3], out);
                Ok(())
            }
            Reading::Actuator(actuator) => self.send_status(actuator, out),
            _ => Err(EncodeError::Kind),
        }
    }
}
