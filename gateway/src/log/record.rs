//! What all formats of logs have in common: a record, and why a part of a log cannot be read.

use proprio_drivers::{Format, Frame, Id};
use proprio_topics::{Nanos, StampKind};
use std::fmt;
use std::ops::Range;

/// The error flag of a SocketCAN identifier, which candump's formats show.
pub(super) const ERROR_FLAG: u32 = 0x2000_0000;
/// The longest line that is read; the longest that any program writes (candump's of 64 bytes in
/// binary digits) has about 650 characters.
pub(super) const MAX_LINE: usize = 4096;
/// The class of an error frame of which no more is known: CAN_ERR_BUSERROR of linux/can/error.h.
const BUS_ERROR: u32 = 0x80;

/// A format of logs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum LogFormat {
    /// can-utils' candump: its log format and its screen format.
    Candump,
    /// Vector ASC.
    Asc,
    /// Vector BLF.
    Blf,
    /// PEAK TRC.
    Trc,
    /// The table that python-can writes.
    Csv,
}

impl LogFormat {
    /// All formats, in words.
    pub const ALL: &str = "candump, Vector ASC, Vector BLF, PEAK TRC, CSV of python-can";

    /// What the format consists of, in the plural.
    #[must_use]
    pub const fn parts(self) -> &'static str {
        match self {
            Self::Blf => "objects",
            _ => "lines",
        }
    }
}

impl fmt::Display for LogFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Candump => "candump",
            Self::Asc => "Vector ASC",
            Self::Blf => "Vector BLF",
            Self::Trc => "PEAK TRC",
            Self::Csv => "python-can CSV",
        })
    }
}

/// Whether a frame was received or sent by the host that recorded it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameDirection {
    /// `R`, `RX`: it came from the bus.
    Received,
    /// `T`, `TX`: that host sent it.
    Sent,
}

impl FrameDirection {
    pub(super) const fn of(sent: bool) -> Self {
        match sent {
            true => Self::Sent,
            false => Self::Received,
        }
    }
}

/// One frame of a log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Record<'a> {
    /// The stamp in the line; `None` if there is none. From a [`LogReader`](super::LogReader):
    /// relative to the log's origin, with stamps since the previous line added up.
    pub stamp: Option<Nanos>,
    /// The interface it was seen on.
    pub interface: &'a str,
    /// Whether it was received or sent, if the line states it.
    pub direction: Option<FrameDirection>,
    /// The frame, with `t` the stamp and [`StampKind::Log`], or zero and [`StampKind::None`].
    pub frame: Frame,
}

/// Why a line of a text, or an object of a BLF file, cannot be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum LineError {
    /// The stamp cannot be read.
    #[error(
        "the time stamp is not (SECONDS.FRACTION) with at most nine decimals, nor (YYYY-MM-DD \
         HH:MM:SS.FRACTION)"
    )]
    Stamp,
    /// The stamp is far later than that of the next frame.
    #[error("the time stamp is {ahead} s later than that of the next frame")]
    Ahead {
        /// By how much \[ns\].
        ahead: Nanos,
    },
    /// The stamp is no instant that anything could be waited for from.
    #[error("the time stamp is out of range: more than 146 years from the origin")]
    Range,
    /// There is no interface, or it is not text.
    #[error("there is no interface name")]
    Interface,
    /// The line has no frame.
    #[error("there is no frame after the interface name")]
    NoFrame,
    /// The identifier has neither three nor eight hexadecimal digits.
    #[error(
        "the identifier has {digits} hexadecimal digits; 3 make a standard one, 8 an extended one"
    )]
    Identifier {
        /// Its number of digits.
        digits: usize,
    },
    /// The identifier is larger than 11 or 29 bits.
    #[error("the identifier {id:#X} is larger than its {bits} bits")]
    IdentifierRange {
        /// The identifier read.
        id: u32,
        /// The number of bits: 11 or 29.
        bits: u8,
    },
    /// Neither `#` nor `[` follows the identifier.
    #[error("after the identifier there is neither #DATA nor [LENGTH]")]
    Separator,
    /// The hexadecimal digit of the CAN FD flags is missing.
    #[error("after ## there is no hexadecimal digit of CAN FD flags")]
    Flags,
    /// A CAN XL frame.
    #[error("CAN XL frames are not supported")]
    Xl,
    /// The data are not pairs of hexadecimal digits.
    #[error("the data are not whole bytes in hexadecimal digits")]
    Data,
    /// More data than this kind of frame can have.
    #[error("the frame has more than {most} bytes")]
    TooLong {
        /// The maximum number of bytes.
        most: usize,
    },
    /// The length in brackets cannot be read.
    #[error("the length in brackets is not a number up to 8, or with two digits up to 64")]
    Length,
    /// Fewer bytes follow than the length in brackets.
    #[error("{declared} bytes are declared, but {found} follow")]
    Missing {
        /// The length in brackets.
        declared: usize,
        /// The number of bytes read.
        found: usize,
    },
    /// A remote request or an error frame that is marked as CAN FD.
    #[error("a remote request or an error frame cannot be CAN FD")]
    Contradiction,
    /// Something follows the frame.
    #[error("there is unexpected text after the frame")]
    Trailing,
    /// The line is longer than any that candump writes.
    #[error("the line is longer than {MAX_LINE} bytes")]
    LineTooLong,
    /// The last line has no line end and could be the beginning of a longer line.
    #[error("the last line is incomplete (it has no line end)")]
    Unfinished,
    /// The time of an event, frame or message is not a number.
    #[error("the time is not a decimal number")]
    Time,
    /// The date at which the recording began cannot be read.
    #[error("the date of the recording cannot be read; its times count from its first moment")]
    Date,
    /// An identifier without a fixed number of digits cannot be read.
    #[error("the identifier is not a number")]
    Number,
    /// A message is named, and nothing tells its identifier.
    #[error(
        "the message has a name instead of an identifier, and no \"ID = \" at the end of the line \
         tells that: record without symbolic names"
    )]
    Symbolic,
    /// The direction is neither of the two.
    #[error("the direction is neither Rx nor Tx")]
    Direction,
    /// The kind of a frame or message is none that the format has.
    #[error("the kind of the frame is none of {format}'s")]
    Kind {
        /// The format.
        format: LogFormat,
    },
    /// The line is neither a header nor an event of the format.
    #[error("this is no line of a {format} log")]
    Foreign {
        /// The format.
        format: LogFormat,
    },
    /// A TRC file whose columns are not known.
    #[error(
        "the version of the TRC file is not 1.0 to 2.1, or ;$COLUMNS= does not name O, T, I, and l \
         or L"
    )]
    Columns,
    /// A table of another program.
    #[error(
        "it is a table with columns other than python-can's, which are \
         timestamp,arbitration_id,extended,remote,error,dlc,data; a table of samples is what \
         `proprio decode` writes, for --samples of other verbs"
    )]
    Table,
    /// A row of python-can's table has another number of fields, or a flag is not 0 or 1.
    #[error("the row is not timestamp,arbitration_id,extended,remote,error,dlc,data")]
    Row,
    /// The data are not base64.
    #[error("the data are not base64")]
    Base64,
    /// The file is of a kind that is no log.
    #[error("it is {0}")]
    NoLog(&'static str),
    /// A container of objects is damaged.
    #[error("a container is damaged: some of its objects are lost or wrong")]
    Container,
    /// A container is packed in an unknown way.
    #[error("a container is packed with method {0}; 0 (not at all) and 2 (zlib) are known")]
    Packing(u16),
    /// There is something between two objects.
    #[error("the {0} bytes before this object are not an object: the file is damaged there")]
    Gap(u64),
    /// The object is shorter than its kind requires.
    #[error("the object is too short, or its sizes contradict each other")]
    Object,
    /// The file ends early.
    #[error("the file was cut off: it ends early")]
    CutOff,
}

impl LineError {
    /// Whether nothing after it can be read.
    pub(super) const fn is_final(self) -> bool {
        matches!(self, Self::NoLog(_) | Self::Table | Self::Columns)
    }
}

/// The origin of a stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StampForm {
    /// 1970, or a date.
    Absolute,
    /// The log's origin.
    Origin,
    /// In candump's screen format: the first line or the previous line.
    Relative,
}

/// Where a frame was seen.
#[derive(Debug)]
pub(super) enum Interface {
    /// The name is this part of the line.
    Text(Range<usize>),
    /// The format numbers its channels; this is the number from zero on.
    Channel(u16),
}

impl Interface {
    /// That of channel `number`, where the first is 1. A channel 0, which some programs write, is
    /// the first, too.
    pub(super) const fn channel(number: u16) -> Self {
        Self::Channel(number.saturating_sub(1))
    }
}

/// A record without its borrow of the line.
#[derive(Debug)]
pub(super) struct OwnedRecord {
    pub(super) stamp: Option<(Nanos, StampForm)>,
    pub(super) interface: Interface,
    pub(super) direction: Option<FrameDirection>,
    pub(super) frame: Frame,
    /// Whether no continuation of this line could make it another frame.
    pub(super) whole: bool,
}

/// What a line or an object holds.
#[derive(Debug)]
pub(super) enum ParsedLine {
    Record(OwnedRecord),
    Dropped(u64),
    Note,
}

impl OwnedRecord {
    pub(super) fn record(self, line: &[u8], stamp: Option<Nanos>) -> Option<Record<'_>> {
        let Interface::Text(interface) = self.interface else {
            return None;
        };
        let interface = std::str::from_utf8(line.get(interface)?).ok()?;
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

/// An identifier of 29 bits if `extended`, else of 11.
pub(super) fn identifier(id: u32, extended: bool) -> Result<Id, LineError> {
    let range = |bits| LineError::IdentifierRange { id, bits };
    match (extended, u16::try_from(id)) {
        (true, _) if id <= 0x1FFF_FFFF => Ok(Id::Extended(id)),
        (true, _) => Err(range(29)),
        (false, Ok(id)) if id <= 0x7FF => Ok(Id::Standard(id)),
        (false, _) => Err(range(11)),
    }
}

/// The stamp of a frame that came `t` after the recording began at `start`, if that is known.
pub(super) fn stamp_since(start: Option<Nanos>, t: Nanos) -> (Nanos, StampForm) {
    match start {
        Some(start) => (start.saturating_add(t), StampForm::Absolute),
        None => (t, StampForm::Origin),
    }
}

/// An error frame of which no more is known.
pub(super) fn bus_error() -> Frame {
    let mut frame = Frame::new(Id::extended(BUS_ERROR), &[]);
    frame.format = Format::Error;
    frame
}

/// The number of bytes that a CAN FD length code stands for.
pub(super) const fn fd_length(code: u8) -> usize {
    match code {
        0..=8 => code as usize,
        9 => 12,
        10 => 16,
        11 => 20,
        12 => 24,
        13 => 32,
        14 => 48,
        _ => 64,
    }
}
