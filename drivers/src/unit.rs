//! The units of numbers that other files describe, and their conversion to SI.

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

/// The spellings of each unit, in lower case and with `spelling`'s replacements.
const UNITS: &[(&[&str], Quantity, f64, f64)] = &[
    (&["rad"], Angle, 1.0, 0.0),
    (&["mrad"], Angle, 1e-3, 0.0),
    (&["deg", "degree", "degrees"], Angle, DEGREE, 0.0),
    (&["rev", "turn", "turns"], Angle, TURN, 0.0),
    (&["rad/s"], AngularVelocity, 1.0, 0.0),
    (&["mrad/s"], AngularVelocity, 1e-3, 0.0),
    (&["deg/s", "dps"], AngularVelocity, DEGREE, 0.0),
    (&["rev/s", "turn/s", "turns/s"], AngularVelocity, TURN, 0.0),
    (
        &["rpm", "1/min", "rev/min"],
        AngularVelocity,
        TURN / 60.0,
        0.0,
    ),
    (&["rad/s2"], AngularAcceleration, 1.0, 0.0),
    (&["deg/s2"], AngularAcceleration, DEGREE, 0.0),
    (&["rev/s2", "turn/s2"], AngularAcceleration, TURN, 0.0),
    (&["m"], Length, 1.0, 0.0),
    (&["cm"], Length, 1e-2, 0.0),
    (&["mm"], Length, 1e-3, 0.0),
    (&["um"], Length, 1e-6, 0.0),
    (&["m/s"], Velocity, 1.0, 0.0),
    (&["mm/s"], Velocity, 1e-3, 0.0),
    (&["m/s2"], Acceleration, 1.0, 0.0),
    (&["mm/s2"], Acceleration, 1e-3, 0.0),
    (&["g"], Acceleration, G, 0.0),
    (&["mg"], Acceleration, G * 1e-3, 0.0),
    (&["n", "newton"], Force, 1.0, 0.0),
    (&["mn"], Force, 1e-3, 0.0),
    (&["kn"], Force, 1e3, 0.0),
    (&["kgf"], Force, G, 0.0),
    (&["lbf"], Force, POUND * G, 0.0),
    (&["nm"], Torque, 1.0, 0.0),
    (&["mnm", "nmm"], Torque, 1e-3, 0.0),
    (&["ncm"], Torque, 1e-2, 0.0),
    (&["knm"], Torque, 1e3, 0.0),
    (&["lbfin"], Torque, POUND * G * INCH, 0.0),
    (&["lbfft"], Torque, POUND * G * FOOT, 0.0),
    (&["a", "ampere"], Current, 1.0, 0.0),
    (&["ma"], Current, 1e-3, 0.0),
    (&["t", "tesla"], MagneticField, 1.0, 0.0),
    (&["mt"], MagneticField, 1e-3, 0.0),
    (&["ut"], MagneticField, 1e-6, 0.0),
    (&["gauss"], MagneticField, 1e-4, 0.0),
    (&["degc", "c"], Temperature, 1.0, 0.0),
    (&["k"], Temperature, 1.0, -273.15),
    (&["degf"], Temperature, 5.0 / 9.0, -160.0 / 9.0),
    (&["pa"], Pressure, 1.0, 0.0),
    (&["kpa"], Pressure, 1e3, 0.0),
    (&["mbar"], Pressure, 1e2, 0.0),
    (&["", "-", "1", "count", "counts", "raw"], Number, 1.0, 0.0),
    (&["%"], Number, 1e-2, 0.0),
];

/// Whether `word` written as .dbc files write units is `spelling`.
fn reads(word: &str, spelling: &str) -> bool {
    let (word, mut rest) = (word.trim(), spelling);
    if word.is_empty() || spelling.is_empty() {
        return word == spelling;
    }
    for letter in word.chars() {
        let letters = match letter {
            '\u{b0}' => "deg",
            '\u{b2}' => "2",
            '\u{b5}' | '\u{3bc}' => "u",
            ' ' | '*' | '.' | '\u{b7}' | '^' => "",
            // Of lbf-in; alone it is a unit of its own.
            '-' if word.len() > 1 => "",
            other => {
                let lower = other.to_ascii_lowercase();
                match rest.strip_prefix(lower) {
                    Some(left) => {
                        rest = left;
                        continue;
                    }
                    None => return false,
                }
            }
        };
        match rest.strip_prefix(letters) {
            Some(left) => rest = left,
            None => return false,
        }
    }
    rest.is_empty()
}

/// The unit that `word` means, if it is one of those known.
pub(crate) fn unit(word: &str) -> Option<Unit> {
    UNITS
        .iter()
        .find_map(|&(spellings, quantity, factor, offset)| {
            let found = spellings.iter().any(|spelling| reads(word, spelling));
            found.then_some(Unit {
                quantity,
                factor,
                offset,
            })
        })
}

/// The spellings of the units of `quantities`, for messages.
pub(crate) fn spellings(quantities: &'static [Quantity]) -> impl Iterator<Item = &'static str> {
    let units = UNITS
        .iter()
        .filter(move |unit| quantities.contains(&unit.1));
    units.filter_map(|unit| unit.0.first().copied())
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
        ] {
            let unit = unit(word).unwrap_or_else(|| panic!("{word:?} is not known"));
            assert_eq!(unit.quantity, quantity, "{word:?}");
            assert!(
                (unit.factor / factor - 1.0).abs() < 1e-14,
                "{word:?}: {unit:?}"
            );
        }
        for word in ["°F", "K"] {
            let unit = unit(word).unwrap();
            let boiling = if word == "K" { 373.15 } else { 212.0 };
            assert!(
                (unit.factor * boiling + unit.offset - 100.0).abs() < 1e-9,
                "{word}"
            );
        }
        for word in ["furlong", "Nmm/s", "deg/", "mradd", "--", "ms/10"] {
            assert_eq!(unit(word), None, "{word:?}");
        }
    }

    /// Milli and mega are told apart by nothing but the case of other letters here: no spelling
    /// is that of two units.
    #[test]
    fn no_spelling_has_two_meanings() {
        let all = || UNITS.iter().flat_map(|unit| unit.0);
        for spelling in all() {
            assert_eq!(
                all().filter(|other| *other == spelling).count(),
                1,
                "{spelling:?}"
            );
        }
    }
}
