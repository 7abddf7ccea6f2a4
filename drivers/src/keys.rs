//! Keys of gateway.toml that several families have.

use crate::{Id, Spec, SpecError};
use core::ops::RangeInclusive;
use proprio_topics::Nanos;

/// The address of `spec`, if it is one of `legal`.
///
/// # Errors
/// [`SpecError::Address`].
pub(crate) fn address<T>(spec: &Spec, legal: RangeInclusive<T>) -> Result<T, SpecError>
where
    T: TryFrom<u32> + Into<u32> + PartialOrd + Copy,
{
    match T::try_from(spec.address) {
        Ok(address) if legal.contains(&address) => Ok(address),
        _ => Err(SpecError::Address {
            address: spec.address,
            least: (*legal.start()).into(),
            most: (*legal.end()).into(),
        }),
    }
}

/// The value of key `key`, if it is one of `legal`; `expected` is in words what is legal.
///
/// # Errors
/// [`SpecError::Key`].
pub(crate) fn within<T: PartialOrd + Into<f64>>(
    key: &'static str,
    value: T,
    legal: RangeInclusive<T>,
    expected: &'static str,
) -> Result<T, SpecError> {
    match legal.contains(&value) {
        true => Ok(value),
        false => Err(SpecError::key(key, value, expected)),
    }
}

/// As [`within`], as a standard identifier.
///
/// # Errors
/// [`SpecError::Key`].
pub(crate) fn id(
    key: &'static str,
    raw: u16,
    legal: RangeInclusive<u16>,
    expected: &'static str,
) -> Result<Id, SpecError> {
    within(key, raw, legal, expected).map(Id::standard)
}

/// As [`within`], as a duration in milliseconds.
///
/// # Errors
/// [`SpecError::Key`].
pub(crate) fn ms(
    key: &'static str,
    ms: u32,
    legal: RangeInclusive<u32>,
    expected: &'static str,
) -> Result<Nanos, SpecError> {
    within(key, ms, legal, expected).map(|ms| Nanos::from_millis(i64::from(ms)))
}

/// The value of key `key` as a duration of 1 ms to 1 minute.
///
/// # Errors
/// [`SpecError::Key`].
pub(crate) fn duration(key: &'static str, value: u32) -> Result<Nanos, SpecError> {
    ms(key, value, 1..=60_000, "1 to 60000")
}

/// As [`duration`], of a key that may be left out.
///
/// # Errors
/// [`SpecError::Key`].
pub(crate) fn stated_duration(
    key: &'static str,
    given: Option<u32>,
) -> Result<Option<Nanos>, SpecError> {
    given.map(|ms| duration(key, ms)).transpose()
}

/// The value of key `key`: a number above 0.
///
/// # Errors
/// [`SpecError::Key`].
pub(crate) fn above_zero(key: &'static str, value: f64) -> Result<f64, SpecError> {
    if value > 0.0 && value.is_finite() {
        return Ok(value);
    }
    Err(SpecError::key(key, value, "a number above 0"))
}

/// As [`above_zero`], of a key that may be left out.
///
/// # Errors
/// [`SpecError::Key`].
pub(crate) fn stated(key: &'static str, given: Option<f64>) -> Result<Option<f64>, SpecError> {
    given.map(|value| above_zero(key, value)).transpose()
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
        None => Err(SpecError::keys(key, "given where the model is not")),
    }
}
