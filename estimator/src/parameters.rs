//! parameters.toml: what identification knows of a robot, to be used again: inertial parameters, F/T offsets, friction, and how certain they are.
//!
//! ```text
//! identification -> Parameters -> parameters.toml -> Setup::apply -> Model (inertias), offsets, Covariance -> Pipeline: torques and their deviations
//!                              -> identified.urdf                    URDF's links that were not identified: uncertain by `identification.model_std`
//! ```
//!
//! # The file
//! | key | meaning |
//! |---|---|
//! | `schema` | 1 |
//! | `robot` | whose: `robot` of estimator.toml |
//! | `[provenance]` | `program` and its version; `tau`, the prior's weight, if there was one |
//! | `[[provenance.log]]` | `file`, `start_ns`, `end_ns`: what it was identified from, instants in that log's clock |
//! | `[[link]]` | every body of the model, in its order: `name`; `joint`, `parent`, `placement` (translation \[m\], rotation row by row), `axis`, which place its frame; `cad`: its ten parameters in the URDF |
//! | | if it was identified: `identified`: the ten parameters of a body that can exist; `std`: their standard deviations |
//! | `[[sensor]]` | `name` of its channel; `offset_n`, `offset_nm`: what it reads with no load, at instant `known_ns`; `std_n`, `std_nm`; `drift_n`, `drift_nm`: standard deviations of how far it wanders in one second, in s^-½ |
//! | | if its calibration was identified, too ([`crate::calibration`]; these win over estimator.toml's): `gain`, 36 numbers row by row, rows and columns `fx fy fz tx ty tz`; `temperature_n_per_k`, `temperature_nm_per_k`, `reference_celsius`; |
//! | | and where they are uncertain: `gain_std`, 36 numbers or the 6 of a diagonal: of `E`, with the true wrench (1 + E) times the one read; `temperature_std_n_per_k`, `temperature_std_nm_per_k` |
//! | `[[joint]]` | `name`, `coulomb_nm`, `viscous_nms`, `offset_nm`: friction of a joint whose torque was measured (N and Ns if it slides); |
//! | | of one whose motor's torque was: `rotor_inertia_kgm2`, inertia of the rotor times the square of the gear ratio (kg if the joint slides), `rotor_inertia_std_kgm2` |
//! | `[correlation]` | `root`: see below |
//!
//! Ten parameters are `[m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz]` \[kg, kg m, kg m^2\] about the origin and in the axes of the link
//! ([`crate::spatial`]). Numbers are written with the shortest text that reads back the same, so that a file read and written again is the same file.
//!
//! # The covariance
//! Columns: ten per identified link, then six per sensor [torque; force], then what is unknown of each sensor's calibration ([`crate::calibration::Kind::unknowns`]), all in the order of the file. `P = U^T U`, `U` upper triangular, and `U = root diag(std)`: the columns of `root` have
//! unit length and are written one by one, from the top down to the diagonal, in units of 1e-9. So a number's rounding is half a billionth of its parameter's own standard deviation. A torque's deviation
//! comes out wrong by at most that times the sum of what all parameters would give it if they were independent; and even a combination a million times better known than its
//! parameters keeps three digits. An iCub (39 links, six sensors: 426 columns, 91 000 numbers) takes less than 1 MB.

use std::f64::consts::FRAC_1_SQRT_2;
use std::fmt::{self, Write as _};
use std::io;
use std::path::Path;

use nalgebra::{DMatrix, Matrix4, SMatrix};
use proprio_topics::Nanos;
use serde::Deserialize;

use crate::calibration::{Calibration, Kind, force_first, gain_from_force_first};
use crate::config::{Gain, exactly};
use crate::files;
use crate::identify::prior::{LEAST_MASS, LEAST_RADIUS};
use crate::model::{JointKind, Model, ModelError};
use crate::setup::Setup;
use crate::spatial::{Mat3, RigidInertia, Vec3, Wrench};

/// One of a column's length: how finely the correlation is written.
const UNIT: f64 = 1e9;
/// How far the same link's frame or inertia may be off between two machines that read the same URDF, relative to 1 or its size.
const SAME: f64 = 1e-9;

/// What identification knows of a robot.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    robot: String,
    provenance: Provenance,
    links: Vec<Link>,
    sensors: Vec<Offset>,
    joints: Vec<Friction>,
    /// Standard deviation of each column.
    deviations: Vec<f64>,
    /// Columns of the correlation's root one after the other, each down to its diagonal, in units of 1 / [`UNIT`].
    correlation: Vec<i32>,
}

/// Where parameters come from.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// The program and its version.
    pub program: String,
    /// The weight that the prior was given, if there was one.
    pub tau: Option<f64>,
    /// The logs.
    #[serde(default, rename = "log")]
    pub logs: Vec<Span>,
}

/// A log that parameters were identified from.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Span {
    /// Its name.
    pub file: String,
    /// The first instant that was used, in the log's clock.
    #[serde(rename = "start_ns", with = "nanoseconds")]
    pub start: Nanos,
    /// The last.
    #[serde(rename = "end_ns", with = "nanoseconds")]
    pub end: Nanos,
}

mod nanoseconds {
    use proprio_topics::Nanos;
    use serde::{Deserialize, Deserializer};

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Nanos, D::Error> {
        i64::deserialize(deserializer).map(Nanos)
    }
}

/// A body of the model: which it is, and what is known of it.
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

/// What an F/T sensor reads with no load.
#[derive(Clone, Debug, PartialEq)]
pub struct Offset {
    /// The sensor's channel.
    pub sensor: String,
    /// What it reads, in its measurement frame.
    pub reading: Wrench,
    /// How far it wanders in one second: standard deviation of each channel [Nm/s^½, N/s^½].
    pub drift: Wrench,
    /// When it was so, in the clock of the log.
    pub known: Nanos,
    /// Standard deviation of a reading about what these parameters say of it [Nm, N]: noise of the sensor, and what is wrong of the model; zero if it is no more than configured.
    pub noise: Wrench,
    /// How its readings are corrected before this is taken off, if that was identified; else as configured.
    pub calibrated: Option<Calibrated>,
}

/// How a sensor's readings are corrected, and what of that was identified and is uncertain.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibrated {
    /// All of it: what was found on top of what was configured.
    pub calibration: Calibration,
    /// What was identified: these have columns in the covariance, relative to the corrected reading.
    pub kind: Kind,
}

/// Friction of a joint, and what its torque sensor reads with no load: measured torque = torque + coulomb tanh(dq / v0) + viscous dq + offset (+ rotor inertia ddq).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Friction {
    /// The joint.
    pub joint: String,
    /// Coulomb friction \[Nm or N\].
    pub coulomb: f64,
    /// Viscous friction \[Nm s/rad or N s/m\].
    pub viscous: f64,
    /// What is measured without load and motion \[Nm or N\].
    pub offset: f64,
    /// The rotor of its motor, where that motor's torque was measured.
    pub rotor: Option<Rotor>,
}

/// Inertia of a motor's rotor, reflected to its joint: times the square of the gear ratio.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rotor {
    /// The inertia \[kg m^2; kg if the joint slides\].
    pub inertia: f64,
    /// Its standard deviation.
    pub deviation: f64,
}

/// Why parameters can not be read, written or used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ParametersError {
    /// The file can not be read.
    #[error("can not be read: {0}")]
    Read(io::Error),
    /// The file can not be written; what was there before is as it was.
    #[error("can not be written: {0}")]
    Write(io::Error),
    /// It is no parameters file, or only a part of one, or something in it is wrong.
    #[error("is damaged, or no parameters.toml: {0}; take a copy of it, or identify again")]
    Damaged(String),
    /// It is of another version.
    #[error("has schema = {0}; this version reads schema = 1: identify again, or use the version that wrote it")]
    Schema(i64),
    /// It is of another robot.
    #[error("is of robot {found:?}, not of {expected:?}: parameters belong to one robot")]
    Robot {
        /// Whose it is.
        found: String,
        /// Who asks.
        expected: String,
    },
    /// It was made with another model.
    #[error(
        "was identified with another model: {what}; use the URDF and the F/T joints that it was identified with, or identify again"
    )]
    Model {
        /// The first difference.
        what: String,
    },
    /// It has an F/T sensor or a joint that the robot has not.
    #[error("has {what} {name:?}, which the configuration has not; identify again")]
    Unknown {
        /// What.
        what: &'static str,
        /// Its name.
        name: String,
    },
    /// A body that can not exist.
    #[error("link {link}: no body has these ten parameters: {why}")]
    Inconsistent {
        /// The link.
        link: String,
        /// What is wrong with it.
        why: String,
    },
    /// Numbers that do not belong together.
    #[error("{what}: {got} given, {expected} needed")]
    Size {
        /// Of what.
        what: &'static str,
        /// How many were given.
        got: usize,
        /// How many are needed.
        expected: usize,
    },
    /// A link that is not there, or is given twice.
    #[error("link {number} is given twice, or is none of the {count} links")]
    Link {
        /// Its number.
        number: usize,
        /// How many links there are.
        count: usize,
    },
    /// A number is NaN or infinite, or a standard deviation is negative.
    #[error("{0}: a number is not finite, or a standard deviation negative")]
    Value(String),
}

impl Parameters {
    /// Of a setup's robot, with nothing identified yet.
    #[must_use]
    pub fn new(setup: &Setup, provenance: Provenance) -> Self {
        let model = &setup.model;
        let link = |(number, cad): (usize, &RigidInertia)| {
            let joint = number.checked_sub(1).and_then(|joint| model.joints().get(joint));
            let placement = joint.map_or_else(crate::spatial::Pose::identity, |joint| joint.placement);
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
                    JointKind::Revolute(axis) | JointKind::Prismatic(axis) => Some(axis.vector.into()),
                    JointKind::Fixed => None,
                }),
                cad: cad.parameters(),
                identified: None,
            }
        };
        Self {
            robot: setup.robot.clone(),
            provenance,
            links: setup.cad().iter().enumerate().map(link).collect(),
            sensors: Vec::new(),
            joints: Vec::new(),
            deviations: Vec::new(),
            correlation: Vec::new(),
        }
    }

    /// Sets what was identified: the inertias of some links by number, the offsets of some sensors, and how certain they are: `root` is any matrix with `root^T root` the covariance of
    /// [ten parameters per link | torque and force offset per sensor | what was identified of each sensor's calibration], in the order given. (With `R^T R` the inverse of the covariance, it is `R^-T`.)
    ///
    /// # Errors
    /// A link that is not there or given twice, a body that can not exist, a root of another width, numbers that are not finite. Nothing is changed then.
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
            let Some(link) = new.links.get_mut(*number).filter(|link| link.identified.is_none()) else {
                return Err(ParametersError::Link { number: *number, count });
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
            let scale = if deviation > 0.0 { UNIT / deviation } else { 0.0 };
            // At most one in size, so it fits.
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

    /// Whose they are.
    #[must_use]
    pub fn robot(&self) -> &str {
        &self.robot
    }

    /// Where they come from.
    #[must_use]
    pub fn provenance(&self) -> &Provenance {
        &self.provenance
    }

    /// The identified inertia of a link of the model, about its origin and in its axes; none if it was not identified.
    #[must_use]
    pub fn inertia(&self, link: usize) -> Option<RigidInertia> {
        let identified = self.links.get(link)?.identified.as_ref()?;
        Some(RigidInertia::from_parameters(identified))
    }

    /// Standard deviations of an identified link's ten parameters; none if it was not identified.
    #[must_use]
    pub fn deviation(&self, link: usize) -> Option<[f64; 10]> {
        self.links.get(link)?.identified?;
        let before = self.links.iter().take(link).filter(|l| l.identified.is_some()).count();
        self.deviations.get(10 * before..10 * (before + 1))?.try_into().ok()
    }

    /// The links that were identified, by their numbers in the model, ascending: their columns come first in the covariance.
    pub fn identified(&self) -> impl Iterator<Item = usize> {
        let links = self.links.iter().enumerate();
        links
            .filter(|(_, link)| link.identified.is_some())
            .map(|(number, _)| number)
    }

    /// Offsets of the F/T sensors, and their calibrations: their columns come last in the covariance, six each, then those of the calibrations.
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

    /// Standard deviations of what was identified of a sensor's calibration, by its place in [`Parameters::offsets`]: in the order of [`Kind::unknowns`].
    #[must_use]
    pub fn calibration_deviation(&self, place: usize) -> &[f64] {
        let before = self.sensors.get(..place).map_or(0, calibration_columns);
        let count = self.sensors.get(place..=place).map_or(0, calibration_columns);
        let first = 10 * self.identified().count() + 6 * self.sensors.len() + before;
        self.deviations.get(first..first + count).unwrap_or_default()
    }

    /// Friction of the joints whose torque was measured.
    #[must_use]
    pub fn friction(&self) -> &[Friction] {
        &self.joints
    }

    /// The covariance's root: upper triangular `U` with `P = U^T U`.
    #[must_use]
    pub fn root(&self) -> DMatrix<f64> {
        let columns = self.deviations.len();
        let mut root = DMatrix::zeros(columns, columns);
        let mut numbers = self.correlation.iter();
        for (j, deviation) in self.deviations.iter().enumerate() {
            for i in 0..=j {
                root[(i, j)] = numbers.next().map_or(0.0, |&n| f64::from(n) / UNIT * deviation);
            }
        }
        root
    }

    /// The text of a URDF with the inertias of the identified links; everything else stays byte for byte ([`Model::rewrite_urdf`]).
    ///
    /// # Errors
    /// The URDF is not the one of `setup`.
    pub fn urdf(&self, text: &str, setup: &Setup) -> Result<String, ModelError> {
        let keep: Vec<&str> = setup
            .structure
            .sensors()
            .iter()
            .map(|sensor| setup.model.joint_name(sensor.joint()))
            .collect();
        let inertias: Vec<RigidInertia> = setup
            .cad()
            .iter()
            .enumerate()
            .map(|(link, cad)| self.inertia(link).unwrap_or(*cad))
            .collect();
        Model::rewrite_urdf(text, &keep, &inertias)
    }

    /// Reads a file.
    ///
    /// # Errors
    /// [`ParametersError`].
    pub fn load(file: &Path) -> Result<Self, ParametersError> {
        let text = std::fs::read_to_string(file).map_err(|error| match error.kind() {
            io::ErrorKind::InvalidData => ParametersError::Damaged("it is not text".into()),
            _ => ParametersError::Read(error),
        })?;
        Self::parse(&text)
    }

    /// Reads the text of a file.
    ///
    /// # Errors
    /// [`ParametersError`].
    pub fn parse(text: &str) -> Result<Self, ParametersError> {
        let damaged = |error: toml::de::Error| {
            let line = error
                .span()
                .map(|span| 1 + text.get(..span.start).unwrap_or(text).matches('\n').count());
            ParametersError::Damaged(match line {
                Some(line) => format!("line {line}: {}", error.message().trim().replace('\n', ", ")),
                None => error.message().trim().replace('\n', ", "),
            })
        };
        // First the version: another one may have other keys.
        let Version { schema } = toml::from_str(text).map_err(damaged)?;
        if schema != 1 {
            return Err(ParametersError::Schema(schema));
        }
        let file: File = toml::from_str(text).map_err(damaged)?;
        file.parameters()
    }

    /// Writes a file: beside it first, then, once that is on the disk, in its place; so that whatever happens there is a whole one, the old or the new.
    ///
    /// # Errors
    /// The system's; the old file is as it was then.
    pub fn save(&self, file: &Path) -> Result<(), ParametersError> {
        files::replace(file, &self.to_string(), 0o644).map_err(ParametersError::Write)
    }

    /// Says whether they are a setup's robot's: its name, its links and their frames, their inertias in the URDF, its sensors and joints.
    ///
    /// # Errors
    /// The first difference.
    pub fn check_setup(&self, setup: &Setup) -> Result<(), ParametersError> {
        if self.robot != setup.robot {
            return Err(ParametersError::Robot {
                found: self.robot.clone(),
                expected: setup.robot.clone(),
            });
        }
        let model = |what: String| Err(ParametersError::Model { what });
        let ours = Self::new(setup, Provenance::default()).links;
        for (theirs, ours) in self.links.iter().zip(&ours) {
            let name = &ours.name;
            if theirs.name != *name {
                return model(format!("where it has link {}, the URDF has {name}", theirs.name));
            }
            if theirs.joint != ours.joint || theirs.parent != ours.parent {
                return model(format!("link {name} hangs in another place there"));
            }
            let same = |a: &[f64], b: &[f64], size: f64| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= SAME * size);
            let axes = match (theirs.axis, ours.axis) {
                (Some(a), Some(b)) => same(&a, &b, 1.0),
                (a, b) => a.is_none() == b.is_none(),
            };
            if !(axes && same(&theirs.placement, &ours.placement, 1.0)) {
                return model(format!("link {name} has another frame or axis there"));
            }
            let size = ours.cad.iter().fold(0.0, |most, value| f64::max(most, value.abs()));
            if !same(&theirs.cad, &ours.cad, size) {
                return model(format!("link {name} has other inertial parameters in its URDF"));
            }
        }
        match (self.links.get(ours.len()), ours.get(self.links.len())) {
            (Some(more), _) => return model(format!("it has link {}, which the URDF has not", more.name)),
            (_, Some(more)) => return model(format!("the URDF has link {}, which it has not", more.name)),
            _ => {}
        }
        for offset in &self.sensors {
            if setup.sensor(&offset.sensor).is_none() {
                return Err(ParametersError::Unknown {
                    what: "force/torque sensor",
                    name: offset.sensor.clone(),
                });
            }
        }
        match self.joints.iter().find(|joint| setup.model.dof(&joint.joint).is_none()) {
            Some(joint) => Err(ParametersError::Unknown {
                what: "joint",
                name: joint.joint.clone(),
            }),
            None => Ok(()),
        }
    }

    /// What must hold of every set of parameters.
    fn check(&self) -> Result<(), ParametersError> {
        let finite = |what: &dyn Fn() -> String, values: &[f64]| match values.iter().all(|v| v.is_finite()) {
            true => Ok(()),
            false => Err(ParametersError::Value(what())),
        };
        if let Some(tau) = self.provenance.tau {
            finite(&|| "provenance.tau".into(), &[tau])?;
        }
        let mut names = std::collections::HashSet::new();
        let mut new_name = |name: &str| match names.insert(name.to_owned()) {
            true => Ok(()),
            false => Err(ParametersError::Damaged(format!("{name} is there twice"))),
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
                        why: match why {
                            crate::spatial::Inconsistency::Mass(mass) => format!("its mass is {mass} kg"),
                            crate::spatial::Inconsistency::NotPositive { least } => {
                                format!("a principal moment about the centre of mass is {least:.3e} kg m^2")
                            }
                            crate::spatial::Inconsistency::Triangle { moments: [a, b, c] } => {
                                format!(
                                    "principal moments {a:.3e}, {b:.3e}, {c:.3e} kg m^2 break the triangle inequality"
                                )
                            }
                        },
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
                // Of a negative number the root is none.
                finite(&at, &[rotor.inertia, rotor.deviation.sqrt()])?;
            }
        }
        // Of a negative number the root is none.
        let roots: Vec<f64> = self.deviations.iter().map(|d| d.sqrt()).collect();
        finite(&|| "a standard deviation".into(), &roots)
    }
}

/// How many columns the calibrations of sensors have.
fn calibration_columns(sensors: &[Offset]) -> usize {
    let calibrated = sensors.iter().filter_map(|sensor| sensor.calibrated.as_ref());
    calibrated.map(|found| found.kind.count()).sum()
}

/// The upper triangle with the same covariance, with a diagonal that is not negative.
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

/// How uncertain a URDF's figures for a link are taken to be: ten rows `U` with `U^T U` the covariance of its ten parameters.
///
/// With the pseudo-inertia `J = L L^T` of the link, its error is `L S L^T`, `S` symmetric with independent entries, of standard deviation
/// `relative` on the diagonal and `relative / sqrt 2` beside it. So the mass, and the second moment of the mass about any plane, each has the relative standard
/// deviation `relative`, and the centre of mass is uncertain by that share, over the root of two, of the body's radius of gyration; this does not depend on the frame.
/// It is the quadratic form of the log-det divergence that identification has as its prior (Lee, Wensing, Park 2020): `d^T P^-1 d = tr((J^-1 dJ)^2) / relative^2`.
/// So it is the prior of [`crate::identify::prior`] with `tau = relative / sqrt 2`, as far as that is quadratic.
/// Bodies lighter than [`LEAST_MASS`] or thinner than [`LEAST_RADIUS`] count as that, or a point mass would be known to sit exactly where it is.
#[must_use]
pub fn cad_root(inertia: &RigidInertia, relative: f64) -> SMatrix<f64, 10, 10> {
    let centre = inertia.centre().unwrap_or_default();
    let sigma = Mat3::from_diagonal_element(inertia.inertia.trace() / 2.0) - inertia.inertia;
    let central = sigma - centre * inertia.first_moment.transpose();
    let mass = inertia.mass.max(LEAST_MASS);
    let eigen = ((central + central.transpose()) / 2.0).symmetric_eigen();
    let least = mass * LEAST_RADIUS * LEAST_RADIUS;
    let radii = eigen.eigenvalues.map(|value| value.max(least).sqrt());
    let mut l = Matrix4::zeros();
    for column in 0..3 {
        let axis: Vec3 = eigen.eigenvectors.column(column) * radii[column];
        l.fixed_view_mut::<3, 1>(0, column).copy_from(&axis);
    }
    l.fixed_view_mut::<3, 1>(0, 3).copy_from(&(centre * mass.sqrt()));
    l[(3, 3)] = mass.sqrt();
    let mut root = SMatrix::zeros();
    let pairs = (0..4).flat_map(|i| (i..4).map(move |j| (i, j)));
    for (row, (i, j)) in pairs.enumerate() {
        let (a, b) = (l.column(i).into_owned(), l.column(j).into_owned());
        let change = if i == j {
            a * a.transpose()
        } else {
            (a * b.transpose() + b * a.transpose()) * FRAC_1_SQRT_2
        } * relative;
        let at = |r: usize, c: usize| change[(r, c)];
        let half = at(0, 0) + at(1, 1) + at(2, 2);
        let numbers = [
            at(3, 3),
            at(0, 3),
            at(1, 3),
            at(2, 3),
            half - at(0, 0),
            -at(0, 1),
            -at(0, 2),
            half - at(1, 1),
            -at(1, 2),
            half - at(2, 2),
        ];
        for (column, value) in numbers.into_iter().enumerate() {
            root[(row, column)] = value;
        }
    }
    root
}

// ---------------------------------------------------------------- the text

impl fmt::Display for Parameters {
    /// The file.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let text = |s: &str| toml::Value::String(s.to_owned()).to_string();
        let moment = |w: &Wrench| -> [f64; 3] { w.torque.into() };
        let force = |w: &Wrench| -> [f64; 3] { w.force.into() };
        writeln!(
            f,
            "# What proprio identified of a robot. `proprio estimate --parameters`, and the estimator with `parameters = ` this file, take inertial parameters\n\
             # and F/T offsets from here instead of the URDF and estimator.toml. A link's ten parameters: [m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz] in kg, kg m,\n\
             # kg m^2, about its origin. `cad` is what the URDF says, `std` a standard deviation. Written by a program; to change parameters, identify again."
        )?;
        writeln!(f, "schema = 1\nrobot = {}\n\n[provenance]", text(&self.robot))?;
        writeln!(f, "program = {}", text(&self.provenance.program))?;
        if let Some(tau) = self.provenance.tau {
            writeln!(f, "tau = {tau:?}")?;
        }
        for Span { file, start, end } in &self.provenance.logs {
            writeln!(
                f,
                "\n[[provenance.log]]\nfile = {}\nstart_ns = {}\nend_ns = {}",
                text(file),
                start.0,
                end.0
            )?;
        }
        for (number, link) in self.links.iter().enumerate() {
            writeln!(f, "\n[[link]]\nname = {}", text(&link.name))?;
            if let (Some(joint), Some(parent)) = (&link.joint, &link.parent) {
                writeln!(f, "joint = {}\nparent = {}", text(joint), text(parent))?;
            }
            writeln!(f, "placement = {:?}", link.placement)?;
            if let Some(axis) = link.axis {
                writeln!(f, "axis = {axis:?}")?;
            }
            writeln!(f, "cad = {:?}", link.cad)?;
            if let (Some(identified), Some(deviation)) = (link.identified, self.deviation(number)) {
                writeln!(f, "identified = {identified:?}\nstd = {deviation:?}")?;
            }
        }
        for (place, sensor) in self.sensors.iter().enumerate() {
            let deviation = self.offset_deviation(place).unwrap_or_default();
            writeln!(
                f,
                "\n[[sensor]]\nname = {}\noffset_n = {:?}\noffset_nm = {:?}\nstd_n = {:?}\nstd_nm = {:?}\ndrift_n = {:?}\ndrift_nm = {:?}\nknown_ns = {}\nnoise_n = {:?}\nnoise_nm = {:?}",
                text(&sensor.sensor),
                force(&sensor.reading),
                moment(&sensor.reading),
                force(&deviation),
                moment(&deviation),
                force(&sensor.drift),
                moment(&sensor.drift),
                sensor.known.0,
                force(&sensor.noise),
                moment(&sensor.noise)
            )?;
            let Some(Calibrated { calibration, kind }) = &sensor.calibrated else {
                continue;
            };
            writeln!(f, "gain = {:?}", calibration.gain_force_first())?;
            let gains = kind.count() - 6 * usize::from(kind.temperature);
            let (gains, kelvins) = self
                .calibration_deviation(place)
                .split_at_checked(gains)
                .unwrap_or_default();
            if kind.gain != Gain::None {
                writeln!(f, "gain_std = {:?}", force_first(gains))?;
            }
            if let Some(reference) = calibration.reference() {
                let per_kelvin = calibration.per_kelvin();
                writeln!(
                    f,
                    "temperature_n_per_k = {:?}\ntemperature_nm_per_k = {:?}\nreference_celsius = {reference:?}",
                    force(per_kelvin),
                    moment(per_kelvin)
                )?;
            }
            if let [tx, ty, tz, fx, fy, fz] = kelvins {
                writeln!(
                    f,
                    "temperature_std_n_per_k = {:?}\ntemperature_std_nm_per_k = {:?}",
                    [fx, fy, fz],
                    [tx, ty, tz]
                )?;
            }
        }
        for joint in &self.joints {
            writeln!(
                f,
                "\n[[joint]]\nname = {}\ncoulomb_nm = {:?}\nviscous_nms = {:?}\noffset_nm = {:?}",
                text(&joint.joint),
                joint.coulomb,
                joint.viscous,
                joint.offset
            )?;
            if let Some(Rotor { inertia, deviation }) = joint.rotor {
                writeln!(
                    f,
                    "rotor_inertia_kgm2 = {inertia:?}\nrotor_inertia_std_kgm2 = {deviation:?}"
                )?;
            }
        }
        f.write_str("\n[correlation]\nroot = [\n")?;
        let mut numbers = self.correlation.as_slice();
        for column in 0..self.deviations.len() {
            let (own, rest) = numbers.split_at_checked(column + 1).unwrap_or((numbers, &[]));
            numbers = rest;
            for (place, number) in own.iter().enumerate() {
                f.write_char(if place == 0 { '[' } else { ',' })?;
                write!(f, "{number}")?;
            }
            f.write_str("],\n")?;
        }
        f.write_str("]\n")
    }
}

#[derive(Deserialize)]
struct Version {
    schema: i64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(rename = "schema")]
    _schema: i64,
    robot: String,
    provenance: Provenance,
    #[serde(default)]
    link: Vec<FileLink>,
    #[serde(default)]
    sensor: Vec<FileSensor>,
    #[serde(default)]
    joint: Vec<FileJoint>,
    // The last of the file: without it the rest is cut off.
    correlation: Correlation,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FileLink {
    name: String,
    joint: Option<String>,
    parent: Option<String>,
    placement: Numbers<12>,
    axis: Option<Numbers<3>>,
    cad: Numbers<10>,
    identified: Option<Numbers<10>>,
    std: Option<Numbers<10>>,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(transparent)]
struct Numbers<const N: usize>(#[serde(deserialize_with = "exactly")] [f64; N]);

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FileSensor {
    name: String,
    offset_n: Numbers<3>,
    offset_nm: Numbers<3>,
    std_n: Numbers<3>,
    std_nm: Numbers<3>,
    drift_n: Numbers<3>,
    drift_nm: Numbers<3>,
    #[serde(with = "nanoseconds", rename = "known_ns")]
    known: Nanos,
    noise_n: Option<Numbers<3>>,
    noise_nm: Option<Numbers<3>>,
    gain: Option<Vec<f64>>,
    gain_std: Option<Vec<f64>>,
    temperature_n_per_k: Option<Numbers<3>>,
    temperature_nm_per_k: Option<Numbers<3>>,
    temperature_std_n_per_k: Option<Numbers<3>>,
    temperature_std_nm_per_k: Option<Numbers<3>>,
    reference_celsius: Option<f64>,
}

impl FileSensor {
    /// How its readings are corrected, and the deviations of what is uncertain of it, in the order of their columns.
    fn calibrated(&self) -> Result<(Option<Calibrated>, Vec<f64>), ParametersError> {
        let damaged = |what: &str| Err(ParametersError::Damaged(format!("sensor {}: {what}", self.name)));
        let drifts = self.temperature_n_per_k.is_some();
        let stds = self.temperature_std_n_per_k.is_some();
        if drifts != self.temperature_nm_per_k.is_some()
            || drifts != self.reference_celsius.is_some()
            || stds != self.temperature_std_nm_per_k.is_some()
            || stds && !drifts
        {
            return damaged("what is said of temperature goes together");
        }
        let Some(gain) = &self.gain else {
            return match drifts || self.gain_std.is_some() {
                true => damaged("gain is missing"),
                false => Ok((None, Vec::new())),
            };
        };
        let Some(gain) = gain_from_force_first(gain) else {
            return damaged("gain has not 36 numbers, nor the 6 of a diagonal");
        };
        let gain_std = self.gain_std.as_deref().unwrap_or_default();
        let kind = match gain_std.len() {
            0 => Gain::None,
            6 => Gain::Diagonal,
            36 => Gain::Full,
            _ => return damaged("gain_std has not 36 numbers, nor the 6 of a diagonal"),
        };
        let numbers = |given: &Option<Numbers<3>>| given.as_ref().map_or([0.0; 3], |numbers| numbers.0);
        let mut deviations = force_first(gain_std);
        if stds {
            deviations.extend(numbers(&self.temperature_std_nm_per_k));
            deviations.extend(numbers(&self.temperature_std_n_per_k));
        }
        let per_kelvin = Wrench::from_parts(numbers(&self.temperature_n_per_k), numbers(&self.temperature_nm_per_k));
        let calibrated = Calibrated {
            calibration: Calibration::new(gain, per_kelvin, self.reference_celsius),
            kind: Kind {
                gain: kind,
                temperature: stds,
            },
        };
        Ok((Some(calibrated), deviations))
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FileJoint {
    name: String,
    coulomb_nm: f64,
    viscous_nms: f64,
    offset_nm: f64,
    rotor_inertia_kgm2: Option<f64>,
    rotor_inertia_std_kgm2: Option<f64>,
}

impl FileJoint {
    fn friction(self) -> Result<Friction, ParametersError> {
        let rotor = match (self.rotor_inertia_kgm2, self.rotor_inertia_std_kgm2) {
            (Some(inertia), Some(deviation)) => Some(Rotor { inertia, deviation }),
            (None, None) => None,
            _ => {
                return Err(ParametersError::Damaged(format!(
                    "joint {}: rotor_inertia_kgm2 and rotor_inertia_std_kgm2 go together",
                    self.name
                )));
            }
        };
        Ok(Friction {
            joint: self.name,
            coulomb: self.coulomb_nm,
            viscous: self.viscous_nms,
            offset: self.offset_nm,
            rotor,
        })
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Correlation {
    root: Vec<Vec<i32>>,
}

impl File {
    fn parameters(self) -> Result<Parameters, ParametersError> {
        let mut deviations = Vec::new();
        for link in &self.link {
            match (&link.identified, &link.std) {
                (Some(_), Some(std)) => deviations.extend(std.0),
                (None, None) => {}
                _ => {
                    return Err(ParametersError::Damaged(format!(
                        "link {}: identified and std go together",
                        link.name
                    )));
                }
            }
        }
        for sensor in &self.sensor {
            deviations.extend(sensor.std_nm.0.iter().chain(&sensor.std_n.0));
        }
        let mut calibrations = Vec::new();
        for sensor in &self.sensor {
            let (calibrated, own) = sensor.calibrated()?;
            calibrations.push(calibrated);
            deviations.extend(own);
        }
        let root = &self.correlation.root;
        let whole =
            root.len() == deviations.len() && root.iter().zip(1..).all(|(column, length)| column.len() == length);
        if !whole {
            return Err(ParametersError::Damaged(format!(
                "correlation.root has not the {} columns of what was identified, each one number longer than the one before",
                deviations.len()
            )));
        }
        for (number, (column, deviation)) in root.iter().zip(&deviations).enumerate() {
            let length = column
                .iter()
                .map(|&n| (f64::from(n) / UNIT).powi(2))
                .sum::<f64>()
                .sqrt();
            let expected = if *deviation > 0.0 { 1.0 } else { 0.0 };
            if (length - expected).abs() > 1e-6 {
                return Err(ParametersError::Damaged(format!(
                    "correlation.root: column {number} has length {length}, not {expected}"
                )));
            }
        }
        let parameters = Parameters {
            robot: self.robot,
            provenance: self.provenance,
            links: self
                .link
                .into_iter()
                .map(|link| Link {
                    name: link.name,
                    joint: link.joint,
                    parent: link.parent,
                    placement: link.placement.0,
                    axis: link.axis.map(|axis| axis.0),
                    cad: link.cad.0,
                    identified: link.identified.map(|numbers| numbers.0),
                })
                .collect(),
            sensors: self
                .sensor
                .into_iter()
                .zip(calibrations)
                .map(|(sensor, calibrated)| Offset {
                    calibrated,
                    sensor: sensor.name,
                    reading: Wrench::from_parts(sensor.offset_n.0, sensor.offset_nm.0),
                    drift: Wrench::from_parts(sensor.drift_n.0, sensor.drift_nm.0),
                    known: sensor.known,
                    noise: {
                        let of = |noise: Option<Numbers<3>>| noise.map_or([0.0; 3], |noise| noise.0);
                        Wrench::from_parts(of(sensor.noise_n), of(sensor.noise_nm))
                    },
                })
                .collect(),
            joints: self
                .joint
                .into_iter()
                .map(FileJoint::friction)
                .collect::<Result<_, _>>()?,
            correlation: self.correlation.root.concat(),
            deviations,
        };
        match parameters.check() {
            Err(error @ (ParametersError::Value(_) | ParametersError::Inconsistent { .. })) => {
                Err(ParametersError::Damaged(error.to_string()))
            }
            other => other.map(|()| parameters),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nothing(robot: &str) -> Parameters {
        Parameters {
            robot: robot.into(),
            provenance: Provenance::default(),
            links: Vec::new(),
            sensors: Vec::new(),
            joints: Vec::new(),
            deviations: Vec::new(),
            correlation: Vec::new(),
        }
    }

    /// Not a test by itself: the process that the next one starts and that dies at the worst moment.
    #[test]
    fn dies_before_the_rename() {
        if let Some(file) = std::env::var_os("PROPRIO_TEST_PARAMETERS") {
            let mut new = files::begin(Path::new(&file)).unwrap();
            io::Write::write_all(&mut new, nothing("new").to_string().as_bytes()).unwrap();
            std::process::abort();
        }
    }

    #[test]
    fn a_process_that_dies_while_it_writes_leaves_the_old_file_whole() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("parameters.toml");
        nothing("old").save(&file).unwrap();
        let status = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "parameters::tests::dies_before_the_rename"])
            .env("PROPRIO_TEST_PARAMETERS", &file)
            .output()
            .unwrap()
            .status;
        assert!(!status.success());
        // It came as far as the new file, all of it, beside the old one.
        let left: Vec<_> = std::fs::read_dir(folder.path())
            .unwrap()
            .map(|e| e.unwrap().path())
            .collect();
        assert_eq!(left.len(), 2, "{left:?}");
        let temporary = left.iter().find(|path| **path != file).unwrap();
        assert_eq!(Parameters::load(temporary).unwrap(), nothing("new"));
        assert_eq!(Parameters::load(&file).unwrap(), nothing("old"));
        // Whoever writes next is not disturbed by what was left.
        nothing("next").save(&file).unwrap();
        assert_eq!(Parameters::load(&file).unwrap(), nothing("next"));
        // Where it can not be written, the old one stays.
        assert!(matches!(
            nothing("x").save(&folder.path().join("no/such.toml")),
            Err(ParametersError::Write(_))
        ));
    }
}
