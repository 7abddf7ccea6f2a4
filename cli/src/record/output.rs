//! Where a recording goes: a table, or a recording that viewers read too.

use proprio_bridge::Heard;
use proprio_gateway::clock::realtime_offset;
use proprio_recording::{About, Recorder, WriteError};
use proprio_topics::Nanos;
use proprio_topics::csv::{Columns, Series, Writer};
use std::fs::File;
use std::io::{self, BufWriter, Write as _};

/// This program, with its version.
const PROGRAM: &str = concat!("proprio ", env!("CARGO_PKG_VERSION"));
/// How often it is recorded how gateway, buses, devices and estimator are.
const DIAGNOSTICS: Nanos = Nanos::from_millis(1000);

/// The file that is written.
pub(super) enum Output {
    /// A table of so many series; and the values of others, which are not in it.
    Table(Writer<BufWriter<File>>, usize, u64),
    /// A recording, and when it is next recorded how everything is.
    Recording(Box<Recorder<BufWriter<File>>>, Nanos),
}

impl Output {
    pub(super) fn table(file: File, series: &[Series], columns: Columns) -> io::Result<Self> {
        let writer = Writer::new(BufWriter::new(file), series, columns)?;
        Ok(Self::Table(writer, series.len(), 0))
    }

    pub(super) fn recording(
        file: File,
        robot: &str,
        series: &[Series],
    ) -> Result<Self, WriteError> {
        let about = About {
            robot: robot.to_owned(),
            program: PROGRAM.to_owned(),
            offset: realtime_offset(),
            files: Vec::new(),
        };
        let recorder = Recorder::new(BufWriter::new(file), &about, series)?;
        Ok(Self::Recording(Box::new(recorder), Nanos::MIN))
    }

    /// The series that are known by now.
    pub(super) fn know(&mut self, series: &[Series]) -> Result<(), WriteError> {
        match self {
            Self::Table(..) => Ok(()),
            Self::Recording(recorder, _) => recorder.know(series),
        }
    }

    pub(super) fn push(&mut self, t: Nanos, heard: &Heard) -> io::Result<()> {
        match (self, heard) {
            (Self::Table(table, count, others), Heard::Value(series, value)) => {
                if series >= count {
                    *others += 1;
                    return Ok(());
                }
                table.push(Some(t), *series, value)
            }
            (Self::Table(..), _) => Ok(()),
            (Self::Recording(recorder, _), heard) => {
                recorder.say(t, heard).map_err(io::Error::other)
            }
        }
    }

    /// Values that are not in the file, because it has no column for them.
    pub(super) const fn without_column(&self) -> u64 {
        match self {
            Self::Table(.., others) => *others,
            Self::Recording(..) => 0,
        }
    }

    /// Writes what was recorded until `now` to the file.
    pub(super) fn flush(&mut self, now: Nanos) -> io::Result<()> {
        match self {
            Self::Table(table, ..) => table.flush(),
            Self::Recording(recorder, next) => {
                if now >= *next {
                    *next = now + DIAGNOSTICS;
                    recorder.diagnostics(now).map_err(io::Error::other)?;
                }
                recorder.flush().map_err(io::Error::other)
            }
        }
    }

    pub(super) fn finish(self) -> io::Result<()> {
        match self {
            Self::Table(table, ..) => table.finish().map(drop),
            Self::Recording(recorder, _) => {
                let mut file = recorder.finish().map_err(io::Error::other)?;
                file.flush()
            }
        }
    }
}
