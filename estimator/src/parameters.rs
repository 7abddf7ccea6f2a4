//! parameters.toml: the identified parameters of a robot (inertial parameters, F/T offsets and
//! calibrations, friction, drives) and their covariance.
//!
//! ```text
//! identification -> Parameters -> parameters.toml -> Setup::apply -> InertialState -> Pipeline
//!                              -> identified.urdf
//! ```
//!
//! Links that were not identified keep the URDF's parameters, with the relative standard deviation
//! `identification.urdf_relative_std` of estimator.toml. The file format is described in
//! `parameters/file.rs`.

mod file;

use std::collections::HashSet;
use std::io;

use crate::config::{exactly, exactly_if_given};
use crate::drive::DriveModel;
use nalgebra::DMatrix;
use proprio_topics::Nanos;
use serde::Deserialize;

use proprio_dynamics::calibration::{Calibration, Kind};
use proprio_dynamics::model::{JointKind, Model, ModelError};
use proprio_dynamics::spatial::{Pose, RigidInertia, Wrench};
use proprio_identification::Robot;

/// The length of a column of the correlation root, in the units in which it is written.
const UNIT: f64 = 1e9;

/// Tolerance when a link's frame or inertia is compared between two machines that read the same
/// URDF, relative to 1 or to the inertia.
const SAME: f64 = 1e-9;

/// The identified parameters of a robot, and their covariance.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    robot: String,
    provenance: Provenance,
    links: Vec<LinkRecord>,
    sensors: Vec<Offset>,
    joints: Vec<Friction>,
    drives: Vec<DriveModel>,
    /// Standard deviation of each column after those of the links.
    sensor_deviations: Vec<f64>,
    /// The upper triangular root of the correlation, column by column, each down to its diagonal,
    /// in units of 1 / [`UNIT`].
    correlation: Vec<i32>,
}

/// The origin of the parameters.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// The program and its version.
    pub program: String,
    /// The scale of the prior, if there was one.
    pub tau: Option<f64>,
    /// The logs.
    #[serde(default, rename = "log")]
    pub logs: Vec<UsedLog>,
}

/// A log that parameters were identified from.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UsedLog {
    /// Its file name.
    pub file: String,
    /// The first instant that was used, in the log's clock.
    #[serde(rename = "start_ns", with = "nanoseconds")]
    pub start: Nanos,
    /// The last instant that was used.
    #[serde(rename = "end_ns", with = "nanoseconds")]
    pub end: Nanos,
}

mod nanoseconds {
    use proprio_topics::Nanos;
    use serde::{Deserialize, Deserializer};

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<Nanos, D::Error> {
        i64::deserialize(deserializer).map(Nanos)
    }
}

/// A body of the model, as in the file: its place in the tree, its parameters in the URDF, and
/// those identified with their standard deviations.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct LinkRecord {
    name: String,
    joint: Option<String>,
    parent: Option<String>,
    #[serde(deserialize_with = "exactly")]
    placement: [f64; 12],
    #[serde(default, deserialize_with = "exactly_if_given")]
    axis: Option<[f64; 3]>,
    #[serde(deserialize_with = "exactly")]
    cad: [f64; 10],
    #[serde(default, deserialize_with = "exactly_if_given")]
    identified: Option<[f64; 10]>,
    #[serde(default, deserialize_with = "exactly_if_given")]
    std: Option<[f64; 10]>,
}

/// The offset of an F/T sensor: its reading without load.
#[derive(Clone, Debug, PartialEq)]
pub struct Offset {
    /// The sensor's channel.
    pub sensor: String,
    /// The offset, in the sensor's measurement frame.
    pub reading: Wrench,
    /// Its drift (random walk): standard deviation of each channel after one second
    /// [Nm/s^½, N/s^½].
    pub drift: Wrench,
    /// The instant of the offset, in the clock of the log.
    pub known: Nanos,
    /// Standard deviation of the residual of a reading with these parameters [Nm, N]: sensor noise
    /// and model error; zero if it does not exceed the configured noise.
    pub noise: Wrench,
    /// The sensor's calibration, if it was identified; else the configured one is used. It is
    /// applied before the offset is subtracted.
    pub calibrated: Option<SensorCalibration>,
}

/// A sensor's calibration, and which parts of it were identified and are uncertain.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorCalibration {
    /// The complete calibration: the identified correction applied to the configured one.
    pub calibration: Calibration,
    /// The identified parts. They have columns in the covariance, relative to the corrected
    /// reading.
    pub kind: Kind,
}

/// Friction of a joint, and the offset of its torque sensor:
///
/// measured torque = torque + coulomb tanh(dq / v0) + viscous dq + offset (+ rotor inertia ddq).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Friction {
    /// The joint.
    pub joint: String,
    /// Coulomb friction \[Nm or N\].
    pub coulomb: f64,
    /// Viscous friction \[Nm s/rad or N s/m\].
    pub viscous: f64,
    /// Measured torque without load and motion \[Nm or N\].
    pub offset: f64,
    /// The rotor of its motor, if the torque was measured at the motor.
    pub rotor: Option<Rotor>,
}

/// Inertia of a motor's rotor, reflected to its joint: times the square of the gear ratio.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rotor {
    /// The inertia \[kg m^2; kg for a prismatic joint\].
    pub inertia: f64,
    /// Its standard deviation.
    pub deviation: f64,
}

/// Why parameters cannot be read, written or used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ParametersError {
    /// The file cannot be read.
    #[error("cannot be read: {0}")]
    Read(io::Error),
    /// The file cannot be written; what was there before is as it was.
    #[error("cannot be written: {0}")]
    Write(io::Error),
    /// It is no parameters file, or it is truncated, or a value in it is wrong.
    #[error("is damaged, or is not a parameters.toml: {0}; use a backup, or identify again")]
    Damaged(String),
    /// It has another version of the format.
    #[error(
        "has schema = {0}; this version reads schema = 1: identify again, or use the version that \
         wrote it"
    )]
    Schema(i64),
    /// It belongs to another robot.
    #[error(
        "belongs to robot {found:?}, not to {expected:?}; use the parameters of {expected:?}, or \
         identify again"
    )]
    Robot {
        /// The robot of the file.
        found: String,
        /// The robot of the configuration.
        expected: String,
    },
    /// It was identified with another model.
    #[error(
        "was identified with another model: {what}; use the URDF and the F/T joints that it was \
         identified with, or identify again"
    )]
    Model {
        /// The first difference.
        what: String,
    },
    /// It has an F/T sensor or a joint that the robot does not have.
    #[error("has {what} {name:?}, which the configuration does not have; identify again")]
    Unknown {
        /// Sensor or joint.
        what: &'static str,
        /// Its name.
        name: String,
    },
    /// A physically inconsistent body.
    #[error("link {link}: no rigid body has these ten parameters: {why}")]
    Inconsistent {
        /// The link.
        link: String,
        /// What is wrong with it.
        why: String,
    },
    /// A wrong number of values.
    #[error("{what}: {got} given, {expected} needed")]
    Size {
        /// The quantity.
        what: &'static str,
        /// How many were given.
        got: usize,
        /// How many are needed.
        expected: usize,
    },
    /// A link that does not exist, or is given twice.
    #[error("link {number} is given twice, or is not one of the {count} links")]
    Link {
        /// Its number.
        number: usize,
        /// How many links there are.
        count: usize,
    },
    /// A number is NaN or infinite, or a standard deviation is negative.
    #[error("{0}: a number is not finite, or a standard deviation is negative")]
    Value(String),
}

impl Parameters {
    /// Parameters of a robot with nothing identified yet.
    #[must_use]
    pub fn new(robot: &Robot, provenance: Provenance) -> Self {
        let bodies = robot.model.inertias().iter().enumerate();
        Self {
            robot: robot.name.clone(),
            provenance,
            links: bodies
                .map(|(link, cad)| LinkRecord::new(&robot.model, link, cad))
                .collect(),
            sensors: Vec::new(),
            joints: Vec::new(),
            drives: Vec::new(),
            sensor_deviations: Vec::new(),
            correlation: Vec::new(),
        }
    }

    /// Sets the identified parameters: the inertias of some links by number, the offsets and
    /// calibrations of some sensors, and their covariance. `root` is any matrix for which
    /// `root^T root` is the covariance of [ten parameters per link | torque and force offset per
    /// sensor | identified unknowns of each sensor's calibration], in the order given. (If `R^T R`
    /// is the information matrix, the inverse of the covariance, then `root` is `R^-T`.)
    ///
    /// # Errors
    /// A link that does not exist or is given twice, a physically inconsistent body, a root of
    /// another width, numbers that are not finite. Nothing is changed then.
    pub fn set_identified(
        &mut self,
        inertias: &[(usize, RigidInertia)],
        offsets: &[Offset],
        root: &DMatrix<f64>,
    ) -> Result<(), ParametersError> {
        let columns = 10 * inertias.len() + 6 * offsets.len() + calibration_columns(offsets);
        if root.ncols() != columns {
            return Err(ParametersError::Size {
                what: "columns of the covariance's root",
                got: root.ncols(),
                expected: columns,
            });
        }
        if root.iter().any(|value| !value.is_finite()) {
            return Err(ParametersError::Value("the covariance".into()));
        }
        let mut new = Self {
            sensors: offsets.to_vec(),
            ..self.clone()
        };
        for link in &mut new.links {
            (link.identified, link.std) = (None, None);
        }
        let count = new.links.len();
        for (number, inertia) in inertias {
            let link = new.links.get_mut(*number);
            let link = link.filter(|link| link.identified.is_none());
            let error = ParametersError::Link {
                number: *number,
                count,
            };
            link.ok_or(error)?.identified = Some(inertia.parameters());
        }
        // In the file links are in the order of the model.
        let mut order: Vec<usize> = (0..inertias.len()).collect();
        order.sort_by_key(|&i| inertias.get(i).map(|(number, _)| *number));
        let order: Vec<usize> = order
            .into_iter()
            .flat_map(|i| 10 * i..10 * (i + 1))
            .chain(10 * inertias.len()..columns)
            .collect();
        let sorted = DMatrix::from_fn(root.nrows(), columns, |i, j| root[(i, order[j])]);
        new.set_covariance(&triangle(sorted));
        new.check()?;
        *self = new;
        Ok(())
    }

    /// Takes the covariance over [identified links | sensors] as its upper triangular root.
    fn set_covariance(&mut self, upper: &DMatrix<f64>) {
        let mut deviations = (0..upper.ncols()).map(|j| upper.column(j).norm());
        self.correlation.clear();
        for (j, deviation) in deviations.clone().enumerate() {
            let scale = if deviation > 0.0 {
                UNIT / deviation
            } else {
                0.0
            };
            // At most one in magnitude, so it fits.
            #[allow(clippy::cast_possible_truncation, reason = "at most 1e9")]
            self.correlation
                .extend((0..=j).map(|i| (upper[(i, j)] * scale).round() as i32));
        }
        for link in self.links.iter_mut().filter(|l| l.identified.is_some()) {
            link.std = Some(std::array::from_fn(|_| deviations.next().unwrap_or(0.0)));
        }
        self.sensor_deviations = deviations.collect();
    }

    /// Sets the friction of joints.
    ///
    /// # Errors
    /// A number is not finite. Nothing is changed then.
    pub fn set_friction(&mut self, joints: &[Friction]) -> Result<(), ParametersError> {
        let new = Self {
            joints: joints.to_vec(),
            ..self.clone()
        };
        new.check()?;
        *self = new;
        Ok(())
    }

    /// Sets the drives of joints.
    ///
    /// # Errors
    /// A number is not finite, a variance is negative, or a constant is zero. Nothing is changed
    /// then.
    pub fn set_drives(&mut self, drives: &[DriveModel]) -> Result<(), ParametersError> {
        let new = Self {
            drives: drives.to_vec(),
            ..self.clone()
        };
        new.check()?;
        *self = new;
        Ok(())
    }

    /// The name of the robot.
    #[must_use]
    pub fn robot(&self) -> &str {
        &self.robot
    }

    /// The origin of the parameters.
    #[must_use]
    pub fn provenance(&self) -> &Provenance {
        &self.provenance
    }

    /// The identified inertia of a link of the model, about its origin and in its axes; none if it
    /// was not identified.
    #[must_use]
    pub fn inertia(&self, link: usize) -> Option<RigidInertia> {
        let identified = self.links.get(link)?.identified.as_ref()?;
        Some(RigidInertia::from_parameters(identified))
    }

    /// Standard deviations of an identified link's ten parameters; none if it was not identified.
    #[must_use]
    pub fn deviation(&self, link: usize) -> Option<[f64; 10]> {
        self.links.get(link)?.std
    }

    /// The standard deviation of each column of the covariance.
    fn deviations(&self) -> impl Iterator<Item = &f64> {
        let links = self.links.iter().filter_map(|link| link.std.as_ref());
        links.flatten().chain(&self.sensor_deviations)
    }

    /// The links that were identified, by their numbers in the model, ascending: their columns come
    /// first in the covariance.
    pub fn identified(&self) -> impl Iterator<Item = usize> {
        let links = self.links.iter().enumerate();
        links
            .filter(|(_, link)| link.identified.is_some())
            .map(|(number, _)| number)
    }

    /// Offsets of the F/T sensors, and their calibrations: their columns come last in the
    /// covariance, six each, then those of the calibrations.
    #[must_use]
    pub fn offsets(&self) -> &[Offset] {
        &self.sensors
    }

    /// Standard deviation of an offset, by its index in [`Parameters::offsets`].
    #[must_use]
    pub(crate) fn offset_deviation(&self, index: usize) -> Option<Wrench> {
        let (sensors, _) = self.sensor_deviations.as_chunks();
        sensors
            .get(..self.sensors.len())?
            .get(index)
            .copied()
            .map(Wrench::from_torque_first)
    }

    /// Standard deviations of the identified unknowns of a sensor's calibration, by its index in
    /// [`Parameters::offsets`], in the order of [`Kind::unknowns`].
    #[must_use]
    pub fn calibration_deviation(&self, index: usize) -> &[f64] {
        let before = self.sensors.get(..index).map_or(0, calibration_columns);
        let count = self
            .sensors
            .get(index..=index)
            .map_or(0, calibration_columns);
        let first = 6 * self.sensors.len() + before;
        self.sensor_deviations
            .get(first..first + count)
            .unwrap_or_default()
    }

    /// Friction of the joints whose torque was measured.
    #[must_use]
    pub fn friction(&self) -> &[Friction] {
        &self.joints
    }

    /// The drives that the torques are compared with.
    #[must_use]
    pub fn drives(&self) -> &[DriveModel] {
        &self.drives
    }

    /// The covariance's root: upper triangular `U` with `P = U^T U`.
    #[must_use]
    pub fn root(&self) -> DMatrix<f64> {
        let columns = self.deviations().count();
        let mut root = DMatrix::zeros(columns, columns);
        let mut numbers = self.correlation.iter();
        for (j, deviation) in self.deviations().enumerate() {
            for i in 0..=j {
                root[(i, j)] = numbers
                    .next()
                    .map_or(0.0, |&n| f64::from(n) / UNIT * deviation);
            }
        }
        root
    }

    /// The text of a URDF with the inertias of the identified links; everything else stays byte for
    /// byte ([`Model::rewrite_urdf`]).
    ///
    /// # Errors
    /// The URDF is not the one of `robot`.
    pub fn urdf(&self, text: &str, robot: &Robot) -> Result<String, ModelError> {
        let keep: Vec<&str> = robot
            .structure
            .sensors()
            .iter()
            .map(|sensor| robot.model.joint_name(sensor.joint()))
            .collect();
        let inertias: Vec<RigidInertia> = robot
            .model
            .inertias()
            .iter()
            .enumerate()
            .map(|(link, cad)| self.inertia(link).unwrap_or(*cad))
            .collect();
        Model::rewrite_urdf(text, &keep, &inertias)
    }

    /// Checks that the parameters belong to `robot`: its name, its links and their frames, their
    /// inertias in the URDF, its sensors and joints.
    ///
    /// # Errors
    /// The first difference.
    pub(crate) fn check_robot(&self, robot: &Robot) -> Result<(), ParametersError> {
        if self.robot != robot.name {
            return Err(ParametersError::Robot {
                found: self.robot.clone(),
                expected: robot.name.clone(),
            });
        }
        let ours = Self::new(robot, Provenance::default()).links;
        let mut pairs = self.links.iter().zip(&ours);
        let differs = pairs
            .find_map(|(theirs, ours)| theirs.difference(ours))
            .or_else(|| {
                let more = self.links.get(ours.len())?;
                let name = &more.name;
                Some(format!("it has link {name}, which the URDF does not have"))
            })
            .or_else(|| {
                let more = ours.get(self.links.len())?;
                let name = &more.name;
                Some(format!("the URDF has link {name}, which it does not have"))
            });
        if let Some(what) = differs {
            return Err(ParametersError::Model { what });
        }
        let unknown = |what, name: &str| {
            let name = name.to_owned();
            Err(ParametersError::Unknown { what, name })
        };
        let mut sensors = self.sensors.iter().map(|offset| &offset.sensor);
        if let Some(sensor) = sensors.find(|sensor| robot.sensor(sensor).is_none()) {
            return unknown("force/torque sensor", sensor);
        }
        let joints = self.joints.iter().map(|joint| &joint.joint);
        let mut joints = joints.chain(self.drives.iter().map(|drive| &drive.joint));
        match joints.find(|joint| robot.model.dof(joint).is_none()) {
            Some(joint) => unknown("joint", joint),
            None => Ok(()),
        }
    }

    /// Checks the conditions that hold for every set of parameters.
    fn check(&self) -> Result<(), ParametersError> {
        finite("provenance.tau", self.provenance.tau.as_slice())?;
        let mut names = HashSet::new();
        let mut new_name = |name: String| match names.insert(name.clone()) {
            true => Ok(name),
            false => Err(ParametersError::Damaged(format!("{name} is given twice"))),
        };
        for link in &self.links {
            link.check(&new_name(format!("link {}", link.name))?)?;
        }
        for sensor in &self.sensors {
            sensor.check(&new_name(format!("sensor {}", sensor.sensor))?)?;
        }
        for joint in &self.joints {
            let at = new_name(format!("joint {}", joint.joint))?;
            finite(&at, &[joint.coulomb, joint.viscous, joint.offset])?;
            if let Some(rotor) = joint.rotor {
                finite(&at, &[rotor.inertia])?;
                deviations(&at, &[rotor.deviation])?;
            }
        }
        for drive in &self.drives {
            let at = new_name(format!("drive {}", drive.joint))?;
            finite(&at, &drive.parameters)?;
            finite(&at, drive.covariance.as_slice())?;
            deviations(&at, &drive.covariance.diagonal())?;
            deviations(&at, &drive.inherited)?;
            deviations(&at, &[drive.noise])?;
            finite(&at, &[1.0 / drive.parameters[0]])?;
        }
        deviations("a standard deviation", self.deviations())
    }
}

/// Checks that all numbers are finite.
fn finite(at: &str, values: &[f64]) -> Result<(), ParametersError> {
    match values.iter().all(|value| value.is_finite()) {
        true => Ok(()),
        false => Err(ParametersError::Value(at.to_owned())),
    }
}

/// Checks that all numbers can be standard deviations or variances.
fn deviations<'a>(
    at: &str,
    values: impl IntoIterator<Item = &'a f64>,
) -> Result<(), ParametersError> {
    // The square root of a negative number is NaN.
    match values.into_iter().all(|value| value.sqrt().is_finite()) {
        true => Ok(()),
        false => Err(ParametersError::Value(at.to_owned())),
    }
}

impl LinkRecord {
    /// A body that was not identified.
    fn new(model: &Model, number: usize, cad: &RigidInertia) -> Self {
        let joint = number
            .checked_sub(1)
            .and_then(|joint| model.joints().get(joint));
        let pose = joint.map_or_else(Pose::identity, |joint| joint.placement);
        let rows = pose.rotation.transpose();
        let mut placement = pose.translation.iter().chain(rows.iter()).copied();
        Self {
            name: model.link_name(number).to_owned(),
            joint: joint.map(|joint| model.joint_name(joint.child - 1).to_owned()),
            parent: joint.map(|joint| model.link_name(joint.parent).to_owned()),
            placement: std::array::from_fn(|_| placement.next().unwrap_or(0.0)),
            axis: joint.and_then(|joint| match joint.kind {
                JointKind::Revolute(axis) | JointKind::Prismatic(axis) => Some(axis.vector.into()),
                JointKind::Fixed => None,
            }),
            cad: cad.parameters(),
            identified: None,
            std: None,
        }
    }

    /// How this body of a file differs from that of the URDF.
    fn difference(&self, urdf: &Self) -> Option<String> {
        let name = &urdf.name;
        if self.name != *name {
            let own = &self.name;
            return Some(format!("it has link {own} where the URDF has {name}"));
        }
        if self.joint != urdf.joint || self.parent != urdf.parent {
            return Some(format!("link {name} has another parent or joint there"));
        }
        let same = |a: &[f64], b: &[f64], size: f64| {
            a.iter().zip(b).all(|(a, b)| (a - b).abs() <= SAME * size)
        };
        let axes = match (self.axis, urdf.axis) {
            (Some(a), Some(b)) => same(&a, &b, 1.0),
            (a, b) => a.is_none() == b.is_none(),
        };
        if !(axes && same(&self.placement, &urdf.placement, 1.0)) {
            return Some(format!("link {name} has another frame or axis there"));
        }
        let sizes = urdf.cad.iter().map(|value| value.abs());
        let is_same = same(&self.cad, &urdf.cad, sizes.fold(0.0, f64::max));
        (!is_same).then(|| format!("link {name} has other inertial parameters in that URDF"))
    }

    fn check(&self, at: &str) -> Result<(), ParametersError> {
        finite(at, &self.placement)?;
        finite(at, &self.axis.unwrap_or_default())?;
        finite(at, &self.cad)?;
        if let Some(identified) = &self.identified {
            finite(at, identified)?;
            let body = RigidInertia::from_parameters(identified);
            body.check(1e-9)
                .map_err(|why| ParametersError::Inconsistent {
                    link: self.name.clone(),
                    why: why.to_string(),
                })?;
        }
        Ok(())
    }
}

impl Offset {
    fn check(&self, at: &str) -> Result<(), ParametersError> {
        finite(at, &self.reading.force_first())?;
        deviations(at, &self.drift.force_first())?;
        deviations(at, &self.noise.force_first())?;
        let Some(SensorCalibration { calibration, kind }) = &self.calibrated else {
            return Ok(());
        };
        finite(at, &calibration.gain_force_first())?;
        finite(at, &calibration.per_kelvin().force_first())?;
        finite(at, calibration.reference().as_slice())?;
        let counts = kind.temperature || *calibration.per_kelvin() != Wrench::zero();
        if counts && calibration.reference().is_none() {
            let what = format!("{at}: reference_celsius is missing");
            return Err(ParametersError::Damaged(what));
        }
        Ok(())
    }
}

/// How many columns the calibrations of sensors have.
fn calibration_columns(sensors: &[Offset]) -> usize {
    let calibrated = sensors
        .iter()
        .filter_map(|sensor| sensor.calibrated.as_ref());
    calibrated.map(|found| found.kind.count()).sum()
}

/// The upper triangular root of the same covariance, with a non-negative diagonal.
fn triangle(root: DMatrix<f64>) -> DMatrix<f64> {
    let columns = root.ncols();
    let mut upper = DMatrix::zeros(columns, columns);
    if root.nrows() == 0 || columns == 0 {
        return upper;
    }
    let r = root.qr().r();
    for i in 0..r.nrows() {
        let sign = if r[(i, i)] < 0.0 { -1.0 } else { 1.0 };
        for j in i..columns {
            upper[(i, j)] = sign * r[(i, j)];
        }
    }
    upper
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files;
    use std::path::Path;

    fn unidentified(robot: &str) -> Parameters {
        Parameters {
            robot: robot.into(),
            provenance: Provenance::default(),
            links: Vec::new(),
            sensors: Vec::new(),
            joints: Vec::new(),
            drives: Vec::new(),
            sensor_deviations: Vec::new(),
            correlation: Vec::new(),
        }
    }

    /// Not a test alone: the next test starts it as a process, which aborts before the rename.
    #[test]
    fn dies_before_the_rename() {
        if let Some(file) = std::env::var_os("PROPRIO_TEST_PARAMETERS") {
            let mut new = files::begin(Path::new(&file)).unwrap();
            io::Write::write_all(&mut new, unidentified("new").to_string().as_bytes()).unwrap();
            std::process::abort();
        }
    }

    #[test]
    fn a_process_that_dies_while_it_writes_leaves_the_old_file_whole() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("parameters.toml");
        unidentified("old").save(&file).unwrap();
        let status = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "parameters::tests::dies_before_the_rename"])
            .env("PROPRIO_TEST_PARAMETERS", &file)
            .output()
            .unwrap()
            .status;
        assert!(!status.success());
        // The new file is there in full, beside the old one.
        let left: Vec<_> = std::fs::read_dir(folder.path())
            .unwrap()
            .map(|e| e.unwrap().path())
            .collect();
        assert_eq!(left.len(), 2, "{left:?}");
        let temporary = left.iter().find(|path| **path != file).unwrap();
        assert_eq!(Parameters::load(temporary).unwrap(), unidentified("new"));
        assert_eq!(Parameters::load(&file).unwrap(), unidentified("old"));
        // The leftover file does not disturb the next write.
        unidentified("next").save(&file).unwrap();
        assert_eq!(Parameters::load(&file).unwrap(), unidentified("next"));
        // A failed write returns an error.
        assert!(matches!(
            unidentified("x").save(&folder.path().join("no/such.toml")),
            Err(ParametersError::Write(_))
        ));
    }
}
