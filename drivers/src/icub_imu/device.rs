//! The host's side of an IMU. It configures and starts the board, and combines the frames of each
//! acquisition into a reading.

use super::frames::{
    ACCELERATION_LSB, FIELD_LSB, ImuQuantity, Legacy, QUATERNION_LSB, RATE_LSB, kind, sensor,
};
use super::options::{IcubImuOptions, ImuKeys};
use crate::bringup::{Bringup, Timing};
use crate::configure::{Configure, Setting};
use crate::family::{Family, Session, Supervised};
use crate::icub::{self, class, command};
use crate::pairing::{self, HalfOrder, Limit, Paired, Pairing};
use crate::received::Received;
use crate::{
    Claim, Device, Driver, Frame, NotSent, OutputInfo, Spec, SpecError, StampedReading, bytes,
};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Counter, Imu, Kind, Nanos, Quality, Reading, StampKind};

/// A frame up to this many sequence numbers back is late; further back, the counter has restarted
/// or there is a long gap.
const LATE: u8 = 4;

/// The current, incomplete acquisition.
#[derive(Debug, Clone, Copy)]
struct Acquisition {
    open: bool,
    /// It is the first that was heard: frames of it may have been sent before.
    joined: bool,
    acquired: Nanos,
    stamp: StampKind,
    /// The quantities received, as bits of the mask.
    have: u16,
    imu: Imu,
}

impl Acquisition {
    const NONE: Self = Self {
        open: false,
        joined: false,
        acquired: Nanos::ZERO,
        stamp: StampKind::None,
        have: 0,
        imu: Imu::ABSENT,
    };
}

/// The host's side of an IMU.
#[derive(Debug)]
pub(super) struct ImuDevice {
    plan: ImuKeys,
    acquisition: Acquisition,
    /// SEQ of the last acquisition begun.
    sequence: Option<u8>,
    /// Until then SEQ may jump once: a command makes the board begin anew.
    may_jump: Nanos,
    /// The sensors in use that are not calibrated according to the last status.
    not_calibrated: bool,
    legacy: Pairing<[i16; 3]>,
    /// Maximum duration of an acquisition.
    together: Nanos,
    gap: bool,
    /// Whether there was a reading: from then on a restart leaves a gap.
    seen: bool,
}

impl ImuDevice {
    /// Whether a frame with `sequence` belongs to the open acquisition; a later `sequence` opens a
    /// new one.
    fn belongs(&mut self, sequence: u8, frame: &mut Received<'_>) -> bool {
        let joined = self.sequence.is_none();
        if let Some(last) = self.sequence {
            match sequence.wrapping_sub(last) {
                // If it is not open, it is complete, and this frame is not needed.
                0 => return self.acquisition.open,
                1 => self.abandon(frame),
                _ if frame.t <= self.may_jump => {
                    self.may_jump = Nanos::MIN;
                    self.gap |= self.seen;
                }
                ahead if ahead <= u8::MAX - LATE => {
                    self.abandon(frame);
                    frame.faults(Counter::Lost, u32::from(ahead) - 1);
                    self.gap = true;
                }
                _ => {
                    frame.fault(Counter::Unpaired);
                    self.gap = true;
                    return false;
                }
            }
        }
        self.sequence = Some(sequence);
        self.acquisition = Acquisition {
            open: true,
            joined,
            acquired: frame.t,
            stamp: frame.stamp,
            ..Acquisition::NONE
        };
        true
    }

    /// Drops an incomplete acquisition.
    fn abandon(&mut self, frame: &mut Received<'_>) {
        if core::mem::take(&mut self.acquisition.open) && !self.acquisition.joined {
            frame.fault(Counter::Unpaired);
            self.gap = true;
        }
    }

    /// Records that the acquisition has `bit`; outputs the reading when all wanted quantities are
    /// present.
    fn hold(&mut self, bit: u16, frame: &mut Received<'_>, session: &mut Session<Configure>) {
        self.acquisition.have |= bit;
        if self.acquisition.have & self.plan.want != self.plan.want {
            return;
        }
        self.acquisition.open = false;
        let Acquisition {
            acquired,
            stamp,
            imu,
            ..
        } = self.acquisition;
        let mut quality = Quality::DEVICE_COUNTER;
        if self.not_calibrated {
            quality |= Quality::NOT_CALIBRATED;
        }
        let stamped = StampedReading {
            acquired,
            stamp,
            device_counter: u32::from(self.sequence.unwrap_or(0)),
            ..StampedReading::new(0, frame, quality, Reading::Imu(imu))
        };
        self.add(stamped, frame, session);
    }

    /// Adds a reading; the first one after something was lost is marked.
    fn add(
        &mut self,
        mut stamped: StampedReading,
        frame: &mut Received<'_>,
        session: &mut Session<Configure>,
    ) {
        if core::mem::take(&mut self.gap) {
            stamped.quality |= Quality::GAP_BEFORE;
        }
        self.seen = true;
        session.add(stamped, frame);
    }

    fn triple(&mut self, data: &[u8], frame: &mut Received<'_>, session: &mut Session<Configure>) {
        let &[sequence, sensor, ..] = data else {
            return;
        };
        if !matches!(
            sensor,
            sensor::ACCELERATION..=sensor::EULER | sensor::LINEAR_ACCELERATION | sensor::GRAVITY
        ) {
            return frame.fault(Counter::Value);
        }
        let bit = 1_u16 << sensor;
        if !self.belongs(sequence, frame) || self.plan.want & bit == 0 {
            return;
        }
        let imu = &mut self.acquisition.imu;
        let (field, lsb) = match sensor {
            sensor::ACCELERATION => (&mut imu.proper_acceleration, ACCELERATION_LSB),
            sensor::MAGNETIC_FIELD => (&mut imu.magnetic_field, FIELD_LSB),
            // Other quantities are never wanted.
            _ => (&mut imu.angular_velocity, RATE_LSB),
        };
        *field = vector(data, 2).map(|count| f64::from(count) * lsb);
        self.hold(bit, frame, session);
    }

    fn quaternion(
        &mut self,
        data: &[u8],
        frame: &mut Received<'_>,
        session: &mut Session<Configure>,
    ) {
        let bit = ImuQuantity::Orientation.bit();
        // Before the first acquisition that is heard it belongs to an earlier one.
        if self.plan.want & bit == 0 || self.sequence.is_none() {
            return;
        }
        let begun = (self.acquisition.acquired, self.acquisition.stamp);
        if !self.acquisition.open || !pairing::within(begun, frame, self.together) {
            frame.fault(Counter::Unpaired);
            self.gap = true;
            return;
        }
        let [x, y, z] = vector(data, 2);
        let w = bytes::i16_le(data, 0);
        self.acquisition.imu.orientation =
            [w, x, y, z].map(|count| f64::from(count) * QUATERNION_LSB);
        self.hold(bit, frame, session);
    }

    fn status(&mut self, data: &[u8], frame: &mut Received<'_>, session: &mut Session<Configure>) {
        let &[sequence, gyroscope, accelerometer, magnetometer, ..] = data else {
            return;
        };
        if gyroscope > 3 || accelerometer > 3 || magnetometer > 3 {
            return frame.fault(Counter::Value);
        }
        let bit = ImuQuantity::Status.bit();
        if self.plan.want & bit == 0 || !self.belongs(sequence, frame) {
            return;
        }
        let lacks = |quantity: ImuQuantity, calibration| {
            self.plan.want & quantity.bit() != 0 && calibration == 0
        };
        self.not_calibrated = lacks(ImuQuantity::Acceleration, accelerometer)
            || lacks(ImuQuantity::AngularVelocity, gyroscope)
            || lacks(ImuQuantity::MagneticField, magnetometer);
        self.hold(bit, frame, session);
    }

    fn legacy(
        &mut self,
        is_gyroscope: bool,
        data: &[u8],
        frame: &mut Received<'_>,
        session: &mut Session<Configure>,
    ) {
        let quantity = if is_gyroscope {
            ImuQuantity::AngularVelocity
        } else {
            ImuQuantity::Acceleration
        };
        if self.plan.want & quantity.bit() == 0 {
            return;
        }
        let counts = vector(data, 0);
        let mut imu = Imu::ABSENT;
        let (mut acquired, mut stamp) = (frame.t, frame.stamp);
        let [acceleration_lsb, rate_lsb] = self.plan.legacy.lsb();
        let mut set = |is_gyroscope: bool, counts: [i16; 3]| {
            if is_gyroscope {
                imu.angular_velocity = counts.map(|count| f64::from(count) * rate_lsb);
            } else {
                imu.proper_acceleration = counts.map(|count| f64::from(count) * acceleration_lsb);
            }
        };
        if self.plan.want == quantity.bit() {
            set(is_gyroscope, counts);
        } else {
            let mut unpaired = 0;
            let paired = self.legacy.push(is_gyroscope, frame, counts, &mut unpaired);
            if unpaired > 0 {
                frame.faults(Counter::Unpaired, unpaired);
                self.gap = true;
            }
            let Paired::With(t, kind, [acceleration, rate]) = paired else {
                return;
            };
            set(false, acceleration);
            set(true, rate);
            (acquired, stamp) = (t, kind);
        }
        let stamped =
            StampedReading::new(0, frame, Quality::GOOD, Reading::Imu(imu)).at(acquired, stamp);
        self.add(stamped, frame, session);
    }
}

/// Three signed 16-bit numbers at `at`.
fn vector(data: &[u8], at: usize) -> [i16; 3] {
    [
        bytes::i16_le(data, at),
        bytes::i16_le(data, at + 2),
        bytes::i16_le(data, at + 4),
    ]
}

impl Driver for IcubImuOptions {
    const NAME: &'static str = "icub_imu";

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Imu)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let plan = ImuKeys::new(spec, self)?;
        let timing = icub::timing(self.power_on_silence_ms)?;
        let is_legacy = plan.legacy != Legacy::None;
        let kinds: &[u8] = if is_legacy {
            &[kind::LEGACY_ACCELEROMETER, kind::LEGACY_GYROSCOPE]
        } else {
            &[kind::TRIPLE, kind::QUATERNION, kind::STATUS]
        };
        let watched = icub::stream(
            class::PERIODIC_INERTIAL,
            plan.address,
            *kinds.first().unwrap_or(&kind::TRIPLE),
        );
        let mut bringup = Bringup::new(spec, spec.mode, timing, watched);
        let id = icub::to_board(class::POLLING_ANALOG, plan.address);
        let mut claims = icub::claims(class::PERIODIC_INERTIAL, plan.address, kinds);
        if is_legacy {
            bringup.start_with(
                id,
                &[command::ACC_GYRO_SETUP, plan.legacy_mask, plan.period_ms],
            );
            bringup.stop_with(id, &[command::ACC_GYRO_SETUP, 0, 0]);
        } else {
            bringup.start_with(id, &[command::IMU_TRANSMIT, plan.period_ms]);
            bringup.stop_with(id, &[command::IMU_TRANSMIT, 0]);
            claims.push(Claim::shared(icub::to_host(
                class::POLLING_ANALOG,
                plan.address,
            )));
        }
        let setting = Setting {
            set: Frame::new(id, &plan.configuration),
            get: Frame::new(id, &[command::IMU_CONFIG_GET]),
            // Mask, mode and orientation; the rest is unused.
            compared: 1..5,
        };
        let period = Nanos::from_millis(i64::from(plan.period_ms));
        // Legacy boards have no such configuration.
        let configure = Configure::new(spec, (!is_legacy).then_some(setting), Timing::USUAL);
        let this = ImuDevice {
            acquisition: Acquisition::NONE,
            sequence: None,
            may_jump: Nanos::MIN,
            not_calibrated: false,
            // A BNO055 board sends the accelerometer first; the order of an mtb is not documented.
            legacy: Pairing::new(
                Limit::of_period(period),
                match plan.legacy {
                    Legacy::Bno055 => HalfOrder::Usual,
                    _ => HalfOrder::Any,
                },
            ),
            together: Nanos(period.0 / 2),
            gap: false,
            seen: false,
            plan,
        };
        Ok(Supervised::boxed(claims, bringup, configure, this))
    }
}

impl Family for ImuDevice {
    type Questions = Configure;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session<Configure>) {
        let is_legacy = self.plan.legacy != Legacy::None;
        if let Some(stream) =
            icub::stream_type(frame.id, class::PERIODIC_INERTIAL, self.plan.address)
        {
            let expected = match stream {
                kind::LEGACY_GYROSCOPE | kind::LEGACY_ACCELEROMETER if is_legacy => 6,
                kind::TRIPLE | kind::QUATERNION | kind::STATUS if !is_legacy => 8,
                _ => return,
            };
            let Some(data) = frame.payload() else {
                return;
            };
            match stream {
                _ if data.len() != expected => frame.fault(Counter::Length),
                kind::TRIPLE => self.triple(data, frame, session),
                kind::QUATERNION => self.quaternion(data, frame, session),
                kind::STATUS => self.status(data, frame, session),
                _ => self.legacy(stream == kind::LEGACY_GYROSCOPE, data, frame, session),
            }
        } else if !is_legacy
            && frame.id == icub::to_host(class::POLLING_ANALOG, self.plan.address)
            && let Some(data) = frame.payload()
        {
            match data.first() {
                Some(&command::IMU_CONFIG_GET) => {
                    session.questions.answer(data, frame);
                }
                // Answers to other questions are for other devices.
                Some(_) => {}
                None => frame.fault(Counter::Length),
            }
        }
    }

    fn on_sent(&mut self, _frame: &Frame, outcome: Result<Nanos, NotSent>) {
        // It takes the command within the time of an answer, and sends a period later.
        if let Ok(t) = outcome {
            self.may_jump = t + Timing::USUAL.answer_timeout + self.together + self.together;
        }
    }

    fn reset(&mut self) {
        self.acquisition.open = false;
        self.sequence = None;
        self.not_calibrated = false;
        self.legacy.reset();
    }
}
