//! Reads a whole log record by record. Skips and reports bad lines, and detects the origin of the
//! stamps.

use super::line::{LineError, MAX_LINE, Parsed, ParsedLine, Record, parse_line};
use super::stamp::StampForm;
use arrayvec::ArrayVec;
use proprio_topics::Nanos;
use std::io::{self, BufRead, Read};

/// Maximum number of bad lines in a [`Report`].
const NAMED: usize = 8;
/// The order of the frames in a log is that of their stamps, except within this time \[ns\]: the
/// recorder reads one interface after the other.
pub const REORDER: Nanos = Nanos::from_millis(100);

/// The meaning of a log's relative stamps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Stamps {
    /// Detect it, as the module documentation describes.
    #[default]
    Detect,
    /// Each counts from the log's origin.
    SinceOrigin,
    /// Each counts from the previous line (`candump -t d`).
    SincePrevious,
}

/// The counts of a [`Reader`] so far.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Report {
    /// Lines, including bad ones.
    pub lines: u64,
    /// Frames.
    pub records: u64,
    /// Frames without a stamp.
    pub unstamped: u64,
    /// Frames with an earlier stamp than the previous frame.
    pub backwards: u64,
    /// Frames that candump reports as lost.
    pub dropped: u64,
    /// Lines that could not be read; they are skipped.
    pub bad: u64,
    /// Line number and error of the first eight of them.
    pub first_bad: ArrayVec<(u64, LineError), NAMED>,
}

impl Report {
    fn reject(&mut self, line: u64, error: LineError) {
        self.bad += 1;
        // The ninth and later ones are only counted.
        let _ = self.first_bad.try_push((line, error));
    }
}

/// Reads the records of a log one after the other; allocates nothing after construction.
///
/// A line that cannot be read is skipped and reported. A last line without a line end, as a stopped
/// recorder leaves it, counts only if no continuation could make it another frame: half a payload
/// is not returned as a short one.
///
/// A stamp that is later than the next frame's by more than [`REORDER`], while the next is not
/// earlier than the one before, is wrong: its frame is skipped and reported. (Everything after it
/// would otherwise seem late.)
#[derive(Debug)]
pub struct Reader<R> {
    inner: R,
    line: Vec<u8>,
    /// The frame after the current one, if it has been read already: its text, the number of its
    /// line, and the frame.
    next_line: Vec<u8>,
    next: Option<(u64, Parsed)>,
    stamps: Stamps,
    sum: Nanos,
    last: Option<Nanos>,
    report: Report,
}

impl<R: BufRead> Reader<R> {
    /// Reads from `inner`. To detect the meaning of relative stamps it looks ahead in `inner`'s
    /// buffer.
    pub fn new(inner: R) -> Self {
        Self::with_stamps(inner, Stamps::Detect)
    }

    /// Reads from `inner`; relative stamps have the meaning `stamps`.
    pub fn with_stamps(inner: R, stamps: Stamps) -> Self {
        let line = || Vec::with_capacity(MAX_LINE + 2);
        Self {
            inner,
            next_line: line(),
            line: line(),
            next: None,
            stamps,
            sum: Nanos::ZERO,
            last: None,
            report: Report::default(),
        }
    }

    /// The counts so far.
    pub const fn report(&self) -> &Report {
        &self.report
    }

    /// The meaning of relative stamps; [`Stamps::Detect`] until the first one was read.
    pub const fn stamps(&self) -> Stamps {
        self.stamps
    }

    /// The next record; `None` at the end of the log.
    ///
    /// # Errors
    /// A read error of `inner`. A bad line is not an error: see [`Reader::report`].
    pub fn next_record(&mut self) -> io::Result<Option<Record<'_>>> {
        let parsed = loop {
            let Some((number, parsed)) = self.next_frame()? else {
                return Ok(None);
            };
            match self.ahead(&parsed)? {
                None => break parsed,
                Some(ahead) => self.report.reject(number, LineError::Ahead { ahead }),
            }
        };
        let stamp = match parsed.stamp {
            None => {
                self.report.unstamped += 1;
                None
            }
            Some((t, StampForm::Relative)) => {
                if self.stamps == Stamps::Detect {
                    self.stamps = look_ahead(t, self.inner.fill_buf()?);
                }
                self.sum = self.sum.saturating_add(t);
                Some(if self.stamps == Stamps::SincePrevious {
                    self.sum
                } else {
                    t
                })
            }
            Some((t, _)) => Some(t),
        };
        if stamp.is_some() {
            self.report.backwards += u64::from(stamp < self.last);
            self.last = stamp;
        }
        self.report.records += 1;
        Ok(parsed.record(&self.line, stamp))
    }

    /// The next frame and the number of its line; its text is in `line`. Lines without a frame are
    /// skipped.
    fn next_frame(&mut self) -> io::Result<Option<(u64, Parsed)>> {
        if let Some(next) = self.next.take() {
            std::mem::swap(&mut self.line, &mut self.next_line);
            return Ok(Some(next));
        }
        loop {
            match self.next_parsed()? {
                None => return Ok(None),
                Some(Ok(ParsedLine::Record(parsed))) => {
                    return Ok(Some((self.report.lines, parsed)));
                }
                Some(Ok(ParsedLine::Dropped(count))) => {
                    self.report.dropped = self.report.dropped.saturating_add(count);
                }
                Some(Ok(ParsedLine::Note)) => {}
                Some(Err(error)) => self.report.reject(self.report.lines, error),
            }
        }
    }

    /// By how much the stamp of `parsed` is too late to be right \[ns\], if it is. Only a stamp
    /// that jumps is compared with the next one, which is then read.
    fn ahead(&mut self, parsed: &Parsed) -> io::Result<Option<Nanos>> {
        let counts_from_origin = |form: StampForm| match form {
            StampForm::Absolute | StampForm::Origin => true,
            StampForm::Relative => self.stamps == Stamps::SinceOrigin,
        };
        let Some((t, form)) = parsed.stamp else {
            return Ok(None);
        };
        let last = self.last.unwrap_or(Nanos::MIN);
        if !counts_from_origin(form) || t.saturating_sub(last) <= REORDER {
            return Ok(None);
        }
        std::mem::swap(&mut self.line, &mut self.next_line);
        self.next = self.next_frame()?;
        std::mem::swap(&mut self.line, &mut self.next_line);
        let Some((next, _)) = self.next.as_ref().and_then(|(_, next)| next.stamp) else {
            return Ok(None);
        };
        let ahead = t.saturating_sub(next);
        Ok((ahead > REORDER && next >= last.saturating_sub(REORDER)).then_some(ahead))
    }

    /// Reads and parses the next line; `None` at the end.
    fn next_parsed(&mut self) -> io::Result<Option<Result<ParsedLine, LineError>>> {
        self.line.clear();
        let most = MAX_LINE as u64 + 1;
        if self
            .inner
            .by_ref()
            .take(most)
            .read_until(b'\n', &mut self.line)?
            == 0
        {
            return Ok(None);
        }
        self.report.lines += 1;
        let ended = self.line.last() == Some(&b'\n');
        if !ended && self.line.len() > MAX_LINE {
            // The rest of the line, in parts.
            while self.line.last() != Some(&b'\n') {
                self.line.clear();
                if self
                    .inner
                    .by_ref()
                    .take(most)
                    .read_until(b'\n', &mut self.line)?
                    == 0
                {
                    break;
                }
            }
            return Ok(Some(Err(LineError::LineTooLong)));
        }
        let parsed = parse_line(&self.line);
        Ok(Some(match parsed {
            Ok(ParsedLine::Record(ref record)) if !ended && !record.whole => {
                Err(LineError::Unfinished)
            }
            Err(_) if !ended => Err(LineError::Unfinished),
            parsed => parsed,
        }))
    }
}

/// Whether the stamps that follow `first` in `buffered` ever decrease.
fn look_ahead(first: Nanos, buffered: &[u8]) -> Stamps {
    let mut last = first;
    for line in buffered.split(|c| *c == b'\n') {
        if let Ok(ParsedLine::Record(Parsed {
            stamp: Some((t, StampForm::Relative)),
            ..
        })) = parse_line(line)
        {
            if t < last {
                return Stamps::SincePrevious;
            }
            last = t;
        }
    }
    Stamps::SinceOrigin
}
