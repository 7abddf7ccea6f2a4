//! Whether the quantities of a configuration can be in the units that their keys name.
//!
//! Each quantity has a range outside of which it is not credible. If another unit that people use
//! explains the number, the configuration is refused, with the number in the right unit. Else, and
//! for the URDF, which other programs accept, it is only told.
//!
//! | quantity | credible | because |
//! |---|---|---|
//! | length of `gravity_mps2` | 9.7 to 9.9 m/s^2 | 9.764 to 9.834 on Earth, and rounding |
//! | `xyz_m`, `position_m` | the robot's length, 2 m at least | points lie on the robot |
//! | `rpy_rad`, a locked revolute joint | a full turn | more is no other angle |
//! | a link's density | osmium, 22590 kg/m^3 | no material is denser |
//! | a link's radius of gyration, centre of mass | as for `xyz_m` | the same |
//!
//! The density is the least that mass and inertia allow: of all bodies of one density with a given
//! radius of gyration (root of the mean square distance of their mass from its centre), the ball
//! has the largest volume; its radius is the root of 5/3 times that. The robot's length is that of
//! its longest chain of joint origins, but 2 m at least: few links are longer.

use crate::config::{Base, Config};
use proprio_dynamics::model::{JointKind, Model, POINT};
use proprio_dynamics::spatial::{RigidInertia, Vec3};
use std::f64::consts::{PI, TAU};

/// The density of osmium \[kg/m^3\].
const DENSEST: f64 = 22590.0;
/// The least length that a robot is credited with \[m\].
const SHORTEST: f64 = 2.0;
/// Most links that one note names.
const NAMED: usize = 5;

/// A kind of quantity.
struct CredibleRange {
    /// The credible values of its size, and the unit.
    range: [f64; 2],
    unit: &'static str,
    /// Where the range comes from.
    because: &'static str,
    /// The units that it is typed in by mistake, in words, and their size in the right unit.
    mistaken: &'static [(&'static str, f64)],
}

const GRAVITY: CredibleRange = CredibleRange {
    range: [9.7, 9.9],
    unit: "m/s^2",
    because: "on Earth it is 9.76 to 9.83",
    mistaken: &[
        ("a multiple of g", 9.80665),
        ("cm/s^2", 1e-2),
        ("mm/s^2", 1e-3),
        ("ft/s^2", 0.3048),
    ],
};

const ANGLE: CredibleRange = CredibleRange {
    range: [0.0, TAU],
    unit: "rad",
    because: "more than a full turn, 6.283185, is no other angle",
    mistaken: &[("degrees", PI / 180.0)],
};

const fn length(longest: f64) -> CredibleRange {
    CredibleRange {
        range: [0.0, longest],
        unit: "m",
        because: "the robot itself is shorter",
        mistaken: &[("millimetres", 1e-3)],
    }
}

impl CredibleRange {
    /// What is wrong with `numbers`, whose size is `size`: an error if another unit explains it,
    /// else a note.
    fn judge(&self, at: &str, numbers: &[f64], size: f64) -> Result<Option<String>, String> {
        let [least, most] = self.range;
        let is_credible = |size: f64| (least..=most).contains(&size);
        let (unit, because) = (self.unit, self.because);
        // A rounded full turn is one.
        if is_credible(size) || is_credible(size * (1.0 - 1e-6)) {
            return Ok(None);
        }
        let explains = |(_, factor): &&(&str, f64)| is_credible(size * factor);
        match self.mistaken.iter().find(explains) {
            Some((word, factor)) => {
                let right: Vec<f64> = numbers.iter().map(|number| number * factor).collect();
                Err(format!(
                    "{at} = {} looks like {word}; in {unit} it is {} ({because})",
                    text(numbers),
                    text(&right)
                ))
            }
            None => Ok(Some(format!(
                "{at} = {} is not credible in {unit}: {because}",
                text(numbers)
            ))),
        }
    }
}

/// A number, or several in brackets, to a millionth.
fn text(numbers: &[f64]) -> String {
    // Adding 0.0 turns -0 into 0.
    let number = |number: &f64| format!("{}", (1e6 * number).round() / 1e6 + 0.0);
    match numbers {
        [one] => number(one),
        several => format!(
            "[{}]",
            several.iter().map(number).collect::<Vec<_>>().join(", ")
        ),
    }
}

/// Checks the quantities of `config` and of its URDF. Returns notes.
///
/// # Errors
/// A text with key, value, the unit that it seems to be in, and the value in the right unit.
pub(crate) fn check(config: &Config, model: &Model) -> Result<Vec<String>, String> {
    let mut notes = Vec::new();
    let longest = longest(model);
    let mut judge = |quantity: &CredibleRange, at: &str, numbers: &[f64], size: f64| {
        let note = quantity.judge(at, numbers, size)?;
        notes.extend(note);
        Ok::<_, String>(())
    };
    let norm = |numbers: &[f64; 3]| Vec3::from(*numbers).norm();
    let largest = |numbers: &[f64; 3]| numbers.iter().fold(0.0_f64, |most, x| most.max(x.abs()));
    match &config.base {
        Base::Fixed { gravity_mps2, .. } => {
            judge(
                &GRAVITY,
                "base.gravity_mps2",
                gravity_mps2,
                norm(gravity_mps2),
            )?;
        }
        Base::Stance { foot } => {
            for foot in foot {
                let at = format!("base.foot {:?}: gravity_mps2", foot.link);
                judge(&GRAVITY, &at, &foot.gravity_mps2, norm(&foot.gravity_mps2))?;
            }
        }
        Base::Imu { xyz_m, rpy_rad, .. } => {
            judge(&length(longest), "base.xyz_m", xyz_m, norm(xyz_m))?;
            judge(&ANGLE, "base.rpy_rad", rpy_rad, largest(rpy_rad))?;
        }
    }
    for ft in &config.force_torque {
        let at = |key: &str| format!("force_torque {:?}: {key}", ft.sensor);
        if let Some(xyz) = &ft.xyz_m {
            judge(&length(longest), &at("xyz_m"), xyz, norm(xyz))?;
        }
        if let Some(rpy) = &ft.rpy_rad {
            judge(&ANGLE, &at("rpy_rad"), rpy, largest(rpy))?;
        }
    }
    for contact in &config.contact {
        let at = format!("contact {:?}: position_m", contact.name());
        let position = &contact.position_m;
        judge(&length(longest), &at, position, norm(position))?;
    }
    for (name, position) in &config.locked {
        let joint = model
            .joint(name)
            .and_then(|joint| model.joints().get(joint));
        if joint.is_some_and(|joint| matches!(joint.kind, JointKind::Revolute(_))) {
            judge(
                &ANGLE,
                &format!("locked.{name}"),
                &[*position],
                position.abs(),
            )?;
        }
    }
    notes.extend(bodies(model, longest));
    Ok(notes)
}

/// Checks an angle that a person typed.
///
/// # Errors
/// As for [`check`].
pub(crate) fn angle(at: &str, rad: f64) -> Result<(), String> {
    match ANGLE.judge(at, &[rad], rad.abs())? {
        Some(note) => Err(note),
        None => Ok(()),
    }
}

/// The length of the longest chain of joint origins, [`SHORTEST`] at least \[m\].
fn longest(model: &Model) -> f64 {
    let mut reach = vec![0.0; model.link_count()];
    for joint in model.joints() {
        let from = reach.get(joint.parent).copied().unwrap_or(0.0);
        if let Some(place) = reach.get_mut(joint.child) {
            *place = from + joint.placement.translation.norm();
        }
    }
    reach.into_iter().fold(SHORTEST, f64::max)
}

/// Notes on the links whose mass or inertia is beyond reason.
fn bodies(model: &Model, longest: f64) -> impl Iterator<Item = String> {
    let links = || {
        model
            .inertias()
            .iter()
            .zip(0..)
            .filter(|(body, _)| body.mass > 0.0)
    };
    let named = |found: Vec<(usize, f64)>, what: &dyn Fn(usize, f64) -> String| {
        let (first, value) = *found.first()?;
        let others: Vec<&str> = (found.iter().skip(1).take(NAMED))
            .map(|(link, _)| model.link_name(*link))
            .collect();
        let more = match (others.is_empty(), found.len() > NAMED + 1) {
            (true, _) => String::new(),
            (_, is_more) => format!(
                "; likewise {}{}",
                others.join(", "),
                if is_more { ", ..." } else { "" }
            ),
        };
        Some(what(first, value) + &more)
    };
    // The inertia of what is meant to be a point says nothing of its size.
    let solid = links().filter(|(body, _)| gyration(body) > POINT);
    let dense = solid.map(|(body, link)| (link, density(body)));
    let dense: Vec<(usize, f64)> = dense.filter(|(_, density)| *density > DENSEST).collect();
    let far = links().map(|(body, link)| (link, extent(body)));
    let far: Vec<(usize, f64)> = far.filter(|(_, extent)| *extent > longest).collect();
    let too_dense = named(dense, &|link, density| {
        format!(
            "link {:?} of the URDF: {} kg with its inertia are {density:.2e} kg/m^3, denser than \
             any material ({DENSEST}): masses are in kg, inertias in kg m^2",
            model.link_name(link),
            text(&[model.inertias()[link].mass])
        )
    });
    let too_far = named(far, &|link, extent| {
        format!(
            "link {:?} of the URDF: its mass lies {extent:.3} m from its origin, but the robot is \
             {longest:.3} m long: lengths are in m, inertias in kg m^2",
            model.link_name(link)
        )
    });
    [too_dense, too_far].into_iter().flatten()
}

/// Square of a body's radius of gyration about its centre of mass \[m^2\].
fn gyration(body: &RigidInertia) -> f64 {
    // The trace of an inertia is twice the second moment about the point.
    let centre = body.first_moment / body.mass;
    0.5 * body.inertia.trace() / body.mass - centre.norm_squared()
}

/// The least density that mass and inertia allow \[kg/m^3\].
fn density(body: &RigidInertia) -> f64 {
    let radius = (5.0 / 3.0 * gyration(body).max(0.0)).sqrt();
    body.mass / (4.0 / 3.0 * PI * radius.powi(3))
}

/// How far from its origin a body's mass lies \[m\].
fn extent(body: &RigidInertia) -> f64 {
    (body.first_moment / body.mass)
        .norm()
        .max(gyration(body).max(0.0).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    const CONFIG: &str = "schema = 1\nrobot = \"r\"\nmodel = \"r.urdf\"\n[base]\nkind = \"fixed\"\n\
        link = \"base\"\ngravity_mps2 = [0, 0, -9.81]\n[locked]\nj = 1.5\n[[force_torque]]\n\
        sensor = \"ft\"\njoint = \"j\"\nxyz_m = [0.01, 0, -0.02]\nrpy_rad = [0, 3.14, -6.283186]\n\
        [[contact]]\nlink = \"arm\"\nposition_m = [0, 0.4, 0]\n";

    fn urdf(mass: f64, com: f64, inertia: f64) -> String {
        let link = |name: &str, mass: f64, com: f64, i: f64| {
            format!(
                "<link name=\"{name}\"><inertial><origin xyz=\"{com} 0 0\"/>\
                 <mass value=\"{mass}\"/>\
                 <inertia ixx=\"{i}\" ixy=\"0\" ixz=\"0\" iyy=\"{i}\" iyz=\"0\" izz=\"{i}\"/>\
                 </inertial></link>"
            )
        };
        format!(
            "<robot name=\"r\">{}{}<joint name=\"j\" type=\"revolute\"><parent link=\"base\"/>\
             <child link=\"arm\"/><origin xyz=\"0 0 0.5\"/><axis xyz=\"0 1 0\"/>\
             <limit lower=\"-2\" upper=\"2\" effort=\"9\" velocity=\"5\"/></joint></robot>",
            link("base", 5.0, 0.0, 0.02),
            link("arm", mass, com, inertia)
        )
    }

    fn checked(config: &str, urdf: &str) -> Result<Vec<String>, String> {
        let config = Config::parse(config).expect("a configuration");
        check(&config, &Model::from_urdf(urdf, &[]).expect("a model"))
    }

    #[test]
    fn quantities_in_other_units_are_named_with_the_right_number() {
        let good = urdf(1.2, 0.1, 0.002);
        assert_eq!(checked(CONFIG, &good), Ok(vec![]));
        for (from, to, expected) in [
            (
                "-9.81]",
                "-1]",
                "looks like a multiple of g; in m/s^2 it is [0, 0, -9.80665]",
            ),
            (
                "[0, 0, -9.81]",
                "[981, 0, 0]",
                "cm/s^2; in m/s^2 it is [9.81, 0, 0]",
            ),
            ("[0, 0, -9.81]", "[0, 9806.65, 0]", "mm/s^2"),
            (
                "-9.81]",
                "-32.17]",
                "ft/s^2; in m/s^2 it is [0, 0, -9.805416]",
            ),
            (
                "[0.01, 0, -0.02]",
                "[10, 0, -20]",
                "\"ft\": xyz_m = [10, 0, -20] looks like millimetres; in m it is [0.01, 0, -0.02]",
            ),
            (
                "[0, 3.14, -6.283186]",
                "[0, 180, -90]",
                "rpy_rad = [0, 180, -90] looks like degrees; in rad it is [0, 3.141593, -1.570796]",
            ),
            (
                "[0, 0.4, 0]",
                "[0, 400, 0]",
                "contact \"arm\": position_m = [0, 400, 0] looks like millimetres",
            ),
            (
                "j = 1.5",
                "j = -90",
                "locked.j = -90 looks like degrees; in rad it is -1.570796",
            ),
        ] {
            assert!(CONFIG.contains(from), "{from}");
            let error = checked(&CONFIG.replacen(from, to, 1), &good).unwrap_err();
            assert!(error.contains(expected), "{to}: {error}");
        }
        // No other unit explains these: they may be meant.
        for (from, to, expected) in [
            (
                "-9.81]",
                "-1.62]",
                "base.gravity_mps2 = [0, 0, -1.62] is not credible in m/s^2",
            ),
            ("-9.81]", "0]", "= [0, 0, 0] is not credible"),
            (
                "j = 1.5",
                "j = 1000",
                "locked.j = 1000 is not credible in rad",
            ),
        ] {
            let notes = checked(&CONFIG.replacen(from, to, 1), &good).unwrap();
            let [note] = &notes[..] else {
                panic!("{notes:?}")
            };
            assert!(note.contains(expected), "{note}");
        }
    }

    /// 1.2 kg, 0.1 m out, with a radius of gyration of 5 cm about its centre.
    #[test]
    fn masses_and_inertias_beyond_reason_are_named() {
        for (mass, com, inertia, expected) in [
            // The mass alone in grams; the inertia, too; the latter in g mm^2; lengths in mm.
            (1200.0, 0.1, 0.002, "1200 kg with its inertia are"),
            (1200.0, 0.1, 2.0, "denser than any material (22590)"),
            (1.2, 0.1, 2e6, "its mass lies 1581.139 m from its origin"),
            (
                1.2,
                100.0,
                0.002,
                "its mass lies 100.000 m from its origin, but the robot is 2.000 m",
            ),
        ] {
            let notes = checked(CONFIG, &urdf(mass, com, inertia)).unwrap();
            let [note] = &notes[..] else {
                panic!("{mass} {com} {inertia}: {notes:?}")
            };
            assert!(
                note.starts_with("link \"arm\"") && note.contains(expected),
                "{note}"
            );
        }
        // A point mass is a usual simplification.
        assert_eq!(checked(CONFIG, &urdf(1.3, 0.0, 0.0)), Ok(vec![]));
        // A ball of osmium is possible, and a denser one is not: a tenth of a litre.
        let radius = (1e-4_f64 * 3.0 / (4.0 * PI)).cbrt();
        for (density, is_told) in [(22580.0, false), (22600.0, true)] {
            let mass = 1e-4 * density;
            let notes = checked(CONFIG, &urdf(mass, 0.0, 0.4 * mass * radius * radius)).unwrap();
            assert_eq!(notes.len(), usize::from(is_told), "{notes:?}");
        }
    }
}
