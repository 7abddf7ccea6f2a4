//! Plausibility figures of a configuration, for a person who knows the robot: `estimator --check`
//! prints them after the setup.
//!
//! - masses: of the whole robot, and beyond each F/T sensor;
//! - the readings of the F/T sensors without offsets, with the robot held at rest by its root link,
//!   whose z axis is up, all joints at zero (or the nearest limit, or their locked position), and
//!   without contacts;
//! - joints whose effort limit could not hold the limb beyond them: masses or limits are in other
//!   units;
//! - joints of sub-trees with an F/T sensor whose torque can never be determined, because the
//!   contacts that are always present have more unknowns than there are equations.

use crate::config::STANDARD_GRAVITY;
use crate::setup::{Setup, gravity_loads};
use proprio_dynamics::model::Limits;
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_dynamics::{
    Certainty, DynamicsError, FrameMotion, InverseDynamics, JointState, Kinematics, Solver,
};
use std::fmt;

/// Largest credible gravity load of a limb, stretched out, as a multiple of its joint's effort
/// limit. It is above one because no posture has all lengths in one line.
const HOLDS: f64 = 10.0;

/// The plausibility figures.
#[derive(Clone, Debug)]
pub struct Check {
    /// Mass of all links \[kg\].
    pub mass: f64,
    /// Per F/T sensor, its load at rest.
    pub sensors: Vec<AtRest>,
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
}

impl Check {
    /// The figures of a configuration.
    ///
    /// # Errors
    /// Never with a [`Setup`] from its own constructors.
    pub fn of(setup: &Setup) -> Result<Self, DynamicsError> {
        let model = &setup.state.model;
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
        let cuts = setup
            .robot
            .structure
            .sensors()
            .iter()
            .zip(setup.robot.sensor_names());
        let sensors = cuts.map(|(cut, name)| AtRest {
            name: name.to_owned(),
            mass: beyond[cut.joint() + 1],
            reading: cut.reading(&dynamics.transmitted(&kinematics, cut.joint())),
        });
        let sensors: Vec<AtRest> = sensors.collect();
        let loads = gravity_loads(model);
        let overloaded = model
            .joints()
            .iter()
            .enumerate()
            .filter_map(|(number, joint)| {
                let (dof, effort) = (joint.dof?, model.effort(number)?);
                (loads[dof] > HOLDS * effort)
                    .then(|| (model.dof_name(dof).to_owned(), loads[dof], effort))
            });
        // A general posture: where axes are aligned, the result would be a special case.
        let somewhere = |limits: Limits| limits.lower + 0.618 * (limits.upper - limits.lower);
        let kinematics = pose(&positions(setup, somewhere, 0.7))?;
        let mut solver = Solver::new(&setup.robot.structure);
        let nothing = vec![Wrench::zero(); sensors.len()];
        solver.solve(
            model,
            &setup.robot.structure,
            &kinematics,
            &nothing,
            &setup.robot.always,
            &[],
        )?;
        let certainty = solver.torque_certainty();
        let subtree_of = |dof: usize| {
            let link = setup.robot.structure.link_of(dof)?;
            setup.robot.structure.subtree_of(link)
        };
        let subtrees = setup.robot.structure.subtrees();
        // Sub-trees without an F/T sensor are not expected to give torques.
        let is_measured =
            |dof| subtree_of(dof).is_some_and(|number| !subtrees[number].sensors.is_empty());
        let lost: Vec<usize> = (0..model.dof_count())
            .filter(|&dof| setup.robot.locked[dof].is_nan() && certainty[dof] == Certainty::Assumed)
            .filter(|&dof| is_measured(dof))
            .collect();
        let hiding = subtrees.iter().enumerate();
        let hiding =
            hiding.filter(|(number, _)| lost.iter().any(|dof| subtree_of(*dof) == Some(*number)));
        let hiding = hiding
            .flat_map(|(_, subtree)| subtree.contacts.intersection(&setup.robot.always).iter());
        Ok(Self {
            mass: bodies.iter().map(|body| body.mass).sum(),
            sensors,
            overloaded: overloaded.collect(),
            hiding: hiding
                .map(|contact| setup.robot.contact_label(contact).to_owned())
                .collect(),
            undetermined: lost
                .into_iter()
                .map(|dof| model.dof_name(dof).to_owned())
                .collect(),
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

/// Positions of all degrees of freedom: the locked position; else `within` of the limits; else,
/// without limits, `without`.
fn positions(setup: &Setup, within: impl Fn(Limits) -> f64, without: f64) -> Vec<f64> {
    let mut positions = setup.robot.locked.clone();
    for (number, joint) in setup.state.model.joints().iter().enumerate() {
        if let Some(dof) = joint.dof.filter(|&dof| positions[dof].is_nan()) {
            let limits = setup
                .state
                .model
                .limits(number)
                .filter(|limits| limits.upper > limits.lower);
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
                "readings of the F/T sensors without offsets, robot held at rest by the root link \
                 (z axis up), joints at zero, no contacts:"
            )?;
        }
        for AtRest {
            name,
            mass,
            reading,
        } in &self.sensors
        {
            // Adding 0.0 turns -0 into 0.
            let list = |three: Vec3| three.map(|x| (1e3 * x).round() / 1e3 + 0.0);
            let ([fx, fy, fz], [tx, ty, tz]): ([f64; 3], [f64; 3]) =
                (list(reading.force).into(), list(reading.torque).into());
            writeln!(
                f,
                "  {name}: force [{fx}, {fy}, {fz}] N, torque [{tx}, {ty}, {tz}] Nm, from \
                 {mass:.3} kg beyond it"
            )?;
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
