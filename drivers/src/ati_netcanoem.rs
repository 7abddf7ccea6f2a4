//! ATI force/torque sensors with the NETCANOEM board (Nano, Mini, Gamma, Delta, Theta, Omega).
//!
//! The board sends nothing by itself. Its identifiers are `base` << 4 | opcode; the address is the
//! base, 0 to 127. A request and its reply share an identifier and differ in length. Big-endian.
//!
//! | opcode | request | reply |
//! |---|---|---|
//! | 0 | empty | status u16, gauges 0, 2, 4 (i16); then opcode 1: gauges 1, 3, 5 |
//! | 2 | axis 0 to 5 | opcodes 2, 3, 4: columns 0 and 1, 2 and 3, 4 and 5 of that row, as f32 |
//! | 5 | empty | serial number, letters and digits |
//! | 6 | calibration 0 to 15 | the same; selects the calibration in use |
//! | 7 | empty | counts per unit of force, of torque (u32) |
//! | 8 | empty | unit of force, of torque (u8) |
//!
//! - Wrench: axis i is the sum over j of matrix\[i\]\[j\] gauge\[j\], divided by the counts per
//!   unit of force (i = 0 to 2) or torque (3 to 5).
//! - Units: force 1 lbf, 2 N, 3 klbf, 4 kN, 5 kgf, 6 gf; torque 1 lbf-in, 2 lbf-ft, 3 Nm, 4 Nmm,
//!   5 kgf-cm, 6 kNm.
//! - Status: bit 0 watchdog, 1 and 2 converters, 3 ground, 4 and 5 supply, 6 calibration, 7 memory,
//!   8 configuration, 11 and 12 temperature: DEVICE_FAULT. Bit 14, an error of the bus, is none of
//!   the measurement's. Bit 15 is set with any of them.
//! - A gauge at -32768, -32767 or 32767 is saturated. Each gauge acts on all axes: the reading is
//!   SATURATED, without an axis.
//!
//! The driver asks for matrix, counts and units before it asks for readings, and refuses the sensor
//! (`Refusal::NoCalibration`) as long as one is missing; a row of zeros, a number that is not
//! finite and zero counts are refused by name. A reply that differs from an earlier one is refused
//! too; where the driver asks, a row that differs twice in the same way.
//!
//! Both halves of a reading have identifiers of different priority: the second may leave the board
//! after the first half of the next reading. Each half comes in the order of the requests, so they
//! are paired first in, first out, and given once there are as many second halves as first ones.
//! A lost half therefore costs up to four readings, and none is wrong, unless a first half is lost
//! within four readings of a second one. The driver itself sends a request only after the replies
//! to the last one, or 30 ms after a request that was not answered. A reply more than there were
//! requests, as from a bridge that repeats frames, makes all readings of a second DEVICE_FAULT: any
//! of them may be an old one.
//!
//! If another program polls the sensor (`listen_only`, or a recorded log), its requests tell which
//! row of the matrix a reply holds. So a log of such a program's start decodes without any key.
//! No reply says which row it holds: two programs must not ask one sensor at a time.
//!
//! Sources: ATI manual 9610-05-1030-04 (Network F/T NETCANOEM). Certain: three programs of others
//! that talk to these boards agree. Their baud rate is 2 Mbit/s / (divisor + 1), or 250 kbit/s by
//! switch 2-1.
//!
//! # Recognition
//! A scan that is told to ask for this family sends opcode 8 (units) to all bases, then 5 (serial
//! number) and 7 to those that answer. It must be told, because the identifiers are those of
//! commands to CANopen nodes and JR3 boards (`208` is a start). Without questions a board is
//! recognised by what it answers to another program.
//!
//! # Keys
//! ```toml
//! period_ms = 2            # of the requests, 1 to 1000
//! calibration = 0          # selects this one of the sensor's at start; default: the one in use
//! # Instead of the sensor's own; each only with its pair.
//! counts_per_force = 1000000
//! counts_per_torque = 1000000
//! force_unit = "N"         # "lbf", "N", "klbf", "kN", "kgf" or "gf"
//! torque_unit = "Nm"       # "lbf-in", "lbf-ft", "Nm", "Nmm", "kgf-cm" or "kNm"
//! matrix = [
//!     [14000, 0, 0, 0, 0, 0],
//!     [0, 14000, 0, 0, 0, 0],
//!     [0, 0, 14000, 0, 0, 0],
//!     [0, 0, 0, 700, 0, 0],
//!     [0, 0, 0, 0, 700, 0],
//!     [0, 0, 0, 0, 0, 700],
//! ]
//! ```

mod board;
mod calibration;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::NetcanoemBoard;
pub use frames::{ForceUnit, TorqueUnit};
pub use options::Options;

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use frames::BASE_MOST;
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "ati_netcanoem";
    const ADDRESS: Option<u32> = Some(0x20);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        device::Netcanoem::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(NetcanoemBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        (0..=BASE_MOST)
            .filter_map(|base| recognise::sensor(seen, Self::NAME, base))
            .collect()
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        recognise::questions(seen)
    }

    const ASKED_BY_NAME: bool = true;
}
