//! The contents of an F/T board's frames: types of its streams, step sizes, and the half of a
//! reading in one frame with its saturation byte.

use crate::bytes;
use crate::{Frame, Id};
use proprio_topics::{Counter, Quality, Saturation};

/// Types of the streams.
pub(super) mod kind {
    pub(in crate::icub_strain) const RAW_FORCE: u8 = 0x8;
    pub(in crate::icub_strain) const RAW_TORQUE: u8 = 0x9;
    pub(in crate::icub_strain) const FORCE: u8 = 0xA;
    pub(in crate::icub_strain) const TORQUE: u8 = 0xB;
    pub(in crate::icub_strain) const THERMOMETER: u8 = 0xE;
    pub(in crate::icub_strain) const THERMOMETER_FIRMWARE: u8 = 0xF;
    pub(in crate::icub_strain) const THERMOMETERS: [u8; 2] = [THERMOMETER, THERMOMETER_FIRMWARE];
}

/// The code of zero in a stream.
pub(super) const ZERO: u16 = 0x8000;
/// Steps in a full scale.
pub(super) const STEPS: f64 = 32768.0;
/// One step of a temperature \[degC\].
pub(super) const CELSIUS_PER_LSB: f64 = 0.1;

/// Half a reading: one frame of a pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct StrainHalf {
    pub(super) counts: [u16; 3],
    /// Its saturation byte, 0 if there is none.
    pub(super) saturation: u8,
}

impl StrainHalf {
    pub(super) fn parse(data: &[u8]) -> Result<Self, Counter> {
        let saturation = match *data {
            [_, _, _, _, _, _] => 0,
            // The byte must have the flag, and the two bits of a gauge are never both set.
            [_, _, _, _, _, _, sat] if sat & 3 == 1 && sat & sat >> 1 & 0b0101_0100 == 0 => sat,
            [_, _, _, _, _, _, _] => return Err(Counter::Value),
            _ => return Err(Counter::Length),
        };
        Ok(Self {
            counts: [
                bytes::u16_le(data, 0),
                bytes::u16_le(data, 2),
                bytes::u16_le(data, 4),
            ],
            saturation,
        })
    }

    /// `quality` with the saturation of gauges `first..first + 3` from this half.
    pub(super) fn mark(self, mut quality: Quality, first: u32) -> Quality {
        if self.saturation == 0 {
            return quality;
        }
        quality |= Quality::SATURATED;
        for k in 0..3 {
            let saturation = match self.saturation >> (2 * (k + 1)) & 3 {
                1 => Saturation::Low,
                2 => Saturation::High,
                _ => Saturation::None,
            };
            quality = quality.with_saturation(first + k, saturation);
        }
        quality
    }

    pub(super) fn frame(self, id: Id) -> Frame {
        let [[a, b], [c, d], [e, f]] = self.counts.map(u16::to_le_bytes);
        if self.saturation == 0 {
            Frame::new(id, &[a, b, c, d, e, f])
        } else {
            Frame::new(id, &[a, b, c, d, e, f, self.saturation])
        }
    }
}

/// The saturation bytes of both frames for `quality`.
pub(super) fn saturation_bytes(quality: Quality) -> [u8; 2] {
    if !quality.contains(Quality::SATURATED) {
        return [0, 0];
    }
    let byte = |first: u32| {
        (0..3).fold(1_u8, |byte, k| {
            let code = match quality.saturation(first + k) {
                Saturation::None => 0,
                Saturation::Low => 1,
                Saturation::High => 2,
            };
            byte | code << (2 * (k + 1))
        })
    };
    [byte(0), byte(3)]
}
