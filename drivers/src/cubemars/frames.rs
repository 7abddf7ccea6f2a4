//! The frames of both modes: raw values and the state of the power stage.

use crate::{bytes, mit};
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

/// The state of the power stage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Stage {
    /// Temperature \[degrees Celsius\].
    pub(super) celsius: f64,
    pub(super) error: u8,
}

/// Where the values of a measurement are in a frame.
#[derive(Debug, Clone, Copy)]
pub(super) enum PayloadLayout {
    Mit {
        /// The temperature that byte 0 means \[degrees Celsius\].
        celsius_at_zero: f64,
    },
    Servo,
}

impl PayloadLayout {
    /// The raw values of a payload, and the state of the power stage if it is there; `None`: a
    /// wrong length.
    pub(super) fn unpack(self, data: &[u8]) -> Option<([i64; 3], Option<Stage>)> {
        match (self, data) {
            (Self::Mit { celsius_at_zero }, [_, measured @ ..]) => {
                let (raw, stage) = mit::unpack(measured)?;
                let stage = match stage {
                    [] => None,
                    &[celsius, error] => Some(Stage {
                        celsius: celsius_at_zero + f64::from(celsius),
                        error,
                    }),
                    _ => return None,
                };
                Some((raw, stage))
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
                let [p0, p1, v0, both, e1] = mit::pack(raw);
                let celsius = bytes::quantise(celsius - celsius_at_zero, 1.0, 0, 255) as u8;
                [number, p0, p1, v0, both, e1, celsius, error]
            }
            Self::Servo => {
                let [[p0, p1], [v0, v1], [e0, e1]] = raw.map(|raw| (raw as i16).to_be_bytes());
                let celsius = bytes::quantise(celsius, 1.0, -128, 127) as i8;
                [p0, p1, v0, v1, e0, e1, celsius.cast_unsigned(), error]
            }
        }
    }
}
