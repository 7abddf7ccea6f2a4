//! The keys of an MTi in gateway.toml, and what they mean to both sides of the driver.

use super::frames::{FIELD_LSB, HighRate, MtiMessage};
use crate::{Id, Spec, SpecError, keys};
use alloc::collections::BTreeMap;
use alloc::vec::Vec;
use proprio_topics::Nanos;
use serde::Deserialize;

/// The keys of `driver = "xsens_mti"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct XsensMtiOptions {
    /// The messages of a reading; default sample time, angular velocity, acceleration.
    pub quantities: Vec<MtiMessage>,
    /// Period of the samples \[ms\], 0.5 to 1000; default 10.
    pub period_ms: f64,
    /// Unit of the sample time \[us\], 1 or 100; default 100.
    pub sample_time_unit_us: u32,
    /// The count that means 1 in a quaternion, 32767 or 32768; default 32767.
    pub quaternion_one: u32,
    /// Whether HR messages take the place of the others; default none.
    pub high_rate: HighRate,
    /// Whether identifiers have 29 bits; default false.
    pub extended: bool,
    /// The magnetic field at the sensor's calibration \[T\].
    pub magnetic_unit: Option<f64>,
    /// Identifiers that differ from those of delivery.
    pub identifiers: BTreeMap<MtiMessage, u32>,
}

impl Default for XsensMtiOptions {
    fn default() -> Self {
        Self {
            quantities: [
                MtiMessage::SampleTime,
                MtiMessage::AngularVelocity,
                MtiMessage::Acceleration,
            ]
            .to_vec(),
            period_ms: 10.0,
            sample_time_unit_us: 100,
            quaternion_one: 32767,
            high_rate: HighRate::None,
            extended: false,
            magnetic_unit: None,
            identifiers: BTreeMap::new(),
        }
    }
}

/// What the keys mean.
#[derive(Debug)]
pub(super) struct MtiKeys {
    /// The messages of a reading in the order in which they come.
    pub(super) messages: Vec<(Id, MtiMessage)>,
    pub(super) error: Id,
    pub(super) period: Nanos,
    /// The unit of the sample time.
    pub(super) tick: Nanos,
    pub(super) quaternion_lsb: f64,
    /// \[T\]
    pub(super) field_lsb: f64,
}

impl MtiKeys {
    pub(super) fn new(spec: &Spec, options: &XsensMtiOptions) -> Result<Self, SpecError> {
        let mut wanted = options.quantities.clone();
        wanted.sort_unstable();
        wanted.dedup();
        let wants = |message: &MtiMessage| wanted.contains(message);
        if wants(&MtiMessage::Error) || !MtiMessage::MEASURED.iter().any(wants) {
            return Err(SpecError::Keys {
                key: "quantities",
                expected: "a list with at least one of orientation, angular_velocity, \
                           acceleration, magnetic_field, and without error",
            });
        }
        let period_ms = options.period_ms;
        let period_ms = keys::within("period_ms", period_ms, 0.5..=1000.0, "from 0.5 to 1000")?;
        let unit = options.sample_time_unit_us;
        if !matches!(unit, 1 | 100) {
            return Err(SpecError::key("sample_time_unit_us", unit, "1 or 100"));
        }
        let one = options.quaternion_one;
        if !matches!(one, 32767 | 32768) {
            return Err(SpecError::key("quaternion_one", one, "32767 or 32768"));
        }
        let unit_field = match options.magnetic_unit {
            Some(unit) if unit > 0.0 && unit <= 1.0 => unit,
            Some(unit) => {
                let expected = "above 0, at most 1";
                return Err(SpecError::key("magnetic_unit", unit, expected));
            }
            None if wants(&MtiMessage::MagneticField) => {
                return Err(SpecError::Incomplete {
                    given: "magnetic_field",
                    missing: "magnetic_unit",
                });
            }
            None => f64::NAN,
        };
        let most = if options.extended { 0x1FFF_FFFF } else { 0x7FF };
        let mut messages = Vec::new();
        for message in wanted.into_iter().chain([MtiMessage::Error]) {
            let delivered = message.identifier(options.high_rate);
            let identifier = *options.identifiers.get(&message).unwrap_or(&delivered);
            keys::within("identifiers", identifier, 0..=most, "an identifier")?;
            let sum = identifier + keys::address(spec, 0..=most - identifier)?;
            let id = match (options.extended, u16::try_from(sum)) {
                (false, Ok(raw)) => Id::standard(raw),
                _ => Id::extended(sum),
            };
            messages.push((id, message));
        }
        let error = messages.pop().map_or(Id::standard(0), |(id, _)| id);
        messages.sort_unstable();
        let twice = messages
            .windows(2)
            .any(|two| matches!(two, [(a, _), (b, _)] if a == b));
        if twice || messages.iter().any(|(id, _)| *id == error) {
            return Err(SpecError::keys("identifiers", "different for each message"));
        }
        Ok(Self {
            messages,
            error,
            period: Nanos::from_seconds(period_ms * 1e-3),
            tick: Nanos::from_micros(i64::from(unit)),
            quaternion_lsb: 1.0 / f64::from(one),
            field_lsb: unit_field * FIELD_LSB,
        })
    }

    pub(super) fn wants(&self, message: MtiMessage) -> bool {
        self.messages.iter().any(|(_, wanted)| *wanted == message)
    }
}
