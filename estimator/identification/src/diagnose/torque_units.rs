//! Units and sign of measured joint torques. Tested before any fit.
//!
//! CAD predicts a joint torque roughly, even with inaccurate masses. From the measured torque `y`
//! and the predicted one `x`, everything that friction and an offset can explain is removed (and a
//! rotor's inertia, if torques are measured at the motors). Then they are compared:
//!
//! - `|y + x|^2 < |y - x|^2 / 3` (a correlation below -1/2 if they are of one size): wrong sign;
//! - `|y| > 30 |x|` and a correlation above 0.7 in magnitude, or `|y|` more than a hundred times
//!   any prediction for a joint of its kind (revolute or prismatic): counts, or thousandths of
//!   newton metres;
//! - `|y| < |x| / 30`: thousands of newton metres, or a dead channel.
//!
//! CAD is never wrong by a factor of thirty. Such a torque is excluded from its log, and reported.

use crate::finding::{Finding, FindingCode, Severity};
use crate::measurement::model::MeasurementModel;
use crate::measurement::rows::Rows;
use crate::measurement::unknowns::FRICTION;
use crate::robot::{IdentificationInput, Robot, TorqueSide};
use crate::training::TrainingLog;
use nalgebra::{DMatrix, DVector};
use proprio_dynamics::DynamicsError;
use proprio_dynamics::model::JointKind;

/// Most observations that are used.
const MAX_OBSERVATIONS: usize = 2000;

/// Fewest observations for a comparison.
const MIN_OBSERVATIONS: usize = 50;

/// A torque above this multiple of the prediction, or below its inverse, has wrong units.
const FACTOR: f64 = 30.0;

/// So has one above this multiple of the largest prediction for any joint of its kind.
const BEYOND: f64 = 100.0;

/// Predictions below this fraction of the largest joint's of its kind are dominated by CAD's
/// errors.
const SMALL: f64 = 0.01;

/// An error of a torque's sign or units.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    Sign,
    TooLarge(f64),
    TooSmall(f64),
}

/// One joint's measurements and predictions.
#[derive(Default)]
struct Pairs {
    measured: Vec<f64>,
    predicted: Vec<f64>,
    /// Friction's columns and the acceleration, row by row.
    nuisance: Vec<f64>,
}

impl Pairs {
    const WIDTH: usize = FRICTION + 1;

    /// RMS of the measured and predicted torque, of their sum and difference, without what friction
    /// and offset (for a motor also the rotor's inertia) can explain; and the correlation of the
    /// first two. None with too few observations.
    fn compare(&self, side: TorqueSide) -> Option<Compared> {
        let count = self.measured.len();
        if count < MIN_OBSERVATIONS {
            return None;
        }
        let width = match side {
            TorqueSide::Link => FRICTION,
            TorqueSide::Motor => Self::WIDTH,
        };
        let nuisance = DMatrix::from_fn(count, width, |i, j| self.nuisance[Self::WIDTH * i + j]);
        let svd = nuisance.svd(true, false);
        let greatest = svd.singular_values.max();
        let axes = svd.u?;
        let rest = |values: &[f64]| {
            let mut rest = DVector::from_column_slice(values);
            for (axis, size) in axes.column_iter().zip(&svd.singular_values) {
                if *size > 1e-9 * greatest {
                    let share = axis.dot(&rest);
                    rest.axpy(-share, &axis, 1.0);
                }
            }
            rest
        };
        let (y, x) = (rest(&self.measured), rest(&self.predicted));
        let rms = |v: &DVector<f64>| (v.norm_squared() / count as f64).sqrt();
        Some(Compared {
            measured: rms(&y),
            predicted: rms(&x),
            sum: rms(&(&y + &x)),
            difference: rms(&(&y - &x)),
            correlation: y.dot(&x) / (y.norm() * x.norm()).max(f64::MIN_POSITIVE),
            raw_predicted: rms(&DVector::from_column_slice(&self.predicted)),
        })
    }
}

struct Compared {
    measured: f64,
    predicted: f64,
    sum: f64,
    difference: f64,
    correlation: f64,
    /// RMS of the prediction, without removing friction and offset.
    raw_predicted: f64,
}

impl Compared {
    /// `greatest`, `greatest_raw`: the largest prediction of all joints of its kind, without and
    /// with the part that friction can explain. Friction and offset are removed from the measured
    /// torque: for a joint with almost no load, they may be most of it.
    fn fault(&self, greatest: f64, greatest_raw: f64) -> Option<Fault> {
        let is_significant = self.predicted > SMALL * greatest && self.predicted > 0.0;
        let ratio = self.measured / self.predicted;
        if greatest_raw > 0.0 && self.measured > BEYOND * greatest_raw {
            Some(Fault::TooLarge(self.measured / greatest_raw))
        } else if is_significant && ratio > FACTOR && self.correlation.abs() > 0.7 {
            Some(Fault::TooLarge(ratio))
        } else if is_significant && ratio < 1.0 / FACTOR {
            Some(Fault::TooSmall(1.0 / ratio))
        } else if is_significant && 3.0 * self.sum.powi(2) < self.difference.powi(2) {
            Some(Fault::Sign)
        } else {
            None
        }
    }
}

/// The fault of each of these torques. `sliding`: whether the joint is prismatic. Forces are
/// compared with forces, torques with torques.
fn faults(compared: &[Option<Compared>], sliding: &[bool]) -> Vec<Option<Fault>> {
    let greatest = |slides: bool, of: &dyn Fn(&Compared) -> f64| {
        let own = compared
            .iter()
            .zip(sliding)
            .filter(|(_, own)| **own == slides);
        own.filter_map(|(compared, _)| compared.as_ref())
            .map(of)
            .fold(0.0, f64::max)
    };
    let [turning, slides] = [false, true].map(|kind| {
        (
            greatest(kind, &|c| c.predicted),
            greatest(kind, &|c| c.raw_predicted),
        )
    });
    let all = compared.iter().zip(sliding);
    all.map(|(compared, own)| {
        let (predicted, raw) = if *own { slides } else { turning };
        compared.as_ref()?.fault(predicted, raw)
    })
    .collect()
}

/// Measured joint torques of a log with a wrong sign or unit.
///
/// # Errors
/// Observations of another robot.
pub(crate) fn faulty(robot: &Robot, log: &TrainingLog) -> Result<Vec<FaultyTorque>, DynamicsError> {
    let measured = |dof: &usize| {
        log.instants
            .iter()
            .any(|i| i.torque.get(*dof).is_some_and(|x| x.is_finite()))
    };
    if log.refused || !(0..robot.model.dof_count()).any(|dof| measured(&dof)) {
        return Ok(Vec::new());
    }
    let step = log.instants.len().div_ceil(MAX_OBSERVATIONS).max(1);
    let some = || log.instants.iter().step_by(step);
    let mut measurement =
        MeasurementModel::for_observations(robot, &[IdentificationInput::Torque], some())?;
    let joints = measurement.unknowns().joints.clone();
    let mut pairs: Vec<Pairs> = joints.iter().map(|_| Pairs::default()).collect();
    let mut rows = Rows::new(measurement.unknowns());
    for instant in some() {
        measurement.make(instant, &mut rows)?;
        for row in 0..rows.count {
            let Some(place) = rows.n(row).iter().position(|x| *x != 0.0) else {
                continue;
            };
            let (torque, own) = (instant.torque[joints[place]], &mut pairs[place]);
            own.measured.push(torque);
            own.predicted.push(torque - rows.r(row));
            own.nuisance
                .extend(&rows.g(row)[FRICTION * place..][..FRICTION]);
            own.nuisance.push(instant.acceleration[joints[place]]);
        }
    }
    let compared: Vec<Option<Compared>> = pairs
        .iter()
        .map(|pairs| pairs.compare(robot.torque_side))
        .collect();
    let slides = |dof: &usize| {
        let joint = robot
            .model
            .dof_joint(*dof)
            .map(|joint| robot.model.joints()[joint]);
        joint.is_some_and(|joint| matches!(joint.kind, JointKind::Prismatic(_)))
    };
    let sliding: Vec<bool> = joints.iter().map(slides).collect();
    let each = joints.iter().zip(&sliding).zip(faults(&compared, &sliding));
    let found =
        each.filter_map(|((dof, slides), fault)| Some(faulty_torque(*dof, robot, *slides, fault?)));
    Ok(found.collect())
}

/// A measured joint torque with a wrong sign or unit.
pub(crate) struct FaultyTorque {
    /// Its degree of freedom.
    pub dof: usize,
    /// Why it is excluded.
    pub reason: String,
    pub finding: Finding,
}

fn faulty_torque(dof: usize, robot: &Robot, slides: bool, fault: Fault) -> FaultyTorque {
    let joint = robot.model.dof_name(dof);
    let (unit, units) = if slides {
        ("N", "newtons")
    } else {
        ("Nm", "newton metres")
    };
    let (code, reason, text) = match fault {
        Fault::Sign => (
            FindingCode::WrongSign,
            "sign",
            format!(
                "joint/{joint}/torque has the wrong sign: it is opposite to what the URDF's masses \
                 predict, and was excluded; positive is along the joint's axis, by the parent on \
                 the child. Check its sign, that of the encoder, and gravity_mps2"
            ),
        ),
        Fault::TooLarge(times) => (
            FindingCode::WrongUnits,
            "units",
            format!(
                "joint/{joint}/torque is about {times:.0} times what the URDF's masses predict, \
                 and was excluded: it is in counts or thousandths of {units}; convert it to \
                 {unit}"
            ),
        ),
        Fault::TooSmall(times) => (
            FindingCode::WrongUnits,
            "units",
            format!(
                "joint/{joint}/torque is about {times:.0} times smaller than the URDF's masses \
                 predict, and was excluded: its channel is dead, or it is in thousands of \
                 {units}; convert it to {unit}"
            ),
        ),
    };
    FaultyTorque {
        dof,
        reason: format!("{reason} of the torque of {joint}"),
        finding: Finding {
            severity: Severity::Warning,
            code,
            subject: format!("joint/{joint}/torque"),
            text,
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arithmetic::normals;

    /// A joint with a prediction of `size` times a few newton metres and `friction` times as many
    /// of friction; its measured torque is scaled by `scale`. CAD's error is `wrong` times another
    /// motion; with noise.
    fn joint(size: f64, friction: f64, scale: f64, wrong: f64, noise: f64) -> Option<Compared> {
        let deviates = normals(3, 1000);
        let mut pairs = Pairs::default();
        for (i, deviate) in deviates.iter().enumerate() {
            let t = 0.05 * i as f64;
            let (dq, ddq) = ((1.1 * t).cos(), -1.1 * (1.1 * t).sin());
            let (x, other) = (8.0 * (0.9 * t).sin() + ddq, 8.0 * (1.7 * t + 1.0).sin());
            let nuisance = [(dq / 0.02).tanh(), dq, 1.0];
            pairs.predicted.push(size * x);
            let lost = 4.0 * nuisance[0] + 3.0 * nuisance[1] - 2.0;
            let torque = size * (x + wrong * other) + friction * lost + noise * deviate;
            pairs.measured.push(scale * torque);
            pairs.nuisance.extend(nuisance);
            pairs.nuisance.push(ddq);
        }
        pairs.compare(TorqueSide::Link)
    }

    /// The fault of such a joint if it is the only one.
    fn found(scale: f64, wrong: f64, noise: f64) -> Option<Fault> {
        faults(&[joint(1.0, 1.0, scale, wrong, noise)], &[false])[0]
    }

    /// A gantry that carries a wrist: an error of the wrist's torque is found beside forces of a
    /// thousand newtons, and these are not compared with torques.
    #[test]
    fn forces_of_prismatic_joints_hide_no_torques() {
        let all = |wrist: f64| {
            [
                joint(200.0, 1.0, 1.0, 0.2, 1.0),
                joint(0.2, 0.2, wrist, 0.2, 0.01),
                joint(0.2, 0.2, 1.0, 0.2, 0.01),
            ]
        };
        let sliding = [true, false, false];
        assert_eq!(faults(&all(1.0), &sliding), [None; 3]);
        assert_eq!(
            faults(&all(-1.0), &sliding),
            [None, Some(Fault::Sign), None]
        );
        assert!(matches!(
            faults(&all(0.001), &sliding)[..],
            [None, Some(Fault::TooSmall(_)), None]
        ));
    }

    /// The first joint of an arm with vertical axes carries no load: its torque is friction.
    #[test]
    fn friction_alone_is_no_count() {
        assert_eq!(
            faults(&[joint(0.01, 3.0, 1.0, 0.2, 0.05)], &[false]),
            [None]
        );
        let counts = faults(&[joint(0.01, 3.0, 1000.0, 0.2, 0.05)], &[false]);
        assert!(
            matches!(counts[..], [Some(Fault::TooLarge(_))]),
            "{counts:?}"
        );
    }

    #[test]
    fn wrong_units_are_separated_from_a_wrong_model() {
        for (wrong, noise) in [(0.0, 0.01), (0.5, 1.0), (1.5, 4.0)] {
            assert_eq!(found(1.0, wrong, noise), None, "{wrong} {noise}");
        }
        assert_eq!(found(-1.0, 0.4, 1.0), Some(Fault::Sign));
        let Some(Fault::TooLarge(times)) = found(1000.0, 0.3, 1.0) else {
            panic!("thousandths")
        };
        assert!((700.0..1500.0).contains(&times), "{times}");
        assert!(matches!(found(-1000.0, 0.3, 1.0), Some(Fault::TooLarge(_))));
        let Some(Fault::TooSmall(times)) = found(0.001, 0.3, 1.0) else {
            panic!("thousands")
        };
        assert!((700.0..1500.0).contains(&times), "{times}");
        assert!(matches!(found(0.0, 0.0, 0.0), Some(Fault::TooSmall(_))));
    }
}
