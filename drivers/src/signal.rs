//! Messages and signals as a .dbc file describes them: where the bits of a number lie in a frame,
//! and what they mean. The gateway reads the file; drivers get these tables.

use crate::Id;
use alloc::string::String;
use alloc::vec::Vec;

/// A message: the frames with one identifier.
#[derive(Debug, Clone, PartialEq)]
pub struct Message {
    /// Its name.
    pub name: String,
    /// Its whole name, where the file keeps one that is longer than names in it may be.
    pub long_name: Option<String>,
    /// Its identifier, or why its frames can not be read: told only to somebody who uses them.
    pub id: Result<Id, String>,
    /// The identifier is one of SAE J1939: the parameter group in it tells what a frame holds.
    pub j1939: bool,
    /// The length of its frames \[bytes\].
    pub size: usize,
    /// Its signals.
    pub signals: Vec<Signal>,
}

/// A number in a message: value = factor x raw + offset, in `unit`.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    /// Its name.
    pub name: String,
    /// Its whole name, as [`Message::long_name`].
    pub long_name: Option<String>,
    /// Where its bits are, or why it can not be read.
    pub bits: Result<Bits, String>,
    /// What its bits are.
    pub raw: Raw,
    /// The value of one.
    pub factor: f64,
    /// The value of zero.
    pub offset: f64,
    /// The unit of the value, in the file's words.
    pub unit: String,
    /// The frames that have it: all if `None`.
    pub switch: Option<Switch>,
}

/// For a multiplexed signal: only frames in which the signal `signal` of the same message has a raw
/// value within `ranges` have it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Switch {
    /// The multiplexor.
    pub signal: String,
    /// Its raw values, first and last.
    pub ranges: Vec<(u64, u64)>,
}

/// What the bits of a signal are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Raw {
    /// An integer.
    Unsigned,
    /// An integer in two's complement.
    Signed,
    /// IEEE 754 of 32 bits.
    Float32,
    /// IEEE 754 of 64 bits.
    Float64,
}

impl Raw {
    /// The number that `bits` are, of which `length` count.
    #[must_use]
    pub fn number(self, bits: u64, length: u8) -> f64 {
        match self {
            Self::Unsigned => bits as f64,
            Self::Signed => {
                let shift = 64 - u32::from(length.clamp(1, 64));
                (bits.cast_signed() << shift >> shift) as f64
            }
            #[allow(clippy::cast_possible_truncation)] // 32 bits count
            Self::Float32 => f64::from(f32::from_bits(bits as u32)),
            Self::Float64 => f64::from_bits(bits),
        }
    }

    /// The `length` bits nearest to `number`, limited to their range. Not a number is 0 for an
    /// integer.
    #[must_use]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // casts saturate
    pub fn bits(self, number: f64, length: u8) -> u64 {
        let length = u32::from(length.clamp(1, 64));
        let nearest = number + if number < 0.0 { -0.5 } else { 0.5 };
        match self {
            Self::Unsigned => (nearest as u64).min(u64::MAX >> (64 - length)),
            Self::Signed => {
                let most = i64::MAX >> (64 - length);
                let raw = (nearest as i64).clamp(-most - 1, most);
                raw.cast_unsigned() & u64::MAX >> (64 - length)
            }
            Self::Float32 => u64::from((number as f32).to_bits()),
            Self::Float64 => number.to_bits(),
        }
    }
}

/// Where the bits of a signal are in a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bits {
    /// The first byte that has one.
    first: u8,
    /// The last.
    last: u8,
    /// The number of bits of the last byte (Intel: of the first) below the signal.
    shift: u8,
    /// How many they are.
    length: u8,
    /// The most significant byte comes first.
    big_endian: bool,
}

impl Bits {
    /// `length` bits from bit `start` on, as .dbc files count: bit 0 is the lowest of byte 0, bit 8
    /// that of byte 1. In Intel's order `start` is the signal's lowest bit, in Motorola's
    /// (`big_endian`) its highest. `None` if they are none, more than 64, or beyond 64 bytes.
    #[must_use]
    #[allow(clippy::cast_possible_truncation)] // below 64
    pub fn new(start: u64, length: u64, big_endian: bool) -> Option<Self> {
        if !(1..=64).contains(&length) || start >= 512 {
            return None;
        }
        let (first, bit) = (start / 8, start % 8);
        // The number of bits from the first byte's edge to the signal's end.
        let reach = if big_endian { 7 - bit } else { bit } + length;
        let last = first + (reach - 1) / 8;
        let shift = match big_endian {
            true => (last - first + 1) * 8 - reach,
            false => bit,
        };
        (last < 64).then_some(Self {
            first: first as u8,
            last: last as u8,
            shift: shift as u8,
            length: length as u8,
            big_endian,
        })
    }

    /// How many they are: 1 to 64.
    #[must_use]
    pub const fn length(self) -> u8 {
        self.length
    }

    /// The length of a frame that has them \[bytes\].
    #[must_use]
    pub const fn reach(self) -> usize {
        self.last as usize + 1
    }

    /// The bits of a frame with this payload; `None` if it is too short.
    #[must_use]
    #[allow(clippy::cast_possible_truncation)] // the mask leaves 64 bits
    pub fn of(self, data: &[u8]) -> Option<u64> {
        let bytes = data.get(usize::from(self.first)..self.reach())?;
        let join = |all: u128, byte: &u8| all << 8 | u128::from(*byte);
        let all = match self.big_endian {
            true => bytes.iter().fold(0, join),
            false => bytes.iter().rev().fold(0, join),
        };
        Some((all >> self.shift) as u64 & self.mask())
    }

    /// Writes `bits` into the payload of a frame; nothing if it is too short.
    #[allow(clippy::cast_possible_truncation)] // one byte each
    pub fn set(self, bits: u64, data: &mut [u8]) {
        let Some(bytes) = data.get_mut(usize::from(self.first)..self.reach()) else {
            return;
        };
        let value = u128::from(bits & self.mask()) << self.shift;
        let mask = u128::from(self.mask()) << self.shift;
        let put = |(number, byte): (u32, &mut u8)| {
            let (value, mask) = ((value >> (8 * number)) as u8, (mask >> (8 * number)) as u8);
            *byte = *byte & !mask | value;
        };
        match self.big_endian {
            true => (0..).zip(bytes.iter_mut().rev()).for_each(put),
            false => (0..).zip(bytes).for_each(put),
        }
    }

    fn mask(self) -> u64 {
        u64::MAX >> (64 - u32::from(self.length))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The bit numbers of a signal, lowest first, by the definition in words.
    fn numbers(start: u64, length: u64, big_endian: bool) -> Vec<u64> {
        if !big_endian {
            return (start..start + length).collect();
        }
        let mut from_highest = std::vec![start];
        while (from_highest.len() as u64) < length {
            let bit = from_highest[from_highest.len() - 1];
            // Below a byte's lowest bit comes the next byte's highest.
            from_highest.push(if bit % 8 == 0 { bit + 15 } else { bit - 1 });
        }
        from_highest.reverse();
        from_highest
    }

    proptest! {
        #[test]
        fn bits_are_where_the_definition_says(
            start in 0_u64..512, length in 1_u64..=64, big_endian: bool,
            data: [u8; 32], more: [u8; 32], value: u64,
        ) {
            let mut frame = [data, more].concat();
            let numbers = numbers(start, length, big_endian);
            let fits = numbers.iter().all(|number| *number < 512);
            let bits = Bits::new(start, length, big_endian);
            prop_assert_eq!(bits.is_some(), fits);
            if let Some(bits) = bits {
                let bit = |frame: &[u8], number: u64| {
                    u64::from(frame[(number / 8) as usize] >> (number % 8) & 1)
                };
                let read = |frame: &[u8]| {
                    numbers.iter().rev().fold(0, |all, number| all << 1 | bit(frame, *number))
                };
                prop_assert_eq!(bits.of(&frame), Some(read(&frame)));
                prop_assert_eq!(bits.of(&frame[..bits.reach() - 1]), None);
                let before = frame.clone();
                bits.set(value, &mut frame);
                prop_assert_eq!(bits.of(&frame), Some(value & (u64::MAX >> (64 - length))));
                for number in (0..512).filter(|number| !numbers.contains(number)) {
                    prop_assert_eq!(bit(&frame, number), bit(&before, number));
                }
            }
        }

        #[test]
        fn numbers_come_back(value in -1e6_f64..1e6, length in 22_u8..=64) {
            let back = |raw: Raw, length| raw.number(raw.bits(value, length), length);
            prop_assert!((back(Raw::Signed, length) - value).abs() <= 0.5);
            prop_assert!((back(Raw::Unsigned, length) - value.max(0.0)).abs() <= 0.5);
            prop_assert_eq!(back(Raw::Float64, 64), value);
            prop_assert!((back(Raw::Float32, 32) - value).abs() <= value.abs() * 1e-7);
        }
    }

    #[test]
    fn integers_are_limited_to_their_range() {
        for (raw, value, bits) in [
            (Raw::Unsigned, 300.0, 0xFF),
            (Raw::Unsigned, -3.0, 0),
            (Raw::Signed, 300.0, 0x7F),
            (Raw::Signed, -300.0, 0x80),
            (Raw::Signed, -1.0, 0xFF),
            (Raw::Signed, f64::NAN, 0),
        ] {
            assert_eq!(raw.bits(value, 8), bits, "{raw:?} {value}");
        }
        assert_eq!(Raw::Signed.number(0x80, 8), -128.0);
        assert!(Bits::new(0, 0, false).is_none() && Bits::new(0, 65, true).is_none());
    }
}
