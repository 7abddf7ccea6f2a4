//! The text of parameters.toml: writing and reading.
//!
//! # The file
//! `schema` is 1. `robot` is the `robot` of estimator.toml.
//!
//! `[provenance]`: `program` with its version, and `tau`, the scale of the prior if there was one.
//! Each `[[provenance.log]]` has the `file` of a log, and `start_ns` and `end_ns`, the first and
//! last instant used, in that log's clock.
//!
//! `[[link]]`, one for every body of the model, in its order:
//!
//! | key | meaning |
//! |---|---|
//! | `name` | the link |
//! | `joint`, `parent` | the joint to its parent, and the parent |
//! | `placement` | its frame in the parent: translation \[m\], then rotation row by row |
//! | `axis` | the axis of the joint |
//! | `cad` | its ten parameters in the URDF |
//! | `identified` | its ten identified parameters, if it was identified |
//! | `std` | their standard deviations |
//!
//! `[[sensor]]`, one for each F/T sensor with an identified offset:
//!
//! | key | meaning |
//! |---|---|
//! | `name` | its channel |
//! | `offset_n`, `offset_nm` | its reading without load, at instant `known_ns` |
//! | `std_n`, `std_nm` | standard deviations of the offset |
//! | `drift_n`, `drift_nm` | drift of the offset: standard deviation after one second, in s^-½ |
//! | `noise_n`, `noise_nm` | standard deviation of the residual of a reading |
//!
//! and if its calibration was identified, too ([`proprio_dynamics::calibration`]), which then
//! replaces the one of estimator.toml:
//!
//! | key | meaning |
//! |---|---|
//! | `gain` | 36 numbers row by row, rows and columns `fx fy fz tx ty tz` |
//! | `gain_std` | standard deviations of `E`: 36 numbers, or the 6 of a diagonal |
//! | `temperature_n_per_k`, `temperature_nm_per_k` | temperature drift |
//! | `temperature_std_n_per_k`, `temperature_std_nm_per_k` | their standard deviations |
//! | `reference_celsius` | the board temperature at which the offset is valid |
//!
//! `E` is the relative error of the gain: the true wrench is (1 + E) times the corrected reading.
//! Only uncertain quantities have a standard deviation.
//!
//! `[[joint]]`, one for each joint whose torque was measured: `name`, `coulomb_nm`, `viscous_nms`,
//! `offset_nm` (N and Ns for a prismatic joint). If the torque was measured at the motor, also
//! `rotor_inertia_kgm2`, the inertia of the rotor times the square of the gear ratio (kg for a
//! prismatic joint), and `rotor_inertia_std_kgm2`.
//!
//! `[[drive]]`, one for each joint whose drive was identified ([`crate::drive`]):
//!
//! | key | meaning |
//! |---|---|
//! | `joint` | the joint |
//! | `signal` | what the drive reports: `"torque"` or `"current"` |
//! | `constant` | torque of the joint by the reported torque, or by the current [Nm/A] |
//! | `coulomb_nm`, `viscous_nms`, `load` | friction |
//! | `rotor_inertia_kgm2`, `offset_nm` | inertia of the rotor; offset of the report |
//! | `std` | standard deviations of these six, in this order, without what they inherit |
//! | `correlation` | the correlations of each with those after it: 15 numbers |
//! | `inherited_relative`, `inherited_nm` | errors of the torques that it was found from |
//! | `noise_nm` | standard deviation of what the model does not explain |
//!
//! (N and m in place of Nm and rad for a prismatic joint.)
//!
//! `[correlation]`: `root`, see below.
//!
//! The ten parameters are `[m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz]`
//! \[kg, kg m, kg m^2\] about the origin and in the axes of the link
//! ([`proprio_dynamics::spatial`]). Numbers are written with the shortest text that reads back the
//! same, so a file that is read and written again does not change.
//!
//! # The covariance
//! Columns: ten per identified link, then six per sensor [torque; force], then the unknowns of each
//! sensor's calibration ([`proprio_dynamics::calibration::Kind::unknowns`]), all in the order of
//! the file. `P = U^T U` with `U` upper triangular, and `U = root diag(std)`. The columns of `root`
//! have unit length. They are written one by one, from the top down to the diagonal, in units of
//! 1e-9, so the rounding error of a number is half a billionth of its parameter's standard
//! deviation. The error of a torque's standard deviation is at most that times the sum of the
//! contributions of all parameters if they were independent. Even a combination that is known a
//! million times better than its parameters keeps three digits. The file of an iCub (39 links, six
//! sensors: 426 columns, 91 000 numbers) has less than 1 MB.

use super::{
    Friction, LinkRecord, Offset, Parameters, ParametersError, Provenance, Rotor,
    SensorCalibration, UNIT, UsedLog, nanoseconds,
};
use crate::config::exactly;
use crate::drive::{DriveModel, DriveSignal};
use crate::files;
use nalgebra::Matrix6;
use proprio_dynamics::calibration::{Calibration, Gain, Kind, force_first, gain_from_force_first};
use proprio_dynamics::spatial::Wrench;
use proprio_topics::Nanos;
use serde::Deserialize;
use std::fmt::{self, Write as _};
use std::io;
use std::path::Path;

impl Parameters {
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
                Some(line) => format!(
                    "line {line}: {}",
                    error.message().trim().replace('\n', ", ")
                ),
                None => error.message().trim().replace('\n', ", "),
            })
        };
        // Read the version first: another version may have other keys.
        let Version { schema } = toml::from_str(text).map_err(damaged)?;
        if schema != 1 {
            return Err(ParametersError::Schema(schema));
        }
        let file: ParametersFile = toml::from_str(text).map_err(damaged)?;
        file.parameters()
    }

    /// Writes a file atomically: a crash leaves the old file or the new one.
    ///
    /// # Errors
    /// The error of the system; the old file is unchanged then.
    pub fn save(&self, file: &Path) -> Result<(), ParametersError> {
        files::replace(file, &self.to_string(), 0o644).map_err(ParametersError::Write)
    }
}

impl fmt::Display for Parameters {
    /// The text of the file.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "# The identified parameters of a robot. `proprio estimate --parameters`, and the\n\
             # estimator with the key `parameters`, use the inertial parameters and F/T offsets\n\
             # of this file instead of those of the URDF and estimator.toml. The ten parameters\n\
             # of a link are [m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz] in kg, kg m,\n\
             # kg m^2, about its origin. `cad`: the URDF's values. `std`: standard deviations.\n\
             # A program writes this file: to change parameters, identify again."
        )?;
        writeln!(
            f,
            "schema = 1\nrobot = {}\n\n[provenance]",
            text(&self.robot)
        )?;
        writeln!(f, "program = {}", text(&self.provenance.program))?;
        if let Some(tau) = self.provenance.tau {
            writeln!(f, "tau = {tau:?}")?;
        }
        for UsedLog { file, start, end } in &self.provenance.logs {
            writeln!(
                f,
                "\n[[provenance.log]]\nfile = {}\nstart_ns = {}\nend_ns = {}",
                text(file),
                start.0,
                end.0
            )?;
        }
        self.links.iter().try_for_each(|link| link.write(f))?;
        for (index, sensor) in self.sensors.iter().enumerate() {
            let deviation = self.offset_deviation(index).unwrap_or_default();
            sensor.write(f, &deviation, self.calibration_deviation(index))?;
        }
        self.joints.iter().try_for_each(|joint| joint.write(f))?;
        for drive in &self.drives {
            write_drive(f, drive)?;
        }
        f.write_str("\n[correlation]\nroot = [\n")?;
        let mut numbers = self.correlation.as_slice();
        for column in 0..self.deviations().count() {
            let (own, rest) = numbers
                .split_at_checked(column + 1)
                .unwrap_or((numbers, &[]));
            numbers = rest;
            for (index, number) in own.iter().enumerate() {
                f.write_char(if index == 0 { '[' } else { ',' })?;
                write!(f, "{number}")?;
            }
            f.write_str("],\n")?;
        }
        f.write_str("]\n")
    }
}

/// A string as TOML has it.
fn text(string: &str) -> String {
    toml::Value::String(string.to_owned()).to_string()
}

/// The two lines of a wrench: `<key>_n<per> = ...`, `<key>_nm<per> = ...`.
fn write_wrench(f: &mut fmt::Formatter<'_>, [key, per]: [&str; 2], wrench: &Wrench) -> fmt::Result {
    let force: [f64; 3] = wrench.force.into();
    let torque: [f64; 3] = wrench.torque.into();
    writeln!(f, "{key}_n{per} = {force:?}\n{key}_nm{per} = {torque:?}")
}

impl LinkRecord {
    fn write(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "\n[[link]]\nname = {}", text(&self.name))?;
        if let (Some(joint), Some(parent)) = (&self.joint, &self.parent) {
            writeln!(f, "joint = {}\nparent = {}", text(joint), text(parent))?;
        }
        writeln!(f, "placement = {:?}", self.placement)?;
        if let Some(axis) = self.axis {
            writeln!(f, "axis = {axis:?}")?;
        }
        writeln!(f, "cad = {:?}", self.cad)?;
        if let (Some(identified), Some(std)) = (self.identified, self.std) {
            writeln!(f, "identified = {identified:?}\nstd = {std:?}")?;
        }
        Ok(())
    }
}

impl Offset {
    /// Writes it with its standard deviation, and its calibration with those of its unknowns.
    fn write(
        &self,
        f: &mut fmt::Formatter<'_>,
        deviation: &Wrench,
        of_calibration: &[f64],
    ) -> fmt::Result {
        writeln!(f, "\n[[sensor]]\nname = {}", text(&self.sensor))?;
        write_wrench(f, ["offset", ""], &self.reading)?;
        write_wrench(f, ["std", ""], deviation)?;
        write_wrench(f, ["drift", ""], &self.drift)?;
        writeln!(f, "known_ns = {}", self.known.0)?;
        write_wrench(f, ["noise", ""], &self.noise)?;
        let Some(SensorCalibration { calibration, kind }) = &self.calibrated else {
            return Ok(());
        };
        writeln!(f, "gain = {:?}", calibration.gain_force_first())?;
        let gains = kind.count() - 6 * usize::from(kind.temperature);
        let (gains, kelvins) = of_calibration.split_at_checked(gains).unwrap_or_default();
        if kind.gain != Gain::None {
            writeln!(f, "gain_std = {:?}", force_first(gains))?;
        }
        if let Some(reference) = calibration.reference() {
            write_wrench(f, ["temperature", "_per_k"], calibration.per_kelvin())?;
            writeln!(f, "reference_celsius = {reference:?}")?;
        }
        if let Ok(kelvins) = <[f64; 6]>::try_from(kelvins) {
            let kelvins = Wrench::from_torque_first(kelvins);
            write_wrench(f, ["temperature_std", "_per_k"], &kelvins)?;
        }
        Ok(())
    }
}

impl Friction {
    fn write(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "\n[[joint]]\nname = {}\ncoulomb_nm = {:?}\nviscous_nms = {:?}\noffset_nm = {:?}",
            text(&self.joint),
            self.coulomb,
            self.viscous,
            self.offset
        )?;
        match self.rotor {
            Some(Rotor { inertia, deviation }) => writeln!(
                f,
                "rotor_inertia_kgm2 = {inertia:?}\nrotor_inertia_std_kgm2 = {deviation:?}"
            ),
            None => Ok(()),
        }
    }
}

fn write_drive(f: &mut fmt::Formatter<'_>, drive: &DriveModel) -> fmt::Result {
    let [constant, coulomb, viscous, load, rotor, offset] = drive.parameters;
    let signal = match drive.signal {
        DriveSignal::Torque => "torque",
        DriveSignal::Current => "current",
    };
    let std: [f64; 6] = std::array::from_fn(|i| drive.covariance[(i, i)].max(0.0).sqrt());
    let [relative, inherited] = drive.inherited;
    let correlation: Vec<f64> = pairs()
        .map(|(i, j)| match std[i] * std[j] {
            0.0 => 0.0,
            // Rounded, so that a file that is read and written again does not change.
            most => (UNIT * drive.covariance[(i, j)] / most).round() / UNIT,
        })
        .collect();
    writeln!(
        f,
        "\n[[drive]]\njoint = {}\nsignal = \"{signal}\"\nconstant = {constant:?}\n\
                 coulomb_nm = {coulomb:?}\nviscous_nms = {viscous:?}\nload = {load:?}\n\
                 rotor_inertia_kgm2 = {rotor:?}\noffset_nm = {offset:?}\nstd = {std:?}\n\
                 correlation = {correlation:?}\ninherited_relative = {relative:?}\n\
                 inherited_nm = {inherited:?}\nnoise_nm = {:?}",
        text(&drive.joint),
        drive.noise
    )
}

#[derive(Deserialize)]
struct Version {
    schema: i64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ParametersFile {
    #[serde(rename = "schema")]
    _schema: i64,
    robot: String,
    provenance: Provenance,
    #[serde(default)]
    link: Vec<LinkRecord>,
    #[serde(default)]
    sensor: Vec<FileSensor>,
    #[serde(default)]
    joint: Vec<FileJoint>,
    #[serde(default)]
    drive: Vec<FileDrive>,
    // The last section of the file: if it is missing, the file is truncated.
    correlation: Correlation,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(transparent)]
struct Exactly<const N: usize>(#[serde(deserialize_with = "exactly")] [f64; N]);

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FileSensor {
    name: String,
    offset_n: Exactly<3>,
    offset_nm: Exactly<3>,
    std_n: Exactly<3>,
    std_nm: Exactly<3>,
    drift_n: Exactly<3>,
    drift_nm: Exactly<3>,
    #[serde(with = "nanoseconds", rename = "known_ns")]
    known: Nanos,
    noise_n: Option<Exactly<3>>,
    noise_nm: Option<Exactly<3>>,
    gain: Option<Vec<f64>>,
    gain_std: Option<Vec<f64>>,
    temperature_n_per_k: Option<Exactly<3>>,
    temperature_nm_per_k: Option<Exactly<3>>,
    temperature_std_n_per_k: Option<Exactly<3>>,
    temperature_std_nm_per_k: Option<Exactly<3>>,
    reference_celsius: Option<f64>,
}

impl FileSensor {
    /// Its calibration, if it was identified, and the standard deviations of the uncertain
    /// quantities, in the order of their columns.
    fn calibrated(&self) -> Result<(Option<SensorCalibration>, Vec<f64>), ParametersError> {
        let damaged = |what: &str| {
            Err(ParametersError::Damaged(format!(
                "sensor {}: {what}",
                self.name
            )))
        };
        let drifts = self.temperature_n_per_k.is_some();
        let stds = self.temperature_std_n_per_k.is_some();
        if drifts != self.temperature_nm_per_k.is_some()
            || drifts != self.reference_celsius.is_some()
            || stds != self.temperature_std_nm_per_k.is_some()
            || stds && !drifts
        {
            return damaged(
                "the temperature keys are incomplete: temperature_n_per_k, temperature_nm_per_k \
                 and reference_celsius are needed together, and so are the two standard deviations",
            );
        }
        let Some(gain) = &self.gain else {
            return match drifts || self.gain_std.is_some() {
                true => damaged("gain is missing"),
                false => Ok((None, Vec::new())),
            };
        };
        let Some(gain) = gain_from_force_first(gain) else {
            return damaged("gain must have 36 numbers, or the 6 of a diagonal");
        };
        let gain_std = self.gain_std.as_deref().unwrap_or_default();
        let kind = match gain_std.len() {
            0 => Gain::None,
            6 => Gain::Diagonal,
            36 => Gain::Full,
            _ => return damaged("gain_std must have 36 numbers, or the 6 of a diagonal"),
        };
        let mut deviations = force_first(gain_std);
        if stds {
            deviations.extend(or_zero(self.temperature_std_nm_per_k));
            deviations.extend(or_zero(self.temperature_std_n_per_k));
        }
        let per_kelvin = Wrench::from_parts(
            or_zero(self.temperature_n_per_k),
            or_zero(self.temperature_nm_per_k),
        );
        let calibrated = SensorCalibration {
            calibration: Calibration::new(gain, per_kelvin, self.reference_celsius),
            kind: Kind {
                gain: kind,
                temperature: stds,
            },
        };
        Ok((Some(calibrated), deviations))
    }

    fn offset(self, calibrated: Option<SensorCalibration>) -> Offset {
        Offset {
            calibrated,
            sensor: self.name,
            reading: Wrench::from_parts(self.offset_n.0, self.offset_nm.0),
            drift: Wrench::from_parts(self.drift_n.0, self.drift_nm.0),
            known: self.known,
            noise: Wrench::from_parts(or_zero(self.noise_n), or_zero(self.noise_nm)),
        }
    }
}

fn or_zero(numbers: Option<Exactly<3>>) -> [f64; 3] {
    numbers.map_or([0.0; 3], |numbers| numbers.0)
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
                    "joint {}: only one of rotor_inertia_kgm2 and rotor_inertia_std_kgm2 is given",
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
struct FileDrive {
    joint: String,
    signal: DriveSignal,
    constant: f64,
    coulomb_nm: f64,
    viscous_nms: f64,
    load: f64,
    rotor_inertia_kgm2: f64,
    offset_nm: f64,
    std: Exactly<6>,
    correlation: Exactly<15>,
    inherited_relative: f64,
    inherited_nm: f64,
    noise_nm: f64,
}

impl FileDrive {
    fn drive(self) -> DriveModel {
        let std = self.std.0;
        let mut covariance = Matrix6::from_diagonal(&std.map(|std| std * std).into());
        for ((i, j), correlation) in pairs().zip(self.correlation.0) {
            covariance[(i, j)] = correlation * std[i] * std[j];
            covariance[(j, i)] = covariance[(i, j)];
        }
        DriveModel {
            joint: self.joint,
            signal: self.signal,
            parameters: [
                self.constant,
                self.coulomb_nm,
                self.viscous_nms,
                self.load,
                self.rotor_inertia_kgm2,
                self.offset_nm,
            ],
            covariance,
            inherited: [self.inherited_relative, self.inherited_nm],
            noise: self.noise_nm,
        }
    }
}

/// The places of a drive's correlations.
fn pairs() -> impl Iterator<Item = (usize, usize)> {
    (0..6).flat_map(|i| (i + 1..6).map(move |j| (i, j)))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Correlation {
    root: Vec<Vec<i32>>,
}

impl ParametersFile {
    fn parameters(self) -> Result<Parameters, ParametersError> {
        let is_half = |link: &&LinkRecord| link.identified.is_some() != link.std.is_some();
        if let Some(LinkRecord { name, .. }) = self.link.iter().find(is_half) {
            return Err(ParametersError::Damaged(format!(
                "link {name}: only one of identified and std is given"
            )));
        }
        let offsets = self.sensor.iter();
        let mut sensor_deviations: Vec<f64> = offsets
            .flat_map(|sensor| [sensor.std_nm.0, sensor.std_n.0])
            .flatten()
            .collect();
        let mut sensors = Vec::new();
        for sensor in self.sensor {
            let (calibrated, of_calibration) = sensor.calibrated()?;
            sensor_deviations.extend(of_calibration);
            sensors.push(sensor.offset(calibrated));
        }
        let parameters = Parameters {
            robot: self.robot,
            provenance: self.provenance,
            links: self.link,
            sensors,
            joints: self
                .joint
                .into_iter()
                .map(FileJoint::friction)
                .collect::<Result<_, _>>()?,
            drives: self.drive.into_iter().map(FileDrive::drive).collect(),
            sensor_deviations,
            correlation: self.correlation.root.concat(),
        };
        self.correlation.check(&parameters)?;
        match parameters.check() {
            Err(error @ (ParametersError::Value(_) | ParametersError::Inconsistent { .. })) => {
                Err(ParametersError::Damaged(error.to_string()))
            }
            other => other.map(|()| parameters),
        }
    }
}

impl Correlation {
    /// Checks that there is one column of unit length for each identified parameter.
    fn check(&self, parameters: &Parameters) -> Result<(), ParametersError> {
        let deviations: Vec<f64> = parameters.deviations().copied().collect();
        let mut lengths = self.root.iter().zip(1..);
        let is_triangle = lengths.all(|(column, length)| column.len() == length);
        if self.root.len() != deviations.len() || !is_triangle {
            return Err(ParametersError::Damaged(format!(
                "correlation.root must have {} columns, one for each identified parameter, each \
                 one number longer than the one before",
                deviations.len()
            )));
        }
        for (number, (column, deviation)) in self.root.iter().zip(deviations).enumerate() {
            let squares = column.iter().map(|&n| (f64::from(n) / UNIT).powi(2));
            let length = squares.sum::<f64>().sqrt();
            let expected = if deviation > 0.0 { 1.0 } else { 0.0 };
            if (length - expected).abs() > 1e-6 {
                return Err(ParametersError::Damaged(format!(
                    "correlation.root: column {number} has length {length}, not {expected}"
                )));
            }
        }
        Ok(())
    }
}
