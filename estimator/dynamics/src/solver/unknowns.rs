//! The unknowns of a contact: the columns of `A x = b`.

use crate::kinematics::Kinematics;
use crate::spatial::{Vec3, stack};
use crate::structure::{ContactKind, ContactSpec};
use nalgebra::Vector6;

/// The columns [torque; force] about `point` of the unknowns of a contact, and their weights in the
/// least norm: forces and torques at its position, along the axes of its frame.
pub fn unknowns(
    spec: &ContactSpec,
    kinematics: &Kinematics,
    point: &Vec3,
    length: f64,
) -> arrayvec::ArrayVec<(Vector6<f64>, f64), 6> {
    let x_bf = kinematics.frame_pose(&spec.frame);
    let arm = x_bf.point(&spec.position) - point;
    let force = |direction: Vec3| (stack(&arm.cross(&direction), &direction), 1.0);
    let torque = |direction: Vec3| (stack(&direction, &Vec3::zeros()), length);
    let axis = |i: usize| x_bf.rotation.column(i).into_owned();
    match spec.kind {
        ContactKind::Wrench => (0..3)
            .map(|i| force(axis(i)))
            .chain((0..3).map(|i| torque(axis(i))))
            .collect(),
        ContactKind::Force => (0..3).map(|i| force(axis(i))).collect(),
        ContactKind::ForceAlong(direction) => {
            std::iter::once(force(x_bf.rotation * direction)).collect()
        }
    }
}
