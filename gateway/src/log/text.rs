//! Numbers, dates and words of the text formats.

use proprio_topics::Nanos;

/// A second \[ns\].
pub(super) const SECOND: u64 = 1_000_000_000;

/// The value of each hexadecimal digit; 0xFF for other characters.
const HEX: [u8; 256] = {
    let mut table = [0xFF; 256];
    let mut i = 0;
    while i < 10 {
        table[b'0' as usize + i] = i as u8;
        i += 1;
    }
    let mut i = 0;
    while i < 6 {
        table[b'A' as usize + i] = 10 + i as u8;
        table[b'a' as usize + i] = 10 + i as u8;
        i += 1;
    }
    table
};

/// The value of a hexadecimal digit.
pub(super) fn hex(digit: u8) -> Option<u8> {
    HEX.get(digit as usize).copied().filter(|v| *v < 16)
}

/// The value of two hexadecimal digits.
pub(super) fn hex_byte(high: u8, low: u8) -> Option<u8> {
    let (high, low) = (*HEX.get(high as usize)?, *HEX.get(low as usize)?);
    // Only the 0xFF of a wrong digit has bits in the high half.
    if (high | low) & 0xF0 == 0 {
        Some(high << 4 | low)
    } else {
        None
    }
}

/// The words of a line, between blanks and tabs.
pub(super) fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> + Clone {
    line.split(u8::is_ascii_whitespace)
        .filter(|word| !word.is_empty())
}

/// Takes the escape sequences of a terminal (`ESC [ .. letter`, as those of colours) out of a line.
pub(super) fn without_escapes(line: &mut Vec<u8>) {
    const ESCAPE: u8 = 0x1B;
    if !line.contains(&ESCAPE) {
        return;
    }
    let (mut before, mut inside) = (0, false);
    line.retain(|&c| {
        let begins = before == ESCAPE && c == b'[';
        let keep = !inside && !begins && c != ESCAPE;
        // Its last character is a letter or one of a few signs, 0x40 to 0x7E.
        inside = begins || inside && matches!(c, b' '..=b'?');
        before = c;
        keep
    });
}

/// A whole number without a sign, in base `radix` (2 to 16).
pub(super) fn number(text: &[u8], radix: u32) -> Option<u32> {
    let digit = |c: &u8| hex(*c).map(u32::from).filter(|digit| *digit < radix);
    let add = |n: u32, c| n.checked_mul(radix)?.checked_add(digit(c)?);
    (!text.is_empty()).then(|| text.iter().try_fold(0, add))?
}

/// A decimal number, such as `-1.5` or `1.5e-05`, in units of `unit` \[ns\], rounded to the nearest
/// nanosecond. The arithmetic is exact.
pub(super) fn decimal(text: &[u8], unit: u64) -> Option<Nanos> {
    // So many digits times a day in nanoseconds fit in 128 bits.
    const MOST: u32 = 22;
    let (negative, mut rest) = match text {
        [b'-', rest @ ..] => (true, rest),
        _ => (false, text),
    };
    let (mut mantissa, mut digits, mut decimals) = (0_i128, 0_u32, 0_i32);
    let (mut any, mut fraction) = (false, false);
    loop {
        rest = match rest {
            [c @ b'0'..=b'9', after @ ..] => {
                any = true;
                if digits < MOST {
                    mantissa = mantissa * 10 + i128::from(c - b'0');
                    digits += u32::from(mantissa > 0);
                    decimals += i32::from(fraction);
                } else if !fraction {
                    return None;
                }
                after
            }
            [b'.', after @ ..] if !fraction => {
                fraction = true;
                after
            }
            _ => break,
        };
    }
    if !any {
        return None;
    }
    match rest {
        [] => {}
        [b'e' | b'E', sign @ (b'+' | b'-'), digits @ ..] => {
            let exponent = i32::try_from(number(digits, 10)?.min(1_000)).ok()?;
            decimals += if *sign == b'-' { exponent } else { -exponent };
        }
        _ => return None,
    }
    let value = mantissa * i128::from(unit);
    let power = |n: i32| 10_i128.checked_pow(n.unsigned_abs());
    let value = match (decimals, power(decimals)) {
        (_, _) if mantissa == 0 => 0,
        // Less than a nanosecond by far.
        (1.., None) => 0,
        (1.., Some(power)) => (value + power / 2) / power,
        (_, power) => value.checked_mul(power?)?,
    };
    Some(Nanos(
        i64::try_from(if negative { -value } else { value }).ok()?,
    ))
}

/// Seconds from 1970 to a date `[year, month, day]` and time `[hour, minute, second]` (UTC); `None`
/// if there is no such instant.
pub(super) fn civil([year, month, day]: [i64; 3], time: [i64; 3]) -> Option<i64> {
    let [hour, minute, second] = time;
    if !(1..=12).contains(&month)
        || !(1..=31).contains(&day)
        || !(0..=23).contains(&hour)
        || !(0..=59).contains(&minute)
        || !(0..=60).contains(&second)
    {
        return None;
    }
    // Days since 1970-01-01. Years begin in March, so that the leap day is the last day: H.
    // Hinnant, "chrono-compatible low-level date algorithms", days_from_civil.
    let year = if month <= 2 { year - 1 } else { year };
    let era = year.div_euclid(400);
    let year_of_era = year.rem_euclid(400);
    let day_of_year = (153 * (if month > 2 { month - 3 } else { month + 9 }) + 2) / 5 + day - 1;
    let days = era * 146_097 + year_of_era * 365 + year_of_era / 4 - year_of_era / 100
        + day_of_year
        - 719_468;
    Some(days * 86_400 + hour * 3_600 + minute * 60 + second)
}
