//! What a log says against the configuration, before any fit: units and signs of readings, frames
//! of F/T sensors, gravity.
//!
//! Every alternative changes the readings linearly, or the proper acceleration of the base, in
//! which the rows are linear as well. So one pass over a log serves all of them. It collects the
//! squares and products of these columns, with CAD, and without what constant offsets, friction and
//! rotors explain ([`ConfigurationEvidence`]):
//!
//! ```text
//! [ rows for 1 g along x, y, z | g_i y_j of each sensor | torque of the joint | r ]
//! ```
//!
//! `y` is a sensor's reading and `g` what its offset has in the row: with the reading `M y`, `sum
//! (M - 1)_ij g_i y_j` is added to `r`.
//!
//! # What is tested
//! CAD may be wrong by a large factor: a gripper that the URDF lacks, on a light flange, has thirty
//! times the flange's mass. So a unit is wrong only beyond what bodies do:
//!
//! - A joint torque `y` that CAD predicts as `x`: wrong sign if `|y + x|^2 < |y - x|^2 / 3` (a
//!   correlation below -1/2 if they are of one size); counts or thousandths if `|y| > 30 |x|` and
//!   the correlation is above 0.7 in magnitude, or more than a hundred times any prediction for a
//!   joint of its kind; thousands or a dead channel if `|y| < |x| / 30`. It is left out of the log.
//! - The readings of an F/T sensor: the log is refused if forces or torques are more than 30 times
//!   the prediction and change by more than the weight of the whole robot, or if both are below
//!   1/300 of it, correlated as above. More than 3 times, or less than a third, is reported.
//! - Its direction and frame, in all logs together, then in each alone: that change of a sensor is
//!   accepted which leaves the least squares of all F/T readings, if less than a third remains
//!   (a correlation of -1/2); then the next. The opposite direction is always tested: with it,
//!   masses would be negative. Other frames only if the readings hardly follow CAD ([`STRANGE`]),
//!   and accepted only if they do with the change.
//! - Gravity, if the base stands still: its direction that leaves the least squares, if it is
//!   nearer to another axis than to the configured one.

mod fault;
mod mounting;

use crate::dataset::LogRole;
use crate::dataset::observation::{Annotated, Observation};
use crate::diagnose::configuration::fault::{
    ReadingFault, TorqueComparison, torque_faults, wrench_fault,
};
use crate::diagnose::configuration::mounting::{Mounting, mountings};
use crate::finding::{Finding, FindingCode};
use crate::linear::nuisance::NuisanceFilter;
use crate::measurement::channels::{attribute_to, sensor_name};
use crate::measurement::model::MeasurementModel;
use crate::measurement::reduction::nuisance_prior;
use crate::measurement::rows::MeasurementRows;
use crate::measurement::unknowns::Unknowns;
use crate::nested_test::accepted;
use crate::prepared_log::PreparedLog;
use crate::readings::{GRAVITY, MotionReading};
use crate::robot::{BaseMotion, IdentificationInput, Robot};
use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Vector3, Vector6};
use proprio_dynamics::spatial::Vec3;
use proprio_dynamics::{DynamicsError, Structure};
use std::ops::ControlFlow;

/// Observations of a log that are used at most, and how many share offsets and friction.
const MAX_OBSERVATIONS: usize = 2000;
const STRETCH: usize = 500;

/// F/T readings are compared if the prediction's RMS exceeds this multiple of the noise.
const ABOVE_NOISE: f64 = 5.0;

/// Lever of the whole robot's weight \[m\].
const LEVER: f64 = 1.0;

/// Fraction of the squared readings that CAD leaves unexplained, above which errors of the inertial
/// parameters are not the cause: parameters wrong by a third leave a ninth.
const STRANGE: f64 = 0.25;

/// A change of a sensor is accepted if less than this fraction of the squares remains.
const REMAINING: f64 = 1.0 / 3.0;

/// Among changes whose remaining squares differ by less than this factor, the simplest is accepted.
const SIMILAR: f64 = 1.5;

/// A log is tested alone if the mean square of its readings is at least this fraction of that of
/// the training logs: with little motion, errors of CAD look like a wrong frame.
const ENOUGH_ALONE: f64 = 1.0 / 9.0;

/// Another gravity is accepted if less than this fraction of the squares remains: parameters wrong
/// by a third leave a ninth. (A joint that counts backwards looks like another gravity, and leaves
/// more.)
const REMAINING_OF_GRAVITY: f64 = 1.0 / 9.0;

/// Tests logs: refuses some, leaves out joint torques, and reports why. Breaks with a reason and
/// findings if all logs together contradict the configuration.
///
/// # Errors
/// Observations of another robot.
pub(crate) fn check(
    robot: &Robot,
    inputs: &[IdentificationInput],
    logs: &mut [PreparedLog],
) -> Result<ControlFlow<(String, Vec<Finding>)>, DynamicsError> {
    let (mut all, mut trained) = (ConfigurationEvidence::new(robot), 0);
    let mut alone = Vec::new();
    for log in &mut *logs {
        let mut evidence = ConfigurationEvidence::new(robot);
        if !log.refused {
            evidence.add_log(robot, inputs, log)?;
            for (dof, fault) in evidence.faulty_torques(robot) {
                let torque = evidence.joint(dof);
                evidence.groups[torque] = GramMatrix::new(evidence.width());
                let (reason, finding) = fault.of_torque(robot, dof);
                log.exclude_torque(dof, reason, finding);
            }
            log.add_findings(evidence.wrong_units(robot));
        }
        if log.role == LogRole::Train && !log.refused {
            all.add(&evidence);
            trained += 1;
        }
        alone.push((evidence.change(), evidence.wrong_frames(robot)));
    }
    let wrong_frames = all.wrong_frames(robot);
    if !wrong_frames.is_empty() {
        let names: Vec<&str> = wrong_frames.iter().map(|f| f.subject.as_str()).collect();
        let reason = format!(
            "{}: wrong measurement frame or direction; nothing was identified",
            names.join(", ")
        );
        return Ok(ControlFlow::Break((reason, wrong_frames)));
    }
    let with_torques = inputs.contains(&IdentificationInput::Torque);
    if let Some(wrong) = all.wrong_gravity(robot, with_torques) {
        return Ok(ControlFlow::Break((wrong.text.clone(), vec![wrong])));
    }
    // A sensor that was mounted differently in a minority of the logs.
    for (log, (change, wrong_frames)) in logs.iter_mut().zip(alone) {
        let is_all = log.role == LogRole::Train && trained == 1;
        if !log.refused && !is_all && change >= ENOUGH_ALONE * all.change() {
            log.add_findings(wrong_frames);
        }
    }
    Ok(ControlFlow::Continue(()))
}

/// Squares and products of the columns in the rows of one quantity.
#[derive(Clone)]
struct GramMatrix {
    gram: DMatrix<f64>,
    rows: f64,
}

impl GramMatrix {
    fn new(width: usize) -> Self {
        Self {
            gram: DMatrix::zeros(width, width),
            rows: 0.0,
        }
    }

    /// Adds a row with these coefficients of offsets and friction.
    fn add<'a>(
        &mut self,
        nuisance: &mut NuisanceFilter,
        g: impl Iterator<Item = &'a f64>,
        line: impl Iterator<Item = &'a f64>,
    ) {
        let (g, mut line): (Vec<f64>, Vec<f64>) = (g.copied().collect(), line.copied().collect());
        nuisance.update(&g, &mut line);
        let there: Vec<usize> = (0..line.len()).filter(|&i| line[i] != 0.0).collect();
        for &i in &there {
            for &j in &there {
                self.gram[(j, i)] += line[i] * line[j];
            }
        }
        self.rows += 1.0;
    }
}

/// See the [module](self).
struct ConfigurationEvidence {
    sensors: usize,
    /// The rows of F/T sensors, in which a force has the weight of its torque at a lever of
    /// [`Structure::LENGTH_SCALE`]; torques and forces of each sensor, to which the residual of its
    /// rows is attributed; the torque of each degree of freedom.
    groups: Vec<GramMatrix>,
    /// The base and its proper acceleration, if it stands still.
    base: Option<(usize, Vec3)>,
    instants: usize,
}

impl ConfigurationEvidence {
    fn new(robot: &Robot) -> Self {
        let sensors = robot.structure.sensors().len();
        let mut new = Self {
            sensors,
            groups: Vec::new(),
            base: None,
            instants: 0,
        };
        let count = new.joint(robot.model.dof_count());
        new.groups = vec![GramMatrix::new(new.width()); count];
        new
    }

    fn width(&self) -> usize {
        3 + 36 * self.sensors + 2
    }

    /// The group of a degree of freedom.
    fn joint(&self, dof: usize) -> usize {
        1 + 2 * self.sensors + dof
    }

    fn add(&mut self, other: &Self) {
        for (own, other) in self.groups.iter_mut().zip(&other.groups) {
            own.gram += &other.gram;
            own.rows += other.rows;
        }
        self.base = match (self.instants, self.base == other.base) {
            (0, _) | (_, true) => other.base,
            _ => None,
        };
        self.instants += other.instants;
    }

    fn add_log(
        &mut self,
        robot: &Robot,
        inputs: &[IdentificationInput],
        log: &PreparedLog,
    ) -> Result<(), DynamicsError> {
        let step = log.instants.len().div_ceil(MAX_OBSERVATIONS).max(1);
        let some: Vec<&Annotated> = log.instants.iter().step_by(step).collect();
        // Joint torques are a reference even if nothing is identified from them.
        let inputs = [inputs, &[IdentificationInput::Torque]].concat();
        let measurement = MeasurementModel::for_observations(robot, &inputs, some.iter().copied())?;
        let base = |instant: &Observation| (instant.base_link, instant.base);
        let Some(first) = some.first() else {
            return Ok(());
        };
        let stands = matches!(robot.base, BaseMotion::Standing(_))
            && some.iter().all(|instant| base(instant) == base(first));
        self.base = stands.then(|| (first.base_link, first.base.proper_acceleration));
        let parts = measurement.map(some.chunks(STRETCH), |measurement, stretch| {
            let mut part = Self {
                base: self.base,
                ..Self::new(robot)
            };
            part.add_stretch(measurement, stretch);
            part
        });
        parts.iter().for_each(|part| self.add(part));
        Ok(())
    }

    /// Adds observations with common offsets and friction.
    fn add_stretch(&mut self, measurement: &mut MeasurementModel<'_>, stretch: &[&Annotated]) {
        let unknowns = measurement.unknowns().clone();
        let (offsets, last) = (unknowns.nuisance(), self.width() - 1);
        // A rotor is among what is eliminated: CAD does not contain it.
        let mut prior = nuisance_prior(&unknowns);
        prior.extend(unknowns.precision.iter().map(|precision| 1.0 / precision));
        let mut nuisance = NuisanceFilter::new(&prior, last + 1);
        let mut of_sensors = nuisance.clone();
        let ones = vec![1.0; unknowns.channels()];
        let mut variances = ones.clone();
        for torque in (0..unknowns.sensors.len()).flat_map(|index| 6 * index..6 * index + 3) {
            variances[torque] = Structure::LENGTH_SCALE.powi(2);
        }
        for instant in stretch {
            let Ok(mut rows) = measurement.checked_rows(instant) else {
                continue;
            };
            self.instants += 1;
            let mut lines = DMatrix::zeros(rows.count, last + 1);
            if self.base.is_some() {
                gravity_columns(measurement, instant, &mut lines);
            }
            reading_columns(&unknowns, instant, &rows, &mut lines);
            let g = |rows: &MeasurementRows| {
                DMatrix::from_fn(rows.count, prior.len(), |row, column| {
                    match column.checked_sub(offsets) {
                        None => rows.g(row)[column],
                        Some(rotor) => rows.a(row)[unknowns.inertial() + rotor],
                    }
                })
            };
            let all = g(&rows);
            for (index, &sensor) in unknowns.sensors.iter().enumerate() {
                let channels = 6 * index..6 * index + 6;
                let Some(map) = attribute_to(&rows, &ones, channels.clone()) else {
                    continue;
                };
                let (g, lines) = (&map * &all, &map * &lines);
                for (k, _) in channels
                    .enumerate()
                    .filter(|(_, channel)| rows.has(*channel))
                {
                    let group = &mut self.groups[1 + 2 * sensor + k / 3];
                    group.add(&mut of_sensors, g.row(k).iter(), lines.row(k).iter());
                }
            }
            let mut lines = lines.transpose();
            rows.whiten_with(&variances, lines.as_mut_slice(), last + 1);
            let all = g(&rows);
            for row in 0..rows.count {
                let joint = rows.joint(row);
                let group = joint.map_or(0, |joint| self.joint(unknowns.joints[joint]));
                let line = lines.column(row);
                self.groups[group].add(&mut nuisance, all.row(row).iter(), line.iter());
            }
        }
    }

    /// Coefficients of the columns of readings: these multiples of the readings of each sensor.
    fn readings(&self, of: impl Fn(usize) -> Matrix6<f64>) -> DVector<f64> {
        let mut vector = DVector::zeros(self.width());
        for sensor in 0..self.sensors {
            let matrix = of(sensor);
            for (i, j) in (0..6).flat_map(|i| (0..6).map(move |j| (i, j))) {
                vector[entry(sensor, i, j)] = matrix[(i, j)];
            }
        }
        vector
    }

    /// Mean square of the sensors' readings per instant.
    fn change(&self) -> f64 {
        let readings = self.readings(|_| Matrix6::identity());
        squares(&self.groups[0].gram, &readings) / self.instants.max(1) as f64
    }

    /// Degrees of freedom whose torque has a wrong unit or sign.
    fn faulty_torques(&self, robot: &Robot) -> Vec<(usize, ReadingFault)> {
        let mut torque = DVector::zeros(self.width());
        torque[self.width() - 2] = 1.0;
        let compared: Vec<_> = self.groups[self.joint(0)..]
            .iter()
            .map(|group| TorqueComparison::new(&group.gram, group.rows, &torque))
            .collect();
        let slides: Vec<bool> = (0..compared.len())
            .map(|dof| robot.model.is_prismatic(dof))
            .collect();
        let faults = torque_faults(&compared, &slides).into_iter().enumerate();
        faults
            .filter_map(|(dof, fault)| Some((dof, fault?)))
            .collect()
    }

    /// Findings of wrong units of F/T readings; refusals if nothing can be identified from them.
    fn wrong_units(&self, robot: &Robot) -> Vec<Finding> {
        let bodies = robot.model.inertias().iter();
        let weight = GRAVITY * bodies.map(|body| body.mass).sum::<f64>();
        let mut faults = Vec::new();
        for sensor in 0..self.sensors {
            let noise = robot.structure.sensors()[sensor].noise();
            let [torque, force] = [noise.torque, noise.force].map(|x| Vec3::from(x).max());
            let compared =
                [(0, torque, LEVER * weight), (1, force, weight)].map(|(kind, noise, most)| {
                    let reading = self.readings(|other| {
                        let is_own = |i: usize| other == sensor && i / 3 == kind;
                        let weight = |i: usize, _| if is_own(i) { 1.0 } else { 0.0 };
                        Matrix6::from_diagonal(&Vector6::from_fn(weight))
                    });
                    let group = &self.groups[1 + 2 * sensor + kind];
                    let compared = TorqueComparison::new(&group.gram, group.rows, &reading)?;
                    (compared.predicted > ABOVE_NOISE * noise).then_some((compared, most))
                });
            let fault = wrench_fault(&compared);
            faults.extend(fault.map(|fault| (sensor, fault, compared)));
        }
        // The prediction of one sensor uses the other sensors of its sub-tree: one that is far too
        // large makes the others look too small.
        let is_large =
            |fault: ReadingFault| matches!(fault, ReadingFault::Unit(ratio) if ratio > 1.0);
        if faults.iter().any(|(_, fault, _)| is_large(*fault)) {
            faults.retain(|(_, fault, _)| *fault == ReadingFault::Odd || is_large(*fault));
        }
        let findings = faults.into_iter();
        findings
            .map(|(sensor, fault, [torque, force])| {
                let ratio = |of: Option<(TorqueComparison, f64)>| of.map(|(own, _)| own.ratio);
                fault.of_wrench(&sensor_name(robot, sensor), ratio(force), ratio(torque))
            })
            .collect()
    }

    /// Sensors whose readings fit CAD only in another frame than the configuration says.
    fn wrong_frames(&self, robot: &Robot) -> Vec<Finding> {
        let gram = &self.groups[0].gram;
        let without = squares(gram, &self.readings(|_| Matrix6::identity()));
        let remains = |chosen: &[(usize, Mounting)]| {
            let mut changed = self.readings(|sensor| {
                let correction = chosen.iter().find(|(own, _)| *own == sensor);
                correction.map_or_else(Matrix6::zeros, |(_, own)| own.change - Matrix6::identity())
            });
            changed[self.width() - 1] = 1.0;
            squares(gram, &changed)
        };
        // Signs first; then, sensor by sensor, frames with a name before turned axes.
        let tried = |chosen: &[(usize, Mounting)]| {
            let is_open = |own: &usize| chosen.iter().all(|(other, _)| other != own);
            let open: Vec<usize> = (0..self.sensors).filter(is_open).collect();
            let opposite = open.iter().map(|&own| (own, Mounting::opposite()));
            let mut tried: Vec<(usize, Mounting)> = opposite.collect();
            if remains(chosen) > STRANGE * without {
                let each = open.iter().flat_map(|&sensor| {
                    let all = mountings(robot, sensor).into_iter();
                    all.map(move |mounting| (sensor, mounting))
                });
                tried.extend(each.filter(|own| {
                    remains(&[chosen, std::slice::from_ref(own)].concat()) < STRANGE * without
                }));
            }
            tried
        };
        let cost = |chosen: &[(usize, Mounting)]| Some(remains(chosen));
        let mut chosen = accepted(tried, cost, |before| (1.0 - REMAINING) * before, SIMILAR);
        chosen.sort_by_key(|(sensor, _)| *sensor);
        let findings = chosen.into_iter().map(|(sensor, mounting)| {
            let sensor = sensor_name(robot, sensor);
            let (code, text) = match mounting.instead {
                None => (
                    FindingCode::WrongSign,
                    "fits only with the opposite sign (masses would be negative): check \
                     `direction` and `frame` in the configuration and, if an IMU measures gravity, \
                     that it is not upside down"
                        .to_owned(),
                ),
                Some(instead) => {
                    let text = format!(
                        "does not fit the links beyond it in the configured frame, but would with \
                         {instead}: check its mounting, and `frame` and `direction` in its \
                         [[force_torque]]"
                    );
                    (FindingCode::WrongFrame, text)
                }
            };
            let text = format!("wrench/{sensor} {text}");
            Finding::refusal(code, sensor, text)
        });
        findings.collect()
    }

    /// The finding, if the logs contradict the configured gravity.
    fn wrong_gravity(&self, robot: &Robot, with_torques: bool) -> Option<Finding> {
        let (base, configured) = self.base?;
        let mut gram = self.groups[0].gram.clone();
        if with_torques {
            let joints = &self.groups[self.joint(0)..];
            joints.iter().for_each(|joint| gram += &joint.gram);
        }
        let columns: Matrix3<f64> = gram.fixed_view::<3, 3>(0, 0).into_owned();
        let right: Vector3<f64> = gram.fixed_view::<3, 1>(0, self.width() - 1).into_owned();
        let remains = |by: Vec3| {
            let mut change = DVector::zeros(self.width());
            change.rows_mut(0, 3).copy_from(&(by / GRAVITY));
            change[self.width() - 1] = 1.0;
            squares(&gram, &change)
        };
        let best = configured - GRAVITY * columns.cholesky()?.solve(&right);
        let found = best.normalize() * configured.norm();
        let is_other_axis = found.dot(&configured) < 0.5_f64.sqrt() * configured.norm_squared();
        let share = remains(found - configured) / remains(Vec3::zeros());
        if !is_other_axis || share > REMAINING_OF_GRAVITY {
            return None;
        }
        let written = |p: &Vec3| {
            let [x, y, z] = [-p.x, -p.y, -p.z].map(|x| if x.abs() < 0.05 { 0.0 } else { x });
            format!("[{x:.1}, {y:.1}, {z:.1}]")
        };
        Some(Finding::refusal(
            FindingCode::WrongGravity,
            "base.gravity_mps2",
            format!(
                "the logs contradict the configured gravity_mps2 = {}: with {} in the axes of {} \
                 the URDF's links leave {:.0} % of the error; correct [base]",
                written(&configured),
                written(&found),
                robot.model.link_name(base),
                100.0 * share.sqrt()
            ),
        ))
    }
}

/// Writes what 1 g along each axis adds to the rows of an observation.
fn gravity_columns(
    measurement: &mut MeasurementModel<'_>,
    instant: &Annotated,
    lines: &mut DMatrix<f64>,
) {
    let mut right = |axis: Vec3| {
        let upright = MotionReading::Upright(axis);
        let other = instant.clone().map(|own| own.read_as(upright));
        let rows = measurement.rows(&other);
        (rows.count == lines.nrows()).then(|| DVector::from_vec(rows.r))
    };
    let without = right(Vec3::zeros());
    let with = [0, 1, 2].map(|axis| right(Vec3::ith(axis, 1.0)));
    for (axis, with) in with.into_iter().enumerate() {
        if let (Some(with), Some(without)) = (with, &without) {
            lines.set_column(axis, &(with - without));
        }
    }
}

/// Writes the columns of the readings in the rows of an observation, and the right side.
fn reading_columns(
    unknowns: &Unknowns,
    instant: &Annotated,
    rows: &MeasurementRows,
    lines: &mut DMatrix<f64>,
) {
    let last = lines.ncols() - 1;
    for row in 0..rows.count {
        for (index, &sensor) in unknowns.sensors.iter().enumerate() {
            let reading = instant.readings[sensor].torque_first();
            for (i, g) in rows.g(row)[6 * index..][..6].iter().enumerate() {
                for (j, y) in reading.iter().enumerate().filter(|_| *g != 0.0) {
                    lines[(row, entry(sensor, i, j))] = g * y;
                }
            }
        }
        if let Some(joint) = rows.joint(row) {
            lines[(row, last - 1)] = instant.torque[unknowns.joints[joint]];
        }
        lines[(row, last)] = rows.r(row);
    }
}

/// The column of `g_i y_j` of a sensor.
fn entry(sensor: usize, i: usize, j: usize) -> usize {
    3 + 36 * sensor + 6 * i + j
}

/// The square sum of a combination of columns.
fn squares(gram: &DMatrix<f64>, of: &DVector<f64>) -> f64 {
    of.dot(&(gram * of))
}
