//! Robotous RFT force/torque sensors with a CAN interface.
//!
//! The bit rate is 1 Mbit/s. A sensor listens to one identifier and answers on two others, a first
//! and a second frame for each response. The maker delivers it with 64, 1 and 2 (hexadecimal);
//! all three can be changed, within 1 to FF. The device's `address` is the identifier to which the
//! sensor listens.
//!
//! Responses, big-endian:
//!
//! | identifier | name | bytes | content |
//! |---|---|---|---|
//! | `id_first` | data, first frame | 8 | `0B`, fx fy fz i16, upper byte of tx |
//! | `id_second` | data, second frame | 8 | lower byte of tx, ty tz i16, overload, 2 unused |
//! | `id_first` | answer, first frame | 8 | command, answer |
//! | `id_second` | answer, second frame | 8 | the rest of the answer, or zeros |
//!
//! - `tx` is split: its upper byte ends the first frame, its lower byte begins the second.
//! - One step of force is 1 N / `force`, one step of torque 1 Nm / `torque`, by model:
//!
//! | model | force | torque |
//! |---|---|---|
//! | RFT40-SA01, RFT44-SB01, RFT60-HA01, RFT64-SB01, RFT76-HA01 | 50 | 2000 |
//! | RFT64-6A01, RFT80-6A01, RFT80-6A02 | 50 | 1000 |
//! | RFT80-6A03 | 25 | 500 |
//!
//! - `overload`: bits 5 to 0 for fx fy fz tx ty tz, set above 120 % of the rated load. The bit has
//!   no sign: the saturated end is taken from the sign of the value.
//! - The frames have no sequence number: they are paired by order and time (`pairing.rs`).
//!
//! Commands to `address`, 8 bytes, unused ones zero:
//!
//! | bytes | meaning | answer |
//! |---|---|---|
//! | `0B` | start | the data |
//! | `0C` | stop | none |
//! | `10` | get the rate | `10 code` |
//! | `0F code` | set the rate | `0F`, 1 or 0 for an error, error |
//! | `11 01` | bias: the present load becomes the zero, until power-off | none |
//!
//! - Rates by code: 1 to 8 are 10, 20, 50, 100, 200, 333, 500, 1000 Hz; 0 is 200 Hz too.
//! - While it streams, the sensor ignores all commands but stop and bias. So it is stopped before
//!   it is asked.
//! - [`Command::Tare`](crate::Command::Tare) sends bias. The sensor does not confirm it: readings
//!   from then on for 100 ms, and the first after that, have ZERO_CHANGED.
//! - The sensor keeps its rate without power. It is set only if the sensor reports another one,
//!   because its memory wears. A sensor that does not report its rate is started all the same, and
//!   one that never takes the rate is counted as changed: neither spoils a reading.
//!
//! Sources: `RFT Series_Manual_ver1.82.pdf`, `RFT_IF_PACKET_Rev1.2.h` and `.cpp`
//! (ROBOTOUS/Sample-Source_RFT-Series_v1.0 fdcddf9b), `RobotousRFT.cpp`
//! (UniMelbHumanRoboticsLab/CANOpenRobotController 04f8eafe). Certain, except: the scale of
//! RFT76-HA01 (one user's code, which says that it is that of RFT40); code 6, which is 333 Hz in
//! the manual and 300 Hz in the header, so `rate_hz` may be either and means code 6.
//!
//! # Recognition
//! A sensor with the identifiers of delivery is recognised by its data. A scan that is told to ask
//! for this family sends the commands `01` (name), `02` (serial number) and `10`, which a sensor
//! that streams ignores; each is answered by 15 characters. It must be told, because `64` may be
//! the number of a CubeMars motor, for which these bytes are a command. A sensor with other
//! identifiers is not recognised.
//!
//! # Keys
//! ```toml
//! model = "RFT40-SA01"
//! rate_hz = 200         # 10, 20, 50, 100, 200, 300, 333, 500 or 1000
//! id_first = 1          # identifiers of the responses, 1 to 255
//! id_second = 2
//! ```

mod board;
mod device;
mod options;
mod protocol;
mod recognise;

pub use board::RftBoard;
pub use options::{Model, Options};

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Rft;
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "robotous_rft";
    const ADDRESS: Option<u32> = Some(0x64);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Rft::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(RftBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        recognise::sensor(seen).into_iter().collect()
    }

    fn questions(_seen: &Traffic) -> Vec<Frame> {
        recognise::questions()
    }

    const ASKED_BY_NAME: bool = true;
}
