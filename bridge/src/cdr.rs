//! ROS 2's encoding of messages: little-endian CDR (OMG DDS-RTPS, "plain CDR version 1"). Each
//! number is aligned to its own size, counted from the end of the four bytes that begin a message.

use proprio_topics::Nanos;

/// Those bytes: little-endian CDR, no options.
const HEAD: [u8; 4] = [0, 1, 0, 0];

/// A message that is being written.
#[derive(Debug, Clone)]
pub struct CdrMessage {
    bytes: Vec<u8>,
}

impl Default for CdrMessage {
    fn default() -> Self {
        Self::new()
    }
}

impl CdrMessage {
    /// An empty one.
    #[must_use]
    pub fn new() -> Self {
        let bytes = HEAD.to_vec();
        Self { bytes }
    }

    /// One that begins with a `std_msgs/Header`; `wall` is in \[ns since 1970, UTC\].
    #[must_use]
    pub fn stamped(wall: u64, frame: &str) -> Self {
        let mut message = Self::new();
        message.time(wall);
        message.text(frame);
        message
    }

    /// The bytes, with those four.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// A `builtin_interfaces/Time`; `wall` is in \[ns since 1970, UTC\].
    pub fn time(&mut self, wall: u64) {
        let (seconds, nanoseconds) = (wall / 1_000_000_000, wall % 1_000_000_000);
        self.i32(i32::try_from(seconds).unwrap_or(i32::MAX));
        self.u32(u32::try_from(nanoseconds).unwrap_or_default());
    }

    fn put<const N: usize>(&mut self, number: [u8; N]) {
        let position = self.bytes.len() - HEAD.len();
        self.bytes
            .resize(HEAD.len() + position.next_multiple_of(N), 0);
        self.bytes.extend(number);
    }

    /// A `bool`.
    pub fn bool(&mut self, value: bool) {
        self.put([u8::from(value)]);
    }

    /// A `uint8` or `byte`.
    pub fn u8(&mut self, value: u8) {
        self.put([value]);
    }

    /// An `int32`.
    pub fn i32(&mut self, value: i32) {
        self.put(value.to_le_bytes());
    }

    /// A `uint32`.
    pub fn u32(&mut self, value: u32) {
        self.put(value.to_le_bytes());
    }

    /// An `int64`.
    pub fn i64(&mut self, value: i64) {
        self.put(value.to_le_bytes());
    }

    /// `float64` values, one after the other.
    pub fn f64s(&mut self, values: &[f64]) {
        for value in values {
            self.put(value.to_le_bytes());
        }
    }

    /// The number of elements that follow.
    pub fn count(&mut self, count: usize) {
        self.u32(u32::try_from(count).unwrap_or(u32::MAX));
    }

    /// A `string`.
    pub fn text(&mut self, text: &str) {
        self.count(text.len() + 1);
        self.bytes.extend(text.bytes());
        self.bytes.push(0);
    }

    /// A sequence of which `each` writes an element.
    pub fn sequence<T>(&mut self, all: &[T], mut each: impl FnMut(&mut Self, &T)) {
        self.count(all.len());
        all.iter().for_each(|one| each(self, one));
    }

    /// A sequence of `float64`.
    pub fn numbers<T>(&mut self, all: &[T], number: impl Fn(&T) -> f64) {
        self.sequence(all, |message, one| message.f64s(&[number(one)]));
    }

    /// A sequence of `string`.
    pub fn texts<'t, T>(&mut self, all: &'t [T], text: impl Fn(&'t T) -> &'t str) {
        self.count(all.len());
        all.iter().for_each(|one| self.text(text(one)));
    }
}

/// A message that is being read.
#[derive(Debug)]
pub struct CdrReader<'a> {
    body: &'a [u8],
    position: usize,
}

impl<'a> CdrReader<'a> {
    /// `None` if it is no little-endian CDR.
    #[must_use]
    pub fn new(bytes: &'a [u8]) -> Option<Self> {
        let body = bytes.strip_prefix(&HEAD)?;
        Some(Self { body, position: 0 })
    }

    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let from = self.position.next_multiple_of(N);
        let number = self.body.get(from..from + N)?;
        self.position = from + N;
        number.try_into().ok()
    }

    /// A `bool`. `None` where the message ends before.
    pub fn bool(&mut self) -> Option<bool> {
        self.take::<1>().map(|[byte]| byte != 0)
    }

    /// A `uint8`. `None` where the message ends before.
    pub fn u8(&mut self) -> Option<u8> {
        self.take::<1>().map(|[byte]| byte)
    }

    /// A `builtin_interfaces/Time` \[ns since 1970, UTC\]. `None` where the message ends before.
    pub fn time(&mut self) -> Option<Nanos> {
        let (seconds, nanoseconds) = (i64::from(self.u32()?.cast_signed()), self.u32()?);
        Some(Nanos(seconds * 1_000_000_000 + i64::from(nanoseconds)))
    }

    /// A `string`. `None` where the message ends before, or it is no UTF-8.
    pub fn text(&mut self) -> Option<&'a str> {
        let count = usize::try_from(self.u32()?).ok()?;
        let bytes = self.bytes(count)?.split_last()?.1;
        std::str::from_utf8(bytes).ok()
    }

    /// A sequence, of elements that `element` reads. `None` where the message ends before.
    pub fn list<T>(&mut self, element: impl Fn(&mut Self) -> Option<T>) -> Option<Vec<T>> {
        (0..self.u32()?).map(|_| element(self)).collect()
    }

    /// So many bytes. `None` where the message ends before.
    pub fn bytes(&mut self, count: usize) -> Option<&'a [u8]> {
        let bytes = self.body.get(self.position..)?.get(..count)?;
        self.position += count;
        Some(bytes)
    }

    /// A `uint32`. `None` where the message ends before.
    pub fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    /// An `int64`. `None` where the message ends before.
    pub fn i64(&mut self) -> Option<i64> {
        self.take().map(i64::from_le_bytes)
    }

    /// A `float64`. `None` where the message ends before.
    pub fn f64(&mut self) -> Option<f64> {
        self.take().map(f64::from_le_bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The bytes of the example in the specification's spirit, counted by hand.
    #[test]
    fn numbers_are_aligned_to_their_size() {
        let mut message = CdrMessage::new();
        message.bool(true);
        message.u32(2);
        message.f64s(&[1.0]);
        message.text("ab");
        message.i32(-1);
        let expected = [
            0, 1, 0, 0, // head
            1, 0, 0, 0, 2, 0, 0, 0, // a bool, three bytes of nothing, a number
            0, 0, 0, 0, 0, 0, 0xf0, 0x3f, // 1.0
            3, 0, 0, 0, b'a', b'b', 0, 0, // a text with its zero, one byte of nothing
            0xff, 0xff, 0xff, 0xff,
        ];
        assert_eq!(message.bytes(), expected);
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(flag: bool, a: u32, b: i64, c: f64) {
            let mut message = CdrMessage::new();
            message.bool(flag);
            message.u32(a);
            message.bool(!flag);
            message.i64(b);
            message.f64s(&[c]);
            message.text("caf\u{e9}");
            message.u8(a as u8);
            let mut parsed = CdrReader::new(message.bytes()).unwrap();
            prop_assert_eq!(parsed.bool(), Some(flag));
            prop_assert_eq!(parsed.u32(), Some(a));
            prop_assert_eq!(parsed.bool(), Some(!flag));
            prop_assert_eq!(parsed.i64(), Some(b));
            prop_assert_eq!(parsed.f64().map(f64::to_bits), Some(c.to_bits()));
            prop_assert_eq!(parsed.text(), Some("caf\u{e9}"));
            prop_assert_eq!(parsed.u8(), Some(a as u8));
            prop_assert_eq!(parsed.bool(), None);
        }

        #[test]
        fn any_bytes_are_legal_input(bytes: Vec<u8>) {
            if let Some(mut parsed) = CdrReader::new(&bytes) {
                let _ = (parsed.bool(), parsed.text(), parsed.i64(), parsed.u32(), parsed.f64());
            }
        }
    }
}
