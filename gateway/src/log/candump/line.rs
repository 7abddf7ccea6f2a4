//! Parses one line of a log, in either format, into a record: the frame with its stamp, interface
//! and direction.

use super::stamp::parse_stamp;
use crate::log::record::{
    ERROR_FLAG, FrameDirection, Interface, LineError, OwnedRecord, ParsedLine, Record, StampForm,
};
use crate::log::text::{hex, hex_byte};
use proprio_drivers::{Format, Frame, Id};

/// One line of a log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Line<'a> {
    /// A frame.
    Record(Record<'a>),
    /// candump reports that it lost this number of frames (`candump -d`).
    Dropped(u64),
    /// Blank, a comment (`#`, `;`, `//`), or candump's explanation of an error frame.
    Note,
}

impl<'a> Line<'a> {
    /// Parses one line, with or without its line end. A relative stamp is returned as written; see
    /// [`LogReader`](crate::log::LogReader).
    ///
    /// # Errors
    /// [`LineError`] names the part that cannot be read.
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

pub(in crate::log) fn parse_line(line: &[u8]) -> Result<ParsedLine, LineError> {
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

    // All these slices end where the line ends, so their lengths give the positions.
    let start = line.len() - rest.len();
    let (name, after) = split_interface(rest)?;
    let interface = start..start + name.len();
    rest = after.trim_ascii_start();

    let (columns, after) = parse_columns(rest);
    rest = after;
    let digits = rest.iter().take_while(|c| hex(**c).is_some()).count();
    let (id, after) = rest.split_at_checked(digits).unwrap_or((rest, &[]));
    let identifier = || match digits {
        0 => Err(LineError::NoFrame),
        3 | 8 => parse_id(id),
        _ => Err(LineError::Identifier { digits }),
    };
    // A stamp that is not absolute counts from the start in a log, and from the line before on a
    // screen.
    let (frame, direction, relative) = match after {
        [b'#', data @ ..] if columns.is_none() => {
            let (mut frame, used) = parse_log_frame(identifier()?, data)?;
            let direction = match data.get(used..).unwrap_or(&[]).trim_ascii_start() {
                [] => None,
                b"R" => Some(FrameDirection::Received),
                b"T" => Some(FrameDirection::Sent),
                _ => return Err(LineError::Trailing),
            };
            frame.whole |= direction.is_some();
            (frame, direction, StampForm::Origin)
        }
        [b' ' | b'[', ..] => {
            let (direction, flags) = columns.map_or((None, (false, false)), |(d, f)| (Some(d), f));
            let frame = parse_screen_frame(identifier()?, after.trim_ascii_start(), flags)?;
            (frame, direction, StampForm::Relative)
        }
        _ if digits == 0 && rest.is_empty() => return Err(LineError::NoFrame),
        _ if digits != 3 && digits != 8 => return Err(LineError::Identifier { digits }),
        _ => return Err(LineError::Separator),
    };
    Ok(ParsedLine::Record(OwnedRecord {
        stamp: stamp.map(|s| match s.absolute {
            true => (s.t, StampForm::Absolute),
            false => (s.t, relative),
        }),
        interface: Interface::Text(interface),
        direction,
        frame: frame.frame,
        whole: frame.whole,
    }))
}

/// Splits the name of an interface from what follows.
fn split_interface(text: &[u8]) -> Result<(&[u8], &[u8]), LineError> {
    let end = text.iter().position(|c| *c == b' ' || *c == b'\t');
    let split = text.split_at_checked(end.unwrap_or(text.len()));
    // A name with control characters would reach a terminal.
    let is_name = |name: &[u8]| {
        std::str::from_utf8(name).is_ok_and(|name| !name.chars().any(char::is_control))
    };
    match split {
        Some(([] | [b'(', ..], _)) | None => Err(LineError::Interface),
        Some((name, _)) if !is_name(name) => Err(LineError::Interface),
        Some(split) => Ok(split),
    }
}

/// The columns of `candump -x`: the direction, and whether bit rate switch and error state are set.
type Columns = (FrameDirection, (bool, bool));

/// Parses the columns of `candump -x`, such as `TX B E  `.
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
            let direction = FrameDirection::of(*d == b'T');
            let columns = (direction, (*brs == b'B', *esi == b'E'));
            (Some(columns), after.trim_ascii_start())
        }
        _ => (None, rest),
    }
}

/// Parses an identifier of three or eight digits; also returns whether it belongs to an error
/// frame.
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

/// Parses the part after the first `#`; also returns how much of it belongs to the frame.
fn parse_log_frame(
    (id, error): (Id, bool),
    text: &[u8],
) -> Result<(ParsedFrame, usize), LineError> {
    let (format, most, mut rest) = match text {
        [b'#', b'#', ..] => return Err(LineError::Xl),
        [b'#', ..] if error => return Err(LineError::Contradiction),
        [b'#', flags, rest @ ..] => {
            let flags = hex(*flags).ok_or(LineError::Flags)?;
            (
                Format::fd(flags & 1 != 0, flags & 2 != 0),
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
        _ => (
            if error {
                Format::Error
            } else {
                Format::Classic
            },
            8,
            text,
        ),
    };
    let mut data = [0_u8; Frame::MAX_LEN];
    let mut len = 0;
    for place in data.iter_mut().take(most) {
        // cansend allows points between the bytes.
        let pairs = if let [b'.', after @ ..] = rest {
            after
        } else {
            rest
        };
        let [high, low, after @ ..] = pairs else {
            break;
        };
        let Some(byte) = hex_byte(*high, *low) else {
            break;
        };
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
    let frame = Frame::with_format(id, format, data.get(..len).unwrap_or(&[]))
        .ok_or(LineError::TooLong { most })?;
    Ok((ParsedFrame { frame, whole }, text.len() - rest.len()))
}

/// Skips the `_9` to `_F` of a raw length code above 8.
fn skip_raw_length(rest: &[u8]) -> Result<&[u8], LineError> {
    match rest {
        [b'_', b'9' | b'A'..=b'F' | b'a'..=b'f', after @ ..] => Ok(after),
        [b'_', ..] => Err(LineError::Length),
        _ => Ok(rest),
    }
}

/// Parses the part after the identifier in the screen format, from the bracket on.
fn parse_screen_frame(
    (id, error): (Id, bool),
    text: &[u8],
    (bit_rate_switch, error_state): (bool, bool),
) -> Result<ParsedFrame, LineError> {
    let digit = |c: &u8| usize::from(c - b'0');
    let (fd, declared, rest) = match text {
        [b'[', c @ b'0'..=b'8', b']', rest @ ..] => (false, digit(c), rest),
        // candump -8 prints a raw length code above 8 this way.
        [b'{', b'9' | b'A'..=b'F' | b'a'..=b'f', b'}', rest @ ..] => (false, 8, rest),
        [b'[', a @ b'0'..=b'9', b @ b'0'..=b'9', b']', rest @ ..] => {
            (true, digit(a) * 10 + digit(b), rest)
        }
        [
            b'[',
            b'0'..=b'9',
            b'0'..=b'9',
            b'0'..=b'9',
            b'0'..=b'9',
            b']',
            ..,
        ] => return Err(LineError::Xl),
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
    let data = bytes.get_mut(..declared).ok_or(LineError::Length)?;
    rest = parse_screen_bytes(rest, data)?;
    match rest.trim_ascii_start() {
        [] | [b'\'' | b'`', ..] => {}
        b"ERRORFRAME" if error => {}
        _ => return Err(LineError::Trailing),
    }
    let format = match (fd, error) {
        (true, true) => return Err(LineError::Contradiction),
        (true, false) => Format::fd(bit_rate_switch, error_state),
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

/// Parses as many bytes as `data` has, in hexadecimal or binary digits, and returns the rest. Signs
/// like `` ` `` between them say that they are in reversed order.
fn parse_screen_bytes<'a>(mut rest: &'a [u8], data: &mut [u8]) -> Result<&'a [u8], LineError> {
    let declared = data.len();
    let mut backwards = false;
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
    Ok(rest)
}

/// Parses a frame in cansend's format: `123#DEADBEEF`, `123##1AABB`, `00000123#R4`, `123#11.22.33`.
///
/// # Errors
/// [`LineError`] names the part that cannot be read.
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
