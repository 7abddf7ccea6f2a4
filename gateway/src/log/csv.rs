//! The table that python-can writes (`.csv`).
//!
//! ```text
//! timestamp,arbitration_id,extended,remote,error,dlc,data
//! 1483389946.197,0xdadada,1,0,0,6,WzQyLCA5XQ==
//! ```
//!
//! The time is in seconds as Python prints a double (`5e-05`), the identifier hexadecimal, the data
//! base64. A row has neither channel nor direction and does not tell CAN FD: a frame of more than
//! eight bytes is CAN FD, one of fewer is taken as classic. python-can writes no header when it
//! begins a file to append to.
//!
//! Source: python-can `io/csv.py`.

use super::record::{
    Interface, LineError, OwnedRecord, ParsedLine, StampForm, bus_error, identifier,
};
use super::text::{SECOND, decimal, number};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use proprio_drivers::{Format, Frame};

/// The names of the columns.
const HEADER: &[u8] = b"timestamp,arbitration_id,extended,remote,error,dlc,data";

/// Whether only this format has such a line.
pub(super) fn has(line: &[u8]) -> bool {
    line.trim_ascii() == HEADER || matches!(parse(line), Ok(ParsedLine::Record(_)))
}

/// Whether the line looks like the header of another table.
pub(super) fn is_other_table(line: &[u8]) -> bool {
    let mut fields = line
        .trim_ascii()
        .split(|c| matches!(c, b',' | b';' | b'\t'));
    let name = |field: &[u8]| {
        let field = field.trim_ascii();
        !field.is_empty() && field.is_ascii() && !field.iter().any(u8::is_ascii_control)
    };
    line.trim_ascii() != HEADER && fields.clone().count() > 2 && fields.all(name)
}

/// Parses a line.
pub(super) fn parse(line: &[u8]) -> Result<ParsedLine, LineError> {
    let line = line.trim_ascii();
    if line.is_empty() || line == HEADER {
        return Ok(ParsedLine::Note);
    }
    let mut fields = line.split(|c| *c == b',');
    let mut next = || fields.next().ok_or(LineError::Row);
    let flag = |field: &[u8]| match field {
        b"0" => Ok(false),
        b"1" => Ok(true),
        _ => Err(LineError::Row),
    };
    let t = decimal(next()?, SECOND).ok_or(LineError::Time)?;
    let id = next()?.strip_prefix(b"0x").and_then(|id| number(id, 16));
    let id = id.ok_or(LineError::Number)?;
    let (extended, remote, error) = (flag(next()?)?, flag(next()?)?, flag(next()?)?);
    let declared = number(next()?, 10).and_then(|n| usize::try_from(n).ok());
    let declared = declared.ok_or(LineError::Row)?;
    let text = next()?;
    if fields.next().is_some() {
        return Err(LineError::Row);
    }
    let id = identifier(id, extended)?;
    // Enough for 64 bytes and what the decoder writes ahead.
    let mut data = [0; 72];
    let found = STANDARD.decode_slice(text, &mut data);
    let data = data
        .get(..found.map_err(|_| LineError::Base64)?)
        .unwrap_or_default();
    let frame = if error {
        bus_error()
    } else if remote {
        Frame::remote(id, u8::try_from(declared).unwrap_or(8))
    } else if data.len() != declared {
        let found = data.len();
        return Err(LineError::Missing { declared, found });
    } else if declared <= 8 {
        Frame::new(id, data)
    } else {
        Frame::with_format(id, Format::fd(false, false), data)
            .ok_or(LineError::TooLong { most: 64 })?
    };
    Ok(ParsedLine::Record(OwnedRecord {
        stamp: Some((t, StampForm::Origin)),
        interface: Interface::channel(1),
        direction: None,
        // The text of so many bytes is so long, and no longer.
        whole: true,
        frame,
    }))
}
