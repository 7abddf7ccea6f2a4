//! iCub F/T boards strain, strain2 and strain2c: wrench, uncalibrated gauges, temperature.
//!
//! Streams of address `a`, little-endian, class 3:
//!
//! | identifier | name | bytes | content |
//! |---|---|---|---|
//! | `3aA` | FORCE_VECTOR | 6 or 7 | fx fy fz u16, then `sat` |
//! | `3aB` | TORQUE_VECTOR | 6 or 7 | tx ty tz u16, then `sat` |
//! | `3a8` | UNCALIBFORCE_VECTOR | 6 or 7 | gauges 0 to 2 u16, then `sat` |
//! | `3a9` | UNCALIBTORQUE_VECTOR | 6 or 7 | gauges 3 to 5 u16, then `sat` |
//! | `3aE` or `3aF` | THERMOMETER_MEASURE | 5 | mask u8, 0.1 degC i16, 2 bytes unused |
//!
//! - value = (u16 - 0x8000) / 32768 x full scale of its axis, force in N, torque in Nm.
//! - `sat` is present only while at least one of the six gauges is saturated: bits 1:0 = 1; then
//!   two bits for each of the frame's three gauges, 0 within range, 1 low, 2 high. **While it is
//!   present, the calibrated output is frozen** at the last vector that was not saturated: such
//!   readings have SATURATED and FROZEN. Saturation is known per *gauge*; gauge k is reported as
//!   axis k of [`Quality::saturation`], although through the calibration matrix each gauge affects
//!   every axis.
//! - The frames have no sequence number: force and torque are paired by order and time
//!   (`Pairing` in `pairing.rs`).
//! - A thermometer frame has type E in the document and the shared header, but F in the strain2
//!   firmware's enumeration: both are accepted.
//!
//! Commands on `20a`, answers on `2a0` (full scales big-endian, in whole N and Nm):
//!
//! | bytes | meaning | answer |
//! |---|---|---|
//! | `18 ch` | full scale of axis ch, 0 to 5 | `18 ch high low` |
//! | `08 ms` | period | none |
//! | `07 00`, `07 03`, `07 04`, `07 01` | send calibrated, uncalibrated, both; stop | none |
//! | `15 01` | tare: take minus the present load as what is added to each axis | none |
//! | `16 ch` | what is added to axis ch, signed, in steps of the stream | `16 ch high low` |
//! | `0A row col` | entry of the calibration matrix, signed, in 1/32768 | `0A row col high low` |
//! | `39 01`, `3A s` | select the thermometer; its period in s, 0 stops | none |
//!
//! Sources: `TSD-ICUBUNIT-canprotocol-sensorboards.docx` v1.12 and
//! `embot_app_application_theSTRAIN.cpp` (icub-firmware b4299211), `canBusAnalogSensor` (icub-main
//! 24c1a003). Certain, except the thermometer's type.
//!
//! The stream does not contain the scale, and a wrong scale gives plausible but wrong values:
//! **without a full scale there is no reading**. It comes from the configuration, else from the
//! board. If the board does not answer, the device is refused ([`Refusal::NoFullScale`]), and the
//! board is asked again twice a second, so that a board that is powered later still starts. A full
//! scale of zero (a corrupt memory) is [`Refusal::ZeroFullScale`]. One that differs from the
//! board's earlier answer is [`Refusal::Changed`], permanently: the readings in between cannot be
//! trusted.
//!
//! # Tare
//! [`Command::Tare`](crate::Command::Tare) makes the present load the zero of the calibrated
//! stream: the board adds minus that load from then on, until its next tare or power-on. (It
//! forgets the tare with its power, and does not tell.) The host sends the command once, then reads
//! back all six axes, which confirms it and gives what is added. The board does not say which
//! reading is the first with the new zero, so every reading from the command to the confirmation,
//! and the first after it, has [`Quality::ZERO_CHANGED`].
//!
//! A tare changes the sensor's offset: offsets that were identified before it no longer hold. It
//! takes what the sensor carries at that instant, gravity and contacts too.
//!
//! [`Quality::ZERO_CHANGED`]: proprio_topics::Quality::ZERO_CHANGED
//!
//! # Calibration
//! [`Command::Calibration`](crate::Command::Calibration) reads the six full scales and the 36
//! entries of the matrix that are in use (a strain2 stores three sets), one question at a time
//! while the board streams. Boards have been found with entries of FFFF and full scales of zero.
//! Nothing is read at the start but the full scales: a matrix that is wrong does not stop a board.
//!
//! # Keys
//! ```toml
//! full_scale_n = [1804, 1804, 1804]  # both or neither; overrides the board's own
//! full_scale_nm = [31, 31, 31]
//! period_ms = 10                     # 1 to 255; strain2 needs 2 or more for full accuracy
//! stream = "calibrated"              # "calibrated", "uncalibrated" or "both"
//! temperature_period_s = 1           # none if absent
//! pair_timeout_ms = 5.3              # longest time from force to torque; default: half a period
//!                                    # plus 0.3 ms; below 2 ms of period 1.3 ms if the bus jitters
//! power_on_silence_ms = 0            # see `crate::icub`
//! ```
//!
//! [`Quality::saturation`]: proprio_topics::Quality::saturation
//! [`Refusal::NoFullScale`]: proprio_topics::Refusal::NoFullScale
//! [`Refusal::ZeroFullScale`]: proprio_topics::Refusal::ZeroFullScale
//! [`Refusal::Changed`]: proprio_topics::Refusal::Changed

mod board;
mod device;
mod exchange;
mod frames;
mod options;

pub use board::StrainBoard;
pub use options::{Options, Stream};

use crate::icub::{self, board as boards, class};
use crate::recognise::{self, Finding, Key, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Strain;
use frames::kind;
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "icub_strain";

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Strain::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(StrainBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let types = [boards::STRAIN, boards::STRAIN2, boards::STRAIN2C];
        icub::recognise(seen, Self::NAME, &types, &[], |evidence, address, _| {
            let id = |kind| icub::stream(class::PERIODIC_ANALOG, address, kind);
            let mut half = |kind| evidence.sends(id(kind), |frame| matches!(frame.len(), 6 | 7));
            let calibrated = (half(kind::FORCE), half(kind::TORQUE));
            let raw = (half(kind::RAW_FORCE), half(kind::RAW_TORQUE));
            for pair in [calibrated, raw] {
                if let (Some(force), Some(torque)) = pair {
                    evidence.together(force, torque);
                    evidence.measures(force);
                } else if pair.0.is_some() || pair.1.is_some() {
                    evidence.lacks();
                }
            }
            for kind in kind::THERMOMETERS {
                evidence.sends_length(id(kind), 5);
            }
            let stream = calibrated.0.or(raw.0);
            let mut keys: Vec<Key> = Vec::new();
            keys.extend(Key::period_ms(
                stream.and_then(recognise::Stream::period),
                1,
                255,
            ));
            match (calibrated.0, raw.0) {
                (Some(_), Some(_)) => keys.push(Key::new("stream", "\"both\"")),
                (None, Some(_)) => keys.push(Key::new("stream", "\"uncalibrated\"")),
                _ => {}
            }
            (keys, Vec::new())
        })
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}
