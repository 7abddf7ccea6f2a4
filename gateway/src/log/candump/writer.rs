//! Writes frames in the log format, one line each.

use crate::log::record::ERROR_FLAG;
use proprio_drivers::{Format, Frame, Id};
use proprio_topics::Nanos;
use std::io::{self, Write};

/// The two hexadecimal digits of each byte.
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

/// The longest text of a frame: identifier, `##`, flags, 64 bytes.
const FRAME_TEXT: usize = 8 + 2 + 1 + 2 * Frame::MAX_LEN;
/// The longest text of a stamp: brackets, sign, 10 digits, point, 9 decimals, and a blank; `i64`
/// allows no more.
const STAMP_TEXT: usize = 24;

/// A text buffer; characters beyond its capacity are dropped, but all texts here fit.
struct Text<const N: usize> {
    bytes: [u8; N],
    len: usize,
}

impl<const N: usize> Text<N> {
    const fn new() -> Self {
        Self {
            bytes: [0; N],
            len: 0,
        }
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
    let extended = |text: &mut Text<N>, id: u32| {
        id.to_be_bytes()
            .into_iter()
            .for_each(|byte| text.push_hex(byte));
    };
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
/// The stamp has six decimals, as candump's, if it is a whole number of microseconds, else nine.
///
/// # Errors
/// `InvalidInput` for an interface name that is empty or has blanks, which no reader could parse; a
/// write error.
pub fn write_log_line(
    out: &mut impl Write,
    stamp: Nanos,
    interface: &str,
    frame: &Frame,
) -> io::Result<()> {
    if interface.is_empty()
        || interface.contains(|c: char| c.is_ascii_whitespace() || c.is_control())
        || interface.starts_with('(')
    {
        return Err(io::Error::new(
            io::ErrorKind::InvalidInput,
            format!("{interface:?} cannot be an interface name in a log (empty or with blanks)"),
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

    /// Number of frames written.
    pub const fn frames(&self) -> u64 {
        self.frames
    }

    /// Flushes the buffer and returns `out`.
    ///
    /// # Errors
    /// A write error.
    pub fn finish(mut self) -> io::Result<W> {
        self.out.flush()?;
        Ok(self.out)
    }
}
