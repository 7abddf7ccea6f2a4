//! The device's own side: a controller that sends its status once a period.

use super::frames::{
    AMPERE_PER_STEP, DUTY_PER_STEP, FET, JOINT, KELVIN_PER_STEP, MOTOR, STEPS_PER_TURN, command,
};
use super::options::{VescKeys, VescOptions, VescPosition};
use crate::bytes::{quantise, quantise_i16};
use crate::{Board, EncodeError, Frames, Simulate, Spec, SpecError, board};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading};

/// A simulated controller.
#[derive(Debug)]
struct VescBoard {
    keys: VescKeys,
    /// The duty cycle that it was told.
    duty: f64,
    /// Of FETs and motor \[degrees Celsius\].
    temperatures: [f64; 2],
}

impl VescBoard {
    fn status(&self, velocity: f64, amperes: f64) -> [u8; 8] {
        let most = i64::from(i32::MAX);
        #[allow(clippy::cast_possible_truncation)] // limited
        let erpm = quantise(velocity, self.keys.velocity_step, -most, most) as i32;
        let [r0, r1, r2, r3] = erpm.to_be_bytes();
        let mut duty = quantise_i16(self.duty, DUTY_PER_STEP);
        if duty == 0 && amperes != 0.0 {
            duty = if amperes < 0.0 { -1 } else { 1 };
        }
        let current = if duty < 0 { -amperes } else { amperes };
        let [c0, c1] = quantise_i16(current, AMPERE_PER_STEP).to_be_bytes();
        let [d0, d1] = duty.to_be_bytes();
        [r0, r1, r2, r3, c0, c1, d0, d1]
    }

    /// The message with the temperatures, and this PID position \[steps\].
    fn status_4(&self, position: i64) -> [u8; 8] {
        let [[f0, f1], [m0, m1]] =
            (self.temperatures).map(|celsius| quantise_i16(celsius, KELVIN_PER_STEP).to_be_bytes());
        #[allow(clippy::cast_possible_truncation)] // within a turn
        let [p0, p1] = (position as i16).to_be_bytes();
        [f0, f1, m0, m1, 0, 0, p0, p1]
    }

    fn send(&self, command: u8, data: [u8; 8], out: &mut Frames) {
        board::send(self.keys.id(command), &data, out);
    }
}

impl Simulate for VescOptions {
    /// A controller at 25 degrees Celsius.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(VescBoard {
            keys: VescKeys::new(spec, self)?,
            duty: 0.0,
            temperatures: [25.0; 2],
        }))
    }
}

impl Board for VescBoard {
    fn period(&self) -> Option<Nanos> {
        Some(self.keys.period)
    }

    /// A PID position is sent within its turn. An absent torque or current is sent as 0.
    /// Temperatures are sent with the next PID position, or by themselves beside a tachometer.
    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        _quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        match (output, reading) {
            (JOINT, Reading::Joint(joint)) => {
                let amperes = board::current(joint, self.keys.torque_constant);
                let amperes = if amperes.is_nan() { 0.0 } else { amperes };
                let values = [joint.position, joint.velocity, amperes];
                board::finite(&values)?;
                self.send(command::STATUS, self.status(joint.velocity, amperes), out);
                let (step, most) = (self.keys.position_step, i64::from(i32::MAX));
                match self.keys.position {
                    VescPosition::Pid => {
                        let steps = quantise(joint.position, step, i64::MIN, i64::MAX);
                        let data = self.status_4(steps.rem_euclid(STEPS_PER_TURN));
                        self.send(command::STATUS_4, data, out);
                    }
                    VescPosition::Tachometer => {
                        #[allow(clippy::cast_possible_truncation)] // limited
                        let count = quantise(joint.position, step, -most, most) as i32;
                        let [t0, t1, t2, t3] = count.to_be_bytes();
                        self.send(command::STATUS_5, [t0, t1, t2, t3, 0, 0, 0, 0], out);
                    }
                }
            }
            (JOINT, Reading::Actuator(actuator)) => self.duty = actuator.duty,
            (MOTOR | FET, Reading::Temperature(temperature)) => {
                board::finite(&[temperature.celsius])?;
                let [fet, motor] = &mut self.temperatures;
                *(if output == MOTOR { motor } else { fet }) = temperature.celsius;
                if self.keys.position == VescPosition::Tachometer {
                    self.send(command::STATUS_4, self.status_4(0), out);
                }
            }
            (JOINT..=FET, _) => return Err(EncodeError::Kind),
            _ => return Err(EncodeError::Output(output)),
        }
        Ok(())
    }
}
