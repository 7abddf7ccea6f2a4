//! Instants and durations as integer nanoseconds: exact and totally ordered.

use core::fmt;
use core::ops::{Add, AddAssign, Sub};
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use zerocopy::FromBytes;

/// An instant of CLOCK_MONOTONIC, or the difference of two instants \[ns\].
///
/// In a recorded log the origin is arbitrary, so only differences have a meaning. Floating point
/// appears only in differences ([`Nanos::seconds`]): after weeks of uptime a double holds an
/// instant since boot only to about a microsecond.
#[repr(C)]
#[derive(
    Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, ZeroCopySend, FromBytes,
)]
pub struct Nanos(pub i64);

impl Nanos {
    /// A duration of zero.
    pub const ZERO: Self = Self(0);
    /// Later than every instant.
    pub const MAX: Self = Self(i64::MAX);
    /// Earlier than every instant.
    pub const MIN: Self = Self(i64::MIN);

    /// Whether it can be an instant: so far (146 years) from both ends that any wait can be added
    /// to it or subtracted from it. Arithmetic saturates, and at an end a wait of any length would
    /// be over at once.
    #[must_use]
    pub const fn is_instant(self) -> bool {
        self.0.unsigned_abs() <= Self::MAX.0.unsigned_abs() / 2
    }

    /// A duration of `ms` milliseconds.
    #[must_use]
    pub const fn from_millis(ms: i64) -> Self {
        Self(ms.saturating_mul(1_000_000))
    }

    /// A duration of `us` microseconds.
    #[must_use]
    pub const fn from_micros(us: i64) -> Self {
        Self(us.saturating_mul(1_000))
    }

    /// A duration given in seconds, rounded to the nearest nanosecond; saturates, and NaN gives
    /// zero.
    #[must_use]
    pub fn from_seconds(s: f64) -> Self {
        let ns = s * 1e9;
        // `as` truncates towards zero and saturates; adding half a nanosecond away from zero
        // rounds.
        #[allow(clippy::cast_possible_truncation)]
        Self((ns + if ns < 0.0 { -0.5 } else { 0.5 }) as i64)
    }

    /// This duration in seconds. Use on differences, never on instants.
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub const fn seconds(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// `self + other`, at most [`Nanos::MAX`].
    #[must_use]
    pub const fn saturating_add(self, other: Self) -> Self {
        Self(self.0.saturating_add(other.0))
    }

    /// `self - other`, clamped to the range of `i64`.
    #[must_use]
    pub const fn saturating_sub(self, other: Self) -> Self {
        Self(self.0.saturating_sub(other.0))
    }

    /// Parses decimal seconds (`12`, `-0.5`, `1479121923.123456789`) as exact nanoseconds.
    ///
    /// Digits beyond the ninth decimal are rounded half up in magnitude. `None` if the text is not
    /// a decimal number or is out of range. An exponent (`1e-3`) is accepted, because spreadsheets
    /// write it.
    #[must_use]
    pub fn parse_seconds(text: &str) -> Option<Self> {
        let (digits, exponent) = match text.find(['e', 'E']) {
            Some(at) => (text.get(..at)?, text.get(at + 1..)?.parse::<i32>().ok()?),
            None => (text, 0),
        };
        let (negative, digits) = match digits.as_bytes().first()? {
            b'-' => (true, digits.get(1..)?),
            b'+' => (false, digits.get(1..)?),
            _ => (false, digits),
        };
        if !(-40..=40).contains(&exponent) {
            return None;
        }
        let (mut value, mut seen_point, mut any) = (0_i128, false, false);
        // Remaining decimals up to the nanosecond digit; below zero, digits only round.
        let mut places = 9 + exponent;
        let mut rounded = false;
        for byte in digits.bytes() {
            match byte {
                b'0'..=b'9' => {
                    any = true;
                    let digit = i128::from(byte - b'0');
                    if !seen_point || places > 0 {
                        if seen_point {
                            places -= 1;
                        }
                        value = value.checked_mul(10)?.checked_add(digit)?;
                    } else if !rounded {
                        rounded = true;
                        if places == 0 && digit >= 5 {
                            value += 1;
                        }
                    }
                }
                b'.' if !seen_point => seen_point = true,
                _ => return None,
            }
            if value > i128::from(i64::MAX) * 1_000_000_000 {
                return None;
            }
        }
        if !any {
            return None;
        }
        while places > 0 {
            value = value.checked_mul(10)?;
            places -= 1;
        }
        while places < 0 {
            value = (value + 5) / 10;
            places += 1;
        }
        let value = if negative { -value } else { value };
        i64::try_from(value).ok().map(Self)
    }
}

impl fmt::Display for Nanos {
    /// Decimal seconds with as many decimals as needed; [`Nanos::parse_seconds`] reads it back
    /// exactly.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let magnitude = self.0.unsigned_abs();
        let (whole, mut rest) = (magnitude / 1_000_000_000, magnitude % 1_000_000_000);
        let sign = if self.0 < 0 { "-" } else { "" };
        if rest == 0 {
            return write!(f, "{sign}{whole}");
        }
        let mut width = 9;
        while rest % 10 == 0 {
            rest /= 10;
            width -= 1;
        }
        write!(f, "{sign}{whole}.{rest:0width$}")
    }
}

impl Add for Nanos {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        self.saturating_add(other)
    }
}

impl AddAssign for Nanos {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl Sub for Nanos {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        self.saturating_sub(other)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::string::ToString;

    #[test]
    fn decimal_seconds_are_exact() {
        for (text, ns) in [
            ("0", 0),
            ("24.00327", 24_003_270_000),
            ("1479121923.123456789", 1_479_121_923_123_456_789),
            ("-0.5", -500_000_000),
            (".25", 250_000_000),
            ("1.0000000004", 1_000_000_000),
            ("1.0000000005", 1_000_000_001),
            ("4.49491e-3", 4_494_910),
            ("1e3", 1_000_000_000_000),
        ] {
            assert_eq!(Nanos::parse_seconds(text), Some(Nanos(ns)), "{text}");
        }
        for text in [
            "",
            ".",
            "-",
            "1.2.3",
            "nan",
            "inf",
            "1,5",
            "99999999999999999999",
            "1e99",
        ] {
            assert_eq!(Nanos::parse_seconds(text), None, "{text}");
        }
    }

    #[test]
    fn an_instant_leaves_room_for_waits() {
        let half = i64::MAX / 2;
        for (ns, is) in [(0, true), (half, true), (-half, true), (half + 1, false)] {
            assert_eq!(Nanos(ns).is_instant(), is, "{ns}");
        }
        for end in [
            Nanos::MIN,
            Nanos(i64::MIN + 1),
            Nanos(i64::MAX - 1),
            Nanos::MAX,
        ] {
            assert!(!end.is_instant());
        }
    }

    proptest::proptest! {
        #[test]
        fn text_round_trips(ns: i64) {
            proptest::prop_assume!(ns != i64::MIN);
            let text = Nanos(ns).to_string();
            proptest::prop_assert_eq!(Nanos::parse_seconds(&text), Some(Nanos(ns)));
        }
    }
}
