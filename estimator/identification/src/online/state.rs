//! The state of on-line identification as a file, so that it survives a restart.
//!
//! ```text
//! proprio identification state 3
//! robot <name>
//! model <hash of the links, the sensors and CAD>
//! sensors <hash of their mounting and calibration>
//! component <unknowns> <tau> <1: learnt parameters are in use, 0: CAD's>
//! noise <variance of each F/T channel>
//! row <R_kk ... R_kn z_k>                     one line per parameter
//! ...
//! sum <hash of all before>
//! ```
//!
//! Numbers are the hexadecimal digits of their bits. The triangle is that of the parameters alone,
//! since F/T offsets may change at a restart. It holds no prior, so that restarts do not count the
//! prior twice. It depends on the calibration of the sensors: with a gain 7 % higher everything
//! would have been 7 % heavier.

use std::fmt::Write as _;

use crate::linear::information::{Information, Panel};
use crate::online::Online;
use crate::online::component::ComponentLayout;
use crate::online::job::{ComponentJob, SolutionJob};
use proprio_dynamics::Structure;
use proprio_dynamics::calibration::Calibration;

const TITLE: &str = "proprio identification state";
const SCHEMA: &str = "3";
/// Text for a difference of the sensors.
const SENSORS: &str = "mounting or calibration of its force/torque sensors";

/// Why a state cannot be resumed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StateError {
    /// The file is no such state, or incomplete.
    #[error("the state of identification is damaged ({0})")]
    Damaged(&'static str),
    /// Another version wrote it.
    #[error("the state of identification has schema {0}; this version reads {SCHEMA}")]
    Schema(String),
    /// It belongs to another robot, model, or set of sensors.
    #[error("the state of identification is for another {what}: {found} instead of {expected}")]
    Foreign {
        /// The difference.
        what: &'static str,
        /// The value in the file.
        found: String,
        /// The value of this robot.
        expected: String,
    },
}

/// Identifies how the sensors measure, which a state depends on besides the model.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SensorFingerprint(String);

impl SensorFingerprint {
    /// From the structure's sensors, with these calibrations in the same order: mounting,
    /// measurement frame, sign, gain and temperature coefficients.
    pub fn new(structure: &Structure, calibrations: &[Calibration]) -> Self {
        let mut bytes = Vec::new();
        for cut in structure.sensors() {
            bytes.extend((cut.joint() as u64).to_le_bytes());
            let pose = cut.pose();
            let numbers = pose.rotation.iter().chain(pose.translation.iter()).copied();
            bytes.extend(
                numbers
                    .chain([cut.sign()])
                    .flat_map(|x| x.to_bits().to_le_bytes()),
            );
        }
        for calibration in calibrations {
            let per_kelvin = calibration.per_kelvin().torque_first();
            let reference = calibration.reference().unwrap_or(f64::NAN);
            let numbers = calibration
                .gain()
                .iter()
                .copied()
                .chain(per_kelvin)
                .chain([reference]);
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

fn model(parts: &[ComponentJob]) -> String {
    let bytes = |part: &ComponentJob| -> Vec<u8> {
        let layout = &part.layout;
        let numbers = layout.links.iter().chain(&layout.sensors);
        let numbers = numbers.map(|number| *number as u64);
        let cad = layout.reference.iter().skip(layout.offset_count());
        let cad = cad.map(|x| x.to_bits());
        let numbers = numbers.chain(cad);
        numbers.flat_map(u64::to_le_bytes).collect()
    };
    format!("{:016x}", hash(parts.iter().flat_map(bytes)))
}

fn put(text: &mut String, word: &str, numbers: impl Iterator<Item = f64>) {
    text.push_str(word);
    for number in numbers {
        // Writing to a string cannot fail.
        let _ = write!(text, " {:016x}", number.to_bits());
    }
    text.push('\n');
}

fn numbers(line: Option<&str>, word: &str, count: usize) -> Result<Vec<f64>, StateError> {
    const DAMAGED: StateError = StateError::Damaged("a line is missing or too short");
    let rest = line.and_then(|line| line.strip_prefix(word));
    let rest = rest.ok_or(DAMAGED)?;
    let numbers: Option<Vec<f64>> = rest
        .split_whitespace()
        .map(|digits| u64::from_str_radix(digits, 16).ok().map(f64::from_bits))
        .collect();
    let numbers = numbers.ok_or(StateError::Damaged("a number cannot be read"))?;
    if numbers.len() != count || numbers.iter().any(|x| !x.is_finite()) {
        return Err(DAMAGED);
    }
    Ok(numbers)
}

impl SolutionJob {
    /// The state at the job's snapshot as text, for [`Online::resume`].
    #[must_use]
    pub fn state(&self, robot: &str, sensors: &SensorFingerprint) -> String {
        let (model, sensors) = (model(&self.components), &sensors.0);
        let mut text =
            format!("{TITLE} {SCHEMA}\nrobot {robot}\nmodel {model}\nsensors {sensors}\n");
        for part in &self.components {
            let parameters = part.information.trailing(part.layout.offset_count());
            let _ = write!(text, "component {}", parameters.unknowns());
            let is_learnt = part.selection.in_use().effective > 0.0;
            put(
                &mut text,
                "",
                [part.tau, f64::from(u8::from(is_learnt))].into_iter(),
            );
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

/// What a state holds of a component.
struct SavedComponent {
    tau: f64,
    is_learnt: bool,
    variances: Vec<f64>,
    information: Information,
}

impl SavedComponent {
    /// Reads the lines of a component with this layout.
    fn read<'a>(
        lines: &mut impl Iterator<Item = &'a str>,
        layout: &ComponentLayout,
    ) -> Result<Self, StateError> {
        let (offset_count, parameters) = (layout.offset_count(), layout.parameters());
        let [tau, is_learnt] = numbers(lines.next(), &format!("component {parameters}"), 2)?[..]
        else {
            return Err(StateError::Damaged("the weight is missing"));
        };
        let variances = numbers(lines.next(), "noise", offset_count)?;
        let mut information = Information::new(offset_count + parameters);
        let mut panel = Panel::new(offset_count + parameters, parameters);
        for k in 0..parameters {
            let from = numbers(lines.next(), "row", parameters - k + 1)?;
            let (a, z) = from.split_at(parameters - k);
            let mut row = vec![0.0; offset_count + k];
            row.extend_from_slice(a);
            let pushed = panel.push_row(&row, z.iter().sum());
            pushed.map_err(|_| StateError::Damaged("a number is too large"))?;
        }
        // Both have the same unknowns.
        let _ = information.absorb(&mut panel);
        if !(tau > 0.0 && variances.iter().all(|v| *v > 0.0)) {
            return Err(StateError::Damaged("a variance is not positive"));
        }
        Ok(Self {
            tau,
            is_learnt: is_learnt > 0.0,
            variances,
            information,
        })
    }
}

/// The lines after the title of an undamaged state.
fn checked(text: &str) -> Result<std::str::Lines<'_>, StateError> {
    let mut lines = text.lines();
    let title = lines.next().and_then(|line| line.strip_prefix(TITLE));
    match title.map(str::trim) {
        Some(SCHEMA) => {}
        Some(schema) if !schema.is_empty() => {
            return Err(StateError::Schema(schema.to_owned()));
        }
        _ => return Err(StateError::Damaged("wrong title")),
    }
    let (body, sum) = text.trim_end().rsplit_once("\nsum ").unwrap_or((text, ""));
    let own = hash(body.bytes().chain([b'\n']));
    if u64::from_str_radix(sum, 16) != Ok(own) {
        return Err(StateError::Damaged("wrong checksum"));
    }
    Ok(lines)
}

impl Online {
    /// Resumes a state of [`SolutionJob::state`], before the first observation. A solution is in
    /// use at once, with unknown offsets. Solves, and allocates.
    ///
    /// # Errors
    /// [`StateError`]. Nothing is changed then.
    pub fn resume(
        &mut self,
        robot: &str,
        sensors: &SensorFingerprint,
        text: &str,
    ) -> Result<(), StateError> {
        let Some(job) = &mut self.job else {
            return Err(StateError::Damaged("a job is running"));
        };
        let mut lines = checked(text)?;
        for (word, what, expected) in [
            ("robot", "robot", robot.to_owned()),
            ("model", "model", model(&job.components)),
            ("sensors", SENSORS, sensors.0.clone()),
        ] {
            let found = lines.next().and_then(|line| line.strip_prefix(word));
            let found = found.ok_or(StateError::Damaged("a line is missing"))?;
            let found = found.trim().to_owned();
            if found != expected {
                return Err(StateError::Foreign {
                    what,
                    found,
                    expected,
                });
            }
        }
        let saved = (job.components.iter())
            .map(|part| SavedComponent::read(&mut lines, &part.layout))
            .collect::<Result<Vec<_>, _>>()?;
        let components = job.components.iter_mut().zip(&mut self.components);
        for ((part, component), saved) in components.zip(saved) {
            part.tau = saved.tau;
            part.is_replaced = saved.is_learnt;
            part.variances.copy_from_slice(&saved.variances);
            component.variances = saved.variances;
            let _ = part.information.copy_from(&saved.information);
            component.information = saved.information;
        }
        job.run();
        for ((own, found), part) in (self.solution.components.iter_mut())
            .zip(&job.solution.components)
            .zip(&job.components)
        {
            if part.failure.is_none() {
                own.clone_from(found);
            }
        }
        Ok(())
    }
}
