//! Whether what a log gives as joint torques are these joints' torques: in newton metres, along the axis, alive. Asked before anything is fitted.
//!
//! What CAD says of a joint's torque is roughly right, however wrong its masses are. From both, measured `y` and predicted `x`, everything is taken off that friction and an offset may be (and a
//! rotor's inertia, where torques are the motors'), and they are compared:
//!
//! - `|y + x|^2 < |y - x|^2 / 3` (a correlation of -1/2 and less if they are of one size): the sign is turned;
//! - `|y| > 30 |x|` while the two go together (correlation above 0.7 either way), or `|y|` more than a hundred times any prediction for a joint of its kind (one that turns, one that slides): counts, or
//!   thousandths of newton metres;
//! - `|y| < |x| / 30`: thousands of newton metres, or nothing at all.
//!
//! No CAD is wrong by thirty times. Such a torque is left out of its log, and said.

use super::batch::Prepared;
use super::outcome::{Finding, LeftOut, Severity};
use super::rows::{FRICTION, RowMaker, Rows};
use crate::config::{IdentificationInput, TorqueSide};
use crate::dynamics::DynamicsError;
use crate::model::JointKind;
use crate::setup::Setup;
use nalgebra::{DMatrix, DVector};

/// Instants that are looked at, at most and at least.
const ENOUGH: usize = 2000;
const LEAST: usize = 50;

/// A torque so many times what CAD says, or as many times less, is none in newton metres.
const FACTOR: f64 = 30.0;

/// ... and one so many times what CAD says of any joint of its kind, whatever it does.
const BEYOND: f64 = 100.0;

/// Predictions less than this share of the greatest joint's of its kind are mostly what CAD has wrong.
const SMALL: f64 = 0.01;

/// What is wrong with a torque.
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

    /// Root mean squares of what is measured, what is predicted, their sum and their difference, without what friction and offset may be (of a motor, the rotor's inertia, too); and
    /// how the first two go together, -1 to 1.
    fn compare(&self, side: TorqueSide) -> Option<Compared> {
        let count = self.measured.len();
        if count < LEAST {
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
    /// With what friction and offset may be.
    raw_predicted: f64,
}

impl Compared {
    /// `greatest`: of all joints of its kind, what is predicted without friction's part; and as predicted. What is measured has friction and offset taken off: a joint that carries next to nothing may
    /// need any amount for these.
    fn fault(&self, greatest: f64, greatest_raw: f64) -> Option<Fault> {
        let tells = self.predicted > SMALL * greatest && self.predicted > 0.0;
        let ratio = self.measured / self.predicted;
        if greatest_raw > 0.0 && self.measured > BEYOND * greatest_raw {
            Some(Fault::TooLarge(self.measured / greatest_raw))
        } else if tells && ratio > FACTOR && self.correlation.abs() > 0.7 {
            Some(Fault::TooLarge(ratio))
        } else if tells && ratio < 1.0 / FACTOR {
            Some(Fault::TooSmall(1.0 / ratio))
        } else if tells && 3.0 * self.sum.powi(2) < self.difference.powi(2) {
            Some(Fault::Sign)
        } else {
            None
        }
    }
}

/// What is wrong with each of these torques; `sliding`: of a joint that slides, whose are forces. Newtons are compared with newtons, newton metres with newton metres.
fn faults(compared: &[Option<Compared>], sliding: &[bool]) -> Vec<Option<Fault>> {
    let greatest = |slides: bool, of: &dyn Fn(&Compared) -> f64| {
        let own = compared.iter().zip(sliding).filter(|(_, own)| **own == slides);
        own.filter_map(|(compared, _)| compared.as_ref())
            .map(of)
            .fold(0.0, f64::max)
    };
    let [turning, slides] =
        [false, true].map(|kind| (greatest(kind, &|c| c.predicted), greatest(kind, &|c| c.raw_predicted)));
    let all = compared.iter().zip(sliding);
    all.map(|(compared, own)| {
        let (predicted, raw) = if *own { slides } else { turning };
        compared.as_ref()?.fault(predicted, raw)
    })
    .collect()
}

/// Takes torques out of a log that are none, and says so there.
///
/// # Errors
/// Instants of another robot.
pub(super) fn check(setup: &Setup, log: &mut Prepared) -> Result<(), DynamicsError> {
    let measured = |dof: &usize| {
        log.instants
            .iter()
            .any(|i| i.torque.get(*dof).is_some_and(|x| x.is_finite()))
    };
    if log.refused || !(0..setup.model.dof_count()).any(|dof| measured(&dof)) {
        return Ok(());
    }
    let step = log.instants.len().div_ceil(ENOUGH).max(1);
    let some = || log.instants.iter().step_by(step);
    let mut maker = RowMaker::survey(setup, &[IdentificationInput::Torque], some())?;
    let joints = maker.layout().joints.clone();
    let mut pairs: Vec<Pairs> = joints.iter().map(|_| Pairs::default()).collect();
    let mut rows = Rows::new(maker.layout());
    for instant in some() {
        maker.make(instant, &mut rows)?;
        for row in 0..rows.count {
            let Some(place) = rows.n(row).iter().position(|x| *x != 0.0) else {
                continue;
            };
            let (torque, own) = (instant.torque[joints[place]], &mut pairs[place]);
            own.measured.push(torque);
            own.predicted.push(torque - rows.r(row));
            own.nuisance.extend(&rows.g(row)[FRICTION * place..][..FRICTION]);
            own.nuisance.push(instant.acceleration[joints[place]]);
        }
    }
    let compared: Vec<Option<Compared>> = pairs.iter().map(|pairs| pairs.compare(setup.torque_side)).collect();
    let slides = |dof: &usize| {
        let joint = setup.model.dof_joint(*dof).map(|joint| setup.model.joints()[joint]);
        joint.is_some_and(|joint| matches!(joint.kind, JointKind::Prismatic(_)))
    };
    let sliding: Vec<bool> = joints.iter().map(slides).collect();
    for ((dof, slides), fault) in joints.iter().zip(&sliding).zip(faults(&compared, &sliding)) {
        if let Some(fault) = fault {
            leave_out(log, *dof, setup.model.dof_name(*dof), *slides, fault);
        }
    }
    Ok(())
}

fn leave_out(log: &mut Prepared, dof: usize, joint: &str, slides: bool, fault: Fault) {
    let (unit, units) = if slides {
        ("N", "newtons")
    } else {
        ("Nm", "newton metres")
    };
    let (code, reason, text) = match fault {
        Fault::Sign => (
            "wrong_sign",
            "sign",
            format!(
                "joint/{joint}/torque is turned: it goes against what the masses of the URDF ask for. It was left out; a torque along the joint's axis, by the parent on the child, is positive: check its sign, that of the encoder, and gravity_mps2"
            ),
        ),
        Fault::TooLarge(times) => (
            "wrong_units",
            "units",
            format!(
                "joint/{joint}/torque is about {times:.0} times what the masses of the URDF ask for: it is in counts or thousandths of {units}. It was left out; convert it to {unit}"
            ),
        ),
        Fault::TooSmall(times) => (
            "wrong_units",
            "units",
            format!(
                "joint/{joint}/torque hardly follows the motion: what the masses of the URDF ask for is about {times:.0} times as much. It was left out; its channel is dead, or it is in thousands of {units}: convert it to {unit}"
            ),
        ),
    };
    let mut out: Option<LeftOut> = None;
    for instant in &mut log.instants {
        if instant.torque.get(dof).is_some_and(|x| x.is_finite()) {
            instant.torque[dof] = f64::NAN;
            let entry = out.get_or_insert(LeftOut {
                reason: format!("{reason} of the torque of {joint}"),
                instants: 0,
                first: instant.t,
                last: instant.t,
            });
            (entry.instants, entry.last) = (entry.instants + 1, instant.t);
        }
    }
    log.left_out.extend(out);
    log.findings.push(Finding {
        severity: Severity::Warning,
        code,
        subject: format!("joint/{joint}/torque"),
        text,
    });
}

#[cfg(test)]
mod tests {
    use super::super::normals;
    use super::*;

    /// A joint of which CAD says `size` times a few newton metres and which needs `friction` times as many against friction; its torque is `scale` times that, and CAD is wrong by `wrong` of another
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

    /// What is found of such a joint if there is no other.
    fn found(scale: f64, wrong: f64, noise: f64) -> Option<Fault> {
        faults(&[joint(1.0, 1.0, scale, wrong, noise)], &[false])[0]
    }

    /// A gantry that carries a wrist: what is wrong with a wrist's torque is found beside forces of a thousand newtons, and these are not too large for any torque.
    #[test]
    fn forces_of_joints_that_slide_hide_no_torques() {
        let all = |wrist: f64| {
            [
                joint(200.0, 1.0, 1.0, 0.2, 1.0),
                joint(0.2, 0.2, wrist, 0.2, 0.01),
                joint(0.2, 0.2, 1.0, 0.2, 0.01),
            ]
        };
        let sliding = [true, false, false];
        assert_eq!(faults(&all(1.0), &sliding), [None; 3]);
        assert_eq!(faults(&all(-1.0), &sliding), [None, Some(Fault::Sign), None]);
        assert!(matches!(
            faults(&all(0.001), &sliding)[..],
            [None, Some(Fault::TooSmall(_)), None]
        ));
    }

    /// The first joint of an arm whose axes are upright carries nothing: its torque is friction, however much.
    #[test]
    fn friction_alone_is_no_count() {
        assert_eq!(faults(&[joint(0.01, 3.0, 1.0, 0.2, 0.05)], &[false]), [None]);
        let counts = faults(&[joint(0.01, 3.0, 1000.0, 0.2, 0.05)], &[false]);
        assert!(matches!(counts[..], [Some(Fault::TooLarge(_))]), "{counts:?}");
    }

    #[test]
    fn torques_that_are_none_are_told_from_a_wrong_model() {
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
