//! What F/T sensors can tell of the torques at all, from the closed form: any motion, for ever.
//!
//! ```text
//! t . x = sum_k t_k b_k + sum_e (t_e - sum_k t_k c_ke) x_e        b_k = x_k + sum_e c_ke x_e
//! ```
//!
//! `x` are the links' parameters and the sensors' offsets, `t` the row of a torque in a state,
//! `b_k` the base parameters ([`BaseParameter`]), `x_e` the parameters that they eliminate. So a
//! torque rests on the `b_k` with a factor `t_k`, and on CAD for ever where the factor of an `x_e`
//! is not zero. If all `b_k` are known, the error of `x` is in the null space `N`: `x = N a`, and
//! CAD alone tells `a`, with the covariance `N (N^T P^-1 N)^-1 N^T`.
//!
//! Gains of the sensors are taken as right, and readings as exact.

use crate::workspace::{Deviation, MotionState, Puppet, UPRIGHT, Workspace, range};
use nalgebra::{DMatrix, SMatrix};
use proprio_dynamics::DynamicsError;
use proprio_dynamics::calibration::UNKNOWN_OFFSET;
use proprio_dynamics::regressor::LINK_PARAMETERS;
use proprio_dynamics::regressor::identifiable::{
    BaseParameter, BaseRegime, Identifiable, JointMotion, Measurement, Offsets, ParameterColumn,
    Regime, Scope,
};
use proprio_dynamics::spatial::Vec3;
use proprio_identification::forecast::{Forecast, ForecastError, SensorNoise};
use proprio_identification::prior::link_cad_root;
use proprio_identification::{CovarianceRoot, Robot};
use proprio_topics::Nanos;

/// Factors below this, relative to the largest, are rounding errors.
const ROUNDING: f64 = 1e-7;

/// Links are named that have at least this share of what remains uncertain of a torque.
const SHARE: f64 = 0.05;

/// What is known if everything identifiable is.
#[derive(Clone, Debug)]
pub struct Knowledge {
    /// Number of unknowns: ten parameters per link and six offsets per sensor.
    pub unknowns: usize,
    /// Number of identified combinations.
    pub rank: usize,
    /// The identified combinations.
    pub base_parameters: Vec<BaseParameter>,
    /// Each torque.
    pub torques: Vec<TorqueKnowledge>,
}

/// What is known of a torque.
#[derive(Clone, Debug, PartialEq)]
pub struct TorqueKnowledge {
    /// The degree of freedom.
    pub dof: usize,
    /// Standard deviation from CAD alone, where the sensors were read for a second with the robot
    /// at rest [Nm or N]; none if contacts leave the torque undetermined.
    pub cad: Option<f64>,
    /// The same if everything identifiable is known.
    pub identified: Option<f64>,
    /// The base parameters that it rests on, by their number.
    pub rests_on: Vec<usize>,
    /// The links whose CAD it rests on for ever, with the standard deviation that each of them
    /// alone causes [Nm or N], the largest first.
    pub assumed: Vec<(usize, f64)>,
    /// The F/T sensors whose offset it rests on without a chance to identify it.
    pub offsets: Vec<usize>,
}

/// The regime of a robot that works: all joints move, contacts that always are there are there.
#[must_use]
pub fn regime(robot: &Robot) -> Regime {
    Regime {
        contacts: robot.always,
        ..robot.regime()
    }
}

/// The regime in which nothing moves but these joints: the others stay in the middle of their
/// ranges. A base with an IMU stands.
#[must_use]
pub fn only(robot: &Robot, moving: &[usize]) -> Regime {
    let mut regime = regime(robot);
    if regime.motion == BaseRegime::Free {
        let gravity = Vec3::from(UPRIGHT);
        regime.motion = BaseRegime::Fixed(gravity);
        regime.base = 0;
    }
    for (dof, motion) in regime.joints.iter_mut().enumerate() {
        if *motion == JointMotion::Moving && !moving.contains(&dof) {
            *motion = JointMotion::Locked(range(&robot.model, dof).middle());
        }
    }
    regime
}

fn identifiable(robot: &Robot, regime: &Regime) -> Result<Identifiable, DynamicsError> {
    let scope = Scope::SubTrees(&robot.structure);
    Identifiable::new(
        &robot.model,
        scope,
        regime,
        Measurement::Wrench,
        Offsets::Unknown,
    )
}

/// Per torque of a workspace, its deviation if everything is known that is identifiable in a
/// regime.
///
/// # Errors
/// There is no closed form ([`Identifiable::new`]).
pub fn limit(
    robot: &Robot,
    regime: &Regime,
    workspace: &Workspace,
) -> Result<Vec<Deviation>, DynamicsError> {
    Ok(workspace.deviations(robot, &remaining(robot, &identifiable(robot, regime)?)))
}

/// The covariance that remains if everything identifiable is known.
fn remaining(robot: &Robot, subspace: &Identifiable) -> CovarianceRoot {
    let null = subspace.null();
    let columns = subspace.columns().to_vec();
    // W with W^T W = P^-1, of CAD and the offsets; an offset that appears nowhere is as configured.
    let mut weighted = null.clone();
    for (link, cad) in robot.model.inertias().iter().enumerate() {
        let first = LINK_PARAMETERS * link;
        let inverse = link_cad_root(cad, robot.urdf_relative_std)
            .transpose()
            .try_inverse();
        // Without an inverse CAD is exact.
        let inverse = inverse.unwrap_or_else(|| SMatrix::identity() * 1e12);
        let block = inverse * null.rows(first, LINK_PARAMETERS);
        weighted.rows_mut(first, LINK_PARAMETERS).copy_from(&block);
    }
    for (row, column) in columns.iter().enumerate() {
        if let ParameterColumn::Offset { sensor, component } = *column {
            let configured = robot.offsets[sensor].1[component];
            let is_free = subspace.basis().row(row).norm() < ROUNDING;
            let deviation = if is_free {
                configured
            } else {
                UNKNOWN_OFFSET[component]
            };
            let mut weighted_row = weighted.row_mut(row);
            weighted_row /= deviation.max(1e-9);
        }
    }
    // Columns in their own units, which differ by orders of magnitude.
    let norms: Vec<f64> = weighted.column_iter().map(|column| column.norm()).collect();
    let mut null = null;
    for (k, norm) in norms.iter().enumerate() {
        let norm = norm.max(f64::MIN_POSITIVE);
        weighted.column_mut(k).unscale_mut(norm);
        null.column_mut(k).unscale_mut(norm);
    }
    let count = null.ncols();
    let root = (weighted.qr().r()).solve_upper_triangular(&DMatrix::identity(count, count));
    CovarianceRoot {
        columns,
        calibrations: Vec::new(),
        root: null * root.unwrap_or_else(|| DMatrix::zeros(count, count)),
    }
}

/// The covariance of CAD where each F/T sensor was read for a second with the robot at rest.
///
/// # Errors
/// [`ForecastError`], without [`ForecastError::Nothing`]: then nothing but CAD and the configured
/// offsets is known.
pub fn at_rest(
    robot: &Robot,
    noise: &[SensorNoise],
    known: Option<&CovarianceRoot>,
) -> Result<CovarianceRoot, ForecastError> {
    let mut state = MotionState::at_rest(robot.position_without_samples());
    for (dof, position) in state.position.iter_mut().enumerate() {
        if robot.locked[dof].is_nan() {
            *position = range(&robot.model, dof).middle();
        }
    }
    let mut puppet = Puppet::new(robot)?;
    let observations =
        (0..10).map(|k| puppet.observe(Nanos::from_seconds(0.1 * f64::from(k)), &state));
    let observations = observations.collect::<Result<Vec<_>, _>>()?;
    match Forecast::new(robot, &observations, 0.1, noise, known) {
        Ok(forecast) => forecast.after(observations),
        Err(ForecastError::Nothing) => Ok(CovarianceRoot::default()),
        Err(error) => Err(error),
    }
}

impl Knowledge {
    /// Of a robot in a regime.
    ///
    /// # Errors
    /// There is no closed form for its contacts ([`Identifiable::new`]), or CAD cannot be used.
    pub fn of(
        robot: &Robot,
        regime: &Regime,
        workspace: &Workspace,
    ) -> Result<Self, ForecastError> {
        let subspace = identifiable(robot, regime)?;
        let base_parameters = subspace.base_parameters();
        let cad = workspace.deviations(robot, &at_rest(robot, &SensorNoise::stated(robot), None)?);
        let end = workspace.deviations(robot, &remaining(robot, &subspace));
        let spreads: Vec<_> = (robot.model.inertias().iter())
            .map(|cad| link_cad_root(cad, robot.urdf_relative_std).transpose())
            .collect();
        let torque = |((dof, rows), (cad, end)): ((usize, Option<&DMatrix<f64>>), _)| {
            let (cad, end): (&Deviation, &Deviation) = (cad, end);
            let mut torque = TorqueKnowledge {
                dof,
                cad: cad.torque,
                identified: end.torque,
                rests_on: Vec::new(),
                assumed: Vec::new(),
                offsets: Vec::new(),
            };
            let Some(rows) = rows else {
                return torque;
            };
            let mut left = rows.clone();
            let largest = rows.amax();
            for (number, base) in base_parameters.iter().enumerate() {
                let factors = rows.column(base.kept.column);
                if factors.amax() > ROUNDING * largest {
                    torque.rests_on.push(number);
                }
                left.column_mut(base.kept.column).fill(0.0);
                for term in &base.terms {
                    let mut column = left.column_mut(term.column);
                    column -= factors * term.coefficient;
                }
            }
            for (link, spread) in spreads.iter().enumerate() {
                let block = left.columns(LINK_PARAMETERS * link, LINK_PARAMETERS) * spread;
                let deviation = block.norm() / (rows.nrows().max(1) as f64).sqrt();
                torque.assumed.push((link, deviation));
            }
            let largest_left = end.torque.unwrap_or_default().max(ROUNDING);
            torque
                .assumed
                .retain(|(_, deviation)| *deviation > SHARE * largest_left);
            torque.assumed.sort_by(|a, b| b.1.total_cmp(&a.1));
            let first = LINK_PARAMETERS * spreads.len();
            let hidden =
                |sensor: &usize| left.columns(first + 6 * sensor, 6).amax() > ROUNDING * largest;
            torque.offsets = (0..robot.structure.sensors().len())
                .filter(hidden)
                .collect();
            torque
        };
        let torques = workspace
            .torques()
            .zip(cad.iter().zip(&end))
            .map(torque)
            .collect();
        Ok(Self {
            unknowns: subspace.columns().len(),
            rank: subspace.rank(),
            base_parameters,
            torques,
        })
    }
}
