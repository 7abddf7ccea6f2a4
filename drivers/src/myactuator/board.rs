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
    fn frame(&self, answer: Answer) -> Frame {
        let data = answer.pack(self.keys.protocol, self.celsius);
        Frame::new(self.keys.answers(), &data)
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
            position,
            velocity,
            torque,
            current,
            ..
        } = self.joint;
        let current = if current.is_nan() {
            torque / torque_constant
        } else {
            current
        };
        let current = current / ampere_per_step;
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
    fn motion(&self) -> Frame {
        let raw = mit::raw(self.keys.scales, &self.joint);
        let [p0, p1, v0, both, t1] = mit::pack(raw);
        let data = [self.keys.address as u8, p0, p1, v0, both, t1, 0, 0];
        Frame::new(self.keys.motion(), &data)
    }

    /// Takes a reading; whether the errors are new, and whether it is one that is sent at once.
    #[allow(clippy::cast_possible_truncation)] // limited or masked
    fn take(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
    ) -> Result<(bool, bool), EncodeError> {
        let errors = self.errors;
        let mut sent = false;
        match (output, reading) {
            (JOINT, Reading::Joint(joint)) => {
                board::finite(&[joint.position, joint.velocity])?;
                board::finite_or_absent(&[joint.torque, joint.current])?;
                self.joint = *joint;
                let carried = Quality::DEVICE_FAULT | Quality::DRIVE_FAULT;
                if self.keys.quality(errors).0 != quality.0 & carried.0 {
                    let set = |flag, error| if quality.contains(flag) { error } else { 0 };
                    // V2 has no error of the encoder.
                    let sensor = match self.keys.protocol {
                        MyactuatorProtocol::V3 => ENCODER_ERROR,
                        MyactuatorProtocol::V2 => ANY_ERROR,
                    };
                    self.errors =
                        set(Quality::DEVICE_FAULT, sensor) | set(Quality::DRIVE_FAULT, ANY_ERROR);
                }
                sent = true;
            }
            (JOINT, Reading::Actuator(actuator)) => self.errors = actuator.faults as u16,
            (MOTOR, Reading::Temperature(temperature)) if temperature.celsius.is_finite() => {
                self.celsius = quantise(temperature.celsius, 1.0, -128, 127) as i8;
            }
            (MOTOR, Reading::Temperature(_)) => return Err(EncodeError::NotFinite),
            (JOINT | MOTOR, _) => return Err(EncodeError::Kind),
            _ => return Err(EncodeError::Output(output)),
        }
        Ok((self.errors != errors, sent))
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
        let _ = out.try_push(self.frame(answer));
    }

    fn period(&self) -> Option<Nanos> {
        let asked = self.keys.request_period.is_some();
        (!asked).then_some(self.keys.period)
    }

    fn present(&mut self, output: u8, reading: &Reading, quality: Quality) {
        let _ = self.take(output, reading, quality);
    }

    /// New errors are sent at once, before a joint reading. The temperature is sent with the next.
    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let (new, sent) = self.take(output, reading, quality)?;
        let errors = new.then(|| self.frame(Answer::Errors(self.errors)));
        let joint = match self.keys.position {
            _ if !sent => [None, None],
            MyactuatorPosition::Angle => [
                Some(self.frame(self.state())),
                Some(self.frame(self.angle())),
            ],
            MyactuatorPosition::Status => [Some(self.frame(self.state())), None],
            MyactuatorPosition::Motion => [Some(self.motion()), None],
        };
        for frame in errors.into_iter().chain(joint.into_iter().flatten()) {
            let _ = out.try_push(frame);
        }
        Ok(())
    }
}
