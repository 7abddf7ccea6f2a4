//! The driver `icub_skin`: iCub skin. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/icub_skin.md")]

use crate::bringup::{Bringup, NoInquiry};
use crate::bytes;
use crate::family::{Family, Link, Supervised};
use crate::icub::{self, class, command};
use crate::pairing::{Limit, Order, Paired, Pairing};
use crate::recognise::{Finding, Key, Traffic};
use crate::{
    Board, Claim, Decoded, Device, Driver, EncodeError, Frame, Frames, Id, Mode, Output,
    OutputInfo, Spec, SpecError,
};
use alloc::boxed::Box;
use alloc::format;
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
            _ => Err(SpecError::Keys {
                key: "triangles",
                expected: "the first and the last of 0 to 15",
            }),
        }
    }
}

impl Driver for IcubSkinOptions {
    const NAME: &'static str = "icub_skin";

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Skin)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Patch::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(SkinBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        // An mtb4 may be an IMU alone.
        let maybe = [icub::board::MTB4, icub::board::MTB4W, icub::board::MTB4C];
        let types = [&[icub::board::MTB][..], &maybe].concat();
        icub::recognise(seen, Self::NAME, &types, &maybe, |evidence, address, _| {
            let mut keys: Vec<Key> = Vec::new();
            let mut triangles: Option<(u8, u8)> = None;
            for triangle in 0..16 {
                let id = icub::stream(class::PERIODIC_SKIN, address, triangle);
                let stream = evidence.sends(id, |frame| {
                    matches!(*frame.data(), [FIRST | SECOND, _, _, _, _, _, _, _])
                });
                let Some(stream) = stream else { continue };
                let first = |frame: &Frame| frame.data().first() == Some(&FIRST);
                if triangles.is_none() {
                    keys.extend(Key::period_ms(stream.period_of(first), 1, 255));
                }
                triangles = Some((triangles.map_or(triangle, |(first, _)| first), triangle));
            }
            if let Some((first, last)) = triangles {
                keys.push(Key::new("triangles", format!("[{first}, {last}]")));
            }
            (keys, Vec::new())
        })
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}

/// The host's side of a skin board.
#[derive(Debug)]
struct Patch {
    address: u8,
    no_load: u8,
    triangles: [u8; 2],
    pairing: [Pairing<[u8; 7]>; TRIANGLES],
    /// Triangles whose next reading follows a gap, one bit each.
    gap: u16,
    /// Triangles that have been read, one bit each.
    seen: u16,
}

impl Patch {
    fn device(spec: &Spec, options: &IcubSkinOptions) -> Result<Box<dyn Device>, SpecError> {
        options.check()?;
        let address = icub::address(spec)?;
        let period = icub::period_ms("period_ms", options.period_ms)?;
        let limit = match options.pair_timeout_ms {
            None => Limit::of_period(Nanos::from_millis(i64::from(period))),
            Some(ms) if ms > 0.0 && ms <= 1000.0 => Limit::fixed(Nanos::from_seconds(ms * 1e-3)),
            Some(value) => {
                return Err(SpecError::Key {
                    key: "pair_timeout_ms",
                    value,
                    expected: "above 0, at most 1000",
                });
            }
        };
        let timing = icub::timing(options.power_on_silence_ms)?;
        let [first, last] = options.triangles;
        let watched = icub::stream(class::PERIODIC_SKIN, address, first);
        let mut bringup = Bringup::new(spec, spec.mode, timing, watched);
        let id = icub::to_board(class::POLLING_ANALOG, address);
        let compensation = options.compensation.code();
        bringup.start_with(
            id,
            &[command::SKIN_CONFIG, compensation, period, options.no_load],
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
        let this = Self {
            address,
            no_load: options.no_load,
            triangles: options.triangles,
            pairing: core::array::from_fn(|_| Pairing::new(limit, Order::Usual)),
            gap: 0,
            seen: 0,
        };
        Ok(Supervised::boxed([claim], bringup, NoInquiry, this))
    }

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

impl Family for Patch {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &Frame, link: &mut Link<NoInquiry>, out: &mut Decoded) {
        let stream = icub::stream_type(frame.id, class::PERIODIC_SKIN, self.address);
        let Some(triangle) = stream else { return };
        let Some(data) = bytes::payload(frame, out) else {
            return;
        };
        let &[kind, ref rest @ ..] = data else {
            return out.fault(Counter::Length, 1, frame.id);
        };
        let Ok(half) = <[u8; 7]>::try_from(rest) else {
            return out.fault(Counter::Length, 1, frame.id);
        };
        let [first, last] = self.triangles;
        if !matches!(kind, FIRST | SECOND) || !(first..=last).contains(&triangle) {
            return out.fault(Counter::Value, 1, frame.id);
        }
        let Some(pairing) = self.pairing.get_mut(usize::from(triangle)) else {
            return;
        };
        let mut unpaired = 0;
        let paired = pairing.push(kind == SECOND, frame, half, &mut unpaired);
        let bit = 1 << triangle;
        if unpaired > 0 {
            self.gap |= bit & self.seen;
            out.fault(Counter::Unpaired, unpaired, frame.id);
        }
        let Paired::With(acquired, stamp, [first, second]) = paired else {
            return;
        };
        if link.bringup.reading(frame.t) {
            self.gap = self.seen;
        }
        let (skin, mut quality) = self.skin(triangle, first, second);
        if quality.contains(Quality::DEVICE_FAULT) {
            out.fault(Counter::DeviceFault, 1, frame.id);
        }
        if self.gap & bit != 0 {
            quality |= Quality::GAP_BEFORE;
        }
        self.gap &= !bit;
        self.seen |= bit;
        let output = Output {
            acquired,
            stamp,
            ..Output::new(0, frame, quality, Reading::Skin(skin))
        };
        out.push(output, frame.id);
    }

    fn reset(&mut self) {
        self.pairing.iter_mut().for_each(Pairing::reset);
    }
}

/// The board's own side. It sends the triangles that it is asked to encode.
#[derive(Debug)]
pub struct SkinBoard {
    address: u8,
    period: Nanos,
    no_load: u8,
    triangles: [u8; 2],
    streaming: bool,
}

impl SkinBoard {
    /// A board after power-on; in [`Mode::Listen`] another program has already started it.
    ///
    /// # Errors
    /// [`SpecError`]: an address outside 1 to 14, a key out of range.
    pub fn new(spec: &Spec, options: &IcubSkinOptions) -> Result<Self, SpecError> {
        options.check()?;
        let ms = icub::period_ms("period_ms", options.period_ms)?;
        Ok(Self {
            address: icub::address(spec)?,
            period: Nanos::from_millis(i64::from(ms)),
            no_load: options.no_load,
            triangles: options.triangles,
            streaming: spec.mode == Mode::Listen,
        })
    }

    fn byte(&self, taxel: f64) -> u8 {
        let raw = bytes::quantise(f64::from(self.no_load) - taxel, 1.0, 0, 255);
        u8::try_from(raw).unwrap_or(u8::MAX)
    }
}

impl Board for SkinBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        icub::answer_management(
            frame,
            class::POLLING_ANALOG,
            self.address,
            icub::board::MTB,
            out,
        );
        match icub::command_for(frame, class::POLLING_ANALOG, self.address) {
            Some(&[command::SKIN_CONFIG, _, ms, no_load]) if ms > 0 => {
                self.period = Nanos::from_millis(i64::from(ms));
                self.no_load = no_load;
            }
            Some(&[command::SKIN_TRIANGLES, first, last, ..]) => self.triangles = [first, last],
            Some(&[command::SET_TXMODE, mode]) => self.streaming = mode == 0,
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
        let Reading::Skin(skin) = reading else {
            return Err(EncodeError::Kind);
        };
        let [first, last] = self.triangles;
        let triangle = u8::try_from(skin.triangle).unwrap_or(u8::MAX);
        if output != 0 || !(first..=last).contains(&triangle) {
            return Err(EncodeError::Output(output));
        }
        let mut out_of_range = 0_u16;
        let mut bytes = [self.no_load; 12];
        for (number, (byte, taxel)) in bytes.iter_mut().zip(skin.taxels).enumerate() {
            if taxel.is_finite() {
                *byte = self.byte(taxel);
            } else if !THERMAL.contains(&number) {
                out_of_range |= 1 << number;
            }
        }
        let [p0, p1, p2, p3, p4, p5, p6, p7, p8, p9, p10, p11] = bytes;
        let [high, low] = (out_of_range << 4).to_be_bytes();
        let low = low | u8::from(quality.contains(Quality::DEVICE_FAULT));
        let id: Id = icub::stream(class::PERIODIC_SKIN, self.address, triangle);
        for data in [
            [FIRST, p0, p1, p2, p3, p4, p5, p6],
            [SECOND, p7, p8, p9, p10, p11, high, low],
        ] {
            let _ = out.try_push(Frame::new(id, &data));
        }
        Ok(())
    }
}
