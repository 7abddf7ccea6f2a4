//! The identifiers, commands and numbers of the protocol.

use crate::{Frame, Id};
use proprio_topics::Nanos;

/// The first byte of a command and of its response.
pub(super) mod command {
    pub(in crate::robotous_rft) const NAME: u8 = 0x01;
    pub(in crate::robotous_rft) const SERIAL: u8 = 0x02;
    pub(in crate::robotous_rft) const FIRMWARE: u8 = 0x03;
    pub(in crate::robotous_rft) const START: u8 = 0x0B;
    pub(in crate::robotous_rft) const STOP: u8 = 0x0C;
    pub(in crate::robotous_rft) const SET_RATE: u8 = 0x0F;
    pub(in crate::robotous_rft) const GET_RATE: u8 = 0x10;
    pub(in crate::robotous_rft) const BIAS: u8 = 0x11;
}

/// Rates \[Hz\] and their codes; where two have one code, the manual's first.
pub(super) const RATES: [(u32, u8); 9] = [
    (10, 1),
    (20, 2),
    (50, 3),
    (100, 4),
    (200, DEFAULT_RATE),
    (333, 6),
    (300, 6),
    (500, 7),
    (1000, 8),
];
/// The rate of a new sensor, which also has code 0.
pub(super) const DEFAULT_RATE: u8 = 5;
/// The argument of BIAS: the present load becomes the zero; 0 is the sensor's own zero.
pub(super) const SET: u8 = 1;
/// The overload bit of fx; the other axes follow downwards.
pub(super) const OVERLOAD_FX: u32 = 5;

/// The identifiers of a sensor.
#[derive(Debug, Clone, Copy)]
pub(super) struct RftIds {
    pub(super) command: Id,
    pub(super) first: Id,
    pub(super) second: Id,
}

pub(super) fn period(hz: u32) -> Nanos {
    Nanos::from_seconds(1.0 / f64::from(hz))
}

/// A command with one argument.
pub(super) fn send(id: Id, command: u8, argument: u8) -> Frame {
    Frame::new(id, &[command, argument, 0, 0, 0, 0, 0, 0])
}
