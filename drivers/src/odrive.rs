//! ODrive motor controllers with the protocol CANSimple: S1, Pro, Micro (firmware 0.6) and v3
//! (firmware 0.5).
//!
//! Each axis is a node; the address is its number, 0 to 63. Identifier: node << 5 | command.
//! Little-endian, f32 unless stated otherwise.
//!
//! | command | name | bytes | content |
//! |---|---|---|---|
//! | 01 | heartbeat | 8 | axis errors u32, axis state u8, then as below |
//! | 09 | encoder estimates | 8 | position \[rev\], velocity \[rev/s\] |
//! | 14 | Iq | 8 | current \[A\]: set point, measured |
//! | 15 | temperature (0.6) | 8 | of the inverter (FET), of the motor \[degrees Celsius\] |
//! | 1C | torques (0.6) | 8 | torque \[Nm\]: target, estimate |
//!
//! - The estimates are the joint reading. The measured current and the estimated torque come in
//!   frames of their own, at their own rates: each joins the readings that follow within `hold_ms`,
//!   and is absent after that. With `torque_constant`, the torque is that times the current.
//! - Position, velocity and torque are those of the shaft that the ODrive controls, usually the
//!   motor's: `ratio` in the joint's table makes them the joint's.
//! - Temperatures have channels of their own: `<device>_motor`, `<device>_fet`. A thermistor that
//!   the ODrive does not have gives none.
//! - In firmware 0.5, 15 is another estimate (without encoder) and 1C a voltage: not read.
//!
//! The heartbeat yields an actuator reading and sets the quality of the joint readings after it.
//! `mode` is the axis state, 8 is closed-loop control. `faults` are the axis errors;
//! [`error_words`] names them. `encoder` holds those of them that concern the encoder. Such an
//! error is DEVICE_FAULT, any other DRIVE_FAULT:
//!
//! | firmware | bytes 5 to 7 | errors of the encoder |
//! |---|---|---|
//! | 0.6 | result of the last procedure, trajectory done, 0 | missing estimate, spinout detected |
//! | 0.5 | bit 0: error of motor, of encoder, of controller | encoder failed, unknown position |
//!
//! - The flags of 0.5 join `faults` as the axis errors "motor failed", "encoder failed" and
//!   "controller failed" that firmware 0.5.1 has for them; older versions leave these bits 0.
//! - In 0.6 the axis errors include the reason of the last disarming, until errors are cleared.
//! - A spinout (electrical and mechanical power disagree) means that the encoder has slipped, or
//!   that its offset is wrong.
//! - **Firmware 0.5 sends 0 as long as it has no estimate**, for example before an incremental
//!   encoder is calibrated, and reports no error.
//!
//! The driver sends nothing: cyclic messages are configured in the ODrive (`encoder_msg_rate_ms`
//! and others; before 0.6 `encoder_rate_ms`; 10 ms by default), and only the heartbeat and the
//! estimates are on by default. Firmware 0.5 has no cyclic current before 0.5.4: with
//! `request_period_ms`, the driver asks for current, torque (0.6) and estimates by remote frames.
//! **In firmware 0.5 each of them feeds the watchdog of the axis**, which then does not notice that
//! its controller has stopped. Extended identifiers (`is_extended`) are not supported.
//!
//! Sources: `Firmware/communication/can/can_simple.cpp`, `tools/odrive-cansimple.dbc` 0.5.6 and
//! `docs/can-protocol.rst` (odriverobotics/ODrive f9b5419c); `can_simple_messages.hpp` (ros_odrive
//! 8ed510b1), the .dbc 0.6.10 in `odrive-can` 2.1.0, `enums.py` in `odrive` 0.6.11. Layouts and
//! errors are certain. Highly probable: the bits of versions before 0.5.4, and the disarm reason in
//! the heartbeat of 0.6, whose firmware is not public. Not known: whether 0.6 feeds its watchdog by
//! remote frames.
//!
//! # Recognition
//! Axes are recognised by heartbeat and estimates. A scan that asks sends each axis that it hears a
//! remote frame for its version (command 00; firmware 0.6 answers: protocol, hardware 3 bytes,
//! firmware 3 bytes, unreleased). Axis 0 is not asked: the identifier is that of CANopen's network
//! management.
//!
//! Axes 48 to 51 would take questions to CANopen nodes (`600` + n), and axis 56 DISCOVER to iCub
//! boards, for commands. These are not sent on the identifiers of an axis that is heard: so such
//! an axis must send its heartbeat, as it does unless that is turned off.
//!
//! # Keys
//! ```toml
//! firmware = "0.6"          # "0.6" or "0.5"
//! torque_constant = 0.05    # torque per current [Nm/A]; default: the torque that 0.6 sends
//! hold_ms = 100             # how long current and torque are used, 1 to 60000
//! request_period_ms = 10    # ask by remote frames, 1 to 60000; default: do not
//! period_ms = 10            # of the estimates, 1 to 60000; used by the simulated device
//! ```

mod board;
mod device;
mod firmware;
mod frames;
mod options;
mod recognise;

pub use board::OdriveBoard;
pub use firmware::{Firmware, error_words};
pub use options::Options;

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Axis;
use frames::{FET, JOINT, MOTOR, NODE_MOST};
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "odrive";

    fn outputs(&self) -> Vec<OutputInfo> {
        let temperature = OutputInfo::temperature;
        let joint = OutputInfo::new(JOINT, Kind::Joint);
        match self.firmware {
            Firmware::V0_5 => [joint].to_vec(),
            Firmware::V0_6 => {
                [joint, temperature(MOTOR, "motor"), temperature(FET, "fet")].to_vec()
            }
        }
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Axis::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(OdriveBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        (0..=NODE_MOST)
            .filter_map(|node| recognise::axis(seen, Self::NAME, node))
            .collect()
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        recognise::questions(seen)
    }
}
