//! Any device whose frames a .dbc file describes.
//!
//! The file says where the bits of each signal are and what they mean; the keys say which signal is
//! which value of a reading. Decoding follows a table that is made at start. The driver listens
//! only: a .dbc file does not say how a device is started.
//!
//! - Signals: Intel and Motorola order, signed and unsigned, IEEE floats (`SIG_VALTYPE_`),
//!   multiplexed ones, also by a multiplexed multiplexor or by ranges (`SG_MUL_VAL_`), frames of
//!   CAN FD, standard and extended identifiers. Of a multiplexed message, signals that some pages
//!   have together are taken from these pages.
//! - A message or signal that can not be used does no harm unless it is named: one of more than 64
//!   bits, or an identifier of more than 11 bits that is not marked as an extended one.
//! - SAE J1939 (attribute `VFrameFormat`, else `ProtocolType`): the parameter group counts, and not
//!   the priority, the source and, where the group has one, the destination that are in the file.
//!   If the file has several messages of one group, their addresses count. Messages of more than 8
//!   bytes, which come in several packets, are not read. Unsigned numbers of whole bytes of which
//!   the highest is FE (error) or FF (not available) are no value, nor are two bits that are 10
//!   (error) or 11; others are none if all their bits are 1. An error of `fault` itself is a fault.
//!   A counter may have any.
//! - Names: those in the file, and the long ones that editors keep beside them
//!   (`SystemMessageLongSymbol`, `SystemSignalLongSymbol`). Where several messages have one name,
//!   the identifier stands for it, three digits or eight: `"0x1A0.Position"`,
//!   `"0x18FF0001.Position"`.
//! - Units: the file's own unit is converted to SI, and must fit the value. Where the file has none
//!   (or one that is not known), `units` gives it; `units` also overrides the file's. Case does not
//!   matter, but for m (a thousandth) and M (a million).
//! - A reading is complete when each of its signals has come once. If they come in several frames,
//!   `first` names the message that opens a reading, and the others must follow within
//!   `pair_timeout_ms`: less than half the period, so that a lost frame never leads to a mixture of
//!   two readings. A frame that comes again before the others have come may mean that they are
//!   lost, or late: both readings are dropped (counted as unpaired), so that none is wrong.
//! - A signal with `hold_ms` does not wait: its last value is used, if it is not older than that,
//!   else none. So a drive's torque, sent ten times a second, joins its position.
//!
//! `address` is added to the identifiers of the file: for a file that describes node 0 of a
//! protocol with the node in the identifier. (Not for J1939: that is what `source_address` is for.)
//!
//! Sources: the format as Vector's "DBC File Format Documentation" 1.0.5 and `cantools` 45.1 read
//! it (certain: the tests compare with frames that cantools encodes). The contents of a file are
//! as certain as the file.
//!
//! # Keys
//! ```toml
//! file = "drive.dbc"       # relative to gateway.toml
//! period_ms = 10           # of the readings: for the load of the bus, and a simulated device (10)
//! j1939 = true             # default: as the file says; false: whole identifiers count
//! # Of J1939: without these, any frame of the parameter group counts.
//! # source_address = 0x23, destination_address = 0x00, priority = 6
//!
//! [[reading]]
//! kind = "joint"           # joint, wrench, imu, gauges, temperature, actuator or skin
//! # The values of that kind, by the names of the columns of `proprio decode`.
//! fields.position = "Encoder.Position"
//! fields.velocity = "Encoder.Velocity"
//! fields.torque = "Motor.Torque"
//! units = { position = "rev", velocity = "rev/s" }
//! hold_ms = { torque = 200.0 }
//! fault = "State.Error"    # any other value than 0: DEVICE_FAULT
//! counter = "Encoder.Count" # counts the readings: tells the lost ones
//!
//! [[reading]]
//! kind = "temperature"
//! name = "motor"           # the channel is <device>_motor; without `name` it is the device's
//! fields = { temperature = "State.Temperature" }
//!
//! [[reading]]
//! kind = "wrench"
//! name = "flange"
//! fields = { fx = "F.X", fy = "F.Y", fz = "F.Z", tx = "T.X", ty = "T.Y", tz = "T.Z" }
//! first = "F"              # the message that is sent first
//! pair_timeout_ms = 2.0
//! ```
//! The joint `[[bus.device.joint]]` of a reading has its number in the list, from 0, as `channel`.

mod board;
mod device;
mod layout;
mod options;

pub use board::DbcBoard;
pub use options::{Options, ReadingKeys};

use crate::signal::Message;
use crate::{Board, Device, Driver, OutputInfo, Spec, SpecError};
use alloc::borrow::Cow;
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::DbcDevice;

impl Driver for Options {
    const NAME: &'static str = "dbc";
    const ADDRESS: Option<u32> = Some(0);

    fn outputs(&self) -> Vec<OutputInfo> {
        let info = |(number, reading): (u8, &ReadingKeys)| OutputInfo {
            number,
            kind: reading.kind,
            suffix: Cow::Owned(reading.name.clone()),
        };
        (0..).zip(&self.reading).map(info).collect()
    }

    fn states_period(&self) -> bool {
        self.period_ms.is_some()
    }

    fn description(&self) -> Option<&str> {
        Some(&self.file)
    }

    fn describe(&mut self, messages: Vec<Message>) {
        self.messages = messages;
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        DbcDevice::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(DbcBoard::new(spec, self)?))
    }
}
