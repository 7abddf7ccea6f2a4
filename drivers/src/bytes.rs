//! The payload of a frame: numbers in either order of bytes, and their quantisation.

/// Little-endian 16 bits at `at`; 0 beyond the end (callers have checked the length).
pub(crate) fn u16_le(data: &[u8], at: usize) -> u16 {
    match data.get(at..at + 2) {
        Some(&[low, high]) => u16::from_le_bytes([low, high]),
        _ => 0,
    }
}

/// As [`u16_le`], in two's complement.
pub(crate) fn i16_le(data: &[u8], at: usize) -> i16 {
    u16_le(data, at).cast_signed()
}

/// Little-endian 32 bits at `at`; 0 beyond the end.
pub(crate) fn u32_le(data: &[u8], at: usize) -> u32 {
    u32::from(u16_le(data, at)) | u32::from(u16_le(data, at + 2)) << 16
}

/// Big-endian 16 bits at `at`; 0 beyond the end.
pub(crate) fn u16_be(data: &[u8], at: usize) -> u16 {
    u16_le(data, at).swap_bytes()
}

/// As [`u16_be`], in two's complement.
pub(crate) fn i16_be(data: &[u8], at: usize) -> i16 {
    u16_be(data, at).cast_signed()
}

/// Big-endian 32 bits at `at`; 0 beyond the end.
pub(crate) fn u32_be(data: &[u8], at: usize) -> u32 {
    u32_le(data, at).swap_bytes()
}

/// `value` in units of `lsb`, rounded to the nearest integer and limited to `least..=most`. `value`
/// must be finite.
#[allow(clippy::cast_possible_truncation)]
pub(crate) fn quantise(value: f64, lsb: f64, least: i64, most: i64) -> i64 {
    let scaled = value / lsb;
    // The cast truncates towards zero and saturates: adding half a unit away from zero rounds.
    let nearest = (scaled + if scaled < 0.0 { -0.5 } else { 0.5 }) as i64;
    nearest.clamp(least, most)
}

/// As [`quantise`], to 16 bits in two's complement.
#[allow(clippy::cast_possible_truncation)]
pub(crate) fn quantise_i16(value: f64, lsb: f64) -> i16 {
    quantise(value, lsb, i64::from(i16::MIN), i64::from(i16::MAX)) as i16
}
