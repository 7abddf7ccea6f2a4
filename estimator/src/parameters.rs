//! parameters.toml: the identified parameters of a robot (inertial parameters, F/T offsets and
//! calibrations, friction) and their covariance.
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

use std::io;

use crate::drive::Drive;
use nalgebra::DMatrix;
use proprio_topics::Nanos;
use serde::Deserialize;

use proprio_dynamics::calibration::{Calibration, Kind};
use proprio_dynamics::model::{JointKind, Model, ModelError};
use proprio_dynamics::spatial::{RigidInertia, Wrench};
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
    links: Vec<Link>,
    sensors: Vec<Offset>,
    joints: Vec<Friction>,
    drives: Vec<Drive>,
    /// Standard deviation of each column.
    deviations: Vec<f64>,
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
    pub logs: Vec<Span>,
}

/// A log that parameters were identified from.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Span {
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

/// A body of the model: its place in the tree, its parameters in the URDF, and those identified.
#[derive(Clone, Debug, PartialEq)]
struct Link {
    name: String,
    joint: Option<String>,
    parent: Option<String>,
    placement: [f64; 12],
    axis: Option<[f64; 3]>,
    cad: [f64; 10],
    identified: Option<[f64; 10]>,
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
    pub calibrated: Option<Calibrated>,
}

/// A sensor's calibration, and which parts of it were identified and are uncertain.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibrated {
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
        let model = &robot.model;
        let link = |(number, cad): (usize, &RigidInertia)| {
            let joint = number
                .checked_sub(1)
                .and_then(|joint| model.joints().get(joint));
            let placement = joint.map_or_else(proprio_dynamics::spatial::Pose::identity, |joint| {
                joint.placement
            });
            let (t, r) = (placement.translation, placement.rotation.transpose());
            let mut numbers = [0.0; 12];
            let values = t.iter().chain(r.iter());
            numbers
                .iter_mut()
                .zip(values)
                .for_each(|(place, value)| *place = *value);
            Link {
                name: model.link_name(number).to_owned(),
                joint: joint.map(|joint| model.joint_name(joint.child - 1).to_owned()),
                parent: joint.map(|joint| model.link_name(joint.parent).to_owned()),
                placement: numbers,
                axis: joint.and_then(|joint| match joint.kind {
                    JointKind::Revolute(axis) | JointKind::Prismatic(axis) => {
                        Some(axis.vector.into())
                    }
                    JointKind::Fixed => None,
                }),
                cad: cad.parameters(),
                identified: None,
            }
        };
        Self {
            robot: robot.name.clone(),
            provenance,
            links: robot
                .model
                .inertias()
                .iter()
                .enumerate()
                .map(link)
                .collect(),
            sensors: Vec::new(),
            joints: Vec::new(),
            drives: Vec::new(),
            deviations: Vec::new(),
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
        let mut new = Self {
            links: self
                .links
                .iter()
                .map(|link| Link {
                    identified: None,
                    ..link.clone()
                })
                .collect(),
            sensors: offsets.to_vec(),
            ..self.clone()
        };
        let count = new.links.len();
        for (number, inertia) in inertias {
            let Some(link) = new
                .links
                .get_mut(*number)
                .filter(|link| link.identified.is_none())
            else {
                return Err(ParametersError::Link {
                    number: *number,
                    count,
                });
            };
            link.identified = Some(inertia.parameters());
        }
        // In the file links are in the order of the model.
        let mut order: Vec<usize> = (0..inertias.len()).collect();
        order.sort_by_key(|&i| inertias.get(i).map(|(number, _)| *number));
        let order: Vec<usize> = order
            .into_iter()
            .flat_map(|i| 10 * i..10 * (i + 1))
            .chain(10 * inertias.len()..columns)
            .collect();
        if root.iter().any(|value| !value.is_finite()) {
            return Err(ParametersError::Value("the covariance".into()));
        }
        let sorted = DMatrix::from_fn(root.nrows(), columns, |i, j| root[(i, order[j])]);
        let upper = triangle(sorted);
        new.deviations = (0..columns).map(|j| upper.column(j).norm()).collect();
        new.correlation.clear();
        for (j, &deviation) in new.deviations.iter().enumerate() {
            let scale = if deviation > 0.0 {
                UNIT / deviation
            } else {
                0.0
            };
            // At most one in magnitude, so it fits.
            #[allow(clippy::cast_possible_truncation, reason = "at most 1e9")]
            new.correlation
                .extend((0..=j).map(|i| (upper[(i, j)] * scale).round() as i32));
        }
        new.check()?;
        *self = new;
        Ok(())
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
    pub fn set_drives(&mut self, drives: &[Drive]) -> Result<(), ParametersError> {
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
        self.links.get(link)?.identified?;
        let before = self
            .links
            .iter()
            .take(link)
            .filter(|l| l.identified.is_some())
            .count();
        self.deviations
            .get(10 * before..10 * (before + 1))?
            .try_into()
            .ok()
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

    /// Standard deviation of an offset, by its place in [`Parameters::offsets`].
    #[must_use]
    pub fn offset_deviation(&self, place: usize) -> Option<Wrench> {
        let first = 10 * self.identified().count() + 6 * place;
        let deviations = self.deviations.get(first..first + 6)?.try_into().ok()?;
        Some(Wrench::from_torque_first(deviations))
    }

    /// Standard deviations of the identified unknowns of a sensor's calibration, by its place in
    /// [`Parameters::offsets`], in the order of [`Kind::unknowns`].
    #[must_use]
    pub fn calibration_deviation(&self, place: usize) -> &[f64] {
        let before = self.sensors.get(..place).map_or(0, calibration_columns);
        let count = self
            .sensors
            .get(place..=place)
            .map_or(0, calibration_columns);
        let first = 10 * self.identified().count() + 6 * self.sensors.len() + before;
        self.deviations
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
    pub fn drives(&self) -> &[Drive] {
        &self.drives
    }

    /// The covariance's root: upper triangular `U` with `P = U^T U`.
    #[must_use]
    pub fn root(&self) -> DMatrix<f64> {
        let columns = self.deviations.len();
        let mut root = DMatrix::zeros(columns, columns);
        let mut numbers = self.correlation.iter();
        for (j, deviation) in self.deviations.iter().enumerate() {
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
    pub fn check_robot(&self, robot: &Robot) -> Result<(), ParametersError> {
        if self.robot != robot.name {
            return Err(ParametersError::Robot {
                found: self.robot.clone(),
                expected: robot.name.clone(),
            });
        }
        let model = |what: String| Err(ParametersError::Model { what });
        let ours = Self::new(robot, Provenance::default()).links;
        for (theirs, ours) in self.links.iter().zip(&ours) {
            let name = &ours.name;
            if theirs.name != *name {
                return model(format!(
                    "it has link {} where the URDF has {name}",
                    theirs.name
                ));
            }
            if theirs.joint != ours.joint || theirs.parent != ours.parent {
                return model(format!("link {name} has another parent or joint there"));
            }
            let same = |a: &[f64], b: &[f64], size: f64| {
                a.iter().zip(b).all(|(a, b)| (a - b).abs() <= SAME * size)
            };
            let axes = match (theirs.axis, ours.axis) {
                (Some(a), Some(b)) => same(&a, &b, 1.0),
                (a, b) => a.is_none() == b.is_none(),
            };
            if !(axes && same(&theirs.placement, &ours.placement, 1.0)) {
                return model(format!("link {name} has another frame or axis there"));
            }
            let size = ours
                .cad
                .iter()
                .fold(0.0, |most, value| f64::max(most, value.abs()));
            if !same(&theirs.cad, &ours.cad, size) {
                return model(format!(
                    "link {name} has other inertial parameters in that URDF"
                ));
            }
        }
        match (self.links.get(ours.len()), ours.get(self.links.len())) {
            (Some(more), _) => {
                return model(format!(
                    "it has link {}, which the URDF does not have",
                    more.name
                ));
            }
            (_, Some(more)) => {
                return model(format!(
                    "the URDF has link {}, which it does not have",
                    more.name
                ));
            }
            _ => {}
        }
        for offset in &self.sensors {
            if robot.sensor(&offset.sensor).is_none() {
                return Err(ParametersError::Unknown {
                    what: "force/torque sensor",
                    name: offset.sensor.clone(),
                });
            }
        }
        let joints = self.joints.iter().map(|joint| &joint.joint);
        let mut joints = joints.chain(self.drives.iter().map(|drive| &drive.joint));
        match joints.find(|joint| robot.model.dof(joint).is_none()) {
            Some(joint) => Err(ParametersError::Unknown {
                what: "joint",
                name: joint.clone(),
            }),
            None => Ok(()),
        }
    }

    /// Checks the conditions that hold for every set of parameters.
    fn check(&self) -> Result<(), ParametersError> {
        let finite = |what: &dyn Fn() -> String, values: &[f64]| match values
            .iter()
            .all(|v| v.is_finite())
        {
            true => Ok(()),
            false => Err(ParametersError::Value(what())),
        };
        if let Some(tau) = self.provenance.tau {
            finite(&|| "provenance.tau".into(), &[tau])?;
        }
        let mut names = std::collections::HashSet::new();
        let mut new_name = |name: &str| match names.insert(name.to_owned()) {
            true => Ok(()),
            false => Err(ParametersError::Damaged(format!("{name} is given twice"))),
        };
        for link in &self.links {
            let at = || format!("link {}", link.name);
            new_name(&at())?;
            finite(&at, &link.placement)?;
            finite(&at, &link.axis.unwrap_or_default())?;
            finite(&at, &link.cad)?;
            if let Some(identified) = &link.identified {
                finite(&at, identified)?;
                RigidInertia::from_parameters(identified)
                    .check(1e-9)
                    .map_err(|why| ParametersError::Inconsistent {
                        link: link.name.clone(),
                        why: why.to_string(),
                    })?;
            }
        }
        for sensor in &self.sensors {
            let at = || format!("sensor {}", sensor.sensor);
            new_name(&at())?;
            finite(&at, &sensor.reading.force_first())?;
            finite(&at, &sensor.drift.force_first().map(f64::sqrt))?;
            finite(&at, &sensor.noise.force_first().map(f64::sqrt))?;
            if let Some(Calibrated { calibration, kind }) = &sensor.calibrated {
                finite(&at, &calibration.gain_force_first())?;
                finite(&at, &calibration.per_kelvin().force_first())?;
                finite(&at, calibration.reference().as_slice())?;
                let counts = kind.temperature || *calibration.per_kelvin() != Wrench::zero();
                if counts && calibration.reference().is_none() {
                    return Err(ParametersError::Damaged(format!(
                        "{}: reference_celsius is missing",
                        at()
                    )));
                }
            }
        }
        for joint in &self.joints {
            let at = || format!("joint {}", joint.joint);
            new_name(&at())?;
            finite(&at, &[joint.coulomb, joint.viscous, joint.offset])?;
            if let Some(rotor) = joint.rotor {
                // The square root of a negative number is NaN.
                finite(&at, &[rotor.inertia, rotor.deviation.sqrt()])?;
            }
        }
        for drive in &self.drives {
            let at = || format!("drive {}", drive.joint);
            new_name(&at())?;
            finite(&at, &drive.parameters)?;
            finite(&at, drive.covariance.as_slice())?;
            // The square root of a negative number is NaN; so is the quotient of two zeros.
            let variances = drive.covariance.diagonal().map(f64::sqrt);
            finite(&at, variances.as_slice())?;
            finite(&at, &drive.inherited.map(f64::sqrt))?;
            finite(&at, &[drive.noise.sqrt(), 1.0 / drive.parameters[0]])?;
        }
        // The square root of a negative number is NaN.
        let roots: Vec<f64> = self.deviations.iter().map(|d| d.sqrt()).collect();
        finite(&|| "a standard deviation".into(), &roots)
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
            deviations: Vec::new(),
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
