//! What a configuration comes to, in numbers that somebody who knows the robot can compare with it
//! before anything runs: `estimator --check` prints it after the plan.
//!
//! - masses: of the whole robot, and beyond each F/T sensor;
//! - what the F/T sensors would read, offsets aside, with the robot held still by its root link,
//!   whose z axis is up, all joints at zero (or the limit nearest to it, or where they are locked),
//!   and nothing touching it;
//! - joints whose effort limit could not hold the limb beyond them: masses or limits in other units;
//! - torques of sub-trees with an F/T sensor that can never be determined, for contacts that are
//!   always present leave more unknown than the equations tell.

use crate::config::STANDARD_GRAVITY;
use crate::dynamics::{Certainty, DynamicsError, FrameMotion, InverseDynamics, JointState, Kinematics, Solver};
use crate::model::Limits;
use crate::setup::{Setup, gravity_loads};
use crate::spatial::{Vec3, Wrench};
use std::fmt;

/// The weight of a limb's links has this moment at the most, stretched out, of what its joint can
/// hold: the bound adds up lengths that no posture has all in one line.
const HOLDS: f64 = 10.0;

/// The numbers.
#[derive(Clone, Debug)]
pub struct Check {
    /// Of all links \[kg\].
    pub mass: f64,
    /// Per F/T sensor.
    pub sensors: Vec<AtRest>,
    /// Joints that could not hold their limb: the name, the moment of the limb's weight, stretched
    /// out, and the effort limit [Nm or N].
    pub overloaded: Vec<(String, f64, f64)>,
    /// Joints whose torque can not be determined while what is always present is.
    pub undetermined: Vec<String>,
    /// Contacts that are always present on a sub-tree that has such joints.
    pub hiding: Vec<String>,
}

/// What an F/T sensor carries at rest.
#[derive(Clone, Debug)]
pub struct AtRest {
    /// Its channel.
    pub name: String,
    /// Of the links beyond it, seen from the root \[kg\].
    pub mass: f64,
    /// What it would read without offset, in its measurement frame.
    pub reading: Wrench,
}

impl Check {
    /// Of a configuration.
    ///
    /// # Errors
    /// Not with a [`Setup`] that was built by its own constructors.
    pub fn of(setup: &Setup) -> Result<Self, DynamicsError> {
        let model = &setup.model;
        let bodies = model.inertias();
        let mut beyond: Vec<f64> = bodies.iter().map(|body| body.mass).collect();
        for joint in model.joints().iter().rev() {
            beyond[joint.parent] += beyond[joint.child];
        }
        let still = vec![0.0; model.dof_count()];
        let gravity = Vec3::new(0.0, 0.0, -STANDARD_GRAVITY);
        let pose = |position: &[f64]| -> Result<Kinematics, DynamicsError> {
            let mut kinematics = Kinematics::new(model, 0)?;
            let state = JointState {
                position,
                velocity: &still,
                acceleration: &still,
            };
            kinematics.update(model, state, &FrameMotion::standing(&gravity))?;
            Ok(kinematics)
        };
        let kinematics = pose(&positions(
            setup,
            |limits| 0.0_f64.clamp(limits.lower, limits.upper),
            0.0,
        ))?;
        let mut dynamics = InverseDynamics::new(model);
        dynamics.update(model, &kinematics, &[])?;
        let cuts = setup.structure.sensors().iter().zip(setup.sensor_names());
        let sensors = cuts.map(|(cut, name)| AtRest {
            name: name.to_owned(),
            mass: beyond[cut.joint() + 1],
            reading: cut.reading(&dynamics.transmitted(&kinematics, cut.joint())),
        });
        let sensors: Vec<AtRest> = sensors.collect();
        let loads = gravity_loads(model);
        let overloaded = model.joints().iter().enumerate().filter_map(|(number, joint)| {
            let (dof, effort) = (joint.dof?, model.effort(number)?);
            (loads[dof] > HOLDS * effort).then(|| (model.dof_name(dof).to_owned(), loads[dof], effort))
        });
        // In no particular posture: where axes meet, more can seem determined, or less.
        let somewhere = |limits: Limits| limits.lower + 0.618 * (limits.upper - limits.lower);
        let kinematics = pose(&positions(setup, somewhere, 0.7))?;
        let mut solver = Solver::new(&setup.structure);
        let nothing = vec![Wrench::zero(); sensors.len()];
        solver.solve(model, &setup.structure, &kinematics, &nothing, &setup.always, &[])?;
        let certainty = solver.torque_certainty();
        let subtree_of = |dof: usize| {
            let link = setup.structure.link_of(dof)?;
            setup.structure.subtree_of(link)
        };
        let subtrees = setup.structure.subtrees();
        // Who has no F/T sensor there wants no torques of it.
        let is_measured = |dof| subtree_of(dof).is_some_and(|number| !subtrees[number].sensors.is_empty());
        let lost: Vec<usize> = (0..model.dof_count())
            .filter(|&dof| setup.locked[dof].is_nan() && certainty[dof] == Certainty::Assumed)
            .filter(|&dof| is_measured(dof))
            .collect();
        let hiding = subtrees.iter().enumerate();
        let hiding = hiding.filter(|(number, _)| lost.iter().any(|dof| subtree_of(*dof) == Some(*number)));
        let hiding = hiding.flat_map(|(_, subtree)| subtree.contacts.intersection(&setup.always).iter());
        Ok(Self {
            mass: bodies.iter().map(|body| body.mass).sum(),
            sensors,
            overloaded: overloaded.collect(),
            hiding: hiding.map(|contact| setup.contact_label(contact).to_owned()).collect(),
            undetermined: lost.into_iter().map(|dof| model.dof_name(dof).to_owned()).collect(),
        })
    }

    /// Why it can not be what is meant, and what to do; none if it can.
    #[must_use]
    pub fn problem(&self) -> Option<String> {
        (!self.undetermined.is_empty()).then(|| {
            format!(
                "the torque of {} can never be determined while {} are present, as they always are \
                 unless declared absent: their wrenches are more than six equations tell; give all but \
                 one presence = \"possible\", or a kind with fewer unknowns, or put an F/T sensor \
                 between them",
                self.undetermined.join(", "),
                self.hiding.join(", ")
            )
        })
    }
}

/// Positions of all degrees of freedom: where they are locked, where `within` says of their limits,
/// else `without`.
fn positions(setup: &Setup, within: impl Fn(Limits) -> f64, without: f64) -> Vec<f64> {
    let mut positions = setup.locked.clone();
    for (number, joint) in setup.model.joints().iter().enumerate() {
        if let Some(dof) = joint.dof.filter(|&dof| positions[dof].is_nan()) {
            let limits = setup.model.limits(number).filter(|limits| limits.upper > limits.lower);
            positions[dof] = limits.map_or(without, &within);
        }
    }
    positions
}

impl fmt::Display for Check {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "mass of all links: {:.3} kg", self.mass)?;
        if !self.sensors.is_empty() {
            writeln!(
                f,
                "held still by the root link, its z axis up, joints at zero, nothing touching, \
                 F/T sensors would read, offsets aside:"
            )?;
        }
        for AtRest { name, mass, reading } in &self.sensors {
            // Without the sign of what is nothing.
            let list = |three: Vec3| three.map(|x| (1e3 * x).round() / 1e3 + 0.0);
            let ([fx, fy, fz], [tx, ty, tz]): ([f64; 3], [f64; 3]) =
                (list(reading.force).into(), list(reading.torque).into());
            writeln!(
                f,
                "  {name}: force [{fx}, {fy}, {fz}] N, torque [{tx}, {ty}, {tz}] Nm, of {mass:.3} kg beyond it"
            )?;
        }
        for (joint, load, effort) in &self.overloaded {
            writeln!(
                f,
                "note: {joint} has an effort limit of {effort} in the URDF, and a limb whose weight \
                 has a moment of up to {load:.1} Nm: one of the two is in other units"
            )?;
        }
        Ok(())
    }
}
