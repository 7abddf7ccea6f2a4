//! Keys of gateway.toml that several families have.

use crate::{Id, Spec, SpecError};
use core::ops::RangeInclusive;
use proprio_topics::Nanos;

/// The address of `spec`, if it is one of `legal`.
///
/// # Errors
/// [`SpecError::Address`].
pub(crate) fn address(spec: &Spec, legal: RangeInclusive<u16>) -> Result<u16, SpecError> {
    match u16::try_from(spec.address) {
        Ok(address) if legal.contains(&address) => Ok(address),
        _ => Err(SpecError::Address {
            address: spec.address,
            least: u32::from(*legal.start()),
            most: u32::from(*legal.end()),
        }),
    }
}

/// The standard identifier `raw` of key `key`, if it is one of `legal`; `expected` is in words what
/// is legal.
///
/// # Errors
/// [`SpecError::Key`].
pub(crate) fn id(
    key: &'static str,
    raw: u16,
    legal: RangeInclusive<u16>,
    expected: &'static str,
) -> Result<Id, SpecError> {
    if legal.contains(&raw) {
        return Ok(Id::standard(raw));
    }
    let value = f64::from(raw);
    Err(SpecError::Key {
        key,
        value,
        expected,
    })
}

/// The value of key `key` as a duration of 1 ms to 1 minute.
///
/// # Errors
/// [`SpecError::Key`].
pub(crate) fn duration(key: &'static str, ms: u32) -> Result<Nanos, SpecError> {
    if !(1..=60_000).contains(&ms) {
        return Err(SpecError::Key {
            key,
            value: f64::from(ms),
            expected: "1 to 60000",
        });
    }
    Ok(Nanos::from_millis(i64::from(ms)))
}

/// The value of key `key`: a number above 0.
///
/// # Errors
/// [`SpecError::Key`].
pub(crate) fn above_zero(key: &'static str, value: f64) -> Result<f64, SpecError> {
    if value > 0.0 && value.is_finite() {
        return Ok(value);
    }
    let expected = "a number above 0";
    Err(SpecError::Key {
        key,
        value,
        expected,
    })
}

/// The value of key `key`, or the model's: a number above 0.
///
/// # Errors
/// [`SpecError::Keys`] of one that is not known, [`SpecError::Key`] of one that is not legal.
pub(crate) fn known(
    key: &'static str,
    given: Option<f64>,
    of_model: Option<f64>,
) -> Result<f64, SpecError> {
    match given.or(of_model) {
        Some(value) => above_zero(key, value),
        None => Err(SpecError::Keys {
            key,
            expected: "given where the model is not",
        }),
    }
}
