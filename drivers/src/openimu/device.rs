//! The host's side of a sensor. It sets its messages and their rate, and combines those of each
//! period into a reading.

use super::frames::{
    ACCELERATION, ANGLE, ANY_PRIORITY, COMMANDS, DELIVERED, HOST, OpenImuQuantity, RATE,
    RATE_LIMIT, group_and_source, identifier, merit, period, pgn, quaternion,
};
use super::options::{OpenImuKeys, OpenImuOptions};
use crate::bringup::{Bringup, NoInquiry, Timing};
use crate::family::{Family, Session, Supervised};
use crate::group::FrameGroup;
use crate::pairing::Limit;
use crate::received::Received;
use crate::{Claim, Device, Driver, OutputInfo, Spec, SpecError, StampedReading, bytes};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Counter, Imu, Kind, Nanos, Quality, Reading, Saturation};

/// How long the host waits for these sensors, which answer nothing.
const TIMING: Timing = Timing {
    answer_timeout: Nanos::from_millis(100),
    attempts: 5,
    // A period of half a second, and time to claim an address.
    start: Nanos::from_millis(1000),
    start_most: Nanos::from_millis(2000),
    ..Timing::LISTENED
};

/// What the messages of a period hold.
#[derive(Debug, Clone, Copy)]
struct OpenImuSample {
    imu: Imu,
    quality: Quality,
}

impl OpenImuSample {
    const EMPTY: Self = Self {
        imu: Imu::ABSENT,
        quality: Quality::GOOD,
    };

    /// What `data` of a message with `quantity` holds; `None` if a value is none.
    fn of(plan: &OpenImuKeys, quantity: OpenImuQuantity, data: &[u8; 8]) -> Option<Self> {
        let mut this = Self::EMPTY;
        let merits = data[6];
        let is_wrong = |bit: &u8| merits >> bit & 3 == merit::ERROR;
        let counts = [0, 2, 4].map(|at| u32::from(bytes::u16_le(data, at)));
        let mut any_wrong = false;
        match quantity {
            OpenImuQuantity::Orientation => {
                let angle = |at| ANGLE.value(bytes::u32_le(data, at) & 0xFF_FFFF);
                this.imu.orientation = quaternion(angle(0)?, angle(3)?);
                any_wrong = merit::OF_ANGLES.iter().any(is_wrong);
            }
            OpenImuQuantity::Acceleration => {
                let values = all(counts.map(|count| ACCELERATION.value(count)))?;
                this.imu.proper_acceleration = plan.upright.turn(plan.axes.exchange(values));
                any_wrong = merit::OF_AXES.iter().any(is_wrong);
            }
            OpenImuQuantity::AngularVelocity => {
                let values = all(counts.map(|count| RATE.value(count)))?;
                this.imu.angular_velocity = plan.axes.exchange(values);
                let bits = plan.axes.exchange(merit::OF_AXES);
                let counts = plan.axes.exchange(counts);
                for (axis, (count, bit)) in (3..).zip(counts.into_iter().zip(&bits)) {
                    let end = match count {
                        0 => Saturation::Low,
                        RATE_LIMIT.. => Saturation::High,
                        _ => Saturation::None,
                    };
                    this.quality = this.quality.with_saturation(axis, end);
                    any_wrong |= end == Saturation::None && is_wrong(bit);
                }
            }
        }
        if any_wrong {
            this.quality |= Quality::DEVICE_FAULT;
        }
        Some(this)
    }

    /// Adds `part`, which holds `quantity`.
    fn add(&mut self, quantity: OpenImuQuantity, part: Self) {
        self.quality |= part.quality;
        let (to, from) = (&mut self.imu, part.imu);
        match quantity {
            OpenImuQuantity::Orientation => to.orientation = from.orientation,
            OpenImuQuantity::Acceleration => to.proper_acceleration = from.proper_acceleration,
            OpenImuQuantity::AngularVelocity => to.angular_velocity = from.angular_velocity,
        }
    }
}

/// Three values, if none of them is absent.
const fn all(values: [Option<f64>; 3]) -> Option<[f64; 3]> {
    match values {
        [Some(a), Some(b), Some(c)] => Some([a, b, c]),
        _ => None,
    }
}

/// The host's side of a sensor.
#[derive(Debug)]
pub(super) struct OpenImuSensor {
    plan: OpenImuKeys,
    group: FrameGroup<OpenImuSample>,
}

impl Driver for OpenImuOptions {
    const NAME: &'static str = "openimu";
    const ADDRESS: Option<u32> = Some(DELIVERED);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Imu)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let plan = OpenImuKeys::new(spec, self)?;
        let watched = plan
            .quantities
            .first()
            .unwrap_or(&OpenImuQuantity::Acceleration);
        let mut bringup = Bringup::new(spec, spec.mode, TIMING, plan.message(*watched));
        let command = |pgn| identifier(COMMANDS, pgn, HOST);
        let types = [plan.address, plan.types(), 0, 0, 0];
        bringup.start_with(command(pgn::PACKET_TYPE), &types);
        bringup.start_with(command(pgn::PACKET_RATE), &[plan.address, plan.divider]);
        bringup.stop_with(command(pgn::PACKET_RATE), &[plan.address, 0]);
        let claims = OpenImuQuantity::ALL.map(|quantity| Claim {
            mask: !ANY_PRIORITY,
            ..Claim::exclusive(plan.message(quantity))
        });
        let limit = Limit::of_period(period(plan.divider));
        let this = OpenImuSensor {
            group: FrameGroup::new(plan.quantities.len(), limit),
            plan,
        };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }
}

impl Family for OpenImuSensor {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        let Some((pgn, source)) = group_and_source(frame.id) else {
            return;
        };
        let mut numbered = (0..).zip(&self.plan.quantities);
        let found = numbered.find(|(_, quantity)| quantity.pgn_priority_bit().0 == pgn);
        let Some((position, &quantity)) = found.filter(|_| source == self.plan.address) else {
            return;
        };
        let data = frame.payload_of(8);
        let Some(data) = data.and_then(|data| data.first_chunk::<8>()) else {
            return;
        };
        let Some(part) = OpenImuSample::of(&self.plan, quantity, data) else {
            return frame.fault(Counter::Value);
        };
        let mut dropped = 0;
        let add = |sample: &mut OpenImuSample| sample.add(quantity, part);
        let whole = (self.group).push(position, frame, OpenImuSample::EMPTY, add, &mut dropped);
        session.lost(Counter::Unpaired, dropped, frame);
        let Some(whole) = whole else { return };
        let OpenImuSample { imu, quality } = whole.content;
        let stamped = StampedReading::new(0, frame, quality, Reading::Imu(imu))
            .at(whole.acquired, whole.stamp);
        session.add(stamped, frame);
    }

    fn reset(&mut self) {
        self.group.reset();
    }
}
