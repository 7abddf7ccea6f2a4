//! The host's side of an MTi. It combines the messages of each sample into a reading.

use super::frames::{ACCELERATION_LSB, BUFFER_OVERFLOW, MtiMessage, RATE_LSB, status};
use super::options::{MtiKeys, XsensMtiOptions};
use crate::bringup::{Bringup, NoInquiry, Timing};
use crate::family::{Family, Session, Supervised};
use crate::group::{FrameGroup, PartialReading};
use crate::pairing::Limit;
use crate::received::Received;
use crate::{Claim, Device, Driver, Mode, OutputInfo, Spec, SpecError, StampedReading, bytes};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Counter, Imu, Kind, Nanos, Quality, Reading, Saturation};

/// What the messages of a sample hold.
#[derive(Debug, Clone, Copy)]
struct MtiSample {
    ticks: u32,
    counter: u16,
    status: u32,
    imu: Imu,
}

impl MtiSample {
    const EMPTY: Self = Self {
        ticks: 0,
        counter: 0,
        status: 0,
        imu: Imu::ABSENT,
    };

    /// Adds what `message` holds.
    fn add(&mut self, plan: &MtiKeys, message: MtiMessage, data: &[u8]) {
        let vector = |lsb: f64| [0, 2, 4].map(|at| f64::from(bytes::i16_be(data, at)) * lsb);
        let imu = &mut self.imu;
        match message {
            MtiMessage::Error => {}
            MtiMessage::SampleTime => self.ticks = bytes::u32_be(data, 0),
            MtiMessage::GroupCounter => self.counter = bytes::u16_be(data, 0),
            MtiMessage::Status => self.status = bytes::u32_be(data, 0),
            MtiMessage::Orientation => {
                imu.orientation =
                    [0, 2, 4, 6].map(|at| f64::from(bytes::i16_be(data, at)) * plan.quaternion_lsb);
            }
            MtiMessage::AngularVelocity => imu.angular_velocity = vector(RATE_LSB),
            MtiMessage::Acceleration => imu.proper_acceleration = vector(ACCELERATION_LSB),
            MtiMessage::MagneticField => imu.magnetic_field = vector(plan.field_lsb),
        }
    }

    /// What the status word says of the sensors in use.
    fn quality(&self, plan: &MtiKeys) -> Quality {
        let mut quality = Quality::GOOD;
        if !plan.wants(MtiMessage::Status) {
            return quality;
        }
        let word = self.status;
        let invalid = word & status::FILTER_VALID == 0 && plan.wants(MtiMessage::Orientation);
        if word & status::SELF_TEST == 0 || invalid {
            quality |= Quality::DEVICE_FAULT;
        }
        let accelerometer = self.imu.proper_acceleration.into_iter();
        let gyroscope = self.imu.angular_velocity.into_iter();
        let axes = (accelerometer.map(|value| (MtiMessage::Acceleration, value)))
            .chain(gyroscope.map(|value| (MtiMessage::AngularVelocity, value)));
        for (axis, (sensor, value)) in (0..).zip(axes) {
            if plan.wants(sensor) && word >> (status::FIRST_AXIS + axis) & 1 != 0 {
                let low = value < 0.0;
                let end = if low {
                    Saturation::Low
                } else {
                    Saturation::High
                };
                quality = quality.with_saturation(axis, end);
            }
        }
        let magnetometer =
            word & status::MAGNETOMETER != 0 && plan.wants(MtiMessage::MagneticField);
        if magnetometer || (word & status::CLIPPED != 0 && word & status::AXES == 0) {
            quality |= Quality::SATURATED;
        }
        quality
    }
}

/// The host's side of an MTi.
#[derive(Debug)]
pub(super) struct Mti {
    plan: MtiKeys,
    group: FrameGroup<MtiSample>,
    /// The last reading's sample time as sent, and without overflow.
    clock: Option<(u32, Nanos)>,
    /// The last reading's counter.
    counter: Option<u16>,
}

impl Mti {
    /// The sample time in ns, without overflow. A clock that goes back has started again.
    fn time(&mut self, ticks: u32) -> Nanos {
        let since = |earlier: u32| ticks.wrapping_sub(earlier);
        let (from, passed) = match self.clock {
            Some((last, time)) if since(last) <= u32::MAX / 2 => (time, since(last)),
            _ => (Nanos::ZERO, ticks),
        };
        let time = from + Nanos(i64::from(passed) * self.plan.tick.0);
        self.clock = Some((ticks, time));
        time
    }

    /// Outputs a complete sample.
    fn add(
        &mut self,
        whole: &PartialReading<MtiSample>,
        frame: &mut Received<'_>,
        session: &mut Session,
    ) {
        let sample = &whole.content;
        let mut quality = sample.quality(&self.plan);
        if self.plan.wants(MtiMessage::GroupCounter) {
            quality |= Quality::DEVICE_COUNTER;
            let last = self.counter.replace(sample.counter);
            match last.map(|last| sample.counter.wrapping_sub(last)) {
                Some(0) => return frame.fault(Counter::Unexpected),
                Some(ahead) => session.lost(Counter::Lost, u32::from(ahead) - 1, frame),
                None => {}
            }
        }
        let device_time = if self.plan.wants(MtiMessage::SampleTime) {
            self.time(sample.ticks)
        } else {
            Nanos::MIN
        };
        let stamped = StampedReading {
            acquired: whole.acquired,
            stamp: whole.stamp,
            device_time,
            device_counter: u32::from(sample.counter),
            ..StampedReading::new(0, frame, quality, Reading::Imu(sample.imu))
        };
        session.add(stamped, frame);
    }
}

impl Driver for XsensMtiOptions {
    const NAME: &'static str = "xsens_mti";
    const ADDRESS: Option<u32> = Some(0);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Imu)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let plan = MtiKeys::new(spec, self)?;
        let watched = plan.messages.first().map_or(plan.error, |(id, _)| *id);
        let bringup = Bringup::new(spec, Mode::Listen, Timing::LISTENED, watched);
        let streams = plan.messages.iter().map(|(id, _)| *id);
        let claims: Vec<Claim> = (streams.chain([plan.error]))
            .map(Claim::exclusive)
            .collect();
        let this = Mti {
            group: FrameGroup::new(plan.messages.len(), Limit::of_period(plan.period)),
            clock: None,
            counter: None,
            plan,
        };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }
}

impl Family for Mti {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        let mut numbered = (0..).zip(&self.plan.messages);
        let found = numbered.find(|(_, (id, _))| *id == frame.id);
        let (position, message) = match found {
            Some((position, (_, message))) => (position, *message),
            None if frame.id == self.plan.error => (0, MtiMessage::Error),
            None => return,
        };
        let Some(data) = frame.payload_of(message.length()) else {
            return;
        };
        if message == MtiMessage::Error {
            if data.first() != Some(&BUFFER_OVERFLOW) {
                return frame.fault(Counter::Value);
            }
            return session.lost(Counter::DeviceFault, 1, frame);
        }
        let mut dropped = 0;
        let add = |sample: &mut MtiSample| sample.add(&self.plan, message, data);
        let whole = (self.group).push(position, frame, MtiSample::EMPTY, add, &mut dropped);
        session.lost(Counter::Unpaired, dropped, frame);
        if let Some(whole) = whole {
            self.add(&whole, frame, session);
        }
    }

    fn reset(&mut self) {
        self.group.reset();
        self.clock = None;
        self.counter = None;
    }
}
