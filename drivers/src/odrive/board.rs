//! The device's own side: an axis that streams its estimates, or answers requests.

use super::firmware::{Firmware, error};
use super::frames::{FET, JOINT, MOTOR, command, is_request};
use super::options::{OdriveKeys, OdriveOptions};
use crate::{Board, EncodeError, Frame, Frames, Simulate, Spec, SpecError, board};
use alloc::boxed::Box;
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
    /// Sends the message `command` with the present values.
    #[allow(clippy::cast_possible_truncation)] // the protocol has single precision
    fn send(&self, command: u8, out: &mut Frames) {
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
        board::send(self.keys.id(command), &data, out);
    }

    fn heartbeat(&self) -> [u8; 8] {
        let [motor, encoder, controller] = match self.keys.firmware {
            Firmware::V0_6 => [0; 3],
            Firmware::V0_5 => error::FLAGS.map(|error| u8::from(self.errors & error != 0)),
        };
        let [a, b, c, d] = self.errors.to_le_bytes();
        [a, b, c, d, self.state, motor, encoder, controller]
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
            self.send(command, out);
        } else if frame.id == self.keys.id(command::VERSION) && self.keys.firmware == Firmware::V0_6
        {
            self.send(command::VERSION, out);
        }
    }

    fn period(&self) -> Option<Nanos> {
        let asked = self.keys.request_period.is_some();
        (!asked).then_some(self.keys.period)
    }

    fn present(&mut self, output: u8, reading: &Reading, quality: Quality) {
        let _ = self.encode(output, reading, quality, &mut Frames::new());
    }

    /// If the faults differ from the last heartbeat, one precedes the joint reading. Both
    /// temperatures are sent once both are new.
    #[allow(clippy::cast_possible_truncation)] // the state is a byte on the wire
    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let firmware = self.keys.firmware;
        match (output, reading) {
            (JOINT, Reading::Joint(joint)) => {
                board::finite(&[joint.position])?;
                if board::has_other_faults(quality, firmware.quality(self.errors)) {
                    let (encoder, drive) = match firmware {
                        Firmware::V0_6 => (error::MISSING_ESTIMATE, error::ESTOP_0_6),
                        Firmware::V0_5 => (error::ENCODER_FAILED, error::ESTOP_0_5),
                    };
                    let set = |flag, error| if quality.contains(flag) { error } else { 0 };
                    self.errors =
                        set(Quality::DEVICE_FAULT, encoder) | set(Quality::DRIVE_FAULT, drive);
                    self.send(command::HEARTBEAT, out);
                }
                self.estimates = [joint.position / TAU, joint.velocity / TAU];
                self.torque = joint.torque;
                self.current = board::current(joint, self.keys.torque_constant);
                if self.current.is_finite() {
                    self.send(command::IQ, out);
                }
                let derived = self.keys.torque_constant.is_some() || firmware == Firmware::V0_5;
                if self.torque.is_finite() && !derived {
                    self.send(command::TORQUES, out);
                }
                self.send(command::ESTIMATES, out);
            }
            (JOINT, Reading::Actuator(actuator)) => {
                self.errors = actuator.faults;
                self.state = actuator.mode as u8;
                self.send(command::HEARTBEAT, out);
            }
            (MOTOR | FET, Reading::Temperature(temperature)) if firmware == Firmware::V0_6 => {
                let [fet, motor] = &mut self.temperatures;
                *(if output == MOTOR { motor } else { fet }) = temperature.celsius;
                self.fresh |= output;
                if self.fresh == MOTOR | FET {
                    self.fresh = 0;
                    self.send(command::TEMPERATURE, out);
                }
            }
            (JOINT..=FET, _) => return Err(EncodeError::Kind),
            _ => return Err(EncodeError::Output(output)),
        }
        Ok(())
    }
}
