//! The device's own side: an axis that streams its estimates, or answers requests.

use super::firmware::{Firmware, error};
use super::frames::{FET, JOINT, MOTOR, command, is_request};
use super::options::{OdriveKeys, OdriveOptions};
use crate::{Board, EncodeError, Frame, Frames, Simulate, Spec, SpecError, board};
use alloc::boxed::Box;
use arrayvec::ArrayVec;
use core::f64::consts::TAU;
use proprio_topics::{Nanos, Quality, Reading};

/// Protocol 2; hardware 4.4, variant 58 (an ODrive Pro); firmware 0.6.9, released.
const VERSION: [u8; 8] = [2, 4, 4, 58, 0, 6, 9, 0];

/// The device's own side of an axis. It streams the estimates, or answers requests if the keys say
/// that it is asked.
#[derive(Debug)]
struct OdriveBoard {
    keys: OdriveKeys,
    errors: u32,
    state: u8,
    estimates: [f64; 2],
    current: f64,
    torque: f64,
    /// Of inverter and motor.
    temperatures: [f64; 2],
    /// Which of them are new, one bit each.
    fresh: u8,
}

impl OdriveBoard {
    /// The frame of `command` with the present values.
    #[allow(clippy::cast_possible_truncation)] // the protocol has single precision
    fn frame(&self, command: u8) -> Frame {
        let floats = |[a, b]: [f64; 2]| {
            let ([a, b, c, d], [e, f, g, h]) = ((a as f32).to_le_bytes(), (b as f32).to_le_bytes());
            [a, b, c, d, e, f, g, h]
        };
        let data = match command {
            command::ESTIMATES => floats(self.estimates),
            command::IQ => floats([self.current; 2]),
            command::TORQUES => floats([self.torque; 2]),
            command::TEMPERATURE => floats(self.temperatures),
            command::VERSION => VERSION,
            _ => self.heartbeat(),
        };
        Frame::new(self.keys.id(command), &data)
    }

    fn heartbeat(&self) -> [u8; 8] {
        let [motor, encoder, controller] = match self.keys.firmware {
            Firmware::V0_6 => [0; 3],
            Firmware::V0_5 => error::FLAGS.map(|error| u8::from(self.errors & error != 0)),
        };
        let [a, b, c, d] = self.errors.to_le_bytes();
        [a, b, c, d, self.state, motor, encoder, controller]
    }

    /// Takes a reading; gives the messages that tell of it.
    #[allow(clippy::cast_possible_truncation)] // the state is a byte on the wire
    fn take(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
    ) -> Result<ArrayVec<u8, 4>, EncodeError> {
        let firmware = self.keys.firmware;
        let mut messages = ArrayVec::new();
        match (output, reading) {
            (JOINT, Reading::Joint(joint)) => {
                board::finite(&[joint.position])?;
                let carried = Quality::DEVICE_FAULT | Quality::DRIVE_FAULT;
                if firmware.quality(self.errors).0 != quality.0 & carried.0 {
                    let (encoder, drive) = match firmware {
                        Firmware::V0_6 => (error::MISSING_ESTIMATE, error::ESTOP_0_6),
                        Firmware::V0_5 => (error::ENCODER_FAILED, error::ESTOP_0_5),
                    };
                    let set = |flag, error| if quality.contains(flag) { error } else { 0 };
                    self.errors =
                        set(Quality::DEVICE_FAULT, encoder) | set(Quality::DRIVE_FAULT, drive);
                    messages.push(command::HEARTBEAT);
                }
                self.estimates = [joint.position / TAU, joint.velocity / TAU];
                self.torque = joint.torque;
                self.current = match self.keys.torque_constant {
                    Some(constant) if joint.current.is_nan() => joint.torque / constant,
                    _ => joint.current,
                };
                if self.current.is_finite() {
                    messages.push(command::IQ);
                }
                let derived = self.keys.torque_constant.is_some() || firmware == Firmware::V0_5;
                if self.torque.is_finite() && !derived {
                    messages.push(command::TORQUES);
                }
                messages.push(command::ESTIMATES);
            }
            (JOINT, Reading::Actuator(actuator)) => {
                self.errors = actuator.faults;
                self.state = actuator.mode as u8;
                messages.push(command::HEARTBEAT);
            }
            (MOTOR | FET, Reading::Temperature(temperature)) if firmware == Firmware::V0_6 => {
                let [fet, motor] = &mut self.temperatures;
                *(if output == MOTOR { motor } else { fet }) = temperature.celsius;
                self.fresh |= output;
                if self.fresh == MOTOR | FET {
                    self.fresh = 0;
                    messages.push(command::TEMPERATURE);
                }
            }
            (JOINT..=FET, _) => return Err(EncodeError::Kind),
            _ => return Err(EncodeError::Output(output)),
        }
        Ok(messages)
    }
}

impl Simulate for OdriveOptions {
    /// An axis in closed-loop control.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(OdriveBoard {
            keys: OdriveKeys::new(spec, self)?,
            errors: 0,
            state: 8,
            estimates: [0.0; 2],
            current: 0.0,
            torque: 0.0,
            temperatures: [f64::NAN; 2],
            fresh: 0,
        }))
    }
}

impl Board for OdriveBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        if !is_request(frame) {
            return;
        }
        if let Some(command) = self.keys.command(frame.id) {
            let _ = out.try_push(self.frame(command));
        } else if frame.id == self.keys.id(command::VERSION) && self.keys.firmware == Firmware::V0_6
        {
            let _ = out.try_push(self.frame(command::VERSION));
        }
    }

    fn period(&self) -> Option<Nanos> {
        let asked = self.keys.request_period.is_some();
        (!asked).then_some(self.keys.period)
    }

    fn present(&mut self, output: u8, reading: &Reading, quality: Quality) {
        let _ = self.take(output, reading, quality);
    }

    /// If the faults differ from the last heartbeat, one precedes the joint reading. Both
    /// temperatures are sent once both are new.
    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        for command in self.take(output, reading, quality)? {
            let _ = out.try_push(self.frame(command));
        }
        Ok(())
    }
}
