//! The device's own side: a motor that answers questions, or sends its state as if it were
//! commanded once a period.

use super::frames::{
    DISABLED, DamiaoState, ENABLED, FET, JOINT, MOTOR, OVERLOAD, QUESTIONS, RANGES, READ, SENSOR,
    STATE, frame, quality_of,
};
use super::options::{DamiaoKeys, DamiaoOptions};
use crate::mit::{self, Scale};
use crate::{Board, EncodeError, Format, Frame, Frames, Simulate, Spec, SpecError, board};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading};

/// The ranges of a motor that neither keys nor a model describe: those of a DM4310.
const RANGES_USUAL: [f64; 3] = [12.5, 30.0, 10.0];

/// A simulated motor.
#[derive(Debug)]
struct DamiaoBoard {
    keys: DamiaoKeys,
    /// The ends of its ranges, and their scales.
    ends: [f64; 3],
    scales: [Scale; 3],
    state: DamiaoState,
}

impl DamiaoBoard {
    fn frame(&self) -> Frame {
        let data = self.state.pack(self.keys.address);
        frame(self.keys.id, self.keys.fd, data)
    }
}

impl Simulate for DamiaoOptions {
    /// An enabled motor at 25 degrees Celsius.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        let keys = DamiaoKeys::new(spec, self)?;
        let mut ends = RANGES_USUAL;
        let known = keys.stated.iter().zip(&keys.of_model);
        for (end, (stated, model)) in ends.iter_mut().zip(known) {
            *end = stated.or(*model).unwrap_or(*end);
        }
        let scales = mit::scales(ends);
        let state = DamiaoState {
            state: ENABLED,
            raw: scales.map(|scale| scale.raw(0.0)),
            celsius: [25; 2],
        };
        Ok(Box::new(DamiaoBoard {
            keys,
            ends,
            scales,
            state,
        }))
    }
}

impl Board for DamiaoBoard {
    /// Answers questions, and commands in each of its modes.
    #[allow(clippy::cast_possible_truncation)] // registers have single precision
    fn on_frame(&mut self, question: &Frame, out: &mut Frames) {
        if matches!(question.format, Format::Remote | Format::Error) {
            return;
        }
        let address = self.keys.address;
        if question.id != QUESTIONS {
            let is_command = |base: u32| question.id.raw() == base + u32::from(address);
            let command = question.id.raw() < 0x400 && question.len() == 8;
            if command && [0, 0x100, 0x200, 0x300].into_iter().any(is_command) {
                let _ = out.try_push(self.frame());
            }
            return;
        }
        let &[low, 0, command, register, ..] = question.data() else {
            return;
        };
        if low != address {
            return;
        }
        let range = RANGES.iter().position(|range| *range == register);
        let end = range.and_then(|place| self.ends.get(place));
        let answer = match (command, end) {
            (STATE, _) => self.frame(),
            (READ, Some(end)) => {
                let [a, b, c, d] = (*end as f32).to_le_bytes();
                let data = [low, 0, READ, register, a, b, c, d];
                frame(self.keys.id, self.keys.fd, data)
            }
            _ => return,
        };
        let _ = out.try_push(answer);
    }

    fn period(&self) -> Option<Nanos> {
        let asked = self.keys.request_period.is_some();
        (!asked).then_some(self.keys.period)
    }

    fn present(&mut self, output: u8, reading: &Reading, quality: Quality) {
        let _ = self.encode(output, reading, quality, &mut Frames::new());
    }

    /// Temperatures and state are sent with the next joint reading. An absent torque is sent as 0.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // limited; casts saturate
    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        match (output, reading) {
            (JOINT, Reading::Joint(joint)) => {
                board::finite(&[joint.position, joint.velocity])?;
                board::finite_or_absent(&[joint.torque])?;
                if board::has_other_faults(quality, quality_of(self.state.state)) {
                    self.state.state = board::fault_code(quality, [ENABLED, SENSOR, OVERLOAD]);
                }
                self.state.raw = mit::raw(self.scales, joint);
                let _ = out.try_push(self.frame());
            }
            (JOINT, Reading::Actuator(actuator)) => {
                self.state.state = match (actuator.faults, actuator.mode) {
                    (0, 0) => DISABLED,
                    (0, _) => ENABLED,
                    (faults, _) => faults.min(0xF) as u8,
                };
            }
            (MOTOR | FET, Reading::Temperature(temperature)) => {
                board::finite(&[temperature.celsius])?;
                let [fet, rotor] = &mut self.state.celsius;
                let place = if output == MOTOR { rotor } else { fet };
                *place = libm::round(temperature.celsius) as u8;
            }
            (JOINT..=FET, _) => return Err(EncodeError::Kind),
            _ => return Err(EncodeError::Output(output)),
        }
        Ok(())
    }
}
