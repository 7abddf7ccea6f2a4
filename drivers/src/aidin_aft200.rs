//! The driver `aidin_aft200`: AIDIN AFT200 force/torque sensors.
//! What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/aidin_aft200.md")]

#[cfg(feature = "boards")]
mod board;
#[cfg(feature = "recognise")]
mod recognise;

use crate::bringup::{Bringup, NoInquiry, Timing};
use crate::family::{Family, Session, Supervised};
use crate::pairing::{HalfOrder, Limit, Paired, Pairing};
use crate::received::Received;
use crate::{Claim, Device, Driver, Id, OutputInfo, Spec, SpecError, StampedReading, keys, wrench};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Counter, Kind, Nanos, Quality, Reading, Wrench};
use serde::Deserialize;

/// The identifier of all sensors' commands.
const COMMAND: Id = Id::standard(0x102);
/// Commands: the second byte.
mod command {
    pub(super) const TRANSMIT: u8 = 0x03;
    pub(super) const PERIOD: u8 = 0x05;
}
/// The argument of TRANSMIT: continuously.
const CONTINUOUSLY: u8 = 1;
/// One step, and the value of code 0 \[N\].
const NEWTON: (f64, f64) = (0.01, -300.0);
/// One step, and the value of code 0 \[Nm\].
const NEWTON_METRE: (f64, f64) = (0.002, -50.0);

/// What a sensor measures \[N, Nm\]: an AFT200-D80 200 N and 15 Nm.
const FULL_SCALE: (f64, f64) = (200.0, 15.0);

/// The keys of `driver = "aidin_aft200"`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct AidinAft200Options {
    /// Period \[ms\], 1 to 65; default 10.
    pub period_ms: u32,
    /// Identifier of the force; default 1.
    pub id_force: u16,
    /// Identifier of the torque; default 2.
    pub id_torque: u16,
}

impl Default for AidinAft200Options {
    fn default() -> Self {
        Self {
            period_ms: 10,
            id_force: 1,
            id_torque: 2,
        }
    }
}

impl AidinAft200Options {
    fn period(&self) -> Result<Nanos, SpecError> {
        keys::ms(
            "period_ms",
            self.period_ms,
            1..=65,
            "an integer from 1 to 65",
        )
    }

    /// The identifiers of force and torque.
    fn ids(&self) -> Result<[Id; 2], SpecError> {
        let expected = "from 0 to 0x7FF";
        let force = keys::id("id_force", self.id_force, 0..=0x7FF, expected)?;
        let torque = keys::id("id_torque", self.id_torque, 0..=0x7FF, expected)?;
        if force == torque {
            let expected = "another identifier than id_force";
            return Err(SpecError::keys("id_torque", expected));
        }
        Ok([force, torque])
    }
}

/// The number of the sensor. FF in its place is a command to all sensors.
fn number(spec: &Spec) -> Result<u8, SpecError> {
    keys::address(spec, 1..=254)
}

impl Driver for AidinAft200Options {
    const NAME: &'static str = "aidin_aft200";
    const ADDRESS: Option<u32> = Some(1);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let number = number(spec)?;
        let (ids, period) = (self.ids()?, self.period()?);
        let [force, _] = ids;
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // at most 65000
        let [high, low] = ((period.0 / 1000) as u16).to_be_bytes();
        let mut bringup = Bringup::new(spec, spec.mode, Timing::USUAL, force);
        bringup.start_with(COMMAND, &[number, command::PERIOD, high, low, 0, 0, 0, 0]);
        let start = [number, command::TRANSMIT, CONTINUOUSLY, 0, 0, 0, 0, 0];
        bringup.start_with(COMMAND, &start);
        let pairing = Pairing::new(Limit::of_period(period), HalfOrder::Usual);
        let claims = ids.map(Claim::exclusive);
        let this = Aft { ids, pairing };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }
}

/// The host's side of a sensor.
#[derive(Debug)]
struct Aft {
    ids: [Id; 2],
    pairing: Pairing<[u8; 6]>,
}

/// The values of one frame, and `quality` with the saturation of the axes `axis..axis + 3`.
fn axes(half: [u8; 6], scale: (f64, f64), axis: u32, quality: &mut Quality) -> [f64; 3] {
    let [a, b, c, d, e, f] = half;
    let counts = [[a, b], [c, d], [e, f]].map(u16::from_be_bytes);
    for (axis, count) in (axis..).zip(counts) {
        *quality = quality.with_saturation(axis, wrench::at_end(count, 0, u16::MAX));
    }
    let (step, least) = scale;
    counts.map(|count| f64::from(count) * step + least)
}

impl Family for Aft {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        let [force, torque] = self.ids;
        let second = frame.id == torque;
        if !second && frame.id != force {
            return;
        }
        let Some(data) = frame.payload() else {
            return;
        };
        let Some(&half) = data.first_chunk() else {
            return frame.fault(Counter::Length);
        };
        let mut unpaired = 0;
        let paired = self.pairing.push(second, frame, half, &mut unpaired);
        session.lost(Counter::Unpaired, unpaired, frame);
        let Paired::With(acquired, stamp, [first, second]) = paired else {
            return;
        };
        let mut quality = Quality::GOOD;
        let force = axes(first, NEWTON, 0, &mut quality);
        let torque = axes(second, NEWTON_METRE, 3, &mut quality);
        let stamped =
            StampedReading::new(0, frame, quality, Reading::Wrench(Wrench { force, torque }))
                .at(acquired, stamp);
        session.add(stamped, frame);
    }

    fn reset(&mut self) {
        self.pairing.reset();
    }
}
