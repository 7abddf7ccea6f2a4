//! The states at which torques are wanted, and the deviations of the torques there.
//!
//! The rows `T` of the torques ([`EstimateRows`]) carry a covariance of parameters, offsets and
//! gains to them, `T P T^T`. Noise of a single reading is not included: no motion lessens it.

use fastrand::Rng;
use nalgebra::{DMatrix, DVector};
use proprio_dynamics::calibration::Unknown;
use proprio_dynamics::model::{Limits, Model};
use proprio_dynamics::regressor::identifiable::ParameterColumn;
use proprio_dynamics::regressor::{EstimateRows, LINK_PARAMETERS};
use proprio_dynamics::spatial::{Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, Determinacy, DynamicsError, FrameMotion, InverseDynamics, JointState, Kinematics,
    Solver,
};
use proprio_identification::dataset::observation::Observation;
use proprio_identification::prior::link_cad_root;
use proprio_identification::robot::BaseMotion;
use proprio_identification::{CovarianceRoot, Robot};
use proprio_topics::{Nanos, Reason};
use std::f64::consts::PI;

/// Physical gravity in the root link, where an IMU has not measured it yet [m/s^2].
pub(crate) const UPRIGHT: [f64; 3] = [0.0, 0.0, -9.80665];

/// The seed of the states.
const SEED: u64 = 1;

/// A joint without velocity limit moves as fast as this in the workspace [rad/s or m/s].
const SPEED: [f64; 2] = [2.0, 0.3];

/// A joint reaches its velocity limit within this time \[s\].
pub const RISE: f64 = 0.5;

/// Positions, velocities and accelerations of all joints, by degree of freedom.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MotionState {
    /// [rad or m]
    pub position: Vec<f64>,
    /// [rad/s or m/s]
    pub velocity: Vec<f64>,
    /// [rad/s^2 or m/s^2]
    pub acceleration: Vec<f64>,
}

impl MotionState {
    /// At rest at this position.
    pub(crate) fn at_rest(position: Vec<f64>) -> Self {
        let still = vec![0.0; position.len()];
        Self {
            position,
            velocity: still.clone(),
            acceleration: still,
        }
    }

    pub(crate) fn joints(&self) -> JointState<'_> {
        JointState {
            position: &self.position,
            velocity: &self.velocity,
            acceleration: &self.acceleration,
        }
    }
}

/// The degrees of freedom that move and of which the torque is published.
pub fn measured(robot: &Robot) -> impl Iterator<Item = usize> {
    robot.published().filter(|&dof| robot.locked[dof].is_nan())
}

/// The range of a joint in the URDF; where it has none a whole turn, or 0.3 m to either side.
#[must_use]
pub fn range(model: &Model, dof: usize) -> Limits {
    let joint = model.dof_joint(dof).unwrap_or_default();
    let half = if model.is_prismatic(dof) { 0.3 } else { PI };
    let limits = model.limits(joint).filter(|own| own.upper > own.lower);
    limits.unwrap_or(Limits {
        lower: -half,
        upper: half,
    })
}

/// A robot that moves as it is told, with CAD's inertias.
#[derive(Clone)]
pub struct Puppet<'a> {
    robot: &'a Robot,
    kinematics: Kinematics,
    dynamics: InverseDynamics,
}

impl<'a> Puppet<'a> {
    /// Of this robot.
    ///
    /// # Errors
    /// Its base link does not exist.
    pub fn new(robot: &'a Robot) -> Result<Self, DynamicsError> {
        Ok(Self {
            robot,
            kinematics: Kinematics::new(&robot.model, robot.base_link)?,
            dynamics: InverseDynamics::new(&robot.model),
        })
    }

    /// What would be observed in a state: no contacts but those that carry the robot, and CAD's
    /// readings.
    ///
    /// # Errors
    /// The state is of another robot, or not finite.
    pub fn observe(&mut self, t: Nanos, state: &MotionState) -> Result<Observation, DynamicsError> {
        let (robot, model) = (self.robot, &self.robot.model);
        let mut active = robot.always;
        let carrying = || {
            let mut contacts = robot.always.iter();
            let specs = robot.structure.contacts();
            contacts.find_map(|contact| {
                let spec = specs.get(contact)?;
                (spec.kind == ContactKind::Wrench).then_some(spec.frame.link)
            })
        };
        let (base_link, known, motion, held) = match &robot.base {
            BaseMotion::Standing(motion) => {
                let link = robot.base_link;
                (link, link, *motion, link)
            }
            BaseMotion::Stance(stances) => {
                stances
                    .iter()
                    .take(1)
                    .for_each(|stance| active.insert(stance.contact));
                let (link, motion, _) = robot.base_motion(&active);
                (link, link, motion, link)
            }
            BaseMotion::Imu(_) => {
                let motion = FrameMotion::standing(&Vec3::from(UPRIGHT));
                let link = robot.base_link;
                (link, 0, motion, carrying().unwrap_or(link))
            }
        };
        let joints = state.joints();
        self.kinematics.set_base(model, known)?;
        self.kinematics.update(model, joints, &motion)?;
        let base = *self.kinematics.motion(base_link);
        let of_held = *self.kinematics.motion(held);
        self.kinematics.set_base(model, held)?;
        self.kinematics.update(model, joints, &of_held)?;
        self.dynamics.update(model, &self.kinematics, &[])?;
        let reading = |cut: &proprio_dynamics::SensorCut| {
            cut.reading(&self.dynamics.transmitted(&self.kinematics, cut.joint()))
        };
        Ok(Observation {
            t,
            position: state.position.clone(),
            velocity: state.velocity.clone(),
            acceleration: state.acceleration.clone(),
            torque: vec![f64::NAN; model.dof_count()],
            base_link,
            base,
            readings: robot.structure.sensors().iter().map(reading).collect(),
            active,
            faults: vec![Reason::None; robot.channels.len()],
            base_fault: Reason::None,
            temperatures: Vec::new(),
        })
    }

    /// The poses of the last observation.
    #[must_use]
    pub fn kinematics(&self) -> &Kinematics {
        &self.kinematics
    }
}

/// Positions within the limits, and velocities and accelerations of lively motion.
fn states(robot: &Robot, count: usize) -> Vec<MotionState> {
    let mut rng = Rng::with_seed(SEED);
    let model = &robot.model;
    let dofs = model.dof_count();
    let still = robot.position_without_samples();
    let mut state = || {
        let mut state = MotionState::at_rest(still.clone());
        for dof in 0..dofs {
            let mut within = |low: f64, high: f64| low + (high - low) * rng.f64();
            let Limits { lower, upper } = range(model, dof);
            let joint = model.dof_joint(dof).unwrap_or_default();
            let usual = SPEED[usize::from(model.is_prismatic(dof))];
            let speed = model.velocity(joint).unwrap_or(usual).min(usual) / 2.0;
            let drawn = [
                within(lower, upper),
                within(-speed, speed),
                within(-speed, speed) / RISE,
            ];
            if robot.locked[dof].is_nan() {
                [
                    state.position[dof],
                    state.velocity[dof],
                    state.acceleration[dof],
                ] = drawn;
            }
        }
        state
    };
    (0..count).map(|_| state()).collect()
}

/// The rows of the torques at some states.
pub struct Workspace {
    /// Per torque its rows over `10 N_B` parameters and six offsets per sensor, a row per state;
    /// none if contacts leave it undetermined.
    torques: Vec<(usize, Option<DMatrix<f64>>)>,
    /// Per state and sensor, CAD's reading.
    readings: Vec<Vec<Wrench>>,
    links: usize,
}

impl Workspace {
    /// Of the torques that the estimator publishes, at `count` random states.
    ///
    /// # Errors
    /// The robot's parts do not fit together.
    pub fn new(robot: &Robot, count: usize) -> Result<Self, DynamicsError> {
        let (model, structure) = (&robot.model, &robot.structure);
        let mut puppet = Puppet::new(robot)?;
        let mut solver = Solver::new(structure);
        let columns = LINK_PARAMETERS * model.link_count() + 6 * structure.sensors().len();
        let mut torques: Vec<(usize, Option<DMatrix<f64>>)> = measured(robot)
            .map(|dof| (dof, Some(DMatrix::zeros(count, columns))))
            .collect();
        let mut readings = Vec::new();
        let mut row = vec![0.0; columns];
        for (number, state) in states(robot, count).iter().enumerate() {
            let seen = puppet.observe(Nanos::ZERO, state)?;
            let (kinematics, active) = (puppet.kinematics(), &seen.active);
            solver.solve(model, structure, kinematics, &seen.readings, active, &[])?;
            let rows = EstimateRows::new(structure, &solver, kinematics)?;
            for (dof, torque) in &mut torques {
                let is_determined = rows.torque_subtree(*dof).is_some()
                    && solver.torque_certainty()[*dof] != Determinacy::Assumed;
                let (Some(matrix), true) = (torque.as_mut(), is_determined) else {
                    *torque = None;
                    continue;
                };
                rows.torque_row(*dof, &mut row)?;
                matrix.row_mut(number).copy_from_slice(&row);
            }
            readings.push(seen.readings);
        }
        Ok(Self {
            torques,
            readings,
            links: model.link_count(),
        })
    }

    /// The torques, by degree of freedom, each with its rows, a row per state, over all links'
    /// parameters and all sensors' offsets; without rows if contacts leave it undetermined.
    pub fn torques(&self) -> impl Iterator<Item = (usize, Option<&DMatrix<f64>>)> {
        self.torques.iter().map(|(dof, rows)| (*dof, rows.as_ref()))
    }

    /// These torques in the columns of a covariance. What the covariance does not contain has the
    /// uncertainty of CAD and of the configured offsets.
    pub(crate) fn in_columns(
        &self,
        robot: &Robot,
        columns: &[ParameterColumn],
        calibrations: &[(usize, Unknown)],
    ) -> TorqueRows {
        let of_offset = |sensor: usize| LINK_PARAMETERS * self.links + 6 * sensor;
        let place = |column: &ParameterColumn| match *column {
            ParameterColumn::Inertial { link, parameter } => LINK_PARAMETERS * link + parameter,
            ParameterColumn::Offset { sensor, component } => of_offset(sensor) + component,
        };
        let places: Vec<usize> = columns.iter().map(place).collect();
        let is_in = |column: usize| places.contains(&column);
        let torques = self.torques.iter().map(|(dof, rows)| {
            let Some(rows) = rows else {
                return (*dof, None);
            };
            let mut own = rows.select_columns(&places);
            let before = places.len();
            own = own.resize_horizontally(before + calibrations.len(), 0.0);
            for (at, &(sensor, unknown)) in calibrations.iter().enumerate() {
                for (state, readings) in self.readings.iter().enumerate() {
                    let reading = readings[sensor].torque_first();
                    own[(state, before + at)] = unknown.as_offset(&reading, 0.0)
                        * rows[(state, of_offset(sensor) + unknown.channel())];
                }
            }
            let mut rest = DVector::zeros(rows.nrows());
            for (link, cad) in robot.model.inertias().iter().enumerate() {
                let first = LINK_PARAMETERS * link;
                if !is_in(first) {
                    let root = link_cad_root(cad, robot.urdf_relative_std);
                    let spread = rows.columns(first, LINK_PARAMETERS) * root.transpose();
                    (0..rest.len()).for_each(|i| rest[i] += spread.row(i).norm_squared());
                }
            }
            for (sensor, (_, deviations)) in robot.offsets.iter().enumerate() {
                for (component, deviation) in deviations.iter().enumerate() {
                    let column = of_offset(sensor) + component;
                    if !is_in(column) {
                        let values = rows.column(column) * *deviation;
                        rest += values.component_mul(&values);
                    }
                }
            }
            (*dof, Some((own, rest)))
        });
        TorqueRows {
            torques: torques.collect(),
        }
    }

    /// The deviation of each torque for this covariance.
    #[must_use]
    pub fn deviations(&self, robot: &Robot, covariance: &CovarianceRoot) -> Vec<Deviation> {
        self.in_columns(robot, &covariance.columns, &covariance.calibrations)
            .deviations(&covariance.root)
    }
}

/// The standard deviation of a torque, as root mean square over the states.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Deviation {
    /// The degree of freedom.
    pub dof: usize,
    /// [Nm or N]; none if contacts leave the torque undetermined.
    pub torque: Option<f64>,
}

/// The torques in the columns of a covariance.
pub(crate) struct TorqueRows {
    torques: Vec<(usize, Option<Block>)>,
}

/// The rows of a torque, a row per state, and per state the variance of what the covariance does
/// not contain.
type Block = (DMatrix<f64>, DVector<f64>);

impl TorqueRows {
    /// The deviation of each torque for the covariance `root root^T`.
    pub(crate) fn deviations(&self, root: &DMatrix<f64>) -> Vec<Deviation> {
        let deviation = |(dof, rows): &(usize, Option<Block>)| {
            let torque = rows.as_ref().map(|(rows, rest)| {
                let square = (rows * root).norm_squared() + rest.sum();
                (square / rows.nrows().max(1) as f64).sqrt()
            });
            Deviation { dof: *dof, torque }
        };
        self.torques.iter().map(deviation).collect()
    }

    /// Keeps only the torques of these degrees of freedom that depend on the covariance.
    pub(crate) fn keep(&mut self, dofs: &[usize]) {
        let depends = |rows: &Option<Block>| {
            (rows.as_ref()).is_some_and(|(rows, _)| rows.iter().any(|x| *x != 0.0))
        };
        (self.torques).retain(|(dof, rows)| dofs.contains(dof) && depends(rows));
    }

    /// Whether there is none.
    pub(crate) fn is_empty(&self) -> bool {
        self.torques.is_empty()
    }
}
