//! The body that a link carries in some logs, and did not carry when the robot was identified: a
//! tool, a grasped object.
//!
//! ```text
//! y = A (d + E p) + v,   d ~ N(0, C),   v ~ N(0, R)
//! ```
//!
//! `p` are its ten parameters, `E` the columns of its link, `d` is the error of the identified
//! parameters with their covariance `C`. The prior of `p` is next to none ([`MASS`], [`SIZE`]).
//! What `d` explains is eliminated, so the covariance of `p` contains the uncertainty of the robot;
//! and that of the sensors' gains: every weight scales with them, and cross-talk turns moments.

use crate::dataset::Dataset;
use crate::diagnose::load::{Normal, body};
use crate::diagnose::undeclared;
use crate::finding::Finding;
use crate::fit::IdentifyError;
use crate::identify::{self, exclude_disturbed, plausible_model, prepare_logs};
use crate::prepared_log::training_instants;
use crate::robot::{IdentificationInput, Robot};
use nalgebra::{DMatrix, SMatrix, SVector};
use proprio_dynamics::model::Frame;
use proprio_dynamics::regressor::LINK_PARAMETERS;
use proprio_dynamics::spatial::{Mat3, Pose, RigidInertia, Vec3};
use std::ops::ControlFlow;

/// Standard deviation of a payload's mass \[kg\] and its size \[m\], before any data.
const MASS: f64 = 100.0;
const SIZE: f64 = 0.5;

type Square = SMatrix<f64, LINK_PARAMETERS, LINK_PARAMETERS>;

/// What is known about a robot before it takes a payload up.
#[derive(Clone, Debug)]
pub struct KnownParameters {
    /// The links whose parameters were identified. The model of the robot has these parameters.
    pub links: Vec<usize>,
    /// `U` of their covariance `U^T U`, ten columns per link.
    pub root: DMatrix<f64>,
    /// Per F/T sensor, the relative standard deviation of its gain.
    pub gains: Vec<f64>,
}

/// A payload, in the axes of the frame that carries it.
#[derive(Clone, Debug, PartialEq)]
pub struct Payload {
    /// Mass, first moment and tensor of inertia about the frame's origin.
    pub parameters: [f64; LINK_PARAMETERS],
    /// Their covariance.
    pub covariance: Square,
    /// Number of instants of the logs.
    pub instants: usize,
    /// What was found in the logs.
    pub findings: Vec<Finding>,
}

/// Why there is no payload.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PayloadError {
    /// The logs can not be used.
    #[error("{0}")]
    Unusable(String),
    /// No measurement in the logs contains the link.
    #[error("no measurement contains what {0} carries: no F/T sensor or joint torque is before it")]
    Unseen(String),
    /// A covariance is singular.
    #[error("the covariance of the robot's parameters, or what the logs tell, is singular")]
    Singular,
    /// As for [`crate::identify`].
    #[error(transparent)]
    Identify(#[from] IdentifyError),
}

/// Identifies what a frame of the robot carries in these logs.
///
/// `inputs`: as for [`crate::identify`]. `robot` has the parameters and calibrations that were
/// identified without the payload.
///
/// # Errors
/// [`PayloadError`].
pub fn payload(
    robot: &Robot,
    known: &KnownParameters,
    frame: &Frame,
    datasets: Vec<Dataset>,
    inputs: &[IdentificationInput],
) -> Result<Payload, PayloadError> {
    let name = || robot.model.link_name(frame.link).to_owned();
    let inputs = identify::chosen_inputs(robot, inputs);
    let mut logs = prepare_logs(robot, datasets);
    let measurement = match plausible_model(robot, &inputs, &mut logs)? {
        ControlFlow::Continue(measurement) => measurement,
        ControlFlow::Break((reason, _)) => return Err(PayloadError::Unusable(reason)),
    };
    let unknowns = measurement.unknowns();
    let index = unknowns.links.iter().position(|link| *link == frame.link);
    let index = index.ok_or_else(|| PayloadError::Unseen(name()))?;
    let clean = exclude_disturbed(&measurement, &mut logs, &mut |_, _| ())?;
    let estimate = clean.estimate;
    undeclared::report(&measurement, &mut logs, &clean.loads, &estimate);

    let mut some = Normal::new(unknowns.parameters());
    some.add(&estimate.information);
    let mut all = some.clone();
    let is_known = |link| known.links.contains(&link);
    // The scale of CAD's errors follows from links that are known, and says nothing of the others.
    let tau = estimate.fit.tau.max(estimate.prior.expected_tau());
    all.add_prior(&estimate.prior, unknowns, tau, &is_known);
    let precision = precision(known, &unknowns.links).ok_or(PayloadError::Singular)?;
    let mut of_links = all.matrix.view_mut((0, 0), precision.shape());
    of_links += &precision;
    let factor = all.matrix.cholesky().ok_or(PayloadError::Singular)?;
    let x = factor.solve(&all.right);
    let prior = Square::from_diagonal(&SVector::from_fn(|i, _| match i {
        0 => MASS.powi(-2),
        1..4 => (MASS * SIZE).powi(-2),
        _ => (MASS * SIZE * SIZE).powi(-2),
    }));
    let (added, _) = body(&prior, index, &some, &factor, &x).ok_or(PayloadError::Singular)?;
    let to_frame = frame.pose.inverse();
    let map = Square::from_columns(&std::array::from_fn::<_, LINK_PARAMETERS, _>(|column| {
        let mut unit = [0.0; LINK_PARAMETERS];
        unit[column] = 1.0;
        let of_frame = RigidInertia::from_parameters(&unit).transformed(&to_frame);
        SVector::from(of_frame.parameters())
    }));
    let parameters = map * added.parameters;
    let of_sensors = (unknowns.sensors.iter()).filter_map(|&sensor| known.gains.get(sensor));
    let off = of_sensors.copied().fold(0.0, f64::max);
    // All of it scales with the gain; cross-talk turns the first moment and the inertia.
    let gain = parameters * off;
    let size = |range: std::ops::Range<usize>| {
        let squares = parameters.as_slice()[range].iter().map(|x| x * x);
        off * squares.sum::<f64>().sqrt()
    };
    let (moment, inertia) = (size(1..4), size(4..10));
    let cross_talk = SVector::<f64, LINK_PARAMETERS>::from_fn(|i, _| match i {
        0 => 0.0,
        1..4 => moment * moment,
        _ => inertia * inertia,
    });
    Ok(Payload {
        parameters: parameters.into(),
        covariance: map * added.covariance * map.transpose()
            + gain * gain.transpose()
            + Square::from_diagonal(&cross_talk),
        instants: training_instants(&logs).count(),
        findings: logs.into_iter().flat_map(|log| log.findings).collect(),
    })
}

/// The inverse of the covariance of these links' parameters; zero for those that are not known.
fn precision(known: &KnownParameters, links: &[usize]) -> Option<DMatrix<f64>> {
    let mut columns = Vec::new();
    for (index, link) in links.iter().enumerate() {
        if let Some(at) = known.links.iter().position(|own| own == link) {
            columns.extend((0..LINK_PARAMETERS).map(|i| {
                let of_known = LINK_PARAMETERS * at + i;
                (LINK_PARAMETERS * index + i, of_known)
            }));
        }
    }
    // Scaled by the deviations, since kilograms and kg m^2 differ by decades.
    let of_known: Vec<usize> = columns.iter().map(|(_, column)| *column).collect();
    let mut root = known.root.select_columns(&of_known);
    let deviations: Vec<f64> = root.column_iter().map(|column| column.norm()).collect();
    for (mut column, deviation) in root.column_iter_mut().zip(&deviations) {
        column /= *deviation;
    }
    let inverse = root.tr_mul(&root).cholesky()?.inverse();
    let size = LINK_PARAMETERS * links.len();
    let mut precision = DMatrix::zeros(size, size);
    for (i, (row, _)) in columns.iter().enumerate() {
        for (j, (column, _)) in columns.iter().enumerate() {
            precision[(*row, *column)] = inverse[(i, j)] / (deviations[i] * deviations[j]);
        }
    }
    precision.iter().all(|x| x.is_finite()).then_some(precision)
}

impl Payload {
    fn inertia(&self) -> RigidInertia {
        RigidInertia::from_parameters(&self.parameters)
    }

    /// Mass and its standard deviation \[kg\].
    #[must_use]
    pub fn mass(&self) -> (f64, f64) {
        (self.parameters[0], self.covariance[(0, 0)].max(0.0).sqrt())
    }

    /// Whether it has a mass, beyond four deviations.
    #[must_use]
    pub fn is_significant(&self) -> bool {
        let (mass, deviation) = self.mass();
        mass.abs() > 4.0 * deviation
    }

    /// Centre of mass in the frame \[m\], and the standard deviation of each component.
    #[must_use]
    pub fn centre(&self) -> (Vec3, Vec3) {
        let centre = |inertia: RigidInertia| (inertia.first_moment / inertia.mass).into();
        let (value, deviation) = self.function::<3>(&centre);
        (value.into(), deviation.into())
    }

    /// Tensor of inertia about the centre of mass in the axes of the frame \[kg m^2\], and the
    /// standard deviation of each component.
    #[must_use]
    pub fn about_centre(&self) -> (Mat3, Mat3) {
        let about_centre = |inertia: RigidInertia| {
            let to_centre = Pose {
                rotation: Mat3::identity(),
                translation: -inertia.first_moment / inertia.mass,
            };
            let tensor = inertia.transformed(&to_centre).inertia;
            std::array::from_fn(|i| tensor[i])
        };
        let (value, deviation) = self.function::<9>(&about_centre);
        (
            Mat3::from_column_slice(&value),
            Mat3::from_column_slice(&deviation),
        )
    }

    /// A function of the parameters and its deviations, to first order.
    fn function<const N: usize>(
        &self,
        of: &dyn Fn(RigidInertia) -> [f64; N],
    ) -> ([f64; N], [f64; N]) {
        let value = of(self.inertia());
        let mut jacobian = SMatrix::<f64, N, LINK_PARAMETERS>::zeros();
        for column in 0..LINK_PARAMETERS {
            // A thousandth of a deviation: the functions are smooth over a deviation.
            let step = 1e-3 * self.covariance[(column, column)].max(1e-20).sqrt();
            let at = |sign: f64| {
                let mut parameters = self.parameters;
                parameters[column] += sign * step;
                of(RigidInertia::from_parameters(&parameters))
            };
            let (above, below) = (at(1.0), at(-1.0));
            for row in 0..N {
                jacobian[(row, column)] = (above[row] - below[row]) / (2.0 * step);
            }
        }
        let covariance = jacobian * self.covariance * jacobian.transpose();
        (
            value,
            std::array::from_fn(|i| covariance[(i, i)].max(0.0).sqrt()),
        )
    }
}
