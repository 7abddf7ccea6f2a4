//! What observations would tell, before anybody makes them: the covariance that [`crate::identify`]
//! would state of parameters, offsets and gains.
//!
//! Rows, elimination of offsets, prior and the assembly of the covariance are those of the
//! identification itself; the noise is a stated one, where identification estimates it. To first
//! order the covariance does not depend on what is measured, so CAD's readings stand for it.
//! Cross-validation, which may retain less than the whole change from CAD, is not anticipated.

use crate::dataset::observation::{Annotated, Observation};
use crate::dataset::resampling::RATE;
use crate::measurement::model::MeasurementModel;
use crate::measurement::noise_model::NoiseModel;
use crate::measurement::reduction::{LogSegment, reduce};
use crate::measurement::unknowns::ExtraParameter;
use crate::prior::{Prior, PriorError};
use crate::report::outcome::CovarianceRoot;
use crate::report::uncertainty::covariance;
use crate::robot::{IdentificationInput, Robot, stated_noise};
use nalgebra::DMatrix;
use proprio_dynamics::DynamicsError;
use proprio_dynamics::calibration::{Gain, Kind};
use proprio_dynamics::regressor::LINK_PARAMETERS;
use proprio_dynamics::regressor::identifiable::ParameterColumn;
use std::f64::consts::SQRT_2;

/// The noise of an F/T sensor at each of the hundred readings per second that identification uses
/// [torque; force].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorNoise {
    /// Standard deviation of a reading [Nm, N].
    pub deviation: [f64; 6],
    /// Drift of the offset (random walk): standard deviation after one second [Nm, N].
    pub drift: [f64; 6],
}

impl SensorNoise {
    /// As the robot's configuration states it, without drift.
    #[must_use]
    pub fn stated(robot: &Robot) -> Vec<Self> {
        let sensors = robot.structure.sensors().iter();
        let stated = sensors.map(|cut| Self {
            deviation: stated_noise(cut),
            drift: [0.0; 6],
        });
        stated.collect()
    }
}

/// Why there is no forecast.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ForecastError {
    /// No reading would contain any link's parameters.
    #[error(
        "no part of the robot beyond or between F/T sensors is free of unknown contacts, so \
         nothing can be identified: a contact that is not always there needs presence = \
         \"possible\" in estimator.toml, or --absent"
    )]
    Nothing,
    /// A known covariance that is not positive definite.
    #[error("the covariance of the known parameters is singular: identify again")]
    Singular,
    /// The observations are of another robot.
    #[error(transparent)]
    Dynamics(#[from] DynamicsError),
    /// CAD cannot be used as a prior.
    #[error("the URDF's inertial parameters cannot be used: {0}")]
    Prior(#[from] PriorError),
}

/// Forecasts for a robot whose F/T sensors are read.
#[derive(Clone)]
pub struct Forecast<'a> {
    measurement: MeasurementModel<'a>,
    noise: NoiseModel,
    /// A root `W` of the information before any observation, `W^T W`.
    before: DMatrix<f64>,
}

impl<'a> Forecast<'a> {
    /// For observations that have the same readings and contacts as these `examples`, each of which
    /// stands for `seconds` of time. `known`: the covariance that an earlier identification of this
    /// robot stated; without it CAD's, as stated in the configuration.
    ///
    /// # Errors
    /// [`ForecastError`].
    pub fn new(
        robot: &'a Robot,
        examples: &[Observation],
        seconds: f64,
        noise: &[SensorNoise],
        known: Option<&CovarianceRoot>,
    ) -> Result<Self, ForecastError> {
        let examples: Vec<Annotated> = examples.iter().cloned().map(Annotated::from).collect();
        let inputs = [IdentificationInput::Wrench];
        let mut measurement = MeasurementModel::for_observations(robot, &inputs, examples.iter())?;
        let gain = match robot.calibrated.gain {
            Gain::Auto => Gain::Full,
            stated => stated,
        };
        // The temperatures of a log to come are not known.
        let kind = Kind {
            gain,
            temperature: false,
        };
        measurement.set_calibration_unknowns(kind, examples.iter());
        let unknowns = measurement.unknowns();
        if unknowns.links.is_empty() {
            return Err(ForecastError::Nothing);
        }
        let of_sensor = |sensor: &usize| noise.get(*sensor).copied();
        let noise: Vec<SensorNoise> = unknowns.sensors.iter().filter_map(of_sensor).collect();
        let each = |values: fn(&SensorNoise) -> [f64; 6], factor: f64| -> Vec<f64> {
            let all = noise.iter().flat_map(values);
            all.map(|deviation| factor * deviation * deviation)
                .collect()
        };
        let square = each(|noise| noise.deviation, 1.0 / (RATE * seconds));
        let noise = NoiseModel {
            time: vec![1.0; square.len()],
            drift_variance: each(|noise| noise.drift, 1.0),
            block: square.clone(),
            least: square.clone(),
            square,
            ..NoiseModel::default()
        };
        let mut before = prior(robot, &measurement)?;
        if let Some(known) = known {
            before = with_known(before, &measurement, known).ok_or(ForecastError::Singular)?;
        }
        Ok(Self {
            measurement,
            noise,
            before,
        })
    }

    /// The covariance after these consecutive observations.
    ///
    /// # Errors
    /// [`ForecastError::Singular`].
    pub fn after(&self, observations: Vec<Observation>) -> Result<CovarianceRoot, ForecastError> {
        let instants: Vec<Annotated> = observations.into_iter().map(Annotated::from).collect();
        let segment = LogSegment::alone(&instants);
        let reduced = reduce(&mut self.measurement.clone(), segment, &self.noise);
        let (r, _) = reduced.information.to_triangle();
        let (count, unknowns) = (self.before.nrows(), self.before.ncols());
        let mut all = self.before.clone().resize_vertically(count + unknowns, 0.0);
        all.rows_mut(count, unknowns).copy_from(&r);
        let unit = DMatrix::identity(unknowns, unknowns);
        let root = all.qr().r().solve_upper_triangular(&unit);
        let root = root.ok_or(ForecastError::Singular)?;
        let unknowns = self.measurement.unknowns();
        Ok(covariance(unknowns, std::slice::from_ref(&reduced), &root))
    }
}

/// The prior of identification: a root of its information.
fn prior(robot: &Robot, measurement: &MeasurementModel<'_>) -> Result<DMatrix<f64>, ForecastError> {
    let unknowns = measurement.unknowns();
    let prior = Prior::new(robot.model.inertias())?.with_roughly(robot.urdf_relative_std);
    let mut root = DMatrix::zeros(unknowns.parameters(), unknowns.parameters());
    for (index, &link) in unknowns.links.iter().enumerate() {
        let factor = prior.metric(link).cholesky().map(|factor| factor.l());
        let block = factor.unwrap_or_default().transpose() / (SQRT_2 * prior.expected_tau());
        let at = LINK_PARAMETERS * index;
        root.view_mut((at, at), (LINK_PARAMETERS, LINK_PARAMETERS))
            .copy_from(&block);
    }
    for (precision, column) in unknowns.precision.iter().zip(unknowns.inertial()..) {
        root[(column, column)] = precision.sqrt();
    }
    Ok(root)
}

/// The information of a known covariance in place of the prior of its parameters. Offsets of
/// another log are not those of the next.
fn with_known(
    mut prior: DMatrix<f64>,
    measurement: &MeasurementModel<'_>,
    known: &CovarianceRoot,
) -> Option<DMatrix<f64>> {
    let unknowns = measurement.unknowns();
    let mut columns = Vec::new();
    for (row, column) in known.columns.iter().enumerate() {
        if let ParameterColumn::Inertial { link, parameter } = *column
            && let Ok(index) = unknowns.links.binary_search(&link)
        {
            columns.push((row, LINK_PARAMETERS * index + parameter));
        }
    }
    for (row, &(sensor, unknown)) in known.calibrations.iter().enumerate() {
        let column = unknowns.column(ExtraParameter::Calibration(sensor, unknown));
        columns.extend(column.map(|column| (known.columns.len() + row, column)));
    }
    let rows: Vec<usize> = columns.iter().map(|(row, _)| *row).collect();
    let mut root = known.root.select_rows(&rows);
    // In units of the deviations, which differ by orders of magnitude.
    let deviations: Vec<f64> = root.row_iter().map(|row| row.norm()).collect();
    for (mut row, deviation) in root.row_iter_mut().zip(&deviations) {
        row /= *deviation;
    }
    let inverse = root.transpose().qr().r().transpose().try_inverse();
    let inverse = inverse.filter(|inverse| inverse.iter().all(|x| x.is_finite()))?;
    let before = prior.nrows();
    // A parameter's rows of the prior are those of its link, all of which is known.
    for (_, column) in &columns {
        prior.row_mut(*column).fill(0.0);
    }
    let mut all = prior.resize_vertically(before + columns.len(), 0.0);
    for (j, ((_, column), deviation)) in columns.iter().zip(&deviations).enumerate() {
        for i in 0..columns.len() {
            all[(before + i, *column)] = inverse[(i, j)] / deviation;
        }
    }
    Some(all)
}
