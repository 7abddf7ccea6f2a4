//! What may be other than stated, and how the readings are to be taken then.

use crate::robot::{ChannelRole, NamedContact, Robot};
use nalgebra::Rotation3;
use proprio_dynamics::spatial::{Mat3, Vec3, Wrench};
use proprio_dynamics::{FrameMotion, JointState};
use std::f64::consts::PI;
use std::fmt;

/// Standard gravity \[m/s^2\].
pub(crate) const GRAVITY: f64 = 9.80665;

/// Standard deviation of each component of a turn of the base \[rad\].
const TURN: f64 = 0.3;
/// The same of what corrects an encoder: an offset \[rad or m\], and a relative gain.
const ENCODER: f64 = 0.2;

/// How the readings of joints and base are to be taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MotionReading {
    /// As stated.
    AsStated,
    /// This encoder counts in the other direction.
    Reversed(usize),
    /// This encoder's readings are in degrees, not in radians.
    Degrees(usize),
    /// These encoders have each other's readings.
    Swapped(usize, usize),
    /// The proper acceleration of the base that stands still is along this axis of the base link.
    Upright(Vec3),
    /// The IMU is mounted in another direction: this turns its readings, in axes of the base link.
    ImuTurned(Mat3),
    /// The IMU's accelerations are in g.
    ImuInG,
    /// The base is tilted, or its IMU mounted askew: this rotation vector turns the motion of the
    /// base, in axes of the base link. It is estimated; zero before.
    BaseTurned(Vec3),
    /// This encoder has another zero and another gain: its readings are to be raised by the second,
    /// a share, then by the first \[rad or m\]. Both are estimated; zero before.
    Encoder(usize, [f64; 2]),
}

impl MotionReading {
    /// The number of unknowns that are estimated.
    pub(crate) const fn unknowns(&self) -> usize {
        match self {
            Self::BaseTurned(_) => 3,
            Self::Encoder(..) => 2,
            _ => 0,
        }
    }

    /// With these values of its unknowns, in units of their standard deviations.
    pub(crate) fn at(self, values: &[f64]) -> Self {
        match (self, values) {
            (Self::BaseTurned(_), &[x, y, z]) => Self::BaseTurned(TURN * Vec3::new(x, y, z)),
            (Self::Encoder(dof, _), &[offset, gain]) => {
                Self::Encoder(dof, [ENCODER * offset, ENCODER * gain])
            }
            (other, _) => other,
        }
    }
}

/// How the readings of the F/T sensors are to be taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum WrenchReading {
    /// As stated.
    AsStated,
    /// This sensor's axes are others: forces and torques are turned, mirrored or negated by this.
    Axes(usize, Mat3),
    /// This sensor's readings are to be multiplied.
    Unit(usize, f64),
    /// These sensors have each other's readings.
    Swapped(usize, usize),
}

/// What may be the case, as far as it is other than stated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hypothesis {
    /// Joints and base.
    pub motion_reading: MotionReading,
    /// F/T sensors.
    pub wrench_reading: WrenchReading,
    /// The contact that has acted on the robot since the start, as a steady force.
    pub contact: Option<usize>,
}

impl Hypothesis {
    /// Everything is as stated, and no contact acts.
    pub(crate) const AS_STATED: Self = Self {
        motion_reading: MotionReading::AsStated,
        wrench_reading: WrenchReading::AsStated,
        contact: None,
    };

    /// The same, before anything is estimated.
    #[must_use]
    pub fn without_estimate(mut self) -> Self {
        self.motion_reading = self
            .motion_reading
            .at(&[0.0; 3][..self.motion_reading.unknowns()]);
        self
    }

    /// The channel whose readings are other than stated; none for a contact.
    #[must_use]
    pub const fn role(&self) -> Option<ChannelRole> {
        use MotionReading as Motion;
        use WrenchReading as Reading;
        match (self.motion_reading, self.wrench_reading) {
            (Motion::Reversed(dof) | Motion::Degrees(dof), _) => Some(ChannelRole::Joint(dof)),
            (Motion::Swapped(dof, _) | Motion::Encoder(dof, _), _) => Some(ChannelRole::Joint(dof)),
            (Motion::Upright(_) | Motion::BaseTurned(_), _) => Some(ChannelRole::Base),
            (Motion::ImuTurned(_) | Motion::ImuInG, _) => Some(ChannelRole::Base),
            (
                Motion::AsStated,
                Reading::Axes(sensor, _) | Reading::Unit(sensor, _) | Reading::Swapped(sensor, _),
            ) => Some(ChannelRole::Sensor(sensor)),
            (Motion::AsStated, Reading::AsStated) => None,
        }
    }

    /// For a person.
    #[must_use]
    pub const fn describe<'r>(&self, robot: &'r Robot) -> impl fmt::Display + use<'r> {
        DescribedHypothesis {
            hypothesis: *self,
            robot,
        }
    }
}

/// A hypothesis about `robot`.
struct DescribedHypothesis<'r> {
    hypothesis: Hypothesis,
    robot: &'r Robot,
}

impl fmt::Display for DescribedHypothesis<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        use MotionReading as Motion;
        use WrenchReading as Reading;
        let robot = self.robot;
        let joint = |dof: usize| robot.model.dof_name(dof);
        let sensor = |number: usize| {
            let cut = robot.structure.sensors().get(number);
            cut.map_or("?", |cut| robot.model.joint_name(cut.joint()))
        };
        let Hypothesis {
            motion_reading,
            wrench_reading,
            contact,
        } = self.hypothesis;
        let contact = contact.and_then(|number| robot.contacts.get(number));
        match (motion_reading, wrench_reading, contact) {
            (Motion::Reversed(dof), ..) => write!(f, "the encoder of {} is reversed", joint(dof)),
            (Motion::Degrees(dof), ..) => write!(f, "the encoder of {} reads degrees", joint(dof)),
            (Motion::Swapped(a, b), ..) => {
                let (a, b) = (joint(a), joint(b));
                write!(f, "the encoders of {a} and {b} are swapped")
            }
            (Motion::Upright(_), ..) => f.write_str("gravity has another direction than stated"),
            (Motion::ImuTurned(_), ..) => f.write_str("the IMU is mounted in another direction"),
            (Motion::ImuInG, ..) => f.write_str("the IMU reads accelerations in g"),
            (Motion::Encoder(dof, [offset, gain]), ..) => write!(
                f,
                "the encoder of {} has another zero or gain (right is {:.3} times its reading \
                 {offset:+.3})",
                joint(dof),
                1.0 + gain,
            ),
            (Motion::BaseTurned(turn), ..) => {
                let angle = turn.norm().to_degrees();
                write!(f, "the base, or its IMU, is tilted by {angle:.0} degrees")
            }
            (_, Reading::Axes(number, axes), _) => {
                let what = if axes == -Mat3::identity() {
                    "the other sign"
                } else {
                    "other axes"
                };
                write!(f, "the F/T sensor {} has {what}", sensor(number))
            }
            (_, Reading::Unit(number, factor), _) => write!(
                f,
                "the F/T sensor {} reads in another unit (right is {factor:.4} times its reading)",
                sensor(number)
            ),
            (_, Reading::Swapped(a, b), _) => {
                let (a, b) = (sensor(a), sensor(b));
                write!(f, "the F/T sensors {a} and {b} are swapped")
            }
            (.., Some(NamedContact { name, .. })) => {
                write!(f, "the contact {name} has been present since the start")
            }
            (Motion::AsStated, Reading::AsStated, None) => f.write_str("everything is as stated"),
        }
    }
}

/// The readings of joints and base at one time, as they are to be taken.
#[derive(Clone, Debug)]
pub(crate) struct SeenMotion {
    pub(crate) position: Vec<f64>,
    pub(crate) velocity: Vec<f64>,
    pub(crate) acceleration: Vec<f64>,
    /// Of the base link.
    pub(crate) base: FrameMotion,
}

impl SeenMotion {
    pub(crate) fn new(dofs: usize) -> Self {
        Self {
            position: vec![0.0; dofs],
            velocity: vec![0.0; dofs],
            acceleration: vec![0.0; dofs],
            base: FrameMotion::standing(&Vec3::zeros()),
        }
    }

    pub(crate) fn copy_from(&mut self, state: JointState<'_>, base: &FrameMotion) {
        self.position.copy_from_slice(state.position);
        self.velocity.copy_from_slice(state.velocity);
        self.acceleration.copy_from_slice(state.acceleration);
        self.base = *base;
    }

    pub(crate) fn state(&self) -> JointState<'_> {
        JointState {
            position: &self.position,
            velocity: &self.velocity,
            acceleration: &self.acceleration,
        }
    }

    /// Takes these readings of the motion as `motion_reading` says.
    pub(crate) fn see(&mut self, motion_reading: MotionReading) {
        let each = [
            &mut self.position,
            &mut self.velocity,
            &mut self.acceleration,
        ];
        match motion_reading {
            MotionReading::AsStated => {}
            MotionReading::Reversed(dof) => each.into_iter().for_each(|values| values[dof] *= -1.0),
            MotionReading::Degrees(dof) => {
                each.into_iter()
                    .for_each(|values| values[dof] *= PI / 180.0);
            }
            MotionReading::Swapped(a, b) => each.into_iter().for_each(|values| values.swap(a, b)),
            MotionReading::Upright(axis) => self.base.proper_acceleration = axis * GRAVITY,
            MotionReading::ImuTurned(turn) => self.turn_base(&turn),
            MotionReading::ImuInG => self.base.proper_acceleration *= GRAVITY,
            MotionReading::BaseTurned(turn) => self.turn_base(Rotation3::new(turn).matrix()),
            MotionReading::Encoder(dof, [offset, gain]) => {
                each.into_iter()
                    .for_each(|values| values[dof] *= 1.0 + gain);
                self.position[dof] += offset;
            }
        }
    }

    fn turn_base(&mut self, turn: &Mat3) {
        self.base.proper_acceleration = turn * self.base.proper_acceleration;
        self.base.angular_velocity = turn * self.base.angular_velocity;
        self.base.angular_acceleration = turn * self.base.angular_acceleration;
    }
}

impl WrenchReading {
    /// The reading of `sensor`, as it is to be taken.
    pub(crate) fn reading(self, sensor: usize, readings: &[Wrench]) -> Wrench {
        let own = readings[sensor];
        match self {
            Self::Axes(number, axes) if number == sensor => Wrench {
                force: axes * own.force,
                torque: axes * own.torque,
            },
            Self::Unit(number, factor) if number == sensor => own * factor,
            Self::Swapped(a, b) if a == sensor => readings[b],
            Self::Swapped(a, b) if b == sensor => readings[a],
            _ => own,
        }
    }
}

/// All rotations by quarter turns about the axes but the identity.
pub(crate) fn quarter_turns() -> Vec<Mat3> {
    let about = |axis: Vec3, count: u8| {
        Rotation3::new(axis * (0.5 * PI * f64::from(count)))
            .into_inner()
            .map(f64::round)
    };
    // A first turn brings z to each of six directions; a second one is about it.
    let first = [
        about(Vec3::x(), 0),
        about(Vec3::x(), 1),
        about(Vec3::x(), 2),
        about(Vec3::x(), 3),
        about(Vec3::y(), 1),
        about(Vec3::y(), 3),
    ];
    let all = first
        .iter()
        .flat_map(|first| (0..4).map(move |k| first * about(Vec3::z(), k)));
    all.filter(|turn| *turn != Mat3::identity()).collect()
}

/// How an F/T sensor may be read: other axes, mirrored or not; other units.
pub(crate) fn wrench_readings(sensor: usize) -> Vec<WrenchReading> {
    /// Millinewtons, kilogram-force and pound-force, taken for newtons and the other way round.
    const FACTORS: [f64; 3] = [1e3, GRAVITY, 4.448_222];
    let mut all = vec![WrenchReading::Axes(sensor, -Mat3::identity())];
    for turn in quarter_turns() {
        all.extend([
            WrenchReading::Axes(sensor, turn),
            WrenchReading::Axes(sensor, -turn),
        ]);
    }
    let units = FACTORS
        .into_iter()
        .flat_map(|factor| [factor, 1.0 / factor]);
    all.extend(units.map(|factor| WrenchReading::Unit(sensor, factor)));
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_estimated_has_its_own_unit() {
        let turn = MotionReading::BaseTurned(Vec3::zeros()).at(&[1.0, 0.0, -0.5]);
        assert_eq!(turn, MotionReading::BaseTurned(Vec3::new(0.3, 0.0, -0.15)));
        let encoder = MotionReading::Encoder(2, [0.0; 2]).at(&[0.5, -1.0]);
        assert_eq!(encoder, MotionReading::Encoder(2, [0.1, -0.2]));
        assert_eq!(
            MotionReading::Reversed(1).at(&[]),
            MotionReading::Reversed(1)
        );
    }

    #[test]
    fn an_encoder_with_another_zero_and_gain_moves_in_proportion() {
        let state = JointState {
            position: &[1.0, 2.0],
            velocity: &[3.0, 4.0],
            acceleration: &[5.0, 6.0],
        };
        let mut motion = SeenMotion::new(2);
        motion.copy_from(state, &FrameMotion::standing(&Vec3::zeros()));
        motion.see(MotionReading::Encoder(1, [0.5, 0.25]));
        assert_eq!(motion.position, [1.0, 3.0]);
        assert_eq!(motion.velocity, [3.0, 5.0]);
        assert_eq!(motion.acceleration, [5.0, 7.5]);
    }

    #[test]
    fn a_base_that_is_tilted_moves_in_other_axes() {
        let turn = Vec3::new(0.0, 0.0, 0.5 * PI);
        let mut motion = SeenMotion::new(0);
        motion.base.proper_acceleration = Vec3::x();
        motion.base.angular_velocity = Vec3::y();
        motion.see(MotionReading::BaseTurned(turn));
        assert!((motion.base.proper_acceleration - Vec3::y()).norm() < 1e-12);
        assert!((motion.base.angular_velocity + Vec3::x()).norm() < 1e-12);
    }

    #[test]
    fn the_quarter_turns_are_twenty_three_rotations() {
        let all = quarter_turns();
        assert_eq!(all.len(), 23);
        for (number, turn) in all.iter().enumerate() {
            assert!((turn.determinant() - 1.0).abs() < 1e-12);
            assert_eq!(turn * turn.transpose(), Mat3::identity());
            assert!(!all[..number].contains(turn));
        }
    }
}
