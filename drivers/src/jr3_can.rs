//! JR3 force/torque sensors at the CAN boards of Universidad Carlos III de Madrid
//! (jr3-mbed-firmware-can).
//!
//! The bit rate is 1 Mbit/s. An identifier is an operation plus the board's number `n`, 1 to 7F,
//! which is the device's `address`. Streams and answers, little-endian:
//!
//! | identifier | name | bytes | content |
//! |---|---|---|---|
//! | `600` + n | force | 8 | fx fy fz i16, counter u16 |
//! | `680` + n | moment | 8 | mx my mz i16, counter u16 |
//! | `100` + n | acknowledge | 1 | state: 0 ready, 1 not initialised |
//! | `100` + n | full scales | 7 | state, then three u16 \[N, or 0.1 Nm\] |
//! | `700` + n | boot-up | 0 | the board has started |
//!
//! - value = i16 / 16384 x full scale of its axis; one above the full scale is counted as out of
//!   range. A value at an end of the 16 bits is reported as
//!   saturated.
//! - `counter` is equal in both frames of a reading: they are paired by it. It counts the sensor's
//!   own samples, one each 128.5 us, not the readings: how many readings were lost follows from it
//!   and the period. A reading with the counter of the one before has FROZEN: the board repeats
//!   itself, because its sensor sends nothing.
//!
//! Commands, answered by an acknowledgement unless stated otherwise:
//!
//! | identifier | bytes | meaning |
//! |---|---|---|
//! | `480` + n | none | full scales of forces, answered by them |
//! | `500` + n | none | full scales of moments, answered by them |
//! | `200` + n | cut-off u16 \[0.01 Hz\], period u32 \[us\] | start |
//! | `280` + n | none | stop |
//! | `300` + n | none | take the present load as the zero |
//!
//! - **Each start takes the present load as the zero** (as does `180` + n, which other programs may
//!   send, and `300` + n, which [`Command::Tare`](crate::Command::Tare) sends). Readings from such
//!   a command to its acknowledgement, and the first after it, have ZERO_CHANGED; so has the first
//!   after a boot-up.
//! - After a boot-up the board waits for a start, so it is asked and started again at once.
//! - The answers to both questions about full scales look alike. One question is asked at a time,
//!   and the other one only when no answer to the first can be on its way any more. A device that
//!   only listens needs to hear the question, too.
//! - **Without full scales there is no reading**: they come from the configuration, else from the
//!   board ([`Refusal::NoFullScale`] if it does not answer, [`Refusal::ZeroFullScale`],
//!   [`Refusal::Changed`] as for `icub_strain`).
//!
//! Sources: `README.md` and `main.cpp` (roboticslab-uc3m/jr3-mbed-firmware-can 06ff3ecf),
//! `Jr3Controller.cpp` (jr3-mbed-firmware 765f7841: zero at start, samples), the host
//! `YarpPlugins/Jr3Mbed` (yarp-devices c491fe5a: full scales of moments in 0.1 Nm, counter at the
//! rate of samples). Highly probable. An older firmware has other identifiers (`580` and `600` for
//! the streams): its boards are not read.
//!
//! # Recognition
//! Boards are recognised by the counter that both halves of a reading have. A scan that is told to
//! ask for this family sends the questions for full scales to all numbers. It must be told, because
//! their identifiers are those of commands to CANopen nodes.
//!
//! # Keys
//! ```toml
//! full_scale_n = [115, 111, 185]    # both or neither; overrides the board's own
//! full_scale_nm = [5.6, 5.2, 6.1]
//! period_ms = 10                    # 1 to 1000
//! cutoff_hz = 0.0                   # of the board's low-pass filter, up to 655.35; 0: no filter
//! ```
//!
//! [`Refusal::NoFullScale`]: proprio_topics::Refusal::NoFullScale
//! [`Refusal::ZeroFullScale`]: proprio_topics::Refusal::ZeroFullScale
//! [`Refusal::Changed`]: proprio_topics::Refusal::Changed

mod board;
mod device;
mod options;
mod protocol;
mod recognise;
mod scales;

pub use board::Jr3Board;
pub use options::Options;

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Jr3;
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "jr3_can";
    const ADDRESS: Option<u32> = Some(1);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Jr3::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(Jr3Board::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        (1..=0x7F)
            .filter_map(|node| recognise::board(seen, Self::NAME, node))
            .collect()
    }

    fn questions(_seen: &Traffic) -> Vec<Frame> {
        recognise::questions()
    }

    const ASKED_BY_NAME: bool = true;
}
