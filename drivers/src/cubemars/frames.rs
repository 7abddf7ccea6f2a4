//! The frames of both modes: raw values and their scales.

use crate::bytes;
use proprio_topics::Quality;

/// The outputs.
pub(super) const JOINT: u8 = 0;
pub(super) const DRIVE: u8 = 1;
/// The identifier of servo mode's upload; the motor's number is added.
pub(super) const SERVO_STATUS: u32 = 0x2900;
/// The error that makes a position doubtful.
pub(super) const ENCODER_ERROR: u8 = 5;

/// The quality of readings with this error.
pub(super) fn quality_of(error: u8) -> Quality {
    match error {
        0 => Quality::GOOD,
        ENCODER_ERROR => Quality::DEVICE_FAULT,
        _ => Quality::DRIVE_FAULT,
    }
}

/// A raw value in SI units: `offset` + `step` x raw. At `least` and `most` it is saturated.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scale {
    step: f64,
    offset: f64,
    least: i64,
    most: i64,
}

impl Scale {
    /// From -`end` to `end` in `bits` bits.
    pub(super) fn range(end: f64, bits: u32) -> Self {
        let most = (1_i64 << bits) - 1;
        Self {
            step: 2.0 * end / most as f64,
            offset: -end,
            least: 0,
            most,
        }
    }

    /// Steps of `step` on both sides of zero, up to `most`.
    pub(super) const fn steps(step: f64, most: i64) -> Self {
        Self {
            step,
            offset: 0.0,
            least: -most,
            most,
        }
    }

    pub(super) fn value(&self, raw: i64) -> f64 {
        self.offset + self.step * raw as f64
    }

    pub(super) const fn is_saturated(&self, raw: i64) -> bool {
        raw <= self.least || raw >= self.most
    }

    /// The raw value nearest to `value`, limited to the range.
    pub(super) fn raw(&self, value: f64) -> i64 {
        bytes::quantise(value - self.offset, self.step, self.least, self.most)
    }
}

/// The state of the power stage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Stage {
    /// Temperature \[degrees Celsius\].
    pub(super) celsius: f64,
    pub(super) error: u8,
}

/// Where the values of a measurement are in a frame.
#[derive(Debug, Clone, Copy)]
pub(super) enum Layout {
    Mit {
        /// The temperature that byte 0 means \[degrees Celsius\].
        celsius_at_zero: f64,
    },
    Servo,
}

impl Layout {
    /// The raw values of a payload, and the state of the power stage if it is there; `None`: a
    /// wrong length.
    pub(super) fn unpack(self, data: &[u8]) -> Option<([i64; 3], Option<Stage>)> {
        match (self, data) {
            (Self::Mit { celsius_at_zero }, &[_, _, _, high, both, low, ref stage @ ..]) => {
                let stage = match stage {
                    [] => None,
                    &[celsius, error] => Some(Stage {
                        celsius: celsius_at_zero + f64::from(celsius),
                        error,
                    }),
                    _ => return None,
                };
                let velocity = u16::from(high) << 4 | u16::from(both >> 4);
                let effort = u16::from(both & 0xF) << 8 | u16::from(low);
                let raw = [bytes::u16_be(data, 1), velocity, effort];
                Some((raw.map(i64::from), stage))
            }
            (Self::Servo, &[_, _, _, _, _, _, celsius, error]) => {
                let raw = [0, 2, 4].map(|at| i64::from(bytes::i16_be(data, at)));
                let celsius = f64::from(celsius.cast_signed());
                Some((raw, Some(Stage { celsius, error })))
            }
            _ => None,
        }
    }

    /// The payload of motor `number` with these values.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // limited to their ranges
    pub(super) fn pack(self, number: u8, raw: [i64; 3], stage: Stage) -> [u8; 8] {
        let Stage { celsius, error } = stage;
        match self {
            Self::Mit { celsius_at_zero } => {
                let [position, velocity, effort] = raw.map(|raw| raw as u16);
                let ([p0, p1], [e0, e1]) = (position.to_be_bytes(), effort.to_be_bytes());
                let [v0, v1] = (velocity << 4).to_be_bytes();
                let celsius = bytes::quantise(celsius - celsius_at_zero, 1.0, 0, 255) as u8;
                [number, p0, p1, v0, v1 | e0, e1, celsius, error]
            }
            Self::Servo => {
                let [[p0, p1], [v0, v1], [e0, e1]] = raw.map(|raw| (raw as i16).to_be_bytes());
                let celsius = bytes::quantise(celsius, 1.0, -128, 127) as i8;
                [p0, p1, v0, v1, e0, e1, celsius.cast_unsigned(), error]
            }
        }
    }
}
