//! The text formats of can-utils' candump: read them all, write the log format.
//!
//! The log format (`candump -l`, `-L`), which canplayer, python-can, SavvyCAN and others read too:
//!
//! ```text
//! (1436509052.249713) vcan0 123#DEADBEEF            classic, standard identifier: three digits
//! (1436509052.249713) vcan0 1F334455#1122 T         extended identifier: eight digits; -x adds R (received) or T (sent)
//! (1436509052.249713) vcan0 123#R4                  remote request for 4 bytes
//! (1436509052.249713) vcan0 123##3112233            CAN FD: one digit of flags (1 bit rate switch, 2 error state)
//! (1436509052.249713) vcan0 20000004#0008000000006000     error frame: 20000000 + error classes
//! (1436509052.249713) vcan0 123#1122334455667788_E  classic with a raw length code above 8 (which is not kept)
//! (1436509052.249713001) vcan0 123#                 candump -N: nanoseconds
//! ```
//!
//! The screen format, and what its options add:
//!
//! ```text
//!   vcan0  123   [4]  DE AD BE EF                                   without stamps
//!  (1795225394.431732)  vcan0  123   [4]  DE AD BE EF               -t a
//!  (2026-11-21 01:43:14.431732)  vcan0  123   [4]  DE AD BE EF      -t A, in local time: taken as UTC
//!  (000.244690)  vcan0  1F334455   [2]  11 22                       -t d (since the line before) or -t z (since the first)
//!   vcan0  TX B -  12345678  [02]  AA BB                            -x; two digits of length: CAN FD
//!   vcan0       020   [5]  48 65 6C 6C 6F            'Hello'        -a
//!   vcan0  123   [4]  EF`BE`AD`DE                                   -S
//!   vcan0       123   [8]  remote request
//!   vcan0  20000040   [1]  00                        ERRORFRAME     -e adds lines that begin with a tab
//! ```
//!
//! An absolute stamp has ten digits of seconds or a date. A shorter one is relative: in the log format always to the
//! origin of the log (other programs write such), on screen it may be `-t z` or `-t d`, which one line can not tell.
//! [`Reader`] looks ahead in its buffer: stamps since the first line never decrease, and stamps since the line before, which
//! the jitter of a bus makes go up and down, soon do; those it adds up. [`Reader::with_stamps`] says it outright.
//!
//! Sources: can-utils `candump.c`, `lib.c` (`parse_canframe`, `sprint_canframe`, `sprint_long_canframe`) and `lib.h`; the
//! golden lines of tests/candump.rs were printed by candump 2020.11.

use arrayvec::ArrayVec;
use proprio_drivers::{Format, Frame, Id};
use proprio_topics::{Nanos, StampKind};
use std::io::{self, BufRead, Read, Write};
use std::ops::Range;

/// The error flag of a SocketCAN identifier, which the text formats show.
const ERROR_FLAG: u32 = 0x2000_0000;
/// The longest line that is read; candump's longest (64 bytes in binary) has some 650.
const MAX_LINE: usize = 4096;
/// How many bad lines a [`Report`] names.
const NAMED: usize = 8;

/// Whether a frame was received or sent by the host that recorded it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// `R`, `RX`: it came from the bus.
    Received,
    /// `T`, `TX`: that host sent it.
    Sent,
}

/// One frame of a log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Record<'a> {
    /// When it was recorded, as the line says it; `None` if the line has no stamp. From a [`Reader`]: relative to the log's
    /// origin, the stamps since the line before added up.
    pub stamp: Option<Nanos>,
    /// The interface it was seen on.
    pub interface: &'a str,
    /// Whether it was received or sent, where the line says so.
    pub direction: Option<Direction>,
    /// The frame, with `t` the stamp and [`StampKind::Log`], or zero and [`StampKind::None`].
    pub frame: Frame,
}

/// One line of a log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Line<'a> {
    /// A frame.
    Record(Record<'a>),
    /// candump tells that it lost so many frames (`candump -d`).
    Dropped(u64),
    /// Blank, a comment (`#`, `;`, `//`), or candump's explanation of an error frame.
    Note,
}

/// What is wrong with a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum LineError {
    /// The stamp can not be read.
    #[error("the time stamp is not (SECONDS.FRACTION) with at most nine decimals, nor (YYYY-MM-DD HH:MM:SS.FRACTION)")]
    Stamp,
    /// There is no interface, or it is not text.
    #[error("there is no interface name")]
    Interface,
    /// The line has no frame.
    #[error("there is no frame after the interface name")]
    NoFrame,
    /// The identifier has neither three nor eight hexadecimal digits.
    #[error("the identifier has {digits} hexadecimal digits; 3 make a standard one, 8 an extended one")]
    Identifier {
        /// How many it has.
        digits: usize,
    },
    /// The identifier is larger than 11 or 29 bits.
    #[error("the identifier {id:X} is larger than its {bits} bits")]
    IdentifierRange {
        /// What was read.
        id: u32,
        /// How many bits there are.
        bits: u8,
    },
    /// Neither `#` nor `[` follows the identifier.
    #[error("after the identifier there is neither #DATA nor [LENGTH]")]
    Separator,
    /// The digit of CAN FD flags is missing.
    #[error("after ## there is no hexadecimal digit of CAN FD flags")]
    Flags,
    /// A CAN XL frame.
    #[error("CAN XL frames are not supported")]
    Xl,
    /// The data are not pairs of hexadecimal digits.
    #[error("the data are not whole bytes in hexadecimal digits")]
    Data,
    /// More data than such a frame can have.
    #[error("the frame has more than {most} bytes")]
    TooLong {
        /// How many it may have.
        most: usize,
    },
    /// The length in brackets can not be read.
    #[error("the length in brackets is not a number up to 8, or with two digits up to 64")]
    Length,
    /// Fewer bytes follow than the brackets say.
    #[error("{declared} bytes are announced and {found} are there")]
    Missing {
        /// What the brackets say.
        declared: usize,
        /// How many were read.
        found: usize,
    },
    /// A remote request or an error frame that is CAN FD too.
    #[error("a remote request or an error frame can not be CAN FD")]
    Contradiction,
    /// Something follows the frame.
    #[error("something follows the frame")]
    Trailing,
    /// The line is longer than any that candump writes.
    #[error("the line is longer than {MAX_LINE} bytes")]
    LineTooLong,
    /// The last line has no end and could be the beginning of a longer one.
    #[error("the last line is not finished")]
    Unfinished,
}

/// The value of each hexadecimal digit; 0xFF for what is none.
const HEX: [u8; 256] = {
    let mut table = [0xFF; 256];
    let mut i = 0;
    while i < 10 {
        table[b'0' as usize + i] = i as u8;
        i += 1;
    }
    let mut i = 0;
    while i < 6 {
        table[b'A' as usize + i] = 10 + i as u8;
        table[b'a' as usize + i] = 10 + i as u8;
        i += 1;
    }
    table
};

/// The two digits of each byte.
const DIGITS: [[u8; 2]; 256] = {
    let digit = b"0123456789ABCDEF";
    let mut table = [[0; 2]; 256];
    let mut i = 0;
    while i < 256 {
        table[i] = [digit[i >> 4], digit[i & 15]];
        i += 1;
    }
    table
};

fn hex(digit: u8) -> Option<u8> {
    HEX.get(digit as usize).copied().filter(|v| *v < 16)
}

fn hex_byte(high: u8, low: u8) -> Option<u8> {
    let (high, low) = (*HEX.get(high as usize)?, *HEX.get(low as usize)?);
    // 0xFF of a wrong digit has high bits that no right one has.
    if (high | low) & 0xF0 == 0 {
        Some(high << 4 | low)
    } else {
        None
    }
}

/// What relates a stamp to others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum StampForm {
    /// Ten digits of seconds, or a date.
    Absolute,
    /// Fewer digits, in the log format: since the log's origin.
    Origin,
    /// Fewer digits, in the screen format: since the first line or since the line before.
    Relative,
}

/// A record with its interface as a place in the line, which no borrow has to outlive.
struct Parsed {
    stamp: Option<(Nanos, StampForm)>,
    interface: Range<usize>,
    direction: Option<Direction>,
    frame: Frame,
    /// No continuation of this line could make it another frame.
    whole: bool,
}

enum ParsedLine {
    Record(Parsed),
    Dropped(u64),
    Note,
}

impl<'a> Line<'a> {
    /// Reads one line, with or without its end. A relative stamp stands as it is written; see [`Reader`].
    ///
    /// # Errors
    /// [`LineError`] says what can not be read.
    pub fn parse(line: &'a [u8]) -> Result<Self, LineError> {
        Ok(match parse_line(line)? {
            ParsedLine::Dropped(count) => Self::Dropped(count),
            ParsedLine::Note => Self::Note,
            ParsedLine::Record(parsed) => {
                let stamp = parsed.stamp.map(|(t, _)| t);
                Self::Record(parsed.record(line, stamp).ok_or(LineError::Interface)?)
            }
        })
    }
}

impl Parsed {
    fn record(self, line: &[u8], stamp: Option<Nanos>) -> Option<Record<'_>> {
        let interface = std::str::from_utf8(line.get(self.interface)?).ok()?;
        let frame = match stamp {
            Some(t) => self.frame.at(t, StampKind::Log),
            None => self.frame,
        };
        Some(Record {
            stamp,
            interface,
            direction: self.direction,
            frame,
        })
    }
}

fn parse_line(line: &[u8]) -> Result<ParsedLine, LineError> {
    // candump -e explains an error frame in lines that begin with a tab.
    if line.first() == Some(&b'\t') {
        return Ok(ParsedLine::Note);
    }
    let line = line.trim_ascii_end();
    let mut rest = line.trim_ascii_start();
    if let Some(count) = rest.strip_prefix(b"DROPCOUNT: dropped ") {
        let count = count
            .iter()
            .map_while(|c| c.is_ascii_digit().then(|| u64::from(c - b'0')));
        return Ok(ParsedLine::Dropped(
            count.fold(0_u64, |n, d| n.saturating_mul(10).saturating_add(d)),
        ));
    }
    let stamp = match rest {
        [] | [b'#' | b';', ..] | [b'/', b'/', ..] => return Ok(ParsedLine::Note),
        [b'(', inner @ ..] => {
            let (stamp, after) = parse_stamp(inner).ok_or(LineError::Stamp)?;
            rest = after.trim_ascii_start();
            Some(stamp)
        }
        _ => None,
    };

    // The line's slices all end where it ends, so lengths tell places.
    let start = line.len() - rest.len();
    let length = rest
        .iter()
        .position(|c| *c == b' ' || *c == b'\t')
        .unwrap_or(rest.len());
    let interface = start..start + length;
    if length == 0 || rest.first() == Some(&b'(') || std::str::from_utf8(rest.get(..length).unwrap_or(&[])).is_err() {
        return Err(LineError::Interface);
    }
    rest = rest.get(length..).unwrap_or(&[]).trim_ascii_start();

    let (columns, after) = parse_columns(rest);
    rest = after;
    let digits = rest.iter().take_while(|c| hex(**c).is_some()).count();
    let (id, after) = rest.split_at_checked(digits).unwrap_or((rest, &[]));
    let identifier = || match digits {
        0 => Err(LineError::NoFrame),
        3 | 8 => parse_id(id),
        _ => Err(LineError::Identifier { digits }),
    };
    match after {
        [b'#', data @ ..] if columns.is_none() => {
            let (mut frame, used) = parse_log_frame(identifier()?, data)?;
            let direction = match data.get(used..).unwrap_or(&[]).trim_ascii_start() {
                [] => None,
                b"R" => Some(Direction::Received),
                b"T" => Some(Direction::Sent),
                _ => return Err(LineError::Trailing),
            };
            frame.whole |= direction.is_some();
            let stamp = stamp.map(|s| {
                (
                    s.t,
                    if s.absolute {
                        StampForm::Absolute
                    } else {
                        StampForm::Origin
                    },
                )
            });
            Ok(ParsedLine::Record(Parsed {
                stamp,
                interface,
                direction,
                frame: frame.frame,
                whole: frame.whole,
            }))
        }
        [b' ', ..] | [b'[', ..] => {
            let (direction, flags) = columns.map_or((None, (false, false)), |(d, f)| (Some(d), f));
            let frame = parse_screen_frame(identifier()?, after.trim_ascii_start(), flags)?;
            let stamp = stamp.map(|s| {
                (
                    s.t,
                    if s.absolute {
                        StampForm::Absolute
                    } else {
                        StampForm::Relative
                    },
                )
            });
            Ok(ParsedLine::Record(Parsed {
                stamp,
                interface,
                direction,
                frame: frame.frame,
                whole: frame.whole,
            }))
        }
        _ if digits == 0 && rest.is_empty() => Err(LineError::NoFrame),
        _ if digits != 3 && digits != 8 => Err(LineError::Identifier { digits }),
        _ => Err(LineError::Separator),
    }
}

/// What `candump -x` tells: the direction, and whether bit rate switch and error state are set.
type Columns = (Direction, (bool, bool));

/// The columns of `candump -x`: `TX B E  ` and so on.
fn parse_columns(rest: &[u8]) -> (Option<Columns>, &[u8]) {
    match rest {
        [
            d @ (b'T' | b'R'),
            b'X',
            b' ',
            brs @ (b'B' | b'-'),
            b' ',
            esi @ (b'E' | b'-'),
            b' ',
            after @ ..,
        ] => {
            let direction = if *d == b'T' {
                Direction::Sent
            } else {
                Direction::Received
            };
            (
                Some((direction, (*brs == b'B', *esi == b'E'))),
                after.trim_ascii_start(),
            )
        }
        _ => (None, rest),
    }
}

struct Stamp {
    t: Nanos,
    absolute: bool,
}

/// Reads a stamp after its opening bracket; also gives what follows the closing one.
fn parse_stamp(text: &[u8]) -> Option<(Stamp, &[u8])> {
    let (negative, digits) = match text {
        [b'-', rest @ ..] => (true, rest),
        _ => (false, text),
    };
    let (mut seconds, mut count) = (0_u64, 0_usize);
    let mut rest = digits;
    while let [c @ b'0'..=b'9', after @ ..] = rest {
        seconds = seconds.checked_mul(10)?.checked_add(u64::from(c - b'0'))?;
        count += 1;
        rest = after;
    }
    if count == 0 {
        return None;
    }
    let absolute = match rest {
        [b'-', ..] if !negative && count == 4 => {
            let (date, after) = parse_date(digits)?;
            seconds = u64::try_from(date).ok()?;
            rest = after;
            true
        }
        _ => count >= 10,
    };
    let mut fraction = 0_u64;
    if let [b'.', after @ ..] = rest {
        rest = after;
        let mut unit = 100_000_000_u64;
        let mut any = false;
        while let [c @ b'0'..=b'9', after @ ..] = rest {
            if unit == 0 {
                return None;
            }
            fraction += u64::from(c - b'0') * unit;
            unit /= 10;
            any = true;
            rest = after;
        }
        if !any {
            return None;
        }
    }
    let [b')', rest @ ..] = rest else { return None };
    let magnitude = seconds.checked_mul(1_000_000_000)?.checked_add(fraction)?;
    let t = if negative {
        0_i64.checked_sub_unsigned(magnitude)?
    } else {
        i64::try_from(magnitude).ok()?
    };
    Some((Stamp { t: Nanos(t), absolute }, rest))
}

/// Reads `YYYY-MM-DD HH:MM:SS` as seconds since 1970, taken as UTC; also gives what follows.
fn parse_date(text: &[u8]) -> Option<(i64, &[u8])> {
    let (text, rest) = text.split_at_checked(19)?;
    let number = |range: Range<usize>| {
        text.get(range)?
            .iter()
            .try_fold(0_i64, |n, c| c.is_ascii_digit().then(|| n * 10 + i64::from(c - b'0')))
    };
    let separators = [(4, b'-'), (7, b'-'), (10, b' '), (13, b':'), (16, b':')];
    if separators.iter().any(|(at, c)| text.get(*at) != Some(c)) {
        return None;
    }
    let (year, month, day) = (number(0..4)?, number(5..7)?, number(8..10)?);
    let (hour, minute, second) = (number(11..13)?, number(14..16)?, number(17..19)?);
    if !(1..=12).contains(&month) || !(1..=31).contains(&day) || hour > 23 || minute > 59 || second > 60 {
        return None;
    }
    // Days since 1970-01-01 in years that begin in March, so that the leap day comes last: H. Hinnant, "chrono-compatible
    // low-level date algorithms", days_from_civil.
    let year = if month <= 2 { year - 1 } else { year };
    let era = year.div_euclid(400);
    let year_of_era = year.rem_euclid(400);
    let day_of_year = (153 * (if month > 2 { month - 3 } else { month + 9 }) + 2) / 5 + day - 1;
    let days = era * 146_097 + year_of_era * 365 + year_of_era / 4 - year_of_era / 100 + day_of_year - 719_468;
    Some((days * 86_400 + hour * 3_600 + minute * 60 + second, rest))
}

/// An identifier of three or eight digits, and whether it is an error frame's.
fn parse_id(digits: &[u8]) -> Result<(Id, bool), LineError> {
    let id = digits
        .iter()
        .fold(0_u32, |n, c| n << 4 | u32::from(hex(*c).unwrap_or(0)));
    if digits.len() == 3 {
        return match u16::try_from(id) {
            Ok(standard) if standard <= 0x7FF => Ok((Id::Standard(standard), false)),
            _ => Err(LineError::IdentifierRange { id, bits: 11 }),
        };
    }
    let number = id & !ERROR_FLAG;
    if number > 0x1FFF_FFFF {
        return Err(LineError::IdentifierRange { id, bits: 29 });
    }
    Ok((Id::Extended(number), id & ERROR_FLAG != 0))
}

struct ParsedFrame {
    frame: Frame,
    whole: bool,
}

/// Reads what follows the first `#`; also tells how much of it is the frame.
fn parse_log_frame((id, error): (Id, bool), text: &[u8]) -> Result<(ParsedFrame, usize), LineError> {
    let (format, most, mut rest) = match text {
        [b'#', b'#', ..] => return Err(LineError::Xl),
        [b'#', ..] if error => return Err(LineError::Contradiction),
        [b'#', flags, rest @ ..] => {
            let flags = hex(*flags).ok_or(LineError::Flags)?;
            (
                Format::Fd {
                    bit_rate_switch: flags & 1 != 0,
                    error_state: flags & 2 != 0,
                },
                Frame::MAX_LEN,
                rest,
            )
        }
        [b'#'] => return Err(LineError::Flags),
        [b'R', ..] if error => return Err(LineError::Contradiction),
        [b'R', rest @ ..] => {
            let (len, rest) = match rest {
                [c @ b'0'..=b'8', rest @ ..] => (Some(c - b'0'), rest),
                [c, ..] if c.is_ascii_alphanumeric() => return Err(LineError::Length),
                _ => (None, rest),
            };
            let frame = Frame::remote(id, len.unwrap_or(0));
            return Ok((
                ParsedFrame {
                    frame,
                    whole: len.is_some(),
                },
                text.len() - skip_raw_length(rest)?.len(),
            ));
        }
        _ => (if error { Format::Error } else { Format::Classic }, 8, text),
    };
    let mut data = [0_u8; Frame::MAX_LEN];
    let mut len = 0;
    for place in data.iter_mut().take(most) {
        // cansend takes points between the bytes.
        let pairs = if let [b'.', after @ ..] = rest { after } else { rest };
        let [high, low, after @ ..] = pairs else { break };
        let Some(byte) = hex_byte(*high, *low) else { break };
        *place = byte;
        len += 1;
        rest = after;
    }
    if len == most && matches!(rest, [high, low, ..] if hex_byte(*high, *low).is_some()) {
        return Err(LineError::TooLong { most });
    }
    let whole = len == most || rest.first() == Some(&b'_');
    if most == 8 && len == 8 {
        rest = skip_raw_length(rest)?;
    }
    if !matches!(rest, [] | [b' ' | b'\t', ..]) {
        return Err(LineError::Data);
    }
    let frame = Frame::with_format(id, format, data.get(..len).unwrap_or(&[])).ok_or(LineError::TooLong { most })?;
    Ok((ParsedFrame { frame, whole }, text.len() - rest.len()))
}

/// The `_9` to `_F` of a raw length code above 8.
fn skip_raw_length(rest: &[u8]) -> Result<&[u8], LineError> {
    match rest {
        [b'_', b'9' | b'A'..=b'F' | b'a'..=b'f', after @ ..] => Ok(after),
        [b'_', ..] => Err(LineError::Length),
        _ => Ok(rest),
    }
}

/// Reads what follows the identifier on screen, from the bracket on.
fn parse_screen_frame(
    (id, error): (Id, bool),
    text: &[u8],
    (bit_rate_switch, error_state): (bool, bool),
) -> Result<ParsedFrame, LineError> {
    let digit = |c: &u8| usize::from(c - b'0');
    let (fd, declared, rest) = match text {
        [b'[', c @ b'0'..=b'8', b']', rest @ ..] => (false, digit(c), rest),
        // candump -8 shows a raw length code above 8 so.
        [b'{', b'9' | b'A'..=b'F' | b'a'..=b'f', b'}', rest @ ..] => (false, 8, rest),
        [b'[', a @ b'0'..=b'9', b @ b'0'..=b'9', b']', rest @ ..] => (true, digit(a) * 10 + digit(b), rest),
        [b'[', b'0'..=b'9', b'0'..=b'9', b'0'..=b'9', b'0'..=b'9', b']', ..] => return Err(LineError::Xl),
        [b'[' | b'{', ..] => return Err(LineError::Length),
        _ => return Err(LineError::Separator),
    };
    if declared > Frame::MAX_LEN {
        return Err(LineError::Length);
    }
    let mut rest = rest.trim_ascii_start();
    if rest == b"remote request" {
        if fd || error {
            return Err(LineError::Contradiction);
        }
        #[allow(clippy::cast_possible_truncation)] // at most 8
        return Ok(ParsedFrame {
            frame: Frame::remote(id, declared as u8),
            whole: true,
        });
    }
    let mut bytes = [0_u8; Frame::MAX_LEN];
    let mut backwards = false;
    let data = bytes.get_mut(..declared).ok_or(LineError::Length)?;
    for (found, byte) in data.iter_mut().enumerate() {
        if found > 0 {
            rest = match rest {
                [b' ', after @ ..] => after,
                [b'`', after @ ..] => {
                    backwards = true;
                    after
                }
                _ => return Err(LineError::Missing { declared, found }),
            };
        }
        let width = rest.iter().take_while(|c| c.is_ascii_hexdigit()).count();
        let (text, after) = rest.split_at_checked(width).unwrap_or((rest, &[]));
        *byte = match text {
            [high, low] => hex_byte(*high, *low).ok_or(LineError::Data)?,
            [_, _, _, _, _, _, _, _] if text.iter().all(|c| matches!(c, b'0' | b'1')) => {
                text.iter().fold(0, |n, c| n << 1 | (c - b'0'))
            }
            [] => return Err(LineError::Missing { declared, found }),
            _ => return Err(LineError::Data),
        };
        rest = after;
    }
    if backwards {
        data.reverse();
    }
    match rest.trim_ascii_start() {
        [] | [b'\'' | b'`', ..] => {}
        b"ERRORFRAME" if error => {}
        _ => return Err(LineError::Trailing),
    }
    let format = match (fd, error) {
        (true, true) => return Err(LineError::Contradiction),
        (true, false) => Format::Fd {
            bit_rate_switch,
            error_state,
        },
        (false, true) => Format::Error,
        (false, false) => Format::Classic,
    };
    let frame = Frame::with_format(id, format, data).ok_or(LineError::TooLong { most: 8 })?;
    // `[0]` could be the beginning of a remote request.
    Ok(ParsedFrame {
        frame,
        whole: declared > 0,
    })
}

/// Reads a frame as cansend takes it: `123#DEADBEEF`, `123##1AABB`, `00000123#R4`, `123#11.22.33`.
///
/// # Errors
/// [`LineError`] says what can not be read.
pub fn parse_frame(text: &[u8]) -> Result<Frame, LineError> {
    let digits = text.iter().take_while(|c| hex(**c).is_some()).count();
    if digits != 3 && digits != 8 {
        return Err(LineError::Identifier { digits });
    }
    let (id, after) = text.split_at_checked(digits).unwrap_or((text, &[]));
    let [b'#', data @ ..] = after else {
        return Err(LineError::Separator);
    };
    let (parsed, used) = parse_log_frame(parse_id(id)?, data)?;
    if used == data.len() {
        Ok(parsed.frame)
    } else {
        Err(LineError::Trailing)
    }
}

/// What the stamps of a log mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Stamps {
    /// Find out; the module documentation says how.
    #[default]
    Detect,
    /// Each counts from the log's origin.
    SinceOrigin,
    /// Each counts from the line before (`candump -t d`).
    SincePrevious,
}

/// What a [`Reader`] has seen so far.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Report {
    /// Lines, the bad ones included.
    pub lines: u64,
    /// Frames.
    pub records: u64,
    /// Frames without a stamp.
    pub unstamped: u64,
    /// Frames whose stamp is earlier than that of the frame before.
    pub backwards: u64,
    /// Frames that candump says it lost.
    pub dropped: u64,
    /// Lines that could not be read; they are skipped.
    pub bad: u64,
    /// The number and fault of the first eight of them.
    pub first_bad: ArrayVec<(u64, LineError), NAMED>,
}

/// Reads the records of a log one after the other; allocates nothing after it is made.
///
/// A line that can not be read is skipped and reported. A last line without an end, as a recorder that was stopped leaves
/// it, counts only if no continuation could have made it another frame: half a payload is not handed out as a short one.
#[derive(Debug)]
pub struct Reader<R> {
    inner: R,
    line: Vec<u8>,
    stamps: Stamps,
    sum: Nanos,
    last: Option<Nanos>,
    report: Report,
}

impl<R: BufRead> Reader<R> {
    /// Reads from `inner`. To tell relative stamps apart it looks ahead as far as `inner` has buffered.
    pub fn new(inner: R) -> Self {
        Self::with_stamps(inner, Stamps::Detect)
    }

    /// Reads from `inner`, whose relative stamps mean `stamps`.
    pub fn with_stamps(inner: R, stamps: Stamps) -> Self {
        let line = Vec::with_capacity(MAX_LINE + 2);
        Self {
            inner,
            line,
            stamps,
            sum: Nanos::ZERO,
            last: None,
            report: Report::default(),
        }
    }

    /// What it has seen so far.
    pub const fn report(&self) -> &Report {
        &self.report
    }

    /// What relative stamps are taken to mean; [`Stamps::Detect`] as long as none was seen.
    pub const fn stamps(&self) -> Stamps {
        self.stamps
    }

    /// The next record; `None` at the end of the log.
    ///
    /// # Errors
    /// What reading fails with. A bad line is not an error: see [`Reader::report`].
    pub fn next_record(&mut self) -> io::Result<Option<Record<'_>>> {
        let parsed = loop {
            match self.next_parsed()? {
                None => return Ok(None),
                Some(Ok(ParsedLine::Record(parsed))) => break parsed,
                Some(Ok(ParsedLine::Dropped(count))) => self.report.dropped = self.report.dropped.saturating_add(count),
                Some(Ok(ParsedLine::Note)) => {}
                Some(Err(error)) => {
                    self.report.bad += 1;
                    // The ninth and later are counted alone.
                    let _ = self.report.first_bad.try_push((self.report.lines, error));
                }
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

    /// The next line, read and parsed; `None` at the end.
    fn next_parsed(&mut self) -> io::Result<Option<Result<ParsedLine, LineError>>> {
        self.line.clear();
        let most = MAX_LINE as u64 + 1;
        if self.inner.by_ref().take(most).read_until(b'\n', &mut self.line)? == 0 {
            return Ok(None);
        }
        self.report.lines += 1;
        let ended = self.line.last() == Some(&b'\n');
        if !ended && self.line.len() > MAX_LINE {
            // The rest of it, in pieces.
            while self.line.last() != Some(&b'\n') {
                self.line.clear();
                if self.inner.by_ref().take(most).read_until(b'\n', &mut self.line)? == 0 {
                    break;
                }
            }
            return Ok(Some(Err(LineError::LineTooLong)));
        }
        let parsed = parse_line(&self.line);
        Ok(Some(match parsed {
            Ok(ParsedLine::Record(ref record)) if !ended && !record.whole => Err(LineError::Unfinished),
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

/// The longest text of a frame: identifier, `##`, flags, 64 bytes.
const FRAME_TEXT: usize = 8 + 2 + 1 + 2 * Frame::MAX_LEN;
/// The longest text of a stamp: brackets, sign, 10 digits, point, 9 decimals, and a blank; `i64` allows no more.
const STAMP_TEXT: usize = 24;

/// Text under construction; what does not fit is not written, and everything fits.
struct Text<const N: usize> {
    bytes: [u8; N],
    len: usize,
}

impl<const N: usize> Text<N> {
    const fn new() -> Self {
        Self { bytes: [0; N], len: 0 }
    }

    fn push(&mut self, byte: u8) {
        if let Some(place) = self.bytes.get_mut(self.len) {
            *place = byte;
            self.len += 1;
        }
    }

    fn push_hex(&mut self, byte: u8) {
        for digit in DIGITS.get(byte as usize).copied().unwrap_or_default() {
            self.push(digit);
        }
    }

    /// `number` in decimal, at least `width` digits.
    fn push_decimal(&mut self, mut number: u64, width: usize) {
        let mut digits = [b'0'; 20];
        let mut used = 0;
        for place in digits.iter_mut().rev() {
            if number == 0 && used >= width {
                break;
            }
            #[allow(clippy::cast_possible_truncation)] // below 10
            {
                *place = b'0' + (number % 10) as u8;
            }
            number /= 10;
            used += 1;
        }
        for digit in digits.get(digits.len() - used..).unwrap_or_default() {
            self.push(*digit);
        }
    }

    fn as_bytes(&self) -> &[u8] {
        self.bytes.get(..self.len).unwrap_or(&self.bytes)
    }
}

fn push_frame<const N: usize>(text: &mut Text<N>, frame: &Frame) {
    let extended = |text: &mut Text<N>, id: u32| id.to_be_bytes().into_iter().for_each(|byte| text.push_hex(byte));
    match (frame.format, frame.id) {
        (Format::Error, id) => extended(text, id.raw() | ERROR_FLAG),
        (_, Id::Extended(id)) => extended(text, id),
        (_, Id::Standard(id)) => {
            let [high, low] = id.to_be_bytes();
            let [_, digit] = DIGITS.get(high as usize).copied().unwrap_or_default();
            text.push(digit);
            text.push_hex(low);
        }
    }
    text.push(b'#');
    match frame.format {
        Format::Classic | Format::Error => {}
        Format::Fd {
            bit_rate_switch,
            error_state,
        } => {
            text.push(b'#');
            text.push(b'0' + (u8::from(bit_rate_switch) | u8::from(error_state) << 1));
        }
        Format::Remote => {
            text.push(b'R');
            if !frame.is_empty() {
                text.push_decimal(frame.len() as u64, 1);
            }
        }
    }
    for byte in frame.data() {
        text.push_hex(*byte);
    }
}

/// Writes one line of the log format: `(1436509052.249713) vcan0 123#DEADBEEF`.
///
/// The stamp has six decimals as candump's if it is a whole number of microseconds, else nine.
///
/// # Errors
/// `InvalidInput` for an interface name that is empty or has blanks, which no reader could take apart again; what writing
/// fails with.
pub fn write_log_line(out: &mut impl Write, stamp: Nanos, interface: &str, frame: &Frame) -> io::Result<()> {
    if interface.is_empty()
        || interface.contains(|c: char| c.is_ascii_whitespace() || c.is_control())
        || interface.starts_with('(')
    {
        return Err(io::Error::new(
            io::ErrorKind::InvalidInput,
            format!("{interface:?} can not be an interface name in a log"),
        ));
    }
    let mut head = Text::<STAMP_TEXT>::new();
    head.push(b'(');
    if stamp.0 < 0 {
        head.push(b'-');
    }
    let ns = stamp.0.unsigned_abs();
    let (seconds, fraction) = (ns / 1_000_000_000, ns % 1_000_000_000);
    head.push_decimal(seconds, 10);
    head.push(b'.');
    if fraction % 1_000 == 0 {
        head.push_decimal(fraction / 1_000, 6);
    } else {
        head.push_decimal(fraction, 9);
    }
    head.push(b')');
    head.push(b' ');
    let mut tail = Text::<{ FRAME_TEXT + 2 }>::new();
    tail.push(b' ');
    push_frame(&mut tail, frame);
    tail.push(b'\n');
    out.write_all(head.as_bytes())?;
    out.write_all(interface.as_bytes())?;
    out.write_all(tail.as_bytes())
}

/// Writes a log; give it a buffered `out`.
#[derive(Debug)]
pub struct Writer<W> {
    out: W,
    frames: u64,
}

impl<W: Write> Writer<W> {
    /// Writes to `out`.
    pub const fn new(out: W) -> Self {
        Self { out, frames: 0 }
    }

    /// Adds a frame, stamped with its own `t`.
    ///
    /// # Errors
    /// As [`write_log_line`].
    pub fn write(&mut self, interface: &str, frame: &Frame) -> io::Result<()> {
        write_log_line(&mut self.out, frame.t, interface, frame)?;
        self.frames += 1;
        Ok(())
    }

    /// How many frames were written.
    pub const fn frames(&self) -> u64 {
        self.frames
    }

    /// Writes out what is buffered and gives `out` back.
    ///
    /// # Errors
    /// What writing fails with.
    pub fn finish(mut self) -> io::Result<W> {
        self.out.flush()?;
        Ok(self.out)
    }
}
