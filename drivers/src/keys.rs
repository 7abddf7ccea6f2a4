//! Keys of gateway.toml that several families have.

use crate::{Id, Spec, SpecError};
use core::ops::RangeInclusive;

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
