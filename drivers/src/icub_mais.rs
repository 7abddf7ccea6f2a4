//! The driver `icub_mais`: iCub Hall sensors. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/icub_mais.md")]

#[cfg(feature = "boards")]
mod board;
#[cfg(feature = "recognise")]
mod recognise;

use crate::bringup::{Bringup, NoInquiry};
use crate::family::{Family, Session, Supervised};
use crate::icub::{self, OutputGaps, class, command};
use crate::received::Received;
use crate::{Device, Driver, OutputInfo, Outputs, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{JointState, Kind, Reading};
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
        let address = icub::address(spec)?;
        let period = icub::period_ms("period_ms", self.period_ms)?;
        let timing = icub::timing(self.power_on_silence_ms)?;
        let watched = icub::stream(class::PERIODIC_ANALOG, address, HES0TO6);
        let mut bringup = Bringup::new(spec, spec.mode, timing, watched);
        let id = icub::to_board(class::POLLING_ANALOG, address);
        bringup.start_with(id, &[command::SET_RESOLUTION, RESOLUTION]);
        bringup.start_with(id, &[command::SET_CANDATARATE, period]);
        bringup.start_with(id, &[command::SET_TXMODE, 0]);
        bringup.stop_with(id, &[command::SET_TXMODE, 1]);
        let claims = icub::claims(class::PERIODIC_ANALOG, address, &[HES0TO6, HES7TO14]);
        let this = Mais {
            address,
            outputs: spec.outputs.clone(),
            gaps: OutputGaps::default(),
        };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }
}

/// The host's side of a MAIS board.
#[derive(Debug)]
struct Mais {
    address: u8,
    outputs: Outputs,
    gaps: OutputGaps,
}

impl Family for Mais {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        let stream = icub::stream_type(frame.id, class::PERIODIC_ANALOG, self.address);
        let (first, length) = match stream {
            Some(HES0TO6) => (0, SECOND),
            Some(HES7TO14) => (SECOND, SENSORS - SECOND),
            _ => return,
        };
        let Some(data) = frame.payload_of(usize::from(length)) else {
            return;
        };
        if session.bringup.reading(frame.t) {
            self.gaps.all();
        }
        for (output, count) in (first..).zip(data) {
            if !self.outputs.0.contains(&output) {
                continue;
            }
            let reading = Reading::Joint(JointState {
                position: f64::from(*count),
                ..JointState::ABSENT
            });
            frame.tell(output, self.gaps.take(output), reading);
        }
    }
}
