//! Recognising IMUs: by the type of their board, or by their streams.

use super::IcubImuOptions;
use super::frames::{kind, sensor};
use crate::icub::{self, board, class};
use crate::recognise::{Finding, Key, Stream, Traffic};
use crate::{Driver, Frame, Recognise};
use alloc::format;
use alloc::vec::Vec;

/// The boards with an IMU; an mtb has legacy sensors.
const TYPES: [u8; 7] = [
    board::STRAIN2,
    board::STRAIN2C,
    board::MTB4,
    board::MTB4W,
    board::MTB4C,
    board::RFE,
    board::MTB,
];
/// The numbers of sensors in IMU_TRIPLE, and the quantities that are read of them.
const SENSORS: [(u8, &str); 6] = [
    (sensor::ACCELERATION, "acceleration"),
    (sensor::MAGNETIC_FIELD, "magnetic_field"),
    (sensor::ANGULAR_VELOCITY, "angular_velocity"),
    (sensor::EULER, ""),
    (sensor::LINEAR_ACCELERATION, ""),
    (sensor::GRAVITY, ""),
];

impl Recognise for IcubImuOptions {
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        icub::recognise(seen, Self::NAME, &TYPES, &[], |evidence, address, board| {
            let id = |kind| icub::stream(class::PERIODIC_INERTIAL, address, kind);
            let is_long = |frame: &Frame| frame.len() == 8;
            let mut keys = Vec::new();
            let mut quantities: Vec<&str> = Vec::new();
            let triple = evidence.sends(id(kind::TRIPLE), |frame| {
                let sensor = frame.data().get(1);
                is_long(frame) && SENSORS.iter().any(|(known, _)| Some(known) == sensor)
            });
            if let Some(triple) = triple {
                evidence.measures(triple);
                evidence.counts(triple, |frame| frame.data().first().copied().unwrap_or(0));
                for (number, quantity) in SENSORS {
                    let is_it = |frame: &Frame| frame.data().get(1) == Some(&number);
                    if triple.recent().any(is_it) && !quantity.is_empty() {
                        if quantities.is_empty() {
                            keys.extend(Key::period_ms(triple.period_of(is_it), 1, 255));
                        }
                        quantities.push(quantity);
                    }
                }
            }
            if evidence.sends(id(kind::QUATERNION), is_long).is_some() {
                quantities.push("orientation");
            }
            // Three calibrations from 0 to 3.
            let status = evidence.sends(id(kind::STATUS), |frame| {
                let mut calibrations = frame.data().iter().skip(1).take(3);
                is_long(frame) && calibrations.all(|calibration| *calibration <= 3)
            });
            if status.is_some() {
                quantities.push("status");
            }
            if !quantities.is_empty() {
                keys.push(Key::new("quantities", format!("{quantities:?}")));
            }
            let accelerometer = evidence.sends_length(id(kind::LEGACY_ACCELEROMETER), 6);
            let gyroscope = evidence.sends_length(id(kind::LEGACY_GYROSCOPE), 6);
            if let (Some(a), Some(b)) = (accelerometer, gyroscope) {
                evidence.together(a, b);
            }
            let is_legacy = accelerometer.is_some() || gyroscope.is_some();
            match board {
                _ if !quantities.is_empty() => {}
                Some(board::MTB) => keys.push(Key::new("legacy", "\"mtb\"")),
                Some(_) if is_legacy => keys.push(Key::new("legacy", "\"bno055\"")),
                None if is_legacy => {
                    let note = "or \"bno055\": which board is it?";
                    keys.push(Key::fill_in("legacy", "\"mtb\"", note));
                }
                _ => {}
            }
            if quantities.is_empty() {
                // Only what it sends is asked of it.
                match (accelerometer, gyroscope) {
                    (Some(_), None) => {
                        keys.push(Key::new("quantities", "[\"acceleration\"]"));
                        let note = "or 8: is it an external accelerometer?";
                        keys.push(Key::fill_in("legacy_mask", "2", note));
                    }
                    (None, Some(_)) => {
                        keys.push(Key::new("quantities", "[\"angular_velocity\"]"));
                        keys.push(Key::new("legacy_mask", "4"));
                    }
                    _ => {}
                }
                let stream = accelerometer.or(gyroscope);
                keys.extend(Key::period_ms(stream.and_then(Stream::period), 1, 255));
            }
            (keys, Vec::new())
        })
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}
