//! Where a recording goes: a table, a recording (MCAP), a series of them, or a black box.

use super::black_box::BlackBox;
use anyhow::{Context, bail};
use proprio_bridge::Heard;
use proprio_drivers::Frame;
use proprio_gateway::clock::realtime_offset;
use proprio_recording::{About, Recorder};
use proprio_topics::Nanos;
use proprio_topics::csv::{Columns, Series, TableWriter};
use std::fs::File;
use std::io::{self, BufWriter, ErrorKind, Write as _};
use std::path::{Path, PathBuf};

/// Creates the file of a recording. An existing one is overwritten only if that is asked for; what
/// is no file, such as a pipe, has nothing to lose.
pub(super) fn create(path: &Path, force: bool) -> anyhow::Result<File> {
    let special = std::fs::metadata(path).is_ok_and(|m| !m.is_file());
    let created = match force || special {
        true => File::create(path),
        false => File::create_new(path),
    };
    match created {
        Err(error) if error.kind() == ErrorKind::AlreadyExists => bail!(
            "{} exists: name another file, or overwrite it with --force",
            path.display()
        ),
        created => created.with_context(|| path.display().to_string()),
    }
}

/// What is written.
pub(super) enum Destination {
    Table(TableFile),
    Recording(Box<RecordingFile>),
    BlackBox(Box<BlackBox>),
}

/// A table of so many series.
pub(super) struct TableFile {
    writer: TableWriter<BufWriter<File>>,
    series: usize,
    /// Values of other series, which are not in it.
    others: u64,
}

/// A recording, in one file or several.
pub(super) struct RecordingFile {
    recorder: Recorder<BufWriter<File>>,
    about: About,
    /// Where the next file is begun, and after what time.
    split: Option<(Split, Nanos)>,
}

/// The names of the files of one recording.
pub(super) struct Split {
    path: PathBuf,
    force: bool,
    number: u32,
    every: Nanos,
}

impl Split {
    /// `path` without a number.
    pub(super) fn new(path: &Path, force: bool, every: Nanos) -> Self {
        Self {
            path: path.to_owned(),
            force,
            number: 0,
            every,
        }
    }

    /// The next file, as `run_0001.mcap`. During a recording (`is_begun`) an existing one is
    /// skipped: the recording goes on.
    fn next(&mut self, is_begun: bool) -> anyhow::Result<File> {
        loop {
            self.number += 1;
            let stem = self.path.file_stem().unwrap_or_default().to_string_lossy();
            let name = format!("{stem}_{:04}.mcap", self.number);
            let path = self.path.with_file_name(name);
            if !is_begun || self.force || !path.exists() {
                return create(&path, self.force);
            }
        }
    }
}

impl Destination {
    pub(super) fn table(file: File, series: &[Series], columns: Columns) -> io::Result<Self> {
        Ok(Self::Table(TableFile {
            writer: TableWriter::new(BufWriter::new(file), series, columns)?,
            series: series.len(),
            others: 0,
        }))
    }

    pub(super) fn recording(file: File, about: About, series: &[Series]) -> anyhow::Result<Self> {
        Ok(Self::Recording(Box::new(RecordingFile {
            recorder: Recorder::new(BufWriter::new(file), &about, series)?,
            about,
            split: None,
        })))
    }

    /// One that begins a new file again and again, from `now` on.
    pub(super) fn split(
        mut split: Split,
        about: About,
        series: &[Series],
        now: Nanos,
    ) -> anyhow::Result<Self> {
        let file = split.next(false)?;
        let mut output = Self::recording(file, about, series)?;
        if let Self::Recording(recording) = &mut output {
            let next = now + split.every;
            recording.split = Some((split, next));
        }
        Ok(output)
    }

    /// Something heard; `series` are all that are known by now.
    pub(super) fn push(&mut self, t: Nanos, heard: &Heard, series: &[Series]) -> io::Result<()> {
        match self {
            Self::Table(table) => match heard {
                Heard::Value(number, _) if *number >= table.series => {
                    table.others += 1;
                    Ok(())
                }
                Heard::Value(number, value) => table.writer.push(Some(t), *number, value),
                _ => Ok(()),
            },
            Self::Recording(recording) => recording.push(t, heard, series),
            Self::BlackBox(black_box) => {
                (black_box.push(t, heard, series)).map_err(io::Error::other)
            }
        }
    }

    /// A raw frame on `bus`.
    pub(super) fn frame(&mut self, bus: &str, frame: &Frame) -> io::Result<()> {
        match self {
            Self::Table(_) => Ok(()),
            Self::Recording(recording) => recording.recorder.frame(bus, frame),
            Self::BlackBox(black_box) => black_box.frame(bus, frame),
        }
        .map_err(io::Error::other)
    }

    /// Values that are not in the file, because it has no column for them.
    pub(super) const fn without_column(&self) -> u64 {
        match self {
            Self::Table(table) => table.others,
            _ => 0,
        }
    }

    /// Writes what was recorded until `now` to the file.
    pub(super) fn flush(&mut self, now: Nanos, series: &[Series]) -> anyhow::Result<()> {
        match self {
            Self::Table(table) => table.writer.flush()?,
            Self::Recording(recording) => recording.flush(now)?,
            Self::BlackBox(black_box) => black_box.turn(now, series)?,
        }
        Ok(())
    }

    /// Ends it at `now`; returns what a person should know of it, if there is something.
    pub(super) fn finish(self, now: Nanos, series: &[Series]) -> anyhow::Result<Option<String>> {
        match self {
            Self::Table(table) => table.writer.finish()?.flush()?,
            Self::Recording(recording) => recording.recorder.finish()?.flush()?,
            Self::BlackBox(mut black_box) => {
                let (written, memory) = (black_box.finish(now, series)?, black_box.memory());
                return Ok(Some(format!(
                    "{written} files were written; the last seconds took {:.1} MB",
                    memory as f64 / 1e6
                )));
            }
        }
        Ok(None)
    }
}

impl RecordingFile {
    fn push(&mut self, t: Nanos, heard: &Heard, series: &[Series]) -> io::Result<()> {
        self.recorder.know(series).map_err(io::Error::other)?;
        self.recorder.say(t, heard).map_err(io::Error::other)?;
        self.recorder.each_second(t).map_err(io::Error::other)
    }

    fn flush(&mut self, now: Nanos) -> anyhow::Result<()> {
        if let Some((split, next)) = &mut self.split
            && now >= *next
        {
            *next = now + split.every;
            let file = BufWriter::new(split.next(true)?);
            self.about.offset = realtime_offset();
            self.recorder.turn_to(file, &self.about)?.flush()?;
        }
        Ok(self.recorder.flush()?)
    }
}
