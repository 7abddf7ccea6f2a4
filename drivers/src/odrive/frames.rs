//! The messages of CANSimple that are read.

use crate::{Format, Frame};

/// The commands.
pub(super) mod command {
    pub(in crate::odrive) const VERSION: u8 = 0x00;
    pub(in crate::odrive) const HEARTBEAT: u8 = 0x01;
    pub(in crate::odrive) const ESTIMATES: u8 = 0x09;
    pub(in crate::odrive) const IQ: u8 = 0x14;
    pub(in crate::odrive) const TEMPERATURE: u8 = 0x15;
    pub(in crate::odrive) const TORQUES: u8 = 0x1C;
}

/// The outputs.
pub(super) const JOINT: u8 = 0;
pub(super) const MOTOR: u8 = 1;
pub(super) const FET: u8 = 2;
/// The length of every message read here.
pub(super) const LENGTH: u8 = 8;
/// The highest node.
pub(super) const NODE_MOST: u16 = 63;

/// Whether `frame` is a host's request and not an answer: a remote frame, or one without data.
pub(super) fn is_request(frame: &Frame) -> bool {
    frame.format == Format::Remote || frame.format == Format::Classic && frame.is_empty()
}
