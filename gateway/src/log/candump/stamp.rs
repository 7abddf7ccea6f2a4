//! Parses the time stamp of a line: seconds or a date.

use crate::log::text::civil;
use proprio_topics::Nanos;
use std::ops::Range;

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
    Some((civil([year, month, day], [hour, minute, second])?, rest))
}
