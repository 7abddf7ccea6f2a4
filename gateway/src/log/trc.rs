//! PEAK TRC, versions 1.0 to 2.1: the text format of PCAN-View and PCAN-Explorer.
//!
//! ```text
//! ;$FILEVERSION=2.1                                 no such line in 1.0
//! ;$STARTTIME=41766.4648963872                      days since 1899-12-30; not in 1.0
//! ;$COLUMNS=N,O,T,B,I,d,R,L,D                       only in 2.0 and 2.1
//!       1      1059.900 DT 1      0300 Rx -  7    00 00 00 00 04 00 00     2.1
//!       5      1334.416 FD 1      0500 Tx -  9    01 02 03 04 05 06 07 08 09 0A 0B 0C
//!      13      1336.543 RR 1      0100 Rx -  3
//!      1)      1059.900 1  Rx        0300 -  7    00 00 00 00 04 00 00     1.3
//!      7)      1352.743 1  Rx        0100 -  3    RTR
//!      6)      1349.2  Error         0008  4  00 19 08 08                  1.1; also Warng
//!      2)      1842      0008  4  ERROR 00 19 08 08                        1.0
//! ```
//!
//! A line is a sequence of columns, and the older versions differ only in which: `N` number, `O`
//! time \[ms\], `T` type, `B` bus, `I` identifier (four digits make a standard one), `d` direction,
//! `R` reserved, `l` length in bytes, `L` length code, `D` data.
//!
//! Types: `DT` classic; `FD`, `FB` (with bit rate switch), `FE` (error state), `BI` (both) CAN FD;
//! `RR` remote request; `ER` error frame. `ST`, `EC` and `EV` (state of the adapter, error
//! counters, the user's notes) and, in older versions, `Warng` are no frames. (python-can takes
//! `FE` for both bits and `BI` for the error state.)
//!
//! The start is rounded to whole microseconds: as the double that the programs keep, it is no more
//! exact.
//!
//! Sources: PEAK-System, "PEAK CAN TRC File Format", 2020; python-can `io/trc.py` and the files of
//! its tests.

use super::record::{
    FrameDirection, Interface, LineError, LogFormat, OwnedRecord, ParsedLine, bus_error, fd_length,
    identifier, stamp_since,
};
use super::text::{civil, decimal, hex_byte, number, words};
use arrayvec::ArrayVec;
use proprio_drivers::{Format, Frame};
use proprio_topics::Nanos;

/// A millisecond \[ns\].
const MILLISECOND: u64 = 1_000_000;
/// A day \[ns\].
const DAY: u64 = 86_400_000_000_000;
/// The most columns of a line; the format has nine.
const COLUMNS: usize = 16;
/// The columns of version 1.0, which does not state its version.
const OLDEST: &[u8] = b"NOILD";

/// What the lines read so far say about the others.
#[derive(Debug)]
pub(super) struct Trc {
    columns: ArrayVec<u8, COLUMNS>,
    /// When the recording began \[ns since 1970\].
    start: Option<Nanos>,
}

impl Trc {
    pub(super) fn new() -> Self {
        Self {
            columns: OLDEST.iter().copied().collect(),
            start: None,
        }
    }

    /// Whether only this format has such a line.
    pub(super) fn has(line: &[u8]) -> bool {
        if line.starts_with(b";$FILEVERSION=") || line.starts_with(b";$STARTTIME=") {
            return true;
        }
        // A part of a log of version 1: `1)`, and a time.
        let mut words = words(line);
        let first = words.next().unwrap_or_default();
        first
            .strip_suffix(b")")
            .is_some_and(|n| number(n, 10).is_some())
            && words
                .next()
                .is_some_and(|t| decimal(t, MILLISECOND).is_some())
    }

    /// Parses a line.
    pub(super) fn parse(&mut self, line: &[u8]) -> Result<ParsedLine, LineError> {
        let line = line.trim_ascii();
        match line {
            [] => Ok(ParsedLine::Note),
            [b';', header @ ..] => self.header(header).map(|()| ParsedLine::Note),
            _ => self.message(line),
        }
    }

    fn header(&mut self, line: &[u8]) -> Result<(), LineError> {
        if let Some(version) = line.strip_prefix(b"$FILEVERSION=") {
            self.columns.clear();
            let columns: &[u8] = match version.trim_ascii() {
                b"1.0" => OLDEST,
                b"1.1" => b"NOTILD",
                b"1.2" => b"NOBTILD",
                b"1.3" => b"NOBTIRLD",
                // Another line names them.
                b"2.0" | b"2.1" => b"",
                _ => return Err(LineError::Columns),
            };
            self.columns.extend(columns.iter().copied());
        } else if let Some(names) = line.strip_prefix(b"$COLUMNS=") {
            self.columns.clear();
            for name in names.split(|c| *c == b',') {
                let [name] = name.trim_ascii() else {
                    return Err(LineError::Columns);
                };
                let pushed = self.columns.try_push(*name);
                pushed.map_err(|_| LineError::Columns)?;
            }
            let has = |name| self.columns.contains(name);
            if !b"OTI".iter().all(has) || !b"lL".iter().any(has) {
                return Err(LineError::Columns);
            }
        } else if let Some(days) = line.strip_prefix(b"$STARTTIME=") {
            let epoch = civil([1899, 12, 30], [0; 3]).unwrap_or_default();
            let since = |days: Nanos| {
                // To whole microseconds.
                let days = days.0.checked_add(500)? / 1_000 * 1_000;
                days.checked_add(epoch.checked_mul(1_000_000_000)?)
            };
            let start = start_day(days.trim_ascii()).and_then(since);
            self.start = Some(Nanos(start.ok_or(LineError::Date)?));
        }
        Ok(())
    }

    fn message(&self, line: &[u8]) -> Result<ParsedLine, LineError> {
        let mut words = words(line);
        let (mut t, mut bus, mut id, mut direction) = (None, 1, None, None);
        let (mut kind, mut length): (&[u8], _) = (b"DT", None);
        for column in &self.columns {
            if *column == b'D' {
                break;
            }
            // Lines without a message have no identifier, or a bar in its place.
            if *column == b'I' && !is_message(kind) {
                break;
            }
            let word = words.next().ok_or(LineError::NoFrame)?;
            match column {
                b'O' => t = Some(decimal(word, MILLISECOND).ok_or(LineError::Time)?),
                b'T' if matches!(word, b"ST" | b"EC" | b"EV" | b"Warng") => {
                    return Ok(ParsedLine::Note);
                }
                b'T' if matches!(word, b"Rx" | b"Tx") => direction = Some(word),
                b'T' => kind = word,
                b'B' => {
                    let number = number(word, 10).and_then(|bus| u16::try_from(bus).ok());
                    bus = number.ok_or(LineError::Interface)?;
                }
                // A warning, in version 1.0.
                b'I' if word == b"FFFFFFFF" => return Ok(ParsedLine::Note),
                b'I' => {
                    let number = number(word, 16).ok_or(LineError::Number)?;
                    id = Some(identifier(number, word.len() > 4)?);
                }
                b'd' => direction = Some(word),
                b'l' => {
                    let length_of = number(word, 10).and_then(|n| usize::try_from(n).ok());
                    length = length_of.filter(|length| *length <= Frame::MAX_LEN);
                }
                b'L' => {
                    let code = number(word, 10).and_then(|n| u8::try_from(n).ok());
                    length = code.filter(|code| *code < 16).map(fd_length);
                }
                _ => {}
            }
        }
        let direction = match direction {
            None => None,
            Some(b"Rx") => Some(FrameDirection::Received),
            Some(b"Tx") => Some(FrameDirection::Sent),
            Some(_) => return Err(LineError::Direction),
        };
        let (frame, whole) = if matches!(kind, b"ER" | b"Error") {
            (bus_error(), true)
        } else {
            let id = id.ok_or(LineError::Columns)?;
            let length = length.ok_or(LineError::Length)?;
            parse_frame(kind, id, length, words)?
        };
        let t = t.ok_or(LineError::Columns)?;
        Ok(ParsedLine::Record(OwnedRecord {
            stamp: Some(stamp_since(self.start, t)),
            interface: Interface::channel(bus),
            direction,
            frame,
            whole,
        }))
    }
}

/// Whether lines of this type have an identifier to read.
fn is_message(kind: &[u8]) -> bool {
    !matches!(kind, b"ER" | b"Error")
}

/// A number of days, with a point or a comma.
fn start_day(text: &[u8]) -> Option<Nanos> {
    let mut plain = ArrayVec::<u8, 40>::new();
    for c in text {
        plain.try_push(if *c == b',' { b'.' } else { *c }).ok()?;
    }
    decimal(&plain, DAY)
}

/// Parses the data of a message of `kind`; also returns whether no continuation of the line could
/// make it another frame.
fn parse_frame<'a>(
    kind: &[u8],
    id: proprio_drivers::Id,
    length: usize,
    mut words: impl Iterator<Item = &'a [u8]> + Clone,
) -> Result<(Frame, bool), LineError> {
    let short = length.min(8);
    #[allow(clippy::cast_possible_truncation)] // at most 8
    let remote = Frame::remote(id, short as u8);
    let format = match kind {
        b"DT" => match words.clone().next() {
            Some(b"RTR") => return Ok((remote, true)),
            Some(b"ERROR") => return Ok((bus_error(), true)),
            _ => Format::Classic,
        },
        // Its length ends the line, unless a blank follows.
        b"RR" => return Ok((remote, false)),
        b"FD" => Format::fd(false, false),
        b"FB" => Format::fd(true, false),
        b"FE" => Format::fd(false, true),
        b"BI" => Format::fd(true, true),
        _ => {
            return Err(LineError::Kind {
                format: LogFormat::Trc,
            });
        }
    };
    let declared = match format {
        Format::Classic => short,
        _ => length,
    };
    let mut data = [0; Frame::MAX_LEN];
    for (found, byte) in data.iter_mut().take(declared).enumerate() {
        let missing = LineError::Missing { declared, found };
        let [high, low] = words.next().ok_or(missing)? else {
            return Err(LineError::Data);
        };
        *byte = hex_byte(*high, *low).ok_or(LineError::Data)?;
    }
    let data = data.get(..declared).unwrap_or(&data);
    let frame = Frame::with_format(id, format, data).ok_or(LineError::TooLong { most: 64 })?;
    Ok((frame, declared > 0))
}
