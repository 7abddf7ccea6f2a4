//! The pass from the base of the regime over all links: their geometry, units in which it is of
//! order one, and checks of the input.

use super::regime::{JointMotion, Measurement, Regime, Scope};
use crate::error::DynamicsError;
use crate::model::{JointKind, Model};
use crate::spatial::{Mat3, Motion, Pose, Vec3, Wrench};
use crate::structure::{ContactKind, ContactSpec, SensorCut, Structure};
use nalgebra::Matrix6;

/// Greatest length [m] and acceleration [m/s^2]; the inverse is the smallest unit. The squares of
/// lengths are added to numbers of order one.
const LARGEST: f64 = 1e6;

/// A link in the order of the pass, depth first.
pub(super) struct Visit {
    pub(super) link: usize,
    /// Index in the pass of the previous link.
    pub(super) parent: Option<usize>,
    /// Pose in the previous link, with the joint between them at its reference position: zero, or
    /// where it is locked.
    pub(super) placement: Pose,
    /// The twist that this joint allows, in the frame of the link, and whether it moves.
    pub(super) freedom: Option<(Motion, bool)>,
}

impl Visit {
    /// Crosses a joint to `link`.
    fn across(
        model: &Model,
        regime: &Regime,
        link: usize,
        (parent, joint): (usize, usize),
    ) -> Result<Self, DynamicsError> {
        let joint = &model.joints()[joint];
        let twist = match joint.kind {
            JointKind::Revolute(axis) => Some(Motion::rotation(&axis.vector, &Vec3::zeros())),
            JointKind::Prismatic(axis) => Some(Motion::translation(&axis.vector)),
            JointKind::Fixed => None,
        };
        // Crossed from child to parent, x_cp(q) = exp(-S q) x_cp(0) = x_cp(0) exp(-(x_pc S) q).
        let (mut placement, twist) = if joint.parent == link {
            let turned = twist.map(|twist| -joint.placement.twist(&twist));
            (joint.placement.inverse(), turned)
        } else {
            (joint.placement, twist)
        };
        check_vector(&placement.translation, "placement of link", link)?;
        // Joints that follow one another count as if each moved for itself: nearly any ratio but 1
        // and -1 leaves as much to identify.
        let motion = joint.dof.and_then(|dof| regime.joints.get(dof).copied());
        let motion = motion.map(|motion| match motion {
            JointMotion::Locked(q) => JointMotion::Locked(joint.ratio * q + joint.offset),
            JointMotion::Moving if joint.ratio == 0.0 => JointMotion::Locked(joint.offset),
            JointMotion::Moving => JointMotion::Moving,
        });
        // Only its direction matters: scaled to a largest entry of one.
        let freedom = twist
            .zip(motion)
            .map(|(Motion { angular, linear }, motion)| {
                let largest = angular.amax().max(linear.amax());
                let (angular, linear) = (angular / largest, linear / largest);
                (Motion { angular, linear }, largest, motion)
            });
        if let Some((twist, largest, JointMotion::Locked(position))) = freedom {
            let what = "joint to link";
            if !position.is_finite() {
                return Err(DynamicsError::NotFinite { what, index: link });
            }
            let displacement = displacement(&twist, position * largest);
            check_vector(&displacement.translation, what, link)?;
            placement = placement * displacement;
            check_vector(&placement.translation, what, link)?;
        }
        Ok(Self {
            link,
            parent: Some(parent),
            placement,
            freedom: freedom.map(|(twist, _, motion)| (twist, motion == JointMotion::Moving)),
        })
    }
}

/// The links of a model in the order of a pass from the base of the regime.
pub(super) fn pass(model: &Model, regime: &Regime) -> Result<Vec<Visit>, DynamicsError> {
    let mut joints_at: Vec<Vec<usize>> = vec![Vec::new(); model.link_count()];
    for (number, joint) in model.joints().iter().enumerate() {
        joints_at[joint.parent].push(number);
        joints_at[joint.child].push(number);
    }
    let mut visits: Vec<Visit> = Vec::with_capacity(model.link_count());
    // Each with the index of the previous link and the joint between them.
    let mut waiting = vec![(regime.base, None)];
    while let Some((link, from)) = waiting.pop() {
        let index = visits.len();
        visits.push(match from {
            Some(from) => Visit::across(model, regime, link, from)?,
            None => Visit {
                link,
                parent: None,
                placement: Pose::identity(),
                freedom: None,
            },
        });
        let crossed = from.map(|(_, joint)| joint);
        let onward = joints_at[link].iter().rev();
        for &number in onward.filter(|&&joint| Some(joint) != crossed) {
            let joint = &model.joints()[number];
            let next = if joint.child == link {
                joint.parent
            } else {
                joint.child
            };
            waiting.push((next, Some((index, number))));
        }
    }
    Ok(visits)
}

/// The displacement by a constant twist, `exp(S q)`: a rotation about its axis, and a translation
/// along it.
fn displacement(twist: &Motion, q: f64) -> Pose {
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

/// Refuses a vector that is not finite, or too large to compute with.
pub(super) fn check_vector(
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

/// Units in which geometry and motion are of order one; mass is in kg.
#[derive(Clone, Copy, Debug)]
pub(super) struct Units {
    /// [m]
    length: f64,
    /// [m/s^2]
    pub(super) acceleration: f64,
}

impl Units {
    /// The greatest distance between neighbouring joints, and gravity.
    pub(super) fn of(visits: &[Visit], gravity: Option<&Vec3>) -> Self {
        let largest = |sizes: &mut dyn Iterator<Item = f64>| {
            let largest = sizes.fold(0.0, f64::max);
            if largest > 1.0 / LARGEST {
                largest
            } else {
                1.0
            }
        };
        let beyond_base = visits.iter().skip(1);
        Self {
            length: largest(&mut beyond_base.map(|visit| visit.placement.translation.norm())),
            acceleration: largest(&mut gravity.iter().map(|gravity| gravity.norm())),
        }
    }

    pub(super) fn pose(&self, pose: &Pose) -> Pose {
        Pose {
            rotation: pose.rotation,
            translation: pose.translation / self.length,
        }
    }

    /// A twist, scaled to length one: only its direction matters.
    pub(super) fn twist(&self, Motion { angular, linear }: &Motion) -> Motion {
        let linear = linear / self.length;
        let norm = angular.norm().hypot(linear.norm());
        Motion {
            angular: angular / norm,
            linear: linear / norm,
        }
    }

    /// A wrench [torque; force], scaled to length one.
    pub(super) fn wrench(&self, wrench: &Wrench) -> [f64; 6] {
        let (n, f) = (wrench.torque / self.length, wrench.force);
        let norm = n.norm().hypot(f.norm());
        [n.x, n.y, n.z, f.x, f.y, f.z].map(|x| x / norm)
    }

    /// Factor from a parameter in SI units to the scaled one.
    pub(super) fn parameter(&self, index: usize) -> f64 {
        match index {
            0 => 1.0,
            1..=3 => 1.0 / self.length,
            _ => 1.0 / (self.length * self.length),
        }
    }

    /// Factor from a component of an offset, [torque; force], in SI units to the scaled one.
    pub(super) fn offset(&self, component: usize) -> f64 {
        if component < 3 {
            1.0 / (self.acceleration * self.length)
        } else {
            1.0 / self.acceleration
        }
    }
}

/// Unknown wrenches that are always present, each with the number of the separately measured part
/// on which it acts, in the frame of the part's first link.
pub(super) fn contact_wrenches(
    scope: Scope<'_>,
    regime: &Regime,
    measured: Measurement,
    visits: &[Visit],
) -> Result<Vec<(usize, Wrench)>, DynamicsError> {
    let mut unknown = Vec::new();
    for contact in regime.contacts.iter() {
        let contacts = scope.structure().map_or(&[][..], Structure::contacts);
        let spec = contacts.get(contact).ok_or(DynamicsError::Index {
            what: "contacts",
            index: contact,
            count: contacts.len(),
        })?;
        let Some(part) = scope.part_of(spec.frame.link) else {
            continue;
        };
        let first = visits
            .iter()
            .find(|visit| scope.part_of(visit.link) == Some(part));
        let is_first = first.is_some_and(|visit| visit.link == spec.frame.link);
        // Its place is irrelevant if it removes the whole balance and nothing else is measured.
        if !is_first && (spec.kind != ContactKind::Wrench || measured != Measurement::Wrench) {
            return Err(DynamicsError::Contact(contact));
        }
        unknown.extend(unit_wrenches(spec).into_iter().map(|wrench| (part, wrench)));
    }
    Ok(unknown)
}

/// The wrenches of a contact's unknowns, for unit values, in the link's frame.
fn unit_wrenches(spec: &ContactSpec) -> Vec<Wrench> {
    let pose = &spec.frame.pose;
    let point = pose.point(&spec.position);
    let force = |along: Vec3| Wrench::of_force(&point, along);
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

/// How a sensor's offset enters the balance of the sub-trees above and below it: the link, and the
/// matrix that takes it to a wrench in the link's frame.
pub(super) fn sides(model: &Model, cut: &SensorCut) -> [(usize, Matrix6<f64>); 2] {
    let joint = &model.joints()[cut.joint()];
    let mut at_child = Matrix6::zeros();
    for component in 0..6 {
        let mut unit = [0.0; 6];
        unit[component] = 1.0;
        let wrench = cut.transmitted(&Wrench::from_torque_first(unit));
        at_child.set_column(component, &wrench.torque_first().into());
    }
    let at_parent = -(wrench_transform(&joint.placement) * at_child);
    [(joint.child, at_child), (joint.parent, at_parent)]
}

/// The matrix that takes a wrench [torque; force] in `b` to `a`, given `x_ab`.
pub(super) fn wrench_transform(x_ab: &Pose) -> Matrix6<f64> {
    let r = &x_ab.rotation;
    let mut matrix = Matrix6::zeros();
    matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(r);
    matrix.fixed_view_mut::<3, 3>(3, 3).copy_from(r);
    matrix
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&(x_ab.translation.cross_matrix() * r));
    matrix
}
