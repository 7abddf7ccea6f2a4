//! The driver `icub_skin`: iCub skin. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/icub_skin.md")]

#[cfg(feature = "boards")]
mod board;
#[cfg(feature = "recognise")]
mod recognise;

use crate::bringup::{Bringup, NoInquiry};
use crate::family::{Family, Session, Supervised};
use crate::icub::{self, OutputGaps, class, command};
use crate::pairing::{HalfOrder, Limit, Paired, Pairing};
use crate::received::Received;
use crate::{Claim, Device, Driver, OutputInfo, Spec, SpecError, StampedReading};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Counter, Kind, Nanos, Quality, Reading, Skin};
use serde::Deserialize;

/// The first byte of each frame of a triangle.
const FIRST: u8 = 0x40;
const SECOND: u8 = 0xC0;
/// The taxels that measure the temperature.
const THERMAL: [usize; 2] = [6, 10];
const TRIANGLES: usize = 16;
/// The shift and the offset that icub-main sends.
const SHIFT: u8 = 2;
const OFFSET: u16 = 0x2200;
/// The flags of the second frame.
const FAULTS: u8 = 0b11;

/// How the board compensates its taxels.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum Compensation {
    /// By the thermal taxels.
    #[default]
    Temperature,
    /// As palms and fingertips need it.
    Palm,
    /// Not at all.
    None,
    /// Not at all, and unscaled.
    Raw,
}

impl Compensation {
    const fn code(self) -> u8 {
        match self {
            Self::Temperature => 0,
            Self::Palm => 1,
            Self::None => 2,
            Self::Raw => 7,
        }
    }
}

/// The keys of `driver = "icub_skin"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct IcubSkinOptions {
    /// Period \[ms\], 1 to 255; default 50.
    pub period_ms: u32,
    /// First and last triangle; default 0 and 15.
    pub triangles: [u8; 2],
    /// A taxel's byte without load; default 245.
    pub no_load: u8,
    /// Compensation; default by temperature.
    pub compensation: Compensation,
    /// Longest time from the first to the second frame \[ms\].
    pub pair_timeout_ms: Option<f64>,
    /// Silence kept after power-on \[ms\]; default 0.
    pub power_on_silence_ms: u32,
}

impl Default for IcubSkinOptions {
    fn default() -> Self {
        Self {
            period_ms: 50,
            triangles: [0, 15],
            no_load: 245,
            compensation: Compensation::Temperature,
            pair_timeout_ms: None,
            power_on_silence_ms: 0,
        }
    }
}

impl IcubSkinOptions {
    fn check(&self) -> Result<(), SpecError> {
        match self.triangles {
            [first, last] if first <= last && usize::from(last) < TRIANGLES => Ok(()),
            _ => {
                let expected = "the first and the last of 0 to 15";
                Err(SpecError::keys("triangles", expected))
            }
        }
    }
}

impl Driver for IcubSkinOptions {
    const NAME: &'static str = "icub_skin";

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Skin)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        self.check()?;
        let address = icub::address(spec)?;
        let period = icub::period_ms("period_ms", self.period_ms)?;
        let limit = match self.pair_timeout_ms {
            None => Limit::of_period(Nanos::from_millis(i64::from(period))),
            Some(ms) if ms > 0.0 && ms <= 1000.0 => Limit::fixed(Nanos::from_seconds(ms * 1e-3)),
            Some(value) => {
                let expected = "above 0, at most 1000";
                return Err(SpecError::key("pair_timeout_ms", value, expected));
            }
        };
        let timing = icub::timing(self.power_on_silence_ms)?;
        let [first, last] = self.triangles;
        let watched = icub::stream(class::PERIODIC_SKIN, address, first);
        let mut bringup = Bringup::new(spec, spec.mode, timing, watched);
        let id = icub::to_board(class::POLLING_ANALOG, address);
        let compensation = self.compensation.code();
        bringup.start_with(
            id,
            &[command::SKIN_CONFIG, compensation, period, self.no_load],
        );
        let [low, high] = OFFSET.to_le_bytes();
        bringup.start_with(
            id,
            &[command::SKIN_TRIANGLES, first, last, SHIFT, 1, low, high],
        );
        bringup.start_with(id, &[command::SET_TXMODE, 0]);
        bringup.stop_with(id, &[command::SET_TXMODE, 1]);
        let claim = Claim {
            mask: !0xF,
            ..Claim::exclusive(icub::stream(class::PERIODIC_SKIN, address, 0))
        };
        let this = SkinPatch {
            address,
            no_load: self.no_load,
            triangles: self.triangles,
            pairing: core::array::from_fn(|_| Pairing::new(limit, HalfOrder::Usual)),
            gaps: OutputGaps::default(),
        };
        Ok(Supervised::boxed([claim], bringup, NoInquiry, this))
    }
}

/// The host's side of a skin board.
#[derive(Debug)]
struct SkinPatch {
    address: u8,
    no_load: u8,
    triangles: [u8; 2],
    pairing: [Pairing<[u8; 7]>; TRIANGLES],
    /// Of the triangles.
    gaps: OutputGaps,
}

impl SkinPatch {
    /// The reading of both frames' bytes.
    fn skin(&self, triangle: u8, first: [u8; 7], second: [u8; 7]) -> (Skin, Quality) {
        let [p7, p8, p9, p10, p11, high, low] = second;
        let out_of_range = u16::from(high) << 4 | u16::from(low >> 4);
        let bytes = first.into_iter().chain([p7, p8, p9, p10, p11]);
        let mut taxels = [f64::NAN; 12];
        for (number, (taxel, byte)) in taxels.iter_mut().zip(bytes).enumerate() {
            if out_of_range >> number & 1 == 0 && !THERMAL.contains(&number) {
                *taxel = f64::from(self.no_load) - f64::from(byte);
            }
        }
        let quality = match low & FAULTS {
            0 => Quality::GOOD,
            _ => Quality::DEVICE_FAULT,
        };
        let triangle = u32::from(triangle);
        (Skin { triangle, taxels }, quality)
    }
}

impl Family for SkinPatch {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        let stream = icub::stream_type(frame.id, class::PERIODIC_SKIN, self.address);
        let Some(triangle) = stream else { return };
        let Some(data) = frame.payload() else {
            return;
        };
        let &[kind, ref rest @ ..] = data else {
            return frame.fault(Counter::Length);
        };
        let Ok(half) = <[u8; 7]>::try_from(rest) else {
            return frame.fault(Counter::Length);
        };
        let [first, last] = self.triangles;
        if !matches!(kind, FIRST | SECOND) || !(first..=last).contains(&triangle) {
            return frame.fault(Counter::Value);
        }
        let Some(pairing) = self.pairing.get_mut(usize::from(triangle)) else {
            return;
        };
        let mut unpaired = 0;
        let paired = pairing.push(kind == SECOND, frame, half, &mut unpaired);
        if unpaired > 0 {
            self.gaps.one(triangle);
            frame.faults(Counter::Unpaired, unpaired);
        }
        let Paired::With(acquired, stamp, [first, second]) = paired else {
            return;
        };
        if session.bringup.reading(frame.t) {
            self.gaps.all();
        }
        let (skin, mut quality) = self.skin(triangle, first, second);
        if quality.contains(Quality::DEVICE_FAULT) {
            frame.fault(Counter::DeviceFault);
        }
        quality |= self.gaps.take(triangle);
        let stamped =
            StampedReading::new(0, frame, quality, Reading::Skin(skin)).at(acquired, stamp);
        frame.push(stamped);
    }

    fn reset(&mut self) {
        self.pairing.iter_mut().for_each(Pairing::reset);
    }
}
