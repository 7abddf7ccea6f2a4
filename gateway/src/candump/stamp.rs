//! Parses the time stamp of a line: seconds or a date.

use proprio_topics::Nanos;
use std::ops::Range;

/// The origin of a stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StampForm {
    /// Ten digits of seconds, or a date.
    Absolute,
    /// Fewer digits, in the log format: since the log's origin.
    Origin,
    /// Fewer digits, in the screen format: since the first line or since the previous line.
    Relative,
}

pub(super) struct Stamp {
    pub(super) t: Nanos,
    pub(super) absolute: bool,
}

/// Parses a stamp after its opening bracket; also returns the rest after the closing one.
pub(super) fn parse_stamp(text: &[u8]) -> Option<(Stamp, &[u8])> {
    let (negative, digits) = match text {
        [b'-', rest @ ..] => (true, rest),
        _ => (false, text),
    };
    let (mut seconds, mut count) = (0_u64, 0_usize);
    let mut rest = digits;
    while let [c @ b'0'..=b'9', after @ ..] = rest {
        seconds = seconds.checked_mul(10)?.checked_add(u64::from(c - b'0'))?;
        count += 1;
        rest = after;
    }
    if count == 0 {
        return None;
    }
    let absolute = match rest {
        [b'-', ..] if !negative && count == 4 => {
            let (date, after) = parse_date(digits)?;
            seconds = u64::try_from(date).ok()?;
            rest = after;
            true
        }
        _ => count >= 10,
    };
    let mut fraction = 0_u64;
    if let [b'.', after @ ..] = rest {
        rest = after;
        let mut unit = 100_000_000_u64;
        let mut any = false;
        while let [c @ b'0'..=b'9', after @ ..] = rest {
            if unit == 0 {
                return None;
            }
            fraction += u64::from(c - b'0') * unit;
            unit /= 10;
            any = true;
            rest = after;
        }
        if !any {
            return None;
        }
    }
    let [b')', rest @ ..] = rest else { return None };
    let magnitude = seconds.checked_mul(1_000_000_000)?.checked_add(fraction)?;
    let t = if negative {
        0_i64.checked_sub_unsigned(magnitude)?
    } else {
        i64::try_from(magnitude).ok()?
    };
    Some((
        Stamp {
            t: Nanos(t),
            absolute,
        },
        rest,
    ))
}

/// Parses `YYYY-MM-DD HH:MM:SS` (UTC) as seconds since 1970; also returns the rest.
fn parse_date(text: &[u8]) -> Option<(i64, &[u8])> {
    let (text, rest) = text.split_at_checked(19)?;
    let number = |range: Range<usize>| {
        text.get(range)?.iter().try_fold(0_i64, |n, c| {
            c.is_ascii_digit().then(|| n * 10 + i64::from(c - b'0'))
        })
    };
    let separators = [(4, b'-'), (7, b'-'), (10, b' '), (13, b':'), (16, b':')];
    if separators.iter().any(|(at, c)| text.get(*at) != Some(c)) {
        return None;
    }
    let (year, month, day) = (number(0..4)?, number(5..7)?, number(8..10)?);
    let (hour, minute, second) = (number(11..13)?, number(14..16)?, number(17..19)?);
    if !(1..=12).contains(&month)
        || !(1..=31).contains(&day)
        || hour > 23
        || minute > 59
        || second > 60
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
    Some((days * 86_400 + hour * 3_600 + minute * 60 + second, rest))
}
