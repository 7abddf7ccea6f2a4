//! CANopen drives (CiA 402): position, velocity, torque and current of a motor.
//!
//! The address is the node, 1 to 127. The drive sends what its process data (TPDO 1 to 4) are
//! mapped to; the driver asks for that mapping at start and changes nothing in it, unless the keys
//! want it to. Little-endian:
//!
//! | object | meaning | |
//! |---|---|---|
//! | 6064, else 6063 | position | i32 counts |
//! | 606C | velocity | i32, in the unit of 60A9 or `velocity_unit` |
//! | 6077 | torque | i16, a thousandth of the rated torque |
//! | 6078 | current | i16, a thousandth of the rated current, or mA |
//! | 6041 | status word; bit 3: fault | u16, `encoder` of the actuator reading |
//! | 6061 | mode of operation | i8, `mode` |
//! | 603F | error code | u16, `faults`; without it the code of the last emergency message |
//!
//! At start the driver checks that the profile (object 1000) is 402, asks for identifier (1800 sub
//! 1), transmission (sub 2) and mapping (1A00) of each TPDO, and for what the keys do not tell:
//! the unit of positions (60A8) and counts per turn (608F: counts, turns), the unit of velocities
//! (60A9; without it counts per second), rated torque (6076, mNm) and rated current (6075, mA).
//! Then it sets the node operational. It never enables or moves a motor, and at the gateway's end
//! the node stays operational.
//!
//! With `configure = true` it sets the node pre-operational first, and maps its TPDOs as `pdos`
//! say, else status, position and mode (TPDO 1) and velocity (TPDO 2): by `sync`, or each
//! `period_ms` (1800 sub 5). Other TPDOs stay as they are. Nothing is stored in the node.
//!
//! - The rated torque of maxon's drives (maker 0xFB: object 1018 sub 1, or VendorNumber of the
//!   file) is in millionths of a newton metre. Others may have other units, too: a rated torque
//!   that no motor has with its rated current (less than 0.0005 or more than 50 Nm/A), or with its
//!   greatest speed (6080; more than 50 kW), is refused. `rated_torque_unit` or `rated_torque`
//!   settle it.
//! - If the position is sent by SYNC (transmission 0 to 240), a reading holds the values of all
//!   TPDOs that one SYNC has caused, and `acquired` is the time of that SYNC. An incomplete reading
//!   is dropped, and the next one too: it may hold a late value of the one before.
//! - Torque or current whose rated value is not known is left out, and that is told; if `pdos` of
//!   the keys ask for it, the drive is refused.
//! - If the position is sent by events or a timer (254, 255), each makes a reading, with the last
//!   values of the others if they are not older than `hold_ms`. If several TPDOs have a position,
//!   one makes the readings: one by SYNC; else one until another comes more than three times as
//!   often, or one with more values as often.
//! - DRIVE_FAULT: the fault bit of the status word, or an emergency message; DEVICE_FAULT: an
//!   emergency message about a sensor (73xx), which makes the position doubtful.
//!
//! A node that boots or leaves the operational state is started again.
//!
//! Mapping and scales are those of the keys; else what the drive says; else those of the maker's
//! file, `eds`, in which what is not used may be wrong (a TPDO without the objects above, one that
//! is off, or one of identifier 0). A drive is asked. If another program
//! commands it (`listen_only`, or a recorded log), its answers to that program count, and what that
//! program writes to it. Of scales a file counts if it is a DCF that states them (ParameterValue),
//! or if they are constants: an EDS is of a kind of drive, and knows no motor; but its units (60A8,
//! 60A9) and its maker count. The bus is opened for the identifiers of the keys or the file, else
//! those of CiA 301, also for a TPDO that the file switches off: the drive may have it on. A drive
//! that sends at another one is refused, with that identifier.
//!
//! Sources: CiA 301 4.2, CiA 303-2 (codes of units), CiA 306 1.3, CiA 402 4.0 (IEC 61800-7-201); a
//! file that EPOS Studio made of an EPOS4. Certain, but for the units of velocity, torque and
//! current, in which makers differ: hence the keys.
//!
//! # Keys
//! ```toml
//! counts_per_turn = 4096        # of the motor; default: the drive's own
//! velocity_unit = "counts/s"    # "counts/s", "0.1 counts/s", "rpm" or "0.1 rpm"; default: its own
//! rated_torque = 0.5            # Nm; default: the drive's own
//! rated_torque_unit = "mNm"     # of the drive's own, "mNm" or "uNm"; default: its maker's
//! rated_current = 3.0           # A; default: the drive's own
//! current_unit = "per_mille"    # "per_mille" or "mA"
//! hold_ms = 100.0
//! eds = "drive.eds"             # the maker's EDS or DCF file, relative to gateway.toml
//! configure = false             # true: the drive is set to `pdos`
//! # The process data, if the drive is not to be asked: objects as indices, in their order.
//! pdos = [
//!     { number = 1, objects = [0x6041, 0x6064, 0x6077], sync = 1 },
//!     # sync = 0: by events or a timer; without id at 280 + node
//!     { number = 2, objects = [0x606C, 0x6078], sync = 1, id = 0x2A1 },
//! ]
//! # For a drive that is configured, and a simulated one, which without `pdos` or `eds` sends
//! # status, position, mode, velocity.
//! period_ms = 10
//! sync = 0
//! ```

mod board;
mod device;
mod layout;
mod options;
mod start;

pub use board::DriveBoard;
pub use options::{CurrentUnit, Options, PdoKeys, VelocityUnit};

use crate::canopen::{self, Recognised};
use crate::objects::Objects;
use crate::recognise::{Finding, Key, Stream, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::format;
use alloc::vec::Vec;
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "canopen_drive";

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Joint)].to_vec()
    }

    fn eds(&self) -> Option<&str> {
        self.eds.as_deref()
    }

    fn describe_objects(&mut self, objects: Objects) {
        self.objects = Some(objects);
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        device::Drive::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(DriveBoard::new(spec, self)?))
    }

    /// Nodes of other profiles too, which no driver reads.
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let find = |node: Recognised<'_>| {
            let (what, unusable) = match node.profile {
                Some(406) => return None,
                Some(402) => (format!("CANopen drive (CiA 402){}", node.identity), ""),
                None => (canopen::NO_PROFILE.into(), ""),
                Some(other) => {
                    let what = format!("CANopen node of profile {other}{}", node.identity);
                    (
                        what,
                        "no driver reads this profile; a .dbc file can describe it",
                    )
                }
            };
            let finding = (node.evidence).finding(Self::NAME, node.node.into(), what)?;
            // Its position is rather in the most frequent of them.
            let periods = node.tpdos.into_iter().flatten().filter_map(Stream::period);
            let finding = finding
                .with_keys(Key::period_ms(periods.min(), 1, 60_000))
                .with_joints([0])
                .with_commands(canopen::commands(node.node));
            Some(Finding {
                unusable,
                guess: node.profile.is_none(),
                needs_sync: node.needs_sync,
                ..finding
            })
        };
        canopen::recognise(seen).filter_map(find).collect()
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        canopen::questions(seen)
    }
}
