//! The tree of bodies, seen from the base of the regime.

use super::assemble::{Scale, wrench_transform};
use super::reach::Reach;
use crate::error::DynamicsError;
use crate::model::{JointKind, Model};
use crate::regressor::identifiable::regime::{Body, Freedom, JointMotion, Regime};
use crate::regressor::identifiable::scaling::{check_size_of, exponential, of_order_one};
use crate::spatial::{Motion, Pose, Vec3, Wrench};
use crate::structure::SensorCut;
use nalgebra::SMatrix;

/// The offset of a sensor on a body.
pub(crate) struct Attached {
    pub(crate) body: usize,
    /// Index of its six columns.
    pub(crate) column: usize,
    /// From the measurement frame to the wrench in the body's frame, with its sign in the balance.
    pub(crate) carry: SMatrix<f64, 6, 6>,
}

/// How a sensor's offset enters the balance of the sub-trees above and below it: the link, and the
/// 6 x 6 matrix that takes it to a wrench in the link's frame.
pub(crate) fn sides(model: &Model, cut: &SensorCut) -> [(usize, SMatrix<f64, 6, 6>); 2] {
    let joint = &model.joints()[cut.joint()];
    let mut at_child = SMatrix::<f64, 6, 6>::zeros();
    for component in 0..6 {
        let unit = |i: usize| f64::from(u8::from(i == component));
        let Wrench { torque, force } = cut.transmitted(&Wrench {
            torque: Vec3::from_fn(|i, _| unit(i)),
            force: Vec3::from_fn(|i, _| unit(3 + i)),
        });
        at_child
            .fixed_view_mut::<3, 1>(0, component)
            .copy_from(&torque);
        at_child
            .fixed_view_mut::<3, 1>(3, component)
            .copy_from(&force);
    }
    let at_parent = -(wrench_transform(&joint.placement) * at_child);
    [(joint.child, at_child), (joint.parent, at_parent)]
}

/// A link in the order of a pass from the base, depth first.
pub(crate) struct Step {
    pub(crate) link: usize,
    /// Index in the pass of the previous link, and the joint between them.
    pub(crate) parent: Option<usize>,
    pub(crate) joint: Option<usize>,
    /// The joint is crossed from child to parent.
    pub(crate) reversed: bool,
}

impl Step {
    pub(crate) fn body(&self, model: &Model, regime: &Regime) -> Body {
        let Some(joint) = self.joint.map(|joint| model.joints()[joint]) else {
            return Body {
                parent: None,
                placement: Pose::identity(),
                joint: Vec::new(),
            };
        };
        let twist = match joint.kind {
            JointKind::Revolute(axis) => Some(Motion::rotation(&axis.vector, &Vec3::zeros())),
            JointKind::Prismatic(axis) => Some(Motion::translation(&axis.vector)),
            JointKind::Fixed => None,
        };
        // Crossed from child to parent, x_cp(q) = exp(-S q) x_cp(0) = x_cp(0) exp(-(x_pc S) q).
        let (placement, twist) = if self.reversed {
            let turned = twist.map(|twist| -joint.placement.twist(&twist));
            (joint.placement.inverse(), turned)
        } else {
            (joint.placement, twist)
        };
        // Joints that follow one another count as if each moved for itself: nearly any ratio but 1
        // and -1 leaves as much to identify.
        let motion = joint.dof.and_then(|dof| regime.joints.get(dof).copied());
        let motion = motion.map(|motion| match motion {
            JointMotion::Locked(q) => JointMotion::Locked(joint.ratio * q + joint.offset),
            _ if joint.ratio == 0.0 => JointMotion::Locked(joint.offset),
            moving => moving,
        });
        Body {
            parent: self.parent,
            placement,
            joint: twist
                .zip(motion)
                .map(|(twist, motion)| Freedom { twist, motion })
                .into_iter()
                .collect(),
        }
    }
}

/// The links of a model in the order of a pass from link `base`.
pub(crate) fn route(model: &Model, base: usize) -> Vec<Step> {
    let mut joints_at: Vec<Vec<usize>> = vec![Vec::new(); model.link_count()];
    for (number, joint) in model.joints().iter().enumerate() {
        joints_at[joint.parent].push(number);
        joints_at[joint.child].push(number);
    }
    let mut route: Vec<Step> = Vec::with_capacity(model.link_count());
    let mut waiting = vec![Step {
        link: base,
        parent: None,
        joint: None,
        reversed: false,
    }];
    while let Some(step) = waiting.pop() {
        let (link, from) = (step.link, step.joint);
        let place = route.len();
        route.push(step);
        for &number in joints_at[link]
            .iter()
            .rev()
            .filter(|&&joint| Some(joint) != from)
        {
            let joint = &model.joints()[number];
            let reversed = joint.child == link;
            waiting.push(Step {
                link: if reversed { joint.parent } else { joint.child },
                parent: Some(place),
                joint: Some(number),
                reversed,
            });
        }
    }
    route
}

/// The spans that the base attains. `held`: gravity and its freedoms; `None` if the base is free.
pub(crate) fn base_reach(
    held: Option<&(Vec3, Vec<(Motion, JointMotion)>)>,
    scale: &Scale,
    tolerance: f64,
) -> Reach {
    let Some((gravity, freedoms)) = held else {
        return Reach::free();
    };
    let mut reach = Reach::standing(&(gravity / -scale.acceleration));
    for (twist, motion) in freedoms {
        reach.cross(&of_order_one(twist, scale), *motion, false, tolerance);
    }
    reach
}

/// Pose of the outer body with moving freedoms at zero and locked ones at their positions, and the
/// freedoms in its frame there, each scaled to a largest entry of about one (only the direction of
/// the twist matters). `what` and `index` name them in an error.
pub(crate) fn at_reference(
    placement: &Pose,
    freedoms: &[Freedom],
    what: &'static str,
    index: impl Fn(usize) -> usize,
) -> Result<(Pose, Vec<(Motion, JointMotion)>), DynamicsError> {
    let mut outer = Pose::identity();
    let mut out = Vec::with_capacity(freedoms.len());
    for (number, freedom) in freedoms.iter().enumerate().rev() {
        let index = index(number);
        let Motion { angular, linear } = freedom.twist;
        let largest = angular.amax().max(linear.amax());
        let position = match freedom.motion {
            JointMotion::Locked(position) => position,
            JointMotion::Moving | JointMotion::Posed => 0.0,
        };
        let is_finite = angular
            .iter()
            .chain(&linear)
            .chain([&position])
            .all(|x| x.is_finite());
        if !is_finite {
            return Err(DynamicsError::NotFinite { what, index });
        }
        if largest == 0.0 {
            continue;
        }
        let twist = Motion {
            angular: angular / largest,
            linear: linear / largest,
        };
        out.push((outer.twist_back(&twist), freedom.motion));
        if position != 0.0 {
            let displacement = exponential(&twist, position * largest);
            check_size_of(&displacement.translation, what, index)?;
            outer = displacement * outer;
            check_size_of(&outer.translation, what, index)?;
        }
    }
    out.reverse();
    let pose = *placement * outer;
    check_size_of(&pose.translation, what, index(0))?;
    Ok((pose, out))
}
