//! Vector BLF: the binary format of CANoe and CANalyzer.
//!
//! ```text
//! file header   "LOGG", u32 its size, .., u64 file size (at 16), .., SYSTEMTIME start (at 40), ..
//! objects       "LOBJ", u16 header size, u16 header version, u32 size, u32 type, rest
//!
//! type 10       a container: u16 packing (0 none, 2 zlib), 14 bytes, then bytes of more objects
//! header        u32 flags (1: time in units of 10 us, else of 1 ns), u32, i64 time
//! type 1, 86    u16 channel, u8 flags (1 sent, 0x80 remote), u8 length, u32 id, 8 bytes
//! type 100      u16 channel, u8 flags, u8 length code, u32 id, u32, u8, u8 FD flags (1 FD, 2 BRS,
//!               4 ESI), u8 bytes, 5 bytes, data
//! type 101      u8 channel, u8 length code, u8 bytes, u8, u32 id, u32, u32 flags (0x10 remote,
//!               0x1000 FD, 0x2000 BRS, 0x4000 ESI), 16 bytes, u16, u8 direction (1 sent), u8
//!               offset of more, u32, data
//! type 2, 73    u16 channel of an error frame;  type 104 the same, u8
//! ```
//!
//! All numbers are little-endian; bit 31 of an identifier marks an extended one. Between objects
//! there are up to three bytes of padding. An object may begin in one container and end in the
//! next: the contents of all containers are one sequence of bytes, which is read here in pieces of
//! constant size, whatever the sizes in the file say. An object outside any container belongs to
//! the same sequence. Other types are skipped.
//!
//! Damage: after a container that cannot be unpacked, and after bytes that are no object, the next
//! "LOBJ" is searched. A container's checksum is at its end: what comes before is already read.
//!
//! Sources: python-can `io/blf.py`; Technica Engineering `vector_blf`; Wireshark `blf.h`.

use super::record::{
    FrameDirection, Interface, LineError, OwnedRecord, ParsedLine, bus_error, identifier,
    stamp_since,
};
use super::text::civil;
use flate2::{Decompress, FlushDecompress, Status};
use proprio_drivers::{Format, Frame, Id};
use proprio_topics::Nanos;
use std::io::{self, BufRead};

/// The beginning of a file.
pub(super) const SIGNATURE: &[u8] = b"LOGG";
/// The beginning of an object.
const OBJECT: [u8; 4] = *b"LOBJ";
/// The file header up to the last field that is used.
const FILE_HEADER: usize = 72;
/// The part of an object's header that all objects have.
const BASE: usize = 16;
/// An object's header of version 1, and of version 2 up to its time.
const HEADER: usize = 32;
/// The longest header that is read; version 2 has 40 bytes.
const LONGEST_HEADER: usize = 64;
/// The header of a container.
const CONTAINER: usize = 32;
/// The type of a container.
const CONTAINER_TYPE: u32 = 10;
/// The longest part of an object that is used: its header and the longest of the frames.
const LONGEST: usize = LONGEST_HEADER + 40 + Frame::MAX_LEN;
/// The most bytes of an object with a frame; a longer one is damaged. The longest that is known, a
/// CAN FD frame with everything that may follow it, has less than half.
const MOST: usize = 512;
/// The bit of an extended identifier.
const EXTENDED: u32 = 0x8000_0000;
/// The most bytes of padding; python-can, too, searches so far.
const PADDING: u64 = 8;
/// Size of the buffer of unpacked bytes.
const BUFFER: usize = 1 << 16;

/// The contents of all containers as one sequence of bytes.
struct Contents {
    part: BytePosition,
    inflate: Decompress,
    /// Bytes read of the file.
    read: u64,
    /// Whether the file ended in the middle of a part.
    cut: bool,
    /// Whether damage was reported after which the next part is not found yet.
    lost: bool,
    /// The header of an object outside any container, which belongs to the sequence.
    outside: Option<[u8; BASE]>,
    /// Unpacked bytes, of which those from `start` to `end` are not used yet.
    buffer: Vec<u8>,
    start: usize,
    end: usize,
}

/// Where in the file the next byte is.
#[derive(Debug, Clone, Copy)]
enum BytePosition {
    /// Before an object.
    Between,
    /// In a container that is not packed, or in an object outside any.
    Plain { left: u64 },
    /// In a packed container.
    Packed { left: u64 },
    /// At the end of the file.
    End,
}

/// Why the sequence is interrupted.
enum Break {
    Io(io::Error),
    Damage(LineError),
}

impl From<io::Error> for Break {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl Contents {
    fn available(&self) -> &[u8] {
        self.buffer.get(self.start..self.end).unwrap_or_default()
    }

    /// Reads until `count` bytes (at most [`LONGEST`]) are available; false if the file ends
    /// before.
    fn fill(&mut self, inner: &mut impl BufRead, count: usize) -> Result<bool, Break> {
        while self.end - self.start < count {
            // So that more than the header of an object fits behind.
            if self.buffer.len() - self.end < LONGEST {
                self.buffer.copy_within(self.start..self.end, 0);
                (self.start, self.end) = (0, self.end - self.start);
            }
            if self.more(inner)? == 0 {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Skips `count` bytes; false if the file ends before.
    fn skip(&mut self, inner: &mut impl BufRead, mut count: usize) -> Result<bool, Break> {
        loop {
            let here = count.min(self.end - self.start);
            self.start += here;
            count -= here;
            if count == 0 {
                return Ok(true);
            }
            (self.start, self.end) = (0, 0);
            if self.more(inner)? == 0 {
                return Ok(false);
            }
        }
    }

    /// Appends bytes to the buffer; returns their number, which is zero at the end of the file.
    fn more(&mut self, inner: &mut impl BufRead) -> Result<usize, Break> {
        if let Some(header) = self.outside.take() {
            self.append(&header);
            return Ok(header.len());
        }
        loop {
            match self.part {
                BytePosition::End => return Ok(0),
                BytePosition::Between => {
                    self.next_part(inner)?;
                    if self.outside.is_some() {
                        return self.more(inner);
                    }
                }
                BytePosition::Plain { left: 0 } => self.part = BytePosition::Between,
                BytePosition::Plain { left } => {
                    let input = inner.fill_buf()?;
                    if input.is_empty() {
                        (self.part, self.cut) = (BytePosition::End, true);
                        continue;
                    }
                    let room = self.buffer.get_mut(self.end..).unwrap_or_default();
                    let most = usize::try_from(left).unwrap_or(usize::MAX);
                    let count = input.len().min(room.len()).min(most);
                    for (to, from) in room.iter_mut().zip(input.iter().take(count)) {
                        *to = *from;
                    }
                    inner.consume(count);
                    self.read += count as u64;
                    self.end += count;
                    self.part = BytePosition::Plain {
                        left: left - count as u64,
                    };
                    return Ok(count);
                }
                BytePosition::Packed { left } => {
                    let count = self.unpack(inner, left)?;
                    if count > 0 {
                        return Ok(count);
                    }
                }
            }
        }
    }

    /// Unpacks some bytes of a container, of which `left` packed ones are left; none does not mean
    /// that it ended.
    fn unpack(&mut self, inner: &mut impl BufRead, left: u64) -> Result<usize, Break> {
        let input = if left > 0 { inner.fill_buf()? } else { &[] };
        let at_end = left > 0 && input.is_empty();
        let most = usize::try_from(left).unwrap_or(usize::MAX);
        let input = input.get(..input.len().min(most)).unwrap_or_default();
        let room = self.buffer.get_mut(self.end..).unwrap_or_default();
        let before = (self.inflate.total_in(), self.inflate.total_out());
        let status = self.inflate.decompress(input, room, FlushDecompress::None);
        let used = self.inflate.total_in() - before.0;
        let made = usize::try_from(self.inflate.total_out() - before.1).unwrap_or_default();
        inner.consume(usize::try_from(used).unwrap_or_default());
        self.read += used;
        self.end += made;
        self.part = match status {
            Ok(Status::StreamEnd) => BytePosition::Between,
            Ok(_) if used > 0 || made > 0 => BytePosition::Packed { left: left - used },
            Ok(_) if at_end => {
                self.cut = true;
                BytePosition::End
            }
            _ => {
                (self.part, self.lost) = (BytePosition::Between, true);
                return Err(Break::Damage(LineError::Container));
            }
        };
        Ok(made)
    }

    /// Finds the next object or container of the file.
    fn next_part(&mut self, inner: &mut impl BufRead) -> Result<(), Break> {
        let mut header = [0; CONTAINER];
        let mut before = 0_u64;
        while !header.starts_with(&OBJECT) {
            let Some(byte) = self.byte(inner)? else {
                self.part = BytePosition::End;
                // What is left is padding, or the beginning of an object.
                self.cut |= header.contains(&OBJECT[0]);
                return Ok(());
            };
            let [first, second, third, last, ..] = &mut header;
            (*first, *second, *third, *last) = (*second, *third, *last, byte);
            before += 1;
        }
        before -= OBJECT.len() as u64;
        let mut have = OBJECT.len();
        let is_container = |header: &[u8]| u32_at(header, 12) == Some(CONTAINER_TYPE);
        while have < BASE || have < CONTAINER && is_container(&header) {
            let Some(byte) = self.byte(inner)? else {
                (self.part, self.cut) = (BytePosition::End, true);
                return Ok(());
            };
            if let Some(place) = header.get_mut(have) {
                *place = byte;
            }
            have += 1;
        }
        let size = u64::from(u32_at(&header, 8).unwrap_or_default());
        let left = size.checked_sub(have as u64);
        let was_lost = std::mem::replace(&mut self.lost, left.is_none());
        let left = left.ok_or(Break::Damage(LineError::Object))?;
        self.part = match u16_at(&header, 16) {
            _ if have < CONTAINER => {
                self.outside = header.get(..BASE).and_then(|header| header.try_into().ok());
                BytePosition::Plain { left }
            }
            Some(0) => BytePosition::Plain { left },
            Some(2) => {
                self.inflate.reset(true);
                BytePosition::Packed { left }
            }
            packing => {
                self.lost = true;
                let packing = packing.unwrap_or_default();
                return Err(Break::Damage(LineError::Packing(packing)));
            }
        };
        if before > PADDING && !was_lost {
            return Err(Break::Damage(LineError::Gap(before)));
        }
        Ok(())
    }

    fn append(&mut self, bytes: &[u8]) {
        let room = self.buffer.get_mut(self.end..).unwrap_or_default();
        for (to, from) in room.iter_mut().zip(bytes) {
            *to = *from;
        }
        self.end += bytes.len().min(room.len());
    }

    fn byte(&mut self, inner: &mut impl BufRead) -> io::Result<Option<u8>> {
        let byte = inner.fill_buf()?.first().copied();
        inner.consume(usize::from(byte.is_some()));
        self.read += u64::from(byte.is_some());
        Ok(byte)
    }
}

/// The objects of a file.
pub(super) struct Blf {
    contents: Contents,
    /// When the recording began \[ns since 1970\].
    start: Option<Nanos>,
    /// The size of the file, as its header states it.
    size: u64,
    opened: bool,
    ended: bool,
    /// Whether damage was reported after which the next object is not found yet.
    lost: bool,
}

impl std::fmt::Debug for Blf {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Blf").finish_non_exhaustive()
    }
}

impl Blf {
    pub(super) fn new() -> Self {
        Self {
            contents: Contents {
                part: BytePosition::Between,
                inflate: Decompress::new(true),
                read: 0,
                cut: false,
                lost: false,
                outside: None,
                buffer: vec![0; BUFFER],
                start: 0,
                end: 0,
            },
            start: None,
            size: 0,
            opened: false,
            ended: false,
            lost: false,
        }
    }

    /// Reads and parses the next object; `None` at the end.
    pub(super) fn next(
        &mut self,
        inner: &mut impl BufRead,
    ) -> io::Result<Option<Result<ParsedLine, LineError>>> {
        match self.object(inner) {
            Ok(found) => Ok(found),
            Err(Break::Io(error)) => Err(error),
            Err(Break::Damage(error)) => {
                // The rest of the object of which this is the beginning is lost.
                self.contents.start = self.contents.end;
                self.lost = true;
                Ok(Some(Err(error)))
            }
        }
    }

    fn object(
        &mut self,
        inner: &mut impl BufRead,
    ) -> Result<Option<Result<ParsedLine, LineError>>, Break> {
        if !self.opened {
            self.opened = true;
            self.open(inner)?;
        }
        let mut before = 0_u64;
        while !self.contents.available().starts_with(&OBJECT) {
            if !self.contents.fill(inner, OBJECT.len())? {
                let begun = self.contents.available().contains(&OBJECT[0]);
                return Ok(self.end(begun));
            }
            if !self.contents.available().starts_with(&OBJECT) {
                self.contents.start += 1;
                before += 1;
            }
        }
        if before > PADDING && !self.lost {
            self.lost = true;
            return Ok(Some(Err(LineError::Gap(before))));
        }
        self.lost = false;
        if !self.contents.fill(inner, BASE)? {
            return Ok(self.end(true));
        }
        let bytes = self.contents.available();
        let at = |at| u32_at(bytes, at).and_then(|n| usize::try_from(n).ok());
        let (size, kind) = (at(8).unwrap_or_default(), u32_at(bytes, 12));
        let header = usize::from(u16_at(bytes, 4).unwrap_or_default());
        let version = u16_at(bytes, 6).unwrap_or_default();
        let is_frame = matches!(kind, Some(1 | 2 | 73 | 86 | 100 | 101 | 104));
        if header < BASE || size < header || is_frame && size > MOST {
            self.contents.start += OBJECT.len();
            self.lost = true;
            return Ok(Some(Err(LineError::Object)));
        }
        let used = size.min(LONGEST);
        let parsed = if is_frame && matches!(version, 1 | 2) {
            if !self.contents.fill(inner, used)? {
                return Ok(self.end(true));
            }
            let object = self.contents.available().get(..used).unwrap_or_default();
            let parsed = parse(kind.unwrap_or_default(), header, object, self.start);
            parsed.map(ParsedLine::Record)
        } else {
            Ok(ParsedLine::Note)
        };
        if !self.contents.skip(inner, size)? {
            return Ok(self.end(true));
        }
        Ok(Some(parsed))
    }

    /// Reads the header of the file.
    fn open(&mut self, inner: &mut impl BufRead) -> io::Result<()> {
        let mut header = [0; FILE_HEADER];
        for place in &mut header {
            let Some(byte) = self.contents.byte(inner)? else {
                (self.contents.part, self.contents.cut) = (BytePosition::End, true);
                return Ok(());
            };
            *place = byte;
        }
        self.size = u64_at(&header, 16).unwrap_or_default();
        self.start = system_time(&header, 40);
        // The rest of the header is of no use; what is no object is skipped anyway.
        let size = u32_at(&header, 4).unwrap_or_default().min(1 << 12);
        for _ in FILE_HEADER as u64..u64::from(size) {
            self.contents.byte(inner)?;
        }
        Ok(())
    }

    /// The end of the file, in the middle of an object or not.
    fn end(&mut self, in_object: bool) -> Option<Result<ParsedLine, LineError>> {
        self.contents.start = self.contents.end;
        let early = in_object || self.contents.cut || self.contents.read < self.size;
        let first = !std::mem::replace(&mut self.ended, true);
        (first && early).then_some(Err(LineError::CutOff))
    }
}

/// Parses an object with a frame: its type, the size of its header, and its bytes.
fn parse(
    kind: u32,
    header: usize,
    object: &[u8],
    start: Option<Nanos>,
) -> Result<OwnedRecord, LineError> {
    let short = LineError::Object;
    if !(HEADER..=LONGEST_HEADER).contains(&header) {
        return Err(short);
    }
    let (channel, direction, frame) = parse_body(kind, header, object)?;
    let unit = match u32_at(object, 16).ok_or(short)? {
        1 => 10_000,
        _ => 1,
    };
    // Some files have times before the start, as negative numbers.
    let t = u64_at(object, 24).ok_or(short)?.cast_signed();
    let t = Nanos(t.saturating_mul(unit));
    Ok(OwnedRecord {
        stamp: Some(stamp_since(start, t)),
        interface: Interface::channel(channel),
        direction,
        frame,
        whole: true,
    })
}

/// Channel, direction and frame of an object.
fn parse_body(
    kind: u32,
    header: usize,
    object: &[u8],
) -> Result<(u16, Option<FrameDirection>, Frame), LineError> {
    let short = LineError::Object;
    let size = u32_at(object, 8).and_then(|size| usize::try_from(size).ok());
    let size = size.ok_or(short)?;
    let body = object.get(header..).ok_or(short)?;
    let byte = |at: usize| body.get(at).copied().ok_or(short);
    let word = |at: usize| u32_at(body, at).ok_or(short);
    let id = || {
        let id = word(4)?;
        identifier(id & !EXTENDED, id & EXTENDED != 0)
    };
    let way = |sent: bool| Some(FrameDirection::of(sent));
    let wide_channel = || u16_at(body, 0).ok_or(short);
    Ok(match kind {
        1 | 86 => {
            let (flags, length) = (byte(2)?, byte(3)?.min(8));
            let data = body.get(8..16).ok_or(short)?;
            let frame = if flags & 0x80 != 0 {
                Frame::remote(id()?, length)
            } else {
                Frame::new(id()?, data.get(..usize::from(length)).ok_or(short)?)
            };
            (wide_channel()?, way(flags & 1 != 0), frame)
        }
        100 => {
            let (flags, code, fd) = (byte(2)?, byte(3)?, byte(13)?);
            let length = usize::from(byte(14)?);
            let data = body
                .get(20..)
                .and_then(|data| data.get(..length))
                .ok_or(short)?;
            let fd = [fd & 1 != 0, fd & 2 != 0, fd & 4 != 0];
            let frame = any_frame(id()?, flags & 0x80 != 0, fd, code, data)?;
            (wide_channel()?, way(flags & 1 != 0), frame)
        }
        101 => {
            let (code, length, flags) = (byte(1)?, usize::from(byte(2)?), word(12)?);
            // Some programs state more bytes than the object has; Vector's read zeros there.
            let end = match usize::from(byte(35)?) {
                0 => size,
                more => more,
            };
            let mut data = [0; Frame::MAX_LEN];
            let there = end.saturating_sub(header + 40).min(length);
            let found = body.get(40..).unwrap_or_default().iter().take(there);
            for (to, from) in data.iter_mut().zip(found) {
                *to = *from;
            }
            let data = data.get(..length).ok_or(short)?;
            let fd = [0x1000, 0x2000, 0x4000].map(|bit| flags & bit != 0);
            let frame = any_frame(id()?, flags & 0x10 != 0, fd, code, data)?;
            (u16::from(byte(0)?), way(byte(34)? != 0), frame)
        }
        104 => (u16::from(byte(0)?), None, bus_error()),
        _ => (wide_channel()?, None, bus_error()),
    })
}

/// A frame of a channel that can be CAN FD: whether it is, its two bits, and its length code.
fn any_frame(
    id: Id,
    remote: bool,
    [fd, bit_rate_switch, error_state]: [bool; 3],
    code: u8,
    data: &[u8],
) -> Result<Frame, LineError> {
    if fd {
        Frame::with_format(id, Format::fd(bit_rate_switch, error_state), data)
            .ok_or(LineError::TooLong { most: 64 })
    } else if remote {
        Ok(Frame::remote(id, code.min(8)))
    } else {
        Frame::with_format(id, Format::Classic, data).ok_or(LineError::TooLong { most: 8 })
    }
}

/// A SYSTEMTIME of Windows: year, month, weekday, day, hour, minute, second, millisecond. Programs
/// that do not know the time leave it zero.
fn system_time(bytes: &[u8], at: usize) -> Option<Nanos> {
    let field = |number: usize| u16_at(bytes, at + 2 * number).map(i64::from);
    let date = [field(0)?, field(1)?, field(3)?];
    let seconds = civil(date, [field(4)?, field(5)?, field(6)?])?;
    let ms = seconds.checked_mul(1_000)?.checked_add(field(7)?)?;
    Some(Nanos(ms.checked_mul(1_000_000)?))
}

fn array<const N: usize>(bytes: &[u8], at: usize) -> Option<[u8; N]> {
    bytes.get(at..)?.first_chunk().copied()
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    array(bytes, at).map(u16::from_le_bytes)
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    array(bytes, at).map(u32::from_le_bytes)
}

fn u64_at(bytes: &[u8], at: usize) -> Option<u64> {
    array(bytes, at).map(u64::from_le_bytes)
}
