//! The IMU board's own side. It executes the host's commands and sends readings as frames.

use super::frames::{
    FIELD_LSB, ImuQuantity, LEGACY_ACCELEROMETERS, LEGACY_GYROSCOPE, Legacy, QUATERNION_LSB, kind,
    sensor,
};
use super::options::{IcubImuOptions, ImuKeys};
use crate::icub::{self, class, command};
use crate::{Board, EncodeError, Frame, Frames, Mode, Simulate, Spec, SpecError, board, bytes};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading};

/// Duration of a simulated board's acquisition \[us\]; real boards take 2 to 6 ms.
const ACQUISITION_US: u32 = 4000;

/// The board's own side.
#[derive(Debug)]
struct ImuBoard {
    plan: ImuKeys,
    period: Nanos,
    streaming: bool,
    /// The configuration received, in the form of IMU_CONFIG_SET.
    configuration: Option<[u8; 8]>,
    /// The legacy configuration received.
    legacy_mask: Option<u8>,
    /// SEQ of the last acquisition.
    sequence: u8,
}

impl ImuBoard {
    /// The plan for encoding a reading: the configuration received, else the keys.
    fn mask(&self) -> u16 {
        match (self.plan.legacy, self.configuration, self.legacy_mask) {
            (Legacy::None, Some([_, low, high, ..]), _) => u16::from_le_bytes([low, high]),
            (Legacy::Mtb | Legacy::Bno055, _, Some(mask)) => {
                let bit = |sensors: u8, quantity: ImuQuantity| {
                    if mask & sensors == 0 {
                        0
                    } else {
                        quantity.bit()
                    }
                };
                bit(LEGACY_ACCELEROMETERS, ImuQuantity::Acceleration)
                    | bit(LEGACY_GYROSCOPE, ImuQuantity::AngularVelocity)
            }
            _ => self.plan.want,
        }
    }

    fn send(&self, kind: u8, data: &[u8], out: &mut Frames) {
        board::send(
            icub::stream(class::PERIODIC_INERTIAL, self.plan.address, kind),
            data,
            out,
        );
    }
}

impl Simulate for IcubImuOptions {
    /// A board after power-on; in [`Mode::Listen`] another program has already started it.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        let plan = ImuKeys::new(spec, self)?;
        Ok(Box::new(ImuBoard {
            period: Nanos::from_millis(i64::from(plan.period_ms)),
            streaming: spec.mode == Mode::Listen,
            configuration: None,
            legacy_mask: None,
            sequence: 0,
            plan,
        }))
    }
}

impl Board for ImuBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let is_legacy = self.plan.legacy != Legacy::None;
        let board = if self.plan.legacy == Legacy::Mtb {
            icub::board::MTB
        } else {
            icub::board::STRAIN2
        };
        let (class, address) = (class::POLLING_ANALOG, self.plan.address);
        let Some(bytes) = icub::answer_management(frame, class, address, board, out) else {
            return;
        };
        match *bytes {
            [command::IMU_CONFIG_SET, a, b, c, d, e, f, g] if !is_legacy => {
                // As in the firmware, a new configuration stops the stream.
                self.streaming = false;
                self.configuration = Some([command::IMU_CONFIG_SET, a, b, c, d, e, f, g]);
            }
            [command::IMU_CONFIG_GET] if !is_legacy => {
                let mut answer = self.configuration.unwrap_or_default();
                if let Some(first) = answer.first_mut() {
                    *first = command::IMU_CONFIG_GET;
                }
                board::send(
                    icub::to_host(class::POLLING_ANALOG, self.plan.address),
                    &answer,
                    out,
                );
            }
            [command::IMU_TRANSMIT, ms] if !is_legacy => {
                // A board without a configuration sends nothing.
                self.streaming =
                    ms > 0 && self.configuration.is_some_and(|c| c[1] != 0 || c[2] != 0);
                if ms > 0 {
                    self.period = Nanos::from_millis(i64::from(ms));
                    self.sequence = 0;
                }
            }
            [command::ACC_GYRO_SETUP, mask, ms] if is_legacy => {
                self.streaming = mask != 0 && ms > 0;
                self.legacy_mask = Some(mask);
                self.period = Nanos::from_millis(i64::from(ms));
            }
            _ => {}
        }
    }

    fn period(&self) -> Option<Nanos> {
        self.streaming.then_some(self.period)
    }

    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let imu = board::only_imu(output, reading)?;
        let mask = self.mask();
        let sends = |quantity: ImuQuantity| mask & quantity.bit() != 0;
        let values: [(ImuQuantity, &[f64]); 4] = [
            (ImuQuantity::Acceleration, &imu.proper_acceleration),
            (ImuQuantity::AngularVelocity, &imu.angular_velocity),
            (ImuQuantity::MagneticField, &imu.magnetic_field),
            (ImuQuantity::Orientation, &imu.orientation),
        ];
        for (quantity, values) in values {
            if sends(quantity) {
                board::finite(values)?;
            }
        }
        let bytes = |values: [f64; 3], lsb: f64| {
            let [[a, b], [c, d], [e, f]] =
                values.map(|value| bytes::quantise_i16(value, lsb).to_le_bytes());
            [a, b, c, d, e, f]
        };
        let [acceleration_lsb, rate_lsb] = self.plan.legacy.lsb();
        let acceleration = bytes(imu.proper_acceleration, acceleration_lsb);
        let rate = bytes(imu.angular_velocity, rate_lsb);
        if self.plan.legacy != Legacy::None {
            if sends(ImuQuantity::Acceleration) {
                self.send(kind::LEGACY_ACCELEROMETER, &acceleration, out);
            }
            if sends(ImuQuantity::AngularVelocity) {
                self.send(kind::LEGACY_GYROSCOPE, &rate, out);
            }
            return Ok(());
        }
        self.sequence = self.sequence.wrapping_add(1);
        let sequence = self.sequence;
        let triple = |sensor: u8, [a, b, c, d, e, f]: [u8; 6]| [sequence, sensor, a, b, c, d, e, f];
        if sends(ImuQuantity::Acceleration) {
            self.send(
                kind::TRIPLE,
                &triple(sensor::ACCELERATION, acceleration),
                out,
            );
        }
        if sends(ImuQuantity::MagneticField) {
            let field = bytes(imu.magnetic_field, FIELD_LSB);
            self.send(kind::TRIPLE, &triple(sensor::MAGNETIC_FIELD, field), out);
        }
        if sends(ImuQuantity::AngularVelocity) {
            self.send(kind::TRIPLE, &triple(sensor::ANGULAR_VELOCITY, rate), out);
        }
        if sends(ImuQuantity::Orientation) {
            let [w, x, y, z] = imu.orientation;
            let [w0, w1] = bytes::quantise_i16(w, QUATERNION_LSB).to_le_bytes();
            let [a, b, c, d, e, f] = bytes([x, y, z], QUATERNION_LSB);
            self.send(kind::QUATERNION, &[w0, w1, a, b, c, d, e, f], out);
        }
        if sends(ImuQuantity::Status) {
            let calibration = if quality.contains(Quality::NOT_CALIBRATED) {
                0
            } else {
                3
            };
            let [a, b, c, d] = ACQUISITION_US.to_le_bytes();
            let status = [sequence, calibration, calibration, calibration, a, b, c, d];
            self.send(kind::STATUS, &status, out);
        }
        Ok(())
    }
}
