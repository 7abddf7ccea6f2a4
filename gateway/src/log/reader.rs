//! Reads a whole log record by record. Detects the format and the origin of the stamps; skips and
//! reports what cannot be read.

use super::asc::Asc;
use super::blf::{self, Blf};
use super::candump::parse_line;
use super::csv;
use super::record::{
    Interface, LineError, LogFormat, MAX_LINE, OwnedRecord, ParsedLine, Record, StampForm,
};
use super::stamps::{Stamps, judge};
use super::text::without_escapes;
use super::trc::Trc;
use arrayvec::ArrayVec;
use proprio_topics::Nanos;
use std::io::{self, BufRead, Read, Write};

/// Maximum number of bad lines in a [`LogReport`].
const NAMED: usize = 8;
/// The order of the frames in a log is that of their stamps, except within this time \[ns\]: the
/// recorder reads one interface after the other.
pub const REORDER: Nanos = Nanos::from_millis(100);

/// The counts of a [`LogReader`] so far.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LogReport {
    /// Lines (or objects of a BLF file), including bad ones.
    pub lines: u64,
    /// Frames.
    pub records: u64,
    /// Frames without a stamp.
    pub unstamped: u64,
    /// Frames with an earlier stamp than the previous frame.
    pub backwards: u64,
    /// The first of them that is earlier by more than [`REORDER`].
    pub first_step: Option<StepBack>,
    /// Frames that candump reports as lost.
    pub dropped: u64,
    /// Lines or objects that could not be read; they are skipped.
    pub bad: u64,
    /// Number and error of the first eight of them.
    pub first_bad: ArrayVec<(u64, LineError), NAMED>,
}

/// A place where the clock of a log was set back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StepBack {
    /// The number of the line or object.
    pub number: u64,
    /// The stamp of the frame before \[ns\].
    pub from: Nanos,
    /// Its own stamp \[ns\].
    pub to: Nanos,
}

/// The beginnings of files that people take for logs; what they are, and what to do.
const NO_LOGS: [(&[u8], &str); 15] = [
    (b"%PDF", "a PDF document, not a log"),
    (
        b"\x1F\x8B",
        "compressed with gzip: unpack it first (zcat FILE)",
    ),
    (
        b"BZh",
        "compressed with bzip2: unpack it first (bzcat FILE)",
    ),
    (
        b"\xFD7zXZ",
        "compressed with xz: unpack it first (xzcat FILE)",
    ),
    (
        b"\x28\xB5\x2F\xFD",
        "compressed with zstd: unpack it first (zstdcat FILE)",
    ),
    (
        b"PK\x03\x04",
        "a zip archive or an office document, not a log",
    ),
    (b"MDF  ", "an MDF file: convert it to BLF or ASC first"),
    (
        b"UnFinMF",
        "an unfinished MDF file: convert it to BLF or ASC first",
    ),
    (
        b"SQLite ",
        "an SQLite database: convert it first, as with python-can's can_logconvert",
    ),
    (
        b"\n\r\r\n",
        "a pcapng capture: convert it to a candump log first",
    ),
    (
        b"\xD4\xC3\xB2\xA1",
        "a pcap capture: convert it to a candump log first",
    ),
    (
        b"\xA1\xB2\xC3\xD4",
        "a pcap capture: convert it to a candump log first",
    ),
    (b"\xFF\xFE", UTF_16),
    (b"\xFE\xFF", UTF_16),
    (b"\x7FELF", "a program, not a log"),
];
const UTF_16: &str = "text in UTF-16: save it as UTF-8 first (iconv -f UTF-16 -t UTF-8)";
/// The mark that Windows programs put before UTF-8 text.
const UTF_8_MARK: &[u8] = b"\xEF\xBB\xBF";
/// Bytes that are read first: the longest of these beginnings.
const HEAD: usize = 8;
/// The most bytes that are read ahead to look for an interface, and how many at first.
const LOOK_FOR_INTERFACE: (usize, usize) = (16 << 20, 64 << 10);
/// Bytes that are read ahead to tell relative stamps apart: a million lines.
const LOOK_AHEAD: usize = 64 << 20;

/// A log, of which some bytes were read ahead.
#[derive(Debug)]
struct Ahead<R> {
    held: Vec<u8>,
    /// So many of them are used.
    used: usize,
    rest: R,
}

impl<R: BufRead> Ahead<R> {
    /// Reads until `count` bytes are held or the log ends; returns what is held.
    fn hold(&mut self, count: usize) -> io::Result<&[u8]> {
        self.held.drain(..self.used);
        self.used = 0;
        let more = count.saturating_sub(self.held.len()) as u64;
        self.rest.by_ref().take(more).read_to_end(&mut self.held)?;
        Ok(&self.held)
    }
}

impl<R: BufRead> Read for Ahead<R> {
    fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
        let count = self.fill_buf()?.read(to)?;
        self.consume(count);
        Ok(count)
    }
}

impl<R: BufRead> BufRead for Ahead<R> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        match self.held.get(self.used..) {
            Some(held) if !held.is_empty() => Ok(held),
            _ => self.rest.fill_buf(),
        }
    }

    fn consume(&mut self, count: usize) {
        match self.used < self.held.len() {
            true => self.used += count,
            false => self.rest.consume(count),
        }
    }
}

/// The source of lines or objects.
#[derive(Debug)]
enum Syntax {
    /// Nothing is read yet.
    Unopened,
    /// Text, of which no line told the format yet.
    Unknown,
    Candump,
    Asc(Asc),
    Blf(Box<Blf>),
    Trc(Trc),
    Csv,
    /// Nothing more can be read.
    Ended,
}

impl LogReport {
    fn reject(&mut self, line: u64, error: LineError) {
        self.bad += 1;
        // The ninth and later ones are only counted.
        let _ = self.first_bad.try_push((line, error));
    }
}

/// Reads the records of a log one after the other; allocates nothing after the first.
///
/// The format is that of the first line that only one format has. A candump line is one that holds
/// a frame; for the others a line of their header will do.
///
/// A line that cannot be read is skipped and reported. A last line without a line end, as a stopped
/// recorder leaves it, counts only if no continuation could make it another frame: half a payload
/// is not returned as a short one.
///
/// A stamp that is later than the next frame's by more than [`REORDER`], while the next is not
/// earlier than the one before, is wrong: its frame is skipped and reported. (Everything after it
/// would otherwise seem late.) So is one that is no instant ([`Nanos::is_instant`]).
///
/// Escape sequences of a terminal, such as the colours of `candump -c`, are ignored.
#[derive(Debug)]
pub struct LogReader<R> {
    inner: Ahead<R>,
    source: Syntax,
    format: Option<LogFormat>,
    line: Vec<u8>,
    /// The frame after the current one, if it has been read already: its text, the number of its
    /// line, and the frame.
    next_line: Vec<u8>,
    next: Option<(u64, OwnedRecord)>,
    stamps: Stamps,
    /// Whether the meaning of the stamps was guessed from too little.
    doubtful: bool,
    sum: Nanos,
    last: Option<Nanos>,
    interfaces: ArrayVec<String, NAMED>,
    report: LogReport,
}

impl<R: BufRead> LogReader<R> {
    /// Reads from `inner`. To detect the meaning of relative stamps it reads ahead: the whole log,
    /// or its first 64 MiB.
    pub fn new(inner: R) -> Self {
        Self::with_stamps(inner, Stamps::Detect)
    }

    /// Reads from `inner`; relative stamps have the meaning `stamps`.
    pub fn with_stamps(inner: R, stamps: Stamps) -> Self {
        let line = || Vec::with_capacity(MAX_LINE + 16);
        Self {
            inner: Ahead {
                held: Vec::with_capacity(HEAD),
                used: 0,
                rest: inner,
            },
            source: Syntax::Unopened,
            format: None,
            next_line: line(),
            line: line(),
            next: None,
            stamps,
            doubtful: false,
            sum: Nanos::ZERO,
            last: None,
            interfaces: ArrayVec::new(),
            report: LogReport::default(),
        }
    }

    /// The counts so far.
    pub const fn report(&self) -> &LogReport {
        &self.report
    }

    /// The format; `None` as long as nothing told it.
    pub const fn format(&self) -> Option<LogFormat> {
        self.format
    }

    /// The first lines or objects that could not be read: `line 7: why`.
    pub fn bad(&self) -> impl Iterator<Item = String> {
        let part = self.part();
        let text = move |(number, error): &(u64, LineError)| match error {
            // Of the whole file.
            LineError::NoLog(_) => error.to_string(),
            _ => format!("{part} {number}: {error}"),
        };
        self.report.first_bad.iter().map(text)
    }

    /// What a person should be told if parts of the log were skipped.
    pub(crate) fn skipped(&self) -> Option<String> {
        let first = self.bad().next()?;
        let parts = self.format.map_or("lines", LogFormat::parts);
        let bad = self.report.bad;
        Some(format!(
            "{bad} {parts} of the log were skipped; the first is {first}"
        ))
    }

    /// Why a log without a frame has none.
    pub fn why_empty(&self) -> String {
        match (self.bad().next(), self.report.first_bad.first()) {
            (Some(bad), Some((_, LineError::NoLog(_) | LineError::Table))) => bad,
            (Some(bad), _) if self.format.is_none() => format!(
                "it is in none of the formats that can be read ({}); as a candump log, {bad}",
                LogFormat::ALL
            ),
            (Some(bad), _) => format!("the first that cannot be read is {bad}"),
            (None, _) if self.report.lines == 0 => "it is empty".to_owned(),
            (None, _) => format!("none of its {} {}s is one", self.report.lines, self.part()),
        }
    }

    fn part(&self) -> &'static str {
        match self.format {
            Some(LogFormat::Blf) => "object",
            _ => "line",
        }
    }

    /// The meaning of relative stamps; [`Stamps::Detect`] until the first one was read.
    pub const fn stamps(&self) -> Stamps {
        self.stamps
    }

    /// What a person should be told if the meaning of relative stamps is a guess; `key` is how it
    /// can be stated.
    pub fn doubt(&self, key: &str) -> Option<String> {
        self.doubtful.then(|| {
            format!(
                "the time stamps may count from the start of the log or each from the line before; \
                 they are taken as {}. State it with {key}",
                match self.stamps {
                    Stamps::SincePrevious => "the latter",
                    Stamps::Detect | Stamps::SinceStart => "the former",
                }
            )
        })
    }

    /// The interfaces of the frames so far, at most eight.
    pub fn interfaces(&self) -> &[String] {
        &self.interfaces
    }

    /// What a person should be told if the clock of the log was set back.
    pub fn step_back(&self) -> Option<String> {
        let StepBack { number, from, to } = self.report.first_step?;
        Some(format!(
            "at {} {number} the time steps back by {} s, from {from} s to {to} s: what has an \
             earlier stamp than its last one is dropped. Cut the log there, and read the parts one \
             by one",
            self.part(),
            from.saturating_sub(to)
        ))
    }

    /// Whether a frame of an interface that is `wanted` is in the log's first 16 MiB. To be called
    /// before the first record is read; takes none.
    ///
    /// # Errors
    /// A read error of `inner`.
    pub(crate) fn has_interface(&mut self, wanted: impl Fn(&str) -> bool) -> io::Result<bool> {
        let (most, mut size) = LOOK_FOR_INTERFACE;
        loop {
            let held = self.inner.hold(size)?;
            let mut ahead = LogReader::with_stamps(held, Stamps::SinceStart);
            while let Some(record) = ahead.next_record()? {
                if wanted(record.interface) {
                    return Ok(true);
                }
            }
            if held.len() < size || size >= most {
                return Ok(false);
            }
            size *= 16;
        }
    }

    /// The next record; `None` at the end of the log.
    ///
    /// # Errors
    /// A read error of `inner`. A bad line is not an error: see [`LogReader::report`].
    pub fn next_record(&mut self) -> io::Result<Option<Record<'_>>> {
        let (parsed, stamp) = loop {
            let Some((number, parsed)) = self.next_frame()? else {
                return Ok(None);
            };
            let Some((t, form)) = parsed.stamp else {
                self.report.unstamped += 1;
                break (parsed, None);
            };
            if form == StampForm::Relative && self.stamps == Stamps::Detect {
                let verdict = judge(t, self.inner.hold(LOOK_AHEAD)?);
                (self.stamps, self.doubtful) = (verdict.stamps, verdict.doubtful);
            }
            let adds_up = self.adds_up(form);
            let t = if adds_up { self.sum + t } else { t };
            if !t.is_instant() {
                self.report.reject(number, LineError::Range);
            } else if let Some(ahead) = self.ahead(t, adds_up)? {
                self.report.reject(number, LineError::Ahead { ahead });
            } else {
                if adds_up {
                    self.sum = t;
                }
                if let Some(from) = self.last.replace(t)
                    && t < from
                {
                    self.report.backwards += 1;
                    let step = StepBack {
                        number,
                        from,
                        to: t,
                    };
                    if from.saturating_sub(t) > REORDER {
                        self.report.first_step.get_or_insert(step);
                    }
                }
                break (parsed, Some(t));
            }
        };
        self.report.records += 1;
        let record = parsed.record(&self.line, stamp);
        if let Some(record) = &record
            && !self.interfaces.is_full()
            && self.interfaces.iter().all(|i| i != record.interface)
        {
            self.interfaces.push(record.interface.to_owned());
        }
        Ok(record)
    }

    /// The next frame and the number of its line; its text is in `line`. Lines without a frame are
    /// skipped.
    fn next_frame(&mut self) -> io::Result<Option<(u64, OwnedRecord)>> {
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

    /// Whether a stamp of this form counts from the one before.
    fn adds_up(&self, form: StampForm) -> bool {
        let may = match form {
            StampForm::Absolute => false,
            StampForm::Origin => self.format == Some(LogFormat::Candump),
            StampForm::Relative => true,
        };
        may && self.stamps == Stamps::SincePrevious
    }

    /// By how much the stamp `t` of the current frame is too late to be right \[ns\], if it is.
    /// Only a stamp that jumps is compared with the next one, which is then read.
    fn ahead(&mut self, t: Nanos, adds_up: bool) -> io::Result<Option<Nanos>> {
        let last = self.last.unwrap_or(Nanos::MIN);
        if adds_up || t.saturating_sub(last) <= REORDER {
            return Ok(None);
        }
        std::mem::swap(&mut self.line, &mut self.next_line);
        self.next = self.next_frame()?;
        std::mem::swap(&mut self.line, &mut self.next_line);
        let next = self.next.as_ref().and_then(|(_, next)| next.stamp);
        let Some((next, _)) = next.filter(|(next, _)| next.is_instant()) else {
            return Ok(None);
        };
        let ahead = t.saturating_sub(next);
        Ok((ahead > REORDER && next >= last.saturating_sub(REORDER)).then_some(ahead))
    }

    /// Reads and parses the next line or object; `None` at the end.
    fn next_parsed(&mut self) -> io::Result<Option<Result<ParsedLine, LineError>>> {
        if matches!(self.source, Syntax::Unopened)
            && let Err(error) = self.open()?
        {
            self.report.lines = 1;
            return Ok(Some(Err(error)));
        }
        let next = match &mut self.source {
            Syntax::Ended => return Ok(None),
            Syntax::Blf(blf) => {
                self.line.clear();
                let next = blf.next(&mut self.inner)?;
                self.report.lines += u64::from(next.is_some());
                next
            }
            _ => self.next_line()?,
        };
        Ok(match next {
            Some(Err(error)) if error.is_final() => {
                self.source = Syntax::Ended;
                Some(Err(error))
            }
            Some(Ok(ParsedLine::Record(mut parsed))) => {
                if let Interface::Channel(channel) = parsed.interface {
                    // The line ends with the name, as if it had been written there.
                    let start = self.line.len();
                    write!(self.line, "can{channel}")?;
                    parsed.interface = Interface::Text(start..self.line.len());
                }
                Some(Ok(ParsedLine::Record(parsed)))
            }
            next => next,
        })
    }

    /// Reads the first bytes; the error is that they are no log's.
    fn open(&mut self) -> io::Result<Result<(), LineError>> {
        let head = self.inner.hold(HEAD)?;
        let is_utf_16 = matches!(head, [_, 0, _, 0, _, 0, ..] | [0, _, 0, _, 0, _, ..])
            && head.iter().any(|c| *c != 0);
        let what = NO_LOGS
            .iter()
            .find(|(beginning, _)| head.starts_with(beginning));
        if let Some((_, what)) = what {
            self.source = Syntax::Ended;
            return Ok(Err(LineError::NoLog(what)));
        }
        if is_utf_16 {
            self.source = Syntax::Ended;
            return Ok(Err(LineError::NoLog(UTF_16)));
        }
        self.source = if head.starts_with(blf::SIGNATURE) {
            self.format = Some(LogFormat::Blf);
            Syntax::Blf(Box::new(Blf::new()))
        } else {
            if head.starts_with(UTF_8_MARK) {
                self.inner.consume(UTF_8_MARK.len());
            }
            Syntax::Unknown
        };
        Ok(Ok(()))
    }

    /// Reads and parses the next line; `None` at the end.
    fn next_line(&mut self) -> io::Result<Option<Result<ParsedLine, LineError>>> {
        if self.read_part()? == 0 {
            return Ok(None);
        }
        self.report.lines += 1;
        let ended = self.line.last() == Some(&b'\n');
        if !ended && self.line.len() > MAX_LINE {
            // The rest of the line, in parts.
            while self.read_part()? > 0 && self.line.last() != Some(&b'\n') {}
            return Ok(Some(Err(LineError::LineTooLong)));
        }
        without_escapes(&mut self.line);
        let parsed = match &mut self.source {
            Syntax::Candump => parse_line(&self.line),
            Syntax::Asc(asc) => asc.parse(&self.line),
            Syntax::Trc(trc) => trc.parse(&self.line),
            Syntax::Csv => csv::parse(&self.line),
            _ => self.first_line(),
        };
        Ok(Some(match parsed {
            Ok(ParsedLine::Record(ref record)) if !ended && !record.whole => {
                Err(LineError::Unfinished)
            }
            Err(error) if !ended && !error.is_final() => Err(LineError::Unfinished),
            parsed => parsed,
        }))
    }

    /// Reads a line, or a part of one that is too long; returns its length.
    fn read_part(&mut self) -> io::Result<usize> {
        self.line.clear();
        let mut part = self.inner.by_ref().take(MAX_LINE as u64 + 1);
        part.read_until(b'\n', &mut self.line)
    }

    /// Parses a line of text whose format is not known, and learns the format if it tells.
    fn first_line(&mut self) -> Result<ParsedLine, LineError> {
        let line = &self.line;
        let parsed = parse_line(line);
        let is_candump = matches!(parsed, Ok(ParsedLine::Record(_) | ParsedLine::Dropped(_)));
        let (format, source, parsed) = if is_candump {
            (LogFormat::Candump, Syntax::Candump, parsed)
        } else if Asc::has(line) {
            let mut asc = Asc::new();
            let parsed = asc.parse(line);
            (LogFormat::Asc, Syntax::Asc(asc), parsed)
        } else if Trc::has(line) {
            let mut trc = Trc::new();
            let parsed = trc.parse(line);
            (LogFormat::Trc, Syntax::Trc(trc), parsed)
        } else if csv::has(line) {
            (LogFormat::Csv, Syntax::Csv, csv::parse(line))
        } else if self.report.lines == 1 && parsed.is_err() && csv::is_other_table(line) {
            return Err(LineError::Table);
        } else {
            return parsed;
        };
        (self.format, self.source) = (Some(format), source);
        parsed
    }
}
