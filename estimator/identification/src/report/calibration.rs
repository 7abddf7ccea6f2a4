//! Calibrations and noise of the sensors.

use crate::finding::{Finding, FindingCode};
use crate::fit::Identified;
use crate::measurement::channels::{channel_name, sensor_name};
use crate::measurement::unknowns::ExtraParameter;
use crate::prepared_log::PreparedLog;
use crate::report::outcome::{CalibrationOutcome, ChannelNoise};
use crate::robot::{AXES, Robot};
use nalgebra::{DMatrix, Matrix6};
use proprio_dynamics::calibration::{Calibration, Gain, Kind, Unknown, swapped};
use proprio_dynamics::spatial::Wrench;

/// Posterior over prior standard deviation above which a parameter counts as not excited.
pub(crate) const NOT_EXCITED: f64 = 0.8;

/// Most such parameters that are named; all are in the table.
pub(crate) const MAX_NAMED: usize = 8;

/// Identified calibrations of the sensors, and findings about them.
pub(crate) fn calibrations(
    identified: &Identified<'_>,
    root: &DMatrix<f64>,
) -> (Vec<CalibrationOutcome>, Vec<Finding>) {
    let robot = identified.robot();
    let (mut outcomes, mut findings) = (Vec::new(), Vec::new());
    if identified.calibrated.is_empty() {
        return (outcomes, findings);
    }
    for &sensor in &identified.unknowns().sensors {
        let errors = SensorErrors::new(identified, root, sensor);
        if robot.calibrated.temperature && !errors.kind.temperature {
            let name = &errors.name;
            findings.push(Finding::warning(
                FindingCode::NoTemperature,
                name,
                format!(
                    "{name}: its temperature coefficients are not identified: no log has its \
                     temperature (column wrench/{name}/temperature), or it never changed"
                ),
            ));
        }
        if errors.kind.is_empty() {
            continue;
        }
        findings.extend(errors.not_excited());
        findings.extend(errors.not_separable(robot, root));
        let reference = identified.measurement.reference(sensor);
        let configured = robot.calibrations[sensor];
        outcomes.push(errors.outcome(configured, reference));
    }
    (outcomes, findings)
}

/// An error of a sensor's calibration.
struct CalibrationError {
    column: usize,
    unknown: Unknown,
    value: f64,
    deviation: f64,
    /// Its deviation before any log.
    prior: f64,
}

impl CalibrationError {
    fn is_gain(&self) -> bool {
        matches!(self.unknown, Unknown::Gain { .. })
    }

    /// Whether it is the gain of a force by itself.
    fn is_force_gain(&self) -> bool {
        matches!(self.unknown, Unknown::Gain { channel, of } if channel == of && channel >= 3)
    }

    /// In words, with the axes' names of samples.
    fn describe(&self) -> String {
        let word = |channel: usize| AXES[swapped(channel)];
        match self.unknown {
            Unknown::Gain { channel, of } if channel == of => {
                format!("the gain of {}", word(channel))
            }
            Unknown::Gain { channel, of } => format!("{} of {}", word(channel), word(of)),
            Unknown::Temperature { channel } => format!("{} by temperature", word(channel)),
        }
    }
}

/// The identified errors of one sensor's calibration.
struct SensorErrors {
    name: String,
    kind: Kind,
    errors: Vec<CalibrationError>,
}

impl SensorErrors {
    fn new(identified: &Identified<'_>, root: &DMatrix<f64>, sensor: usize) -> Self {
        let unknowns = identified.unknowns();
        let extra = unknowns.extra.iter().zip(unknowns.inertial()..);
        let errors: Vec<CalibrationError> = (extra.zip(&unknowns.precision))
            .filter_map(|((extra, column), precision)| match *extra {
                ExtraParameter::Calibration(other, unknown) if other == sensor => {
                    Some(CalibrationError {
                        column,
                        unknown,
                        value: identified.d[column],
                        deviation: root.row(column).norm(),
                        prior: precision.sqrt().recip(),
                    })
                }
                _ => None,
            })
            .collect();
        let kind = Kind {
            gain: if errors.iter().any(CalibrationError::is_gain) {
                identified.calibrated.gain
            } else {
                Gain::None
            },
            temperature: !errors.iter().all(CalibrationError::is_gain),
        };
        Self {
            name: sensor_name(identified.robot(), sensor),
            kind,
            errors,
        }
    }

    /// A note of the parameters that the logs hardly excite.
    fn not_excited(&self) -> Option<Finding> {
        let is_weak = |own: &&CalibrationError| own.deviation > NOT_EXCITED * own.prior;
        let weak: Vec<&CalibrationError> = self.errors.iter().filter(is_weak).collect();
        if weak.is_empty() {
            return None;
        }
        let named = weak.iter().take(MAX_NAMED).map(|own| own.describe());
        let more = if weak.len() > MAX_NAMED { ", ..." } else { "" };
        let name = &self.name;
        Some(Finding::note(
            FindingCode::CalibrationNotObservable,
            name,
            format!(
                "{name}: {} of the {} calibration parameters are not excited by the motion and \
                 stay close to the factory calibration: {}. Record motion that loads these \
                 channels more",
                weak.len(),
                self.errors.len(),
                named.collect::<Vec<_>>().join(", ") + more
            ),
        ))
    }

    /// A note if a common gain of all forces is not separable from a common scale of all masses
    /// beyond.
    fn not_separable(&self, robot: &Robot, root: &DMatrix<f64>) -> Option<Finding> {
        let forces = self.errors.iter().filter(|own| own.is_force_gain());
        let forces: Vec<&CalibrationError> = forces.collect();
        if forces.len() != 3 {
            return None;
        }
        let common: f64 = forces.iter().map(|own| own.value).sum::<f64>() / 3.0;
        let rows = forces.iter().map(|own| root.row(own.column).into_owned());
        let spread = rows
            .reduce(|a, b| a + b)
            .map_or(f64::NAN, |sum| sum.norm() / 3.0);
        let before = robot.gain_std / 3.0_f64.sqrt();
        let name = &self.name;
        (spread > 0.5 * before).then(|| {
            Finding::note(
                FindingCode::GainMassNotSeparable,
                name,
                format!(
                    "{name}: the common gain of its forces, {:+.1} +- {:.1} %, is not separable \
                     from the masses beyond it; only the priors decide between them \
                     (identification.gain_std for the factory calibration, the estimated error of \
                     CAD for the masses). Hang a known mass on the sensor, or weigh a link and \
                     correct the URDF",
                    100.0 * common,
                    100.0 * spread
                ),
            )
        })
    }

    /// `reference`: the temperature at which the sensor is as configured.
    fn outcome(self, configured: Calibration, reference: Option<f64>) -> CalibrationOutcome {
        let (mut gain, mut per_kelvin) = (Matrix6::zeros(), [0.0; 6]);
        for own in &self.errors {
            match own.unknown {
                Unknown::Gain { channel, of } => gain[(channel, of)] = own.value,
                Unknown::Temperature { channel } => per_kelvin[channel] = own.value,
            }
        }
        let per_kelvin = Wrench::from_torque_first(per_kelvin);
        let reference = reference.filter(|_| self.kind.temperature);
        let each = |value: fn(&CalibrationError) -> f64| self.errors.iter().map(value).collect();
        CalibrationOutcome {
            configured,
            identified: configured.then(&gain, &per_kelvin, reference),
            kind: self.kind,
            error: each(|own| own.value),
            deviation: each(|own| own.deviation),
            prior: each(|own| own.prior),
            sensor: self.name,
        }
    }
}

pub(crate) fn channels(
    identified: &Identified<'_>,
    training: &[&PreparedLog],
) -> Vec<ChannelNoise> {
    let noise = &identified.noise;
    let seconds = training
        .iter()
        .map(|log| (log.span.1 - log.span.0).seconds());
    let instants: usize = training.iter().map(|log| log.instants.len()).sum();
    let period = seconds.sum::<f64>() / instants.max(1) as f64;
    (0..identified.unknowns().channels())
        .map(|channel| {
            let (name, unit) = channel_name(identified.robot(), identified.unknowns(), channel);
            ChannelNoise {
                name,
                unit,
                deviation: noise.square[channel].sqrt(),
                autocorrelation_seconds: noise.time[channel] * period,
                drift: noise.drift_variance[channel].sqrt(),
            }
        })
        .collect()
}
