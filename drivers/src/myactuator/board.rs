//! The device's own side: a motor that answers questions, or sends what it measures as if it were
//! asked once a period.

use super::frames::{
    ANY_ERROR, Answer, ENCODER_ERROR, JOINT, LENGTH, MOTOR, MotorStatus, MyactuatorProtocol,
    command,
};
use super::options::{MyactuatorKeys, MyactuatorOptions, MyactuatorPosition};
use crate::bytes::{quantise, quantise_i16};
use crate::{Board, EncodeError, Format, Frame, Frames, Simulate, Spec, SpecError, board, mit};
use alloc::boxed::Box;
use proprio_topics::{JointState, Nanos, Quality, Reading};

/// A simulated motor.
#[derive(Debug)]
struct MyactuatorBoard {
    keys: MyactuatorKeys,
    joint: JointState,
    errors: u16,
    celsius: i8,
}

impl MyactuatorBoard {
    fn send(&self, answer: Answer, out: &mut Frames) {
        let data = answer.pack(self.keys.protocol, self.celsius);
        board::send(self.keys.answers(), &data, out);
    }

    #[allow(clippy::cast_possible_truncation)] // limited, or within a turn
    fn state(&self) -> Answer {
        let MyactuatorKeys {
            protocol,
            place_step,
            speed_step,
            ampere_per_step,
            torque_constant,
            encoder_bits,
            ..
        } = self.keys;
        let JointState {
            position, velocity, ..
        } = self.joint;
        let current = board::current(&self.joint, Some(torque_constant)) / ampere_per_step;
        let place = match protocol {
            MyactuatorProtocol::V3 => i64::from(quantise_i16(position, place_step)),
            MyactuatorProtocol::V2 => {
                let steps = quantise(position, place_step, i64::MIN, i64::MAX);
                steps.rem_euclid(1 << encoder_bits)
            }
        };
        Answer::State(MotorStatus {
            celsius: self.celsius,
            current: if current.is_finite() {
                quantise_i16(current, 1.0)
            } else {
                0
            },
            speed: quantise_i16(velocity, speed_step),
            place: place as i32,
        })
    }

    fn angle(&self) -> Answer {
        let most = match self.keys.protocol {
            MyactuatorProtocol::V3 => i64::from(i32::MAX),
            MyactuatorProtocol::V2 => (1 << 55) - 1,
        };
        Answer::Angle(quantise(
            self.joint.position,
            self.keys.angle_step,
            -most,
            most,
        ))
    }

    #[allow(clippy::cast_possible_truncation)] // an address is a byte
    fn send_motion(&self, out: &mut Frames) {
        let raw = mit::raw(self.keys.scales, &self.joint);
        let [p0, p1, v0, both, t1] = mit::pack(raw);
        let data = [self.keys.address as u8, p0, p1, v0, both, t1, 0, 0];
        board::send(self.keys.motion(), &data, out);
    }
}

impl Simulate for MyactuatorOptions {
    /// A motor at 25 degrees Celsius.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(MyactuatorBoard {
            keys: MyactuatorKeys::new(spec, self)?,
            joint: JointState {
                position: 0.0,
                velocity: 0.0,
                ..JointState::ABSENT
            },
            errors: 0,
            celsius: 25,
        }))
    }
}

impl Board for MyactuatorBoard {
    /// Answers questions, and commands that move.
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let is_its = frame.id == self.keys.commands() && frame.len() == LENGTH;
        if !is_its || frame.format != Format::Classic {
            return;
        }
        let answer = match frame.data().first() {
            Some(&command::ANGLE) => self.angle(),
            Some(&command::ERRORS) => Answer::Errors(self.errors),
            Some(&command::STATE) => self.state(),
            Some(moves) if command::MOVES.contains(moves) => self.state(),
            _ => return,
        };
        self.send(answer, out);
    }

    fn period(&self) -> Option<Nanos> {
        let asked = self.keys.request_period.is_some();
        (!asked).then_some(self.keys.period)
    }

    fn present(&mut self, output: u8, reading: &Reading, quality: Quality) {
        let _ = self.encode(output, reading, quality, &mut Frames::new());
    }

    /// New errors are sent at once, before a joint reading. The temperature is sent with the next.
    #[allow(clippy::cast_possible_truncation)] // limited or masked
    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let (errors, mut is_measured) = (self.errors, false);
        match (output, reading) {
            (JOINT, Reading::Joint(joint)) => {
                board::finite(&[joint.position, joint.velocity])?;
                board::finite_or_absent(&[joint.torque, joint.current])?;
                self.joint = *joint;
                if board::has_other_faults(quality, self.keys.quality(errors)) {
                    let set = |flag, error| if quality.contains(flag) { error } else { 0 };
                    // V2 has no error of the encoder.
                    let sensor = match self.keys.protocol {
                        MyactuatorProtocol::V3 => ENCODER_ERROR,
                        MyactuatorProtocol::V2 => ANY_ERROR,
                    };
                    self.errors =
                        set(Quality::DEVICE_FAULT, sensor) | set(Quality::DRIVE_FAULT, ANY_ERROR);
                }
                is_measured = true;
            }
            (JOINT, Reading::Actuator(actuator)) => self.errors = actuator.faults as u16,
            (MOTOR, Reading::Temperature(temperature)) => {
                board::finite(&[temperature.celsius])?;
                self.celsius = quantise(temperature.celsius, 1.0, -128, 127) as i8;
            }
            (JOINT | MOTOR, _) => return Err(EncodeError::Kind),
            _ => return Err(EncodeError::Output(output)),
        }
        if self.errors != errors {
            self.send(Answer::Errors(self.errors), out);
        }
        match self.keys.position {
            _ if !is_measured => {}
            MyactuatorPosition::Angle => {
                self.send(self.state(), out);
                self.send(self.angle(), out);
            }
            MyactuatorPosition::Status => self.send(self.state(), out),
            MyactuatorPosition::Motion => self.send_motion(out),
        }
        Ok(())
    }
}
