//! Recorded buses: reads the logs that people have, whatever program wrote them.
//!
//! ```text
//! bytes -> Reader: which format? -> candump | asc | trc | csv (lines), blf (objects)
//!            |                          |
//!            |  stamps, report  <-  frame, time, interface, direction
//!            v
//!          Record
//! ```
//!
//! | format | written by | file |
//! |---|---|---|
//! | candump, on the screen or as a log | can-utils, python-can, SavvyCAN | [`candump`] |
//! | Vector ASC | CANoe, CANalyzer, CANape, python-can, can-utils' log2asc | `asc` |
//! | Vector BLF | the same | `blf` |
//! | PEAK TRC 1.0 to 2.1 | PCAN-View, PCAN-Explorer, python-can | `trc` |
//! | CSV with python-can's columns | python-can | `csv` |
//!
//! The first bytes or lines tell the format, not the file's name. A program can add formats that
//! need libraries which the gateway does not depend on ([`convert_with`]).
//!
//! **Interfaces.** ASC, BLF and TRC number their channels from 1. Channel 1 is read as interface
//! `can0`, channel 2 as `can1` and so on: python-can and log2asc number them this way, too. A CSV
//! and a TRC without a column for the bus have one channel: `can0`. Which frames a bus takes, given
//! these names: [`Matching`](crate::link::replay::Matching).
//!
//! **Times** are whole nanoseconds, never a floating-point number. A stamp is absolute if the
//! file tells when the recording began, which is taken as UTC (Vector's and PEAK's programs write
//! local time without its zone); else it counts from the start of the recording.
//!
//! **Error frames** of other formats than candump's become an error frame of class bus error
//! without data: what more they tell differs between programs and adapters.
//!
//! A stamp more than 146 years from its origin is no instant; its record is skipped.
//!
//! **Damage.** A line or object that cannot be read is skipped, counted and reported; so is the
//! end of a file that was cut off. What comes before and after is read.

mod asc;
mod blf;
pub mod candump;
mod csv;
mod reader;
mod record;
mod stamps;
mod text;
mod trc;

pub use reader::{LogReader, LogReport, REORDER, StepBack};
pub use record::{FrameDirection, LineError, LogFormat, Record};
pub use stamps::{STAMPS_OPTION, Stamps};

use std::fmt;
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;
use std::sync::OnceLock;

/// A log, as bytes of one of these formats.
pub struct Bytes(Box<dyn Read + Send>);

impl Bytes {
    /// Those that `from` gives.
    pub fn of(from: impl Read + Send + 'static) -> Self {
        Self(Box::new(from))
    }
}

impl Read for Bytes {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.0.read(buffer)
    }
}

impl fmt::Debug for Bytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Bytes")
    }
}

/// Makes of a file what can be read: the file itself, or what it is as a log of these formats.
pub type Convert = fn(File, &Path) -> io::Result<Bytes>;

static CONVERT: OnceLock<Convert> = OnceLock::new();

/// Has every log that is opened from now on converted by `convert`. Only the first call counts.
pub fn convert_with(convert: Convert) {
    let _ = CONVERT.set(convert);
}

/// Opens the log at `path`.
///
/// # Errors
/// It cannot be opened, or not be converted.
pub fn open(path: &Path) -> io::Result<Bytes> {
    let file = File::open(path)?;
    match CONVERT.get() {
        Some(convert) => convert(file, path),
        None => Ok(Bytes::of(file)),
    }
}
