//! Units of F/T readings: whether a log has them in newtons and newton metres. Tested before any
//! fit.
//!
//! Readings are compared with CAD's prediction, forces and torques separately, both without their
//! means (because of the offset). CAD may be wrong by a large factor: a gripper that the URDF
//! lacks, on a light flange, has thirty times the flange's mass. So a log is refused only for
//! readings that no robot produces, if they are correlated with the prediction (above 0.7 in
//! magnitude):
//!
//! - more than 30 times the prediction, and changes above the weight of the whole robot (torques:
//!   at a lever of a metre): not newtons, or not newton metres;
//! - forces and torques both below 1/300 of the prediction: kilonewtons.
//!
//! More than 3 times, or less than a third, is reported: kilograms-force, or masses that are wrong
//! by this factor.

use crate::arithmetic::dot;
use crate::finding::{Finding, FindingCode, Severity};
use crate::measurement::channels::{attribute_to, sensor_name};
use crate::measurement::model::MeasurementModel;
use crate::measurement::rows::Rows;
use crate::training::TrainingLog;
use nalgebra::DVector;

/// Most observations that are used.
const MAX_OBSERVATIONS: usize = 2000;

/// Fewest observations of a stretch of constant offset.
const MIN_OBSERVATIONS: usize = 50;

/// Readings above this multiple of the prediction have wrong units.
const MAX_RATIO: f64 = 30.0;

/// Readings below the prediction by this factor have wrong units.
const SMALL: f64 = 300.0;

/// A ratio beyond this, or below its inverse, is reported.
const ODD: f64 = 3.0;

/// Lever of the whole robot's weight \[m\].
const LEVER: f64 = 1.0;

/// Least magnitude of the correlation of readings and prediction.
const CORRELATED: f64 = 0.7;

/// The prediction is used if its RMS exceeds this multiple of the sensor's noise.
const ABOVE_NOISE: f64 = 5.0;

/// Readings and predictions, without their means.
#[derive(Default)]
struct Pairs {
    read: Vec<f64>,
    predicted: Vec<f64>,
}

impl Pairs {
    fn add(&mut self, stretch: &[(f64, f64)]) {
        let count = stretch.len() as f64;
        let (read, predicted) = stretch
            .iter()
            .fold((0.0, 0.0), |(y, x), own| (y + own.0, x + own.1));
        self.read
            .extend(stretch.iter().map(|own| own.0 - read / count));
        self.predicted
            .extend(stretch.iter().map(|own| own.1 - predicted / count));
    }

    fn compare<'a>(all: impl Iterator<Item = &'a Self> + Clone) -> Compared {
        let sum = |of: fn(&Self) -> f64| all.clone().map(of).sum::<f64>();
        let (yy, xx) = (
            sum(|p| dot(&p.read, &p.read)),
            sum(|p| dot(&p.predicted, &p.predicted)),
        );
        let count = sum(|p| p.read.len() as f64).max(1.0);
        Compared {
            predicted: (xx / count).sqrt(),
            ratio: (yy / xx).sqrt(),
            correlation: sum(|p| dot(&p.read, &p.predicted))
                / (yy * xx).sqrt().max(f64::MIN_POSITIVE),
        }
    }
}

#[derive(Clone, Copy, Debug)]
struct Compared {
    /// RMS of the prediction.
    predicted: f64,
    /// RMS of the readings relative to it.
    ratio: f64,
    correlation: f64,
}

impl Compared {
    /// `most`: the largest reading that the robot can cause.
    fn is_too_large(&self, most: f64) -> bool {
        self.ratio > MAX_RATIO
            && self.correlation.abs() > CORRELATED
            && self.ratio * self.predicted > most
    }

    fn is_too_small(&self) -> bool {
        self.ratio < 1.0 / SMALL && self.correlation.abs() > CORRELATED
    }

    fn is_odd(&self) -> bool {
        !(1.0 / ODD..=ODD).contains(&self.ratio) && self.correlation > CORRELATED
    }
}

/// Findings of wrong units of a log's F/T readings; refusals if nothing can be identified from
/// them.
pub(crate) fn wrong(measurement: &mut MeasurementModel<'_>, log: &TrainingLog) -> Vec<Finding> {
    if log.refused {
        return Vec::new();
    }
    let sensors = measurement.unknowns().sensors.clone();
    let weight = 9.80665
        * measurement
            .robot()
            .model
            .inertias()
            .iter()
            .map(|body| body.mass)
            .sum::<f64>();
    let mut faults = Vec::new();
    for (place, pairs) in pairs(measurement, log).into_iter().enumerate() {
        let noise = measurement.robot().structure.sensors()[sensors[place]].noise();
        let [torque, force] = [(0..3, noise.torque), (3..6, noise.force)].map(|(axes, noise)| {
            let found = Pairs::compare(pairs[axes].iter());
            (found.predicted > ABOVE_NOISE * noise.into_iter().fold(0.0, f64::max)).then_some(found)
        });
        let fault = fault(force, torque, weight);
        faults.extend(fault.map(|fault| {
            (
                fault,
                sensor_name(measurement.robot(), sensors[place]),
                force,
                torque,
            )
        }));
    }
    // The prediction of one sensor uses the other sensors of its sub-tree: one that is far too
    // large makes the others look too small.
    if faults.iter().any(|(fault, ..)| *fault == Fault::Large) {
        faults.retain(|(fault, ..)| *fault != Fault::Small);
    }
    let findings = faults.into_iter();
    findings
        .map(|(fault, name, force, torque)| fault.finding(&name, force, torque))
        .collect()
}

/// An error of a sensor's units.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    Large,
    Small,
    Odd,
}

fn fault(force: Option<Compared>, torque: Option<Compared>, weight: f64) -> Option<Fault> {
    let both = || {
        [(force, weight), (torque, LEVER * weight)]
            .into_iter()
            .filter_map(|(of, most)| Some((of?, most)))
    };
    if both().any(|(of, most)| of.is_too_large(most)) {
        Some(Fault::Large)
    } else if both().count() > 0 && both().all(|(of, _)| of.is_too_small()) {
        Some(Fault::Small)
    } else if both().any(|(of, _)| of.is_odd()) {
        Some(Fault::Odd)
    } else {
        None
    }
}

impl Fault {
    fn finding(self, name: &str, force: Option<Compared>, torque: Option<Compared>) -> Finding {
        let both = [("forces", force), ("torques", torque)];
        let ratios = both
            .iter()
            .filter_map(|(word, own)| Some((word, own.as_ref()?.ratio)));
        let ratios: Vec<String> = ratios
            .map(|(word, ratio)| format!("{word} {}", times(ratio)))
            .collect();
        let ratios = ratios.join(" and ");
        let (severity, code, rest) = match self {
            Self::Large => (
                Severity::Refusal,
                FindingCode::WrongUnits,
                "it is in counts or in mN and mNm (convert it to N and Nm), or the URDF's masses \
                 are not in kg",
            ),
            Self::Small => (
                Severity::Refusal,
                FindingCode::WrongUnits,
                "it is in kN and kNm (convert it to N and Nm), or the URDF's masses are not in kg",
            ),
            Self::Odd => (
                Severity::Warning,
                FindingCode::Scale,
                "the robot carries a load that the URDF lacks, or the URDF's masses are wrong by \
                 this factor; or the units (1 kgf is 9.807 N) or the calibration are wrong, and \
                 then so are the parameters: weigh the robot, or hang a known mass on it",
            ),
        };
        Finding {
            severity,
            code,
            subject: format!("wrench/{name}"),
            text: format!(
                "wrench/{name} does not change as the URDF's masses predict ({ratios} as \
                 large as predicted): {rest}"
            ),
        }
    }
}

fn times(ratio: f64) -> String {
    match ratio {
        ratio if ratio >= 10.0 => format!("{ratio:.0} times"),
        ratio if ratio >= 1.0 => format!("{ratio:.1} times"),
        ratio if ratio > 0.0 => format!("1/{:.0}", 1.0 / ratio),
        _ => "0 times".into(),
    }
}

/// Per sensor of the layout and axis, torques first: readings and the predictions by CAD and the
/// other sensors, from stretches of constant offset.
fn pairs(measurement: &mut MeasurementModel<'_>, log: &TrainingLog) -> Vec<[Pairs; 6]> {
    let unknowns = measurement.unknowns().clone();
    let variances = vec![1.0; unknowns.channels()];
    let mut pairs: Vec<[Pairs; 6]> = unknowns
        .sensors
        .iter()
        .map(|_| Default::default())
        .collect();
    let mut open: Vec<[Vec<(f64, f64)>; 6]> = unknowns
        .sensors
        .iter()
        .map(|_| Default::default())
        .collect();
    let close = |pairs: &mut [Pairs; 6], open: &mut [Vec<(f64, f64)>; 6]| {
        for (pairs, stretch) in pairs.iter_mut().zip(open) {
            if stretch.len() >= MIN_OBSERVATIONS {
                pairs.add(stretch);
            }
            stretch.clear();
        }
    };
    let mut rows = Rows::new(&unknowns);
    for instant in log
        .instants
        .iter()
        .step_by(log.instants.len().div_ceil(MAX_OBSERVATIONS).max(1))
    {
        let made = measurement.make(instant, &mut rows).is_ok();
        let residual = DVector::from_fn(rows.count, |row, _| rows.r(row));
        for (place, &sensor) in unknowns.sensors.iter().enumerate() {
            let Some(map) = made
                .then(|| attribute_to(&rows, &variances, 6 * place..6 * place + 6))
                .flatten()
            else {
                continue;
            };
            let off = map * &residual;
            for (channel, read) in instant.readings[sensor]
                .torque_first()
                .into_iter()
                .enumerate()
            {
                if rows.has(6 * place + channel) && (read + off[channel]).is_finite() {
                    open[place][channel].push((read, read - off[channel]));
                }
            }
        }
    }
    pairs
        .iter_mut()
        .zip(&mut open)
        .for_each(|(pairs, open)| close(pairs, open));
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arithmetic::normals;

    /// The fault of a sensor whose forces are `scale` times those that CAD predicts, with a model
    /// error of `wrong` times another motion, and noise. The robot weighs ten times the moved mass.
    fn found(scale: f64, wrong: f64, noise: f64) -> Option<Fault> {
        fault(Some(forces(scale, wrong, noise)), None, 80.0)
    }

    fn forces(scale: f64, wrong: f64, noise: f64) -> Compared {
        let deviates = normals(3, 1000);
        let each = deviates.iter().enumerate().map(|(i, deviate)| {
            let t = 0.05 * i as f64;
            let (x, other) = (8.0 * (0.9 * t).sin(), 8.0 * (1.7 * t + 1.0).sin());
            (300.0 + scale * (x + wrong * other + noise * deviate), x)
        });
        let mut pairs = Pairs::default();
        pairs.add(&each.collect::<Vec<_>>());
        Pairs::compare(std::iter::once(&pairs))
    }

    #[test]
    fn wrong_units_are_separated_from_a_wrong_model() {
        for (wrong, noise) in [(0.0, 0.01), (0.5, 1.0), (1.5, 4.0), (5.0, 10.0)] {
            assert_eq!(found(1.0, wrong, noise), None, "{wrong} {noise}");
        }
        // Cables and drifting offsets, with little motion, are not counts.
        assert_eq!(found(1.0, 60.0, 1.0), None);
        assert_eq!(found(1000.0, 0.3, 1.0), Some(Fault::Large));
        assert_eq!(found(-1000.0, 0.3, 1.0), Some(Fault::Large));
        assert_eq!(found(0.001, 0.3, 1.0), Some(Fault::Small));
        for kilograms in [0.102, 9.8] {
            assert_eq!(found(kilograms, 0.3, 1.0), Some(Fault::Odd));
        }
    }

    /// A gripper on a flange that the URDF lacks, or the opposite; a tool whose centre of mass is
    /// elsewhere: unusual, but possible.
    #[test]
    fn errors_of_the_urdf_are_not_refused() {
        let heavy = |scale| {
            fault(
                Some(forces(scale, 0.3, 1.0)),
                Some(forces(scale, 0.3, 1.0)),
                5000.0,
            )
        };
        for scale in [40.0, 0.02] {
            assert_eq!(heavy(scale), Some(Fault::Odd), "{scale}");
        }
        for scale in [40.0, 0.001] {
            let elsewhere = fault(
                Some(forces(1.1, 0.3, 1.0)),
                Some(forces(scale, 0.3, 1.0)),
                5000.0,
            );
            assert_eq!(elsewhere, Some(Fault::Odd), "{scale}");
        }
    }
}
