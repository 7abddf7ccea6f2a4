//! The sensor's own side.

use super::frames::{
    ACCELERATION, ANGLE, OpenImuQuantity, RATE, RATE_LIMIT, REPETITION, group_and_source, merit,
    period, pgn, pitch_and_roll,
};
use super::options::{OpenImuKeys, OpenImuOptions};
use crate::{Board, EncodeError, Format, Frame, Frames, Mode, Simulate, Spec, SpecError, board};
use alloc::boxed::Box;
use proprio_topics::{Imu, Nanos, Quality, Reading, Saturation};

/// The sensor's own side. From power-on it sends the quantities of its keys at 100 Hz.
#[derive(Debug)]
struct OpenImuBoard {
    plan: OpenImuKeys,
    /// The messages to send, as bits of the command.
    types: u8,
    /// 0: quiet.
    divider: u8,
}

impl OpenImuBoard {
    /// Six bytes of three values in x, y, z.
    fn six(&self, counts: [u32; 3]) -> [u8; 6] {
        let [[a, b, ..], [c, d, ..], [e, f, ..]] =
            (self.plan.axes.exchange(counts)).map(u32::to_le_bytes);
        [a, b, c, d, e, f]
    }

    /// The payload of the message that holds `quantity`.
    fn payload(
        &self,
        quantity: OpenImuQuantity,
        imu: &Imu,
        quality: Quality,
    ) -> Result<[u8; 8], EncodeError> {
        let said = if quality.contains(Quality::DEVICE_FAULT) {
            merit::ERROR
        } else {
            merit::NOT_KNOWN
        };
        let merits = |bits: &[u8]| bits.iter().fold(0, |all, bit| all | said << bit);
        let [a, b, c, d, e, f, merits] = match quantity {
            OpenImuQuantity::Orientation => {
                board::finite(&imu.orientation)?;
                let [[a, b, c, _], [d, e, f, _]] =
                    pitch_and_roll(imu.orientation).map(|angle| ANGLE.count(angle).to_le_bytes());
                [a, b, c, d, e, f, merits(&merit::OF_ANGLES)]
            }
            OpenImuQuantity::Acceleration => {
                board::finite(&imu.proper_acceleration)?;
                let turned = self.plan.upright.turn(imu.proper_acceleration);
                let counts = turned.map(|value| ACCELERATION.count(value));
                let [a, b, c, d, e, f] = self.six(counts);
                [a, b, c, d, e, f, merits(&merit::OF_AXES) | REPETITION]
            }
            OpenImuQuantity::AngularVelocity => {
                board::finite(&imu.angular_velocity)?;
                let mut counts = imu
                    .angular_velocity
                    .map(|value| RATE.count(value).min(RATE_LIMIT));
                for (axis, count) in (3..).zip(&mut counts) {
                    match quality.saturation(axis) {
                        Saturation::None => {}
                        Saturation::Low => *count = 0,
                        Saturation::High => *count = RATE_LIMIT,
                    }
                }
                let [a, b, c, d, e, f] = self.six(counts);
                [a, b, c, d, e, f, merits(&merit::OF_AXES)]
            }
        };
        Ok([a, b, c, d, e, f, merits, 0])
    }
}

impl Simulate for OpenImuOptions {
    /// A sensor after power-on; in [`Mode::Listen`] another program has set its rate already.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        let plan = OpenImuKeys::new(spec, self)?;
        Ok(Box::new(OpenImuBoard {
            types: plan.types(),
            divider: match spec.mode {
                Mode::Supervise => 1,
                Mode::Listen => plan.divider,
            },
            plan,
        }))
    }
}

impl Board for OpenImuBoard {
    fn on_frame(&mut self, frame: &Frame, _out: &mut Frames) {
        let (Some((pgn, _)), Format::Classic) = (group_and_source(frame.id), frame.format) else {
            return;
        };
        match (pgn, frame.data()) {
            (pgn::PACKET_TYPE, &[to, types, ..]) if to == self.plan.address => self.types = types,
            (pgn::PACKET_RATE, &[to, by, ..]) if to == self.plan.address => self.divider = by,
            _ => {}
        }
    }

    fn period(&self) -> Option<Nanos> {
        (self.divider > 0).then_some(period(self.divider))
    }

    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let imu = board::only_imu(output, reading)?;
        let mut sent = Frames::new();
        for quantity in OpenImuQuantity::ALL {
            if self.types & quantity.pgn_priority_bit().2 != 0 {
                let payload = self.payload(quantity, imu, quality)?;
                let _ = sent.try_push(Frame::new(self.plan.message(quantity), &payload));
            }
        }
        for frame in sent {
            let _ = out.try_push(frame);
        }
        Ok(())
    }
}
