//! Prediction error of a log: the figure by which parameters are judged, computed alike for CAD and
//! for the identified parameters. It depends on the log and on the parameters alone.
//!
//! ```text
//! e_k(t) = (1 + E_k)^-1 M_k (r - A d - G s)    reading of sensor k less its prediction
//! s      = argmin  sum over t, k of |S e_k(t)|^2
//! error  = ( sum |S e_k|^2 / sum |S (y_k - mean y_k)|^2 )^1/2
//! ```
//!
//! - `M_k` attributes the whole residual of the rows to sensor `k` ([`attribute_to`]).
//! - `E_k` is the error of its gain. Uncorrected readings are predicted, because two sensors whose
//!   gains are corrected to zero would agree perfectly.
//! - `S` converts forces to moments ([`Unknowns::scale`]).
//!
//! Parameters, gains and friction are those of the training logs. Only the offsets `s` are fitted
//! to the log: one constant for each channel; and, for a second figure, a linear drift in addition.
//! (An offset that follows a random walk would absorb model errors, the more the faster it may
//! drift.) Parameters that were identified on-line are judged as they were in use: at each instant
//! those that were known by then, with offsets fitted to the log as a whole ([`predicted`]).

use crate::arithmetic::{add_multiple, dot, rms};
use crate::dataset::observation::{Annotated, Observation};
use crate::measurement::channels::{attribute_to, channel_of, sensor_name};
use crate::measurement::model::MeasurementModel;
use crate::measurement::reduction::OFFSET_VARIANCE;
use crate::measurement::rows::MeasurementRows;
use crate::measurement::unknowns::{ExtraParameter, FRICTION, Unknowns};
use crate::report::outcome::{Both, InForce, Predicted, both};
use crate::robot::{IdentificationInput, Robot};
use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Matrix6xX, Vector3, Vector6};
use proprio_dynamics::DynamicsError;
use proprio_dynamics::calibration::{Gain, Kind, Unknown};
use proprio_dynamics::spatial::RigidInertia;
use proprio_topics::Nanos;
use std::ops::Range;

/// Most observations of a log that are used: they give its RMS to 1 %, and the same ones are used
/// for CAD and for other parameters.
const MAX_OBSERVATIONS: usize = 20_000;

/// Observations that one thread processes at a time.
const BATCH: usize = 256;

/// Parameters to be judged, with their friction.
#[derive(Clone, Debug)]
pub(crate) struct JudgedParameters {
    /// Parameters less CAD's, in the columns of a layout, with the instant from which they are
    /// used.
    pub course: Vec<(Nanos, DVector<f64>)>,
    /// Of each joint of that layout.
    pub friction: Vec<[f64; FRICTION]>,
}

impl JudgedParameters {
    /// The same parameters at all times.
    pub(crate) fn constant(d: &DVector<f64>, friction: Vec<[f64; FRICTION]>) -> Self {
        let course = vec![(Nanos::ZERO, d.clone())];
        Self { course, friction }
    }
}

/// Residuals of a candidate in a log, at the used instants; NaN where there is no prediction.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct PredictionErrors {
    /// Per channel of the layout, readings with constant offsets, and torques.
    pub channels: Vec<Vec<f64>>,
    /// Per F/T channel, with linear drifts; empty if not requested.
    pub drifting: Vec<Vec<f64>>,
    /// Per degree of freedom whose torque follows from two sides, their difference.
    pub routes: Vec<Vec<f64>>,
}

/// A log on which parameters are judged, with its measurement model.
pub(crate) struct PredictionError<'a> {
    measurement: MeasurementModel<'a>,
    instants: Vec<Annotated>,
}

/// The candidates in the columns of the log's own layout.
struct JudgedSets {
    /// All parameters that any of them uses at any time.
    sets: Vec<ParameterSet>,
    /// Distinct gains: per sensor, the matrix from errors of the wrench to errors of the reading.
    gains: Vec<Vec<Matrix6<f64>>>,
    courses: Vec<ParameterCourse>,
}

/// The parameters that a candidate uses over time.
struct ParameterCourse {
    /// Number of the set used from each instant on.
    sets: Vec<(Nanos, usize)>,
    /// Of each joint.
    friction: Vec<[f64; FRICTION]>,
}

struct ParameterSet {
    d: DVector<f64>,
    /// Number of its gains.
    gains: usize,
}

/// Prediction errors of F/T readings at the instants of a log: of the parameters in use at each
/// instant (`course`), and of CAD with the factory calibrations. `cad`: the robot without
/// identified parameters, with which the observations were computed. `course` ascends in time; its
/// first parameters are used from the beginning.
///
/// # Errors
/// Observations of another robot.
pub fn predicted(
    cad: &Robot,
    instants: &[Observation],
    course: &[InForce],
) -> Result<Predicted, DynamicsError> {
    let has_gains = course
        .iter()
        .any(|in_force| in_force.calibrations != cad.calibrations);
    let kind = if has_gains {
        Kind {
            gain: Gain::Full,
            temperature: true,
        }
    } else {
        Kind::default()
    };
    let prediction_error =
        PredictionError::of_record(cad, &[IdentificationInput::Wrench], kind, instants.iter())?;
    let unknowns = Unknowns {
        links: (0..cad.model.link_count()).collect(),
        extra: (0..cad.calibrations.len())
            .flat_map(|sensor| {
                kind.unknowns()
                    .map(move |unknown| ExtraParameter::Calibration(sensor, unknown))
            })
            .collect(),
        ..Unknowns::default()
    };
    let of_cad = vec![(Nanos::ZERO, DVector::zeros(unknowns.parameters()))];
    let own = course
        .iter()
        .map(|in_force| (in_force.since, beside(cad, &unknowns, in_force)));
    let candidates = [of_cad, own.collect()].map(|course| JudgedParameters {
        course,
        friction: Vec::new(),
    });
    Ok(prediction_error.predicted(&unknowns, &candidates))
}

/// Parameters less CAD's, in the columns of a layout.
fn beside(cad: &Robot, unknowns: &Unknowns, in_force: &InForce) -> DVector<f64> {
    let mut d = DVector::zeros(unknowns.parameters());
    for (index, &link) in unknowns.links.iter().enumerate() {
        let parameters =
            [&in_force.bodies[link], &cad.model.inertias()[link]].map(RigidInertia::parameters);
        for k in 0..10 {
            d[10 * index + k] = parameters[0][k] - parameters[1][k];
        }
    }
    let changes: Vec<(Matrix6<f64>, [f64; 6])> = in_force
        .calibrations
        .iter()
        .zip(&cad.calibrations)
        .map(|(own, configured)| own.after(configured))
        .collect();
    let values = d.iter_mut().skip(unknowns.inertial());
    for (extra, value) in unknowns.extra.iter().zip(values) {
        if let ExtraParameter::Calibration(sensor, unknown) = *extra {
            let (gain, per_kelvin) = &changes[sensor];
            *value = match unknown {
                Unknown::Gain { channel, of } => gain[(channel, of)],
                Unknown::Temperature { channel } => per_kelvin[channel],
            };
        }
    }
    d
}

/// One comparison at an instant.
struct ComparedRow {
    of: ComparedQuantity,
    /// Residual of each set, without offsets.
    residuals: Vec<f64>,
    /// Coefficients of the offsets, for each of the distinct gains.
    h: Vec<Vec<f64>>,
}

/// What is compared.
#[derive(Clone, Copy)]
enum ComparedQuantity {
    Channel(usize),
    Route(usize),
}

impl<'a> PredictionError<'a> {
    /// Of the whole record, undeclared disturbances included.
    ///
    /// # Errors
    /// Observations of another robot.
    pub(crate) fn of_record<'b>(
        robot: &'a Robot,
        inputs: &[IdentificationInput],
        calibrated: Kind,
        instants: impl ExactSizeIterator<Item = &'b Observation>,
    ) -> Result<Self, DynamicsError> {
        let stride = instants.len().div_ceil(MAX_OBSERVATIONS).max(1);
        let recorded = |observation: &Observation| Annotated::from(observation.clone());
        let instants: Vec<Annotated> = instants.step_by(stride).map(recorded).collect();
        let mut measurement = MeasurementModel::for_observations(robot, inputs, instants.iter())?;
        measurement.set_calibration_unknowns(calibrated, instants.iter());
        Ok(Self {
            measurement,
            instants,
        })
    }

    /// Of the instants that parameters may be fitted to, in the columns of `measurement`.
    pub(crate) fn of_fit(measurement: &MeasurementModel<'a>, instants: &[Annotated]) -> Self {
        let given = |instant: &Annotated| instant.clone().without_fitted();
        Self {
            measurement: measurement.clone(),
            instants: instants.iter().map(given).collect(),
        }
    }

    fn unknowns(&self) -> &Unknowns {
        self.measurement.unknowns()
    }

    /// The figures of F/T readings; none of joint torques.
    pub(crate) fn predicted(
        &self,
        unknowns: &Unknowns,
        candidates: &[JudgedParameters; 2],
    ) -> Predicted {
        let robot = self.measurement.robot();
        let errors = self.errors(unknowns, candidates, true);
        let unknowns = self.unknowns();
        let (mut squares, mut all) = ([[0.0; 2]; 2], 0.0);
        for channel in 0..unknowns.wrenches() {
            let weighted = |values: &[f64]| -> f64 {
                let finite = values.iter().filter(|x| x.is_finite());
                finite.map(|x| (x * unknowns.scale(channel)).powi(2)).sum()
            };
            for ([constant, drifting], errors) in squares.iter_mut().zip(&errors) {
                *constant += weighted(&errors.channels[channel]);
                *drifting += weighted(&errors.drifting[channel]);
            }
            all += weighted(&self.load(channel, &errors[0]));
        }
        let relative = |which: usize| both(squares.map(|of| (of[which] / all).sqrt()));
        let series = |of: &dyn Fn(&PredictionErrors) -> f64| both([of(&errors[0]), of(&errors[1])]);
        let of_channel =
            |channel: usize| series(&|errors| rms(errors.channels[channel].iter().copied()));
        let of_sensor = |index: usize| {
            let axes: [Both<f64>; 6] =
                std::array::from_fn(|axis| of_channel(channel_of(index, axis)));
            both([axes.map(|axis| axis.cad), axes.map(|axis| axis.identified)])
        };
        let routes = (0..robot.model.dof_count()).map(|dof| {
            let of_dof = series(&|errors| rms(errors.routes[dof].iter().copied()));
            (robot.model.dof_name(dof).to_owned(), of_dof)
        });
        Predicted {
            relative_error: relative(0),
            relative_error_with_drift: relative(1),
            joints: Vec::new(),
            sensors: (unknowns.sensors.iter().enumerate())
                .map(|(index, sensor)| (sensor_name(robot, *sensor), of_sensor(index)))
                .collect(),
            two_route: routes.filter(|(_, rms)| rms.cad.is_finite()).collect(),
        }
    }

    /// Readings of a channel of F/T sensors, less their mean over the log, where errors are known.
    pub(crate) fn load(&self, channel: usize, errors: &PredictionErrors) -> Vec<f64> {
        let sensor = self.unknowns().sensors[channel / 6];
        let pairs = self.instants.iter().zip(&errors.channels[channel]);
        let read = pairs.filter(|(_, error)| error.is_finite());
        let load: Vec<f64> = read
            .map(|(i, _)| i.readings[sensor].torque_first()[channel % 6])
            .collect();
        let mean = load.iter().sum::<f64>() / load.len().max(1) as f64;
        load.into_iter().map(|x| x - mean).collect()
    }

    /// Residuals of each of the candidates, given in the columns of `unknowns`; with constant
    /// offsets only, or once with linear drifts too.
    pub(crate) fn errors(
        &self,
        unknowns: &Unknowns,
        candidates: &[JudgedParameters],
        with_drifts: bool,
    ) -> Vec<PredictionErrors> {
        let own = self.unknowns();
        let (offsets, channels) = (own.wrenches(), own.channels());
        let drifts = if with_drifts { offsets } else { 0 };
        let width = channels + drifts + self.measurement.robot().model.dof_count();
        let plan = JudgedSets::new(unknowns, own, candidates);
        let fitted = self.fitted_offsets(&plan, drifts);
        let values = self.map_instants(Vec::new, |values: &mut Vec<f64>, made| {
            let start = values.len();
            values.resize(start + candidates.len() * width, f64::NAN);
            let in_force = plan.in_force(made.instant.t);
            let compared = comparisons(made, &plan, &in_force);
            let each = values[start..].chunks_exact_mut(width.max(1));
            for (which, (out, course)) in each.zip(&plan.courses).enumerate() {
                let ParameterSet { d, gains } = &plan.sets[in_force[which]];
                let [constant, drifting] = &fitted[in_force[which]];
                for ComparedRow { of, residuals, h } in &compared {
                    let (residual, h) = (residuals[which], &h[*gains]);
                    let remains = residual - dot(h, constant.as_slice());
                    match *of {
                        ComparedQuantity::Route(dof) => out[channels + drifts + dof] = remains,
                        ComparedQuantity::Channel(channel) => {
                            out[channel] = remains;
                            if channel < drifts {
                                let line = line(h, made.late, drifts);
                                out[channels + channel] =
                                    residual - dot(&line, drifting.as_slice());
                            }
                        }
                    }
                }
                for row in 0..made.rows.count {
                    if let Some(joint) = made.rows.joint(row) {
                        let share = &made.rows.g(row)[offsets + FRICTION * joint..][..FRICTION];
                        out[offsets + joint] = made.rows.without_bodies(row, d.as_slice())
                            - dot(share, &course.friction[joint]);
                    }
                }
            }
        });
        let values: Vec<f64> = values.concat();
        let column = |at: usize| -> Vec<f64> {
            let series = values.iter().skip(at).step_by(candidates.len() * width);
            series.copied().collect()
        };
        let columns = |which: usize, places: Range<usize>| -> Vec<Vec<f64>> {
            places.map(|index| column(which * width + index)).collect()
        };
        (0..candidates.len())
            .map(|which| PredictionErrors {
                channels: columns(which, 0..channels),
                drifting: columns(which, channels..channels + drifts),
                routes: columns(which, channels + drifts..width),
            })
            .collect()
    }

    /// Per set, the constant offsets that fit the whole log best, and the offsets that do so
    /// together with this number of linear drifts.
    fn fitted_offsets(&self, plan: &JudgedSets, drifts: usize) -> Vec<[DVector<f64>; 2]> {
        let own = self.unknowns();
        let offsets = own.wrenches();
        let width = offsets + drifts;
        let all: Vec<usize> = (0..plan.sets.len()).collect();
        let zero = || {
            let normals = vec![DMatrix::zeros(width, width); plan.gains.len()];
            (normals, vec![DVector::zeros(width); plan.sets.len()])
        };
        let parts = self.map_instants(zero, |(normals, rights), made| {
            for ComparedRow { of, residuals, h } in comparisons(made, plan, &all) {
                let ComparedQuantity::Channel(channel) = of else {
                    continue;
                };
                let square = own.scale(channel).powi(2);
                let lines: Vec<Vec<f64>> = h.iter().map(|h| line(h, made.late, drifts)).collect();
                for (normal, line) in normals.iter_mut().zip(&lines) {
                    for (i, x) in line.iter().enumerate().filter(|(_, x)| **x != 0.0) {
                        let column = &mut normal.as_mut_slice()[width * i..][..width];
                        add_multiple(column, square * x, line);
                    }
                }
                for ((right, residuals), set) in rights.iter_mut().zip(residuals).zip(&plan.sets) {
                    add_multiple(right.as_mut_slice(), square * residuals, &lines[set.gains]);
                }
            }
        });
        let mut parts = parts.into_iter();
        let (mut normals, mut rights) = parts.next().unwrap_or_else(zero);
        for (more, others) in parts {
            (normals.iter_mut().zip(more)).for_each(|(normal, more)| *normal += more);
            (rights.iter_mut().zip(others)).for_each(|(right, other)| *right += other);
        }
        let of_set = |(right, set): (&DVector<f64>, &ParameterSet)| {
            [offsets, width].map(|count| solved(&normals[set.gains], right, count))
        };
        rights.iter().zip(&plan.sets).map(of_set).collect()
    }

    /// Runs `each` over all instants, on all cores, with an accumulator of its own for each part of
    /// the log.
    fn map_instants<T: Send>(
        &self,
        make: impl Fn() -> T + Sync,
        each: impl Fn(&mut T, &InstantRows<'_, '_>) + Sync,
    ) -> Vec<T> {
        let trusted = stated_variances(self.measurement.robot(), self.unknowns());
        let (Some(first), Some(last)) = (self.instants.first(), self.instants.last()) else {
            return Vec::new();
        };
        let half = 0.5 * (last.t - first.t).seconds().max(f64::MIN_POSITIVE);
        (self.measurement).map(self.instants.chunks(BATCH), |measurement, batch| {
            let mut state = make();
            for instant in batch {
                let made = InstantRows {
                    late: (instant.t - first.t).seconds() / half - 1.0,
                    instant,
                    rows: measurement.rows(instant),
                    measurement,
                    trusted: &trusted,
                };
                each(&mut state, &made);
            }
            state
        })
    }
}

/// An instant and its rows.
struct InstantRows<'a, 'b> {
    instant: &'a Annotated,
    /// From -1 at the log's beginning to 1 at its end.
    late: f64,
    measurement: &'a MeasurementModel<'b>,
    rows: MeasurementRows,
    trusted: &'a [f64],
}

/// The comparisons at an instant, for these sets: readings, and torques from two sides.
fn comparisons(made: &InstantRows<'_, '_>, plan: &JudgedSets, sets: &[usize]) -> Vec<ComparedRow> {
    let (rows, unknowns) = (&made.rows, made.measurement.unknowns());
    let offsets = unknowns.wrenches();
    let residuals: Vec<DVector<f64>> = sets
        .iter()
        .map(|&set| &plan.sets[set].d)
        .map(|d| DVector::from_fn(rows.count, |row, _| rows.without_bodies(row, d.as_slice())))
        .collect();
    let g = DMatrix::from_fn(rows.count, offsets, |row, column| rows.g(row)[column]);
    let mut compared = Vec::new();
    for index in 0..unknowns.sensors.len() {
        let Some(map) = attribute_to(rows, made.trusted, 6 * index..6 * index + 6) else {
            continue;
        };
        let maps: Vec<Matrix6xX<f64>> =
            plan.gains.iter().map(|gains| gains[index] * &map).collect();
        let h: Vec<Matrix6xX<f64>> = maps.iter().map(|map| map * &g).collect();
        let each = residuals.iter().zip(sets);
        let errors: Vec<Vector6<f64>> = each
            .map(|(residuals, &set)| &maps[plan.sets[set].gains] * residuals)
            .collect();
        for k in (0..6).filter(|k| rows.has(6 * index + k)) {
            compared.push(ComparedRow {
                of: ComparedQuantity::Channel(6 * index + k),
                residuals: errors.iter().map(|error| error[k]).collect(),
                h: h.iter()
                    .map(|h| h.row(k).iter().copied().collect())
                    .collect(),
            });
        }
    }
    for (dof, along) in made.measurement.two_routes(rows) {
        compared.push(ComparedRow {
            of: ComparedQuantity::Route(dof),
            residuals: residuals.iter().map(|own| along.dot(own)).collect(),
            h: vec![g.tr_mul(&along).as_slice().to_vec(); plan.gains.len()],
        });
    }
    compared
}

impl JudgedSets {
    fn new(from: &Unknowns, to: &Unknowns, candidates: &[JudgedParameters]) -> Self {
        let mut plan = Self {
            sets: Vec::new(),
            gains: Vec::new(),
            courses: Vec::new(),
        };
        for JudgedParameters { course, friction } in candidates {
            let mut own: Vec<(Nanos, usize)> = Vec::new();
            for (since, d) in course {
                let d = in_columns_of(from, d, to);
                if own.last().is_some_and(|(_, set)| plan.sets[*set].d == d) {
                    continue;
                }
                let gains = gains(to, &d);
                let known = plan.gains.iter().position(|other| *other == gains);
                let number = known.unwrap_or(plan.gains.len());
                if known.is_none() {
                    plan.gains.push(gains);
                }
                own.push((*since, plan.sets.len()));
                plan.sets.push(ParameterSet { d, gains: number });
            }
            let of_joint = |dof: &usize| {
                let index = from.joints.binary_search(dof).ok();
                index.map_or([0.0; FRICTION], |index| friction[index])
            };
            plan.courses.push(ParameterCourse {
                sets: own,
                friction: to.joints.iter().map(of_joint).collect(),
            });
        }
        plan
    }

    /// The set that each candidate uses at an instant; the first one before its start.
    fn in_force(&self, t: Nanos) -> Vec<usize> {
        let of_course = |ParameterCourse { sets, .. }: &ParameterCourse| {
            let at = sets.partition_point(|(since, _)| *since <= t);
            sets[at.saturating_sub(1)].1
        };
        self.courses.iter().map(of_course).collect()
    }
}

/// Coefficients of the constant offsets, then of `drifts` linear drifts.
fn line(h: &[f64], late: f64, drifts: usize) -> Vec<f64> {
    let drifts = h.iter().take(drifts).map(|x| late * x);
    h.iter().copied().chain(drifts).collect()
}

/// Least-squares solution for the first `count` offsets. Unobserved ones are zero.
fn solved(normal: &DMatrix<f64>, right: &DVector<f64>, count: usize) -> DVector<f64> {
    let mut matrix = normal.view((0, 0), (count, count)).into_owned();
    for i in 0..count {
        matrix[(i, i)] += 1.0 / OFFSET_VARIANCE;
    }
    let right = right.rows(0, count).into_owned();
    let solution = matrix.cholesky().map(|factor| factor.solve(&right));
    solution.unwrap_or_else(|| DVector::zeros(count))
}

/// Stated variances of the readings: the attribution of a residual to one of several sensors must
/// not depend on a log's estimated noise.
fn stated_variances(robot: &Robot, unknowns: &Unknowns) -> Vec<f64> {
    let mut variances: Vec<f64> = unknowns.stated(robot).map(|x| x * x).collect();
    variances.resize(unknowns.channels(), 1.0);
    variances
}

/// Parameters in the columns of another layout; CAD's where `from` has none.
fn in_columns_of(from: &Unknowns, d: &DVector<f64>, to: &Unknowns) -> DVector<f64> {
    let mut out = DVector::zeros(to.parameters());
    for (index, link) in to.links.iter().enumerate() {
        if let Ok(other) = from.links.binary_search(link) {
            out.rows_mut(10 * index, 10)
                .copy_from(&d.rows(10 * other, 10));
        }
    }
    for (index, extra) in to.extra.iter().enumerate() {
        if let Some(column) = from.column(*extra) {
            out[to.inertial() + index] = d[column];
        }
    }
    out
}

/// For each sensor of the layout, the matrix from errors of the wrench to errors of the reading.
fn gains(unknowns: &Unknowns, d: &DVector<f64>) -> Vec<Matrix6<f64>> {
    let of_sensor = |sensor: &usize| {
        let mut gain = Matrix6::identity();
        let values = d.iter().skip(unknowns.inertial());
        for (extra, value) in unknowns.extra.iter().zip(values) {
            if let ExtraParameter::Calibration(own, Unknown::Gain { channel, of }) = extra
                && own == sensor
            {
                gain[(*channel, *of)] += value;
            }
        }
        gain.try_inverse().unwrap_or_else(Matrix6::identity)
    };
    unknowns.sensors.iter().map(of_sensor).collect()
}

/// Least-squares friction of each joint of the layout, over all these instants, for each set of
/// parameters.
pub(crate) fn friction<'b>(
    measurement: &MeasurementModel<'_>,
    instants: impl Iterator<Item = &'b Annotated>,
    sets: &[DVector<f64>],
) -> Vec<Vec<[f64; FRICTION]>> {
    let unknowns = measurement.unknowns();
    let (joints, offsets) = (unknowns.joints.len(), unknowns.wrenches());
    if joints == 0 {
        return vec![Vec::new(); sets.len()];
    }
    let zero = || vec![(Matrix3::zeros(), vec![Vector3::zeros(); sets.len()]); joints];
    let instants: Vec<&Annotated> = instants.collect();
    let parts = measurement.map(instants.chunks(BATCH), |measurement, batch| {
        let mut sums = zero();
        for instant in batch {
            let rows = measurement.rows(instant);
            for row in 0..rows.count {
                let Some(joint) = rows.joint(row) else {
                    continue;
                };
                let friction = &rows.g(row)[offsets + FRICTION * joint..][..FRICTION];
                let g = Vector3::from_column_slice(friction);
                let (normal, rights) = &mut sums[joint];
                *normal += g * g.transpose();
                for (right, d) in rights.iter_mut().zip(sets) {
                    *right += g * rows.without_bodies(row, d.as_slice());
                }
            }
        }
        sums
    });
    let mut total = zero();
    for part in parts {
        for ((normal, rights), (more, others)) in total.iter_mut().zip(part) {
            *normal += more;
            for (right, other) in rights.iter_mut().zip(others) {
                *right += other;
            }
        }
    }
    let solve = |normal: &Matrix3<f64>, right: &Vector3<f64>| -> [f64; FRICTION] {
        // The friction of a joint that stands still is not observable.
        let solution = normal.svd(true, true).solve(right, 1e-9 * normal.norm());
        solution.unwrap_or_else(|_| Vector3::zeros()).into()
    };
    (0..sets.len())
        .map(|set| {
            total
                .iter()
                .map(|(normal, rights)| solve(normal, &rights[set]))
                .collect()
        })
        .collect()
}
