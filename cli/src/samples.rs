//! Tables of samples and logs of frames, of which a recording (MCAP) has both: it becomes one or
//! the other while it is read.

use anyhow::Context;
use proprio_gateway::log::{Bytes, candump};
use proprio_recording::{
    ReadError, RecordingSummary, about, frames, is_mcap, to_estimates, to_table,
};
use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter, Cursor, PipeReader, PipeWriter, Read, Write as _};
use std::path::Path;
use std::thread::{self, JoinHandle};
use tempfile::TempDir;

/// What becomes of a recording.
#[derive(Clone, Copy)]
enum Conversion {
    /// A table; `from_table`: what is one already stays as it is.
    Table {
        from_table: bool,
    },
    Estimates,
    /// A log; what is no recording stays as it is.
    Frames,
}

/// The table of a recording's samples, or of its estimates.
pub(crate) fn of_recording(
    input: impl Read + Send + 'static,
    path: &Path,
    estimates: bool,
) -> anyhow::Result<Bytes> {
    let what = match estimates {
        true => Conversion::Estimates,
        false => Conversion::Table { from_table: false },
    };
    convert(input, path, what).with_context(|| format!("{}: cannot be read", path.display()))
}

/// The table that `input` is, or has as a recording.
pub(crate) fn table(input: impl Read + Send + 'static, path: &Path) -> anyhow::Result<Bytes> {
    convert(input, path, Conversion::Table { from_table: true })
        .with_context(|| format!("{}: cannot be read", path.display()))
}

/// The log that `input` is, or has as a recording with raw frames.
pub(crate) fn log(input: impl Read + Send + 'static, path: &Path) -> io::Result<Bytes> {
    convert(input, path, Conversion::Frames)
}

/// The log in this file.
pub(crate) fn log_of_file(file: File, path: &Path) -> io::Result<Bytes> {
    log(file, path)
}

fn convert(
    mut input: impl Read + Send + 'static,
    path: &Path,
    what: Conversion,
) -> io::Result<Bytes> {
    let mut beginning = Vec::new();
    input.by_ref().take(8).read_to_end(&mut beginning)?;
    let is_recording = is_mcap(&beginning);
    let whole = Cursor::new(beginning).chain(input);
    match (is_recording, what) {
        (true, _) => {}
        (false, Conversion::Table { from_table: true } | Conversion::Frames) => {
            return Ok(Bytes::of(whole));
        }
        (false, _) => return Err(io::Error::other("it is no recording (MCAP)")),
    }
    let (pipe, to) = io::pipe()?;
    let thread = thread::Builder::new()
        .name("recording".into())
        .spawn(move || {
            let whole = BufReader::new(whole);
            match what {
                Conversion::Table { .. } => to_table(whole, to),
                Conversion::Estimates => to_estimates(whole, to),
                Conversion::Frames => to_log(whole, to),
            }
        })?;
    Ok(Bytes::of(Converted {
        name: path.display().to_string(),
        pipe,
        thread: Some(thread),
    }))
}

fn to_log(recording: impl Read, to: PipeWriter) -> Result<RecordingSummary, ReadError> {
    let mut log = candump::Writer::new(BufWriter::new(to));
    let summary = frames(recording, |bus, frame| log.write(bus, frame))?;
    log.finish()?.flush()?;
    Ok(summary)
}

/// A recording on its way to a table or a log, in a thread of its own.
struct Converted {
    name: String,
    pipe: PipeReader,
    thread: Option<JoinHandle<Result<RecordingSummary, ReadError>>>,
}

impl Read for Converted {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.pipe.read(buffer)?;
        if count > 0 || buffer.is_empty() {
            return Ok(count);
        }
        // The end, or the end of what could be read.
        let Some(thread) = self.thread.take() else {
            return Ok(0);
        };
        let summary = thread
            .join()
            .map_err(|_| io::Error::other("a defect of this program"))?
            .map_err(io::Error::other)?;
        if summary.is_cut {
            eprintln!(
                "{}: the end is missing or damaged: the recorder was killed, or the file was cut",
                self.name
            );
        }
        if summary.without_column > 0 {
            eprintln!(
                "{}: {} samples skipped: their channels came to be known while it was recorded",
                self.name, summary.without_column
            );
        }
        if summary.damaged > 0 {
            eprintln!(
                "{}: {} damaged messages skipped",
                self.name, summary.damaged
            );
        }
        Ok(0)
    }
}

/// The files that a recording took along, in a folder of their own; `None` if it has none, or
/// `path` is no recording.
pub(crate) fn files_in(path: &Path) -> anyhow::Result<Option<TempDir>> {
    let cannot = || format!("{}: cannot be read", path.display());
    let mut beginning = Vec::new();
    let file = File::open(path).with_context(cannot)?;
    (&file)
        .take(8)
        .read_to_end(&mut beginning)
        .with_context(cannot)?;
    if !is_mcap(&beginning) {
        return Ok(None);
    }
    let whole = Cursor::new(beginning).chain(BufReader::new(file));
    let about = about(whole).with_context(cannot)?;
    if about.files.is_empty() {
        return Ok(None);
    }
    let folder = TempDir::with_prefix("proprio-")?;
    for (name, bytes) in &about.files {
        // A file of another program could name a place outside.
        let name: &Path = name.as_ref();
        if name
            .components()
            .all(|part| matches!(part, std::path::Component::Normal(_)))
        {
            let place = folder.path().join(name);
            if let Some(parent) = place.parent() {
                fs::create_dir_all(parent)?;
            }
            fs::write(&place, bytes).with_context(|| place.display().to_string())?;
        }
    }
    Ok(Some(folder))
}
