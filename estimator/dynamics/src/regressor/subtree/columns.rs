//! Columns of the wrenches of sensors and contacts in the balance of a sub-tree.

use crate::spatial::{Motion, Pose, Vec3, Wrench};
use crate::structure::{ContactKind, ContactSpec};

pub(crate) fn put(values: &mut [f64], stride: usize, column: usize, sign: f64, unit: &Wrench) {
    for (row, value) in unit.torque_first().into_iter().enumerate() {
        values[row * stride + column] = sign * value;
    }
}

/// Unit torques, then unit forces, along the axes and at the origin of frame `m`, in `t`.
pub(crate) fn wrench_columns(x_tm: &Pose, mut column: impl FnMut(Wrench)) {
    for axis in 0..3 {
        column(Wrench {
            torque: x_tm.rotation.column(axis).into_owned(),
            force: Vec3::zeros(),
        });
    }
    for axis in 0..3 {
        column(force_at(
            &x_tm.translation,
            x_tm.rotation.column(axis).into_owned(),
        ));
    }
}

pub(crate) fn force_at(point: &Vec3, force: Vec3) -> Wrench {
    // A force along an axis has the components of a rotation about it, in the other order.
    let Motion { angular, linear } = Motion::rotation(&force, point);
    Wrench {
        torque: linear,
        force: angular,
    }
}

/// The wrenches of a contact's unknowns, for unit values, in `t`.
pub(crate) fn contact_columns(spec: &ContactSpec, x_tf: &Pose, mut column: impl FnMut(Wrench)) {
    let point = x_tf.point(&spec.position);
    match spec.kind {
        ContactKind::Wrench => wrench_columns(x_tf, column),
        ContactKind::Force => {
            (0..3)
                .for_each(|axis| column(force_at(&point, x_tf.rotation.column(axis).into_owned())));
        }
        ContactKind::ForceAlong(direction) => column(force_at(&point, x_tf.rotation * direction)),
    }
}
