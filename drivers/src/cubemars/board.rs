//! The device's own side: a motor that sends its state as if it were commanded once a period.

use super::frames::{DRIVE, ENCODER_ERROR, JOINT, Stage, quality_of};
use super::options::{CubemarsKeys, CubemarsOptions, Effort};
use crate::{Board, EncodeError, Frame, Frames, Simulate, Spec, SpecError, board};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading};

/// The error that stands for any fault of the drive.
const OVER_CURRENT: u8 = 2;

/// A simulated motor. It streams without commands.
#[derive(Debug)]
struct CubemarsBoard {
    keys: CubemarsKeys,
    stage: Stage,
}

impl Simulate for CubemarsOptions {
    /// A motor at 25 degrees Celsius.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(CubemarsBoard {
            keys: CubemarsKeys::new(spec, self)?,
            stage: Stage {
                celsius: 25.0,
                error: 0,
            },
        }))
    }
}

impl Board for CubemarsBoard {
    fn on_frame(&mut self, _frame: &Frame, _out: &mut Frames) {}

    fn period(&self) -> Option<Nanos> {
        Some(self.keys.period)
    }

    /// Temperature and error are sent with the next joint reading. An absent torque or current is
    /// sent as 0.
    #[allow(clippy::cast_possible_truncation)] // the error is a byte on the wire
    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        match (output, reading) {
            (JOINT, Reading::Joint(joint)) => {
                let torque_constant = self.keys.torque_constant.unwrap_or(f64::NAN);
                let effort = match self.keys.effort {
                    Effort::Torque => joint.torque,
                    Effort::Current if joint.current.is_nan() => joint.torque / torque_constant,
                    Effort::Current => joint.current,
                };
                let effort = if effort.is_nan() { 0.0 } else { effort };
                let values = [joint.position, joint.velocity, effort];
                board::finite(&values)?;
                let carried = Quality::DEVICE_FAULT | Quality::DRIVE_FAULT;
                if quality_of(self.stage.error).0 != quality.0 & carried.0 {
                    self.stage.error = if quality.contains(Quality::DEVICE_FAULT) {
                        ENCODER_ERROR
                    } else if quality.contains(Quality::DRIVE_FAULT) {
                        OVER_CURRENT
                    } else {
                        0
                    };
                }
                let [p, v, e] = self.keys.scales;
                let [position, velocity, effort] = values;
                let raw = [p.raw(position), v.raw(velocity), e.raw(effort)];
                let data = (self.keys.layout).pack(self.keys.number, raw, self.stage);
                let _ = out.try_push(Frame::new(self.keys.id, &data));
                Ok(())
            }
            (JOINT, Reading::Actuator(actuator)) => {
                self.stage.error = actuator.faults as u8;
                Ok(())
            }
            (DRIVE, Reading::Temperature(temperature)) if temperature.celsius.is_finite() => {
                self.stage.celsius = temperature.celsius;
                Ok(())
            }
            (DRIVE, Reading::Temperature(_)) => Err(EncodeError::NotFinite),
            (JOINT | DRIVE, _) => Err(EncodeError::Kind),
            _ => Err(EncodeError::Output(output)),
        }
    }
}
