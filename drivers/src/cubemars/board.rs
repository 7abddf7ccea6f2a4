//! The device's own side: a motor that sends its state as if it were commanded once a period.

use super::frames::{DRIVE, ENCODER_ERROR, JOINT, Stage, quality_of};
use super::options::{CubemarsKeys, CubemarsOptions, Effort};
use crate::{Board, EncodeError, Frames, Simulate, Spec, SpecError, board};
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
                let effort = match self.keys.effort {
                    Effort::Torque => joint.torque,
                    Effort::Current => board::current(joint, self.keys.torque_constant),
                };
                let effort = if effort.is_nan() { 0.0 } else { effort };
                let values = [joint.position, joint.velocity, effort];
                board::finite(&values)?;
                if board::has_other_faults(quality, quality_of(self.stage.error)) {
                    let codes = [0, ENCODER_ERROR, OVER_CURRENT];
                    self.stage.error = board::fault_code(quality, codes);
                }
                let [p, v, e] = self.keys.scales;
                let [position, velocity, effort] = values;
                let raw = [p.raw(position), v.raw(velocity), e.raw(effort)];
                let data = (self.keys.layout).pack(self.keys.number, raw, self.stage);
                board::send(self.keys.id, &data, out);
            }
            (JOINT, Reading::Actuator(actuator)) => self.stage.error = actuator.faults as u8,
            (DRIVE, Reading::Temperature(temperature)) => {
                board::finite(&[temperature.celsius])?;
                self.stage.celsius = temperature.celsius;
            }
            (JOINT | DRIVE, _) => return Err(EncodeError::Kind),
            _ => return Err(EncodeError::Output(output)),
        }
        Ok(())
    }
}
