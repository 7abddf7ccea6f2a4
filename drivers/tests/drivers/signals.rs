//! The bits of a signal in a frame, as a .dbc file counts them, and the numbers that they are.

use proprio_drivers::signal::{Bits, Raw};

/// A signal of the lowest bits, one across two bytes, and one that fills a frame, in both orders.
#[test]
fn bits_are_where_the_file_says() {
    for (start, length, big_endian, raw, data) in [
        (0, 8, false, 0xA5, [0xA5, 0, 0, 0, 0, 0, 0, 0]),
        (4, 12, false, 0xABC, [0xC0, 0xAB, 0, 0, 0, 0, 0, 0]),
        (13, 1, false, 1, [0, 0x20, 0, 0, 0, 0, 0, 0]),
        (6, 20, false, 0xF_0001, [0x40, 0, 0xC0, 0x03, 0, 0, 0, 0]),
        (
            0,
            64,
            false,
            0x0102_0304_0506_0708,
            [8, 7, 6, 5, 4, 3, 2, 1],
        ),
        (7, 8, true, 0xA5, [0xA5, 0, 0, 0, 0, 0, 0, 0]),
        (3, 12, true, 0xABC, [0x0A, 0xBC, 0, 0, 0, 0, 0, 0]),
        (13, 10, true, 0x2A5, [0, 0x2A, 0x50, 0, 0, 0, 0, 0]),
        (7, 64, true, 0x0102_0304_0506_0708, [1, 2, 3, 4, 5, 6, 7, 8]),
    ] {
        let bits = Bits::new(start, length, big_endian).unwrap();
        assert_eq!(u64::from(bits.length()), length);
        assert_eq!(bits.of(&data), Some(raw), "{bits:?}");
        let mut written = [0; 8];
        bits.set(raw, &mut written);
        assert_eq!(written, data, "{bits:?}");
        // Bits of other signals are neither read nor changed, and a number that is too long has
        // no more bits.
        let ones = if length == 64 {
            u64::MAX
        } else {
            (1 << length) - 1
        };
        let others = {
            let mut mine = [0; 8];
            bits.set(u64::MAX, &mut mine);
            assert_eq!(bits.of(&mine), Some(ones), "{bits:?}");
            mine.map(|byte| !byte)
        };
        assert_eq!(bits.of(&others), Some(0), "{bits:?}");
        let mut both = others;
        bits.set(raw, &mut both);
        let sum: Vec<u8> = data.iter().zip(others).map(|(a, b)| a + b).collect();
        assert_eq!(both[..], sum, "{bits:?}");
        bits.set(0, &mut both);
        assert_eq!(both, others, "{bits:?}");
    }
}

/// The nearest number that the bits can be.
#[test]
fn numbers_are_limited_to_their_bits() {
    for (raw, length, number, bits) in [
        (Raw::Unsigned, 8, 0.0, 0),
        (Raw::Unsigned, 8, 2.4, 2),
        (Raw::Unsigned, 8, 2.6, 3),
        (Raw::Unsigned, 8, 255.0, 0xFF),
        (Raw::Unsigned, 8, 256.0, 0xFF),
        (Raw::Unsigned, 8, -1.0, 0),
        (Raw::Unsigned, 1, 7.0, 1),
        (Raw::Unsigned, 64, 1e30, u64::MAX),
        (Raw::Signed, 8, 127.0, 0x7F),
        (Raw::Signed, 8, 128.0, 0x7F),
        (Raw::Signed, 8, -1.0, 0xFF),
        (Raw::Signed, 8, -127.6, 0x80),
        (Raw::Signed, 8, -129.0, 0x80),
        (Raw::Signed, 12, -2048.0, 0x800),
        (Raw::Signed, 12, -5000.0, 0x800),
        (Raw::Signed, 12, 5000.0, 0x7FF),
        (Raw::Signed, 64, -1e30, 1 << 63),
        (Raw::Float32, 32, -0.5, 0xBF00_0000),
        (Raw::Float64, 64, -0.5, 0xBFE0_0000_0000_0000),
    ] {
        assert_eq!(raw.bits(number, length), bits, "{raw:?} {length} {number}");
    }
    for (raw, length, bits, number) in [
        (Raw::Unsigned, 12, 0xFFF, 4095.0),
        (Raw::Signed, 12, 0xFFF, -1.0),
        (Raw::Signed, 12, 0x7FF, 2047.0),
        (Raw::Signed, 1, 1, -1.0),
        (Raw::Float32, 32, 0xBF00_0000, -0.5),
        (Raw::Float64, 64, 0xBFE0_0000_0000_0000, -0.5),
    ] {
        assert_eq!(
            raw.number(bits, length),
            number,
            "{raw:?} {length} {bits:X}"
        );
    }
}
