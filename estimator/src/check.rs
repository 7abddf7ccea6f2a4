//! Plausibility figures of a configuration, for a person who knows the robot: `estimator --check`
//! prints them after the setup.
//!
//! - masses: of the whole robot, and beyond each F/T sensor;
//! - the readings of the F/T sensors without offsets, with the robot at rest in a posture
//!   ([`Posture`]), held by its base, under the configured gravity, and without contacts; beside
//!   what a running robot measures;
//! - which torques are withheld in that posture, and why ([`Withheld`]);
//! - joints whose effort limit could not hold the limb beyond them: masses or limits are in other
//!   units;
//! - joints of sub-trees with an F/T sensor whose torque can never be determined, because the
//!   contacts that are always present have more unknowns than there are equations.

mod withheld;

use withheld::Still;
pub use withheld::{Withheld, significant};

use crate::config::STANDARD_GRAVITY;
use crate::pipeline::Pipeline;
use crate::setup::{Setup, gravity_loads, nearest};
use crate::units;
use proprio_dynamics::model::{Limits, Model};
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, Determinacy, DynamicsError, FrameMotion, InverseDynamics, JointState, Kinematics,
    Solver,
};
use proprio_identification::robot::BaseMotion;
use std::fmt;

/// Largest credible gravity load of a limb, stretched out, as a multiple of its joint's effort
/// limit. It is above one because no posture has all lengths in one line.
const HOLDS: f64 = 10.0;

/// A robot whose joints move by more while its posture is read does not stand still \[rad or m\]:
/// more than noise, and a hundredth of a limb's load.
const MOVED: f64 = 0.01;

/// The plausibility figures.
#[derive(Clone, Debug)]
pub struct Check {
    /// Mass of all links \[kg\].
    pub mass: f64,
    /// The posture, and what holds the robot, in words.
    pub posture: String,
    /// Per F/T sensor, its load at rest.
    pub sensors: Vec<AtRest>,
    /// What is withheld at rest.
    pub withheld: Withheld,
    /// Why nothing can be identified on-line although it is configured.
    pub refused: Option<String>,
    /// Joints that could not hold their limb: the name, the gravity load of the limb, stretched
    /// out, and the effort limit [Nm or N].
    pub overloaded: Vec<(String, f64, f64)>,
    /// Joints whose torque cannot be determined while all always present contacts are there.
    pub undetermined: Vec<String>,
    /// The always present contacts of the sub-trees with such joints.
    pub hiding: Vec<String>,
}

/// The load of an F/T sensor at rest.
#[derive(Clone, Debug)]
pub struct AtRest {
    /// Its channel.
    pub name: String,
    /// Mass of the links beyond it, seen from the root \[kg\].
    pub mass: f64,
    /// Its reading without offset, in its measurement frame.
    pub reading: Wrench,
    /// What it measures now, calibrated, if the posture is that of a running robot.
    pub measured: Option<Wrench>,
    /// Its offset, if it is known.
    pub offset: Option<Wrench>,
}

/// A posture of the robot.
#[derive(Clone, Debug)]
pub struct Posture {
    /// Per degree of freedom, its position \[rad or m\]; NaN: its locked position, else zero, or
    /// the nearest limit.
    position: Vec<f64>,
    measured: Option<PostureReadings>,
}

/// What a running robot measures in a posture.
#[derive(Clone, Debug)]
pub struct PostureReadings {
    /// Per F/T sensor, its reading.
    pub wrenches: Vec<Wrench>,
    /// The proper acceleration of the IMU at the base, in its axes \[m/s^2\].
    pub proper_acceleration: Option<Vec3>,
    /// By how much a joint moved meanwhile \[rad or m\].
    pub moved: f64,
}

impl Posture {
    /// The posture of a running robot: per degree of freedom the position \[rad or m\], NaN where
    /// nobody measures it.
    #[must_use]
    pub const fn measured(position: Vec<f64>, measured: PostureReadings) -> Self {
        Self {
            position,
            measured: Some(measured),
        }
    }

    /// No position is known.
    #[must_use]
    pub fn unknown(setup: &Setup) -> Self {
        Self {
            position: vec![f64::NAN; setup.robot.model.dof_count()],
            measured: None,
        }
    }

    /// Reads `JOINT=POSITION` \[rad or m\], once for each joint that is not at zero.
    ///
    /// # Errors
    /// A text: what is wrong, and what is allowed.
    pub fn parse(setup: &Setup, given: &[String]) -> Result<Self, String> {
        let mut posture = Self::unknown(setup);
        for text in given {
            let (name, number) = text.split_once('=').ok_or_else(|| {
                format!("--at {text}: give a joint and its position: l_elbow=1.2")
            })?;
            let name = name.trim();
            let dof = setup.robot.joint_names().position(|own| own == name);
            let dof = dof.ok_or_else(|| {
                let names = nearest(name, setup.robot.joint_names());
                format!("--at {text}: {name:?} is not a moving joint of the URDF{names}")
            })?;
            let position: Option<f64> = number.trim().parse().ok();
            let position = position
                .filter(|position| position.is_finite())
                .ok_or_else(|| format!("--at {text}: {number:?} must be a number [rad or m]"))?;
            units::angle(&format!("--at {name}"), position)?;
            if let Some(place) = posture.position.get_mut(dof) {
                *place = position;
            }
        }
        Ok(posture)
    }
}

impl Check {
    /// The figures of a configuration.
    ///
    /// # Errors
    /// Never with a [`Setup`] from its own constructors.
    pub fn of(setup: &Setup, posture: &Posture) -> Result<Self, DynamicsError> {
        let pipeline = Pipeline::new(setup.clone());
        let refused = pipeline.identification_refused().map(ToString::to_string);
        // Then everything is as without identification: stated offsets are used.
        let mut setup = setup.clone();
        setup.identifies &= refused.is_none();
        let setup = &setup;
        let model = &setup.initial.model;
        let mut position = positions(
            setup,
            |limits| 0.0_f64.clamp(limits.lower, limits.upper),
            0.0,
        );
        for (place, given) in position.iter_mut().zip(&posture.position) {
            if given.is_finite() {
                *place = *given;
            }
        }
        let hold = Hold::new(setup, posture.measured.as_ref());
        let start = at_rest(model, &position, hold.known, &hold.motion)?;
        let kinematics = at_rest(model, &position, hold.link, start.motion(hold.link))?;
        let mut dynamics = InverseDynamics::new(model);
        dynamics.update(model, &kinematics, &[])?;
        let cuts = setup.robot.structure.sensors().iter();
        let loads: Vec<Wrench> = cuts
            .map(|cut| cut.reading(&dynamics.transmitted(&kinematics, cut.joint())))
            .collect();
        let (undetermined, hiding) = undetermined(setup)?;
        Ok(Self {
            mass: model.inertias().iter().map(|body| body.mass).sum(),
            posture: format!(
                "{}; held at rest by {}, {}; no contacts",
                posture_words(setup, posture, &position),
                model.link_name(hold.link),
                hold.words
            ),
            sensors: sensors_at_rest(setup, posture, &loads),
            withheld: Withheld::of(
                setup,
                &Still {
                    base: *kinematics.motion(setup.robot.base_link),
                    position,
                    declared: hold.declared,
                    loads,
                },
            ),
            refused,
            overloaded: overloaded(model),
            hiding,
            undetermined,
        })
    }

    /// The problem and what to do about it; none if there is no problem.
    #[must_use]
    pub fn problem(&self) -> Option<String> {
        (!self.undetermined.is_empty()).then(|| {
            format!(
                "the torque of {} can never be determined: the contacts {} are always present \
                 unless declared absent, and their wrenches have more unknowns than the six \
                 equations of the sub-tree; give all but one presence = \"possible\", or a kind \
                 with fewer unknowns, or put an F/T sensor between them",
                self.undetermined.join(", "),
                self.hiding.join(", ")
            )
        })
    }
}

/// How the robot is held at rest.
struct Hold {
    /// The link where gravity is known, and its motion.
    known: usize,
    motion: FrameMotion,
    /// The link by which the robot is held.
    link: usize,
    /// Gravity, in words.
    words: String,
    /// The contact that is declared to be present.
    declared: Option<usize>,
}

impl Hold {
    fn new(setup: &Setup, measured: Option<&PostureReadings>) -> Self {
        let upright = upright();
        let at = |link, motion, declared| Self {
            known: link,
            motion,
            link,
            words: gravity_words(&motion),
            declared,
        };
        let base = setup.robot.base_link;
        match &setup.robot.base {
            BaseMotion::Imu(x_li) => {
                let measured = measured.and_then(|measured| measured.proper_acceleration);
                let (known, motion) = measured.map_or((0, upright), |proper| {
                    let imu = FrameMotion::standing(&-proper);
                    (base, FrameMotion::of_link_from_imu(&imu, x_li))
                });
                let words = match measured {
                    Some(_) => "gravity as the IMU measures it",
                    None => "the root link's z axis up",
                };
                Self {
                    known,
                    motion,
                    link: support(setup).unwrap_or(0),
                    words: words.to_owned(),
                    declared: None,
                }
            }
            BaseMotion::Standing(motion) => at(base, *motion, None),
            BaseMotion::Stance(stances) => match stances.first() {
                Some(stance) => at(stance.link, stance.motion, Some(stance.contact)),
                None => at(0, upright, None),
            },
        }
    }
}

/// The motion of a link at rest whose z axis points up.
fn upright() -> FrameMotion {
    FrameMotion::standing(&Vec3::new(0.0, 0.0, -STANDARD_GRAVITY))
}

/// The robot at rest, whose link `base` has this motion.
fn at_rest(
    model: &Model,
    position: &[f64],
    base: usize,
    motion: &FrameMotion,
) -> Result<Kinematics, DynamicsError> {
    let still = vec![0.0; model.dof_count()];
    let state = JointState {
        position,
        velocity: &still,
        acceleration: &still,
    };
    let mut kinematics = Kinematics::new(model, base)?;
    kinematics.update(model, state, motion)?;
    Ok(kinematics)
}

/// Per F/T sensor, its load at rest, beside what it measures.
fn sensors_at_rest(setup: &Setup, posture: &Posture, loads: &[Wrench]) -> Vec<AtRest> {
    let model = &setup.initial.model;
    let mut beyond: Vec<f64> = model.inertias().iter().map(|body| body.mass).collect();
    for joint in model.joints().iter().rev() {
        beyond[joint.parent] += beyond[joint.child];
    }
    let measured = |number: usize| {
        let raw = posture.measured.as_ref()?.wrenches.get(number)?;
        let calibration = setup.initial.calibrations.get(number)?;
        Some(calibration.apply(raw, f64::NAN))
    };
    let cuts = setup.robot.structure.sensors().iter().zip(loads);
    let named = cuts.zip(setup.robot.sensor_names()).enumerate();
    let sensors = named.map(|(number, ((cut, load), name))| AtRest {
        name: name.to_owned(),
        mass: beyond[cut.joint() + 1],
        reading: *load,
        measured: measured(number),
        offset: setup.known_offset(number),
    });
    sensors.collect()
}

/// Joints that could not hold their limb ([`Check::overloaded`]).
fn overloaded(model: &Model) -> Vec<(String, f64, f64)> {
    let loads = gravity_loads(model).into_iter().enumerate();
    let overloaded = loads.filter_map(|(dof, load)| {
        let effort = model.effort(model.dof_joint(dof)?)?;
        (load > HOLDS * effort).then(|| (model.dof_name(dof).to_owned(), load, effort))
    });
    overloaded.collect()
}

/// The joints whose torque can never be determined, and the contacts that hide it.
fn undetermined(setup: &Setup) -> Result<(Vec<String>, Vec<String>), DynamicsError> {
    let (model, robot) = (&setup.initial.model, &setup.robot);
    let structure = &robot.structure;
    // A general posture: where axes are aligned, the result would be a special case.
    let somewhere = |limits: Limits| limits.lower + 0.618 * (limits.upper - limits.lower);
    let kinematics = at_rest(model, &positions(setup, somewhere, 0.7), 0, &upright())?;
    let mut solver = Solver::new(structure);
    let nothing = vec![Wrench::zero(); structure.sensors().len()];
    solver.solve(model, structure, &kinematics, &nothing, &robot.always, &[])?;
    let certainty = solver.torque_certainty();
    let subtree_of = |dof: usize| structure.subtree_of(structure.link_of(dof)?);
    let subtrees = structure.subtrees();
    // Sub-trees without an F/T sensor are not expected to give torques.
    let is_measured =
        |dof| subtree_of(dof).is_some_and(|number| !subtrees[number].sensors.is_empty());
    let lost: Vec<usize> = (0..model.dof_count())
        .filter(|&dof| robot.locked[dof].is_nan() && certainty[dof] == Determinacy::Assumed)
        .filter(|&dof| is_measured(dof))
        .collect();
    let hiding = subtrees.iter().enumerate();
    let hiding =
        hiding.filter(|(number, _)| lost.iter().any(|dof| subtree_of(*dof) == Some(*number)));
    let hiding =
        hiding.flat_map(|(_, subtree)| subtree.contacts.intersection(&robot.always).iter());
    Ok((
        lost.iter()
            .map(|dof| model.dof_name(*dof).to_owned())
            .collect(),
        hiding
            .map(|contact| robot.contact_label(contact).to_owned())
            .collect(),
    ))
}

/// Positions of all degrees of freedom: the locked position; else `within` of the limits; else,
/// without limits, `without`.
fn positions(setup: &Setup, within: impl Fn(Limits) -> f64, without: f64) -> Vec<f64> {
    let mut positions = setup.robot.locked.clone();
    let model = &setup.initial.model;
    for (dof, position) in positions.iter_mut().enumerate() {
        if position.is_nan() {
            let limits = model.dof_joint(dof).and_then(|joint| model.limits(joint));
            let limits = limits.filter(|limits| limits.upper > limits.lower);
            *position = limits.map_or(without, &within);
        }
    }
    positions
}

/// The link at which a robot with an IMU is held: that of the first contact that is always present
/// and carries any load.
fn support(setup: &Setup) -> Option<usize> {
    let contacts = setup.robot.always.iter();
    let mut specs = contacts.filter_map(|contact| setup.robot.structure.contacts().get(contact));
    let spec = specs.find(|spec| spec.kind == ContactKind::Wrench)?;
    Some(spec.frame.link)
}

/// Gravity in the axes of a link at rest, in words.
fn gravity_words(motion: &FrameMotion) -> String {
    let [x, y, z]: [f64; 3] = rounded(-motion.proper_acceleration).into();
    format!("gravity [{x}, {y}, {z}] m/s^2 in its axes")
}

/// Where the joints are, in words.
fn posture_words(setup: &Setup, posture: &Posture, position: &[f64]) -> String {
    let named = setup
        .robot
        .joint_names()
        .zip(position)
        .zip(&posture.position);
    let given: Vec<String> = named
        .filter(|(_, given)| given.is_finite())
        .map(|((name, position), _)| format!("{name} {}", (1e3 * position).round() / 1e3 + 0.0))
        .collect();
    match (&posture.measured, given.is_empty()) {
        (Some(measured), _) => {
            let moved = if measured.moved > MOVED {
                " (it moves, so what it measures is not at rest)"
            } else {
                ""
            };
            format!("of the running robot{moved}: {}", given.join(", "))
        }
        (None, true) => "joints at zero, or the nearest limit (--at JOINT=RAD)".to_owned(),
        (None, false) => format!("{}, others at zero or the nearest limit", given.join(", ")),
    }
}

/// Three numbers to a thousandth.
fn rounded(three: Vec3) -> Vec3 {
    // Adding 0.0 turns -0 into 0.
    three.map(|x| (1e3 * x).round() / 1e3 + 0.0)
}

/// A wrench, in words.
fn wrench(wrench: &Wrench) -> String {
    let [fx, fy, fz]: [f64; 3] = rounded(wrench.force).into();
    let [tx, ty, tz]: [f64; 3] = rounded(wrench.torque).into();
    format!("force [{fx}, {fy}, {fz}] N, torque [{tx}, {ty}, {tz}] Nm")
}

impl Check {
    fn write_withheld(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Withheld { reasons, largest } = &self.withheld;
        if reasons.is_empty() {
            write!(f, "withheld at rest in this posture: nothing")?;
        } else {
            writeln!(
                f,
                "withheld at rest in this posture, however well all channels work:"
            )?;
        }
        for (why, names) in reasons {
            writeln!(f, "  {}: {why}", names.join(", "))?;
        }
        if let Some((joint, std)) = largest {
            let valid = if reasons.is_empty() {
                ";"
            } else {
                "  all other torques:"
            };
            writeln!(f, "{valid} standard deviations up to {std:.3} Nm ({joint})")?;
        } else if reasons.is_empty() {
            writeln!(f)?;
        }
        Ok(())
    }
}

impl fmt::Display for Check {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "mass of all links: {:.3} kg", self.mass)?;
        writeln!(f, "posture: {}", self.posture)?;
        if !self.sensors.is_empty() {
            writeln!(f, "readings of the F/T sensors in it, without offsets:")?;
        }
        for sensor in &self.sensors {
            writeln!(
                f,
                "  {}: {}, from {:.3} kg beyond it",
                sensor.name,
                wrench(&sensor.reading),
                sensor.mass
            )?;
            if let Some(measured) = &sensor.measured {
                writeln!(f, "    measured now: {}", wrench(measured))?;
                writeln!(
                    f,
                    "    the difference: {}; if nothing touches the robot, it is the offset",
                    wrench(&(*measured - sensor.reading))
                )?;
            }
            match &sensor.offset {
                Some(offset) => writeln!(f, "    its offset in use: {}", wrench(offset))?,
                None => writeln!(f, "    its offset is not known")?,
            }
        }
        self.write_withheld(f)?;
        if let Some(why) = &self.refused {
            writeln!(f, "note: nothing can be identified on-line: {why}")?;
        }
        for (joint, load, effort) in &self.overloaded {
            writeln!(
                f,
                "note: {joint} has an effort limit of {effort} in the URDF, but the weight of its \
                 limb has a moment of up to {load:.1} Nm; check the units of both"
            )?;
        }
        Ok(())
    }
}
