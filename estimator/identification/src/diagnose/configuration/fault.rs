//! Units and signs of readings: the size of a reading beside what CAD predicts for it, and whether
//! the two are alike.

use crate::finding::{Finding, FindingCode, Severity};
use crate::robot::Robot;
use nalgebra::{DMatrix, DVector};

/// Fewest values for a comparison with the prediction.
const MIN_VALUES: f64 = 50.0;

/// Readings above this multiple of the prediction have wrong units, and joint torques below its
/// inverse.
const FACTOR: f64 = 30.0;

/// So have F/T readings below the prediction by this factor ...
const SMALL: f64 = 300.0;

/// ... and joint torques above this multiple of the largest prediction for any joint of the kind.
const BEYOND: f64 = 100.0;

/// Predicted joint torques below this fraction of the largest one are dominated by CAD's errors.
const SLIGHT: f64 = 0.01;

/// A ratio of F/T readings beyond this, or below its inverse, is reported.
const ODD: f64 = 3.0;

/// Least magnitude of the correlation of readings and prediction: they share half of the squares.
const CORRELATED: f64 = 0.7;

/// A reading beside its prediction, both without what offsets and friction explain.
#[derive(Clone, Copy, Debug)]
pub(super) struct TorqueComparison {
    /// RMS of the prediction.
    pub(super) predicted: f64,
    /// RMS of the reading relative to it.
    pub(super) ratio: f64,
    correlation: f64,
}

impl TorqueComparison {
    /// A reading, given as a combination of columns, with CAD's prediction of it: their squares and
    /// products in so many rows, the residual last. None if there are too few, or no prediction.
    pub(super) fn new(gram: &DMatrix<f64>, rows: f64, reading: &DVector<f64>) -> Option<Self> {
        let mut prediction = reading.clone();
        *prediction.iter_mut().next_back()? -= 1.0;
        let product = |a: &DVector<f64>, b: &DVector<f64>| a.dot(&(gram * b));
        let [yy, xx, xy] = [
            product(reading, reading),
            product(&prediction, &prediction),
            product(reading, &prediction),
        ];
        (rows >= MIN_VALUES && xx > 0.0).then(|| Self {
            predicted: (xx / rows).sqrt(),
            ratio: (yy.max(0.0) / xx).sqrt(),
            correlation: xy / (yy * xx).sqrt().max(f64::MIN_POSITIVE),
        })
    }
}

/// An error of a unit or sign, with the ratio of reading and prediction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum ReadingFault {
    Sign,
    Unit(f64),
    /// Possible, but unusual.
    Odd,
}

/// The fault of each of these joint torques. `slides`: whether the joint is prismatic. Forces are
/// compared with forces, torques with torques.
pub(super) fn torque_faults(
    compared: &[Option<TorqueComparison>],
    slides: &[bool],
) -> Vec<Option<ReadingFault>> {
    let all = || compared.iter().zip(slides);
    all()
        .map(|(own, kind)| {
            let alike = all().filter(|(_, other)| *other == kind);
            let predicted = alike.filter_map(|(other, _)| Some(other.as_ref()?.predicted));
            let greatest = predicted.fold(0.0, f64::max);
            let TorqueComparison {
                predicted,
                ratio,
                correlation,
            } = (*own)?;
            let beyond = ratio * predicted / greatest;
            if beyond > BEYOND {
                Some(ReadingFault::Unit(beyond))
            } else if predicted <= SLIGHT * greatest {
                None
            } else if ratio > FACTOR && correlation.abs() > CORRELATED || ratio < 1.0 / FACTOR {
                Some(ReadingFault::Unit(ratio))
            } else {
                let is_opposite = 4.0 * correlation * ratio < -(1.0 + ratio * ratio);
                is_opposite.then_some(ReadingFault::Sign)
            }
        })
        .collect()
}

/// The fault of a sensor from its torques and forces, each with the largest change that the robot
/// can cause.
pub(super) fn wrench_fault(both: &[Option<(TorqueComparison, f64)>; 2]) -> Option<ReadingFault> {
    let both = || both.iter().flatten();
    let is_alike = |own: &TorqueComparison| own.correlation.abs() > CORRELATED;
    let is_large = |own: &TorqueComparison, most: f64| {
        own.ratio > FACTOR && is_alike(own) && own.ratio * own.predicted > most
    };
    let is_odd = |own: &TorqueComparison| {
        !(1.0 / ODD..=ODD).contains(&own.ratio) && own.correlation > CORRELATED
    };
    let (first, _) = both().next()?;
    if let Some((own, _)) = both().find(|(own, most)| is_large(own, *most)) {
        Some(ReadingFault::Unit(own.ratio))
    } else if both().all(|(own, _)| own.ratio < 1.0 / SMALL && is_alike(own)) {
        Some(ReadingFault::Unit(first.ratio))
    } else {
        both()
            .any(|(own, _)| is_odd(own))
            .then_some(ReadingFault::Odd)
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

impl ReadingFault {
    /// Why a joint's torque is left out, and the finding.
    pub(super) fn of_torque(self, robot: &Robot, dof: usize) -> (String, Finding) {
        let joint = robot.model.dof_name(dof);
        let (unit, units) = if robot.model.is_prismatic(dof) {
            ("N", "newtons")
        } else {
            ("Nm", "newton metres")
        };
        let (code, reason, what) = if let Self::Unit(ratio) = self {
            let cause = if ratio > 1.0 {
                format!("it is in counts or thousandths of {units}")
            } else {
                format!("its channel is dead, or it is in thousands of {units}")
            };
            let text = format!(
                "is {} what the URDF's masses predict, and was excluded: {cause}; convert it to \
                 {unit}",
                times(ratio)
            );
            (FindingCode::WrongUnits, "units", text)
        } else {
            let text = "has the wrong sign: it is opposite to what the URDF's masses predict, and \
                        was excluded; positive is along the joint's axis, by the parent on the \
                        child. Check its sign, that of the encoder, and gravity_mps2";
            (FindingCode::WrongSign, "sign", text.to_owned())
        };
        let finding = Finding::warning(
            code,
            format!("joint/{joint}/torque"),
            format!("joint/{joint}/torque {what}"),
        );
        (format!("{reason} of the torque of {joint}"), finding)
    }

    pub(super) fn of_wrench(self, name: &str, force: Option<f64>, torque: Option<f64>) -> Finding {
        let both = [("forces", force), ("torques", torque)].into_iter();
        let ratios = both.filter_map(|(word, ratio)| Some(format!("{word} {}", times(ratio?))));
        let ratios = ratios.collect::<Vec<_>>().join(" and ");
        let (severity, code, rest) = match self {
            Self::Unit(ratio) if ratio > 1.0 => (
                Severity::Refusal,
                FindingCode::WrongUnits,
                "it is in counts or in mN and mNm (convert it to N and Nm), or the URDF's masses \
                 are not in kg",
            ),
            Self::Unit(_) => (
                Severity::Refusal,
                FindingCode::WrongUnits,
                "it is in kN and kNm (convert it to N and Nm), or the URDF's masses are not in kg",
            ),
            _ => (
                Severity::Warning,
                FindingCode::Scale,
                "the robot carries a load that the URDF lacks, or the URDF's masses are wrong by \
                 this factor; or the units (1 kgf is 9.807 N) or the calibration are wrong, and \
                 then so are the parameters: weigh the robot, or hang a known mass on it",
            ),
        };
        Finding::new(
            severity,
            code,
            format!("wrench/{name}"),
            format!(
                "wrench/{name} does not change as the URDF's masses predict ({ratios} as \
                 large as predicted): {rest}"
            ),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arithmetic::normals;

    /// A reading of `scale` times the prediction, which is wrong by `wrong` times another motion;
    /// with noise.
    fn compared(size: f64, scale: f64, wrong: f64, noise: f64) -> TorqueComparison {
        let mut gram = DMatrix::zeros(2, 2);
        let deviates = normals(3, 1000);
        for (i, deviate) in deviates.iter().enumerate() {
            let t = 0.05 * i as f64;
            let (x, other) = (8.0 * (0.9 * t).sin(), 8.0 * (1.7 * t + 1.0).sin());
            let y = scale * (size * (x + wrong * other) + noise * deviate);
            let row = DVector::from_column_slice(&[y, y - size * x]);
            gram += &row * row.transpose();
        }
        let reading = DVector::from_column_slice(&[1.0, 0.0]);
        TorqueComparison::new(&gram, 1000.0, &reading).expect("enough")
    }

    /// The fault of a torque that is the only one.
    fn of_torque(scale: f64, wrong: f64, noise: f64) -> Option<ReadingFault> {
        torque_faults(&[Some(compared(1.0, scale, wrong, noise))], &[false])[0]
    }

    /// The fault of a sensor of a robot that weighs ten times the moved mass.
    fn of_force(scale: f64, wrong: f64, noise: f64) -> Option<ReadingFault> {
        wrench_fault(&[None, Some((compared(1.0, scale, wrong, noise), 80.0))])
    }

    fn is_unit(fault: Option<ReadingFault>, expected: f64) -> bool {
        matches!(fault, Some(ReadingFault::Unit(ratio)) if (0.7..1.5).contains(&(ratio / expected)))
    }

    #[test]
    fn wrong_units_are_separated_from_a_wrong_model() {
        for (wrong, noise) in [(0.0, 0.01), (0.5, 1.0), (1.5, 4.0)] {
            assert_eq!(of_torque(1.0, wrong, noise), None, "{wrong} {noise}");
            assert_eq!(of_force(1.0, wrong, noise), None, "{wrong} {noise}");
        }
        assert_eq!(of_torque(-1.0, 0.4, 1.0), Some(ReadingFault::Sign));
        // Cables and drifting offsets, with little motion, are not counts.
        assert_eq!(of_force(1.0, 60.0, 1.0), None);
        for (scale, times) in [(1000.0, 1000.0), (-1000.0, 1000.0), (0.001, 0.001)] {
            assert!(is_unit(of_torque(scale, 0.3, 1.0), times), "{scale}");
            assert!(is_unit(of_force(scale, 0.3, 1.0), times), "{scale}");
        }
        assert!(matches!(of_torque(0.0, 0.0, 0.0), Some(ReadingFault::Unit(ratio)) if ratio < 1.0));
        for kilograms in [0.102, 9.8] {
            assert_eq!(of_force(kilograms, 0.3, 1.0), Some(ReadingFault::Odd));
        }
    }

    /// A gantry that carries a wrist: an error of the wrist's torque is found beside forces of a
    /// thousand newtons, and these are not compared with torques. A joint that carries next to
    /// nothing shows its unit only by far.
    #[test]
    fn torques_are_compared_with_torques() {
        let all = |wrist: f64, idle: f64| {
            let joints = [
                compared(200.0, 1.0, 0.2, 1.0),
                compared(0.2, wrist, 0.2, 0.01),
                compared(0.2, 1.0, 0.2, 0.01),
                compared(1e-3, idle, 0.2, 0.1),
            ];
            torque_faults(&joints.map(Some), &[true, false, false, false])
        };
        assert_eq!(all(1.0, 1.0), [None; 4]);
        assert_eq!(all(-1.0, 1.0), [None, Some(ReadingFault::Sign), None, None]);
        let [None, small, None, None] = all(0.001, 1.0)[..] else {
            panic!("another fault")
        };
        assert!(is_unit(small, 0.001));
        assert!(matches!(
            all(1.0, 1e4)[..],
            [None, None, None, Some(ReadingFault::Unit(_))]
        ));
    }

    /// A gripper on a flange that the URDF lacks, or the opposite; a tool whose centre of mass is
    /// elsewhere: unusual, but possible.
    #[test]
    fn errors_of_the_urdf_are_not_refused() {
        let of_both = |force: f64, torque: f64| {
            wrench_fault(&[torque, force].map(|scale| {
                let own = compared(1.0, scale, 0.3, 1.0);
                Some((own, 5000.0))
            }))
        };
        for (force, torque) in [(40.0, 40.0), (0.02, 0.02), (1.1, 40.0), (1.1, 0.001)] {
            assert_eq!(
                of_both(force, torque),
                Some(ReadingFault::Odd),
                "{force} {torque}"
            );
        }
    }
}
