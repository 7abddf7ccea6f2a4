//! Columns of the wrenches of sensors and contacts in the balance of a sub-tree.

use crate::spatial::{Pose, Vec3, Wrench};
use crate::structure::{ContactKind, ContactSpec};
use arrayvec::ArrayVec;

/// Unit torques, then unit forces, along the axes and at the origin of frame `m`, in `t`.
pub(super) fn wrench_columns(x_tm: &Pose) -> [Wrench; 6] {
    let axis = |i: usize| x_tm.rotation.column(i).into_owned();
    let torque = |i: usize| Wrench {
        torque: axis(i),
        force: Vec3::zeros(),
    };
    std::array::from_fn(|i| match i {
        0..3 => torque(i),
        _ => Wrench::of_force(&x_tm.translation, axis(i - 3)),
    })
}

/// The wrenches of a contact's unknowns, for unit values, in `t`.
pub(super) fn contact_columns(spec: &ContactSpec, x_tf: &Pose) -> ArrayVec<Wrench, 6> {
    let force = |along: Vec3| Wrench::of_force(&x_tf.point(&spec.position), along);
    match spec.kind {
        ContactKind::Wrench => wrench_columns(x_tf).into(),
        ContactKind::Force => (0..3)
            .map(|axis| force(x_tf.rotation.column(axis).into_owned()))
            .collect(),
        ContactKind::ForceAlong(direction) => {
            std::iter::once(force(x_tf.rotation * direction)).collect()
        }
    }
}
