//! Tables of samples: CSV, or recordings (MCAP), which become tables while they are read.

use anyhow::Context;
use proprio_recording::{ReadError, Summary, is_mcap, to_table};
use std::io::{self, BufReader, Cursor, PipeReader, Read};
use std::path::Path;
use std::thread::{self, JoinHandle};

/// The table that `input` is, or has as a recording.
pub(crate) fn table(
    mut input: impl Read + Send + 'static,
    path: &Path,
) -> anyhow::Result<Box<dyn Read + Send>> {
    let cannot = || format!("{}: cannot be read", path.display());
    let mut beginning = Vec::new();
    input
        .by_ref()
        .take(8)
        .read_to_end(&mut beginning)
        .with_context(cannot)?;
    let is_recording = is_mcap(&beginning);
    let whole = Cursor::new(beginning).chain(input);
    if !is_recording {
        return Ok(Box::new(whole));
    }
    let (pipe, to) = io::pipe().with_context(cannot)?;
    let thread = thread::Builder::new()
        .name("recording".into())
        .spawn(move || to_table(BufReader::new(whole), to))
        .with_context(cannot)?;
    Ok(Box::new(Converted {
        name: path.display().to_string(),
        pipe,
        thread: Some(thread),
    }))
}

/// A recording on its way to a table, in a thread of its own.
struct Converted {
    name: String,
    pipe: PipeReader,
    thread: Option<JoinHandle<Result<Summary, ReadError>>>,
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
