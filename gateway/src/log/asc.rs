//! Vector ASC: the text format of CANoe and CANalyzer.
//!
//! ```text
//! date Sat Sep 30 15:06:13.191 2017                 or 03:06:13.191 pm; see below
//! base hex  timestamps absolute                     or dec; or relative
//! // version 9.0.0
//! Begin Triggerblock Sat Sep 30 15:06:13.191 2017
//!    0.000000 Start of measurement
//!    1.015991 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%
//!    3.098426 1  18EBFF00x       Rx   d 8 01 A0 0F A6 60 3B D1 40  Length = 273910 BitCount = 141
//!    2.584921 2  300             Tx   r 8              r alone in old files: length unknown
//!    2.501000 1  ErrorFrame      ECC: 10100010
//!   31.506898 CANFD   4 Rx   1C4D80A7x  Name  1 0 9 12 B1 02 ... 104812 132 303000 a800f6c9 ...
//!              channel          id      |  BRS ESI | length |    time, bits, flags
//!                                  if it has one   length code, hexadecimal
//! End TriggerBlock
//! ```
//!
//! - CANoe may be set to write the name of the message in the identifier's column. A name begins
//!   with a letter, as a number may: then `ID = 1638` (decimal; `x` marks an extended one) at the
//!   end of the line counts, if it is there.
//! - The number after `d` is a length code: 9 to F stand for 8 bytes.
//! - Lines with `CANFD` are hexadecimal even in `base dec`, but for the length. Their flags tell
//!   whether the frame was CAN FD (0x1000) at all, and whether a classic one was a remote request
//!   (0x10).
//! - `timestamps relative`: each line counts from the one before, whatever it is.
//! - The recording began at the date of the trigger block in which `Start of measurement` stands,
//!   else at that of the header. python-can's header has the time at which the file was opened.
//! - The words of a date come in any order. Months have English, German, French, Italian, Spanish
//!   or Portuguese names, or are numbers in a date such as 2017-09-30 or 30.09.2017.
//! - Up to three digits after the seconds of a date are a number of milliseconds: python-can writes
//!   `13.5` for 13.005 s. More are a fraction: asammdf writes microseconds.
//! - `TxRq` asks for a frame, which has a line of its own once it is sent.
//!
//! Sources: can-utils `asc2log.c`, `log2asc.c`; python-can `io/asc.py` and the files of its tests.

use super::record::{
    FrameDirection, Interface, LineError, LogFormat, OwnedRecord, ParsedLine, bus_error,
    identifier, stamp_since,
};
use super::text::{SECOND, civil, decimal, number, words};
use arrayvec::ArrayVec;
use proprio_drivers::{Format, Frame, Id};
use proprio_topics::Nanos;

/// The flag of a line with `CANFD`: the frame is a remote request.
const REMOTE: u32 = 0x10;
/// The flag of a line with `CANFD`: the frame is CAN FD.
const FD: u32 = 0x1000;

/// What the lines read so far say about the others.
#[derive(Debug)]
pub(super) struct Asc {
    decimal: bool,
    relative: bool,
    /// When the recording began \[ns since 1970\].
    start: Option<Nanos>,
    /// The date of the trigger block.
    block: Option<Nanos>,
    /// The time of the line before.
    last: Nanos,
}

impl Asc {
    pub(super) const fn new() -> Self {
        Self {
            decimal: false,
            relative: false,
            start: None,
            block: None,
            last: Nanos::ZERO,
        }
    }

    /// Whether only this format has such a line.
    pub(super) fn has(line: &[u8]) -> bool {
        let mut words = words(line);
        let mut next = || words.next().unwrap_or_default();
        let (first, second) = (next(), next());
        if is(first, "date") {
            // Words of a date in whatever language and order, and a time.
            return words.any(|word| word.contains(&b':'));
        }
        if is(first, "base") {
            return is(second, "hex") || is(second, "dec");
        }
        if is(first, "begin") {
            return is(second, "triggerblock");
        }
        // A part of a log without its header: a time, a channel, and what only a frame has.
        if !first.contains(&b'.') || decimal(first, SECOND).is_none() {
            return false;
        }
        is(second, "CANFD")
            || number(second, 10).is_some() && (is(next(), "ErrorFrame") || way(next()).is_some())
    }

    /// Parses a line.
    pub(super) fn parse(&mut self, line: &[u8]) -> Result<ParsedLine, LineError> {
        let mut words = words(line);
        let Some(first) = words.next() else {
            return Ok(ParsedLine::Note);
        };
        if let [b'0'..=b'9' | b'-' | b'.', ..] = first {
            let t = decimal(first, SECOND).ok_or(LineError::Time)?;
            let t = if self.relative { self.last + t } else { t };
            if !t.is_instant() {
                return Err(LineError::Range);
            }
            self.last = t;
            return self.event(words);
        }
        if is(first, "date") {
            (self.start, self.last) = (parse_date(words), Nanos::ZERO);
            return self.start.map(|_| ParsedLine::Note).ok_or(LineError::Date);
        }
        if is(first, "base") {
            let has = |text| words.clone().any(|word| is(word, text));
            (self.decimal, self.relative) = (has("dec"), has("relative"));
        } else if is(first, "begin") {
            words.next();
            self.block = parse_date(words);
            self.start = self.start.or(self.block);
        } else if !["internal", "no", "end"].iter().any(|w| is(first, w))
            && !first.starts_with(b"//")
        {
            return Err(LineError::Foreign {
                format: LogFormat::Asc,
            });
        }
        Ok(ParsedLine::Note)
    }

    /// Parses what follows the time of a line.
    fn event<'a>(
        &mut self,
        mut words: impl Iterator<Item = &'a [u8]> + Clone,
    ) -> Result<ParsedLine, LineError> {
        let second = words.next().ok_or(LineError::NoFrame)?;
        let (channel, (frame, direction, whole)) = if is(second, "CANFD") {
            let channel = words.next().and_then(channel).ok_or(LineError::Interface)?;
            match fd_frame(words)? {
                Some(frame) => (channel, frame),
                None => return Ok(ParsedLine::Note),
            }
        } else if is(second, "CANXL") {
            return Err(LineError::Xl);
        } else if let Some(channel) = channel(second) {
            match classic_frame(words, if self.decimal { 10 } else { 16 })? {
                Some(frame) => (channel, frame),
                None => return Ok(ParsedLine::Note),
            }
        } else {
            // Of the recording itself, of another bus, or of a variable.
            if is(second, "Start") && words.next().is_some_and(|word| is(word, "of")) {
                self.start = self.block.or(self.start);
            }
            return Ok(ParsedLine::Note);
        };
        Ok(ParsedLine::Record(OwnedRecord {
            stamp: Some(stamp_since(self.start, self.last)),
            interface: Interface::channel(channel),
            direction,
            frame,
            whole,
        }))
    }
}

/// A frame, its direction, and whether no continuation of the line could make it another one.
type Found = (Frame, Option<FrameDirection>, bool);

fn is(word: &[u8], text: &str) -> bool {
    word.eq_ignore_ascii_case(text.as_bytes())
}

fn channel(word: &[u8]) -> Option<u16> {
    number(word, 10).and_then(|number| u16::try_from(number).ok())
}

/// What `Rx`, `Tx` or `TxRq` says: the direction, unless the frame is only asked for.
fn way(word: &[u8]) -> Option<Option<FrameDirection>> {
    match word {
        b"Rx" | b"rx" | b"RX" => Some(Some(FrameDirection::Received)),
        b"Tx" | b"tx" | b"TX" => Some(Some(FrameDirection::Sent)),
        b"TxRq" => Some(None),
        _ => None,
    }
}

/// Parses `18EBFF00x`.
fn parse_id(word: &[u8], radix: u32) -> Result<Id, LineError> {
    let (digits, extended) = match word {
        [digits @ .., b'x' | b'X'] => (digits, true),
        _ => (word, false),
    };
    identifier(number(digits, radix).ok_or(LineError::Number)?, extended)
}

/// Finds `ID = 1638` at the end of a line: its identifier, and whether it is surely complete.
fn stated_id<'a>(words: impl Iterator<Item = &'a [u8]>) -> Result<Option<(Id, bool)>, LineError> {
    let mut last: [&[u8]; 3] = [&[]; 3];
    for word in words {
        last = [last[1], last[2], word];
    }
    match last {
        [b"ID", b"=", id] => Ok(Some((parse_id(id, 10)?, id.ends_with(b"x")))),
        _ => Ok(None),
    }
}

/// Parses the `declared` bytes of a frame; also returns whether the last has all its digits.
fn parse_data<'a>(
    words: &mut impl Iterator<Item = &'a [u8]>,
    declared: usize,
    radix: u32,
) -> Result<([u8; Frame::MAX_LEN], bool), LineError> {
    let mut data = [0; Frame::MAX_LEN];
    let mut whole = false;
    for (found, byte) in data.iter_mut().take(declared).enumerate() {
        let word = words.next().ok_or(LineError::Missing { declared, found })?;
        let value = number(word, radix).and_then(|value| u8::try_from(value).ok());
        *byte = value.ok_or(LineError::Data)?;
        whole = radix == 16 && word.len() == 2;
    }
    Ok((data, whole))
}

/// Parses what follows the channel of a line of a classic frame; `None` if it is none.
fn classic_frame<'a>(
    mut words: impl Iterator<Item = &'a [u8]> + Clone,
    radix: u32,
) -> Result<Option<Found>, LineError> {
    let id = words.next().ok_or(LineError::NoFrame)?;
    if is(id, "ErrorFrame") {
        return Ok(Some((bus_error(), None, true)));
    }
    if ["Statistic:", "J1939TP", "OverloadFrame"]
        .iter()
        .any(|w| is(id, w))
    {
        return Ok(None);
    }
    // What begins with a letter may be a name, and what tells its identifier be cut off.
    let (id, id_is_whole) = match id.first().is_some_and(u8::is_ascii_digit) {
        true => (parse_id(id, radix)?, true),
        false => match (stated_id(words.clone())?, parse_id(id, radix)) {
            (Some(stated), _) => stated,
            (None, Err(LineError::Number)) => return Err(LineError::Symbolic),
            (None, number) => (number?, false),
        },
    };
    let Some(direction) = way(words.next().unwrap_or_default()).ok_or(LineError::Direction)? else {
        return Ok(None);
    };
    let kind = words.next().unwrap_or_default();
    let code = words.next().map(|word| number(word, radix));
    let length = |code: u32| usize::try_from(code).unwrap_or(8).min(8);
    let found = if is(kind, "d") {
        let code = code.flatten().filter(|code| *code < 16);
        let declared = length(code.ok_or(LineError::Length)?);
        let (data, whole) = parse_data(&mut words, declared, radix)?;
        let frame = Frame::new(id, data.get(..declared).unwrap_or(&data));
        (frame, Some(direction), whole && id_is_whole)
    } else if is(kind, "r") {
        // Old files state no length; their next word is that of a comment.
        let stated = code.flatten().filter(|code| *code < 16);
        #[allow(clippy::cast_possible_truncation)] // at most 8
        let frame = Frame::remote(id, stated.map_or(0, length) as u8);
        (frame, Some(direction), code.is_some() && id_is_whole)
    } else {
        return Err(LineError::Kind {
            format: LogFormat::Asc,
        });
    };
    Ok(Some(found))
}

/// Parses what follows the channel of a line with `CANFD`; `None` if it is no frame on the bus.
fn fd_frame<'a>(
    mut words: impl Iterator<Item = &'a [u8]> + Clone,
) -> Result<Option<Found>, LineError> {
    let direction = way(words.next().unwrap_or_default()).ok_or(LineError::Direction)?;
    let Some(direction) = direction else {
        return Ok(None);
    };
    let id = words.next().ok_or(LineError::NoFrame)?;
    if is(id, "ErrorFrame") {
        return Ok(Some((bus_error(), None, true)));
    }
    let id = parse_id(id, 16)?;
    let bit = |word: Option<&[u8]>| match word {
        Some(b"0") => Some(false),
        Some(b"1") => Some(true),
        _ => None,
    };
    let mut ahead = words.clone();
    let unnamed = bit(ahead.next()).is_some() && bit(ahead.next()).is_some();
    if !unnamed {
        words.next();
    }
    let kind = LineError::Kind {
        format: LogFormat::Asc,
    };
    let bit_rate_switch = bit(words.next()).ok_or(kind)?;
    let error_state = bit(words.next()).ok_or(kind)?;
    let mut read = |radix| number(words.next()?, radix).and_then(|n| usize::try_from(n).ok());
    let code = read(16)
        .filter(|code| *code < 16)
        .ok_or(LineError::Length)?;
    let declared = read(10)
        .filter(|length| *length <= Frame::MAX_LEN)
        .ok_or(LineError::Length)?;
    let (data, _) = parse_data(&mut words, declared, 16)?;
    let data = data.get(..declared).unwrap_or(&data);
    // The flags follow the duration and the number of bits. Something must follow them: they could
    // be cut off.
    let flags = words.nth(2).and_then(|word| number(word, 16));
    let whole = words.next().is_some();
    let classic = flags.filter(|flags| flags & FD == 0 && declared <= 8);
    let frame = match classic {
        #[allow(clippy::cast_possible_truncation)] // at most 8
        Some(flags) if flags & REMOTE != 0 => Frame::remote(id, code.min(8) as u8),
        Some(_) => Frame::new(id, data),
        None => {
            let format = Format::fd(bit_rate_switch, error_state);
            Frame::with_format(id, format, data).ok_or(LineError::TooLong { most: 64 })?
        }
    };
    Ok(Some((frame, Some(direction), whole)))
}

/// Parses the words of a date: `Sat Sep 30 03:06:13.191 pm 2017`, or the same in another order.
fn parse_date<'a>(words: impl Iterator<Item = &'a [u8]>) -> Option<Nanos> {
    let whole = |word: &[u8]| number(word, 10).map(i64::from);
    let (mut year, mut at_month, mut day) = (None, None, None);
    let (mut time, mut afternoon) = (None, None);
    for word in words {
        let word = word.strip_suffix(b",").unwrap_or(word);
        let numeric = word.first().is_some_and(u8::is_ascii_digit);
        if word.contains(&b':') {
            time = Some(parse_time(word)?);
        } else if let Some(half) = half_of_day(word) {
            afternoon = Some(half);
        } else if let Some(date) = numeric.then(|| parse_numeric_date(word)).flatten() {
            let [y, m, d] = date;
            (year, at_month, day) = (Some(y), Some(m), Some(d));
        } else if numeric {
            // A German day has a point.
            let value = whole(word.strip_suffix(b".").unwrap_or(word))?;
            let place = if word.len() == 4 { &mut year } else { &mut day };
            *place = Some(value);
        } else {
            // Else it is the day of the week.
            at_month = month(word).or(at_month);
        }
    }
    let ([hour, minute, second], ns) = time?;
    let hour = match afternoon {
        None => hour,
        Some(afternoon) => hour % 12 + if afternoon { 12 } else { 0 },
    };
    let seconds = civil([year?, at_month?, day?], [hour, minute, second])?;
    let ns = seconds.checked_mul(1_000_000_000)?.checked_add(ns)?;
    Some(Nanos(ns))
}

/// Parses `15:06:13.191`: hour, minute, second, and the rest in nanoseconds.
fn parse_time(word: &[u8]) -> Option<([i64; 3], i64)> {
    let whole = |word: &[u8]| number(word, 10).map(i64::from);
    let mut parts = word.splitn(3, |c| *c == b':');
    let (hour, minute, second) = (whole(parts.next()?)?, whole(parts.next()?)?, parts.next()?);
    let mut parts = second.splitn(2, |c| matches!(c, b'.' | b','));
    let (second, rest) = (whole(parts.next()?)?, parts.next());
    let ns = match rest {
        None => 0,
        Some(ms) if ms.len() <= 3 => whole(ms)? * 1_000_000,
        Some(fraction) => {
            let digits = u32::try_from(fraction.len()).ok().filter(|n| *n <= 9)?;
            whole(fraction)? * 10_i64.pow(9 - digits)
        }
    };
    Some(([hour, minute, second], ns))
}

/// Whether a word stands for the second half of the day (`pm`), or for the first (`am`).
fn half_of_day(word: &[u8]) -> Option<bool> {
    match word {
        [half, b'm' | b'M'] | [half, b'.', b'm' | b'M', b'.'] => match half {
            b'a' | b'A' => Some(false),
            b'p' | b'P' => Some(true),
            _ => None,
        },
        _ => None,
    }
}

/// Parses `2017-09-30` or `30.09.2017`: year, month, day.
fn parse_numeric_date(word: &[u8]) -> Option<[i64; 3]> {
    let three = |mark: u8| {
        let mut parts = word.split(|c| *c == mark).map(|part| number(part, 10));
        let three = [parts.next()??, parts.next()??, parts.next()??].map(i64::from);
        parts.next().is_none().then_some(three)
    };
    match (three(b'-'), three(b'.')) {
        (Some(date @ [1000..=9999, ..]), _) => Some(date),
        (_, Some([day, month, year @ 1000..=9999])) => Some([year, month, day]),
        _ => None,
    }
}

/// The number of a month with an English, German, French, Italian, Spanish or Portuguese name,
/// which may be cut after three letters (French `juin` and `juil` after four).
fn month(name: &[u8]) -> Option<i64> {
    // What is not ASCII, in any encoding, is a question mark here.
    const NAMES: [&[&str]; 12] = [
        &["jan", "j?n", "gen", "ene"],
        &["feb", "f?v", "fev"],
        &["mar", "m?r", "mrz"],
        &["apr", "avr", "abr"],
        &["may", "mai", "mag"],
        &["jun", "juin", "giu"],
        &["jul", "juil", "lug"],
        &["aug", "ao?", "aou", "ago"],
        &["sep", "set"],
        &["oct", "okt", "ott", "out"],
        &["nov"],
        &["dec", "dez", "d?c", "dic"],
    ];
    let mut plain = ArrayVec::<u8, 4>::new();
    for c in name {
        let c = if c.is_ascii() {
            c.to_ascii_lowercase()
        } else {
            b'?'
        };
        // One letter may have several bytes.
        if c == b'?' && plain.last() == Some(&b'?') {
            continue;
        }
        if plain.try_push(c).is_err() {
            break;
        }
    }
    let begins = |names: &&[&str]| {
        names
            .iter()
            .any(|other| plain.starts_with(other.as_bytes()))
    };
    let at = NAMES.iter().position(begins)?;
    i64::try_from(at).ok().map(|at| at + 1)
}
