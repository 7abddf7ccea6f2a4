//! The drives of the simulated joints: what they report of the torque of a joint, with the friction
//! of a gear, the inertia of a rotor and the ripple of its teeth.

use crate::truth::JointTruth;
use proprio_dynamics::model::Model;

/// Speed over which the sign of friction is smoothed [rad/s or m/s]: another one than that of the
/// estimator's model, as a real gear has.
const SMOOTHING: f64 = 0.01;

/// A joint without limits in the URDF has these: effort [Nm or N], velocity [rad/s or m/s].
const LIMITS: (f64, f64) = (20.0, 2.0);

/// What a drive adds to the torque of its joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveTruth {
    /// Coulomb friction: 3 % of the effort limit [Nm or N].
    pub coulomb: f64,
    /// Viscous friction: 2 % of the effort limit at the limit of the velocity.
    pub viscous: f64,
    /// Friction by load.
    pub load: f64,
    /// Inertia of the rotor, reflected: a thousandth of the effort limit [kg m^2 or kg].
    pub rotor: f64,
    /// Peak of the ripple, a hundred times per radian or metre: 0.5 % of the effort limit.
    pub ripple: f64,
    /// Torque of the joint per current: the effort limit is at 10 A [Nm/A or N/A].
    pub per_ampere: f64,
}

impl DriveTruth {
    /// That of a joint, by its name.
    #[must_use]
    pub fn new(model: &Model, joint: &str) -> Self {
        let joint = model.joint(joint);
        let effort = joint.and_then(|joint| model.effort(joint));
        let velocity = joint.and_then(|joint| model.velocity(joint));
        let effort = effort.unwrap_or(LIMITS.0);
        Self {
            coulomb: 0.03 * effort,
            viscous: 0.02 * effort / velocity.unwrap_or(LIMITS.1),
            load: 0.05,
            rotor: 1e-3 * effort,
            ripple: 5e-3 * effort,
            per_ampere: effort / 10.0,
        }
    }

    /// The torque that a drive reports [Nm or N]: that of the motor, on the joint's side.
    #[must_use]
    pub fn torque(&self, joint: &JointTruth) -> f64 {
        let sign = (joint.velocity / SMOOTHING).tanh();
        joint.torque
            + (self.coulomb + self.load * joint.torque.abs()) * sign
            + self.viscous * joint.velocity
            + self.rotor * joint.acceleration
            + self.ripple * (100.0 * joint.position).sin()
    }
}
