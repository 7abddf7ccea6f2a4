//! The gear between a device and a joint.

use proprio_topics::JointState;

/// joint = sign * device / ratio + offset.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointMap {
    /// sign / ratio.
    pub gain: f64,
    /// \[rad\].
    pub offset: f64,
}

impl JointMap {
    /// The identity.
    pub const IDENTITY: Self = Self {
        gain: 1.0,
        offset: 0.0,
    };

    /// The joint's state from the device's: gain and offset apply to position, the gain to its
    /// derivatives, and its inverse to the torque (of an ideal gear). The current passes unchanged.
    #[must_use]
    pub fn joint(&self, device: JointState) -> JointState {
        JointState {
            position: device.position * self.gain + self.offset,
            velocity: device.velocity * self.gain,
            acceleration: device.acceleration * self.gain,
            torque: device.torque / self.gain,
            ..device
        }
    }

    /// The device's state from the joint's: the inverse of [`JointMap::joint`].
    #[must_use]
    pub fn device(&self, joint: JointState) -> JointState {
        JointState {
            position: (joint.position - self.offset) / self.gain,
            velocity: joint.velocity / self.gain,
            acceleration: joint.acceleration / self.gain,
            torque: joint.torque * self.gain,
            ..joint
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A gear of 100 that turns the other way: a hundredth of the angle, 100 times the torque.
    #[test]
    fn a_gear_transmits_angles_and_torques() {
        let map = JointMap {
            gain: -1.0 / 100.0,
            offset: 0.5,
        };
        let motor = JointState {
            position: 200.0,
            velocity: 30.0,
            acceleration: 4.0,
            torque: 0.25,
            current: 1.5,
        };
        let joint = map.joint(motor);
        assert_eq!((joint.position, joint.velocity), (-1.5, -0.3));
        assert_eq!((joint.acceleration, joint.torque), (-0.04, -25.0));
        assert_eq!(joint.current, motor.current);
        let power = |state: JointState| state.torque * state.velocity;
        assert_eq!(power(joint), power(motor));
        let back = map.device(joint);
        assert!((back.position - motor.position).abs() < 1e-9);
        assert_eq!((back.velocity, back.torque), (30.0, 0.25));
    }
}
