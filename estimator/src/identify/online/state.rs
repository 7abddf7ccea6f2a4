//! What identification knows, in a file: what a robot was taught survives a restart.
//!
//! ```text
//! proprio identification state 3
//! robot <name>
//! model <hash of the links, the sensors and CAD>
//! sensors <hash of how each is mounted and calibrated>
//! component <unknowns> <tau> <1: parameters that were learnt are in force, 0: CAD's>
//! noise <variance of each F/T channel>
//! row <R_kk ... R_kn z_k>                     one line per parameter
//! ...
//! sum <hash of all before>
//! ```
//!
//! Numbers are the hexadecimal digits of their bits. The triangle is that of the parameters alone: an F/T offset may be another one after a restart. It holds no prior, so that
//! restarts do not count that twice. What it knows was read by the sensors as they were calibrated then: a gain of 7 % more would have made everything 7 % heavier.

use std::fmt::Write as _;
use std::io;
use std::path::{Path, PathBuf};

use super::{Job, Online, Part, WIDTH};
use crate::calibration::Calibration;
use crate::dynamics::Structure;
use crate::identify::information::{Information, Panel};

const TITLE: &str = "proprio identification state";
const SCHEMA: &str = "3";
/// What differs, in words.
const SENSORS: &str = "mounting or calibration of its force/torque sensors";

/// Why a state can not be resumed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StateError {
    /// The file can not be read or written.
    #[error("the state of identification can not be read or written: {0}")]
    Io(#[from] io::Error),
    /// It is no such file, or not a whole one.
    #[error("the state of identification is damaged ({0})")]
    Damaged(&'static str),
    /// Another version wrote it.
    #[error("the state of identification has schema {0}; this version reads {SCHEMA}")]
    Schema(String),
    /// It is of another robot, or of another model of it, or of other sensors.
    #[error("the state of identification is of another {what}: {found}, not {expected}")]
    Foreign {
        /// What differs.
        what: &'static str,
        /// What the file has.
        found: String,
        /// What there is.
        expected: String,
    },
}

/// How sensors measure: what the numbers of a state hang on beside the model.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Measuring(String);

impl Measuring {
    /// Of the structure's sensors, with these calibrations in the same order: where each sits, its measurement frame, its sign, its gain and what temperature does.
    pub fn new(structure: &Structure, calibrations: &[Calibration]) -> Self {
        let mut bytes = Vec::new();
        for cut in structure.sensors() {
            bytes.extend((cut.joint() as u64).to_le_bytes());
            let pose = cut.pose();
            let numbers = pose.rotation.iter().chain(pose.translation.iter()).copied();
            bytes.extend(numbers.chain([cut.sign()]).flat_map(|x| x.to_bits().to_le_bytes()));
        }
        for calibration in calibrations {
            let per_kelvin = calibration.per_kelvin().torque_first();
            let reference = calibration.reference().unwrap_or(f64::NAN);
            let numbers = calibration.gain().iter().copied().chain(per_kelvin).chain([reference]);
            bytes.extend(numbers.flat_map(|x| x.to_bits().to_le_bytes()));
        }
        Self(format!("{:016x}", hash(bytes.into_iter())))
    }
}

/// FNV-1a.
fn hash(bytes: impl Iterator<Item = u8>) -> u64 {
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    })
}

fn model(parts: &[Part]) -> String {
    let of = |part: &Part| {
        let numbers = part.links.iter().chain(&part.sensors).map(|number| *number as u64);
        let cad = part.reference.iter().skip(6 * part.sensors.len()).map(|x| x.to_bits());
        numbers.chain(cad).flat_map(u64::to_le_bytes).collect::<Vec<_>>()
    };
    format!("{:016x}", hash(parts.iter().flat_map(of)))
}

fn put(text: &mut String, word: &str, numbers: impl Iterator<Item = f64>) {
    text.push_str(word);
    for number in numbers {
        // Into a string: it can not fail.
        let _ = write!(text, " {:016x}", number.to_bits());
    }
    text.push('\n');
}

fn numbers(line: Option<&str>, word: &str, count: usize) -> Result<Vec<f64>, StateError> {
    const DAMAGED: StateError = StateError::Damaged("a line is missing or too short");
    let rest = line.and_then(|line| line.strip_prefix(word)).ok_or(DAMAGED)?;
    let numbers: Option<Vec<f64>> = rest
        .split_whitespace()
        .map(|digits| u64::from_str_radix(digits, 16).ok().map(f64::from_bits))
        .collect();
    let numbers = numbers.ok_or(StateError::Damaged("a number is none"))?;
    if numbers.len() != count || numbers.iter().any(|x| !x.is_finite()) {
        return Err(DAMAGED);
    }
    Ok(numbers)
}

impl Job {
    /// What was known at the job's snapshot, as text, for [`Online::resume`].
    #[must_use]
    pub fn state(&self, robot: &str, sensors: &Measuring) -> String {
        let (model, sensors) = (model(&self.parts), &sensors.0);
        let mut text = format!("{TITLE} {SCHEMA}\nrobot {robot}\nmodel {model}\nsensors {sensors}\n");
        for part in &self.parts {
            let parameters = part.information.trailing(6 * part.sensors.len());
            let _ = write!(text, "component {}", parameters.unknowns());
            let is_learnt = part.contest.in_force().effective > 0.0;
            put(&mut text, "", [part.tau, f64::from(u8::from(is_learnt))].into_iter());
            put(&mut text, "noise", part.variances.iter().copied());
            for k in 0..parameters.unknowns() {
                put(&mut text, "row", parameters.row(k).iter().copied());
            }
        }
        let sum = hash(text.bytes());
        let _ = writeln!(text, "sum {sum:016x}");
        text
    }
}

impl Online {
    /// Goes on from what [`Job::state`] told, before anything is observed: a solution is in force at once, with the offsets unknown. Solves, and allocates.
    ///
    /// # Errors
    /// [`StateError`]. Nothing is changed then.
    pub fn resume(&mut self, robot: &str, sensors: &Measuring, text: &str) -> Result<(), StateError> {
        let Some(job) = &mut self.job else {
            return Err(StateError::Damaged("a job is away"));
        };
        let mut lines = text.lines();
        let title = lines.next().and_then(|line| line.strip_prefix(TITLE));
        match title.map(str::trim) {
            Some(SCHEMA) => {}
            Some(schema) if !schema.is_empty() => return Err(StateError::Schema(schema.to_owned())),
            _ => return Err(StateError::Damaged("it does not begin as such a file does")),
        }
        let (body, sum) = text.trim_end().rsplit_once("\nsum ").unwrap_or((text, ""));
        let own = hash(body.bytes().chain([b'\n']));
        if u64::from_str_radix(sum, 16) != Ok(own) {
            return Err(StateError::Damaged("its sum is not right"));
        }
        for (word, what, expected) in [
            ("robot", "robot", robot.to_owned()),
            ("model", "model", model(&job.parts)),
            ("sensors", SENSORS, sensors.0.clone()),
        ] {
            let found = lines.next().and_then(|line| line.strip_prefix(word)).map(str::trim);
            let found = found.ok_or(StateError::Damaged("a line is missing"))?.to_owned();
            if found != expected {
                return Err(StateError::Foreign { what, found, expected });
            }
        }
        let mut read = Vec::new();
        for part in &job.parts {
            let (session, parameters) = (6 * part.sensors.len(), WIDTH * part.links.len());
            let [tau, is_learnt] = numbers(lines.next(), &format!("component {parameters}"), 2)?[..] else {
                return Err(StateError::Damaged("no weight"));
            };
            let variances = numbers(lines.next(), "noise", session)?;
            let mut information = Information::new(session + parameters);
            let mut panel = Panel::new(session + parameters, parameters);
            for k in 0..parameters {
                let from = numbers(lines.next(), "row", parameters - k + 1)?;
                let (a, z) = from.split_at(parameters - k);
                let mut row = vec![0.0; session + k];
                row.extend_from_slice(a);
                let pushed = panel.push_row(&row, z.iter().sum());
                pushed.map_err(|_| StateError::Damaged("a number is too large"))?;
            }
            // Made for the same unknowns.
            let _ = information.absorb(&mut panel);
            if !(tau > 0.0 && variances.iter().all(|v| *v > 0.0)) {
                return Err(StateError::Damaged("a variance is not positive"));
            }
            read.push(((tau, is_learnt > 0.0), variances, information));
        }
        for ((part, component), ((tau, is_learnt), variances, information)) in
            job.parts.iter_mut().zip(&mut self.components).zip(read)
        {
            part.tau = tau;
            part.is_replaced = is_learnt;
            part.variances.copy_from_slice(&variances);
            component.variances = variances;
            let _ = part.information.copy_from(&information);
            component.information = information;
        }
        job.run();
        for ((own, found), part) in (self.solution.components.iter_mut())
            .zip(&job.solution.components)
            .zip(&job.parts)
        {
            if part.failure.is_none() {
                own.clone_from(found);
            }
        }
        Ok(())
    }
}

/// Writes a state: whole, or not at all.
///
/// # Errors
/// The file system's.
pub fn write(file: &Path, text: &str) -> Result<(), StateError> {
    Ok(crate::files::replace(file, text, 0o600)?)
}

/// Renames a file that is no good to `<file>.bad-<n>`, the first that is free: which.
///
/// # Errors
/// The file system's.
pub fn set_aside(file: &Path) -> Result<PathBuf, StateError> {
    let mut number = 1_u32;
    loop {
        let mut name = file.as_os_str().to_owned();
        name.push(format!(".bad-{number}"));
        let aside = PathBuf::from(name);
        if !aside.exists() {
            std::fs::rename(file, &aside)?;
            return Ok(aside);
        }
        number += 1;
    }
}
