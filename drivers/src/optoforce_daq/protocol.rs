//! The identifiers and numbers of the protocol.

use crate::Id;
use proprio_topics::Nanos;

/// The first bytes of a packet, of an answer, and of a configuration.
pub(super) const PACKET: [u8; 4] = [0xAA, 0x07, 0x08, 0x0A];
pub(super) const ANSWER: [u8; 4] = [0xAA, 0x00, 0x50, 0x01];
pub(super) const CONFIGURATION: [u8; 4] = [0xAA, 0x00, 0x32, 0x03];
/// Bits of the status: the overload of fx, below which are the other axes', and all errors.
pub(super) const OVERLOAD_FX: u32 = 9;
pub(super) const ERRORS: u16 = 0b111_111 << 10;
/// The error of a sensor that has failed.
pub(super) const SENSOR_FAILURE: u16 = 2 << 10;
/// Values of `zero` in a configuration.
pub(super) const ZERO_HERE: u8 = 255;
pub(super) const ZERO_OWN: u8 = 0;
/// Rates \[Hz\] and their codes, which are periods in ms.
pub(super) const RATES: [(u32, u8); 5] = [(1000, 1), (333, 3), (100, 10), (30, 33), (10, 100)];
/// The code of a unit that was not configured.
pub(super) const DEFAULT_RATE: u8 = 10;
/// Filters \[Hz\]; each one's code is its place.
pub(super) const FILTERS: [f64; 7] = [0.0, 500.0, 150.0, 50.0, 15.0, 5.0, 1.5];
pub(super) const DEFAULT_FILTER: f64 = 15.0;

/// The settings of a configuration, as the unit writes them.
#[derive(Debug, Clone, Copy)]
pub(super) struct OptoSettings {
    pub(super) speed: u8,
    pub(super) filter: u8,
    pub(super) zero: u8,
}

/// The identifiers of a unit.
#[derive(Debug, Clone, Copy)]
pub(super) struct OptoIds {
    pub(super) data: Id,
    pub(super) config: Id,
}

/// The period that a speed means.
pub(super) fn period(speed: u8) -> Nanos {
    Nanos::from_millis(i64::from(speed))
}

/// The checksum of what stands before it.
pub(super) fn sum(bytes: &[u8]) -> u16 {
    bytes
        .iter()
        .fold(0, |sum: u16, byte| sum.wrapping_add(u16::from(*byte)))
}
