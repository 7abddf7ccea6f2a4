//! The units of numbers that other files describe, and their conversion to SI.

use alloc::format;
use alloc::string::{String, ToString};
use alloc::vec::Vec;
use proprio_topics::Kind;

/// What a number measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Quantity {
    Angle,
    AngularVelocity,
    AngularAcceleration,
    Length,
    Velocity,
    Acceleration,
    Force,
    Torque,
    Current,
    MagneticField,
    Temperature,
    Pressure,
    /// A count, a share or a code.
    Number,
}

/// A unit: SI value = factor x value + offset. (For a temperature, "SI" is degrees Celsius.)
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Unit {
    pub(crate) quantity: Quantity,
    pub(crate) factor: f64,
    pub(crate) offset: f64,
}

const DEGREE: f64 = core::f64::consts::PI / 180.0;
const TURN: f64 = core::f64::consts::TAU;
/// Standard gravity: exact by definition (CGPM 1901).
const G: f64 = 9.80665;
/// The avoirdupois pound [kg], the inch and the foot [m]: exact by definition (1959).
const POUND: f64 = 0.453_592_37;
const INCH: f64 = 0.0254;
const FOOT: f64 = 0.3048;

use Quantity::{
    Acceleration, Angle, AngularAcceleration, AngularVelocity, Current, Force, Length,
    MagneticField, Number, Pressure, Temperature, Torque, Velocity,
};

/// The spellings of each unit as [`plain`] writes them, the usual one first (that of a number is
/// empty), its factor and its offset. Rates are left out: they are an angle or a length over times.
const UNITS: &[(&str, Quantity, f64, f64)] = &[
    ("rad rads radian radians", Angle, 1.0, 0.0),
    ("mrad", Angle, 1e-3, 0.0),
    ("deg degs degree degrees", Angle, DEGREE, 0.0),
    ("mdeg", Angle, DEGREE * 1e-3, 0.0),
    (
        "rev revs revolution revolutions turn turns r u",
        Angle,
        TURN,
        0.0,
    ),
    ("rpm 1/min /min upm rpms", AngularVelocity, TURN / 60.0, 0.0),
    ("krpm", AngularVelocity, TURN / 60.0 * 1e3, 0.0),
    ("dps", AngularVelocity, DEGREE, 0.0),
    ("mdps", AngularVelocity, DEGREE * 1e-3, 0.0),
    ("m meter meters metre metres", Length, 1.0, 0.0),
    ("cm", Length, 1e-2, 0.0),
    ("mm", Length, 1e-3, 0.0),
    ("um", Length, 1e-6, 0.0),
    ("km", Length, 1e3, 0.0),
    ("in inch inches", Length, INCH, 0.0),
    ("ft foot feet", Length, FOOT, 0.0),
    ("kph kmh kmph", Velocity, 1e3 / 3600.0, 0.0),
    ("mph", Velocity, 5280.0 * FOOT / 3600.0, 0.0),
    ("g gs", Acceleration, G, 0.0),
    ("mg", Acceleration, G * 1e-3, 0.0),
    ("n newton newtons", Force, 1.0, 0.0),
    ("mn", Force, 1e-3, 0.0),
    ("kn", Force, 1e3, 0.0),
    ("dan", Force, 10.0, 0.0),
    ("kgf", Force, G, 0.0),
    ("gf", Force, G * 1e-3, 0.0),
    ("lbf", Force, POUND * G, 0.0),
    (
        "nm newtonmeter newtonmeters newtonmetre newtonmetres",
        Torque,
        1.0,
        0.0,
    ),
    ("mnm nmm", Torque, 1e-3, 0.0),
    ("unm", Torque, 1e-6, 0.0),
    ("ncm", Torque, 1e-2, 0.0),
    ("knm", Torque, 1e3, 0.0),
    ("kgfcm", Torque, G * 1e-2, 0.0),
    ("kgfm", Torque, G, 0.0),
    ("lbfin inlbf inlb inlbs", Torque, POUND * G * INCH, 0.0),
    ("lbfft ftlbf ftlb ftlbs", Torque, POUND * G * FOOT, 0.0),
    ("ozfin ozin inoz", Torque, POUND / 16.0 * G * INCH, 0.0),
    (
        "a amp amps ampere amperes arms apk adc aac",
        Current,
        1.0,
        0.0,
    ),
    ("ma mamp mamps milliamp milliamps", Current, 1e-3, 0.0),
    ("ua", Current, 1e-6, 0.0),
    ("ka", Current, 1e3, 0.0),
    ("t tesla", MagneticField, 1.0, 0.0),
    ("mt", MagneticField, 1e-3, 0.0),
    ("ut", MagneticField, 1e-6, 0.0),
    ("nt", MagneticField, 1e-9, 0.0),
    ("gauss gs g", MagneticField, 1e-4, 0.0),
    ("mgauss mg", MagneticField, 1e-7, 0.0),
    (
        "degc c celsius degcelsius degreec degreesc degreecelsius degreescelsius",
        Temperature,
        1.0,
        0.0,
    ),
    ("k degk kelvin", Temperature, 1.0, -273.15),
    (
        "degf f fahrenheit degfahrenheit degreesf",
        Temperature,
        5.0 / 9.0,
        -160.0 / 9.0,
    ),
    ("pa pascal", Pressure, 1.0, 0.0),
    ("hpa", Pressure, 1e2, 0.0),
    ("kpa", Pressure, 1e3, 0.0),
    ("Mpa", Pressure, 1e6, 0.0),
    ("bar bars", Pressure, 1e5, 0.0),
    ("mbar", Pressure, 1e2, 0.0),
    ("psi", Pressure, POUND * G / (INCH * INCH), 0.0),
    (
        " 1 count counts cnt tick ticks bit bits lsb raw",
        Number,
        1.0,
        0.0,
    ),
    ("% percent pct", Number, 1e-2, 0.0),
];

/// The spellings of times \[s\].
const TIMES: &[(&str, f64)] = &[
    ("s sec secs second seconds", 1.0),
    ("ms", 1e-3),
    ("min minute minutes", 60.0),
    ("h hr hour hours", 3600.0),
];

/// What a quantity over a time is.
const RATES: &[(Quantity, Quantity)] = &[
    (Angle, AngularVelocity),
    (AngularVelocity, AngularAcceleration),
    (Length, Velocity),
    (Velocity, Acceleration),
];

/// `word` in lower case (but for M, which is no m), with signs spelled out, without spaces,
/// brackets and signs of products, and with a slash before what divides. So `[N·m]` is `nm`, and
/// `°/s²` and `deg s^-2` are `deg/s2`.
fn plain(word: &str) -> String {
    let mut text = String::new();
    for letter in word.trim().chars() {
        match letter {
            '\u{b0}' | '\u{ba}' => text += "deg",
            '\u{b2}' => text += "2",
            '\u{b5}' | '\u{3bc}' => text += "u",
            '\u{207b}' | '\u{2212}' => text += "-",
            '\u{b9}' => text += "1",
            // UTF-8 that was taken for Latin-1 has it before a degree sign.
            '\u{c2}' => {}
            '*' | '.' | '\u{b7}' | '\u{22c5}' => text.push(' '),
            '^' | '_' | '[' | ']' | '(' | ')' | '\'' => {}
            'M' => text.push('M'),
            other => text.extend(other.to_lowercase()),
        }
    }
    let mut plain = String::new();
    for part in text.split_whitespace() {
        match part.split_once('-') {
            _ if part == "per" => plain.push('/'),
            // A negative power divides. Other lines join words, as in lbf-in.
            Some((unit, "1")) => plain += &format!("/{unit}"),
            Some((unit, "2")) => plain += &format!("/{unit}2"),
            _ if part != "-" => plain.extend(part.chars().filter(|c| *c != '-')),
            _ => {}
        }
    }
    plain
}

/// Whether `text`, as [`plain`] writes it, is the spelling `spelling`, which is one of `all`. Case
/// does not matter, but for an m of a unit with a prefix: m is a thousandth, and M a million.
fn is_spelled<'s>(text: &str, spelling: &str, mut all: impl Iterator<Item = &'s str>) -> bool {
    let mut has_prefix = |of: &str| {
        let unit = of.strip_prefix(['m', 'M']).filter(|unit| !unit.is_empty());
        unit.is_some_and(|unit| all.any(|known| known.eq_ignore_ascii_case(unit)))
    };
    spelling.eq_ignore_ascii_case(text)
        && (spelling.get(..1) == text.get(..1) || !has_prefix(spelling))
}

/// The time that a unit is divided by, one or two factors: how many, and their product \[s\].
fn times(text: &str) -> Option<(usize, f64)> {
    let time = |text: &str| {
        let all = || TIMES.iter().flat_map(|(spellings, _)| spellings.split(' '));
        let is = |spelling: &str| is_spelled(text, spelling, all());
        let found = TIMES
            .iter()
            .find(|(spellings, _)| spellings.split(' ').any(is));
        found.map(|(_, seconds)| *seconds)
    };
    if let Some((first, second)) = text.split_once('/') {
        return Some((2, time(first)? * time(second)?));
    }
    if let Some(seconds) = time(text) {
        return Some((1, seconds));
    }
    let squared = text.strip_suffix('2').or((text == "ss").then_some("s"));
    squared.and_then(time).map(|seconds| (2, seconds * seconds))
}

/// The unit that `word` means among those of `legal`, else among all that are known.
pub(crate) fn unit(word: &str, legal: &[Quantity]) -> Option<Unit> {
    let text = plain(word);
    // Lines alone: "-" is how some write that there is none.
    if text.is_empty() && !matches!(word.trim(), "" | "-") {
        return None;
    }
    let spelled = |text: &str, legal: &[Quantity]| {
        let words = || UNITS.iter().flat_map(|unit| unit.0.split(' '));
        let is = |spelling: &str| is_spelled(text, spelling, words());
        let mut units = UNITS.iter();
        let found = units.find(|u| legal.contains(&u.1) && u.0.split(' ').any(is));
        let all = || UNITS.iter().find(|unit| unit.0.split(' ').any(is));
        found
            .or_else(all)
            .map(|&(_, quantity, factor, offset)| Unit {
                quantity,
                factor,
                offset,
            })
    };
    if let Some(unit) = spelled(&text, legal) {
        return Some(unit);
    }
    let (of, over) = text.split_once('/')?;
    let (number, seconds) = times(over)?;
    // Units of a number per time are left out: a frequency is no rate of anything.
    let mut unit = spelled(of, &[Angle, AngularVelocity, Length, Velocity])?;
    for _ in 0..number {
        unit.quantity = RATES.iter().find(|(of, _)| *of == unit.quantity)?.1;
    }
    unit.factor /= seconds;
    Some(unit)
}

/// Whether `word`, which is no unit, is one behind a number other than 1, as `0.1 degC`.
pub(crate) fn is_multiple(word: &str) -> bool {
    let is_number = |c: char| c.is_ascii_digit() || matches!(c, '.' | ',' | '/' | '*' | ' ');
    let rest = word.trim_start_matches(is_number);
    rest.len() < word.trim_start().len() && !rest.is_empty() && unit(rest, &[]).is_some()
}

/// Whether `word`, which is no unit, is one with m for M, or M for m.
pub(crate) fn is_of_other_case(word: &str) -> bool {
    let other = |c| match c {
        'm' => 'M',
        'M' => 'm',
        c => c,
    };
    unit(&word.chars().map(other).collect::<String>(), &[]).is_some()
}

/// The usual spellings of the units of `quantities`, for messages.
pub(crate) fn spellings(quantities: &[Quantity]) -> Vec<String> {
    let mut words = Vec::new();
    for quantity in quantities {
        let (of, over) = match quantity {
            AngularVelocity => (Angle, "/s"),
            AngularAcceleration => (Angle, "/s^2"),
            Velocity => (Length, "/s"),
            Acceleration => (Length, "/s^2"),
            _ => (*quantity, ""),
        };
        let named = |quantity| {
            let units = UNITS.iter().filter(move |unit| unit.1 == quantity);
            units.filter_map(|unit| unit.0.split(' ').next())
        };
        words.extend(named(of).map(|word| format!("{word}{over}")));
        if of != *quantity {
            words.extend(named(*quantity).map(ToString::to_string));
        }
    }
    words
}

/// What value number `field` of a reading of kind `kind` measures.
pub(crate) const fn quantities(kind: Kind, field: usize) -> &'static [Quantity] {
    match (kind, field) {
        (Kind::Joint, 0) => &[Angle, Length],
        (Kind::Joint, 1) => &[AngularVelocity, Velocity],
        (Kind::Joint, 2) => &[AngularAcceleration, Acceleration],
        (Kind::Joint, 3) => &[Torque, Force],
        (Kind::Joint, _) => &[Current],
        (Kind::Wrench, 0..=2) => &[Force],
        (Kind::Wrench, _) => &[Torque],
        (Kind::Imu, 0..=2) => &[Acceleration],
        (Kind::Imu, 3..=5) => &[AngularVelocity],
        (Kind::Imu, 6..=8) => &[AngularAcceleration],
        (Kind::Imu, 9..=11) => &[MagneticField],
        (Kind::Temperature, _) => &[Temperature],
        (Kind::Skin, 1..) => &[Pressure, Number],
        (Kind::Imu | Kind::Gauges | Kind::Actuator | Kind::Skin, _) => &[Number],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_read_as_files_write_them() {
        for (word, quantity, factor) in [
            ("m/s²", Acceleration, 1.0),
            ("m/s^2", Acceleration, 1.0),
            ("°/s", AngularVelocity, DEGREE),
            ("deg/s", AngularVelocity, DEGREE),
            ("RPM", AngularVelocity, TURN / 60.0),
            ("N·m", Torque, 1.0),
            ("N m", Torque, 1.0),
            ("Nm", Torque, 1.0),
            ("mNm", Torque, 1e-3),
            ("N", Force, 1.0),
            ("lbf-in", Torque, 0.112_984_829_027_616_7),
            ("lbf", Force, 4.448_221_615_260_5),
            ("rev", Angle, TURN),
            ("µT", MagneticField, 1e-6),
            ("A", Current, 1.0),
            ("°C", Temperature, 1.0),
            ("", Number, 1.0),
            ("-", Number, 1.0),
            ("%", Number, 0.01),
            // Numbers of the international system of units, and of NIST SP 811.
            ("mrad", Angle, 1e-3),
            ("deg", Angle, 0.017_453_292_519_943_295),
            ("rpm", AngularVelocity, 0.104_719_755_119_659_77),
            ("rad/s2", AngularAcceleration, 1.0),
            ("deg/s2", AngularAcceleration, 0.017_453_292_519_943_295),
            (
                "rev/s2",
                AngularAcceleration,
                360.0 * 0.017_453_292_519_943_295,
            ),
            ("cm", Length, 0.01),
            ("mm", Length, 1e-3),
            ("um", Length, 1e-6),
            ("mm/s", Velocity, 1e-3),
            ("mm/s2", Acceleration, 1e-3),
            ("g", Acceleration, 9.806_65),
            ("mg", Acceleration, 9.806_65e-3),
            ("mN", Force, 1e-3),
            ("kN", Force, 1e3),
            ("kgf", Force, 9.806_65),
            ("Ncm", Torque, 0.01),
            ("Nmm", Torque, 1e-3),
            ("kNm", Torque, 1e3),
            ("lbf-ft", Torque, 1.355_817_948_331_400_4),
            ("mA", Current, 1e-3),
            ("mT", MagneticField, 1e-3),
            // Spellings of public files.
            ("deg/sec", AngularVelocity, 0.017_453_292_519_943_295),
            ("degrees/s", AngularVelocity, 0.017_453_292_519_943_295),
            (
                "Degree per second",
                AngularVelocity,
                0.017_453_292_519_943_295,
            ),
            (
                "\u{c2}\u{b0}/sec",
                AngularVelocity,
                0.017_453_292_519_943_295,
            ),
            ("[\u{ba}/s]", AngularVelocity, 0.017_453_292_519_943_295),
            ("rad s^-1", AngularVelocity, 1.0),
            ("rad/min", AngularVelocity, 1.0 / 60.0),
            ("U/min", AngularVelocity, 0.104_719_755_119_659_77),
            ("1/min", AngularVelocity, 0.104_719_755_119_659_77),
            ("min^-1", AngularVelocity, 0.104_719_755_119_659_77),
            ("min-1", AngularVelocity, 0.104_719_755_119_659_77),
            ("rev/min", AngularVelocity, 0.104_719_755_119_659_77),
            ("revs per minute", AngularVelocity, 0.104_719_755_119_659_77),
            ("r/min", AngularVelocity, 0.104_719_755_119_659_77),
            ("Rev/Sec", AngularVelocity, TURN),
            (
                "degrees/sec\u{b2}",
                AngularAcceleration,
                0.017_453_292_519_943_295,
            ),
            ("deg/s/s", AngularAcceleration, 0.017_453_292_519_943_295),
            ("deg/(s*s)", AngularAcceleration, 0.017_453_292_519_943_295),
            ("rpm/s", AngularAcceleration, 0.104_719_755_119_659_77),
            ("rad\u{b7}s\u{207b}\u{b2}", AngularAcceleration, 1.0),
            ("m/sec^2", Acceleration, 1.0),
            ("m s-2", Acceleration, 1.0),
            ("m/sec", Velocity, 1.0),
            ("km/h", Velocity, 1.0 / 3.6),
            ("kph", Velocity, 1.0 / 3.6),
            ("mph", Velocity, 0.447_04),
            ("Amps", Current, 1.0),
            ("A_rms", Current, 1.0),
            ("mAmp", Current, 1e-3),
            ("Newton-meter", Torque, 1.0),
            ("N*m", Torque, 1.0),
            ("ft-lbs", Torque, 1.355_817_948_331_400_4),
            ("oz-in", Torque, 7.061_551_814_226_044e-3),
            ("Newtons", Force, 1.0),
            ("daN", Force, 10.0),
            ("bar", Pressure, 1e5),
            ("hPa", Pressure, 1e2),
            ("MPa", Pressure, 1e6),
            ("psi", Pressure, 6_894.757_293_168_361),
            ("deg C", Temperature, 1.0),
            ("Celsius", Temperature, 1.0),
            ("degrees C", Temperature, 1.0),
            ("Gauss", MagneticField, 1e-4),
            ("percent", Number, 0.01),
            ("NMM", Torque, 1e-3),
            ("1/MIN", AngularVelocity, 0.104_719_755_119_659_77),
            ("REV/MIN", AngularVelocity, 0.104_719_755_119_659_77),
            ("M/S", Velocity, 1.0),
            ("Meters", Length, 1.0),
        ] {
            let unit = unit(word, &[]).unwrap_or_else(|| panic!("{word:?} is not known"));
            assert_eq!(unit.quantity, quantity, "{word:?}");
            assert!(
                (unit.factor / factor - 1.0).abs() < 1e-14,
                "{word:?}: {unit:?}"
            );
        }
        for word in ["°F", "K"] {
            let unit = unit(word, &[]).unwrap();
            let boiling = if word == "K" { 373.15 } else { 212.0 };
            assert!(
                (unit.factor * boiling + unit.offset - 100.0).abs() < 1e-9,
                "{word}"
            );
        }
        for word in [
            "furlong",
            "Nmm/s",
            "deg/",
            "mradd",
            "--",
            "ms/10",
            "1/s",
            "deg/s/s/s",
            "rad/s^3",
            "*",
            "V",
            // A million of it.
            "MN",
            "MNm",
            "Mrad",
            "MM",
            "Mrad/s",
            "rad/Ms",
            "MA",
            // A thousandth.
            "mPa",
            "0.1 degC",
        ] {
            assert_eq!(unit(word, &[]), None, "{word:?}");
        }
    }

    /// Where a spelling is that of two units, what the number measures tells them apart: no two of
    /// one quantity have the same.
    #[test]
    fn no_spelling_has_two_meanings() {
        for (at, one) in UNITS.iter().enumerate() {
            let others = UNITS.iter().skip(at + 1).filter(|other| other.1 == one.1);
            for spelling in others.flat_map(|other| other.0.split(' ')) {
                let known = one.0.split(' ').any(|known| known == spelling);
                assert!(!known, "{spelling:?}");
            }
        }
        assert_eq!(
            unit("Gs", &[MagneticField]).unwrap().quantity,
            MagneticField
        );
        assert_eq!(unit("g's", &[Acceleration]).unwrap().quantity, Acceleration);
        let milli = |legal| unit("mG", &[legal]).map(|unit| (unit.quantity, unit.factor));
        assert_eq!(milli(Acceleration), Some((Acceleration, G * 1e-3)));
        assert_eq!(milli(MagneticField), Some((MagneticField, 1e-7)));
        for (word, of_other_case, multiple) in [
            ("MNm", true, false),
            ("mPa", true, false),
            ("0.1 degC", false, true),
            ("1/10 \u{b0}C", false, true),
            ("furlong", false, false),
            ("3", false, false),
        ] {
            let found = (is_of_other_case(word), is_multiple(word));
            assert_eq!(found, (of_other_case, multiple), "{word}");
        }
    }

    /// What a message offers is read as what it says.
    #[test]
    fn the_spellings_of_messages_are_read() {
        for quantity in [
            Angle,
            AngularVelocity,
            AngularAcceleration,
            Length,
            Velocity,
            Acceleration,
            Force,
            Torque,
            Current,
            MagneticField,
            Temperature,
            Pressure,
            Number,
        ] {
            let words = spellings(&[quantity]);
            assert!(!words.is_empty());
            for word in words {
                let found = unit(&word, &[quantity]).map(|unit| unit.quantity);
                assert_eq!(found, Some(quantity), "{word}");
            }
        }
    }
}
