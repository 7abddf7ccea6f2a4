//! Results of the solver: torques from both sides, contact wrenches, balances, and their certainty.

use crate::spatial::{Vec3, Wrench};
use crate::structure::SensorSet;

/// The basis of a result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Certainty {
    /// Measurements and the model.
    Determined,
    /// Also a choice. Either the contacts have more unknowns than the six equations determine, and
    /// the solution of least norm was taken; or nothing measures the wrench that holds the
    /// sub-tree, and its imbalance was left as it is.
    Assumed,
    /// The contact is not present; its wrench is zero by declaration.
    Absent,
}

/// The wrench of one contact.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactEstimate {
    /// The wrench by the environment on the link, in the axes and about the origin of the contact's
    /// frame.
    pub wrench: Wrench,
    /// Standard deviations from F/T noise, `[fx fy fz tx ty tz]` [N, Nm]; see
    /// [`Solver::update_deviations`].
    pub deviation: [f64; 6],
    /// Its basis.
    pub certainty: Certainty,
}

impl ContactEstimate {
    pub(crate) const ABSENT: Self = Self {
        wrench: Wrench {
            torque: Vec3::new(0.0, 0.0, 0.0),
            force: Vec3::new(0.0, 0.0, 0.0),
        },
        deviation: [0.0; 6],
        certainty: Certainty::Absent,
    };
}

/// The residual of the six equations of a sub-tree.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Balance {
    /// The part of the net wrench that neither sensors nor contacts explain, about the origin and
    /// in the axes of the sub-tree's top link.
    pub residual: Wrench,
    /// The residual squared, weighted by the inverse covariance of F/T noise: chi-square
    /// distributed if the model is correct and there is no undeclared contact. `None` if no sensor
    /// measures the sub-tree.
    pub chi_square: Option<f64>,
    /// Its degrees of freedom: six minus the rank of the unknowns.
    pub degrees: usize,
}

/// A joint torque computed from one side of the joint, within its sub-tree.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SideTorque {
    /// The torque [Nm or N], with the sign of [`Solver::torque`].
    pub torque: f64,
    /// Its standard deviation from the noise of this side's F/T sensors [Nm or N]. Zero if there is
    /// no sensor, which does not mean that the torque is exact.
    pub deviation: f64,
    /// This side's F/T sensors. If there is none, the side is a free end, and the torque is the
    /// model's prediction for its motion: not a measurement, but a value to compare with the other
    /// side.
    pub sensors: SensorSet,
}

/// A joint torque from both sides of the joint, each without the sensors and links of the other. A
/// side is `None` where an unknown contact acts.
///
/// Let `F_j` be the sum of the net wrenches of the links below joint `j` in its sub-tree, minus
/// their sensors' and known external wrenches; `b` the same sum for the whole sub-tree; and `s_j`
/// the joint's unit motion. The side of the child gives `s_j . F_j`, that of the parent
/// `s_j . (F_j - b)` ([`Solver::sides`]). They have different sensors, so their errors are
/// independent. Their difference `s_j . b`, the imbalance along the axis, has the variance
/// `s_j^T C s_j`, where `C` and `C_j` are the covariances of `b` and `F_j` from the noise of their
/// sensors. This is a check of the calibration joint by joint.
///
/// The fused torque is better than the mean of the two torques weighted by inverse variance.
/// Without unknowns all six components of `b` are noise; their covariance with the noise of
/// `s_j . F_j` is `C_j s_j`. Of all `s_j . F_j - h . b` the one of least variance has
/// `h = C^-1 C_j s_j` (Gauss-Markov). It is the component along the axis of the mean of the two
/// *wrenches*, `F_j` with covariance `C_j` and `F_j - b` with `C - C_j`, weighted by inverse
/// covariance:
///
/// ```text
/// s . (C_j^-1 + (C - C_j)^-1)^-1 (C_j^-1 F_j + (C - C_j)^-1 (F_j - b)) = s . F_j - s . C_j C^-1 b
/// ```
///
/// The mean of the two torques is the member `h = w s_j` of that family. It is equally good only
/// where `C_j s_j` is parallel to `C s_j`: then the other five equations have no information about
/// the noise in this one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sides {
    /// From the side of the URDF child.
    pub child: Option<SideTorque>,
    /// From the side of the URDF parent.
    pub parent: Option<SideTorque>,
}

/// Difference between the two sides of a joint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Disagreement {
    /// Torque from the side of the child minus torque from that of the parent [Nm or N].
    pub difference: f64,
    /// Standard deviation of the difference from F/T noise: the two sides share no sensor, so their
    /// variances add. A difference far above it indicates an error of the calibration or the model,
    /// or an undeclared contact.
    pub deviation: f64,
}

impl Sides {
    /// The comparison of the two sides; `None` unless both exist and at least one has a sensor.
    pub fn disagreement(&self) -> Option<Disagreement> {
        let (child, parent) = (self.child?, self.parent?);
        let measured = !(child.sensors.is_empty() && parent.sensors.is_empty());
        measured.then(|| Disagreement {
            difference: child.torque - parent.torque,
            deviation: child.deviation.hypot(parent.deviation),
        })
    }
}
