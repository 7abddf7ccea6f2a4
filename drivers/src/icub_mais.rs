//! The driver `icub_mais`: iCub Hall sensors. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/icub_mais.md")]

use crate::bringup::{Bringup, NoInquiry};
use crate::bytes;
use crate::family::{Family, Link, Supervised};
use crate::icub::{self, class, command};
use crate::recognise::{Finding, Key, Stream, Traffic};
use crate::{
    Board, Claim, Decoded, Device, Driver, EncodeError, Frame, Frames, Mode, Output, OutputInfo,
    Outputs, Spec, SpecError,
};
use alloc::boxed::Box;
use alloc::vec::Vec;
use arrayvec::ArrayVec;
use proprio_topics::{Counter, JointState, Kind, Nanos, Quality, Reading};
use serde::Deserialize;

/// Types of the streams.
const HES0TO6: u8 = 0xC;
const HES7TO14: u8 = 0xD;
/// The first sensor of the second frame, and how many there are.
const SECOND: u8 = 7;
const SENSORS: u8 = 15;
/// 8 bits.
const RESOLUTION: u8 = 2;

/// The keys of `driver = "icub_mais"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct IcubMaisOptions {
    /// Period \[ms\], 1 to 255; default 10.
    pub period_ms: u32,
    /// Silence kept after power-on \[ms\]; default 0.
    pub power_on_silence_ms: u32,
}

impl Default for IcubMaisOptions {
    fn default() -> Self {
        Self {
            period_ms: 10,
            power_on_silence_ms: 0,
        }
    }
}

impl Driver for IcubMaisOptions {
    const NAME: &'static str = "icub_mais";

    fn outputs(&self) -> Vec<OutputInfo> {
        (0..SENSORS)
            .map(|sensor| OutputInfo::new(sensor, Kind::Joint))
            .collect()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Mais::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(MaisBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        icub::recognise(
            seen,
            Self::NAME,
            &[icub::board::MAIS],
            &[],
            |evidence, address, _| {
                let id = |kind| icub::stream(class::PERIODIC_ANALOG, address, kind);
                let first = evidence.sends_length(id(HES0TO6), usize::from(SECOND));
                let second = evidence.sends_length(id(HES7TO14), usize::from(SENSORS - SECOND));
                if let (Some(first), Some(second)) = (first, second) {
                    evidence.together(first, second);
                } else if first.is_some() || second.is_some() {
                    evidence.lacks();
                }
                let keys = Key::period_ms(first.and_then(Stream::period), 1, 255);
                (keys.into_iter().collect(), (0..SENSORS).collect())
            },
        )
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}

/// The host's side of a MAIS board.
#[derive(Debug)]
struct Mais {
    address: u8,
    outputs: Outputs,
    /// Sensors whose next reading follows a gap, one bit each.
    gap: u16,
    /// Sensors that have been read, one bit each.
    seen: u16,
}

impl Mais {
    fn device(spec: &Spec, options: &IcubMaisOptions) -> Result<Box<dyn Device>, SpecError> {
        let address = icub::address(spec)?;
        let period = icub::period_ms("period_ms", options.period_ms)?;
        let timing = icub::timing(options.power_on_silence_ms)?;
        let watched = icub::stream(class::PERIODIC_ANALOG, address, HES0TO6);
        let mut bringup = Bringup::new(spec, spec.mode, timing, watched);
        let id = icub::to_board(class::POLLING_ANALOG, address);
        bringup.start_with(id, &[command::SET_RESOLUTION, RESOLUTION]);
        bringup.start_with(id, &[command::SET_CANDATARATE, period]);
        bringup.start_with(id, &[command::SET_TXMODE, 0]);
        bringup.stop_with(id, &[command::SET_TXMODE, 1]);
        let claims: ArrayVec<Claim, 2> =
            icub::claims(class::PERIODIC_ANALOG, address, &[HES0TO6, HES7TO14]);
        let this = Self {
            address,
            outputs: spec.outputs.clone(),
            gap: 0,
            seen: 0,
        };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }
}

impl Family for Mais {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &Frame, link: &mut Link<NoInquiry>, out: &mut Decoded) {
        let stream = icub::stream_type(frame.id, class::PERIODIC_ANALOG, self.address);
        let (first, length) = match stream {
            Some(HES0TO6) => (0, SECOND),
            Some(HES7TO14) => (SECOND, SENSORS - SECOND),
            _ => return,
        };
        let Some(data) = bytes::payload(frame, out) else {
            return;
        };
        if data.len() != usize::from(length) {
            return out.fault(Counter::Length, 1, frame.id);
        }
        if link.bringup.reading(frame.t) {
            self.gap = self.seen;
        }
        for (output, count) in (first..).zip(data) {
            if !self.outputs.0.contains(&output) {
                continue;
            }
            let bit = 1 << output;
            let quality = match self.gap & bit {
                0 => Quality::GOOD,
                _ => Quality::GAP_BEFORE,
            };
            self.gap &= !bit;
            self.seen |= bit;
            let reading = Reading::Joint(JointState {
                position: f64::from(*count),
                ..JointState::ABSENT
            });
            out.push(Output::new(output, frame, quality, reading), frame.id);
        }
    }
}

/// The board's own side. It sends a frame when all sensors of it that are joints are new.
#[derive(Debug)]
pub struct MaisBoard {
    address: u8,
    period: Nanos,
    streaming: bool,
    counts: [u8; SENSORS as usize],
    /// The joints, and those of them that are new, one bit each.
    joints: u16,
    fresh: u16,
}

impl MaisBoard {
    /// A board after power-on; in [`Mode::Listen`] another program has already started it.
    ///
    /// # Errors
    /// [`SpecError`]: an address outside 1 to 14, a period out of range.
    pub fn new(spec: &Spec, options: &IcubMaisOptions) -> Result<Self, SpecError> {
        let ms = icub::period_ms("period_ms", options.period_ms)?;
        Ok(Self {
            address: icub::address(spec)?,
            period: Nanos::from_millis(i64::from(ms)),
            streaming: spec.mode == Mode::Listen,
            counts: [0; SENSORS as usize],
            joints: spec
                .outputs
                .0
                .iter()
                .fold(0, |all, sensor| all | 1 << sensor),
            fresh: 0,
        })
    }
}

impl Board for MaisBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        icub::answer_management(
            frame,
            class::POLLING_ANALOG,
            self.address,
            icub::board::MAIS,
            out,
        );
        match icub::command_for(frame, class::POLLING_ANALOG, self.address) {
            Some(&[command::SET_CANDATARATE, ms]) if ms > 0 => {
                self.period = Nanos::from_millis(i64::from(ms));
            }
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
        _quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let Reading::Joint(joint) = reading else {
            return Err(EncodeError::Kind);
        };
        if !joint.position.is_finite() {
            return Err(EncodeError::NotFinite);
        }
        let Some(count) = self.counts.get_mut(usize::from(output)) else {
            return Err(EncodeError::Output(output));
        };
        let quantised = bytes::quantise(joint.position, 1.0, 0, 255);
        *count = u8::try_from(quantised).unwrap_or(u8::MAX);
        self.fresh |= 1 << output;
        let (first, second) = self.counts.split_at(usize::from(SECOND));
        let lower: u16 = (1 << SECOND) - 1;
        for (kind, counts, mask) in [(HES0TO6, first, lower), (HES7TO14, second, !lower)] {
            let joints = self.joints & mask;
            let has_this = 1 << output & mask != 0;
            if has_this && self.fresh & joints == joints {
                self.fresh &= !mask;
                let id = icub::stream(class::PERIODIC_ANALOG, self.address, kind);
                let _ = out.try_push(Frame::new(id, counts));
            }
        }
        Ok(())
    }
}
