//! The keys of a sensor in gateway.toml, and what they mean to both sides of the driver.

use super::frames::{
    ADDRESSES, AxisOrder, BASE_PERIOD_MS, DIVIDERS, OpenImuQuantity, Upright, identifier,
};
use crate::{Id, Spec, SpecError, keys};
use alloc::vec::Vec;
use serde::Deserialize;

/// The keys of `driver = "openimu"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct OpenImuOptions {
    /// The quantities of a reading; default acceleration and angular velocity.
    pub quantities: Vec<OpenImuQuantity>,
    /// Period \[ms\]; default 10.
    pub period_ms: u32,
    /// Order of the axes; default y, x, z.
    pub axes: AxisOrder,
    /// Axes of the acceleration; default z up.
    pub acceleration_z: Upright,
}

impl Default for OpenImuOptions {
    fn default() -> Self {
        Self {
            quantities: [
                OpenImuQuantity::Acceleration,
                OpenImuQuantity::AngularVelocity,
            ]
            .to_vec(),
            period_ms: u32::from(BASE_PERIOD_MS),
            axes: AxisOrder::Yxz,
            acceleration_z: Upright::Up,
        }
    }
}

/// What the keys mean.
#[derive(Debug)]
pub(super) struct OpenImuKeys {
    pub(super) address: u8,
    /// In the order of their messages.
    pub(super) quantities: Vec<OpenImuQuantity>,
    pub(super) divider: u8,
    pub(super) axes: AxisOrder,
    pub(super) upright: Upright,
}

impl OpenImuKeys {
    pub(super) fn new(spec: &Spec, options: &OpenImuOptions) -> Result<Self, SpecError> {
        let address = keys::address(spec, ADDRESSES)?;
        let mut dividers = DIVIDERS.into_iter();
        let period = options.period_ms;
        let divider = dividers.find(|by| u32::from(*by) * u32::from(BASE_PERIOD_MS) == period);
        let quantities = OpenImuQuantity::ALL.into_iter();
        let quantities: Vec<OpenImuQuantity> = quantities
            .filter(|quantity| options.quantities.contains(quantity))
            .collect();
        if quantities.is_empty() {
            let expected = "a list with at least one quantity";
            return Err(SpecError::keys("quantities", expected));
        }
        Ok(Self {
            address,
            quantities,
            divider: divider.ok_or(SpecError::key(
                "period_ms",
                period,
                "10, 20, 40, 50, 100, 200, 250 or 500",
            ))?,
            axes: options.axes,
            upright: options.acceleration_z,
        })
    }

    /// The bits of its quantities in a command.
    pub(super) fn types(&self) -> u8 {
        (self.quantities.iter()).fold(0, |bits, quantity| bits | quantity.pgn_priority_bit().2)
    }

    /// The identifier of the messages that hold `quantity`.
    pub(super) const fn message(&self, quantity: OpenImuQuantity) -> Id {
        let (pgn, priority, _) = quantity.pgn_priority_bit();
        identifier(priority, pgn, self.address)
    }
}
