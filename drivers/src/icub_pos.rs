//! The driver `icub_pos`: iCub POS encoders. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/icub_pos.md")]

#[cfg(feature = "boards")]
mod board;
#[cfg(feature = "recognise")]
mod recognise;

use crate::bringup::{Bringup, Timing};
use crate::configure::{Configure, Setting};
use crate::family::{Family, Session, Supervised};
use crate::icub::{self, OutputGaps, class, command};
use crate::received::Received;
use crate::{Claim, Device, Driver, Frame, OutputInfo, Outputs, Spec, SpecError, bytes, keys};
use alloc::boxed::Box;
use alloc::vec::Vec;
use core::f64::consts::TAU;
use proprio_topics::{Counter, JointState, Kind, Quality, Reading};
use serde::Deserialize;

/// Type of the stream.
const POS: u8 = 1;
/// How many values fit a frame.
const VALUES: u8 = 3;
/// The highest label.
const LABEL_MOST: u8 = 15;
/// 0.1 deg \[rad\].
const RAD_PER_LSB: f64 = TAU / 3600.0;
/// 0.1 mm \[m\].
const METRE_PER_LSB: f64 = 1e-4;

/// What a POS board measures.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum PosQuantity {
    /// Angles \[rad\].
    #[default]
    Angle,
    /// Lengths \[m\].
    Length,
}

impl PosQuantity {
    /// Its number in a frame, and one step \[rad or m\].
    const fn code_and_lsb(self) -> (u8, f64) {
        match self {
            Self::Angle => (0, RAD_PER_LSB),
            Self::Length => (1, METRE_PER_LSB),
        }
    }
}

/// The configuration of one sensor of a board.
#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct PosSensor {
    /// Its label, which is the joint's channel.
    pub label: u8,
    /// Negate its value; default false.
    pub inverted: bool,
    /// Added before the zero is subtracted \[deg\]: 0, 90, 180 or -90; default 0.
    pub rotation_deg: i32,
    /// The zero position \[deg\]; default 0.
    pub zero_deg: f64,
}

impl PosSensor {
    /// Its three bytes in POS_CONFIG_SET.
    fn bytes(&self) -> Result<[u8; 3], SpecError> {
        let rotation = match self.rotation_deg {
            0 => 0,
            180 => 1,
            90 => 2,
            -90 => 3,
            other => {
                let expected = "0, 90, 180 or -90";
                return Err(SpecError::key("rotation_deg", other, expected));
            }
        };
        let label = keys::within("label", self.label, 0..=LABEL_MOST, "at most 15")?;
        let degrees = -360.0..=360.0;
        let zero = keys::within("zero_deg", self.zero_deg, degrees, "from -360 to 360")?;
        let [low, high] = bytes::quantise_i16(zero, 0.1).to_le_bytes();
        Ok([
            0x80 | u8::from(self.inverted) << 6 | rotation << 4 | label,
            low,
            high,
        ])
    }
}

/// The keys of `driver = "icub_pos"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct IcubPosOptions {
    /// Period \[ms\], 1 to 255; default 10.
    pub period_ms: u32,
    /// The quantity that the board sends; default angles.
    pub quantity: PosQuantity,
    /// Silence kept after power-on \[ms\]; default 0.
    pub power_on_silence_ms: u32,
    /// Configuration of its sensors, at most two; default: keep the board's own.
    pub sensors: Option<Vec<PosSensor>>,
}

impl Default for IcubPosOptions {
    fn default() -> Self {
        Self {
            period_ms: 10,
            quantity: PosQuantity::Angle,
            power_on_silence_ms: 0,
            sensors: None,
        }
    }
}

impl IcubPosOptions {
    /// The bytes of POS_CONFIG_SET, if the sensors are to be configured.
    fn configuration(&self) -> Result<Option<[u8; 8]>, SpecError> {
        let Some(sensors) = &self.sensors else {
            return Ok(None);
        };
        let (first, second) = match sensors.as_slice() {
            [first] => (first.bytes()?, [0; 3]),
            [first, second] => (first.bytes()?, second.bytes()?),
            _ => {
                return Err(SpecError::keys("sensors", "a list of one or two sensors"));
            }
        };
        let ([a, b, c], [d, e, f]) = (first, second);
        // Identity 0: all of a psc.
        Ok(Some([
            command::POS_CONFIG_SET,
            self.quantity.code_and_lsb().0,
            a,
            b,
            c,
            d,
            e,
            f,
        ]))
    }
}

impl Driver for IcubPosOptions {
    const NAME: &'static str = "icub_pos";

    fn outputs(&self) -> Vec<OutputInfo> {
        (0..=LABEL_MOST)
            .map(|label| OutputInfo::new(label, Kind::Joint))
            .collect()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let address = icub::address(spec)?;
        let period = icub::period_ms("period_ms", self.period_ms)?;
        let timing = icub::timing(self.power_on_silence_ms)?;
        let watched = icub::stream(class::PERIODIC_ANALOG, address, POS);
        let mut bringup = Bringup::new(spec, spec.mode, timing, watched);
        let id = icub::to_board(class::POLLING_ANALOG, address);
        let setting = self.configuration()?.map(|set| Setting {
            get: Frame::new(
                id,
                &[command::POS_CONFIG_GET, self.quantity.code_and_lsb().0],
            ),
            set: Frame::new(id, &set),
            compared: 1..8,
        });
        bringup.start_with(id, &[command::POS_TRANSMIT, period]);
        bringup.stop_with(id, &[command::POS_TRANSMIT, 0]);
        let mut claims = icub::claims(class::PERIODIC_ANALOG, address, &[POS]);
        if setting.is_some() {
            claims.push(Claim::shared(icub::to_host(class::POLLING_ANALOG, address)));
        }
        let configure = Configure::new(spec, setting, Timing::USUAL);
        let this = Pos {
            address,
            quantity: self.quantity,
            outputs: spec.outputs.clone(),
            gaps: OutputGaps::default(),
        };
        Ok(Supervised::boxed(claims, bringup, configure, this))
    }
}

/// The host's side of a POS board.
#[derive(Debug)]
struct Pos {
    address: u8,
    quantity: PosQuantity,
    outputs: Outputs,
    gaps: OutputGaps,
}

impl Family for Pos {
    type Questions = Configure;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session<Configure>) {
        if frame.id == icub::to_host(class::POLLING_ANALOG, self.address) {
            // Answers to other questions are for other devices.
            if let Some(data) = frame.payload()
                && data.first() == Some(&command::POS_CONFIG_GET)
            {
                session.questions.answer(data, frame);
            }
            return;
        }
        if icub::stream_type(frame.id, class::PERIODIC_ANALOG, self.address) != Some(POS) {
            return;
        }
        let Some(data) = frame.payload() else {
            return;
        };
        let &[quantity, label_and_count, ref values @ ..] = data else {
            return frame.fault(Counter::Length);
        };
        if values.len() != 2 * usize::from(VALUES) {
            return frame.fault(Counter::Length);
        }
        let (label, count) = (label_and_count >> 4, label_and_count & 0xF);
        let (code, lsb) = self.quantity.code_and_lsb();
        if quantity != code || !(1..=VALUES).contains(&count) || label + count - 1 > LABEL_MOST {
            return frame.fault(Counter::Value);
        }
        if session.bringup.reading(frame.t) {
            self.gaps.all();
        }
        for (output, value) in (label..)
            .zip(values.chunks_exact(2))
            .take(usize::from(count))
        {
            if !self.outputs.0.contains(&output) {
                continue;
            }
            let mut quality = self.gaps.take(output);
            if !session.questions.confirmed() {
                quality |= Quality::NOT_CALIBRATED;
            }
            let position = f64::from(bytes::i16_le(value, 0)) * lsb;
            let reading = Reading::Joint(JointState {
                position,
                ..JointState::ABSENT
            });
            frame.tell(output, quality, reading);
        }
    }
}
