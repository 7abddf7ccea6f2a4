//! Calibrations and noise of the sensors.

use crate::finding::{Finding, FindingCode};
use crate::fit::Identified;
use crate::measurement::channels::{channel_name, sensor_name};
use crate::measurement::model::MeasurementModel;
use crate::measurement::unknowns::ExtraParameter;
use crate::report::outcome::{CalibrationOutcome, ChannelNoise};
use crate::robot::{AXES, Robot};
use crate::training::TrainingLog;
use nalgebra::{DMatrix, Matrix6};
use proprio_dynamics::calibration::{Gain, Kind, Unknown, swapped};
use proprio_dynamics::spatial::Wrench;

/// Posterior over prior standard deviation above which a parameter counts as not excited.
pub(crate) const NOT_EXCITED: f64 = 0.8;

/// Most such parameters that are named; all are in the table.
pub(crate) const MAX_NAMED: usize = 8;

/// Identified calibrations of the sensors, and findings about them.
pub(crate) fn calibrations(
    robot: &Robot,
    measurement: &MeasurementModel<'_>,
    identified: &Identified,
    root: &DMatrix<f64>,
) -> (Vec<CalibrationOutcome>, Vec<Finding>) {
    let unknowns = &identified.unknowns;
    let (mut outcomes, mut findings) = (Vec::new(), Vec::new());
    if identified.calibrated.is_empty() {
        return (outcomes, findings);
    }
    let precision = &unknowns.precision;
    for &sensor in &unknowns.sensors {
        let name = sensor_name(robot, sensor);
        let own: Vec<(usize, Unknown, f64)> = (unknowns
            .extra
            .iter()
            .zip(unknowns.inertial()..)
            .zip(precision))
        .filter_map(|((extra, column), precision)| match *extra {
            ExtraParameter::Calibration(other, unknown) if other == sensor => {
                Some((column, unknown, precision.sqrt().recip()))
            }
            _ => None,
        })
        .collect();
        let (mut e, mut kelvin) = (Matrix6::zeros(), [0.0; 6]);
        for (column, unknown, _) in &own {
            match *unknown {
                Unknown::Gain { channel, of } => e[(channel, of)] = identified.d[*column],
                Unknown::Temperature { channel } => kelvin[channel] = identified.d[*column],
            }
        }
        let is_gain = |unknown: &Unknown| matches!(unknown, Unknown::Gain { .. });
        let kind = Kind {
            gain: if own.iter().any(|(_, unknown, _)| is_gain(unknown)) {
                identified.calibrated.gain
            } else {
                Gain::None
            },
            temperature: own.iter().any(|(_, unknown, _)| !is_gain(unknown)),
        };
        if robot.calibrated.temperature && !kind.temperature {
            findings.push(Finding::warning(
                FindingCode::NoTemperature,
                &name,
                format!(
                    "{name}: its temperature coefficients are not identified: no log has its \
                     temperature (column wrench/{name}/temperature), or it never changed"
                ),
            ));
        }
        if kind.is_empty() {
            continue;
        }
        let more = Wrench::from_torque_first(kelvin);
        let reference = measurement.reference(sensor).filter(|_| kind.temperature);
        let deviation: Vec<f64> = own
            .iter()
            .map(|(column, ..)| root.row(*column).norm())
            .collect();
        let prior: Vec<f64> = own.iter().map(|(.., prior)| *prior).collect();
        // Parameters that the logs hardly excite, with the axes' names of samples.
        let mut not_excited: Vec<String> = Vec::new();
        for ((_, unknown, prior), deviation) in own.iter().zip(&deviation) {
            let word = |channel: usize| AXES[swapped(channel)];
            if *deviation > NOT_EXCITED * prior {
                not_excited.push(match *unknown {
                    Unknown::Gain { channel, of } if channel == of => {
                        format!("the gain of {}", word(channel))
                    }
                    Unknown::Gain { channel, of } => format!("{} of {}", word(channel), word(of)),
                    Unknown::Temperature { channel } => format!("{} by temperature", word(channel)),
                });
            }
        }
        if !not_excited.is_empty() {
            let (count, more) = (
                not_excited.len(),
                if not_excited.len() > MAX_NAMED {
                    ", ..."
                } else {
                    ""
                },
            );
            not_excited.truncate(MAX_NAMED);
            findings.push(Finding::note(
                FindingCode::CalibrationNotObservable,
                &name,
                format!(
                    "{name}: {} of the {} calibration parameters are not excited by the motion and \
                     stay close to the factory calibration: {}. Record motion that loads these \
                     channels more",
                    count,
                    own.len(),
                    not_excited.join(", ") + more
                ),
            ));
        }
        // A common gain of all forces is not separable from a common scale of all masses beyond.
        let is_force_gain = |unknown: &Unknown| match unknown {
            Unknown::Gain { channel, of } => channel == of && *channel >= 3,
            Unknown::Temperature { .. } => false,
        };
        let forces = own.iter().filter(|(_, unknown, _)| is_force_gain(unknown));
        let forces: Vec<usize> = forces.map(|(column, ..)| *column).collect();
        if forces.len() == 3 {
            let common: f64 = forces
                .iter()
                .map(|&column| identified.d[column])
                .sum::<f64>()
                / 3.0;
            let sum = forces.iter().map(|&column| root.row(column).into_owned());
            let spread = sum
                .reduce(|a, b| a + b)
                .map_or(f64::NAN, |sum| sum.norm() / 3.0);
            let before = robot.gain_std / 3.0_f64.sqrt();
            if spread > 0.5 * before {
                findings.push(Finding::note(
                    FindingCode::GainMassNotSeparable,
                    &name,
                    format!(
                        "{name}: the common gain of its forces, {:+.1} +- {:.1} %, is not \
                         separable from the masses beyond it; only the priors decide between them \
                         (identification.gain_std for the factory calibration, the estimated \
                         error of CAD for the masses). Hang a known mass on the sensor, or weigh a \
                         link and correct the URDF",
                        100.0 * common,
                        100.0 * spread
                    ),
                ));
            }
        }
        outcomes.push(CalibrationOutcome {
            sensor: name,
            configured: robot.calibrations[sensor],
            identified: robot.calibrations[sensor].then(&e, &more, reference),
            kind,
            error: own
                .iter()
                .map(|(column, ..)| identified.d[*column])
                .collect(),
            deviation,
            prior,
        });
    }
    (outcomes, findings)
}

pub(crate) fn channels(
    robot: &Robot,
    identified: &Identified,
    training: &[&TrainingLog],
) -> Vec<ChannelNoise> {
    let noise = &identified.noise;
    let seconds: f64 = training
        .iter()
        .map(|log| (log.span.1 - log.span.0).seconds())
        .sum();
    let instants: usize = training.iter().map(|log| log.instants.len()).sum();
    let period = seconds / instants.max(1) as f64;
    (0..identified.unknowns.channels())
        .map(|channel| {
            let (name, unit) = channel_name(robot, &identified.unknowns, channel);
            ChannelNoise {
                name,
                unit,
                deviation: noise.square[channel].sqrt(),
                autocorrelation_seconds: noise.time[channel] * period,
                drift: noise.drift[channel].sqrt(),
            }
        })
        .collect()
}
