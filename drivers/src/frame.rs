//! A CAN frame with its time of arrival.

use core::fmt;
use proprio_topics::{Nanos, StampKind};

/// A CAN identifier. Standard and extended identifiers of the same number are different
/// identifiers.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Id {
    /// 11 bits.
    Standard(u16),
    /// 29 bits.
    Extended(u32),
}

impl Id {
    /// A standard identifier from the low 11 bits.
    #[must_use]
    pub const fn standard(id: u16) -> Self {
        Self::Standard(id & 0x7FF)
    }

    /// An extended identifier from the low 29 bits.
    #[must_use]
    pub const fn extended(id: u32) -> Self {
        Self::Extended(id & 0x1FFF_FFFF)
    }

    /// The number alone.
    #[must_use]
    pub const fn raw(self) -> u32 {
        match self {
            Self::Standard(id) => id as u32,
            Self::Extended(id) => id,
        }
    }
}

impl fmt::Display for Id {
    /// `0x123`, or `0x1F334455`: three hexadecimal digits for a standard identifier, eight for an
    /// extended one.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "0x{}", Digits(*self))
    }
}

/// An identifier as can-utils write it, as part of a frame: without `0x`.
struct Digits(Id);

impl fmt::Display for Digits {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Id::Standard(id) => write!(f, "{id:03X}"),
            Id::Extended(id) => write!(f, "{id:08X}"),
        }
    }
}

impl fmt::Debug for Id {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// What kind of frame it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Format {
    /// A classic data frame, at most 8 bytes.
    Classic,
    /// A CAN FD data frame, at most 64 bytes.
    Fd {
        /// Its data was sent at the higher bit rate (BRS).
        bit_rate_switch: bool,
        /// The sender is error passive (ESI).
        error_state: bool,
    },
    /// A remote transmission request: no data; `len` is the requested length.
    Remote,
    /// An error frame of the SocketCAN interface: the identifier holds the error classes
    /// (linux/can/error.h).
    Error,
}

/// One frame.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Frame {
    /// Time of reception, or time to send it \[ns\].
    pub t: Nanos,
    /// Its identifier.
    pub id: Id,
    /// The source of `t`.
    pub stamp: StampKind,
    /// What kind of frame it is.
    pub format: Format,
    /// Number of valid bytes in `data`.
    len: u8,
    data: [u8; 64],
}

impl Format {
    /// CAN FD with these two bits.
    #[must_use]
    pub const fn fd(bit_rate_switch: bool, error_state: bool) -> Self {
        Self::Fd {
            bit_rate_switch,
            error_state,
        }
    }
}

impl Frame {
    /// The longest payload \[bytes\].
    pub const MAX_LEN: usize = 64;

    /// A classic data frame with the first 8 bytes of `data`, without a stamp.
    #[must_use]
    pub fn new(id: Id, data: &[u8]) -> Self {
        Self::with_format(id, Format::Classic, data.get(..8).unwrap_or(data))
            .unwrap_or_else(|| unreachable_frame(id))
    }

    /// A frame of `format`; `None` if `data` is longer than that format allows (8 bytes; 64 for CAN
    /// FD).
    #[must_use]
    pub fn with_format(id: Id, format: Format, data: &[u8]) -> Option<Self> {
        let most = if matches!(format, Format::Fd { .. }) {
            Self::MAX_LEN
        } else {
            8
        };
        let mut bytes = [0; 64];
        if data.len() > most {
            return None;
        }
        bytes.get_mut(..data.len())?.copy_from_slice(data);
        #[allow(clippy::cast_possible_truncation)]
        Some(Self {
            t: Nanos::ZERO,
            id,
            stamp: StampKind::None,
            format,
            len: data.len() as u8,
            data: bytes,
        })
    }

    /// A remote transmission request for `len` bytes (at most 8).
    #[must_use]
    pub fn remote(id: Id, len: u8) -> Self {
        Self {
            t: Nanos::ZERO,
            id,
            stamp: StampKind::None,
            format: Format::Remote,
            len: len.min(8),
            data: [0; 64],
        }
    }

    /// The same frame with stamp `t`.
    #[must_use]
    pub const fn at(mut self, t: Nanos, stamp: StampKind) -> Self {
        self.t = t;
        self.stamp = stamp;
        self
    }

    /// The payload; empty for a remote request.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        if matches!(self.format, Format::Remote) {
            &[]
        } else {
            self.data.get(..self.len as usize).unwrap_or(&self.data)
        }
    }

    /// The payload's length, or the requested length of a remote request.
    #[must_use]
    pub const fn len(&self) -> usize {
        self.len as usize
    }

    /// Whether the length is zero.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }
}

/// Never used by [`Frame::new`], because 8 bytes always fit; it avoids a panic.
const fn unreachable_frame(id: Id) -> Frame {
    Frame {
        t: Nanos::ZERO,
        id,
        stamp: StampKind::None,
        format: Format::Classic,
        len: 0,
        data: [0; 64],
    }
}

impl fmt::Display for Frame {
    /// As can-utils' log format writes a frame, without stamp and interface: `31A#E380B76A1887`,
    /// `123##1AABB`, `123#R4`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let id = Digits(self.id);
        match self.format {
            Format::Classic => write!(f, "{id}#")?,
            Format::Fd {
                bit_rate_switch,
                error_state,
            } => {
                write!(
                    f,
                    "{id}##{:X}",
                    u8::from(bit_rate_switch) | u8::from(error_state) << 1
                )?;
            }
            Format::Remote if self.len == 0 => return write!(f, "{id}#R"),
            Format::Remote => return write!(f, "{id}#R{}", self.len),
            // In that format the error flag is part of the identifier: 20000000 + classes.
            Format::Error => write!(f, "{:08X}#", self.id.raw() | 0x2000_0000)?,
        }
        for byte in self.data() {
            write!(f, "{byte:02X}")?;
        }
        Ok(())
    }
}

impl fmt::Debug for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "({}) {self}", self.t)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::string::ToString;

    #[test]
    fn frames_print_as_can_utils_write_them() {
        assert_eq!(
            Frame::new(Id::standard(0x31A), &[0xE3, 0x80, 0xB7]).to_string(),
            "31A#E380B7"
        );
        assert_eq!(
            Frame::remote(Id::extended(0x123), 4).to_string(),
            "00000123#R4"
        );
        let empty = Frame::remote(Id::standard(0x705), 0);
        assert_eq!(empty.to_string(), "705#R");
        let fd = Format::Fd {
            bit_rate_switch: true,
            error_state: false,
        };
        let frame = Frame::with_format(Id::standard(0x123), fd, &[0xAA; 12]).map(|f| f.to_string());
        assert_eq!(frame.as_deref(), Some("123##1AAAAAAAAAAAAAAAAAAAAAAAA"));
        assert!(Frame::with_format(Id::standard(1), Format::Classic, &[0; 9]).is_none());
    }
}
