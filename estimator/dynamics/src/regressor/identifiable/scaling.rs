//! Units in which lengths, masses and accelerations are of order one, and checks of the input.

use super::assemble::Scale;
use crate::error::DynamicsError;
use crate::spatial::{Mat3, Motion, Pose, Vec3, Wrench};
use crate::structure::{ContactKind, ContactSpec};

/// A twist in scaled units, of length one.
pub(crate) fn of_order_one(twist: &Motion, scale: &Scale) -> Motion {
    let Motion { angular, linear } = twist;
    let linear = linear / scale.length;
    let norm = angular.norm().hypot(linear.norm());
    Motion {
        angular: angular / norm,
        linear: linear / norm,
    }
}

/// A wrench in scaled units, [torque; force], of length one.
pub(crate) fn of_length_one(wrench: &Wrench, scale: &Scale) -> [f64; 6] {
    let (n, f) = (wrench.torque / scale.length, wrench.force);
    let norm = n.norm().hypot(f.norm());
    [n.x, n.y, n.z, f.x, f.y, f.z].map(|x| x / norm)
}

/// The wrenches of a contact's unknowns, for unit values, in the link's frame.
pub(crate) fn contact_wrenches(spec: &ContactSpec) -> Vec<Wrench> {
    let pose = &spec.frame.pose;
    let point = pose.point(&spec.position);
    let force = |along: Vec3| Wrench {
        torque: point.cross(&along),
        force: along,
    };
    let axes = [Vec3::x(), Vec3::y(), Vec3::z()];
    match spec.kind {
        ContactKind::Wrench => {
            let torques = axes.map(|torque| Wrench {
                torque,
                force: Vec3::zeros(),
            });
            torques.into_iter().chain(axes.map(force)).collect()
        }
        ContactKind::Force => axes.map(force).to_vec(),
        ContactKind::ForceAlong(direction) => vec![force(pose.rotation * direction)],
    }
}

/// The displacement by a constant twist, `exp(S q)`: a rotation about its axis, and a translation
/// along it.
pub(crate) fn exponential(twist: &Motion, q: f64) -> Pose {
    let rate = twist.angular.norm();
    if rate == 0.0 {
        return Pose {
            rotation: Mat3::identity(),
            translation: twist.linear * q,
        };
    }
    let (axis, v) = (twist.angular / rate, twist.linear / rate);
    let angle = rate * q;
    let cross = axis.cross_matrix();
    let (sine, versine) = (angle.sin(), 2.0 * (angle / 2.0).sin().powi(2));
    let along = axis * axis.dot(&v);
    Pose {
        rotation: Mat3::identity() + cross * sine + cross * cross * versine,
        translation: along * angle + (v - along) * sine + axis.cross(&v) * versine,
    }
}

pub(crate) fn scaled(pose: &Pose, scale: &Scale) -> Pose {
    Pose {
        rotation: pose.rotation,
        translation: pose.translation / scale.length,
    }
}

/// Greatest length [m] and acceleration [m/s^2]; the inverse is the smallest unit. The squares of
/// lengths are added to numbers of order one.
pub(crate) const LARGEST: f64 = 1e6;

/// The unit of lengths, or of accelerations: the largest one, if it is usable.
pub(crate) fn unit(sizes: impl Iterator<Item = f64>) -> f64 {
    let largest = sizes.fold(0.0, f64::max);
    if largest > 1.0 / LARGEST {
        largest
    } else {
        1.0
    }
}

pub(crate) fn check_size_of(
    vector: &Vec3,
    what: &'static str,
    index: usize,
) -> Result<(), DynamicsError> {
    if vector.iter().any(|x| !x.is_finite()) {
        return Err(DynamicsError::NotFinite { what, index });
    }
    if vector.amax() > LARGEST {
        return Err(DynamicsError::OutOfRange { what, index });
    }
    Ok(())
}

pub(crate) fn check_pose(
    pose: &Pose,
    tolerance: f64,
    what: &'static str,
    index: usize,
) -> Result<(), DynamicsError> {
    if !pose.is_finite() {
        return Err(DynamicsError::NotFinite { what, index });
    }
    check_size_of(&pose.translation, what, index)?;
    let r = &pose.rotation;
    let is_orthonormal = (r.tr_mul(r) - Mat3::identity()).amax() <= tolerance;
    if is_orthonormal && r.determinant() > 0.0 {
        Ok(())
    } else {
        Err(DynamicsError::NoRotation { what, index })
    }
}
